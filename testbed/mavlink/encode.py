"""Numbers to MAVLink 2 frames: the one layer that rounds, saturates and wraps, and cannot fail whatever the numbers.

`Encoder` makes frames, `Voice` numbers and signs them for one listener.

Field names, types, order on the wire and checksum seeds come from pymavlink's ``all`` dialect; only the framing is
done here, because pymavlink's own objects cost several times the rest of the stream.
Source: MAVLink 2 packet format, https://mavlink.io/en/guide/serialization.html
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from operator import itemgetter
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import all as dialect  # type: ignore[import-untyped]

from nav.samples import Array
from testbed.mavlink.signing import SIGNED, Signing

Value: TypeAlias = float | bytes | Sequence[float] | Array
Fields: TypeAlias = Mapping[str, Value]

_MARKER = bytes([dialect.PROTOCOL_MARKER_V2])
_HEADER = struct.Struct("6B")
_CRC_START = 0xFFFF
_FLOAT_MAX = struct.unpack("<f", b"\xff\xff\x7f\x7f")[0]
_RANGE: dict[str, tuple[float, float]] = {
    "uint8_t": (0, 2**8 - 1),
    "int8_t": (-(2**7), 2**7 - 1),
    "uint16_t": (0, 2**16 - 1),
    "int16_t": (-(2**15), 2**15 - 1),
    "uint32_t": (0, 2**32 - 1),
    "int32_t": (-(2**31), 2**31 - 1),
    "uint64_t": (0, 2**64 - 1),
    "int64_t": (-(2**63), 2**63 - 1),
    "float": (-_FLOAT_MAX, _FLOAT_MAX),
}
_TYPES = {
    "uint8_t": "u1",
    "int8_t": "i1",
    "uint16_t": "<u2",
    "int16_t": "<i2",
    "uint32_t": "<u4",
    "int32_t": "<i4",
    "uint64_t": "<u8",
    "int64_t": "<i8",
    "float": "<f4",
    "double": "<f8",
}
# What an integer field says when its number is NaN; 0 where the message defines nothing. Floats carry NaN themselves.
_UNKNOWN: dict[tuple[str, str], int] = {
    ("GLOBAL_POSITION_INT", "hdg"): 2**16 - 1,
    ("GPS_RAW_INT", "eph"): 2**16 - 1,
    ("GPS_RAW_INT", "epv"): 2**16 - 1,
    ("GPS_RAW_INT", "vel"): 2**16 - 1,
    ("GPS_RAW_INT", "cog"): 2**16 - 1,
    ("GPS_RAW_INT", "satellites_visible"): 2**8 - 1,
    ("GPS_RAW_INT", "h_acc"): 2**32 - 1,
    ("GPS_RAW_INT", "v_acc"): 2**32 - 1,
    ("GPS_RAW_INT", "vel_acc"): 2**32 - 1,
}
_MESSAGES: dict[str, Any] = {message.msgname: message for message in dialect.mavlink_map.values()}


def _checksum(data: bytes) -> bytes:
    """CRC-16/MCRF4XX on the wire; pymavlink's class costs as much again as the sum, and stands in where that lacks."""
    found: int = dialect.x25crc(data).crc if dialect.mcrf4xx is None else dialect.mcrf4xx(data, _CRC_START)
    return found.to_bytes(2, "little")


def boot_ms(t: float) -> int:
    """Time since boot [ms] of ``t`` [s]; wraps after 49.7 days as the field does, 0 when ``t`` is not finite."""
    return round(t * 1e3) % 2**32 if math.isfinite(t * 1e3) else 0


def microseconds(t: float) -> int:
    """``t`` [s] in microseconds, 0 when it is not finite."""
    return round(t * 1e6) if math.isfinite(t * 1e6) else 0


def centidegrees(angle: float) -> float:
    """Angle [rad] as 0 … 35999 hundredths of a degree, clockwise from north; NaN (unknown) when it is not finite."""
    hundredths = math.degrees(angle) * 100
    return round(hundredths) % 36000 if math.isfinite(hundredths) else math.nan


def latitude_e7(lat: float) -> float:
    """Latitude [rad] in 1e-7 deg, saturated at the poles."""
    return max(-90e7, min(90e7, math.degrees(lat) * 1e7)) if lat == lat else math.nan


def longitude_e7(lon: float) -> float:
    """Longitude [rad] in 1e-7 deg, wrapped into [-180, 180] deg; NaN when it is not finite."""
    return math.degrees(math.remainder(lon, 2 * math.pi)) * 1e7 if math.isfinite(lon) else math.nan


def latitudes_e7(lat: Array) -> Array:
    """`latitude_e7` of many."""
    return np.clip(np.degrees(lat) * 1e7, -90e7, 90e7)


def longitudes_e7(lon: Array) -> Array:
    """`longitude_e7` of many."""
    return np.degrees(lon - 2 * math.pi * np.rint(lon / (2 * math.pi))) * 1e7


@dataclass(frozen=True, slots=True)
class _Number:
    """One number (or text, without limits) on the wire."""

    limits: tuple[float, float] | None
    is_integer: bool
    unknown: int

    def saturate(self, value: Any) -> Any:
        """``value`` within the field's range, whatever it was."""
        if self.limits is None or (not self.is_integer and not math.isfinite(value)):
            return value
        if value != value:
            return self.unknown
        low, high = self.limits
        bounded = max(low, min(high, value))
        return round(bounded) if self.is_integer else bounded

    def fill(self, column: NDArray[Any], values: Any) -> None:
        """Put values into a column of their type, each as `saturate` has it."""
        if self.limits is None:
            column[...] = values
            return
        kept = np.rint(values) if self.is_integer else np.asarray(values, float)
        low, high = self.limits
        fits = (low <= kept) & (kept <= min(high, 2.0**62))  # a float does not hold the last of 64 bits
        if not self.is_integer:
            fits |= ~np.isfinite(kept)
        if fits.all():
            column[...] = kept
        else:
            slow = [self.saturate(value) for value in np.broadcast_to(kept, column.shape).ravel().tolist()]
            column[...] = np.array(slow, column.dtype).reshape(column.shape)


class Layout:
    """How one message lies on the wire."""

    def __init__(self, name: str) -> None:
        message = _MESSAGES[name]
        types = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
        self.id: bytes = message.id.to_bytes(3, "little")
        self.crc_extra = bytes([message.crc_extra])
        self._pack = message.unpacker.pack
        names = message.ordered_fieldnames
        self._values = itemgetter(*names) if len(names) > 1 else lambda fields: (fields[names[0]],)
        self._numbers: list[_Number] = []
        self._columns: dict[str, _Number] = {}
        self._arrays: list[int] = []  # positions among the fields, the last first: each is replaced by its numbers
        for position, (field, length) in enumerate(zip(message.ordered_fieldnames, message.array_lengths, strict=True)):
            kind = types[field]
            number = _Number(
                limits=_RANGE.get(kind),
                is_integer=kind not in ("float", "char"),
                unknown=_UNKNOWN.get((name, field), 0),
            )
            self._columns[field] = number
            is_array = length > 0 and kind != "char"
            self._numbers += [number] * (length if is_array else 1)
            if is_array:
                self._arrays.insert(0, position)
        self._integers = [i for i, number in enumerate(self._numbers) if number.is_integer]
        self._row = np.dtype(
            [
                (field, f"S{n}" if types[field] == "char" else (_TYPES[types[field]], (n,) if n else ()))
                for field, n in zip(names, message.array_lengths, strict=True)
            ]
        )

    def payload(self, fields: Fields) -> bytes:
        """The fields as bytes."""
        values: list[Any] = list(self._values(fields))
        for position in self._arrays:
            values[position : position + 1] = values[position]
        try:
            for i in self._integers:
                values[i] = round(values[i])
            packed = self._pack(*values)
        except (struct.error, OverflowError, ValueError):  # out of range or not a number: rare, so the slow way
            packed = self._pack(*[number.saturate(v) for v, number in zip(values, self._numbers, strict=True)])
        return bytes(packed)

    def payloads(self, fields: Fields, count: int) -> NDArray[np.uint8]:
        """What `payload` gives for each of ``count`` rows, (count, size).

        A field is one value for all rows, or an array of them.
        """
        rows = np.zeros(count, self._row)
        for field, number in self._columns.items():
            number.fill(rows[field], fields[field])
        return rows.view(np.uint8).reshape(count, -1)


@cache
def layout(message: str) -> Layout:
    """How a message of that name lies on the wire."""
    return Layout(message)


class Encoder:
    """Frames of one vehicle, numbered as they are made."""

    def __init__(self, system: int = 1, component: int = 1) -> None:
        self.system = system
        self._component = component
        self._sequence = 0

    def frame(self, message: str, values: Fields) -> bytes:
        """One frame of ``message`` (its name in the dialect) with every field of it given, in the field's unit.

        Numbers may be any float: integer fields are rounded and saturate, NaN becomes the field's unknown value;
        float fields keep NaN and infinities and saturate at the largest float32.
        """
        return self.wrap(message, layout(message).payload(values))

    def wrap(self, message: str, payload: bytes) -> bytes:
        """One frame of a ``message`` whose fields are bytes already; the zeros at their end are left out."""
        own = layout(message)
        payload = payload.rstrip(b"\0") or b"\0"
        said = _HEADER.pack(len(payload), 0, 0, self._sequence, self.system, self._component) + own.id + payload
        self._sequence = (self._sequence + 1) % 256
        return _MARKER + said + _checksum(said + own.crc_extra)


_CRC_EXTRA = {
    number.to_bytes(3, "little"): bytes([message.crc_extra]) for number, message in dialect.mavlink_map.items()
}


class Voice:
    """What one listener hears: frames numbered without gaps, by vehicle, and signed when there is a key.

    Frames are made once for all listeners; but a listener counts the numbers to know what was lost on its own way.
    """

    def __init__(self, signing: Signing | None = None) -> None:
        self._signing = signing
        self._numbers: dict[bytes, int] = {}

    def say(self, frame: bytes) -> bytes:
        """``frame`` (of an `Encoder`) with the number that is next for this listener, signed if need be."""
        source = frame[5:7]
        number = self._numbers.get(source, 0)
        self._numbers[source] = (number + 1) % 256
        flags = SIGNED if self._signing else 0
        body = frame[:2] + bytes((flags, 0, number)) + frame[5:-2]
        said = body + _checksum(body[1:] + _CRC_EXTRA[frame[7:10]])
        return self._signing.sign(said) if self._signing else said
