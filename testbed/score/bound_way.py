"""The true way of a recorded run, as the bound goes along it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nav.samples import Array
from testbed.score.accuracy import column, rotated

if TYPE_CHECKING:
    import xarray

MEAN_WIND_S = 120.0  # over which the direction of the mean wind is taken


@dataclass(frozen=True, slots=True)
class Way:
    """Truth over K steps that end at ``t`` (K,), each ``T`` (K,) long [s].

    Integrals over each step, with s the axes of the IMU: ``turned`` (K, 3, 3) of C_ns, ``turned_rate`` and
    ``turned_force`` (K, 3, 3, 3) of C_ns times each component, the last index, of omega_s and f_s; ``force_n`` (K, 3)
    of f_n. At the ends of steps: ``C_nb`` (K, 3, 3), ``omega_b``, ``v_n``, ``wind_n``, ``mean_wind_n``, ``lla`` (K, 3),
    ``density``, ``current``, ``airspeed`` (K,). ``temperature`` (K,) is a step's, less that of the start. ``slip`` (N,)
    is the velocity [m/s] of the air from the side, at rows ``row_s`` apart.
    """

    t: Array
    T: Array
    turned: Array
    turned_rate: Array
    turned_force: Array
    force_n: Array
    C_nb: Array
    omega_b: Array
    v_n: Array
    lla: Array
    wind_n: Array
    mean_wind_n: Array
    density: Array
    current: Array
    temperature: Array
    airspeed: Array
    slip: Array
    row_s: float

    def __len__(self) -> int:
        return len(self.t)


def way(dataset: xarray.DataTree, C_sb: Array, step_s: float) -> Way:
    """The true way of a recorded run in steps of about ``step_s``, at least a row of truth each."""

    def true(name: str) -> Array:
        return np.asarray(column(dataset, f"truth/{name}"), float)

    t = true("time")
    row_s = float(np.median(np.diff(t)))
    every = max(1, round(step_s / row_s))
    steps = (len(t) - 1) // every
    ends = every * np.arange(1, steps + 1)
    rows = slice(1, every * steps + 1)
    q_nb = true("q_nb")
    C_nb = np.stack([rotated(q_nb, np.broadcast_to(axis, (len(t), 3))) for axis in np.eye(3)], axis=-1)
    C_ns = (0.5 * (C_nb[1:] + C_nb[:-1]) @ C_sb.T)[: rows.stop - 1]
    dt, dtheta_s, dv_s = np.diff(t)[: rows.stop - 1], true("dtheta")[rows] @ C_sb.T, true("dv")[rows] @ C_sb.T
    starts = every * np.arange(steps)

    def summed(values: Array) -> Array:
        return np.add.reduceat(values, starts, axis=0)

    wind_n, airspeed, warmer = true("wind_n"), true("airspeed"), true("temperature") - true("temperature")[0]
    mean_wind_n = _running_mean(wind_n, max(1, round(MEAN_WIND_S / row_s)))
    return Way(
        t=t[ends], T=summed(dt), turned=summed(C_ns * dt[:, None, None]),
        turned_rate=summed(C_ns[:, :, :, None] * dtheta_s[:, None, None, :]),
        turned_force=summed(C_ns[:, :, :, None] * dv_s[:, None, None, :]),
        force_n=summed(np.einsum("kij,kj->ki", C_ns, dv_s)),
        C_nb=C_nb[ends], omega_b=true("omega_b")[ends], v_n=true("v_n")[ends],
        lla=np.column_stack([true(name) for name in ("lat", "lon", "h")])[ends],
        wind_n=wind_n[ends], mean_wind_n=mean_wind_n[ends], density=true("density")[ends],
        current=true("current")[ends], temperature=0.5 * (warmer[starts] + warmer[ends]),
        airspeed=airspeed[ends], slip=airspeed * np.sin(true("beta")), row_s=row_s,
    )  # fmt: skip


def _running_mean(values: Array, n: int) -> Array:
    """Of ``n`` rows about each row; the first and the last stand for what would be beyond them."""
    padded = np.pad(values, ((n // 2 + 1, (n - 1) // 2), (0, 0)), mode="edge")
    padded[0] = 0.0
    sums = np.cumsum(padded, axis=0)
    mean: Array = (sums[n:] - sums[:-n]) / n
    return mean
