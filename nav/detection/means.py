"""What detectors that gather evidence remember of the residuals: a window of them, and means that forget or do not."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from nav._jit import njit
from nav.samples import Array


class Window:
    """The residuals of the last ``span_s`` seconds in one contiguous array that grows when it must."""

    def __init__(self, span_s: float) -> None:
        self.span_s = span_s
        self._times: Array = np.empty(64)
        self._rows: Array = np.empty((64, 0, 0))
        self._first = self._end = 0

    def push(self, r: Array, t: float) -> Array:
        """Take ``r`` of any shape and return those still inside the window, oldest first (n, *r.shape)."""
        if self._end == 0 or self._rows.shape[1:] != r.shape:
            self._first = self._end = 0
            self._rows = np.empty((len(self._times), *r.shape))
        if self._end == len(self._times):
            self._make_room()
        self._times[self._end], self._rows[self._end] = t, r
        self._end += 1
        while self._times[self._first] <= t - self.span_s:
            self._first += 1
        return self._rows[self._first : self._end]

    def clear(self) -> None:
        """Forget everything."""
        self._first = self._end = 0

    def _make_room(self) -> None:
        live, size = slice(self._first, self._end), self._end - self._first
        capacity = max(64, 2 * size)
        times, rows = np.empty(capacity), np.empty((capacity, *self._rows.shape[1:]))
        times[:size], rows[:size] = self._times[live], self._rows[live]
        self._times, self._rows, self._first, self._end = times, rows, 0, size


@njit
def _mean(rows: Array) -> Array:
    """The mean of ``rows`` (n, 2, m) over the first axis."""
    total: Array = np.zeros_like(rows[0])
    for row in rows:
        total += row
    total /= len(rows)
    return total


class Mean(Protocol):
    """What `Sprt` remembers of the residuals."""

    decay: float  # what a step leaves of the evidence gathered so far, in the recursive form
    n: float  # the samples it stands for
    value: Array  # (2, m) of `whiten`'s residuals
    variance: float  # of each component when nothing is wrong

    def add(self, r: Array, t: float) -> None:
        """Take the residuals ``r`` (2, m) of one sample at ``t`` [s]."""
        ...

    def restart(self, r: Array, t: float) -> None:
        """Forget all but ``r`` (Eq 21)."""
        ...


@dataclass
class RunningMean:
    """n <- decay n + 1; mean <- mean + (r - mean) / n: see `plain` and `exponential`."""

    decay: float = 1.0
    n: float = field(default=0.0, init=False)
    value: Array = field(default_factory=lambda: np.zeros((2, 1)), init=False)
    variance: float = field(default=0.0, init=False)

    def add(self, r: Array, t: float) -> None:
        """Take one sample; see `Mean`."""
        self.n = self.decay * self.n + 1.0
        gain = 1.0 / self.n
        self.value = self.value + gain * (r - self.value)
        self.variance = (1.0 - gain) ** 2 * self.variance + gain**2

    def restart(self, r: Array, t: float) -> None:
        """Forget all but ``r``; see `Mean`."""
        self.n, self.value, self.variance = 1.0, r, 1.0


def plain() -> RunningMean:
    """The mean of all samples (Eq 12): the longer the sound past, the slower; 20 s to see 5 sigma after 1 h at 5 Hz."""
    return RunningMean()


def exponential(s: float) -> RunningMean:
    """The mean that forgets, weights s^age: a memory of 1/(1 - s) samples; 0.95 suits 5-10 Hz, 0.8 suits 1 Hz.

    Raises ValueError when ``s`` is no fraction between 0 and 1.
    """
    if not 0 < s < 1:
        raise ValueError(f"a forgetting factor between 0 and 1 is needed, not {s}")
    return RunningMean(decay=s)


class WindowMean:
    """The mean of the samples of the last ``span_s`` seconds."""

    decay = 1.0

    def __init__(self, span_s: float) -> None:
        self._window = Window(span_s)
        self.n = 0.0
        self.value: Array = np.zeros((2, 1))
        self.variance = 0.0

    def add(self, r: Array, t: float) -> None:
        """Take one sample; see `Mean`."""
        rows = self._window.push(r, t)
        self.n = float(len(rows))
        self.value = _mean(rows)
        self.variance = 1.0 / self.n

    def restart(self, r: Array, t: float) -> None:
        """Forget all but ``r``; see `Mean`."""
        self._window.clear()
        self.add(r, t)
