"""An aircraft as tables: its limits, its trims over airspeed, its natural modes. None is wider than 80 columns."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from rich.table import Table

from testbed.motion import aircraft
from testbed.motion.modes import Mode, Trim, trim_and_modes

ALTITUDE = 300.0  # at which it is looked at [m]
SPEEDS = 5  # from the slowest to the fastest


def listed() -> Table:
    """The shipped aircraft."""
    table = Table("name", "what it is")
    for name in aircraft.shipped():
        table.add_row(name, aircraft.load(name).title)
    return table


def tables(name: str) -> Iterator[Table]:
    """Limits, trims and modes of a shipped aircraft, or of one in a folder. Raises UserError where there is none."""
    envelope = aircraft.load(name)
    yield _limits(envelope)
    slowest, fastest = envelope.min_airspeed(ALTITUDE), envelope.max_airspeed(ALTITUDE)
    airspeeds = np.round(2 * np.linspace(math.ceil(2 * slowest) / 2, math.floor(2 * fastest) / 2, SPEEDS)) / 2
    found = [trim_and_modes(name, float(airspeed), ALTITUDE) for airspeed in airspeeds]
    yield _trims([trim for trim, _ in found], envelope)
    yield _modes(found)


def _limits(envelope: aircraft.Envelope) -> Table:
    table = Table("limit", "value", title=envelope.title)
    speed, usual = envelope.airspeed, envelope.usual
    turn = f"{math.degrees(usual.turn_rate_radps):.1f} deg/s"
    for what, value in {
        "stall, 1 g, equivalent airspeed": f"{speed.stall_mps:g} m/s",
        "slowest flown, equivalent": f"{envelope.min_airspeed(0.0):.1f} m/s",
        "fastest, equivalent": f"{speed.max_mps:g} m/s",
        "steepest bank": f"{envelope.bank.max_deg:g} deg",
        "altitude": f"{envelope.altitude.floor_m:g} to {envelope.altitude.ceiling_m:g} m",
        "usually flown, true airspeed": f"{usual.airspeed_mps:g} m/s",
        "usual turn": turn,
        "launched": _launched(envelope.launch),
    }.items():
        table.add_row(what, value)
    return table


def _launched(launch: aircraft.Launch | None) -> str:
    if launch is None:
        return "not from the ground"
    return f"nose up {launch.pitch_deg:g} deg, to {launch.speed_mps:g} m/s over {launch.length_m:g} m"


def _trims(trims: list[Trim], envelope: aircraft.Envelope) -> Table:
    heads = ("TAS\nm/s", "alpha\ndeg", "elev.\n%", "throt.\n%", "rev/min", "thrust\nN")
    table = Table(
        *heads, "climb\nm/s", "descent\nm/s", "bank\ndeg", title=f"trimmed at {ALTITUDE:g} m, and limits there"
    )
    for trim in trims:
        v = trim.airspeed
        table.add_row(
            f"{v:g}",
            f"{math.degrees(trim.alpha):.1f}",
            f"{100 * trim.elevator:.0f}",
            f"{100 * trim.throttle:.0f}",
            f"{trim.rpm:.0f}",
            f"{trim.thrust:.1f}",
            f"{max(envelope.climb_limit(v, ALTITUDE), 0.0):.1f}",
            f"{max(envelope.descent_limit(v, ALTITUDE), 0.0):.1f}",
            f"{math.degrees(envelope.bank_limit(v, ALTITUDE)):.0f}",
        )
    return _right(table)


def _modes(found: list[tuple[Trim, list[Mode]]]) -> Table:
    heads = ("TAS\nm/s", "mode", "eigenvalue\n1/s", "damping", "period\ns", "time\nconstant s")
    table = Table(*heads, title="modes, hands off")
    for trim, modes in found:
        for mode in modes:
            s = mode.eigenvalue
            value = f"{s.real:.3f} ± {abs(s.imag):.3f}i" if s.imag else f"{s.real:.4f}"
            period = f"{mode.period:.2f}" if math.isfinite(mode.period) else "–"
            first = f"{trim.airspeed:g}" if mode is modes[0] else ""
            last = mode is modes[-1]
            table.add_row(
                first, mode.name, value, f"{mode.damping:.2f}", period, f"{mode.time_constant:.2f}", end_section=last
            )
    return _right(table)


def _right(table: Table) -> Table:
    """Numbers stand right, and nothing is cut."""
    for column in table.columns:
        column.no_wrap = True
        column.justify = "left" if column.header == "mode" else "right"
    return table
