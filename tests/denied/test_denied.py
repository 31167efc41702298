"""The benchmark of denied navigation: a flight is what a run flies, nothing is flown twice, statistics are honest."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner
from worlds import browser

import testbed.__main__ as cli
from testbed import Scenario, run
from testbed.data import data_dir
from testbed.denied import benchmark, flight, goals, saved
from testbed.denied.benchmark import Plan, Result, contestants
from testbed.denied.flight import Outcome
from testbed.denied.table import AIDINGS, CIRCLES, FULL, GRADES, QUICK, WEATHERS, Case, Contestant, Table
from testbed.errors import UserError
from testbed.interrupts import Interrupted
from testbed.report import denied as report
from testbed.results import REPORT
from testbed.score import accuracy, bound
from testbed.score.claims import Verdict

INS = (Contestant("ins", "ins"),)
HIGHER = CIRCLES._replace(start=CIRCLES.start.replace("280", "300"))
SMALL = Table(WEATHERS[1:2], (AIDINGS[0], AIDINGS[1]._replace(route=HIGHER)), GRADES[:1], (10, 20), draws=2, lost_s=60)
FILTERS = '''
import numpy as np
from nav.samples import Estimate

class Still:
    """It stays where the first fix was, and says that it is 1 km sure of it."""

    def __init__(self, rig):
        self.t, self.lla, self.kinds = np.nan, None, set()

    def propagate(self, imu):
        self.t = float(imu.t[-1])

    def update(self, sample):
        self.kinds.add(type(sample).__name__)
        if self.lla is None and hasattr(sample, "v_n"):
            self.lla = sample.lat, sample.lon, sample.h

    def estimate(self):
        return Estimate.of(self.t, lla=self.lla, q_nb=np.array([1.0, 0, 0, 0]), v_n=np.zeros(3),
                           covariance=np.diag([1e6] * 9)) if self.lla else Estimate.of(self.t)

class Ends(Still):
    def propagate(self, imu):
        super().propagate(imu)
        if self.t > 75:
            raise ValueError(f"knows {len(self.kinds)} kinds of samples")
'''


@pytest.fixture(scope="module")
def filters(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with estimators of somebody else."""
    folder = tmp_path_factory.mktemp("filters")
    (folder / "filters.py").write_text(FILTERS)
    return folder


@pytest.fixture(scope="module")
def entered(filters: Path) -> tuple[Contestant, ...]:
    begun = data_dir("template") / "filters.py"  # as `testbed init` writes it
    return contestants(["ins", "./filters.py:Still", "./filters.py:Ends", f"{begun}:Mine"], SMALL, filters)


@pytest.fixture(scope="module")
def cases(entered: tuple[Contestant, ...]) -> list[Case]:
    return list(SMALL.cases(SMALL.weathers[0], entered))


@pytest.fixture(scope="module")
def flown(cases: list[Case]) -> Outcome:
    """One short flight."""
    return flight.fly(cases, 7)


# --- a flight


@pytest.mark.ci
def test_a_flight_is_what_a_run_of_its_scenario_flies(flown: Outcome, cases: list[Case]) -> None:
    case = cases[1]
    result = run(Scenario.parse(case.text), seed=7)
    k = flown.lanes.index((case.aids.name, case.grade.name, "ins"))
    errors = accuracy.errors(result.dataset, "ins")
    rows = np.searchsorted(errors.t, flown.t + case.lost_s - 1e-6)
    assert flown.t.tolist() == [0, 10, 20]
    assert flown.error[k] == pytest.approx(errors.position[rows, :2], abs=1e-6)
    assert np.sqrt(flown.covariance[k][:, [0, 2]]) == pytest.approx(errors.sigma_position[rows, :2], rel=1e-5)
    least = bound.of_run(result.dataset)["ins"]
    assert flown.bound[k] == pytest.approx([least.horizontal_at(t) for t in flown.t + case.lost_s], rel=1e-6)
    assert flown.distance[k] == pytest.approx([0, 250, 500], rel=0.3)


@pytest.mark.ci
def test_estimators_of_others_are_handed_the_same(flown: Outcome) -> None:
    assert {lane[2] for lane in flown.lanes} == {"ins", "Still", "Ends", "Mine"}
    by_name = dict(zip(flown.lanes, flown.horizontal, strict=True))
    assert by_name["flow", "consumer", "Still"][-1] > 500 > 100 > by_name["flow", "consumer", "Mine"][-1]
    assert np.isfinite(by_name["flow", "consumer", "Ends"]).tolist() == [True, True, False]
    assert "ValueError: knows 4 kinds" in flown.ended["air_data/consumer/Ends"]
    assert "ValueError: knows 6 kinds" in flown.ended["flow/consumer/Ends"]
    k = flown.lanes.index(("flow", "consumer", "Still"))
    assert flown.normalised[k] == pytest.approx(by_name["flow", "consumer", "Still"] ** 2 / 1e6)


@pytest.mark.ci
def test_some_aids_are_flown_longer(flown: Outcome) -> None:
    """Then the others have nothing after their own end, and goals have a time of their own."""
    table = dataclasses.replace(SMALL, judged_longest_s={"flow": 30})
    longer = flight.fly(table.judged(INS), 7)
    shared = dataclasses.replace(table, aids=AIDINGS[:2])  # one route, but each flown for as long as it is asked
    assert np.isfinite(flight.fly(shared.judged(INS), 7).error[1]).all()
    assert longer.t.tolist() == [0, 10, 20, 30]
    for k, lane in enumerate(longer.lanes):
        same = flown.lane(lane)
        assert longer.error[k, :3] == pytest.approx(same.error[0], abs=1e-9)
        assert np.isnan(longer.error[k, 3]).all() == (lane[0] == "air_data")
    assert goals.claims(whole(2))["ins"][-2].quantity.endswith("after 1800 s")


@pytest.mark.ci
def test_what_is_stored_comes_back_as_it_was(flown: Outcome, tmp_path: Path) -> None:
    flight.store(flown, tmp_path / "one.npz")
    again = flight.stored(tmp_path / "one.npz")
    assert again is not None
    for field in dataclasses.fields(Outcome):
        before, after = getattr(flown, field.name), getattr(again, field.name)
        np.testing.assert_array_equal(after, before) if isinstance(before, np.ndarray) else None
        assert isinstance(before, np.ndarray) or after == before
    (tmp_path / "one.npz").write_bytes((tmp_path / "one.npz").read_bytes()[:-40])
    assert flight.stored(tmp_path / "one.npz") is None
    assert flight.stored(tmp_path / "none.npz") is None


def test_every_case_is_a_scenario() -> None:
    for weather in WEATHERS:
        for case in [*FULL.cases(weather, INS), *QUICK.cases(weather, INS)]:
            assert case.scenario.duration_s == case.lost_s + case.longest_s + 1
            assert case.scenario.rig(1).expected_air.wind_walk == (0.0 if weather.name == "constant" else 0.02)
            assert set(case.scenario.estimator[0].aiding(case.scenario.sensors)) == set(case.scenario.sensors) - {"imu"}


# --- flights that are made up


def made_up(weather: str, seed: int, lanes: Sequence[tuple[str, str, str]], ratio: float = 1.0) -> Outcome:
    """Errors of an efficient and honest estimator, of 10 m north and 5 m east, times a ``ratio``."""
    random = np.random.default_rng([seed, len(weather)])
    t = np.array([0.0, *FULL.marks_s])
    error = random.normal(size=(len(lanes), len(t), 2)) * [10.0, 5.0] * ratio
    covariance = np.broadcast_to([100.0, 0.0, 25.0], (len(lanes), len(t), 3))
    least = np.full(error.shape[:2], math.sqrt(125.0))
    return Outcome(weather, seed, t, tuple(lanes), error, covariance, least, np.tile(25.0 * t, (len(lanes), 1)), {})


def whole(draws: int, ratio: float = 1.0, change: Callable[[Outcome], Outcome] = lambda one: one) -> Result:
    """A made-up benchmark."""
    plan = Plan(FULL, INS, Path("nowhere"), 5, draws)
    lanes = [(case.aids.name, case.grade.name, "ins") for case in FULL.cases(WEATHERS[0], INS)]
    outcomes = [change(made_up(w.name, seed, lanes, ratio)) for w in FULL.weathers for seed in plan.seeds]
    return Result(plan, outcomes, [])


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Flights are made up, and noted here."""
    flights: list[tuple[str, int]] = []

    def fly(cases: Sequence[Case], seed: int, tell: Any) -> Outcome:
        flights.append((cases[0].weather.name, seed))
        tell(0.5)
        return made_up(
            cases[0].weather.name, seed, [(c.aids.name, c.grade.name, e.name) for c in cases for e in c.contestants]
        )

    monkeypatch.setattr(flight, "fly", fly)
    return flights


def test_what_was_interrupted_ends_as_if_it_had_not_been(
    made: list[tuple[str, int]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = dataclasses.replace(SMALL, weathers=WEATHERS, marks_s=(60, 120), draws=3)
    plans = [Plan(table, INS, tmp_path / name) for name in ("broken", "whole")]
    good = flight.fly

    def breaks(cases: Sequence[Case], seed: int, tell: Any) -> Outcome:
        if len(made) == 4:
            raise Interrupted
        return good(cases, seed, tell)

    monkeypatch.setattr(flight, "fly", breaks)
    with pytest.raises(Interrupted):
        benchmark.fly(plans[0], workers=1)
    assert [weather for weather, _ in made] == ["constant", "walking", "front", "constant"]
    monkeypatch.setattr(flight, "fly", good)
    monkeypatch.setattr(report, "figures", lambda result: {})
    told: list[tuple[float, str]] = []
    for plan in plans:
        result = benchmark.fly(plan, 1, lambda *now: told.append(now))
        report.save(result, goals.claims(result))
    assert len(made) == 9 + 9 == len(set(made[:9])) * 2
    assert (4.5 / 9, "4 of 9 flights, 4 of them before") in told
    for name in (report.SUMMARY, report.DRAWS):
        assert (plans[0].out / name).read_bytes() == (plans[1].out / name).read_bytes()
    more = dataclasses.replace(plans[0], draws=4)
    assert len(benchmark.fly(more, 1).outcomes) == 12
    assert len(made) == 9 + 9 + 3


def test_what_goals_are_set_for_has_further_draws(made: list[tuple[str, int]], tmp_path: Path) -> None:
    """They count for the goals, and for nothing else; more draws of the whole table fly theirs whole."""
    table = dataclasses.replace(FULL, aids=AIDINGS[:2], grades=GRADES[:2], marks_s=(60, 120), judged_draws=3)
    result = benchmark.fly(Plan(table, INS, tmp_path, 5, 2), 1)
    first = result.plan.seeds.start
    assert made[6:] == [("walking", first + k) for k in (2, 3, 4, 5)]
    assert [one.lanes for one in result.further] == [(("air_data", "consumer", "ins"), ("flow", "consumer", "ins"))] * 4
    assert {cell.draws for cell in report.cells(result)} == {2}
    claims = goals.claims(result)["ins"]
    assert [claim.draws for claim in claims] == [6, 6, 6, 6, 1]
    more = benchmark.fly(Plan(table, INS, tmp_path, 5, 3), 1)
    assert len(more.outcomes) == 9
    assert {len(one.lanes) for one in more.outcomes} == {4}
    assert len(more.further) == 6


def test_a_goal_after_the_last_time_of_the_table_has_the_draws_that_went_on() -> None:
    result = whole(20)
    seeds = result.plan.further
    judged = [(case.aids.name, case.grade.name, "ins") for case in FULL.judged(INS)]
    flown = [made_up("walking", seed, judged) for seed in seeds]
    hour = np.array([3600.0])
    flown = [
        dataclasses.replace(one, t=np.append(one.t, hour), **{
            name: np.concatenate([getattr(one, name), getattr(one, name)[:, -1:]], axis=1)
            for name in ("error", "covariance", "bound", "distance")
        })
        for one in flown
    ]  # fmt: skip
    found = goals.claims(dataclasses.replace(result, further=flown))["ins"]
    assert [(one.draws, one.quantity[-7:]) for one in found[-3:-1]] == [(80, " 3600 s")] * 2
    assert {one.draws for one in found[:-3]} == {100}


def test_a_folder_holds_one_benchmark(made: list[tuple[str, int]], tmp_path: Path) -> None:
    benchmark.fly(Plan(SMALL, INS, tmp_path), 1)
    with pytest.raises(UserError, match="holds a benchmark with different scenarios"):
        benchmark.fly(Plan(dataclasses.replace(SMALL, lost_s=70), INS, tmp_path), 1)
    setup = tmp_path / "setup.json"
    setup.write_text(json.dumps(json.loads(setup.read_text()) | {"code": "other"}))
    with pytest.raises(UserError, match="holds a benchmark with different code"):
        benchmark.fly(Plan(SMALL, INS, tmp_path), 1)


def test_a_class_that_was_edited_is_another(made: list[tuple[str, int]], tmp_path: Path) -> None:
    for text in (FILTERS, FILTERS.replace("1e6", "1e4")):
        (tmp_path / "filters.py").write_text(text)
        plan = Plan(SMALL, contestants(["./filters.py:Still"], SMALL, tmp_path), tmp_path / "out")
        if text == FILTERS:
            benchmark.fly(plan, 1)
    with pytest.raises(UserError, match="different estimators"):
        benchmark.fly(plan, 1)


def test_a_flight_that_fails_stops_no_other(
    made: list[tuple[str, int]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    good = flight.fly

    def breaks(cases: Sequence[Case], seed: int, tell: Any) -> Outcome:
        if seed % 2:
            raise UserError("the flight ended early: control lost")
        return good(cases, seed, tell)

    monkeypatch.setattr(flight, "fly", breaks)
    result = benchmark.fly(Plan(SMALL, INS, tmp_path), 1)
    assert [failure.message for failure in result.failures] == ["the flight ended early: control lost"]
    assert {cell.draws for cell in report.cells(result)} == {1}
    with pytest.raises(UserError, match="1 flights failed"):
        saved.save(result, [], {})
    with pytest.raises(UserError, match=r"no flight came to its end: .* control lost"):
        benchmark.fly(Plan(SMALL, INS, tmp_path / "none", draws=1, number=0), 1)


# --- statistics


@pytest.mark.slow
def test_an_efficient_and_honest_estimator_is_found_to_be_one() -> None:
    result = whole(100)
    found = report.cells(result)
    assert len(found) == len(WEATHERS) * len(AIDINGS) * len(GRADES) * 4
    efficient = [cell.efficiency.low <= 1.0 <= cell.efficiency.high for cell in found if cell.efficiency]
    honest = [cell.inside.low <= 0.95 <= cell.inside.high for cell in found if cell.inside]
    assert np.mean(efficient) > 0.88
    assert np.mean(honest) > 0.88
    # of a length with these sigmas, by 10^6 draws
    lengths = np.hypot(*(np.random.default_rng(1).normal(size=(2, 10**6)) * [[10.0], [5.0]]))
    assert np.mean([c.median.low <= np.median(lengths) <= c.median.high for c in found]) > 0.88
    assert np.mean([c.p95.low <= np.quantile(lengths, 0.95) <= c.p95.high for c in found]) > 0.88
    assert goals.below_the_bound(result, "ins") == (0, len(found))


def test_whoever_is_below_the_bound_is_caught() -> None:
    result = whole(40, ratio=0.5)
    beaten, judged = goals.below_the_bound(result, "ins")
    assert beaten == judged == len(report.cells(result))
    assert goals.claims(result)["ins"][-1].verdict is Verdict.MISSED


@pytest.mark.parametrize(
    ("draws", "ratio", "said"), [(100, 0.3, Verdict.MET), (100, 300.0, Verdict.MISSED), (2, 1.0, Verdict.OPEN)]
)
def test_goals_are_judged_by_their_intervals(draws: int, ratio: float, said: Verdict) -> None:
    *own, below = goals.claims(whole(draws, ratio))["ins"]
    assert {claim.verdict for claim in own if claim.unit} == {said}
    assert below.verdict is (Verdict.MISSED if ratio < 1 else Verdict.MET)


def test_who_gave_no_estimate_is_infinitely_far_off() -> None:
    def lost(one: Outcome) -> Outcome:
        none = np.full_like(one.error, np.nan)
        return dataclasses.replace(one, error=none, covariance=np.full_like(one.covariance, np.nan))

    result = whole(10, change=lost)
    for cell in report.cells(result):
        assert (cell.median.value, cell.inside) == (math.inf, None)
    assert {claim.verdict for claim in goals.claims(result)["ins"]} == {Verdict.MISSED}
    json.loads(json.dumps(report._json(result, report.cells(result), goals.claims(result)), allow_nan=False))


def test_without_a_bound_there_is_no_efficiency() -> None:
    result = whole(5, change=lambda one: dataclasses.replace(one, bound=np.full_like(one.bound, np.nan)))
    assert {cell.efficiency for cell in report.cells(result)} == {None}
    assert goals.below_the_bound(result, "ins") == (0, 0)


def test_the_figure_of_who_never_had_an_estimate_is_empty() -> None:
    def nothing(one: Outcome) -> Outcome:
        return dataclasses.replace(one, error=np.full_like(one.error, np.nan), bound=np.full_like(one.bound, np.nan))

    assert list(report.figures(whole(2, change=nothing))) == ["denied_ins.png"]


# --- what is written


@pytest.mark.ci
@pytest.mark.skipif(browser.program() is None, reason="there is no Chromium on this machine to open a page in")
def test_the_page_can_be_looked_around_in(tmp_path: Path) -> None:
    result = dataclasses.replace(whole(3), plan=Plan(FULL, INS, tmp_path, 5, 3))
    report.save(result, goals.claims(result))
    with browser.opened() as tab:
        tab.size(1200, 900)
        tab.open(tmp_path / REPORT, "document.documentElement.dataset.state")
        assert tab.run("page.panels.length") == len(WEATHERS) * len(AIDINGS)
        tab.run("page.setCursor(60)")
        tab.until("page.panels[0].view && page.panels[0].told.textContent.includes(' m')")
        assert tab.run("page.panels[0].values()[0][1]").endswith(": RMS")
        before = tab.run("page.panels[0].values().length")
        tab.key("1")
        tab.until(f"page.panels[0].values().length < {before}")
        assert tab.run("document.querySelectorAll('#tables table').length") == 1 + len(WEATHERS)
        assert tab.complaints == []


@pytest.mark.ci
def test_files_and_page_have_every_cell(tmp_path: Path) -> None:
    result = dataclasses.replace(whole(6), plan=Plan(FULL, INS, tmp_path, 5, 6))
    claims = goals.claims(result)
    found = report.save(result, claims)
    told = json.loads((tmp_path / report.SUMMARY).read_bytes())
    assert (told["draw"], told["draws"], len(told["cells"])) == (5, 6, len(found))
    lines = list(csv.DictReader(io.StringIO((tmp_path / report.DRAWS).read_text())))
    assert len(lines) == 6 * len(found)
    assert np.hypot(float(lines[0]["north_m"]), float(lines[0]["east_m"])) < 100
    page = report.page(result, found, claims)
    assert "`testbed denied --save --draw 5 --draws 6`" in page
    assert sum(line.startswith(f"| {AIDINGS[1].name} | consumer | ") for line in page.splitlines()) == 4 * len(WEATHERS)
    assert all(f"| {claim.verdict.value} |" in page for claim in claims["ins"])
    assert (tmp_path / "denied_ins.png").stat().st_size > 10_000
    assert [table.row_count for table in report.tables(result, found, claims)] == [
        *[len(AIDINGS) * len(GRADES) * 4] * len(WEATHERS),
        len(claims["ins"]),
    ]


def test_saving_writes_page_and_figure_into_a_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = dataclasses.replace(whole(2), plan=Plan(FULL, INS, tmp_path, 5, 2))
    (tmp_path / saved.FIGURE).write_bytes(b"picture")
    for folder in ("docs", "scenarios"):
        (tmp_path / "checkout" / folder).mkdir(parents=True)
    monkeypatch.setattr(saved, "docs_dir", lambda: tmp_path / "checkout" / "docs")
    monkeypatch.setattr(saved, "data_dir", lambda name: tmp_path / "checkout" / name)
    path = saved.save(result, report.cells(result), goals.claims(result))
    assert path == tmp_path / "checkout" / "docs" / saved.PAGE
    assert "# The table of denied navigation" in path.read_text("utf-8")
    assert (tmp_path / "checkout" / "scenarios" / saved.FIGURE).read_bytes() == b"picture"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--estimator", "federated"], "--estimator federated: needs keys of its own: give ins, or a class"),
        (["--estimator", "imagined"], '--estimator "imagined": there is no kind "imagined"'),
        (["--estimator", "./none.py:Mine"], "--estimator ./none.py:Mine: there is no file"),
        (["--estimator", "nobodys_package:Mine"], "there is no module nobodys_package"),
        (["--estimator", "ins", "--estimator", "ins"], "there is another ins"),
        (["--save", "--quick"], "--save: the documentation has the whole table of ins"),
        (["--draw", "10000000000"], "--draw 10000000000: give a number from 0"),
    ],
)
def test_mistakes_are_told_in_a_line(given: list[str], said: str, tmp_path: Path) -> None:
    with pytest.raises(UserError) as told:
        CliRunner().invoke(
            cli.app, ["denied", *given, "--out", str(tmp_path / "out")], catch_exceptions=False, standalone_mode=False
        )
    assert said in str(told.value)
    assert "\n" not in str(told.value)
    assert not (tmp_path / "out" / report.SUMMARY).exists()


@pytest.mark.ci
def test_the_command_shows_table_and_goals(
    made: list[tuple[str, int]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(benchmark.pool, "cores", lambda: 1)
    ended = CliRunner().invoke(cli.app, ["denied", "--quick", "--draws", "3", "--out", str(tmp_path / "out")])
    assert ended.exit_code == 0, ended.output
    assert len(made) == 9
    assert "Constant wind: 3 draws" in ended.stdout
    assert "Goals: consumer IMU, walking wind" in ended.stdout
    scenarios = sorted((tmp_path / "out" / "scenarios").iterdir())
    assert len(scenarios) == len(WEATHERS) * len(AIDINGS)
    assert Scenario.load(scenarios[0]).estimator[0].name == "ins"


# --- the manual


def test_the_manual_has_the_table_of_the_draw_that_is_drawn_when_nobody_says() -> None:
    text = (data_dir("scenarios").parent / "docs" / saved.PAGE).read_text("utf-8")
    assert f"`testbed denied --save --draw {benchmark.RECORDED_DRAW} --draws" in text
    assert all(f"\n| {aids} |" in text for aids in ("air_data", "flow", "wind_report", "pitot_failed"))
    assert (data_dir("scenarios") / saved.FIGURE).is_file()
