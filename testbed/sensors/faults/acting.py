"""Faults at work on the samples of one run."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, overload

import numpy as np

from nav.samples import GnssSample, ImuSamples, Sample
from testbed.noise import stream
from testbed.sensors.faults.channels import CHANNELS, Increment
from testbed.sensors.faults.kinds import (
    Delay,
    DragOff,
    Dropout,
    Exponential,
    FaultConfig,
    Garbage,
    Intermittent,
    Losing,
    Noise,
    OnChannel,
    Quadratic,
    Ramp,
    Scale,
    Sine,
    Sized,
    Slow,
    Spikes,
    Step,
    Stuck,
)
from testbed.sensors.units import DEG

ON_THE_EDGE_S = 1e-6  # what times lose as decimal numbers
NONSENSE = (math.nan, math.inf, -math.inf, 1e300, -1e300, 1e18, -1e9)


@dataclass(frozen=True, slots=True)
class FaultTruth:
    """What is recorded of one fault; ``size`` is its principal number, in ``unit``. ``channel`` empty: all of them."""

    name: str
    sensor: str
    channel: str
    kind: str
    start: float
    end: float
    size: float
    unit: str

    def __str__(self) -> str:
        size = "" if math.isnan(self.size) else f" {self.size:g} {self.unit}"
        return f"{' '.join(filter(None, (self.sensor, self.channel, self.kind)))}{size}"


class _Running:
    """One fault at work on the samples of its sensor, in their order."""

    def __init__(self, fault: FaultConfig, sensor: Any, rng: np.random.Generator) -> None:
        self._fault = fault
        self._rng = rng
        self._channels = CHANNELS.get(sensor.kind, {})
        self.start, self.end = (edge - ON_THE_EDGE_S for edge in fault.window)
        self.listens = self.start  # from when on it has to see every sample; of earlier ones the newest will do
        self._before: deque[tuple[float, tuple[float, ...]]] = deque()
        self._next_spike = fault.window[0]
        self._seen = 0  # samples inside the window
        self._held: tuple[float, ...] = ()
        self._unit = 1.0
        self._bearing = 0.0
        self._sigma = 0.0
        if isinstance(fault, OnChannel):
            self._channel = self._channels[fault.channel]
            self._bearing = (fault.bearing_deg or 0.0) * DEG
            self._sigma = self._channel.sigma(sensor)
        if isinstance(fault, Sized):
            name = fault.unit or next(iter(self._channel.units))
            self._unit = self._sigma if name == "sigma" else self._channel.units[name]
        if isinstance(fault, Delay):
            self.listens -= fault.delay_s

    def act(self, sample: Any) -> Any:
        """What becomes of a sample, None when it is lost."""
        fault = self._fault
        if isinstance(sample, GnssSample) and not sample.has_fix and not isinstance(fault, Losing):
            return sample  # there is nothing in it that could be wrong
        if isinstance(fault, (Stuck, Delay)):
            self._remember(fault, sample)
        if not self.start <= sample.t < self.end:
            return sample
        tau = max(sample.t - fault.window[0], 0.0)
        match fault:
            case Step() | Ramp() | Quadratic() | Exponential() | Sine():
                return self._shifted(sample, self._unit * fault.offset(tau))
            case Spikes():
                if sample.t < self._next_spike - ON_THE_EDGE_S:
                    return sample
                self._next_spike = fault.window[0] + fault.period_s * (
                    1 + math.floor((tau + ON_THE_EDGE_S) / fault.period_s)
                )
                return self._shifted(sample, self._unit * fault.size)
            case Noise():
                sigma = math.sqrt(fault.factor**2 - 1) * self._sigma
                return self._shifted(sample, sigma * self._rng.standard_normal())
            case Scale():
                return self._channel.write(sample, [fault.factor * x for x in self._channel.read(sample)])
            case Stuck():
                stuck = self._before[0][1] if fault.value is None else [self._unit * fault.value]
                return self._channel.write(sample, stuck)
            case Delay():
                return self._channel.write(sample, self._before[0][1])
            case Garbage():
                picked = self._rng.integers(len(NONSENSE), size=len(self._channel.read(sample)))
                return self._channel.write(sample, [NONSENSE[k] for k in picked])
            case Dropout():
                return self._lost(fault, sample)
            case Slow():
                self._seen += 1
                delivers = self._seen % fault.factor == 1
                if fault.channel is None:
                    return sample if delivers else None
                channel = self._channels[fault.channel]
                self._held = channel.read(sample) if delivers else self._held
                return channel.write(sample, self._held)
            case Intermittent():
                phase = (tau + ON_THE_EDGE_S) % fault.period_s
                return self._lost(fault, sample) if phase < fault.share * fault.period_s else sample
            case DragOff():
                bearing = fault.bearing_deg * DEG
                away = fault.velocity_mps * tau + fault.acceleration_mps2 * tau**2 / 2
                sample = self._channels["position"].shift(sample, away, bearing)
                if "velocity" in self._channels:
                    speed = fault.velocity_mps + fault.acceleration_mps2 * tau
                    sample = self._channels["velocity"].shift(sample, speed, bearing)
                return sample

    def _lost(self, fault: Losing, sample: Any) -> Any:
        """None, or NaN in the channels of an increment: the time still passes."""
        if not isinstance(sample, Increment):
            return None
        for name in ("gyro", "accel") if fault.channel is None else (fault.channel,):
            channel = self._channels[name]
            sample = channel.write(sample, [math.nan] * len(channel.read(sample)))
        return sample

    def _shifted(self, sample: Any, size: float) -> Any:
        return self._channel.shift(sample, size, self._bearing)

    def _remember(self, fault: Stuck | Delay, sample: Any) -> None:
        """Keep the value to stick at, or all values since ``delay_s`` ago, that of then first."""
        if isinstance(fault, Stuck):
            if not self._before or sample.t < self.start:
                self._before.clear()
                self._before.append((sample.t, self._channel.read(sample)))
            return
        self._before.append((sample.t, self._channel.read(sample)))
        while len(self._before) > 1 and self._before[1][0] <= sample.t - fault.delay_s + ON_THE_EDGE_S:
            self._before.popleft()


class Faults:
    """All faults of a run. ``truth`` says what they are; they may be added and ended while the run goes on."""

    def __init__(self, faults: Sequence[FaultConfig], sensors: Mapping[str, Any], seed: int) -> None:
        self.truth: list[FaultTruth] = []
        self._sensors = sensors
        self._seed = seed
        self._running: dict[str, list[_Running]] = {}
        self._open: dict[int, _Running] = {}  # that may be ended yet, by their places in ``truth``
        for fault in faults:
            self.add(fault)

    def add(self, fault: FaultConfig) -> int:
        """One more fault, which acts on the samples that have yet to come; its place in ``truth``."""
        sensor = self._sensors[fault.sensor]
        rng = stream(self._seed, fault.sensor, f"fault {len(self.truth)}")
        running = self._open[len(self.truth)] = _Running(fault, sensor, rng)
        self._running.setdefault(fault.sensor, []).append(running)
        self.truth.append(_truth(fault, sensor, [one.name for one in self.truth]))
        return len(self.truth) - 1

    def end(self, index: int, t: float) -> FaultTruth:
        """End one at ``t`` [s], before the samples of then have been seen; what it is now known to have been."""
        self._open.pop(index).end = t - ON_THE_EDGE_S
        self.truth[index] = replace(self.truth[index], end=t)
        return self.truth[index]

    @overload
    def apply(self, sensor: str, samples: ImuSamples) -> ImuSamples: ...
    @overload
    def apply(self, sensor: str, samples: Sequence[Sample]) -> Sequence[Sample]: ...
    def apply(self, sensor: str, samples: ImuSamples | Sequence[Sample]) -> ImuSamples | Sequence[Sample]:
        """What the faults of a sensor make of a block of its samples, of any length."""
        running = self._running.get(sensor)
        if not running or not len(samples):
            return samples
        first = float(samples.t[0]) if isinstance(samples, ImuSamples) else samples[0].t
        running[:] = [one for one in running if first < one.end]  # the others are over for good
        if isinstance(samples, ImuSamples):
            return self._apply_imu(running, samples) if running else samples
        if not running:
            return samples
        last = samples[-1].t
        if not any(one.listens <= last and first < one.end for one in running):
            _act(running, samples[-1])  # which a fault that begins later may have to know
            return samples
        return [changed for sample in samples if (changed := _act(running, sample)) is not None]

    @staticmethod
    def _apply_imu(running: Sequence[_Running], imu: ImuSamples) -> ImuSamples:
        listening = any(one.listens <= imu.t[-1] and imu.t[0] < one.end for one in running)
        dtheta, dv = imu.dtheta, imu.dv
        for k in range(len(imu)) if listening else (len(imu) - 1,):
            row = Increment(float(imu.t[k]), float(imu.dt[k]), imu.dtheta[k], imu.dv[k])
            changed = _act(running, row)
            if changed is not row:
                if dtheta is imu.dtheta:
                    dtheta, dv = dtheta.copy(), dv.copy()
                dtheta[k], dv[k] = changed.dtheta, changed.dv
        return replace(imu, dtheta=dtheta, dv=dv)


def _act(running: Sequence[_Running], sample: Any) -> Any:
    for one in running:
        if sample is None:
            break
        sample = one.act(sample)
    return sample


def label(fault: FaultConfig, taken: Collection[str]) -> str:
    """The fault's name: its own, or one made of what it is that is not ``taken``."""
    if fault.name is not None:
        return fault.name
    made = "_".join(filter(None, (fault.sensor, getattr(fault, "channel", ""), fault.kind)))
    numbered = (f"{made}_{count}" for count in itertools.count(2))
    return next(name for name in itertools.chain([made], numbered) if name not in taken)


_SIZES = ("size", "slope", "coefficient", "value", "factor", "delay_s", "period_s", "velocity_mps")
_UNITS = {"noise": "times", "scale": "times", "delay": "s", "slow": "times", "intermittent": "s", "drag_off": "m/s"}
_PER = {"ramp": "/s", "quadratic": "/s^2"}


def _truth(fault: FaultConfig, sensor: Any, taken: Collection[str]) -> FaultTruth:
    size = next((value for key in _SIZES if (value := getattr(fault, key, None)) is not None), math.nan)
    unit = _UNITS.get(fault.kind, "")
    if isinstance(fault, DragOff) and not fault.velocity_mps:
        size, unit = fault.acceleration_mps2, "m/s^2"
    if isinstance(fault, Sized) and not math.isnan(size):
        unit = (fault.unit or next(iter(CHANNELS[sensor.kind][fault.channel].units))) + _PER.get(fault.kind, "")
    channel = getattr(fault, "channel", None) or ""
    return FaultTruth(label(fault, taken), fault.sensor, channel, fault.kind, *fault.window, float(size), unit)
