"""What the filters are told: the datasheet of the sensors that they are given, and of no other."""

from __future__ import annotations

import math

import numpy as np
import pytest

from nav.detection import Eraim, Glr
from nav.earth import position_difference_n
from nav.federated import Federated
from nav.ins import Ins
from nav.local_filter import AirspeedAid, GnssAid
from testbed import Scenario, estimators, run

TWO_RECEIVERS = [
    "duration_s=20",
    "sensors.gnss.grade=rtk",
    'sensors.gnss2={kind="gnss", lever_arm_m=[20.0, 0.0, 0.0], denied=[[8, 15]]}',
    'estimator=[{name="ins", aids=["gnss2", "barometer", "magnetometer", "airspeed"]}]',
    "expect={}",
]


def told(scenario: Scenario, name: str = "ins") -> Ins:
    inner = estimators.build(scenario)[name].horizon.estimator
    assert isinstance(inner, Ins)
    return inner


def test_datasheet_units() -> None:
    model = told(Scenario.load("loiter_gnss_outage")).config.imu
    hour = 3600.0
    assert model.gyro_noise == pytest.approx(math.radians(0.3) / math.sqrt(hour))
    assert model.accel_noise == pytest.approx(0.06 / math.sqrt(hour))
    assert model.gyro_bias_sigma >= math.radians(40) / hour
    assert model.accel_bias_sigma >= 2e-3 * 9.80665


def test_a_receiver_that_is_no_aid_is_not_fused() -> None:
    scenario = Scenario.load("u_turn", TWO_RECEIVERS)
    assert estimators.build(scenario)["ins"].sensors[0] == "gnss2"
    assert "gnss" not in estimators.build(scenario)["ins"].sensors
    fused = run(scenario).dataset["estimators/ins/innovations/gnss_position"]["sample_time"].values
    assert not ((fused > 8.05) & (fused < 14.95)).any()
    assert (fused < 8).any()


def test_alignment_knows_the_lever_arm_of_a_receiver_that_is_no_aid() -> None:
    still = ["duration_s=30", "sensors.gnss.grade=rtk", "sensors.gnss.lever_arm_m=[20.0, 0.0, 0.0]", "expect={}"]
    scenario = Scenario.load("static_bench", [*still, 'estimator=[{name="alone", aids=[]}]'])
    assert told(scenario, "alone").config.aids == ()
    dataset = run(scenario).dataset
    estimate, truth = dataset["estimators/alone"], dataset["truth"]
    lat, lon, h = (estimate[name].values for name in ("lat", "lon", "h"))
    first = int(np.argmax(np.isfinite(lat)))
    place = [float(truth[name].values[0]) for name in ("lat", "lon", "h")]
    error = position_difference_n(float(lat[first]), float(lon[first]), float(h[first]), *place)
    assert np.linalg.norm(error) < 2.0  # 20 m of arm, turned by a heading that is known to a degree or two


FEDERATED = [
    "sensors.gnss.grade=rtk",
    'sensors.gnss2={kind="gnss", lever_arm_m=[2.0, 0.0, 0.0], denied=[[40, 50]]}',
    'estimator=[{name="fed", kind="federated", structure="full_reset", locals=['
    '{name="one", aids=["gnss"], share=0.5, detector={kind="glr", window_s=20.0}},'
    '{name="two", aids=["gnss2"], share=0.3},'
    '{name="air", aids=["airspeed", "barometer", "magnetometer"], share=0.2, detector={kind="eraim"}}]}]',
    "expect={}",
]


def test_a_federation_is_told_of_each_sensor() -> None:
    running = estimators.build(Scenario.load("u_turn", FEDERATED))["fed"]
    federated = running.horizon.estimator
    assert isinstance(federated, Federated)
    assert running.sensors == ("gnss", "gnss2", "airspeed", "barometer", "magnetometer")
    assert federated.config.structure == "full_reset"
    assert federated.shares.tolist() == [0.5, 0.3, 0.2]
    one, two, air = federated.config.locals
    first, second = one.sensors[0].aid, two.sensors[0].aid
    assert isinstance(first, GnssAid)
    assert isinstance(second, GnssAid)
    assert second.arm_b[0] - first.arm_b[0] == pytest.approx(2.0, abs=0.5)
    assert first.position_error_sigma < second.position_error_sigma  # RTK and the usual kind
    assert isinstance(air.sensors[0].aid, AirspeedAid)
    detector = one.sensors[0].detector()
    assert isinstance(detector, Glr)
    assert detector.window_s == 20.0
    assert isinstance(air.sensors[0].detector(), Eraim)
    assert air.sensors[0].detector() is not air.sensors[0].detector()


def test_a_federation_without_receivers_aligns_with_the_first() -> None:
    blind = ['estimator=[{name="fed", kind="federated", locals=[{name="air", aids=["barometer"]}]}]', "expect={}"]
    running = estimators.build(Scenario.load("u_turn", blind))["fed"]
    assert running.sensors == ("barometer", "gnss", "magnetometer")


def test_a_federation_in_a_run() -> None:
    result = run(Scenario.load("u_turn", [*FEDERATED, "duration_s=110"]))
    metrics = result.metrics
    assert metrics["fed.position_horizontal_rms_m"] < 0.5  # RTK goes first
    assert metrics["fed.heading_rms_deg"] < 1.0
    assert metrics["fed.velocity_nees_mean"] < 3.0
    innovations = result.dataset["estimators/fed/innovations"]
    assert set(innovations.children) == {
        "gnss_position", "gnss_velocity", "airspeed", "sideslip", "barometer", "magnetometer",
    }  # fmt: skip
    assert "wind" in result.dataset["estimators/fed"]
