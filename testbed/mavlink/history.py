"""What a telemetry log holds: rows of a run are kept until they are many, and become frames all at once."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from nav._jit import njit
from testbed.mavlink.encode import Fields, layout
from testbed.mavlink.snapshot import Moments, Rows
from testbed.mavlink.stream import Group

Places: TypeAlias = NDArray[np.intp]
Said: TypeAlias = Sequence[tuple[int, str, Fields]]  # rows, in their order, and messages

KEPT = 1000  # rows, forty seconds at the usual rate
FRESH_S = 1.0  # of wall time: what is kept is no older, so that a log can be followed
_SLOTS = 1024  # frames of one vehicle in one row at most
_STREAMS = 512  # the first of those for streams
_STAMP, _HEAD, _TAIL = 8, 10, 2  # bytes before and after a payload


@dataclass(slots=True)
class Speech:
    """What one vehicle says in N rows: in each what is ``said`` first, then the streams that are ``due``."""

    system: int
    said: Said
    moments: Moments | None = None
    due: Sequence[tuple[Places, Group]] = ()


class History:
    """Rows of a run, in their order, with the numbers of the frames by vehicle."""

    def __init__(self) -> None:
        self._kept: list[tuple[int, Sequence[Speech]]] = []  # after the numbers of their first places
        self._stamps: list[int] = []
        self._systems: list[int] = []
        self._numbers = np.zeros(256, np.uint8)
        self._rows = 0
        self._taken = time.monotonic()

    def add(self, stamps_us: Sequence[int], speeches: Sequence[Speech]) -> bool:
        """Keep what vehicles say in rows at ``stamps_us`` (N,); whether it is time to take what was kept."""
        self._kept.append((len(self._stamps), speeches))
        for stamp in stamps_us:
            self._stamps += [max(0, min(2**64 - 1, stamp))] * len(speeches)
        self._systems += [one.system for one in speeches] * len(stamps_us)
        self._rows += len(stamps_us)
        return self._rows >= KEPT or time.monotonic() - self._taken > FRESH_S

    def take(self) -> bytes:
        """All that was kept as bytes of a log: big-endian microseconds before each frame."""
        parts = _Parts()
        wanted: dict[Group, list[tuple[Moments, Places, Places]]] = {}  # rows, and their places
        for first, speeches in self._kept:
            for vehicle, speech in enumerate(speeches):
                slots: dict[int, int] = {}
                for row, message, fields in speech.said:
                    place = first + row * len(speeches) + vehicle
                    slots[row] = slots.get(row, -1) + 1
                    payload = np.frombuffer(layout(message).payload(fields), np.uint8)
                    parts.add(message, np.array([place * _SLOTS + slots[row]]), np.array([len(payload)]), payload)
                for rows, group in speech.due:
                    if len(rows) and speech.moments is not None:
                        places = first + rows * len(speeches) + vehicle
                        wanted.setdefault(group, []).append((speech.moments, rows, places))
        for group, found in wanted.items():  # streams of one rate share what is worked out
            together = Rows([(moments, rows) for moments, rows, _ in found])
            places = np.concatenate([places for _, _, places in found]) * _SLOTS + _STREAMS
            for slot, stream in group.streams:
                own = stream.payloads(together)
                parts.add(stream.message, places[own.rows] + slot, own.sizes, own.data)
        data = parts.frames(np.array(self._stamps, np.uint64), np.array(self._systems, np.uint8), self._numbers)
        self._kept, self._stamps, self._systems, self._rows, self._taken = [], [], [], 0, time.monotonic()
        return data


class _Parts:
    """Payloads in the order in which they are made, and where in the log they belong."""

    def __init__(self) -> None:
        self._payloads: list[NDArray[np.uint8]] = []
        self._facts: list[NDArray[np.int64]] = []  # rows of place, size, message, seed of the checksum

    def add(self, message: str, places: Places, sizes: Places, data: NDArray[np.uint8]) -> None:
        """Payloads of one message (N,), each at its place: a slot of a vehicle in a row."""
        own = layout(message)
        facts = np.empty((len(places), 4), np.int64)
        facts[:, 0] = places
        facts[:, 1] = sizes
        facts[:, 2] = int.from_bytes(own.id, "little")
        facts[:, 3] = own.crc_extra[0]
        self._payloads.append(data)
        self._facts.append(facts)

    def frames(self, stamps: NDArray[np.uint64], systems: NDArray[np.uint8], numbers: NDArray[np.uint8]) -> bytes:
        """All of them in their places; ``numbers`` (256,) are those of the next frames by system."""
        if not self._facts:
            return b""
        facts, payload = np.concatenate(self._facts), np.concatenate(self._payloads)
        begins = np.cumsum(facts[:, 1]) - facts[:, 1]
        order = np.argsort(facts[:, 0])
        out = np.empty(len(payload) + len(facts) * (_STAMP + _HEAD + _TAIL), np.uint8)
        length = _write(out, payload, begins[order], facts[order], stamps, systems, numbers)
        return out[:length].tobytes()


def _remainders() -> NDArray[np.uint16]:
    """CRC-16/MCRF4XX of each byte (256,): polynomial 1 + x^5 + x^12 + x^16, the lowest bit first."""
    found = np.arange(256, dtype=np.uint16)
    for _ in range(8):
        found = np.where(found & 1, found >> 1 ^ 0x8408, found >> 1)
    return found.astype(np.uint16)


_REMAINDERS = _remainders()


@njit
def _write(
    out: NDArray[Any],
    payload: NDArray[Any],
    begins: NDArray[Any],
    facts: NDArray[Any],
    stamps: NDArray[Any],
    systems: NDArray[Any],
    numbers: NDArray[Any],
) -> int:
    """Stamps and MAVLink 2 frames of payloads, without their trailing zeros; how many bytes that is."""
    end = 0
    for k in range(len(facts)):
        place, size, message, seed = facts[k, 0] // _SLOTS, facts[k, 1], facts[k, 2], facts[k, 3]
        first = begins[k]
        while size > 1 and payload[first + size - 1] == 0:
            size -= 1
        for i in range(_STAMP):
            out[end + i] = (stamps[place] >> np.uint64(8 * (_STAMP - 1 - i))) & np.uint64(255)
        head = end + _STAMP
        system = systems[place]
        out[head] = 0xFD
        out[head + 1] = size
        out[head + 2] = 0
        out[head + 3] = 0
        out[head + 4] = numbers[system]
        numbers[system] = (numbers[system] + 1) & 255
        out[head + 5] = system
        out[head + 6] = 1
        for i in range(3):
            out[head + 7 + i] = (message >> (8 * i)) & 255
        end = head + _HEAD + size
        out[head + _HEAD : end] = payload[first : first + size]
        crc = 0xFFFF
        for i in range(head + 1, end + 1):
            byte = int(seed if i == end else out[i])
            crc = (crc >> 8) ^ int(_REMAINDERS[(crc ^ byte) & 255])
        out[end] = crc & 255
        out[end + 1] = crc >> 8
        end += _TAIL
    return end
