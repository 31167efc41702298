"""The one loop: turns of a feed go to the estimators, and what comes of them to the record and to whoever watches.

Data goes one way; what is heard from downstream are requests (`testbed.loop.requests`), at the start of a turn.
"""

from __future__ import annotations

import gc
import json
import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Unpack

from nav.columns import Estimates
from nav.increments import COINCIDENT
from nav.samples import Status
from testbed import interrupts
from testbed.errors import UserError
from testbed.estimators import registry
from testbed.estimators.lane import Lane, Tracked
from testbed.estimators.section import EstimatorSection
from testbed.feeds.build import located, open_feed
from testbed.feeds.feed import Feed, Turn
from testbed.feeds.known import commanded, handed_over
from testbed.loop.arguments import Others, Setup, require_sound, setup_of
from testbed.loop.director import Director, Executor, Restarted
from testbed.loop.events import EventWatch, legs_unflown, plan_flown
from testbed.loop.links import Listeners, Progress
from testbed.loop.rehearsal import Rehearsal
from testbed.loop.settings import Parts
from testbed.loop.showing import Arrival, Arrivals, Backlog, Showing
from testbed.motion.ahead import Ahead
from testbed.motion.logged import LogTruth
from testbed.record.recorder import Recorder
from testbed.results import METRICS, RECORD, held, require_own, start_anew
from testbed.scenario import Scenario
from testbed.score import metrics
from testbed.score.remarks import remarks
from testbed.sensors.imu import ImuConfig
from testbed.sensors.registry import BUILT_IN

if TYPE_CHECKING:
    import xarray

BATCH_S = 20.0  # simulated time per turn of the loop when nobody can interfere
HEARD_S = 5.0  # and when somebody can, with another's motion, or slowly: as much is lost when that breaks
QUICK = 40.0  # times real time, from which on a turn may be long
PACED_S = 0.1  # and when it keeps to the clock, or a far end follows
EVENTS_S = 0.1  # how often events are looked for, at times of their own: watching a run must not change its record
REHEARSAL_S = 5.0  # that an estimator aligns in
COLLECT_AFTER = 200_000  # objects kept


@dataclass(frozen=True, slots=True)
class RunResult:
    """What `run` gives back: the recorded dataset, its metrics, and the folder written (None when in memory).

    ``failure`` is empty unless the motion ended early because control was lost; then it says how. ``remarks`` are what
    else the caller should know: a plan that ended before the run, deadlines missed in real time, errors not scored.
    ``ended`` are the estimators that ended by errors of their own, and why.
    """

    dataset: xarray.DataTree
    metrics: dict[str, float]
    path: Path | None
    failure: str = ""
    remarks: tuple[str, ...] = ()
    ended: Mapping[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        """In a line, as the last of a notebook's cell is shown."""
        parts = [repr(self.dataset.attrs.get("title")), f"{len(self.metrics)} metrics"]
        parts += [f"in {self.path}"] if self.path else []
        parts += [f"failure: {self.failure}"] if self.failure else []
        return f"<RunResult {', '.join([*parts, *self.remarks])}>"


def run(
    scenario: Scenario,
    *,
    seed: int | None = None,
    out: str | Path | None = None,
    progress: Callable[[Progress], None] | None = None,
    **others: Unpack[Others],
) -> RunResult:
    """Fly, sense, estimate and record one scenario.

    ``seed`` replaces the scenario's own. With ``out`` the record goes to ``out/run.nc`` as it is made, and
    metrics.json beside it; without, everything stays in memory. ``progress`` is told how far it is. Further arguments,
    by name: ``links`` watch the estimator ``shown``, the first unless it is named, and are closed at the end, however
    it comes; ``realtime`` paces the run (1 = wall clock). Links and ``controls`` may make requests
    (`testbed.loop.requests`); ``replay`` are those of an earlier run with their times. ``source`` replaces the motion,
    to share one flown truth between runs. A ``far_end`` is told of every turn, flies if it is to, and is closed at the
    end; when it fails the run ends. Same scenario, seed and requests, same bits. Raises UserError when the folder
    can't be written, the motion can't be started, or the seed or ``shown`` is none.
    """
    require_sound(scenario, out, progress, others)
    with ExitStack() as ending:
        for link in others.get("links", ()):
            ending.callback(link.close)
        if (far_end := others.get("far_end")) is not None:
            ending.callback(far_end.close)
        scenario = located(scenario)
        setup = setup_of(scenario, seed, out, progress, others)
        helper = _helper(scenario, setup)
        if helper is not None:
            ending.callback(helper.close)
        if setup.out is not None:
            ending.enter_context(held(setup.out))
            require_own(setup.out, [RECORD, METRICS])
        director = _director(scenario, setup)
        if setup.realtime is not None and setup.source is None:
            # The first calls load and compile, for which there is no time later.
            _rehearse(scenario, setup.own(scenario), setup.seed)
            gc.collect()  # an estimator of the user's lets go of what it holds, such as a port, before it is made again
            if helper is not None:
                helper.close()
        flown = None
        while flown is None:
            with suppress(Restarted):
                flown = _fly(scenario, setup, director)
        results = metrics.compute(flown.dataset) | {f"run.{name}": value for name, value in flown.seconds.items()}
        if setup.out is not None:
            metrics.save(results, setup.out / METRICS)
    told = (*flown.remarks, *remarks(flown.dataset, results))
    return RunResult(flown.dataset, results, setup.out, flown.failure, told, flown.ended)


def _director(scenario: Scenario, setup: Setup) -> Director:
    """Who heeds requests and the clock."""
    rate_hz = scenario.truth.rate_hz if setup.source is None else setup.source.rate_hz
    asking = (*(link.requests for link in setup.links if link.asks), *setup.controls)
    may_restart = setup.source is None and setup.far_end is None
    return Director(asking, setup.replay, setup.realtime, rate_hz, may_restart)


def _helper(scenario: Scenario, setup: Setup) -> Rehearsal | None:
    """A second process that compiles from the other end, where that is worth it.

    Sensors come first there, then the last estimator, while the run begins with the first.
    """
    if not _leaves_to_compile(scenario, setup):
        return None
    kernels = [(one,) for one in reversed(setup.own(scenario)) if registry.find(one.kind).kernel]
    with interrupts.held():
        return Rehearsal([partial(_rehearse, scenario, some, setup.seed) for some in ((), *kernels)])


def _leaves_to_compile(scenario: Scenario, setup: Setup) -> bool:
    """Whether much of what a run needs is still to be compiled, and a second process may do a part of that.

    That flies parts of the scenario once more: not where a filter steers, a log would be read, or anybody else's code
    would be called.
    """
    ours = setup.source is None and setup.far_end is None
    ours &= all(section.kind in BUILT_IN for section in scenario.sensors.values())
    open_loop = not isinstance(scenario.truth, LogTruth) and not scenario.autopilot.feedback.estimators
    return ours and open_loop and Ahead.possible() and not registry.is_kept(scenario.estimator)


def _own_code(scenario: Scenario) -> tuple[dict[str, str], list[str]]:
    """What a record says of the code of the user's classes, and what there is to say where they have been edited."""
    try:
        digests = {kind: code for own in scenario.own().values() for kind, code in own.items()}
    except UserError as error:
        return {}, [str(error)]
    return {"own_code": json.dumps(digests)} if digests else {}, []


def _rehearse(scenario: Scenario, estimators: Sequence[EstimatorSection], seed: int) -> None:
    """Fly the beginning of a scenario with some of its estimators, and keep nothing."""
    beginning = {"duration_s": min(REHEARSAL_S, scenario.duration_s), "estimator": tuple(estimators)}
    _fly(scenario.model_copy(update=beginning), Setup(seed), Director((), (), None, scenario.truth.rate_hz))


class _Flown(NamedTuple):
    """A run from its first tick to its end: record, failure, remarks, who ended, and what it says of its own speed."""

    dataset: xarray.DataTree
    failure: str
    remarks: list[str]
    ended: dict[str, str]
    seconds: dict[str, float]


def _fly(scenario: Scenario, setup: Setup, director: Director) -> _Flown:
    """From the first tick to the end. Raises Restarted when that was asked for."""
    with ExitStack() as ending:
        passage = _Passage(scenario, setup, director, ending)
        # Samples come by the million and leave no cycles: the collector, called at every 700th that is kept, would walk
        # those that wait for the record again and again, and all that was there before.
        gc.freeze()
        ending.callback(gc.unfreeze)
        thresholds = gc.get_threshold()
        if 0 < thresholds[0] < COLLECT_AFTER:
            ending.callback(gc.set_threshold, *thresholds)
            gc.set_threshold(COLLECT_AFTER)
        while passage.tick < passage.ticks and director.ready(passage.tick) and passage.advance():
            pass
        remarks = passage.conclude()
        passage.look_back()
        dataset = passage.recorder.finish()
    return _Flown(dataset, passage.feed.failure, remarks, passage.ended, passage.seconds())


@dataclass(frozen=True, slots=True)
class _Cadence:
    """At which ticks rows are recorded, looked at for events, handed to links, with the others beside (0: never)."""

    record: int
    events: int
    publish: int
    others: int

    def rows(self, tick: int, n: int, shown: bool = True) -> list[int]:
        """The rows of the ``n`` from ``tick`` on at which anybody wants an estimate, of the ``shown`` one or not."""
        every = (self.record, self.events, self.publish if shown else self.others)
        return sorted(set().union(*(range(-tick % one, n, one) for one in every if one)))


class _Passage:
    """One passage through a run: where it stands, and the parts that it is made of."""

    def __init__(self, scenario: Scenario, setup: Setup, director: Director, ending: ExitStack) -> None:
        """Set up the parts; what they hold is let go of by ``ending``."""
        self.scenario, self.setup, self.director = scenario, setup, director
        rate_hz = scenario.truth.rate_hz if setup.source is None else setup.source.rate_hz
        self.rate_hz = rate_hz
        self.tick, self.ticks = 0, round(scenario.duration_s * rate_hz) + 1
        publish = max(1, round(min(link.period_s for link in setup.links) * rate_hz)) if setup.links else 0
        others = publish * math.gcd(*(link.others_every for link in setup.links))
        events = max(1, round(EVENTS_S * rate_hz))
        self.cadence = _Cadence(round(rate_hz / scenario.record.rate_hz), events, publish, others)
        alone = BATCH_S if setup.source is None and not director.listens else HEARD_S
        self.batch = round((alone if setup.far_end is None else PACED_S) * rate_hz)
        self.slow, self.quick = min(self.batch, round(HEARD_S * rate_hz)), False
        self.paced = min(publish or self.ticks, max(1, round(PACED_S * rate_hz)))
        self.lanes = registry.build(setup.own(scenario), scenario.rig(setup.seed))
        ahead = None if director.listens else (self.batch, self.ticks)
        self.feed: Feed = open_feed(scenario, setup.seed, self.lanes, setup.source, ahead, setup.far_end)
        ending.callback(self.feed.close)
        self.recorder = Recorder(setup.out / RECORD if setup.out else None, scenario, setup.seed)
        ending.callback(self.recorder.close)
        self.told = Listeners(setup.links, setup.progress, scenario.duration_s, self.recorder.event)
        own_code, self.edited = _own_code(scenario)
        self.recorder.attributes |= self.feed.origin | own_code
        self.watch = EventWatch.of(self._emit, self.feed.faults.truth, scenario)
        self.leg_names = scenario.leg_names
        plant = Parts(self.feed.faults, self.feed.receptions, self.lanes, self.feed.source)
        director.begin(Executor(scenario, plant), self.recorder, self.told.emit, self.told.say, self.told.settings)
        self.arrivals = Arrivals()
        self.arrived: deque[Arrival] = deque()  # not looked at for events
        behind = {name: self._behind(one) for name, one in self.lanes.items()}
        self.backlog = {name: Backlog(one) for name, one in behind.items()}
        self.showing = Showing(setup.links, publish, behind[setup.shown] if setup.shown else 0.0)
        self.row = 0  # of the turn, that is looked at for events
        self.ended: dict[str, str] = {}  # estimators that have ended by an error of their own, and why
        self.ending: dict[str, float] = {}  # when those of this turn did [s]

    def _behind(self, lane: Lane) -> float:
        """Between a tick and what a filter has surely used by then [s]: an increment may not be complete yet."""
        imu = self.scenario.sensors[lane.imu]
        assert isinstance(imu, ImuConfig)
        return lane.horizon.lag_s + imu.longest_s - 1 / self.rate_hz

    def advance(self) -> bool:
        """One turn: what the feed gives, estimated, recorded and handed out. False when the motion has ended."""
        began = time.monotonic()
        left, live = self.ticks - self.tick, self.director.pacer is not None
        size = self.paced if live else self.batch if self.quick else self.slow
        if live and left <= size + size // 2:  # the last few rows come with these: their own deadline would be at once
            size = left
        ticks = min(size, left, self.director.room(self.tick))
        turn = self.feed.advance(ticks, self.cadence.rows(self.tick, ticks))
        block = turn.reference
        if not len(block):
            return False
        if self.tick == 0 and self.setup.out is not None:
            start_anew(self.setup.out, [RECORD])  # from here on what an earlier run left there would not fit the record
        rows = self.cadence.rows(self.tick, len(block))
        fewer = self.cadence.rows(self.tick, len(block), shown=False)
        wanted = {name: rows if name in (self.setup.shown, *turn.tracked) else fewer for name in self.lanes}
        tracked = {name: self._track(name, turn, block.t[wanted[name]].tolist()) for name in self.lanes}
        self._record(turn)
        recorded = range(-self.tick % self.cadence.record, len(block), self.cadence.record)
        known = {name for name, aligned in self.watch.aligned.items() if aligned}
        told = {name: _TurnEstimates.of(tracked[name].estimates, wanted[name], name in known) for name in self.lanes}
        for name, one in told.items():
            self.recorder.estimates(name, one.of_rows(recorded))
        self._hand_out(turn, tracked, told)
        self.tick += len(block)
        t = float(block.t[-1])
        if self.director.pacer is not None:
            self.director.pacer.wait(t, self.recorder.tend)
        self.told.advance(t, "GNSS denied" if self.watch.denied else self.feed.activity())
        self.quick = QUICK * (time.monotonic() - began) < len(block) / self.rate_hz
        return True

    def _track(self, name: str, turn: Turn, times: Sequence[float]) -> Tracked:
        """What one estimator makes of a turn, with its reports recorded."""
        lane = self.lanes[name]
        if name in turn.tracked:
            tracked = turn.tracked[name]
        else:
            if self.tick == 0 and lane.handover is not None:
                lane.start(handed_over(lane.handover, turn.reference))
            tracked = lane.track(commanded(turn.reference), turn.imu, turn.samples, times)
        self.recorder.reports(name, tracked.votes)
        self.recorder.reports(name, tracked.reports.pieces)
        self.backlog[name].add(tracked.votes, tracked.reports)
        return tracked

    def _record(self, turn: Turn) -> None:
        """The reference, and what the sensors delivered."""
        if self.tick == 0:
            self.recorder.faults(self.feed.faults.truth[: len(self.scenario.fault)])
        self.recorder.truth(turn.reference)
        for name, increments in turn.imu.items():
            self.recorder.imu(name, increments)
        for name, own in turn.samples.items():
            self.recorder.samples(name, own)
        self.recorder.steered(turn.steered)

    def _hand_out(self, turn: Turn, tracked: Mapping[str, Tracked], told: Mapping[str, _TurnEstimates]) -> None:
        """The rows of a turn, with what estimators that were asked told: to who looks for events, and to links."""
        block, shown = turn.reference, self.setup.shown
        for own in turn.samples.values():
            self.arrivals.add(own)
        arrived = self.arrivals.until(float(block.t[-1]))
        self.arrived += arrived
        if self.cadence.publish and shown is not None:
            own_rows = told[shown].at, told[shown].estimates, tracked[shown].increments
            others = {name: (one.at, one.estimates) for name, one in told.items() if name != shown}
            self.showing.hear(arrived, tracked[shown].reports)
            self.showing.begin(self.tick, block, own_rows, others)
        rows = range(-self.tick % self.cadence.events, len(block), self.cadence.events)
        quiet = not self.watch.heeds_fused and all(one.plain for one in self.backlog.values())
        telling = {name: one for name, one in told.items() if one.news or not quiet}
        looked = slice(rows.start, None, rows.step)
        self.ending = {name: lane.ended for name, lane in self.lanes.items() if lane.failure}
        for row, t, leg in zip(rows, block.t[looked].tolist(), block.leg[looked].tolist(), strict=True):
            self.row = row
            self._look(t, leg, telling, row)
        for name in told.keys() - telling.keys() if rows else ():
            self.backlog[name].skip(float(block.t[rows[-1]]))
        self.showing.until(len(block))

    def _emit(self, t: float, severity: str, text: str) -> None:
        """Tell and record an event, after the rows before it."""
        self.showing.until(self.row)
        self.told.emit(t, severity, text)

    def _look(self, t: float, leg: float, told: Mapping[str, _TurnEstimates], k: int) -> None:
        """Look for events at ``t``, row ``k`` of a turn."""
        for event in self.feed.take_events(t):
            self._emit(*event)
        self._tell_ended(t, [name for name, ended in self.ending.items() if ended <= t + COINCIDENT])
        while self.arrived and self.arrived[0][0] <= t:
            when, _, samples, which = self.arrived.popleft()
            self.watch.sample(when, samples, which)
        self.watch.row(t, leg, self.leg_names)
        for name, one in told.items():
            if one.news and k in one.at:
                self.watch.estimate(name, *one.news[one.at[k]])
            for report in self.backlog[name].until(t, lambda: self.watch.heeds_fused):
                self.watch.report(name, report)

    def _tell_ended(self, t: float, names: Sequence[str]) -> None:
        """Tell of the estimators that have ended by an error of their own, of each once."""
        for name in names:
            if name not in self.ended:
                self.ended[name] = self.lanes[name].failure
                self.recorder.attributes["ended"] = json.dumps(self.ended)
                self._emit(t, "error", f"{name} has ended: {self.ended[name]}")

    def conclude(self) -> list[str]:
        """The end: last events, and what the caller should know."""
        end, remarks = self._end, [*self.edited]
        self._tell_ended(end, [name for name, lane in self.lanes.items() if lane.failure])
        for event in self.feed.take_events():
            self.told.emit(*event)
        remark = self.feed.remark()
        if remark:
            remarks.append(remark)
            self.told.emit(end, "warning", remark)
        if self.feed.failure:
            self.told.emit(end, "error", self.feed.failure)
        elif self.director.ended:
            remarks.append(f"ended on request at {end:.0f} s of {self.scenario.duration_s:g} s")
        elif self.tick < self.ticks:
            severity, remark = plan_flown(self.scenario, end)
            self.told.emit(end, severity, remark)
            remarks.append(remark)
        elif unflown := legs_unflown(self.scenario, self.watch.leg):
            self.told.emit(end, "warning", unflown)
            remarks.append(unflown)
        remarks += [f"{name} has ended: {self.ended[name]}" for name in self.lanes if name in self.ended]
        for name, lane in self.lanes.items():
            if lane.problem:
                remarks.append(f"{name} is not aligned at the end: {lane.problem}")
                self.told.emit(end, "warning", remarks[-1])
        self.director.conclude(end)
        self.recorder.attributes |= self.feed.origin  # with why a far end failed
        if self.director.pacer is not None and self.director.pacer.missed:
            remarks.append(str(self.director.pacer))
        return remarks

    def look_back(self) -> None:
        """Record what estimators say of the whole run when they look back."""
        times = [tick / self.rate_hz for tick in range(0, self.tick, self.cadence.record)]
        for section in self.setup.own(self.scenario):
            _, *smoothed = section.recorded
            for name in smoothed:
                self.recorder.flush()  # looking back takes a while, and a run may be killed in it
                self.recorder.estimates(name, Estimates.of(self.lanes[section.name].smoothed(times)))
        if self.setup.far_end is not None:
            for name, found in self.setup.far_end.estimates(times).items():
                self.recorder.estimates(name, found)

    @property
    def _end(self) -> float:
        return (self.tick - 1) / self.rate_hz

    def seconds(self) -> dict[str, float]:
        """What the run has to say of its own speed, at its end."""
        wall_s, pacer = time.perf_counter() - self.told.started, self.director.pacer
        seconds = {"wall_s": wall_s, "truth_s": self.feed.motion_s, "realtime_factor": self._end / wall_s}
        if pacer is not None and pacer.waits:
            seconds["missed_percent"] = 100 * pacer.missed / pacer.waits
            seconds["jitter_p99_s"] = pacer.jitter_s(0.99)
        return seconds


class _TurnEstimates(NamedTuple):
    """What an estimator told in a turn, and where each row of the turn is among it; of the same, if it is news, time
    and whether it is aligned.
    """

    estimates: Estimates
    at: dict[int, int]
    news: list[tuple[float, bool]]

    @classmethod
    def of(cls, estimates: Estimates, rows: Sequence[int], known: bool) -> _TurnEstimates:
        """Of the ``rows`` that were wanted; that it is aligned may be ``known``."""
        aligned = (estimates.status & Status.ALIGNED).astype(bool)
        at = {row: k for k, row in enumerate(rows)}
        old = known and aligned.all()
        return cls(estimates, at, [] if old else list(zip(estimates.t.tolist(), aligned.tolist(), strict=True)))

    def of_rows(self, rows: Sequence[int]) -> Estimates:
        """Those of some rows."""
        return self.estimates if len(rows) == len(self.at) else self.estimates[[self.at[row] for row in rows]]
