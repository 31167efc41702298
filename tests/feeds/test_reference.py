"""What errors of a recorded flight are against, where that is its receiver: of its antenna, and of sound fixes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import pytest

from nav.samples import FixType, GnssSample
from testbed import Scenario, run
from testbed.feeds.reference import of_receiver, strays

ARM = [1.0, -0.4, 0.3]
FLIGHT = f"""
title = "A lever arm"
duration_s = 100
[truth]
source = "flight"
aircraft = "flying_wing"
start = {{ lat_deg = 47.0, lon_deg = 8.0, alt_m = 500, heading_deg = 30, airspeed_mps = 18 }}
[[plan]]
leg = "racetrack"
length_m = 300
radius_m = 80
direction = "left"
laps = 4
[sensors.imu]
grade = "mems-consumer"
rate_hz = 100
[sensors.gnss]
grade = "rtk"
rate_hz = 5
lever_arm_m = {ARM}
[sensors.barometer]
[sensors.magnetometer]
[[estimator]]
name = "ins"
aids = ["gnss", "barometer", "magnetometer"]
[record]
imu = true
"""


@pytest.mark.ci
def test_errors_against_a_receiver_are_of_its_antenna(tmp_path: Path) -> None:
    """Against the truth they are of centimetres, and so they are against a receiver of centimetres, a metre away."""
    flown = run(Scenario.parse(FLIGHT), out=tmp_path / "flown")
    log = {"source": "log", "file": str(tmp_path / "flown" / "run.nc"), "reference": "gnss"}
    text = FLIGHT.partition("[truth]")[0] + "[sensors.imu]" + FLIGHT.partition("[sensors.imu]")[2]
    found = run(Scenario.parse(text, {"truth": log}))
    for metric, most in (("position_horizontal_rms_m", 0.03), ("velocity_rms_mps", 0.1)):
        assert flown.metrics[f"ins.{metric}"] < most
        assert found.metrics[f"ins.{metric}"] < most


def fixes(north: Any, east: Any, step: float, *, velocities: bool = True) -> list[GnssSample]:
    """Fixes of a way over the ellipsoid, with the velocities of their central differences, or none."""
    lat, lon, h = pymap3d.ned2geodetic(np.asarray(north), np.asarray(east), -500.0 + 0 * np.asarray(north), 47, 8, 0)
    v_n = np.column_stack([np.gradient(north, step), np.gradient(east, step), 0 * np.asarray(north)])
    unknown = np.full(3, np.nan)
    return [
        GnssSample(
            step * k, step * k, np.radians(lat[k]), np.radians(lon[k]), h[k], v_n[k] if velocities else unknown,
            np.ones(3), np.ones(3), FixType.FIX_3D, 10, 1.0, 1.0,
        )
        for k in range(len(lat))
    ]  # fmt: skip


def circle(step: float) -> tuple[Any, Any]:
    """25 m/s round 60 m."""
    angle = 25.0 / 60.0 * step * np.arange(60)
    return 60.0 * np.cos(angle), 60.0 * np.sin(angle)


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize("at", [1, 30, 58])
def test_a_fix_far_from_both_its_neighbours_is_no_reference(at: int, velocities: bool) -> None:
    own = fixes(*circle(0.2), 0.2, velocities=velocities)
    north, east = circle(0.2)
    north[at] += 2000.0
    own[at] = fixes(north, east, 0.2, velocities=velocities)[at]
    assert np.flatnonzero(strays(own)).tolist() == [at]
    found = of_receiver(own, "gnss", np.zeros(3))
    assert len(found.t) == len(own) - 1
    assert "but for 1 far" in found.name


@pytest.mark.parametrize("at", [1, 30, 57])
@pytest.mark.parametrize("second", [2000.0, -700.0, 2500.0])
def test_two_side_by_side_are_no_reference(at: int, second: float) -> None:
    """Both stayed, where either alone was left out."""
    own = fixes(*circle(0.2), 0.2)
    north, east = circle(0.2)
    north[at], north[at + 1] = north[at] + 2000.0, north[at + 1] + second
    own[at : at + 2] = fixes(north, east, 0.2)[at : at + 2]
    assert np.flatnonzero(strays(own)).tolist() == [at, at + 1]


def test_there_and_back_from_a_hover_is_flown() -> None:
    """Without velocities nothing says that two fixes 15 m away, of a receiver of 1 Hz, are astray."""
    north = np.random.default_rng(1).normal(0.0, 0.3, 60)
    north[30:32] += 15.0
    assert not strays(fixes(north, 0 * north, 1.0, velocities=False)).any()


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize("step", [0.2, 1.0, 5.0, 7.5])
def test_no_fix_of_a_sound_flight_is_left_out(step: float, velocities: bool) -> None:
    """A quarter of a second to half a circle from one to the next."""
    assert not strays(fixes(*circle(step), step, velocities=velocities)).any()


def test_a_jump_that_stays_is_no_single_fix() -> None:
    north, east = circle(0.2)
    north[30:] += 2000.0
    assert not strays(fixes(north, east, 0.2)).any()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_fixes_are_all_there_is(count: int) -> None:
    assert not strays(fixes(*circle(1.0), 1.0)[:count]).any()
