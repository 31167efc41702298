"""Flights: tracking, truth columns, determinism, wind, turbulence, the ends of a flight."""

from __future__ import annotations

import hashlib
import math
import subprocess
import sys
import threading
from dataclasses import fields
from pathlib import Path
from typing import Any

import jsbsim
import numpy as np
import pymap3d
import pytest
from pydantic import TypeAdapter
from scipy.spatial.transform import Rotation

import testbed
from nav import earth, strapdown
from testbed.data import data_dir
from testbed.motion import aircraft
from testbed.motion.flight import Flight
from testbed.motion.guidance import plan_mistakes
from testbed.motion.legs import Leg
from testbed.motion.model import LOGGER, Aircraft
from testbed.motion.paths import Feedback
from testbed.motion.sections import FlightTruth
from testbed.motion.table import COLUMNS, TruthBlock

PLAN = TypeAdapter(list[Leg])
START = {"lat_deg": 34.0, "lon_deg": 108.0, "alt_m": 800.0, "heading_deg": 30.0, "airspeed_mps": 25.0}
LOITER = {"leg": "loiter", "radius_m": 400, "duration_s": 120}
MANOEUVRES = [
    {"leg": "straight", "length_m": 800},
    {"leg": "climb", "to_m": 860, "rate_mps": 2},
    {"leg": "turn", "to_deg": 150},
    {"leg": "figure_eight", "radius_m": 200, "turns": 1},
    {"leg": "u_turn"},
    {"leg": "loiter", "radius_m": 200, "turns": 2, "airspeed_mps": 27},
    {"leg": "racetrack", "radius_m": 200, "length_m": 400, "duration_s": 4000},
]
GUSTY = {"from_deg": 250.0, "speed_mps": 8.0, "turbulence": "moderate"}


def flight(
    plan: list[dict[str, Any]], seed: int = 1, rate_hz: float = 200.0, wind: Any = None, **start: float
) -> Flight:
    truth = FlightTruth(source="flight", rate_hz=rate_hz, start={**START, **start}, wind=wind or {})
    legs = PLAN.validate_python(plan)
    assert not plan_mistakes(legs, truth.start, aircraft.load("loiter"), truth.wind.speed_mps)
    return Flight(truth, legs, seed)


def join(blocks: list[TruthBlock]) -> TruthBlock:
    columns = {name: np.concatenate([getattr(block, name) for block in blocks]) for name in COLUMNS}
    return TruthBlock(blocks[0].tick, **columns)


def fly(source: Flight, seconds: float = math.inf, chunk: int = 20_000) -> TruthBlock:
    """All rows, or those of the first ``seconds``."""
    blocks, left = [], seconds * source.rate_hz
    while left > 0:
        block = source.advance(int(min(chunk, left)))
        blocks.append(block)
        left -= len(block)
        if len(block) < chunk:
            break
    return join(blocks)


def bits(block: TruthBlock) -> str:
    return hashlib.sha256(
        b"".join(getattr(block, f.name).tobytes() for f in fields(block) if f.name != "tick")
    ).hexdigest()


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def radii(block: TruthBlock, lat_deg: float, lon_deg: float) -> np.ndarray:
    """Horizontal distance from a place, at the aircraft's height."""
    n, e, _ = pymap3d.geodetic2ned(np.degrees(block.lat), np.degrees(block.lon), block.h, lat_deg, lon_deg, block.h)
    return np.hypot(n, e)


def about(centre: tuple[float, float], radius: float, **more: Any) -> dict[str, Any]:
    place = {"lat_deg": centre[0], "lon_deg": centre[1]}
    return {"leg": "loiter", "radius_m": radius, "centre": place, **more}


# --- tracking


@pytest.mark.ci
@pytest.mark.parametrize(("airspeed", "radius"), [(21.0, 150.0), (25.0, 120.0), (25.0, 400.0), (33.0, 400.0)])
def test_loiter_in_calm_air(airspeed: float, radius: float) -> None:
    block = fly(flight([about((34.0, 108.0), radius, duration_s=240)], airspeed_mps=airspeed))
    settled = block.t > 90
    assert rms(block.h[settled] - 800) < 2.0
    assert rms(block.airspeed[settled] - airspeed) < 0.7
    assert rms(radii(block, 34.0, 108.0)[settled] - radius) < 0.02 * radius


@pytest.mark.ci
def test_a_plan_of_every_kind_in_calm_air() -> None:
    plan = [
        {"leg": "straight", "length_m": 500},
        {"leg": "s_turns", "radius_m": 250, "turns": 2},
        {"leg": "turn", "by_deg": -135},
        {"leg": "climb", "to_m": 850},
        {"leg": "airspeed", "to_mps": 28},
        {"leg": "descend", "to_m": 830, "rate_mps": 1.5},
        {"leg": "u_turn", "direction": "right"},
        {"leg": "racetrack", "length_m": 300, "radius_m": 200, "laps": 1},
        {"leg": "figure_eight", "radius_m": 200, "turns": 1},
        {"leg": "loiter", "radius_m": 250, "turns": 1},
    ]
    source = flight(plan)
    block = fly(source, 2000.0)
    assert source.failure == ""
    assert source.activity() == "plan flown"
    assert sorted(set(block.leg)) == list(range(len(plan)))
    assert np.all(np.diff(block.leg) >= 0)
    assert rms(block.h - block.commands[:, 1]) < 2.0
    assert rms(block.airspeed - block.commands[:, 2]) < 0.7
    assert np.abs(block.controls[:, :3]).max() < 0.95


@pytest.mark.ci
@pytest.mark.parametrize(
    ("lat", "lon", "heading"),
    [(0.0, 0.0, 0.0), (-34.0, 179.999, 90.0), (-34.0, -179.999, 270.0), (84.0, 12.0, 200.0), (-84.0, -120.0, 359.0)],
)
def test_anywhere_at_any_heading(lat: float, lon: float, heading: float) -> None:
    source = flight(
        [{"leg": "straight", "length_m": 1000}, {"leg": "loiter", "radius_m": 200, "turns": 2}],
        lat_deg=lat,
        lon_deg=lon,
        heading_deg=heading,
        wind={"from_deg": 120.0, "speed_mps": 5.0},
    )
    block = fly(source)
    assert source.failure == ""
    assert rms(block.h - 800) < 1.0
    assert np.all(np.abs(block.lon) <= math.pi)
    n, e, _ = pymap3d.geodetic2ned(np.degrees(block.lat), np.degrees(block.lon), block.h, lat, lon, 800.0)
    straight = block.leg == 0
    course = math.atan2(block.v_n[0, 1], block.v_n[0, 0])
    assert np.abs(e * math.cos(course) - n * math.sin(course))[straight].max() < 1.0
    # Two turns of one circle: its diameter is the same whichever way it is measured.
    ring = block.leg == 1
    centre_n, centre_e = (n[ring].max() + n[ring].min()) / 2, (e[ring].max() + e[ring].min()) / 2
    assert np.abs(np.hypot(n[ring] - centre_n, e[ring] - centre_e) - 200).max() < 8.0


def test_starts_trimmed_in_the_wind() -> None:
    block = fly(flight([LOITER | {"radius_m": 5000}], heading_deg=77.0, wind={"from_deg": 0.0, "speed_mps": 8.0}), 5.0)
    q = np.roll(block.q_nb[0], -1)
    assert Rotation.from_quat(q).as_euler("ZYX", degrees=True)[0] == pytest.approx(77.0, abs=1e-6)
    assert block.wind_n[0] == pytest.approx([-8.0, 0.0, 0.0], abs=1e-9)
    assert np.degrees([block.lat[0], block.lon[0]]) == pytest.approx([34.0, 108.0], abs=1e-12)
    assert block.h[0] == pytest.approx(800.0, abs=1e-3)
    assert np.abs(block.airspeed - 25.0).max() < 0.1
    assert np.abs(block.omega_b[:200]).max() < 0.05
    assert block.fuel[0] == pytest.approx(5.0, abs=1e-3)


@pytest.mark.slow
def test_an_hour_of_wind_and_moderate_turbulence() -> None:
    """8 m/s of wind, MIL-F-8785C moderate turbulence of the low-altitude model, a 400 m loiter."""
    source = flight(
        [about((34.0, 108.0), 400.0, duration_s=3600)],
        alt_m=280.0,
        lat_deg=34.0 - 0.0036,
        heading_deg=270.0,
        wind=GUSTY,
    )
    block = fly(source)
    assert source.failure == ""
    assert block.t[-1] == pytest.approx(3600, abs=0.1)
    settled = block.t > 60
    assert rms(block.h[settled] - 280) < 8.0
    assert rms(radii(block, 34.0, 108.0)[settled] - 400) < 12.0
    assert np.abs(block.controls[settled, :3]).max() < 1.0
    assert np.mean(block.controls[settled, 3] >= 1.0) < 0.01
    assert block.wind_n[:, 2].std() == pytest.approx(0.1 * 50.6 * 0.3048, rel=0.15)  # sigma_w = 0.1 W20


# --- truth columns


@pytest.mark.ci
def test_columns_are_consistent_with_each_other() -> None:
    block = fly(flight(MANOEUVRES, wind=GUSTY), 120.0)
    attitude = Rotation.from_quat(np.roll(block.q_nb, -1, axis=1))
    air_b = attitude.inv().apply(block.v_n - block.wind_n)
    assert block.airspeed == pytest.approx(np.linalg.norm(air_b, axis=1), rel=1e-12)
    assert block.alpha == pytest.approx(np.arctan2(air_b[:, 2], air_b[:, 0]), abs=1e-12)
    assert block.beta == pytest.approx(np.arcsin(air_b[:, 1] / block.airspeed), abs=1e-12)
    assert block.t == pytest.approx(np.arange(len(block)) / 200, abs=1e-12)
    assert block.pressure == pytest.approx(earth.isa_pressure(block.h), rel=1e-4)
    assert block.temperature == pytest.approx(earth.isa_temperature(block.h), rel=1e-4)
    assert block.density == pytest.approx(earth.isa_density(block.h), rel=1e-4)
    # The rate column is the rate whose integral the increments are.
    middle = (block.omega_b[1:] + block.omega_b[:-1]) / 2
    assert rms(block.dtheta[1:] * 200 - middle) < 1e-3
    assert np.all(np.diff(block.fuel) <= 0)
    assert 0.005 < block.fuel[0] - block.fuel[-1] < 0.02
    assert 3500 < block.engine_rpm.min() < block.engine_rpm.max() < 8000
    assert 1.5 < block.current.min() < block.current.max() < 3.2
    assert np.abs(block.controls).max() <= 1.0 + 1e-12


def test_jsbsim_agrees_on_the_air() -> None:
    source = flight(MANOEUVRES, wind=GUSTY)
    for _ in range(5):
        block = source.advance(777)
        fdm = source._aircraft.fdm
        assert block.alpha[-1] == pytest.approx(fdm["aero/alpha-rad"], abs=1e-9)
        assert block.beta[-1] == pytest.approx(fdm["aero/beta-rad"], abs=1e-9)
        assert block.airspeed[-1] == pytest.approx(fdm["velocities/vt-fps"] * 0.3048, rel=1e-9)
        assert block.density[-1] == pytest.approx(fdm["atmosphere/rho-slugs_ft3"] * 515.378818, rel=1e-4)


def strapdown_error(block: TruthBlock, every: int) -> tuple[np.ndarray, float]:
    """Largest horizontal position error [m] and attitude error [rad] of a strapdown on error-free increments."""
    q, v = block.q_nb[0].copy(), block.v_n[0].copy()
    lla = np.array([block.lat[0], block.lon[0], block.h[0]])
    horizontal, tilt = 0.0, 0.0
    for k in range(1, len(block)):
        strapdown.step(q, v, lla, block.dtheta[k], block.dv[k], 1 / 200)
        if k % every == 0:
            offset = earth.position_difference_n(*lla, block.lat[k], block.lon[k], block.h[k])
            horizontal = max(horizontal, float(np.hypot(offset[0], offset[1])))
            pair = Rotation.from_quat(np.roll([q, block.q_nb[k]], -1, axis=1))
            tilt = max(tilt, float((pair[0] * pair[1].inv()).magnitude()))
    return horizontal, tilt


@pytest.mark.ci
def test_strapdown_of_the_increments_follows_jsbsim_for_ten_minutes() -> None:
    horizontal, tilt = strapdown_error(fly(flight(MANOEUVRES, wind=GUSTY), 600.0), 1000)
    assert horizontal < 0.1
    assert tilt < 1e-5


@pytest.mark.slow
def test_strapdown_of_the_increments_follows_jsbsim_for_an_hour() -> None:
    horizontal, _ = strapdown_error(fly(flight(MANOEUVRES, wind=GUSTY), 3600.0), 10_000)
    assert horizontal < 1.0


# --- determinism


@pytest.mark.parametrize("rate_hz", [200.0, pytest.param(130.0, marks=pytest.mark.ci)])
def test_the_same_bits_however_it_is_advanced(rate_hz: float) -> None:
    whole = fly(flight(MANOEUVRES, 5, rate_hz, GUSTY), 40.0)
    for chunks in ([1], [7, 1, 333], [1000]):
        source = flight(MANOEUVRES, 5, rate_hz, GUSTY)
        blocks, rows = [], 0
        while rows < len(whole):
            block = source.advance(min(chunks[len(blocks) % len(chunks)], len(whole) - rows))
            assert block.tick == rows
            blocks.append(block)
            rows += len(block)
        assert bits(join(blocks)) == bits(whole)


@pytest.mark.ci
def test_seeds_make_the_turbulence_and_flights_do_not_share_it() -> None:
    first, second, other = (flight(MANOEUVRES, seed, wind=GUSTY) for seed in (3, 3, 4))
    mixed = [(first.advance(100), second.advance(100), other.advance(100)) for _ in range(10)]
    blocks = [join(list(column)) for column in zip(*mixed, strict=True)]
    assert bits(blocks[0]) == bits(blocks[1])
    assert rms(blocks[0].wind_n - blocks[2].wind_n) > 0.5


@pytest.mark.ci
def test_turbulence_of_its_own_seed() -> None:
    wind = {**GUSTY, "turbulence_seed": 3}
    fixed, same, own = (flight(MANOEUVRES, seed, wind=w).advance(200) for seed, w in ((1, wind), (2, wind), (3, GUSTY)))
    assert bits(fixed) == bits(same) == bits(own)


@pytest.mark.ci
def test_the_same_bits_in_another_process() -> None:
    here = bits(fly(flight(MANOEUVRES, 9, wind=GUSTY), 10.0))
    program = (
        "import sys; sys.path[:0] = sys.argv[1:]; import test_flight as t; "
        "print(t.bits(t.fly(t.flight(t.MANOEUVRES, 9, wind=t.GUSTY), 10.0)))"
    )
    folder = __file__.rpartition("/")[0]
    printed = subprocess.run([sys.executable, "-c", program, folder], capture_output=True, text=True, check=True)
    assert printed.stdout.strip() == here  # and nothing else: JSBSim keeps its banners to itself
    assert printed.stderr == ""


def test_nothing_is_printed(capfd: pytest.CaptureFixture[str]) -> None:
    flight([LOITER], wind=GUSTY).advance(400)
    assert capfd.readouterr() == ("", "")


# --- wind


@pytest.mark.ci
def test_wind_from_a_profile() -> None:
    profile = [[700.0, 0.0, 2.0], [900.0, 90.0, 6.0]]
    plan = [{"leg": "climb", "to_m": 950}]
    block = fly(flight(plan, alt_m=650.0, wind={"profile": profile}))
    expected = np.column_stack(
        [np.interp(block.h, [700, 900], [-2.0, 0.0]), np.interp(block.h, [700, 900], [0.0, -6.0])]
    )
    assert np.abs(block.wind_n[:, :2] - expected).max() < 0.01
    assert rms(block.airspeed - 25) < 0.7


@pytest.mark.slow
@pytest.mark.parametrize(("level", "at_20ft"), [("light", 25.3), ("moderate", 50.6)])
def test_turbulence_has_the_spread_of_its_level(level: str, at_20ft: float) -> None:
    """Below 1000 ft: sigma_w = 0.1 W20, sigma_u = sigma_w / (0.177 + 0.000823 h)^0.4 (MIL-F-8785C, 3.7.2.2)."""
    wind = {"turbulence": level}
    block = join([fly(flight([LOITER | {"duration_s": 900}], seed, wind=wind, alt_m=150.0)) for seed in range(4)])
    sigma_w = 0.1 * at_20ft * 0.3048
    sigma_u = sigma_w / (0.177 + 0.000823 * 150 / 0.3048) ** 0.4
    assert rms(block.wind_n[:, 2]) == pytest.approx(sigma_w, rel=0.15)
    assert rms(block.wind_n[:, :2]) == pytest.approx(sigma_u, rel=0.2)


# --- feedback


@pytest.mark.ci
def test_loops_closed_on_fed_back_truth_fly_as_on_truth_itself() -> None:
    plan = [{"leg": "loiter", "radius_m": 300, "duration_s": 60}]
    alone, fed = flight(plan), flight(plan)
    expected = fly(alone)
    blocks = [fed.advance(1)]
    while len(blocks[-1]):
        row = blocks[-1]
        heading, pitch, roll = Rotation.from_quat(np.roll(row.q_nb[0], -1)).as_euler("ZYX")
        fed.feed_back(
            Feedback(
                row.lat[0], row.lon[0], row.h[0], *row.v_n[0], roll, pitch, heading, *row.omega_b[0], row.airspeed[0]
            )
        )
        blocks.append(fed.advance(1))
    block = join(blocks)
    assert len(block) == len(expected)
    n, e, d = pymap3d.geodetic2ned(block.lat, block.lon, block.h, expected.lat, expected.lon, expected.h, deg=False)
    assert np.max(np.sqrt(n**2 + e**2 + d**2)) < 0.5


def test_loops_follow_what_is_fed_back() -> None:
    source = flight([{"leg": "straight", "length_m": 3000}])
    block = source.advance(1)
    for _ in range(400):
        # Somebody who believes that the aircraft banks 10 deg to the right gets a left bank of 10 deg.
        q = Rotation.from_quat(np.roll(block.q_nb[-1], -1))
        heading, pitch, roll = q.as_euler("ZYX")
        state = Feedback(
            block.lat[-1],
            block.lon[-1],
            block.h[-1],
            *block.v_n[-1],
            roll + 0.17,
            pitch,
            heading,
            *block.omega_b[-1],
            25.0,
        )
        source.feed_back(state)
        block = source.advance(1)
    roll = Rotation.from_quat(np.roll(block.q_nb[-1], -1)).as_euler("ZYX")[2]
    assert roll - block.commands[-1, 0] == pytest.approx(-0.17, abs=0.05)


# --- the end


def test_the_flight_ends_with_its_plan() -> None:
    source = flight([{"leg": "straight", "length_m": 250}])
    block = source.advance(5000)
    assert len(block) == pytest.approx(2000, abs=30)
    assert len(source.advance(10)) == 0
    assert source.failure == ""
    assert source.activity() == "plan flown"


@pytest.mark.parametrize(
    ("sabotage", "said"),
    [
        ({"ap/engaged": 0.0, "fcs/elevator-cmd-norm": 1.0}, "pitch"),
        ({"ap/engaged": 0.0, "fcs/aileron-cmd-norm": 0.5}, "bank"),
        ({"propulsion/tank/contents-lbs": 0.0}, "hit the ground"),
    ],
)
def test_loss_of_control_ends_the_flight_and_says_so(sabotage: dict[str, float], said: str) -> None:
    source = flight([LOITER | {"duration_s": 3000}], alt_m=200.0)
    source.advance(1000)
    for name, value in sabotage.items():
        source._aircraft.fdm[name] = value
    block = fly(source, 1500.0)
    assert len(block) < 1500 * 200
    assert said in source.failure
    assert source.activity() == source.failure
    assert len(source.advance(100)) == 0


def test_every_column_is_finite() -> None:
    block = fly(flight([LOITER], wind=GUSTY), 20.0)
    for name in COLUMNS:
        assert np.isfinite(getattr(block, name)).all(), name


def test_specific_force_is_not_taken_from_the_simulator() -> None:
    """Increments come from the motion itself; JSBSim's accelerometer properties sit at another point and time."""
    sources = [*Path(testbed.__file__).parent.rglob("*.py"), *data_dir("aircraft").rglob("*.xml")]
    assert len(sources) > 20
    assert not [path.name for path in sources if "a-pilot" in path.read_text(encoding="utf-8")]


def test_a_thread_that_ends_is_never_the_last_to_hold_its_logger() -> None:
    """JSBSim drops a thread's logger without Python's lock: freeing it there crashes the process now and then."""
    held: list[object] = []

    def fly() -> None:
        Aircraft("loiter", 200.0)
        held.append(jsbsim.get_logger() is LOGGER)

    thread = threading.Thread(target=fly)
    thread.start()
    thread.join()
    assert held == [True]
