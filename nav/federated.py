"""A federated filter: several local filters over one strapdown, whose master fuses what they found (Carlson's scheme).

Every local filter holds the common states, motion and errors of the IMU, and the errors of its own aids. Between
corrections local filter i estimates the error of the one nominal state that all share; the master combines these
estimates (`Config.combination`), corrects the strapdown with the result x_g, and every x_i is shifted by as much, so
the nominal state is the best one for all of them (closed loop: Zhu et al. 2020, section 4.3).

Sharing. The common process noise and initial covariance reach every filter, which correlates their errors. With shares
beta_i that add up to one, filter i is told Q / beta_i and P0 / beta_i: then the sum of their information claims no more
than there is, whatever the correlation (Cui et al. 2022, Eq 7; needed without resets too).

Structure. ``no_reset``: the filters stay independent. ``full_reset``: after each fusion x_i = x_g, P_i = P_g / beta_i.
``partial``: P_i^-1 <- (1 - alpha) P_i^-1 + alpha beta_i P_g^-1, and x_i likewise, alpha being the retention. What a
filter knows of its own aids given the common states is kept through any reset (`reset`).

Fusion is on the common states: the sub-block of P_i is taken, not that of its inverse, which marginalises the rest.

Faults. Each part of a sensor's looks has a detector, which judges the innovation against its local filter; condemned
axes are left out, and isolated when that lasts (`nav.local_filter.Watch`); a sensor with one part isolated on every
axis is isolated as a whole. While any part of a sensor is isolated it is judged against the fused solution of the
filters without an isolated part, since its own filter drifts, or is wrong. A fault
that grows slowly has pulled its filter before it is found. Therefore on every isolation all filters start again from
the fused solution of those without an isolated part, P_i = P_g / beta_i: what the faulty sensor told stays in none,
nothing is counted twice, and the Markov errors of its aid go back to their first variance. Filters with an isolated
part get next to no share of it: what they hold is lost when another part is isolated. When all filters have an isolated
part, they are left as they are.

Which structure finds faults: with ``no_reset`` a fault stays in its own filter until it is found, but a filter that is
alone with a poor IMU follows a spoofer whose velocity grows slowly together with its position, and never notices: that
takes a cross-check. With ``full_reset`` the fault reaches all filters until it is found, but every look is judged by
what all sensors predict, and the sound receiver keeps that prediction with the IMU. Without aid in an outage
``full_reset`` is as good as one filter with every sensor; without resets nobody combines one filter's wind with
another's heading.

Cross-check. A fault that grows as smoothly as the aircraft could move drags its own filter along and is never seen
there; but then the filters contradict each other. With ``cross_check``, before a fusion each filter without an isolated
part is compared with the fused solution of the others in position and velocity, which the sharing has made independent:
(x_i - x_o)' (P_i + P_o)^-1 (x_i - x_o) is chi-square of six degrees of freedom at most. When one exceeds its limit, a
filter is wrong: of two that contradict each other as strongly it is the one whose own detectors have more evidence
(`Watch.suspicion`): little, but the other has none, provided that they remember the onset as `nav.detection.Glr` does.
That sensor is isolated. With resets all filters tell the same and nothing can be compared: it needs ``no_reset``.
Without a third to tell who is wrong, that is the weakest link: a fault so slow that no detector has evidence of its
onset is found, but may be laid on the wrong one of two receivers.

Weighting. ``normalised`` weakens a look before its detector condemns it: its variances become R / N with the weight of
`nav.weighting.normalised_weights` (Zhou et al. 2025, Eq 22-26) from its own statistic and that of every other filter,
each filter counting by the most suspect of its latest looks. A filter without one in the last seconds has no say.

A policy that learns R (`nav.weighting.SageHusa`) is asked before the detector, which judges by what was learned. What
is condemned or isolated teaches nothing: a sensor so much noisier than it says that it is isolated before its R is
known stays so, as a faulty one would. A detector that keeps the sound axes, or gathers evidence, leaves it the time.

Engines. A filter with a `Local.scaling` works by sigma points around its own estimate, nominal state and x together,
which may be tens of degrees from the nominal one: there x of the attitude is a rotation vector and is composed, not
added. Its P is of its own estimate's error, and is turned into x's for the fusion and back after a reset
(`nav.reference.turned`). Fused at once or seldom, one such filter is the closed one of `nav.ins`. A linear filter
beside it may be wrong about a heading far off and sure of itself, and then the fusion is: all that shall find one need
the engine.

When every position was refused for ``patience_s``, the filters were too sure of themselves: their positions and
velocities are given up as in `nav.ins`, and the next fixes are believed.

Starting again from the others is costly when they don't know what the isolated filter knew. With ``recall_s``, and
without resets, each filter has two shadows, carried along without measurements and renewed in turn every ``recall_s``
(two shadow filters: Da, J. Guidance 17, 1994). An isolation then puts this one filter back to its older shadow,
``recall_s`` to twice that old, and leaves the others; what was told before the shadow was taken stays, so the fault
must be found sooner. The isolated sensor is judged against the fused solution of all filters, which are sound then.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from nav import aiding
from nav._jit import njit
from nav.alignment import AidSigmas, Alignment, InitialState
from nav.detection import ChiSquareGate, chi_square_threshold, whiten
from nav.error_model import MOTION, POS, VEL, ImuModel
from nav.local_filter import (
    OUTSIDE,
    Aid,
    AirspeedAid,
    Change,
    GnssAid,
    LocalFilter,
    Look,
    MagnetometerAid,
    Ruling,
    Watch,
    Watched,
    refusals,
    report_on,
    without_position,
)
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
    State,
    align,
    describe,
    forget,
    inject,
    nothing_known,
    spread,
    turned,
)
from nav.samples import (
    Array,
    Estimate,
    GnssSample,
    ImuSamples,
    Outcome,
    Sample,
    Status,
    UpdateReport,
)
from nav.unscented import Scaling
from nav.weighting import InOrder, Policy, Weight, normalised_weights

Structure = Literal["no_reset", "full_reset", "partial"]
Sharing = Literal["fixed", "by_covariance", "none"]
Combination = Literal["information", "scalar", "covariance_intersection"]
Weighting = Literal["none", "normalised"]

CROSS_CHECK_FALSE_ALARM = 1e-7  # of a filter at a fusion
LOST_M = 1e4  # 1-sigma of a position that tells nothing any more, neither does its error model: it is not compared
CONTRADICTION_SHARE = 0.5  # of the largest contradiction: filters with less are not suspected of it
REFUSAL_GAP_S = 10.0  # without a refused position for longer, the refusals begin anew
LEAST_SHARE = 0.02  # of a filter with an isolated part, or when shares follow the covariances: it must come back


@dataclass(frozen=True)
class Local:
    """One local filter: its sensors; ``share`` of the information, all alike when no filter has one.

    With a ``scaling`` it works by sigma points instead of derivatives.
    """

    name: str
    sensors: tuple[Watched, ...]
    share: float | None = None
    scaling: Scaling | None = None


@dataclass(frozen=True)
class Config:
    """What the federation is told.

    ``literal`` takes the weights of the scalar combination from Zhu et al. 2020, Eq 13, as printed: they mix units, are
    decided by the gyro biases and hardly react to a filter whose position is lost. It also takes the normalised weights
    from Zhou et al. 2025, Eq 22-25, as printed: every R is multiplied by the number of filters when nothing is wrong.
    """

    imu: ImuModel
    locals: tuple[Local, ...]
    structure: Structure = "no_reset"
    sharing: Sharing = "fixed"
    combination: Combination = "information"
    retention: float = 0.5  # alpha of ``partial``: 0 is no reset, 1 a full one
    weighting: Weighting = "none"
    literal: bool = False
    fusion_period_s: float = 1.0  # at the first aiding epoch after this; 0 is at every one
    isolate_after: int = 3  # consecutive condemned looks
    readmit_after: int = 10  # consecutive sound looks
    recall_s: float | None = None  # age of what an isolated filter goes back to; None: to the others' solution
    cross_check: bool = False  # of the filters' solutions, at every fusion
    patience_s: float = 30.0  # of refused positions and none fused
    covariance_period: int = 10  # IMU samples per covariance step
    mounting_sigma: float = 0.0  # between the axes of the IMU and of the body [rad]
    alignment_s: float = 2.0
    alignment_aids: tuple[Aid, ...] = ()  # sensors that serve the alignment only

    def __post_init__(self) -> None:
        names = [local.name for local in self.locals]
        if not names or len(set(names)) < len(names):
            raise ValueError("a federation needs local filters, each with a name of its own")
        given = [local.share for local in self.locals if local.share is not None]
        if given and (len(given) < len(names) or min(given) <= 0 or abs(sum(given) - 1) > 1e-6):
            raise ValueError("give every local filter a positive share so that they add up to 1, or none of them")
        if not 0 <= self.retention <= 1:
            raise ValueError(f"retention {self.retention} is no fraction from 0 to 1")
        if self.recall_s is not None and self.structure != "no_reset":
            raise ValueError(f"structure {self.structure!r} spreads what recall_s would take back from one filter")
        if self.cross_check and (self.structure != "no_reset" or self.combination != "information"):
            raise ValueError("cross_check compares independent filters: structure no_reset and information needed")
        if self.combination == "information":
            if self.sharing == "none" and self.structure != "no_reset":
                raise ValueError(f"structure {self.structure!r} counts information again and again without sharing it")
        elif self.sharing != "none":
            raise ValueError(f"combination {self.combination!r} allows for correlation itself: sharing must be 'none'")
        if not (self.imu.gyro_bias_sigma > 0 and self.imu.accel_bias_sigma > 0):
            raise ValueError("the biases of the IMU need a sigma above zero")

    @property
    def shares(self) -> Array:
        """Fixed share of each local filter, adding up to one."""
        n = len(self.locals)
        return np.array([1 / n if local.share is None else local.share for local in self.locals])


class Isolation(NamedTuple):
    """An event: part of a sensor's looks was isolated or readmitted, by axis."""

    t: float
    local: str
    sensor: str
    part: str
    isolated: tuple[bool, ...]  # per axis, after the event


class Master(NamedTuple):
    """The fused solution: what it would add to the nominal common states (m,), its covariance (m, m), the weights."""

    x: Array
    P: Array
    weights: Array


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
        self.shares = config.shares
        gate = ChiSquareGate(1e-3)
        self.locals = [
            LocalFilter(config.imu, [w.aid for w in local.sensors], gate, row, closed=False, scaling=local.scaling)
            for row, local in enumerate(config.locals)
        ]
        self._users: dict[str, list[LocalFilter]] = {}
        for local, filter_ in zip(config.locals, self.locals, strict=True):
            for watched in local.sensors:
                self._users.setdefault(watched.aid.sensor, []).append(filter_)
                filter_.watch(watched, config.isolate_after, config.readmit_after)
        # Rows of the state: the filters, then, with a recall, their younger shadows and their older ones.
        self._copies = 1 if config.recall_s is None else 3
        self._reference = Reference(
            [f.model for f in self.locals] * self._copies, self._told_shares(), config.covariance_period, field_n,
            scalings=[local.scaling for local in config.locals] * self._copies,
        )  # fmt: skip
        self.model = self.locals[0].model
        self._common = self._reference.common
        self._state: State | None = None
        self._last_bad = self._last_fused = -math.inf
        self._refused_since = self._last_refused = -math.inf  # positions, without one fused in between
        self._fused_at = self._remembered_at = -math.inf
        self._aligning = self._alignment_aids()
        gnss = next((a for a in self._aligning.values() if isinstance(a, GnssAid)), GnssAid())
        magnetometer = next((a for a in self._aligning.values() if isinstance(a, MagnetometerAid)), MagnetometerAid())
        aids = [w.aid for local in config.locals for w in local.sensors]
        wind_sigma = next((a.wind_sigma for a in aids if isinstance(a, AirspeedAid)), AirspeedAid().wind_sigma)
        self._alignment = Alignment(
            config.imu,
            AidSigmas(
                field=magnetometer.sigma,
                field_bias=magnetometer.bias_sigma,
                gnss_position=np.array(gnss.position_error_sigma),
                gnss_velocity=np.array(gnss.velocity_error_sigma),
                wind=wind_sigma,
            ),
            gnss.arm,
            config.alignment_s,
        )
        self._renamed = dict(zip(("gnss_position_error", "gnss_velocity_error"), gnss.states, strict=True))
        self._renamed["magnetometer_bias"] = magnetometer.states[0]
        self._extra = self._extras()

    def _alignment_aids(self) -> dict[str, Aid]:
        """The first receiver and the first magnetometer."""
        found: dict[str, Aid] = {}
        for aid in (*(w.aid for local in self.config.locals for w in local.sensors), *self.config.alignment_aids):
            if isinstance(aid, (GnssAid, MagnetometerAid)) and not any(type(a) is type(aid) for a in found.values()):
                found[aid.sensor] = aid
        return found

    def _extras(self) -> list[tuple[str, int, slice]]:
        """(name, row, where) of the further states in an estimate: a name that two filters have gets the filter's."""
        own = [
            (name, row, where)
            for row, filter_ in enumerate(self.locals)
            for name, where in filter_.model.slices.items()
            if where.start >= self._common
        ]
        names = [name for name, _, _ in own]
        return [
            (f"{self.config.locals[row].name}_{name}" if names.count(name) > 1 else name, row, where)
            for name, row, where in own
        ]

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
            for key, watch in filter_.watches.items()
            if watch.suspect
        ]

    def start(self, initial: InitialState) -> None:
        """Begin at a given state instead of aligning."""
        state = self._reference.start(initial, [self._renamed] * len(self._reference.models))
        common = self._common
        for row, share in enumerate(self._told_shares()):
            reset(state.x[row], state.P[row], np.zeros(common), state.P[row, :common, :common] / share)
        self._state, self._draft = state, state.copy()
        self.t = self._last_fused = self._fused_at = self._remembered_at = initial.t

    def propagate(self, imu: ImuSamples) -> None:
        """Advance by a block of increments; a non-finite or impossible one is bridged with the last sound rates."""
        if len(imu) == 0:
            return
        if self._state is None:
            self._alignment.propagate(imu)
        else:
            self._last_bad = max(self._last_bad, self._reference.run(self._state, imu))
        self.t = float(imu.t[-1])

    def accepts(self, sample: Sample) -> bool:
        """Whether the sample's sensor is an aid of some filter, or it can still serve the alignment."""
        return sample.sensor in (self._aligning if self._state is None else self._users)

    def update(self, sample: Sample) -> list[UpdateReport]:
        """Use a sample valid at the estimator's own time (ValueError otherwise: `nav.horizon.FusionHorizon`).

        One report per part of the sample and local filter that has its sensor.
        """
        if isinstance(sample, GnssSample) and not sample.has_fix:
            return []
        trouble = aiding.problem(sample)
        if trouble:
            self._last_bad = max(self._last_bad, sample.t if math.isfinite(sample.t) else self.t)
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
        reports: list[UpdateReport] = []
        for filter_ in self._users.get(sample.sensor, ()):
            reports += self._use(state, filter_, sample)
        config = self.config
        if sample.t - self._fused_at >= config.fusion_period_s - TIME_TOLERANCE:
            if config.cross_check:
                self._cross_check(state, sample.t)
            self._fuse(state)
            self._fused_at = sample.t
            if config.recall_s is not None and sample.t - self._remembered_at >= config.recall_s - TIME_TOLERANCE:
                self._remember(state)
                self._remembered_at = sample.t
        return reports

    def refuse(self, sample: Sample, reason: str) -> list[UpdateReport]:
        """Reports on a sample that is not used, without innovations (NaN), as `update` would give."""
        return [
            report
            for filter_ in self._users.get(sample.sensor, ())
            for report in refusals(sample, filter_.aids[sample.sensor], reason, self.t)
        ]

    def estimate(self) -> Estimate:
        """The fused state at the estimator's own time."""
        return self._estimate(self._drafted(), self.t, self._last_bad)

    def predict(self, imu: ImuSamples) -> Estimate:
        """The fused state after further increments, the estimator itself staying where it is."""
        state = self._drafted()
        last_bad = self._last_bad
        if state is not None and len(imu):
            last_bad = max(last_bad, self._reference.run(state, imu, PREDICTED_PERIODS))
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

    def _use(self, state: State, filter_: LocalFilter, sample: Sample) -> list[UpdateReport]:
        aid = filter_.aids[sample.sensor]
        reports: list[UpdateReport] = []
        withheld: Ruling | None = None
        for part, _ in aid.parts:
            look = filter_.look(self._reference, state, aid, part, sample)
            if look is None:
                continue
            report = self._use_look(state, filter_, sample, part, look, withheld)
            if part == "gnss_position":
                if report.weight > 0:
                    self._last_fused, self._last_refused = sample.t, -math.inf
                else:
                    withheld = without_position(Ruling(report.outcome, report.reason))
                    self._recover(state, sample)
            reports.append(report)
        return reports

    def _use_look(
        self, state: State, filter_: LocalFilter, sample: Sample, part: str, look: Look,
        withheld: Ruling | None,
    ) -> UpdateReport:  # fmt: skip
        t, watch = sample.t, filter_.watches[sample.sensor, part]
        nu, S, nis = filter_.innovate(state, look)
        withheld = withheld or look.withheld
        if withheld is not None and look.withheld is not None:
            return report_on(sample, part, nu, S, nis, math.nan, withheld)
        watches = filter_.of_sensor[sample.sensor]
        suspect = any(w.suspect for w in watches)
        judged = self._against_master(state, filter_, sample, part) if suspect else (nu, S)
        decision, changed = watch.judge(*judged, t)
        if changed:
            self._note(t, filter_, sample.sensor, part, watch)
            if changed is Change.ISOLATED:
                if self.config.recall_s is None:
                    self._start_again(state, filter_, sample.sensor)
                else:
                    self._recall(state, filter_)
                again = filter_.look(self._reference, state, filter_.aids[sample.sensor], part, sample)
                assert again is not None  # as there was one
                look = again
                nu, S, nis = filter_.innovate(state, look)
        suspect, out = any(w.suspect for w in watches), any(w.out for w in watches)
        isolated = Ruling(Outcome.ISOLATED, "isolated")
        ruling = withheld or isolated
        if withheld is None and not out:
            used = decision.axis_mask & ~watch.isolated if suspect else decision.axis_mask
            policy = self._policy(filter_, watch)
            ruling = filter_.take(self._reference, state, look, nu, S, used, watch.noise, policy, t)
        if out or watch.suspect:
            ruling = isolated._replace(weight=ruling.weight)
        elif decision.alarm and withheld is None:
            ruling = OUTSIDE._replace(weight=ruling.weight)
        threshold = decision.threshold if math.isclose(decision.statistic, nis, rel_tol=1e-6) else math.nan
        return report_on(sample, part, nu, S, nis, threshold, ruling)

    def _policy(self, filter_: LocalFilter, watch: Watch) -> Policy | None:
        """What becomes of R in the look that ``watch`` has just judged: its own policy, then the normalised weight."""
        if self.config.weighting == "none":
            return watch.policy
        t = watch.judged
        latest = [
            max((w.suspicion for w in other.watches.values() if t - w.judged <= RECENT_S), default=math.inf)
            for other in self.locals
            if other is not filter_
        ]
        suspicions = np.array([watch.suspicion, *latest])
        N = float(normalised_weights(suspicions, np.ones(len(suspicions)), literal=self.config.literal)[0])
        if N == 1.0:
            return watch.policy
        return Weight(N) if watch.policy is None else InOrder([watch.policy, Weight(N)])

    def _against_master(self, state: State, filter_: LocalFilter, sample: Sample, part: str) -> tuple[Array, Array]:
        """Innovation and covariance of a look against the fused solution of the healthy filters.

        What its own filter knows of the sensor's error given the common states goes with it. With a recall all filters
        are healthy: then its own was put back to what it knew before the fault.
        """
        everyone = np.ones(len(self.locals))
        healthy = everyone if self.config.recall_s is not None else self._healthy()
        master = self._combine(state, healthy if healthy.any() else everyone)
        look = filter_.nominal_look(self._reference, state, filter_.aids[sample.sensor], part, sample)
        assert look is not None
        x, P, common = state.x[filter_.row].copy(), self._charted(state, filter_.row), self._common
        change = -x
        change[:common] = 0.0  # the nominal state is without what the filter would add to it
        reset(x, P, master.x, master.P)
        change += x
        return look.nu - look.H @ change, look.H @ P @ look.H.T + np.diag(look.R)

    def _healthy(self) -> Array:
        """1 for each local filter without an isolated part, 0 for the others."""
        return np.array([not any(w.suspect for w in f.watches.values()) for f in self.locals], dtype=float)

    def _note(self, t: float, filter_: LocalFilter, sensor: str, part: str, watch: Watch) -> None:
        name = self.config.locals[filter_.row].name
        self.events.append(Isolation(t, name, sensor, part, tuple(map(bool, watch.isolated))))

    def _start_again(self, state: State, faulty: LocalFilter, sensor: str) -> None:
        """Every filter from the fused solution of the healthy ones, so that nothing stays of what the sensor told."""
        healthy = self._healthy()
        if not healthy.any():
            return
        master = self._combine(state, healthy)
        row, model = faulty.row, faulty.model
        shares = self._reset_shares()
        if self.config.combination == "information":
            shares = np.where(healthy > 0, shares, 0.0)
            shares = np.where(
                healthy > 0, shares / shares.sum() * (1 - LEAST_SHARE * np.sum(healthy == 0)), LEAST_SHARE
            )
        for name in faulty.aids[sensor].states:
            if name in model.slices and model.decay_rate[model.slices[name].start] > 0:
                where = model.slices[name]
                state.x[row, where] = 0.0
                forget(state.P[row], where.start, model.sigma[where] ** 2)
        for i, share in enumerate(shares):
            self._reset(state, i, master.x, master.P / share)

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
        """Isolate the sensor behind a contradiction between filters."""
        healthy = self._healthy()
        against = np.zeros(len(healthy))
        if healthy.sum() >= 2:
            positions = state.P[:, range(POS, POS + 3), range(POS, POS + 3)]
            for i in np.flatnonzero((healthy > 0) & (positions.max(axis=1) < LOST_M**2)):
                others = self._combine(state, np.where(np.arange(len(healthy)) == i, 0.0, healthy))
                S = state.P[i, VEL:MOTION, VEL:MOTION] + others.P[VEL:MOTION, VEL:MOTION]
                against[i] = whiten(state.x[i, VEL:MOTION] - others.x[VEL:MOTION], S)[1]
        if not against.max() > chi_square_threshold(CROSS_CHECK_FALSE_ALARM, MOTION - VEL):
            return
        suspects = [self.locals[i] for i in np.flatnonzero(against >= CONTRADICTION_SHARE * against.max())]
        evidence = {(f, key): watch.suspicion for f in suspects for key, watch in f.watches.items()}
        filter_, (sensor, _) = max(evidence, key=lambda which: evidence[which])
        for (name, part), watch in filter_.watches.items():
            if name == sensor:
                watch.convict()
                self._note(t, filter_, sensor, part, watch)
        self._start_again(state, filter_, sensor)

    def _recover(self, state: State, sample: Sample) -> None:
        """Give up positions and velocities when every fix was refused for long."""
        config = self.config
        if sample.t - self._last_refused > REFUSAL_GAP_S:
            self._refused_since = sample.t
        self._last_refused = sample.t
        if sample.t - self._refused_since < config.patience_s:
            return
        for filter_, local in zip(self.locals, config.locals, strict=True):
            for watched in local.sensors:
                if isinstance(watched.aid, GnssAid) and any(w.suspect for w in filter_.of_sensor[watched.aid.sensor]):
                    filter_.watch(watched, config.isolate_after, config.readmit_after)
                    for part, watch in zip(watched.aid.parts, filter_.of_sensor[watched.aid.sensor], strict=True):
                        self._note(sample.t, filter_, watched.aid.sensor, part[0], watch)
        self._widen(state, sample)
        self._last_refused = -math.inf

    def _widen(self, state: State, sample: Sample) -> None:
        filter_ = self._users[sample.sensor][0]
        aid = filter_.aids[sample.sensor]
        for part, start in (("gnss_position", POS), ("gnss_velocity", VEL)):
            if part not in [name for name, _ in aid.parts]:
                continue
            look = filter_.look(self._reference, state, aid, part, sample)
            if look is None:
                continue
            nu, S, nis = filter_.innovate(state, look)
            if part == "gnss_velocity" and nis <= filter_.gate.threshold(3):
                continue
            for i, share in enumerate(np.tile(self._reset_shares(), self._copies)):
                forget(state.P[i], start, (nu**2 + np.diag(S)) / share)

    # --- the master

    def _told_shares(self) -> Array:
        """By which noise and covariance are divided, for each row: ones when information is not shared."""
        shares = np.ones(len(self.locals)) if self.config.sharing == "none" else self.shares
        return np.tile(shares, self._copies)

    def _reset_shares(self) -> Array:
        """The shares of a fused covariance, for each filter: ones when the combination does not add information up."""
        return self.shares if self.config.combination == "information" else np.ones(len(self.locals))

    def _combine(self, state: State, members: Array) -> Master:
        """The fused solution of the ``members`` (filters,), one or zero each."""
        n = len(self.locals)
        P = state.P[:n]
        if self._reference.scalings:
            P = np.stack([self._charted(state, row) for row in range(n)])
        return combine(state.x[:n], P, self._common, members, self.config)

    def _charted(self, state: State, row: int) -> Array:
        """A copy of one filter's P, as the covariance of its x; by sigma points it is that of its own estimate."""
        P = state.P[row]
        return turned(state.x[row], P, own=False) if row in self._reference.scalings else P.copy()

    def _reset(self, state: State, row: int, x_g: Array, P_g: Array) -> None:
        """`reset` one filter."""
        P = self._charted(state, row)
        reset(state.x[row], P, x_g, P_g)
        state.P[row] = turned(state.x[row], P, own=True) if row in self._reference.scalings else P

    def _fuse(self, state: State) -> None:
        """Fuse, correct the nominal state, reset the filters as the structure says."""
        config = self.config
        everyone = np.ones(len(self.locals))
        if config.sharing == "by_covariance":
            by = weights_by_covariance(state.P[: len(self.locals)], self._common, everyone, self.shares)
            by = np.maximum(by, LEAST_SHARE)
            self.shares = by / by.sum()
            self._reference.share_noise(self._told_shares())
        master = self._combine(state, everyone)
        retention = {"no_reset": 0.0, "full_reset": 1.0, "partial": config.retention}[config.structure]
        if retention > 0:
            for i, share in enumerate(self._reset_shares()):
                target = master.x, master.P / share
                if retention < 1:
                    target = blend(state.x[i], self._charted(state, i), *target, retention)
                self._reset(state, i, *target)
        self._reference.correct(state, master.x)

    def _estimate(self, state: State | None, t: float, last_bad: float) -> Estimate:
        """The estimate at ``t`` from a ``state`` that may be changed."""
        status = Status.ALIGNING if state is None else FUSED if t - self._last_fused <= RECENT_S else UNAIDED
        if t - last_bad <= BAD_SAMPLE_S:
            status |= Status.BAD_SAMPLE
        if state is None:
            return nothing_known(t, status)
        self._reference.settle(state)
        master = self._combine(state, np.ones(len(self.locals)))
        inject(state.q_nb, state.v_n, state.lla, state.imu, master.x)
        P = turned(master.x, master.P, own=True) if self._reference.scalings else master.P
        covariance, sigma = spread(P, self.config.mounting_sigma**2)
        imu = state.imu.copy()
        extra = {
            name: (imu[where], sigma[where])
            for name, where in self.model.slices.items()
            if where.start < self._common and name not in REPORTED
        }
        for name, row, where in self._extra:
            extra[name] = (state.x[row, where].copy(), np.sqrt(state.P[row, where, where].diagonal()))
        return describe(state, imu, P, self.model, t, status, covariance, sigma, extra)


def combine(x: Array, P: Array, common: int, members: Array, config: Config) -> Master:
    """Fuse the common states of filters ``x`` (filters, n), ``P`` (filters, n, n); ``members`` (filters,) are 1 or 0.

    Information: ``P_g = (sum P_i^-1)^-1, x_g = P_g sum P_i^-1 x_i`` (Cui et al. 2022, Eq 10). Covariance intersection
    is the same with each P_i^-1 times w_i, sum w_i = 1. Scalar: ``x_g = sum w_i x_i`` (Zhu et al. 2020, Eq 14) with the
    bound ``P_g = sum w_i P_i``, which holds for any correlation. The w_i are those of `weights_by_covariance`.
    """
    if config.combination == "information":
        return Master(*_information(x, P, common, members), members)
    weigh = weights_eq13 if config.literal else weights_by_covariance
    weights = weigh(P, common, members)
    if config.combination == "scalar":
        x_g, P_g = weights @ x[:, :common], np.tensordot(weights, P[:, :common, :common], 1)
    else:
        x_g, P_g = _information(x, P, common, weights)
    return Master(x_g, P_g, weights)


def weights_by_covariance(P: Array, common: int, members: Array, shares: Array | None = None) -> Array:
    """Weights (filters,) that add up to one, from the traces of the position and the velocity block.

    ``w_i`` is the mean over the two blocks of ``(1 / tr P_i) / sum_j (1 / tr P_j)``, so no units are mixed. With
    ``shares`` the traces are those of beta_i P_i: what a filter was merely told must not raise its next share.
    """
    trace = np.array([[np.trace(p[b : b + 3, b : b + 3]) for b in (POS, VEL)] for p in P])
    if shares is not None:
        trace *= shares[:, None]
    better = members[:, None] / trace
    weights: Array = np.mean(better / better.sum(axis=0), axis=1)
    return weights


def weights_eq13(P: Array, common: int, members: Array) -> Array:
    """Weights (filters,) of Zhu et al. 2020, Eq 13, as printed: ``|diag(P_i^-1 P_i^-T)|_F`` over their sum."""
    norms = np.zeros(len(P))
    for i in np.flatnonzero(members):
        inverse = _scaled_inverse(P[i], common)[0]
        norms[i] = np.linalg.norm(np.sum(inverse * inverse, axis=1))
    weights: Array = norms / norms.sum()
    return weights


@njit
def _scaled_inverse(P: Array, common: int) -> tuple[Array, bool]:
    """Inverse (common, common) of the common block, and whether it was positive definite.

    By Gauss and Jordan in place, which needs no pivoting then, on the block scaled to a unit diagonal: the units of the
    states differ by 1e12.
    """
    A, scale = np.empty((common, common)), np.empty(common)
    for i in range(common):
        scale[i] = 1.0 / math.sqrt(P[i, i]) if P[i, i] > 0.0 else 0.0
    for i in range(common):
        for j in range(common):
            A[i, j] = P[i, j] * scale[i] * scale[j]
    for k in range(common):
        if not A[k, k] > 0.0:
            return A, False
        over = 1.0 / A[k, k]
        A[k, k] = 1.0
        for j in range(common):
            A[k, j] *= over
        for i in range(common):
            if i != k:
                a = A[i, k]
                A[i, k] = 0.0
                for j in range(common):
                    A[i, j] -= a * A[k, j]
    for i in range(common):
        for j in range(i + 1):
            A[i, j] = A[j, i] = 0.5 * (A[i, j] + A[j, i]) * scale[i] * scale[j]
    return A, True


@njit
def _information(x: Array, P: Array, common: int, weights: Array) -> tuple[Array, Array]:
    """(x_g, P_g) with ``P_g^-1 = sum w_i P_i^-1`` over the filters whose covariance is definite and w_i positive."""
    total, y = np.zeros((common, common)), np.zeros(common)
    for f in range(len(x)):
        if weights[f] > 0.0:
            inverse, definite = _scaled_inverse(P[f], common)
            if definite:
                for i in range(common):
                    for j in range(common):
                        total[i, j] += weights[f] * inverse[i, j]
                        y[i] += weights[f] * inverse[i, j] * x[f, j]
    P_g, _ = _scaled_inverse(total, common)
    x_g = np.zeros(common)
    for i in range(common):
        for j in range(common):
            x_g[i] += P_g[i, j] * y[j]
    return x_g, P_g


def blend(x: Array, P: Array, x_g: Array, P_g: Array, retention: float) -> tuple[Array, Array]:
    """(x, P) of the common states between a filter's own (0) and the shared ones (1), by weighted information."""
    common = len(x_g)
    both = np.stack([x[:common], x_g]), np.stack([P[:common, :common], P_g])
    return _information(*both, common, np.array([1.0 - retention, retention]))


@njit
def reset(x: Array, P: Array, x_g: Array, P_g: Array) -> None:
    """Give a filter, ``x`` (n,) and ``P`` (n, n), new common states; what it knows of its aids *given* them stays.

    With G = P_ac P_cc^-1: ``x_a += G (x_g - x_c)``, ``P_ac = G P_g``, ``P_aa += G (P_g - P_cc) G'``. The errors of an
    aid depend on all other filters' measurements through the common states only, so this is Bayes' rule and no
    approximation, apart from the process noise over a step.
    """
    n, common = len(x), len(x_g)
    inverse, _ = _scaled_inverse(P, common)
    G, GD = np.zeros((n, common)), np.zeros((n, common))
    for a in range(common, n):
        if P[a, a] > 0.0:
            for j in range(common):
                for k in range(common):
                    G[a, j] += P[a, k] * inverse[k, j]
    for a in range(common, n):
        if P[a, a] > 0.0:
            for k in range(common):
                x[a] += G[a, k] * (x_g[k] - x[k])
                for j in range(common):
                    GD[a, j] += G[a, k] * (P_g[k, j] - P[k, j])
    for a in range(common, n):
        if P[a, a] > 0.0:
            for b in range(common, a + 1):
                total = 0.0
                for k in range(common):
                    total += GD[a, k] * G[b, k]
                P[a, b] += total
                P[b, a] = P[a, b]
            for j in range(common):
                P[a, j] += GD[a, j]
                P[j, a] = P[a, j]
    for i in range(common):
        x[i] = x_g[i]
        for j in range(common):
            P[i, j] = P_g[i, j]
