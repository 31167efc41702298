"""The table of the documentation, and the figures: what ``testbed papers --save`` writes into a checkout."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

from testbed.data import data_dir, docs_dir, write_file
from testbed.errors import UserError
from testbed.papers import COLUMNS, RESULTS, Records, counted, find, parted, row, stored
from testbed.papers.draws import Draws
from testbed.report import markdown
from testbed.results import REPORT, write_result

TABLE = "papers-table.md"


def require_checkout() -> None:
    """Raises UserError when there is no documentation to write to."""
    docs_dir()


def save(folder: Path) -> Path:
    """Write the table of what that ``folder`` has of all papers, and copy its figures beside their scenarios.

    Returns the table's file. Raises UserError when a paper has not been judged there with the same draws as the others.
    """
    papers = find([])
    draws, found = stored(folder / RESULTS) or (Draws(0), {})
    missing = [name for name in papers if name not in found]
    if missing:
        raise UserError(
            f"{folder / RESULTS}: {', '.join(missing)} not judged yet: testbed papers {' '.join(missing)} --draw"
            f" {draws.number} --runs {draws.runs} --save"
        )
    path = docs_dir() / TABLE
    write_file(path, page({paper.title: found[name] for name, paper in papers.items()}, draws).encode())
    for paper in papers.values():
        for figure in paper.figures:
            write_file(data_dir("scenarios") / "papers" / figure, (folder / figure).read_bytes())
    return path


def show(folder: Path) -> Path:
    """Write the page on what that ``folder`` has of the papers; its file."""
    from testbed.papers import page as pages  # pages take a while to import
    from testbed.report.page import Shown

    draws, found = stored(folder / RESULTS) or (Draws(0), {})
    papers = find(list(found))
    pictures = [
        Shown("Figures", paper.title, (folder / figure).read_bytes())
        for paper in papers.values() for figure in paper.figures if (folder / figure).exists()
    ]  # fmt: skip
    text = pages.page({paper.title: found[name] for name, paper in papers.items()}, draws, pictures)
    write_result(folder / REPORT, text.encode())
    return folder / REPORT


def page(found: Mapping[str, Records], draws: Draws) -> str:
    """Every claim of every paper, by title, in Markdown."""
    today = datetime.now(UTC).date()
    lines = [
        "# Claims and verdicts",
        "",
        f"Written by `testbed papers --save --draw {draws.number} --runs {draws.runs}` on {today}. {counted(found)}.",
        "[Five papers](papers.md) says what each verdict means.",
    ]
    for title, records in found.items():
        for heading, own in parted(title, records):
            lines += ["", f"## {heading}", "", *markdown.table(COLUMNS, map(row, own))]
    return "\n".join(lines) + "\n"
