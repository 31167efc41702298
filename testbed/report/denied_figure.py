"""The figure of the benchmark: horizontal error over the time without GNSS, a panel a weather and set of aids."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from nav.samples import Array
from testbed.report import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    from testbed.denied.benchmark import Result
    from testbed.denied.flight import Outcome

LEAST_M = 0.3  # of the axis: a shorter error is no outage's
LINES: Mapping[str, dict[str, Any]] = {
    "RMS": {"lw": 1.6},
    "95 %": {"lw": 0.8, "alpha": 0.7},
    "bound of the RMS": {"lw": 1.1, "ls": (0, (4, 1.5))},
}


def figures(result: Result) -> Mapping[str, Figure]:
    """One for each estimator, by file name."""
    return {f"denied_{one.name}.png": _figure(result, one.name) for one in result.plan.contestants}


def _figure(result: Result, estimator: str) -> Figure:
    """RMS, 95th percentile and the bound of every grade, over the time since GNSS was lost."""
    table = result.plan.table
    drawn = style.sheet(len(table.aids), len(table.weathers), height=1.9, gap=0.42)
    for column, weather in enumerate(table.weathers):
        own = [one for one in result.outcomes if one.weather == weather.name]
        for row, aids in enumerate(table.aids):
            ax = drawn.axes[row, column]
            ax.set_title(f"{aids.title}\n{weather.title}", loc="left", fontsize=8)
            for k, grade in enumerate(table.grades):
                _draw(ax, own, (aids.name, grade.name, estimator), style.COLOURS[k])
    for row in drawn.axes:
        row[0].set_ylabel("horizontal error [m]")
        limits = np.array([ax.dataLim.intervaly for ax in row])
        limits = limits[np.isfinite(limits).all(axis=1)]
        for ax in row:
            ax.set_xlim(10.0, max(table.marks_s))
            for mark in table.marks_s:
                ax.axvline(mark, color=style.SHADE, lw=0.8, zorder=0)
            style.logarithmic(ax, along="x")
            if len(limits):
                ax.set_ylim(max(LEAST_M, limits[:, 0].min() / 1.3), limits[:, 1].max() * 1.3)
                style.logarithmic(ax)
    for ax in drawn.axes[-1]:
        ax.set_xlabel("time without GNSS [s]")
    drawn.legend(_keys(result), 0.45)
    return drawn.figure


def _keys(result: Result) -> dict[str, Line2D]:
    """A colour for each grade, a line for each quantity."""
    from matplotlib.lines import Line2D

    colours = {grade.name: {"color": style.COLOURS[k], "lw": 4.0} for k, grade in enumerate(result.plan.table.grades)}
    lines = {name: {"color": style.GUIDE, **line} for name, line in LINES.items()}
    return {name: Line2D([], [], **look) for name, look in (colours | lines).items()}


def curves(outcomes: Sequence[Outcome], lane: tuple[str, str, str]) -> dict[str, tuple[Array, Array]]:
    """Times [s] and horizontal errors [m] of one estimator in one case, by `LINES`; without an estimate, a gap."""
    k, since = outcomes[0].lanes.index(lane), outcomes[0].t > 0
    error = np.array([one.horizontal[k] for one in outcomes])[:, since]
    bound = np.array([one.bound[k] for one in outcomes])[:, since]
    error = np.where(np.isfinite(error), error, np.nan)
    found = (_rms(error), np.quantile(error, 0.95, axis=0, method="inverted_cdf"), _rms(bound))
    return {name: (outcomes[0].t[since], values) for name, values in zip(LINES, found, strict=True)}


def _draw(ax: Axes, outcomes: Sequence[Outcome], lane: tuple[str, str, str], colour: str) -> None:
    for name, (t, values) in curves(outcomes, lane).items() if outcomes else ():
        ax.plot(t, values, color=colour, **LINES[name])


def _rms(values: Array) -> Array:
    found: Array = np.sqrt(np.mean(values**2, axis=0))
    return found
