"""Receivers that jump, state their accuracy late and tell old velocities, against independent statistics."""

import numpy as np
import pymap3d
import pytest
from scipy import signal, stats
from worlds.sensor_truth import RATE_HZ, cut, lively, still

from testbed.sensors.gnss import Gnss, GnssConfig


def sense(config, truth, seed=1, rate_hz=RATE_HZ):
    return Gnss("gnss", config, rate_hz, seed).sense(truth)


def offsets_n(samples, truth):
    """Position error (n, 3) [m] of a receiver at rest."""
    at = (truth.lat[0], truth.lon[0], truth.h[0])
    ned = [pymap3d.geodetic2ned(s.lat, s.lon, s.h, *at, deg=False) for s in samples]
    return np.array(ned)


@pytest.mark.ci
def test_jumps_come_at_random_last_exponentially_and_are_normal():
    truth = still(40_000, 1.0)
    config = GnssConfig(grade="perfect", rate_hz=1.0, jumps_per_h=30.0, jump_m=4.0, jump_s=20.0)
    away = offsets_n(sense(config, truth, rate_hz=1.0), truth).round(4)
    begins = np.flatnonzero(np.any(away[1:] != away[:-1], axis=1) & np.any(away[1:] != 0, axis=1)) + 1
    hours = len(truth) / 3600
    assert stats.poisson.sf(len(begins) - 1, 30 * hours) > 1e-3
    assert stats.poisson.cdf(len(begins), 30 * hours) > 1e-3
    sizes = away[begins] / [4.0, 4.0, 6.0]
    assert stats.kstest(sizes.ravel(), "norm").pvalue > 1e-3
    # the share of time away from the truth, of a renewal process whose new jumps take the place of old ones
    share = np.any(away != 0, axis=1).mean()
    assert share == pytest.approx(1 - np.exp(-30 / 3600 * 20), abs=0.04)
    ends = [int(np.argmax(np.any(away[b:] != away[b], axis=1))) for b in begins[:-1]]
    assert np.mean(ends) == pytest.approx(1 / (1 / 20 + 30 / 3600), rel=0.2)


def test_the_stated_accuracy_follows_the_true_one_late():
    keys = {"rate_hz": 5.0, "denied": ((2.0, 4.0),), "reacquire_s": 1.5, "settle_factor": 3.0, "settle_s": 4.0}
    honest = [s for s in sense(GnssConfig(**keys), still(6000)) if s.has_fix]
    late = [s for s in sense(GnssConfig(**keys, accuracy_lag_s=6.0), still(6000)) if s.has_fix]
    variance = np.array([s.sigma_position_n for s in honest]) ** 2
    a = np.exp(-0.2 / 6.0)
    expected, _ = signal.lfilter([1 - a], [1, -a], variance, axis=0, zi=a * variance[:1])
    np.testing.assert_allclose(np.array([s.sigma_position_n for s in late]) ** 2, expected, rtol=1e-9)
    first = next(k for k, s in enumerate(honest) if s.t > 4)
    assert (late[first].sigma_position_n < 0.6 * honest[first].sigma_position_n).all()  # it claims too much
    assert (late[-60].sigma_position_n > 1.05 * honest[-60].sigma_position_n).all()  # and then too little


def test_a_jump_is_stated_after_a_while():
    truth = still(3000, 1.0)
    config = GnssConfig(rate_hz=1.0, jumps_per_h=20.0, jump_m=200.0, jump_s=100.0, accuracy_lag_s=10.0)
    samples = sense(config, truth, rate_hz=1.0)
    size = np.abs(offsets_n(samples, truth)[:, 0])
    stated = np.array([s.sigma_position_n[0] for s in samples])
    begins = [k for k in range(1, len(size) - 40) if size[k] > 60 and size[k - 1] < 10 and size[k : k + 30].min() > 60]
    assert begins
    for k in begins:
        assert stated[k] < 0.5 * size[k]
        assert stated[k + 29] == pytest.approx(size[k + 29], rel=0.2)


def test_velocity_is_older_than_position_by_its_lag():
    truth = lively(2000)
    samples = sense(GnssConfig(grade="perfect", rate_hz=5.0, latency_s=0.1, velocity_lag_s=0.15), truth)
    rows = np.arange(0, 2000, 40)
    np.testing.assert_array_equal([s.v_n for s in samples], truth.v_n[np.maximum(rows - 30, 0)])
    np.testing.assert_array_equal([s.lat for s in samples], truth.lat[rows])
    np.testing.assert_array_equal([s.t for s in samples], truth.t[rows])


def test_an_uncertain_latency_is_drawn_and_nothing_arrives_before_it_was_measured():
    config = GnssConfig(grade="perfect", rate_hz=5.0, latency_s=0.2, latency_sigma_s=0.1)
    truth = still(41)
    truth.v_n[:, 0] = truth.t
    off, older = [], []
    for seed in range(300):
        one = sense(config, truth, seed)[-1]
        assert one.t_arrival - one.t == pytest.approx(0.2)
        assert one.t_arrival >= 0.2 - 1e-12
        off.append(one.t - 0.2)
        older.append(0.2 - one.v_n[0])
    assert stats.kstest(off, stats.norm(scale=0.1).cdf).pvalue > 1e-3  # cut at two sigma, early
    late = np.array(older)[np.array(older) > 1e-9]
    assert stats.binomtest(len(late), 300, 0.5).pvalue > 1e-3
    assert stats.kstest(late[late < 0.19], stats.truncnorm(0, 1.95, scale=0.1).cdf).pvalue > 1e-3


def test_the_same_however_a_run_is_cut():
    truth = lively(2000)
    config = GnssConfig(grade="u-blox-m8", rate_hz=10.0, jumps_per_h=1000.0, velocity_lag_s=0.13, offset_s=0.05)
    whole = sense(config, truth)
    receiver = Gnss("gnss", config, RATE_HZ, 1)
    parts = [one for block in cut(truth, [1, 2, 9, 11, 30, 30, 500, 501, 1999]) for one in receiver.sense(block)]
    assert len(whole) == len(parts) == 100
    for one, other in zip(whole, parts, strict=True):
        assert (one.t, one.t_arrival, one.lat, one.lon, one.h) == (
            other.t,
            other.t_arrival,
            other.lat,
            other.lon,
            other.h,
        )
        np.testing.assert_array_equal(one.v_n, other.v_n)
        np.testing.assert_array_equal(one.sigma_position_n, other.sigma_position_n)
