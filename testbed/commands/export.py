"""``testbed export``: a record in a form that other programs read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from testbed.commands.shared import Force, console
from testbed.errors import UserError, printable

Record = Annotated[Path | None, typer.Argument(metavar="RUN.nc", help="The record of a run.")]
Form = Annotated[str | None, typer.Option(metavar="NAME", help="Which format: --list says which there are.")]
Target = Annotated[Path | None, typer.Option(metavar="PATH", help="Where to; beside the run file.")]
Listing = Annotated[bool, typer.Option("--list", help="List the formats, what is in them, and who reads them.")]


def export(
    run_file: Record = None, format: Form = None, out: Target = None, listing: Listing = False, force: Force = False
) -> None:
    """Turn a run file into a form that other programs read."""
    from testbed.exports import FORMATS
    from testbed.exports import export as write

    if listing:
        from rich.table import Table

        table = Table("format", "what is in it", "who reads it")
        for one in FORMATS.values():
            needs = f" (needs the extra {one.extra})" if one.extra else ""
            table.add_row(one.name, one.holds + needs, one.readers)
        console().print(table)
        return
    if run_file is None or format is None:
        raise UserError("export: give a record and --format NAME: `testbed export --list` says which there are")
    print(printable(str(write(run_file, format, out, force))))
