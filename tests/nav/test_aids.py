"""Every aid's Jacobian against differences of its own non-linear measurement, and what is not let in."""

import dataclasses
import math

import numpy as np
import pymap3d
import pytest
from scipy.spatial.transform import Rotation

from nav import aids
from nav.aids.base import aid_blocks
from nav.earth import OMEGA_IE, pressure_altitude, quat_en, quat_ie, radii
from nav.error_model import MOTION, PHI, POS, VEL, Block, ErrorModel, ImuModel, markov, sensor_errors
from nav.rotation import quat_from_rotvec, quat_multiply, quat_normalise
from nav.samples import (
    AirspeedSample,
    BarometerSample,
    BodyVelocitySample,
    FixType,
    GnssSample,
    MagnetometerSample,
    PositionSample,
    StarSample,
)

IMU = ImuModel(1e-4, 1e-3, 1e-4, 0.05, 0, 0, 1e-5, 1e-3, 300.0, 300.0, 1e-3, 1e-3)
AIDS = (
    aids.GnssAid(position_error_sigma=(1.0, 1.0, 2.0), velocity_error_sigma=(0.1, 0.1, 0.1)),
    aids.BarometerAid(error_sigma=1.0),
    aids.MagnetometerAid(anomaly_sigma=1e-7, error_sigma=1e-7),
    aids.AirspeedAid(gust_sigma=1.0, scale_sigma=0.02),
)
BODY_VELOCITY = [Block("body_velocity_scale", 2, 0.01), markov("body_velocity_error", 2, 0.1, 300.0)]
SOFT_IRON = Block("magnetometer_soft_iron", 9, 0.02)
MODEL = ErrorModel(IMU, [*aid_blocks(AIDS), *BODY_VELOCITY, SOFT_IRON])
ARM = np.array([0.7, -0.3, -1.2])
FIELD_N = np.array([28e-6, -2e-6, 40e-6])
STEPS = {"phi": 1e-5, "dv": 1e-2, "dp": 1.0, "gyro_bias": 1e-3, "gyro_drift": 1e-3, "gyro_scale": 1e-3,
         "accel_bias": 1e-2, "accel_drift": 1e-2, "accel_scale": 1e-2, "magnetometer_bias": 1e-7,
         "magnetometer_anomaly": 1e-7, "magnetometer_error": 1e-7, "magnetometer_soft_iron": 1e-3,
         "airspeed_scale": 1e-3, "wind": 1e-2, "gust": 1e-2, "barometer_error": 1.0}  # fmt: skip


def state(seed):
    rng = np.random.default_rng(seed)
    q = quat_normalise(rng.normal(size=4))
    v_n = rng.normal(size=3) * 20
    lla = np.array([rng.uniform(-1.3, 1.3), rng.uniform(-3, 3), rng.uniform(0, 3000)])
    x = rng.normal(size=MODEL.size) * np.where(MODEL.sigma > 0, MODEL.sigma, 0)
    return q, v_n, lla, x, rng.normal(size=3)


def displaced(at, delta):
    """The state with the error `delta` (n,); the measured angular rate stays, so its estimate turns with the gyro's."""
    q, v_n, lla, x, measured = at
    R_M, R_N = radii(lla[0])
    dp = delta[POS : POS + 3]
    off = np.array([dp[0] / (R_M + lla[2]), dp[1] / ((R_N + lla[2]) * math.cos(lla[0])), -dp[2]])
    values = x.copy()
    values[MOTION:] += delta[MOTION:]
    turned = quat_normalise(quat_multiply(quat_from_rotvec(-delta[PHI : PHI + 3]), q))
    return turned, v_n + delta[VEL : VEL + 3], lla + off, values, measured


def gnss_position(at):
    """The fix a few metres away, where the arcs are straight."""
    q, _, lla, x, _ = at
    return aids.gnss.gnss_position(q, lla, x, ARM, MODEL.start("gnss_position_error"), FIX["lat"], FIX["lon"], FIX["h"])


def gnss_velocity(at):
    q, v_n, lla, x, measured = at
    errors = np.zeros((4, 3))
    sensor_errors(errors, x, MODEL.driven)
    start = MODEL.start("gnss_velocity_error")
    return aids.gnss.gnss_velocity(
        q, v_n, lla, x, measured, errors, MODEL.driven, ARM, start, np.array([1.0, 2.0, 3.0])
    )


def barometer(at):
    return aids.barometer.barometer(
        at[2], at[3], MODEL.start("barometer_bias"), MODEL.start("barometer_error"), pressure_altitude(95_000.0)
    )


def magnetometer(at):
    states = [MODEL.start(f"magnetometer_{name}") for name in ("bias", "error", "anomaly", "soft_iron")]
    return aids.magnetometer.magnetometer(at[0], at[3], *states, FIELD_N, np.array([1e-5, 2e-5, 3e-5]))


def airspeed(at):
    q, v_n, lla, x, _ = at
    return aids.airspeed.airspeed(
        q, v_n, lla, x, MODEL.start("wind"), MODEL.start("gust"), MODEL.start("airspeed_scale"), 24.0
    )


def sideslip(at):
    return aids.airspeed.sideslip(at[0], at[1], at[3], MODEL.start("wind"), MODEL.start("gust"))


def body_velocity(at, arm=ARM):
    starts = [MODEL.start(f"body_velocity_{name}") for name in ("scale", "error")]
    return moving_point(at, arm, np.array([0, 2]), *starts, np.array([20.0, np.nan, 1.0]))


def odometer(at, arm=ARM):
    return moving_point(at, arm, np.array([0]), -1, -1, np.array([5.0, np.nan, np.nan]))


def moving_point(at, arm, *measured):
    q, v_n, lla, x, omega = at
    errors = np.zeros((4, 3))
    sensor_errors(errors, x, MODEL.driven)
    return aids.body_velocity.body_velocity(q, v_n, lla, x, omega, errors, MODEL.driven, arm, *measured)


def nonholonomic(at, arm=ARM):
    q, v_n, lla, x, omega = at
    errors = np.zeros((4, 3))
    sensor_errors(errors, x, MODEL.driven)
    return aids.body_velocity.nonholonomic(q, v_n, lla, x, omega, errors, MODEL.driven, arm)


def at_the_imu(aid):
    """The same without a lever arm."""

    def look(at):
        return aid(at, np.zeros(3))

    return look


def star_attitude(at):
    return aids.star_tracker.star_attitude(at[0], at[2], at[3], STAR_TIME, FIX["q_ib"])


def position_fix(at, arm=ARM):
    return aids.position_fix.position_fix(at[0], at[2], at[3], arm, FIX["lat"], FIX["lon"], FIX["h"])


def flat_position_fix(at, arm=ARM):
    return aids.position_fix.position_fix(at[0], at[2], at[3], arm, FIX["lat"], FIX["lon"], math.nan)


def gnss_course(at):
    """Course from heading and drift, near the prediction."""
    q, v_n, _, x, _ = at
    return aids.gnss.gnss_course(q, v_n, x, MODEL.start("wind"), MODEL.start("gust"), FIX["course_v_n"])


def gnss_course_as_heading(at):
    return aids.gnss.gnss_course(at[0], at[1], at[3], -1, -1, FIX["course_v_n"])


FIX = {}
STAR_TIME = 3000.0
AIDS = [
    gnss_position, gnss_velocity, barometer, magnetometer, airspeed, body_velocity, odometer, nonholonomic,
    *map(at_the_imu, (body_velocity, odometer, nonholonomic, position_fix)),
    star_attitude, position_fix, flat_position_fix, gnss_course, gnss_course_as_heading,
]  # fmt: skip


@pytest.mark.parametrize("aid", AIDS)
@pytest.mark.parametrize("seed", range(5))
def test_jacobian(aid, seed):
    check_jacobian(aid, state(seed))


@pytest.mark.parametrize("seed", range(5))
def test_sideslip_has_the_jacobian_of_its_angle(seed):
    """At the airspeed that there is, where the angle is not small; its value is the velocity from the side."""
    at = state(seed)
    speed = np.linalg.norm(air_b(at))
    nu, H = sideslip(at)
    assert nu[0] == pytest.approx(-air_b(at)[1])
    assert abs(nu[0]) > 0.05 * speed

    def angle(there):
        air = air_b(there)
        return np.array([-speed * air[1] / np.linalg.norm(air)]), H

    check_jacobian(angle, at)


def air_b(at):
    """Velocity through the air in body axes, by scipy."""
    q, v_n, _, x, _ = at
    wind = np.append(x[MODEL.slices["wind"]] + x[MODEL.slices["gust"]], 0.0)
    return scipy_rotation(q).inv().apply(v_n - wind)


def check_jacobian(aid, at):
    """Against differences, in every state."""
    FIX.update(lat=at[2][0] + 1e-6, lon=at[2][1] - 1e-6, h=at[2][2] + 3, course_v_n=np.array([15.0, 2.0, 0.0]))
    q_in = quat_multiply(quat_ie(STAR_TIME), quat_en(at[2][0], at[2][1]))
    FIX["q_ib"] = quat_multiply(q_in, quat_multiply(at[0], quat_from_rotvec(np.array([1e-6, -2e-6, 3e-6]))))
    nu, H = aid(at)
    scale = max(1e-12, np.abs(H[:, :MOTION]).max())
    for block in MODEL.blocks:
        step = STEPS.get(block.name, 0.1)
        where = MODEL.slices[block.name]
        expected = np.empty((len(nu), block.size))
        for k in range(block.size):
            delta = np.zeros(MODEL.size)
            delta[where.start + k] = step
            high, low = aid(displaced(at, delta))[0], aid(displaced(at, -delta))[0]
            expected[:, k] = (low - high) / (2 * step)
        size = max(np.abs(expected).max(), 1e-6 * scale)
        np.testing.assert_allclose(H[:, where], expected, atol=2e-5 * size, rtol=0, err_msg=block.name)


def test_density_is_in_the_airspeed_jacobian():
    """Height by a hundred metres changes equivalent airspeed by half a percent; it must not be lost in tolerances."""
    at = state(3)
    _, H = airspeed(at)
    delta = np.zeros(MODEL.size)
    delta[POS + 2] = 1.0
    expected = (airspeed(displaced(at, -delta))[0] - airspeed(displaced(at, delta))[0]) / 2
    assert H[0, POS + 2] == pytest.approx(expected[0], rel=1e-3)
    assert abs(H[0, POS + 2]) > 1e-5


def scipy_rotation(q):
    return Rotation.from_quat(q, scalar_first=True)


@pytest.mark.parametrize("seed", range(3))
def test_body_velocity_is_what_scipy_says(seed):
    at = q, v_n, lla, x, omega = state(seed)
    gyro, errors = MODEL.slices, np.zeros((4, 3))
    for name in ("gyro_bias", "gyro_drift"):
        errors[0] += x[gyro[name]]
    omega_b = (omega - errors[0]) / (1 + x[gyro["gyro_scale"]])
    earth_b = scipy_rotation(q).inv().apply(OMEGA_IE * np.array([np.cos(lla[0]), 0, -np.sin(lla[0])]))
    scale, error = (x[MODEL.slices[f"body_velocity_{name}"]] for name in ("scale", "error"))
    for arm in (np.zeros(3), ARM):
        v_b = scipy_rotation(q).inv().apply(v_n) + np.cross(omega_b - earth_b, arm)
        measured = (1 + scale) * v_b[[0, 2]] + error
        np.testing.assert_allclose(body_velocity(at, arm)[0], [20.0, 1.0] - measured, atol=1e-12)
        assert odometer(at, arm)[0] == pytest.approx([5.0 - v_b[0]], abs=1e-12)
        np.testing.assert_allclose(nonholonomic(at, arm)[0], -v_b[1:], atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_position_fix_is_of_the_sensor_not_of_the_imu(seed):
    """At the sensor's place, found by pymap3d, nothing is left to correct."""
    q, _, lla, x, _ = state(seed)
    north, east, down = scipy_rotation(q).apply(ARM)
    lat, lon, h = pymap3d.enu2geodetic(east, north, -down, *np.degrees(lla[:2]), lla[2])
    nu, _ = aids.position_fix.position_fix(q, lla, x, ARM, np.radians(lat), np.radians(lon), h)
    np.testing.assert_allclose(nu, 0.0, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_star_attitude_tells_tilt_and_place(seed):
    """The truth by scipy and pymap3d; then wrong attitude and position, and what must be seen of them."""
    q, v_n, lla, x, _ = state(seed)
    at = pymap3d.geodetic2ecef(*lla, deg=False)
    axes = [np.subtract(pymap3d.ned2ecef(*100 * axis, *lla, deg=False), at) / 100 for axis in np.eye(3)]
    C_en = Rotation.from_matrix(np.array(axes).T)
    C_ib = Rotation.from_rotvec([0, 0, OMEGA_IE * STAR_TIME]) * C_en * scipy_rotation(q)
    FIX["q_ib"] = C_ib.as_quat(scalar_first=True)
    np.testing.assert_allclose(star_attitude((q, v_n, lla, x, None))[0], 0.0, atol=1e-9)
    rng = np.random.default_rng(seed)
    delta = np.zeros(MODEL.size)
    delta[PHI : PHI + 3], delta[POS : POS + 3] = 1e-4 * rng.normal(size=3), 300 * rng.normal(size=3)
    nu, H = star_attitude(displaced((q, v_n, lla, x, None), delta))
    phi = delta[PHI : PHI + 3]
    R_M, R_N = radii(lla[0])
    dlat, dlon = delta[POS] / (R_M + lla[2]), delta[POS + 1] / ((R_N + lla[2]) * np.cos(lla[0]))
    # Cui 2022's dP in east-north-up is (-dL, dlon cos L, dlon sin L)
    turned = np.array([dlon * np.cos(lla[0]), -dlat, -dlon * np.sin(lla[0])])
    expected = scipy_rotation(q).inv().apply(phi - turned)
    np.testing.assert_allclose(nu, expected, atol=2e-7)
    np.testing.assert_allclose(nu, -H @ delta, atol=2e-7)


def test_course_is_heading_and_drift():
    """North-east by the nose at 20 m/s, wind from the west at 5: course by the wind triangle; and the sign of phi."""
    heading, pitch, air = math.radians(45), math.radians(5), 20.0
    q = Rotation.from_euler("ZYX", [heading, pitch, 0.1]).as_quat(scalar_first=True)
    wind = MODEL.start("wind")
    x = np.zeros(MODEL.size)
    x[wind + 1] = 5.0
    v_n = np.array([air * math.cos(heading), air * math.sin(heading) + 5, 0.0])
    course = math.atan2(v_n[1], v_n[0])
    assert math.degrees(course - heading) == pytest.approx(8.5, abs=0.1)
    nu, _ = aids.gnss.gnss_course(q, v_n, x, wind, -1, v_n)
    assert nu[0] == pytest.approx(0, abs=1e-12)
    nu, H = aids.gnss.gnss_course(q, v_n, x, -1, -1, v_n)
    assert nu[0] == pytest.approx(course - heading, abs=1e-12)  # the drift, taken for an error of heading
    assert H[0, PHI + 2] == -1.0
    assert not H[0, VEL : VEL + 3].any()
    backwards = aids.gnss.gnss_course(q, v_n, x, -1, -1, np.array([-1.0, -0.9, 0.0]))[0][0]
    assert -math.pi < backwards <= math.pi
    assert backwards == pytest.approx(math.atan2(-0.9, -1.0) - heading + 2 * math.pi, abs=1e-12)


def test_course_of_what_does_not_move_is_of_no_direction():
    """No velocity and no wind: a number, and nothing that either of them would change."""
    nu, H = aids.gnss.gnss_course(
        np.array([1.0, 0, 0, 0]), np.zeros(3), np.zeros(MODEL.size), MODEL.start("wind"), -1, np.array([3.0, 3.0, 0.0])
    )
    assert nu[0] == pytest.approx(math.radians(45))
    assert np.flatnonzero(H).tolist() == [PHI + 2]


def test_axes_that_a_sample_has():
    sample = BodyVelocitySample(1.0, 1.0, np.array([3.0, NAN, 0.0]))
    assert aids.body_velocity.measures(sample, np.array([0, 2]))
    assert not aids.body_velocity.measures(sample, np.array([0, 1]))


GOOD = GnssSample(1.0, 1.0, 0.8, 0.2, 500.0, np.array([20.0, 1.0, 0.0]), np.ones(3), np.full(3, 0.1),
                  FixType.FIX_3D, 10, 0.9, 1.3)  # fmt: skip
NAN = math.nan


@pytest.mark.parametrize(
    ("sample", "reason"),
    [
        (GOOD, ""),
        (dataclasses.replace(GOOD, v_n=np.full(3, NAN)), ""),
        (dataclasses.replace(GOOD, v_n=np.array([1.0, NAN, 0.0])), "velocity is not finite"),
        (dataclasses.replace(GOOD, lat=NAN), "position is not finite"),
        (dataclasses.replace(GOOD, h=math.inf), "position is not finite"),
        (dataclasses.replace(GOOD, lat=1.6), "position is out of range"),
        (dataclasses.replace(GOOD, h=-2e4), "height -20000 is out of range"),
        (dataclasses.replace(GOOD, v_n=np.array([1e9, 0.0, 0.0])), "speed 1e+09 is out of range"),
        (dataclasses.replace(GOOD, sigma_position_n=np.array([1.0, 0.0, 1.0])), "accuracy of position"),
        (dataclasses.replace(GOOD, sigma_velocity_n=np.array([1.0, NAN, 1.0])), "accuracy of velocity"),
        (dataclasses.replace(GOOD, t=NAN), "time is not finite"),
        (BarometerSample(1.0, 1.0, 95_000.0), ""),
        (BarometerSample(1.0, 1.0, NAN), "pressure is not finite"),
        (BarometerSample(1.0, 1.0, 0.0), "pressure 0 is out of range"),
        (MagnetometerSample(1.0, 1.0, np.array([3e-5, 0.0, 3e-5])), ""),
        (MagnetometerSample(1.0, 1.0, np.array([NAN, 0.0, 0.0])), "field is not finite"),
        (MagnetometerSample(1.0, 1.0, np.zeros(3)), "field 0 is out of range"),
        (AirspeedSample(1.0, 1.0, 25.0), ""),
        (AirspeedSample(1.0, 1.0, -math.inf), "airspeed is not finite"),
        (AirspeedSample(1.0, 1.0, 900.0), "airspeed 900 is out of range"),
        (BodyVelocitySample(1.0, 1.0, np.array([20.0, 1.0, 0.5])), ""),
        (BodyVelocitySample(1.0, 1.0, np.array([20.0, NAN, NAN])), ""),
        (BodyVelocitySample(1.0, 1.0, np.full(3, NAN)), "velocity is not finite"),
        (BodyVelocitySample(1.0, 1.0, np.array([NAN, math.inf, 0.0])), "speed is not finite"),
        (BodyVelocitySample(1.0, 1.0, np.array([-700.0, NAN, NAN])), "speed 700 is out of range"),
        (StarSample(1.0, 1.0, np.array([0.6, 0.0, -0.8, 0.0])), ""),
        (StarSample(1.0, 1.0, np.array([0.6, 0.0, NAN, 0.0])), "norm of the quaternion is not finite"),
        (StarSample(1.0, 1.0, np.zeros(4)), "norm of the quaternion 0 is out of range"),
        (StarSample(NAN, 1.0, np.array([1.0, 0.0, 0.0, 0.0])), "time is not finite"),
        (PositionSample(1.0, 1.0, 0.8, 0.2, 500.0), ""),
        (PositionSample(1.0, 1.0, 0.8, 0.2, NAN), ""),
        (PositionSample(1.0, 1.0, 0.8, NAN, NAN), "position is not finite"),
        (PositionSample(1.0, 1.0, 0.8, 0.2, math.inf), "position is not finite"),
        (PositionSample(1.0, 1.0, 0.8, 7.0, NAN), "position is out of range"),
        (PositionSample(1.0, 1.0, 0.8, 0.2, 9e4), "height 90000 is out of range"),
    ],
)
def test_broken_samples_are_named(sample, reason):
    found = aids.problem(sample)
    assert (reason in found) if reason else found == ""
