"""Tables of a run, for the console and the page: metrics, how faults were detected, which states can be seen."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nav.observability import Visibility
from testbed.report.figures.observability import states_of
from testbed.score import metrics as scores
from testbed.sensors.faults import FaultTruth

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderResult
    from rich.table import Table

ROWS: tuple[tuple[str, str], ...] = (
    ("position_horizontal_rms_m", "horizontal position error, RMS [m]"),
    ("position_horizontal_max_m", "horizontal position error, largest [m]"),
    ("position_horizontal_over_3sigma_max", "horizontal position error, largest over claimed 3 σ"),
    ("position_vertical_rms_m", "vertical position error, RMS [m]"),
    ("velocity_rms_mps", "velocity error, RMS [m/s]"),
    ("roll_pitch_rms_deg", "roll and pitch error, RMS [deg]"),
    ("roll_pitch_max_deg", "roll and pitch error, largest [deg]"),
    ("heading_rms_deg", "heading error, RMS [deg]"),
    ("position_nees_mean", "position NEES per degree of freedom"),
    ("velocity_nees_mean", "velocity NEES per degree of freedom"),
    ("attitude_nees_mean", "attitude NEES per degree of freedom"),
)
OUTAGE_ROWS = tuple(
    (f"outage_position_horizontal_at_{mark}s_m", f"horizontal error after {mark} s [m]")
    for mark in scores.OUTAGE_MARKS_S
)
RUN_ROWS = (
    ("recovery_s", "back below 5 m after [s]"),
    ("unrecovered_outages", "outages it did not recover from"),
    ("aligned_s", "aligned at [s]"),
    ("nonfinite_samples", "estimates that are not finite"),
)
FAULT_COLUMNS: tuple[tuple[str, str, Callable[[float], str]], ...] = (
    ("detection_delay_s", "detected after [s]", "{:.1f}".format),
    ("coverage", "refused", lambda share: f"{100 * share:.3g} %"),
    ("end_lag_s", "used again after [s]", "{:.1f}".format),
    ("isolation_correct", "isolated", lambda correct: "yes" if correct else "no"),
    ("error_over_3sigma", "error / claimed 3 σ", "{:.2g}".format),
)
PHASES = ("with GNSS", "in the outage")
NOTHING = "–"


def _fitting(console: Console, options: ConsoleOptions, whole: Table, parts: Iterable[Table]) -> RenderResult:
    """The whole table where the console is wide enough, its parts one below the other where it is not."""
    from rich.measure import Measurement

    several = list(parts)
    fits = Measurement.get(console, options.update(max_width=10_000), whole).maximum <= options.max_width
    yield from [whole] if fits or len(several) < 2 else several


# --- metrics


@dataclass(frozen=True, slots=True)
class Summary:
    """The main metrics: for each row its label, and for each estimator one cell, or with an ``outage`` one per phase.

    Printed on a console, estimators stand side by side, or one below the other where that would not fit.
    """

    names: Sequence[str]
    outage: bool
    rows: Sequence[tuple[str, Sequence[Sequence[str]]]]
    pace: str

    @property
    def phases(self) -> tuple[str, ...]:
        """Heads of the columns of one estimator; none where there is one column."""
        return PHASES if self.outage else ()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """One table, or one for each estimator: whatever the width, no number is cut."""
        every = range(len(self.names))
        yield from _fitting(console, options, self._table(every), (self._table([k]) for k in every))
        if self.pace:
            yield self.pace

    def _table(self, shown: Sequence[int]) -> Table:
        from rich.table import Table
        from rich.text import Text

        table = Table()
        table.add_column("")
        for k in shown:
            for phase in self.phases or ("",):
                table.add_column(f"{self.names[k]}\n{phase}".strip(), justify="right", no_wrap=True, overflow="fold")
        if not self.names:
            table.add_column("no estimator was ever aligned")
        for label, cells in self.rows:
            if any(cell not in ("", NOTHING) for k in shown for cell in cells[k]):
                table.add_row(Text(label), *(cell for k in shown for cell in cells[k]))  # text: a unit is no markup
        return table


def summary(metrics: Mapping[str, float]) -> Summary:
    """The main metrics of a run: estimators side by side, with GNSS and in the outage."""
    known = {key for key, _ in (*ROWS, *OUTAGE_ROWS, *RUN_ROWS)}
    parts = [key.partition(".")[::2] for key in metrics]
    names = list(dict.fromkeys(name for name, key in parts if key.removeprefix("outage_") in known))
    outage = any(".outage_" in key for key in metrics)
    rows = []
    for key, label in (*ROWS, *OUTAGE_ROWS, *RUN_ROWS):
        cells = [_cells(metrics, name, key, outage) for name in names]
        if any(cell not in ("", NOTHING) for own in cells for cell in own):
            rows.append((label, cells))
    return Summary(names, outage, rows, _pace(metrics))


def _cells(metrics: Mapping[str, float], name: str, key: str, outage: bool) -> list[str]:
    """What one estimator has in one row: with GNSS, and in the outage if there was one."""

    def cell(key: str) -> str:
        return f"{metrics[f'{name}.{key}']:.3g}" if f"{name}.{key}" in metrics else NOTHING

    if not outage:
        return [cell(key)]
    if key in dict(OUTAGE_ROWS):
        return ["", cell(key)]
    return [cell(key), cell(f"outage_{key}") if key in dict(ROWS) else ""]


def _pace(metrics: Mapping[str, float]) -> str:
    if "run.wall_s" not in metrics or "run.realtime_factor" not in metrics:
        return ""
    return f"{metrics['run.wall_s']:.3g} s of computing, {metrics['run.realtime_factor']:.4g} times real time"


# --- faults


def _fault_rows(metrics: Mapping[str, float]) -> list[list[str]]:
    """One row per fault and estimator that takes its sensor's samples: fault, estimator, `FAULT_COLUMNS`."""
    scored = [key.split(".") for key in metrics if ".missed." in key]
    rows = []
    for estimator, _, fault in sorted(scored, key=lambda parts: parts[2]):
        values = [(metrics.get(f"{estimator}.{key}.{fault}"), shown) for key, _, shown in FAULT_COLUMNS]
        cells = [NOTHING if value is None else shown(value) for value, shown in values]
        cells[0] = "missed" if metrics[f"{estimator}.missed.{fault}"] else cells[0]
        rows.append([fault, estimator, *cells])
    return rows


@dataclass(frozen=True, slots=True)
class FaultTable:
    """How faults were detected: fault, estimator and `FAULT_COLUMNS` in each row. Printed as `Summary` is."""

    rows: Sequence[Sequence[str]]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """One table, or one for each estimator."""
        names = dict.fromkeys(row[1] for row in self.rows)
        yield from _fitting(console, options, self._table(), (self._table(name) for name in names))

    def _table(self, only: str = "") -> Table:
        from rich.markup import escape
        from rich.table import Table

        table = Table(title=only or None, title_justify="left")
        for name in ("fault",) if only else ("fault", "estimator"):
            table.add_column(name, overflow="fold")
        for _, name, _ in FAULT_COLUMNS:
            table.add_column(escape(name), justify="right")
        for fault, estimator, *cells in self.rows:
            if not only:
                table.add_row(fault, estimator, *cells)
            elif estimator == only:
                table.add_row(fault, *cells)
        return table


def fault_table(metrics: Mapping[str, float]) -> FaultTable | None:
    """How the faults of a run were detected, for the console; None when there was none to detect."""
    rows = _fault_rows(metrics)
    return FaultTable(rows) if rows else None


def faults(happened: Sequence[FaultTruth], metrics: Mapping[str, float]) -> list[list[str]]:
    """What went wrong, and for each estimator how it was detected: a head and its rows; empty without faults."""
    if not happened:
        return []
    told = {fault.name: f"{fault}, {fault.start:g} to {fault.end:g} s" for fault in happened}
    rows = _fault_rows(metrics)
    scored = {row[0] for row in rows}
    rows += [[name, "none looked", *[""] * len(FAULT_COLUMNS)] for name in told if name not in scored]
    order = list(told)
    rows.sort(key=lambda row: order.index(row[0]))
    head = ["fault", "estimator", *(name for _, name, _ in FAULT_COLUMNS)]
    return [head, *([f"{row[0]}: {told[row[0]]}", *row[1:]] for row in rows)]


# --- observability


def seen(visible: Mapping[str, Visibility]) -> list[list[str]]:
    """A head, ranks, steps, then each state: seen from when [s], or the share of it that is, 0 to 1; or nothing."""
    return list(_seen(visible)) if visible else []


def _seen(visible: Mapping[str, Visibility]) -> Iterator[list[str]]:
    yield ["state", *visible]
    yield ["rank", *(f"{own.rank[-1]} of {len(own.names)}" for own in visible.values())]
    yield ["in steps of", *(f"{own.t[1] - own.t[0]:.0f} s" for own in visible.values())]
    for state in states_of(visible):
        row = [state]
        for own in visible.values():
            if state not in own.names:
                row.append("")
                continue
            k = own.names.index(state)
            since = float(own.seen_from()[k])
            row.append(f"from {since:.0f} s" if np.isfinite(since) else f"never ({own.share[-1, k]:.2f})")
        yield row
