"""``testbed run``: fly one scenario, or run a record again."""

from __future__ import annotations

import json
import math
import shlex
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from testbed import interrupts
from testbed.commands.shared import (
    EXIT_FAILED,
    RUNS,
    Force,
    Overrides,
    conclude,
    console,
    output_folder,
    remark,
)
from testbed.errors import UserError
from testbed.results import MANIFEST, METRICS, RECORD, beside, held, require_own, stamp, withdraw

if TYPE_CHECKING:
    from testbed.bridges.gps_input import GpsInput
    from testbed.feeds.bridged import FarEnd
    from testbed.loop.links import Publisher
    from testbed.loop.loop import RunResult
    from testbed.loop.requests import Recorded
    from testbed.scenario import Scenario

Flown = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO|RUN.nc", help="A scenario file, a shipped one by name, or a record to be run again."
    ),
]
Folder = Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for the results; runs/<scenario>.")]
Seed = Annotated[int | None, typer.Option(metavar="N", min=0, max=2**63 - 1, help="In place of the scenario's seed.")]
Mavlink = Annotated[
    list[str] | None,
    typer.Option(metavar="URL", help="To udpout, udpin, tcp or tcpin:HOST:PORT, serial:DEVICE, tlog:FILE; repeatable."),
]
MavlinkIdentity = Annotated[
    str | None, typer.Option(metavar="NAME", help="Whose ways the vehicle has: px4, or ardupilot.")
]
MavlinkVehicles = Annotated[
    bool, typer.Option("--mavlink-vehicles", help="Show truth and the other estimators as vehicles of their own.")
]
MavlinkReadonly = Annotated[bool, typer.Option("--mavlink-readonly", help="Let stations watch, but change nothing.")]
MavlinkKey = Annotated[
    str | None,
    typer.Option(metavar="KEY", help="Hear only what is signed with this passphrase or 64 hexadecimal digits."),
]
Px4Address = Annotated[
    str | None, typer.Option("--px4", metavar="[URL]", help="Let PX4 follow the run; it connects to tcpin:HOST:PORT.")
]
ArduPilotAddress = Annotated[
    str | None, typer.Option("--ardupilot", metavar="[URL]", help="Let ArduPilot follow it; it calls udpin:HOST:PORT.")
]
GpsInputAddress = Annotated[
    str | None,
    typer.Option(
        "--gps-input", metavar="[URL]", help="With --ardupilot: send our fixes to its MAVLink there, as GPS_INPUT."
    ),
]
Pilot = Annotated[
    bool, typer.Option("--pilot", help="With --px4 or --ardupilot: let it fly, in place of the plan, once it is armed.")
]
Shown = Annotated[str | None, typer.Option(metavar="NAME", help="Which estimator to stream; the scenario's first.")]
Realtime = Annotated[
    float | None, typer.Option(metavar="[FACTOR]", help="Run no faster than real time, or FACTOR times that.")
]
Report = Annotated[bool, typer.Option("--report/--no-report", help="Write figures and report.html.")]


def run(
    scenario: Flown,
    out: Folder = None,
    seed: Seed = None,
    overrides: Overrides = None,
    mavlink: Mavlink = None,
    mavlink_identity: MavlinkIdentity = None,
    mavlink_vehicles: MavlinkVehicles = False,
    mavlink_readonly: MavlinkReadonly = False,
    mavlink_key: MavlinkKey = None,
    estimator: Shown = None,
    px4: Px4Address = None,
    ardupilot: ArduPilotAddress = None,
    gps_input: GpsInputAddress = None,
    pilot: Pilot = False,
    realtime: Realtime = None,
    report: Report = True,
    force: Force = False,
) -> None:
    """Fly one scenario: record, metrics, report. Exit code 1 if control was lost on the way.

    A record is run again with everything that was asked of it, bit for bit; --seed and --set make another run of it,
    of which the same is asked at the same times.
    """
    if realtime is not None and not (math.isfinite(realtime) and realtime > 0):
        raise UserError(f"--realtime {realtime:g}: the factor must be above 0, such as 1 for wall-clock time")
    loaded, folder, seed, replay, flown = _flight(scenario, overrides or [], seed, anew=pilot)
    if flown is not None and (px4 or ardupilot or gps_input):
        raise UserError(f"{scenario}: {flown.name} flew it: add --pilot to have it flown anew, or let nobody follow")
    folder = out or folder
    if (folder / RECORD).resolve() == Path(scenario).resolve():
        raise UserError(f"{scenario}: would be overwritten by its own rerun: choose another folder with --out")
    with output_folder(folder):
        far_end = flown or _far_end(loaded, px4, ardupilot, gps_input, pilot)
        with ExitStack() as over:
            with held(folder):  # a log that another run is writing is not to be begun anew
                _require_own(loaded, folder, report, force)
                over.enter_context(beside(folder, _logs(mavlink or [], loaded, folder, report, force), force))
                links = _connect(
                    mavlink or [],
                    loaded,
                    estimator,
                    identity=mavlink_identity,
                    vehicles=mavlink_vehicles,
                    readonly=mavlink_readonly,
                    key=mavlink_key,
                )
            options = {"seed": seed, "links": links, "shown": estimator, "replay": replay, "far_end": far_end}
            result = _fly(loaded, folder, realtime, **options)
        with interrupts.leaving(lambda: _shows(folder / RECORD, "the record is")):
            conclude(result.dataset, result.metrics, folder / RECORD, report, force)
    if _lost(result):
        raise typer.Exit(EXIT_FAILED)


class _Flight(NamedTuple):
    """What is to be run: scenario, folder of its results, seed if not the scenario's; what was asked, and who flew."""

    scenario: Scenario
    folder: Path
    seed: int | None
    replay: Sequence[tuple[float, Recorded]] = ()
    flown: FarEnd | None = None


def _flight(name: str, overrides: Sequence[str], seed: int | None, *, anew: bool) -> _Flight:
    """A scenario, or a record; ``anew``: whoever flew that is not to do so again."""
    from testbed.feeds.build import located
    from testbed.scenario import Scenario

    if name.endswith(".nc"):
        found = _again(Path(name), overrides, anew)
        found = found if seed is None else found._replace(seed=seed)
    else:
        found = _Flight(Scenario.load(name, overrides), RUNS / Path(name).stem, seed)
    return found._replace(scenario=located(found.scenario))


def _again(run_file: Path, overrides: Sequence[str], anew: bool) -> _Flight:
    """A record that is to be run again."""
    from testbed.feeds.played import played
    from testbed.loop import director
    from testbed.record import format1
    from testbed.record.reader import load, scenario_of
    from testbed.record.recorder import versions as installed

    dataset = load(run_file)
    said = dataset.attrs
    try:
        versions, seed = [*json.loads(said["versions"]).items()], int(said["seed"])
        own_code = dict(json.loads(said.get("own_code", "{}")))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{run_file}: damaged record ({error}); run the scenario again") from None
    try:
        scenario = scenario_of(dataset, overrides)
        flown = None if anew else played(dataset)
    except UserError as error:
        raise error.within(str(run_file)) from None
    other = [f"{name} {version}" for name, version in versions if installed().get(name) != version]
    if other:
        remark(f"{run_file}: was made with {', '.join(other)}: bits may differ")
    edited = _edited(scenario, own_code)
    if edited:
        remark(f"{run_file}: {edited} has been edited since: bits may differ")
    if said["format"] == format1.FORMAT:
        remark(f"{run_file}: is of format {said['format']!r}: {format1.CHANGED}")
    if not said["complete"]:
        ends = "goes on to the scenario's end" if flown is None else "ends where its commands do"
        remark(f"{run_file}: ends early; the rerun {ends}")
    name = run_file.resolve().parent.name if run_file.name == RECORD else run_file.stem
    return _Flight(scenario, RUNS / f"{name}_again", seed, director.recorded(dataset, scenario), flown)


def _edited(scenario: Scenario, own_code: Mapping[str, str]) -> str:
    """The kinds of the user's that are not of the code that a record was made with."""
    now = {kind: code for own in scenario.own().values() for kind, code in own.items()}
    return ", ".join(kind for kind, code in own_code.items() if now.get(kind, code) != code)


def _require_own(scenario: Scenario, folder: Path, report: bool, force: bool) -> None:
    """See before a run that nothing of somebody else's is where its results go."""
    if force:  # what figures there will be is not known; each is forced as it is written
        require_own(folder, [RECORD, METRICS], force)
        return
    require_own(folder, _results(scenario, report))


def _results(scenario: Scenario, report: bool) -> list[str]:
    """What files a run may make of itself."""
    names = [RECORD, METRICS]
    if report:
        from testbed.report import page

        names += page.files([*(one.name for one in scenario.estimator), *scenario.sensors])
    return names


def _logs(urls: Sequence[str], scenario: Scenario, folder: Path, report: bool, force: bool) -> list[str]:
    """The telemetry logs among the links that go to the results, by name.

    Raises UserError of one that would overwrite a result or, without ``force``, a file elsewhere.
    """
    from testbed.mavlink.link import log_path

    found = []
    for url, path in ((url, log_path(url)) for url in urls):
        if path is None:
            continue
        if path.resolve().parent != folder.resolve():
            if path.is_file() and not force:
                raise UserError(f"{url}: {path.name} is there already: give the log another name, or add --force")
        elif path.name in (MANIFEST, *_results(scenario, report)):
            raise UserError(f"{url}: a result of the run goes there: give the log another name, such as run.tlog")
        else:
            found.append(path.name)
    return found


def _connect(urls: Sequence[str], scenario: Scenario, estimator: str | None, **options: Any) -> list[Publisher]:
    """Open the links, once it is sure that there is something to show.

    ``options`` are those of `testbed.mavlink.MavlinkPublisher`.
    """
    if not urls:
        if any(options.values()):
            given = ", ".join(f"--mavlink-{name}" for name, value in options.items() if value)
            raise UserError(f"{given}: there is no link: add --mavlink URL, or leave it out")
        return []
    from testbed.loop.links import shown_estimator
    from testbed.mavlink import MavlinkPublisher

    shown_estimator(scenario.estimator, estimator)
    return [MavlinkPublisher(urls, scenario, **{name: value for name, value in options.items() if value is not None})]


def _far_end(
    scenario: Scenario, px4: str | None, ardupilot: str | None, gps_input: str | None, flies: bool
) -> FarEnd | None:
    """The autopilot that is to follow the run, once it is there; None when there is to be none."""
    if gps_input is not None and ardupilot is None:
        raise UserError("--gps-input: is for ArduPilot: add --ardupilot, or leave it out")
    if px4 is None and ardupilot is None:
        if flies:
            raise UserError("--pilot: there is no autopilot: add --px4 or --ardupilot, or leave it out")
        return None
    from testbed.estimators.outside import ArduPilotSection, Px4Section
    from testbed.sensors.imu import ImuConfig

    if px4 is not None and ardupilot is not None:
        raise UserError("--px4, --ardupilot: one autopilot follows a run: leave one of them out")
    if not any(isinstance(section, ImuConfig) for section in scenario.sensors.values()):
        raise UserError("--px4, --ardupilot: an autopilot lives on inertial samples: add [sensors.imu]")
    if px4 is not None:
        from testbed.bridges.px4 import Px4

        remark(f"waiting for PX4 on {px4}")
        theirs = {one.name: one.address for one in scenario.estimator if isinstance(one, Px4Section)}
        return Px4(px4, flies=flies, estimators=theirs)
    assert ardupilot is not None
    from testbed.bridges.ardupilot import ArduPilot

    fixes = None if gps_input is None else _fixes(scenario, gps_input)
    remark(f"waiting for ArduPilot on {ardupilot}")
    theirs = {one.name: one.address for one in scenario.estimator if isinstance(one, ArduPilotSection)}
    return ArduPilot(ardupilot, flies=flies, fixes=fixes, estimators=theirs)


def _fixes(scenario: Scenario, url: str) -> GpsInput:
    """Where the fixes of the scenario's receivers go."""
    from testbed.bridges.gps_input import GpsInput
    from testbed.sensors.gnss import GnssConfig

    receivers = [name for name, section in scenario.sensors.items() if isinstance(section, GnssConfig)]
    if not receivers:
        raise UserError("--gps-input: the scenario has no receiver whose fixes could be sent: add [sensors.gnss]")
    return GpsInput(url, receivers, scenario.date)


def _fly(scenario: Scenario, folder: Path, realtime: float | None, **options: Any) -> RunResult:
    """Run with progress and keys; ``options`` are others of `testbed.run`."""
    from testbed.loop import keyboard, loop
    from testbed.many import progress

    record, before = folder / RECORD, stamp(folder / RECORD)
    with (
        interrupts.leaving(
            lambda: _kept(record) if stamp(record) != before and _has_rows(record) else _nothing(record, before)
        ),
        keyboard.keys() if realtime else nullcontext() as keys,
        progress.shown(console(stderr=True), scenario.title) as tell,
    ):
        if keys is not None:
            print(keyboard.HELP, file=sys.stderr)
        try:
            result = loop.run(
                scenario,
                out=folder,
                realtime=realtime,
                progress=lambda now: tell(*progress.of_run(now)),
                controls=[keys.requests] if keys is not None else (),
                **options,
            )
        except UserError as error:
            raise UserError(*error.args, *([_kept(record)] if stamp(record) != before else [])) from None
    for text in result.remarks:
        remark(text)
    return result


def _has_rows(record: Path) -> bool:
    """Whether there is a row of truth in a record, without which it shows nothing; one that can't be read may have."""
    from h5py import File

    try:
        with File(record, "r") as file:
            return math.isfinite(file["truth/time"][0])
    except (KeyError, ValueError):
        return False
    except OSError:
        return record.is_file() and record.stat().st_size > 0


def _nothing(record: Path, before: tuple[int, int, int] | None) -> str:
    """That there is no record, once one without a row is gone, or the word of one that was to come."""
    if stamp(record) != before or before is None:
        withdraw(record)
    return "nothing was recorded"


def _kept(record: Path) -> str:
    return _shows(record, "the record so far is")


def _shows(record: Path, what: str) -> str:
    return f"{what} {record}: `testbed report {shlex.quote(str(record))}` shows it"


def _lost(result: RunResult) -> bool:
    """Whether the flight got out of control; if so, it is said."""
    if result.failure:
        from testbed.score.accuracy import column

        t = column(result.dataset, "truth/time")[-1]
        remark(f"the flight ended after {t:.0f} s: {result.failure}")
    return bool(result.failure)
