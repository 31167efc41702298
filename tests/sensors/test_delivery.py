"""What is lost and stamped late on the way from a sensor: by the shares and sizes asked for, however a run is cut."""

import numpy as np
import pytest
from scipy import stats
from worlds.sensor_truth import RATE_HZ, cut, lively

from testbed.sensors.barometer import Barometer, BarometerConfig
from testbed.sensors.delivery import Delivery
from testbed.sensors.imu import Imu, ImuConfig

TICKS = 40_000
PERIOD_S = 1 / RATE_HZ


def delivered(config, blocks, seed=5):
    """The samples of a barometer as they come through, block by block."""
    sensor, delivery = Barometer("baro", config, RATE_HZ, seed), Delivery("baro", config, seed)
    return [one for block in blocks for one in delivery.of(sensor.sense(block))]


def increments(config, blocks, seed=5):
    """Times, lengths and increments (N, 6) of a unit."""
    unit = Imu("imu", config, RATE_HZ, seed)
    found = [unit.sense(block) for block in blocks]
    return (
        np.concatenate([one.t for one in found]),
        np.concatenate([one.dt for one in found]),
        np.vstack([np.hstack([one.dtheta, one.dv]) for one in found]),
    )


def test_stamps_are_late_by_a_half_normal_and_in_order():
    config = BarometerConfig(grade="perfect", rate_hz=100.0, latency_s=0.02, jitter_s=0.001)
    samples = delivered(config, [lively(TICKS)])
    t = np.array([one.t for one in samples])
    late = t - 0.01 * np.arange(len(t))
    assert (late >= -1e-12).all()
    assert stats.kstest(late, stats.halfnorm(scale=0.001).cdf).pvalue > 1e-3
    np.testing.assert_allclose([one.t_arrival - one.t for one in samples], 0.02, atol=1e-12)
    assert (np.diff(t) > 0).all()
    rough = delivered(BarometerConfig(grade="perfect", rate_hz=100.0, jitter_s=0.05), [lively(2000)])
    assert (np.diff([one.t for one in rough]) > 0).all()  # never later than the next


def test_losses_are_independent_and_as_frequent_as_asked_for():
    config = BarometerConfig(grade="perfect", rate_hz=100.0, dropout_percent=10.0)
    samples = delivered(config, [lively(TICKS)])
    slots = np.zeros(TICKS // 2, int)
    slots[[round(one.t * 100) for one in samples]] = 1
    lost = 1 - slots
    assert stats.binomtest(int(lost.sum()), len(lost), 0.1).pvalue > 1e-3
    together = int((lost[1:] * lost[:-1]).sum())
    assert stats.binomtest(together, len(lost) - 1, 0.01).pvalue > 1e-3


@pytest.mark.parametrize(
    "keys", [{"jitter_s": 0.002}, {"dropout_percent": 20.0}, {"jitter_s": 0.004, "dropout_percent": 5.0}]
)
@pytest.mark.parametrize("rate_hz", [200.0, 50.0])
def test_the_same_however_a_run_is_cut(keys, rate_hz):
    truth = lively(1000)
    cuts = [1, 2, 7, 100, 100, 333, 334, 335, 800]
    config = ImuConfig(grade="mems-consumer", rate_hz=rate_hz, **keys)
    whole, parts = increments(config, [truth]), increments(config, cut(truth, cuts))
    for one, other in zip(whole, parts, strict=True):
        np.testing.assert_array_equal(one, other)
    aid = BarometerConfig(rate_hz=rate_hz, **keys)
    assert delivered(aid, [truth]) == delivered(aid, cut(truth, cuts))


def test_increments_are_mean_rates_times_the_steps_of_their_stamps():
    truth = lively(TICKS)
    exact = increments(ImuConfig(grade="perfect"), [truth])
    t, dt, found = increments(ImuConfig(grade="perfect", jitter_s=0.001), [truth])
    n = len(t)
    np.testing.assert_allclose(np.diff(t), dt[1:], atol=1e-12)
    late = t - exact[0][:n]
    assert late.min() >= 0.0
    assert stats.kstest(late, stats.halfnorm(scale=0.001).cdf).pvalue > 1e-3
    np.testing.assert_allclose(found / dt[:, None], exact[2][:n] / PERIOD_S, rtol=1e-9, atol=1e-12)
    assert dt[0] == dt.max()  # no wait for the next is longer
    assert t[-1] <= truth.t[-1] + 1e-9


def test_for_a_lost_increment_the_last_rates_are_read_again():
    truth = lively(2000)
    exact = increments(ImuConfig(grade="perfect"), [truth])
    t, dt, found = increments(ImuConfig(grade="perfect", dropout_percent=20.0), [truth])
    np.testing.assert_array_equal(t, exact[0])
    np.testing.assert_array_equal(dt, exact[1])
    same = np.isclose(found, exact[2], rtol=1e-12, atol=0).all(axis=1)
    assert 0.75 < same.mean() < 0.85
    for k in np.flatnonzero(~same):
        np.testing.assert_array_equal(found[k], found[k - 1])


def test_what_comes_through_changes_no_noise():
    truth = lively(2000)
    sound = delivered(BarometerConfig(rate_hz=50.0), [truth])
    rough = delivered(BarometerConfig(rate_hz=50.0, jitter_s=0.003, dropout_percent=30.0), [truth])
    by_slot = {round(50 * one.t - 0.3): one.pressure for one in rough}
    assert 0.6 * len(sound) < len(by_slot) < 0.8 * len(sound)
    assert all(sound[slot].pressure == pressure for slot, pressure in by_slot.items())
