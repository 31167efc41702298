"""What the filters are told: the datasheet of the sensors that they are given, and of no other."""

from __future__ import annotations

import math

import numpy as np
import pytest

from nav.earth import position_difference_n
from nav.ins import Ins
from testbed import Scenario, estimators, run

TWO_RECEIVERS = [
    "duration_s=20",
    "sensors.gnss.grade=rtk",
    'sensors.gnss2={kind="gnss", lever_arm_m=[20.0, 0.0, 0.0], denied=[[8, 15]]}',
    'estimator=[{name="ins", aids=["gnss2", "barometer", "magnetometer", "airspeed"]}]',
    "expect={}",
]


def told(scenario: Scenario, name: str = "ins") -> Ins:
    inner = estimators.build(scenario, 0)[name].horizon.estimator
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
    assert estimators.build(scenario, 0)["ins"].sensors[0] == "gnss2"
    assert "gnss" not in estimators.build(scenario, 0)["ins"].sensors
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
