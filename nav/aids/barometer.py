"""A barometer: pressure altitude."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from nav._jit import lean, njit
from nav.aids.base import Kind, Measurement, OperatingPoint, range_problem
from nav.claims import Following
from nav.columns import column
from nav.earth import PRESSURE_EXPONENT, SEA_LEVEL_PRESSURE, TROPOPAUSE_PRESSURE, pressure_altitude
from nav.error_model import POS, Block, markov
from nav.samples import Array, BarometerSample, Sample

CLOSE_S = 0.25  # between neighbours: 10 m/s^2 bend the line by 0.1 m then [s]
SCATTER_SAMPLES, OUTLYING = 100, 10.0  # that are averaged; times the mean square that one of them counts at most
LEAST = 1 / 4  # of what is told to drive the wake
PRESSURE_LIMITS = (1_000.0, 120_000.0)  # what an instrument could possibly report [Pa]


@dataclass(frozen=True)
class BarometerAid:
    """Pressure altitude with a walking bias, weather and geoid before the first GNSS height tells, and the airframe's
    wake, a first-order Markov error. With ``follow_s`` that is claimed to be less as long as it is (`nav.claims`).

    Its noise is one of pressure, and as many more metres high up as air is thinner there (`thinness`). The walk of the
    bias and the wake are metres whatever the height.
    """

    sensor: str = "barometer"
    sigma: float = 0.5  # at sea level [m]
    bias_sigma: float = 300.0  # [m]
    bias_walk: float = 0.03  # [m/sqrt(s)]
    error_sigma: float = 0.0  # of the wake [m]
    error_correlation_s: float = 10.0
    scatters: bool = False  # its samples may scatter by more than sigma: see `Scatter`
    follow_s: float = 0.0  # over which what is claimed of the wake follows innovations, 0: it does not [s]

    parts = (("barometer", 1),)

    @property
    def following(self) -> dict[str, Following]:
        """See `nav.claims.FollowingAid`."""
        follows = self.follow_s and self.error_sigma
        return {"barometer": Following(self.follow_s, LEAST, 1.0, self.states[1], self.error_sigma)} if follows else {}

    @property
    def states(self) -> tuple[str, ...]:
        """See `Aid`."""
        return f"{self.sensor}_bias", f"{self.sensor}_error"

    def blocks(self) -> list[Block]:
        """See `Aid`."""
        bias, error = self.states
        return [
            Block(bias, 1, self.bias_sigma, self.bias_walk),
            markov(error, 1, self.error_sigma, self.error_correlation_s),
        ]

    @cached_property
    def _R(self) -> Array:
        return np.array([self.sigma**2])

    @property
    def plain(self) -> tuple[Kind, tuple[float]] | None:
        """See `PlainAid`: its variance."""
        return None if self.scatters else (Kind.BAROMETER, (self._R[0],))

    def numbers(self, samples: Sequence[BarometerSample]) -> Array:
        """See `PlainAid`."""
        return column(samples, "pressure")[:, None]

    def measure(self, part: str, sample: Sample, at: OperatingPoint) -> Measurement | None:
        """See `Aid`."""
        assert isinstance(sample, BarometerSample)
        bias, error = at.starts
        nu, H = barometer(at.state.lla, at.x, bias, error, pressure_altitude(sample.pressure))
        thin = thinness(sample.pressure)
        return Measurement(nu, H, self._R * (thin * thin))  # no power, which has other bits here than in a kernel


@dataclass
class Scatter:
    """The white noise that a barometer's own samples show, whatever a filter thinks of them.

    It is how far each is from the line through its neighbours, where these are so close that height can't have bent
    it: squares averaged over some seconds. Parts of one kind differ by ten times in it.
    """

    variance: float = 0.0  # [m^2]
    _taken: int = 0
    _last: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=3))  # times, pressure altitudes

    def heard(self, sample: BarometerSample) -> float:
        """The variance [m^2] with one more sample; one that it was told of before changes nothing."""
        last = self._last
        if last and sample.t <= last[-1][0]:
            return self.variance
        last.append((sample.t, pressure_altitude(sample.pressure)))
        if len(last) < 3 or sample.t - last[0][0] > 2 * CLOSE_S:
            return self.variance
        (t0, h0), (t1, h1), (t2, h2) = last
        share = (t1 - t0) / (t2 - t0)
        square = (h1 - h0 - share * (h2 - h0)) ** 2 / (1 + share**2 + (1 - share) ** 2)
        if self._taken >= SCATTER_SAMPLES:
            square = min(square, OUTLYING * self.variance)
        self._taken = min(self._taken + 1, SCATTER_SAMPLES)
        self.variance += (square - self.variance) / self._taken
        return self.variance


def problem(sample: BarometerSample) -> str:
    """See `nav.aids.problem`."""
    return range_problem("pressure", sample.pressure, PRESSURE_LIMITS)


@njit
def thinness(pressure: float) -> float:
    """How many more metres a pascal is worth at a ``pressure`` p [Pa] than at sea level.

    By the density of the standard atmosphere, rho_0 / rho = (p_0 / p) (T / T_0) with T / T_0 = (p / p_0)^(1 / 5.256) up
    to the tropopause. Gravity, 0.3 % less at 10 km, is left out.
    """
    warmth: float = (max(pressure, TROPOPAUSE_PRESSURE) / SEA_LEVEL_PRESSURE) ** (1 / PRESSURE_EXPONENT)
    return SEA_LEVEL_PRESSURE / pressure * warmth


@njit
def barometer(lla: Array, x: Array, bias: int, error: int, pressure_altitude: float) -> tuple[Array, Array]:
    """Pressure altitude [m]: h + bias + error; each is where its state is, -1 for none."""
    nu, H = np.empty(1), np.zeros((1, len(x)))
    put_barometer(nu, H, lla, x, bias, error, pressure_altitude)
    return nu, H


@lean
def put_barometer(nu: Array, H: Array, lla: Array, x: Array, bias: int, error: int, pressure_altitude: float) -> None:
    """`barometer` into ``nu`` (1,) and zeros ``H`` (1, n)."""
    nu[0] = pressure_altitude - lla[2]
    H[0, POS + 2] = -1.0
    for state in (bias, error):
        if state >= 0:
            H[0, state] = 1.0
            nu[0] -= x[state]
