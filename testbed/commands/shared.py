"""What several commands need: where results go, what is said and shown, options of the same meaning."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from testbed.errors import UserError, printable

if TYPE_CHECKING:
    import xarray
    from rich.console import Console

EXIT_FAILED, EXIT_USER_ERROR = 1, 2  # and of an interrupt, 128 and the number of its signal
RUNS = Path("runs")
PIPE_COLUMNS = 120  # width of tables where the output is not a terminal

ScenarioName = Annotated[str, typer.Argument(metavar="SCENARIO", help="A scenario file, or a shipped one by name.")]
RunFile = Annotated[Path, typer.Argument(metavar="RUN.nc", help="The record of a run.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a key: sensors.gnss.denied=[[300,500]]; repeatable."),
]
Force = Annotated[bool, typer.Option("--force", help="Replace files of the same names that no earlier command made.")]


def remark(text: str) -> None:
    """One line for whoever reads along; what a file name may hold that a terminal would obey is escaped."""
    print(f"testbed: {printable(text)}", file=sys.stderr)


def console(stderr: bool = False) -> Console:
    """Where tables go: as wide as the terminal, or `PIPE_COLUMNS` where there is none."""
    from rich.console import Console

    console = Console(stderr=stderr)
    return console if console.is_terminal else Console(stderr=stderr, width=PIPE_COLUMNS)


@contextmanager
def output_folder(folder: Path) -> Iterator[None]:
    """Make a folder and see that it can be written; no empty one stays behind."""
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UserError(f"{folder}: can't be written: {error.strerror}: choose another folder with --out") from None
    try:
        yield
    finally:
        for path in made:
            with suppress(OSError):
                path.rmdir()


def conclude(dataset: xarray.DataTree, metrics: Mapping[str, float], run_file: Path, report: bool, force: bool) -> None:
    """The end of a run or report: tables, the page if a ``report`` is wanted, and where all is."""
    from testbed.report import page, tables

    console().print(tables.summary(metrics))
    faults = tables.fault_table(metrics)
    if faults is not None:
        console().print(faults)
    if report:
        written = page.write_report(dataset, metrics, run_file.parent, force)
        print(printable(f"report: {written}"))
    print(printable(f"record: {run_file}"))
