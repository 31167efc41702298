"""The one numba decorator: compiled once, cached on disk, same bits on every call."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")


def njit(function: Callable[P, R]) -> Callable[P, R]:
    """Compile ``function`` in nopython mode with an on-disk cache.

    fastmath stays off: reordered sums would make results depend on the machine's vector width.
    """
    return cast("Callable[P, R]", numba.njit(cache=True)(function))
