"""The IMU that the filters of the bench are told of, and where they stand."""

from __future__ import annotations

import numpy as np

from nav.error_model import ImuModel

DEG = np.pi / 180
START = (50.0, 30.0, 500.0)  # lat, lon [deg], h [m]
GYRO_NOISE, ACCEL_NOISE = 0.3 * DEG / 60, 0.05 / 60  # [rad/sqrt(s)], [m/s/sqrt(s)]
GYRO_WALK, ACCEL_WALK = 1e-6, 1e-5  # [rad/s/sqrt(s)], [m/s^2/sqrt(s)]
GNSS_SIGMA = 1.0  # [m]


def site() -> tuple[float, float, float]:
    """Latitude and longitude [rad], height [m]."""
    return START[0] * DEG, START[1] * DEG, START[2]


def unit() -> ImuModel:
    """The filters' model of that IMU."""
    return ImuModel(GYRO_NOISE, ACCEL_NOISE, 60 * DEG / 3600, 0.06, GYRO_WALK, ACCEL_WALK)
