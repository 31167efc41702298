"""A ULog read back by pyulog holds the record, in the words of PX4's messages."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyulog import ULog

from testbed.exports import export, ulog
from testbed.exports.px4 import NEVER, local
from testbed.exports.px4_messages import MESSAGES, VERSIONS
from testbed.exports.stream import START_US
from testbed.exports.ulog import layout
from testbed.feeds import px4
from testbed.record.reader import load

pytestmark = pytest.mark.ci

MESSAGE_FOLDERS = "TESTBED_PX4_MSGS"  # PX4's own definitions: the folder of px4_msgs of each version, 1.16=DIR:1.15=DIR


@pytest.fixture(scope="module")
def record(flown: Path) -> Any:
    return load(flown)


@pytest.fixture(scope="module")
def log(flown: Path, tmp_path_factory: pytest.TempPathFactory) -> ULog:
    return ULog(str(export(flown, "ulg", tmp_path_factory.mktemp("ulg") / "run.ulg")))


def rows(log: ULog, topic: str, instance: int = 0) -> dict[str, Any]:
    return dict(log.get_dataset(topic, instance).data)


def vector(own: dict[str, Any], name: str, n: int = 3) -> Any:
    return np.column_stack([own[f"{name}[{k}]"] for k in range(n)])


def single(values: Any) -> Any:
    return np.asarray(values, np.float32)


def us(t: Any) -> Any:
    return START_US + np.rint(np.asarray(t) * 1e6).astype(np.int64)


def test_inertial_samples_are_the_records(log: ULog, record: Any) -> None:
    own, imu = rows(log, "sensor_combined"), record["sensors/imu"]
    dt = imu["dt"].values[:, None]
    np.testing.assert_array_equal(own["timestamp"], us(imu["time"].values))
    np.testing.assert_array_equal(vector(own, "gyro_rad"), single(imu["dtheta"].values / dt))
    np.testing.assert_array_equal(vector(own, "accelerometer_m_s2"), single(imu["dv"].values / dt))
    assert set(own["gyro_integral_dt"]) == set(own["accelerometer_integral_dt"]) == {5000}
    assert (log.file_corruption, log.start_timestamp) == (False, START_US)


@pytest.mark.parametrize(("name", "instance"), [("gnss", 0), ("second", 1)])
def test_fixes_are_the_records_and_without_one_the_place_is_the_last(
    log: ULog, record: Any, name: str, instance: int
) -> None:
    own, gnss = rows(log, "sensor_gps", instance), record[f"sensors/{name}"]
    fix = gnss["fix_type"].values >= 3
    assert 0 < fix.sum() < len(fix)
    np.testing.assert_array_equal(own["timestamp"], us(gnss["t_arrival"].values))
    np.testing.assert_array_equal(own["timestamp_sample"], us(gnss["time"].values))
    np.testing.assert_array_equal(own["fix_type"], gnss["fix_type"].values)
    for key, values in (
        ("latitude_deg", np.degrees(gnss["lat"].values)),
        ("longitude_deg", np.degrees(gnss["lon"].values)),
        ("altitude_msl_m", gnss["h"].values),
    ):
        np.testing.assert_array_equal(own[key][fix], values[fix])
        assert np.isfinite(own[key]).all()
    sigma = gnss["sigma_position_n"].values
    np.testing.assert_array_equal(own["epv"], single(sigma[:, 2]))
    np.testing.assert_array_equal(own["eph"], single(np.hypot(sigma[:, 0], sigma[:, 1])))
    np.testing.assert_array_equal(own["vel_e_m_s"][fix], single(gnss["v_n"].values[fix, 1]))
    assert list(own["vel_ned_valid"]) == list(fix)
    at = np.flatnonzero(~fix)[0]
    assert own["latitude_deg"][at] == own["latitude_deg"][at - 1]
    midnight = 1780272000 * 10**6  # 2026-06-01
    np.testing.assert_array_equal(own["time_utc_usec"] - midnight, own["timestamp_sample"] - START_US)


def test_the_first_receiver_is_the_vehicles(log: ULog) -> None:
    mine, its = rows(log, "sensor_gps"), rows(log, "vehicle_gps_position")
    for name in mine:
        np.testing.assert_array_equal(mine[name], its[name])
    assert log.initial_parameters["EKF2_GPS_DELAY"] == pytest.approx(120)
    assert [log.initial_parameters[f"EKF2_GPS_POS_{axis}"] for axis in "XYZ"] == pytest.approx([0.5, 0, -0.3])
    assert [log.initial_parameters[f"EKF2_IMU_POS_{axis}"] for axis in "XYZ"] == pytest.approx([0.2, 0.1, -0.1])


def test_the_other_sensors_are_the_records(log: ULog, record: Any) -> None:
    for topic, name, values in (
        ("vehicle_air_data", "barometer", {"baro_pressure_pa": record["sensors/barometer/pressure"].values}),
        ("airspeed", "airspeed", {"indicated_airspeed_m_s": record["sensors/airspeed/eas"].values}),
    ):
        own, sensor = rows(log, topic), record[f"sensors/{name}"]
        np.testing.assert_array_equal(own["timestamp_sample"], us(sensor["time"].values))
        for key, expected in values.items():
            np.testing.assert_array_equal(own[key], single(expected))
    field = vector(rows(log, "vehicle_magnetometer"), "magnetometer_ga")
    np.testing.assert_allclose(field, record["sensors/magnetometer/field_b"].values * 1e4, rtol=1e-7)


def test_what_ekf2_saw_when_is_exact_to_a_tenth_of_a_millisecond(log: ULog) -> None:
    own = rows(log, "ekf2_timestamps")
    np.testing.assert_array_equal(own["timestamp"], rows(log, "sensor_combined")["timestamp"])
    for field, topic in (
        ("vehicle_air_data_timestamp_rel", "vehicle_air_data"),
        ("vehicle_magnetometer_timestamp_rel", "vehicle_magnetometer"),
        ("airspeed_timestamp_rel", "airspeed"),
        ("airspeed_validated_timestamp_rel", "airspeed_validated"),
    ):
        new = own[field] != NEVER
        at = own["timestamp"][new].astype(np.int64)
        told, came = at + 100 * own[field][new].astype(np.int64), rows(log, topic)["timestamp"].astype(np.int64)
        np.testing.assert_array_equal(told[-len(came) + 1 :], came[-len(told) + 1 :])
        assert (np.abs(own[field][new]) <= 50).all()  # the sample after which it came is 5 ms older
    assert set(own["distance_sensor_timestamp_rel"]) == {NEVER}


def test_truth_and_estimates_are_there_by_instance(log: ULog, record: Any) -> None:
    truth = record["truth"]
    np.testing.assert_array_equal(
        vector(rows(log, "vehicle_attitude_groundtruth"), "q", 4), single(truth["q_nb"].values)
    )
    place = rows(log, "vehicle_global_position_groundtruth")
    np.testing.assert_array_equal(place["lat"], np.degrees(truth["lat"].values))
    for instance, name in enumerate(("ins", "level")):
        known = np.isfinite(record[f"estimators/{name}/q_nb"].values).all(axis=1)
        own = rows(log, "estimator_attitude", instance)
        np.testing.assert_array_equal(vector(own, "q", 4), single(record[f"estimators/{name}/q_nb"].values[known]))
    local_position = rows(log, "estimator_local_position")
    assert (local_position["vx"] == single(record["estimators/ins/v_n"].values[known_rows(record, "ins"), 0])).all()
    with pytest.raises(IndexError):
        log.get_dataset("estimator_local_position", 1)  # attitude is all that it estimates
    assert log.msg_info_dict["estimators"] == "ins, level"
    assert {m.message for m in log.logged_messages} == set(record["events/text"].values)


def known_rows(record: Any, name: str) -> Any:
    return np.isfinite(record[f"estimators/{name}/lat"].values)


def test_innovations_are_prediction_less_measurement(log: ULog, record: Any) -> None:
    own, ours = rows(log, "estimator_aid_src_gnss_vel"), record["estimators/ins/innovations/gnss_velocity"]
    np.testing.assert_array_equal(vector(own, "innovation"), single(-ours["innovation"].values))
    baro = rows(log, "estimator_aid_src_baro_hgt")
    np.testing.assert_array_equal(
        baro["innovation"], single(record["estimators/ins/innovations/barometer/innovation"].values[:, 0])
    )


def test_local_positions_are_on_px4s_sphere() -> None:
    lat, lon = np.radians([47.1, 47.0, 47.0]), np.radians([8.0, 8.1, 8.0])
    place = local(lat, lon, np.radians(47.0), np.radians(8.0))
    # A tenth of a degree of a sphere of 6371 km is 11.119 km; a parallel leaves the great circle by R/2 dlon^2 sin cos.
    np.testing.assert_allclose(place[0], [11119.49, 0.0], atol=0.01)
    np.testing.assert_allclose(place[1], [4.840, 7583.47], atol=0.01)
    np.testing.assert_allclose(place[2], 0.0, atol=1e-6)


def test_our_own_reader_finds_the_samples_again(flown: Path, record: Any, tmp_path: Path) -> None:
    found = px4.read(export(flown, "ulg", tmp_path / "again.ulg"), {})
    imu = record["sensors/imu"]
    np.testing.assert_allclose(found.imus["imu"].dtheta[1:], imu["dtheta"].values[1:], rtol=1e-6, atol=1e-12)
    assert {"gnss", "gnss2", "barometer", "magnetometer", "airspeed"} <= found.samples.keys()
    assert len(found.samples["barometer"]) == len(record["sensors/barometer/time"])


def test_what_a_field_cannot_hold_is_infinite_or_nothing() -> None:
    stamps = np.arange(3, dtype=np.int64)
    made = ulog.rows(
        "sensor_gps", next(iter(VERSIONS)), stamps, satellites_used=[1e300, np.nan, 300.0], eph=[1e300, 2.0, 3.0]
    )
    assert made["satellites_used"].tolist() == [0, 0, 0]
    assert made["eph"].tolist() == [np.inf, 2.0, 3.0]


def test_formats_are_as_px4_writes_them() -> None:
    for version, wanted in (
        ("1.16", "int16_t airspeed_timestamp_rel;int16_t airspeed_validated_timestamp_rel;"),
        ("1.15", "int16_t airspeed_timestamp_rel;"),
    ):
        text, row = layout("ekf2_timestamps", version)
        rest = ["distance_sensor", "optical_flow", "vehicle_air_data", "vehicle_magnetometer", "visual_odometry"]
        fields = "".join(f"int16_t {name}_timestamp_rel;" for name in rest)
        padding = {"1.16": 2, "1.15": 4}[version]
        assert text == f"uint64_t timestamp;{wanted}{fields}uint8_t[{padding}] _padding0;"
        assert row.itemsize % 8 == 8 - padding
    assert layout("sensor_combined", "1.15")[0] == (
        "uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;int32_t accelerometer_timestamp_relative;"
        "float[3] accelerometer_m_s2;uint32_t accelerometer_integral_dt;uint8_t accelerometer_clipping;"
        "uint8_t gyro_clipping;uint8_t accel_calibration_count;uint8_t gyro_calibration_count;"
    )  # 48 bytes: no padding


def test_each_version_has_its_own_fields(flown: Path, tmp_path: Path) -> None:
    old = ULog(str(export(flown, "ulg-1.15", tmp_path / "old.ulg")))
    assert "eas2tas" in rows(old, "vehicle_air_data")
    assert "airspeed_validated_timestamp_rel" not in rows(old, "ekf2_timestamps")


@pytest.mark.parametrize("version", VERSIONS)
def test_fields_are_those_of_px4s_definitions(version: str) -> None:
    folders = dict(one.split("=") for one in os.environ.get(MESSAGE_FOLDERS, "").split(":") if one)
    if version not in folders:
        pytest.skip(f"{MESSAGE_FOLDERS} does not name the folder of PX4's definitions of {version}")
    for message in VERSIONS[version]:
        name = "".join(part[0].upper() + part[1:] for part in message.split("_"))
        lines = (Path(folders[version]) / f"{name}.msg").read_text("utf-8").splitlines()
        said = [re.sub(r"#.*", "", line).split() for line in lines]
        own = [(kind, field) for kind, field, *rest in (one for one in said if len(one) > 1) if not rest]
        sizes = {"64": 8, "32": 4, "16": 2}
        own.sort(key=lambda one: -sizes.get(re.sub(r"\[.*|\D", "", one[0]), 1))
        c = {"float32": "float", "float64": "double", "bool": "bool"}
        fields = []
        for kind, field in own:
            bare, length = re.fullmatch(r"(\w+?)(\[\d+\])?", kind).groups()  # type: ignore[union-attr]
            fields.append(f"{c.get(bare, bare + '_t')}{length or ''} {field}")
        assert [one for one in layout(message, version)[0].split(";") if one and "_padding" not in one] == fields


def test_topics_name_messages_that_there_are() -> None:
    assert all(set(MESSAGES.values()) <= set(known) for known in VERSIONS.values())
