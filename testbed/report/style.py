"""How all figures look: colours, shades, axes on time, and one legend that takes the room it needs.

An estimator has one colour and dash wherever it appears; truth is black, and drawn last and thinnest, so that nothing
hides it. What belongs to no estimator is grey or slate. Windows without GNSS fix and faults of sensors are shaded alike
in all figures over time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from nav.samples import Array, Outcome

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette, safe for colour-blind eyes, from the darkest on; then what is apart from it in Paul Tol's
# "muted" and "bright" schemes.
COLOURS = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00",
    "#882255", "#999933", "#332288", "#44AA99", "#AA4499", "#BBBBBB",
)  # fmt: skip
# The same hues for a dark ground, in the same order.
ON_DARK = (
    "#4BA3E3", "#F0803C", "#2FC79A", "#E6A3C8", "#A5DBFF", "#F5BE41",
    "#E0609A", "#CFCF5A", "#9F8CF0", "#70D6C6", "#D486D4", "#DDDDDD",
)  # fmt: skip
DASHES = ("-", "--", ":", "-.")  # a colour that comes again is dashed
TRUTH = "#000000"
BOUND: dict[str, Any] = {"color": "#000000", "lw": 1.1, "ls": (0, (4, 1.5)), "zorder": 4}  # what nobody can be below
NEUTRAL = "#3A4A5A"  # what belongs to no estimator: a sensor
GUIDE = "#444444"  # gates, bounds
PROMISED = "#B06A00"  # by a data sheet
# Samples that were not used, by what became of them: apart from each other, and from the shades of an estimator.
NOT_USED = {
    Outcome.OUTSIDE_GATE: "#C00020",
    Outcome.ISOLATED: "#7A1FA2",
    Outcome.WITHHELD: "#8A949E",
    Outcome.WEAKENED: "#8C5A2B",
    Outcome.OUT_OF_RANGE: "#00838F",
    Outcome.UNSOUND: "#000000",
}
NOT_USED_ON_DARK = {
    Outcome.OUTSIDE_GATE: "#FF6B6B",
    Outcome.ISOLATED: "#C58AF0",
    Outcome.WITHHELD: "#A9B3BD",
    Outcome.WEAKENED: "#D0A070",
    Outcome.OUT_OF_RANGE: "#4DD0E1",
    Outcome.UNSOUND: "#FFFFFF",
}
SHADE = "#DDDDDD"
FAULT = "#FBE9A8"
CONSISTENT = "#DCE8DC"
AXIS_COLOURS = ("#0072B2", "#E69F00", "#009E73")  # of figures that show no estimators beside each other
FAINT = 0.22  # of its colour: what an estimator claims
BINS = 900  # a line is drawn through the lowest and highest point of each
FAR = 4.0  # times: what is so much larger than the rest gets a view of its own

WIDTH, LEFT, RIGHT, BOTTOM = 10.5, 1.0, 0.26, 0.55  # [in]
CHARACTER, LINE, KEY = 0.074, 0.21, 0.5  # width and height of 9-point letters, width of a legend's key [in]


def line_of(index: int) -> dict[str, Any]:
    """Colour and dash of the estimator at this place in the scenario."""
    return {"color": COLOURS[index % len(COLOURS)], "ls": DASHES[index // len(COLOURS) % len(DASHES)]}


def layer(rank: int, count: int, thinnest: float = 2.0) -> dict[str, Any]:
    """Width and order of the line at ``rank`` of ``count`` that may lie on each other: the last is the widest, below.

    So each shows beside those above it, and truth, at order 4 and one point wide, above them all.
    """
    return {"lw": thinnest * (1 + min(0.45, 3 / max(count, 1)) * rank), "zorder": 3 - 0.05 * rank}


def tints(colour: str) -> list[str]:
    """A colour in three shades, for the three axes: dark, itself, light."""
    from matplotlib.colors import to_hex, to_rgb

    rgb = np.array(to_rgb(colour))
    dark, light = 0.45 * rgb, 1 - 0.5 * (1 - rgb)
    return [to_hex((dark[0], dark[1], dark[2])), colour, to_hex((light[0], light[1], light[2]))]


def thin(t: Array, y: Array, bins: int = BINS) -> tuple[Array, Array]:
    """A line with at most two points per bin, its lowest and its highest: no peak is lost. NaN stay gaps."""
    size = len(t) // bins
    if size < 3:
        return t, y
    count = len(t) // size
    values = y[: count * size].reshape(count, size)
    low = np.where(np.isnan(values), np.inf, values).argmin(axis=1)
    high = np.where(np.isnan(values), -np.inf, values).argmax(axis=1)
    first, second = np.minimum(low, high), np.maximum(low, high)
    kept = (np.arange(count)[:, None] * size + np.column_stack([first, second])).ravel()
    kept = np.append(kept, np.arange(count * size, len(t)))
    return t[kept], y[kept]


def stride(n: int) -> slice:
    """Every so many of ``n`` rows that a line keeps its shape."""
    return slice(None, None, max(1, n // (2 * BINS)))


@dataclass(frozen=True, slots=True)
class Sheet:
    """A figure and its panels (rows, columns), every row ``height`` high, ``gap`` apart, with room above [in]."""

    figure: Figure
    axes: Any
    height: float
    gap: float
    margins: tuple[float, float]

    def legend(self, keys: Mapping[str, Any], title: float = 0.0) -> None:
        """One legend above all panels, of as many lines as it takes, and ``title`` [in] for panels' titles below it."""
        left, right = self.margins
        room = WIDTH - left - right
        longest = KEY + CHARACTER * max(map(len, keys), default=1)
        columns = max(1, min(len(keys), int(room / longest)))
        head = LINE * math.ceil(len(keys) / columns) + title + 0.12
        rows = len(self.axes)
        tall = BOTTOM + head + (self.height + self.gap) * rows - self.gap
        self.figure.set_size_inches(WIDTH, tall)
        self.figure.subplots_adjust(
            left / WIDTH, BOTTOM / tall, 1 - right / WIDTH, 1 - head / tall, hspace=self.gap / self.height
        )
        if keys:
            self.figure.legend(
                list(keys.values()), list(keys), loc="upper right", ncols=columns, frameon=False, fontsize=9,
                borderaxespad=0.2, borderpad=0.2, labelspacing=0.35, handlelength=1.8, columnspacing=1.2,
            )  # fmt: skip


def sheet(
    rows: int,
    columns: int = 1,
    height: float = 2.1,
    gap: float = 0.16,
    *,
    margins: tuple[float, float] = (LEFT, RIGHT),
    shared: bool = True,
) -> Sheet:
    """Empty panels, the rows on one horizontal axis if it is ``shared``. Margins are in inches: they are drawn once."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, height * rows), dpi=100)
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=shared and rows > 1)
    figure.subplots_adjust(wspace=0.2)
    for ax in axes.flat:
        dress(ax)
    return Sheet(figure, axes, height, gap, margins)


def dress(ax: Axes) -> None:
    """Grid and frame, and the height of titles: where it is given, nothing is measured for it."""
    ax.set_title("", y=1.0)
    ax.grid(alpha=0.35, lw=0.6)
    ax.spines[["top", "right"]].set_visible(False)


def shade(ax: Axes, windows: Iterable[tuple[float, float]], colour: str, end: float) -> None:
    """Shade windows [start, end) [s] up to the ``end`` of the run; where both kinds are, both show."""
    for start, stop in windows:
        if start < end:
            alpha = 1.0 if colour == SHADE else 0.65
            ax.axvspan(start, min(stop, end), color=colour, alpha=alpha, lw=0, zorder=0 if colour == SHADE else 0.1)


def keys_of(axes: Iterable[Axes]) -> dict[str, Any]:
    """What is labelled in some panels, each label once, in the order in which it appears.

    A line whose points are all unknown is none; one without points is there for its key.
    """
    from matplotlib.lines import Line2D

    found: dict[str, Any] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            y = np.asarray(handle.get_ydata() if isinstance(handle, Line2D) else (), float)
            if not len(y) or np.isfinite(y).any():
                found.setdefault(label, handle)
    return found


def patch(colour: str) -> Any:
    """A legend's key for a shade."""
    from matplotlib.patches import Patch

    return Patch(color=colour)


def logarithmic(ax: Axes, least: float = math.inf, most: float = 0.0, along: str = "y") -> None:
    """A logarithmic axis from ``least`` to ``most`` at the least, with plain numbers, three of them or more.

    Call it when everything is drawn: where powers of ten are too few, there are numbers between them.
    """
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    ax.set(**{f"{along}scale": "log"})
    axis = ax.yaxis if along == "y" else ax.xaxis
    low, high = axis.get_view_interval()
    low, high = min(low, least), max(high, most)
    ax.set(**{f"{along}lim": (low, high)})
    axis.set_major_locator(FixedLocator(_ticks(low, high)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x / 1000:g}k" if x >= 10_000 else f"{x:.12g}"))


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers in [low, high], from three to about seven: powers of ten, 1-2-5 steps, or even steps."""
    from matplotlib.ticker import MaxNLocator

    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    every = max(1, len(decades) // 7 + 1)
    for factors in ((1,), (1, 3), (1, 2, 5)):
        step = every if factors == (1,) else 1
        found = [f * 10.0**k for k in decades if k % step == 0 for f in factors]
        found = [float(f"{x:.3g}") for x in found if low <= x <= high]
        if len(found) >= 3:
            return found
    return [float(f"{x:.12g}") for x in MaxNLocator(5).tick_values(low, high) if low <= x <= high and x > 0]


def focus_log(ax: Axes, values: Sequence[Array], least: float = math.inf, most: float = 0.0) -> None:
    """A logarithmic axis from a twentieth of the best median to the largest value."""
    values = [v[np.isfinite(v) & (v > 0)] for v in values]
    values = [v for v in values if len(v)]
    ax.set_yscale("log")
    if values:
        ax.set_ylim(min(float(np.median(v)) for v in values) / 20, 2 * max(float(v.max()) for v in values))
    logarithmic(ax, least, most)
