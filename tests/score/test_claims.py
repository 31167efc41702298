"""How claims are judged: statistics against analytic intervals, verdicts from intervals, draws and worlds."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from testbed.errors import UserError
from testbed.papers.draws import LATITUDE_DEG, STRETCH, Draws, draws, world
from testbed.score.claims import (
    EXACT,
    HARDLY_ANY,
    MEAN,
    MEDIAN,
    NEARLY_ALL,
    RATIO_OF_MEANS,
    RATIO_OF_RMS,
    RMS,
    SHARE,
    Claim,
    Floor,
    Statistic,
    Verdict,
    quantile,
)

HUNDRED = np.random.default_rng(1).permutation(np.arange(1.0, 101.0))


def claim(ours: Any, bound: float, **keys: Any) -> Claim:
    return Claim("error", "m", "10", ours, bound, **keys)


@pytest.mark.parametrize(("p", "name"), [(0.5, "median"), (0.95, "95 %"), (0.05, "5 %")])
def test_a_quantile_lies_between_the_binomial_ranks(p: float, name: str) -> None:
    """Of 1, 2, ... 100 an order statistic is its rank: rank r keeps P(B < r) and P(B >= r), B binomial(100, p)."""
    statistic = quantile(p)
    found = statistic.of(HUNDRED)
    assert statistic.name == name
    assert found.value == (50.5 if p == 0.5 else math.ceil(100 * p))
    binomial = stats.binom(100, p)
    assert binomial.cdf(found.low - 1) <= 0.025 < binomial.cdf(found.low)
    assert binomial.sf(found.high - 1) <= 0.025 < binomial.sf(found.high - 2)


def test_too_few_draws_leave_a_quantile_without_an_end() -> None:
    assert NEARLY_ALL.of(HUNDRED[:20]).high == math.inf
    assert HARDLY_ANY.of(HUNDRED[:20]).low == -math.inf
    assert claim(HUNDRED[:20], 1000.0, statistic=NEARLY_ALL).verdict == "open"


def test_what_was_never_found_counts_as_the_largest() -> None:
    values = np.where(HUNDRED > 70, np.inf, HUNDRED)
    assert MEDIAN.of(values).high < math.inf
    assert MEDIAN.of(np.array([1.0, 2.0, math.inf, math.inf])).value == math.inf
    assert NEARLY_ALL.of(values) == (math.inf, math.inf, math.inf)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("statistic", "truth"), [(MEDIAN, 0.0), (NEARLY_ALL, stats.norm.ppf(0.95)), (MEAN, 0.0), (RMS, 1.0)]
)
def test_intervals_hold_the_truth_as_often_as_they_say(statistic: Statistic, truth: float) -> None:
    """Of 120 intervals of 95 % 114 hold it: 104 is four standard deviations less."""
    random = np.random.default_rng(2)
    held = sum(low <= truth <= high for _ in range(120) for _, low, high in [statistic.of(random.normal(size=100))])
    assert held >= 104


@pytest.mark.parametrize(("statistic", "columns"), [(RMS, ()), (RATIO_OF_RMS, (2,)), (RATIO_OF_MEANS, (2,))])
def test_intervals_of_few_draws_are_wide_enough(statistic: Statistic, columns: tuple[int, ...]) -> None:
    """Of 2000 with ten draws each: a bootstrap's percentiles hold an RMS in 84 % of cases."""
    random = np.random.default_rng(3)
    drawn = np.abs(random.normal(size=(2000, 10, *columns)))
    held = np.mean([low <= 1.0 <= high for _, low, high in map(statistic.of, drawn)])
    assert held > 0.89


def test_one_draw_says_nothing_of_an_rms_or_a_ratio() -> None:
    assert RMS.of(np.zeros(1)) == (0.0, -math.inf, math.inf)
    assert RATIO_OF_RMS.of(np.array([[1.0, 2.0]])) == (0.5, -math.inf, math.inf)
    assert RATIO_OF_MEANS.of(np.array([[1000.0, 1.0], [-999.9, 1.0]])).high == math.inf


def test_a_ratio_is_paired() -> None:
    """Where each draw has the same ratio there is no doubt about it, however the draws differ."""
    found = RATIO_OF_RMS.of(np.column_stack([0.5 * HUNDRED, HUNDRED]))
    assert found == pytest.approx((0.5, 0.5, 0.5))


def test_a_share_has_the_interval_of_clopper_and_pearson() -> None:
    found = SHARE.of(np.repeat([1.0, 0.0], [30, 70]))
    assert found == pytest.approx((0.3, stats.beta.ppf(0.025, 30, 71), stats.beta.ppf(0.975, 31, 70)))
    assert SHARE.of(np.array([[10.0, 40.0], [20.0, 60.0]])) == pytest.approx(found)
    assert SHARE.of(np.zeros(100)) == pytest.approx((0.0, 0.0, 1 - 0.025**0.01))


def test_what_is_the_same_in_every_draw_is_sure() -> None:
    assert MEAN.of(np.full(10, 3.0)) == (3.0, 3.0, 3.0)
    assert MEAN.of(np.array([3.0])) == (3.0, -math.inf, math.inf)
    assert EXACT.of(np.array([3.0])) == (3.0, 3.0, 3.0)


def test_verdicts() -> None:
    assert claim(HUNDRED, 70.0).verdict is Verdict.MET
    assert claim(HUNDRED, 50.0).verdict is Verdict.OPEN
    assert claim(HUNDRED, 30.0).verdict is Verdict.MISSED
    assert claim(HUNDRED, 30.0, at_least=True).verdict is Verdict.MET
    assert claim(HUNDRED, 50.0, at_least=True).verdict is Verdict.OPEN
    assert claim(HUNDRED, 70.0, at_least=True).verdict is Verdict.MISSED
    assert claim([3.0], 3.0, statistic=EXACT).verdict is Verdict.MET
    assert claim([], 3.0).verdict is Verdict.MISSED
    assert claim([1.0, math.nan], 3.0).verdict is Verdict.MISSED


@pytest.mark.parametrize("at_least", [True, False])
def test_a_figure_that_is_its_bound_but_for_rounding_keeps_it(at_least: bool) -> None:
    lag = 67.6 - 60.0  # 7.599999999999994
    found = Claim("lag", "s", "7.6", [lag, lag, lag], 7.6, at_least=at_least, statistic=MEAN)
    assert found.verdict is Verdict.MET
    rest = Claim("lag", "s", "7.6", [1.2 + 2e-16] * 9, 1.2, statistic=MEAN)
    assert rest.verdict is Verdict.MET


def test_impossible_takes_a_bound_that_was_computed_and_does_not_keep_the_claim_either() -> None:
    beyond, below = Floor(HUNDRED + 50, "the optimal filter"), Floor(HUNDRED - 50, "the optimal filter")
    assert claim(HUNDRED + 60, 20.0, floor=beyond).verdict is Verdict.IMPOSSIBLE
    assert claim(HUNDRED + 60, 20.0, floor=below).verdict is Verdict.MISSED
    assert claim(HUNDRED + 60, 20.0, floor=Floor(100.0, "an information bound", exact=True)).verdict == "impossible"
    assert claim(HUNDRED, 99.0, floor=beyond).verdict is Verdict.MET, "what is met is possible"
    assert claim(HUNDRED + 80, 100.0, floor=beyond).verdict is Verdict.MISSED, "a floor that is open proves nothing"
    assert "the optimal filter: 100 (" in claim(HUNDRED + 60, 20.0, floor=beyond).why


def test_a_misprint_is_one_only_where_it_misses() -> None:
    assert claim(HUNDRED, 30.0, misprint=True).verdict is Verdict.MISPRINT
    assert claim(HUNDRED, 50.0, misprint=True).verdict is Verdict.OPEN
    assert claim(HUNDRED, 70.0, misprint=True).verdict is Verdict.MET


def test_a_record_is_json_without_infinities() -> None:
    found = json.loads(json.dumps(claim(HUNDRED[:20], 99.0, statistic=NEARLY_ALL).record(), allow_nan=False))
    assert found["interval"][1] is None
    assert found["draws"] == 20


def test_no_draw_has_a_seed_of_another() -> None:
    seeds = [set(Draws(number, 100).seeds) for number in range(5)]
    assert len(set().union(*seeds)) == 500


def test_draws_that_are_not_there_are_refused() -> None:
    assert draws(3, None, True).runs == 10
    assert draws(3, None, False).runs == 100
    for number, runs, quick in ((-1, None, False), (10**10, None, False), (0, 10**7, False), (0, 5, True)):
        with pytest.raises(UserError, match=r"--draw|--runs"):
            draws(number, runs, quick)


def test_worlds_lie_in_their_ranges_and_in_both_hemispheres() -> None:
    worlds = [world(seed, 3) for seed in range(200)]
    latitudes = np.array([one.lat_deg for one in worlds])
    assert np.all((np.abs(latitudes) >= LATITUDE_DEG[0]) & (np.abs(latitudes) <= LATITUDE_DEG[1]))
    assert 60 < np.sum(latitudes > 0) < 140
    assert all(STRETCH[0] <= factor <= STRETCH[1] for one in worlds for factor in one.stretch)
    quadrants = np.bincount([int(one.heading_deg // 90) for one in worlds])
    assert quadrants.min() > 25
    assert world(7, 2).stretch == world(7, 3).stretch[:2]
