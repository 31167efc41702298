"""Maps of the ground from files, and what is said of files that are none."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from nav.earth import radii
from nav.terrain import Terrain, ground
from testbed import Scenario, run
from testbed.errors import UserError
from testbed.motion.sections import Terrain as Section
from testbed.motion.terrain import of, read, thinned, uneven

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


def test_the_relief_that_comes_along() -> None:
    """Hills in the north-west, a valley in the south-east, as on any map of Campbell County."""
    terrain = of(Section(file="jacksboro"))
    heights = terrain.heights
    assert (heights.min(), heights.max(), heights.shape) == (236.0, 1076.0, (344, 403))
    assert heights[172:, :200].mean() > heights[:172, 200:].mean() + 100
    south, step, west, _ = np.degrees(terrain.grid)
    assert (south, west) == pytest.approx((36.44625 + step / 2, -84.41375 + step / 2))


def test_a_coarser_map_says_how_much_is_between_its_points() -> None:
    steps = math.radians(3 / 3600)
    rows, columns = np.mgrid[0:31, 0:41]
    bowl = Terrain(0.01 * (rows - 10.0) ** 2 + 0.0 * columns, np.array([0.6, steps, 1.9, steps]))
    known, between = thinned(bowl, 10)
    assert known.heights.shape == (4, 5)
    # between x = 0 and 10 a parabola 0.01 x^2 is lower than its chord by 0.01 x (10 - x)
    chord = np.array([0.01 * x * (10 - x) for x in range(10)])
    assert between == pytest.approx(math.sqrt(np.sum(3 * chord**2) / 31), rel=1e-9)
    for i, j in ((0, 0), (2, 3)):
        height = ground(0.6 + 10 * i * steps, 1.9 + 10 * j * steps, known.heights, known.grid)[0]
        assert height == pytest.approx(bowl.heights[10 * i, 10 * j])
    assert thinned(bowl, 1) == (bowl, 0.0)
    with pytest.raises(UserError, match="map_every leaves one"):
        thinned(bowl, 40)


def test_errors_of_a_map_are_as_large_and_as_alike_as_is_told() -> None:
    steps = math.radians(3 / 3600)
    flat = Terrain(np.zeros((1200, 1200)), np.array([0.6, steps, 1.9, steps]))
    field = uneven(flat, 4.0, 300.0, np.random.default_rng(1)).heights
    R_M, R_N = radii(0.6)
    assert field.std() == pytest.approx(4.0, rel=0.03)
    assert field[0].std() == pytest.approx(4.0, rel=0.25)  # some 100 independent values
    assert field[:, 0].std() == pytest.approx(4.0, rel=0.25)
    for axis, apart in ((0, steps * R_M), (1, steps * R_N * math.cos(0.6))):
        ahead, here = field.take(range(3, 1200), axis), field.take(range(1197), axis)
        assert np.mean(ahead * here) / 16 == pytest.approx(math.exp(-3 * apart / 300.0), abs=0.05)
    assert uneven(flat, 0.0, 300.0, np.random.default_rng(1)) is flat


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("map_error_m = 4", "are of a map with relief"),
        ('file = "jacksboro", map_every = 500', "map_every"),
        ('file = "jacksborough"', r"truth\.terrain\.file.*jacksborough: can't be read"),
        ('file = "jacksboro", map_error_m = -1', "map_error_m"),
    ],
)
def test_mistakes_in_the_section(tmp_path: Path, text: str, says: str) -> None:
    written = SCENARIO.replace('file = "ground.npz", map_sigma_m = 0', text)
    (tmp_path / "hills.toml").write_text(written, "utf-8")
    with pytest.raises(UserError, match=says):
        Scenario.load(tmp_path / "hills.toml")


def flown_over(ground: dict[str, object], **overrides: object) -> Scenario:
    """A straight flight at 1050 m over what is given."""
    start = {"lat_deg": 36.58, "lon_deg": -84.34, "alt_m": 1050, "heading_deg": 30, "airspeed_mps": 25}
    keys = {"truth.start": start, "truth.terrain": ground, "duration_s": 20, "expect": {}, "estimator": []}
    return Scenario.load("u_turn", keys | overrides)


@pytest.mark.parametrize(
    ("ground", "overrides", "says"),
    [
        ({"height_m": 2000}, {}, r"truth\.start\.alt_m: .* 2\d\d\d"),
        (
            {"file": "jacksboro"},
            {"plan": [{"leg": "descend", "to_m": 100}]},
            r"plan\[0\]\.to_m: 100 m can't be flown: the ground is at 236 m \(ellipsoid\), choose from 266 to",
        ),
        (
            {"file": "jacksboro"},
            {"truth.start.alt_m": 300},
            r"truth\.start\.alt_m: is below the ground, which is at \d+ m",
        ),
        (
            {"file": "jacksboro"},
            {"truth.start.lon_deg": 84.34},
            r"truth\.terrain\.file: has no heights where the flight begins: it covers latitudes 36\.45 to 36\.73 deg, "
            r"longitudes -84\.4\d+ to -84\.0\d+ deg",
        ),
    ],
)
def test_a_start_below_the_ground_or_off_its_map_is_told(
    ground: dict[str, object], overrides: dict[str, object], says: str
) -> None:
    with pytest.raises(UserError, match=says):
        flown_over(ground, **overrides)


def test_a_flight_ends_where_it_meets_the_ground(tmp_path: Path) -> None:
    """It went on through hills: here, a kilometre ahead, is one of 1200 m."""
    lat, lon = 36.5 + 0.01 * np.arange(20), -84.4 + 0.01 * np.arange(20)
    height = np.where(lat > 36.585, 1200.0, 500.0)[:, None] + np.zeros(20)
    np.savez(tmp_path / "hill.npz", lat_deg=lat, lon_deg=lon, height_m=height)
    result = run(flown_over({"file": str(tmp_path / "hill.npz")}, duration_s=120))
    assert result.failure == "the aircraft hit the ground"
    truth = result.dataset["truth"]
    terrain = read(tmp_path / "hill.npz")
    here = ground(float(truth["lat"][-1]), float(truth["lon"][-1]), terrain.heights, terrain.grid)[0]
    assert float(truth["h"][-1]) == pytest.approx(here + 1.0, abs=70.0)
    assert float(truth["time"][-1]) < 100
