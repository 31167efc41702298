"""The far ends of bridges, played byte by byte as PX4 and ArduPilot do, with pymavlink's own encoder and parser."""

from __future__ import annotations

import contextlib
import json
import math
import socket
import struct
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mav

TRIES = 2000  # at reaching a simulator that has not opened its port yet
HEARTBEAT_AND_ASK = 2  # messages with which PX4 begins


def free_port(kind: socket.SocketKind) -> int:
    """A port of this machine that nobody uses."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Circle:
    """A minimal autopilot: holds a bank, the height and the airspeed that it finds when it begins. Outputs from -1 to 1
    are positive to the right, up and right; the throttle from 0 to 1.
    """

    BANK = math.radians(25.0)
    AILERON, ELEVATOR = 0.35, 0.52  # travel [rad]

    def __init__(self) -> None:
        self._begun: tuple[float, float] | None = None
        self._t = 0.0
        self._lift, self._nose, self._power = 0.0, 0.0, 0.5  # integrals

    def fly(self, t: float, rates: Sequence[float], angles: Sequence[float], h: float, climb: float, v: float) -> Any:
        """Roll, pitch, yaw and throttle for time [s], body rates, roll and pitch [rad], height, climb and airspeed."""
        h0, v0 = self._begun = self._begun or (h, v)
        dt, self._t = (t - self._t if self._t else 0.0), t
        (p, q, r), (roll, pitch, *_) = rates, angles
        climb_error = max(-2.0, min(2.0, 0.3 * (h0 - h))) - climb
        self._lift += 0.014 * climb_error * dt
        wanted = max(-0.2, min(0.25, 0.03 * climb_error + self._lift))
        self._nose += 1.0 * (wanted - pitch) * dt
        slow = v0 - v
        self._power += 0.014 * slow * dt
        turned_q = q * math.cos(roll) - r * math.sin(roll)
        up = (1.0 * (wanted - pitch) + self._nose - 0.15 * turned_q) / self.ELEVATOR
        right = (0.45 * (self.BANK - roll) - 0.03 * p) / self.AILERON
        yaw = 0.16 * right - 0.25 * (r - 9.81 * math.sin(roll) / max(v, 10.0)) / self.AILERON
        return right, up, yaw, max(0.0, min(1.0, self._power + 0.1 * slow))


class TakeOff(Circle):
    """Full throttle and surfaces still until it is flying; then wings level, `CLIMB_M` higher than where it was."""

    BANK = 0.0
    FLYING_MPS, SPEED_MPS, CLIMB_M = 12.0, 25.0, 40.0

    def fly(self, t: float, rates: Sequence[float], angles: Sequence[float], h: float, climb: float, v: float) -> Any:
        """See `Circle`."""
        if v < self.FLYING_MPS and self._begun is None:
            return 0.0, 0.0, 0.0, 1.0
        self._begun = self._begun or (h + self.CLIMB_M, self.SPEED_MPS)
        return super().fly(t, rates, angles, h, climb, v)


class Voice:
    """What PX4 says over its own MAVLink: truth, but `NORTH_M` too far north. Its clock begins with the first stamp.

    With ``odd`` each message comes a turn late, the youngest first, among numbers that are none, others' and garbage,
    and from 4 to 6 s nothing is said of the position. Before ``placed_s`` there is no position at all. Its shell takes
    one command, whose stamp is ``armed`` [us]; as PX4's, it is gone at once when nobody asks for what it says.
    """

    NORTH_M, SIGMA_M = 3.0, 2.0

    def __init__(self, odd: bool = False, placed_s: float = 0.0) -> None:
        self.port, self.odd, self.placed_s = free_port(socket.SOCK_DGRAM), odd, placed_s
        self.armed: int | None = None
        self._link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._mav, self._other = (mav.MAVLink(None, srcSystem=own, srcComponent=1) for own in (1, 7))
        self._begun: int | None = None
        self._late: list[bytes] = []

    @property
    def url(self) -> str:
        return f"udpin:127.0.0.1:{self.port}"

    def close(self) -> None:
        """It says no more."""
        self._link.close()

    def say(self, own: Any) -> None:
        """Say what a HIL_STATE_QUATERNION says."""
        self._begun = own.time_usec - 5000 if self._begun is None else self._begun
        stamp = own.time_usec - 5000 - self._begun
        q, velocity = own.attitude_quaternion, [value / 100 for value in (own.vx, own.vy, own.vz)]
        lat = own.lat + round(self.NORTH_M / 6.371e6 * math.degrees(1) * 1e7)
        covariance = [0.0] * 21
        for k, sigma in zip((0, 6, 11, 15, 18, 20), [self.SIGMA_M] * 3 + [0.01] * 3, strict=True):
            covariance[k] = sigma**2
        place = mav.MAVLink_global_position_int_message(stamp // 1000, lat, own.lon, own.alt, 0, 1, 2, 3, 65535)
        said = [
            mav.MAVLink_attitude_quaternion_message(stamp // 1000, *q, 0, 0, 0),
            mav.MAVLink_local_position_ned_message(stamp // 1000, 0, 0, 0, *velocity),
            mav.MAVLink_odometry_message(
                stamp, 1, 1, 0, 0, 0, q, *velocity, 0, 0, 0, covariance, [0.01] * 21, estimator_type=8
            ),
        ]
        if stamp >= 1e6 * self.placed_s and not (self.odd and 4e6 < stamp < 6e6):
            said.append(place)
        frames = [bytes(message.pack(self._mav)) for message in said]
        if self.odd:
            none = [math.nan] * 4
            frames.append(mav.MAVLink_attitude_quaternion_message(stamp // 1000, *none, 0, 0, 0).pack(self._mav))
            frames.append(mav.MAVLink_local_position_ned_message(stamp // 1000, 0, 0, 0, *none[:3]).pack(self._mav))
            frames.append(
                mav.MAVLink_global_position_int_message(stamp // 1000, 0, 0, 0, 0, 0, 0, 0, 0).pack(self._other)
            )
            frames += [b"garbage\xfd\x09", mav.MAVLink_vfr_hud_message(1, 1, 1, 1, 1, 1).pack(self._mav), frames[0][:9]]
            frames, self._late = self._late, frames[::-1]
        for frame in frames:
            self._link.sendto(frame, ("127.0.0.1", self.port))
        with contextlib.suppress(BlockingIOError):
            while True:
                self._hear(self._link.recv(4096, socket.MSG_DONTWAIT), stamp)

    def _hear(self, data: bytes, stamp: int) -> None:
        for message in mav.MAVLink(None).parse_buffer(data) or []:
            if message.get_type() != "SERIAL_CONTROL" or message.device != mav.SERIAL_CONTROL_DEV_SHELL:
                continue
            typed = bytes(message.data[: message.count])
            if typed == b"commander arm -f\n" and message.flags & mav.SERIAL_CONTROL_FLAG_RESPOND:
                self.armed = stamp if self.armed is None else self.armed


class Px4(threading.Thread):
    """PX4's side: connects, says hello, and answers each HIL_SENSOR from the ``boot``-th on.

    ``behaviour`` from the ``at``-th sensor on: "stall", "close", "late" (answers of the step before), "ahead" (of a
    later time), "talk" (never stops), "deaf" (says much, reads nothing); all the time: "double" (every answer twice),
    "halves" (a byte at a time, garbage between). With a ``pilot`` it is armed from the ``at``-th sensor on. With a
    ``voice`` it says what it believes of its own motion.
    """

    def __init__(
        self, behaviour: str = "", at: int = 0, boot: int = 3, pilot: Circle | None = None, voice: Voice | None = None
    ) -> None:
        super().__init__(daemon=True)
        self.pilot, self.voice, self._state = pilot, voice, None
        self.port = free_port(socket.SOCK_STREAM)
        self.behaviour, self.at, self.boot = behaviour, at, boot
        self.heard: list[Any] = []  # messages
        self.raw = b""
        self.over = threading.Event()  # the test is done with it
        self._mav = mav.MAVLink(None, srcSystem=1, srcComponent=1)
        self.start()

    @property
    def url(self) -> str:
        return f"tcpin:127.0.0.1:{self.port}"

    def of(self, name: str) -> list[Any]:
        """The messages of a name."""
        return [m for m in self.heard if m.get_type() == name]

    def run(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as link:
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # a byte at a time is one
            for _ in range(TRIES):
                try:
                    link.connect(("127.0.0.1", self.port))
                    break
                except OSError:
                    time.sleep(0.01)
            with contextlib.suppress(OSError):
                self._serve(link)
        if self.voice is not None:
            self.voice.close()

    def _serve(self, link: socket.socket) -> None:
        hello = self._mav.heartbeat_encode(mav.MAV_TYPE_GENERIC, mav.MAV_AUTOPILOT_PX4, 0, 0, 0)
        ask = self._mav.command_long_encode(0, 0, mav.MAV_CMD_SET_MESSAGE_INTERVAL, 0, 115, 5e3, 0, 0, 0, 0, 0)
        link.sendall(hello.pack(self._mav) + ask.pack(self._mav))
        parser, sensors = mav.MAVLink(None), 0
        while data := link.recv(4096):
            self.raw += data
            for message in parser.parse_buffer(data) or []:
                self.heard.append(message)
                if message.get_type() == "HIL_STATE_QUATERNION":
                    self._state = message
                    if self.voice is not None:
                        self.voice.say(message)
                if message.get_type() != "HIL_SENSOR":
                    continue
                self._sensor = message
                sensors += 1
                if sensors >= self.boot and not self._answer(link, message.time_usec, sensors):
                    return

    def _controls(self, stamp: int) -> bytes:
        controls, mode = [0.0] * 16, 1
        if self.pilot is not None and self._due and self._state is not None:
            right, up, yaw, throttle = self._flown()
            controls[:4], mode = [right, up, throttle, yaw], 1 | 128
        elif self.voice is not None and self.voice.armed is not None:
            mode |= 128
        return bytes(self._mav.hil_actuator_controls_encode(stamp, controls, mode, 1).pack(self._mav))

    def _flown(self) -> Any:
        own, sensor = self._state, self._sensor
        w, x, y, z = own.attitude_quaternion
        roll, pitch = math.atan2(2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), math.asin(2 * (w * y - x * z))
        rates = sensor.xgyro, sensor.ygyro, sensor.zgyro
        assert self.pilot is not None
        return self.pilot.fly(
            sensor.time_usec / 1e6, rates, (roll, pitch), own.alt / 1e3, -own.vz / 100, own.true_airspeed / 100
        )

    def _answer(self, link: socket.socket, stamp: int, count: int) -> bool:
        due = self._due = count >= self.at
        if self.behaviour == "stall" and due:
            self.over.wait()
            return False
        if self.behaviour == "close" and due:
            return False
        if self.behaviour == "talk" and due:
            while not self.over.is_set():
                link.sendall(self._mav.statustext_encode(6, b"never quiet").pack(self._mav) * 1000)
            return False
        shift = {"late": -5000, "ahead": 5000}.get(self.behaviour, 0) if due else 0
        frame = self._controls(stamp + shift)
        if self.behaviour == "halves":
            for byte in b"\xfd\x00garbage" + frame:
                link.sendall(bytes([byte]))
        else:
            link.sendall(frame * (2 if self.behaviour == "double" else 1))
        return True


class Answering:
    """What ArduPilot says over its own MAVLink: truth, but `NORTH_M` too far north, of what it was asked for.

    It says what it is until then; it has no position before `placed_s`, and is armed when it is told so by force.
    """

    NORTH_M = 2.0

    def __init__(self, lat: float, lon: float, h: float, placed_s: float = 0.0) -> None:
        self.home, self.placed_s = (lat, lon, h), placed_s
        self.armed: float | None = None  # when [s]
        self.asked: dict[int, float] = {}  # intervals [us] by message
        self._link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._port = free_port(socket.SOCK_DGRAM)
        self._mav = mav.MAVLink(None, srcSystem=1, srcComponent=1)

    @property
    def url(self) -> str:
        return f"udpin:127.0.0.1:{self._port}"

    def close(self) -> None:
        """It says no more."""
        self._link.close()

    def say(self, line: dict[str, Any]) -> None:
        """Say what a line of JSON says, and hear what is asked."""
        stamp, velocity = round(1e3 * line["timestamp"]), line["velocity"]
        roll, pitch, yaw = (0.5 * angle for angle in line["attitude"])
        q = _half_angles(roll, pitch, yaw)
        lat, lon, h = self.home
        north, east, down = line["position"]
        place = [
            math.degrees(lat + (north + self.NORTH_M) / 6_378_100) * 1e7,
            math.degrees(lon + east / (6_378_100 * math.cos(lat + 0.5 * north / 6_378_100))) * 1e7,
            1e3 * (h - down),
        ]
        flags = mav.MAV_MODE_FLAG_SAFETY_ARMED if self.armed is not None else 0
        said = [
            mav.MAVLink_heartbeat_message(mav.MAV_TYPE_FIXED_WING, mav.MAV_AUTOPILOT_ARDUPILOTMEGA, flags, 0, 0, 3),
            mav.MAVLink_attitude_quaternion_message(stamp, *q, 0, 0, 0),
        ]
        if stamp >= 1e3 * self.placed_s:
            said.append(mav.MAVLink_global_position_int_message(stamp, *map(round, place), 0, 0, 0, 0, 0))
            said.append(mav.MAVLink_local_position_ned_message(stamp, north, east, down, *velocity))
        for message in said:
            if message.get_msgId() == mav.MAVLINK_MSG_ID_HEARTBEAT or message.get_msgId() in self.asked:
                self._link.sendto(message.pack(self._mav), ("127.0.0.1", self._port))
        with contextlib.suppress(BlockingIOError):
            while True:
                self._hear(self._link.recv(4096, socket.MSG_DONTWAIT), line["timestamp"])

    def _hear(self, data: bytes, t: float) -> None:
        for message in mav.MAVLink(None).parse_buffer(data) or []:
            assert (message.target_system, message.target_component) == (1, 1)
            if message.command == mav.MAV_CMD_SET_MESSAGE_INTERVAL:
                self.asked[int(message.param1)] = message.param2
            elif message.command == mav.MAV_CMD_COMPONENT_ARM_DISARM and (message.param1, message.param2) == (1, 2989):
                self.armed = t if self.armed is None else self.armed


def _half_angles(roll: float, pitch: float, yaw: float) -> list[float]:
    """The quaternion of half of each of three angles [rad]."""
    (sr, sp, sy), (cr, cp, cy) = ([f(a) for a in (roll, pitch, yaw)] for f in (math.sin, math.cos))
    return [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]


class ArduPilot(threading.Thread):
    """ArduPilot's side: sends frames of servo outputs, and the next when it has been answered.

    ``behaviour`` from the ``at``-th frame on: "stall", "restart" (frame 0), "repeat" (the same frame for ever); all the
    time: "double" (every packet twice), "wrong" (packets of a wrong magic and halves of packets before each), "wide"
    (32 channels). With a ``pilot`` its throttle is up from the ``at``-th frame on.
    """

    def __init__(
        self, behaviour: str = "", at: int = 0, pilot: Circle | None = None, voice: Answering | None = None
    ) -> None:
        super().__init__(daemon=True)
        self.pilot, self.voice = pilot, voice
        self.port = free_port(socket.SOCK_DGRAM)
        self.behaviour, self.at = behaviour, at
        self.lines: list[bytes] = []
        self.over = threading.Event()
        self.start()

    @property
    def url(self) -> str:
        return f"udpin:127.0.0.1:{self.port}"

    @property
    def said(self) -> Sequence[dict[str, Any]]:
        """The lines as ArduPilot reads them."""
        return [json.loads(line) for line in self.lines]

    def run(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
            link.settimeout(0.02)
            count = 0
            while not self.over.is_set():
                if self.behaviour == "stall" and count >= self.at:
                    self.over.wait()
                    return
                again = 2 if self.behaviour == "double" else 1
                shown = 0 if self.behaviour == "restart" and count >= self.at else count
                with contextlib.suppress(OSError):
                    self._send(link, shown, again)
                    for _ in range(again):
                        line = link.recv(4096)
                        if not self.lines or line != self.lines[-1]:
                            self.lines.append(line)
                            if self.voice is not None:
                                self.voice.say(json.loads(line))
                            if not (self.behaviour == "repeat" and count >= self.at):
                                count += 1

    def _send(self, link: socket.socket, count: int, again: int) -> None:
        there = ("127.0.0.1", self.port)
        magic, channels = (29569, 32) if self.behaviour == "wide" else (18458, 16)
        outputs = [1500, 1500, 1000, 1500] + [1500] * (channels - 4)
        if self.pilot is not None and count >= self.at and self.lines:
            said = json.loads(self.lines[-1])
            v = said["velocity"]
            right, up, yaw, throttle = self.pilot.fly(
                said["timestamp"], said["imu"]["gyro"], said["attitude"], -said["position"][2], -v[2], said["airspeed"]
            )
            pwm = 1500 + 500 * right, 1500 + 500 * up, 1000 + 1000 * throttle, 1500 + 500 * yaw
            outputs[:4] = [round(max(1000.0, min(2000.0, value))) for value in pwm]
        packet = struct.pack(f"<HHI{channels}H", magic, 400, count, *outputs)
        if self.behaviour == "wrong":
            link.sendto(struct.pack("<HHI16H", 18459, 400, count + 1, *[1500] * 16), there)
            link.sendto(packet[: len(packet) // 2], there)
            link.sendto(b"", there)
        for _ in range(again):
            link.sendto(packet, there)


class Ear:
    """ArduPilot's MAVLink: keeps the GPS_INPUT that it is sent at `url`."""

    def __init__(self) -> None:
        self._link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._link.bind(("127.0.0.1", 0))
        self._link.setblocking(False)
        self.url = f"udpout:127.0.0.1:{self._link.getsockname()[1]}"

    def speak(self, port: int) -> None:
        """A heartbeat to somebody who listens."""
        own = mav.MAVLink(None, srcSystem=1, srcComponent=1)
        said = own.heartbeat_encode(mav.MAV_TYPE_FIXED_WING, mav.MAV_AUTOPILOT_ARDUPILOTMEGA, 0, 0, 0)
        self._link.sendto(said.pack(own), ("127.0.0.1", port))

    def heard(self) -> list[Any]:
        """What it was sent, by pymavlink's own parser; it hears no more."""
        parser, messages = mav.MAVLink(None), []
        with self._link, contextlib.suppress(BlockingIOError):
            while True:
                messages += parser.parse_buffer(self._link.recv(4096)) or []
        return messages


class Station(threading.Thread):
    """A ground station of an autopilot itself, a ``system`` that speaks to a port: hears, commands, sends a mission."""

    def __init__(self, port: int, system: int = 1) -> None:
        super().__init__(daemon=True)
        self.port, self.system = port, system
        self.link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=255)
        self.over = threading.Event()

    def close(self) -> None:
        """It hears no more."""
        self.over.set()
        self.join()
        self.link.close()

    def hear(self, name: str, seconds: float, is_it: Callable[[Any], bool] = lambda _: True) -> Any:
        """The next message of a name, or of several, "A|B"; None when none comes within so many seconds."""
        until = time.monotonic() + seconds
        while time.monotonic() < until and not self.over.is_set():
            self.link.mav.heartbeat_send(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, 0)
            message = self.link.recv_match(type=name.split("|"), blocking=True, timeout=0.1)
            if message is not None and is_it(message):
                return message
        return None

    def command(self, command: int, *values: float) -> bool:
        """Whether a command was accepted."""
        padded = [*values, *[0.0] * (7 - len(values))]
        self.link.mav.command_long_send(self.system, 1, command, 0, *padded)
        answer = self.hear("COMMAND_ACK", 2.0, lambda one: one.command == command)
        return answer is not None and answer.result == mav.MAV_RESULT_ACCEPTED

    def send(self, items: Sequence[tuple[int, int, Sequence[float]]]) -> int | None:
        """What a mission was answered with, None when it wasn't; of each item frame, command and seven numbers."""
        self.link.mav.mission_count_send(self.system, 1, len(items))
        while (asked := self.hear("MISSION_REQUEST_INT|MISSION_REQUEST|MISSION_ACK", 5.0)) is not None:
            if asked.get_type() == "MISSION_ACK":
                return int(asked.type)
            frame, command, (*how, lat, lon, h) = items[asked.seq]
            place = round(lat * 1e7), round(lon * 1e7), h
            self.link.mav.mission_item_int_send(self.system, 1, asked.seq, frame, command, 0, 1, *how, *place)
        return None
