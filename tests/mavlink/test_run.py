"""A whole run watched by a ground station: what it heard is what the run file says."""

import collections
import math
import socket
import threading

import numpy as np
import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import all as mav
from scipy.spatial.transform import Rotation
from worlds.mavlink import read_log

from testbed import Scenario, run
from testbed.feeds import build
from testbed.mavlink import MavlinkPublisher

SECONDS = 12
DENIED = (4.0, 8.0)


@pytest.fixture(scope="module")
def watched(tmp_path_factory):
    """(what a station heard on loopback UDP, what the log holds, the run's dataset) of a short flight."""
    folder = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        patch.setenv("MAVLINK20", "1")
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
        probe.close()
        station = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", dialect="all")
        over = threading.Event()
        heard = collections.defaultdict(list)

        def listen():
            while not over.is_set():
                while message := station.recv_match(blocking=True, timeout=0.2):
                    heard[message.get_type()].append(message)

        thread = threading.Thread(target=listen, daemon=True)
        thread.start()
        scenario = Scenario.load(
            "u_turn",
            [
                f"duration_s={SECONDS}",
                f"sensors.gnss.denied=[[{DENIED[0]},{DENIED[1]}]]",
                "sensors.gnss.reacquire_s=1.0",
            ],
        )
        log = folder / "run.tlog"
        publisher = MavlinkPublisher([f"udpout:127.0.0.1:{port}", f"tlog:{log}"], scenario)
        try:
            result = run(scenario, links=[publisher], realtime=5.0)
        finally:
            over.set()
            thread.join(5.0)
            station.close()
        reader = mavutil.mavlink_connection(str(log), dialect="all")
        logged = collections.defaultdict(list)
        while message := reader.recv_msg():
            logged[message.get_type()].append(message)
        reader.close()
    return heard, logged, result.dataset


@pytest.fixture(params=["udp", "log"])
def messages(watched, request):
    return watched[0] if request.param == "udp" else watched[1]


def recorded(dataset):
    """Row of the run file by time in milliseconds."""
    rows = dataset["estimators/ins"]
    return rows, {round(t * 1e3): i for i, t in enumerate(rows["time"].values) if math.isfinite(t)}


def test_attitude_is_the_recorded_one(watched, messages):
    rows, at = recorded(watched[2])
    q = rows["q_nb"].values
    compared = 0
    for message in messages["ATTITUDE"]:
        if message.time_boot_ms not in at:
            continue
        w, x, y, z = q[at[message.time_boot_ms]]
        yaw, pitch, roll = Rotation.from_quat([x, y, z, w]).as_euler("ZYX")
        np.testing.assert_allclose([message.roll, message.pitch, message.yaw], [roll, pitch, yaw], atol=1e-6)
        compared += 1
    assert compared > 0.8 * 5 * (SECONDS - 3)  # rows at 10 Hz and messages at 25 Hz meet five times a second


def test_position_is_the_recorded_one(watched, messages):
    rows, at = recorded(watched[2])
    lat, lon, h, v_n = (rows[name].values for name in ("lat", "lon", "h", "v_n"))
    compared = 0
    for message in messages["GLOBAL_POSITION_INT"]:
        if message.time_boot_ms not in at:
            continue
        i = at[message.time_boot_ms]
        assert message.lat == pytest.approx(math.degrees(lat[i]) * 1e7, abs=0.51)
        assert message.lon == pytest.approx(math.degrees(lon[i]) * 1e7, abs=0.51)
        assert message.alt == pytest.approx(h[i] * 1e3, abs=0.51)
        np.testing.assert_allclose([message.vx, message.vy, message.vz], v_n[i] * 100, atol=0.51)
        compared += 1
    assert compared > 0.8 * 5 * (SECONDS - 3)


def test_truth_is_the_recorded_one(watched, messages):
    rows = watched[2]["truth"]
    at = {round(t * 1e3): i for i, t in enumerate(rows["time"].values)}
    compared = 0
    for message in messages["HIL_STATE_QUATERNION"]:
        i = at.get(round(message.time_usec / 1e3))
        if i is None:
            continue
        assert message.lat == pytest.approx(math.degrees(rows["lat"].values[i]) * 1e7, abs=0.51)
        np.testing.assert_allclose(message.attitude_quaternion, rows["q_nb"].values[i], atol=1e-6)
        compared += 1
    assert compared > 0.8 * 5 * SECONDS


def test_denial_shows_as_no_fix_and_is_said(messages):
    fixes = {message.time_usec / 1e6: message.fix_type for message in messages["GPS_RAW_INT"]}
    inside = [fix for t, fix in fixes.items() if DENIED[0] <= t < DENIED[1]]
    before = [fix for t, fix in fixes.items() if 1.0 <= t < DENIED[0]]
    after = [fix for t, fix in fixes.items() if t > DENIED[1] + 1.0]
    assert set(inside) == {mav.GPS_FIX_TYPE_NO_FIX}
    assert set(before) == set(after) == {mav.GPS_FIX_TYPE_3D_FIX}
    said = [(message.severity, message.text) for message in messages["STATUSTEXT"]]
    assert (mav.MAV_SEVERITY_WARNING, "gnss denied") in said
    assert (mav.MAV_SEVERITY_INFO, "gnss reacquired") in said


def test_nothing_is_claimed_before_alignment(watched, messages):
    rows, at = recorded(watched[2])
    first = min(t for t, i in at.items() if math.isfinite(rows["lat"].values[i]))
    for name in ("ATTITUDE", "GLOBAL_POSITION_INT"):
        assert messages[name][0].time_boot_ms > first - 100
    assert messages["HEARTBEAT"][0].system_status == mav.MAV_STATE_CALIBRATING
    assert messages["HEARTBEAT"][-1].system_status == mav.MAV_STATE_ACTIVE


@pytest.mark.ci
def test_station_breaks_the_receiver_and_heals_it(tmp_path, monkeypatch):
    """Within two seconds of the run its health says so, and the record has both requests."""
    monkeypatch.setenv("MAVLINK20", "1")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    scenario = Scenario.load("u_turn", ["duration_s=14"])
    publisher = MavlinkPublisher([f"udpin:127.0.0.1:{port}"], scenario)
    station = mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", dialect="all")
    asked, health, over = {}, [], threading.Event()

    def converse():
        station.mav.heartbeat_send(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, 0)
        t = 0.0
        while not over.is_set():
            message = station.recv_match(blocking=True, timeout=0.1)
            if message is None:
                continue
            t = getattr(message, "time_boot_ms", t * 1e3) / 1e3
            for when, kind in ((4.0, mav.FAILURE_TYPE_OFF), (9.0, mav.FAILURE_TYPE_OK)):
                if t > when and kind not in asked:
                    asked[kind] = t
                    station.mav.command_long_send(1, 1, 420, 0, mav.FAILURE_UNIT_SENSOR_GPS, kind, 0, 0, 0, 0, 0)
            if message.get_type() == "SYS_STATUS":
                gps = message.onboard_control_sensors_health & mav.MAV_SYS_STATUS_SENSOR_GPS
                health.append((t, bool(gps)))

    thread = threading.Thread(target=converse, daemon=True)
    thread.start()
    try:
        dataset = run(scenario, links=[publisher], realtime=4.0).dataset
    finally:
        over.set()
        thread.join(5.0)
        station.close()
    off, ok = asked[mav.FAILURE_TYPE_OFF], asked[mav.FAILURE_TYPE_OK]
    assert all(healthy for t, healthy in health if 1.5 < t < off)
    assert not any(healthy for t, healthy in health if off + 2.0 < t < ok)
    assert all(healthy for t, healthy in health if t > ok + 2.0)
    assert len([t for t, _ in health if t > ok + 2.0]) > 1
    assert dataset["requests"]["kind"].values.astype(str).tolist() == ["inject", "clear"]


@pytest.mark.ci
@pytest.mark.parametrize("listening", [False, True])
def test_only_what_may_ask_keeps_the_run_from_flying_ahead(listening, monkeypatch, tmp_path):
    ahead = []

    class Counted(build.Ahead):
        def __init__(self, *arguments):
            ahead.append(self)
            super().__init__(*arguments)

    monkeypatch.setattr(build, "Ahead", Counted)
    monkeypatch.setattr(Counted, "possible", staticmethod(lambda: True))
    scenario = Scenario.load("u_turn", ["duration_s=8"])
    urls = [f"tlog:{tmp_path / 'run.tlog'}", *(["udpout:127.0.0.1:9"] if listening else [])]
    watched = run(scenario, links=[MavlinkPublisher(urls, scenario)]).dataset
    assert len(ahead) == (0 if listening else 1)
    unwatched = run(scenario, controls=[tuple]).dataset  # flown in this process
    for group in ("truth", "estimators"):
        for mine, own in zip(watched[group].subtree, unwatched[group].subtree, strict=True):
            assert mine.dataset.equals(own.dataset)


def test_a_specific_force_that_nobody_knows_is_not_told(tmp_path):
    """Of a recorded flight it was told to be 0, of a vehicle in the air."""
    scenario = Scenario.load("recorded_flight", {"duration_s": 3, "sensors.gnss.denied": [], "expect": {}})
    publisher = MavlinkPublisher([f"tlog:{tmp_path / 'run.tlog'}"], scenario)
    result = run(scenario, links=[publisher])
    assert np.isnan(result.dataset["truth/dv"].values).all()
    assert np.isnan(result.dataset["truth/dtheta"].values).all()
    told = [message for _, message in read_log(tmp_path / "run.tlog")]
    said = [message for message in told if message.get_type() in ("SIMSTATE", "SIM_STATE")]
    assert {message.get_type() for message in said} == {"SIMSTATE", "SIM_STATE"}
    assert np.isnan([[message.xacc, message.yacc, message.zacc] for message in said]).all()
    assert np.isfinite([message.yaw for message in said]).all()
