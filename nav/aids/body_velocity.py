"""Velocity over ground in body axes: an odometer, a Doppler radar, optical flow; and the constraint of wheels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nav._jit import njit
from nav.aids.base import NO_RATES, SPEED_LIMIT, Axes, Measurement, OperatingPoint, range_problem
from nav.aids.gnss import gnss_velocity
from nav.error_model import PHI, VEL, Block, Indices, markov
from nav.rotation import cross, dcm_from_quat
from nav.samples import Array, BodyVelocitySample, Sample

SIDEWAYS = np.array([1, 2])  # the body axes along which a wheeled vehicle does not move


@dataclass(frozen=True)
class BodyVelocityAid:
    """Velocity over ground along some body ``axes`` (indices), each with a scale factor error and a Markov error.

    ``nonholonomic_sigma`` adds the constraint of wheels, which neither slip sideways nor leave the ground where the
    sensor is.
    """

    sensor: str = "body_velocity"
    axes: tuple[int, ...] = (0, 1, 2)
    sigma: float = 0.1  # [m/s]
    scale_sigma: float = 0.0  # [1]
    error_sigma: float = 0.0  # [m/s]
    error_correlation_s: float = 300.0
    nonholonomic_sigma: float | None = None  # [m/s]
    arm_b: Axes = (0.0, 0.0, 0.0)  # IMU to the sensor's point [m]

    @property
    def parts(self) -> tuple[tuple[str, int], ...]:
        """See `Aid`."""
        own = ("body_velocity", len(self.axes))
        return (own,) if self.nonholonomic_sigma is None else (own, ("nonholonomic", 2))

    @property
    def states(self) -> tuple[str, ...]:
        """See `Aid`."""
        return f"{self.sensor}_scale", f"{self.sensor}_error"

    def blocks(self) -> list[Block]:
        """See `Aid`."""
        scale, error = self.states
        return [
            Block(scale, len(self.axes), self.scale_sigma),
            markov(error, len(self.axes), self.error_sigma, self.error_correlation_s),
        ]

    @cached_property
    def _values(self) -> tuple[Indices, Array, Array, Array]:
        """Axes, the variances of the two parts, and the lever arm."""
        nonholonomic = np.full(2, (self.nonholonomic_sigma or 0.0) ** 2)
        arm = np.array(self.arm_b, dtype=float)
        return np.array(self.axes), np.full(len(self.axes), self.sigma**2), nonholonomic, arm

    def measure(self, part: str, sample: Sample, at: OperatingPoint) -> Measurement | None:
        """See `Aid`."""
        assert isinstance(sample, BodyVelocitySample)
        axes, R, R_nonholonomic, arm = self._values
        state, (scale, error) = at.state, at.starts
        there = state.q_nb, state.v_n, state.lla, at.x, state.rates[0], state.errors, at.reference.driven, arm
        unknown = NO_RATES if any(self.arm_b) and not state.rates[0].any() else None
        if part == "nonholonomic":
            return Measurement(*nonholonomic(*there), R_nonholonomic, unknown)
        if not measures(sample, axes):
            return None
        nu, H = body_velocity(*there, axes, scale, error, sample.v_b)
        return Measurement(nu, H, R, unknown)


def problem(sample: BodyVelocitySample) -> str:
    """See `nav.aids.problem`. Axes that are not measured are NaN; which they may be, only the filter knows."""
    measured = [v for v in sample.v_b.tolist() if not math.isnan(v)]
    if not measured:
        return "velocity is not finite"
    return range_problem("speed", math.hypot(*measured), (0.0, SPEED_LIMIT))


def measures(sample: BodyVelocitySample, axes: Indices) -> bool:
    """Whether a sound sample has a number on each of the body ``axes``."""
    return all(math.isfinite(v) for v in sample.v_b[axes].tolist())


@njit
def body_velocity(
    q_nb: Array,
    v_n: Array,
    lla: Array,
    x: Array,
    omega_measured_b: Array,
    errors: Array,
    driven: Indices,
    arm_b: Array,
    axes: Indices,
    scale: int,
    error: int,
    v_b: Array,
) -> tuple[Array, Array]:
    """Velocity over ground along the m body ``axes`` [m/s], one row for each: (1 + scale) e . C_nb' v_s + error.

    v_s = v + C_nb (omega_ib x arm) - omega_ie x (C_nb arm) is the sensor's, see `gnss_velocity`. ``v_b`` (3,) is what
    was measured. The blocks ``scale`` and ``error`` have a state for each row, in the same order. By an odometer,
    axes = [0]: forward speed. Cui et al. 2022, equations 50-52, with the difference taken in body axes.
    """
    C_nb = dcm_from_quat(q_nb)
    nu = np.empty(len(axes))
    H = np.zeros((len(axes), len(x)))
    point_n, swing = v_n, H  # velocity of the sensor, and its Jacobian where it isn't that of the IMU's
    swings = arm_b[0] != 0.0 or arm_b[1] != 0.0 or arm_b[2] != 0.0
    if swings:
        behind, swing = gnss_velocity(q_nb, v_n, lla, x, omega_measured_b, errors, driven, arm_b, -1, np.zeros(3))
        point_n = -behind
        for i in range(3):
            swing[i, VEL + i] = 0.0
    for row in range(len(axes)):
        axis = axes[row]
        along_n = np.array([C_nb[0, axis], C_nb[1, axis], C_nb[2, axis]])
        speed = along_n[0] * point_n[0] + along_n[1] * point_n[1] + along_n[2] * point_n[2]
        gain = 1 + x[scale + row] if scale >= 0 else 1.0
        turned = cross(point_n, along_n)
        nu[row] = v_b[axis] - gain * speed
        for i in range(3):
            H[row, PHI + i], H[row, VEL + i] = gain * turned[i], gain * along_n[i]
        if swings:
            for i in range(3):
                for j in range(len(x)):
                    H[row, j] += gain * along_n[i] * swing[i, j]
        if scale >= 0:
            H[row, scale + row] = speed
        if error >= 0:
            H[row, error + row] = 1.0
            nu[row] -= x[error + row]
    return nu, H


def nonholonomic(
    q_nb: Array, v_n: Array, lla: Array, x: Array, omega_measured_b: Array, errors: Array, driven: Indices, arm_b: Array
) -> tuple[Array, Array]:
    """The constraint of wheels, neither sideways nor off the ground: 0 = (e_y, e_z) . C_nb' v_s [m/s].

    It acts where the sensor of the wheels does, v_s as of `body_velocity`.
    """
    return body_velocity(
        q_nb, v_n, lla, x, omega_measured_b, errors, driven, arm_b, SIDEWAYS, -1, -1, np.zeros(3)
    )  # fmt: skip
