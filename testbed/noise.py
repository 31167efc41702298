"""Random processes, drawn ahead in batches of fixed size so that nothing depends on how a run is cut into blocks.

Every process of every sensor, and of the weather, has its own stream: adding one, or switching an error off, moves no
other number.
"""

from __future__ import annotations

import zlib

import numpy as np
import numpy.typing as npt

from nav._jit import njit
from nav.samples import Array

BATCH = 256  # rows drawn at a time


def stream(seed: int, sensor: str, process: str) -> np.random.Generator:
    """The random stream of one process of one sensor in the run with this seed.

    The names enter as CRC-32, which is the same on every machine and in every Python session.
    """
    key = (zlib.crc32(sensor.encode()), zlib.crc32(process.encode()))
    return np.random.default_rng(np.random.SeedSequence(entropy=seed, spawn_key=key))


@njit
def _recursion(x: Array, phi: Array, drive: Array, w: Array) -> None:
    """``x = phi x + drive w`` row by row, in place: ``w`` becomes the process and ``x`` its last row."""
    for k in range(w.shape[0]):
        for i in range(w.shape[1]):
            x[i] = phi[i] * x[i] + drive[i] * w[k, i]
            w[k, i] = x[i]


class Process:
    """Independent first-order processes side by side: x[k+1] = phi x[k] + drive w[k], w standard normal.

    ``white``, ``gauss_markov`` and ``random_walk`` choose phi and drive; columns may differ in size and time constant.
    """

    def __init__(self, rng: np.random.Generator, phi: Array, drive: Array, start: Array) -> None:
        self._rng = rng
        self._phi = phi
        self._drive = drive
        self._x = start
        self._batch = np.zeros((BATCH, len(phi)))
        self._used = BATCH
        self._silent = not (drive.any() or start.any())

    @classmethod
    def white(cls, rng: np.random.Generator, sigma: npt.ArrayLike) -> Process:
        """White noise with standard deviation ``sigma`` (m,)."""
        drive = np.array(sigma, dtype=float)
        return cls(rng, np.zeros_like(drive), drive, np.zeros_like(drive))

    @classmethod
    def gauss_markov(cls, rng: np.random.Generator, sigma: npt.ArrayLike, tau: npt.ArrayLike, dt: float) -> Process:
        """First-order Gauss-Markov, stationary from the start: phi = exp(-dt/tau), drive = sigma sqrt(1 - phi^2).

        ``sigma`` (m,), correlation time ``tau`` (m,) and step ``dt`` [s].
        """
        size = np.array(sigma, dtype=float)
        decay = dt / np.broadcast_to(np.asarray(tau, dtype=float), size.shape)
        drive = size * np.sqrt(-np.expm1(-2 * decay))
        return cls(rng, np.exp(-decay), drive, size * rng.standard_normal(len(size)))

    @classmethod
    def random_walk(cls, rng: np.random.Generator, density: npt.ArrayLike, dt: float) -> Process:
        """Random walk from zero that grows by ``density`` sqrt(t), density (m,) per sqrt(s)."""
        drive = np.array(density, dtype=float) * np.sqrt(dt)
        return cls(rng, np.ones_like(drive), drive, np.zeros_like(drive))

    def take(self, n: int) -> Array:
        """The next ``n`` rows (n, m)."""
        if self._silent:
            return np.zeros((n, len(self._x)))
        if n <= BATCH - self._used:
            self._used += n
            return self._batch[self._used - n : self._used].copy()
        rows = np.empty((n, len(self._x)))
        filled = 0
        while filled < n:
            if self._used == BATCH:
                self._rng.standard_normal(out=self._batch)
                _recursion(self._x, self._phi, self._drive, self._batch)
                self._used = 0
            count = min(n - filled, BATCH - self._used)
            rows[filled : filled + count] = self._batch[self._used : self._used + count]
            self._used += count
            filled += count
        return rows
