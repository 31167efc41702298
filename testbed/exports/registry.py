"""Which formats there are, who reads them, and writing one: whole or not at all, over nothing that is not ours."""

from __future__ import annotations

import importlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from testbed.data import write_file
from testbed.errors import UserError, unknown
from testbed.record.reader import load
from testbed.results import (
    MANIFEST,
    METRICS,
    REPORT,
    WHOSE,
    enter,
    held,
    require_none_but,
    require_own,
    start_anew,
    write_result,
)

if TYPE_CHECKING:
    import xarray


@dataclass(frozen=True, slots=True)
class Format:
    """One format: its name, the ending that replaces the record's, what is in it, and who reads it.

    ``module`` has ``content(tree) -> bytes``; of a folder of files (``many``) ``contents(tree) -> dict of names and
    bytes``. An ending without a dot is that of a folder. ``version`` is what one
    module of several formats is told. ``extra`` is the optional extra of the installation
    that it needs.
    """

    name: str
    ending: str
    module: str
    holds: str
    readers: str
    version: str = ""
    extra: str = ""

    @property
    def many(self) -> bool:
        """Whether it is a folder of files."""
        return "." not in self.ending


FORMATS: dict[str, Format] = {
    one.name: one
    for one in (
        Format("csv", "_csv", "tables", "everything, one table per group", "any program"),
        Format(
            "ulg",
            ".ulg",
            "px4",
            "a PX4 log: samples, truth as *_groundtruth, estimates",
            "PX4's EKF2 replay (1.16), pyulog, Flight Review, PlotJuggler, Foxglove",
            version="1.16",
        ),
        Format(
            "ulg-1.15", "-1.15.ulg", "px4", "the same by the messages of PX4 1.15", "EKF2 replay (1.15)", version="1.15"
        ),
        Format(
            "bin",
            ".bin",
            "dataflash",
            "an ArduPilot log: samples, truth as SIM, estimators as cores of XKF1",
            "pymavlink, MAVExplorer, Mission Planner, UAV Log Viewer, PlotJuggler",
        ),
        Format(
            "mcap",
            ".mcap",
            "foxglove",
            "locations, poses, inertial samples and events, Foxglove's schemas in JSON",
            "Foxglove, PlotJuggler, mcap",
            extra="mcap",
        ),
        Format("kml", ".kml", "kml", "truth and estimates on the map, denied stretches, 95 % ellipses", "Google Earth"),
        Format("czml", ".czml", "czml", "the same over time", "Cesium"),
        Format("gpx", ".gpx", "gpx", "truth, GNSS fixes and estimates as tracks", "GPS viewers, GIS"),
        Format("pos", "_pos", "rtklib", "truth, each receiver and estimator as a solution", "RTKLIB's RTKPLOT"),
        Format(
            "navego", "_navego.mat", "toolboxes", "first IMU and receiver, truth as ref", "NaveGo", version="navego"
        ),
        Format("psins", "_psins.mat", "toolboxes", "the same as trj and gps", "PSINS", version="psins"),
        Format("mat", ".mat", "matlab", "everything, one struct per group", "MATLAB, Octave, scipy"),
    )
}


def export(run_file: Path, format: str, out: Path | None = None, force: bool = False) -> Path:
    """Write a record in one of `FORMATS` and return where: beside the record unless ``out`` says otherwise.

    Raises UserError when there is no such format, the record can't be read or lacks what the format is made of, or
    the target can't be written, which leaves nothing of it; or, without ``force``, when files are there that are no
    earlier export's.
    """
    if format not in FORMATS:
        raise UserError(unknown("format", format, [*FORMATS]))
    if out is not None and out.resolve() == run_file.resolve():
        raise UserError(f"{out}: is the record itself: choose another place with --out")
    one = FORMATS[format]
    tree = load(run_file)
    target = run_file.with_name(run_file.stem + one.ending) if out is None else out
    try:
        written = importlib.import_module(f"testbed.exports.{one.module}")
        content = written.contents(tree) if one.many else _content(written, one, tree)
    except ImportError as error:
        if not one.extra:
            raise
        raise UserError(
            f"--format {format}: needs the package {error.name}: install the extra {one.extra!r} of navigation-testbed"
        ) from None
    except UserError as error:
        raise error.within(str(run_file)) from None
    if isinstance(content, bytes):
        write_one(target, content, force)
    else:
        _write_many(target, content, force)
    return target


def _content(module: object, one: Format, tree: xarray.DataTree) -> bytes:
    arguments = (tree, one.version) if one.version else (tree,)
    content: bytes = module.content(*arguments)  # type: ignore[attr-defined]
    return content


def write_one(path: Path, content: bytes, force: bool) -> None:
    """Write one file whole, or not at all. Raises UserError when it can't be, or is somebody else's."""
    if path.is_dir():
        raise UserError(f"{path}: is a folder: give the name of a file")
    if path.name in (*WHOSE, METRICS, REPORT, MANIFEST):
        raise UserError(f"{path}: is what a result of another command is called: give another name with --out")
    with held(path.parent):
        require_own(path.parent, [path.name], force)
        if (path.parent / MANIFEST).exists():  # beside the record, or a folder of results
            enter(path.parent, [path.name])
        write_file(path, content)


def _write_many(folder: Path, contents: dict[str, bytes], force: bool) -> None:
    with held(folder):
        require_none_but(folder)
        require_own(folder, contents, force)
        if (folder.parent / MANIFEST).exists():  # beside the record: the next run takes it away
            enter(folder.parent, [folder.name])
        start_anew(folder, contents)
        try:
            for name, content in contents.items():
                write_result(folder / name, content)
        except UserError:
            start_anew(folder)
            with suppress(OSError):
                folder.rmdir()
            raise
