"""Tables whose sensors have times of their own: of clocks that differ, with holes, with rows that were there before."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nav.samples import ImuSamples
from testbed.errors import UserError
from testbed.feeds import formats
from testbed.feeds.log import Log
from testbed.feeds.stamps import Loss, bridged
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


@pytest.mark.parametrize("times", [["t"], ["gt"], ["gt", "rt"]])
def test_sensors_of_clocks_that_differ_are_named_with_their_times(times: list[str], tmp_path: Path) -> None:
    made = table()
    for name in times:
        made[name] = made[name] + 1.7e9
    with pytest.raises(UserError, match=r"no time in common with imu has gnss \(") as caught:
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


INCREMENTS = {"imu": {"form": "increments"}}
TURN = 0.1  # [rad/s], of each increment, and of nothing else


def increments(kept: Any = slice(None)) -> dict[str, Any]:
    made = table()
    return made | {"t": T[kept].copy(), "w": made["w"][kept] / IMU_HZ, "f": made["f"][kept] / IMU_HZ}


def unit(made: Mapping[str, Any], folder: Path) -> tuple[ImuSamples, list[str]]:
    """The unit's increments, and what was told of it."""
    log = read(made, folder, INCREMENTS)
    return log.imus["imu"], [note for note in log.notes if note.startswith("imu: ")]


@pytest.mark.parametrize(("rows", "known"), [(1, True), (4, True), (8, False), (15, False), (400, False)])
@pytest.mark.parametrize("blank", [False, True])
def test_missing_increments_are_no_rest(rows: int, known: bool, blank: bool, tmp_path: Path) -> None:
    """A few are like their neighbours, more are unknown; each row that there is has its own step."""
    lost = np.isin(np.arange(len(T)), [at + k for at in (2000, 7000) for k in range(rows)])
    made = increments(slice(None) if blank else ~lost)
    if blank:
        made["w"][lost], made["f"][lost] = np.nan, np.nan
    imu, notes = unit(made, tmp_path)
    assert np.allclose(imu.t - imu.dt, np.concatenate([[0.0], imu.t[:-1]]), rtol=0, atol=1e-9)
    imu = bridged(imu)
    unknown = np.isnan(imu.dtheta).any(axis=1)
    assert imu.dt[unknown].sum() == pytest.approx(0.0 if known else 2 * rows / IMU_HZ)
    assert np.allclose(imu.dtheta[~unknown, 0], TURN * imu.dt[~unknown])
    assert any("rows are missing in 2 places" in note for note in notes)
    assert any(isinstance(note, Loss) for note in notes) == (rows > 60)


def test_what_is_measured_of_a_log_is_of_the_increments_that_it_has(tmp_path: Path) -> None:
    found = survey(read(increments(~np.isin(np.arange(len(T)), np.arange(7000, 7200))), tmp_path, INCREMENTS))
    assert [phase.name for phase in found.phases] == ["flying"]
    assert np.isfinite(found.vibration["imu"].rms)
    assert found.rates["imu"].rate_hz == pytest.approx(IMU_HZ)
    assert found.rates["imu"].gaps == 1


def test_increments_that_are_often_missing_are_told_aloud(tmp_path: Path) -> None:
    imu, notes = unit(increments(np.random.default_rng(1).random(len(T)) > 0.1), tmp_path)
    assert imu.dtheta[:, 0].sum() == pytest.approx(TURN * imu.t[-1])
    assert [type(note) for note in notes] == [Loss]


def test_increments_with_a_part_that_is_no_number_are_unknown_and_told(tmp_path: Path) -> None:
    made = increments()
    made["w"][[500, 900], 1] = np.nan
    imu, notes = unit(made, tmp_path)
    assert np.flatnonzero(np.isnan(imu.dtheta).any(axis=1)).tolist() == [500, 900]
    assert notes == ["imu: increments of 2 rows are no numbers, and unknown"]


@pytest.mark.parametrize("every", [2, 3, 20, 500])
def test_increments_that_share_a_time_happened_one_after_the_other(every: int, tmp_path: Path) -> None:
    """A clock too coarse for them, or a stamp that was not read anew."""
    made = increments()
    k = np.arange(1, len(T) - 1, every)
    made["t"][k] = made["t"][k - 1]
    imu, notes = unit(made, tmp_path)
    assert len(imu) == len(T)
    assert imu.dtheta[:, 0].sum() == pytest.approx(TURN * T[-1])
    assert np.allclose(imu.t, T, rtol=0, atol=1.01 / IMU_HZ)
    assert len(notes) == 1
    assert notes[0].endswith("share the time of the one before, and are put after it")


def test_increments_that_are_told_again_happened_once(tmp_path: Path) -> None:
    made = increments(np.sort(np.concatenate([np.arange(len(T)), np.arange(100, len(T), 50)])))
    imu, notes = unit(made, tmp_path)
    assert imu.dtheta[:, 0].sum() == pytest.approx(TURN * T[-1])
    assert len(imu) == len(T)
    assert "come again, and are left out" in notes[0]


@pytest.mark.parametrize("burst", [1, 2, 3, 4])
def test_times_that_come_early_or_late_are_no_sign_of_missing_increments(burst: int, tmp_path: Path) -> None:
    """Stamps of a computer that hears of several rows at once, or of one that is sometimes busy."""
    made = increments()
    rng = np.random.default_rng(burst)
    late = np.ceil(np.arange(1, len(T) + 1) / burst) * burst / IMU_HZ
    made["t"] = late + np.arange(len(T)) % burst * 1e-4 + rng.uniform(0, 0.2 / IMU_HZ, len(T)) * (burst == 1)
    made["t"][::97] += 0.6 / IMU_HZ * (burst == 1)
    imu, notes = unit(made, tmp_path)
    assert imu.dtheta[:, 0].sum() == pytest.approx(TURN * T[-1])
    assert notes == []


def held(t: np.ndarray) -> dict[str, Any]:
    """The table with the receiver's newest row at each of the times ``t``."""
    made = table()
    rows = np.searchsorted(made["gt"], t, side="right") - 1
    told = {name: made[name][rows] for name in ("lat", "lon", "h", "v")}
    return made | told | {"gt": t, "rt": t}


def test_fixes_that_are_held_on_are_no_new_ones(tmp_path: Path) -> None:
    """Nor is the last one before a receiver fell silent."""
    made = held(T)
    silent = (T > 20) & (T < 40)
    for name in ("lat", "lon", "h", "v"):
        made[name][silent] = made[name][np.flatnonzero(silent)[0]]
    log = read(made, tmp_path)
    t = np.array([one.t for one in log.samples["gnss"]])
    assert len(t) == pytest.approx((SECONDS - 20) * GNSS_HZ, abs=3)
    assert not ((t > 20.3) & (t < 39.7)).any()
    assert np.median(np.diff(t)) == pytest.approx(1 / GNSS_HZ)
    notes = [note for note in log.notes if "hold what the one before had" in note]
    assert [(note.split(":")[0], type(note)) for note in notes] == [("gnss", Loss), ("reference", Loss)]


def test_a_reference_that_is_held_on_is_as_seldom_as_it_was(tmp_path: Path) -> None:
    """Its rows between would be a vehicle that stands still and jumps."""
    log = read(held(T), tmp_path)
    assert log.solution is not None
    assert np.median(np.diff(log.solution.t)) == pytest.approx(1 / GNSS_HZ)
    assert any(note.startswith("reference: ") and "hold what the one before had" in note for note in log.notes)


@pytest.mark.parametrize("hz", [1, 5, 20])
def test_a_receiver_that_stands_still_is_heard_at_its_own_rate(hz: int, tmp_path: Path) -> None:
    own = np.arange(1, SECONDS * hz) / hz + 0.0013
    log = read({**held(own), "h": np.full(len(own), 500.0), "v": np.zeros((len(own), 3))}, tmp_path)
    assert len(log.samples["gnss"]) == len(own)


def test_a_sensor_of_the_units_rate_may_say_the_same_again(tmp_path: Path) -> None:
    made = held(T)
    made["h"] = 500.0 + np.maximum(np.arange(len(T)) - 4000, 0) * 0.01  # it stands for twenty seconds
    made["v"][:4000], made["lat"][:4000] = 0.0, 0.8
    assert len(read(made, tmp_path).samples["gnss"]) == len(T)
