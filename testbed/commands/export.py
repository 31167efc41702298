"""``testbed export``: a record, or the plan of a scenario, in a form that other programs read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from testbed.commands.shared import Force, console
from testbed.errors import UserError, printable, unknown

Record = Annotated[
    Path | None,
    typer.Argument(metavar="RUN.nc|SCENARIO", help="The record of a run; for an autopilot's files a scenario, too."),
]
Form = Annotated[str | None, typer.Option(metavar="NAME", help="Which format: --list says which there are.")]
Target = Annotated[Path | None, typer.Option(metavar="PATH", help="Where to; beside the run file, or here.")]
Listing = Annotated[bool, typer.Option("--list", help="List the formats, what is in them, and who reads them.")]


def export(
    run_file: Record = None, format: Form = None, out: Target = None, listing: Listing = False, force: Force = False
) -> None:
    """Turn a run file into a form that other programs read; or write the mission and parameters of a scenario."""
    from testbed.bridges import files
    from testbed.exports import FORMATS
    from testbed.exports import export as write

    if listing:
        from rich.table import Table

        table = Table("format", "what is in it", "who reads it")
        for one in (*FORMATS.values(), *files.FILES.values()):
            needs = f" (needs the extra {one.extra})" if one.extra else ""
            table.add_row(one.name, one.holds + needs, one.readers)
        console().print(table)
        return
    if run_file is None or format is None:
        raise UserError("export: give a record and --format NAME: `testbed export --list` says which there are")
    if format not in FORMATS and format not in files.FILES:
        raise UserError(unknown("format", format, [*FORMATS, *files.FILES]))
    target = files.write(run_file, format, out, force) if format in files.FILES else write(run_file, format, out, force)
    print(printable(str(target)))
