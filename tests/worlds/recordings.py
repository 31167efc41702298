"""Logs made of simulated flights."""

from __future__ import annotations

import re
from pathlib import Path

TABLE = re.compile(r"^\[+(?P<name>[^\]]+)\]+", re.MULTILINE)


def log_of(text: str, file: Path, columns: str = "") -> str:
    """A scenario's text with a log in place of its motion and plan; ``columns`` are more lines of [truth]."""
    found = list(TABLE.finditer(text))
    ends = [*(one.start() for one in found[1:]), len(text)]
    kept = text[: found[0].start()]
    for one, end in zip(found, ends, strict=True):
        if one["name"].split(".")[0] not in ("truth", "plan", "expect"):
            kept += text[one.start() : end]
    return f'{kept}\n[truth]\nsource = "log"\nfile = "{file}"\n{columns}\n'
