"""`testbed check`: what is compared and how closely, who flies it, and what is said of it."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest
import xarray
from typer.testing import CliRunner

import testbed
import testbed.__main__ as cli
from testbed import measures
from testbed.data import data_dir
from testbed.errors import UserError
from testbed.feeds.closed import NEVER_CLOSED
from testbed.loop import loop
from testbed.many import check
from testbed.many.check import Outcome, Row, Task, against_golden, judge
from testbed.report import page as report
from testbed.scenario import Bounds, Scenario
from testbed.score import observability as visibility

BENCH = (data_dir("scenarios") / "static_bench.toml").read_text("utf-8").replace("duration_s = 300", "duration_s = 90")
HEAD = BENCH[: BENCH.index("[expect]")]
HOUR = BENCH.replace("duration_s = 90", "duration_s = 36000")


def scenario(folder: Path, name: str, text: str = BENCH) -> Path:
    path = folder / f"{name}.toml"
    path.write_text(text)
    return path


def command(*arguments: str | Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> SimpleNamespace:
    monkeypatch.setattr(sys, "argv", ["testbed", "check", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    captured = capsys.readouterr()
    return SimpleNamespace(code=int(ended.value.code or 0), out=captured.out, err=captured.err)


# --- verdicts


@pytest.mark.parametrize(
    ("metric", "golden", "now", "verdict"),
    [
        ("position_horizontal_rms_m", 2.0, 2.09, "same"),
        ("position_horizontal_rms_m", 2.0, 2.11, "worse"),
        ("position_horizontal_rms_m", 2.0, 1.85, "better"),
        ("outage_heading_max_deg", 1e-6, 9e-6, "same"),
        ("position_nees_mean", 0.8, 0.9, "better"),
        ("position_nees_mean", 0.8, 1.2, "better"),
        ("position_nees_mean", 0.8, 1.3, "worse"),
        ("nis_mean.gnss_position", 1.0, 0.0, "worse"),
        ("rejected_fraction.barometer", 0.01, 0.013, "changed"),
        ("rejected_fraction.barometer", 0.01, 0.0085, "same"),
        ("coverage.ramp", 0.9, 0.8, "worse"),
        ("coverage.ramp", 0.9, 1.0, "better"),
        ("missed.ramp", 0.0, 1.0, "worse"),
        ("isolation_correct.ramp", 1.0, 0.0, "worse"),
        ("unrecovered_outages", 0.0, 1.0, "worse"),
        ("recovery_s", 1.0, 1.4, "same"),
        ("recovery_s", 1.0, 1.6, "worse"),
    ],
)
def test_verdict_on_one_metric(metric: str, golden: float, now: float, verdict: str) -> None:
    (row,) = against_golden({f"ins.{metric}": golden}, {f"ins.{metric}": now, "run.wall_s": 3.0})
    assert (row.verdict, row.sound) == (verdict, verdict in ("same", "better"))


@pytest.mark.parametrize(
    ("mean", "now", "verdict"),
    [
        # As it came out on two machines, whose matrix products differ in their last bits,
        (-0.01457, -0.01577, "same"),
        (-0.01457, 0.0, "better"),
        # and one that is further from zero, or nearer, than rounding makes it.
        (-0.01457, -0.0195, "worse"),
        (-0.0195, -0.01457, "better"),
    ],
)
@pytest.mark.parametrize("outage", ["", "outage_"])
def test_a_mean_is_held_against_its_rms(outage: str, mean: float, now: float, verdict: str) -> None:
    rms = {f"ins.{outage}heading_rms_deg": 0.086}
    rows = against_golden({f"ins.{outage}heading_mean_deg": mean} | rms, {f"ins.{outage}heading_mean_deg": now} | rms)
    assert [row.verdict for row in rows] == [verdict, "same"]


def test_a_metric_that_is_gone_or_new_is_a_failure() -> None:
    rows = against_golden({"ins.recovery_s": 1.0}, {"ins.nonfinite_samples": 1.0})
    assert [(row.metric, row.verdict, row.sound) for row in rows] == [
        ("ins.nonfinite_samples", "new", False),
        ("ins.recovery_s", "missing", False),
    ]


def test_a_metric_of_no_known_family_may_not_change() -> None:
    (row,) = against_golden({"ins.sideslip": 1.0}, {"ins.sideslip": 0.9})
    assert row.verdict == "changed"


def test_tolerances_leave_no_room_for_a_tenth() -> None:
    for name, measure in (measures.MEASURES | measures.OF_AIDS | measures.OF_FAULTS | measures.OF_FLIGHT).items():
        large = 1e4
        assert measure.verdict(large, 1.11 * large) in ("worse", "better", "changed"), name
        assert measure.verdict(large, large) == "same"
        assert not measure.size or measure.size in measures.MEASURES, name


def test_judge() -> None:
    expect = {"a": Bounds(max=1.0), "b": Bounds(min=2.0), "c": Bounds(min=0.0, max=1.0)}
    assert [row.verdict for row in judge(expect, {"a": 1.0, "b": 2.0, "c": 0.5})] == ["kept"] * 3
    assert [row.verdict for row in judge(expect, {"a": 1.1, "b": 1.9})] == ["exceeded", "exceeded", "missing"]
    assert [row.verdict for row in judge(expect, {"a": float("nan"), "b": 2.0, "c": 0})] == ["exceeded", "kept", "kept"]


def test_a_count_of_lost_estimates_that_is_missing_is_none() -> None:
    """Who allows for a filter that may turn NaN failed where it did not."""
    (row,) = judge({"mine.nonfinite_samples": Bounds(max=100.0)}, {"mine.aligned_s": 1.0})
    assert (row.verdict, row.now) == ("kept", 0.0)


# --- golden files


def flown(tmp_path: Path, metrics: Mapping[str, float], failure: str = "") -> Outcome:
    task = Task("mine", Scenario.load("static_bench"), tmp_path / "mine", None)
    return Outcome(task, metrics=metrics, failure=failure)


def test_an_update_is_a_difference_worth_reading(tmp_path: Path) -> None:
    path = tmp_path / "golden" / "mine.json"
    first = {"ins.heading_rms_deg": 1.234567, "ins.aligned_s": 12345.0, "ins.recovery_s": 2.0, "run.wall_s": 1.0}
    (one,) = check.update([flown(tmp_path, first)], path.parent)
    assert not one.failed
    assert path.read_text() == (
        '{\n "ins.aligned_s": 12345.0,\n "ins.heading_rms_deg": 1.235,\n "ins.recovery_s": 2.0\n}\n'
    )
    before = path.stat().st_mtime_ns
    check.update([flown(tmp_path, first | {"ins.heading_rms_deg": 1.25})], path.parent)
    assert path.stat().st_mtime_ns == before, "what is the same was written"
    now = {"ins.heading_rms_deg": 1.25, "ins.aligned_s": 3.0, "ins.roll_rms_deg": 0.1}
    (one,) = check.update([flown(tmp_path, now)], path.parent)
    assert [row.verdict for row in one.rows] == ["updated", "same", "updated", "updated"]
    assert json.loads(path.read_text()) == {
        "ins.aligned_s": 3.0,
        "ins.heading_rms_deg": 1.235,
        "ins.roll_rms_deg": 0.1,
    }


def test_an_update_leaves_out_what_failed(tmp_path: Path) -> None:
    (one,) = check.update([flown(tmp_path, {"ins.aligned_s": 1.0}, "control lost")], tmp_path / "golden")
    assert one.failed
    assert list((tmp_path / "golden").iterdir()) == []


def test_where_rounding_decides_expect_alone_is_checked(tmp_path: Path) -> None:
    path = scenario(tmp_path, "mine", BENCH.replace("seed =", "golden = false\nseed ="))
    (tmp_path / "golden").mkdir()
    (tmp_path / "golden" / "mine.json").write_text('{"ins.aligned_s": 1.0}')
    (task,) = check.tasks([str(path)], tmp_path, tmp_path / "golden")
    assert task.scenario.expect
    assert task.golden is None
    (one,) = check.update([Outcome(task, metrics={"ins.aligned_s": 3.0})], tmp_path / "golden")
    assert not one.rows
    assert json.loads((tmp_path / "golden" / "mine.json").read_text()) == {"ins.aligned_s": 1.0}


@pytest.mark.parametrize("text", ["", "[1]", '{"a": "b"}', '{"a": NaN}', '{"a": 1e999}', '{"a": true}'])
def test_a_damaged_golden_file_is_a_mistake(tmp_path: Path, text: str) -> None:
    (tmp_path / "static_bench.json").write_text(text)
    with pytest.raises(
        UserError, match=r"static_bench\.json: .*delete it, and make it again with `testbed check --update`"
    ):
        check.tasks(["static_bench"], tmp_path, tmp_path)


def test_nothing_to_check_is_a_mistake(tmp_path: Path) -> None:
    path = scenario(tmp_path, "mine", HEAD)
    with pytest.raises(UserError, match=r"mine\.toml: has no \[expect\] and no golden metrics"):
        check.tasks([str(path)], tmp_path, None)
    assert check.tasks([str(path)], tmp_path, tmp_path, update=True)


def test_what_a_caller_gets_wrong_is_told(tmp_path: Path) -> None:
    """Some ended in tracebacks, and a folder that is misspelt made every test pass."""
    path = scenario(tmp_path, "mine")
    (tmp_path / "file").write_text("")
    wrong: list[tuple[tuple[Any, ...], dict[str, Any], str]] = [
        ((), {}, "there is nothing to check: name a scenario"),
        ((Scenario.load(path),), {}, "check: scenarios: give the file or the name of each, not Scenario"),
        ((path,), {"golden": tmp_path / "nogolden"}, "nogolden: no such folder: make it with --update"),
        ((path,), {"golden": tmp_path / "file"}, "file: no such folder"),
        ((path,), {"golden": 3}, "check: golden: give a folder, not int"),
        ((path,), {"out": None}, "check: out: give a folder, not NoneType"),
        ((path,), {"out": ""}, "check: out: give a folder, not ''"),
        ((path,), {"workers": 1.5}, "check: workers: give a whole number"),
        ((path,), {"out": tmp_path / "file"}, "file: can't be made: File exists"),
        ((path,), {"out": "a\0b"}, "can't be made"),
    ]
    for arguments, options, says in wrong:
        with pytest.raises(UserError, match=re.escape(says)):
            check.check(*arguments, **options)


def test_what_is_in_the_way_of_a_failure_is_told_and_nothing_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(scenario: Scenario, *, out: Path, **_: Any) -> None:
        out.mkdir()
        (out / "run.nc").write_text("")
        raise UserError("no trim")

    monkeypatch.setattr(loop, "run", fails)
    (tmp_path / "static_bench").write_text("")
    (outcome,) = check.fly_all(check.tasks(["static_bench"], tmp_path, None), workers=1)
    assert "not kept: " in outcome.failure
    assert "kept in" not in str(outcome)
    (tmp_path / "static_bench").unlink()
    (outcome,) = check.fly_all(check.tasks(["static_bench"], tmp_path, None), workers=1)
    assert f"kept in {tmp_path / 'static_bench'}" in str(outcome)


# --- one scenario


@pytest.mark.ci
def test_a_pass_leaves_nothing_and_a_failure_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded = Scenario.load(scenario(tmp_path, "mine"))
    passed = check.fly(Task("mine", loaded, tmp_path / "mine", None))
    assert not passed.failed, passed
    assert not (tmp_path / "mine").exists()
    golden = {key: value for key, value in passed.metrics.items() if not key.startswith("run.")}
    again = check.fly(Task("mine", loaded, tmp_path / "mine", golden))
    assert {row.verdict for row in again.rows} == {"kept", "same"}
    golden["ins.heading_rms_deg"] *= 0.9
    shares: list[float] = []
    failed = check.fly(Task("mine", loaded, tmp_path / "mine", golden), shares.append)
    assert [row.metric for row in failed.rows if not row.sound] == ["ins.heading_rms_deg"]
    assert {"run.nc", "metrics.json", "report.html"} <= {path.name for path in (tmp_path / "mine").iterdir()}
    assert "kept in" in str(failed)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


@pytest.mark.parametrize(("error", "lines"), [(UserError("no trim"), 1), (ZeroDivisionError("oops"), 5)])
def test_an_error_is_a_failure_of_the_scenario(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, lines: int
) -> None:
    def fails(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(loop, "run", fails)
    (task,) = check.tasks(["static_bench"], tmp_path, None)
    outcome = check.fly(task)
    assert outcome.failed
    assert str(error) in str(outcome)
    assert len(outcome.failure.splitlines()) >= lines
    assert ("Traceback" in outcome.failure) == (lines > 1)


def test_a_lost_flight_fails_though_all_bounds_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    truth = xarray.DataTree.from_dict({"/truth": xarray.Dataset(coords={"time": [0.0, 12.0]})})
    lost = SimpleNamespace(metrics={}, failure="control lost: bank 80 deg", dataset=truth, remarks=(), ended={})
    monkeypatch.setattr(loop, "run", lambda *_, **__: lost)
    monkeypatch.setattr(report, "write_report", lambda *_: None)
    monkeypatch.setattr(visibility, "of_run", lambda _: {})
    loaded = Scenario.load("static_bench", ["expect={}"])
    outcome = check.fly(Task("mine", loaded, tmp_path, {}))
    assert outcome.failure == "the flight ended after 12 s: control lost: bank 80 deg"
    assert outcome.failed


LOST = "mine.nonfinite_samples"


@pytest.mark.parametrize(
    ("expected", "golden", "failed"),
    [({}, {}, True), ({LOST: {"max": 800}}, None, False), ({}, {LOST: 799.0}, False)],
)
def test_estimates_that_are_no_numbers_fail_unless_they_are_expected(
    expected: dict[str, Any],
    golden: dict[str, float] | None,
    failed: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """They are in no error: a filter that is dead for most of a run kept all bounds."""
    dead = SimpleNamespace(metrics={LOST: 799.0}, failure="", dataset=SimpleNamespace(attrs={}), ended={})
    monkeypatch.setattr(loop, "run", lambda *_, **__: dead)
    monkeypatch.setattr(report, "write_report", lambda *_: None)
    loaded = Scenario.load("static_bench", {"expect": expected, "estimator": [{"name": "mine", "aids": ["gnss"]}]})
    outcome = check.fly(Task("mine", loaded, tmp_path, golden))
    assert outcome.failed == failed
    told = [str(row) for row in outcome.rows if row.verdict == "exceeded"]
    assert told == [f"{LOST} is 799, not ≤ 0: exceeded"] * failed


@pytest.mark.ci
def test_a_loop_that_never_closes_fails_though_all_bounds_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """How well the aircraft flew on truth is no answer."""
    monkeypatch.setattr(report, "write_report", lambda *_: None)
    silent = "fault=[{sensor='barometer',kind='dropout',window=[0,10]}]"
    bound = 'expect={"flight.bank_max_deg" = 45}'
    for fault in ("fault=[]", silent):
        loaded = Scenario.load("closed_loop_ahrs_only", ["duration_s=10", fault, bound])
        outcome = check.fly(Task("mine", loaded, tmp_path, None))
        assert [row.verdict for row in outcome.rows] == ["kept"]
        assert outcome.failed == (fault == silent)
        assert outcome.failure == (NEVER_CLOSED if fault == silent else "")


def test_a_report_that_fails_hides_no_metrics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: Any) -> None:
        raise KeyError("figure")

    monkeypatch.setattr(report, "write_report", fails)
    loaded = Scenario.load("static_bench", ["duration_s=3", 'expect={"ins.aligned_s" = 0}'])
    outcome = check.fly(Task("mine", loaded, tmp_path / "mine", None))
    assert outcome.failure.startswith("no report: KeyError: 'figure'")
    assert [row.verdict for row in outcome.rows] == ["exceeded"]


# --- all of them


@pytest.mark.ci
def test_check_end_to_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.chdir(tmp_path)
    run = partial(command, monkeypatch=monkeypatch, capsys=capsys)
    in_parallel = check.fly_all
    monkeypatch.setattr(check, "fly_all", lambda given, tell: [check.fly(task) for task in given])
    monkeypatch.setattr(report, "write_report", lambda *_: None)  # in this process
    good, bad = scenario(tmp_path, "good"), scenario(tmp_path, "bad", f'{HEAD}[expect]\n"ins.velocity_rms_mps" = 0.0\n')
    plain = run(good)
    assert plain.code == 0, plain.err
    assert re.fullmatch(r"good: passed in \d+ s: of \[expect\] 4 kept; no golden metrics.*\n", plain.out[: -len(LAST)])
    assert plain.out.endswith(LAST)
    assert not (tmp_path / "runs").exists(), "a check that passes left something"
    assert run(good, bad, "--golden", "golden", "--update").code == 1, "what breaks its [expect] is no example"
    assert [path.name for path in (tmp_path / "golden").iterdir()] == ["good.json"]
    changed = json.loads((tmp_path / "golden/good.json").read_text())
    changed["ins.heading_max_deg"] *= 2
    (tmp_path / "golden/good.json").write_text(json.dumps(changed))
    (tmp_path / "golden/bad.json").write_text(json.dumps(changed | {"ins.heading_rms_deg": 0.1}))
    monkeypatch.setattr(check, "fly_all", in_parallel)
    both = run(good, bad, "--golden", "golden", "--junit", "check.xml")
    assert both.code == 1
    assert " of 2 scenarios" in both.err
    table = [line.split("│") for line in both.out.splitlines() if line.startswith("│")]
    shown = [[cell.strip() for cell in (cells[1], cells[2], cells[-2])] for cells in table]
    assert shown == [
        ["good", "ins.heading_max_deg", "better"],
        ["bad", "ins.velocity_rms_mps", "exceeded"],
        ["bad", "ins.heading_max_deg", "better"],
        ["bad", "ins.heading_rms_deg", "worse"],
    ]
    assert re.search(r"heading_max_deg .* -50\.\d % ", both.out)
    assert re.search(
        r"^good: passed in \d+ s: of \[expect\] 4 kept; of golden metrics 1 better, 57 same$", both.out, re.M
    )
    assert re.search(r"^bad: FAILED in .* 1 worse; kept in runs/check/bad$", both.out, re.M)
    assert [path.name for path in (tmp_path / "runs/check").iterdir()] == ["bad"]
    assert {"run.nc", "report.html"} <= {path.name for path in (tmp_path / "runs/check/bad").iterdir()}
    suites = ElementTree.parse(tmp_path / "check.xml").getroot()
    assert (suites.get("tests"), suites.get("failures"), suites.get("errors")) == ("6", "2", "0")


LAST = "Only [expect] was checked: there is no tests/golden here. Give golden metrics with --golden DIR.\n"


def fly_or_crash(task: Task, tell: Any) -> Outcome:
    """Called on a worker."""
    if task.name == "crash":
        task.folder.mkdir()
        (task.folder / "run.nc").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return Outcome(task, wall_s=os.getpid())


@pytest.mark.ci
def test_a_crash_costs_one_scenario(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The one that flies longest crashes; the same worker's place is taken by another."""
    names = ["crash", "good", "also", "more"]
    given = check.tasks(
        [str(scenario(tmp_path, name, HOUR if name == "crash" else BENCH)) for name in names], tmp_path / "runs", None
    )
    monkeypatch.setattr(check, "fly", fly_or_crash)
    outcomes = check.fly_all(given, workers=2)
    assert [outcome.failed for outcome in outcomes] == [True, False, False, False]
    assert outcomes[0].failure.startswith("its process ended by signal 9")
    assert [outcome.task for outcome in outcomes] == given
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["crash"]


@pytest.mark.ci
def test_check_in_a_test(tmp_path: Path) -> None:
    result = testbed.check(scenario(tmp_path, "mine"), out=tmp_path / "runs")
    assert result.passed, result
    bad = scenario(tmp_path, "bad", f'{HEAD}[expect]\n"ins.aligned_s" = 0.0\n')
    result = testbed.check(bad, out=tmp_path / "runs")
    assert not result.passed
    assert re.search(r"(?m)^bad: FAILED in .*\n  ins.aligned_s is \S+, not ≤ 0: exceeded$", str(result))


@pytest.mark.ci
def test_an_interrupt_leaves_no_process_and_no_file(tmp_path: Path) -> None:
    names = [scenario(tmp_path, name, HOUR).name for name in ("one", "two", "three")]
    command = [sys.executable, "-m", "testbed", "check", *names]
    heed = partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=heed, process_group=0, env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    ) as running:  # fmt: skip
        assert running.stderr is not None
        running.stderr.readline()  # the first progress
        os.killpg(running.pid, signal.SIGINT)  # as a terminal does it
        rest = running.stderr.read()
    assert running.returncode == 130
    assert rest.splitlines()[-1] == "testbed: interrupted: nothing was concluded"
    assert "Traceback" not in rest
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names)
    deadline = time.monotonic() + 5
    while time.monotonic() < deadline:
        try:
            os.killpg(running.pid, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    pytest.fail("a process of the group is still there")


# --- JUnit


def test_a_junit_file_that_cant_be_is_told_before_the_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setattr(check, "fly_all", lambda *_: pytest.fail("flown"))
    for place, why in ((tmp_path, "is a folder"), (tmp_path / "no" / "check.xml", "there is no folder")):
        told = command("static_bench", "--junit", place, monkeypatch=monkeypatch, capsys=capsys)
        assert told.code == 2
        assert f"--junit {place}: {why}" in told.err


def valid(root: ElementTree.Element) -> None:
    """The rules of the schema that Jenkins, GitLab and others read (junit-10.xsd), on what is used of it."""
    assert root.tag == "testsuites"
    attributes = {
        "testsuites": ({"name", "tests", "failures", "errors", "time", "disabled"}, set()),
        "testsuite": ({"name", "tests", "failures", "errors", "time", "skipped", "timestamp"}, {"name", "tests"}),
        "testcase": ({"name", "classname", "time", "status", "assertions"}, {"name", "classname"}),
        "failure": ({"message", "type"}, {"type"}),
        "error": ({"message", "type"}, {"type"}),
    }
    parents = {"testsuite": "testsuites", "testcase": "testsuite", "failure": "testcase", "error": "testcase"}
    for parent in root.iter():
        allowed, needed = attributes[parent.tag]
        assert needed <= set(parent.keys()) <= allowed
        for child in parent:
            assert parents[child.tag] == parent.tag
        assert parent.tag in ("failure", "error") or not (parent.text or "").strip()
    for group in (root, *root):
        for count, tag in (("tests", "testcase"), ("failures", "failure"), ("errors", "error")):
            assert int(group.get(count, "-1")) == sum(1 for _ in group.iter(tag))


def test_junit(tmp_path: Path) -> None:
    task = Task("mine", Scenario.load("static_bench"), tmp_path, {})
    rows = [
        Row("ins.heading_rms_deg", "≤ 1", 2.0, "exceeded", False),
        Row("ins.heading_rms_deg", "1", 2.0, "worse", True),
        Row("ins.roll_rms_deg", "1", 0.5, "better", True),
        Row("other.roll_rms_deg", "1", None, "missing", True),
    ]
    passed = Outcome(task, rows=rows[2:3], wall_s=1.5)
    crashed = Outcome(task, failure="ValueError: <&> \x00\x1b[31m\nTraceback", wall_s=0.2)
    root = ElementTree.fromstring(check.junit([Outcome(task, rows=rows), passed, crashed]))
    valid(root)
    cases = [(case.get("name"), [child.tag for child in case]) for case in root.iter("testcase")]
    assert cases == [
        ("flight", []), ("expect", ["failure"]), ("golden ins", ["failure"]), ("golden other", ["failure"]),
        ("flight", []), ("golden ins", []), ("flight", ["error"]),
    ]  # fmt: skip
    messages = [failure.text for failure in root.iter("failure")]
    assert messages[1] == "ins.heading_rms_deg is 2, not 1: worse"
    error = next(root.iter("error"))
    assert error.get("message") == "ValueError: <&> ??[31m"


DYING = """
import os

from nav.samples import Estimate


class Dying:
    def __init__(self, rig):
        self.t = 0.0

    def propagate(self, imu):
        self.t = float(imu.t[-1])
        if self.t > 2.0:
            os._exit(0)

    def update(self, sample):
        return []

    def estimate(self):
        return Estimate.of(self.t)
"""


@pytest.mark.ci
def test_one_scenario_whose_process_dies_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It ended the command, with exit code 0, no verdict, and the JUnit report of the run before."""
    (tmp_path / "dying.py").write_text(DYING)
    flight = (data_dir("scenarios") / "u_turn.toml").read_text().replace("duration_s = 200", "duration_s = 20")
    mine = '\n[[estimator]]\nname = "mine"\nkind = "./dying.py:Dying"\n'
    (tmp_path / "mine.toml").write_text(flight + mine)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "junit.xml").write_bytes(check.junit([]))
    result = CliRunner().invoke(cli.app, ["check", "mine.toml", "--junit", "junit.xml"])
    assert result.exit_code == 1, result.output
    assert "its process ended with exit code 0" in (tmp_path / "junit.xml").read_text()
    assert "kept in" not in result.output  # there is no record
