"""Files that are cut, broken, empty or something else: one clear message each, or what is left of them."""

from __future__ import annotations

import gzip
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from worlds import log_writers
from worlds.recordings import log_of

from testbed import Scenario, run
from testbed.errors import UserError
from testbed.feeds import formats
from testbed.feeds.log import Log
from testbed.motion.logged import LogTruth

ROUNDS = 15


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A short simulated run in every format."""
    folder = tmp_path_factory.mktemp("logs")
    dataset = run(Scenario.load("kinematic_u_flight", {"duration_s": 8, "fault": []}), out=folder).dataset
    t = np.arange(400) / 50
    np.savez_compressed(folder / "a.npz", t=t, w=np.zeros((400, 3)), f=np.full((400, 3), [0.0, 0.0, -9.8]))
    from scipy.io import savemat

    savemat(folder / "a.mat", {"log": {"t": t, "w": np.zeros((400, 3)), "f": np.full((400, 3), -9.8)}})
    rows = pd.DataFrame({"t": t, "w": [[0.0, 0.0, 0.0]] * 400, "f": [[0.0, 0.0, -9.8]] * 400, "note": ["a"] * 400})
    rows.to_parquet(folder / "a.parquet")
    return {
        "nc": folder / "run.nc",
        "bin": log_writers.dataflash(log_writers.dataflash_rows(dataset), folder / "a.bin"),
        "log": log_writers.dataflash_text(log_writers.dataflash_rows(dataset), folder / "a.log"),
        "ulg": log_writers.ulog(log_writers.ulog_rows(dataset), folder / "a.ulg"),
        "csv": log_writers.csv(dataset, folder / "a.csv"),
        "npz": folder / "a.npz",
        "mat": folder / "a.mat",
        "parquet": folder / "a.parquet",
    }


COLUMNS: dict[str, Any] = {
    "csv": log_writers.CSV,
    "npz": {"imu": {"time": "t", "gyro": "w", "accel": "f"}},
    "parquet": {"imu": {"time": "t", "gyro": "w", "accel": "f"}},
    "mat": {"imu": {"time": "log.t", "gyro": "log.w", "accel": "log.f"}},
}


def read(path: Path, name: str) -> Log:
    truth = LogTruth.model_validate({"source": "log", "file": "-", "columns": COLUMNS.get(name, {})})
    return formats.read(path, truth.columns)


@pytest.mark.parametrize("name", ["nc", "bin", "log", "ulg", "csv", "npz", "mat", "parquet"])
def test_every_format_is_known_by_its_content(files: dict[str, Path], name: str, tmp_path: Path) -> None:
    disguised = tmp_path / "flight.dat"
    disguised.write_bytes(files[name].read_bytes())
    log = read(disguised, name)
    assert len(log.imus["imu"]) > 300
    assert log.t0 >= 0


def test_parquet_without_its_library_is_refused_with_its_name(
    files: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UserError, match="pip install pyarrow"):
        read(files["parquet"], "parquet")


def broken(name: str, whole: bytes, kind: str, rng: np.random.Generator) -> bytes:
    match kind:
        case "cut":
            return whole[: rng.integers(len(whole))]
        case "flipped":
            damaged = bytearray(whole)
            for k in rng.integers(len(whole), size=20):
                damaged[k] ^= 1 << int(rng.integers(8))
            return bytes(damaged)
    at = int(rng.integers(len(whole)))
    return whole[:at] + rng.bytes(int(rng.integers(1, 400))) + whole[at + 200 :]


@pytest.mark.ci
@pytest.mark.parametrize("name", ["nc", "bin", "log", "ulg", "csv", "npz", "mat", "parquet"])
@pytest.mark.parametrize("kind", ["cut", "flipped", "noise"])
def test_a_broken_log_is_read_as_far_as_it_goes_or_refused(
    files: dict[str, Path], name: str, kind: str, tmp_path: Path
) -> None:
    rng = np.random.default_rng([len(name), len(kind)])
    whole = files[name].read_bytes()
    for _ in range(ROUNDS):
        path = tmp_path / "broken"
        path.write_bytes(broken(name, whole, kind, rng))
        log, refused = attempted(path, name)
        if log is None:
            assert "broken" in refused or "truth.columns" in refused
        else:
            assert all((np.diff(imu.t) > 0).all() for imu in log.imus.values())


def attempted(path: Path, name: str) -> tuple[Log | None, str]:
    """The log, or why it was refused; anything but a UserError is raised."""
    try:
        return read(path, name), ""
    except UserError as error:
        return None, str(error)


@pytest.mark.parametrize("name", ["bin", "ulg"])
def test_what_can_not_be_read_of_a_log_is_told(files: dict[str, Path], name: str, tmp_path: Path) -> None:
    whole = files[name].read_bytes()
    path = tmp_path / "broken"
    half = len(whole) // 2
    for bad in (b"", bytes(1000)):
        path.write_bytes(whole[:half] + bad + whole[half:])
        told = [note for note in read(path, name).notes if "can't be read, and are left out: it is damaged" in note]
        assert len(told) == bool(bad)
        if bad and name == "bin":  # with the message that they are in
            lost, size = (int(word) for word in told[0].split() if word.isdecimal())
            assert len(bad) <= lost <= len(bad) + 200
            assert size == len(whole) + len(bad)


def test_a_number_that_one_damaged_message_has_is_no_unit(files: dict[str, Path], tmp_path: Path) -> None:
    whole = bytearray(files["bin"].read_bytes())
    at = whole.index(b"\xa3\x95\x83", 2000)  # a GPS message: its number is after its time
    whole[at + 11] = 77
    path = tmp_path / "broken"
    path.write_bytes(whole)
    log = read(path, "bin")
    assert [one for one in log.names if one.startswith("gnss")] == ["gnss"]
    assert len(log.samples["gnss"]) == len(read(files["bin"], "bin").samples["gnss"]) - 1


def nothing(path: Path) -> None:
    path.write_bytes(b"")


def words(path: Path) -> None:
    path.write_text("It was a fine flight.\n")


def picture(path: Path) -> None:
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(500))


def huge(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(2 << 30)


def folder(path: Path) -> None:
    path.mkdir()


def telemetry(path: Path) -> None:
    packet = bytes(8) + b"\xfd\x09\x00\x00\x00\x01\x01\x00\x00\x00" + bytes(11)
    path.write_bytes(packet * 50)


def compressed(path: Path) -> None:
    path.write_bytes(gzip.compress(b"t,a\n0.1,2\n"))


def json_lines(path: Path) -> None:
    path.write_text('{"type": "IMU", "data": {"TimeUS": 1, "GyrX": 0.1}}\n{"type": "IMU", "data": {"TimeUS": 2}}\n')


def json_list(path: Path) -> None:
    path.write_text('[\n  {"t": 0.1, "gyro_x": 0.2}\n]\n')


def wide_text(path: Path) -> None:
    path.write_text("t,a\n0.1,2\n", encoding="utf-16")


def matlab_7_3(path: Path) -> None:
    path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(128) + bytes(384) + b"\x89HDF\r\n\x1a\n")


def pointer(path: Path) -> None:
    path.write_text(f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 4053364\n")


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (nothing, "is empty"),
        (pointer, "is a pointer of Git LFS in place of the log"),
        (matlab_7_3, "is a MATLAB file of version 7.3: save it with -v7"),
        (compressed, "is compressed: unpack it first"),
        (json_lines, "is JSON: write it as a table"),
        (json_list, "is JSON: write it as a table"),
        (wide_text, "is text in UTF-16: save it as UTF-8"),
        (words, "is no log of a known format"),
        (picture, "is no log of a known format"),
        (huge, "2.0 GiB"),
        (folder, "is a folder"),
        (telemetry, "telemetry"),
    ],
)
def test_what_is_no_log_is_told(make: Callable[[Path], None], said: str, tmp_path: Path) -> None:
    path = tmp_path / "flight"
    make(path)
    with pytest.raises(UserError, match=said) as caught:
        formats.read(path, {})
    assert str(path) in str(caught.value)


def test_a_log_without_imu_says_what_it_has_and_what_it_needs(files: dict[str, Path], tmp_path: Path) -> None:
    text = "\n".join(line for line in files["log"].read_text().splitlines() if not line.startswith("IMU"))
    path = tmp_path / "1.log"
    path.write_text(text + "\n")
    with pytest.raises(UserError, match=r"needed are IMU.*GPS \(\d+\)"):
        formats.read(path, {})


def test_a_sensor_that_the_log_has_not_is_told(files: dict[str, Path], tmp_path: Path) -> None:
    text = log_of(Scenario.load("kinematic_u_flight").text, files["nc"]) + '[sensors.gnss7]\nkind = "gnss"\n'
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(UserError, match=r"sensors\.gnss7: .*it has imu"):
        run(Scenario.load(tmp_path / "a.toml"))


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ({"imu": {"time": "t", "gyro": "w"}}, "truth.columns.imu.accel: is missing"),
        ({"imu": {"time": "t", "gyro": "w", "accel": "g"}}, 'no column "g"'),
        ({"imu": {"time": "t", "gyro": "t", "accel": "f"}}, "has 1 columns: 3 are needed"),
        ({"imu": {"time": "t", "gyro": {"column": "w", "unit": "rpm"}, "accel": "f"}}, 'no unit "rpm"'),
        ({"imu": {"time": "t", "gyro": "w", "accel": "f", "lat": "t"}}, "is nothing that a sensor of kind imu has"),
        ({"compass": {"time": "t", "field": "w"}}, 'no kind "compass"'),
        ({}, "say in"),
    ],
)
def test_a_table_that_is_not_what_was_said_is_told(files: dict[str, Path], columns: Any, said: str) -> None:
    truth = LogTruth.model_validate({"source": "log", "file": "-", "columns": columns})
    with pytest.raises(UserError, match=said):
        formats.read(files["npz"], truth.columns)
