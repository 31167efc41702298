"""Trials of BROAD (Laidig et al. 2021), that are not part of the project: reading, feeding, scoring by its metric.

The variable ``TESTBED_RECORDINGS`` names the folder that has them in ``broad/``: one npz of a trial each with ``imu_t``
[s], ``gyro`` [rad/s], ``accel`` [m/s^2] and ``mag`` [uT] in forward-right-down axes, ``truth_q`` (body to NED, scalar
first, heading from magnetic north) by cameras, ``truth_valid`` and ``movement``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from nav.ahrs import Ahrs, AhrsConfig
from nav.error_model import ImuModel
from nav.horizon import FusionHorizon
from nav.samples import Array, ImuSamples, MagnetometerSample
from worlds.real_flights import FOLDER

DEG = math.pi / 180
LAT, FIELD_N = 52.5 * DEG, np.array([18.6e-6, 0.0, 45.9e-6])  # Berlin, from magnetic north
IRON, IRON_S = 2 * DEG, 10.0  # of the heading by a magnetometer's residual errors, and for how long
# What data sheets of such parts say: no figure of a trial.
IMU = ImuModel(
    gyro_noise=0.02 * DEG, accel_noise=3e-3, gyro_bias_sigma=0.5 * DEG, accel_bias_sigma=0.05, gyro_bias_walk=5e-3 * DEG
)


@dataclass(frozen=True)
class Trial:
    name: str
    dt: float
    t: Array
    gyro: Array
    accel: Array
    mag: Array
    true: Array
    scored: Array  # moving, and seen by the cameras


def trials() -> list[Path]:
    return sorted((Path(FOLDER) / "broad").glob("*.npz")) if FOLDER else []


def read(path: Path) -> Trial:
    with np.load(path) as data:
        true = data["truth_q"]
        scored = data["movement"] & data["truth_valid"] & np.isfinite(true).all(axis=1)
        t, dt = data["imu_t"], 1 / float(data["sampling_rate"])
        return Trial(path.stem, dt, t, data["gyro"], data["accel"], data["mag"], true, scored)


def config(rate_hz: float) -> AhrsConfig:
    """The configuration for all trials, of a magnetometer at this rate."""
    sigma = IRON * math.sqrt(2 * IRON_S * rate_hz)
    return AhrsConfig(IMU, LAT, aids=("magnetometer",), magnetometer_sigma=sigma)


def estimates(trial: Trial, told: AhrsConfig, every: int = 10) -> tuple[Array, Array, Array]:
    """Rows, attitudes (N, 4) at their times and covariances (N, 3, 3) of attitude; NaN before there is one."""
    imu = ImuSamples(trial.t + trial.dt, np.full(len(trial.t), trial.dt), trial.gyro * trial.dt, trial.accel * trial.dt)
    samples = [MagnetometerSample(t, t, m) for t, m in zip(imu.t.tolist(), trial.mag * 1e-6, strict=True)]
    rows = np.arange(0, len(trial.t), every)
    _, found = FusionHorizon(Ahrs(told, FIELD_N)).track(imu, samples, imu.t[rows].tolist())
    return rows, np.array([one.q_nb for one in found]), np.array([one.covariance[6:, 6:] for one in found])


def vqf(trial: Trial) -> Array:
    """Attitudes (N, 4) by VQF with its defaults, turned from its axes: forward-left-up, east-north-up."""
    from vqf import VQF

    axes = np.array([1.0, -1.0, -1.0])
    given = [np.ascontiguousarray(one * axes) for one in (trial.gyro, trial.accel, trial.mag)]
    found = Rotation.from_quat(VQF(trial.dt).updateBatch(*given)["quat9D"], scalar_first=True)
    to_ned = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return (to_ned * found * Rotation.from_matrix(np.diag(axes))).as_quat(scalar_first=True)


def error(q: Array, true: Array) -> Array:
    """Total, heading and inclination error (N, 3) [deg]: the rotation in n from truth to estimate, its twist about the
    vertical, and what is left. Equations of BROAD, section 4; nothing is aligned.
    """
    turn = Rotation.from_quat(q, scalar_first=True) * Rotation.from_quat(true, scalar_first=True).inv()
    w, x, y, z = np.abs(turn.as_quat(scalar_first=True)).T
    inclination = np.arctan2(np.hypot(x, y), np.hypot(w, z))
    return 2 * np.degrees(np.column_stack([turn.magnitude() / 2, np.arctan2(z, w), inclination]))


def rms(values: Array) -> Array:
    found: Array = np.sqrt(np.mean(np.square(values), axis=0))
    return found


def nees(q: Array, true: Array, covariance: Array) -> tuple[float, float]:
    """Mean NEES per degree of freedom of tilt and of heading."""
    turn = Rotation.from_quat(q, scalar_first=True) * Rotation.from_quat(true, scalar_first=True).inv()
    phi = -turn.as_rotvec()
    tilt = np.einsum("ni,nij,nj->n", phi[:, :2], np.linalg.inv(covariance[:, :2, :2]), phi[:, :2]) / 2
    return float(tilt.mean()), float(np.mean(phi[:, 2] ** 2 / covariance[:, 2, 2]))
