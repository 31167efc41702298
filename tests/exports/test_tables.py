"""CSV and MATLAB files hold the record's numbers, with their units."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pandas
import pytest
from scipy.io import loadmat
from worlds import synthetic_run
from worlds.full_disk import file_size_limit

from testbed import results
from testbed.errors import UserError
from testbed.exports import export
from testbed.record.recorder import load


@pytest.fixture(scope="module")
def run_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("export") / "run.nc"
    synthetic_run.dataset(10.0, path=path)
    return path


def test_csv_has_one_file_per_group_with_units_in_its_header(run_file: Path) -> None:
    folder = export(run_file, "csv")
    tree = load(run_file)
    assert folder == run_file.with_name("run_csv")
    groups = {n.path.strip("/").replace("/", ".") for n in tree.subtree if n.to_dataset(inherit=False).data_vars}
    assert {p.stem for p in folder.glob("*.csv")} == groups
    own = pandas.read_csv(folder / "estimators.ins.csv", dtype=str)
    assert own.columns[0] == "time [s]"
    np.testing.assert_array_equal(own["v_n.east [m/s]"].astype(float), tree["estimators/ins/v_n"].values[:, 1])
    np.testing.assert_array_equal(own["lat [rad]"].astype(float), tree["estimators/ins/lat"].values)
    events = pandas.read_csv(folder / "events.csv")
    assert events["text"].tolist() == ["leg 1/2 «circle»"]
    imu = pandas.read_csv(folder / "sensors.imu.csv", dtype=str)
    np.testing.assert_array_equal(imu["dv.down [m/s]"].astype(float), tree["sensors/imu/dv"].values[:, 2])


def test_each_component_has_its_own_unit(run_file: Path, tmp_path: Path) -> None:
    truth = pandas.read_csv(export(run_file, "csv", tmp_path / "units") / "truth.csv", nrows=1)
    assert {"commands.bank [rad]", "commands.altitude [m]", "commands.airspeed [m/s]"} <= set(truth.columns)


@pytest.mark.ci
def test_an_export_replaces_an_earlier_one_but_nothing_else(run_file: Path, tmp_path: Path) -> None:
    record = tmp_path / "run.nc"
    shutil.copy(run_file, record)
    before = record.read_bytes()
    with pytest.raises(UserError, match=r"run\.nc: is the record itself"):
        export(record, "mat", record)
    (tmp_path / "run.mat").write_text("mine")
    with pytest.raises(UserError, match=r"run\.mat already, not made by an earlier command"):
        export(record, "mat")
    (tmp_path / "run.mat").unlink()
    (tmp_path / "run_csv").mkdir()
    (tmp_path / "run_csv/truth.csv").write_text("mine")
    with pytest.raises(UserError, match=r"run_csv: there is truth\.csv already"):
        export(record, "csv")
    assert (record.read_bytes(), (tmp_path / "run_csv/truth.csv").read_text()) == (before, "mine")
    for _ in range(2):
        export(record, "csv", force=True)
    results.enter(tmp_path, ["run.nc"])
    for _ in range(2):
        export(record, "csv")
        export(record, "mat")
    results.start_anew(tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("form", ["csv", "mat"])
def test_a_full_disk_leaves_no_half_export(run_file: Path, tmp_path: Path, form: str) -> None:
    with file_size_limit(100_000), pytest.raises(UserError, match="can't be written: File too large"):
        export(run_file, form, tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_mat_has_a_struct_per_group_with_units(run_file: Path, tmp_path: Path) -> None:
    path = export(run_file, "mat", tmp_path / "deep" / "run.mat")
    tree = load(run_file)
    found = loadmat(path, simplify_cells=True)
    np.testing.assert_array_equal(found["truth"]["q_nb"], tree["truth/q_nb"].values)
    assert found["truth"]["units"]["v_n"] == "m/s"
    reports = found["estimators"]["ins"]["innovations"]["gnss_position"]
    np.testing.assert_array_equal(reports["S"], tree["estimators/ins/innovations/gnss_position/S"].values)
    assert found["events"]["text"] == "leg 1/2 «circle»"
    assert found["attributes"]["seed"] == 3


def test_a_folder_in_the_place_of_a_file_is_told(run_file: Path, tmp_path: Path) -> None:
    for force in (False, True):
        with pytest.raises(UserError, match="is a folder: give the name of a file"):
            export(run_file, "mat", tmp_path, force)


def test_unwritable_target_is_told(run_file: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for kind in ("csv", "mat"):
        with pytest.raises(UserError, match="can't be written"):
            export(run_file, kind, tmp_path / "file" / "x")
