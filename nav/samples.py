"""What sensors deliver and what estimators return: the only vocabulary that `nav` and `testbed` share.

The consumer defines these structures and the simulator fills the same ones. Every field is SI with radians;
frames are those of the conventions page (`nav`). Aiding samples carry two times: ``t`` is when the measurement
was true, ``t_arrival`` when the receiver of it could first have known (``t_arrival >= t``).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from itertools import chain
from typing import Any, TypeAlias, overload

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[np.float64]

NO_SENSOR = "no sensor"  # that a report is of what is known without a sample


class FixType(IntEnum):
    """GNSS fix type, numbered as in MAVLink's GPS_FIX_TYPE."""

    NO_FIX = 1
    FIX_2D = 2
    FIX_3D = 3


def has_fix(fix_type: FixType | npt.NDArray[np.integer]) -> bool | npt.NDArray[np.bool_]:
    """Whether a receiver has a fix that can be navigated by: of three dimensions. The one place that decides it."""
    return fix_type >= FixType.FIX_3D


class Outcome(IntEnum):
    """What became of an aiding sample, or of the part of it that a report is on."""

    FUSED = 0  # used as it is
    WEAKENED = 1  # used with less information than it claims, as a measurement policy says; at weight 0 left out by it
    OUTSIDE_GATE = 2  # its innovation was refused by gate or detector, on one axis at least
    ISOLATED = 3  # its sensor is out of use, on one axis at least, until it has been sound for a while
    WITHHELD = 4  # not used for another reason than itself, such as probation or a refused position
    OUT_OF_RANGE = 5  # a sound reading, but where the sensor tells nothing: too slow for a pitot tube
    UNSOUND = 6  # refused before an innovation was formed: no number, impossible, or too late


class Status(IntFlag):
    """What an estimator says of itself."""

    ALIGNING = 1  # no attitude, velocity or position yet: every number in the estimate is NaN
    ALIGNED = 2
    GNSS_FUSED = 4  # a GNSS sample was fused within the last two seconds
    DEAD_RECKONING = 8  # aligned, and no position aid is being fused
    BAD_SAMPLE = 16  # a non-finite or out-of-range sample was refused within the last second
    ATTITUDE_ONLY = 32  # no position and no velocity are estimated: they are NaN, and so is their covariance


@dataclass(frozen=True, slots=True)
class ImuSamples:
    """A block of N consecutive inertial increments.

    ``t`` (N,) end of each interval [s]; ``dt`` (N,) its length [s]; ``dtheta`` (N, 3) integrated angular rate
    of b relative to i [rad]; ``dv`` (N, 3) integrated specific force [m/s], both in rotating body axes.
    Averages over the interval are ``dtheta/dt`` and ``dv/dt``.
    """

    t: Array
    dt: Array
    dtheta: Array
    dv: Array

    def __len__(self) -> int:
        return len(self.t)


@dataclass(frozen=True, slots=True)
class GnssSample:
    """One GNSS epoch at the antenna. ``sigma_position_n`` and ``sigma_velocity_n`` are the receiver's own 1-sigma.

    Without a fix (``fix_type`` NO_FIX) position and velocity are NaN and the sample only says that there is none.
    """

    t: float
    t_arrival: float
    lat: float
    lon: float
    h: float
    v_n: Array
    sigma_position_n: Array
    sigma_velocity_n: Array
    fix_type: FixType
    satellites: int
    hdop: float
    vdop: float
    sensor: str = "gnss"

    @property
    def has_fix(self) -> bool:
        """Whether there is a position that can be navigated by."""
        return bool(has_fix(self.fix_type))


@dataclass(frozen=True, slots=True)
class BarometerSample:
    """Static pressure [Pa]."""

    t: float
    t_arrival: float
    pressure: float
    sensor: str = "barometer"


@dataclass(frozen=True, slots=True)
class MagnetometerSample:
    """Magnetic flux density in body axes (3,) [T]."""

    t: float
    t_arrival: float
    field_b: Array
    sensor: str = "magnetometer"


@dataclass(frozen=True, slots=True)
class AirspeedSample:
    """Equivalent airspeed along the pitot tube (body x) [m/s]: sqrt(2 q / rho0), rho0 = 1.225 kg/m^3."""

    t: float
    t_arrival: float
    eas: float
    sensor: str = "airspeed"


@dataclass(frozen=True, slots=True)
class BodyVelocitySample:
    """Velocity over ground in body axes (3,) [m/s], NaN on the axes that the instrument does not measure."""

    t: float
    t_arrival: float
    v_b: Array
    sensor: str = "body_velocity"


@dataclass(frozen=True, slots=True)
class StarSample:
    """Attitude against the stars: ``q_ib`` (4,) takes b to the inertial frame i, which coincides with e at t = 0."""

    t: float
    t_arrival: float
    q_ib: Array
    sensor: str = "star_tracker"


@dataclass(frozen=True, slots=True)
class PositionSample:
    """A position found by other means than GNSS: latitude, longitude [rad], ``h`` [m], NaN when not measured."""

    t: float
    t_arrival: float
    lat: float
    lon: float
    h: float
    sensor: str = "position_fix"


@dataclass(frozen=True, slots=True)
class RangeSample:
    """Range to the ground along body z, down [m]."""

    t: float
    t_arrival: float
    range: float
    sensor: str = "rangefinder"


@dataclass(frozen=True, slots=True)
class OpticalFlowSample:
    """How the image of a camera that looks along body z, down, moves: means over an interval whose middle is ``t``.

    ``flow_b`` (2,) rates of the line of sight about body x and y, positive as by a rotation of the body about them
    (MAVLink, OPTICAL_FLOW_RAD), and ``rotation_b`` (2,) that rotation by the sensor's own gyro [rad/s]; ``quality`` of
    the match from 0 to 1, to whose inverse the variance of its noise is proportional.
    """

    t: float
    t_arrival: float
    flow_b: Array
    rotation_b: Array
    quality: float
    sensor: str = "optical_flow"


@dataclass(frozen=True, slots=True)
class WindSample:
    """The wind by radio: velocity of the air over ground north and east ``wind_n`` (2,), a mean without gusts [m/s].

    It is of ``age`` [s] before ``t``, when it was reported; ``sigma`` is the 1-sigma per axis that is told with it.
    """

    t: float
    t_arrival: float
    wind_n: Array
    age: float
    sigma: float
    sensor: str = "wind_report"


Sample: TypeAlias = (
    GnssSample
    | BarometerSample
    | MagnetometerSample
    | AirspeedSample
    | BodyVelocitySample
    | StarSample
    | PositionSample
    | RangeSample
    | OpticalFlowSample
    | WindSample
)


@dataclass(frozen=True, slots=True)
class UpdateReport:
    """What became of one aiding sample, one report per aid (a GNSS sample gives position and velocity).

    ``t`` is the sample's time of validity; ``aid`` the measurement's name, such as ``gnss_position``; ``innovation``
    (m,) = measurement - prediction; ``S`` (m, m) its covariance before the update; ``nis`` = innovation' S^-1
    innovation; ``threshold`` the gate for it; ``weight`` the factor on the information of the sample (1 taken as
    it is, 0 rejected), the mean over the axes; ``outcome`` what became of it, ``reason`` the same in words for people.
    """

    t: float
    sensor: str
    aid: str
    innovation: Array
    S: Array
    nis: float
    threshold: float
    weight: float
    outcome: Outcome
    reason: str = ""  # why it was refused or weakened, empty when it was simply fused; no code reads it


@dataclass(frozen=True, slots=True)
class FusedReports(Sequence[UpdateReport]):
    """Reports on N parts of samples that were simply fused, one after the other.

    ``kinds`` are sensor, aid and axes m; ``kind`` (N,) the place of each report's among them. ``innovation`` (N, 3) and
    ``S`` (N, 9), row by row, begin with the m and the m * m numbers that there are; the others as in `UpdateReport`.
    """

    kinds: Sequence[tuple[str, str, int]]
    kind: npt.NDArray[np.int64]
    t: Array
    innovation: Array
    S: Array
    nis: Array
    threshold: Array

    def __len__(self) -> int:
        return len(self.t)

    @overload
    def __getitem__(self, which: int) -> UpdateReport: ...
    @overload
    def __getitem__(self, which: slice) -> list[UpdateReport]: ...

    def __getitem__(self, which: int | slice) -> UpdateReport | list[UpdateReport]:
        """One of them, or those of a slice."""
        rows = range(len(self))[which]
        return self._one(rows) if isinstance(rows, int) else [self._one(k) for k in rows]

    def _one(self, k: int) -> UpdateReport:
        sensor, aid, m = self.kinds[self.kind[k]]
        numbers = float(self.nis[k]), float(self.threshold[k])
        S = self.S[k, : m * m].reshape(m, m)
        return UpdateReport(float(self.t[k]), sensor, aid, self.innovation[k, :m], S, *numbers, 1.0, Outcome.FUSED)

    def by_kind(self) -> Iterator[FusedReports]:
        """Those of one kind after the other, as columns of as many numbers as it has."""
        for number, (sensor, aid, m) in enumerate(self.kinds):
            own = np.flatnonzero(self.kind == number)
            if len(own):
                yield FusedReports(
                    [(sensor, aid, m)], np.zeros(len(own), np.int64), self.t[own], self.innovation[own, :m],
                    self.S[own, : m * m], self.nis[own], self.threshold[own],
                )  # fmt: skip


class Reports(Sequence[UpdateReport]):
    """Reports one after the other: single ones, and stretches of `FusedReports`."""

    def __init__(self, pieces: Iterable[UpdateReport | FusedReports] = ()) -> None:
        self.pieces = [*pieces]

    def __len__(self) -> int:
        return sum(len(piece) if isinstance(piece, FusedReports) else 1 for piece in self.pieces)

    def __iter__(self) -> Iterator[UpdateReport]:
        for piece in self.pieces:
            if isinstance(piece, FusedReports):
                yield from piece[:]
            else:
                yield piece

    @overload
    def __getitem__(self, which: int) -> UpdateReport: ...
    @overload
    def __getitem__(self, which: slice) -> list[UpdateReport]: ...

    def __getitem__(self, which: int | slice) -> UpdateReport | list[UpdateReport]:
        """One of them, or those of a slice."""
        return [*self][which]

    def of(self, sensor: str, aid: str) -> Iterator[UpdateReport]:
        """Those on one part of the samples of one sensor."""
        for piece in self.pieces:
            if isinstance(piece, FusedReports):
                for own in piece.by_kind():
                    if own.kinds[0][:2] == (sensor, aid):
                        yield from own[:]
            elif (piece.sensor, piece.aid) == (sensor, aid):
                yield piece


@dataclass(frozen=True, slots=True)
class Estimate:
    """State of an estimator at ``t``.

    ``covariance`` (9, 9) is of [position error NED m, velocity error NED m/s, attitude error phi rad], in that
    order. ``extra`` holds further states by name (wind, aid biases) as (value, sigma) pairs, each array (k,).
    While aligning all numbers are NaN and ``status`` says so.
    """

    t: float
    lat: float
    lon: float
    h: float
    v_n: Array
    q_nb: Array
    gyro_bias: Array
    accel_bias: Array
    covariance: Array
    sigma_gyro_bias: Array
    sigma_accel_bias: Array
    status: Status
    extra: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)

    @classmethod
    def of(
        cls, t: float, *, q_nb: Array | None = None, lla: Array | None = None, v_n: Array | None = None,
        covariance: Array | None = None, status: Status | None = None,
    ) -> Estimate:  # fmt: skip
        """An estimate of what is given, ``lla`` being (lat, lon, h); what is not given is NaN, and not known.

        Without ``status`` it is aligned when there is an attitude, and of attitude only when there is no position.
        """
        if status is None:
            aligned = Status.ALIGNED if lla is not None else Status.ALIGNED | Status.ATTITUDE_ONLY
            status = Status.ALIGNING if q_nb is None else aligned
        unknown = np.full(3, np.nan)
        lat, lon, h = unknown if lla is None else lla
        return cls(
            t, float(lat), float(lon), float(h), unknown if v_n is None else v_n,
            np.full(4, np.nan) if q_nb is None else q_nb, unknown, unknown,
            np.full((9, 9), np.nan) if covariance is None else covariance, unknown, unknown, status,
        )  # fmt: skip


# The fields of an estimate that are arrays, and how long they are.
VECTORS: Mapping[str, tuple[int, ...]] = {
    "v_n": (3,), "q_nb": (4,), "gyro_bias": (3,), "accel_bias": (3,), "covariance": (9, 9), "sigma_gyro_bias": (3,),
    "sigma_accel_bias": (3,),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Estimates(Sequence[Estimate]):
    """Estimates one after the other: the fields of `Estimate`, with a row of each array for each of N.

    ``status`` (N,) are numbers of `Status`. In ``extra`` a state that an estimate lacks is NaN, and so is its sigma.
    """

    t: Array
    lat: Array
    lon: Array
    h: Array
    v_n: Array
    q_nb: Array
    gyro_bias: Array
    accel_bias: Array
    covariance: Array
    sigma_gyro_bias: Array
    sigma_accel_bias: Array
    status: npt.NDArray[np.int64]
    extra: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)

    @classmethod
    def of(cls, pieces: Iterable[Estimate | Estimates]) -> Estimates:
        """Single ones, and several at once, in their order."""
        blocks: list[Estimates] = []
        singles: list[Estimate] = []
        for piece in pieces:
            if isinstance(piece, Estimate):
                singles.append(piece)
                continue
            if singles:
                blocks.append(cls._gathered(singles))
                singles = []
            blocks.append(piece)
        if singles:
            blocks.append(cls._gathered(singles))
        if len(blocks) < 2:
            return blocks[0] if blocks else NO_ESTIMATES
        columns = {name: np.concatenate([getattr(block, name) for block in blocks]) for name in (*_NUMBERS, *VECTORS)}
        return cls(**columns, extra=_joined(blocks))

    @classmethod
    def _gathered(cls, singles: Sequence[Estimate]) -> Estimates:
        columns: dict[str, Any] = {name: np.array([getattr(one, name) for one in singles]) for name in _NUMBERS}
        columns |= {
            name: np.array([getattr(one, name) for one in singles], float).reshape(-1, *shape)
            for name, shape in VECTORS.items()
        }
        widths = {name: len(value) for one in singles for name, (value, _) in one.extra.items()}
        extra = {}
        for name, width in widths.items():
            unknown = (np.full(width, np.nan),) * 2
            pairs = np.array([one.extra.get(name, unknown) for one in singles], float)
            extra[name] = pairs[:, 0], pairs[:, 1]
        return cls(**columns, extra=extra)

    def __len__(self) -> int:
        return len(self.t)

    @overload
    def __getitem__(self, which: int) -> Estimate: ...
    @overload
    def __getitem__(self, which: slice | Sequence[int]) -> Estimates: ...

    def __getitem__(self, which: int | slice | Sequence[int]) -> Estimate | Estimates:
        """One of them, or those of a slice or of a list of indices."""
        if not isinstance(which, int):
            columns = {name: getattr(self, name)[which] for name in (*_NUMBERS, *VECTORS)}
            return Estimates(**columns, extra={name: (x[which], s[which]) for name, (x, s) in self.extra.items()})
        return next(self._singles(range(len(self))[which]))

    def __iter__(self) -> Iterator[Estimate]:
        return self._singles(slice(None))

    def _singles(self, which: int | slice) -> Iterator[Estimate]:
        """Those of an index or of a slice."""
        rows = slice(which, which + 1) if isinstance(which, int) else which
        columns = [getattr(self, name)[rows] for name in _FIELDS]
        lists: list[Any] = [column.tolist() if column.ndim == 1 else column for column in columns]
        pairs = [(name, x[rows], sigma[rows]) for name, (x, sigma) in self.extra.items()]
        known: Any = [~(np.isnan(x).all(axis=1) & np.isnan(sigma).all(axis=1)) for _, x, sigma in pairs]
        known = [one.tolist() for one in known]
        for k, (status, t, lat, lon, h, *vectors) in enumerate(zip(*lists, strict=True)):
            own = zip(pairs, known, strict=True)
            extra = {name: (x[k], sigma[k]) for (name, x, sigma), has in own if has[k]}
            yield Estimate(t, lat, lon, h, *vectors, _STATUS.get(status) or Status(status), extra)  # type: ignore[call-arg]


Told: TypeAlias = list[Estimate | Estimates]  # on the way, one at a time or several
Reported: TypeAlias = list[UpdateReport | FusedReports]
_NUMBERS = ("t", "lat", "lon", "h", "status")
_FIELDS = ("status", *_NUMBERS[:4], *VECTORS)  # status, and the others as `Estimate` has them
_USUAL = (Status.ALIGNED | Status.GNSS_FUSED, Status.ALIGNED | Status.DEAD_RECKONING)
_STATUS = {int(status): status for status in _USUAL}  # made anew it takes longer than all the rest
_EMPTY: dict[str, Any] = dict.fromkeys(("t", "lat", "lon", "h"), np.empty(0)) | {
    name: np.empty((0, *shape)) for name, shape in VECTORS.items()
}
NO_ESTIMATES = Estimates(**_EMPTY, status=np.empty(0, np.int64))


def _joined(blocks: Sequence[Estimates]) -> dict[str, tuple[Array, Array]]:
    """The further states of blocks; where one lacks a state it is NaN."""
    extra = {}
    for name in dict.fromkeys(chain.from_iterable(block.extra for block in blocks)):
        width = next(block.extra[name][0].shape[1] for block in blocks if name in block.extra)
        pairs = [block.extra.get(name) or (np.full((len(block), width), np.nan),) * 2 for block in blocks]
        extra[name] = np.concatenate([x for x, _ in pairs]), np.concatenate([sigma for _, sigma in pairs])
    return extra
