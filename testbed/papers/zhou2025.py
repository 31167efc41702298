"""Zhou et al. 2025: SINS/GNSS/odometer, the completely reset SPRT, and fusion by adaptive normalised weights.

The detectors are replayed on residuals as a perfect filter has them: white, of unit sigma, one axis, with the paper's
faults (a step of 5 sigma at 40-60 s, a ramp at 90-130 s of the printed 0.02 sigma/s or of the 0.1 sigma/s that fits the
paper's other figures). What is not printed is assumed: 1e-3 for every probability, s = 0.9 in Eq 20, memories of 4 s.
The fusion is flown on ``scenarios/papers/zhou2025.toml``, with its faults and without.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from nav.detection import ChiSquare, Detector, Glr, Reset, Sprt, eq20, exponential, glr_false_alarm
from nav.samples import Array
from testbed import loop, metrics
from testbed.papers import Claim, Job, Paper, scenario
from testbed.report import COLOURS, FAULT
from testbed.sensors.noise import stream

if TYPE_CHECKING:
    from matplotlib.figure import Figure

P = 1e-3  # false alarms and missed ones, per look
STEP, GAP, RAMP = (40.0, 60.0), (60.0, 90.0), (90.0, 130.0)
SIZE = 5.0  # of the step [sigma]
SLOPES = (0.02, 0.1)  # of the ramp [sigma/s]: as printed, and as fits the paper's figures
SCORED_S, DURATION_S = 150.0, 216.0  # nothing is scored later
RATES = (1, 5, 10)  # [Hz]
BATCH, BATCHES = 50, 10  # seeds
ONSET = 10.0  # evidence at which the likelihood ratio alarms, window full [nats]
DRAWN = 5  # [Hz]

FUSION_SEEDS = 20
DRAWN_HZ = 2.0

CHI2, FADING, FAST, COMPLETE, GLR = "chi-square", "fading", "fast reset", "complete reset", "likelihood ratio"
FAST_EQ20, COMPLETE_EQ20, COMPLETE_N = "fast reset, Eq 20", "complete reset, Eq 20", "complete reset, Eq 17"


def _mean(rate: int) -> Any:
    """The mean that forgets in 4 s."""
    return exponential(0.95 if rate > 1 else 0.8)


# ``literal`` has evidence n |mean|^2 / 2 whatever the weights (Eq 17), a mean that includes the look, Wald's limit.
BUILD: Mapping[str, Callable[[int], Detector]] = {
    CHI2: lambda rate: ChiSquare(P),
    FADING: lambda rate: Sprt(P, _mean(rate), signed=True, literal=True),
    FAST: lambda rate: Sprt(P, _mean(rate), Reset.FAST, signed=True, literal=True),
    COMPLETE: lambda rate: Sprt(P, _mean(rate), Reset.COMPLETE),
    GLR: lambda rate: Glr(glr_false_alarm(ONSET, 1, 40 * rate)),
    FAST_EQ20: lambda rate: Sprt(P, eq20(0.9), Reset.FAST, signed=True, literal=True),
    COMPLETE_EQ20: lambda rate: Sprt(P, eq20(0.9), Reset.COMPLETE, literal=True),
    COMPLETE_N: lambda rate: Sprt(P, _mean(rate), Reset.COMPLETE, literal=True),
}


class Hard(NamedTuple):
    """One seed up to the ramp: alarms before the step, on it, after it."""

    false_alarms: float  # share of the looks before the step
    delay: float  # [s]
    coverage: float
    end_lag: float  # [s]
    gap: float  # share of the healthy looks between the faults
    lowest: float  # statistic there


class Soft(NamedTuple):
    """One seed's ramp."""

    delay: float  # [s]
    sustained: float  # [s]
    coverage: float
    end_lag: float  # [s]


# --- detectors on residuals


def residuals(rate: int, seed: int, duration: float = SCORED_S) -> tuple[Array, Array]:
    """(times, residuals without the ramp) of one run: unit normals and the step, both (looks,)."""
    t = np.arange(1, round(duration * rate) + 1) / rate
    return t, stream(seed, "zhou2025", f"{rate} Hz").standard_normal(len(t)) + SIZE * during(t, STEP)


def ramp(t: Array, slope: float) -> Array:
    """The soft fault at the times ``t`` (looks,) [sigma]."""
    return np.where(during(t, RAMP), slope * (t - RAMP[0]), 0.0)


def during(t: Array, span: tuple[float, float]) -> metrics.Mask:
    """Where the times lie in [start, end)."""
    inside: metrics.Mask = (t >= span[0] - 1e-9) & (t < span[1] - 1e-9)
    return inside


def watch(detector: Detector, t: Array, r: Array) -> tuple[metrics.Mask, Array, Array]:
    """(alarms, statistics, thresholds), each (looks,), of one detector on residuals ``r`` (looks,) of unit sigma."""
    S = np.eye(1)
    decisions = [detector.step(r[k : k + 1], S, float(t[k])) for k in range(len(t))]
    return (
        np.array([d.alarm for d in decisions]),
        np.array([d.statistic for d in decisions]),
        np.array([d.threshold for d in decisions]),
    )


def replay(name: str, rate: int, first_seed: int, seeds: int) -> dict[str, Any]:
    """One detector on a batch of seeds: `Hard` (seeds, 6), and by slope `Soft` (seeds, 4), as plain lists."""
    hard: list[Hard] = []
    soft: dict[float, list[Soft]] = {slope: [] for slope in SLOPES}
    for seed in range(first_seed, first_seed + seeds):
        t, r = residuals(rate, seed)
        start = int(np.searchsorted(t, RAMP[0] - 1e-9))
        detector = BUILD[name](rate)
        alarms, statistics, _ = watch(detector, t[:start], r[:start])
        step = metrics.detection(t[:start], alarms, STEP, RAMP[0])
        assert step is not None
        gap = during(t[:start], GAP)
        end_lag = STEP[1] - STEP[0] if math.isnan(step.end_lag) else step.end_lag
        hard.append(
            Hard(
                float(alarms[t[:start] < STEP[0] - 1e-9].mean()), step.delay, step.coverage, end_lag,
                float(alarms[gap].mean()), float(statistics[gap].min()),
            )  # fmt: skip
        )
        for slope in SLOPES:
            later = t[start:]
            found, _, _ = watch(copy.deepcopy(detector), later, r[start:] + ramp(later, slope))
            score = metrics.detection(later, found, RAMP)
            assert score is not None
            end_lag = SCORED_S - RAMP[1] if math.isnan(score.end_lag) else score.end_lag
            soft[slope].append(Soft(score.delay, score.sustained_delay, score.coverage, end_lag))
    return {"detector": name, "rate": rate, "hard": hard, "soft": soft}
