"""PX4 itself on the bridge, where the environment says where it is: PX4_EXECUTABLE=…/build/px4_sitl_default/bin/px4."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mav

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


class Station(threading.Thread):
    """A ground station that loads parameters and a mission, sets the mode, and arms as soon as it may."""

    def __init__(self, plan: Path, parameters: Path) -> None:
        super().__init__(daemon=True)
        self._items = json.loads(plan.read_text())["mission"]["items"]
        rows = (line.split("\t") for line in parameters.read_text().splitlines() if not line.startswith("#"))
        self._parameters = [(name, value, int(kind)) for _, _, name, value, kind in rows]
        self._link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{14540 + INSTANCE}", source_system=255)
        self.over = threading.Event()
        self.refused: list[str] = []
        self.start()

    def run(self) -> None:
        if self._hear("HEARTBEAT", 120.0) is None:
            return
        for name, value, kind in self._parameters:
            self._set(name, value, kind)
        self._send_mission()
        while not self.over.is_set():
            self._command(mav.MAV_CMD_DO_SET_MODE, 1, *MISSION_MODE)
            if self._command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1):
                return

    def close(self) -> None:
        self.over.set()
        self.join()
        self._link.close()

    def _hear(self, name: str, seconds: float, is_it: Callable[[Any], bool] = lambda _: True) -> Any:
        until = time.monotonic() + seconds
        while time.monotonic() < until and not self.over.is_set():
            self._link.mav.heartbeat_send(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, 0)
            message = self._link.recv_match(type=name.split("|"), blocking=True, timeout=0.1)
            if message is not None and is_it(message):
                return message
        return None

    def _set(self, name: str, value: str, kind: int) -> None:
        number = (
            float(value) if kind == mav.MAV_PARAM_TYPE_REAL32 else struct.unpack("<f", struct.pack("<i", int(value)))[0]
        )
        for _ in range(5):
            self._link.mav.param_set_send(SYSTEM, 1, name.encode(), number, kind)
            answer = self._hear("PARAM_VALUE", 1.0, lambda one: one.param_id == name)
            if answer is not None and struct.pack("<f", answer.param_value) == struct.pack("<f", number):
                return
        self.refused.append(name)

    def _send_mission(self) -> None:
        self._link.mav.mission_count_send(SYSTEM, 1, len(self._items))
        while (asked := self._hear("MISSION_REQUEST_INT|MISSION_REQUEST|MISSION_ACK", 5.0)) is not None:
            if asked.get_type() == "MISSION_ACK":
                if asked.type != mav.MAV_MISSION_ACCEPTED:
                    self.refused.append(f"mission {asked.type}")
                return
            one = self._items[asked.seq]
            *how, lat, lon, h = one["params"]
            place = round(lat * 1e7), round(lon * 1e7), h
            self._link.mav.mission_item_int_send(SYSTEM, 1, asked.seq, one["frame"], one["command"], 0, 1, *how, *place)
        self.refused.append("mission")

    def _command(self, command: int, *values: float) -> bool:
        padded = [*values, *[0.0] * (7 - len(values))]
        self._link.mav.command_long_send(SYSTEM, 1, command, 0, *padded)
        answer = self._hear("COMMAND_ACK", 2.0, lambda one: one.command == command)
        return answer is not None and answer.result == mav.MAV_RESULT_ACCEPTED


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
