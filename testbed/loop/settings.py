"""What may be changed while a run goes on: settings by the names that ground stations know, and what they act on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from nav.ins import Ins
from testbed.estimators.ins import InsSection
from testbed.motion.sections import FlightTruth
from testbed.scenario import Scenario
from testbed.sensors.faults import Faults

if TYPE_CHECKING:
    from testbed.estimators.lane import Lane
    from testbed.motion.table import MotionSource
    from testbed.sensors.gnss import Reception

from testbed.loop.injection import named
from testbed.loop.requests import Refused

NOISE_PERIOD_S = 4 * math.pi  # ArduPilot's SIM_GPS1_NOISE: sin(0.0005 times the milliseconds)
LARGEST_SPEED, SMALLEST_SPEED = 1000.0, 0.01


@dataclass(frozen=True, slots=True)
class Setting:
    """What may be changed: its value at the start, the range, whether it is a whole number, its meaning with unit."""

    value: float
    least: float
    most: float
    whole: bool
    text: str


@dataclass(slots=True)
class Parts:
    """What requests act on: the parts of one run."""

    faults: Faults
    receptions: Mapping[str, Reception]
    filters: Mapping[str, Lane]
    source: MotionSource


@dataclass(frozen=True, slots=True)
class Knob:
    """A setting and what it does: the faults that a value means, or an action with the values of all settings."""

    setting: Setting
    faults: Callable[[float], Sequence[Mapping[str, object]]] | None = None
    act: Callable[[Parts, Mapping[str, float]], None] | None = None


def settings(scenario: Scenario) -> dict[str, Setting]:
    """What may change in flight, by the name that stations know it by: of at most 16 letters.

    Names and meanings are those of ArduPilot's simulation (libraries/SITL/SITL.cpp) where it has them. IMUs, receivers
    and the like are numbered in the order of the scenario.
    """
    return {name: knob.setting for name, knob in knobs(scenario).items()}


def knobs(scenario: Scenario) -> dict[str, Knob]:
    """The settings of a scenario with what each does."""
    knobs: dict[str, Knob] = {}

    def switch(name: str, sensor: str, text: str, fails_at: int = 1, **fault: object) -> None:
        knobs[name] = Knob(
            Setting(1 - fails_at, 0, 1, True, text),
            lambda value: [{"sensor": sensor, "kind": "dropout", **fault}] if value == fails_at else [],
        )

    for k, name in enumerate(named(scenario, "gnss"), 1):
        switch(f"SIM_GPS{k}_ENABLE", name, f"{name}: 1 on, 0 says nothing", 0)
        knobs[f"SIM_GPS{k}_JAM"] = Knob(
            Setting(0, 0, 1, True, f"{name}: 1 jammed, it has no fix"), act=_jamming(name, f"SIM_GPS{k}_JAM")
        )
        knobs[f"SIM_GPS{k}_NOISE"] = Knob(
            Setting(0, 0, 1000, False, f"{name}: amplitude of a slow wave in altitude [m]"), _wave(name)
        )
    for k, name in enumerate(named(scenario, "magnetometer"), 1):
        switch(f"SIM_MAG{k}_FAIL", name, f"{name}: 1 says nothing")
    for k, name in enumerate(named(scenario, "barometer"), 1):
        switch("SIM_BARO_DISABLE" if k == 1 else f"SIM_BAR{k}_DISABLE", name, f"{name}: 1 says nothing")
    for k, name in enumerate(named(scenario, "airspeed"), 1):
        knobs["SIM_ARSPD_FAIL" if k == 1 else f"SIM_ARSPD{k}_FAIL"] = Knob(
            Setting(0, 0, 100, False, f"{name}: above 0 always this airspeed [m/s]"), _fixed_speed(name)
        )
    imus = named(scenario, "imu")
    for k, name in enumerate(imus, 1):
        switch(f"SIM_ACCEL{k}_FAIL", name, f"{name}: 1 accelerometers stick", kind="stuck", channel="accel")
    for what, channel in (("GYR", "gyro"), ("ACC", "accel")) if imus else ():
        text = f"mask of the IMUs whose {channel} says nothing: 1 {imus[0]}, 2 the next"
        knobs[f"SIM_{what}_FAIL_MSK"] = Knob(Setting(0, 0, 2 ** len(imus) - 1, True, text), _masked(imus, channel))
    truth = scenario.truth
    if isinstance(truth, FlightTruth) and truth.wind.one:
        wind = truth.wind
        knobs["SIM_WIND_SPD"] = Knob(Setting(wind.speed_mps, 0, 50, False, "mean wind [m/s]"), act=_blow)
        knobs["SIM_WIND_DIR"] = Knob(Setting(wind.from_deg % 360, 0, 360, False, "it comes from [deg]"), act=_blow)
    text = "simulated over wall time"
    knobs["SIM_SPEEDUP"] = Knob(Setting(1, SMALLEST_SPEED, LARGEST_SPEED, False, text))
    for k, estimator in enumerate(scenario.estimator, 1):
        if isinstance(estimator, InsSection):
            key = f"EST{k}_FALSE_REJ"
            text = f"{estimator.name}: sound samples that its gate may refuse [1]; 0: no gate"
            gate = _gate(estimator.name, key)
            knobs[key] = Knob(Setting(estimator.false_rejection, 0, 0.49, False, text), act=gate)
    return knobs


def _jamming(sensor: str, setting: str) -> Callable[[Parts, Mapping[str, float]], None]:
    def act(parts: Parts, values: Mapping[str, float]) -> None:
        parts.receptions[sensor].jammed = values[setting] > 0

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


def _blow(parts: Parts, values: Mapping[str, float]) -> None:
    blow = getattr(parts.source, "blow", None)
    if blow is None:
        raise Refused("this motion knows no wind")
    blow(values["SIM_WIND_DIR"], values["SIM_WIND_SPD"])


def _gate(estimator: str, setting: str) -> Callable[[Parts, Mapping[str, float]], None]:
    def act(parts: Parts, values: Mapping[str, float]) -> None:
        ins = parts.filters[estimator].horizon.estimator
        assert isinstance(ins, Ins)
        ins.set_gate(values[setting])

    return act
