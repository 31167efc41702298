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
from testbed.papers.misprints import weights_by_sum
from testbed.papers.zhou2025 import PAPER, fusion, replays
from testbed.papers.zhou2025.fusion import (
    ALONE,
    CASES,
    CROSS,
    FKF,
    GLR,
    HEALTHY,
    IMPROVED,
    LITERAL,
    PRINTED,
    STEEP,
    TOLD,
)
from testbed.papers.zhou2025.replays import COMPLETE, FADING, Case, Hard, Replayed, Soft


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
    running = {name: fusion.built(scenario, 1, name) for name in (FKF, IMPROVED, GLR, ALONE, LITERAL)}
    filters = {name: one.horizon.estimator for name, one in running.items()}
    for name, one in filters.items():
        assert isinstance(one, Federated)
        assert one.config.structure == "full_reset"
        assert one.config.shares == pytest.approx([0.5, 0.5])
        assert one.config.weighting == ("none" if name in (FKF, ALONE) else "normalised")
        assert one.config.normalise is (weights_by_sum if name == LITERAL else normalised_weights)
        assert one.config.imu.gyro_noise == pytest.approx(math.radians(5) / 60)
        assert one.config.imu.accel_noise == pytest.approx(60e-6 * 9.80665, rel=1e-3)
        assert one.config.imu.accel_bias_sigma == pytest.approx(15e-6 * 9.80665)
    step, ramp = ([f for f in scenario.fault if f.kind == kind] for kind in ("step", "ramp"))
    assert [(f.channel, f.size, f.window) for f in step] == [("north", 5, (40, 60)), ("east", 5, (40, 60))]
    assert [(f.channel, f.slope, f.window) for f in ramp] == [("north", 0.02, (90, 130)), ("east", 0.02, (90, 130))]
    noise = [f.factor for f in scenario.fault if f.kind == "noise"]
    assert noise == pytest.approx([math.sqrt(1.1)] * 7, rel=1e-4)
    crossed = fusion.built(scenario, 1, CROSS).horizon.estimator
    assert isinstance(crossed, Federated)
    assert crossed.config.cross_check
    assert crossed.config.structure == "no_reset"
    steep = papers.scenario("zhou2025", CASES[STEEP])
    assert [f.slope for f in steep.fault if f.kind == "ramp"] == [0.1, 0.1]


def test_residuals_are_what_a_perfect_filter_has() -> None:
    t, r = replays.residuals(10, 3, 2, 20_000.0)
    healthy = ~replays.during(t, replays.STEP)
    assert abs(r[healthy].mean()) < 5 / math.sqrt(2 * healthy.sum())
    assert r[healthy].std() == pytest.approx(1.0, abs=0.01)
    assert r[~healthy].mean() == pytest.approx(5.0, abs=5 / math.sqrt(400))
    assert not np.array_equal(r[:900], replays.residuals(10, 4, 2)[1][:900])
    ramp = replays.ramp(t, 0.02)
    assert ramp[np.isclose(t, 110)] == pytest.approx(0.4)
    assert ramp.max() < 0.8
    assert not ramp[t >= 130].any()


@pytest.mark.ci
def test_a_replay_scores_every_case() -> None:
    found = replays.replay(4)
    assert set(found) == set(replays.CASES)
    assert all(len(one.hard) == replays.BATCH for one in found.values())
    assert min(hard.coverage for hard in found[Case(COMPLETE)].hard) > 0.8
    lags = [[hard.end_lag for hard in found[Case(name)].hard] for name in (FADING, COMPLETE)]
    assert min(lags[0]) > 4 > 1 > max(lags[1])


@pytest.fixture(scope="module")
def flown() -> dict[str, dict[str, fusion.Flown]]:
    return fusion.fly(2, True)


@pytest.mark.ci
def test_the_improved_fusion_does_not_follow_the_faults(flown: dict[str, dict[str, fusion.Flown]]) -> None:
    """One draw; over all of them the ratios are the claims."""
    faulty = flown[PRINTED]
    assert set(faulty) == {FKF, IMPROVED, GLR, ALONE, TOLD}
    assert (faulty[IMPROVED].rmse < 0.7 * faulty[FKF].rmse).all()
    assert faulty[IMPROVED].delay[0] <= 3
    assert math.isinf(faulty[FKF].delay[0])
    error = faulty[FKF].error
    assert len(error) == pytest.approx(216 * fusion.RECORD_HZ, abs=2)
    assert np.sqrt(np.mean(error**2, axis=0)) == pytest.approx(faulty[FKF].rmse)
    assert (flown[STEEP][TOLD].rmse < 0.6 * flown[STEEP][FKF].rmse).all()
    assert flown[STEEP][TOLD].rmse == pytest.approx(faulty[TOLD].rmse, rel=1e-6)  # what it left out was another fault
    healthy = flown[HEALTHY]
    assert healthy[FKF].refused[0] == 0
    assert healthy[LITERAL].sigma > 1.2 * healthy[FKF].sigma


def test_no_heading_is_chosen() -> None:
    sides = {(here.lat_deg, here.heading_deg) for here in (fusion.world(seed, 1) for seed in range(20))}
    assert len(sides) == 20


def missed(results: Any) -> set[str]:
    return {claim.quantity for claim in PAPER.conclude(results) if claim.verdict == "missed"}


@pytest.mark.ci
def test_claims_hold_and_fail_as_the_figures_do(flown: dict[str, dict[str, fusion.Flown]], tmp_path: Path) -> None:
    """Judged over a hundred times the same, so that every interval is as narrow as it can be."""
    replayed = replays.replay(4)
    PAPER.draw([flown, replayed], tmp_path)
    assert (tmp_path / "zhou2025.png").read_bytes().startswith(b"\x89PNG")
    before = missed([flown] * 100 + [replayed] * 100)

    worse = flown | {PRINTED: flown[PRINTED] | {IMPROVED: flown[PRINTED][IMPROVED]._replace(rmse=np.array([9.0, 9.0]))}}
    worse |= {HEALTHY: flown[HEALTHY] | {GLR: flown[HEALTHY][GLR]._replace(rmse=2 * flown[HEALTHY][FKF].rmse)}}
    lost = missed([worse] * 100 + [replayed] * 100)
    assert len(lost) > len(before)
    for side in ("north", "east"):
        assert f"{side} RMSE over the traditional, {PRINTED}, SPRT" in lost
        assert f"{side} RMSE, {PRINTED}, SPRT" in lost
        assert f"{side} RMSE over that of traditional, {HEALTHY}, likelihood ratio" in lost

    late = Replayed(
        [Hard(9.0, 200.0, 2.0, 0.9, 5.0, 0.5, 1.0)] * 3, {0.02: [Soft(*[30.0] * 5)] * 3, 0.1: [Soft(*[30.0] * 5)] * 3}
    )
    lost = missed([flown] * 100 + [replayed | {Case(COMPLETE): late}] * 100) - before
    assert {name.removeprefix(f"hard fault at 5 Hz, {COMPLETE}: ") for name in lost} >= {"delay", "end lag"}
    assert f"alarms before the faults at 5 Hz, {COMPLETE}" in lost
