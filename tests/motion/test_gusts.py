"""Strength of gusts: MIL-F-8785C as tabulated, and as JSBSim really makes them."""

from __future__ import annotations

from array import array

import numpy as np
import pytest
from pydantic import TypeAdapter

from testbed.motion.flight import Flight
from testbed.motion.gusts import UNKNOWN_AIR, expected_gust, gust_sigma
from testbed.motion.legs import Leg
from testbed.motion.model import Aircraft
from testbed.motion.sections import FlightTruth

FOOT, KNOT = 0.3048, 1852 / 3600
PLAN = TypeAdapter(list[Leg])


def truth(level: str, alt: float) -> FlightTruth:
    start = {"lat_deg": 34.0, "lon_deg": 108.0, "alt_m": alt, "heading_deg": 30.0, "airspeed_mps": 27.0}
    return FlightTruth(source="flight", start=start, wind={"turbulence": level})  # type: ignore[arg-type]


@pytest.mark.parametrize(("level", "knots"), [("light", 15), ("moderate", 30), ("severe", 45)])
def test_low_altitude_against_figure_10(level: str, knots: float) -> None:
    """At 1000 ft a tenth of the wind at 20 ft; at 20 ft twice that, as the figure of sigma_u / sigma_w has it."""
    assert gust_sigma(level, 1000 * FOOT) == pytest.approx(0.1 * knots * KNOT, rel=0.01)
    assert gust_sigma(level, 20 * FOOT) == pytest.approx(0.1 * knots * KNOT * 1.93, rel=0.02)
    assert gust_sigma(level, 0.0) == gust_sigma(level, 10 * FOOT)


@pytest.mark.parametrize(
    ("level", "altitude_ft", "feet"),
    [("light", 3750, 7.4), ("light", 7500, 6.7), ("moderate", 3750, 10.6), ("severe", 15_000, 22.1)],
)
def test_high_altitude_against_figure_7(level: str, altitude_ft: float, feet: float) -> None:
    assert gust_sigma(level, altitude_ft * FOOT) == pytest.approx(feet * FOOT)


def test_strength_has_no_jump() -> None:
    altitudes = np.arange(5.0, 4500.0, 0.5)
    for level in ("light", "moderate", "severe"):
        sigmas = np.array([gust_sigma(level, alt) for alt in altitudes])
        assert np.abs(np.diff(sigmas)).max() < 0.06


@pytest.mark.ci
@pytest.mark.parametrize(("level", "alt"), [("light", 250.0), ("light", 800.0), ("moderate", 450.0)])
def test_jsbsim_makes_gusts_of_this_strength(level: str, alt: float) -> None:
    """Both axes of ten minutes at 27 m/s: some sixty lengths of gusts each, so a fifth is within 3 sigma."""
    plan = PLAN.validate_python([{"leg": "loiter", "radius_m": 600, "duration_s": 600}])
    wind_n = Flight(truth(level, alt), plan, 1).advance(600 * 200).wind_n
    assert np.sqrt((wind_n[:, :2] ** 2).mean()) == pytest.approx(gust_sigma(level, alt), rel=0.2)


@pytest.mark.ci
def test_jsbsim_takes_the_altitude_for_the_height_over_ground() -> None:
    """Told of terrain 500 m high it makes the same gusts 300 m over it as 800 m over none; what filters are told."""
    flown = []
    for ground in (0.0, 500.0):
        aircraft = Aircraft("loiter", 200.0)
        aircraft.fdm["position/terrain-elevation-asl-ft"] = ground / FOOT
        aircraft.start(truth("light", 800.0).start)
        aircraft.turbulence("light", 1)
        rows = array("d")
        aircraft.run(2000, rows)
        assert FOOT * aircraft.fdm["position/h-agl-ft"] == pytest.approx(800.0 - ground, abs=10.0)
        flown.append(rows)
    assert flown[0] == flown[1]


def test_a_filter_expects_the_strongest_that_the_plan_meets() -> None:
    plan = PLAN.validate_python([{"leg": "climb", "to_m": 800}, {"leg": "straight", "length_m": 500, "alt_m": 700}])
    assert expected_gust(truth("light", 250.0), plan) == gust_sigma("light", 800.0)
    assert gust_sigma("light", 800.0) == pytest.approx(2.17, abs=0.01)
    assert expected_gust(truth("light", 250.0), plan[1:]) < gust_sigma("light", 800.0)
    assert expected_gust(truth("none", 250.0), plan) == UNKNOWN_AIR
