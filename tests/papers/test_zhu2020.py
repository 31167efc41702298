"""Zhu et al. 2020: inflation as a scenario's policy, the river run, and claims that can be missed."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2
from worlds.lanes import lanes

from nav.detection import Never
from testbed import papers
from testbed.errors import UserError
from testbed.loop.loop import run
from testbed.papers import scenario, zhu2020
from testbed.papers.misprints import weights_eq13
from testbed.papers.zhu2020 import EQ13, HEADING, NO_RESET, P_E, P_N, RUNS, V_E, V_N, Flown
from testbed.scenario import Scenario

SHORT = ("duration_s=320", "expect={}")


@pytest.mark.parametrize("name", ["zhu2020", "zhu2020_outage"])
def test_scenarios_are_sound(name: str) -> None:
    chosen = scenario(name)
    assert chosen.expect
    assert "frkf" in lanes(chosen, 1)


def test_equation_13_is_flown_beside_the_outage() -> None:
    found = zhu2020.estimators(scenario("zhu2020_outage"), 1)
    told = {name: lane.horizon.estimator.config for name, lane in found.items() if name in (NO_RESET, EQ13)}
    assert (told[EQ13].weigh, told[EQ13].combination, told[EQ13].sharing) == (weights_eq13, "scalar", "none")
    assert told[EQ13].locals[0].sensors[0].aid == told[NO_RESET].locals[0].sensors[0].aid


@pytest.mark.parametrize(
    ("override", "complaint"),
    [
        ('{ kind = "deflate" }', "policy.kind"),
        ('{ kind = "inflate", false_alarm = 2.0 }', "policy.false_alarm"),
        ("{ false_alarm = 0.1 }", "policy.kind: is missing"),
    ],
)
def test_a_wrong_policy_is_answered(override: str, complaint: str) -> None:
    with pytest.raises(UserError, match="estimator") as refused:
        scenario("zhu2020", (f"estimator.frkf.locals[0].policy={override}",))
    assert complaint in str(refused.value)


def test_no_detector_has_no_false_alarms() -> None:
    with pytest.raises(UserError, match="condemns nothing"):
        scenario("zhu2020", ('estimator.frkf.locals[0].detector={ kind = "none", false_alarm = 0.1 }',))


def test_never_an_alarm() -> None:
    decision = Never().step(np.array([1e6, 0.0]), np.diag([4.0, 9.0]), 0.0)
    assert not decision.alarm
    assert decision.axis_mask.all()
    assert decision.statistic == pytest.approx(2.5e11)


def looks(chosen: Scenario) -> dict[str, tuple[np.ndarray, ...]]:
    """Times of the fixes, their squared distances, and their weights, by estimator."""
    dataset = run(chosen).dataset
    keys = ("sample_time", "nis", "weight")
    reports = {e.name: dataset[f"estimators/{e.name}/innovations/position_fix"] for e in chosen.estimator}
    return {name: tuple(report[key].values for key in keys) for name, report in reports.items()}


def test_a_wrong_fix_is_weakened_to_the_limit_and_a_sound_one_not() -> None:
    found = looks(scenario("zhu2020", (*SHORT, "duration_s=160", "fault[1].window=[155, 160]")))
    t, nis, weight = found["frkf"]
    limit = chi2.ppf(0.99, 2)
    wrong = t == 150.5
    assert nis[wrong] > 500
    assert 0 < weight[wrong] < 0.02
    sound = nis <= limit
    assert (weight[sound] == 1.0).all()
    assert (weight[~sound] < 1.0).all()
    assert (found["tfkf"][2] == 1.0).all()


def test_a_gross_error_can_be_left_out() -> None:
    keys = ("duration_s=160", "fault[1].window=[155, 160]", "estimator.frkf.locals[1].policy.reject_above=100")
    t, _, weight = looks(scenario("zhu2020", (*SHORT, *keys)))["frkf"]
    assert weight[t == 150.5] == 0.0


def test_a_wrong_fix_moves_the_robust_filter_by_less_than_a_sigma() -> None:
    flown = zhu2020.navigate(scenario("zhu2020", SHORT), 3)
    assert set(flown) == {"frkf", "tfkf"}
    robust, plain = flown["frkf"], flown["tfkf"]
    assert robust.error.shape == (321, 9)
    assert np.array_equal(robust.error[0], plain.error[0])  # the same start
    assert robust.step.shape == (2, 9)
    assert robust.step.max() < 1.0
    assert plain.step.max() > 5.0
    assert np.abs(robust.error[301:, :2]).max() < 15.0
    assert np.abs(plain.error[301:, :2]).max() > 20.0


def flown(position: float, velocity: float, step: float = 0.1, by_trace: float = 0.01, by_eq13: float = 0.3) -> Flown:
    """Errors that oscillate with these standard deviations."""
    error = np.zeros((3601, 9))
    wave = np.sqrt(2) * np.cos(np.arange(3601) * np.pi / 360)
    error[:, [P_N, P_E]] = position * wave[:, None]
    error[:, [V_N, V_E]] = velocity * wave[:, None]
    error[:, HEADING] = 1e-3 * wave
    blocks = np.ones(361)
    return Flown(error, np.full((23, 9), step), by_trace * blocks, by_eq13 * blocks)


def results() -> list[Any]:
    """As good as it could be, of two seeds."""
    river = {"frkf": flown(2, 0.01), "tfkf": flown(10, 0.05, step=10.0)}
    clean = {"frkf": flown(2, 0.01), "tfkf": flown(2, 0.01)}
    outage = {
        "frkf": flown(2, 0.01), "frkf_no_reset": flown(5, 0.01), "rkf_dvl": flown(20, 0.02),
        "rkf_ast": flown(100, 0.5), "eq13": flown(30, 0.2),
    }  # fmt: skip
    solved = {"newton": 16, "reciprocal": 5, "off": 1e-7, "near": 3.0}
    of = {"outage": outage, "1 Hz": river, "clean": clean, "30 s": river}
    return [*(copy.deepcopy(of[run]) for run in RUNS for _ in range(2)), solved]


def missed(found: list[Any]) -> list[str]:
    return [claim.quantity for claim in zhu2020.conclude(found) if claim.verdict == "missed"]


def test_claims_of_a_good_campaign() -> None:
    assert not missed(results())
    verdicts = [claim.verdict for claim in zhu2020.conclude(results())]
    assert verdicts.count("impossible") == 3
    assert "beaten" in verdicts


@pytest.mark.parametrize(
    ("run", "estimator", "worse", "quantity"),
    [
        ("30 s", "frkf", flown(5, 0.01), "log every 30 s: std of latitude, robust over traditional"),
        ("30 s", "frkf", flown(2, 0.04), "log every 30 s: std of v_E, robust over traditional"),
        ("1 Hz", "frkf", flown(2, 0.04), "log at 1 Hz: std of v_N, robust over traditional"),
        ("1 Hz", "frkf", flown(2, 0.01, step=1.5), "largest step at a wrong fix, any state, worst seed"),
        ("outage", "frkf", flown(20, 0.01), "1000 s of outage, largest error of latitude, worst seed"),
        ("outage", "rkf_ast", flown(20, 0.01), "error of the transponder's filter alone at the end of it"),
        ("outage", "eq13", flown(5, 0.01), "1000 s of outage, largest error with the weights of equation 13"),
        ("clean", "frkf", flown(2.1, 0.01), "sound Gaussian data: RMS of position, loss by inflation"),
    ],
)
def test_claims_can_be_missed(run: str, estimator: str, worse: Flown, quantity: str) -> None:
    found = results()
    first = 2 * list(RUNS).index(run)
    for seed in range(2):
        found[first + seed][estimator] = worse
    assert quantity in missed(found)


@pytest.mark.ci
def test_the_figure_is_drawn(tmp_path: Path) -> None:
    zhu2020.draw(results(), tmp_path)
    assert (tmp_path / "zhu2020.png").stat().st_size > 20_000


def test_the_printed_solver_fails_where_the_right_ones_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zhu2020, "CASES", 300)
    solved = zhu2020.solve(2)
    assert solved["newton"] <= 17
    assert solved["reciprocal"] <= 5
    assert solved["off"] <= 1e-5
    assert solved["near"] < 8


@pytest.mark.slow
def test_every_claim_holds(tmp_path: Path) -> None:
    claims = papers.reproduce({"zhu2020": zhu2020.PAPER}, tmp_path)["zhu2020"]
    assert [claim.quantity for claim in claims if claim.verdict == "missed"] == []
