"""The HDF5 structure of a record, as netCDF-4 wants it."""

from __future__ import annotations

import functools
import os
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.record.columns import AXES
from testbed.record.tables import Column, Data

if TYPE_CHECKING:
    import h5py


# What is noise beyond its first digits hardly gets smaller: of 88 MB of the main scenario, compressing what is halved
# at least saves 28 for 0.07 s of a core; all of it 40, for 2.3 s.
GZIP_LEVEL = 1
CHUNK_BYTES = 1 << 18
TRIAL_BYTES = 1 << 11
SMALL_BYTES = 1 << 12
COLUMN_BYTES = 1 << 12  # of the structure for each column, at most


@dataclass(slots=True)
class Plan:
    """What a new file is to hold of a table: rows, columns with time first, and where each begins in it [bytes]."""

    time_name: str
    capacity: int
    columns: dict[str, Column]
    offsets: dict[str, int] = field(default_factory=dict)


def create(
    path: Path,
    plans: Mapping[str, Plan],
    attributes: Mapping[str, str | int | float],
    contents: Callable[[str, str], Data] | None = None,
) -> Iterator[None]:
    """Write a record in small pieces of work, between which it yields.

    Without ``contents`` there is room for all rows, none counts as written, and the plans are told where each column's
    rows go. With, the rows that it gives for a group and a column are written, compressed where that is worth it.
    """
    import h5py

    reserve(path, plans, attributes)
    with h5py.File(path, "w", libver=("earliest", "v110"), track_order=True) as file:
        for name, value in attributes.items():
            file.attrs[name] = value
        for group_path, plan in plans.items():
            group = _group(file, group_path)
            scales: dict[str, Any] = {}  # of this group, by dimension
            for name, column in plan.columns.items():
                values = None if contents is None else contents(group_path, name)
                dataset = _dataset(group, plan, name, values)
                _describe(group, dataset, plan.time_name, name, column, scales)
                if values is None:
                    plan.offsets[name] = dataset.get_offset()
                yield


def reserve(path: Path, plans: Mapping[str, Plan], attributes: Mapping[str, str | int | float]) -> None:
    """Raise OSError when there is no room for the file and all its rows.

    HDF5 must not meet the end of the disk itself: what it can't write when it closes a file ends the process.
    """
    columns = [plan.capacity * column.row_bytes for plan in plans.values() for column in plan.columns.values()]
    structure = COLUMN_BYTES * (len(columns) + 16) + sum(len(str(value)) for value in attributes.values())
    with path.open("wb") as file:
        os.ftruncate(file.fileno(), structure + sum(columns))
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, structure + sum(columns))


def _dataset(group: h5py.Group, plan: Plan, name: str, values: Data | None) -> Any:
    """The dataset of one column, at the low-level interface: ten times faster than the high-level one."""
    from h5py import h5d, h5p, h5s, h5t

    column = plan.columns[name]
    text = column.dtype.kind == "S"
    shape = (plan.capacity, *column.shape, *((column.dtype.itemsize,) if text else ()))
    layout = h5p.create(h5p.DATASET_CREATE)
    layout.set_obj_track_times(False)  # the same run gives the same bytes
    if values is None and name == plan.time_name:
        layout.set_fill_value(np.array(np.nan))
    else:
        layout.set_fill_time(h5d.FILL_TIME_NEVER)  # room costs nothing until it is written
    if values is not None and _compressible(values):
        layout.set_chunk((min(plan.capacity, max(1, CHUNK_BYTES // column.row_bytes)), *shape[1:]))
        layout.set_shuffle()
        layout.set_deflate(GZIP_LEVEL)
    else:
        layout.set_alloc_time(h5d.ALLOC_TIME_EARLY)
    stored = h5t.py_create(np.dtype("S1") if text else column.dtype)
    dataset = h5d.create(group.id, name.encode(), stored, h5s.create_simple(shape), layout)
    if values is not None:
        dataset.write(h5s.ALL, h5s.ALL, values.view("S1").reshape(shape) if text else values)
    return dataset


def _compressible(values: Data) -> bool:
    """Whether compressing a column halves it, judged by three pieces of it: not its ends, where runs are unlike."""
    if values.nbytes < SMALL_BYTES:
        return False
    flat = values.reshape(-1)
    size = max(1, min(len(flat), TRIAL_BYTES // flat.itemsize))
    starts = [quarters * (len(flat) - size) // 4 for quarters in (1, 2, 3)]
    trials = [flat[k : k + size].view(np.uint8).reshape(size, flat.itemsize).T.tobytes() for k in starts]
    return sum(len(zlib.compress(trial, GZIP_LEVEL)) for trial in trials) < 0.5 * sum(map(len, trials))


def _describe(
    group: h5py.Group, dataset: Any, time_name: str, name: str, column: Column, scales: dict[str, Any]
) -> None:
    """Give a column its dimensions and attributes."""
    from h5py import h5ds

    text = column.dtype.kind == "S"
    dims = (*column.variable.dims, *((f"characters_{column.dtype.itemsize}",) if text else ()))
    labels = column.variable.labels
    if name == time_name:
        h5ds.set_scale(dataset, name.encode())
        scales[name] = dataset
        labels = {"standard_name": "time", "axis": "T"} | labels
    else:
        h5ds.attach_scale(dataset, scales[time_name], 0)
    for k, dim in enumerate(dims, start=1):
        if dim not in scales:
            scales[dim] = _labels(group, dim) if dim in AXES else _bare_dimension(group, dim, dataset.shape[k])
        h5ds.attach_scale(dataset, scales[dim], k)
    if text:
        labels = labels | {"_Encoding": "utf-8"}
    for key, value in labels.items():
        _attribute(dataset, key, value)


def _attribute(where: Any, name: str, value: str) -> None:
    from h5py import h5a, h5s

    raw = np.array(value.encode())
    kind = _text(max(raw.itemsize, 1))
    h5a.create(where, name.encode(), kind, h5s.create(h5s.SCALAR)).write(raw, mtype=kind)


@functools.cache
def _text(size: int) -> Any:
    """The type of a text of so many bytes."""
    from h5py import h5t

    kind = h5t.C_S1.copy()
    kind.set_size(size)
    kind.set_cset(h5t.CSET_UTF8)
    return kind


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
