"""What a ground station hears: pymavlink listens, and its decoded numbers are compared with what went in."""

import collections
import dataclasses
import math
import socket
import subprocess
import sys
import sysconfig
import threading
from pathlib import Path

import numpy as np
import pymap3d
import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import all as mav
from scipy.spatial.transform import Rotation
from worlds.loop import joined
from worlds.mavlink import (
    MIDNIGHT_US,
    SCENARIO,
    G,
    attitude,
    estimate,
    position,
    publish,
    quaternion,
    read_log,
    row_at,
    samples_at,
    truth_row,
    velocity,
)

from nav.samples import (
    AirspeedSample,
    BarometerSample,
    ImuSamples,
    Outcome,
    Status,
    UpdateReport,
)
from testbed import Scenario
from testbed.feeds.samples import Fixes
from testbed.mavlink import MavlinkPublisher


def log_of(tmp_path, calls, **changes):
    """Messages by type of a log of these calls."""
    path = tmp_path / "run.tlog"
    publisher = MavlinkPublisher([str(path)], SCENARIO)
    publish(publisher, calls, **changes)
    publisher.close()
    by_type = collections.defaultdict(list)
    for _, message in read_log(path):
        by_type[message.get_type()].append(message)
    return by_type


@pytest.fixture
def unused_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def mavlink2(monkeypatch):
    monkeypatch.setenv("MAVLINK20", "1")


class Station(threading.Thread):
    """A ground station made of pymavlink: listens until it has heard ``count`` ATTITUDE messages."""

    def __init__(self, address, count):
        super().__init__(daemon=True)
        self.connection = mavutil.mavlink_connection(address, dialect="all")
        self.count = count
        self.heard = collections.defaultdict(list)
        self.start()

    def run(self):
        while len(self.heard["ATTITUDE"]) < self.count:
            message = self.connection.recv_match(blocking=True, timeout=5.0)
            if message is None:
                return
            self.heard[message.get_type()].append(message)

    def finish(self):
        self.join(10.0)
        self.connection.close()
        return self.heard


def check_attitude_and_position(heard, count):
    assert len(heard["ATTITUDE"]) == count
    for message in heard["ATTITUDE"]:
        yaw, pitch, roll = attitude(message.time_boot_ms / 1e3).as_euler("ZYX")
        np.testing.assert_allclose([message.roll, message.pitch, message.yaw], [roll, pitch, yaw], atol=1e-6)
        np.testing.assert_allclose(
            [message.rollspeed, message.pitchspeed, message.yawspeed], [0.1, 0.2, 0.3], atol=1e-6
        )
    for message in heard["GLOBAL_POSITION_INT"]:
        t = message.time_boot_ms / 1e3
        lat, lon, h = position(t)
        assert message.lat == round(math.degrees(lat) * 1e7)
        assert message.lon == round(math.degrees(lon) * 1e7)
        assert message.alt == round(h * 1e3)
        assert message.relative_alt == pytest.approx((h - position(0.0)[2]) * 1e3, abs=1)
        assert (message.vx, message.vy, message.vz) == (300, 3000, -200)
        assert message.hdg == pytest.approx((300 + 20 * t) % 360 * 100, abs=1)
    assert {message.get_srcSystem() for messages in heard.values() for message in messages} == {1}
    assert {message.get_srcComponent() for messages in heard.values() for message in messages} == {1}


def paced(publisher, station, calls):
    """As fast as the station hears it, so that no datagram is lost on the way."""
    for k in calls:
        publish(publisher, [k])
        for _ in range(1000):
            if len(station.heard["ATTITUDE"]) > k or not station.is_alive():
                break
            threading.Event().wait(0.002)


@pytest.mark.usefixtures("mavlink2")
def test_station_listens_on_udp(unused_port):
    station = Station(f"udpin:127.0.0.1:{unused_port}", 250)
    publisher = MavlinkPublisher([f"udpout:127.0.0.1:{unused_port}"], SCENARIO)
    paced(publisher, station, range(250))
    publisher.close()
    heard = station.finish()
    check_attitude_and_position(heard, 250)
    assert len(heard["GLOBAL_POSITION_INT"]) >= 99
    east = [message.lon for message in heard["GLOBAL_POSITION_INT"]]
    assert max(east) > 179.9e7  # the flight did cross the date line
    assert min(east) < -179.9e7


@pytest.mark.usefixtures("mavlink2")
@pytest.mark.parametrize(("ours", "theirs"), [("tcp", "tcpin"), ("tcpin", "tcp")])
def test_station_on_tcp(unused_port, ours, theirs):
    if ours == "tcp":
        station = Station(f"{theirs}:127.0.0.1:{unused_port}", 50)
        publisher = MavlinkPublisher([f"{ours}:127.0.0.1:{unused_port}"], SCENARIO)
    else:
        publisher = MavlinkPublisher([f"{ours}:127.0.0.1:{unused_port}"], SCENARIO)
        station = Station(f"{theirs}:127.0.0.1:{unused_port}", 50)
    paced(publisher, station, range(50))
    heard = station.finish()
    publisher.close()
    check_attitude_and_position(heard, 50)


@pytest.mark.ci
@pytest.mark.usefixtures("mavlink2")
def test_mavlogdump_reads_the_log(tmp_path):
    path = tmp_path / "run.tlog"
    publisher = MavlinkPublisher([f"tlog:{path}"], SCENARIO)
    publish(publisher, range(51))
    publisher.event(2.0, "warning", "gnss denied")
    publisher.close()
    tool = Path(sysconfig.get_path("scripts")) / "mavlogdump.py"
    done = subprocess.run(
        [sys.executable, str(tool), "--dialect", "all", "--types", "ATTITUDE,STATUSTEXT,HEARTBEAT", str(path)],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert sum("ATTITUDE {" in line for line in lines) == 51
    assert sum("HEARTBEAT {" in line for line in lines) == 3
    assert any("gnss denied" in line for line in lines)
    assert "BAD_DATA" not in done.stdout


def test_rates(tmp_path):
    seconds = 20
    both = [("second", estimate(1.0)), ("third", estimate(1.0))]
    heard = log_of(tmp_path, range(25 * seconds), others=lambda t: both)
    expected = {
        "HEARTBEAT": 1,
        "ATTITUDE": 25,
        "ATTITUDE_QUATERNION": 10,
        "GLOBAL_POSITION_INT": 10,
        "LOCAL_POSITION_NED": 10,
        "VFR_HUD": 5,
        "ALTITUDE": 2,
        "WIND_COV": 1,
        "ODOMETRY": 5,
        "GPS_RAW_INT": 5,
        "HIGHRES_IMU": 10,
        "SCALED_PRESSURE": 1,
        "SYS_STATUS": 2,
        "MISSION_CURRENT": 1,
        "ESTIMATOR_STATUS": 2,
        "EKF_STATUS_REPORT": 1,
        "EXTENDED_SYS_STATE": 1,
        "HOME_POSITION": 0.5,
        "SYSTEM_TIME": 1,
        "GNSS_INTEGRITY": 1,
        "HIL_STATE_QUATERNION": 10,
        "SIMSTATE": 5,
        "SIM_STATE": 1,
        "AHRS2": 5,
        "AHRS3": 5,
        "NAMED_VALUE_FLOAT": 10,
    }
    assert {name: len(messages) / seconds for name, messages in heard.items()} == expected
    # Evenly: never more than one call early or late.
    for name in ("GLOBAL_POSITION_INT", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED"):
        gaps = np.diff([message.time_boot_ms for message in heard[name]])
        assert set(gaps) <= {80, 120}


def test_log_is_stamped_in_simulated_time_and_the_same_every_time(tmp_path):
    paths = [tmp_path / "a.tlog", tmp_path / "b.tlog"]
    for path in paths:
        publisher = MavlinkPublisher([str(path)], SCENARIO)
        publish(publisher, range(60))
        publisher.event(2.4, "info", "gnss reacquired")
        publisher.close()
    assert paths[0].read_bytes() == paths[1].read_bytes()
    log = read_log(paths[0])
    stamps = [time_us for time_us, message in log if message.get_type() == "ATTITUDE"]
    assert stamps == [MIDNIGHT_US + 40_000 * k for k in range(60)]
    assert log[-1][0] == MIDNIGHT_US + 2_400_000
    clock = [message for _, message in log if message.get_type() == "SYSTEM_TIME"]
    assert clock[1].time_unix_usec == MIDNIGHT_US + 1_000_000
    assert clock[1].time_boot_ms == 1000


def test_sequence_numbers_have_no_gap(tmp_path):
    path = tmp_path / "run.tlog"
    publisher = MavlinkPublisher([str(path)], SCENARIO)
    publish(publisher, range(100))
    publisher.event(4.0, "info", "x" * 120)
    publisher.close()
    sequence = [message.get_seq() for _, message in read_log(path)]
    assert sequence == [k % 256 for k in range(len(sequence))]
    assert len(sequence) > 256


def test_identity(tmp_path):
    heard = log_of(tmp_path, range(2))
    beat = heard["HEARTBEAT"][0]
    assert (beat.type, beat.autopilot, beat.custom_mode) == (mav.MAV_TYPE_FIXED_WING, mav.MAV_AUTOPILOT_PX4, 0x03040000)
    assert beat.base_mode & mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    assert beat.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED
    assert beat.system_status == mav.MAV_STATE_ACTIVE
    assert mavutil.mode_string_v10(beat) == "LOITER"  # pymavlink's name for PX4 Hold
    assert heard["EXTENDED_SYS_STATE"][0].landed_state == mav.MAV_LANDED_STATE_IN_AIR


def test_on_the_ground(tmp_path):
    still = estimate(0.0)
    still.v_n[:] = 0.0
    slow = samples_at(0.0) | {"airspeed": AirspeedSample(0.0, 0.0, 1.0)}
    heard = log_of(tmp_path, range(1), estimate=lambda t: still, samples=lambda t: slow)
    assert heard["EXTENDED_SYS_STATE"][0].landed_state == mav.MAV_LANDED_STATE_ON_GROUND
    assert not heard["HEARTBEAT"][0].base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED
    assert heard["HEARTBEAT"][0].system_status == mav.MAV_STATE_STANDBY


def test_nothing_is_claimed_while_aligning(tmp_path):
    nothing = estimate(0.0, Status.ALIGNING, covariance=np.full((9, 9), math.nan))
    heard = log_of(tmp_path, range(50), estimate=lambda t: nothing, others=lambda t: [("second", nothing)])
    silent = {"ATTITUDE", "ATTITUDE_QUATERNION", "GLOBAL_POSITION_INT", "LOCAL_POSITION_NED", "ODOMETRY", "VFR_HUD"}
    silent |= {"ALTITUDE", "WIND_COV", "HOME_POSITION", "AHRS2", "NAMED_VALUE_FLOAT"}
    assert not silent & set(heard)
    assert {beat.system_status for beat in heard["HEARTBEAT"]} == {mav.MAV_STATE_CALIBRATING}
    assert heard["ESTIMATOR_STATUS"][0].flags == 0
    assert math.isnan(heard["ESTIMATOR_STATUS"][0].pos_horiz_accuracy)
    assert heard["EKF_STATUS_REPORT"][0].flags == mav.EKF_UNINITIALIZED
    assert not heard["SYS_STATUS"][0].onboard_control_sensors_health & mav.MAV_SYS_STATUS_AHRS
    assert len(heard["HIL_STATE_QUATERNION"]) == 20  # truth goes on
    assert heard["GPS_RAW_INT"][0].fix_type == 3


def test_home_is_where_the_estimator_was_aligned(tmp_path):
    late = lambda t: estimate(t, Status.ALIGNING if t < 1.0 else Status.ALIGNED)  # noqa: E731
    heard = log_of(tmp_path, range(101), estimate=late)
    lat, lon, h = position(1.0)
    home = heard["HOME_POSITION"][-1]
    assert (home.latitude, home.longitude) == (round(math.degrees(lat) * 1e7), round(math.degrees(lon) * 1e7))
    assert home.altitude == round(h * 1e3)
    for message in heard["LOCAL_POSITION_NED"]:
        here = position(message.time_boot_ms / 1e3)
        expected = pymap3d.geodetic2ned(*np.degrees(here[:2]), here[2], *np.degrees([lat, lon]), h)
        np.testing.assert_allclose([message.x, message.y, message.z], expected, atol=0.01)
        assert (message.vx, message.vy, message.vz) == (3.0, 30.0, -2.0)


def test_gnss_with_a_fix(tmp_path):
    heard = log_of(tmp_path, range(6))
    gps = heard["GPS_RAW_INT"][1]
    lat, lon, h = position(0.2)
    assert gps.time_usec == 200_000
    assert (gps.fix_type, gps.satellites_visible, gps.eph, gps.epv) == (3, 14, 80, 125)
    assert (gps.lat, gps.lon, gps.alt) == (
        round(math.degrees(lat) * 1e7),
        round(math.degrees(lon) * 1e7),
        round(h * 1e3),
    )
    assert (gps.vel, gps.cog) == (500, round((math.degrees(math.atan2(-4, -3)) % 360) * 100))
    assert (gps.h_acc, gps.v_acc, gps.vel_acc) == (5000, 6000, 300)
    assert heard["SYS_STATUS"][0].onboard_control_sensors_health & mav.MAV_SYS_STATUS_SENSOR_GPS
    assert heard["GNSS_INTEGRITY"][0].jamming_state == mav.GPS_JAMMING_STATE_NOT_JAMMED


def test_a_receiver_of_a_log_may_not_say_how_good_it_is(tmp_path):
    """Of a table without such columns 0 satellites were told."""
    t = np.arange(0.0, 1.0, 0.2)
    fixes = Fixes(t, *np.full((3, len(t)), 0.5)).samples("gnss")
    heard = log_of(tmp_path, range(6), samples=lambda now: {"gnss": fixes[int(now / 0.2)]})
    gps = heard["GPS_RAW_INT"][1]
    assert (gps.fix_type, gps.satellites_visible, gps.eph, gps.epv, gps.vel, gps.cog) == (3, 255, *4 * [65535])


def test_a_place_that_a_log_does_not_know_is_not_told(tmp_path):
    """Where its reference is silent the vehicle was told to be at latitude and longitude 0."""

    def lost(t):
        row = truth_row(t)
        row.lat[0] = row.lon[0] = row.h[0] = math.nan
        return row

    heard = log_of(tmp_path, range(50), truth=lambda t: truth_row(t) if t < 1.0 else lost(t))
    assert [len(heard[name]) for name in ("HIL_STATE_QUATERNION", "SIMSTATE", "SIM_STATE")] == [10, 5, 1]
    assert len(heard["ATTITUDE"]) == 50


def test_an_attitude_that_a_log_does_not_know_is_not_told(tmp_path):
    """Of a flight without one the nose was told to point straight down, at every place."""

    def unknown(t):
        row = truth_row(t)
        row.q_nb[0] = math.nan
        return row

    heard = log_of(tmp_path, range(25), truth=unknown)
    for name in ("SIMSTATE", "SIM_STATE"):
        message = heard[name][0]
        assert np.isnan([message.roll, message.pitch, message.yaw]).all()
        assert message.lat != 0
    assert np.isnan(heard["HIL_STATE_QUATERNION"][0].attitude_quaternion).all()
    assert heard["HIL_STATE_QUATERNION"][0].lat != 0


def test_a_wind_may_have_no_sigma(tmp_path):
    wind = {"wind": (np.array([4.0, -3.0]), np.full(2, math.nan))}
    heard = log_of(tmp_path, range(6), estimate=lambda t: dataclasses.replace(estimate(t), extra=wind))
    assert (heard["WIND_COV"][0].wind_x, heard["WIND_COV"][0].horiz_accuracy) == (4.0, 0.0)


def denied(t):
    return samples_at(t, fix=False)


def silent(t):
    return samples_at(0.0) | {"barometer": BarometerSample(t, t, 90000.0)}


@pytest.mark.parametrize(("samples", "satellites"), [(denied, 0), (silent, 255)])
def test_gnss_denied_or_silent_shows_as_no_fix(tmp_path, samples, satellites):
    start = 150  # six seconds in
    publisher = MavlinkPublisher([str(tmp_path / "run.tlog")], SCENARIO)
    publish(publisher, range(start, start + 25), samples=samples)
    publisher.close()
    heard = {message.get_type(): message for _, message in read_log(tmp_path / "run.tlog")}
    gps = heard["GPS_RAW_INT"]
    assert (gps.fix_type, gps.eph, gps.epv, gps.vel, gps.cog) == (1, 65535, 65535, 65535, 65535)
    assert (gps.satellites_visible, gps.lat, gps.lon) == (satellites, 0, 0)
    status = heard["SYS_STATUS"]
    assert status.onboard_control_sensors_present & mav.MAV_SYS_STATUS_SENSOR_GPS
    assert not status.onboard_control_sensors_health & mav.MAV_SYS_STATUS_SENSOR_GPS
    assert status.onboard_control_sensors_health & mav.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    assert heard["GNSS_INTEGRITY"].jamming_state == mav.GPS_JAMMING_STATE_DETECTED


TWO_OF_EACH = {
    f"sensors.{name}2": {"kind": name, "rate_hz": 5} for name in ("gnss", "barometer", "magnetometer", "airspeed")
}


def both(t, first):
    """What second sensors say, and then, if anything, the first."""
    others = {f"{name}2": dataclasses.replace(one, sensor=f"{name}2") for name, one in samples_at(t).items()}
    return others | first


def differing(t):
    """Samples that differ from those of the second sensors, and no fix."""
    return samples_at(t, fix=False) | {
        "barometer": BarometerSample(t, t, 80000.0),
        "magnetometer": dataclasses.replace(samples_at(t)["magnetometer"], field_b=np.array([-2e-5, 1e-5, 5e-5])),
        "airspeed": AirspeedSample(t, t, 10.0),
    }


def test_the_first_sensor_is_the_scenarios_not_who_spoke_first(tmp_path):
    """A receiver heard 0.1 s before the first one was shown in its place, and the outage of that was not."""
    heard = collections.defaultdict(list)
    publisher = MavlinkPublisher([str(tmp_path / "run.tlog")], SCENARIO.changed(TWO_OF_EACH))
    publish(publisher, range(60), samples=lambda t: both(t, differing(t) if t > 0.1 else {}))
    publisher.close()
    for _, message in read_log(tmp_path / "run.tlog"):
        heard[message.get_type()].append(message)
    bit = mav.MAV_SYS_STATUS_SENSOR_GPS
    assert {message.fix_type for message in heard["GPS_RAW_INT"]} == {mav.GPS_FIX_TYPE_NO_FIX}
    assert not any(message.onboard_control_sensors_health & bit for message in heard["SYS_STATUS"])
    assert all(message.onboard_control_sensors_present & bit for message in heard["SYS_STATUS"])
    assert last(heard, "GNSS_INTEGRITY", "jamming_state") == mav.GPS_JAMMING_STATE_DETECTED
    early, late = heard["HIGHRES_IMU"][0], heard["HIGHRES_IMU"][-1]
    assert early.time_usec < 100_000
    assert np.isnan([early.abs_pressure, early.diff_pressure, early.xmag]).all()
    assert (late.abs_pressure, late.diff_pressure) == pytest.approx((800.0, 0.6125), rel=1e-4)
    assert (late.xmag, late.zmag) == pytest.approx((-0.2, 0.5))
    assert last(heard, "VFR_HUD", "airspeed") == 10.0
    assert last(heard, "SCALED_PRESSURE", "press_abs") == 800.0


def test_health_is_told_as_soon_as_it_changes(tmp_path):
    publisher = MavlinkPublisher([str(tmp_path / "run.tlog")], SCENARIO)
    publish(publisher, range(153))
    publish(publisher, range(153, 154), samples=denied)  # a call at which neither message is due
    publish(publisher, range(154, 155))
    publisher.close()
    told = [message for _, message in read_log(tmp_path / "run.tlog")]
    health = [m.onboard_control_sensors_health for m in told if m.get_type() == "SYS_STATUS"][-3:]
    assert [bool(bits & mav.MAV_SYS_STATUS_SENSOR_GPS) for bits in health] == [True, False, True]
    flags = [m.flags for m in told if m.get_type() == "EKF_STATUS_REPORT"][-3:]  # whatever the estimator still holds
    assert [bool(bits & mav.EKF_POS_HORIZ_ABS) for bits in flags] == [True, False, True]


def test_dead_reckoning_drops_the_absolute_position_flag(tmp_path):
    lost = Status.ALIGNED | Status.DEAD_RECKONING
    heard = log_of(tmp_path, range(1), estimate=lambda t: estimate(t, lost))
    fused = log_of(tmp_path, range(1))
    for name, absolute in (
        ("ESTIMATOR_STATUS", mav.ESTIMATOR_POS_HORIZ_ABS),
        ("EKF_STATUS_REPORT", mav.EKF_POS_HORIZ_ABS),
    ):
        assert not heard[name][0].flags & absolute
        assert fused[name][0].flags & absolute
        assert heard[name][0].flags & mav.ESTIMATOR_POS_HORIZ_REL
    assert heard["ESTIMATOR_STATUS"][0].pos_horiz_accuracy == 5.0
    assert heard["ESTIMATOR_STATUS"][0].pos_vert_accuracy == 2.0


def test_innovations_over_their_gates(tmp_path):
    def report(aid, nis):
        return UpdateReport(0.0, "any", aid, np.zeros(1), np.eye(1), nis, 4.0, 1.0, Outcome.FUSED)

    now = [report("gnss_position", 1.0), report("gnss_velocity", 16.0), report("barometer", math.nan)]
    heard = log_of(tmp_path, range(1), reports=lambda t: now)
    status = heard["ESTIMATOR_STATUS"][0]
    assert (status.pos_horiz_ratio, status.vel_ratio) == (0.5, 2.0)
    assert math.isnan(status.pos_vert_ratio)
    assert math.isnan(status.mag_ratio)
    assert heard["EKF_STATUS_REPORT"][0].velocity_variance == 2.0


def test_sensors(tmp_path):
    heard = log_of(tmp_path, range(6))
    imu = heard["HIGHRES_IMU"][1]
    np.testing.assert_allclose([imu.xgyro, imu.ygyro, imu.zgyro], [0.11, 0.22, 0.33], rtol=1e-6)
    np.testing.assert_allclose([imu.xacc, imu.yacc, imu.zacc], [0.5, -0.5, -9.8], rtol=1e-6)
    np.testing.assert_allclose([imu.xmag, imu.ymag, imu.zmag], [0.2, 0.1, -0.5], rtol=1e-6)
    assert imu.abs_pressure == 900.0
    assert imu.diff_pressure == pytest.approx(0.5 * 1.225 * 400 / 100)
    assert imu.pressure_alt == pytest.approx(988.5, abs=0.5)  # U.S. Standard Atmosphere 1976, 900 hPa
    assert imu.fields_updated == 0b0111111111111  # all but temperature
    assert heard["SCALED_PRESSURE"][0].press_abs == 900.0
    assert heard["VFR_HUD"][0].airspeed == 20.0
    assert heard["VFR_HUD"][0].throttle == 60
    assert heard["VFR_HUD"][0].groundspeed == pytest.approx(math.hypot(3, 30))
    assert heard["VFR_HUD"][0].climb == 2.0
    assert heard["VFR_HUD"][0].heading == 300
    wind = heard["WIND_COV"][0]
    assert (wind.wind_x, wind.wind_y, wind.horiz_accuracy) == (4.0, -3.0, 0.5)


@pytest.mark.parametrize("ticks", [8, 200])
def test_slow_imu_reads_the_same_however_the_run_is_cut(tmp_path, ticks):
    """An IMU at 12.5 Hz whose increments are their own time, handed over in blocks of the calls' length or a second."""
    times = np.arange(1, 60) * 0.08 - 0.02

    def block(t):
        first = round(t * 200) // ticks * ticks / 200
        inside = (times >= first - 1e-9) & (times < first + ticks / 200 - 1e-9)
        own = times[inside]
        return ImuSamples(own, np.ones(len(own)), np.repeat(own[:, None], 3, axis=1), np.ones((len(own), 3)))

    heard = log_of(tmp_path, range(100), imu=block)
    for message in heard["ATTITUDE"][2:]:
        t = message.time_boot_ms / 1e3
        assert message.rollspeed + 0.01 == pytest.approx(times[times <= t + 1e-9][-1], abs=1e-6)


def test_without_sensors(tmp_path):
    heard = log_of(tmp_path, range(25), samples=lambda t: {}, imu=lambda t: None)
    assert not {"GPS_RAW_INT", "GNSS_INTEGRITY", "SCALED_PRESSURE"} & set(heard)
    assert heard["HIGHRES_IMU"][0].fields_updated == 0
    status = heard["SYS_STATUS"][0]
    assert not status.onboard_control_sensors_present & mav.MAV_SYS_STATUS_SENSOR_GPS
    assert not status.onboard_control_sensors_health & mav.MAV_SYS_STATUS_SENSOR_3D_GYRO
    assert math.isnan(heard["ATTITUDE"][0].rollspeed)


def test_truth(tmp_path):
    heard = log_of(tmp_path, range(1, 11), estimate=lambda t: estimate(t, offset_h=12.0))
    for message in heard["HIL_STATE_QUATERNION"]:
        t = message.time_usec / 1e6
        lat, lon, h = position(t)
        assert (message.lat, message.lon) == (round(math.degrees(lat) * 1e7), round(math.degrees(lon) * 1e7))
        assert message.alt == round(h * 1e3)
        np.testing.assert_allclose(message.attitude_quaternion, quaternion(attitude(t)), atol=1e-6)
        assert (message.xacc, message.yacc, message.zacc) == (round(1e3 / G), round(2e3 / G), -32768)
        assert (message.ind_airspeed, message.true_airspeed) == (1350, 2700)
    yaw, pitch, roll = attitude(0.04).as_euler("ZYX")
    for name in ("SIMSTATE", "SIM_STATE"):
        message = heard[name][0]
        np.testing.assert_allclose([message.roll, message.pitch, message.yaw], [roll, pitch, yaw], atol=1e-6)
        assert message.zacc == pytest.approx(-50 * G)
    assert heard["SIM_STATE"][0].lat_int == heard["SIMSTATE"][0].lat


def test_errors(tmp_path):
    """The estimate is 12 m too high, a degree off in heading and two in level."""
    tilt = Rotation.from_rotvec([0.0, math.radians(2), math.radians(1)])

    def off(t):
        wrong = estimate(t, offset_h=12.0)
        wrong.q_nb[:] = quaternion(tilt * attitude(t))
        wrong.v_n[1] += 0.5
        return wrong

    heard = log_of(tmp_path, range(1), estimate=off)
    errors = {message.name: message.value for message in heard["NAMED_VALUE_FLOAT"]}
    assert errors["err_horiz"] == pytest.approx(0.0, abs=1e-6)
    assert errors["err_down"] == pytest.approx(-12.0, abs=1e-4)
    assert errors["err_vel"] == pytest.approx(0.5)
    assert errors["err_tilt"] == pytest.approx(2.0, abs=1e-4)
    assert errors["err_head"] == pytest.approx(1.0, abs=1e-4)
    assert errors["sig_horiz"] == pytest.approx(5.0)
    sigma = np.sqrt(np.diag(estimate(0.0).covariance))
    assert errors["sig_down"] == pytest.approx(sigma[2])
    assert errors["sig_vel"] == pytest.approx(np.linalg.norm(sigma[3:6]))
    assert errors["sig_tilt"] == pytest.approx(math.degrees(np.linalg.norm(sigma[6:8])), rel=1e-6)
    assert errors["sig_head"] == pytest.approx(math.degrees(sigma[8]), rel=1e-6)


def test_other_estimators(tmp_path):
    others = [("dead_reckoning", estimate(1.0, offset_h=7.0)), ("third", estimate(1.0, Status.ALIGNING))]
    heard = log_of(tmp_path, range(1), others=lambda t: others)
    lat, lon, h = position(1.0)
    ahrs = heard["AHRS2"][0]
    assert (ahrs.lat, ahrs.lng) == (round(math.degrees(lat) * 1e7), round(math.degrees(lon) * 1e7))
    assert ahrs.altitude == pytest.approx(h + 7.0)
    assert "AHRS3" not in heard


@pytest.mark.ci
def test_odometry_covariance(tmp_path):
    """Against a cloud of estimates drawn from the covariance, in the house's sign of the attitude error."""
    rng = np.random.default_rng(5)
    root = rng.normal(size=(9, 9)) * np.array([3, 4, 2, 0.5, 0.4, 0.3, 0.004, 0.005, 0.01])[:, None]
    P = root @ root.T
    here = estimate(0.0, covariance=P)
    heard = log_of(tmp_path, range(1), estimate=lambda t: here)
    message = heard["ODOMETRY"][0]

    draws = rng.multivariate_normal(np.zeros(9), P, size=200_000)
    C_nb = attitude(0.0)
    C_hat = Rotation.from_rotvec(-draws[:, 6:9]) * C_nb  # C_hat = (I - [phi x]) C
    turned = (C_hat * C_nb.inv()).as_rotvec()
    pose = np.cov(np.hstack([draws[:, :3], turned]).T)
    v_b = C_hat.inv().apply(velocity(0.0) + draws[:, 3:6])
    np.testing.assert_allclose([message.vx, message.vy, message.vz], C_nb.inv().apply(velocity(0.0)), rtol=1e-5)

    scale = np.sqrt(np.outer(np.diag(pose), np.diag(pose)))
    received = np.zeros((6, 6))
    received[np.triu_indices(6)] = message.pose_covariance
    np.testing.assert_allclose(received / scale, np.triu(pose / scale), atol=0.01)

    twist = np.zeros((6, 6))
    twist[np.triu_indices(6)] = message.velocity_covariance
    expected = np.cov(v_b.T)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(np.triu(twist[:3, :3] / scale), np.triu(expected / scale), atol=0.01)
    np.testing.assert_allclose(twist.diagonal()[3:], 1e-6, rtol=1e-5)
    assert (message.frame_id, message.child_frame_id) == (mav.MAV_FRAME_LOCAL_NED, mav.MAV_FRAME_BODY_FRD)


def test_events(tmp_path):
    path = tmp_path / "run.tlog"
    publisher = MavlinkPublisher([str(path)], SCENARIO)
    publisher.event(300.0, "warning", "gnss denied")
    publisher.event(900.0, "info", "gnss reacquired")
    publisher.event(901.0, "error", "x" * 60)
    publisher.event(902.0, "info", "y" * 60)
    publisher.close()
    log = read_log(path)
    assert [(m.severity, m.text, m.id) for _, m in log[:2]] == [(4, "gnss denied", 0), (6, "gnss reacquired", 0)]
    assert [time_us for time_us, _ in log[:2]] == [MIDNIGHT_US + 300_000_000, MIDNIGHT_US + 900_000_000]
    assert [(m.severity, m.text, m.chunk_seq) for _, m in log[2:4]] == [(3, "x" * 50, 0), (3, "x" * 10, 1)]
    assert log[2][1].id == log[3][1].id != log[4][1].id


def test_time_never_runs_backwards_in_the_log(tmp_path):
    path = tmp_path / "run.tlog"
    publisher = MavlinkPublisher([str(path)], SCENARIO)
    publish(publisher, range(50))
    publisher.event(1.0, "info", "of a sample that was used late")
    publish(publisher, range(50, 60))
    publisher.close()
    stamps = [time_us for time_us, _ in read_log(path)]
    assert stamps == sorted(stamps)
    assert stamps[-1] == MIDNIGHT_US + 59 * 40_000


@pytest.mark.ci
@pytest.mark.parametrize("vehicles", [False, True])
def test_a_log_is_the_same_however_many_rows_come_at_once(tmp_path, vehicles):
    """The estimator aligns, a receiver loses its fix, a barometer falls silent, legs end, a sensor is shut out."""

    def estimates(t):
        return estimate(t, Status.ALIGNING if t < 1 else Status.ALIGNED, offset_h=t)

    def truth(t):
        row = truth_row(t)
        row.leg[0] = t // 3
        return row

    def samples(t):
        found = samples_at(t, fix=not 4 < t < 5)
        if t > 2:
            found["barometer"] = samples_at(2.0)["barometer"]
        return {name: one for name, one in found.items() if round(t / 0.04) % 3 == 0}

    def reports(t):
        outcome = Outcome.ISOLATED if 6 < t < 7 else Outcome.OUTSIDE_GATE if 7.5 < t < 8.5 else Outcome.FUSED
        weight = float(outcome is Outcome.FUSED)
        return [UpdateReport(t, "gnss", "gnss_position", np.zeros(3), np.eye(3), t, 9.0, weight, outcome)]

    turns = np.random.default_rng(1).normal(size=(2, 2000, 3)) / 200
    imu = ImuSamples(np.arange(1, 2001) / 200, np.full(2000, 1 / 200), *turns)
    rows = [
        row_at(
            k,
            truth=truth,
            estimate=estimates,
            samples=samples,
            reports=reports,
            imu=lambda t: imu,
            others=lambda t: [("b", estimate(t, offset_h=5.0)), ("c", estimate(t, Status.ALIGNING))],
        )
        for k in range(250)
    ]
    logs = []
    for chunk in (1, 7, 250):
        path = tmp_path / f"{chunk}.tlog"
        publisher = MavlinkPublisher([str(path)], SCENARIO, vehicles=vehicles)
        for first in range(0, 250, chunk):
            publisher.publish(joined(rows[first : first + chunk]))
        publisher.close()
        logs.append(path.read_bytes())
    assert logs[0] == logs[1] == logs[2]
    told = collections.Counter(message.get_type() for _, message in read_log(tmp_path / "250.tlog"))
    assert told["MISSION_ITEM_REACHED"] == 3
    texts = [m.text for _, m in read_log(tmp_path / "250.tlog") if m.get_type() == "STATUSTEXT"]
    assert texts[-2:] == ["gnss isolated", "gnss no longer isolated"]
    assert told["SYS_STATUS"] > 20 * (1 + 3 * vehicles)


def test_several_links_say_the_same(tmp_path):
    paths = [tmp_path / "a.tlog", tmp_path / "b.tlog"]
    publisher = MavlinkPublisher([f"tlog:{path}" for path in paths], SCENARIO)
    publish(publisher, range(10))
    publisher.close()
    publisher.close()
    assert paths[0].read_bytes() == paths[1].read_bytes() != b""


# Health: what stations are told of sensors that fail


def report(t, *, weight, outcome):
    return UpdateReport(t, "gnss", "gnss_position", np.zeros(3), np.eye(3), 30.0, 11.3, weight, outcome)


def last(heard, name, field):
    return getattr(heard[name][-1], field)


@pytest.mark.ci
def test_silent_sensors_lose_their_health_within_two_seconds_and_get_it_back(tmp_path):
    bits = {
        "gnss": mav.MAV_SYS_STATUS_SENSOR_GPS,
        "barometer": mav.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE,
        "magnetometer": mav.MAV_SYS_STATUS_SENSOR_3D_MAG,
        "airspeed": mav.MAV_SYS_STATUS_SENSOR_DIFFERENTIAL_PRESSURE,
    }
    silent_from = {"gnss": 1.0, "barometer": 1.2, "magnetometer": 1.4, "airspeed": 1.6}

    def samples(t):
        return {sensor: samples_at(start if start <= t < 5.0 else t)[sensor] for sensor, start in silent_from.items()}

    heard = collections.defaultdict(list)
    path = tmp_path / "run.tlog"
    publisher = MavlinkPublisher([str(path)], SCENARIO)
    publish(publisher, range(170), samples=samples)
    publisher.close()
    for time_us, message in read_log(path):
        if message.get_type() == "SYS_STATUS":
            for sensor, bit in bits.items():
                health = bool(message.onboard_control_sensors_health & bit)
                heard[sensor].append(((time_us - MIDNIGHT_US) / 1e6, health))
    for sensor, start in silent_from.items():
        assert all(healthy for t, healthy in heard[sensor] if t <= start + 0.3)
        assert not any(healthy for t, healthy in heard[sensor] if start + 2.0 <= t < 5.0)
        assert all(healthy for t, healthy in heard[sensor] if t >= 6.0)


def test_slow_sensor_is_not_silent(tmp_path):
    slow = Scenario.load("u_turn", ["sensors.barometer.rate_hz=0.5"])
    publisher = MavlinkPublisher([str(tmp_path / "run.tlog")], slow)
    publish(publisher, range(120), samples=lambda t: samples_at(t) | {"barometer": samples_at(t - t % 2)["barometer"]})
    publisher.close()
    bit = mav.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    status = [m for _, m in read_log(tmp_path / "run.tlog") if m.get_type() == "SYS_STATUS"]
    assert all(message.onboard_control_sensors_health & bit for message in status)


@pytest.mark.ci
@pytest.mark.parametrize("how", [Outcome.ISOLATED, Outcome.OUTSIDE_GATE])
def test_receiver_that_is_not_believed_shows_as_spoofed(tmp_path, how):
    def reports(t):
        doubted = 1.0 <= t < 3.0
        return [report(t, weight=0.0, outcome=how) if doubted else report(t, weight=1.0, outcome=Outcome.FUSED)]

    heard = log_of(tmp_path, range(25), reports=reports)
    assert last(heard, "GNSS_INTEGRITY", "spoofing_state") == mav.GPS_SPOOFING_STATE_NOT_SPOOFED
    assert not last(heard, "ESTIMATOR_STATUS", "flags") & mav.ESTIMATOR_GPS_GLITCH
    heard = log_of(tmp_path, range(75), reports=reports)
    assert last(heard, "GNSS_INTEGRITY", "spoofing_state") == mav.GPS_SPOOFING_STATE_DETECTED
    assert last(heard, "GNSS_INTEGRITY", "jamming_state") == mav.GPS_JAMMING_STATE_NOT_JAMMED
    assert last(heard, "ESTIMATOR_STATUS", "flags") & mav.ESTIMATOR_GPS_GLITCH
    assert last(heard, "EKF_STATUS_REPORT", "flags") & mav.EKF_GPS_GLITCHING
    assert not last(heard, "SYS_STATUS", "onboard_control_sensors_health") & mav.MAV_SYS_STATUS_SENSOR_GPS
    assert [message.text for message in heard["STATUSTEXT"]] == ["gnss isolated"] * (how is Outcome.ISOLATED)
    heard = log_of(tmp_path, range(110), reports=reports)
    assert last(heard, "GNSS_INTEGRITY", "spoofing_state") == mav.GPS_SPOOFING_STATE_NOT_SPOOFED
    assert last(heard, "SYS_STATUS", "onboard_control_sensors_health") & mav.MAV_SYS_STATUS_SENSOR_GPS
    assert how is not Outcome.ISOLATED or last(heard, "STATUSTEXT", "text") == "gnss no longer isolated"


@pytest.mark.ci
@pytest.mark.parametrize("how", [Outcome.ISOLATED, Outcome.OUTSIDE_GATE, Outcome.OUT_OF_RANGE])
@pytest.mark.parametrize(
    ("sensor", "bit"),
    [
        ("airspeed", mav.MAV_SYS_STATUS_SENSOR_DIFFERENTIAL_PRESSURE),
        ("barometer", mav.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE),
        ("magnetometer", mav.MAV_SYS_STATUS_SENSOR_3D_MAG),
    ],
)
def test_a_sensor_that_is_not_believed_shows_as_failed(tmp_path, sensor, bit, how):
    """A pitot tube that stuck was refused for minutes, and healthy."""

    def reports(t):
        kind = {"weight": 0.0, "outcome": how} if 1.0 <= t < 3.0 else {"weight": 1.0, "outcome": Outcome.FUSED}
        return [dataclasses.replace(report(t, **kind), sensor=sensor, aid=sensor)]

    heard = log_of(tmp_path, range(110), reports=reports)
    health = {round(one.onboard_control_sensors_health & bit) for one in heard["SYS_STATUS"]}
    assert health == {0, bit}
    heard = log_of(tmp_path, range(70), reports=reports)
    assert not last(heard, "SYS_STATUS", "onboard_control_sensors_health") & bit
    assert last(heard, "SYS_STATUS", "onboard_control_sensors_health") & mav.MAV_SYS_STATUS_SENSOR_GPS


def test_a_pitot_tube_at_rest_is_healthy(tmp_path):
    """It is out of its range for as long as that takes, and as far off as any sound sensor."""

    def reports(t):
        slow = report(t, weight=0.0, outcome=Outcome.OUT_OF_RANGE)
        return [dataclasses.replace(slow, sensor="airspeed", aid="airspeed", nis=1.0)]

    heard = log_of(tmp_path, range(70), reports=reports)
    bit = mav.MAV_SYS_STATUS_SENSOR_DIFFERENTIAL_PRESSURE
    assert all(message.onboard_control_sensors_health & bit for message in heard["SYS_STATUS"])


def test_receiver_without_fix_shows_as_jammed_not_spoofed(tmp_path):
    heard = log_of(tmp_path, range(50), samples=lambda t: samples_at(t, fix=False))
    assert last(heard, "GNSS_INTEGRITY", "jamming_state") == mav.GPS_JAMMING_STATE_DETECTED
    assert last(heard, "GNSS_INTEGRITY", "spoofing_state") == mav.GPS_SPOOFING_STATE_UNKNOWN
