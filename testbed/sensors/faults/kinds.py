"""The ``[[fault]]`` sections, one for each kind, and what can be wrong with one and a sensor together."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Field, field_validator

from testbed.schema import Section
from testbed.sensors.faults.channels import CHANNELS

Size: TypeAlias = Annotated[float, Field(ge=-1e9, le=1e9)]
Seconds: TypeAlias = Annotated[float, Field(ge=1e-3, le=1e6)]


class AnyFault(Section):
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


class OnChannel(AnyFault):
    """A fault of one channel."""

    channel: str = Field(description="quantity that it acts on; the choice depends on the sensor")
    bearing_deg: float | None = Field(
        None, ge=-360, le=360, description="direction of the offset, for channels that have none of their own"
    )


class Sized(OnChannel):
    """A fault that adds a size."""

    unit: str | None = Field(
        None, description="of the size: the channel's first unit unless given, another that fits, or `sigma`"
    )


class Step(Sized):
    """A constant offset."""

    kind: Literal["step"]
    size: Size = Field(description="the offset")

    def offset(self, tau: float) -> float:
        """What is added ``tau`` [s] after the start, in the fault's unit."""
        return self.size


class Ramp(Sized):
    """An offset that grows by ``slope`` per second."""

    kind: Literal["ramp"]
    slope: Size = Field(description="growth of the offset per second")

    def offset(self, tau: float) -> float:
        """What is added ``tau`` [s] after the start, in the fault's unit."""
        return self.slope * tau


class Quadratic(Sized):
    """An offset of ``coefficient`` times the square of the seconds."""

    kind: Literal["quadratic"]
    coefficient: Size = Field(description="the offset is this times the square of the seconds since the start")

    def offset(self, tau: float) -> float:
        """What is added ``tau`` [s] after the start, in the fault's unit."""
        return self.coefficient * tau**2


class Exponential(Sized):
    """An offset that settles at ``size``."""

    kind: Literal["exponential"]
    size: Size = Field(description="offset at which it settles")
    time_constant_s: Seconds = Field(description="after which 63 % of the offset are reached")

    def offset(self, tau: float) -> float:
        """What is added ``tau`` [s] after the start, in the fault's unit."""
        return -self.size * math.expm1(-tau / self.time_constant_s)


class Sine(Sized):
    """An oscillation of amplitude ``size``."""

    kind: Literal["sine"]
    size: Size = Field(description="amplitude")
    period_s: Seconds = Field(description="of the oscillation")

    def offset(self, tau: float) -> float:
        """What is added ``tau`` [s] after the start, in the fault's unit."""
        return self.size * math.sin(2 * math.pi * tau / self.period_s)


class Spikes(Sized):
    """Single samples that are off by ``size``, one every ``period_s``."""

    kind: Literal["spikes"]
    size: Size = Field(description="how far a spike is off")
    period_s: Seconds = Field(description="from one spike to the next")


class Stuck(Sized):
    """Always the same value."""

    kind: Literal["stuck"]
    value: Size | None = Field(None, description="what the sensor says; none: the last value before the window")


class Noise(OnChannel):
    """The stated 1-sigma is ``factor`` times as large."""

    kind: Literal["noise"]
    factor: float = Field(ge=1, le=1e6, description="how many times larger the white noise makes the stated 1-sigma")


class Scale(OnChannel):
    """The value times ``factor``."""

    kind: Literal["scale"]
    factor: Size = Field(description="what the value is multiplied by")


class Delay(OnChannel):
    """The value of ``delay_s`` ago, under the time of now."""

    kind: Literal["delay"]
    delay_s: float = Field(gt=0, le=3600, description="age of the value that is given for the present one")


class Garbage(OnChannel):
    """Random nonsense."""

    kind: Literal["garbage"]


class Losing(AnyFault):
    """A fault that loses samples."""

    channel: str | None = Field(None, description="of an IMU, whose other channels go on: `gyro` or `accel`; none: all")


class Dropout(Losing):
    """No samples."""

    kind: Literal["dropout"]


class Slow(Losing):
    """One sample of every ``factor``; an IMU, which is asked all the same, repeats its last rates."""

    kind: Literal["slow"]
    factor: int = Field(ge=2, le=10_000, description="of so many samples one is left; an IMU repeats its last rates")


class Intermittent(Losing):
    """Comes and goes: no samples during the first ``share`` of every ``period_s``."""

    kind: Literal["intermittent"]
    period_s: Seconds = Field(description="from one loss to the next")
    share: float = Field(
        0.5, gt=0, lt=1, description="of each period during which there are no samples, at its beginning"
    )


class DragOff(AnyFault):
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
DRAWN = (Noise, Garbage)  # of random numbers, which the seed of a run decides


def mistakes(fault: FaultConfig, sensor: Any) -> Iterator[tuple[str, str]]:
    """Key and complaint for everything about a fault that does not fit its ``sensor``'s section."""
    channels = CHANNELS.get(sensor.kind, {})
    if isinstance(fault, DragOff):
        if "position" not in channels:
            yield "kind", f"drag_off needs a sensor of position, and {fault.sensor!r} is of kind {sensor.kind!r}"
        if not fault.velocity_mps and not fault.acceleration_mps2:
            yield "kind", "drag_off needs velocity_mps, acceleration_mps2 or both: nothing would move"
    if isinstance(fault, Losing) and fault.channel in channels and sensor.kind != "imu":
        yield "channel", f"a sample of kind {sensor.kind!r} is lost as a whole: leave the channel out"
    if isinstance(fault, Slow) and fault.channel is None and sensor.kind == "imu":
        yield "channel", "is missing: gyros and accelerometers are slow each by themselves: add gyro or accel"
    if not isinstance(fault, OnChannel) or fault.channel not in channels:
        return
    channel = channels[fault.channel]
    if isinstance(fault, Noise) and channel.is_whole:
        yield "channel", f"{fault.channel!r} stands for several, whose noise is not the same: name one of them"
    elif isinstance(fault, Sized) and not isinstance(fault, Stuck) and not channel.has_size:
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
    if isinstance(fault, Sized) and fault.unit is not None:
        known = [*channel.units, "sigma"]
        in_sigmas = fault.unit == "sigma"
        if fault.unit not in known:
            yield "unit", f"{fault.unit!r} does not fit {fault.sensor} {fault.channel}: choose from {', '.join(known)}"
        if in_sigmas and isinstance(fault, Stuck):
            yield "unit", "a value is in no sigmas: give it in " + " or ".join(channel.units)
    if in_sigmas and channel.has_size and channel.sigma(sensor) <= 0:
        key = "factor" if isinstance(fault, Noise) else "unit"
        yield key, f"{fault.sensor!r} states no error of {fault.channel!r} to take multiples of: give a size"
