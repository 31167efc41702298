"""Failures that stations inject, as faults of scenario files without an end (`testbed.sensors.faults`).

What each
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

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from pydantic import TypeAdapter, ValidationError

from testbed.scenario import Scenario
from testbed.schema import LONGEST_RUN_S
from testbed.sensors.faults import CHANNELS, Fault, FaultConfig, mistakes

if TYPE_CHECKING:
    pass

from testbed.loop.requests import Clear, Inject, Refused, Request

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
    names = named(scenario, of_kind)
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


def named(scenario: Scenario, kind: str) -> list[str]:
    """The sensors of a kind, in the order of the scenario."""
    return [name for name, config in scenario.sensors.items() if config.kind == kind]


_FAULT: TypeAdapter[FaultConfig] = TypeAdapter(Fault)


def fault_of(scenario: Scenario, table: Mapping[str, object], start: float) -> FaultConfig:
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
    return list(CHANNELS.get(kind, {}))
