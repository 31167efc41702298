"""Whether one estimator, build or setting is better than another: metrics beside each other, and what may be chance.

Runs of both that have a seed in common are pairs: they had the same noise. Their differences are judged by Wilcoxon's
signed-rank test; where no seed is common, all runs by Mann and Whitney's U test (Conover, Practical Nonparametric
Statistics, 1999, 5.7 and 5.1). Both are two-sided and ask for no distribution; ``p`` is how probable a difference as
clear as this one is by chance alone. It is not corrected for the number of rows: of twenty that differ by chance alone,
one is below 0.05. One pair has no significance, and up to five pairs can have none below 0.05: p is 2 / 2^n at the
least. Rows of a single run are no further samples, as errors are correlated over minutes.

There is no verdict on an estimator that ended before the run, or gave estimates that are not finite: its metrics are of
another, shorter part of the run than the other's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from testbed import measures
from testbed.score.remarks import LOST

SIGNIFICANT = 0.05
NO_VERDICT = "none"


@dataclass(frozen=True, slots=True)
class Case:
    """Runs that are alike but for their seeds: for each, its seed and its metrics. ``estimators`` are those of all.

    Without a ``name`` its estimators go by their own. ``ended`` are those that ended in any of the runs, and why.
    """

    name: str
    estimators: Sequence[str]
    runs: Sequence[tuple[int, Mapping[str, float]]]
    ended: Mapping[str, str] = field(default_factory=dict)

    def values(self, metric: str) -> dict[int, list[float]]:
        """A metric by seed."""
        found: dict[int, list[float]] = {}
        for seed, metrics in self.runs:
            if metric in metrics:
                found.setdefault(seed, []).append(metrics[metric])
        return found


@dataclass(frozen=True, slots=True)
class Side:
    """One estimator of a case."""

    case: Case
    estimator: str

    def __str__(self) -> str:
        return f"{self.case.name}: {self.estimator}" if self.case.name else self.estimator

    @property
    def lacking(self) -> str:
        """Why it is scored on less than its runs: it ended, or gave estimates that are not finite; else empty."""
        if self.estimator in self.case.ended:
            return f"{self} has ended: {self.case.ended[self.estimator]}"
        lost = sum(metrics.get(f"{self.estimator}{LOST}", 0) for _, metrics in self.case.runs)
        return f"{self} gave {lost:.0f} estimates that are not finite" if lost else ""


@dataclass(frozen=True, slots=True)
class Difference:
    """One metric of both sides: means over ``runs`` pairs, or over all if these are not ``paired``.

    ``verdict``: same, better, worse or changed, by the tolerance of the metric; none where a side is `Side.lacking`.
    ``p`` is NaN where nothing can be said.
    """

    metric: str
    first: float
    second: float
    verdict: str
    runs: int
    paired: bool
    p: float

    @property
    def significant(self) -> bool:
        """Whether chance alone hardly does it."""
        return self.p < SIGNIFICANT


def sides(cases: Sequence[Case]) -> Iterator[tuple[Side, Side]]:
    """What is held against what: the others against the first, estimators of one name, or all where none is common."""
    first, *others = cases
    if not others:
        yield from ((Side(first, first.estimators[0]), Side(first, name)) for name in first.estimators[1:])
    for other in others:
        common = [name for name in first.estimators if name in other.estimators]
        yield from ((Side(first, name), Side(other, name)) for name in common)
        if not common and first.estimators:
            yield from ((Side(first, first.estimators[0]), Side(other, name)) for name in other.estimators)


def differences(first: Side, second: Side, metrics: Sequence[str]) -> list[Difference]:
    """Each of these metrics that both have; names are without the estimator's."""
    lacking = first.lacking or second.lacking
    found = []
    for metric in metrics:
        one, two = (side.case.values(f"{side.estimator}.{metric}") for side in (first, second))
        if one and two:
            row = _difference(metric, one, two)
            found.append(replace(row, verdict=NO_VERDICT, p=math.nan) if lacking else row)
    return found


def _difference(metric: str, one: Mapping[int, Sequence[float]], two: Mapping[int, Sequence[float]]) -> Difference:
    common = [seed for seed in one if seed in two]
    before, after = (
        np.array([float(np.mean(side[seed])) for seed in (common or side)], np.float64) for side in (one, two)
    )
    means = float(before.mean()), float(after.mean())
    measure = measures.find(f"_.{metric}") or measures.Measure(measures.Aim.NONE)
    runs = len(common) or min(len(before), len(after))
    return Difference(metric, *means, measure.verdict(*means), runs, bool(common), _chance(before, after, bool(common)))


def _chance(before: np.ndarray, after: np.ndarray, paired: bool) -> float:
    """How probable such a difference is by chance; NaN of a single pair, and where nothing differs."""
    from scipy.stats import mannwhitneyu, wilcoxon  # takes half a second to import

    if min(len(before), len(after)) < 2:
        return math.nan
    if not paired:
        return float(mannwhitneyu(before, after).pvalue)
    apart = after - before
    return float(wilcoxon(apart[apart != 0]).pvalue) if np.count_nonzero(apart) > 1 else math.nan
