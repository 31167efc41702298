"""A DataFlash log read back by pymavlink holds the record, to the resolution of its messages."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from pymavlink import DFReader

from testbed import Scenario, run
from testbed.exports import dataflash, export
from testbed.exports.dataflash import MESSAGES
from testbed.record.reader import load
from testbed.report.page import write_report
from testbed.score.accuracy import euler

pytestmark = pytest.mark.ci

START_US = 1_000_000


@pytest.fixture(scope="module")
def record(flown: Path) -> Any:
    return load(flown)


@pytest.fixture(scope="module")
def messages(flown: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    return read(export(flown, "bin", tmp_path_factory.mktemp("bin") / "run.bin"))


def read(path: Path) -> dict[str, list[Any]]:
    """Messages by name."""
    reader = DFReader.DFReader_binary(str(path))
    found: dict[str, list[Any]] = {}
    with contextlib.closing(reader.filehandle), contextlib.closing(reader.data_map):
        while (message := reader.recv_msg()) is not None:
            found.setdefault(message.get_type(), []).append(message)
    return found


def column(messages: dict[str, list[Any]], name: str, field: str, unit: int | None = None, by: str = "I") -> Any:
    return np.array([getattr(m, field) for m in messages[name] if unit is None or getattr(m, by) == unit])


def us(t: Any) -> Any:
    return START_US + np.rint(np.asarray(t) * 1e6).astype(np.int64)


def test_inertial_samples_are_the_records(messages: dict[str, list[Any]], record: Any) -> None:
    imu = record["sensors/imu"]
    np.testing.assert_array_equal(column(messages, "IMU", "TimeUS"), us(imu["time"].values))
    rate = imu["dtheta"].values / imu["dt"].values[:, None]
    force = imu["dv"].values / imu["dt"].values[:, None]
    for k, axis in enumerate("XYZ"):
        np.testing.assert_array_equal(column(messages, "IMU", f"Gyr{axis}"), rate[:, k].astype(np.float32))
        np.testing.assert_array_equal(column(messages, "IMU", f"Acc{axis}"), force[:, k].astype(np.float32))


@pytest.mark.parametrize(("name", "unit"), [("gnss", 0), ("second", 1)])
def test_fixes_are_the_records(messages: dict[str, list[Any]], record: Any, name: str, unit: int) -> None:
    gnss = record[f"sensors/{name}"]
    fix = gnss["fix_type"].values >= 3
    np.testing.assert_array_equal(column(messages, "GPS", "TimeUS", unit), us(gnss["t_arrival"].values))
    np.testing.assert_array_equal(column(messages, "GPS", "Status", unit), np.where(fix, 3, 1))
    for field, key, half in (("Lat", "lat", 0.51e-7), ("Lng", "lon", 0.51e-7)):
        found = column(messages, "GPS", field, unit)[fix]
        np.testing.assert_allclose(found, np.degrees(gnss[key].values[fix]), rtol=0, atol=half)
    np.testing.assert_allclose(column(messages, "GPS", "Alt", unit)[fix], gnss["h"].values[fix], rtol=0, atol=0.0051)
    v, speed = gnss["v_n"].values[fix], column(messages, "GPS", "Spd", unit)[fix]
    np.testing.assert_allclose(speed, np.hypot(v[:, 0], v[:, 1]), rtol=1e-6)
    sigma = gnss["sigma_position_n"].values[fix]
    np.testing.assert_allclose(column(messages, "GPA", "VAcc", unit)[fix], sigma[:, 2], rtol=0, atol=0.0051)
    assert set(column(messages, "GPS", "GWk")) == {2421}  # of 2026-06-01, a Monday
    np.testing.assert_allclose(
        column(messages, "GPS", "GMS", unit), (86400 + 18 + gnss["time"].values) * 1e3, rtol=0, atol=0.51
    )


def test_the_other_sensors_are_the_records(messages: dict[str, list[Any]], record: Any) -> None:
    for name, field, sensor, key in (
        ("BARO", "Press", "barometer", "pressure"),
        ("ARSP", "Airspeed", "airspeed", "eas"),
    ):
        values = record[f"sensors/{sensor}/{key}"].values
        np.testing.assert_array_equal(column(messages, name, field), values.astype(np.float32))
    field_b = record["sensors/magnetometer/field_b"].values * 1e7  # milligauss
    for k, axis in enumerate("XYZ"):
        np.testing.assert_allclose(column(messages, "MAG", f"Mag{axis}"), field_b[:, k], rtol=0, atol=0.501)


def test_truth_and_estimates_are_the_records(messages: dict[str, list[Any]], record: Any) -> None:
    truth = record["truth"]
    for k in range(4):
        found = column(messages, "SIM", f"Q{k + 1}")
        np.testing.assert_array_equal(found, truth["q_nb"].values[:, k].astype(np.float32))
    for core, name in enumerate(("ins", "level")):
        own = record[f"estimators/{name}"]
        known = np.isfinite(own["q_nb"].values).all(axis=1)
        np.testing.assert_array_equal(column(messages, "XKF1", "TimeUS", core, "C"), us(own["time"].values[known]))
        angles = np.degrees(euler(own["q_nb"].values[known]))
        np.testing.assert_allclose(column(messages, "XKF1", "Pitch", core, "C"), angles[:, 1], rtol=0, atol=0.0051)
    assert np.isnan(column(messages, "XKF1", "PN", 1, "C")).all()  # attitude is all that it estimates
    assert [m.Message for m in messages["MSG"]][1:] == list(record["events/text"].values)


def test_a_long_text_goes_on_in_further_messages(flown: Path, tmp_path: Path) -> None:
    """They have room for 64 bytes: of 200 Pa the 20 were told."""
    said = ["fault barometer_pressure_step begins: barometer pressure step 200 Pa", 63 * "a" + "µ" + 40 * "€"]
    shutil.copy(flown, tmp_path / "run.nc")
    with h5py.File(tmp_path / "run.nc", "r+") as file:
        file["events/text"][:2] = np.array([text.encode() for text in said], "S320").view("S1").reshape(2, 320)
    messages = read(export(tmp_path / "run.nc", "bin"))
    record = load(tmp_path / "run.nc")["events"]
    texts = [one.Message for one in messages["MSG"][1:]]
    assert "".join(texts) == "".join(record["text"].values)
    assert max(len(text.encode()) for text in texts) <= 64
    assert texts[:2] == [said[0][:64], said[0][64:]]
    assert messages["MSG"][1].TimeUS == messages["MSG"][2].TimeUS == us(record["time"].values[0])


def test_units_and_labels_fit_the_letters(messages: dict[str, list[Any]]) -> None:
    for name, own in MESSAGES.items():
        assert len(own.letters) == len(own.labels.split(",")) == len(own.units) == len(own.factors), name
        assert len(own.labels) <= 64, name
    assert messages["MAG"][0].fmt.instance_field == "I"
    gyro = messages["IMU"][0].fmt
    assert gyro.units[gyro.columns.index("GyrX")] == "rad/s"


def test_what_is_too_large_for_a_field_is_the_largest() -> None:
    one = dataflash._rows("GPA", np.array([us(0.0)]), HAcc=1e6, VAcc=np.nan)
    assert (one["HAcc"][0], one["VAcc"][0]) == (65535, 0)
    with pytest.raises(KeyError):
        dataflash._rows("GPA", np.array([us(0.0)]), Hacc=1.0)


def test_what_no_sensor_measures_is_no_matter(tmp_path: Path) -> None:
    """Numbers beyond those of the message, and none at all, end neither the report nor the export, nor warn."""
    garbage = {"sensor": "imu", "channel": "accel", "kind": "garbage", "window": [20.0, 25.0]}
    scenario = Scenario.load("static_bench", {"duration_s": 40.0, "fault": [garbage]})
    found = run(scenario, out=tmp_path)
    write_report(found.dataset, found.metrics, tmp_path)
    assert export(tmp_path / "run.nc", "bin", tmp_path / "run.bin").stat().st_size > 0
