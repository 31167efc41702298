"""Rows that a link is handed, a link that keeps them, and whether two records are the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from nav.columns import Estimates, FusedReports
from nav.samples import Estimate, ImuSamples, Sample, UpdateReport
from testbed.loop.links import Beside, Stretch
from testbed.loop.requests import Request
from testbed.motion.table import COLUMNS, TruthBlock


def one_row(
    truth: TruthBlock,
    estimate: Estimate,
    samples: Mapping[str, Sample],
    imu: ImuSamples | None,
    others: Sequence[tuple[str, Estimate]] = (),
    reports: Sequence[UpdateReport] = (),
) -> Stretch:
    """A row by itself, with what has become known by it."""
    return Stretch(
        np.array([truth.tick]),
        {name: getattr(truth, name) for name in COLUMNS},
        Estimates.of([estimate]),
        imu,
        [Beside(name, np.zeros(1, int), Estimates.of([one])) for name, one in others],
        [(0, sample) for sample in samples.values()],
        [(np.zeros(1, int), report) for report in reports],
    )


def joined(rows: Sequence[Stretch]) -> Stretch:
    """Rows that each are by themselves as one stretch, with the increments of the last."""
    beside = [
        Beside(
            one.name,
            np.arange(len(rows)),
            Estimates.of([row.others[k].estimates[0] for row in rows]),
        )
        for k, one in enumerate(rows[0].others)
    ]
    return Stretch(
        np.concatenate([row.ticks for row in rows]),
        {name: np.concatenate([row.truth[name] for row in rows]) for name in COLUMNS},
        Estimates.of([row.estimates[0] for row in rows]),
        rows[-1].imu,
        beside,
        [(k, sample) for k, row in enumerate(rows) for _, sample in row.samples],
        [(np.full(1, k), report) for k, row in enumerate(rows) for _, report in row.reports],
    )


class Watcher:
    """A link that keeps what it is handed."""

    period_s = 0.04
    others_every = 1
    asks = False

    def __init__(self) -> None:
        self.rows: list[float] = []
        self.gnss_age: list[float] = []
        self.events: list[tuple[float, str, str]] = []
        self.closed = False
        self.latest: dict[str, Sample] = {}

    def publish(self, rows: Stretch) -> None:
        t = rows.truth["t"]
        assert len(rows) == len(t) > 0
        assert rows.estimates.t == pytest.approx(t, abs=1e-9)
        assert rows.imu is not None
        # At the end of a run the next increment is still to come, and later than the last one was long: stamps jitter.
        assert len(rows.imu) == 0 or rows.imu.t[-1] >= t[-1] - 1.5 * rows.imu.dt[-1] - 1e-9
        assert [row for row, _ in rows.samples] == sorted(row for row, _ in rows.samples)
        for row, sample in rows.samples:
            assert sample.t_arrival <= t[row] + 1e-9
            assert row == 0 or sample.t_arrival > t[row - 1]
        due = np.concatenate([np.zeros(0, int), *(at for at, _ in rows.reports)])
        assert (np.diff(due) >= 0).all()
        for at, report in rows.reports:
            assert len(at) == (len(report) if isinstance(report, FusedReports) else 1)
            assert (report.t <= t[at]).all()
        for row in range(len(rows)):
            self.latest |= {sample.sensor: sample for at, sample in rows.samples if at == row}
            self.row(rows, row)

    def row(self, rows: Stretch, row: int) -> None:
        """One of them, after all samples that had arrived by it."""
        t = float(rows.truth["t"][row])
        if "gnss" in self.latest:
            self.gnss_age.append(t - self.latest["gnss"].t)
        self.rows.append(t)

    def requests(self) -> Sequence[Request]:
        return ()

    def settings(self, values: Mapping[str, float]) -> None:
        pass

    def event(self, t: float, severity: str, text: str) -> None:
        self.events.append((t, severity, text))

    def close(self) -> None:
        self.closed = True


def same(a: object, b: object) -> bool:
    """Whether two recorded datasets hold the same bits."""
    groups = {node.path: node for node in a.subtree}  # type: ignore[attr-defined]
    others = {node.path: node for node in b.subtree}  # type: ignore[attr-defined]
    if groups.keys() != others.keys():
        return False
    return all(
        np.array_equal(variable.values, others[path][name].values, equal_nan=variable.dtype.kind == "f")
        for path, node in groups.items()
        for name, variable in node.variables.items()
    )
