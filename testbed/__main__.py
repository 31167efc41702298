"""Commands: ``testbed scenarios | aircraft | run | log | compare | view | check | report | export | campaign | …``.

Nothing heavy is imported before a command needs it, so that help and completion answer at once.
"""

from __future__ import annotations

import io
import math
import os
import re
import shlex
import sys
import tomllib
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated

from testbed import interrupts, threads

if sys.argv[0] == __file__ or Path(sys.argv[0]).name == "testbed":  # this is the program, and not a module of another
    interrupts.end_at_once()  # while all else is imported
    os.environ.update({name: value for name, value in threads.ONE.items() if name not in os.environ})

import typer

from testbed.commands.compare import compare
from testbed.commands.denied import denied
from testbed.commands.export import export
from testbed.commands.log import log
from testbed.commands.run import run
from testbed.commands.shared import (
    EXIT_FAILED,
    EXIT_USER_ERROR,
    RUNS,
    Force,
    Overrides,
    RunFile,
    ScenarioName,
    conclude,
    console,
    output_folder,
    remark,
)
from testbed.commands.view import view
from testbed.data import data_dir
from testbed.errors import UserError, printable
from testbed.results import METRICS, held, require_own

# Options that may stand alone: what their values look like, and which is meant without one.
ALONE = {
    "--realtime": (r"[-+]?(\d*\.?\d*(e[-+]?\d+)?|nan|inf)", "1"),
    "--px4": (r"\w+:.*", "tcpin:127.0.0.1:4560"),
    "--ardupilot": (r"\w+:.*", "udpin:127.0.0.1:9002"),
    "--gps-input": (r"\w+:.*", "udpin:127.0.0.1:14551"),
}

app = typer.Typer(
    help="Fly, sense, navigate: a navigation testbed coupled to a flight simulation.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def main() -> None:
    """Entry point: a user's mistake ends with its message and exit code 2, never with a traceback."""
    try:
        _main()
    except SystemExit as end:
        interrupts.wait_for_nobody(end.code)
        raise


def _main() -> None:
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal that is not UTF-8 lacks signs of ours
            stream.close = stream.flush  # type: ignore[method-assign]  # in code of the user's: we go on to speak
    try:
        with interrupts.heeded():
            app(_explicit(sys.argv[1:]))
    except UserError as error:
        for line in str(error).splitlines():
            remark(line)
        sys.exit(EXIT_USER_ERROR)
    except OSError as error:  # a full disk, a folder that went away
        remark(str(error))
        sys.exit(EXIT_USER_ERROR)


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="Print the version and leave.")] = False) -> None:
    if version:
        from importlib.metadata import version as installed

        print(f"testbed {installed('navigation-testbed')}")
        raise typer.Exit


@app.command()
def scenarios() -> None:
    """List the shipped scenarios."""
    from rich.table import Table

    table = Table("name", "title", "duration")
    for path in sorted(data_dir("scenarios").glob("*.toml")):
        try:
            head = tomllib.loads(path.read_text("utf-8"))
        except (OSError, ValueError) as error:
            raise UserError(f"{path}: {error}") from None
        table.add_row(path.stem, str(head.get("title")), f"{head.get('duration_s')} s")
    console().print(table)


@app.command()
def aircraft(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="A shipped aircraft, or the path of a folder.")
    ] = None,
) -> None:
    """List the shipped aircraft, or show the limits, trims and modes of one."""
    from testbed.report import aircraft as pages

    for table in [pages.listed()] if name is None else pages.tables(name):
        console().print(table)


app.command()(run)
app.command()(log)
app.command()(compare)
app.command()(view)


@app.command()
def check(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[SCENARIO...]", help="Scenario files or shipped names; all shipped.")
    ] = None,
    golden: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of golden metrics; tests/golden where there is one.")
    ] = None,
    update: Annotated[
        bool, typer.Option("--update", help="Write golden metrics anew where they have changed.")
    ] = False,
    junit: Annotated[Path | None, typer.Option(metavar="FILE", help="Write a JUnit report too.")] = None,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="Show the metrics that are as they should be too.")
    ] = False,
) -> None:
    """Fly scenarios side by side, and hold their metrics against [expect] and golden ones; exit code 1 on failure."""
    from testbed.data import write_file
    from testbed.many import check as checks
    from testbed.many import progress

    if junit is not None and not junit.parent.is_dir():
        raise UserError(f"--junit {junit}: there is no folder {junit.parent}: make it first")
    if junit is not None and junit.is_dir():
        raise UserError(f"--junit {junit}: is a folder: name the file in it")
    if junit is not None and junit.is_file() and not checks.is_junit(junit.read_bytes()):
        raise UserError(f"--junit {junit}: is there already, and is no report: give it another name")
    if junit is not None:
        junit.unlink(missing_ok=True)  # whatever ends this, it is not that of a run before
    folder = golden or (checks.GOLDEN if checks.GOLDEN.is_dir() else None)
    if folder is None and update:
        raise UserError(f"--update: there is no {checks.GOLDEN} here: say with --golden DIR where they go")
    if folder is not None and update:
        checks.make_folder(folder)
    todo = checks.tasks(names or checks.shipped(), RUNS / "check", folder, update)
    with (
        output_folder(RUNS / "check"),
        interrupts.leaving(lambda: "nothing was concluded"),
        progress.shown(console(stderr=True), "check") as tell,
    ):
        outcomes = checks.fly_all(todo, tell)
    if update and folder is not None:
        outcomes = checks.update(outcomes, folder)
    shown = checks.table(outcomes, verbose)
    if shown is not None:
        console().print(shown)
    for outcome in outcomes:
        print(outcome)
        print(outcome.failure, end="\n" if outcome.failure else "", file=sys.stderr)
    if folder is None:
        print(f"Only [expect] was checked: there is no {checks.GOLDEN} here. Give golden metrics with --golden DIR.")
    if junit is not None:
        write_file(junit, checks.junit(outcomes))
    if any(outcome.failed for outcome in outcomes):
        raise typer.Exit(EXIT_FAILED)


@app.command()
def report(run_file: RunFile, force: Force = False) -> None:
    """Write figures and report.html again from a run file, beside it."""
    from testbed.record.reader import load
    from testbed.score import accuracy, metrics
    from testbed.score.remarks import remarks

    dataset = load(run_file)
    try:
        computed = metrics.compute(dataset)
    except UserError as error:
        raise error.within(str(run_file)) from None
    for name, why in accuracy.ended(dataset).items():
        remark(f"{name} has ended: {why}")
    for text in remarks(dataset, computed):
        remark(text)
    kept = run_file.parent / METRICS
    with held(run_file.parent):
        if not kept.exists() or not dataset.attrs["complete"]:  # the run was killed, perhaps since they were written
            require_own(run_file.parent, [METRICS], force)
            metrics.save(computed, kept)
    conclude(dataset, computed, run_file, True, force)


app.command()(export)


@app.command()
def campaign(
    scenario: ScenarioName,
    runs: Annotated[int, typer.Option(metavar="N", min=1, help="How many seeds.")],
    vary: Annotated[
        list[str] | None, typer.Option(metavar="KEY=A,B,C", help="Repeat for each of these values; repeatable.")
    ] = None,
    overrides: Overrides = None,
    draw: Annotated[
        int, typer.Option(metavar="N", min=0, help="Seeds that no other draw has: 0, the scenario's, or 1, 2, ...")
    ] = 0,
    scheduler: Annotated[str | None, typer.Option(metavar="ADDRESS", help="An existing Dask cluster.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder; runs/<scenario>_campaign.")] = None,
    save: Annotated[bool, typer.Option("--save", help="Write how [expect] is kept into the documentation.")] = False,
) -> None:
    """Fly a scenario with many seeds."""
    from testbed.many import campaign as campaigns
    from testbed.many import progress
    from testbed.report import campaign as campaign_report
    from testbed.report import expected

    folder = out or campaigns.usual_folder(scenario, draw)
    plan = campaigns.Plan(scenario, runs, folder, parse_vary(vary or []), overrides or (), draw)
    if save:
        expected.require_shipped(plan)
    with (
        output_folder(folder),
        held(folder),
        interrupts.leaving(lambda: f"what is finished is in {folder}; the same command carries on"),
        progress.shown(console(stderr=True), scenario) as tell,
    ):
        result = campaigns.fly(plan, scheduler, lambda now: tell(now.fraction, str(now)), remark)
    for table in campaign_report.tables(result):
        console().print(table)
    print(printable(f"campaign: {folder}"))
    for text in result.spoilt():
        remark(text)
    for failure in result.failures:
        case = f"{result.combinations[failure.combination]} seed {failure.seed}".strip()
        remark(f"{case}: {failure.message}")
    if save:
        print(printable(str(expected.save(plan, result))))
    if result.failures:
        raise typer.Exit(EXIT_FAILED)


@app.command()
def papers(
    ids: Annotated[list[str] | None, typer.Argument(metavar="[ID...]", help="Which papers; all of them.")] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for papers.json and figures.")] = RUNS / "papers",
    draw: Annotated[
        int | None, typer.Option(metavar="N", min=0, help="Seeds that no other draw has; that of the documentation.")
    ] = None,
    runs: Annotated[int | None, typer.Option(metavar="N", min=2, help="Draws of each claim: 100.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Ten draws of each claim.")] = False,
    save: Annotated[bool, typer.Option("--save", help="Write table and figures into the documentation.")] = False,
) -> None:
    """Reproduce the papers: every claim beside what comes out here; exit code 1 if one is missed."""
    from testbed import papers as library
    from testbed.many import progress
    from testbed.papers import saved
    from testbed.papers.draws import draws
    from testbed.score.claims import Verdict

    found = library.find(ids or [])
    drawn = draws(library.RECORDED_DRAW if draw is None else draw, runs, quick)
    if save:
        saved.require_checkout()
    require_own(out, [library.RESULTS, *(figure for paper in found.values() for figure in paper.figures)])
    with (
        output_folder(out),
        held(out),
        interrupts.leaving(lambda: "nothing was written"),
        progress.shown(console(stderr=True), "papers") as tell,
    ):
        claims = library.reproduce(found, drawn, out, tell)
    records = {name: [claim.record() for claim in own] for name, own in claims.items()}
    for name, own in records.items():
        for table in library.tables(found[name].title, own):
            console().print(table)
    print(library.counted(records))
    print(printable(f"{saved.show(out)}, {library.RESULTS} and figures beside it"))
    if save:
        print(printable(str(saved.save(out))))
    if any(claim.verdict is Verdict.MISSED for own in claims.values() for claim in own if claim.paper):
        raise typer.Exit(EXIT_FAILED)


app.command()(denied)


@app.command()
def watch(
    source: Annotated[
        str, typer.Argument(metavar="URL|RUN.tlog", help="udpin:HOST:PORT, tcp:HOST:PORT, or a telemetry log.")
    ] = "udpin:127.0.0.1:14550",
    speed: Annotated[float, typer.Option(metavar="FACTOR", help="How fast a log is replayed.")] = 10,
) -> None:
    """Watch a run in the terminal: mode, leg, errors against sigma, sensors, detections. Ctrl-C ends it."""
    from testbed.mavlink.watch import watch as show

    if not (math.isfinite(speed) and speed > 0):
        raise UserError(f"--speed {speed:g}: the factor must be above 0, such as 10")
    show(source, console(), speed)


@app.command()
def init(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="A new folder, or an empty one.")],
) -> None:
    """Begin a project of your own: a flight, an estimator for it, and a test of both."""
    from testbed.data import make_project

    for path in make_project(folder):
        print(printable(str(path)))
    print(printable(f"Now: cd {shlex.quote(str(folder))} && testbed run first.toml"))


def parse_vary(texts: Sequence[str]) -> dict[str, list[str]]:
    """The varied keys of ``key=a,b,c`` texts; commas inside brackets, braces and quotes do not separate values.

    Raises UserError when a text has no key or lacks a value, or when a key comes twice.
    """
    varied: dict[str, list[str]] = {}
    for text in texts:
        key, _, listed = text.partition("=")
        values = [value.strip() for value in _split(listed)]
        if not key.strip() or not all(values):
            raise UserError(f"--vary {text}: give it as key=a,b,c, such as truth.wind.speed_mps=0,5,10")
        if key.strip() in varied:
            raise UserError(f"--vary {text}: {key.strip()} is varied twice: give all its values at once")
        varied[key.strip()] = values
    return varied


def _split(text: str) -> list[str]:
    parts, depth, quote = [""], 0, ""
    for character in text:
        if quote:
            quote = "" if character == quote else quote
        elif character in "\"'":
            quote = character
        else:
            depth += (character in "[{") - (character in "]}")
        if character == "," and not quote and depth == 0:
            parts.append("")
        else:
            parts[-1] += character
    return parts


def _explicit(arguments: Sequence[str]) -> list[str]:
    """Give an option that stands alone what it means: the option parser knows no optional values."""
    explicit = []
    for argument, following in pairwise([*arguments, ""]):
        explicit.append(argument)
        if argument in ALONE and not (following and re.fullmatch(ALONE[argument][0], following)):
            explicit.append(ALONE[argument][1])
    return explicit


if __name__ == "__main__":
    main()
