"""Where the shipped aircraft and scenarios lie, and writing a file whole."""

from __future__ import annotations

import os
from pathlib import Path

from testbed.errors import UserError


def data_dir(name: str) -> Path:
    """Folder of shipped data, ``"aircraft"`` or ``"scenarios"``: in `testbed` once installed, beside it in a checkout.

    Raises UserError when the installation lacks it.
    """
    package = Path(__file__).resolve().parent
    for folder in (package / name, package.parent / name):
        if folder.is_dir():
            return folder
    raise UserError(f"{package / name}: the folder of shipped {name} is missing: install the package again")


def write_file(path: Path, content: bytes) -> None:
    """Write a file so that it is there whole or not at all. Raises UserError when it can't be written."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(content)
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise UserError(f"{path}: can't be written: {error.strerror}") from None
