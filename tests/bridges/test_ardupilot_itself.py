"""ArduPlane itself on the bridge, where the environment says where it is: ARDUPLANE_EXECUTABLE=…/sitl/bin/arduplane."""

from __future__ import annotations

import os
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
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


class Station(autopilots.Station):
    """Loads a mission, arms as soon as it may, and has it flown."""

    def __init__(self, mission: Path) -> None:
        super().__init__(autopilots.free_port(socket.SOCK_DGRAM))
        rows = [line.split("\t") for line in mission.read_text().splitlines()[1:]]
        self._items = [(int(row[2]), int(row[3]), [float(value) for value in row[4:11]]) for row in rows]
        self.fixes: set[int] = set()  # kinds that it said it has, while armed
        self.start()

    def run(self) -> None:
        if self.hear("HEARTBEAT", 120.0) is None:
            return
        # It is refused until its store is open.
        while not self.over.is_set() and self.send(self._items) != mav.MAV_MISSION_ACCEPTED:
            time.sleep(0.1)
        # Armed first: one that enters AUTO before it knows where it is takes the sea for its home.
        for command, *values in (
            (mav.MAV_CMD_COMPONENT_ARM_DISARM, 1),
            (mav.MAV_CMD_DO_SET_MODE, mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, AUTO),
        ):
            while not self.over.is_set() and not self.command(command, *values):
                time.sleep(0.1)
        while not self.over.is_set():
            if (message := self.hear("GPS_RAW_INT", 1.0)) is not None:
                self.fixes.add(int(message.fix_type))


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
