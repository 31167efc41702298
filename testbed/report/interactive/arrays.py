"""The numbers of a page: thinned, as 32-bit floats, one after the other."""

from __future__ import annotations

import base64
from typing import TypeAlias

import numpy as np

from nav.samples import Array
from testbed.report import style

FLOATS = 750_000  # that a page may hold: 4 MB of it
PER_BIN = 170  # floats that an estimator has for each bin of a line
FEWEST, MOST = 300, 2000  # bins

Place: TypeAlias = list[int]  # where numbers begin, and how many there are


class Arrays:
    """Takes arrays and says where they are. ``bins`` is of how many parts lines are made, each with two points."""

    def __init__(self, subjects: int) -> None:
        self.bins = int(np.clip(FLOATS // (PER_BIN * max(subjects, 1)), FEWEST, MOST))
        self._parts: dict[bytes, Place] = {}
        self._length = 0

    def add(self, values: Array) -> Place:
        """Keep an array (N,); what is not finite, or too large for 32 bits, is a gap. The same array is kept once."""
        with np.errstate(over="ignore"):
            kept = np.asarray(values).astype("<f4")
        kept[~np.isfinite(kept)] = np.nan
        part = kept.tobytes()
        if part not in self._parts:
            self._parts[part] = [self._length, len(kept)]
            self._length += len(kept)
        return self._parts[part]

    def line(self, t: Array, y: Array) -> dict[str, Place]:
        """A line with the lowest and the highest point of each bin."""
        thin_t, thin_y = style.thin(np.asarray(t), np.asarray(y), self.bins)
        return {"t": self.add(thin_t), "y": self.add(thin_y)}

    def stride(self, count: int, points: int = 0) -> slice:
        """Every so many of ``count`` rows that there are about ``points``, or one for each bin."""
        return slice(None, None, max(1, count // (points or self.bins)))

    def text(self) -> str:
        """All of them, in base64."""
        return base64.b64encode(b"".join(self._parts)).decode()
