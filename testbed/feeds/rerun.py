"""The testbed's own record, `run.nc`, as a log: what its sensors delivered is what they deliver again, bit for bit."""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nav.samples import FixType, ImuSamples, Sample
from testbed.errors import UserError
from testbed.feeds.log import SAMPLES, Log, Reference, Samples, require_imu
from testbed.motion.logged import Place, Stream
from testbed.motion.table import COLUMNS
from testbed.record.reader import load, scenario_of

if TYPE_CHECKING:
    import xarray


def read(path: Path, columns: Mapping[str, Stream]) -> Log:
    """Read a record of a run. Raises UserError when it is damaged, or kept no increments."""
    tree = load(path)
    groups = tree.children["sensors"].children if "sensors" in tree.children else {}
    imus: dict[str, ImuSamples] = {}
    samples: dict[str, Samples] = {}
    notes = []
    for name, node in groups.items():
        dataset = node.to_dataset(inherit=False)
        if "dtheta" in dataset:
            t, dt, dtheta, dv = (np.array(dataset[key].values) for key in ("time", "dt", "dtheta", "dv"))
            imus[name] = ImuSamples(t, dt, dtheta, dv)
        else:
            recorded = {"t", "sensor", *map(str, dataset.data_vars)}
            made = next((made for made in SAMPLES.values() if {own.name for own in fields(made)} == recorded), None)
            if made is None:
                notes.append(f"{name} is a sensor of the user's, whose samples can't be given again")
            else:
                samples[name] = _samples(name, made, dataset)
    found = {f"sensors/{name}": node.sizes.get("time", 0) for name, node in groups.items()}
    require_imu(path, imus, found, "the increments of an IMU, which a run keeps with record.imu = true")
    if "truth" not in tree.children:
        raise UserError(f"{path}: holds no row of truth: the run ended before its first")
    truth = tree.children["truth"].to_dataset(inherit=False)
    whole = {name: np.array(truth[name].values, float) for name in COLUMNS if name in truth.data_vars}
    of = str(tree.attrs.get("reference", "simulated truth"))
    reference = Reference(of, np.array(truth["time"].values), whole)
    return Log(path, "run.nc", imus, samples, reference, 0.0, found, notes, True, *_place(tree))


def _place(tree: xarray.DataTree) -> tuple[dt.date | None, Place | None]:
    """Date and place of the start, as the scenario of a record says; None where that is no longer read."""
    try:
        scenario = scenario_of(tree)
    except UserError:
        return None, None
    start = scenario.truth.start
    if start is None:
        return scenario.date, None
    return scenario.date, Place(lat_deg=start.lat_deg, lon_deg=start.lon_deg, alt_m=start.alt_m)


def _samples(name: str, made: type[Sample], dataset: xarray.Dataset) -> list[Sample]:
    """The rows of one sensor as it delivered them."""
    columns = {str(key): _column(dataset[key].values) for key in dataset.data_vars}
    columns["t"] = dataset["time"].values.tolist()
    if "fix_type" in columns:
        columns["fix_type"] = [FixType(k) for k in columns["fix_type"]]
    keys = list(columns)
    return [made(**dict(zip(keys, row, strict=True)), sensor=name) for row in zip(*columns.values(), strict=True)]


def _column(values: Any) -> list[Any]:
    """Numbers as Python has them, vectors each by itself."""
    return [row.copy() for row in values] if values.ndim > 1 else values.tolist()
