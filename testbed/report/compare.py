"""Several runs or estimators on one page: their plots over each other, and a table of differences for each pair."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from testbed.report import interactive, tables
from testbed.report.interactive.contents import events
from testbed.report.page import render, script_of
from testbed.report.run import Run
from testbed.results import REPORT, held, write_result
from testbed.score.differences import Case, Difference, differences, sides

if TYPE_CHECKING:
    from rich.table import Table

MOST_LINES = 12  # estimators whose plots are told apart
LABELS = dict((*tables.ROWS, *tables.OUTAGE_ROWS, *tables.RUN_ROWS))
METRICS = [name for key in LABELS for name in ([key, f"outage_{key}"] if key in dict(tables.ROWS) else [key])]
PLAIN = {
    True: "p: Wilcoxon's signed-rank test of the differences of runs with the same seed, two-sided, not corrected for"
    " the number of rows.",
    False: "p: Mann and Whitney's U test, as no two runs have the same seed, two-sided, not corrected for the number of"
    " rows.",
}
ALONE = (
    "No significance: one pair of runs can't tell a difference from chance, however long they are, as errors are"
    " correlated over minutes. Fly more seeds: six pairs are the fewest that can reach p < 0.05."
)
FEW = "Fewer than six pairs: p can't be below 0.05, whatever the difference."


@dataclass(frozen=True, slots=True)
class Block:
    """One table: what is held against what, its rows, and what their p is."""

    first: str
    second: str
    rows: Sequence[Difference]

    @property
    def head(self) -> tuple[str, ...]:
        """Names of the columns that `cells` has."""
        return "", self.first, self.second, "change", "", "runs", "p"

    @property
    def note(self) -> str:
        """Which statistic it is, or why there is none."""
        pairs = max(row.runs for row in self.rows)
        if pairs < 2:
            return ALONE
        paired = self.rows[0].paired
        return f"{PLAIN[paired]} {FEW}" if paired and pairs < 6 else PLAIN[paired]


def blocks(cases: Sequence[Case]) -> list[Block]:
    """The tables of differences, those without a row left out."""
    found = [Block(str(one), str(two), differences(one, two, METRICS)) for one, two in sides(cases)]
    return [block for block in found if block.rows]


def label(metric: str) -> str:
    """What tables call a metric."""
    name = metric.removeprefix("outage_")
    return LABELS[metric] if metric in LABELS else f"in the outage: {LABELS[name]}"


def cells(row: Difference) -> list[str]:
    """Label, both values, change, verdict, number of pairs or runs, and p."""
    change = f"{100 * (row.second / row.first - 1):+.1f} %" if row.first else "–"
    p = "–" if math.isnan(row.p) else f"{row.p:.2g}"
    return [label(row.metric), f"{row.first:.3g}", f"{row.second:.3g}", change, row.verdict, str(row.runs), p]


def console_table(block: Block) -> Table:
    """The same for the console."""
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=escape(f"{block.second} against {block.first}"), title_justify="left", caption=block.note)
    for k, name in enumerate(map(escape, block.head)):
        table.add_column(name, justify="left" if k in (0, 4) else "right", overflow="fold")
    for row in block.rows:
        table.add_row(*map(escape, cells(row)), style="bold" if row.significant else None)
    return table


def write_comparison(
    found: Sequence[Block], runs: Mapping[str, Run], folder: Path, title: str, force: bool = False
) -> Path:
    """Write ``report.html`` with the plots of these runs, by their names, and the tables of differences.

    Raises UserError when the folder can't be written or, without ``force``, holds a page that no earlier command made.
    """
    several = len(runs) > 1
    shown = [interactive.Shown(name if several else "", run) for name, run in runs.items()]
    kept: list[interactive.Shown] = []
    for one in shown:
        if not kept or sum(len(other.run.aligned) for other in [*kept, one]) <= MOST_LINES:
            kept.append(one)
    contents = interactive.contents(kept)
    values: dict[str, Any] = {
        "title": title,
        "contents": contents,
        "script": script_of(contents),
        "blocks": [(block, [(row, cells(row)) for row in block.rows]) for block in found],
        "left_out": [one.name for one in shown if one not in kept],
        "events": [(t, f"{t:.1f} s", how, what) for t, how, what in events(kept[0].run)],
    }
    with held(folder):
        write_result(folder / REPORT, render("compare.html", **values).encode(), force)
    return folder / REPORT
