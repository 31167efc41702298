"""What became of samples, and how faults were detected: looks of an estimator at a sensor, and its alarms."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nav.samples import NO_SENSOR, Array, Outcome
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


def alarmed(weight: Array, outcome: npt.NDArray[Any]) -> Mask:
    """Which samples (N,) were refused, in part at least, because they looked wrong."""
    alarm: Mask = refused(weight, outcome) & (outcome != Outcome.WITHHELD)
    return alarm


def _reports(dataset: xarray.DataTree, estimator: str, aid: str) -> _Reports:
    own = f"estimators/{estimator}/innovations/{aid}"
    outcome, value = column(dataset, f"{own}/outcome"), column(dataset, f"{own}/nis")
    weight = column(dataset, f"{own}/weight")
    used = weight > 0
    alarm = alarmed(weight, outcome)
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


class SensorLooks(NamedTuple):
    """Times (N,) of a sensor's samples, whether any part of one raised an alarm, whether it was not used whole."""

    t: Array
    alarm: Mask
    unused: Mask


def by_sensor(
    t: Array, sensor: npt.NDArray[np.str_], weight: Array, outcome: npt.NDArray[Any]
) -> dict[str, SensorLooks]:
    """Of reports (N,) on the samples of any aids, what became of the samples of each sensor."""
    alarms, used = alarmed(weight, outcome), weight > 0
    result = {}
    for name in np.unique(sensor).tolist():
        mine = sensor == name
        when, row = np.unique(t[mine], return_inverse=True)
        alarm, taken = np.zeros(len(when), bool), np.zeros(len(when), bool)
        np.logical_or.at(alarm, row, alarms[mine])
        np.logical_or.at(taken, row, used[mine])
        result[name] = SensorLooks(when, alarm, ~taken | alarm)
    return result


def taken(dataset: xarray.DataTree, estimator: str) -> set[str]:
    """The sensors whose samples an estimator takes, the unit that it integrates among them."""
    imus = json.loads(dataset.attrs.get("estimator_imus", "{}"))
    return {*_recorded_looks(dataset, estimator), imus.get(estimator, "")}


def _recorded_looks(dataset: xarray.DataTree, estimator: str) -> dict[str, SensorLooks]:
    groups = [f"estimators/{estimator}/innovations/{aid}" for aid in aids(dataset, estimator)]
    if not groups:
        return {}
    t, sensor, weight, outcome = (
        np.concatenate([column(dataset, f"{group}/{name}") for group in groups])
        for name in ("sample_time", "sensor", "weight", "outcome")
    )
    looks = by_sensor(t, sensor.astype(str), weight, outcome)
    looks.pop(NO_SENSOR, None)  # what is known without a sample is no sensor that could be isolated by mistake
    return looks


class FaultScore(NamedTuple):
    """How a fault was detected, None when nobody looked; whether its sensor was isolated, by a sustained alarm and more
    alarms than any healthy one has; and from when on an alarm is the next fault's of the same sensor [s].
    """

    detection: DetectionScore | None
    isolated: bool
    until: float


def score_faults(every: Sequence[FaultTruth], looks: Mapping[str, SensorLooks]) -> list[FaultScore]:
    """A score of each fault, from what became of the samples of each sensor."""
    found = []
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
        at_fault = {other.sensor for other in every if other.start < fault.end and other.end > fault.start}
        others = [detection(t, alarm, window) for name, (t, alarm, _) in looks.items() if name not in at_fault]
        most = max((other.coverage for other in others if other is not None), default=0.0)
        isolated = score is not None and np.isfinite(score.sustained_delay) and score.coverage > most
        found.append(FaultScore(score, bool(isolated), until))
    return found


def fault_scores(dataset: xarray.DataTree, estimator: str, e: Errors) -> tuple[dict[str, float], list[Window]]:
    """Scores of all faults, and the spans of time in which an alarm may be theirs."""
    every = faults(dataset)
    looks = _recorded_looks(dataset, estimator) if every else {}
    result: dict[str, float] = {}
    spans: list[Window] = []
    for fault, (score, isolated, until) in zip(every, score_faults(every, looks), strict=True):
        if score is None:
            spans.append(fault_window(fault))
            continue
        ceased = until if np.isnan(score.end_lag) else fault.end + score.end_lag
        spans.append((fault.start, ceased + RECOVERY_WINDOW_S))
        scored = {
            "detection_delay_s": score.delay,
            "end_lag_s": score.end_lag,
            "coverage": score.coverage,
            "missed": score.missed,
            "isolation_correct": isolated,
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
