"""``testbed log``: what is in a recorded flight, and a scenario that runs it."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from testbed.commands.shared import Force, console
from testbed.errors import UserError, printable

if TYPE_CHECKING:
    from collections.abc import Mapping
    from datetime import date as Date

    from testbed.motion.logged import LogTruth
    from testbed.sensors import SensorConfig

LogFile = Annotated[
    Path,
    typer.Argument(metavar="FILE", help="A log, or a scenario of one, which says what columns are; or a shipped log."),
]
Target = Annotated[
    Path | None, typer.Option("--scenario", metavar="OUT.toml", help="Write a scenario that runs the log.")
]
Simulation = Annotated[
    Path | None,
    typer.Option(
        "--compare", metavar="RUN.nc", help="Show beside it what a simulation of the flight has, or another log, named "
        "as FILE is. Two records are compared by their innovations too.",
    ),
]  # fmt: skip


def log(file: LogFile, scenario: Target = None, compare: Simulation = None, force: Force = False) -> None:
    """Show what is in a recorded flight: rates, gaps, phases, noise, vibration, latencies; propose grades."""
    from testbed.data import write_file
    from testbed.feeds import draft, formats
    from testbed.feeds.doubted import mounted
    from testbed.feeds.survey import survey
    from testbed.report import log as pages

    file, truth, date, sections = _named(file)
    if scenario is not None:
        _require_free(scenario, force)
    place = file if truth is None else Path(truth.file)
    if truth is None and formats.known(place).module == "table":
        from testbed.feeds.table import load

        console().print(pages.columns(load(place), f"{place.name}: a table"))
        if scenario is not None:
            raise UserError(
                f"{file}: is a table: begin with a scenario that says what its columns are, and give that in its place"
            )
        print("Say in [truth.columns.<sensor>] of a scenario what they are, and give that in place of the table.")
        return
    read = formats.read(place, {}) if truth is None else formats.open_log(truth)
    found = survey(mounted(read if date is None else replace(read, date=date), sections), _in_body_axes(sections))
    if compare is not None:
        from testbed.score import likeness

        other, columns, _, told = _named(compare)
        simulated = formats.read(other, {}) if columns is None else formats.open_log(columns)
        other_found = survey(mounted(simulated, told), _in_body_axes(told))
        console().print(pages.beside(likeness.compare(found, other_found), likeness.called(other_found)))
    else:
        for table in pages.tables(found):
            console().print(table)
    if scenario is not None:
        write_file(scenario, draft.scenario(found, scenario, truth, date, sections).encode())
        print(printable(f"scenario: {scenario}"))
        if (truth is None or truth.start is None) and not draft.is_placed(found.log):
            print("The log does not say where the flight was: a place is assumed. Give the right one, in start.")


def _named(file: Path) -> tuple[Path, LogTruth | None, Date | None, Mapping[str, SensorConfig]]:
    """A log by its path, or shipped; of a scenario, what that says of its log, the date if it says one, and sensors."""
    from testbed.data import data_dir
    from testbed.motion.logged import LogTruth
    from testbed.scenario import Scenario

    if not file.exists() and (data_dir("scenarios") / file).is_file():
        file = data_dir("scenarios") / file
    if file.suffix != ".toml":
        return file, None, None, {}
    loaded = Scenario.load(file)
    if not isinstance(loaded.truth, LogTruth):
        raise UserError(f"{file}: is a scenario without a log: its truth.source is {loaded.truth.source!r}")
    date = loaded.date if "date" in loaded.model_fields_set else None
    return file, loaded.truth, date, loaded.sensors


def _in_body_axes(sections: Mapping[str, SensorConfig]) -> Mapping[str, SensorConfig]:
    """The same of units whose increments are in body axes already."""
    from testbed.sensors.imu import ImuConfig

    plain = {"mounting_deg": (0.0, 0.0, 0.0)}
    return {name: one.model_copy(update=plain) if isinstance(one, ImuConfig) else one for name, one in sections.items()}


def _require_free(scenario: Path, force: bool) -> None:
    """Raise UserError where what is there may not be replaced: with ``force`` a scenario may be, and no log."""
    if scenario.is_dir():
        raise UserError(f"{scenario}: is a folder: give the name of a file")
    if not scenario.exists():
        return
    if not force:
        raise UserError(f"{scenario}: is there already: choose another name, or replace it with --force")
    try:
        tomllib.loads(scenario.read_text("utf-8"))
    except (OSError, ValueError):
        raise UserError(f"{scenario}: is no scenario: choose another name") from None
