"""Which states can be seen, and when."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from nav.observability import Visibility
from testbed.report.figures.plot import Plot
from testbed.report.run import Run
from testbed.report.style import RIGHT, sheet

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PALE = 0.3  # of its colour: a state seen with the help of earlier measurements
ABREAST = 3  # estimators beside each other


def states_of(seen: Mapping[str, Visibility]) -> list[str]:
    """The states that any of them has, each once."""
    return list(dict.fromkeys(state for own in seen.values() for state in own.names))


def visibility(run: Run) -> Figure | None:
    """Which states can be seen, and when: pale with the help of all before, full by what is measured at the time."""
    seen = run.seen
    if not seen:
        return None
    from matplotlib.colors import to_rgb

    states = states_of(seen)
    columns = min(len(seen), ABREAST)
    drawn = sheet(-(-len(seen) // columns), columns, height=0.16 * max(len(states), 8), gap=0.3, margins=(1.7, RIGHT))
    drawn.figure.subplots_adjust(wspace=0.06)
    for ax, (name, own) in zip(drawn.axes.flat, seen.items(), strict=False):
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
        ax.set_yticks(range(len(states)), states if ax in drawn.axes[:, 0] else [], fontsize=7)
        ax.set_title(name, y=1.0, fontsize=10, loc="left")
    run.against_time(drawn, 0.25)
    for ax in drawn.axes.flat:
        ax.grid(axis="y", visible=False)
    for ax in drawn.axes.flat[len(seen) :]:
        ax.set_visible(False)
    for ax in drawn.axes[-2] if len(seen) % columns else ():  # above a place that is left empty
        ax.set_xlabel("time [s]" if ax in drawn.axes[-2, len(seen) % columns :] else "")
        ax.tick_params(labelbottom=ax in drawn.axes[-2, len(seen) % columns :])
    return drawn.figure


PLOTS = (
    Plot(
        "visibility",
        "Which states can be seen, and when. Full colour: by what was measured at that time; pale: only together with"
        " what was measured before; blank: not at all, or not apart from others. A grey line: the estimator has no such"
        " state. What own sensors measure is left out.",
        visibility,
        pictured=True,
    ),
)
