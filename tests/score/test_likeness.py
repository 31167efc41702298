"""A flight beside its simulation: figures that can be reckoned by hand, and what is said where they differ."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import integrate

import testbed.__main__ as cli
from nav.samples import FixType, GnssSample, ImuSamples
from testbed.errors import UserError
from testbed.feeds.lateness import Late
from testbed.feeds.log import Log
from testbed.feeds.survey import survey
from testbed.report.log import beside
from testbed.score import likeness
from testbed.score.likeness import Row

RATE_HZ, SECONDS = 200.0, 60.0


def toy(shake: float, frequency: float = 20.0, gap: bool = False, name: str = "imu") -> Log:
    """A vehicle at 20 m/s whose specific force along x is shaken with an amplitude [m/s^2], and its rate about z."""
    t = np.arange(1, round(SECONDS * RATE_HZ) + 1) / RATE_HZ
    dt = np.full(len(t), 1 / RATE_HZ)
    wave = np.sin(2 * np.pi * frequency * t)[:, None]
    force = shake * wave * [1.0, 0.0, 0.0] + [0.0, 0.0, -9.8]
    rate = np.deg2rad(3.0) * np.sin(2 * np.pi * 1.0 * t)[:, None] * [0.0, 0.0, 1.0]
    if gap:
        force[1000:1010] = np.nan
    imu = ImuSamples(t, dt, rate / RATE_HZ, force / RATE_HZ)
    fixes = [
        GnssSample(
            t=float(k), sensor="gnss", t_arrival=float(k), fix_type=FixType.FIX_3D, lat=0.8, lon=0.1 + 3e-6 * k,
            h=100.0, v_n=np.array([0.0, 20.0, 0.0]), sigma_position_n=np.full(3, 2.0), sigma_velocity_n=np.full(3, 0.2),
            satellites=9, hdop=1.0, vdop=1.5,
        )
        for k in range(1, 60)
    ]  # fmt: skip
    return Log(Path("toy"), "toy", {name: imu}, {"gnss": fixes}, None, 0.0, {})


def found(rows: list[Row], what: str) -> Row:
    return next(row for row in rows if row.what == what)


def test_the_same_flight_is_alike_in_all() -> None:
    flight = survey(toy(2.0))
    rows = likeness.compare(flight, flight)
    assert len(rows) > 8
    assert all(row.alike and row.ratio == 1 for row in rows)


def test_bands_have_the_power_of_what_shakes_in_them() -> None:
    rows = likeness.compare(survey(toy(2.0)), survey(toy(0.5, gap=True)))
    row = found(rows, "specific force in motion, 8 to 32 Hz, rms")
    assert row.flight == pytest.approx(2.0 / math.sqrt(2), rel=0.02)
    assert row.other == pytest.approx(0.5 / math.sqrt(2), rel=0.05)
    assert not row.alike
    assert row.ratio == pytest.approx(0.25, rel=0.05)
    mean_square, _ = integrate.quad(lambda s: (3.0 * math.sin(2 * math.pi * s)) ** 2, 0.0, 1.0)
    rate = found(rows, "rate in motion, 0.5 to 2 Hz, rms")
    assert rate.flight == pytest.approx(math.sqrt(mean_square), rel=0.02)
    assert rate.alike


def test_of_what_a_unit_can_not_feel_nothing_is_said() -> None:
    log = toy(2.0, frequency=3.0)
    imu = log.imus["imu"]
    slower = ImuSamples(*(one[3::4] for one in (imu.t, 4 * imu.dt, imu.dtheta, imu.dv)))  # at 50 Hz
    rows = likeness.compare(survey(replace(log, imus={"imu": slower})), survey(log))
    bands = [row.what for row in rows if row.what.startswith("rate in motion")]
    assert bands == [f"rate in motion, {band} Hz, rms" for band in ("0.5 to 2", "2 to 8", "8 to 25")]


def test_what_only_one_has_is_not_alike_and_what_neither_has_is_no_row() -> None:
    flight = survey(toy(2.0))
    late = replace(flight, latency={"gnss": Late(0.2, 0.0)})
    row = found(likeness.compare(late, flight), "velocity is told of later by")
    assert row.flight == 0.2
    assert math.isnan(row.other)
    assert not row.alike
    assert not [one for one in likeness.compare(flight, flight) if one.what == row.what]


@pytest.mark.parametrize(("lag", "alike"), [(0.01, True), (0.2, False)])
def test_a_receiver_that_is_not_late_is_compared_like_any(lag: float, alike: bool) -> None:
    flight = replace(survey(toy(2.0)), latency={"gnss": Late(0.0, 0.0)})
    row = found(
        likeness.compare(flight, replace(flight, latency={"gnss": Late(lag, 0.0)})), "velocity is told of later by"
    )
    assert row.alike == alike
    only = found(likeness.compare(flight, replace(flight, latency={})), row.what)
    assert not only.alike
    assert math.isnan(only.ratio)


@pytest.mark.parametrize(
    ("flight", "other", "said"),
    [
        (0.9, -0.9, "of the other sign"),
        (5.0, 0.0, "only the flight has any"),
        (0.0, 5.0, "only the simulation has any"),
        (9.0, 3.0, "the flight's is 3 times as large"),
        (3.0, 9.0, "the simulation's is 3 times as large"),
        (0.05, -0.04, "alike"),  # within the slack
    ],
)
def test_what_is_said_of_figures_that_differ(flight: float, other: float, said: str) -> None:
    row = Row("ins: airspeed", "correlation with the innovation before", "", flight, other, slack=0.1)
    assert row.alike == (said == "alike")
    assert beside([row], "simulation").columns[4]._cells[0].removeprefix("[red]").removesuffix("[/]") == said
    assert beside([row], "other log").columns[3].header == "other log"
    for_a_log = beside([row], "other log").columns[4]._cells[0].removeprefix("[red]").removesuffix("[/]")
    assert for_a_log == said.replace("simulation", "other log")


def test_a_flight_of_other_sensors_is_refused() -> None:
    other = toy(2.0, name="second")
    with pytest.raises(UserError, match="has no sensor of the flight's: second; the flight has imu, gnss"):
        likeness.compare(survey(toy(2.0)), survey(replace(other, samples={})))


@pytest.mark.ci
def test_a_run_and_its_rerun_are_compared_by_their_innovations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)

    def command(*arguments: str) -> str:
        monkeypatch.setattr("sys.argv", ["testbed", *arguments])
        monkeypatch.setenv("COLUMNS", "200")
        with suppress(SystemExit):
            cli.main()
        out, err = capsys.readouterr()
        return out + err

    short = ("--no-report", "--set", "duration_s=100", "--set", "record.imu=true")
    command("run", "u_turn", "--out", "flight", *short)
    command("run", "u_turn", "--out", "simulation", *short, "--seed", "2")
    shown = command("log", "flight/run.nc", "--compare", "simulation/run.nc")
    line = next(one for one in shown.splitlines() if "ins: barometer" in one and "NIS" in one)
    assert line.rstrip().endswith("alike │")
    assert "No such file" in command("log", "flight/run.nc", "--compare", "nowhere.nc")
    shown = command("log", "recorded_flight.bin", "--compare", "recorded_flight.toml")  # shipped, a scenario of it
    assert "22 figures, 22 of them alike" in shown
    assert " other log " in shown
    assert " simulation " not in shown
    command("run", "recorded_flight", "--out", "again", *short, "--set", "duration_s=110")
    assert " other log " in command("log", "recorded_flight.bin", "--compare", "again/run.nc")
    assert " simulation " in command("log", "recorded_flight.bin", "--compare", "simulation/run.nc")
    assert "is a scenario without a log" in command("log", "flight/run.nc", "--compare", "u_turn.toml")
