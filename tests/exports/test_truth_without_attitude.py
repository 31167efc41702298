"""Truth that knows places and no attitude, as of a recorded flight whose reference is its receiver: all formats."""

from __future__ import annotations

import contextlib
import io
import shutil
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import h5py
import numpy as np
import pytest
from pymavlink import DFReader
from pyulog import ULog
from scipy.io import loadmat

from testbed.errors import UserError
from testbed.exports import FORMATS, export
from testbed.record.reader import load

pytestmark = pytest.mark.ci

GPX = {"g": "http://www.topografix.com/GPX/1/1"}
GAP = slice(100, 200)  # of a truth that knows its attitude else


def unturned(flown: Path, path: Path, rows: slice, *columns: str) -> Path:
    """A copy of the record without an attitude in these rows of truth, and without some more."""
    shutil.copy(flown, path)
    with h5py.File(path, "r+") as file:
        for name in ("q_nb", *columns):
            file[f"truth/{name}"][rows] = np.nan
    return path


@pytest.fixture(scope="module")
def never(flown: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return unturned(flown, tmp_path_factory.mktemp("never") / "run.nc", slice(None))


@pytest.fixture(scope="module")
def gap(flown: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return unturned(flown, tmp_path_factory.mktemp("gap") / "run.nc", GAP)


@pytest.fixture(scope="module")
def n(flown: Path) -> int:
    """Rows of truth."""
    return len(load(flown)["truth/time"])


def exported(path: Path, form: str, to: Path) -> Path:
    return export(path, form, to / f"out{FORMATS[form].ending}")


@pytest.mark.parametrize("form", ["gpx", "kml", "czml", "pos"])
def test_maps_are_as_with_an_attitude(form: str, flown: Path, never: Path, tmp_path: Path) -> None:
    with_it, without = (exported(path, form, tmp_path / path.parent.name) for path in (flown, never))
    files = sorted(with_it.iterdir()) if with_it.is_dir() else [with_it]
    assert files
    for file in files:
        assert file.read_bytes() == (without / file.name if without.is_dir() else without).read_bytes()
        assert b"nan" not in file.read_bytes().lower()


def test_a_gap_of_the_attitude_is_none_of_the_place(gap: Path, tmp_path: Path, n: int) -> None:
    root = ElementTree.parse(exported(gap, "gpx", tmp_path)).getroot()
    tracks = {t.findtext("g:name", None, GPX): t.findall(".//g:trkpt", GPX) for t in root.findall("g:trk", GPX)}
    assert len(tracks["truth"]) == n


def topics(path: Path) -> dict[tuple[str, int], dict[str, Any]]:
    return {(one.name, one.multi_id): one.data for one in ULog(str(path)).data_list}


def test_px4s_log_has_places_without_a_heading(flown: Path, never: Path, gap: Path, tmp_path: Path, n: int) -> None:
    whole, none, some = (topics(exported(path, "ulg", tmp_path / path.parent.name)) for path in (flown, never, gap))
    assert whole.keys() - none.keys() == {("vehicle_attitude_groundtruth", 0)}
    position = none["vehicle_local_position_groundtruth", 0]
    assert np.isnan(position["heading"]).all()
    assert not position["heading_good_for_control"].any()
    for name in ("x", "vy", "vz"):
        np.testing.assert_array_equal(position[name], whole["vehicle_local_position_groundtruth", 0][name])
    estimate = none["estimator_local_position", 0]
    np.testing.assert_array_equal(estimate["heading"], whole["estimator_local_position", 0]["heading"])
    turned = some["vehicle_attitude_groundtruth", 0]
    assert len(turned["timestamp"]) == n - 100
    assert np.isfinite(turned["q[0]"]).all()
    assert (~some["vehicle_local_position_groundtruth", 0]["heading_good_for_control"].astype(bool)).sum() == 100


def test_ardupilots_log_has_places_without_a_quaternion(never: Path, tmp_path: Path, n: int) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        log = DFReader.DFReader_binary(str(exported(never, "bin", tmp_path)))
    found: dict[str, list[Any]] = {}
    while (message := log.recv_msg()) is not None:
        found.setdefault(message.get_type(), []).append(message)
    log.close()
    assert len(found["SIM"]) == n
    truth = load(never)["truth"]
    lat = [message.Lat for message in found["SIM"]]
    np.testing.assert_allclose(lat, np.degrees(truth["lat"].values), rtol=0, atol=1e-7)
    assert all(np.isnan(message.Q1) and message.Roll == 0 for message in found["SIM"])
    assert any(message.Roll != 0 for message in found["XKF1"])


def test_mcap_has_no_pose_of_it(never: Path, gap: Path, tmp_path: Path, n: int) -> None:
    reading = pytest.importorskip("mcap.reader", reason="the extra mcap is not installed")
    counts = []
    for path in (never, gap):
        content = exported(path, "mcap", tmp_path / path.parent.name).read_bytes()
        topics: dict[str, int] = {}
        for _, channel, message in reading.make_reader(io.BytesIO(content)).iter_messages():
            topics[channel.topic] = topics.get(channel.topic, 0) + 1
            assert b"NaN" not in message.data
        counts.append((topics.get("/truth/pose", 0), topics["/truth/location"]))
        assert topics["/estimators/ins/pose"]
    assert counts == [(0, n), (n - 100, n)]


def test_toolboxes_have_rows_with_an_attitude_or_none_at_all(never: Path, gap: Path, tmp_path: Path, n: int) -> None:
    none, some = (
        [
            loadmat(exported(path, form, tmp_path / path.parent.name), simplify_cells=True)
            for form in ("navego", "psins")
        ]
        for path in (never, gap)
    )
    assert set(none[0]["ref"]) == {"t", "lat", "lon", "h", "vel", "freq"}
    assert len(none[0]["ref"]["lat"]) == n
    assert set(none[1]["trj"]) == {"imu", "ts"}
    assert len(some[0]["ref"]["roll"]) == len(some[0]["ref"]["lat"]) == len(some[1]["trj"]["avp"]) == n - 100
    assert all(np.isfinite(one).all() for one in (some[0]["ref"]["yaw"], some[1]["trj"]["avp"], some[1]["trj"]["avp0"]))


def test_truth_of_which_nothing_is_known_is_told_as_such(flown: Path, tmp_path: Path) -> None:
    path = unturned(flown, tmp_path / "run.nc", slice(None), "lat", "lon", "h")
    with pytest.raises(
        UserError, match=r"the truth of the record is unknown: no row of it has a place or an attitude$"
    ):
        export(path, "gpx")
