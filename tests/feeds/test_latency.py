"""How late a receiver's velocities are by the inertial unit, of flights that are known by formula."""

from __future__ import annotations

import math
import re
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import testbed.__main__ as cli
from nav.samples import GnssSample, ImuSamples
from testbed import Scenario, run
from testbed.feeds.lateness import late_by_imu, latency
from testbed.feeds.log import Log
from testbed.feeds.samples import Fixes
from testbed.feeds.survey import survey
from testbed.score import likeness
from testbed.sensors.gnss import GnssConfig
from testbed.sensors.imu import ImuConfig

RATE_HZ, LASTS, SPEED = 100.0, 240.0, 12.0
ARM, NONE = (1.5, 0.8, -0.5), np.zeros(3)
TURNS, SWINGS = np.array([1.3, 0.47]), np.array([0.5, 0.4])  # of the course [rad/s, rad]


def receiver(t: np.ndarray, v_n: np.ndarray, noise: float) -> list[GnssSample]:
    told = Fixes(t, np.full(len(t), 0.8), np.full(len(t), 0.1), np.full(len(t), 500.0))
    told.v_n = v_n + noise * np.random.default_rng(1).standard_normal((len(t), 3))
    return told.samples("gnss")  # type: ignore[return-value]


def weaving(
    late: float, arm_b: tuple[float, float, float] = (0.0, 0.0, 0.0), noise: float = 0.05
) -> tuple[ImuSamples, list[GnssSample]]:
    """A level vehicle whose course swings, and a receiver of 5 Hz that is so late [s], its antenna at ``arm_b`` [m]."""

    def course(t: np.ndarray) -> np.ndarray:
        return np.asarray(np.sin(t[:, None] * TURNS) @ SWINGS)

    edges = np.arange(round(LASTS * RATE_HZ) + 1) / RATE_HZ
    turn = np.diff(course(edges))
    push = np.column_stack([0 * turn, SPEED * turn, np.full(len(turn), -9.8 / RATE_HZ)])
    imu = ImuSamples(edges[1:], np.diff(edges), turn[:, None] * [0.0, 0.0, 1.0], push)
    at = np.arange(1.0, LASTS, 0.2)
    heading, rate = course(at - late), np.cos((at - late)[:, None] * TURNS) @ (SWINGS * TURNS)
    ahead, aside = SPEED - rate * arm_b[1], rate * arm_b[0]
    east = np.sin(heading) * ahead + np.cos(heading) * aside
    return imu, receiver(at, np.column_stack([np.cos(heading) * ahead - np.sin(heading) * aside, east, 0 * at]), noise)


def seconds(imu: ImuSamples, own: list[GnssSample], arm: np.ndarray) -> float:
    found = latency(imu, own, arm)
    return math.nan if found is None else found.s


def test_velocities_that_are_unknown_hide_no_latency() -> None:
    """One of a thousand did, and the whole log was taken for a receiver without velocities."""
    imu, own = weaving(0.36)
    for k in (3, *range(200, 230), 700):
        own[k].v_n[:] = np.nan
    assert seconds(imu, own, NONE) == pytest.approx(0.36, abs=0.011)


@pytest.mark.parametrize("arm", [ARM, (-1.0, 0.0, 0.0)])
def test_an_antenna_swings_about_the_unit(arm: tuple[float, float, float]) -> None:
    """One that is ahead of the unit moves aside before that does: its latency seemed less."""
    imu, own = weaving(0.2, arm)
    assert seconds(imu, own, np.array(arm)) == pytest.approx(0.2, abs=0.011)
    assert abs(seconds(imu, own, NONE) - 0.2) > 0.05


def test_a_unit_has_a_place_and_a_mounting_of_its_own() -> None:
    """The arm is from the unit to the antenna, in the axes of the unit."""
    angles = (10.0, -20.0, 130.0)
    roll, pitch, heading = angles
    C_bs = Rotation.from_euler("ZYX", [heading, pitch, roll], degrees=True).as_matrix()
    imu, own = weaving(0.2, ARM)
    imu = ImuSamples(imu.t, imu.dt, imu.dtheta @ C_bs, imu.dv @ C_bs)
    at = (0.4, -0.3, 0.2)
    told = GnssConfig.model_validate({"lever_arm_m": tuple(np.add(ARM, at).tolist())})
    mounted = ImuConfig.model_validate({"lever_arm_m": at, "mounting_deg": angles})
    log = Log(Path("a.npz"), "table", {"imu": imu}, {"gnss": own}, None, 0.0, {})
    found = late_by_imu(log, "gnss", own, {"gnss": told, "imu": mounted})
    assert found is not None
    assert found.s == pytest.approx(0.2, abs=0.011)


def written(
    folder: Path, late: float, told: str, arm: tuple[float, float, float] = (0.0, 0.0, 0.0), noise: float = 0.05
) -> Path:
    """The scenario of a table with a flight that weaves, its receiver ``told`` so."""
    imu, own = weaving(late, arm, noise)
    columns = {"at": np.array([one.t for one in own]), "v": np.array([one.v_n for one in own])}
    place = {key: np.array([getattr(one, key) for one in own]) for key in ("lat", "lon", "h")}
    rates = {"t": imu.t, "gyro": RATE_HZ * imu.dtheta, "accel": RATE_HZ * imu.dv}
    np.savez(folder / "flight.npz", **rates, **columns, **place)  # type: ignore[arg-type]
    path = folder / "flight.toml"
    path.write_text(
        'title = "weaving"\nduration_s = 230\n[truth]\nsource = "log"\nfile = "flight.npz"\n'
        '[truth.columns.imu]\ntime = "t"\ngyro = "gyro"\naccel = "accel"\n[truth.columns.gnss]\ntime = "at"\n'
        'lat = "lat"\nlon = "lon"\nheight = "h"\nvelocity = "v"\n[sensors.imu]\n'
        f'[sensors.gnss]\ngrade = "u-blox-m8"\n{told}\n'
    )
    return path


def test_a_told_lever_arm_is_known_to_the_survey_and_the_reference(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, 0.2, f"lever_arm_m = {list(ARM)}", ARM)
    monkeypatch.setattr("sys.argv", ["testbed", "log", str(path)])
    monkeypatch.setenv("COLUMNS", "200")
    with suppress(SystemExit):
        cli.main()
    shown = re.search(r"velocity is told of later than the motion by │ ([\d.]+) ± ([\d.]+) s", capsys.readouterr().out)
    assert shown is not None
    assert float(shown[1]) == pytest.approx(0.2, abs=0.011)
    found = re.search(r", ([\d.]+) ± [\d.]+ s late by the IMU", run(Scenario.load(path)).dataset.attrs["reference"])
    assert found is not None
    assert float(found[1]) == pytest.approx(0.2, abs=0.011)


@pytest.mark.ci
@pytest.mark.parametrize("late", [0.0, 0.03])
def test_a_flight_that_contradicts_the_told_latency_is_believed(late: float, tmp_path: Path) -> None:
    """It was asked only whether it speaks against the least of the grades, 0.1 s, which noise of 0.8 m/s hides."""
    path = written(tmp_path, late, "latency_s = 0.3", noise=0.8)
    found = re.search(r", ([\d.]+) ± [\d.]+ s late by the IMU", run(Scenario.load(path)).dataset.attrs["reference"])
    assert found is not None
    assert float(found[1]) == pytest.approx(late, abs=0.05)
    as_told = run(Scenario.load(path, {"sensors.gnss.latency_s": late}))
    assert "late by the IMU" not in as_told.dataset.attrs["reference"]


def test_a_latency_is_by_a_unit_that_feels_something() -> None:
    imu, own = weaving(0.2)
    dead = ImuSamples(imu.t, imu.dt, 0 * imu.dtheta, 0 * imu.dv)
    log = Log(Path("a.npz"), "table", {"dead": dead, "imu": imu}, {"gnss": own}, None, 0.0, {})
    found = late_by_imu(log, "gnss", own, {})
    assert found is not None
    assert found.s == pytest.approx(0.2, abs=0.011)


def test_a_receiver_of_the_testbeds_own_record_is_as_late_as_in_a_log_of_it() -> None:
    """A record says of each fix when it was valid and when it arrived; by the first of them none is late."""
    imu, own = weaving(0.2)
    written = Log(Path("a.bin"), "dataflash", {"imu": imu}, {"gnss": own}, None, 0.0, {})
    valid = [replace(one, t=one.t - 0.2, t_arrival=one.t) for one in own]
    record = replace(written, samples={"gnss": valid}, valid_times=True)
    late = [survey(log).latency["gnss"].s for log in (written, record)]
    assert late == pytest.approx([0.2, 0.2], abs=0.011)
    rows = likeness.compare(survey(written), survey(record))
    assert next(row for row in rows if row.what == "velocity is told of later by").alike


@pytest.mark.ci
@pytest.mark.parametrize(("late", "vibration", "known"), [(0.2, 1.0, 0.003), (0.2, 8.0, 0.025), (0.02, 3.0, 0.01)])
def test_how_well_a_latency_is_known_under_vibration(late: float, vibration: float, known: float) -> None:
    """White vibration of 8 m/s^2 made the least misfit of single steps scatter by 0.06 s, and two digits were told.

    The oracle is what many draws are off by.
    """
    imu, own = weaving(late, noise=0.0)
    off = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        shaken = replace(imu, dv=imu.dv + vibration / RATE_HZ * rng.standard_normal(imu.dv.shape))
        noisy = [replace(one, v_n=one.v_n + rng.normal(0.0, 0.05, 3)) for one in own]
        found = latency(shaken, noisy, NONE)
        assert found is not None
        off.append((found.s - late, found.sigma))
    error, sigma = np.array(off).T
    assert np.sqrt(np.mean(error**2)) < known
    assert np.mean(np.abs(error) < sigma) == pytest.approx(0.68, abs=0.17)  # 2.3 sigma of 40 draws
    assert np.sqrt(np.mean((error / sigma) ** 2)) == pytest.approx(1.0, abs=0.3)


def test_a_unit_that_shakes_at_rest_shows_no_latency() -> None:
    """Of 20 draws 8 were believed to show one, as the noise of the unit is another for each lag."""
    still = np.arange(1, round(LASTS * RATE_HZ) + 1) / RATE_HZ
    at = np.arange(1.0, LASTS)
    found = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        dv = rng.standard_normal((len(still), 3)) / RATE_HZ - [0.0, 0.0, 9.8 / RATE_HZ]
        imu = ImuSamples(still, np.full(len(still), 1 / RATE_HZ), np.zeros((len(still), 3)), dv)
        found.append(latency(imu, receiver(at, 0.05 * rng.standard_normal((len(at), 3)), 0.0), NONE))
    assert sum(one is not None for one in found) <= 1
