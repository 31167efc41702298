"""Sigma points instead of derivatives: the engine for attitude errors that are too large to be linear.

The error state and its signs are those of `nav.error_model`; the attitude's part is a rotation vector,
``C_nb_hat = exp(-[phi x]) C_nb``, of any size. A local filter keeps its strapdown, its estimated values and P, and

* in place of `kalman.predict` calls `predict`, and takes the mean error that it returns out of the motion;
* in place of `kalman.innovate` and `kalman.correct` calls `points`, its measurement function, `innovate` and
  `correct` (`update` does all four), or stays with the linear ones for a measurement that is linear in the error.

Transform. With P = L L' and L_j the columns of L, the points are ``e = 0`` and ``e = +-s L_j``, s = alpha sqrt(3): the
scaled transform with kappa = 0 over the three directions in which the equations curve, all others being linear. From
Y_j+-, the points after the function, with ``a_j = (Y_j+ - Y_j-) / (2 s)``, ``b_j = (Y_j+ + Y_j-) / 2 - Y_0`` and
``c = sum b_j / s^2``,

    mean = Y_0 + c
    covariance = sum a_j a_j' + sum b_j b_j' / s^2 + (beta - alpha^2) c c'

which are the weighted sums of Julier and Uhlmann (Proc. IEEE 92, 2004, 401) rearranged so that no weight is negative:
it is positive for alpha^2 <= beta whatever the function. A function that curves in more directions than three gets the
transform with n + kappa = 3.

Time update. Only the attitude is bent by the motion, so only the three columns of L that move it need a function: P is
split into those and the rest, which the linear step carries. Their function is the error model for large misalignment
(Cheng et al. 2020, Eq 1, with the accelerometers' term that its print leaves out); E = exp(-[phi x]), and the
quantities with a hat are those of the strapdown:

    phi' = -[w_in_hat x] phi + J_r^-1(phi) C_nb_hat db_g + J_l^-1(phi) dw_in
    dv'  = (I - E^-1) C_nb_hat f_hat - E^-1 C_nb_hat db_a + (linear terms of `error_model`)

Of it `predict` takes what is left over the transition, so for small errors it is the linear step. Every point's own
strapdown is not needed; the tests compare with that.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from nav import kalman
from nav._jit import njit
from nav.earth import radii, wrap_longitude
from nav.error_model import MOTION, PHI, POS, VEL
from nav.rotation import quat_from_rotvec, quat_multiply, quat_normalise, rotation_coefficients
from nav.samples import Array

CURVED = 3  # error states in which the equations are not linear: the attitude's, which are the first
HALF_TURN2 = math.pi**2
GUARD = 1e-14  # of a variance, what rounding may have left of it at least


class Scaling(NamedTuple):
    """How far out the points lie: ``alpha`` from 0.1 to 1; ``beta`` = 2 for a normal error."""

    alpha: float = 1.0
    beta: float = 2.0

    @property
    def spread(self) -> float:
        """The distance s of the points [sigma]."""
        return self.alpha * math.sqrt(CURVED)

    @property
    def excess(self) -> float:
        """What the square of the mean's shift counts in the covariance."""
        return self.beta - self.alpha**2


class Points(NamedTuple):
    """What the truth would be at each of N points: the estimate first, then all +, then all -."""

    q_nb: Array  # (N, 4)
    v_n: Array  # (N, 3)
    lla: Array  # (N, 3)
    x: Array  # (N, n), the further states; the motion's entries are those of the estimate


@njit
def factor(P: Array, columns: int) -> Array:
    """The first ``columns`` columns of L as rows (columns, n): L is lower triangular, L L' = P.

    A pivot that rounding has made too small is raised to `GUARD` of P_ii.
    """
    n = len(P)
    root = np.zeros((columns, n))
    for j in range(columns):
        for i in range(j, n):
            root[j, i] = P[j, i]
        for k in range(j):
            c = root[k, j]
            for i in range(j, n):
                root[j, i] -= c * root[k, i]
        pivot = math.sqrt(max(root[j, j], GUARD * P[j, j], 0.0))
        root[j, j] = pivot
        for i in range(j + 1, n):
            root[j, i] = root[j, i] / pivot if pivot > 0.0 else 0.0
    return root


@njit
def _cross(ux: float, uy: float, uz: float, vx: float, vy: float, vz: float) -> tuple[float, float, float]:
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@njit
def _beyond_linear(even: Array, odd: Array, e: Array, Phi: Array, push_n: Array, T: float) -> None:
    """What the error ``e`` (n,) becomes over ``T`` seconds beyond ``Phi @ e``, in its parts even and odd in e, (9,)."""
    gx = gy = gz = dx = dy = dz = px = py = pz = 0.0
    for j in range(VEL, MOTION):  # the turn of n that errors of velocity and place add
        dx += Phi[PHI, j] * e[j]
        dy += Phi[PHI + 1, j] * e[j]
        dz += Phi[PHI + 2, j] * e[j]
    for j in range(MOTION, Phi.shape[1]):  # the turn and the velocity that the sensors' errors add
        gx += Phi[PHI, j] * e[j]
        gy += Phi[PHI + 1, j] * e[j]
        gz += Phi[PHI + 2, j] * e[j]
        px += Phi[VEL, j] * e[j]
        py += Phi[VEL + 1, j] * e[j]
        pz += Phi[VEL + 2, j] * e[j]
    x, y, z = e[PHI], e[PHI + 1], e[PHI + 2]
    fx, fy, fz = push_n[0], push_n[1], push_n[2]
    angle2 = x * x + y * y + z * z
    a, b, _ = rotation_coefficients(angle2)
    k = 1 / 12  # of the Jacobian's inverse, which has no meaning beyond half a turn
    if angle2 > 1e-8:
        k = (1 - 0.5 * a / b) / angle2 if angle2 < HALF_TURN2 else 1 / HALF_TURN2

    ux, uy, uz = _cross(x, y, z, gx - dx, gy - dy, gz - dz)
    even[PHI], even[PHI + 1], even[PHI + 2] = 0.5 * ux, 0.5 * uy, 0.5 * uz
    ux, uy, uz = _cross(x, y, z, gx + dx, gy + dy, gz + dz)
    ux, uy, uz = _cross(x, y, z, ux, uy, uz)
    odd[PHI], odd[PHI + 1], odd[PHI + 2] = k * ux, k * uy, k * uz

    # (I - E^-1 + [phi x]) push + (E^-1 - I) p, with E^-1 = I + a [phi x] + b [phi x]^2
    ux, uy, uz = _cross(x, y, z, fx, fy, fz)
    sx, sy, sz = _cross(x, y, z, ux, uy, uz)
    wx, wy, wz = _cross(x, y, z, px, py, pz)
    tx, ty, tz = _cross(x, y, z, wx, wy, wz)
    even[VEL], even[VEL + 1], even[VEL + 2] = a * wx - b * sx, a * wy - b * sy, a * wz - b * sz
    odd[VEL] = (1 - a) * ux + b * tx
    odd[VEL + 1] = (1 - a) * uy + b * ty
    odd[VEL + 2] = (1 - a) * uz + b * tz
    for i in range(3):
        even[POS + i] = 0.5 * T * even[VEL + i]
        odd[POS + i] = 0.5 * T * odd[VEL + i]


@njit
def predict(
    P: Array, Phi: Array, decay: Array, half_noise: Array, work: Array, push_n: Array, T: float, spread: float,
    excess: float,
) -> Array:  # fmt: skip
    """Take ``P`` (n, n) in place over ``T`` seconds and return the mean error (n,) that arises, estimate minus truth.

    The first five arguments as in `kalman.predict`, with the Phi (9, columns) of `error_model.transition`; ``push_n``
    (3,) is the integral of the specific force in n [m/s], the row sums of the integral of C_nb diag(f_b); ``spread``
    and ``excess`` are of `Scaling`. The mean must be subtracted from the estimate.
    """
    n = len(P)
    rows, columns = Phi.shape
    A, B = np.zeros((CURVED, n)), np.zeros((CURVED, MOTION))
    mean, point, odd = np.zeros(n), np.empty(n), np.empty(MOTION)
    C = factor(P, CURVED)
    # What these columns leave of P goes the linear way
    for i in range(n):
        for j in range(CURVED):
            P[i, j] = P[j, i] = 0.0
    for i in range(CURVED, n):
        a, b, c = C[0, i], C[1, i], C[2, i]
        for j in range(CURVED, n):
            P[i, j] -= a * C[0, j] + b * C[1, j] + c * C[2, j]
    kalman.predict(P, Phi, decay, half_noise, work)

    for k in range(CURVED):
        for i in range(n):
            point[i] = spread * C[k, i]
        _beyond_linear(B[k], odd, point, Phi, push_n, T)
        for i in range(MOTION):
            A[k, i] = odd[i] / spread
            B[k, i] /= spread
            mean[i] += B[k, i] / spread
        for i in range(rows, n):
            A[k, i] = decay[i] * C[k, i]
    for i in range(rows):
        for j in range(columns):
            step = Phi[i, j]
            if step != 0.0:
                for k in range(CURVED):
                    A[k, i] += step * C[k, j]
    for i in range(n):
        a, b, c = A[0, i], A[1, i], A[2, i]
        for j in range(n):
            P[i, j] += a * A[0, j] + b * A[1, j] + c * A[2, j]
    for i in range(MOTION):
        a, b, c, shift = B[0, i], B[1, i], B[2, i], excess * mean[i]
        for j in range(MOTION):
            P[i, j] += a * B[0, j] + b * B[1, j] + c * B[2, j] + shift * mean[j]
    return mean


@njit
def remove(q_nb: Array, v_n: Array, lla: Array, x: Array, error: Array) -> None:
    """Take an ``error`` (n,), estimate minus truth, out of the estimate in place; the attitude's is of any size."""
    turned = quat_normalise(quat_multiply(quat_from_rotvec(error[PHI : PHI + 3]), q_nb))
    R_M, R_N = radii(lla[0])
    for i in range(4):
        q_nb[i] = turned[i]
    for i in range(3):
        v_n[i] -= error[VEL + i]
    lla[1] = wrap_longitude(lla[1] - error[POS + 1] / ((R_N + lla[2]) * math.cos(lla[0])))
    lla[0] -= error[POS] / (R_M + lla[2])
    lla[2] += error[POS + 2]
    for i in range(MOTION, len(x)):
        x[i] -= error[i]


@njit
def _points(
    q_nb: Array, v_n: Array, lla: Array, x: Array, root: Array, spread: float
) -> tuple[Array, Array, Array, Array]:
    columns, n = root.shape
    size = 2 * columns + 1
    q, v, place, further = np.empty((size, 4)), np.empty((size, 3)), np.empty((size, 3)), np.empty((size, n))
    error = np.zeros(n)
    for k in range(size):
        for i in range(4):
            q[k, i] = q_nb[i]
        for i in range(3):
            v[k, i], place[k, i] = v_n[i], lla[i]
        for i in range(n):
            further[k, i] = x[i]
            if k > 0:
                error[i] = spread * root[k - 1, i] if k <= columns else -spread * root[k - 1 - columns, i]
        if k > 0:
            remove(q[k], v[k], place[k], further[k], error)
    return q, v, place, further


def points(q_nb: Array, v_n: Array, lla: Array, x: Array, root: Array, spread: float) -> Points:
    """The candidates for the truth around an estimate along the columns of L in ``root`` (columns, n): see `factor`."""
    return Points(*_points(q_nb, v_n, lla, x, root, spread))


@njit
def innovate(
    Z: Array, z: Array, R: Array, root: Array, H: Array, spread: float, excess: float
) -> tuple[Array, Array, Array, Array, float]:
    """(nu, S, A, R_curved, nis) of a measurement ``z`` (m,) with variances ``R`` from ``Z`` (2 k + 1, m) at the points.

    The points lie along the first k columns of L (``root`` (n, n) by `factor`); along the others the measurement is
    linear, with ``H`` (m, n) as in `kalman.innovate`: not used when k = n.

    nu = z - mean; A (m, n) is the measurement's slope along the columns of L; R_curved (m, m) what the curvature adds
    to R; S = A A' + R_curved + diag(R); nis = nu' S^-1 nu, NaN when rounding has left S not positive definite.
    """
    curved, n, m = len(Z) // 2, len(root), len(z)
    A, R_curved, S, nu, shift = np.zeros((m, n)), np.zeros((m, m)), np.empty((m, m)), np.empty(m), np.zeros(m)
    bend = np.empty(m)
    for j in range(curved):
        for i in range(m):
            A[i, j] = 0.5 * (Z[1 + j, i] - Z[1 + curved + j, i]) / spread
            bend[i] = (0.5 * (Z[1 + j, i] + Z[1 + curved + j, i]) - Z[0, i]) / spread
            shift[i] += bend[i] / spread
        for i in range(m):
            for k in range(m):
                R_curved[i, k] += bend[i] * bend[k]
    for i in range(m):
        for j in range(curved, n):
            for k in range(j, n):
                A[i, j] -= H[i, k] * root[j, k]  # truth = estimate - error
    for i in range(m):
        nu[i] = z[i] - Z[0, i] - shift[i]
        for k in range(i + 1):
            R_curved[i, k] += excess * shift[i] * shift[k]
            R_curved[k, i] = R_curved[i, k]
            total = R_curved[i, k]
            for j in range(n):
                total += A[i, j] * A[k, j]
            S[i, k] = S[k, i] = total
        S[i, i] += R[i]
    S_inverse, definite = kalman.invert(S)
    nis = 0.0 if definite else math.nan
    for i in range(m):
        for k in range(m):
            nis += nu[i] * S_inverse[i, k] * nu[k]
    return nu, S, A, R_curved, nis


@njit
def correct(P: Array, root: Array, A: Array, R_curved: Array, R: Array, nu: Array) -> Array:
    """Update ``P`` in place and return the mean error (n,) found, for `remove`; the arguments as from `innovate`.

    An infinite variance in ``R`` leaves its axis out. Potter's square root, one decorrelated axis after the other:

    L <- L (I - a a' / (r^2 + r)),  r^2 = 1 + a' a

    so P = L L' is positive whatever rounding did; then the attitude's part is turned into the axes of the corrected
    estimate, phi <- J_l(mean phi) (phi - mean phi). ``root`` is used up.
    """
    n, m = len(P), len(nu)
    kept = np.empty(m, dtype=np.int64)
    used = 0
    for i in range(m):
        if R[i] < math.inf:
            kept[used] = i
            used += 1
    # Rows with independent unit noise: D^-1 A, D^-1 nu, with D D' = R_curved + diag(R)
    noise, a, y = np.empty((used, used)), np.empty((used, n)), np.empty(used)
    for i in range(used):
        y[i] = nu[kept[i]]
        for j in range(n):
            a[i, j] = A[kept[i], j]
        for k in range(used):
            noise[i, k] = R_curved[kept[i], kept[k]]
        noise[i, i] += R[kept[i]]
    D = factor(noise, used)
    for i in range(used):
        for k in range(i):
            y[i] -= D[k, i] * y[k]
            for j in range(n):
                a[i, j] -= D[k, i] * a[k, j]
        y[i] /= D[i, i]
        for j in range(n):
            a[i, j] /= D[i, i]
    found, gain = np.zeros(n), np.empty(n)
    for i in range(used):
        total = 1.0
        for j in range(n):
            gain[j] = 0.0
        for k in range(n):
            total += a[i, k] * a[i, k]
            c = a[i, k]
            for j in range(n):
                gain[j] += c * root[k, j]  # L a
        shrink = 1.0 / (total + math.sqrt(total))
        for j in range(n):
            found[j] += gain[j] * y[i] / total
        for k in range(n):
            c = shrink * a[i, k]
            for j in range(n):
                root[k, j] -= c * gain[j]
        # what is left of the later axes: their innovation, and their slope along the new columns
        for k in range(i + 1, used):
            product = 0.0
            for j in range(n):
                product += a[k, j] * a[i, j]
            y[k] -= product * y[i] / total
            for j in range(n):
                a[k, j] -= shrink * product * a[i, j]
    _turn(root, found)
    for i in range(n):
        for j in range(n):
            P[i, j] = 0.0
        for k in range(n):
            c = root[k, i]
            for j in range(n):
                P[i, j] += c * root[k, j]
    return found


@njit
def _turn(root: Array, error: Array) -> None:
    """J_l(phi) = I + b [phi x] + c [phi x]^2 on the attitude's part of every column of L, phi of ``error``."""
    x, y, z = error[PHI], error[PHI + 1], error[PHI + 2]
    _, b, c = rotation_coefficients(x * x + y * y + z * z)
    for k in range(len(root)):
        ux, uy, uz = _cross(x, y, z, root[k, PHI], root[k, PHI + 1], root[k, PHI + 2])
        wx, wy, wz = _cross(x, y, z, ux, uy, uz)
        root[k, PHI] += b * ux + c * wx
        root[k, PHI + 1] += b * uy + c * wy
        root[k, PHI + 2] += b * uz + c * wz


def update(
    q_nb: Array, v_n: Array, lla: Array, x: Array, P: Array, z: Array, h: Callable[[Points], Array], R: Array,
    H: Array | None = None, scaling: Scaling | None = None, threshold: float = math.inf,
) -> tuple[Array, Array, float]:  # fmt: skip
    """One measurement (``R`` finite) into the estimate and ``P`` if its nis is at most ``threshold``; (nu, S, nis).

    ``h`` gives the measurement at every point at once, (points, m): a plain function of arrays, or one that hands them
    to a kernel. Differences that wrap (headings) are its own affair: let it return them near ``z``. With an ``H``
    (m, n), as in `kalman.innovate`, the measurement is taken as linear in all but the attitude, whose columns in it
    are not used, and h is asked for 7 points instead of 2n + 1.
    """
    scaling = scaling or Scaling()
    root = factor(P, len(P))
    Z = h(points(q_nb, v_n, lla, x, root if H is None else root[:CURVED], scaling.spread))
    slope = np.zeros((len(z), len(P))) if H is None else H
    nu, S, A, R_curved, nis = innovate(Z, z, R, root, slope, scaling.spread, scaling.excess)
    if nis <= threshold:
        remove(q_nb, v_n, lla, x, correct(P, root, A, R_curved, R, nu))
    return nu, S, nis
