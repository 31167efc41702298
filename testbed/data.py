"""Where the shipped aircraft and scenarios lie; what a run leaves in its folder; and writing a file whole."""

from __future__ import annotations

import os
from fnmatch import fnmatchcase
from pathlib import Path

from testbed.errors import UserError

# What a run writes beside its record; * is the name of an estimator.
DERIVED = (
    "metrics.json",
    "report.html",
    *(f"{name}.png" for name in ("ground_track", "flight", "comparison", "attitude", "wind", "nees")),
    *(f"*_{name}.png" for name in ("position_errors", "motion_errors", "attitude_errors", "biases", "innovations")),
)


def is_result(name: str) -> bool:
    """Whether a run writes a file of that name into its folder."""
    return name == "run.nc" or any(fnmatchcase(name, pattern) for pattern in DERIVED)


def remove_derived(folder: Path) -> None:
    """Remove what an earlier run in ``folder`` left beside its record. Raises UserError when that can't be done."""
    try:
        for pattern in DERIVED:
            for path in folder.glob(pattern):
                path.unlink()
    except OSError as error:
        raise UserError(f"{error.filename}: an earlier result can't be removed: {error.strerror}") from None


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
