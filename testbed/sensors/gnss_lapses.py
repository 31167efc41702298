"""What receivers do beside noise: positions that jump, accuracies that come late, velocities that are old."""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np

from nav.samples import Array
from testbed.noise import Process, stream

VERTICAL = 1.5  # of a jump, over the horizontal ones: as of errors in general


class Jumps:
    """Offsets of the position that come at once, last for a while and go at once, as with other satellites or echoes.

    Jumps begin at random, ``per_h`` an hour; they are normal with ``size`` [m] along north and east and `VERTICAL`
    times that down, and last exponentially with the mean ``lasting`` [s]. A new one takes the place of the one before.
    ``take`` is asked for every epoch, ``dt`` [s] apart, once and in order.
    """

    def __init__(self, name: str, per_h: float, size: float, lasting: float, dt: float, seed: int) -> None:
        share = -math.expm1(-per_h * dt / 3600)
        self._begins_below = NormalDist().inv_cdf(share) if share else -math.inf
        on = 1.0 if share else 0.0
        self._draws = Process.white(stream(seed, name, "jumps"), [on, on, *np.array([1, 1, VERTICAL]) * size * on])
        self._lasting = lasting
        self._offset_n = np.zeros(3)
        self._until = -math.inf

    def take(self, t: Array) -> Array:
        """Offsets NED (n, 3) [m] at the epochs ``t`` (n,) [s]."""
        offsets_n = np.zeros((len(t), 3))
        if self._begins_below == -math.inf:
            return offsets_n
        for k, (now, (luck, length, *size)) in enumerate(
            zip(t.tolist(), self._draws.take(len(t)).tolist(), strict=True)
        ):
            if luck < self._begins_below:
                self._offset_n = np.array(size)
                self._until = now - self._lasting * math.log(NormalDist().cdf(length))
            if now < self._until:
                offsets_n[k] = self._offset_n
        return offsets_n


class Accuracy:
    """The accuracy that a receiver states, which follows that of what it tells with the time constant ``lag`` [s].

    ``sigma_n`` (m,) is what it states when nothing is the matter; variances follow, from epoch to epoch ``dt`` [s].
    """

    def __init__(self, sigma_n: Array, lag: float, dt: float) -> None:
        self._sigma_n = sigma_n
        self._gain = -math.expm1(-dt / lag)
        self._factors = np.ones(len(sigma_n))

    def stated(self, unsettled: float, offset_n: Array) -> Array:
        """What is stated (m,) at an epoch with errors ``unsettled`` times the usual and an offset (m,)."""
        true = unsettled**2 + (offset_n / self._sigma_n) ** 2
        self._factors += self._gain * (true - self._factors)
        stated: Array = self._sigma_n * np.sqrt(self._factors)
        return stated


class Older:
    """Velocities of ``ticks`` ago. ``of`` is given those of consecutive ticks; before the first it was as then."""

    def __init__(self, ticks: int) -> None:
        self.ticks = ticks
        self._past = np.empty((0, 3))

    def of(self, v_n: Array) -> Array:
        """For each of the velocities (n, 3) that of ``ticks`` before."""
        if len(v_n) and not len(self._past):
            self._past = np.repeat(v_n[:1], self.ticks, axis=0)
        series = np.vstack([self._past, v_n])
        self._past = series[len(v_n) :]
        return series[: len(v_n)]
