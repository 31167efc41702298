"""The record of a run: what goes in comes out, labelled; it survives its writer and says clearly what it can't read."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import h5py
import numpy as np
import pytest
import xarray
from worlds import synthetic_run
from worlds.full_disk import file_size_limit
from worlds.synthetic_run import Errors, circle, scenario

from nav.columns import Estimates, Samples, delivered
from nav.samples import ImuSamples, MagnetometerSample, Outcome, UpdateReport
from testbed import interrupts
from testbed.errors import UserError
from testbed.motion.table import COLUMNS, TruthBlock
from testbed.record import hdf5, tables
from testbed.record import recorder as record
from testbed.record.columns import AXES
from testbed.record.reader import load
from testbed.record.recorder import Recorder
from testbed.record.tables import Table

TWO = {"ins": Errors(), "dead_reckoning": Errors(drift_mps=5.0)}
DENIED = ((20.0, 40.0),)


def make(path: Path | None, chunk: int = 200, duration: float = 60.0) -> Recorder:
    recorder = Recorder(path, scenario(duration), 3)
    synthetic_run.record(recorder, circle(duration), TWO, DENIED, chunk)
    return recorder


@pytest.fixture(scope="module")
def run_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "run.nc"
    make(path).close()
    return path


def variables(tree: Any) -> dict[str, Any]:
    """Every variable by path, inherited coordinates left out."""
    return {
        f"{node.path}/{name}": variable
        for node in tree.subtree
        for name, variable in node.to_dataset(inherit=False).variables.items()
    }


def assert_same(a: Any, b: Any) -> None:
    left, right = variables(a), variables(b)
    assert left.keys() == right.keys()
    for path, variable in left.items():
        assert variable.dims == right[path].dims, path
        assert variable.attrs == right[path].attrs, path
        if variable.dtype.kind in "USO":
            assert variable.values.tolist() == right[path].values.tolist(), path
        else:
            np.testing.assert_array_equal(variable.values, right[path].values, err_msg=path)


def test_samples_in_columns_are_recorded_as_single_ones_are() -> None:
    t, field_b = np.arange(20) * 0.5, np.random.default_rng(2).standard_normal((20, 3))
    many = delivered(MagnetometerSample, "compass", t, 0.1, field_b=field_b)
    assert isinstance(many, Samples)
    found = []
    for pieces in ([[*many]], [many], [many[:9], [*many[9:12]], many[12:]]):
        recorder = Recorder(None, scenario(10.0), 3)
        recorder.truth(circle(10.0))
        for piece in pieces:
            recorder.samples("compass", piece)
        found.append(recorder.dataset())
    assert_same(found[0], found[1])
    assert_same(found[0], found[2])
    assert np.array_equal(found[0]["sensors/compass/field_b"], field_b)


def test_truth_is_recorded_at_its_own_rate_with_summed_increments(run_file: Path) -> None:
    truth, expected = load(run_file)["truth"], circle(60.0)
    assert len(truth["time"]) == 601
    np.testing.assert_array_equal(truth["time"], expected.t[::20])
    for name in COLUMNS.keys() - {"t", "dtheta", "dv"}:
        np.testing.assert_array_equal(truth[name], getattr(expected, name)[::20], err_msg=name)
    for name in ("dtheta", "dv"):
        total = np.cumsum(getattr(expected, name), axis=0)[::20]
        np.testing.assert_allclose(np.cumsum(truth[name].values, axis=0), total, rtol=0, atol=1e-12)


def test_imu_keeps_every_sample(run_file: Path) -> None:
    imu, expected = load(run_file)["sensors/imu"], circle(60.0)
    np.testing.assert_array_equal(imu["time"], expected.t)
    np.testing.assert_array_equal(imu["dtheta"], expected.dtheta)
    np.testing.assert_array_equal(imu["dv"], expected.dv)


def test_samples_estimates_reports_and_events_come_back(run_file: Path) -> None:
    tree, truth = load(run_file), circle(60.0)
    gnss = tree["sensors/gnss"]
    np.testing.assert_array_equal(gnss["time"], truth.t[::40])
    np.testing.assert_array_equal(gnss["t_arrival"], truth.t[::40] + 0.1)
    out = (truth.t[::40] >= 20) & (truth.t[::40] < 40)
    np.testing.assert_array_equal(gnss["fix_type"], np.where(out, 1, 3))
    np.testing.assert_array_equal(gnss["v_n"][~out], truth.v_n[::40][~out])
    assert np.isnan(gnss["lat"].values[out]).all()
    estimates = list(synthetic_run.estimates(truth, TWO["ins"], np.random.default_rng([0, 0])).values())
    ins = tree["estimators/ins"]
    for name in ("lat", "lon", "h", "v_n", "q_nb", "gyro_bias", "accel_bias", "sigma_gyro_bias", "sigma_accel_bias"):
        np.testing.assert_array_equal(ins[name], np.array([getattr(e, name) for e in estimates]), err_msg=name)
    np.testing.assert_array_equal(ins["status"], [int(e.status) for e in estimates])
    covariance = np.array([e.covariance for e in estimates])
    np.testing.assert_allclose(ins["covariance"], covariance, rtol=1e-7)
    sigma = np.sqrt(np.array([np.diag(c) for c in covariance]))
    for k, name in enumerate(("sigma_position_n", "sigma_velocity_n", "sigma_attitude_n")):
        np.testing.assert_array_equal(ins[name], sigma[:, 3 * k : 3 * k + 3])
    aligned = [e for e in estimates if e.extra]
    assert np.isnan(ins["wind"].values[: -len(aligned)]).all()
    np.testing.assert_array_equal(ins["wind"][-len(aligned) :], [e.extra["wind"][0] for e in aligned])
    np.testing.assert_array_equal(
        ins["sigma_barometer_bias"][-len(aligned) :], [e.extra["barometer_bias"][1][0] for e in aligned]
    )
    reports = tree["estimators/ins/innovations/gnss_position"]
    S = reports["S"].values
    z = reports["innovation"].values
    np.testing.assert_allclose(reports["nis"], np.einsum("ki,kij,kj->k", z, np.linalg.inv(S), z))
    refused = reports["nis"].values > reports["threshold"].values
    np.testing.assert_array_equal(reports["weight"], np.where(refused, 0.0, 1.0))
    assert reports["reason"].values.tolist() == ["gate" if r else "" for r in refused]
    assert tree["events"]["text"].values.tolist() == ["leg 1/2 «circle»", "gnss denied", "gnss reacquired"]
    assert tree["events"]["severity"].values.tolist() == ["info", "warning", "info"]


def test_every_variable_has_a_unit_and_a_meaning(run_file: Path) -> None:
    text = {"reason", "severity", "text", "sensor"}
    for path, variable in variables(load(run_file)).items():
        if path.rsplit("/", 1)[1] in AXES:
            continue
        assert variable.attrs.get("long_name"), path
        assert path.rsplit("/", 1)[1] in text or variable.attrs.get("units"), path
        assert variable.attrs.get("units") != "unknown", path
        if variable.dims[1:] in {("ned",), ("body",), ("quaternion",)}:
            assert variable.attrs["frame"], path


def test_root_says_how_the_run_was_made(run_file: Path) -> None:
    attributes = load(run_file).attrs
    assert attributes["scenario"] == scenario().text
    assert json.loads(attributes["overrides"]) == ["seed=3"]
    assert attributes["seed"] == 3
    assert attributes["complete"] == 1
    versions = json.loads(attributes["versions"])
    assert versions["numpy"] == np.__version__
    assert all(v != "not installed" for v in versions.values())


@pytest.mark.ci
def test_memory_file_and_plain_xarray_agree(run_file: Path) -> None:
    loaded = load(run_file)
    recorder = make(None)
    recorder.close()
    assert_same(recorder.dataset(), loaded)
    with xarray.open_datatree(run_file) as plain:
        plain.load()
        for path, variable in variables(loaded).items():
            other = variables(plain)[path]
            assert other.dims == variable.dims
            if variable.dtype.kind == "U":
                assert other.values.tolist() == variable.values.tolist()
            else:
                np.testing.assert_array_equal(other.values, variable.values, err_msg=path)
                assert other.dtype == variable.dtype
        assert plain.attrs["scenario"] == loaded.attrs["scenario"]
        assert plain["estimators/ins"]["v_n"].sel(ned="east").attrs["units"] == "m/s"


@pytest.mark.ci
def test_reading_does_not_load_dask(run_file: Path) -> None:
    """Its arrays would be half of what a short run loads, and none of them is there."""
    script = (
        "import sys; from pathlib import Path; from testbed.record.reader import load;"
        "load(Path(sys.argv[1])); sys.exit('dask.array' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", script, str(run_file)], timeout=120).returncode == 0


@pytest.mark.ci
def test_chunking_changes_no_byte(tmp_path: Path, run_file: Path) -> None:
    for chunk in (7, 33, 4096):
        path = tmp_path / f"{chunk}.nc"
        make(path, chunk).close()
        assert_same(load(path), load(run_file))


def test_same_run_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.nc", "b.nc"):
        make(tmp_path / name, duration=10.0).close()
    assert (tmp_path / "a.nc").read_bytes() == (tmp_path / "b.nc").read_bytes()


@pytest.mark.ci
def test_every_flush_can_be_read_and_flushing_changes_nothing(tmp_path: Path, run_file: Path) -> None:
    path = tmp_path / "run.nc"
    recorder = Recorder(path, scenario(), 3)
    truth = circle(60.0)
    told = synthetic_run.estimates(truth, Errors(), np.random.default_rng(0))
    for start in range(0, len(truth), 397):
        block = truth.rows(start, min(start + 397, len(truth)))
        recorder.truth(block)
        for k in range(-(-start // 20) * 20, start + len(block), 20):
            recorder.estimates("late" if k > 6000 else "ins", Estimates.of([told[k]]))
        recorder.flush()
        tree = load(path)
        assert tree["truth"]["time"].values[-1] == truth.t[(start + len(block) - 1) // 20 * 20]
        assert tree.attrs["complete"] == 0
        np.testing.assert_array_equal(tree["truth"]["v_n"], truth.v_n[: start + len(block) : 20])
    recorder.close()
    tree = load(path)
    assert tree.attrs["complete"] == 1
    assert len(tree["estimators/ins"]["time"]) + len(tree["estimators/late"]["time"]) == 601
    assert not list(tmp_path.glob(".*"))


def test_a_column_that_appears_late_is_blank_before(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run.nc", scenario(), 3)
    truth = circle(20.0)
    told = synthetic_run.estimates(truth, Errors(), np.random.default_rng(0))
    recorder.truth(truth)
    for k in (0, 20, 2000, 2020):  # the extra states come with alignment at 5 s
        recorder.estimates("ins", Estimates.of([told[k]]))
        recorder.flush()
    recorder.close()
    wind = load(tmp_path / "run.nc")["estimators/ins"]["wind"].values
    assert np.isnan(wind[:2]).all()
    assert np.isfinite(wind[2:]).all()


def test_a_report_without_innovation_keeps_its_place(tmp_path: Path) -> None:
    """A broken sample is refused before an innovation is formed; its time may be broken too."""
    recorder = Recorder(tmp_path / "run.nc", scenario(), 3)
    fused = synthetic_run._report(1.0, "gnss", "gnss_position", 3, np.random.default_rng(0))
    refused = UpdateReport(
        np.nan, "gnss", "gnss_position", np.empty(0), np.empty((0, 0)), np.nan, np.nan, 0.0, Outcome.UNSOUND, "broken"
    )
    for reports in ([refused], [fused, refused], [fused], [fused]):
        recorder.reports("ins", reports)
        recorder.reports("ins", [replace(refused, t=2.0, aid="gnss")])
        recorder.flush()
    recorder.close()
    innovations = load(tmp_path / "run.nc")["estimators/ins/innovations"]
    assert innovations["gnss"]["reason"].values.tolist() == ["broken"] * 4
    assert innovations["gnss"]["outcome"].values.tolist() == [Outcome.UNSOUND] * 4
    position = innovations["gnss_position"]
    assert position["reason"].values.tolist() == ["broken", "", "broken", "", ""]
    np.testing.assert_array_equal(np.isnan(position["innovation"].values[:, 0]), [True, False, True, False, False])
    np.testing.assert_array_equal(position["S"][1], fused.S)


@pytest.mark.ci
def test_a_record_tended_in_spare_moments_is_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pieces of a new file are made between blocks, while rows, columns and groups go on coming."""
    monkeypatch.setattr(record, "FLUSH_WALL_S", 0.0)
    monkeypatch.setattr(record, "PIECE_S", 0.0)
    truth, errors = circle(60.0), {"ins": Errors(), "other": Errors(aligned_after=20)}
    plain = Recorder(None, scenario(60.0), 3)
    synthetic_run.record(plain, truth, errors, ((30.0, 50.0),))
    read = []

    class Tended(Recorder):
        def truth(self, block: TruthBlock) -> None:
            super().truth(block)
            self.tend(0.002)
            if path.exists() and len(read) < 5:
                read.append(load(path))  # while the next one is in the making

    path = tmp_path / "run.nc"
    tended = Tended(path, scenario(60.0), 3)
    synthetic_run.record(tended, truth, errors, ((30.0, 50.0),))
    tended.close()
    expected, whole = plain.dataset(), load(path)
    for node in expected.subtree:
        assert whole[node.path].to_dataset().drop_attrs().identical(node.to_dataset().drop_attrs()), node.path
    for early in read:
        rows = early["truth"].sizes["time"]
        np.testing.assert_array_equal(early["truth/lat"], expected["truth/lat"][:rows])
    assert 0 < read[0]["truth"].sizes["time"] < expected["truth"].sizes["time"]


def test_a_record_without_spare_moments_is_written_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record, "FLUSH_WALL_S", 0.0)
    monkeypatch.setattr(record, "UNTENDED_S", 0.0)
    recorder = Recorder(tmp_path / "run.nc", scenario(60.0), 3)
    recorder.tend(0.0)
    recorder.truth(circle(10.0))
    assert load(tmp_path / "run.nc")["truth"].sizes["time"] == 101
    recorder.close()


@pytest.mark.parametrize(("duration", "written"), [(600.0, True), (10.5, False)])
def test_rows_are_written_on_the_way_unless_the_end_is_near(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, duration: float, written: bool
) -> None:
    now = 0.0
    monkeypatch.setattr(record.time, "monotonic", lambda: now)
    recorder = Recorder(tmp_path / "run.nc", scenario(duration), 3)
    now = 1.5  # in which ten seconds went by
    recorder.truth(circle(10.0))
    assert (tmp_path / "run.nc").exists() == written
    recorder.close()
    assert load(tmp_path / "run.nc")["truth"].sizes["time"] == 101


def test_long_text_is_cut_at_a_whole_character() -> None:
    recorder = Recorder(None, scenario(), 3)
    recorder.event(0.0, "warning", "é" * 200 + "!")
    assert recorder.dataset()["events"]["text"].item() == "é" * 160


def test_imu_can_be_left_out() -> None:
    recorder = Recorder(None, scenario(imu=False), 3)
    block = circle(1.0)
    recorder.truth(block)
    recorder.imu("imu", ImuSamples(block.t, block.t, block.dtheta, block.dv))
    assert "sensors" not in recorder.dataset().children


WRITER = """
import sys
from pathlib import Path
from worlds import synthetic_run
from worlds.full_disk import file_size_limit
from worlds.synthetic_run import Errors, circle, scenario
from testbed.record.recorder import Recorder

class Announced(Recorder):
    def flush(self):
        super().flush()
        if self.path.exists():
            sys.stdout.write(f"{self._t}\\n")
            sys.stdout.flush()

recorder = Announced(Path(sys.argv[1]), scenario(600.0), 3)
truth = circle(600.0)
print("ready", flush=True)
import testbed.record.recorder
testbed.record.recorder.FLUSH_WALL_S = 0.0  # every block: the writer does little but write and lay out
synthetic_run.record(recorder, truth, {"ins": Errors(), "other": Errors(aligned_after=20)}, ((30.0, 50.0),))
"""


def kill_and_read(folder: Path, number: int, delay: float) -> float:
    """Kill a writer ``delay`` seconds into its work and compare what it left with what it had said was flushed."""
    path = folder / f"{number}.nc"
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1]), "OPENBLAS_NUM_THREADS": "1"}
    with subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, env=environment, text=True
    ) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == "ready\n"
        for _ in range(3):  # flushes: from here on there has to be a file with all groups
            assert writer.stdout.readline()
        time.sleep(delay)
        writer.send_signal(signal.SIGKILL)
        said = writer.stdout.read().split()
    flushed = float(said[-1]) if said else 0.0
    truth = circle(600.0)
    tree = load(path)
    t = tree["truth"]["time"].values
    rows = len(t)
    assert t[-1] >= np.floor(flushed * 10) / 10 - 1e-9
    np.testing.assert_array_equal(tree["truth"]["v_n"], truth.v_n[::20][:rows])
    ins = tree["estimators/ins"]
    assert ins["time"].values[-1] >= np.floor(flushed * 10) / 10 - 1.0 - 1e-9
    told = synthetic_run.estimates(truth, Errors(denied=((30.0, 50.0),)), np.random.default_rng([0, 0]))
    expected = list(told.values())[: len(ins["time"])]
    np.testing.assert_array_equal(ins["lat"], [e.lat for e in expected])
    np.testing.assert_array_equal(tree["sensors/imu"]["dv"], truth.dv[: len(tree["sensors/imu"]["time"])])
    with xarray.open_datatree(path) as plain:
        plain.load()
    return float(t[-1])


@pytest.mark.ci
def test_a_killed_writer_leaves_a_readable_record(tmp_path: Path) -> None:
    ends = [kill_and_read(tmp_path, k, delay) for k, delay in enumerate((0.0, 0.05, 0.4))]
    assert ends[-1] > ends[0]


@pytest.mark.slow
def test_many_killed_writers_leave_readable_records(tmp_path: Path) -> None:
    draw = random.Random(1)
    for k in range(40):
        kill_and_read(tmp_path, k, draw.uniform(0.0, 1.5))


@pytest.mark.ci
@pytest.mark.parametrize("step", range(0, 40, 5))
def test_death_at_any_write_leaves_the_last_flush(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    """The process ends at its n-th write of a flush, wherever in the order of columns and groups that is."""

    class Died(BaseException):
        pass

    monkeypatch.setattr(record, "FLUSH_WALL_S", np.inf)
    path = tmp_path / "run.nc"
    recorder = Recorder(path, scenario(), 3)
    truth = circle(20.0)
    synthetic_run.record(recorder, truth.rows(0, 2001), {"ins": Errors()})
    recorder.flush()
    before = load(path)
    writes = 0
    real = Table.rows

    def dying(self: Table, name: str) -> Any:
        nonlocal writes
        writes += 1
        if writes > step:
            raise Died
        return real(self, name)

    monkeypatch.setattr(Table, "rows", dying)
    recorder.truth(truth.rows(2001, 4001))
    told = synthetic_run.estimates(truth, Errors(), np.random.default_rng(5))
    for k in range(2020, 4001, 20):
        recorder.estimates("ins", Estimates.of([told[k]]))
    with pytest.raises(Died):
        recorder.flush()
    with pytest.raises(Died):
        recorder.close()
    after = load(path)
    for group in ("truth", "estimators/ins", "sensors/imu"):
        rows = len(before[group]["time"])
        assert len(after[group]["time"]) >= rows
        for name in before[group].data_vars:
            np.testing.assert_array_equal(after[group][name].values[:rows], before[group][name].values)
    rows = len(after["truth"]["time"])
    np.testing.assert_array_equal(after["truth"]["wind_n"], truth.wind_n[: 20 * rows : 20])
    monkeypatch.setattr(Table, "rows", real)
    recorder.close()  # what it could not end it ends now
    np.testing.assert_array_equal(load(path)["truth"]["wind_n"], truth.wind_n[::20])


def interrupted_at(line: int, work: Callable[[], object]) -> bool:
    """Whether ``work`` was interrupted at its n-th line of the recorder; where interrupts are held, at their end."""
    passed = 0

    def trace(frame: FrameType, event: str, _: Any) -> Any:
        nonlocal passed
        if frame.f_code.co_filename not in (record.__file__, tables.__file__):
            return None
        passed += event == "line"
        if passed > line:
            sys.settrace(None)
            if not interrupts._held:
                raise interrupts.Interrupted
            interrupts._waiting.append(signal.SIGINT)
        return trace

    sys.settrace(trace)
    try:
        work()
    except interrupts.Interrupted:
        return True
    finally:
        sys.settrace(None)
    return False


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # a file that its owner did not close
@pytest.mark.parametrize(
    ("flushed", "work", "least"),
    [("truth", "flush", 200), ("truth, events", "flush", 20), ("truth", "finish", 200), ("", "finish", 200)],
)
def test_an_interrupt_at_any_line_leaves_every_row(tmp_path: Path, flushed: str, work: str, least: int) -> None:
    """Of a flush that lays out a new file, or not; of the end, with a file or without. `close` may come twice."""
    truth = circle(2.0)

    def interrupted(path: Path, line: int) -> bool:
        recorder = Recorder(path, scenario(), 3)
        recorder.truth(truth.rows(0, 201))
        if "events" in flushed:
            recorder.event(0.2, "info", "a table that the file has")
        if flushed:
            recorder.flush()
        recorder.truth(truth.rows(201, 401))
        recorder.event(1.2, "info", "a row that the file lacks")
        was = interrupted_at(line, getattr(recorder, work))
        recorder.close()
        recorder.close()
        return was

    interrupted(tmp_path / "whole.nc", 1_000_000)
    whole, line = load(tmp_path / "whole.nc"), 0
    while interrupted(tmp_path / "run.nc", line):
        assert_same(whole, load(tmp_path / "run.nc"))
        assert not list(tmp_path.glob(".*"))
        line += 1
    assert line > least


def test_missing_damaged_and_foreign_files_are_told(tmp_path: Path, run_file: Path) -> None:
    with pytest.raises(UserError, match=r"absent\.nc: no such file"):
        load(tmp_path / "absent.nc")
    with pytest.raises(UserError, match="is a folder"):
        load(tmp_path)
    text = tmp_path / "text.nc"
    text.write_text("hello")
    with pytest.raises(UserError, match=r"text\.nc: not a record"):
        load(text)
    foreign = tmp_path / "foreign.nc"
    with h5py.File(foreign, "w") as file:
        file["x"] = 1.0
    with pytest.raises(UserError, match=r"foreign\.nc: netCDF-4/HDF5, but not a record"):
        load(foreign)
    cut = tmp_path / "cut.nc"
    cut.write_bytes(run_file.read_bytes()[:100_000])
    with pytest.raises(UserError, match=r"cut\.nc: damaged record .*run the scenario again"):
        load(cut)


@pytest.mark.ci
def test_a_scrambled_file_never_ends_in_a_traceback(tmp_path: Path, run_file: Path) -> None:
    whole = np.frombuffer(run_file.read_bytes(), np.uint8)
    draw = np.random.default_rng(2)
    told = 0
    for k in range(30):
        bad = whole.copy()
        at = int(draw.integers(0, 60_000 if k % 2 else len(bad) - 64))
        bad[at : at + 64] = draw.integers(0, 256, 64)
        path = tmp_path / "bad.nc"
        path.write_bytes(bad.tobytes())
        try:
            load(path)
        except UserError:
            told += 1
    assert told > 0


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_folder_without_permission_is_told(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(UserError, match="can't write here"):
        Recorder(tmp_path / "run.nc", scenario(), 3)


def test_unwritable_places_are_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"file: can't write here .*--out"):
        Recorder(tmp_path / "file" / "run.nc", scenario(), 3)
    with pytest.raises(UserError, match="is a folder"):
        Recorder(tmp_path, scenario(), 3)


def test_a_run_without_rows_leaves_nothing_and_spares_the_earlier_record(tmp_path: Path) -> None:
    path = tmp_path / "run.nc"
    Recorder(path, scenario(), 3).close()
    assert list(tmp_path.iterdir()) == []
    make(path, duration=2.0).close()
    before = path.read_bytes()
    Recorder(path, scenario(), 4).close()
    assert path.read_bytes() == before
    Recorder(None, scenario(), 4).dataset()


def test_a_full_disk_is_told_and_the_last_flush_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.nc"
    recorder = Recorder(path, scenario(), 3)
    truth = circle(4.0)
    recorder.truth(truth.rows(0, 401))
    recorder.flush()

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(record, "create", full)
    recorder.truth(truth.rows(401, 801))
    recorder.event(2.0, "info", "needs a new group")
    with pytest.raises(UserError, match=r"run\.nc: can't write the record \(No space left on device\)"):
        recorder.flush()
    with pytest.raises(UserError, match="can't write the record"):
        recorder.close()
    assert len(load(path)["truth"]["time"]) == 21
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("room", [0, 1, 40, 75])
def test_a_disk_that_is_full_from_any_write_on_leaves_the_last_flush(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    """The file has just been changed for a larger one, or not yet, when the n-th write after the last flush fails."""
    path = tmp_path / "run.nc"
    recorder = Recorder(path, scenario(), 3)
    truth = circle(4.0)
    recorder.truth(truth.rows(0, 401))
    recorder.flush()
    left, put = room, record._put

    def filling(*arguments: Any) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise OSError(28, "No space left on device")
        put(*arguments)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    recorder.truth(truth.rows(401, 801))
    recorder.event(2.0, "info", "needs a new group")
    monkeypatch.setattr(record, "_put", filling)
    if room == 75:
        recorder.flush()  # of some 60 writes
    else:
        with pytest.raises(UserError, match=r"run\.nc: can't write the record \(No space left on device\)"):
            recorder.flush()
    left = 0
    monkeypatch.setattr(hdf5, "reserve", full)
    with pytest.raises(UserError, match="can't write the record"):
        recorder.close()
    recorder.close()
    left_over = load(path)
    rows = len(left_over["truth"]["time"])
    assert rows == 41 if room == 75 else rows >= 21
    np.testing.assert_array_equal(left_over["truth"]["v_n"], truth.v_n[: 20 * rows : 20])
    assert not list(tmp_path.glob(".*"))


def test_an_error_of_another_kind_at_the_end_leaves_every_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.nc"
    recorder = Recorder(path, scenario(), 3)
    truth = circle(4.0)
    recorder.truth(truth.rows(0, 401))
    recorder.flush()
    recorder.truth(truth.rows(401, 801))

    def exhausted(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(hdf5, "reserve", exhausted)
    with pytest.raises(MemoryError):
        recorder.finish()
    recorder.close()
    assert len(load(path)["truth"]["time"]) == 41
    assert len(recorder.finish()["truth"]["time"]) == 41
    assert not list(tmp_path.glob(".*"))


def test_rows_since_the_last_flush_go_where_they_can_when_there_is_no_room_for_a_whole_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.nc"
    recorder = Recorder(path, scenario(), 3)
    truth = circle(4.0)
    recorder.truth(truth.rows(0, 401))
    recorder.flush()
    recorder.truth(truth.rows(401, 441))

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(hdf5, "reserve", full)
    with pytest.raises(UserError, match="No space left"):
        recorder.close()
    assert len(load(path)["truth"]["time"]) == 23


def test_a_disk_that_fills_up_is_told_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "run.nc"
    with file_size_limit(600_000), pytest.raises(UserError) as told:
        make(path).close()
    assert str(told.value) == f"{path}: can't write the record (File too large)"
    assert not list(tmp_path.glob(".*"))


def test_what_compresses_well_is_compressed_when_the_run_ends(run_file: Path) -> None:
    with h5py.File(run_file) as file:
        assert {file["sensors/imu/dt"].compression, file["sensors/imu/time"].compression} == {"gzip"}
        assert file["sensors/imu/dtheta"].compression is None
        text = file["estimators/ins/innovations/gnss_position/reason"]
        assert text.compression == "gzip"
        assert text.id.get_storage_size() < 0.1 * text.size


def test_memory_does_not_grow_with_the_run(tmp_path: Path) -> None:
    truth = circle(100.0)

    def peak(times: int) -> float:
        recorder = Recorder(tmp_path / f"{times}.nc", scenario(100.0 * times), 3)
        tracemalloc.start()
        for k in range(times):
            shift = 100.0 * k
            for start in range(0, 20_000, 200):
                rows = truth.rows(start, start + 200)
                block = type(rows)(
                    rows.tick + 20_000 * k, rows.t + shift, *(getattr(rows, n) for n in COLUMNS if n != "t")
                )
                recorder.truth(block)
                recorder.imu("imu", ImuSamples(block.t, np.full(200, 0.005), block.dtheta.copy(), block.dv.copy()))
            recorder.flush()
        recorder.close()
        return tracemalloc.get_traced_memory()[1]

    try:
        short = peak(2)
        tracemalloc.stop()
        long = peak(8)
    finally:
        tracemalloc.stop()
    assert long < 1.5 * short + 5e6


@pytest.mark.parametrize(("gone", "says"), [
    ("truth/h", "truth/h is missing"),
    ("truth/ned", "what labels its columns is missing"),
    ("estimators/ins/v_n", "estimators/ins/v_n is missing"),
    ("estimators/ins/sigma_wind", "estimators/ins/sigma_wind is missing"),
    ("estimators/ins/innovations/gnss_position/S", "gnss_position/S is missing"),
    ("estimators/ins/innovations/gnss_position/nis", "gnss_position/nis is missing"),
    ("sensors/imu/dt", "sensors/imu/dt is missing"),
    ("sensors/gnss/hdop", "sensors/gnss/hdop is missing"),
    ("sensors/gnss/t_arrival", "sensors/gnss/t_arrival is missing"),
    ("events/text", "events/text is missing"),
])  # fmt: skip
def test_a_record_that_lacks_a_column_says_which(gone: str, says: str, tmp_path: Path, run_file: Path) -> None:
    path = tmp_path / "mine.nc"
    path.write_bytes(run_file.read_bytes())
    with h5py.File(path, "r+") as file:
        del file[gone]
    with pytest.raises(UserError, match=rf"mine\.nc: damaged record \(.*{says}\); run the scenario again"):
        load(path)


@pytest.mark.parametrize(("name", "value", "says"), [
    ("scenario", None, "its attribute scenario is missing"),
    ("estimated_point_b_m", None, "its attribute estimated_point_b_m is missing"),
    ("record_rate_hz", "fast", "its attribute record_rate_hz is no number: 'fast'"),
    ("estimator_imus", "{", "its attribute estimator_imus is no dict in JSON: '{'"),
    ("estimated_point_b_m", "[]", r"its attribute estimated_point_b_m is no dict in JSON: '\[\]'"),
    ("overrides", 5, "its attribute overrides is no list in JSON: 5"),
])  # fmt: skip
def test_a_record_that_lacks_an_attribute_says_which(
    name: str, value: str | int | None, says: str, tmp_path: Path, run_file: Path
) -> None:
    path = tmp_path / "mine.nc"
    path.write_bytes(run_file.read_bytes())
    with h5py.File(path, "r+") as file:
        if value is None:
            del file.attrs[name]
        else:
            file.attrs[name] = value
    with pytest.raises(UserError, match=rf"mine\.nc: damaged record \({says}\); run the scenario again"):
        load(path)
