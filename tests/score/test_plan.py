"""A leg that the wind keeps from its end is told, and one that the end of the run cuts is not."""

from __future__ import annotations

import pytest

from testbed import Scenario
from testbed.motion.flight import Flight
from testbed.motion.sections import FlightTruth
from testbed.record.recorder import Recorder
from testbed.score.plan import not_as_planned


def told(wind_mps: float, duration_s: float, *legs: str) -> list[str]:
    """What is said of a flight of u_turn's aircraft against the wind, of motion alone."""
    changes = [f"truth.wind={{from_deg=90, speed_mps={wind_mps}}}", f"duration_s={duration_s}"]
    scenario = Scenario.load("u_turn", [*changes, f"plan=[{', '.join(legs)}]"])
    assert isinstance(scenario.truth, FlightTruth)
    recorder = Recorder(None, scenario, 1)
    recorder.truth(Flight(scenario.truth, scenario.plan, 1).advance(round(duration_s * scenario.truth.rate_hz) + 1))
    recorder.close()
    return not_as_planned(recorder.dataset())


STRAIGHT, TO = "{leg='straight', length_m=%g}", "{leg='straight', to={lat_deg=47.0, lon_deg=%g}}"
LOITER = "{leg='loiter', radius_m=460, %s}"


@pytest.mark.ci
@pytest.mark.parametrize(
    ("wind_mps", "legs", "said"),
    [
        (30.0, [TO % 8.04], "straight was begun and not flown to its end: it was 3.04 km away at first, and "),
        (30.0, [LOITER % "duration_s=4000, centre={lat_deg=47, lon_deg=8.04}"], "loiter was begun and not flown"),
        (14.0, [STRAIGHT % 700], "straight was begun and not flown to its end: after 61 s, where still air"),
        (14.0, [TO % 8.0092], "straight was begun and not flown to its end: after 61 s, where still air"),
    ],
)
def test_a_leg_that_should_have_been_over_is_told(wind_mps: float, legs: list[str], said: str) -> None:
    (remark,) = told(wind_mps, 61.0, *legs)
    assert remark.startswith(f"leg 1/1 {said}")


@pytest.mark.ci
@pytest.mark.parametrize("leg", [STRAIGHT % 700, "{leg='climb', to_m=430}"])
def test_a_leg_that_wind_turned_round_is_told(leg: str) -> None:
    """It keeps the course over ground, and so flew away from where it was to go, to its end."""
    remarks = told(30.0, 61.0, leg, "{leg='turn', to_deg=270}")
    assert any(one.startswith(f"leg 1/2 {leg[6:].split(chr(39))[0]} went the other way: ") for one in remarks)
    assert any("the wind (30 m/s) is faster than the aircraft (25 m/s)" in one for one in remarks)
    assert not any("went the other way" in one for one in told(20.0, 61.0, leg, "{leg='turn', to_deg=270}"))


@pytest.mark.ci
def test_a_long_leg_against_ordinary_wind_is_not_late() -> None:
    assert told(8.0, 278.0, STRAIGHT % 5000) == []  # over after 294 s


@pytest.mark.ci
@pytest.mark.parametrize(
    ("wind_mps", "legs"),
    [
        (0.0, [STRAIGHT % 1600]),  # the run ends 3 s before the leg
        (8.0, [STRAIGHT % 1100]),  # ordinary wind
        (8.0, [TO % 7.97]),  # after a turn
        (8.0, [LOITER % "duration_s=4000"]),
        (8.0, [LOITER % "turns=1"]),
        (8.0, [STRAIGHT % 500, "{leg='u_turn'}", STRAIGHT % 3000]),
        (8.0, ["{leg='climb', to_m=430}"]),
        (30.0, ["{leg='turn', to_deg=270}"]),  # flown, and the plan with it
    ],
)
def test_a_leg_that_the_end_of_the_run_cuts_is_not(wind_mps: float, legs: list[str]) -> None:
    assert told(wind_mps, 61.0, *legs) == []
