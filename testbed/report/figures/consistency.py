"""Whether claims hold: NEES, innovations against their gates, and error ellipses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import chdtr  # as scipy.stats, which takes half a second to import

from nav.detection import chi_square_threshold
from nav.samples import Array, Outcome
from testbed.report.figures.errors import LOG_LINE, SMOOTH_S, moving_rms
from testbed.report.figures.plot import Plot
from testbed.report.run import Run
from testbed.report.style import (
    CONSISTENT,
    FAR,
    GUIDE,
    LEFT,
    NOT_USED,
    focus_log,
    keys_of,
    layer,
    patch,
    sheet,
    thin,
    tints,
)
from testbed.score import accuracy, detection

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIGMAS = 3.0  # of the ellipses
MOMENTS = 6  # at which they are shown
ABREAST = 3  # of them beside each other
CORNERS = 73  # of an ellipse
MOST_DOTS = 4000  # of one aid
OUTCOMES = {
    Outcome.OUTSIDE_GATE: "outside the gate",
    Outcome.ISOLATED: "sensor isolated",
    Outcome.WITHHELD: "withheld: probation, attitude lost, or refused with another part",
    Outcome.WEAKENED: "weight zero",
    Outcome.OUT_OF_RANGE: "out of range",
    Outcome.UNSOUND: "unsound",
}


def consistency(run: Run) -> Figure | None:
    """NEES per degree of freedom of every estimator with the 95 % bounds of a single run."""
    if not run.aligned:
        return None
    quantities = ("position", "velocity", "attitude") if run.positioned else ("attitude",)
    drawn = sheet(len(quantities), height=2.0, margins=(LEFT, 1.0))
    low, high = (chi_square_threshold(1 - p, 3) / 3 for p in (0.025, 0.975))
    for ax, what in zip(drawn.axes[:, 0], quantities, strict=True):
        shown = run.aligned if what == "attitude" else run.positioned
        values = {name: np.where(e.valid, getattr(e, f"{what}_nees"), np.nan) for name, e in shown.items()}
        ax.axhspan(low, high, color=CONSISTENT, lw=0, label="95 % of a consistent filter", zorder=0.2)
        ax.axhline(1.0, color=GUIDE, lw=0.8)
        for rank, (name, nees) in enumerate(values.items()):
            t = run.errors[name].t
            smooth = moving_rms(t, np.sqrt(nees), SMOOTH_S) ** 2
            ax.plot(*thin(t, smooth), **run.lines[name], **layer(rank, len(values), LOG_LINE), label=name)
        _shares_inside(run, ax, values, (low, high), drawn.height)
        focus_log(ax, list(values.values()), 0.05, 10.0)
        ax.set_ylim(bottom=max(ax.get_ylim()[0], 1e-3))
        ax.set_ylabel(f"{what}\nNEES / 3")
    run.against_time(drawn, 0.1)
    return drawn.figure


def _shares_inside(run: Run, ax: Axes, values: dict[str, Array], bounds: tuple[float, float], height: float) -> None:
    """Write beside the panel which share of the time each estimator keeps the bounds."""
    step = min(0.15, height / (len(values) + 1)) / height
    box: dict[str, Any] = {"transform": ax.transAxes, "fontsize": 60 * step * height, "va": "top", "clip_on": False}
    ax.text(1.01, 1.0, "inside", color=GUIDE, **box)
    for k, (name, nees) in enumerate(values.items()):
        finite = nees[np.isfinite(nees)]
        if len(finite):
            share = np.mean((finite > bounds[0]) & (finite < bounds[1]))
            ax.text(1.01, 1.0 - (k + 1) * step, f"{share:.0%}", color=run.colours[name], **box)


def ellipses(run: Run) -> Figure | None:
    """Horizontal error of every estimator at some moments, each with the ellipse that it claims."""
    claimed = {name: (run.estimate(name, "time"), run.estimate(name, "covariance")) for name in run.positioned}
    moments = [(title, shown) for t, title in _moments(run) if (shown := _known_at(run, t, claimed))]
    if not moments:
        return None
    drawn = sheet(-(-len(moments) // ABREAST), ABREAST, height=2.75, gap=0.75, shared=False)
    drawn.figure.subplots_adjust(wspace=0.28)
    for ax, (title, shown) in zip(drawn.axes.flat, moments, strict=False):
        _ellipses_at(run, ax, shown)
        ax.set_title(title, y=1.0, fontsize=9, loc="left")
        ax.set_xlabel("east [m]", fontsize=9)
    for ax in drawn.axes[:, 0]:
        ax.set_ylabel("north [m]")
    for ax in drawn.axes.flat[len(moments) :]:
        ax.set_visible(False)
    drawn.legend(keys_of(drawn.axes.flat[: len(moments)]), 0.3)
    return drawn.figure


def _moments(run: Run) -> list[tuple[float, str]]:
    """Times at which errors count, and what they are called: around and in the longest outage if there is one."""
    counted = [e.t[e.valid] for e in run.positioned.values() if e.valid.any()]
    if not counted:
        return []
    first, last = min(float(t[0]) for t in counted), max(float(t[-1]) for t in counted)
    cut = [(max(start, first), min(end, last)) for start, end in run.windows]
    cut = [(start, end) for start, end in cut if end - start > accuracy.RECOVERY_WINDOW_S]
    if not cut:
        return [(t, f"{t:.0f} s") for t in np.linspace(first, last, MOMENTS).tolist()] if last > first else []
    start, end = max(cut, key=lambda window: window[1] - window[0])
    step = (end - start) / 4
    moments = [(start + k * step, f"{start + k * step:.0f} s, {k * step:.0f} s without fix") for k in (1, 2, 3)]
    moments.append((end - 0.5, f"{end:.0f} s, the end of the outage"))
    if first < start - 1:
        moments.insert(0, (start - 1, f"{start - 1:.0f} s, before the outage"))
    after = end + accuracy.RECOVERY_WINDOW_S
    if after < last:
        moments.append((after, f"{after:.0f} s, {accuracy.RECOVERY_WINDOW_S:.0f} s after it"))
    return moments


def _known_at(run: Run, t: float, claimed: Mapping[str, tuple[Array, Array]]) -> dict[str, tuple[Array, Array]]:
    """Ellipse (N, 2) and error (2,) [m] at a time of all estimators that have both; none where nobody knew the truth.

    ``claimed``: times (N,) and covariances (N, 9, 9) of each estimator.
    """
    shown: dict[str, tuple[Array, Array]] = {}
    for name, e in run.positioned.items():
        row = int(np.argmin(np.abs(e.t - t)))
        if e.valid[row]:
            times, covariance = claimed[name]
            at = int(np.argmin(np.abs(times - e.t[row])))
            shown[name] = (ellipse(covariance[at, :2, :2], SIGMAS), e.position[row, :2])
    return {name: (corners, error) for name, (corners, error) in shown.items() if np.isfinite([*corners, error]).all()}


def _ellipses_at(run: Run, ax: Axes, shown: Mapping[str, tuple[Array, Array]]) -> None:
    """Ellipses and errors at a moment; what is far larger than the smallest is cut off, and named."""
    sizes = {name: float(np.abs([*corners, error]).max()) for name, (corners, error) in shown.items()}
    limit = 1.25 * max(size for size in sizes.values() if size <= FAR * FAR * min(sizes.values()))
    for rank, name in enumerate(sizes):
        corners, error = shown[name]
        on_top = layer(rank, len(sizes), 1.1)
        ax.plot(corners[:, 1], corners[:, 0], **run.lines[name], **on_top, label=name)
        ax.plot(
            error[1],
            error[0],
            "x",
            color=run.colours[name],
            ms=6 + on_top["lw"],
            mew=on_top["lw"],
            zorder=on_top["zorder"],
        )
    beyond = [f"{name}: {size:,.0f} m" for name, size in sizes.items() if size > limit]
    if beyond:
        ax.text(0.02, 0.02, "beyond: " + "\n".join(beyond), transform=ax.transAxes, fontsize=7, color=GUIDE, zorder=5)
    ax.axhline(0.0, color=GUIDE, lw=0.5)
    ax.axvline(0.0, color=GUIDE, lw=0.5)
    ax.set_xlim(-limit, limit)
    ax.set_ylim(-limit, limit)
    ax.set_aspect("equal", adjustable="box")


def ellipse(covariance: Array, sigmas: float) -> Array:
    """Points (N, 2) at which x' P^-1 x = ``sigmas`` squared, of a covariance P (2, 2); NaN where it is no number."""
    if not np.isfinite(covariance).all():
        return np.full((CORNERS, 2), np.nan)
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2 * np.pi, CORNERS)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    points: Array = sigmas * circle * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    return points


def innovations(run: Run, name: str) -> Figure | None:
    """Innovations over their claimed sigma, with the gate; refused ones crossed, in the colour of their outcome."""
    aids = [
        aid for aid in accuracy.aids(run.dataset, name) if run.has(f"estimators/{name}/innovations/{aid}/innovation")
    ]
    if not aids:
        return None
    from matplotlib.lines import Line2D

    drawn = sheet(len(aids), height=1.5, gap=0.32)
    sensors = [_innovations_of(run, ax, name, aid) for ax, aid in zip(drawn.axes[:, 0], aids, strict=True)]
    drawn.axes[len(aids) // 2, 0].set_ylabel("innovation / its sigma")
    first = drawn.axes[0, 0]
    gates = [run.estimate(name, f"innovations/{aid}/threshold") for aid in aids]
    if any(np.isfinite(gate).any() for gate in gates):
        first.plot([], [], color=GUIDE, lw=0.8, ls="--", label="gate")
    seen = np.unique(np.concatenate([refused_as(run, name, aid) for aid in aids]))
    for outcome in (one for one in NOT_USED if one in seen):
        first.add_line(Line2D([], [], color=NOT_USED[outcome], marker="x", ls="", ms=5, label=OUTCOMES[outcome]))
    run.against_time(drawn, 0.28, sensors)
    return drawn.figure


def refused_as(run: Run, name: str, aid: str) -> Array:
    """What became of each sample (N,) that was not used, or not with every axis; NaN for the others."""
    own = f"innovations/{aid}"
    outcome = run.estimate(name, f"{own}/outcome")
    became = np.where(outcome == Outcome.FUSED, Outcome.WEAKENED, outcome)  # fused with weight 0
    return np.where(detection.refused(run.estimate(name, f"{own}/weight"), outcome), became, np.nan)


def _innovations_of(run: Run, ax: Axes, name: str, aid: str) -> set[str]:
    """Draw those of one aid, and say whose they are."""
    own = f"innovations/{aid}"
    t, z = run.estimate(name, f"{own}/sample_time"), run.estimate(name, f"{own}/innovation")
    became = refused_as(run, name, aid)
    refused = np.isfinite(became)
    gate = np.sqrt(run.estimate(name, f"{own}/threshold"))
    with np.errstate(invalid="ignore", divide="ignore"):
        normalised = z / np.sqrt(np.diagonal(run.estimate(name, f"{own}/S"), axis1=1, axis2=2))
    limit = 1.6 * float(np.nanmax(gate)) if np.isfinite(gate).any() else 6.0
    shown = np.clip(normalised, -0.97 * limit, 0.97 * limit)
    shown[refused] = np.nan_to_num(shown[refused], nan=-0.97 * limit)
    some = slice(None, None, max(1, len(t) // MOST_DOTS))
    fused = ~refused[some]
    axes, colours = axes_of(run, f"estimators/{name}/{own}/innovation"), tints(run.colours[name])
    for k in range(z.shape[1]):
        colour = colours[k % 3] if axes else run.colours[name]
        ax.plot(t[some][fused], shown[some, k][fused], ".", ms=1.6, color=colour)
        for outcome, cross in reversed(NOT_USED.items()):  # those that the gate refused above the others
            ax.plot(t[became == outcome], shown[became == outcome, k], "x", ms=4, color=cross, mew=0.9)
    for sign in (-1, 1):
        ax.plot(t, sign * gate, color=GUIDE, lw=0.8, ls="--")
    ax.set_ylim(-limit, limit)
    ax.set_title(f"{aid}: {np.mean(refused):.2%} refused", y=1.0, fontsize=10, loc="left")
    if axes:
        keys = [patch(colours[k % 3]) for k in range(len(axes))]
        ax.legend(
            keys, axes, loc="lower right", bbox_to_anchor=(1, 1), ncols=3, frameon=False, fontsize=9, handlelength=0.7,
            borderaxespad=0.1,
        )  # fmt: skip
    return set(run.estimate(name, f"{own}/sensor").astype(str).tolist())


def axes_of(run: Run, path: str) -> list[str]:
    """What the record calls the components of a vector; none where it has one, or no names for them."""
    variable: Any = run.dataset[path]
    along = variable.dims[1]
    return [str(name) for name in variable[along].values] if along in variable.coords else []


OF_ALL = (
    Plot(
        "nees",
        "Consistency: squared errors over claimed variances, mean of 2 s; 1 is right, above is overconfident. Each line"
        " is an estimator. Green band: where a consistent filter is for 95 % of the time; beside each panel, for how"
        " much of it each estimator is.",
        consistency,
    ),
    Plot(
        "ellipses",
        f"Horizontal error at chosen times. Cross: the error; ellipse: {SIGMAS:.0f} sigma as claimed, which holds"
        f" {float(chdtr(2, SIGMAS**2)):.1%} of the errors of a consistent filter. What is far larger than the"
        " smallest reaches beyond the axes; how far is written in the corner.",
        ellipses,
        timed=False,
    ),
)
OF_EACH = (
    Plot(
        "{}_innovations",
        "What each aid said that was not expected, over the sigma that was expected of it. Dots: used, one shade per"
        " axis; crosses: not used, one axis at least, in the colour of what became of it, at the edge if it lies"
        " beyond, at the lower one if it has no innovation; dashed lines: the gate. Faults are shaded where their"
        " sensor is shown.",
        innovations,
    ),
)
