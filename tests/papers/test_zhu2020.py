"""Zhu et al. 2020: inflation as a scenario's policy, the river run, and claims that can be missed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2
from worlds.lanes import lanes

from nav.detection import Never
from testbed.errors import UserError
from testbed.loop.loop import run
from testbed.papers import scenario
from testbed.papers.flights import Sensed
from testbed.papers.misprints import weights_eq13, weights_eq13_in_degrees
from testbed.papers.zhu2020 import claims, figure, flight
from testbed.papers.zhu2020.claims import HEADING, P_E, P_N, V_E, V_N
from testbed.papers.zhu2020.flight import (
    AST,
    DVL,
    EQ13,
    EQ13_DEGREES,
    FRKF,
    FRKF_ALONE,
    SHARED,
    SHARED_ALONE,
    TFKF,
    TFKF_ALONE,
    Draw,
    Flown,
)
from testbed.scenario import Scenario
from testbed.score.claims import Verdict

SHORT = ("duration_s=320", "expect={}")


@pytest.mark.parametrize("name", ["zhu2020", "zhu2020_outage"])
def test_scenarios_are_sound(name: str) -> None:
    chosen = scenario(name)
    assert chosen.expect
    assert "frkf" in lanes(chosen, 1)


def test_equation_13_is_flown_beside_the_outage() -> None:
    chosen = flight.placed("zhu2020_outage", 1)
    found = lanes(chosen, 1) | flight.others(chosen, 1)
    told = {name: lane.horizon.estimator.config for name, lane in found.items()}
    for name, weigh in ((EQ13, weights_eq13), (EQ13_DEGREES, weights_eq13_in_degrees)):
        assert (told[name].weigh, told[name].combination, told[name].sharing) == (weigh, "scalar", "none")
        assert told[name].locals[0].sensors[0].aid == told[FRKF_ALONE].locals[0].sensors[0].aid
    assert [(told[name].structure, told[name].sharing) for name in (SHARED, SHARED_ALONE)] == [
        ("full_reset", "by_covariance"),
        ("no_reset", "by_covariance"),
    ]


def test_equation_13_in_its_units_by_the_formula() -> None:
    """Of diagonal covariances it is the root of the sum of sigma^-8 in these units, without the vertical."""
    random = np.random.default_rng(1)
    sigma = np.repeat([1e-4, 0.01, 10.0, 5e-8, 3e-4], 3) * random.uniform(0.5, 2.0, (2, 15))  # as `nav` has them
    level = [0, 1, 2, 3, 4, 6, 7, *range(9, 15)]
    units = np.array([57.29578] * 3 + [1.0] * 4 + [206264.8] * 3 + [1e6 / 9.80665] * 3)
    norms = np.sqrt(np.sum((sigma[:, level] * units) ** -8.0, axis=1))
    P = np.stack([np.diag(s**2) for s in sigma])
    np.testing.assert_allclose(weights_eq13_in_degrees(P, 15, np.ones(2)), norms / norms.sum(), rtol=1e-4)


def test_each_draw_has_a_river_of_its_own() -> None:
    first, second = (flight.placed("zhu2020", seed) for seed in (1, 2))
    assert first.site().lat != second.site().lat
    assert first.truth.segments != second.truth.segments  # type: ignore[union-attr]


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
    chosen = scenario("zhu2020", (*SHORT, f"truth.rate_hz={flight.RATE_HZ}", f"sensors.imu.rate_hz={flight.RATE_HZ}"))
    flown = flight.navigate(chosen, 3, lanes(chosen, 3), 320.0)
    assert set(flown) == {FRKF, TFKF, FRKF_ALONE, TFKF_ALONE}
    for robust, plain in ((flown[FRKF], flown[TFKF]), (flown[FRKF_ALONE], flown[TFKF_ALONE])):
        assert robust.error.shape == (32, 9)
        assert robust.step.shape == (2, 9)
        assert robust.step.max() < 1.0
        assert plain.step.max() > 5.0
        assert np.abs(robust.error[30:, :2]).max() < 20.0
        assert np.abs(plain.error[30:, :2]).max() > 20.0


def test_samples_are_cut_where_the_flight_ends() -> None:
    chosen = flight.placed("zhu2020", 1, "duration_s=320", "expect={}")
    sensed = Sensed.of(chosen, 1).between(-np.inf, 100.0)
    assert sensed.samples["imu"].t[-1] == pytest.approx(100.0)
    assert max(sample.t for sample in sensed.samples["ast"]) <= 100.0


def made(position: float, velocity: float, step: float = 0.1) -> Flown:
    """Errors that oscillate with these standard deviations."""
    t = np.arange(10.0, 3601.0, 10.0)
    error = np.zeros((len(t), 9))
    wave = np.sqrt(2) * np.cos(t * np.pi / 360)
    error[:, [P_N, P_E]] = position * wave[:, None]
    error[:, [V_N, V_E]] = velocity * wave[:, None]
    error[:, HEADING] = 1e-3 * wave
    return Flown(t, error, np.full((23, 9), step))


def draws() -> list[Any]:
    """As good as it could be, of a hundred draws."""
    good, plain = made(2, 0.01), made(10, 0.05, step=10.0)
    river = {FRKF: good, TFKF: plain, FRKF_ALONE: good, TFKF_ALONE: plain}
    outage = dict.fromkeys((FRKF, FRKF_ALONE, DVL, SHARED, SHARED_ALONE, EQ13_DEGREES), made(5, 0.01))
    outage |= {AST: made(150, 0.5), EQ13: made(30, 0.2)}
    weight = {"traces": 0.01, EQ13: 0.3, EQ13_DEGREES: 0.01}
    solved = {"newton": 16, "reciprocal": 5, "off": 1e-7, "near": 100}
    return [*([Draw(river, outage, {FRKF: good, TFKF: good}, weight)] * 100), solved]


def verdicts(found: list[Any]) -> dict[str, Verdict]:
    return {claim.quantity: claim.verdict for claim in claims.conclude(found)}


def test_claims_of_a_good_campaign() -> None:
    found = verdicts(draws())
    assert {quantity for quantity, verdict in found.items() if verdict in (Verdict.MISSED, Verdict.OPEN)} == set()
    printed = [quantity for quantity, verdict in found.items() if verdict is Verdict.MISPRINT]
    assert len(printed) == 4
    assert all("quation 1" in quantity for quantity in printed)


@pytest.mark.ci
@pytest.mark.parametrize(
    ("run", "estimator", "worse", "quantity"),
    [
        ("river", FRKF_ALONE, made(5, 0.01), "no feedback, the whole run: std of latitude, robust over traditional"),
        ("river", FRKF_ALONE, made(2, 0.04), "no feedback, its first 600 s: std of v_E, robust over traditional"),
        ("river", FRKF, made(2, 0.04), "with feedback, without its first 600 s: std of v_N, robust over traditional"),
        ("river", FRKF_ALONE, made(2, 0.01, step=1.5), "no feedback: largest step at a wrong fix, any state, robust"),
        ("outage", FRKF_ALONE, made(20, 0.01), "1000 s of outage, no feedback: largest error of latitude"),
        ("outage", AST, made(20, 0.01), "error of the transponder's filter alone at the end of it"),
        ("outage", FRKF, made(20, 0.01), "1000 s of outage, with feedback: largest error of longitude"),
        ("clean", FRKF, made(2.1, 0.01), "sound Gaussian data: RMS of position, loss by inflation"),
    ],
)  # fmt: skip
def test_claims_can_be_missed(run: str, estimator: str, worse: Flown, quantity: str) -> None:
    *good, solved = draws()
    worse_draw = good[0]._replace(**{run: getattr(good[0], run) | {estimator: worse}})
    assert verdicts([*good, solved])[quantity] is Verdict.MET
    assert verdicts([*([worse_draw] * 100), solved])[quantity] is Verdict.MISSED


@pytest.mark.ci
def test_the_figure_is_drawn(tmp_path: Path) -> None:
    figure.draw(draws()[0], tmp_path)
    assert (tmp_path / "zhu2020.png").stat().st_size > 20_000


def test_the_printed_solver_fails_where_the_right_ones_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flight, "CASES", 300)
    solved = flight.solve(2)
    assert solved["newton"] <= 17
    assert solved["reciprocal"] <= 5
    assert solved["off"] <= 1e-5
    assert solved["near"] < 0.08 * 300


@pytest.mark.slow
def test_one_draw_is_flown(tmp_path: Path) -> None:
    draw = flight.fly(1)
    assert set(draw.river) >= {FRKF, TFKF, FRKF_ALONE, TFKF_ALONE}
    assert set(draw.outage) >= {FRKF_ALONE, DVL, AST, EQ13, EQ13_DEGREES, SHARED, SHARED_ALONE}
    assert draw.outage[AST].t[-1] == 2500.0
    assert draw.weight["traces"] < 0.05 < draw.weight[EQ13]
    assert len(claims.conclude([draw, flight.solve(1)])) > 40
