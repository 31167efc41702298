"""A record turned into CSV or MATLAB, units kept."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.errors import UserError
from testbed.record.recorder import AXES, load

if TYPE_CHECKING:
    import xarray


def export(run_file: Path, format: str, out: Path | None = None) -> Path:
    """Write a record as ``csv`` or ``mat`` and return where.

    CSV: a folder (``<run>_csv`` beside the record unless ``out`` says otherwise) with one file per group, such as
    ``estimators.ins.csv``, and the unit of each column in its header: ``v_n.north [m/s]``. MATLAB: one file with a
    struct per group, in it one array per variable and the struct ``units`` with the same fields. Raises UserError
    when the record can't be read or the target not be written.
    """
    tree = load(run_file)
    write, default = {
        "csv": (_write_csv, run_file.with_name(f"{run_file.stem}_csv")),
        "mat": (_write_mat, run_file.with_suffix(".mat")),
    }[format]
    target = default if out is None else out
    try:
        write(tree, target)
    except OSError as error:
        raise UserError(f"{target}: can't be written ({error.strerror or error}); choose another place") from error
    return target


def _groups(tree: xarray.DataTree) -> Iterator[tuple[list[str], xarray.Dataset]]:
    for node in tree.subtree:
        dataset = node.to_dataset(inherit=False)
        if node.path != "/" and dataset.variables:
            yield node.path.strip("/").split("/"), dataset


def _time_name(dataset: xarray.Dataset) -> str:
    return "sample_time" if "sample_time" in dataset.variables else "time"


def _write_csv(tree: xarray.DataTree, folder: Path) -> None:
    import pandas

    folder.mkdir(parents=True, exist_ok=True)
    for path, dataset in _groups(tree):
        time_name = _time_name(dataset)
        columns: dict[str, Any] = {}
        for name in (time_name, *dataset.data_vars):
            variable = dataset[name]
            unit = f" [{variable.attrs['units']}]" if "units" in variable.attrs else ""
            labels = [AXES.get(str(d), [str(k + 1) for k in range(dataset.sizes[d])]) for d in variable.dims[1:]]
            flat = variable.values.reshape(variable.shape[0], -1)
            for k, parts in enumerate(itertools.product(*labels)):
                columns[".".join((str(name), *parts)) + unit] = flat[:, k]
        pandas.DataFrame(columns).to_csv(folder / f"{'.'.join(path)}.csv", index=False, lineterminator="\n")


def _write_mat(tree: xarray.DataTree, path: Path) -> None:
    from scipy.io import savemat

    root: dict[str, Any] = {"attributes": dict(tree.attrs), "axes": {k: np.array(v, object) for k, v in AXES.items()}}
    for parts, dataset in _groups(tree):
        struct = root
        for part in parts:
            struct = struct.setdefault(part, {})
        struct["units"] = {str(name): v.attrs.get("units", "") for name, v in dataset.variables.items()}
        for name, variable in dataset.variables.items():
            values = variable.values
            struct[str(name)] = values.astype(object) if values.dtype.kind == "U" else values
    path.parent.mkdir(parents=True, exist_ok=True)
    savemat(str(path), root, appendmat=False, long_field_names=True, oned_as="column")
