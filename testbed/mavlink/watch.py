"""A run's essentials in the terminal, from its link or from its telemetry log.

`Picture` keeps what was said last and draws it; `watch` feeds it. Only what any ground station can hear is used.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import select
import socket
import struct
import time
from collections import deque
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any, TypeAlias

from pymavlink import mavutil  # type: ignore[import-untyped]
from pymavlink.dialects.v20 import all as mav  # type: ignore[import-untyped]
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from testbed import interrupts
from testbed.errors import UserError, printable
from testbed.mavlink.link import CONNECT_TIMEOUT_S, in_use, log_path, resolve

Turn: TypeAlias = tuple[float, list[Any]]  # a clock [s] and the messages that have come up to then
Turns: TypeAlias = Generator[Turn, None, None]

REDRAW_S = 0.2
LINE_S = 1.0  # between two lines where the output is no terminal
LOST_S = 3.5  # without a heartbeat; QGroundControl's figure
POLL_S = 0.05
TEXTS = 8
STATUSTEXT_BYTES = 50  # a shorter one is the last of its text
LONGEST_TEXT = 256 * STATUSTEXT_BYTES  # chunks are numbered by a byte
_FORMS = "udpin:host:port (listens), tcp:host:port (connects) or a telemetry log, path.tlog"
_STAMP = struct.Struct(">Q")
_MAX_DATAGRAM = 65535

_ERRORS = {
    "horiz": ("horizontal", "m"),
    "down": ("down", "m"),
    "vel": ("velocity", "m/s"),
    "tilt": ("tilt", "deg"),
    "head": ("heading", "deg"),
}
_SENSORS = {
    "gyro": mav.MAV_SYS_STATUS_SENSOR_3D_GYRO,
    "accelerometer": mav.MAV_SYS_STATUS_SENSOR_3D_ACCEL,
    "magnetometer": mav.MAV_SYS_STATUS_SENSOR_3D_MAG,
    "barometer": mav.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE,
    "airspeed": mav.MAV_SYS_STATUS_SENSOR_DIFFERENTIAL_PRESSURE,
    "GNSS": mav.MAV_SYS_STATUS_SENSOR_GPS,
}
_STYLES = {"healthy": "green", "denied": "yellow", "spoofed": "bold red", "failed": "bold red"}


def watch(source: str, console: Console, speed: float) -> None:
    """Show what comes from ``source`` until it ends or Ctrl-C: redrawn in a terminal, else as lines and a last picture.

    A log is replayed at ``speed`` times its own pace in a terminal, and otherwise as fast as it can be read. Raises
    UserError when the source is malformed, can't be had or isn't a log.
    """
    path = log_path(source)
    picture = Picture(source)
    if path is None:
        speed, turns = 1.0, _live(source)
    else:
        turns = _replay(path, speed if console.is_terminal else math.inf)
    with contextlib.closing(turns):
        try:
            (_draw if console.is_terminal else _write)(picture, turns, console, speed)
        except interrupts.INTERRUPTS:
            interrupts.taken()
    if not console.is_terminal:
        console.print(picture.render())


def _draw(picture: Picture, turns: Iterator[Turn], console: Console, speed: float) -> None:
    with Live(picture.render(), console=console, auto_refresh=False) as screen:
        due = -math.inf
        try:
            for clock, messages in turns:
                for message in messages:
                    picture.hear(message, clock)
                picture.clock = clock
                if clock >= due:
                    screen.update(picture.render(), refresh=True)
                    due = clock + REDRAW_S * speed
        finally:
            screen.update(picture.render(), refresh=True)


def _write(picture: Picture, turns: Iterator[Turn], console: Console, speed: float) -> None:
    due, last = -math.inf, ""
    for clock, messages in turns:
        for message in messages:
            said = picture.hear(message, clock)
            if said:
                print(said, flush=True)
        picture.clock = clock
        if clock >= due and picture.line() != last:
            last = picture.line()
            print(last, flush=True)
            due = clock + LINE_S * speed


class Picture:
    """What one vehicle has said last: the first that is heard. Another run on the same link begins it anew."""

    def __init__(self, source: str) -> None:
        self.clock = 0.0
        self._source = source
        self._system: int | None = None
        self._heartbeat_at = -math.inf
        self._t = math.nan
        self._latest: dict[str, Any] = {}
        self._values: dict[str, float] = {}
        self._texts: deque[tuple[str, str]] = deque(maxlen=TEXTS)
        self._chunks: dict[int, bytes] = {}

    def hear(self, message: Any, clock: float) -> str | None:
        """Take a message that came at ``clock``; the line it says, if it is the end of a STATUSTEXT."""
        name = message.get_type()
        if self._system is None and _is_of_vehicle(message):
            self._system = message.get_srcSystem()
        if message.get_srcSystem() != self._system:
            return None
        if name in ("ATTITUDE", "SYSTEM_TIME"):
            t = message.time_boot_ms / 1e3
            if t < self._t - 1:
                self._latest.clear()
                self._values.clear()
            self._t = t
        if name == "HEARTBEAT":
            self._heartbeat_at = clock
        if name == "NAMED_VALUE_FLOAT":
            self._values[message.name] = message.value
        elif name == "STATUSTEXT":
            return self._read_text(message)
        self._latest[name] = message
        return None

    def _read_text(self, message: Any) -> str | None:
        chunk = message._text_raw.partition(b"\0")[0]
        before = self._chunks.pop(message.id, b"")
        text = (before + chunk if message.chunk_seq else chunk)[:LONGEST_TEXT]
        if message.id and len(chunk) == STATUSTEXT_BYTES:
            self._chunks[message.id] = text
            if len(self._chunks) > TEXTS:  # the oldest has lost its end
                del self._chunks[next(iter(self._chunks))]
            return None
        readable = text.decode(errors="replace")
        readable = "".join(character if character.isprintable() else " " for character in readable)
        style = "bold red" if message.severity <= mav.MAV_SEVERITY_ERROR else ""
        style = "yellow" if message.severity == mav.MAV_SEVERITY_WARNING else style
        said = f"{self._time():>8}  {readable}"
        self._texts.append((said, style))
        return said

    def line(self) -> str:
        """The essentials in one line."""
        if "HEARTBEAT" not in self._latest:
            return self._link()
        link = self._link().partition(":")[0]
        horizontal = self._errors().get("horiz")
        sensors = self._sensors()
        broken = [f"{name} {state}" for name, state in sensors.items() if state != "healthy"]
        parts = [
            f"{self._time():>8}",
            "" if link == "online" else f"link {link}",
            self._mode(),
            f"leg {self._progress()}" if self._progress() else "",
            self._solution(),
            f"horizontal error {horizontal[0]:.1f} m, sigma {horizontal[1]:.1f} m" if horizontal else "",
            f"wind {self._wind()}" if self._wind() else "",
            ", ".join(broken) or ("all sensors healthy" if sensors else ""),
        ]
        return "  ".join(filter(None, parts))

    def render(self) -> RenderableType:
        """The whole picture, 80 columns wide or more."""
        head = Table.grid(padding=(0, 3))
        lost = self._link() != "online"
        head.add_row("link", Text(self._link(), "bold red" if lost else "green"), "time", self._time())
        head.add_row("mode", self._mode(), "leg", Text(self._progress()))
        head.add_row("estimate", self._solution(), "wind", self._wind())
        errors = Table("error", "", "sigma", "error/sigma", box=None, padding=(0, 1))
        for column in errors.columns[1:]:
            column.justify = "right"
        for key, (error, sigma) in self._errors().items():
            label, unit = _ERRORS[key]
            ratio = abs(error) / sigma if sigma > 0 else math.nan
            told = Text("" if math.isnan(ratio) else f"{ratio:.1f}", "bold red" if ratio > 3 else "")
            errors.add_row(label, f"{error:.2f} {unit}", "" if math.isnan(sigma) else f"{sigma:.2f}", told)
        sensors = Table("sensor", "", box=None, padding=(0, 1))
        for name, state in self._sensors().items():
            sensors.add_row(name, Text(state, _STYLES[state]))
        both = Table.grid(padding=(0, 4))
        both.add_row(errors, sensors)
        said = Text("\n").join(Text(text, style, no_wrap=True, overflow="ellipsis") for text, style in self._texts)
        return Panel(
            Group(head, "", both, "", said), title=Text(printable(self._source)), title_align="left", expand=False
        )

    def _link(self) -> str:
        silence = self.clock - self._heartbeat_at
        if math.isinf(silence):
            return "no vehicle heard yet"
        return "online" if silence <= LOST_S else f"lost: no heartbeat for {silence:.0f} s"

    def _time(self) -> str:
        return "" if math.isnan(self._t) else f"{self._t:.1f} s"

    def _mode(self) -> str:
        heartbeat = self._latest.get("HEARTBEAT")
        if heartbeat is None:
            return ""
        armed = "armed" if heartbeat.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED else "disarmed"
        return f"{mavutil.mode_string_v10(heartbeat)}, {armed}"

    def _progress(self) -> str:
        """Number of the leg, and of how many; its name is only told in a text, as it begins."""
        current, heartbeat = self._latest.get("MISSION_CURRENT"), self._latest.get("HEARTBEAT")
        if current is None or heartbeat is None or not current.total:
            return ""
        home_first = heartbeat.autopilot == mav.MAV_AUTOPILOT_ARDUPILOTMEGA
        return f"{current.seq + (not home_first)}/{current.total}"

    def _solution(self) -> str:
        status = self._latest.get("ESTIMATOR_STATUS")
        if status is None:
            return ""
        if not status.flags & mav.ESTIMATOR_ATTITUDE:
            return "not aligned"
        if status.flags & mav.ESTIMATOR_POS_HORIZ_ABS:
            return "position known"
        return "dead reckoning" if status.flags & mav.ESTIMATOR_POS_HORIZ_REL else "attitude only"

    def _wind(self) -> str:
        wind = self._latest.get("WIND_COV")
        if wind is None:
            return ""
        origin = math.degrees(math.atan2(-wind.wind_y, -wind.wind_x)) % 360
        return f"{math.hypot(wind.wind_x, wind.wind_y):.1f} m/s from {origin:.0f} deg"

    def _errors(self) -> dict[str, tuple[float, float]]:
        """Error and its sigma, NaN when not told, of what is told."""
        return {
            key: (self._values[f"err_{key}"], self._values.get(f"sig_{key}", math.nan))
            for key in _ERRORS
            if f"err_{key}" in self._values
        }

    def _sensors(self) -> dict[str, str]:
        """State of every sensor that there is."""
        status = self._latest.get("SYS_STATUS")
        if status is None:
            return {}
        states = {
            name: "healthy" if status.onboard_control_sensors_health & bit else "failed"
            for name, bit in _SENSORS.items()
            if status.onboard_control_sensors_present & bit
        }
        fix, integrity = self._latest.get("GPS_RAW_INT"), self._latest.get("GNSS_INTEGRITY")
        if "GNSS" in states and fix is not None and fix.fix_type == mav.GPS_FIX_TYPE_NO_FIX:
            states["GNSS"] = "denied"  # five times a second, where health comes once
        elif "GNSS" in states and integrity is not None:
            spoofed = integrity.spoofing_state == mav.GPS_SPOOFING_STATE_DETECTED
            states["GNSS"] = "spoofed" if spoofed else states["GNSS"]
        return states


def _live(url: str) -> Turns:
    """Open ``url`` now, so that an error is told before anything is drawn; then turn by turn what comes."""
    kind, _, where = url.partition(":")
    if kind not in ("udpin", "tcp"):
        raise UserError(f"{url}: nothing to watch; use {_FORMS}")
    address = resolve(url, where, _FORMS)
    if kind == "udpin":
        connection = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            connection.bind(address)
        except OSError as error:
            connection.close()
            raise UserError(in_use(url, error)) from None
    else:
        try:
            connection = socket.create_connection(address, timeout=CONNECT_TIMEOUT_S)
        except OSError as error:
            raise UserError(f"{url}: nobody answers there ({error}); start the run first, with tcpin:") from None
    connection.setblocking(False)
    return _listen(connection)


def _listen(connection: socket.socket) -> Turns:
    parser = mav.MAVLink(None)
    parser.robust_parsing = True
    datagrams = connection.type == socket.SOCK_DGRAM
    with connection:
        while True:
            select.select([connection], [], [], POLL_S)
            heard: list[Any] = []
            with contextlib.suppress(BlockingIOError):
                while len(heard) < 1000:  # then it is time to look at the clock
                    try:
                        data = connection.recv(_MAX_DATAGRAM)
                    except ConnectionError:  # reset
                        data = b""
                    if not data and not datagrams:
                        yield time.monotonic(), heard
                        return
                    heard += _messages(parser, data)
            yield time.monotonic(), heard


def _is_of_vehicle(message: Any) -> bool:
    return bool(message.get_srcComponent() == mav.MAV_COMP_ID_AUTOPILOT1)


def _messages(parser: Any, data: bytes) -> list[Any]:
    """The messages that ``data`` completes; a frame that the parser fails at is passed over."""
    found: list[Any] = []
    while True:
        try:
            message = parser.parse_char(data)
        except Exception:  # various ones at hostile bytes, once the frame has been taken from the buffer
            message = mav.MAVLink_bad_data(b"", "")
        if message is None:
            return found
        if message.get_type() != "BAD_DATA":
            found.append(message)
        data = b""


def _replay(path: Path, speed: float) -> Turns:
    """A telemetry log turn by turn at ``speed`` times its own pace. What is no frame is passed over."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: can't be read ({error.strerror}); give {_FORMS}") from None
    log = _frames(data)
    before: list[Turn] = []  # among random bytes there are messages too, now and then
    for turn in log:
        before.append(turn)
        if any(_is_of_vehicle(message) and message.get_type() == "HEARTBEAT" for message in turn[1]):
            return _paced(itertools.chain(before, log), speed)
    raise UserError(f"{path}: no telemetry log: there is no heartbeat of a vehicle in it")


def _paced(log: Iterator[Turn], speed: float) -> Turns:
    began, start = time.monotonic(), None
    for clock, messages in log:
        start = clock if start is None else start
        ahead = (clock - start) / speed - (time.monotonic() - began)
        if ahead > 0:
            time.sleep(ahead)
        yield clock, messages


def _frames(data: bytes) -> Iterator[Turn]:
    """Time [s] and message of each frame in a log."""
    parser = mav.MAVLink(None)
    at = _STAMP.size
    while at + 3 <= len(data):
        long = data[at] == mav.PROTOCOL_MARKER_V2
        if long:
            signed = data[at + 2] & mav.MAVLINK_IFLAG_SIGNED
            end = at + data[at + 1] + 12 + (mav.MAVLINK_SIGNATURE_BLOCK_LEN if signed else 0)
        else:
            end = at + data[at + 1] + 8
        message = None
        if long or data[at] == mav.PROTOCOL_MARKER_V1:
            with contextlib.suppress(Exception):  # pymavlink raises various ones at hostile bytes
                message = parser.decode(bytearray(data[at:end]))
        if message is None:
            at += 1
            continue
        yield _STAMP.unpack_from(data, at - _STAMP.size)[0] / 1e6, [message]
        at = end + _STAMP.size
