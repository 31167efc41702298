"""Where shipped files lie, a project made of them, and writing a file whole."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from testbed.errors import UserError


def data_dir(name: str) -> Path:
    """Folder of shipped files, ``"aircraft"``, ``"scenarios"`` or ``"template"``.

    They are in `testbed` once installed; aircraft and scenarios are beside it in a checkout.
    Raises UserError when the installation lacks it.
    """
    package = Path(__file__).resolve().parent
    for folder in (package / name, package.parent / name):
        if folder.is_dir():
            return folder
    raise UserError(f"{package / name}: the folder of shipped {name} is missing: install the package again")


def docs_dir() -> Path:
    """The manual's folder. Raises UserError where there is none: it is not installed."""
    folder = data_dir("scenarios").parent / "docs"
    if not folder.is_dir():
        raise UserError(f"{folder}: is missing: --save is for a checkout of the testbed")
    return folder


def make_project(folder: Path) -> list[Path]:
    """Copy the template of a user's own project into a new or empty folder; the files made.

    Raises UserError when there is something in it, or it can't be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise UserError(f"{folder}: is not empty: name a new folder")
    except OSError as error:
        raise UserError(f"{folder}: can't be made: {error.strerror}: name another folder") from None
    made = []
    for source in sorted(path for path in data_dir("template").iterdir() if path.is_file()):
        made.append(folder / source.name)
        write_file(made[-1], source.read_bytes())
    return made


def write_file(path: Path, content: bytes) -> None:
    """Write a file so that it is there whole or not at all; a link stays one, to what is written.

    Raises UserError when it can't be written.
    """
    part = None
    try:
        target = path.resolve()
        if target.is_dir():
            raise UserError(f"{path}: is a folder: give the name of a file")
        if target.exists() and not target.is_file():  # a device, or a pipe, which nothing can be put in the place of
            target.write_bytes(content)
            return
        part = target.with_name(f".{target.name}.{os.getpid()}.part")
        part.write_bytes(content)
        part.replace(target)
    except (OSError, RuntimeError, ValueError) as error:  # links in a circle, a name that can be none
        if part is not None:
            with suppress(OSError):
                part.unlink(missing_ok=True)
        raise UserError(f"{path}: can't be written: {getattr(error, 'strerror', None) or error}") from None
