"""What a run has to tell: denial and reacquisition, silence, refusals, alignment, legs, faults, an early end."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from nav.columns import Samples
from nav.samples import GnssSample, Sample, UpdateReport, has_fix
from testbed.motion.logged import LogTruth
from testbed.motion.table import ON_GROUND, OUTSIDE
from testbed.scenario import Scenario
from testbed.sensors.faults import FaultTruth
from testbed.sensors.imu import ImuConfig
from testbed.sensors.timing import patience

REFUSALS = 10  # of an aid in a row, before it is worth an event, and its sensor is held for failed
Emit: TypeAlias = Callable[[float, str, str], None]  # time [s], severity, text

BAD_SAMPLE_QUIET_S = 10.0  # a sensor that keeps delivering nonsense is reported once per this time


@dataclass(slots=True)
class EventWatch:
    """Turns changes in samples, reports, estimates and legs into events."""

    emit: Emit
    faults: Sequence[FaultTruth] = ()
    patience: dict[str, float] = field(default_factory=dict)  # how long an aiding sensor may say nothing
    heard: dict[str, float] = field(default_factory=dict)  # when it last did, or at first should
    silent: set[str] = field(default_factory=set)
    fix: dict[str, bool] = field(default_factory=dict)
    aligned: dict[str, bool] = field(default_factory=dict)
    refusals: dict[tuple[str, str], int] = field(default_factory=dict)  # in a row
    unsound: dict[tuple[str, str], float] = field(default_factory=dict)  # when last reported
    leg: float = OUTSIDE
    t: float = -math.inf

    @classmethod
    def of(cls, emit: Emit, faults: Sequence[FaultTruth], scenario: Scenario) -> EventWatch:
        """The watch over the sensors of a scenario."""
        aiding = {name: one for name, one in scenario.sensors.items() if not isinstance(one, ImuConfig)}
        return cls(
            emit,
            faults,
            {name: patience(one.rate_hz) for name, one in aiding.items()},
            {name: one.offset_s + one.latency_s for name, one in aiding.items()},
        )

    @property
    def denied(self) -> bool:
        """Whether no GNSS receiver has a fix, or says so; one that has said nothing yet doesn't count."""
        return bool(self.fix) and not any(has and name not in self.silent for name, has in self.fix.items())

    def sample(self, t: float, samples: Sequence[Sample], which: int) -> None:
        """One of several samples of a sensor has arrived at ``t``: it may end a silence or a denial, or begin one."""
        sensor = samples.sensor if isinstance(samples, Samples) else samples[which].sensor
        if sensor in self.silent:
            self.silent.remove(sensor)
            self.emit(t, "info", f"{sensor} heard again")
        self.heard[sensor] = t
        fixed = _fixed(samples, which)
        if fixed is None:
            return
        if self.fix.get(sensor, fixed) != fixed:
            severity, what = ("info", "reacquired") if fixed else ("warning", "denied")
            self.emit(samples[which].t, severity, f"{sensor} {what}")
        self.fix[sensor] = fixed

    @property
    def heeds_fused(self) -> bool:
        """Whether a report on a sample that was simply fused may be an event: the end of refusals."""
        return bool(self.refusals)

    def report(self, estimator: str, report: UpdateReport) -> None:
        """An unsound sample is an event; the gate turns a sound one away now and then, so only a run of those is."""
        if report.weight > 0.0 and not self.heeds_fused:
            return  # as most are: nothing ends by it
        what = report.aid if report.aid.startswith(report.sensor) else f"{report.aid} of {report.sensor}"
        key = (estimator, what)
        if report.weight > 0.0:
            if self.refusals.pop(key, 0) >= REFUSALS:
                self.emit(report.t, "info", f"{estimator}: {what} accepted again")
        elif math.isnan(report.nis):
            key = (estimator, report.sensor)  # a sample may serve several aids
            if report.t - self.unsound.get(key, -BAD_SAMPLE_QUIET_S) >= BAD_SAMPLE_QUIET_S:
                self.emit(report.t, "warning", f"{estimator}: {report.sensor} refused, {report.reason}")
                self.unsound[key] = report.t
        else:
            self.refusals[key] = self.refusals.get(key, 0) + 1
            if self.refusals[key] == REFUSALS:
                text = f"{estimator}: {what} refused {REFUSALS} times in a row, {report.reason}"
                self.emit(report.t, "warning", text)

    def estimate(self, estimator: str, t: float, aligned: bool) -> None:
        """An estimator may have aligned."""
        if aligned and not self.aligned.get(estimator, False):
            self.emit(t, "info", f"{estimator} aligned")
        self.aligned[estimator] = aligned

    def row(self, t: float, leg: float, plan: Sequence[str]) -> None:
        """The run has come to ``t``: a leg may have begun, a sensor be overdue, a fault begin or end."""
        if self.leg == ON_GROUND and leg != ON_GROUND:
            self.emit(t, "info", "launch")
        if leg != self.leg and 0 <= leg < len(plan):
            self.emit(t, "info", f"leg {int(leg) + 1}/{len(plan)} {plan[int(leg)]}")
        self.leg = leg
        for name, most in self.patience.items():
            if name not in self.silent and t > self.heard[name] + most:
                self.silent.add(name)
                self.emit(t, "warning", f"{name} silent")
        if self.faults:
            self._edges(t)
        self.t = t

    def _edges(self, t: float) -> None:
        """Faults that have begun or ended since the row before."""
        edges = [(one.start, "begins", one) for one in self.faults] + [(one.end, "ends", one) for one in self.faults]
        for when, what, one in sorted(edges, key=lambda edge: edge[0]):
            if self.t < when <= t:
                self.emit(when, "info", f"fault {one.name} {what}: {one}")


def _fixed(samples: Sequence[Sample], which: int) -> bool | None:
    """Whether one of several samples of a sensor is a fix, None where that is no receiver."""
    if isinstance(samples, Samples):
        return bool(has_fix(samples.columns["fix_type"][which])) if samples.kind is GnssSample else None
    sample = samples[which]
    return sample.has_fix if isinstance(sample, GnssSample) else None


def legs_unflown(scenario: Scenario, leg: float) -> str:
    """Which legs of the plan a run that ends in leg ``leg``, counted from 0, never came to; empty when none.

    Who flies from outside has a plan of its own, of which nothing is known here.
    """
    if leg == OUTSIDE:
        return ""
    names = [one.leg.replace("_", " ") for one in scenario.plan]
    missed = [f"{number}/{len(names)} {name}" for number, name in enumerate(names, 1) if number > max(leg, -1) + 1]
    if not missed:
        return ""
    what = f"leg {missed[0]} was" if len(missed) == 1 else f"legs {', '.join(missed)} were"
    where = f"in leg {leg + 1:.0f} {names[int(leg)]}" if leg >= 0 else "before the first"
    return f"{what} never flown: the run ended {where}"


def plan_flown(scenario: Scenario, end: float) -> tuple[str, str]:
    """Severity and text of a plan that ended before the run; a denial that it never reached is worth a warning."""
    over = "the log is over" if isinstance(scenario.truth, LogTruth) else "plan flown"
    text = f"{over}: the run ends at {end:.0f} s of {scenario.duration_s:g} s"
    missed = [
        f"{name} denied from {window[0]:g} s"
        for name, config in scenario.sensors.items()
        for window in getattr(config, "denied", ())
        if window[0] >= end
    ]
    missed += [
        f"fault of {fault.sensor} from {fault.window[0]:g} s" for fault in scenario.fault if fault.window[0] >= end
    ]
    return ("warning", f"{text}, before {', '.join(missed)}") if missed else ("info", text)
