"""A record turned into CSV or MATLAB, units kept."""

from __future__ import annotations

import io
import itertools
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from testbed.data import write_file
from testbed.errors import UserError
from testbed.record.columns import AXES
from testbed.record.reader import load
from testbed.results import MANIFEST, enter, held, require_own, start_anew, write_result

if TYPE_CHECKING:
    import xarray


def export(run_file: Path, format: str, out: Path | None = None, force: bool = False) -> Path:
    """Write a record as ``csv`` or ``mat`` and return where.

    CSV: a folder (``<run>_csv`` beside the record unless ``out`` says otherwise) with one file per group, such as
    ``estimators.ins.csv``, and the unit of each column in its header: ``v_n.north [m/s]``. MATLAB: one file with a
    struct per group, in it one array per variable and the struct ``units`` with the same fields. Raises UserError
    when the record can't be read or the target not be written, which leaves nothing of it; or, without ``force``, when
    files are there that are no earlier export's.
    """
    if out is not None and out.resolve() == run_file.resolve():
        raise UserError(f"{out}: is the record itself: choose another place with --out")
    tree = load(run_file)
    if format == "csv":
        target = run_file.with_name(f"{run_file.stem}_csv") if out is None else out
        _write_csv(tree, target, force)
    else:
        target = run_file.with_suffix(".mat") if out is None else out
        _write_mat(tree, target, force)
    return target


def _groups(tree: xarray.DataTree) -> Iterator[tuple[list[str], xarray.Dataset]]:
    for node in tree.subtree:
        dataset = node.to_dataset(inherit=False)
        if node.path != "/" and dataset.variables:
            yield node.path.strip("/").split("/"), dataset


def _time_name(dataset: xarray.Dataset) -> str:
    return "sample_time" if "sample_time" in dataset.variables else "time"


def _write_csv(tree: xarray.DataTree, folder: Path, force: bool) -> None:
    groups = {f"{'.'.join(path)}.csv": dataset for path, dataset in _groups(tree)}
    with held(folder):
        require_own(folder, groups, force)
        if (folder.parent / MANIFEST).exists():  # beside the record: the next run takes it away
            enter(folder.parent, [folder.name])
        start_anew(folder, groups)
        try:
            for name, dataset in groups.items():
                write_result(folder / name, _csv(dataset).encode())
        except UserError:
            start_anew(folder)
            with suppress(OSError):
                folder.rmdir()
            raise


def _csv(dataset: xarray.Dataset) -> str:
    import pandas

    columns: dict[str, Any] = {}
    for name in (_time_name(dataset), *dataset.data_vars):
        variable = dataset[name]
        labels = [AXES.get(str(d), [str(k + 1) for k in range(dataset.sizes[d])]) for d in variable.dims[1:]]
        components = list(itertools.product(*labels))
        unit = variable.attrs.get("units", "")
        units = unit.split(", ")  # one for all, or one for each
        if len(units) != len(components):
            units = [unit] * len(components)
        flat = variable.values.reshape(variable.shape[0], -1)
        for k, (parts, own) in enumerate(zip(components, units, strict=True)):
            columns[".".join((str(name), *parts)) + (f" [{own}]" if own else "")] = flat[:, k]
    text: str = pandas.DataFrame(columns).to_csv(index=False, lineterminator="\n")
    return text


def _write_mat(tree: xarray.DataTree, path: Path, force: bool) -> None:
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
    content = io.BytesIO()
    savemat(cast("Any", content), root, long_field_names=True, oned_as="column")
    with held(path.parent):
        require_own(path.parent, [path.name], force)
        if (path.parent / MANIFEST).exists():  # beside the record, or a folder of results
            enter(path.parent, [path.name])
        write_file(path, content.getvalue())
