"""A barometer as installed: a wake that lasts for seconds is a state, white noise is what its own samples show."""

from __future__ import annotations

import numpy as np
import pytest
from worlds.ins import CONSUMER, FIELD_N, feed, flight, gnss, imu, magnetometer

from nav.aids import BarometerAid, GnssAid, MagnetometerAid
from nav.aids.barometer import Scatter, thinness
from nav.earth import isa_pressure
from nav.horizon import FusionHorizon
from nav.ins import Ins, InsConfig
from nav.samples import BarometerSample

RATE_HZ = 10.0
WAKE, WAKE_S = 3.3, 8.0  # [m], [s]
INSTALLED = BarometerAid(sigma=0.25, bias_walk=0.05, error_sigma=WAKE, error_correlation_s=WAKE_S, scatters=True)


def heard(t, h):
    return BarometerSample(t, t, isa_pressure(h))


@pytest.mark.parametrize(
    ("pressure", "density"), [(101325.0, 1.2250), (54048.0, 0.73643), (26500.0, 0.41351), (12112.0, 0.19476)]
)
def test_a_pascal_is_worth_more_metres_high_up(pressure, density):
    """By the tables of the U.S. Standard Atmosphere 1976 at 0, 5, 10 and 15 km."""
    assert thinness(pressure) == pytest.approx(1.2250 / density, rel=1e-3)


@pytest.mark.parametrize("noise", [0.1, 2.0])
def test_scatter_is_the_white_noise_whatever_the_climb(noise):
    rng, scatter = np.random.default_rng(91401), Scatter()
    t = np.arange(600) / RATE_HZ + rng.uniform(-0.02, 0.02, 600)
    h = 300.0 + 8.0 * t + 20.0 * np.sin(0.3 * t) + noise * rng.normal(size=600)
    found = [np.sqrt(scatter.heard(heard(*one))) for one in zip(t, h, strict=True)]
    assert np.mean(found[200:]) == pytest.approx(noise, rel=0.15)
    assert scatter.heard(heard(t[-1], 900.0)) == scatter.variance  # told of again, it is no second sample


def test_one_outlier_and_samples_far_apart_teach_little():
    rng, scatter = np.random.default_rng(91402), Scatter()
    for k in range(300):
        scatter.heard(heard(k / RATE_HZ, 300.0 + 0.2 * rng.normal()))
    before = scatter.variance
    scatter.heard(heard(30.0, 400.0))
    assert scatter.variance < 1.5 * before
    slow = Scatter()
    for k in range(20):
        slow.heard(heard(2.0 * k, 300.0 + k * k))
    assert slow.variance == 0.0


@pytest.mark.ci
@pytest.mark.parametrize("noise", [0.25, 1.7])
def test_innovations_are_white_and_as_large_as_told(noise):
    """A wake of 3.3 m for 8 s, and white noise as told or seven times that: NIS is about 1, and none refused.

    Some of the wake is in the scatter too, 0.3 m: where noise is as told NIS is 0.74.
    """
    truth, rng = flight(120), np.random.default_rng(91403)
    increments, *_ = imu(truth, CONSUMER, rng)
    rows = slice(0, None, round(200 / RATE_HZ))
    t, h = truth.t[rows], truth.h[rows].copy()
    kept = np.exp(-1 / RATE_HZ / WAKE_S)
    wake = WAKE * rng.normal()
    for k in range(len(h)):
        h[k] += wake + noise * rng.normal()
        wake = kept * wake + WAKE * np.sqrt(1 - kept**2) * rng.normal()
    samples = gnss(truth, rng, 2.0) + magnetometer(truth, rng) + [heard(*one) for one in zip(t, h, strict=True)]
    config = InsConfig(CONSUMER, (GnssAid(), INSTALLED, MagnetometerAid()))
    estimates, reports = feed(FusionHorizon(Ins(config, lambda *_: FIELD_N)), increments, samples)
    looks = [one for one in reports if one.aid == "barometer" and one.t > 15]
    assert 0.6 < np.mean([one.nis for one in looks]) < 1.25
    assert np.mean([one.weight == 0 for one in looks]) < 0.01
    nu = np.array([one.innovation[0] for one in looks])
    assert abs(np.mean(nu[1:] * nu[:-1]) / np.mean(nu**2)) < 0.2
    off = [(one.h - truth.h[round(one.t * 200)]) ** 2 / one.covariance[2, 2] for one in estimates if one.t > 15]
    assert np.mean(off) < 3
