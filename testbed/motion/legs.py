"""The legs of a plan: the keys of a ``[[plan]]`` table, and the segments that a leg becomes in the air.

The segments lie in the plane tangent to the ellipsoid where the leg begins, so that nothing special happens at the date
line or near the poles. Whether an aircraft can fly them is asked by `testbed.motion.guidance.plan_mistakes`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Literal, Self, TypeAlias, TypeVar

from pydantic import Field, model_validator

from testbed.motion.paths import Arc, Feedback, HeadingTurn, Line, Motion, Segment, abeam, arc_from, turn_radius, wrap
from testbed.schema import Section

CLIMB_RATE = 2.0  # when a leg asks for an altitude but not for a rate [m/s]
TURN_BANK = math.radians(25.0)  # of a turn to a heading


Direction: TypeAlias = Annotated[Literal["left", "right"], Field(description="which way it goes round first")]
Count: TypeAlias = Annotated[float, Field(gt=0, le=100_000)]
Duration: TypeAlias = Annotated[float, Field(gt=0, le=1e6, description="ends the leg this long after it began")]
Length: TypeAlias = Annotated[float, Field(gt=0, le=300_000)]
Radius: TypeAlias = Annotated[
    float, Field(gt=0, le=20_000, description="of the circles; not below what the aircraft's bank limit allows")
]
Altitude: TypeAlias = Annotated[
    float, Field(description="height above the ellipsoid to fly at, from the floor to the aircraft's ceiling")
]
Speed: TypeAlias = Annotated[
    float, Field(gt=0, description="true airspeed to fly at, between the aircraft's stall margin and its fastest")
]
Rate: TypeAlias = Annotated[float, Field(gt=0, description="vertical speed, always positive")]
Bearing: TypeAlias = Annotated[float, Field(ge=-360, le=360)]


class Waypoint(Section):
    """A place on the map."""

    lat_deg: float = Field(gt=-85, lt=85, description="geodetic latitude, WGS84")
    lon_deg: float = Field(ge=-180, le=180, description="longitude, east positive")


class _Leg(Section):
    """What the legs have in common."""

    def reached(self, altitude: float, airspeed: float, state: Feedback, measured_airspeed: float) -> bool:
        """Whether the leg is over before its path is, given the commands, the state, and its airspeed less gusts."""
        return False


class Straight(_Leg):
    """Straight along the present course for a length, or to a place."""

    leg: Literal["straight"]
    length_m: Length | None = Field(default=None, description="ends the leg after this length; or give `to`")
    to: Waypoint | None = Field(default=None, description="a place to fly to, where the leg ends; or give `length_m`")
    alt_m: Altitude | None = None
    airspeed_mps: Speed | None = None

    @model_validator(mode="after")
    def _ends(self) -> Self:
        return _one_of(self, "length_m", "to")

    def segments(self, here: Motion, course: float) -> Iterator[Segment]:
        """One line. Towards a place the leg's plane touches the Earth there, so the line ends at its origin."""
        if self.length_m is not None:
            yield Line(here.north, here.east, course, self.length_m)
        else:
            yield Line(here.north, here.east, math.atan2(-here.east, -here.north), math.hypot(here.north, here.east))


class Turn(_Leg):
    """Turn the nose to a heading, the shorter way unless a direction is given, or by an angle, right positive."""

    leg: Literal["turn"]
    to_deg: Bearing | None = Field(default=None, description="true heading to turn to; or give `by_deg`")
    by_deg: Annotated[float, Field(ge=-3600, le=3600)] | None = Field(
        default=None, description="angle to turn by, right positive; or give `to_deg`"
    )
    direction: Direction | None = Field(
        default=None, description="which way to turn to `to_deg`; the shorter way where it is left out"
    )
    alt_m: Altitude | None = None
    airspeed_mps: Speed | None = None

    @model_validator(mode="after")
    def _ends(self) -> Self:
        if self.by_deg is not None and self.direction is not None:
            raise ValueError("the sign of by_deg gives the direction, right positive: leave direction out")
        return _one_of(self, "to_deg", "by_deg")

    def segments(self, here: Motion, course: float) -> Iterator[Segment]:
        """One turn of the nose."""
        if self.by_deg is not None:
            angle = math.radians(self.by_deg)
        else:
            assert self.to_deg is not None
            angle = wrap(math.radians(self.to_deg) - here.heading)
            if self.direction == "right":
                angle %= 2 * math.pi
            elif self.direction == "left":
                angle = -(-angle % (2 * math.pi))
        yield HeadingTurn(angle, TURN_BANK)


class Climb(_Leg):
    """Climb to an altitude along the present course."""

    leg: Literal["climb"]
    to_m: Altitude = Field(description="height above the ellipsoid at which the leg ends")
    rate_mps: Rate = CLIMB_RATE
    airspeed_mps: Speed | None = None

    def segments(self, here: Motion, course: float) -> Iterator[Segment]:
        """On and on, until the altitude is reached."""
        yield Line(here.north, here.east, course, math.inf)

    def reached(self, altitude: float, airspeed: float, state: Feedback, measured_airspeed: float) -> bool:
        """At the altitude."""
        return altitude == self.to_m and abs(state.h - self.to_m) < 5.0


class Descend(_Leg):
    """Descend to an altitude along the present course."""

    leg: Literal["descend"]
    to_m: Altitude = Field(description="height above the ellipsoid at which the leg ends")
    rate_mps: Rate = CLIMB_RATE
    airspeed_mps: Speed | None = None

    def segments(self, here: Motion, course: float) -> Iterator[Segment]:
        """On and on, until the altitude is reached."""
        yield Line(here.north, here.east, course, math.inf)

    def reached(self, altitude: float, airspeed: float, state: Feedback, measured_airspeed: float) -> bool:
        """At the altitude."""
        return altitude == self.to_m and abs(state.h - self.to_m) < 5.0


class Airspeed(_Leg):
    """Change the true airspeed along the present course."""

    leg: Literal["airspeed"]
    to_mps: Speed = Field(description="true airspeed at which the leg ends")
    alt_m: Altitude | None = None

    def segments(self, here: Motion, course: float) -> Iterator[Segment]:
        """On and on, until the airspeed is reached."""
        yield Line(here.north, here.east, course, math.inf)

    def reached(self, altitude: float, airspeed: float, state: Feedback, measured_airspeed: float) -> bool:
        """At the airspeed."""
        return airspeed == self.to_mps and abs(measured_airspeed - self.to_mps) < 1.0


class Loiter(_Leg):
    """Circle: about a centre, or from here on, which is then a point of the circle. Counts turns, or lasts a time.

    Turns count from where the circle is reached; the time counts from the beginning of the leg.
    """

    leg: Literal["loiter"]
    radius_m: Radius
    centre: Waypoint | None = Field(
        default=None, description="centre of the circle; without one the circle begins where the aircraft is"
    )
    turns: Count | None = Field(
        default=None,
        description="ends the leg after so many turns, counted from where the circle is reached; or give `duration_s`",
    )
    duration_s: Duration | None = None
    direction: Direction = "left"
    alt_m: Altitude | None = None
    airspeed_mps: Speed | None = None

    @model_validator(mode="after")
    def _ends(self) -> Self:
        return _one_of(self, "turns", "duration_s")

    def segments(self, here: Motion, course: float) -> Iterator[Segment]:
        """One arc; with a centre the leg's plane touches the Earth there."""
        sweep = math.inf if self.turns is None else self.turns * 2 * math.pi
        if self.centre is not None:
            yield Arc(0.0, 0.0, self.radius_m, _side(self.direction), sweep)
        else:
            yield arc_from(here.north, here.east, course, self.radius_m, _side(self.direction), sweep)


class Racetrack(_Leg):
    """Two straights joined by half circles, from here along the present course. Counts laps, or lasts a time."""

    leg: Literal["racetrack"]
    length_m: Length = Field(description="length of each straight")
    radius_m: Radius
    laps: Count | None = Field(default=None, description="ends the leg after so many laps; or give `duration_s`")
    duration_s: Duration | None = None
    direction: Direction = "left"
    alt_m: Altitude | None = None
    airspeed_mps: Speed | None = None

    @model_validator(mode="after")
    def _ends(self) -> Self:
        return _one_of(self, "laps", "duration_s")

    def segments(self, here: Motion, course: float) -> Iterator[Segment]:
        """Line, half circle, line back, half circle, again."""
        side = _side(self.direction)
        north, east = here.north, here.east
        half_laps = math.inf if self.laps is None else round(2 * self.laps)
        while half_laps > 0:
            yield Line(north, east, course, self.length_m)
            north, east = north + self.length_m * math.cos(course), east + self.length_m * math.sin(course)
            yield arc_from(north, east, course, self.radius_m, side, math.pi)
            north, east = abeam(north, east, course, 2 * side * self.radius_m)
            course = wrap(course + math.pi)
            half_laps -= 1


class FigureEight(_Leg):
    """Two circles that touch here, one after the other in opposite directions. Counts eights, or lasts a time."""

    leg: Literal["figure_eight"]
    radius_m: Radius
    turns: Count | None = Field(default=None, description="ends the leg after so many eights; or give `duration_s`")
    duration_s: Duration | None = None
    direction: Direction = "left"
    alt_m: Altitude | None = None
    airspeed_mps: Speed | None = None

    @model_validator(mode="after")
    def _ends(self) -> Self:
        return _one_of(self, "turns", "duration_s")

    def segments(self, here: Motion, course: float) -> Iterator[Segment]:
        """A full circle to each side in turn."""
        side = _side(self.direction)
        circles = math.inf if self.turns is None else round(2 * self.turns)
        while circles > 0:
            yield arc_from(here.north, here.east, course, self.radius_m, side, 2 * math.pi)
            side, circles = -side, circles - 1


class STurns(_Leg):
    """Swing from one side of the present course to the other, on arcs; ends on the course it began with."""

    leg: Literal["s_turns"]
    radius_m: Radius
    turns: Annotated[int, Field(ge=1, le=1000)] = Field(description="how many turns across the present course")
    swing_deg: Annotated[float, Field(ge=10, le=120)] = Field(
        default=60.0, description="how far the course leaves the present one, to either side"
    )
    direction: Direction = "left"
    alt_m: Altitude | None = None
    airspeed_mps: Speed | None = None

    def segments(self, here: Motion, course: float) -> Iterator[Segment]:
        """Out by the swing, across by twice the swing as often as there are more turns, and back."""
        side, north, east = _side(self.direction), here.north, here.east
        swing = math.radians(self.swing_deg)
        for sweep in (swing, *[2 * swing] * (self.turns - 1), swing):
            arc = arc_from(north, east, course, self.radius_m, side, sweep)
            yield arc
            course = wrap(course + side * sweep)
            north, east = abeam(arc.north, arc.east, course, -side * self.radius_m)
            side = -side


class UTurn(_Leg):
    """Half a circle, back along a parallel course; without a radius at 25 deg of bank."""

    leg: Literal["u_turn"]
    radius_m: Radius | None = Field(
        default=None, description="of the half circle; without one what 25 deg of bank give"
    )
    direction: Direction = "left"
    alt_m: Altitude | None = None
    airspeed_mps: Speed | None = None

    def segments(self, here: Motion, course: float) -> Iterator[Segment]:
        """One half circle, wide enough for its downwind end."""
        radius = self.radius_m or turn_radius(here.airspeed + here.wind_speed(), TURN_BANK)
        yield arc_from(here.north, here.east, course, radius, _side(self.direction), math.pi)


Leg: TypeAlias = Annotated[
    Straight | Turn | Climb | Descend | Airspeed | Loiter | Racetrack | FigureEight | STurns | UTurn,
    Field(discriminator="leg"),
]

LegModel = TypeVar("LegModel", bound=Section)


def _one_of(leg: LegModel, first: str, second: str) -> LegModel:
    if (getattr(leg, first) is None) == (getattr(leg, second) is None):
        raise ValueError(f"the leg ends by {first} or by {second}: give one of them")
    return leg


def _side(direction: Direction) -> int:
    return 1 if direction == "right" else -1
