"""How far something long has come, and how long it will take: a bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import math
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeAlias

from rich.progress import BarColumn, Progress, TextColumn

from testbed.errors import printable

if TYPE_CHECKING:
    from rich.console import Console

    from testbed.loop import links

PLAIN_LINES = 10  # for the whole
PLAIN_EVERY_S = 5.0  # wall time
PACE_S = 5.0  # wall time of work before it is said how long the rest will take

Tell: TypeAlias = Callable[[float, str], None]


@contextmanager
def shown(console: Console, title: str) -> Iterator[Tell]:
    """A function to be told the fraction done and what is going on, shown on ``console`` while the context lasts."""
    pace = _Pace()
    if not console.is_terminal:
        yield _plain(console, pace)
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.fields[text]}", markup=False),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(printable(title), total=1.0, text="starting; the first time, kernels are compiled")
        yield lambda fraction, text: bar.update(task, completed=fraction, text=pace.with_remaining(fraction, text))


def say(text: str) -> None:
    """One line on stderr for whoever reads along, above what is shown there of how far it is."""
    print(printable(text), file=sys.stderr)


class _Pace:
    """How long the rest will take, if it goes on as in the latter half of the time since the first of it was done.

    To start and to compile is once, and soon forgotten so.
    """

    def __init__(self) -> None:
        self._told: deque[tuple[float, float]] = deque()  # wall times, and the fractions that were done then
        self._began = 0.0, math.inf  # wall time when no more was done than at first, and the fraction then

    def with_remaining(self, fraction: float, text: str) -> str:
        """The text, and how long it will take, once that can be said."""
        now = time.monotonic()
        if fraction <= self._began[1]:
            self._began = now, fraction
            self._told.clear()
        self._told.append((now, fraction))
        elapsed = now - self._began[0]
        while self._told[0][0] < now - elapsed / 2:
            self._told.popleft()
        done = fraction - self._told[0][1]
        if elapsed < PACE_S or done <= 0 or fraction >= 1.0:
            return text
        return f"{text}  {_about((now - self._told[0][0]) / done * (1.0 - fraction))} to go"


def _about(seconds: float) -> str:
    """A time to come, in the unit that it is told in."""
    for unit, size in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * size:
            return f"about {seconds / size:,.0f} {unit}"
    return f"about {seconds:.0f} s"


def _plain(console: Console, pace: _Pace) -> Tell:
    shown = 0
    last_line = time.monotonic()

    def tell(fraction: float, text: str) -> None:
        nonlocal shown, last_line
        text = pace.with_remaining(fraction, text)
        reached = int(fraction * PLAIN_LINES + 1e-9)  # a tenth of the whole is none in binary
        if reached <= shown and time.monotonic() - last_line < PLAIN_EVERY_S:
            return
        shown = reached
        last_line = time.monotonic()
        console.print(f"{100.0 * fraction:3.0f} %  {text}", markup=False, highlight=False, soft_wrap=True)

    return tell


def of_run(now: links.Progress) -> tuple[float, str]:
    """The fraction of a run that is done; simulated time, real-time factor and what is going on."""
    factor = f"{now.realtime_factor:.3g} × real time"
    return now.t / now.duration, f"{_clock(now.t)} of {_clock(now.duration)}  {factor}  {now.activity}"


def _clock(seconds: float) -> str:
    """Minutes and seconds, with hours where there are any."""
    minutes, s = divmod(int(seconds), 60)
    hours, m = divmod(minutes, 60)
    return f"{hours}:{m:02d}:{s:02d}" if hours else f"{m:02d}:{s:02d}"
