"""Three-axis magnetometer: the geomagnetic field in body axes, bent by iron and currents on board."""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from nav._jit import njit
from nav.columns import delivered
from nav.rotation import quat_conjugate, quat_rotate
from nav.samples import Array, MagnetometerSample, Sample
from testbed.errors import UserError
from testbed.motion.table import TruthBlock
from testbed.noise import Process, stream
from testbed.sensors.grades import with_grade
from testbed.sensors.site import Site
from testbed.sensors.timing import AidingTiming, Schedule
from testbed.sensors.units import DEG, MICROTESLA, PERCENT

NANOTESLA = 1e-9
WMM_YEARS = (2010, 2030)  # covered by the models that pygeomag carries, five years each

GRADES: dict[str, dict[str, Any]] = {
    "perfect": {},
    # Bosch BMM350 data sheet BST-BMM350-DS001: noise 190 nT rms, range +-2000 uT. What calibration on the aircraft
    # leaves of hard and soft iron, and the stray field of the wiring, are assumed.
    "mems": {
        "noise_ut": 0.19,
        "hard_iron_ut": 0.5,
        "soft_iron_percent": 0.5,
        "current_ut_per_a": 0.05,
        "range_ut": 2000.0,
    },
    # Beside motor and wiring, hardly calibrated: residuals of 17 to 24 mG, scales off by 5 % on recorded flights, and
    # 0.04 to 0.15 uT/A of the motor's current on two (12 A in cruise: 1 to 2 uT, 3 uT or so at full throttle).
    "hobby": {
        "noise_ut": 0.5,
        "hard_iron_ut": 6.0,
        "soft_iron_percent": 5.0,
        "current_ut_per_a": 0.1,
        "doubt_percent": 100.0,
        "follow_s": 60.0,
        "fused_hz": 10.0,
        "range_ut": 400.0,
    },
}


def decimal_year(date: datetime.date) -> float:
    """The date as a year with a fraction, as geomagnetic models take it."""
    start, end = datetime.date(date.year, 1, 1), datetime.date(date.year + 1, 1, 1)
    return date.year + (date - start).days / (end - start).days


def covered(date: datetime.date) -> datetime.date:
    """The same date. Raises ValueError when no magnetic model covers it."""
    if not WMM_YEARS[0] <= date.year < WMM_YEARS[1]:
        years = f"from {WMM_YEARS[0]} to {WMM_YEARS[1] - 1}"
        raise ValueError(
            f"there is no geomagnetic model for {date}: choose one {years}, as the World Magnetic Model is"
        )
    return date


@lru_cache(maxsize=4)
def _model(year: int) -> Any:
    from pygeomag import GeoMag  # type: ignore[import-untyped]

    return GeoMag(base_year=year)


def geomagnetic_field_n(lat: float, lon: float, h: float, date: datetime.date) -> Array:
    """Main field of the Earth (3,) [T], north-east-down, from the World Magnetic Model of the date.

    ``lat``, ``lon`` geodetic [rad], ``h`` above the ellipsoid [m]. Source: WMM2010 to WMM2025 (NOAA NCEI and BGS),
    which give the main field to about 0.14 uT and know no local anomaly. Raises UserError for a date that no model
    covers.
    """
    try:
        covered(date)
    except ValueError as error:
        raise UserError(f"date: {error}") from None
    at = _model(date.year).calculate(glat=lat / DEG, glon=lon / DEG, alt=h / 1000, time=decimal_year(date))
    return np.array([at.x, at.y, at.z]) * NANOTESLA


class FieldMap:
    """The field near a moving point, interpolated linearly on a fixed lattice of latitude, longitude and height.

    The model itself takes 0.1 ms. Nodes depend on nothing but the date, so results do not depend on the way there; the
    interpolation errs by less than 1 nT below 80 deg of latitude.
    """

    STEP = np.array([0.1 * DEG, 0.1 * DEG, 5000.0])  # lat, lon [rad], h [m]

    def __init__(self, date: datetime.date) -> None:
        self._date = date
        self._nodes: dict[tuple[int, int, int], Array] = {}
        self._cell: tuple[int, int, int] | None = None
        self._corners = np.zeros((2, 2, 2, 3))

    def field_n(self, lat: float, lon: float, h: float) -> Array:
        """The field (3,) [T], north-east-down."""
        field: Array = self.along(np.array([[lat, lon, h]]))[0]
        return field

    def along(self, lla: Array) -> Array:
        """The field (N, 3) [T], north-east-down, at places (N, 3) one after the other."""
        fields, at = np.empty(lla.shape), lla / self.STEP
        cells = np.floor(at)
        edges = 1 + np.flatnonzero((cells[1:] != cells[:-1]).any(axis=1))
        for first, last in pairwise([0, *edges.tolist(), len(lla)]):
            i, j, k = cells[first].astype(int).tolist()
            if (i, j, k) != self._cell:
                self._enter((i, j, k))
            _interpolate(self._corners, at[first:last] - cells[first], fields[first:last])
        return fields

    def _enter(self, cell: tuple[int, int, int]) -> None:
        self._cell = cell
        for corner in np.ndindex(2, 2, 2):
            i, j, k = cell[0] + corner[0], cell[1] + corner[1], cell[2] + corner[2]
            if (i, j, k) not in self._nodes:
                at = np.array([i, j, k]) * self.STEP
                lat = min(max(at[0], -math.pi / 2), math.pi / 2)
                self._nodes[i, j, k] = geomagnetic_field_n(lat, math.remainder(at[1], 2 * math.pi), at[2], self._date)
            self._corners[corner] = self._nodes[i, j, k]


@njit
def _interpolate(corners: Array, inside: Array, values: Array) -> None:
    """Trilinear interpolation between ``corners`` (2, 2, 2, 3) at ``inside`` (N, 3), in [0, 1], into ``values``."""
    values[:] = 0.0
    for row in range(len(inside)):
        x, y, z = inside[row]
        for i in range(2):
            for j in range(2):
                for k in range(2):
                    weight = (x if i else 1 - x) * (y if j else 1 - y) * (z if k else 1 - z)
                    for c in range(3):
                        values[row, c] += weight * corners[i, j, k, c]


@dataclass(frozen=True, slots=True)
class MagnetometerErrors:
    """The sensor's datasheet in SI, 1 sigma per axis: ``noise``, ``hard_iron`` [T], ``soft_iron`` [1],
    ``current`` [T/A], ``throttle`` [T] at full throttle, ``latency`` [s]; ``doubt`` [1] as `nav.aids.MagnetometerAid`
    has it.
    """

    noise: float
    hard_iron: float
    soft_iron: float
    current: float
    throttle: float
    latency: float
    doubt: float


class MagnetometerConfig(AidingTiming):
    """Keys of a magnetometer. ``grade`` sets the errors; each may be given to override it."""

    kind: Literal["magnetometer"] = Field(
        default="magnetometer", description="what the sensor is; the table's name where it is left out"
    )
    grade: Literal["perfect", "mems", "hobby"] = Field(
        default="mems", description="datasheet that presets every error below"
    )

    noise_ut: float = Field(0.0, ge=0, le=1000, description="white noise per axis")
    hard_iron_ut: float = Field(0.0, ge=0, le=1000, description="constant offset per axis that calibration left")
    soft_iron_percent: float = Field(
        0.0, ge=0, le=50, description="each element of the soft iron matrix that calibration left"
    )
    current_ut_per_a: float = Field(
        0.0, ge=0, le=100, description="stray field of the wiring per axis and ampere of the aircraft's current"
    )
    throttle_ut: float = Field(
        0.0, ge=0, le=1000, description="stray field per axis of what feeds a motor at full throttle; told to filters"
    )
    doubt_percent: float = Field(
        0.0, ge=0, le=1000, description="told to filters: doubt of each axis, of what the field's length is off by"
    )
    follow_s: float = Field(
        0.0, ge=0, le=3600, description="told to an INS: over which its noise and doubt follow innovations; 0: not"
    )
    range_ut: float | None = Field(None, gt=0, le=1e6, description="largest field per axis; none: no limit")

    @model_validator(mode="before")
    @classmethod
    def _on_top_of_grade(cls, data: Any) -> Any:
        return with_grade(data, GRADES, "mems")

    def errors(self) -> MagnetometerErrors:
        """The same in SI."""
        return MagnetometerErrors(
            noise=self.noise_ut * MICROTESLA,
            hard_iron=self.hard_iron_ut * MICROTESLA,
            soft_iron=self.soft_iron_percent * PERCENT,
            current=self.current_ut_per_a * MICROTESLA,
            throttle=self.throttle_ut * MICROTESLA,
            latency=self.latency_s,
            doubt=self.doubt_percent * PERCENT,
        )


class Magnetometer:
    """One magnetometer on one run: measured = (I + soft iron) C_bn field_n + hard iron + wiring * current
    + motor * throttle + noise, throttle from 0 to 1.
    """

    def __init__(self, name: str, config: MagnetometerConfig, tick_rate_hz: float, seed: int, site: Site) -> None:
        self.name = name
        self.rate_hz = config.rate_hz
        self.errors = e = config.errors()
        self._schedule = Schedule.of(name, config, tick_rate_hz)
        self._map = FieldMap(site.date)
        self._map.field_n(site.lat, site.lon, site.h)  # a date without a model is refused here, not in flight
        self._hard_iron = stream(seed, name, "hard iron").standard_normal(3) * e.hard_iron
        self._iron = np.eye(3) + stream(seed, name, "soft iron").standard_normal((3, 3)) * e.soft_iron
        self._wiring = stream(seed, name, "wiring").standard_normal(3) * e.current
        self._motor = stream(seed, name, "motor").standard_normal(3) * e.throttle
        self._white = Process.white(stream(seed, name, "white"), np.full(3, e.noise))
        self._limit = (config.range_ut or math.inf) * MICROTESLA

    def sense(self, truth: TruthBlock) -> Sequence[Sample]:
        """The samples that fall inside this block."""
        rows = self._schedule.rows(truth)
        n = len(rows)
        if not n:
            return []
        due = slice(rows.start, None, rows.step)
        fields = self._map.along(np.column_stack([truth.lat[due], truth.lon[due], truth.h[due]]))
        measured = self._white.take(n)
        if self._motor.any():
            measured += truth.controls[due, 3, None] * self._motor
        _measure(
            rows.start,
            rows.step,
            truth.q_nb,
            truth.current,
            fields,
            self._iron,
            self._hard_iron,
            self._wiring,
            self._limit,
            measured,
        )
        return delivered(MagnetometerSample, self.name, truth.t[due].copy(), self._schedule.latency, field_b=measured)


@njit
def _measure(
    start: int,
    step: int,
    q_nb: Array,
    current: Array,
    fields_n: Array,
    iron: Array,
    hard_iron: Array,
    wiring: Array,
    limit: float,
    measured: Array,
) -> None:
    """What the sensor makes of ``fields_n`` (n, 3) [T] on every ``step``-th row; ``measured`` comes in as noise."""
    for i in range(measured.shape[0]):
        k = start + i * step
        field_b = quat_rotate(quat_conjugate(q_nb[k]), fields_n[i])
        for c in range(3):
            bent = iron[c, 0] * field_b[0] + iron[c, 1] * field_b[1] + iron[c, 2] * field_b[2]
            value = bent + hard_iron[c] + wiring[c] * current[k] + measured[i, c]
            measured[i, c] = min(limit, max(-limit, value))
