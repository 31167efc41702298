"""The geomagnetic field against published values, and what the magnetometer makes of it."""

import datetime

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation
from worlds.sensor_truth import RATE_HZ, lively, still

from testbed import Scenario
from testbed.errors import UserError
from testbed.estimators.datasheet import aid_of
from testbed.sensors.magnetometer import FieldMap, Magnetometer, MagnetometerConfig, geomagnetic_field_n
from testbed.sensors.site import Site

DATE = datetime.date(2026, 6, 1)
SITE = Site(DATE, 0.6, 1.9, 800.0)

# WMM2025_TEST_VALUES.txt (NOAA NCEI): year, height km, lat deg, lon deg, north, east, down nT
PUBLISHED = [
    (2025.0, 0, 80, 0, 6521.6, 145.9, 54791.5),
    (2025.0, 0, 0, 120, 39677.8, -109.6, -10580.2),
    (2025.0, 0, -80, -120, 6117.5, 15751.9, -52022.5),
    (2025.0, 100, 80, 0, 6216.0, 92.4, 52598.8),
    (2025.0, 100, 0, 120, 37688.6, -96.2, -10152.1),
    (2025.0, 100, -80, -120, 5907.6, 14780.3, -49540.7),
    (2027.5, 0, 80, 0, 6500.8, 294.5, 54869.4),
    (2027.5, 0, 0, 120, 39701.6, -167.4, -10381.8),
    (2027.5, 0, -80, -120, 6200.7, 15730.3, -51783.7),
    (2027.5, 100, 80, 0, 6196.7, 233.8, 52670.5),
    (2027.5, 100, 0, 120, 37711.5, -148.7, -9969.8),
    (2027.5, 100, -80, -120, 5984.0, 14760.1, -49317.7),
]


@pytest.mark.parametrize(("year", "h_km", "lat_deg", "lon_deg", "north", "east", "down"), PUBLISHED)
def test_field_has_the_published_values(year, h_km, lat_deg, lon_deg, north, east, down):
    date = datetime.date(2025, 1, 1) if year == 2025.0 else datetime.date(2027, 7, 2)
    field = geomagnetic_field_n(np.radians(lat_deg), np.radians(lon_deg), 1000.0 * h_km, date)
    # published to 0.1 nT; noon of 2 July, the middle of the year, is half a day from a whole date: 0.1 nT of change
    np.testing.assert_allclose(field / 1e-9, [north, east, down], atol=0.06 if year == 2025.0 else 0.2)


@pytest.mark.parametrize("year", [2009, 2030, 1900])
def test_date_without_a_model_is_refused(year):
    date = datetime.date(year, 6, 1)
    with pytest.raises(UserError, match="no geomagnetic model"):
        geomagnetic_field_n(0.6, 1.9, 0.0, date)
    with pytest.raises(UserError, match="no geomagnetic model"):
        Magnetometer("magnetometer", MagnetometerConfig(), RATE_HZ, 1, Site(date, 0.6, 1.9, 0.0))


@pytest.mark.parametrize("year", range(2010, 2030))
def test_every_covered_year_has_a_model(year):
    for date in (datetime.date(year, 1, 1), datetime.date(year, 12, 31)):
        assert 2e-5 < np.linalg.norm(geomagnetic_field_n(0.6, 1.9, 0.0, date)) < 7e-5


def test_interpolated_field_is_that_of_the_model():
    rng = np.random.default_rng(0)
    field_map = FieldMap(DATE)
    for _ in range(200):
        lat, lon, h = np.radians(rng.uniform(-80, 80)), np.radians(rng.uniform(-180, 180)), rng.uniform(-400, 9000)
        difference = field_map.field_n(lat, lon, h) - geomagnetic_field_n(lat, lon, h, DATE)
        assert np.abs(difference).max() < 1e-9


def test_interpolated_field_is_continuous_across_the_date_line():
    field_map = FieldMap(DATE)
    west, east = (field_map.field_n(0.3, lon, 100.0) for lon in (np.pi - 1e-9, -np.pi + 1e-9))
    np.testing.assert_allclose(west, east, atol=1e-12)


def sense(config, truth, seed=1):
    return np.array([s.field_b for s in Magnetometer("magnetometer", config, RATE_HZ, seed, SITE).sense(truth)])


def test_perfect_magnetometer_sees_the_field_in_body_axes():
    truth = lively(2000)
    field = sense(MagnetometerConfig(grade="perfect", rate_hz=20.0), truth)
    rows = range(0, 2000, 10)
    field_n = np.array([geomagnetic_field_n(truth.lat[k], truth.lon[k], truth.h[k], DATE) for k in rows])
    expected = Rotation.from_quat(truth.q_nb[::10], scalar_first=True).inv().apply(field_n)
    np.testing.assert_allclose(field, expected, atol=1e-9)


def test_iron_is_affine_and_constant():
    truth = lively(4000)
    exact = sense(MagnetometerConfig(grade="perfect"), truth)
    bent = sense(MagnetometerConfig(grade="perfect", hard_iron_ut=5.0, soft_iron_percent=3.0), truth)
    design = np.column_stack([exact, np.full(len(exact), 1e-5)])
    fit, *_ = np.linalg.lstsq(design, bent)
    np.testing.assert_allclose(design @ fit, bent, atol=1e-15)
    assert np.abs(fit[:3] - np.eye(3)).max() > 0.01
    assert np.abs(fit[3] * 1e-5).max() > 1e-6


@pytest.mark.ci
def test_filters_are_told_how_far_iron_bends_the_field_of_a_doubted_compass():
    start = lively(2)
    exact = sense(MagnetometerConfig(grade="perfect"), start)[0]
    bent = [sense(MagnetometerConfig(grade="perfect", soft_iron_percent=5.0), start, seed)[0] for seed in range(600)]
    rig = Scenario.load("u_turn", {"sensors.magnetometer.grade": "hobby"}).rig(1)
    told = aid_of("magnetometer", rig, rig.imu("imu").errors(), rig.air(0.0))
    assert told.error_sigma == pytest.approx(np.std(bent - exact), rel=0.15)
    assert told.anomaly_sigma == pytest.approx(told.error_sigma / 2)
    assert told.error_correlation_s == 60.0


def test_current_disturbs_in_proportion():
    quiet, loud = still(2), still(2)
    quiet.current[:], loud.current[:] = 1.0, 3.0
    config = MagnetometerConfig(grade="perfect", current_ut_per_a=0.5)
    nothing = sense(MagnetometerConfig(grade="perfect"), quiet)[0]
    one, three = sense(config, quiet)[0] - nothing, sense(config, loud)[0] - nothing
    assert np.all(one != 0)
    np.testing.assert_allclose(three, 3 * one, rtol=1e-6)


@pytest.mark.ci
def test_throttle_disturbs_in_proportion():
    idle, half, full = still(2), still(2), still(2)
    half.controls[:, 3], full.controls[:, 3] = 0.5, 1.0
    stray = []
    for seed in range(400):
        at = [sense(MagnetometerConfig(grade="perfect", throttle_ut=3.0), one, seed)[0] for one in (idle, half, full)]
        np.testing.assert_allclose(at[2] - at[0], 2 * (at[1] - at[0]), rtol=1e-6)
        stray.append(at[2] - at[0])
    assert stats.kstest(np.ravel(stray) / 3e-6, "norm").pvalue > 1e-3


def test_range():
    field = sense(MagnetometerConfig(grade="perfect", range_ut=10.0), lively(1000))
    assert np.abs(field).max() == pytest.approx(10e-6, rel=1e-12)


@pytest.mark.ci
def test_noise_and_spread():
    truth = still(40_000)
    truth.lat[:], truth.lon[:] = SITE.lat, SITE.lon
    noisy = sense(MagnetometerConfig(grade="perfect", rate_hz=RATE_HZ, noise_ut=0.2), truth)
    np.testing.assert_allclose(noisy.std(axis=0), 0.2e-6, rtol=0.02)
    start = truth.rows(0, 1)
    exact = sense(MagnetometerConfig(grade="perfect"), start)
    iron = [sense(MagnetometerConfig(grade="perfect", hard_iron_ut=0.5), start, seed) - exact for seed in range(1000)]
    assert np.std(iron) == pytest.approx(0.5e-6, rel=0.05)
