"""Bytes to messages: whatever comes in, what comes out are sound MAVLink frames meant for us, and never an exception.

Only frames of known messages whose checksum holds, and with a key whose signature holds, are taken. The fields' types
come from pymavlink's ``all`` dialect; its parser is not used, because it stumbles over hostile input.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import all as dialect  # type: ignore[import-untyped]

from testbed.mavlink.signing import SIGNATURE_BYTES, SIGNED, Signing

_V1, _V2 = dialect.PROTOCOL_MARKER_V1, dialect.PROTOCOL_MARKER_V2
_HEADER_BYTES = {_V1: 6, _V2: 10}
_CHECKSUM_BYTES = 2
_MARKER = re.compile(b"[\xfd\xfe]")


@dataclass(frozen=True, slots=True)
class Message:
    """One message of a station: who said it, its name, its fields as they came (texts as bytes, up to the first zero).

    ``target`` is the system that it is for, 0 when it is for all; ``payload`` the bytes on the wire, complete.
    """

    name: str
    system: int
    component: int
    target: int
    target_component: int
    payload: bytes
    fields: dict[str, Any]

    def __getitem__(self, field: str) -> Any:
        return self.fields[field]


class _Form:
    """How one message is read."""

    def __init__(self, message: Any) -> None:
        self.name: str = message.msgname
        self.extra = bytes([message.crc_extra])
        self.size: int = message.unpacker.size
        self._unpack = message.unpacker.unpack
        types = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
        self._fields = [
            (name, types[name] == "char", length if types[name] != "char" else 0)
            for name, length in zip(message.ordered_fieldnames, message.array_lengths, strict=True)
        ]

    def read(self, system: int, component: int, payload: bytes) -> Message:
        payload = payload[: self.size].ljust(self.size, b"\0")
        values = self._unpack(payload)
        fields: dict[str, Any] = {}
        at = 0
        for name, is_text, length in self._fields:
            if length:
                fields[name] = values[at : at + length]
                at += length
            else:
                fields[name] = values[at].partition(b"\0")[0] if is_text else values[at]
                at += 1
        target, target_component = fields.get("target_system", 0), fields.get("target_component", 0)
        return Message(self.name, system, component, target, target_component, payload, fields)


_FORMS = {number: _Form(message) for number, message in dialect.mavlink_map.items()}


class Reader:
    """Reads the stream of one station. Work is in proportion to the bytes, and what is kept is less than a frame."""

    def __init__(self, signing: Signing | None = None) -> None:
        self._signing = signing
        self._rest = b""

    def read(self, data: bytes, whole: bool = False) -> Iterator[Message]:
        """The messages that ``data`` completes; ``whole`` when no frame is cut at its end, as in a datagram."""
        data = self._rest + data
        at, end = 0, len(data)
        self._rest = b""
        while at < end:
            marker = data[at]
            if marker != _V2 and marker != _V1:
                found = _MARKER.search(data, at)
                at = found.start() if found else end
                continue
            header = _HEADER_BYTES[marker]
            if at + header > end:
                break
            length = data[at + 1]
            if marker == _V2:
                flags, system, component = data[at + 2], data[at + 5], data[at + 6]
                number = int.from_bytes(data[at + 7 : at + 10], "little")
            else:
                flags, system, component, number = 0, data[at + 3], data[at + 4], data[at + 5]
            form = _FORMS.get(number)
            if form is None or flags & ~SIGNED or (marker == _V1 and length > form.size):
                at += 1
                continue
            payload_end = at + header + length
            size = header + length + _CHECKSUM_BYTES + (SIGNATURE_BYTES if flags else 0)
            if at + size > end:
                if whole:
                    at += 1
                    continue
                break
            checksum: int = dialect.x25crc(data[at + 1 : payload_end] + form.extra).crc
            if checksum != int.from_bytes(data[payload_end : payload_end + _CHECKSUM_BYTES], "little"):
                at += 1
                continue
            frame = data[at : at + size]
            at += size
            if self._signing is not None and not (flags and self._signing.accepts(frame, system, component)):
                continue
            yield form.read(system, component, frame[header : header + length])
        if not whole:
            self._rest = data[at:]


def whole_number(value: float) -> int | None:
    """``value`` as an integer; None when it is none that a message means (NaN, infinite, fractional, beyond 2^53)."""
    return int(value) if abs(value) < 2.0**53 and value == int(value) else None
