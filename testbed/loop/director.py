"""Requests at work: heard at the start of a turn, carried out, recorded; replayed; and the pace of the run."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

from testbed.errors import UserError
from testbed.loop.pacer import Pacer
from testbed.scenario import Scenario
from testbed.schema import LONGEST_RUN_S
from testbed.sensors.faults import FaultTruth

if TYPE_CHECKING:
    import xarray

    from testbed.record.recorder import Recorder

from testbed.loop.injection import fault_of
from testbed.loop.requests import (
    RECORDED,
    Change,
    Clear,
    End,
    Faster,
    Inject,
    Pause,
    Recorded,
    Refused,
    Request,
    Restart,
    Resume,
    Speed,
    Step,
    Toggle,
    written,
)
from testbed.loop.settings import LARGEST_SPEED, SMALLEST_SPEED, Knob, Parts, knobs

Event: TypeAlias = Callable[[float, str, str], None]  # time [s], severity, text
MAX_TICKS = 10**9  # more than any run has
ASK_EVERY_S = 0.02  # of wall time, while the run is paused
LONGEST_REQUEST = 512  # letters of its record


def _check(request: Recorded, scenario: Scenario, knobs: Mapping[str, Knob], t: float) -> None:
    """Raise Refused when a request at ``t`` [s] makes no sense."""
    match request:
        case Inject(table):
            fault_of(scenario, table, t)
        case Change(name, value):
            if name not in knobs:
                raise Refused(f"there is no setting {name}: choose from {', '.join(knobs)}")
            own = knobs[name].setting
            if not own.least <= value <= own.most or (own.whole and value != int(value)):
                whole = "a whole number " if own.whole else ""
                raise Refused(f"{name} {value:g}: must be {whole}from {own.least:g} to {own.most:g}")


class Executor:
    """Carries out, on the parts of one run, what changes its results; ``values`` are those of the settings now."""

    def __init__(self, scenario: Scenario, parts: Parts) -> None:
        self._scenario = scenario
        self._parts = parts
        self._knobs = knobs(scenario)
        self.values = {name: knob.setting.value for name, knob in self._knobs.items()}
        self._open: dict[int, str] = {}  # faults that go on, by their place, and the setting that they come from

    def carry_out(self, request: Recorded, t: float) -> list[FaultTruth]:
        """Do it at ``t`` [s], the time of the next row; the faults that have ended by it. Raises Refused."""
        _check(request, self._scenario, self._knobs, t)
        match request:
            case Inject(table):
                self._begin(table, "", t)
            case Clear(sensor, channel):
                truth = self._parts.faults.truth
                return self._end(
                    [
                        k
                        for k, setting in self._open.items()
                        if not setting and truth[k].sensor == sensor and truth[k].channel.startswith(channel)
                    ],
                    t,
                )
            case Change(setting, value):
                return self._change(setting, value, t)
        return []

    def conclude(self, t: float) -> list[FaultTruth]:
        """The faults that go on when the run ends at ``t`` [s], and end with it."""
        return self._end(list(self._open), t)

    def _begin(self, table: Mapping[str, object], setting: str, t: float) -> None:
        self._open[self._parts.faults.add(fault_of(self._scenario, table, t))] = setting

    def _end(self, which: Sequence[int], t: float) -> list[FaultTruth]:
        for k in which:
            del self._open[k]
        return [self._parts.faults.end(k, t) for k in which]

    def _change(self, name: str, value: float, t: float) -> list[FaultTruth]:
        knob, before = self._knobs[name], self.values[name]
        self.values[name] = value
        ended: list[FaultTruth] = []
        if knob.faults is not None and knob.faults(value) != knob.faults(before):
            ended = self._end([k for k, setting in self._open.items() if setting == name], t)
            for table in knob.faults(value):
                self._begin(table, name, t)
        if knob.act is not None:
            knob.act(self._parts, self.values)
        return ended


class Restarted(Exception):
    """The run is to begin anew."""


class Director:
    """Hears what is asked of a run at the start of its turns, has it carried out, and holds the run to the clock.

    ``sources`` are asked without waiting; ``replay`` are requests of an earlier run by their times. With a ``factor``
    the run keeps to that many times the wall clock; none: as fast as it can, until somebody asks for a speed. A motion
    that is not ``repeatable`` can't be begun anew.
    """

    def __init__(
        self,
        sources: Sequence[Callable[[], Sequence[Request]]],
        replay: Sequence[tuple[float, Recorded]],
        factor: float | None,
        rate_hz: float,
        repeatable: bool = True,
        *,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.pacer = None if factor is None else Pacer(factor)
        self.ended = False
        self.listens = bool(sources or replay) or factor is not None
        self._sources = sources
        self._asked: deque[Request] = deque()
        self._replay = [(round(t * rate_hz), request) for t, request in replay]
        self._rate_hz, self._repeatable = rate_hz, repeatable
        self._sleep = sleep

    def begin(
        self,
        executor: Executor,
        recorder: Recorder,
        emit: Event,
        say: Event,
        tell: Callable[[Mapping[str, float]], None],
    ) -> None:
        """A run begins, anew perhaps. ``emit`` tells and records events, ``say`` only tells; ``tell`` the settings."""
        self._executor, self._recorder, self._emit, self._say, self._tell = executor, recorder, emit, say, tell
        self._waiting = list(self._replay)
        self._stop_at: int | None = None
        self._paused = self.ended = False
        self._tell_settings()

    def ready(self, tick: int) -> bool:
        """Carry out what is due or asked for before ``tick``, waiting there while paused; False ends the run.

        Raises Restarted, and UserError when a request of the earlier run can't be repeated.
        """
        while self._waiting and self._waiting[0][0] <= tick:
            request = self._waiting.pop(0)[1]
            try:
                self._carry_out(request, tick)
            except Refused as reason:
                raise UserError(f"the request at {tick / self._rate_hz:g} s can't be repeated: {reason}") from None
        self._listen(tick)
        if tick == self._stop_at:
            self._stop_at = None
            self._hold(tick)
        if self._paused:
            while self._paused and not self.ended:
                self._sleep(ASK_EVERY_S)
                self._listen(tick)
            if self.pacer is not None:
                self.pacer.restart(tick / self._rate_hz)
        return not (self.ended and tick)  # there is always a first row

    def room(self, tick: int) -> int:
        """How many ticks may pass until something is due that is known already."""
        due = [self._waiting[0][0]] if self._waiting else []
        due += [self._stop_at] if self._stop_at is not None else []
        return 1 if self.ended else min(due, default=tick + MAX_TICKS) - tick

    def conclude(self, t: float) -> None:
        """The run ends at ``t`` [s]: record what the faults were that went on until then."""
        self._recorder.faults(self._executor.conclude(t))

    def _tell_settings(self) -> None:
        self._tell(self._executor.values | ({"SIM_SPEEDUP": self.pacer.factor} if self.pacer is not None else {}))

    def _listen(self, tick: int) -> None:
        for source in self._sources:
            self._asked.extend(source())
        while self._asked:  # what is asked after a restart is left for the run that begins
            try:
                self._heed(self._asked.popleft(), tick)
            except Refused as reason:
                self._say(tick / self._rate_hz, "warning", f"refused: {reason}")
                self._tell_settings()

    def _heed(self, request: Request, tick: int) -> None:
        t = tick / self._rate_hz
        match request:
            case Toggle():
                self._heed(Resume() if self._paused else Pause(), tick)
            case Pause():
                self._stop_at = None
                self._hold(tick)
            case Resume() | Step():
                if isinstance(request, Step):
                    if not 0 < request.seconds <= LONGEST_RUN_S:
                        raise Refused(f"a step of {request.seconds:g} s: must be above 0")
                    self._stop_at = tick + max(1, round(request.seconds * self._rate_hz))
                elif self._paused:
                    self._say(t, "info", "goes on")
                self._paused = False
            case Faster(times):
                factor = times * (1.0 if self.pacer is None else self.pacer.factor)
                self._heed(Speed(min(max(factor, SMALLEST_SPEED), LARGEST_SPEED)), tick)
            case Speed(factor) | Change("SIM_SPEEDUP", factor):
                if not SMALLEST_SPEED <= factor <= LARGEST_SPEED:
                    raise Refused(f"speed {factor:g}: must be from {SMALLEST_SPEED:g} to {LARGEST_SPEED:g}")
                self.pacer = self.pacer or Pacer()
                self.pacer.restart(t, factor)
                self._tell_settings()
                self._say(t, "info", f"{factor:g} times the wall clock")
            case Restart():
                if not self._repeatable:
                    raise Refused("this motion can't be flown again")
                self._say(t, "info", "begins anew")
                self.pacer = self.pacer and Pacer(self.pacer.factor)
                raise Restarted
            case _:
                self._carry_out(request, tick)

    def _hold(self, tick: int) -> None:
        if not self._paused:
            self._say(tick / self._rate_hz, "info", f"paused at {tick / self._rate_hz:.2f} s")
        self._paused = True

    def _carry_out(self, request: Recorded, tick: int) -> None:
        """What changes results: with its record, and an event unless one tells of its faults."""
        t = tick / self._rate_hz
        kind, content = written(request)
        if len(content) > LONGEST_REQUEST:
            raise Refused(f"a request of {len(content)} letters: at most {LONGEST_REQUEST} can be recorded")
        ended = self._executor.carry_out(request, t)
        if isinstance(request, Clear) and not ended:
            return  # there was nothing to end
        self._recorder.request(t, tick, kind, content)
        self._recorder.faults(ended)
        if isinstance(request, End):
            self.ended = True
            self._emit(t, "info", "ended on request")
        elif isinstance(request, Change):
            self._tell_settings()
            self._emit(t, "info", f"{request.setting} set to {request.value:g}")


def recorded(dataset: xarray.DataTree, scenario: Scenario) -> list[tuple[float, Recorded]]:
    """The requests of a recorded run with their times. Raises UserError when they make no sense in ``scenario``."""
    if "requests" not in dataset.children:
        return []
    group = dataset["requests"]
    known = knobs(scenario)
    found: list[tuple[float, Recorded]] = []
    columns = (group.dataset[name].values.tolist() for name in ("time", "kind", "content"))
    for t, kind, content in zip(*columns, strict=True):
        try:
            fields: dict[str, Any] = json.loads(content)
            found.append((t, RECORDED[kind](**fields)))
            _check(found[-1][1], scenario, known, t)
        except (KeyError, TypeError, ValueError):
            raise UserError(f"the record's request at {t:g} s can't be read: {kind} {content[:60]}") from None
        except Refused as reason:
            raise UserError(f"the record's request at {t:g} s does not fit the scenario: {reason}") from None
    return found
