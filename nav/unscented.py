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

from nav._jit import embedded, inlined, njit
from nav.earth import radii, wrap_longitude
from nav.error_model import MOTION, PHI, POS, VEL
from nav.kalman import take_rest
from nav.matrix import LANES, multiply
from nav.rotation import SMALL_ANGLE_SQUARED, rotation_coefficients
from nav.samples import Array

CURVED = 3  # error states in which the equations are not linear: the attitude's, which are the first
USUAL, USUAL_ROWS = 15, 6  # states and rows of a measurement for which loops are compiled as well: half of the time
FURTHER = 10  # numbers of a point before its further states: attitude, velocity, place
OWN = 29  # rows of a `scratch` beyond n that are for `predict`
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
        """What the square of the mean's shift counts in the covariance.

        Raises ValueError when it is negative.
        """
        if self.alpha**2 > self.beta:
            raise ValueError(
                f"alpha {self.alpha} is more than the root of beta, {self.beta}: weights would be negative"
            )
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
    root = np.empty((columns, len(P)))
    factor_into(root, P)
    return root


@embedded
def factor_into(root: Array, P: Array) -> None:
    """`factor` for kernels: into ``root`` (columns, n)."""
    if len(root) == CURVED and len(P) == USUAL:
        _factor(P, root, CURVED, USUAL)
    else:
        _factor(P, root, len(root), len(P))


@inlined
def _factor(P: Array, root: Array, columns: int, n: int) -> None:
    """`factor` into ``root``, with sizes that may be known when it is compiled."""
    for j in range(columns):
        pivot = P[j, j]
        for k in range(j):
            pivot -= root[k, j] * root[k, j]
        pivot = max(pivot, GUARD * P[j, j], 0.0)
        per_pivot = math.sqrt(1 / pivot) if pivot > 0.0 else 0.0
        for i in range(j):
            root[j, i] = 0.0
        root[j, j] = pivot * per_pivot
        for i in range(j + 1, n):
            total = P[j, i]
            for k in range(j):
                total -= root[k, j] * root[k, i]
            root[j, i] = per_pivot * total


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


def scratch(n: int, m: int = USUAL_ROWS, curved: int = CURVED) -> Array:
    """Room to work in, again and again: n states, m rows of a measurement, points along ``curved`` columns of L.

    The first n + `OWN` rows are for `predict`, and after it for `correct`; the others are for `innovate`.
    """
    return np.empty((2 * n + OWN + 5 * m + 4 * curved + 3, max(n, m, LANES) + 1))


@inlined
def _check(work: Array, n: int, m: int, curved: int) -> None:
    if len(work) < 2 * n + OWN + 5 * m + 4 * curved + 3 or work.shape[1] < max(n, m, LANES) + 1:
        raise ValueError("too little room to work in: make it by `scratch`")


@embedded
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
    _check(work, len(P), 0, 0)
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
    _factor(P, root, CURVED, n)
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


@inlined
def _half_turn(x: float, y: float, z: float) -> tuple[float, float]:
    """The scalar part of the quaternion of exp([phi x]), phi = (x, y, z), and its vector part over phi."""
    quarter = 0.25 * (x * x + y * y + z * z)
    sinc, versine, _ = rotation_coefficients(quarter)
    return 1 - quarter * versine, 0.5 * sinc


@inlined
def _turn_into(out: Array, q: Array, w: float, x: float, y: float, z: float) -> None:
    """The unit quaternion (w, x, y, z) times ``q`` (4,) into ``out``, which may be q, made a unit one again."""
    a, b = w * q[0] - x * q[1] - y * q[2] - z * q[3], w * q[1] + x * q[0] + y * q[3] - z * q[2]
    c, d = w * q[2] - x * q[3] + y * q[0] + z * q[1], w * q[3] + x * q[2] - y * q[1] + z * q[0]
    unit = 1.5 - 0.5 * (a * a + b * b + c * c + d * d)  # a Newton step: rounding only is to be made good
    out[0], out[1], out[2], out[3] = unit * a, unit * b, unit * c, unit * d


@njit
def _per_metre(lat: float, h: float) -> tuple[float, float]:
    """What a metre north is of latitude, and a metre east of longitude [rad/m]."""
    R_M, R_N = radii(lat)
    return 1 / (R_M + h), 1 / ((R_N + h) * math.cos(lat))


@embedded
def remove(q_nb: Array, v_n: Array, lla: Array, x: Array, error: Array) -> None:
    """Take an ``error`` (n,), estimate minus truth, out of the estimate in place; the attitude's is of any size.

    ``q_nb`` is a unit quaternion but for rounding.
    """
    x_n, y_n, z_n = error[PHI], error[PHI + 1], error[PHI + 2]
    w, half = _half_turn(x_n, y_n, z_n)
    _turn_into(q_nb, q_nb, w, half * x_n, half * y_n, half * z_n)
    per_north, per_east = _per_metre(lla[0], lla[2])
    for i in range(3):
        v_n[i] -= error[VEL + i]
    lla[0] -= error[POS] * per_north
    lla[1] = wrap_longitude(lla[1] - error[POS + 1] * per_east)
    lla[2] += error[POS + 2]
    for i in range(MOTION, len(x)):
        x[i] -= error[i]


@embedded
def points_into(found: Array, q_nb: Array, v_n: Array, lla: Array, x: Array, root: Array, spread: float) -> None:
    """`points` for kernels: rows of q_nb, v_n, lla, x into ``found`` (2 columns + 1, FURTHER + n)."""
    if len(root) == CURVED and len(x) == USUAL:
        _points(found, q_nb, v_n, lla, x, root, spread, CURVED, USUAL)
    else:
        _points(found, q_nb, v_n, lla, x, root, spread, len(root), len(x))


@inlined
def _points(
    found: Array, q_nb: Array, v_n: Array, lla: Array, x: Array, root: Array, spread: float, columns: int, n: int
) -> None:  # fmt: skip
    """`points_into`, with sizes that may be known when it is compiled: `remove` of 0, of + and of - spread times L."""
    per_north, per_east = _per_metre(lla[0], lla[2])
    for i in range(4):
        found[0, i] = q_nb[i]
    for i in range(3):
        found[0, 4 + i], found[0, 7 + i] = v_n[i], lla[i]
    for i in range(n):
        found[0, FURTHER + i] = x[i]
    for k in range(columns):
        ahead, behind, column = found[1 + k], found[1 + columns + k], root[k]
        x_n, y_n, z_n = spread * column[PHI], spread * column[PHI + 1], spread * column[PHI + 2]
        w, half = _half_turn(x_n, y_n, z_n)
        _turn_into(ahead, q_nb, w, half * x_n, half * y_n, half * z_n)
        _turn_into(behind, q_nb, w, -half * x_n, -half * y_n, -half * z_n)
        for i in range(3):
            d = spread * column[VEL + i]
            ahead[4 + i], behind[4 + i] = v_n[i] - d, v_n[i] + d
        d = spread * column[POS] * per_north
        ahead[7], behind[7] = lla[0] - d, lla[0] + d
        d = spread * column[POS + 1] * per_east
        ahead[8], behind[8] = wrap_longitude(lla[1] - d), wrap_longitude(lla[1] + d)
        d = spread * column[POS + 2]
        ahead[9], behind[9] = lla[2] + d, lla[2] - d
        for i in range(MOTION):
            ahead[FURTHER + i] = behind[FURTHER + i] = x[i]
        for i in range(MOTION, n):
            d = spread * column[i]
            ahead[FURTHER + i], behind[FURTHER + i] = x[i] - d, x[i] + d


def points(q_nb: Array, v_n: Array, lla: Array, x: Array, root: Array, spread: float) -> Points:
    """The candidates for the truth around an estimate along the columns of L in ``root`` (columns, n): see `factor`."""
    found = np.empty((2 * len(root) + 1, FURTHER + len(x)))
    points_into(found, q_nb, v_n, lla, x, root, spread)
    return Points(found[:, :4], found[:, 4:7], found[:, 7:FURTHER], found[:, FURTHER:])


@embedded
def innovate(
    P: Array, Z: Array, z: Array, R: Array, root: Array, H: Array, work: Array, spread: float, excess: float
) -> tuple[Array, Array, Array, float]:
    """(nu, S, W, nis) of a measurement ``z`` (m,) with variances ``R`` from ``Z`` (2 k + 1, m) at the points.

    The points lie along the first k columns of L (``root`` (k, n) by `factor`, ``P`` (n, n) = L L'); along the others
    the measurement is linear, with ``H`` (m, n) as in `kalman.innovate`, whose first k columns are not used: in its
    H P there are those that have the slopes which the points found, H L_j = -a_j.

    nu = z - mean; S = H P H' + diag(R) and what the curvature adds to R; S = D D', D lower triangular; W = D^-1 (H P,
    -nu) (m, n + 1 or wider) for `correct`; nis = nu' S^-1 nu, NaN when rounding has left S not positive definite. All
    three arrays are parts of ``work``, a `scratch`. Raises ValueError when that is too small.
    """
    _check(work, len(P), len(z), len(root))
    if len(P) == USUAL and len(z) == USUAL_ROWS and len(root) == CURVED:
        return _innovate(P, Z, z, R, root, H, work, spread, excess, USUAL, USUAL_ROWS, CURVED)
    return _innovate(P, Z, z, R, root, H, work, spread, excess, len(P), len(z), len(root))


@inlined
def _innovate(
    P: Array, Z: Array, z: Array, R: Array, root: Array, H: Array, work: Array, spread: float, excess: float, n: int,
    m: int, curved: int,
) -> tuple[Array, Array, Array, float]:  # fmt: skip
    """`innovate`, with sizes that may be known when it is compiled."""
    wide, last, room = max(m, LANES), 2 * curved, work[n + OWN :]
    W, HP, L, inverse = room[:m], room[m : 2 * m], room[2 * m : 3 * m], room[3 * m : 4 * m]
    S, nu, rows, none = room[4 * m : 5 * m], room[5 * m], room[5 * m + 1 :], work[:0]
    HT, left, right = rows[:n], rows[n : n + last + 1], rows[n + last + 1 : n + 2 * last + 2]
    per_spread = 1 / spread
    half = 0.5 * per_spread
    for i in range(m):
        base, shift = Z[0, i], 0.0
        for j in range(curved):
            ahead, behind = Z[1 + j, i] - base, Z[1 + curved + j, i] - base
            bend = half * (ahead + behind)
            left[j, i] = half * (behind - ahead)
            left[curved + j, i] = right[curved + j, i] = bend
            shift += bend
        shift *= per_spread
        left[last, i], right[last, i] = excess * shift, shift
        nu[i] = z[i] - base - shift
        for j in range(curved, n):
            HT[j, i] = H[i, j]
    # of the rows of P, what lies along the first columns is replaced: by the slope less the linear share
    share = right[:curved]
    multiply(share, root, HT, curved, n, none, HT, wide)
    for k in range(curved):
        for i in range(m):
            share[k, i] = left[k, i] - share[k, i]
    multiply(HP, H, P, curved, n, share, root, n)
    multiply(S, HP, HT, curved, n, left, right, wide)
    for i in range(m):
        HP[i, n] = -nu[i]
        S[i, i] += R[i]

    # S = L diag(d) L', in which no root stands in the way of the next pivot; L d is kept above L
    for i in range(m):
        pivot = S[i, i]
        for k in range(i):
            c = S[i, k]
            S[k, i] = c
            for j in range(k):
                c -= L[j, i] * L[k, j]
            L[k, i] = c
            L[i, k] = c * L[k, k]
            pivot -= c * L[i, k]
        L[i, i] = 1 / pivot if pivot > GUARD * S[i, i] else math.nan
        for k in range(m):
            inverse[i, k] = 1.0 if k == i else 0.0
        for k in range(i):
            for j in range(k + 1):
                inverse[i, j] -= L[i, k] * inverse[k, j]
    for i in range(m):
        c = math.sqrt(L[i, i])
        for k in range(i + 1):
            inverse[i, k] *= c
    multiply(W, inverse, HP, 0, m, none, HP, n + 1)
    nis = 0.0
    for i in range(m):
        nis += W[i, n] * W[i, n]
    return nu[:m], S[:, :m], W, nis


@embedded
def correct(P: Array, W: Array, work: Array) -> Array:
    """Update ``P`` in place and return the mean error (n,) found, for `remove`; ``W`` = D^-1 (H P, -nu) by `innovate`.

    mean = W_P' w,  P <- P - TAKEN W_P' W_P,  with W = (W_P, w)

    which leaves as much as rounding may have taken too much; then the attitude's part is turned into the axes of the
    corrected estimate, phi <- J_l(mean phi) (phi - mean phi). ``work`` is a `scratch`, part of which is the mean
    until it is used again. Raises ValueError when that is too small.
    """
    _check(work, len(P), 0, 0)
    if len(P) == USUAL and len(W) == USUAL_ROWS:
        return _correct(P, W, work, USUAL, USUAL_ROWS)
    return _correct(P, W, work, len(P), len(W))


@inlined
def _correct(P: Array, W: Array, work: Array, n: int, m: int) -> Array:
    """`correct`, with sizes that may be known when it is compiled."""
    taken = work.ravel()[: (n + 1) * n].reshape((n + 1, n))
    multiply(taken, W, W, 0, 0, W, W, n)
    left, less = P.reshape(n * n), taken.reshape(n * n + n)
    mean: Array = taken[n]
    for i in range(n * n):
        left[i] -= TAKEN * less[i]
    _turn(P, mean, n)
    return mean


@inlined
def _turn(P: Array, error: Array, n: int) -> None:
    """J P J' for the attitude's part of ``P``, with J = J_l(phi) = I + b [phi x] + c [phi x]^2 and phi of ``error``."""
    x, y, z = error[PHI], error[PHI + 1], error[PHI + 2]
    _, b, c = rotation_coefficients(x * x + y * y + z * z)
    xx, xy, xz = 1 - c * (y * y + z * z), c * x * y - b * z, c * x * z + b * y
    yx, yy, yz = c * x * y + b * z, 1 - c * (x * x + z * z), c * y * z - b * x
    zx, zy, zz = c * x * z - b * y, c * y * z + b * x, 1 - c * (x * x + y * y)
    for j in range(n):
        u, v, w = P[0, j], P[1, j], P[2, j]
        P[0, j], P[1, j], P[2, j] = xx * u + xy * v + xz * w, yx * u + yy * v + yz * w, zx * u + zy * v + zz * w
    for i in range(3):
        u, v, w = P[i, 0], P[i, 1], P[i, 2]
        P[i, 0], P[i, 1], P[i, 2] = xx * u + xy * v + xz * w, yx * u + yy * v + yz * w, zx * u + zy * v + zz * w
    P[1, 0], P[2, 0], P[2, 1] = P[0, 1], P[0, 2], P[1, 2]
    for j in range(3, n):
        P[j, 0], P[j, 1], P[j, 2] = P[0, j], P[1, j], P[2, j]


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
    work = scratch(len(P), len(z), len(root))
    nu, S, W, nis = innovate(P, Z, z, R, root, slope, work, scaling.spread, scaling.excess)
    if nis <= threshold:
        remove(q_nb, v_n, lla, x, correct(P, W, work))
    return nu.copy(), S.copy(), nis
