"""Statistics with thresholds and faults, Table 2 as bars, errors of the fusions: ``zhou2025.png``."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from testbed.papers.zhou2025 import fusion
from testbed.papers.zhou2025.replays import (
    BUILD,
    FAST,
    MAIN,
    MAIN_RATE,
    RAMP,
    STEEP,
    STEP,
    Case,
    Found,
    Replayed,
    ramp,
    residuals,
    watch,
)
from testbed.report.style import COLOURS, FAULT
from testbed.results import write_result

DURATION_S = 216.0
# What Table 2 says is missed of each fault [s]; it has no likelihood ratio.
TABLE_2 = {"hard": (0.0, 1.2, 1.2, 1.2, math.nan), "soft": (20.4, 9.2, 7.8, 1.5, math.nan)}


def draw(
    flown: Mapping[str, Mapping[str, fusion.Flown]], replays: Sequence[Mapping[Case, Replayed]], out: Path
) -> None:  # fmt: skip
    """From a flight with its series, and all replays."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 7.4), dpi=80, layout="constrained")
    FigureCanvasAgg(figure)
    halves: Any = figure.subfigures(1, 2, width_ratios=(1.15, 1))
    _draw_statistics(halves[0])
    _draw_results(halves[1], flown, Found(replays))
    data = io.BytesIO()
    figure.savefig(data, format="png")
    write_result(out / "zhou2025.png", data.getvalue())


def _draw_statistics(figure: Any) -> None:
    """One seed through the detectors, over the whole of the run."""
    rows = figure.subplots(len(MAIN), 1, sharex=True)
    t, r = residuals(MAIN_RATE, 1, duration=DURATION_S)
    for name, ax in zip(MAIN, rows, strict=True):
        alarms, statistics, thresholds = watch(BUILD[name](MAIN_RATE, 1), t, r + ramp(t, STEEP)[:, None])
        ax.axvspan(*STEP, color=FAULT, lw=0)
        ax.axvspan(*RAMP, color=FAULT, lw=0)
        ax.plot(t, statistics, color=COLOURS[0], lw=0.8)
        ax.plot(t, thresholds, color="#000000", lw=0.9, ls="--")
        reach = 5 * float(thresholds[-1])
        ax.set_ylim(-0.8 * reach if name == FAST else -0.16 * reach, reach)
        bottom = ax.get_ylim()[0]
        ax.plot(t[alarms], np.full(alarms.sum(), 0.93 * bottom), "|", color=COLOURS[1], ms=5, mew=0.8)
        ax.set_title(name, loc="left", fontsize=9, pad=2)
        ax.grid(alpha=0.35, lw=0.6)
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=8)
    rows[0].set_xlim(0, DURATION_S)
    rows[-1].set_xlabel("time [s]", fontsize=9)
    figure.suptitle("Statistic, threshold (dashed), alarms (ticks); step 5 σ and ramp 0.1 σ/s at 5 Hz", fontsize=10)


def _draw_results(figure: Any, flown: Mapping[str, Mapping[str, fusion.Flown]], found: Found) -> None:
    """Table 2 as bars, and what the fusion makes of the faults."""
    bars, north, east = figure.subplots(3, 1, height_ratios=(1.25, 1, 1))
    place = np.arange(len(MAIN))
    series = (
        ("hard fault, paper", TABLE_2["hard"], COLOURS[4]),
        ("hard fault, ours", [float(np.median(found.hard(Case(name), "delay"))) for name in MAIN], COLOURS[0]),
        ("soft fault, paper", TABLE_2["soft"], COLOURS[5]),
        (
            "soft fault 0.1 σ/s, ours",
            [float(np.median(found.soft(Case(name), "sustained"))) for name in MAIN],
            COLOURS[1],
        ),
    )
    for k, (label, values, colour) in enumerate(series):
        drawn = bars.bar(place + 0.2 * (k - 1.5), values, 0.2, color=colour, label=label)
        bars.bar_label(drawn, [f"{v:.1f}" if v >= 0.05 else "0" if v == v else "" for v in values], fontsize=7)
    bars.set_xticks(place, [name.replace(" ", "\n") for name in MAIN], fontsize=8)
    bars.set_ylim(0, 45)
    bars.set_ylabel("missed before [s]", fontsize=9)
    bars.legend(fontsize=8, ncols=2, frameon=False, loc="upper right")
    for axis, (side, ax) in enumerate((("north", north), ("east", east))):
        ax.axvspan(*STEP, color=FAULT, lw=0)
        ax.axvspan(*RAMP, color=FAULT, lw=0)
        for k, name in ((1, fusion.FKF), (0, fusion.IMPROVED), (2, fusion.GLR)):
            error = flown[fusion.STEEP][name].error[:, axis]
            t = np.arange(len(error)) / fusion.RECORD_HZ
            ax.plot(t, error, color=COLOURS[k], lw=1, label=fusion.LABELS[name])
        ax.set_ylabel(f"{side} error [m]", fontsize=9)
        ax.set_xlim(0, DURATION_S)
    north.legend(fontsize=8, ncols=3, frameon=False, loc="upper right")
    north.set_xticklabels([])
    east.set_xlabel("time [s]", fontsize=9)
    for ax in (bars, north, east):
        ax.grid(alpha=0.35, lw=0.6)
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=8)
    figure.suptitle("Table 2, and the position on the circuit", fontsize=10)
