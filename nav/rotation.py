"""Rotations as quaternions, direction cosine matrices, rotation vectors and Euler angles.

A quaternion ``q_ab`` (scalar first, unit) and a matrix ``C_ab`` take components in b to components in a:
``x_a = C_ab @ x_b``; they compose as ``C_ac = C_ab @ C_bc``, ``q_ac = q_ab * q_bc``. ``q`` and ``-q`` are the same
rotation. Every function takes one rotation and can be called from a kernel. Most allocate their result; those named
`..._components` give numbers instead, for long loops, and `turn` changes what it is given.

Source of the formulae: Titterton and Weston, Strapdown Inertial Navigation Technology, 2nd ed., section 3.6;
the Jacobian of the rotation vector: Barfoot, State Estimation for Robotics, section 7.1.5.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from nav._jit import lean, njit
from nav.samples import Array

Three: TypeAlias = tuple[float, float, float]
Four: TypeAlias = tuple[float, float, float, float]

# Below this squared angle the power series replace sin and cos: exact to rounding there, and faster.
SMALL_ANGLE_SQUARED = 0.04


@njit
def rotation_coefficients(angle_squared: float) -> tuple[float, float, float]:
    """sin(x)/x, (1 - cos x)/x^2 and (x - sin x)/x^3 at x = sqrt(``angle_squared``)."""
    s = angle_squared
    if s < SMALL_ANGLE_SQUARED:
        return (
            1 + s * (-1 / 6 + s * (1 / 120 + s * (-1 / 5040 + s * (1 / 362880 - s / 39916800)))),
            1 / 2 + s * (-1 / 24 + s * (1 / 720 + s * (-1 / 40320 + s / 3628800))),
            1 / 6 + s * (-1 / 120 + s * (1 / 5040 + s * (-1 / 362880 + s / 39916800))),
        )
    x = math.sqrt(s)
    sine, sine_of_half = math.sin(x), math.sin(0.5 * x)
    return sine / x, 2 * sine_of_half * sine_of_half / s, (x - sine) / (s * x)


@njit
def skew(v: Array) -> Array:
    """Matrix [v x] (3, 3) with ``skew(v) @ u = v x u``."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@njit
def dot(u: Array | Three, v: Array | Three) -> float:
    """U . v of (3,): in the same order, and so to the same bits, on every processor."""
    product: float = u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
    return product


@njit
def cross(u: Array, v: Array) -> Array:
    """U x v (3,): for three elements far cheaper than `numpy.cross`, and quicker to compile."""
    return np.array(cross_components(u, v))


@njit
def cross_components(u: Array | Three, v: Array | Three) -> Three:
    """`cross` without an array, for long loops."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@njit
def quat_multiply(p: Array, q: Array) -> Array:
    """Product (4,) of two quaternions: the rotation q first, then p."""
    return np.array(quat_multiply_components(p, q))


@njit
def quat_multiply_components(p: Array | Four, q: Array | Four) -> Four:
    """`quat_multiply` without an array, for long loops."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


@njit
def quat_conjugate(q: Array) -> Array:
    """The inverse rotation (4,): ``q_ba`` from ``q_ab``."""
    return np.array([q[0], -q[1], -q[2], -q[3]])


@njit
def quat_normalise(q: Array) -> Array:
    """``q`` (4,) scaled to unit norm."""
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return np.array([q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm])


@njit
def quat_from_rotvec(phi: Array) -> Array:
    """Quaternion (4,) of the rotation by |phi| [rad] about phi: exp(phi / 2)."""
    quarter = 0.25 * (phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2])
    sinc, versine, _ = rotation_coefficients(quarter)
    return np.array([1 - quarter * versine, 0.5 * sinc * phi[0], 0.5 * sinc * phi[1], 0.5 * sinc * phi[2]])


@lean
def turn(q: Array, x: float, y: float, z: float) -> None:
    """Turn ``q`` (4,) in place by the rotation vector (x, y, z) [rad]: exp(phi / 2) q, scaled to unit norm."""
    quarter = 0.25 * (x * x + y * y + z * z)
    sinc, versine, _ = rotation_coefficients(quarter)
    p, px, py, pz = 1 - quarter * versine, 0.5 * sinc * x, 0.5 * sinc * y, 0.5 * sinc * z
    w, qx, qy, qz = (
        p * q[0] - px * q[1] - py * q[2] - pz * q[3],
        p * q[1] + px * q[0] + py * q[3] - pz * q[2],
        p * q[2] - px * q[3] + py * q[0] + pz * q[1],
        p * q[3] + px * q[2] - py * q[1] + pz * q[0],
    )
    norm = math.sqrt(w * w + qx * qx + qy * qy + qz * qz)
    q[0], q[1], q[2], q[3] = w / norm, qx / norm, qy / norm, qz / norm


@njit
def rotvec_from_quat(q: Array) -> Array:
    """Rotation vector (3,) [rad] of a unit quaternion, the shorter way round: |phi| <= pi."""
    return np.array(rotvec_components(q))


@njit
def rotvec_components(q: Array | Four) -> Three:
    """`rotvec_from_quat` without an array, for long loops."""
    sine = math.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if sine == 0.0:
        return 0.0, 0.0, 0.0
    scale = 2 * math.atan2(sine, q[0]) / sine if q[0] >= 0 else -2 * math.atan2(sine, -q[0]) / sine
    return scale * q[1], scale * q[2], scale * q[3]


@njit
def dcm_from_quat(q: Array) -> Array:
    """Direction cosine matrix (3, 3) of a unit quaternion."""
    return np.array(dcm_components(q))


@njit
def dcm_components(q: Array | Four) -> tuple[Three, Three, Three]:
    """`dcm_from_quat` without an array, for long loops."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@njit
def quat_from_dcm(C: Array) -> Array:
    """Unit quaternion (4,) of a direction cosine matrix, scalar part not negative.

    Divides by the largest component, so it keeps full accuracy at every rotation, half turns included.
    """
    trace = C[0, 0] + C[1, 1] + C[2, 2]
    q = np.empty(4)
    i, largest = 0, trace
    for axis in range(3):
        if C[axis, axis] > largest:
            i, largest = axis + 1, C[axis, axis]
    if i == 0:
        q[0] = 1 + trace
        q[1] = C[2, 1] - C[1, 2]
        q[2] = C[0, 2] - C[2, 0]
        q[3] = C[1, 0] - C[0, 1]
    else:
        a, b, c = i - 1, i % 3, (i + 1) % 3
        q[0] = C[c, b] - C[b, c]
        q[1 + a] = 1 + 2 * C[a, a] - trace
        q[1 + b] = C[a, b] + C[b, a]
        q[1 + c] = C[a, c] + C[c, a]
    if q[0] < 0:
        for k in range(4):
            q[k] = -q[k]
    return quat_normalise(q)


@njit
def quat_from_euler(roll: float, pitch: float, heading: float) -> Array:
    """``q_nb`` (4,) from Euler angles [rad], turning by heading about z, then pitch about y, then roll about x."""
    return np.array(quat_from_euler_components(roll, pitch, heading))


@njit
def quat_from_euler_components(roll: float, pitch: float, heading: float) -> Four:
    """`quat_from_euler` without an array, for long loops."""
    sr, cr = math.sin(0.5 * roll), math.cos(0.5 * roll)
    sp, cp = math.sin(0.5 * pitch), math.cos(0.5 * pitch)
    sh, ch = math.sin(0.5 * heading), math.cos(0.5 * heading)
    return (
        ch * cp * cr + sh * sp * sr,
        ch * cp * sr - sh * sp * cr,
        ch * sp * cr + sh * cp * sr,
        sh * cp * cr - ch * sp * sr,
    )


@njit
def euler_from_quat(q: Array) -> Array:
    """[roll, pitch, heading] (3,) [rad] of a unit ``q_nb``: roll, heading in [-pi, pi], pitch in [-pi/2, pi/2].

    At pitch +-90 deg only the sum or difference of heading and roll is defined; near there both are ill-conditioned.
    All are NaN where ``q_nb`` is.
    """
    w, x, y, z = q[0], q[1], q[2], q[3]
    sin_pitch = 2 * (w * y - x * z)
    if abs(sin_pitch) > 1.0:  # by rounding
        sin_pitch = math.copysign(1.0, sin_pitch)
    return np.array(
        [
            math.atan2(2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
            math.asin(sin_pitch),
            math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)),
        ]
    )


@njit
def quat_rotate(q: Array, v: Array) -> Array:
    """``C(q) @ v`` (3,) for a unit quaternion."""
    return np.array(quat_rotate_components(q, v))


@njit
def quat_rotate_components(q: Array | Four, v: Array | Three) -> Three:
    """`quat_rotate` without an array, for long loops."""
    tx = 2 * (q[2] * v[2] - q[3] * v[1])
    ty = 2 * (q[3] * v[0] - q[1] * v[2])
    tz = 2 * (q[1] * v[1] - q[2] * v[0])
    return (
        v[0] + q[0] * tx + q[2] * tz - q[3] * ty,
        v[1] + q[0] * ty + q[3] * tx - q[1] * tz,
        v[2] + q[0] * tz + q[1] * ty - q[2] * tx,
    )


@njit
def left_jacobian_solve(phi: Array, v: Array) -> Array:
    """J(phi)^-1 @ v (3,), with J the mean of the rotation over the turn, ``integral of exp(s [phi x]) ds`` over [0, 1].

    A vector f that is constant in axes turning by ``phi`` (|phi| < 2 pi) has the mean J @ f in the axes where the turn
    began; this finds f from that mean.
    """
    return np.array(left_jacobian_components(phi, v))


@njit
def left_jacobian_components(phi: Array | Three, v: Array | Three) -> Three:
    """`left_jacobian_solve` without an array, for long loops."""
    s = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    a, b, _ = rotation_coefficients(s)
    # The rounding error of k grows as 1/s, but k multiplies terms of order s.
    k = (1 - 0.5 * a / b) / s if s > 1e-8 else 1 / 12
    first = cross_components(phi, v)
    second = cross_components(phi, first)
    return (
        v[0] - 0.5 * first[0] + k * second[0],
        v[1] - 0.5 * first[1] + k * second[1],
        v[2] - 0.5 * first[2] + k * second[2],
    )
