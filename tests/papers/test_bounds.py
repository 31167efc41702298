"""The test that is told of a fault, against simulated ones."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import norm

from testbed.papers.bounds import told_test
from testbed.papers.zhou2025.replays import STEEP, clairvoyant

P = 1e-3


def test_a_constant_fault_is_found_when_its_evidence_is_there() -> None:
    """After n samples of a sigma: d = sqrt(n) against the quantile of n P."""
    first, share = told_test(np.ones(60), P)
    n = next(n for n in range(1, 61) if math.sqrt(n) >= norm.isf(n * P))
    assert first == n - 1
    assert share == pytest.approx(np.mean(norm.sf(norm.isf(P) - np.sqrt(np.arange(1, 61)))))


def test_what_is_too_small_is_never_found() -> None:
    assert told_test(np.full(10, 0.01), P)[0] == math.inf


@pytest.mark.ci
def test_the_matched_filter_alarms_as_often_as_computed() -> None:
    """20 000 ramps: share of alarms of the correlation with the ramp, by the limit of P at each sample."""
    random = np.random.default_rng(3)
    added = STEEP * np.arange(200) / 5
    gathered = np.cumsum(added * (random.standard_normal((20_000, len(added))) + added), axis=1)
    weight = np.maximum(np.sqrt(np.cumsum(added**2)), 1e-12)
    alarms = gathered / weight > norm.isf(P)
    assert alarms[:, 1:].mean() == pytest.approx(clairvoyant(5, STEEP)[1], abs=0.01)


@pytest.mark.slow
def test_no_detector_of_the_library_beats_it() -> None:
    """Neither sooner in the median nor for more of the fault, at the same false alarms."""
    from testbed.papers.zhou2025 import replays

    drawn = [replays.replay(seed) for seed in range(9_000_000, 9_000_012)]
    found = replays.Found(drawn)
    delay, coverage = clairvoyant(5, STEEP)
    for name in (replays.COMPLETE, replays.FADING, replays.GLR):
        assert np.median(found.soft(replays.Case(name), "delay")) > delay
        assert found.soft(replays.Case(name), "coverage").mean() < coverage
