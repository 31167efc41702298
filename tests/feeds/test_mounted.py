"""A unit that a scenario says is mounted otherwise than its vehicle lies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from testbed import Scenario, run
from testbed.__main__ import app

RESTS_S = 60.0
SCENARIO = """
title = "upside down"
duration_s = 60
date = 2024-06-01
[truth]
source = "log"
file = "a.npz"
columns.imu = { time = "t", gyro = "w", accel = "f" }
columns.gnss = { time = "gt", lat = "lat", lon = "lon", height = "h", velocity = "v" }
columns.reference = { time = "gt", lat = "lat", lon = "lon", height = "h", velocity = "v", attitude = "rpy" }
[sensors.imu]
%s
[sensors.gnss]
lever_arm_m = [0.3, 0.0, 0.0]
[[estimator]]
name = "ins"
aids = ["gnss"]
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A level vehicle at rest, whose unit hangs upside down."""
    t, fixed = np.arange(0.0, RESTS_S, 0.01), np.arange(0.0, RESTS_S, 0.2)
    noise = np.random.default_rng(60).standard_normal((2, len(t), 3))
    place = {"lat": np.full(len(fixed), 0.8), "lon": np.full(len(fixed), 0.1), "h": np.full(len(fixed), 500.0)}
    known: dict[str, Any] = {"v": np.zeros((len(fixed), 3)), "rpy": np.zeros((len(fixed), 3))}
    force = np.array([0.0, 0.0, 9.81]) + 0.02 * noise[1]
    np.savez(tmp_path / "a.npz", t=t, w=1e-4 * noise[0], f=force, gt=fixed, **place, **known)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("told", [True, False])
def test_what_is_told_of_it_is_known_to_whoever_looks_for_mistakes(told: bool, folder: Path) -> None:
    """Beside estimates that were right it was said that the reference lies 178 deg otherwise than the unit feels."""
    (folder / "a.toml").write_text(SCENARIO % ("mounting_deg = [180, 0, 0]" if told else ""))
    remarks = "; ".join(run(Scenario.load(folder / "a.toml")).remarks)
    said = CliRunner().invoke(app, ["log", "a.toml", "--scenario", "draft.toml"], env={"COLUMNS": "500"}).output
    for words in ("on its back", "deg apart"):
        assert (words in remarks) != told
        assert (words in said) != told
    drafted = Scenario.load(folder / "draft.toml").sensors
    assert tuple(drafted["imu"].mounting_deg) == ((180.0, 0.0, 0.0) if told else (0.0, 0.0, 0.0))
    assert tuple(drafted["gnss"].lever_arm_m) == (0.3, 0.0, 0.0)
