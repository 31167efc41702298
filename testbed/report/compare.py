"""Several runs or estimators on one page: their plots over each other, and a table of differences for each pair."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from testbed.report import interactive
from testbed.report.differences import Block, cells, with_cells
from testbed.report.interactive.contents import events
from testbed.report.page import render, script_of
from testbed.report.run import Run
from testbed.results import REPORT, held, require_none_but, write_result

if TYPE_CHECKING:
    from rich.table import Table

MOST_LINES = 12  # estimators whose plots are told apart


def console_table(block: Block) -> Table:
    """The same for the console."""
    from rich.markup import escape
    from rich.table import Table

    table = Table(
        title=escape(f"{block.second} against {block.first}"), title_justify="left", caption=escape(block.note)
    )
    for k, name in enumerate(map(escape, block.head)):
        table.add_column(name, justify="left" if k in (0, 4) else "right", overflow="fold")
    for row in block.rows:
        table.add_row(*map(escape, cells(row)), style="bold" if row.significant else None)
    return table


def write_comparison(
    found: Sequence[Block], runs: Mapping[str, Run], folder: Path, title: str, force: bool = False
) -> Path:
    """Write ``report.html`` with the plots of these runs, by their names, and the tables of differences.

    Raises UserError when the folder can't be written, has the results of another command, or, without ``force``, holds
    a page that no earlier command made.
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
        "blocks": with_cells(found),
        "left_out": [one.name for one in shown if one not in kept],
        "events": [(t, f"{t:.1f} s", how, what) for t, how, what in events(kept[0].run)],
    }
    with held(folder):
        require_none_but(folder)
        write_result(folder / REPORT, render("compare.html", **values).encode(), force)
    return folder / REPORT
