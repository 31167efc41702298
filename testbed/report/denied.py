"""The benchmark of denied navigation on paper: statistics of every case, files, tables, the page of the manual.

Intervals are at 95 %: of median and 95th percentile by order statistics, of shares Clopper and Pearson's, of RMS over
bound Student's, of its logarithm (`testbed.score.claims`).
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from nav.samples import Array
from testbed.report import denied_page, markdown
from testbed.report.denied_figure import figures
from testbed.report.page import png
from testbed.results import DENIED, REPORT, write_result
from testbed.score.claims import MEDIAN, NEARLY_ALL, RMS_OVER_BOUND, SHARE, Claim, Interval, Verdict

if TYPE_CHECKING:
    from rich.table import Table

    from testbed.denied.benchmark import Result
    from testbed.denied.table import Weather

SUMMARY, DRAWS = DENIED, "denied.csv"
ELLIPSE = -2 * math.log(0.05)  # of chi-square with two degrees of freedom, 95 %
COLUMNS = ("aids", "IMU", "after", "median [m]", "95 % [m]", "in its ellipse", "RMS / bound")
GOAL_COLUMNS = ("goal", "found, with its 95 % interval", "statistic", "bound", "verdict")
COLOURS = {Verdict.MET: "green", Verdict.MISSED: "red", Verdict.OPEN: "yellow"}


@dataclass(frozen=True, slots=True)
class Cell:
    """One estimator in one case, ``after_s`` without GNSS, over ``draws``: horizontal errors [m].

    ``inside`` is the share of draws in which the error lies in the ellipse that the estimator claims to hold 95 %, None
    where it never claims one; ``bound`` and ``efficiency``, RMS over bound, are None where there is no bound.
    """

    weather: str
    aids: str
    grade: str
    estimator: str
    after_s: int
    draws: int
    median: Interval
    p95: Interval
    inside: Interval | None
    rms: float
    bound: float | None
    efficiency: Interval | None


def cells(result: Result) -> list[Cell]:
    """Every cell of the table, in its order."""
    found = []
    for weather in result.plan.table.weathers:
        own = [one for one in result.outcomes if one.weather == weather.name]
        if own:
            then = result.at(weather.name)
            for k, lane in enumerate(own[0].lanes):
                for i, mark in enumerate(result.plan.table.marks_s):
                    columns = (then.horizontal[:, k, i], then.normalised[:, k, i], then.bound[:, k, i])
                    found.append(_cell((weather.name, *lane, mark), *columns))
    return found


def _cell(of: tuple[str, str, str, str, int], error: Array, squared: Array, bound: Array) -> Cell:
    """One cell of the figures of all its draws."""
    bounded = bool(np.isfinite(bound).all())
    return Cell(
        *of, len(error),
        median=_length(MEDIAN.of(error)), p95=_length(NEARLY_ALL.of(error)),
        inside=None if np.isnan(squared).all() else SHARE.of((squared <= ELLIPSE).astype(float)),
        rms=float(np.sqrt(np.mean(error**2))),
        bound=float(np.sqrt(np.mean(bound**2))) if bounded else None,
        efficiency=RMS_OVER_BOUND.of(np.column_stack([error, bound])) if bounded else None,
    )  # fmt: skip


def _length(interval: Interval) -> Interval:
    """No length is below zero, however few draws there are."""
    return interval._replace(low=max(interval.low, 0.0))


# --- files


def save(result: Result, claims: Mapping[str, Sequence[Claim]]) -> list[Cell]:
    """Write `SUMMARY` (all cells and goals), `DRAWS` (a line a draw of each cell), figures and the page; the cells."""
    found, out = cells(result), result.plan.out
    write_result(out / SUMMARY, (json.dumps(_json(result, found, claims), indent=1) + "\n").encode())
    write_result(out / DRAWS, _csv(result).encode())
    for name, figure in figures(result).items():
        write_result(out / name, png(figure))
    if result.outcomes:
        goals = [GOAL_COLUMNS, *(row for row, _ in _goal_rows(claims))]
        told = {"Goals: consumer IMU, walking wind": goals} if len(goals) > 1 else {}
        for weather in result.plan.table.weathers:
            told[_heading(result, weather)] = [COLUMNS, *_rows(result, found, weather.name)]
        write_result(out / REPORT, denied_page.page(result, told).encode())
    return found


def _json(result: Result, found: Sequence[Cell], claims: Mapping[str, Sequence[Claim]]) -> dict[str, Any]:
    return {
        "draw": result.plan.number,
        "draws": len(result.plan.seeds),
        "cells": [
            {
                "weather": cell.weather, "aids": cell.aids, "grade": cell.grade, "estimator": cell.estimator,
                "after_s": cell.after_s, "draws": cell.draws, "median_m": _pair(cell.median), "p95_m": _pair(cell.p95),
                "inside_95_ellipse": _pair(cell.inside), "rms_m": _finite(cell.rms), "bound_rms_m": cell.bound,
                "rms_over_bound": _pair(cell.efficiency),
            }
            for cell in found
        ],
        "goals": {name: [_plain(claim) for claim in own] for name, own in claims.items()},
        "failures": [failure._asdict() for failure in result.failures],
        "ended": [
            {"weather": one.weather, "seed": one.seed, "lane": lane, "why": why}
            for one in (*result.outcomes, *result.further) for lane, why in one.ended.items()
        ],
    }  # fmt: skip


def _plain(claim: Claim) -> dict[str, Any]:
    return {key: value for key, value in claim.record().items() if key not in ("paper", "best possible")}


def _pair(interval: Interval | None) -> dict[str, Any] | None:
    if interval is None:
        return None
    return {"value": _finite(interval.value), "interval": [_finite(interval.low), _finite(interval.high)]}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _csv(result: Result) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["weather", "aids", "grade", "estimator", "seed", "after_s", "north_m", "east_m", "variance_north_m2",
         "covariance_m2", "variance_east_m2", "bound_m", "distance_m"]
    )  # fmt: skip
    table = result.plan.table
    for one in (*result.outcomes, *result.further):
        for k, lane in enumerate(one.lanes):
            longer = table.judged_longest_s.get(lane[0])
            marks = (*table.marks_s, *([longer] if longer is not None and longer <= one.t[-1] else []))
            for mark in marks:
                row = int(np.searchsorted(one.t, mark - 1e-6))
                numbers = (*one.error[k, row], *one.covariance[k, row], one.bound[k, row], one.distance[k, row])
                writer.writerow(
                    [one.weather, *lane, one.seed, mark, *("" if np.isnan(x) else f"{x:.6g}" for x in numbers)]
                )
    return text.getvalue()


# --- tables


def _rows(result: Result, found: Sequence[Cell], weather: str) -> Iterator[tuple[str, ...]]:
    """The cells of one weather in `COLUMNS`, with the estimator behind the aids where there are several."""
    several = len(result.plan.contestants) > 1
    for cell in (cell for cell in found if cell.weather == weather):
        yield (
            cell.aids + (f", {cell.estimator}" if several else ""),
            cell.grade,
            f"{cell.after_s} s",
            str(cell.median),
            str(cell.p95),
            "–" if cell.inside is None else str(cell.inside),
            "–" if cell.efficiency is None else str(cell.efficiency),
        )


def _goal_rows(claims: Mapping[str, Sequence[Claim]]) -> Iterator[tuple[tuple[str, ...], Verdict]]:
    """The goals in `GOAL_COLUMNS`, with the estimator in front where there are several."""
    for name, own in claims.items():
        for claim in own:
            told = claim.record()
            quantity = f"{name}: {told['quantity']}" if len(claims) > 1 else told["quantity"]
            quantity += f" [{told['unit']}]" if told["unit"] else ""
            statistic = told["statistic"] if claim.draws == 1 else f"{told['statistic']} of {claim.draws}"
            yield (quantity, told["as text"], statistic, told["bound"], claim.verdict.value), claim.verdict


def tables(result: Result, found: Sequence[Cell], claims: Mapping[str, Sequence[Claim]]) -> Iterator[Table]:
    """For the console: a table for each weather, and one of the goals."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    for weather in result.plan.table.weathers:
        table = Table(title=_heading(result, weather), box=box.SIMPLE, title_justify="left")
        for k, name in enumerate(COLUMNS):
            table.add_column(escape(name), justify="left" if k < 2 else "right", overflow="fold")
        rows = list(_rows(result, found, weather.name))
        for row, following in zip(rows, [*rows[1:], ("",) * len(COLUMNS)], strict=True):
            table.add_row(*map(escape, row), end_section=row[:2] != following[:2])
        yield table
    goals = Table(*map(escape, GOAL_COLUMNS), title="Goals: consumer IMU, walking wind", title_justify="left")
    for row, verdict in _goal_rows(claims):
        goals.add_row(*map(escape, row[:-1]), f"[{COLOURS.get(verdict, 'cyan')}]{row[-1]}[/]")
    if goals.row_count:
        yield goals


def _heading(result: Result, weather: Weather) -> str:
    draws = sum(one.weather == weather.name for one in result.outcomes)
    return f"{weather.title[:1].upper()}{weather.title[1:]}: {draws} draws"


def page(result: Result, found: Sequence[Cell], claims: Mapping[str, Sequence[Claim]]) -> str:
    """The table and the goals for the manual, in Markdown."""
    today, plan = datetime.now(UTC).date(), result.plan
    lines = [
        "# The table of denied navigation",
        "",
        f"Written by `testbed denied --save --draw {plan.number} --draws {len(plan.seeds)}` on {today}, of"
        f" {len(plan.seeds)} draws, goals of {len(plan.seeds) + len(plan.further)}: an end of an interval that so few"
        " can't tell is infinite. [Denied navigation](denied.md) says what each row and column is.",
        "",
        "## Goals: consumer IMU, walking wind",
        "",
        *markdown.table(GOAL_COLUMNS, (row for row, _ in _goal_rows(claims))),
    ]
    for weather in plan.table.weathers:
        lines += ["", f"## {_heading(result, weather)}", ""]
        lines += markdown.table(COLUMNS, _rows(result, found, weather.name))
    return "\n".join(lines) + "\n"
