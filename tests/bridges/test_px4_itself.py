"""PX4 itself on the bridge, where the environment says where it is: PX4_EXECUTABLE=…/build/px4_sitl_default/bin/px4."""

from __future__ import annotations

import json
import os
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mav
from worlds import autopilots

from testbed import Scenario, run
from testbed.bridges import files
from testbed.bridges.px4 import Px4

EXECUTABLE = os.environ.get("PX4_EXECUTABLE", "")
INSTANCE = 7  # not one that somebody else may have started
SYSTEM = INSTANCE + 1
AIRFRAME = "gazebo-classic_plane"
MISSION_MODE = (4, 4)  # main and sub mode
HEIGHT_M = 20.0  # off the plan

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not EXECUTABLE, reason="PX4_EXECUTABLE does not say where PX4's px4_sitl_default build is"),
]


@pytest.fixture
def px4(tmp_path: Path) -> Iterator[str]:
    """PX4, started; where it connects to."""
    program, folder = Path(EXECUTABLE), tmp_path / "px4"
    folder.mkdir()
    environment = os.environ | {"PX4_SIM_MODEL": AIRFRAME, "PX4_PARAM_EKF2_GPS_DELAY": "100"}
    command = [program, "-d", "-i", str(INSTANCE), "-w", folder, program.parent.parent / "etc"]
    with (folder / "said.txt").open("wb") as said:
        process = subprocess.Popen(command, cwd=folder, env=environment, stdout=said, stderr=said)
        try:
            yield f"tcpin:127.0.0.1:{4560 + INSTANCE}"
        finally:
            process.kill()
            process.wait()


class Station(autopilots.Station):
    """Loads parameters and a mission, sets the mode, and arms as soon as it may."""

    def __init__(self, plan: Path, parameters: Path) -> None:
        super().__init__(14540 + INSTANCE, SYSTEM)
        items = json.loads(plan.read_text())["mission"]["items"]
        self._items = [(one["frame"], one["command"], one["params"]) for one in items]
        rows = (line.split("\t") for line in parameters.read_text().splitlines() if not line.startswith("#"))
        self._parameters = [(name, value, int(kind)) for _, _, name, value, kind in rows]
        self.refused: list[str] = []
        self.start()

    def run(self) -> None:
        if self.hear("HEARTBEAT", 120.0) is None:
            return
        for name, value, kind in self._parameters:
            self._set(name, value, kind)
        if (answer := self.send(self._items)) != mav.MAV_MISSION_ACCEPTED:
            self.refused.append(f"mission {answer}")
        while not self.over.is_set():
            self.command(mav.MAV_CMD_DO_SET_MODE, 1, *MISSION_MODE)
            if self.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1):
                return

    def _set(self, name: str, value: str, kind: int) -> None:
        number = (
            float(value) if kind == mav.MAV_PARAM_TYPE_REAL32 else struct.unpack("<f", struct.pack("<i", int(value)))[0]
        )
        for _ in range(5):
            self.link.mav.param_set_send(SYSTEM, 1, name.encode(), number, kind)
            answer = self.hear("PARAM_VALUE", 1.0, lambda one: one.param_id == name)
            if answer is not None and struct.pack("<f", answer.param_value) == struct.pack("<f", number):
                return
        self.refused.append(name)


def test_its_estimator_runs_beside_ours(px4: str) -> None:
    ours = {"name": "ins", "gust_mps": 1.0, "aids": ["gnss", "barometer", "magnetometer", "airspeed"]}
    theirs = {"name": "ekf2", "kind": "px4", "address": f"udpin:127.0.0.1:{14540 + INSTANCE}"}
    changes = {"duration_s": 200, "sensors.gnss.denied": [[120, 180]], "estimator": [ours, theirs], "expect": {}}
    far_end = Px4(px4, estimators={"ekf2": theirs["address"]})
    try:
        result = run(Scenario.load("loiter_gnss_outage", changes), far_end=far_end)
    finally:
        far_end.close()
    assert result.failure == ""
    assert far_end.answered == len(result.dataset["sensors/imu/time"])
    assert far_end.armed
    found = result.metrics
    assert found["ekf2.aligned_s"] < 60
    assert found["ekf2.position_horizontal_rms_m"] < 3
    assert found["ekf2.roll_pitch_rms_deg"] < 1
    assert found["ekf2.outage_position_horizontal_at_60s_m"] < 150  # 27 m and 54 m were seen, 389 m unarmed


def test_it_takes_off_and_flies_the_plan(px4: str, tmp_path: Path) -> None:
    scenario = Scenario.load("take_off", {"duration_s": 180, "expect": {}})
    plan = files.write(Path("take_off"), "plan", tmp_path / "take_off.plan")
    station = Station(plan, files.write(Path("take_off"), "px4-params", tmp_path / "take_off.params"))
    far_end = Px4(px4, flies=True)
    try:
        result = run(scenario, far_end=far_end)
    finally:
        far_end.close()
        station.close()
    assert result.failure == ""
    assert station.refused == []
    assert far_end.answered == len(result.dataset["sensors/imu/time"])
    events = list(result.dataset["events/text"].values)
    assert "launch" in events
    truth = result.dataset["truth"]
    late = truth["time"].values > 120
    assert np.abs(truth["h"].values[late] - 380).max() < HEIGHT_M
    assert result.metrics["flight.stall_margin_min_mps"] > 0
    assert result.metrics["ins.position_horizontal_rms_m"] < 5  # our estimators watch
