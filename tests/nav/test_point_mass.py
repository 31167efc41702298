"""The point-mass filter over a map: against the likelihood of all heights at once, and how good its fixes are."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from nav.earth import radii, wrap_longitude
from nav.point_mass import POINTS, PointMass
from nav.terrain import Terrain, ground
from testbed import Scenario, run
from testbed.motion.sections import Terrain as Section
from testbed.motion.terrain import of, uneven
from testbed.score.accuracy import column

HILLS = of(Section(file="jacksboro"))
H_M, SPEED = 1200.0, 25.0
SCENARIO = """
title = "Lost over hills"
seed = 702
duration_s = 90
[truth]
source = "flight"
start = { lat_deg = 36.58, lon_deg = -84.34, alt_m = 1050, heading_deg = 30, airspeed_mps = 25 }
terrain = { file = "jacksboro", map_error_m = 4 }
[[plan]]
leg = "straight"
length_m = 9000
[sensors.imu]
[sensors.gnss]
denied = [[0, 90]]
[sensors.barometer]
[sensors.magnetometer]
[sensors.airspeed]
[sensors.rangefinder]
[[estimator]]
name = "ins"
aids = ["barometer", "magnetometer", "airspeed", "rangefinder"]
handover = { level_deg = 0.5, heading_deg = 2, velocity_mps = 0.5, position_m = 400 }
"""


def height(terrain: Terrain, lat: float, lon: float, north: float = 0.0, east: float = 0.0) -> float:
    R_M, R_N = radii(lat)
    return ground(lat + north / R_M, lon + east / (R_N * math.cos(lat)), terrain.heights, terrain.grid)[0]


def test_weights_are_the_likelihood_of_all_heights_at_once() -> None:
    """Their errors together: white, one for all, Markov; each place by the density of all its residuals."""
    lat, lon, rng, count = math.radians(36.6), math.radians(-84.3), np.random.default_rng(1), 6
    places = PointMass(HILLS, 2.0, 4.0, 8.0)
    places.begin(0.0, np.array([lat, lon, H_M]), np.eye(2) * 300.0**2, 10.0)
    step, measured, R = places.step.copy(), [], []
    north, east = ((np.arange(POINTS) - 40) * step[i] for i in range(2))
    maps = []
    for k in range(count):
        if k:
            places.move(3.0 * k, np.array([SPEED, 0.0, 0.5]), np.zeros(2))
        here = places.lat, places.lon
        maps.append([[height(HILLS, *here, a + 30.0, b - 20.0) for b in east] for a in north])
        rough = sum(np.mean(np.diff(maps[-1], axis=axis) ** 2) for axis in (0, 1)) / 12
        R.append(4.0 + rough)
        measured.append(maps[-1][50][35] + 5 * rng.standard_normal())
        places.weigh(np.array([30.0, -20.0, H_M - 1.5 * k - measured[-1]]))
    apart = 3.0 * np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    together = multivariate_normal(np.zeros(count), np.diag(R) + 100.0 + 16.0 * np.exp(-apart / 8.0))
    expected = together.logpdf(np.array(measured) - np.moveaxis(np.array(maps), 0, -1))
    likely = expected > expected.max() - 600.0  # beyond it a weight is none
    assert likely.mean() > 0.5
    found = places.log_w - places.log_w.max()
    np.testing.assert_allclose(found[likely], (expected - expected.max())[likely], atol=2e-3, rtol=1e-6)
    whole = places.level + places.log_w.max()
    assert whole == pytest.approx(expected.max() - together.logpdf(np.zeros(count)), abs=2e-3)
    assert places.fits
    for off in (150.0, -150.0):
        places.weigh(np.array([30.0, -20.0, H_M - 1.5 * count - measured[-1] - off]))
    assert not places.fits  # no two places side by side are 300 m apart in height


def test_a_place_across_the_date_line_is_as_near_as_any() -> None:
    """As the same search over the same hills elsewhere has it."""
    rng, found = np.random.default_rng(3), []
    heights = rng.uniform(700.0, 900.0, 20)
    for lon_deg in (10.0, 180.0):
        west = math.radians(lon_deg) - 600 * HILLS.grid[3]
        places = PointMass(Terrain(HILLS.heights, np.array([*HILLS.grid[:2], west, HILLS.grid[3]])), 5.0, 4.0, 8.0)
        here = np.array([math.radians(36.6), math.radians(lon_deg) - 1e-5, H_M])
        P = np.eye(2) * 300.0**2
        places.begin(0.0, here, P, 10.0)
        for k in range(1, 20):
            places.move(float(k), np.array([0.0, SPEED, 0.0]), np.array([0.5, 0.1]))
            places.weigh(np.array([0.0, 0.0, heights[k]]))
        own = float(wrap_longitude(places.lon))
        assert (own < 0.0) == (lon_deg == 180.0)
        found.append(places.posterior(places.lat, own, P))
        if (fix := places.fix(places.lat, own, P)) is not None:
            assert abs(fix.lon) <= math.pi
    for before, across in zip(*found, strict=True):
        np.testing.assert_allclose(across, before, rtol=1e-5, atol=1e-5)


def flown(seed: int, sigma: float, sigma_v: float = 0.5, local: float = 4.0) -> tuple[float, float, list[float]]:
    """Until a fix: when [s], NEES of filter and fix together, and the kurtosis of each posterior on the way."""
    rng = np.random.default_rng(seed)
    true = uneven(HILLS, local, 200.0, rng)
    lat, lon = math.radians(rng.uniform(36.54, 36.64)), math.radians(rng.uniform(-84.34, -84.22))
    R_M, R_N = radii(lat)
    per = np.array([1 / R_M, 1 / (R_N * math.cos(lat))])
    heading, off, slip = rng.uniform(0, 2 * math.pi), sigma * rng.standard_normal(2), sigma_v * rng.standard_normal(2)
    v = SPEED * np.array([math.cos(heading), math.sin(heading)])
    higher = 8 * rng.standard_normal()
    places = PointMass(HILLS, 0.5, local, 200.0 / SPEED)
    places.begin(0.0, np.array([*(np.array([lat, lon]) + off * per), H_M]), np.eye(2) * sigma**2, 8.0)
    found: list[float] = []
    for t in range(1, 240):
        places.move(float(t), np.array([*(v + slip), 0.0]), np.array([sigma_v, 0.0]))
        here = height(true, lat, lon, *(v * t)) + higher + 0.5 * rng.standard_normal()
        places.weigh(np.array([0.0, 0.0, H_M - here]))
        assert places.fits  # as its sensor and its map are what they are said to be
        if t % 5:
            continue
        P, own = np.eye(2) * (sigma**2 + (sigma_v * t) ** 2), (v + slip) * t + off
        place = np.array([lat, lon]) + own * per
        mean, C, kurtosis, _ = places.posterior(*place, P)
        found.append(kurtosis)
        if (fix := places.fix(*place, P)) is not None:
            z = (np.array([fix.lat, fix.lon]) - [lat, lon]) / per - own
            gain = P @ np.linalg.inv(P + fix.R)
            np.testing.assert_allclose(gain @ z, mean, rtol=5e-4, atol=0.2)  # the posterior; meridians converge
            np.testing.assert_allclose(P - gain @ P, C, rtol=1e-6, atol=1e-6 * sigma**2)
            error = own + mean - v * t
            return t, float(error @ np.linalg.solve(C, error)), found
    return math.inf, math.nan, found


@pytest.mark.ci
def test_a_place_is_told_only_when_it_is_one() -> None:
    t, nees, kurtosis = flown(3, 300.0)
    assert 10 < t < 200
    assert nees < 13.8  # one in a thousand
    assert not 7.0 < kurtosis[0] < 9.5


@pytest.mark.slow
@pytest.mark.parametrize(("sigma", "sigma_v", "local"), [(200.0, 0.5, 4.0), (500.0, 0.5, 4.0), (300.0, 0.5, 1.0)])
def test_fixes_are_as_good_as_they_say(sigma: float, sigma_v: float, local: float) -> None:
    runs = [flown(seed, sigma, sigma_v, local) for seed in range(1000, 1040)]
    nees = np.array([one[1] for one in runs])
    print(f"found {np.isfinite(nees).mean():.2f} after {np.median([one[0] for one in runs]):.0f} s")
    print(f"NEES per degree of freedom {np.nanmean(nees) / 2:.2f}")
    assert np.isfinite(nees).mean() > 0.9
    assert 0.4 < np.nanmean(nees) / 2 < 1.6


@pytest.mark.ci
def test_an_ins_that_is_lost_finds_its_place() -> None:
    """Handed over 600 m off, without GNSS."""
    tree = run(Scenario.parse(SCENARIO)).dataset
    R_M, R_N = radii(math.radians(36.58))
    t, own_t = column(tree, "truth/time"), column(tree, "estimators/ins/time")
    off = [
        (column(tree, f"estimators/ins/{name}") - np.interp(own_t, t, column(tree, f"truth/{name}"))) * metres
        for name, metres in (("lat", R_M), ("lon", R_N * math.cos(math.radians(36.58))))
    ]
    error = np.hypot(*off)
    assert error[0] > 300
    assert error[-1] < 60
    outcome = column(tree, "estimators/ins/innovations/terrain_fix/outcome")
    assert 1 <= len(outcome) <= 3
