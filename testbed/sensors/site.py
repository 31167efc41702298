"""Where and when a run takes place, and the ground there."""

from __future__ import annotations

import datetime
from dataclasses import dataclass, field

from nav.terrain import Terrain
from testbed.noise import stream


@dataclass(frozen=True, slots=True)
class Site:
    """Where and when a run starts: date, geodetic ``lat``, ``lon`` [rad], ``h`` [m].

    ``terrain`` is the map of the ground, ``terrain_sigma`` [m] how well it is known.
    """

    date: datetime.date
    lat: float
    lon: float
    h: float
    terrain: Terrain = field(default_factory=Terrain)
    terrain_sigma: float = 0.0

    def raised(self, seed: int) -> float:
        """How much higher the ground is than the map says, in the run of this ``seed`` [m]."""
        return float(stream(seed, "terrain", "height").standard_normal()) * self.terrain_sigma
