"""The covariance and the mean error over time, with the attitude's error of any size; see `nav.unscented`."""

from __future__ import annotations

import math

import numpy as np

from nav._jit import inlined, njit
from nav.error_model import MOTION, PHI, POS, VEL
from nav.kalman import take_rest
from nav.matrix import multiply
from nav.rotation import SMALL_ANGLE_SQUARED, rotation_coefficients
from nav.samples import Array
from nav.unscented.sigma_points import CURVED, USUAL, check, factor_sized

HALF_TURN2 = math.pi**2


@njit
def _cross(ux: float, uy: float, uz: float, vx: float, vy: float, vz: float) -> tuple[float, float, float]:
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@inlined
def _bend(
    x: float, y: float, z: float, dx: float, dy: float, dz: float, gx: float, gy: float, gz: float,
    px: float, py: float, pz: float, fx: float, fy: float, fz: float,
) -> tuple[float, float, float, float, float, float, float, float, float, float, float, float]:  # fmt: skip
    """What an error adds to attitude and velocity beyond the linear step: parts odd and even in the error, 3 x 4.

    ``x`` is its attitude, any size; the linear step makes the turns ``d`` of its velocity and place, and ``g`` and the
    velocity ``p`` of the errors of the sensors; ``f`` is the integral of the specific force. To be taken ``s`` times
    the error, x and f alone have to be taken s times and 1 / s times.
    """
    angle2 = x * x + y * y + z * z
    a, b, _ = rotation_coefficients(angle2)
    # of the Jacobian's inverse, which has no meaning beyond half a turn
    k = 1 / 12 + angle2 * (1 / 720 + angle2 * (1 / 30240 + angle2 * (1 / 1209600 + angle2 / 47900160)))
    if angle2 > SMALL_ANGLE_SQUARED:
        k = (1 - 0.5 * a / b) / angle2 if angle2 < HALF_TURN2 else 1 / HALF_TURN2
    ux, uy, uz = _cross(x, y, z, gx + dx, gy + dy, gz + dz)
    ux, uy, uz = _cross(x, y, z, ux, uy, uz)
    ex, ey, ez = _cross(x, y, z, gx - dx, gy - dy, gz - dz)

    # (I - E^-1 + [phi x]) f + (E^-1 - I) p, with E^-1 = I + a [phi x] + b [phi x]^2
    vx, vy, vz = _cross(x, y, z, fx, fy, fz)
    sx, sy, sz = _cross(x, y, z, vx, vy, vz)
    wx, wy, wz = _cross(x, y, z, px, py, pz)
    tx, ty, tz = _cross(x, y, z, wx, wy, wz)
    return (
        k * ux, k * uy, k * uz, (1 - a) * vx + b * tx, (1 - a) * vy + b * ty, (1 - a) * vz + b * tz,
        0.5 * ex, 0.5 * ey, 0.5 * ez, a * wx - b * sx, a * wy - b * sy, a * wz - b * sz,
    )  # fmt: skip


@njit
def carry(e: Array, Phi: Array, push_n: Array, T: float) -> Array:
    """What an error ``e`` (n,) of any size becomes over ``T`` seconds: the motion's part (9,); see `predict`."""
    moved, sensed, carried = np.zeros((3, MOTION))
    for i in range(MOTION):
        for j in range(VEL, MOTION):
            moved[i] += Phi[i, j] * e[j]
        for j in range(MOTION, Phi.shape[1]):
            sensed[i] += Phi[i, j] * e[j]
        for j in range(VEL):
            carried[i] += Phi[i, j] * e[j]
        carried[i] += moved[i] + sensed[i]
    bent = _bend(
        e[0], e[1], e[2], moved[PHI], moved[PHI + 1], moved[PHI + 2], sensed[PHI], sensed[PHI + 1], sensed[PHI + 2],
        sensed[VEL], sensed[VEL + 1], sensed[VEL + 2], push_n[0], push_n[1], push_n[2],
    )  # fmt: skip
    for i in range(6):
        carried[i] += bent[i] + bent[6 + i]
    for i in range(3):
        carried[POS + i] += 0.5 * T * (bent[VEL + i] + bent[6 + VEL + i])
    return carried


@inlined
def predict(
    P: Array, Phi: Array, decay: Array, half_noise: Array, work: Array, push_n: Array, T: float, spread: float,
    excess: float,
) -> Array:  # fmt: skip
    """Take ``P`` (n, n) in place over ``T`` seconds and return the mean error (n,) that arises, estimate minus truth.

    The first four arguments as in `kalman.predict`, with the Phi (9, columns) of `error_model.transition`; ``work`` is
    a `scratch`, part of which is the mean until it is used again; ``push_n`` (3,) is the integral of the specific force
    in n [m/s], the row sums of the integral of C_nb diag(f_b); ``spread`` and ``excess`` are of `Scaling`. The mean
    must be subtracted from the estimate. Raises ValueError for too small a ``work``.

    With half of the noise in P before and half added after, T the whole transition and L_1 the three columns of L that
    have an attitude,

        P <- T (P - L_1 L_1') T' + sum a_j a_j' + sum b_j b_j' / s^2 + (beta - alpha^2) c c'

    of which P - L_1 L_1' has no rows of the attitude.
    """
    check(work, len(P), 0, 0)
    if len(P) == USUAL and Phi.shape[1] == USUAL:
        return _predict(P, Phi, decay, half_noise, work, push_n, T, spread, excess, USUAL, USUAL)
    return _predict(P, Phi, decay, half_noise, work, push_n, T, spread, excess, len(P), Phi.shape[1])


@inlined
def _predict(
    P: Array, Phi: Array, decay: Array, half_noise: Array, work: Array, push_n: Array, T: float, spread: float,
    excess: float, n: int, columns: int,
) -> Array:  # fmt: skip
    """`predict` with the sizes (n, columns) of Phi and P, so that they may be known when it is compiled."""
    TT, root, own, moved = work[:n], work[n : n + 3], work[n + 3 : n + 6], work[n + 6 : n + 9]
    sensed, curved, rest = work[n + 9 : n + 12], work[n + 12 : n + 19], work[n + 19 : n + 28]
    none: Array = work[:0]
    mean: Array = work[n + 28, :n]
    for i in range(n):
        P[i, i] += half_noise[i]
    factor_sized(P, root, CURVED, n)
    for j in range(n):  # T'
        for i in range(MOTION):
            TT[j, i] = Phi[i, j] if j < columns else 0.0
        for i in range(MOTION, n):
            TT[j, i] = 0.0
        if j >= MOTION:
            TT[j, j] = decay[j]

    multiply(own, root, TT, 0, VEL, none, TT, n)
    multiply(moved, root, TT, VEL, MOTION, none, TT, n)
    multiply(sensed, root, TT, MOTION, n, none, TT, n)
    per_spread, half, weight = 1 / spread, 0.5 * T, math.sqrt(excess)
    fx, fy, fz = per_spread * push_n[0], per_spread * push_n[1], per_spread * push_n[2]
    for k in range(CURVED):  # rows a_j, then b_j / s, then that of c
        odd, even = curved[k], curved[CURVED + k]
        for i in range(MOTION):
            further = moved[k, i] + sensed[k, i]
            odd[i] = own[k, i] + further
            own[k, i] = -further
        for i in range(MOTION, n):
            odd[i], even[i] = sensed[k, i], 0.0
        ax, ay, az, bx, by, bz, cx, cy, cz, dx, dy, dz = _bend(
            spread * root[k, 0], spread * root[k, 1], spread * root[k, 2], moved[k, 0], moved[k, 1], moved[k, 2],
            sensed[k, 0], sensed[k, 1], sensed[k, 2], sensed[k, 3], sensed[k, 4], sensed[k, 5], fx, fy, fz,
        )  # fmt: skip
        odd[0] += ax
        odd[1] += ay
        odd[2] += az
        odd[3] += bx
        odd[4] += by
        odd[5] += bz
        odd[6] += half * bx
        odd[7] += half * by
        odd[8] += half * bz
        even[0], even[1], even[2], even[3], even[4], even[5] = cx, cy, cz, dx, dy, dz
        even[6], even[7], even[8] = half * dx, half * dy, half * dz
    for i in range(n):
        mean[i] = per_spread * (curved[3, i] + curved[4, i] + curved[5, i])
        curved[6, i] = weight * mean[i]

    multiply(rest, Phi, P, CURVED, columns, own, root, n)
    multiply(P[:MOTION], rest, TT, CURVED, n, curved, curved, n)
    for i in range(1, MOTION):
        for j in range(i):
            P[i, j] = P[j, i]
    take_rest(P, decay, MOTION, n)
    for i in range(n):
        P[i, i] += half_noise[i]
    return mean
