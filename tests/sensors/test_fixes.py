"""Body velocity, star tracker and position fixes: what they measure, how wrong they are, when they are silent.

And several sensors of a kind side by side, in a whole run.
"""

import json

import numpy as np
import pymap3d
import pytest
from pymap3d.vincenty import vreckon
from scipy import stats
from scipy.spatial.transform import Rotation
from worlds.sensor_truth import RATE_HZ, lively, still

from testbed import Scenario, run
from testbed.exports import export
from testbed.report.page import write_report
from testbed.sensors.body_velocity import BodyVelocity, BodyVelocityConfig
from testbed.sensors.position_fix import PositionFix, PositionFixConfig
from testbed.sensors.star_tracker import StarTracker, StarTrackerConfig

ARCSEC = np.pi / 180 / 3600
OMEGA_IE = 7.292115e-5
CLASSES = {BodyVelocityConfig: BodyVelocity, StarTrackerConfig: StarTracker, PositionFixConfig: PositionFix}
CONFIGS = list(CLASSES)


def sense(config, truth, seed=1, rate_hz=RATE_HZ, name="x"):
    return CLASSES[type(config)](name, config, rate_hz, seed).sense(truth)


def scipy_rotation(q):
    return Rotation.from_quat(q, scalar_first=True)


def correlation(x, lag):
    return np.mean(x[lag:] * x[:-lag]) / np.mean(x**2)


# --- body velocity


def moving(n, rate_hz, v_b=(100.0, 2.0, -3.0)):
    """Attitude fixed and askew, velocity constant."""
    truth = still(n, rate_hz)
    C = Rotation.from_euler("ZYX", [2.0, 0.3, -0.5])
    truth.q_nb[:] = C.as_quat(scalar_first=True)
    truth.v_n[:] = C.apply(v_b)
    return truth


def velocities(config, truth, seed=1, rate_hz=RATE_HZ):
    return np.array([s.v_b for s in sense(config, truth, seed, rate_hz)])


def test_perfect_body_velocity_is_truth_in_body_axes():
    truth = lively(1000)
    samples = sense(BodyVelocityConfig(grade="perfect", rate_hz=20.0, latency_s=0.02), truth)
    expected = scipy_rotation(truth.q_nb[::10]).inv().apply(truth.v_n[::10])
    np.testing.assert_allclose([s.v_b for s in samples], expected, atol=1e-12)
    assert [s.t for s in samples] == truth.t[::10].tolist()
    np.testing.assert_allclose([s.t_arrival - s.t for s in samples], 0.02, atol=1e-12)
    assert samples[0].sensor == "x"


def test_axes_that_are_not_measured_are_nan():
    odometer = velocities(BodyVelocityConfig(grade="odometer"), lively(100))
    assert len(odometer) == 25  # 50 Hz
    assert np.isfinite(odometer[:, 0]).all()
    assert np.isnan(odometer[:, 1:]).all()
    config = BodyVelocityConfig(axes=("down", "forward"), rate_hz=20.0)
    assert config.errors().axes == (0, 2)
    two = velocities(config, lively(100))
    assert np.isfinite(two[:, [0, 2]]).all()
    assert np.isnan(two[:, 1]).all()
    # an axis more or less changes nothing on the others
    three = velocities(BodyVelocityConfig(rate_hz=20.0), lively(100))
    np.testing.assert_array_equal(two[:, [0, 2]], three[:, [0, 2]])


def test_odometer_noise():
    n, true = 40_000, np.array([5.0, 0.0, 0.0])
    error = velocities(BodyVelocityConfig(grade="odometer"), moving(n, 50.0, true), rate_hz=50.0)[:, 0] - 5.0
    assert error.std() == pytest.approx(0.3, rel=0.05)
    assert abs(error.mean()) < 4 * 0.3 / np.sqrt(n)
    assert abs(correlation(error, 1)) < 4 / np.sqrt(n)
    assert stats.kstest(error / 0.3, "norm").pvalue > 1e-3


@pytest.mark.ci
def test_doppler_white_and_markov_noise():
    """White variance and correlated variance apart by the autocovariance, which is that of a first-order process."""
    tau, n = 30.0, 400_000  # 13000 correlation times: 1 % of a standard deviation
    config = BodyVelocityConfig(correlation_time_s=tau, scale_percent=0.0)
    error = velocities(config, moving(n, 1.0), rate_hz=1.0) - [100.0, 2.0, -3.0]
    assert error.std() == pytest.approx(np.hypot(0.1, 0.05), rel=0.05)
    for axis in error.T:
        lag = int(tau)
        covariance = [np.mean(axis[k:] * axis[: n - k]) for k in (1, lag)]
        correlated = covariance[0] * np.exp(1 / tau)
        assert np.sqrt(correlated) == pytest.approx(0.05, rel=0.05)
        assert np.sqrt(np.var(axis) - correlated) == pytest.approx(0.1, rel=0.05)
        assert -lag / np.log(covariance[1] / correlated) == pytest.approx(tau, rel=0.1)
    assert np.abs(np.corrcoef(error.T)[np.triu_indices(3, 1)]).max() < 0.02


@pytest.mark.ci
@pytest.mark.parametrize("grade", ["dvl", "doppler"])
def test_scale_factor_is_constant_and_of_each_axis(grade):
    share = {"dvl": 0.005, "doppler": 0.001}[grade]
    config = BodyVelocityConfig(grade=grade, noise_mps=0.0, correlated_mps=0.0)
    assert config.errors().scale == pytest.approx(share)
    v_b = np.array([100.0, 50.0, -20.0])
    scales = []
    for seed in range(1500):
        measured = velocities(config, moving(2, 1.0, v_b), seed, 1.0) / v_b - 1
        np.testing.assert_allclose(measured[0], measured[1], atol=1e-12)
        scales.append(measured[0])
    assert np.std(scales) == pytest.approx(share, rel=0.05)
    assert np.abs(np.corrcoef(np.transpose(scales))[np.triu_indices(3, 1)]).max() < 0.1


def test_dvl_noise_at_rest():
    error = velocities(BodyVelocityConfig(grade="dvl"), still(20_000, 1.0), rate_hz=1.0)
    assert error.std() == pytest.approx(0.005, rel=0.05)


def test_thinned_to_one_in_thirty_seconds():
    samples = sense(BodyVelocityConfig(grade="dvl", rate_hz=1 / 30), still(121, 1.0), rate_hz=1.0)
    assert [s.t for s in samples] == [0.0, 30.0, 60.0, 90.0, 120.0]


# --- star tracker


def true_q_ib(truth, k):
    """Attitude in i by pymap3d's axes of n and scipy's rotations."""
    place = truth.lat[k], truth.lon[k], truth.h[k]
    origin = pymap3d.geodetic2ecef(*place, deg=False)
    axes = [np.subtract(pymap3d.ned2ecef(*1000 * axis, *place, deg=False), origin) / 1000 for axis in np.eye(3)]
    C_en = Rotation.from_matrix(np.transpose(axes))
    return Rotation.from_rotvec([0, 0, OMEGA_IE * truth.t[k]]) * C_en * scipy_rotation(truth.q_nb[k])


def test_perfect_star_tracker_is_attitude_in_inertial_axes():
    truth = lively(400)
    truth.t[:] += 20_000.0  # the Earth has turned by 84 deg
    samples = sense(StarTrackerConfig(grade="perfect", rate_hz=4.0), truth)
    assert len(samples) == 8
    for k, sample in zip(range(0, 400, 50), samples, strict=True):
        error = true_q_ib(truth, k).inv() * scipy_rotation(sample.q_ib)
        assert error.magnitude() < 1e-8
        assert np.linalg.norm(sample.q_ib) == pytest.approx(1, abs=1e-14)


@pytest.mark.ci
@pytest.mark.parametrize(("boresight", "poor"), [("forward", 0), ("right", 1), ("down", 2)])
def test_star_tracker_noise_about_each_body_axis(boresight, poor):
    n = 8000
    truth = moving(n, 1.0)
    config = StarTrackerConfig(boresight=boresight)
    perfect = sense(StarTrackerConfig(grade="perfect"), truth, rate_hz=1.0)
    noisy = sense(config, truth, rate_hz=1.0)
    before = scipy_rotation([s.q_ib for s in perfect])
    errors = (before.inv() * scipy_rotation([s.q_ib for s in noisy])).as_rotvec()
    expected = np.full(3, 5.0)
    expected[poor] = 15.0
    np.testing.assert_allclose(errors.std(axis=0) / ARCSEC, expected, rtol=0.05)
    np.testing.assert_allclose(config.errors().noise_b / ARCSEC, expected)
    assert max(abs(correlation(e, 1)) for e in errors.T) < 4 / np.sqrt(n)
    assert np.abs(np.corrcoef(errors.T)[np.triu_indices(3, 1)]).max() < 4 / np.sqrt(n)


# --- position fix


def error_n(samples, truth):
    """Position errors (n, 3) [m] at rest."""
    here = truth.lat[0], truth.lon[0], truth.h[0]
    return np.transpose([pymap3d.geodetic2ned(s.lat, s.lon, s.h, *here, deg=False) for s in samples]).T


def test_perfect_fix_is_truth_bit_for_bit():
    truth = lively(400)
    samples = sense(PositionFixConfig(grade="perfect", rate_hz=10.0), truth)
    for name in ("t", "lat", "lon", "h"):
        assert [getattr(s, name) for s in samples] == getattr(truth, name)[::20].tolist()


def test_terrain_fix_is_gaussian_on_three_axes():
    n = 12_000
    truth = still(n, 1.0)
    config = PositionFixConfig(grade="terrain")
    errors = error_n(sense(config, truth, rate_hz=1.0), truth)
    np.testing.assert_allclose(errors.std(axis=0), 30.0, rtol=0.05)
    np.testing.assert_allclose(config.errors().position_n, 30.0)
    for axis in errors.T:
        assert stats.kstest(axis / 30, "norm").pvalue > 1e-3
        assert abs(correlation(axis, 1)) < 4 / np.sqrt(n)


def test_transponder_fix_is_uniform_and_has_no_height():
    n = 12_000
    truth = still(n, 1.0)
    config = PositionFixConfig(grade="transponder", rate_hz=1.0)
    samples = sense(config, truth, rate_hz=1.0)
    assert np.isnan([s.h for s in samples]).all()
    assert not config.errors().height
    flat = [pymap3d.geodetic2ned(s.lat, s.lon, 0.0, 0.0, 0.0, 0.0, deg=False)[:2] for s in samples]
    for axis in np.transpose(flat):
        assert np.abs(axis).max() < 20.001
        assert stats.kstest(axis, "uniform", args=(-20, 40)).pvalue > 1e-3
        assert axis.std() == pytest.approx(config.errors().position_n[0], rel=0.05)
    assert abs(np.corrcoef(np.transpose(flat))[0, 1]) < 4 / np.sqrt(n)


@pytest.mark.parametrize("depth", [0.0, 1500.0])
@pytest.mark.parametrize(("lat_deg", "lon_deg"), [(30.5, 114.3), (-60.0, 180.0)])
def test_range_zone_is_as_the_crow_flies(lat_deg, lon_deg, depth):
    n, heard = 400, 2500.0
    truth = still(n, 1.0)
    rng = np.random.default_rng(0)
    lat, lon = vreckon(lat_deg, lon_deg, rng.uniform(0, 2 * heard, n), rng.uniform(0, 360, n))
    truth.lat[:], truth.lon[:] = np.radians(lat), np.radians((lon + 180) % 360 - 180)
    where = pymap3d.geodetic2ecef(truth.lat, truth.lon, truth.h, deg=False)
    centre = pymap3d.geodetic2ecef(lat_deg, lon_deg, -depth)
    distance = np.linalg.norm(np.transpose(where) - centre, axis=1)
    transponder = {"lat_deg": lat_deg, "lon_deg": lon_deg, "alt_m": -depth, "range_m": heard}
    config = PositionFixConfig(rate_hz=1.0, transponder=transponder)
    assert 0.2 < (distance <= heard).mean() < 0.8
    times = [s.t for s in sense(config, truth, rate_hz=1.0)]
    assert times == truth.t[distance <= heard].tolist()
    # Being out of range moves no error of the fixes within.
    everywhere = {s.t: s for s in sense(PositionFixConfig(rate_hz=1.0), truth, rate_hz=1.0)}
    for sample in sense(config, truth, rate_hz=1.0):
        assert (sample.lat, sample.lon) == (everywhere[sample.t].lat, everywhere[sample.t].lon)


# --- silence, of all three alike


@pytest.mark.parametrize("kind", CONFIGS)
def test_denied_windows_are_silent(kind):
    samples = sense(kind(rate_hz=5.0, denied=[[4.0, 6.0], [1.0, 2.0]]), still(2000))
    times = np.round([s.t for s in samples], 9)
    expected = np.round(np.arange(50) / 5, 9)
    np.testing.assert_array_equal(times, [t for t in expected if not (1 <= t < 2 or 4 <= t < 6)])


@pytest.mark.ci
@pytest.mark.parametrize("kind", CONFIGS)
def test_dropouts_come_at_their_rate_one_by_one_and_move_no_other_number(kind):
    n, share = 20_000, 0.1
    truth = moving(n, 1.0)
    everything = {s.t: s for s in sense(kind(rate_hz=1.0), truth, rate_hz=1.0)}
    assert len(everything) == n
    left = sense(kind(rate_hz=1.0, dropout_percent=100 * share), truth, rate_hz=1.0)
    lost = ~np.isin(truth.t, [s.t for s in left])
    assert lost.mean() == pytest.approx(share, rel=0.05)
    assert (lost[1:] & lost[:-1]).mean() == pytest.approx(share**2, rel=0.25)  # independent of each other
    for sample in left[:100]:
        for name in sample.__slots__:
            np.testing.assert_array_equal(getattr(sample, name), getattr(everything[sample.t], name))


@pytest.mark.parametrize("kind", CONFIGS)
def test_bad_windows_are_refused(kind):
    with pytest.raises(ValueError, match="overlap"):
        kind(denied=[[10, 50], [40, 60]])


# --- several of a kind, by name

TWINS = """
title = "Two of each at rest"
seed = 3
duration_s = 130
[truth]
source = "kinematic"
rate_hz = 50
start = { lat_deg = 30.5, lon_deg = 114.3, alt_m = 20, heading_deg = 40 }
[sensors.imu]
rate_hz = 50
[sensors.imu2]
kind = "imu"
rate_hz = 50
gyro_turn_on_degph = 4000
[sensors.gnss]
rate_hz = 2
[sensors.gnss2]
kind = "gnss"
rate_hz = 2
denied = [[50, 70]]
[sensors.magnetometer]
rate_hz = 5
[sensors.radar]
kind = "body_velocity"
[sensors.radar2]
kind = "body_velocity"
[sensors.odometer]
kind = "body_velocity"
grade = "odometer"
[sensors.star_tracker]
[sensors.star_tracker2]
kind = "star_tracker"
[sensors.beacon]
kind = "position_fix"
transponder = { lat_deg = 30.5, lon_deg = 114.3, range_m = 500 }
[sensors.beacon2]
kind = "position_fix"
transponder = { lat_deg = 30.5, lon_deg = 114.3, range_m = 500 }
[sensors.far]
kind = "position_fix"
transponder = { lat_deg = 31.5, lon_deg = 114.3, range_m = 500 }
[[estimator]]
name = "first"
aids = ["gnss", "magnetometer"]
[[estimator]]
name = "second"
imu = "imu2"
aids = ["gnss2", "magnetometer"]
"""


@pytest.fixture(scope="module")
def twins(tmp_path_factory):
    return run(Scenario.parse(TWINS), out=tmp_path_factory.mktemp("twins"))


@pytest.mark.parametrize(("name", "what"), [
    ("imu", "dtheta"), ("gnss", "lat"), ("radar", "v_b"), ("star_tracker", "q_ib"), ("beacon", "lat"),
])  # fmt: skip
def test_twins_are_recorded_by_name_with_errors_of_their_own(twins, name, what):
    one, two = (twins.dataset[f"sensors/{sensor}"] for sensor in (name, f"{name}2"))
    assert np.array_equal(one["time"], two["time"])
    assert len(one["time"]) >= 10
    same = np.isclose(one[what].values, two[what].values, rtol=1e-15, atol=0) & np.isfinite(two[what].values)
    assert same.mean() < 0.1


def test_recorded_columns_say_what_they_are(twins):
    q_ib, v_b = twins.dataset["sensors/star_tracker/q_ib"], twins.dataset["sensors/odometer/v_b"]
    assert "ECEF at time 0" in q_ib.attrs["frame"]
    assert v_b.attrs["units"] == "m/s"
    assert np.isfinite(v_b.sel(body="forward")).all()
    assert np.isnan(v_b.sel(body="right")).all()
    assert "far" not in twins.dataset["sensors"].children


@pytest.mark.ci
def test_twins_in_export_and_report(twins):
    folder = export(twins.path / "run.nc", "csv")
    for name in ("imu2", "gnss2", "radar2", "star_tracker2", "beacon2"):
        assert (folder / f"sensors.{name}.csv").exists()
    page = write_report(twins.dataset, twins.metrics, twins.path).read_text("utf-8")
    assert "gnss2 denied" in page
    assert "gnss2 reacquired" in page


def test_each_estimator_uses_the_sensors_that_it_names(twins):
    fused = {
        name: twins.dataset[f"estimators/{name}/innovations/gnss_position/sample_time"].values
        for name in ("first", "second")
    }
    assert ((fused["first"] > 51) & (fused["first"] < 69)).any()
    assert not ((fused["second"] >= 50) & (fused["second"] < 70)).any()
    assert json.loads(twins.dataset.attrs["estimator_imus"]) == {"first": "imu", "second": "imu2"}
    bias = {n: np.abs(twins.dataset[f"estimators/{n}/gyro_bias"].values[-1]).max() for n in ("first", "second")}
    assert bias["second"] > 5 * bias["first"]  # 4000 deg/h against 40


def test_the_report_compares_biases_with_the_estimators_own_imu(twins):
    from testbed.report.figures import imu
    from testbed.report.run import Run

    seen = {name: imu.imu_error(Run(twins.dataset), name) for name in ("first", "second")}
    assert np.abs(seen["second"]["gyro"]).max() > 5 * np.abs(seen["first"]["gyro"]).max()
