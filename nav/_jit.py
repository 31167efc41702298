"""The decorators of kernels: compiled once, cached on disk, same bits on every call."""

from __future__ import annotations

import atexit
import hashlib
import logging
import os
import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

# Of numba, before it is loaded: LLVM's last level adds an eighth to the time of compilation, and no speed.
os.environ.setdefault("NUMBA_OPT", "2")

import numba

P = ParamSpec("P")
R = TypeVar("R")


@cache
def _sources(folder: Path) -> str:
    """A digest of name, time and size of every source in the package of ``folder`` and in this one."""
    while (folder.parent / "__init__.py").exists():
        folder = folder.parent
    sources = {*folder.rglob("[!.]*.py"), *Path(__file__).parent.rglob("[!.]*.py")}
    states = [(str(source), source.stat().st_mtime_ns, source.stat().st_size) for source in sorted(sources)]
    return hashlib.sha256(repr(states).encode()).hexdigest()


def _keep_for_now() -> None:
    """Keep kernels in a temporary folder, for this process and those that it starts, and say so."""
    folder = tempfile.mkdtemp(prefix="navigation-testbed-kernels-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    config: Any = numba.config
    os.environ["NUMBA_CACHE_DIR"] = config.CACHE_DIR = folder
    logging.getLogger("nav").warning(
        "nav: compiled kernels can't be kept in %s or in the home folder: every start compiles them anew; "
        "to keep them, set NUMBA_CACHE_DIR to a folder that can be written",
        Path(__file__).parent,
    )


def _compiled(function: Callable[P, R], **options: Any) -> Callable[P, R]:
    """Compile with an on-disk cache that is good while all sources are what they were.

    Numba looks at a kernel's own file only, and not at those of the kernels that are part of it: after an update of one
    file the others would go on with what it was.
    """
    try:
        compiled: Any = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # nowhere to keep it: neither beside the source nor in the user's home
        _keep_for_now()
        compiled = numba.njit(cache=True, **options)(function)
    index = compiled._cache._cache_file
    index._source_stamp = index._source_stamp, _sources(Path(function.__code__.co_filename).parent)
    return cast("Callable[P, R]", compiled)


def njit(function: Callable[P, R]) -> Callable[P, R]:
    """Compile ``function`` in nopython mode with an on-disk cache.

    It can be called from Python and from other such functions, but not handed over as a value: the wrapper which that
    would need is not compiled.

    fastmath stays off: reordered sums would make results depend on the machine's vector width.
    """
    return _compiled(function, no_cfunc_wrapper=True)


def embedded(function: Callable[P, R]) -> Callable[P, R]:
    """As `njit`, and repeated in the machine code of every kernel that calls it, where handing over arrays takes long.

    For a function that is called from Python as well, or from several kernels.
    """
    return _compiled(function, forceinline=True)


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """As `njit`, but compiled as part of the kernel that calls it: for a long function with one caller.

    Compiled by itself first, it would be compiled twice.
    """
    return _compiled(function, inline="always")
