"""MAVProxy, a ground station of the ArduPilot family, sees the vehicle whole."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest
from worlds.programs import START_S, Program

from testbed import Scenario

pytestmark = pytest.mark.slow

# Those that ask the vehicle something; others look for windows, or for terrain on the internet.
MODULES = "wp,param,mode,misc,cmdlong,arm,rally,fence"


@pytest.mark.parametrize("identity", ["px4", "ardupilot"])
def test_vehicle_parameters_mission_and_map(
    clients: Path, fly: Callable[..., int], start: Callable[..., Program], identity: str
) -> None:
    port = fly("u_turn", "--mavlink-identity", identity, realtime=2)
    station = start(
        clients / "python", clients / "mavproxy.py", f"--master=udpin:127.0.0.1:{port}",
        "--state-basedir=.", "--aircraft=vehicle", f"--default-modules={MODULES}",
    )  # fmt: skip
    station.expect("Detected vehicle 1:1", START_S)
    station.expect("Mode LOITER" if identity == "px4" else "Mode (LOITER|AUTO)", 5)
    received = int(station.expect(r"Received (\d+) parameters", 20)[1])
    assert received >= 10
    station.say("param show SIM_GPS1_ENABLE")
    assert float(station.expect(r"SIM_GPS1_ENABLE +([\d.]+)", 5)[1]) == 1
    station.say("wp list")
    legs = len(Scenario.load("u_turn").plan)
    assert int(station.expect(r"Requesting (\d+) waypoints", 10)[1]) >= legs
    station.expect(r"Loaded|Saved (\d+) waypoints", 10)
    seen = []
    for _ in range(2):
        station.say("status GLOBAL_POSITION_INT")
        found = station.expect(r"GLOBAL_POSITION_INT \{time_boot_ms : (\d+), lat : (-?\d+), lon : (-?\d+)", 5)
        seen.append([int(number) for number in found.groups()])
        station.say("status SIMSTATE")
        station.expect(r"SIMSTATE \{.*lat : \d+, lng : \d+", 5)
        time.sleep(0.5)
    (t0, lat0, lon0), (t1, lat1, lon1) = seen
    assert t1 > t0
    assert (lat0, lon0) != (lat1, lon1)
    station.say("param set SIM_GPS1_ENABLE 0")
    station.expect("AP: gnss silent", 3)
    station.say("param set SIM_GPS1_ENABLE 1")
    station.expect("AP: gnss (heard again|reacquired)", 3)
