"""The first draw of Cui et al. 2022: errors on the left, what each detector saw on the right: ``cui2022.png``."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from nav.detection import chi_square_threshold
from testbed.papers.cui2022.claims import AXES, FIGURES, UNITS
from testbed.papers.cui2022.flight import AFTER_S, FALSE_ALARM, NAME, WITH_STAR, WITHOUT_STAR, Draw
from testbed.report.style import AXIS_COLOURS, COLOURS, FAULT
from testbed.results import write_result

COLOURS_KEPT = 48  # dots of many shades make the file four times as large
LABELS = {"gnss_position": "GPS position", "gnss_velocity": "GPS velocity", "body_velocity": "Doppler",
          "star_attitude": "star"}  # fmt: skip
SENSORS = {"gnss_position": "gps", "gnss_velocity": "gps", "body_velocity": "doppler", "star_attitude": "star_tracker"}


def draw(first: Draw, out: Path) -> None:
    """From a draw with its series; the faults are shaded, the paper's bounds dotted."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    shown = first.series
    figure = Figure(figsize=(10.5, 7.4), dpi=90, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(4, 2, sharex=True)
    rows = [
        (WITH_STAR, "position"),
        (WITH_STAR, "velocity"),
        (WITH_STAR, "attitude"),
        (WITHOUT_STAR, "attitude"),
    ]
    for ax, (name, what) in zip(axes[:, 0], rows, strict=True):
        t, error = shown["t"], shown["errors"][name][what]
        for k, axis in enumerate(AXES[what]):
            ax.plot(t, error[:, k], color=AXIS_COLOURS[k], lw=0.9, label=axis)
            if name == WITH_STAR:
                for bound in (-FIGURES[what][k], FIGURES[what][k]):
                    ax.axhline(bound, color=AXIS_COLOURS[k], lw=0.9, ls=":")
        most = max(1.15 * np.abs(error[t >= AFTER_S]).max(), 1.2 * min(FIGURES[what]))
        ax.set(ylim=(-most, most), ylabel=f"{what} error [{UNITS[what]}]")
        for _, start, end in shown["faults"]:
            ax.axvspan(start, end, color=FAULT, lw=0)
        ax.set_title("without star tracker" if name == WITHOUT_STAR else "", fontsize=9, loc="left", pad=3)
        ax.legend(loc="upper right", ncols=3, fontsize=8, frameon=False, borderaxespad=0.1)
    for ax, (part, label) in zip(axes[:, 1], LABELS.items(), strict=True):
        t, nis = shown["measurements"][part]
        ax.semilogy(t, np.maximum(nis, 0.01), ".", ms=1.8, color=COLOURS[0], label="ERAIM")
        ax.axhline(chi_square_threshold(FALSE_ALARM, 3), color=COLOURS[1], lw=1)
        if part == "gnss_velocity":
            t, statistic, threshold = shown["glr"]
            ax.semilogy(t, np.maximum(statistic, 0.01), color=COLOURS[2], lw=1, label="GLR around the small step")
            ax.semilogy(t, threshold, color=COLOURS[2], lw=1, ls="--")
            ax.legend(loc="upper left", ncols=2, fontsize=8, frameon=False, borderaxespad=0.1, markerscale=3)
        for name, start, end in shown["faults"]:
            if name == SENSORS[part]:
                ax.axvspan(start, end, color=FAULT, lw=0)
        ax.set(ylabel=f"{label}: statistic", ylim=(0.05, 3e4))
    for ax in axes.flat:
        ax.grid(alpha=0.35, lw=0.6)
        ax.spines[["top", "right"]].set_visible(False)
        ax.set_xlim(0, 1200)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    axes[0, 0].set_title("federated filter, faults shaded", fontsize=9, loc="left", pad=3)
    axes[0, 1].set_title("detection statistic and limit, faults of the sensor shaded", fontsize=9, loc="left", pad=3)
    drawn, content = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn)
    Image.open(drawn).convert("RGB").quantize(COLOURS_KEPT).save(content, "png")
    write_result(out / f"{NAME}.png", content.getvalue())
