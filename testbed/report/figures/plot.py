"""What a figure is to the report: its file, its caption, and the function that draws it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from testbed.report.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHADES = "Grey: no GNSS fix. Yellow: a fault of a sensor."


@dataclass(frozen=True, slots=True)
class Plot:
    """One figure. ``draw(run)``, or ``draw(run, subject)`` in a chapter of subjects, is None where it would be empty.

    ``name`` is that of the file, with {} for the subject. ``timed`` ones have shades, which their caption explains.
    ``pictured`` ones stand in the page too, which has nothing like them to look around in.
    """

    name: str
    caption: str
    draw: Callable[..., Figure | None]
    timed: bool = True
    pictured: bool = False


@dataclass(frozen=True, slots=True)
class Chapter:
    """Figures that belong together, of the run or of each of its ``subjects``, whose name replaces {} in ``title``."""

    title: str
    plots: tuple[Plot, ...]
    subjects: Callable[[Run], Iterable[str]] | None = None

    def drawn(self, run: Run) -> Iterator[tuple[Plot, str, str, str, Figure]]:
        """Plot, title of the chapter, file name, caption and figure, of all that has something to show."""
        for subject in [()] if self.subjects is None else [(name,) for name in self.subjects(run)]:
            for plot in self.plots:
                figure = plot.draw(run, *subject)
                if figure is not None:
                    shades = f" {SHADES}" if plot.timed and (run.windows or run.faults) else ""
                    yield plot, self.title.format(*subject), plot.name.format(*subject), plot.caption + shades, figure
