"""One hour of MEMS increments and 1 Hz GNSS positions, on which two independent codes agree how well one can do.

Start 50 N 30 E 500 m, velocity NED 25/15/0 m/s plus sines of 8/8/0.5 m/s and 60 s (the second a quarter ahead), level
wings, nose along the velocity. 100 Hz increments with biases of some 50 deg/h and 0.05 m/s^2 that walk, 0.3 deg/sqrt(h)
and 0.05 m/s/sqrt(h); positions with 1 m of white noise, no velocity. pyins and a second, independent filter reach the
figures of `ORACLE` in the last half hour; this is the same hour with noise of our own.
"""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nav.aids import GnssAid
from nav.alignment import InitialState
from nav.earth import position_difference_n, radii
from nav.error_model import ImuModel
from nav.ins import Ins, InsConfig
from nav.samples import FixType, GnssSample, ImuSamples
from testbed.motion.table import increments

DEG = math.pi / 180
DT, SECONDS = 0.01, 3600
MODEL = ImuModel(
    gyro_noise=0.3 * DEG / 60,
    accel_noise=0.05 / 60,
    gyro_bias_sigma=50 * DEG / 3600,
    accel_bias_sigma=0.05,
    gyro_bias_walk=1e-6,
    accel_bias_walk=1e-5,
)
ORACLE = np.array([0.43, 0.44, 0.28, 0.028, 0.028, 0.145])  # RMS N, E, D [m]; roll, pitch, heading [deg]
SEEDS = range(6)


@pytest.fixture(scope="module")
def hour():
    """Truth rows (t, lat, lon, h, v_n, rotation) and exact increments; position is the trapezoid of velocity."""
    t = np.arange(SECONDS * 100 + 1) * DT
    phase = 2 * math.pi * t[:, None] / 60 + np.array([0.0, math.pi / 2, 0.0])
    v_n = np.array([25.0, 15.0, 0.0]) + np.array([8.0, 8.0, 0.5]) * np.sin(phase)
    mean = 0.5 * (v_n[1:] + v_n[:-1]) * DT
    h = 500 - np.concatenate([[0.0], np.cumsum(mean[:, 2])])
    lat, lon = np.full(len(t), 50 * DEG), np.full(len(t), 30 * DEG)
    for _ in range(4):  # the radii depend on where one is
        R_M, R_N = radii(lat)
        north = mean[:, 0] / (0.5 * (R_M[1:] + R_M[:-1]) + 0.5 * (h[1:] + h[:-1]))
        lat = 50 * DEG + np.concatenate([[0.0], np.cumsum(north)])
        middle = 0.5 * (lat[1:] + lat[:-1])
        east = mean[:, 1] / ((0.5 * (R_N[1:] + R_N[:-1]) + 0.5 * (h[1:] + h[:-1])) * np.cos(middle))
        lon = 30 * DEG + np.concatenate([[0.0], np.cumsum(east)])
    pitch = np.arctan2(-v_n[:, 2], np.hypot(v_n[:, 0], v_n[:, 1]))
    heading = np.arctan2(v_n[:, 1], v_n[:, 0])
    attitude = Rotation.from_euler("ZYX", np.column_stack([heading, pitch, np.zeros(len(t))]))
    rows = (t, lat, lon, h, v_n, attitude.as_quat(scalar_first=True))
    return rows, increments(*rows)


def navigate(hour, seed, covariance_period):
    """Errors (epochs, 6) at 10 Hz in the last half hour: NED [m]; roll, pitch, heading [deg]."""
    (t, lat, lon, h, v_n, q_nb), (dtheta, dv) = hour
    rng = np.random.default_rng(seed)
    n = len(t) - 1

    def measured(exact, bias, walk, noise):
        wandering = bias + np.cumsum(rng.normal(size=(n, 3)), axis=0) * walk * math.sqrt(DT)
        return exact[1:] + wandering * DT + rng.normal(size=(n, 3)) * noise * math.sqrt(DT)

    gyro_bias = np.array([60.0, -40.0, 50.0]) * DEG / 3600
    angle = measured(dtheta, gyro_bias, MODEL.gyro_bias_walk, MODEL.gyro_noise)
    push = measured(dv, np.array([0.05, -0.04, 0.06]), MODEL.accel_bias_walk, MODEL.accel_noise)

    sigma = np.repeat([0.5 * DEG, 0.5, 3.0], 3)
    sigma[2] = 3 * DEG
    wrong = sigma * rng.normal(size=9)
    attitude = Rotation.from_rotvec(-wrong[:3]) * Rotation.from_quat(q_nb[0], scalar_first=True)
    ins = Ins(InsConfig(MODEL, (GnssAid(use_velocity=False),), covariance_period=covariance_period))
    ins.start(
        InitialState(
            0.0,
            lat[0] + wrong[6] / 6.37e6,
            lon[0] + wrong[7] / (6.37e6 * math.cos(lat[0])),
            h[0] - wrong[8],
            v_n[0] + wrong[3:6],
            attitude.as_quat(scalar_first=True),
            np.diag(sigma**2),
        )
    )
    dt = np.full(n, DT)
    rows, states = [], []
    for second in range(SECONDS):
        for tenth in range(10):
            rows.append(100 * second + 10 * (tenth + 1))
            block = slice(rows[-1] - 10, rows[-1])
            ins.propagate(ImuSamples(t[1:][block], dt[block], angle[block], push[block]))
            if tenth == 9:
                k = rows[-1]
                noise = rng.normal(size=3) / [6.37e6, 6.37e6 * math.cos(lat[k]), -1]
                ins.update(
                    GnssSample(t[k], t[k], lat[k] + noise[0], lon[k] + noise[1], h[k] + noise[2], np.full(3, np.nan),
                               np.ones(3), np.full(3, np.nan), FixType.FIX_3D, 10, 1.0, 1.0)
                )  # fmt: skip
            state = ins.estimate() if second >= SECONDS // 2 else None
            if state is not None:
                states.append(np.r_[state.lat, state.lon, state.h, state.q_nb])
    rows, states = np.array(rows[-len(states) :]), np.array(states)
    position = position_difference_n(*states[:, :3].T, lat[rows], lon[rows], h[rows])
    angles, true = (Rotation.from_quat(q, scalar_first=True).as_euler("ZYX") for q in (states[:, 3:], q_nb[rows]))
    return np.column_stack([position, (angles - true)[:, ::-1] / DEG])


@pytest.mark.slow
@pytest.mark.parametrize("covariance_period", [1, 5])
def test_as_accurate_as_the_oracles(hour, covariance_period):
    errors = np.array([navigate(hour, seed, covariance_period) for seed in SEEDS])
    rms = np.sqrt(np.mean(errors**2, axis=(0, 1)))
    print("N, E, D [m], roll, pitch, heading [deg]:", rms.round(4), "over the oracles':", (rms / ORACLE).round(3))
    print("per seed:", (np.sqrt(np.mean(errors**2, axis=1)) / ORACLE).round(2).tolist())
    assert (rms <= 1.05 * ORACLE).all()
