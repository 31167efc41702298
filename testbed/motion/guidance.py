"""Plan legs and the law that flies them: legs -> bank, altitude and airspeed commands.

A leg is one ``[[plan]]`` table of a scenario. In the air it becomes a sequence of segments (lines, arcs, turns) in the
plane tangent to the ellipsoid where the leg begins, so that nothing special happens at the date line or near the poles.
Lines and arcs are followed by a vector field of ground course (Nelson, Barber, McLain, Beard, "Vector Field Path
Following for Miniature Air Vehicles", IEEE Trans. Robotics 23(3), 2007), with the path's curvature fed forward. The law
works on ground velocity, so wind needs no estimate.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Annotated, Literal, NamedTuple, Protocol, Self, TypeAlias, TypeVar

from pydantic import AfterValidator, Field, model_validator

from nav.earth import E2, SEA_LEVEL_DENSITY, A, isa_density
from testbed.schema import Section

GRAVITY = 9.81  # [m/s^2], for banks and load factors only

# What the aircraft can do (aircraft/SOURCES.md says where each comes from).
STALL_EAS = 17.3  # equivalent airspeed at 1 g stall, full tank [m/s]
STALL_MARGIN = 1.1  # the slowest that is flown, over the stall speed
MAX_EAS = 36.0  # [m/s]
MAX_BANK = math.radians(40.0)
GENTLE_BANK = math.radians(10.0)  # adds 1.5 % to the load, allowed at any airspeed
BANK_RESERVE = math.radians(6.0)  # kept back for tracking when a plan is checked
CEILING = 4500.0  # [m]
FLOOR = 30.0  # lowest altitude over the ellipsoid, which is the ground here [m]

CLIMB_RATE = 2.0  # when a leg asks for an altitude but not for a rate [m/s]
ACCELERATION = 0.4  # slope of airspeed changes [m/s^2]
FIELD_RATE = 0.25  # decay of a small cross-track error [1/s]
COURSE_RATE = 0.9  # decay of a course error [1/s]
ON_PATH = 30.0  # the next leg begins on the path of the one before when it was followed this closely [m]
TURN_BANK = math.radians(25.0)  # of a turn to a heading


def min_airspeed(alt_m: float, bank: float = 0.0) -> float:
    """Slowest true airspeed [m/s] flown at an altitude and a bank [rad]: the stall speed with its margin."""
    return STALL_MARGIN * STALL_EAS * math.sqrt(SEA_LEVEL_DENSITY / isa_density(alt_m) / math.cos(bank))


def max_airspeed(alt_m: float) -> float:
    """Fastest true airspeed [m/s] flown at an altitude."""
    return MAX_EAS * math.sqrt(SEA_LEVEL_DENSITY / isa_density(alt_m))


def bank_limit(airspeed: float, alt_m: float) -> float:
    """Steepest bank [rad] that keeps the stall margin in a level turn at a true airspeed."""
    load = (airspeed / min_airspeed(alt_m)) ** 2
    return min(MAX_BANK, math.acos(1.0 / load)) if load > 1.0 else 0.0


def climb_limit(airspeed: float, alt_m: float) -> float:
    """Steepest steady climb [m/s] at a true airspeed that leaves a tenth of the throttle for tracking.

    Fit to the aircraft, on the safe side: near the stall by its airspeed protection, above by the engine.
    """
    eas = airspeed * math.sqrt(isa_density(alt_m) / SEA_LEVEL_DENSITY)
    return min(4.0, eas - 18.8, 5.0 - 0.0007 * alt_m - 0.2 * (eas - 23.0))


def descent_limit(airspeed: float, alt_m: float) -> float:
    """Steepest steady descent [m/s] at idle that leaves the airspeed less than 1 m/s high; fit to the aircraft."""
    to_tas = math.sqrt(SEA_LEVEL_DENSITY / isa_density(alt_m))
    return min(3.0, to_tas * (0.5 + 0.33 * (airspeed / to_tas - 20.5)))


def wrap(angle: float) -> float:
    """Angle [rad] in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def _flyable_speed(value: float) -> float:
    if value < min_airspeed(0.0):
        raise ValueError(
            f"{value:g} m/s is too slow: the aircraft stalls at {STALL_EAS:g} and is flown from {min_airspeed(0.0):.1f}"
        )
    if value > max_airspeed(CEILING):
        raise ValueError(f"{value:g} m/s is too fast: the aircraft is flown up to {MAX_EAS:g} m/s equivalent airspeed")
    return value


def _flyable_altitude(value: float) -> float:
    if not FLOOR <= value <= CEILING:
        raise ValueError(
            f"{value:g} m can't be flown: the ground is at 0 m (ellipsoid), choose from {FLOOR:g} to {CEILING:g}"
        )
    return value


def _flyable_radius(value: float) -> float:
    if value < (least := turn_radius(min_airspeed(0.0, MAX_BANK), MAX_BANK - BANK_RESERVE)):
        raise ValueError(f"a radius of {value:g} m is below the bank limit at any airspeed: {least:.0f} m is the least")
    return value


def turn_radius(ground_speed: float, bank: float) -> float:
    """Radius [m] of a turn at a bank [rad]."""
    return ground_speed**2 / (GRAVITY * math.tan(bank))


Direction: TypeAlias = Annotated[Literal["left", "right"], Field(description="which way it goes round first")]
Count: TypeAlias = Annotated[float, Field(gt=0, le=100_000)]
Duration: TypeAlias = Annotated[float, Field(gt=0, le=1e6, description="ends the leg this long after it began")]
Length: TypeAlias = Annotated[float, Field(gt=0, le=300_000)]
Radius: TypeAlias = Annotated[
    float,
    Field(gt=0, le=20_000, description="of the circles; not below what the aircraft's bank limit allows"),
    AfterValidator(_flyable_radius),
]
Altitude: TypeAlias = Annotated[
    float,
    Field(description="height above the ellipsoid to fly at, from the floor to the aircraft's ceiling"),
    AfterValidator(_flyable_altitude),
]
Speed: TypeAlias = Annotated[
    float,
    Field(description="true airspeed to fly at, between the aircraft's stall margin and its fastest"),
    AfterValidator(_flyable_speed),
]
Rate: TypeAlias = Annotated[float, Field(gt=0, description="vertical speed, always positive")]
Bearing: TypeAlias = Annotated[float, Field(ge=-360, le=360)]


# --- segments: what is flown, in the plane tangent to the ellipsoid at the beginning of the leg


class Motion:
    """Motion in the leg's tangent plane: north, east [m], their rates [m/s], heading [rad], true airspeed [m/s].

    ``ground_speed`` [m/s] and ``course`` [rad] are the polar form of the rates.
    """

    __slots__ = ("airspeed", "course", "east", "ground_speed", "heading", "north", "v_east", "v_north")

    def __init__(
        self, north: float, east: float, v_north: float, v_east: float, heading: float, airspeed: float
    ) -> None:
        self.north, self.east, self.v_north, self.v_east = north, east, v_north, v_east
        self.heading, self.airspeed = heading, airspeed
        self.ground_speed = math.hypot(v_north, v_east)
        self.course = math.atan2(v_east, v_north)

    def wind_speed(self) -> float:
        """Wind that ground velocity, heading and airspeed imply without sideslip [m/s]."""
        return math.hypot(
            self.v_north - self.airspeed * math.cos(self.heading), self.v_east - self.airspeed * math.sin(self.heading)
        )


class Segment(Protocol):
    """One piece of path: `steer` gives the acceleration wanted across the ground track, to the right [m/s^2]."""

    done: bool
    course: float
    error: float

    def steer(self, motion: Motion) -> float:
        """Acceleration to the right [m/s^2].

        Updates ``done``, the path's ``course`` [rad] here, and ``error``, the distance to the right of the path [m].
        """
        ...


class Line:
    """Straight from (north, east) along ``course`` for ``length``."""

    def __init__(self, north: float, east: float, course: float, length: float) -> None:
        self.north, self.east, self.course, self.length = north, east, course, length
        self.along = self.error = 0.0
        self.done = False
        self._cos, self._sin = math.cos(course), math.sin(course)

    def steer(self, motion: Motion) -> float:
        """Course field chi = chi_line - atan(k e), with its own rate of change fed forward."""
        north, east = motion.north - self.north, motion.east - self.east
        self.along = north * self._cos + east * self._sin
        self.done = self.along >= self.length
        self.error = error = east * self._cos - north * self._sin
        speed = max(motion.ground_speed, 5.0)
        k = FIELD_RATE / speed
        error_rate = motion.v_east * self._cos - motion.v_north * self._sin
        field = self.course - math.atan(k * error)
        field_rate = -k * error_rate / (1.0 + (k * error) ** 2)
        return speed * (field_rate + COURSE_RATE * wrap(field - motion.course))


class Arc:
    """Circle about (north, east), flown right (+1) or left (-1) until it has swept ``sweep`` [rad]."""

    def __init__(self, north: float, east: float, radius: float, side: int, sweep: float) -> None:
        self.north, self.east, self.radius, self.side, self.sweep = north, east, radius, side, sweep
        self.swept = self.course = self.error = 0.0
        self.done = False
        self._bearing: float | None = None

    def steer(self, motion: Motion) -> float:
        """Course field chi = tangent + atan(k (d - R)) towards the circle, curvature fed forward."""
        north, east = motion.north - self.north, motion.east - self.east
        distance = math.hypot(north, east)
        bearing = math.atan2(east, north)
        if self._bearing is not None and distance < 1.5 * self.radius + 50.0:
            self.swept += self.side * wrap(bearing - self._bearing)
        self._bearing = bearing
        self.done = self.swept >= self.sweep
        self.course = wrap(bearing + self.side * 0.5 * math.pi)
        speed = max(motion.ground_speed, 5.0)
        k = FIELD_RATE / speed
        error = distance - self.radius
        self.error = -self.side * error
        off = wrap(motion.course - self.course)
        tangential, outward = speed * math.cos(off), -self.side * speed * math.sin(off)
        field = self.course + self.side * math.atan(k * error)
        field_rate = max(tangential, 0.0) / max(distance, 0.5 * self.radius) + k * outward / (1.0 + (k * error) ** 2)
        return speed * (self.side * field_rate + COURSE_RATE * wrap(field - motion.course))


class HeadingTurn:
    """Turn of the nose by ``angle`` [rad], right positive, at constant bank, rolling out at the end."""

    def __init__(self, angle: float, bank: float) -> None:
        self.remaining = angle
        self.course = self.error = 0.0
        self.done = False
        self._limit = GRAVITY * math.tan(bank)
        self._heading: float | None = None

    def steer(self, motion: Motion) -> float:
        """Acceleration of the bank, less when the heading is nearly there."""
        if self._heading is not None:
            self.remaining -= wrap(motion.heading - self._heading)
        self._heading = motion.heading
        self.course = motion.course
        self.done = abs(self.remaining) < math.radians(2.0)
        wanted = 0.8 * motion.airspeed * self.remaining
        return max(-self._limit, min(self._limit, wanted))


# --- legs: the keys of a [[plan]] table, and the segments they become


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
            yield _arc(here.north, here.east, course, self.radius_m, _side(self.direction), sweep)


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
            yield _arc(north, east, course, self.radius_m, side, math.pi)
            north, east = _abeam(north, east, course, 2 * side * self.radius_m)
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
            yield _arc(here.north, here.east, course, self.radius_m, side, 2 * math.pi)
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
            arc = _arc(north, east, course, self.radius_m, side, sweep)
            yield arc
            course = wrap(course + side * sweep)
            north, east = _abeam(arc.north, arc.east, course, -side * self.radius_m)
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
        yield _arc(here.north, here.east, course, radius, _side(self.direction), math.pi)


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


def _abeam(north: float, east: float, course: float, distance: float) -> tuple[float, float]:
    """The point ``distance`` to the right of a point on a course."""
    return north - distance * math.sin(course), east + distance * math.cos(course)


def _arc(north: float, east: float, course: float, radius: float, side: int, sweep: float) -> Arc:
    """The arc that leaves a point along ``course``."""
    return Arc(*_abeam(north, east, course, side * radius), radius, side, sweep)


# --- may it be flown?


class Beginning(Protocol):
    """Where a plan begins."""

    alt_m: float
    airspeed_mps: float


def check_plan(plan: Sequence[Leg], start: Beginning, wind_mps: float = 0.0) -> None:
    """Follow altitude and airspeed through a plan; raise ValueError at the first leg that can't be flown, and why.

    Radii are checked with the wind behind: bank atan((V + W)^2 / (g R)) against the limit at the leg's airspeed.
    """
    alt, speed = start.alt_m, start.airspeed_mps
    try:
        _flyable_altitude(alt)
    except ValueError as reason:
        raise ValueError(f"truth.start.alt_m: {reason}") from None
    _check_speed("truth.start.airspeed_mps", speed, alt)
    for index, leg in enumerate(plan):
        at = f"plan[{index}]"
        to_alt = getattr(leg, "to_m", None) or getattr(leg, "alt_m", None) or alt
        speed_key = "to_mps" if isinstance(leg, Airspeed) else "airspeed_mps"
        to_speed = getattr(leg, speed_key, None) or speed
        for height in (alt, to_alt):
            _check_speed(f"{at}.{speed_key}", to_speed, height)
        _check_vertical(at, leg, alt, to_alt, (speed, to_speed))
        radius = getattr(leg, "radius_m", None)
        if radius is not None:
            _check_radius(f"{at}.radius_m", radius, (speed, to_speed), max(alt, to_alt), wind_mps)
        alt, speed = to_alt, to_speed


def _check_speed(key: str, speed: float, alt: float) -> None:
    slowest, fastest = min_airspeed(alt), max_airspeed(alt)
    if speed < slowest:
        raise ValueError(
            f"{key}: {speed:g} m/s true airspeed at {alt:g} m is too near the stall: {slowest:.1f} is the least"
        )
    if speed > fastest or climb_limit(speed, alt) < 0.2:
        raise ValueError(f"{key}: {speed:g} m/s true airspeed at {alt:g} m is more than engine and airframe stand")


def _check_vertical(at: str, leg: Leg, alt: float, to_alt: float, speeds: Sequence[float]) -> None:
    if isinstance(leg, Climb) and to_alt <= alt:
        raise ValueError(f"{at}.to_m: {to_alt:g} m is not above the {alt:g} m before it: use a descend leg")
    if isinstance(leg, Descend) and to_alt >= alt:
        raise ValueError(f"{at}.to_m: {to_alt:g} m is not below the {alt:g} m before it: use a climb leg")
    climbing = to_alt > alt
    limits = [(climb_limit if climbing else descent_limit)(v, height) for v in speeds for height in (alt, to_alt)]
    rate = getattr(leg, "rate_mps", 0.2 if to_alt != alt else 0.0)
    if rate > min(limits):
        key, what = ("rate_mps", f"{rate:g} m/s") if isinstance(leg, Climb | Descend) else ("alt_m", "a change")
        way = "climb" if climbing else "descent"
        raise ValueError(f"{at}.{key}: {what} is too much of a {way}: {max(min(limits), 0.0):.1f} m/s can be kept")


def _check_radius(key: str, radius: float, speeds: Sequence[float], alt: float, wind: float) -> None:
    for speed in speeds:
        limit = bank_limit(speed, alt) - BANK_RESERVE
        if limit <= 0 or radius < turn_radius(speed + wind, limit):
            least = f"the least is {turn_radius(speed + wind, limit):.0f} m" if limit > 0 else "fly faster"
            with_wind = f" and {wind:g} m/s of wind" if wind else ""
            raise ValueError(f"{key}: {radius:g} m is below the bank limit at {speed:g} m/s{with_wind}: {least}")


# --- flying the plan


class Feedback(NamedTuple):
    """What closes the loops: true by default, an estimator's when somebody says so. SI, radians, NED, body rates."""

    lat: float
    lon: float
    h: float
    v_north: float
    v_east: float
    v_down: float
    roll: float
    pitch: float
    heading: float
    p: float
    q: float
    r: float
    airspeed: float


class Command(NamedTuple):
    """What guidance asks of the inner loops: bank [rad], altitude [m] and its slope [m/s], true airspeed [m/s]."""

    bank: float
    altitude: float
    climb: float
    airspeed: float


class TangentPlane:
    """The plane that touches the ellipsoid at a place: north and east there, whatever the meridians do elsewhere."""

    def __init__(self, lat: float, lon: float) -> None:
        self._sin, self._cos, self._lon = math.sin(lat), math.cos(lat), lon
        self._normal = A / math.sqrt(1.0 - E2 * self._sin**2)

    def motion(self, state: Feedback) -> Motion:
        """Position, ground velocity and heading of ``state`` seen in the plane, at the aircraft's height."""
        s, c = math.sin(state.lat), math.cos(state.lat)
        sl, cl = math.sin(state.lon - self._lon), math.cos(state.lon - self._lon)
        normal = A / math.sqrt(1.0 - E2 * s * s)
        x = (normal + state.h) * c * cl - (self._normal + state.h) * self._cos
        z = (normal * (1.0 - E2) + state.h) * s - (self._normal * (1.0 - E2) + state.h) * self._sin
        v_x = -state.v_north * s * cl - state.v_east * sl - state.v_down * c * cl
        v_y = -state.v_north * s * sl + state.v_east * cl - state.v_down * c * sl
        v_z = state.v_north * c - state.v_down * s
        v_north, v_east = v_z * self._cos - v_x * self._sin, v_y
        convergence = math.atan2(v_east, v_north) - math.atan2(state.v_east, state.v_north)
        return Motion(
            z * self._cos - x * self._sin,
            (normal + state.h) * c * sl,
            v_north,
            v_east,
            state.heading + convergence,
            state.airspeed,
        )


class Guidance:
    """Flies a plan, one leg after the other. `step` is called at a fixed rate with the newest state."""

    def __init__(self, plan: Sequence[Leg], state: Feedback, altitude: float, airspeed: float, period: float) -> None:
        self.leg = 0
        self.done = False
        self._plan, self._period = plan, period
        self._altitude, self._airspeed = altitude, airspeed  # commands now
        self._to_altitude, self._climb_rate, self._to_airspeed = altitude, CLIMB_RATE, airspeed  # and where they go
        self._measured_airspeed = state.airspeed
        self._course: float | None = None  # nominal, at the end of the leg before, and the distance right of its path
        self._error = 0.0
        self._begin(state)

    def step(self, state: Feedback) -> Command:
        """The command for the next period."""
        self._measured_airspeed += self._period / 2.0 * (state.airspeed - self._measured_airspeed)
        self._elapsed += self._period
        motion = self._plane.motion(state)
        acceleration = self._segment.steer(motion)
        while not self.done and self._leg_over(state):
            self._finish_leg(state, motion)
            if not self.done:
                motion = self._plane.motion(state)
                acceleration = self._segment.steer(motion)
        # Banking accelerates across the air's flow, which is off the ground track by the crab angle.
        crab = max(math.cos(motion.course - motion.heading), 0.5)
        bank = math.atan(acceleration / (GRAVITY * crab))
        if abs(bank) > GENTLE_BANK:
            limit = max(bank_limit(self._airspeed, state.h), GENTLE_BANK)
            bank = max(-limit, min(limit, bank))
        climb = self._ramp_altitude()
        step = ACCELERATION * self._period
        self._airspeed += max(-step, min(step, self._to_airspeed - self._airspeed))
        return Command(bank, self._altitude, climb, self._airspeed)

    def activity(self) -> str:
        """The leg being flown and how far it is."""
        if self.done:
            return "plan flown"
        leg, segment, name = self._leg, self._segment, self._leg.leg.replace("_", " ")
        if self._time_limit < math.inf:
            return f"{name} {self._elapsed:.0f}/{self._time_limit:g} s"
        match leg:
            case Straight():
                assert isinstance(segment, Line)
                return f"{name} {max(segment.along, 0.0) / 1000:.1f}/{segment.length / 1000:.1f} km"
            case Climb() | Descend():
                return f"{name} to {leg.to_m:g} m"
            case Airspeed():
                return f"{name} to {leg.to_mps:g} m/s"
            case Loiter():
                assert isinstance(segment, Arc)
                return f"{name} {segment.swept / (2 * math.pi):.1f}/{leg.turns:g} turns"
            case Racetrack():
                return f"{name} {self._segments_flown // 4 + 1}/{leg.laps:g} laps"
            case FigureEight():
                return f"{name} {self._segments_flown // 2 + 1}/{leg.turns:g} turns"
        return name

    def _begin(self, state: Feedback) -> None:
        """Set up the leg that begins at ``state``."""
        self._leg = leg = self._plan[self.leg]
        place = getattr(leg, "to", None) or getattr(leg, "centre", None)
        if place is not None:
            self._plane = TangentPlane(math.radians(place.lat_deg), math.radians(place.lon_deg))
        else:
            self._plane = TangentPlane(state.lat, state.lon)
        here = self._plane.motion(state)
        track = math.atan2(state.v_east, state.v_north)
        course = track if self._course is None else self._course
        course = wrap(course + here.course - track)
        here.north, here.east = _abeam(here.north, here.east, course, -self._error)
        self._segments = leg.segments(here, course)
        self._segment = next(self._segments)
        self._segments_flown = 0
        self._elapsed = 0.0
        self._time_limit = getattr(leg, "duration_s", None) or math.inf
        self._to_altitude = getattr(leg, "to_m", None) or getattr(leg, "alt_m", None) or self._to_altitude
        limit = climb_limit if self._to_altitude > self._altitude else descent_limit
        self._climb_rate = getattr(leg, "rate_mps", min(CLIMB_RATE, limit(self._airspeed, state.h)))
        self._to_airspeed = getattr(leg, "to_mps", None) or getattr(leg, "airspeed_mps", None) or self._to_airspeed

    def _leg_over(self, state: Feedback) -> bool:
        """Whether the leg's own condition is met; goes on to its next segment where one is done."""
        if self._elapsed >= self._time_limit or self._leg.reached(
            self._altitude, self._airspeed, state, self._measured_airspeed
        ):
            return True
        if not self._segment.done:
            return False
        following = next(self._segments, None)
        if following is None:
            return True
        self._segment = following
        self._segments_flown += 1
        return False

    def _finish_leg(self, state: Feedback, motion: Motion) -> None:
        """Keep the nominal end of the path, course as a true course here, and begin the next leg there."""
        track = math.atan2(state.v_east, state.v_north)
        self._course = wrap(self._segment.course - motion.course + track)
        self._error = self._segment.error if abs(self._segment.error) < ON_PATH else 0.0
        self.leg += 1
        self.done = self.leg == len(self._plan)
        if not self.done:
            self._begin(state)

    def _ramp_altitude(self) -> float:
        """Move the altitude command on; returns its slope [m/s]."""
        left = self._to_altitude - self._altitude
        step = self._climb_rate * self._period
        if abs(left) <= step:
            self._altitude = self._to_altitude
            return 0.0
        self._altitude += math.copysign(step, left)
        return math.copysign(self._climb_rate, left)
