"""CSV: a folder with one file per group, such as ``estimators.ins.csv``, units in the header: ``v_n.north [m/s]``."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from testbed.record.columns import AXES

if TYPE_CHECKING:
    import xarray


def contents(tree: xarray.DataTree) -> dict[str, bytes]:
    """The files of a record by their names."""
    return {f"{'.'.join(path)}.csv": _csv(dataset).encode() for path, dataset in groups(tree)}


def groups(tree: xarray.DataTree) -> Iterator[tuple[list[str], xarray.Dataset]]:
    """The groups of a record that hold anything, each by the parts of its path."""
    for node in tree.subtree:
        dataset = node.to_dataset(inherit=False)
        if node.path != "/" and dataset.variables:
            yield node.path.strip("/").split("/"), dataset


def _time_name(dataset: xarray.Dataset) -> str:
    return "sample_time" if "sample_time" in dataset.variables else "time"


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
