"""What a page shows of one run or of several: who, when, what happened, panels over time, and a map."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from testbed.report import style
from testbed.report.figures.consistency import OUTCOMES
from testbed.report.interactive.arrays import Arrays
from testbed.report.interactive.panels import Subject, chapters
from testbed.report.interactive.place import place
from testbed.report.run import Run
from testbed.score.accuracy import column


def over_time(axis: str, reach: tuple[float, float], subjects: Sequence[str], band: str | None) -> dict[str, Any]:
    """Contents of a page that shows no run, but ``subjects`` over an ``axis`` from and to the ends of its ``reach``.

    ``band`` is what bands are called, if there are any. Chapters and numbers are to be added.
    """
    shown = {"axis": axis, "start": reach[0], "end": reach[1], "band": band, "reference": None, "map": None}
    lists: dict[str, list[Any]] = {key: [] for key in ("windows", "faults", "events", "outcomes")}
    return shown | lists | {"subjects": [looks(name, k) for k, name in enumerate(subjects)]}


@dataclass(frozen=True, slots=True)
class Shown:
    """A run on a page, and what it is called there: nothing where it is the only one."""

    name: str
    run: Run

    def called(self, what: str) -> str:
        """Something of this run, such as an estimator."""
        return f"{self.name}: {what}" if self.name else what


def contents(runs: Sequence[Shown]) -> dict[str, Any]:
    """Plain data of all that is drawn, for `script`. Runs share one axis of time, and events are of the first alone."""
    every = [(one, name) for one in runs for name in one.run.errors]
    known = [(k, one, name) for k, (one, name) in enumerate(every) if name in one.run.aligned]
    subjects = [Subject(at, k, one.called(name), one.run, name) for at, (k, one, name) in enumerate(known)]
    truths = [(one.called(one.run.reference), one.run) for one in runs]
    arrays = Arrays(len(subjects) + len(truths) // 2)
    start = min(float(one.run.t[0]) for one in runs)
    end = max(float(one.run.t[-1]) for one in runs)
    shown = {
        "start": start,
        "end": max(end, start + 1e-3),
        "subjects": [looks(subject.name, subject.line) for subject in subjects],
        "reference": runs[0].run.reference,
        "band": "±3 σ",
        "axis": "time [s]",
        "windows": _windows(runs, end),
        "faults": _faults(runs, end),
        "events": _events(runs[0].run),
        "outcomes": [{"name": name, "light": light, "dark": dark} for name, light, dark in outcomes()],
        "chapters": chapters(subjects, truths, arrays),
        "map": place(subjects, truths, arrays),
    }
    return shown | {"numbers": arrays.text()}


def outcomes() -> list[tuple[str, str, str]]:
    """What may become of a sample that is not used, and its colours on light and dark ground, as in `NOT_USED`."""
    return [(OUTCOMES[one], colour, style.NOT_USED_ON_DARK[one]) for one, colour in style.NOT_USED.items()]


def looks(name: str, line: int) -> dict[str, Any]:
    """What the legend switches, and how its lines look, by its number among all that have lines."""
    colour, dash = style.line_of(line).values()
    dark = style.ON_DARK[line % len(style.ON_DARK)]
    return {"name": name, "light": colour, "dark": dark, "dash": style.DASHES.index(dash)}


def _windows(runs: Sequence[Shown], end: float) -> list[list[float]]:
    """Windows in which no receiver of a run has a fix, each once."""
    found = {(start, min(stop, end)) for one in runs for start, stop in one.run.windows if start < end}
    return [list(window) for window in sorted(found)]


def _faults(runs: Sequence[Shown], end: float) -> list[dict[str, Any]]:
    found = {
        (fault.start, min(fault.end, end), fault.sensor, f"{fault.name}: {fault}")
        for one in runs
        for fault in one.run.faults
        if fault.start < end
    }
    return [dict(zip(("start", "end", "sensor", "text"), fault, strict=True)) for fault in sorted(found)]


def _events(run: Run) -> list[dict[str, Any]]:
    return [{"t": t, "severity": severity, "text": text} for t, severity, text in events(run)]


def events(run: Run) -> list[tuple[float, str, str]]:
    """When [s], how grave and what, of everything that was told during a run."""
    if not run.has("events"):
        return []
    when, severity, text = (
        np.atleast_1d(column(run.dataset, f"events/{name}")) for name in ("time", "severity", "text")
    )
    rows = zip(when.tolist(), severity, text, strict=True)
    return [(t, str(how), str(what)) for t, how, what in rows if math.isfinite(t)]
