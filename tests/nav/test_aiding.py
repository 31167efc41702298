"""Every aid's Jacobian against differences of its own non-linear measurement, and what is not let in."""

import dataclasses
import math

import numpy as np
import pytest

from nav import aiding
from nav.earth import pressure_altitude, radii
from nav.error_model import MOTION, PHI, POS, VEL, ErrorModel, ImuModel, sensor_errors
from nav.ins import InsConfig
from nav.rotation import quat_from_rotvec, quat_multiply, quat_normalise
from nav.samples import AirspeedSample, BarometerSample, FixType, GnssSample, MagnetometerSample

IMU = ImuModel(1e-4, 1e-3, 1e-4, 0.05, 0, 0, 1e-5, 1e-3, 300.0, 300.0, 1e-3, 1e-3)
CONFIG = InsConfig(
    IMU,
    gnss_position_error_sigma=(1.0, 1.0, 2.0),
    gnss_velocity_error_sigma=(0.1, 0.1, 0.1),
    gust_sigma=1.0,
    airspeed_scale_sigma=0.02,
    magnetometer_anomaly_sigma=1e-7,
    magnetometer_error_sigma=1e-7,
)
MODEL = ErrorModel(IMU, CONFIG.aid_blocks())
ARM = np.array([0.7, -0.3, -1.2])
FIELD_N = np.array([28e-6, -2e-6, 40e-6])
STEPS = {"phi": 1e-5, "dv": 1e-2, "dp": 1.0, "gyro_bias": 1e-3, "gyro_drift": 1e-3, "gyro_scale": 1e-3,
         "accel_bias": 1e-2, "accel_drift": 1e-2, "accel_scale": 1e-2, "magnetometer_bias": 1e-7,
         "magnetometer_anomaly": 1e-7, "magnetometer_error": 1e-7,
         "airspeed_scale": 1e-3}  # fmt: skip


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
    return aiding.gnss_position(q, lla, x, ARM, MODEL.start("gnss_position_error"), FIX["lat"], FIX["lon"], FIX["h"])


def gnss_velocity(at):
    q, v_n, lla, x, measured = at
    errors = np.zeros((4, 3))
    sensor_errors(errors, x, MODEL.driven)
    start = MODEL.start("gnss_velocity_error")
    return aiding.gnss_velocity(q, v_n, lla, x, measured, errors, MODEL.driven, ARM, start, np.array([1.0, 2.0, 3.0]))


def barometer(at):
    return aiding.barometer(at[2], at[3], MODEL.start("barometer_bias"), pressure_altitude(95_000.0))


def magnetometer(at):
    states = [MODEL.start(f"magnetometer_{name}") for name in ("bias", "error", "anomaly")]
    return aiding.magnetometer(at[0], at[3], *states, FIELD_N, np.array([1e-5, 2e-5, 3e-5]))


def airspeed(at):
    q, v_n, lla, x, _ = at
    return aiding.airspeed(
        q, v_n, lla, x, MODEL.start("wind"), MODEL.start("gust"), MODEL.start("airspeed_scale"), 24.0
    )


def sideslip(at):
    return aiding.sideslip(at[0], at[1], at[3], MODEL.start("wind"), MODEL.start("gust"))


FIX = {}


@pytest.mark.parametrize("aid", [gnss_position, gnss_velocity, barometer, magnetometer, airspeed, sideslip])
@pytest.mark.parametrize("seed", range(5))
def test_jacobian(aid, seed):
    at = state(seed)
    FIX.update(lat=at[2][0] + 1e-6, lon=at[2][1] - 1e-6, h=at[2][2] + 3)
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
    ],
)
def test_broken_samples_are_named(sample, reason):
    found = aiding.problem(sample)
    assert (reason in found) if reason else found == ""
