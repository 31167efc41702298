"""Thermals with sink between them: M. J. Allen, *Updraft Model for Development of Autonomous Soaring Uninhabited Air
Vehicles*, NASA/TM-2006-214019, 2006. Equations are numbered as there.
"""

from __future__ import annotations

import math

import numpy as np

from nav._jit import njit
from nav.samples import Array
from testbed.noise import stream

SIDE = 5.0  # of the square that repeats itself, over the depth of the mixing layer
SPACING_HEIGHT = 0.4  # share of the depth at which updrafts are counted
FLATTEST = 600.0  # outer radius from which on the shape stays [m]

# r1/r2 and k1, k2, k3, k4 of each shape (table 3). k4 is that of the program in the report's appendix B, which with it
# brings the updraft to nothing at r2; the table prints another column there.
SHAPES = np.array(
    [
        (0.14, 1.5352, 2.5826, -0.0113, -0.1950),
        (0.25, 1.5265, 3.6054, -0.0176, -0.1265),
        (0.36, 1.4866, 4.8356, -0.0320, -0.0818),
        (0.47, 1.2042, 7.7904, 0.0848, -0.0445),
        (0.58, 0.8816, 13.9720, 0.3404, -0.0216),
        (0.69, 0.7067, 23.9940, 0.5689, -0.0099),
        (0.80, 0.6189, 42.7965, 0.7157, -0.0033),
    ]
)


class UpdraftField:
    """Updrafts that stand still over a square around the start, which repeats itself in all directions.

    ``w_star`` is the convective velocity scale [m/s], ``depth`` that of the mixing layer [m]. There are
    N = 0.6 A / (depth r2) of them in the area A (20), each drawn anywhere in it.
    """

    def __init__(self, w_star: float, depth: float, seed: int) -> None:
        self.w_star, self.depth = w_star, depth
        self.side = SIDE * depth
        count = round(0.6 * self.side**2 / (depth * outer_radius(SPACING_HEIGHT * depth, depth)))
        self.places = stream(seed, "wind", "updrafts").uniform(0.0, self.side, (count, 2))

    def up(self, north: float, east: float, h: float) -> float:
        """Vertical velocity of the air [m/s], up positive, at metres north and east of the start, ``h`` over ground."""
        apart = self.places - (north, east)
        apart -= self.side * np.round(apart / self.side)
        nearest = math.sqrt(float((apart * apart).sum(axis=1).min()))
        share = len(self.places) * math.pi / self.side**2
        return float(velocity(nearest, h, self.w_star, self.depth, share, SHAPES))


@njit
def outer_radius(h: float, depth: float) -> float:
    """Radius [m] of an updraft at a height over ground [m] in a mixing layer of this depth [m] (12), at least 10 m."""
    z = max(h, 0.0) / depth
    return float(max(10.0, 0.102 * math.pow(z, 1 / 3) * (1 - 0.25 * z) * depth))


@njit
def velocity(r: float, h: float, w_star: float, depth: float, share: float, shapes: Array) -> float:
    """Vertical velocity [m/s], up positive, at ``r`` [m] from the nearest updraft, at ``h`` over ground [m].

    ``share`` is the number of updrafts per area times pi [1/m^2]. The blend into the sink (23) is applied from the
    centre on, where it is nothing, not from the inner radius, at which it would be a step.
    """
    z = h / depth
    if z <= 0.0:
        return 0.0
    mean = w_star * math.pow(z, 1 / 3) * (1 - 1.1 * z)  # over the updraft (11)
    if mean <= 0.0:  # from 0.91 of the depth on
        return 0.0
    r2 = outer_radius(h, depth)
    ratio = 0.0011 * r2 + 0.14 if r2 < FLATTEST else 0.8  # (13)
    peak = 3 * mean * (1 - ratio) / (1 - ratio * ratio * ratio)  # (15)
    k = shapes[np.argmin(np.abs(shapes[:, 0] - ratio))]
    x = r / r2
    bell = max(1 / (1 + math.pow(abs(k[1] * x + k[3]), k[2])) + k[4] * x, 0.0)  # (16)
    strength = 2.5 * (z - 0.5) if 0.5 < z <= 0.9 else 0.0  # of the sink at the edge (18)
    edge = min(math.pi / 6 * math.sin(math.pi * x), 0.0) if ratio < x < 2 else 0.0  # (17)
    inside = share * r2 * r2  # of the area
    sink = min(-inside * mean * (1 - strength) / (1 - inside), 0.0)  # (21, 22)
    return float((bell * peak + strength * edge * mean) * (1 - sink / peak) + sink)  # (23)
