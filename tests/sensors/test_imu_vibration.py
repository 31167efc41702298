"""What an engine does to a sampled unit: lines that fold, noise that grows, biases; against scipy and allantools."""

import allantools
import numpy as np
import pytest
from scipy import signal
from worlds.sensor_truth import cut, lively, still

from testbed.sensors.imu import Imu, ImuConfig
from testbed.sensors.units import DEG, DEG_PER_H, DEG_PER_ROOT_H, MG, MPS_PER_ROOT_H, G

TICK_HZ = 200.0


def running(ticks, rpm):
    truth = still(ticks, TICK_HZ)
    truth.engine_rpm[:] = rpm
    return truth


def sense(truth, seed=3, **keys):
    return Imu("imu", ImuConfig(grade="perfect", **keys), TICK_HZ, seed).sense(truth)


@pytest.mark.parametrize(("rpm", "rate_hz"), [(4980.0, 50.0), (4980.0, 100.0), (4980.0, 200.0), (5940.0, 100.0)])
def test_lines_fold_at_the_sampling_rate_with_the_size_that_the_filter_leaves(rpm, rate_hz):
    keys = {"vibration_mg": 200.0, "vibration_degps": 2.0, "gyro_bandwidth_hz": 42.0, "accel_bandwidth_hz": 44.0}
    imu = sense(running(40_001, rpm), rate_hz=rate_hz, output="sampled", **keys)
    for increments, size, bandwidth in ((imu.dv, 0.2 * G, 44.0), (imu.dtheta, 2.0 * DEG, 42.0)):
        for harmonic, share in ((1, 1.0), (2, 0.5)):
            line_hz = harmonic * rpm / 60
            b, a = signal.butter(2, 2 * np.pi * bandwidth, analog=True)
            _, (gain,) = signal.freqs(b, a, [2 * np.pi * line_hz])
            folded = abs(line_hz - rate_hz * round(line_hz / rate_hz))
            tone = np.exp(-2j * np.pi * folded * imu.t)
            window = signal.windows.hann(len(imu.t))
            amplitude = 2 * np.abs((increments * rate_hz * (tone * window)[:, None]).sum(axis=0)) / window.sum()
            expected = size * (rpm / 6000) ** 2 * share * abs(gain)
            np.testing.assert_allclose(amplitude, expected, rtol=0.02)


@pytest.mark.parametrize("rpm", [3300.0, 5000.0, 5900.0])
@pytest.mark.parametrize("bandwidth_hz", [42.0, 116.0, 300.0, None])
def test_summed_over_a_tick_a_line_is_behind_one_filter_and_one_mean(rpm, bandwidth_hz):
    """Of the continuous tone: a Butterworth filter's gain, and the mean over the tick, sinc(f T)."""
    imu = sense(running(40_001, rpm), rate_hz=200.0, vibration_mg=200.0, accel_bandwidth_hz=bandwidth_hz)
    square = 0.0
    for harmonic, share in ((1, 1.0), (2, 0.5)):
        line_hz = harmonic * rpm / 60
        b, a = signal.butter(2, 2 * np.pi * (bandwidth_hz or 1e9), analog=True)
        _, (gain,) = signal.freqs(b, a, [2 * np.pi * line_hz])
        square += (0.2 * G * (rpm / 6000) ** 2 * share * abs(gain) * np.sinc(line_hz / TICK_HZ)) ** 2 / 2
    force = imu.dv[1000:] * TICK_HZ
    np.testing.assert_allclose(np.sqrt((force**2).mean(axis=0)), np.sqrt(square), rtol=0.02)


def test_near_the_sampling_rate_a_line_becomes_a_slow_error():
    imu = sense(running(20_001, 5999.4), rate_hz=100.0, output="sampled", vibration_mg=200.0, accel_bandwidth_hz=44.0)
    force = imu.dv[:, 0] * 100.0
    frequency, density = signal.periodogram(force, 100.0, window="hann")
    assert frequency[np.argmax(density)] == pytest.approx(0.01, abs=0.011)
    summed = sense(running(20_001, 5999.4), rate_hz=100.0, vibration_mg=200.0, accel_bandwidth_hz=44.0)
    assert np.abs(summed.dv[:, 0].cumsum()).max() < 0.05 * np.abs(imu.dv[:, 0].cumsum()).max()


def test_sampled_and_summed_are_the_same_at_rest():
    truth = running(2001, 0.0)
    truth.dv[1:] = np.array([0.1, -0.2, -9.8]) / TICK_HZ
    truth.dtheta[1:] = np.array([0.1, 0.02, -0.05]) / TICK_HZ
    for bandwidth in (None, 40.0):
        keys = {"rate_hz": 50.0, "gyro_bandwidth_hz": bandwidth, "accel_bandwidth_hz": bandwidth}
        one, other = sense(truth, **keys), sense(truth, output="sampled", **keys)
        np.testing.assert_allclose(one.dv[50:], other.dv[50:], rtol=1e-9)
        np.testing.assert_allclose(one.dtheta[50:], other.dtheta[50:], rtol=1e-9)


def test_rectified_bias_is_the_mean_square_times_the_coefficient():
    def biases(seed, rpm, mg):
        keys = {"accel_rectification_mgpg2": 64.0, "gyro_rectification_degphpg2": 100.0, "vibration_mg": mg}
        imu = sense(running(4001, rpm), seed, rate_hz=50.0, **keys)
        return imu.dtheta.mean(axis=0) * 50, imu.dv.mean(axis=0) * 50

    drawn = np.array([np.hstack(biases(seed, 6000.0, 500.0)) for seed in range(120)])
    square = 0.5**2 / 2 * (1 + 0.5**2)  # g^2 of one axis, at one and two per rev
    assert drawn[:, :3].std() == pytest.approx(100 * DEG_PER_H * 3 * square, rel=0.12)
    assert drawn[:, 3:].std() == pytest.approx(64 * MG * square, rel=0.12)
    half, whole = biases(1, 3000.0, 500.0), biases(1, 6000.0, 500.0)
    for one, other in zip(half, whole, strict=True):  # fourth power of the speed
        np.testing.assert_allclose(one, other / 16, rtol=0.02, atol=1e-4 * np.abs(other).max())


@pytest.mark.parametrize(("rpm", "share"), [(0.0, 0.0), (6000.0, 1.0), (4500.0, 0.5625)])
def test_white_noise_grows_with_the_engine(rpm, share):
    keys = {"angle_random_walk_degprth": 0.3, "gyro_vibration_degprth": 2.0, "accel_vibration_mpsprth": 3.0}
    imu = sense(running(80_001, rpm), rate_hz=100.0, **keys)
    for values, at_rest, more in (
        (imu.dtheta, 0.3 * DEG_PER_ROOT_H, 2.0 * DEG_PER_ROOT_H),
        (imu.dv, 0.0, 3.0 * MPS_PER_ROOT_H),
    ):
        _, deviation, *_ = allantools.oadev(values[:, 0] * 100.0, rate=100.0, data_type="freq", taus=[1.0])
        assert deviation[0] == pytest.approx(np.hypot(at_rest, share * more), rel=0.1, abs=1e-12)


def test_a_hobby_unit_is_the_same_however_a_run_is_cut():
    truth, config = lively(2000), ImuConfig(grade="mems-hobby", rate_hz=50.0)
    whole = Imu("imu", config, TICK_HZ, 1).sense(truth)
    unit = Imu("imu", config, TICK_HZ, 1)
    parts = [unit.sense(block) for block in cut(truth, [1, 3, 4, 5, 90, 91, 700, 1333])]
    for name in ("t", "dt", "dtheta", "dv"):
        np.testing.assert_array_equal(getattr(whole, name), np.concatenate([getattr(one, name) for one in parts]))
