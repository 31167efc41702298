"""A measurement at sigma points: its innovation, and what it corrects; see `nav.unscented`."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from nav._jit import inlined
from nav.error_model import PHI
from nav.matrix import LANES, multiply
from nav.rotation import rotation_coefficients
from nav.samples import Array
from nav.unscented.sigma_points import (
    CURVED,
    GUARD,
    OWN,
    USUAL,
    USUAL_ROWS,
    Points,
    Scaling,
    check,
    factor,
    points,
    remove,
    scratch,
)

TAKEN = 1 - GUARD  # of what a measurement takes from the covariance


@inlined
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
    check(work, len(P), len(z), len(root))
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


@inlined
def correct(P: Array, W: Array, work: Array) -> Array:
    """Update ``P`` in place and return the mean error (n,) found, for `remove`; ``W`` = D^-1 (H P, -nu) by `innovate`.

    mean = W_P' w,  P <- P - TAKEN W_P' W_P,  with W = (W_P, w)

    which leaves as much as rounding may have taken too much; then the attitude's part is turned into the axes of the
    corrected estimate, phi <- J_l(mean phi) (phi - mean phi). ``work`` is a `scratch`, part of which is the mean
    until it is used again. Raises ValueError when that is too small.
    """
    check(work, len(P), 0, 0)
    if len(P) == USUAL and len(W) == USUAL_ROWS:
        return _correct(P, W, work, USUAL, USUAL_ROWS)
    return _correct(P, W, work, len(P), len(W))


@inlined
def _correct(P: Array, W: Array, work: Array, n: int, m: int) -> Array:
    """`correct`, with sizes that may be known when it is compiled."""
    taken = work.reshape(work.size)[: (n + 1) * n].reshape((n + 1, n))
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
