"""A table beside a log of another format: what the log is judged by, such as a receiver's solution found afterwards."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from testbed.errors import UserError
from testbed.feeds.clocks import Clocks
from testbed.feeds.doubted import contradicted
from testbed.feeds.log import Log
from testbed.feeds.samples import newly
from testbed.feeds.table import Tables, known_motion, load, quantities
from testbed.motion.logged import Stream


def judged_by(log: Log, columns: Mapping[str, Stream]) -> Log:
    """A log with the reference that a table beside it has, in place of its own solution.

    Times are those of the log's clock. Dates, of UTC, are taken to it by its receiver. Raises UserError when
    ``columns`` are of anything else, or what is said of them is wrong.
    """
    for name, stream in columns.items():
        if (stream.kind or name) != "reference":
            told = "says itself what its sensors are: beside it a table has a reference, and nothing else"
            raise UserError(f"truth.columns.{name}: {log.path} ({log.format}) {told}")
        if stream.file is None:
            raise UserError(f"truth.columns.{name}.file: is missing: the table that the reference is in")
    if len(columns) > 1:
        raise UserError(f"truth.columns: {log.path} is judged by one reference, and has {', '.join(columns)}")
    ((name, stream),) = columns.items()
    path = Path(stream.file or "")
    tables = {Path(file): load(Path(file)) for file in stream.files.values()}
    imu = next(own for own in log.imus.values() if len(own))
    notes = list(log.notes)
    dated = stream.time.column in tables[Path(stream.time.file or path)].dates
    if dated and log.utc is None:
        told = f"holds dates, and {log.path} doesn't say what time it was: give seconds of that one's clock"
        raise UserError(f"truth.columns.{name}.time: {told}")
    zero, pace = (log.utc, 1.0) if dated and log.utc is not None else (0.0, log.pace)
    heard = float(imu.t[0]) * pace + zero, float(imu.t[-1]) * pace + zero
    t, values = quantities(Tables(tables, path), name, "reference", stream, Clocks(heard), notes)
    if not len(t):
        raise UserError(f"truth.columns.{name}: {path} has no row with a time and anything else")
    found = known_motion(*newly(name, (t - zero) / pace, values, log.imus, notes), notes)
    found = replace(found, name=f"the reference in {path.name}")
    said = contradicted(found, log.imus, log.samples)
    return replace(log, solution=found, notes=notes, remark=said, solution_by_utc=dated)
