"""The page of the papers: every claim with its interval beside the bound, and the figures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from testbed.papers import COLUMNS, Records, counted, parted, row
from testbed.papers.draws import Draws
from testbed.report.page import Shown, render
from testbed.score.claims import Verdict

REACH = 8.0  # of a drawing, to either side of the bound, as a factor


class Drawn(NamedTuple):
    """Where value and ends of an interval lie in its drawing [%]; the bound is in the middle."""

    value: float
    low: float
    high: float


class Line(NamedTuple):
    """A claim on the page."""

    cells: tuple[str, ...]
    verdict: str
    drawn: Drawn | None


def page(found: Mapping[str, Records], draws: Draws, pictures: Sequence[Shown]) -> str:
    """One page that needs nothing else: claims by the papers' titles, and ``pictures``."""
    every = [record["verdict"] for own in found.values() for record in own]
    return render(
        "papers.html",
        title=f"Five papers: draw {draws.number}, {draws.runs} draws of each claim",
        counted=counted(found),
        verdicts=[(verdict.value, every.count(verdict)) for verdict in Verdict if verdict in every],
        columns=COLUMNS,
        chapters=list(_chapters(found)),
        figures=pictures,
    )


def _chapters(found: Mapping[str, Records]) -> Iterator[tuple[str, list[Line]]]:
    for title, records in found.items():
        for heading, own in parted(title, records):
            yield heading, [Line(row(record), record["verdict"], drawn(record)) for record in own]


def drawn(record: Mapping[str, Any]) -> Drawn | None:
    """The drawing of a claim's interval over its bound, on a logarithmic axis; None where there is none to draw."""
    bound, value, (low, high) = record.get("limit"), record["ours"], record["interval"]
    if bound is None or not bound > 0.0 or value is None:
        return None

    def place(number: float | None, missing: float) -> float:
        if number is None:
            return missing
        if not number > 0.0:
            return 0.0
        return min(max(50.0 + 50.0 * math.log(number / bound) / math.log(REACH), 0.0), 100.0)

    return Drawn(place(value, math.nan), place(low, 0.0), place(high, 100.0))
