"""Tables as other programs write them: rows with names, ends of lines, angles of a whole turn."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from testbed.errors import UserError
from testbed.feeds import formats
from testbed.feeds.samples import quaternions
from testbed.feeds.table import load
from testbed.motion.logged import LogTruth

ROWS = [f"{k / 50},0.1,0.2,-9.8" for k in range(20)]


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize(("name", "last"), [("{},", ""), ('"{}",', ""), ('"row, {}",', ""), ("", ""), ("", ",")])
def test_rows_may_have_names_and_any_ends(end: str, name: str, last: str, tmp_path: Path) -> None:
    """As R writes them: the header has one field less."""
    rows = [name.format(k) + row + last for k, row in enumerate(ROWS)]
    (tmp_path / "a.csv").write_bytes(end.join(["t,a,b,c", *rows, ""]).encode())
    found = load(tmp_path / "a.csv").numbers
    np.testing.assert_allclose(found["t"], np.arange(20) / 50)
    assert found["c"].tolist() == [-9.8] * 20


def test_text_may_have_line_ends_and_commas_in_quotes(tmp_path: Path) -> None:
    rows = [row + ',"up,\nleft, right, down, and on, 5"' for row in ROWS]
    (tmp_path / "a.csv").write_text("\n".join(["t,a,b,c,said", *rows]))
    assert len(load(tmp_path / "a.csv").numbers["c"]) == 20


def test_names_of_some_rows_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes("\r".join(["t,a,b,c", *ROWS[:5], "6," + ROWS[6], *ROWS[7:]]).encode())
    with pytest.raises(UserError, match=r"line 7 has 5 fields, and the first, which names them, 4"):
        load(tmp_path / "a.csv")


def attitude(folder: Path, values: Any, column: dict[str, Any]) -> Any:
    t = np.arange(100) / 50
    whole = np.tile(values, (100, 1))
    np.savez(folder / "a.npz", t=t, w=np.zeros((100, 3)), f=np.tile([0.0, 0.0, -9.8], (100, 1)), q=whole)
    imu = {"time": "t", "gyro": "w", "accel": "f"}
    known = {"time": "t", "attitude": {"column": "q", **column}}
    given = {"source": "log", "file": "-", "columns": {"imu": imu, "reference": known}}
    log = formats.read(folder / "a.npz", LogTruth.model_validate(given).columns)
    assert log.solution is not None
    return log.solution.columns["q_nb"]


@pytest.mark.parametrize("unit", ["deg", "rad"])
@pytest.mark.parametrize("pitch", [358.0, 300.0, 20.0, -80.0])
def test_a_pitch_may_be_of_a_whole_turn(unit: str, pitch: float, tmp_path: Path) -> None:
    angles = np.radians([1.0, pitch, 90.0])
    found = attitude(tmp_path, np.degrees(angles) if unit == "deg" else angles, {"unit": unit})
    assert np.allclose(np.abs(found @ quaternions(*angles[:, None])[0]), 1.0)


def test_a_unit_of_a_quaternion_says_nothing(tmp_path: Path) -> None:
    assert np.allclose(attitude(tmp_path, [1.0, 0.0, 0.0, 0.0], {"unit": "rad"}), [1, 0, 0, 0])
