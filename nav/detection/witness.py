"""The wind as a witness: whether a filter or the fixes that contradict it were led astray."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from nav.samples import Array

SURE = math.log(20.0)  # odds for the fixes from which on they are believed against the filter [nats]
STEP_S, MEMORY_S = 20.0, 600.0  # between two memories, and how old the oldest is


@dataclass
class WindMemory:
    """The mean wind as it was estimated while fixes were fused: its random walk and gusts are known, 1-sigma per axis.

    Who drags a receiver away drags along what is thought of the air: airspeed says how fast the air is passed, so a
    wrong velocity over ground makes a wrong wind. A wind that comes back to what it was with the velocity of the fixes
    speaks for them, one that leaves it for the filter.
    """

    walk: float  # [m/s/sqrt(s)]
    gust: float  # [m/s]
    _winds: deque[tuple[float, Array, Array]] = field(default_factory=deque)

    def due(self, t: float) -> bool:
        """Whether `remember` would keep a wind of ``t`` [s]: one in `STEP_S`."""
        return not (self._winds and t - self._winds[-1][0] < STEP_S)

    def remember(self, t: float, wind: Array, variance: Array) -> None:
        """The mean wind (2,) [m/s], NE, and its variance (2,), at ``t`` [s], if one is `due`."""
        if not self.due(t):
            return
        self._winds.append((t, wind.copy(), variance.copy()))
        while t - self._winds[0][0] > MEMORY_S:
            self._winds.popleft()

    def odds(self, t: float, air: Array, change: Array) -> float:
        """Log of the odds for the fixes against the filter [nats], by the memory that tells most; zero without one.

        ``air`` (2,) is the velocity of the air by the filter, gusts included; ``change`` (2,) the velocity over ground
        of a fix less the filter's, by which the air's would be another. Both are normal about the mean wind that was.
        """
        told = [0.0]
        for then, wind, variance in self._winds:
            s2 = variance + self.gust**2 + self.walk**2 * (t - then)
            by_filter, by_fix = air - wind, air + change - wind
            told.append(float(np.sum((by_filter**2 - by_fix**2) / (2 * s2))))
        return max(told, key=abs)
