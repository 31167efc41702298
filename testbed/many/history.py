"""What a campaign keeps of a run over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from nav.samples import Array
from testbed.score import accuracy, metrics

if TYPE_CHECKING:
    import xarray

HISTORY_HZ = 1.0  # rate at which a run's errors are kept


def history_of(dataset: xarray.DataTree) -> dict[str, Array]:
    """The errors of a run over time, as `testbed.many.campaign.Outcome` keeps them."""
    t = accuracy.column(dataset, "truth/time")
    kept = {"time": t, "outage": accuracy.inside(t, metrics.outages(dataset)).astype(float)}
    for name in accuracy.names(dataset):
        errors = accuracy.errors(dataset, name)
        rows = np.searchsorted(t, errors.t - accuracy.SAME_TIME_S)
        if errors.attitude_only:
            error, sigma, nees = np.rad2deg(errors.tilt), np.rad2deg(errors.sigma_attitude), errors.attitude_nees
        else:
            error, sigma, nees = errors.horizontal, errors.sigma_position, errors.position_nees
        for what, values in (
            ("error", error),
            ("sigma", np.hypot(sigma[:, 0], sigma[:, 1])),
            ("nees", np.where(errors.valid, nees, np.nan)),
        ):
            kept[f"{name}.{what}"] = np.full(len(t), np.nan)
            kept[f"{name}.{what}"][rows] = values
    every = max(1, round(float(dataset.attrs["record_rate_hz"]) / HISTORY_HZ))
    return {name: values[::every].copy() for name, values in kept.items()}
