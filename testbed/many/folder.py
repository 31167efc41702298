"""The folder of something long that carries on where it stopped: what was flown there before is of the same making."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import nav
import testbed
from testbed.data import data_dir, write_file
from testbed.errors import UserError
from testbed.scenario import Scenario

SETUP = "setup.json"
PRESENTATION = ("report", "mavlink")  # rooms that change no number
PACKAGES = ("numpy", "scipy", "numba", "jsbsim", "pygeomag")  # that do


@functools.cache
def code() -> str:
    """Digest of the code and the aircraft that decide the numbers of a run in this process."""
    digest = hashlib.sha256()
    package = Path(testbed.__file__).parent
    shown = {file for room in PRESENTATION for file in (package / room).rglob("*.py")}
    for folder, kinds in (
        (Path(nav.__file__).parent, (".py",)),
        (package, (".py",)),
        (data_dir("aircraft"), (".xml", ".toml")),
    ):
        for file in sorted({file for file in folder.rglob("*") if file.suffix in kinds} - shown):
            digest.update(file.relative_to(folder).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def require_code(begun_with: str) -> None:
    """Raises UserError when a worker has other code than whoever gave it the task."""
    if code() != begun_with:
        raise UserError("this worker has other code than it was begun with: has a file been edited meanwhile?")


def own(scenarios: Sequence[Scenario]) -> dict[str, dict[str, str]]:
    """Digests of the user's classes in these scenarios, by kind. Raises UserError where one can't be had."""
    each = [one.own() for one in scenarios]
    return {
        what: {kind: code for one in each for kind, code in one[what].items()} for what in ("estimators", "sensors")
    }


def require_own_code(begun_with: Mapping[str, Mapping[str, str]], scenario: Scenario) -> None:
    """Raises UserError when a class of the user's in a scenario is not what it was."""
    now = own([scenario])
    if any(begun_with[what].get(kind) != code for what, each in now.items() for kind, code in each.items()):
        raise UserError("an estimator or sensor of yours has been edited meanwhile: fly all runs again, elsewhere")


def versions() -> dict[str, str]:
    """Of the packages that decide numbers too."""
    return {package: version(package) for package in PACKAGES}


def claim(folder: Path, room: str, what: str, setup: Mapping[str, Any]) -> None:
    """Make ``folder`` and in it the ``room`` for runs, or make sure that it holds this and no other.

    ``what`` it is called, and ``setup`` is everything that decides its numbers, apart from the seeds. Raises UserError.
    """
    file = folder / SETUP
    advice = "choose another folder with --out"
    try:
        (folder / room).mkdir(parents=True, exist_ok=True)
        if file.exists():
            before = json.loads(file.read_bytes())
            differ = [key for key in setup if before.get(key) != setup[key]]
            if differ:
                raise UserError(
                    f"{folder}: holds a {what} with different {', '.join(differ)}: {advice}, or delete this one"
                )
        elif any((folder / room).iterdir()):
            raise UserError(f"{folder}: has {room} but no {SETUP} to say of what: {advice}")
        else:
            write_file(file, json.dumps(setup, indent=1).encode())
    except OSError as error:
        raise UserError(f"{folder}: can't write here ({error.strerror}): choose another folder with --out") from None
    except (ValueError, AttributeError):
        raise UserError(f"{file}: is damaged: {advice}") from None
