"""One netCDF-4/HDF5 file per run: truth, sensors, estimators with every innovation, and events.

Layout, one group each, every group with its own time axis::

    truth                                    the true state at the record rate
    sensors/<name>                           what the sensor delivered
    estimators/<name>                        state, sigmas, 9x9 covariance, further states
    estimators/<name>/innovations/<aid>      what became of each aiding sample
    faults                                   what was made to go wrong; time is when it begins
    requests                                 what was asked of the run while it went on
    events                                   severity and text

Every variable carries ``units``, ``long_name`` and, where it has one, ``frame``. The root carries the scenario text,
seed and versions. The dimension is ``time``, except ``sample_time`` for innovations: a nested group may not reuse its
parent's dimension with other values.

A record survives the death of its writer. Its HDF5 structure never changes in place: a new column, a new group or more
room means a new file beside it, renamed over the old one when complete. In between, rows are written straight into the
space that the contiguous datasets already own, the time column last, so that a finite time marks a complete row:
where nothing was written yet, time is NaN. `load` leaves those rows out.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from nav.samples import Estimate, FixType, ImuSamples, Sample, Status, UpdateReport
from testbed.errors import UserError
from testbed.motion.table import COLUMNS, TruthBlock

if TYPE_CHECKING:
    import h5py
    import xarray

    from testbed.scenario import Scenario
    from testbed.sensors.faults import FaultTruth
    from testbed.sensors.imu import ImuConfig

Data: TypeAlias = npt.NDArray[Any]

FORMAT = "navigation-testbed run 1"
FLUSH_WALL_S = 1.0  # a killed run loses at most this much work
UNTENDED_S = 5.0  # or this much of a live one, which writes when there is time, if there was none
PIECE_S = 0.004  # what one piece of that work may take, on a busy machine
PACK_ROWS = 400  # objects that a table keeps before it makes columns of them: while they are in the cache
SPARE_ROWS = 64  # room made for a table beyond what its rate so far asks for

# What the components of a vector mean: the labels of its dimension.
AXES: dict[str, tuple[str, ...]] = {
    "ned": ("north", "east", "down"),
    "body": ("forward", "right", "down"),
    "north_east": ("north", "east"),
    "quaternion": ("w", "x", "y", "z"),
    "inertial_quaternion": ("w", "x", "y", "z"),
    "surface": ("aileron", "elevator", "rudder", "throttle"),
    "command": ("bank", "altitude", "airspeed"),
    "error": tuple(
        f"{what}_{axis}" for what in ("position", "velocity", "attitude") for axis in ("north", "east", "down")
    ),
}
AXES["error_column"] = AXES["error"]
_FRAME = {
    "ned": "n: local north-east-down",
    "north_east": "n: local north-east-down",
    "body": "b: forward-right-down",
    "quaternion": "from b (forward-right-down) to n (north-east-down)",
    "inertial_quaternion": "from b (forward-right-down) to i (ECEF at time 0)",
    "error": "n: local north-east-down",
}


@dataclass(frozen=True, slots=True)
class Variable:
    """Unit, meaning, dimensions after time, element type and further attributes of one recorded column."""

    unit: str
    meaning: str
    dims: tuple[str, ...] = ()
    dtype: str = "<f8"
    attributes: Mapping[str, str] = field(default_factory=dict)

    @property
    def frame(self) -> str:
        """Frame of the components, empty for scalars."""
        return next((_FRAME[d] for d in self.dims if d in _FRAME), "")


def _truth_dims(name: str, width: int) -> tuple[str, ...]:
    if width == 1:
        return ()
    if name.startswith("q_"):
        return ("quaternion",)
    if name.endswith("_n"):
        return ("ned",)
    return {"controls": ("surface",), "commands": ("command",)}.get(name, ("body",))


TRUTH = {name: Variable(c.unit, c.meaning, _truth_dims(name, c.width)) for name, c in COLUMNS.items() if name != "t"}
for _name, _what in (("dtheta", "omega_b"), ("dv", "specific force at the centre of gravity, body axes")):
    TRUTH[_name] = replace(TRUTH[_name], meaning=f"sum over the ticks since the last row of the increments of {_what}")

IMU = {
    "dt": Variable("s", "length of the interval that ends at time"),
    "dtheta": Variable("rad", "measured integral of angular rate of b relative to i", ("body",)),
    "dv": Variable("m/s", "measured integral of specific force", ("body",)),
}

SAMPLE = {
    "t_arrival": Variable("s", "when the sample could first be used"),
    "lat": Variable("rad", "measured geodetic latitude, WGS84; GNSS: of the antenna"),
    "lon": Variable("rad", "measured longitude, WGS84; GNSS: of the antenna"),
    "h": Variable("m", "measured height above the ellipsoid; GNSS: of the antenna"),
    "v_n": Variable("m/s", "velocity of the antenna over ground", ("ned",)),
    "sigma_position_n": Variable("m", "reported 1-sigma of position", ("ned",)),
    "sigma_velocity_n": Variable("m/s", "reported 1-sigma of velocity", ("ned",)),
    "fix_type": Variable(
        "1",
        "GNSS fix type, -1 where nothing was written",
        dtype="<i4",
        attributes={
            "flag_values": " ".join(str(int(f)) for f in FixType),
            "flag_meanings": " ".join(f.name.lower() for f in FixType),
        },
    ),
    "satellites": Variable("1", "satellites used, -1 where nothing was written", dtype="<i4"),
    "hdop": Variable("1", "horizontal dilution of precision"),
    "vdop": Variable("1", "vertical dilution of precision"),
    "pressure": Variable("Pa", "measured static pressure"),
    "field_b": Variable("T", "measured magnetic flux density", ("body",)),
    "eas": Variable("m/s", "measured equivalent airspeed along body x"),
    "v_b": Variable("m/s", "measured velocity over ground, NaN on axes that are not measured", ("body",)),
    "q_ib": Variable("1", "measured attitude quaternion, scalar first", ("inertial_quaternion",)),
}

ESTIMATE = {
    "lat": Variable("rad", "estimated geodetic latitude, WGS84"),
    "lon": Variable("rad", "estimated longitude, WGS84"),
    "h": Variable("m", "estimated height above the ellipsoid"),
    "v_n": Variable("m/s", "estimated velocity over ground", ("ned",)),
    "q_nb": Variable("1", "estimated attitude quaternion, scalar first", ("quaternion",)),
    "gyro_bias": Variable("rad/s", "estimated gyro bias", ("body",)),
    "accel_bias": Variable("m/s^2", "estimated accelerometer bias", ("body",)),
    "sigma_position_n": Variable("m", "1-sigma of position error", ("ned",)),
    "sigma_velocity_n": Variable("m/s", "1-sigma of velocity error", ("ned",)),
    "sigma_attitude_n": Variable("rad", "1-sigma of attitude error phi", ("ned",)),
    "sigma_gyro_bias": Variable("rad/s", "1-sigma of gyro bias", ("body",)),
    "sigma_accel_bias": Variable("m/s^2", "1-sigma of accelerometer bias", ("body",)),
    "covariance": Variable(
        "products of m, m/s, rad",
        "covariance of position, velocity and attitude error",
        ("error", "error_column"),
        "<f4",  # a dozen standard deviations would do; half the size of everything else an estimator says
    ),
    "status": Variable(
        "1",
        "what the estimator says of itself, -1 where nothing was written",
        dtype="<i4",
        attributes={
            "flag_masks": " ".join(str(int(f)) for f in Status),
            "flag_meanings": " ".join((f.name or "").lower() for f in Status),
        },
    ),
}

# The further states that estimators may carry, by name.
EXTRA = {
    "gyro_drift": Variable("rad/s", "estimated correlated part of the gyro bias", ("body",)),
    "accel_drift": Variable("m/s^2", "estimated correlated part of the accelerometer bias", ("body",)),
    "gyro_scale": Variable("1", "estimated gyro scale factor error", ("body",)),
    "accel_scale": Variable("1", "estimated accelerometer scale factor error", ("body",)),
    "gnss_position_error": Variable("m", "estimated correlated error of GNSS position", ("ned",)),
    "gnss_velocity_error": Variable("m/s", "estimated correlated error of GNSS velocity", ("ned",)),
    "barometer_bias": Variable("m", "estimated bias of pressure altitude"),
    "magnetometer_bias": Variable("T", "estimated magnetometer bias", ("body",)),
    "magnetometer_anomaly": Variable("T", "estimated error of the reference field, constant over ground", ("ned",)),
    "magnetometer_error": Variable("T", "estimated correlated error of the magnetometer", ("body",)),
    "wind": Variable("m/s", "estimated velocity of the air over ground, without gusts", ("north_east",)),
    "gust": Variable("m/s", "estimated gust beside the steady wind", ("north_east",)),
    "airspeed_scale": Variable("1", "estimated scale factor error of the airspeed sensor"),
    "body_velocity_scale": Variable("1", "estimated scale factor error of the body velocity sensor", ("body_axis",)),
    "body_velocity_error": Variable("m/s", "estimated correlated error of body velocity", ("body_axis",)),
    "mode_counter": Variable("1", "periods of low dynamics without a break"),
    "correction_counter": Variable("1", "corrections of the attitude among them"),
}


def _extra(name: str) -> Variable:
    """What a further state is; receivers have names of their own, and a local filter's may stand in front."""
    for known, variable in EXTRA.items():
        if name == known or name.endswith(("_" + known, known.removeprefix("gnss"))):
            return variable
    return Variable("unknown", "further state", (f"{name}_component",))


# Unit of the innovation of each aid, and its components.
AIDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "gnss_position": ("m", ("ned",)),
    "gnss_velocity": ("m/s", ("ned",)),
    "magnetometer": ("T", ("body",)),
    "barometer": ("m", ("component",)),
    "airspeed": ("m/s", ("component",)),
    "sideslip": ("m/s", ("component",)),
    "body_velocity": ("m/s", ("component",)),
    "nonholonomic": ("m/s", ("component",)),
    "star_attitude": ("rad", ("body",)),
    "position_fix": ("m", ("component",)),
    "gnss_course": ("rad", ("component",)),
    "level": ("m/s^2", ("north_east",)),
    "magnetic_heading": ("rad", ("component",)),
}
REPORT = {
    "sensor": Variable("", "whose sample it was", dtype="S32"),
    "nis": Variable("1", "normalised innovation squared"),
    "threshold": Variable("1", "gate for nis"),
    "weight": Variable("1", "factor on the information of the sample: 1 taken as it is, 0 rejected"),
    "reason": Variable("", "why it was refused or weakened, empty when simply fused", dtype="S64"),
}

FAULT = {
    "end": Variable("s", "when the fault ends"),
    "name": Variable("", "name of the fault", dtype="S64"),
    "sensor": Variable("", "sensor that it acts on", dtype="S64"),
    "channel": Variable("", "quantity that it acts on, empty for all", dtype="S16"),
    "kind": Variable("", "how it acts", dtype="S16"),
    "size": Variable("in unit", "its principal number as in the scenario, NaN when it has none"),
    "unit": Variable("", "unit of size", dtype="S16"),
}

REQUEST = {
    "tick": Variable("1", "number of the first row that it had to do with", dtype="<i8"),
    "kind": Variable("", "what was asked", dtype="S8"),
    "content": Variable("", "the same in full, JSON", dtype="S512"),
}

EVENT = {
    "severity": Variable("", "info, warning or error", dtype="S8"),
    "text": Variable("", "what happened", dtype="S160"),
}


def _missing(dtype: np.dtype[Any]) -> Any:
    return {"f": np.nan, "i": -1, "S": b""}[dtype.kind]


def _blank(shape: tuple[int, ...], dtype: np.dtype[Any]) -> Data:
    return np.full(shape, _missing(dtype), dtype)


@dataclass(slots=True)
class _Column:
    variable: Variable
    shape: tuple[int, ...]
    offset: int = 0  # of row 0 in the file [bytes]
    dtype: np.dtype[Any] = field(init=False)

    def __post_init__(self) -> None:
        self.dtype = np.dtype(self.variable.dtype)

    @property
    def row_bytes(self) -> int:
        return self.dtype.itemsize * int(np.prod(self.shape, dtype=int))


@dataclass(slots=True)
class _Plan:
    """What a new file is to hold of a table: rows, columns with time first, and where each begins in it [bytes]."""

    time_name: str
    capacity: int
    columns: dict[str, _Column]
    offsets: dict[str, int] = field(default_factory=dict)


Block: TypeAlias = dict[str, Data]
Pack: TypeAlias = Callable[[Sequence[Any]], tuple[Block, dict[str, Variable]]]


class _Table:
    """One group: its columns, the rows waiting to be written, and how many the file holds.

    Rows come as blocks of columns or as objects, which ``pack`` turns into a block when the table is flushed: one
    array per column is far cheaper than one store per number.
    """

    def __init__(self, pack: Pack | None = None, time_name: str = "time") -> None:
        self.time_name = time_name
        self.columns = {time_name: _Column(Variable("s", "time from the start of the run"), ())}
        self.objects: list[Any] = []
        self.blocks: list[Block] = []
        self.pending = 0
        self.written = 0
        self.capacity = 0
        self.grown = True  # has columns that the file does not have yet
        self.started = math.nan  # time of the first row
        self._pack = pack

    def add(self, block: Block, variables: Mapping[str, Variable]) -> None:
        """Append one block; columns that are new start blank in the rows before it."""
        for name, values in block.items():
            if name not in self.columns:
                self.columns[name] = _Column(variables[name], values.shape[1:])
                self.grown = True
        if math.isnan(self.started):
            self.started = float(block[self.time_name][0])
        self.blocks.append(block)
        self.pending += len(block[self.time_name])

    @property
    def rows_now(self) -> int:
        """Rows in the file and waiting."""
        return self.written + self.pending

    def rows_expected(self, t: float, duration: float) -> int:
        """Rows at the end of the run at the rate so far, with some room to spare."""
        elapsed = t - self.started
        rate = self.rows_now / elapsed if elapsed > 1.0 else self.rows_now
        expected = self.rows_now + 1.05 * rate * max(duration - t, 0.0)
        return int(max(expected, 1.25 * self.rows_now)) + SPARE_ROWS

    def pack(self) -> None:
        """Turn the waiting objects into a block."""
        if self.objects and self._pack is not None:
            self.add(*self._pack(self.objects))
            self.objects.clear()

    def rows(self, name: str) -> Data:
        """All waiting rows of one column."""
        column = self.columns[name]
        parts = [
            np.asarray(block[name], column.dtype)
            if name in block
            else _blank((len(block[self.time_name]), *column.shape), column.dtype)
            for block in self.blocks
        ]
        return np.ascontiguousarray(parts[0] if len(parts) == 1 else np.concatenate(parts))

    def order(self) -> Iterator[str]:
        """Column names, time last: a finite time says that the rest of its row is there."""
        yield from (name for name in self.columns if name != self.time_name)
        yield self.time_name


def _scalars(objects: Sequence[Any], name: str, dtype: str = "<f8") -> Data:
    return np.array(list(map(attrgetter(name), objects)), dtype)


def _vectors(objects: Sequence[Any], name: str) -> Data:
    parts = list(map(attrgetter(name), objects))
    return np.concatenate(parts).reshape(len(parts), *parts[0].shape)


def _text(values: Sequence[str], dtype: str) -> Data:
    width = np.dtype(dtype).itemsize
    result = np.zeros(len(values), dtype)
    for k, value in enumerate(values):
        if value:  # most reports have no reason
            # Cut by whole characters, so that no half of one is left.
            result[k] = value.encode()[:width].decode(errors="ignore").encode()
    return result


def _pack_samples(samples: Sequence[Sample]) -> tuple[Block, dict[str, Variable]]:
    block: Block = {"time": _scalars(samples, "t")}
    for f in fields(samples[0]):
        if f.name in ("t", "sensor"):
            continue
        variable = SAMPLE[f.name]
        block[f.name] = _vectors(samples, f.name) if variable.dims else _scalars(samples, f.name, variable.dtype)
    return block, SAMPLE


def _pack_reports(aid: str, reports: Sequence[UpdateReport]) -> tuple[Block, dict[str, Variable]]:
    block: Block = {"sample_time": _scalars(reports, "t")}
    variables = dict(REPORT)
    sizes = {len(r.innovation) for r in reports}
    m = max(sizes)
    if m:
        unit, dims = AIDS.get(aid, ("unknown", ("component",)))
        variables["innovation"] = Variable(unit, "measurement - prediction", dims)
        variables["S"] = Variable(
            f"({unit})^2", "innovation covariance before the update", ("component", "component_column")
        )
        if sizes == {m}:
            block["innovation"], block["S"] = _vectors(reports, "innovation"), _vectors(reports, "S")
        else:  # broken samples are refused before an innovation is formed
            block["innovation"] = np.full((len(reports), m), np.nan)
            block["S"] = np.full((len(reports), m, m), np.nan)
            for k, report in enumerate(reports):
                if len(report.innovation) == m:
                    block["innovation"][k], block["S"][k] = report.innovation, report.S
    for name in ("nis", "threshold", "weight"):
        block[name] = _scalars(reports, name)
    sensors = {r.sensor for r in reports}
    names = sensors if len(sensors) == 1 else [r.sensor for r in reports]
    block["sensor"] = np.resize(_text(list(names), REPORT["sensor"].dtype), len(reports))
    block["reason"] = _text([r.reason for r in reports], REPORT["reason"].dtype)
    return block, variables


def _pack_estimates(estimates: Sequence[Estimate]) -> tuple[Block, dict[str, Variable]]:
    block: Block = {"time": _scalars(estimates, "t")}
    variables = dict(ESTIMATE)
    for name in ("lat", "lon", "h", "status"):
        block[name] = _scalars(estimates, name, ESTIMATE[name].dtype)
    for name in ("v_n", "q_nb", "gyro_bias", "accel_bias", "sigma_gyro_bias", "sigma_accel_bias", "covariance"):
        block[name] = _vectors(estimates, name)
    sigma = np.sqrt(np.maximum(np.diagonal(block["covariance"], axis1=1, axis2=2), 0.0))  # nan stays nan
    for k, name in enumerate(("sigma_position_n", "sigma_velocity_n", "sigma_attitude_n")):
        block[name] = sigma[:, 3 * k : 3 * k + 3]
    for name in dict.fromkeys(key for e in estimates for key in e.extra):
        width = next(len(e.extra[name][0]) for e in estimates if name in e.extra)
        variable = _extra(name)
        blank = (np.full(width, np.nan), np.full(width, np.nan))
        pairs = [e.extra.get(name, blank) for e in estimates]
        for k, column in enumerate((name, f"sigma_{name}")):
            values = np.concatenate([pair[k] for pair in pairs]).reshape(len(pairs), width)
            block[column] = values if variable.dims else values[:, 0]
            variables[column] = variable if k == 0 else replace(variable, meaning=f"1-sigma of {name}")
    return block, variables


def _pack_faults(faults: Sequence[FaultTruth]) -> tuple[Block, dict[str, Variable]]:
    block: Block = {"time": _scalars(faults, "start")}
    for name, variable in FAULT.items():
        text = variable.dtype.startswith("S")
        block[name] = _text([getattr(f, name) for f in faults], variable.dtype) if text else _scalars(faults, name)
    return block, FAULT


def _pack_requests(requests: Sequence[tuple[float, int, str, str]]) -> tuple[Block, dict[str, Variable]]:
    times, ticks, kinds, contents = zip(*requests, strict=True)
    block: Block = {
        "time": np.array(times),
        "tick": np.array(ticks, REQUEST["tick"].dtype),
        "kind": _text(kinds, REQUEST["kind"].dtype),
        "content": _text(contents, REQUEST["content"].dtype),
    }
    return block, REQUEST


def _pack_events(events: Sequence[tuple[float, str, str]]) -> tuple[Block, dict[str, Variable]]:
    block: Block = {
        "time": np.array([e[0] for e in events]),
        "severity": _text([e[1] for e in events], EVENT["severity"].dtype),
        "text": _text([e[2] for e in events], EVENT["text"].dtype),
    }
    return block, EVENT


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
            "scenario_path": str(scenario.path or ""),
            "overrides": json.dumps(scenario.overrides),
            "seed": seed,
            "duration_s": float(scenario.duration_s),
            "record_rate_hz": float(scenario.record.rate_hz),
            "versions": json.dumps(versions()),
            "estimated_point_b_m": json.dumps(
                {own.name: cast("ImuConfig", scenario.sensors[own.imu]).lever_arm_m for own in scenario.estimator}
            ),
            "estimator_imus": json.dumps({own.name: own.imu for own in scenario.estimator}),
            "error_convention": "error = estimate - truth; C_nb_hat = (I - [phi x]) C_nb; position error in metres NED",
            "complete": 0,
        }
        self._duration = float(scenario.duration_s)
        self._record_imu = scenario.record.imu
        self._every = round(scenario.truth.rate_hz / scenario.record.rate_hz)
        self._tables: dict[str, _Table] = {}
        self._increments = np.zeros((0, 6))  # dtheta and dv of the ticks since the last recorded row
        self._t = 0.0
        self._last_flush = time.monotonic()
        self._tended = False
        self._file: BinaryIO | None = None
        self._laying: Iterator[None] | None = None  # the next file in the making
        if path is not None:
            _check_writable(path)

    def truth(self, block: TruthBlock) -> None:
        """Take full-rate rows; every n-th is recorded, with the increments summed since the one before."""
        if len(block):
            self._record_truth(block)
            self._t = float(block.t[-1])
        for table in self._tables.values():
            if len(table.objects) >= PACK_ROWS:
                table.pack()
        if time.monotonic() - self._last_flush >= (UNTENDED_S if self._tended else FLUSH_WALL_S):
            self.flush()

    def imu(self, name: str, samples: ImuSamples) -> None:
        """Take inertial increments at their full rate, if the scenario records them."""
        if self._record_imu and len(samples):
            block = {"time": samples.t, "dt": samples.dt, "dtheta": samples.dtheta, "dv": samples.dv}
            self._table(f"sensors/{name}").add(block, IMU)

    def samples(self, name: str, samples: Sequence[Sample]) -> None:
        """Take aiding samples as delivered."""
        if samples:
            self._table(f"sensors/{name}", _pack_samples).objects.extend(samples)

    def estimate(self, name: str, estimate: Estimate) -> None:
        """Take one estimate."""
        self._table(f"estimators/{name}", _pack_estimates).objects.append(estimate)

    def reports(self, name: str, reports: Sequence[UpdateReport]) -> None:
        """Take what became of aiding samples, one group per aid."""
        for report in reports:
            path = f"estimators/{name}/innovations/{report.aid}"
            table = self._tables.get(path) or self._table(path, partial(_pack_reports, report.aid), "sample_time")
            table.objects.append(report)

    def faults(self, faults: Sequence[FaultTruth]) -> None:
        """Note what is going to go wrong."""
        if faults:
            self._table("faults", _pack_faults).objects.extend(faults)

    def request(self, t: float, tick: int, kind: str, content: str) -> None:
        """Note what somebody asked of the run, at once if there is a file: a run that is killed can be repeated."""
        self._table("requests", _pack_requests).objects.append((t, tick, kind, content))
        if self._tended:
            self._last_flush = -math.inf
        elif "truth" in self._tables:  # a run without rows leaves no file
            self.flush()

    def event(self, t: float, severity: str, text: str) -> None:
        """Note that something happened; severity is info, warning or error."""
        self._table("events", _pack_events).objects.append((t, severity, text))

    def flush(self) -> None:
        """Make every row taken so far part of the file; in memory, only pack it."""
        self._pack()
        if self.path is not None and (self._laying or any(table.pending for table in self._tables.values())):
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
        try:
            self.flush()
            if self._file is not None:
                self.attributes["complete"] = 1
                self._laying = self._lay_out(final=True)
                self._guard(self._write)
        finally:
            if self._file is not None:
                self._file.close()
                self._file = None

    def dataset(self) -> xarray.DataTree:
        """Everything recorded so far, equal to `load` of the file."""
        self.flush()
        if self.path is not None and self.path.exists():
            return load(self.path)
        columns = {
            path: {name: (c.variable, table.rows(name)) for name, c in table.columns.items()}
            for path, table in self._tables.items()
        }
        return _tree(columns, self.attributes)

    def _table(self, path: str, pack: Pack | None = None, time_name: str = "time") -> _Table:
        table = self._tables.get(path)
        if table is None:
            table = self._tables[path] = _Table(pack, time_name)
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
                self._file.seek(column.offset + table.written * column.row_bytes)
                self._file.write(table.rows(name).data.cast("B"))
            table.written += table.pending
            table.pending = 0
            table.blocks.clear()

    def _lay_piece(self) -> None:
        assert self._laying is not None
        if next(self._laying, self) is self:
            self._laying = None

    def _lay_out(self, final: bool = False) -> Iterator[None]:
        """Write a new file with the room that is needed, piece by piece, and put it in place of the old one.

        Rows may come meanwhile, and columns; these wait for the next file.
        """
        assert self.path is not None
        plans = {
            path: _Plan(
                table.time_name,
                table.rows_now if final else table.rows_expected(self._t, self._duration),
                dict(table.columns),
            )
            for path, table in self._tables.items()
        }
        yield from _create(_part(self.path), plans, dict(self.attributes), blank=not final)
        new = _part(self.path).open("r+b", buffering=0)
        if self._file is not None:
            for path, plan in plans.items():
                written = self._tables[path].written
                for name in reversed(plan.columns) if written else ():
                    column = plan.columns[name]
                    if column.offset:
                        yield from _copy(self._file, column.offset, new, plan.offsets[name], written * column.row_bytes)
                    else:
                        new.seek(plan.offsets[name])
                        new.write(_blank((written, *column.shape), column.dtype).data.cast("B"))
            self._file.close()
        self._file = new
        for path, plan in plans.items():
            table = self._tables[path]
            table.capacity, table.grown = plan.capacity, len(table.columns) > len(plan.columns)
            for name, column in plan.columns.items():
                column.offset = plan.offsets[name]
        self._write_rows()
        os.replace(_part(self.path), self.path)

    def _guard(self, write: Callable[[], None]) -> None:
        """Turn a full disk and the like into a message; what the file held before stays."""
        assert self.path is not None
        try:
            write()
        except OSError as error:
            _part(self.path).unlink(missing_ok=True)
            raise UserError(f"{self.path}: can't write the record ({error.strerror or error})") from error


def _part(path: Path) -> Path:
    """Where the next version of a file is made."""
    return path.with_name(f".{path.name}.part")


def _copy(source: BinaryIO, start: int, target: BinaryIO, at: int, count: int) -> Iterator[None]:
    source.seek(start)
    target.seek(at)
    while count:
        chunk = source.read(min(count, 1 << 20))
        target.write(chunk)
        count -= len(chunk)
        yield


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


# -- HDF5 ---------------------------------------------------------------------------------------------------------


class _Attributes:
    """Writes string and number attributes through the low-level interface: ten times faster than the high-level one."""

    def __init__(self) -> None:
        from h5py import h5s

        self._scalar = h5s.create(h5s.SCALAR)

    def text(self, where: Any, name: str, value: str) -> None:
        from h5py import h5a, h5t

        raw = value.encode()
        kind = h5t.C_S1.copy()
        kind.set_size(max(len(raw), 1))
        kind.set_cset(h5t.CSET_UTF8)
        h5a.create(where, name.encode(), kind, self._scalar).write(np.array(raw, f"S{max(len(raw), 1)}"), mtype=kind)


def _create(
    path: Path, plans: Mapping[str, _Plan], attributes: Mapping[str, str | int | float], blank: bool
) -> Iterator[None]:
    """Write the structure of a record with all its space allocated, and note where each column's rows go.

    ``blank`` marks all rows as not written; without, every row is about to be. Yields between small pieces of work.
    """
    import h5py
    from h5py import h5d, h5ds, h5p, h5s, h5t

    note = _Attributes()
    with h5py.File(path, "w", libver=("earliest", "v110"), track_order=True) as file:
        for name, value in attributes.items():
            file.attrs[name] = value
        for group_path, plan in plans.items():
            group = _group(file, group_path)
            local: dict[str, Any] = {}
            for name, column in plan.columns.items():
                dtype = column.dtype
                text = dtype.kind == "S"
                layout = h5p.create(h5p.DATASET_CREATE)
                layout.set_alloc_time(h5d.ALLOC_TIME_EARLY)
                layout.set_obj_track_times(False)  # the same run gives the same bytes
                if blank and name == plan.time_name:
                    layout.set_fill_value(np.array(np.nan))
                else:
                    layout.set_fill_time(h5d.FILL_TIME_NEVER)  # room costs nothing until it is written
                shape = (plan.capacity, *column.shape, *((dtype.itemsize,) if text else ()))
                stored = h5t.py_create(np.dtype("S1") if text else dtype)
                dataset = h5d.create(group.id, name.encode(), stored, h5s.create_simple(shape), layout)
                dims = (*column.variable.dims, *((f"characters_{dtype.itemsize}",) if text else ()))
                if name == plan.time_name:
                    h5ds.set_scale(dataset, name.encode())
                    local[name] = dataset
                    note.text(dataset, "standard_name", "time")
                    note.text(dataset, "axis", "T")
                else:
                    h5ds.attach_scale(dataset, local[plan.time_name], 0)
                for k, dim in enumerate(dims, start=1):
                    if dim not in local:
                        local[dim] = _labels(group, dim) if dim in AXES else _bare_dimension(group, dim, shape[k])
                    h5ds.attach_scale(dataset, local[dim], k)
                for key, value in _attributes(column.variable).items():
                    note.text(dataset, key, value)
                if text:
                    note.text(dataset, "_Encoding", "utf-8")
                plan.offsets[name] = dataset.get_offset()
                yield


def _group(file: h5py.File, path: str) -> h5py.Group:
    """Make a group and those above it, each listing its members in the order in which they were made."""
    group = file
    for part in path.split("/"):
        group = group[part] if part in group else group.create_group(part, track_order=True)
    return group


def _labels(group: h5py.Group, name: str) -> Any:
    """A dimension whose components have names."""
    import h5py

    labels = group.create_dataset(name, data=list(AXES[name]), dtype=h5py.string_dtype())
    labels.make_scale(name)
    return labels.id


def _bare_dimension(group: h5py.Group, name: str, size: int) -> Any:
    """A netCDF-4 dimension without coordinate values."""
    from h5py import h5d, h5ds, h5p, h5s, h5t

    layout = h5p.create(h5p.DATASET_CREATE)
    layout.set_obj_track_times(False)
    scale = h5d.create(group.id, name.encode(), h5t.IEEE_F32BE, h5s.create_simple((size,)), layout)
    h5ds.set_scale(scale, f"This is a netCDF dimension but not a netCDF variable.{size:10d}".encode())
    return scale


def _attributes(variable: Variable) -> dict[str, str]:
    pairs = {"units": variable.unit, "long_name": variable.meaning, "frame": variable.frame, **variable.attributes}
    return {key: value for key, value in pairs.items() if value}


def load(path: Path) -> xarray.DataTree:
    """Read a record. A run that was killed gives the rows of its last flush, and the attribute ``complete`` is 0.

    Raises UserError when the file is missing, damaged or no record.
    """
    import h5py

    if not path.exists():
        raise UserError(f"{path}: no such file; `testbed run` writes run.nc into its --out folder")
    if path.is_dir():
        raise UserError(f"{path}: is a folder; give the record in it, such as {path / 'run.nc'}")
    if not h5py.is_hdf5(path):
        raise UserError(f"{path}: not a record of a run (not netCDF-4/HDF5)")
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT:
                raise UserError(f"{path}: netCDF-4/HDF5, but not a record of a run of this version ({FORMAT!r})")
            columns: dict[str, dict[str, tuple[Variable, Data]]] = {}
            _read_group(file, "", columns)
            attributes = {name: _plain(value) for name, value in file.attrs.items()}
        return _tree(columns, attributes)
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise UserError(f"{path}: damaged record ({error}); run the scenario again") from error


def _plain(value: Any) -> Any:
    if isinstance(value, bytes):
        return value.decode()
    return value.item() if isinstance(value, np.generic) else value


def _read_group(group: h5py.Group, path: str, found: dict[str, dict[str, tuple[Variable, Data]]]) -> None:
    import h5py

    time_name = next((name for name in ("time", "sample_time") if name in group), None)
    if time_name is not None:
        written = np.flatnonzero(np.isfinite(group[time_name][()]))
        rows = int(written[-1]) + 1 if len(written) else 0
        found[path] = {
            name: _read_column(item, rows)
            for name, item in group.items()
            if isinstance(item, h5py.Dataset) and "long_name" in item.attrs
        }
    for name, item in group.items():
        if isinstance(item, h5py.Group):
            _read_group(item, f"{path}/{name}".lstrip("/"), found)


def _read_column(dataset: h5py.Dataset, rows: int) -> tuple[Variable, Data]:
    attributes = {
        name: _plain(dataset.attrs[name])
        for name in ("units", "long_name", "flag_values", "flag_masks", "flag_meanings")
        if name in dataset.attrs
    }
    dims = tuple(Path(dataset.dims[k][0].name).name for k in range(1, dataset.ndim))
    values = dataset[:rows]
    if values.dtype.kind == "S":
        values = values.view(f"S{values.shape[1]}")[:, 0]
        dims = dims[:-1]
    variable = Variable(attributes.pop("units", ""), attributes.pop("long_name"), dims, values.dtype.str, attributes)
    return variable, values


def _tree(
    columns: Mapping[str, Mapping[str, tuple[Variable, Data]]], attributes: Mapping[str, str | int | float]
) -> xarray.DataTree:
    import xarray

    nodes = {"/": xarray.Dataset(attrs=dict(attributes))}
    for path, group in columns.items():
        time_name = "sample_time" if "sample_time" in group else "time"
        nodes[path] = xarray.Dataset(
            {
                name: (
                    (time_name, *variable.dims),
                    np.char.decode(values, "utf-8") if values.dtype.kind == "S" else values,
                    _attributes(variable),
                )
                for name, (variable, values) in group.items()
            }
        ).set_coords(time_name)
        labels = {str(dim): list(AXES[str(dim)]) for dim in nodes[path].dims if dim in AXES}
        nodes[path] = nodes[path].assign_coords(labels)
    return xarray.DataTree.from_dict(nodes)
