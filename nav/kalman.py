"""The Kalman filter's three steps on a symmetric covariance, in place and without dense matrices of the full size.

Errors are estimate minus truth: a measurement ``z = h(x) + noise`` has the innovation ``nu = z - h(x_hat)``, and
``H = dh/dx`` at the estimate. `correct` returns what must be *added* to the estimate.
"""

from __future__ import annotations

import math

import numpy as np

from nav._jit import njit
from nav.samples import Array


@njit
def predict(P: Array, Phi: Array, decay: Array, half_noise: Array, work: Array) -> None:
    """P <- T P T' + Q, where T = [Phi 0; 0 diag(decay)] in place on ``P`` (n, n).

    ``Phi`` (r, c) holds the first r rows, zero beyond column c; ``decay`` (n,) the diagonal of the others (its first r
    entries are not used); ``half_noise`` (n,) is half the variance that each state's white noise adds over the step.
    Adding one half before and one half after is the trapezoid of the integral that defines Q; ``work`` (r, n) is
    scratch.
    """
    n = len(P)
    rows, columns = Phi.shape
    for i in range(n):
        P[i, i] += half_noise[i]
    for i in range(rows):
        for j in range(n):
            work[i, j] = 0.0
        for k in range(columns):
            a = Phi[i, k]
            if a != 0.0:
                for j in range(n):
                    work[i, j] += a * P[k, j]
    for i in range(rows):
        for j in range(i, rows):
            total = 0.0
            for k in range(columns):
                total += work[i, k] * Phi[j, k]
            P[i, j] = P[j, i] = total
        for j in range(rows, n):
            P[i, j] = P[j, i] = work[i, j] * decay[j]
    for i in range(rows, n):
        if decay[i] != 1.0:
            for j in range(rows, n):
                P[i, j] *= decay[i]
                P[j, i] = P[i, j] if j != i else P[i, j] * decay[i]
    for i in range(n):
        P[i, i] += half_noise[i]


@njit
def innovate(P: Array, H: Array, R: Array, nu: Array) -> tuple[Array, Array, Array, float]:
    """(S, S^-1, P H', nis) of an innovation ``nu`` (m,): S = H P H' + diag(R), nis = nu' S^-1 nu.

    ``H`` (m, n), variances ``R`` (m,). When rounding has left S not positive definite, nis is NaN.
    """
    m, n = H.shape
    S, PHt = np.zeros((m, m)), np.zeros((n, m))
    for i in range(m):
        for k in range(n):
            a = H[i, k]
            if a != 0.0:
                for j in range(n):
                    PHt[j, i] += a * P[k, j]
    for i in range(m):
        for j in range(i, m):
            total = R[i] if i == j else 0.0
            for k in range(n):
                total += H[i, k] * PHt[k, j]
            S[i, j] = S[j, i] = total
    S_inverse, definite = invert(S)
    nis = 0.0 if definite else math.nan
    for i in range(m):
        for j in range(m):
            nis += nu[i] * S_inverse[i, j] * nu[j]
    return S, S_inverse, PHt, nis


@njit
def invert(S: Array) -> tuple[Array, bool]:
    """Inverse of a symmetric positive definite ``S`` (m, m) by Cholesky, and whether it was positive definite."""
    m = len(S)
    L, inverse = np.zeros((m, m)), np.zeros((m, m))
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
                return inverse, False
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
    return inverse, True


@njit
def correct(P: Array, H: Array, R: Array, PHt: Array, S_inverse: Array, nu: Array) -> Array:
    """Update ``P`` in place and return K nu (n,), what to add to the estimate; K = P H' S^-1, in Joseph's form:

    P <- (I - K H) P (I - K H)' + K R K'

    It stays symmetric and positive for any gain, whatever rounding did to K. The other arguments as in `innovate`.
    """
    m, n = H.shape
    K, correction = np.zeros((n, m)), np.zeros(n)
    for i in range(n):
        for j in range(m):
            for k in range(m):
                K[i, j] += PHt[i, k] * S_inverse[k, j]
            correction[i] += K[i, j] * nu[j]
    # left = (I - K H) P, then P = left (I - K H)' + K R K'
    left_Ht = np.zeros((n, m))
    for i in range(n):
        for k in range(m):
            a = K[i, k]
            for j in range(n):
                P[i, j] -= a * PHt[j, k]
        for k in range(m):
            for j in range(n):
                left_Ht[i, k] += P[i, j] * H[k, j]
    for i in range(n):
        for j in range(i, n):
            total = P[i, j]
            for k in range(m):
                total += (K[i, k] * R[k] - left_Ht[i, k]) * K[j, k]
            P[i, j] = P[j, i] = total
    return correction
