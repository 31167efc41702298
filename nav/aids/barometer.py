"""A barometer: pressure altitude."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nav._jit import njit
from nav.aids.base import Measurement, OperatingPoint, range_problem
from nav.earth import pressure_altitude
from nav.error_model import POS, Block
from nav.samples import Array, BarometerSample, Sample

PRESSURE_LIMITS = (1_000.0, 120_000.0)  # what an instrument could possibly report [Pa]


@dataclass(frozen=True)
class BarometerAid:
    """Pressure altitude with a walking bias: weather and geoid, before the first GNSS height tells."""

    sensor: str = "barometer"
    sigma: float = 0.5  # [m]
    bias_sigma: float = 300.0  # [m]
    bias_walk: float = 0.03  # [m/sqrt(s)]

    parts = (("barometer", 1),)

    @property
    def states(self) -> tuple[str, ...]:
        """See `Aid`."""
        return (f"{self.sensor}_bias",)

    def blocks(self) -> list[Block]:
        """See `Aid`."""
        return [Block(self.states[0], 1, self.bias_sigma, self.bias_walk)]

    @cached_property
    def _R(self) -> Array:
        return np.array([self.sigma**2])

    def measure(self, part: str, sample: Sample, at: OperatingPoint) -> Measurement | None:
        """See `Aid`."""
        assert isinstance(sample, BarometerSample)
        nu, H = barometer(at.state.lla, at.x, at.starts[0], pressure_altitude(sample.pressure))
        return Measurement(nu, H, self._R)


def problem(sample: BarometerSample) -> str:
    """See `nav.aids.problem`."""
    return range_problem("pressure", sample.pressure, PRESSURE_LIMITS)


@njit
def barometer(lla: Array, x: Array, barometer_bias: int, pressure_altitude: float) -> tuple[Array, Array]:
    """Pressure altitude [m]: h + bias."""
    nu = np.array([pressure_altitude - lla[2] - x[barometer_bias]])
    H = np.zeros((1, len(x)))
    H[0, POS + 2] = -1.0
    H[0, barometer_bias] = 1.0
    return nu, H
