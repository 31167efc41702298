"""Tables that are not quite what their scenario says: what has a clear meaning is done, and the rest is told."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import testbed.__main__ as cli
from nav.rotation import quat_from_euler, quat_multiply
from testbed import Scenario, run
from testbed.errors import UserError
from testbed.feeds import draft, formats
from testbed.feeds.log import Log
from testbed.feeds.recorded import first_place
from testbed.feeds.samples import quaternions
from testbed.feeds.survey import survey
from testbed.feeds.table import load
from testbed.motion.logged import LogTruth
from testbed.report.log import columns, tables

SECONDS, RATE_HZ = 30, 50
LYING = np.radians((3.0, -20.0, 60.0))  # roll, pitch, heading of a vehicle that stands there
HALF = np.sqrt(0.5)
ENU, FLU = np.array([0.0, HALF, HALF, 0.0]), np.array([0.0, 1.0, 0.0, 0.0])  # as turns of ours


def standing() -> dict[str, Any]:
    """A vehicle that stands on a slope at 47 N 8 E, its inertial unit, its receiver and what is known of it."""
    t = np.arange(1, SECONDS * RATE_HZ + 1) / RATE_HZ
    roll, pitch, _ = LYING
    force = -9.81 * np.array([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])
    once = np.ones(len(t))
    return {
        "t": t, "w": np.zeros((len(t), 3)), "f": np.tile(force, (len(t), 1)),
        "lat": 47 + 1e-12 * t, "lon": 8 * once, "h": 500 * once, "v": np.zeros((len(t), 3)),
        "angles": np.tile(LYING, (len(t), 1)), "q": np.tile(quat_from_euler(*LYING), (len(t), 1)),
    }  # fmt: skip


IMU: dict[str, Any] = {"time": "t", "gyro": "w", "accel": "f"}
DEG = {"lat": {"column": "lat", "unit": "deg"}, "lon": {"column": "lon", "unit": "deg"}}
PLACE: dict[str, Any] = {"time": "t", **DEG, "height": "h", "velocity": "v"}


def read(folder: Path, table: Mapping[str, Any], **columns: Any) -> Log:
    """A table as a log; that of the inertial unit need not be said."""
    np.savez(folder / "flight.npz", **table)
    given = {"source": "log", "file": "flight.npz", "columns": {"imu": IMU, **columns}}
    return formats.read(folder / "flight.npz", LogTruth.model_validate(given).columns)


# --- attitudes


def attitudes(folder: Path, table: Mapping[str, Any], column: Any) -> Any:
    """What a reference's attitude is read as, (N, 4)."""
    log = read(folder, table, reference={"time": "t", "attitude": column})
    assert log.solution is not None
    return log.solution.columns["q_nb"]


def same(found: Any, roll: float, pitch: float, heading: float) -> bool:
    """Whether all of some quaternions are one attitude."""
    return bool(np.allclose(np.abs(found @ quaternions([roll], [pitch], [heading])[0]), 1.0, rtol=0, atol=1e-12))


def test_axes_of_angles_say_which_is_roll_pitch_and_heading(tmp_path: Path) -> None:
    """As PSINS has them: pitch, roll, and yaw, counter-clockwise from north."""
    table = standing()
    table["avp"] = np.degrees(table["angles"][:, [1, 0, 2]] * [1, 1, -1])
    column = {"column": ["avp:0", "avp:1", "avp:2"], "unit": "deg", "axes": ["y", "x", "-z"]}
    assert same(attitudes(tmp_path, table, column), *LYING)
    table["avp"] = table["avp"] * 100
    assert same(attitudes(tmp_path, table, {**column, "scale": 0.01}), *LYING)


@pytest.mark.parametrize("last", [False, True])
def test_a_quaternion_may_be_as_ros_has_it(last: bool, tmp_path: Path) -> None:
    """Of every attitude: forward, left, up to east, north, up; w first or, by the columns' names, last."""
    table = standing()
    rng = np.random.default_rng(1)
    table["q"] = np.array([quat_from_euler(*rng.uniform(-1.5, 1.5, 3)) for _ in table["t"]])
    theirs = np.array([quat_multiply(quat_multiply(ENU, q), FLU) for q in table["q"]])
    column: dict[str, Any] = {"column": "theirs", "frame": "flu-enu"}
    if last:
        theirs = theirs[:, [1, 2, 3, 0]]
        column["column"] = ["theirs:3", "theirs:0", "theirs:1", "theirs:2"]
    found = attitudes(tmp_path, {**table, "theirs": 2 * theirs}, column)
    np.testing.assert_allclose(np.abs(np.sum(found * table["q"], axis=1)), 1.0, rtol=0, atol=1e-12)


def test_angles_may_be_as_ros_has_them(tmp_path: Path) -> None:
    """Pitch is of the nose down, and yaw counter-clockwise from east."""
    table = standing()
    table["angles"] = np.degrees(table["angles"]) * [1, -1, -1] + [0, 0, 90]
    column = {"column": "angles", "unit": "deg", "frame": "flu-enu"}
    assert same(attitudes(tmp_path, table, column), *LYING)


@pytest.mark.parametrize(
    ("column", "said"),
    [
        ({"column": "q", "axes": ["y", "x", "-z"]}, r"order w, x, y, z, such as column = .*, and say with frame"),
        ({"column": "q", "offset": 1.0}, "a quaternion has no offset or axes"),
        ({"column": "angles", "offset": 1.57}, "added to roll, pitch and heading alike"),
        ({"column": "degrees"}, r'has a pitch of 20 rad: unit = "deg"\?'),
    ],
)
def test_what_an_attitude_can_not_have_is_refused(column: Any, said: str, tmp_path: Path) -> None:
    table = standing()
    table["degrees"] = np.degrees(table["angles"])
    with pytest.raises(UserError, match=rf"^truth\.columns\.reference\.attitude: .*{said}"):
        attitudes(tmp_path, table, column)


def test_only_an_attitude_has_a_frame() -> None:
    columns = {"imu": {**IMU, "gyro": {"column": "w", "frame": "flu-enu"}}}
    with pytest.raises(ValueError, match=r"gyro\.frame: is an attitude's or a velocity's"):
        LogTruth.model_validate({"source": "log", "file": "-", "columns": columns})


@pytest.mark.filterwarnings("error")
def test_a_quaternion_of_no_length_is_unknown(tmp_path: Path) -> None:
    table = standing()
    table["q"][::50] = 0
    log = read(tmp_path, table, reference={"time": "t", "attitude": "q"})
    assert "reference.attitude: 30 quaternions are of no length, and unknown" in log.notes
    assert log.solution is not None
    known = np.isfinite(log.solution.columns["q_nb"]).all(axis=1)
    assert known.sum() == len(table["t"]) - 30
    assert same(log.solution.columns["q_nb"][known], *LYING)


# --- inertial units


@pytest.mark.parametrize(("quantity", "size"), [("w", 1e5), ("f", -1e6)])
def test_a_row_that_nothing_can_feel_is_left_out(tmp_path: Path, quantity: str, size: float) -> None:
    table = standing()
    table[quantity][700, 1] = size
    log = read(tmp_path, table)
    assert f"imu: 1 of {len(table['t'])} rows turn or push harder than anything does: left out" in log.notes
    assert len(log.imus["imu"]) == len(table["t"]) - 1
    table[quantity][:] = size  # all of them are no damage
    assert len(read(tmp_path, table).imus["imu"]) == len(table["t"])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"gyro": {"column": "w", "unit": "rad"}}, 'gyro.unit: is "rad", of an integral: form = "increments"?'),
        ({"accel": {"column": "f", "unit": "m/s"}}, 'accel.unit: is "m/s", of an integral: form = "increments"?'),
        (
            {"gyro": {"column": "w", "unit": "deg/s"}, "form": "increments"},
            'gyro.unit: is "deg/s", and of increments one of rad, deg',
        ),
        (
            {"accel": {"column": "f", "unit": "g"}, "form": "increments"},
            'accel.unit: is "g", and of increments one of m/s',
        ),
        (
            {"gyro": {"column": "w", "axes": ["y", "x", "z"]}},
            "gyro.axes: are left-handed: is a sign missing? Of values whose signs are all reversed say scale = -1 and"
            ' axes = ["-y", "-x", "-z"]',
        ),
        (
            {"accel": {"column": "f", "axes": ["y", "x", "z"], "scale": -2.0}},
            'scale = 2 and axes = ["-y", "-x", "-z"]',
        ),
        (
            {"accel": {"column": "f", "axes": ["y", "x", "z"], "offset": 0.5}},
            'scale = -1, offset = -0.5 and axes = ["-y", "-x", "-z"]',
        ),
        ({"gyro": {"column": "w", "scale": 0.0}}, "must not be 0, which makes all values alike"),
        (
            {"gyro": None, "accel": None, "form": "instantaneous"},
            "form: is of gyro and accel, and there are none here: leave it out",
        ),
    ],
)
def test_what_contradicts_itself_is_refused_when_it_is_loaded(changes: Any, said: str) -> None:
    columns = {"imu": {**IMU, **changes}}
    with pytest.raises(ValueError, match=re.escape(said)):
        LogTruth.model_validate({"source": "log", "file": "-", "columns": columns})


def test_what_is_said_instead_means_the_same(tmp_path: Path) -> None:
    """All signs may be reversed, of what is a reaction for one and a load for another; so may those of left hands."""
    table = standing()
    turned = read(tmp_path, table, imu={**IMU, "accel": {"column": "f", "axes": ["-x", "-y", "-z"]}}).imus["imu"]
    table["f"] = -table["f"]
    np.testing.assert_array_equal(turned.dv, read(tmp_path, table).imus["imu"].dv)
    table["f"] = table["f"][:, [1, 0, 2]]
    said = {"column": "f", "scale": -1, "axes": ["-y", "-x", "-z"]}
    np.testing.assert_array_equal(turned.dv, read(tmp_path, table, imu={**IMU, "accel": said}).imus["imu"].dv)


def test_velocities_may_be_north_east_up(tmp_path: Path) -> None:
    table = standing()
    table["v"][:] = [1.0, 2.0, 3.0]
    log = read(tmp_path, table, gnss={**PLACE, "velocity": {"column": "v", "axes": ["x", "y", "-z"]}})
    np.testing.assert_array_equal(log.samples["gnss"][0].v_n, [1.0, 2.0, -3.0])  # type: ignore[union-attr]


# --- places


@pytest.mark.parametrize("name", ["gnss", "reference"])
@pytest.mark.parametrize(
    ("units", "factor", "said"),
    [
        ({}, 1.0, r'lat: is 47 rad: unit = "deg"\?'),
        ({"unit": "deg"}, 1e7, r'lat: is 4\.7e\+08 deg: unit = "1e-7deg"\?'),
        ({}, 1e7, r'lat: is 4\.7e\+08 rad: unit = "1e-7deg"\?'),
    ],
)
def test_a_latitude_that_can_be_none_is_of_another_unit(
    name: str, units: Any, factor: float, said: str, tmp_path: Path
) -> None:
    table = standing()
    table["lat"] = table["lat"] * factor
    table["lat"][:100] = 0  # not heard yet
    place = {**PLACE, "lat": {"column": "lat", **units}}
    with pytest.raises(UserError, match=rf"truth\.columns\.{name}\.{said}"):
        read(tmp_path, table, **{name: place})


def test_a_longitude_may_have_a_turn_too_many(tmp_path: Path) -> None:
    table = standing()
    for turned in (351.0, 711.0):
        table["lon"] = np.full(1500, turned)
        log = read(tmp_path, table, reference=PLACE)
        assert log.solution is not None
        np.testing.assert_allclose(log.solution.columns["lon"], np.radians(-9.0))
    with pytest.raises(UserError, match=r'lon: is 711 rad: unit = "deg"\?'):
        read(tmp_path, table, reference={**PLACE, "lon": "lon"})


def test_where_a_receiver_is_nowhere_it_has_no_fix(tmp_path: Path) -> None:
    """At 0 N 0 E, as loggers have it before the first fix; unless the table says itself what is a fix."""
    table = standing()
    for name in ("lat", "lon", "h"):
        table[name][:200] = 0
    log = read(tmp_path, table, gnss=PLACE)
    assert [one.has_fix for one in log.samples["gnss"]] == [False] * 200 + [True] * 1300  # type: ignore[union-attr]
    assert "gnss: 200 rows are at latitude and longitude 0: taken to be without a fix" in log.notes
    assert first_place(log, 0.0).lat_deg == pytest.approx(47)
    told = read(tmp_path, {**table, "fix": np.full(1500, 3)}, gnss={**PLACE, "fix": "fix"})
    assert all(one.has_fix for one in told.samples["gnss"])  # type: ignore[union-attr]


@pytest.mark.parametrize(("bad", "told"), [(700, False), (800, True)])
def test_fixes_that_are_mostly_refused_for_their_code_are_told(bad: int, told: bool, tmp_path: Path) -> None:
    """As where 1 is the best of fixes."""
    table = standing()
    table["fix"] = np.where(np.arange(1500) < bad, 1, 3)
    log = read(tmp_path, table, gnss={**PLACE, "fix": "fix"})
    assert any(f"gnss: {bad} of 1500 rows have fix < 3, and are taken" in note for note in log.notes) == told


def test_where_a_reference_is_nowhere_it_is_unknown(tmp_path: Path) -> None:
    table = standing()
    for name in ("lat", "lon"):
        table[name][::3] = 0
    table["h"][1::3] = np.nan
    log = read(tmp_path, table, reference=PLACE)
    assert any("reference: 1000 of 1500 rows are without height, or at latitude" in note for note in log.notes)
    assert log.solution is not None
    assert np.array_equal(np.isfinite(log.solution.columns["lat"]), np.arange(1500) % 3 == 2)
    assert np.array_equal(np.isfinite(log.solution.columns["v_n"]).all(axis=1), np.arange(1500) % 3 != 0)


def test_a_log_does_not_begin_where_no_aircraft_is(tmp_path: Path) -> None:
    table = standing()
    table["h"][:10] = 62815.0
    assert first_place(read(tmp_path, table, reference=PLACE), 0.0).alt_m == 500.0


def test_of_a_reference_without_height_no_place_is_left(tmp_path: Path) -> None:
    """A run begins where its receiver is then, and is judged by that."""
    table = known()
    table["rh"] = np.full(1500, np.nan)
    np.savez(tmp_path / "flight.npz", **table)
    (tmp_path / "flight.toml").write_text(SCENARIO.replace('height = "h", velocity = "v", att', 'height = "rh", att'))
    result = run(Scenario.load(tmp_path / "flight.toml"))
    assert any(one.startswith("errors are against gnss of the log") for one in result.remarks)
    del table["rh"]
    log = read(tmp_path, table, reference={"time": "t", "lat": "lat", "lon": "lon", "velocity": "v"})
    assert "reference: not all of lat, lon and height are said: nothing is judged by its place" in log.notes


# --- columns


HEADER = "t,gx,gy,gz,ax,ay,az"
OF_TEXT = {"imu": {"time": "t", "gyro": ["gx", "gy", "gz"], "accel": ["ax", "ay", "az"]}}


def of_text(folder: Path, lines: Sequence[str], columns: Any = OF_TEXT) -> Log:
    """A CSV as a log."""
    (folder / "flight.csv").write_text("\n".join(lines) + "\n")
    given = {"source": "log", "file": "flight.csv", "columns": columns}
    return formats.read(folder / "flight.csv", LogTruth.model_validate(given).columns)


def numbers(count: int = 20) -> list[str]:
    return [f"{k / 50},0.1,0.2,0.3,0,0,-9.8" for k in range(count)]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("header", [HEADER, HEADER + ","])
@pytest.mark.parametrize("ends", ["", ",", ", ,"])
def test_commas_at_the_ends_of_rows_shift_nothing(header: str, ends: str, tmp_path: Path) -> None:
    log = of_text(tmp_path, [header, *(line + ends for line in numbers())])
    imu = log.imus["imu"]
    np.testing.assert_allclose(imu.t, np.arange(20) / 50)
    np.testing.assert_allclose(imu.dtheta / imu.dt[:, None], np.tile([0.1, 0.2, 0.3], (20, 1)))


@pytest.mark.parametrize(("bad", "line"), [([5], 7), (range(19), 2)])
def test_a_row_of_more_fields_than_there_are_names_is_refused(bad: Any, line: int, tmp_path: Path) -> None:
    rows = [one + (",1" if k in bad else "") for k, one in enumerate(numbers())]
    with pytest.raises(UserError, match=rf"flight\.csv: line {line} has 8 fields, and the first, which names them, 7"):
        of_text(tmp_path, [HEADER, *rows])


def test_commas_in_quotes_are_none(tmp_path: Path) -> None:
    rows = [f'{one},"rest, armed"' for one in numbers()]
    assert len(of_text(tmp_path, ['"t",gx,gy,gz,ax,ay,az,"phase, mode"', *rows]).imus["imu"]) == 20


STAMPS = ["2024-05-03T09:00:00.010000", "2024-05-03T09:00:00.020000", "2024-05-03T09:00:00.030000"]


@pytest.mark.parametrize(
    ("above", "mark", "names"),
    [
        ([], ",", ["0", "1", "2"]),
        ([], " ", ["0", "1", "2"]),
        (["time;gx;gy"], ";", ["time", "gx", "gy"]),
        (["time\tgx\tgy"], "\t", ["time", "gx", "gy"]),
        (["time,gx,gy", "s,rad/s,rad/s"], ",", ["time", "gx", "gy"]),
        (["time\tgx\tgy", "[s]\t[rad/s]\t[rad/s]"], "\t", ["time", "gx", "gy"]),
        (["time;gx;gy", "sec;°/s;dps"], ";", ["time", "gx", "gy"]),
        (["% time gx gy", "% s rad/s rad/s"], " ", ["time", "gx", "gy"]),
        (["# anything at all", "# time gx gy", "# (s) (rad/s) (deg/s)"], " ", ["time", "gx", "gy"]),
    ],
)
@pytest.mark.parametrize("stamps", [STAMPS, ["0.01", "0.02", "0.03"]], ids=["dates", "seconds"])
def test_texts_as_tools_write_them(
    above: list[str], mark: str, names: list[str], stamps: list[str], tmp_path: Path
) -> None:
    """Dates were no numbers, so that the first row had the names, or there was no table; a line of units had them."""
    path = tmp_path / "a.txt"
    path.write_text("\n".join([*above, *(mark.join([stamp, "0.5", "-0.25"]) for stamp in stamps)]) + "\n")
    numbers = load(path).numbers
    assert list(numbers) == names
    np.testing.assert_allclose(np.diff(numbers[names[0]]), 0.01, atol=1e-6)
    assert [numbers[name].tolist() for name in names[1:]] == [[0.5] * 3, [-0.25] * 3]


@pytest.mark.parametrize(
    "text", ["t,ok\n1,T\n2,F\n", "id,sys\n1,G\n2,R\n", "t,flag,n\n1,-,1\n2,-,5\n", "s,m\n1,2\n3,4\n"]
)
def test_a_first_row_of_data_is_no_line_of_units(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text)
    first = next(iter(load(tmp_path / "a.csv").numbers.values()))
    assert len(first) == 2


def test_names_that_come_again_have_a_number_above_units_too(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,a,a\ns,m,m\n5,1,2\n")
    assert list(load(tmp_path / "a.csv").numbers) == ["t", "a", "a.1"]


def test_a_date_and_a_time_of_day_alone_are_a_table(tmp_path: Path) -> None:
    """KITTI's timestamps.txt, and rows of RTKLIB without their head."""
    (tmp_path / "stamps.txt").write_text("2011-09-26 13:02:25.010000000\n2011-09-26 13:02:25.020000000\n")
    np.testing.assert_allclose(np.diff(load(tmp_path / "stamps.txt").numbers["1"]), 0.01, atol=1e-6)


def test_text_that_is_no_table_is_none(tmp_path: Path) -> None:
    for text in ("int main() {\n  return 0;\n}\n", "Hello; this is\na text; of words\n"):
        (tmp_path / "a.txt").write_text(text)
        with pytest.raises(UserError, match="is no log of a known format"):
            load(tmp_path / "a.txt")


def test_seconds_and_nanoseconds_are_one_time(tmp_path: Path) -> None:
    table = standing()
    table["sec"], table["nanosec"] = np.floor(table["t"]), np.round(table["t"] % 1 * 1e9)
    apart = read(tmp_path, table, imu={**IMU, "time": ["sec", "nanosec"]}).imus["imu"]
    np.testing.assert_allclose(apart.t, table["t"], atol=1e-9)
    table["usec"] = np.round(table["t"] % 1 * 1e6)
    with pytest.raises(UserError, match="time: has 2 columns: 1 are needed"):
        read(tmp_path, table, imu={**IMU, "time": ["sec", "usec"]})


def dashed(rows: list[str]) -> None:
    rows[10] = rows[10].replace("0.1", "-")


def named_again(rows: list[str]) -> None:
    rows.insert(15, HEADER)


def filled_up(rows: list[str]) -> None:
    rows.append("\0" * 4096)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("mangle", "said"),
    [
        (dashed, r'imu\.gyro: gx of .*flight\.csv holds text, first "-" in row 11$'),
        (named_again, r'imu\.gyro: gx of .* holds text, first "gx" in row 16$'),
        (filled_up, r"imu\.time: t of .* holds text, first .* in row 201$"),
    ],
)
def test_a_column_that_holds_text_is_told(mangle: Callable[[list[str]], None], said: str, tmp_path: Path) -> None:
    rows = numbers(200)
    mangle(rows)
    with pytest.raises(UserError, match=rf"truth\.columns\.{said}"):
        of_text(tmp_path, [HEADER, *rows])


def test_a_column_of_spans_of_time_is_told(tmp_path: Path) -> None:
    """Of dates it is known what they are, of these not since when."""
    table = standing()
    table["t"] = table["t"].astype("timedelta64[s]")
    with pytest.raises(UserError, match=r"imu\.time: t of .*npz holds timedelta64\[s\]: give seconds as numbers"):
        read(tmp_path, table)


def test_columns_are_listed_as_they_are_named(tmp_path: Path) -> None:
    """With the brackets of their units, and those that hold no numbers with what they hold."""
    rows = [f"{one},a" for one in numbers()]
    path = tmp_path / "flight.csv"
    path.write_text("\n".join([HEADER.replace("t", "time [s]") + ",mode [/]", *rows]) + "\n")
    console = Console(width=200, file=io.StringIO())
    console.print(columns(load(path), "flight.csv"))
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    assert "time [s]" in shown
    assert re.search(r'mode \[/\] +│ holds text, first "a" in row 1 ', shown)


def test_columns_with_brackets_are_in_what_a_log_holds(tmp_path: Path) -> None:
    table = standing()
    log = read(tmp_path, {**table, "mode [red]": table["t"]})
    console = Console(width=200, file=io.StringIO())
    console.print(next(tables(survey(log))))
    assert "mode [red] 1500" in console.file.getvalue()  # type: ignore[attr-defined]


# --- a reference that is contradicted


def judged(folder: Path, log_of: Mapping[str, Any], changes: Mapping[str, Any] | None = None) -> Any:
    """The run of a table with a place and an attitude as the reference."""
    np.savez(folder / "flight.npz", **log_of)
    (folder / "flight.toml").write_text(SCENARIO)
    return run(Scenario.load(folder / "flight.toml", changes or {}))


SCENARIO = """
title = "standing"
duration_s = 20
[truth]
source = "log"
file = "flight.npz"
rate_hz = 50
columns.imu = { time = "t", gyro = "w", accel = "f" }
columns.gnss = { time = "t", lat = "lat", lon = "lon", height = "h", velocity = "v" }
columns.reference = { time = "rt", lat = "rlat", lon = "rlon", height = "h", velocity = "v", attitude = "q" }
[sensors.imu]
[sensors.gnss]
latency_s = 0.0
[[estimator]]
name = "ins"
aids = ["gnss"]
"""


def known() -> dict[str, Any]:
    """The same with columns of its own for the reference, in SI units."""
    table = standing()
    table["lat"], table["lon"] = np.radians(table["lat"]), np.radians(table["lon"])
    return {**table, "rt": table["t"], "rlat": table["lat"], "rlon": table["lon"]}


def test_a_reference_that_agrees_is_not_remarked_upon(tmp_path: Path) -> None:
    assert not [one for one in judged(tmp_path, known()).remarks if "reference of the log is" in one or "rest" in one]


def test_a_reference_that_is_not_where_its_receiver_was_is_told(tmp_path: Path) -> None:
    """It was named by the user: errors are against it all the same."""
    table = known()
    table["rlat"] = table["rlat"] + 405 / 6.367e6
    result = judged(tmp_path, table)
    (said,) = [one for one in result.remarks if "from gnss" in one]
    assert said.startswith("reference of the log is 405 m (RMS) from gnss, 405 m at most")
    np.testing.assert_allclose(result.dataset["truth/lat"].values[1:], table["rlat"][0], rtol=0, atol=1e-12)
    assert not [one for one in judged(tmp_path, table, {"truth.reference": "gnss"}).remarks if "from gnss" in one]


def test_a_reference_that_does_not_lie_as_the_accelerometers_feel_is_told(tmp_path: Path) -> None:
    table = known()
    table["q"] = table["q"][:, [1, 2, 3, 0]]  # w last, untold
    (said,) = [one for one in judged(tmp_path, table).remarks if "accelerometers" in one]
    assert "deg apart (median): unit, order or frame of its attitude, or axes of accel, are not as" in said


@pytest.mark.parametrize("receiver", [True, False])
def test_a_reference_of_another_time_is_told(receiver: bool, tmp_path: Path) -> None:
    table = known()
    table["rt"] = table["rt"] + 1.7e9
    if not receiver:
        table["lat"] = np.full(len(table["t"]), np.nan)
    (said,) = [one for one in judged(tmp_path, table).remarks if "outside of" in one]
    assert said.startswith("reference of the log is of 1700000000 to 1700000030 s, outside of the 0 to 20 s of the run")
    log = formats.open_log(Scenario.load(tmp_path / "flight.toml").truth)  # type: ignore[arg-type]
    assert f"outside of the 0.02 to 30 s of {'gnss' if receiver else 'imu'}" in log.remark
    assert ("judges by the receiver" in log.remark) == receiver
    text = draft.scenario(survey(log), tmp_path / "x", None)
    assert ('reference = "gnss"' in text) == receiver


def test_a_run_of_which_its_reference_knows_nothing_says_so(tmp_path: Path) -> None:
    table = known()
    late = table["t"] > 25.0
    for name in ("rt", "rlat", "rlon", "q"):
        table[f"{name}"] = table[name][late]
    table |= {"rh": table["h"][late], "rv": table["v"][late]}
    text = SCENARIO.replace('height = "h", velocity = "v", att', 'height = "rh", velocity = "rv", att')
    np.savez(tmp_path / "flight.npz", **table)
    (tmp_path / "flight.toml").write_text(text)
    (said,) = [one for one in run(Scenario.load(tmp_path / "flight.toml")).remarks if "outside of" in one]
    assert "is of 25 to 29.98 s, outside of the 0 to 20 s of the run: nothing is judged by it" in said


def test_a_draft_keeps_what_the_scenario_of_a_table_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And lasts as long as the log does from where it begins; files are as seen from where it is written."""
    np.savez(tmp_path / "flight.npz", **known())
    grid = np.linspace(46.9, 47.1, 3)
    np.savez(tmp_path / "ground.npz", lat_deg=grid, lon_deg=grid - 39, height_m=np.full((3, 3), 300.0))
    said = 'rate_hz = 200\naircraft = "loiter"\nstart_s = 12\nterrain = { file = "ground.npz", map_sigma_m = 2.0 }'
    text = SCENARIO.replace("[truth]", "date = 2021-03-04\n[truth]").replace("rate_hz = 50", said)
    (tmp_path / "flight.toml").write_text(text.replace("duration_s = 20", "duration_s = 10"))
    (tmp_path / "drafts").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["testbed", "log", "flight.toml", "--scenario", "drafts/new.toml"])
    with suppress(SystemExit):
        cli.main()
    before, after = Scenario.load("flight.toml"), Scenario.load("drafts/new.toml")
    assert isinstance(before.truth, LogTruth)
    assert isinstance(after.truth, LogTruth)
    assert after.date == before.date
    assert after.duration_s == pytest.approx(18, abs=0.11)
    for name in ("aircraft", "rate_hz", "start_s"):
        assert getattr(after.truth, name) == getattr(before.truth, name)
    assert after.truth.terrain.map_sigma_m == 2.0
    assert Path(after.truth.terrain.file or "").resolve() == tmp_path / "ground.npz"
