"""Every shipped scenario loads, flies and keeps its promises."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from testbed import Scenario, measures, run
from testbed.data import data_dir
from testbed.many import check

SCENARIOS = sorted(path.stem for path in data_dir("scenarios").glob("*.toml"))
SHORT_S = 400.0
GOLDEN = Path(__file__).parent / "golden"


def test_the_promised_scenarios_are_shipped() -> None:
    promised = {
        "loiter_gnss_outage",
        "denied_walking_wind",
        "denied_optical_flow",
        "denied_terrain",
        "u_turn",
        "survey_racetrack_wind",
        "jammer_zone",
        "static_bench",
        "take_off",
    }
    promised |= {"loiter_ahrs_denied", "loiter_ahrs_continuous", "loiter_heading", "loiter_fault_tolerant"}
    promised |= {"regression", "hardware_loiter", "hardware_gnss_outage"}
    promised |= {f"closed_loop_{x}" for x in ("gnss_outage", "ahrs_only", "spoofed", "pitot_blocked", "gyro_failed")}
    assert promised <= set(SCENARIOS)


@pytest.mark.parametrize("name", SCENARIOS)
def test_loads_and_says_what_it_shows(name: str) -> None:
    scenario = Scenario.load(name)
    assert scenario.title
    assert scenario.text.startswith("# What this shows")
    assert scenario.expect, "a scenario without [expect] can't fail"


@pytest.mark.ci
@pytest.mark.parametrize("name", SCENARIOS)
def test_all_that_is_recorded_has_a_known_unit(name: str) -> None:
    whole = Scenario.load(name)
    healthy = [f"sensors.{sensor}.denied=[]" for sensor, config in whole.sensors.items() if config.kind == "gnss"]
    recorded = run(Scenario.load(name, ["duration_s=8", "fault=[]", "expect={}", *healthy])).dataset
    units = {
        f"{node.path}/{variable}": values.attrs.get("units")
        for node in recorded.subtree
        for variable, values in node.data_vars.items()
    }
    assert units
    assert not {path for path, unit in units.items() if unit and "unknown" in unit}


def passes_its_check(name: str, out: Path) -> check.Outcome:
    (task,) = check.tasks([name], out, GOLDEN)
    assert (task.golden is not None) == task.scenario.golden, "no golden metrics: testbed check --update"
    outcome = check.fly(task)
    assert not outcome.failed, "\n".join([str(outcome), *(str(row) for row in outcome.rows if not row.sound)])
    return outcome


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=[] if n == "u_turn" else [pytest.mark.ci])
        for n in SCENARIOS
        if Scenario.load(n).duration_s <= SHORT_S
    ],
)
def test_short_scenario_passes_its_check(name: str, tmp_path: Path) -> None:
    outcome = passes_its_check(name, tmp_path)
    if name == "regression":  # which other tests break, and compare with this
        assert {row.verdict for row in outcome.rows} == {"kept", "same"}


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in SCENARIOS if Scenario.load(n).duration_s > SHORT_S])
def test_long_scenario_passes_its_check(name: str, tmp_path: Path) -> None:
    passes_its_check(name, tmp_path)


def test_golden_metrics_are_of_shipped_scenarios_and_known() -> None:
    compared = {name for name in SCENARIOS if Scenario.load(name).golden}
    assert {path.stem for path in GOLDEN.iterdir()} == compared, "testbed check --update, or delete what is left"
    for path in GOLDEN.iterdir():
        golden = check.read_golden(path)
        assert golden
        assert path.read_text("utf-8").count("\n") == len(golden) + 2, "one metric a line"
        assert list(golden) == sorted(golden)
        assert {key for key in golden if measures.find(key) is None} == set()


@pytest.mark.slow
def test_sweep_script(tmp_path: Path) -> None:
    script = data_dir("scenarios") / "sweep_outage.py"
    out = subprocess.run(
        [sys.executable, str(script), "--seeds", "1", "--out", str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )
    assert (tmp_path / "sweep_outage.png").stat().st_size > 10_000
    assert out.stdout.count(" m\n") == 6
