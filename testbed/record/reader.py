"""Reading a record back."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.errors import UserError
from testbed.record import format1
from testbed.record.columns import AXES, ESTIMATE, EVENT, FAULT, FORMAT, IMU, REPORT, TRUTH, Variable
from testbed.record.tables import Data

if TYPE_CHECKING:
    import h5py
    import xarray

    from testbed.scenario import Scenario

# What every record says of itself, and what it is; of some, in JSON. Others may say more.
NUMBERS = ("seed", "record_rate_hz", "duration_s")
IN_JSON: Mapping[str, type] = {
    "overrides": list,
    "versions": dict,
    "estimated_point_b_m": dict,
    "estimator_imus": dict,
    "ended": dict,
    "reference_sigma_n": list,
    "reference_point_b_m": list,
}
SAID = {"scenario", "overrides", "estimated_point_b_m", *NUMBERS}
# What comes with a column that samples of ours have. Where more than one is not there, they are the user's.
COMES_WITH: Mapping[str, Sequence[str]] = {
    "fix_type": ("lat", "lon", "h", "v_n", "sigma_position_n", "sigma_velocity_n", "satellites", "hdop", "vdop"),
    "dtheta": tuple(IMU),
}


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
            written = file.attrs.get("format")
            if written not in (FORMAT, format1.FORMAT):
                raise UserError(f"{path}: netCDF-4/HDF5, but not a record of a run of this version ({FORMAT!r})")
            columns: dict[str, dict[str, tuple[Variable, Data]]] = {}
            _read_group(file, "", columns)
            attributes = {name: _plain(value) for name, value in file.attrs.items()}
        if written == format1.FORMAT:
            _upgrade(columns)
        _require_whole(columns, attributes)
        return tree(columns, attributes)
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise UserError(f"{path}: damaged record ({error}); run the scenario again") from error


def _upgrade(columns: dict[str, dict[str, tuple[Variable, Data]]]) -> None:
    """Give the reports of a record of the first format their outcomes."""
    for path, group in columns.items():
        if path.split("/")[2:3] == ["innovations"]:
            reason, nis, weight = (group[name][1] for name in ("reason", "nis", "weight"))
            group["outcome"] = REPORT["outcome"], format1.outcomes(reason, nis, weight)


def _require_whole(columns: Mapping[str, Mapping[str, object]], attributes: Mapping[str, Any]) -> None:
    """Raise ValueError of the first thing that every record has, and this one lacks or has garbage in place of."""
    for path, group in columns.items():
        if missing := sorted(_needed(path, group) - group.keys()):
            raise ValueError(f"{path}/{missing[0]} is missing")
    if unsaid := sorted(SAID - attributes.keys()):
        raise ValueError(f"its attribute {unsaid[0]} is missing")
    for name in NUMBERS:
        if not isinstance(attributes[name], int | float):
            raise ValueError(f"its attribute {name} is no number: {attributes[name]!r}")
    for name, kind in IN_JSON.items():
        try:
            whole = name not in attributes or isinstance(json.loads(attributes[name]), kind)
        except (TypeError, ValueError):
            whole = False
        if not whole:
            raise ValueError(f"its attribute {name} is no {kind.__name__} in JSON: {attributes[name]!r}")


def _needed(path: str, group: Mapping[str, object]) -> set[str]:
    """The columns without which a group, that has these, is none."""
    match path.split("/"):
        case ["truth"]:
            return set(TRUTH)
        case ["estimators", _]:
            states = {name for name in group.keys() - ESTIMATE.keys() - {"time"} if not name.startswith("sigma_")}
            return {*ESTIMATE, *(f"sigma_{name}" for name in states)}
        case ["estimators", _, "innovations", _]:
            return {*REPORT, *({"innovation", "S"} if group.keys() & {"innovation", "S"} else ())}
        case ["sensors", _]:
            needed = set() if "dtheta" in group else {"t_arrival"}
            for one, others in COMES_WITH.items():
                if one in group and len(set(others) - group.keys()) == 1:
                    needed.update(others)
            return needed
        case ["events"]:
            return set(EVENT)
        case ["faults"]:
            return set(FAULT)
        case _:
            return set()


def scenario_of(dataset: xarray.DataTree, overrides: Sequence[str] = ()) -> Scenario:
    """The scenario that a record was made of, with further ``overrides``.

    Raises UserError, naming the record's format and who wrote it, when that scenario is no longer read; when there is
    none; and as `Scenario.parse` does when an override is wrong.
    """
    from testbed.scenario import Scenario

    said = dataset.attrs
    try:
        if not overrides:
            return Scenario.of_record(said)
        return Scenario.of_record({**said, "overrides": json.dumps([*json.loads(said["overrides"]), *overrides])})
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"damaged record ({error}); run the scenario again") from None
    except UserError as error:
        if overrides:
            scenario_of(dataset)  # raises where it is the record that is not read
            raise
        raise error.within(f"a record of {_writer(dataset)}, whose scenario is no longer read") from None


def _writer(dataset: xarray.DataTree) -> str:
    """Format of a record, and the version that wrote it."""
    try:
        version = json.loads(dataset.attrs["versions"])["navigation-testbed"]
    except (KeyError, TypeError, ValueError):
        version = "of unknown version"
    return f"format {dataset.attrs.get('format', 'unknown')!r}, written by navigation-testbed {version}"


def _plain(value: Any) -> Any:
    if isinstance(value, bytes):
        return value.decode()
    return value.item() if isinstance(value, np.generic) else value


def _read_group(group: h5py.Group, path: str, found: dict[str, dict[str, tuple[Variable, Data]]]) -> None:
    import h5py

    members = dict(group.items())
    time_name = next((name for name in ("time", "sample_time") if name in members), None)
    if time_name is not None:
        written = np.flatnonzero(np.isfinite(group[time_name][()]))
        rows = int(written[-1]) + 1 if len(written) else 0
        datasets = {name: item for name, item in members.items() if isinstance(item, h5py.Dataset)}
        places = {h5py.h5o.get_info(item.id).addr: name for name, item in datasets.items()}
        found[path] = {
            name: _read_column(item, rows, places) for name, item in datasets.items() if "long_name" in item.attrs
        }
    for name, item in members.items():
        if isinstance(item, h5py.Group):
            _read_group(item, f"{path}/{name}".lstrip("/"), found)


def _read_column(dataset: h5py.Dataset, rows: int, places: Mapping[int, str]) -> tuple[Variable, Data]:
    """One column; ``places`` are the names in its group by address: to ask HDF5 for a name makes it search the file."""
    from h5py import h5o

    attributes = {
        name: _plain(dataset.attrs[name])
        for name in ("units", "long_name", "flag_values", "flag_masks", "flag_meanings")
        if name in dataset.attrs
    }
    try:
        scales = [dataset.dims[k][0] for k in range(1, dataset.ndim)]
        dims = tuple(places.get(h5o.get_info(scale.id).addr) or Path(scale.name).name for scale in scales)
    except (RuntimeError, TypeError):
        raise ValueError(f"{dataset.name.strip('/')}: what labels its columns is missing") from None
    values = dataset[:rows]
    if values.dtype.kind == "S":
        values = values.view(f"S{values.shape[1]}")[:, 0]
        dims = dims[:-1]
    variable = Variable(attributes.pop("units", ""), attributes.pop("long_name"), dims, values.dtype.str, attributes)
    return variable, values


def _text(values: Data) -> Data:
    """Texts of their bytes; most columns say the same in every row."""
    if len(values) and (values == values[0]).all():
        return np.full(len(values), values[0].decode())
    return np.char.decode(values, "utf-8")


def tree(
    columns: Mapping[str, Mapping[str, tuple[Variable, Data]]], attributes: Mapping[str, str | int | float]
) -> xarray.DataTree:
    """A record as labelled arrays, from the columns of each group and the attributes of the root."""
    import xarray

    def labelled(dims: Sequence[str], values: Data, attrs: Mapping[str, Any] | None = None) -> xarray.Variable:
        # Arrays that it has to look at, xarray compares with those of Dask, which take longer to load than a short run.
        return xarray.Variable(dims, values, attrs, fastpath=True)

    nodes = {"/": xarray.Dataset(attrs=dict(attributes))}
    for path, group in columns.items():
        time_name = "sample_time" if "sample_time" in group else "time"
        variables = {
            name: labelled(
                (time_name, *variable.dims),
                _text(values) if values.dtype.kind == "S" else values,
                variable.labels,
            )
            for name, (variable, values) in group.items()
        }
        dims = dict.fromkeys(dim for variable, _ in group.values() for dim in variable.dims)
        labels = {dim: labelled([dim], np.array(AXES[dim])) for dim in dims if dim in AXES}
        nodes[path] = xarray.Dataset(variables, {time_name: variables.pop(time_name), **labels})
    return xarray.DataTree.from_dict(nodes)
