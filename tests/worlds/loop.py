"""A link that keeps what it is handed, and whether two records are the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from nav.samples import Estimate, ImuSamples, Sample, UpdateReport
from testbed.loop.requests import Request
from testbed.motion.table import TruthBlock


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

    def publish(
        self,
        truth: TruthBlock,
        estimate: Estimate,
        samples: Mapping[str, Sample],
        imu: ImuSamples | None,
        others: Sequence[tuple[str, Estimate]],
        reports: Sequence[UpdateReport],
    ) -> None:
        t = float(truth.t[0])
        assert len(truth) == 1
        assert estimate.t == pytest.approx(t, abs=1e-9)
        assert imu is not None
        assert len(imu) == 0 or imu.t[-1] >= t - imu.dt[-1] - 1e-9
        assert all(report.t <= t for report in reports)
        assert all(sample.t_arrival <= t + 1e-9 for sample in samples.values())
        if "gnss" in samples:
            self.gnss_age.append(t - samples["gnss"].t)
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
