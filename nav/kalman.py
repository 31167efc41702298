"""The Kalman filter's steps on a symmetric covariance, in place and without dense matrices of the full size.

Errors are estimate minus truth: a measurement ``z = h(x) + noise`` has the innovation ``nu = z - h(x_hat)``, and
``H = dh/dx`` at the estimate. `correct` returns what must be *added* to the estimate.
"""

from __future__ import annotations

import math

import numpy as np

from nav._jit import inlined, lean, njit
from nav.matrix import add_symmetric, multiply
from nav.samples import Array

CRITICAL = 1e9  # of the variance that a measurement is predicted with over its own: rounding may take all that is left
MARGIN = 1e-14  # by which a covariance scaled to a unit diagonal must be positive; its rounding errors are some 1e-16


@inlined
def predict(P: Array, Phi: Array, decay: Array, half_noise: Array, work: Array, first: int) -> None:
    """P <- T P T' + Q, where T = [Phi 0; 0 diag(decay)] in place on ``P`` (n, n).

    ``Phi`` (r, c) holds the first r rows, zero beyond column c; ``decay`` (n,) the diagonal of the others (its first r
    entries are not used); ``half_noise`` (n,) is half the variance that each state's white noise adds over the step.
    Adding one half before and one half after is the trapezoid of the integral that defines Q; ``work`` (r, n) or larger
    is scratch. Of the states beyond the ``first`` (at least eight and c; n for all) only the variances are found.
    """
    n = len(P)
    rows, columns = Phi.shape
    for i in range(n):
        P[i, i] += half_noise[i]
    multiply(work[:rows], Phi, P, 0, columns, work[:0], P, first)
    for i in range(rows):
        for j in range(i, rows):
            total = 0.0
            for k in range(columns):
                total += work[i, k] * Phi[j, k]
            P[i, j] = P[j, i] = total
        for j in range(rows, first):
            P[i, j] = work[i, j] * decay[j]
    take_rest(P, decay, rows, first)
    for i in range(first, n):
        P[i, i] = P[i, i] * decay[i] * decay[i]
    for i in range(n):
        P[i, i] += half_noise[i]


@inlined
def take_rest(P: Array, decay: Array, rows: int, n: int) -> None:
    """The part of P <- T P T' that `predict` leaves when it has the first ``rows``: the states that decay alone."""
    for i in range(rows, n):
        for j in range(rows):
            P[i, j] = P[j, i]
        if decay[i] != 1.0:
            for j in range(rows, n):
                P[i, j] *= decay[i]
                P[j, i] = P[i, j] if j != i else P[i, j] * decay[i]


@njit
def innovate(P: Array, H: Array, R: Array, nu: Array) -> tuple[Array, Array, Array, float]:
    """(S, S^-1, H P, nis) of an innovation ``nu`` (m,): S = H P H' + diag(R), nis = nu' S^-1 nu.

    ``H`` (m, n), variances ``R`` (m,). When rounding has left S not positive definite, nis is NaN.
    """
    m, n = H.shape
    S, HP, inverses = np.empty((m, m)), np.empty((m, n)), np.empty((2 * m, m))
    nis = innovate_in(P, H, R, nu, S, HP, inverses)
    return S, inverses[:m], HP, nis


@lean
def innovate_in(P: Array, H: Array, R: Array, nu: Array, S: Array, HP: Array, inverses: Array) -> float:
    """`innovate` into ``S`` (m, m), ``HP`` (m, n) and the first half of ``inverses`` (2 m, m); nis."""
    m, n = H.shape
    for i in range(m):
        for j in range(n):
            HP[i, j] = 0.0
        for k in range(n):
            a = H[i, k]
            if a != 0.0:
                for j in range(n):
                    HP[i, j] += a * P[k, j]
    for i in range(m):
        for j in range(i, m):
            total = R[i] if i == j else 0.0
            for k in range(n):
                if H[i, k] != 0.0:
                    total += H[i, k] * HP[j, k]
            S[i, j] = S[j, i] = total
    nis = 0.0 if _invert(S, inverses[:m], inverses[m:]) else math.nan
    for i in range(m):
        for j in range(m):
            nis += nu[i] * inverses[i, j] * nu[j]
    return nis


@njit
def update(x: Array, P: Array, H: Array, R: Array, nu: Array, threshold: float) -> tuple[Array, float]:
    """`innovate` and, if nis is at most ``threshold``, `correct` ``x`` (n,) and ``P`` (n, n) in place; (S, nis).

    The rows of ``P`` must be contiguous, here and in all that works on a covariance (`nav.matrix`): ValueError.
    """
    if P.strides[1] != P.itemsize:
        raise ValueError("the rows of P must be contiguous: numpy.ascontiguousarray makes them so")
    S, inverses, work = scratch(len(nu), len(x))
    return S, update_in(x, P, H, R, nu, threshold, S, inverses, work)


@inlined
def scratch(m: int, n: int) -> tuple[Array, Array, Array]:
    """S (m, m), and what `update_in` works in, of ``m`` measurements and ``n`` states; the latter may be larger."""
    return np.empty((m, m)), np.empty((2 * m, m)), np.empty((4 * m + 3 + n, n))


@lean
def update_in(
    x: Array, P: Array, H: Array, R: Array, nu: Array, threshold: float, S: Array, inverses: Array, work: Array
) -> float:
    """`update` in the arrays of `scratch`; nis."""
    m = len(nu)
    HP, correction = work[:m], work[4 * m + 1]
    nis = innovate_in(P, H, R, nu, S, HP, inverses)
    if nis <= threshold:
        critical = is_critical(P, H, R)
        _correct(P, H, R, inverses, nu, work)
        if critical:
            _keep_positive(P, work[4 * m + 2 :])
        for i in range(len(x)):
            x[i] += correction[i]
    return nis


@lean
def is_critical(P: Array, H: Array, R: Array) -> bool:
    """Whether rounding may leave ``P`` indefinite after an update by ``H`` (m, n) and variances ``R`` (m,).

    The states that a measurement sees may each be known so much worse than their sum (a position and the error of its
    receiver, say) that products with H cancel to less than their rounding; Joseph's form is then positive on paper
    only.
    """
    for i in range(len(R)):
        size = 0.0
        for j in range(len(P)):
            if H[i, j] != 0.0:
                size += abs(H[i, j]) * math.sqrt(abs(P[j, j]))
        if size * size > CRITICAL * R[i]:
            return True
    return False


@lean
def _is_positive(P: Array, share: float, work: Array) -> bool:
    """Whether ``P`` (n, n), each variance raised by a ``share`` of itself, is positive definite by a `MARGIN`.

    By Cholesky on ``P`` scaled to a unit diagonal: the units of the states differ by 1e12. Rows of zeros, states that
    are not in use, are left out. ``work`` (n + 1, n) or larger is scratch.
    """
    n = len(P)
    L, scale = work[1:], work[0]
    for i in range(n):
        if P[i, i] > 0.0:
            scale[i] = 1.0 / math.sqrt(P[i, i])
        else:
            scale[i] = 0.0
            for j in range(n):
                if P[i, j] != 0.0:
                    return False
    for i in range(n):
        for j in range(i + 1):
            total = 1.0 + share - MARGIN if i == j else P[i, j] * scale[i] * scale[j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i != j:
                L[i, j] = total / L[j, j]
            elif total > 0.0:
                L[i, i] = math.sqrt(total)
            else:
                return False
    return True


@njit
def keep_positive(P: Array) -> None:
    """Make ``P`` (n, n) positive definite, if it isn't, by raising its variances by a small share of themselves.

    The share is the least power of ten that does it, so that no more is claimed than is known. A variance that has
    become negative itself is given back its size, without correlations.
    """
    _keep_positive(P, np.empty((len(P) + 1, len(P))))


@lean
def _keep_positive(P: Array, work: Array) -> None:
    """`keep_positive`; ``work`` (n + 1, n) is scratch."""
    if _is_positive(P, 0.0, work):
        return
    n = len(P)
    for i in range(n):
        if P[i, i] <= 0.0:
            for j in range(n):
                if j != i:
                    P[i, j] = P[j, i] = 0.0
            P[i, i] = -P[i, i]
    share = MARGIN
    while share < 1.0 and not _is_positive(P, share, work):
        share *= 10.0
    for i in range(n):
        P[i, i] += share * P[i, i]


@njit
def invert(S: Array) -> tuple[Array, bool]:
    """Inverse of a symmetric positive definite ``S`` (m, m) by Cholesky, and whether it was positive definite."""
    inverse = np.empty_like(S)
    return inverse, _invert(S, inverse, np.empty_like(S))


@lean
def _invert(S: Array, inverse: Array, L: Array) -> bool:
    """`invert` into ``inverse``, zeros where it fails; ``L`` (m, m) is scratch."""
    m = len(S)
    for i in range(m):
        for j in range(m):
            inverse[i, j] = 0.0
    for i in range(m):
        for j in range(i + 1):
            total = S[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i != j:
                L[i, j] = total / L[j, j]
            elif total > 0.0:
                L[i, i] = math.sqrt(total)
            else:
                return False
    for column in range(m):
        # L y = e_column, then L' (column of the inverse) = y, in place
        for i in range(column, m):
            total = 1.0 if i == column else 0.0
            for k in range(column, i):
                total -= L[i, k] * inverse[k, column]
            inverse[i, column] = total / L[i, i]
        for i in range(m - 1, -1, -1):
            total = inverse[i, column]
            for k in range(i + 1, m):
                total -= L[k, i] * inverse[k, column]
            inverse[i, column] = total / L[i, i]
    return True


@njit
def correct(P: Array, H: Array, R: Array, HP: Array, S_inverse: Array, nu: Array) -> Array:
    """Update ``P`` in place and return K nu (n,), what to add to the estimate; K = P H' S^-1, in Joseph's form:

    P <- (I - K H) P (I - K H)' + K R K'

    It stays symmetric and positive for any gain, whatever rounding did to K. The other arguments as in `innovate`.
    """
    m, n = H.shape
    work = np.empty((4 * m + 2, n))
    work[:m] = HP
    _correct(P, H, R, S_inverse, nu, work)
    correction: Array = work[4 * m + 1]
    return correction


@inlined
def _correct(P: Array, H: Array, R: Array, S_inverse: Array, nu: Array, work: Array) -> None:
    """`correct` with H P in the first rows of ``work`` (4 m + 2, n), and K nu in its last."""
    m, n = H.shape
    right, left, column, correction = work[: 2 * m], work[2 * m : 4 * m], work[4 * m], work[4 * m + 1]
    HP, KT, factor = right[:m], right[m:], left[m:]  # K', so that every inner loop runs along a row
    for i in range(n):
        correction[i] = 0.0
    for j in range(m):
        for i in range(n):
            KT[j, i] = 0.0
        for k in range(m):
            for i in range(n):
                KT[j, i] += S_inverse[k, j] * HP[k, i]
        for i in range(n):
            correction[i] += KT[j, i] * nu[j]
            left[j, i] = -KT[j, i]
            factor[j, i] = KT[j, i] * R[j]
    # (I - K H) P (I - K H)' + K R K' = P - K H P + (K R - (P - K H P) H') K', by what H sees of P - K H P
    for j in range(n):
        seen = False
        for k in range(m):
            seen = seen or H[k, j] != 0.0
        if not seen:
            continue
        for i in range(n):
            column[i] = P[i, j]
        for k in range(m):
            a = HP[k, j]
            for i in range(n):
                column[i] += left[k, i] * a
        for k in range(m):
            h = H[k, j]
            if h != 0.0:
                for i in range(n):
                    factor[k, i] -= column[i] * h
    add_symmetric(P, left, right)
