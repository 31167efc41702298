"""What became of samples, and how faults were detected: looks of an estimator at a sensor, and its alarms."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from nav.samples import Array, Outcome
from testbed.score.accuracy import (
    RECOVERY_WINDOW_S,
    SAME_TIME_S,
    Errors,
    Mask,
    Window,
    aids,
    column,
    inside,
    worst_over_3sigma,
)
from testbed.sensors.faults import FaultTruth

if TYPE_CHECKING:
    import xarray

SUSTAINED_S = 2.0  # for how long an alarm has to go on to be a sustained one,
SUSTAINED_SHARE = 0.8  # and at how many of the looks


@dataclass(frozen=True, slots=True)
class _Reports:
    """What became of the samples of one aid, or of one sensor, each (N,).

    ``used``, in part at least; ``gated`` refused by the gate; ``alarm`` refused, in part at least, because the sample
    looked wrong; ``judged`` used or refused for its innovation.
    """

    t: Array
    sensor: npt.NDArray[np.str_]
    nis: Array
    used: Mask
    gated: Mask
    alarm: Mask
    judged: Mask


def refused(weight: Array, outcome: npt.NDArray[Any]) -> Mask:
    """Which samples (N,) were not used, or not with every axis."""
    return (weight <= 0) | np.isin(outcome, (Outcome.OUTSIDE_GATE, Outcome.ISOLATED))


def _reports(dataset: xarray.DataTree, estimator: str, aid: str) -> _Reports:
    own = f"estimators/{estimator}/innovations/{aid}"
    outcome, value = column(dataset, f"{own}/outcome"), column(dataset, f"{own}/nis")
    weight = column(dataset, f"{own}/weight")
    used = weight > 0
    alarm = refused(weight, outcome) & (outcome != Outcome.WITHHELD)
    return _Reports(
        t=column(dataset, f"{own}/sample_time"),
        sensor=column(dataset, f"{own}/sensor").astype(str),
        nis=value,
        used=used,
        gated=outcome == Outcome.OUTSIDE_GATE,
        alarm=alarm,
        judged=(used | alarm) & np.isfinite(value),  # an unsound sample has no innovation
    )


@dataclass(frozen=True, slots=True)
class Judged:
    """Samples that the gate judged: times (N,) [s], NIS (N,), whether it refused them (N,), components of each.

    ``components`` is 0 for the parity of redundant units, which has no innovation.
    """

    t: Array
    nis: Array
    gated: Mask
    components: int


def judged(dataset: xarray.DataTree, estimator: str, aid: str) -> Judged:
    """What the gate of one aid judged, whether it let it pass or not."""
    reports = _reports(dataset, estimator, aid)
    rows = (reports.used & ~reports.alarm | reports.gated) & np.isfinite(reports.nis)
    own = dataset[f"estimators/{estimator}/innovations/{aid}"]
    components = own["innovation"].shape[1] if "innovation" in own else 0
    return Judged(reports.t[rows], reports.nis[rows], reports.gated[rows], components)


def innovation_scores(dataset: xarray.DataTree, estimator: str, aid: str, start: float) -> dict[str, float]:
    """Mean NIS and share refused of what the gate of one aid judged from ``start`` [s] on."""
    looks = judged(dataset, estimator, aid)
    rows = looks.t >= start
    if not rows.any() or not looks.components:
        return {}
    return {
        f"nis_mean.{aid}": float(looks.nis[rows].mean() / looks.components),
        f"rejected_fraction.{aid}": float(np.mean(looks.gated[rows])),
    }


@dataclass(frozen=True, slots=True)
class DetectionScore:
    """How one fault was detected; times in seconds, NaN where it was not.

    ``delay`` from its beginning to the first alarm; ``sustained_delay`` to the first alarm from which on, for
    `SUSTAINED_S` or to the end, `SUSTAINED_SHARE` of the looks are alarms; ``coverage`` share of the looks in the
    window that are alarms; ``end_lag`` from its end to the first look without alarm.
    """

    delay: float
    sustained_delay: float
    coverage: float
    end_lag: float

    @property
    def missed(self) -> bool:
        """Whether there was no alarm in the window."""
        return self.coverage == 0.0


def detection(t: Array, alarm: Mask, window: Window, until: float = np.inf) -> DetectionScore | None:
    """Score of alarms (N,) at looks (N,) [s], ascending, on a fault in ``window`` [start, end).

    ``until`` is when the next fault of the same sensor begins: an alarm from then on belongs to that. None when nobody
    looked during the fault.
    """
    start, end = window[0] - SAME_TIME_S, window[1] - SAME_TIME_S
    during = (t >= start) & (t < end)
    if not during.any():
        return None
    looked, alarmed = t[during], alarm[during]
    after = (t >= end) & (t < until) & ~alarm
    total = np.append(0, np.cumsum(alarmed))
    stop = np.searchsorted(looked, looked + SUSTAINED_S - SAME_TIME_S)
    here = np.arange(len(looked))
    sustained = alarmed & (total[stop] - total[here] >= SUSTAINED_SHARE * (stop - here))

    def first(when: Array, since: float) -> float:
        return max(float(when[0]) - since, 0.0) if len(when) else np.nan

    return DetectionScore(
        delay=first(looked[alarmed], window[0]),
        sustained_delay=first(looked[sustained], window[0]),
        coverage=float(alarmed.mean()),
        end_lag=first(t[after], window[1]),
    )


def faults(dataset: xarray.DataTree) -> list[FaultTruth]:
    """What was made to go wrong in a run."""
    if "faults" not in dataset.children:
        return []
    own = [column(dataset, f"faults/{'time' if f.name == 'start' else f.name}").tolist() for f in fields(FaultTruth)]
    return [FaultTruth(*row) for row in zip(*own, strict=True)]


def fault_window(fault: FaultTruth) -> Window:
    """From the beginning of a fault to `RECOVERY_WINDOW_S` after its end [s]."""
    return fault.start, fault.end + RECOVERY_WINDOW_S


def _by_sensor(dataset: xarray.DataTree, estimator: str) -> dict[str, tuple[Array, Mask, Mask]]:
    """Times of the samples of each sensor, whether any part of one raised an alarm, whether it was not used whole."""
    found = [_reports(dataset, estimator, aid) for aid in aids(dataset, estimator)]
    result = {}
    for sensor in dict.fromkeys(name for reports in found for name in np.unique(reports.sensor).tolist()):
        own = [(reports, reports.sensor == sensor) for reports in found]
        t, row = np.unique(np.concatenate([reports.t[mine] for reports, mine in own]), return_inverse=True)
        alarm, used = np.zeros(len(t), bool), np.zeros(len(t), bool)
        np.logical_or.at(alarm, row, np.concatenate([reports.alarm[mine] for reports, mine in own]))
        np.logical_or.at(used, row, np.concatenate([reports.used[mine] for reports, mine in own]))
        result[sensor] = (t, alarm, ~used | alarm)
    return result


def fault_scores(dataset: xarray.DataTree, estimator: str, e: Errors) -> tuple[dict[str, float], list[Window]]:
    """Scores of all faults, and the spans of time in which an alarm may be theirs."""
    every = faults(dataset)
    looks = _by_sensor(dataset, estimator) if every else {}
    result: dict[str, float] = {}
    spans: list[Window] = []
    for fault in every:
        window, score = (fault.start, fault.end), None
        # From when on an alarm is another fault's of the same sensor.
        until = min(
            (max(o.start, fault.end) for o in every if o.sensor == fault.sensor and o.end > fault.end), default=np.inf
        )
        if fault.sensor in looks:
            t, alarm, unused = looks[fault.sensor]
            # What was refused as faulty may be on probation before it is used again.
            score = detection(t, alarm | unused & (t >= fault.end - SAME_TIME_S), window, until)
        if score is None:
            spans.append(fault_window(fault))
            continue
        ceased = until if np.isnan(score.end_lag) else fault.end + score.end_lag
        spans.append((fault.start, ceased + RECOVERY_WINDOW_S))
        at_fault = {other.sensor for other in every if other.start < fault.end and other.end > fault.start}
        others = [detection(t, alarm, window) for name, (t, alarm, _) in looks.items() if name not in at_fault]
        most = max((other.coverage for other in others if other is not None), default=0.0)
        scored = {
            "detection_delay_s": score.delay,
            "end_lag_s": score.end_lag,
            "coverage": score.coverage,
            "missed": score.missed,
            "isolation_correct": score.coverage > most,
        }
        result |= {f"{key}.{fault.name}": value for key, value in scored.items() if np.isfinite(value)}
        if not e.attitude_only:
            result |= worst_over_3sigma(
                e, e.valid & inside(e.t, [fault_window(fault)]), f"error_over_3sigma.{fault.name}"
            )
    return result, spans


def false_alarms(dataset: xarray.DataTree, estimator: str, e: Errors, troubled: list[Window]) -> dict[str, float]:
    """Innovations refused though all was well, of those judged and per hour of healthy time with GNSS fix."""
    counted = e.t[e.valid & ~inside(e.t, troubled)]
    if not len(counted):
        return {}
    alarms = looks = 0
    for aid in aids(dataset, estimator):
        reports = _reports(dataset, estimator, aid)
        healthy = reports.judged & (reports.t >= counted[0]) & ~inside(reports.t, troubled)
        alarms += int(np.sum(healthy & reports.alarm))
        looks += int(healthy.sum())
    hours = len(counted) / (3600.0 * float(dataset.attrs["record_rate_hz"]))
    return {"false_alarms_per_h": alarms / hours} | ({"false_alarms_per_look": alarms / looks} if looks else {})
