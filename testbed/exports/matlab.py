"""MATLAB: a struct per group, in it one array per variable and the struct ``units`` with the same fields."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from testbed.exports.tables import groups
from testbed.record.columns import AXES

if TYPE_CHECKING:
    import xarray


def content(tree: xarray.DataTree) -> bytes:
    """The file of a record."""
    root: dict[str, Any] = {"attributes": dict(tree.attrs), "axes": {k: np.array(v, object) for k, v in AXES.items()}}
    for parts, dataset in groups(tree):
        struct = root
        for part in parts:
            struct = struct.setdefault(part, {})
        struct["units"] = {str(name): v.attrs.get("units", "") for name, v in dataset.variables.items()}
        for name, variable in dataset.variables.items():
            values = variable.values
            struct[str(name)] = values.astype(object) if values.dtype.kind == "U" else values
    return packed(root)


def packed(root: dict[str, Any]) -> bytes:
    """A .mat file of these variables; 1-D arrays are columns."""
    from scipy.io import savemat

    file = io.BytesIO()
    savemat(cast("Any", file), root, long_field_names=True, oned_as="column")
    return file.getvalue()
