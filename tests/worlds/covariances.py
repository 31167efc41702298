"""Covariances that rounding makes indefinite, and those of a filter that has lost its position."""

import numpy as np

from nav.error_model import POS, VEL


def position_and_its_error(seed):
    """(P, H, R): a position lost by kilometres, its receiver's error as large, their sum known to half a millimetre."""
    rng = np.random.default_rng(seed)
    root = np.zeros((6, 4))  # velocity, another velocity, position, receiver's error, attitude, something else
    root[0, :2], root[2, :2] = 7 * rng.normal(size=2), 2000 * rng.normal(size=2)
    root[1, 0], root[4, :2], root[4, 3] = 3.0, 0.1 * rng.normal(size=2), 0.1
    root[3], root[5] = -root[2], rng.normal(size=4)
    root[3, 2] = 5e-4
    P = root @ root.T + np.diag([1e-2, 1e-2, 0.0, 1e-7, 1e-3, 1e-2])
    return P, np.array([[0.0, 0.0, 1.0, 1.0, 1.2, 0.0]]), np.array([2.5e-7])


def scaled_eigenvalues(P):
    sigma = np.sqrt(np.diag(P))
    return np.linalg.eigvalsh(P / np.outer(sigma, sigma))


def lost_position():
    """A Doppler filter with 10 m, and one that lost its transponder and drifted to 185 m, alike in all else."""
    sigma = np.r_[np.full(3, 1e-4), np.full(3, 0.05), np.full(3, 10.0), np.full(3, 5e-8), np.full(3, 2e-4)]
    other = sigma.copy()
    other[POS : POS + 3], other[VEL : VEL + 3] = 185.0, 0.3
    return np.stack([np.diag(sigma**2), np.diag(other**2)])
