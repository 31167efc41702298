"""Streams of one table keep the same part of it, and count alike how often a clock began anew."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from testbed.feeds import formats
from testbed.feeds.log import Log
from testbed.feeds.stamps import Loss
from testbed.feeds.survey import survey
from testbed.motion.logged import LogTruth

UNIT: dict[str, Any] = {"time": "t", "gyro": "w", "accel": "f"}
FIXES: dict[str, Any] = {"time": "gt", "lat": "lat", "lon": "lon", "height": "h"}
SHARED = {**FIXES, "time": "t"}
PRESSURES: dict[str, Any] = {"time": "bt", "pressure": "p"}


def unit(t: np.ndarray) -> dict[str, Any]:
    return {"t": t, "w": np.zeros((len(t), 3)), "f": np.tile([0, 0, -9.8], (len(t), 1))}


def fixes(t: np.ndarray, begins: np.ndarray | float = 0.0) -> dict[str, Any]:
    """Fixes at times t (N,), whose height is when they were, by a clock that goes on."""
    return {"gt": t, "lat": 0.8 + 1e-7 * t, "lon": np.full(len(t), 0.1), "h": begins + t}


def read(folder: Path, table: dict[str, Any], **columns: Any) -> Log:
    np.savez(folder / "a.npz", **table)
    truth = LogTruth.model_validate({"source": "log", "file": "-", "columns": {"imu": UNIT, **columns}})
    return formats.read(folder / "a.npz", truth.columns)


def told(log: Log, name: str) -> list[str]:
    return [note for note in log.notes if note.startswith(f"{name}: ")]


FIRST, SECOND = np.arange(1, 12_001) / 100, np.arange(1, 10_001) / 100  # the times of two boots


@pytest.mark.parametrize("longer", [0, 1])
def test_of_two_boots_all_sensors_keep_that_of_the_inertial_unit(longer: int, tmp_path: Path) -> None:
    """The receiver, in the longer of the unit's, is heard for the shorter time."""
    boots = [FIRST, SECOND] if longer == 0 else [SECOND, FIRST]
    heard = [np.arange(60.0, 119.0) if boot is FIRST else np.arange(1.0, 99.0) for boot in boots]
    table = unit(np.concatenate(boots)) | fixes(np.concatenate(heard), np.repeat([0, 1000], [len(x) for x in heard]))
    log = read(tmp_path, table, gnss=FIXES)
    assert log.imus["imu"].t[-1] == 120.0
    assert [one.h for one in log.samples["gnss"]] == (1000 * longer + np.arange(60.0, 119.0)).tolist()
    assert any(isinstance(note, Loss) and "time goes back 1 times" in note for note in told(log, "gnss"))


def test_rows_of_one_time_column_are_of_the_units_part(tmp_path: Path) -> None:
    """A receiver that was heard in one of two boots alone, once in the one that is kept, once in the other."""
    t = np.concatenate([FIRST, SECOND])
    for boot, count in ((0, 59), (1, 0)):
        blank = fixes(t, np.where(np.arange(len(t)) < len(FIRST), 0.0, 1000.0))
        for name in ("lat", "lon", "h"):
            blank[name][(np.arange(len(t)) % 100 > 0) | ((np.arange(len(t)) >= len(FIRST)) != boot) | (t < 60.5)] = (
                np.nan
            )
        log = read(tmp_path, unit(t) | blank, gnss=SHARED)
        assert len(log.samples["gnss"]) == pytest.approx(count, abs=1)
        found = survey(log)  # and goes on without it
        assert ("gnss" in found.rates) == (count > 0)
        assert ("gnss: none of its samples can be used: it is left out" in found.log.notes) == (count == 0)
        assert all(one.h < 1000 for one in log.samples["gnss"])


def test_a_sensor_whose_boots_are_not_known_is_told(tmp_path: Path) -> None:
    log = read(tmp_path, unit(np.concatenate([FIRST, SECOND])) | fixes(np.arange(1.0, 99.0)), gnss=FIXES)
    notes = [note for note in told(log, "gnss") if isinstance(note, Loss)]
    assert notes == [
        "gnss: its time goes back 0 times, that of imu 1 times: what is kept may be of another flight: "
        "leave all but one out of the file"
    ]


@pytest.mark.parametrize("wrap", [65.536, 86_400.0, 604_800.0, 2**32 * 1e-6, 2**32 * 1e-3])
@pytest.mark.parametrize("begins", [5.0, 25.0])
@pytest.mark.parametrize("moved", [0.0, -300.0])
def test_who_is_heard_after_a_clock_began_anew_is_as_late(
    wrap: float, begins: float, moved: float, tmp_path: Path
) -> None:
    """It begins anew 20 s after the unit's first row; as counters do, or less what it was at some time."""
    t, gt = np.arange(1, 6001) / 100, np.arange(begins, 60.0)
    since = wrap - 20
    table = unit((t + since) % wrap + moved) | fixes((gt + since) % wrap + moved)
    log = read(tmp_path, table, gnss=FIXES)
    offset = since + moved
    np.testing.assert_allclose(log.imus["imu"].t, t + offset, rtol=0, atol=1e-6)
    np.testing.assert_allclose([one.t for one in log.samples["gnss"]], gt + offset, rtol=0, atol=1e-6)
    assert not any(isinstance(note, Loss) for note in log.notes)


def test_who_is_heard_before_the_unit_and_its_clocks_new_turn_is_as_late(tmp_path: Path) -> None:
    t, gt = 30 + np.arange(1, 6001) / 100, np.arange(90.0)
    log = read(tmp_path, unit((t - 20) % 604_800) | fixes((gt - 20) % 604_800), gnss=FIXES)
    np.testing.assert_allclose(log.imus["imu"].t, t - 20, rtol=0, atol=1e-6)
    np.testing.assert_allclose([one.t for one in log.samples["gnss"]], gt - 20, rtol=0, atol=1e-6)
    assert "gnss: the clock began anew after 604800 s, 1 times before imu was heard" in log.notes


def test_a_counter_that_is_short_is_told_where_turns_are_not_known(tmp_path: Path) -> None:
    """Of 65 s, of a receiver that is heard from 70 s on, not of who is heard all the time; an offset mends it."""
    t, gt, bt = np.arange(1, 20_001) / 100, np.arange(70.0, 200.0), np.arange(1.0, 200.0)
    table = unit(t % 65.536) | fixes(gt % 65.536) | {"bt": bt % 65.536, "p": 95e3 + bt}
    log = read(tmp_path, table, gnss=FIXES, barometer=PRESSURES)
    assert [one.t for one in log.samples["barometer"]] == pytest.approx(bt)
    assert not any(isinstance(note, Loss) for note in told(log, "barometer"))
    notes = [note for note in told(log, "gnss") if isinstance(note, Loss)]
    assert len(notes) == 1
    assert notes[0].endswith("needs an offset of 65.536 s")
    mended = {**FIXES, "time": {"column": "gt", "offset": 65.536}}
    log = read(tmp_path, table, gnss=mended, barometer=PRESSURES)
    assert [one.t for one in log.samples["gnss"]] == pytest.approx(gt)
    assert not any(isinstance(note, Loss) for note in log.notes)


def test_who_is_heard_a_turn_before_the_unit_is_told(tmp_path: Path) -> None:
    """Nothing was said, and the receiver was 65 s late: it and the unit end together, or begin together."""
    t, gt = 70 + np.arange(1, 20_001) / 100, np.arange(271.0)
    table = unit(t % 65.536) | fixes(gt % 65.536) | {"h": gt}
    (told_of,) = [note for note in told(read(tmp_path, table, gnss=FIXES), "gnss") if isinstance(note, Loss)]
    assert told_of.endswith("if it is early or late its time needs an offset of -65.536 s")
    log = read(tmp_path, table, gnss={**FIXES, "time": {"column": "gt", "offset": -65.536}})
    first = log.imus["imu"].t[0] - t[0]
    assert [one.t - one.h for one in log.samples["gnss"]] == pytest.approx(np.full(271, first))


def test_turns_of_one_time_column_are_counted_by_its_rows(tmp_path: Path) -> None:
    t = np.arange(1, 20_001) / 100
    table = unit(t % 65.536) | fixes(t)
    for name in ("lat", "lon", "h"):
        table[name][(np.arange(len(t)) % 100 > 0) | (t < 70)] = np.nan
    log = read(tmp_path, table, gnss=SHARED)
    assert [one.t for one in log.samples["gnss"]] == pytest.approx([one.h for one in log.samples["gnss"]])
    assert len(log.samples["gnss"]) == 130
    assert not any(isinstance(note, Loss) for note in log.notes)
