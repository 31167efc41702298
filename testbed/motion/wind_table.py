"""Wind over time and altitude from a CSV file: what a radiosonde measured, or a forecast says."""

from __future__ import annotations

import csv
import itertools
import math
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nav.samples import Array
from testbed.errors import UserError

NEEDED = ("alt_m", "from_deg", "speed_mps")
LIMITS = {"time_s": (-1e9, 1e9), "alt_m": (-500.0, 50_000.0), "from_deg": (-360.0, 360.0), "speed_mps": (0.0, 150.0)}


@dataclass(frozen=True, slots=True)
class WindTable:
    """Soundings at ``times`` [s], ascending: each altitudes (N,) [m], ascending, and velocity of the air (N, 2), NE.

    Between altitudes, then between times, each component is linear; beyond the first and last it is constant.
    """

    times: list[float]
    soundings: list[tuple[Array, Array]]

    def at(self, t: float, alt: float) -> tuple[float, float]:
        """Velocity of the air north, east [m/s] at a time [s] and an altitude [m]."""
        after = bisect_right(self.times, t)
        if after in (0, len(self.times)):
            return self._sounding(after and -1, alt)
        before = after - 1
        share = (t - self.times[before]) / (self.times[after] - self.times[before])
        earlier, later = self._sounding(before, alt), self._sounding(after, alt)
        return earlier[0] + share * (later[0] - earlier[0]), earlier[1] + share * (later[1] - earlier[1])

    @property
    def strongest(self) -> float:
        """The largest speed in it [m/s]."""
        return max(float(np.hypot(*v.T).max()) for _, v in self.soundings)

    def _sounding(self, number: int, alt: float) -> tuple[float, float]:
        alts, v = self.soundings[number]
        return float(np.interp(alt, alts, v[:, 0])), float(np.interp(alt, alts, v[:, 1]))


def read(path: Path) -> WindTable:
    """The table in a CSV file. Raises UserError, with the line, where it can't be read or makes no sense.

    Its first line names the columns: ``alt_m`` (above the ellipsoid), ``from_deg``, ``speed_mps``, and ``time_s`` of
    the run, without which there is one sounding for all times. Others are left alone. Rows are sorted by time, then
    altitude.
    """
    try:
        text = path.read_text("utf-8-sig")
    except OSError as error:
        raise UserError(f"{path}: can't be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: is not UTF-8 text: save it as CSV") from None
    try:
        rows = list(_rows(path, text))
    except csv.Error as error:
        raise UserError(f"{path}: is no CSV file: {error}") from None
    if not rows:
        raise UserError(f"{path}: has no rows: add at least one below the names of the columns")
    for (_, upper), (line, lower) in itertools.pairwise(rows):
        if lower[:2] <= upper[:2]:
            raise UserError(f"{path}:{line}: is not sorted: times must ascend, and in each time altitudes, each once")
    table = np.array([row for _, row in rows])
    from_rad = np.radians(table[:, 2])
    v = -table[:, 3:] * np.column_stack((np.cos(from_rad), np.sin(from_rad)))
    times, firsts = np.unique(table[:, 0], return_index=True)
    parts = zip(np.split(table[:, 1], firsts[1:]), np.split(v, firsts[1:]), strict=True)
    return WindTable(times.tolist(), list(parts))


def _rows(path: Path, text: str) -> Iterator[tuple[int, tuple[float, ...]]]:
    """The number of each line and its time, altitude, direction and speed."""
    reader = csv.DictReader(text.splitlines(), skipinitialspace=True)
    names = [name.strip() for name in reader.fieldnames or ()]
    reader.fieldnames = names
    if missing := [name for name in NEEDED if name not in names]:
        there = ", ".join(names) or "none"
        raise UserError(f"{path}:1: has no column {' and no '.join(missing)}: its columns are {there}")
    wanted = ("time_s", *NEEDED)
    for row in reader:
        line = reader.line_num
        yield line, tuple(_number(path, line, name, row[name]) if name in names else 0.0 for name in wanted)


def _number(path: Path, line: int, name: str, text: str | None) -> float:
    text = text or ""  # of a line that is too short
    least, most = LIMITS[name]
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        raise UserError(f"{path}:{line}: {name} is {text!r}: must be a number from {least:g} to {most:g}")
    return value
