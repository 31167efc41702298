"""Instants of a run as stations are told of them: truth, estimates, samples, and what follows from them.

`Moments` are columns of many; a `Snapshot` is one of them, `Rows` are some.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from nav._jit import njit
from nav.columns import Estimates
from nav.earth import position_difference_n, pressure_altitude
from nav.rotation import euler_from_quat, quat_conjugate, quat_multiply, rotvec_from_quat
from nav.samples import AirspeedSample, Array, BarometerSample, GnssSample, Sample, Status
from testbed.loop.links import Beside
from testbed.mavlink.encode import boot_ms, microseconds
from testbed.mavlink.hearing import Hearing, Places, S
from testbed.mavlink.identity import Identity
from testbed.mavlink.verdicts import ShutOut
from testbed.motion.table import FLYING_MPS

Point: TypeAlias = tuple[float, float, float]
# Blocks of an estimate's covariance.
POSITION, VELOCITY, ATTITUDE = slice(0, 3), slice(3, 6), slice(6, 9)
DOWN, HEADING = slice(2, 3), slice(8, 9)


@dataclass
class Moments:
    """N instants of a run as one vehicle has them.

    ``truth`` are columns of `testbed.motion.table.COLUMNS`, ``ticks`` their numbers. ``gyro`` [rad/s] and ``accel``
    [m/s^2] (N, 3) are the newest inertial readings; ``home`` (N, 3) (lat, lon, h) the origin of local coordinates, NaN
    until the estimator is aligned; ``ratios`` the newest innovation over its gate, by aid: from which instants on, and
    which; ``shut_out`` whom the estimator has shut out; ``legs`` how
    many the plan has; ``start_us`` the run's start in microseconds since 1970.
    """

    ticks: npt.NDArray[np.int64]
    truth: Mapping[str, Array]
    estimates: Estimates
    others: Sequence[Beside]
    gyro: Array
    accel: Array
    hearing: Hearing
    home: Array
    ratios: Mapping[str, tuple[Sequence[int], Sequence[float]]]
    shut_out: Sequence[ShutOut]
    legs: int
    identity: Identity
    start_us: int

    def __len__(self) -> int:
        return len(self.ticks)

    @cached_property
    def aligned(self) -> list[bool]:
        """Whether the estimator is."""
        found: list[bool] = _aligned(self.estimates).tolist()
        return found

    @cached_property
    def points(self) -> Array:
        """Estimated lat, lon [rad], h [m] (N, 3), NaN where they are not known."""
        return known_points(self.estimates)

    def snapshot(self, row: int) -> Snapshot:
        """One of them."""
        return Snapshot(self, row)


class Snapshot:
    """One instant of a run, in the numbers that several messages share; worked out when first asked for."""

    def __init__(self, moments: Moments, row: int) -> None:
        self._moments, self._row = moments, row
        self.t = float(moments.truth["t"][row])
        self.identity, self.legs, self.start_us = moments.identity, moments.legs, moments.start_us
        self._disbelieved = moments.shut_out[row].sensors

    @property
    def aligned(self) -> bool:
        """Whether the estimator is."""
        return self._moments.aligned[self._row]

    @property
    def status(self) -> int:
        """The estimator's, as a number of `Status`."""
        return int(self._moments.estimates.status[self._row])

    @property
    def leg(self) -> float:
        """The leg of the plan that is flown."""
        return float(self._moments.truth["leg"][self._row])

    @property
    def inertial(self) -> bool:
        """Whether the inertial reading is one."""
        row = self._row
        return all(map(math.isfinite, self._moments.gyro[row].tolist() + self._moments.accel[row].tolist()))

    @cached_property
    def home(self) -> Point | None:
        """The origin of local coordinates."""
        lat, lon, h = self._moments.home[self._row].tolist()
        return None if lat != lat else (lat, lon, h)

    @cached_property
    def alone(self) -> Rows:
        """The same as one row."""
        return Rows([(self._moments, np.array([self._row]))])

    @property
    def gnss_fix(self) -> GnssSample | None:
        """The receiver's newest epoch if it has a fix."""
        receiver = self.newest(GnssSample)
        return receiver if receiver and receiver.has_fix else None

    @cached_property
    def boot_ms(self) -> int:
        """Time since boot [ms]."""
        return boot_ms(self.t)

    @cached_property
    def usec(self) -> int:
        """Time since boot [us]."""
        return microseconds(self.t)

    @property
    def pressure(self) -> float:
        """Measured static pressure [Pa], NaN when it is not known."""
        barometer = self.newest(BarometerSample)
        return float(barometer.pressure) if barometer else math.nan

    @property
    def eas(self) -> float:
        """Measured equivalent airspeed [m/s], NaN when it is not known."""
        pitot = self.newest(AirspeedSample)
        return float(pitot.eas) if pitot else math.nan

    @cached_property
    def point(self) -> Point | None:
        """Estimated (lat, lon, h)."""
        lat, lon, h = self._moments.points[self._row].tolist()
        return None if lat != lat else (lat, lon, h)

    @cached_property
    def v_n(self) -> list[float]:
        """Estimated velocity [m/s], NED."""
        return floats(self._moments.estimates.v_n[self._row])

    @cached_property
    def groundspeed(self) -> float:
        """Estimated horizontal speed over ground [m/s]."""
        return math.hypot(self.v_n[0], self.v_n[1])

    def works(self, kind: type[S]) -> bool:
        """Whether the first sensor of this kind says something, and is believed."""
        sample = self.newest(kind)
        return sample is not None and sample.sensor not in self._disbelieved

    @cached_property
    def doubted(self) -> bool:
        """Whether the estimator does not believe a receiver that has a fix."""
        fix = self.gnss_fix
        return fix is not None and fix.sensor in self._disbelieved

    @cached_property
    def flying(self) -> bool | None:
        """Whether the vehicle is in the air, as far as it can tell itself."""
        speeds = [speed for speed in (self.eas, self.groundspeed) if math.isfinite(speed)]
        return max(speeds) > FLYING_MPS if speeds else None

    def newest(self, kind: type[S]) -> S | None:
        """The newest sample of the first sensor of this kind, None when there is none or it is silent."""
        return cast("S | None", self._moments.hearing.newest(kind, self._row))

    def knows(self, kind: type[Sample]) -> bool:
        """Whether any sensor of this kind has ever said something."""
        return self._moments.hearing.knows(kind, self._row)

    @property
    def fixed(self) -> bool:
        """Whether any sensor tells where the vehicle is."""
        return self._moments.hearing.fixed(self._row)

    @property
    def wind(self) -> tuple[Array, Array] | None:
        """Estimated wind (north, east) [m/s] and its 1-sigma, of an estimator that has wind states."""
        found = self._moments.estimates.extra.get("wind")
        if found is None or found[0].shape[1] < 2:  # an estimator of the user's may call another thing so
            return None
        wind, sigma = (column[self._row, :2] for column in found)
        return None if np.isnan((wind, sigma)).all() else (wind, sigma)

    def sigma(self, block: slice, dimensions: int = 3) -> float:
        """Root of the summed variances of the first ``dimensions`` components of a block of the covariance."""
        return root(self._moments.estimates.covariance[self._row].diagonal()[block][:dimensions])

    def ratio(self, aid: str) -> float:
        """Newest innovation of an aid over its gate, NaN when it is not known."""
        rows, ratios = self._moments.ratios.get(aid, ((), ()))
        at = bisect_right(rows, self._row) - 1
        return float(ratios[at]) if at >= 0 else math.nan


def known_points(estimates: Estimates) -> Array:
    """Lat, lon [rad], h [m] (N, 3) of estimates, NaN where one has no position."""
    points = np.column_stack([estimates.lat, estimates.lon, estimates.h])
    known = _aligned(estimates) & np.isfinite(points.sum(axis=1))
    points[~known] = math.nan
    return points


def _aligned(estimates: Estimates) -> npt.NDArray[np.bool_]:
    return np.asarray((estimates.status & Status.ALIGNED) != 0)


def floats(x: Array) -> list[float]:
    """Python's own floats of an array."""
    values: list[float] = x.tolist()  # encoding Python's own floats is several times faster
    return values


def root(variances: Array) -> float:
    """Root of summed variances, NaN where their sum is negative."""
    total = float(variances.sum())
    return math.sqrt(total) if total >= 0 else math.nan


class Rows:
    """Several instants of a run at once, for messages that go out often: each number is an array, a row an instant.

    What is not known is NaN; a vector is known or not as a whole.
    """

    def __init__(self, parts: Sequence[tuple[Moments, Places]]) -> None:
        """Of each of several `Moments` some."""
        self._parts = parts
        self._t = self.truth("t")

    def __len__(self) -> int:
        return len(self._t)

    @cached_property
    def snapshots(self) -> list[Snapshot]:
        """The same one by one."""
        return [moments.snapshot(row) for moments, rows in self._parts for row in rows.tolist()]

    def _of(self, column: Callable[[Moments], npt.NDArray[Any]]) -> npt.NDArray[Any]:
        return np.concatenate([column(moments)[rows] for moments, rows in self._parts])

    @cached_property
    def boot_ms(self) -> Array:
        """Time since boot [ms], as `encode.boot_ms` has it."""
        found = np.rint(self._t * 1e3) % 2**32
        return np.where(np.isfinite(found), found, 0.0)

    @cached_property
    def usec(self) -> Array:
        """Time since boot [us], 0 when it is not finite."""
        return np.where(np.isfinite(self._t * 1e6), np.rint(self._t * 1e6), 0.0)

    # The estimate

    @cached_property
    def q_nb(self) -> Array:
        """Estimated attitude (N, 4)."""
        return self._of(lambda one: one.estimates.q_nb)

    @cached_property
    def euler(self) -> Array:
        """Estimated roll, pitch, heading (N, 3) [rad]."""
        return _eulers(self.q_nb, self._of(lambda one: _aligned(one.estimates)))

    @cached_property
    def rates(self) -> Array:
        """Angular rate (N, 3) [rad/s], body: the gyro less its estimated bias; Earth and transport rate are left in."""
        bias: Array = self._of(lambda one: one.estimates.gyro_bias)
        return self.gyro - bias

    @cached_property
    def point(self) -> Array:
        """Estimated lat, lon [rad], h [m] (N, 3)."""
        return self._of(lambda one: one.points)

    @cached_property
    def local_n(self) -> Array:
        """Estimated position from home (N, 3) [m], NED."""
        return position_difference_n(*self.point.T, *self._of(lambda one: one.home).T)

    @cached_property
    def v_n(self) -> Array:
        """Estimated velocity (N, 3) [m/s], NED."""
        return self._of(lambda one: one.estimates.v_n)

    @cached_property
    def covariance(self) -> Array:
        """Of position, velocity and attitude (N, 9, 9)."""
        return self._of(lambda one: one.estimates.covariance)

    @cached_property
    def gyro_bias_variance(self) -> Array:
        """Of the gyro's bias (N, 3) [rad^2/s^2]."""
        return self._of(lambda one: one.estimates.sigma_gyro_bias) ** 2

    @cached_property
    def second(self) -> Array:
        """Roll, pitch, heading, lat, lon [rad], h [m] (N, 6) of the second estimator."""
        return self._of(lambda one: _pose(one, 0))

    @cached_property
    def third(self) -> Array:
        """The same of the third."""
        return self._of(lambda one: _pose(one, 1))

    # Samples

    @cached_property
    def gyro(self) -> Array:
        """Newest angular rate measured (N, 3) [rad/s]."""
        return self._of(lambda one: one.gyro)

    @cached_property
    def accel(self) -> Array:
        """Newest specific force measured (N, 3) [m/s^2]."""
        return self._of(lambda one: one.accel)

    @cached_property
    def field_b(self) -> Array:
        """Newest magnetic field measured (N, 3) [T]."""
        return self._of(lambda one: one.hearing.field_b)

    @cached_property
    def pressure(self) -> Array:
        """Static pressure measured [Pa]."""
        return self._of(lambda one: one.hearing.pressure)

    @cached_property
    def pressure_altitude(self) -> Array:
        """Height in the standard atmosphere [m] that belongs to the pressure, NaN where that is not above zero."""
        return np.array([pressure_altitude(p) if p > 0 else math.nan for p in self.pressure.tolist()])

    @cached_property
    def eas(self) -> Array:
        """Equivalent airspeed measured [m/s]."""
        return self._of(lambda one: one.hearing.eas)

    # The truth

    def truth(self, name: str) -> Array:
        """A column of truth, (N,) or (N, width)."""
        return self._of(lambda one: one.truth[name])

    @cached_property
    def true_point(self) -> Array:
        """True lat, lon [rad], h [m] (N, 3); a log may not know them."""
        return np.column_stack([self.truth(name) for name in ("lat", "lon", "h")])

    @cached_property
    def true_euler(self) -> Array:
        """True roll, pitch, heading (N, 3) [rad]."""
        return _euler_rows(self.truth("q_nb"))

    @cached_property
    def specific_force(self) -> Array:
        """True specific force over the last tick (N, 3) [m/s^2], body."""
        ticks = self._of(lambda one: one.ticks).astype(float)
        dt = np.where(ticks == 0, math.inf, self._t / ticks)
        return self.truth("dv") / dt[:, None]

    @cached_property
    def errors(self) -> dict[str, Array]:
        """Estimate less truth, and the estimator's own idea of it."""
        position = position_difference_n(*self.point.T, *self.true_point.T)
        velocity = self.v_n - self.truth("v_n")
        turn = _turns(self.q_nb, self.truth("q_nb"))
        return {
            "err_tilt": np.degrees(np.hypot(turn[:, 0], turn[:, 1])),
            "err_head": np.degrees(turn[:, 2]),
            "sig_tilt": np.degrees(self._sigma(ATTITUDE, 2)),
            "sig_head": np.degrees(self._sigma(HEADING)),
            "err_horiz": np.hypot(position[:, 0], position[:, 1]),
            "err_down": position[:, 2],
            "err_vel": np.linalg.norm(velocity, axis=1),
            "sig_horiz": self._sigma(POSITION, 2),
            "sig_down": self._sigma(DOWN),
            "sig_vel": self._sigma(VELOCITY),
        }

    def _sigma(self, block: slice, dimensions: int = 3) -> Array:
        """As `Snapshot.sigma`."""
        variances = np.diagonal(self.covariance, axis1=1, axis2=2)[:, block][:, :dimensions]
        total: Array = variances.sum(axis=1)
        return np.sqrt(total)


def _pose(moments: Moments, index: int) -> Array:
    """Roll, pitch, heading, lat, lon [rad], h [m] (N, 6) of an estimator beside the shown one."""
    pose = np.full((len(moments), 6), math.nan)
    if index < len(moments.others):
        other = moments.others[index]
        known = np.flatnonzero(other.at >= 0)
        own = other.estimates[other.at[known].tolist()]
        pose[known, :3] = _eulers(own.q_nb, _aligned(own))
        pose[known, 3:] = known_points(own)
    return pose


def _eulers(q_nb: Array, aligned: npt.NDArray[np.bool_]) -> Array:
    """Roll, pitch, heading (N, 3) [rad], NaN of what is not aligned and has no attitude."""
    found = _euler_rows(q_nb)
    found[~(aligned & np.isfinite(found).all(axis=1))] = math.nan
    return found


@njit
def _euler_rows(q_nb: Array) -> Array:
    """`euler_from_quat` of each row (N, 4)."""
    found = np.empty((len(q_nb), 3))
    for k in range(len(q_nb)):
        found[k] = euler_from_quat(q_nb[k])
    return found


@njit
def _turns(estimated: Array, true: Array) -> Array:
    """Rotation vectors (N, 3) from one attitude (N, 4) to the other."""
    found = np.empty((len(estimated), 3))
    for k in range(len(estimated)):
        found[k] = rotvec_from_quat(quat_multiply(estimated[k], quat_conjugate(true[k])))
    return found
