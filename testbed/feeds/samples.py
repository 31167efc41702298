"""Columns of a log as the samples that estimators take; what a log leaves out is NaN."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt

from nav.earth import SEA_LEVEL_DENSITY
from nav.samples import (
    AirspeedSample,
    Array,
    BarometerSample,
    FixType,
    GnssSample,
    ImuSamples,
    MagnetometerSample,
    Sample,
)
from testbed.feeds.stamps import left_out
from testbed.feeds.survey import usual_step
from testbed.sensors.gnss import NO_FIX_DOP, without_fix

UNKNOWN = np.full(3, np.nan)
HELD_SHARE = 0.9  # of a sensor's rows that are at the times of an inertial unit, if it is told with that
# What a slower clock makes: so many times that rows are held, and of these the share that last about as long as the
# usual one, to so much of it and of a row at least.
LEAST_HELD, ALIKE_SHARE, ALIKE, ALIKE_ROWS = 20, 0.9, 0.25, 1.5
# Or so many times that: at rest a coarse place is held for several epochs. By chance a share of 3/8 would do.
EPOCHS, LEAST_ROWS = 16, 8


class Fixes:
    """What a receiver said at times ``t`` (N,) [s]: latitude, longitude [rad], height [m], all (N,).

    What else it says is given afterwards, and NaN until then: velocity and 1-sigmas (N, 3) NED, type of fix,
    satellites, dilutions (N,). Without a type there is a fix where there is a position. In samples satellites that are
    not known are -1.
    """

    def __init__(self, t: Array, lat: Array, lon: Array, h: Array) -> None:
        n = len(t)
        self.t, self.lat, self.lon, self.h = t, lat, lon, h
        self.v_n, self.sigma_position_n, self.sigma_velocity_n = (np.full((n, 3), np.nan) for _ in range(3))
        known = np.isfinite(lat) & np.isfinite(lon) & np.isfinite(h)
        self.fix = np.where(known, int(FixType.FIX_3D), int(FixType.NO_FIX)).astype(float)
        self.satellites, self.hdop, self.vdop = (np.full(n, np.nan) for _ in range(3))

    def samples(self, name: str, notes: list[str] | None = None) -> list[Sample]:
        """The same as samples of the receiver ``name``; a velocity of which not all is known is none, and noted."""
        there = np.isfinite(self.v_n)
        half = there.any(axis=1) & ~there.all(axis=1) & (self.fix >= FixType.FIX_3D)
        if half.any() and notes is not None:
            lacking = ", ".join(np.array(["north", "east", "down"])[~there[half].all(axis=0)])
            notes.append(f"{name}: {half.sum()} of {len(half)} velocities have no {lacking}, and are taken for unknown")
        self.v_n = np.where(there.all(axis=1, keepdims=True), self.v_n, np.nan)
        return [self._sample(k, name) for k in range(len(self.t))]

    def _sample(self, k: int, name: str) -> Sample:
        t, fix = float(self.t[k]), self.fix[k]
        if not fix >= FixType.FIX_3D:  # NaN is no fix either
            return without_fix(t, t, name)
        hdop, vdop = (float(x) if x < NO_FIX_DOP else math.nan for x in (self.hdop[k], self.vdop[k]))
        return GnssSample(
            t, t, float(self.lat[k]), float(self.lon[k]), float(self.h[k]), self.v_n[k].copy(),
            _positive(self.sigma_position_n[k]), _positive(self.sigma_velocity_n[k]), FixType.FIX_3D,
            int(np.nan_to_num(self.satellites[k], nan=-1.0)), hdop, vdop, name,
        )  # fmt: skip


def _positive(sigma: Array) -> Array:
    """The same, or NaN where a receiver says something that is no accuracy."""
    return sigma.copy() if (sigma > 0).all() else UNKNOWN


def newly(
    name: str, t: Array, values: Mapping[str, Array], imus: Mapping[str, ImuSamples], notes: list[str]
) -> tuple[Array, dict[str, Array]]:
    """Times (N,) and quantities of a sensor without the rows that repeat the one before, of one that is only held.

    A table with a row for each of an inertial unit's says again what a slower sensor said last. That is so where all of
    it, to the last bit, is held about as long each time, or for about as many rows, as a slower clock makes it, or for
    several times of that, at the unit's own times: by a receiver that stands still at its own rate nothing is held, nor
    by a sensor of the unit's rate that says the same by chance, or since nothing changes. Of a receiver latitude and
    longitude tell, where the rest changes no more often: it may come in rows of its own. One of which it is not known
    is told.
    """
    if len(t) < 2 or not any(np.isin(t, imu.t).mean() > HELD_SHARE for imu in imus.values()):
        return t, dict(values)
    first = _changes(values.values())
    if "lat" in values and "lon" in values:
        placed = _changes([values["lat"], values["lon"]])
        if max(len(_changes([one])) for one in values.values()) <= (1 + ALIKE) * len(placed):
            first = placed
    rows = np.diff(first, append=len(t))
    lasts = np.diff(t[first], append=t[-1])
    if np.median(rows) < 2 or len(first) < LEAST_HELD:
        return t, dict(values)
    ways = ((rows, 1.0), (lasts, usual_step(t)))
    if max(_alike(*way) for way in ways) < ALIKE_SHARE and max(_of_epochs(*way) for way in ways) < ALIKE_SHARE:
        if "lat" in values:
            told = f"{len(t)} rows, at the times of an IMU, are all taken for new, and {len(first)} differ from the one"
            notes.append(left_out(name, f"{told} before: leave those blank that only hold it", len(t), len(t)))
        return t, dict(values)
    held = len(t) - len(first)
    told = f"{held} of {len(t)} rows, at the times of an IMU, hold what the one before had: left out"
    notes.append(left_out(name, told, held, len(t)))
    return t[first], {key: one[first] for key, one in values.items()}


def _alike(lasts: Array, step: float) -> float:
    """The share of times (N,) that are about as long as the usual one, where one row is a ``step``."""
    usual = float(np.median(lasts))
    return float(np.mean(np.abs(lasts - usual) <= max(ALIKE * usual, ALIKE_ROWS * step)))


def _of_epochs(lasts: Array, step: float) -> float:
    """The share of times (N,) up to `EPOCHS` epochs that are whole numbers of these, to `ALIKE_ROWS` steps at an end.

    An epoch is as long as the shortest are; 0 where few are, or where one is so short that most would do by chance.
    """
    epoch = float(np.mean(lasts[lasts <= 1.5 * np.quantile(lasts, 0.1)]))
    for most in (1, 4, EPOCHS):  # the longer they are the better they tell it
        number = np.maximum(np.round(lasts / epoch), 1)
        epoch = float(lasts[number <= most].sum() / number[number <= most].sum())
    known = number <= EPOCHS
    if epoch < LEAST_ROWS * step or np.sum(number == 1) < LEAST_HELD or 2 * known.sum() < len(lasts):
        return 0.0
    return float(np.mean(np.abs(lasts - number * epoch)[known] <= ALIKE_ROWS * step))


def _changes(values: Iterable[Array]) -> Array:
    """The rows (M,) that differ from the one before in any of the quantities, and the first."""
    rows = np.column_stack([np.nan_to_num(one.reshape(len(one), -1), nan=np.inf) for one in values])
    return np.concatenate([[0], 1 + np.flatnonzero((rows[1:] != rows[:-1]).any(axis=1))])


def barometers(name: str, t: Array, pressure: Array) -> list[Sample]:
    """Static pressures [Pa]."""
    return [BarometerSample(s, s, p, name) for s, p in zip(t.tolist(), pressure.tolist(), strict=True)]


def magnetometers(name: str, t: Array, field_b: Array, notes: list[str]) -> list[Sample]:
    """Magnetic fields (N, 3) [T], body axes. No field at all is that of a sensor that is not there: left out, noted."""
    there = field_b.any(axis=1)
    if not there.all():
        said = f"{np.sum(~there)} samples have no field at all" if there.any() else "it never has a field"
        notes.append(left_out(name, f"{said}: left out", int(np.sum(~there)), len(t)))
    rows = np.flatnonzero(there)
    return [MagnetometerSample(s, s, field_b[k].copy(), name) for k, s in zip(rows, t[rows].tolist(), strict=True)]


def airspeeds(name: str, t: Array, eas: Array) -> list[Sample]:
    """Equivalent airspeeds [m/s]."""
    return [AirspeedSample(s, s, v, name) for s, v in zip(t.tolist(), eas.tolist(), strict=True)]


def eas_of(dynamic_pressure: npt.ArrayLike) -> Array:
    """Equivalent airspeed [m/s] of a dynamic pressure [Pa]: none where it is negative."""
    eas: Array = np.sqrt(2 * np.maximum(dynamic_pressure, 0.0) / SEA_LEVEL_DENSITY)
    return eas


def spread(horizontal: npt.ArrayLike, vertical: npt.ArrayLike) -> Array:
    """Accuracies along north, east, down (N, 3) of those in the horizontal, per axis, and the vertical (N,)."""
    level = np.asarray(horizontal, float)
    sigma: Array = np.column_stack([level, level, np.asarray(vertical, float)])
    return sigma


def quaternions(roll: npt.ArrayLike, pitch: npt.ArrayLike, heading: npt.ArrayLike) -> Array:
    """Attitudes q_nb (N, 4) of angles (N,) [rad], as `nav.rotation.quat_from_euler`."""
    half = [0.5 * np.asarray(angle, float) for angle in (roll, pitch, heading)]
    (cr, cp, ch), (sr, sp, sh) = (np.cos(half), np.sin(half))
    q: Array = np.column_stack(
        [
            cr * cp * ch + sr * sp * sh,
            sr * cp * ch - cr * sp * sh,
            cr * sp * ch + sr * cp * sh,
            cr * cp * sh - sr * sp * ch,
        ]
    )
    return q
