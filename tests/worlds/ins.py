"""A simulated flight for the filters' tests: exact motion, and sensors that err exactly as the filter is told."""

import dataclasses
import functools
import math

import numpy as np
import pymap3d
from scipy.spatial.transform import Rotation

from nav.earth import isa_density, isa_pressure
from nav.error_model import ImuModel
from nav.samples import AirspeedSample, BarometerSample, FixType, GnssSample, ImuSamples, MagnetometerSample
from testbed.motion.table import increments
from worlds.motion import DT, RATE_HZ, manoeuvres

DEG = math.pi / 180
FIELD_N = np.array([28e-6, -2e-6, 40e-6])
WIND_N = np.array([3.0, -4.0, 0.0])

CONSUMER = ImuModel(
    gyro_noise=0.3 * DEG / 60,
    accel_noise=0.1 / 60,
    gyro_bias_sigma=40 * DEG / 3600,
    accel_bias_sigma=0.02,
    gyro_bias_walk=1e-6,
    accel_bias_walk=2e-5,
)
NOISELESS = ImuModel(gyro_noise=1e-7, accel_noise=1e-6, gyro_bias_sigma=1e-7, accel_bias_sigma=1e-5)


@dataclasses.dataclass(frozen=True)
class Flight:
    t: np.ndarray
    lat: np.ndarray
    lon: np.ndarray
    h: np.ndarray
    v_n: np.ndarray
    q_nb: np.ndarray
    dtheta: np.ndarray
    dv: np.ndarray

    @functools.cached_property
    def C_nb(self):
        return Rotation.from_quat(self.q_nb, scalar_first=True).as_matrix()


@functools.lru_cache(maxsize=4)
def flight(duration_s):
    rows = manoeuvres(duration_s, 48.0, 11.0)
    return Flight(*rows, *increments(*rows))


@functools.lru_cache(maxsize=2)
def at_rest(duration_s, heading_deg=70.0):
    n = int(duration_s * RATE_HZ) + 1
    q = Rotation.from_euler("ZYX", [heading_deg, 4.0, -3.0], degrees=True).as_quat(scalar_first=True)
    rows = (
        np.arange(n) / RATE_HZ,
        np.full(n, 48 * DEG),
        np.full(n, 11 * DEG),
        np.full(n, 400.0),
        np.zeros((n, 3)),
        np.tile(q, (n, 1)),
    )
    return Flight(*rows, *increments(*rows))


def imu(truth, model, rng):
    """Increments (without row 0) with turn-on biases, bias random walks and white noise as `model` says."""
    n = len(truth.t) - 1

    def biased(turn_on, walk, noise):
        steps = rng.normal(size=(n, 3)) * walk * math.sqrt(DT)
        bias = rng.normal(size=3) * turn_on + np.cumsum(steps, axis=0)
        return bias * DT + rng.normal(size=(n, 3)) * noise * math.sqrt(DT), bias

    gyro_error, gyro_bias = biased(model.gyro_bias_sigma, model.gyro_bias_walk, model.gyro_noise)
    accel_error, accel_bias = biased(model.accel_bias_sigma, model.accel_bias_walk, model.accel_noise)
    samples = ImuSamples(truth.t[1:], np.full(n, DT), truth.dtheta[1:] + gyro_error, truth.dv[1:] + accel_error)
    return samples, gyro_bias, accel_bias


def gnss(truth, rng, rate_hz=1.0, sigma_p=1.5, sigma_v=0.1, arm_b=(0.0, 0.0, 0.0), offset_s=0.0, latency_s=0.0):
    """White fixes at the antenna. Between rows (offset_s) truth is interpolated by its velocity and acceleration."""
    samples = []
    for t in np.arange(offset_s, truth.t[-1] - 2 * DT, 1 / rate_hz):
        k = min(max(int(t / DT), 1), len(truth.t) - 2)
        lat, lon, h, v_n, C_nb, omega_b = _between(truth, k, t - truth.t[k])
        arm_n = C_nb @ arm_b
        noise_p, noise_v = rng.normal(size=3) * sigma_p, rng.normal(size=3) * sigma_v
        place = pymap3d.ned2geodetic(*(arm_n + noise_p), lat, lon, h, deg=False)
        velocity = v_n + C_nb @ np.cross(omega_b, arm_b) + noise_v
        samples.append(
            GnssSample(t, t + latency_s, *place, velocity, np.full(3, sigma_p or 0.01), np.full(3, sigma_v or 0.02),
                       FixType.FIX_3D, 12, 0.8, 1.2)
        )  # fmt: skip
    return samples


def _between(truth, k, tau):
    a_n = (truth.v_n[k + 1] - truth.v_n[k]) / DT
    moved = tau * truth.v_n[k] + 0.5 * tau**2 * a_n
    lat, lon, h = pymap3d.ned2geodetic(*moved, truth.lat[k], truth.lon[k], truth.h[k], deg=False)
    omega_b = truth.dtheta[k + 1] / DT
    C_nb = truth.C_nb[k] @ Rotation.from_rotvec(tau * omega_b).as_matrix()
    omega_now = truth.dtheta[k] / DT if tau == 0 else omega_b
    return lat, lon, h, truth.v_n[k] + tau * a_n, C_nb, omega_now


def barometer(truth, rng, bias=0.0, sigma=0.5, rate_hz=10.0):
    """Its noise is one of pressure: ``sigma`` [m] of 12.013 Pa each, as at sea level."""
    rows = np.arange(0, len(truth.t), int(RATE_HZ / rate_hz))
    return [
        BarometerSample(truth.t[k], truth.t[k], isa_pressure(truth.h[k] + bias) - 12.013 * sigma * rng.normal())
        for k in rows
    ]


def magnetometer(truth, rng, bias=0.0, sigma=0.5e-6, rate_hz=10.0):
    rows = np.arange(0, len(truth.t), int(RATE_HZ / rate_hz))
    return [
        MagnetometerSample(truth.t[k], truth.t[k], truth.C_nb[k].T @ FIELD_N + bias + sigma * rng.normal(size=3))
        for k in rows
    ]


def airspeed(truth, rng, sigma=0.5, rate_hz=10.0):
    rows = np.arange(0, len(truth.t), int(RATE_HZ / rate_hz))
    samples = []
    for k in rows:
        along = truth.C_nb[k][:, 0] @ (truth.v_n[k] - WIND_N)
        eas = along * math.sqrt(isa_density(truth.h[k]) / 1.225) + sigma * rng.normal()
        samples.append(AirspeedSample(truth.t[k], truth.t[k], eas))
    return samples


def error(estimate, truth):
    """(9,) position NED [m], velocity [m/s], phi [rad]: estimate minus truth, in the order of `Estimate.covariance`."""
    k = round(estimate.t / DT)
    dp = pymap3d.geodetic2ned(estimate.lat, estimate.lon, estimate.h, truth.lat[k], truth.lon[k], truth.h[k], deg=False)
    turned = Rotation.from_quat(estimate.q_nb, scalar_first=True) * Rotation.from_matrix(truth.C_nb[k]).inv()
    return np.concatenate([dp, estimate.v_n - truth.v_n[k], -turned.as_rotvec()])


def feed(horizon, increments_, samples, seconds=1.0):
    """Push a whole run in blocks of `seconds`, samples as they arrive; estimates at the ends, and reports."""
    samples = sorted(samples, key=lambda s: s.t_arrival)
    estimates, reports, taken = [], [], 0
    size = max(1, round(seconds / DT))
    for start in range(0, len(increments_), size):
        rows = slice(start, start + size)
        block = ImuSamples(increments_.t[rows], increments_.dt[rows], increments_.dtheta[rows], increments_.dv[rows])
        arrived = []
        while taken < len(samples) and samples[taken].t_arrival <= block.t[-1] + 1e-9:
            arrived.append(samples[taken])
            taken += 1
        reports += horizon.push(block, arrived)
        estimates.append(horizon.estimate_at(float(block.t[-1])))
    return estimates, reports
