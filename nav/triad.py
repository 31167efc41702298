"""TRIAD: the attitude that two pairs of vectors tell (Black, AIAA Journal 2 (1964) 1350)."""

from __future__ import annotations

import numpy as np

from nav.samples import Array

STEP = 1e-6  # of each input, relative, in the differences


def triad(primary_b: Array, second_b: Array, primary_n: Array, second_n: Array) -> Array:
    """C_nb (3, 3) that takes the first pair exactly and the second as nearly as that allows."""
    return _axes(primary_n, second_n) @ _axes(primary_b, second_b).T


def _axes(primary: Array, second: Array) -> Array:
    x = primary / np.linalg.norm(primary)
    y = np.cross(x, second)
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])


def attitude_jacobian(primary_b: Array, second_b: Array, primary_n: Array, second_n: Array, which: int) -> Array:
    """D phi / d (one of the four vectors), (3, 3), at the TRIAD attitude, by central differences."""
    vectors = [primary_b, second_b, primary_n, second_n]
    C = triad(*vectors)
    step = STEP * float(np.linalg.norm(vectors[which]))
    J = np.empty((3, 3))
    for axis in range(3):
        turned = []
        for sign in (1.0, -1.0):
            moved = [vector.copy() for vector in vectors]
            moved[which][axis] += sign * step
            turned.append(triad(*moved) @ C.T)
        skewed = (turned[0] - turned[1]) / (2 * step)  # = -[dphi x]
        J[:, axis] = -0.5 * np.array(
            [skewed[2, 1] - skewed[1, 2], skewed[0, 2] - skewed[2, 0], skewed[1, 0] - skewed[0, 1]]
        )
    return J
