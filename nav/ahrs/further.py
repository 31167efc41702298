"""Error states after the six, as far as they are asked for: gyro axes, accelerometer biases, gusts, velocity."""

from __future__ import annotations

import math

import numpy as np

from nav.ahrs.config import AhrsConfig
from nav.ahrs.state import PHI, STATES
from nav.earth import gravity
from nav.rotation import dcm_from_quat
from nav.samples import Array

NAMES = (
    [f"gyro_misalignment {axis}" for axis in "xyz"],
    [f"accel_bias {axis}" for axis in "xyz"],
    ["gust north", "gust east"],
    ["velocity north", "velocity east"],
)
VELOCITY_SIGMA = 1.0  # of it at the start [m/s]


class FurtherStates:
    """The error states after the six: k of them, estimate - truth where the estimate is zero.

    Gyros (3,), a share m of the yaw rate that each feels beside its own, by misalignment or scale; constant:

        phi' = ... + C_nb m omega_z

    Accelerometers (3,) in b, a constant bias b_a, and gusts (2,), accelerations a of the body to north and east: the
    mean over a period shows

        f_N = g phi_E - (C_nb b_a + a)_N,    f_E = -g phi_N - (C_nb b_a + a)_E

    Gusts are Gauss-Markov, of ``gust_sigma`` (s) and ``gust_correlation_s`` (tau). Their means over periods of T have
    the variance

        s_m^2 = 2 s^2 (tau / T) (1 - (tau / T) (1 - exp(-T / tau)))

    and are taken for AR(1), a <- r a + noise, with r such that the long-term power of the gusts is kept:

        s_m^2 (1 + r) / (1 - r) = p = 2 s^2 tau / T,    so  r = (p - s_m^2) / (p + s_m^2)

    Velocity (2,) is that of `nav.ahrs.any_motion`, which moves it itself.
    """

    def __init__(self, config: AhrsConfig) -> None:
        ratio = config.gust_correlation_s / config.period_s
        power = 2 * config.gust_sigma**2 * ratio
        variance = power * (1 + ratio * math.expm1(-1 / ratio))
        self._g = float(gravity(config.lat, config.h))
        velocity = 0.0 if config.any_motion is None else VELOCITY_SIGMA
        sigmas = config.gyro_misalignment_sigma, config.accel_bias_sigma, math.sqrt(variance), velocity
        sizes = [len(names) if sigma > 0 else 0 for names, sigma in zip(NAMES, sigmas, strict=True)]
        edges = STATES + np.cumsum([0, *sizes])
        # where they lie in the state
        self.misalignment, self.accel_bias, self.gust, self.velocity = (
            slice(*edges[k : k + 2].tolist()) for k in range(len(NAMES))
        )
        self.count = sum(sizes)
        self._places = np.arange(STATES, STATES + self.count)
        self.names = [name for names, size in zip(NAMES, sizes, strict=True) for name in names[:size]]
        self.sigma = np.repeat(sigmas, sizes)  # (k,) at the start
        fading = -math.log((power - variance) / (power + variance)) / config.period_s if sizes[2] else 0.0
        self.decay_rate = np.repeat([0.0, 0.0, fading, 0.0], sizes)  # (k,) [1/s]

    def step(self, whole: Array, half_noise: Array, T: float) -> None:
        """Put what fades in ``T`` [s] into the transition ``whole`` (n, n), and half of what comes in into (n,).

        Half comes in before the decay and half after, and the variance of gusts stays.
        """
        if not self.count:
            return
        kept = np.exp(-T * self.decay_rate)
        whole[self._places, self._places] = kept
        half_noise[STATES:] = self.sigma**2 * (1 - kept**2) / (1 + kept**2)

    def turn(self, whole: Array, turned: Array, yaw_rate: float) -> None:
        """Put what the misaligned gyros make of ``yaw_rate`` [rad/s] into the transition ``whole`` (n, n).

        ``turned`` (3, 3) is the integral of C_nb.
        """
        if self.misalignment.stop > self.misalignment.start:
            whole[PHI : PHI + 3, self.misalignment] = turned * yaw_rate

    def drive(self, F: Array) -> None:
        """Put what tilt makes of the velocity into the system matrix ``F`` (n, n) [1/s]."""
        if self.velocity.stop > self.velocity.start:
            north, east = range(self.velocity.start, self.velocity.stop)
            F[north, PHI + 1], F[east, PHI] = self._g, -self._g

    def columns(self, H: Array, q_nb: Array) -> None:
        """Put theirs into ``H`` (2, n) of the mean horizontal specific force of a body at the attitude ``q_nb``."""
        if self.accel_bias.stop > self.accel_bias.start:
            H[:, self.accel_bias] = -dcm_from_quat(q_nb)[:2]
        if self.gust.stop > self.gust.start:
            H[:, self.gust] = -np.eye(2)
