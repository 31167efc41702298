"""Of a file with several boots of an ArduPilot all sensors keep the same one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from worlds.log_writers import dataflash, us

from testbed.feeds import formats
from testbed.feeds.stamps import Loss


def boot(lasts: float, heard: np.ndarray, height: float) -> list[tuple[str, tuple[Any, ...]]]:
    """Messages of a vehicle that stands at a height, its receiver and solution being ``heard`` at times [s]."""
    found: list[tuple[float, str, tuple[Any, ...]]] = [(0.0, "PARM", (us(0.0), b"AHRS_TRIM_X", 0.0))]
    found += [(t, "IMU", (us(t), 0, 0.0, 0.0, 0.0, 0.0, 0.0, -9.8)) for t in np.arange(1, 50 * lasts + 1) / 50]
    for t in heard:
        told = us(t), 0, 3, 100_000_000 + round(t * 1e3), 1820, 10, 1.0
        found += [(t, "GPS", (*told, 47.0, 8.0, height, 0.0, 0.0, 0.0)), (t, "POS", (us(t), 47.0, 8.0, height))]
        found += [(t, "XKF1", (us(t), 0, 0.0, 0.0, height / 100, 0.0, 0.0, 0.0))]
    return [(name, values) for _, name, values in sorted(found, key=lambda one: one[0])]


LONG, SHORT = boot(120.0, np.arange(60.0, 119.0), 500.0), boot(100.0, np.arange(1.0, 99.0), 900.0)


@pytest.mark.parametrize("messages", [LONG + SHORT, SHORT + LONG])
def test_all_sensors_keep_the_boot_of_the_inertial_unit(messages: list[Any], tmp_path: Path) -> None:
    """The receiver and the solution, which had more of the other boot, were of that one."""
    log = formats.read(dataflash(messages, tmp_path / "a.bin"), {})
    assert log.imus["imu"].t[-1] == 120.0
    fixes: Any = log.samples["gnss"]
    assert [one.t for one in fixes] == np.arange(60.0, 119.0).tolist()
    assert {one.h for one in fixes} == {500.0}
    assert log.solution is not None
    assert log.solution.t[0] == 60.0
    (note,) = [one for one in log.notes if "time goes back" in one]
    assert isinstance(note, Loss)
    assert "5000 rows of its own are left out" in note


def test_one_boot_is_whole(tmp_path: Path) -> None:
    log = formats.read(dataflash(LONG, tmp_path / "a.bin"), {})
    assert len(log.imus["imu"]) == 6000
    assert len(log.samples["gnss"]) == 59
    assert not any(isinstance(one, Loss) for one in log.notes)
