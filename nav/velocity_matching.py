"""The heading of what has no compass and is too slow for its course, by the accelerations that change its velocity.

Between two fixes the specific force, carried into the axes of one moment by the gyros, is the change of velocity less
gravity: a vector known in body axes and in n (Wu and Pan, Velocity/Position Integration Formula, Part I: Application to
In-Flight Coarse Alignment, IEEE Trans. Aerospace and Electronic Systems 49 (2), 2013). One pair is hardly more than
gravity, which tells no heading. Of several in a row, k = 1 ... K, what is not gravity does,

    y_k = C_n0 (exp(-[B_k b x]) s_k - A_k a) + T_k p,

with 0 the body axes at the beginning as the gyros carry them, s_k (3,) the push in these and y_k (3,) in n, A_k (3, 3)
the integral of C_0b over the pair and B_k from now back to its middle (negative), b and a the biases of gyros and
accelerometers: of small units they tilt 0 by degrees meanwhile; p (3,) is by what a receiver may be pulled away in n,
steadily, over T_k seconds. C_n0, b, a and p follow by least squares (Gauss-Newton), all but C_n0 with what is known of
them; the derivative by b is of first order in the turn. Where hardly more than gravity is felt, p can't be told from a
tilt.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nav.samples import Array

PAIRS, LEAST = 15, 8  # the last ones are used
STARTS, STEPS = 8, 5  # headings that it is tried from, steps from each
SIGMA_LIMIT = 0.25  # a heading that is known less well is none [rad]
EXPLAINED = 0.7
UNLIKE, ELSEWHERE = 16.0, 1.0  # by which a heading so far away must be worse, in squares of sigma [rad]
BETTER = 9.0  # times smaller than told residuals may show squares of sigma to be
DAMPING = 1e-6  # of a turn that nothing tells [1/rad^2]
AT_BEST = 0.15  # of a heading so found: latency and scale that nobody knows [rad]


class _Pair(NamedTuple):
    push_0: Array  # (3,) integral of specific force [m/s]
    over: Array  # (3, 3) integral of C_0b over the pair [s]
    before: Array  # (3, 3) the same from the beginning of the chain up to the middle of the pair
    lasts: float  # [s]
    push_n: Array  # (3,)
    sigma: float  # of any axis [m/s]


class Matched(NamedTuple):
    """An attitude, and how well it is known: its heading `AT_BEST` so."""

    C_nb: Array  # (3, 3)
    covariance: Array  # (3, 3) of its turn about the axes of n, by what residuals show [rad^2]


class _Fit(NamedTuple):
    cost: float
    level_cost: float  # of horizontal residuals, and of what was known of slow errors
    C_n0: Array
    covariance: Array  # (3, 3) of C_n0's turn [rad^2], if residuals are as told


class VelocityMatching:
    """Collects pairs of pushes, one after the other without a gap, until they tell a heading.

    ``gyro_sigma`` [rad/s] and ``accel_sigma`` [m/s^2] are those of the biases, ``pull_sigma`` [m/s^2] that of what a
    receiver may be pulled away by, each axis alike. It takes at least so many pairs, and a heading must explain the
    share ``explained`` of the squares of horizontal pushes, or they are the receiver's.
    """

    def __init__(
        self, gyro_sigma: float, accel_sigma: float, pull_sigma: float = 0.0, least: int = LEAST,
        explained: float = EXPLAINED,
    ) -> None:  # fmt: skip
        self._least, self._explained = least, explained
        known = np.maximum([gyro_sigma, accel_sigma, pull_sigma], 1e-9)
        self._weights = np.repeat([DAMPING, *known**-2], 3)
        self.forget()

    def forget(self) -> None:
        """Begin anew: the chain of attitudes is broken."""
        self._pairs: list[_Pair] = []
        self._C_0b, self._turned = np.eye(3), np.zeros((3, 3))  # of 0, the axes when it began

    @property
    def under_way(self) -> bool:
        """Whether there are pairs."""
        return bool(self._pairs)

    def add(self, C_1b: Array, push_1: Array, turned_1: Array, lasts: float, push_n: Array, sigma: float) -> None:
        """Add what was felt since the last pair, which ``lasts`` so long [s]: in the axes 1 at its beginning, to which
        ``C_1b`` turns those of now, the push (3,) [m/s] and the integral (3, 3) of C_1b [s]; in n, the change of
        velocity less gravity (3,) [m/s], of which ``sigma`` [m/s] is what any axis is wrong by. A pair of infinite
        sigma only carries the axes on.
        """
        over = self._C_0b @ turned_1
        if math.isfinite(sigma):
            self._pairs.append(_Pair(self._C_0b @ push_1, over, self._turned + 0.5 * over, lasts, push_n, sigma))
            del self._pairs[:-PAIRS]
        self._C_0b, self._turned = self._C_0b @ C_1b, self._turned + over

    def attitude(self, last: int = PAIRS) -> Matched | None:
        """That of now by so many of the ``last`` pairs, or None."""
        pairs = self._pairs[-last:]
        if len(pairs) < self._least:
            return None
        sigma = np.array([one.sigma for one in pairs])[:, None]
        level = float(np.sum((np.array([one.push_n[:2] for one in pairs]) / sigma) ** 2))
        if level * SIGMA_LIMIT**2 * BETTER < 1.0:  # not enough for it, whatever they fit
            return None
        fits = sorted((self._fit(pairs, 2 * math.pi * k / STARTS) for k in range(STARTS)), key=lambda one: one.cost)
        best = fits[0]
        shown = max(1 / BETTER, best.level_cost / (2 * len(pairs) - 5))  # over what was told
        C_nb = best.C_n0 @ self._C_0b
        others = [one.cost for one in fits if abs(_heading(one.C_n0 @ self._C_0b @ C_nb.T)) > ELSEWHERE]
        covariance = shown * best.covariance + np.diag([0.0, 0.0, AT_BEST**2])
        believed = (
            covariance[2, 2] <= SIGMA_LIMIT**2
            and best.level_cost <= (1 - self._explained) * level
            and min(others, default=math.inf) - best.cost >= UNLIKE * shown
        )
        return Matched(C_nb, covariance) if believed else None

    def _fit(self, pairs: Sequence[_Pair], heading: float) -> _Fit:
        """Least squares from this turn [rad] of what is level on."""
        f, over, before, lasts, y, sigma = (np.array(column) for column in zip(*pairs, strict=True))
        before, lasts, sigma = before - self._turned, lasts[:, None], sigma[:, None]
        pulled = lasts[:, None] * np.eye(3)
        C_n0 = _turn(np.array([0.0, 0.0, heading])) @ _between(f.sum(axis=0), y.sum(axis=0))
        slow = np.zeros(9)  # b, a and p
        for step in range(STEPS + 1):
            turned = _turned(f, -(before @ slow[:3]))
            found = (turned - over @ slow[3:6]) @ C_n0.T
            left = (y - found - lasts * slow[6:]) / sigma
            if step == STEPS:
                break
            by_biases = [C_n0 @ _skew(turned) @ before, -(C_n0 @ over)]
            J = np.concatenate([-_skew(found), *by_biases, pulled], axis=2) / sigma[:, None]
            N = np.einsum("kij,kil->jl", J, J) + np.diag(self._weights)
            known = self._weights * np.concatenate([np.zeros(3), slow])
            change = np.linalg.solve(N, np.einsum("kij,ki->j", J, left) - known)
            C_n0 = _turn(change[:3]) @ C_n0
            slow = slow + change[3:]
        prior = float(self._weights[3:] @ slow**2)
        return _Fit(
            float(np.sum(left**2)) + prior, float(np.sum(left[:, :2] ** 2)) + prior, C_n0, np.linalg.inv(N)[:3, :3]
        )


def _heading(C: Array) -> float:
    return math.atan2(C[1, 0], C[0, 0])


def _turn(angle: Array) -> Array:
    """exp([angle x]) (3, 3)."""
    return _turned(np.eye(3), np.broadcast_to(angle, (3, 3))).T


def _turned(v: Array, angle: Array) -> Array:
    """Vectors (K, 3) turned by angles (K, 3): Rodrigues' formula."""
    size = np.linalg.norm(angle, axis=1, keepdims=True)
    about = angle / np.maximum(size, 1e-12)
    along = np.sum(about * v, axis=1, keepdims=True)
    turned: Array = np.cos(size) * v + np.sin(size) * np.cross(about, v) + (1 - np.cos(size)) * along * about
    return turned


def _between(a: Array, b: Array) -> Array:
    """The shortest turn (3, 3) that takes the direction of ``a`` to that of ``b``."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    size = float(np.linalg.norm(axis))
    if size < 1e-9:  # alike, or opposite, where any axis across will do
        axis, size = np.cross(a, np.eye(3)[np.argmin(np.abs(a))]), 1.0
        axis /= np.linalg.norm(axis)
    return _turn(axis / size * math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b)))


def _skew(v: Array) -> Array:
    """[v x] (K, 3, 3) of vectors (K, 3)."""
    matrix = np.zeros((len(v), 3, 3))
    matrix[:, 2, 1], matrix[:, 0, 2], matrix[:, 1, 0] = v.T
    return matrix - matrix.transpose(0, 2, 1)
