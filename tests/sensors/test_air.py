"""Barometer and airspeed."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from worlds.sensor_truth import RATE_HZ, lively, still

from testbed import Scenario
from testbed.estimators.datasheet import aid_of
from testbed.estimators.rig import Air
from testbed.sensors.airspeed import Airspeed, AirspeedConfig
from testbed.sensors.barometer import Barometer, BarometerConfig


def pressures(config, truth, seed=1, rate_hz=RATE_HZ):
    return np.array([s.pressure for s in Barometer("barometer", config, rate_hz, seed).sense(truth)])


def speeds(config, truth, seed=1, rate_hz=RATE_HZ):
    return np.array([s.eas for s in Airspeed("airspeed", config, rate_hz, seed).sense(truth)])


def test_perfect_barometer_is_truth_bit_for_bit():
    truth = lively(1000)
    samples = Barometer("barometer", BarometerConfig(grade="perfect", rate_hz=20.0, latency_s=0.02), RATE_HZ, 1).sense(
        truth
    )
    assert [s.pressure for s in samples] == truth.pressure[::10].tolist()
    assert [s.t for s in samples] == truth.t[::10].tolist()
    np.testing.assert_allclose([s.t_arrival - s.t for s in samples], 0.02, atol=1e-12)


@pytest.mark.ci
def test_barometer_errors():
    truth = still(200_000, 10.0)
    noise = pressures(BarometerConfig(grade="perfect", noise_pa=2.0), truth, rate_hz=10.0) - 101_325
    assert noise.std() == pytest.approx(2.0, rel=0.01)
    drift = pressures(BarometerConfig(grade="perfect", drift_pa=10.0, drift_time_s=10.0), truth, rate_hz=10.0) - 101_325
    assert drift.std() == pytest.approx(10.0, rel=0.1)  # 2000 correlation times: 2.2 %
    assert np.corrcoef(drift[100:], drift[:-100])[0, 1] == pytest.approx(np.exp(-1), abs=0.1)
    start = truth.rows(0, 1)
    bias = [pressures(BarometerConfig(grade="perfect", bias_pa=50.0), start, s, 10.0)[0] - 101_325 for s in range(3000)]
    assert np.std(bias) == pytest.approx(50.0, rel=0.05)
    assert abs(np.mean(bias)) < 3.5 * 50 / np.sqrt(3000)


def test_perfect_airspeed_is_equivalent_airspeed_along_the_tube():
    truth = lively(1000)
    expected = truth.airspeed * np.cos(truth.alpha) * np.cos(truth.beta) * np.sqrt(truth.density / 1.225)
    np.testing.assert_allclose(speeds(AirspeedConfig(grade="perfect", rate_hz=20.0), truth), expected[::10], rtol=1e-14)


def flying(n, rate_hz=RATE_HZ, airspeed=25.0):
    truth = still(n, rate_hz)
    truth.airspeed[:] = airspeed
    return truth


@pytest.mark.ci
def test_airspeed_errors():
    truth = flying(50_000)
    config = AirspeedConfig(grade="perfect", rate_hz=RATE_HZ, noise_pa=2.0)
    assert speeds(config, truth).std() == pytest.approx(config.errors().noise, rel=0.02)
    start = truth.rows(0, 1)
    for config, sigma in [
        (AirspeedConfig(grade="perfect", bias_pa=3.0), 3.0 / (1.225 * 25.0)),
        (AirspeedConfig(grade="perfect", scale_percent=1.0), 0.005 * 25.0),
    ]:
        errors = np.array([speeds(config, start, seed)[0] - 25.0 for seed in range(3000)])
        assert errors.std() == pytest.approx(sigma, rel=0.05)
        assert config.errors().bias + 25.0 * config.errors().scale == pytest.approx(sigma)


def test_unsteady_errors_are_gauss_markov_and_filters_know():
    truth = still(40_000, 10.0)
    config = BarometerConfig(grade="perfect", rate_hz=10.0, noise_pa=3.0, unsteady_pa=40.0, unsteady_time_s=8.0)
    off = pressures(config, truth, rate_hz=10.0) - 101_325
    assert off.std() == pytest.approx(np.hypot(40, 3), rel=0.05)
    assert np.corrcoef(off[80:], off[:-80])[0, 1] == pytest.approx(np.exp(-1), abs=0.1)
    tube = AirspeedConfig(grade="perfect", rate_hz=10.0, unsteady_pa=14.0, unsteady_time_s=2.0)
    off = 0.5 * 1.225 * (speeds(tube, flying(40_000, 10.0), rate_hz=10.0) ** 2 - 25.0**2)
    assert off.std() == pytest.approx(14, rel=0.05)
    assert np.corrcoef(off[20:], off[:-20])[0, 1] == pytest.approx(np.exp(-1), abs=0.1)
    slow = speeds(tube, flying(40_000, 10.0, airspeed=10.0), rate_hz=10.0) - 10.0
    assert slow.std() == pytest.approx(14 / (1.225 * 25), rel=0.05)
    rig = Scenario.load("u_turn", {"sensors.barometer.grade": "hobby", "sensors.airspeed.grade": "hobby"}).rig(1)
    told = {name: aid_of(name, rig, rig.imu("imu").errors(), rig.air(0.0)) for name in ("barometer", "airspeed")}
    wake = told["barometer"]
    assert (wake.sigma, wake.error_sigma, wake.error_correlation_s) == pytest.approx((3 / 12, 32 / 12, 8.0))
    assert wake.bias_walk == pytest.approx(80 / 12 * np.sqrt(2 / 300))
    assert told["airspeed"].sigma == pytest.approx(np.hypot(10 / (1.225 * 25), 0.15 * 1.5), rel=0.01)


@pytest.mark.ci
@pytest.mark.parametrize("usual_mps", [14.0, 18.0, 25.0, 35.0])
def test_filters_are_told_the_errors_of_pressure_at_the_usual_airspeed(usual_mps):
    """What 200 sensors make of that airspeed, beside what a filter of such an aircraft reckons with, gusts left out."""
    truth = flying(4000, 10.0)
    truth.airspeed[:] = usual_mps
    config = AirspeedConfig(rate_hz=10.0, grade="hobby", scale_percent=0.0, sideslip_percent=0.0, gust_mps=0.0)
    off = np.array([speeds(config, truth, seed, 10.0) - usual_mps for seed in range(200)])
    rig = Scenario.load("u_turn").rig(1)
    rig = replace(rig, sensors={"airspeed": config}, usual=rig.usual.model_copy(update={"airspeed_mps": usual_mps}))
    told = aid_of("airspeed", rig, Scenario.load("u_turn").rig(1).imu("imu").errors(), Air(gust=0.0, wind_walk=0.0))
    assert told.sigma == pytest.approx((off - off.mean(axis=1, keepdims=True)).std(), rel=0.03)
    assert told.scale_sigma * usual_mps == pytest.approx(off.mean(axis=1).std(), rel=0.12)


@pytest.mark.parametrize("beta_deg", [0.0, 10.0, -20.0])
def test_static_pressure_is_off_with_dynamic_pressure_and_sideslip(beta_deg):
    slow, fast = flying(1), flying(1)
    fast.airspeed[:] = 50.0
    for one in (slow, fast):
        one.beta[:] = np.radians(beta_deg)
    config = BarometerConfig(grade="perfect", dynamic_percent=15.0, sideslip_percent=10.0)
    q = 0.5 * 1.225 * 25.0**2
    ratio = np.sin(np.radians(beta_deg)) ** 2 / np.sin(np.radians(10)) ** 2
    errors = []
    for seed in range(600):
        off = [pressures(config, one, seed)[0] - 101_325 for one in (slow, fast)]
        assert off[1] == pytest.approx(4 * off[0])
        errors.append(off[0] / q)
    assert stats.kstest(errors, stats.norm(scale=np.hypot(0.15, 0.10 * ratio)).cdf).pvalue > 1e-3


def test_sideslip_is_an_error_of_airspeed():
    slipping = flying(1)
    slipping.beta[:] = np.radians(10)
    along = 0.5 * 1.225 * (25.0 * np.cos(np.radians(10))) ** 2
    config = AirspeedConfig(grade="perfect", sideslip_percent=10.0)
    off = [0.5 * 1.225 * speeds(config, slipping, seed)[0] ** 2 - along for seed in range(600)]
    assert stats.kstest(np.array(off) / (0.5 * 1.225 * 25.0**2), stats.norm(scale=0.1).cdf).pvalue > 1e-3
    assert speeds(config, flying(1))[0] == pytest.approx(25.0)


def test_the_tube_of_a_standing_vehicle_is_blown_into():
    config = AirspeedConfig(grade="perfect", rate_hz=10.0, blown_pa=15.0)
    standing = still(40_000, 10.0)
    blown = 0.5 * 1.225 * speeds(config, standing, rate_hz=10.0) ** 2
    apart = blown[::100]  # three correlation times
    assert stats.kstest(apart, stats.halfnorm(scale=15.0).cdf).pvalue > 1e-3
    sound = AirspeedConfig(grade="perfect", rate_hz=10.0)
    flown = flying(1000, 10.0)
    np.testing.assert_array_equal(speeds(config, flown, rate_hz=10.0), speeds(sound, flown, rate_hz=10.0))


def test_no_negative_airspeed_and_no_nan_on_the_ground():
    eas = speeds(AirspeedConfig(rate_hz=RATE_HZ), still(5000))
    assert np.isfinite(eas).all()
    assert eas.min() == 0.0
    backwards = flying(10)
    backwards.alpha[:] = np.pi
    assert not speeds(AirspeedConfig(grade="perfect"), backwards).any()
