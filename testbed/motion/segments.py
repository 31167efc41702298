"""Segments of a kinematic motion: the keys of a ``[[truth.segments]]`` table, and the curves in time they become.

A motion is three rates over time: acceleration along the track, rate of turn of the course, and climb. Each is a cubic
Hermite spline; its integral gives speed, course and height, its slope what the body's own rates need, so all agree to
rounding. A rate goes from zero to its steady value and back by the smooth step 3x^2 - 2x^3, so that whatever is put
together, acceleration, bank and pitch are continuous, and but for the ends of a weave the body's rate too.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal, Self, TypeAlias, TypeVar

import numpy as np
from pydantic import Field, model_validator

from nav.earth import STANDARD_GRAVITY
from nav.samples import Array
from testbed.schema import Section

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

MAX_ACCELERATION = 5 * STANDARD_GRAVITY  # [m/s^2] in any direction, beyond that a slip of the keyboard
MAX_CLIMB_ANGLE = math.radians(45.0)
HEIGHTS = (-500.0, 20_000.0)  # [m] where the standard atmosphere is known
SHORTEST_S, LONGEST_S = 1e-3, 48 * 3600.0  # of a segment
MOST_KNOTS = 200_000
PIECES = 16  # of the spline in a quarter of a sinusoid: it keeps within 2e-7 of it

TO_REST = 12  # decimals of the speed [m/s] at knots: sums are rounded to it, so that a body that stops stands still

Duration: TypeAlias = Annotated[float, Field(ge=SHORTEST_S, le=LONGEST_S, description="how long the segment lasts")]
GroundSpeed: TypeAlias = Annotated[float, Field(ge=0, le=1000)]
Angle: TypeAlias = Annotated[float, Field(ge=-36_000, le=36_000)]

ACCELERATION, TURN, CLIMB = 0, 1, 2  # rates, or speed, course and height
RATES = 3

# Rows of a segment: time from its start, three rates, three slopes.
Knots: TypeAlias = Array


AnySegment = TypeVar("AnySegment", bound=Section)


class _Segment(Section):
    """What the segments have in common.

    Each gives its ``knots``, told the speed [m/s] that it finds and the time [s] that a manoeuvre takes to build up.
    """

    def end_speed(self, speed: float) -> float:
        """Speed [m/s] after the segment, given that before."""
        return speed


class Stop(_Segment):
    """Stand still."""

    leg: Literal["stop"]
    duration_s: Duration

    def knots(self, speed: float, blend: float) -> Knots:
        """No rates."""
        if speed > 0:
            raise ValueError(f"leg: the body still moves at {speed:g} m/s: put an accelerate leg to 0 before it")
        return _steady(self.duration_s)


class Straight(_Segment):
    """Go on at the speed and course reached."""

    leg: Literal["straight"]
    length_m: Annotated[float, Field(gt=0, le=1e8)] | None = Field(
        default=None, description="length of the segment; or give `duration_s`"
    )
    duration_s: Duration | None = None

    @model_validator(mode="after")
    def _ends(self) -> Self:
        return _one_of(self, "length_m", "duration_s")

    def knots(self, speed: float, blend: float) -> Knots:
        """No rates."""
        if self.duration_s is not None:
            return _steady(self.duration_s)
        assert self.length_m is not None
        _moving("length_m", speed)
        return _steady(_duration("length_m", self.length_m / speed))


class Accelerate(_Segment):
    """Gain or lose speed along the track: with a steady acceleration, or within a time."""

    leg: Literal["accelerate"]
    to_mps: GroundSpeed = Field(description="speed over ground at its end; 0 comes to rest")
    accel_mps2: Annotated[float, Field(gt=0, le=MAX_ACCELERATION)] | None = Field(
        default=None, description="steady acceleration, or deceleration, always positive; or give `duration_s`"
    )
    duration_s: Duration | None = None

    @model_validator(mode="after")
    def _ends(self) -> Self:
        return _one_of(self, "accel_mps2", "duration_s")

    def end_speed(self, speed: float) -> float:
        """The speed it leads to."""
        return self.to_mps

    def knots(self, speed: float, blend: float) -> Knots:
        """One change of speed."""
        if self.to_mps == speed:
            raise ValueError(f"to_mps: the speed is {speed:g} m/s already: leave the leg out, or use straight")
        knots = _change(ACCELERATION, self.to_mps - speed, self.accel_mps2, self.duration_s, blend, "accel_mps2")
        _bearable("duration_s", np.abs(knots[:, 1]).max())
        return knots


class Turn(_Segment):
    """Turn the course by an angle, right positive, at constant speed: at a rate, on a radius, or within a time."""

    leg: Literal["turn"]
    by_deg: Angle = Field(description="change of course, right positive")
    rate_degps: Annotated[float, Field(gt=0, le=360)] | None = Field(
        default=None, description="steady rate of turn; or give `radius_m` or `duration_s`"
    )
    radius_m: Annotated[float, Field(gt=0, le=1e7)] | None = Field(
        default=None, description="radius of the steady part; or give `rate_degps` or `duration_s`"
    )
    duration_s: Duration | None = None

    @model_validator(mode="after")
    def _ends(self) -> Self:
        _turns(self.by_deg)
        return _one_of(self, "rate_degps", "radius_m", "duration_s")

    def knots(self, speed: float, blend: float) -> Knots:
        """One change of course. Where it turns steadily the track is a circle."""
        key = next(key for key in ("rate_degps", "radius_m", "duration_s") if getattr(self, key) is not None)
        _moving(key, speed)
        rate = None if self.rate_degps is None else math.radians(self.rate_degps)
        rate = rate if self.radius_m is None else speed / self.radius_m
        knots = _change(TURN, math.radians(self.by_deg), rate, self.duration_s, blend, key)
        _bearable(key, speed * np.abs(knots[:, 1 + TURN]).max())
        return knots


class Climb(_Segment):
    """Climb by a height, or descend by a negative one, at constant speed over ground: at a rate, or within a time."""

    leg: Literal["climb"]
    by_m: Annotated[float, Field(ge=-20_500, le=20_500)] = Field(description="change of height, negative to descend")
    rate_mps: Annotated[float, Field(gt=0, le=500)] | None = Field(
        default=None, description="steady vertical speed, always positive; or give `duration_s`"
    )
    duration_s: Duration | None = None

    @model_validator(mode="after")
    def _ends(self) -> Self:
        return _one_of(self, "rate_mps", "duration_s")

    def knots(self, speed: float, blend: float) -> Knots:
        """One change of height."""
        if self.by_m == 0:
            raise ValueError("by_m: is no climb: leave the leg out, or use straight")
        key = "rate_mps" if self.duration_s is None else "duration_s"
        _moving(key, speed)
        knots = _change(CLIMB, self.by_m, self.rate_mps, self.duration_s, blend, key)
        climb = np.abs(knots[:, 1 + CLIMB]).max()
        steepest = speed * math.tan(MAX_CLIMB_ANGLE)
        if climb > steepest:
            raise ValueError(f"{key}: {climb:.3g} m/s is steeper than 45 deg: at {speed:g} m/s climb slower")
        _bearable(key, 1.5 * climb / (knots[1, 0] - knots[0, 0]))
        return knots


class Weave(_Segment):
    """Swing the course to and fro like a river: sinusoidal, first to the right by ``swing_deg`` (left if negative).

    The course starts at one end of its swing. A period is a swing there and one back. With ``to_mps`` the speed goes
    from what it is to that in the middle of a swing, and back at its end.
    """

    leg: Literal["weave"]
    swing_deg: Angle = Field(
        description="from one end of the swing to the other, first to the right; negative: first to the left"
    )
    period_s: Annotated[float, Field(ge=1, le=LONGEST_S)] = Field(description="a swing there and one back")
    swings: Annotated[int, Field(ge=1, le=1000)] = Field(description="how many swings, two to a period")
    to_mps: GroundSpeed | None = Field(
        default=None, description="speed in the middle of each swing; without it the speed stays"
    )

    def knots(self, speed: float, blend: float) -> Knots:
        """One sine of the rate of turn per period, two of the acceleration."""
        _turns(self.swing_deg)
        _moving("swings", speed)
        fastest = speed if self.to_mps is None else self.to_mps
        quarter = self.period_s / 4
        swing = np.zeros((4 * PIECES + 1, 1 + 2 * RATES))
        x = np.linspace(0.0, np.pi, 4 * PIECES + 1)
        swing[:, 0] = 2 * quarter * x / np.pi
        _sine(swing, TURN, math.radians(self.swing_deg))
        _sine(swing[: 2 * PIECES + 1], ACCELERATION, fastest - speed)
        _sine(swing[2 * PIECES :], ACCELERATION, speed - fastest)
        _bearable("period_s", np.abs(swing[:, 1]).max())
        _bearable("period_s", max(fastest, speed) * np.abs(swing[:, 1 + TURN]).max())
        back = swing.copy()
        back[:, [1 + TURN, 1 + RATES + TURN]] *= -1
        rows = [swing]
        for number in range(1, self.swings):
            rows.append((back if number % 2 else swing)[1:].copy())
            rows[-1][:, 0] += number * 2 * quarter
        return np.vstack(rows)


class Repeat(_Segment):
    """Do the ``last`` segments before it again, so many times."""

    leg: Literal["repeat"]
    last: Annotated[int, Field(ge=1, le=1000)] = Field(description="how many of the segments before this one")
    times: Annotated[int, Field(ge=1, le=100_000)] = Field(description="how often they are done again")


Segment: TypeAlias = Annotated[
    Stop | Straight | Accelerate | Turn | Climb | Weave | Repeat,
    Field(discriminator="leg"),
]


class Sway(Section):
    """A sinusoid in roll or pitch, on top of the motion's own."""

    amplitude_deg: float = Field(ge=0, le=60, description="largest angle")
    period_s: float = Field(ge=0.5, le=3600, description="of the sinusoid")
    phase_deg: float = Field(default=0.0, ge=-360, le=360, description="at the start of the run")


class Body(Section):
    """How a body moves along its track.

    An aircraft banks into its turns as far as a ball in the middle wants; a road vehicle stays ``flat``, its nose
    pointing further into the turn than the course by ``drift_s`` times the rate of turn; a ship has ``roll`` and
    ``pitch``. ``blend_s`` is the time that a manoeuvre takes to build up, and to fade.
    """

    turns: Literal["banked", "flat"] = Field(
        default="flat", description="banked as an aircraft, or flat as a vehicle or a ship"
    )
    blend_s: float = Field(
        default=1.0, ge=0.01, le=60, description="time that a manoeuvre takes to build up, and to fade"
    )
    drift_s: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="flat: by how much the nose points further into a turn than the course, per rate of turn",
    )
    roll: Sway | None = Field(default=None, description="swaying about the forward axis; none: it does not")
    pitch: Sway | None = Field(default=None, description="swaying about the right axis; none: it does not")


@dataclass(frozen=True, slots=True)
class Track:
    """Speed [m/s], course less that at the start [rad] and height above it [m] as functions of time.

    ``path(t)`` (N, 3) are these three, ``rates(t)`` (N, 3) their rates, ``rates(t, 1)`` their second derivatives.
    ``legs`` are the times at which segments begin and their indexes; the last, -1, goes on straight for ever.
    """

    path: PPoly
    rates: PPoly
    leg_starts: Array
    legs: Array

    def leg(self, t: Array) -> Array:
        """Index of the segment at each of the times (N,), -1 after the last."""
        return self.legs[np.searchsorted(self.leg_starts, t, side="right") - 1]


def lay_track(segments: Sequence[Segment], speed: float = 0.0, height: float = 0.0, blend: float = 1.0) -> Track:
    """The track of segments from a speed [m/s] and height [m] on.

    Raises ValueError, beginning with its key, at the first segment that can't be.
    """
    from scipy.interpolate import CubicHermiteSpline, PPoly  # slow to load, and flights have no need of it

    pieces: list[Array] = []
    ends, starts, legs = [np.zeros(1)], [], []
    start_speed, t, count = speed, 0.0, 0
    for index, segment in _unrolled(segments):
        try:
            knots = segment.knots(speed, blend)
            height += float(np.trapezoid(knots[:, 1 + CLIMB], knots[:, 0]))  # exact for smooth steps and constants
            if not HEIGHTS[0] <= height <= HEIGHTS[1]:
                raise ValueError(f"by_m: ends at {height:g} m: stay from {HEIGHTS[0]:g} to {HEIGHTS[1]:g} m")
            count += len(knots)
            if count > MOST_KNOTS:
                raise ValueError("leg: the motion has too many segments up to here: shorten it")
        except ValueError as error:
            raise ValueError(f"truth.segments[{index}].{error}") from None
        starts.append(t)
        legs.append(index)
        pieces.append(CubicHermiteSpline(knots[:, 0], knots[:, 1 : 1 + RATES], knots[:, 1 + RATES :]).c)
        ends.append(t + knots[1:, 0])
        t, speed = float(ends[-1][-1]), segment.end_speed(speed)
    pieces.append(np.zeros((4, 1, RATES)))
    ends.append(np.array([t + LONGEST_S]))
    rates = PPoly(np.concatenate(pieces, axis=1), np.concatenate(ends))
    path = rates.antiderivative()
    path.c[-1, :, ACCELERATION] += start_speed
    path.c[-1] = np.round(path.c[-1], TO_REST)
    return Track(path, rates, np.array([*starts, t]), np.array([*legs, -1], dtype=float))


def _unrolled(segments: Sequence[Segment]) -> Iterator[tuple[int, Stop | Straight | Accelerate | Turn | Climb | Weave]]:
    """The segments in the order in which they come, with their indexes."""
    for index, segment in enumerate(segments):
        if not isinstance(segment, Repeat):
            yield index, segment
            continue
        again = list(enumerate(segments))[max(0, index - segment.last) : index]
        if len(again) < segment.last:
            raise ValueError(f"truth.segments[{index}].last: there are only {index} segments before it")
        for _ in range(segment.times):
            for number, one in again:
                if isinstance(one, Repeat):
                    raise ValueError(f"truth.segments[{index}].last: reaches beyond another repeat: take fewer")
                yield number, one


def _steady(duration: float) -> Knots:
    knots = np.zeros((2, 1 + 2 * RATES))
    knots[1, 0] = duration
    return knots


def _change(channel: int, change: float, rate: float | None, duration: float | None, blend: float, key: str) -> Knots:
    """Change one of the path's coordinates at a steady rate that builds up and fades within ``blend`` [s] each.

    Given the duration T the rate is change / (T - blend); given the rate it lasts that much longer than without blends.
    One that is over before it has built up blends faster.
    """
    if duration is None:
        assert rate is not None
        steady = _duration(key, abs(change) / rate)
        blend = min(blend, steady)
        duration = steady + blend
    blend = min(blend, duration / 2)
    if duration - 2 * blend < SHORTEST_S:
        blend = duration / 2
        times = [0.0, blend, duration]
    else:
        times = [0.0, blend, duration - blend, duration]
    knots = np.zeros((len(times), 1 + 2 * RATES))
    knots[:, 0] = times
    knots[1:-1, 1 + channel] = change / (duration - blend)
    return knots


def _sine(knots: Knots, channel: int, change: float) -> None:
    """Write into ``knots`` half a sine of a rate, over all of their even steps, whose integral is ``change``.

    The spline of unit amplitude has the integral T/pi (h/tan(h/2) + h^2/6) with h the angle of a step.
    """
    x = np.linspace(0.0, np.pi, len(knots))
    time_per_angle = (knots[-1, 0] - knots[0, 0]) / np.pi
    h = x[1]
    amplitude = change / (time_per_angle * (h / math.tan(h / 2) + h * h / 6))
    knots[:, 1 + channel] = amplitude * np.sin(x)
    knots[[0, -1], 1 + channel] = 0.0
    knots[:, 1 + RATES + channel] = amplitude * np.cos(x) / time_per_angle


def _duration(key: str, duration: float) -> float:
    if not SHORTEST_S <= duration <= LONGEST_S:
        raise ValueError(f"{key}: takes {duration:.3g} s: it must last from 1 ms to 48 h")
    return duration


def _moving(key: str, speed: float) -> None:
    if speed == 0:
        raise ValueError(f"{key}: the body stands still here: put an accelerate leg or truth.start.speed_mps before it")


def _bearable(key: str, acceleration: float) -> None:
    if acceleration > MAX_ACCELERATION:
        asked, most = acceleration / STANDARD_GRAVITY, MAX_ACCELERATION / STANDARD_GRAVITY
        raise ValueError(f"{key}: asks for {asked:.3g} g: {most:g} g is the most")


def _turns(angle: float) -> None:
    if abs(angle) < 1e-6:
        raise ValueError("turns by nothing: give degrees, right positive")


def _one_of(segment: AnySegment, *keys: str) -> AnySegment:
    given = [key for key in keys if getattr(segment, key) is not None]
    if len(given) != 1:
        raise ValueError(f"give one of {', '.join(keys)}")
    return segment
