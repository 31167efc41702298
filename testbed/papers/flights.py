"""A flight of a paper: its motion sensed once, then any estimator on the same samples; kept is what verdicts need."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from nav.columns import Estimates
from nav.earth import position_difference_n
from nav.ins import Ins
from nav.samples import Array, ImuSamples, Outcome, UpdateReport
from testbed import sensors
from testbed.estimators import registry
from testbed.estimators.federated import FederatedSection
from testbed.estimators.ins import InsSection
from testbed.estimators.lane import Lane
from testbed.feeds.known import handed_over
from testbed.feeds.simulated import motion
from testbed.motion.table import TruthBlock
from testbed.scenario import Scenario
from testbed.score import accuracy, detection
from testbed.sensors.faults import Faults, FaultTruth


@dataclass(frozen=True, slots=True)
class Sensed:
    """A motion, and by sensor what was made of it: samples, or an IMU's increments."""

    truth: TruthBlock
    samples: Mapping[str, Any]

    @classmethod
    def of(cls, chosen: Scenario, seed: int) -> Sensed:
        """The whole motion of a scenario and its sensors, without any of its faults."""
        rate = chosen.truth.rate_hz
        truth = motion(chosen, seed).advance(round(chosen.duration_s * rate) + 1)
        return cls(
            truth,
            {
                name: sensors.build(name, section, rate, seed, chosen.site()).sense(truth)
                for name, section in chosen.sensors.items()
            },
        )

    def between(self, start: float, end: float) -> Sensed:
        """What arrived after ``start`` and up to ``end`` [s]."""
        return Sensed(self.truth, {name: _between(one, start, end) for name, one in self.samples.items()})

    def with_faults(self, chosen: Scenario, seed: int) -> tuple[Sensed, list[FaultTruth]]:
        """The same with a scenario's faults, and what they are."""
        faults = Faults(chosen.fault, chosen.sensors, seed)
        found = {name: faults.apply(name, samples) for name, samples in self.samples.items()}
        return Sensed(self.truth, found), faults.truth


def _between(samples: Any, start: float, end: float) -> Any:
    start, end = start + accuracy.SAME_TIME_S, end + accuracy.SAME_TIME_S
    if isinstance(samples, ImuSamples):
        rows = slice(*np.searchsorted(samples.t, (start, end)))
        return ImuSamples(samples.t[rows], samples.dt[rows], samples.dtheta[rows], samples.dv[rows])
    return [sample for sample in samples if start < sample.t_arrival <= end]


@dataclass(frozen=True, slots=True)
class Looks:
    """What became of the samples of one aid: times (N,) [s], weights (N,), outcomes (N,), NIS (N,)."""

    t: Array
    weight: Array
    outcome: npt.NDArray[Any]
    nis: Array

    @property
    def alarm(self) -> accuracy.Mask:
        """Which were refused, in part at least, because they looked wrong."""
        return detection.alarmed(self.weight, self.outcome)

    @property
    def isolated(self) -> accuracy.Mask:
        """Which were refused because their sensor, or an axis of it, is isolated."""
        mask: accuracy.Mask = self.outcome == Outcome.ISOLATED
        return mask


@dataclass(frozen=True, slots=True)
class Track:
    """An estimator's errors (N, 3) and claimed 1-sigma (N, 9) at times (N,), and its reports.

    ``position`` NED [m], ``velocity`` NED [m/s], ``attitude`` phi in n [rad], ``angles`` of roll, pitch, heading [rad].
    """

    t: Array
    position: Array
    velocity: Array
    attitude: Array
    angles: Array
    sigma: Array
    reports: Sequence[UpdateReport]

    @property
    def every(self) -> Array:
        """Position, velocity and attitude (N, 9)."""
        return np.column_stack([self.position, self.velocity, self.attitude])

    def looks(self, aid: str) -> Looks:
        """What became of the samples of one aid."""
        own = [report for report in self.reports if report.aid == aid]
        return Looks(
            np.array([report.t for report in own]), np.array([report.weight for report in own]),
            np.array([report.outcome for report in own]), np.array([report.nis for report in own]),
        )  # fmt: skip

    @property
    def by_sensor(self) -> dict[str, detection.SensorLooks]:
        """As `testbed.score.detection.score_faults` wants it: what became of the samples of each sensor."""
        columns = zip(*((r.t, r.sensor, r.weight, r.outcome) for r in self.reports), strict=True)
        return detection.by_sensor(*(np.array(column) for column in columns))


@dataclass(frozen=True, slots=True)
class KnownFaults:
    """A measurement policy that leaves out what it was told is wrong: (axis, from, to) of one kind of measurement."""

    wrong: Sequence[tuple[int, float, float]]

    def adapt(self, nu: Array, S: Array, R: Array, t: float) -> Array:
        """See `nav.weighting.Policy`."""
        out = [axis for axis, start, end in self.wrong if start <= t + accuracy.SAME_TIME_S < end]
        told = R.copy()
        told[out] = np.inf
        return told


def told(chosen: Scenario, seed: int, section: FederatedSection, wrong: Mapping[str, KnownFaults] | None) -> Lane:
    """What no filter of the same sensors could better, as linear as the problem is: one Kalman filter with all of them
    and no gate, of the states, noise and initial errors of a federation, that is told what is ``wrong`` by aid.
    """
    same = ("name", "imu", "states", "turn_degps", "gust_mps", "handover", "nonholonomic_mps")
    aids = tuple(dict.fromkeys(aid for local in section.locals for aid in local.aids))
    alone = InsSection(aids=aids, false_rejection=0.0, **{key: getattr(section, key) for key in same})
    lane = registry.build((alone,), chosen.rig(seed))[section.name]
    assert isinstance(lane.horizon.estimator, Ins)
    lane.horizon.estimator = Ins(lane.horizon.estimator.config, policies=wrong)
    return lane


def lanes(chosen: Scenario, seed: int) -> dict[str, Lane]:
    """The scenario's estimators."""
    return registry.build(chosen.estimator, chosen.rig(seed))


class Flight:
    """An estimator on its way over a flight, begun with what is handed over, if anything is."""

    def __init__(self, lane: Lane, sensed: Sensed) -> None:
        if lane.handover is not None:
            lane.start(handed_over(lane.handover, sensed.truth))
        self._lane, self._sensed = lane, sensed
        self._now, self._t = -math.inf, np.empty(0)
        self._reports: list[UpdateReport] = []
        self._estimates: list[Estimates] = []

    def on(self, t: Array) -> None:
        """Fly on, with estimates at ``t`` (N,) [s], to the last of them."""
        now = self._sensed.between(self._now, float(t[-1]))
        handed = [sample for name in self._lane.sensors for sample in now.samples[name]]
        reports, estimates = self._lane.horizon.track(self._lane.increments(now.samples)[0], handed, t.tolist())
        self._now, self._t = float(t[-1]), np.append(self._t, t)
        self._reports += reports
        self._estimates.append(estimates)

    def fork(self, sensed: Sensed) -> Flight:
        """The same up to now, on the way over another flight that was alike so far."""
        fork = copy(self)
        fork._lane, fork._sensed = deepcopy(self._lane), sensed
        fork._reports, fork._estimates = self._reports.copy(), self._estimates.copy()
        return fork

    def track(self) -> Track:
        """What came of it so far."""
        return _errors(Estimates.of(self._estimates), self._reports, self._sensed.truth, self._t)


def track(lane: Lane, sensed: Sensed, t: Array) -> Track:
    """An estimator over a whole flight; at times ``t`` (N,) [s]."""
    flight = Flight(lane, sensed)
    flight.on(t)
    return flight.track()


def _errors(estimates: Estimates, reports: Sequence[UpdateReport], truth: TruthBlock, t: Array) -> Track:
    rows = np.searchsorted(truth.t, t - accuracy.SAME_TIME_S)
    here, true = (truth.lat[rows], truth.lon[rows], truth.h[rows]), truth.q_nb[rows]
    return Track(
        t=t,
        position=position_difference_n(estimates.lat, estimates.lon, estimates.h, *here),
        velocity=estimates.v_n - truth.v_n[rows],
        attitude=accuracy.attitude_error(estimates.q_nb, true),
        angles=accuracy.wrapped(accuracy.euler(estimates.q_nb) - accuracy.euler(true)),
        sigma=np.sqrt(np.diagonal(estimates.covariance, axis1=1, axis2=2)),
        reports=reports,
    )
