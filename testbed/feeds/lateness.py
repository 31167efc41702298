"""How late a receiver's velocities are: by the inertial unit, and by the positions beside them.

Nothing of it needs an estimate of attitude: the velocity that the inertial unit gains from fix to fix, in axes that do
not turn, is as long as the change of GNSS velocity less gravity, however the vehicle lies. That of an antenna is
v + C (w x l): v of the unit, C its attitude, w its rate and l the arm to the antenna, in its axes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nav._jit import njit
from nav.earth import gravity, radii
from nav.rotation import quat_from_rotvec, quat_multiply, quat_normalise, quat_rotate
from nav.samples import Array, ImuSamples
from testbed.feeds.log import Log
from testbed.sensors import SensorConfig
from testbed.sensors.gnss import GRADES, GnssConfig
from testbed.sensors.imu import ImuConfig

LAGS = np.arange(-0.2, 0.605, 0.01)  # of GNSS that are tried [s], some less than there can be, for the way about 0,
FURTHER = np.append(0.0, np.arange(0.6, 3.01, 0.02))  # and where the last of these fits best: a clock is off then
CLEARER = 25.0  # must one fit than none to believe in it, in sigmas squared: 5,
CLEAREST = 40.0  # and the best of all lags, as of noise alone one of many fits well
USUAL_S = min(one["latency_s"] for one in GRADES.values() if "latency_s" in one)  # of a receiver: the least of grades
LAG_S, FIT_ROUNDS, TINY = 1.0, 5, 1e-9  # over which changes are summed [s], -, [m]
BOWL_S = 0.2  # to either side of the best lag, of the parabola that has the least misfit where it has its vertex
APART, LEAST_PARTS = 4, 5  # `LAG_S` that a part of a flight lasts, so that parts know nothing of each other; of these
KNOWN_S = 0.05  # sigma of a latency that is believed: a filter that is told 0.1 s finds the rest better itself
SHOWN_S = 0.01  # the least that is said of it: flights do not tell more, whatever the scatter
NEAR = 10  # lags to either side, of which one is the least
ALIKE = 5  # lags that both halves of a flight may be from the whole
OUTLYING = 6.0  # times the median of what does not fit: 4 sigma
LEAST_FIXES = 60


class Late(NamedTuple):
    """How late a receiver's velocities are, and one sigma of that [s]."""

    s: float
    sigma: float

    @property
    def text(self) -> str:
        """Both to what is known."""
        return f"{self.s:.2f} ± {max(self.sigma, SHOWN_S):.2f} s"


def fixes(own: Sequence[Any]) -> tuple[Array, Array, Array]:
    """Times (N,), velocities (N, 3) and places (N, 3) of the samples of a receiver that have a fix."""
    found = [one for one in own if one.has_fix]
    t = np.array([one.t for one in found])
    v_n = np.array([one.v_n for one in found]).reshape(-1, 3)
    return t, v_n, np.array([(one.lat, one.lon, one.h) for one in found]).reshape(-1, 3)


def late_by_imu(log: Log, name: str, own: Sequence[Any], sections: Mapping[str, SensorConfig]) -> Late | None:
    """`latency` of the samples ``own`` of a receiver by a log's unit, with what ``sections`` tell of both."""
    receiver, mounted = sections.get(name), sections.get(log.unit)
    arm_s, told = np.zeros(3), USUAL_S
    if isinstance(receiver, GnssConfig):
        arm_s, told = receiver.errors().lever_arm_b, receiver.latency_s + receiver.velocity_lag_s
    if isinstance(mounted, ImuConfig):
        e = mounted.errors()
        arm_s = e.C_sb @ (arm_s - e.lever_arm_b)
    return latency(log.imus[log.unit], own, arm_s, told)


@njit
def _gained(dtheta: Array, dv: Array, swung: Array) -> Array:
    """Velocity (N + 1, 3) [m/s] that increments (N, 3) add up to, in the body axes of the beginning.

    And what an antenna has beside, ``swung`` (N + 1, 3), in the body axes of each time.
    """
    total, found = np.zeros(3), np.zeros((len(dv) + 1, 3))
    found[0] = swung[0]
    q = np.array([1.0, 0.0, 0.0, 0.0])
    for k in range(len(dv)):
        half = quat_normalise(quat_multiply(q, quat_from_rotvec(0.5 * dtheta[k])))
        total = total + quat_rotate(half, dv[k])
        q = quat_normalise(quat_multiply(q, quat_from_rotvec(dtheta[k])))
        found[k + 1] = total + quat_rotate(q, swung[k + 1])
    return found


def _swung(imu: ImuSamples, arm_s: Array) -> Array:
    """Velocity (N + 1, 3) [m/s] w x l of an antenna about the unit, at the ends of its increments, in its axes."""
    if not arm_s.any():
        return np.zeros((len(imu) + 1, 3))
    rates = np.nan_to_num(imu.dtheta) / imu.dt[:, None]
    return np.cross(0.5 * (np.vstack([rates[:1], rates]) + np.vstack([rates, rates[-1:]])), arm_s)


def latency(imu: ImuSamples, own: Sequence[Any], arm_s: Array, told: float = USUAL_S) -> Late | None:
    """How much later than the motion a receiver's velocity is told of; None where the flight does not show it.

    Its antenna is ``arm_s`` (3,) [m] from the unit, in the unit's axes. What fits best is believed if it is known to
    `KNOWN_S` and fits clearly better than 0; or, where both halves of the flight agree, than what is ``told`` [s],
    which is taken off where nothing is known. About 0 it is believed too if 0 fits clearly better than a grade's.
    """
    lags, misfits = LAGS, _misfits(imu, own, arm_s, LAGS)
    best = misfits.best(LAGS) if misfits else 0
    if best == len(LAGS) - 1:
        lags, misfits = FURTHER, _misfits(imu, own, arm_s, FURTHER)
        best = misfits.best(FURTHER) if misfits else 0
    fit = misfits.fit(lags, best) if misfits else None
    if fit is None:
        return None
    if lags is FURTHER:
        # Who swings to and fro moves as well a swing later: the first that is no worse.
        costs = fit.costs
        least = [k for k in range(1, best) if costs[k] <= min(costs[max(k - NEAR, 0) : k + NEAR])]
        best = next((k for k in least if not fit.clearer(best, k)), best)
        fit = misfits.fit(lags, best) if misfits else None
    if fit is None or fit.late.sigma > KNOWN_S:
        return None
    none = _nearest(lags, 0.0)
    if none < best < len(lags) - 1 and fit.clearer(best, none):
        return fit.late
    if lags is FURTHER:
        return None
    otherwise = [_nearest(LAGS, one) for one in (told, USUAL_S)]
    if best <= none + 1:
        return fit.late if any(fit.clearer(none, one) for one in otherwise) else None
    return fit.late if fit.clearer(best, otherwise[0]) and _is_steady(imu, own, arm_s, best) else None


def _nearest(lags: Array, one: float) -> int:
    return int(np.argmin(np.abs(lags - one)))


def _is_steady(imu: ImuSamples, own: Sequence[Any], arm_s: Array, best: int) -> bool:
    """Whether each half of the flight has its least misfit near the ``best`` of the lags: noise has it anywhere."""
    halves = (_misfits(imu, half, arm_s, LAGS) for half in (own[: len(own) // 2], own[len(own) // 2 :]))
    return all(one is not None and abs(one.best(LAGS) - best) <= ALIKE for one in halves)


class _Fit(NamedTuple):
    """The latency of the least misfit, the ``costs`` (K,) of all lags, and what of these one sigma makes."""

    late: Late
    costs: Array
    scale: float

    def clearer(self, one: int, other: int) -> bool:
        """Whether ``one`` lag fits clearly better than the ``other``."""
        return bool(self.costs[other] - self.costs[one] > CLEAREST * self.scale)


class _Misfits(NamedTuple):
    """How badly velocities fit what was felt so much earlier: squares (K, N) of K lags and N changes of velocity.

    Of which ``together`` have a part of their time in common, and so of their noise.
    """

    squares: Array
    together: int

    def best(self, lags: Array) -> int:
        """Which of the ``lags`` (K,), of those that can be, has the least mean."""
        return int(np.argmin(np.where(lags >= -TINY, self.squares.mean(axis=1), math.inf)))

    def fit(self, lags: Array, best: int) -> _Fit | None:
        """The parabola through the mean squares about the ``best`` of the ``lags`` (K,); None without a vertex there.

        That is off by what the slope there is off by, over twice the curvature. The slope is a mean over all changes,
        of which each has what noise of the unit, which moves with the lag, and of the receiver make of it: how far that
        is off is known by how sums over parts of the flight scatter. Over so many lags what moves is small.
        """
        near = np.abs(lags - lags[best]) < BOWL_S + SHOWN_S / 2
        curvature, slope, _ = np.linalg.pinv(np.vander(lags[near] - lags[best], 3))
        squares, costs = self.squares[near], self.squares.mean(axis=1)
        parts = np.arange(0, squares.shape[1], APART * self.together)
        bent = float(curvature @ costs[near])
        if bent <= 0 or len(parts) < LEAST_PARTS:
            return None
        off = -float(slope @ costs[near]) / (2 * bent)
        slopes = np.add.reduceat((2 * off * curvature + slope) @ squares, parts)
        sigma = math.sqrt(len(parts) * float(np.var(slopes, ddof=1))) / squares.shape[1] / (2 * bent)
        late = Late(max(float(lags[best]) + off, 0.0), sigma)
        return _Fit(late, costs, bent * sigma**2) if abs(off) < BOWL_S else None


def _misfits(imu: ImuSamples, own: Sequence[Any], arm_s: Array, lags: Array) -> _Misfits | None:
    """Those of changes over `LAG_S` each for each of the ``lags`` (K,) [s], None if there are too few of them.

    Over so long noise of an inertial unit that vibrates is small beside what it is moved by, and over one step of a
    receiver it may not be.
    """
    t, v_n, place = fixes(own)
    known = np.isfinite(v_n).all(axis=1) & np.isfinite(place).all(axis=1)
    t, v_n, place = t[known], v_n[known], place[known]
    if len(t) < LEAST_FIXES:
        return None
    n, whole = _spans(t)
    gained = _gained(np.nan_to_num(imu.dtheta), np.nan_to_num(imu.dv), _swung(imu, arm_s))
    at = np.concatenate([imu.t[:1] - imu.dt[:1], imu.t])
    lasts = t[n:] - t[:-n]
    change = v_n[n:] - v_n[:-n]
    change[:, 2] -= gravity(place[:-n, 0], place[:-n, 2]) * lasts
    told = np.linalg.norm(change, axis=1)
    steady = whole & (t[:-n] - lags[-1] > at[0]) & (t[n:] - lags[0] < at[-1])
    if steady.sum() < LEAST_FIXES:
        return None
    squares = []
    for lag in lags:
        moved = np.column_stack([np.interp(t - lag, at, column) for column in gained.T])
        felt = np.linalg.norm(moved[n:] - moved[:-n], axis=1)
        apart = ((felt - told) / lasts)[steady]
        apart = np.abs(apart - np.median(apart))
        squares.append(np.minimum(apart, OUTLYING * np.median(apart)) ** 2)
    return _Misfits(np.array(squares), n)


def _spans(t: Array) -> tuple[int, npt.NDArray[np.bool_]]:
    """How many steps of ascending times (N,) are `LAG_S`, and in which stretches of so many none is much longer."""
    step = np.diff(t)
    n = max(1, round(LAG_S / float(np.median(step))))
    gaps = np.concatenate([[0], np.cumsum(step > 2 * np.median(step))])
    return n, gaps[n:] == gaps[:-n]


def velocity_lag(own: Sequence[Any]) -> float | None:
    """How much older a receiver's velocities are than the positions beside them [s]; None where that is not shown.

    Positions p move by what velocities of that age add up to: sum v dt - dp = -lag dv, level, over `LAG_S` each. Least
    squares, what does not fit counting for less; it is believed from 5 sigma on, its residuals lasting so long, too.
    """
    t, v_n, place = fixes(own)
    known = np.isfinite(v_n[:, :2]).all(axis=1) & np.isfinite(place).all(axis=1)
    t, v, place = t[known], v_n[known, :2], place[known]
    if len(t) < LEAST_FIXES:
        return None
    step = np.diff(t)
    n, whole = _spans(t)
    lat, lon, h = place.T
    R_M, R_N = radii(lat)
    east = (lon - lon[0] + math.pi) % (2 * math.pi) - math.pi
    p = np.column_stack([(lat - lat[0]) * (R_M + h), east * (R_N + h) * np.cos(lat)])
    way = np.vstack([np.zeros((1, 2)), np.cumsum(0.5 * (v[1:] + v[:-1]) * step[:, None], axis=0)])
    apart, gained = (((way - p)[n:] - (way - p)[:-n])[whole], (v[n:] - v[:-n])[whole])
    if len(apart) < LEAST_FIXES or not gained.any():
        return None
    weights, lag, left = np.ones(len(apart)), 0.0, np.zeros(len(apart))
    for _ in range(FIT_ROUNDS):
        told = float(weights @ np.sum(gained**2, axis=1))
        lag = -float(weights @ np.sum(apart * gained, axis=1)) / told
        left = np.linalg.norm(apart + lag * gained, axis=1)
        weights = np.minimum(1.0, OUTLYING * np.median(left) / np.maximum(left, TINY))
    variance = float(weights @ left**2) / len(left) / 2 * n / told
    return lag if lag**2 > CLEARER * variance else None
