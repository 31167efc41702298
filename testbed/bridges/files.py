"""Files for the autopilot that is to fly a scenario: a mission and parameters."""

from __future__ import annotations

import importlib
from pathlib import Path

from testbed.errors import UserError
from testbed.exports.registry import Format, write_one
from testbed.record.reader import load, scenario_of
from testbed.scenario import Scenario

QGC, ARDUPILOT = "QGroundControl, for PX4 and ArduPlane", "MAVProxy, Mission Planner, sim_vehicle.py"
FILES: dict[str, Format] = {
    one.name: one
    for one in (
        Format("plan", ".plan", "mavlink.mission_file", "the scenario's plan as a mission", QGC, version="plan"),
        Format("wpl", ".waypoints", "mavlink.mission_file", "the same as text, QGC WPL 110", ARDUPILOT, version="wpl"),
        Format(
            "px4-params",
            ".params",
            "bridges.parameters",
            "outputs, envelope and delays for PX4",
            "QGroundControl",
            version="px4",
        ),
        Format(
            "ardupilot-params",
            ".parm",
            "bridges.parameters",
            "the same for ArduPlane",
            ARDUPILOT,
            version="ardupilot",
        ),
    )
}


def write(source: Path, format: str, out: Path | None = None, force: bool = False) -> Path:
    """Write one of `FILES` for a scenario, by file or name, or for that of a record, and return where.

    It goes beside a record, else here, unless ``out`` says otherwise. Raises UserError when there is no such scenario
    or nothing of it to fly, or the target can't be written; or, without ``force``, when a file is there.
    """
    one = FILES[format]
    if source.suffix == ".nc":
        scenario, target = scenario_of(load(source)), source.with_suffix(one.ending)
    else:
        scenario, target = Scenario.load(source), Path(source.stem + one.ending)
    try:
        content: bytes = importlib.import_module(f"testbed.{one.module}").content(scenario, one.version)
    except UserError as error:
        raise error.within(str(source)) from None
    target = target if out is None else out
    write_one(target, content, force)
    return target
