"""Coloured innovations: how much wider than white ones their sums are, learned while they are sound."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from nav._jit import njit
from nav.detection.base import whiten
from nav.samples import Array

MEMORY_S = 60.0  # over which it is learned
DELAY_S = 20.0  # until a sample counts: a fault that is found by then has taught nothing
PRIOR, PRIOR_S = 4.0, 30.0  # what it is taken for at first, and how many seconds of samples that weighs
LONGEST_S = 2.0  # that one sample may stand for
CLIP = 3.0  # of residuals, in sigma: one outlier is no colour
LARGEST_CORRELATION = 0.95


@dataclass
class LongRunVariance:
    """The long-run variance of whitened residuals r, at least 1: that of their sum over n, for large n.

    A detector that gathers evidence over samples takes them for white. In flight the errors of a model last for
    seconds, and a sum of n such residuals varies by more than n. Taken for a first-order autoregression with the
    variance c and the correlation rho of neighbours,

        V = max(1, c (1 + rho) / (1 - rho)),  rho = max(0, E[r_k' r_(k-1)] / E[r_k' r_k])

    and the detector is given V S in place of S, so that its sums vary as it thinks (Newey and West 1987 with this
    model for the sum of covariances). On white residuals V is 1 and nothing is lost; what slows detection then is the
    uncertainty of V and, in the first minute, what it is taken for before anything is known.
    """

    value: float = field(default=PRIOR, init=False)
    _square: float = field(default=PRIOR_S, init=False)  # sums over the memory: of r'r / m,
    _product: float = field(default=PRIOR_S * (PRIOR - 1.0) / (PRIOR + 1.0), init=False)  # of neighbours,
    _weight: float = field(default=PRIOR_S, init=False)  # and of seconds
    _waiting: deque[tuple[float, float, float, float]] = field(default_factory=deque, init=False)
    _last: Array = field(default_factory=lambda: np.zeros(0), init=False)
    _t: float = field(default=-math.inf, init=False)

    def widened(self, nu: Array, S: Array, t: float, sound: bool) -> Array:
        """V S (m, m) for an innovation ``nu`` (m,) at ``t`` [s], from which it learns if the sensor is ``sound``.

        Otherwise what has not counted yet is forgotten: it may be the beginning of the fault.
        """
        if len(self._last) != len(nu):
            self._last = np.zeros(len(nu))
        square, product = _products(nu, S, self._last)
        span, self._t = min(t - self._t, LONGEST_S), t
        if not sound:
            self._waiting.clear()
        elif math.isfinite(square):
            self._waiting.append((t, span, square, product))
        while self._waiting and self._waiting[0][0] <= t - DELAY_S:
            _, span, square, product = self._waiting.popleft()
            kept = math.exp(-span / MEMORY_S)
            self._square = kept * self._square + span * square
            self._product = kept * self._product + span * product
            self._weight = kept * self._weight + span
            rho = min(max(self._product / self._square, 0.0), LARGEST_CORRELATION)
            self.value = max(1.0, self._square / self._weight * (1.0 + rho) / (1.0 - rho))
        wide: Array = self.value * S
        return wide


@njit
def _products(nu: Array, S: Array, last: Array) -> tuple[float, float]:
    """(r'r, r'last) / m of the clipped whitened residual, which becomes ``last`` (m,); NaN when it can't be judged."""
    r, gamma2 = whiten(nu, S)
    square, product = 0.0, 0.0
    if not math.isfinite(gamma2):
        return math.nan, math.nan
    for i in range(len(nu)):
        own = min(max(r[0, i], -CLIP), CLIP)
        square += own * own
        product += own * last[i]
        last[i] = own
    return square / len(nu), product / len(nu)
