"""The command line: what it prints, where it writes, and how it ends."""

from __future__ import annotations

import io
import json
import math
import os
import re
import runpy
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import pytest
from rich.console import Console
from worlds import synthetic_run

import testbed.__main__ as cli
from testbed import threads
from testbed.data import data_dir
from testbed.errors import UserError
from testbed.loop import links, loop
from testbed.many import progress
from testbed.motion import flight
from testbed.record import reader as record
from testbed.results import held
from testbed.scenario import Scenario

QUICK = ["--set", "duration_s=3", "--no-report"]
PROMISED = {"scenarios", "run", "check", "report", "export", "campaign", "watch", "init"}


class Ended:
    """How a command ended."""

    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err


Testbed = Callable[..., Ended]


@pytest.fixture
def testbed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Testbed:
    """Runs a command in this process, in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def command(*arguments: str | Path) -> Ended:
        monkeypatch.setattr(sys, "argv", ["testbed", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        captured = capsys.readouterr()
        return Ended(int(ended.value.code or 0), captured.out, captured.err)

    return command


def python(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, cwd=cwd, timeout=60)


# --- what is there


def test_help_names_every_command(testbed: Testbed) -> None:
    shown = testbed("--help").out
    assert {word for word in PROMISED if f"  {word}" in shown} == PROMISED


def test_alone_it_shows_its_help(testbed: Testbed) -> None:
    ended = testbed()
    shown = ended.out + ended.err
    assert {word for word in PROMISED if f"  {word}" in shown} == PROMISED
    assert "Traceback" not in shown


@pytest.mark.parametrize("command", [(), *((name,) for name in sorted(PROMISED))])
def test_h_is_help(testbed: Testbed, command: tuple[str, ...]) -> None:
    short, long = testbed(*command, "-h"), testbed(*command, "--help")
    assert short.code == 0
    assert short.out == long.out


def test_init_begins_a_project(testbed: Testbed, tmp_path: Path) -> None:
    begun = testbed("init", "new/mine")
    assert begun.code == 0
    files = sorted(path.name for path in (tmp_path / "new/mine").iterdir())
    assert files == ["README.md", "filters.py", "first.toml", "test_filters.py"]
    assert begun.out.splitlines() == [
        *(f"new/mine/{name}" for name in files),
        "Now: cd new/mine && testbed run first.toml",
    ]
    assert {one.name for one in Scenario.load(tmp_path / "new/mine/first.toml").estimator} == {"mine", "ins"}
    again = testbed("init", "new/mine")
    assert (again.code, again.err) == (2, "testbed: new/mine: is not empty: name a new folder\n")
    taken = testbed("init", "new/mine/README.md")
    assert (taken.code, taken.err.count("\n")) == (2, 1)


@pytest.mark.ci
def test_a_project_that_was_begun_passes_its_own_test(testbed: Testbed, tmp_path: Path) -> None:
    testbed("init", "mine")
    tests = runpy.run_path(str(tmp_path / "mine/test_filters.py"))
    tests["test_mine_stays_near_an_ins"]()


@pytest.mark.parametrize("said", [
    {"PYTHONIOENCODING": "cp1252"},
    {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
])  # fmt: skip
def test_a_terminal_that_is_not_utf8_lacks_signs_and_no_more(said: dict[str, str], tmp_path: Path) -> None:
    words = [sys.executable, "-m", "testbed", "init", "≤☃"]
    ran = subprocess.run(words, env=os.environ | said, cwd=tmp_path, capture_output=True, timeout=60)
    assert (ran.returncode, ran.stderr) == (0, b"")
    assert (tmp_path / "≤☃/first.toml").is_file()


def test_scenarios_lists_name_title_and_duration(testbed: Testbed) -> None:
    shown = testbed("scenarios")
    assert shown.code == 0
    for path in data_dir("scenarios").glob("*.toml"):
        assert path.stem in shown.out
    assert "A U-turn with all sensors healthy" in shown.out
    assert "200 s" in shown.out


def test_version(testbed: Testbed) -> None:
    shown = testbed("--version")
    assert (shown.code, shown.out.split()[0]) == (0, "testbed")
    assert shown.out.split()[1][0].isdigit()


def test_a_script_can_tell_its_mistakes_from_ours() -> None:
    import testbed

    assert testbed.UserError is UserError


def test_start_up_imports_nothing_heavy() -> None:
    code = """
import sys, testbed.__main__ as cli
sys.argv = ["testbed", "scenarios"]
try:
    cli.main()
except SystemExit:
    pass
heavy = {"numpy", "numba", "scipy", "jsbsim", "pymavlink", "matplotlib", "xarray", "h5py", "distributed"}
print("heavy:", sorted(heavy & sys.modules.keys()))
"""
    shown = python("-c", code).stdout
    assert "u_turn" in shown
    assert shown.splitlines()[-1] == "heavy: []"


@pytest.mark.ci
def test_a_run_imports_nothing_slow_that_it_does_not_use() -> None:
    code = """
import sys, testbed.loop.loop
print("slow:", sorted({"matplotlib", "scipy.signal", "scipy.stats", "scipy.spatial", "pandas"} & sys.modules.keys()))
"""
    assert python("-c", code).stdout.splitlines()[-1] == "slow: []"


# --- what goes wrong ends with one message and code 2


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["run", "uturn"], "testbed: uturn: no such file and no shipped scenario of that name: did you mean u_turn?"),
        (["run", "none.toml"], "testbed: none.toml: no such file"),
        (["run", "."], "testbed: .: is a folder"),
        (["run", "u_turn", "--set", "seed"], "testbed: --set seed: give it as key=value"),
        (["run", "u_turn", "--set", "sed=3"], "(--set sed=3): sed: unknown key: did you mean seed?"),
        (["run", "u_turn", "--realtime", "0"], "testbed: --realtime 0: the factor must be above 0"),
        (["run", "u_turn", "--realtime", "nan"], "testbed: --realtime nan: the factor must be above 0"),
        (["run", "u_turn", "--seed", "-1"], "--seed"),
        (["run", "u_turn", "--seed", "x"], "--seed"),
        (["run", "u_turn", "--seed", "99999999999999999999"], "--seed"),
        (
            ["run", "u_turn", "--mavlink", "tlog:a.tlog", "--estimator", "inz"],
            "testbed: --estimator inz: the scenario has no such estimator: choose from ins",
        ),
        (["run", "u_turn", "--estimator", "inz"], "testbed: --estimator inz: the scenario has no such estimator"),
        (
            ["run", "u_turn", "--mavlink", "tlog:a.tlog", "--set", "estimator=[]", "--set", "expect={}"],
            "testbed: the scenario has no [[estimator]], so a link has nothing to show: add one",
        ),
        (
            ["run", "u_turn", "--mavlink", "tlog:runs/u_turn/../u_turn/run.nc"],
            "testbed: tlog:runs/u_turn/../u_turn/run.nc: a result of the run goes there: give the log another name",
        ),
        (["run", "u_turn", "--mavlink", "tlog:o/report.html", "--out", "o"], "a result of the run goes there"),
        (["run", "u_turn", "--mavlink", "tlog:o/flight.png", "--out", "o"], "a result of the run goes there"),
        (["run", "u_turn", "--mavlink", "udp"], "testbed: udp: not a MAVLink address"),
        (["run", "u_turn", "--mavlink", "a.tlog", "--mavlink-key", " "], "testbed: --mavlink-key: is empty"),
        (["run", "u_turn", "--mavlink", "a.tlog", "--mavlink-identity", "apm"], "choose from px4, ardupilot"),
        (["run", "u_turn", "--mavlink", "udpout:127.0.0.1:99999"], "testbed: udpout:127.0.0.1:99999: no port number"),
        (["run", "u_turn", "--mavlink-readonly"], "testbed: --mavlink-readonly: there is no link: add --mavlink URL"),
        (["run", "u_turn", "--gps-input"], "testbed: --gps-input: is for ArduPilot: add --ardupilot"),
        (["run", "u_turn", "--bogus"], "No such option"),
        (["run"], "Missing argument"),
        (["check", "u_turn", "uturn"], "testbed: uturn: no such file"),
        (["check", "u_turn", "./u_turn"], "testbed: ./u_turn: no such file"),
        (["check", "u_turn", "u_turn"], "testbed: u_turn: there is another scenario of that name among these"),
        (["check", "--golden", "none"], "testbed: --golden none: no such folder: make it with --update"),
        (["check", "--update"], "testbed: --update: there is no tests/golden here: say with --golden DIR where"),
        (["check", "u_turn", "--junit", "none/check.xml"], "testbed: --junit none/check.xml: there is no folder none"),
        (["report", "none.nc"], "testbed: none.nc: no such file"),
        (["report", "."], "testbed: .: is a folder"),
        (["export", "none.nc", "--format", "csv"], "testbed: none.nc: no such file"),
        (["export", "none.nc", "--format", "xls"], 'there is no format "xls"'),
        (["export", "u_turn", "--format", "kml"], "testbed: u_turn: no such file"),
        (["export", "kinematic_u_flight", "--format", "wpl"], "there is no plan that an autopilot could fly"),
        (["campaign", "u_turn", "--runs", "0"], "--runs"),
        (["campaign", "u_turn", "--runs", "2", "--vary", "seed"], "testbed: --vary seed: give it as key=a,b,c"),
        (["campaign", "u_turn", "--runs", "2", "--set", "sed=3"], "(--set sed=3): sed: unknown key"),
        (["campaign", "uturn", "--runs", "2"], "testbed: uturn: no such file"),
        (["fly"], "No such command"),
    ],
)
def test_user_mistakes(testbed: Testbed, tmp_path: Path, arguments: list[str], says: str) -> None:
    ended = testbed(*arguments)
    assert ended.code == 2
    assert says in ended.err
    assert "Traceback" not in ended.err
    assert list(tmp_path.iterdir()) == [], "something was written"


def test_a_junit_report_goes_over_a_report_and_nothing_else(testbed: Testbed, tmp_path: Path) -> None:
    """It went over a scenario."""
    (tmp_path / "mine.toml").write_text("seed = 1\n")
    ended = testbed("check", "static_bench", "--junit", "mine.toml")
    assert ended.code == 2
    assert "--junit mine.toml: is there already, and is no report: give it another name" in ended.err
    assert (tmp_path / "mine.toml").read_text() == "seed = 1\n"
    (tmp_path / "aircraft.xml").write_text('<?xml version="1.0"?>\n<fdm_config/>\n')
    assert testbed("check", "static_bench", "--junit", "aircraft.xml").code == 2
    assert "fdm_config" in (tmp_path / "aircraft.xml").read_text()


def test_a_telemetry_log_of_somebody_else_is_kept(testbed: Testbed, tmp_path: Path) -> None:
    """One elsewhere than the results went, and one that another run was writing."""
    run = ["run", "static_bench", *QUICK, "--set", "duration_s=5", "--out", "a", "--mavlink"]
    assert testbed(*run, "tlog:flown.tlog").code == 0
    before = (tmp_path / "flown.tlog").read_bytes()
    ended = testbed(*run, "tlog:flown.tlog", "--set", "duration_s=3")
    assert ended.code == 2
    assert "tlog:flown.tlog: flown.tlog is there already: give the log another name, or add --force" in ended.err
    assert (tmp_path / "flown.tlog").read_bytes() == before
    assert testbed(*run, "tlog:flown.tlog", "--set", "duration_s=3", "--force").code == 0
    assert testbed(*run, "tlog:a/run.tlog").code == 0
    assert testbed(*run, "tlog:a/run.tlog").code == 0  # which is of the run before
    before = (tmp_path / "a" / "run.tlog").read_bytes()
    assert before
    with held(tmp_path / "a"):
        assert "another run is writing here" in testbed(*run, "tlog:a/run.tlog").err
    assert (tmp_path / "a" / "run.tlog").read_bytes() == before
    (tmp_path / "a" / "mine.tlog").write_bytes(b"mine")
    ended = testbed(*run, "tlog:a/mine.tlog")
    assert ended.code == 2
    assert "a: there is mine.tlog already, not made by an earlier command" in ended.err
    assert (tmp_path / "a" / "mine.tlog").read_bytes() == b"mine"
    assert testbed(*run[:-1]).code == 0
    assert not (tmp_path / "a" / "run.tlog").exists(), "the log of another run is beside the record"


@pytest.mark.ci
def test_metrics_are_those_of_the_whole_record_that_a_killed_run_left(testbed: Testbed, tmp_path: Path) -> None:
    assert testbed("run", "static_bench", *QUICK, "--set", "duration_s=70", "--out", "a").code == 0
    whole = (tmp_path / "a" / "metrics.json").read_bytes()
    with h5py.File(tmp_path / "a" / "run.nc", "r+") as file:
        file.attrs["complete"] = 0
    (tmp_path / "a" / "metrics.json").write_text("{}")
    with held(tmp_path / "a"):
        assert "another run is writing here" in testbed("report", "a/run.nc").err
    assert (tmp_path / "a" / "metrics.json").read_text() == "{}"
    assert testbed("report", "a/run.nc").code == 0
    now = json.loads((tmp_path / "a" / "metrics.json").read_bytes())
    assert now == {key: value for key, value in json.loads(whole).items() if not key.startswith("run.")}


def test_a_drafted_scenario_goes_over_a_scenario_and_nothing_else(testbed: Testbed, tmp_path: Path) -> None:
    """It went over the log that it is of."""
    log = tmp_path / "mine.bin"
    shutil.copy(data_dir("scenarios") / "recorded_flight.bin", log)
    size = log.stat().st_size
    for target, says in (("mine.bin", "mine.bin: is no scenario"), (".", ".: is a folder: give the name of a file")):
        ended = testbed("log", "mine.bin", "--scenario", target, "--force")
        assert (ended.code, says in ended.err) == (2, True)
    assert log.stat().st_size == size
    (tmp_path / "mine.toml").write_text("seed = 1\n")
    assert testbed("log", "mine.bin", "--scenario", "mine.toml").code == 2
    assert testbed("log", "mine.bin", "--scenario", "mine.toml", "--force").code == 0
    assert 'source = "log"' in (tmp_path / "mine.toml").read_text()


def test_every_mistake_of_a_file_is_a_line(testbed: Testbed, tmp_path: Path) -> None:
    text = (data_dir("scenarios") / "u_turn.toml").read_text("utf-8")
    (tmp_path / "mine.toml").write_text(text.replace("seed = 1", "seed = true").replace("lat_deg = 47", "lat_deg = 91"))
    ended = testbed("run", "mine.toml")
    assert ended.code == 2
    assert ended.err.splitlines() == [
        "testbed: mine.toml:6: seed: must be a whole number, not true",
        "testbed: mine.toml:14: truth.start.lat_deg: must be less than 85, not 91.0",
    ]


def test_an_unwritable_folder_is_refused_before_the_run(testbed: Testbed, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for folder in ("file", "file/below", "/proc/testbed"):
        ended = testbed("run", "u_turn", "--out", folder)
        assert ended.code == 2
        assert ended.err.startswith(f"testbed: {folder}: can't be written: ")
        assert ended.err.endswith("choose another folder with --out\n")


def test_a_port_in_use_leaves_nothing_behind(testbed: Testbed, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        url = f"tcpin:127.0.0.1:{taken.getsockname()[1]}"
        ended = testbed("run", "u_turn", "--mavlink", url, "--mavlink", "tlog:runs/u_turn/run.tlog")
    assert ended.code == 2
    assert ended.err.startswith(f"testbed: {url}: ")
    assert list(tmp_path.iterdir()) == []


def test_a_record_that_lacks_a_column_is_damaged(testbed: Testbed, tmp_path: Path) -> None:
    synthetic_run.dataset(100.0, path=tmp_path / "run.nc")
    with h5py.File(tmp_path / "run.nc", "r+") as file:
        del file["estimators/ins/covariance"]
    ended = testbed("report", "run.nc")
    assert ended.code == 2
    assert "run.nc: damaged record (estimators/ins/covariance is missing); run the scenario again" in ended.err


def test_a_damaged_record(testbed: Testbed, tmp_path: Path) -> None:
    (tmp_path / "run.nc").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(500))
    (tmp_path / "text.nc").write_text("not a record")
    for name in ("run.nc", "text.nc"):
        ended = testbed("report", name)
        assert ended.code == 2
        assert ended.err.startswith(f"testbed: {name}: ")
        assert len(ended.err.splitlines()) == 1


def test_a_full_disk_is_a_message(testbed: Testbed, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device", "run.nc")

    monkeypatch.setattr(loop, "run", full)
    ended = testbed("run", "static_bench")
    assert (ended.code, ended.err) == (2, "testbed: [Errno 28] No space left on device: 'run.nc'\n")


@pytest.mark.ci
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_what_ends_a_run_leaves_its_record_and_says_so(testbed: Testbed) -> None:
    ended = testbed(
        "run", "static_bench", *QUICK, "--set", "duration_s=20", "--mavlink", "tlog:/dev/full", "--out", "a"
    )
    assert ended.code == 2
    told = ended.err.splitlines()[-2:]
    assert told[0].startswith("testbed: tlog:/dev/full: the log can't be written any further")
    assert told[1] == "testbed: the record so far is a/run.nc: `testbed report a/run.nc` shows it"
    assert testbed("report", "a/run.nc").code == 0


@pytest.mark.ci
def test_no_traceback_reaches_the_shell(tmp_path: Path) -> None:
    ended = python("-m", "testbed", "run", "uturn", cwd=tmp_path)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert len(ended.stderr.splitlines()) == 1


# --- running


def test_run_writes_a_record_and_metrics(testbed: Testbed, tmp_path: Path) -> None:
    ended = testbed("run", "static_bench", *QUICK)
    assert ended.code == 0, ended.err
    assert {"run.nc", "metrics.json"} <= {path.name for path in (tmp_path / "runs/static_bench").iterdir()}
    assert "100 %  00:03 of 00:03" in ended.err
    assert "ins" in ended.out


def test_run_passes_everything_on(testbed: Testbed, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: dict[str, Any] = {}

    def run(scenario: Any, **options: Any) -> None:
        asked.update(options, scenario=scenario)
        raise UserError("enough")

    monkeypatch.setattr(loop, "run", run)
    ended = testbed("run", "u_turn", "--out", "a/b", "--seed", "9", "--realtime", "4", "--set", "duration_s=50")
    assert (ended.code, ended.err) == (2, "testbed: enough\n")
    assert (asked["seed"], asked["realtime"], asked["out"], asked["links"]) == (9, 4.0, Path("a/b"), [])
    assert asked["scenario"].duration_s == 50.0
    assert not (tmp_path / "a").exists(), "an empty folder was left behind"
    for arguments in (["--realtime", "u_turn"], ["u_turn", "--realtime"], ["u_turn", "--realtime", "--seed", "3"]):
        testbed("run", *arguments)
        assert asked["realtime"] == 1.0


@pytest.mark.ci
def test_a_record_is_run_again(testbed: Testbed, tmp_path: Path) -> None:
    testbed("run", "static_bench", *QUICK, "--out", "first", "--seed", "7")
    ended = testbed("run", "first/run.nc", "--no-report")
    assert ended.code == 0, ended.err
    again = tmp_path / "runs/first_again/run.nc"
    assert str(again.relative_to(tmp_path)) in ended.out
    first, second = record.load(tmp_path / "first/run.nc"), record.load(again)
    assert first.identical(second)
    ended = testbed("run", "first/run.nc", "--no-report", "--seed", "8", "--set", "duration_s=2", "--out", "other")
    other = record.load(tmp_path / "other/run.nc")
    assert (other.attrs["seed"], other["truth/time"].values[-1]) == (8, 2.0)
    third = testbed("run", "other/run.nc", "--no-report", "--out", "third")
    assert third.code == 0, "overrides are part of a record"
    assert record.load(tmp_path / "third/run.nc").identical(other)


@pytest.mark.ci
def test_a_record_of_a_class_that_was_edited_is_run_again_with_a_remark(testbed: Testbed, tmp_path: Path) -> None:
    assert testbed("init", "mine").code == 0
    assert testbed("run", "mine/first.toml", *QUICK, "--out", "first").code == 0
    assert "bits may differ" not in testbed("run", "first/run.nc", "--no-report", "--out", "second").err
    file = tmp_path / "mine/filters.py"
    file.write_text(file.read_text("utf-8") + "\nMORE = 1\n", "utf-8")
    ended = testbed("run", "first/run.nc", "--no-report", "--out", "third")
    assert ended.code == 0, ended.err
    assert "first/run.nc: ./filters.py:Mine has been edited since: bits may differ" in ended.err


@pytest.mark.ci
def test_a_record_with_a_class_of_the_user_s_is_run_again_from_anywhere(
    testbed: Testbed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file was looked for only from where the first was run."""
    assert testbed("init", "mine").code == 0
    assert testbed("run", "mine/first.toml", *QUICK, "--out", "first").code == 0
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    ended = testbed("run", "../first/run.nc", "--no-report", "--out", "again")
    assert ended.code == 0, ended.err
    assert record.load(Path("again/run.nc")).identical(record.load(tmp_path / "first/run.nc"))
    file = tmp_path / "mine/filters.py"
    file.unlink()
    ended = testbed("run", "../first/run.nc", "--no-report", "--out", "third")
    assert ended.code == 2
    assert f"{file}: can't be read: No such file or directory" in ended.err


def _spoilt(folder: Path, **attributes: str) -> Path:
    """A record some of whose attributes are not what a run writes."""
    import h5py

    folder.mkdir()
    path = folder / "mine.nc"
    path.write_bytes((folder.parent / "first/run.nc").read_bytes())
    with h5py.File(path, "r+") as file:
        for name, value in attributes.items():
            file.attrs[name] = value
    return path


@pytest.mark.ci
def test_what_is_wrong_with_running_a_record_again(testbed: Testbed, tmp_path: Path) -> None:
    testbed("run", "static_bench", *QUICK, "--out", "first")
    for arguments, says in (
        (["first/run.nc", "--out", "first"], "first/run.nc: would be overwritten by its own rerun: choose another"),
        (["nothing.nc"], "nothing.nc: no such file"),
        (["first/run.nc", "--set", "sensors.gnss=3"], "sensors.gnss: must be a table, not 3"),
        ([_spoilt(tmp_path / "a", overrides="[")], "a/mine.nc: damaged record"),
        ([_spoilt(tmp_path / "b", scenario="title = 3")], "title: must be text"),
        ([_spoilt(tmp_path / "c", versions="5")], "c/mine.nc: damaged record"),
    ):
        ended = testbed("run", *arguments)
        assert ended.code == 2, arguments
        assert says in ended.err
        assert "Traceback" not in ended.err
    assert (tmp_path / "first/run.nc").exists()
    assert not (tmp_path / "runs").exists()
    old = _spoilt(tmp_path / "d", versions='{"numpy": "0.1"}', complete="")
    ended = testbed("run", old, "--no-report")
    assert ended.code == 0, ended.err
    assert "mine.nc: was made with numpy 0.1: bits may differ" in ended.err
    assert "mine.nc: ends early; the rerun goes on to the scenario's end" in ended.err
    assert (tmp_path / "runs/mine_again/run.nc").exists()


@pytest.mark.ci
def test_a_lost_flight_fails_and_keeps_its_record(
    testbed: Testbed, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(flight, "MAX_ROLL", math.radians(20.0))  # which the U-turn exceeds
    ended = testbed("run", "u_turn", "--set", "duration_s=60", "--set", "plan[0].length_m=500", "--no-report")
    assert ended.code == 1
    assert re.fullmatch(
        r"testbed: the flight ended after \d+ s: control lost: bank -?2\d deg, .*", ended.err.splitlines()[-1]
    )
    assert (tmp_path / "runs/u_turn/run.nc").exists()


def test_an_interrupted_run_says_what_it_leaves(testbed: Testbed, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(loop, "run", interrupted)
    ended = testbed("run", "u_turn")
    assert (ended.code, ended.err) == (130, "testbed: interrupted: nothing was recorded\n")


def test_the_program_multiplies_on_one_thread_unless_it_is_told() -> None:
    """On two, the bound of an outage takes five times the processor time, and a run an eighth more."""
    told = {name: value for name, value in os.environ.items() if name not in threads.ONE}
    ask = "import os, sys; sys.argv = ['testbed']; import testbed.__main__; print(os.environ['OPENBLAS_NUM_THREADS'])"
    for environment, many in ((told, "1"), (told | {"OPENBLAS_NUM_THREADS": "4"}, "4")):
        ran = subprocess.run([sys.executable, "-c", ask], env=environment, capture_output=True, text=True, timeout=60)
        assert ran.stdout == f"{many}\n"


@pytest.mark.ci
def test_an_interrupt_from_the_keyboard_leaves_a_record(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "testbed", "run", "static_bench", "--realtime", "50", "--no-report"]
    # Tests that run in the background of a shell inherit that interrupts are ignored.
    heed = partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, preexec_fn=heed) as running:
        assert running.stderr is not None
        # Under load lines come before the first rows do.
        percent = next(done for line in running.stderr if (done := int(line.split("%")[0])) > 0)
        running.send_signal(signal.SIGINT)
        rest = running.stderr.read()
    assert running.returncode == 130
    assert rest.splitlines()[-1] == (
        "testbed: interrupted: the record so far is runs/static_bench/run.nc: "
        "`testbed report runs/static_bench/run.nc` shows it"
    )
    assert "Traceback" not in rest
    rows = record.load(tmp_path / "runs/static_bench/run.nc")["truth"].sizes["time"]
    assert rows >= 30 * (percent - 0.5)  # at 10 Hz over 300 s; what is shown is rounded


@pytest.mark.ci
def test_export_and_report_of_a_run(testbed: Testbed, tmp_path: Path) -> None:
    testbed("run", "static_bench", *QUICK, "--out", "out")
    for form, made in (("csv", "run_csv"), ("mat", "run.mat")):
        ended = testbed("export", "out/run.nc", "--format", form)
        assert (ended.code, ended.out) == (0, f"out/{made}\n")
        assert (tmp_path / "out" / made).exists()
    (tmp_path / "out/run.nc").rename(tmp_path / "out/mine.nc")
    (tmp_path / "out/metrics.json").unlink()  # as after a killed run
    ended = testbed("report", "out/mine.nc")
    assert ended.code == 0, ended.err
    assert ended.out.splitlines()[-1] == "record: out/mine.nc"
    assert (tmp_path / "out/report.html").stat().st_size > 10_000
    assert "ins.aligned_s" in (tmp_path / "out/metrics.json").read_text("utf-8")


def test_what_a_run_remarks_is_said(testbed: Testbed) -> None:
    ended = testbed("run", "u_turn", "--set", "plan=[{leg='straight', length_m=200}]", "--no-report")
    assert ended.code == 0
    assert re.search(r"^testbed: plan flown: the run ends at \d+ s of 200 s$", ended.err, re.MULTILINE)


# --- arguments and progress


@pytest.mark.parametrize(
    ("texts", "varied"),
    [
        ([], {}),
        (["truth.wind.speed_mps=0, 5,10"], {"truth.wind.speed_mps": ["0", "5", "10"]}),
        (["a=[[1,2]],[[3,4],[5,6]]", "b=x"], {"a": ["[[1,2]]", "[[3,4],[5,6]]"], "b": ["x"]}),
        (["a={p=1,q=2},\"x,y\",'],'"], {"a": ["{p=1,q=2}", '"x,y"', "'],'"]}),
    ],
)
def test_parse_vary(texts: Sequence[str], varied: dict[str, list[str]]) -> None:
    assert cli.parse_vary(texts) == varied


@pytest.mark.parametrize("texts", [["a"], ["a="], ["=1"], ["a=1,,2"], ["a=1,"], ["a=1", "a=2"]])
def test_parse_vary_refuses(texts: Sequence[str]) -> None:
    with pytest.raises(UserError, match=r"--vary a|--vary =1"):
        cli.parse_vary(texts)


def told(console: Console) -> None:
    with progress.shown(console, "a title [with] brackets") as tell:
        for k in range(101):
            now = links.Progress(36.0 * k, 3600.0, 87.65, "GNSS denied" if 30 <= k < 60 else "leg [2]")
            tell(*progress.of_run(now))


def test_progress_on_a_pipe_is_a_line_now_and_then() -> None:
    out = io.StringIO()
    told(Console(file=out))
    lines = out.getvalue().splitlines()
    assert [int(line.split("%")[0]) for line in lines] == list(range(10, 101, 10))
    assert " 50 %  30:00 of 1:00:00  87.7 × real time  GNSS denied" in lines
    assert lines[-1] == "100 %  1:00:00 of 1:00:00  87.7 × real time  leg [2]"


def test_progress_on_a_terminal_is_a_bar() -> None:
    out = io.StringIO()
    told(Console(file=out, force_terminal=True, width=120))
    assert "a title [with] brackets" in out.getvalue()
    assert "1:00:00 of 1:00:00  87.7 × real time  leg [2]" in out.getvalue()


def remaining(monkeypatch: pytest.MonkeyPatch, points: Iterable[tuple[float, float]]) -> list[str]:
    """What is told, to whoever reads along in a pipe, of wall times [s] and fractions that are done then."""
    clock = [0.0]
    monkeypatch.setattr("testbed.many.progress.time", SimpleNamespace(monotonic=lambda: clock[0]))
    out = io.StringIO()
    with progress.shown(Console(file=out), "a title") as tell:
        for clock[0], fraction in points:
            tell(fraction, "0/1000 runs")
    return out.getvalue().splitlines()


def test_how_long_the_rest_takes_is_told_before_the_first_of_many_long_runs_is_in(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nothing was said before half a percent of the whole was done."""
    pace = 1e-6  # of 1000 runs, one in 1000 s
    lines = remaining(monkeypatch, [(t, pace * max(t - 8, 0)) for t in range(31)])
    assert lines[:2] == ["  0 %  0/1000 runs", "  0 %  0/1000 runs"]  # it starts
    assert set(lines[2:]) == {"  0 %  0/1000 runs  about 12 days to go"}
    assert len(lines) == 6


def test_a_halt_is_not_told_as_the_pace_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kernels are compiled after the first rows of a run: 40 s without a step are soon behind it."""
    lines = remaining(monkeypatch, [(t, 1e-5 if 1 <= t < 41 else 1e-4 * max(t - 40, 0)) for t in range(201)])
    assert lines[2:7] == ["  0 %  0/1000 runs"] * 5
    assert lines[-1] == "  2 %  0/1000 runs  about 3 h to go"


def test_own_files_are_named_before_a_run_and_left(testbed: Testbed, tmp_path: Path) -> None:
    mine = [tmp_path / name for name in ("flight.png", "ins_biases.png", "report.html", "photo.png")]
    for path in mine:
        path.write_text("mine")
    ended = testbed("run", "static_bench", "--out", ".")
    assert ended.code == 2
    assert ended.err.startswith("testbed: .: there is report.html, flight.png, ins_biases.png already, not made by")
    assert not (tmp_path / "run.nc").exists()
    ended = testbed("run", "static_bench", *QUICK, "--out", ".", "--force")
    assert ended.code == 0, ended.err
    assert {path.read_text() for path in mine} == {"mine"}


def test_what_a_file_name_may_hold_is_not_obeyed_by_the_terminal(testbed: Testbed) -> None:
    ended = testbed("report", "\x1b[31mred.nc")
    assert (ended.code, ended.err.startswith(r"testbed: \x1b[31mred.nc: no such file")) == (2, True)
    ended = testbed("run", "two\nlines.toml")
    assert (ended.code, ended.err.startswith(r"testbed: two\nlines.toml: no such file")) == (2, True)
    assert len(ended.err.splitlines()) == 1


def test_each_mistake_of_a_scenario_is_a_line_whatever_its_file_is_called(tmp_path: Path) -> None:
    with pytest.raises(UserError) as told:
        Scenario.parse("title = 3", path=tmp_path / "two\nlines.toml")
    lines = str(told.value).splitlines()
    assert len(lines) == len(told.value.args) > 1
    assert all(r"two\nlines.toml" in line for line in lines)
    within = str(told.value.within("run.nc")).splitlines()
    assert within == [f"run.nc: {lines[0]}", *lines[1:]]
