"""Flights from rest: still on the launcher, off it, and up to where the plan begins."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from nav import earth
from nav.rotation import euler_from_quat, quat_rotate
from testbed import Scenario
from testbed.errors import UserError
from testbed.motion import aircraft
from testbed.motion.flight import Flight
from testbed.motion.legs import Leg
from testbed.motion.sections import FlightTruth
from testbed.motion.table import CLIMBING_OUT, COLUMNS, ON_GROUND, TruthBlock

REST_S, RATE_HZ, GROUND_M, HEADING = 4.0, 200.0, 430.0, 60.0
PLAN = [{"leg": "climb", "to_m": 480}, {"leg": "straight", "length_m": 9000}]


def flight(name: str, rest_s: float = REST_S, terrain: Any = None, **wind: Any) -> Flight:
    start = {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": GROUND_M, "heading_deg": HEADING, "rest_s": rest_s}
    truth = FlightTruth(
        source="flight", aircraft=name, rate_hz=RATE_HZ, start={**start, "on_ground": True}, wind=wind,
        terrain=terrain or {"height_m": GROUND_M},
    )  # fmt: skip
    return Flight(truth, TypeAdapter(list[Leg]).validate_python(PLAN), 92110001)


def flown(source: Flight, seconds: float, chunks: tuple[int, ...] = (20_000,)) -> TruthBlock:
    blocks, left = [], round(seconds * RATE_HZ) + 1
    while left > 0:
        blocks.append(source.advance(min(left, chunks[len(blocks) % len(chunks)])))
        left -= len(blocks[-1])
    return TruthBlock(0, **{name: np.concatenate([getattr(block, name) for block in blocks]) for name in COLUMNS})


@pytest.fixture(scope="module", params=["loiter", "flying_wing"])
def taken_off(request: pytest.FixtureRequest) -> tuple[aircraft.Envelope, TruthBlock]:
    source = flight(request.param, from_deg=HEADING + 30, speed_mps=4, turbulence="light")
    block = flown(source, 30.0)
    assert source.failure == ""
    return aircraft.load(request.param), block


def test_at_rest_nothing_moves(taken_off: tuple[aircraft.Envelope, TruthBlock]) -> None:
    envelope, truth = taken_off
    assert envelope.launch is not None
    still = truth.rows(0, round((REST_S - 0.5) * RATE_HZ))
    assert (still.leg == ON_GROUND).all()
    assert still.h == pytest.approx(GROUND_M + envelope.launch.height_m, abs=1e-6)
    for moved in (still.lat - still.lat[0], still.lon - still.lon[0]):
        assert np.abs(moved).max() * 6.4e6 < 1e-6
    assert np.abs(still.v_n).max() < 1e-9
    assert np.abs(still.q_nb - still.q_nb[0]).max() < 1e-12
    angles = np.degrees(euler_from_quat(still.q_nb[0]))
    assert angles == pytest.approx([0.0, envelope.launch.pitch_deg, HEADING], abs=1e-9)
    # What sensors feel: gravity from below, and the Earth's rate.
    g, earth_n = float(earth.gravity(still.lat[0], still.h[0])), earth.earth_rate_n(still.lat[0])
    for k in (1, 100, len(still) - 1):
        assert quat_rotate(still.q_nb[k], still.dv[k] * RATE_HZ) == pytest.approx([0.0, 0.0, -g], abs=1e-7)
        assert quat_rotate(still.q_nb[k], still.dtheta[k] * RATE_HZ) == pytest.approx(earth_n, abs=1e-11)


def test_the_launcher_pushes_evenly_along_the_nose(taken_off: tuple[aircraft.Envelope, TruthBlock]) -> None:
    envelope, truth = taken_off
    assert envelope.launch is not None
    launch, on = envelope.launch, truth.leg == ON_GROUND
    last = int(np.flatnonzero(on)[-1])
    assert np.linalg.norm(truth.v_n[last]) == pytest.approx(launch.speed_mps, abs=1e-6)
    pushed = np.flatnonzero(on & (np.linalg.norm(truth.v_n, axis=1) > 1e-6))
    acceleration = launch.speed_mps / len(pushed) * RATE_HZ
    pitch = math.radians(launch.pitch_deg)
    g = float(earth.gravity(truth.lat[0], truth.h[0]))
    expected = [acceleration + g * math.sin(pitch), 0.0, -g * math.cos(pitch)]
    assert truth.dv[pushed] * RATE_HZ == pytest.approx(np.tile(expected, (len(pushed), 1)), abs=0.01)
    rise = truth.h[last] - truth.h[0]
    assert rise == pytest.approx(launch.length_m * math.sin(pitch), rel=0.02)


def test_it_climbs_away_without_stalling_or_touching(taken_off: tuple[aircraft.Envelope, TruthBlock]) -> None:
    envelope, truth = taken_off
    free = truth.leg != ON_GROUND
    order = truth.leg[np.flatnonzero(np.diff(truth.leg, prepend=np.nan))]
    assert order[:3].tolist() == [ON_GROUND, CLIMBING_OUT, 0.0]
    eas = truth.airspeed * np.sqrt(truth.density / earth.SEA_LEVEL_DENSITY)
    assert (eas[free] > envelope.airspeed.stall_mps).all()
    assert (truth.h[free] > GROUND_M + 1.5).all()
    angles = np.degrees([euler_from_quat(q) for q in truth.q_nb[free][::20]])
    assert np.abs(angles[:, 0]).max() < 15
    assert np.abs(np.mod(angles[:, 2] - HEADING + 180, 360) - 180).max() < 25
    begun = np.flatnonzero(truth.leg == 0.0)[0]
    assert truth.h[begun] == pytest.approx(GROUND_M + envelope.altitude.floor_m, abs=6)
    assert truth.h[-1] > truth.h[begun]


@pytest.mark.parametrize(("hill_m", "hit"), [(600.0, True), (GROUND_M, False)])
def test_off_the_runway_the_ground_is_the_maps(hill_m: float, hit: bool, tmp_path: Path) -> None:
    """The runway is told to a metre: here the map has it half a metre higher."""
    ahead = 0.01 * np.arange(5)
    height = np.where(ahead < 0.02, GROUND_M + 0.5, hill_m)[:, None] + np.zeros(5)
    np.savez(tmp_path / "hill.npz", lat_deg=46.99 + ahead, lon_deg=7.99 + ahead, height_m=height)
    source = flight("flying_wing", terrain={"file": str(tmp_path / "hill.npz")})
    truth = source.advance(round(90.0 * RATE_HZ))
    assert source.failure == ("the aircraft hit the ground" if hit else "")
    assert hit == (len(truth) < 90.0 * RATE_HZ)


def test_same_bits_however_it_is_advanced() -> None:
    rows = [
        flown(flight("flying_wing", 3.0, turbulence="light"), 8.0, chunks)
        for chunks in ((20_000,), (1, 333, 20, 7, 61))
    ]
    for name in COLUMNS:
        assert getattr(rows[0], name).tobytes() == getattr(rows[1], name).tobytes(), name


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"airspeed_mps": 25}, "on_ground is a start at rest: leave airspeed_mps out"),
        ({"on_ground": False}, "airspeed_mps is missing or 0: give the speed to begin with, or set on_ground"),
        ({"on_ground": False, "airspeed_mps": 25, "rest_s": 9}, "rest_s is of a start at rest: set on_ground = true"),
    ],
)
def test_a_start_is_at_rest_or_in_the_air(changes: dict[str, Any], message: str) -> None:
    start = {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 300, "heading_deg": 0, "on_ground": True, **changes}
    with pytest.raises(ValidationError, match=message):
        FlightTruth(source="flight", start=start)


@pytest.mark.parametrize(
    ("scenario", "changes", "message"),
    [
        ("take_off", {"truth.start.alt_m": 320}, r"truth\.start\.alt_m: .*300\.0 m by truth\.terrain\.height_m, not"),
        ("take_off", {"truth.start.airspeed_mps": 25}, r"truth\.start: on_ground is a start at rest: leave"),
        ("take_off", {"plan[0].to_m": 320}, r"plan\[0\]\.to_m: .* the ground is at 300 m .* from 330 to 4500"),
        ("static_bench", {"truth.start.on_ground": True}, r"truth\.start\.on_ground: unknown key"),
        ("u_turn", {"truth.start.on_ground": True}, r"truth\.start: on_ground is a start at rest: leave"),
    ],
)  # fmt: skip
def test_what_contradicts_a_start_on_the_ground_is_said(scenario: str, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        Scenario.load(scenario, changes)


def test_an_aircraft_without_a_launcher_can_not_begin_on_the_ground(tmp_path: Any) -> None:
    home = tmp_path / "loiter"
    home.mkdir()
    shipped = aircraft.folder("loiter")
    (home / "loiter.xml").write_text((shipped / "loiter.xml").read_text())
    (home / "envelope.toml").write_text((shipped / "envelope.toml").read_text().partition("[launch]")[0])
    with pytest.raises(UserError, match=r"truth\.start\.on_ground: the aircraft .* has no \[launch\]"):
        Scenario.load("take_off", {"truth.aircraft": str(home)})
