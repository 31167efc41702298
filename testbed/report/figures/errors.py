"""Errors: all estimators beside each other, and each against what it claims."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from nav.samples import Array
from testbed.report.figures.plot import Plot
from testbed.report.run import Run
from testbed.report.style import BOUND, FAINT, FAR, TRUTH, focus_log, layer, sheet, stride, thin
from testbed.score import accuracy
from testbed.score.accuracy import Errors
from testbed.score.bound import Bound

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOG_LINE = 0.9  # the thinnest line of a logarithmic figure [points]
LEAST = "Dashed: the least that anybody could claim, where there is an outage."
SMOOTH_S = 2.0  # the single zero crossings of an error say nothing on a logarithmic axis


def moving_rms(t: Array, y: Array, seconds: float) -> Array:
    """Root of the mean square (N,) of ``y`` (N,) over the last ``seconds``; NaN stay NaN."""
    if len(t) < 3:
        return np.abs(y)
    n = max(1, round(seconds / float(np.median(np.diff(t)))))
    finite = np.isfinite(y)
    total, count = np.cumsum(np.where(finite, y, 0.0) ** 2), np.cumsum(finite)
    total[n:], count[n:] = total[n:] - total[:-n], count[n:] - count[:-n]
    result: Array = np.where(finite, np.sqrt(np.maximum(total, 0.0) / np.maximum(count, 1)), np.nan)
    return result


def comparison(run: Run) -> Figure | None:
    """Size of the errors of all estimators, logarithmic so that a good one stays readable beside a bad one."""
    if not run.aligned:
        return None
    of_position: tuple[tuple[str, Callable[[Errors | Bound], Array]], ...] = (
        ("horizontal\nposition [m]", lambda e: e.horizontal),
        ("height [m]", lambda e: np.abs(e.position[:, 2])),
    )
    of_attitude: tuple[tuple[str, Callable[[Errors | Bound], Array]], ...] = (
        ("roll and\npitch [deg]", lambda e: np.rad2deg(e.tilt)),
        ("heading [deg]", lambda e: np.rad2deg(np.abs(e.attitude[:, 2]))),
    )
    bounds = {id(bound): bound for bound in run.bounds.values()}.values()  # of estimators with the same sensors, once
    panels = [(run.positioned, *panel) for panel in of_position if run.positioned]
    panels += [(run.aligned, *panel) for panel in of_attitude]
    drawn = sheet(len(panels), height=1.9)
    for ax, (shown, label, size) in zip(drawn.axes[:, 0], panels, strict=True):
        for rank, (name, e) in enumerate(shown.items()):
            line = thin(e.t, np.maximum(moving_rms(e.t, size(e), SMOOTH_S), 1e-6))
            ax.plot(*line, **run.lines[name], **layer(rank, len(shown), LOG_LINE), label=name)
        for bound in bounds:
            ax.plot(*thin(bound.t, size(bound)), **BOUND, label="bound")
        ax.set_ylabel(label)
        focus_log(ax, [size(e)[e.valid] for e in shown.values()])
    run.against_time(drawn)
    return drawn.figure


def attitude(run: Run) -> Figure | None:
    """Roll, pitch and heading, true and estimated."""
    if not run.aligned:
        return None
    drawn = sheet(3)
    curves: list[tuple[str, Array, Array, dict[str, Any]]] = [
        (name, run.estimate(name, "time"), euler_deg(run.estimate(name, "q_nb")),
         run.lines[name] | layer(rank, len(run.aligned)))
        for rank, name in enumerate(run.aligned)
    ]  # fmt: skip
    curves.insert(0, (run.reference, run.t, euler_deg(run.truth("q_nb")), {"color": TRUTH, "lw": 1.0, "zorder": 4}))
    for k, (ax, label) in enumerate(zip(drawn.axes[:, 0], ("roll [deg]", "pitch [deg]", "heading [deg]"), strict=True)):
        for name, t, euler, line in curves:
            some = stride(len(t))
            y = euler[some, k].copy()
            y[1:][np.abs(np.diff(y)) > 180] = np.nan  # a turn through north or south is no line across the axes
            ax.plot(t[some], y, **line, label=name)
        ax.set_ylabel(label)
    drawn.axes[2, 0].set_yticks(range(0, 361, 90))
    drawn.axes[2, 0].set_ylim(-5, 365)
    run.against_time(drawn)
    return drawn.figure


def euler_deg(q: Array) -> Array:
    """Roll, pitch, heading (N, 3) of q_nb (N, 4); heading in [0, 360)."""
    angles = np.rad2deg(accuracy.euler(q))
    angles[:, 2] %= 360.0
    return angles


class _Sigmas(NamedTuple):
    """What is claimed (N, 3) of an error, and the least that could be (K, 3), at the times of the bound, if any."""

    claimed: Array
    least: Array | None


def _error_panels(run: Run, axes: Any, name: str, error: Array, sigmas: _Sigmas, labels: Sequence[str]) -> None:
    """Three errors against what the estimator claims, and against the bound."""
    t, (sigma, least) = run.errors[name].t, sigmas
    some = stride(len(t))
    for k, ax in enumerate(axes):
        low, high = -3 * sigma[some, k], 3 * sigma[some, k]
        if np.isfinite(sigma[:, k]).any():  # who says nothing of it claims nothing
            ax.fill_between(t[some], low, high, color=run.colours[name], alpha=FAINT, lw=0, label="±3 sigma, claimed")
        ax.plot(*thin(t, error[:, k]), color=run.colours[name], lw=0.9, label="error")
        if least is not None:
            for sign in (-3, 3):
                ax.plot(*thin(run.bounds[name].t, sign * least[:, k]), **BOUND, label="±3 sigma, bound")
        ax.set_ylabel(labels[k])


def _limits(error: Array, sigma: Array, mask: accuracy.Mask) -> list[float]:
    """How far the panels have to reach to hold errors and bounds of the rows in ``mask``; 0 where there is nothing."""
    limits = []
    for k in range(error.shape[1]):
        values = np.concatenate([np.abs(error[mask, k]), np.minimum(3 * sigma[mask, k], 1e12)])
        limits.append(1.15 * float(values[np.isfinite(values)].max(initial=0.0)))
    return limits


def _reach(axes: Any, limits: Sequence[float]) -> None:
    for ax, limit in zip(axes, limits, strict=True):
        if limit > 0:
            ax.set_ylim(-limit, limit)


def _shown_rows(e: Errors) -> accuracy.Mask:
    """Rows that decide the limits: those that count, of a short run those that there are."""
    return e.valid if e.valid.any() else np.asarray(np.isfinite(e.attitude).all(axis=1))


def position_errors(run: Run, name: str) -> Figure | None:
    """Position error north, east, down with ±3 sigma; a second column looks closer when an outage dwarfs the rest."""
    e = run.errors[name]
    if e.attitude_only:
        return None
    near_outage = accuracy.inside(e.t, [(start, end + accuracy.RECOVERY_WINDOW_S) for start, end in run.windows])
    masks = [_shown_rows(e), e.valid & ~near_outage]
    reach = [_limits(e.position, e.sigma_position, mask) for mask in masks]
    closer = [masks[1].any() and far > FAR * near for far, near in zip(*reach, strict=True)]
    drawn = sheet(3, 2 if any(closer) else 1)
    for k, (mask, limits) in enumerate(zip(masks[: 2 if any(closer) else 1], reach, strict=False)):
        scale, unit = (1e-3, "km") if np.abs(e.position[mask]).max(initial=0.0) > 5000 else (1.0, "m")
        labels = [f"{axis} [{unit}]" for axis in accuracy.AXES]
        least = scale * run.bounds[name].position if name in run.bounds else None
        sigmas = _Sigmas(scale * e.sigma_position, least)
        _error_panels(run, drawn.axes[:, k], name, scale * e.position, sigmas, labels)
        _reach(drawn.axes[:, k], [scale * limit for limit in limits])
    if any(closer):
        drawn.axes[0, 0].set_title("whole run", y=1.0, fontsize=10, loc="left")
        drawn.axes[closer.index(True), 1].set_title("the same, closer", y=1.0, fontsize=10, loc="left")
    run.against_time(drawn, 0.25 if any(closer) else 0.0)
    for row, differs in zip(drawn.axes, closer, strict=True):
        row[-1].set_visible(differs or row[-1] is row[0])  # no panel twice
    if any(closer):
        lowest = drawn.axes[2 - closer[::-1].index(True), 1]
        lowest.tick_params(labelbottom=True)
        lowest.set_xlabel("time [s]")
    return drawn.figure


def motion_errors(run: Run, name: str) -> Figure:
    """Velocity and attitude error with ±3 sigma."""
    e = run.errors[name]
    labels = ("about north [deg]", "about east [deg]", "about down [deg]")
    bound = run.bounds.get(name)
    sigmas = _Sigmas(np.rad2deg(e.sigma_attitude), np.rad2deg(bound.attitude) if bound else None)
    columns = [("attitude", np.rad2deg(e.attitude), sigmas, labels)]
    if not e.attitude_only:
        sigmas = _Sigmas(e.sigma_velocity, bound.velocity if bound else None)
        columns.insert(0, ("velocity", e.velocity, sigmas, ("north [m/s]", "east [m/s]", "down [m/s]")))
    drawn = sheet(3, len(columns))
    for k, (title, error, both, names) in enumerate(columns):
        _error_panels(run, drawn.axes[:, k], name, error, both, names)
        _reach(drawn.axes[:, k], _limits(error, both.claimed, _shown_rows(e)))
        drawn.axes[0, k].set_title(title, y=1.0, fontsize=10, loc="left")
    run.against_time(drawn, 0.25)
    return drawn.figure


OF_ALL = (
    Plot(
        "comparison",
        "Size of the errors, logarithmic: root mean square over the last 2 s. Each line is an estimator, wider below"
        " narrower. Dashed black: the bound, a root mean square over draws that no estimator of these sensors can be"
        " below; one run may be, and what looks back.",
        comparison,
    ),
    Plot(
        "attitude",
        "Attitude. Thin black line: truth, drawn over all else; coloured lines: estimates, wider below narrower.",
        attitude,
    ),
)
OF_EACH = (
    Plot(
        "{}_position_errors",
        f"Position error. Line: error; band: ±3 sigma as claimed. {LEAST}",
        position_errors,
    ),
    Plot(
        "{}_motion_errors",
        f"Velocity and attitude errors. Line: error; band: ±3 sigma as claimed. {LEAST}",
        lambda run, name: None if run.errors[name].attitude_only else motion_errors(run, name),
    ),
    Plot(
        "{}_attitude_errors",
        "Attitude error. Line: error; band: ±3 sigma as claimed.",
        lambda run, name: motion_errors(run, name) if run.errors[name].attitude_only else None,
    ),
)
