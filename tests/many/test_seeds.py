"""What follows the seed of a recorded flight, and that the same run is not taken for two draws."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import testbed
from testbed import Scenario, run
from testbed.__main__ import app
from testbed.many import seeds
from testbed.many.campaign import Plan, campaign, fly
from testbed.report import campaign as campaign_report
from testbed.results import REPORT

SHORT: dict[str, Any] = {"duration_s": 65, "expect": {}, "sensors.gnss.denied": []}
NOISE = {"sensor": "barometer", "channel": "pressure", "kind": "noise", "factor": 3.0, "window": [20, 40]}
STEP = {"sensor": "barometer", "channel": "pressure", "kind": "step", "size": 50.0, "window": [20, 40]}
HANDOVER = {"level_deg": 0.2, "heading_deg": 2.0, "velocity_mps": 0.1, "position_m": 2.0}
SAME = "nothing in a recorded flight follows the seed: all runs and draws would be the same, one is flown"


def recorded(**changes: Any) -> Scenario:
    return Scenario.load("recorded_flight", SHORT | changes)


@pytest.mark.ci
@pytest.mark.parametrize("changes", [
    {"fault": [STEP]}, {"fault": [NOISE]}, {"estimator.ins.handover": HANDOVER, "truth.start_s": 30},
])  # fmt: skip
def test_a_recorded_flight_follows_the_seed_where_it_is_said_to(changes: dict[str, Any]) -> None:
    scenario = recorded(**changes)
    one, other = (
        {key: value for key, value in run(scenario, seed=seed).metrics.items() if not key.startswith("run.")}
        for seed in (0, 1)
    )
    assert (one != other) is seeds.matter(scenario)


def test_what_is_simulated_or_of_the_users_may_follow_the_seed() -> None:
    own = {"name": "own", "kind": "tests.seeds:Own", "imu": "imu"}
    scenario = recorded()
    assert not seeds.matter(scenario)
    assert seeds.matter(Scenario.load("u_turn"))
    section: Any = seeds.CustomSection.model_construct(**own)
    assert seeds.matter(scenario.model_copy(update={"estimator": (section,)}))


def test_it_is_said_of_how_many_combinations() -> None:
    still, drawn = recorded(), recorded(fault=[NOISE])
    assert seeds.remarks([still], 1, 0) == seeds.remarks([drawn, Scenario.load("u_turn")], 5, 3) == []
    assert seeds.remarks([still], 2, 0) == seeds.remarks([still], 1, 3) == [SAME]
    assert seeds.remarks([still, still], 2, 0) == [SAME.replace("one is", "one of each value is")]
    (some,) = seeds.remarks([still, drawn, drawn], 2, 0)
    assert "follows the seed in 1 of 3 combinations of values: " in some


@pytest.mark.ci
def test_the_same_run_is_flown_once_and_that_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two runs of a value were two independent draws: "+0.149 ± 0.000", and the NEES had bounds for two."""
    monkeypatch.chdir(tmp_path)
    values = ["--vary", "fault=[],[{sensor='gnss',kind='dropout',window=[20,25]}]"]
    given = ["campaign", "recorded_flight", "--runs", "3", *values, "--out", "out"]
    changed = [part for key, value in SHORT.items() for part in ("--set", f"{key}={json.dumps(value)}")]
    told = CliRunner().invoke(app, [*given, *changed])
    remark = SAME.replace("one is", "one of each value is")
    assert told.exit_code == 0, told.stderr
    assert told.stderr.startswith(f"testbed: {remark}\n")
    assert "/2 runs" in told.stderr
    summary = json.loads(Path("out/campaign.json").read_text("utf-8"))
    assert (summary["runs"], summary["remarks"]) == (2, [remark])
    assert {row["runs"] for row in summary["consistency"]} == {1}
    assert f"{remark}." in Path("out", REPORT).read_text("utf-8")

    other = campaign("recorded_flight", 2, draw=1, overrides=SHORT, workers=1, out="other")
    assert [one.seed for one in other.outcomes] == [1_000_000]
    assert list(other.remarks) == [SAME]
    assert SAME in capsys.readouterr().err


@pytest.mark.ci
def test_a_campaign_with_more_runs_carries_on(tmp_path: Path) -> None:
    """Of the value that draws more are flown, of the other none."""
    overrides = tuple(f"{key}={json.dumps(value)}" for key, value in SHORT.items())
    noise = "[{sensor='barometer',channel='pressure',kind='noise',factor=3.0,window=[20,40]}]"
    flown: list[list[tuple[int, int]]] = []
    said: list[str] = []
    for runs in (1, 2):
        result = fly(Plan("recorded_flight", runs, tmp_path, {"fault": ["[]", noise]}, overrides), 1, say=said.append)
        flown.append([(one.combination, one.seed) for one in result.outcomes])
    assert flown == [[(0, 0), (1, 0)], [(0, 0), (1, 0), (1, 1)]]
    assert said == list(result.remarks) == seeds.remarks([one.scenario for one in result.combinations], 2, 0)
    assert "Mean errors over the runs" in [text.title for text in campaign_report.texts(result)]
    assert testbed.CampaignResult is type(result)
