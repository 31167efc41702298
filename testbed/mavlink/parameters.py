"""The vehicle's parameters: what may change in flight, and a few facts that stations look for.

Source of the two ways to send integers: https://mavlink.io/en/services/parameter.html#parameter-encoding
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from pymavlink.dialects.v20 import all as mav  # type: ignore[import-untyped]

from testbed.loop.settings import Setting
from testbed.mavlink.encode import Fields
from testbed.mavlink.receive import Message, whole_number

_INTEGERS = {
    mav.MAV_PARAM_TYPE_UINT8: "<B",
    mav.MAV_PARAM_TYPE_INT8: "<b",
    mav.MAV_PARAM_TYPE_UINT16: "<H",
    mav.MAV_PARAM_TYPE_INT16: "<h",
    mav.MAV_PARAM_TYPE_UINT32: "<I",
    mav.MAV_PARAM_TYPE_INT32: "<i",
}
_VALUE_BYTES = 4
_BY_NAME = -1  # index of a request that names the parameter
_NO_INDEX = 2**16 - 1


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of a PARAM_SET: the name, the new value, or the MAV_PARAM_ERROR that stands against it."""

    name: str
    value: float
    error: int = mav.MAV_PARAM_ERROR_NO_ERROR


class Parameters:
    """A table of parameters in a fixed order, and how their values travel."""

    def __init__(self, facts: Mapping[str, tuple[int, str]], settings: Mapping[str, Setting], byte_wise: bool) -> None:
        """``facts`` are for reading only; ``settings`` as `testbed.loop.settings.settings` gives them."""
        self._byte_wise = byte_wise
        self._settings = dict(settings)
        self._values: dict[str, float] = {name: float(value) for name, (value, _) in facts.items()}
        self._values |= {name: setting.value for name, setting in settings.items()}
        self._names = sorted(self._values)  # as stations sort them
        self._whole = set(facts) | {name for name, setting in settings.items() if setting.whole}

    def __len__(self) -> int:
        return len(self._names)

    def value(self, index: int) -> Fields:
        """PARAM_VALUE of the parameter at ``index``."""
        name = self._names[index]
        return self._fields(name, index)

    def sought(self, message: Message) -> Fields | None:
        """PARAM_VALUE that a PARAM_REQUEST_READ asks for; None when there is no such parameter."""
        index = message["param_index"]
        if index != _BY_NAME:
            return self.value(index) if 0 <= index < len(self) else None
        name = _text(message)
        return self._fields(name, self._names.index(name)) if name in self._values else None

    def in_force(self, name: str) -> Fields | None:
        """PARAM_VALUE of a name; None when there is no such parameter."""
        return self._fields(name, self._names.index(name)) if name in self._values else None

    def judge(self, message: Message) -> Verdict:
        """What a PARAM_SET asks for, and whether it may be."""
        name = _text(message)
        if name not in self._values:
            return Verdict(name, math.nan, mav.MAV_PARAM_ERROR_DOES_NOT_EXIST)
        setting = self._settings.get(name)
        if setting is None:
            return Verdict(name, math.nan, mav.MAV_PARAM_ERROR_READ_ONLY)
        value = self._decode(message)
        fits = setting.least <= value <= setting.most and not (setting.whole and whole_number(value) is None)
        return Verdict(name, value, mav.MAV_PARAM_ERROR_NO_ERROR if fits else mav.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE)

    def put(self, name: str, value: float) -> None:
        """Keep a value, as judged."""
        self._values[name] = value

    def _fields(self, name: str, index: int) -> Fields:
        value = self._values[name]
        if name in self._whole and self._byte_wise:
            value = struct.unpack("<f", struct.pack("<i", int(value)))[0]
        return {
            "param_id": name.encode(),
            "param_value": value,
            "param_type": mav.MAV_PARAM_TYPE_INT32 if name in self._whole else mav.MAV_PARAM_TYPE_REAL32,
            "param_count": len(self),
            "param_index": index,
        }

    def _decode(self, message: Message) -> float:
        """The number meant: bytes of an integer, or a float32, taken for the shortest decimal number that gives it."""
        raw = message.payload[:_VALUE_BYTES]
        form = _INTEGERS.get(message["param_type"])
        if form and self._byte_wise:
            return float(struct.unpack(form, raw[: struct.calcsize(form)])[0])
        return float(str(np.frombuffer(raw, "<f4")[0]))


def refusal(name: bytes, index: int, error: int) -> dict[str, float | bytes]:
    """PARAM_ERROR without its target."""
    return {"param_id": name, "param_index": index, "error": error}


def _text(message: Message) -> str:
    """The name in a message; what is not text becomes a name that no parameter has."""
    raw: bytes = message["param_id"]
    return raw.decode("ascii", "replace")
