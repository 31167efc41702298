"""Classes of the user's: in a module, in a file beside the scenario, or by a name that an installed package gives."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import os
import sys
import sysconfig
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from importlib.machinery import ModuleSpec, PathFinder
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numpy as np

from testbed.errors import UserError, printable, shown, unknown
from testbed.interrupts import INTERRUPTS

# Where Python's own modules are, and our own, and folders of packages that are not the user's to edit.
_STDLIB = tuple(Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib"))
_PACKAGES = {"site-packages", "dist-packages"}
_HERE = (Path(__file__).resolve().parent, Path(__file__).resolve().parents[1] / "nav")

T = TypeVar("T")


def confined(call: Callable[..., T], /, *given: Any, **options: Any) -> T:
    """What the user's code gives. Working folder and error state of NumPy, which are everybody's, are put back.

    Python tells an interrupt to the main thread: in another, as in that of a campaign's worker, one is an error as any.
    """
    folder = _working_folder()
    with np.errstate():
        try:
            return call(*given, **options)
        except KeyboardInterrupt as error:
            if threading.current_thread() is threading.main_thread():
                raise
            told = RuntimeError("KeyboardInterrupt, where nobody interrupted")
            raise told.with_traceback(error.__traceback__) from None
        finally:
            if folder and folder != _working_folder():
                os.chdir(folder)


def _working_folder() -> str:
    """Empty where it has been removed."""
    try:
        return os.getcwd()
    except OSError:
        return ""


@cache
def installed(group: str) -> Mapping[str, str]:
    """The kinds that installed packages offer by entry points of a ``group``: name and ``module:Class``."""
    return {point.name: point.value for point in entry_points(group=group)}


def _called(kind: str, group: str) -> str:
    """A kind, and the package that offers it where one does."""
    for point in entry_points(group=group, name=kind):
        if point.dist is not None:
            return f"kind {shown(kind)} of the package {shown(point.dist.name)}"
    return f"kind {shown(kind)}"


def load(kind: str, folder: Path, group: str) -> Any:
    """The class that ``kind`` names: ``module:Class``, ``./file.py:Class`` seen from ``folder``, or an entry point.

    Raises UserError when it can't be had.
    """
    module, where, name = _named(kind, folder, group)
    if not hasattr(module, name):
        classes = [key for key, value in vars(module).items() if _is_of(value, module) and not key.startswith("_")]
        raise UserError(f"{_called(kind, group)}: {unknown(f'class in {where}', name, classes)}")
    _looked_at(module)
    return getattr(module, name)


def _is_of(value: object, module: ModuleType) -> bool:
    """Whether it is a class of the module's own package, not one that it imports from elsewhere."""
    return isinstance(value, type) and value.__module__.partition(".")[0] == module.__name__.partition(".")[0]


def _named(kind: str, folder: Path, group: str) -> tuple[ModuleType, str, str]:
    """The module that ``kind`` names, and how; and the name of the class in it."""
    where, _, name = installed(group).get(kind, kind).rpartition(":")
    wrong = _misnamed(where, name)
    if wrong:
        raise UserError(f"{_called(kind, group)}: {wrong}")
    try:
        found = (_file, folder / where) if where.endswith(".py") else (importlib.import_module, where)
        module = confined(*found)
    except UserError as error:
        raise UserError(f"{_called(kind, group)}: {error}") from None
    except ModuleNotFoundError as error:
        if error.name is not None and where.split(".")[0] != error.name.split(".")[0]:
            todo = _beside(folder / where, error.name) if where.endswith(".py") else ""
            raise UserError(f"{_called(kind, group)}: {where} can't be imported: {error.msg}{todo}") from error
        todo = f'install it, or give its file, such as "./{where.rpartition(".")[2]}.py:{name}"'
        raise UserError(f"{_called(kind, group)}: there is no module {where}: {todo}") from None
    except INTERRUPTS:
        raise
    except BaseException as error:
        raise UserError(f"{_called(kind, group)}: {where} can't be imported: {raised(error)}") from error
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


# Dimensions in the record that have labels (`testbed.record.columns`), and times: no column or group can be called so.
DIMENSIONS = {"time", "sample_time", "ned", "body", "north_east", "cross", "fix_part", "body_xy", "quaternion",
              "inertial_quaternion", "surface", "command", "error", "error_column", "element"}  # fmt: skip


def can_be_name(name: object) -> bool:
    """Whether a group or a column of the record can be called so."""
    return isinstance(name, str) and bool(name.strip(".")) and "/" not in name and name.isprintable()


def raised(error: BaseException) -> str:
    """What was raised and where, on one line: in the user's code if it can be told, not in what that calls."""
    found = [
        frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith("<frozen ")
    ]  # Python's own import
    frames = [frame for frame in found if not _lies(Path(frame.filename), _HERE)]
    theirs = [frame for frame in frames if not _is_installed(Path(frame.filename))]
    last = (theirs or frames)[-1:]
    at = f" ({Path(last[0].filename).name}, line {last[0].lineno})" if last else ""
    try:
        said = " ".join(str(error).split())  # pydantic's texts have several lines
    except Exception:
        said = "it can't be shown"
    return f"{type(error).__name__}: {printable(said)}{at}"


def _lies(path: Path, places: Sequence[Path]) -> bool:
    return any(place in path.parents for place in places)


def _is_installed(path: Path) -> bool:
    return _lies(path, _STDLIB) or not _PACKAGES.isdisjoint(path.parts)


# --- what it is made of

_NOT_THEIRS = {*sys.stdlib_module_names, "nav", "testbed"}  # the digest of the code has the last two
_SEEN: dict[str, tuple[object, str]] = {}  # by module: its spec, which a reload makes anew, and the digest of its file


def digest(kind: str, folder: Path, group: str) -> str:
    """What tells the class that ``kind`` names from what it was before: the digest of its file and of those it imports.

    Of these there are those of its own package, and those in the folder where its file or package lies, or below, but
    no installed ones; what they read nobody watches. Raises UserError as `load` does, and where a module was edited
    that this process goes on with as it was.
    """
    load(kind, folder, group)
    found = hashlib.sha256()
    for name, file, content in _files(_named(kind, folder, group)[0]):
        now = hashlib.sha256(content)
        if _remembered(name, now.hexdigest()) != now.hexdigest():
            raise UserError(f"{file}: has been edited since it was imported: start Python anew to fly what it says now")
        found.update(now.digest())
    return found.hexdigest()


@cache
def _looked_at(module: ModuleType) -> None:
    """Remember the files of a module as it was imported."""
    for name, _, content in _files(module):
        _remembered(name, hashlib.sha256(content).hexdigest())


def _remembered(name: str, now: str) -> str:
    """The digest of a module's file when it was first looked at: ``now`` where it is not imported, or was anew."""
    module = sys.modules.get(name)
    if module is None:
        return now
    spec, before = _SEEN.get(name, (None, ""))
    if spec is module.__spec__:
        return before
    _SEEN[name] = module.__spec__, now
    return now


def _files(module: ModuleType) -> Iterator[tuple[str, Path, bytes]]:
    """A module and all of the user's that it imports, in the order of their import statements: name, file, content."""
    home, first = module.__name__.partition(".")[0], _source(module.__name__)
    if first is None:
        return
    root = first.parents[module.__name__.count(".") + (first.name == "__init__.py")].resolve()
    waiting, known = [module.__name__], {module.__name__}
    while waiting:
        name = waiting.pop(0)
        file = _source(name)
        if file is None or not (name.partition(".")[0] == home or _is_beside(file, root)):
            continue
        try:
            content = file.read_bytes()
        except OSError:  # it has gone since, or is in an archive
            continue
        yield name, file, content
        others = dict.fromkeys(_imports(name, file, content))
        waiting += [one for one in others if one not in known and one.partition(".")[0] not in _NOT_THEIRS]
        known.update(others)


def _is_beside(file: Path, root: Path) -> bool:
    """Whether a module lies in a folder or below, and is not of an installed package."""
    folder = file.parent.resolve()
    return folder.is_relative_to(root) and not _is_installed(folder / file.name)


def _source(name: str) -> Path | None:
    """The file of a module; None where there is none."""
    spec = _spec(name)
    return Path(spec.origin) if spec is not None and spec.has_location and spec.origin else None


def _spec(name: str) -> ModuleSpec | None:
    """Where a module is found; None where it is not. Nothing is imported for that: it would run."""
    above = name.rpartition(".")[0]
    try:
        if sys.modules.get(name) is not None:
            return sys.modules[name].__spec__
        package = _spec(above) if above else None
        if above and (package is None or package.submodule_search_locations is None):
            return None
        return PathFinder.find_spec(name, package.submodule_search_locations if package else None)
    except Exception:  # a package without __init__.py in one that was never imported, or no module at all
        return None


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
