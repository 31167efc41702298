"""Zhou et al. 2025: SINS/GNSS/odometer, the completely reset SPRT, and fusion by adaptive normalised weights.

The detectors are replayed on residuals as a perfect filter has them: white, of unit sigma, one axis, with the paper's
faults (a step of 5 sigma at 40-60 s, a ramp at 90-130 s of the printed 0.02 sigma/s or of the 0.1 sigma/s that fits the
paper's other figures). What is not printed is assumed: 1e-3 for every probability, s = 0.9 in Eq 20, memories of 4 s.
What is compared with one another has the same evidence and the same limit, and differs in its resets alone. (With Eq 17
instead of the recursive evidence, on an exponential mean, the complete reset covers 0.448 of the ramp of 0.1 sigma/s.)
The fusion is flown on ``scenarios/papers/zhou2025.toml``, with its faults and without.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nav.detection import ChiSquare, Detector, Glr, Mean, Reset, Sprt, exponential, glr_false_alarm
from nav.samples import Array
from testbed.estimators import federated, registry
from testbed.estimators.lane import Lane
from testbed.estimators.rig import Rig
from testbed.estimators.section import EstimatorSection
from testbed.loop import loop
from testbed.papers import Job, Paper, scenario
from testbed.papers.claims import NEARLY_ALL, Claim
from testbed.papers.draws import Draws
from testbed.papers.misprints import FadingMean, InclusiveEvidence, weights_by_sum
from testbed.report.style import COLOURS, FAULT
from testbed.results import write_result
from testbed.scenario import Scenario
from testbed.score import accuracy, detection
from testbed.sensors.noise import stream

P = 1e-3  # false alarms and missed ones, per sample
STEP, GAP, RAMP = (40.0, 60.0), (60.0, 90.0), (90.0, 130.0)
SIZE = 5.0  # of the step [sigma]
SLOPES = (0.02, 0.1)  # of the ramp [sigma/s]: as printed, and as fits the paper's figures
SCORED_S, DURATION_S = 150.0, 216.0  # nothing is scored later
RATES = (1, 5, 10)  # [Hz]
BATCH = 5  # seeds of detectors for each draw
ONSET = 10.0  # evidence at which the likelihood ratio alarms, window full [nats]

MAIN_RATE = 5  # [Hz] of what the paper's figures are compared with
RECORD_HZ = 2.0

FKF, IMPROVED, LITERAL = "fkf", "improved", "literal"
LABELS = {FKF: "traditional", IMPROVED: "SPRT", "glr": "likelihood ratio", LITERAL: "weights as printed"}
PRINTED, STEEP, HEALTHY = "ramp as printed", "ramp 0.1 sigma/s", "healthy"
CASES: Mapping[str, Sequence[str]] = {
    PRINTED: (),
    STEEP: ("fault[2].slope=0.1", "fault[3].slope=0.1"),
    HEALTHY: ("fault=[]",),
}
FLOWN: Mapping[str, Sequence[str]] = {
    PRINTED: (FKF, IMPROVED),
    STEEP: (FKF, IMPROVED, "glr"),
    HEALTHY: (FKF, IMPROVED, "glr", LITERAL),
}

CHI2, FADING, FAST, COMPLETE, GLR = "chi-square", "fading", "fast reset", "complete reset", "likelihood ratio"
FADING_EQ20, FAST_EQ20, COMPLETE_EQ20 = "fading, Eq 20", "fast reset, Eq 20", "complete reset, Eq 20"
COMPLETE_CHI2 = "complete reset, chi-square limit"


def _mean(rate: int) -> Mean:
    """The mean that forgets in 4 s."""
    return exponential(0.95 if rate > 1 else 0.8)


def _printed(mean: Mean, reset: Reset = Reset.NONE) -> Detector:
    """The recursive evidence, with a mean that includes the sample, and Wald's limit."""
    return Sprt(P, mean, reset, InclusiveEvidence())


BUILD: Mapping[str, Callable[[int], Detector]] = {
    CHI2: lambda rate: ChiSquare(P),
    FADING: lambda rate: _printed(_mean(rate)),
    FAST: lambda rate: _printed(_mean(rate), Reset.FAST),
    COMPLETE: lambda rate: _printed(_mean(rate), Reset.COMPLETE),
    GLR: lambda rate: Glr(glr_false_alarm(ONSET, 1, 40 * rate)),
    FADING_EQ20: lambda rate: _printed(FadingMean(0.9)),
    FAST_EQ20: lambda rate: _printed(FadingMean(0.9), Reset.FAST),
    COMPLETE_EQ20: lambda rate: _printed(FadingMean(0.9), Reset.COMPLETE),
    COMPLETE_CHI2: lambda rate: Sprt(P, _mean(rate), Reset.COMPLETE),
}

MAIN = (CHI2, FADING, FAST, COMPLETE, GLR)
# What Table 2 says is missed of each fault [s]; it has no likelihood ratio.
TABLE_2 = {"hard": (0.0, 1.2, 1.2, 1.2, math.nan), "soft": (20.4, 9.2, 7.8, 1.5, math.nan)}


class Hard(NamedTuple):
    """One seed up to the ramp: alarms before the step, on it, after it."""

    false_alarms: float  # share of the samples before the step
    delay: float  # [s]
    coverage: float
    end_lag: float  # [s]
    gap: float  # share of the healthy samples between the faults
    lowest: float  # statistic there


class Soft(NamedTuple):
    """One seed's ramp."""

    delay: float  # [s]
    sustained: float  # [s]
    coverage: float
    end_lag: float  # [s]
    wrong: float  # time of the whole run, up to `SCORED_S`, with an alarm and no fault or a fault and no alarm [s]


# --- detectors on residuals


def residuals(rate: int, seed: int, duration: float = SCORED_S) -> tuple[Array, Array]:
    """(times, residuals without the ramp) of one run: unit normals and the step, both (samples,)."""
    t = np.arange(1, round(duration * rate) + 1) / rate
    return t, stream(seed, "zhou2025", f"{rate} Hz").standard_normal(len(t)) + SIZE * during(t, STEP)


def ramp(t: Array, slope: float) -> Array:
    """The soft fault at the times ``t`` (samples,) [sigma]."""
    return np.where(during(t, RAMP), slope * (t - RAMP[0]), 0.0)


def during(t: Array, span: tuple[float, float]) -> accuracy.Mask:
    """Where the times lie in [start, end)."""
    inside: accuracy.Mask = (t >= span[0] - 1e-9) & (t < span[1] - 1e-9)
    return inside


def watch(detector: Detector, t: Array, r: Array) -> tuple[accuracy.Mask, Array, Array]:
    """(alarms, statistics, thresholds), each (samples,), of a detector on residuals ``r`` (samples,) of unit sigma."""
    S = np.eye(1)
    decisions = [detector.step(r[k : k + 1], S, float(t[k])) for k in range(len(t))]
    return (
        np.array([d.alarm for d in decisions]),
        np.array([d.statistic for d in decisions]),
        np.array([d.threshold for d in decisions]),
    )


def replay(name: str, rate: int, first_seed: int, seeds: int) -> dict[str, Any]:
    """One detector on a batch of seeds: `Hard` (seeds, 6), and by slope `Soft` (seeds, 5), as plain lists."""
    hard: list[Hard] = []
    soft: dict[float, list[Soft]] = {slope: [] for slope in SLOPES}
    for seed in range(first_seed, first_seed + seeds):
        t, r = residuals(rate, seed)
        start = int(np.searchsorted(t, RAMP[0] - 1e-9))
        detector = BUILD[name](rate)
        alarms, statistics, _ = watch(detector, t[:start], r[:start])
        step = detection.detection(t[:start], alarms, STEP, RAMP[0])
        assert step is not None
        gap = during(t[:start], GAP)
        end_lag = STEP[1] - STEP[0] if math.isnan(step.end_lag) else step.end_lag
        false_alarms, after = float(alarms[t[:start] < STEP[0] - 1e-9].mean()), float(alarms[gap].mean())
        lowest = float(statistics[gap].min())
        hard.append(Hard(false_alarms, step.delay, step.coverage, end_lag, after, lowest))
        wrong = np.sum(alarms != during(t[:start], STEP))
        for slope in SLOPES:
            later = t[start:]
            found, _, _ = watch(copy.deepcopy(detector), later, r[start:] + ramp(later, slope))
            score = detection.detection(later, found, RAMP)
            assert score is not None
            end_lag = SCORED_S - RAMP[1] if math.isnan(score.end_lag) else score.end_lag
            wrong_s = float(wrong + np.sum(found != during(later, RAMP))) / rate
            soft[slope].append(Soft(score.delay, score.sustained_delay, score.coverage, end_lag, wrong_s))
    return {"detector": name, "rate": rate, "hard": hard, "soft": soft}


# --- fusion on the square circuit


def chosen(names: Sequence[str], overrides: Sequence[str] = ()) -> Scenario:
    """The scenario with these of `LABELS`; `LITERAL` is `IMPROVED` until `build` makes it."""
    whole = scenario("zhou2025", overrides)
    improved = next(section for section in whole.estimator if section.name == IMPROVED)
    every = (*whole.estimator, improved.model_copy(update={"name": LITERAL}))
    return whole.model_copy(update={"estimator": tuple(section for section in every if section.name in names)})


def build(sections: Sequence[EstimatorSection], rig: Rig) -> dict[str, Lane]:
    """The estimators of these sections, the one called `LITERAL` with the normalised weights as they are printed."""
    lanes = registry.build(sections, rig)
    for section in sections:
        if section.name == LITERAL and isinstance(section, federated.FederatedSection):
            told = replace(federated.configuration(section, rig), normalise=weights_by_sum)
            lanes[LITERAL] = federated.lane(section, rig, told)
    return lanes


def fly(case: str, seed: int, series: bool = False) -> dict[str, Any]:
    """One run: by estimator the RMSE north and east [m], the mean of the horizontal 1-sigma that it claims [m].

    With ``series`` also the errors over time, for the figure.
    """
    keys = [*CASES[case], f"seed={seed}", "record.imu=false", f"record.rate_hz={RECORD_HZ}"]
    result = loop.run(chosen(FLOWN[case], keys), build=build)
    found: dict[str, Any] = {"case": case, "seed": seed, "rmse": {}, "sigma": {}, "errors": {}}
    for name in FLOWN[case]:
        e = accuracy.errors(result.dataset, name, 0.0)
        found["rmse"][name] = [float(np.sqrt(np.mean(e.position[:, axis] ** 2))) for axis in (0, 1)]
        found["sigma"][name] = float(np.mean(e.sigma_position[:, :2]))
        if series:
            found["errors"][name] = e.position[:, :2].tolist()
    return found


def jobs(draws: Draws) -> Iterator[Job]:
    """Batches of seeds for each detector and rate, one run for each case and seed."""
    for case in CASES:
        for seed in draws.seeds:
            yield Job(fly, (case, seed, seed == draws.seeds[0]))
    for rate in RATES:
        for name in BUILD if rate == MAIN_RATE else MAIN:
            for seed in draws.seeds[::BATCH]:
                yield Job(replay, (name, rate, seed, BATCH))


# --- what comes out


class Found:
    """The results, sorted."""

    def __init__(self, results: Sequence[Any]) -> None:
        self._flights = [r for r in results if "case" in r]
        self._replays = [r for r in results if "detector" in r]

    def hard(self, name: str, field: str, rate: int = MAIN_RATE) -> list[float]:
        """Mean of one field of `Hard` in each batch."""
        index = Hard._fields.index(field)
        return [_mean_of(row[index] for row in r["hard"]) for r in self._of(name, rate)]

    def soft(self, name: str, field: str, slope: float, rate: int = MAIN_RATE) -> list[float]:
        """Mean of one field of `Soft` over the seeds of each batch that have one."""
        index = Soft._fields.index(field)
        return [_mean_of(row[index] for row in r["soft"][slope]) for r in self._of(name, rate)]

    def _of(self, name: str, rate: int) -> list[Any]:
        return [r for r in self._replays if r["detector"] == name and r["rate"] == rate]

    def rmse(self, case: str, name: str) -> Array:
        """RMSE (seeds, 2) north and east [m]."""
        return np.array([r["rmse"][name] for r in self._flights if r["case"] == case])

    def ratio(self, case: str, name: str) -> Array:
        """RMSE over all seeds, relative to the traditional filter's, (2,) north and east."""
        square = [np.mean(self.rmse(case, one) ** 2, axis=0) for one in (name, FKF)]
        ratio: Array = np.sqrt(square[0] / square[1])
        return ratio

    def sigma(self, case: str, name: str) -> list[float]:
        """The 1-sigma that it claims, relative to the traditional filter's, by seed."""
        return [r["sigma"][name] / r["sigma"][FKF] for r in self._flights if r["case"] == case]

    def errors(self, case: str, name: str) -> Array:
        """Errors (n, 2) north and east of the first seed [m]."""
        return next(np.array(r["errors"][name]) for r in self._flights if r["case"] == case and r["errors"])


def _mean_of(values: Any) -> float:
    known = [value for value in values if not math.isnan(value)]
    return math.fsum(known) / len(known) if known else math.nan


def conclude(results: Sequence[Any]) -> list[Claim]:
    """Detectors by means over batches of seeds, fusion by the RMSE over all seeds."""
    found = Found(results)
    return [*_hard_claims(found), *_soft_claims(found), *_false_alarm_claims(found), *_fusion_claims(found)]


def _hard_claims(found: Found) -> Iterator[Claim]:
    for rate in RATES:
        for name, paper in ((COMPLETE, "1.2"), (GLR, "1.2 (complete reset)")):
            what = f"hard fault at {rate} Hz, {name}"
            yield Claim(f"{what}: delay", "s", paper, found.hard(name, "delay", rate), 1.2)
            yield Claim(f"{what}: end lag", "s", "0", found.hard(name, "end_lag", rate), 0.2)
    # Eq 20's mean after n healthy samples and k of size a is near a k / (s n), and the evidence a^2 k^2 / (2 s n).
    # What noise makes before, as the mean includes the sample: 1/(s k) - 1/(2 k) at sample k.
    n, s = STEP[0] * MAIN_RATE, 0.9
    missing = math.log((1 - P) / P) - (1 / s - 0.5) * (math.log(n) + np.euler_gamma)
    slowest = math.ceil(math.sqrt(2 * s * n * missing) / SIZE) / MAIN_RATE
    yield Claim(
        f"hard fault at 5 Hz, {COMPLETE_EQ20}: delay", "s", "1.2", found.hard(COMPLETE_EQ20, "delay"), slowest,
        note="the mean of Eq 20 holds the 40 s before the fault: 1.2 s would take 6 Hz, and the GNSS has 1 Hz",
    )  # fmt: skip
    yield Claim("hard fault, chi-square: delay", "s", "0", found.hard(CHI2, "delay"), 0.2)
    yield Claim(f"hard fault, {FADING}: delay", "s", "1.2", found.hard(FADING, "delay"), 1.2)
    yield Claim(f"hard fault, {FADING}: end lag", "s", "7.6", found.hard(FADING, "end_lag"), 5.0, at_least=True)
    yield Claim(f"hard fault, {FAST}: end lag", "s", "0", found.hard(FAST, "end_lag"), 0.2)
    for name in (FAST, FAST_EQ20):
        lowest = found.hard(name, "lowest")
        yield Claim(
            f"after the hard fault, {name}: lowest evidence", "", "below zero", lowest, 0.0, statistic=NEARLY_ALL
        )


def _soft_claims(found: Found) -> Iterator[Claim]:
    low, high = SLOPES
    for name in (COMPLETE, COMPLETE_EQ20, COMPLETE_CHI2):
        covered = found.soft(name, "coverage", high)
        yield Claim(f"ramp 0.1 sigma/s, {name}: coverage", "", "0.96", covered, 0.45, at_least=True)
    covered = found.soft(GLR, "coverage", high)
    yield Claim(f"ramp 0.1 sigma/s, {GLR}: coverage", "", "0.96 (complete reset)", covered, 0.74, at_least=True)
    evidence = MAIN_RATE * high**2 * 1.5**3 / 6
    yield Claim(
        f"ramp 0.1 sigma/s, {GLR}: delay", "s", "1.5 (complete reset)", found.soft(GLR, "delay", high), 10.5,
        note=f"the samples of 1.5 s hold {evidence:.2f} nats of evidence, and the false alarms ask for {ONSET:g}",
    )  # fmt: skip

    def sooner(name: str, than: str, field: str = "delay") -> list[float]:
        return _less(found.soft(than, field, high), found.soft(name, field, high))

    yield Claim(f"ramp 0.1 sigma/s, {GLR} before {FADING} by", "s", "", sooner(GLR, FADING), 0.0, at_least=True)
    yield Claim(f"ramp 0.1 sigma/s, {GLR} before {COMPLETE} by", "s", "", sooner(GLR, COMPLETE), 0.0, at_least=True)
    for name in (COMPLETE, COMPLETE_CHI2):
        what = f"ramp 0.1 sigma/s, {GLR} before {name} (sustained) by"
        yield Claim(what, "s", "", sooner(GLR, name, "sustained"), 0.0, at_least=True)
    chi2 = _less(found.soft(CHI2, "sustained", high), found.soft(FADING, "delay", high))
    yield Claim(f"ramp 0.1 sigma/s, {FADING} before {CHI2} (sustained) by", "s", "11.2", chi2, 0.0, at_least=True)
    because = "after 4 s nothing is left of the first fault in these means: 30 s later there is nothing to take out"
    for name, paper in ((FADING, "7.7"), (FAST, "6.3")):
        what = f"ramp 0.1 sigma/s, {COMPLETE} before {name} by"
        yield Claim(what, "s", paper, sooner(COMPLETE, name), -0.1, at_least=True, note=because)
    what = f"ramp 0.1 sigma/s, {COMPLETE_EQ20} before {FAST_EQ20} by"
    yield Claim(what, "s", "6.3", sooner(COMPLETE_EQ20, FAST_EQ20), 6.3, at_least=True)
    for name, others in (
        (COMPLETE, (FAST, FADING)), (COMPLETE_EQ20, (FAST_EQ20, FADING_EQ20)),
        (GLR, [other for other in BUILD if other != GLR]),
    ):  # fmt: skip
        less = np.min([sooner(name, other, "wrong") for other in others], axis=0).tolist()
        against = " and ".join(others) if name != GLR else "any other"
        what = f"time judged wrongly with the ramp of 0.1 sigma/s, {name} less than {against} by"
        yield Claim(what, "s", "", less, 0.0, at_least=True)
    expected = (6 * ONSET / (MAIN_RATE * low**2)) ** (1 / 3)
    ratio = [delay / expected for delay in found.soft(GLR, "delay", low)]
    because = "0.02 sigma/s is 0.03 sigma after 1.5 s: no detector can see that before some 30 kHz"
    what = f"ramp 0.02 sigma/s, {GLR}: delay over that of the expected evidence, {expected:.1f} s"
    yield Claim(what, "", "0.05 (1.5 s, complete reset)", ratio, 1.05, note=because)
    yield Claim(what, "", "0.05 (1.5 s, complete reset)", ratio, 0.75, at_least=True, note=because)


def _less(later: Sequence[float], sooner: Sequence[float]) -> list[float]:
    return [a - b for a, b in zip(later, sooner, strict=True)]


def _false_alarm_claims(found: Found) -> Iterator[Claim]:
    for rate in RATES:
        for name in MAIN:
            share = found.hard(name, "false_alarms", rate)
            # Chi-square has P by design: away from the main rate, what chance makes of it in all samples.
            by_chance = rate != MAIN_RATE and name == CHI2
            room = 3 * math.sqrt(P / (STEP[0] * rate * BATCH * len(share))) if by_chance else 0.0
            yield Claim(
                f"alarms before the faults at {rate} Hz, {name}", "", "", [math.fsum(share) / len(share)], P + room
            )
            if name in (COMPLETE, FAST, GLR):
                gap = found.hard(name, "gap", rate)
                yield Claim(f"alarms between the faults at {rate} Hz, {name}", "", "0", gap, 0.01)
    for name in (FADING, FADING_EQ20):
        gap = found.hard(name, "gap")
        yield Claim(f"alarms between the faults at {MAIN_RATE} Hz, {name}", "", "0.25", gap, 0.2, at_least=True)


def _fusion_claims(found: Found) -> Iterator[Claim]:
    paper = {"north": ("2.17", "1.10", "0.51 or 0.55", 0.55), "east": ("3.50", "2.25", "0.64", 0.65)}
    for axis, (side, (fkf, improved, ratio, bound)) in enumerate(paper.items()):
        what = f"{side} RMSE, improved (traditional: {np.mean(found.rmse(PRINTED, FKF)[:, axis]):.2f}; paper: {fkf})"
        yield Claim(what, "m", improved, found.rmse(PRINTED, IMPROVED)[:, axis].tolist(), float(improved))
        for case, name in ((PRINTED, IMPROVED), (STEEP, IMPROVED), (STEEP, "glr")):
            what = f"{side} RMSE over the traditional, {case}, {LABELS[name]}"
            yield Claim(what, "", ratio, [float(found.ratio(case, name)[axis])], bound)
        for name in (IMPROVED, "glr"):
            what = f"{side} RMSE over the traditional, {HEALTHY}, {LABELS[name]}"
            yield Claim(what, "", "", [float(found.ratio(HEALTHY, name)[axis])], 1.02)
        what = f"{side} RMSE over the traditional, {HEALTHY}, weights as printed"
        yield Claim(what, "", "", [float(found.ratio(HEALTHY, LITERAL)[axis])], 1.02, at_least=True)
    claimed = found.sigma(HEALTHY, LITERAL)
    yield Claim(f"claimed 1-sigma over the traditional, {HEALTHY}, weights as printed", "", "", claimed, 1.1, True)


# --- figure


def draw(results: Sequence[Any], out: Path) -> None:
    """Statistics with thresholds and faults, Table 2 as bars, errors of both fusions: ``zhou2025.png``."""
    import io

    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    found = Found(results)
    figure = Figure(figsize=(12, 7.4), dpi=80, layout="constrained")
    FigureCanvasAgg(figure)
    halves: Any = figure.subfigures(1, 2, width_ratios=(1.15, 1))
    _draw_statistics(halves[0])
    _draw_results(halves[1], found)
    data = io.BytesIO()
    figure.savefig(data, format="png")
    write_result(out / "zhou2025.png", data.getvalue())


def _draw_statistics(figure: Any) -> None:
    """One seed through the detectors, over the whole of the run."""
    rows = figure.subplots(len(MAIN), 1, sharex=True)
    t, r = residuals(MAIN_RATE, 1, DURATION_S)
    for name, ax in zip(MAIN, rows, strict=True):
        alarms, statistics, thresholds = watch(BUILD[name](MAIN_RATE), t, r + ramp(t, SLOPES[1]))
        ax.axvspan(*STEP, color=FAULT, lw=0)
        ax.axvspan(*RAMP, color=FAULT, lw=0)
        ax.plot(t, statistics, color=COLOURS[0], lw=0.8)
        ax.plot(t, thresholds, color="#000000", lw=0.9, ls="--")
        reach = 5 * float(thresholds[-1])
        ax.set_ylim(-0.8 * reach if name == FAST else -0.16 * reach, reach)
        bottom = ax.get_ylim()[0]
        ax.plot(t[alarms], np.full(alarms.sum(), 0.93 * bottom), "|", color=COLOURS[1], ms=5, mew=0.8)
        ax.set_title(name, loc="left", fontsize=9, pad=2)
        ax.grid(alpha=0.35, lw=0.6)
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=8)
    rows[0].set_xlim(0, DURATION_S)
    rows[-1].set_xlabel("time [s]", fontsize=9)
    figure.suptitle("Statistic, threshold (dashed), alarms (ticks); step 5 σ and ramp 0.1 σ/s at 5 Hz", fontsize=10)


def _draw_results(figure: Any, found: Found) -> None:
    """Table 2 as bars, and what the fusion makes of the faults."""
    bars, north, east = figure.subplots(3, 1, height_ratios=(1.25, 1, 1))
    place = np.arange(len(MAIN))
    series = (
        ("hard fault, paper", TABLE_2["hard"], COLOURS[4]),
        ("hard fault, ours", [_mean_of(found.hard(name, "delay")) for name in MAIN], COLOURS[0]),
        ("soft fault, paper", TABLE_2["soft"], COLOURS[5]),
        ("soft fault 0.1 σ/s, ours", [_mean_of(found.soft(name, "sustained", SLOPES[1])) for name in MAIN], COLOURS[1]),
    )
    for k, (label, values, colour) in enumerate(series):
        drawn = bars.bar(place + 0.2 * (k - 1.5), values, 0.2, color=colour, label=label)
        bars.bar_label(drawn, [f"{v:.1f}" if v >= 0.05 else "0" if v == v else "" for v in values], fontsize=7)
    bars.set_xticks(place, [name.replace(" ", "\n") for name in MAIN], fontsize=8)
    bars.set_ylim(0, 45)
    bars.set_ylabel("missed before [s]", fontsize=9)
    bars.legend(fontsize=8, ncols=2, frameon=False, loc="upper right")
    for axis, (side, ax) in enumerate((("north", north), ("east", east))):
        ax.axvspan(*STEP, color=FAULT, lw=0)
        ax.axvspan(*RAMP, color=FAULT, lw=0)
        for k, name in ((1, FKF), (0, IMPROVED), (2, "glr")):
            error = found.errors(STEEP, name)[:, axis]
            t = np.arange(len(error)) / RECORD_HZ
            ax.plot(t, error, color=COLOURS[k], lw=1, label=LABELS[name])
        ax.set_ylabel(f"{side} error [m]", fontsize=9)
        ax.set_xlim(0, DURATION_S)
    north.legend(fontsize=8, ncols=3, frameon=False, loc="upper right")
    north.set_xticklabels([])
    east.set_xlabel("time [s]", fontsize=9)
    for ax in (bars, north, east):
        ax.grid(alpha=0.35, lw=0.6)
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=8)
    figure.suptitle("Table 2, and the position on the circuit", fontsize=10)


PAPER = Paper(
    "Zhou 2025: completely reset SPRT and adaptive normalised weights",
    ("zhou2025.png",),
    lambda draws: list(jobs(draws)),
    conclude,
    draw,
)
