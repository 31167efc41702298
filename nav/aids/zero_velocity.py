"""A vehicle that stands: its velocity over ground is zero."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nav.aids.base import Measurement, OperatingPoint
from nav.error_model import VEL, Block
from nav.samples import Array, Sample


@dataclass(frozen=True)
class ZeroVelocityAid:
    """0 = v + noise of ``sigma`` [m/s] on each axis: how fast what stands may move, shaken by wind or engine.

    Told of by samples of no instrument: `nav.standing.Standing`.
    """

    sensor: str
    sigma: float  # [m/s]

    parts = (("zero_velocity", 3),)
    states = ()

    def blocks(self) -> list[Block]:
        """See `Aid`."""
        return []

    @cached_property
    def _R(self) -> Array:
        return np.full(3, self.sigma**2)

    def measure(self, part: str, sample: Sample, at: OperatingPoint) -> Measurement | None:
        """See `Aid`."""
        H = np.zeros((3, len(at.x)))
        H[:, VEL : VEL + 3] = np.eye(3)
        return Measurement(-at.state.v_n, H, self._R)
