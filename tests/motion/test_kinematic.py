"""A kinematic body reads what physics says, and an error-free strapdown follows it, at rest and along segments."""

import functools
import math
import re
from types import SimpleNamespace

import numpy as np
import pymap3d
import pytest
from scipy.integrate import cumulative_simpson
from scipy.spatial.transform import Rotation

from nav import earth, strapdown
from testbed.errors import UserError
from testbed.feeds.simulated import motion
from testbed.motion.kinematic import Kinematic
from testbed.motion.sections import KinematicStart
from testbed.motion.segments import lay_track
from testbed.motion.table import COLUMNS, TruthBlock, increments
from testbed.scenario import Scenario

PLACES = [(34.0, 108.0, 800.0), (-33.0, 180.0, 20.0), (84.0, -40.0, 3000.0), (0.0, -180.0, 0.0)]


def place(lat_deg, lon_deg, alt_m, heading_deg=30.0, pitch_deg=4.0, roll_deg=-7.0):
    return SimpleNamespace(
        lat_deg=lat_deg, lon_deg=lon_deg, alt_m=alt_m, heading_deg=heading_deg, pitch_deg=pitch_deg, roll_deg=roll_deg
    )


@pytest.mark.parametrize("where", PLACES)
def test_reads_gravity_and_earth_rate(where):
    block = Kinematic(place(*where), 200).advance(3)
    lat = math.radians(where[0])
    C_nb = Rotation.from_euler("ZYX", [30.0, 4.0, -7.0], degrees=True).as_matrix()
    # rounding of some 460 m/s of inertial velocity, 200 times a second
    assert block.dv[1] * 200 == pytest.approx(C_nb.T @ [0, 0, -earth.gravity(lat, where[2])], abs=3e-11)
    earth_rate = 7.292115e-5 * np.array([math.cos(lat), 0, -math.sin(lat)])
    assert block.dtheta[1] * 200 == pytest.approx(C_nb.T @ earth_rate, abs=1e-13)  # rounding of quaternions
    assert block.omega_b[0] == pytest.approx(C_nb.T @ earth_rate, abs=1e-18)
    assert not block.dtheta[0].any()
    assert not block.dv[0].any()


@pytest.mark.parametrize("where", PLACES)
def test_agrees_with_increments_formed_from_its_rows(where):
    block = Kinematic(place(*where), 200).advance(2001)
    dtheta, dv = increments(block.t, block.lat, block.lon, block.h, block.v_n, block.q_nb)
    assert np.abs(dtheta - block.dtheta).max() < 1e-15
    assert np.abs(dv - block.dv).max() < 1e-12


@pytest.mark.ci
@pytest.mark.parametrize("where", PLACES)
def test_error_free_strapdown_stays_for_ten_minutes(where):
    block = Kinematic(place(*where), 200).advance(120_001)
    q, v, lla = block.q_nb[0].copy(), np.zeros(3), np.array([block.lat[0], block.lon[0], block.h[0]])
    strapdown.propagate(q, v, lla, block.dtheta[1:], block.dv[1:], np.full(120_000, 1 / 200))
    n, e, d = pymap3d.geodetic2ned(*lla, block.lat[0], block.lon[0], block.h[0], deg=False)
    print(
        f"{where}: {math.hypot(n, e):.1e} m horizontal, {abs(d):.1e} m vertical, {np.abs(q - block.q_nb[0]).max():.1e}"
    )
    assert math.hypot(n, e) < 1e-4
    assert abs(d) < 1e-4
    assert np.abs(q - block.q_nb[0]).max() < 1e-10


def test_rows_do_not_depend_on_how_they_are_asked_for():
    whole = Kinematic(place(*PLACES[0]), 200).advance(50)
    source = Kinematic(place(*PLACES[0]), 200)
    blocks = [source.advance(n) for n in (1, 0, 7, 42)]
    assert [b.tick for b in blocks] == [0, 1, 1, 8]
    for name in COLUMNS:
        assert np.array_equal(np.concatenate([getattr(b, name) for b in blocks]), getattr(whole, name))
    assert whole.t[-1] == 49 / 200


def test_still_standard_air_and_no_engine():
    row = Kinematic(place(*PLACES[0]), 200).advance(1)
    assert row.pressure[0] == pytest.approx(92076, rel=1e-4)  # U.S. Standard Atmosphere 1976 at 800 m
    assert row.temperature[0] == pytest.approx(282.951, abs=1e-2)
    assert row.density[0] == pytest.approx(1.1336, rel=1e-4)
    for name in ("v_n", "wind_n", "airspeed", "alpha", "beta", "engine_rpm", "current", "fuel", "controls"):
        assert not getattr(row, name).any()
    assert row.leg[0] == -1
    assert -math.pi < Kinematic(place(0.0, 540.0, 0.0), 200).advance(1).lon[0] <= math.pi


# --- along segments


def scenario(truth: str, start: str = "speed_mps = 50", rate_hz: float = 200, duration_s: float = 3600) -> Scenario:
    """Nothing but a motion: ``truth`` holds further keys and tables of [truth]."""
    return Scenario.parse(
        f'title = "motion"\nduration_s = {duration_s}\n[truth]\nsource = "kinematic"\nmotion = "segments"\n'
        f"rate_hz = {rate_hz}\nstart = {{ lat_deg = 34.0, lon_deg = 108.0, alt_m = 1000, heading_deg = 30, {start} }}\n"
        f"{truth}"
    )


def source(truth: str, start: str = "speed_mps = 50", rate_hz: float = 200) -> Kinematic:
    made = motion(scenario(truth, start, rate_hz), 1)
    assert isinstance(made, Kinematic)
    return made


def segments(*tables: str) -> str:
    return "".join(f"[[truth.segments]]\n{table}\n" for table in tables)


U_FLIGHT = 'body = { turns = "banked", blend_s = 3 }\n' + segments(
    'leg = "straight"\nduration_s = 200', 'leg = "turn"\nby_deg = 180\nrate_degps = 3'
)
STOP_AND_GO = "body = { drift_s = 0.1, blend_s = 0.5 }\n" + segments(
    'leg = "stop"\nduration_s = 60',
    'leg = "accelerate"\nto_mps = 3\naccel_mps2 = 2',
    'leg = "straight"\nduration_s = 130',
    'leg = "accelerate"\nto_mps = 0\naccel_mps2 = 2',
    'leg = "stop"\nduration_s = 20',
    'leg = "accelerate"\nto_mps = 3\naccel_mps2 = 2',
    'leg = "straight"\nduration_s = 133.5',
    'leg = "turn"\nby_deg = -90\nrate_degps = 30',
    'leg = "repeat"\nlast = 6\ntimes = 40',
)
SWAY = "roll = { amplitude_deg = 2, period_s = 8 }, pitch = { amplitude_deg = 0.5, period_s = 6, phase_deg = 40 }"
RIVER = f"body = {{ {SWAY} }}\n" + segments('leg = "weave"\nswing_deg = 120\nperiod_s = 1200\nswings = 6\nto_mps = 6')
SQUARE = "body = { blend_s = 0.5 }\n" + segments(
    'leg = "stop"\nduration_s = 10',
    'leg = "accelerate"\nto_mps = 5\naccel_mps2 = 1',
    'leg = "straight"\nlength_m = 230',
    'leg = "turn"\nby_deg = 90\nradius_m = 8',
    'leg = "repeat"\nlast = 2\ntimes = 3',
    'leg = "accelerate"\nto_mps = 0\naccel_mps2 = 1',
)
ACCELERATED = segments('leg = "straight"\nduration_s = 100', 'leg = "accelerate"\nto_mps = 200\nduration_s = 100')
CLIMBS = 'body = { turns = "banked", blend_s = 2 }\n' + segments(
    'leg = "climb"\nby_m = 300\nrate_mps = 5',
    'leg = "turn"\nby_deg = -400\nradius_m = 500',
    'leg = "climb"\nby_m = -200\nduration_s = 100',
)
# Motion, speed at its start, how long
MOTIONS = {
    "accelerated": (ACCELERATED, 100.0, 1200.0),
    "square": (SQUARE, 0.0, 216.0),
    "u_flight": (U_FLIGHT, 50.0, 600.0),
    "stop_and_go": (STOP_AND_GO, 0.0, 700.0),
    "river": (RIVER, 3.0, 1200.0),
    "climbs": (CLIMBS, 60.0, 600.0),
}


@functools.cache
def rows(name: str) -> TruthBlock:
    truth, speed, duration = MOTIONS[name]
    return source(truth, f"speed_mps = {speed}").advance(round(duration * 200) + 1)


def attitude(block: TruthBlock) -> Rotation:
    return Rotation.from_quat(block.q_nb, scalar_first=True)


def euler_deg(block: TruthBlock) -> np.ndarray:
    """Roll, pitch, heading (N, 3)."""
    return attitude(block).as_euler("ZYX", degrees=True)[:, ::-1]


def to_ecef(block: TruthBlock) -> Rotation:
    """North-east-down to earth-centred axes: from the Euler angles of their definition."""
    return Rotation.from_euler("ZY", np.column_stack([block.lon, -np.pi / 2 - block.lat]))


def error_free_strapdown_follows(block: TruthBlock, rate_hz: float) -> None:
    q, v, lla = block.q_nb[0].copy(), block.v_n[0].copy(), np.array([block.lat[0], block.lon[0], block.h[0]])
    worst = np.zeros(3)
    step = len(block) // 10
    for start in range(0, len(block) - step, step):
        part = slice(start + 1, start + step + 1)
        strapdown.propagate(q, v, lla, block.dtheta[part], block.dv[part], np.full(step, 1 / rate_hz))
        k = start + step
        ned = pymap3d.geodetic2ned(*lla, block.lat[k], block.lon[k], block.h[k], deg=False)
        true = Rotation.from_quat(block.q_nb[k], scalar_first=True)
        turned = true.inv() * Rotation.from_quat(q, scalar_first=True)
        worst = np.maximum(worst, [np.linalg.norm(ned), np.abs(v - block.v_n[k]).max(), turned.magnitude()])
    print(f"{block.t[-1]:.0f} s at {rate_hz} Hz: {worst[0]:.1e} m, {worst[1]:.1e} m/s, {worst[2]:.1e} rad")
    assert worst[0] < 0.1
    assert worst[2] < 1e-5


@pytest.mark.ci
@pytest.mark.parametrize("name", MOTIONS)
def test_error_free_strapdown_follows(name: str) -> None:
    error_free_strapdown_follows(rows(name), 200)


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [100, 250])
@pytest.mark.parametrize("name", MOTIONS)
def test_error_free_strapdown_follows_for_an_hour(name: str, rate_hz: float) -> None:
    truth, speed, _ = MOTIONS[name]
    error_free_strapdown_follows(source(truth, f"speed_mps = {speed}", rate_hz).advance(round(3600 * rate_hz)), rate_hz)


@pytest.mark.ci
@pytest.mark.parametrize("name", MOTIONS)
def test_position_is_the_integral_of_velocity(name: str) -> None:
    block = rows(name)
    x, y, z = pymap3d.geodetic2ecef(block.lat, block.lon, block.h, deg=False)
    v_e = to_ecef(block).apply(block.v_n)
    moved = cumulative_simpson(v_e, dx=1 / 200, axis=0, initial=0)
    apart = np.column_stack([x, y, z]) - [x[0], y[0], z[0]] - moved
    print(f"{name}: {np.abs(apart).max():.1e} m in {block.t[-1]:.0f} s")
    assert np.abs(apart).max() < 1e-6


@pytest.mark.ci
@pytest.mark.parametrize("name", MOTIONS)
def test_body_rate_is_that_of_the_attitude_and_sums_to_the_increments(name: str) -> None:
    block = rows(name)
    inertial = Rotation.from_euler("Z", 7.292115e-5 * block.t[:, None]) * to_ecef(block) * attitude(block)
    dt = 1 / 200
    near = (inertial[1:-1].inv() * inertial[2:]).as_rotvec() - (inertial[1:-1].inv() * inertial[:-2]).as_rotvec()
    far = (inertial[2:-2].inv() * inertial[4:]).as_rotvec() - (inertial[2:-2].inv() * inertial[:-4]).as_rotvec()
    rate = (8 * near[1:-1] - far) / (12 * dt)  # five points: the fourth order
    two = dt / 3 * (block.omega_b[:-2] + 4 * block.omega_b[1:-1] + block.omega_b[2:])
    # not across the instants at which a blend begins or ends: the rate has corners there
    truth, speed, _ = MOTIONS[name]
    knots = scenario(truth, f"speed_mps = {speed}").truth.track().path.x
    after = np.searchsorted(knots, block.t + 3.5 * dt) == np.searchsorted(knots, block.t - 3.5 * dt)
    assert np.abs(rate - block.omega_b[2:-2])[after[2:-2]].max() < 1e-9
    assert (
        np.abs(block.dtheta[1:-1] + block.dtheta[2:] - two)[after[1:-1]].max() < 3e-9
    )  # what coning there is in a tick


def test_rows_of_a_moving_body_do_not_depend_on_how_they_are_asked_for() -> None:
    truth = 'body = { turns = "banked", drift_s = 0.1 }\n' + segments(
        'leg = "turn"\nby_deg = 9\nrate_degps = 30', 'leg = "climb"\nby_m = 9\nrate_mps = 9'
    )
    whole, pieces = source(truth).advance(999), source(truth)
    blocks = [pieces.advance(n) for n in (1, 0, 1, 7, 390, 600)]
    for name in COLUMNS:
        joined = np.concatenate([getattr(b, name) for b in blocks])
        assert np.array_equal(joined[:999], getattr(whole, name)), name


def test_a_flat_turn_is_felt_sideways() -> None:
    """Closed forms in the steady part of a turn: V w to the right, less 2 w_ie V sin(lat) by which the Earth turns."""
    body = rows("square")
    k = np.flatnonzero(body.leg == 3)[200]
    V, w = 5.0, 5.0 / 8
    f_b, lat = body.dv[k] * 200, body.lat[k]
    assert np.linalg.norm(body.v_n[k]) == pytest.approx(V, abs=1e-12)
    assert body.omega_b[k, 2] == pytest.approx(w - 7.292e-5 * math.sin(lat), abs=2e-6)
    assert f_b[1] == pytest.approx(V * w - 2 * 7.292e-5 * V * math.sin(lat), abs=1e-5)
    assert f_b[2] == pytest.approx(-earth.gravity(lat, 1000.0), abs=1e-3)
    assert np.abs(euler_deg(body)[k, :2]).max() < 1e-12


def test_a_banked_turn_is_felt_downwards() -> None:
    body = rows("u_flight")
    k = 220 * 200
    V, w, lat = 50.0, math.radians(3), body.lat[k]
    f_b, g = body.dv[k] * 200, earth.gravity(lat, 1000.0)
    assert euler_deg(body)[k, 0] == pytest.approx(math.degrees(math.atan(V * w / g)), abs=1e-3)
    # Besides lift there is what holds the body on a turning Earth, 2 w_ie x v, and over a round one, v^2 / R
    v_n = (body.v_n[k] + body.v_n[k - 1]) / 2
    rate_n = 2 * 7.292115e-5 * np.array([math.cos(lat), 0, -math.sin(lat)])
    rate_n += [v_n[1] / 6.385e6, -v_n[0] / 6.364e6, -v_n[1] / 6.385e6 * math.tan(lat)]
    lift = f_b - attitude(body)[k].inv().apply(np.cross(rate_n, v_n))
    assert lift == pytest.approx([0, 0, -math.hypot(g, V * w)], abs=1e-3)
    assert np.abs(body.beta).max() < 1e-12
    assert np.abs(body.alpha).max() < 1e-12
    assert body.commands[k] == pytest.approx([math.atan(V * w / g), 1000.0, 50.0], rel=1e-4)


def test_a_turn_is_a_circle_of_its_radius_and_ends_on_its_course() -> None:
    body = rows("square")
    first = body.rows(*np.flatnonzero((body.leg == 3) & (body.t < 65))[[0, -1]])
    steady = first.rows(120, len(first) - 120)
    north, east, _ = pymap3d.geodetic2ned(
        steady.lat, steady.lon, steady.h, steady.lat[0], steady.lon[0], 1000.0, deg=False
    )
    lines = np.column_stack([2 * north, 2 * east, np.ones(len(north))])
    (cn, ce, c), *_ = np.linalg.lstsq(lines, north**2 + east**2)
    assert math.sqrt(c + cn**2 + ce**2) == pytest.approx(8.0, abs=1e-4)
    courses = np.degrees(np.arctan2(body.v_n[:, 1], body.v_n[:, 0]))
    straight = np.flatnonzero((body.leg == 2) & (body.t < 100))[-1]
    assert courses[straight] == pytest.approx(120.0, abs=1e-9)
    # length: 230 m, and the turn's at 5 m/s: 90 deg at the full rate, and once the blend
    assert len(first) / 200 == pytest.approx(math.pi / 2 * 8 / 5 + 0.5, abs=0.011)
    assert np.count_nonzero((body.leg == 2) & (body.t < 64)) / 200 == pytest.approx(46.0, abs=0.011)


def test_acceleration_within_a_time_or_at_a_rate() -> None:
    body = rows("accelerated")
    speed = np.linalg.norm(body.v_n, axis=1)
    assert speed[[0, 100 * 200, 200 * 200, -1]] == pytest.approx([100, 100, 200, 200], abs=1e-10)
    assert body.dv[150 * 200, 0] * 200 == pytest.approx(100 / 99, abs=1e-6)  # 1 s of blend
    stop_and_go = rows("stop_and_go")
    going = np.flatnonzero(stop_and_go.leg == 1)
    assert len(going) / 200 == pytest.approx(1.5 + 0.5, abs=0.011)
    assert stop_and_go.dv[going[150], 0] * 200 == pytest.approx(2.0, abs=1e-6)
    standing = stop_and_go.rows(*np.flatnonzero((stop_and_go.leg == 4) & (stop_and_go.t < 300))[[0, -1]])
    assert len(standing) > 3900
    assert not standing.v_n.any()
    assert np.abs(standing.dv[1:, :2]).max() * 200 < 1e-9


def test_rounding_never_lets_a_body_that_stops_go_backwards() -> None:
    """A row just before the stop, where speed is less than its rounding."""
    for speed in np.random.default_rng(1).uniform(0.1, 30, 60).round(3):
        truth = segments('leg = "accelerate"\nto_mps = 0\nduration_s = 2.0000001')
        body = source(truth, f"speed_mps = {speed}", 50).advance(102)
        assert np.abs(euler_deg(body) - [0, 0, 30]).max() < 1e-9
        assert not body.alpha.any()
        assert not body.v_n[-1].any()


def test_drift_points_the_nose_into_the_turn() -> None:
    body = rows("stop_and_go")
    k = np.flatnonzero(body.leg == 7)[350]  # to the left at 30 deg/s
    course = math.degrees(math.atan2(body.v_n[k, 1], body.v_n[k, 0]))
    assert euler_deg(body)[k, 2] - course == pytest.approx(-3.0, abs=1e-9)
    assert math.degrees(body.beta[k]) == pytest.approx(3.0, abs=1e-9)  # the velocity lies to the right of the nose
    assert np.abs(body.beta[body.leg == 6]).max() < 1e-12


def test_a_river_is_sinusoidal_and_a_ship_sways() -> None:
    body = rows("river")
    phase = 2 * np.pi * body.t / 1200
    course = np.degrees(np.unwrap(np.arctan2(body.v_n[:, 1], body.v_n[:, 0])))
    assert np.abs(course - (90 - 60 * np.cos(phase))).max() < 1e-4
    assert np.abs(np.linalg.norm(body.v_n, axis=1) - (4.5 - 1.5 * np.cos(2 * phase))).max() < 1e-5
    roll, pitch, _ = euler_deg(body).T
    assert np.abs(roll - 2 * np.sin(2 * np.pi * body.t / 8)).max() < 1e-9
    assert np.abs(pitch - 0.5 * np.sin(2 * np.pi * body.t / 6 + math.radians(40))).max() < 1e-9


def test_a_climb_points_up_its_path_into_thinner_air() -> None:
    body = rows("climbs")
    k = 30 * 200
    assert euler_deg(body)[k, 1] == pytest.approx(math.degrees(math.atan2(5, 60)), abs=1e-9)
    assert body.airspeed[k] == pytest.approx(math.hypot(5, 60), abs=1e-9)
    assert np.abs(body.alpha).max() < 1e-12
    assert body.h[np.flatnonzero(body.leg == 1)[[0, -1]]] == pytest.approx(1300.0, abs=1e-9)
    assert body.h[-1] == pytest.approx(1100.0, abs=1e-9)
    assert body.pressure[np.flatnonzero(body.leg == 1)[0]] == pytest.approx(86666, rel=2e-4)  # ISA at 1300 m
    assert body.density[-1] == pytest.approx(1.1008, rel=1e-3)  # and at 1100 m


def test_it_goes_on_straight_after_its_segments_and_repeats_count_as_what_they_repeat() -> None:
    body = rows("u_flight")
    assert list(dict.fromkeys(body.leg)) == [0, 1, -1]
    assert body.leg[[200 * 200 - 1, 200 * 200]].tolist() == [0, 1]
    assert np.ptp(body.v_n[body.leg == -1], axis=0) == pytest.approx(0.0, abs=1e-12)
    assert np.linalg.norm(body.v_n[-1]) == pytest.approx(50.0, abs=1e-12)
    square = rows("square")
    assert square.leg[np.flatnonzero(np.diff(square.leg))].tolist() == [0, 1, 2, 3, 2, 3, 2, 3, 2, 3]


def test_short_changes_blend_faster() -> None:
    """A turn that ends before its rate has built up is all blend; its angle is kept."""
    truth = "body = { blend_s = 5 }\n" + segments(
        'leg = "turn"\nby_deg = 6\nrate_degps = 3', 'leg = "turn"\nby_deg = 6\nduration_s = 4'
    )
    body = source(truth).advance(1601)
    courses = np.degrees(np.arctan2(body.v_n[:, 1], body.v_n[:, 0]))
    assert courses[[0, 800, 1600]] == pytest.approx([30, 36, 42], abs=1e-9)
    assert np.degrees(body.omega_b[[400, 1200], 2]) == pytest.approx([3, 3], abs=0.01)


def test_it_ends_where_there_is_no_north() -> None:
    truth = segments('leg = "straight"\nduration_s = 100')
    start = scenario(truth).truth.start.model_copy(update={"lat_deg": 84.99, "heading_deg": 0.0, "speed_mps": 500.0})
    assert isinstance(start, KinematicStart)
    body = Kinematic(start, 200, lay_track((), 500.0))
    blocks = [body.advance(300) for _ in range(3)]
    assert len(blocks[0]) == 300
    assert 0 < len(blocks[1]) < 300
    assert len(blocks[2]) == 0
    assert np.degrees(blocks[1].lat[-1]) == pytest.approx(85, abs=1e-4)
    assert np.degrees(blocks[1].lat[-1]) <= 85
    assert "no north" in body.failure
    assert body.activity() == body.failure


# --- what can't be


@pytest.mark.parametrize(
    ("tables", "start", "says"),
    [
        ('leg = "turn"\nby_deg = 90', "", "truth.segments[0]: give one of rate_degps, radius_m, duration_s"),
        ('leg = "turn"\nby_deg = 90\nradius_m = 0', "", "truth.segments[0].radius_m: must be greater than 0"),
        ('leg = "turn"\nby_deg = 90\nradius_m = 100', "0", "truth.segments[0].radius_m: the body stands still here"),
        (
            'leg = "turn"\nby_deg = 90\nradius_m = 10',
            "",
            "truth.segments[0].radius_m: asks for 25.5 g: 5 g is the most",
        ),
        ('leg = "turn"\nby_deg = 0\nradius_m = 10', "", "truth.segments[0]: turns by nothing"),
        ('leg = "turn"\nby_deg = 9\nradius = 10', "", "truth.segments[0].radius: unknown key: did you mean radius_m"),
        ('leg = "tern"', "", 'truth.segments[0].leg: there is no leg "tern": did you mean turn'),
        ("by_deg = 3", "", "truth.segments[0].leg: is missing: add it, one of stop, straight"),
        ('leg = "stop"\nduration_s = 3', "", "truth.segments[0].leg: the body still moves at 50 m/s"),
        ('leg = "stop"\nduration_s = -3', "0", "truth.segments[0].duration_s: must be greater than or equal to 0.001"),
        ('leg = "straight"\nlength_m = 3', "0", "truth.segments[0].length_m: the body stands still here"),
        ('leg = "straight"\nlength_m = 3', "1e-300", "truth.segments[0].length_m: takes 3e+300 s"),
        ('leg = "straight"', "", "truth.segments[0]: give one of length_m, duration_s"),
        (
            'leg = "accelerate"\nto_mps = 50\naccel_mps2 = 1',
            "",
            "truth.segments[0].to_mps: the speed is 50 m/s already",
        ),
        ('leg = "accelerate"\nto_mps = 60\nduration_s = 0.1', "", "truth.segments[0].duration_s: asks for 20.4 g"),
        ('leg = "climb"\nby_m = 100\nrate_mps = 60', "", "truth.segments[0].rate_mps: 60 m/s is steeper than 45 deg"),
        ('leg = "climb"\nby_m = -1600\nrate_mps = 6', "", "truth.segments[0].by_m: ends at -600 m"),
        ('leg = "climb"\nby_m = 0\nrate_mps = 6', "", "truth.segments[0].by_m: is no climb"),
        ('leg = "weave"\nswing_deg = 120\nperiod_s = 9\nswings = 0', "", "truth.segments[0].swings: must be greater"),
        ('leg = "weave"\nswing_deg = 120\nperiod_s = 2\nswings = 2', "", "truth.segments[0].period_s: asks for"),
        ('leg = "repeat"\nlast = 1\ntimes = 1', "", "truth.segments[0].last: there are only 0 segments before it"),
    ],
)
def test_motions_that_cannot_be(tables: str, start: str, says: str) -> None:
    with pytest.raises(UserError) as caught:
        scenario(segments(tables), f"speed_mps = {start or 50}")
    place, _, said = str(caught.value).partition(": ")
    assert re.fullmatch(r"scenario:\d+", place)
    assert said.startswith(says)


@pytest.mark.parametrize(
    ("truth", "says"),
    [
        ("", "truth.segments: is missing: add at least one [[truth.segments]] table"),
        (
            segments('leg = "straight"\nlength_m = 1', 'leg = "repeat"\nlast = 1\ntimes = 1') * 2
            + segments('leg = "repeat"\nlast = 4\ntimes = 1'),
            "truth.segments[4].last: reaches beyond another repeat",
        ),
        (
            segments(
                'leg = "weave"\nswing_deg = 9\nperiod_s = 9\nswings = 999', 'leg = "repeat"\nlast = 1\ntimes = 99'
            ),
            "truth.segments[0].leg: the motion has too many segments up to here",
        ),
        ("body = { turns = 3 }\n" + segments('leg = "straight"\nlength_m = 1'), "truth.body.turns: can't be 3"),
    ],
)
def test_motions_that_cannot_be_as_a_whole(truth: str, says: str) -> None:
    with pytest.raises(UserError, match=re.escape(says)):
        scenario(truth)


def test_a_static_body_has_neither_speed_nor_segments() -> None:
    text = scenario(segments('leg = "straight"\nlength_m = 1')).text
    with pytest.raises(UserError) as caught:
        Scenario.parse(text, ["truth.motion=static"])
    assert "truth.segments: a static body follows none" in str(caught.value)
    assert "truth.start.speed_mps: a static body has none" in str(caught.value)
