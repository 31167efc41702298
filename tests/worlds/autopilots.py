"""The far ends of bridges, played byte by byte as PX4 and ArduPilot do, with pymavlink's own encoder and parser."""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import threading
import time
from collections.abc import Sequence
from typing import Any

from pymavlink.dialects.v20 import common as mav

TRIES = 2000  # at reaching a simulator that has not opened its port yet
HEARTBEAT_AND_ASK = 2  # messages with which PX4 begins


def free_port(kind: socket.SocketKind) -> int:
    """A port of this machine that nobody uses."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Px4(threading.Thread):
    """PX4's side: connects, says hello, and answers each HIL_SENSOR from the ``boot``-th on.

    ``behaviour`` from the ``at``-th sensor on: "stall", "close", "late" (answers of the step before), "ahead" (of a
    later time), "talk" (never stops), "deaf" (says much, reads nothing); all the time: "double" (every answer twice),
    "halves" (a byte at a time, garbage between).
    """

    def __init__(self, behaviour: str = "", at: int = 0, boot: int = 3) -> None:
        super().__init__(daemon=True)
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
            for _ in range(TRIES):
                try:
                    link.connect(("127.0.0.1", self.port))
                    break
                except OSError:
                    time.sleep(0.01)
            with contextlib.suppress(OSError):
                self._serve(link)

    def _serve(self, link: socket.socket) -> None:
        hello = self._mav.heartbeat_encode(mav.MAV_TYPE_GENERIC, mav.MAV_AUTOPILOT_PX4, 0, 0, 0)
        ask = self._mav.command_long_encode(0, 0, mav.MAV_CMD_SET_MESSAGE_INTERVAL, 0, 115, 5e3, 0, 0, 0, 0, 0)
        link.sendall(hello.pack(self._mav) + ask.pack(self._mav))
        parser, sensors = mav.MAVLink(None), 0
        while data := link.recv(4096):
            self.raw += data
            for message in parser.parse_buffer(data) or []:
                self.heard.append(message)
                if message.get_type() != "HIL_SENSOR":
                    continue
                sensors += 1
                if sensors >= self.boot and not self._answer(link, message.time_usec, sensors):
                    return

    def _controls(self, stamp: int) -> bytes:
        return bytes(self._mav.hil_actuator_controls_encode(stamp, [0.0] * 16, 1, 1).pack(self._mav))

    def _answer(self, link: socket.socket, stamp: int, count: int) -> bool:
        due = count >= self.at
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


class ArduPilot(threading.Thread):
    """ArduPilot's side: sends frames of servo outputs, and the next when it has been answered.

    ``behaviour`` from the ``at``-th frame on: "stall", "restart" (frame 0), "repeat" (the same frame for ever); all the
    time: "double" (every packet twice), "wrong" (packets of a wrong magic and halves of packets before each), "wide"
    (32 channels).
    """

    def __init__(self, behaviour: str = "", at: int = 0, frames: int = 10**9) -> None:
        super().__init__(daemon=True)
        self.port = free_port(socket.SOCK_DGRAM)
        self.behaviour, self.at, self.frames = behaviour, at, frames
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
                            if not (self.behaviour == "repeat" and count >= self.at):
                                count += 1

    def _send(self, link: socket.socket, count: int, again: int) -> None:
        there = ("127.0.0.1", self.port)
        magic, channels = (29569, 32) if self.behaviour == "wide" else (18458, 16)
        packet = struct.pack(f"<HHI{channels}H", magic, 400, count, *[1500] * channels)
        if self.behaviour == "wrong":
            link.sendto(struct.pack("<HHI16H", 18459, 400, count + 1, *[1500] * 16), there)
            link.sendto(packet[: len(packet) // 2], there)
            link.sendto(b"", there)
        for _ in range(again):
            link.sendto(packet, there)
