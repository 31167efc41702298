"""How far a run has come: a bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bar

if TYPE_CHECKING:
    from rich.console import Console

    from testbed.loop import Progress

PLAIN_EVERY_PERCENT = 10.0
PLAIN_EVERY_S = 5.0


@contextmanager
def shown(console: Console, title: str) -> Iterator[Callable[[Progress], None]]:
    """A function to be told of progress, shown on ``console`` as long as the context lasts."""
    if not console.is_terminal:
        yield _plain(console)
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[clock]}  {task.fields[factor]}  [cyan]{task.fields[activity]}"),
    )
    with Bar(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=None, clock="", factor="", activity="starting")

        def tell(now: Progress) -> None:
            bar.update(
                task,
                total=now.duration,
                completed=now.t,
                clock=f"{_clock(now.t)} of {_clock(now.duration)}",
                factor=_factor(now),
                activity=now.activity,
            )

        yield tell


def _plain(console: Console) -> Callable[[Progress], None]:
    next_percent = PLAIN_EVERY_PERCENT
    last_line = time.monotonic()

    def tell(now: Progress) -> None:
        nonlocal next_percent, last_line
        percent = 100.0 * now.t / now.duration
        if percent < next_percent and time.monotonic() - last_line < PLAIN_EVERY_S:
            return
        next_percent = (percent // PLAIN_EVERY_PERCENT + 1.0) * PLAIN_EVERY_PERCENT
        last_line = time.monotonic()
        line = f"{percent:3.0f} %  {_clock(now.t)} of {_clock(now.duration)}  {_factor(now)}  {now.activity}"
        console.print(line, markup=False, highlight=False, soft_wrap=True)

    return tell


def _clock(seconds: float) -> str:
    """Simulated time as minutes and seconds, with hours where there are any."""
    minutes, s = divmod(int(seconds), 60)
    hours, m = divmod(minutes, 60)
    return f"{hours}:{m:02d}:{s:02d}" if hours else f"{m:02d}:{s:02d}"


def _factor(now: Progress) -> str:
    return f"{now.realtime_factor:.3g} × real time"
