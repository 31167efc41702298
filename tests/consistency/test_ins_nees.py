"""With sensors that err as the filter is told, its covariance is the covariance of its errors.

Normalised estimation error squared of position, velocity and attitude, three degrees of freedom each, averaged over
seeds; two-sided 95 % bounds from chi-square. Every run aligns itself from its sensors.
"""

import numpy as np
import pytest
from scipy.stats import chi2
from worlds.ins import CONSUMER, FIELD_N, airspeed, barometer, error, feed, flight, gnss, imu, magnetometer

from nav.aids import AirspeedAid, BarometerAid, GnssAid, MagnetometerAid
from nav.horizon import FusionHorizon
from nav.ins import Ins, InsConfig

ARM = (0.5, 0.1, -0.3)
DURATION = 120
AIDS = {
    "gnss": GnssAid(arm_b=ARM),
    "barometer": BarometerAid(bias_walk=0.0),
    "magnetometer": MagnetometerAid(),
    "airspeed": AirspeedAid(sideslip_sigma=None, wind_walk=0.0),
}


def nees(seed, aids=tuple(AIDS), denied=(np.inf, np.inf)):
    """(DURATION, 3) at every full second, NaN before alignment."""
    truth, rng = flight(DURATION), np.random.default_rng(seed)
    increments, *_ = imu(truth, CONSUMER, rng)
    samples = [s for s in gnss(truth, rng, 5.0, arm_b=ARM) if not denied[0] <= s.t < denied[1]]
    samples += magnetometer(truth, rng, MagnetometerAid().bias_sigma * rng.normal(size=3))
    if "barometer" in aids:
        samples += barometer(truth, rng, 100 * rng.normal())
    if "airspeed" in aids:
        samples += airspeed(truth, rng)
    ins = Ins(InsConfig(CONSUMER, tuple(AIDS[aid] for aid in aids), false_rejection=1e-6), lambda *_: FIELD_N)
    estimates, _ = feed(FusionHorizon(ins), increments, samples)
    result = np.full((DURATION, 3), np.nan)
    for row, estimate in enumerate(estimates):
        if np.isfinite(estimate.lat):
            wrong = error(estimate, truth)
            for i in range(3):
                block = slice(3 * i, 3 * i + 3)
                result[row, i] = wrong[block] @ np.linalg.solve(estimate.covariance[block, block], wrong[block])
    return result


def check(runs, at, probability):
    low, high = chi2.ppf([(1 - probability) / 2, (1 + probability) / 2], 3 * len(runs)) / len(runs)
    means = runs.mean(axis=0)
    inside = np.mean((means[5:] > low) & (means[5:] < high), axis=0)
    print(f"bounds {low:.3f} {high:.3f}; position, velocity, attitude inside {inside} of the time")
    for second in at:
        print(f"t = {second} s: {means[second - 1]}")
        assert ((low < means[second - 1]) & (means[second - 1] < high)).all()
    return inside


def test_few_seeds():
    check(np.array([nees(seed) for seed in range(4)]), at=(60, 120), probability=0.999)


@pytest.mark.slow
@pytest.mark.parametrize("aids", [("gnss", "magnetometer"), ("gnss", "barometer", "magnetometer", "airspeed")])
def test_fifty_seeds(aids):
    inside = check(np.array([nees(seed, aids) for seed in range(50)]), at=(60, 120), probability=0.95)
    assert (inside > 0.8).all()


@pytest.mark.slow
def test_fifty_seeds_in_an_outage():
    """GNSS ends half-way; a minute later the three aids that are left still know how little they know."""
    check(np.array([nees(seed, denied=(60.0, np.inf)) for seed in range(50)]), at=(90, 119), probability=0.95)
