"""How the runs of a campaign keep the scenario's [expect], and the manual's page on that of the shipped scenarios."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nav.samples import Array
from testbed.data import data_dir, docs_dir, write_file
from testbed.errors import UserError
from testbed.report import markdown
from testbed.score.claims import HARDLY_ANY, MEDIAN, NEARLY_ALL, SHARE, Interval
from testbed.score.remarks import LOST

if TYPE_CHECKING:
    from testbed.many.campaign import CampaignResult, Combination, Failure, Outcome, Plan
    from testbed.scenario.schema import Bounds

PAGE = "expected.md"
COLUMNS = ("metric", "bound", "kept by", "median", "95 % of runs")
HEAD = """# What the shipped scenarios promise

Each line is a bound of a scenario's `[expect]`, over seeds that nobody looked at before: the share of runs that keep
it, the median, and what 95 % of the runs keep, each with the interval that holds it with 95 % confidence (order
statistics, and Clopper and Pearson's for the share; an end that so few runs can't tell is infinite).
Of an even number of runs the median of a section saved before 2026-11-30 is the lower of the two in the middle, later
halfway between them. [Many seeds](regression.md) says how to fly them again.
"""


@dataclass(frozen=True, slots=True)
class Kept:
    """One bound of [expect] over the runs of one combination.

    ``share`` is that of the runs which keep it; ``most`` is what 95 % of them do not exceed, or, ``at_least``, do not
    stay below. A run that failed or lacks the metric keeps nothing, nor does one whose estimator has ended, or gave no
    numbers more often than expected; ``missing`` lack it, ``failed`` have none.
    """

    combination: int
    metric: str
    bound: float
    at_least: bool
    share: Interval
    median: Interval
    most: Interval
    runs: int
    missing: int
    failed: int

    @property
    def row(self) -> tuple[str, ...]:
        """Under `COLUMNS`."""
        sign = "≥" if self.at_least else "≤"
        share = Interval(*(100 * one for one in self.share))
        told = [f", {what} {count}" for what, count in (("missing in", self.missing), ("failed", self.failed)) if count]
        kept_by = f"{share} %{''.join(told)}"
        return self.metric, f"{sign} {self.bound:g}", kept_by, f"{self.median}", f"{sign} {self.most}"


def kept(
    combinations: Sequence[Combination], outcomes: Sequence[Outcome], failures: Sequence[Failure] = ()
) -> Iterator[Kept]:
    """Every bound, one combination after the other, but on how long runs took, which says nothing of a filter."""
    for i, combination in enumerate(combinations):
        own = [outcome for outcome in outcomes if outcome.combination == i]
        failed = sum(failure.combination == i for failure in failures)
        expect = combination.scenario.expect
        for metric, bounds in expect.items() if own or failed else ():
            for bound, at_least in ((bounds.min, True), (bounds.max, False)):
                if bound is not None and not metric.startswith("run."):
                    worst = -math.inf if at_least else math.inf
                    values = np.array([_judged(metric, one, expect, worst) for one in own] + [worst] * failed)
                    yield _kept(i, metric, bound, at_least, values, own, failed)


def _judged(metric: str, one: Outcome, expect: Mapping[str, Bounds], worst: float) -> float:
    """What a run is judged by: the worst where its estimator has ended, or lost more estimates than expected."""
    whose = metric.partition(".")[0]
    lost, allowed = one.metrics.get(f"{whose}{LOST}", 0.0), expect.get(f"{whose}{LOST}")
    if whose in one.ended or (not metric.endswith(LOST) and lost and not (allowed and allowed.hold(lost))):
        return worst
    return one.metrics.get(metric, 0.0 if metric.endswith(LOST) else worst)


def _kept(
    combination: int, metric: str, bound: float, at_least: bool, values: Array, outcomes: Sequence[Outcome], failed: int
) -> Kept:
    holds = values >= bound if at_least else values <= bound
    lacking = [one for one in outcomes if metric not in one.metrics and not metric.endswith(LOST)]
    return Kept(
        combination, metric, bound, at_least, share=SHARE.of(holds.astype(float)), median=MEDIAN.of(values),
        most=(HARDLY_ANY if at_least else NEARLY_ALL).of(values), runs=len(values), missing=len(lacking), failed=failed,
    )  # fmt: skip


# --- the manual


def require_shipped(plan: Plan) -> None:
    """Raises UserError unless it is a shipped scenario as it is, and this a checkout."""
    docs_dir()
    if (
        plan.vary
        or plan.overrides
        or str(plan.scenario) not in {one.stem for one in data_dir("scenarios").glob("*.toml")}
    ):
        raise UserError(
            f"--save {plan.scenario}: is for shipped scenarios by name as they are, without --set and --vary"
        )


def save(plan: Plan, result: CampaignResult) -> Path:
    """Put the scenario's section into the manual's page, in place of the one that it has; the page's file.

    Raises UserError when a run failed.
    """
    if result.failures:
        raise UserError(f"{result.path}: {len(result.failures)} runs failed, so that nothing was saved")
    path = docs_dir() / PAGE
    sections = dict(_sections(path.read_text("utf-8"))) if path.exists() else {}
    sections[str(plan.scenario)] = _section(plan, result)
    text = "\n".join([HEAD, *(f"## {name}\n\n{sections[name]}" for name in sorted(sections))])
    write_file(path, text.encode())
    return path


def _sections(page: str) -> Iterator[tuple[str, str]]:
    """(scenario, text) of the sections of a page."""
    for section in page.split("\n## ")[1:]:
        name, _, text = section.partition("\n")
        yield name, text.strip("\n") + "\n"


def _section(plan: Plan, result: CampaignResult) -> str:
    today = datetime.now(UTC).date()
    lines = [f"`testbed campaign {plan.scenario} --runs {plan.runs} --draw {plan.draw} --save`, {today}.", ""]
    lines += markdown.table(COLUMNS, (one.row for one in result.statistics.expected))
    return "\n".join(lines) + "\n"
