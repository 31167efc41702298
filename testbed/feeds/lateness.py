"""How late a receiver's velocities are: by the inertial unit, and by the positions beside them.

Nothing of it needs an estimate of attitude: the velocity that the inertial unit gains from fix to fix, in axes that do
not turn, is as long as the change of GNSS velocity less gravity, however the vehicle lies. That of an antenna is
v + C (w x l): v of the unit, C its attitude, w its rate and l the arm to the antenna, in its axes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nav._jit import njit
from nav.earth import gravity, radii
from nav.rotation import quat_from_rotvec, quat_multiply, quat_normalise, quat_rotate
from nav.samples import Array, ImuSamples
from testbed.feeds.log import Log
from testbed.sensors import SensorConfig
from testbed.sensors.gnss import GRADES, GnssConfig
from testbed.sensors.imu import ImuConfig

LAGS = np.arange(0.0, 0.61, 0.01)  # of GNSS that are tried [s],
FURTHER = np.append(0.0, np.arange(0.6, 3.01, 0.02))  # and where the last of these fits best: a clock is off then
CLEARER = 25.0  # must its likelihood be than that of none, twice the logarithm, to believe in one: 5 sigma
USUAL_S = min(one["latency_s"] for one in GRADES.values() if "latency_s" in one)  # of a receiver: the least of grades
LAG_S, FIT_ROUNDS, TINY = 1.0, 5, 1e-9  # [s], -, [m]
NEAR = 10  # lags to either side, of which one is the least
ALIKE = 5  # lags that both halves of a flight may be from the whole
OUTLYING = 6.0  # times the median of what does not fit: 4 sigma
LEAST_FIXES = 60


def fixes(own: Sequence[Any]) -> tuple[Array, Array, Array]:
    """Times (N,), velocities (N, 3) and places (N, 3) of the samples of a receiver that have a fix."""
    found = [one for one in own if one.has_fix]
    t = np.array([one.t for one in found])
    v_n = np.array([one.v_n for one in found]).reshape(-1, 3)
    return t, v_n, np.array([(one.lat, one.lon, one.h) for one in found]).reshape(-1, 3)


def late_by_imu(log: Log, name: str, own: Sequence[Any], sections: Mapping[str, SensorConfig]) -> float | None:
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


def latency(imu: ImuSamples, own: Sequence[Any], arm_s: Array, told: float = USUAL_S) -> float | None:
    """How much later than the motion a receiver's velocity is told of [s]; None where the flight does not show it.

    Its antenna is ``arm_s`` (3,) [m] from the unit, in the unit's axes. What fits best is believed if it fits clearly
    better than 0; or, where both halves of the flight agree, than what is ``told`` [s], which is taken off where
    nothing is known. The lag next to 0 is 0, and that is believed too if it fits clearly better than what a grade has.
    """
    costs, weight = _misfits(imu, own, arm_s, LAGS)
    if not len(costs):
        return None

    def clearer(one: int, other: int) -> bool:
        found = weight * math.log(costs[other] / costs[one]) if costs[one] else math.inf
        return bool(found > CLEARER)

    best, lags = int(np.argmin(costs)), LAGS
    if best == len(LAGS) - 1:
        lags, (costs, weight) = FURTHER, _misfits(imu, own, arm_s, FURTHER)
        best = int(np.argmin(costs)) if len(costs) else 0
        # Who swings to and fro moves as well a swing later: the first that is no worse.
        least = [k for k in range(1, best) if costs[k] <= min(costs[max(k - NEAR, 0) : k + NEAR])]
        best = next((k for k in least if not clearer(best, k)), best)
    if 0 < best < len(lags) - 1 and clearer(best, 0):
        return float(lags[best])
    if lags is FURTHER:
        return None
    otherwise = [int(np.argmin(np.abs(LAGS - one))) for one in (told, USUAL_S)]
    if best <= 1:
        return 0.0 if any(clearer(0, one) for one in otherwise) else None
    return float(LAGS[best]) if clearer(best, otherwise[0]) and _is_steady(imu, own, arm_s, best) else None


def _is_steady(imu: ImuSamples, own: Sequence[Any], arm_s: Array, best: int) -> bool:
    """Whether each half of the flight has its least misfit near the ``best`` of the lags: noise has it anywhere."""
    halves = (_misfits(imu, half, arm_s, LAGS)[0] for half in (own[: len(own) // 2], own[len(own) // 2 :]))
    return all(len(costs) and abs(int(np.argmin(costs)) - best) <= ALIKE for costs in halves)


def _misfits(imu: ImuSamples, own: Sequence[Any], arm_s: Array, lags: Array) -> tuple[list[float], int]:
    """How badly velocities fit what was felt so much earlier, for each of the ``lags`` (K,) [s], none if too few do.

    And twice the number of steps between fixes that this is the root mean square of.
    """
    t, v_n, place = fixes(own)
    known = np.isfinite(v_n).all(axis=1) & np.isfinite(place).all(axis=1)
    t, v_n, place = t[known], v_n[known], place[known]
    if len(t) < LEAST_FIXES:
        return [], 0
    gained = _gained(np.nan_to_num(imu.dtheta), np.nan_to_num(imu.dv), _swung(imu, arm_s))
    at = np.concatenate([imu.t[:1] - imu.dt[:1], imu.t])
    step = np.diff(t)
    g = gravity(place[:-1, 0], place[:-1, 2])
    change = np.diff(v_n, axis=0)
    change[:, 2] -= g * step
    told = np.linalg.norm(change, axis=1)
    steady = (step < 2 * np.median(step)) & (t[:-1] - lags[-1] > at[0]) & (t[1:] < at[-1])
    if steady.sum() < LEAST_FIXES:
        return [], 0
    costs = []
    for lag in lags:
        moved = np.column_stack([np.interp(t - lag, at, column) for column in gained.T])
        felt = np.linalg.norm(np.diff(moved, axis=0), axis=1)
        apart = ((felt - told) / step)[steady]
        apart = np.abs(apart - np.median(apart))
        costs.append(float(np.sqrt(np.mean(np.minimum(apart, OUTLYING * np.median(apart)) ** 2))))
    return costs, int(2 * steady.sum())


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
    n = max(1, round(LAG_S / float(np.median(step))))
    lat, lon, h = place.T
    R_M, R_N = radii(lat)
    east = (lon - lon[0] + math.pi) % (2 * math.pi) - math.pi
    p = np.column_stack([(lat - lat[0]) * (R_M + h), east * (R_N + h) * np.cos(lat)])
    way = np.vstack([np.zeros((1, 2)), np.cumsum(0.5 * (v[1:] + v[:-1]) * step[:, None], axis=0)])
    gaps = np.concatenate([[0], np.cumsum(step > 2 * np.median(step))])
    whole = gaps[n:] == gaps[:-n]
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
