"""The detectors of Zhou et al. 2025 on residuals as a perfect filter has them: white, of unit sigma.

The paper's faults act on them: a step of 5 sigma at 40-60 s, a ramp at 90-130 s of the printed 0.02 sigma/s or of the
0.1 sigma/s that fits the paper's other figures. What is not printed is assumed: 1e-3 for every probability, s = 0.9 in
Eq 20, memories of 4 s. What is compared with one another has the same evidence and the same limit, and differs in its
resets alone.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from nav.detection import ChiSquare, Detector, Glr, Mean, Reset, Sprt, exponential, glr_false_alarm
from nav.samples import Array
from testbed.noise import stream
from testbed.papers.bounds import TOLD, told_test
from testbed.papers.misprints import CountedEvidence, FadingMean, InclusiveEvidence
from testbed.score import accuracy, detection
from testbed.score.claims import MEAN, NEARLY_ALL, RATIO_OF_MEANS, SHARE, Claim, Floor

P = 1e-3  # false alarms and missed ones, per sample
STEP, GAP, RAMP = (40.0, 60.0), (60.0, 90.0), (90.0, 130.0)
SIZE = 5.0  # of the step [sigma]
PRINTED, STEEP = SLOPES = (0.02, 0.1)  # of the ramp [sigma/s]: as printed, and as fits the paper's figures
SCORED_S = 150.0  # nothing is scored later
RATES = (1, 5, 10)  # [Hz]
MAIN_RATE = 5  # of what the paper's figures are compared with
BATCH = 3  # replays of each draw
ONSET = 10.0  # evidence at which the likelihood ratio alarms, window full [nats]

CHI2, FADING, FAST, COMPLETE, GLR = "chi-square", "fading", "fast reset", "complete reset", "likelihood ratio"
FADING_EQ20, FAST_EQ20, COMPLETE_EQ20 = "fading, Eq 20", "fast reset, Eq 20", "complete reset, Eq 20"
COMPLETE_EQ17, COMPLETE_EQ17_EQ20 = "complete reset, Eq 17", "complete reset, Eq 17 and 20"
COMPLETE_CHI2 = "complete reset, chi-square limit"


def _mean(rate: int) -> Mean:
    """The mean that forgets in 4 s."""
    return exponential(0.95 if rate > 1 else 0.8)


def _printed(mean: Mean, reset: Reset = Reset.NONE) -> Detector:
    """The recursive evidence, with a mean that includes the sample, and Wald's limit."""
    return Sprt(P, mean, reset, InclusiveEvidence())


def _glr(rate: int, m: int) -> Detector:
    """On one axis by `ONSET`, as the prototype; on more by a probability: its limit must rise with their number."""
    return Glr(glr_false_alarm(ONSET, 1, 40 * rate) if m == 1 else P / 100)


BUILD: Mapping[str, Callable[[int, int], Detector]] = {
    CHI2: lambda rate, m: ChiSquare(P),
    FADING: lambda rate, m: _printed(_mean(rate)),
    FAST: lambda rate, m: _printed(_mean(rate), Reset.FAST),
    COMPLETE: lambda rate, m: _printed(_mean(rate), Reset.COMPLETE),
    GLR: _glr,
    FADING_EQ20: lambda rate, m: _printed(FadingMean(0.9)),
    FAST_EQ20: lambda rate, m: _printed(FadingMean(0.9), Reset.FAST),
    COMPLETE_EQ20: lambda rate, m: _printed(FadingMean(0.9), Reset.COMPLETE),
    COMPLETE_EQ17: lambda rate, m: Sprt(P, _mean(rate), Reset.COMPLETE, CountedEvidence()),
    COMPLETE_EQ17_EQ20: lambda rate, m: Sprt(P, FadingMean(0.9), Reset.COMPLETE, CountedEvidence()),
    COMPLETE_CHI2: lambda rate, m: Sprt(P, _mean(rate), Reset.COMPLETE),
}
MAIN = (CHI2, FADING, FAST, COMPLETE, GLR)
SEVERAL_AXES = (CHI2, COMPLETE_CHI2, GLR)  # of residuals of two and three axes, the fault on each


class Case(NamedTuple):
    """A detector on residuals of ``axes`` axes at ``rate`` [Hz]."""

    detector: str
    rate: int = MAIN_RATE
    axes: int = 1


CASES = (
    *(Case(name) for name in BUILD),
    *(Case(name, rate) for name in MAIN for rate in RATES if rate != MAIN_RATE),
    *(Case(name, MAIN_RATE, axes) for name in SEVERAL_AXES for axes in (2, 3)),
)


class Hard(NamedTuple):
    """One replay up to the ramp: alarms before the step, on it, after it. A delay is infinite without an alarm."""

    early: float  # alarms before the step
    samples: float  # there
    delay: float  # [s]
    coverage: float
    end_lag: float  # [s]
    gap: float  # share of the healthy samples between the faults
    lowest: float  # statistic there


class Soft(NamedTuple):
    """One replay's ramp. A delay is infinite without an alarm."""

    delay: float  # [s]
    sustained: float  # [s]
    coverage: float
    end_lag: float  # [s]
    wrong: float  # time of the whole run, up to `SCORED_S`, with an alarm and no fault or a fault and no alarm [s]


class Replayed(NamedTuple):
    """A draw of one case: `BATCH` steps, and as many ramps of each slope."""

    hard: list[Hard]
    soft: dict[float, list[Soft]]


def residuals(rate: int, seed: int, axes: int = 1, duration: float = SCORED_S) -> tuple[Array, Array]:
    """(times (samples,), residuals (samples, axes) without the ramp) of one run: unit normals and the step."""
    t = np.arange(1, round(duration * rate) + 1) / rate
    noise = stream(seed, "zhou2025", f"{rate} Hz").standard_normal((len(t), axes))
    return t, noise + SIZE * during(t, STEP)[:, None]


def ramp(t: Array, slope: float) -> Array:
    """The soft fault at the times ``t`` (samples,) [sigma]."""
    return np.where(during(t, RAMP), slope * (t - RAMP[0]), 0.0)


def during(t: Array, span: tuple[float, float]) -> accuracy.Mask:
    """Where the times lie in [start, end)."""
    inside: accuracy.Mask = (t >= span[0] - 1e-9) & (t < span[1] - 1e-9)
    return inside


def watch(detector: Detector, t: Array, r: Array) -> tuple[accuracy.Mask, Array, Array]:
    """(alarms, statistics, thresholds), each (samples,), of a detector on residuals (samples, axes) of unit sigma."""
    S = np.eye(r.shape[1])
    decisions = [detector.step(r[k], S, float(t[k])) for k in range(len(t))]
    return (
        np.array([d.alarm for d in decisions]),
        np.array([d.statistic for d in decisions]),
        np.array([d.threshold for d in decisions]),
    )


def replay(seed: int) -> dict[Case, Replayed]:
    """Every case on the residuals of one draw."""
    seeds = [BATCH * seed + k for k in range(BATCH)]
    return {case: Replayed(*_replayed(case, seeds)) for case in CASES}


def _replayed(case: Case, seeds: Sequence[int]) -> tuple[list[Hard], dict[float, list[Soft]]]:
    hard: list[Hard] = []
    soft: dict[float, list[Soft]] = {slope: [] for slope in SLOPES}
    for seed in seeds:
        t, r = residuals(case.rate, seed, case.axes)
        start = int(np.searchsorted(t, RAMP[0] - 1e-9))
        detector = BUILD[case.detector](case.rate, case.axes)
        alarms, statistics, _ = watch(detector, t[:start], r[:start])
        hard.append(_hard(t[:start], alarms, statistics))
        wrong = int(np.sum(alarms != during(t[:start], STEP)))
        for slope in SLOPES:
            later = t[start:]
            found, _, _ = watch(copy.deepcopy(detector), later, r[start:] + ramp(later, slope)[:, None])
            score = detection.detection(later, found, RAMP)
            assert score is not None
            wrong_s = float(wrong + np.sum(found != during(later, RAMP))) / case.rate
            end_lag = SCORED_S - RAMP[1] if math.isnan(score.end_lag) else score.end_lag
            soft[slope].append(
                Soft(_found(score.delay), _found(score.sustained_delay), score.coverage, end_lag, wrong_s)
            )
    return hard, soft


def _hard(t: Array, alarms: accuracy.Mask, statistics: Array) -> Hard:
    step = detection.detection(t, alarms, STEP, RAMP[0])
    assert step is not None
    before, gap = t < STEP[0] - 1e-9, during(t, GAP)
    end_lag = GAP[1] - GAP[0] if math.isnan(step.end_lag) else step.end_lag
    return Hard(
        float(alarms[before].sum()), float(before.sum()), _found(step.delay), step.coverage, end_lag,
        float(alarms[gap].mean()), float(statistics[gap].min()),
    )  # fmt: skip


def _found(delay: float) -> float:
    return math.inf if math.isnan(delay) else delay


# --- what comes out


class Found:
    """The results, by case."""

    def __init__(self, results: Sequence[Mapping[Case, Replayed]]) -> None:
        self._results = results

    def hard(self, case: Case, field: str) -> Array:
        """One field of `Hard` in every replay."""
        return np.array([getattr(one, field) for result in self._results for one in result[case].hard])

    def soft(self, case: Case, field: str, slope: float = STEEP) -> Array:
        """One field of `Soft` in every replay."""
        return np.array([getattr(one, field) for result in self._results for one in result[case].soft[slope]])

    def early(self, case: Case) -> Array:
        """(alarms, samples) before the step, in every replay."""
        return np.column_stack([self.hard(case, "early"), self.hard(case, "samples")])


def clairvoyant(rate: int, slope: float, axes: int = 1, p: float = P) -> tuple[float, float]:
    """(median delay [s], coverage) of a ramp's `told_test`."""
    tau = np.arange(round((RAMP[1] - RAMP[0]) * rate)) / rate
    samples, coverage = told_test(math.sqrt(axes) * slope * tau, p)
    return samples / rate, coverage


def claims(results: Sequence[Mapping[Case, Replayed]]) -> list[Claim]:
    """Every claim of Table 2, and what else is to be known of the detectors."""
    found = Found(results)
    return [
        *_hard_claims(found),
        *_soft_claims(found),
        *_gain_claims(found),
        *_misprints(found),
        *_own(found),
        *_false_alarms(found),
    ]


def _hard_claims(found: Found) -> Iterator[Claim]:
    for rate in RATES:
        case, what = Case(COMPLETE, rate), f"hard fault at {rate} Hz, {COMPLETE}"
        yield Claim(f"{what}: delay", "s", "1.2", found.hard(case, "delay"), 1.2)
        yield Claim(f"{what}: end lag", "s", "0", found.hard(case, "end_lag"), 0.0)
        yield Claim(f"{what}: alarms between the faults, share", "", "0", found.hard(case, "gap"), 0.0)
    for name, delay in ((CHI2, 0.0), (FADING, 1.2), (FAST, 1.2)):
        yield Claim(f"hard fault, {name}: delay", "s", f"{delay:g}", found.hard(Case(name), "delay"), delay)
    yield Claim(f"hard fault, {FADING}: end lag", "s", "7.6", found.hard(Case(FADING), "end_lag"), 7.6, at_least=True)
    yield Claim(f"hard fault, {FAST}: end lag", "s", "0", found.hard(Case(FAST), "end_lag"), 0.0)
    lowest = found.hard(Case(FAST), "lowest")
    yield Claim(
        f"after the hard fault, {FAST}: lowest evidence", "", "below zero", lowest, 0.0, statistic=NEARLY_ALL
    )  # fmt: skip


def _soft_claims(found: Found) -> Iterator[Claim]:
    for slope in SLOPES:
        for rate in RATES:
            delay, coverage = clairvoyant(rate, slope)
            case, what = Case(COMPLETE, rate), f"ramp of {slope:g} sigma/s at {rate} Hz, {COMPLETE}"
            yield Claim(
                f"{what}: delay", "s", "1.5", found.soft(case, "delay", slope), 1.5,
                floor=Floor(delay, TOLD, exact=True),
            )  # fmt: skip
            yield Claim(
                f"{what}: coverage", "", "0.96", found.soft(case, "coverage", slope), 0.96, at_least=True,
                statistic=MEAN, floor=Floor(coverage, TOLD, exact=True),
            )  # fmt: skip
    delay, coverage = clairvoyant(MAIN_RATE, STEEP)
    for name, paper in ((CHI2, 20.4), (FADING, 9.2), (FAST, 7.8)):
        yield Claim(
            f"ramp of 0.1 sigma/s, {name}: sustained delay", "s", f"{paper:g}", found.soft(Case(name), "sustained"),
            paper, floor=Floor(delay, TOLD, exact=True),
        )  # fmt: skip
    for name in (COMPLETE_EQ17, COMPLETE_CHI2):
        yield Claim(
            f"ramp of 0.1 sigma/s, {name}: coverage", "", "0.96", found.soft(Case(name), "coverage"), 0.96,
            at_least=True, statistic=MEAN, floor=Floor(coverage, TOLD, exact=True),
        )  # fmt: skip


def _gain_claims(found: Found) -> Iterator[Claim]:
    """Detected time, from the first alarm to the end of the fault, as the paper counts it."""
    length = RAMP[1] - RAMP[0]

    def detected(name: str) -> Array:
        return np.maximum(length - found.soft(Case(name), "delay"), 0.0)

    best = np.full(len(detected(COMPLETE)), length - clairvoyant(MAIN_RATE, STEEP)[0])
    for name, gain in ((CHI2, 0.9643), (FADING, 0.25), (FAST, 0.1957)):
        yield Claim(
            f"ramp of 0.1 sigma/s: detected time, {COMPLETE} over {name}", "", f"{1 + gain:.3g}",
            np.column_stack([detected(COMPLETE), detected(name)]), 1 + gain, at_least=True, statistic=RATIO_OF_MEANS,
            floor=Floor(np.column_stack([best, detected(name)]), TOLD),
        )  # fmt: skip


def _misprints(found: Found) -> Iterator[Claim]:
    """Equation 20, whose mean never forgets, with either evidence."""
    for name in (COMPLETE_EQ17_EQ20, COMPLETE_EQ20):
        delay = found.hard(Case(name), "delay")
        yield Claim(f"hard fault, {name}: delay", "s", "1.2", delay, 1.2, misprint=True)
        covered = found.soft(Case(name), "coverage")
        yield Claim(
            f"ramp of 0.1 sigma/s, {name}: coverage", "", "0.96", covered, 0.96, at_least=True, statistic=MEAN,
            misprint=True,
        )  # fmt: skip
    lag = found.hard(Case(FADING_EQ20), "end_lag")
    yield Claim(f"hard fault, {FADING_EQ20}: end lag", "s", "7.6", lag, 7.6, misprint=True)


def _own(found: Found) -> Iterator[Claim]:
    """The likelihood ratio, resets compared by the time judged wrongly, and several axes."""
    case, covered = Case(GLR), clairvoyant(MAIN_RATE, STEEP)[1]
    yield Claim(f"hard fault, {GLR}: delay", "s", "", found.hard(case, "delay"), 0.2)
    yield Claim(f"hard fault, {GLR}: end lag", "s", "", found.hard(case, "end_lag"), 0.2)
    coverage = found.soft(case, "coverage") / covered
    what = f"ramp of 0.1 sigma/s, {GLR}: coverage over that of the test that is told"
    yield Claim(what, "", "", coverage, 0.9, at_least=True, statistic=MEAN)
    for name, others in (
        (COMPLETE, (FAST, FADING)), (COMPLETE_EQ20, (FAST_EQ20, FADING_EQ20)),
        (GLR, tuple(other for other in BUILD if other != GLR)),
    ):  # fmt: skip
        rival = min(others, key=lambda other: found.soft(Case(other), "wrong").mean())
        pair = np.column_stack([found.soft(Case(one), "wrong") for one in (name, rival)])
        what = f"ramp of 0.1 sigma/s: time judged wrongly, {name} over the best {'reset' if name != GLR else 'other'}"
        yield Claim(what, "", "", pair, 1.0, statistic=RATIO_OF_MEANS, note=f"that is {rival}")
    for axes in (2, 3):
        for name in SEVERAL_AXES:
            case = Case(name, MAIN_RATE, axes)
            yield Claim(f"{axes} axes, hard fault, {name}: delay", "s", "", found.hard(case, "delay"), 0.4)
            yield _early(f"{axes} axes, alarms before the faults, {name}", found, case)


def _false_alarms(found: Found) -> Iterator[Claim]:
    for rate in RATES:
        for name in MAIN:
            yield _early(f"alarms before the faults at {rate} Hz, {name}", found, Case(name, rate))


def _early(what: str, found: Found, case: Case) -> Claim:
    """Of chi-square P is what it is made to have, so there is room for chance."""
    bound = 2 * P if case.detector == CHI2 else P
    return Claim(what, "", "", found.early(case), bound, statistic=SHARE)
