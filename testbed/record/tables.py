"""Rows on their way into a record: objects are gathered and packed into columns, one array for each."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import Field, dataclass, field, fields, replace
from operator import attrgetter
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from nav.columns import VECTORS, Estimates, FusedReports, Samples
from nav.samples import Outcome, Sample, UpdateReport
from testbed import interrupts
from testbed.record.columns import (
    AXES,
    ESTIMATE,
    EVENT,
    FAULT,
    INNOVATIONS,
    REPORT,
    REQUEST,
    SAMPLE,
    STEERED,
    Variable,
    extra_state,
)

if TYPE_CHECKING:
    from testbed.sensors.faults import FaultTruth

Data: TypeAlias = npt.NDArray[Any]

FLOAT = np.dtype(float)

SPARE_ROWS = 64  # room made for a table beyond what its rate so far asks for


def _missing(dtype: np.dtype[Any]) -> Any:
    return {"f": np.nan, "i": -1, "S": b""}[dtype.kind]


def blank(shape: tuple[int, ...], dtype: np.dtype[Any]) -> Data:
    """Rows in which nothing was recorded."""
    return np.full(shape, _missing(dtype), dtype)


@dataclass(slots=True)
class Column:
    """One column: what it is, the shape of a row, where it lies."""

    variable: Variable
    shape: tuple[int, ...]
    offset: int = 0  # of row 0 in the file [bytes]
    dtype: np.dtype[Any] = field(init=False)

    def __post_init__(self) -> None:
        self.dtype = np.dtype(self.variable.dtype)

    @property
    def row_bytes(self) -> int:
        """Size of one row."""
        return self.dtype.itemsize * math.prod(self.shape)


Block: TypeAlias = dict[str, Data]
Pack: TypeAlias = Callable[[Sequence[Any]], tuple[Block, dict[str, Variable]]]


class Table:
    """One group: its columns, the rows waiting to be written, and how many the file holds.

    Rows come as blocks of columns or as objects, which ``pack`` turns into a block when the table is flushed: one
    array per column is far cheaper than one store per number.
    """

    def __init__(self, pack: Pack | None = None, time_name: str = "time") -> None:
        self.time_name = time_name
        self.columns = {time_name: Column(Variable("s", "time from the start of the run"), ())}
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
                self.columns[name] = Column(variables[name], values.shape[1:])
                self.grown = True
        if math.isnan(self.started):
            self.started = float(block[self.time_name][0])
        with interrupts.held():
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
            with interrupts.held():
                self.add(*self._pack(self.objects))
                self.objects.clear()

    def rows(self, name: str) -> Data:
        """All waiting rows of one column."""
        column = self.columns[name]
        if not self.blocks:
            return np.empty((0, *column.shape), column.dtype)
        with np.errstate(over="ignore", invalid="ignore"):  # what has diverged is inf in single precision
            parts = [
                np.asarray(block[name], column.dtype)
                if name in block
                else blank((len(block[self.time_name]), *column.shape), column.dtype)
                for block in self.blocks
            ]
        return np.ascontiguousarray(parts[0] if len(parts) == 1 else np.concatenate(parts))

    def count_written(self) -> None:
        """Take the waiting rows for written."""
        self.written += self.pending
        self.pending = 0
        self.blocks.clear()

    def order(self) -> Iterator[str]:
        """Column names, time last: a finite time says that the rest of its row is there."""
        yield from (name for name in self.columns if name != self.time_name)
        yield self.time_name


def _scalars(objects: Sequence[Any], name: str, dtype: str = "<f8") -> Data:
    return np.fromiter(map(attrgetter(name), objects), dtype, len(objects))


def _vectors(objects: Sequence[Any], name: str) -> Data:
    return _joined(list(map(attrgetter(name), objects)))


def _joined(parts: Sequence[Any]) -> Data:
    """Arrays of one shape as the rows of one.

    Arrays of numbers as they are recorded are joined as bytes, which takes a fifth of the time of `numpy.concatenate`.
    """
    shape = (len(parts), *parts[0].shape)
    if set(map(attrgetter("dtype"), parts)) == {FLOAT}:
        with suppress(TypeError):  # an array of the user's may be part of a larger one, and have gaps
            return np.frombuffer(bytearray().join(parts)).reshape(shape)
    return np.concatenate(parts).reshape(shape)


def _text(values: Sequence[str], dtype: str) -> Data:
    width = np.dtype(dtype).itemsize
    result = np.zeros(len(values), dtype)
    for k, value in enumerate(values):
        if value:  # most reports have no reason
            # Cut by whole characters, so that no half of one is left.
            result[k] = value.encode()[:width].decode(errors="ignore").encode()
    return result


def pack_samples(samples: Sequence[Sample]) -> tuple[Block, dict[str, Variable]]:
    """Samples of one sensor."""
    block: Block = {"time": _scalars(samples, "t")}
    variables = dict(SAMPLE)
    sizes: dict[str, int] = {}
    for f in fields(samples[0]):
        if f.name in ("t", "sensor"):
            continue
        shape = np.shape(getattr(samples[0], f.name))
        if f.name not in SAMPLE or shape != tuple(len(AXES[dim]) for dim in SAMPLE[f.name].dims):
            variables[f.name] = _own(f, shape, sizes)  # the user's may call another thing as ours
        variable = variables[f.name]
        block[f.name] = _vectors(samples, f.name) if variable.dims else _scalars(samples, f.name, variable.dtype)
    return block, variables


def sample_columns(samples: Samples) -> tuple[Block, Mapping[str, Variable]]:
    """Many samples of one sensor."""
    return {"time": samples.t} | {name: x for name, x in samples.columns.items() if name != "t"}, SAMPLE


def _own(f: Field[Any], shape: tuple[int, ...], sizes: dict[str, int]) -> Variable:
    """A number of a sample of the user's, or several: unit and meaning from its metadata.

    ``sizes`` has those of the dimensions that the numbers before it have.
    """
    unit, meaning = (str(f.metadata.get(key, "unknown")) for key in ("unit", "meaning"))
    if not shape:
        return Variable(unit, meaning)
    alike = sizes.setdefault("component", shape[0]) == shape[0]
    return Variable(unit, meaning, ("component" if alike else f"{f.name}_component",))


def pack_reports(aid: str, reports: Sequence[UpdateReport]) -> tuple[Block, dict[str, Variable]]:
    """What became of the samples of one aid."""
    block: Block = {"sample_time": _scalars(reports, "t")}
    variables = dict(REPORT)
    innovations = list(map(attrgetter("innovation"), reports))
    sizes = set(map(len, innovations))
    m = max(sizes)
    if m:
        variables |= _innovation(aid, m)
        if sizes == {m}:
            block["innovation"], block["S"] = _joined(innovations), _vectors(reports, "S")
        else:  # broken samples are refused before an innovation is formed
            block["innovation"] = np.full((len(reports), m), np.nan)
            block["S"] = np.full((len(reports), m, m), np.nan)
            for k, report in enumerate(reports):
                if len(report.innovation) == m:
                    block["innovation"][k], block["S"][k] = report.innovation, report.S
    for name in ("nis", "threshold", "weight"):
        block[name] = _scalars(reports, name)
    block["outcome"] = _scalars(reports, "outcome", REPORT["outcome"].dtype)
    sensors = list(map(attrgetter("sensor"), reports))
    names = set(sensors)
    block["sensor"] = np.resize(_text([*names] if len(names) == 1 else sensors, REPORT["sensor"].dtype), len(reports))
    block["reason"] = _text(list(map(attrgetter("reason"), reports)), REPORT["reason"].dtype)
    return block, variables


def fused_columns(reports: FusedReports) -> tuple[Block, dict[str, Variable]]:
    """Reports of one kind."""
    ((sensor, aid, m),) = reports.kinds
    block: Block = {"sample_time": reports.t, "nis": reports.nis, "threshold": reports.threshold}
    block["innovation"], block["S"] = reports.innovation, reports.S.reshape(-1, m, m)
    for name, value in (("weight", 1.0), ("outcome", Outcome.FUSED), ("sensor", sensor.encode())):
        block[name] = np.full(len(reports), value, REPORT[name].dtype)
    block["reason"] = np.zeros(len(reports), REPORT["reason"].dtype)
    return block, REPORT | _innovation(aid, m)


def _innovation(aid: str, m: int) -> dict[str, Variable]:
    """What an innovation of an aid with m components is, and its covariance."""
    unit, dims = INNOVATIONS.get(aid, ("unknown", ("component",)))
    if len(AXES.get(dims[0], range(m))) != m:  # an estimator of the user's may call another thing so
        unit, dims = "unknown", ("component",)
    return {
        "innovation": Variable(unit, "measurement - prediction", dims),
        "S": Variable(f"({unit})^2", "innovation covariance before the update", ("component", "component_column")),
    }


def estimate_columns(estimates: Estimates) -> tuple[Block, dict[str, Variable]]:
    """Estimates of one estimator."""
    block: Block = {"time": estimates.t}
    variables = dict(ESTIMATE)
    for name in ("lat", "lon", "h", "status", *VECTORS):
        block[name] = getattr(estimates, name)
    sigma = np.sqrt(np.maximum(np.diagonal(estimates.covariance, axis1=1, axis2=2), 0.0))  # nan stays nan
    for k, name in enumerate(("sigma_position_n", "sigma_velocity_n", "sigma_attitude_n")):
        block[name] = sigma[:, 3 * k : 3 * k + 3]
    for name, pair in estimates.extra.items():
        variable = extra_state(name, pair[0].shape[1])
        for column, values in zip((name, f"sigma_{name}"), pair, strict=True):
            block[column] = values if variable.dims else values[:, 0]
            variables[column] = variable if column == name else replace(variable, meaning=f"1-sigma of {name}")
    return block, variables


def pack_faults(faults: Sequence[FaultTruth]) -> tuple[Block, dict[str, Variable]]:
    """What is made to go wrong."""
    block: Block = {"time": _scalars(faults, "start")}
    for name, variable in FAULT.items():
        text = variable.dtype.startswith("S")
        block[name] = _text([getattr(f, name) for f in faults], variable.dtype) if text else _scalars(faults, name)
    return block, FAULT


def pack_steered(steps: Sequence[tuple[float, Sequence[float] | None]]) -> tuple[Block, dict[str, Variable]]:
    """Steps of a far end that is to fly: time, and the surfaces that it commands, None while it does not."""
    unknown = (math.nan,) * 4
    block: Block = {
        "time": np.array([t for t, _ in steps]),
        "surfaces": np.array([unknown if surfaces is None else surfaces for _, surfaces in steps]),
        "flies": np.array([surfaces is not None for _, surfaces in steps], STEERED["flies"].dtype),
    }
    return block, STEERED


def pack_requests(requests: Sequence[tuple[float, int, str, str]]) -> tuple[Block, dict[str, Variable]]:
    """Requests: time, tick, kind, content."""
    times, ticks, kinds, contents = zip(*requests, strict=True)
    block: Block = {
        "time": np.array(times),
        "tick": np.array(ticks, REQUEST["tick"].dtype),
        "kind": _text(kinds, REQUEST["kind"].dtype),
        "content": _text(contents, REQUEST["content"].dtype),
    }
    return block, REQUEST


def pack_events(events: Sequence[tuple[float, str, str]]) -> tuple[Block, dict[str, Variable]]:
    """Events: time, severity, text."""
    block: Block = {
        "time": np.array([e[0] for e in events]),
        "severity": _text([e[1] for e in events], EVENT["severity"].dtype),
        "text": _text([e[2] for e in events], EVENT["text"].dtype),
    }
    return block, EVENT
