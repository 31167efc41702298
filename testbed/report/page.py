"""What a run looks like: a table for the console, figures as PNG, and one HTML page that needs nothing else.

Every figure tells one thing. Time without GNSS fix is shaded everywhere, faults where the innovations of their sensor
are shown. An estimator has the same colour wherever it appears; truth is black. Where one estimator leaves the others
behind by orders of magnitude, axes follow the better ones, and a second panel or a logarithmic axis shows the rest.
"""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import chi2

from nav import earth
from nav.observability import Visibility
from nav.samples import Array
from testbed.results import REPORT, held, write_result
from testbed.score import metrics as scores
from testbed.score.metrics import Errors, column

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from rich.table import Table

# Okabe and Ito's palette, safe for colour-blind eyes, from the darkest on; truth is black.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
TRUTH = "#000000"
REFUSED = "#D55E00"
SHADE = "#DDDDDD"
FAULT = "#FBE9A8"
AXIS_COLOURS = ("#0072B2", "#E69F00", "#009E73")  # north-east-down, forward-right-down
BINS = 900  # a line is drawn through the lowest and highest point of each
BIAS_MEAN_S = 60.0
BROKEN = 1e3  # an increment [rad], [m/s] that no IMU measured
PALE = 0.3  # of its colour: a state seen with the help of earlier measurements
FAR = 4.0  # times: what is so much larger than the rest gets a view of its own

ROWS: tuple[tuple[str, str], ...] = (
    ("position_horizontal_rms_m", "horizontal position error, RMS [m]"),
    ("position_horizontal_max_m", "horizontal position error, largest [m]"),
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
FAULT_COLUMNS = (
    ("detection_delay_s", "detected after [s]", "{:.1f}"),
    ("coverage", "refused", "{:.0%}"),
    ("end_lag_s", "used again after [s]", "{:.1f}"),
    ("isolation_correct", "isolated", "{:.0f}"),
)


# -- table ----------------------------------------------------------------------------------------------------------


def _cells(metrics: Mapping[str, float]) -> tuple[list[str], bool, list[list[str]]]:
    """Estimators, whether there was an outage, and the table's rows: label, then one or two cells per estimator."""
    known = {key for key, _ in (*ROWS, *OUTAGE_ROWS, *RUN_ROWS)}
    names = list(
        dict.fromkeys(
            key.partition(".")[0] for key in metrics if key.partition(".")[2].removeprefix("outage_") in known
        )
    )
    outage = any(".outage_" in key for key in metrics)

    def cell(key: str) -> str:
        return f"{metrics[key]:.3g}" if key in metrics else "–"

    rows = []
    for key, label in ROWS:
        if not any(f"{n}.{prefix}{key}" in metrics for n in names for prefix in ("", "outage_")):
            continue
        pairs = [[cell(f"{n}.{key}"), *([cell(f"{n}.outage_{key}")] if outage else [])] for n in names]
        rows.append([label, *(c for pair in pairs for c in pair)])
    for key, label in (*OUTAGE_ROWS, *RUN_ROWS):
        if any(f"{n}.{key}" in metrics for n in names):
            of_outage = key.startswith("outage_")
            pairs = [
                ([""] if of_outage and outage else [])
                + [cell(f"{n}.{key}")]
                + ([""] if outage and not of_outage else [])
                for n in names
            ]
            rows.append([label, *(c for pair in pairs for c in pair)])
    return names, outage, rows


def _pace(metrics: Mapping[str, float]) -> str:
    if "run.wall_s" not in metrics or "run.realtime_factor" not in metrics:
        return ""
    return f"{metrics['run.wall_s']:.3g} s of computing, {metrics['run.realtime_factor']:.4g} times real time"


def _fault_rows(metrics: Mapping[str, float]) -> list[list[str]]:
    """One row per fault and estimator that takes its sensor's samples: fault, estimator, `FAULT_COLUMNS`."""
    scored = [key.split(".") for key in metrics if ".missed." in key]
    rows = []
    for estimator, _, fault in sorted(scored, key=lambda parts: parts[2]):
        values = [(metrics.get(f"{estimator}.{key}.{fault}"), form) for key, _, form in FAULT_COLUMNS]
        cells = ["–" if value is None else form.format(value) for value, form in values]
        cells[0] = "missed" if metrics[f"{estimator}.missed.{fault}"] else cells[0]
        cells[-1] = {"1": "yes", "0": "no"}[cells[-1]]
        rows.append([fault, estimator, *cells])
    return rows


def fault_table(metrics: Mapping[str, float]) -> Table | None:
    """How the faults of a run were detected, for the console; None when there was none to detect."""
    from rich.table import Table

    rows = _fault_rows(metrics)
    if not rows:
        return None
    table = Table()
    for name in ("fault", "estimator"):
        table.add_column(name)
    for _, name, _ in FAULT_COLUMNS:
        table.add_column(name.replace("[", r"\["), justify="right")
    for row in rows:
        table.add_row(*row)
    return table


def summary_table(metrics: Mapping[str, float]) -> Table:
    """The main metrics for the console: estimators side by side, with GNSS and in the outage."""
    from rich.table import Table
    from rich.text import Text

    names, outage, rows = _cells(metrics)
    table = Table(caption=_pace(metrics) or None, caption_justify="left")
    table.add_column("")
    for name in names:
        table.add_column(f"{name}\nwith GNSS" if outage else name, justify="right")
        if outage:
            table.add_column(f"{name}\nin the outage", justify="right")
    if not names:
        table.add_column("no estimator was ever aligned")
    for row in rows if names else ():
        table.add_row(Text(row[0]), *row[1:])  # as text: a unit in brackets is no markup
    return table


# -- data of a run --------------------------------------------------------------------------------------------------


class _Run:
    """What all figures need of a dataset."""

    def __init__(self, dataset: xarray.DataTree) -> None:
        self.dataset = dataset
        self.windows = scores.outages(dataset)
        self.faults = scores.faults(dataset)
        names = scores.names(dataset)
        self.errors = {name: scores.errors(dataset, name) for name in names}
        self.colours = {name: COLOURS[k % len(COLOURS)] for k, name in enumerate(names)}
        self.t = self.truth("time")

    def truth(self, name: str) -> Array:
        return column(self.dataset, f"truth/{name}")

    def estimate(self, estimator: str, name: str) -> Array:
        return column(self.dataset, f"estimators/{estimator}/{name}")

    def has(self, path: str) -> bool:
        node: Any = self.dataset
        for part in path.split("/"):
            if part not in node:
                return False
            node = node[part]
        return True

    @property
    def aligned(self) -> dict[str, Errors]:
        """Errors of the estimators that were ever aligned."""
        return {name: e for name, e in self.errors.items() if e.aligned_s is not None}

    @property
    def positioned(self) -> dict[str, Errors]:
        """Those of them that estimate position and velocity too."""
        return {name: e for name, e in self.aligned.items() if not e.attitude_only}

    def track(self, lat: Array, lon: Array) -> Array:
        """North and east of the run's first point (N, 2) [km]."""
        start = [np.full(len(lat), self.truth(name)[0]) for name in ("lat", "lon", "h")]
        return earth.position_difference_n(lat, lon, start[2], *start)[:, :2] / 1000


def thin(t: Array, y: Array) -> tuple[Array, Array]:
    """A line with at most two points per bin, its lowest and its highest: no peak is lost. NaN stay gaps."""
    size = len(t) // BINS
    if size < 3:
        return t, y
    count = len(t) // size
    bins = y[: count * size].reshape(count, size)
    low = np.where(np.isnan(bins), np.inf, bins).argmin(axis=1)
    high = np.where(np.isnan(bins), -np.inf, bins).argmax(axis=1)
    first, second = np.minimum(low, high), np.maximum(low, high)
    kept = (np.arange(count)[:, None] * size + np.column_stack([first, second])).ravel()
    kept = np.append(kept, np.arange(count * size, len(t)))
    return t[kept], y[kept]


def _stride(n: int) -> slice:
    return slice(None, None, max(1, n // (2 * BINS)))


# -- figures --------------------------------------------------------------------------------------------------------


def _figure(
    rows: int, columns: int = 1, height: float = 2.1, gap: float = 0.16, head: float = 0.45
) -> tuple[Figure, Any]:
    """A figure, its rows on one time axis. Margins are in inches: fixed ones are drawn once, fitted ones thrice."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    tall = 0.55 + head + (height + gap) * rows - gap
    figure = Figure(figsize=(10.5, tall), dpi=100)
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=rows > 1)
    figure.subplots_adjust(0.085, 0.55 / tall, 0.975, 1 - head / tall, wspace=0.2, hspace=gap / height)
    return figure, axes


def _against_time(run: _Run, axes: Any, label_last_row: bool = True) -> None:
    """Shade the outages, set the common time axis, grid and frame."""
    for row in axes:
        for ax in row:
            for start, end in run.windows:
                ax.axvspan(start, min(end, run.t[-1]), color=SHADE, lw=0, zorder=0)
            if run.t[-1] > run.t[0]:
                ax.set_xlim(run.t[0], run.t[-1])
            _dress(ax)
    if label_last_row:
        for ax in axes[-1]:
            ax.set_xlabel("time [s]")


def _dress(ax: Axes) -> None:
    ax.grid(alpha=0.35, lw=0.6)
    ax.spines[["top", "right"]].set_visible(False)


def _legend(run: _Run, ax: Axes, shade: bool = True) -> None:
    """A legend with the shading explained, above the axes so that it hides nothing."""
    from matplotlib.patches import Patch

    handles, labels = ax.get_legend_handles_labels()
    if run.windows and shade:
        handles, labels = [*handles, Patch(color=SHADE)], [*labels, "no GNSS fix"]
    if handles:
        ax.legend(
            handles, labels, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=6, frameon=False, fontsize=9,
            borderaxespad=0.2, handlelength=1.6, columnspacing=1.4,
        )  # fmt: skip


def _head_legend(run: _Run, figure: Figure, handles: list[Any]) -> None:
    """A legend for the whole figure, above everything."""
    from matplotlib.patches import Patch

    if run.windows:
        handles = [*handles, Patch(color=SHADE, label="no GNSS fix")]
    figure.legend(
        handles=handles, loc="upper right", ncols=6, frameon=False, fontsize=9, borderaxespad=0.2, columnspacing=1.4
    )


def ground_track(run: _Run) -> Figure:
    """Where it flew and where each estimator thought it was."""
    truth = run.track(run.truth("lat"), run.truth("lon"))
    believed = {name: run.track(run.estimate(name, "lat"), run.estimate(name, "lon")) for name in run.positioned}
    low, high = truth.min(axis=0), truth.max(axis=0)
    extent = max(float((high - low).max()), 0.02)
    far = [
        name
        for name, points in believed.items()
        if np.isfinite(points).any() and max(np.nanmax(points - high), np.nanmax(low - points)) > extent / FAR
    ]
    figure, axes = _figure(1, 2 if far else 1, height=5.2, head=0.6)
    for k, ax in enumerate(axes[0]):
        denied = scores.inside(run.t, run.windows)
        ax.plot(truth[:, 1], truth[:, 0], color=TRUTH, lw=1.2, label="truth")
        gap = np.where(denied[:, None], truth, np.nan)
        if denied.any():
            ax.plot(gap[:, 1], gap[:, 0], color=SHADE, lw=7, solid_capstyle="round", zorder=0, label="no GNSS fix")
        for name, points in believed.items():
            ax.plot(points[:, 1], points[:, 0], color=run.colours[name], lw=1.1, label=name, zorder=3 - 0.1 * k)
        ax.plot(truth[0, 1], truth[0, 0], "o", color=TRUTH, ms=7, label="start")
        ax.plot(truth[-1, 1], truth[-1, 0], "s", color=TRUTH, ms=7, label="end")
        ax.set_xlabel("east of the start [km]")
        ax.set_aspect("equal", adjustable="box" if far and k == 0 else "datalim")
        _dress(ax)
    axes[0, 0].set_ylabel("north of the start [km]")
    if far:
        margin = 0.12 * extent
        centre = (low + high) / 2
        half = extent / 2 + margin
        axes[0, 0].set_xlim(centre[1] - half, centre[1] + half)
        axes[0, 0].set_ylim(centre[0] - half, centre[0] + half)
        axes[0, 0].set_title("around the true track", fontsize=10)
        axes[0, 1].set_title("as far as the estimates go", fontsize=10)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper center", ncols=6, frameon=False, fontsize=9)
    return figure


def flight(run: _Run) -> Figure:
    """Height and speed of the flight."""
    figure, axes = _figure(2, height=2.5, gap=0.35)
    top, bottom = axes[:, 0]
    top.plot(*thin(run.t, run.truth("h")), color=TRUTH, lw=1.4, label="truth")
    for name in run.positioned:
        top.plot(*thin(run.estimate(name, "time"), run.estimate(name, "h")), color=run.colours[name], lw=1, label=name)
    truth = run.truth("h")
    margin = max(0.15 * float(np.ptp(truth)), 20.0)
    top.set_ylim(truth.min() - margin, truth.max() + margin)
    top.set_ylabel("height above\nellipsoid [m]")
    bottom.plot(*thin(run.t, run.truth("airspeed")), color=TRUTH, lw=1.2, label="true airspeed")
    ground = np.hypot(run.truth("v_n")[:, 0], run.truth("v_n")[:, 1])
    bottom.plot(*thin(run.t, ground), color="#777777", lw=1, ls="--", label="speed over ground")
    bottom.set_ylabel("speed [m/s]")
    _against_time(run, axes)
    _legend(run, top)
    _legend(run, bottom, shade=False)
    return figure


def comparison(run: _Run) -> Figure:
    """Size of the errors of all estimators, logarithmic so that a good one stays readable beside a bad one."""
    of_position: tuple[tuple[str, Callable[[Errors], Array]], ...] = (
        ("horizontal\nposition [m]", lambda e: e.horizontal),
        ("height [m]", lambda e: np.abs(e.position[:, 2])),
    )
    of_attitude: tuple[tuple[str, Callable[[Errors], Array]], ...] = (
        ("roll and\npitch [deg]", lambda e: np.rad2deg(e.tilt)),
        ("heading [deg]", lambda e: np.rad2deg(np.abs(e.attitude[:, 2]))),
    )
    panels = [(run.positioned, *panel) for panel in of_position if run.positioned]
    panels += [(run.aligned, *panel) for panel in of_attitude]
    figure, axes = _figure(len(panels), height=1.9)
    for ax, (shown, label, size) in zip(axes[:, 0], panels, strict=True):
        for name, e in shown.items():
            # A moving mean of squares over 2 s: the single zero crossings of an error say nothing on a log axis.
            ax.plot(
                *thin(e.t, np.maximum(_moving_rms(e.t, size(e), 2.0), 1e-6)),
                color=run.colours[name],
                lw=1.1,
                label=name,
            )
        ax.set_yscale("log")
        ax.set_ylabel(label)
        _focus_log(ax, [size(e)[e.valid] for e in shown.values()])
    _against_time(run, axes)
    for name in run.aligned:  # one legend of them all, also of those without a position
        if name not in panels[0][0]:
            axes[0, 0].plot([], [], color=run.colours[name], lw=1.1, label=name)
    _legend(run, axes[0, 0])
    return figure


def _moving_rms(t: Array, y: Array, seconds: float) -> Array:
    if len(t) < 3:
        return np.abs(y)
    n = max(1, round(seconds / float(np.median(np.diff(t)))))
    finite = np.isfinite(y)
    total, count = np.cumsum(np.where(finite, y, 0.0) ** 2), np.cumsum(finite)
    total[n:], count[n:] = total[n:] - total[:-n], count[n:] - count[:-n]
    result: Array = np.where(finite, np.sqrt(np.maximum(total, 0.0) / np.maximum(count, 1)), np.nan)
    return result


def _focus_log(ax: Axes, values: Sequence[Array]) -> None:
    """Limits from a twentieth of the best median to the largest value."""
    values = [v[v > 0] for v in values]
    values = [v for v in values if len(v)]
    if values:
        ax.set_ylim(min(float(np.median(v)) for v in values) / 20, 2 * max(float(v.max()) for v in values))


def _error_panels(run: _Run, axes: Any, name: str, t: Array, error: Array, sigma: Array, labels: Sequence[str]) -> None:
    """Three errors against the bounds that the estimator claims."""
    some = _stride(len(t))
    for k, ax in enumerate(axes):
        ax.fill_between(
            t[some],
            -3 * sigma[some, k],
            3 * sigma[some, k],
            color=run.colours[name],
            alpha=0.22,
            lw=0,
            label="±3 sigma",
        )
        ax.plot(*thin(t, error[:, k]), color=run.colours[name], lw=0.9, label="error")
        ax.set_ylabel(labels[k])


def _focus(axes: Any, error: Array, sigma: Array, mask: scores.Mask) -> None:
    """Symmetric limits that hold errors and bounds of the rows in ``mask``."""
    for k, ax in enumerate(axes):
        values = np.concatenate([np.abs(error[mask, k]), np.minimum(3 * sigma[mask, k], 1e12)])
        values = values[np.isfinite(values)]
        if len(values) and values.max() > 0:
            limit = 1.15 * float(values.max())
            ax.set_ylim(-limit, limit)


def position_errors(run: _Run, name: str) -> Figure:
    """Position error north, east, down with ±3 sigma; a second column looks closer when an outage dwarfs the rest."""
    e = run.errors[name]
    with_gnss = e.valid & ~_near_outage(run, e)
    largest = [float(np.abs(e.position[m]).max()) if m.any() else 0.0 for m in (e.valid, with_gnss)]
    two = with_gnss.any() and largest[0] > FAR * largest[1]
    figure, axes = _figure(3, 2 if two else 1)
    masks = [e.valid if e.valid.any() else _any_row(e), *([with_gnss] if two else [])]
    for k, mask in enumerate(masks):
        scale, unit = (1e-3, "km") if np.abs(e.position[mask]).max(initial=0.0) > 5000 else (1.0, "m")
        error, sigma = scale * e.position, scale * e.sigma_position
        _error_panels(run, axes[:, k], name, e.t, error, sigma, [f"{d} [{unit}]" for d in ("north", "east", "down")])
        _focus(axes[:, k], error, sigma, mask)
    if two:
        axes[0, 1].set_title("the same, closer", fontsize=10, loc="left")
    _against_time(run, axes)
    _legend(run, axes[0, -1])
    return figure


def _near_outage(run: _Run, e: Errors) -> scores.Mask:
    return scores.inside(e.t, [(start, end + scores.RECOVERY_WINDOW_S) for start, end in run.windows])


def _any_row(e: Errors) -> scores.Mask:
    return np.asarray(np.isfinite(e.attitude).all(axis=1))


def motion_errors(run: _Run, name: str) -> Figure:
    """Velocity and attitude error with ±3 sigma."""
    e = run.errors[name]
    labels = ("about north [deg]", "about east [deg]", "about down [deg]")
    columns = [("attitude", np.rad2deg(e.attitude), np.rad2deg(e.sigma_attitude), labels)]
    if not e.attitude_only:
        columns.insert(0, ("velocity", e.velocity, e.sigma_velocity, ("north [m/s]", "east [m/s]", "down [m/s]")))
    figure, axes = _figure(3, len(columns))
    mask = e.valid if e.valid.any() else _any_row(e)
    for k, (title, error, sigma, names) in enumerate(columns):
        _error_panels(run, axes[:, k], name, e.t, error, sigma, names)
        _focus(axes[:, k], error, sigma, mask)
        axes[0, k].set_title(title, fontsize=10, loc="left")
    _against_time(run, axes)
    _legend(run, axes[0, -1])
    return figure


def attitude(run: _Run) -> Figure:
    """Roll, pitch and heading, true and estimated."""
    figure, axes = _figure(3)
    curves = [("truth", TRUTH, run.t, _euler_deg(run.truth("q_nb")), 1.6)]
    curves += [
        (n, run.colours[n], run.estimate(n, "time"), _euler_deg(run.estimate(n, "q_nb")), 0.9) for n in run.aligned
    ]
    for k, (ax, label) in enumerate(zip(axes[:, 0], ("roll [deg]", "pitch [deg]", "heading [deg]"), strict=True)):
        for rank, (name, colour, t, euler, width) in enumerate(curves):  # truth below, the first estimator on top
            some = _stride(len(t))
            y = euler[some, k].copy()
            y[1:][np.abs(np.diff(y)) > 180] = np.nan  # a turn through north or south is no line across the axes
            ax.plot(t[some], y, color=colour, lw=width, label=name, zorder=3 - 0.1 * rank if rank else 2)
        ax.set_ylabel(label)
    axes[2, 0].set_yticks(range(0, 361, 90))
    axes[2, 0].set_ylim(-5, 365)
    _against_time(run, axes)
    _legend(run, axes[0, 0])
    return figure


def _euler_deg(q: Array) -> Array:
    """Roll, pitch, heading (N, 3) of q_nb (N, 4); heading in [0, 360)."""
    angles = np.rad2deg(scores.euler(q))
    angles[:, 2] %= 360.0
    return angles


def biases(run: _Run, name: str) -> Figure:
    """Estimated biases with ±3 sigma, over what the IMU's error really was where the record tells."""
    figure, axes = _figure(3, 2, head=0.75)
    real = _imu_error(run, name)
    scale = (np.rad2deg(3600.0), 1000 / earth.STANDARD_GRAVITY)
    t = run.estimate(name, "time")
    some = _stride(len(t))
    for j, (what, unit) in enumerate((("gyro", "deg/h"), ("accel", "mg"))):
        value = scale[j] * run.estimate(name, f"{what}_bias")
        sigma = scale[j] * run.estimate(name, f"sigma_{what}_bias")
        for k, (ax, axis) in enumerate(zip(axes[:, j], ("forward", "right", "down"), strict=True)):
            low, high = value[some, k] - 3 * sigma[some, k], value[some, k] + 3 * sigma[some, k]
            ax.fill_between(t[some], low, high, color=run.colours[name], alpha=0.22, lw=0, label="±3 sigma")
            if real is not None:
                ax.plot(real[0], scale[j] * real[1 + j][:, k], color=TRUTH, lw=1, label="IMU - truth, mean of 60 s")
            ax.plot(t[some], value[some, k], color=run.colours[name], lw=1.3, label="estimate")
            ax.set_ylabel(f"{axis} [{unit}]")
            _focus_bias(ax, value[:, k], scale[j] * real[1 + j][:, k] if real is not None else value[:0, k])
    axes[0, 0].set_title("gyro bias", fontsize=10, loc="left")
    axes[0, 1].set_title("accelerometer bias", fontsize=10, loc="left")
    _against_time(run, axes)
    _head_legend(run, figure, axes[0, 0].get_legend_handles_labels()[0])
    return figure


def _focus_bias(ax: Axes, value: Array, real: Array) -> None:
    """Limits around what matters: the first guess's wide bound is cut off."""
    both = np.concatenate([value[np.isfinite(value)], real[np.isfinite(real)]])
    if len(both):
        low, high = float(both.min()), float(both.max())
        margin = 0.6 * (high - low) + 1e-9
        ax.set_ylim(low - margin, high + margin)


def _imu_error(run: _Run, estimator: str) -> tuple[Array, Array, Array] | None:
    """Times and mean error of rate [rad/s] and specific force [m/s^2] of an estimator's IMU, in steps of 10 s."""
    imu = json.loads(run.dataset.attrs.get("estimator_imus", "{}")).get(estimator)
    if imu is None or not run.has(f"sensors/{imu}") or len(run.t) < 3:
        return None
    t = column(run.dataset, f"sensors/{imu}/time")
    edges = np.arange(run.t[0], run.t[-1], 10.0)
    if len(edges) < 2 * BIAS_MEAN_S / 10:
        return None
    means = []
    for name in ("dtheta", "dv"):
        increments = column(run.dataset, f"sensors/{imu}/{name}")
        broken = ~(np.abs(increments) < BROKEN).all(axis=1, keepdims=True)
        measured = np.vstack([np.zeros(3), np.cumsum(np.where(broken, 0.0, increments), axis=0)])
        lost = np.append(0, np.cumsum(broken))
        true = np.cumsum(run.truth(name), axis=0)
        at = np.searchsorted(t, edges + 1e-9, side="right")
        at_true = np.searchsorted(run.t, edges + 1e-9, side="right") - 1
        total = measured[at] - true[at_true]
        n = round(BIAS_MEAN_S / 10)
        whole = lost[at[n:]] == lost[at[:-n]]
        means.append(np.where(whole[:, None], (total[n:] - total[:-n]) / BIAS_MEAN_S, np.nan))
    n = round(BIAS_MEAN_S / 10)
    return (edges[n:] + edges[:-n]) / 2, means[0], means[1]


def innovations(run: _Run, name: str) -> Figure | None:
    """Innovations over their claimed sigma, with the gate; refused ones crossed."""
    aids = [aid for aid in scores.aids(run.dataset, name) if run.has(f"estimators/{name}/innovations/{aid}/innovation")]
    if not aids:
        return None
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    figure, axes = _figure(len(aids), height=1.5, gap=0.32, head=0.75)
    for ax, aid in zip(axes[:, 0], aids, strict=True):
        own = f"innovations/{aid}"
        t, weight = run.estimate(name, f"{own}/sample_time"), run.estimate(name, f"{own}/weight")
        S, z = run.estimate(name, f"{own}/S"), run.estimate(name, f"{own}/innovation")
        refused = scores.refused(weight, run.estimate(name, f"{own}/outcome"))
        gate = np.sqrt(run.estimate(name, f"{own}/threshold"))
        with np.errstate(invalid="ignore", divide="ignore"):
            normalised = z / np.sqrt(np.diagonal(S, axis1=1, axis2=2))
        limit = 1.6 * float(np.nanmax(gate)) if np.isfinite(gate).any() else 6.0
        shown = np.clip(normalised, -0.97 * limit, 0.97 * limit)
        ned, body = ("north", "east", "down"), ("forward", "right", "down")
        labels = ned if aid.startswith(("gnss", "position", "level")) else body[1:] if aid == "nonholonomic" else body
        some = slice(None, None, max(1, len(t) // 4000))
        for k in range(z.shape[1]):
            label = labels[k] if z.shape[1] > 1 else None
            fused = ~refused[some]
            colour = AXIS_COLOURS[k] if z.shape[1] > 1 else run.colours[name]
            ax.plot(t[some][fused], shown[some, k][fused], ".", ms=1.6, color=colour, label=label)
            ax.plot(t[refused], shown[refused, k], "x", ms=4, color=REFUSED, mew=0.9)
        mine = set(run.estimate(name, f"{own}/sensor").astype(str).tolist())
        for fault in run.faults:
            if fault.sensor in mine and fault.start < run.t[-1]:
                ax.axvspan(fault.start, min(fault.end, run.t[-1]), color=FAULT, lw=0, zorder=0.5)
        for sign in (-1, 1):
            ax.plot(t, sign * gate, color="#444444", lw=0.8, ls="--")
        ax.set_ylim(-limit, limit)
        ax.set_title(f"{aid}: {np.mean(refused):.2%} refused", fontsize=10, loc="left")
        if z.shape[1] > 1:
            ax.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3, frameon=False, fontsize=9, markerscale=5)
    figure.supylabel("innovation / its sigma", fontsize=10)
    _against_time(run, axes)
    gates = [run.estimate(name, f"innovations/{aid}/threshold") for aid in aids]
    gate_key = Line2D([], [], color="#444444", lw=0.8, ls="--", label="gate")
    refused_key = Line2D(
        [],
        [],
        color=REFUSED,
        marker="x",
        ls="",
        ms=5,
        label="refused, one axis at least (beyond the axes: at their edge)",
    )
    fault_key = [Patch(color=FAULT, label="fault of the sensor")] if run.faults else []
    gated = [gate_key, refused_key] if any(np.isfinite(gate).any() for gate in gates) else []
    _head_legend(run, figure, [*gated, *fault_key])
    return figure


def consistency(run: _Run) -> Figure:
    """NEES per degree of freedom of every estimator with the 95 % bounds of a single run."""
    quantities = ("position", "velocity", "attitude") if run.positioned else ("attitude",)
    figure, axes = _figure(len(quantities), height=2.0, gap=0.32)
    low, high = (float(chi2.ppf(p, 3)) / 3 for p in (0.025, 0.975))
    for ax, what in zip(axes[:, 0], quantities, strict=True):
        shown = run.aligned if what == "attitude" else run.positioned
        values = {name: np.where(e.valid, getattr(e, f"{what}_nees"), np.nan) for name, e in shown.items()}
        ax.axhspan(low, high, color="#009E73", alpha=0.15, lw=0, label="95 % of a consistent filter")
        ax.axhline(1.0, color="#444444", lw=0.8)
        for name, nees in values.items():
            finite = nees[np.isfinite(nees)]
            inside = f": {np.mean((finite > low) & (finite < high)):.0%} inside" if len(finite) else ""
            t = run.errors[name].t
            smooth = _moving_rms(t, np.sqrt(nees), 2.0) ** 2
            ax.plot(*thin(t, smooth), color=run.colours[name], lw=0.9, label=f"{name}{inside}")
        ax.set_yscale("log")
        _focus_log(ax, list(values.values()))
        bottom, top = ax.get_ylim()
        ax.set_ylim(max(bottom, 1e-3), max(top, 10.0))
        ax.set_ylabel(f"{what}\nNEES / 3")
    _against_time(run, axes)
    for k, ax in enumerate(axes[:, 0]):
        _legend(run, ax, shade=k == 0)
    return figure


def wind(run: _Run) -> Figure | None:
    """Estimated wind over the true one."""
    names = [name for name in run.aligned if run.has(f"estimators/{name}/wind")]
    if not names:
        return None
    figure, axes = _figure(2, height=2.2)
    for k, (ax, label) in enumerate(zip(axes[:, 0], ("from south [m/s]", "from west [m/s]"), strict=True)):
        ax.plot(*thin(run.t, run.truth("wind_n")[:, k]), color="#999999", lw=0.6, label="truth, turbulence included")
        for name in names:
            t, value, sigma = (run.estimate(name, q) for q in ("time", "wind", "sigma_wind"))
            some = _stride(len(t))
            low, high = value[some, k] - 3 * sigma[some, k], value[some, k] + 3 * sigma[some, k]
            ax.fill_between(t[some], low, high, color=run.colours[name], alpha=0.22, lw=0, label=f"{name} ±3 sigma")
            ax.plot(t[some], value[some, k], color=run.colours[name], lw=1.3, label=name)
        everything = np.concatenate([run.truth("wind_n")[:, k], *(run.estimate(n, "wind")[:, k] for n in names)])
        middle, spread = float(np.nanmedian(everything)), float(np.nanmax(np.abs(everything)))
        ax.set_ylim(middle - max(spread, 2.0), middle + max(spread, 2.0))
        ax.set_ylabel(label)
    _against_time(run, axes)
    _legend(run, axes[0, 0])
    return figure


def seen_table(seen: Mapping[str, Visibility]) -> list[list[str]]:
    """Rows for all: head, ranks, steps, then each state: seen from when [s], or the share of it that is, 0 to 1."""
    rows = [["state", *seen], ["rank", *(f"{own.rank[-1]} of {len(own.names)}" for own in seen.values())]]
    rows.append(["in steps of", *(f"{own.t[1] - own.t[0]:.0f} s" for own in seen.values())])
    for state in _states(seen):
        row = [state]
        for own in seen.values():
            if state not in own.names:
                row.append("")
                continue
            k = own.names.index(state)
            since = float(own.seen_from()[k])
            row.append(f"from {since:.0f} s" if np.isfinite(since) else f"never ({own.share[-1, k]:.2f})")
        rows.append(row)
    return rows


def _states(seen: Mapping[str, Visibility]) -> list[str]:
    return list(dict.fromkeys(state for own in seen.values() for state in own.names))


def visibility(run: _Run, seen: Mapping[str, Visibility]) -> Figure | None:
    """Which states can be seen, and when: pale with the help of all before, full by what is measured at the time."""
    if not seen:
        return None
    from matplotlib.colors import to_rgb

    states = _states(seen)
    figure, axes = _figure(1, len(seen), height=0.16 * len(states), head=0.6)
    figure.subplots_adjust(left=0.16, wspace=0.06)
    for ax, (name, own) in zip(axes[0], seen.items(), strict=True):
        cells = np.zeros((len(states), len(own.rank), 4))
        cells[..., :3] = to_rgb(run.colours[name])
        rows = [states.index(state) for state in own.names]
        cells[rows, :, 3] = np.minimum(PALE * own.share + (1 - PALE) * own.alone, 1.0).T  # rounding
        ax.imshow(
            cells, extent=(own.t[0], own.t[-1], len(states) - 0.5, -0.5), aspect="auto", interpolation="nearest",
            zorder=1,
        )  # fmt: skip
        missing = sorted(set(range(len(states))) - set(rows))
        ax.hlines(missing, run.t[0], run.t[-1], color="#BBBBBB", lw=0.6)
        ax.set_yticks(range(len(states)), states if ax is axes[0, 0] else [], fontsize=7)
        ax.set_title(name, fontsize=10, loc="left")
    _against_time(run, axes)
    for ax in axes[0]:
        ax.grid(axis="y", visible=False)
    _head_legend(run, figure, [])
    return figure


# -- page -----------------------------------------------------------------------------------------------------------


def _figures(run: _Run, seen: Mapping[str, Visibility]) -> Iterator[tuple[str, str, Figure | None]]:
    """File name, caption and figure, in reading order."""
    yield "ground_track", "Ground track.", ground_track(run)
    yield "flight", "Height and speed.", flight(run)
    if run.aligned:
        yield "comparison", "Size of the errors (2 s RMS), logarithmic.", comparison(run)
        yield "attitude", "Attitude.", attitude(run)
        yield "wind", "Wind over ground: estimate and truth.", wind(run)
        yield (
            "nees",
            "Consistency: squared errors over claimed variances (2 s mean); 1 is right, above is overconfident.",
            (consistency(run)),
        )
    for name, e in run.aligned.items():
        if e.attitude_only:
            yield f"{name}_attitude_errors", f"{name}: attitude error with ±3 sigma.", motion_errors(run, name)
        else:
            yield f"{name}_position_errors", f"{name}: position error with ±3 sigma.", position_errors(run, name)
            yield (
                f"{name}_motion_errors",
                f"{name}: velocity and attitude errors with ±3 sigma.",
                motion_errors(run, name),
            )
        yield f"{name}_biases", f"{name}: estimated IMU biases with ±3 sigma.", biases(run, name)
        yield f"{name}_innovations", f"{name}: what each aid said that was not expected.", innovations(run, name)
    yield (
        "visibility",
        "Which states can be seen, and when. Full colour: by what was measured at that time; pale: only together with"
        " what was measured before; blank: not at all, or not apart from others. A line: the estimator has no such"
        " state.",
        visibility(run, seen),
    )


def write_report(
    dataset: xarray.DataTree,
    metrics: Mapping[str, float],
    folder: Path,
    seen: Mapping[str, Visibility] = MappingProxyType({}),
    force: bool = False,
) -> Path:
    """Write ``report.html`` and one PNG per figure into ``folder`` and return the page's path.

    ``seen`` tells which states of each estimator can be seen. The page holds everything it shows. Raises UserError when
    the folder can't be written or, without ``force``, holds files of these names that no earlier command made.
    """
    run = _Run(dataset)
    with held(folder):
        shown = []
        for name, caption, figure in _figures(run, seen):
            if figure is not None:
                png = io.BytesIO()
                figure.savefig(png, pil_kwargs={"compress_level": 4})
                write_result(folder / f"{name}.png", png.getvalue(), force)
                shown.append((caption, png.getvalue()))
        page = folder / REPORT
        write_result(page, _page(run, metrics, shown, seen).encode(), force)
    return page


_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;color:#222;max-width:1080px;margin:2em auto;padding:0 1em}
h1{font-size:1.5em;margin-bottom:.1em} table{border-collapse:collapse;margin:1em 0}
td,th{padding:.2em .9em;border-bottom:1px solid #ddd;text-align:right;font-variant-numeric:tabular-nums}
td:first-child,th:first-child{text-align:left} figure{margin:2em 0} img{max-width:100%}
.seen{font-size:.85em} .seen td,.seen th{padding:.05em .9em}
figcaption{color:#444} pre{background:#f6f6f6;padding:1em;overflow:auto} .warning{color:#a30}
"""


def _page(
    run: _Run, metrics: Mapping[str, float], figures: Sequence[tuple[str, bytes]], seen: Mapping[str, Visibility]
) -> str:
    attributes = run.dataset.attrs
    title = html.escape(str(attributes.get("title", "Run")))
    parts = [
        f"<!DOCTYPE html><html lang='en'><head><meta charset='utf-8'><title>{title}</title>",
        f"<style>{_STYLE}</style></head><body><h1>{title}</h1>",
        f"<p>{run.t[-1]:.6g} s, seed {attributes.get('seed', '')}. {_pace(metrics)}</p>",
    ]
    if not attributes.get("complete", 1):
        parts.append("<p class='warning'>The run did not end: this is its record up to the last flush.</p>")
    parts += [
        f"<p class='warning'>{html.escape(name)} was never aligned: it has no errors to show.</p>"
        for name, e in run.errors.items()
        if e.aligned_s is None
    ]
    parts.append(_html_table(metrics))
    parts.append(_html_faults(run, metrics))
    for caption, image in figures:
        data = base64.b64encode(image).decode()
        text = html.escape(caption)
        parts.append(
            f"<figure><img alt='{text}' src='data:image/png;base64,{data}'><figcaption>{text}</figcaption></figure>"
        )
    parts.append(_html_seen(seen))
    parts.append(_html_events(run))
    for summary, key in (("Scenario", "scenario"), ("Overrides", "overrides"), ("Versions", "versions")):
        if attributes.get(key):
            parts.append(
                f"<details><summary>{summary}</summary><pre>{html.escape(str(attributes[key]))}</pre></details>"
            )
    return "\n".join([*parts, "</body></html>\n"])


def _html_table(metrics: Mapping[str, float]) -> str:
    names, outage, rows = _cells(metrics)
    if not names:
        return ""
    span = 2 if outage else 1
    head = "".join(f"<th colspan='{span}'>{html.escape(name)}</th>" for name in names)
    second = "<tr><th></th>" + "<th>with GNSS</th><th>in the outage</th>" * len(names) + "</tr>" if outage else ""
    body = "".join("<tr>" + "".join(f"<td>{html.escape(c)}</td>" for c in row) + "</tr>" for row in rows)
    return f"<table><tr><th></th>{head}</tr>{second}{body}</table>"


def _html_faults(run: _Run, metrics: Mapping[str, float]) -> str:
    """What went wrong, and for each estimator how it was detected."""
    if not run.faults:
        return ""
    told = {fault.name: f"{fault}, {fault.start:g} to {fault.end:g} s" for fault in run.faults}
    names = ("fault", "estimator", *(name for _, name, _ in FAULT_COLUMNS))
    rows = _fault_rows(metrics)
    scored = {row[0] for row in rows}
    rows += [[name, "none looked", *[""] * len(FAULT_COLUMNS)] for name in told if name not in scored]
    order = list(told)
    rows.sort(key=lambda row: order.index(row[0]))
    shown = [[f"{row[0]}: {told[row[0]]}", *row[1:]] for row in rows]
    head = "".join(f"<th>{html.escape(name)}</th>" for name in names)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in shown)
    return f"<table><tr>{head}</tr>{body}</table>"


def _html_seen(seen: Mapping[str, Visibility]) -> str:
    """Since when which states can be seen."""
    if not seen:
        return ""
    head, *body = ["".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in seen_table(seen)]
    text = (
        "Since when the looks that were used can show the state: an error as large as it was once aligned moves what"
        " is measured within five seconds by its noise. These are the units: of states their 1-sigma once aligned, of"
        " looks their noise, of time 5 s. In brackets the share that shows of a state that is never seen alone. phi is"
        " the error of attitude [rad], dv of velocity [m/s], dp of position [m]; x, y, z are the axes of the body. A"
        " federated filter counts as one filter with the aids of all its locals."
    )
    lines = "".join(f"<tr>{row}</tr>" for row in body)
    return (
        f"<figure><table class='seen'><tr>{head.replace('td>', 'th>')}</tr>{lines}</table>"
        f"<figcaption>{text}</figcaption></figure>"
    )


def _html_events(run: _Run) -> str:
    if not run.has("events"):
        return ""
    columns = [np.atleast_1d(column(run.dataset, f"events/{name}")) for name in ("time", "severity", "text")]
    body = "".join(
        f"<tr><td>{when:.1f} s</td><td>{html.escape(str(how))}</td><td>{html.escape(str(what))}</td></tr>"
        for when, how, what in zip(*columns, strict=True)
    )
    return f"<details><summary>Events</summary><table>{body}</table></details>"
