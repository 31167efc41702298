"""The receiver: where its antenna is, what it adds, when it is silent and how it comes back."""

import numpy as np
import pymap3d
import pytest
from pymap3d.vincenty import vreckon
from scipy.spatial.transform import Rotation
from worlds.sensor_truth import RATE_HZ, lively, still

from nav.samples import FixType
from testbed.errors import UserError
from testbed.sensors.gnss import GRADES, Gnss, GnssConfig


def sense(config, truth, seed=1, rate_hz=RATE_HZ):
    return Gnss("gnss", config, rate_hz, seed).sense(truth)


def error_n(samples, truth):
    """Position error (n, 3) [m] of a receiver at rest at latitude 0."""
    lat0, lon0, h0 = truth.lat[0], truth.lon[0], truth.h[0]
    enu = [pymap3d.geodetic2enu(s.lat, s.lon, s.h, lat0, lon0, h0, deg=False) for s in samples]
    return np.array(enu)[:, [1, 0, 2]] * [1, 1, -1]


def test_perfect_receiver_is_truth_bit_for_bit():
    truth = lively(1000)
    samples = sense(GnssConfig(grade="perfect", rate_hz=10.0), truth)
    rows = slice(0, None, 20)
    assert [s.t for s in samples] == truth.t[rows].tolist()
    assert [s.t_arrival for s in samples] == truth.t[rows].tolist()
    for name in ("lat", "lon", "h"):
        assert [getattr(s, name) for s in samples] == getattr(truth, name)[rows].tolist()
    np.testing.assert_array_equal([s.v_n for s in samples], truth.v_n[rows])
    assert all(s.fix_type == FixType.FIX_3D and s.sensor == "gnss" for s in samples)
    # A receiver reports millimetres; an accuracy of nothing at all would be refused as unsound.
    assert all((s.sigma_position_n == 1e-3).all() and (s.sigma_velocity_n == 1e-3).all() for s in samples)


def test_timing():
    truth = lively(400)
    samples = sense(GnssConfig(rate_hz=5.0, offset_s=0.115, latency_s=0.25), truth)
    np.testing.assert_allclose([s.t for s in samples], 0.115 + 0.2 * np.arange(10), atol=1e-12)
    np.testing.assert_allclose([s.t_arrival - s.t for s in samples], 0.25, atol=1e-12)
    late = sense(GnssConfig(rate_hz=5.0, offset_s=1.5), truth)
    assert [round(s.t, 9) for s in late] == [1.5, 1.7, 1.9]


@pytest.mark.parametrize(("keys", "message"), [
    ({"rate_hz": 7.0}, r"sensors\.gnss\.rate_hz: 7 Hz does not divide"),
    ({"offset_s": 0.001}, r"sensors\.gnss\.offset_s: 0\.001 s is not a whole number of ticks"),
])  # fmt: skip
def test_timing_off_the_ticks_is_refused(keys, message):
    with pytest.raises(UserError, match=message):
        Gnss("gnss", GnssConfig(**keys), RATE_HZ, 1)


@pytest.mark.parametrize("lat_deg", [-80.0, -34.0, 0.0, 60.0])
@pytest.mark.parametrize("lon_deg", [10.0, 180.0])
def test_lever_arm_moves_position_and_velocity(lat_deg, lon_deg):
    """Against finite differences of the antenna's ECEF position, by pymap3d."""
    arm, eps = np.array([1.5, -0.7, 0.4]), 1e-3
    lat0, lon0, h0 = np.radians(lat_deg), np.radians(lon_deg), 300.0

    def attitude(t):
        return Rotation.from_euler("ZYX", [1 + 0.3 * t, 0.2 + 0.1 * t, -0.4 + 0.5 * t])

    def antenna_ecef(t):
        # at rest on the ground but turning: n does not move
        n, e, d = attitude(t).apply(arm)
        return np.array(pymap3d.ned2ecef(n, e, d, lat0, lon0, h0, deg=False))

    truth = still(1)
    truth.lat[:], truth.lon[:], truth.h[:] = lat0, lon0, h0
    truth.q_nb[0] = attitude(0.0).as_quat(scalar_first=True)
    omega_ie_n = 7.292115e-5 * np.array([np.cos(lat0), 0.0, -np.sin(lat0)])
    omega_nb_b = (attitude(-eps).inv() * attitude(eps)).as_rotvec() / (2 * eps)
    truth.omega_b[0] = omega_nb_b + attitude(0.0).inv().apply(omega_ie_n)
    (sample,) = sense(GnssConfig(grade="perfect", lever_arm_m=tuple(arm)), truth)

    expected = antenna_ecef(0.0)
    np.testing.assert_allclose(pymap3d.geodetic2ecef(sample.lat, sample.lon, sample.h, deg=False), expected, atol=1e-5)
    velocity_e = (antenna_ecef(eps) - antenna_ecef(-eps)) / (2 * eps)
    e, n, u = pymap3d.ecef2enuv(*velocity_e, lat0, lon0, deg=False)
    np.testing.assert_allclose(sample.v_n, [n, e, -u], atol=1e-6)
    assert -np.pi < sample.lon <= np.pi


def test_reported_accuracy_is_the_total_of_what_is_added():
    config = GnssConfig(horizontal_white_m=3.0, horizontal_correlated_m=4.0, vertical_white_m=5.0,
                        vertical_correlated_m=12.0, horizontal_velocity_white_mps=0.3,
                        horizontal_velocity_correlated_mps=0.4)  # fmt: skip
    (sample,) = sense(config, still(1))
    np.testing.assert_allclose(sample.sigma_position_n, [5.0, 5.0, 13.0])
    np.testing.assert_allclose(sample.sigma_velocity_n[:2], [0.5, 0.5])


# --- denial

DENIED = GnssConfig(rate_hz=5.0, denied=((2.0, 4.0),), reacquire_s=1.5, settle_factor=3.0, settle_s=2.0)


def test_denied_window_and_time_to_reacquire():
    for sample in sense(DENIED, still(2000)):
        assert (sample.fix_type == FixType.NO_FIX) == (2.0 <= round(sample.t, 9) < 5.5)


def test_without_a_fix_samples_come_and_say_nothing():
    samples = [s for s in sense(DENIED, still(2000)) if s.fix_type == FixType.NO_FIX]
    assert len(samples) == 18  # 2.0 to 5.4 s
    for s in samples:
        assert np.isnan([s.lat, s.lon, s.h, *s.v_n, *s.sigma_position_n, *s.sigma_velocity_n]).all()
        assert s.satellites == 0
        assert s.hdop > 50
        assert s.t_arrival == pytest.approx(s.t + 0.1)


def test_accuracy_settles_after_reacquisition_and_errors_with_it():
    truth = still(3000)
    denied = {s.t: s for s in sense(DENIED, truth)}
    heard = sense(DENIED.model_copy(update={"denied": ()}), truth)
    normal = heard[0].sigma_position_n
    errors = dict(zip([s.t for s in heard], error_n(heard, truth), strict=True))
    fixed = [s for s in denied.values() if s.fix_type == FixType.FIX_3D]
    for sample, error in zip(fixed, error_n(fixed, truth), strict=True):
        factor = 1.0 if sample.t < 2.0 else 1 + 2.0 * np.exp(-(sample.t - 5.5) / 2.0)
        np.testing.assert_allclose(sample.sigma_position_n, factor * normal, rtol=1e-9)
        # the errors went on under denial: those of a receiver that was never denied, scaled
        np.testing.assert_allclose(error, factor * errors[sample.t], atol=1e-5)
    assert min(fixed, key=lambda s: abs(s.t - 5.5)).satellites < fixed[0].satellites


def test_window_between_two_samples_breaks_lock_too():
    config = GnssConfig(rate_hz=1.0, denied=((2.2, 2.4),), reacquire_s=1.0)
    assert [s.t for s in sense(config, still(1201)) if s.fix_type == FixType.NO_FIX] == [3.0]


def test_denied_from_the_start():
    samples = sense(GnssConfig(rate_hz=1.0, denied=((0.0, 2.0),), reacquire_s=0.0), still(1001))
    assert [s.fix_type == FixType.NO_FIX for s in samples] == [True, True, False, False, False, False]


@pytest.mark.parametrize("lat_deg", [-60.0, 0.0, 75.0])
@pytest.mark.parametrize("lon_deg", [25.0, 180.0])
def test_jammer_zone_by_geodesic_distance(lat_deg, lon_deg):
    radius, n = 2500.0, 400
    truth = still(n, 1.0)
    rng = np.random.default_rng(0)
    bearing, away = rng.uniform(0, 360, n), rng.uniform(0, 2 * radius, n)
    lat, lon = vreckon(lat_deg, lon_deg, away, bearing)
    truth.lat[:], truth.lon[:] = np.radians(lat), np.radians((lon + 180) % 360 - 180)
    truth.h[:] = 3000.0  # the zone is a cylinder
    jammers = ({"lat_deg": lat_deg, "lon_deg": lon_deg, "radius_m": radius},)
    samples = sense(GnssConfig(rate_hz=1.0, jammers=jammers, reacquire_s=0.0), truth, rate_hz=1.0)
    for sample, distance in zip(samples, away, strict=True):
        if abs(distance - radius) > 0.01:
            assert (sample.fix_type == FixType.NO_FIX) == (distance < radius)


@pytest.mark.parametrize("denied", [(), ((2.0, 5.0),)])
def test_time_to_reacquire_counts_from_leaving_the_zone(denied):
    truth = still(60, 1.0)
    truth.lat[:] = np.arange(60) * 10.0 / 6_335_439  # 10 m/s north from the equator
    jammers = ({"lat_deg": 0.0, "lon_deg": 0.0, "radius_m": 204.0},)
    samples = sense(GnssConfig(rate_hz=1.0, jammers=jammers, denied=denied, reacquire_s=3.5), truth, rate_hz=1.0)
    assert next(s.t for s in samples if s.fix_type == FixType.FIX_3D) == 24.0  # last jammed at 20 s


@pytest.mark.parametrize("grade", sorted(set(GRADES) - {"perfect"}))
def test_sky_is_plausible(grade):
    samples = sense(GnssConfig(grade=grade, rate_hz=1.0), still(3600, 1.0), rate_hz=1.0)
    preset = GRADES[grade]
    counts = np.array([s.satellites for s in samples])
    assert abs(counts.mean() - preset["satellites"]) < 1.5
    assert 1 < len(np.unique(counts)) < 10
    for s in samples:  # fewer satellites, worse geometry
        assert s.hdop == pytest.approx(preset["hdop"] * np.sqrt(preset["satellites"] / s.satellites))
        assert s.vdop > s.hdop


@pytest.mark.parametrize(("windows", "message"), [
    ([[300, 200]], "ends before it starts"),
    ([[300, 300]], "ends before it starts"),
    ([[-5, 10]], "starts before the run"),
    ([[10, 50], [40, 60]], "overlap"),
    ([[40, 60], [10, 50]], "overlap"),
    ([[10, 50], [20, 30]], "overlap"),
])  # fmt: skip
def test_bad_windows_are_refused(windows, message):
    with pytest.raises(ValueError, match=message):
        GnssConfig(denied=windows)


def test_windows_are_taken_in_any_order():
    assert GnssConfig(denied=[[40, 60], [10, 40]]).denied == ((10, 40), (40, 60))
