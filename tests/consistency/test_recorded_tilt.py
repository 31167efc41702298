"""The attitude of an INS on recorded flights: what is felt in two seconds against the change of GNSS velocity.

``TESTBED_RECORDINGS=DIR pytest -m slow -s tests/consistency/test_recorded_tilt.py`` prints the figures. No autopilot's
attitude is asked. The angle holds what velocities are off by, too: 0.1 m/s are 0.4 deg of it. What is left to a
smoother, which knows the whole flight, is printed beside.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray
from scipy.spatial.transform import Rotation, Slerp
from worlds import real_flights

from nav.earth import STANDARD_GRAVITY
from nav.samples import Array
from testbed import Scenario, run
from testbed.record import reader as record

WINDOW_S = 2.0
LAGS = np.arange(-0.3, 0.31, 0.02)  # of the velocities behind the times told: that with which they fit best is taken
FLOWN = {"thor": (155.0, 518.0), "swiss": (25.0, 148.0), "quad": (60.0, 689.0)}  # [s of the run]
MOST_DEG = 2.1  # median


@pytest.mark.slow
@pytest.mark.skipif(not real_flights.available(), reason="TESTBED_RECORDINGS names no folder of recordings")
@pytest.mark.parametrize("name", FLOWN)
def test_tilt_against_changes_of_velocity(name: str, tmp_path: Path) -> None:
    path = tmp_path / "flight.toml"
    ins = real_flights.FLIGHTS[name].partition('[[estimator]]\nname = "ahrs"')[0]
    path.write_text(f"{ins}smooth = true\n", "utf-8")
    run(Scenario.load(path, {"truth.reference": "gnss"}), out=tmp_path)
    tree = record.load(tmp_path / "run.nc")
    carried = _carried(tree["sensors/imu"])
    medians = {}
    for estimator in ("ins", "ins_smoothed"):
        each = [_angles(tree, estimator, carried, *FLOWN[name], lag) for lag in LAGS]
        angles = min(each, key=lambda one: float(np.mean(one**2)))
        rms, medians[estimator] = np.sqrt(np.mean(angles**2)), np.median(angles)
        told = f"{medians[estimator]:.2f} deg (median), {angles.mean():.2f} deg (mean), {rms:.2f} deg (RMS)"
        print(f"{name}, {estimator}: {len(angles)} windows of {WINDOW_S:g} s: {told}")
    assert medians["ins"] < MOST_DEG


def _carried(imu: xarray.DataTree) -> tuple[list[Rotation], Array, Array]:
    """Body axes at each increment in those of the first, and what is felt until then there (N + 1, 3), less its biases
    times the last (N + 1, 3, 3).
    """
    axes, felt, of_bias = [Rotation.identity()], np.zeros((len(imu.time) + 1, 3)), np.zeros((len(imu.time) + 1, 3, 3))
    for k, (dt, dtheta, dv) in enumerate(zip(*(imu[name].values for name in ("dt", "dtheta", "dv")), strict=True)):
        half = (axes[-1] * Rotation.from_rotvec(dtheta / 2)).as_matrix()
        felt[k + 1], of_bias[k + 1] = felt[k] + half @ dv, of_bias[k] + half * dt
        axes.append(axes[-1] * Rotation.from_rotvec(dtheta))
    return axes, felt, of_bias


def _angles(
    tree: xarray.DataTree,
    estimator: str,
    carried: tuple[list[Rotation], Array, Array],
    begins: float,
    ends: float,
    lag: float,
) -> Array:
    """Between what is felt, turned by the estimate, and the changes of velocity less gravity, each window [deg]."""
    imu, gnss, ins = tree["sensors/imu"], tree["sensors/gnss"], tree["estimators"][estimator]
    axes, felt, of_bias = carried
    t, v_n = gnss["time"].values - lag, gnss["v_n"].values
    known = np.isfinite(v_n).all(axis=1) & (t > begins) & (t < ends)
    t, v_n = t[known], v_n[known]
    at, q_nb = ins["time"].values, ins["q_nb"].values
    told = np.isfinite(q_nb).all(axis=1)
    attitudes = Slerp(at[told], Rotation.from_quat(q_nb[told], scalar_first=True))
    angles = []
    for first in np.unique(np.searchsorted(t, np.arange(t[0], t[-1] - 2 * WINDOW_S, WINDOW_S / 2))):
        last = int(np.searchsorted(t, t[first] + WINDOW_S - 0.01))
        lasts = t[last] - t[first]
        if lasts > 1.2 * WINDOW_S:
            continue
        i, j = np.searchsorted(imu["time"].values, [t[first] + 1e-9, t[last] + 1e-9])
        bias = ins["accel_bias"].values[np.searchsorted(at, t[first])]
        pushed = axes[i].inv().apply(felt[j] - felt[i] - (of_bias[j] - of_bias[i]) @ bias)
        told_n = attitudes(t[first]).apply(pushed)
        changed = v_n[last] - v_n[first] - [0.0, 0.0, STANDARD_GRAVITY * lasts]
        angles.append(np.arctan2(np.linalg.norm(np.cross(told_n, changed)), told_n @ changed))
    return np.degrees(angles)
