"""Whether a measurement may be believed: the fault detectors, the chi-square gate, and GNSS after an outage.

Every detector has one method, ``step(nu, S, t) -> Decision``, for the innovation ``nu`` (m,), its covariance ``S``
(m, m) by the filter and the time ``t`` [s] of one sample. A sound innovation is zero-mean with covariance S. Residuals
are whitened, ``r = L^-1 nu`` with ``S = L L'``, so that a mean over samples stays one of unit normals when S changes.
A detector holds the state of one sensor: build one for each.

Which one: `ChiSquare` sees a fault in one sample or not at all; `Eraim` is the same test and keeps the sound axes;
`Sprt` gathers evidence over samples, as Zhou et al. 2025 do; `Glr` finds slow faults sooner and knows best when they
end.

Sources: Zhou et al. 2025 (SINS/GNSS/odometer, completely reset SPRT; "Eq" below), Cui et al. 2022 (ERAIM), Siegmund,
Sequential Analysis (1985). Evidence is a logarithm of a likelihood ratio [nats].
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum, auto
from functools import cache
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri, exp1

from nav._jit import njit
from nav.earth import displacement_n
from nav.samples import Array, GnssSample

# The mean of two velocities misses V w^2 dt^3 / 12 of a turn; this covers 0.5 rad/s at 30 m/s [m/s^3].
TURN_ERROR = 0.6
JUMP_FLOOR = 0.5  # a smaller jump harms nobody: it also covers the swing of an antenna on its lever arm [m]

OVERSHOOT = 0.583  # mean overshoot of a unit normal walk over a distant limit, -zeta(1/2)/sqrt(2 pi)
FAULT_MEAN_GAIN = 0.05  # how fast `Glr` follows a fault that grows

Mask = NDArray[np.bool_]


class Event(Enum):
    """What changed with this sample."""

    NONE = ""
    ONSET = "onset"
    END = "end"


class Decision(NamedTuple):
    """A detector's word on one sample."""

    alarm: bool  # the sensor is taken for faulty
    statistic: float  # NaN or infinite when the sample can't be judged: no number, or S not positive definite
    threshold: float
    axis_mask: Mask  # (m,) True where the axis may be used, all True without an alarm
    event: Event


class Detector(Protocol):
    """Anything that judges one sensor sample by sample."""

    def step(self, nu: Array, S: Array, t: float) -> Decision:
        """Judge the innovation ``nu`` (m,) with covariance ``S`` (m, m) at ``t`` [s]."""
        ...


@cache
def chi_square_threshold(false_alarm: float, m: int) -> float:
    """The value that a chi-square variable of ``m`` degrees of freedom exceeds with probability ``false_alarm``.

    Raises ValueError when ``false_alarm`` is no probability between 0 and 1.
    """
    if not 0 < false_alarm < 1:
        raise ValueError(f"a probability between 0 and 1 is needed, not {false_alarm}")
    return float(chdtri(m, false_alarm))


@njit
def whiten(nu: Array, S: Array) -> tuple[Array, float]:
    """(r, nu' S^-1 nu) of ``nu`` (m,) with covariance ``S`` (m, m): r (2, m) has the joint and the axis residuals.

    ``r[0] = L^-1 nu`` with ``S = L L'``; ``r[1] = nu_i / sqrt(S_ii)``, untouched by faults of other axes. When S is not
    positive definite or nu is no number, the second is NaN.
    """
    m = len(nu)
    L, r = np.empty((m, m)), np.empty((2, m))
    gamma2 = 0.0
    for i in range(m):
        total = nu[i]
        for j in range(i):
            a = S[i, j]
            for k in range(j):
                a -= L[i, k] * L[j, k]
            L[i, j] = a / L[j, j]
            total -= L[i, j] * r[0, j]
        pivot = S[i, i]
        for k in range(i):
            pivot -= L[i, k] * L[i, k]
        if not (pivot > 0.0 and math.isfinite(nu[i])):
            return r, math.nan
        L[i, i] = math.sqrt(pivot)
        r[0, i] = total / L[i, i]
        r[1, i] = nu[i] / math.sqrt(S[i, i])
        gamma2 += r[0, i] * r[0, i]
    return r, gamma2


def w_tests(nu: Array, S: Array) -> Array:
    """|w_i| = |(S^-1 nu)_i| / sqrt((S^-1)_ii): Baarda's test of axis i, the others taken for sound. Unit normal. (m,).

    The same as the w-test of the least squares that stacks the measurement and the filter's prediction (ERAIM).
    """
    S_inverse = np.linalg.inv(S)
    w: Array = np.abs(S_inverse @ nu) / np.sqrt(np.diag(S_inverse))
    return w


@cache
def _every_axis(m: int) -> Mask:
    mask = np.full(m, True)
    mask.flags.writeable = False  # shared by all healthy samples
    return mask


@dataclass
class _Alarm:
    """Whether the last sample was an alarm."""

    on: bool = False

    def decide(self, statistic: float, threshold: float, m: int, sound: Mask | None) -> Decision:
        """The decision on ``m`` axes; ``sound`` is None without an alarm."""
        before, self.on = self.on, sound is not None
        event = Event.NONE if self.on == before else Event.ONSET if self.on else Event.END
        return Decision(self.on, statistic, threshold, _every_axis(m) if sound is None else sound, event)


def _small(mean: Array, variance: float, false_alarm: float) -> Mask:
    """The axes whose own ``mean`` (m,) is no larger than chance allows."""
    small: Mask = mean * mean <= variance * chi_square_threshold(false_alarm, 1)
    return small


def _sound_axes(mean: Array, variance: float, false_alarm: float) -> Mask:
    """The axes left on an alarm: those with a small ``mean`` (m,), or none when the fault can't be laid on any."""
    small = _small(mean, variance, false_alarm)
    return np.zeros_like(small) if small.all() else small


@dataclass
class ChiSquare:
    """One sample: nu' S^-1 nu, the squared Mahalanobis distance, against chi-square of m degrees of freedom.

    ``false_alarm`` is the probability per sample. ``literal`` compares the distance itself with the same quantile, as
    Zhou et al. print (Eq 13-14): the limit of one axis moves from 3.3 to 10.8 sigma at 1e-3.
    """

    false_alarm: float
    literal: bool = False
    _alarm: _Alarm = field(default_factory=_Alarm, init=False)

    def statistic(self, gamma2: float) -> float:
        """What is compared with the quantile, from the squared distance ``gamma2``."""
        return math.sqrt(gamma2) if self.literal else gamma2

    def passes(self, gamma2: float, m: int) -> bool:
        """Whether the squared distance ``gamma2`` of ``m`` axes is small enough; a NaN is not."""
        return self.statistic(gamma2) <= chi_square_threshold(self.false_alarm, m)

    def step(self, nu: Array, S: Array, t: float) -> Decision:
        """Judge one sample; see `Detector`."""
        m = len(nu)
        gamma2 = whiten(nu, S)[1]
        sound = None if self.passes(gamma2, m) else np.full(m, False)
        return self._alarm.decide(self.statistic(gamma2), chi_square_threshold(self.false_alarm, m), m, sound)


class Never:
    """No alarm, whatever comes: for a sensor whose measurement policy alone shall answer (`nav.weighting`)."""

    def step(self, nu: Array, S: Array, t: float) -> Decision:
        """Judge one sample; see `Detector`."""
        return Decision(False, whiten(nu, S)[1], math.inf, _every_axis(len(nu)), Event.NONE)


@dataclass
class Eraim:
    """`ChiSquare`, and on alarm the axis of the largest w-test goes, again and again, until the rest passes.

    Extrapolated receiver autonomous integrity monitoring: least squares over the measurement and the prediction. Its
    global statistic is nu' S^-1 nu and leaving an axis out is leaving its row and column out of nu and S (Cui et al.
    name the method without equations). ``axis_mask`` keeps the sound axes; ``statistic`` is that of all axes.
    """

    false_alarm: float
    _alarm: _Alarm = field(default_factory=_Alarm, init=False)

    def step(self, nu: Array, S: Array, t: float) -> Decision:
        """Judge one sample; see `Detector`."""
        m = len(nu)
        gamma2 = whiten(nu, S)[1]
        threshold = chi_square_threshold(self.false_alarm, m)
        return self._alarm.decide(gamma2, threshold, m, None if gamma2 <= threshold else self._exclude(nu, S))

    def _exclude(self, nu: Array, S: Array) -> Mask:
        """The axes left when the rest passes the global test."""
        used = np.isfinite(nu)
        while used.any():
            part = S[np.ix_(used, used)]
            gamma2 = whiten(nu[used], part)[1]
            if math.isnan(gamma2):
                return np.zeros_like(used)
            if gamma2 <= chi_square_threshold(self.false_alarm, len(part)):
                break
            used[np.flatnonzero(used)[w_tests(nu[used], part).argmax()]] = False
        return used


class _Window:
    """The residuals of the last ``span_s`` seconds in one contiguous array that grows when it must."""

    def __init__(self, span_s: float) -> None:
        self.span_s = span_s
        self._times: Array = np.empty(64)
        self._rows: Array = np.empty((64, 0, 0))
        self._first = self._end = 0

    def push(self, r: Array, t: float) -> Array:
        """Take ``r`` of any shape and return those still inside the window, oldest first (n, *r.shape)."""
        if self._end == 0 or self._rows.shape[1:] != r.shape:
            self._first = self._end = 0
            self._rows = np.empty((len(self._times), *r.shape))
        if self._end == len(self._times):
            self._make_room()
        self._times[self._end], self._rows[self._end] = t, r
        self._end += 1
        while self._times[self._first] <= t - self.span_s:
            self._first += 1
        return self._rows[self._first : self._end]

    def clear(self) -> None:
        """Forget everything."""
        self._first = self._end = 0

    def _make_room(self) -> None:
        live, size = slice(self._first, self._end), self._end - self._first
        capacity = max(64, 2 * size)
        times, rows = np.empty(capacity), np.empty((capacity, *self._rows.shape[1:]))
        times[:size], rows[:size] = self._times[live], self._rows[live]
        self._times, self._rows, self._first, self._end = times, rows, 0, size


@njit
def _mean(rows: Array) -> Array:
    """The mean of ``rows`` (n, 2, m) over the first axis."""
    total: Array = np.zeros_like(rows[0])
    for row in rows:
        total += row
    total /= len(rows)
    return total


class Mean(Protocol):
    """What `Sprt` remembers of the residuals."""

    decay: float  # what a step leaves of the evidence gathered so far, in the signed form
    n: float  # the samples it stands for
    value: Array  # (2, m) of `whiten`'s residuals
    variance: float  # of each component when nothing is wrong

    def add(self, r: Array, t: float) -> None:
        """Take the residuals ``r`` (2, m) of one sample at ``t`` [s]."""
        ...

    def restart(self, r: Array, t: float) -> None:
        """Forget all but ``r`` (Eq 21)."""
        ...


@dataclass
class RunningMean:
    """n <- decay n + 1; mean <- mean + (r - mean) / (stretch n): see `plain`, `exponential` and `eq20`."""

    decay: float = 1.0
    stretch: float = 1.0
    n: float = field(default=0.0, init=False)
    value: Array = field(default_factory=lambda: np.zeros((2, 1)), init=False)
    variance: float = field(default=0.0, init=False)

    def add(self, r: Array, t: float) -> None:
        """Take one sample; see `Mean`."""
        self.n = self.decay * self.n + 1.0
        gain = 1.0 / (self.stretch * self.n)
        self.value = self.value + gain * (r - self.value)
        self.variance = (1.0 - gain) ** 2 * self.variance + gain**2

    def restart(self, r: Array, t: float) -> None:
        """Forget all but ``r``; see `Mean`."""
        self.n, self.value, self.variance = 1.0, r, 1.0


def plain() -> RunningMean:
    """The mean of all samples (Eq 12): the longer the sound past, the slower; 20 s to see 5 sigma after 1 h at 5 Hz."""
    return RunningMean()


def exponential(s: float) -> RunningMean:
    """The mean that forgets, weights s^age: a memory of 1/(1 - s) samples; 0.95 suits 5-10 Hz, 0.8 suits 1 Hz."""
    return RunningMean(decay=_fraction(s))


def eq20(s: float) -> RunningMean:
    """Literal Eq 20, ``mean <- (s k - 1)/(s k) mean + r/(s k)``: meant to fade, but an old fault is never forgotten."""
    return RunningMean(stretch=_fraction(s))


def _fraction(s: float) -> float:
    if not 0 < s < 1:
        raise ValueError(f"a forgetting factor between 0 and 1 is needed, not {s}")
    return s


class WindowMean:
    """The mean of the samples of the last ``span_s`` seconds."""

    decay = 1.0

    def __init__(self, span_s: float) -> None:
        self._window = _Window(span_s)
        self.n = 0.0
        self.value: Array = np.zeros((2, 1))
        self.variance = 0.0

    def add(self, r: Array, t: float) -> None:
        """Take one sample; see `Mean`."""
        rows = self._window.push(r, t)
        self.n = float(len(rows))
        self.value = _mean(rows)
        self.variance = 1.0 / self.n

    def restart(self, r: Array, t: float) -> None:
        """Forget all but ``r``; see `Mean`."""
        self._window.clear()
        self.add(r, t)


class Reset(Enum):
    """What `Sprt` does when its evidence is over the limit but falling and the sample alone is sound."""

    NONE = "none"
    FAST = "fast"  # evidence to zero, the mean is kept (Wang 2016): lasting in the signed form only
    COMPLETE = "complete"  # evidence and mean start again from this sample (Zhou et al. 2025)


@dataclass
class Sprt:
    """Evidence for a constant bias, gathered over samples (Zhou et al. 2025, Eq 12-21).

    Quadratic form: ``|mean|^2 / (2 variance)``, twice of which is chi-square of m degrees of freedom at each sample, so
    ``false_alarm`` holds per sample with half the quantile as the limit. It is a likelihood ratio with the mean
    estimated, not Wald's test. ``signed`` form: ``E <- decay E + mean' r - |mean|^2 / 2`` with the mean *before* r; it
    can fall below zero, and as exp(E) has expectation of at most one, ``-ln(false_alarm)`` bounds alarms per sample.

    ``end_test`` is what the sample alone must pass for a reset. ``axis_mask`` takes out the axes whose own mean is
    beyond its limit, or all if none is.

    ``literal`` is Zhou et al. as printed: n |mean|^2 / 2 whatever the weights (Eq 17), the signed form with the mean
    that includes r (drifts upwards: alarms without a fault), and Wald's limit (Eq 18, p_m = p_f) for any m.
    """

    false_alarm: float
    mean: Mean
    reset: Reset = Reset.NONE
    signed: bool = False
    end_test: ChiSquare = field(default_factory=lambda: ChiSquare(1e-3))
    literal: bool = False
    _evidence: float = field(default=0.0, init=False)
    _alarm: _Alarm = field(default_factory=_Alarm, init=False)

    def threshold(self, m: int) -> float:
        """The limit of the evidence for ``m`` axes [nats]."""
        if self.literal:
            return math.log((1.0 - self.false_alarm) / self.false_alarm)
        return -math.log(self.false_alarm) if self.signed else 0.5 * chi_square_threshold(self.false_alarm, m)

    def step(self, nu: Array, S: Array, t: float) -> Decision:
        """Judge one sample; see `Detector`."""
        m = len(nu)
        r, gamma2 = whiten(nu, S)
        threshold = self.threshold(m)
        if not math.isfinite(gamma2):
            return self._alarm.decide(gamma2, threshold, m, np.full(m, False))
        before, self._evidence = self._evidence, self._gather(r, t)
        over = self._evidence > threshold
        if over and self._evidence < before and self.reset is not Reset.NONE and self.end_test.passes(gamma2, m):
            over = False
            if self.reset is Reset.COMPLETE:
                self.mean.restart(r, t)
                self._evidence = 0.0 if self.signed and not self.literal else 0.5 * gamma2
            else:
                self._evidence = 0.0
        sound = _sound_axes(self.mean.value[1], self.mean.variance, self.false_alarm) if over else None
        return self._alarm.decide(self._evidence, threshold, m, sound)

    def _gather(self, r: Array, t: float) -> float:
        """The evidence with ``r``."""
        mean = self.mean
        predicted = mean.value[0] if mean.n else np.zeros_like(r[0])
        mean.add(r, t)
        if self.signed:
            mu = mean.value[0] if self.literal else predicted
            return mean.decay * self._evidence + float(mu.dot(r[0] - 0.5 * mu))
        mu = mean.value[0]
        return 0.5 * float(mu.dot(mu)) * (mean.n if self.literal else 1.0 / mean.variance)


def glr_false_alarm(threshold: float, m: int, n: int) -> float:
    """The probability that the largest of |r_1 + .. + r_j|^2 / (2 j), j = 1..n, of sound residuals exceeds a limit.

    With b^2 = 2 threshold and the density f of chi of m degrees of freedom,
    ``P = P(chi > b) + b f(b) int nu(x)/x dx`` from b/sqrt(n) to b, nu(x) = exp(-0.583 x): the rate at which the
    Ornstein-Uhlenbeck process S_j/sqrt(j) of log j leaves the ball of radius b, corrected for looking at whole j only
    (after Siegmund 1985; m axes by the density of the radius). Good to a tenth at 1e-3 and below.
    """
    b = math.sqrt(2.0 * threshold)
    density = math.exp((m - 1) * math.log(b) - threshold - (0.5 * m - 1) * math.log(2.0) - math.lgamma(0.5 * m))
    crossings = b * density * (exp1(OVERSHOOT * b / math.sqrt(n)) - exp1(OVERSHOOT * b))
    return float(chdtrc(m, b * b) + crossings)


@cache
def glr_threshold(false_alarm: float, m: int, n: int) -> float:
    """The limit that `glr_false_alarm` meets with ``n`` samples of ``m`` axes [nats]."""
    low = 0.5 * chi_square_threshold(false_alarm, m)
    if n == 1:
        return low
    from scipy.optimize import brentq  # takes half as long to load as the rest of this package, and few need it

    high = 0.5 * chi_square_threshold(0.1 * false_alarm / n, m)  # beyond the limit of n independent samples
    return float(brentq(lambda T: math.log(glr_false_alarm(T, m, n) / false_alarm), low, high))


@njit
def _largest_evidence(rows: Array) -> tuple[float, int]:
    """(max over j of |sum of the last j rows|^2 / (2 j), that j) of the joint residuals ``rows[:, 0]`` (n, m)."""
    n, _, m = rows.shape
    total = np.zeros(m)
    largest, length = 0.0, 1
    for j in range(1, n + 1):
        square = 0.0
        for i in range(m):
            total[i] += rows[n - j, 0, i]
            square += total[i] * total[i]
        if square > 2 * j * largest:
            largest, length = square / (2 * j), j
    return largest, length


@dataclass
class Glr:
    """Generalised likelihood ratio for a bias that began at any sample within ``window_s``; reverse CUSUM for its end.

    Onset: ``max_j j |mean of the last j|^2 / 2`` over `glr_threshold` of the samples in the window, so ``false_alarm``
    holds per sample at any rate and from the first on. While the alarm lasts, the fault's mean follows the residuals
    and ``G <- max(0, G + |mean|^2 / 2 - mean' r)`` gathers evidence that the mean is zero; over ``end_evidence`` [nats]
    the fault is over and everything starts again from that sample.
    (Basseville and Nikiforov, Detection of Abrupt Changes, 1993, chapter 2.)

    ``axis_mask`` takes out the axes whose own mean is beyond the chi-square limit; when none is any more, those that
    were last.
    """

    false_alarm: float
    window_s: float = 40.0
    end_evidence: float = 7.0
    _window: _Window = field(init=False)
    _fault: Array | None = field(default=None, init=False)  # mean of the residuals (2, m) while the alarm lasts
    _variance: float = field(default=1.0, init=False)  # of each of its components when its axis is sound
    _end: float = field(default=0.0, init=False)
    _sound: Mask = field(init=False)
    _alarm: _Alarm = field(default_factory=_Alarm, init=False)

    def __post_init__(self) -> None:
        self._window = _Window(self.window_s)

    def step(self, nu: Array, S: Array, t: float) -> Decision:
        """Judge one sample; see `Detector`."""
        m = len(nu)
        r, gamma2 = whiten(nu, S)
        if not math.isfinite(gamma2):
            return self._alarm.decide(gamma2, glr_threshold(self.false_alarm, m, 1), m, np.full(m, False))
        rows = self._window.push(r, t)
        statistic, length = _largest_evidence(rows)
        threshold = glr_threshold(self.false_alarm, m, len(rows))
        if self._fault is not None:
            self._follow(self._fault, r)
            if self._end > self.end_evidence:
                self._fault = None
                self._window.clear()
                self._window.push(r, t)
                statistic, threshold = 0.5 * gamma2, glr_threshold(self.false_alarm, m, 1)
        elif statistic > threshold:
            self._fault, self._variance = rows[-length:].mean(axis=0), 1.0 / length
            self._end = 0.0
            self._sound = _sound_axes(self._fault[1], self._variance, self.false_alarm)
        return self._alarm.decide(statistic, threshold, m, None if self._fault is None else self._sound)

    def _follow(self, fault: Array, r: Array) -> None:
        """Evidence for the end of the ``fault``; without any, its mean follows ``r`` and names the axes anew."""
        mu = fault[0]
        self._end = max(0.0, self._end + float(mu.dot(0.5 * mu - r[0])))
        if self._end == 0.0:
            fault += FAULT_MEAN_GAIN * (r - fault)
            self._variance = (1.0 - FAULT_MEAN_GAIN) ** 2 * self._variance + FAULT_MEAN_GAIN**2
            small = _small(fault[1], self._variance, self.false_alarm)
            if not small.all():
                self._sound = small


@dataclass(frozen=True)
class ChiSquareGate:
    """Accept an innovation when nu' S^-1 nu stays below the chi-square quantile of its dimension.

    ``false_rejection`` is the probability that a sound measurement of a consistent filter is turned away; 0: no gate.
    """

    false_rejection: float
    thresholds: tuple[float, ...] = field(init=False)

    def __post_init__(self) -> None:
        if not 0 <= self.false_rejection < 1:
            raise ValueError(f"a probability between 0 and 1 is needed, not {self.false_rejection}")
        object.__setattr__(self, "thresholds", tuple(float(chdtri(m, self.false_rejection)) for m in range(1, 7)))

    def threshold(self, dimension: int) -> float:
        """The largest accepted statistic for an innovation of ``dimension`` (1 to 6)."""
        return self.thresholds[dimension - 1]


class Verdict(Enum):
    """What to do with a GNSS fix."""

    FUSE = auto()
    REJECT = auto()  # outside the gate
    PROBATION = auto()  # not to be used before it has been consistent for a while after an outage
    RECOVER = auto()  # outside the gate, but consistent for so long that the filter must be wrong


@dataclass
class GnssMonitor:
    """Decides on each GNSS fix so that a good receiver is never shut out for ever and a bad fix never pulls the filter.

    Successive fixes form a streak while each agrees with the one before and with the velocities in between, which
    needs no trust in the filter. While the filter is being aided, a fix inside the gate is fused and one outside
    rejected, and only a streak that stays outside for ``patience_s`` is believed against the filter. After an outage of
    ``outage_s`` the filter's covariance is wide enough to swallow a bad first fix, so nothing is fused before a streak
    has lasted ``probation_s``; if it then lies outside the gate, the filter was too sure of itself, and after
    ``recovery_s`` the streak is believed.
    """

    outage_s: float
    probation_s: float
    recovery_s: float
    patience_s: float
    consistency_gate: float  # chi-square limit for the jump between two fixes, three degrees of freedom
    last_fused: float = -math.inf
    _streak_start: float = math.nan
    _interval: float = math.inf  # the shortest between two epochs, with a fix or without: what the receiver can do
    _heard: float = math.nan  # when the last of them was
    _was_aided: bool = False
    _previous: tuple[GnssSample, Array] | None = None

    def heard(self, t: float) -> None:
        """The receiver has reported at ``t`` [s], if only that it has no fix."""
        if t > self._heard:  # not the first
            self._interval = min(self._interval, t - self._heard)
        self._heard = t

    def judge(self, fix: GnssSample, v_n: Array, sigma_v: Array, inside_gate: bool) -> Verdict:
        """Verdict on a sound ``fix`` given its velocity [m/s], 1-sigma, and whether its position is inside the gate."""
        self.heard(fix.t)
        if not self._continues(fix, v_n, sigma_v):
            self._streak_start = fix.t
            self._was_aided = fix.t - self.last_fused <= self._longest_gap()
        self._previous = (fix, v_n)
        lasted = fix.t - max(self._streak_start, self.last_fused)
        wait = self.patience_s if self._was_aided else self.recovery_s
        if not self._was_aided and lasted < self.probation_s:
            verdict = Verdict.PROBATION
        elif inside_gate:
            verdict = Verdict.FUSE
        else:
            verdict = Verdict.RECOVER if lasted >= wait else Verdict.REJECT
        if verdict in (Verdict.FUSE, Verdict.RECOVER):
            self.last_fused = fix.t
            self._was_aided = True
        return verdict

    def _longest_gap(self) -> float:
        """Without fixes for longer is an outage, unless the receiver is as slow as that [s]."""
        return max(self.outage_s, 2 * self._interval) if math.isfinite(self._interval) else self.outage_s

    def _continues(self, fix: GnssSample, v_n: Array, sigma_v: Array) -> bool:
        """Whether ``fix`` is where the fix before it and the mean of both velocities say."""
        if self._previous is None:
            return False
        before, v0_n = self._previous
        dt = fix.t - before.t
        if dt > self._longest_gap():
            return False
        moved = displacement_n(fix.lat, fix.lon, fix.h, before.lat, before.lon, before.h)
        jump = moved - 0.5 * dt * (v0_n + v_n)
        variance = fix.sigma_position_n**2 + before.sigma_position_n**2 + (dt * sigma_v) ** 2
        variance += JUMP_FLOOR**2 + (TURN_ERROR * dt**3) ** 2
        return float(np.sum(jump * jump / variance)) <= self.consistency_gate
