"""What the table is of: weather, aids, grades of the IMU, times without GNSS. A line each is all that a new one takes.

Every case, one of each, is a scenario that `testbed run` flies too. `Case.text` is its file.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

from testbed.scenario import Scenario

EVERY_S = 10  # how often errors are kept from the loss of GNSS on
BEYOND_S = 1  # flown after the last time that is asked for
LONGEST_S = 1800
FRONT_S = 90  # after the loss


class Weather(NamedTuple):
    """A wind: ``wind`` are keys of ``truth.wind``. What it says of a walk filters are told.

    {front} stands for the time when it changes, for those in which it does.
    """

    name: str
    title: str
    wind: str


class Route(NamedTuple):
    """Where it is flown: keys of ``truth.start`` and ``truth.terrain``, and the plan. Aids of one share its motion."""

    start: str
    terrain: str
    plan: str


# Two straights, a turn, and in the rest of five minutes with GNSS the first of the circles.
PLAN = """\
[[plan]]
leg = "straight"
length_m = {straight_m}
[[plan]]
leg = "turn"
to_deg = 120
[[plan]]
leg = "straight"
length_m = 1500
[[plan]]
leg = "loiter"
radius_m = {radius_m}
duration_s = 4000
"""
CIRCLES = Route(
    "lat_deg = 34.0, lon_deg = 108.0, alt_m = 280, heading_deg = 30, airspeed_mps = 25",
    "height_m = 0",
    PLAN.format(straight_m=1500, radius_m=400),
)
HILLS = Route(
    "lat_deg = 36.58, lon_deg = -84.34, alt_m = 1050, heading_deg = 30, airspeed_mps = 25",
    'file = "jacksboro", map_error_m = 4',
    PLAN.format(straight_m=3000, radius_m=1500),
)


class Aids(NamedTuple):
    """What a filter has beside IMU, GNSS, barometer, magnetometer and airspeed: ``sensors`` are further tables.

    ``fault`` is what goes wrong, if anything does; {half} stands for the time half-way between the loss of GNSS and the
    {end}.
    """

    name: str
    title: str
    sensors: str = ""
    fault: str = ""
    route: Route = CIRCLES


class Grade(NamedTuple):
    """A grade of the IMU, by its name in ``[sensors.imu]``."""

    name: str
    grade: str


WEATHERS = (
    Weather("constant", "constant wind", "walk_mps_per_sqrt_s = 0.0"),
    Weather("walking", "walking wind, 0.02 m/s/√s", "walk_mps_per_sqrt_s = 0.02"),
    Weather(
        "front",
        "walking wind, and a front that nobody is told of",
        "walk_mps_per_sqrt_s = 0.02, front = {{ time_s = {front}, width_s = 60, from_deg = 310, speed_mps = 10 }}",
    ),
)
AIDINGS = (
    Aids("air_data", "air data"),
    Aids("flow", "flow and range", '[sensors.optical_flow]\ngrade = "camera"\n[sensors.rangefinder]\ngrade = "radar"'),
    Aids("terrain", "air data and height over hills", '[sensors.rangefinder]\ngrade = "radar"', route=HILLS),
    Aids("wind_report", "air data and wind reports", '[sensors.wind_report]\ngrade = "nearby"'),
    Aids(
        "pitot_failed",
        "air data, pitot silent from half-way on",
        fault='[[fault]]\nsensor = "airspeed"\nkind = "dropout"\nwindow = [{half}, {end}]',
    ),
)
# What goals are set for (`testbed.denied.goals`), by names.
JUDGED_WEATHER, JUDGED_GRADE, JUDGED_AIDS = "walking", "consumer", ("air_data", "flow", "terrain")
GRADES = (
    Grade("consumer", "mems-consumer"),
    Grade("industrial", "mems-industrial"),
    Grade("tactical", "tactical"),
)
SCENARIO = """\
title = "Denied navigation: {title}"
duration_s = {duration}
date = 2026-06-01

[truth]
source = "flight"
aircraft = "loiter"
rate_hz = 200
start = {{ {start} }}
wind = {{ from_deg = 250, speed_mps = 8, turbulence = "light", {wind} }}
terrain = {{ {terrain} }}

{plan}
[record]
rate_hz = 2
imu = false

[sensors.imu]
grade = "{grade}"
rate_hz = 200
[sensors.gnss]
rate_hz = 5
denied = [[{lost}, {end}]]
[sensors.barometer]
rate_hz = 5
[sensors.magnetometer]
rate_hz = 10
[sensors.airspeed]
rate_hz = 5
{sensors}
{fault}
"""


# What built-in estimators are told beyond their aids: all that is drawn for a run is a state then.
TOLD = {"ins": {"states": "matrix"}}


class Contestant(NamedTuple):
    """An estimator that takes part: its name in the table, and its ``kind`` in a scenario."""

    name: str
    kind: str


@dataclass(frozen=True)
class Case:
    """One weather, set of aids and grade, flown until ``longest_s`` after GNSS was lost at ``lost_s`` [s]."""

    weather: Weather
    aids: Aids
    grade: Grade
    contestants: tuple[Contestant, ...]
    lost_s: int
    longest_s: int

    @property
    def text(self) -> str:
        """The scenario's file."""
        lost, duration = self.lost_s, self.lost_s + self.longest_s + BEYOND_S
        end, half = duration + 60, lost + self.longest_s // 2
        flown = SCENARIO.format(
            title=f"{self.aids.title}, {self.weather.title}, {self.grade.name} IMU",
            duration=duration, lost=lost, end=end, wind=self.weather.wind.format(front=lost + FRONT_S),
            grade=self.grade.grade, sensors=self.aids.sensors, fault=self.aids.fault.format(half=half, end=end),
            **self.aids.route._asdict(),
        )  # fmt: skip
        aiding = [name for name, one in Scenario.parse(flown).sensors.items() if one.kind != "imu"]
        entered = [
            "[[estimator]]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in keys.items())
            for keys in (
                {"name": one.name, "kind": one.kind, "aids": aiding, **TOLD.get(one.kind, {})}
                for one in self.contestants
            )
        ]
        return "\n".join([flown.rstrip(), "", *entered])

    @cached_property
    def scenario(self) -> Scenario:
        """The same, checked. Raises UserError."""
        return Scenario.parse(self.text)


@dataclass(frozen=True, slots=True)
class Table:
    """Which part of the table is flown, how many draws unless somebody says, and when GNSS is lost, ``lost_s`` [s].

    What goals are set for is flown in ``judged_draws`` times as many draws: a quantile of 95 % takes dozens. In those
    that are added, sets of aids are flown until ``judged_longest_s`` after the loss where it names them.
    """

    weathers: Sequence[Weather] = WEATHERS
    aids: Sequence[Aids] = AIDINGS
    grades: Sequence[Grade] = GRADES
    marks_s: Sequence[int] = (60, 120, 600, LONGEST_S)
    draws: int = 20
    judged_draws: int = 1
    judged_longest_s: Mapping[str, int] = field(default_factory=dict)
    lost_s: int = 300

    def cases(self, weather: Weather, contestants: tuple[Contestant, ...]) -> Iterator[Case]:
        """Those of one weather."""
        for aids in self.aids:
            for grade in self.grades:
                yield Case(weather, aids, grade, contestants, self.lost_s, max(self.marks_s))

    def judged(self, contestants: tuple[Contestant, ...]) -> tuple[Case, ...]:
        """Those that goals are set for."""
        return tuple(
            replace(case, longest_s=self.judged_longest_s.get(case.aids.name, case.longest_s))
            for weather in self.weathers
            if weather.name == JUDGED_WEATHER
            for case in self.cases(weather, contestants)
            if case.grade.name == JUDGED_GRADE and case.aids.name in JUDGED_AIDS
        )


FULL = Table(judged_draws=5, judged_longest_s={"terrain": 3600})
QUICK = Table(grades=GRADES[:1], marks_s=(60, 120), draws=4)
