"""A pitot tube: airspeed along body x, and the constraint that no air comes from the side."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nav._jit import njit
from nav.aids.base import Measurement, OperatingPoint, Ruling, range_problem
from nav.earth import SEA_LEVEL_DENSITY, isa_density
from nav.error_model import PHI, POS, VEL, Block, markov
from nav.rotation import cross, dcm_from_quat
from nav.samples import AirspeedSample, Array, Outcome, Sample

AIRSPEED_LIMITS = (-10.0, 300.0)  # what an instrument could possibly report [m/s]
TOO_SLOW = Ruling(Outcome.OUT_OF_RANGE, "too slow for the pitot tube")
STANDING = Ruling(Outcome.OUT_OF_RANGE, "standing, and blown upon")
STANDING_SPEED = 2.0  # over ground: what blows at a vehicle at rest tells of gusts near the ground only [m/s]
SILENT_S, SILENT_INTERVALS = 1.0, 3.0  # without a sample for longer than both, a pitot tube has fallen silent
TIME_TOLERANCE = 1e-4  # [s]


@dataclass(frozen=True)
class AirspeedAid:
    """Airspeed along body x, and the constraint of no sideslip (None leaves it out); a filter has one wind.

    A sample of no airspeed, NaN, stands for a tube that has fallen silent (`Silence`): of that the constraint is left,
    as long as the filter's own velocity through the air is that of flight.
    """

    sensor: str = "airspeed"
    sigma: float = 0.5  # [m/s]
    scale_sigma: float = 0.0  # [1]
    minimum: float = 10.0  # equivalent; below it neither airspeed nor sideslip is used [m/s]
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

    def measure(self, part: str, sample: Sample, at: OperatingPoint) -> Measurement | None:
        """See `Aid`."""
        assert isinstance(sample, AirspeedSample)
        state, (wind, gust, scale) = at.state, at.starts
        eas = sample.eas
        if math.isnan(eas):
            if part == "airspeed":
                return None
            eas = -float(airspeed(state.q_nb, state.v_n, state.lla, at.x, wind, gust, scale, 0.0)[0][0])
        slow = None if eas >= self.minimum else TOO_SLOW
        if slow is None and float(state.v_n @ state.v_n) < STANDING_SPEED**2:
            slow = STANDING
        if part == "airspeed":
            nu, H = airspeed(state.q_nb, state.v_n, state.lla, at.x, wind, gust, scale, sample.eas)
            return Measurement(nu, H, self._R[0], slow)
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

    def stand_in(self, sample: Sample) -> AirspeedSample | None:
        """What stands in for the tube, given the newest ``sample`` of any sensor: nothing unless it has fallen silent.

        It comes as often as the tube had said something, or other sensors do if that is less often.
        """
        t = sample.t
        if sample.sensor == self.sensor:
            self._interval, self._heard = t - self._heard, t
            return None
        silent = t - self._heard > max(SILENT_S, SILENT_INTERVALS * self._interval)
        if not silent or t - self._stood_in < self._interval - TIME_TOLERANCE:
            return None
        self._stood_in = t
        return AirspeedSample(t, t, math.nan, self.sensor)


def problem(sample: AirspeedSample) -> str:
    """See `nav.aids.problem`."""
    return range_problem("airspeed", sample.eas, AIRSPEED_LIMITS)


@njit
def airspeed(
    q_nb: Array, v_n: Array, lla: Array, x: Array, wind: int, gust: int, airspeed_scale: int, eas: float
) -> tuple[Array, Array]:
    """Equivalent airspeed along body x [m/s]: (1 + scale) sqrt(rho / rho0) e_x . C_nb' (v - wind - gust).

    The density rho is the standard atmosphere's at the estimated height.
    """
    C_nb = dcm_from_quat(q_nb)
    scale = x[airspeed_scale] if airspeed_scale >= 0 else 0.0
    root = (1 + scale) * math.sqrt(isa_density(lla[2]) / SEA_LEVEL_DENSITY)
    nu, H = _air_velocity(C_nb[:, 0], v_n, x, wind, gust)
    predicted = -root * nu[0]
    for i in range(len(x)):
        H[0, i] *= root
    nu[0] = eas - predicted
    half_lapse = 0.25 * math.log(isa_density(lla[2] + 1.0) / isa_density(lla[2] - 1.0))  # of density, per metre up
    H[0, POS + 2] = -predicted * half_lapse
    if airspeed_scale >= 0:
        H[0, airspeed_scale] = predicted / (1 + scale)
    return nu, H


@njit
def sideslip(q_nb: Array, v_n: Array, x: Array, wind: int, gust: int) -> tuple[Array, Array]:
    """The constraint that no air comes from the side: 0 = e_y . C_nb' (v - wind - gust) [m/s]."""
    return _air_velocity(dcm_from_quat(q_nb)[:, 1], v_n, x, wind, gust)


@njit
def _air_velocity(axis_n: Array, v_n: Array, x: Array, wind: int, gust: int) -> tuple[Array, Array]:
    """Zero minus the velocity through the air along a body axis ``axis_n`` (3,), and the Jacobian of that velocity."""
    air_n, along_n = np.empty(3), np.empty(3)
    H = np.zeros((1, len(x)))
    for i in range(3):
        air_n[i], along_n[i] = v_n[i], axis_n[i]
    for start in (wind, gust):
        if start >= 0:
            for i in range(2):
                air_n[i] -= x[start + i]
                H[0, start + i] = -along_n[i]
    turned = cross(air_n, along_n)
    nu = np.zeros(1)
    for i in range(3):
        H[0, PHI + i], H[0, VEL + i] = turned[i], along_n[i]
        nu[0] -= along_n[i] * air_n[i]
    return nu, H
