"""Whoever watches a run, and how all of them are told."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from nav.columns import Estimates, FusedReports
from nav.samples import Array, ImuSamples, Sample, UpdateReport
from testbed.errors import UserError
from testbed.estimators.section import EstimatorSection
from testbed.loop.requests import Request


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a run stands: simulated time and duration [s], simulated over wall time, what is going on."""

    t: float
    duration: float
    realtime_factor: float
    activity: str


@dataclass(frozen=True, slots=True)
class Beside:
    """An estimator beside the shown one: ``at`` (N,) says which of its estimates is of which row, -1 where none is."""

    name: str
    at: npt.NDArray[np.intp]
    estimates: Estimates


@dataclass(frozen=True, slots=True)
class Stretch:
    """N rows of a run, one after the other, and what became known by each.

    ``ticks`` (N,) are their numbers; ``truth`` are columns of `testbed.motion.table.COLUMNS` at them, ``estimates``
    those of the shown estimator, ``imu`` increments up to the last row or beyond. ``samples`` are those that arrived,
    in their order, and ``reports`` the shown estimator's updates, each after the number of the row by which it was
    there: for a stretch of reports (M,) of them.
    """

    ticks: npt.NDArray[np.int64]
    truth: Mapping[str, Array]
    estimates: Estimates
    imu: ImuSamples | None
    others: Sequence[Beside]
    samples: Sequence[tuple[int, Sample]]
    reports: Sequence[tuple[npt.NDArray[np.intp], UpdateReport | FusedReports]]

    def __len__(self) -> int:
        return len(self.ticks)


class Publisher(Protocol):
    """Whoever watches a run: handed rows of it that are ``period_s`` of simulated time apart.

    ``others_every`` says at which rows it looks at the estimators beside the shown one: the first and each so many.
    ``asks`` says whether it may ever ask for something; without, `requests` is not called.
    """

    period_s: float
    others_every: int
    asks: bool

    def publish(self, rows: Stretch) -> None:
        """The next rows, as many as are known: one when the run keeps to the clock, some seconds of it when not."""
        ...

    def requests(self) -> Sequence[Request]:
        """Answer what has come in since the last call, and hand over what is asked of the run; never waits.

        Called before every turn, and while the run is paused every 20 ms of wall time.
        """
        ...

    def settings(self, values: Mapping[str, float]) -> None:
        """The values in force of what may change (`testbed.loop.settings.settings`): first and at each change."""
        ...

    def event(self, t: float, severity: str, text: str) -> None:
        """Something happened at ``t``; severity is info, warning or error."""
        ...

    def close(self) -> None:
        """The run is over."""
        ...


def shown_estimator(estimators: Sequence[EstimatorSection], asked: str | None = None) -> str:
    """The estimator that links show: the one asked for, or the first. Raises UserError when there is none such."""
    names = [one.name for one in estimators]
    if not names:
        raise UserError("the scenario has no [[estimator]], so a link has nothing to show: add one, or leave it out")
    if asked is None:
        return names[0]
    if asked not in names:
        raise UserError(f"--estimator {asked}: the scenario has no such estimator: choose from {', '.join(names)}")
    return asked


@dataclass(slots=True)
class Listeners:
    """All that are told of a run: its ``links``, its record by ``write_event``, and who asked for progress."""

    links: Sequence[Publisher]
    progress: Callable[[Progress], None] | None
    duration_s: float
    write_event: Callable[[float, str, str], None]
    started: float = field(default_factory=time.perf_counter)  # wall time

    def emit(self, t: float, severity: str, text: str) -> None:
        """Tell and record an event."""
        self.write_event(t, severity, text)
        for link in self.links:
            link.event(t, severity, text)

    def say(self, t: float, severity: str, text: str) -> None:
        """Tell what is no part of the record: how the run is paced."""
        for link in self.links:
            link.event(t, severity, text)
        self.advance(t, text)

    def settings(self, values: Mapping[str, float]) -> None:
        """Tell the values in force of what may change."""
        for link in self.links:
            link.settings(values)

    def advance(self, t: float, activity: str) -> None:
        """Tell how far the run has come."""
        if self.progress is not None:
            factor = t / max(time.perf_counter() - self.started, 1e-9)
            self.progress(Progress(t, self.duration_s, factor, activity))
