"""Tables whose sensors are silent for long, slow for a part, or coarse: nothing that happened is left out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from testbed.feeds import formats
from testbed.feeds.log import Log
from testbed.motion.logged import LogTruth

IMU: dict[str, Any] = {"time": "t", "gyro": "w", "accel": "f"}
GNSS: dict[str, Any] = {"time": "gt", "lat": "lat", "lon": "lon", "height": "h"}


def unit(t: np.ndarray) -> dict[str, Any]:
    """An inertial unit that turns and is held up."""
    return {"t": t, "w": np.tile([0.1, 0, 0], (len(t), 1)), "f": np.tile([0, 0, -9.8], (len(t), 1))}


def fixes(t: np.ndarray) -> dict[str, Any]:
    """A receiver that goes north."""
    return {"gt": t, "lat": 0.8 + 1e-7 * t, "lon": np.full(len(t), 0.1), "h": np.full(len(t), 500.0)}


def read(folder: Path, table: dict[str, Any], **columns: Any) -> Log:
    np.savez(folder / "a.npz", **table)
    truth = LogTruth.model_validate({"source": "log", "file": "-", "columns": {"imu": IMU, **columns}})
    return formats.read(folder / "a.npz", truth.columns)


@pytest.mark.parametrize(("begins", "ends"), [(600, 9000), (600, 9299), (0.5, 9000), (5, 9310)])
def test_a_receiver_may_be_denied_for_hours(begins: float, ends: float, tmp_path: Path) -> None:
    """Rows of the unit, blank for the receiver; the unit may even end before it is heard again."""
    t = np.arange(93_000) / 10.0
    gt = np.arange(93_500) / 10.0
    table = unit(t) | fixes(gt)
    denied = (gt > begins) & (gt < ends)
    for name in ("lat", "lon", "h"):
        table[name][denied] = np.nan
    log = read(tmp_path, table, gnss=GNSS)
    assert len(log.samples["gnss"]) == np.sum(~denied)
    assert not any("clock that was set" in note for note in log.notes)


@pytest.mark.parametrize("fast", [1500, 6000])
@pytest.mark.parametrize("missing", [0, 1, 2])
def test_increments_may_be_slower_for_a_while(fast: int, missing: int, tmp_path: Path) -> None:
    """At 100 Hz, then at 50: none are missing but those that are."""
    t = np.concatenate([np.arange(1, fast + 1) * 0.01, fast * 0.01 + np.arange(1, 1001) * 0.02])
    dt = np.diff(t, prepend=0.0)
    kept = ~np.isin(np.arange(len(t)), [fast + 500 + k for k in range(missing)])
    table = {"t": t[kept], "w": np.outer(dt, [0.1, 0, 0])[kept], "f": np.outer(dt, [0, 0, -9.8])[kept]}
    log = read(tmp_path, table, imu={**IMU, "form": "increments"})
    imu = log.imus["imu"]
    np.testing.assert_allclose(imu.dv[:, 2] / imu.dt, -9.8)
    assert imu.dtheta[:, 0].sum() == pytest.approx(0.1 * t[-1])
    assert any("rows are missing in 1 places" in note for note in log.notes) == (missing > 0)
