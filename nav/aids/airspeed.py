"""A pitot tube: airspeed along body x, and the constraint that no air comes from the side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nav._jit import lean, njit
from nav.aids.base import Kind, Measurement, OperatingPoint, Ruling, range_problem
from nav.columns import column
from nav.earth import SEA_LEVEL_DENSITY, isa_density
from nav.error_model import PHI, POS, VEL, Block, markov
from nav.rotation import Three, cross_components, dcm_components, dot
from nav.samples import AirspeedSample, Array, Outcome, Sample

AIRSPEED_LIMITS = (-10.0, 300.0)  # what an instrument could possibly report [m/s]
TOO_SLOW = Ruling(Outcome.OUT_OF_RANGE, "too slow for the pitot tube")
STANDING = Ruling(Outcome.OUT_OF_RANGE, "standing, and blown upon")
SLOW = 10.0  # equivalent, below which pressures are so small that their errors count as speeds [m/s]
STANDING_SPEED = 2.0  # over ground: what blows at a vehicle at rest tells of gusts near the ground only [m/s]
SILENT_S, SILENT_INTERVALS = 1.0, 3.0  # without a sample for longer than both, a pitot tube has fallen silent
TIME_TOLERANCE = 1e-4  # [s]


@dataclass(frozen=True)
class AirspeedAid:
    """Airspeed along body x, and the constraint of no sideslip (None leaves it out); a filter has one wind.

    ``sigma`` is that of `SLOW` and faster. Where one of a smaller ``minimum`` is used below, it grows as 1/EAS, as
    errors of pressure do.

    A sample of no airspeed, NaN, stands for a tube that has fallen silent (`Silence`): of that the constraint is left,
    as long as the filter's own velocity through the air is that of flight.
    """

    sensor: str = "airspeed"
    sigma: float = 0.5  # [m/s]
    scale_sigma: float = 0.0  # [1]
    minimum: float = SLOW  # equivalent; below it neither airspeed nor sideslip is used [m/s]
    sideslip_sigma: float | None = 1.0  # [m/s]
    wind_sigma: float = 8.0  # per horizontal axis, before anything is known [m/s]
    wind_walk: float = 0.03  # [m/s/sqrt(s)]
    gust_sigma: float = 0.0  # turbulence as a Markov part of the wind [m/s]
    gust_correlation_s: float = 5.0

    @property
    def parts(self) -> tuple[tuple[str, int], ...]:
        """See `Aid`."""
        return (("airspeed", 1),) if self.sideslip_sigma is None else (("airspeed", 1), ("sideslip", 1))

    @property
    def states(self) -> tuple[str, ...]:
        """See `Aid`."""
        return "wind", "gust", f"{self.sensor}_scale"

    def blocks(self) -> list[Block]:
        """See `Aid`."""
        wind, gust, scale = self.states
        return [
            Block(wind, 2, self.wind_sigma, self.wind_walk),
            markov(gust, 2, self.gust_sigma, self.gust_correlation_s),
            Block(scale, 1, self.scale_sigma),
        ]

    @cached_property
    def _R(self) -> tuple[Array, Array]:
        return np.array([self.sigma**2]), np.array([(self.sideslip_sigma or 0.0) ** 2])

    @property
    def plain(self) -> tuple[Kind, tuple[float, ...]]:
        """See `PlainAid`: its two variances, and below what it tells nothing."""
        return Kind.AIRSPEED, (self._R[0][0], self._R[1][0], self.minimum)

    def numbers(self, samples: Sequence[AirspeedSample]) -> Array:
        """See `PlainAid`."""
        return column(samples, "eas")[:, None]

    def measure(self, part: str, sample: Sample, at: OperatingPoint) -> Measurement | None:
        """See `Aid`."""
        assert isinstance(sample, AirspeedSample)
        state, (wind, gust, scale) = at.state, at.starts
        eas = sample.eas
        if math.isnan(eas):
            if part == "airspeed":
                return None
            eas = -float(airspeed(state.q_nb, state.v_n, state.lla, at.x, wind, gust, scale, 0.0)[0][0])
        slow = None
        if is_slow(eas, state.v_n, self.minimum):
            slow = STANDING if eas >= self.minimum else TOO_SLOW
        if part == "airspeed":
            nu, H = airspeed(state.q_nb, state.v_n, state.lla, at.x, wind, gust, scale, sample.eas)
            return Measurement(nu, H, self._R[0] if slow else self._R[0] * widened(eas), slow)
        nu, H = sideslip(state.q_nb, state.v_n, at.x, wind, gust)
        return Measurement(nu, H, self._R[1], slow)


@dataclass
class Silence:
    """Watches whether a pitot tube still says anything.

    That no air comes from the side is known without it: how fast the aircraft flies hardly matters, so that
    the filter's own velocity through the air will do.
    """

    sensor: str
    _heard: float = -math.inf  # the latest sample [s]
    _interval: float = math.inf  # between the latest two
    _stood_in: float = -math.inf

    def hears(self, times: Sequence[float], until: float) -> bool:
        """Hear samples of the sensor at ``times`` [s], and others up to ``until``.

        False, and nothing is heard, where it may have been silent for so long that something would have stood in.
        """
        heard, interval = self._heard, self._interval
        for t in times:
            if t - heard > max(SILENT_S, SILENT_INTERVALS * interval):
                return False
            heard, interval = t, t - heard
        if until - heard > max(SILENT_S, SILENT_INTERVALS * interval):
            return False
        self._heard, self._interval = heard, interval
        return True

    def hear(self, times: Sequence[float]) -> None:
        """Hear samples of the sensor at ``times`` [s], whatever was silent meanwhile."""
        for t in times:
            self._interval, self._heard = t - self._heard, t

    def stand_in(self, sample: Sample) -> AirspeedSample | None:
        """What stands in for the tube, given the newest ``sample`` of any sensor: nothing unless it has fallen silent.

        It comes as often as the tube had said something, or other sensors do if that is less often.
        """
        t = sample.t
        if sample.sensor == self.sensor:
            self.hear([t])
            return None
        since = t - self._heard
        if not since > SILENT_S or not since > SILENT_INTERVALS * self._interval:
            return None
        if t - self._stood_in < self._interval - TIME_TOLERANCE:
            return None
        self._stood_in = t
        return AirspeedSample(t, t, math.nan, self.sensor)


def problem(sample: AirspeedSample) -> str:
    """See `nav.aids.problem`."""
    return range_problem("airspeed", sample.eas, AIRSPEED_LIMITS)


@njit
def widened(eas: float) -> float:
    """How much larger the variance of an airspeed ``eas`` [m/s] is for being slow; one at `SLOW` and faster."""
    return (SLOW / eas) ** 2 if 0.0 < eas < SLOW else 1.0


@njit
def is_slow(eas: float, v_n: Array, minimum: float) -> bool:
    """Whether a pitot tube says nothing of the air that is flown through: below its minimum, or at rest."""
    return not eas >= minimum or dot(v_n, v_n) < STANDING_SPEED**2


@njit
def airspeed(
    q_nb: Array, v_n: Array, lla: Array, x: Array, wind: int, gust: int, airspeed_scale: int, eas: float
) -> tuple[Array, Array]:
    """Equivalent airspeed along body x [m/s]: sqrt(rho / rho0) e_x . C_nb' ((1 + scale) (v - wind) - gust).

    The density rho is the standard atmosphere's at the estimated height. Gusts are as the tube feels them: were they
    scaled, the scale would be learned from how they come and go, of which a filter knows little.
    """
    nu, H = np.empty(1), np.zeros((1, len(x)))
    put_airspeed(nu, H, q_nb, v_n, lla, x, wind, gust, airspeed_scale, eas)
    return nu, H


@lean
def put_airspeed(
    nu: Array, H: Array, q_nb: Array, v_n: Array, lla: Array, x: Array, wind: int, gust: int, airspeed_scale: int,
    eas: float,
) -> None:  # fmt: skip
    """`airspeed` into ``nu`` (1,) and zeros ``H`` (1, n)."""
    factor = 1 + x[airspeed_scale] if airspeed_scale >= 0 else 1.0
    root = math.sqrt(isa_density(lla[2]) / SEA_LEVEL_DENSITY)
    C_nb = dcm_components(q_nb)
    axis_n = C_nb[0][0], C_nb[1][0], C_nb[2][0]
    steady_n, air_n = _air(v_n, x, wind, gust, factor)
    slope_n = root * axis_n[0], root * axis_n[1], root * axis_n[2]
    _put_jacobian(H, slope_n, cross_components(air_n, slope_n), wind, gust, factor)
    predicted = root * dot(axis_n, air_n)
    half_lapse = 0.25 * math.log(isa_density(lla[2] + 1.0) / isa_density(lla[2] - 1.0))  # of density, per metre up
    H[0, POS + 2] = -predicted * half_lapse
    if airspeed_scale >= 0:
        H[0, airspeed_scale] = root * dot(axis_n, steady_n)
    nu[0] = eas - predicted


@njit
def sideslip(q_nb: Array, v_n: Array, x: Array, wind: int, gust: int) -> tuple[Array, Array]:
    """The constraint that no air comes from the side: 0 = e_y . C_nb' (v - wind - gust) [m/s].

    The Jacobian is that of the angle of sideslip times the airspeed, so it lies across the velocity through the air and
    not along e_y. An aircraft turns into a gust from the side: e_y moves with the innovation. A gain along e_y would
    move with it too, and the mean of their product, which is not zero, would make a bias of the airspeed's scale.
    """
    nu, H = np.empty(1), np.zeros((1, len(x)))
    put_sideslip(nu, H, q_nb, v_n, x, wind, gust)
    return nu, H


@lean
def put_sideslip(nu: Array, H: Array, q_nb: Array, v_n: Array, x: Array, wind: int, gust: int) -> None:
    """`sideslip` into ``nu`` (1,) and zeros ``H`` (1, n)."""
    C_nb = dcm_components(q_nb)
    axis_n = C_nb[0][1], C_nb[1][1], C_nb[2][1]
    _, air_n = _air(v_n, x, wind, gust, 1.0)
    slip, squared = dot(axis_n, air_n), dot(air_n, air_n)
    share = slip / squared if squared > 0.0 else 0.0
    across_n = axis_n[0] - share * air_n[0], axis_n[1] - share * air_n[1], axis_n[2] - share * air_n[2]
    _put_jacobian(H, across_n, cross_components(air_n, axis_n), wind, gust, 1.0)
    nu[0] = -slip


@njit
def _air(v_n: Array, x: Array, wind: int, gust: int, factor: float) -> tuple[Three, Three]:
    """The velocity through the mean wind (3,), and factor times that less the gust (3,)."""
    north, east, down = v_n[0], v_n[1], v_n[2]
    if wind >= 0:
        north, east = north - x[wind], east - x[wind + 1]
    gust_n, gust_e = (x[gust], x[gust + 1]) if gust >= 0 else (0.0, 0.0)
    return (north, east, down), (factor * north - gust_n, factor * east - gust_e, factor * down)


@lean
def _put_jacobian(H: Array, slope_n: Three, turned: Three, wind: int, gust: int, factor: float) -> None:
    """Jacobian (1, n) of what has the gradient ``slope_n`` in factor (v - wind) - gust, and ``turned`` in phi."""
    for i in range(3):
        H[0, PHI + i], H[0, VEL + i] = turned[i], factor * slope_n[i]
    for i in range(2):
        if wind >= 0:
            H[0, wind + i] = -factor * slope_n[i]
        if gust >= 0:
            H[0, gust + i] = -slope_n[i]
