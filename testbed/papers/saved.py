"""The table of the documentation, and the figures: what ``testbed papers --save`` writes into a checkout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

from testbed.data import data_dir, write_file
from testbed.errors import UserError
from testbed.papers import COLUMNS, Paper, counted, parted, row
from testbed.papers.claims import Claim
from testbed.papers.draws import Draws

TABLE = "papers-table.md"


def require_checkout(ids: Sequence[str]) -> None:
    """Raises UserError when there is no documentation to write to, or only some papers are asked for."""
    if ids:
        raise UserError("--save: the table has all papers: leave out " + ", ".join(ids))
    if not _docs().is_dir():
        raise UserError(f"{_docs()}: is missing: --save is for a checkout of the testbed")


def save(
    papers: Mapping[str, Paper], claims: Mapping[str, Sequence[Claim]], draws: Draws, figures: Path
) -> Path:  # fmt: skip
    """Write the table, and copy the ``figures`` of that folder beside the papers' scenarios; the table's file."""
    path = _docs() / TABLE
    write_file(path, page({paper.title: claims[name] for name, paper in papers.items()}, draws).encode())
    for paper in papers.values():
        for figure in paper.figures:
            write_file(data_dir("scenarios") / "papers" / figure, (figures / figure).read_bytes())
    return path


def page(claims: Mapping[str, Sequence[Claim]], draws: Draws) -> str:
    """Every claim of every paper, by title, in Markdown."""
    today = datetime.now(UTC).date()
    lines = [
        "# Claims and verdicts",
        "",
        f"Written by `testbed papers --save --draw {draws.number} --runs {draws.runs}` on {today}. {counted(claims)}.",
        "[Five papers](papers.md) says what each verdict means.",
    ]
    for title, every in claims.items():
        for heading, own in parted(title, every):
            lines += ["", f"## {heading}", "", _line(COLUMNS), _line(["---"] * len(COLUMNS))]
            lines += [_line(row(claim)) for claim in own]
    return "\n".join(lines) + "\n"


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _docs() -> Path:
    return data_dir("scenarios").parent / "docs"
