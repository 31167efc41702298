"""Where it flew, how high and how fast, and in what wind."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from nav.samples import Array
from testbed.report.figures.plot import Plot
from testbed.report.run import Run
from testbed.report.style import (
    FAINT,
    FAR,
    GUIDE,
    SHADE,
    TRUTH,
    keys_of,
    layer,
    patch,
    sheet,
    stride,
    thin,
)
from testbed.score import accuracy
from testbed.score.accuracy import column

SHORT_KM, TICKS = 2.0, 6
LEAST_SPEEDS = 2.0  # that the speed panel spans [m/s]: in calm air the rest is no news
MOST_WIND = 1e6  # [m/s] that the wind panel makes room for

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def ground_track(run: Run) -> Figure | None:
    """Where it flew and where each estimator thought it was."""
    truth = run.track(run.truth("lat"), run.truth("lon"))
    if not np.isfinite(truth).any():
        return None
    believed = {name: run.track(run.estimate(name, "lat"), run.estimate(name, "lon")) for name in run.positioned}
    low, high = np.nanmin(truth, axis=0), np.nanmax(truth, axis=0)
    extent = max(float((high - low).max()), 0.02)
    far = any(
        np.isfinite(points).any() and max(np.nanmax(points - high), np.nanmax(low - points)) > extent / FAR
        for points in believed.values()
    )
    drawn = sheet(1, 2 if far else 1, height=5.2, shared=False)
    for ax in drawn.axes[0]:
        _tracks(run, ax, truth, believed)
    first = drawn.axes[0, 0]
    first.set_aspect("equal", adjustable="box" if far else "datalim")
    if far:
        centre, half = (low + high) / 2, 0.62 * extent
        first.set_xlim(centre[1] - half, centre[1] + half)
        first.set_ylim(centre[0] - half, centre[0] + half)
        first.set_title("around the true track", y=1.0, fontsize=10)
        drawn.axes[0, 1].set_title("as far as the estimates go", y=1.0, fontsize=10)
        drawn.axes[0, 1].set_aspect("equal", adjustable="datalim")
    first.set_ylabel(f"north of the start [{_distances(first)}]")
    for ax in drawn.axes[0]:
        ax.set_xlabel(f"east of the start [{_distances(ax)}]")
    keys = keys_of(drawn.axes.flat)
    if run.windows:
        keys["no GNSS fix"] = patch(SHADE)
    drawn.legend(keys, 0.3 if far else 0.1)
    return drawn.figure


def _tracks(run: Run, ax: Axes, truth: Array, believed: dict[str, Array]) -> None:
    denied = accuracy.inside(run.t, run.windows)
    ax.plot(truth[:, 1], truth[:, 0], color=TRUTH, lw=1.0, label=run.reference, zorder=4)
    for name in run.receivers if run.recorded else ():
        fixes = run.track(*(column(run.dataset, f"sensors/{name}/{axis}") for axis in ("lat", "lon")))
        ax.plot(fixes[:, 1], fixes[:, 0], ".", color=GUIDE, ms=2, label=f"{name}, as used", zorder=1)
    if denied.any():
        gap = np.where(denied[:, None], _bridged(run.t, truth), np.nan)
        wide = 12 if believed else 7
        ax.plot(gap[:, 1], gap[:, 0], color=SHADE, lw=wide, solid_capstyle="round", zorder=0)
    for rank, (name, points) in enumerate(believed.items()):
        ax.plot(points[:, 1], points[:, 0], **run.lines[name], **layer(rank, len(believed)), label=name)
    known = truth[np.isfinite(truth).all(axis=1)]
    ax.plot(known[0, 1], known[0, 0], "o", color=TRUTH, ms=7, label="start", zorder=5)
    ax.plot(known[-1, 1], known[-1, 0], "s", color=TRUTH, ms=7, label="end", zorder=5)


def _bridged(t: Array, truth: Array) -> Array:
    """The same, straight on between places where the reference is silent, as that of a log is without fixes."""
    known = np.isfinite(truth).all(axis=1)
    axes = (np.interp(t, t[known], axis[known], left=np.nan, right=np.nan) for axis in truth.T)
    return np.column_stack([*axes])


def _distances(ax: Axes) -> str:
    """Let both axes, which are in kilometres, be read in metres where they are short; the unit."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    short = max(np.ptp(ax.get_xlim()), np.ptp(ax.get_ylim())) < SHORT_KM
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(TICKS))
        if short:
            axis.set_major_formatter(FuncFormatter(lambda x, _: f"{1000 * x:.6g}"))
    return "m" if short else "km"


def flight(run: Run) -> Figure:
    """Height and speed of the flight."""
    drawn = sheet(2, height=2.5, gap=0.2)
    top, bottom = drawn.axes[:, 0]
    truth = run.truth("h")
    top.plot(*thin(run.t, truth), color=TRUTH, lw=1.0, label=run.reference, zorder=4)
    for rank, name in enumerate(run.positioned):
        line = thin(run.estimate(name, "time"), run.estimate(name, "h"))
        top.plot(*line, **run.lines[name], **layer(rank, len(run.positioned)), label=name)
    if np.isfinite(truth).any():
        margin = max(0.15 * float(np.nanmax(truth) - np.nanmin(truth)), 20.0)
        top.set_ylim(np.nanmin(truth) - margin, np.nanmax(truth) + margin)
    top.set_ylabel("height above\nellipsoid [m]")
    bottom.plot(*thin(run.t, run.truth("airspeed")), color=TRUTH, lw=1.2, label="true airspeed")
    ground = np.hypot(run.truth("v_n")[:, 0], run.truth("v_n")[:, 1])
    whose = "speed over ground of the reference" if run.recorded else "true speed over ground"
    bottom.plot(*thin(run.t, ground), color=GUIDE, lw=1, ls="--", label=whose)
    low, high = bottom.get_ylim()
    if high - low < LEAST_SPEEDS:
        bottom.set_ylim((low + high - LEAST_SPEEDS) / 2, (low + high + LEAST_SPEEDS) / 2)
    bottom.set_ylabel("speed [m/s]")
    run.against_time(drawn)
    return drawn.figure


def wind(run: Run) -> Figure | None:
    """Estimated wind over the true one."""
    names = [name for name in run.aligned if run.has(f"estimators/{name}/wind")]
    if not names:
        return None
    drawn = sheet(2, height=2.2)
    for k, (ax, label) in enumerate(zip(drawn.axes[:, 0], ("from south [m/s]", "from west [m/s]"), strict=True)):
        true = run.truth("wind_n")[:, k]
        ax.plot(*thin(run.t, true), color=TRUTH, lw=0.5, label="truth, turbulence included", zorder=1)
        everything = [true]
        for name in names:
            t, value, sigma = (run.estimate(name, q) for q in ("time", "wind", "sigma_wind"))
            some = stride(len(t))
            low, high = value[some, k] - 3 * sigma[some, k], value[some, k] + 3 * sigma[some, k]
            ax.fill_between(t[some], low, high, color=run.colours[name], alpha=FAINT / len(names) ** 0.5, lw=0)
            ax.plot(t[some], value[some, k], **run.lines[name], lw=1.4, label=name, zorder=3)
            everything.append(value[:, k])
        _centre(ax, np.concatenate(everything))
        ax.set_ylabel(label)
    run.against_time(drawn)
    return drawn.figure


def _centre(ax: Any, values: Array) -> None:
    shown = values[np.abs(values) < MOST_WIND]  # an estimator of the user's may say anything
    if len(shown):
        middle, spread = float(np.median(shown)), max(float(np.abs(shown).max()), 2.0)
        ax.set_ylim(middle - spread, middle + spread)


PLOTS = (
    Plot(
        "ground_track",
        "Ground track. Thin black line: truth, drawn over all else; coloured lines: where each estimator thought it"
        " was, wider below narrower so that none hides another. Wide grey line: no GNSS fix, straight on where truth is"
        " not known either.",
        ground_track,
        timed=False,
    ),
    Plot("flight", "Height and speed. Black: truth; coloured lines: estimates.", flight),
    Plot(
        "wind", "Wind over ground. Black: truth with its turbulence; coloured lines: estimates; bands: ±3 sigma.", wind
    ),
)
