"""What of a sample can be wrong: its numbers by name, with the units they take."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from nav.earth import isa_pressure, pressure_altitude
from nav.rotation import quat_from_rotvec, quat_multiply
from nav.samples import Array
from testbed.sensors.gnss import displaced
from testbed.sensors.units import ARCSEC, DEG, DEG_PER_H, MG, MICROTESLA

PASCALS_PER_METRE = 12.0  # near the ground


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
class Increment:
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
    "rangefinder": {"range": _scalar("range", {"m": 1.0}, lambda c: c.errors().noise)},
    "optical_flow": {
        name: _component("flow_b", axis, {"rad/s": 1.0}, lambda c: c.errors().noise) for axis, name in enumerate("xy")
    },
    "wind_report": {
        name: _component("wind_n", axis, SPEEDS, lambda c: c.errors().noise)
        for axis, name in enumerate(("north", "east"))
    },
}
