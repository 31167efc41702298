"""The report of a run: its figures as PNG, and one HTML page to look around in that needs nothing else."""

from __future__ import annotations

import base64
import functools
import io
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from testbed.report import differences, interactive, tables
from testbed.report.figures import CHAPTERS
from testbed.report.interactive.contents import events
from testbed.report.run import Run
from testbed.results import REPORT, held, write_result
from testbed.score import accuracy
from testbed.score.differences import Case
from testbed.score.remarks import remarks

if TYPE_CHECKING:
    import xarray
    from jinja2 import Environment
    from matplotlib.figure import Figure

KEPT = (  # attributes shown as they are
    ("reference", "Reference"),
    ("log", "Log"),
    ("scenario", "Scenario"),
    ("overrides", "Overrides"),
    ("versions", "Versions"),
)


@dataclass(frozen=True, slots=True)
class Shown:
    """One figure on a page: under which heading, its caption, and the picture."""

    chapter: str
    caption: str
    png: bytes

    @property
    def anchor(self) -> str:
        """Where the table of contents points to."""
        return re.sub(r"\W+", "-", self.chapter).strip("-").lower()

    @property
    def data(self) -> str:
        """The picture as it stands in the page."""
        return base64.b64encode(self.png).decode()


def write_report(dataset: xarray.DataTree, metrics: Mapping[str, float], folder: Path, force: bool = False) -> Path:
    """Write ``report.html`` and one PNG per figure into ``folder`` and return the page's path.

    The page holds everything it shows. Raises UserError when the folder can't be written or, without ``force``, holds
    files of these names that no earlier command made.
    """
    run = Run(dataset)
    page = folder / REPORT
    with held(folder):
        shown = []
        for chapter in CHAPTERS:
            for plot, title, name, caption, figure in chapter.drawn(run):
                picture = png(figure)
                write_result(folder / f"{name}.png", picture, force)
                if plot.pictured:
                    shown.append(Shown(title, caption, picture))
        write_result(page, render("run.html", figures=shown, **content(run, metrics)).encode(), force)
    return page


def files(subjects: Iterable[str]) -> list[str]:
    """Every file that a report may consist of, with these estimators and inertial sensors."""
    of_each = list(subjects)
    names = [
        plot.name.format(subject)
        for chapter in CHAPTERS
        for plot in chapter.plots
        for subject in (of_each if chapter.subjects else [""])
    ]
    return [REPORT, *(f"{name}.png" for name in names)]


def content(run: Run, metrics: Mapping[str, float]) -> dict[str, Any]:
    """What the page says beside its figures."""
    attributes = run.dataset.attrs
    contents = interactive.contents([interactive.Shown("", run)])
    summary = tables.summary(metrics)
    ended = accuracy.ended(run.dataset)
    beside = Case("", summary.names, [(0, metrics)], ended)
    return {
        "contents": contents,
        "script": script_of(contents),
        "title": str(attributes.get("title", "Run")),
        "duration_s": float(run.t[-1]),
        "seed": attributes.get("seed", ""),
        "complete": bool(attributes.get("complete", 1)),
        "remarks": [*(f"{name} has ended: {why}" for name, why in ended.items()), *remarks(run.dataset, metrics)],
        "summary": summary,
        "against": differences.with_cells(differences.blocks([beside])),
        "faults": tables.faults(run.faults, metrics),
        "seen": tables.seen(run.seen),
        "events": [(t, f"{t:.1f} s", how, what) for t, how, what in events(run)],
        "kept": [(name, str(attributes[key])) for key, name in KEPT if attributes.get(key)],
    }


def png(figure: Figure) -> bytes:
    """A figure as the bytes of a PNG file."""
    picture = io.BytesIO()
    figure.savefig(
        picture,
        format="png",
        pil_kwargs={"compress_level": 2},  # as small as 6, in half the time
    )
    return picture.getvalue()


def script_of(contents: Mapping[str, Any]) -> Markup:
    """What draws these contents, to be put into a page as it is."""
    return Markup(interactive.script(contents))


def render(template: str, **values: Any) -> str:
    """One of the pages in `templates`; whatever text is put into it is escaped."""
    return _pages().get_template(template).render(styles=Markup(interactive.styles()), **values)


@functools.cache
def _pages() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("testbed.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
