"""Tables whose places and velocities are along the axes of the Earth, against pymap3d."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import pytest

from nav.samples import GnssSample
from testbed.errors import UserError
from testbed.feeds import formats
from testbed.feeds.log import Log
from testbed.motion.logged import LogTruth

T = np.arange(1.0, 21.0)
LAT, LON, H = -33.0 + 1e-4 * T, 151.0 - 2e-4 * T, 40.0 + T
NED = np.column_stack([11.0 + T, -18.0 - T, -1.0 + 0 * T])
IMU = {"time": "t", "gyro": "w", "accel": "f"}


def earth_fixed() -> dict[str, Any]:
    """A receiver's positions and velocities as pymap3d turns them, and an inertial unit."""
    v = np.column_stack(pymap3d.enu2ecefv(NED[:, 1], NED[:, 0], -NED[:, 2], LAT, LON))
    position = np.column_stack(pymap3d.geodetic2ecef(LAT, LON, H))
    force = np.tile([0.0, 0.0, -9.8], (len(T), 1))
    return {"t": T, "w": np.zeros((len(T), 3)), "f": force, "r": position, "v": v}


def read(folder: Path, table: dict[str, Any], **columns: Any) -> Log:
    np.savez(folder / "flight.npz", **table)
    given = {"source": "log", "file": "flight.npz", "columns": {"imu": IMU, **columns}}
    return formats.read(folder / "flight.npz", LogTruth.model_validate(given).columns)


def test_fixes_and_a_reference_are_as_pymap3d_turns_them(tmp_path: Path) -> None:
    table = earth_fixed()
    table |= {"km": table["r"][:, [2, 0, 1]] / 1e3, "swapped": -table["v"][:, [2, 1, 0]]}
    velocity = {"column": "swapped", "axes": ["-z", "-y", "-x"], "frame": "ecef"}
    position = {"column": "km", "unit": "km", "axes": ["y", "z", "x"]}
    log = read(
        tmp_path, table,
        gnss={"time": "t", "position": position, "velocity": velocity},
        reference={"time": "t", "position": {"column": "r", "frame": "ecef"}},
    )  # fmt: skip
    fixes = [one for one in log.samples["gnss"] if isinstance(one, GnssSample)]
    found = np.array([[one.lat, one.lon, one.h, *one.v_n] for one in fixes])
    np.testing.assert_allclose(found[:, :2], np.radians(np.column_stack([LAT, LON])), rtol=0, atol=1e-12)
    np.testing.assert_allclose(found[:, 2:], np.column_stack([H, NED]), rtol=0, atol=1e-6)
    assert log.solution is not None
    own = log.solution.columns
    np.testing.assert_allclose(np.degrees([own["lat"], own["lon"]]), [LAT, LON], rtol=0, atol=1e-10)
    np.testing.assert_allclose(own["h"], H, rtol=0, atol=1e-6)


def test_what_is_nowhere_has_no_fix(tmp_path: Path) -> None:
    table = earth_fixed()
    table["r"][:3], table["r"][3] = 0.0, np.nan
    log = read(tmp_path, table, gnss={"time": "t", "position": "r", "velocity": {"column": "v", "frame": "ecef"}})
    fixes = [one for one in log.samples["gnss"] if isinstance(one, GnssSample)]
    assert [one.has_fix for one in fixes] == [False] * 3 + [True] * 16  # and a row that says nothing is none
    assert any("3 rows are at latitude and longitude 0" in note for note in log.notes)


@pytest.mark.parametrize(
    ("gnss", "said"),
    [
        ({"position": {"column": "r", "unit": "mm"}}, r"gnss\.position: is 6\.3\d+ km from the centre .* unit another"),
        ({"position": "v"}, r"gnss\.position: .* or are these no coordinates of the Earth \(ECEF\)"),
        ({"position": "r", "lat": "t"}, r"gnss\.position: is given beside lat: say one of lat and position only"),
        ({}, r"gnss\.lat: is missing: a sensor of kind gnss needs lat or position"),
    ],
)
def test_what_can_be_no_place_of_a_vehicle_is_refused(gnss: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=said):
        read(tmp_path, earth_fixed(), gnss={"time": "t", **gnss})


def test_a_reference_has_one_place_and_needs_it_for_such_velocities(tmp_path: Path) -> None:
    velocity = {"column": "v", "frame": "ecef"}
    with pytest.raises(UserError, match=r"reference\.velocity: frame = \"ecef\" needs a position"):
        read(tmp_path, earth_fixed(), reference={"time": "t", "velocity": velocity})
    with pytest.raises(UserError, match=r"reference\.height: is given beside position"):
        read(tmp_path, earth_fixed(), reference={"time": "t", "position": "r", "height": "t"})


@pytest.mark.parametrize(
    ("key", "frame", "said"),
    [
        ("attitude", "ecef", r'attitude\.frame: must be one of "frd-ned", "flu-enu"'),
        ("velocity", "flu-enu", r'velocity\.frame: must be one of "frd-ned", "ecef"'),
        ("sigma_position", "ecef", r"sigma_position\.frame: is an attitude's or a velocity's"),
    ],
)
def test_frames_are_of_few(key: str, frame: str, said: str) -> None:
    columns = {"reference": {"time": "t", key: {"column": "q", "frame": frame}}}
    with pytest.raises(ValueError, match=said):
        LogTruth.model_validate({"source": "log", "file": "-", "columns": columns})
