"""The decorators of kernels: compiled once, cached on disk, same bits on every call."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import ParamSpec, TypeVar, cast

# Of numba, before it is loaded: LLVM's last level adds an eighth to the time of compilation, and no speed.
os.environ.setdefault("NUMBA_OPT", "2")

import numba

P = ParamSpec("P")
R = TypeVar("R")


@cache
def _forget_stale(folder: Path, kernels: Path = Path(__file__).parent) -> None:
    """Remove the cached kernels of ``folder`` if a source in it or in ``kernels`` is not what they were compiled from.

    Numba looks at a kernel's own file only, and not at those of the kernels that are part of it: after an update of one
    file the others would go on with what it was.
    """
    sources = sorted({*folder.glob("*.py"), *kernels.glob("*.py")})
    now = "".join(f"{source.name} {source.stat().st_mtime_ns} {source.stat().st_size}\n" for source in sources)
    stamp = folder / "__pycache__" / "kernels.txt"
    try:
        if stamp.exists() and stamp.read_text() == now:
            return
        stamp.parent.mkdir(exist_ok=True)
        for index in stamp.parent.glob("*.nbi"):
            index.unlink(missing_ok=True)
        stamp.write_text(now)
    except OSError:
        return  # a folder that cannot be written to: numba caches elsewhere, and it is not updated in place


def njit(function: Callable[P, R]) -> Callable[P, R]:
    """Compile ``function`` in nopython mode with an on-disk cache.

    It can be called from Python and from other such functions, but not handed over as a value: the wrapper which that
    would need is not compiled.

    fastmath stays off: reordered sums would make results depend on the machine's vector width.
    """
    _forget_stale(Path(function.__code__.co_filename).parent)
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
