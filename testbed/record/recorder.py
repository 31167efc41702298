"""Takes the rows of one run and writes them as they come, so that a record survives the death of its writer.

Its HDF5 structure never changes in place: a new column, a new group or more room means a new file beside it, renamed
over the old one when complete. In between, rows are written straight into the space that the contiguous datasets
already own, the time column last, so that a finite time marks a complete row: where nothing was written yet, time is
NaN, and `load` leaves those rows out.

HDF5's own ways were measured first, with 48 columns and 40 flushes of 200 rows. Resizable datasets with a plain flush:
cut between any two of the library's writes, 9 % of the files could not be read, compressed 80 to 90 %. Single writer,
multiple readers (SWMR): all of 30 records of killed writers could be read, but only by who asks for that mode (the
others are told that the file is open), a flush of 264 columns took twenty times as long as here, and no column
or group can be added.
"""

from __future__ import annotations

import errno
import json
import math
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar, cast

import numpy as np

from nav.columns import Estimates, FusedReports, Samples
from nav.samples import ImuSamples, Sample, UpdateReport
from testbed import interrupts
from testbed.errors import UserError
from testbed.motion.table import TruthBlock
from testbed.record import tables
from testbed.record.columns import FORMAT, IMU, TRUTH
from testbed.record.hdf5 import Plan, create
from testbed.record.reader import load, tree
from testbed.record.tables import Data, Pack, Table, blank

if TYPE_CHECKING:
    import xarray

    from testbed.scenario import Scenario
    from testbed.sensors.faults import FaultTruth
    from testbed.sensors.imu import ImuConfig

T = TypeVar("T")

FLUSH_WALL_S = 1.0  # a killed run loses at most this much work
ENDING = 2.5  # times that, and as much more is lost, when it is about to end: all is written anew then
UNTENDED_S = 5.0  # or this much of a live one, which writes when there is time, if there was none
PIECE_S = 0.004  # what one piece of that work may take, on a busy machine
COPY_BYTES = 1 << 20  # at a time, from a file to a larger one
PACK_ROWS = 400  # objects that a table keeps before it makes columns of them: while they are in the cache


class Recorder:
    """Collects the rows of one run and writes them as they come.

    ``path`` None keeps everything in memory. The file appears with the first flush, so a run that fails before its
    first row leaves no file, and an earlier record in its place intact. Raises UserError when the folder can't be
    written. Objects handed over are read at the next flush: their arrays must not be written to afterwards.
    """

    def __init__(self, path: Path | None, scenario: Scenario, seed: int) -> None:
        self.path = path
        self.attributes: dict[str, str | int | float] = {
            "format": FORMAT,
            "Conventions": "CF-1.8",
            "title": scenario.title,
            "scenario": scenario.text,
            "scenario_path": str(Path(scenario.path).absolute()) if scenario.path else "",  # found from everywhere
            "overrides": json.dumps(scenario.overrides),
            "seed": seed,
            "duration_s": float(scenario.duration_s),
            "record_rate_hz": float(scenario.record.rate_hz),
            "versions": json.dumps(versions()),
            "estimated_point_b_m": json.dumps(
                {
                    name: cast("ImuConfig", scenario.sensors[own.imu]).lever_arm_m
                    for own in scenario.estimator
                    for name in own.recorded
                }
            ),
            "estimator_imus": json.dumps({name: own.imu for own in scenario.estimator for name in own.recorded}),
            "error_convention": "error = estimate - truth; C_nb_hat = (I - [phi x]) C_nb; position error in metres NED",
            "complete": 0,
        }
        self._duration = float(scenario.duration_s)
        self._record_imu = scenario.record.imu
        self._every = round(scenario.truth.rate_hz / scenario.record.rate_hz)
        self._tables: dict[str, Table] = {}
        self._increments = np.zeros((0, 6))  # dtheta and dv of the ticks since the last recorded row
        self._t = 0.0  # of the newest row of truth
        self._heard = 0.0  # up to where all else has been taken, which comes after truth
        self._last_flush = self._began = time.monotonic()
        self._tended = False
        self._file: FileIO | None = None
        self._closed = False
        self._laying: Iterator[None] | None = None  # the next file in the making
        if path is not None:
            _check_writable(path)

    def truth(self, block: TruthBlock) -> None:
        """Take full-rate rows; every n-th is recorded, with the increments summed since the one before."""
        self._heard = self._t
        if len(block):
            self._record_truth(block)
            self._t = float(block.t[-1])
        for table in self._tables.values():
            if len(table.objects) >= PACK_ROWS:
                table.pack()
        if time.monotonic() - self._last_flush >= (UNTENDED_S if self._tended else FLUSH_WALL_S) and not self._ending():
            self.flush()

    def _ending(self) -> bool:
        """Whether all will be written soon anyway, at the pace so far: most runs take no longer than three seconds."""
        elapsed = time.monotonic() - self._began
        return not self._tended and elapsed * (self._duration - self._t) < ENDING * FLUSH_WALL_S * self._t

    def imu(self, name: str, samples: ImuSamples) -> None:
        """Take inertial increments at their full rate, if the scenario records them."""
        if self._record_imu and len(samples):
            block = {"time": samples.t, "dt": samples.dt, "dtheta": samples.dtheta, "dv": samples.dv}
            self._table(f"sensors/{name}").add(block, IMU)

    def samples(self, name: str, samples: Sequence[Sample]) -> None:
        """Take aiding samples as delivered."""
        if not samples:
            return
        table = self._table(f"sensors/{name}", tables.pack_samples)
        if isinstance(samples, Samples):
            table.pack()  # those before
            table.add(*tables.sample_columns(samples))
        else:
            table.objects.extend(samples)

    def estimates(self, name: str, estimates: Estimates) -> None:
        """Take estimates of one estimator."""
        if len(estimates):
            self._table(f"estimators/{name}").add(*tables.estimate_columns(estimates))

    def reports(self, name: str, reports: Iterable[UpdateReport | FusedReports]) -> None:
        """Take what became of aiding samples, one group per aid."""
        for report in reports:
            if isinstance(report, UpdateReport):
                self._reports(name, report.aid).objects.append(report)
                continue
            for own in report.by_kind():
                table = self._reports(name, own.kinds[0][1])
                table.pack()  # those before
                table.add(*tables.fused_columns(own))

    def _reports(self, name: str, aid: str) -> Table:
        path = f"estimators/{name}/innovations/{aid}"
        return self._tables.get(path) or self._table(path, partial(tables.pack_reports, aid), "sample_time")

    def faults(self, faults: Sequence[FaultTruth]) -> None:
        """Note what is going to go wrong."""
        if faults:
            self._table("faults", tables.pack_faults).objects.extend(faults)

    def steered(self, steps: Sequence[tuple[float, Sequence[float] | None]]) -> None:
        """Take what a far end commanded that is to fly: time and surfaces, None where it did not, of each step."""
        if steps:
            self._table("far_end", tables.pack_steered).objects.extend(steps)

    def request(self, t: float, tick: int, kind: str, content: str) -> None:
        """Note what somebody asked of the run, at once if there is a file: a run that is killed can be repeated."""
        self._table("requests", tables.pack_requests).objects.append((t, tick, kind, content))
        if self._tended:
            self._last_flush = -math.inf
        elif "truth" in self._tables:  # a run without rows leaves no file
            self.flush()

    def event(self, t: float, severity: str, text: str) -> None:
        """Note that something happened; severity is info, warning or error."""
        self._table("events", tables.pack_events).objects.append((t, severity, text))

    def flush(self) -> None:
        """Make every row taken so far part of the file; in memory, only pack it."""
        self._pack()
        if self.path is None or self._closed:
            return
        if self._laying or any(table.pending for table in self._tables.values()):
            self._guard(self._write)

    def tend(self, seconds: float) -> None:
        """Use no more than ``seconds`` of wall time, which nobody else needs, for what `flush` does in one go."""
        until = time.monotonic() + seconds - PIECE_S
        self._tended = True
        if self.path is None or time.monotonic() >= until:
            return
        if self._laying is None and time.monotonic() - self._last_flush >= FLUSH_WALL_S:
            self._pack()
            if self._misfit():
                self._laying = self._lay_out()
            else:
                self._guard(self._write_rows)
        while self._laying is not None and time.monotonic() < until:
            self._guard(self._lay_piece)

    def close(self) -> None:
        """Write what is left and give the file its final size. A run without rows leaves no file."""
        if not self._closed:
            with suppress(UserError):
                self.flush()  # first what takes little: whoever closes before the end may be in a hurry
            self._close(self._rows)

    def _close(self, rows: Callable[[str, str], Data]) -> None:
        """`close`, with all ``rows`` of a group and a column. Interrupted, it can be called again."""
        if self.path is None or not any(table.rows_now for table in self._tables.values()):
            self._closed = True
            return
        try:
            self._guard(lambda: self._finish(rows))
        except Exception:
            with suppress(UserError):
                self.flush()  # the file that grew may have room where a whole one beside it has none
            self._let_go()
            raise

    def _let_go(self) -> None:
        self._closed = True
        if self._file is not None:
            self._file.close()
            self._file = None

    def dataset(self) -> xarray.DataTree:
        """Everything recorded so far, equal to `load` of the file."""
        self.flush()
        if self.path is not None and self.path.exists():
            return load(self.path)
        return self._tree(self._rows)

    def finish(self) -> xarray.DataTree:
        """`close`, and give everything recorded: to read the compressed file again would take several times as long."""
        if self.path is None or self._closed:
            return self.dataset()
        self._pack()
        self._laying = None
        columns = self._tables.items()
        rows = self._guard(lambda: {(path, name): self._rows(path, name) for path, t in columns for name in t.columns})
        self._close(lambda path, name: rows[path, name])
        return self._tree(lambda path, name: rows[path, name])

    def _tree(self, rows: Callable[[str, str], Data]) -> xarray.DataTree:
        """The columns with their ``rows``."""
        columns = {
            path: {name: (c.variable, rows(path, name)) for name, c in table.columns.items()}
            for path, table in self._tables.items()
        }
        return tree(columns, self.attributes)

    def _table(self, path: str, pack: Pack | None = None, time_name: str = "time") -> Table:
        table = self._tables.get(path)
        if table is None:
            table = self._tables[path] = Table(pack, time_name)
        return table

    def _record_truth(self, block: TruthBlock) -> None:
        """Record the rows whose ticks are multiples of the record interval, with the increments summed up to them."""
        every = self._every
        kept = slice(-block.tick % every, None, every)
        count = len(block.t[kept])
        before = self._increments
        if block.tick == 0:  # nothing led to the initial state: its interval is itself alone
            before = np.zeros((every - 1, 6))
        increments = np.empty((len(before) + len(block), 6))
        increments[: len(before)] = before
        increments[len(before) :, :3] = block.dtheta
        increments[len(before) :, 3:] = block.dv
        whole = count * every
        self._increments = increments[whole:]
        if not count:
            return
        columns = {name: getattr(block, name)[kept].copy() for name in TRUTH if name not in ("dtheta", "dv")}
        # Each interval is summed by itself, in order: the result can't depend on how the run was chunked.
        sums = np.add.reduceat(increments[:whole], np.arange(0, whole, every), axis=0)
        self._table("truth").add(
            {"time": block.t[kept].copy(), **columns, "dtheta": sums[:, :3], "dv": sums[:, 3:]}, TRUTH
        )

    def _pack(self) -> None:
        self._last_flush = time.monotonic()
        for table in self._tables.values():
            table.pack()

    def _misfit(self) -> bool:
        """Whether the file lacks a column, or room."""
        return any(table.grown or table.rows_now > table.capacity for table in self._tables.values())

    def _write(self) -> None:
        """Write all rows, whatever it takes."""
        while self._laying is not None:
            self._lay_piece()
        if self._misfit():
            self._laying = self._lay_out()
            self._write()
        self._write_rows()

    def _write_rows(self) -> None:
        """Write the rows of the tables that the file has room for."""
        assert self._file is not None
        for table in self._tables.values():
            if not table.pending or table.grown or table.rows_now > table.capacity:
                continue
            for name in table.order():
                column = table.columns[name]
                _put(self._file, column.offset + table.written * column.row_bytes, table.rows(name).data.cast("B"))
            with interrupts.held():
                table.count_written()

    def _lay_piece(self) -> None:
        assert self._laying is not None
        if next(self._laying, self) is self:
            self._laying = None

    def _finish(self, rows: Callable[[str, str], Data]) -> None:
        """Put a whole and compressed file in place of the one that grew."""
        assert self.path is not None
        self._laying = None
        plans = {path: Plan(t.time_name, t.rows_now, dict(t.columns)) for path, t in self._tables.items()}
        for _ in create(_part(self.path), plans, self.attributes | {"complete": 1}, rows):
            pass
        with interrupts.held():  # from here on the rows are there, and the file that grew is not
            os.replace(_part(self.path), self.path)
            self.attributes["complete"] = 1
            for table in self._tables.values():
                table.count_written()
            self._let_go()

    def _rows(self, path: str, name: str) -> Data:
        """All rows of a column: those in the file, and those that wait."""
        table = self._tables[path]
        column = table.columns[name]
        if not table.written:
            return table.rows(name)
        assert self._file is not None
        shape = (table.written, *column.shape)
        if not column.offset:  # newer than the file
            return np.concatenate([blank(shape, column.dtype), table.rows(name)])
        whole = np.empty((table.rows_now, *column.shape), column.dtype)
        _get(self._file, column.offset, whole[: table.written].data.cast("B"))
        if table.pending:
            whole[table.written :] = table.rows(name)
        return whole

    def _lay_out(self) -> Iterator[None]:
        """Write a new file with the room that is needed, piece by piece, and put it in place of the old one.

        Rows may come meanwhile, and columns; these wait for the next file.
        """
        assert self.path is not None
        plans = {
            path: Plan(
                table.time_name,
                table.rows_expected(self._t if path == "truth" else self._heard, self._duration),
                dict(table.columns),
            )
            for path, table in self._tables.items()
        }
        yield from create(_part(self.path), plans, dict(self.attributes))
        new = _part(self.path).open("r+b", buffering=0)
        try:
            yield from self._copied(new, plans)
        except BaseException:
            new.close()
            raise
        with interrupts.held():  # between the old file and the new one, what is in which would not be known
            try:
                os.replace(_part(self.path), self.path)
            except OSError:
                new.close()
                raise
            if self._file is not None:
                self._file.close()
            self._file = new
            for path, plan in plans.items():
                table = self._tables[path]
                table.capacity, table.grown = plan.capacity, len(table.columns) > len(plan.columns)
                for name, column in plan.columns.items():
                    column.offset = plan.offsets[name]
        self._write_rows()

    def _copied(self, new: FileIO, plans: Mapping[str, Plan]) -> Iterator[None]:
        """Copy what was written to a file of these plans, piece by piece."""
        if self._file is None:
            return
        for path, plan in plans.items():
            written = self._tables[path].written
            for name in reversed(plan.columns) if written else ():
                column = plan.columns[name]
                if column.offset:
                    yield from _copy(self._file, column.offset, new, plan.offsets[name], written * column.row_bytes)
                else:
                    _put(new, plan.offsets[name], blank((written, *column.shape), column.dtype).data.cast("B"))

    def _guard(self, work: Callable[[], T]) -> T:
        """Turn a full disk and the like into a message; what the file held before stays."""
        assert self.path is not None
        try:
            return work()
        except Exception as error:
            self._laying = None
            _part(self.path).unlink(missing_ok=True)
            if isinstance(error, OSError | RuntimeError):  # HDF5 has both
                raise UserError(f"{self.path}: can't write the record ({_reason(error)})") from error
            raise


def _reason(error: Exception) -> str:
    """Why the system refused: HDF5 wraps the number of the error in a page of its own text."""
    number = re.search(r"errno = (\d+)", str(error))
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return os.strerror(int(number[1])) if number else str(error).splitlines()[0]


def _part(path: Path) -> Path:
    """Where the next version of a file is made."""
    return path.with_name(f".{path.name}.part")


def _copy(source: FileIO, start: int, target: FileIO, at: int, count: int) -> Iterator[None]:
    for done in range(0, count, COPY_BYTES):
        chunk = memoryview(bytearray(min(COPY_BYTES, count - done)))
        _get(source, start + done, chunk)
        _put(target, at + done, chunk)
        yield


def _get(file: FileIO, at: int, room: memoryview) -> None:
    """Read as many bytes as there is room for."""
    file.seek(at)
    done = 0
    while done < len(room):
        count = file.readinto(room[done:])
        if not count:
            raise OSError(errno.EIO, "the file is shorter than what was written to it")
        done += count


def _put(file: FileIO, at: int, data: bytes | memoryview) -> None:
    """Write all of it: a disk that fills up takes a part without a word, and refuses the next."""
    file.seek(at)
    done = 0
    while done < len(data):
        done += file.write(data[done:])


def _check_writable(path: Path) -> None:
    if path.is_dir():
        raise UserError(f"{path}: is a folder; give the name of a file")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _part(path).write_bytes(b"")
        _part(path).unlink()
    except OSError as error:
        raise UserError(
            f"{path.parent}: can't write here ({error.strerror or error}); choose another folder with --out"
        ) from error


def versions() -> dict[str, str]:
    """What the installed packages are that decide on a run's bits."""
    found = {}
    for package in ("navigation-testbed", "numpy", "scipy", "numba", "jsbsim", "h5py"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found
