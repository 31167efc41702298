"""What all figures need of a record: truth, estimates, their errors, and what happened when."""

from __future__ import annotations

import json
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from nav import earth
from nav.samples import Array
from testbed.errors import UserError
from testbed.report import style
from testbed.scenario import Scenario
from testbed.score import accuracy, bound, detection, observability
from testbed.score import metrics as scores
from testbed.score.accuracy import Errors, column
from testbed.score.bound import Bound
from testbed.sensors.imu import ImuConfig, ImuErrors

if TYPE_CHECKING:
    import xarray

    from nav.observability import Visibility
    from testbed.report.style import Sheet


class Run:
    """One recorded run; ``windows`` are those without GNSS fix. Raises UserError of a record without a single row."""

    def __init__(self, dataset: xarray.DataTree) -> None:
        self.dataset = dataset
        self.windows = scores.outages(dataset)
        self.faults = detection.faults(dataset)
        names = accuracy.names(dataset)
        self.errors = {name: accuracy.errors(dataset, name) for name in names}
        self.lines = {name: style.line_of(k) for k, name in enumerate(names)}
        self.colours = {name: line["color"] for name, line in self.lines.items()}
        self.t = self.truth("time")

    @cached_property
    def seen(self) -> dict[str, Visibility]:
        """Which states of each estimator can be seen."""
        return observability.of_run(self.dataset)

    @cached_property
    def bounds(self) -> dict[str, Bound]:
        """What no estimator can be better than, by the name of each that has a bound; only of a run with an outage."""
        return bound.of_run(self.dataset) if self.windows else {}

    def truth(self, name: str) -> Array:
        """One column of truth."""
        return column(self.dataset, f"truth/{name}")

    def estimate(self, estimator: str, name: str) -> npt.NDArray[Any]:
        """One column of an estimator."""
        return column(self.dataset, f"estimators/{estimator}/{name}")

    def has(self, path: str) -> bool:
        """Whether the record has such a column or group."""
        node: Any = self.dataset
        for part in path.split("/"):
            if part not in node:
                return False
            node = node[part]
        return True

    @property
    def recorded(self) -> bool:
        """Whether the flight was recorded: what stands for truth is a reference, unknown here and there."""
        return "reference" in self.dataset.attrs

    @property
    def reference(self) -> str:
        """What the estimates are held against, in a word."""
        return "reference" if self.recorded else "truth"

    @property
    def receivers(self) -> list[str]:
        """The GNSS receivers."""
        return scores.receivers(self.dataset)

    @property
    def aligned(self) -> dict[str, Errors]:
        """Errors of the estimators that were ever aligned."""
        return {name: e for name, e in self.errors.items() if e.aligned_s is not None}

    @property
    def positioned(self) -> dict[str, Errors]:
        """Those of them that estimate position and velocity too."""
        return {name: e for name, e in self.aligned.items() if not e.attitude_only}

    @property
    def imus(self) -> list[str]:
        """The recorded inertial units."""
        if "sensors" not in self.dataset.children:
            return []
        return [name for name, node in self.dataset["sensors"].children.items() if "dtheta" in node.data_vars]

    def imu_of(self, estimator: str) -> str | None:
        """The inertial unit that an estimator lives on, None if it was not recorded."""
        imu = json.loads(self.dataset.attrs.get("estimator_imus", "{}")).get(estimator)
        return imu if imu in self.imus else None

    @cached_property
    def _scenario(self) -> Scenario | None:
        """What was flown; None of a record whose scenario is no longer read."""
        try:
            overrides = json.loads(self.dataset.attrs.get("overrides", "[]"))
            return Scenario.parse(str(self.dataset.attrs["scenario"]), overrides)
        except (KeyError, ValueError, UserError):
            return None

    def datasheet(self, imu: str) -> ImuErrors | None:
        """What the scenario says of an inertial unit; None of a record whose scenario is no longer read."""
        config = self._scenario.sensors.get(imu) if self._scenario else None
        return config.errors() if isinstance(config, ImuConfig) else None

    def track(self, lat: Array, lon: Array) -> Array:
        """North and east of the run's first point (N, 2) [km]."""
        places = np.column_stack([self.truth(name) for name in ("lat", "lon", "h")])
        known = places[np.isfinite(places).all(axis=1)]
        first = known[0] if len(known) else places[0]
        start = [np.full(len(lat), one) for one in first.tolist()]
        return earth.position_difference_n(lat, lon, start[2], *start)[:, :2] / 1000

    def against_time(self, sheet: Sheet, title: float = 0.0, sensors: list[set[str]] | None = None) -> None:
        """Set the common time axis, shade outages and faults, and explain everything in one legend.

        ``sensors``, if given, tells for each row of panels whose faults it shows.
        """
        end = float(self.t[-1])
        keys = style.keys_of(sheet.axes.flat)
        shown = []
        for k, row in enumerate(sheet.axes):
            faults = [f for f in self.faults if sensors is None or f.sensor in sensors[k]]
            shown += [fault for fault in faults if fault.start < end]
            for ax in row:
                style.shade(ax, self.windows, style.SHADE, end)
                style.shade(ax, [(fault.start, fault.end) for fault in faults], style.FAULT, end)
                if end > self.t[0]:
                    ax.set_xlim(self.t[0], end)
        for ax in sheet.axes[-1]:
            ax.set_xlabel("time [s]")
        if self.windows:
            keys["no GNSS fix"] = style.patch(style.SHADE)
        if shown:
            keys["fault of a sensor"] = style.patch(style.FAULT)
        sheet.legend(keys, title)
