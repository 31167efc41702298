"""A table beside an autopilot's log, by which it is judged."""

from __future__ import annotations

import datetime as dt
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from testbed import Scenario, run
from testbed.errors import UserError
from testbed.feeds import formats
from testbed.feeds.log import Reference

LOG = Path("scenarios/recorded_flight.bin").absolute()
LATE_S = 0.1  # that its receiver's fixes come, as its scenario says
PLACE = {"lat": {"column": "lat", "unit": "deg"}, "lon": {"column": "lon", "unit": "deg"}, "height": "h"}
RMS = "ins.position_horizontal_rms_m"
SHORT: dict[str, Any] = {"duration_s": 90.0, "expect": {}, "sensors.gnss.denied": []}


@pytest.fixture(scope="module")
def solution() -> tuple[Reference, float]:
    """What the autopilot says of its motion, and UTC at 0 of its clock."""
    log = formats.read(LOG, {})
    assert log.solution is not None
    assert log.utc is not None
    return log.solution, log.utc + LATE_S


def written(folder: Path, known: Reference, zero: float | None = None, ahead: float = 0.0) -> Path:
    """A table of it, by UTC, and what is ahead of that, in two columns as RTKLIB has it, or by the log's clock."""
    columns = [np.degrees(known.columns[name]) for name in ("lat", "lon")] + [known.columns["h"]]
    lines = [("time" if zero is None else "day,time") + ",lat,lon,h,vn,ve,vd"]
    for t, *values in zip(known.t, *columns, *known.columns["v_n"].T, strict=True):
        at = f"{t:.6f}"
        if zero is not None:
            when = dt.datetime.fromtimestamp(t + zero + ahead, dt.UTC)
            at = f"{when:%Y/%m/%d},{when:%H:%M:%S.%f}"
        lines.append(",".join([at, *(f"{value:.9f}" for value in values)]))
    (folder / "ppk.csv").write_text("\n".join(lines))
    return folder / "ppk.csv"


def flown(table: Path, time: Any = "time", log: Path = LOG, **more: Any) -> Any:
    stream = {"file": str(table), "time": time, **PLACE, **more}
    changes = {"truth.file": str(log), "truth.columns": {"reference": stream}}
    return run(Scenario.load("recorded_flight", SHORT | changes))


@pytest.fixture(scope="module")
def own() -> float:
    """How far the estimator is from the autopilot's solution, as the log has it [m]."""
    return float(run(Scenario.load("recorded_flight", SHORT)).metrics[RMS])


@pytest.mark.ci
@pytest.mark.parametrize("more", [{}, {"velocity": ["vn", "ve", "vd"]}])
def test_dates_are_taken_to_the_clock_of_the_log(
    more: dict[str, Any], solution: tuple[Reference, float], own: float, tmp_path: Path
) -> None:
    """By the receiver: 30 m/s make 3 m of its latency, which velocities show, or the scenario tells."""
    found = flown(written(tmp_path, *solution), **more)
    assert found.metrics[RMS] == pytest.approx(own, abs=0.3)
    reference = found.dataset.attrs["reference"]
    assert "ppk.csv" in reference
    assert f"{LATE_S:.2f}{' ± 0.01' if more else ''} s late" in reference


@pytest.mark.ci
def test_gps_time_is_told_by_an_offset(solution: tuple[Reference, float], own: float, tmp_path: Path) -> None:
    table = written(tmp_path, *solution, ahead=18.0)
    assert flown(table, {"column": "time", "offset": -18}).metrics[RMS] == pytest.approx(own, abs=0.3)
    late = flown(table)
    assert late.metrics[RMS] > 100
    assert any('truth.reference = "gnss" judges by the receiver' in remark for remark in late.remarks)


def test_seconds_are_those_of_the_log(solution: tuple[Reference, float], own: float, tmp_path: Path) -> None:
    assert flown(written(tmp_path, solution[0])).metrics[RMS] == pytest.approx(own, abs=0.1)


@pytest.mark.ci
def test_a_reference_is_as_good_as_it_says(solution: tuple[Reference, float], tmp_path: Path) -> None:
    """Its variance is a part of what errors should be; nothing else changes."""
    sigma = 3.0
    table = written(tmp_path, solution[0])
    lines = table.read_text().splitlines()
    unknown = [lines[0] + ",sn,se,sd", lines[1] + ",,,"]
    table.write_text("\n".join([*unknown, *(f"{line},{sigma},{sigma},{2 * sigma}" for line in lines[2:])]))
    exact, told = flown(table), flown(table, sigma_position=["sn", "se", "sd"])
    assert json.loads(told.dataset.attrs["reference_sigma_n"]) == [sigma, sigma, 2 * sigma, 0.0, 0.0, 0.0]
    assert json.loads(exact.dataset.attrs["reference_sigma_n"]) == [0.0] * 6
    assert told.metrics[RMS] == exact.metrics[RMS]
    assert told.metrics["ins.position_nees_mean"] < 0.8 * exact.metrics["ins.position_nees_mean"]


def test_a_table_without_a_row_that_says_anything_is_told(tmp_path: Path) -> None:
    (tmp_path / "ppk.csv").write_text("time,lat,lon,h\n1.0,,,\n2.0,,,\n")
    with pytest.raises(UserError, match=r"columns\.reference: .*ppk\.csv has no row with a time and anything else"):
        flown(tmp_path / "ppk.csv")


def test_a_log_without_the_time_of_day_asks_for_its_own_seconds(
    solution: tuple[Reference, float], tmp_path: Path
) -> None:
    run(Scenario.load("static_bench", {"duration_s": 20.0}), out=tmp_path)
    with pytest.raises(UserError, match=r"truth\.columns\.reference\.time: holds dates, and .* doesn't say what time"):
        flown(written(tmp_path, *solution), log=tmp_path / "run.nc")


@pytest.mark.ci
@pytest.mark.parametrize(
    ("columns", "told"),
    [
        ({"gnss": {"file": "{table}", "time": "time", **PLACE}}, r"columns\.gnss: .* says itself what its sensors are"),
        ({"reference": {"time": "time", **PLACE}}, r"columns\.reference\.file: is missing"),
        (
            {name: {"kind": "reference", "file": "{table}", "time": "time", **PLACE} for name in ("a", "b")},
            "is judged by one reference, and has a, b",
        ),
    ],
)
def test_a_log_that_knows_its_sensors_has_nothing_else_beside_it(
    columns: dict[str, dict[str, Any]], told: str, solution: tuple[Reference, float], tmp_path: Path
) -> None:
    """It was not read, without a word."""
    table = str(written(tmp_path, solution[0]))
    for stream in columns.values():
        if "file" in stream:
            stream["file"] = table
    with pytest.raises(UserError, match=told):
        run(Scenario.load("recorded_flight", {"truth.columns": columns}))
