"""The truth table: what really happens, tick by tick, and the exact IMU increments between ticks.

A motion source (`testbed.motion.flight`, `testbed.motion.kinematic`) fills blocks of rows; sensors, record and metrics
read them.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from dataclasses import dataclass, fields
from operator import attrgetter
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.lib.format import open_memmap

from nav._jit import njit
from nav.earth import OMEGA_IE, ecef_components, gravity, quat_en_components
from nav.rotation import (
    Four,
    Three,
    left_jacobian_components,
    quat_multiply_components,
    quat_rotate_components,
    rotvec_components,
)
from nav.samples import Array
from testbed.errors import UserError

SAVE_TICKS = 20_000  # rows of a motion being stored that are in memory at a time
# Of the column leg, where no leg of a plan is flown. The launch ends with the row at which the aircraft is free.
OUTSIDE, CLIMBING_OUT, ON_GROUND = -1.0, -2.0, -3.0
FLYING_MPS = 8.0  # faster than this, through the air or over ground, is flight: well below any stall speed


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
    "leg": Column("1", 1, "index of the plan leg being flown; -1 outside a plan, -2 before it, -3 on the ground"),
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
        return TruthBlock(self.tick + start, *[column[start:stop] for column in _columns(self)])

    @staticmethod
    def empty(tick: int, n: int) -> TruthBlock:
        """A block of n rows filled with zeros, ready to be written."""
        columns = {name: np.zeros(n if c.width == 1 else (n, c.width)) for name, c in COLUMNS.items()}
        return TruthBlock(tick, **columns)


_columns = attrgetter(*(f.name for f in fields(TruthBlock) if f.name != "tick"))


class MotionSource(Protocol):
    """Whatever moves the body: a flight, a kinematic curve, a log.

    ``failure`` is empty unless the motion ended because control was lost; then it says how.
    """

    rate_hz: float
    failure: str

    def advance(self, ticks: int) -> TruthBlock:
        """The next ``ticks`` rows, fewer when the motion ends, none when it has ended. Starts at tick 0."""
        ...

    def activity(self) -> str:
        """What is going on, in a few words: ``loiter 3/12 turns``."""
        ...


@njit
def _plus(u: Three, factor: float, v: Three) -> Three:
    """The sum u + factor v."""
    return u[0] + factor * v[0], u[1] + factor * v[1], u[2] + factor * v[2]


@njit
def _inertial(lat: float, lon: float, h: float, v_n: Array, q_nb: Array) -> tuple[Four, Three, Three]:
    """Attitude q_eb, inertial velocity [m/s] and gravitation [m/s^2] of one row, both vectors in e axes."""
    q_en = quat_en_components(lat, lon)
    r_e = ecef_components(lat, lon, h)
    v_e = quat_rotate_components(q_en, v_n)
    # Gravity includes the centrifugal acceleration of the turning Earth, gravitation does not.
    g_e = quat_rotate_components(q_en, (0.0, 0.0, gravity(lat, h)))
    gravitation = g_e[0] - OMEGA_IE**2 * r_e[0], g_e[1] - OMEGA_IE**2 * r_e[1], g_e[2]
    v_i = v_e[0] - OMEGA_IE * r_e[1], v_e[1] + OMEGA_IE * r_e[0], v_e[2]
    return quat_multiply_components(q_en, q_nb), v_i, gravitation


@njit
def increments(t: Array, lat: Array, lon: Array, h: Array, v_n: Array, q_nb: Array) -> tuple[Array, Array]:
    """Exact IMU increments ``(dtheta, dv)``, each (N, 3), of motion given at N rows; row 0 is zero.

    Row k covers the interval from row k - 1: to join blocks, put the last row of the previous block first and drop
    row 0 of the result. Formed in inertial axes, without any navigation equation:

    dtheta = log(C_ib(k-1)^T C_ib(k))                                                           [rad]
    dv = J(dtheta)^-1 C_bi(k-1) (v_i(k) - v_i(k-1) - integral of gravitation)                     [m/s]

    with J the left Jacobian: the integrals of rate and specific force in turning body axes of the motion that has both
    constant in those axes between rows and meets every row. At the tick rate there is hence no coning or sculling left
    to compensate; an IMU that sums m of them shows what it would at its rate, less what goes on within one tick.

    The inertial axes are those of e at row k - 1, so nothing grows with time. The trapezoid of gravitation is good to
    1e-10 m/s^2 at 200 Hz.
    """
    dtheta, dv = np.zeros(v_n.shape), np.zeros(v_n.shape)
    q, v, gravitation = _inertial(lat[0], lon[0], h[0], v_n[0], q_nb[0])
    for k in range(1, len(t)):
        dt = t[k] - t[k - 1]
        q_next, v_next, gravitation_next = _inertial(lat[k], lon[k], h[k], v_n[k], q_nb[k])
        earth_turn = math.cos(0.5 * OMEGA_IE * dt), 0.0, 0.0, math.sin(0.5 * OMEGA_IE * dt)
        q_bi = q[0], -q[1], -q[2], -q[3]
        turn = rotvec_components(quat_multiply_components(q_bi, quat_multiply_components(earth_turn, q_next)))
        before = _plus(v, 0.5 * dt, gravitation)
        after = quat_rotate_components(earth_turn, _plus(v_next, -0.5 * dt, gravitation_next))
        gain = left_jacobian_components(turn, quat_rotate_components(q_bi, _plus(after, -1.0, before)))
        for axis in range(3):
            dtheta[k, axis], dv[k, axis] = turn[axis], gain[axis]
        q, v, gravitation = q_next, v_next, gravitation_next
    return dtheta, dv


class Replay:
    """A motion source that gives, row for row, what `save_motion` stored in a folder."""

    def __init__(self, folder: Path) -> None:
        stored = json.loads((folder / "motion.json").read_bytes())
        self.rate_hz = float(stored["rate_hz"])
        self.failure = ""
        self._failure = str(stored["failure"])
        self._rows = int(stored["rows"])
        self._columns = {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in COLUMNS}
        self._tick = 0

    def advance(self, ticks: int) -> TruthBlock:
        """The next ``ticks`` rows, as copies: numba would compile again for arrays that can't be written to."""
        rows = slice(self._tick, min(self._tick + ticks, self._rows))
        block = TruthBlock(self._tick, **{name: np.array(column[rows]) for name, column in self._columns.items()})
        self._tick += len(block)
        if len(block) < ticks:
            self.failure = self._failure
        return block

    def activity(self) -> str:
        """What is going on."""
        return "replay"


def _take_room(file: Path) -> None:
    """Take the room on the disk that a file is as long as: without any, writing to it as memory ends the process."""
    if hasattr(os, "posix_fallocate"):
        with file.open("r+b") as opened:
            os.posix_fallocate(opened.fileno(), 0, file.stat().st_size)


def save_motion(source: MotionSource, ticks: int, folder: Path) -> None:
    """Store the first ``ticks`` rows of a motion, one .npy per truth column, for `Replay`.

    The folder appears when it is complete. Raises UserError when it can't be written.
    """
    part = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    try:
        part.mkdir()
        columns = {
            name: open_memmap(part / f"{name}.npy", "w+", float, (ticks, c.width) if c.width > 1 else (ticks,))
            for name, c in COLUMNS.items()
        }
        for name in columns:
            _take_room(part / f"{name}.npy")
        rows = 0
        while rows < ticks and len(block := source.advance(min(SAVE_TICKS, ticks - rows))):
            for name, column in columns.items():
                column[rows : rows + len(block)] = getattr(block, name)
            rows += len(block)
        (part / "motion.json").write_text(
            json.dumps({"rate_hz": source.rate_hz, "rows": rows, "failure": source.failure})
        )
        part.rename(folder)
    except OSError as error:
        raise UserError(f"{folder}: can't store the flight: {error.strerror}") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)
