"""The master's arithmetic: how a federation fuses its filters' common states, and gives fused ones back to them.

Fusion is on the common states: the sub-block of P_i is taken, not that of its inverse, which marginalises the rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from nav._jit import njit
from nav.error_model import POS, VEL
from nav.kalman import keep_positive
from nav.samples import Array

Combination = Literal["information", "scalar", "covariance_intersection"]
Weigh: TypeAlias = Callable[[Array, int, Array], Array]  # as `weights_by_covariance`


class Master(NamedTuple):
    """The fused solution: what it would add to the nominal common states (m,), its covariance (m, m), the weights."""

    x: Array
    P: Array
    weights: Array


def combine(
    x: Array, P: Array, common: int, members: Array, combination: Combination, weigh: Weigh | None = None
) -> Master:
    """Fuse the common states of filters ``x`` (filters, n), ``P`` (filters, n, n); ``members`` (filters,) are 1 or 0.

    Information: ``P_g = (sum P_i^-1)^-1, x_g = P_g sum P_i^-1 x_i`` (Cui et al. 2022, Eq 10). Covariance intersection
    is the same with each P_i^-1 times w_i, sum w_i = 1. Scalar: ``x_g = sum w_i x_i`` (Zhu et al. 2020, Eq 14) with the
    bound ``P_g = sum w_i P_i``, which holds for any correlation. The w_i are those of `weights_by_covariance`, or of
    ``weigh``, which is handed the covariances of the common states (filters, common, common).
    """
    if combination == "information":
        return Master(*information(x, P, common, members), members)
    own = np.ascontiguousarray(P[:, :common, :common])  # on the way to an estimate there is nothing else in P
    weights = (weigh or weights_by_covariance)(own, common, members)
    if combination == "scalar":
        x_g, P_g = weights @ x[:, :common], np.tensordot(weights, P[:, :common, :common], 1)
    else:
        x_g, P_g = information(x, P, common, weights)
    return Master(x_g, P_g, weights)


def weights_by_covariance(P: Array, common: int, members: Array, shares: Array | None = None) -> Array:
    """Weights (filters,) that add up to one, from the traces of the position and the velocity block.

    ``w_i`` is the mean over the two blocks of ``(1 / tr P_i) / sum_j (1 / tr P_j)``, so no units are mixed. With
    ``shares`` the traces are those of beta_i P_i: what a filter was merely told must not raise its next share.
    """
    trace = np.array([[np.trace(p[b : b + 3, b : b + 3]) for b in (POS, VEL)] for p in P])
    if shares is not None:
        trace *= shares[:, None]
    better = members[:, None] / trace
    weights: Array = np.mean(better / better.sum(axis=0), axis=1)
    return weights


@njit
def information(x: Array, P: Array, common: int, weights: Array) -> tuple[Array, Array]:
    """(x_g, P_g) with ``P_g^-1 = sum w_i P_i^-1`` over the filters whose covariance is definite and w_i positive."""
    total, y = np.zeros((common, common)), np.zeros(common)
    for f in range(len(x)):
        if weights[f] > 0.0:
            inverse, definite = scaled_inverse(P[f], common)
            if definite:
                for i in range(common):
                    for j in range(common):
                        total[i, j] += weights[f] * inverse[i, j]
                        y[i] += weights[f] * inverse[i, j] * x[f, j]
    P_g, _ = scaled_inverse(total, common)
    x_g = np.zeros(common)
    for i in range(common):
        for j in range(common):
            x_g[i] += P_g[i, j] * y[j]
    return x_g, P_g


def blend(x: Array, P: Array, x_g: Array, P_g: Array, retention: float) -> tuple[Array, Array]:
    """(x, P) of the common states between a filter's own (0) and the shared ones (1), by weighted information."""
    common = len(x_g)
    both = np.stack([x[:common], x_g]), np.stack([P[:common, :common], P_g])
    return information(*both, common, np.array([1.0 - retention, retention]))


@njit
def reset(x: Array, P: Array, x_g: Array, P_g: Array) -> None:
    """Give a filter, ``x`` (n,) and ``P`` (n, n), new common states; what it knows of its aids *given* them stays.

    With G = P_ac P_cc^-1: ``x_a += G (x_g - x_c)``, ``P_ac = G P_g``, ``P_aa += G (P_g - P_cc) G'``. The errors of an
    aid depend on all other filters' measurements through the common states only, so this is Bayes' rule and no
    approximation, apart from the process noise over a step. Where the aid is known far better given the common states
    than by itself, rounding may take more than that: see `nav.kalman.keep_positive`.
    """
    n, common = len(x), len(x_g)
    inverse, _ = scaled_inverse(P, common)
    G, GD = np.zeros((n, common)), np.zeros((n, common))
    for a in range(common, n):
        if P[a, a] > 0.0:
            for j in range(common):
                for k in range(common):
                    G[a, j] += P[a, k] * inverse[k, j]
    for a in range(common, n):
        if P[a, a] > 0.0:
            for k in range(common):
                x[a] += G[a, k] * (x_g[k] - x[k])
                for j in range(common):
                    GD[a, j] += G[a, k] * (P_g[k, j] - P[k, j])
    for a in range(common, n):
        if P[a, a] > 0.0:
            for b in range(common, a + 1):
                total = 0.0
                for k in range(common):
                    total += GD[a, k] * G[b, k]
                P[a, b] += total
                P[b, a] = P[a, b]
            for j in range(common):
                P[a, j] += GD[a, j]
                P[j, a] = P[a, j]
    for i in range(common):
        x[i] = x_g[i]
        for j in range(common):
            P[i, j] = P_g[i, j]
    keep_positive(P)


@njit
def scaled_inverse(P: Array, common: int) -> tuple[Array, bool]:
    """Inverse (common, common) of the common block, and whether it was positive definite.

    By Gauss and Jordan in place, which needs no pivoting then, on the block scaled to a unit diagonal: the units of the
    states differ by 1e12.
    """
    A, scale = np.empty((common, common)), np.empty(common)
    for i in range(common):
        scale[i] = 1.0 / math.sqrt(P[i, i]) if P[i, i] > 0.0 else 0.0
    for i in range(common):
        for j in range(common):
            A[i, j] = P[i, j] * scale[i] * scale[j]
    for k in range(common):
        if not A[k, k] > 0.0:
            return A, False
        over = 1.0 / A[k, k]
        A[k, k] = 1.0
        for j in range(common):
            A[k, j] *= over
        for i in range(common):
            if i != k:
                a = A[i, k]
                A[i, k] = 0.0
                for j in range(common):
                    A[i, j] -= a * A[k, j]
    for i in range(common):
        for j in range(i + 1):
            A[i, j] = A[j, i] = 0.5 * (A[i, j] + A[j, i]) * scale[i] * scale[j]
    return A, True
