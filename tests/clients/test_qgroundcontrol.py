"""QGroundControl's questions after it has found a vehicle, in its order: each is answered. How soon, the bench says.

The order is that of its InitialConnectStateMachine: version, modes, metadata, parameters, mission, home; then what its
toolbar and its menus send.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import all as mav
from worlds.programs import START_S

from testbed import Scenario

ANSWER_S = 30.0  # patience: what is not answered by then never will be
PROTOCOL_VERSION, COMPONENT_INFORMATION, COMPONENT_METADATA = 300, 395, 397  # not in the dialect shipped


class Station:
    """System 255, component 190, with a heartbeat once per second."""

    def __init__(self, port: int) -> None:
        self.connection = mavutil.mavlink_connection(
            f"udpin:127.0.0.1:{port}", dialect="all", source_system=255, source_component=190
        )
        self._heard, self._beaten = False, 0.0

    @property
    def send(self) -> Any:
        return self.connection.mav

    def hear(self, within_s: float) -> Iterator[Any]:
        """What the vehicle says in the given time."""
        limit = time.monotonic() + within_s
        while (left := limit - time.monotonic()) > 0:
            if self._heard and time.monotonic() - self._beaten > 1:
                self.send.heartbeat_send(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, mav.MAV_STATE_ACTIVE)
                self._beaten = time.monotonic()
            message = self.connection.recv_match(blocking=True, timeout=min(left, 0.1))
            if message is None or message.get_srcSystem() != 1:
                continue
            self._heard = self._heard or message.get_type() == "HEARTBEAT"
            yield message

    def wait(self, kind: str, within_s: float = ANSWER_S, **fields: Any) -> Any:
        for message in self.hear(within_s):
            if message.get_type() == kind and all(getattr(message, key) == value for key, value in fields.items()):
                return message
        pytest.fail(f"no {kind} {fields} within {within_s} s")

    def command(self, command: int, *parameters: float) -> int:
        """Result of a command's acknowledgement."""
        self.send.command_long_send(1, 1, command, 0, *parameters, *[0] * (7 - len(parameters)))
        result: int = self.wait("COMMAND_ACK", command=command).result
        return result

    def request(self, identifier: int, kind: str, *parameters: float) -> Any:
        """The message asked for, None when that was refused; the answer may be before or behind its acknowledgement."""
        command = mav.MAV_CMD_REQUEST_MESSAGE
        self.send.command_long_send(1, 1, command, 0, identifier, *parameters, *[0] * (6 - len(parameters)))
        result, answer = None, None
        for message in self.hear(ANSWER_S):
            if message.get_type() == "COMMAND_ACK" and message.command == command:
                result = message.result
            elif message.get_type() == kind:
                answer = message
            if result is not None and (result != mav.MAV_RESULT_ACCEPTED or answer is not None):
                return answer if result == mav.MAV_RESULT_ACCEPTED else None
        pytest.fail(f"{kind}: result {result}, answer {answer} within {ANSWER_S} s")

    def mission(self, kind: int) -> list[Any]:
        """Every item of a mission; none when there are none or that is refused."""
        self.send.mission_request_list_send(1, 1, kind)
        for message in self.hear(ANSWER_S):
            if message.get_type() == "MISSION_ACK" and message.mission_type == kind:
                return []
            if message.get_type() == "MISSION_COUNT" and message.mission_type == kind:
                break
        else:
            pytest.fail(f"no MISSION_COUNT of type {kind} within {ANSWER_S} s")
        items = []
        for i in range(message.count):
            self.send.mission_request_int_send(1, 1, i, kind)
            items.append(self.wait("MISSION_ITEM_INT", seq=i))
        self.send.mission_ack_send(1, 1, mav.MAV_MISSION_ACCEPTED, kind)
        return items


@pytest.fixture(params=["px4", pytest.param("ardupilot", marks=pytest.mark.slow)])
def station(
    fly: Callable[..., int], monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> Iterator[Station]:
    monkeypatch.setenv("MAVLINK20", "1")
    port = fly("u_turn", "--mavlink-identity", request.param, realtime=2)
    station = Station(port)
    yield station
    station.connection.close()


@pytest.mark.ci
def test_connect_sequence(station: Station) -> None:
    first = station.wait("HEARTBEAT", START_S, system_status=mav.MAV_STATE_ACTIVE)
    px4 = first.autopilot == mav.MAV_AUTOPILOT_PX4
    assert first.get_srcComponent() == mav.MAV_COMP_ID_AUTOPILOT1
    assert first.type == mav.MAV_TYPE_FIXED_WING

    version = station.request(mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION, "AUTOPILOT_VERSION")
    assert version is not None
    assert version.capabilities & mav.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    assert version.capabilities & mav.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    for absent in (mav.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE, mav.MAV_PROTOCOL_CAPABILITY_MISSION_RALLY):
        assert not version.capabilities & absent
    union = mav.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    assert bool(version.capabilities & union) == px4

    station.request(mav.MAVLINK_MSG_ID_AVAILABLE_MODES, "AVAILABLE_MODES", 0)
    station.request(COMPONENT_METADATA, "COMPONENT_METADATA")
    station.request(COMPONENT_INFORMATION, "COMPONENT_INFORMATION")
    if not px4:  # parameters are tried as a file first
        opcode_open, opcode_nak = 4, 129
        path = b"@PARAM/param.pck"
        payload = [0, 0, 0, opcode_open, len(path), 0, 0, 0, 0, 0, 0, 0, *path]
        station.send.file_transfer_protocol_send(0, 1, 1, payload + [0] * (251 - len(payload)))
        assert station.wait("FILE_TRANSFER_PROTOCOL").payload[3] == opcode_nak

    station.send.param_request_list_send(1, 1)
    value = station.wait("PARAM_VALUE")
    values = {value.param_index: value}
    for message in station.hear(5):
        if message.get_type() == "PARAM_VALUE":
            values[message.param_index] = message
        if len(values) == value.param_count:
            break
    assert sorted(values) == list(range(value.param_count))
    assert len({message.param_id for message in values.values()}) == len(values)
    last = values[value.param_count - 1]
    station.send.param_request_read_send(1, 1, last.param_id.encode(), -1)
    assert station.wait("PARAM_VALUE", param_id=last.param_id).param_value == last.param_value

    items = station.mission(mav.MAV_MISSION_TYPE_MISSION)
    assert len(items) >= len(Scenario.load("u_turn").plan)
    assert any(abs(item.x - 47e7) < 1e6 and abs(item.y - 8e7) < 1e6 for item in items)
    assert station.mission(mav.MAV_MISSION_TYPE_FENCE) == []
    assert station.mission(mav.MAV_MISSION_TYPE_RALLY) == []

    home = station.request(mav.MAVLINK_MSG_ID_HOME_POSITION, "HOME_POSITION")
    assert home is not None
    assert abs(home.latitude - 47e7) < 1e6
    station.request(PROTOCOL_VERSION, "PROTOCOL_VERSION")

    assert station.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, mav.MAVLINK_MSG_ID_ATTITUDE, 50_000) == 0
    assert station.command(mav.MAV_CMD_GET_HOME_POSITION) in (mav.MAV_RESULT_ACCEPTED, mav.MAV_RESULT_UNSUPPORTED)
    assert station.command(31999) == mav.MAV_RESULT_UNSUPPORTED
    for command, *parameters in (
        (mav.MAV_CMD_COMPONENT_ARM_DISARM, 1),
        (mav.MAV_CMD_DO_SET_MODE, first.base_mode, first.custom_mode >> 16 & 255, first.custom_mode >> 24),
        (mav.MAV_CMD_NAV_RETURN_TO_LAUNCH,),
        (mav.MAV_CMD_START_RX_PAIR, 0),
        (mav.MAV_CMD_PREFLIGHT_CALIBRATION, 1),
    ):
        station.command(command, *parameters)  # whatever the answer: there is one
    station.send.command_int_send(1, 1, 0, mav.MAV_CMD_DO_REPOSITION, 0, 0, 0, 0, 0, 0, 470000000, 80000000, 300)
    station.wait("COMMAND_ACK", command=mav.MAV_CMD_DO_REPOSITION)
    station.send.timesync_send(0, 12345)
    assert station.wait("TIMESYNC", ts1=12345).tc1 != 0
    station.send.ping_send(0, 7, 0, 0)
    station.wait("PING", seq=7)
    station.send.request_data_stream_send(1, 1, mav.MAV_DATA_STREAM_ALL, 4, 1)
    station.wait("ATTITUDE")
