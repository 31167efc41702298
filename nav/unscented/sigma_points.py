"""Sigma points: how far out they lie, along which root of the covariance, and an error taken out of a state.

`nav.unscented` says what for.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from nav._jit import inlined, njit
from nav.earth import radii, wrap_longitude
from nav.error_model import MOTION, PHI, POS, VEL
from nav.matrix import LANES
from nav.rotation import rotation_coefficients
from nav.samples import Array

CURVED = 3  # error states in which the equations are not linear: the attitude's, which are the first
USUAL, USUAL_ROWS = 15, 6  # states and rows of a measurement for which loops are compiled as well: half of the time
FURTHER = 10  # numbers of a point before its further states: attitude, velocity, place
OWN = 29  # rows of a `scratch` beyond n that are for `predict`
GUARD = 1e-14  # of a variance, what rounding may have left of it at least


class Scaling(NamedTuple):
    """How far out the points lie: ``alpha`` from 0.1 to 1; ``beta`` for how the square of a normal error spreads.

    Of a quadratic along one direction the variance is exact with ``beta`` = 2 - 2 ``alpha``^2, which is 2 for small
    ``alpha``; with 2 it is claimed larger by 2 ``alpha``^2 times the square of the mean's shift.
    """

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


@inlined
def factor_into(root: Array, P: Array) -> None:
    """`factor` for kernels: into ``root`` (columns, n)."""
    if len(root) == CURVED and len(P) == USUAL:
        factor_sized(P, root, CURVED, USUAL)
    else:
        factor_sized(P, root, len(root), len(P))


@inlined
def factor_sized(P: Array, root: Array, columns: int, n: int) -> None:
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


def scratch(n: int, m: int = USUAL_ROWS, curved: int = CURVED) -> Array:
    """Room to work in, again and again: n states, m rows of a measurement, points along ``curved`` columns of L.

    The first n + `OWN` rows are for `predict`, and after it for `correct`; the others are for `innovate`. All are zero:
    what stands beside m columns is computed with, though not used, and subnormal numbers take four times as long.
    """
    return np.zeros((2 * n + OWN + 5 * m + 4 * curved + 3, max(n, m, LANES) + 1))


@inlined
def check(work: Array, n: int, m: int, curved: int) -> None:
    """Raise ValueError when ``work`` is smaller than `scratch` makes it for these sizes."""
    if len(work) < 2 * n + OWN + 5 * m + 4 * curved + 3 or work.shape[1] < max(n, m, LANES) + 1:
        raise ValueError("too little room to work in: make it by `scratch`")


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


@inlined
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


@inlined
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
