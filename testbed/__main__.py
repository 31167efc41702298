"""Commands: ``testbed scenarios | aircraft | run | check | report | export | campaign | papers | watch | init``.

Nothing heavy is imported before a command needs it, so that help and completion answer at once.
"""

from __future__ import annotations

import json
import math
import shlex
import sys
import tempfile
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from enum import StrEnum
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from testbed import interrupts

if sys.argv[0] == __file__ or Path(sys.argv[0]).name == "testbed":  # this is the program, and not a module of another
    interrupts.end_at_once()  # while all else is imported

import typer

from testbed.data import data_dir
from testbed.errors import UserError, printable
from testbed.results import METRICS, RECORD, REPORT, held, require_own

if TYPE_CHECKING:
    import xarray
    from rich.console import Console

    from testbed.loop.links import Publisher
    from testbed.loop.loop import RunResult
    from testbed.loop.requests import Recorded
    from testbed.scenario import Scenario

EXIT_FAILED, EXIT_USER_ERROR = 1, 2  # and of an interrupt, 128 and the number of its signal
RUNS = Path("runs")
PIPE_COLUMNS = 120  # width of tables where the output is not a terminal


app = typer.Typer(
    help="Fly, sense, navigate: a navigation testbed coupled to a flight simulation.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

ScenarioName = Annotated[str, typer.Argument(metavar="SCENARIO", help="A scenario file, or a shipped one by name.")]
RunFile = Annotated[Path, typer.Argument(metavar="RUN.nc", help="The record of a run.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a key: sensors.gnss.denied=[[300,500]]; repeatable."),
]
Force = Annotated[bool, typer.Option("--force", help="Replace files of the same names that no earlier command made.")]


class ExportFormat(StrEnum):
    """What a run file can be turned into."""

    csv = "csv"
    mat = "mat"


def main() -> None:
    """Entry point: a user's mistake ends with its message and exit code 2, never with a traceback."""
    try:
        with interrupts.heeded():
            app(_explicit_realtime(sys.argv[1:]))
    except UserError as error:
        for line in str(error).splitlines():
            _remark(line)
        sys.exit(EXIT_USER_ERROR)
    except OSError as error:  # a full disk, a folder that went away
        _remark(str(error))
        sys.exit(EXIT_USER_ERROR)


def _remark(text: str) -> None:
    """One line for whoever reads along; what a file name may hold that a terminal would obey is escaped."""
    print(f"testbed: {printable(text)}", file=sys.stderr)


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
    _console().print(table)


@app.command()
def aircraft(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="A shipped aircraft, or the path of a folder.")
    ] = None,
) -> None:
    """List the shipped aircraft, or show the limits, trims and modes of one."""
    from testbed.report import aircraft as pages

    for table in [pages.listed()] if name is None else pages.tables(name):
        _console().print(table)


@app.command()
def run(
    scenario: Annotated[
        str,
        typer.Argument(
            metavar="SCENARIO|RUN.nc", help="A scenario file, a shipped one by name, or a record to be run again."
        ),
    ],
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for the results; runs/<scenario>.")] = None,
    seed: Annotated[
        int | None, typer.Option(metavar="N", min=0, max=2**63 - 1, help="In place of the scenario's seed.")
    ] = None,
    overrides: Overrides = None,
    mavlink: Annotated[
        list[str] | None,
        typer.Option(
            metavar="URL", help="To udpout, udpin, tcp or tcpin:HOST:PORT, serial:DEVICE, tlog:FILE; repeatable."
        ),
    ] = None,
    mavlink_identity: Annotated[
        str | None, typer.Option(metavar="NAME", help="Whose ways the vehicle has: px4, or ardupilot.")
    ] = None,
    mavlink_vehicles: Annotated[
        bool, typer.Option("--mavlink-vehicles", help="Show truth and the other estimators as vehicles of their own.")
    ] = False,
    mavlink_readonly: Annotated[
        bool, typer.Option("--mavlink-readonly", help="Let stations watch, but change nothing.")
    ] = False,
    mavlink_key: Annotated[
        str | None,
        typer.Option(metavar="KEY", help="Hear only what is signed with this passphrase or 64 hexadecimal digits."),
    ] = None,
    estimator: Annotated[
        str | None, typer.Option(metavar="NAME", help="Which estimator to stream; the scenario's first.")
    ] = None,
    realtime: Annotated[
        float | None, typer.Option(metavar="[FACTOR]", help="Run no faster than real time, or FACTOR times that.")
    ] = None,
    report: Annotated[bool, typer.Option("--report/--no-report", help="Write figures and report.html.")] = True,
    force: Force = False,
) -> None:
    """Fly one scenario: record, metrics, report. Exit code 1 if control was lost on the way.

    A record is run again with everything that was asked of it, bit for bit; --seed and --set make another run of it,
    of which the same is asked at the same times.
    """
    if realtime is not None and not (math.isfinite(realtime) and realtime > 0):
        raise UserError(f"--realtime {realtime:g}: the factor must be above 0, such as 1 for wall-clock time")
    replay: Sequence[tuple[float, Recorded]] = ()
    if scenario.endswith(".nc"):
        loaded, folder, recorded_seed, replay = _again(Path(scenario), overrides or [])
        seed = recorded_seed if seed is None else seed
    else:
        loaded, folder = _load(scenario, overrides), RUNS / Path(scenario).stem
    folder = out or folder
    if (folder / RECORD).resolve() == Path(scenario).resolve():
        raise UserError(f"{scenario}: would be overwritten by its own rerun: choose another folder with --out")
    with _output_folder(folder):
        _require_own(loaded, folder, report, force)
        links = _connect(
            mavlink or [],
            loaded,
            folder,
            estimator,
            identity=mavlink_identity,
            vehicles=mavlink_vehicles,
            readonly=mavlink_readonly,
            key=mavlink_key,
        )
        result = _fly(loaded, folder, seed=seed, links=links, shown=estimator, realtime=realtime, replay=replay)
        _conclude(result.dataset, result.metrics, folder / RECORD, report, force)
    if _lost(result):
        raise typer.Exit(EXIT_FAILED)


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

    if golden is not None and not golden.is_dir() and not update:
        raise UserError(f"--golden {golden}: no such folder: make it with --update")
    if junit is not None and not junit.parent.is_dir():
        raise UserError(f"--junit {junit}: there is no folder {junit.parent}: make it first")
    if junit is not None and junit.is_dir():
        raise UserError(f"--junit {junit}: is a folder: name the file in it")
    folder = golden or (checks.GOLDEN if checks.GOLDEN.is_dir() else None)
    if folder is None and update:
        raise UserError(f"--update: there is no {checks.GOLDEN} here: say with --golden DIR where they go")
    todo = checks.tasks(names or checks.shipped(), RUNS / "check", folder, update)
    with (
        _output_folder(RUNS / "check"),
        interrupts.leaving(lambda: "nothing was concluded"),
        progress.shown(_console(stderr=True), "check") as tell,
    ):
        outcomes = checks.fly_all(todo, tell)
    if update and folder is not None:
        outcomes = checks.update(outcomes, folder)
    shown = checks.table(outcomes, verbose)
    if shown is not None:
        _console().print(shown)
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
    from testbed.score import metrics
    from testbed.score.remarks import remarks

    dataset = load(run_file)
    try:
        computed = metrics.compute(dataset)
    except UserError as error:
        raise UserError(f"{run_file}: {error}") from None
    for remark in remarks(dataset, computed):
        _remark(remark)
    kept = run_file.parent / METRICS
    if not kept.exists():  # the run was killed
        metrics.save(computed, kept)
    _conclude(dataset, computed, run_file, True, force)


@app.command()
def export(
    run_file: RunFile,
    format: Annotated[ExportFormat, typer.Option(help="One CSV file per table, or one MATLAB file.")],
    out: Annotated[Path | None, typer.Option(metavar="PATH", help="Where to; beside the run file.")] = None,
    force: Force = False,
) -> None:
    """Turn a run file into CSV or MATLAB."""
    from testbed.record.export import export as write

    print(printable(str(write(run_file, format.value, out, force))))


@app.command()
def campaign(
    scenario: ScenarioName,
    runs: Annotated[int, typer.Option(metavar="N", min=1, help="How many seeds.")],
    vary: Annotated[
        list[str] | None, typer.Option(metavar="KEY=A,B,C", help="Repeat for each of these values; repeatable.")
    ] = None,
    overrides: Overrides = None,
    scheduler: Annotated[str | None, typer.Option(metavar="ADDRESS", help="An existing Dask cluster.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder; runs/<scenario>_campaign.")] = None,
) -> None:
    """Fly a scenario with many seeds."""
    from testbed.many import campaign as campaigns
    from testbed.many import progress
    from testbed.report import campaign as campaign_report

    varied = parse_vary(vary or [])
    folder = out or RUNS / f"{Path(scenario).stem}_campaign"
    require_own(folder, [campaign_report.TABLE, campaign_report.SUMMARY])
    with (
        _output_folder(folder),
        held(folder),
        interrupts.leaving(lambda: f"what is finished is in {folder}; the same command carries on"),
        progress.shown(_console(stderr=True), scenario) as tell,
    ):
        plan = campaigns.Plan(scenario, runs, folder, varied, overrides or ())
        result = campaigns.fly(plan, scheduler, lambda now: tell(now.fraction, str(now)))
    for table in campaign_report.tables(result):
        _console().print(table)
    print(printable(f"campaign: {folder}"))
    for failure in result.failures:
        case = f"{result.combinations[failure.combination]} seed {failure.seed}".strip()
        _remark(f"{case}: {failure.message}")
    if result.failures:
        raise typer.Exit(EXIT_FAILED)


@app.command()
def papers(
    ids: Annotated[list[str] | None, typer.Argument(metavar="[ID...]", help="Which papers; all of them.")] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for papers.json and figures.")] = RUNS / "papers",
) -> None:
    """Reproduce the papers: every claim beside what comes out here; exit code 1 if one is missed."""
    from testbed import papers as library
    from testbed.many import progress

    found = library.find(ids or [])
    require_own(out, [library.RESULTS, *(f"{name}.png" for name in found)])
    with (
        _output_folder(out),
        held(out),
        interrupts.leaving(lambda: "nothing was written"),
        progress.shown(_console(stderr=True), "papers") as tell,
    ):
        claims = library.reproduce(found, out, tell)
    for name, own in claims.items():
        _console().print(library.table(found[name].title, own))
    print(printable(f"{out / library.RESULTS} and figures beside it"))
    if any(claim.verdict == "missed" for own in claims.values() for claim in own):
        raise typer.Exit(EXIT_FAILED)


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
    show(source, _console(), speed)


@app.command()
def init(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="A new folder, or an empty one.")],
) -> None:
    """Begin a project of your own: a flight, an estimator for it, and a test of both."""
    from testbed.data import make_project

    for path in make_project(folder):
        print(path)
    print(f"Now: cd {folder} && testbed run first.toml")


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


def _explicit_realtime(arguments: Sequence[str]) -> list[str]:
    """Give a bare ``--realtime`` its factor 1: the option parser knows no optional values."""
    explicit = []
    for argument, following in pairwise([*arguments, ""]):
        explicit.append(argument)
        if argument == "--realtime":
            try:
                float(following)
            except ValueError:
                explicit.append("1")
    return explicit


def _console(stderr: bool = False) -> Console:
    from rich.console import Console

    console = Console(stderr=stderr)
    return console if console.is_terminal else Console(stderr=stderr, width=PIPE_COLUMNS)


def _load(name: str, overrides: Sequence[str] | None = None) -> Scenario:
    from testbed.scenario import Scenario

    return Scenario.load(name, overrides or ())


def _again(run_file: Path, overrides: Sequence[str]) -> tuple[Scenario, Path, int, list[tuple[float, Recorded]]]:
    """Scenario, folder, seed and requests for running a record again."""
    from testbed.loop import director
    from testbed.record import format1
    from testbed.record.reader import load, scenario_of
    from testbed.record.recorder import versions as installed

    dataset = load(run_file)
    said = dataset.attrs
    try:
        versions, seed = [*json.loads(said["versions"]).items()], int(said["seed"])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{run_file}: damaged record ({error}); run the scenario again") from None
    try:
        scenario = scenario_of(dataset, overrides)
    except UserError as error:
        raise UserError(f"{run_file}: {error}") from None
    other = [f"{name} {version}" for name, version in versions if installed().get(name) != version]
    if other:
        _remark(f"{run_file}: was made with {', '.join(other)}: bits may differ")
    if said["format"] == format1.FORMAT:
        _remark(f"{run_file}: is of format {said['format']!r}: {format1.CHANGED}")
    if not said["complete"]:
        _remark(f"{run_file}: ends early; the rerun goes on to the scenario's end")
    name = run_file.resolve().parent.name if run_file.name == RECORD else run_file.stem
    return scenario, RUNS / f"{name}_again", seed, director.recorded(dataset, scenario)


def _require_own(scenario: Scenario, folder: Path, report: bool, force: bool) -> None:
    """See before a run that nothing of somebody else's is where its results go."""
    if force:  # what figures there will be is not known; each is forced as it is written
        require_own(folder, [RECORD, METRICS], force)
        return
    names = [RECORD, METRICS]
    if report:
        from testbed.report import page

        names += page.files([*(one.name for one in scenario.estimator), *scenario.sensors])
    require_own(folder, names)


@contextmanager
def _output_folder(folder: Path) -> Iterator[None]:
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


def _connect(
    urls: Sequence[str], scenario: Scenario, folder: Path, estimator: str | None, **options: Any
) -> list[Publisher]:
    """Open the links, once it is sure that there is something to show and that no log would overwrite a result.

    ``options`` are those of `testbed.mavlink.MavlinkPublisher`.
    """
    if not urls:
        if any(options.values()):
            given = ", ".join(f"--mavlink-{name}" for name, value in options.items() if value)
            raise UserError(f"{given}: there is no link: add --mavlink URL, or leave it out")
        return []
    from testbed.loop.links import shown_estimator
    from testbed.mavlink import MavlinkPublisher, log_path

    shown_estimator(scenario, estimator)
    for url in urls:
        path = log_path(url)
        if path is not None and path.resolve().parent == folder.resolve() and path.name in (RECORD, METRICS, REPORT):
            raise UserError(f"{url}: a result of the run goes there: give the log another name, such as run.tlog")
    return [MavlinkPublisher(urls, scenario, **{name: value for name, value in options.items() if value is not None})]


def _fly(
    scenario: Scenario,
    folder: Path,
    *,
    seed: int | None = None,
    links: Sequence[Publisher] = (),
    shown: str | None = None,
    realtime: float | None = None,
    replay: Sequence[tuple[float, Recorded]] = (),
) -> RunResult:
    from testbed.loop import keyboard, loop
    from testbed.many import progress

    record, before = folder / RECORD, _stamp(folder / RECORD)
    with (
        interrupts.leaving(lambda: _kept(record) if _stamp(record) != before else "nothing was recorded"),
        keyboard.keys() if realtime else nullcontext() as keys,
        progress.shown(_console(stderr=True), scenario.title) as tell,
    ):
        if keys is not None:
            print(keyboard.HELP, file=sys.stderr)
        result = loop.run(
            scenario,
            seed=seed,
            out=folder,
            links=links,
            shown=shown,
            realtime=realtime,
            progress=lambda now: tell(*progress.of_run(now)),
            controls=[keys.requests] if keys is not None else (),
            replay=replay,
        )
    for remark in result.remarks:
        _remark(remark)
    return result


def _stamp(path: Path) -> tuple[int, int] | None:
    """What changes when a file is written or made anew; None when there is none."""
    with suppress(OSError):
        status = path.stat()
        return status.st_ino, status.st_mtime_ns
    return None


def _kept(record: Path) -> str:
    return f"the record so far is {record}: `testbed report {shlex.quote(str(record))}` shows it"


def _conclude(
    dataset: xarray.DataTree, metrics: Mapping[str, float], run_file: Path, report: bool, force: bool
) -> None:
    from testbed.report import page, tables

    console = _console()
    console.print(tables.summary(metrics))
    faults = tables.fault_table(metrics)
    if faults is not None:
        console.print(faults)
    if report:
        written = page.write_report(dataset, metrics, run_file.parent, force)
        print(printable(f"report: {written}"))
    print(printable(f"record: {run_file}"))


def _lost(result: RunResult) -> bool:
    """Whether the flight got out of control; if so, it is said."""
    if result.failure:
        from testbed.score.accuracy import column

        t = column(result.dataset, "truth/time")[-1]
        _remark(f"the flight ended after {t:.0f} s: {result.failure}")
    return bool(result.failure)


if __name__ == "__main__":
    main()
