"""Simulated time held to the wall clock."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from numbers import Real

from testbed.errors import UserError

JITTER_STEP_S = 1e-4
MAX_LAG_S = 0.5  # a run further behind than this gives up the rest instead of racing to make it good


class Pacer:
    """Holds a run to ``factor`` times the speed of the wall clock.

    Every deadline is counted from one start on a monotonic clock, so waits don't add up to a drift. A run that comes
    late catches up at most `MAX_LAG_S` of wall time; what exceeds it is given up, and the deadlines after it move.

    ``waits`` counts the calls after the first, ``missed`` those that came after their deadline; ``worst_s`` is the
    latest of them and ``given_up_s`` the wall time that was not made good. As text, it says these. `jitter_s` tells
    how late the waits were over.
    """

    def __init__(
        self,
        factor: float = 1.0,
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Start at the first `wait`. Raises UserError unless ``factor`` is positive and finite."""
        given: object = factor
        if not (isinstance(given, Real) and math.isfinite(factor) and factor > 0):
            raise UserError(f"--realtime {factor}: the speed must be above 0; 1 is the speed of the wall clock")
        self.factor = factor
        self._clock = clock
        self._sleep = sleep
        self._jitter = [0] * 5000  # waits by how late they were over; the last: or more
        self._start: float | None = None  # clock reading at simulated time 0
        self.waits = 0
        self.missed = 0
        self.worst_s = 0.0
        self.given_up_s = 0.0

    def restart(self, t: float, factor: float | None = None) -> None:
        """Count from now, which is simulated time ``t`` [s], at another speed perhaps."""
        self.factor = factor or self.factor
        self._start = self._clock() - t / self.factor

    def wait(self, t: float, meanwhile: Callable[[float], object] | None = None) -> None:
        """Return when the wall clock has reached simulated time ``t`` [s]; the first call only sets the start.

        ``meanwhile`` is called if there is time to spare, with how much [s], and should use less.
        """
        now = self._clock()
        if self._start is None:
            self._start = now - t / self.factor
            return
        self.waits += 1
        deadline = self._start + t / self.factor
        late = now - deadline
        if late < 0:
            if meanwhile is not None:
                meanwhile(-late)
                now = self._clock()
            if now < deadline:
                self._sleep(deadline - now)
                now = self._clock()
        elif late > 0:
            self.missed += 1
            self.worst_s = max(self.worst_s, late)
            excess = max(0.0, late - MAX_LAG_S)
            self.given_up_s += excess
            self._start += excess
        self._jitter[min(int((now - deadline) / JITTER_STEP_S), len(self._jitter) - 1)] += 1

    def jitter_s(self, share: float) -> float:
        """How long after its deadline the wait of all but ``1 - share`` was over at the latest [s], to 0.1 ms."""
        below = 0
        for k, count in enumerate(self._jitter):
            below += count
            if below >= share * self.waits:
                return (k + 1) * JITTER_STEP_S
        return 0.0

    def __str__(self) -> str:
        return (
            f"real time: {self.missed} of {self.waits} deadlines missed, at worst by {self.worst_s:.2g} s; "
            f"{self.given_up_s:.2g} s not made good"
        )
