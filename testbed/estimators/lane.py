"""An estimator at work in a run: the IMUs it integrates, the sensors it is handed, what it makes of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol, cast

import numpy as np

from nav._jit import njit
from nav.alignment import InitialState
from nav.columns import Estimates, Reports, Samples, one_by_one
from nav.horizon import FusionHorizon
from nav.increments import COINCIDENT
from nav.ins import Ins
from nav.samples import Array, Estimate, ImuSamples, Outcome, Sample, UpdateReport
from nav.standing import Standing
from nav.voting import Voter
from testbed.estimators.datasheet import imu_model
from testbed.estimators.rig import Rig
from testbed.estimators.section import EstimatorSection, Handover
from testbed.noise import stream

JITTER = 0.05  # of the distance that samples must keep


class Tracked(NamedTuple):
    """What an estimator integrated, its reports on redundant units and on samples, and its estimates."""

    increments: ImuSamples
    votes: list[UpdateReport]
    reports: Reports
    estimates: Estimates


class Commanded(NamedTuple):
    """What the autopilot commands over the intervals that end at ``t`` (n,) [s]: bank [rad], altitude [m], airspeed
    [m/s], each (n,), NaN where nothing is commanded.
    """

    t: Array
    bank: Array
    altitude: Array
    airspeed: Array


@dataclass(frozen=True, slots=True)
class HandoverErrors:
    """How wrong the state is that somebody else's navigation hands over.

    ``arm_b`` (3,) [m] points from the centre of gravity to the IMU; ``sigma`` (9,) is of attitude [rad], velocity [m/s]
    and position [m], NED; the errors are drawn from ``random``.
    """

    arm_b: Array
    sigma: Array
    random: np.random.Generator


class _Startable(Protocol):
    def start(self, initial: InitialState) -> None: ...


@dataclass(frozen=True, slots=True)
class Lane:
    """An estimator behind its fusion horizon: the IMUs it integrates, the sensors whose samples it is handed.

    ``imus`` has how each IMU is mounted, C_sb (3, 3), by name; of several the ``voter`` makes one. The estimate is of
    the point where the first sits. ``commanded`` is for one that listens to the autopilot. With ``handover`` it does
    not align but waits for `start`. Of sensors in ``spacing_s`` [s] it is handed only samples so far apart, and of
    ``standing`` what that makes of increments and samples.
    """

    horizon: FusionHorizon
    imus: Mapping[str, Array]
    sensors: tuple[str, ...]
    handover: HandoverErrors | None = None
    voter: Voter | None = None
    commanded: Callable[[Commanded], None] | None = None
    standing: Standing | None = None
    spacing_s: Mapping[str, float] = field(default_factory=dict)
    _taken: dict[str, float] = field(default_factory=dict)

    def start(self, initial: InitialState) -> None:
        """Begin with a state that is handed over."""
        cast(_Startable, self.horizon.estimator).start(initial)

    def track(
        self, commanded: Commanded, imu: Mapping[str, ImuSamples], samples: Mapping[str, Sequence[Sample]],
        times: Sequence[float],
    ) -> Tracked:  # fmt: skip
        """Give it what the sensors delivered and the autopilot commanded; estimates are wanted at ``times`` [s]."""
        if self.commanded is not None:
            self.commanded(commanded)
        increments, votes = self.increments(imu)
        handed: list[Sample | Samples] = []
        for aid in self.sensors:
            own = self._thinned(aid, samples[aid])
            handed += [own] if isinstance(own, Samples) else own
        if self.standing is not None:
            handed += self.standing.heard(increments, [*one_by_one(handed)])
        reports, estimates = self.horizon.track(increments, handed, times)
        return Tracked(increments, votes, reports, estimates)

    def smoothed(self, times: Sequence[float]) -> Iterator[Estimate]:
        """The estimates at ``times`` [s] by all that it was ever handed, of one that keeps what that takes.

        From its fusion horizon on nothing has told it more than it predicted by.
        """
        estimator = self.horizon.estimator
        if not (isinstance(estimator, Ins) and estimator.config.smooth and estimator.aligned):
            return
        told = [t for t in times if t <= estimator.t + COINCIDENT]
        yield from estimator.smoothed(told)
        yield from map(self.horizon.estimate_at, times[len(told) :])

    def _thinned(self, sensor: str, samples: Sequence[Sample]) -> Sequence[Sample]:
        """Those of one sensor that are far enough from the last one before them that was handed over."""
        least = self.spacing_s.get(sensor)
        if least is None:
            return samples
        spaced = []
        for sample in samples:
            if not sample.t - self._taken.get(sensor, -math.inf) < least * (1 - JITTER):
                self._taken[sensor] = sample.t
                spaced.append(sample)
        return spaced

    @property
    def failure(self) -> str:
        """Why it has ended by an error of its own, empty while it has not (`testbed.estimators.custom.Adapter`)."""
        return str(getattr(self.horizon.estimator, "failure", ""))

    @property
    def ended(self) -> float:
        """From which time on it gives no estimate because of that [s], NaN while nobody has asked for one since."""
        return float(getattr(self.horizon.estimator, "ended", math.nan))

    @property
    def problem(self) -> str:
        """What its alignment waits for, of one that says so."""
        return str(getattr(self.horizon.estimator, "problem", ""))

    @property
    def imu(self) -> str:
        """The first IMU."""
        return next(iter(self.imus))

    def increments(self, imu: Mapping[str, ImuSamples]) -> tuple[ImuSamples, list[UpdateReport]]:
        """What to integrate, in body axes, from the increments of each IMU; and on each unit of several what was voted.

        A report's nis is the unit's parity statistic; its weight is 0 while the unit is voted out.
        """
        turned = [
            replace(imu[name], dtheta=_turned_back(C_sb, imu[name].dtheta), dv=_turned_back(C_sb, imu[name].dv))
            for name, C_sb in self.imus.items()
        ]
        if self.voter is None:
            return turned[0], []
        used, ballots = self.voter.vote(turned)
        none = np.empty(0)
        return used, [
            UpdateReport(
                ballot.t, name, "imu_parity", none, none.reshape(0, 0), float(statistic), ballot.threshold,
                *((0.0, Outcome.ISOLATED, "voted out") if failed else (1.0, Outcome.FUSED, doubt)),
            )
            for ballot in ballots
            for doubt in ("the units left disagree" if ballot.ambiguous else "",)
            for name, statistic, failed in zip(self.imus, ballot.statistic, ballot.failed, strict=True)
        ]  # fmt: skip


def mountings(section: EstimatorSection, rig: Rig) -> tuple[dict[str, Array], Voter | None]:
    """How the IMUs of an estimator are mounted, C_sb by name, and who votes where there are several."""
    mounted = {name: rig.imu(name).errors().C_sb for name in (section.imu, *section.spare_imus)}
    if not section.spare_imus:
        return mounted, None
    e = rig.imu_errors(section.imu, *section.spare_imus)
    turn = math.hypot(e.gyro_misalignment, e.gyro_nonorthogonality, e.gyro_scale)
    level = math.hypot(e.accel_misalignment, e.accel_nonorthogonality, e.accel_scale)
    return mounted, Voter(imu_model(e), turn, level)


def handover_errors(given: Handover | None, arm_b: Array, seed: int) -> HandoverErrors | None:
    """The errors of a state that is handed over, None to an estimator that aligns.

    All estimators of a run draw the same, so that none has a better start than its rival.
    """
    if given is None:
        return None
    level, heading = math.radians(given.level_deg), math.radians(given.heading_deg)
    sigma = np.array([level, level, heading, *[given.velocity_mps] * 3, *[given.position_m] * 3])
    return HandoverErrors(arm_b, sigma, stream(seed, "start", "handover"))


@njit
def _turned_back(C_sb: Array, x_s: Array) -> Array:
    """C_sb' x of each row, whatever a broken unit says; the order of the sums does not depend on how many there are."""
    x_b = np.empty(x_s.shape)
    for k in range(len(x_s)):
        for i in range(3):
            x_b[k, i] = x_s[k, 0] * C_sb[0, i] + x_s[k, 1] * C_sb[1, i] + x_s[k, 2] * C_sb[2, i]
    return x_b
