"""A recorded flight beside a simulation of it, or another log: do the sensors and the innovations look alike?"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import signal

from nav.samples import Array, ImuSamples
from testbed.errors import UserError
from testbed.feeds.survey import LEAST_REST_S, MOVING, Survey, between, usual_step
from testbed.record.reader import load
from testbed.score import accuracy, detection
from testbed.sensors.units import DEG, DEG_PER_H, DEG_PER_ROOT_H, MG, MICROTESLA, MPS_PER_ROOT_H

if TYPE_CHECKING:
    import xarray

ALIKE = 2.0  # figures within this factor of each other are alike
ROUNDING = 1e-9
BANDS_HZ = (0.5, 2.0, 8.0, 32.0, 128.0)
RECORD = "run.nc"
LEAST_INNOVATIONS = 30
LAG_SLACK_S = 0.015  # and what is not known of both


class Row(NamedTuple):
    """One figure of a sensor, or of an estimator's aid: of the flight and of the other one, NaN where it has none.

    ``slack`` is a difference that means nothing.
    """

    of: str
    what: str
    unit: str
    flight: float
    other: float
    slack: float = 0.0

    @property
    def ratio(self) -> float:
        """The other's size over the flight's; NaN where one of them is not known."""
        first, second = abs(self.flight), abs(self.other)
        if abs(first - second) <= self.slack:
            return 1.0
        if first:
            return second / first
        return math.nan if math.isnan(second) else math.inf

    @property
    def opposite(self) -> bool:
        """Of different signs, beyond the slack."""
        return self.flight * self.other < 0 and abs(self.flight - self.other) > self.slack

    @property
    def alike(self) -> bool:
        """Within `ALIKE` and of the same sign; what only one of them has is not."""
        within = (1 + ROUNDING) * self.ratio >= 1 / ALIKE and self.ratio <= (1 + ROUNDING) * ALIKE
        return within and not self.opposite


def called(other: Survey) -> str:
    """What a flight is beside: its simulation, of a record of simulated motion, or another log."""
    simulated = other.log.format == RECORD and "log" not in load(other.log.path).attrs
    return "simulation" if simulated else "other log"


def compare(flight: Survey, other: Survey) -> list[Row]:
    """Every figure that either has, of the sensors that both have by the same name.

    Two records of runs are compared by the innovations of the estimators too that both have.
    Raises UserError when there is no sensor in common.
    """
    common = [name for name in flight.log.names if name in other.log.names]
    if not common:
        raise UserError(
            f"{other.log.path}: has no sensor of the flight's: {', '.join(other.log.names)};"
            f" the flight has {', '.join(flight.log.names)}"
        )
    found = [row for name in common for row in _sensor(name, flight, other)]
    if flight.log.format == other.log.format == RECORD:
        found += _innovations(load(flight.log.path), load(other.log.path))
    return [row for row in found if not (math.isnan(row.flight) and math.isnan(row.other))]


def _sensor(name: str, *both: Survey) -> Iterator[Row]:
    def row(what: str, unit: str, values: list[float], scale: float = 1.0, slack: float = 0.0) -> Row:
        return Row(name, what, unit, values[0] / scale, values[1] / scale, slack)

    rates = [one.rates[name] for one in both]
    yield row("rate", "Hz", [one.rate_hz for one in rates])
    yield row("jitter of its times", "ms", [one.jitter_s for one in rates], 1e-3, slack=0.1)
    yield row("gaps in a thousand", "", [1e3 * one.gaps / one.count for one in rates], slack=0.1)
    if name in both[0].log.imus:
        yield from _inertial(name, *both)
    for what, unit, tables, scale, slack in (
        (
            "velocity is told of later by", "s", [{key: late.s for key, late in one.latency.items()} for one in both],
            1.0, LAG_SLACK_S + sum(one.latency[name].sigma for one in both if name in one.latency),
        ),
        ("true airspeed over the sensor's", "", [one.airspeed_scale for one in both], 1.0, 0.0),
        (
            "rms from the sphere that fits", "µT",
            [{key: sphere.residual for key, sphere in one.spheres.items()} for one in both], MICROTESLA,
            0.0,
        ),
    ):  # fmt: skip
        yield row(what, unit, [table.get(name, math.nan) for table in tables], scale, slack)


def _inertial(name: str, *both: Survey) -> Iterator[Row]:
    for field, what, unit, scale in (
        ("gyro_walk", "gyro noise at rest, Allan deviation at 1 s", "deg/√h", DEG_PER_ROOT_H),
        ("gyro_floor", "gyro floor at rest", "deg/h", DEG_PER_H),
        ("accel_walk", "accelerometer noise at rest, at 1 s", "m/s/√h", MPS_PER_ROOT_H),
        ("accel_floor", "accelerometer floor at rest", "mg", MG),
    ):
        first, second = (getattr(one.noise[name], field) if name in one.noise else math.nan for one in both)
        yield Row(name, what, unit, first / scale, second / scale)
    biases = [float(np.abs(one.noise[name].gyro_bias).max()) if name in one.noise else math.nan for one in both]
    yield Row(name, "largest gyro bias at rest", "deg/h", biases[0] / DEG_PER_H, biases[1] / DEG_PER_H)
    spectra = [_moving_spectrum(one, one.log.imus[name]) for one in both]
    for low, wide in itertools.pairwise(BANDS_HZ):
        high = min(wide, *(one.rates[name].rate_hz / 2 for one in both))  # of what neither unit feels nothing is said
        for k, (what, unit, scale) in enumerate((("rate", "deg/s", DEG), ("specific force", "m/s²", 1.0))):
            first, second = (_band(spectrum[0], spectrum[1][k], low, high) / scale for spectrum in spectra)
            yield Row(name, f"{what} in motion, {low:g} to {high:.3g} Hz, rms", unit, first, second)


def _moving_spectrum(found: Survey, imu: ImuSamples) -> tuple[Array, tuple[Array, Array]]:
    """Frequencies [Hz] and the densities of rate [rad^2/s^2/Hz] and force over the longest stretch that is no rest."""
    moving = max((p for p in found.phases if p.name in MOVING), key=lambda p: p.end - p.start, default=None)
    if moving is None or moving.end - moving.start < LEAST_REST_S:
        return np.empty(0), (np.empty(0), np.empty(0))
    part = between(found.log, imu, moving)
    if part.stop - part.start < 2:  # another unit was heard then
        return np.empty(0), (np.empty(0), np.empty(0))
    rate_hz = 1 / usual_step(imu.t[part])
    densities = []
    for increments in (imu.dtheta[part], imu.dv[part]):
        measured = increments / imu.dt[part, None]
        whole = np.where(np.isfinite(measured), measured, np.nanmean(measured, axis=0))  # in a gap
        frequency, density = signal.welch(whole, rate_hz, nperseg=min(1024, len(whole)), axis=0)
        densities.append(density.sum(axis=1))
    return frequency, (densities[0], densities[1])


def _band(frequency: Array, density: Array, low: float, high: float) -> float:
    """The rms between two frequencies; NaN where a spectrum does not reach the lower one."""
    inside = (frequency >= low) & (frequency < high)
    return math.sqrt(float(density[inside].sum()) * float(frequency[1])) if inside.any() else math.nan


def _innovations(flight: xarray.DataTree, other: xarray.DataTree) -> Iterator[Row]:
    """Of each aid: mean NIS, share refused, and how much an innovation has of the one before."""
    for estimator in accuracy.names(flight):
        if estimator not in accuracy.names(other):
            continue
        for aid in accuracy.aids(flight, estimator):
            if aid not in accuracy.aids(other, estimator):
                continue
            of = f"{estimator}: {aid}"
            first, second = (_statistics(one, estimator, aid) for one in (flight, other))
            yield Row(of, "NIS per degree of freedom", "", first.nis, second.nis)
            yield Row(of, "refused, percent", "", first.refused, second.refused, slack=1.0)
            yield Row(of, "correlation with the innovation before", "", first.memory, second.memory, slack=0.1)


class _Statistics(NamedTuple):
    nis: float = math.nan
    refused: float = math.nan
    memory: float = math.nan


def _statistics(dataset: xarray.DataTree, estimator: str, aid: str) -> _Statistics:
    looks = detection.judged(dataset, estimator, aid)
    if len(looks.nis) < LEAST_INNOVATIONS or not looks.components:
        return _Statistics()
    nu = accuracy.column(dataset, f"estimators/{estimator}/innovations/{aid}/innovation")
    nu = nu[np.isfinite(nu).all(axis=1)]
    memory = float(np.sum(nu[1:] * nu[:-1]) / np.sum(nu * nu))
    return _Statistics(float(looks.nis.mean()) / looks.components, 100 * float(looks.gated.mean()), memory)
