"""The truth table: what really happens, tick by tick, and the exact IMU increments between ticks.

A motion source (`testbed.flight`, `testbed.kinematic`) fills blocks of rows; sensors, record and metrics read them.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np

from nav.samples import Array


@dataclass(frozen=True, slots=True)
class Column:
    """Unit, frame and meaning of one truth column; ``width`` 1 is stored as (N,), else (N, width)."""

    unit: str
    width: int
    meaning: str


COLUMNS: dict[str, Column] = {
    "t": Column("s", 1, "time from the start of the run"),
    "lat": Column("rad", 1, "geodetic latitude, WGS84"),
    "lon": Column("rad", 1, "longitude, WGS84, in (-pi, pi]"),
    "h": Column("m", 1, "height above the ellipsoid"),
    "v_n": Column("m/s", 3, "velocity over ground, NED"),
    "q_nb": Column("1", 4, "attitude quaternion, body to NED, scalar first"),
    "omega_b": Column("rad/s", 3, "angular rate of b relative to i, body axes, at the tick"),
    "dtheta": Column("rad", 3, "integral of omega_b over the interval ending at this tick"),
    "dv": Column("m/s", 3, "integral of specific force at the centre of gravity over the same interval, body axes"),
    "wind_n": Column("m/s", 3, "velocity of the air over ground, turbulence included, NED"),
    "airspeed": Column("m/s", 1, "true airspeed"),
    "alpha": Column("rad", 1, "angle of attack"),
    "beta": Column("rad", 1, "angle of sideslip"),
    "pressure": Column("Pa", 1, "static pressure"),
    "temperature": Column("K", 1, "static air temperature"),
    "density": Column("kg/m^3", 1, "air density"),
    "engine_rpm": Column("1/min", 1, "crankshaft speed"),
    "current": Column("A", 1, "electrical current drawn by actuators and payload, source of magnetic disturbance"),
    "fuel": Column("kg", 1, "fuel on board"),
    "controls": Column("1", 4, "aileron, elevator, rudder, throttle after the actuators, normalised"),
    "commands": Column("rad, m, m/s", 3, "guidance commands: bank, altitude, true airspeed"),
    "leg": Column("1", 1, "index of the plan leg being flown, -1 outside a plan"),
}


@dataclass(frozen=True, slots=True)
class TruthBlock:
    """N consecutive rows of the truth table as arrays of float64, units and frames as in `COLUMNS`.

    ``tick`` is the number of the first row; row k is at tick + k. Row 0 of a run is the initial state,
    whose increments are zero.
    """

    tick: int
    t: Array
    lat: Array
    lon: Array
    h: Array
    v_n: Array
    q_nb: Array
    omega_b: Array
    dtheta: Array
    dv: Array
    wind_n: Array
    airspeed: Array
    alpha: Array
    beta: Array
    pressure: Array
    temperature: Array
    density: Array
    engine_rpm: Array
    current: Array
    fuel: Array
    controls: Array
    commands: Array
    leg: Array

    def __len__(self) -> int:
        return len(self.t)

    def rows(self, start: int, stop: int) -> TruthBlock:
        """Rows ``start:stop`` of this block as views."""
        columns = {f.name: getattr(self, f.name)[start:stop] for f in fields(self) if f.name != "tick"}
        return TruthBlock(self.tick + start, **columns)

    @staticmethod
    def empty(tick: int, n: int) -> TruthBlock:
        """A block of n rows filled with zeros, ready to be written."""
        columns = {name: np.zeros(n if c.width == 1 else (n, c.width)) for name, c in COLUMNS.items()}
        return TruthBlock(tick, **columns)


class MotionSource(Protocol):
    """Whatever moves the body: a flight, a kinematic curve, a log."""

    rate_hz: float

    def advance(self, ticks: int) -> TruthBlock:
        """The next ``ticks`` rows, fewer when the motion ends, none when it has ended. The first call starts at tick 0."""
        ...

    def activity(self) -> str:
        """What is going on, in a few words: ``loiter 3/12 turns``."""
        ...
