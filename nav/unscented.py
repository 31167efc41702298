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

Measurement. Along all directions but those three it is linear, so that neither the rest of L nor a Jacobian in the
attitude is needed: P, less what the three columns have of it, gives the covariance with the measurement there.

Time update. Only the attitude is bent by the motion, so only the three columns of L that move it need a function; all
else the linear step carries. Their function is the error model for large misalignment
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
from nav._jit import inlined, njit
from nav.earth import radii, wrap_longitude
from nav.error_model import MOTION, PHI, POS, VEL
from nav.rotation import rotation_coefficients
from nav.samples import Array

CURVED = 3  # error states in which the equations are not linear: the attitude's, which are the first
HALF_TURN2 = math.pi**2
GUARD = 1e-14  # of a variance, what rounding may have left of it at least
TAKEN = 1 - GUARD  # of what a measurement takes from the covariance


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
        c = 1 / pivot if pivot > 0.0 else 0.0
        for i in range(j + 1, n):
            root[j, i] *= c
    return root


@njit
def _cross(ux: float, uy: float, uz: float, vx: float, vy: float, vz: float) -> tuple[float, float, float]:
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@inlined
def _carry(linear: Array, odd: Array, even: Array, e: Array, Phi: Array, push_n: Array, T: float, s: float) -> None:
    """What a column ``e`` of L becomes over ``T`` seconds, all (9,) or longer: ``linear`` is ``Phi @ e``.

    ``odd`` and ``even`` are what the errors ``+-s e`` become beyond that, over s, in parts odd and even in e.
    """
    dx = dy = dz = gx = gy = gz = px = py = pz = 0.0
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
    linear[PHI], linear[PHI + 1], linear[PHI + 2] = dx + gx, dy + gy, dz + gz
    linear[VEL], linear[VEL + 1], linear[VEL + 2] = px, py, pz
    linear[POS], linear[POS + 1], linear[POS + 2] = 0.0, 0.0, 0.0
    for third in range(3):
        i, known = 3 * third, (PHI + 3, MOTION, Phi.shape[1])[third]
        hx, hy, hz = linear[i], linear[i + 1], linear[i + 2]
        for j in range(known):
            hx += Phi[i, j] * e[j]
            hy += Phi[i + 1, j] * e[j]
            hz += Phi[i + 2, j] * e[j]
        linear[i], linear[i + 1], linear[i + 2] = hx, hy, hz

    x, y, z = s * e[PHI], s * e[PHI + 1], s * e[PHI + 2]
    fx, fy, fz = push_n[0] / s, push_n[1] / s, push_n[2] / s
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
def carry(e: Array, Phi: Array, push_n: Array, T: float) -> Array:
    """What an error ``e`` (n,) of any size becomes over ``T`` seconds: the motion's part (9,); see `predict`."""
    linear, odd, even = np.empty(MOTION), np.empty(MOTION), np.empty(MOTION)
    _carry(linear, odd, even, e, Phi, push_n, T, 1.0)
    for i in range(MOTION):
        linear[i] += odd[i] + even[i]
    return linear


@njit
def predict(
    P: Array, Phi: Array, decay: Array, half_noise: Array, work: Array, push_n: Array, T: float, spread: float,
    excess: float,
) -> Array:  # fmt: skip
    """Take ``P`` (n, n) in place over ``T`` seconds and return the mean error (n,) that arises, estimate minus truth.

    The first five arguments as in `kalman.predict`, with the Phi (9, columns) of `error_model.transition`; ``push_n``
    (3,) is the integral of the specific force in n [m/s], the row sums of the integral of C_nb diag(f_b); ``spread``
    and ``excess`` are of `Scaling`. The mean must be subtracted from the estimate.

    With l_j what the linear step makes of a column, o_j and b_j / s the parts of what it becomes beyond that,

        a_j a_j' = (l_j + o_j) (l_j + o_j)' = l_j l_j' + m_j o_j' + o_j m_j',  m_j = l_j + o_j / 2

    and the linear step of the whole P has the l_j l_j' and all that is not of these columns.
    """
    n = len(P)
    root, mean = factor(P, CURVED), np.zeros(n)
    kalman.predict(P, Phi, decay, half_noise, work)
    for k in range(CURVED):  # work has been used
        middle, odd, even = work[k], work[CURVED + k], work[2 * CURVED + k]
        _carry(middle, odd, even, root[k], Phi, push_n, T, spread)
        for i in range(MOTION):
            middle[i] += 0.5 * odd[i]
            mean[i] += even[i] / spread
        for i in range(MOTION, n):
            middle[i] = decay[i] * root[k, i]
            odd[i] = even[i] = 0.0
    for i in range(MOTION):
        a, b, c, d, e, f = work[0, i], work[1, i], work[2, i], work[3, i], work[4, i], work[5, i]
        g, h, p, shift = work[6, i], work[7, i], work[8, i], mean[i]
        for j in range(n):  # in pairs of the same bits for (i, j) and (j, i)
            first = (a * work[3, j] + d * work[0, j]) + (b * work[4, j] + e * work[1, j])
            second = (c * work[5, j] + f * work[2, j]) + (g * work[6, j] + h * work[7, j])
            P[i, j] += first + second + (p * work[8, j] + excess * (shift * mean[j]))
    for i in range(MOTION, n):
        for j in range(MOTION):
            P[i, j] = P[j, i]
    return mean


@njit
def _turned(q: Array, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """The unit quaternion of exp([phi x]) times ``q`` (4,), phi = (x, y, z)."""
    quarter = 0.25 * (x * x + y * y + z * z)
    sinc, versine, _ = rotation_coefficients(quarter)
    w, half = 1 - quarter * versine, 0.5 * sinc
    x, y, z = half * x, half * y, half * z
    a, b = w * q[0] - x * q[1] - y * q[2] - z * q[3], w * q[1] + x * q[0] + y * q[3] - z * q[2]
    c, d = w * q[2] - x * q[3] + y * q[0] + z * q[1], w * q[3] + x * q[2] - y * q[1] + z * q[0]
    unit = 1 / math.sqrt(a * a + b * b + c * c + d * d)
    return unit * a, unit * b, unit * c, unit * d


@njit
def _per_metre(lat: float, h: float) -> tuple[float, float]:
    """What a metre north is of latitude, and a metre east of longitude [rad/m]."""
    R_M, R_N = radii(lat)
    return 1 / (R_M + h), 1 / ((R_N + h) * math.cos(lat))


@njit
def remove(q_nb: Array, v_n: Array, lla: Array, x: Array, error: Array) -> None:
    """Take an ``error`` (n,), estimate minus truth, out of the estimate in place; the attitude's is of any size."""
    q_nb[0], q_nb[1], q_nb[2], q_nb[3] = _turned(q_nb, error[PHI], error[PHI + 1], error[PHI + 2])
    per_north, per_east = _per_metre(lla[0], lla[2])
    for i in range(3):
        v_n[i] -= error[VEL + i]
    lla[0] -= error[POS] * per_north
    lla[1] = wrap_longitude(lla[1] - error[POS + 1] * per_east)
    lla[2] += error[POS + 2]
    for i in range(MOTION, len(x)):
        x[i] -= error[i]


@njit
def _points(
    q_nb: Array, v_n: Array, lla: Array, x: Array, root: Array, spread: float
) -> tuple[Array, Array, Array, Array]:
    """`remove` of 0, of + and of - ``spread`` times each row of ``root``."""
    columns, n = root.shape
    size = 2 * columns + 1
    q, v, place, further = np.empty((size, 4)), np.empty((size, 3)), np.empty((size, 3)), np.empty((size, n))
    per_north, per_east = _per_metre(lla[0], lla[2])
    for k in range(size):
        row, s = (0, 0.0) if k == 0 else (k - 1, spread) if k <= columns else (k - 1 - columns, -spread)
        q[k, 0], q[k, 1], q[k, 2], q[k, 3] = _turned(
            q_nb, s * root[row, PHI], s * root[row, PHI + 1], s * root[row, PHI + 2]
        )
        for i in range(3):
            v[k, i] = v_n[i] - s * root[row, VEL + i]
        place[k, 0] = lla[0] - s * root[row, POS] * per_north
        place[k, 1] = wrap_longitude(lla[1] - s * root[row, POS + 1] * per_east)
        place[k, 2] = lla[2] + s * root[row, POS + 2]
        for i in range(n):
            further[k, i] = x[i] - s * root[row, i] if i >= MOTION else x[i]
    return q, v, place, further


def points(q_nb: Array, v_n: Array, lla: Array, x: Array, root: Array, spread: float) -> Points:
    """The candidates for the truth around an estimate along the columns of L in ``root`` (columns, n): see `factor`."""
    return Points(*_points(q_nb, v_n, lla, x, root, spread))


@njit
def innovate(
    P: Array, Z: Array, z: Array, R: Array, root: Array, H: Array, spread: float, excess: float
) -> tuple[Array, Array, Array, Array, float]:
    """(nu, S, D, H P, nis) of a measurement ``z`` (m,) with variances ``R`` from ``Z`` (2 k + 1, m) at the points.

    The points lie along the first k columns of L (``root`` (k, n) by `factor`, ``P`` (n, n) = L L'); along the others
    the measurement is linear, with ``H`` (m, n) as in `kalman.innovate`, whose first k columns are not used: in its
    ``H P`` there are those that have the slopes which the points found, H L_j = -a_j.

    nu = z - mean; S = H P H' + diag(R) and what the curvature adds to R; S = D D', D by `factor`; nis = nu' S^-1 nu,
    NaN when rounding has left S not positive definite.
    """
    curved, n, m = len(root), len(P), len(z)
    nu, S, HP = np.empty(m), np.empty((m, m)), np.zeros((m, n))
    slope, bend, part = np.empty((3, m, curved))
    per_spread = 1 / spread
    half = 0.5 * per_spread
    for i in range(m):
        shift = 0.0
        for j in range(curved):
            ahead, behind = Z[1 + j, i] - Z[0, i], Z[1 + curved + j, i] - Z[0, i]
            slope[i, j] = part[i, j] = half * (ahead - behind)
            bend[i, j] = half * (ahead + behind)
            shift += per_spread * bend[i, j]
        nu[i] = shift
        # of the rows of P, what lies along the first columns is replaced: ``part`` is the slope less the linear share
        for j in range(curved, n):
            h = H[i, j]
            if h != 0.0:
                for k in range(n):
                    HP[i, k] += h * P[j, k]
                for k in range(curved):
                    part[i, k] += h * root[k, j]
        for k in range(curved):
            a = part[i, k]
            for j in range(n):
                HP[i, j] -= a * root[k, j]
    for k in range(m):
        for i in range(k, m):
            S[i, k] = excess * nu[i] * nu[k]
            for j in range(curved):
                S[i, k] += bend[i, j] * bend[k, j] + slope[i, j] * part[k, j]
        S[k, k] += R[k]
        for j in range(curved, n):
            h = H[k, j]
            if h != 0.0:
                for i in range(k, m):
                    S[i, k] += h * HP[i, j]
        for i in range(k + 1, m):
            S[k, i] = S[i, k]
    D, nis = factor(S, m), 0.0
    for i in range(m):
        nu[i] = z[i] - Z[0, i] - nu[i]
    y = nu.copy()
    for i in range(m):
        y[i] *= 1 / D[i, i] if D[i, i] > math.sqrt(GUARD * S[i, i]) else math.nan
        nis += y[i] * y[i]
        for k in range(i + 1, m):
            y[k] -= D[i, k] * y[i]
    return nu, S, D, HP, nis


@njit
def correct(P: Array, nu: Array, D: Array, HP: Array) -> Array:
    """Update ``P`` in place and return the mean error (n,) found, for `remove`; the arguments as from `innovate`.

    With W = D^-1 H P and y = D^-1 nu

    mean = -W' y,  P <- P - TAKEN W' W

    which leaves as much as rounding may have taken too much; then the attitude's part is turned into the axes of the
    corrected estimate, phi <- J_l(mean phi) (phi - mean phi). ``HP`` is used up.
    """
    m, n = HP.shape
    y, mean = nu.copy(), np.zeros(n)
    W = np.zeros((6 * ((m + 5) // 6), n))
    for i in range(m):
        c = 1 / D[i, i]
        y[i] *= c
        for j in range(n):
            W[i, j] = c * HP[i, j]
            mean[j] -= y[i] * W[i, j]
        for k in range(i + 1, m):
            c = D[i, k]
            y[k] -= c * y[i]
            for j in range(n):
                HP[k, j] -= c * W[i, j]
    for sixth in range(len(W) // 6):
        k = 6 * sixth
        for i in range(n):
            a, b, c, d, e, f = W[k, i], W[k + 1, i], W[k + 2, i], W[k + 3, i], W[k + 4, i], W[k + 5, i]
            for j in range(n):
                first = a * W[k, j] + b * W[k + 1, j] + c * W[k + 2, j]
                P[i, j] -= TAKEN * (first + d * W[k + 3, j] + e * W[k + 4, j] + f * W[k + 5, j])
    _turn(P, mean)
    return mean


@inlined
def _turn(P: Array, error: Array) -> None:
    """J P J' for the attitude's part of ``P``, with J = J_l(phi) = I + b [phi x] + c [phi x]^2 and phi of ``error``."""
    x, y, z = error[PHI], error[PHI + 1], error[PHI + 2]
    _, b, c = rotation_coefficients(x * x + y * y + z * z)
    xx, xy, xz = 1 - c * (y * y + z * z), c * x * y - b * z, c * x * z + b * y
    yx, yy, yz = c * x * y + b * z, 1 - c * (x * x + z * z), c * y * z - b * x
    zx, zy, zz = c * x * z - b * y, c * y * z + b * x, 1 - c * (x * x + y * y)
    for j in range(len(P)):
        u, v, w = P[0, j], P[1, j], P[2, j]
        P[0, j], P[1, j], P[2, j] = xx * u + xy * v + xz * w, yx * u + yy * v + yz * w, zx * u + zy * v + zz * w
    for i in range(3):
        u, v, w = P[i, 0], P[i, 1], P[i, 2]
        P[i, 0], P[i, 1], P[i, 2] = xx * u + xy * v + xz * w, yx * u + yy * v + yz * w, zx * u + zy * v + zz * w
    for i in range(1, len(P)):
        for j in range(min(i, 3)):
            P[i, j] = P[j, i]


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
    root = factor(P, len(P) if H is None else CURVED)
    Z = h(points(q_nb, v_n, lla, x, root, scaling.spread))
    slope = np.zeros((len(z), len(P))) if H is None else H
    nu, S, D, HP, nis = innovate(P, Z, z, R, root, slope, scaling.spread, scaling.excess)
    if nis <= threshold:
        remove(q_nb, v_n, lla, x, correct(P, nu, D, HP))
    return nu, S, nis
