"""What a telemetry log holds: rows of a run are kept until they are many, and become frames all at once."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from nav._jit import njit
from testbed.mavlink.encode import Fields, layout
from testbed.mavlink.snapshot import Rows, Snapshot
from testbed.mavlink.stream import Stream

Places: TypeAlias = NDArray[np.intp]

KEPT = 1000  # moments, forty seconds at the usual rate
FRESH_S = 1.0  # of wall time: what is kept is no older, so that a log can be followed
_SLOTS = 256  # frames of one moment at most
_STAMP, _HEAD, _TAIL = 8, 10, 2  # bytes before and after a payload


@dataclass(slots=True)  # frozen ones take three times as long to make
class _Moment:
    """What one vehicle says at one time."""

    stamp_us: int
    system: int
    said: Sequence[tuple[str, Fields]]
    snapshot: Snapshot | None
    streams: Sequence[Stream]


class History:
    """Moments of a run, in their order, with the numbers of the frames by vehicle."""

    def __init__(self) -> None:
        self._moments: list[_Moment] = []
        self._numbers = np.zeros(256, np.uint8)
        self._taken = time.monotonic()

    def add(
        self,
        stamp_us: int,
        system: int,
        said: Sequence[tuple[str, Fields]],
        snapshot: Snapshot | None = None,
        streams: Sequence[Stream] = (),
    ) -> bool:
        """Keep what is ``said`` first and the ``streams`` due of a ``snapshot``; whether it is time to take them."""
        self._moments.append(_Moment(stamp_us, system, said, snapshot, streams))
        return len(self._moments) >= KEPT or time.monotonic() - self._taken > FRESH_S

    def take(self) -> bytes:
        """All that was kept as bytes of a log: big-endian microseconds before each frame."""
        moments, self._moments, self._taken = self._moments, [], time.monotonic()
        parts = _Parts()
        wanted: dict[Stream, list[int]] = defaultdict(list)
        for at, moment in enumerate(moments):
            place = at * _SLOTS
            for message, fields in moment.said:
                payload = np.frombuffer(layout(message).payload(fields), np.uint8)
                parts.add(message, np.array([place]), np.array([len(payload)]), payload)
                place += 1
            for stream in moment.streams:
                wanted[stream].append(place)
                place += 1
        together: dict[bytes, Rows] = {}  # streams of one rate share what is worked out
        for stream, found in wanted.items():
            places = np.array(found)
            where = places // _SLOTS
            rows = together.get(where.tobytes())
            if rows is None:
                snapshots = [one for at in where.tolist() if (one := moments[at].snapshot) is not None]
                rows = together[where.tobytes()] = Rows(snapshots)
            own = stream.payloads(rows)
            parts.add(stream.message, places[own.rows], own.sizes, own.data)
        stamps = np.array([max(0, min(2**64 - 1, moment.stamp_us)) for moment in moments], np.uint64)
        systems = np.array([moment.system for moment in moments], np.uint8)
        return parts.frames(stamps, systems, self._numbers)


class _Parts:
    """Payloads in the order in which they are made, and where in the log they belong."""

    def __init__(self) -> None:
        self._payloads: list[NDArray[np.uint8]] = []
        self._facts: list[NDArray[np.int64]] = []  # rows of place, moment, size, message, seed of the checksum

    def add(self, message: str, places: Places, sizes: Places, data: NDArray[np.uint8]) -> None:
        """Payloads of one message (N,), each at its place: the slot of a moment."""
        own = layout(message)
        facts = np.empty((len(places), 5), np.int64)
        facts[:, 0] = places
        facts[:, 1] = places // _SLOTS
        facts[:, 2] = sizes
        facts[:, 3] = int.from_bytes(own.id, "little")
        facts[:, 4] = own.crc_extra[0]
        self._payloads.append(data)
        self._facts.append(facts)

    def frames(self, stamps: NDArray[np.uint64], systems: NDArray[np.uint8], numbers: NDArray[np.uint8]) -> bytes:
        """All of them in their places; ``numbers`` (256,) are those of the next frames by system."""
        if not self._facts:
            return b""
        facts, payload = np.concatenate(self._facts), np.concatenate(self._payloads)
        begins = np.cumsum(facts[:, 2]) - facts[:, 2]
        order = np.argsort(facts[:, 0])
        out = np.empty(len(payload) + len(facts) * (_STAMP + _HEAD + _TAIL), np.uint8)
        length = _write(out, payload, begins[order], facts[order], stamps, systems, numbers)
        return out[:length].tobytes()


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
        moment, size, message, seed = facts[k, 1], facts[k, 2], facts[k, 3], facts[k, 4]
        first = begins[k]
        while size > 1 and payload[first + size - 1] == 0:
            size -= 1
        for i in range(_STAMP):
            out[end + i] = (stamps[moment] >> np.uint64(8 * (_STAMP - 1 - i))) & np.uint64(255)
        head = end + _STAMP
        system = systems[moment]
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
            byte = int(seed if i == end else out[i]) ^ (crc & 255)
            byte = (byte ^ (byte << 4)) & 255
            crc = (crc >> 8) ^ (byte << 8) ^ (byte << 3) ^ (byte >> 4)
        out[end] = crc & 255
        out[end + 1] = crc >> 8
        end += _TAIL
    return end
