"""Differences between runs: what is held against what, and what chance says."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest

from testbed.score.differences import Case, Side, differences, sides

METRIC = "position_horizontal_rms_m"


def case(name: str, values: dict[int, float], estimators: tuple[str, ...] = ("ins",)) -> Case:
    runs = [(seed, {f"{one}.{METRIC}": value for one in estimators}) for seed, value in values.items()]
    return Case(name, estimators, runs)


def held(one: Case, two: Case) -> list[str]:
    return [f"{second} < {first}" for first, second in sides([one, two])]


def test_estimators_of_one_name_are_held_against_each_other() -> None:
    one, two = case("a", {1: 1.0}, ("ins", "ahrs")), case("b", {1: 1.0}, ("other", "ins"))
    assert held(one, two) == ["b: ins < a: ins"]
    assert held(one, case("b", {1: 1.0}, ("x", "y"))) == ["b: x < a: ins", "b: y < a: ins"]
    assert [f"{second} < {first}" for first, second in sides([one])] == ["a: ahrs < a: ins"]
    assert list(sides([case("a", {1: 1.0}, ())])) == []


def test_pairs_are_judged_by_the_signed_ranks_of_their_differences() -> None:
    before = {seed: 10.0 + seed for seed in range(7)}
    after = {seed: value - 1.0 - 0.1 * seed for seed, value in before.items()}
    one, two = (Side(case(name, values), "ins") for name, values in (("before", before), ("after", after)))
    [found] = differences(one, two, [METRIC])
    assert (found.runs, found.paired, found.verdict) == (7, True, "better")
    assert found.first == pytest.approx(np.mean(list(before.values())))
    # All of one sign: of the 2^7 ways in which chance may have drawn them, this one and its opposite are as clear.
    ways = [abs(sum(s * (k + 1) for k, s in enumerate(signs))) for signs in product((-1, 1), repeat=7)]
    assert found.p == pytest.approx(np.mean(np.array(ways) >= 28))
    assert found.significant


def test_seeds_that_only_one_side_has_are_no_pairs() -> None:
    one, two = Side(case("a", {1: 1.0, 2: 2.0, 3: 9.0}), "ins"), Side(case("b", {2: 2.5, 1: 1.5, 7: 99.0}), "ins")
    [found] = differences(one, two, [METRIC])
    assert (found.first, found.second, found.runs) == (1.5, 2.0, 2)


def test_without_a_common_seed_all_runs_are_ranked() -> None:
    one, two = case("a", {k: 1.0 + k for k in range(4)}), case("b", {10 + k: 9.0 + k for k in range(4)})
    [found] = differences(Side(one, "ins"), Side(two, "ins"), [METRIC])
    assert not found.paired
    assert found.verdict == "worse"
    assert found.p == pytest.approx(2 / math.comb(8, 4))


@pytest.mark.parametrize(("before", "after"), [({1: 2.0}, {1: 1.0}), ({1: 2.0, 2: 3.0}, {1: 2.0, 2: 3.0})])
def test_one_pair_or_no_difference_says_nothing(before: dict[int, float], after: dict[int, float]) -> None:
    [found] = differences(Side(case("a", before), "ins"), Side(case("b", after), "ins"), [METRIC])
    assert math.isnan(found.p)
    assert not found.significant


def test_who_is_not_scored_on_the_whole_run_is_neither_better_nor_worse() -> None:
    """Of a filter that died after 15 of 90 s the smaller error is of 15 s."""
    whole, dead = case("a", dict.fromkeys(range(7), 2.0)), case("b", dict.fromkeys(range(7), 1.0))
    lost = Case("b", ("ins",), [(seed, {**own, "ins.nonfinite_samples": 75.0}) for seed, own in dead.runs])
    ended = Case("b", ("ins",), dead.runs, {"ins": "RuntimeError: lost"})
    assert [one.verdict for one in differences(Side(whole, "ins"), Side(dead, "ins"), [METRIC])] == ["better"]
    for case_, why in ((lost, "b: ins gave 525 estimates"), (ended, "b: ins has ended: RuntimeError: lost")):
        for first, second in ((whole, case_), (case_, whole)):
            (found,) = differences(Side(first, "ins"), Side(second, "ins"), [METRIC])
            assert (found.verdict, found.significant) == ("none", False)
        assert Side(case_, "ins").lacking.startswith(why)


def test_a_filter_without_a_difference_is_found_different_in_a_twentieth_of_trials() -> None:
    rng = np.random.default_rng(1)
    found = []
    for _ in range(200):
        noise = rng.gamma(3.0, size=(2, 8))
        one, two = (Side(case(name, dict(enumerate(own))), "ins") for name, own in zip("ab", noise, strict=True))
        found += differences(one, two, [METRIC])
    assert np.mean([one.significant for one in found]) < 0.05 + 3 * math.sqrt(0.05 * 0.95 / 200)
