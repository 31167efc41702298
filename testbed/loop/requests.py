"""What may be asked of a run while it goes on: plain data, so that it can be recorded and replayed.

Whoever watches a run (`testbed.loop.links.Publisher`) hands its requests over when the loop looks, at the start of a
turn. Those that change what is computed take effect at that tick and are recorded with it; replayed at the same
ticks they give the same bits. The others only say when the loop goes on.

Failures that stations inject become faults as in scenario files (`testbed.sensors.faults`), without an end. What each
of MAVLink's FAILURE_TYPEs (mavlink.io, common.xml, whose words are quoted) means here:

off           "completely non-responsive": dropout
stuck         "keeps reporting the same value": stuck at the first value from now on
garbage       "reporting complete garbage": garbage
wrong         "consistently wrong": a step of the size in `WRONG`; of an airspeed a leak in the pitot line
slow          "reporting at slower than expected rate": one sample of `SLOW`
delayed       "delayed in time": the values of `DELAYED_S` ago, under the time of now; until then the first
intermittent  "sometimes working, sometimes not": away for the first half of every `INTERMITTENT_S`
ok            "used to reset a previous failure": ends what was injected there; scheduled faults go on
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, get_args

from pydantic import TypeAdapter, ValidationError

from nav.ins import Ins
from testbed.errors import UserError
from testbed.estimators.ins import InsSection
from testbed.loop.pacer import Pacer
from testbed.motion.sections import FlightTruth
from testbed.scenario import Scenario
from testbed.schema import LONGEST_RUN_S
from testbed.sensors.faults import Fault, FaultConfig, Faults, FaultTruth, mistakes
from testbed.sensors.gnss import Gnss

if TYPE_CHECKING:
    import xarray

    from testbed.estimators.lane import Lane
    from testbed.motion.table import MotionSource
    from testbed.record.recorder import Recorder
    from testbed.sensors import AidingSensor

SLOW = 5  # a GNSS receiver of 5 Hz then reports once a second
DELAYED_S = 0.5
INTERMITTENT_S = 4.0
# Sizes far beyond what is ever sound and within what hardware does: the units are those of the channels.
WRONG: Mapping[str, Mapping[str, object]] = {
    "gnss": {"channel": "position", "kind": "step", "size": 100.0, "bearing_deg": 0.0},  # as of strong multipath
    "gyro": {"channel": "gyro", "kind": "step", "size": 1.0, "unit": "deg/s"},  # on every axis: no calibration left
    "accelerometer": {"channel": "accel", "kind": "step", "size": 1.0, "unit": "m/s^2"},
    "magnetometer": {"channel": "field", "kind": "step", "size": 20.0, "unit": "uT"},  # a magnet nearby
    "barometer": {"channel": "height", "kind": "step", "size": 50.0, "unit": "m"},  # 6 hPa
    "airspeed": {"channel": "speed", "kind": "scale", "factor": 0.707},  # half the dynamic pressure
}
# What can be made to fail: the kind of sensor, and which of its channels that is, as a whole.
UNITS: Mapping[str, tuple[str, str]] = {
    "gnss": ("gnss", "fix"),
    "gyro": ("imu", "gyro"),
    "accelerometer": ("imu", "accel"),
    "magnetometer": ("magnetometer", "field"),
    "barometer": ("barometer", "pressure"),
    "airspeed": ("airspeed", "speed"),
}
KINDS = ("off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent", "ok")
NOISE_PERIOD_S = 4 * math.pi  # ArduPilot's SIM_GPS1_NOISE: sin(0.0005 times the milliseconds)
LARGEST_SPEED, SMALLEST_SPEED = 1000.0, 0.01
MAX_TICKS = 10**9  # more than any run has
ASK_EVERY_S = 0.02  # of wall time, while the run is paused
LONGEST_REQUEST = 512  # letters of its record


class Refused(Exception):
    """What was asked for can't be done; says why."""


@dataclass(frozen=True, slots=True)
class Inject:
    """Begin a fault now, until it is cleared: a ``[[fault]]`` table without its window."""

    fault: Mapping[str, object]


@dataclass(frozen=True, slots=True)
class Clear:
    """End now what was injected into a sensor, or only into its ``channel``; scheduled faults go on.

    The channel of a fault counts as another's if it is one of those that the other stands for, such as gyro_x of gyro.
    """

    sensor: str
    channel: str = ""


@dataclass(frozen=True, slots=True)
class Change:
    """Give a setting another value."""

    setting: str
    value: float


@dataclass(frozen=True, slots=True)
class End:
    """End the run here; what was recorded is concluded as usual."""


@dataclass(frozen=True, slots=True)
class Pause:
    """Hold simulated time until `Resume` or `Step`."""


@dataclass(frozen=True, slots=True)
class Resume:
    """Go on after `Pause`."""


@dataclass(frozen=True, slots=True)
class Toggle:
    """`Resume` if the run is paused, else `Pause`."""


@dataclass(frozen=True, slots=True)
class Step:
    """Go on for ``seconds`` of simulated time, then hold again."""

    seconds: float


@dataclass(frozen=True, slots=True)
class Speed:
    """Run at ``factor`` times the wall clock."""

    factor: float


@dataclass(frozen=True, slots=True)
class Faster:
    """Run ``times`` as fast as now, within what a speed may be."""

    times: float


@dataclass(frozen=True, slots=True)
class Restart:
    """Begin the run anew, at its first tick."""


Request: TypeAlias = Inject | Clear | Change | End | Pause | Resume | Toggle | Step | Speed | Faster | Restart
Recorded: TypeAlias = Inject | Clear | Change | End  # those that change what is computed
Event: TypeAlias = Callable[[float, str, str], None]  # time [s], severity, text
_RECORDED: Mapping[str, type[Recorded]] = {one.__name__.lower(): one for one in get_args(Recorded)}


# --- injection


def injection(scenario: Scenario, unit: str, kind: str, instance: int = 0) -> list[Request]:
    """What to ask for so that a unit fails in this way; see the head of this file.

    ``unit`` is a key of `UNITS`, ``kind`` one of `KINDS`, ``instance`` 0 for all and else the number of the unit in
    the order of the scenario, from 1. A failure takes the place of the one injected before into the same unit.
    Raises Refused when there is no such unit or kind.
    """
    if unit not in UNITS:
        raise Refused(f"{unit} can't be made to fail: choose from {', '.join(UNITS)}")
    if kind not in KINDS:
        raise Refused(f"{kind} is no way to fail: choose from {', '.join(KINDS)}")
    of_kind, channel = UNITS[unit]
    names = _named(scenario, of_kind)
    if not names:
        raise Refused(f"there is no {unit}")
    if not 0 <= instance <= len(names):
        raise Refused(f"there is no {unit} {instance}: choose from 1 to {len(names)}, or 0 for all")
    asked: list[Request] = []
    for name in names if instance == 0 else (names[instance - 1],):
        asked.append(Clear(name, channel if of_kind == "imu" else ""))
        if kind != "ok":
            asked.append(Inject({"sensor": name, **_failure(unit, kind)}))
    return asked


def _failure(unit: str, kind: str) -> dict[str, object]:
    """The keys of the fault."""
    of_kind, channel = UNITS[unit]
    part = {"channel": channel} if of_kind == "imu" else {}
    faults: dict[str, dict[str, object]] = {
        "off": {"kind": "dropout", **part},
        "stuck": {"kind": "stuck", "channel": channel},
        "garbage": {"kind": "garbage", "channel": channel},
        "wrong": dict(WRONG[unit]),
        "slow": {"kind": "slow", "factor": SLOW, **part},
        "delayed": {"kind": "delay", "channel": channel, "delay_s": DELAYED_S},
        "intermittent": {"kind": "intermittent", "period_s": INTERMITTENT_S, **part},
    }
    return faults[kind]


def _named(scenario: Scenario, kind: str) -> list[str]:
    return [name for name, config in scenario.sensors.items() if config.kind == kind]


_FAULT: TypeAdapter[FaultConfig] = TypeAdapter(Fault)


def _fault(scenario: Scenario, table: Mapping[str, object], start: float) -> FaultConfig:
    """The fault that a table asks for, from ``start`` [s] on. Raises Refused when there can be none such."""
    if "name" in table:
        raise Refused("no such fault: name: what is injected is named by what it is")
    try:
        fault = _FAULT.validate_python({**table, "window": (start, start + LONGEST_RUN_S)}, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise Refused(f"no such fault: {'.'.join(map(str, first['loc']))}: {first['msg']}") from None
    if fault.sensor not in scenario.sensors:
        raise Refused(f"no such fault: there is no sensor {fault.sensor!r}")
    sensor = scenario.sensors[fault.sensor]
    channel = getattr(fault, "channel", None)
    if channel is not None and channel not in _channels(sensor.kind):
        raise Refused(f"no such fault: {fault.sensor} has no channel {channel!r}")
    for key, complaint in mistakes(fault, sensor):
        raise Refused(f"no such fault: {key}: {complaint}")
    return fault


def _channels(kind: str) -> Sequence[str]:
    from testbed.sensors.faults import CHANNELS

    return list(CHANNELS.get(kind, {}))


# --- settings


@dataclass(frozen=True, slots=True)
class Setting:
    """What may be changed: its value at the start, the range, whether it is a whole number, its meaning with unit."""

    value: float
    least: float
    most: float
    whole: bool
    text: str


@dataclass(slots=True)
class Plant:
    """What requests act on: the parts of one run."""

    faults: Faults
    aiding: Mapping[str, AidingSensor]
    filters: Mapping[str, Lane]
    source: MotionSource


@dataclass(frozen=True, slots=True)
class _Knob:
    """A setting and what it does: the faults that a value means, or an action with the values of all settings."""

    setting: Setting
    faults: Callable[[float], Sequence[Mapping[str, object]]] | None = None
    act: Callable[[Plant, Mapping[str, float]], None] | None = None


def settings(scenario: Scenario) -> dict[str, Setting]:
    """What may change in flight, by the name that stations know it by: of at most 16 letters.

    Names and meanings are those of ArduPilot's simulation (libraries/SITL/SITL.cpp) where it has them. IMUs, receivers
    and the like are numbered in the order of the scenario.
    """
    return {name: knob.setting for name, knob in _knobs(scenario).items()}


def _knobs(scenario: Scenario) -> dict[str, _Knob]:
    knobs: dict[str, _Knob] = {}

    def switch(name: str, sensor: str, text: str, fails_at: int = 1, **fault: object) -> None:
        knobs[name] = _Knob(
            Setting(1 - fails_at, 0, 1, True, text),
            lambda value: [{"sensor": sensor, "kind": "dropout", **fault}] if value == fails_at else [],
        )

    for k, name in enumerate(_named(scenario, "gnss"), 1):
        switch(f"SIM_GPS{k}_ENABLE", name, f"{name}: 1 on, 0 says nothing", 0)
        knobs[f"SIM_GPS{k}_JAM"] = _Knob(
            Setting(0, 0, 1, True, f"{name}: 1 jammed, it has no fix"), act=_jamming(name, f"SIM_GPS{k}_JAM")
        )
        knobs[f"SIM_GPS{k}_NOISE"] = _Knob(
            Setting(0, 0, 1000, False, f"{name}: amplitude of a slow wave in altitude [m]"), _wave(name)
        )
    for k, name in enumerate(_named(scenario, "magnetometer"), 1):
        switch(f"SIM_MAG{k}_FAIL", name, f"{name}: 1 says nothing")
    for k, name in enumerate(_named(scenario, "barometer"), 1):
        switch("SIM_BARO_DISABLE" if k == 1 else f"SIM_BAR{k}_DISABLE", name, f"{name}: 1 says nothing")
    for k, name in enumerate(_named(scenario, "airspeed"), 1):
        knobs["SIM_ARSPD_FAIL" if k == 1 else f"SIM_ARSPD{k}_FAIL"] = _Knob(
            Setting(0, 0, 100, False, f"{name}: above 0 always this airspeed [m/s]"), _fixed_speed(name)
        )
    imus = _named(scenario, "imu")
    for k, name in enumerate(imus, 1):
        switch(f"SIM_ACCEL{k}_FAIL", name, f"{name}: 1 accelerometers stick", kind="stuck", channel="accel")
    for what, channel in (("GYR", "gyro"), ("ACC", "accel")) if imus else ():
        text = f"mask of the IMUs whose {channel} says nothing: 1 {imus[0]}, 2 the next"
        knobs[f"SIM_{what}_FAIL_MSK"] = _Knob(Setting(0, 0, 2 ** len(imus) - 1, True, text), _masked(imus, channel))
    truth = scenario.truth
    if isinstance(truth, FlightTruth) and not truth.wind.profile:
        wind = truth.wind
        knobs["SIM_WIND_SPD"] = _Knob(Setting(wind.speed_mps, 0, 50, False, "steady wind [m/s]"), act=_blow)
        knobs["SIM_WIND_DIR"] = _Knob(Setting(wind.from_deg % 360, 0, 360, False, "it comes from [deg]"), act=_blow)
    text = "simulated over wall time"
    knobs["SIM_SPEEDUP"] = _Knob(Setting(1, SMALLEST_SPEED, LARGEST_SPEED, False, text))
    for k, estimator in enumerate(scenario.estimator, 1):
        if isinstance(estimator, InsSection):
            key = f"EST{k}_FALSE_REJ"
            text = f"{estimator.name}: sound samples that its gate may refuse [1]; 0: no gate"
            gate = _gate(estimator.name, key)
            knobs[key] = _Knob(Setting(estimator.false_rejection, 0, 0.49, False, text), act=gate)
    return knobs


def _jamming(sensor: str, setting: str) -> Callable[[Plant, Mapping[str, float]], None]:
    def act(plant: Plant, values: Mapping[str, float]) -> None:
        receiver = plant.aiding[sensor]
        assert isinstance(receiver, Gnss)
        receiver.jammed = values[setting] > 0

    return act


def _wave(sensor: str) -> Callable[[float], Sequence[Mapping[str, object]]]:
    fault = {"sensor": sensor, "kind": "sine", "channel": "down", "period_s": NOISE_PERIOD_S}
    return lambda value: [{**fault, "size": -value}] if value > 0 else []


def _fixed_speed(sensor: str) -> Callable[[float], Sequence[Mapping[str, object]]]:
    fault = {"sensor": sensor, "kind": "stuck", "channel": "speed"}
    return lambda value: [{**fault, "value": value}] if value > 0 else []


def _masked(imus: Sequence[str], channel: str) -> Callable[[float], Sequence[Mapping[str, object]]]:
    return lambda value: [
        {"sensor": name, "kind": "dropout", "channel": channel}
        for bit, name in enumerate(imus)
        if int(value) >> bit & 1
    ]


def _blow(plant: Plant, values: Mapping[str, float]) -> None:
    blow = getattr(plant.source, "blow", None)
    if blow is None:
        raise Refused("this motion knows no wind")
    blow(values["SIM_WIND_DIR"], values["SIM_WIND_SPD"])


def _gate(estimator: str, setting: str) -> Callable[[Plant, Mapping[str, float]], None]:
    def act(plant: Plant, values: Mapping[str, float]) -> None:
        ins = plant.filters[estimator].horizon.estimator
        assert isinstance(ins, Ins)
        ins.set_gate(values[setting])

    return act


def _check(request: Recorded, scenario: Scenario, knobs: Mapping[str, _Knob], t: float) -> None:
    """Raise Refused when a request at ``t`` [s] makes no sense."""
    match request:
        case Inject(table):
            _fault(scenario, table, t)
        case Change(name, value):
            if name not in knobs:
                raise Refused(f"there is no setting {name}: choose from {', '.join(knobs)}")
            own = knobs[name].setting
            if not own.least <= value <= own.most or (own.whole and value != int(value)):
                whole = "a whole number " if own.whole else ""
                raise Refused(f"{name} {value:g}: must be {whole}from {own.least:g} to {own.most:g}")


# --- at work


class Desk:
    """Carries out, on the parts of one run, what changes its results; ``values`` are those of the settings now."""

    def __init__(self, scenario: Scenario, plant: Plant) -> None:
        self._scenario = scenario
        self._plant = plant
        self._knobs = _knobs(scenario)
        self.values = {name: knob.setting.value for name, knob in self._knobs.items()}
        self._open: dict[int, str] = {}  # faults that go on, by their place, and the setting that they come from

    def carry_out(self, request: Recorded, t: float) -> list[FaultTruth]:
        """Do it at ``t`` [s], the time of the next row; the faults that have ended by it. Raises Refused."""
        _check(request, self._scenario, self._knobs, t)
        match request:
            case Inject(table):
                self._begin(table, "", t)
            case Clear(sensor, channel):
                truth = self._plant.faults.truth
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
        self._open[self._plant.faults.add(_fault(self._scenario, table, t))] = setting

    def _end(self, which: Sequence[int], t: float) -> list[FaultTruth]:
        for k in which:
            del self._open[k]
        return [self._plant.faults.end(k, t) for k in which]

    def _change(self, name: str, value: float, t: float) -> list[FaultTruth]:
        knob, before = self._knobs[name], self.values[name]
        self.values[name] = value
        ended: list[FaultTruth] = []
        if knob.faults is not None and knob.faults(value) != knob.faults(before):
            ended = self._end([k for k, setting in self._open.items() if setting == name], t)
            for table in knob.faults(value):
                self._begin(table, name, t)
        if knob.act is not None:
            knob.act(self._plant, self.values)
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
        scenario: Scenario,
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
        self, desk: Desk, recorder: Recorder, emit: Event, say: Event, tell: Callable[[Mapping[str, float]], None]
    ) -> None:
        """A run begins, anew perhaps. ``emit`` tells and records events, ``say`` only tells; ``tell`` the settings."""
        self._desk, self._recorder, self._emit, self._say, self._tell = desk, recorder, emit, say, tell
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
        self._recorder.faults(self._desk.conclude(t))

    def _tell_settings(self) -> None:
        self._tell(self._desk.values | ({"SIM_SPEEDUP": self.pacer.factor} if self.pacer is not None else {}))

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
        ended = self._desk.carry_out(request, t)
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


# --- the record


def written(request: Recorded) -> tuple[str, str]:
    """Kind and content of a request as they are recorded."""
    return type(request).__name__.lower(), json.dumps(dataclasses.asdict(request))


def recorded(dataset: xarray.DataTree, scenario: Scenario) -> list[tuple[float, Recorded]]:
    """The requests of a recorded run with their times. Raises UserError when they make no sense in ``scenario``."""
    if "requests" not in dataset.children:
        return []
    group = dataset["requests"]
    knobs = _knobs(scenario)
    found: list[tuple[float, Recorded]] = []
    columns = (group.dataset[name].values.tolist() for name in ("time", "kind", "content"))
    for t, kind, content in zip(*columns, strict=True):
        try:
            fields: dict[str, Any] = json.loads(content)
            found.append((t, _RECORDED[kind](**fields)))
            _check(found[-1][1], scenario, knobs, t)
        except (KeyError, TypeError, ValueError):
            raise UserError(f"the record's request at {t:g} s can't be read: {kind} {content[:60]}") from None
        except Refused as reason:
            raise UserError(f"the record's request at {t:g} s does not fit the scenario: {reason}") from None
    return found
