"""Sensors of a log that can't be right are told, and no others."""

from __future__ import annotations

import contextlib
import datetime as dt
import io
import math
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from worlds.log_writers import dataflash, us

import testbed.__main__ as cli
from nav.earth import isa_pressure
from testbed.feeds import draft, formats
from testbed.feeds.survey import Survey, survey
from testbed.feeds.unsound import barometers, magnetometers
from testbed.report.log import tables
from testbed.sensors.magnetometer import geomagnetic_field_n

REST_S, SECONDS, IMU_HZ, GNSS_HZ, SPEED = 20.0, 40.0, 50, 5, 12.0
HEIGHT, WEEK, MONDAY_MS = 724.0, 1820, 100_000_000
DATE = dt.date(2014, 11, 24)
ROLL = math.radians(20.0)
ADVICE = "leave it out of the estimators' aids, or correct its calibration or axes"


def flown(
    folder: Path, dips: float = 0.0, factor: float = 1.0, motors: float = 1.0, second: bool = False, air: float = 1.0
) -> Survey:
    """A vehicle that lies rolled, and then flies north; its field is turned down by ``dips`` [deg] and enlarged.

    In flight it is enlarged by ``motors`` besides, and pressure is always by ``air``; a second magnetometer is sound.
    """
    true = geomagnetic_field_n(math.radians(47), math.radians(8), HEIGHT, DATE) * 1e7
    dip = math.radians(dips)
    turned = np.array([true[0] * math.cos(dip) - true[2] * math.sin(dip), true[1], true[2] * math.cos(dip)])
    turned[2] += true[0] * math.sin(dip)
    found: list[tuple[str, tuple[Any, ...]]] = []
    for k in range(1, int(SECONDS * IMU_HZ) + 1):
        t = k / IMU_HZ
        flies, roll = t > REST_S, 0.0 if t > REST_S else ROLL
        shaken = 0.5 * (-1) ** k if flies else 0.0
        force = shaken, -9.81 * math.sin(roll), -9.81 * math.cos(roll)
        found.append(("IMU", (us(t), 0, 0.0, 0.0, 0.0, *force)))
        if k % (IMU_HZ // GNSS_HZ):
            continue
        north = SPEED * max(t - REST_S, 0.0)
        place = 47 + math.degrees(north / 6.378e6), 8.0, HEIGHT
        told = us(t), 0, 3, MONDAY_MS + round(t * 1e3), WEEK, 10, 1.0
        found.append(("GPS", (*told, *place, SPEED if flies else 0.0, 0.0, 0.0)))
        for number, field in enumerate((turned * factor * (motors if flies else 1.0), true)[: 1 + second]):
            across, down = field[1], field[2]
            rolled = (
                field[0],
                across * math.cos(roll) + down * math.sin(roll),
                down * math.cos(roll) - across * math.sin(roll),
            )
            found.append(("MAG", (us(t), number, *rolled)))
        found.append(("BARO", (us(t), 0, 0.0, air * float(isa_pressure(HEIGHT)))))
    return survey(formats.read(dataflash(found, folder / "flight.bin"), {}))


@pytest.mark.ci
@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({}, ""),
        ({"dips": 10.0}, ""),
        ({"factor": 1.2}, ""),
        ({"motors": 1.2}, ""),
        ({"dips": -25.0}, "at rest its field is inclined by 38 deg, by the World Magnetic Model by 63 deg"),
        ({"dips": 20.0}, "at rest its field is inclined by 83 deg, by the World Magnetic Model by 63 deg"),
        ({"factor": 1.5}, "at rest its field is of 71.6 µT, by the World Magnetic Model of 47.7 µT"),
        ({"factor": 0.6}, "at rest its field is of 28.6 µT, by the World Magnetic Model of 47.7 µT"),
        ({"motors": 1.5}, "in flight its field is 1.50 times as large as at rest, as motors' currents make it"),
    ],
)
def test_a_magnetometer_that_is_not_in_the_earths_field_is_told(
    wrong: dict[str, Any], said: str, tmp_path: Path
) -> None:
    told = magnetometers(flown(tmp_path, **wrong))
    assert told == ({"magnetometer": f"magnetometer: {said}: {ADVICE}"} if said else {})


@pytest.mark.parametrize(("factor", "said"), [(1.0, ""), (0.3, "14.3"), (2.0, "95.4")])
def test_a_field_that_is_not_the_earths_is_told_without_a_rest_too(factor: float, said: str, tmp_path: Path) -> None:
    found = flown(tmp_path, factor=factor)
    restless = replace(found, phases=[phase for phase in found.phases if phase.name != "rest"])
    mostly = f"its field is of {said} µT mostly, where the Earth's is of 22 to 67 µT"
    assert magnetometers(restless) == ({"magnetometer": f"magnetometer: {mostly}: {ADVICE}"} if said else {})


@pytest.mark.parametrize("factor", [1.0, 1.5])
def test_a_draft_takes_the_magnetometer_that_is_sound(factor: float, tmp_path: Path) -> None:
    text = draft.scenario(flown(tmp_path, factor=factor, second=True), tmp_path / "x", None)
    taken = "magnetometer" if factor == 1.0 else "magnetometer2"
    assert f'aids = ["gnss", "barometer", "{taken}"]' in text


def test_a_draft_leaves_out_of_aids_what_its_note_says_to_leave_out(tmp_path: Path) -> None:
    """An INS whose magnetometer was noted as unfit, and was among its aids, never aligned."""
    found = flown(tmp_path, factor=1.5)
    text = draft.scenario(found, tmp_path / "x", None)
    assert [one["aids"] for one in tomllib.loads(text)["estimator"]] == [["gnss", "barometer"], ["barometer"]]
    (said,) = magnetometers(found).values()
    assert f"[sensors.magnetometer]\n# Among no estimator's aids: {said}\n" in text
    thin = draft.scenario(flown(tmp_path, air=0.5), tmp_path / "x", None)
    assert [one["aids"] for one in tomllib.loads(thin)["estimator"]] == [["gnss", "magnetometer"], ["magnetometer"]]


@pytest.mark.parametrize(("air", "where"), [(1.0, ""), (0.95, ""), (0.5, "5394 m above"), (2.0, "6143 m below")])
def test_a_barometer_that_is_elsewhere_than_its_receiver_is_told(air: float, where: str, tmp_path: Path) -> None:
    found = flown(tmp_path, air=air)
    advice = "leave it out of the estimators' aids, or correct its pressure"
    told = {"barometer": f"barometer: its pressure altitude is {where} gnss (median): {advice}"}
    assert barometers(found) == (told if where else {})
    console = Console(width=1000, file=io.StringIO())
    console.print(next(tables(found)))
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    assert ("its pressure altitude is" in shown) == bool(where)


@pytest.mark.parametrize("date", ["", "date = 2024-06-01\n"])
def test_a_table_has_the_date_of_its_scenario(
    date: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    t, mag_t = np.arange(0, 20, 0.02), np.arange(0, 20, 0.1)
    flat = {"t": t, "g": np.zeros((len(t), 3)), "a": np.tile([0, 0, -9.8], (len(t), 1)), "mag_t": mag_t}
    flat |= {"m": np.tile([480.0, 0.0, 0.0], (len(mag_t), 1)), "lat": np.full(len(mag_t), 47.0)}
    np.savez(tmp_path / "a.npz", **flat)
    (tmp_path / "a.toml").write_text(
        f'title = "a"\nduration_s = 15\n{date}[truth]\nsource = "log"\nfile = "a.npz"\n'
        '[truth.columns.imu]\ntime = "t"\ngyro = "g"\naccel = "a"\n'
        '[truth.columns.gnss]\ntime = "mag_t"\nlat = { column = "lat", unit = "deg" }\n'
        'lon = { column = "lat", unit = "deg" }\nheight = "lat"\n'
        '[truth.columns.magnetometer]\ntime = "mag_t"\nfield = { column = "m", unit = "mG" }\n'
        '[sensors.imu]\n[sensors.gnss]\n[[estimator]]\nname = "ins"\nkind = "ins"\naids = ["gnss"]\n'
    )
    monkeypatch.setenv("COLUMNS", "300")
    monkeypatch.setattr("sys.argv", ["testbed", "log", str(tmp_path / "a.toml")])
    with contextlib.suppress(SystemExit):
        cli.main()
    told = "magnetometer: at rest its field is inclined by 0 deg, by the World Magnetic Model by 6"
    assert (told in capsys.readouterr().out) == bool(date)
