"""A record as exporters look at it: plain arrays by group, sensors by what they measure, the day of the flight."""

from __future__ import annotations

import datetime as dt
import json
from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from nav.samples import Array, has_fix
from testbed.errors import UserError
from testbed.record.reader import scenario_of
from testbed.scenario import Scenario
from testbed.score.accuracy import Window
from testbed.score.metrics import outages

if TYPE_CHECKING:
    import xarray

Columns: TypeAlias = Mapping[str, npt.NDArray[Any]]

# A sensor is what it measures: its kind by one of its columns.
KINDS = {
    "dtheta": "imu",
    "fix_type": "gnss",
    "field_b": "magnetometer",
    "pressure": "barometer",
    "eas": "airspeed",
}


class View:
    """One record. ``truth`` is where it has a place or an attitude. Raises UserError where it never has any."""

    def __init__(self, tree: xarray.DataTree) -> None:
        self._tree = tree
        rows = self.group("truth")
        if not len(rows.get("time", ())):
            raise UserError("the record holds no row of truth: the run ended before its first")
        self.truth = only(rows, placed(rows) | turned(rows))
        if not len(self.truth["time"]):
            raise UserError("the truth of the record is unknown: no row of it has a place or an attitude")

    def group(self, path: str) -> Columns:
        """The columns of one group, none where there is no such group."""
        node = next((n for n in self._tree.subtree if n.path.strip("/") == path), None)
        if node is None:
            return {}
        own = node.to_dataset(inherit=False)
        columns = {str(name): variable for name, variable in own.variables.items()}
        time = next((name for name in ("time", "sample_time") if name in columns), "")
        return {name: np.asarray(one.values) for name, one in columns.items() if one.dims[:1] == (time,)}

    def _known(self, path: str) -> Columns:
        """The rows of an estimate in which the attitude is known: before alignment nothing is."""
        own = self.group(path)
        return only(own, turned(own)) if "q_nb" in own else own

    @cached_property
    def title(self) -> str:
        """What the run is called."""
        return str(self._tree.attrs.get("title", "flight"))

    @cached_property
    def estimators(self) -> dict[str, Columns]:
        """Estimates by estimator, in the order of the scenario, from alignment on."""
        names = list(self._tree["estimators"].children) if "estimators" in self._tree.children else []
        return {name: own for name in names if len((own := self._known(f"estimators/{name}")).get("time", ()))}

    @cached_property
    def sensors(self) -> dict[str, dict[str, Columns]]:
        """Samples of each kind of sensor by the sensor's name; increments that are missing are left out."""
        found: dict[str, dict[str, Columns]] = {kind: {} for kind in KINDS.values()}
        for name in self._tree["sensors"].children if "sensors" in self._tree.children else ():
            own = self.group(f"sensors/{name}")
            if "dtheta" in own:
                known = np.isfinite(own["dtheta"]).all(axis=1) & np.isfinite(own["dv"]).all(axis=1)
                own = only(own, np.asarray(known))
            for column, kind in KINDS.items():
                if column in own and len(own["time"]):
                    found[kind][str(name)] = own
        return found

    def first(self, kind: str) -> Columns | None:
        """The first sensor of a kind."""
        return next(iter(self.sensors[kind].values()), None)

    @cached_property
    def scenario(self) -> Scenario:
        """What was flown. Raises UserError when it is no longer read."""
        return scenario_of(self._tree)

    @cached_property
    def midnight(self) -> dt.datetime:
        """The run's start: midnight, UTC, of the scenario's date, as on its MAVLink stream."""
        return dt.datetime.combine(self.scenario.date, dt.time(), dt.UTC)

    @cached_property
    def denied(self) -> list[Window]:
        """Windows without a fix [s], the last one to the end of the run."""
        end = float(self.truth["time"][-1])
        return [(start, min(stop, end)) for start, stop in outages(self._tree) if start < end]

    @cached_property
    def events(self) -> list[tuple[float, str, str]]:
        """Time [s], severity and text of what happened."""
        own = self.group("events")
        if not own:
            return []
        return [(float(t), str(s), str(w)) for t, s, w in zip(own["time"], own["severity"], own["text"], strict=True)]

    @cached_property
    def arms(self) -> dict[str, Array]:
        """Where in the body, from the centre of gravity [m], the point is that each estimator tells of."""
        said = json.loads(self._tree.attrs.get("estimated_point_b_m", "{}"))
        return {name: np.array(arm, float) for name, arm in said.items()}

    def origin(self) -> tuple[float, float, float]:
        """The first place that truth has, else an estimate: latitude, longitude [rad], height [m]."""
        for own in (self.truth, *self.estimators.values()):
            known = np.flatnonzero(placed(own))
            if len(known):
                lat, lon, h = (float(own[name][known[0]]) for name in ("lat", "lon", "h"))
                return lat, lon, h
        return 0.0, 0.0, 0.0

    def reports(self, estimator: str, aid: str) -> Columns:
        """What became of the samples of one aid, none where it is not used."""
        return self.group(f"estimators/{estimator}/innovations/{aid}")


def placed(own: Columns) -> npt.NDArray[np.bool_]:
    """In which rows of truth or an estimate a place is known."""
    return np.asarray(np.isfinite(own["lat"]) & np.isfinite(own["lon"]) & np.isfinite(own["h"]))


def turned(own: Columns) -> npt.NDArray[np.bool_]:
    """In which rows of truth or an estimate an attitude is known. The reference of a recorded flight may have none."""
    return np.asarray(np.isfinite(own["q_nb"]).all(axis=1))


def only(own: Columns, rows: npt.NDArray[np.bool_]) -> Columns:
    """These rows alone."""
    return {name: values[rows] for name, values in own.items()}


def fixed(own: Columns) -> npt.NDArray[np.bool_]:
    """At which of its samples a receiver has a fix."""
    return np.asarray(has_fix(own["fix_type"]))


def carried(values: Array, known: npt.NDArray[np.bool_], before: float = 0.0) -> Array:
    """Values (N,) with the last known in place of those that are not, ``before`` until there is one."""
    at = np.maximum.accumulate(np.where(known, np.arange(len(values)), -1))
    return np.where(at >= 0, values[np.maximum(at, 0)], before)
