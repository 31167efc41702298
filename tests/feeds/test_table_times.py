"""Tables whose sensors have times of their own: of clocks that differ, with holes, with rows that were there before."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from testbed.errors import UserError
from testbed.feeds import formats
from testbed.feeds.log import Log
from testbed.feeds.survey import survey
from testbed.motion.logged import LogTruth

IMU_HZ, GNSS_HZ, SECONDS = 200, 5, 60
T = np.arange(1, SECONDS * IMU_HZ + 1) / IMU_HZ
COLUMNS: dict[str, Any] = {
    "imu": {"time": "t", "gyro": "w", "accel": "f"},
    "gnss": {"time": "gt", "lat": "lat", "lon": "lon", "height": "h", "velocity": "v"},
    "reference": {"time": "rt", "lat": "lat", "lon": "lon", "height": "h"},
}


def table() -> dict[str, Any]:
    """A minute of an inertial unit that turns, and of a receiver that goes north."""
    gt = np.arange(SECONDS * GNSS_HZ + 1) / GNSS_HZ
    n = len(gt)
    made: dict[str, Any] = {"t": T, "w": np.tile([0.1, 0.0, 0.0], (len(T), 1)), "f": np.tile([0, 0, -9.8], (len(T), 1))}
    made |= {"gt": gt, "rt": gt, "lat": 0.8 + 1e-6 * gt, "lon": np.full(n, 0.1), "h": 500 + np.sin(gt)}
    return made | {"v": np.tile([6.4, 0.0, 0.0], (n, 1))}


def read(made: Mapping[str, Any], folder: Path, changes: Mapping[str, Any] | None = None) -> Log:
    columns = {name: {**keys, **(changes or {}).get(name, {})} for name, keys in COLUMNS.items()}
    np.savez(folder / "a.npz", **made)
    truth = LogTruth.model_validate({"source": "log", "file": "-", "columns": columns})
    return formats.read(folder / "a.npz", truth.columns)


@pytest.mark.parametrize(
    ("times", "apart"), [(["t"], "gnss, reference"), (["gt"], "gnss"), (["rt"], "reference"), (["gt", "rt"], "gnss")]
)
def test_sensors_of_clocks_that_differ_are_named_with_their_times(times: list[str], apart: str, tmp_path: Path) -> None:
    made = table()
    for name in times:
        made[name] = made[name] + 1.7e9
    with pytest.raises(UserError, match=f"no time in common with imu has {apart}") as caught:
        read(made, tmp_path)
    assert "to 1700000060 s" in str(caught.value)
    assert "offset" in str(caught.value)
    if times == ["gt", "rt"]:
        mended = {
            name: {"time": {"column": key, "offset": -1.7e9}} for name, key in (("gnss", "gt"), ("reference", "rt"))
        }
        assert read(made, tmp_path, mended).t0 == pytest.approx(0.0)


def test_times_before_a_receiver_knew_any_are_left_out(tmp_path: Path) -> None:
    """Seconds of the week are zero until its first fix; and one stamp of any sensor may be nonsense."""
    made = table()
    for name in ("t", "gt", "rt"):
        made[name] = made[name] + 345_600
    made["gt"][:20] = 0.0
    made["rt"][-1] = 1e12
    log = read(made, tmp_path)
    assert log.t0 == pytest.approx(345_600)
    assert log.samples["gnss"][0].t == pytest.approx(345_604)
    assert survey(log).phases[-1].end < SECONDS + 1
    assert any("gnss: 1 times are 3600 s and more" in note for note in log.notes)
    assert any("reference: 1 times are 3600 s and more" in note for note in log.notes)


@pytest.mark.parametrize(("early", "begins"), [(500.0, -500.0), (700.0, 1 / IMU_HZ)])
def test_a_log_begins_with_its_inertial_unit_when_others_were_heard_long_before(
    early: float, begins: float, tmp_path: Path
) -> None:
    made = table()
    made["gt"] = np.concatenate([[-early], made["gt"][1:]])
    made["rt"] = made["rt"] + 1
    assert read(made, tmp_path).t0 == pytest.approx(begins)
