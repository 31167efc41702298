"""Weather: what is drawn against its analytic variances, the rest against closed formulas; and as it is flown in."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy.interpolate import RegularGridInterpolator
from scipy.stats import chi2

from nav.terrain import Terrain
from testbed.errors import UserError
from testbed.estimators.rig import Air
from testbed.motion.flight import Flight
from testbed.motion.legs import Leg
from testbed.motion.sections import FlightTruth, KinematicTruth, Start, Wind
from testbed.motion.sections import Terrain as Ground
from testbed.motion.updrafts import UpdraftField, outer_radius
from testbed.motion.weather import UNKNOWN_WALK, Weather, blowing, expected_walk, strongest
from testbed.motion.wind_table import read
from testbed.scenario import Scenario

PERIOD = 0.1
START = Start(lat_deg=34.0, lon_deg=108.0, alt_m=280.0, heading_deg=30.0, airspeed_mps=25.0)
LEVEL = Terrain.flat(0.0)
HERE = (math.radians(34.0), math.radians(108.0), 280.0)
RUNS = 400
METRE = math.degrees(1 / 6.37e6)
ALWAYS = {"from_deg": 250.0, "speed_mps": 6.0}
LAYER = {**ALWAYS, "boundary_layer": {"roughness_m": 0.1, "reference_m": 10.0, "top_m": 300.0}}
THERMALS = {"updrafts": {"w_star_mps": 2.5, "depth_m": 1500.0}}


def air(wind: dict[str, Any], seed: int = 1, ground: Terrain = LEVEL) -> Weather:
    return Weather(Wind.model_validate(wind), START, ground, seed, PERIOD)


def blown(wind: dict[str, Any], seconds: float, seed: int = 1) -> np.ndarray:
    """Velocity at each step of a body that stays (N, 3)."""
    weather = air(wind, seed)
    return np.array([weather.step(*HERE) for _ in range(round(seconds / PERIOD) + 1)])


def within_chance(values: np.ndarray, variance: float) -> None:
    """Whether independent draws with zero mean have this variance, in a band that one in ten thousand tests leaves."""
    low, high = chi2.ppf([5e-5, 1 - 5e-5], values.size)
    assert low < (values**2).sum() / variance < high


# --- what is drawn


@pytest.mark.ci
def test_a_walk_grows_with_the_root_of_time() -> None:
    """From zero at the start; what it does in one stretch of time says nothing of the next."""
    walks = np.array([blown({"walk_mps_per_sqrt_s": 0.05}, 40.0, seed)[:, :2] for seed in range(RUNS)])
    assert not walks[:, 0].any()
    for seconds in (1.0, 10.0, 40.0):
        within_chance(walks[:, round(seconds / PERIOD)], 0.05**2 * seconds)
    within_chance(walks[:, 400] - walks[:, 100], 0.05**2 * 30)
    product = (walks[:, 400] - walks[:, 100]) * walks[:, 100] / (0.05**2 * math.sqrt(30 * 10))
    assert abs(product.mean()) < 4 / math.sqrt(product.size)
    north_east = walks[:, 400].prod(axis=1) / (0.05**2 * 40)
    assert abs(north_east.mean()) < 4 / math.sqrt(RUNS)


@pytest.mark.ci
def test_a_gauss_markov_part_is_stationary_and_forgets() -> None:
    """Variance sigma^2 at all times, from the first on, and covariance sigma^2 exp(-t / tau)."""
    wind = {"gauss_markov": {"sigma_mps": 1.5, "correlation_s": 20.0}}
    drawn = np.array([blown(wind, 40.0, seed)[:, :2] for seed in range(RUNS)])
    for seconds in (0.0, 20.0, 40.0):
        within_chance(drawn[:, round(seconds / PERIOD)], 1.5**2)
    phi = math.exp(-20.0 / 20.0)
    within_chance(drawn[:, 200] - phi * drawn[:, 0], 1.5**2 * (1 - phi**2))
    within_chance(drawn[:, 400] - phi * drawn[:, 200], 1.5**2 * (1 - phi**2))


@pytest.mark.ci
def test_each_is_drawn_from_its_own_stream() -> None:
    walk, back = {"walk_mps_per_sqrt_s": 0.05}, {"gauss_markov": {"sigma_mps": 1.5, "correlation_s": 20.0}}
    alone = blown(walk, 30.0) + blown(back, 30.0) + blown(THERMALS, 30.0)
    np.testing.assert_allclose(blown({**walk, **back, **THERMALS}, 30.0), alone, atol=1e-12)
    assert (blown(walk, 30.0, seed=2) != blown(walk, 30.0)).any()


def test_the_start_is_in_the_wind_of_the_first_step() -> None:
    wind = {**ALWAYS, "gauss_markov": {"sigma_mps": 1.5, "correlation_s": 20.0}}
    weather = air(wind)
    assert weather.start(280.0) == weather.step(*HERE)[:2]


# --- formulas


def test_one_wind_never_changes() -> None:
    assert not air(ALWAYS).changes
    assert air(ALWAYS).start(280.0) == blowing(250.0, 6.0)
    assert blowing(90.0, 6.0) == pytest.approx((0.0, -6.0))  # an easterly


def test_a_front_is_a_smooth_step() -> None:
    """Old wind before, new wind after, half of each in the middle; 3 s^2 - 2 s^3 of the change at a share s of it."""
    front = {"time_s": 60.0, "width_s": 40.0, "from_deg": 330.0, "speed_mps": 11.0}
    v = blown({**ALWAYS, "front": front}, 120.0)
    t = PERIOD * np.arange(len(v))
    old, new = np.array(blowing(250.0, 6.0)), np.array(blowing(330.0, 11.0))
    s = np.clip((t - 40.0) / 40.0, 0.0, 1.0)
    np.testing.assert_allclose(v[:, :2], old + np.outer(3 * s**2 - 2 * s**3, new - old), atol=1e-12)
    np.testing.assert_allclose(v[600, :2], (old + new) / 2, atol=1e-12)
    assert np.abs(np.diff(v, axis=0)).max() < 1.5 * PERIOD / 40 * np.abs(new - old).max() + 1e-9  # its steepest slope


def test_a_boundary_layer_is_logarithmic() -> None:
    """v(h) = u* / 0.4 ln(h / z0), u* that of the wind at the reference; nothing at z0, the same from the top on."""
    weather = air(LAYER)
    friction = 0.4 * 6.0 / math.log(10.0 / 0.1)
    for h in (0.1, 2.0, 10.0, 50.0, 300.0):
        assert math.hypot(*weather.step(*HERE[:2], h)) == pytest.approx(friction / 0.4 * math.log(h / 0.1), abs=1e-12)
    assert weather.step(*HERE[:2], 900.0) == weather.step(*HERE[:2], 300.0)
    assert math.hypot(*weather.step(*HERE[:2], -3.0)) == 0.0
    assert strongest(Wind.model_validate(LAYER)) == pytest.approx(6.0 * math.log(3000) / math.log(100))


@pytest.mark.parametrize("ground", [0.0, 500.0, 2000.0])
def test_height_over_ground_is_over_the_ground(ground: float) -> None:
    """It was over the ellipsoid: over 2000 m a boundary layer was at its top, and no thermals were left.

    The same but for metres north of the start, which are longer higher up: 0.6 m of 2000.
    """
    level, raised = air({**LAYER, **THERMALS}), air({**LAYER, **THERMALS}, ground=Terrain.flat(ground))
    for north in np.arange(0.0, 2000.0, 50.0):
        lat, h = HERE[0] + math.radians(north * METRE), 100.0 + north / 10
        assert raised.start(ground + h) == pytest.approx(level.start(h))
        np.testing.assert_allclose(raised.step(lat, HERE[1], ground + h), level.step(lat, HERE[1], h), atol=0.02)


def test_height_over_ground_follows_a_relief() -> None:
    """A slope of one in ten to the north, flown level: the height over ground is what is left."""
    slope = Terrain(np.array([[0.0, 0.0], [1000.0, 1000.0]]), np.radians([34.0, 10_000 * METRE, 107.0, 2.0]))
    weather, level = air(LAYER, ground=slope), air(LAYER)
    for north in (0.0, 1000.0, 2000.0, 2700.0):
        lat = HERE[0] + math.radians(north * METRE)
        assert weather.step(lat, *HERE[1:]) == pytest.approx(level.step(lat, HERE[1], 280.0 - north / 10))


def test_profiles_go_by_altitude() -> None:
    profile = {"profile": [[0.0, 250.0, 2.0], [1000.0, 250.0, 12.0]]}
    assert air(profile, ground=Terrain.flat(500.0)).step(*HERE) == air(profile).step(*HERE)


def test_a_gradient_grows_with_the_distance_from_the_start() -> None:
    weather = air({**ALWAYS, "gradient_mps_per_km": [[1.0, -2.0], [0.5, 3.0]]})
    lat, lon = math.radians(34.0 + 2000 * METRE), math.radians(108.0 - 1000 * METRE / math.cos(math.radians(34.0)))
    change = np.array(weather.step(lat, lon, 280.0)[:2]) - blowing(250.0, 6.0)
    np.testing.assert_allclose(change, [1.0 * 2 - 2.0 * -1, 0.5 * 2 + 3.0 * -1], rtol=5e-3)
    assert weather.step(*HERE)[:2] == pytest.approx(blowing(250.0, 6.0))


def test_a_gradient_knows_the_date_line() -> None:
    start = START.model_copy(update={"lon_deg": 179.9999})
    weather = Weather(Wind(gradient_mps_per_km=((1.0, 1.0), (1.0, 1.0))), start, LEVEL, 1, PERIOD)
    assert np.abs(weather.step(HERE[0], math.radians(-179.9999), 280.0)).max() < 0.03


# --- updrafts


def test_an_updraft_is_allens() -> None:
    """At 0.4 of a layer of 1500 m, worked by hand: r2 = 0.102 x 0.7368 x 0.9 x 1500 = 101.5 m, r1/r2 = 0.2516, the mean
    2.5 x 0.7368 x 0.56 = 1.0315 m/s, the centre 3 x 1.0315 x 0.7484 / 0.98407 = 2.353 m/s; sink between them.
    """
    field = UpdraftField(2.5, 1500.0, 1)
    assert outer_radius(600.0, 1500.0) == pytest.approx(101.5, abs=0.1)
    place = field.places[0]
    assert field.up(*place, 600.0) == pytest.approx(2.353, abs=0.01)
    assert field.up(place[0] + field.side, place[1] - 3 * field.side, 600.0) == pytest.approx(field.up(*place, 600.0))
    assert len(field.places) == round(0.6 * field.side**2 / (1500.0 * 101.5))
    for h in (0.0, -5.0, 0.95 * 1500.0, 3000.0):
        assert field.up(*place, h) == 0.0


@pytest.mark.parametrize("share", [0.2, 0.4, 0.6, 0.8])
def test_what_goes_up_comes_down(share: float) -> None:
    """The mean over the field is a hundredth of the strongest; over one updraft Allen's mean; no step on any way."""
    field = UpdraftField(2.5, 1500.0, 1)
    h = share * 1500.0
    along = np.linspace(0.0, field.side, 100)
    w = np.array([field.up(north, east, h) for north, east in itertools.product(along, along)])
    assert abs(w.mean()) < 0.015 * w.max()
    assert w.min() < 0.0
    way = np.array([field.up(field.places[0][0] + x, field.places[0][1], h) for x in np.arange(0.0, 500.0, 0.5)])
    assert np.abs(np.diff(way)).max() < 0.04


def test_updrafts_lie_anywhere_and_by_the_seed() -> None:
    places = np.concatenate([UpdraftField(2.5, 1500.0, seed).places for seed in range(40)]) / (5 * 1500.0)
    counts = np.histogram2d(*places.T, bins=8, range=[[0, 1], [0, 1]])[0]
    expected = len(places) / 64
    assert chi2.ppf(1e-4, 63) < ((counts - expected) ** 2 / expected).sum() < chi2.ppf(1 - 1e-4, 63)
    np.testing.assert_array_equal(UpdraftField(2.5, 1500.0, 3).places, UpdraftField(1.0, 1500.0, 3).places)


# --- a table


def write(path: Path, text: str) -> Path:
    path.write_text(text, "utf-8")
    return path


def test_a_table_is_linear_in_time_and_altitude(tmp_path: Path) -> None:
    """Against scipy's interpolation on a grid; beyond it the nearest values hold."""
    times, alts = np.array([0.0, 600.0, 1500.0]), np.array([0.0, 150.0, 300.0, 1000.0])
    rng = np.random.default_rng(3)
    from_deg, speed = rng.uniform(0, 360, (3, 4)), rng.uniform(0, 15, (3, 4))
    grid = itertools.product(enumerate(times), enumerate(alts))
    rows = [f"{t},{alt},{from_deg[i, k]:.17g},{speed[i, k]:.17g}" for (i, t), (k, alt) in grid]
    table = read(write(tmp_path / "wind.csv", "\n".join(["time_s, alt_m, from_deg, speed_mps", *rows])))
    v = -speed[..., None] * np.stack((np.cos(np.radians(from_deg)), np.sin(np.radians(from_deg))), axis=-1)
    oracle = RegularGridInterpolator((times, alts), v)
    points = np.column_stack((rng.uniform(-200, 1800, 300), rng.uniform(-100, 1300, 300)))
    clipped = np.clip(points, [0.0, 0.0], [1500.0, 1000.0])
    np.testing.assert_allclose([table.at(*point) for point in points], oracle(clipped), atol=1e-12)
    assert table.strongest == pytest.approx(speed.max())


def test_a_sounding_may_have_other_columns_and_no_time(tmp_path: Path) -> None:
    path = write(tmp_path / "up.csv", "pressure,speed_mps,alt_m,from_deg\n1000,4,100,270\n900,8,900,270\n")
    weather = air({"file": str(path)})
    assert weather.changes
    assert weather.step(*HERE[:2], 500.0) == pytest.approx((0.0, 6.0, 0.0))


BAD_TABLES = [
    ("alt_m,from_deg\n0,1\n", ":1: has no column speed_mps: its columns are alt_m, from_deg"),
    ("", ":1: has no column alt_m and no from_deg and no speed_mps: its columns are none"),
    ("alt_m,from_deg,speed_mps\n", ": has no rows"),
    ("alt_m,from_deg,speed_mps\n0,1,2\n100,nan,3\n", ":3: from_deg is 'nan': must be a number from -360 to 360"),
    ("alt_m,from_deg,speed_mps\n0,1,2\n100,10,inf\n", ":3: speed_mps is 'inf'"),
    ("alt_m,from_deg,speed_mps\n0,1,-2\n", ":2: speed_mps is '-2': must be a number from 0"),
    ("alt_m,from_deg,speed_mps\n0,1\n", ":2: speed_mps is '': must"),
    ("alt_m,from_deg,speed_mps\n0,west,2\n", ":2: from_deg is 'west'"),
    ("alt_m,from_deg,speed_mps\n100,1,2\n0,1,2\n", ":3: is not sorted"),
    ("alt_m,from_deg,speed_mps\n100,1,2\n100,1,2\n", ":3: is not sorted"),
    ("time_s,alt_m,from_deg,speed_mps\n60,0,1,2\n0,0,1,2\n", ":3: is not sorted"),
]


@pytest.mark.parametrize(("text", "says"), BAD_TABLES)
def test_a_bad_table_is_told_with_file_line_and_key(tmp_path: Path, text: str, says: str) -> None:
    write(tmp_path / "wind.csv", text)
    with pytest.raises(UserError) as caught:
        Scenario.parse(WINDY, ['truth.wind={file="wind.csv"}'], tmp_path / "windy.toml")
    message = str(caught.value)
    assert message.count("\n") == 0
    assert "truth.wind.file: " in message
    assert f"{tmp_path / 'wind.csv'}{says}" in message


def test_a_table_that_is_not_there_or_no_text(tmp_path: Path) -> None:
    for name, says in (("none.csv", "can't be read: No such file"), (".", "can't be read: Is a directory")):
        with pytest.raises(UserError, match=says):
            Scenario.parse(WINDY, [f'truth.wind={{file="{name}"}}'], tmp_path / "windy.toml")
    (tmp_path / "wind.csv").write_bytes(b"alt_m\xff\xfe\x00")
    with pytest.raises(UserError, match="is not UTF-8 text"):
        Scenario.parse(WINDY, ['truth.wind={file="wind.csv"}'], tmp_path / "windy.toml")


# --- the section

WINDY = """title = "windy"
duration_s = 60
[truth]
source = "flight"
start = { lat_deg = 34.0, lon_deg = 108.0, alt_m = 280, heading_deg = 30, airspeed_mps = 25 }
wind = { from_deg = 250, speed_mps = 5 }
[[plan]]
leg = "straight"
length_m = 5000
[sensors.imu]
[sensors.gnss]
[sensors.airspeed]
[[estimator]]
name = "ins"
aids = ["gnss", "airspeed"]
"""


@pytest.mark.parametrize(
    ("wind", "says"),
    [
        ("{walk_mps_per_sqrt_s=-0.1}", "truth.wind.walk_mps_per_sqrt_s"),
        ("{walk_mps_per_sqrt_s=nan}", "truth.wind.walk_mps_per_sqrt_s"),
        ("{gauss_markov={sigma_mps=-1.0, correlation_s=60}}", "truth.wind.gauss_markov.sigma_mps"),
        ("{gauss_markov={sigma_mps=1.0, correlation_s=0}}", "truth.wind.gauss_markov.correlation_s"),
        ("{front={time_s=60, width_s=0, from_deg=0, speed_mps=5}}", "truth.wind.front.width_s"),
        ("{front={time_s=60, width_s=10}}", "truth.wind.front.speed_mps: is missing"),
        ("{gradient_mps_per_km=[[1, 2]]}", "truth.wind.gradient_mps_per_km"),
        ("{boundary_layer={roughness_m=20}}", "truth.wind.boundary_layer.roughness_m"),
        ("{boundary_layer={roughness_m=1, reference_m=0.5}}", "roughness_m must be below reference_m"),
        ("{updrafts={w_star_mps=2.0, depth_m=10}}", "truth.wind.updrafts.depth_m"),
        ("{profile=[]}", "truth.wind: profile has no rows: give one, or leave it out"),
        ('{file="a.csv", profile=[[0, 0, 1]]}', "a file replaces a profile"),
        ('{file="a.csv", speed_mps=3}', "a file replaces speed_mps"),
        (
            "{profile=[[0, 0, 1]], front={time_s=60, width_s=9, from_deg=0, speed_mps=5}}",
            "a profile replaces front: give one or the other",
        ),
    ],
)
def test_bad_weather_is_told_with_its_key(wind: str, says: str) -> None:
    with pytest.raises(UserError) as caught:
        Scenario.parse(WINDY, [f"truth.wind={wind}"])
    assert says in str(caught.value)


def test_a_radius_is_checked_with_the_strongest_wind(tmp_path: Path) -> None:
    write(tmp_path / "wind.csv", "alt_m,from_deg,speed_mps\n0,250,5\n900,250,20\n")
    tight = ['plan=[{leg="loiter", radius_m=150, turns=2}]']
    for wind in (
        "{from_deg=250, speed_mps=5, front={time_s=30, width_s=9, from_deg=0, speed_mps=20}}",
        "{from_deg=250, speed_mps=12, boundary_layer={roughness_m=0.1}}",
        '{file="wind.csv"}',
    ):
        with pytest.raises(UserError, match="m/s of wind: the least is"):
            Scenario.parse(WINDY, [*tight, f"truth.wind={wind}"], tmp_path / "windy.toml")
    Scenario.parse(WINDY, [*tight, "truth.wind.walk_mps_per_sqrt_s=0.05"])


# --- what filters are told


def told(*overrides: str) -> Air:
    return Scenario.parse(WINDY, overrides).rig(1).expected_air


def test_filters_expect_the_walk_that_the_scenario_has() -> None:
    assert told().wind_walk == UNKNOWN_WALK == 0.015
    assert told("truth.wind.walk_mps_per_sqrt_s=0.02").wind_walk == 0.02
    assert told("truth.wind.walk_mps_per_sqrt_s=0.0").wind_walk == 0.0  # which was said
    both = told("truth.wind.walk_mps_per_sqrt_s=0.02", "truth.wind.gauss_markov={sigma_mps=1.0, correlation_s=800}")
    assert both.wind_walk == pytest.approx(math.hypot(0.02, 0.05))
    still = KinematicTruth(source="kinematic", start={"lat_deg": 0.0, "lon_deg": 0.0, "alt_m": 0.0})  # type: ignore[arg-type]
    assert expected_walk(still) == UNKNOWN_WALK


@pytest.mark.parametrize("kind", ["ins", "federated"])
def test_an_estimator_may_be_told_otherwise(kind: str) -> None:
    aids = 'aids=["gnss", "airspeed"]' if kind == "ins" else 'locals=[{name="all", aids=["gnss", "airspeed"]}]'
    one = f'estimator=[{{name="e", kind="{kind}", {aids}, wind_walk_mps_per_sqrt_s=0.0}}]'
    scenario = Scenario.parse(WINDY, [one, "truth.wind.walk_mps_per_sqrt_s=0.02"])
    section: Any = scenario.estimator[0]
    rig = scenario.rig(1)
    assert rig.air(section.gust_mps, section.wind_walk_mps_per_sqrt_s).wind_walk == 0.0
    with pytest.raises(UserError, match="wind_walk_mps_per_sqrt_s"):
        Scenario.parse(WINDY, [one.replace("=0.0", "=-1.0")])


# --- flown

PLAN = TypeAdapter(list[Leg])
ROUND = PLAN.validate_python([{"leg": "loiter", "radius_m": 400, "duration_s": 120}])
ALL = {
    **ALWAYS,
    "walk_mps_per_sqrt_s": 0.05,
    "gauss_markov": {"sigma_mps": 1.0, "correlation_s": 60.0},
    "front": {"time_s": 15.0, "width_s": 10.0, "from_deg": 330.0, "speed_mps": 9.0},
    "gradient_mps_per_km": [[1.0, 0.0], [0.0, 1.0]],
    "boundary_layer": {"roughness_m": 0.1, "reference_m": 280.0},
    "updrafts": {"w_star_mps": 2.5, "depth_m": 1500.0},
}


def flight(wind: dict[str, Any], seed: int = 1, ground: float = 0.0) -> Flight:
    start = START.model_copy(update={"alt_m": START.alt_m + ground})
    truth = FlightTruth(source="flight", start=start, wind=Wind.model_validate(wind), terrain=Ground(height_m=ground))
    return Flight(truth, ROUND, seed)


@pytest.mark.ci
def test_truth_has_the_wind_that_there_was() -> None:
    """Each of ten times a second the wind of that place and time, and it holds until the next."""
    source = flight(ALL)
    block = source.advance(30 * 200 + 1)
    assert not source.failure
    weather = air(ALL)
    for frame in range(0, 300, 7):
        row = frame * 20
        while weather._steps < frame:
            weather.step(*HERE)
        expected = weather.step(block.lat[row], block.lon[row], block.h[row])
        held = block.wind_n[row + 1 : row + 21]
        np.testing.assert_allclose(held, np.tile(expected, (20, 1)), atol=1e-6)
    assert np.ptp(block.wind_n[:, 2]) > 0.05
    speed = np.linalg.norm(block.v_n - block.wind_n, axis=1)
    np.testing.assert_allclose(speed, block.airspeed, atol=1e-9)


@pytest.mark.ci
def test_weather_is_the_same_however_a_run_is_cut() -> None:
    whole = flight(ALL).advance(4001)
    source, blocks = flight(ALL), []
    for ticks in itertools.cycle((1, 7, 20, 333)):
        left = 4001 - sum(map(len, blocks))
        if not left:
            break
        blocks.append(source.advance(min(ticks, left)))
    for name in ("wind_n", "v_n", "lat", "q_nb"):
        np.testing.assert_array_equal(np.concatenate([getattr(b, name) for b in blocks]), getattr(whole, name))
    assert (flight(ALL, seed=2).advance(4001).wind_n != whole.wind_n).any()


@pytest.mark.ci
def test_over_high_ground_there_are_the_same_wind_and_thermals() -> None:
    """Higher up it flies another way, in thinner air: the same at first, and thermals all along."""
    wind = {**LAYER, **THERMALS}
    low, high = flight(wind).advance(30 * 200).wind_n, flight(wind, ground=2000.0).advance(30 * 200).wind_n
    np.testing.assert_allclose(high[:200], low[:200], atol=0.01)
    assert (high[1:, 2] != 0.0).all()
    assert np.linalg.norm(high[:, :2], axis=1) == pytest.approx(np.linalg.norm(low[:, :2], axis=1), abs=0.01)


@pytest.mark.ci
@pytest.mark.parametrize("ground", [0.0, 500.0])
def test_on_its_launcher_it_is_in_the_wind_there(ground: float) -> None:
    """Which is that of its height over ground from the first row on."""
    start = Start(lat_deg=34.0, lon_deg=108.0, alt_m=ground, heading_deg=250.0, on_ground=True)
    truth = FlightTruth(source="flight", start=start, wind=Wind.model_validate(LAYER), terrain=Ground(height_m=ground))
    source = Flight(truth, ROUND, 1)
    block = source.advance(200)
    over_ground = block.h[0] - ground
    assert 1.0 < over_ground < 5.0
    wind = 6.0 * math.log(over_ground / 0.1) / math.log(10.0 / 0.1)
    assert np.linalg.norm(block.wind_n, axis=1) == pytest.approx(wind, abs=1e-3)


@pytest.mark.ci
def test_a_wind_asked_for_comes_under_what_is_drawn() -> None:
    calm, blow = flight({**ALWAYS, "walk_mps_per_sqrt_s": 0.05}), flight({**ALWAYS, "walk_mps_per_sqrt_s": 0.05})
    blow.blow(90.0, 10.0)
    without, asked = calm.advance(12_000).wind_n[-1], blow.advance(12_000).wind_n[-1]
    np.testing.assert_allclose(asked - without, [*(np.array(blowing(90, 10)) - blowing(250, 6)), 0.0], atol=1e-3)
