"""How well anybody could have known a simulated run: the posterior Cramér-Rao bound beside each estimator.

Of an estimator without bias, or of any on average over draws, the mean square error is not below the inverse of the
information that prior, motion and measurements hold. Tichavský, Muravchik and Nehorai, Posterior Cramér-Rao Bounds for
Discrete-Time Nonlinear Filtering, IEEE Trans. Signal Processing 46 (5), 1998, proposition 1, give its recursion; with
errors that grow linearly about the true trajectory, and Gaussian noises, it is the covariance of a Kalman filter that
knows the true trajectory and all statistics, written with information. That covariance is what is computed here, since
states without driving noise have none of it to invert.

The bound is for the sensors that an estimator is handed. It counts all their samples, as if they were sound, and, with
airspeed, that the aircraft slips as it did. A recorded flight has no statistics and so no bound. None is given either
for an estimator that votes on several IMUs, knows wheels that do not slip, has no GNSS among its aids, or takes a
sensor whose errors are not known in `testbed.score.bound_model`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nav._jit import njit
from nav.kalman import predict
from nav.matrix import add_symmetric
from nav.samples import Array
from testbed.errors import UserError
from testbed.estimators.outside import ArduPilotSection
from testbed.estimators.section import EstimatorSection, Handover
from testbed.motion.logged import LogTruth
from testbed.motion.sections import FlightTruth
from testbed.record.reader import scenario_of
from testbed.score import accuracy
from testbed.score.accuracy import Window
from testbed.score.bound_model import (
    MOTION,
    PHI,
    POS,
    VEL,
    Model,
    add_air,
    add_imu,
    add_sensor,
)
from testbed.score.bound_sight import add_sight
from testbed.score.bound_way import way
from testbed.sensors.gnss import GnssConfig

if TYPE_CHECKING:
    import xarray

    from testbed.scenario import Scenario

STEP_S = 0.2  # as 0.1 s to 0.01 %; 0.5 s makes a minute without GNSS too low by 0.7 %, two by 0.3 %
PART = 500  # steps that are in memory at a time
SHORTEST = 100  # rows of truth of a run that is worth it
# Whom nobody told anything knows this after aligning at the best: attitude [rad], velocity [m/s], position [m].
ALIGNED = (0.01, 1.0, 10.0)


@dataclass(frozen=True, slots=True)
class Bound:
    """Least 1-sigma of any estimator's errors at ``t`` (K,) [s], each (K, 3) along north, east, down.

    ``position`` [m], ``velocity`` [m/s], ``attitude`` [rad].
    """

    t: Array
    position: Array
    velocity: Array
    attitude: Array

    @property
    def horizontal(self) -> Array:
        """Least root mean square of the length of the horizontal position error (K,) [m]."""
        return np.hypot(self.position[:, 0], self.position[:, 1])

    @property
    def tilt(self) -> Array:
        """Least root mean square of the angle between true and estimated vertical (K,) [rad]."""
        return np.hypot(self.attitude[:, 0], self.attitude[:, 1])

    def horizontal_at(self, t: float) -> float:
        """The same at one time [s]."""
        return float(np.interp(t, self.t, self.horizontal))


def of_run(dataset: xarray.DataTree, step_s: float = STEP_S, until: float = math.inf) -> dict[str, Bound]:
    """The bound of each estimator that has one, by name, in steps of ``step_s`` [s]; see the head of this module.

    Nothing is worked out of what comes after ``until`` [s].
    """
    try:
        scenario = scenario_of(dataset)
    except UserError:  # `metrics.unscored` says so
        return {}
    if isinstance(scenario.truth, LogTruth) or len(accuracy.column(dataset, "truth/time")) < SHORTEST:
        return {}
    found: dict[str, Bound] = {}
    same: dict[tuple[str, ...], Bound | None] = {}
    for section in scenario.estimator:
        if section.name not in accuracy.names(dataset) or _none_for(section, scenario):
            continue
        key = (section.imu, *sorted(section.aiding(scenario.sensors)), str(getattr(section, "handover", None)))
        if key not in same:
            same[key] = of_estimator(dataset, scenario, section, step_s, until)
        if (bound := same[key]) is not None:
            found[section.name] = bound
    return found


def of_estimator(
    dataset: xarray.DataTree, scenario: Scenario, section: EstimatorSection, step_s: float = STEP_S,
    until: float = math.inf,
) -> Bound | None:  # fmt: skip
    """The bound of one estimator of a simulated ``scenario``, if it has one; of the record, truth and samples count."""
    if _none_for(section, scenario):
        return None
    errors = scenario.rig(scenario.seed).imu(section.imu).errors()
    model = Model(way(dataset, errors.C_sb, step_s))
    add_imu(model, errors)
    if isinstance(scenario.truth, FlightTruth):
        add_air(model, scenario.truth)
    for name in section.aiding(scenario.sensors):
        config = scenario.sensors[name]
        known = add_sensor(model, dataset, name, config, scenario.date)
        if not known and not add_sight(model, dataset, name, config, scenario.truth.terrain):
            return None
    start = model.prior
    start[range(MOTION), range(MOTION)] = _start(getattr(section, "handover", None)) ** 2
    steps = int(np.searchsorted(model.way.t, until)) + 1
    sigma = np.sqrt(np.maximum(along(model, start, steps), 0.0))
    return Bound(model.way.t[:steps], sigma[:, POS], sigma[:, VEL], sigma[:, PHI])


def _none_for(section: EstimatorSection, scenario: Scenario) -> bool:
    """Whether an estimator has no bound, whatever its sensors are: ArduPilot has some of its own, made of truth."""
    receivers = [aid for aid in section.aiding(scenario.sensors) if isinstance(scenario.sensors[aid], GnssConfig)]
    told_more = section.spare_imus or getattr(section, "nonholonomic_mps", None) is not None
    return bool(section.attitude_only or not receivers or told_more or isinstance(section, ArduPilotSection))


def _start(handover: Handover | None) -> Array:
    """How well the motion (9,) is known at the start: 1-sigma of attitude, velocity and position."""
    if handover is None:
        return np.repeat(ALIGNED, 3)
    level, heading = np.deg2rad(handover.level_deg), np.deg2rad(handover.heading_deg)
    return np.array([level, level, heading, *[handover.velocity_mps] * 3, *[handover.position_m] * 3])


def along(model: Model, P: Array, steps: int) -> Array:
    """The bound's variances (K, 9) of the motion after each of the first ``steps``, from ``P`` (n, n) before them."""
    stop = min(steps, len(model.way))
    parts = [slice(first, min(first + PART, stop)) for first in range(0, stop, PART)]
    return np.concatenate([variances(P, *model.transition(part), model.measured(part)) for part in parts])


@njit
def variances(P: Array, Phi: Array, decay: Array, variance: Array, H: Array) -> Array:
    """Take the bound ``P`` (n, n) over K steps, in place; its variances (K, r) of the first r states after each.

    Of each step ``Phi`` (K, r, n) takes all states to the first r at its end, the others decay by ``decay`` (K, n);
    ``variance`` (K, n) is the white noise on each, half of it before and half after; ``H`` (K, m, n) are measurements
    of unit noise, one after the other, P - P h h' P / (h' P h + 1), and none where a row is zero.
    """
    (steps, moving, _), (_, measured, n) = Phi.shape, H.shape
    found, work = np.empty((steps, moving)), np.empty((moving, n))
    W = np.empty((measured, n))  # P h of each measurement, after those before it, over the root of its variance
    minus = np.empty((measured, n))
    sees = np.empty(n, np.int64)  # the states that a measurement is of, which are few
    for k in range(steps):
        predict(P, Phi[k], decay[k], 0.5 * variance[k], work, n)
        seen = 0
        for h in H[k]:
            few = 0
            w = W[seen]
            w[:] = 0.0
            s = 1.0
            for i in range(n):
                if h[i] != 0.0:
                    sees[few] = i
                    few += 1
                    for j in range(n):
                        w[j] += h[i] * P[i, j]
            for before in W[:seen]:
                told = 0.0
                for i in sees[:few]:
                    told += before[i] * h[i]
                for j in range(n):
                    w[j] -= told * before[j]
            for i in sees[:few]:
                s += h[i] * w[i]
            if s > 1.0:
                for j in range(n):
                    w[j] /= math.sqrt(s)
                    minus[seen, j] = -w[j]
                seen += 1
        if seen:
            add_symmetric(P, minus[:seen], W[:seen])
        for i in range(moving):
            found[k, i] = P[i, i]
    return found


def marks(bound: Bound, windows: Iterable[Window], seconds: Iterable[int]) -> dict[str, float]:
    """The bound so many ``seconds`` into an outage, the largest of all that last so long, as metrics."""
    result: dict[str, float] = {}
    for mark in seconds:
        found = [bound.horizontal_at(start + mark) for start, end in windows if start + mark < min(end, bound.t[-1])]
        if found:
            result[f"outage_bound_at_{mark}s_m"] = max(found)
    return result
