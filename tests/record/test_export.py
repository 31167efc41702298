"""CSV and MATLAB files hold the record's numbers, with their units."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas
import pytest
from scipy.io import loadmat
from worlds import synthetic_run

from testbed.errors import UserError
from testbed.record.export import export
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
    assert {p.stem for p in folder.iterdir()} == groups
    own = pandas.read_csv(folder / "estimators.ins.csv", dtype=str)
    assert own.columns[0] == "time [s]"
    np.testing.assert_array_equal(own["v_n.east [m/s]"].astype(float), tree["estimators/ins/v_n"].values[:, 1])
    np.testing.assert_array_equal(own["lat [rad]"].astype(float), tree["estimators/ins/lat"].values)
    events = pandas.read_csv(folder / "events.csv")
    assert events["text"].tolist() == ["leg 1/2 «circle»"]
    imu = pandas.read_csv(folder / "sensors.imu.csv", dtype=str)
    np.testing.assert_array_equal(imu["dv.down [m/s]"].astype(float), tree["sensors/imu/dv"].values[:, 2])


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


def test_unwritable_target_is_told(run_file: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for kind in ("csv", "mat"):
        with pytest.raises(UserError, match="can't be written"):
            export(run_file, kind, tmp_path / "file" / "x")
