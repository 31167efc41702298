"""The run at one row, as messages see it: truth, estimates, samples, and what follows from them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias, TypeVar, cast

import numpy as np

from nav._jit import njit
from nav.earth import displacement_n, position_difference_n
from nav.rotation import euler_from_quat, quat_conjugate, quat_multiply, rotvec_from_quat
from nav.samples import (
    AirspeedSample,
    Array,
    BarometerSample,
    Estimate,
    GnssSample,
    MagnetometerSample,
    PositionSample,
    Sample,
    Status,
)
from testbed.mavlink.encode import boot_ms, microseconds
from testbed.mavlink.identity import Identity
from testbed.motion.table import FLYING_MPS, TruthBlock

_MARGIN_S = 1e-6  # before a sensor falls silent, where rounding might decide
S = TypeVar("S", GnssSample, BarometerSample, MagnetometerSample, AirspeedSample)
_KINDS = (GnssSample, BarometerSample, MagnetometerSample, AirspeedSample, PositionSample)
Point: TypeAlias = tuple[float, float, float]

# Blocks of an estimate's covariance.
POSITION, VELOCITY, ATTITUDE = slice(0, 3), slice(3, 6), slice(6, 9)
DOWN, HEADING = slice(2, 3), slice(8, 9)


class Heard:
    """The newest sample of each sensor at a time, and what follows from who has fallen silent."""

    def __init__(self, samples: Mapping[str, Sample], t: float, silent_s: Mapping[str, float]) -> None:
        """``silent_s`` says after how long a sensor that says nothing counts as failed."""
        self._samples = [*samples.values()]
        self._ids = [*map(id, self._samples)]
        self._t, self._until = t, math.inf
        # The newest sample of the first sensor of each kind, and those of them that have not fallen silent.
        self.first: dict[type[Sample], Sample] = {}
        self.newest: dict[type[Sample], Sample] = {}
        # Whether any sensor tells where the vehicle is; the estimator takes its last word for fresh a while longer.
        self.fixed = False
        for sample in self._samples:
            kind = _kind(sample)
            speaks = t - sample.t_arrival < silent_s[sample.sensor]
            if kind not in self.first:
                self.first[kind] = sample
                if speaks:
                    self.newest[kind] = sample
            if speaks:
                self._until = min(self._until, sample.t_arrival + silent_s[sample.sensor])
                self.fixed |= kind is PositionSample or (isinstance(sample, GnssSample) and sample.has_fix)

    def holds(self, samples: Mapping[str, Sample], t: float) -> bool:
        """Whether nothing of it has changed at a later time, with samples that may be others."""
        return self._t <= t < self._until - _MARGIN_S and [*map(id, samples.values())] == self._ids


@dataclass
class Snapshot:
    """One instant of a run, in the numbers that several messages share; worked out when first asked for.

    ``gyro`` [rad/s] and ``accel`` [m/s^2] are the newest inertial reading; ``home`` (lat, lon, h) the origin of local
    coordinates, None until the estimator is aligned; ``start_us`` the run's start in microseconds since 1970;
    ``ratios`` the newest innovation over its gate, by aid; ``legs`` how many the plan has; ``isolated`` and ``refused``
    are sensors that the estimator has shut out, or whose samples it has long refused.
    """

    truth: TruthBlock
    estimate: Estimate
    heard: Heard
    gyro: Array
    accel: Array
    others: Sequence[tuple[str, Estimate]]
    home: Point | None
    start_us: int
    ratios: Mapping[str, float]
    identity: Identity
    legs: int
    isolated: frozenset[str]
    refused: frozenset[str]

    def __post_init__(self) -> None:
        """What every call needs."""
        self.t = float(self.truth.t[0])
        self.aligned = Status.ALIGNED in self.estimate.status

    @property
    def gnss_fix(self) -> GnssSample | None:
        """The receiver's newest epoch if it has a fix."""
        receiver = self.newest(GnssSample)
        return receiver if receiver and receiver.has_fix else None

    @cached_property
    def alone(self) -> Rows:
        """The same as one row."""
        return Rows((self,))

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
        return known_point(self.estimate)

    @cached_property
    def local_n(self) -> list[float] | None:
        """Estimated position from home [m], NED."""
        if self.point is None or self.home is None:
            return None
        return floats(displacement_n(*self.point, *self.home))

    @cached_property
    def v_n(self) -> list[float]:
        """Estimated velocity [m/s], NED."""
        return floats(self.estimate.v_n)

    @cached_property
    def groundspeed(self) -> float:
        """Estimated horizontal speed over ground [m/s]."""
        return math.hypot(self.v_n[0], self.v_n[1])

    def works(self, kind: type[S]) -> bool:
        """Whether the first sensor of this kind says something, and is not isolated."""
        sample = self.newest(kind)
        return sample is not None and sample.sensor not in self.isolated

    @cached_property
    def doubted(self) -> bool:
        """Whether the estimator has isolated, or long refused, a receiver that has a fix."""
        fix = self.gnss_fix
        return fix is not None and (fix.sensor in self.isolated or fix.sensor in self.refused)

    @cached_property
    def flying(self) -> bool | None:
        """Whether the vehicle is in the air, as far as it can tell itself."""
        speeds = [speed for speed in (self.eas, self.groundspeed) if math.isfinite(speed)]
        return max(speeds) > FLYING_MPS if speeds else None

    def newest(self, kind: type[S]) -> S | None:
        """The newest sample of the first sensor of this kind, None when there is none or it has fallen silent."""
        return cast("S | None", self.heard.newest.get(kind))

    def sigma(self, block: slice, dimensions: int = 3) -> float:
        """Root of the summed variances of the first ``dimensions`` components of a block of the covariance."""
        return root(np.diagonal(self.estimate.covariance)[block][:dimensions])

    def ratio(self, aid: str) -> float:
        """Newest innovation of an aid over its gate, NaN when it is not known."""
        return self.ratios.get(aid, math.nan)


def _kind(sample: Sample) -> type[Sample]:
    """The one of `_KINDS` that a sample is of, of what is none its class."""
    own = type(sample)
    return own if own in _KINDS else next((kind for kind in _KINDS if isinstance(sample, kind)), own)


def known_point(estimate: Estimate) -> Point | None:
    """(lat, lon, h) of an estimate, None while it has no position."""
    if Status.ALIGNED not in estimate.status:
        return None
    point = float(estimate.lat), float(estimate.lon), float(estimate.h)
    return point if math.isfinite(point[0] + point[1] + point[2]) else None


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

    def __init__(self, snapshots: Sequence[Snapshot]) -> None:
        self.snapshots = snapshots
        self._estimates = [one.estimate for one in snapshots]
        self._truths = [one.truth for one in snapshots]
        self._t = np.array([one.t for one in snapshots])

    def __len__(self) -> int:
        return len(self.snapshots)

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
        return _together([one.q_nb for one in self._estimates])

    @cached_property
    def euler(self) -> Array:
        """Estimated roll, pitch, heading (N, 3) [rad]."""
        return _eulers(self._estimates)

    @cached_property
    def rates(self) -> Array:
        """Angular rate (N, 3) [rad/s], body: the gyro less its estimated bias; Earth and transport rate are left in."""
        bias: Array = _together([one.gyro_bias for one in self._estimates])
        return self.gyro - bias

    @cached_property
    def point(self) -> Array:
        """Estimated lat, lon [rad], h [m] (N, 3)."""
        return np.array([one.point or _NOWHERE for one in self.snapshots])

    @cached_property
    def local_n(self) -> Array:
        """Estimated position from home (N, 3) [m], NED."""
        home = np.array([one.home or _NOWHERE for one in self.snapshots])
        return position_difference_n(*self.point.T, *home.T)

    @cached_property
    def v_n(self) -> Array:
        """Estimated velocity (N, 3) [m/s], NED."""
        return _together([one.v_n for one in self._estimates])

    @cached_property
    def covariance(self) -> Array:
        """Of position, velocity and attitude (N, 9, 9)."""
        return np.array([one.covariance for one in self._estimates])

    @cached_property
    def gyro_bias_variance(self) -> Array:
        """Of the gyro's bias (N, 3) [rad^2/s^2]."""
        return _together([one.sigma_gyro_bias for one in self._estimates]) ** 2

    @cached_property
    def second(self) -> Array:
        """Roll, pitch, heading, lat, lon [rad], h [m] (N, 6) of the second estimator."""
        return self._other(0)

    @cached_property
    def third(self) -> Array:
        """The same of the third."""
        return self._other(1)

    def _other(self, index: int) -> Array:
        others = [one.others[index][1] if index < len(one.others) else None for one in self.snapshots]
        points = np.array([known_point(one) or _NOWHERE if one else _NOWHERE for one in others])
        return np.hstack([_eulers(others), points])

    # Samples

    @cached_property
    def gyro(self) -> Array:
        """Newest angular rate measured (N, 3) [rad/s]."""
        return _together([one.gyro for one in self.snapshots])

    @cached_property
    def accel(self) -> Array:
        """Newest specific force measured (N, 3) [m/s^2]."""
        return _together([one.accel for one in self.snapshots])

    @cached_property
    def field_b(self) -> Array:
        """Newest magnetic field measured (N, 3) [T]."""
        found = [one.newest(MagnetometerSample) for one in self.snapshots]
        return np.array([_NOWHERE if one is None else one.field_b for one in found])

    @cached_property
    def pressure(self) -> Array:
        """Static pressure measured [Pa]."""
        return np.array([one.pressure for one in self.snapshots])

    @cached_property
    def eas(self) -> Array:
        """Equivalent airspeed measured [m/s]."""
        return np.array([one.eas for one in self.snapshots])

    # The truth

    def truth(self, name: str) -> Array:
        """A column of truth, (N,) or (N, width)."""
        return np.concatenate([getattr(one, name) for one in self._truths])

    @cached_property
    def true_euler(self) -> Array:
        """True roll, pitch, heading (N, 3) [rad]."""
        return _euler_rows(self.truth("q_nb"))

    @cached_property
    def specific_force(self) -> Array:
        """True specific force over the last tick (N, 3) [m/s^2], body."""
        ticks = np.array([one.tick for one in self._truths], float)
        dt = np.where(ticks == 0, math.inf, self.truth("t") / ticks)
        return self.truth("dv") / dt[:, None]

    @cached_property
    def errors(self) -> dict[str, Array]:
        """Estimate less truth, and the estimator's own idea of it."""
        true = np.column_stack([self.truth(name) for name in ("lat", "lon", "h")])
        position = position_difference_n(*self.point.T, *true.T)
        velocity = self.v_n - self.truth("v_n")
        pairs = zip(self._estimates, self._truths, strict=True)
        turns = [rotvec_from_quat(quat_multiply(one.q_nb, quat_conjugate(true.q_nb[0]))) for one, true in pairs]
        turn = np.array(turns)
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
        return np.array([one.sigma(block, dimensions) for one in self.snapshots])


_NOWHERE = (math.nan, math.nan, math.nan)
_NOTHING = np.full(4, math.nan)


def _together(vectors: Sequence[Array]) -> Array:
    """Vectors (n,) as rows (N, n); several times faster than `numpy.array`."""
    return np.concatenate(vectors).reshape(len(vectors), -1)


def _eulers(estimates: Sequence[Estimate | None]) -> Array:
    """Roll, pitch, heading (N, 3) [rad] of estimates that have an attitude."""
    q_nb = [one.q_nb if one is not None and Status.ALIGNED in one.status else _NOTHING for one in estimates]
    found = _euler_rows(_together(q_nb))
    found[~np.isfinite(found).all(axis=1)] = math.nan
    return found


@njit
def _euler_rows(q_nb: Array) -> Array:
    """`euler_from_quat` of each row (N, 4)."""
    found = np.empty((len(q_nb), 3))
    for k in range(len(q_nb)):
        found[k] = euler_from_quat(q_nb[k])
    return found
