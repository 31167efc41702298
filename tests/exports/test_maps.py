"""What goes onto maps and into other toolboxes: places, times, ellipses and axes, read back by independent means."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import h5py
import numpy as np
import pymap3d
import pytest
from scipy.io import loadmat
from scipy.spatial.transform import Rotation
from worlds import synthetic_run

from testbed import results
from testbed.errors import UserError
from testbed.exports import FORMATS, export
from testbed.exports.track import CONFIDENT, Track, ellipse, outlines
from testbed.record.reader import load
from testbed.record.recorder import Recorder

pytestmark = pytest.mark.ci

KML = {"k": "http://www.opengis.net/kml/2.2", "gx": "http://www.google.com/kml/ext/2.2"}
GPX = {"g": "http://www.topografix.com/GPX/1/1"}


@pytest.fixture(scope="module")
def record(flown: Path) -> Any:
    return load(flown)


@pytest.fixture
def exported(flown: Path, tmp_path: Path) -> Callable[[str], Path]:
    return lambda form: export(flown, form, tmp_path / FORMATS[form].ending)


def in_degrees(own: Any) -> Any:
    return np.column_stack([np.degrees(own["lon"].values), np.degrees(own["lat"].values), own["h"].values])


def test_kml_has_tracks_denied_stretches_and_ellipses(exported: Any, record: Any) -> None:
    root = ElementTree.parse(exported("kml")).getroot()
    folders = {f.findtext("k:name", None, KML): f for f in root.findall(".//k:Folder", KML)}
    assert set(folders) == {"truth", "ins"}
    track = folders["truth"].find(".//gx:Track", KML)
    assert track is not None
    places = np.array([[float(x) for x in c.text.split()] for c in track.findall("gx:coord", KML)])
    np.testing.assert_allclose(places, in_degrees(record["truth"]), rtol=0, atol=5.1e-4)
    np.testing.assert_allclose(places[:, :2], in_degrees(record["truth"])[:, :2], rtol=0, atol=5.1e-10)
    times = [w.text for w in track.findall("k:when", KML)]
    assert (times[0], times[-1]) == ("2026-06-01T00:00:00.000Z", "2026-06-01T00:00:40.000Z")
    names = [m.findtext("k:name", None, KML) for m in folders["truth"].findall("k:Placemark", KML)]
    assert len(names) == 2
    assert names[1] == "no GNSS, 26 to 32.12 s"  # while neither receiver has any; the first is back after 2 s and 0.12
    assert folders["ins"].find(".//k:Polygon", KML) is not None


def test_czml_says_the_same_over_time(exported: Any, record: Any) -> None:
    packets = {p["id"]: p for p in json.loads(exported("czml").read_text("utf-8"))}
    assert packets["document"]["version"] == "1.0"
    rows = np.array(packets["truth"]["position"]["cartographicDegrees"]).reshape(-1, 4)
    np.testing.assert_allclose(rows[:, 1:], in_degrees(record["truth"]), rtol=0, atol=1e-9)
    assert packets["ins"]["availability"].endswith("/2026-06-01T00:00:40.000Z")
    larger, smaller = (
        np.array(packets["ins"]["ellipse"][axis]["number"])[1::2] for axis in ("semiMajorAxis", "semiMinorAxis")
    )
    assert (larger >= smaller).all()
    assert any(name.startswith("denied") for name in packets)


@pytest.mark.parametrize(("known", "shown"), [(28.0, 1), (0.0, 0)])
def test_a_denied_stretch_without_a_place_is_left_out(known: float, shown: int, flown: Path, tmp_path: Path) -> None:
    """Where the truth of a recorded flight was unknown it was a line without a point."""
    shutil.copy(flown, tmp_path / "run.nc")
    with h5py.File(tmp_path / "run.nc", "r+") as file:
        t = file["truth/time"][:]
        file["truth/lat"][(t > known) & (t < 33.0)] = np.nan
    root = ElementTree.parse(export(tmp_path / "run.nc", "kml")).getroot()
    lines = root.findall(".//k:LineString/k:coordinates", KML)
    packets = json.loads(export(tmp_path / "run.nc", "czml").read_text("utf-8"))
    stretches = [one["polyline"]["positions"]["cartographicDegrees"] for one in packets if "polyline" in one]
    assert len(lines) == len(stretches) == shown
    assert all(line.text for line in lines)
    assert all(stretches)


def test_ellipses_enclose_what_they_claim() -> None:
    covariance = np.zeros((2, 3, 3))
    covariance[:, :2, :2] = [[9.0, 3.0], [3.0, 4.0]]
    t = np.array([0.0, 30.0])
    lat, lon, h = np.full(2, 0.6), np.full(2, 1.9), np.full(2, 500.0)
    (_, corners), *_ = outlines(Track("a", t, lat, lon, h, covariance))
    east, north, _ = pymap3d.geodetic2enu(*np.degrees(corners[:, :2].T), corners[:, 2], *np.degrees([0.6, 1.9]), 500.0)
    offsets = np.column_stack([north, east])
    distance = np.einsum("ki,ij,kj->k", offsets, np.linalg.inv(covariance[0, :2, :2]), offsets)
    np.testing.assert_allclose(distance, CONFIDENT, rtol=1e-4)
    larger, smaller, azimuth = ellipse(covariance)
    assert larger[0] > smaller[0]
    assert np.degrees(azimuth[0]) % 180 == pytest.approx(25.1, abs=0.1)  # towards north-east


def test_gpx_has_receivers_where_they_had_a_fix(exported: Any, record: Any) -> None:
    root = ElementTree.parse(exported("gpx")).getroot()
    found = {t.findtext("g:name", None, GPX): t.findall(".//g:trkpt", GPX) for t in root.findall("g:trk", GPX)}
    assert set(found) == {"truth", "gnss", "second", "ins"}
    fix = record["sensors/gnss/fix_type"].values >= 3
    places = np.array([[float(p.get("lon")), float(p.get("lat"))] for p in found["gnss"]])
    np.testing.assert_allclose(places, in_degrees(record["sensors/gnss"])[fix, :2], rtol=0, atol=5.1e-10)


def test_solutions_for_rtklib_are_in_gps_time(exported: Any, record: Any) -> None:
    folder = exported("pos")
    assert {p.name for p in folder.glob("*.pos")} == {"truth.pos", "gnss.pos", "second.pos", "ins.pos"}
    lines = [line for line in (folder / "ins.pos").read_text("utf-8").splitlines() if line[0] != "%"]
    own = record["estimators/ins"]
    known = np.isfinite(own["lat"].values)
    assert len(lines) == known.sum()
    date, clock, lat, lon, h, quality, _, *sigmas = lines[-1].split()
    assert (date, clock, quality) == ("2026/06/01", "00:00:58.000", "5")  # 18 s ahead of UTC
    np.testing.assert_allclose([float(lon), float(lat), float(h)], in_degrees(own)[-1], rtol=0, atol=5.1e-5)
    P = own["covariance"].values[-1]
    told = np.array(sigmas[:6], float)
    np.testing.assert_allclose(told[:3], np.sqrt(np.diagonal(P)[:3]), atol=5.1e-5)
    np.testing.assert_allclose(told[3:] * np.abs(told[3:]), [P[0, 1], -P[1, 2], -P[2, 0]], atol=2e-4)


def test_navego_has_imu_receiver_and_reference(exported: Any, record: Any) -> None:
    found = loadmat(exported("navego"), simplify_cells=True)
    imu = record["sensors/imu"]
    np.testing.assert_array_equal(found["imu"]["fb"], imu["dv"].values / imu["dt"].values[:, None])
    assert found["imu"]["freq"] == pytest.approx(200)
    angles = np.column_stack([found["ref"][name] for name in ("yaw", "pitch", "roll")])
    same = Rotation.from_euler("ZYX", angles) * Rotation.from_quat(record["truth/q_nb"].values, scalar_first=True).inv()
    assert same.magnitude().max() < 1e-7
    assert np.isfinite(found["gnss"]["lat"]).all()
    np.testing.assert_array_equal(found["gnss"]["larm"], [0.5, 0.0, -0.3])


def test_psins_has_its_axes(exported: Any, record: Any) -> None:
    found = loadmat(exported("psins"), simplify_cells=True)
    imu, avp = found["trj"]["imu"], found["trj"]["avp"]
    own = record["sensors/imu"]
    np.testing.assert_array_equal(imu[:, 0], own["dtheta"].values[:, 1])  # right
    np.testing.assert_array_equal(imu[:, 5], -own["dv"].values[:, 2])  # up
    # PSINS turns about up, then right, then forward; seen from north-east-down the same attitude.
    turned = Rotation.from_euler("ZXY", np.column_stack([avp[:, 2], avp[:, 0], avp[:, 1]]))
    swap = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    truth = Rotation.from_quat(record["truth/q_nb"].values, scalar_first=True)
    assert (swap * turned * swap * truth.inv()).magnitude().max() < 1e-7
    np.testing.assert_array_equal(avp[:, 6], record["truth/lat"].values)
    np.testing.assert_array_equal(avp[:, 5], -record["truth/v_n"].values[:, 2])


@pytest.mark.parametrize("form", ["navego", "psins", "ulg", "bin"])
def test_increments_that_are_missing_are_left_out(form: str, flown: Path, tmp_path: Path) -> None:
    """A NaN would end a toolbox's solution: time shows the gap."""
    whole, gap = tmp_path / "whole.nc", tmp_path / "gap.nc"
    for path in (whole, gap):
        shutil.copy(flown, path)
    with h5py.File(gap, "r+") as file:
        file["sensors/imu/dtheta"][200:300] = np.nan
        file["sensors/imu/dv"][200:300] = np.nan
    paths = [export(path, form) for path in (whole, gap)]
    if form in ("navego", "psins"):
        rows = [loadmat(path, simplify_cells=True) for path in paths]
        rows = [one["imu"]["fb"] if form == "navego" else one["trj"]["imu"] for one in rows]
        assert len(rows[0]) - len(rows[1]) == 100
        assert np.isfinite(rows[1]).all()
    else:
        assert paths[1].stat().st_size < paths[0].stat().st_size


def test_mcap_is_read_by_its_own_library(exported: Any, record: Any) -> None:
    reading = pytest.importorskip("mcap.reader", reason="the extra mcap is not installed")
    reader = reading.make_reader(io.BytesIO(exported("mcap").read_bytes()))
    messages: dict[str, list[Any]] = {}
    for schema, channel, message in reader.iter_messages():
        messages.setdefault(channel.topic, []).append((schema.name, message.log_time, json.loads(message.data)))
    assert set(messages) >= {"/truth/location", "/truth/pose", "/estimators/ins/location", "/sensors/imu", "/events"}
    kind, when, place = messages["/truth/location"][-1]
    assert (kind, when) == ("foxglove.LocationFix", (1780272000 + 40) * 10**9)
    assert place["latitude"] == np.degrees(record["truth/lat"].values[-1])
    _, _, said = messages["/truth/pose"][-1]
    orientation = Rotation.from_quat([said["pose"]["orientation"][axis] for axis in "xyzw"])
    # Forward in east-north-up, by the heading.
    v = record["truth/v_n"].values[-1]
    forward = orientation.apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(forward[:2], v[[1, 0]] / np.linalg.norm(v), atol=1e-3)
    assert orientation.apply([0.0, 0.0, 1.0])[2] > 0.9  # upright
    imu = messages["/sensors/imu"][0][2]
    assert imu["linear_acceleration"]["z"] > 9  # at rest and in level flight upwards


def test_a_record_whose_scenario_is_no_longer_read_is_told(tmp_path: Path) -> None:
    path = tmp_path / "run.nc"
    synthetic_run.dataset(3.0, path=path, gnss=False)
    with pytest.raises(UserError, match=r"run\.nc: .*no longer read"):
        export(path, "ulg")


def test_toolboxes_need_inertial_samples(tmp_path: Path) -> None:
    path = tmp_path / "run.nc"
    recorder = Recorder(path, synthetic_run.scenario(1.0), 3)
    recorder.truth(synthetic_run.circle(1.0))
    recorder.close()
    with pytest.raises(UserError, match=r"run\.nc: the record has no inertial samples: run it with record\.imu = true"):
        export(path, "psins")


def test_each_format_says_who_reads_it() -> None:
    assert set(FORMATS) >= {"csv", "mat", "ulg", "bin", "mcap", "kml", "czml", "gpx", "pos", "navego", "psins"}
    assert all(one.holds and one.readers for one in FORMATS.values())
    assert len({one.ending for one in FORMATS.values()}) == len(FORMATS)  # none takes another's place


def test_an_export_never_goes_over_results(flown: Path, tmp_path: Path) -> None:
    """Into a folder of results it took away the record and all beside it."""
    shutil.copy(flown, tmp_path / "run.nc")
    results.enter(tmp_path, ["run.nc"])
    with pytest.raises(UserError, match="has the results of a run: choose another folder"):
        export(flown, "csv", tmp_path, force=True)
    for name in ("run.nc", "metrics.json"):
        with pytest.raises(UserError, match=f"{name}: is what a result of another command is called"):
            export(flown, "kml", tmp_path / name, force=True)
    assert {path.name for path in tmp_path.iterdir()} == {"run.nc", results.MANIFEST}
    assert (tmp_path / "run.nc").read_bytes() == flown.read_bytes()


@pytest.mark.parametrize("form", ["kml", "czml", "gpx", "pos"])
def test_a_record_without_a_place_is_exported(flown: Path, form: str, tmp_path: Path) -> None:
    """Of a log without positions: one format ended in a traceback."""
    shutil.copy(flown, tmp_path / "run.nc")
    with h5py.File(tmp_path / "run.nc", "r+") as file:
        for group in (file["truth"], *file["estimators"].values()):
            group["lat"][:] = np.nan
    assert export(tmp_path / "run.nc", form).exists()
