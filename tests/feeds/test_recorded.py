"""A recorded flight is a feed like the simulated one: same samples, same estimates; denial and faults act alike."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worlds import log_writers, real_flights
from worlds.loop import same
from worlds.recordings import log_of

from nav.samples import ImuSamples
from testbed import Scenario, run
from testbed.feeds.log import Reference
from testbed.feeds.reference import with_rates
from testbed.loop.loop import RunResult
from testbed.score import metrics
from testbed.score.accuracy import column
from testbed.sensors.imu import ImuConfig

FLIGHT = {
    "duration_s": 30,
    "sensors.gnss.settle_factor": 1.0,
    "sensors.gnss.denied": [],
}
ESTIMATORS = """
[[estimator]]
name = "fed"
kind = "federated"
gust_mps = 1.0
locals = [{ name = "gnss", aids = ["gnss"] }, { name = "air", aids = ["barometer", "airspeed"] }]

[[estimator]]
name = "ahrs"
kind = "ahrs"
gust_mps = 1.0
aids = ["magnetometer", "airspeed", "barometer"]
"""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, RunResult]:
    """A clean flight with three estimators: its text, and what came of it."""
    text = Scenario.load("u_turn").text + ESTIMATORS
    return text, fly(text, FLIGHT, tmp_path_factory.mktemp("flown"))


def fly(text: str, changes: Mapping[str, Any], folder: Path) -> RunResult:
    path = folder / "flight.toml"
    path.write_text(text, "utf-8")
    return run(Scenario.load(path, changes), out=folder)


def again(flown: RunResult, text: str, changes: Mapping[str, Any], folder: Path) -> RunResult:
    """The same scenario with the record in place of its motion."""
    assert flown.path is not None
    return fly(log_of(text, flown.path / "run.nc", 'aircraft = "loiter"'), {**FLIGHT, **changes}, folder)


@pytest.mark.ci
def test_attitudes_are_judged_between_the_fixes_of_a_slow_receiver(tmp_path: Path) -> None:
    """By the log's solution at its own rate: between two fixes an aircraft in a turn does not turn evenly."""
    text = Scenario.load("u_turn").text
    slow = {**FLIGHT, "sensors.gnss.rate_hz": 1.0, "truth.wind.turbulence": "severe"}
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
    first = fly(text, slow, tmp_path / "first")
    second = again(first, text, {"sensors.gnss.rate_hz": 1.0, "truth.reference": "gnss"}, tmp_path / "second")
    true, judged = (
        (one.dataset["truth"]["time"].to_numpy(), one.dataset["truth"]["q_nb"].to_numpy()) for one in (first, second)
    )
    _, i, j = np.intersect1d(true[0].round(3), judged[0].round(3), return_indices=True)
    known = np.isfinite(judged[1][j]).all(axis=1)
    off = Rotation.from_quat(true[1][i][known]).inv() * Rotation.from_quat(judged[1][j][known])
    assert known.sum() > 0.8 * len(i)
    assert np.degrees(off.magnitude()).max() < 0.1


def test_a_record_as_log_gives_every_estimate_bit_for_bit(flown: tuple[str, RunResult], tmp_path: Path) -> None:
    text, first = flown
    second = again(first, text, {}, tmp_path)
    for group in ("estimators", "sensors"):
        assert same(first.dataset[group], second.dataset[group]), group
    scores = metrics.compute(first.dataset, settling_s=10.0)
    mine = {key: value for key, value in scores.items() if not key.startswith("flight.")}
    assert len(mine) > 100
    assert metrics.compute(second.dataset, settling_s=10.0) == mine
    assert second.dataset.attrs["reference"] == "simulated truth"


@pytest.mark.ci
@pytest.mark.parametrize(
    "changes",
    [
        {"sensors.gnss.denied": [[15, 20]]},
        {"sensors.gnss.jammers": [{"lat_deg": 47.0, "lon_deg": 8.0, "radius_m": 2e4}]},
        {
            "fault": [
                {"sensor": "gnss", "kind": "drag_off", "window": [10, 25], "bearing_deg": 90.0, "velocity_mps": 2.0},
                {"sensor": "imu", "kind": "step", "channel": "gyro_x", "window": [15, 25], "size": 0.5},
                {"sensor": "barometer", "kind": "dropout", "window": [8, 14]},
            ]
        },
    ],
    ids=["denied", "jammed", "faults"],
)
def test_denial_and_faults_act_on_a_log_as_on_a_simulation(
    flown: tuple[str, RunResult], changes: dict[str, Any], tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    text, first = flown
    simulated = fly(text, {**FLIGHT, **changes}, tmp_path)
    recorded = again(first, text, changes, tmp_path_factory.mktemp("again"))
    assert not same(first.dataset["estimators"], simulated.dataset["estimators"])
    assert same(simulated.dataset["estimators"], recorded.dataset["estimators"])
    assert same(simulated.dataset["sensors"], recorded.dataset["sensors"])


LOSSY = """
title = "lossy"
duration_s = 12
date = 2026-06-01
[truth]
source = "kinematic"
motion = "segments"
rate_hz = 100
start = { lat_deg = 47.0, lon_deg = 8.0, alt_m = 300, speed_mps = 40 }
[[truth.segments]]
leg = "straight"
duration_s = 12
[sensors.imu]
rate_hz = 100
[sensors.gnss]
dropout_percent = 20
[sensors.barometer]
dropout_percent = 20
[sensors.rangefinder]
dropout_percent = 30
[sensors.body_velocity]
dropout_percent = 30
[record]
imu = true
"""


def test_what_was_lost_on_the_way_is_lost_once(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    """The samples of a record are all there, and those in windows of denial are taken away, no more."""
    first = fly(LOSSY, {}, tmp_path)
    second = again(first, LOSSY, {"duration_s": 12}, tmp_path_factory.mktemp("again"))
    assert same(first.dataset["sensors"], second.dataset["sensors"])
    assert not any("acts on none" in one for one in events(second))
    denied = again(
        first, LOSSY, {"duration_s": 12, "sensors.rangefinder.denied": [[3, 5]]}, tmp_path_factory.mktemp("denied")
    )
    t = column(first.dataset, "sensors/rangefinder/time")
    assert 0.5 < len(t) / 120 < 0.9
    np.testing.assert_array_equal(
        column(denied.dataset, "sensors/rangefinder/time"), t[(t < 3 - 1e-9) | (t >= 5 - 1e-9)]
    )


def events(result: RunResult) -> list[str]:
    return [str(one) for one in result.dataset["events"].dataset["text"].values]


def test_losses_that_are_asked_of_a_log_are_told() -> None:
    """Of what was given, and not of what a grade says."""
    changes = {
        "duration_s": 5,
        "sensors.gnss.denied": [],
        "sensors.gnss.grade": "u-blox-m8",
        "sensors.barometer.jitter_s": 0.01,
        "sensors.imu.dropout_percent": 3.0,
    }
    told = [one for one in events(run(Scenario.load("recorded_flight", changes))) if "acts on none" in one]
    assert len(told) == 2
    assert "sensors.imu.dropout_percent" in told[0]
    assert "sensors.barometer.jitter_s" in told[1]


def written(name: str, dataset: Any, folder: Path) -> Path:
    match name:
        case "bin":
            return log_writers.dataflash(log_writers.dataflash_rows(dataset), folder / "00000001.BIN")
        case "log":
            return log_writers.dataflash_text(log_writers.dataflash_rows(dataset), folder / "1.log")
        case "ulg":
            return log_writers.ulog(log_writers.ulog_rows(dataset), folder / "flight")  # known by content
    return log_writers.csv(dataset, folder / "flight.csv")


# DataFlash and ULog have one accuracy for three axes of velocity, places in 1e-7 deg and heights in centimetres.
COARSE = {"lat": 2e-9, "lon": 4e-9, "h": 0.02, "v_n": 0.02, "q_nb": 0.005}
FINE = {"lat": 1e-12, "lon": 1e-12, "h": 1e-4, "v_n": 1e-4, "q_nb": 1e-4}


@pytest.mark.ci
@pytest.mark.parametrize(("name", "near"), [("bin", COARSE), ("log", COARSE), ("ulg", COARSE), ("csv", FINE)])
def test_a_flight_written_in_another_format_gives_the_same_within_its_resolution(
    flown: tuple[str, RunResult], tmp_path: Path, name: str, near: Mapping[str, float]
) -> None:
    text, first = flown
    columns = log_writers.csv_columns() if name == "csv" else ""
    file = written(name, first.dataset, tmp_path)
    again = fly(log_of(text, file, f'aircraft = "loiter"\n{columns}'), FLIGHT, tmp_path)
    for key, most in near.items():
        before, after = (column(one.dataset, f"estimators/ins/{key}") for one in (first, again))
        np.testing.assert_allclose(after, before, rtol=0, atol=most, err_msg=key)
    for key in ("truth/lat", "truth/lon"):
        true, known = (column(one.dataset, key) for one in (first, again))
        judged = np.isfinite(known)
        assert judged.mean() > 0.95
        assert np.abs(known - true)[judged].max() < (1e-6 if name == "csv" else 1e-8)  # GNSS, or the solution


@pytest.mark.ci
@pytest.mark.skipif(not real_flights.available(), reason="TESTBED_RECORDINGS names no folder of recordings")
@pytest.mark.parametrize("name", real_flights.FLIGHTS)
def test_real_flights_run(name: str, tmp_path: Path) -> None:
    """With the grades of such parts and nothing else; each was half a metre or more within its bound when flown."""
    result = fly(real_flights.FLIGHTS[name], {}, tmp_path)
    assert result.metrics["ins.position_horizontal_rms_m"] < {"thor": 3.0, "swiss": 4.0, "quad": 2.0}[name]
    assert result.metrics["ins.nis_mean.gnss_position"] < 2.0
    assert {"ins.aligned_s", "ahrs.aligned_s", "ins.nis_mean.gnss_position"} <= result.metrics.keys()
    # The magnetometer of the first is off by the size of the field, which tells no heading before it flies.
    assert result.metrics["ins.aligned_s"] < {"thor": 156, "swiss": 10, "quad": 10}[name]
    assert all(np.isfinite(value) for value in result.metrics.values())
    assert result.failure == ""


def test_a_reference_has_the_rates_of_the_body_whatever_the_unit_lies_like() -> None:
    """Rates as the motion has them: of a unit that lies turned, and whose increments are lost now and then."""
    t, omega_b = 0.01 * np.arange(1, 301), np.array([0.2, -0.1, 0.4])
    turned = Rotation.from_euler("ZYX", [90.0, 10.0, 180.0], degrees=True)  # from its axes to the body's
    dtheta = np.tile(0.01 * turned.inv().apply(omega_b), (300, 1))
    dtheta[100], dtheta[250:] = np.nan, np.nan
    imu = ImuSamples(t, np.full(300, 0.01), dtheta, np.tile([0.0, 0.0, -0.098], (300, 1)))
    config = ImuConfig.model_validate({"mounting_deg": (180.0, 10.0, 90.0)})
    found = with_rates(Reference("a receiver", np.array([0.5, 1.01, 2.9]), {}), imu, config.errors().C_sb)
    np.testing.assert_allclose(found.columns["omega_b"], np.tile(omega_b, (3, 1)), atol=1e-12)
