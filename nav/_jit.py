"""The decorators of kernels: compiled once, cached on disk, same bits on every call."""

from __future__ import annotations

import atexit
import hashlib
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any, ParamSpec, TypeVar, cast

# Of numba, before it is loaded: LLVM's last level adds an eighth to the time of compilation, and no speed.
os.environ.setdefault("NUMBA_OPT", "2")

import numba
import numpy as np

P = ParamSpec("P")
R = TypeVar("R")


@cache
def _taken(name: str) -> frozenset[str]:
    """The modules of its own package and of this one that the module ``name``, its imports done, has something from."""
    roots = {name.partition(".")[0], __name__.partition(".")[0]}
    found = set()
    for value in vars(sys.modules[name]).values():
        origin = value.__name__ if isinstance(value, ModuleType) else getattr(value, "__module__", None)
        if not isinstance(origin, str) or origin.partition(".")[0] not in roots or origin not in sys.modules:
            continue
        if not (isinstance(value, ModuleType) and origin.startswith(f"{name}.")):  # a part, loaded by whomever
            found.add(origin)
    return frozenset(found)


@cache
def _state(name: str) -> tuple[str, int, int]:
    """Path, time and size of the file of a module."""
    source = str(sys.modules[name].__file__)
    state = os.stat(source)
    return source, state.st_mtime_ns, state.st_size


@cache
def _sources(name: str) -> str:
    """A digest of all that the kernels of the module ``name`` may be made of.

    That is its file, the files that it takes something from, and those that they do. A constant does not tell where it
    comes from, so its value counts.
    """
    found, waiting = {name}, [name]
    while waiting:
        new = _taken(waiting.pop()) - found
        found |= new
        waiting += new
    values = vars(sys.modules[name]).items()
    constants = sorted((key, repr(value)) for key, value in values if _constant(value))
    constants += sorted((key, repr(value.tolist())) for key, value in values if isinstance(value, np.ndarray))
    return hashlib.sha256(repr((sorted(map(_state, found)), constants)).encode()).hexdigest()


def _constant(value: object) -> bool:
    if isinstance(value, tuple):
        return all(map(_constant, value))
    return isinstance(value, bool | int | float | complex | str | bytes)


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


def _keep(index: Any, key: object, code: object) -> None:
    """Keep what was compiled for a signature: the code in a file of its own, and only then the index that names it.

    Numba does it the other way round, in numbered files. There an older version's code is found by who looks meanwhile,
    and by everybody after an interrupt in between; and two processes may take one number for two signatures.
    """
    name = index._data_name(int(hashlib.sha256(repr(key).encode()).hexdigest()[:12], 16))
    index._save_data(name, (index._version, index._source_stamp, code))
    index._save_index(index._load_index() | {key: name})


def _kept(index: Any, key: object) -> object:
    """What was kept for a signature, None unless it is of this version: another one may just be writing its own."""
    name = index._load_index().get(key)
    if name is None:
        return None
    try:
        version, stamp, code = index._load_data(name)
    except OSError:
        return None
    return code if (version, stamp) == (index._version, index._source_stamp) else None


def is_kept(kernel: Callable[..., Any]) -> bool:
    """Whether a kernel, as it is now, has been compiled before and can be loaded."""
    compiled: Any = kernel
    index = getattr(compiled._cache, "_cache_file", None)
    return index is not None and bool(index._load_index())


def _compiled(function: Callable[P, R], **options: Any) -> Callable[P, R]:
    """Compile with an on-disk cache that is good while all that it may be made of is what it was.

    Numba looks at a kernel's own file only, and not at those of the kernels that are part of it: after an update of one
    file the others would go on with what it was.
    """
    try:
        compiled: Any = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # nowhere to keep it: neither beside the source nor in the user's home
        try:
            _keep_for_now()
        except OSError:  # nor anywhere: each process compiles for itself
            return cast("Callable[P, R]", numba.njit(**options)(function))
        compiled = numba.njit(cache=True, **options)(function)
    index = compiled._cache._cache_file
    index._source_stamp = index._source_stamp, _sources(function.__module__)
    index.save, index.load = partial(_keep, index), partial(_kept, index)
    return cast("Callable[P, R]", compiled)


def njit(function: Callable[P, R]) -> Callable[P, R]:
    """Compile ``function`` in nopython mode with an on-disk cache.

    It can be called from Python and from other such functions, but not handed over as a value: the wrapper which that
    would need is not compiled.

    fastmath stays off: reordered sums would make results depend on the machine's vector width.
    """
    return _compiled(function, no_cfunc_wrapper=True)


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """As `njit`, but compiled as part of the kernel that calls it: for a long function with one caller.

    Compiled by itself first, it would be compiled twice. Also for what hands back a view, which `lean` kernels can call
    no other way.
    """
    return _compiled(function, inline="always")


def lean(function: Callable[P, R]) -> Callable[P, R]:
    """As `njit`, without counting the references to arrays, which takes a fifth of the time where these are small.

    For a kernel that makes no array, and neither hands one back nor calls what does; views are no arrays made. Numba
    refuses to compile one that makes an array, or calls what does and is not compiled yet.
    """
    return _compiled(function, no_cfunc_wrapper=True, _nrt=False)
