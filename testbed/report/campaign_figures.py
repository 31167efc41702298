"""Figures of a campaign: errors over time, NEES against its bounds, and how the largest errors are distributed.

A panel shows one estimator. What belongs to it alone has its colour, the same as in the report of a run; combinations
of varied values that share a panel are told apart by a scale of colours that no estimator has.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nav.samples import Array
from testbed.report import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from testbed.many.campaign import CampaignResult, Combination, Outcome
    from testbed.report.style import Sheet

NEES_DOF = 3  # north, east, down
CONFIDENCE = (0.025, 0.975)
DISTRIBUTION = "distribution"
WHISKERS = (5, 95)  # percentiles of the runs
LINEAR_UP_TO = 30.0  # times the smallest error; a wider distribution gets a logarithmic axis
MOST_COLUMNS = 3  # more combinations than this share a panel


class Drawn(NamedTuple):
    """A figure and what is to be said below it."""

    caption: str
    figure: Figure


class Group(NamedTuple):
    """The outcomes of one combination, what it is called, and its colour among others."""

    label: str
    colour: Any
    outcomes: Sequence[Outcome]


def figures(result: CampaignResult) -> dict[str, Drawn]:
    """The campaign's figures by file name: error envelopes, NEES, one distribution per varied key."""
    if not result.outcomes:
        return {}
    groups = list(groups_of(result))
    runs = max(len(group.outcomes) for group in groups)
    shades = " Grey: no GNSS fix. Yellow: a fault of a sensor." if outages_of(result) or faults_of(result) else ""
    of_error = (
        "Full line: median; band: 5th to 95th percentile; dashed: 1 sigma as claimed, median."
        if len(groups) <= MOST_COLUMNS
        else "Each line is the median of one combination."
    )
    made = {
        "errors": Drawn(f"Errors over {runs} runs. {of_error}{shades}", _errors(result, groups)),
        "nees": Drawn(
            f"NEES per degree of freedom, mean over {runs} runs: each line is one combination. Green band: where it is"
            f" at 95 % of all instants if the covariance is right.{shades}",
            _nees(result, groups, runs),
        ),
    }
    caption = (
        f"Largest error of each run. Box: quartiles and median; whiskers: {WHISKERS[0]}th and {WHISKERS[1]}th"
        " percentile, between runs where need be; dots: the runs."
    )
    keys = list(result.combinations[0].values)
    for key in keys:
        made[_distribution_of(key)] = Drawn(caption, _distribution(result, key, lambda c, key=key: c.values[key]))  # type: ignore[misc]
    if not keys:
        made[DISTRIBUTION] = Drawn(caption, _distribution(result, "", lambda _: "all runs"))
    return made


def files(keys: Iterable[str]) -> list[str]:
    """The files that figures of a campaign with these varied keys may go to."""
    return [f"{name}.png" for name in ("errors", "nees", DISTRIBUTION, *map(_distribution_of, keys))]


def _distribution_of(key: str) -> str:
    return f"{DISTRIBUTION}_" + re.sub(r"\W+", "_", key).strip("_")


# --- numbers


def nees_bounds(runs: npt.ArrayLike) -> Array:
    """Two-sided 95 % bounds (2, ...) of the mean position NEES per degree of freedom over ``runs`` independent runs."""
    from scipy.stats import chi2

    dof = NEES_DOF * np.asarray(runs, dtype=float)
    bounds: Array = np.array([chi2.ppf(p, dof) / dof for p in CONFIDENCE])
    return bounds


def nees_mean(outcomes: Sequence[Outcome], estimator: str) -> tuple[Array, npt.NDArray[np.int64]]:
    """NEES per degree of freedom over time, mean over the runs that have one, and how many these are."""
    nees = stacked(outcomes, f"{estimator}.nees")
    runs = np.isfinite(nees).sum(axis=0)
    return np.where(runs > 0, np.nansum(nees, axis=0) / np.maximum(runs, 1), np.nan), runs


def stacked(outcomes: Sequence[Outcome], name: str) -> Array:
    """One row per run, NaN after its end: a motion that ends by itself ends sooner in some gusts than in others."""
    rows = [outcome.history[name] for outcome in outcomes]
    longest = max(map(len, rows))
    return np.array([np.pad(row, (0, longest - len(row)), constant_values=np.nan) for row in rows])


def longest_of(outcomes: Sequence[Outcome]) -> Mapping[str, Array]:
    """History of the run that lasted longest; all have the same times as far as they go."""
    return max((outcome.history for outcome in outcomes), key=lambda history: len(history["time"]))


def groups_of(result: CampaignResult) -> Iterator[Group]:
    """Every combination that has any outcomes."""
    import matplotlib

    scale = matplotlib.colormaps["viridis"]
    for i, combination in enumerate(result.combinations):
        own = [outcome for outcome in result.outcomes if outcome.combination == i]
        if own:
            yield Group(str(combination), scale(0.9 * i / max(len(result.combinations) - 1, 1)), own)


def outages_of(result: CampaignResult) -> list[tuple[float, float]]:
    """Windows without a fix, when they are the same in all runs."""
    longest = longest_of(result.outcomes)
    time, outage = longest["time"], longest["outage"]
    if not all(np.array_equal(o.history["outage"], outage[: len(o.history["outage"])]) for o in result.outcomes):
        return []
    edges = np.flatnonzero(np.diff(outage, prepend=0.0, append=0.0))
    times = np.append(time, time[-1])
    return [(float(times[start]), float(times[end])) for start, end in edges.reshape(-1, 2)]


def faults_of(result: CampaignResult) -> list[tuple[float, float]]:
    """Windows of faults, when they are the same in all combinations."""
    windows = [[fault.window for fault in combination.scenario.fault] for combination in result.combinations]
    return list(windows[0]) if all(own == windows[0] for own in windows) else []


# --- drawing


def _panels(result: CampaignResult, columns: int = 1) -> Sheet:
    """Panels (estimators, columns), each row under the name of its estimator."""
    estimators = result.combinations[0].scenario.estimator
    drawn = style.sheet(len(estimators), columns, height=2.2, gap=0.4)
    for row, estimator in zip(drawn.axes, estimators, strict=True):
        row[0].set_title(estimator.name, loc="left", fontsize=10)
    return drawn


def _against_time(result: CampaignResult, drawn: Sheet, title: float) -> None:
    """Shade outages and faults, and explain everything in one legend."""
    outages, faults = outages_of(result), faults_of(result)
    end = float(longest_of(result.outcomes)["time"][-1])
    keys = style.keys_of(drawn.axes.flat)
    for ax in drawn.axes.flat:
        style.shade(ax, outages, style.SHADE, end)
        style.shade(ax, faults, style.FAULT, end)
    for ax in drawn.axes[-1]:
        ax.set_xlabel("time [s]")
    keys |= {"no GNSS fix": style.patch(style.SHADE)} if outages else {}
    keys |= {"fault of a sensor": style.patch(style.FAULT)} if faults else {}
    drawn.legend(keys, title)


def _errors(result: CampaignResult, groups: Sequence[Group]) -> Figure:
    """Median, 5 to 95 % and claimed sigma; a column for each of a few combinations, medians alone for many."""
    apart = len(groups) <= MOST_COLUMNS
    drawn = _panels(result, len(groups) if apart else 1)
    named = apart and any(group.label for group in groups)
    for ax, group in zip(drawn.axes[0], groups if named else (), strict=False):
        ax.set_title(group.label, loc="right", fontsize=9)
    for k, (row, estimator) in enumerate(zip(drawn.axes, result.combinations[0].scenario.estimator, strict=True)):
        for i, group in enumerate(groups):
            colour = style.line_of(k)["color"] if apart else group.colour
            _envelope(row[i if apart else 0], estimator.name, group, colour, apart)
        row[0].set_ylabel("roll, pitch error [deg]" if estimator.attitude_only else "horizontal error [m]")
        low, high = np.transpose([ax.get_ylim() for ax in row])
        for ax in row:
            style.logarithmic(ax, float(low.min()), float(high.max()))
    _against_time(result, drawn, 0.5 if named else 0.28)
    return drawn.figure


def _envelope(ax: Axes, estimator: str, group: Group, colour: Any, apart: bool) -> None:
    """Errors of one estimator over the runs of one combination."""
    error = stacked(group.outcomes, f"{estimator}.error")
    known = np.flatnonzero(np.isfinite(error).any(axis=0))
    time, error = longest_of(group.outcomes)["time"][known], error[:, known]
    ax.set_yscale("log")
    if not len(known):
        return
    low, median, high = np.nanpercentile(error, (5, 50, 95), axis=0)
    ax.plot(time, median, color=colour, lw=1.4, label="median" if apart else group.label)
    if apart:
        claimed = median_of(stacked(group.outcomes, f"{estimator}.sigma")[:, known])
        ax.fill_between(time, low, high, color=colour, alpha=0.25, lw=0, label="5 – 95 %")
        ax.plot(time, claimed, color=style.GUIDE, lw=1.0, ls="--", label="claimed 1 sigma, median")


def median_of(values: Array) -> Array:
    """Over the runs (N, …) that have a number; NaN where none has, as of an estimator that claims no covariance."""
    known = np.isfinite(values).any(axis=0)
    return np.where(known, np.nanmedian(np.where(known, values, 0.0), axis=0), np.nan)


def _nees(result: CampaignResult, groups: Sequence[Group], runs: int) -> Figure:
    """NEES of each estimator, a line for each combination, and its bounds."""
    drawn = _panels(result)
    low, high = nees_bounds(runs)
    for k, (ax, estimator) in enumerate(zip(drawn.axes[:, 0], result.combinations[0].scenario.estimator, strict=True)):
        ax.axhspan(low, high, color=style.CONSISTENT, lw=0, label="95 % bounds", zorder=0.2)
        ax.axhline(1.0, color=style.GUIDE, lw=0.8, zorder=1.5)
        for rank, group in enumerate(groups):
            mean, _ = nees_mean(group.outcomes, estimator.name)
            colour = style.line_of(k)["color"] if len(groups) == 1 else group.colour
            told = {"color": colour, "label": group.label if len(groups) > 1 else None}
            ax.plot(longest_of(group.outcomes)["time"], mean, **told, **style.layer(rank, len(groups), 1.0))
        ax.set_ylabel(f"{'attitude' if estimator.attitude_only else 'position'} NEES / dof")
        style.logarithmic(ax, 0.1, 10.0)
    _against_time(result, drawn, 0.28)
    return drawn.figure


def _distribution(result: CampaignResult, key: str, value_of: Callable[[Combination], str]) -> Figure:
    """A panel for each estimator: a box of one metric per value, with every run as a dot."""
    denied = any(".outage_" in name for o in result.outcomes for name in o.metrics)
    values = list(dict.fromkeys(value_of(c) for c in result.combinations))
    drawn = _panels(result)
    for k, (ax, estimator) in enumerate(zip(drawn.axes[:, 0], result.combinations[0].scenario.estimator, strict=True)):
        metric = "roll_pitch_max_deg" if estimator.attitude_only else "position_horizontal_max_m"
        metric = f"{estimator.name}.outage_{metric}" if denied else f"{estimator.name}.{metric}"
        found: dict[str, list[float]] = {value: [] for value in values}
        for o in result.outcomes:
            if metric in o.metrics:
                found[value_of(result.combinations[o.combination])].append(o.metrics[metric])
        _boxes(ax, list(found.values()), style.line_of(k)["color"])
        of = "roll, pitch [deg]" if estimator.attitude_only else "horizontal [m]"
        ax.set_ylabel(f"largest error{' in outage' if denied else ''},\n{of}")
    crowded = style.CHARACTER * sum(len(value) + 3 for value in values) > style.WIDTH - 2
    drawn.axes[-1, 0].set_xticks(
        range(len(values)), values, rotation=30 if crowded else 0, fontsize=8 if crowded else 10
    )
    drawn.axes[-1, 0].set_xlim(-0.6, len(values) - 0.4)
    drawn.axes[-1, 0].set_xlabel(key)
    drawn.legend({}, 0.28)
    return drawn.figure


def _boxes(ax: Axes, samples: Sequence[Sequence[float]], colour: str) -> None:
    """A box for each sample that is not empty, at 0, 1, ..."""
    for x, errors in enumerate(samples):
        if not errors:
            continue
        low, q1, median, q3, high = np.percentile(errors, (WHISKERS[0], 25, 50, 75, WHISKERS[1]))
        box = {"whislo": low, "q1": q1, "med": median, "q3": q3, "whishi": high}
        ax.bxp([box], positions=[x], widths=0.5, showfliers=False, medianprops={"color": colour, "linewidth": 2})
        ax.plot(x + np.linspace(-0.15, 0.15, len(errors)), errors, "o", color=style.GUIDE, ms=3, alpha=0.6)
    known = [error for errors in samples for error in errors]
    if known and max(known) > LINEAR_UP_TO * min(known):
        style.logarithmic(ax)
    else:
        ax.set_ylim(bottom=0.0)
