"""The wind as somebody else measured it, some time ago: told by radio."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nav._jit import njit
from nav.aids.airspeed import AIRSPEED_LIMITS
from nav.aids.base import Measurement, OperatingPoint, range_problem
from nav.error_model import Block, markov
from nav.samples import Array, Sample, WindSample


@dataclass(frozen=True)
class WindReportAid:
    """Mean wind, north and east, as a measurement of a filter's wind; without one (`AirspeedAid`) it tells nothing.

    The report is of the wind an ``age`` ago, and of another place. Since then the mean wind has walked by
    ``wind_walk`` sqrt(age) [m/s], which is counted as white noise beside the report's own: R = sigma^2 + wind_walk^2
    age. That loses something, as the filter that remembered its own wind of then would know part of that walk. The
    other place is an error of ``error_sigma`` [m/s] (Markov), and ``gust_sigma`` [m/s] what is left of gusts in the
    mean.
    """

    sensor: str = "wind_report"
    error_sigma: float = 0.0
    error_correlation_s: float = 3600.0
    gust_sigma: float = 0.0
    wind_walk: float = 0.03  # [m/s/sqrt(s)]

    parts = (("wind_report", 2),)

    @property
    def states(self) -> tuple[str, ...]:
        """See `Aid`."""
        return "wind", f"{self.sensor}_error"

    def blocks(self) -> list[Block]:
        """See `Aid`."""
        return [markov(self.states[1], 2, self.error_sigma, self.error_correlation_s)]

    def measure(self, part: str, sample: Sample, at: OperatingPoint) -> Measurement | None:
        """See `Aid`."""
        assert isinstance(sample, WindSample)
        wind, error = at.starts
        if wind < 0:
            return None
        nu, H = wind_report(at.x, wind, error, sample.wind_n)
        return Measurement(nu, H, np.full(2, sample.sigma**2 + self.gust_sigma**2 + self.wind_walk**2 * sample.age))


def problem(sample: WindSample) -> str:
    """See `nav.aids.problem`."""
    speed = float(np.hypot(*sample.wind_n))
    return (
        range_problem("wind", speed, (0.0, AIRSPEED_LIMITS[1]))
        or range_problem("age", sample.age, (0.0, np.inf))
        or range_problem("sigma", sample.sigma, (0.0, AIRSPEED_LIMITS[1]))
    )


@njit
def wind_report(x: Array, wind: int, error: int, wind_n: Array) -> tuple[Array, Array]:
    """Mean wind north and east [m/s], plus the error of the report."""
    nu, H = np.empty(2), np.zeros((2, len(x)))
    for i in range(2):
        nu[i] = wind_n[i] - x[wind + i]
        H[i, wind + i] = 1.0
        if error >= 0:
            nu[i] -= x[error + i]
            H[i, error + i] = 1.0
    return nu, H
