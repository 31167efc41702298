"""The ground from a file, an SRTM tile or a grid of heights in a NumPy archive, and how maps of it are wrong."""

from __future__ import annotations

import math
import re
import zipfile
from functools import lru_cache
from pathlib import Path

import numpy as np

from nav.earth import radii, wrap_longitude
from nav.samples import Array
from nav.terrain import Terrain
from testbed.errors import UserError
from testbed.motion.sections import Terrain as Section

TILE = re.compile(r"(?P<ns>[NS])(?P<lat>\d{2})(?P<ew>[EW])(?P<lon>\d{3})", re.IGNORECASE)
TILE_SIZES = (1201, 3601)  # points a side, 3 and 1 arc-second
VOID = -32768  # of SRTM, where nothing was measured
LIMITS = (-500.0, 9000.0)  # [m]
NEEDED = ("lat_deg", "lon_deg", "height_m")
EVEN = 1e-6  # of a step
JACKSBORO = "jacksboro"  # the relief among the sample data of matplotlib, in place of a file


def of(section: Section) -> Terrain:
    """The map of a section. Raises UserError where its file can't be read or makes no sense."""
    if section.file is None:
        return Terrain.flat(section.height_m)
    if section.file == JACKSBORO:
        return _jacksboro()
    path = Path(section.file)
    try:
        changed = path.stat().st_mtime_ns
    except OSError as error:
        raise UserError(f"{path}: can't be read: {error.strerror or error}") from None
    return _kept(path, changed)


def covers(terrain: Terrain, lat: float, lon: float) -> bool:
    """Whether a place [rad] is not beyond the edge of a map with relief."""
    lat_0, lat_step, lon_0, lon_step = terrain.grid.tolist()
    rows, columns = terrain.heights.shape
    north, east = lat - lat_0, wrap_longitude(lon - lon_0 - 0.5 * (columns - 1) * lon_step)
    return bool(0.0 <= north <= (rows - 1) * lat_step and abs(east) <= 0.5 * (columns - 1) * lon_step)


def extent(terrain: Terrain) -> str:
    """From where to where a map with relief goes, in words."""
    lat_0, lat_step, lon_0, lon_step = np.degrees(terrain.grid).tolist()
    rows, columns = terrain.heights.shape
    lat_1, lon_1 = lat_0 + (rows - 1) * lat_step, lon_0 + (columns - 1) * lon_step
    return f"latitudes {lat_0:.4g} to {lat_1:.4g} deg, longitudes {lon_0:.5g} to {lon_1:.5g} deg"


def thinned(terrain: Terrain, every: int) -> tuple[Terrain, float]:
    """A map with each of ``every`` rows and columns, and the rms [m] of what lies between its points.

    Raises UserError where that is less than two of each.
    """
    if every == 1:
        return terrain, 0.0
    from scipy.ndimage import map_coordinates  # takes long to load, and few need it; the same of those below

    heights = np.ascontiguousarray(terrain.heights[::every, ::every])
    if min(heights.shape) < 2:
        raise UserError(f"of the file's {min(terrain.heights.shape)} rows or columns, map_every leaves one: lower it")
    places = [np.minimum(np.arange(n) / every, (n - 1) // every) for n in terrain.heights.shape]
    between = map_coordinates(heights, np.meshgrid(*places, indexing="ij"), order=1)
    grid = terrain.grid * [1.0, every, 1.0, every]
    return Terrain(heights, grid), float(np.sqrt(np.mean((between - terrain.heights) ** 2)))


def uneven(terrain: Terrain, sigma: float, length: float, rng: np.random.Generator) -> Terrain:
    """The same with errors of ``sigma`` [m] drawn by ``rng``, alike by exp(-(|north| + |east|) / length [m])."""
    if not sigma:
        return terrain
    from scipy.signal import lfilter

    R_M, R_N = radii(terrain.grid[0])
    field = rng.standard_normal(terrain.heights.shape)
    steps = terrain.grid[1] * R_M, terrain.grid[3] * R_N * math.cos(terrain.grid[0])
    for axis, step in enumerate(steps):
        phi = math.exp(-step / length)
        drive = math.sqrt(1 - phi**2)
        first = np.take(field, [0], axis=axis) * (1 - drive)  # so that the first one is as large as the others
        phis = phi ** np.arange(field.shape[axis])
        field = lfilter([drive], [1.0, -phi], field, axis=axis) + first * (phis[:, None] if axis == 0 else phis)
    return Terrain(terrain.heights + sigma * field, terrain.grid)


@lru_cache(maxsize=1)
def _jacksboro() -> Terrain:
    """3 arc-seconds from SRTM around a fault in Tennessee; rows from the north, whose bounds the file has swapped."""
    from matplotlib.cbook import get_sample_data

    with np.load(str(get_sample_data("jacksboro_fault_dem.npz", asfileobj=False))) as archive:
        heights = np.ascontiguousarray(archive["elevation"][::-1].astype(float))
        south, west, step = float(archive["ymax"]), float(archive["xmin"]), float(archive["dy"])
    return Terrain(heights, np.radians([south + 0.5 * step, step, west + 0.5 * step, step]))


@lru_cache(maxsize=2)
def _kept(path: Path, changed: int) -> Terrain:
    """`read`, once for every sensor and filter."""
    return read(path)


def read(path: Path) -> Terrain:
    """The heights [m] above the ellipsoid in a file; what a tile gives above the geoid is taken as that.

    ``.hgt``: a tile of SRTM, whose name tells its south-west corner, such as N36W085.hgt. ``.npz``: ``lat_deg`` and
    ``lon_deg``, ascending in even steps, and ``height_m`` (latitudes, longitudes). Raises UserError.
    """
    try:
        if path.suffix.lower() == ".hgt":
            lat, lon, heights = _tile(path)
        elif path.suffix.lower() == ".npz":
            lat, lon, heights = _archive(path)
        else:
            raise UserError(f"{path}: heights of the ground are read from .hgt (SRTM) and .npz: convert it")
    except OSError as error:
        raise UserError(f"{path}: can't be read: {error.strerror or error}") from None
    if not ((heights >= LIMITS[0]) & (heights <= LIMITS[1])).all():
        raise UserError(f"{path}: a height is missing, or not from {LIMITS[0]:g} to {LIMITS[1]:g} m: fill it first")
    grid = np.radians([lat[0], (lat[-1] - lat[0]) / (len(lat) - 1), lon[0], (lon[-1] - lon[0]) / (len(lon) - 1)])
    return Terrain(np.ascontiguousarray(heights), grid)


def _tile(path: Path) -> tuple[Array, Array, Array]:
    """Latitudes, longitudes [deg], ascending, and heights of a tile: big-endian numbers, northern row first."""
    name = TILE.fullmatch(path.stem)
    if name is None:
        raise UserError(f"{path}: the name of a tile is its south-west corner, such as N36W085.hgt")
    raw = np.fromfile(path, ">i2")
    side = math.isqrt(len(raw))
    if side not in TILE_SIZES or side * side != len(raw):
        sizes = " or ".join(f"{2 * n * n}" for n in TILE_SIZES)
        raise UserError(f"{path}: an SRTM tile has {sizes} bytes, this file {2 * len(raw)}")
    south = int(name["lat"]) * (1 if name["ns"].upper() == "N" else -1)
    west = int(name["lon"]) * (1 if name["ew"].upper() == "E" else -1)
    ahead = np.linspace(0.0, 1.0, side)
    heights = raw.reshape(side, side)[::-1].astype(float)
    heights[heights == VOID] = math.nan
    return south + ahead, west + ahead, heights


def _archive(path: Path) -> tuple[Array, Array, Array]:
    """The same of a NumPy archive."""
    try:
        with np.load(path) as archive:
            if missing := [name for name in NEEDED if name not in archive]:
                raise UserError(f"{path}: has no {' and no '.join(missing)}: it has {', '.join(archive) or 'nothing'}")
            lat, lon, heights = (np.asarray(archive[name], float) for name in NEEDED)
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise UserError(f"{path}: is no archive of numbers: {error}") from None
    for name, values in (("lat_deg", lat), ("lon_deg", lon)):
        steps = np.diff(values) if values.ndim == 1 else np.zeros(0)
        if not (len(steps) and (np.abs(steps - steps.mean()) <= EVEN * steps.mean()).all()):
            raise UserError(f"{path}: {name} must ascend in even steps, two at least")
    if heights.shape != (len(lat), len(lon)):
        shape = " x ".join(map(str, heights.shape))
        raise UserError(f"{path}: height_m is {shape}, not latitudes x longitudes, {len(lat)} x {len(lon)}")
    return lat, lon, heights
