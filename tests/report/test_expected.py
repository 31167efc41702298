"""How runs keep what a scenario expects: what counts as kept where a run, or an estimator of it, is no good."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from testbed.errors import UserError
from testbed.many import campaign as campaigns
from testbed.many.campaign import CampaignResult, Combination, Failure, Outcome
from testbed.report.campaign import Statistics
from testbed.report.expected import kept
from testbed.scenario.schema import Bounds

RMS, LOST = "mine.position_horizontal_rms_m", "mine.nonfinite_samples"


def shares(expect: Mapping[str, Bounds], *runs: Mapping[str, float], failed: int = 0) -> dict[str, float]:
    """The share of runs that keep each bound, of runs with these metrics and some that failed."""
    scenario: Any = SimpleNamespace(expect=expect)
    outcomes = [Outcome(0, seed, metrics, {}) for seed, metrics in enumerate(runs)]
    failures = [Failure(0, 100 + seed, "lost") for seed in range(failed)]
    return {one.metric: one.share.value for one in kept([Combination({}, scenario)], outcomes, failures)}


def test_who_gives_no_numbers_keeps_nothing() -> None:
    """An estimator that is NaN whenever it is bad was the better for it."""
    expect = {RMS: Bounds(max=5.0)}
    assert shares(expect, {RMS: 1.0}, {RMS: 1.0, LOST: 49.0}) == {RMS: 0.5}
    # unless so many are expected
    assert shares(expect | {LOST: Bounds(max=50.0)}, {RMS: 1.0}, {RMS: 1.0, LOST: 49.0}) == {RMS: 1.0, LOST: 1.0}
    assert shares(expect | {LOST: Bounds(max=0.0)}, {RMS: 1.0}, {RMS: 1.0, LOST: 49.0}) == {RMS: 0.5, LOST: 0.5}


def test_no_estimates_lost_is_none() -> None:
    """The guard against such was judged backwards: who lost none has no such metric, and it was said to be missing."""
    expect = {LOST: Bounds(max=0.0)}
    assert shares(expect, {RMS: 1.0}, {RMS: 1.0, LOST: 3.0}) == {LOST: 0.5}


def test_a_run_that_failed_keeps_nothing() -> None:
    assert shares({RMS: Bounds(max=5.0)}, {RMS: 1.0}, {RMS: 1.0}, failed=2) == {RMS: 0.5}
    assert shares({RMS: Bounds(max=5.0)}, failed=2) == {RMS: 0.0}


def test_how_long_runs_took_is_not_judged() -> None:
    assert shares({"run.wall_s": Bounds(max=1000.0)}, {RMS: 1.0}) == {}


def test_whose_estimates_are_no_numbers_is_told() -> None:
    outcomes = [Outcome(0, seed, {LOST: float(seed % 2)}, {}) for seed in range(4)]
    scenario: Any = SimpleNamespace(expect={})
    result = CampaignResult(Path("out"), [Combination({}, scenario)], outcomes, [], Statistics([], []))
    assert result.spoilt() == ["mine gave estimates that are no numbers in 2 runs, the first of seed 1"]


@pytest.mark.parametrize(
    ("vary", "said"),
    [
        ({"estimator[0].name": ["'a'", "'b'"]}, "they are compared by their names"),
        ({"record.rate_hz": ["10", "2.5"]}, "runs whose records have other rows"),
    ],
)
def test_what_can_not_be_compared_is_not_flown(vary: dict[str, list[str]], said: str, tmp_path: Path) -> None:
    """It was, and the statistics ended in a KeyError, or put runs on the times of another."""
    plan = campaigns.Plan("u_turn", 1, tmp_path, vary, ["expect={}"])
    with pytest.raises(UserError, match=said):
        campaigns.fly(plan)
