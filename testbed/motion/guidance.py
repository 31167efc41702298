"""The law that flies a plan: legs -> bank, altitude and airspeed commands; and whether an aircraft can fly it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

from nav.earth import SEA_LEVEL_DENSITY, isa_density
from testbed.motion.aircraft import GRAVITY, LEAST_CLIMB, Envelope
from testbed.motion.legs import CLIMB_RATE, Airspeed, Climb, Descend, FigureEight, Leg, Loiter, Racetrack, Straight
from testbed.motion.paths import Arc, Feedback, Line, Motion, TangentPlane, abeam, turn_radius, wrap
from testbed.motion.sections import Start

GENTLE_BANK = math.radians(10.0)  # adds 1.5 % to the load, allowed at any airspeed
BANK_RESERVE = math.radians(6.0)  # kept back for tracking when a plan is checked
ACCELERATION = 0.4  # slope of airspeed changes [m/s^2]
ON_PATH = 30.0  # the next leg begins on the path of the one before when it was followed this closely [m]


# --- may it be flown?


class Beginning(Protocol):
    """Where a plan begins."""

    @property
    def alt_m(self) -> float:
        """Height above the ellipsoid [m]."""
        ...

    @property
    def airspeed_mps(self) -> float:
        """True airspeed [m/s]."""
        ...


class ClimbedOut(NamedTuple):
    """Where a plan begins after a take-off: `Beginning`."""

    alt_m: float
    airspeed_mps: float


def beginning(start: Start, envelope: Envelope) -> Beginning:
    """Where a plan begins: at the start; after a take-off the aircraft's floor over ground, at its usual airspeed."""
    if not start.on_ground:
        return start
    alt = start.alt_m + envelope.altitude.floor_m
    return ClimbedOut(alt, envelope.usual.airspeed_mps * math.sqrt(SEA_LEVEL_DENSITY / isa_density(alt)))


def climb_out(start: Start, envelope: Envelope) -> Climb:
    """The leg from the launcher to where the plan begins, along the heading of the start."""
    end = beginning(start, envelope)
    rate = envelope.climb_limit(end.airspeed_mps, end.alt_m)
    return Climb(leg="climb", to_m=end.alt_m, rate_mps=rate, airspeed_mps=end.airspeed_mps)


def plan_mistakes(
    plan: Sequence[Leg], start: Beginning, envelope: Envelope, wind_mps: float = 0.0, ground_m: float = 0.0
) -> list[tuple[str, str]]:
    """What of a plan the aircraft can't fly over ground at ``ground_m``: key and reason.

    All that no aircraft of this envelope could fly at any time; where there is nothing of that, the first that it
    can't fly when altitude and airspeed are followed through the plan. Radii are checked with the wind behind: bank
    atan((V + W)^2 / (g R)) against the limit at the leg's airspeed.
    """
    never = list(_altitude_mistake("truth.start.alt_m", start.alt_m, envelope, ground_m))
    never += [found for index, leg in enumerate(plan) for found in _leg_mistakes(index, leg, envelope, ground_m)]
    return never or list(itertools.islice(_followed(plan, start, envelope, wind_mps), 1))


def _leg_mistakes(index: int, leg: Leg, envelope: Envelope, ground: float) -> Iterator[tuple[str, str]]:
    """What of a leg can't be flown at any altitude and airspeed."""
    stall, fastest = envelope.airspeed.stall_mps, envelope.airspeed.max_mps
    slowest, tightest = envelope.min_airspeed(0.0), envelope.max_bank
    for key in ("to_m", "alt_m"):
        if (altitude := getattr(leg, key, None)) is not None:
            yield from _altitude_mistake(f"plan[{index}].{key}", altitude, envelope, ground)
    for key in ("to_mps", "airspeed_mps"):
        speed = getattr(leg, key, None)
        if speed is not None and speed < slowest:
            reason = f"is too slow: the aircraft stalls at {stall:g} and is flown from {slowest:.1f}"
            yield f"plan[{index}].{key}", f"{speed:g} m/s {reason}"
        elif speed is not None and speed > envelope.max_airspeed(envelope.altitude.ceiling_m):
            reason = f"is too fast: the aircraft is flown up to {fastest:g} m/s equivalent airspeed"
            yield f"plan[{index}].{key}", f"{speed:g} m/s {reason}"
    radius = getattr(leg, "radius_m", None)
    least = turn_radius(envelope.min_airspeed(0.0, tightest), tightest - BANK_RESERVE)
    if radius is not None and radius < least:
        reason = f"is below the bank limit at any airspeed: {least:.0f} m is the least"
        yield f"plan[{index}].radius_m", f"a radius of {radius:g} m {reason}"


def _altitude_mistake(key: str, altitude: float, envelope: Envelope, ground: float) -> Iterator[tuple[str, str]]:
    floor, ceiling = ground + envelope.altitude.floor_m, envelope.altitude.ceiling_m
    if not floor <= altitude <= ceiling:
        reason = f"the ground is at {ground:g} m (ellipsoid), choose from {floor:g} to {ceiling:g}"
        yield key, f"{altitude:g} m can't be flown: {reason}"


def _followed(plan: Sequence[Leg], start: Beginning, envelope: Envelope, wind_mps: float) -> Iterator[tuple[str, str]]:
    """What can't be flown at the altitude and airspeed that it is met at."""
    alt, speed = start.alt_m, start.airspeed_mps
    yield from _speed_mistake("truth.start.airspeed_mps", speed, alt, envelope)
    for index, leg in enumerate(plan):
        at = f"plan[{index}]"
        to_alt = getattr(leg, "to_m", None) or getattr(leg, "alt_m", None) or alt
        speed_key = "to_mps" if isinstance(leg, Airspeed) else "airspeed_mps"
        to_speed = getattr(leg, speed_key, None) or speed
        for height in (alt, to_alt):
            yield from _speed_mistake(f"{at}.{speed_key}", to_speed, height, envelope)
        limit = envelope.climb_limit if to_alt > alt else envelope.descent_limit
        yield from _vertical_mistakes(
            at, leg, alt, to_alt, min(limit(v, height) for v in (speed, to_speed) for height in (alt, to_alt))
        )
        radius = getattr(leg, "radius_m", None)
        for flown in (speed, to_speed):
            if radius is None:
                continue
            bank = envelope.bank_limit(flown, max(alt, to_alt)) - BANK_RESERVE
            yield from _radius_mistake(f"{at}.radius_m", radius, flown, bank, wind_mps)
        alt, speed = to_alt, to_speed


def _speed_mistake(key: str, speed: float, alt: float, envelope: Envelope) -> Iterator[tuple[str, str]]:
    slowest, fastest = envelope.min_airspeed(alt), envelope.max_airspeed(alt)
    at = f"{speed:g} m/s true airspeed at {alt:g} m"
    if speed < slowest:
        yield key, f"{at} is too near the stall: {slowest:.1f} is the least"
    elif speed > fastest:
        yield key, f"{at} is more than the airframe stands: {fastest:.1f} is the most"
    elif (climb := envelope.climb_limit(speed, alt)) < LEAST_CLIMB:
        yield key, f"{at} leaves no climb, {climb:.1f} m/s by the fit in envelope.toml: {LEAST_CLIMB:g} is the least"


def _vertical_mistakes(at: str, leg: Leg, alt: float, to_alt: float, limit: float) -> Iterator[tuple[str, str]]:
    if isinstance(leg, Climb) and to_alt <= alt:
        yield f"{at}.to_m", f"{to_alt:g} m is not above the {alt:g} m before it: use a descend leg"
    if isinstance(leg, Descend) and to_alt >= alt:
        yield f"{at}.to_m", f"{to_alt:g} m is not below the {alt:g} m before it: use a climb leg"
    rate = getattr(leg, "rate_mps", LEAST_CLIMB if to_alt != alt else 0.0)
    if rate > limit:
        key, what = ("rate_mps", f"{rate:g} m/s") if isinstance(leg, Climb | Descend) else ("alt_m", "a change")
        way = "climb" if to_alt > alt else "descent"
        yield f"{at}.{key}", f"{what} is too much of a {way}: {max(limit, 0.0):.1f} m/s can be kept"


def _radius_mistake(key: str, radius: float, speed: float, bank: float, wind: float) -> Iterator[tuple[str, str]]:
    if bank <= 0 or radius < turn_radius(speed + wind, bank):
        least = f"the least is {turn_radius(speed + wind, bank):.0f} m" if bank > 0 else "fly faster"
        with_wind = f" and {wind:g} m/s of wind" if wind else ""
        yield key, f"{radius:g} m is below the bank limit at {speed:g} m/s{with_wind}: {least}"


# --- flying the plan


class Command(NamedTuple):
    """What guidance asks of the inner loops: bank [rad], altitude [m] and its slope [m/s], true airspeed [m/s]."""

    bank: float
    altitude: float
    climb: float
    airspeed: float


class Guidance:
    """Flies a plan, one leg after the other. `step` is called at a fixed rate with the newest state."""

    def __init__(
        self,
        plan: Sequence[Leg],
        envelope: Envelope,
        state: Feedback,
        altitude: float,
        airspeed: float,
        period: float,
    ) -> None:
        self.leg = 0
        self.done = False
        self._plan, self._envelope, self._period = plan, envelope, period
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
            limit = max(self._envelope.bank_limit(self._airspeed, state.h), GENTLE_BANK)
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
        here.north, here.east = abeam(here.north, here.east, course, -self._error)
        self._segments = leg.segments(here, course)
        self._segment = next(self._segments)
        self._segments_flown = 0
        self._elapsed = 0.0
        self._time_limit = getattr(leg, "duration_s", None) or math.inf
        self._to_altitude = getattr(leg, "to_m", None) or getattr(leg, "alt_m", None) or self._to_altitude
        envelope = self._envelope
        limit = envelope.climb_limit if self._to_altitude > self._altitude else envelope.descent_limit
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
