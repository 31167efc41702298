"""The least error that levelling by gravity can have: a linear filter told all statistics, simulated by its gains.

Once a second it takes horizontal specific force for tilt, unless the body turns. It knows when that is, how strong
gusts are and how long they last (means over a second of Gauss-Markov noise, without approximation), how large biases
and misalignments are, and it has no limits. Nothing of `nav.ahrs` is in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nav.earth import STANDARD_GRAVITY
from nav.rotation import dcm_from_quat
from nav.samples import Array
from testbed.score.accuracy import Mask

# phi (n), gyro bias (b), what gyros x and y feel of the yaw rate, accelerometer bias (b), gusts and their mean (n)
PHI, GYRO, SHARE, ACCEL = slice(0, 3), slice(3, 6), slice(6, 8), slice(8, 11)
GUST, MEAN = slice(11, 13), slice(13, 15)
STATES = 15
DRIVEN = np.r_[PHI, GUST, MEAN]  # by noise


@dataclass(frozen=True, slots=True)
class Statistics:
    """Of the sensors and the air, SI: `gyro_bias` and `accel_bias` are of either sign, the rest is normal."""

    gyro_bias: float
    gyro_noise: float  # [rad/sqrt(s)]
    misalignment: float
    accel_bias: float
    accel_noise: float  # [m/s/sqrt(s)]
    gust: float
    gust_correlation_s: float
    tilt: float  # at the start, wherever to


def gust_step(s: Statistics) -> tuple[Array, Array]:
    """Of [gust, its mean over a second]: transition (2, 2) and covariance (2, 2) of what comes in."""
    tau = s.gust_correlation_s
    a = np.exp(-1.0 / tau)
    both = tau * (1 - a) ** 2
    Q = s.gust**2 * np.array([[1 - a**2, both], [both, 2 * tau - tau**2 * (3 - 4 * a + a**2)]])
    return np.array([[a, 0.0], [tau * (1 - a), 0.0]]), Q


def best(s: Statistics, q_nb: Array, yaw_rate: Array, straight: Mask, random: np.random.Generator) -> Array:
    """Errors of roll and pitch (N, 2) [deg] after each of N seconds, as one draw of such a filter has them.

    ``q_nb`` (N, 4) and ``yaw_rate`` (N,) [rad/s] are true in the middle of each, ``straight`` (N,) when it levels.
    """
    sigma = np.zeros(STATES)
    sigma[:2], sigma[GYRO], sigma[SHARE] = s.tilt / np.sqrt(2), s.gyro_bias, s.misalignment
    sigma[ACCEL], sigma[GUST] = np.hypot(s.accel_bias, s.misalignment * STANDARD_GRAVITY), s.gust
    P, e = np.diag(sigma**2), sigma * random.normal(size=STATES)
    e[GYRO] = s.gyro_bias * random.choice((-1.0, 1.0), 3)
    F, Q = np.eye(STATES), np.zeros((STATES, STATES))
    Q[PHI, PHI] = s.gyro_noise**2 * np.eye(3)
    gusts = slice(GUST.start, MEAN.stop)
    F[gusts, gusts], Q[gusts, gusts] = (np.kron(one, np.eye(2)) for one in gust_step(s))
    root = np.linalg.cholesky(Q[np.ix_(DRIVEN, DRIVEN)])
    R = s.accel_noise**2
    H = np.zeros((2, STATES))
    H[0, 1], H[1, 0], H[:, MEAN] = STANDARD_GRAVITY, -STANDARD_GRAVITY, -np.eye(2)
    found = np.empty((len(q_nb), 2))
    for k, q in enumerate(q_nb):
        C_nb = dcm_from_quat(q)
        F[PHI, GYRO], F[PHI, SHARE] = C_nb, C_nb[:, :2] * yaw_rate[k]
        P, e = F @ P @ F.T + Q, F @ e
        e[DRIVEN] += root @ random.normal(size=len(DRIVEN))
        if straight[k]:
            H[:, ACCEL] = -C_nb[:2]
            K = np.linalg.solve(H @ P @ H.T + R * np.eye(2), H @ P).T
            I_KH = np.eye(STATES) - K @ H
            P = I_KH @ P @ I_KH.T + R * K @ K.T
            e = I_KH @ e + np.sqrt(R) * K @ random.normal(size=2)
        north, east = C_nb[:2, 0] / np.hypot(*C_nb[:2, 0])
        found[k] = np.degrees([north * e[0] + east * e[1], north * e[1] - east * e[0]])
    return found
