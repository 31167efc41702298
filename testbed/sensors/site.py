"""Where and when a run takes place, and the ground there."""

from __future__ import annotations

import datetime
from dataclasses import dataclass, field

from nav.terrain import Terrain
from testbed.motion.terrain import uneven
from testbed.noise import stream


@dataclass(frozen=True, slots=True)
class Site:
    """Where and when a run starts: date, geodetic ``lat``, ``lon`` [rad], ``h`` [m].

    ``terrain`` is the map of the ground that filters have, ``terrain_sigma`` [m] how well it is known as a whole and
    ``local_sigma`` [m] from place to place, over ``local_length`` [m]. ``finer`` is what the map was made of, where
    that has more points, and ``local_error`` [m] how far the ground is from it: 1 sigma, as all of these.
    """

    date: datetime.date
    lat: float
    lon: float
    h: float
    terrain: Terrain = field(default_factory=Terrain)
    terrain_sigma: float = 0.0
    local_sigma: float = 0.0
    local_length: float = 1.0
    finer: Terrain | None = None
    local_error: float = 0.0

    def raised(self, seed: int) -> float:
        """How much higher the ground is than the map says, in the run of this ``seed`` [m]."""
        return float(stream(seed, "terrain", "height").standard_normal()) * self.terrain_sigma

    def ground(self, seed: int) -> Terrain:
        """The ground in the run of this ``seed``, but for how much higher it is as a whole."""
        surveyed = self.finer or self.terrain
        return uneven(surveyed, self.local_error, self.local_length, stream(seed, "terrain", "local"))
