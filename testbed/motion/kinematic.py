"""Motion without an aircraft: at rest on the turning Earth, or along segments as car, ship or aircraft would go."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from nav._jit import njit
from nav.earth import (
    earth_rate_n,
    gravity,
    isa_density,
    isa_pressure,
    isa_temperature,
    radii,
    transport_rate_n,
    wrap_longitude,
)
from nav.rotation import quat_conjugate, quat_from_euler, quat_rotate
from nav.samples import Array
from testbed.motion.segments import Body, Sway, Track, lay_track
from testbed.motion.table import TruthBlock, increments

LATITUDE_LIMIT = math.radians(85.0)  # as for a start

# Columns of `_rows`' output
SPEED, ALPHA, BETA, PRESSURE, TEMPERATURE, DENSITY, BANK = range(7)


class Placement(Protocol):
    """Where the body starts and how it lies; heading, pitch, roll in the aerospace sequence."""

    lat_deg: float
    lon_deg: float
    alt_m: float
    heading_deg: float
    pitch_deg: float
    roll_deg: float


class Kinematic:
    """A body on a track, in still standard air, engine off: a `MotionSource`.

    It goes on straight after its last segment and never ends by itself, unless it leaves the latitudes in which
    north-east-down navigation works. The heading is the track's course and any drift into the turn, the pitch the angle
    of climb, and tan(bank) = speed x rate of turn / g, with g of the start; what the Earth's turn asks for sideways,
    2 mrad at 100 m/s, is not banked for. Start's pitch and roll, and any sway, come on top.

    Latitude and longitude are integrated from tick to tick (Runge-Kutta, fourth order) on speed, course and height,
    which are exact at every time, so that position and velocity agree to 2e-8 m. The increments are `increments` of the
    rows, so that strapdown leads from each row to the next. From the integrals of body rate they differ by the coning
    within a tick: below 1e-9 rad in a quick roll at 200 Hz, and with the cube of the tick.
    """

    def __init__(self, start: Placement, rate_hz: float, along: Track | None = None, body: Body | None = None) -> None:
        self.rate_hz = rate_hz
        self.failure = ""
        self._tick = 0
        self._track = along or lay_track(())
        body = body or Body()
        self._start = np.radians([start.lat_deg, start.lon_deg, start.heading_deg])
        self._height = float(start.alt_m)
        self._trim = np.radians([start.roll_deg, start.pitch_deg])
        self._sways = np.array([_sway(body.roll), _sway(body.pitch)])
        self._drift = body.drift_s
        self._g = float(gravity(self._start[0], self._height)) if body.turns == "banked" else math.inf
        self._position = np.zeros(2)  # latitude and longitude less those at the start [rad], at the last row
        self._ended = False

    def advance(self, ticks: int) -> TruthBlock:
        """The next ``ticks`` rows; fewer when it gets too near a pole, none after that."""
        first = self._tick
        if ticks == 0 or self._ended:
            return TruthBlock.empty(first, 0)
        # One row more in front, for the increments; the first row of a run stands in for the one before it.
        numbers = np.maximum(first - 1 + np.arange(ticks + 1), 0)
        middles = (numbers[:-1] + numbers[1:]) / 2 / self.rate_hz
        t = numbers / self.rate_hz
        path = self._path(t)
        position = np.empty((ticks + 1, 2))
        position[0] = self._position
        rows = _positions(position, path, self._path(middles), self._start[0], np.diff(t)) - 1
        if rows < ticks:
            self._ended = True
            limit = math.degrees(LATITUDE_LIMIT)
            self.failure = f"beyond {limit:g} deg of latitude there is no north to navigate by: the motion ends"
        position, path, t = position[: rows + 1], path[: rows + 1], t[: rows + 1]
        self._position = position[-1].copy()
        self._tick += rows
        lat = self._start[0] + position[:, 0]
        lon = np.asarray(wrap_longitude(self._start[1] + position[:, 1]))
        rates, slopes = self._track.rates(t), self._track.rates(t, 1)
        v_n, q_nb, omega_b, rest = _rows(t, lat, path, rates, slopes, self._g, self._drift, self._trim, self._sways)
        dtheta, dv = increments(t, lat, lon, path[:, 2].copy(), v_n, q_nb)
        if first == 0:
            dtheta[1:2] = dv[1:2] = 0.0  # no interval ends at the first row of a run
        block = TruthBlock.empty(first, rows)
        block.t[:], block.lat[:], block.lon[:], block.h[:] = t[1:], lat[1:], lon[1:], path[1:, 2]
        block.v_n[:], block.q_nb[:], block.omega_b[:] = v_n[1:], q_nb[1:], omega_b[1:]
        block.dtheta[:], block.dv[:] = dtheta[1:], dv[1:]
        block.airspeed[:], block.alpha[:], block.beta[:] = rest[1:, SPEED], rest[1:, ALPHA], rest[1:, BETA]
        block.pressure[:], block.temperature[:] = rest[1:, PRESSURE], rest[1:, TEMPERATURE]
        block.density[:] = rest[1:, DENSITY]
        block.commands[:, 0], block.commands[:, 1], block.commands[:, 2] = rest[1:, BANK], block.h, block.airspeed
        block.leg[:] = self._track.leg(block.t)
        return block

    def activity(self) -> str:
        """What is going on."""
        leg = self._track.leg(np.array([max(self._tick - 1, 0) / self.rate_hz]))[0]
        if self.failure:
            return self.failure
        if leg >= 0:
            return f"segment {leg + 1:.0f}/{self._track.legs.max() + 1:.0f}"
        return "under way" if self._track.path.c[-1, -1, 0] > 0 else "at rest"

    def _path(self, t: Array) -> Array:
        """Speed, course and height (N, 3)."""
        path: Array = self._track.path(t)
        path[:, 0] = np.maximum(path[:, 0], 0.0) + 0.0  # a rounding error of -0.0 would be a body that goes backwards
        path[:, 1] += self._start[2]
        path[:, 2] += self._height
        return path


def _sway(sway: Sway | None) -> tuple[float, float, float]:
    """Amplitude [rad], angular rate [rad/s] and phase [rad]."""
    if sway is None:
        return 0.0, 0.0, 0.0
    return math.radians(sway.amplitude_deg), 2 * math.pi / sway.period_s, math.radians(sway.phase_deg)


@njit
def _rates(lat: float, speed: float, course: float, h: float) -> tuple[float, float]:
    """Rates of latitude and longitude [rad/s] (Groves 2.111)."""
    R_M, R_N = radii(lat)
    return speed * math.cos(course) / (R_M + h), speed * math.sin(course) / ((R_N + h) * math.cos(lat))


@njit
def _positions(position: Array, path: Array, middle: Array, lat: float, dt: Array) -> int:
    """Fill ``position`` (N, 2) from its first row on, given the path (N, 3) at the rows and (N - 1, 3) between them.

    Returns how many rows there are short of the limit in latitude.
    """
    for k in range(len(dt)):
        here = lat + position[k, 0]
        north_1, east_1 = _rates(here, path[k, 0], path[k, 1], path[k, 2])
        half = 0.5 * dt[k]
        north_2, east_2 = _rates(here + half * north_1, middle[k, 0], middle[k, 1], middle[k, 2])
        north_3, east_3 = _rates(here + half * north_2, middle[k, 0], middle[k, 1], middle[k, 2])
        north_4, east_4 = _rates(here + dt[k] * north_3, path[k + 1, 0], path[k + 1, 1], path[k + 1, 2])
        position[k + 1, 0] = position[k, 0] + dt[k] / 6 * (north_1 + 2 * (north_2 + north_3) + north_4)
        position[k + 1, 1] = position[k, 1] + dt[k] / 6 * (east_1 + 2 * (east_2 + east_3) + east_4)
        if abs(lat + position[k + 1, 0]) > LATITUDE_LIMIT:
            return k + 1
    return len(position)


@njit
def _rows(
    t: Array,
    lat: Array,
    path: Array,
    rates: Array,
    slopes: Array,
    g: float,
    drift: float,
    trim: Array,
    sways: Array,
) -> tuple[Array, Array, Array, Array]:
    """Velocity (N, 3), attitude (N, 4), body rate (N, 3), and (N, 7) air data and bank, from path and rates (N, 3)."""
    n = len(t)
    v_n, q_nb, omega_b, rest = np.empty((n, 3)), np.empty((n, 4)), np.empty((n, 3)), np.empty((n, 7))
    euler, euler_rate = np.empty(2), np.empty(2)  # roll and pitch
    for k in range(n):
        speed, course, h = path[k, 0], path[k, 1], path[k, 2]
        acceleration, turn, climb = rates[k, 0], rates[k, 1], rates[k, 2]
        v_n[k, 0], v_n[k, 1], v_n[k, 2] = speed * math.cos(course), speed * math.sin(course), -climb

        # Roll, pitch and heading with their rates: derivatives of what stands in the class's docstring
        lean = speed * turn / g
        euler[0] = math.atan(lean)
        euler_rate[0] = (acceleration * turn + speed * slopes[k, 1]) / g / (1 + lean * lean)
        squared = speed * speed + climb * climb
        euler[1] = math.atan2(climb, speed)
        euler_rate[1] = (slopes[k, 2] * speed - climb * acceleration) / squared if squared > 0.0 else 0.0
        for i in range(2):
            amplitude, frequency, phase = sways[i, 0], sways[i, 1], sways[i, 2]
            euler[i] += trim[i] + amplitude * math.sin(frequency * t[k] + phase)
            euler_rate[i] += amplitude * frequency * math.cos(frequency * t[k] + phase)
        heading_rate = turn + drift * slopes[k, 1]
        q = quat_from_euler(euler[0], euler[1], course + drift * turn)
        q_bn = quat_conjugate(q)

        sin_roll, cos_roll = math.sin(euler[0]), math.cos(euler[0])
        sin_pitch, cos_pitch = math.sin(euler[1]), math.cos(euler[1])
        omega_en = transport_rate_n(lat[k], h, v_n[k])
        omega_ie = earth_rate_n(lat[k])
        omega = quat_rotate(q_bn, omega_en)
        earth = quat_rotate(q_bn, omega_ie)
        omega_b[k, 0] = omega[0] + earth[0] + euler_rate[0] - heading_rate * sin_pitch
        omega_b[k, 1] = omega[1] + earth[1] + euler_rate[1] * cos_roll + heading_rate * sin_roll * cos_pitch
        omega_b[k, 2] = omega[2] + earth[2] - euler_rate[1] * sin_roll + heading_rate * cos_roll * cos_pitch

        for i in range(4):
            q_nb[k, i] = q[i]
        air_b = quat_rotate(q_bn, v_n[k])
        airspeed = math.sqrt(squared)
        rest[k, SPEED] = airspeed
        rest[k, ALPHA] = math.atan2(air_b[2], air_b[0]) if airspeed > 1e-9 else 0.0
        rest[k, BETA] = math.asin(max(-1.0, min(1.0, air_b[1] / airspeed))) if airspeed > 1e-9 else 0.0
        rest[k, PRESSURE], rest[k, TEMPERATURE], rest[k, DENSITY] = isa_pressure(h), isa_temperature(h), isa_density(h)
        rest[k, BANK] = euler[0]
    return v_n, q_nb, omega_b, rest
