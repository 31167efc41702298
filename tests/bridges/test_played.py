"""A run that was flown from outside is repeated from its record, without who flew it."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray
from worlds import autopilots
from worlds.loop import Watcher, same

import testbed.__main__ as cli
from testbed import Scenario, run
from testbed.bridges.px4 import Px4
from testbed.errors import UserError
from testbed.feeds.played import played
from testbed.record.reader import load, scenario_of

END_S, TAKEN_OVER_S = 5.0, 3.0
TICK_HZ, IMU_HZ = 100.0, 50.0  # so that a chunk may end between two steps


def fly(folder: Path, behaviour: str = "") -> Path:
    changes = {"duration_s": END_S, "truth.rate_hz": TICK_HZ, "sensors.imu.rate_hz": IMU_HZ, "expect": {}}
    one = {"name": "ins", "aids": ["gnss", "barometer", "magnetometer", "airspeed"]}
    scenario = Scenario.load("loiter_gnss_outage", {**changes, "sensors.gnss.denied": [], "estimator": [one]})
    pilot = None if behaviour else autopilots.Circle()
    peer = autopilots.Px4(behaviour, at=round(TAKEN_OVER_S * IMU_HZ), pilot=pilot)
    try:
        run(scenario, far_end=Px4(peer.url, flies=True), out=folder)
    finally:
        peer.over.set()
    return folder / "run.nc"


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fly(tmp_path_factory.mktemp("flown"))


@pytest.mark.ci
def test_what_was_commanded_is_recorded_step_by_step(flown: Path) -> None:
    record = load(flown)
    own = record["far_end"]
    t, flies, surfaces = (own[key].values for key in ("time", "flies", "surfaces"))
    np.testing.assert_allclose(np.diff(t), 1 / IMU_HZ, atol=1e-9)
    assert t[-1] == pytest.approx(END_S)
    assert (flies == (t > TAKEN_OVER_S - 0.1)).mean() > 0.97  # it boots on some of its steps
    assert (np.isfinite(surfaces).all(axis=1) == (flies == 1)).all()
    assert own["surface"].values.tolist() == ["aileron", "elevator", "rudder", "throttle"]
    assert own["surfaces"].attrs["units"] == "1"


@pytest.mark.ci
def test_the_record_is_run_again_bit_for_bit(flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["testbed", "run", str(flown), "--out", str(tmp_path), "--no-report"]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert not ended.value.code
    again, before = load(tmp_path / "run.nc"), load(flown)
    assert same(again, before)
    assert again.attrs["far_end"] == before.attrs["far_end"]


@pytest.mark.ci
def test_a_take_off_by_itself_is_repeated_too(tmp_path: Path) -> None:
    changes = {"duration_s": END_S, "truth.start.rest_s": 3, "truth.rate_hz": TICK_HZ, "expect": {}}
    run(Scenario.load("take_off", {**changes, "sensors.imu.rate_hz": TICK_HZ}), out=tmp_path)
    before = load(tmp_path / "run.nc")
    assert "launch" in before["events/text"].values.tolist()
    assert same(run(scenario_of(before)).dataset, before)


@pytest.mark.ci
def test_watched_live_in_other_chunks_it_has_the_same_bits(flown: Path) -> None:
    class Seldom(Watcher):
        period_s = 0.07

    before = load(flown)
    again = run(scenario_of(before), far_end=played(before), links=[Seldom()], realtime=1000.0)
    assert same(again.dataset, before)


@pytest.mark.ci
def test_beyond_what_was_recorded_nobody_knows(flown: Path) -> None:
    before = load(flown)
    longer = run(scenario_of(before, [f"duration_s={END_S + 1}"]), far_end=played(before))
    assert longer.failure == "the recorded commands of PX4 end here"
    assert longer.dataset["events/time"].values[-1] == pytest.approx(END_S + 1 / IMU_HZ)


@pytest.mark.ci
def test_a_far_end_that_failed_fails_again(tmp_path: Path) -> None:
    before = load(fly(tmp_path, "close"))
    again = run(scenario_of(before), far_end=played(before))
    assert again.failure == "PX4 has closed the connection"
    assert same(again.dataset, before)
    assert json.loads(again.dataset.attrs["far_end"])["failure"] == again.failure


def test_a_record_without_commands_says_so(flown: Path) -> None:
    before = load(flown)
    groups = {path: node.to_dataset() for path, node in before.children.items() if path == "events"}
    old = xarray.DataTree.from_dict({"/": xarray.Dataset(), **groups})
    with pytest.raises(UserError, match="was flown from outside, and kept no commands: it can't be repeated"):
        played(old)
    listened = xarray.DataTree(xarray.Dataset(attrs={"far_end": '{"name": "PX4", "flies": false}'}))
    assert played(listened) is None
    with pytest.raises(UserError, match="damaged record"):
        played(xarray.DataTree(xarray.Dataset(attrs={"far_end": "{"})))


def test_it_is_flown_again_or_anew_but_not_both(
    flown: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["testbed", "run", str(flown), "--px4"])
    with pytest.raises(SystemExit):
        cli.main()
    assert "PX4 flew it: add --pilot to have it flown anew, or let nobody follow" in capsys.readouterr().err
