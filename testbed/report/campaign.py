"""What the runs of a campaign say together: statistics, tables, figures.

Median, 95th percentile and worst are over the runs of one combination of varied values. Consistency is judged by the
position NEES: over n independent runs of a filter whose covariance is right, the sum at one instant is chi-square with
3 n degrees of freedom, so that the mean per degree of freedom lies between the 2.5 % and 97.5 % points of
chi2(3 n) / (3 n) at 95 % of all instants (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and
Navigation, 2001, 5.4).
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from nav.samples import Array
from testbed.results import write_result

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from rich.table import Table

    from testbed.many.campaign import CampaignResult, Combination, Outcome

TABLE, SUMMARY = "campaign.csv", "campaign.json"
NEES_DOF = 3  # north, east, down
CONFIDENCE = (0.025, 0.975)

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
}
BEST_LARGE = frozenset({"coverage", "isolation_correct"})


@dataclass(frozen=True, slots=True)
class Spread:
    """One metric of one estimator over the runs of one combination; ``runs`` counts those that have a number for it.

    ``p95`` is what 95 % of them do not exceed, or do not stay below where large is good.
    """

    combination: int
    estimator: str
    metric: str
    median: float
    p95: float
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
class Statistics:
    """Everything the tables show."""

    spreads: Sequence[Spread]
    consistency: Sequence[Consistency]


def nees_bounds(runs: npt.ArrayLike) -> Array:
    """Two-sided 95 % bounds (2, ...) of the mean position NEES per degree of freedom over ``runs`` independent runs."""
    from scipy.stats import chi2

    dof = NEES_DOF * np.asarray(runs, dtype=float)
    bounds: Array = np.array([chi2.ppf(p, dof) / dof for p in CONFIDENCE])
    return bounds


def statistics(combinations: Sequence[Combination], outcomes: Sequence[Outcome]) -> Statistics:
    """Spread and consistency of every estimator, one combination after the other."""
    spreads: list[Spread] = []
    consistency: list[Consistency] = []
    for i, combination in enumerate(combinations):
        own = [outcome for outcome in outcomes if outcome.combination == i]
        for estimator in [e.name for e in combination.scenario.estimator] if own else ():
            spreads += _spreads(i, estimator, own)
            consistency.append(_consistency(i, estimator, own))
    return Statistics(spreads, consistency)


def _spreads(combination: int, estimator: str, outcomes: Sequence[Outcome]) -> Iterator[Spread]:
    every = dict.fromkeys(
        key.partition(".")[2] for o in outcomes for key in o.metrics if key.startswith(f"{estimator}.")
    )
    for metric in (*QUANTITIES, *(key for key in every if key.partition(".")[0] in OF_FAULTS)):
        key = f"{estimator}.{metric}"
        found = [(o.metrics[key], o.seed) for o in outcomes if key in o.metrics]
        if found:
            values = [value for value, _ in found]
            small = metric.partition(".")[0] in BEST_LARGE
            worst, seed = (min if small else max)(found, key=lambda pair: pair[0])
            median, p95 = (float(np.percentile(values, p)) for p in (50, 5 if small else 95))
            yield Spread(combination, estimator, metric, median, p95, worst, seed, len(found))


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


def nees_mean(outcomes: Sequence[Outcome], estimator: str) -> tuple[Array, npt.NDArray[np.int64]]:
    """NEES per degree of freedom over time, mean over the runs that have one, and how many these are."""
    nees = _stack(outcomes, f"{estimator}.nees")
    runs = np.isfinite(nees).sum(axis=0)
    return np.where(runs > 0, np.nansum(nees, axis=0) / np.maximum(runs, 1), np.nan), runs


def _stack(outcomes: Sequence[Outcome], name: str) -> Array:
    """One row per run, NaN after its end: a motion that ends by itself ends sooner in some gusts than in others."""
    rows = [outcome.history[name] for outcome in outcomes]
    longest = max(map(len, rows))
    return np.array([np.pad(row, (0, longest - len(row)), constant_values=np.nan) for row in rows])


def _longest(outcomes: Sequence[Outcome]) -> Mapping[str, Array]:
    """History of the run that lasted longest; all have the same times as far as they go."""
    return max((outcome.history for outcome in outcomes), key=lambda history: len(history["time"]))


# --- files


def save(result: CampaignResult) -> None:
    """Write campaign.csv (one line per run), campaign.json (statistics and failures) and the figures."""
    write_result(result.path / TABLE, _csv(result).encode())
    write_result(result.path / SUMMARY, json.dumps(_json(result), indent=1).encode())
    for name, figure in figures(result).items():
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=120)
        write_result(result.path / f"{name}.png", buffer.getvalue())


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
        return [
            {key: None if isinstance(v, float) and not math.isfinite(v) else v for key, v in asdict(row).items()}
            for row in rows
        ]

    return {
        "combinations": [dict(combination.values) for combination in result.combinations],
        "runs": len(result.outcomes),
        "spreads": plain(result.statistics.spreads),
        "consistency": plain(result.statistics.consistency),
        "failures": plain(result.failures),
    }


# --- tables


def tables(result: CampaignResult) -> list[Table]:
    """The tables for a console: errors, then consistency."""
    from rich import box
    from rich.markup import escape  # varied values and units may hold brackets
    from rich.table import Table

    keys = list(result.combinations[0].values)

    def values(combination: int) -> list[str]:
        return [escape(value) for value in result.combinations[combination].values.values()]

    errors = Table(title="Errors over the runs", box=box.SIMPLE, title_justify="left")
    consistency = Table(title="Consistency over the runs", box=box.SIMPLE, title_justify="left")
    for table, names in ((errors, ["estimator", "error", *keys]), (consistency, ["estimator", *keys])):
        for name in names:
            table.add_column(escape(name))
    for name in ("median", "95 %", "worst", "of seed", "runs"):
        errors.add_column(name, justify="right")
    for name in ("NEES/dof", "bounds", "inside", "false alarms/h", "runs"):
        consistency.add_column(name, justify="right")

    spreads = result.statistics.spreads
    for estimator, metric in dict.fromkeys((s.estimator, s.metric) for s in spreads):
        rows = [s for s in spreads if (s.estimator, s.metric) == (estimator, metric)]
        for i, s in enumerate(rows):
            names = [estimator, escape(_called(metric))] if i == 0 else ["", ""]
            numbers = [_number(s.median), _number(s.p95), _number(s.worst), str(s.worst_seed), str(s.runs)]
            errors.add_row(*names, *values(s.combination), *numbers, end_section=bool(keys) and s is rows[-1])
    estimators = [e.name for e in result.combinations[0].scenario.estimator]
    for c in sorted(result.statistics.consistency, key=lambda c: estimators.index(c.estimator)):
        bounds = f"{c.lower:.2f} – {c.upper:.2f}"
        numbers = [f"{c.nees:.2f}", bounds, f"{100 * c.inside:.0f} %", _number(c.false_alarms_per_h), str(c.runs)]
        consistency.add_row(c.estimator, *values(c.combination), *numbers)
    return [errors, consistency]


def _called(metric: str) -> str:
    what, _, fault = metric.partition(".")
    return f"{fault}: {OF_FAULTS[what]}" if what in OF_FAULTS else QUANTITIES[metric]


def _number(value: float) -> str:
    """Three digits that count, without an exponent."""
    if not math.isfinite(value):
        return "–"
    digits = 0 if value == 0.0 else max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:.{min(digits, 4)}f}"


# --- figures

_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_LINEAR_UP_TO = 30.0  # times the smallest error; a wider distribution gets a logarithmic axis
_MOST_COLUMNS = 3  # more combinations than this share a panel


def figures(result: CampaignResult) -> dict[str, Figure]:
    """The campaign's figures by file name: error envelopes, NEES, one distribution per varied key."""
    if not result.outcomes:
        return {}
    keys = list(result.combinations[0].values)
    made = {"errors": _error_figure(result), "nees": _nees_figure(result)}
    for key in keys:
        name = "distribution_" + re.sub(r"\W+", "_", key).strip("_")
        made[name] = _distribution_figure(result, key, lambda c, key=key: c.values[key])  # type: ignore[misc]
    if not keys:
        made["distribution"] = _distribution_figure(result, "", lambda _: "all runs")
    return made


def _panels(result: CampaignResult, title: str, columns: int = 1) -> tuple[Figure, npt.NDArray[Any]]:
    """Panels (estimators, columns) with outages shaded and time below."""
    from matplotlib.figure import Figure

    estimators = [e.name for e in result.combinations[0].scenario.estimator]
    figure = Figure(figsize=(5.0 + 4.0 * columns, 1.4 + 2.8 * len(estimators)), layout="constrained")
    figure.suptitle(title)
    panels = figure.subplots(len(estimators), columns, sharex=True, sharey="row", squeeze=False)
    outages = _outages(result)
    for axes in panels.flat:
        axes.grid(alpha=0.3)
        for start, end in outages:
            axes.axvspan(start, end, color="0.9", zorder=0)
    for row, estimator in zip(panels, estimators, strict=True):
        row[0].set_title(estimator, loc="left", fontsize="medium")
    for axes in panels[-1]:
        axes.set_xlabel("time [s]    (shaded: no GNSS fix)" if outages else "time [s]")
    return figure, panels


def _outages(result: CampaignResult) -> list[tuple[float, float]]:
    """Windows without a fix, when they are the same in all runs."""
    longest = _longest(result.outcomes)
    time, outage = longest["time"], longest["outage"]
    if not all(np.array_equal(o.history["outage"], outage[: len(o.history["outage"])]) for o in result.outcomes):
        return []
    edges = np.flatnonzero(np.diff(outage, prepend=0.0, append=0.0))
    times = np.append(time, time[-1])
    return [(float(times[start]), float(times[end])) for start, end in edges.reshape(-1, 2)]


def _groups(result: CampaignResult) -> Iterator[tuple[str, Any, list[Outcome]]]:
    """Label, colour and outcomes of every combination that has any."""
    import matplotlib

    many = len(result.combinations) > len(_COLOURS)
    for i, combination in enumerate(result.combinations):
        own = [outcome for outcome in result.outcomes if outcome.combination == i]
        colour = matplotlib.colormaps["viridis"](i / len(result.combinations)) if many else _COLOURS[i]
        if own:
            yield str(combination), colour, own


def _error_figure(result: CampaignResult) -> Figure:
    """Median, 5 to 95 % and claimed sigma; a column for each of a few combinations, medians alone for many."""
    groups = list(_groups(result))
    apart = len(groups) <= _MOST_COLUMNS
    runs = max(len(own) for _, _, own in groups)
    figure, panels = _panels(result, f"Errors over {runs} runs", len(groups) if apart else 1)
    for axes, (label, _, _) in zip(panels[0] if apart else (), groups, strict=False):
        axes.set_title(label, loc="right", fontsize="medium")
    for row, estimator in zip(panels, result.combinations[0].scenario.estimator, strict=True):
        for i, (label, colour, own) in enumerate(groups):
            axes = row[i if apart else 0]
            error = _stack(own, f"{estimator.name}.error")
            known = np.flatnonzero(np.isfinite(error).any(axis=0))
            time, error = _longest(own)["time"][known], error[:, known]
            low, median, high = np.nanpercentile(error, (5, 50, 95), axis=0)
            axes.plot(time, median, color=colour, linewidth=1.4, label="median" if apart else label)
            if apart:
                claimed = np.nanmedian(_stack(own, f"{estimator.name}.sigma")[:, known], axis=0)
                axes.fill_between(time, low, high, color=colour, alpha=0.25, linewidth=0, label="5 – 95 %")
                axes.plot(time, claimed, color="0.2", linewidth=1.0, linestyle="--", label="claimed 1 σ, median")
        row[0].set_ylabel("roll, pitch error [deg]" if estimator.attitude_only else "horizontal error [m]")
        _logarithmic(row[0])
    panels[0, -1].legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _nees_figure(result: CampaignResult) -> Figure:
    groups = list(_groups(result))
    runs = max(len(own) for _, _, own in groups)
    figure, panels = _panels(result, f"NEES per degree of freedom, mean over {runs} runs")
    low, high = nees_bounds(runs)
    for axes, estimator in zip(panels[:, 0], result.combinations[0].scenario.estimator, strict=True):
        axes.axhspan(low, high, color="0.75", linewidth=0, label="95 % bounds")
        axes.axhline(1.0, color="0.4", linewidth=0.8)
        for label, colour, own in groups:
            mean, _ = nees_mean(own, estimator.name)
            axes.plot(_longest(own)["time"], mean, color=colour, linewidth=1.0, label=label or "mean")
        axes.set_ylabel(f"{'attitude' if estimator.attitude_only else 'position'} NEES / dof")
        _logarithmic(axes, 0.1, 10.0)
    panels[0, 0].legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _logarithmic(axes: Axes, least: float = math.inf, most: float = 0.0) -> None:
    """A logarithmic axis from ``least`` to ``most`` at the least, with plain numbers.

    The numbers between the powers of ten are there only where they have room.
    """
    from matplotlib.ticker import FuncFormatter, NullFormatter

    axes.set_yscale("log")
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, least), max(high, most))
    plain = FuncFormatter(lambda x, _: f"{x:,.0f}" if x >= 1.0 else f"{x:g}")
    axes.yaxis.set_major_formatter(plain)
    axes.yaxis.set_minor_formatter(plain if high < 6.0 * low else NullFormatter())


def _distribution_figure(result: CampaignResult, key: str, value_of: Callable[[Combination], str]) -> Figure:
    """A panel for each estimator: a box of one metric per value, with every run as a dot."""
    from matplotlib.figure import Figure

    estimators = result.combinations[0].scenario.estimator
    denied = any(".outage_" in key for o in result.outcomes for key in o.metrics)
    values = list(dict.fromkeys(value_of(c) for c in result.combinations))
    figure = Figure(figsize=(3.0 + 1.5 * len(values), 1.4 + 2.8 * len(estimators)), layout="constrained")
    figure.suptitle("Largest error of each run\n(box: quartiles, whiskers: 5 and 95 %)", fontsize="medium")
    panels = figure.subplots(len(estimators), 1, sharex=True, squeeze=False)[:, 0]
    for axes, estimator in zip(panels, estimators, strict=True):
        metric = "roll_pitch_max_deg" if estimator.attitude_only else "position_horizontal_max_m"
        metric = f"outage_{metric}" if denied else metric
        found: dict[str, list[float]] = {value: [] for value in values}
        for o in result.outcomes:
            if f"{estimator.name}.{metric}" in o.metrics:
                found[value_of(result.combinations[o.combination])].append(o.metrics[f"{estimator.name}.{metric}"])
        for x, errors in enumerate(found.values()):
            line = {"color": _COLOURS[0], "linewidth": 2}
            axes.boxplot(errors, positions=[x], widths=0.5, whis=(5, 95), showfliers=False, medianprops=line)
            axes.plot(x + np.linspace(-0.15, 0.15, len(errors)), errors, "o", color="0.3", markersize=3, alpha=0.6)
        axes.set_title(estimator.name, loc="left", fontsize="medium")
        axes.set_ylabel(QUANTITIES[metric])
        axes.grid(alpha=0.3, axis="y")
        known = [error for errors in found.values() for error in errors]
        if known and max(known) > _LINEAR_UP_TO * min(known):
            _logarithmic(axes)
        else:
            axes.set_ylim(bottom=0.0)
    panels[-1].set_xticks(range(len(values)), values)
    panels[-1].set_xlim(-0.6, len(values) - 0.4)
    panels[-1].set_xlabel(key)
    return figure
