"""Maps of the ground from files, and what is said of files that are none."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from nav.terrain import ground
from testbed import Scenario, run
from testbed.errors import UserError
from testbed.motion.terrain import read

LAT, LON = np.linspace(33.9, 34.1, 21), np.linspace(107.9, 108.1, 31)
HEIGHTS = 100 + 50 * np.sin(40 * LAT[:, None]) * np.cos(30 * LON)


def saved(folder: Path, **changed: object) -> Path:
    path = folder / "ground.npz"
    np.savez(path, **({"lat_deg": LAT, "lon_deg": LON, "height_m": HEIGHTS} | changed))
    return path


def height(path: Path, lat_deg: float, lon_deg: float) -> float:
    terrain = read(path)
    return ground(math.radians(lat_deg), math.radians(lon_deg), terrain.heights, terrain.grid)[0]


def test_an_archive(tmp_path: Path) -> None:
    path = saved(tmp_path)
    for i, j in ((0, 0), (7, 19), (20, 30)):
        assert height(path, LAT[i], LON[j]) == pytest.approx(HEIGHTS[i, j])


def test_a_tile_lies_north_east_of_its_name(tmp_path: Path) -> None:
    rows = np.arange(1201)[:, None] + np.zeros(1201)  # the first row is the northern one
    columns = np.zeros((1201, 1)) + np.arange(1201)
    (rows + 2 * columns).astype(">i2").tofile(tmp_path / "S36W085.hgt")
    assert height(tmp_path / "S36W085.hgt", -35.0, -85.0) == pytest.approx(0.0, abs=1e-6)
    assert height(tmp_path / "S36W085.hgt", -36.0, -85.0) == pytest.approx(1200.0)
    assert height(tmp_path / "S36W085.hgt", -35.25, -84.5) == pytest.approx(300.0 + 1200.0)


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"lat_deg": LAT[::-1]}, "lat_deg must ascend in even steps"),
        ({"lon_deg": LON**2}, "lon_deg must ascend in even steps"),
        ({"lat_deg": np.array([34.0])}, "lat_deg must ascend in even steps, two at least"),
        ({"height_m": HEIGHTS.T}, "height_m is 31 x 21, not latitudes x longitudes, 21 x 31"),
        ({"height_m": np.where(HEIGHTS > 140, np.nan, HEIGHTS)}, "a height is missing"),
        ({"height_m": 100 * HEIGHTS}, "not from -500 to 9000 m"),
        ({"height_m": np.array("none")}, "is no archive of numbers"),
    ],
)
def test_what_is_wrong_with_an_archive_is_told(tmp_path: Path, changed: dict[str, object], says: str) -> None:
    with pytest.raises(UserError, match=says):
        read(saved(tmp_path, **changed))


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("N36W085.hgt", b"\0" * 1000, "an SRTM tile has 2884802 or 25934402 bytes, this file 1000"),
        ("here.hgt", b"", "the name of a tile is its south-west corner"),
        ("N36W085.hgt", b"\x80\x00" * 1201 * 1201, "a height is missing"),
        ("ground.tif", b"", "are read from .hgt"),
        ("ground.npz", b"nothing", "is no archive"),
        ("ground.npz", b"", "is no archive"),
    ],
)
def test_what_is_wrong_with_a_file_is_told(tmp_path: Path, name: str, content: bytes, says: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=says):
        read(tmp_path / name)


SCENARIO = """
title = "Over hills"
duration_s = 20
[truth]
source = "kinematic"
motion = "segments"
start = { lat_deg = 34.0, lon_deg = 108.0, alt_m = 400, heading_deg = 30, speed_mps = 25 }
terrain = { file = "ground.npz", map_sigma_m = 0 }
[[truth.segments]]
leg = "straight"
duration_s = 20
[sensors.imu]
[sensors.rangefinder]
grade = "perfect"
[[estimator]]
name = "ins"
aids = []
"""


def test_a_scenario_flies_over_the_map_beside_it(tmp_path: Path) -> None:
    saved(tmp_path)
    (tmp_path / "hills.toml").write_text(SCENARIO, "utf-8")
    tree = run(Scenario.load(tmp_path / "hills.toml")).dataset
    truth, seen = tree["truth"], tree["sensors/rangefinder"]
    terrain = read(tmp_path / "ground.npz")
    for k in range(0, len(seen["time"]), 37):
        at = int(np.argmin(np.abs(truth["time"].values - seen["time"].values[k])))
        here = ground(float(truth["lat"][at]), float(truth["lon"][at]), terrain.heights, terrain.grid)[0]
        assert float(seen["range"][k]) == pytest.approx(float(truth["h"][at]) - here, abs=0.1)
    assert float(seen["range"].max() - seen["range"].min()) > 3.0


def test_a_map_that_is_not_there_is_named(tmp_path: Path) -> None:
    (tmp_path / "hills.toml").write_text(SCENARIO, "utf-8")
    with pytest.raises(UserError, match=r"truth\.terrain\.file.*ground\.npz: can't be read: No such file"):
        Scenario.load(tmp_path / "hills.toml")
