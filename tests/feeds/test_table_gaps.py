"""Tables whose sensors are silent for long, slow for a part, or coarse: nothing that happened is left out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nav.samples import ImuSamples
from testbed import Scenario, run
from testbed.errors import UserError
from testbed.feeds import formats
from testbed.feeds.lateness import latency
from testbed.feeds.log import Log
from testbed.feeds.samples import Fixes
from testbed.feeds.stamps import Loss
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


@pytest.mark.parametrize("lost", [0, 30])
def test_increments_of_steps_that_differ_are_whole(lost: int, tmp_path: Path) -> None:
    """A unit that is read when there is time for it says what it felt since it was read last; rows may be lost too."""
    rng = np.random.default_rng(51003)
    dt = rng.gamma(16.0, 0.01 / 16, 6000)
    table = {"t": np.cumsum(dt), "w": np.outer(dt, [0.1, 0, 0]), "f": np.outer(dt, [0, 3.0, -9.8])}
    table["f"] += 0.005 * rng.standard_normal((6000, 3))
    kept = np.ones(6000, bool)
    kept[rng.choice(np.arange(100, 5900, 10), lost, replace=False)] = False
    log = read(tmp_path, {name: one[kept] for name, one in table.items()}, imu={**IMU, "form": "increments"})
    assert log.imus["imu"].dtheta[:, 0].sum() == pytest.approx(0.1 * dt.sum(), rel=0.005 if lost else 1e-9)
    assert any("rows are missing" in note for note in log.notes) == (lost > 0)


@pytest.mark.parametrize("vibration", [2.0, 8.0])
def test_of_a_steady_unit_that_vibrates_all_missing_rows_are_found(vibration: float, tmp_path: Path) -> None:
    rng = np.random.default_rng(51007)
    t = np.arange(1, 20001) / 100
    table = {
        "t": t,
        "w": np.tile([1e-3, 0, 0], (20000, 1)),
        "f": rng.normal([0, 0, -0.098], 0.01 * vibration, (20000, 3)),
    }
    kept = np.ones(20000, bool)
    kept[rng.choice(np.arange(100, 19900, 10), 200, replace=False)] = False
    log = read(tmp_path, {name: one[kept] for name, one in table.items()}, imu={**IMU, "form": "increments"})
    assert log.imus["imu"].dtheta[:, 0].sum() == pytest.approx(20.0, rel=1e-6)
    assert any("rows are missing in 200 places" in note for note in log.notes)


COARSE = np.round(9500 + 0.2 * np.random.default_rng(1).standard_normal(6000)) * 10
STEPS = np.repeat(np.random.default_rng(2).standard_normal(3000), np.random.default_rng(3).geometric(0.4, 3000))[:6000]


@pytest.mark.parametrize("values", [COARSE, STEPS, np.full(6000, 95e3), np.arange(6000) // 3000 * 20.0])
def test_who_says_the_same_by_chance_is_heard_each_time(values: np.ndarray, tmp_path: Path) -> None:
    """A barometer of little resolution, or one whose values do not change, at the rate of the unit."""
    table = unit(np.arange(6000) / 100) | {"p": values}
    log = read(tmp_path, table, barometer={"time": "t", "pressure": "p"})
    assert len(log.samples["barometer"]) == 6000
    assert not log.notes


@pytest.mark.parametrize("hz", [8, 40, 49])
def test_who_is_held_by_a_slower_clock_is_heard_at_its_own_rate(hz: int, tmp_path: Path) -> None:
    """And is frozen for a while."""
    t = np.arange(6000) / 100
    own = np.floor(t * hz)
    table = unit(t) | {"p": np.where((t > 20) & (t < 30), 0.0, np.sin(own))}
    log = read(tmp_path, table, barometer={"time": "t", "pressure": "p"})
    assert len(log.samples["barometer"]) == pytest.approx(50 * hz, abs=3)


@pytest.mark.parametrize("steps", [(0.005, 0.04), (0.001, 0.037)])
def test_who_is_held_is_told_by_rows_where_times_come_anyhow(steps: tuple[float, float], tmp_path: Path) -> None:
    t = np.cumsum(np.random.default_rng(51006).uniform(*steps, 5000))
    log = read(tmp_path, unit(t) | {"p": np.repeat(np.arange(1000.0), 5)}, barometer={"time": "t", "pressure": "p"})
    assert len(log.samples["barometer"]) == 1000


@pytest.mark.parametrize("seed", [1, 2])
def test_who_is_held_is_told_by_time_where_rows_come_anyhow(seed: int, tmp_path: Path) -> None:
    """Between one fix and the next a unit that is read by a busy computer has more rows or fewer."""
    t = np.cumsum(np.random.default_rng(seed).gamma(1.0, 0.01, 6000))
    own = np.floor(t * 4) / 4
    log = read(tmp_path, unit(t) | fixes(own) | {"gt": t}, gnss=GNSS)
    assert len(log.samples["gnss"]) == len(np.unique(own))


def coarse(t: np.ndarray, hz: float, jitter: float = 0.0) -> tuple[dict[str, Any], np.ndarray]:
    """Fixes of a receiver that wanders at rest for two minutes, then moves for one, at times t; when each was new."""
    rng = np.random.default_rng(7)
    own = np.arange(0.0, 180.0, 1 / hz)
    own = np.sort(own + jitter * rng.uniform(-0.5, 0.5, len(own)) / hz)
    north = np.cumsum(0.02 * rng.standard_normal(len(own))) + 5 * np.maximum(own - 120, 0)
    lat = np.round(0.8 + north / 6.4e6, 8)  # to 6 cm
    rows = np.maximum(np.searchsorted(own, t, side="right") - 1, 0)
    new = np.flatnonzero(np.diff(lat[rows], prepend=np.nan) != 0)
    return {"gt": t, "lat": lat[rows], "lon": np.full(len(t), 0.1), "h": np.full(len(t), 500.0)}, t[new]


@pytest.mark.parametrize("hz", [1.0, 4.0, 5.0, 8.0, 10.0])
@pytest.mark.parametrize("late", [0.0, 0.002])
def test_who_is_held_is_known_after_a_long_rest_where_it_often_says_the_same(
    hz: float, late: float, tmp_path: Path
) -> None:
    t = np.arange(18_000) / 100 + late * np.random.default_rng(3).random(18_000)
    held, new = coarse(t, hz)
    assert len(new) < 0.8 * 180 * hz
    log = read(tmp_path, unit(t) | held, gnss=GNSS)
    np.testing.assert_array_equal([one.t for one in log.samples["gnss"]], new)


def test_a_receiver_whose_rows_may_be_held_is_told(tmp_path: Path) -> None:
    """One that comes at any time: nothing says which of its rows are new."""
    t = np.arange(18_000) / 100
    log = read(tmp_path, unit(t) | coarse(t, 5.0, 1.0)[0], gnss=GNSS)
    assert len(log.samples["gnss"]) == len(t)
    notes = [note for note in log.notes if isinstance(note, Loss)]
    assert len(notes) == 1
    assert notes[0].startswith("gnss: 18000 rows, at the times of an IMU, are all taken for new")


@pytest.mark.parametrize("begins", [-400.0, -5.0, 61.0, 600.0])
def test_a_sensor_may_be_heard_before_the_unit_alone_or_after_it(begins: float, tmp_path: Path) -> None:
    table = unit(np.arange(6000) / 100) | fixes(begins + np.arange(3.0))
    log = read(tmp_path, table, gnss=GNSS)
    assert len(log.samples["gnss"]) == 3
    assert log.t0 == min(begins, 0.0)


@pytest.mark.parametrize("moved", [-700.0, 1000.0, -1e6])
def test_fixes_of_another_clock_are_refused(moved: float, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no time in common with imu has gnss"):
        read(tmp_path, unit(np.arange(6000) / 100) | fixes(moved + np.arange(3.0)), gnss=GNSS)


TWO = """
title = "two units"
duration_s = 5
[truth]
source = "log"
file = "a.npz"
columns.imu = { time = "t", gyro = "w", accel = "f" }
columns.spare = { kind = "imu", time = "t2", gyro = "w", accel = "f" }
columns.gnss = { time = "gt", lat = "lat", lon = "lon", height = "h" }
[[estimator]]
name = "ins"
aids = ["gnss"]
[sensors.imu]
[sensors.gnss]
"""


@pytest.mark.parametrize("moved", [100.0, 700.0, -700.0, 1.7e9, -1.7e9])
def test_a_second_unit_may_have_been_heard_later(moved: float, tmp_path: Path) -> None:
    """One that is years apart adds no years to go through; it is refused where it is made use of."""
    t = np.arange(6000) / 100
    table = unit(t) | fixes(np.arange(60.0)) | {"t2": t + moved}
    log = read(tmp_path, table, gnss=GNSS, spare={**IMU, "kind": "imu", "time": "t2"})
    assert list(log.imus) == ["imu", "spare"]
    assert log.t0 == 0.0
    (tmp_path / "a.toml").write_text(TWO)
    assert len(run(Scenario.load(tmp_path / "a.toml")).dataset["truth/lat"]) == 51
    if moved != 100.0:
        (tmp_path / "a.toml").write_text(TWO + '[sensors.spare]\nkind = "imu"\n')
        with pytest.raises(UserError, match=r"sensors\.spare: was heard from "):
            run(Scenario.load(tmp_path / "a.toml"))


@pytest.mark.parametrize("step", [0.0099, 0.0101, 0.02])
def test_a_spare_unit_may_be_a_little_faster_or_slower(step: float, tmp_path: Path) -> None:
    """By two crystals; it is given at the times of the first. One of another rate is refused."""
    t = np.arange(6000) / 100
    np.savez(tmp_path / "a.npz", **unit(t) | fixes(np.arange(60.0)) | {"t2": step * np.arange(6000)})
    (tmp_path / "a.toml").write_text(TWO + '[sensors.spare]\nkind = "imu"\n')
    if step < 0.02:
        run(Scenario.load(tmp_path / "a.toml", {"estimator.ins.spare_imus": ["spare"]}))
    else:
        with pytest.raises(UserError, match=r"has 50 Hz, not the 100 Hz of 'imu'"):
            run(Scenario.load(tmp_path / "a.toml", {"estimator.ins.spare_imus": ["spare"]}))


def test_fixes_may_come_as_often_as_increments(tmp_path: Path) -> None:
    """As those of a receiver's solution that somebody interpolated: no one gave that rate, nor can mend it."""
    t = np.arange(6000) / 200
    np.savez(tmp_path / "a.npz", **unit(t) | fixes(t) | {"t2": t})
    (tmp_path / "a.toml").write_text(TWO)
    assert len(run(Scenario.load(tmp_path / "a.toml")).dataset["truth/lat"]) == 51


def test_a_log_that_begins_later_than_it_is_heard_says_so(tmp_path: Path) -> None:
    log = read(tmp_path, unit(700 + np.arange(6000) / 100) | fixes(np.arange(750.0)), gnss=GNSS)
    assert log.t0 == 700.0
    assert "it begins with its IMU: what is heard up to 700 s before is left out" in log.notes


@pytest.mark.filterwarnings("ignore:All-NaN slice")  # of a receiver without velocity, by numpy
def test_losses_are_told_of_what_a_run_makes_use_of(tmp_path: Path) -> None:
    """A reference by its own name, and no sensor that it leaves alone."""
    twice = np.concatenate([np.arange(60.0), np.arange(20.0)])
    known = fixes(np.arange(60.0)) | {f"r{name}": values for name, values in fixes(twice).items()}
    np.savez(tmp_path / "a.npz", **unit(np.arange(6000) / 100), **known, t2=np.arange(60.0))
    again = 'time = "rgt", lat = "rlat", lon = "rlon", height = "rh" }\n'
    streams = f'columns.known = {{ kind = "reference", {again}columns.other = {{ kind = "gnss", {again}'
    spare = 'columns.spare = { kind = "imu", time = "t2", gyro = "w", accel = "f" }\n'
    (tmp_path / "a.toml").write_text(TWO.replace(spare, streams))

    def told(**changes: Any) -> list[str]:
        remarks = run(Scenario.load(tmp_path / "a.toml", changes)).remarks
        return [name for name in ("known", "other") for one in remarks if f"{name}: time goes back" in one]

    assert told() == ["known"]
    assert told(**{"truth.reference": "gnss"}) == []
    assert told(**{"truth.reference": "gnss", "sensors.other.kind": "gnss"}) == ["other"]


def latency_of(late: float, period: float) -> float | None:
    """The latency found of a receiver that is so late, of a vehicle that goes to and fro."""
    t, turn = np.arange(1, 30_001) / 100, 2 * np.pi / period
    push = np.column_stack([8 * np.sin(turn * (t - 0.005)), 0 * t, np.full(len(t), -9.8)])
    at = np.arange(0, 300, 0.2)
    told = Fixes(at, np.full(len(at), 0.8), np.full(len(at), 0.1), np.full(len(at), 500.0))
    told.v_n = np.column_stack([-8 / turn * np.cos(turn * (at - late)), 0 * at, 0 * at])
    told.v_n += 0.05 * np.random.default_rng(1).standard_normal((len(at), 3))
    imu = ImuSamples(t, np.full(len(t), 0.01), np.zeros((len(t), 3)), 0.01 * push)
    found = latency(imu, told.samples("gnss"), np.zeros(3))
    return None if found is None else found.s


@pytest.mark.ci
@pytest.mark.parametrize("period", [2.0, 5.0])
@pytest.mark.parametrize("late", [0.0, 0.1, 0.4, 0.65, 0.7])
def test_a_latency_is_found_however_the_vehicle_swings(late: float, period: float) -> None:
    """A vehicle that goes to and fro moves alike half a swing later."""
    assert latency_of(late, period) == pytest.approx(late, abs=0.011)
