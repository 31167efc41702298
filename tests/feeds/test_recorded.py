"""A recorded flight is a feed like the simulated one: same samples, same estimates; denial and faults act alike."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from worlds.loop import same
from worlds.recordings import log_of

from testbed import Scenario, run
from testbed.loop.loop import RunResult
from testbed.score import metrics

FLIGHT = {
    "duration_s": 30,
    "sensors.gnss.settle_factor": 1.0,
    "sensors.gnss.denied": [],
}
ESTIMATORS = """
[[estimator]]
name = "fed"
kind = "federated"
gust_mps = 1.0
locals = [{ name = "gnss", aids = ["gnss"] }, { name = "air", aids = ["barometer", "airspeed"] }]

[[estimator]]
name = "ahrs"
kind = "ahrs"
gust_mps = 1.0
aids = ["magnetometer", "airspeed", "barometer"]
"""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, RunResult]:
    """A clean flight with three estimators: its text, and what came of it."""
    text = Scenario.load("u_turn").text + ESTIMATORS
    return text, fly(text, FLIGHT, tmp_path_factory.mktemp("flown"))


def fly(text: str, changes: Mapping[str, Any], folder: Path) -> RunResult:
    path = folder / "flight.toml"
    path.write_text(text, "utf-8")
    return run(Scenario.load(path, changes), out=folder)


def again(flown: RunResult, text: str, changes: Mapping[str, Any], folder: Path) -> RunResult:
    """The same scenario with the record in place of its motion."""
    assert flown.path is not None
    return fly(log_of(text, flown.path / "run.nc", 'aircraft = "loiter"'), {**FLIGHT, **changes}, folder)


def test_a_record_as_log_gives_every_estimate_bit_for_bit(flown: tuple[str, RunResult], tmp_path: Path) -> None:
    text, first = flown
    second = again(first, text, {}, tmp_path)
    for group in ("estimators", "sensors"):
        assert same(first.dataset[group], second.dataset[group]), group
    scores = metrics.compute(first.dataset, settling_s=10.0)
    mine = {key: value for key, value in scores.items() if not key.startswith("flight.")}
    assert len(mine) > 100
    assert metrics.compute(second.dataset, settling_s=10.0) == mine
    assert second.dataset.attrs["reference"] == "simulated truth"


@pytest.mark.parametrize(
    "changes",
    [
        {"sensors.gnss.denied": [[15, 20]]},
        {"sensors.gnss.jammers": [{"lat_deg": 47.0, "lon_deg": 8.0, "radius_m": 2e4}]},
        {
            "fault": [
                {"sensor": "gnss", "kind": "drag_off", "window": [10, 25], "bearing_deg": 90.0, "velocity_mps": 2.0},
                {"sensor": "imu", "kind": "step", "channel": "gyro_x", "window": [15, 25], "size": 0.5},
                {"sensor": "barometer", "kind": "dropout", "window": [8, 14]},
            ]
        },
    ],
    ids=["denied", "jammed", "faults"],
)
def test_denial_and_faults_act_on_a_log_as_on_a_simulation(
    flown: tuple[str, RunResult], changes: dict[str, Any], tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    text, first = flown
    simulated = fly(text, {**FLIGHT, **changes}, tmp_path)
    recorded = again(first, text, changes, tmp_path_factory.mktemp("again"))
    assert not same(first.dataset["estimators"], simulated.dataset["estimators"])
    assert same(simulated.dataset["estimators"], recorded.dataset["estimators"])
    assert same(simulated.dataset["sensors"], recorded.dataset["sensors"])
