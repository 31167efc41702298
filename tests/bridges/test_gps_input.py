"""Our fixes go to ArduPilot as GPS_INPUT: each as it is, and no bit of the run is another for it."""

from __future__ import annotations

import datetime as dt
import json
import socket

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mav
from worlds import autopilots
from worlds.loop import same

from nav.samples import FixType, GnssSample
from testbed import RunResult, Scenario, run
from testbed.bridges.ardupilot import ArduPilot
from testbed.bridges.gps_input import GpsInput
from testbed.bridges.steps import Step
from testbed.errors import UserError
from testbed.motion.table import TruthBlock

DENIED = (4.0, 7.0)
DATE = dt.date(2026, 6, 1)


def scenario() -> Scenario:
    changes = {"duration_s": 10.0, "date": DATE, "sensors.gnss.denied": [list(DENIED)], "sensors.gnss.latency_s": 0.15}
    step = {"name": "step", "sensor": "gnss", "channel": "east", "kind": "step", "window": [8, 9], "size": 40.0}
    return Scenario.load("kinematic_u_flight", {**changes, "fault": [step]})


@pytest.fixture(scope="module")
def told() -> tuple[RunResult, list[mav.MAVLink_gps_input_message]]:
    peer, ear = autopilots.ArduPilot(), autopilots.Ear()
    try:
        fixes = GpsInput(ear.url, ["gnss"], DATE)
        result = run(scenario(), far_end=ArduPilot(peer.url, fixes=fixes))
    finally:
        peer.over.set()
    assert result.failure == ""
    return result, ear.heard()


@pytest.mark.ci
def test_every_epoch_is_told_as_it_is(told: tuple[RunResult, list[mav.MAVLink_gps_input_message]]) -> None:
    result, messages = told
    own = result.dataset["sensors/gnss"].to_dataset()
    own = own.isel(time=own["t_arrival"].values <= 10.0)
    assert len(messages) == len(own["time"])
    midnight = dt.datetime.combine(DATE, dt.time(), dt.UTC).timestamp()
    for k, message in enumerate(messages):
        one = own.isel(time=k)
        t = float(one["time"])
        assert message.get_type() == "GPS_INPUT"
        assert message.gps_id == 0
        assert message.time_usec == pytest.approx((midnight + t) * 1e6, abs=0.6)
        since_1980 = message.time_week * 604_800 + message.time_week_ms / 1e3  # GPS time is 18 s ahead
        assert since_1980 == pytest.approx(midnight + t - 315_964_800 + 18, abs=6e-4)
        assert message.fix_type == int(one["fix_type"])
        if message.fix_type < FixType.FIX_3D:
            continue
        assert message.lat == pytest.approx(np.degrees(float(one["lat"])) * 1e7, abs=0.51)
        assert message.lon == pytest.approx(np.degrees(float(one["lon"])) * 1e7, abs=0.51)
        assert message.alt == pytest.approx(float(one["h"]), rel=1e-7)
        np.testing.assert_allclose([message.vn, message.ve, message.vd], one["v_n"].values, rtol=1e-7)
        sigma, speed = one["sigma_position_n"].values, one["sigma_velocity_n"].values
        assert message.horiz_accuracy == pytest.approx(np.hypot(*sigma[:2]), rel=1e-6)
        assert message.vert_accuracy == pytest.approx(sigma[2], rel=1e-6)
        assert message.speed_accuracy == pytest.approx(np.linalg.norm(speed), rel=1e-6)
        assert (message.hdop, message.vdop) == pytest.approx((float(one["hdop"]), float(one["vdop"])), rel=1e-6)
        assert (message.satellites_visible, message.ignore_flags, message.yaw) == (int(one["satellites"]), 0, 0)


@pytest.mark.ci
def test_where_it_is_denied_it_only_says_that_there_is_no_fix(
    told: tuple[RunResult, list[mav.MAVLink_gps_input_message]],
) -> None:
    start = dt.datetime.combine(DATE, dt.time(), dt.UTC).timestamp()
    inside = [m for m in told[1] if DENIED[0] <= m.time_usec / 1e6 - start < DENIED[1]]
    assert len(inside) > 10
    assert {(m.fix_type, m.lat, m.lon, m.alt, m.vn, m.ignore_flags) for m in inside} == {(1, 0, 0, 0, 0, 255)}


@pytest.mark.ci
def test_the_run_is_what_it_is_without_and_says_whose_sensors_were_whose(
    told: tuple[RunResult, list[mav.MAVLink_gps_input_message]],
) -> None:
    result, alone = told[0].dataset, run(scenario()).dataset
    assert same(result, alone)
    assert "far_end" not in alone.attrs
    said = json.loads(result.attrs["far_end"])
    assert (said["name"], said["flies"], said["failure"]) == ("ArduPilot", False, "")
    ours = [kind for kind, whose in said["sensors"].items() if whose == "ours"]
    theirs = [kind for kind, whose in said["sensors"].items() if whose == "theirs"]
    assert (ours, theirs) == (["imu", "airspeed", "gnss"], ["magnetometer", "barometer"])


def epoch(sensor: str) -> Step:
    zero = np.zeros(3)
    fix = GnssSample(1.0, 1.1, 0.5, 1.0, 100.0, zero, zero + 1, zero + 1, FixType.FIX_3D, 9, 1.0, 1.0, sensor)
    return Step(1.1, 0.005, zero, zero, {sensor: fix}, TruthBlock.empty(0, 0))


def test_over_tcp_it_may_begin_to_listen_later() -> None:
    port = autopilots.free_port(socket.SOCK_STREAM)
    fixes = GpsInput(f"tcp:127.0.0.1:{port}", ["left", "right"], DATE)
    fixes.tell(epoch("left"))  # lost
    with socket.create_server(("127.0.0.1", port)) as server:
        fixes.tell(epoch("right"))
        peer, _ = server.accept()
        with peer:
            (message,) = mav.MAVLink(None).parse_buffer(peer.recv(4096))
    fixes.close()
    assert (message.get_type(), message.gps_id, fixes.failure) == ("GPS_INPUT", 1, "")


def test_whoever_speaks_first_is_told() -> None:
    port, ear = autopilots.free_port(socket.SOCK_DGRAM), autopilots.Ear()
    fixes = GpsInput(f"udpin:127.0.0.1:{port}", ["gnss"], DATE)
    fixes.tell(epoch("gnss"))  # lost
    ear.speak(port)
    fixes.tell(epoch("gnss"))
    fixes.close()
    assert [message.get_type() for message in ear.heard()] == ["GPS_INPUT"]


def test_nobody_is_there_to_take_them() -> None:
    url = f"udpin:127.0.0.1:{autopilots.free_port(socket.SOCK_DGRAM)}"
    fixes = GpsInput(url, ["gnss"], DATE, connect_s=0.0)
    fixes.tell(epoch("third"))  # of a receiver that is not told
    assert fixes.failure == ""
    fixes.tell(epoch("gnss"))
    fixes.close()
    assert "no MAVLink of ArduPilot there for 0 s" in fixes.failure
    with pytest.raises(UserError, match=r"run\.tlog: nobody reads a log while it is written"):
        GpsInput("run.tlog", ["gnss"], DATE)
    with pytest.raises(UserError, match="udp: not a MAVLink address"):
        GpsInput("udp", ["gnss"], DATE)
