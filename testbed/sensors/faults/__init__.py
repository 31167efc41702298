"""Faults: what goes wrong with a sensor beyond its datasheet, and when.

A fault acts on samples that the healthy sensor has produced, so no noise stream is touched: other sensors keep their
bits, and so does this one outside the window. Faults on one channel act in the order of the file, each on what the one
before it left. A window [start, end) is in times of validity; after its end the sensor is as if nothing had been.

With tau = t - start [s] the kinds are::

    step         + size                                  ramp       + slope tau
    quadratic    + coefficient tau^2                     sine       + size sin(2 pi tau / period_s)
    exponential  + size (1 - exp(-tau / time_constant_s))
    spikes       + size on the first sample, and on the first after every period_s
    noise        white noise on top, so that the sensor's stated 1-sigma becomes factor times as large
    scale        the value times factor                  stuck      the last value before the window, or ``value``
    delay        the value of delay_s ago                dropout    no sample at all; an IMU's increments are NaN
    garbage      NaN, infinities and absurd numbers      slow       one sample of ``factor``; an IMU holds its rates
    intermittent a dropout during the first ``share`` of every period_s
    drag_off     spoofing: from the true position away along bearing_deg by velocity_mps tau +
                 acceleration_mps2 tau^2 / 2, and the velocity with it

Sizes are in the channel's unit, in another that fits it, or with ``unit = "sigma"`` in the sensor's own stated 1-sigma
of one sample: what a GNSS receiver reports, white noise elsewhere. What loses samples may name ``gyro`` or ``accel`` as
the channel of an IMU, and then loses these alone.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, TypeAlias, overload

import numpy as np
from pydantic import Field, field_validator

from nav.earth import isa_pressure, pressure_altitude
from nav.rotation import quat_from_rotvec, quat_multiply
from nav.samples import Array, GnssSample, ImuSamples, Sample
from testbed.schema import Section
from testbed.sensors.gnss import displaced
from testbed.sensors.noise import stream
from testbed.sensors.units import ARCSEC, DEG, DEG_PER_H, MG, MICROTESLA

Size: TypeAlias = Annotated[float, Field(ge=-1e9, le=1e9)]
Seconds: TypeAlias = Annotated[float, Field(ge=1e-3, le=1e6)]

ON_THE_EDGE_S = 1e-6  # what times lose as decimal numbers
PASCALS_PER_METRE = 12.0  # near the ground
NONSENSE = (math.nan, math.inf, -math.inf, 1e300, -1e300, 1e18, -1e9)


# --- channels


@dataclass(frozen=True, slots=True)
class Channel:
    """One quantity of a sample that a fault can act on.

    ``units`` by name, in SI, the default first; ``read`` and ``write`` its numbers as the sample holds them; ``shift``
    adds a size [SI] to it, along a bearing [rad] where the channel ``needs_bearing``; ``sigma`` is the stated 1-sigma
    of one sample [SI] by the sensor's section. Of a channel that ``has_zero`` a multiple and a given value make sense.
    One that ``is_whole`` stands for several: a size is added to each, and one that ``has_size`` False takes none.
    """

    units: Mapping[str, float]
    read: Callable[[Any], tuple[float, ...]]
    write: Callable[[Any, Sequence[float]], Any]
    shift: Callable[[Any, float, float], Any]
    sigma: Callable[[Any], float]
    has_zero: bool = True
    needs_bearing: bool = False
    is_whole: bool = False
    has_size: bool = True


@dataclass(frozen=True, slots=True)
class _Increment:
    """One row of `ImuSamples`."""

    t: float
    dt: float
    dtheta: Array
    dv: Array


def _changed(vector: Array, axis: int, value: float) -> Array:
    result = vector.copy()
    result[axis] = value
    return result


def _scalar(field: str, units: Mapping[str, float], sigma: Callable[[Any], float]) -> Channel:
    """A number of a sample."""
    return Channel(
        units,
        lambda s: (getattr(s, field),),
        lambda s, values: replace(s, **{field: values[0]}),
        lambda s, size, _: replace(s, **{field: getattr(s, field) + size}),
        sigma,
    )


def _component(field: str, axis: int, units: Mapping[str, float], sigma: Callable[[Any], float]) -> Channel:
    """One component of a vector of a sample."""
    return Channel(
        units,
        lambda s: (float(getattr(s, field)[axis]),),
        lambda s, values: replace(s, **{field: _changed(getattr(s, field), axis, values[0])}),
        lambda s, size, _: replace(s, **{field: _changed(getattr(s, field), axis, getattr(s, field)[axis] + size)}),
        sigma,
    )


def _rate(field: str, axis: int, units: Mapping[str, float], sigma: Callable[[Any], float]) -> Channel:
    """Mean rate or force over an increment of an IMU."""
    return Channel(
        units,
        lambda s: (float(getattr(s, field)[axis]) / s.dt,),
        lambda s, values: replace(s, **{field: _changed(getattr(s, field), axis, values[0] * s.dt)}),
        lambda s, size, _: replace(
            s, **{field: _changed(getattr(s, field), axis, getattr(s, field)[axis] + size * s.dt)}
        ),
        sigma,
    )


def _displaced(s: Any, north: float, east: float, down: float) -> Any:
    """A sample with ``lat``, ``lon``, ``h`` moved by metres, for moves that are small beside the Earth."""
    h = s.h if math.isfinite(s.h) else 0.0  # not every position has a height
    lat, lon, _ = displaced(s.lat, s.lon, h, np.array([north, east, down]))
    return replace(s, lat=lat, lon=lon, h=s.h - down)


Move: TypeAlias = Callable[[float, float], tuple[float, float, float]]  # size and bearing to north, east, down
METRES = {"m": 1.0}
SPEEDS = {"m/s": 1.0}
BODY_AXES = ("forward", "right", "down")


def _position(sigma: Callable[[Any, int], float]) -> dict[str, Channel]:
    """Position by axis, and horizontally along a bearing, of samples with ``lat``, ``lon``, ``h``."""

    def along(fields: tuple[str, ...], move: Move, axis: int) -> Channel:
        return Channel(
            METRES,
            lambda s: tuple(getattr(s, field) for field in fields),
            lambda s, values: replace(s, **dict(zip(fields, values, strict=True))),
            lambda s, size, bearing: _displaced(s, *move(size, bearing)),
            lambda c: sigma(c, axis),
            has_zero=False,
            needs_bearing=len(fields) == 2,
        )

    return {
        "north": along(("lat",), lambda d, _: (d, 0.0, 0.0), 0),
        "east": along(("lon",), lambda d, _: (0.0, d, 0.0), 1),
        "down": along(("h",), lambda d, _: (0.0, 0.0, d), 2),
        "position": along(("lat", "lon"), lambda d, b: (d * math.cos(b), d * math.sin(b), 0.0), 0),
    }


def _velocity(sigma: Callable[[Any, int], float]) -> dict[str, Channel]:
    """Velocity by axis, and horizontally along a bearing, of samples with ``v_n``."""
    horizontal = Channel(
        SPEEDS,
        lambda s: (float(s.v_n[0]), float(s.v_n[1])),
        lambda s, values: replace(s, v_n=np.array([*values, s.v_n[2]])),
        lambda s, size, b: replace(s, v_n=s.v_n + size * np.array([math.cos(b), math.sin(b), 0.0])),
        lambda c: sigma(c, 0),
        needs_bearing=True,
    )
    return {
        **{
            f"v_{name}": _component("v_n", axis, SPEEDS, lambda c, axis=axis: sigma(c, axis))  # type: ignore[misc]
            for axis, name in enumerate(("north", "east", "down"))
        },
        "velocity": horizontal,
    }


def _gnss_sigma(what: str) -> Callable[[Any, int], float]:
    def sigma(config: Any, axis: int) -> float:
        e = config.errors()
        return math.hypot(getattr(e, f"{what}_white_n")[axis], getattr(e, f"{what}_correlated_n")[axis])

    return sigma


def _imu_axes(what: str, field: str, units: Mapping[str, float]) -> dict[str, Channel]:
    """The three axes of the gyros or accelerometers, in the axes of the unit, and all at once; noise per increment."""

    def sigma(config: Any) -> float:
        return float(getattr(config.errors(), f"{what}_noise")) * math.sqrt(config.rate_hz)

    triad = Channel(
        units,
        lambda s: tuple((getattr(s, field) / s.dt).tolist()),
        lambda s, values: replace(s, **{field: np.array(values) * s.dt}),
        lambda s, size, _: replace(s, **{field: getattr(s, field) + size * s.dt}),
        sigma,
        is_whole=True,
    )
    return {
        **{f"{what}_{name}": _rate(field, axis, units, sigma) for axis, name in enumerate("xyz")},
        what: triad,
    }


def _turn(axis: int) -> Channel:
    """Attitude about one body axis, of samples with ``q_ib``; what sticks or is late is the attitude as a whole."""
    direction = np.eye(3)[axis]
    return Channel(
        {"arcsec": ARCSEC, "deg": DEG},
        lambda s: tuple(s.q_ib.tolist()),
        lambda s, values: replace(s, q_ib=np.array(values)),
        lambda s, size, _: replace(s, q_ib=quat_multiply(s.q_ib, quat_from_rotvec(size * direction))),
        lambda c: float(c.errors().noise_b[axis]),
        has_zero=False,
    )


_FIELD = Channel(
    {"uT": MICROTESLA},
    lambda s: tuple(s.field_b.tolist()),
    lambda s, values: replace(s, field_b=np.array(values)),
    lambda s, size, _: replace(s, field_b=s.field_b + size),
    lambda c: float(c.errors().noise),
    is_whole=True,
)

_FIX = Channel(
    METRES,
    lambda s: (s.lat, s.lon, s.h, *s.v_n.tolist()),
    lambda s, values: replace(s, lat=values[0], lon=values[1], h=values[2], v_n=np.array(values[3:])),
    lambda s, size, _: s,
    lambda c: 0.0,
    has_zero=False,
    is_whole=True,
    has_size=False,
)

_HEIGHT = Channel(
    METRES,
    lambda s: (s.pressure,),
    lambda s, values: replace(s, pressure=values[0]),
    lambda s, size, _: replace(s, pressure=float(isa_pressure(pressure_altitude(s.pressure) + size))),
    lambda c: c.errors().noise / PASCALS_PER_METRE,
    has_zero=False,
)

# By kind of sensor. A new kind of sample takes a row here, of these building blocks.
CHANNELS: Mapping[str, Mapping[str, Channel]] = {
    "imu": {
        **_imu_axes("gyro", "dtheta", {"deg/s": DEG, "deg/h": DEG_PER_H, "rad/s": 1.0}),
        **_imu_axes("accel", "dv", {"m/s^2": 1.0, "mg": MG}),
    },
    "gnss": {**_position(_gnss_sigma("position")), **_velocity(_gnss_sigma("velocity")), "fix": _FIX},
    "barometer": {
        "pressure": _scalar("pressure", {"Pa": 1.0, "hPa": 100.0}, lambda c: c.errors().noise),
        "height": _HEIGHT,
    },
    "magnetometer": {
        **{
            name: _component("field_b", axis, {"uT": MICROTESLA}, lambda c: c.errors().noise)
            for axis, name in enumerate("xyz")
        },
        "field": _FIELD,
    },
    "body_velocity": {
        name: _component("v_b", axis, SPEEDS, lambda c: c.errors().noise) for axis, name in enumerate(BODY_AXES)
    },
    "star_tracker": {name: _turn(axis) for axis, name in enumerate(BODY_AXES)},
    "position_fix": _position(lambda c, axis: float(c.errors().position_n[axis])),
    "airspeed": {"speed": _scalar("eas", SPEEDS, lambda c: c.errors().noise)},
}


# --- what a scenario says


class _Fault(Section):
    """Keys of every ``[[fault]]``. Metrics and events know it by its name."""

    name: str | None = Field(
        None,
        max_length=64,
        description="what metrics and events call it; sensor, channel and kind joined by _ where left out",
    )
    sensor: str = Field(description="name of the sensor that fails")
    window: tuple[float, float] = Field(
        description="start and end in seconds; afterwards the sensor is as if nothing had been"
    )

    @field_validator("window")
    @classmethod
    def _forwards(cls, window: tuple[float, float]) -> tuple[float, float]:
        start, end = window
        if start < 0:
            raise ValueError(f"[{start:g}, {end:g}] starts before the run; times are seconds from its start")
        if end <= start:
            raise ValueError(f"[{start:g}, {end:g}] ends before it starts; write [start, end] in seconds")
        return window


class _OnChannel(_Fault):
    channel: str = Field(description="quantity that it acts on; the choice depends on the sensor")
    bearing_deg: float | None = Field(
        None, ge=-360, le=360, description="direction of the offset, for channels that have none of their own"
    )


class _Sized(_OnChannel):
    unit: str | None = Field(
        None, description="of the size: the channel's first unit unless given, another that fits, or `sigma`"
    )


class Step(_Sized):
    """A constant offset."""

    kind: Literal["step"]
    size: Size = Field(description="the offset")

    def offset(self, tau: float) -> float:
        """What is added ``tau`` [s] after the start, in the fault's unit."""
        return self.size


class Ramp(_Sized):
    """An offset that grows by ``slope`` per second."""

    kind: Literal["ramp"]
    slope: Size = Field(description="growth of the offset per second")

    def offset(self, tau: float) -> float:
        """What is added ``tau`` [s] after the start, in the fault's unit."""
        return self.slope * tau


class Quadratic(_Sized):
    """An offset of ``coefficient`` times the square of the seconds."""

    kind: Literal["quadratic"]
    coefficient: Size = Field(description="the offset is this times the square of the seconds since the start")

    def offset(self, tau: float) -> float:
        """What is added ``tau`` [s] after the start, in the fault's unit."""
        return self.coefficient * tau**2


class Exponential(_Sized):
    """An offset that settles at ``size``."""

    kind: Literal["exponential"]
    size: Size = Field(description="offset at which it settles")
    time_constant_s: Seconds = Field(description="after which 63 % of the offset are reached")

    def offset(self, tau: float) -> float:
        """What is added ``tau`` [s] after the start, in the fault's unit."""
        return -self.size * math.expm1(-tau / self.time_constant_s)


class Sine(_Sized):
    """An oscillation of amplitude ``size``."""

    kind: Literal["sine"]
    size: Size = Field(description="amplitude")
    period_s: Seconds = Field(description="of the oscillation")

    def offset(self, tau: float) -> float:
        """What is added ``tau`` [s] after the start, in the fault's unit."""
        return self.size * math.sin(2 * math.pi * tau / self.period_s)


class Spikes(_Sized):
    """Single samples that are off by ``size``, one every ``period_s``."""

    kind: Literal["spikes"]
    size: Size = Field(description="how far a spike is off")
    period_s: Seconds = Field(description="from one spike to the next")


class Stuck(_Sized):
    """Always the same value."""

    kind: Literal["stuck"]
    value: Size | None = Field(None, description="what the sensor says; none: the last value before the window")


class Noise(_OnChannel):
    """The stated 1-sigma is ``factor`` times as large."""

    kind: Literal["noise"]
    factor: float = Field(ge=1, le=1e6, description="how many times larger the white noise makes the stated 1-sigma")


class Scale(_OnChannel):
    """The value times ``factor``."""

    kind: Literal["scale"]
    factor: Size = Field(description="what the value is multiplied by")


class Delay(_OnChannel):
    """The value of ``delay_s`` ago, under the time of now."""

    kind: Literal["delay"]
    delay_s: float = Field(gt=0, le=3600, description="age of the value that is given for the present one")


class Garbage(_OnChannel):
    """Random nonsense."""

    kind: Literal["garbage"]


class _Losing(_Fault):
    channel: str | None = Field(None, description="of an IMU, whose other channels go on: `gyro` or `accel`; none: all")


class Dropout(_Losing):
    """No samples."""

    kind: Literal["dropout"]


class Slow(_Losing):
    """One sample of every ``factor``; an IMU, which is asked all the same, repeats its last rates."""

    kind: Literal["slow"]
    factor: int = Field(ge=2, le=10_000, description="of so many samples one is left; an IMU repeats its last rates")


class Intermittent(_Losing):
    """Comes and goes: no samples during the first ``share`` of every ``period_s``."""

    kind: Literal["intermittent"]
    period_s: Seconds = Field(description="from one loss to the next")
    share: float = Field(
        0.5, gt=0, lt=1, description="of each period during which there are no samples, at its beginning"
    )


class DragOff(_Fault):
    """Spoofing: position and velocity are drawn away together, smoothly."""

    kind: Literal["drag_off"]
    bearing_deg: float = Field(ge=-360, le=360, description="true direction of the pull")
    velocity_mps: Size = Field(default=0.0, description="at which the position leaves from the start of the window")
    acceleration_mps2: Size = Field(default=0.0, description="by which that velocity grows")


FaultConfig: TypeAlias = (
    Step
    | Ramp
    | Quadratic
    | Exponential
    | Sine
    | Spikes
    | Stuck
    | Noise
    | Scale
    | Delay
    | Garbage
    | Dropout
    | Slow
    | Intermittent
    | DragOff
)
Fault: TypeAlias = Annotated[FaultConfig, Field(discriminator="kind")]


def mistakes(fault: FaultConfig, sensor: Any) -> Iterator[tuple[str, str]]:
    """Key and complaint for everything about a fault that does not fit its ``sensor``'s section."""
    channels = CHANNELS.get(sensor.kind, {})
    if isinstance(fault, DragOff):
        if "position" not in channels:
            yield "kind", f"drag_off needs a sensor of position, and {fault.sensor!r} is of kind {sensor.kind!r}"
        if not fault.velocity_mps and not fault.acceleration_mps2:
            yield "kind", "drag_off needs velocity_mps, acceleration_mps2 or both: nothing would move"
    if isinstance(fault, _Losing) and fault.channel in channels and sensor.kind != "imu":
        yield "channel", f"a sample of kind {sensor.kind!r} is lost as a whole: leave the channel out"
    if isinstance(fault, Slow) and fault.channel is None and sensor.kind == "imu":
        yield "channel", "is missing: gyros and accelerometers are slow each by themselves: add gyro or accel"
    if not isinstance(fault, _OnChannel) or fault.channel not in channels:
        return
    channel = channels[fault.channel]
    if isinstance(fault, Noise) and channel.is_whole:
        yield "channel", f"{fault.channel!r} stands for several, whose noise is not the same: name one of them"
    elif isinstance(fault, _Sized) and not isinstance(fault, Stuck) and not channel.has_size:
        yield "channel", f"{fault.channel!r} stands for several of different units: name one of them"
    if channel.needs_bearing and fault.bearing_deg is None and not isinstance(fault, (Stuck, Delay, Scale, Garbage)):
        yield "channel", f"{fault.channel!r} has no direction of its own: add bearing_deg"
    if not channel.needs_bearing and fault.bearing_deg is not None:
        yield "bearing_deg", f"{fault.channel!r} has its own direction: leave the bearing out"
    if not channel.has_zero and isinstance(fault, Scale):
        yield "kind", f"a multiple of {fault.channel!r} means nothing: choose another kind"
    valued = channel.has_zero and not channel.needs_bearing and not channel.is_whole
    if isinstance(fault, Stuck) and fault.value is not None and not valued:
        yield "value", f"{fault.channel!r} takes no value: leave it out, and it sticks where it was"
    in_sigmas = isinstance(fault, Noise)
    if isinstance(fault, _Sized) and fault.unit is not None:
        known = [*channel.units, "sigma"]
        in_sigmas = fault.unit == "sigma"
        if fault.unit not in known:
            yield "unit", f"{fault.unit!r} does not fit {fault.sensor} {fault.channel}: choose from {', '.join(known)}"
        if in_sigmas and isinstance(fault, Stuck):
            yield "unit", "a value is in no sigmas: give it in " + " or ".join(channel.units)
    if in_sigmas and channel.has_size and channel.sigma(sensor) <= 0:
        key = "factor" if isinstance(fault, Noise) else "unit"
        yield key, f"{fault.sensor!r} states no error of {fault.channel!r} to take multiples of: give a size"


# --- at work


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
        if isinstance(fault, _OnChannel):
            self._channel = self._channels[fault.channel]
            self._bearing = (fault.bearing_deg or 0.0) * DEG
            self._sigma = self._channel.sigma(sensor)
        if isinstance(fault, _Sized):
            name = fault.unit or next(iter(self._channel.units))
            self._unit = self._sigma if name == "sigma" else self._channel.units[name]
        if isinstance(fault, Delay):
            self.listens -= fault.delay_s

    def act(self, sample: Any) -> Any:
        """What becomes of a sample, None when it is lost."""
        fault = self._fault
        if isinstance(sample, GnssSample) and not sample.has_fix and not isinstance(fault, _Losing):
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

    def _lost(self, fault: _Losing, sample: Any) -> Any:
        """None, or NaN in the channels of an increment: the time still passes."""
        if not isinstance(sample, _Increment):
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
            row = _Increment(float(imu.t[k]), float(imu.dt[k]), imu.dtheta[k], imu.dv[k])
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
    if isinstance(fault, _Sized) and not math.isnan(size):
        unit = (fault.unit or next(iter(CHANNELS[sensor.kind][fault.channel].units))) + _PER.get(fault.kind, "")
    channel = getattr(fault, "channel", None) or ""
    return FaultTruth(label(fault, taken), fault.sensor, channel, fault.kind, *fault.window, float(size), unit)
