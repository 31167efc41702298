"""What the runs of a campaign say together: statistics, tables, figures.

Median, 95th percentile and worst are over the runs of one combination of varied values: the median as usual, the
percentile what 95 % of them do not exceed (`testbed.score.claims`). An interval of a quantile is from one order
statistic to another, and holds the quantile of all draws with at least 95 %, whatever the distribution (Conover,
Practical Nonparametric Statistics, 1999, 3.2). Consistency is judged by the position NEES: over n independent runs of a
filter whose covariance is right, the sum at one instant is chi-square with 3 n degrees of freedom, so that the mean per
degree of freedom lies between the 2.5 % and 97.5 % points of chi2(3 n) / (3 n) at 95 % of all instants (Bar-Shalom, Li,
Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, 5.4).
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from nav.samples import Array
from testbed.report.campaign_figures import figures, nees_bounds, nees_mean
from testbed.report.campaign_page import contents
from testbed.report.expected import COLUMNS, Kept, kept
from testbed.report.page import Shown, png, render, script_of
from testbed.results import CAMPAIGN, REPORT, write_result
from testbed.score.accuracy import AXES, SETTLING_S
from testbed.score.claims import HARDLY_ANY, MEDIAN, NEARLY_ALL, student
from testbed.score.metrics import OUTAGE_MARKS_S

if TYPE_CHECKING:
    from rich.table import Table

    from testbed.many.campaign import CampaignResult, Combination, Failure, Outcome

UNSCORED = f"Errors over the runs: none is scored, which begins {SETTLING_S:.0f} s after an alignment"
INTERACTIVE = ("errors", "nees")  # figures that the page has as plots to look around in
TABLE, SUMMARY = "campaign.csv", CAMPAIGN

# The main metrics and how tables call them. All are errors: the worst is the largest, but for `BEST_LARGE`.
QUANTITIES: Mapping[str, str] = {
    "position_horizontal_rms_m": "horizontal rms [m]",
    "position_horizontal_max_m": "horizontal max [m]",
    "position_vertical_rms_m": "vertical rms [m]",
    "velocity_rms_mps": "velocity rms [m/s]",
    "roll_pitch_rms_deg": "roll, pitch rms [deg]",
    "roll_pitch_max_deg": "roll, pitch max [deg]",
    "heading_rms_deg": "heading rms [deg]",
    "outage_position_horizontal_rms_m": "in outage, horizontal rms [m]",
    "outage_position_horizontal_max_m": "in outage, horizontal max [m]",
    "outage_roll_pitch_max_deg": "in outage, roll, pitch max [deg]",
    "outage_position_horizontal_at_120s_m": "after 120 s of outage [m]",
    "outage_position_horizontal_at_600s_m": "after 600 s of outage [m]",
    "recovery_s": "recovery [s]",
}
# And those of each fault, whose name follows after a dot.
OF_FAULTS: Mapping[str, str] = {
    "detection_delay_s": "detected after [s]",
    "coverage": "share refused",
    "end_lag_s": "used again after [s]",
    "missed": "missed",
    "isolation_correct": "isolated",
    "error_over_3sigma": "error / claimed 3 σ",
}
BEST_LARGE = frozenset({"coverage", "isolation_correct"})
ERROR_AT, BOUND_AT = "outage_position_horizontal_at_{}s_m", "outage_bound_at_{}s_m"
MEAN_ERROR = re.compile(r"(outage_)?(position|velocity)_(north|east|down)_mean_\w+")
NARROW, LEGIBLE = 80, 12  # columns of a terminal, and of a name that is folded


@dataclass(frozen=True, slots=True)
class Spread:
    """One metric of one estimator over the runs of one combination; ``runs`` counts those that have a number for it.

    ``p95`` is what 95 % of them do not exceed, or do not stay below where large is good. The ``_low`` and ``_high`` of
    median and p95 are the ends of their 95 % intervals, infinite where there are too few runs for one.
    """

    combination: int
    estimator: str
    metric: str
    median: float
    median_low: float
    median_high: float
    p95: float
    p95_low: float
    p95_high: float
    worst: float
    worst_seed: int
    runs: int


@dataclass(frozen=True, slots=True)
class Consistency:
    """Whether an estimator's claims hold over the runs of one combination.

    ``nees`` is the position NEES per degree of freedom (of an estimator of attitude alone, the attitude NEES), mean
    over runs and time; ``lower`` and ``upper`` bound the mean over runs at one instant; ``inside`` is the share of
    instants at which it keeps them, 0.95 when all is right.
    ``false_alarms_per_h`` is the mean over runs of that metric.
    """

    combination: int
    estimator: str
    nees: float
    lower: float
    upper: float
    inside: float
    false_alarms_per_h: float
    runs: int


@dataclass(frozen=True, slots=True)
class Mean:
    """One signed error of one estimator: the mean over the runs of one combination of each run's mean error.

    ``low`` and ``high`` are the ends of Student's 95 % interval, NaN where there is one run only.
    """

    combination: int
    estimator: str
    metric: str
    mean: float
    low: float
    high: float
    runs: int


@dataclass(frozen=True, slots=True)
class Efficiency:
    """Horizontal error of one estimator some time into an outage over the bound, both root mean squares over the runs.

    1 is as good as can be. ``low`` and ``high`` are from Student's 95 % interval of the mean square, NaN where there is
    one run only.
    """

    combination: int
    estimator: str
    metric: str
    rms: float
    bound: float
    efficiency: float
    low: float
    high: float
    runs: int


@dataclass(frozen=True, slots=True)
class Statistics:
    """Everything the tables show."""

    spreads: Sequence[Spread]
    consistency: Sequence[Consistency]
    means: Sequence[Mean] = ()
    efficiencies: Sequence[Efficiency] = ()
    expected: Sequence[Kept] = ()


def statistics(
    combinations: Sequence[Combination], outcomes: Sequence[Outcome], failures: Sequence[Failure] = ()
) -> Statistics:
    """Spread, mean errors, efficiency and consistency of every estimator, and [expect], by combination."""
    spreads: list[Spread] = []
    consistency: list[Consistency] = []
    means: list[Mean] = []
    efficiencies: list[Efficiency] = []
    for i, combination in enumerate(combinations):
        own = [outcome for outcome in outcomes if outcome.combination == i]
        for estimator in [e.name for e in combination.scenario.estimator] if own else ():
            spreads += _spreads(i, estimator, own)
            consistency.append(_consistency(i, estimator, own))
            means += _means(i, estimator, own)
            efficiencies += _efficiencies(i, estimator, own)
    return Statistics(spreads, consistency, means, efficiencies, list(kept(combinations, outcomes, failures)))


def _spreads(combination: int, estimator: str, outcomes: Sequence[Outcome]) -> Iterator[Spread]:
    every = dict.fromkeys(
        key.partition(".")[2] for o in outcomes for key in o.metrics if key.startswith(f"{estimator}.")
    )
    for metric in (*QUANTITIES, *(key for key in every if key.partition(".")[0] in OF_FAULTS)):
        key = f"{estimator}.{metric}"
        found = [(o.metrics[key], o.seed) for o in outcomes if key in o.metrics]
        if found:
            values = np.array([value for value, _ in found])
            small = metric.partition(".")[0] in BEST_LARGE
            worst, seed = (min if small else max)(found, key=lambda pair: pair[0])
            median, p95 = MEDIAN.of(values), (HARDLY_ANY if small else NEARLY_ALL).of(values)
            yield Spread(combination, estimator, metric, *median, *p95, worst, seed, len(found))


def _means(combination: int, estimator: str, outcomes: Sequence[Outcome]) -> Iterator[Mean]:
    keys = dict.fromkeys(key for o in outcomes for key in o.metrics if key.startswith(f"{estimator}."))
    for key in (key for key in keys if MEAN_ERROR.fullmatch(key.partition(".")[2])):
        values = np.array([o.metrics[key] for o in outcomes if key in o.metrics])
        yield Mean(combination, estimator, key.partition(".")[2], *_mean(values), len(values))


def _efficiencies(combination: int, estimator: str, outcomes: Sequence[Outcome]) -> Iterator[Efficiency]:
    for mark in OUTAGE_MARKS_S:
        keys = [f"{estimator}.{name.format(mark)}" for name in (ERROR_AT, BOUND_AT)]
        both = np.array([[o.metrics[key] for key in keys] for o in outcomes if all(key in o.metrics for key in keys)])
        if not len(both) or not both[:, 1].all():
            continue
        error, bound = (both**2).T
        share, low, high = (math.sqrt(max(one, 0.0)) for one in _mean(error / bound.mean()))
        rms, least = math.sqrt(error.mean()), math.sqrt(bound.mean())
        name = f"outage_efficiency_at_{mark}s"
        yield Efficiency(combination, estimator, name, rms, least, share, low, high, len(both))


def _mean(values: Array) -> tuple[float, float, float]:
    """The mean of some values, and the ends of its interval."""
    if len(values) < 2:
        return float(values.mean()), math.nan, math.nan
    return student(values)


def _consistency(combination: int, estimator: str, outcomes: Sequence[Outcome]) -> Consistency:
    mean, runs = nees_mean(outcomes, estimator)
    known = runs > 0
    lower, upper = nees_bounds(len(outcomes))
    low, high = nees_bounds(runs[known])
    alarms = [o.metrics.get(f"{estimator}.false_alarms_per_h", math.nan) for o in outcomes]
    return Consistency(
        combination,
        estimator,
        float(np.mean(mean[known])) if known.any() else math.nan,
        float(lower),
        float(upper),
        float(np.mean((mean[known] >= low) & (mean[known] <= high))) if known.any() else math.nan,
        float(np.nanmean(alarms)) if np.isfinite(alarms).any() else math.nan,
        len(outcomes),
    )


# --- files


def save(result: CampaignResult) -> None:
    """Write campaign.csv (one line per run), campaign.json (statistics and failures), the figures, and report.html."""
    write_result(result.path / TABLE, _csv(result).encode())
    write_result(result.path / SUMMARY, json.dumps(_json(result), indent=1).encode())
    shown = []
    for name, (caption, figure) in figures(result).items():
        picture = png(figure)
        write_result(result.path / f"{name}.png", picture)
        if name not in INTERACTIVE:
            shown.append(Shown("Largest errors", caption, picture))
    if result.outcomes:
        write_result(result.path / REPORT, _page(result, shown).encode())


def _page(result: CampaignResult, shown: Sequence[Shown]) -> str:
    """One page with tables and figures, which needs nothing else."""
    of_runs = len(result.outcomes) + len(result.failures)
    interactive = contents(result)
    return render(
        "campaign.html",
        title=f"{result.combinations[0].scenario.title}: a campaign of {of_runs} runs",
        figures=shown,
        contents=interactive,
        script=script_of(interactive),
        remarks=result.remarks,
        tables=[(table.title, table.rows) for table in texts(result)],
        failures=[
            (f"{result.combinations[failure.combination]} seed {failure.seed}".strip(), failure.message)
            for failure in result.failures
        ]
        + [
            (
                f"{result.combinations[one.combination]} seed {one.seed}".strip(),
                ": ".join([f"{name} {what}", *filter(None, [why])]),
            )
            for one in result.outcomes
            for name, (what, why) in one.spoilt.items()
        ],
    )


def _csv(result: CampaignResult) -> str:
    text = io.StringIO()
    metrics = sorted({key for outcome in result.outcomes for key in outcome.metrics})
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*result.combinations[0].values, "seed", *metrics])
    for outcome in result.outcomes:
        values = result.combinations[outcome.combination].values.values()
        writer.writerow([*values, outcome.seed, *(outcome.metrics.get(key, "") for key in metrics)])
    return text.getvalue()


def _json(result: CampaignResult) -> dict[str, Any]:
    def plain(rows: Iterable[Any]) -> list[dict[str, Any]]:
        return [{key: finite(value) for key, value in asdict(row).items()} for row in rows]

    def finite(value: Any) -> Any:
        if isinstance(value, tuple):
            return [finite(one) for one in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return {
        "combinations": [dict(combination.values) for combination in result.combinations],
        "draw": result.draw,
        "runs": len(result.outcomes),
        "remarks": list(result.remarks),
        "spreads": plain(result.statistics.spreads),
        "consistency": plain(result.statistics.consistency),
        "means": plain(result.statistics.means),
        "efficiencies": plain(result.statistics.efficiencies),
        "expected": plain(result.statistics.expected),
        "failures": plain(result.failures),
        "spoilt": [
            {"combination": one.combination, "seed": one.seed, "estimator": name, "message": why or what}
            for one in result.outcomes
            for name, (what, why) in one.spoilt.items()
        ],
    }


# --- tables


@dataclass(frozen=True, slots=True)
class Text:
    """A table as text: its title, and its rows, the head first. The first ``words`` columns are no numbers."""

    title: str
    rows: Sequence[Sequence[str]]
    words: int


def texts(result: CampaignResult) -> list[Text]:
    """The tables of a campaign: errors, how sure they are, then consistency."""
    keys = list(result.combinations[0].values)

    def values(combination: int) -> list[str]:
        return list(result.combinations[combination].values.values())

    errors = [["estimator", "error", *keys, "median", "95 %", "worst", "of seed", "runs"]]
    intervals = [["estimator", "error", *keys, "median", "95 %"]]
    spreads = result.statistics.spreads
    for estimator, metric in dict.fromkeys((s.estimator, s.metric) for s in spreads):
        rows = [s for s in spreads if (s.estimator, s.metric) == (estimator, metric)]
        for i, s in enumerate(rows):
            names = [estimator, _called(metric)] if i == 0 else ["", ""]
            numbers = [_number(s.median), _number(s.p95), _number(s.worst), str(s.worst_seed), str(s.runs)]
            errors.append([*names, *values(s.combination), *numbers])
            ends = [_interval(s.median_low, s.median_high), _interval(s.p95_low, s.p95_high)]
            intervals.append([*names, *values(s.combination), *ends])
    consistency = [["estimator", *keys, "NEES/dof", "bounds", "inside", "false alarms/h", "runs"]]
    estimators = [e.name for e in result.combinations[0].scenario.estimator]
    for c in sorted(result.statistics.consistency, key=lambda c: estimators.index(c.estimator)):
        bounds = f"{c.lower:.2f} – {c.upper:.2f}"
        scored = math.isfinite(c.nees)
        shown = [f"{c.nees:.2f}", bounds, f"{100 * c.inside:.0f} %"] if scored else ["–", bounds, "–"]
        numbers = [*shown, _number(c.false_alarms_per_h), str(c.runs)]
        consistency.append([c.estimator, *values(c.combination), *numbers])
    enough = any(math.isfinite(s.median_low) for s in spreads)
    sure = Text("95 % confidence intervals of median and 95th percentile", intervals, 2 + len(keys))
    return [
        Text("Errors over the runs" if spreads else UNSCORED, errors, 2 + len(keys)),
        *([sure] if enough else []),
        Text("Consistency over the runs", consistency, 1 + len(keys)),
        *_efficiency(result, keys),
        *_mean_errors(result, keys),
        *_expected(result, keys),
    ]


def _efficiency(result: CampaignResult, keys: Sequence[str]) -> Iterator[Text]:
    """How near to the bound the horizontal errors in outages are; nothing where there is no bound."""
    rows = [["estimator", "after", *keys, "rms [m]", "bound [m]", "rms / bound", "95 % interval", "runs"]]
    for e in result.statistics.efficiencies:
        after = e.metric.rpartition("_")[2].removesuffix("s")
        numbers = [_number(e.rms), _number(e.bound), f"{e.efficiency:.2f}", _interval(e.low, e.high), str(e.runs)]
        rows.append([e.estimator, f"{after} s", *result.combinations[e.combination].values.values(), *numbers])
    if len(rows) > 1:
        yield Text("Horizontal error in outages against the bound", rows, 2 + len(keys))


def _mean_errors(result: CampaignResult, keys: Sequence[str]) -> Iterator[Text]:
    """Mean errors by axis with half of their intervals, a line for each quantity."""
    rows = [["estimator", "mean error", *keys, *(f"{axis} ± 95 %" for axis in AXES), "runs"]]
    found = {(m.combination, m.estimator, m.metric): m for m in result.statistics.means if m.runs > 1}
    for combination, estimator, metric in (key for key in found if "_north_" in key[2]):
        axes = [found[combination, estimator, metric.replace("north", axis)] for axis in AXES]
        named = metric.replace("outage_", "in outage, ").replace("_north_mean_", " [").replace("mps", "m/s") + "]"
        numbers = [f"{m.mean:+.3f} ± {m.high - m.mean:.3f}" for m in axes]
        own = result.combinations[combination].values.values()
        rows.append([estimator, named, *own, *numbers, str(axes[0].runs)])
    if len(rows) > 1:
        yield Text("Mean errors over the runs", rows, 2 + len(keys))


def _expected(result: CampaignResult, keys: Sequence[str]) -> Iterator[Text]:
    """How [expect] is kept; nothing where there is none."""
    rows = [[COLUMNS[0], *keys, *COLUMNS[1:]]]
    for one in result.statistics.expected:
        metric, *numbers = one.row
        rows.append([metric, *result.combinations[one.combination].values.values(), *numbers])
    if len(rows) > 1:
        yield Text("[expect] over the runs", rows, 1 + len(keys))


def tables(result: CampaignResult) -> list[Table]:
    """The same for a console. Where it is narrow, names are folded and numbers are not, if that leaves names legible.

    Else numbers are folded too, with their intervals below them.
    """
    from rich import box
    from rich.markup import escape  # varied values and units may hold brackets
    from rich.table import Table

    made = []
    for text in texts(result):
        table = Table(title=escape(text.title), box=box.SIMPLE, title_justify="left")
        head, *rows = text.rows
        grouped = any(not row[0] for row in rows)  # names stand in the first row of each group
        widths = [max(map(len, column)) for column in zip(*text.rows, strict=True)]
        parts = [
            max(len(part) for cell in column for part in cell.split() or [""])
            for column in zip(*text.rows, strict=True)
        ]
        least = [min(width, LEGIBLE) for width in widths[: text.words]]
        folded = sum(least) + sum(widths[text.words :]) + 3 * len(head) > NARROW
        for k, name in enumerate(head):
            number = k >= text.words
            table.add_column(
                escape(name),
                justify="right" if number else "left",
                no_wrap=number and not folded,
                overflow="fold",
                min_width=parts[k] if number else least[k],
            )
        for row, following in zip(rows, [*rows[1:], ["end"]][: len(rows)], strict=True):
            table.add_row(*map(escape, row), end_section=grouped and bool(following[0]))
        made.append(table)
    return made


def _called(metric: str) -> str:
    what, _, fault = metric.partition(".")
    return f"{fault}: {OF_FAULTS[what]}" if what in OF_FAULTS else QUANTITIES[metric]


def _interval(low: float, high: float) -> str:
    """Both ends, or the one that there is."""
    ends = math.isfinite(low), math.isfinite(high)
    if all(ends):
        return f"{_number(low)} – {_number(high)}"
    if not any(ends):
        return "too few runs"
    return f"≥ {_number(low)}" if ends[0] else f"≤ {_number(high)}"


def _number(value: float) -> str:
    """Three digits that count, without an exponent."""
    if not math.isfinite(value):
        return "–"
    digits = 0 if value == 0.0 else max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:.{min(digits, 4)}f}"
