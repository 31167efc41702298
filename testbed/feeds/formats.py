"""Which formats of logs there are: a log is known by its first bytes, whatever its name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import NamedTuple, TypeAlias

from testbed.errors import UserError
from testbed.feeds.log import Log
from testbed.feeds.text import is_table
from testbed.motion.logged import LogTruth, Stream

LARGEST_BYTES = 1 << 30
HEAD_BYTES = 4096

Reader: TypeAlias = Callable[[Path, Mapping[str, Stream]], Log]


class Format(NamedTuple):
    """What a format is called, how a file of it begins, and the module beside this one that reads it.

    ``line`` is how its own first line begins, of a text before which a ground station has put lines of its own.
    """

    name: str
    begins: tuple[bytes, ...]
    module: str
    line: bytes = b""


FORMATS = (
    Format("run.nc", (b"\x89HDF\r\n\x1a\n",), "rerun"),
    Format("ArduPilot DataFlash", (b"\xa3\x95", b"FMT,"), "ardupilot", b"FMT,"),
    Format("PX4 ULog", (b"ULog\x01\x12\x35",), "px4"),
    Format("npz", (b"PK\x03\x04",), "table"),
    Format("MATLAB", (b"MATLAB 5.0 MAT-file",), "table"),
    Format("Parquet", (b"PAR1",), "table"),
)
CSV = Format("CSV", (), "table")  # text, whatever it begins with
# What else files begin with, and what to do about it.
OTHERS = (
    ((b"\x1f\x8b", b"BZh", b"\xfd7zXZ\x00", b"\x28\xb5\x2f\xfd", b"7z\xbc\xaf"), "is compressed: unpack it first"),
    ((b"\xff\xfe", b"\xfe\xff"), "is text in UTF-16: save it as UTF-8"),
    ((b"MATLAB 7.3 MAT-file",), "is a MATLAB file of version 7.3: save it with -v7"),
    ((b"{", b"[{", b"[\n"), "is JSON: write it as a table, as CSV say, or give the log that it was made of"),
    ((b"version https://git-lfs",), "is a pointer of Git LFS in place of the log: fetch that with `git lfs pull`"),
)


def open_log(truth: LogTruth) -> Log:
    """The log of a scenario, read once however often it is asked for.

    Raises UserError when there is no such file, it is none of the known formats, or damaged.
    """
    states = []
    for key, file in truth.files.items():
        try:
            stat = Path(file).stat()
        except OSError as error:
            raise UserError(f"truth.{key}: {file}: {error.strerror}") from None
        states.append((stat.st_size, stat.st_mtime_ns))
    asked = truth.model_dump_json(include={"source", "file", "columns"})  # what the log is read by
    return _read_once(asked, tuple(states))


@lru_cache(maxsize=2)
def _read_once(truth: str, states: tuple[tuple[int, int], ...]) -> Log:
    """``states`` of its files are sizes and times of change: another one is read anew."""
    asked = LogTruth.model_validate_json(truth)
    return read(Path(asked.file), asked.columns)


def read(path: Path, columns: Mapping[str, Stream]) -> Log:
    """A log by its path and its ``columns``: of a table, or of what another log is judged by.

    Raises UserError as `open_log`.
    """
    found = known(path)
    made: Reader = import_module(f"testbed.feeds.{found.module}").read
    try:
        log = made(path, columns)
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:  # what a damaged file leads to
        raise UserError(f"{path}: is damaged, or no {found.name} as it should be: {error!r}") from None
    if not columns or found.module == "table":
        return log
    from testbed.feeds.beside import judged_by  # which asks here itself what a file is

    return judged_by(log, columns)


def known(path: Path) -> Format:
    """The format of a file. Raises UserError when it is none of those that are known."""
    if path.is_dir():
        raise UserError(f"{path}: is a folder: give the log in it")
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError as error:
        raise UserError(f"{path}: can't be read: {error.strerror}") from None
    if not head:
        raise UserError(f"{path}: is empty: nothing was ever logged, or the copy failed")
    if size > LARGEST_BYTES:
        raise UserError(f"{path}: has {size / 2**30:.1f} GiB, of which at most 1 is read: cut it to the flight")
    for one in FORMATS:
        if head.startswith(one.begins) or (one.line and b"\n" + one.line in head):
            return one
    for begins, told in OTHERS:
        if head.startswith(begins):
            raise UserError(f"{path}: {told}")
    if is_table(head):
        return CSV
    if head[8:9] in (b"\xfd", b"\xfe"):
        what = "a telemetry log, which has no inertial data at their rate"
        raise UserError(f"{path}: is {what}: give the log that the autopilot kept on board")
    names = ", ".join(one.name for one in (*FORMATS, CSV))
    raise UserError(f"{path}: is no log of a known format: these are {names}")
