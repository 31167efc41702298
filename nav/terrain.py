"""The ground below: heights on a grid, and how far away it is along a line of sight."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from nav._jit import njit
from nav.earth import radii
from nav.samples import Array

STEEPEST = 0.3  # sine of the angle below the horizon from which on a line of sight is followed to the ground
LEAST_REACH = 0.1  # over which a slope is taken [m]
STEPS, CLOSE_M = 50, 0.01  # until a point of a line of sight is this close to the ground


@dataclass(frozen=True, eq=False)
class Terrain:
    """Heights of the ground above the ellipsoid (rows, columns) [m], bilinear between, beyond its edge as at the edge.

    ``grid`` (4,) [rad]: latitude of the first row, northward step of the rows, longitude of the first column, eastward
    step of the columns. One height is flat ground.
    """

    heights: Array = field(default_factory=lambda: np.zeros((1, 1)))
    grid: Array = field(default_factory=lambda: np.array([0.0, 1.0, 0.0, 1.0]))

    @staticmethod
    def flat(height: float) -> Terrain:
        """Level ground at a ``height`` [m]."""
        return Terrain(np.array([[height]]))


@njit
def ground(lat: float, lon: float, heights: Array, grid: Array) -> tuple[float, float, float]:
    """Height of the ground [m] and its slope, per metre north and east [1]."""
    rows, columns = heights.shape
    if rows == 1 or columns == 1:
        return heights[0, 0], 0.0, 0.0
    row, column = (lat - grid[0]) / grid[1], (lon - grid[2]) / grid[3]
    around = 2.0 * math.pi / grid[3]  # columns; the map may lie across the date line
    column -= around * math.floor((column - 0.5 * (columns - 1)) / around + 0.5)
    inside_n, inside_e = 0.0 <= row <= rows - 1, 0.0 <= column <= columns - 1
    row, column = min(max(row, 0.0), rows - 1.0), min(max(column, 0.0), columns - 1.0)
    i, j = min(int(row), rows - 2), min(int(column), columns - 2)
    y, x = row - i, column - j
    south = (1.0 - x) * heights[i, j] + x * heights[i, j + 1]
    north = (1.0 - x) * heights[i + 1, j] + x * heights[i + 1, j + 1]
    west = (1.0 - y) * heights[i, j] + y * heights[i + 1, j]
    east = (1.0 - y) * heights[i, j + 1] + y * heights[i + 1, j + 1]
    R_M, R_N = radii(lat)
    slope_n = (north - south) / (grid[1] * R_M) if inside_n else 0.0
    slope_e = (east - west) / (grid[3] * R_N * math.cos(lat)) if inside_e else 0.0
    return (1.0 - y) * south + y * north, slope_n, slope_e


@njit
def slope(lat: float, lon: float, reach: float, heights: Array, grid: Array) -> tuple[float, float]:
    """Slope of the ground, per metre north and east [1], from its heights ``reach`` [m] to either side."""
    R_M, R_N = radii(lat)
    reach = max(reach, LEAST_REACH)
    north, east = reach / R_M, reach / (R_N * math.cos(lat))
    up_n = ground(lat + north, lon, heights, grid)[0] - ground(lat - north, lon, heights, grid)[0]
    up_e = ground(lat, lon + east, heights, grid)[0] - ground(lat, lon - east, heights, grid)[0]
    return 0.5 * up_n / reach, 0.5 * up_e / reach


@njit
def slant_range(
    lla: Array, direction_n: Array, raised: float, heights: Array, grid: Array
) -> tuple[float, float, float]:
    """Range [m] along a unit vector ``direction_n`` (3,) to the ground ``raised`` [m] over the map; its place [rad].

    The line is straight over a level Earth: over a kilometre it is 8 cm too high. NaN where it looks too near the
    horizon, where the ground is above, and where it meets none.
    """
    nothing = math.nan, math.nan, math.nan
    if direction_n[2] < STEEPEST:
        return nothing
    R_M, R_N = radii(lla[0])
    north, east = 1.0 / (R_M + lla[2]), 1.0 / ((R_N + lla[2]) * math.cos(lla[0]))
    length = 0.0
    for _ in range(STEPS):
        lat = lla[0] + length * direction_n[0] * north
        lon = lla[1] + length * direction_n[1] * east
        height, slope_n, slope_e = ground(lat, lon, heights, grid)
        clearance = lla[2] - length * direction_n[2] - height - raised
        closing = direction_n[2] + slope_n * direction_n[0] + slope_e * direction_n[1]
        if abs(clearance) < CLOSE_M:
            length += clearance / closing
            return (length, lat, lon) if length > 0.0 and closing > 0.0 else nothing
        length += clearance / max(closing, direction_n[2])  # short of the ground where that falls away
    return nothing
