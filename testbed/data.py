"""Where the shipped aircraft and scenarios lie."""

from __future__ import annotations

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
