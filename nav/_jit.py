"""The one numba decorator: compiled once, cached on disk, same bits on every call."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

# Of numba, before it is loaded: LLVM's last level adds an eighth to the time of compilation, and no speed.
os.environ.setdefault("NUMBA_OPT", "2")

import numba

P = ParamSpec("P")
R = TypeVar("R")


def njit(function: Callable[P, R]) -> Callable[P, R]:
    """Compile ``function`` in nopython mode with an on-disk cache.

    It can be called from Python and from other such functions, but not handed over as a value: the wrapper which that
    would need is not compiled.

    fastmath stays off: reordered sums would make results depend on the machine's vector width.
    """
    compiled = numba.njit(cache=True, no_cfunc_wrapper=True)(function)  # type: ignore[call-overload]
    return cast("Callable[P, R]", compiled)


def embedded(function: Callable[P, R]) -> Callable[P, R]:
    """As `njit`, and repeated in the machine code of every kernel that calls it: where handing over arrays would show.

    For a function that is called from Python as well, or from several kernels.
    """
    return cast("Callable[P, R]", numba.njit(cache=True, forceinline=True)(function))


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """As `njit`, but compiled as part of the kernel that calls it: for a long function with one caller.

    Compiled by itself first, it would be compiled twice.
    """
    return cast("Callable[P, R]", numba.njit(cache=True, inline="always")(function))
