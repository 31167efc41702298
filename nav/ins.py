"""Inertial navigation closed by one error-state Kalman filter.

The strapdown runs at the rate of the IMU; the covariance every `InsConfig.covariance_period` samples, with the
transition of the whole period; estimated errors are put into the state at once, so the error state itself is always
zero. Between calls nothing depends on how the increments were cut into blocks: what has not yet been put into the
covariance is kept as integrals until the period is full or a measurement comes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nav import aids
from nav.aids import Aid, AirspeedAid, BarometerAid, GnssAid, MagnetometerAid, RangefinderAid
from nav.aids.base import Ruling, refusals, report_on, without_position
from nav.aids.gnss import has_velocity
from nav.aids.terrain import TERRAIN
from nav.alignment import Alignment, InitialState
from nav.batch import Batch
from nav.columns import Estimated, Estimates, Reported
from nav.detection import PROBATION_S, RECOVERY_S, ChiSquareGate, GnssMonitor, Refusals, Verdict
from nav.doubts import RULINGS, FixDoubt, WindDoubt
from nav.error_model import MOTION, POS, VEL, ImuModel
from nav.increments import Increments, Steps
from nav.local_filter import LocalFilter
from nav.motion import TurnDetector
from nav.realignment import Realignment
from nav.reference import (
    BAD_SAMPLE_S,
    FUSED,
    PREDICTED_PERIODS,
    RECENT_S,
    REPORTED,
    TIME_TOLERANCE,
    UNAIDED,
    FieldModel,
    Reference,
    align,
    described,
    forget,
    nothing_known,
    spread,
)
from nav.samples import (
    NO_SENSOR,
    Array,
    Estimate,
    GnssSample,
    ImuSamples,
    MagnetometerSample,
    Outcome,
    PositionSample,
    Sample,
    Status,
    UpdateReport,
    WindSample,
)
from nav.smoother import Smoother
from nav.state import State, known
from nav.unscented import Scaling
from nav.weighting import Fading, Policy

# Relief refused for so long contradicts the position or the sensor. A filter that follows a slope of the map where it
# is not takes its error for wind: so much, and since then. A sensor may be off by so much, as the ground may be.
ASTRAY_S, ASTRAY_MPS, ASTRAY_LASTING_S, ASTRAY_HEIGHT_M = 10.0, np.array([3.0, 3.0]), 60.0, 100.0
REOPENED = "outside the gate for long: its bias is as good as unknown"


@dataclass(frozen=True)
class InsConfig:
    """What the filter is told: SI, radians, body axes from the IMU.

    ``aids`` are the sensors whose samples it uses, one GNSS receiver at most; ``alignment_aids`` serve the alignment
    only.
    """

    imu: ImuModel
    aids: tuple[Aid, ...] = (GnssAid(), BarometerAid(), MagnetometerAid(), AirspeedAid())
    alignment_aids: tuple[Aid, ...] = ()
    mounting_sigma: float = 0.0  # between the axes of the IMU, whose attitude is found, and of the body, reported [rad]
    covariance_period: int = 10  # IMU samples per covariance step; 50 ms and less lose nothing on an aircraft
    scaling: Scaling | None = None  # of sigma points instead of derivatives
    smooth: bool = False  # keeps what it does, to look back in the end (`Ins.smoothed`); not with sigma points

    # Belief
    false_rejection: float = 1e-3  # probability that the gate turns a sound measurement away; 0: there is no gate
    outage_s: float = 10.0  # this long without a fused position is an outage
    probation_s: float = PROBATION_S  # fixes must agree with each other for this long after it
    recovery_s: float = RECOVERY_S  # after an outage, fixes that agree for this long overrule the filter
    patience_s: float = 30.0  # the longest, without an outage (see `GnssMonitor`); so long is a bias held, too

    alignment_s: float = 2.0  # shortest time over which the initial attitude is found

    def __post_init__(self) -> None:
        if sum(isinstance(aid, GnssAid) for aid in self.aids) > 1:
            raise ValueError("one GNSS receiver can be aided by: several make a federation")
        if self.covariance_period < 1:
            raise ValueError("covariance_period is a number of samples, at least 1")
        if self.smooth and self.scaling is not None:
            raise ValueError("what sigma points did can't be smoothed")


class Ins:
    """Strapdown closed by one local filter; see the estimator protocol in `nav.horizon`.

    ``field_n`` gives the reference magnetic field (3,) [T], NED, at (lat, lon, h); without it the magnetometer is not
    used. ``policies`` may weigh parts of samples by their names, such as ``gnss_velocity``, and ``fadings`` the P that
    they meet. The filter aligns itself from the samples it is given; `start` sets it at a known state instead.
    """

    def __init__(
        self,
        config: InsConfig,
        field_n: FieldModel | None = None,
        policies: Mapping[str, Policy] | None = None,
        fadings: Mapping[str, Fading] | None = None,
    ) -> None:
        self.config, self.field_n = config, field_n
        self.t = math.nan
        self._gate = ChiSquareGate(config.false_rejection)
        self._filter = LocalFilter(config.imu, config.aids, self._gate, scaling=config.scaling)
        self._filter.weigh_by(policies or {})
        self._filter.fadings = fadings or {}
        self.model = self._filter.model
        self._smoother = self._filter.smoother = Smoother(self.model) if config.smooth else None
        self._reference = Reference([self.model], [1.0], config.covariance_period, field_n, config.scaling)
        self._gnss = next((aid for aid in config.aids if isinstance(aid, GnssAid)), None)
        course = self._gnss.course if self._gnss is not None else None
        self._turns = TurnDetector(course.max_turn_rate, course.quiet_s) if course is not None else None
        self._monitor = GnssMonitor(
            config.outage_s, config.probation_s, config.recovery_s, config.patience_s, self._gate.threshold(3)
        )
        self._refusals = {name: Refusals(config.patience_s) for name in self._filter.aids if self._bias_of(name)}
        self._astray = {
            aid.sensor: Refusals(ASTRAY_S) for aid in config.aids if isinstance(aid, RangefinderAid) and aid.search
        }
        self._winds = self._filter.wind_memory()
        self._wind_doubt = WindDoubt(self._gate.threshold(2))
        self._fix_doubt = FixDoubt()
        self._last_bad = self._last_unsound = -math.inf  # when an increment, a sample was refused as unsound last
        self._state: State | None = None
        self._alignment = Alignment.from_aids(config.imu, config.aids + config.alignment_aids, config.alignment_s)
        self.realignment = Realignment(self._alignment, self._filter.aids, self._reference, self._smoother)
        self._batch = Batch([self._filter], self._reference)
        self._takes_steps = not (config.smooth or config.scaling or course)
        self._extra = [(name, where) for name, where in self.model.slices.items() if name not in REPORTED]

    @property
    def aligned(self) -> bool:
        """Whether there is an attitude, a velocity and a position."""
        return self._state is not None

    @property
    def listening(self) -> bool:
        """Whether a sample of some kind would still be used."""
        return self._state is None or bool(self.config.aids)

    @property
    def problem(self) -> str:
        """What the alignment is waiting for or why it refuses, empty once aligned."""
        return "" if self.aligned else self._alignment.problem

    def start(self, initial: InitialState) -> None:
        """Begin at a given state instead of aligning."""
        self._state = self._reference.start(initial, [self._alignment.names])
        self._draft = self._state.copy()
        self._fix_doubt.begin(initial.t, self._monitor)
        self.t = self._monitor.last_fused = initial.t
        self.realignment.begin(initial.t)
        self._filter.claim_as_told(self._reference, self._state)
        if self._smoother is not None:
            self._smoother.begin(self.t, self._state)

    def set_gate(self, false_rejection: float) -> None:
        """From now on, turn sound measurements away with this probability (`InsConfig.false_rejection`)."""
        self._gate = self._filter.gate = ChiSquareGate(false_rejection)
        self._monitor.consistency_gate = self._gate.threshold(3)

    def propagate(self, imu: ImuSamples) -> None:
        """Advance by a block of increments; a non-finite or impossible one is bridged with the last sound rates."""
        if len(imu) == 0:
            return
        if self._turns is not None:
            self._turns.push(imu)
        if self._state is None:
            self._alignment.propagate(imu)
        else:
            if self._smoother is not None:
                self._smoother.carry(self._state, imu)
            self._last_bad = max(self._last_bad, self._reference.run(self._state, imu))
            self.realignment.propagate(imu)
        self.t = float(imu.t[-1])

    @property
    def in_steps(self) -> bool:
        """Whether it takes many steps at once."""
        return self._takes_steps and self._state is not None

    def take(self, steps: Steps, ahead: Increments, reports: Reported, estimates: Estimated) -> int:
        """Take the next of ``steps``, as far as they are plain: see `nav.horizon.TakesSteps`."""
        if self._state is None or self.realignment.under_way or self._fix_doubt.pending or self._wind_doubt.pending:
            return 0
        taken, self._last_bad = self._batch.take(
            self, self._state, self._last_bad, self._monitor.last_fused, steps, ahead, reports, estimates
        )
        self.t = ahead.t
        return taken

    def trusted(self, sensor: str, t: float, before: float) -> bool:
        """See `nav.batch.Taker`."""
        return self._monitor.sure(t, before) and not (self._winds is not None and self._winds.due(t))

    @property
    def pauses_from(self) -> float:
        """See `nav.batch.Taker`: never."""
        return math.inf

    def took(self, sample: Sample) -> None:
        """See `nav.batch.Taker`."""
        if isinstance(sample, GnssSample):
            if not sample.has_fix:
                self._monitor.heard(sample.t)
                return
            self._monitor.judge(sample, sample.v_n, sample.sigma_velocity_n, inside_gate=True)
        elif (refusals := self._refusals.get(sample.sensor)) is not None:
            refusals.taken()

    def finish(self, sample: Sample, first: int) -> list[UpdateReport]:
        """See `nav.batch.Taker`."""
        aid, state = self._filter.aids[sample.sensor], self._state
        assert state is not None
        self.t = sample.t
        if isinstance(sample, GnssSample) and isinstance(aid, GnssAid):
            return self._update_gnss_further(state, sample, aid, None)
        return self._update_part_by_part(state, sample, aid, first)

    def told(self, wholes: Array, t: Array, status: Sequence[Status]) -> Estimates:
        """See `nav.batch.Taker`."""
        return self._described(wholes, t, status, self._fix_doubt.off(t))

    def accepts(self, sample: Sample) -> bool:
        """Whether the sample is of an aid, or can still serve the alignment."""
        if self._state is None:
            return isinstance(sample, (GnssSample, MagnetometerSample))
        return sample.sensor in self._filter.aids

    def update(self, sample: Sample) -> list[UpdateReport]:
        """Use a sample valid at the filter's own time (ValueError otherwise: `nav.horizon.FusionHorizon` sees to that).

        One report per aid; an unsound sample is refused and reported; none for a GNSS sample without fix, for a kind
        that is not among the aids, and during alignment.
        """
        if isinstance(sample, GnssSample) and not sample.has_fix:
            self._monitor.heard(sample.t)
            return []
        trouble = aids.problem(sample)
        if trouble:
            self._last_unsound = max(self._last_unsound, sample.t if math.isfinite(sample.t) else self.t)
            return self.refuse(sample, trouble)
        if not math.isnan(self.t) and abs(sample.t - self.t) > TIME_TOLERANCE:
            raise ValueError(f"sample at {sample.t} s, but the filter is at {self.t} s")
        state = self._state
        if state is None:
            initial = align(self._alignment, self._reference, sample)
            if initial is not None:
                self.start(initial)
            return []
        aid = self._filter.aids.get(sample.sensor)
        if aid is None:
            return []
        self._reference.settle(state)
        if (kept := self.realignment.keeps(self, state, 1, sample, self._last_bad)) is not None:
            self._filter.stand_in(sample)
            return kept
        if isinstance(sample, GnssSample) and isinstance(aid, GnssAid):
            reports = self._update_gnss(state, sample, aid)
        else:
            reports = self._update_part_by_part(state, sample, aid)
        if (silent := self._filter.stand_in(sample)) is not None:
            known = self._update_part_by_part(state, silent, self._filter.aids[silent.sensor])
            reports += [replace(report, sensor=NO_SENSOR) for report in known]
        if self._smoother is not None:
            self._smoother.pause(self.t, state)
        self.realignment.judge(self, state, 1, sample, reports, self._monitor.last_fused)
        return reports

    def _update_part_by_part(self, state: State, sample: Sample, aid: Aid, first: int = 0) -> list[UpdateReport]:
        reports = []
        for part, _ in aid.parts[first:]:
            measurement = self._filter.measure(self._reference, state, aid, part, sample)
            if measurement is not None:
                report = self._filter.fuse(self._reference, state, sample, part, measurement)
                if sample.sensor in self._astray:
                    report = self._unless_astray(state, sample, report)
                elif isinstance(sample, WindSample):
                    report = self._hear_of_wind(state, sample, aid, measurement.R, report)
                else:
                    report = self._unless_lasting(state, sample, aid, report)
                if isinstance(sample, PositionSample) and report.weight:
                    for refused in self._astray.values():
                        refused.taken()
                reports.append(report)
        return reports

    def _hear_of_wind(self, state: State, sample: WindSample, aid: Aid, R: Array, report: UpdateReport) -> UpdateReport:
        """What becomes of a wind report, given what its gate made of it: see `WindDoubt`."""
        self._wind_doubt.right(self._monitor.last_fused)
        if report.outcome is not Outcome.OUTSIDE_GATE:
            if report.weight > 0:
                self._wind_doubt.right(sample.t - sample.age, told=True)
            return report
        if self._aided(sample.t) or not self._wind_doubt.refused(sample, report.innovation, R):
            return report
        self._filter.reopen_wind(state, report.innovation, self._wind_doubt.lasting(sample.t))
        self._wind_doubt.right(sample.t, told=True)
        again = self._filter.measure(self._reference, state, aid, report.aid, sample)
        assert again is not None  # as there was one
        report = self._filter.fuse(self._reference, state, sample, report.aid, again)
        return replace(report, reason="outside the gate, but as the report before: the wind was opened again")

    def _unless_astray(self, state: State, sample: Sample, report: UpdateReport) -> UpdateReport:
        """The ``report`` on a range; refused for `ASTRAY_S` without fixes, they open the position, and it is searched.

        The search goes by the shape of the ground, which a sensor that is off leaves as it is.
        """
        refused = self._astray[sample.sensor]
        if aided := bool(report.weight or self._aided(sample.t)):
            refused.taken()
        if aided or report.outcome is not Outcome.OUTSIDE_GATE or not refused.too_long(sample.t):
            return report
        refused.taken()
        self._filter.reopen_wind(state, ASTRAY_MPS, ASTRAY_LASTING_S)
        if TERRAIN in self.model.slices:
            forget(state.P[0], self.model.slices[TERRAIN].start, np.array([ASTRAY_HEIGHT_M**2]))
        return replace(report, reason="outside the gate for long: the position is searched again")

    def _unless_lasting(self, state: State, sample: Sample, aid: Aid, report: UpdateReport) -> UpdateReport:
        """The ``report`` on a part of a sample, or that of its fusion with the aid's bias open again.

        That is one that was refused for ``patience_s`` while GNSS was not. What is refused by a filter that has nothing
        else to go by stays so: its own sigma grows until it gives in.
        """
        refusals = self._refusals.get(sample.sensor)
        if refusals is None or report.outcome is not Outcome.OUTSIDE_GATE:
            if refusals is not None and report.weight:
                refusals.taken()
            return report
        if not (refusals.too_long(sample.t) and self._aided(sample.t)):
            return report
        refusals.taken()
        bias = self._bias_of(sample.sensor)
        assert bias is not None
        off = report.innovation**2 + np.diag(report.S)
        forget(state.P[0], bias.start, np.maximum(self.model.sigma[bias] ** 2, off))
        wide = self._filter.measure(self._reference, state, aid, report.aid, sample)
        assert wide is not None
        return replace(self._filter.fuse(self._reference, state, sample, report.aid, wide), reason=REOPENED)

    def _bias_of(self, sensor: str) -> slice | None:
        """Where the bias of a sensor lies, in the units and axes that it measures in; None where it is no state."""
        return self.model.slices.get(f"{sensor}_bias")

    def _aided(self, t: float) -> bool:
        """Whether a position was fused of late."""
        return self._gnss is not None and t - self._monitor.last_fused <= RECENT_S

    def smoothed(self, times: Sequence[float]) -> Iterator[Estimate]:
        """The estimates at ``times`` [s], ascending, by all samples used so far; from the alignment to its own time.

        Raises ValueError where the filter was not told to keep what they need (`InsConfig.smooth`).
        """
        if self._smoother is None:
            raise ValueError("this filter was not told to keep what smoothing needs: see InsConfig.smooth")
        for t, state in self._smoother.states(times):
            yield self._described(state.whole[None].copy(), np.array([t]), [Status.ALIGNED], np.zeros((1, MOTION)))[0]

    def refuse(self, sample: Sample, reason: str, outcome: Outcome = Outcome.UNSOUND) -> list[UpdateReport]:
        """Reports on a sample that is not used, without innovations (NaN): one for each aid it would have served."""
        aid = self._filter.aids.get(sample.sensor)
        return [] if aid is None else refusals(sample, aid, reason, self.t, outcome)

    def estimate(self) -> Estimate:
        """The state at the filter's own time."""
        return self._estimate(self._drafted(), self.t, self._last_bad)

    def predict(self, imu: ImuSamples) -> Estimate:
        """The state after further increments, the filter itself staying where it is."""
        state, last_bad = self._drafted(), self._last_bad
        if state is not None and len(imu):
            last_bad = max(last_bad, self._reference.run(state, imu, PREDICTED_PERIODS, settle=True))
        return self._estimate(state, float(imu.t[-1]) if len(imu) else self.t, last_bad)

    def _drafted(self) -> State | None:
        """The state in arrays of its own, which are the same ones each time."""
        if self._state is None:
            return None
        self._draft.take(self._state)
        return self._draft

    def _update_gnss(self, state: State, sample: GnssSample, aid: GnssAid) -> list[UpdateReport]:
        measurement = self._filter.measure(self._reference, state, aid, "gnss_position", sample)
        assert measurement is not None
        nu, H, R, at_points = measurement.nu, measurement.H, measurement.R, measurement.at_points
        S, nis = self._filter.absorb(self._reference, state, nu, H, R, -math.inf, at_points)
        with_velocity = has_velocity(sample)
        v_n, sigma_v = (
            (sample.v_n, self._filter.learned_sigma("gnss_velocity", sample.sigma_velocity_n))
            if with_velocity
            else (state.v_n.copy(), np.sqrt(np.diag(state.P[0])[VEL : VEL + 3]))
        )
        statistic, threshold, shown = self._filter.gated("gnss_position", sample, nu, S, nis)
        sigma_p = self._filter.learned_sigma("gnss_position", sample.sigma_position_n)
        use_velocity, inside, odds, both = with_velocity and aid.use_velocity, statistic <= threshold, 0.0, False
        if not inside:
            odds = self._filter.odds(self._winds, state, v_n, sample.t)
            off = self._filter.off(self._reference, state, aid, "gnss_velocity", sample) if use_velocity else None
            both = off is not None and self._monitor.led(sample.t, nu[:2])
        fix = sample if sigma_p is sample.sigma_position_n else replace(sample, sigma_position_n=sigma_p)
        verdict = self._monitor.judge(fix, v_n, sigma_v, inside, odds, both)
        if verdict is not Verdict.PROBATION:
            self._filter.heard(self._reference, state, "gnss_position", sample, nis, 3)
        self._fix_doubt.heard(nu, v_n - state.v_n, self._monitor)
        if verdict is Verdict.RECOVER:
            self._give_up_position(state, sample, aid, nu, S, use_velocity)
        ruling = RULINGS[verdict]
        if verdict is Verdict.FUSE:
            self._filter.remember_wind(self._winds, state, sample.t)
            ruling = self._filter.weigh(self._reference, state, sample, "gnss_position", measurement, S)
        elif verdict is Verdict.RECOVER:
            wide = self._filter.measure(self._reference, state, aid, "gnss_position", sample)
            assert wide is not None
            S, nis = self._filter.absorb(self._reference, state, nu, H, wide.R, math.inf, wide.at_points)
            shown = threshold
        withheld = None if ruling.weight else without_position(ruling)
        position = report_on(sample, "gnss_position", nu, S, nis, shown, ruling)
        return [position, *self._update_gnss_further(state, sample, aid, withheld)]

    def _update_gnss_further(
        self, state: State, sample: GnssSample, aid: GnssAid, withheld: Ruling | None
    ) -> list[UpdateReport]:
        """Velocity and course of a fix whose position was used, or ``withheld``."""
        reports = []
        if has_velocity(sample) and aid.use_velocity:
            velocity = self._filter.measure(self._reference, state, aid, "gnss_velocity", sample)
            assert velocity is not None
            reports.append(self._filter.fuse(self._reference, state, sample, "gnss_velocity", velocity, withheld))
        if self._turns is not None and self._turns.straight(sample.t):
            course = self._filter.measure(self._reference, state, aid, "gnss_course", sample)
            if course is not None:
                reports.append(self._filter.fuse(self._reference, state, sample, "gnss_course", course, withheld))
        return reports

    def _give_up_position(
        self, state: State, sample: GnssSample, aid: Aid, nu: Array, S: Array, use_velocity: bool
    ) -> None:
        """Make the covariance as wide as the innovation says; the rest of the state keeps what it knows.

        When velocity is off as well, it goes too, and with it wind and gusts that were estimated from it.
        """
        P = state.P[0]
        self._fix_doubt.gave_in(self._monitor.since, nu, np.diag(S), self._monitor.unexplained)
        self._filter.claim_as_told(self._reference, state)
        off = self._filter.off(self._reference, state, aid, "gnss_velocity", sample) if use_velocity else None
        if off is not None:
            forget(P, VEL, off)
            self._filter.forget_air(state)
        forget(P, POS, nu**2 + np.diag(S))

    def _estimate(self, state: State | None, t: float, last_bad: float) -> Estimate:
        """The estimate at ``t`` from a ``state`` that may be changed."""
        status = self.status(t, last_bad)
        if state is None:
            return nothing_known(t, status)
        self._reference.settle(state)
        self._wind_doubt.right(self._monitor.last_fused)
        when = np.array([t])
        doubt = self._fix_doubt.off(when) + self._wind_doubt.off(t)
        return self._described(state.whole[None].copy(), when, [status], doubt)[0]

    def status(self, t: float, last_bad: float) -> Status:
        """What it says of itself at ``t``; see `nav.batch.Taker`."""
        status = Status.ALIGNING if self._state is None else FUSED if self._aided(t) else UNAIDED
        return status | Status.BAD_SAMPLE if t - max(last_bad, self._last_unsound) <= BAD_SAMPLE_S else status

    def _described(self, wholes: Array, t: Array, status: Sequence[Status], doubt: Array) -> Estimates:
        """The estimates of N settled states (N, numbers), with a ``doubt`` (N, 9) of their motion."""
        assert self._state is not None
        n = self._state.shape[2]
        q_nb, v_n, lla, imu, filters, first = known(wholes, *self._state.shape)
        x = filters[:, 0]
        x[:, : imu.shape[1]] = imu
        covariance, sigma = spread(wholes, first, n, self.config.mounting_sigma**2, doubt)
        extra = {name: (x[:, where], sigma[:, where]) for name, where in self._extra}
        return described(t, status, (q_nb, v_n, lla), x, (wholes, first), self.model, covariance, sigma, extra)
