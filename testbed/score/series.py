"""Errors of an estimator over time as a table, for whoever wants to plot or sum them up by himself."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from nav.samples import Array
from testbed.errors import UserError, shown
from testbed.score import accuracy

if TYPE_CHECKING:
    import pandas
    import xarray

    from testbed.loop.loop import RunResult


def error_series(run: RunResult | xarray.DataTree, estimator: str) -> pandas.DataFrame:
    """Errors, estimate less truth, of one estimator at every recorded time, beside the 1-sigma that it claimed.

    ``run`` is what `testbed.run` gave back, or its dataset. One row a time, with the time [s] as index ``t_s``:

    * ``north_m``, ``east_m``, ``down_m`` and ``sigma_north_m`` …: position at the IMU, along the axes of n there;
    * ``v_north_mps``, ``v_east_mps``, ``v_down_mps`` and ``sigma_v_north_mps`` …: velocity in n;
    * ``roll_deg``, ``pitch_deg``, ``heading_deg``: the differences of these angles;
    * ``phi_north_deg``, ``phi_east_deg``, ``phi_down_deg`` and ``sigma_phi_north_deg`` …: attitude error, a rotation
      about the axes of n with ``C_nb_hat = (I - [phi x]) C_nb``, which is what estimators claim a sigma of.

    What is not estimated, or not yet, is NaN. Raises UserError when the run has no such estimator.

    Example::

        import testbed

        result = testbed.run(testbed.Scenario.load("u_turn"))
        errors = testbed.error_series(result, "ins")
        print(errors.loc[60:, ["north_m", "sigma_north_m"]].describe())
    """
    import pandas
    import xarray

    dataset = run if isinstance(run, xarray.DataTree) else getattr(run, "dataset", None)
    if not isinstance(dataset, xarray.DataTree):
        told = "give what `testbed.run` gave back, or a record as xarray.open_datatree reads it"
        raise UserError(f"error_series: {shown(str(run))} is no run: {told}")
    known = accuracy.names(dataset)
    if estimator not in known:
        raise UserError(f"the run has no estimator {estimator}: choose from {', '.join(known) or 'none'}")
    e = accuracy.errors(dataset, estimator)
    phi, sigma_phi = np.rad2deg(e.attitude), np.rad2deg(e.sigma_attitude)
    columns: dict[str, Array] = {}
    for name, unit, error, sigma in (
        ("{}", "m", e.position, e.sigma_position),
        ("v_{}", "mps", e.velocity, e.sigma_velocity),
        ("phi_{}", "deg", phi, sigma_phi),
    ):
        for values, said in ((error, ""), (sigma, "sigma_")):
            columns |= {f"{said}{name.format(axis)}_{unit}": values[:, k] for k, axis in enumerate(accuracy.AXES)}
    columns |= {f"{angle}_deg": np.rad2deg(e.angles[:, k]) for k, angle in enumerate(("roll", "pitch", "heading"))}
    return pandas.DataFrame(columns, index=pandas.Index(e.t, name="t_s"))
