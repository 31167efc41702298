"""PX4's ULog: topics of fixed rows, parameters, and texts, as bytes.

Source: ULog file format, https://docs.px4.io/main/en/dev_log/ulog_file_format
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from testbed.exports.px4_messages import MESSAGES, VERSIONS
from testbed.exports.stream import Bytes, Rows, in_order

TYPES = {
    "Q": "uint64_t", "I": "uint32_t", "H": "uint16_t", "B": "uint8_t", "i": "int32_t", "h": "int16_t", "b": "int8_t",
    "?": "bool", "f": "float", "d": "double",
}  # fmt: skip
ALIGNED_TO = 8  # bytes, by the time stamp that every message has
LEVELS = {"info": b"6", "warning": b"4", "error": b"3"}  # as those of the kernel's log


@dataclass(frozen=True, slots=True)
class Topic:
    """The rows of one instance of a topic, by rising ``timestamp`` [us]."""

    name: str
    instance: int
    rows: Rows


@lru_cache
def layout(topic: str, version: str) -> tuple[str, np.dtype[Any]]:
    """How PX4 of this version writes a topic: its FORMAT text, padding in it, and the row, without that at its end."""
    fields: list[tuple[str, Any, tuple[int, ...]]] = []
    text = []
    for group in VERSIONS[version][MESSAGES.get(topic, topic)].split(" | "):
        kind, *names = group.split()
        letter, length = kind[-1], kind[:-1]
        for name in names:
            fields.append((name, np.dtype(f"<{letter}"), (int(length),) if length else ()))
            text.append(f"{TYPES[letter]}{f'[{length}]' if length else ''} {name};")
    row = np.dtype(fields)
    if missing := -row.itemsize % ALIGNED_TO:
        text.append(f"uint8_t[{missing}] _padding0;")
    return "".join(text), row


def rows(topic: str, version: str, stamps: npt.NDArray[np.int64], **values: Any) -> Rows:
    """Rows of a topic at these times (N,) [us]: ``values`` by field, 0 where nothing is said.

    What only another version has is left out. Raises KeyError of a field that none has.
    """
    _, row = layout(topic, version)
    made = np.zeros(len(stamps), row)
    for name, value in {"timestamp": stamps, **values}.items():
        if name in (row.names or ()):
            kind = row[name].base
            with np.errstate(over="ignore", invalid="ignore"):  # beyond what the field can hold it is infinite, or 0
                made[name] = _whole(value, kind) if kind.kind in "iu" else value
        elif not any(name in (layout(topic, other)[1].names or ()) for other in VERSIONS):
            raise KeyError(name)
    return made


def _whole(value: Any, kind: np.dtype[Any]) -> npt.NDArray[Any]:
    """Numbers as integers of a ``kind``, 0 of what that can't hold."""
    number, limits = np.rint(value), np.iinfo(kind)
    held = (number >= limits.min) & (number <= limits.max)
    return np.where(held, number, 0).astype(kind)


def encode(
    topics: Sequence[Topic],
    version: str,
    start_us: int,
    *,
    parameters: Mapping[str, int | float],
    infos: Mapping[str, str],
    texts: Sequence[tuple[int, str, str]],
) -> bytes:
    """A ULog: ``texts`` are time [us], severity and words. Topics without rows are left out."""
    topics = [topic for topic in topics if len(topic.rows)]
    head = [b"ULog\x01\x12\x35\x01", struct.pack("<Q", start_us), _message(b"B", bytes(40))]
    head += [
        _message(b"F", f"{name}:{layout(name, version)[0]}".encode())
        for name in dict.fromkeys(topic.name for topic in topics)
    ]
    head += [_named(b"I", f"char[{len(text.encode())}] {name}", text.encode()) for name, text in infos.items()]
    for name, value in parameters.items():
        kind, letter = ("int32_t", "i") if isinstance(value, int) else ("float", "f")
        head.append(_named(b"P", f"{kind} {name}", struct.pack(f"<{letter}", value)))
    for number, topic in enumerate(topics):
        head.append(_message(b"A", struct.pack("<BH", topic.instance, number) + topic.name.encode()))
    parts = [(topic.rows["timestamp"], _framed(number, topic.rows)) for number, topic in enumerate(topics)]
    for t, severity, words in texts:
        said = _message(b"L", LEVELS[severity] + struct.pack("<Q", t) + words.encode())
        parts.append((np.array([t], np.uint64), np.frombuffer(said, np.uint8)[None]))
    return b"".join(head) + in_order(parts)


def _message(kind: bytes, body: bytes) -> bytes:
    return struct.pack("<H", len(body)) + kind + body


def _named(kind: bytes, key: str, value: bytes) -> bytes:
    return _message(kind, bytes([len(key.encode())]) + key.encode() + value)


def _framed(number: int, own: Rows) -> Bytes:
    """Each row as a message of data (N, size)."""
    size = own.dtype.itemsize
    framed = np.empty((len(own), size + 5), np.uint8)
    framed[:, :5] = np.frombuffer(struct.pack("<H", size + 2) + b"D" + struct.pack("<H", number), np.uint8)
    framed[:, 5:] = np.ascontiguousarray(own).view(np.uint8).reshape(len(own), size)
    return framed
