"""The strapdown against motion written down as formulas, and against the textbook errors of coning and sculling."""

import math

import numpy as np
import pymap3d
import pymap3d.rcurve
import pytest
from scipy.spatial.transform import Rotation
from worlds.motion import DT, RADIUS, RATE_HZ, manoeuvres, quaternions

from nav import earth, rotation, strapdown
from nav.samples import ImuSamples
from testbed.motion.table import increments

PLACES = {
    "mid north": (34.0, 108.0),
    "south": (-33.0, 151.0),
    "equator": (0.0, 20.0),
    "date line": (52.0, 179.999),
    "high north": (84.0, -40.0),
    "high south": (-84.0, 10.0),
}


def navigate(rows, dtheta, dv):
    """Dead reckoning from the first row; largest horizontal, vertical [m] and attitude [rad] errors at full seconds."""
    t, lat, lon, h, v_n, q_nb = rows
    q, v, lla = q_nb[0].copy(), v_n[0].copy(), np.array([lat[0], lon[0], h[0]])
    worst = np.zeros(3)
    for k in range(0, len(t) - 1, RATE_HZ):
        second = slice(k + 1, k + 1 + RATE_HZ)
        strapdown.propagate(q, v, lla, dtheta[second], dv[second], np.full(RATE_HZ, DT))
        row = k + RATE_HZ
        n, e, d = pymap3d.geodetic2ned(*lla, lat[row], lon[row], h[row], deg=False)
        turned = Rotation.from_quat(q, scalar_first=True) * Rotation.from_quat(q_nb[row], scalar_first=True).inv()
        assert -math.pi < lla[1] <= math.pi
        worst = np.maximum(worst, [math.hypot(n, e), abs(d), turned.magnitude()])
    return worst


def final_errors(rows, imu):
    """Error of attitude (3,) [rad], in n, and velocity (3,) [m/s] after dead reckoning through all of ``imu``."""
    _, lat, lon, h, v_n, q_nb = rows
    q, v, lla = q_nb[0].copy(), v_n[0].copy(), np.array([lat[0], lon[0], h[0]])
    strapdown.propagate(q, v, lla, imu.dtheta, imu.dv, imu.dt)
    turned = Rotation.from_quat(q, scalar_first=True) * Rotation.from_quat(q_nb[-1], scalar_first=True).inv()
    return turned.as_rotvec(), v - v_n[-1]


def imu_at(stride, dtheta, dv):
    """Samples of an IMU ``stride`` times slower than the rows: sums of their increments."""
    dtheta, dv = (x[1:].reshape(-1, stride, 3).sum(axis=1) for x in (dtheta, dv))
    dt = np.full(len(dtheta), stride * DT)
    return ImuSamples(np.cumsum(dt), dt, dtheta, dv)


@pytest.mark.ci
@pytest.mark.parametrize("place", PLACES)
def test_ten_minutes_of_manoeuvres(place):
    rows = manoeuvres(600, *PLACES[place])
    horizontal, vertical, attitude = navigate(rows, *increments(*rows))
    print(f"{place}: 10 min: {horizontal:.2e} m horizontal, {vertical:.2e} m vertical, {attitude:.2e} rad")
    assert horizontal < 0.1
    assert attitude < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("place", PLACES)
def test_an_hour_of_manoeuvres(place):
    rows = manoeuvres(3600, *PLACES[place])
    horizontal, vertical, attitude = navigate(rows, *increments(*rows))
    print(f"{place}: 1 h: {horizontal:.2e} m horizontal, {vertical:.2e} m vertical, {attitude:.2e} rad")
    assert horizontal < 1.0
    assert attitude < 1e-5


def test_second_order_at_a_slow_rate_and_a_high_speed():
    """Ten minutes of straight climb from 84 deg at 200 m/s and 25 Hz: latitude, height, velocity of mid-interval count.

    Taken at its start, latitude puts the end 0.4 m off in longitude, and height puts it 0.1 m off in height.
    """
    t = np.arange(600 * 25 + 1) / 25
    lat, lon, h = math.radians(84) + 140 / RADIUS * t, 0.3 + 1400 / RADIUS * t, 1000 + 10 * t
    v_north = 140 / RADIUS * (pymap3d.rcurve.meridian(np.degrees(lat)) + h)
    v_east = 1400 / RADIUS * np.cos(lat) * (pymap3d.rcurve.transverse(np.degrees(lat)) + h)
    one = np.ones(len(t))
    rows = (t, lat, lon, h, np.column_stack([v_north, v_east, -10 * one]), quaternions(0 * t, 0.05 * one, 0.8 * one))
    dtheta, dv = increments(*rows)
    q, v, lla = rows[5][0].copy(), rows[4][0].copy(), np.array([lat[0], lon[0], h[0]])
    strapdown.propagate(q, v, lla, dtheta[1:], dv[1:], np.diff(t))
    n, e, d = pymap3d.geodetic2ned(*lla, lat[-1], lon[-1], h[-1], deg=False)
    print(f"200 m/s at 84 deg, 25 Hz: {math.hypot(n, e):.1e} m horizontal, {abs(d):.1e} m vertical after 10 min")
    assert math.hypot(n, e) < 0.01
    assert abs(d) < 0.001


# Coning and sculling. With x the phase per interval, an algorithm that takes the sum of rate for a rotation vector
# errs by the share 1 - sinc(x) of the whole effect (Savage part 1; Groves section 5.6.1). The increments between
# truth rows are rotation vectors, so a sum of several of them lacks sinc(x_row) - sinc(x_imu).
VIBRATION = 2 * math.pi * 10  # [rad/s]
LAT, LON, H = 0.6, 1.0, 500.0


def sinc(x):
    return math.sin(x) / x


def lack(stride):
    return sinc(VIBRATION * DT) - sinc(VIBRATION * DT * stride)


def two_sample_share(stride):
    """What the product of this and the previous sine or cosine increment adds, in the units of `lack`."""
    x = VIBRATION * DT * stride
    return (1 - math.cos(x)) * math.sin(x) / (3 * x)


def coning(duration_s, half_angle):
    """A body at rest whose z axis describes a cone about the vertical."""
    t = np.arange(int(duration_s * RATE_HZ) + 1) / RATE_HZ
    one = np.ones(len(t))
    axis = np.column_stack([np.cos(VIBRATION * t), np.sin(VIBRATION * t), 0 * t])
    q_nb = Rotation.from_rotvec(half_angle * axis).as_quat(scalar_first=True)
    return t, LAT * one, LON * one, H * one, np.zeros((len(t), 3)), q_nb


def sculling(duration_s, roll_amplitude, east_acceleration):
    """Roll and eastward acceleration swing in phase."""
    t = np.arange(int(duration_s * RATE_HZ) + 1) / RATE_HZ
    one = np.ones(len(t))
    east_radius = (pymap3d.rcurve.transverse(math.degrees(LAT)) + H) * math.cos(LAT)
    lon = LON - east_acceleration / VIBRATION**2 * np.sin(VIBRATION * t) / east_radius
    v_east = -east_acceleration / VIBRATION * np.cos(VIBRATION * t)
    q_nb = quaternions(roll_amplitude * np.sin(VIBRATION * t), 0 * t, 0 * t)
    return t, LAT * one, lon, H * one, np.column_stack([0 * t, v_east, 0 * t]), q_nb


@pytest.mark.parametrize("stride", [2, 4])
def test_coning_error_of_a_slower_imu_and_what_two_samples_recover(stride):
    duration, half_angle = 20.0, math.radians(1.0)
    rows = coning(duration, half_angle)
    increment = increments(*rows)
    whole = 0.5 * half_angle**2 * VIBRATION * duration

    exact, _ = final_errors(rows, imu_at(1, *increment))
    raw, _ = final_errors(rows, imu_at(stride, *increment))
    compensated, _ = final_errors(rows, strapdown.compensate(imu_at(stride, *increment)))
    print(f"coning, 1/{stride} rate: {raw[2]:.3e} rad raw, {compensated[2]:.3e} rad compensated, of {whole:.3e}")
    assert abs(exact[2]) < 1e-9
    assert raw[2] == pytest.approx(-whole * lack(stride), rel=0.02)
    residual = lack(stride) - two_sample_share(stride)
    assert compensated[2] == pytest.approx(-whole * residual, rel=0.02)
    assert abs(compensated[2]) < abs(raw[2]) / 2.5


@pytest.mark.parametrize("stride", [2, 4])
def test_sculling_error_of_a_slower_imu_and_what_two_samples_recover(stride):
    duration, roll, acceleration = 20.0, math.radians(1.0), 5.0
    rows = sculling(duration, roll, acceleration)
    increment = increments(*rows)
    whole = 0.5 * roll * (acceleration - earth.gravity(LAT, H) * roll) * duration  # roll also tilts gravity into body y

    _, exact = final_errors(rows, imu_at(1, *increment))
    _, raw = final_errors(rows, imu_at(stride, *increment))
    _, compensated = final_errors(rows, strapdown.compensate(imu_at(stride, *increment)))
    print(f"sculling, 1/{stride} rate: {raw[2]:.3e} m/s raw, {compensated[2]:.3e} m/s compensated, of {whole:.3e}")
    assert abs(exact[2]) < 1e-6
    assert raw[2] == pytest.approx(-whole * lack(stride), rel=0.03)
    residual = lack(stride) - two_sample_share(stride)
    assert compensated[2] == pytest.approx(-whole * residual, rel=0.03)
    assert abs(compensated[2]) < abs(raw[2]) / 2.5


@pytest.mark.parametrize("frequency_hz", [1.0, 5.0, 10.0, 25.0])
def test_classic_coning_drift(frequency_hz):
    """Integrals of rate of the textbook cone, on no planet: drift without and with compensation."""
    half_angle, cone_rate, duration = math.radians(0.5), 2 * math.pi * frequency_hz, 2.0
    x = cone_rate * DT
    t = np.arange(round(duration * RATE_HZ) + 1) * DT
    angle = np.column_stack([np.cos(cone_rate * t), np.sin(cone_rate * t), 0 * t]) * math.sin(half_angle)
    angle[:, 2] = -(1 - math.cos(half_angle)) * cone_rate * t
    imu = ImuSamples(t[1:], np.full(len(t) - 1, DT), np.diff(angle, axis=0), np.zeros((len(t) - 1, 3)))

    def drift(dtheta):
        turn = rotation.quat_from_rotvec(np.array([half_angle, 0.0, 0.0]))
        for increment in dtheta:
            turn = rotation.quat_multiply(turn, rotation.quat_from_rotvec(increment))
        return (Rotation.from_quat(turn, scalar_first=True) * Rotation.from_rotvec([-half_angle, 0, 0])).as_rotvec()[2]

    whole = 0.5 * half_angle**2 * cone_rate * duration
    before = ImuSamples(imu.t[-1:], imu.dt[-1:], imu.dtheta[-1:], imu.dv[-1:])  # the cone is periodic
    share = (1 - math.cos(x)) * math.sin(x) / (3 * x)
    assert drift(imu.dtheta) == pytest.approx(-whole * (1 - sinc(x)), rel=0.01)
    assert drift(strapdown.compensate(imu, before).dtheta) == pytest.approx(-whole * (1 - sinc(x) - share), rel=0.01)


def some_imu(n):
    generator = np.random.default_rng(5)
    dt = np.full(n, DT)
    return ImuSamples(np.cumsum(dt), dt, 0.01 * generator.normal(size=(n, 3)), 0.05 * generator.normal(size=(n, 3)))


def part(imu, start, stop):
    return ImuSamples(imu.t[start:stop], imu.dt[start:stop], imu.dtheta[start:stop], imu.dv[start:stop])


def test_compensation_does_not_see_where_blocks_end():
    imu = some_imu(100)
    whole = strapdown.compensate(imu)
    previous, dtheta, dv = None, [], []
    for start, stop in [(0, 1), (1, 1), (1, 40), (40, 41), (41, 100)]:
        block = part(imu, start, stop)
        compensated = strapdown.compensate(block, previous)
        assert len(compensated) == stop - start
        dtheta.append(compensated.dtheta)
        dv.append(compensated.dv)
        previous = block if stop > start else previous
    assert np.array_equal(np.vstack(dtheta), whole.dtheta)
    assert np.array_equal(np.vstack(dv), whole.dv)
    assert np.array_equal(whole.dtheta[0], imu.dtheta[0])
    assert not np.array_equal(whole.dtheta[1:], imu.dtheta[1:])


def start():
    return rotation.quat_from_euler(0.1, 0.2, 0.3), np.array([20.0, 10.0, -1.0]), np.array([0.6, 1.0, 500.0])


def test_propagate_is_step_after_step():
    imu = some_imu(50)
    one, many = start(), start()
    for k in range(50):
        strapdown.step(*one, imu.dtheta[k], imu.dv[k], imu.dt[k])
    strapdown.propagate(*many, imu.dtheta, imu.dv, imu.dt)
    for a, b in zip(one, many, strict=True):
        assert np.array_equal(a, b)
    assert np.linalg.norm(many[0]) == pytest.approx(1.0, abs=1e-15)


def test_the_quaternion_is_pulled_back_to_unit_norm():
    q, v, lla = start()
    q *= 1 + 1e-6
    strapdown.step(q, v, lla, np.zeros(3), np.zeros(3), DT)
    assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-11)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.8])
def test_an_interval_splits_linearly_in_time(share):
    dtheta, dv = np.array([0.01, -0.02, 0.03]), np.array([0.05, 0.02, -0.06])
    whole, parts = start(), start()
    strapdown.step(*whole, dtheta, dv, DT)
    strapdown.step(*parts, share * dtheta, share * dv, share * DT)
    strapdown.step(*parts, (1 - share) * dtheta, (1 - share) * dv, (1 - share) * DT)
    assert parts[0] == pytest.approx(whole[0], abs=1e-13)
    assert parts[1] == pytest.approx(whole[1], abs=1e-9)
    difference = earth.position_difference_n(*parts[2], *whole[2])
    assert np.abs(difference).max() < 1e-4  # the trapezoid of velocity takes the acceleration for constant


def test_fast_turn_is_exact():
    """One interval of a large turn with constant specific force, against small steps of the same."""
    dtheta, dv = np.array([0.3, -0.8, 0.5]), np.array([0.5, 0.2, -0.6])
    coarse, fine = start(), start()
    strapdown.step(*coarse, dtheta, dv, 0.05)
    n = 1000
    strapdown.propagate(*fine, np.tile(dtheta / n, (n, 1)), np.tile(dv / n, (n, 1)), np.full(n, 0.05 / n))
    assert coarse[0] == pytest.approx(fine[0], abs=1e-10)
    assert coarse[1] == pytest.approx(fine[1], abs=1e-6)
