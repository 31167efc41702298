"""``testbed view``: the page of a run in the browser, also while the run goes on."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import Annotated

import typer

from testbed.errors import UserError, printable
from testbed.results import RECORD, REPORT

POLITE = 10  # what `nice` adds: the run goes first

Viewed = Annotated[Path, typer.Argument(metavar="RUN", help="A record, the folder that it is in, or a page.")]
AsItGoes = Annotated[bool, typer.Option("--live", help="Serve the page while the run goes on, to this machine alone.")]
Port = Annotated[int, typer.Option(metavar="N", min=0, max=65535, help="Of --live; 0 is any that is free.")]


def view(run: Viewed, live: AsItGoes = False, port: Port = 0) -> None:
    """Open the page of a run in the browser; with --live that of a run in progress, or of one yet to begin."""
    import webbrowser

    if live:
        return _live(run, port)
    if port:
        raise UserError("--port: a page that is a file has none: add --live, or leave it out")
    page = run if run.suffix == ".html" else (run if run.is_dir() else run.parent) / REPORT
    if not page.is_file():
        record = run if run.suffix == ".nc" else page.parent / RECORD
        raise UserError(f"{page}: no such file: `testbed report {shlex.quote(str(record))}` makes it")
    if not webbrowser.open(page.resolve().as_uri()):
        raise UserError(f"{page}: there is no browser to open it in here: open it in one")
    print(printable(f"report: {page}"))


def _live(run: Path, port: int) -> None:
    """Serve a run until an interrupt ends it."""
    import webbrowser

    from testbed.report.live import Live, served

    if run.suffix == ".html":
        raise UserError(f"{run}: a page stays as it is: name the record, or its folder, for --live")
    if hasattr(os, "nice"):
        os.nice(POLITE)
    watched = Live(run if run.suffix == ".nc" else run / RECORD)
    with served(watched, port) as url:
        print(printable(f"live: {url} shows {watched.record}; Ctrl-C ends it, and not the run"), flush=True)
        webbrowser.open(url)
        watched.follow()
