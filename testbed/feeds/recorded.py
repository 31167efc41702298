"""The recorded feed: a log's samples in place of simulated ones; denial, jammers and faults act on them all alike."""

from __future__ import annotations

import json
import math
from bisect import bisect_right
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from nav.samples import Array, GnssSample, ImuSamples, Sample
from testbed.errors import UserError
from testbed.feeds import formats
from testbed.feeds.doubted import mounted
from testbed.feeds.feed import Turn
from testbed.feeds.lateness import Late, late_by_imu, latency, velocity_lag
from testbed.feeds.log import LONGEST_WAIT_S, SAMPLES, Log, Reference
from testbed.feeds.mistaken import mistaken
from testbed.feeds.reference import ReferenceMotion, is_flown, of_receiver, silence, with_rates
from testbed.feeds.samples import Fixes
from testbed.feeds.scatter import misjudged
from testbed.feeds.stamps import Loss, at_times, begun, bridged
from testbed.feeds.survey import usual_step
from testbed.motion.logged import LogTruth, Place
from testbed.motion.table import MotionSource
from testbed.scenario import Scenario
from testbed.sensors import SensorConfig
from testbed.sensors.faults import Faults
from testbed.sensors.gnss import REPORTED_AT_LEAST, GnssConfig, Reception, without_fix
from testbed.sensors.imu import ImuConfig
from testbed.sensors.timing import InterruptedTiming, outside

EDGE_S = 1e-6  # a sample this close to a row comes with it
DIGITS = 3  # of a rate that is found
FASTEST_HZ = 10_000.0  # of any sensor
SLOWEST_IMU_HZ = 5.0
ALIKE = 0.1  # of a rate, by which those of units that are meant to report together are measured otherwise
OTHER_CLOCK_S = 0.5  # by which a receiver is late otherwise than is told
NOBODY = Reference("none: nothing is judged", np.empty(0), {})


def located(scenario: Scenario) -> Scenario:
    """A scenario of a log with what only the log can tell: where it begins, and the rates that it doesn't give.

    Raises UserError when the log can't be read, or has not the sensors that the scenario asks for.
    """
    if not isinstance(scenario.truth, LogTruth):
        return scenario
    log = formats.open_log(scenario.truth)
    _require_sensors(scenario, log, scenario.truth.start_s)
    found: dict[str, Any] = {}
    if scenario.truth.start is None:
        found["truth.start"] = (log.start or first_place(log, scenario.truth.start_s)).model_dump()
    for name, section in scenario.sensors.items():
        if "rate_hz" not in section.model_fields_set:
            found[f"sensors.{name}.rate_hz"] = rate(log, name)
    for estimator in scenario.estimator:  # spares are given at the times of the unit that they stand in for
        for spare in estimator.spare_imus:
            own, first = (found.get(f"sensors.{name}.rate_hz", math.nan) for name in (spare, estimator.imu))
            if abs(own - first) < ALIKE * first:
                found[f"sensors.{spare}.rate_hz"] = first
    return scenario.changed(found) if found else scenario


def rate(log: Log, name: str) -> float:
    """How often a sensor of a log reports [Hz], to `DIGITS` digits."""
    t = log.imus[name].t if name in log.imus else np.array([one.t for one in log.samples[name]])
    usual = usual_step(t) if len(t) > 1 and t[-1] > t[0] else 1.0
    return float(f"{1 / usual:.{DIGITS}g}")


def _require_sensors(scenario: Scenario, log: Log, start_s: float) -> None:
    """Raise UserError when a sensor of the scenario is not in its log, of another kind, or over by ``start_s``."""
    for name, section in scenario.sensors.items():
        kind = section.kind
        there = log.imus.get(name) if kind == "imu" else log.samples.get(name)
        if there is not None and not len(there):
            why = "; ".join(note for note in log.notes if note.startswith(f"{name}:"))
            raise UserError(f"sensors.{name}: of {log.path} none of its samples can be used{why and ': ' + why}")
        if there is None:
            known = ", ".join(log.names)
            raise UserError(f"sensors.{name}: {log.path} has no {kind} of that name: it has {known}")
        if kind != "imu" and not isinstance(there[0], SAMPLES.get(kind, object)):  # type: ignore[index]
            raise UserError(f"sensors.{name}: {log.path} has something else than a {kind} under that name")
        if isinstance(there, ImuSamples):
            _require_near(log, name, there, start_s)
        if kind == "imu" and there.t[-1] <= log.t0 + start_s:  # type: ignore[union-attr]
            lasts = f"it lasts {there.t[-1] - log.t0:.1f} s"  # type: ignore[union-attr]
            raise UserError(f"truth.start_s: {name} of {log.path} is over by then: {lasts}")
        if kind == "imu" and rate(log, name) < SLOWEST_IMU_HZ:
            slow = f"reports {rate(log, name):g} times a second: at least {SLOWEST_IMU_HZ:g} are needed"
            raise UserError(f"sensors.{name}: the IMU of {log.path} {slow}")
        if "rate_hz" not in section.model_fields_set and (often := rate(log, name)) > FASTEST_HZ:
            raise UserError(f"sensors.{name}: {log.path} has {often:g} samples a second: is the unit of its time so?")


def _require_near(log: Log, name: str, imu: ImuSamples, start_s: float) -> None:
    """Raise UserError when a unit was over before the log begins, or begins long after its first unit: another clock.

    What it did not feel until then, all that time, would be told as unknown, in steps of its own.
    """
    ends = float(next(own.t[-1] for own in log.imus.values() if len(own)))
    if imu.t[-1] < log.t0 or imu.t[0] > max(ends, log.t0 + start_s) + LONGEST_WAIT_S:
        told = f"was heard from {imu.t[0]:.10g} to {imu.t[-1]:.10g} s of a log from {log.t0:.10g} to {ends:.10g} s"
        raise UserError(f"sensors.{name}: {told}: give its time a unit, or an offset, which is added to it")


def first_place(log: Log, start_s: float) -> Place:
    """Where a log begins: by its solution, or else by its GNSS. Raises UserError when it does not say it."""
    solution = log.solution.columns if log.solution is not None else {}
    if log.solution is not None and "lat" in solution:
        known = np.flatnonzero(is_flown(solution["lat"], solution["h"]) & (log.solution.t >= log.t0 + start_s))
        if len(known):
            return _place(*(float(solution[key][known[0]]) for key in ("lat", "lon", "h")))
    for own in log.samples.values():
        for one in own:
            if isinstance(one, GnssSample) and one.has_fix and one.t >= log.t0 + start_s and is_flown(one.lat, one.h):
                return _place(one.lat, one.lon, one.h)
    raise UserError(f"{log.path}: says nowhere where it is: give truth.start with lat_deg, lon_deg and alt_m")


def _place(lat: float, lon: float, h: float) -> Place:
    return Place(lat_deg=math.degrees(lat), lon_deg=math.degrees(lon), alt_m=h)


class Recorded:
    """A log as a feed (`testbed.feeds.feed.Feed`): nothing in it depends on how it is asked for."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        truth = scenario.truth
        assert isinstance(truth, LogTruth)
        log = formats.open_log(truth)
        self.rate_hz = truth.rate_hz
        self.motion_s = 0.0
        self.failure = ""
        self.notes = [*log.notes, *_in_it_already(scenario, log)]
        self._start = log.t0 + truth.start_s
        self._imus = _increments(scenario, log, self._start)
        self._samples = {
            name: _samples_of(section, log, name, self._start)
            for name, section in scenario.sensors.items()
            if not isinstance(section, ImuConfig)
        }
        self._times = {name: [one.t for one in own] for name, own in self._samples.items()}
        rows = self._rows(scenario)
        reference = self._reference(truth, log, scenario.sensors)
        self._motion = ReferenceMotion(reference, truth.rate_hz, rows)
        self.source: MotionSource = self._motion
        self.origin = {
            "reference": reference.name,
            "reference_sigma_n": json.dumps([*reference.sigma_position_n, *reference.sigma_velocity_n]),
            "reference_point_b_m": json.dumps(reference.point_b.tolist()),
            "log": f"{log.path.name} ({log.format})",
        }
        sections = scenario.sensors
        self.receptions = {name: Reception(one) for name, one in sections.items() if isinstance(one, GnssConfig)}
        self._denied = {name: one.denied for name, one in sections.items() if isinstance(one, InterruptedTiming)}
        self.faults = Faults(scenario.fault, sections, seed)
        self._remarked = False
        used = _as_used(log, sections)
        doubt = used.remark if truth.reference == "solution" else ""
        if apart := silence(reference, 0.0, min((rows - 1) / truth.rate_hz, scenario.duration_s)):
            doubt = f"{apart} of the run: nothing is judged by it"
        scattered = [misjudged(one, log.samples[one], sections[one]) for one in self.receptions if one in log.samples]
        lost = _losses(log, [*scenario.sensors, *references(truth)])
        late = [_later(name, section, log, sections) for name, section in sections.items() if name == log.receiver]
        told = [doubt, *mistaken(used), *late, *scattered, *lost]
        self._remark = "; ".join(one for one in told if one)

    def advance(self, ticks: int, wanted: Sequence[int]) -> Turn:
        """The next rows, and what came with them."""
        block = self._motion.advance(ticks)
        if not len(block):
            return Turn(block, {}, {})
        first, last = float(block.t[0]) - 1 / self.rate_hz, float(block.t[-1])
        after = -math.inf if block.tick == 0 else first
        imu = {name: self.faults.apply(name, _cut(own, max(after, 0.0), last)) for name, own in self._imus.items()}
        samples = {name: self.faults.apply(name, self._heard(name, after, last)) for name in self._samples}
        return Turn(block, imu, samples)

    def activity(self) -> str:
        """How far it has come."""
        return self._motion.activity()

    def take_events(self, until: float = math.inf) -> list[tuple[float, str, str]]:
        """What was odd with the log, once."""
        remarked, self._remarked = self._remarked, True
        return [] if remarked else [(0.0, "info", f"log: {note}") for note in self.notes]

    def remark(self) -> str:
        """Whether what errors are against contradicts the receiver, and what much of the log was left out for."""
        return self._remark

    def close(self) -> None:
        """Nothing is held."""

    def _rows(self, scenario: Scenario) -> int:
        """How many rows there can be: estimates go as far as the inertial units do."""
        end = min((float(own.t[-1]) for own in self._imus.values()), default=scenario.duration_s)
        return math.floor(end * self.rate_hz + EDGE_S) + 1

    def _reference(self, truth: LogTruth, log: Log, sections: Mapping[str, SensorConfig]) -> Reference:
        """What is judged against."""
        if truth.reference == "none":
            return NOBODY
        solution = None if log.solution is None else _by_imu(log.solution, log, sections)
        if solution is not None and truth.reference == "solution" and "lat" in solution.columns:
            found = replace(solution, t=solution.t - self._start)
        elif (receiver := log.receiver) is None:
            return NOBODY if solution is None else replace(solution, t=solution.t - self._start)
        else:
            section = sections.get(receiver, GnssConfig.model_validate({}))
            told = self._samples.get(receiver) or _samples_of(section, log, receiver, self._start)
            arm_b = np.array(section.lever_arm_m) if isinstance(section, GnssConfig) else np.zeros(3)
            found = of_receiver([one for one in told if isinstance(one, GnssSample)], receiver, arm_b)
            found = _when_felt(found, section, log, receiver, sections)
            if solution is not None and "q_nb" in solution.columns:  # attitude is nothing that a receiver knows
                found = _with_attitude(found, solution, self._start)
        if not self._imus:
            return found
        name, imu = next(iter(self._imus.items()))
        unit = sections[name]
        assert isinstance(unit, ImuConfig)
        return with_rates(found, imu, unit.errors().C_sb)

    def _heard(self, name: str, after: float, until: float) -> Sequence[Sample]:
        """The samples of one sensor in (``after``, ``until``] [s], as denial leaves them."""
        times = self._times[name]
        first = bisect_right(times, after + EDGE_S)
        own = self._samples[name][first : bisect_right(times, until + EDGE_S)]
        if name in self.receptions:
            return [self._received(self.receptions[name], one) for one in own]
        if name in self._denied and own:
            kept = outside(self._denied[name], np.array([one.t for one in own]))
            return [one for one, keep in zip(own, kept, strict=True) if keep]
        return own

    @staticmethod
    def _received(reception: Reception, sample: Any) -> Sample:
        if reception.has_fix(sample.t, sample.lat, sample.lon):
            return sample  # type: ignore[no-any-return]
        return without_fix(sample.t, sample.t_arrival, sample.sensor)


def _in_it_already(scenario: Scenario, log: Log) -> list[str]:
    """What was given for the way from a sensor to the estimators: of a log it is over, and acts on nothing.

    Not what a grade presets, nor of the testbed's own record, whose samples came to be as its scenario says.
    """
    if formats.known(log.path).module == "rerun":
        return []
    told = []
    for name, section in scenario.sensors.items():
        if section.kind in ("imu", *SAMPLES):
            preset: Any = type(section).model_validate({"grade": getattr(section, "grade", None)})
            told += [
                f"sensors.{name}.{key} acts on none of its samples, which are as they came to the log"
                for key in ("dropout_percent", "jitter_s")
                if getattr(section, key) not in (0.0, getattr(preset, key))
            ]
    return told


def references(truth: LogTruth) -> list[str]:
    """The streams of a table that are known of the motion, where the run makes use of them."""
    used = [name for name, stream in truth.columns.items() if (stream.kind or name) == "reference"]
    return used if truth.reference == "solution" else []


def _as_used(log: Log, sections: Mapping[str, SensorConfig]) -> Log:
    """The log of the sensors that a run makes use of, its units in body axes."""
    turned = mounted(log, sections)
    imus = {name: turned.imus[name] for name, section in sections.items() if isinstance(section, ImuConfig)}
    return replace(turned, imus=imus, samples={name: own for name, own in log.samples.items() if name in sections})


def _losses(log: Log, streams: Collection[str]) -> list[str]:
    """What is told of rows that were left out of streams that a run makes use of, where they are many."""
    return [note for note in log.notes if isinstance(note, Loss) and note.stream in streams]


def _by_imu(solution: Reference, log: Log, sections: Mapping[str, SensorConfig]) -> Reference:
    """A solution by the IMU's times, of one by a receiver's: as its velocities show, or else as late as is told."""
    if not log.solution_by_utc or log.receiver is None:
        return solution
    section = sections.get(log.receiver)
    late = section.latency_s if isinstance(section, GnssConfig) else 0.0
    if {"lat", "v_n"} <= set(solution.columns) and log.imus:
        rows = Fixes(solution.t, *(solution.columns[key] for key in ("lat", "lon", "h")))
        rows.v_n = solution.columns["v_n"]
        shown = latency(log.imus[log.unit], rows.samples(log.receiver), np.zeros(3), late)
        if shown is not None:
            told = f"its dates {shown.text} late by the IMU"
            return replace(solution, name=f"{solution.name}, {told}", t=solution.t - shown.s)
    return replace(solution, name=f"{solution.name}, its dates {late:.2f} s late as told", t=solution.t - late)


def _when_felt(
    found: Reference, section: Any, log: Log, receiver: str, sections: Mapping[str, SensorConfig]
) -> Reference:
    """A receiver's reference at the times when the IMU felt its velocities, of one whose latency is not known well.

    No estimator has a part in it: one that finds a latency must not be judged by what it was told. Velocities are older
    than the positions beside them, by what both say of each other or by what is told.
    """
    lag = section.velocity_lag_s
    if log.valid_times or not section.latency_sigma_s or not log.imus:
        return _lagging(found, lag)
    late = late_by_imu(log, receiver, log.samples[receiver], sections)
    if late is None:
        return _lagging(found, lag)
    shown = velocity_lag(log.samples[receiver])
    lag = lag if shown is None else min(shown, late.s)
    late = Late(late.s - lag, late.sigma)
    by = f"{late.text} late by the IMU" + (f", its velocities {lag:.2f} s more" if shown else "")
    return replace(_lagging(found, lag), name=f"{found.name}, {by}", t=found.t + section.latency_s - late.s)


def _later(name: str, section: Any, log: Log, sections: Mapping[str, SensorConfig]) -> str:
    """What there is to say of a receiver that is much later than it is told to be, or sooner; else nothing."""
    found = late_by_imu(log, name, log.samples[name], sections) if log.imus else None
    told = 0.0 if log.valid_times else section.latency_s + section.velocity_lag_s
    if found is None or abs(found.s - told) < OTHER_CLOCK_S:
        return ""
    mends = "" if log.valid_times else f"latency_s = {max(found.s - section.velocity_lag_s, 0.0):.2g}, or "
    return f"{name} is {found.text} late by the IMU, and told to be {told:g}: {mends}an offset of its time mends it"


def _lagging(found: Reference, lag: float) -> Reference:
    """The same with its velocities where they were ``lag`` [s] before; beyond the last of them they are unknown."""
    if not lag or "v_n" not in found.columns or len(found.t) < 2:
        return found
    v_n = [np.interp(found.t, found.t - lag, axis, np.nan, np.nan) for axis in found.columns["v_n"].T]
    return replace(found, columns={**found.columns, "v_n": np.column_stack(v_n)})


def _with_attitude(found: Reference, solution: Reference, start: float) -> Reference:
    """The receiver's reference with the attitude of the log's solution, at its times too: it turns between fixes."""
    own = solution.t - start
    # And each second, as it may be silent for longer than rows are joined, but not than those of a slow receiver are.
    further = np.union1d(own, np.arange(found.t[0], found.t[-1])) if len(found.t) else own[:0]
    t = np.union1d(found.t, further[(further > found.t[0]) & (further < found.t[-1])] if len(found.t) else further)
    place = ReferenceMotion(found, 1.0, 0).at(t)
    columns = {name: getattr(place, name) for name in found.columns}
    columns["q_nb"] = ReferenceMotion(replace(solution, t=own), 1.0, 0).at(t).q_nb
    return replace(found, name=f"{found.name}; attitude: {solution.name}", t=t, columns=columns)


def _increments(scenario: Scenario, log: Log, start: float) -> dict[str, ImuSamples]:
    """The increments of each unit from the start on, those of spares at the times of the unit that they stand in for.

    What a unit felt before it began, if later, is unknown. One whose increments are not all of one length is given in
    pieces none of which is longer than the first.
    """
    found = {}
    for name, section in scenario.sensors.items():
        if isinstance(section, ImuConfig):
            own = log.imus[name]
            moved = own if start == 0.0 else replace(own, t=own.t - start)
            found[name] = bridged(begun(_cut(moved, 0.0, math.inf), 0.0))
    for estimator in scenario.estimator:
        for spare in estimator.spare_imus:
            if spare in found and not np.array_equal(found[spare].t, found[estimator.imu].t):
                found[spare] = at_times(found[spare], found[estimator.imu])
    return found


def _cut(imu: ImuSamples, after: float, until: float) -> ImuSamples:
    """The increments that end in (``after``, ``until``] [s]."""
    first, stop = np.searchsorted(imu.t, [after + EDGE_S, until + EDGE_S], side="right")
    rows = slice(int(first), int(stop))
    return ImuSamples(imu.t[rows], imu.dt[rows], imu.dtheta[rows], imu.dv[rows])


def _samples_of(section: Any, log: Log, name: str, start: float) -> list[Sample]:
    """The samples of one sensor in the order of their times, from the start on, with what the log leaves out.

    A log that has one time only tells when a sample arrived: it was valid a ``latency_s`` before.
    """
    late = 0.0 if log.valid_times else section.latency_s
    told: list[Sample] = []
    for one in log.samples[name]:
        t, arrival = one.t - start - late, one.t_arrival - start
        if t < -EDGE_S:
            continue
        changed: Any = one if t == one.t and arrival == one.t_arrival else replace(one, t=t, t_arrival=arrival)
        told.append(_with_sigmas(changed, section) if isinstance(changed, GnssSample) else changed)
    return told


def _with_sigmas(fix: GnssSample, section: GnssConfig) -> GnssSample:
    """A fix with the accuracies that the scenario declares where the log has none: they grow with dilution."""
    given: dict[str, Array] = {}
    errors = section.errors()
    if fix.has_fix and not np.isfinite(fix.sigma_position_n).all():
        told = np.maximum(np.hypot(errors.position_white_n, errors.position_correlated_n), REPORTED_AT_LEAST)
        worse = [one / usual for one, usual in ((fix.hdop, section.hdop), (fix.vdop, section.vdop))]
        horizontal, vertical = (max(1.0, one) if math.isfinite(one) else 1.0 for one in worse)
        given["sigma_position_n"] = told * np.array([horizontal, horizontal, vertical])
    if fix.has_fix and not np.isfinite(fix.sigma_velocity_n).all() and np.isfinite(fix.v_n).all():
        told = np.hypot(errors.velocity_white_n, errors.velocity_correlated_n)
        given["sigma_velocity_n"] = np.maximum(told, REPORTED_AT_LEAST)
    return replace(fix, **given) if given else fix  # type: ignore[arg-type]
