"""The README: every command parses, the quick ones run, every scenario flies, every Python block runs."""

from __future__ import annotations

import importlib.util
import re
import shlex
import sys
from pathlib import Path
from typing import get_args

import pytest
import typer

import testbed.__main__ as cli
from testbed import Scenario, run
from testbed.motion.modes import modes_table
from testbed.sensors import imu
from testbed.sensors.faults import CHANNELS, FaultConfig

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text("utf-8")
QUICK = ["--set", "duration_s=3", "--no-report"]
QUICK_COMMANDS = ("scenarios", "run", "report", "export")  # the others have tests of their own


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)


LINES = [shlex.split(line, comments=True) for block in blocks("sh") for line in block.splitlines()]
WHOLE = [text for text in blocks("toml") if text.startswith("title")]
COMMANDS = [line[1:] for line in LINES if line[0] == "testbed"]
SCRIPTS = [line[1:] for line in LINES if line[0] == "python"]


def test_there_is_something_to_test() -> None:
    assert {command[0] for command in COMMANDS} == {
        "scenarios", "run", "check", "report", "export", "campaign", "papers", "watch"
    }  # fmt: skip
    assert SCRIPTS
    assert blocks("toml")
    assert len(blocks("python")) == 2
    assert all(line[0] in ("testbed", "python", "make", "mavproxy.py") for line in LINES)


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_command_parses(command: list[str]) -> None:
    group = typer.main.get_command(cli.app)
    name, *arguments = cli._explicit_realtime(command)
    parsed = group.get_command(group.make_context("testbed", [name]), name).make_context(name, arguments).params  # type: ignore[attr-defined]
    for scenario in parsed.get("names") or filter(None, [parsed.get("scenario")]):
        Scenario.load(scenario, parsed.get("overrides") or ())


def test_quick_commands_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    made = {"run": "runs/*/run.nc", "report": "runs/u_turn/report.html", "export": "runs/u_turn/run_csv/*.csv"}
    for command in COMMANDS:
        if command[0] not in QUICK_COMMANDS:
            continue
        shortened = [*command, *QUICK] if command[0] == "run" else command
        monkeypatch.setattr(sys, "argv", ["testbed", *shortened])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        assert not ended.value.code, command
        if command[0] in made:
            assert list(tmp_path.glob(made[command[0]])), command
    assert (tmp_path / "runs/third/run.nc").exists()


@pytest.mark.parametrize("script", SCRIPTS, ids=" ".join)
def test_script_parses(script: list[str]) -> None:
    path, *arguments = script
    spec = importlib.util.spec_from_file_location("script", ROOT / path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.parser().parse_args(arguments)


def test_make_targets_exist() -> None:
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert set(re.findall(r"`?make ([a-z-]+)", README)) <= set(targets)


@pytest.mark.parametrize("text", WHOLE)
def test_scenario_flies(text: str) -> None:
    assert Scenario.parse(text).duration_s > 200
    scenario = Scenario.parse(text, ["duration_s=20", "sensors.gnss.denied=[[12, 15]]"])
    result = run(scenario)
    for estimator in scenario.estimator:
        assert result.metrics[f"{estimator.name}.aligned_s"] < 10


def test_parts_of_scenarios_fit_into_one() -> None:
    parts = [text for text in blocks("toml") if text not in WHOLE]
    assert parts
    alone = Scenario.parse(WHOLE[0])
    for part in parts:
        both = Scenario.parse(f"{WHOLE[0]}\n{part}")
        more = len(both.fault) + len(both.estimator) - len(alone.fault) - len(alone.estimator)
        assert more > 0 or both.autopilot != alone.autopilot


def test_faults_are_those_of_the_code() -> None:
    section = README[README.index("### Faults") :]
    section = section[: section.index("\n## ")]
    rows = [row.split(" | ") for row in re.findall(r"^\| (`.*) \|$", section, re.MULTILINE)]
    kinds = [name for row in rows for name in re.findall(r"`(\w+)`", row[0]) if name not in CHANNELS]
    assert sorted(kinds) == sorted(get_args(kind.model_fields["kind"].annotation)[0] for kind in get_args(FaultConfig))
    told = {name: row[1] for row in rows for name in re.findall(r"`(\w+)`", row[0]) if name in CHANNELS}
    for sensor, channels in CHANNELS.items():
        between = {"gyro_y", "accel_y"}  # "gyro_x to gyro_z"
        assert set(channels) - between <= set(re.findall(r"`(\w+)`", told[sensor])), sensor
        assert all(unit in told[sensor] for channel in channels.values() for unit in channel.units)


@pytest.mark.parametrize("code", blocks("python"))
def test_python_runs(code: str, capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(code, "README.md", "exec"), {})
    assert capsys.readouterr().out


def test_grades_are_those_of_the_sensors() -> None:
    rows = re.findall(r"^\| `([a-z-]+)` \| ([\d.]+), ([\d.]+) deg/h \| ([\d.]+) .* \| ([\d.]+), ([\d.]+) mg \| ([\d.]+) ", README, re.MULTILINE)  # fmt: skip # noqa: E501
    assert {name for name, *_ in rows} == set(imu.GRADES) - {"perfect"}
    keys = (
        "gyro_turn_on_degph", "gyro_instability_degph", "angle_random_walk_degprth",
        "accel_turn_on_mg", "accel_instability_mg", "velocity_random_walk_mpsprth",
    )  # fmt: skip
    for name, *figures in rows:
        assert [float(figure) for figure in figures] == [imu.GRADES[name][key] for key in keys]


@pytest.mark.slow
def test_modes_are_those_of_the_aircraft() -> None:
    def numbers(table: str) -> list[float]:
        return [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?", table)]

    table = modes_table()
    start = README.index(table.splitlines()[0])
    stated = README[start : README.index("\n\n", start)]
    assert numbers(stated) == pytest.approx(numbers(table), rel=0.02, abs=0.002)
