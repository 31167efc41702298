"""ArduPlane itself on the bridge, where the environment says where it is: ARDUPLANE_EXECUTABLE=…/sitl/bin/arduplane."""

from __future__ import annotations

import os
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mav
from worlds import autopilots

from testbed import Scenario, run
from testbed.bridges import files
from testbed.bridges.ardupilot import ArduPilot
from testbed.bridges.gps_input import GpsInput

EXECUTABLE = os.environ.get("ARDUPLANE_EXECUTABLE", "")
INSTANCE = 7  # not one that somebody else may have started
START = "47.0,8.0,300,300"  # of the scenario
AUTO = 10  # a mode of ArduPlane
DENIED_S = [150, 190]
HEIGHT_M = 20.0  # off the plan

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not EXECUTABLE, reason="ARDUPLANE_EXECUTABLE does not say where ArduPlane's sitl build is"),
]


class Station(threading.Thread):
    """A ground station that loads a mission, arms as soon as it may, and has it flown."""

    def __init__(self, mission: Path) -> None:
        super().__init__(daemon=True)
        self._rows = [line.split("\t") for line in mission.read_text().splitlines()[1:]]
        self.port = autopilots.free_port(socket.SOCK_DGRAM)
        self._link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{self.port}", source_system=255)
        self.over = threading.Event()
        self.fixes: set[int] = set()  # kinds that it said it has, while armed
        self.start()

    def run(self) -> None:
        if self._hear("HEARTBEAT", 120.0) is None:
            return
        while not self._sent_mission() and not self.over.is_set():  # it is refused until its store is open
            time.sleep(0.1)
        # Armed first: one that enters AUTO before it knows where it is takes the sea for its home.
        for command, *values in (
            (mav.MAV_CMD_COMPONENT_ARM_DISARM, 1),
            (mav.MAV_CMD_DO_SET_MODE, mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, AUTO),
        ):
            while not self.over.is_set() and not self._command(command, *values):
                time.sleep(0.1)
        while not self.over.is_set():
            if (message := self._hear("GPS_RAW_INT", 1.0)) is not None:
                self.fixes.add(int(message.fix_type))

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

    def _sent_mission(self) -> bool:
        self._link.mav.mission_count_send(1, 1, len(self._rows))
        while (asked := self._hear("MISSION_REQUEST_INT|MISSION_REQUEST|MISSION_ACK", 5.0)) is not None:
            if asked.get_type() == "MISSION_ACK":
                return bool(asked.type == mav.MAV_MISSION_ACCEPTED)
            _, _, frame, command, *numbers, _ = self._rows[asked.seq]
            *how, lat, lon, h = map(float, numbers)
            place = round(lat * 1e7), round(lon * 1e7), h
            self._link.mav.mission_item_int_send(1, 1, asked.seq, int(frame), int(command), 0, 1, *how, *place)
        return False

    def _command(self, command: int, *values: float) -> bool:
        self._link.mav.command_long_send(1, 1, command, 0, *values, *[0.0] * (7 - len(values)))
        answer = self._hear("COMMAND_ACK", 2.0, lambda one: one.command == command)
        return answer is not None and answer.result == mav.MAV_RESULT_ACCEPTED


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    one = Station(files.write(Path("take_off"), "wpl", tmp_path / "take_off.waypoints"))
    yield one
    one.close()


@pytest.fixture
def ardupilot(tmp_path: Path, station: Station) -> Iterator[tuple[str, str]]:
    """ArduPlane, started with our parameters; where it sends its frames, and where it speaks for fixes."""
    parameters = files.write(Path("take_off"), "ardupilot-params", tmp_path / "take_off.parm")
    folder, port = tmp_path / "ardupilot", autopilots.free_port(socket.SOCK_DGRAM)
    folder.mkdir()
    command = [EXECUTABLE, "--wipe", "--instance", str(INSTANCE), "--model", "JSON:127.0.0.1", "--home", START]
    command += ["--defaults", str(parameters)]
    for number, there in enumerate((station.port, port)):
        command += [f"--serial{number}", f"udpclient:127.0.0.1:{there}"]
    command += ["--serial2", "none:"]
    with (folder / "said.txt").open("wb") as said:
        process = subprocess.Popen(command, cwd=folder, stdout=said, stderr=said)
        try:
            yield f"udpin:127.0.0.1:{9002 + 10 * INSTANCE}", f"udpin:127.0.0.1:{port}"
        finally:
            process.kill()
            process.wait()


def test_its_estimator_listens(tmp_path: Path) -> None:
    """Our aircraft flies; what ArduPlane makes of the same samples is scored beside it, an outage included."""
    ports = [autopilots.free_port(socket.SOCK_DGRAM) for _ in range(2)]
    theirs = {"name": "ekf3", "kind": "ardupilot", "address": f"udpin:127.0.0.1:{ports[0]}"}
    ours = {"name": "ins", "aids": ["gnss", "barometer", "magnetometer", "airspeed"]}
    changes = {"duration_s": 330, "sensors.gnss.denied": [[200, 320]], "estimator": [ours, theirs], "expect": {}}
    scenario = Scenario.load("loiter_gnss_outage", changes)
    parameters = files.write(Path("loiter_gnss_outage"), "ardupilot-params", tmp_path / "loiter.parm")
    command = [EXECUTABLE, "--wipe", "--instance", str(INSTANCE), "--model", "JSON:127.0.0.1"]
    command += ["--home", "34.0,108.0,150,30", "--defaults", str(parameters), "--serial2", "none:"]
    for number, port in enumerate(ports):
        command += [f"--serial{number}", f"udpclient:127.0.0.1:{port}"]
    with (tmp_path / "said.txt").open("wb") as said:
        process = subprocess.Popen(command, cwd=tmp_path, stdout=said, stderr=said)
    far_end = None
    try:
        fixes = GpsInput(f"udpin:127.0.0.1:{ports[1]}", ["gnss"], scenario.date)
        far_end = ArduPilot(
            f"udpin:127.0.0.1:{9002 + 10 * INSTANCE}", fixes=fixes, estimators={"ekf3": str(theirs["address"])}
        )
        result = run(scenario, far_end=far_end)
    finally:
        process.kill()
        process.wait()
        if far_end is not None:
            far_end.close()
    assert result.failure == ""
    assert result.metrics["ekf3.position_horizontal_rms_m"] < 3
    assert result.metrics["ekf3.velocity_rms_mps"] < 0.5
    assert 3 < result.metrics["ekf3.outage_position_horizontal_at_60s_m"] < 200  # it dead-reckons, as it is armed


def test_it_takes_off_and_flies_the_plan_on_our_fixes(ardupilot: tuple[str, str], station: Station) -> None:
    url, speaks = ardupilot
    scenario = Scenario.load("take_off", {"duration_s": 240, "sensors.gnss.denied": [DENIED_S], "expect": {}})
    far_end = ArduPilot(url, flies=True, fixes=GpsInput(speaks, ["gnss"], scenario.date))
    try:
        result = run(scenario, far_end=far_end)
    finally:
        far_end.close()
    assert result.failure == ""
    assert far_end.answered == len(result.dataset["sensors/imu/time"])
    assert "launch" in list(result.dataset["events/text"].values)
    assert station.fixes == {1, 3}
    truth = result.dataset["truth"]
    late = truth["time"].values > 140
    assert np.abs(truth["h"].values[late] - 380).max() < HEIGHT_M
    assert result.metrics["flight.stall_margin_min_mps"] > 0
    assert result.metrics["ins.position_horizontal_rms_m"] < 5  # our estimators watch
