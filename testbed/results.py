"""What is written into a folder of results: by one command at a time, and never over a file that is somebody else's.

`MANIFEST` in the folder lists what was written there; every file enters as it is written. Only what it lists is ever
replaced or removed.
"""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from testbed.data import write_file
from testbed.errors import UserError

RECORD, METRICS, REPORT = "run.nc", "metrics.json", "report.html"
CAMPAIGN, DENIED, PAPERS = "campaign.json", "denied.json", "papers.json"
# The file by which it is told whose results a folder has.
WHOSE = {RECORD: "a run", CAMPAIGN: "a campaign", DENIED: "`testbed denied`", PAPERS: "`testbed papers`"}
MANIFEST = "testbed_manifest.json"  # {"files": [names within the folder]}


def write_result(path: Path, content: bytes, force: bool = False) -> None:
    """Write a file, whole or not at all, and enter it in the manifest of its folder.

    Raises UserError when it can't be written; or, without ``force``, when a file of that name is there that the
    manifest doesn't list.
    """
    require_own(path.parent, [path.name], force)
    enter(path.parent, [path.name])
    write_file(path, content)


def require_own(folder: Path, names: Collection[str], force: bool = False) -> None:
    """See that files of these names in ``folder`` are absent or listed in its manifest; with ``force``, list them.

    Raises UserError that names the others; and, of names that tell whose results they are, when those of another
    command are there, which has them listed: they would be mixed, or lost.
    """
    listed = _listed(folder)
    if not WHOSE.keys().isdisjoint(names):
        require_none_but(folder, names)
    foreign = [name for name in names if name not in listed and (folder / name).exists()]
    if foreign and force:
        enter(folder, foreign)
    elif foreign:
        raise UserError(
            f"{folder}: there is {', '.join(foreign)} already, not made by an earlier command: move it away, choose"
            " another folder, or add --force if the command takes it"
        )


def require_none_but(folder: Path, names: Iterable[str] = ()) -> None:
    """Raise UserError when the results of a command are in a folder, unless the file that tells it is of ``names``."""
    others = [WHOSE[name] for name in sorted((_listed(folder) & WHOSE.keys()).difference(names))]
    if others:
        raise UserError(f"{folder}: has the results of {' and '.join(others)}: choose another folder")


def enter(folder: Path, names: Iterable[str]) -> None:
    """List files in the manifest of a folder: from now on they may be replaced and removed."""
    before = _listed(folder)
    if not before.issuperset(names):
        _list(folder, before.union(names))


def withdraw(path: Path) -> None:
    """Remove a file that was written and shows nothing, if it was, and what is said of it."""
    with suppress(OSError, UserError):
        path.unlink(missing_ok=True)
        rest = _listed(path.parent) - {path.name}
        if rest:
            _list(path.parent, rest)
        else:
            (path.parent / MANIFEST).unlink()


@contextmanager
def beside(folder: Path, names: Collection[str], force: bool = False) -> Iterator[None]:
    """Files of these names are written by somebody while a run makes ``folder`` anew: they are listed when it is over.

    What was not listed before, and is as it was, is not. Raises UserError as `require_own` does.
    """
    listed = _listed(folder)
    before = {name: stamp(folder / name) for name in names if name not in listed}
    if not force:
        require_own(folder, names)
    if listed.intersection(names):
        _list(folder, listed.difference(names))  # or the run would remove them
    try:
        yield
    finally:
        written = [name for name in names if (now := stamp(folder / name)) and now != before.get(name)]
        if written:
            enter(folder, written)


def stamp(path: Path) -> tuple[int, int, int] | None:
    """What changes when a file is written; None when there is none."""
    with suppress(OSError):
        status = path.stat()
        return status.st_ino, status.st_mtime_ns, status.st_size
    return None


def start_anew(folder: Path, names: Iterable[str] = ()) -> None:
    """Remove what the manifest of a folder lists, but files of these names: they are listed, as about to be written.

    Raises UserError when something can't be removed.
    """
    coming = set(names)
    before = _listed(folder)
    try:
        for path in (folder / name for name in sorted(before - coming)):
            if path.is_dir() and not path.is_symlink():  # an export, with a manifest of its own
                start_anew(path)
                with suppress(OSError):  # something else is in it
                    path.rmdir()
            else:
                path.unlink(missing_ok=True)
        if before and not coming:
            (folder / MANIFEST).unlink()
    except OSError as error:
        raise UserError(f"{error.filename}: an earlier result can't be removed: {error.strerror}") from None
    if coming:
        _list(folder, coming)


def _list(folder: Path, names: Iterable[str]) -> None:
    write_file(folder / MANIFEST, (json.dumps({"files": sorted(names)}, indent=1) + "\n").encode())


def _listed(folder: Path) -> set[str]:
    path = folder / MANIFEST
    try:
        files = set(json.loads(path.read_bytes())["files"])
        if any(Path(name).name != name for name in files):  # none of ours leads out of the folder
            raise ValueError
    except (FileNotFoundError, NotADirectoryError):
        return set()
    except OSError as error:
        raise UserError(f"{path}: can't be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError):
        raise UserError(f"{path}: is damaged: delete it, and the results beside it that are not wanted") from None
    return files


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Make a folder and keep other commands from writing into it meanwhile. The lock ends with the process.

    Raises UserError when another one holds it, or when the folder can't be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:  # ValueError: a name that can be none
        why = getattr(error, "strerror", None) or error
        raise UserError(f"{folder}: can't be written: {why}: choose another place with --out") from None
    lock = _lock(folder)
    try:
        yield
    finally:
        if lock is not None:
            os.close(lock)


def _lock(folder: Path) -> int | None:
    """A descriptor whose closing ends the lock, None where folders can't be locked (Windows, some network drives)."""
    try:
        import fcntl
    except ImportError:
        return None
    lock = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(lock)
        raise UserError(f"{folder}: another run is writing here: wait for it, or choose another folder") from None
    except OSError:
        os.close(lock)
        return None
    return lock
