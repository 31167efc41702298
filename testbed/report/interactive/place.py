"""The map, and errors with the ellipses that are claimed of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from nav.samples import Array, has_fix
from testbed.report.interactive.arrays import Arrays
from testbed.report.interactive.panels import Subject, Truths
from testbed.report.run import Run
from testbed.score.accuracy import column

POINTS = 2  # of a track, for each bin of a line
CONFIDENCE = 0.95  # of the ellipses


def place(subjects: Sequence[Subject], truths: Truths, arrays: Arrays) -> dict[str, Any] | None:
    """Tracks north and east of the first run's start [m], fixes, and errors with their covariance; None without any."""
    origin = truths[0][1]
    known = [_truth(name, run, origin, arrays) for name, run in truths]
    tracks = [_track(one, origin, arrays) for one in subjects if not one.errors.attitude_only]
    if not any(np.isfinite(run.truth("lat")).any() for _, run in truths) and not tracks:
        return None
    return {
        "truths": known,
        "tracks": tracks,
        "fixes": [_fixes(name, origin, arrays) for name in origin.receivers],
        "sigmas": float(np.sqrt(-2 * np.log(1 - CONFIDENCE))),  # of chi-square with two degrees of freedom
        "confidence": CONFIDENCE,
    }


def _metres(run: Run, origin: Run, group: str, rows: Any, arrays: Arrays) -> dict[str, Any]:
    places = 1000 * origin.track(*(column(run.dataset, f"{group}/{name}")[rows] for name in ("lat", "lon")))
    return {"n": arrays.add(places[:, 0]), "e": arrays.add(places[:, 1])}


def _truth(name: str, run: Run, origin: Run, arrays: Arrays) -> dict[str, Any]:
    rows = arrays.stride(len(run.t), POINTS * arrays.bins)
    return {"name": name, "t": arrays.add(run.t[rows]), **_metres(run, origin, "truth", rows, arrays)}


def _track(one: Subject, origin: Run, arrays: Arrays) -> dict[str, Any]:
    """Where one thought it was, how far that was off, and the horizontal part of the covariance that it claimed."""
    e = one.errors
    rows = arrays.stride(len(e.t), POINTS * arrays.bins)
    at = np.searchsorted(one.column("time"), e.t[rows] - 1e-6)
    covariance: Array = one.column("covariance")[at, :2, :2]
    return {
        "of": one.index,
        "t": arrays.add(e.t[rows]),
        **_metres(one.run, origin, f"estimators/{one.estimator}", at, arrays),
        "error": [arrays.add(e.position[rows, k]) for k in (0, 1)],
        "covariance": [arrays.add(covariance[:, i, k]) for i, k in ((0, 0), (0, 1), (1, 1))],
    }


def _fixes(name: str, run: Run, arrays: Arrays) -> dict[str, Any]:
    """Where a receiver said that it was."""
    group = f"sensors/{name}"
    rows = np.flatnonzero(has_fix(column(run.dataset, f"{group}/fix_type")))
    rows = rows[arrays.stride(len(rows))]
    return {
        "name": name,
        "t": arrays.add(column(run.dataset, f"{group}/time")[rows]),
        **_metres(run, run, group, rows, arrays),
    }
