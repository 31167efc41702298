"""How a claim is judged: one statistic over many draws, its 95 % interval, and a verdict from that interval.

* **met**: the whole interval keeps the bound, which is the paper's figure where it prints one;
* **missed**: none of the interval does;
* **open**: the bound is inside: more draws would tell;
* **impossible**: not met, and the best that anything could have, computed beside it, does not keep the bound either;
* **misprint**: missed by an equation that was taken as it is printed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nav.samples import Array

CONFIDENCE = 0.95
RESAMPLES = 2000  # of a bootstrap
ROUNDING = 1e-9  # of a figure beside its bound


class Verdict(StrEnum):
    """What is said of a claim; see the head of this module."""

    MET = "met"
    MISSED = "missed"
    OPEN = "open"
    IMPOSSIBLE = "impossible"
    MISPRINT = "misprint"


def _three(value: float) -> str:
    """Three digits; thousands without an exponent."""
    return f"{float(f'{value:.3g}'):.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"


class Interval(NamedTuple):
    """A statistic and the ends of its 95 % interval; an end that the draws are too few for is infinite."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        """As tables and texts have it, three digits each: ``0.52 (0.48 to 0.55)``; a number alone where it is sure."""
        if self.low == self.high:
            return _three(self.value)
        return f"{_three(self.value)} ({_three(self.low)} to {_three(self.high)})"


class Statistic(NamedTuple):
    """A name, and what makes an interval of the figures of all draws (draws,) or (draws, ...)."""

    name: str
    of: Callable[[Array], Interval]


def quantile(p: float) -> Statistic:
    """The ``p`` quantile, an order statistic, between two others (`scipy.stats.quantile_test`).

    A median is the usual one: of an even number of figures halfway between the two in the middle.

    Infinite figures, such as the delay of what was never found, count as the largest.
    """

    def of(values: Array) -> Interval:
        first, last = _ranks(len(values), p)
        ordered = np.sort(values)
        low = -math.inf if first is None else float(ordered[first])
        high = math.inf if last is None else float(ordered[last])
        value = np.median(values) if p == 0.5 else np.quantile(values, p, method="inverted_cdf")
        return Interval(float(value), low, high)

    return Statistic("median" if p == 0.5 else f"{100 * p:g} %", of)


@cache
def _ranks(n: int, p: float) -> tuple[int | None, int | None]:
    """Of which of ``n`` values in their order the interval of a quantile is made, None where they are too few."""
    from scipy.stats import quantile_test  # takes half a second to import

    found: Any = quantile_test(np.arange(n), p=p).confidence_interval(CONFIDENCE)
    return None if math.isnan(found.low) else int(found.low), None if math.isnan(found.high) else int(found.high)


def bootstrapped(name: str, function: Callable[[Array], float]) -> Statistic:
    """Any ``function`` of the figures of all draws; percentiles of a bootstrap over draws (`scipy.stats.bootstrap`).

    For what neither order statistics nor Student's interval tell; its ends are too near each other where draws are few.
    """

    def of(values: Array) -> Interval:
        from scipy.stats import bootstrap

        value = float(function(values))
        if np.all(values == values[0]):
            return Interval(value, value, value) if len(values) > 1 else Interval(value, -math.inf, math.inf)

        def resampled(rows: npt.NDArray[np.intp]) -> float:
            return function(values[rows])

        found = bootstrap(
            (np.arange(len(values)),), resampled, n_resamples=RESAMPLES, vectorized=False, method="percentile",
            confidence_level=CONFIDENCE, rng=np.random.default_rng(0),
        ).confidence_interval  # fmt: skip
        return Interval(value, float(found.low), float(found.high))

    return Statistic(name, of)


def _exact(values: Array) -> Interval:
    value = float(values[0])
    return Interval(value, value, value)


def _share(values: Array) -> Interval:
    """Of yes (1) and no (0), Clopper and Pearson's; of (hits, trials) of each draw a bootstrap's as well, since what is
    hit in one draw may be hit in a row: the wider of the two.
    """
    from scipy.stats import binomtest

    hits, trials = np.sum(values, axis=0) if values.ndim == 2 else (np.sum(values), len(values))
    exact = binomtest(round(float(hits)), round(float(trials))).proportion_ci(CONFIDENCE)
    low, high = float(exact.low), float(exact.high)
    if values.ndim == 2 and len(values) > 1:
        drawn = bootstrapped("", lambda rows: float(rows[:, 0].sum() / rows[:, 1].sum())).of(values)
        low, high = min(low, drawn.low), max(high, drawn.high)
    return Interval(float(hits / trials), low, high)


def student(values: Array) -> Interval:
    """The mean of some values, with the ends of Student's interval: infinite ones where there is one value only."""
    from scipy.special import stdtrit  # as scipy.stats, which takes half a second to import

    mean, n = float(values.mean()), len(values)
    if not math.isfinite(mean):
        return Interval(mean, mean, mean)
    if n < 2:
        return Interval(mean, -math.inf, math.inf)
    half = float(stdtrit(n - 1, (1 + CONFIDENCE) / 2) * values.std(ddof=1)) / math.sqrt(n)
    return Interval(mean, mean - half, mean + half)


def _product(values: Array, exponents: tuple[float, ...]) -> Interval:
    """Of (draws, n): the product of the n means, each to its power, and Student's interval of its logarithm.

    An RMS of Gaussian figures is in it in 91, 91, 93 and 94 % of cases with 5, 10, 20 and 100 draws; in a bootstrap's
    interval it is in 72, 84, 88 and 94 %.
    """
    means = values.mean(axis=0)
    value = float(np.prod(means**exponents))
    if len(values) < 2 or value < 0:
        return Interval(value, -math.inf, math.inf)
    if not 0 < value < math.inf:
        return Interval(value, value, value)
    mean, _, high = student((values / means) @ exponents)
    with np.errstate(over="ignore"):
        wide = float(np.exp(high - mean))
    return Interval(value, value / wide, value * wide)


RATIO = (1.0, -1.0)  # of (draws, 2): the first over the second
ROOT, RATIO_OF_ROOTS = (0.5,), (0.5, -0.5)
MEDIAN = quantile(0.5)
NEARLY_ALL, HARDLY_ANY = quantile(0.95), quantile(0.05)  # what is said of "any" draw: 100 draws can show no more
MEAN = Statistic("mean", student)
RMS = Statistic("RMS", lambda values: _product(values[:, None] ** 2, ROOT))
RATIO_OF_RMS = Statistic("ratio of RMS", lambda values: _product(values**2, RATIO_OF_ROOTS))
RATIO_OF_MEANS = Statistic("ratio of means", lambda values: _product(values, RATIO))
RMS_OVER_BOUND = RATIO_OF_RMS._replace(name="RMS / bound")  # of errors and their bounds
SHARE = Statistic("share", _share)
EXACT = Statistic("exact", _exact)  # of a figure that nothing is drawn for


class Floor(NamedTuple):
    """The best that anything could have: figures as `Claim.ours` has them, or, ``exact``, a computed one; and why."""

    values: npt.ArrayLike
    why: str
    exact: bool = False


@dataclass(frozen=True)
class Claim:
    """One figure of a paper beside ours.

    ``paper`` is what it prints, as text, empty where it claims nothing of the kind; ``ours`` the same quantity of each
    draw, of which the ``statistic`` is judged; ``bound`` what it must keep, at most or, with ``at_least``, at least.
    """

    quantity: str
    unit: str
    paper: str
    ours: npt.ArrayLike
    bound: float
    at_least: bool = False
    statistic: Statistic = MEDIAN
    floor: Floor | None = None
    misprint: bool = False
    note: str = ""

    @property
    def draws(self) -> int:
        """How many draws there are."""
        return len(np.atleast_1d(np.asarray(self.ours, dtype=float)))

    @cached_property
    def interval(self) -> Interval:
        """The statistic with its interval; NaN when there is nothing to judge."""
        return _judged(self.ours, self.statistic)

    @cached_property
    def best(self) -> Interval | None:
        """That of the `Floor`."""
        if self.floor is None:
            return None
        return _judged(self.floor.values, EXACT if self.floor.exact else self.statistic)

    @cached_property
    def verdict(self) -> Verdict:
        """See the head of this module; without a figure it is missed."""
        found = self._compare(self.interval)
        if found is Verdict.MET:
            return found
        if self.best is not None and self._compare(self.best) is Verdict.MISSED:
            return Verdict.IMPOSSIBLE
        return Verdict.MISPRINT if self.misprint and found is Verdict.MISSED else found

    def _compare(self, found: Interval) -> Verdict:
        value, inner, outer = found.value, found.high, found.low
        if self.at_least:
            inner, outer = found.low, found.high
        if math.isnan(value) or math.isnan(inner) or math.isnan(outer) or not self._keeps(outer):
            return Verdict.MISSED
        return Verdict.MET if self._keeps(inner) else Verdict.OPEN

    def _keeps(self, value: float) -> bool:
        """Rounding is no miss: a lag of 7.6 s is a difference of two times."""
        if math.isclose(value, self.bound, rel_tol=ROUNDING):
            return True
        return value >= self.bound if self.at_least else value <= self.bound

    @property
    def why(self) -> str:
        """What is to be said beside the verdict."""
        if self.verdict is Verdict.IMPOSSIBLE and self.floor is not None:
            return f"{self.floor.why}: {self.best}"
        return self.note

    def record(self) -> dict[str, Any]:
        """The claim as JSON has it; what is infinite or missing is None."""
        found, best = self.interval, self.best
        return {
            "quantity": self.quantity,
            "unit": self.unit,
            "paper": self.paper,
            "statistic": self.statistic.name,
            "draws": self.draws,
            "ours": _finite(found.value),
            "interval": [_finite(found.low), _finite(found.high)],
            "as text": str(found),
            "bound": f"{'≥' if self.at_least else '≤'} {self.bound:.3g}",
            "limit": self.bound,
            "best possible": None if best is None else _finite(best.value),
            "verdict": self.verdict.value,
            "why": self.why,
        }


def _judged(figures: npt.ArrayLike, statistic: Statistic) -> Interval:
    values = np.atleast_1d(np.asarray(figures, dtype=float))
    if not values.size or np.any(np.isnan(values)):
        return Interval(math.nan, math.nan, math.nan)
    return statistic.of(values)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
