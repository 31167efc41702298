"""What the shown estimator has made of samples: how far they were off, and whom it has shut out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nav.columns import FusedReports
from nav.samples import Outcome, UpdateReport
from testbed.loop.events import REFUSALS


class ShutOut(NamedTuple):
    """The sensors that an estimator has isolated, and those whose samples it has refused `REFUSALS` times in a row."""

    isolated: frozenset[str]
    refused: frozenset[str]

    @property
    def sensors(self) -> frozenset[str]:
        """All of them: who is not believed."""
        return self.isolated | self.refused


NOBODY = ShutOut(frozenset(), frozenset())


class Verdicts:
    """Innovations over their gates by aid, and who is shut out, as reports have it so far."""

    def __init__(self) -> None:
        self._ratios: dict[str, float] = {}
        self._refused: dict[tuple[str, str], int] = {}  # samples in a row, by sensor and aid
        self._isolated: set[tuple[str, str]] = set()
        self._shut_out = NOBODY

    def read(
        self, reports: Sequence[tuple[npt.NDArray[np.intp], UpdateReport | FusedReports]], count: int
    ) -> tuple[Mapping[str, tuple[Sequence[int], Sequence[float]]], Sequence[ShutOut]]:
        """Reports of ``count`` rows, each after its row: from which rows on which ratio is the newest of an aid, -1
        being before the first; and who is shut out in each row, the same object until that changes.
        """
        ratios = {aid: ([-1], [ratio]) for aid, ratio in self._ratios.items()}
        shut_out: list[ShutOut] = []
        for rows, piece in reports:
            if isinstance(piece, FusedReports):
                self._fused(rows, piece, ratios, shut_out)
            else:
                _add(ratios, piece.aid, rows, np.array([piece.nis]) / piece.threshold)
                if self._judged(piece):
                    self._tell(int(rows[0]), shut_out)
        shut_out += [self._shut_out] * (count - len(shut_out))
        self._ratios = {aid: values[-1] for aid, (_, values) in ratios.items()}
        return ratios, shut_out

    def _fused(
        self,
        rows: npt.NDArray[np.intp],
        piece: FusedReports,
        ratios: dict[str, tuple[list[int], list[float]]],
        shut_out: list[ShutOut],
    ) -> None:
        """Samples that were fused: their sensors are let in again, each from its first on."""
        ratio = piece.nis / piece.threshold
        aids = [aid for _, aid, _ in piece.kinds]
        first_of = np.array([aids.index(aid) for aid in aids])[piece.kind]  # two sensors may have the same aid
        for number in dict.fromkeys(first_of.tolist()):
            own = first_of == number
            _add(ratios, aids[number], rows[own], ratio[own])
        if self._isolated or self._refused:
            kinds, firsts = np.unique(piece.kind, return_index=True)
            for first, kind in sorted(zip(firsts.tolist(), kinds.tolist(), strict=True)):
                part = piece.kinds[kind][:2]
                if part in self._isolated or part in self._refused:
                    self._isolated.discard(part)
                    self._refused.pop(part, None)
                    self._tell(int(rows[first]), shut_out)

    def _judged(self, report: UpdateReport) -> bool:
        """Take one report; whether this may change who is shut out."""
        part = report.sensor, report.aid
        before = part in self._isolated, self._refused.get(part, 0)
        if report.outcome is Outcome.ISOLATED:
            self._isolated.add(part)
        else:
            self._isolated.discard(part)
        if _is_refused(report):
            self._refused[part] = self._refused.get(part, 0) + 1
        elif report.weight > 0:
            self._refused.pop(part, None)
        return before != (part in self._isolated, self._refused.get(part, 0))

    def _tell(self, row: int, shut_out: list[ShutOut]) -> None:
        """From this row on it is as it is now."""
        now = ShutOut(
            frozenset(sensor for sensor, _ in self._isolated),
            frozenset(sensor for (sensor, _), count in self._refused.items() if count >= REFUSALS),
        )
        if now != self._shut_out:
            shut_out += [self._shut_out] * (row - len(shut_out))
            self._shut_out = now


def _is_refused(report: UpdateReport) -> bool:
    """Whether a sample is not believed: outside the gate, or saying that it is out of range, and off by more than that.

    So does a pitot tube that is blocked in flight; one that stands is out of range, and right.
    """
    out_of_range = report.outcome is Outcome.OUT_OF_RANGE
    return report.outcome is Outcome.OUTSIDE_GATE or (out_of_range and report.nis > report.threshold)


def _add(
    ratios: dict[str, tuple[list[int], list[float]]],
    aid: str,
    rows: npt.NDArray[np.intp],
    squared: npt.NDArray[np.float64],
) -> None:
    """Further ratios of an aid, from their squares, NaN where one is negative."""
    if len(rows):
        at, values = ratios.setdefault(aid, ([], []))
        at += rows.tolist()
        values += np.sqrt(np.where(squared >= 0, squared, math.nan)).tolist()
