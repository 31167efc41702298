"""A federated filter: several local filters over one strapdown, whose master fuses what they found (Carlson's scheme).

Every local filter holds the common states, motion and errors of the IMU, and the errors of its own aids. Between
corrections local filter i estimates the error of the one nominal state that all share; the master combines these
estimates (`nav.fusion`), corrects the strapdown with the result x_g, and every x_i is shifted by as much, so the
nominal state is the best one for all of them (closed loop: Zhu et al. 2020, section 4.3).

How information is shared, what is done about faults, and what speaks for which structure: `nav.federation`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from nav import aids
from nav.aids import Aid, GnssAid, MagnetometerAid
from nav.aids.base import OUTSIDE, Measurement, Ruling, refusals, report_on, without_position
from nav.alignment import Alignment, InitialState
from nav.batch import Batch
from nav.columns import Estimated, Estimates, Reported
from nav.detection import ChiSquareGate, chi_square_threshold, whiten
from nav.doubts import Doubts
from nav.error_model import MOTION, POS, VEL
from nav.federation import Config
from nav.fusion import reset
from nav.increments import Increments, Steps
from nav.local_filter import LocalFilter
from nav.master import MasterFilter, noise_shares
from nav.monitor import Change, Isolation, Monitor, shown_limit
from nav.realignment import Realignment
from nav.reference import (
    BAD_SAMPLE_S,
    FUSED,
    PREDICTED_PERIODS,
    RECENT_S,
    TIME_TOLERANCE,
    UNAIDED,
    FieldModel,
    Reference,
    align,
    forget,
    nothing_known,
)
from nav.samples import NO_SENSOR, Array, Estimate, GnssSample, ImuSamples, Outcome, Sample, Status, UpdateReport
from nav.state import State
from nav.weighting import InOrder, Policy, Weight

CROSS_CHECK_FALSE_ALARM = 1e-7  # of a filter at a fusion
CONTRADICTION_SHARE = 0.5  # of the largest contradiction: filters with less are not suspected of it


class Federated:
    """Strapdown closed by a master over local filters; see the estimator protocol in `nav.horizon`.

    It aligns itself from the first GNSS receiver and the first magnetometer of its locals (or `Config.alignment_aids`);
    `start` sets it at a known state instead. A sample is used by every local filter that has its sensor. ``events``
    lists the isolations.
    """

    def __init__(self, config: Config, field_n: FieldModel | None = None) -> None:
        self.config, self.field_n = config, field_n
        self.t = math.nan
        self.events: list[Isolation] = []
        gate = ChiSquareGate(1e-3)
        self.locals = [
            LocalFilter(config.imu, [w.aid for w in local.sensors], gate, row, closed=False, scaling=local.scaling)
            for row, local in enumerate(config.locals)
        ]
        self._users: dict[str, list[LocalFilter]] = {}
        for local, filter_ in zip(config.locals, self.locals, strict=True):
            for monitored in local.sensors:
                self._users.setdefault(monitored.aid.sensor, []).append(filter_)
                filter_.monitor(monitored, config.patience)
        # Rows of the state: the filters, then, with a recall, their younger shadows and their older ones.
        self._copies = 1 if config.recall_s is None else 3
        self._reference = Reference(
            [f.model for f in self.locals] * self._copies, noise_shares(config, config.shares, self._copies),
            config.covariance_period, field_n,
            scalings=[local.scaling for local in config.locals] * self._copies,
        )  # fmt: skip
        self.model = self.locals[0].model
        self._common = self._reference.common
        self._state: State | None = None
        self._last_bad = self._last_unsound = self._last_fused = -math.inf
        self._fused_at = self._remembered_at = -math.inf
        self._doubts = Doubts(self.locals, config.patience_s, gate.threshold(3))
        self._aligning = self._alignment_aids()
        used = [monitored.aid for local in config.locals for monitored in local.sensors]
        self._alignment = Alignment.from_aids(config.imu, [*self._aligning.values(), *used], config.alignment_s)
        self.realignment = Realignment(self._alignment, self._aligning, self._reference)
        self._batch = Batch(self.locals, self._reference)
        self._master = MasterFilter(config, self.locals, self._reference, self._copies)

    def _alignment_aids(self) -> dict[str, Aid]:
        """The first receiver and the first magnetometer."""
        found: dict[str, Aid] = {}
        for aid in (*(w.aid for local in self.config.locals for w in local.sensors), *self.config.alignment_aids):
            if isinstance(aid, (GnssAid, MagnetometerAid)) and not any(type(a) is type(aid) for a in found.values()):
                found[aid.sensor] = aid
        return found

    @property
    def shares(self) -> Array:
        """The share of each local filter, adding up to one."""
        return self._master.shares

    @property
    def aligned(self) -> bool:
        """Whether there is an attitude, a velocity and a position."""
        return self._state is not None

    @property
    def listening(self) -> bool:
        """Whether a sample of some kind would still be used."""
        return self._state is None or bool(self._users)

    @property
    def problem(self) -> str:
        """What the alignment is waiting for or why it refuses, empty once aligned."""
        return "" if self.aligned else self._alignment.problem

    def isolated(self) -> list[tuple[str, str, str]]:
        """(local, sensor, part) of what is isolated now, on any axis."""
        return [
            (local.name, *key)
            for local, filter_ in zip(self.config.locals, self.locals, strict=True)
            for key, monitor in filter_.monitors.items()
            if monitor.suspect
        ]

    def start(self, initial: InitialState) -> None:
        """Begin at a given state instead of aligning."""
        state = self._reference.start(initial, [self._alignment.names] * len(self._reference.models))
        common = self._common
        for row, share in enumerate(self._master.noise_shares()):
            reset(state.x[row], state.P[row], np.zeros(common), state.P[row, :common, :common] / share)
        self._state, self._draft = state, state.copy()
        self.t = self._last_fused = self._fused_at = self._remembered_at = initial.t
        self.realignment.begin(initial.t)
        self._doubts.begin(initial.t)
        self._master.kept.clear()

    def propagate(self, imu: ImuSamples) -> None:
        """Advance by a block of increments; a non-finite or impossible one is bridged with the last sound rates."""
        if len(imu) == 0:
            return
        if self._state is None:
            self._alignment.propagate(imu)
        else:
            self._last_bad = max(self._last_bad, self._reference.run(self._state, imu))
            self.realignment.propagate(imu)
        self.t = float(imu.t[-1])

    def accepts(self, sample: Sample) -> bool:
        """Whether the sample's sensor is an aid of some filter, or it can still serve the alignment."""
        return sample.sensor in (self._aligning if self._state is None else self._users)

    @np.errstate(over="ignore")  # of one that has diverged, as its covariances tell
    def update(self, sample: Sample) -> list[UpdateReport]:
        """Use a sample valid at the estimator's own time, else ValueError; a report per part and filter that has it."""
        if isinstance(sample, GnssSample) and not sample.has_fix:
            return []
        trouble = aids.problem(sample)
        if trouble:
            self._last_unsound = max(self._last_unsound, sample.t if math.isfinite(sample.t) else self.t)
            return self.refuse(sample, trouble)
        if not math.isnan(self.t) and abs(sample.t - self.t) > TIME_TOLERANCE:
            raise ValueError(f"sample at {sample.t} s, but the filter is at {self.t} s")
        state = self._state
        if state is None:
            initial = align(self._alignment, self._reference, sample) if sample.sensor in self._aligning else None
            if initial is not None:
                self.start(initial)
            return []
        self._reference.settle(state)
        isolated = any(w.suspect for f in self._users.get(sample.sensor, ()) for w in f.of_sensor[sample.sensor])
        kept = self.realignment.keeps(self, state, len(self.locals), sample, self._last_bad, not isolated)
        if kept is not None:
            for filter_ in self.locals:
                filter_.stand_in(sample)
            return kept
        reports: list[UpdateReport] = []
        for filter_ in self._users.get(sample.sensor, ()):
            reports += self._use(state, filter_, sample)
        for filter_ in self.locals:
            if (silent := filter_.stand_in(sample)) is not None:
                reports += [replace(report, sensor=NO_SENSOR) for report in self._use(state, filter_, silent)]
        if sample.t >= self.pauses_from:
            self._pause(state, sample.t)
        self.realignment.judge(self, state, len(self.locals), sample, reports, self._last_fused)
        return reports

    @property
    def pauses_from(self) -> float:
        """See `nav.batch.Taker`: when a fusion is due."""
        return self._fused_at + self.config.fusion_period_s - TIME_TOLERANCE

    def _pause(self, state: State, t: float) -> None:
        """Fuse."""
        config = self.config
        if config.cross_check:
            self._cross_check(state, t)
        self._master.fuse(state)
        self._fused_at = t
        if config.recall_s is not None and t - self._remembered_at >= config.recall_s - TIME_TOLERANCE:
            self._remember(state)
            self._remembered_at = t

    @property
    def in_steps(self) -> bool:
        """Whether it takes many steps at once."""
        return self._state is not None and self.config.weighting == "none" and not self._reference.scalings

    def take(self, steps: Steps, ahead: Increments, reports: Reported, estimates: Estimated) -> int:
        """Take the next of ``steps``, as far as they are plain: see `nav.horizon.TakesSteps`."""
        if self._state is None or self.realignment.under_way or self._doubts.fixes.pending:
            return 0
        taken, self._last_bad = self._batch.take(
            self, self._state, self._last_bad, self._last_fused, steps, ahead, reports, estimates
        )
        self.t = ahead.t
        last = steps.last(taken) if taken else None
        used = last is not None and not (isinstance(last, GnssSample) and not last.has_fix)
        if last is not None and used and last.t >= self.pauses_from:
            self._pause(self._state, last.t)
        return taken

    def trusted(self, sensor: str, t: float, before: float) -> bool:
        """See `nav.batch.Taker`."""
        return self._doubts.trusted(sensor, t, before)

    def took(self, sample: Sample) -> None:
        """See `nav.batch.Taker`."""
        if isinstance(sample, GnssSample):
            if not sample.has_fix:
                return
            self._last_fused = sample.t
            self._doubts.used(sample)

    def finish(self, sample: Sample, first: int) -> list[UpdateReport]:
        """See `nav.batch.Taker`."""
        assert self._state is not None
        return self._use(self._state, self._users[sample.sensor][0], sample, first)

    def told(self, wholes: Array, t: Array, status: Sequence[Status]) -> Estimates:
        """See `nav.batch.Taker`."""
        assert self._state is not None
        return self._master.told(wholes, self._state.shape, t, status, self._doubts.fixes.off(t))

    def refuse(self, sample: Sample, reason: str, outcome: Outcome = Outcome.UNSOUND) -> list[UpdateReport]:
        """Reports on a sample that is not used, without innovations (NaN), as `update` would give."""
        return [
            report
            for filter_ in self._users.get(sample.sensor, ())
            for report in refusals(sample, filter_.aids[sample.sensor], reason, self.t, outcome)
        ]

    def estimate(self) -> Estimate:
        """The fused state at the estimator's own time."""
        return self._estimate(self._drafted(), self.t, self._last_bad)

    def predict(self, imu: ImuSamples) -> Estimate:
        """The fused state after further increments, the estimator itself staying where it is."""
        state = self._drafted()
        last_bad = self._last_bad
        if state is not None and len(imu):
            last_bad = max(last_bad, self._reference.run(state, imu, PREDICTED_PERIODS, settle=True))
        return self._estimate(state, float(imu.t[-1]) if len(imu) else self.t, last_bad)

    def _drafted(self) -> State | None:
        """The state in arrays of its own, which are the same ones each time."""
        if self._state is None:
            return None
        self._draft.take(self._state)
        return self._draft

    def local(self, name: str) -> tuple[Array, Array]:
        """(x, P) of one local filter now: what it would add to the nominal state, its aids' errors; covariance."""
        assert self._state is not None
        row = [local.name for local in self.config.locals].index(name)
        size = self.locals[row].model.size
        return self._state.x[row, :size].copy(), self._state.P[row, :size, :size].copy()

    # --- one sample in one local filter

    def _use(self, state: State, filter_: LocalFilter, sample: Sample, first: int = 0) -> list[UpdateReport]:
        aid = filter_.aids[sample.sensor]
        reports: list[UpdateReport] = []
        withheld: Ruling | None = None
        for part, _ in aid.parts[first:]:
            measurement = filter_.measure(self._reference, state, aid, part, sample)
            if measurement is None:
                continue
            report = self._use_part(state, filter_, sample, part, measurement, withheld)
            if part == "gnss_position":
                if report.weight > 0:
                    self._last_fused = sample.t
                    self._doubts.fused()
                else:
                    withheld = without_position(Ruling(report.outcome, report.reason))
                if self._doubts.overruled(state, sample, measurement.nu, report):
                    self._give_in(state, sample)
            reports.append(report)
        return reports

    def _use_part(
        self, state: State, filter_: LocalFilter, sample: Sample, part: str, measurement: Measurement,
        withheld: Ruling | None,
    ) -> UpdateReport:  # fmt: skip
        t, monitor = sample.t, filter_.monitors[sample.sensor, part]
        nu, S, nis = filter_.innovate(state, measurement)
        withheld = withheld or measurement.withheld
        if withheld is not None and measurement.withheld is not None:
            return report_on(sample, part, nu, S, nis, math.nan, withheld)
        monitors = filter_.of_sensor[sample.sensor]
        suspect = any(w.suspect for w in monitors)
        if suspect and self._doubts.astray(sample):
            monitor.doubt()
        nu_judged, S_judged = self._against_master(state, filter_, sample, part) if suspect else (nu, S)
        decision, changed = monitor.judge(nu_judged, filter_.as_judged(part, sample, S_judged), t)
        if changed:
            self._note(t, filter_, sample.sensor, part, monitor)
            if changed is Change.READMITTED and not any(w.suspect for w in monitors):
                self._master.kept.discard(sample.sensor)
            if changed is Change.ISOLATED:
                self._take_back(state, filter_, sample, monitor)
                again = filter_.measure(self._reference, state, filter_.aids[sample.sensor], part, sample)
                assert again is not None  # as there was one
                measurement = again
                nu, S, nis = filter_.innovate(state, measurement)
        suspect, out = any(w.suspect for w in monitors), any(w.out for w in monitors)
        isolated = Ruling(Outcome.ISOLATED, "isolated")
        ruling = withheld or isolated
        if withheld is None and not out:
            used = decision.axis_mask & ~monitor.isolated if suspect else decision.axis_mask
            policy = self._policy(filter_, monitor)
            ruling = filter_.take(self._reference, state, measurement, nu, S, used, monitor.noise, policy, t)
        if out or monitor.suspect:
            ruling = isolated._replace(weight=ruling.weight)
        elif decision.alarm and withheld is None:
            ruling = OUTSIDE._replace(weight=ruling.weight)
        threshold = shown_limit(decision.threshold, decision.statistic, nis)
        return report_on(sample, part, nu, S, nis, threshold, ruling)

    def _policy(self, filter_: LocalFilter, monitor: Monitor) -> Policy | None:
        """What becomes of R in what ``monitor`` has just judged: its own policy, then the normalised weight."""
        if self.config.weighting == "none":
            return monitor.policy
        t, latest = monitor.judged, [monitor.suspicion]
        for other in self.locals:
            if other is not filter_:
                recent = [w.suspicion for w in other.monitors.values() if t - w.judged <= RECENT_S]
                latest.append(max(recent) if recent else math.inf)
        suspicions = np.array(latest)
        N = float(self.config.normalise(suspicions, np.ones(len(suspicions)))[0])
        if N == 1.0:
            return monitor.policy
        return Weight(N) if monitor.policy is None else InOrder([monitor.policy, Weight(N)])

    def _against_master(self, state: State, filter_: LocalFilter, sample: Sample, part: str) -> tuple[Array, Array]:
        """Innovation and covariance of a measurement against the fused solution of the healthy filters.

        What its own filter knows of the sensor's error given the common states goes with it. With a recall all filters
        are healthy: then its own was put back to what it knew before the fault. So they are where its own holds nothing
        of the fault (`_take_back`).
        """
        everyone = np.ones(len(self.locals))
        kept = self.config.recall_s is not None or sample.sensor in self._master.kept
        healthy = everyone if kept else self._master.sound(state)
        master = self._master.combine(state, healthy if healthy.any() else everyone)
        measurement = filter_.measure_at_nominal(self._reference, state, filter_.aids[sample.sensor], part, sample)
        assert measurement is not None
        x, P, common = state.x[filter_.row].copy(), self._master.charted(state, filter_.row), self._common
        change = -x
        change[:common] = 0.0  # the nominal state is without what the filter would add to it
        reset(x, P, master.x, master.P)
        change += x
        return measurement.nu - measurement.H @ change, measurement.H @ P @ measurement.H.T + np.diag(measurement.R)

    def _note(self, t: float, filter_: LocalFilter, sensor: str, part: str, monitor: Monitor) -> None:
        name = self.config.locals[filter_.row].name
        self.events.append(Isolation(t, name, sensor, part, tuple(map(bool, monitor.isolated))))

    def _take_back(self, state: State, faulty: LocalFilter, sample: Sample, monitor: Monitor) -> None:
        """Take out of the filters what a sensor told that is isolated now.

        That is nothing where it was far off at once, and was refused since: where others know much less they stay.
        """
        kept = self._master.kept
        if sample.sensor in kept or (monitor.sudden and self._master.rests_on(state, faulty.row)):
            kept.add(sample.sensor)
        elif self.config.recall_s is None:
            self._master.start_again(state, faulty, sample.sensor)
        else:
            self._recall(state, faulty)

    def _remember(self, state: State) -> None:
        """The younger shadows become the older ones, and the filters the younger."""
        n = len(self.locals)
        for values in (state.x, state.P):
            values[2 * n :] = values[n : 2 * n]
            values[n : 2 * n] = values[:n]

    def _recall(self, state: State, faulty: LocalFilter) -> None:
        """Put a filter back to its older shadow; the younger may hold some of the fault."""
        n, row = len(self.locals), faulty.row
        for values in (state.x, state.P):
            values[row] = values[n + row] = values[2 * n + row]

    def _cross_check(self, state: State, t: float) -> None:
        """Isolate the sensor behind a contradiction between filters, held against each other in velocity and position.

        It is the one whose own filter suspected it most of late: by its velocities, where it has some, for slow errors
        of positions make suspicions of their own.
        """
        against = np.zeros(len(healthy := self._master.healthy()))
        if healthy.sum() >= 2:
            for i in np.flatnonzero((healthy > 0) & ~self._master.lost(state)):
                others = self._master.combine(state, np.where(np.arange(len(healthy)) == i, 0.0, healthy))
                S = state.P[i, VEL:MOTION, VEL:MOTION] + others.P[VEL:MOTION, VEL:MOTION]
                against[i] = whiten(state.x[i, VEL:MOTION] - others.x[VEL:MOTION], S)[1]
        if not against.max() > chi_square_threshold(CROSS_CHECK_FALSE_ALARM, MOTION - VEL):
            return
        suspects = [self.locals[i] for i in np.flatnonzero(against >= CONTRADICTION_SHARE * against.max())]
        evidence = {
            (f, (sensor, part)): monitor.suspected
            for f in suspects
            for (sensor, part), monitor in f.monitors.items()
            if part != "gnss_position" or (sensor, "gnss_velocity") not in f.monitors
        }
        filter_, (sensor, _) = max(evidence, key=lambda which: evidence[which])
        for (name, part), monitor in filter_.monitors.items():
            if name == sensor:
                monitor.isolate()
                self._note(t, filter_, sensor, part, monitor)
        self._master.start_again(state, filter_, sensor)

    def _give_in(self, state: State, sample: Sample) -> None:
        """Believe the fixes: receivers are sound from now on, positions and velocities are given up."""
        for filter_, local in zip(self.locals, self.config.locals, strict=True):
            for monitored in local.sensors:
                monitors = filter_.of_sensor[monitored.aid.sensor]
                if isinstance(monitored.aid, GnssAid) and any(w.suspect for w in monitors):
                    filter_.monitor(monitored, self.config.patience)
                    for part, monitor in zip(monitored.aid.parts, filter_.of_sensor[monitored.aid.sensor], strict=True):
                        self._note(sample.t, filter_, monitored.aid.sensor, part[0], monitor)
        self._master.kept.clear()
        self._widen(state, sample)

    def _widen(self, state: State, sample: Sample) -> None:
        off, variance, alone = np.zeros(3), np.zeros(3), False
        filter_ = self._users[sample.sensor][0]
        aid = filter_.aids[sample.sensor]
        for part, start in (("gnss_position", POS), ("gnss_velocity", VEL)):
            if part not in [name for name, _ in aid.parts]:
                continue
            measurement = filter_.measure(self._reference, state, aid, part, sample)
            if measurement is None:
                continue
            nu, S, nis = filter_.innovate(state, measurement)
            if part == "gnss_velocity" and nis <= filter_.gate.threshold(3):
                continue
            off, variance, alone = (nu, np.diag(S), True) if part == "gnss_position" else (off, variance, False)
            there = nu + state.x[filter_.row, start : start + 3]  # as another filter may be elsewhere
            for i, share in enumerate(np.tile(self._master.reset_shares(), self._copies)):
                forget(state.P[i], start, ((there - state.x[i, start : start + 3]) ** 2 + np.diag(S)) / share)
            if part == "gnss_velocity":
                for local in self.locals:
                    local.forget_air(state)
        self._doubts.gave_in(off, variance, alone)

    def _estimate(self, state: State | None, t: float, last_bad: float) -> Estimate:
        """The estimate at ``t`` from a ``state`` that may be changed."""
        status = self.status(t, last_bad)
        if state is None:
            return nothing_known(t, status)
        self._reference.settle(state)
        return self.told(state.whole[None].copy(), np.array([t]), [status])[0]

    def status(self, t: float, last_bad: float) -> Status:
        """What it says of itself at ``t``; see `nav.batch.Taker`."""
        status = Status.ALIGNING if self._state is None else FUSED if t - self._last_fused <= RECENT_S else UNAIDED
        return status | Status.BAD_SAMPLE if t - max(last_bad, self._last_unsound) <= BAD_SAMPLE_S else status
