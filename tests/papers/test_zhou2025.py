"""Zhou et al. 2025: the scenario, the detectors on residuals, the fusion on the circuit, and the claims."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import pytest

from nav.federated import Federated
from nav.weighting import normalised_weights
from testbed import papers
from testbed.feeds.simulated import motion
from testbed.papers import zhou2025
from testbed.papers.misprints import weights_by_sum
from testbed.papers.zhou2025 import (
    CASES,
    COMPLETE,
    FADING,
    FKF,
    GLR,
    HEALTHY,
    LABELS,
    PAPER,
    PRINTED,
    STEEP,
    Hard,
    Soft,
)


def test_the_circuit_is_nearly_closed() -> None:
    rows = motion(papers.scenario("zhou2025"), 1).advance(216 * 250 + 1)
    start = math.degrees(rows.lat[0]), math.degrees(rows.lon[0]), float(rows.h[0])
    north, east, _ = pymap3d.geodetic2ned(np.degrees(rows.lat), np.degrees(rows.lon), rows.h, *start)
    assert math.hypot(north[-1], east[-1]) < 30
    assert np.hypot(north, east).max() > 300
    assert np.linalg.norm(rows.v_n[-1]) < 1.0  # it comes to rest
    assert rows.t[np.linalg.norm(rows.v_n, axis=1) > 0][0] == pytest.approx(10, abs=0.01)


def test_the_scenario_is_that_of_the_tables() -> None:
    scenario = papers.scenario("zhou2025")
    running = zhou2025.build(zhou2025.chosen(list(LABELS)).estimator, scenario.rig(1))
    filters = {name: one.horizon.estimator for name, one in running.items()}
    assert list(filters) == list(LABELS)
    for name, one in filters.items():
        assert isinstance(one, Federated)
        assert one.config.structure == "full_reset"
        assert one.config.shares == pytest.approx([0.5, 0.5])
        assert one.config.weighting == ("none" if name == FKF else "normalised")
        assert one.config.normalise is (weights_by_sum if name == zhou2025.LITERAL else normalised_weights)
        assert one.config.imu.gyro_noise == pytest.approx(math.radians(5) / 60)
        assert one.config.imu.accel_noise == pytest.approx(60e-6 * 9.80665, rel=1e-3)
        assert one.config.imu.accel_bias_sigma == pytest.approx(15e-6 * 9.80665)
    step, ramp = ([f for f in scenario.fault if f.kind == kind] for kind in ("step", "ramp"))
    assert [(f.channel, f.size, f.window) for f in step] == [("north", 5, (40, 60)), ("east", 5, (40, 60))]
    assert [(f.channel, f.slope, f.window) for f in ramp] == [("north", 0.02, (90, 130)), ("east", 0.02, (90, 130))]
    noise = [f.factor for f in scenario.fault if f.kind == "noise"]
    assert noise == pytest.approx([math.sqrt(1.1)] * 7, rel=1e-4)
    steep = papers.scenario("zhou2025", CASES[STEEP])
    assert [f.slope for f in steep.fault if f.kind == "ramp"] == [0.1, 0.1]
    assert not papers.scenario("zhou2025", CASES[HEALTHY]).fault


def test_residuals_are_what_a_perfect_filter_has() -> None:
    t, r = zhou2025.residuals(10, 3, 20_000.0)
    healthy = ~zhou2025.during(t, zhou2025.STEP)
    assert abs(r[healthy].mean()) < 5 / math.sqrt(healthy.sum())
    assert r[healthy].std() == pytest.approx(1.0, abs=0.01)
    assert r[~healthy].mean() == pytest.approx(5.0, abs=5 / math.sqrt(200))
    assert not np.array_equal(r[:900], zhou2025.residuals(10, 4)[1][:900])
    ramp = zhou2025.ramp(t, 0.02)
    assert ramp[np.isclose(t, 110)] == pytest.approx(0.4)
    assert ramp.max() < 0.8
    assert not ramp[t >= 130].any()


def test_a_replay_scores_each_seed_by_itself() -> None:
    both = zhou2025.replay(COMPLETE, 5, 1, 2)
    second = zhou2025.replay(COMPLETE, 5, 2, 1)
    assert both["hard"][1] == second["hard"][0]
    assert both["soft"][0.1][1] == second["soft"][0.1][0]
    assert both["hard"][0].coverage > 0.8
    fading = zhou2025.replay(FADING, 5, 1, 2)
    assert min(h.end_lag for h in fading["hard"]) > 4 > 1 > max(h.end_lag for h in both["hard"])


@pytest.mark.ci
def test_the_improved_fusion_does_not_follow_the_faults() -> None:
    """One run as the campaign's; over all seeds the ratios are the claims."""
    found = zhou2025.fly(PRINTED, 1)
    for axis in (0, 1):
        assert found["rmse"]["improved"][axis] < 0.6 * found["rmse"][FKF][axis]
    errors = np.array(found["errors"][FKF])
    assert len(errors) == pytest.approx(216 * zhou2025.RECORD_HZ, abs=2)
    assert np.sqrt(np.mean(errors**2, axis=0)) == pytest.approx(found["rmse"][FKF])


def made_up() -> list[Any]:
    """Results of every job with good figures, whatever was measured."""
    good_hard = {
        FADING: Hard(0.0, 0.5, 0.97, 7.5, 0.25, 0.4),
        zhou2025.FAST: Hard(0.0, 0.5, 0.94, 0.0, 0.0, -50.0),
        zhou2025.FAST_EQ20: Hard(0.0, 1.4, 0.93, 0.0, 0.0, -150.0),
        zhou2025.FADING_EQ20: Hard(0.0, 1.4, 0.93, 20.0, 1.0, 20.0),
        zhou2025.COMPLETE_EQ20: Hard(0.0, 1.3, 0.9, 0.0, 0.0, 0.0),
    }
    sooner = {zhou2025.FAST_EQ20: 30.0, zhou2025.COMPLETE_EQ20: 14.0, zhou2025.COMPLETE_CHI2: 8.0, GLR: 9.9}
    chatters = {COMPLETE: 20.0, zhou2025.COMPLETE_CHI2: 18.0, zhou2025.CHI2: 34.0}
    wrong = {GLR: 11.0, COMPLETE: 20.0, zhou2025.COMPLETE_EQ20: 19.0}
    results: list[Any] = []
    for case, seeds in zhou2025.SEEDS.items():
        for seed in range(1, seeds + 1):
            own = {FKF: 2.0, "improved": 0.9, "glr": 0.9, "literal": 1.1}
            if case == HEALTHY:
                own = {FKF: 0.35, "improved": 0.352, "glr": 0.353, "literal": 0.37}
            sigma = {name: 0.45 if name == "literal" else 0.35 for name in LABELS}
            errors = {name: [[0.0, 0.0], [1.0, 1.0]] if seed == 1 else [] for name in LABELS}
            rmse = {name: [value, value] for name, value in own.items()}
            results.append({"case": case, "seed": seed, "rmse": rmse, "sigma": sigma, "errors": errors})
    for rate in zhou2025.RATES:
        for name in zhou2025.BUILD if rate == zhou2025.MAIN_RATE else zhou2025.MAIN:
            hard = good_hard.get(name, Hard(0.0, 0.1, 0.99, 0.0, 0.0, 0.0))
            soft = Soft(sooner.get(name, 11.2), chatters.get(name, 11.3), 0.75, 0.1, wrong.get(name, 24.0))
            low = Soft(28.0, 28.0, 0.26, 0.1, 30.0)
            results.append({"detector": name, "rate": rate, "hard": [hard], "soft": {0.02: [low], 0.1: [soft]}})
    return results


def missed(results: list[Any]) -> set[str]:
    return {claim.quantity for claim in PAPER.conclude(results) if claim.verdict == "missed"}


def replays(results: list[Any], name: str) -> list[dict[str, Any]]:
    return [r for r in results if r.get("detector") == name and r["rate"] == zhou2025.MAIN_RATE]


@pytest.mark.ci
def test_claims_hold_and_fail_as_the_figures_do(tmp_path: Path) -> None:
    assert not missed(made_up())
    PAPER.draw(made_up(), tmp_path)
    assert (tmp_path / "zhou2025.png").read_bytes().startswith(b"\x89PNG")

    results = made_up()
    replays(results, GLR)[0]["hard"] = [Hard(2e-3, 1.3, 0.99, 0.3, 0.02, 0.0)]
    replays(results, GLR)[0]["soft"] = {
        0.02: [Soft(20.0, 20.0, 0.2, 0.1, 30.0)], 0.1: [Soft(12.0, 21.0, 0.7, 0.1, 20.5)],
    }  # fmt: skip
    assert {quantity.partition(f"{GLR}")[2] for quantity in missed(results)} == {
        "", ": delay", ": end lag", ": coverage", " before fading by", f" before {COMPLETE} by",
        f" before {COMPLETE} (sustained) by", f" before {zhou2025.COMPLETE_CHI2} (sustained) by",
        " less than any other by",
        ": delay over that of the expected evidence, 31.1 s",
    }  # fmt: skip

    results = made_up()
    for r in replays(results, COMPLETE):
        r["soft"][0.1] = [Soft(25.0, 25.0, 0.3, 0.1, 25.0)]
    assert len(missed(results)) == 4  # coverage, before fading, before the fast reset, time judged wrongly

    results = made_up()
    for r in results:
        if r.get("case") == PRINTED:
            r["rmse"]["improved"] = [1.2, 1.4]
        if r.get("case") == HEALTHY:
            r["rmse"]["improved"] = [0.36, 0.36]
            r["rmse"]["literal"] = [0.35, 0.35]
    failed = missed(results)
    for side in ("north", "east"):
        assert f"{side} RMSE over the traditional, {PRINTED}, SPRT" in failed
        assert f"{side} RMSE over the traditional, {HEALTHY}, SPRT" in failed
        assert f"{side} RMSE over the traditional, {HEALTHY}, weights as printed" in failed


@pytest.mark.slow
def test_the_campaign(tmp_path: Path) -> None:
    claims = papers.reproduce({"zhou2025": PAPER}, tmp_path)["zhou2025"]
    for claim in claims:
        print(f"{claim.quantity}: {claim.value:.3g} ({claim.verdict})")
    assert not {claim.quantity for claim in claims if claim.verdict == "missed"}
    assert (tmp_path / "zhou2025.png").exists()
