"""Tables of differences: two runs, or two estimators of one, row by row, and whether the second is better."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from testbed.report import tables
from testbed.score.differences import Case, Difference, differences, sides

LABELS = dict((*tables.ROWS, *tables.OUTAGE_ROWS, *tables.RUN_ROWS))
METRICS = [name for key in LABELS for name in ([key, f"outage_{key}"] if key in dict(tables.ROWS) else [key])]
PLAIN = {
    True: "p: Wilcoxon's signed-rank test of the differences of runs with the same seed, two-sided, not corrected for"
    " the number of rows.",
    False: "p: Mann and Whitney's U test, as no two runs have the same seed, two-sided, not corrected for the number of"
    " rows.",
}
ALONE = (
    "No significance: one pair of runs can't tell a difference from chance, however long they are, as errors are"
    " correlated over minutes. Fly more seeds: six pairs are the fewest that can reach p < 0.05."
)
FEW = "Fewer than six pairs: p can't be below 0.05, whatever the difference."


@dataclass(frozen=True, slots=True)
class Block:
    """One table: what is held against what, its rows, and what their p is."""

    first: str
    second: str
    rows: Sequence[Difference]
    lacking: Sequence[str] = ()  # why there is no verdict

    @property
    def head(self) -> tuple[str, ...]:
        """Names of the columns that `cells` has."""
        return "", self.first, self.second, "change", "", "runs", "p"

    def count(self, verdict: str) -> int:
        """How many rows have this verdict."""
        return sum(row.verdict == verdict for row in self.rows)

    @property
    def tested(self) -> bool:
        """Whether there are several runs; of one the columns of their number and p say nothing."""
        return max(row.runs for row in self.rows) > 1

    @property
    def note(self) -> str:
        """Which statistic it is, or why there is none."""
        if self.lacking:
            return f"No verdict, as not all of the run is scored: {'; '.join(self.lacking)}."
        pairs = max(row.runs for row in self.rows)
        if pairs < 2:
            return ALONE
        paired = self.rows[0].paired
        return f"{PLAIN[paired]} {FEW}" if paired and pairs < 6 else PLAIN[paired]


def blocks(cases: Sequence[Case]) -> list[Block]:
    """The tables of differences, those without a row left out."""
    found = [
        Block(str(one), str(two), differences(one, two, METRICS), [side.lacking for side in (one, two) if side.lacking])
        for one, two in sides(cases)
    ]
    return [block for block in found if block.rows]


def with_cells(found: Sequence[Block]) -> list[tuple[Block, list[tuple[Difference, list[str]]]]]:
    """Tables as pages have them: each row with its cells."""
    return [(block, [(row, cells(row)) for row in block.rows]) for block in found]


def label(metric: str) -> str:
    """What tables call a metric."""
    name = metric.removeprefix("outage_")
    return LABELS[metric] if metric in LABELS else f"in the outage: {LABELS[name]}"


def cells(row: Difference) -> list[str]:
    """Label, both values, change, verdict, number of pairs or runs, and p."""
    change = f"{100 * (row.second / row.first - 1):+.1f} %" if row.first else "–"
    p = "–" if math.isnan(row.p) else f"{row.p:.2g}"
    return [label(row.metric), f"{row.first:.3g}", f"{row.second:.3g}", change, row.verdict, str(row.runs), p]
