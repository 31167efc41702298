"""``testbed compare``: runs beside each other."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from testbed.commands.shared import RUNS, Force, console, output_folder
from testbed.errors import UserError, printable
from testbed.results import METRICS, RECORD

if TYPE_CHECKING:
    import xarray

    from testbed.report.run import Run
    from testbed.score.differences import Case

Compared = Annotated[
    list[Path],
    typer.Argument(
        metavar="RUN...",
        help="Records, or folders: the runs in one are alike but for their seeds. The first is the base.",
    ),
]
Folder = Annotated[Path, typer.Option(metavar="DIR", help="Folder for report.html.")]


def compare(runs: Compared, out: Folder = RUNS / "compare", force: Force = False) -> None:
    """Show runs beside each other (builds, settings, seeds), or the estimators of one, and which differences count."""
    from testbed.report import compare as pages
    from testbed.report import differences

    found = [_case(path, name) for path, name in zip(runs, _names(runs), strict=True)]
    cases = [case for case, _ in found]
    blocks = differences.blocks(cases)
    if not blocks:
        raise UserError("there is nothing to compare: no two estimators have a metric in common")
    for block in blocks:
        console().print(pages.console_table(block))
    with output_folder(out):
        title = " and ".join(case.name for case in cases)
        page = pages.write_comparison(blocks, {case.name: run for case, run in found}, out, title, force)
    print(printable(f"report: {page}"))


def _names(paths: Sequence[Path]) -> list[str]:
    """What cases are called: by the last part of their paths that tells them apart."""
    folders = [path.parent if path.name == RECORD else path.with_suffix("") for path in map(Path.resolve, paths)]
    if len(set(folders)) < len(folders):
        raise UserError("a run is named twice: name each once")
    for count in range(1, max(len(folder.parts) for folder in folders) + 1):
        names = [printable("/".join(folder.parts[-count:])) for folder in folders]
        if len(set(names)) == len(names):
            break
    return names


def _case(path: Path, name: str) -> tuple[Case, Run]:
    """The runs of one argument, and the one with the least seed, which is shown."""
    from testbed.record.reader import load
    from testbed.report.run import Run
    from testbed.score import accuracy
    from testbed.score.differences import Case

    records = sorted(path.rglob(RECORD)) if path.is_dir() else [path]
    if not records:
        raise UserError(f"{path}: there is no {RECORD} in this folder: name a record, or a folder of some")
    loaded = [(int(dataset.attrs.get("seed", 0)), record, dataset) for record in records for dataset in [load(record)]]
    scored = [(seed, _metrics(record, dataset)) for seed, record, dataset in loaded]
    _, _, shown = min(loaded, key=lambda one: one[:2])
    ended = {one: why for _, _, dataset in loaded for one, why in accuracy.ended(dataset).items()}
    return Case(name, accuracy.names(shown), scored, ended), Run(shown)


def _metrics(record: Path, dataset: xarray.DataTree) -> dict[str, float]:
    """The metrics of a record: those beside it, or of one that stands alone computed."""
    from testbed.score import metrics

    beside = record.parent / METRICS
    if record.name != RECORD or not beside.is_file():
        return metrics.compute(dataset)
    try:
        return dict(json.loads(beside.read_text("utf-8")))
    except (OSError, ValueError) as error:
        raise UserError(
            f"{beside}: can't be read ({error}): `testbed report {record}` makes it when it is gone"
        ) from None
