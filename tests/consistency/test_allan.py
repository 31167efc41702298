"""What a laboratory would find: the Allan deviation of two hours at rest gives back the datasheet of every grade.

Random walk is read at one second, where white noise rules. The in-run instability is read at the height of the flat
region, 1.89 correlation times, after taking the random walk away. Two hours of one axis hold only 4 to 19 intervals of
that length, so variances are averaged over axes and seeds; `allantools` computes them.
"""

import allantools
import numpy as np
import pytest

from testbed.motion.kinematic import Kinematic
from testbed.motion.sections import KinematicStart
from testbed.sensors.imu import Imu, ImuConfig
from testbed.sensors.imu_grades import GRADES

RATE_HZ = 50.0
HOURS = 2
WARM_UP_S = 1800.0  # laboratories let a unit warm up first
SEEDS = 20
FLAT = 1.89  # Gauss-Markov correlation times to the maximum of the Allan deviation
REAL = [grade for grade in GRADES if grade != "perfect"]

DEG_PER_H = np.pi / 180 / 3600
DEG_PER_ROOT_H = np.pi / 180 / 60
MG = 9.80665e-3


def at_rest(config, seed, seconds=HOURS * 3600):
    """Two hours, or so long, of (gyro, accel) rates (2, 3, n), warm."""
    place = KinematicStart(lat_deg=34.0, lon_deg=108.0, alt_m=400.0, heading_deg=30.0)
    body, imu = Kinematic(place, RATE_HZ), Imu("imu", config, RATE_HZ, seed)
    imu.sense(body.advance(round(WARM_UP_S * RATE_HZ) + 1))
    samples = imu.sense(body.advance(round(seconds * RATE_HZ)))
    return np.stack([samples.dtheta.T, samples.dv.T]) / samples.dt


def allan_variance(rates, tau):
    _, deviation, _, _ = allantools.oadev(rates, rate=RATE_HZ, data_type="freq", taus=[tau])
    return deviation[0] ** 2


def measured(config):
    """((ARW, VRW), (gyro, accel instability)) in SI, averaged over axes and seeds.

    From the variance at the floor those of white noise and of the random walk are taken: N^2 / T and K^2 T / 3.
    """
    flat = FLAT * np.array([config.gyro_instability_tau_s, config.accel_instability_tau_s])
    short, long = np.zeros(2), np.zeros(2)
    for seed in range(SEEDS):
        for triad, axes in enumerate(at_rest(config, seed)):
            short[triad] += np.mean([allan_variance(axis, 1.0) for axis in axes]) / SEEDS
            long[triad] += np.mean([allan_variance(axis, flat[triad]) for axis in axes]) / SEEDS
    walk = np.array([config.errors().gyro_random_walk, config.errors().accel_random_walk])
    return np.sqrt(short), np.sqrt(long - short / flat - walk**2 * flat / 3)


@pytest.mark.slow
@pytest.mark.parametrize("grade", REAL)
def test_two_hours_at_rest_give_back_the_datasheet(grade):
    config = ImuConfig(grade=grade, rate_hz=RATE_HZ)
    walk, instability = measured(config)
    walk_datasheet = np.array(
        [config.angle_random_walk_degprth * DEG_PER_ROOT_H, config.velocity_random_walk_mpsprth / 60]
    )
    instability_datasheet = np.array([config.gyro_instability_degph * DEG_PER_H, config.accel_instability_mg * MG])
    ratios = walk / walk_datasheet, instability / instability_datasheet
    print(f"\n{grade}: over datasheet, random walk {ratios[0]}, instability {ratios[1]}")
    np.testing.assert_allclose(walk, walk_datasheet, rtol=0.05)
    np.testing.assert_allclose(instability, instability_datasheet, rtol=0.20)


@pytest.mark.ci
def test_perfect_unit_has_no_allan_deviation():
    rates = at_rest(ImuConfig(grade="perfect", rate_hz=RATE_HZ), 0, 600)
    assert max(allan_variance(axis, 1.0) for triad in rates for axis in triad) < 1e-24  # rounding of the motion


def test_one_run_of_the_consumer_unit_gives_back_its_random_walk():
    """The quick form of the above: one second intervals of ten minutes, 6 axes."""
    config = ImuConfig(grade="mems-consumer", rate_hz=RATE_HZ)
    gyro, accel = at_rest(config, 1, 600)
    arw = np.sqrt(np.mean([allan_variance(axis, 1.0) for axis in gyro])) / DEG_PER_ROOT_H
    vrw = np.sqrt(np.mean([allan_variance(axis, 1.0) for axis in accel])) * 60
    assert arw == pytest.approx(config.angle_random_walk_degprth, rel=0.05)
    assert vrw == pytest.approx(config.velocity_random_walk_mpsprth, rel=0.05)


@pytest.mark.slow
def test_rate_random_walk_shows_at_long_intervals():
    """Allan deviation K sqrt(tau/3) of the rate random walk alone (IEEE Std 952, C.1.4)."""
    config = ImuConfig(
        grade="perfect", rate_hz=RATE_HZ, gyro_rate_random_walk_degphprth=10.0, accel_random_walk_mgprth=0.1
    )
    tau = 300.0
    variances = np.mean(
        [[[allan_variance(axis, tau) for axis in triad] for triad in at_rest(config, seed)] for seed in range(8)],
        axis=(0, 2),
    )
    K = np.sqrt(3 * variances / tau)
    np.testing.assert_allclose(K, [10.0 * DEG_PER_H / 60, 0.1 * MG / 60], rtol=0.1)
