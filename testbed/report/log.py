"""What is in a log, as tables for the console."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from testbed.feeds.draft import sections
from testbed.feeds.mistaken import mistaken
from testbed.feeds.survey import Survey
from testbed.feeds.unsound import barometers, magnetometers
from testbed.score.likeness import ALIKE, Row
from testbed.sensors.units import DEG_PER_H, DEG_PER_ROOT_H, MG, MICROTESLA, MPS_PER_ROOT_H

if TYPE_CHECKING:
    from rich.table import Table

    from testbed.feeds.table import Table as Columns

MESSAGES_SHOWN = 60
PHASES_SHOWN = 20


def tables(found: Survey) -> Iterator[Table]:
    """What the file holds, how its sensors report, the flight, and how good the sensors are."""
    log = found.log
    head = _table(f"{log.path.name}: {log.format}", "", "")
    lasts = max(float(own.t[-1]) for own in log.imus.values()) - log.t0
    head.add_row("lasts", f"{lasts:.1f} s")
    head.add_row("date", str(log.date or "not said"))
    reference = "its GNSS alone" if log.receiver is not None else "none"
    _add(head, "reference", log.solution.name if log.solution is not None else reference)
    listed = [f"{name} {count}" for name, count in sorted(log.messages.items())]
    more = " …" if len(listed) > MESSAGES_SHOWN else ""
    _add(head, "holds", ", ".join(listed[:MESSAGES_SHOWN]) + more)
    unsound = {**magnetometers(found), **barometers(found)}
    for note in [*log.notes, *([log.remark] if log.remark else []), *mistaken(log), *unsound.values()]:
        _add(head, "note", note)
    yield head
    reports = _table("sensors", "sensor", "samples", "rate [Hz]", "jitter [ms]", "gaps", "longest step [s]", "proposed")
    proposed = sections(found)
    for name, one in found.rates.items():
        keys = {key: value for key, value in proposed.get(name, {}).items() if key not in ("kind", "rate_hz")}
        said = ", ".join(f"{key} = {value}" if key != "grade" else str(value) for key, value in keys.items())
        numbers = (f"{one.rate_hz:.4g}", f"{1e3 * one.jitter_s:.3g}", f"{one.gaps}", f"{one.longest_s:.3g}")
        _add(reports, name, str(one.count), *numbers, said)
    yield reports
    flight = _table("flight", "phase", "from [s]", "to [s]")
    longest = sorted(found.phases, key=lambda p: p.start - p.end)[:PHASES_SHOWN]
    for phase in sorted(longest, key=lambda p: p.start):
        flight.add_row(phase.name, f"{phase.start:.0f}", f"{phase.end:.0f}")
    if shorter := len(found.phases) - len(longest):
        flight.caption = f"and {shorter} shorter ones"
    yield flight
    quality = _table("measured", "sensor", "what", "value")
    for row in _measured(found):
        _add(quality, *row)
    if quality.row_count:
        yield quality


def _measured(found: Survey) -> Iterator[tuple[str, str, str]]:
    """Sensor, what, and value with its unit."""
    for name, own in found.noise.items():
        x, y, z = own.gyro_bias / DEG_PER_H
        yield name, f"gyro bias, {own.seconds:.0f} s at rest", f"{x:.0f}, {y:.0f}, {z:.0f} deg/h"
        yield name, "gyro noise, by Allan deviation at 1 s", f"{own.gyro_walk / DEG_PER_ROOT_H:.3g} deg/√h"
        yield name, f"gyro floor, at {own.gyro_floor_s:.3g} s", f"{own.gyro_floor / DEG_PER_H:.3g} deg/h"
        yield name, "accelerometer size less gravity", f"{own.force_error / MG:.3g} mg"
        yield name, "accelerometer noise at 1 s", f"{own.accel_walk / MPS_PER_ROOT_H:.3g} m/s/√h"
        yield name, f"accelerometer floor, at {own.accel_floor_s:.3g} s", f"{own.accel_floor / MG:.3g} mg"
    for name, felt in found.vibration.items():
        yield name, "vibration above 5 Hz, rms", f"{felt.rms:.3g} m/s²"
        for frequency, amplitude in felt.lines:
            yield name, "line of the spectrum", f"{frequency:.1f} Hz, {amplitude:.3g} m/s²"
    for name, late in found.latency.items():
        yield name, "velocity is told of later than the motion by", late.text
    for name, lag in found.velocity_lag_s.items():
        yield name, "velocity is older than the position beside it by", f"{lag:.2f} s"
    for name, sphere in found.spheres.items():
        residual, radius, off, sigma = (f"{value / MICROTESLA:.3g}" for value in sphere)
        yield name, "rms from the sphere that fits", f"{residual} µT about {radius} µT"
        yield name, "its centre, hard iron, is off by", f"{off} µT, to {sigma}"
    for name, scale in found.airspeed_scale.items():
        yield name, "true airspeed over the sensor's", f"{scale:.3f}"


def beside(rows: Sequence[Row], other: str) -> Table:
    """A flight and what it is beside, called ``other``, row by row, and where they are not alike."""
    unlike = sum(not row.alike for row in rows)
    title = f"{len(rows)} figures, {len(rows) - unlike} of them alike, within a factor of {ALIKE:g}"
    table = _table(title, "of", "what", "flight", other, "")
    for row in rows:
        numbers = ("" if math.isnan(value) else f"{value:.3g} {row.unit}".strip() for value in row[3:5])
        table.add_row(row.of, row.what, *numbers, _likeness(row, other))
    return table


def _likeness(row: Row, other: str) -> str:
    if row.alike:
        return "alike"
    if math.isnan(row.ratio):
        return "only the flight has it" if math.isnan(row.other) else f"only the {other} has it"
    if row.opposite:
        return "[red]of the other sign[/]"
    if math.isinf(row.ratio):
        return f"[red]only the {other} has any[/]"
    if row.ratio > 1:
        return f"[red]the {other}'s is {row.ratio:.3g} times as large[/]"
    return (
        f"[red]the flight's is {1 / row.ratio:.3g} times as large[/]"
        if row.ratio
        else "[red]only the flight has any[/]"
    )


def _table(title: str, *columns: str) -> Table:
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=escape(title), title_justify="left", show_header=any(columns))
    for column in columns:
        table.add_column(escape(column), overflow="fold")
    return table


def _add(table: Table, *cells: str) -> None:
    """A row of words of the user's, in which brackets are brackets."""
    from rich.markup import escape

    table.add_row(*map(escape, cells))


def columns(table: Columns, title: str) -> Table:
    """What the columns of a table are, for whoever has to say which is which."""
    import numpy as np

    shown = _table(title, "column", "rows", "least", "largest", "median step")
    for name, values in table.numbers.items():
        known = values[np.isfinite(values)]
        steps = np.diff(values) if values.ndim == 1 and len(values) > 1 else np.empty(0)
        ascends = len(steps) and bool((steps >= 0).all())
        ends = (f"{known.min():.6g}", f"{known.max():.6g}") if len(known) else ("", "")
        shape = " × ".join(map(str, values.shape))
        _add(shown, name, shape, *ends, f"{np.median(steps):.4g}" if ascends else "")
    for name, held in table.others.items():
        _add(shown, name, held)
    return shown
