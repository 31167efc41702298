"""An aircraft as tables."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from testbed.errors import UserError
from testbed.motion import aircraft
from testbed.report.aircraft import SPEEDS, listed, tables


def shown(name: str | None) -> str:
    """What a terminal of 80 columns shows."""
    console = Console(width=80, file=io.StringIO())
    for table in [listed()] if name is None else tables(name):
        console.print(table)
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    assert max(map(len, text.splitlines())) <= 80
    return text


def test_shipped_aircraft_are_listed() -> None:
    assert all(name in shown(None) for name in aircraft.shipped())


@pytest.mark.ci
def test_limits_trims_and_modes_fit_80_columns() -> None:
    text = shown("flying_wing")
    assert "…" not in text
    assert text.count("short period") == text.count("spiral") == SPEEDS
    for said in ("9.6 m/s", "12.0 m/s", "25 m/s", "40 deg", "30 to 3000 m", "12.5", "throt.", "Dutch roll"):
        assert said in text


def test_an_aircraft_that_is_not_there_is_told() -> None:
    with pytest.raises(UserError, match=r"no such aircraft.* flying_wing, loiter"):
        next(tables("loitr"))
