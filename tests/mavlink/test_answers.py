"""What a ground station is answered, with pymavlink as the station."""

import collections
import hashlib
import math
import os
import pty
import socket
import struct
import time

import pymap3d
import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import all as mav
from worlds.mavlink import SCENARIO, Calls, publish, read_log

from testbed import Scenario
from testbed.errors import UserError
from testbed.loop import injection, settings
from testbed.loop import requests as control
from testbed.mavlink import MavlinkPublisher, link, mission, signing
from testbed.mavlink.stream import STREAMS

ACCEPTED, REJECTED, DENIED, UNSUPPORTED = 0, 1, 2, 3
PATIENCE_S, QUIET_S = 2.0, 0.015  # for an answer, and after the last


@pytest.fixture(autouse=True)
def _mavlink2(monkeypatch):
    monkeypatch.setenv("MAVLINK20", "1")


@pytest.fixture
def port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Peer:
    """A station; what it waits for is also what lets the vehicle work."""

    def __init__(self, publisher, connection):
        self.publisher = publisher
        self.connection = connection
        self.mav = connection.mav
        self.asked = []

    def hear(self, *types, patience=PATIENCE_S):
        """The next message of these types; None when there is none for long."""
        until = time.monotonic() + patience
        while time.monotonic() < until:
            self.asked += self.publisher.requests()
            message = self.connection.recv_match(type=list(types) or None)
            if message is not None:
                return message
            time.sleep(0.0005)
        return None

    def read(self, heard):
        """Take what is there."""
        while message := self.connection.recv_match():
            heard[message.get_type()].append(message)

    def fly(self, calls, *others, **changes):
        """What it, and others, hear while rows are published."""
        heard = [collections.defaultdict(list) for _ in (self, *others)]
        for k in calls:
            publish(self.publisher, [k], **changes)
            for one, own in zip((self, *others), heard, strict=True):
                one.read(own)
        return heard if others else heard[0]

    def drain(self):
        """All that comes within a moment, by type."""
        heard = collections.defaultdict(list)
        while message := self.hear(patience=QUIET_S):
            heard[message.get_type()].append(message)
        return heard

    def command(self, number, *params, system=1):
        """The results of a command's acknowledgements, and all else that was heard."""
        self.mav.command_long_send(system, 1, number, 0, *[*params, *[0] * 7][:7])
        heard = self.drain()
        return [ack.result for ack in heard["COMMAND_ACK"] if ack.command == number], heard

    def close(self):
        self.connection.close()


@pytest.fixture
def meet(port):
    """Makes a publisher with a station that is known to it, and rows of a run if there shall be."""
    opened = []

    def make(calls=1, scenario=SCENARIO, hello=True, **options):
        publisher = MavlinkPublisher([f"udpin:127.0.0.1:{port}"], scenario, **options)
        opened.append(publisher)
        peer = Peer(publisher, mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", dialect="all"))
        opened.append(peer)
        if hello:
            peer.mav.heartbeat_send(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, 0)
            assert peer.hear("HEARTBEAT")
            publish(publisher, range(calls))
            peer.drain()
        return peer

    yield make
    for one in opened:
        one.close()


def decoded(message, byte_wise=True):
    if message.param_type == mav.MAV_PARAM_TYPE_REAL32 or not byte_wise:
        return message.param_value
    return struct.unpack("<i", struct.pack("<f", message.param_value))[0]


def encoded(value):
    return struct.unpack("<f", struct.pack("<i", value))[0]


# Parameters


@pytest.mark.parametrize("identity", ["px4", "ardupilot"])
def test_all_parameters_are_fetched(meet, identity):
    peer = meet(identity=identity)
    peer.mav.param_request_list_send(1, 1)
    heard = peer.drain()["PARAM_VALUE"]
    assert [message.param_index for message in heard] == list(range(len(heard)))
    assert {message.param_count for message in heard} == {len(heard)}
    values = {message.param_id: decoded(message, identity == "px4") for message in heard}
    assert list(values) == sorted(values)
    known = settings.settings(SCENARIO)
    for name, setting in known.items():
        assert values[name] == pytest.approx(setting.value)
    types = {message.param_id: message.param_type for message in heard}
    assert types["SIM_GPS1_ENABLE"] == mav.MAV_PARAM_TYPE_INT32
    assert types["SIM_WIND_SPD"] == mav.MAV_PARAM_TYPE_REAL32
    facts = set(values) - set(known)
    if identity == "px4":
        assert facts == {"MAV_SYS_ID", "MAV_TYPE", "SYS_AUTOSTART", "SYS_FAILURE_EN"}
        assert values["SYS_FAILURE_EN"] == 1  # or MAVSDK injects no failures
        assert values["SYS_AUTOSTART"] == 2100
    else:
        assert facts == {"SYSID_THISMAV"}


def test_list_is_spread_over_turns_and_begins_again_when_asked_again(meet):
    peer = meet()
    peer.mav.param_request_list_send(1, 1)
    first = peer.hear("PARAM_VALUE")
    peer.mav.param_request_list_send(1, 1)
    heard = [first.param_index] + [message.param_index for message in peer.drain()["PARAM_VALUE"]]
    count = first.param_count
    assert count < len(heard) < 2 * count
    assert heard[-count:] == list(range(count))


def test_parameter_is_read_by_name_and_by_index(meet):
    peer = meet()
    peer.mav.param_request_read_send(1, 1, b"SIM_SPEEDUP", -1)
    by_name = peer.hear("PARAM_VALUE")
    assert by_name.param_value == 1.0
    peer.mav.param_request_read_send(1, 1, b"whatever", by_name.param_index)
    assert peer.hear("PARAM_VALUE").to_dict() == by_name.to_dict()
    for name, index in ((b"NO_SUCH", -1), (b"\xff\xfe\x80", -1), (b"", -1), (b"SIM_SPEEDUP", 999), (b"", -2)):
        peer.mav.param_request_read_send(1, 1, name, index)
        assert peer.hear("PARAM_ERROR", "PARAM_VALUE").error == mav.MAV_PARAM_ERROR_DOES_NOT_EXIST


def test_parameter_is_set(meet):
    peer = meet()
    peer.mav.param_set_send(1, 1, b"SIM_WIND_SPD", 0.1, mav.MAV_PARAM_TYPE_REAL32)
    assert peer.hear("PARAM_VALUE").param_value == pytest.approx(0.1)
    peer.mav.param_set_send(1, 1, b"SIM_GPS1_JAM", encoded(1), mav.MAV_PARAM_TYPE_INT32)
    assert decoded(peer.hear("PARAM_VALUE")) == 1
    assert peer.asked == [control.Change("SIM_WIND_SPD", 0.1), control.Change("SIM_GPS1_JAM", 1.0)]
    peer.mav.param_request_read_send(1, 1, b"SIM_GPS1_JAM", -1)
    assert decoded(peer.hear("PARAM_VALUE")) == 1


def test_numbers_as_arduPilot_sends_them(meet):
    peer = meet(identity="ardupilot")
    peer.mav.param_set_send(1, 1, b"SIM_GPS1_JAM", 1.0, mav.MAV_PARAM_TYPE_INT32)
    assert peer.hear("PARAM_VALUE").param_value == 1.0
    assert peer.asked == [control.Change("SIM_GPS1_JAM", 1.0)]


@pytest.mark.parametrize(
    ("name", "value", "kind", "error"),
    [
        (b"SIM_WIND_SPD", math.nan, 9, mav.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE),
        (b"SIM_WIND_SPD", math.inf, 9, mav.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE),
        (b"SIM_WIND_SPD", -0.1, 9, mav.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE),
        (b"SIM_WIND_SPD", 3e38, 9, mav.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE),
        (b"SIM_WIND_SPD", math.nan, 255, mav.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE),
        (b"SIM_GPS1_JAM", encoded(2), 6, mav.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE),
        (b"SIM_GPS1_JAM", encoded(-1), 6, mav.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE),
        (b"SIM_GPS1_JAM", 0.5, 9, mav.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE),
        (b"MAV_SYS_ID", encoded(7), 6, mav.MAV_PARAM_ERROR_READ_ONLY),
        (b"NO_SUCH", 1.0, 9, mav.MAV_PARAM_ERROR_DOES_NOT_EXIST),
        (b"\x80\x81", 1.0, 9, mav.MAV_PARAM_ERROR_DOES_NOT_EXIST),
    ],
)
def test_what_may_not_be_set_is_said_with_the_value_in_force(meet, name, value, kind, error):
    peer = meet()
    peer.mav.param_set_send(1, 1, name, value, kind)
    heard = peer.drain()
    assert [message.error for message in heard["PARAM_ERROR"]] == [error]
    in_force = [(m.param_id, decoded(m)) for m in heard["PARAM_VALUE"]]
    expected = {b"SIM_WIND_SPD": [("SIM_WIND_SPD", 4.0)], b"SIM_GPS1_JAM": [("SIM_GPS1_JAM", 0)]}
    assert in_force == expected.get(name, [("MAV_SYS_ID", 1)] if name == b"MAV_SYS_ID" else [])
    assert peer.asked == []


# The mission


def test_mission_is_downloaded(meet):
    peer = meet()
    peer.mav.mission_request_list_send(1, 1)
    count = peer.hear("MISSION_COUNT").count
    assert count == len(SCENARIO.plan)
    items = []
    for number in range(count):
        peer.mav.mission_request_int_send(1, 1, number)
        items.append(peer.hear("MISSION_ITEM_INT"))
        peer.mav.mission_request_send(1, 1, number)
        old = peer.hear("MISSION_ITEM")
        assert (old.x, old.y) == pytest.approx((items[-1].x / 1e7, items[-1].y / 1e7), rel=1e-6)
        assert (old.seq, old.command, old.z) == (number, items[-1].command, items[-1].z)
    assert [item.seq for item in items] == list(range(count))
    # East, half a circle to the left, and back: u_turn.toml.
    start = SCENARIO.truth.start
    lat, lon, _ = pymap3d.ned2geodetic(0, SCENARIO.plan[0].length_m, 0, start.lat_deg, start.lon_deg, start.alt_m)
    assert (items[0].x / 1e7, items[0].y / 1e7) == pytest.approx((lat, lon), abs=2e-5)
    home = peer.command(mav.MAV_CMD_GET_HOME_POSITION)[1]["HOME_POSITION"][0]
    assert home.altitude / 1e3 + items[0].z == pytest.approx(start.alt_m, abs=1e-3)
    assert items[1].y / 1e7 == pytest.approx(items[0].y / 1e7, abs=2e-5)
    assert items[1].x > items[0].x
    back = SCENARIO.plan[0].length_m - SCENARIO.plan[2].length_m
    lon = pymap3d.ned2geodetic(0, back, 0, start.lat_deg, start.lon_deg, start.alt_m)[1]
    assert items[2].y / 1e7 == pytest.approx(lon, abs=2e-5)
    for number in (count, 2**16 - 1):
        peer.mav.mission_request_int_send(1, 1, number)
        assert peer.hear("MISSION_ACK").type == mav.MAV_MISSION_INVALID_SEQUENCE
    for kind in (mav.MAV_MISSION_TYPE_FENCE, mav.MAV_MISSION_TYPE_RALLY):
        peer.mav.mission_request_list_send(1, 1, kind)
        message = peer.hear("MISSION_COUNT")
        assert (message.count, message.mission_type) == (0, kind)
        peer.mav.mission_request_int_send(1, 1, 0, kind)
        assert peer.hear("MISSION_ACK").type == mav.MAV_MISSION_INVALID_SEQUENCE


def test_every_kind_of_leg_has_its_item():
    plan = """
        title = "all"
        duration_s = 100
        [truth]
        source = "flight"
        start = { lat_deg = 10.0, lon_deg = 20.0, alt_m = 300, heading_deg = 0, airspeed_mps = 25 }
        plan = [
            { leg = "climb", to_m = 400 }, { leg = "descend", to_m = 300, rate_mps = 1 },
            { leg = "airspeed", to_mps = 27 },
            { leg = "straight", to = { lat_deg = 10.1, lon_deg = 20.1 } }, { leg = "turn", by_deg = -90 },
            { leg = "loiter", radius_m = 400, turns = 2, centre = { lat_deg = 10.2, lon_deg = 20.0 } },
            { leg = "loiter", radius_m = 400, duration_s = 60, direction = "right" },
            { leg = "racetrack", radius_m = 400, length_m = 1000, laps = 2 },
            { leg = "figure_eight", radius_m = 400, turns = 1 }, { leg = "s_turns", radius_m = 400, turns = 3 },
            { leg = "u_turn" }, { leg = "straight", length_m = 1000 },
        ]
    """.replace("plan = [", "_ = 0\nplan = [")
    head, _, legs = plan.partition("_ = 0\n")
    scenario = Scenario.parse(legs + head)
    items = mission.items(scenario, home_first=False)
    assert [item.command for item in items] == [30, 30, 178, 16, 16, 18, 19, 18, 18, 16, 16, 16]
    assert (items[0].h, items[1].h) == (400, 300)
    assert items[2].params[1] == 27
    assert math.degrees(items[3].lat) == pytest.approx(10.1, abs=1e-9)
    assert math.degrees(items[3].lon) == pytest.approx(20.1, abs=1e-9)
    assert math.degrees(items[5].lat) == pytest.approx(10.2, abs=1e-9)
    assert items[5].params[0] == 2
    assert (items[5].params[2], items[6].params[2]) == (-400, 400)
    # An S-turn of three arcs ends on the course that it began with: half a circle later the way back is parallel to it.
    turn = (items[10].params[3] - items[9].params[3]) % 360
    assert turn == pytest.approx(180)
    with_home = mission.items(scenario, home_first=True)
    assert with_home[1:] == items
    assert math.degrees(with_home[0].lat) == 10.0


def test_kinematic_motion_has_a_mission():
    scenario = Scenario.load("kinematic_u_flight")
    assert len(mission.items(scenario, home_first=False)) == len(scenario.truth.segments)


def test_current_leg_is_shown(meet):
    peer = meet(calls=0)

    def at_leg(leg):
        def change(t):
            from worlds.mavlink import truth_row

            row = truth_row(t)
            row.leg[0] = leg
            return row

        return change

    heard = peer.fly(range(25), truth=at_leg(0))
    assert {(m.seq, m.total) for m in heard["MISSION_CURRENT"]} == {(0, 3)}
    heard = peer.fly(range(25, 51), truth=at_leg(1))
    assert [message.seq for message in heard["MISSION_ITEM_REACHED"]] == [0]
    assert heard["MISSION_CURRENT"][-1].seq == 1
    heard = peer.fly(range(51, 80), truth=at_leg(-1))
    assert [message.seq for message in heard["MISSION_ITEM_REACHED"]] == [1]
    assert heard["MISSION_CURRENT"][-1].mission_state == mav.MISSION_STATE_COMPLETE
    peer.mav.mission_set_current_send(1, 1, 0)
    assert peer.hear("MISSION_CURRENT").seq == 2


def test_uploads_are_refused(meet):
    peer = meet()
    for kind, result in (
        (0, mav.MAV_MISSION_DENIED),
        (1, mav.MAV_MISSION_UNSUPPORTED),
        (2, mav.MAV_MISSION_UNSUPPORTED),
    ):
        peer.mav.mission_count_send(1, 1, 5, kind)
        assert peer.hear("MISSION_ACK").type == result
    peer.mav.mission_clear_all_send(1, 1)
    assert peer.hear("MISSION_ACK").type == mav.MAV_MISSION_DENIED
    peer.mav.mission_write_partial_list_send(1, 1, 0, 1)
    assert peer.hear("MISSION_ACK").type == mav.MAV_MISSION_DENIED


# Commands


def test_every_command_is_acknowledged_once(meet):
    peer = meet()
    without_parameters = (mav.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, mav.MAV_CMD_GET_HOME_POSITION)
    known = [number for number in mav.enums["MAV_CMD"] if number < 2**16]
    for number in (*known, 0, 2**16 - 1):
        peer.mav.command_int_send(1, 1, 0, number, 0, 0, 9, 9, 9, 9, 9, 9, 9)
        assert peer.hear("COMMAND_ACK").command == number
        peer.mav.command_long_send(1, 1, number, 0, *[math.nan] * 7)
        ack = peer.hear("COMMAND_ACK")
        assert (ack.command, ack.target_system) == (number, 255)
        assert ack.result != ACCEPTED or number in without_parameters
    assert peer.drain().get("COMMAND_ACK") is None
    assert peer.asked == []


def test_unknown_is_unsupported_and_what_is_not_done_denied(meet):
    peer = meet()
    assert peer.command(31000)[0] == [UNSUPPORTED]
    for number in (mav.MAV_CMD_NAV_RETURN_TO_LAUNCH, mav.MAV_CMD_NAV_LAND, mav.MAV_CMD_DO_REPOSITION):
        assert peer.command(number)[0] == [DENIED]


def test_other_targets_are_not_answered(meet):
    peer = meet()
    peer.mav.command_long_send(2, 1, 512, 0, 148, 0, 0, 0, 0, 0, 0)
    peer.mav.command_long_send(1, 154, 512, 0, 148, 0, 0, 0, 0, 0, 0)
    peer.mav.param_request_list_send(77, 1)
    assert not {"COMMAND_ACK", "PARAM_VALUE", "AUTOPILOT_VERSION"} & set(peer.drain())
    peer.mav.command_long_send(0, 0, 512, 0, 148, 0, 0, 0, 0, 0, 0)  # to all
    assert peer.hear("COMMAND_ACK").result == ACCEPTED


@pytest.mark.parametrize(
    ("identity", "mode", "other", "autopilot"),
    [("px4", (1, 4, 3), (1, 4, 5), mav.MAV_AUTOPILOT_PX4), ("ardupilot", (1, 12, 0), (1, 10, 0), 3)],
)
def test_version_and_modes(meet, identity, mode, other, autopilot):
    peer = meet(identity=identity)
    results, heard = peer.command(512, 148)
    assert results == [ACCEPTED]
    capabilities = heard["AUTOPILOT_VERSION"][0].capabilities
    byte_wise = bool(capabilities & mav.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE)
    c_cast = bool(capabilities & mav.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST)
    assert (byte_wise, c_cast) == (identity == "px4", identity == "ardupilot")
    assert capabilities & mav.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    assert capabilities & mav.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    for absent in ("MISSION_FENCE", "MISSION_RALLY", "FTP", "SET_ATTITUDE_TARGET"):
        assert not capabilities & getattr(mav, f"MAV_PROTOCOL_CAPABILITY_{absent}")
    results, heard = peer.command(512, 435)
    assert results == [ACCEPTED]
    assert heard["AVAILABLE_MODES"][0].number_modes == 1
    peer.publisher._heartbeat_at = -math.inf
    heartbeat = peer.hear("HEARTBEAT")
    assert heartbeat.autopilot == autopilot
    assert heartbeat.custom_mode == heard["AVAILABLE_MODES"][0].custom_mode
    assert peer.command(mav.MAV_CMD_DO_SET_MODE, *mode)[0] == [ACCEPTED]
    assert peer.command(mav.MAV_CMD_DO_SET_MODE, *other)[0] == [DENIED]
    assert peer.command(mav.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, 1)[1]["AUTOPILOT_VERSION"]
    peer.mav.autopilot_version_request_send(1, 1)
    assert peer.hear("AUTOPILOT_VERSION")
    peer.mav.set_mode_send(1, 1, 12345)
    assert peer.hear("COMMAND_ACK").result == DENIED


def test_any_streamed_message_can_be_asked_for(meet):
    peer = meet()
    for name in sorted({stream.message for stream in STREAMS} - {"AHRS2", "AHRS3"}):
        results, heard = peer.command(512, getattr(mav, f"MAVLINK_MSG_ID_{name}"))
        assert (name, results) == (name, [ACCEPTED])
        assert heard[name]
    assert peer.command(mav.MAV_CMD_GET_HOME_POSITION)[1]["HOME_POSITION"]
    assert peer.command(512, mav.MAVLINK_MSG_ID_AHRS2)[0] == [REJECTED]  # there is no other estimator now
    assert peer.command(512, mav.MAVLINK_MSG_ID_RC_CHANNELS)[0] == [DENIED]


def test_arming(meet):
    peer = meet()  # flies
    assert peer.command(400, 1)[0] == [ACCEPTED]
    assert peer.command(400, 0)[0] == [REJECTED]
    assert peer.command(400, 5)[0] == [DENIED]


def test_failures_are_injected(meet):
    peer = meet()
    assert peer.command(420, mav.FAILURE_UNIT_SENSOR_GPS, mav.FAILURE_TYPE_OFF, 0)[0] == [ACCEPTED]
    assert peer.asked == injection.injection(SCENARIO, "gnss", "off", 0)
    peer.asked.clear()
    assert peer.command(420, mav.FAILURE_UNIT_SENSOR_MAG, mav.FAILURE_TYPE_STUCK, 1)[0] == [ACCEPTED]
    assert peer.asked == injection.injection(SCENARIO, "magnetometer", "stuck", 1)
    peer.asked.clear()
    results, heard = peer.command(420, mav.FAILURE_UNIT_SENSOR_GPS, mav.FAILURE_TYPE_OFF, 3)
    assert results == [DENIED]
    assert "no gnss 3" in heard["STATUSTEXT"][0].text
    for unit, kind, instance, result in [
        (mav.FAILURE_UNIT_SYSTEM_MOTOR, 1, 0, UNSUPPORTED),
        (mav.FAILURE_UNIT_SENSOR_GPS, 99, 0, UNSUPPORTED),
        (math.nan, 1, 0, UNSUPPORTED),
        (mav.FAILURE_UNIT_SENSOR_GPS, 1, -1, DENIED),
        (mav.FAILURE_UNIT_SENSOR_GPS, 1, math.inf, DENIED),
    ]:
        assert peer.command(420, unit, kind, instance)[0] == [result]
    assert peer.asked == []


def test_pause_restart_and_end(meet):
    peer = meet()
    for number, param in ((193, 0), (193, 1), (246, 1), (246, 2), (246, 0)):
        assert peer.command(number, param)[0] == [ACCEPTED]
    assert peer.asked == [control.Pause(), control.Resume(), control.Restart(), control.End()]
    assert peer.command(193, math.nan)[0] == [DENIED]


# Rates


@pytest.mark.ci
def test_rates_are_the_stations_own(meet, port):
    peer, other = meet(), Peer(None, mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", dialect="all"))
    other.publisher = peer.publisher
    other.mav.heartbeat_send(6, 8, 0, 0, 0)
    other.hear("HEARTBEAT")
    attitude, position = mav.MAVLINK_MSG_ID_ATTITUDE, mav.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
    assert peer.command(511, attitude, 200_000)[0] == [ACCEPTED]
    assert peer.command(511, position, -1)[0] == [ACCEPTED]
    peer.drain(), other.drain()
    mine, theirs = peer.fly(range(100), other)
    assert (len(mine["ATTITUDE"]), len(mine["GLOBAL_POSITION_INT"])) == (20, 0)
    assert (len(theirs["ATTITUDE"]), len(theirs["GLOBAL_POSITION_INT"])) == (100, 40)
    assert len(mine["VFR_HUD"]) == len(theirs["VFR_HUD"]) == 20
    for number, interval in ((attitude, 200_000), (position, -1), (mav.MAVLINK_MSG_ID_RC_CHANNELS, 0)):
        results, heard = peer.command(510, number)
        assert results == [ACCEPTED]
        assert heard["MESSAGE_INTERVAL"][0].interval_us == interval
    assert peer.command(511, attitude, 0)[0] == [ACCEPTED]
    assert peer.command(510, attitude)[1]["MESSAGE_INTERVAL"][0].interval_us == 40_000
    for bad in ((9999, 1e6), (attitude, math.nan), (attitude, -7), (math.inf, 1)):
        assert peer.command(511, *bad)[0] == [DENIED]
    other.close()


@pytest.mark.ci
def test_data_streams(meet):
    peer = meet()
    peer.mav.request_data_stream_send(1, 1, mav.MAV_DATA_STREAM_ALL, 4, 1)
    peer.drain()
    heard = peer.fly(range(50))
    assert len(heard["ATTITUDE"]) == len(heard["VFR_HUD"]) == len(heard["GPS_RAW_INT"]) == 8
    peer.mav.request_data_stream_send(1, 1, mav.MAV_DATA_STREAM_EXTRA1, 10, 1)
    peer.mav.request_data_stream_send(1, 1, mav.MAV_DATA_STREAM_EXTRA2, 10, 0)
    peer.drain()
    heard = peer.fly(range(50, 100))
    assert (len(heard["ATTITUDE"]), len(heard["VFR_HUD"]), len(heard["GPS_RAW_INT"])) == (20, 0, 8)
    peer.mav.request_data_stream_send(1, 1, mav.MAV_DATA_STREAM_ALL, 0, 0)
    peer.drain()
    peer.publisher._heartbeat_at = -math.inf
    assert set(peer.fly(range(100, 150))) == {"HEARTBEAT", "HOME_POSITION"}


# Times, files, logs


def test_times_files_and_logs(meet):
    peer = meet(calls=26)
    peer.mav.ping_send(123456, 7, 0, 0)
    ping = peer.hear("PING")
    assert (ping.time_usec, ping.seq, ping.target_system) == (123456, 7, 255)
    peer.mav.timesync_send(0, 987654321)
    sync = peer.hear("TIMESYNC")
    assert (sync.tc1, sync.ts1) == (1_000_000_000, 987654321)
    peer.mav.timesync_send(5, 987654321)
    peer.mav.ping_send(1, 1, 1, 1)
    assert not {"TIMESYNC", "PING"} & set(peer.drain())
    peer.mav.file_transfer_protocol_send(0, 1, 1, [7, 0, 3, 4, 5, *[0] * 246])
    reply = peer.hear("FILE_TRANSFER_PROTOCOL")
    assert (reply.payload[:6], reply.target_system) == ([8, 0, 3, 129, 1, 4], 255)
    peer.mav.log_request_list_send(1, 1, 0, 2**16 - 1)
    assert peer.hear("LOG_ENTRY").num_logs == 0
    peer.mav.log_request_data_send(1, 1, 3, 100, 90)
    assert peer.hear("LOG_DATA").count == 0


# Who may do what


def test_readonly(meet):
    peer = meet(readonly=True)
    for number, *params in ((420, 4, 1, 0), (193, 0), (246, 1), (176, 1, 4, 3), (400, 1)):
        assert peer.command(number, *params)[0] == [DENIED]
    peer.mav.param_set_send(1, 1, b"SIM_GPS1_JAM", encoded(1), mav.MAV_PARAM_TYPE_INT32)
    heard = peer.drain()
    assert heard["PARAM_ERROR"][0].error == mav.MAV_PARAM_ERROR_PERMISSION_DENIED
    assert decoded(heard["PARAM_VALUE"][0]) == 0
    assert peer.command(512, 148)[0] == [ACCEPTED]
    assert peer.command(31000)[0] == [UNSUPPORTED]
    peer.mav.param_request_list_send(1, 1)
    assert peer.hear("PARAM_VALUE")
    assert peer.asked == []


def signed(peer, key, timestamp=None):
    """Let a station sign, as MAVProxy does it."""
    peer.connection.setup_signing(hashlib.sha256(key.encode()).digest(), initial_timestamp=timestamp)


def test_signed_commands_are_heard_and_answers_are_signed(meet):
    peer = meet(key="a secret", hello=False)
    signed(peer, "a secret")
    publish(peer.publisher, range(1))
    assert peer.command(193, 0)[0] == [ACCEPTED]
    assert peer.asked == [control.Pause()]
    heard = peer.fly(range(1, 26))
    assert len(heard["ATTITUDE"]) == 25
    assert all(message._signed for own in heard.values() for message in own)
    assert not heard["BAD_DATA"]


@pytest.mark.parametrize("how", ["unsigned", "another key", "old"])
def test_what_is_not_signed_right_does_nothing(meet, how):
    peer = meet(key="a secret", hello=False)
    if how == "another key":
        signed(peer, "another secret")
    elif how == "old":  # recorded two minutes ago, say
        signed(peer, "a secret", timestamp=int((time.time() - 1420070400 - 120) * 1e5))
    publish(peer.publisher, range(1))
    for _ in range(3):
        peer.command(193, 0)
        peer.command(420, 4, 1, 0)
    assert peer.asked == []
    assert peer.publisher._links[0].stations == []


def test_replayed_command_does_nothing(meet, port):
    peer = meet(key="a secret", hello=False)
    signed(peer, "a secret")
    sent = []
    write = peer.connection.write
    peer.connection.write = lambda data: (sent.append(bytes(data)), write(data))
    assert peer.command(193, 0)[0] == [ACCEPTED]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as thief:
        for frame in sent:
            thief.sendto(frame, ("127.0.0.1", port))
        peer.drain()
    assert peer.asked == [control.Pause()]


@pytest.mark.parametrize("key", ["", "  ", "0123456789abcdef" * 2, "0" * 65])
def test_bad_key_is_named(key):
    with pytest.raises(UserError, match="--mavlink-key"):
        MavlinkPublisher([], SCENARIO, key=key)


def test_keys_as_stations_make_them():
    assert signing.key_bytes("00" * 31 + "Ff") == bytes(31) + b"\xff"
    assert signing.key_bytes("password") == hashlib.sha256(b"password").digest()


def test_unknown_identity_is_named():
    with pytest.raises(UserError, match="choose from px4, ardupilot"):
        MavlinkPublisher([], SCENARIO, identity="paparazzi")


# Several of everything


@pytest.mark.ci
def test_two_stations_a_late_one_and_one_that_vanishes(meet, port, monkeypatch):
    peer = meet()
    peer.fly(range(1, 30))
    late = Peer(peer.publisher, mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", dialect="all"))
    late.mav.heartbeat_send(6, 8, 0, 0, 0)
    late.drain()
    for heard in peer.fly(range(30, 90), late):
        assert len(heard["ATTITUDE"]) == 60
        assert heard["HOME_POSITION"]
    late.mav.param_request_list_send(1, 1)
    assert late.hear("PARAM_VALUE")
    assert "PARAM_VALUE" not in peer.drain()  # who asks is answered
    for one in (peer, late):
        assert one.connection.mav_loss == 0  # numbers without gaps, whoever else was talked to
    peer.close()
    monkeypatch.setattr(link, "FORGET_S", 0.0)
    time.sleep(0.01)
    late.mav.heartbeat_send(6, 8, 0, 0, 0)
    late.drain()
    assert len(peer.publisher._links[0].stations) <= 1
    late.close()


def test_strangers_that_speak_no_mavlink_are_no_stations(meet, port):
    peer = meet()
    for k in range(50):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.sendto(b"GET / HTTP/1.1\r\n\r\n" * k, ("127.0.0.1", port))
    peer.drain()
    assert len(peer.publisher._links[0].stations) == 1
    assert len(peer.publisher._talks) == 1


def test_station_on_tcp_and_on_a_known_address(port):
    for url, theirs in ((f"tcpin:127.0.0.1:{port}", f"tcp:127.0.0.1:{port}"),):
        publisher = MavlinkPublisher([url], SCENARIO)
        peer = Peer(publisher, mavutil.mavlink_connection(theirs, dialect="all"))
        publish(publisher, range(2))
        assert peer.command(512, 148)[0] == [ACCEPTED]
        peer.close()
        publish(publisher, range(2, 40))
        assert publisher._links[0].stations == []
        publisher.close()
    station = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", dialect="all")
    publisher = MavlinkPublisher([f"udpout:127.0.0.1:{port}"], SCENARIO)
    peer = Peer(publisher, station)
    assert peer.hear("HEARTBEAT")
    assert peer.command(512, 148)[0] == [ACCEPTED]
    peer.close()
    publisher.close()


def test_serial_port():
    ours, theirs = pty.openpty()
    name = os.ttyname(theirs)
    publisher = MavlinkPublisher([f"serial:{name}:115200"], SCENARIO)
    os.set_blocking(ours, False)
    station = mav.MAVLink(None, srcSystem=255)
    station.robust_parsing = True
    request = mav.MAVLink_command_long_message(1, 1, 512, 0, 148, 0, 0, 0, 0, 0, 0)
    os.write(ours, request.pack(station))
    heard = []
    until = time.monotonic() + PATIENCE_S
    while not {"COMMAND_ACK", "AUTOPILOT_VERSION"} <= {m.get_type() for m in heard} and time.monotonic() < until:
        publisher.requests()
        try:
            heard += station.parse_buffer(os.read(ours, 4096)) or []
        except BlockingIOError:
            time.sleep(0.001)
    assert {"HEARTBEAT", "COMMAND_ACK", "AUTOPILOT_VERSION"} <= {m.get_type() for m in heard}
    os.close(ours)
    os.close(theirs)
    publish(publisher, range(50))  # pulled out: nothing happens
    assert publisher._links[0].stations == []
    publisher.close()
    publisher.close()


def test_vehicles(meet):
    from worlds.mavlink import estimate, position

    peer = meet(calls=0, vehicles=True)
    both = [("second", estimate(1.0, offset_h=50.0)), ("third", estimate(1.0, offset_h=90.0))]
    publish(peer.publisher, range(1), others=lambda t: both)
    heard = peer.drain()
    for name, messages in peer.fly(range(1, 26), others=lambda t: both).items():
        heard[name] += messages
    peer.publisher._heartbeat_at = -math.inf
    heard["HEARTBEAT"] += peer.drain()["HEARTBEAT"]
    assert {m.get_srcSystem() for m in heard["HEARTBEAT"]} == {1, 2, 3, 4}
    assert {m.get_srcComponent() for m in heard["HEARTBEAT"]} == {1}
    assert {m.text for m in heard["STATUSTEXT"]} >= {"system 2 is truth", "system 3 is second", "system 4 is third"}
    by_system = {m.get_srcSystem(): m for m in heard["GLOBAL_POSITION_INT"]}
    h = position(1.0)[2]
    assert by_system[3].alt == pytest.approx((h + 50) * 1e3, abs=1)
    assert by_system[4].alt == pytest.approx((h + 90) * 1e3, abs=1)
    assert {m.get_srcSystem() for m in heard["ATTITUDE"]} == {1, 2, 3, 4}
    assert "AHRS2" not in heard
    for system in (2, 3, 4):
        results, answers = peer.command(512, 148, system=system)
        assert results == [ACCEPTED]
        assert answers["AUTOPILOT_VERSION"][0].get_srcSystem() == system
        assert peer.command(420, 4, 1, 0, system=system)[0] == [DENIED]
        peer.mav.param_request_list_send(system, 1)
        assert [decoded(m) for m in peer.drain()["PARAM_VALUE"]] == [system]
        peer.mav.mission_request_list_send(system, 1)
        assert peer.hear("MISSION_COUNT").count == 0
    assert peer.asked == []
    assert peer.connection.mav_loss == 0


def test_rates_are_of_the_vehicle_that_was_asked(meet):
    peer = meet(vehicles=True)
    attitude = mav.MAVLINK_MSG_ID_ATTITUDE
    assert peer.command(511, attitude, -1, system=1)[0] == [ACCEPTED]
    said = collections.Counter(m.get_srcSystem() for m in peer.fly(range(1, 26))["ATTITUDE"])
    assert (said[1], said[2]) == (0, 10)
    assert peer.command(510, attitude, system=2)[1]["MESSAGE_INTERVAL"][0].interval_us == 100_000
    peer.mav.request_data_stream_send(2, 1, mav.MAV_DATA_STREAM_ALL, 5, 1)
    peer.drain()
    said = collections.Counter(m.get_srcSystem() for m in peer.fly(range(26, 51))["ATTITUDE"])
    assert (said[1], said[2]) == (0, 5)


def test_who_is_not_let_in_is_not_heard(meet, monkeypatch, port):
    peer = meet()
    monkeypatch.setattr(link, "MOST_STATIONS", 1)
    late = Peer(peer.publisher, mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", dialect="all"))
    assert late.command(mav.MAV_CMD_DO_PAUSE_CONTINUE, 0)[0] == []
    assert late.asked == []
    assert peer.command(mav.MAV_CMD_DO_PAUSE_CONTINUE, 0)[0] == [ACCEPTED]
    late.close()


# The wall clock and the run's


def test_heart_beats_while_the_run_is_paused(meet, monkeypatch):
    peer = meet()
    now = time.monotonic()
    beats = 0
    for k in range(200):
        monkeypatch.setattr("testbed.mavlink.publisher.time.monotonic", lambda k=k: now + 10 + 0.02 * k)
        peer.publisher.requests()
        while message := peer.connection.recv_match():
            beats += message.get_type() == "HEARTBEAT"
    assert 4 <= beats <= 5


@pytest.mark.ci
def test_log_does_not_depend_on_who_asks(tmp_path, port):
    def flown(name, urls):
        publisher = MavlinkPublisher([f"tlog:{tmp_path / name}", *urls], SCENARIO)
        peer = Peer(publisher, mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", dialect="all"))
        for k in range(8):
            peer.mav.param_request_list_send(1, 1)
            peer.mav.command_long_send(1, 1, 511, 0, 30, 1e5 * k, 0, 0, 0, 0, 0)
            peer.mav.command_long_send(1, 1, 512, 0, 31, 0, 0, 0, 0, 0, 0)
            publish(publisher, range(20 * k, 20 * (k + 1)))
        publisher.event(6.0, "warning", "gnss denied")
        publisher.close()
        peer.close()
        return (tmp_path / name).read_bytes()

    alone = flown("alone.tlog", [])
    assert flown("asked.tlog", [f"udpin:127.0.0.1:{port}"]) == alone
    numbers = [message.get_seq() for _, message in read_log(tmp_path / "asked.tlog")]
    assert numbers == [k % 256 for k in range(len(numbers))]


def test_restart_forgets_what_was_set(meet):
    peer = meet(calls=30)
    peer.mav.param_set_send(1, 1, b"SIM_GPS1_JAM", encoded(1), mav.MAV_PARAM_TYPE_INT32)
    assert decoded(peer.hear("PARAM_VALUE")) == 1
    peer.publisher.settings({"SIM_GPS1_JAM": 0.0})  # as a run does when it begins
    publish(peer.publisher, range(1))
    peer.drain()
    peer.mav.param_request_read_send(1, 1, b"SIM_GPS1_JAM", -1)
    assert decoded(peer.hear("PARAM_VALUE")) == 0


def test_stations_are_told_what_another_has_changed(meet):
    peer = meet(calls=30)
    peer.publisher.settings({"SIM_GPS1_JAM": 0.0})
    peer.drain()
    peer.publisher.settings({"SIM_GPS1_JAM": 1.0})
    assert decoded(peer.hear("PARAM_VALUE")) == 1


def test_asking_nothing_costs_next_to_nothing(meet):
    peer = meet()
    peer.publisher.requests()
    with Calls() as calls:
        for _ in range(1000):  # a heartbeat or two among them
            peer.publisher.requests()
    assert calls.count < 12 * 1000
