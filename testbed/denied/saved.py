"""The table of the manual, and its figure: what ``testbed denied --save`` writes into a checkout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from testbed.data import data_dir, docs_dir, write_file
from testbed.denied.benchmark import OURS, Result
from testbed.errors import UserError
from testbed.report import denied as report
from testbed.report.denied import Cell
from testbed.score.claims import Claim

PAGE, FIGURE = "denied-table.md", f"denied_{OURS}.png"


def require_checkout() -> None:
    """Raises UserError when there is no documentation to write to."""
    docs_dir()


def save(result: Result, cells: Sequence[Cell], claims: Mapping[str, Sequence[Claim]]) -> Path:
    """Write the page, and the figure beside the scenarios; the page's file.

    Raises UserError when a flight failed: its draw would be missing.
    """
    if result.failures:
        raise UserError(f"{result.plan.out}: {len(result.failures)} flights failed, so that nothing was saved")
    path = docs_dir() / PAGE
    write_file(path, report.page(result, cells, claims).encode())
    write_file(data_dir("scenarios") / FIGURE, (result.plan.out / FIGURE).read_bytes())
    return path
