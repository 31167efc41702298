"""White and correlated GNSS errors, recovered from what the receiver delivers at rest."""

import numpy as np
import pytest

from nav.earth import position_difference_n
from testbed.motion.kinematic import Kinematic
from testbed.motion.sections import KinematicStart
from testbed.sensors.gnss import GRADES, Gnss, GnssConfig

RATE_HZ = 0.2
HOURS = 60
SEEDS = 12
REAL = [grade for grade in GRADES if grade != "perfect"]


def errors(config, seed):
    """(position (n, 3) [m], velocity (n, 3) [m/s]) errors of one long stay, and the same over the reported sigma."""
    place = KinematicStart(lat_deg=47.0, lon_deg=-120.0, alt_m=400.0, heading_deg=0.0)
    truth = Kinematic(place, RATE_HZ).advance(round(HOURS * 3600 * RATE_HZ))
    samples = Gnss("gnss", config, RATE_HZ, seed).sense(truth)
    lat, lon, h = (np.array([getattr(s, name) for s in samples]) for name in ("lat", "lon", "h"))
    position = position_difference_n(lat, lon, h, truth.lat, truth.lon, truth.h)
    velocity = np.array([s.v_n for s in samples]) - truth.v_n
    sigmas = np.array([[*s.sigma_position_n, *s.sigma_velocity_n] for s in samples])
    return np.hstack([position, velocity]), sigmas


def autocovariance(runs, lag):
    """Of runs (k, n) with zero mean."""
    return np.mean(runs[:, : runs.shape[1] - lag] * runs[:, lag:])


def split(runs, tau):
    """(white, correlated) standard deviations of runs (k, n): R(m) = c^2 exp(-m dt/tau) but for white^2 at m = 0.

    The correlated part is read half a correlation time away; the white part from differences of neighbours, whose
    variance is 2 white^2 + 2 c^2 (1 - exp(-dt/tau)).
    """
    lag = max(1, round(tau * RATE_HZ / 2))
    correlated2 = autocovariance(runs, lag) * np.exp(lag / RATE_HZ / tau)
    white2 = np.mean(np.diff(runs) ** 2) / 2 - correlated2 * -np.expm1(-1 / RATE_HZ / tau)
    return np.sqrt(white2), np.sqrt(correlated2)


def correlation_time(runs, tau):
    """From how the autocovariance decays between half a correlation time and a whole one."""
    lag = max(1, round(tau * RATE_HZ / 2))
    return -lag / RATE_HZ / np.log(autocovariance(runs, 2 * lag) / autocovariance(runs, lag))


@pytest.mark.slow
@pytest.mark.parametrize("grade", REAL)
def test_white_and_correlated_errors_are_recovered(grade):
    config = GnssConfig(grade=grade, rate_hz=RATE_HZ, jumps_per_h=0.0)  # jumps have tests of their own
    e = config.errors()
    found = [errors(config, seed) for seed in range(SEEDS)]
    for what, first, white, correlated, tau in [
        ("position", 0, e.position_white_n, e.position_correlated_n, e.position_tau),
        ("velocity", 3, e.velocity_white_n, e.velocity_correlated_n, e.velocity_tau),
    ]:
        axes = [np.array([run[:, first + c] for run, _ in found]) for c in range(3)]
        sizes = np.array([split(runs, tau) for runs in axes]) / np.stack([white, correlated], axis=1)
        normalised = np.concatenate([runs / np.hypot(white[c], correlated[c]) for c, runs in enumerate(axes)])
        time = correlation_time(normalised, tau) / tau
        reported = np.mean([(run[:, first : first + 3] / sigma[:, first : first + 3]) ** 2 for run, sigma in found])
        print(f"\n{grade} {what}, over what was asked: white {sizes[:, 0]}, correlated {sizes[:, 1]}, time {time:.4f};")
        print(f"mean (error/reported)^2 {reported:.4f}")
        np.testing.assert_allclose(sizes, 1.0, rtol=0.05)
        assert time == pytest.approx(1.0, rel=0.05)
        assert reported == pytest.approx(1.0, rel=0.05)


@pytest.mark.ci
def test_reported_accuracy_covers_a_short_stay():
    """The quick form: fast correlation, so that the stay holds many."""
    config = GnssConfig(rate_hz=RATE_HZ, correlation_time_s=20.0, velocity_correlation_time_s=20.0)
    run, sigma = errors(config, 3)
    np.testing.assert_allclose(np.mean((run / sigma) ** 2, axis=0), 1.0, rtol=0.1)
    np.testing.assert_allclose(run.mean(axis=0) / sigma[0], 0.0, atol=0.06)
