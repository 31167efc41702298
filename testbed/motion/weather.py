"""The air that a flight meets, gusts aside: mean wind over time, place and height, and what goes up and down."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from nav.earth import radii, wrap_longitude
from nav.samples import Array
from nav.terrain import Terrain
from nav.terrain import ground as height_of_ground
from testbed.motion.sections import FlightTruth, Front, Start, Wind
from testbed.motion.updrafts import UpdraftField
from testbed.motion.wind_table import read
from testbed.noise import Process, stream
from testbed.schema import Section

Velocity = tuple[float, float, float]  # of the air, north, east, down [m/s]

WIND_CHANGE_S = 5.0  # time constant of a change of wind in flight, as in ArduPilot's simulation (SIM_WIND_TC)
UNKNOWN_WALK = 0.015  # what is expected of a mean wind that nothing is said about [m/s/sqrt(s)]: 1 m/s in 75 min


class Weather:
    """The mean wind and the updrafts of one run, asked for in equal steps of time from its start on.

    Velocity = base wind, or that it becomes by a front, times the boundary layer's factor; plus random walk and
    Gauss-Markov part; plus gradient times distance; plus updrafts. What is drawn depends on seed and step alone.
    Boundary layer and updrafts lie on ``ground``, profiles and tables go by altitude. ``changes`` says whether it may
    ever be another than at the start. Raises UserError where the file of a table can't be read.
    """

    def __init__(self, wind: Wind, start: Start, ground: Terrain, seed: int, period_s: float) -> None:
        self._wind, self._start, self._ground, self._period = wind, start, ground, period_s
        self._base = blowing(wind.from_deg, wind.speed_mps)
        self._asked: tuple[float, float] | None = None
        self._profile = [(alt, *blowing(from_deg, speed)) for alt, from_deg, speed in wind.profile]
        self._table = read(Path(wind.file)) if wind.file else None
        self._gradient = np.array(wind.gradient_mps_per_km) / 1000
        self._drawn, self._drift = _drawn(wind, seed, period_s)
        updrafts = wind.updrafts
        self._updrafts = UpdraftField(updrafts.w_star_mps, updrafts.depth_m, seed) if updrafts else None
        self._steps = 0
        self.changes = not wind.one or bool(self._drawn) or updrafts is not None or bool(self._gradient.any())

    def start(self, h: float) -> tuple[float, float]:
        """Horizontal velocity [m/s] over the place of the start at a height ``h`` [m], which is no step yet."""
        lat, lon = math.radians(self._start.lat_deg), math.radians(self._start.lon_deg)
        return self._horizontal(0.0, h, self._over_ground(lat, lon, h), 0.0, 0.0)

    def step(self, lat: float, lon: float, h: float) -> Velocity:
        """Velocity at the next step, the first being at time zero, and a place: ``lat``, ``lon`` [rad], ``h`` [m]."""
        t = self._steps * self._period
        if self._asked is not None:
            share = -math.expm1(-self._period / WIND_CHANGE_S)
            north, east = self._base
            self._base = north + share * (self._asked[0] - north), east + share * (self._asked[1] - east)
        away, over_ground = self._away(lat, lon, h), self._over_ground(lat, lon, h)
        v_north, v_east = self._horizontal(t, h, over_ground, *away)
        up = self._updrafts.up(*away, over_ground) if self._updrafts else 0.0
        self._steps += 1
        if self._drawn:
            self._drift = sum(part.take(1)[0] for part in self._drawn)
        return v_north, v_east, 0.0 - up

    def blow(self, from_deg: float, speed_mps: float) -> None:
        """Let the base wind, where there is one, become this with a time constant of `WIND_CHANGE_S`."""
        self._asked, self.changes = blowing(from_deg, speed_mps), True

    def _horizontal(self, t: float, h: float, over_ground: float, north: float, east: float) -> tuple[float, float]:
        """Velocity north, east at a time [s], heights [m], and metres north and east of the start."""
        if self._table is not None:
            v = self._table.at(t, h)
        elif self._profile:
            alts, norths, easts = zip(*self._profile, strict=True)
            v = float(np.interp(h, alts, norths)), float(np.interp(h, alts, easts))
        else:
            v = self._base
        if self._wind.front is not None:
            v = _changed(v, self._wind.front, t)
        if self._wind.boundary_layer is not None:
            factor = self._wind.boundary_layer.factor(over_ground)
            v = factor * v[0], factor * v[1]
        more = self._drift + self._gradient @ (north, east)
        return v[0] + float(more[0]), v[1] + float(more[1])

    def _over_ground(self, lat: float, lon: float, h: float) -> float:
        """The height over ground [m]; ``h`` where nothing asks for it."""
        if self._wind.boundary_layer is None and self._updrafts is None:
            return h
        return h - height_of_ground(lat, lon, self._ground.heights, self._ground.grid)[0]

    def _away(self, lat: float, lon: float, h: float) -> tuple[float, float]:
        """Metres north and east of the start."""
        first = math.radians(self._start.lat_deg)
        R_M, R_N = radii(first)
        east = float(wrap_longitude(lon - math.radians(self._start.lon_deg)))
        return (lat - first) * (R_M + h), east * (R_N + h) * math.cos(first)


def expected_walk(truth: Section) -> float:
    """How fast the mean wind of a motion wanders [m/s/sqrt(s)]; `UNKNOWN_WALK` where nothing is said of it.

    Over times short beside its correlation time, a Gauss-Markov part walks by sigma sqrt(2 / tau).
    """
    if not isinstance(truth, FlightTruth):
        return UNKNOWN_WALK
    wind = truth.wind
    back = wind.gauss_markov
    wanders = back.sigma_mps * math.sqrt(2 / back.correlation_s) if back else 0.0
    said = "walk_mps_per_sqrt_s" in wind.model_fields_set  # of a wind that keeps still, too
    return math.hypot(wind.walk_mps_per_sqrt_s, wanders) or (0.0 if said else UNKNOWN_WALK)


def strongest(wind: Wind) -> float:
    """The strongest mean wind that is foreseen [m/s]. Raises UserError where the file of a table can't be read."""
    if wind.file:
        return read(Path(wind.file)).strongest
    speeds = [wind.speed_mps, *(speed for _, _, speed in wind.profile)]
    if wind.front:
        speeds.append(wind.front.speed_mps)
    factor = wind.boundary_layer.factor(wind.boundary_layer.top_m) if wind.boundary_layer else 1.0
    return max(speeds) * factor


def blowing(from_deg: float, speed_mps: float) -> tuple[float, float]:
    """Velocity of the air north, east [m/s] of a wind that comes from a true direction."""
    heading = math.radians(from_deg)
    return -(speed_mps * math.cos(heading)), -(speed_mps * math.sin(heading))


def _drawn(wind: Wind, seed: int, period_s: float) -> tuple[list[Process], Array]:
    """The processes that are summed, and their sum (2,) at time zero."""
    parts, first = [], np.zeros(2)
    if wind.walk_mps_per_sqrt_s > 0:
        density = [wind.walk_mps_per_sqrt_s] * 2
        parts.append(Process.random_walk(stream(seed, "wind", "walk"), density, period_s))
    if wind.gauss_markov is not None and wind.gauss_markov.sigma_mps > 0:
        sigma, tau = wind.gauss_markov.sigma_mps, wind.gauss_markov.correlation_s
        parts.append(Process.gauss_markov(stream(seed, "wind", "gauss_markov"), [sigma] * 2, [tau] * 2, period_s))
        first = parts[-1].take(1)[0]
    return parts, first


def _changed(v: tuple[float, float], front: Front, t: float) -> tuple[float, float]:
    """The wind that another has become by a front."""
    s = min(max((t - front.time_s) / front.width_s + 0.5, 0.0), 1.0)
    share = s * s * (3 - 2 * s)
    north, east = blowing(front.from_deg, front.speed_mps)
    return v[0] + share * (north - v[0]), v[1] + share * (east - v[1])
