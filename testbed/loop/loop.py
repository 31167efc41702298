"""The one loop: motion, sensors, estimators, record, link.

Data goes one way; what is heard from downstream are requests (`testbed.loop.requests`), at the start of a turn.
"""

from __future__ import annotations

import gc
import heapq
import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from nav.samples import Estimate, FixType, GnssSample, ImuSamples, Sample, Status, UpdateReport
from testbed import sensors
from testbed.errors import UserError
from testbed.estimators import registry
from testbed.feeds.autopilot import Autopilot, Steered
from testbed.feeds.known import commanded, handed_over
from testbed.loop.requests import Desk, Director, Plant, Recorded, Request, Restarted
from testbed.motion.ahead import Ahead
from testbed.motion.sections import FlightTruth
from testbed.motion.table import MotionSource, TruthBlock
from testbed.record.recorder import Recorder
from testbed.results import METRICS, RECORD, held, require_own, start_anew
from testbed.scenario import Scenario
from testbed.score import metrics
from testbed.sensors.faults import Faults, FaultTruth
from testbed.sensors.imu import ImuConfig

if TYPE_CHECKING:
    import xarray

BATCH_S = 5.0  # simulated time per turn of the loop when nobody is watching
PACED_S = 0.1  # and when it keeps to the clock
EVENTS_S = 0.1  # how often events are looked for, at times of their own: watching a run must not change its record
SILENT_S = 0.5  # beyond its period, or half of it if that is longer, before a sensor that says nothing is silent
REFUSALS = 10  # of an aid in a row, before it is worth an event
REHEARSAL_S = 5.0  # that an estimator aligns in
LARGEST_SEED = 2**63 - 1
NEVER_CLOSED = "the autopilot flew on truth to the end: what it was to fly on was never ready"
BAD_SAMPLE_QUIET_S = 10.0  # a sensor that keeps delivering nonsense is reported once per this time


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a run stands: simulated time and duration [s], simulated over wall time, what is going on."""

    t: float
    duration: float
    realtime_factor: float
    activity: str


@dataclass(frozen=True, slots=True)
class RunResult:
    """What `run` gives back: the recorded dataset, its metrics, and the folder written (None when in memory).

    ``failure`` is empty unless the motion ended early because control was lost; then it says how. ``remarks`` are what
    else the caller should know: a plan that ended before the run, deadlines missed in real time, errors not scored.
    """

    dataset: xarray.DataTree
    metrics: dict[str, float]
    path: Path | None
    failure: str = ""
    remarks: tuple[str, ...] = ()


class Publisher(Protocol):
    """Whoever watches a run: handed plain data every ``period_s`` of simulated time.

    ``asks`` says whether it may ever ask for something; without, `requests` is not called.
    """

    period_s: float
    asks: bool

    def publish(
        self,
        truth: TruthBlock,
        estimate: Estimate,
        samples: Mapping[str, Sample],
        imu: ImuSamples | None,
        others: Sequence[tuple[str, Estimate]],
        reports: Sequence[UpdateReport],
    ) -> None:
        """One row of truth; the shown estimator's estimate and its reports since the last call; the newest sample of
        each sensor; increments up to the row or beyond; the other estimators' estimates.
        """
        ...

    def requests(self) -> Sequence[Request]:
        """Answer what has come in since the last call, and hand over what is asked of the run; never waits.

        Called before every turn, and while the run is paused every 20 ms of wall time.
        """
        ...

    def settings(self, values: Mapping[str, float]) -> None:
        """The values in force of what may change (`testbed.loop.requests.settings`): first and at each change."""
        ...

    def event(self, t: float, severity: str, text: str) -> None:
        """Something happened at ``t``; severity is info, warning or error."""
        ...

    def close(self) -> None:
        """The run is over."""
        ...


def shown_estimator(scenario: Scenario, asked: str | None = None) -> str:
    """The estimator that links show: the one asked for, or the first. Raises UserError when there is none such."""
    names = [one.name for one in scenario.estimator]
    if not names:
        raise UserError("the scenario has no [[estimator]], so a link has nothing to show: add one, or leave it out")
    if asked is None:
        return names[0]
    if asked not in names:
        raise UserError(f"--estimator {asked}: the scenario has no such estimator: choose from {', '.join(names)}")
    return asked


def motion(scenario: Scenario, seed: int) -> MotionSource:
    """The motion source that the scenario asks for, at its first tick."""
    if isinstance(scenario.truth, FlightTruth):
        from testbed.motion.flight import Flight

        return Flight(scenario.truth, scenario.plan, seed)
    from testbed.motion.kinematic import Kinematic

    truth = scenario.truth
    return Kinematic(truth.start, truth.rate_hz, truth.track(), truth.body)


def patience(rate_hz: float) -> float:
    """After how long [s] without a sample a sensor is silent."""
    return 1 / rate_hz + max(SILENT_S, 0.5 / rate_hz)


@dataclass(slots=True)
class _EventWatch:
    """Turns changes in samples, reports, estimates and legs into events."""

    emit: Callable[[float, str, str], None]
    faults: Sequence[FaultTruth] = ()
    patience: dict[str, float] = field(default_factory=dict)  # how long an aiding sensor may say nothing
    heard: dict[str, float] = field(default_factory=dict)  # when it last did, or at first should
    silent: set[str] = field(default_factory=set)
    fix: dict[str, bool] = field(default_factory=dict)
    aligned: dict[str, bool] = field(default_factory=dict)
    refusals: dict[tuple[str, str], int] = field(default_factory=dict)  # in a row
    unsound: dict[tuple[str, str], float] = field(default_factory=dict)  # when last reported
    leg: float = -2.0
    t: float = -math.inf

    @property
    def denied(self) -> bool:
        """Whether no GNSS receiver has a fix, or says so; one that has said nothing yet doesn't count."""
        return bool(self.fix) and not any(has and name not in self.silent for name, has in self.fix.items())

    def sample(self, sample: Sample) -> None:
        if sample.sensor in self.silent:
            self.silent.remove(sample.sensor)
            self.emit(sample.t_arrival, "info", f"{sample.sensor} heard again")
        self.heard[sample.sensor] = sample.t_arrival
        if not isinstance(sample, GnssSample):
            return
        has_fix = sample.fix_type != FixType.NO_FIX
        before = self.fix.get(sample.sensor)
        if before is not None and before != has_fix:
            severity, what = ("info", "reacquired") if has_fix else ("warning", "denied")
            self.emit(sample.t, severity, f"{sample.sensor} {what}")
        self.fix[sample.sensor] = has_fix

    def report(self, estimator: str, report: UpdateReport) -> None:
        """An unsound sample is an event; the gate turns a sound one away now and then, so only a run of those is."""
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

    def estimate(self, estimator: str, estimate: Estimate) -> None:
        aligned = Status.ALIGNED in estimate.status
        if aligned and not self.aligned.get(estimator, False):
            self.emit(estimate.t, "info", f"{estimator} aligned")
        self.aligned[estimator] = aligned

    def row(self, t: float, leg: float, plan: Sequence[str]) -> None:
        if leg != self.leg and 0 <= leg < len(plan):
            self.emit(t, "info", f"leg {int(leg) + 1}/{len(plan)} {plan[int(leg)]}")
        self.leg = leg
        for name, patience in self.patience.items():
            if name not in self.silent and t > self.heard[name] + patience:
                self.silent.add(name)
                self.emit(t, "warning", f"{name} silent")
        edges = [(one.start, "begins", one) for one in self.faults] + [(one.end, "ends", one) for one in self.faults]
        for when, what, one in sorted(edges, key=lambda edge: edge[0]):
            if self.t < when <= t:
                self.emit(when, "info", f"fault {one.name} {what}: {one}")
        self.t = t


class _Latest:
    """The newest sample of each sensor that has arrived by a time, however far ahead the sensors were computed."""

    def __init__(self) -> None:
        self.by_sensor: dict[str, Sample] = {}
        self._pending: list[tuple[float, int, Sample]] = []
        self._count = 0

    def add(self, samples: Sequence[Sample]) -> None:
        for sample in samples:
            heapq.heappush(self._pending, (sample.t_arrival, self._count, sample))
            self._count += 1

    def until(self, t: float) -> list[Sample]:
        """Samples that arrive up to ``t``, in order of arrival."""
        arrived = []
        while self._pending and self._pending[0][0] <= t:
            sample = heapq.heappop(self._pending)[2]
            self.by_sensor[sample.sensor] = sample
            arrived.append(sample)
        return arrived


def _take(reports: deque[UpdateReport], until: float) -> list[UpdateReport]:
    """Remove and give the reports on samples up to a time."""
    taken = []
    while reports and not reports[0].t > until:  # a time may be NaN
        taken.append(reports.popleft())
    return taken


def _flown(scenario: Scenario, end: float) -> tuple[str, str]:
    """Severity and text of a plan that ended before the run; a denial that it never reached is worth a warning."""
    text = f"plan flown: the run ends at {end:.0f} s of {scenario.duration_s:g} s"
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


def run(
    scenario: Scenario,
    *,
    seed: int | None = None,
    out: str | Path | None = None,
    links: Sequence[Publisher] = (),
    shown: str | None = None,
    realtime: float | None = None,
    progress: Callable[[Progress], None] | None = None,
    source: MotionSource | None = None,
    controls: Sequence[Callable[[], Sequence[Request]]] = (),
    replay: Sequence[tuple[float, Recorded]] = (),
) -> RunResult:
    """Fly, sense, estimate and record one scenario.

    ``seed`` replaces the scenario's own. With ``out`` the record goes to ``out/run.nc`` as it is made, and
    metrics.json beside it; without, everything stays in memory. ``links`` watch the estimator ``shown``, the first
    unless it is named, and are closed at the end, however it comes; ``realtime`` paces the run (1 = wall clock).
    ``source`` replaces the motion, to share one flown truth between runs. Links and ``controls`` may make requests
    (`testbed.loop.requests`); ``replay`` are those of an earlier run with their times. Same scenario, seed and
    requests, same bits. Raises UserError when the folder can't be written, the motion can't be started, or the seed or
    ``shown`` is none.
    """
    with ExitStack() as ending:
        for link in links:
            ending.callback(link.close)
        out = None if out is None else Path(out)
        seed = scenario.seed if seed is None else seed
        if not 0 <= seed <= LARGEST_SEED:
            raise UserError(f"seed {seed}: must be from 0 to {LARGEST_SEED}")
        shown = shown_estimator(scenario, shown) if links or shown is not None else None
        rate_hz = scenario.truth.rate_hz if source is None else source.rate_hz
        if out is not None:
            ending.enter_context(held(out))
            require_own(out, [RECORD, METRICS])
        asking = (*(link.requests for link in links if link.asks), *controls)
        director = Director(scenario, asking, replay, realtime, rate_hz, source is None)
        if (
            realtime is not None and source is None
        ):  # the first calls load and compile, for which there is no time later
            rehearsal = scenario.model_copy(update={"duration_s": min(REHEARSAL_S, scenario.duration_s)})
            _fly(rehearsal, seed, None, (), None, Director(scenario, (), (), None, rate_hz), None, None)
        flown = None
        while flown is None:
            with suppress(Restarted):
                flown = _fly(scenario, seed, out, links, shown, director, progress, source)
        dataset, failure, remarks, seconds = flown
        results = metrics.compute(dataset) | {f"run.{name}": value for name, value in seconds.items()}
        if out is not None:
            metrics.save(results, out / METRICS)
    return RunResult(dataset, results, out, failure, (*remarks, *metrics.unscored(dataset)))


def _fly(
    scenario: Scenario,
    seed: int,
    out: Path | None,
    links: Sequence[Publisher],
    shown: str | None,
    director: Director,
    progress: Callable[[Progress], None] | None,
    source: MotionSource | None,
) -> tuple[xarray.DataTree, str, list[str], dict[str, float]]:
    """From the first tick to the end: the record, failure and remarks, what the run has to say of itself.

    Raises Restarted when that was asked for.
    """
    started = time.perf_counter()
    with ExitStack() as ending:
        rate_hz = scenario.truth.rate_hz if source is None else source.rate_hz
        ticks = round(scenario.duration_s * rate_hz) + 1
        record_every = round(rate_hz / scenario.record.rate_hz)
        events_every = max(1, round(EVENTS_S * rate_hz))
        publish_every = max(1, round(min(link.period_s for link in links) * rate_hz)) if links else 0
        paced = min(publish_every or ticks, max(1, round(PACED_S * rate_hz)))
        batch = round(BATCH_S * rate_hz)
        closed = bool(scenario.autopilot.feedback.estimators)  # on something else than truth
        by_itself = isinstance(scenario.truth, FlightTruth) and not closed and not director.listens
        if source is None and by_itself and Ahead.possible():
            source = ahead = Ahead(partial(motion, scenario, seed), rate_hz, batch, ticks)
            ending.callback(ahead.close)
        elif source is None:
            source = motion(scenario, seed)
        if closed and not isinstance(source, Steered):
            raise UserError("autopilot.feedback: a motion flown before can't follow an estimate")
        site = scenario.site()
        inertial: dict[str, sensors.Imu] = {}
        aiding: dict[str, sensors.AidingSensor] = {}
        for name, config in scenario.sensors.items():
            sensor = sensors.build(name, config, rate_hz, seed, site)
            if isinstance(sensor, sensors.Imu):
                inertial[name] = sensor
            else:
                aiding[name] = sensor
        faults = Faults(scenario.fault, scenario.sensors, seed)
        filters = registry.build(scenario.estimator, scenario.rig(seed))
        # Between a tick and what a filter has surely used by then: an increment may not be complete yet.
        behind = {
            name: one.horizon.lag_s + 1 / inertial[one.imu].rate_hz - 1 / rate_hz for name, one in filters.items()
        }
        legs = scenario.plan if isinstance(scenario.truth, FlightTruth) else scenario.truth.segments
        plan = [leg.leg for leg in legs]

        recorder = Recorder(out / RECORD if out else None, scenario, seed)
        ending.callback(recorder.close)

        def emit(t: float, severity: str, text: str) -> None:
            recorder.event(t, severity, text)
            for link in links:
                link.event(t, severity, text)

        def say(t: float, severity: str, text: str) -> None:
            for link in links:
                link.event(t, severity, text)
            if progress is not None:
                progress(Progress(t, scenario.duration_s, t / (time.perf_counter() - started), text))

        def sense(block: TruthBlock) -> tuple[dict[str, ImuSamples], dict[str, Sequence[Sample]]]:
            return (
                {name: faults.apply(name, sensor.sense(block)) for name, sensor in inertial.items()},
                {name: faults.apply(name, sensor.sense(block)) for name, sensor in aiding.items()},
            )

        def wanted(n: int) -> list[int]:
            """The rows of the next ``n`` at which anybody wants an estimate."""
            every = (record_every, events_every, publish_every)
            return sorted(set().union(*(range(-tick % one, n, one) for one in every if one)))

        pilot = Autopilot(source, scenario, filters, sense) if closed and isinstance(source, Steered) else None

        def tell(values: Mapping[str, float]) -> None:
            for link in links:
                link.settings(values)

        watch = _EventWatch(emit, faults.truth)
        for name, config in scenario.sensors.items():
            if not isinstance(config, ImuConfig):
                watch.heard[name] = config.offset_s + config.latency_s
                watch.patience[name] = patience(config.rate_hz)
        director.begin(Desk(scenario, Plant(faults, aiding, filters, source)), recorder, emit, say, tell)
        latest = _Latest()
        unshown: deque[UpdateReport] = deque()  # reports of that estimator that the links have not been given
        unread: dict[str, deque[UpdateReport]] = {name: deque() for name in filters}  # not looked at for events
        votes: dict[str, deque[UpdateReport]] = {name: deque() for name in filters}  # on redundant units, nor these
        arrived: list[Sample] = []  # nor these
        truth_s = 0.0
        tick = 0
        # Samples come by the million, and the collector would walk all that was there before again and again.
        gc.freeze()
        ending.callback(gc.unfreeze)
        while tick < ticks and director.ready(tick):
            before = time.perf_counter()
            turn = min(paced if director.pacer is not None else batch, ticks - tick, director.room(tick))
            if pilot is None:
                block, flown = source.advance(turn), None
                truth_s += time.perf_counter() - before
            else:
                flown = pilot.advance(turn, wanted(turn))
                block, truth_s = flown.block, pilot.truth_s
            if not len(block):
                break
            if tick == 0 and out is not None:  # from here on what an earlier run left there would not fit the record
                start_anew(out, [RECORD])
            imu, samples = sense(block) if flown is None else (flown.imu, flown.samples)
            for own in samples.values():
                latest.add(own)
            outputs = wanted(len(block))
            times = [float(block.t[k]) for k in outputs]
            estimates: dict[str, list[Estimate]] = {}
            integrated: dict[str, ImuSamples] = {}
            for name, one in filters.items():
                if flown is not None and name in flown.tracked:
                    tracked = flown.tracked[name]
                else:
                    if tick == 0 and one.handover is not None:
                        one.start(handed_over(one.handover, block))
                    tracked = one.track(commanded(block), imu, samples, times)
                integrated[name], parity, reports, estimates[name] = tracked
                recorder.reports(name, parity)
                votes[name].extend(parity)
                recorder.reports(name, reports)
                unread[name].extend(reports)
                if links and name == shown:
                    unshown.extend(reports)
            if tick == 0:
                recorder.faults(faults.truth[: len(scenario.fault)])
            recorder.truth(block)
            for name, increments in imu.items():
                recorder.imu(name, increments)
            for name, own in samples.items():
                recorder.samples(name, own)
            for i, k in enumerate(outputs):
                arrived += latest.until(times[i])
                now = [(name, values[i]) for name, values in estimates.items()]
                if (tick + k) % events_every == 0:
                    if pilot is not None:
                        for event in pilot.take_events(times[i]):
                            emit(*event)
                    for sample in arrived:
                        watch.sample(sample)
                    arrived.clear()
                    watch.row(times[i], block.leg[k], plan)
                    for name, estimate in now:
                        watch.estimate(name, estimate)
                        for report in (*_take(votes[name], times[i]), *_take(unread[name], times[i] - behind[name])):
                            watch.report(name, report)
                if (tick + k) % record_every == 0:
                    for name, estimate in now:
                        recorder.estimate(name, estimate)
                if publish_every and (tick + k) % publish_every == 0 and shown is not None:
                    due = _take(unshown, times[i] - behind[shown])
                    row, first = block.rows(k, k + 1), estimates[shown][i]
                    others = [(name, estimate) for name, estimate in now if name != shown]
                    for link in links:
                        link.publish(row, first, latest.by_sensor, integrated[shown], others, due)
            tick += len(block)
            t = float(block.t[-1])
            if director.pacer is not None:
                director.pacer.wait(t, recorder.tend)
            if progress is not None:
                activity = "GNSS denied" if watch.denied else source.activity()
                factor = t / max(time.perf_counter() - started, 1e-9)
                progress(Progress(t, scenario.duration_s, factor, activity))
        end = (tick - 1) / rate_hz
        remarks = []
        if pilot is not None:
            for event in pilot.take_events():
                emit(*event)
            if not pilot.closed:
                remarks.append(NEVER_CLOSED)
                emit(end, "warning", remarks[-1])
        if source.failure:
            emit(end, "error", source.failure)
        elif director.ended:
            remarks.append(f"ended on request at {end:.0f} s of {scenario.duration_s:g} s")
        elif tick < ticks:
            severity, remark = _flown(scenario, end)
            emit(end, severity, remark)
            remarks.append(remark)
        director.conclude(end)
        if director.pacer is not None and director.pacer.missed:
            remarks.append(str(director.pacer))
    dataset = recorder.dataset()
    wall_s = time.perf_counter() - started
    seconds = {"wall_s": wall_s, "truth_s": truth_s, "realtime_factor": end / wall_s}
    if director.pacer is not None and director.pacer.waits:
        seconds["missed_percent"] = 100 * director.pacer.missed / director.pacer.waits
        seconds["jitter_p99_s"] = director.pacer.jitter_s(0.99)
    return dataset, source.failure, remarks, seconds
