"""What Zhu et al. 2020 show of the river and of the outage, for one draw."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from testbed.papers.zhu2020.claims import LOST, P_E, P_N, SPREAD, V_E, V_N, largest
from testbed.papers.zhu2020.flight import (
    AST,
    DVL,
    EQ13_DEGREES,
    FRKF,
    FRKF_ALONE,
    OUTAGE,
    OUTLIERS,
    TFKF_ALONE,
    Draw,
    Flown,
)
from testbed.report.style import COLOURS, GUIDE, SHADE
from testbed.results import write_result

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROWS = (
    (P_N, "latitude\nerror [m]", 60.0),
    (P_E, "longitude\nerror [m]", 60.0),
    (V_N, "v$_N$ error\n[m/s]", 0.25),
    (V_E, "v$_E$ error\n[m/s]", 0.25),
)
STD = {column: robust for column, _, robust in SPREAD.values()}  # of the robust filter, Table 3
ALONE = (
    (AST, "transponder, alone", COLOURS[1]),
    (DVL, "log, alone", COLOURS[2]),
    (FRKF_ALONE, "federated, no feedback", COLOURS[0]),
    (FRKF, "federated, feedback", COLOURS[3]),
    (EQ13_DEGREES, "equation 13, deg and µg", COLOURS[4]),
)
PAPER_LARGEST = {AST: (25.13, 225.30), DVL: (81.53, 62.27), FRKF_ALONE: (17.57, 18.68)}  # latitude, longitude [m]


def draw(one: Draw, out: Path) -> None:
    """Errors without feedback with wrong fixes (log every 30 s), and what the outage does."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 8.6), dpi=85, layout="constrained")
    FigureCanvasAgg(figure)
    of = figure.subplot_mosaic([["0", "north"], ["1", "east"], ["2", "bars"], ["3", "bars"]])
    _draw_river([of[str(row)] for row in range(len(ROWS))], one.river)
    _draw_outage([of["north"], of["east"]], one.outage)
    _draw_bars(of["bars"], one.outage)
    for ax in of.values():
        ax.grid(alpha=0.35, lw=0.6)
        ax.spines[["top", "right"]].set_visible(False)
    figure.supxlabel(CAPTION, fontsize=9)
    image = io.BytesIO()
    figure.savefig(image, format="png")
    write_result(out / "zhu2020.png", image.getvalue())


CAPTION = """\
Not reproduced: the ship's own data, which are not public; motion, noise and start errors are made up here. The log is
better than the paper's must have been, whose filter without fixes drifts by 82 m and whose velocity is ten times as
uncertain. The outage is flown to its end."""


def _draw_river(panels: Sequence[Axes], river: Mapping[str, Flown]) -> None:
    """Errors of both filters, and when the fixes are wrong."""
    for ax, (column, label, limit) in zip(panels, ROWS, strict=True):
        for name, text, colour in ((TFKF_ALONE, "traditional", COLOURS[1]), (FRKF_ALONE, "robust", COLOURS[0])):
            ax.plot(river[name].t, river[name].error[:, column], color=colour, lw=0.9, label=text)
        for sign in (-1, 1):
            label_of = "the paper's 1 sigma, robust" if sign > 0 else None
            ax.axhline(sign * STD[column], color=GUIDE, lw=0.9, ls="--", label=label_of)
        top = ax.get_xaxis_transform()
        flags = np.full(len(OUTLIERS), 0.97)
        ax.plot(OUTLIERS, flags, "v", color="black", ms=3.5, transform=top, label="fix 500 m wrong")
        ax.set_ylabel(label)
        ax.set_ylim(-limit, limit)
        ax.set_xlim(0, 3600)
    panels[-1].set_xlabel("time [s]")
    panels[0].set_title("Fixes 500 m wrong every 150 s, log every 30 s, no feedback", fontsize=10)
    panels[0].legend(loc="lower left", ncols=2, fontsize=7.5, frameon=False)


def _draw_outage(panels: Sequence[Axes], outage: Mapping[str, Flown]) -> None:
    """Errors of each filter alone and of both."""
    for ax, (what, (column, paper)) in zip(panels, LOST.items(), strict=True):
        for name, text, colour in ALONE:
            if name in outage:
                ax.plot(outage[name].t, outage[name].error[:, column], color=colour, lw=1.1, label=text)
        for sign in (-1, 1):
            ax.axhline(sign * paper, color=GUIDE, lw=0.9, ls="--", label="the paper's largest" if sign > 0 else None)
        ax.set_ylabel(f"{what}\nerror [m]")
        ax.set_ylim(-100, 60)
        ax.set_xlim(0, 2500)
        ax.axvspan(*OUTAGE, color=SHADE, lw=0, zorder=0)
    panels[0].set_title("No fix from 1500 s on, log at 1 Hz", fontsize=10)
    panels[1].legend(loc="lower left", fontsize=7.5, frameon=False, ncols=2)
    panels[1].set_xlabel("time [s]")


def _draw_bars(ax: Axes, outage: Mapping[str, Flown]) -> None:
    """Largest errors of the outage, latitude and longitude, beside those of the paper."""
    shown = [(name, text, colour) for name, text, colour in ALONE if name in outage]
    for k, (name, _, colour) in enumerate(shown):
        for i, column in enumerate((P_N, P_E)):
            x, value = k + 0.36 * i - 0.18, largest(outage[name], (column,), *OUTAGE)
            ax.bar(x, value, 0.32, color=colour)
            ax.annotate("lat" if i == 0 else "lon", (x, 1.1), ha="center", fontsize=7, color="white")
            if name in PAPER_LARGEST:
                label = "the paper's" if k + i == 0 else None
                ax.plot(x, PAPER_LARGEST[name][i], "D", color="black", ms=4, label=label)
    ax.set_yscale("log")
    ax.set_ylim(1, 1000)
    ax.set_xticks(range(len(shown)), [text.replace(", ", ",\n") for _, text, _ in shown], fontsize=8)
    ax.set_ylabel("largest error in the outage [m]")
    ax.legend(loc="upper right", fontsize=8, frameon=False)
