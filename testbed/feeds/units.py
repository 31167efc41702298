"""What the quantities of a table may be in, and which of two units were mixed up."""

from __future__ import annotations

import math
from collections.abc import Mapping

from testbed.sensors.units import DEG, DEG_PER_H, MG, MICROTESLA, G

LIKELY = 0.12  # by which a factor may be off one that units make

TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
ANGLE = {"rad": 1.0, "deg": DEG, "1e-7deg": 1e-7 * DEG}
LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3, "ft": 0.3048}
SPEED = {
    "m/s": 1.0,
    "cm/s": 1e-2,
    "mm/s": 1e-3,
    "km/h": 1 / 3.6,
    "kn": 1852 / 3600,
    "mph": 1609.344 / 3600,
    "ft/s": 0.3048,
}
PRESSURE = {"Pa": 1.0, "hPa": 100.0, "mbar": 100.0, "kPa": 1000.0}
ONE = {"1": 1.0}
# The units that a quantity may be in, the SI unit first.
UNITS: Mapping[str, Mapping[str, float]] = {
    "time": TIME,
    "gyro": {"rad/s": 1.0, "deg/s": DEG, "deg/h": DEG_PER_H, "rad": 1.0, "deg": DEG},
    "accel": {"m/s^2": 1.0, "g": G, "mg": MG, "m/s": 1.0},
    "lat": ANGLE,
    "lon": ANGLE,
    "height": LENGTH,
    "position": LENGTH,
    "velocity": SPEED,
    "sigma_position": LENGTH,
    "sigma_velocity": SPEED,
    "fix": ONE,
    "satellites": ONE,
    "hdop": ONE,
    "vdop": ONE,
    "pressure": PRESSURE,
    "field": {"T": 1.0, "uT": MICROTESLA, "nT": 1e-9, "G": 1e-4, "mG": 1e-7},
    "airspeed": SPEED,
    "attitude": ANGLE,
}


def mixed_up(factor: float, units: Mapping[str, float]) -> str:
    """Which of the ``units``, the SI unit first, was told as which, if ``factor`` mends it; empty where none fits."""
    plain = next(iter(units))
    pairs = {f"{unit} told as {plain}": size for unit, size in units.items() if unit != plain}
    pairs |= {f"{plain} told as {unit}": 1 / size for unit, size in units.items() if unit != plain}
    off = {pair: abs(math.log(factor / made)) for pair, made in pairs.items()}
    nearest = min(off, key=off.__getitem__)
    return nearest if off[nearest] < LIKELY else ""
