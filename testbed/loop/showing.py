"""What links are shown: rows of the run gathered to stretches, with what became known by each."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from operator import itemgetter
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from nav.columns import Estimates, FusedReports, Reports, Samples
from nav.samples import ImuSamples, Sample, UpdateReport
from testbed.loop.links import Beside, Publisher, Stretch
from testbed.motion.table import COLUMNS, TruthBlock

# When it arrives, its number among all, and which it is of whose samples: most are never looked at.
Arrival: TypeAlias = tuple[float, int, Sequence[Sample], int]


class Arrivals:
    """Samples in the order of their arrival, however far ahead the sensors were computed."""

    def __init__(self) -> None:
        self._pending: list[Arrival] = []
        self._count = 0

    def add(self, samples: Sequence[Sample]) -> None:
        """Some more of them."""
        times = samples.t_arrival.tolist() if isinstance(samples, Samples) else [one.t_arrival for one in samples]
        self._pending += [(t, self._count + k, samples, k) for k, t in enumerate(times)]
        self._count += len(samples)

    def until(self, t: float) -> list[Arrival]:
        """Remove and give those that arrive up to ``t``."""
        self._pending.sort(key=itemgetter(0, 1))
        due = bisect_right(self._pending, t, key=itemgetter(0))
        arrived = self._pending[:due]
        del self._pending[:due]
        return arrived


class Waiting:
    """Reports that wait for their time, in their order: one that is due comes after those before it."""

    def __init__(self) -> None:
        self._pieces: deque[tuple[UpdateReport | FusedReports, list[float]]] = deque()  # with their times
        self._used = 0  # of the first piece

    def add(self, reports: Reports) -> None:
        """Some more of them."""
        for piece in reports.pieces:
            self._pieces.append((piece, piece.t.tolist() if isinstance(piece, FusedReports) else [piece.t]))

    def until(self, t: float) -> Iterator[tuple[UpdateReport | FusedReports, int, int]]:
        """Remove and give those on samples up to a time: of each piece from the first to before the last."""
        while self._pieces:
            (piece, times), first = self._pieces[0], self._used
            while self._used < len(times) and not times[self._used] > t:  # a time may be NaN
                self._used += 1
            last, ended = self._used, self._used == len(times)
            if ended:
                self._pieces.popleft()
                self._used = 0
            if last > first:
                yield piece, first, last
            if not ended:
                return


class Backlog:
    """Reports of one estimator that have not been looked at for events.

    ``behind`` [s] is how long after a sample it is used.
    """

    def __init__(self, behind: float) -> None:
        self._behind = behind
        self._votes: deque[UpdateReport] = deque()  # on redundant units
        self._unread = Waiting()  # on samples
        self._single = 0  # of these, so many that are not `FusedReports`
        self._passed = -math.inf  # up to when nobody asked for these, and no other was there

    def add(self, votes: Sequence[UpdateReport], reports: Reports) -> None:
        """Some more of them."""
        self._pass()
        self._votes.extend(votes)
        self._unread.add(reports)
        self._single += sum(isinstance(piece, UpdateReport) for piece in reports.pieces)

    @property
    def plain(self) -> bool:
        """Whether there are none but `FusedReports`."""
        return not self._single and not self._votes

    def skip(self, t: float) -> None:
        """Remove those that are there at ``t``, all of `FusedReports`."""
        self._passed = t - self._behind

    def until(self, t: float, fused: Callable[[], bool]) -> Iterator[UpdateReport]:
        """Remove and give those that are there at ``t``, of `FusedReports` only while these are asked for."""
        while self._votes and not self._votes[0].t > t:
            yield self._votes.popleft()
        if not self._single and not fused():
            self.skip(t)
            return
        self._pass()
        for piece, first, last in self._unread.until(t - self._behind):
            if not isinstance(piece, FusedReports):
                self._single -= 1
                yield piece
            elif fused():
                yield from piece[first:last]

    def _pass(self) -> None:
        """Remove those that nobody asked for."""
        for _ in self._unread.until(self._passed):
            pass


class Showing:
    """Hands ``links`` the rows of a run that are ``every`` ticks apart (0: none), some at once."""

    def __init__(self, links: Sequence[Publisher], every: int, behind: float) -> None:
        """``behind`` [s] is how long after a sample the shown estimator uses it."""
        self._links, self._every, self._behind = links, every, behind
        self._samples: list[Sample] = []  # that the links have not been given, nor the reports
        self._reports = Waiting()
        self._rows = range(0)  # of the turn, not handed out
        self._turn: tuple[int, TruthBlock, Estimates, ImuSamples, list[Beside]] | None = None

    def hear(self, arrived: Sequence[Arrival], reports: Reports) -> None:
        """Samples in the order of their arrival, and reports of the shown estimator."""
        if self._every:
            self._samples += [samples[k] for _, _, samples, k in arrived]
            self._reports.add(reports)

    def begin(
        self,
        tick: int,
        block: TruthBlock,
        shown: tuple[Mapping[int, int], Estimates, ImuSamples],
        others: Mapping[str, tuple[Mapping[int, int], Estimates]],
    ) -> None:
        """A turn that begins at a tick: where the estimates of which rows are, for each estimator."""
        if not self._every:
            return
        self._rows = range(-tick % self._every, len(block), self._every)
        at, estimates, increments = shown
        own = estimates[[at[row] for row in self._rows]]
        beside = [
            Beside(name, np.array([at.get(row, -1) for row in self._rows], int), found)
            for name, (at, found) in others.items()
        ]
        self._turn = tick, block, own, increments, beside

    def until(self, row: int) -> None:
        """Hand out those before this row of the turn."""
        rows = range(self._rows.start, min(row, self._rows.stop), self._every) if self._rows else self._rows
        if not len(rows) or self._turn is None:
            return
        tick, block, estimates, increments, others = self._turn
        first, last = len(estimates) - len(self._rows), len(estimates) - len(self._rows) + len(rows)
        self._rows = self._rows[len(rows) :]
        taken = slice(rows.start, rows[-1] + 1, self._every)
        truth = {name: getattr(block, name)[taken] for name in COLUMNS}
        stretch = Stretch(
            tick + np.arange(rows.start, rows[-1] + 1, self._every),
            truth,
            estimates[first:last],
            increments,
            [Beside(one.name, one.at[first:last], one.estimates) for one in others],
            self._arrived(truth["t"]),
            [*self._due(truth["t"] - self._behind)],
        )
        for link in self._links:
            link.publish(stretch)

    def _arrived(self, t: npt.NDArray[np.float64]) -> list[tuple[int, Sample]]:
        """The samples that have arrived by the rows at ``t``."""
        times = np.array([sample.t_arrival for sample in self._samples])
        rows = np.maximum.accumulate(np.searchsorted(t, times)) if len(times) else times.astype(int)
        count = int(np.searchsorted(rows, len(t)))
        arrived, self._samples = self._samples[:count], self._samples[count:]
        return list(zip(rows.tolist(), arrived, strict=False))

    def _due(self, t: npt.NDArray[np.float64]) -> Iterator[tuple[npt.NDArray[np.intp], UpdateReport | FusedReports]]:
        """The reports that are there by the rows at ``t``, less how long they take."""
        row = 0
        for piece, first, last in self._reports.until(float(t[-1])):
            times = piece.t[first:last] if isinstance(piece, FusedReports) else np.array([piece.t])
            rows = np.searchsorted(t, np.where(np.isnan(times), -np.inf, times))
            rows = np.maximum.accumulate(np.maximum(rows, row))
            row = int(rows[-1])
            yield rows, piece.part(first, last) if isinstance(piece, FusedReports) else piece
