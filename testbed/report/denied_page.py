"""The page of the benchmark: its tables, and errors over the time without GNSS to look around in."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.report import interactive
from testbed.report.denied_figure import LEAST_M, curves
from testbed.report.page import render, script_of

if TYPE_CHECKING:
    from testbed.denied.benchmark import Result
    from testbed.denied.flight import Outcome
    from testbed.denied.table import Weather
    from testbed.report.interactive import Arrays

AXIS = "time without GNSS [s]"


def page(result: Result, tables: Mapping[str, Sequence[Sequence[str]]]) -> str:
    """One page that needs nothing else, with ``tables`` by their titles, the head first."""
    own = contents(result)
    title = f"Denied navigation: draw {result.plan.number}"
    return render("denied.html", title=title, tables=tables, contents=own, script=script_of(own))


def contents(result: Result) -> dict[str, Any]:
    """Plain data of it, for `interactive.script`; the legend switches grades of the IMU, and estimators if several."""
    table, names = result.plan.table, [one.name for one in result.plan.contestants]
    lanes = [(grade.name, name) for name in names for grade in table.grades]
    arrays = interactive.Arrays(len(lanes))
    chapters = [
        {
            "title": weather.title[:1].upper() + weather.title[1:],
            "note": "Over the draws. Full line: RMS; dashed: 95th percentile, and the bound of the RMS.",
            "panels": list(_panels(result, weather, lanes, arrays)),
        }
        for weather in table.weathers
    ]
    called = [grade if len(names) == 1 else f"{grade}, {name}" for grade, name in lanes]
    return interactive.over_time(AXIS, (0.0, float(max(table.marks_s))), called, None) | {
        "chapters": [chapter for chapter in chapters if chapter["panels"]],
        "numbers": arrays.text(),
    }


def _panels(
    result: Result, weather: Weather, lanes: Sequence[tuple[str, str]], arrays: Arrays
) -> Iterator[dict[str, Any]]:
    own = [one for one in result.outcomes if one.weather == weather.name]
    for aids in result.plan.table.aids if own else ():
        lines = [
            line for k, (grade, name) in enumerate(lanes) for line in _lines(own, k, (aids.name, grade, name), arrays)
        ]
        if lines:
            yield {"title": f"{aids.title}: horizontal error", "unit": "m", "lines": lines, "log": True}


def _lines(
    outcomes: Sequence[Outcome], of: int, lane: tuple[str, str, str], arrays: Arrays
) -> Iterator[dict[str, Any]]:
    for name, (t, values) in curves(outcomes, lane).items():
        if np.isfinite(values).any():
            line = arrays.line(t, np.maximum(values, LEAST_M / 10))
            yield {"of": of, "name": f"{lane[1]}: {name}", "dashed": name != "RMS", **line}
