"""Classes of the user's: in a module, in a file beside the scenario, or by a name that an installed package gives."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
import traceback
from collections.abc import Mapping
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from testbed.errors import UserError, printable, shown, unknown

OUR_FOLDERS = {Path(__file__).parent, Path(__file__).parent / "estimators"}  # whose lines tell a user nothing


@cache
def installed(group: str) -> Mapping[str, str]:
    """The kinds that installed packages offer by entry points of a ``group``: name and ``module:Class``."""
    return {point.name: point.value for point in entry_points(group=group)}


def load(kind: str, folder: Path, group: str) -> Any:
    """The class that ``kind`` names: ``module:Class``, ``./file.py:Class`` seen from ``folder``, or an entry point.

    Raises UserError when it can't be had.
    """
    where, _, name = installed(group).get(kind, kind).rpartition(":")
    try:
        module = _file(folder / where) if where.endswith(".py") else importlib.import_module(where)
    except UserError:
        raise
    except ModuleNotFoundError as error:
        if error.name is not None and where.split(".")[0] != error.name.split(".")[0]:
            raise UserError(f"kind {shown(kind)}: {where} can't be imported: {error.msg}") from error
        todo = f'install it, or give its file, such as "./{where.rpartition(".")[2]}.py:{name}"'
        raise UserError(f"kind {shown(kind)}: there is no module {where}: {todo}") from None
    except (Exception, SystemExit) as error:
        raise UserError(f"kind {shown(kind)}: {where} can't be imported: {raised(error)}") from error
    if not hasattr(module, name):
        classes = [key for key, value in vars(module).items() if isinstance(value, type) and not key.startswith("_")]
        raise UserError(f"kind {shown(kind)}: {unknown(f'class in {where}', name, classes)}")
    return getattr(module, name)


def _file(path: Path) -> ModuleType:
    """The module in a file, the same one as long as the file is the same."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: can't be read: {error.strerror}: a path is relative to the scenario file") from None
    name = f"{path.stem}_{hashlib.sha256(str(path.resolve()).encode() + content).hexdigest()[:12]}"
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
    """What was raised and where, on one line, in code that is not of `OUR_FOLDERS`."""
    frames = [
        frame for frame in traceback.extract_tb(error.__traceback__) if Path(frame.filename).parent not in OUR_FOLDERS
    ]
    at = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {printable(str(error))}{at}"
