"""Lines of sight to the ground, for every sensor that looks down."""

from __future__ import annotations

import numpy as np

from nav._jit import njit
from nav.rotation import dcm_from_quat
from nav.samples import Array
from nav.terrain import Terrain, slant_range


def lines_of_sight(lat: Array, lon: Array, h: Array, q_nb: Array, raised: float, terrain: Terrain) -> Array:
    """Range (n,) [m] along body z to the ground, ``raised`` [m] over the map; NaN where none is met."""
    return _lines_of_sight(lat, lon, h, np.ascontiguousarray(q_nb), raised, terrain.heights, terrain.grid)


@njit
def _lines_of_sight(lat: Array, lon: Array, h: Array, q_nb: Array, raised: float, heights: Array, grid: Array) -> Array:
    found, down = np.empty(len(lat)), np.empty(3)
    for k in range(len(lat)):
        C_nb = dcm_from_quat(q_nb[k])
        for i in range(3):
            down[i] = C_nb[i, 2]
        found[k] = slant_range(np.array([lat[k], lon[k], h[k]]), down, raised, heights, grid)[0]
    return found
