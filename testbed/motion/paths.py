"""Paths over ground: lines, arcs and turns in a plane tangent to the ellipsoid, and how each is followed.

Lines and arcs are followed by a vector field of ground course (Nelson, Barber, McLain, Beard, "Vector Field Path
Following for Miniature Air Vehicles", IEEE Trans. Robotics 23(3), 2007), with the path's curvature fed forward. The law
works on ground velocity, so wind needs no estimate.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

from nav.earth import E2, A
from testbed.motion.aircraft import GRAVITY

FIELD_RATE = 0.25  # decay of a small cross-track error [1/s]
COURSE_RATE = 0.9  # decay of a course error [1/s]


def wrap(angle: float) -> float:
    """Angle [rad] in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def turn_radius(ground_speed: float, bank: float) -> float:
    """Radius [m] of a turn at a bank [rad]."""
    return ground_speed**2 / (GRAVITY * math.tan(bank))


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


class TangentPlane:
    """The plane that touches the ellipsoid at a place: north and east there, whatever the meridians do elsewhere."""

    def __init__(self, lat: float, lon: float) -> None:
        self._sin, self._cos, self._lon = math.sin(lat), math.cos(lat), lon
        self._normal = A / math.sqrt(1.0 - E2 * self._sin**2)

    def motion(self, state: Feedback) -> Motion:
        """Position, ground velocity and heading of ``state`` seen in the plane, at the aircraft's height."""
        lat, lon, h, north, east, down, _, _, heading, _, _, _, airspeed = state  # once: names take their time
        s, c = math.sin(lat), math.cos(lat)
        sl, cl = math.sin(lon - self._lon), math.cos(lon - self._lon)
        normal = A / math.sqrt(1.0 - E2 * s * s)
        x = (normal + h) * c * cl - (self._normal + h) * self._cos
        z = (normal * (1.0 - E2) + h) * s - (self._normal * (1.0 - E2) + h) * self._sin
        v_x = -north * s * cl - east * sl - down * c * cl
        v_y = -north * s * sl + east * cl - down * c * sl
        v_z = north * c - down * s
        v_north = v_z * self._cos - v_x * self._sin
        convergence = math.atan2(v_y, v_north) - math.atan2(east, north)
        return Motion(
            z * self._cos - x * self._sin, (normal + h) * c * sl, v_north, v_y, heading + convergence, airspeed
        )


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


def abeam(north: float, east: float, course: float, distance: float) -> tuple[float, float]:
    """The point ``distance`` to the right of a point on a course."""
    return north - distance * math.sin(course), east + distance * math.cos(course)


def arc_from(north: float, east: float, course: float, radius: float, side: int, sweep: float) -> Arc:
    """The arc that leaves a point along ``course``."""
    return Arc(*abeam(north, east, course, side * radius), radius, side, sweep)
