"""Error states after the six, as far as they are asked for: gyro axes, accelerometer biases, gusts, velocities."""

from __future__ import annotations

import math

import numpy as np

from nav._jit import inlined
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
    ["turning velocity north", "turning velocity east"],
)
RIGHT = np.array([[0.0, -1.0], [1.0, 0.0]])  # of a horizontal vector, a quarter of a turn on

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

    Velocity (2,), and velocity (2,) that turns with the body, are those of `nav.ahrs.any_motion`, which moves them
    itself; the latter fades as gusts do.
    """

    def __init__(self, config: AhrsConfig) -> None:
        ratio = config.gust_correlation_s / config.period_s
        power = 2 * config.gust_sigma**2 * ratio
        variance = power * (1 + ratio * math.expm1(-1 / ratio))
        self._g = float(gravity(config.lat, config.h))
        told = config.any_motion
        velocity, turning, forgotten = (
            (0.0, 0.0, 0.0) if told is None else (VELOCITY_SIGMA, told.turning_speed, 1 / told.turning_speed_s)
        )
        sigmas = config.gyro_misalignment_sigma, config.accel_bias_sigma, math.sqrt(variance), velocity, turning
        sizes = [len(names) if sigma > 0 else 0 for names, sigma in zip(NAMES, sigmas, strict=True)]
        edges = STATES + np.cumsum([0, *sizes])
        # where they lie in the state
        self.misalignment, self.accel_bias, self.gust, self.velocity, self.turning = (
            slice(*edges[k : k + 2].tolist()) for k in range(len(NAMES))
        )
        self.count = sum(sizes)
        own = self.misalignment, self.accel_bias, self.gust
        self.places = [place.start if place.stop > place.start else -1 for place in own]  # of the first three, as begun
        self.names = [name for names, size in zip(NAMES, sizes, strict=True) for name in names[:size]]
        self.sigma = np.repeat(sigmas, sizes)  # (k,) at the start
        fading = -math.log((power - variance) / (power + variance)) / config.period_s if sizes[2] else 0.0
        self.decay_rate = np.repeat([0.0, 0.0, fading, 0.0, forgotten], sizes)  # (k,) [1/s]

    def turn(self, whole: Array, turned: Array, yaw_rate: float) -> None:
        """Put what the misaligned gyros make of ``yaw_rate`` [rad/s] into the transition ``whole`` (n, n).

        ``turned`` (3, 3) is the integral of C_nb.
        """
        misaligned(whole, turned, yaw_rate, self.places[0])

    def drive(self, F: Array, turn_rate: float) -> None:
        """Put what tilt, and a turn about the vertical [rad/s], make of the velocities into ``F`` (n, n) [1/s]."""
        if self.velocity.stop > self.velocity.start:
            north, east = range(self.velocity.start, self.velocity.stop)
            F[north, PHI + 1], F[east, PHI] = self._g, -self._g
            F[self.velocity, self.turning] = -turn_rate * RIGHT
            F[self.turning, self.turning] += turn_rate * RIGHT


@inlined
def misaligned(whole: Array, turned: Array, yaw_rate: float, start: int) -> None:
    """`FurtherStates.turn`: the states begin at ``start``, -1 without any."""
    if start >= 0:
        for i in range(3):
            for j in range(3):
                whole[PHI + i, start + j] = turned[i, j] * yaw_rate


@inlined
def columns(H: Array, q_nb: Array, accel_bias: int, gust: int) -> None:
    """Put theirs into ``H`` (2, n) of the mean horizontal specific force of a body at the attitude ``q_nb``.

    The states begin at ``accel_bias`` and ``gust``, -1 without any.
    """
    if accel_bias >= 0:
        C_nb = dcm_from_quat(q_nb)
        for i in range(2):
            for j in range(3):
                H[i, accel_bias + j] = -C_nb[i, j]
    if gust >= 0:
        H[0, gust] = H[1, gust + 1] = -1.0
