"""A position found by other means than GNSS: a transponder, terrain."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nav._jit import njit
from nav.aids.base import Axes, Measurement, OperatingPoint, position_problem
from nav.aids.gnss import gnss_position
from nav.error_model import Block
from nav.samples import Array, PositionSample, Sample


@dataclass(frozen=True)
class PositionFixAid:
    """Position from a transponder or from terrain; ``sigma`` north, east, down [m]; with ``height`` or without."""

    sensor: str = "position_fix"
    sigma: Axes = (10.0, 10.0, 10.0)
    height: bool = True
    arm_b: Axes = (0.0, 0.0, 0.0)  # IMU to the sensor's point [m]

    states = ()

    @property
    def parts(self) -> tuple[tuple[str, int], ...]:
        """See `Aid`."""
        return (("position_fix", 3 if self.height else 2),)

    def blocks(self) -> list[Block]:
        """See `Aid`."""
        return []

    @cached_property
    def _arm(self) -> Array:
        return np.array(self.arm_b, dtype=float)

    @cached_property
    def _R(self) -> Array:
        return np.array(self.sigma)[: 3 if self.height else 2] ** 2

    def measure(self, part: str, sample: Sample, at: OperatingPoint) -> Measurement | None:
        """See `Aid`."""
        assert isinstance(sample, PositionSample)
        h = sample.h if self.height else math.nan
        state = at.state
        nu, H = position_fix(state.q_nb, state.lla, at.x, self._arm, sample.lat, sample.lon, h)
        return Measurement(nu, H, self._R) if len(nu) == len(self._R) else None


def problem(sample: PositionSample) -> str:
    """See `nav.aids.problem`; without height it is NaN."""
    return position_problem(sample.lat, sample.lon, 0.0 if math.isnan(sample.h) else sample.h)


@njit
def position_fix(
    q_nb: Array, lla: Array, x: Array, arm_b: Array, lat: float, lon: float, h: float
) -> tuple[Array, Array]:
    """The sensor's position [m], north, east and, unless ``h`` is NaN, down: p + C_nb arm_b."""
    rows = 2 if math.isnan(h) else 3
    nu, H = gnss_position(q_nb, lla, x, arm_b, -1, lat, lon, lla[2] if rows == 2 else h)
    return nu[:rows], H[:rows]
