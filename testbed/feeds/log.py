"""A recorded flight, whatever its format: what each sensor delivered, and what is known of the motion.

A format is one file beside this one, with ``read(path, columns) -> Log`` and a line in `testbed.feeds.formats`.
"""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from nav.earth import STANDARD_GRAVITY
from nav.samples import (
    AirspeedSample,
    Array,
    BarometerSample,
    BodyVelocitySample,
    GnssSample,
    ImuSamples,
    MagnetometerSample,
    OpticalFlowSample,
    PositionSample,
    RangeSample,
    Sample,
    StarSample,
    WindSample,
)
from testbed.errors import UserError
from testbed.motion.logged import Place

# What a sensor of each kind delivers.
SAMPLES: Mapping[str, type[Sample]] = {
    "gnss": GnssSample,
    "barometer": BarometerSample,
    "magnetometer": MagnetometerSample,
    "airspeed": AirspeedSample,
    "body_velocity": BodyVelocitySample,
    "star_tracker": StarSample,
    "position_fix": PositionSample,
    "rangefinder": RangeSample,
    "optical_flow": OpticalFlowSample,
    "wind_report": WindSample,
}

TABLE = "table"  # the format of what has columns, which a scenario names
LEAST_FORCE, MOST_FORCE = 0.6, 2.0  # of gravity, that a unit feels mostly: recorded ones 0.81 to 1.08
LONGEST_WAIT_S = 600.0  # for an inertial unit, of a log whose other sensors are heard before it

Samples: TypeAlias = Sequence[Sample]


@dataclass(frozen=True, slots=True)
class Reference:
    """The motion as somebody else knew it: ``name`` says who; rows at ``t`` (N,) [s], ascending.

    ``columns`` are those of the truth table that it has (`testbed.motion.table.COLUMNS`), NaN where it is silent.
    ``sigma_position_n`` [m] and ``sigma_velocity_n`` [m/s] (3,) are how good it is, 0 where it is the truth.
    ``point_b`` (3,) [m], b, is what it is of: 0 of what all lever arms begin at, or an antenna.
    """

    name: str
    t: Array
    columns: Mapping[str, Array]
    sigma_position_n: Array = field(default_factory=lambda: np.zeros(3))
    sigma_velocity_n: Array = field(default_factory=lambda: np.zeros(3))
    point_b: Array = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, slots=True)
class Log:
    """What a log has: increments by IMU and samples by sensor, ascending in time, SI and body axes; times its own [s].

    Without ``valid_times`` the times of samples are those at which they were told, and the sensor's latency is yet to
    be taken off. Accuracies and velocities that a receiver does not report are NaN. ``t0`` is when it begins,
    ``start`` where the log itself says that it begins; ``messages`` the number of each kind that the file holds;
    ``notes`` what was odd with it, a sentence each; ``remark`` what whoever is judged by its solution should know.
    ``utc`` is what its receiver says of the time at 0 of its clock [s since 1970], as late as that tells of a fix;
    ``solution_by_utc`` that the times of its solution are by that, and as late. Its clock ran ``pace`` times as fast as
    the times here.
    """

    path: Path
    format: str
    imus: Mapping[str, ImuSamples]
    samples: Mapping[str, Samples]
    solution: Reference | None
    t0: float
    messages: Mapping[str, int]
    notes: Sequence[str] = ()
    valid_times: bool = False
    date: dt.date | None = None
    start: Place | None = None
    remark: str = ""
    utc: float | None = None
    solution_by_utc: bool = False
    pace: float = 1.0

    @property
    def names(self) -> list[str]:
        """Its sensors."""
        return [*self.imus, *self.samples]

    @property
    def unit(self) -> str:
        """The first inertial unit that mostly feels gravity; where none does, the first that was heard."""
        heard = [name for name, imu in self.imus.items() if len(imu)] or [*self.imus]
        return next((name for name in heard if feels_gravity(self.imus[name])), heard[0])

    @property
    def receiver(self) -> str | None:
        """The first GNSS receiver with at least half as many fixes as the one with the most, None without a fix."""
        fixes = {
            name: sum(isinstance(one, GnssSample) and one.has_fix for one in own) for name, own in self.samples.items()
        }
        most = max(fixes.values(), default=0)
        return next((name for name, count in fixes.items() if most and 2 * count >= most), None)


def usual_force(imu: ImuSamples) -> float:
    """The median size of the specific force that a unit feels [m/s^2]; NaN where nothing of it is known."""
    size = np.linalg.norm(imu.dv, axis=1) / imu.dt
    known = size[np.isfinite(size)]
    return float(np.median(known)) if len(known) else math.nan


def feels_gravity(imu: ImuSamples) -> bool:
    """Whether a unit's usual force is about as much as gravity."""
    return LEAST_FORCE < usual_force(imu) / STANDARD_GRAVITY < MOST_FORCE


def beginning(
    imus: Mapping[str, ImuSamples], samples: Mapping[str, Samples], reference: Reference | None, notes: list[str]
) -> float:
    """When a log begins [s]: with its inertial units, or `LONGEST_WAIT_S` before at most, with what else is heard.

    What was heard longer before says nothing of a flight of which nothing is known up to there: told. Nor does a unit
    that was over by so long before the first of them began.
    """
    units = [imu for imu in imus.values() if len(imu)]
    moves = min(float(imu.t[0]) for imu in units if imu.t[-1] >= units[0].t[0] - LONGEST_WAIT_S)
    times = [moves]
    times += [own[0].t for own in samples.values() if own]
    if reference is not None and len(reference.t):
        times.append(float(reference.t[0]))
    earliest = min(times)
    if moves - earliest <= LONGEST_WAIT_S:
        return earliest
    notes.append(f"it begins with its IMU: what is heard up to {moves - earliest:.0f} s before is left out")
    return moves


def at_pace(log: Log, pace: float) -> Log:
    """The same in seconds as they are, of a log whose clock runs ``pace`` times as fast; told, if that is not 1.

    Rates are sensors' own, whatever the clock: increments are as much longer as the time that they are over.
    """
    if pace == 1.0:
        return log
    imus = {
        name: ImuSamples(imu.t / pace, imu.dt / pace, imu.dtheta / pace, imu.dv / pace)
        for name, imu in log.imus.items()
    }
    samples = {
        name: [replace(one, t=one.t / pace, t_arrival=one.t_arrival / pace) for one in own]
        for name, own in log.samples.items()
    }
    solution = None if log.solution is None else replace(log.solution, t=log.solution.t / pace)
    slow = (
        f"its clock runs {abs(pace - 1):.1%} too {'fast' if pace > 1 else 'slow'} by the receiver's: times are mended"
    )
    notes = [*log.notes, slow]
    return replace(log, imus=imus, samples=samples, solution=solution, t0=log.t0 / pace, notes=notes, pace=pace)


def require_imu(
    path: Path, imus: Mapping[str, ImuSamples], found: Mapping[str, int], needed: str, notes: Sequence[str] = ()
) -> None:
    """Raise UserError when a log has no inertial data, with what it has, what would be needed and what was odd."""
    if not any(len(imu) > 1 for imu in imus.values()):
        there = ", ".join(f"{name} ({count})" for name, count in sorted(found.items())) or "nothing at all"
        odd = "".join(f"; {note}" for note in notes)
        raise UserError(f"{path}: has no inertial data: needed are {needed}; it has {there}{odd}")


def require_one_clock(path: Path, imus: Mapping[str, ImuSamples], samples: Mapping[str, Samples]) -> None:
    """Raise UserError when a sensor of a table is apart from its first inertial unit by more than that could be.

    By more than `LONGEST_WAIT_S` and than it lasts: before that it may have been heard in another part of a flight.
    """
    unit, imu = next((name, imu) for name, imu in imus.items() if len(imu))
    begins, ends = float(imu.t[0]), float(imu.t[-1])
    spans = {unit: (begins, ends)} | {name: (own[0].t, own[-1].t) for name, own in samples.items() if own}
    most = max(ends - begins, LONGEST_WAIT_S)
    apart = [name for name, (first, last) in spans.items() if first - ends > most or begins - last > most]
    if apart:
        told = ", ".join(f"{name} from {spans[name][0]:.10g} to {spans[name][1]:.10g} s" for name in (unit, *apart))
        raise UserError(
            f"{path}: no time in common with {unit} has {', '.join(apart)} ({told}): clocks differ, or units: "
            "give truth.columns.<sensor>.time a unit, or an offset, which is added to it"
        )
