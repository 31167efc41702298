"""What a campaign's page shows that can be looked around in: errors and NEES of all runs over time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.report import campaign_figures as figures
from testbed.report import interactive

if TYPE_CHECKING:
    from testbed.many.campaign import CampaignResult
    from testbed.report.campaign_figures import Group
    from testbed.report.interactive import Arrays

ALL = "all runs"  # of a campaign that varies nothing
LEAST = 1e-6  # on a logarithmic axis


def contents(result: CampaignResult) -> dict[str, Any]:
    """Plain data of it, for `interactive.script`; the legend switches combinations of what is varied."""
    groups = list(figures.groups_of(result))
    time = figures.longest_of(result.outcomes)["time"]
    arrays = interactive.Arrays(len(groups))
    chapters = [
        {
            "title": "Errors over the runs",
            "note": "Line: median; band: 5th to 95th percentile; dashed: 1 sigma as claimed, median.",
            "panels": list(_errors(result, groups, arrays)),
        },
        {
            "title": "NEES over the runs",
            "note": "Per degree of freedom, mean over the runs. Green: where it is at 95 % of all instants if the"
            " covariance is right.",
            "panels": list(_nees(result, groups, arrays)),
        },
    ]
    names = [group.label or ALL for group in groups]
    reach = float(time[0]), max(float(time[-1]), float(time[0]) + 1e-3)
    return interactive.over_time("time [s]", reach, names, "5 – 95 %") | {
        "windows": [list(window) for window in figures.outages_of(result)],
        "faults": [
            {"start": start, "end": min(end, reach[1]), "sensor": None, "text": "fault of a sensor"}
            for start, end in figures.faults_of(result)
        ],
        "chapters": [chapter for chapter in chapters if chapter["panels"]],
        "numbers": arrays.text(),
    }


def _errors(result: CampaignResult, groups: Sequence[Group], arrays: Arrays) -> Iterator[dict[str, Any]]:
    for estimator in result.combinations[0].scenario.estimator:
        lines: list[dict[str, Any]] = []
        for k, group in enumerate(groups):
            error = figures.stacked(group.outcomes, f"{estimator.name}.error")
            known = np.flatnonzero(np.isfinite(error).any(axis=0))
            if not len(known):
                continue
            known = known[arrays.stride(len(known))]
            low, median, high = np.maximum(np.nanpercentile(error[:, known], (5, 50, 95), axis=0), LEAST)
            sigma = figures.stacked(group.outcomes, f"{estimator.name}.sigma")[:, known]
            claimed = np.maximum(figures.median_of(sigma), LEAST)
            t = arrays.add(figures.longest_of(group.outcomes)["time"][known])
            band = {"t": t, "low": arrays.add(low), "high": arrays.add(high)}
            name = group.label or ALL
            lines.append({"of": k, "t": t, "y": arrays.add(median), "band": band, "name": f"{name}, median"})
            lines.append({"of": k, "t": t, "y": arrays.add(claimed), "dashed": True, "name": f"{name}, claimed 1 σ"})
        title, unit = ("roll, pitch error", "deg") if estimator.attitude_only else ("horizontal error", "m")
        if lines:
            yield {"title": f"{estimator.name}: {title}", "unit": unit, "lines": lines, "log": True}


def _nees(result: CampaignResult, groups: Sequence[Group], arrays: Arrays) -> Iterator[dict[str, Any]]:
    bounds = figures.nees_bounds(max(len(group.outcomes) for group in groups)).tolist()
    for estimator in result.combinations[0].scenario.estimator:
        lines = []
        for k, group in enumerate(groups):
            mean, _ = figures.nees_mean(group.outcomes, estimator.name)
            if np.isfinite(mean).any():
                time = figures.longest_of(group.outcomes)["time"]
                lines.append({"of": k, **arrays.line(time, np.maximum(mean, 1e-4))})
        if lines:
            what = f"{'attitude' if estimator.attitude_only else 'position'} NEES / dof"
            more = {"log": True, "bounds": bounds, "level": 1.0}
            yield {"title": f"{estimator.name}: {what}", "unit": "", "lines": lines, **more}
