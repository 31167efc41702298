"""Products of small matrices against numpy's, and their order of summation bit by bit."""

import numpy as np
import pytest
from numba.core.errors import TypingError

from nav._jit import njit
from nav.matrix import LANES, add_symmetric, multiply
from nav.samples import Array


@njit
def product(out: Array, A: Array, B: Array, first: int, stop: int, C: Array, D: Array, columns: int) -> None:
    multiply(out, A, B, first, stop, C, D, columns)


@njit
def add(P: Array, C: Array, D: Array) -> None:
    add_symmetric(P, C, D)


@pytest.mark.parametrize("rows", [1, 2, 3, 5, 9])
@pytest.mark.parametrize("columns", [LANES, 9, 15, 16, 17, 25])
@pytest.mark.parametrize(("first", "stop"), [(0, 4), (1, 3), (2, 2)])
@pytest.mark.parametrize("terms", [0, 1, 3])
def test_is_the_sum_of_both_products(rows, columns, first, stop, terms):
    rng = np.random.default_rng(rows * columns + stop + terms)
    A, B = rng.normal(size=(rows, 4)), rng.normal(size=(4, columns))
    C, D = rng.normal(size=(terms, rows + 2)), rng.normal(size=(terms, columns))
    wide = np.full((rows, columns + 3), 7.0)
    product(wide, A, B, first, stop, C, D, columns)
    expected = A[:, first:stop] @ B[first:stop] + C[:, :rows].T @ D
    np.testing.assert_allclose(wide[:, :columns], expected, rtol=1e-12, atol=1e-13)
    assert (wide[:, columns:] == 7.0).all()


def test_sums_one_term_after_the_other():
    """The same bits as a loop in Python, also in rows of wider arrays: neither fused nor in another order."""
    rng = np.random.default_rng(0)
    work = 10.0 ** rng.uniform(-8, 8, (40, 19))
    A, B, C, D = work[:7, :15], work[7:22, :17], work[22:25, :15], work[25:28, :17]
    out = work[28:35, :17]
    expected = np.zeros((7, 17))
    for i in range(7):
        for j in range(17):
            for k in range(2, 15):
                expected[i, j] += A[i, k] * B[k, j]
            for k in range(3):
                expected[i, j] += C[k, i] * D[k, j]
    product(out, A, B, 2, 15, C, D, 17)
    np.testing.assert_array_equal(out, expected)


@pytest.mark.parametrize("n", [1, 6, LANES, 9, 15, 16, 17, 39])
@pytest.mark.parametrize("terms", [0, 1, 2, 6])
def test_adds_to_a_symmetric_matrix_one_term_after_the_other(n, terms):
    rng = np.random.default_rng(n + terms)
    C, root = 10.0 ** rng.uniform(-4, 4, (terms, n)), rng.normal(size=(n, n))
    D, P = C * rng.normal(size=(terms, 1)), root @ root.T
    P = np.tril(P) + np.tril(P, -1).T
    expected = P.copy()
    for i in range(n):
        for j in range(i, n):
            for k in range(terms):
                expected[i, j] += C[k, i] * D[k, j]
            expected[j, i] = expected[i, j]
    wide = np.full((n, n + 3), 7.0)
    wide[:, :n] = P
    add(wide[:, :n], C, D)
    np.testing.assert_array_equal(wide[:, :n], expected)
    assert (wide[:, n:] == 7.0).all()
    np.testing.assert_allclose(expected, P + C.T @ D, rtol=1e-10, atol=1e-9)


def test_what_it_cannot_multiply_is_refused():
    good, none = np.ones((9, 9)), np.ones((0, 9))
    with pytest.raises(ValueError, match="eight columns"):
        product(good.copy(), good, good, 0, 9, none, none, 7)
    for bad in (
        np.asfortranarray(np.ones((9, 8)).repeat(2, axis=1)),
        np.ones((9, 9), int),
        np.ones((9, 9), np.float32),
    ):
        with pytest.raises(TypingError, match="must have rows of float64"):
            product(good.copy(), bad, good, 0, 9, none, none, 9)
