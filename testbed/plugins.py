"""Classes of the user's: in a module, in a file beside the scenario, or by a name that an installed package gives."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import os
import sys
import sysconfig
import traceback
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.machinery import ModuleSpec
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from testbed.errors import UserError, printable, shown, unknown

# Packages that are not the user's to edit, and where our own are.
_INSTALLED = tuple(Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib", "purelib", "platlib"))
_HERE = (Path(__file__).resolve().parent, Path(__file__).resolve().parents[1] / "nav")


@cache
def installed(group: str) -> Mapping[str, str]:
    """The kinds that installed packages offer by entry points of a ``group``: name and ``module:Class``."""
    return {point.name: point.value for point in entry_points(group=group)}


def load(kind: str, folder: Path, group: str) -> Any:
    """The class that ``kind`` names: ``module:Class``, ``./file.py:Class`` seen from ``folder``, or an entry point.

    Raises UserError when it can't be had.
    """
    module, where, name = _named(kind, folder, group)
    if not hasattr(module, name):
        classes = [key for key, value in vars(module).items() if isinstance(value, type) and not key.startswith("_")]
        raise UserError(f"kind {shown(kind)}: {unknown(f'class in {where}', name, classes)}")
    _looked_at(module)
    return getattr(module, name)


def _named(kind: str, folder: Path, group: str) -> tuple[ModuleType, str, str]:
    """The module that ``kind`` names, and how; and the name of the class in it."""
    where, _, name = installed(group).get(kind, kind).rpartition(":")
    wrong = _misnamed(where, name)
    if wrong:
        raise UserError(f"kind {shown(kind)}: {wrong}")
    try:
        module = _file(folder / where) if where.endswith(".py") else importlib.import_module(where)
    except UserError:
        raise
    except ModuleNotFoundError as error:
        if error.name is not None and where.split(".")[0] != error.name.split(".")[0]:
            todo = _beside(folder / where, error.name) if where.endswith(".py") else ""
            raise UserError(f"kind {shown(kind)}: {where} can't be imported: {error.msg}{todo}") from error
        todo = f'install it, or give its file, such as "./{where.rpartition(".")[2]}.py:{name}"'
        raise UserError(f"kind {shown(kind)}: there is no module {where}: {todo}") from None
    except (Exception, SystemExit) as error:
        raise UserError(f"kind {shown(kind)}: {where} can't be imported: {raised(error)}") from error
    return module, where, name


def _misnamed(where: str, name: str) -> str:
    """What is wrong with a name as such; empty when nothing is."""
    if not where:
        return 'names no module: give a file, such as "./filters.py:Mine", or an installed module'
    if not name:
        return f'names no class: give it as "{where}:Mine"'
    if not where.endswith(".py") and ("/" in where or "\\" in where):
        return f'is a path without .py: give it as "{where}.py:{name}"'
    if where.startswith(".") and not where.endswith(".py"):
        file = f"./{where.lstrip('.')}.py:{name}"
        return f'has a dot in front: give the whole name of the module, or a file, such as "{file}"'
    return ""


def _beside(file: Path, missing: str) -> str:
    """What to do about a module that a file imports, where that lies beside it; empty where it does not."""
    beside = file.parent / missing.partition(".")[0]
    if not (beside.is_dir() or beside.with_suffix(".py").is_file()):
        return ""
    return f": a file beside it is not found: install both as a package, or set PYTHONPATH={file.parent.resolve()}"


def _file(path: Path) -> ModuleType:
    """The module in a file, the same one as long as the file is the same."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: can't be read: {error.strerror}: a path is relative to the scenario file") from None
    name = f"{path.stem}_{hashlib.sha256(os.fsencode(path.resolve()) + content).hexdigest()[:12]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None  # its name ends with .py
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def raised(error: BaseException) -> str:
    """What was raised and where, on one line: in the user's code if it can be told, not in what that calls."""
    found = traceback.extract_tb(error.__traceback__)
    frames = [frame for frame in found if not _lies(Path(frame.filename), _HERE)]
    theirs = [frame for frame in frames if not _lies(Path(frame.filename), _INSTALLED)]
    last = (theirs or frames)[-1:]
    at = f" ({Path(last[0].filename).name}, line {last[0].lineno})" if last else ""
    return f"{type(error).__name__}: {printable(str(error))}{at}"


def _lies(path: Path, places: Sequence[Path]) -> bool:
    return any(place in path.parents for place in places)


# --- what it is made of

_OURS = ("nav", "testbed")  # which the digest of the code has
_SEEN: dict[str, tuple[object, str]] = {}  # by module: its spec, which a reload makes anew, and the digest of its file


def digest(kind: str, folder: Path, group: str) -> str:
    """What tells the class that ``kind`` names from what it was before: the digest of its file and of those it imports.

    Of these there are all of its own package, and all others but installed packages; what they read nobody watches.
    Raises UserError as `load` does, and where a module was edited that this process goes on with as it was.
    """
    load(kind, folder, group)
    found = hashlib.sha256()
    for content in _contents(_named(kind, folder, group)[0]):
        found.update(hashlib.sha256(content).digest())
    return found.hexdigest()


@cache
def _looked_at(module: ModuleType) -> None:
    """Remember the files of a module as it was imported."""
    for _ in _contents(module):
        pass


def _contents(module: ModuleType) -> Iterator[bytes]:
    """The files of a module and of all that it imports, in the order of their import statements."""
    home = module.__name__.partition(".")[0]
    waiting, known = [module.__name__], {module.__name__}
    while waiting:
        name = waiting.pop(0)
        file = _source(name)
        if file is None:
            continue
        try:
            content = file.read_bytes()
        except OSError:  # it has gone since, or is in an archive
            continue
        _require_same(name, file, content)
        yield content
        for other in _imports(name, file, content):
            if other not in known and _is_own(other.partition(".")[0], home):
                known.add(other)
                waiting.append(other)


def _source(name: str) -> Path | None:
    """The file of a module; None where there is none."""
    spec = _spec(name)
    return Path(spec.origin) if spec is not None and spec.has_location and spec.origin else None


def _spec(name: str) -> ModuleSpec | None:
    """Where a module is found, imported already or not; None where it is not."""
    try:
        return sys.modules[name].__spec__ if name in sys.modules else importlib.util.find_spec(name)
    except Exception:  # no module, but a class in one, or a package that can't be imported
        return None


def _is_own(top: str, home: str) -> bool:
    """Whether a package is that of the class, or at least not installed."""
    if top in sys.stdlib_module_names or top in _OURS:
        return False
    spec = _spec(top)
    if top == home or spec is None:
        return top == home
    places = [*(spec.submodule_search_locations or ()), *([spec.origin] if spec.has_location and spec.origin else [])]
    return not any(_lies(Path(place).resolve(), _INSTALLED) for place in places)


def _imports(name: str, file: Path, content: bytes) -> Iterator[str]:
    """The modules that a module's import statements may mean, wherever they stand, with the packages they are in."""
    import ast

    if file.suffix != ".py":
        return
    package = name if file.name == "__init__.py" else name.rpartition(".")[0]
    named = [name]
    try:
        tree = ast.parse(content)
    except (SyntaxError, ValueError, RecursionError):  # of what is imported later, if at all
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            named += [one.name for one in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            within = ".".join([*above, *([node.module] if node.module else [])])
            named += [f"{within}.{one.name}" for one in node.names]
    for one in named:
        parts = one.split(".")
        yield from (".".join(parts[: k + 1]) for k in range(len(parts)))


def _require_same(name: str, file: Path, content: bytes) -> None:
    """Raises UserError when an imported module is no longer what its file says."""
    module = sys.modules.get(name)
    if module is None:
        return
    now = hashlib.sha256(content).hexdigest()
    spec, before = _SEEN.get(name, (None, ""))
    if spec is not module.__spec__:
        _SEEN[name] = module.__spec__, now
    elif before != now:
        raise UserError(f"{file}: has been edited since it was imported: start Python anew to fly what it says now")
