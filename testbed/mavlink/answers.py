"""What a vehicle answers when stations ask: parameters, the mission, commands, versions, times, files, logs.

Every request gets an answer, also when it is no: stations that hear nothing wait and ask again. What concerns the run
becomes a request of `testbed.loop.requests`. What is never done here is denied, what is unknown is unsupported, as
https://mavlink.io/en/messages/common.html#MAV_RESULT has it.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from pymavlink.dialects.v20 import all as mav  # type: ignore[import-untyped]

from testbed.loop import injection
from testbed.loop import requests as control
from testbed.mavlink import messages, mission
from testbed.mavlink.encode import Encoder, Fields, Voice
from testbed.mavlink.identity import Identity, autopilot_version, available_mode, current_mode
from testbed.mavlink.link import Station
from testbed.mavlink.parameters import Parameters, refusal
from testbed.mavlink.receive import Message, Reader, whole_number
from testbed.mavlink.signing import Signing
from testbed.mavlink.snapshot import Snapshot
from testbed.mavlink.stream import PUBLISH_HZ, STREAMS, Stream
from testbed.scenario import Scenario

COMPONENT = mav.MAV_COMP_ID_AUTOPILOT1
_PARAMETERS_A_TURN = 10
_NAK, _FTP_FAIL = 129, 1  # MAVFTP's opcode and error: https://mavlink.io/en/services/ftp.html

_UNITS = {
    mav.FAILURE_UNIT_SENSOR_GYRO: "gyro",
    mav.FAILURE_UNIT_SENSOR_ACCEL: "accelerometer",
    mav.FAILURE_UNIT_SENSOR_MAG: "magnetometer",
    mav.FAILURE_UNIT_SENSOR_BARO: "barometer",
    mav.FAILURE_UNIT_SENSOR_GPS: "gnss",
    mav.FAILURE_UNIT_SENSOR_AIRSPEED: "airspeed",
}
_FAILURES = {
    mav.FAILURE_TYPE_OK: "ok",
    mav.FAILURE_TYPE_OFF: "off",
    mav.FAILURE_TYPE_STUCK: "stuck",
    mav.FAILURE_TYPE_GARBAGE: "garbage",
    mav.FAILURE_TYPE_WRONG: "wrong",
    mav.FAILURE_TYPE_SLOW: "slow",
    mav.FAILURE_TYPE_DELAYED: "delayed",
    mav.FAILURE_TYPE_INTERMITTENT: "intermittent",
}
# What an aircraft that follows its plan doesn't do for a station.
_NOT_DONE = (
    mav.MAV_CMD_NAV_LOITER_UNLIM,
    mav.MAV_CMD_NAV_RETURN_TO_LAUNCH,
    mav.MAV_CMD_NAV_LAND,
    mav.MAV_CMD_NAV_TAKEOFF,
    mav.MAV_CMD_DO_CHANGE_SPEED,
    mav.MAV_CMD_DO_SET_HOME,
    mav.MAV_CMD_DO_REPOSITION,
    mav.MAV_CMD_DO_ORBIT,
    mav.MAV_CMD_DO_LAND_START,
    mav.MAV_CMD_DO_SET_MISSION_CURRENT,
    mav.MAV_CMD_DO_FLIGHTTERMINATION,
    mav.MAV_CMD_MISSION_START,
    mav.MAV_CMD_DO_SET_STANDARD_MODE,
)

Params: TypeAlias = Sequence[float]


class Talk:
    """What has passed between us and one station, as long as it is there."""

    def __init__(self, signing: Signing | None) -> None:
        self._reader = Reader(signing)
        self._voice = Voice(signing)
        self.due: list[bytes] = []  # frames for the next `flush`
        self.rates: defaultdict[int, dict[str, float]] = defaultdict(dict)  # [Hz] asked for, by vehicle and message
        self.lists: dict[int, int] = {}  # the parameter that is next in the list under way, by vehicle

    def hear(self, station: Station, data: bytes) -> list[Message]:
        """The messages in what it said; with the first it is one of ours, and who isn't let in is not heard."""
        heard = list(self._reader.read(data, station.datagrams))
        return heard if heard and station.admit() else []

    def flush(self, station: Station, frames: Sequence[bytes] = ()) -> None:
        """Send what is due, and ``frames``."""
        if self.due or frames:
            station.send([self._voice.say(frame) for frame in (*self.due, *frames)])
            self.due.clear()


@dataclass(frozen=True, slots=True)
class Vehicle:
    """What a vehicle has to tell: as which system, in whose ways, its parameters, mission and streams."""

    identity: Identity
    parameters: Parameters
    items: Sequence[mission.Item] = ()
    streams: Sequence[Stream] = STREAMS
    system: int = 1


class Answers:
    """The answering side of one vehicle.

    ``snapshot`` is the newest row, None before the first; ``asked`` collects what concerns the run.
    """

    def __init__(self, vehicle: Vehicle, scenario: Scenario | None = None, readonly: bool = False) -> None:
        """Without a ``scenario`` nothing can be injected; ``readonly`` denies all that changes the run."""
        self.snapshot: Snapshot | None = None
        self.asked: list[control.Request] = []
        self._identity, self._system = vehicle.identity, vehicle.system
        self._parameters, self._items = vehicle.parameters, vehicle.items
        self._streams: defaultdict[str, list[Stream]] = defaultdict(list)
        for stream in vehicle.streams:
            self._streams[stream.message].append(stream)
        self._numbers = {mav_id(name): name for name in self._streams}
        self._scenario, self._readonly = scenario, readonly
        self.encoder = Encoder(self._system, COMPONENT)
        self._texts = 0
        self._requests, self._commands, self._changes = self._by_message(), self._by_command(), self._by_change()

    def _by_message(self) -> Mapping[str, Callable[[Message, Talk], None]]:
        """Who answers a message."""
        return {
            "PARAM_REQUEST_LIST": self._param_list,
            "PARAM_REQUEST_READ": self._param_read,
            "PARAM_SET": self._param_set,
            "MISSION_REQUEST_LIST": self._mission_list,
            "MISSION_REQUEST_INT": self._mission_item,
            "MISSION_REQUEST": self._mission_item,
            **dict.fromkeys(
                (
                    "MISSION_COUNT",
                    "MISSION_CLEAR_ALL",
                    "MISSION_WRITE_PARTIAL_LIST",
                    "MISSION_ITEM",
                    "MISSION_ITEM_INT",
                ),
                self._mission_refuse,
            ),
            "MISSION_SET_CURRENT": self._mission_current,
            "COMMAND_LONG": self._command_long,
            "COMMAND_INT": self._command_int,
            "SET_MODE": self._set_mode,
            "REQUEST_DATA_STREAM": self._data_stream,
            "AUTOPILOT_VERSION_REQUEST": self._version,
            "PING": self._ping,
            "TIMESYNC": self._timesync,
            "FILE_TRANSFER_PROTOCOL": self._file,
            "LOG_REQUEST_LIST": self._log_list,
            "LOG_REQUEST_DATA": self._log_data,
        }

    def _by_command(self) -> Mapping[int, Callable[[Params, Talk], int]]:
        """Who answers a command that changes nothing."""
        return {
            mav.MAV_CMD_REQUEST_MESSAGE: self._request_message,
            mav.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_interval,
            mav.MAV_CMD_GET_MESSAGE_INTERVAL: self._get_interval,
            mav.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: self._capabilities,
            mav.MAV_CMD_GET_HOME_POSITION: lambda params, talk: self._stream("HOME_POSITION", talk),
        }

    def _by_change(self) -> Mapping[int, Callable[[Params, Talk], int]]:
        """Who answers a command that changes the run."""
        return {
            mav.MAV_CMD_DO_SET_MODE: self._do_set_mode,
            mav.MAV_CMD_COMPONENT_ARM_DISARM: self._arm,
            mav.MAV_CMD_INJECT_FAILURE: self._inject,
            mav.MAV_CMD_DO_PAUSE_CONTINUE: self._pause,
            mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: self._reboot,
            **dict.fromkeys(_NOT_DONE, lambda params, talk: int(mav.MAV_RESULT_DENIED)),
        }

    def answer(self, message: Message, talk: Talk) -> None:
        """Answer a message, if it is one that wants an answer of this vehicle."""
        request = self._requests.get(message.name)
        is_ours = message.target in (0, self._system) and message.target_component in (0, COMPONENT)
        if request and is_ours and (message.system, message.component) != (self._system, COMPONENT):
            request(message, talk)

    def go_on(self, talk: Talk) -> None:
        """Send the next few parameters of a list under way."""
        at = talk.lists.get(self._system)
        if at is None:
            return
        end = min(at + _PARAMETERS_A_TURN, len(self._parameters))
        for index in range(at, end):
            self._say(talk, "PARAM_VALUE", self._parameters.value(index))
        if end < len(self._parameters):
            talk.lists[self._system] = end
        else:
            del talk.lists[self._system]

    def heartbeat(self) -> bytes:
        """A HEARTBEAT of now."""
        return self.encoder.frame("HEARTBEAT", messages.heartbeat(self.snapshot, self._identity))

    def frame(self, stream: Stream) -> bytes | None:
        """The newest of a stream; None when there is nothing to say."""
        with np.errstate(all="ignore"):  # an estimate may be anything; the encoder copes
            payload = stream.payload(self.snapshot) if self.snapshot else None
        return self.encoder.wrap(stream.message, payload) if payload else None

    def _say(self, talk: Talk, name: str, fields: Fields) -> None:
        talk.due.append(self.encoder.frame(name, fields))

    def _text(self, talk: Talk, text: str) -> None:
        chunks = messages.statustext("warning", text, self._texts)
        self._texts += 1
        for chunk in chunks:
            self._say(talk, "STATUSTEXT", chunk)

    # Parameters

    def _param_list(self, message: Message, talk: Talk) -> None:
        talk.lists[self._system] = 0

    def _param_read(self, message: Message, talk: Talk) -> None:
        fields = self._parameters.sought(message)
        if fields:
            self._say(talk, "PARAM_VALUE", fields)
        else:
            self._param_error(message, talk, message["param_index"], mav.MAV_PARAM_ERROR_DOES_NOT_EXIST)

    def _param_set(self, message: Message, talk: Talk) -> None:
        verdict = self._parameters.judge(message)
        error = verdict.error
        if self._readonly and not error:
            error = mav.MAV_PARAM_ERROR_PERMISSION_DENIED
        if error:
            self._param_error(message, talk, -1, error)
        else:
            self._parameters.put(verdict.name, verdict.value)
            self.asked.append(control.Change(verdict.name, verdict.value))
        fields = self._parameters.in_force(verdict.name)
        if fields:
            self._say(talk, "PARAM_VALUE", fields)

    def _param_error(self, message: Message, talk: Talk, index: int, error: int) -> None:
        self._say(talk, "PARAM_ERROR", {**refusal(message["param_id"], index, error), **_to(message)})

    # The mission

    def _mission_list(self, message: Message, talk: Talk) -> None:
        kind = message["mission_type"]
        count = len(self._items) if kind == mav.MAV_MISSION_TYPE_MISSION else 0
        self._say(talk, "MISSION_COUNT", {"count": count, "mission_type": kind, "opaque_id": 0, **_to(message)})

    def _mission_item(self, message: Message, talk: Talk) -> None:
        number, kind = message["seq"], message["mission_type"]
        if kind != mav.MAV_MISSION_TYPE_MISSION or number >= len(self._items):
            self._mission_ack(message, talk, kind, mav.MAV_MISSION_INVALID_SEQUENCE)
            return
        fields = mission.fields(self._items, number, self._current(), self._home_h())
        if message.name == "MISSION_REQUEST":
            self._say(talk, "MISSION_ITEM", {**mission.with_floats(fields), **_to(message)})
        else:
            self._say(talk, "MISSION_ITEM_INT", {**fields, **_to(message)})

    def _mission_refuse(self, message: Message, talk: Talk) -> None:
        kind = message["mission_type"]
        is_mission = kind == mav.MAV_MISSION_TYPE_MISSION
        self._mission_ack(message, talk, kind, mav.MAV_MISSION_DENIED if is_mission else mav.MAV_MISSION_UNSUPPORTED)

    def _mission_ack(self, message: Message, talk: Talk, kind: int, result: int) -> None:
        self._say(talk, "MISSION_ACK", {"type": result, "mission_type": kind, "opaque_id": 0, **_to(message)})

    def _mission_current(self, message: Message, talk: Talk) -> None:
        for stream in self._streams.get("MISSION_CURRENT", ()):
            frame = self.frame(stream)
            if frame:
                talk.due.append(frame)

    def _home_h(self) -> float:
        """Height of home, as HOME_POSITION has it; before it is known, the start's."""
        if self.snapshot and self.snapshot.home:
            return self.snapshot.home[2]
        start = self._scenario.truth.start if self._scenario else None
        return float(start.alt_m) if start else 0.0

    def _current(self) -> int:
        return messages.current_item(self.snapshot) if self.snapshot else 0

    # Commands

    def _command_long(self, message: Message, talk: Talk) -> None:
        self._command(message, talk, [message[f"param{k}"] for k in range(1, 8)])

    def _command_int(self, message: Message, talk: Talk) -> None:
        place = [float(message["x"]), float(message["y"]), message["z"]]
        self._command(message, talk, [message[f"param{k}"] for k in range(1, 5)] + place)

    def _command(self, message: Message, talk: Talk, params: Params) -> None:
        number = message["command"]
        before = len(talk.due)
        if number in self._commands:
            result = self._commands[number](params, talk)
        elif number in self._changes:
            result = mav.MAV_RESULT_DENIED if self._readonly else self._changes[number](params, talk)
        else:
            result = mav.MAV_RESULT_UNSUPPORTED
        # What the command asks to be said comes after its acknowledgement.
        talk.due.insert(before, self._ack(message, number, result))

    def _ack(self, message: Message, command: int, result: int) -> bytes:
        fields = {"command": command, "result": result, "progress": 0, "result_param2": 0, **_to(message)}
        return self.encoder.frame("COMMAND_ACK", fields)

    def _set_mode(self, message: Message, talk: Talk) -> None:
        """The message that was there before the command: acknowledged by its own number, as ArduPilot does."""
        is_mode = message["custom_mode"] == self._identity.mode and not self._readonly
        talk.due.append(self._ack(message, mav.MAVLINK_MSG_ID_SET_MODE, _granted(is_mode)))

    def _do_set_mode(self, params: Params, talk: Talk) -> int:
        """The one mode that there is may be asked for: it is flown already."""
        main, sub = whole_number(params[1]), whole_number(params[2])
        mode = self._identity.mode
        is_mode = (main, sub) == (mode >> 16 & 0xFF, mode >> 24) if mode >> 16 else main == mode
        return _granted(is_mode)

    def _arm(self, params: Params, talk: Talk) -> int:
        """Arming what flies and disarming what doesn't change nothing; the engine is not stopped in flight."""
        if params[0] not in (0.0, 1.0):
            return int(mav.MAV_RESULT_DENIED)
        flying = bool(self.snapshot and self.snapshot.flying)
        if (params[0] == 1.0) == flying:
            return int(mav.MAV_RESULT_ACCEPTED)
        return int(mav.MAV_RESULT_TEMPORARILY_REJECTED)

    def _inject(self, params: Params, talk: Talk) -> int:
        unit, kind, instance = (whole_number(value) for value in params[:3])
        if unit not in _UNITS or kind not in _FAILURES or self._scenario is None:
            return int(mav.MAV_RESULT_UNSUPPORTED)
        if instance is None or instance < 0:
            return int(mav.MAV_RESULT_DENIED)
        try:
            self.asked += injection.injection(self._scenario, _UNITS[unit], _FAILURES[kind], instance)
        except control.Refused as refused:
            self._text(talk, str(refused))
            return int(mav.MAV_RESULT_DENIED)
        return int(mav.MAV_RESULT_ACCEPTED)

    def _pause(self, params: Params, talk: Talk) -> int:
        """0 holds simulated time, 1 lets it go on."""
        if params[0] not in (0.0, 1.0):
            return int(mav.MAV_RESULT_DENIED)
        self.asked.append(control.Resume() if params[0] else control.Pause())
        return int(mav.MAV_RESULT_ACCEPTED)

    def _reboot(self, params: Params, talk: Talk) -> int:
        """1 begins the run anew, 2 ends it."""
        if params[0] not in (0.0, 1.0, 2.0):
            return int(mav.MAV_RESULT_DENIED)
        if params[0]:
            self.asked.append(control.Restart() if params[0] == 1.0 else control.End())
        return int(mav.MAV_RESULT_ACCEPTED)

    def _request_message(self, params: Params, talk: Talk) -> int:
        number, which = whole_number(params[0]), whole_number(params[1])
        if number in self._numbers:
            return self._stream(self._numbers[number], talk)
        if number == mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
            return self._capabilities(params, talk)
        if number == mav.MAVLINK_MSG_ID_AVAILABLE_MODES and which in (0, 1):
            self._say(talk, "AVAILABLE_MODES", available_mode(self._identity))
        elif number == mav.MAVLINK_MSG_ID_CURRENT_MODE:
            self._say(talk, "CURRENT_MODE", current_mode(self._identity))
        elif number == mav.MAVLINK_MSG_ID_MESSAGE_INTERVAL:
            return self._get_interval(params[1:], talk)
        else:
            return int(mav.MAV_RESULT_DENIED)
        return int(mav.MAV_RESULT_ACCEPTED)

    def _stream(self, name: str, talk: Talk) -> int:
        """The newest of what is streamed; not yet when there is nothing to say."""
        frames = [frame for stream in self._streams[name] if (frame := self.frame(stream))]
        for frame in frames:
            talk.due.append(frame)
        return int(mav.MAV_RESULT_ACCEPTED if frames else mav.MAV_RESULT_TEMPORARILY_REJECTED)

    def _version(self, message: Message, talk: Talk) -> None:
        self._say(talk, "AUTOPILOT_VERSION", autopilot_version(self._identity, self._system))

    def _capabilities(self, params: Params, talk: Talk) -> int:
        self._say(talk, "AUTOPILOT_VERSION", autopilot_version(self._identity, self._system))
        return int(mav.MAV_RESULT_ACCEPTED)

    # Rates

    def _set_interval(self, params: Params, talk: Talk) -> int:
        """Of this station's streams only: 0 is the usual interval, -1 none."""
        number, interval = whole_number(params[0]), params[1]
        name = None if number is None else self._numbers.get(number)
        if name is None or self._scenario is None or not (interval >= 0 or interval == -1):
            return int(mav.MAV_RESULT_DENIED)
        if interval == 0:
            talk.rates[self._system].pop(name, None)
        else:
            talk.rates[self._system][name] = min(1e6 / interval, PUBLISH_HZ) if interval > 0 else 0.0
        return int(mav.MAV_RESULT_ACCEPTED)

    def _get_interval(self, params: Params, talk: Talk) -> int:
        number = whole_number(params[0])
        if number is None or not 0 <= number < 2**16:
            return int(mav.MAV_RESULT_DENIED)
        name = self._numbers.get(number)
        rates = talk.rates[self._system]
        rate = rates.get(name, self._streams[name][0].rate_hz) if name else math.nan  # NaN: no such stream
        interval = 0 if name is None else 1e6 / rate if rate > 0 else -1
        self._say(talk, "MESSAGE_INTERVAL", {"message_id": number, "interval_us": interval})
        return int(mav.MAV_RESULT_ACCEPTED)

    def _data_stream(self, message: Message, talk: Talk) -> None:
        """The rates of a group of messages, or of all, as ArduPilot groups them; HEARTBEAT goes on."""
        group = message["req_stream_id"]
        rate = min(message["req_message_rate"], PUBLISH_HZ) if message["start_stop"] else 0
        for name, streams in self._streams.items():
            if streams[0].group and group in (mav.MAV_DATA_STREAM_ALL, streams[0].group):
                talk.rates[self._system][name] = float(rate)

    # Times, files, logs

    def _ping(self, message: Message, talk: Talk) -> None:
        if message.target == message.target_component == 0:  # otherwise it is an answer
            self._say(talk, "PING", {"time_usec": message["time_usec"], "seq": message["seq"], **_to(message)})

    def _timesync(self, message: Message, talk: Talk) -> None:
        if message["tc1"] == 0:  # otherwise it is an answer
            now = self.snapshot.usec * 1000 if self.snapshot else 0
            self._say(talk, "TIMESYNC", {"tc1": now, "ts1": message["ts1"], **_to(message)})

    def _file(self, message: Message, talk: Talk) -> None:
        """MAVFTP: there are no files, so every request is refused."""
        asked = message["payload"]
        sequence = (asked[0] + 256 * asked[1] + 1) % 2**16
        payload = [sequence % 256, sequence // 256, asked[2], _NAK, 1, asked[3], 0, 0, 0, 0, 0, 0, _FTP_FAIL]
        payload += [0] * (251 - len(payload))
        self._say(talk, "FILE_TRANSFER_PROTOCOL", {"target_network": 0, "payload": payload, **_to(message)})

    def _log_list(self, message: Message, talk: Talk) -> None:
        self._say(talk, "LOG_ENTRY", {"id": 0, "num_logs": 0, "last_log_num": 0, "time_utc": 0, "size": 0})

    def _log_data(self, message: Message, talk: Talk) -> None:
        self._say(talk, "LOG_DATA", {"id": message["id"], "ofs": message["ofs"], "count": 0, "data": [0] * 90})


def mav_id(name: str) -> int:
    """Number of the message of that name."""
    return int(getattr(mav, f"MAVLINK_MSG_ID_{name}"))


def _to(message: Message) -> dict[str, float]:
    return {"target_system": message.system, "target_component": message.component}


def _granted(is_so: bool) -> int:
    return int(mav.MAV_RESULT_ACCEPTED if is_so else mav.MAV_RESULT_DENIED)
