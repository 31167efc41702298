"""Tables of text as other programs write them, and sensors that have files of their own."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from nav.rotation import euler_from_quat
from testbed import Scenario, run
from testbed.errors import UserError
from testbed.feeds import draft, formats, px4
from testbed.feeds.survey import survey
from testbed.feeds.table import load
from testbed.many.shared_flight import log_digests
from testbed.motion.logged import LogTruth, Stream

T = np.arange(1, 1501) / 50
IMU = np.column_stack([T, np.zeros((1500, 3)), np.tile([0.0, 0.0, -9.8 / 50], (1500, 1))])  # increments
FIXES = np.column_stack([T[::10], np.tile([47.0, 8.0, 500.0, 0.0, 0.0, 0.0], (150, 1))])
NAMES = ["t", "gx", "gy", "gz", "fx", "fy", "fz"]


def rows(table: Any, mark: str, decimal: str = ".") -> list[str]:
    return [mark.join(f"{one:.9f}".replace(".", decimal) for one in row) for row in table]


@pytest.mark.parametrize(
    ("mark", "decimal"), [(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), (" ", "."), ("   ", ".")]
)
@pytest.mark.parametrize(
    ("above", "named"),
    [
        ([], NAMES),
        (["a flight", "of an hour"], NAMES),
        ([], [f"# {NAMES[0]}", *NAMES[1:]]),
        ([], [f"%{NAMES[0]}", *NAMES[1:]]),
        ([], None),
        (["a remark"], None),
    ],
)
def test_a_text_tells_how_it_is_to_be_read(
    mark: str, decimal: str, above: list[str], named: list[str] | None, tmp_path: Path
) -> None:
    """Marks and decimal points of all kinds, names in the first line or in a comment, or none."""
    head = [f"# {line}" for line in above] + ([mark.join(named)] if named else [])
    (tmp_path / "imu.txt").write_text("\n".join([*head, "", *rows(IMU, mark, decimal), ""]))
    found = load(tmp_path / "imu.txt").numbers
    first = [name for name in found if "t" in name] if named else ["0"]
    assert list(found) == (first + NAMES[1:] if named else [str(k) for k in range(7)])
    np.testing.assert_allclose(np.column_stack(list(found.values())), IMU, atol=1e-9)


def test_names_below_a_comment_with_as_many_commas_are_the_names(tmp_path: Path) -> None:
    for comment in ("# flown, on a day, of May", "#flown,on a day,of May"):
        (tmp_path / "a.csv").write_text("\n".join([comment, "t,a,b", *(f"{k / 10},1.5,2.5" for k in range(20))]))
        assert list(load(tmp_path / "a.csv").numbers) == ["t", "a", "b"]


@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_a_line_that_tells_spreadsheets_the_mark_is_no_row(mark: str, tmp_path: Path) -> None:
    lines = [f"sep={mark}", f"t{mark}a", *(f"{k / 10}{mark}1.5" for k in range(20))]
    for told in (lines, [lines[0], *lines[2:]]):
        (tmp_path / "a.csv").write_text("\n".join(told))
        assert [len(one) for one in load(tmp_path / "a.csv").numbers.values()] == [20, 20]


def test_numbers_that_count_the_columns_are_names(tmp_path: Path) -> None:
    """As a data frame without names is written, with and without its index."""
    for index in ("", ",0,1,2"):
        lines = [index or "0,1,2", *(f"{k}," * bool(index) + f"{k / 10},1.5,2.5" for k in range(20))]
        (tmp_path / "a.csv").write_text("\n".join(lines))
        assert load(tmp_path / "a.csv").numbers["0"].tolist() == [k / 10 for k in range(20)]


def test_rows_of_text_parted_by_spaces_may_have_names(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("\n".join(['"t" "a"', *(f'"{k}" {k / 10} 1.5' for k in range(20))]))
    assert load(tmp_path / "a.txt").numbers["t"].tolist() == [k / 10 for k in range(20)]


def test_names_with_spaces_between_spaces_are_told(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("\n".join(["time gyro x gyro y", *(f"{k / 10} 1.5 2.5" for k in range(20))]))
    with pytest.raises(UserError, match=r"line 1 names 5 columns, and the row after it has 3 fields"):
        load(tmp_path / "a.txt")


def test_names_have_no_blanks_about_them(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("\n".join(["t , a , b", *(f"{k / 10} , 1.5 , 2.5" for k in range(20))]))
    assert list(load(tmp_path / "a.csv").numbers) == ["t", "a", "b"]


def test_a_decimal_comma_may_show_in_a_later_row(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("\n".join(["t;a", "0;0", "1;2", "1,5;3", "2;3,25"]))
    assert load(tmp_path / "a.csv").numbers["a"].tolist() == [0.0, 2.0, 3.0, 3.25]


@pytest.mark.parametrize("name", ["time", None])
def test_an_index_of_parquet_is_a_column(name: str | None, tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    index = pandas.Index([0.5, 1.5], name=name)
    pandas.DataFrame({"a": [1.0, 2.0]}, index=index).to_parquet(tmp_path / "a.parquet", engine="pyarrow")
    assert load(tmp_path / "a.parquet").numbers[name or "index"].tolist() == [0.5, 1.5]


def test_several_indices_of_parquet_are_columns(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    index = pandas.MultiIndex.from_arrays([[7.0, 8.0], [0.5, 1.5]], names=["flight", "time"])
    pandas.DataFrame({"a": [1.0, 2.0]}, index=index).to_parquet(tmp_path / "a.parquet", engine="pyarrow")
    assert load(tmp_path / "a.parquet").numbers["time"].tolist() == [0.5, 1.5]


def test_an_index_of_parquet_that_is_called_as_a_column_is_left_out(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    path, index = tmp_path / "a.parquet", pandas.MultiIndex.from_arrays([[7.0, 8.0], [0.5, 1.5]], names=["b", "c"])
    pandas.DataFrame({"a": [1.0, 2.0]}, index=index).assign(b=[3.0, 4.0]).to_parquet(path, engine="pyarrow")
    assert load(path).numbers["b"].tolist() == [3.0, 4.0]


@pytest.mark.parametrize("zone", [None, "UTC", "Europe/Berlin"])
@pytest.mark.parametrize("index", [False, True])
def test_dates_of_parquet_may_have_a_zone(zone: str | None, index: bool, tmp_path: Path) -> None:
    """Those of none are UTC; one that is missing is unknown."""
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    noon = dt.datetime(2024, 6, 1, 12, tzinfo=dt.UTC).timestamp()
    times = pandas.to_datetime([noon + 0.25, noon + 1.25, None], unit="s", utc=True).tz_convert(zone)
    rows = pandas.DataFrame({"t": times, "a": [1.0, 2.0, 3.0]})
    (rows.set_index("t") if index else rows).to_parquet(tmp_path / "a.parquet", engine="pyarrow")
    found = load(tmp_path / "a.parquet")
    np.testing.assert_array_equal(found.numbers["t"], [noon + 0.25, noon + 1.25, np.nan])
    assert found.dates == {"t"}


@pytest.mark.parametrize("words", ["Dear diary, we flew", "we flew\nand landed", "1 fish 2 fish\n3 fish"])
def test_prose_is_no_table(words: str, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(words)
    with pytest.raises(UserError):
        formats.read(tmp_path / "a.txt", {})


COLUMNS = {
    "imu": {
        "time": "0",
        "form": "increments",
        "gyro": {"column": ("1", "2", "3"), "unit": "rad"},
        "accel": {"column": ("4", "5", "6"), "unit": "m/s"},
    },
    "gnss": {
        "file": "fixes.txt",
        "time": "0",
        "lat": {"column": "1", "unit": "deg"},
        "lon": {"column": "2", "unit": "deg"},
        "height": "3",
        "velocity": ("4", "5", "6"),
    },
}
SCENARIO = """
title = "files of a toolbox"
duration_s = 25.0
date = 2024-06-01
[truth]
source = "log"
file = "imu.txt"
[truth.columns.imu]
time = "0"
form = "increments"
gyro = { column = ["1", "2", "3"], unit = "rad" }
accel = { column = ["4", "5", "6"], unit = "m/s" }
[truth.columns.gnss]
file = "fixes.txt"
time = "0"
lat = { column = "1", unit = "deg" }
lon = { column = "2", unit = "deg" }
height = "3"
velocity = ["4", "5", "6"]
[sensors.imu]
kind = "imu"
grade = "mems-hobby"
[sensors.gnss]
[[estimator]]
name = "ahrs"
kind = "ahrs"
aids = []
heading_deg = 0.0
"""


def write(folder: Path, fixes: Any = FIXES) -> Path:
    """The files of two sensors, without names, and their scenario."""
    (folder / "imu.txt").write_text("\n".join(rows(IMU, " ")))
    (folder / "fixes.txt").write_text("\n".join(rows(fixes, "  ")))
    (folder / "flight.toml").write_text(SCENARIO)
    return folder / "flight.toml"


def test_each_sensor_may_have_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen from the scenario, wherever it is called from: a navigation toolbox's own files are a flight."""
    (tmp_path / "flight").mkdir()
    scenario = Scenario.load(write(tmp_path / "flight"))
    assert isinstance(scenario.truth, LogTruth)
    log = formats.open_log(scenario.truth)
    assert len(log.imus["imu"]) == 1500
    assert len(log.samples["gnss"]) == 150
    assert log.messages["1"] == 1500
    assert log.messages["1 of fixes.txt"] == 150
    monkeypatch.chdir(tmp_path)
    flown = run(Scenario.load(Path("flight/flight.toml"))).dataset
    assert len(flown["sensors/gnss/time"]) == 125
    assert abs(euler_from_quat(flown["estimators/ahrs/q_nb"].values[-1])[:2]).max() < 0.01


def test_a_file_of_a_sensor_that_has_changed_is_another_log(tmp_path: Path) -> None:
    scenario = Scenario.load(write(tmp_path))
    assert isinstance(scenario.truth, LogTruth)
    before = len(formats.open_log(scenario.truth).samples["gnss"]), log_digests([scenario])
    write(tmp_path, FIXES[:100])
    after = len(formats.open_log(scenario.truth).samples["gnss"]), log_digests([scenario])
    assert (before[0], after[0]) == (150, 100)
    assert len(before[1]) == 2
    assert before[1] != after[1]


def test_a_draft_keeps_the_files(tmp_path: Path) -> None:
    (tmp_path / "drafts").mkdir()
    out = tmp_path / "drafts" / "draft.toml"
    truth = Scenario.load(write(tmp_path)).truth
    assert isinstance(truth, LogTruth)
    out.write_text(draft.scenario(survey(formats.open_log(truth)), out, truth, dt.date(2024, 6, 1)))
    drafted = Scenario.load(out)
    assert isinstance(drafted.truth, LogTruth)
    assert Path(drafted.truth.columns["gnss"].file or "").resolve() == tmp_path / "fixes.txt"
    assert len(formats.open_log(drafted.truth).samples["gnss"]) == 150


def test_what_is_wrong_with_a_sensors_file_is_told(tmp_path: Path) -> None:
    path = write(tmp_path)
    (tmp_path / "fixes.txt").unlink()
    truth = Scenario.load(path).truth
    assert isinstance(truth, LogTruth)
    with pytest.raises(UserError, match=r"truth\.columns\.gnss\.file: .*fixes\.txt: No such file"):
        formats.open_log(truth)
    (tmp_path / "fixes.txt").write_bytes(b"\xa3\x95" + bytes(100))
    with pytest.raises(UserError, match=r"fixes\.txt: is ArduPilot DataFlash, and no table"):
        formats.open_log(truth)


def test_one_quantity_in_two_columns_is_refused(tmp_path: Path) -> None:
    """One of them would be left unread without a word."""
    path = write(tmp_path)
    more = '[truth.columns.barometer]\nfile = "fixes.txt"\ntime = "0"\npressure = "1"\nheight = "3"\n[sensors.imu]'
    path.write_text(SCENARIO.replace("[sensors.imu]", more))
    truth = Scenario.load(path).truth
    assert isinstance(truth, LogTruth)
    with pytest.raises(UserError, match=r"truth\.columns\.barometer\.height: is given beside pressure: say one of"):
        formats.open_log(truth)


def test_a_unit_of_time_that_can_not_be_is_told(tmp_path: Path) -> None:
    path = write(tmp_path)
    path.write_text(SCENARIO.replace('time = "0"\nform', 'time = { column = "0", unit = "us" }\nform'))
    with pytest.raises(
        UserError, match=r"sensors\.imu: .*imu\.txt has 5e\+07 samples a second: is the unit of its time"
    ):
        run(Scenario.load(path))


def test_dates_are_times(tmp_path: Path) -> None:
    """As ISO 8601 has them, of any zone: UTC where they say none."""
    start = dt.datetime(2024, 6, 1, 12, tzinfo=dt.UTC)
    said = [(start + dt.timedelta(seconds=k / 50)).isoformat() for k in range(100)]
    for cut, end in ((None, ""), (-6, ""), (-6, "Z")):
        lines = ["t,a", *(f"{one[:cut]}{end},1.5" for one in said)]
        (tmp_path / "a.csv").write_text("\n".join(lines))
        np.testing.assert_allclose(
            load(tmp_path / "a.csv").numbers["t"], start.timestamp() + np.arange(100) / 50, atol=1e-6
        )


def test_a_date_may_have_slashes(tmp_path: Path) -> None:
    (tmp_path / "a.pos").write_text("t,a\n2024/06/01 12:00:00.250,1.5\n2024/06/01 12:00:01.250,1.5\n")
    noon = dt.datetime(2024, 6, 1, 12, tzinfo=dt.UTC).timestamp()
    assert load(tmp_path / "a.pos").numbers["t"].tolist() == [noon + 0.25, noon + 1.25]


def test_a_log_whose_times_are_dates_has_a_date(tmp_path: Path) -> None:
    """That of its first row, in UTC, which the magnetic field of a drafted scenario needs; of numbers none is known."""
    start = dt.datetime(2024, 6, 1, 23, 30, tzinfo=dt.timezone(dt.timedelta(hours=-2)))
    times = [(start + dt.timedelta(seconds=k / 50)).isoformat() for k in range(100)]
    for said, date in ((times, dt.date(2024, 6, 2)), ([str(k / 50) for k in range(100)], None)):
        lines = ["t,x,y,z,a,b,c", *(f"{one},0,0,0,0,0,-9.8" for one in said)]
        (tmp_path / "a.csv").write_text("\n".join(lines))
        stream = Stream.model_validate({"time": "t", "gyro": ["x", "y", "z"], "accel": ["a", "b", "c"]})
        assert formats.read(tmp_path / "a.csv", {"imu": stream}).date == date


POS = """% program   : RTKPOST
% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,ns=# of satellites)
%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)
2024/06/01 23:59:59.800   47.000000000    8.000000000   500.0000   1  10   0.0050   0.0060   0.0100
2024/06/02 00:00:00.000   47.000001000    8.000000000   500.1000   1  10   0.0050   0.0060   0.0100
2024/06/02 00:00:00.200   47.000002000    8.000000000   500.2000   2  10   0.0500   0.0600   0.1000
"""


def test_a_date_and_a_time_of_day_in_two_columns_are_one_time(tmp_path: Path) -> None:
    """As RTKLIB writes its solutions, and loggers their rows."""
    midnight = dt.datetime(2024, 6, 2, tzinfo=dt.UTC).timestamp()
    (tmp_path / "a.pos").write_text(POS)
    found = load(tmp_path / "a.pos")
    np.testing.assert_allclose(found.numbers["GPST"] - midnight, [-0.2, 0.0, 0.2], atol=1e-6)
    assert found.numbers["sdn(m)"].tolist() == [0.005, 0.005, 0.05]
    assert found.dates == {"GPST"}
    (tmp_path / "a.csv").write_text("Date,Time,a\n2024-06-02,00:00:01,1.5\n2024-06-02,00:00:02,2.5\n")
    assert (load(tmp_path / "a.csv").numbers["Time"] - midnight).tolist() == [1.0, 2.0]


def test_a_blank_date_is_an_unknown_time(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("Date,Time,a\n2024-06-02,00:00:01,1.5\n,,2\n2024-06-02,00:00:02,2.5\n")
    assert np.isnan(load(tmp_path / "a.csv").numbers["Time"]).tolist() == [False, True, False]


def test_a_text_beside_arrays_is_no_matter(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", name="flight 1", t=np.arange(3.0))
    assert load(tmp_path / "a.npz").numbers["t"].tolist() == [0.0, 1.0, 2.0]


def test_a_comma_among_decimal_points_parts_no_numbers(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t;x;sats\n0.0;1.5;5\n0.1;1.5;5\n0.2;1.5;5,7")
    assert load(tmp_path / "a.csv").numbers["x"].tolist() == [1.5] * 3


@pytest.mark.parametrize(
    "said", ["00:00:01", "00:04:10.001007", "07.03.2015 12:04:10.5", "3/7/2015 12:04", "2015-3-7T12:04:10"]
)
def test_a_time_that_is_not_read_is_shown_with_how_times_are(said: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(f"Time,a\n{said},1.5\n{said},2.5\n")
    advice = (
        "dates are read as ISO 8601 has them, 2015-03-07T12:04:10.5, and times of day beside a column of such dates,"
        " 2015-03-07: write them so, or give seconds as numbers"
    )
    assert load(tmp_path / "a.csv").others["Time"] == f'holds text, first "{said}" in row 1: {advice}'


def test_a_decimal_comma_that_is_not_read_is_shown_with_how_they_are(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text('t,a\n0,"2,75"\n1,"3,25"\n')
    advice = "decimal commas are read where semicolons or tabs part the fields, and none of these has a point"
    assert load(tmp_path / "a.csv").others["a"] == f'holds text, first "2,75" in row 1: {advice}'


def test_each_quantity_may_have_its_file(tmp_path: Path) -> None:
    """As gnss-ins-sim writes them: times, rates and forces of one unit in three files, one of a single column."""
    columns = {"time": ["time (sec)"], "gyro-0": NAMES[1:4], "accel-0": NAMES[4:]}
    starts = {"time": 0, "gyro-0": 1, "accel-0": 4}
    for name, names in columns.items():
        part = IMU[:, starts[name] : starts[name] + len(names)]
        (tmp_path / f"{name}.csv").write_text("\n".join([",".join(names), *rows(part, ",")]))
    (tmp_path / "fixes.txt").write_text("\n".join(rows(FIXES, "  ")))
    text = SCENARIO.replace("imu.txt", "time.csv").replace('time = "0"', 'time = "time (sec)"', 1)
    text = text.replace('column = ["1", "2", "3"]', 'file = "gyro-0.csv", column = ["gx", "gy", "gz"]')
    text = text.replace('column = ["4", "5", "6"]', 'file = "accel-0.csv", column = ["fx", "fy", "fz"]')
    (tmp_path / "flight.toml").write_text(text)
    truth = Scenario.load(tmp_path / "flight.toml").truth
    assert isinstance(truth, LogTruth)
    imu = formats.open_log(truth).imus["imu"]
    np.testing.assert_allclose(imu.t, T, atol=1e-9)
    np.testing.assert_allclose(np.hstack([imu.dtheta, imu.dv]), IMU[:, 1:], atol=1e-9)

    (tmp_path / "drafts").mkdir()
    out = tmp_path / "drafts" / "draft.toml"
    out.write_text(draft.scenario(survey(formats.open_log(truth)), out, truth, dt.date(2024, 6, 1)))
    drafted = Scenario.load(out).truth
    assert isinstance(drafted, LogTruth)
    assert len(formats.open_log(drafted).imus["imu"]) == 1500

    (tmp_path / "gyro-0.csv").write_text("\n".join(["gx,gy,gz", *rows(IMU[:100, 1:4], ",")]))
    with pytest.raises(UserError, match=r"columns\.imu\.gyro: has 100 rows, and its time has 1500"):
        formats.open_log(truth)
    (tmp_path / "gyro-0.csv").unlink()
    with pytest.raises(UserError, match=r"truth\.columns\.imu\.gyro\.file: .*gyro-0\.csv: No such file"):
        formats.open_log(truth)


def test_a_text_among_the_variables_of_matlab_is_no_matter(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", {"t": T, "gyro": IMU[:, 1:4], "note": "hello"})
    assert set(load(tmp_path / "a.mat").numbers) == {"t", "gyro"}


def test_rows_without_a_rate_are_left_out_and_told(tmp_path: Path) -> None:
    """A unit whose gyro is slower than its accelerometer, in one table, was none: its increments were no numbers."""
    gyro = np.where(np.arange(1500)[:, None] % 3 == 1, np.nan, 0.1)
    np.savez(tmp_path / "a.npz", t=T, gyro=gyro + np.zeros((1500, 3)), accel=np.tile([0.0, 0.0, -9.8], (1500, 1)))
    log = formats.read(tmp_path / "a.npz", {"imu": Stream(time="t", gyro="gyro", accel="accel")})  # type: ignore[arg-type]
    assert np.isfinite(log.imus["imu"].dtheta).all()
    assert log.imus["imu"].dtheta[1:].sum(axis=0) == pytest.approx(0.1 * (T[-1] - log.imus["imu"].t[0]), rel=1e-3)
    assert "imu: 500 of 1500 rows have no rate or no specific force: left out" in log.notes


def test_a_receiver_whose_height_comes_in_rows_of_its_own_is_held_too(tmp_path: Path) -> None:
    """As NMEA has it, written beside each row of an IMU."""
    second = np.arange(1500) // 50
    height = 500.0 + 0.1 * ((np.arange(1500) + 20) // 50)
    np.savez(
        tmp_path / "a.npz", t=T, gyro=np.zeros((1500, 3)), accel=np.tile([0.0, 0.0, -9.8], (1500, 1)),
        lat=0.8 + 1e-6 * second, lon=0.1 + 1e-6 * second, h=height,
    )  # fmt: skip
    columns = {
        "imu": {"time": "t", "gyro": "gyro", "accel": "accel"},
        "gnss": {"time": "t", "lat": "lat", "lon": "lon", "height": "h"},
    }
    log = formats.read(tmp_path / "a.npz", {name: Stream(**own) for name, own in columns.items()})  # type: ignore[arg-type]
    assert len(log.samples["gnss"]) == 30


def test_a_reference_above_the_sea_beside_a_receiver_above_the_ellipsoid_is_told(tmp_path: Path) -> None:
    place = {"lat": np.full(1500, 0.8), "lon": np.full(1500, 0.1)}
    np.savez(
        tmp_path / "a.npz", t=T, gyro=np.zeros((1500, 3)), accel=np.tile([0.0, 0.0, -9.8], (1500, 1)), **place,
        h=np.full(1500, 500.0), sea=np.full(1500, 452.0), t1=T[::50], lat1=np.full(30, 0.8), lon1=np.full(30, 0.1),
        h1=np.full(30, 500.0),
    )  # fmt: skip
    columns = {
        "imu": {"time": "t", "gyro": "gyro", "accel": "accel"},
        "gnss": {"time": "t1", "lat": "lat1", "lon": "lon1", "height": "h1"},
        "reference": {"time": "t", "lat": "lat", "lon": "lon", "height": "sea"},
    }
    log = formats.read(tmp_path / "a.npz", {name: Stream(**own) for name, own in columns.items()})  # type: ignore[arg-type]
    assert "is 48 m below gnss (median): is one of heights above the sea?" in log.remark


@pytest.mark.parametrize("old", [True, False])
def test_the_heights_of_a_px4_solution_are_above_the_ellipsoid(old: bool) -> None:
    """Those of its EKF are above the sea, and were judged by a receiver's above the ellipsoid."""
    ellipsoid, sea = np.array([0.0, 55.6, 55.2, 56.0]), np.array([0.0, 89.6, 89.2, 90.0])
    rows = {"fix_type": np.array([0, 3, 3, 3])}
    rows |= (
        {"alt_ellipsoid": (1e3 * ellipsoid).astype(np.int32), "alt": (1e3 * sea).astype(np.int32)}
        if old
        else {"altitude_ellipsoid_m": ellipsoid, "altitude_msl_m": sea}
    )
    assert px4._geoid({"vehicle_gps_position": {0: rows}}) == pytest.approx(-34.0, abs=1e-6)
    assert px4._geoid({}) == 0.0


def test_columns_without_rows_are_told(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(",".join(NAMES) + "\n")
    assert set(load(tmp_path / "a.csv").others.values()) == {"has no rows"}
    np.savez(tmp_path / "a.npz", **{name: np.empty(0) for name in NAMES})
    columns = {"time": "t", "gyro": ["gx", "gy", "gz"], "accel": ["fx", "fy", "fz"]}
    arrays = {"time": "t", "gyro": "gyro", "accel": "accel"}
    np.savez(tmp_path / "b.npz", t=np.empty(0), gyro=np.empty((0, 3)), accel=np.empty((0, 3)))
    for file, own in (("a.csv", columns), ("a.npz", columns), ("b.npz", arrays)):
        truth = LogTruth.model_validate({"source": "log", "file": file, "columns": {"imu": own}})
        with pytest.raises(UserError, match=r"truth\.columns\.imu\.time: .*has no rows|has no rows"):
            formats.read(tmp_path / file, truth.columns)


@pytest.mark.parametrize(("wrong", "right"), [("gyroo", "gyro"), ("tme", "time")])
def test_a_key_of_a_column_that_is_misspelt_is_told(wrong: str, right: str, tmp_path: Path) -> None:
    text = f"""
duration_s = 10
[truth]
source = "log"
file = "a.npz"
columns.time = {{ kind = "imu", {wrong} = "g", time = "t", accel = {{ column = "a", axs = ["x", "y", "z"] }} }}
[sensors.time]
kind = "imu"
"""
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(UserError) as caught:
        Scenario.load(tmp_path / "a.toml")
    assert f"truth.columns.time.{wrong}: unknown key: did you mean {right}? Choose from" in str(caught.value)
    assert "truth.columns.time.accel.axs: unknown key: did you mean axes? Choose from" in str(caught.value)


@pytest.mark.parametrize("column", ["t", "gx"])
def test_of_a_unit_that_can_not_be_read_it_is_said_why(column: str, tmp_path: Path) -> None:
    table = dict(zip(NAMES, IMU.T, strict=True))
    np.savez(tmp_path / "a.npz", **{**table, column: np.full(len(T), 7.0 if column == "t" else np.nan)})
    columns = {"time": "t", "gyro": ["gx", "gy", "gz"], "accel": ["fx", "fy", "fz"]}
    truth = LogTruth.model_validate({"source": "log", "file": "a.npz", "columns": {"imu": columns}})
    with pytest.raises(UserError, match=r"has no inertial data: .*; imu: .*(come again|of 1500)"):
        formats.read(tmp_path / "a.npz", truth.columns)


@pytest.mark.parametrize("encoding", ["latin-1", "mac-roman"])
def test_a_text_that_is_not_utf_8_is_told(encoding: str, tmp_path: Path) -> None:
    """A name of a column, as a spreadsheet of another time writes it."""
    lines = [",".join([*NAMES, "Höhe"]), *(f"{row},300" for row in rows(IMU, ","))]
    (tmp_path / "a.csv").write_text("\n".join(lines), encoding=encoding)
    with pytest.raises(UserError, match="is text, but not in UTF-8: save it as that"):
        load(tmp_path / "a.csv")
