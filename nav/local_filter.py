"""A local filter: aids with the states of their errors, a detector and a measurement policy for each kind of look.

An aid is one sensor as the filter is told of it. A sample gives one or more looks (`Aid.parts`: a GNSS sample tells a
position and a velocity), and each look goes the same way: innovation at the filter's own estimate, detector, policy,
update. `nav.ins` closes a strapdown with one such filter, `nav.federated` with several.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np

from nav import aiding, unscented
from nav._jit import njit
from nav.detection import ChiSquare, ChiSquareGate, Decision, Detector, Mask, chi_square_threshold
from nav.earth import pressure_altitude
from nav.error_model import MOTION, Block, ErrorModel, ImuModel, Indices, markov, sensor_errors
from nav.kalman import innovate
from nav.reference import Reference, State, absorb, remove_open
from nav.samples import (
    AirspeedSample,
    Array,
    BarometerSample,
    BodyVelocitySample,
    GnssSample,
    MagnetometerSample,
    Outcome,
    PositionSample,
    Sample,
    StarSample,
    UpdateReport,
)
from nav.unscented import CURVED, Scaling
from nav.weighting import Fading, SageHusa, split

Axes: TypeAlias = tuple[float, float, float]

WHITE_SHARE = 0.1  # of a receiver's reported variance, the least that is taken as white noise
PATIENT, ALONE_FALSE_ALARM = 10, 1e-3  # see `Watch`


class Ruling(NamedTuple):
    """What becomes of one part of a sample: the last three fields of its `UpdateReport`."""

    outcome: Outcome
    reason: str = ""
    weight: float = 0.0


FUSED = Ruling(Outcome.FUSED, weight=1.0)
OUTSIDE = Ruling(Outcome.OUTSIDE_GATE, "outside the gate")
LEFT_OUT = Ruling(Outcome.WEAKENED, "left out by the measurement policy")
TOO_SLOW = Ruling(Outcome.OUT_OF_RANGE, "too slow for the pitot tube")
NO_RATES = Ruling(Outcome.WITHHELD, "how fast the sensor swings about the IMU isn't known before the first increment")


def without_position(position: Ruling) -> Ruling:
    """What becomes of the velocity of a fix whose position was not used."""
    return Ruling(Outcome.WITHHELD, f"position {position.reason}")


class Policy(Protocol):
    """What the variances of a look are worth: called after the detector and before the update.

    It is shown the axes that the detector has left, and no others. `SageHusa` alone is asked before the detector, about
    whole looks.
    """

    def adapt(self, nu: Array, S: Array, R: Array, t: float) -> Array:
        """Variances (m,) to use for innovation ``nu`` (m,), S (m, m) = H P H' + diag(R); inf leaves an axis out."""
        ...


class Look(NamedTuple):
    """A measurement at the nominal state: innovation (m,), Jacobian (m, n), variances (m,).

    ``withheld`` says why it must not be used, None when it may.

    ``at_points`` (7, m) are the innovations at the sigma points of an unscented filter; ``told`` (m,) are the variances
    as the sensor has them, where R is what they were learned to be.
    """

    nu: Array
    H: Array
    R: Array
    withheld: Ruling | None = None
    at_points: Array | None = None
    told: Array | None = None


class Seat(NamedTuple):
    """Where an aid is looked at from: the nominal state, the filter's own states ``x`` (n,), where the aid's begin."""

    reference: Reference
    state: State
    x: Array
    starts: tuple[int, ...]


class Aid(Protocol):
    """One sensor as a filter is told of it."""

    @property
    def sensor(self) -> str:
        """The sensor's name."""
        ...

    @property
    def parts(self) -> tuple[tuple[str, int], ...]:
        """The looks that a sample gives, in their order, and the number of axes of each."""
        ...

    @property
    def states(self) -> tuple[str, ...]:
        """The blocks that `look` needs the places of."""
        ...

    def blocks(self) -> list[Block]:
        """The error states; one whose sigma is zero is left out."""
        ...

    def look(self, part: str, sample: Sample, seat: Seat) -> Look | None:
        """One part of a sound sample, None when it has no such part."""
        ...


@dataclass(frozen=True)
class Course:
    """Course over ground as a look at the heading (Cheng et al. 2020, Eq 22-24): see `nav.aiding.gnss_course`.

    It is worth the receiver's velocity and the ``slip`` of the body, over the speed; nothing below ``minimum`` speed.
    Where it turned faster than ``max_turn_rate`` within the last ``quiet_s`` there is no look (`nav.motion`).
    """

    max_turn_rate: float = math.inf  # [rad/s]
    quiet_s: float = 0.0
    slip: float = 0.0  # sideways through the air, 1 sigma [m/s]
    minimum: float = 1.0  # [m/s]


@dataclass(frozen=True)
class GnssAid:
    """A receiver by its own sigmas, of which a part may be a slowly varying error (first-order Markov, NED)."""

    sensor: str = "gnss"
    arm_b: Axes = (0.0, 0.0, 0.0)  # IMU to antenna [m]
    use_velocity: bool = True
    position_error_sigma: Axes = (0.0, 0.0, 0.0)  # [m]
    position_error_correlation_s: float = 100.0
    velocity_error_sigma: Axes = (0.0, 0.0, 0.0)  # [m/s]
    velocity_error_correlation_s: float = 20.0
    course: Course | None = None

    @property
    def parts(self) -> tuple[tuple[str, int], ...]:
        """See `Aid`."""
        velocity = (("gnss_velocity", 3),) if self.use_velocity else ()
        return (("gnss_position", 3), *velocity, *((("gnss_course", 1),) if self.course else ()))

    @property
    def states(self) -> tuple[str, ...]:
        """See `Aid`."""
        own = f"{self.sensor}_position_error", f"{self.sensor}_velocity_error"
        return (*own, "wind", "gust") if self.course else own

    def blocks(self) -> list[Block]:
        """See `Aid`."""
        position, velocity = self.states[:2]
        return [
            markov(position, 3, self.position_error_sigma, self.position_error_correlation_s),
            markov(velocity, 3, self.velocity_error_sigma, self.velocity_error_correlation_s),
        ]

    @cached_property
    def arm(self) -> Array:
        """IMU to antenna (3,) [m]."""
        return np.array(self.arm_b, dtype=float)

    @cached_property
    def _correlated(self) -> tuple[Array, Array]:
        return np.array(self.position_error_sigma) ** 2, np.array(self.velocity_error_sigma) ** 2

    def look(self, part: str, sample: Sample, seat: Seat) -> Look | None:
        """See `Aid`."""
        assert isinstance(sample, GnssSample)
        state = seat.state
        if part == "gnss_position":
            nu, H = aiding.gnss_position(
                state.q_nb, state.lla, seat.x, self.arm, seat.starts[0], sample.lat, sample.lon, sample.h
            )
            return Look(nu, H, _white(sample.sigma_position_n, self._correlated[0]))
        if not aiding.has_velocity(sample):
            return None
        if part == "gnss_course":
            return self._course(sample, seat)
        nu, H = aiding.gnss_velocity(
            state.q_nb, state.v_n, state.lla, seat.x, state.rates[0], state.errors, seat.reference.driven,
            self.arm, seat.starts[1], sample.v_n,
        )  # fmt: skip
        unknown = NO_RATES if any(self.arm_b) and not state.rates[0].any() else None
        return Look(nu, H, _white(sample.sigma_velocity_n, self._correlated[1]), unknown)

    def _course(self, sample: GnssSample, seat: Seat) -> Look | None:
        assert self.course is not None
        speed2 = float(sample.v_n[0] ** 2 + sample.v_n[1] ** 2)
        if not speed2 > self.course.minimum**2:
            return None
        nu, H = aiding.gnss_course(seat.state.q_nb, seat.state.v_n, seat.x, seat.starts[2], seat.starts[3], sample.v_n)
        sigma2 = float(sample.sigma_velocity_n[:2] @ sample.sigma_velocity_n[:2]) / 2
        return Look(nu, H, np.array([(sigma2 + self.course.slip**2) / speed2]))


@dataclass(frozen=True)
class BarometerAid:
    """Pressure altitude with a walking bias: weather and geoid, before the first GNSS height tells."""

    sensor: str = "barometer"
    sigma: float = 0.5  # [m]
    bias_sigma: float = 300.0  # [m]
    bias_walk: float = 0.03  # [m/sqrt(s)]

    parts = (("barometer", 1),)

    @property
    def states(self) -> tuple[str, ...]:
        """See `Aid`."""
        return (f"{self.sensor}_bias",)

    def blocks(self) -> list[Block]:
        """See `Aid`."""
        return [Block(self.states[0], 1, self.bias_sigma, self.bias_walk)]

    @cached_property
    def _R(self) -> Array:
        return np.array([self.sigma**2])

    def look(self, part: str, sample: Sample, seat: Seat) -> Look | None:
        """See `Aid`."""
        assert isinstance(sample, BarometerSample)
        nu, H = aiding.barometer(seat.state.lla, seat.x, seat.starts[0], pressure_altitude(sample.pressure))
        return Look(nu, H, self._R)


@dataclass(frozen=True)
class MagnetometerAid:
    """Three axes; without a reference field it is not used."""

    sensor: str = "magnetometer"
    sigma: float = 0.5e-6  # [T]
    bias_sigma: float = 1.0e-6  # hard iron left after calibration [T]
    anomaly_sigma: float = 0.0  # of the reference field, constant in n [T]
    error_sigma: float = 0.0  # what changes with attitude, soft iron, as a Markov process [T]
    error_correlation_s: float = 30.0

    parts = (("magnetometer", 3),)

    @property
    def states(self) -> tuple[str, ...]:
        """See `Aid`."""
        return f"{self.sensor}_bias", f"{self.sensor}_anomaly", f"{self.sensor}_error"

    def blocks(self) -> list[Block]:
        """See `Aid`."""
        bias, anomaly, error = self.states
        return [
            Block(bias, 3, self.bias_sigma),
            Block(anomaly, 3, self.anomaly_sigma),
            markov(error, 3, self.error_sigma, self.error_correlation_s),
        ]

    @cached_property
    def _R(self) -> Array:
        return np.full(3, self.sigma**2)

    def look(self, part: str, sample: Sample, seat: Seat) -> Look | None:
        """See `Aid`."""
        assert isinstance(sample, MagnetometerSample)
        state, (bias, anomaly, error) = seat.state, seat.starts
        if not seat.reference.has_field:
            return None
        field_n = seat.reference.field_n(state.lla)
        nu, H = aiding.magnetometer(state.q_nb, seat.x, bias, error, anomaly, field_n, sample.field_b)
        return Look(nu, H, self._R)


@dataclass(frozen=True)
class AirspeedAid:
    """Airspeed along body x, and the constraint of no sideslip (None leaves it out); a filter has one wind."""

    sensor: str = "airspeed"
    sigma: float = 0.5  # [m/s]
    scale_sigma: float = 0.0  # [1]
    minimum: float = 10.0  # equivalent; below it neither airspeed nor sideslip is used [m/s]
    sideslip_sigma: float | None = 1.0  # [m/s]
    wind_sigma: float = 8.0  # per horizontal axis, before anything is known [m/s]
    wind_walk: float = 0.03  # [m/s/sqrt(s)]
    gust_sigma: float = 0.0  # turbulence as a Markov part of the wind [m/s]
    gust_correlation_s: float = 5.0

    @property
    def parts(self) -> tuple[tuple[str, int], ...]:
        """See `Aid`."""
        return (("airspeed", 1),) if self.sideslip_sigma is None else (("airspeed", 1), ("sideslip", 1))

    @property
    def states(self) -> tuple[str, ...]:
        """See `Aid`."""
        return "wind", "gust", f"{self.sensor}_scale"

    def blocks(self) -> list[Block]:
        """See `Aid`."""
        wind, gust, scale = self.states
        return [
            Block(wind, 2, self.wind_sigma, self.wind_walk),
            markov(gust, 2, self.gust_sigma, self.gust_correlation_s),
            Block(scale, 1, self.scale_sigma),
        ]

    @cached_property
    def _R(self) -> tuple[Array, Array]:
        return np.array([self.sigma**2]), np.array([(self.sideslip_sigma or 0.0) ** 2])

    def look(self, part: str, sample: Sample, seat: Seat) -> Look | None:
        """See `Aid`."""
        assert isinstance(sample, AirspeedSample)
        state, (wind, gust, scale) = seat.state, seat.starts
        slow = None if sample.eas >= self.minimum else TOO_SLOW
        if part == "airspeed":
            nu, H = aiding.airspeed(state.q_nb, state.v_n, state.lla, seat.x, wind, gust, scale, sample.eas)
            return Look(nu, H, self._R[0], slow)
        nu, H = aiding.sideslip(state.q_nb, state.v_n, seat.x, wind, gust)
        return Look(nu, H, self._R[1], slow)


@dataclass(frozen=True)
class BodyVelocityAid:
    """Velocity over ground along some body ``axes`` (indices), each with a scale factor error and a Markov error.

    ``nonholonomic_sigma`` adds the constraint of wheels, which neither slip sideways nor leave the ground where the
    sensor is.
    """

    sensor: str = "body_velocity"
    axes: tuple[int, ...] = (0, 1, 2)
    sigma: float = 0.1  # [m/s]
    scale_sigma: float = 0.0  # [1]
    error_sigma: float = 0.0  # [m/s]
    error_correlation_s: float = 300.0
    nonholonomic_sigma: float | None = None  # [m/s]
    arm_b: Axes = (0.0, 0.0, 0.0)  # IMU to the sensor's point [m]

    @property
    def parts(self) -> tuple[tuple[str, int], ...]:
        """See `Aid`."""
        own = ("body_velocity", len(self.axes))
        return (own,) if self.nonholonomic_sigma is None else (own, ("nonholonomic", 2))

    @property
    def states(self) -> tuple[str, ...]:
        """See `Aid`."""
        return f"{self.sensor}_scale", f"{self.sensor}_error"

    def blocks(self) -> list[Block]:
        """See `Aid`."""
        scale, error = self.states
        return [
            Block(scale, len(self.axes), self.scale_sigma),
            markov(error, len(self.axes), self.error_sigma, self.error_correlation_s),
        ]

    @cached_property
    def _told(self) -> tuple[Indices, Array, Array, Array]:
        """Axes, the variances of the two parts, and the lever arm."""
        nonholonomic = np.full(2, (self.nonholonomic_sigma or 0.0) ** 2)
        arm = np.array(self.arm_b, dtype=float)
        return np.array(self.axes), np.full(len(self.axes), self.sigma**2), nonholonomic, arm

    def look(self, part: str, sample: Sample, seat: Seat) -> Look | None:
        """See `Aid`."""
        assert isinstance(sample, BodyVelocitySample)
        axes, R, nonholonomic, arm = self._told
        state, (scale, error) = seat.state, seat.starts
        there = state.q_nb, state.v_n, state.lla, seat.x, state.rates[0], state.errors, seat.reference.driven, arm
        unknown = NO_RATES if any(self.arm_b) and not state.rates[0].any() else None
        if part == "nonholonomic":
            return Look(*aiding.nonholonomic(*there), nonholonomic, unknown)
        if not aiding.measures(sample, axes):
            return None
        nu, H = aiding.body_velocity(*there, axes, scale, error, sample.v_b)
        return Look(nu, H, R, unknown)


@dataclass(frozen=True)
class StarAid:
    """Attitude against the stars; ``sigma`` about each body axis [rad]."""

    sensor: str = "star_tracker"
    sigma: Axes = (2.4e-5, 2.4e-5, 7.3e-5)

    parts = (("star_attitude", 3),)
    states = ()

    def blocks(self) -> list[Block]:
        """See `Aid`."""
        return []

    @cached_property
    def _R(self) -> Array:
        return np.array(self.sigma) ** 2

    def look(self, part: str, sample: Sample, seat: Seat) -> Look | None:
        """See `Aid`."""
        assert isinstance(sample, StarSample)
        nu, H = aiding.star_attitude(seat.state.q_nb, seat.state.lla, seat.x, sample.t, sample.q_ib)
        return Look(nu, H, self._R)


@dataclass(frozen=True)
class PositionFixAid:
    """Position from a transponder or from terrain; ``sigma`` north, east, down [m]; with ``height`` or without."""

    sensor: str = "position_fix"
    sigma: Axes = (10.0, 10.0, 10.0)
    height: bool = True
    arm_b: Axes = (0.0, 0.0, 0.0)  # IMU to the sensor's point [m]

    states = ()

    @property
    def parts(self) -> tuple[tuple[str, int], ...]:
        """See `Aid`."""
        return (("position_fix", 3 if self.height else 2),)

    def blocks(self) -> list[Block]:
        """See `Aid`."""
        return []

    @cached_property
    def _arm(self) -> Array:
        return np.array(self.arm_b, dtype=float)

    @cached_property
    def _R(self) -> Array:
        return np.array(self.sigma)[: 3 if self.height else 2] ** 2

    def look(self, part: str, sample: Sample, seat: Seat) -> Look | None:
        """See `Aid`."""
        assert isinstance(sample, PositionSample)
        h = sample.h if self.height else math.nan
        state = seat.state
        nu, H = aiding.position_fix(state.q_nb, state.lla, seat.x, self._arm, sample.lat, sample.lon, h)
        return Look(nu, H, self._R) if len(nu) == len(self._R) else None


def _white(sigma: Array, correlated_variance: Array) -> Array:
    """The white part of a receiver's reported variance, when the correlated part is a state of the filter."""
    reported = sigma * sigma
    return np.maximum(reported - correlated_variance, WHITE_SHARE * reported)


def aid_blocks(aids: Sequence[Aid]) -> list[Block]:
    """The error states of several aids, each name once, none of sigma zero."""
    blocks = {block.name: block for aid in aids for block in aid.blocks()}
    return [block for block in blocks.values() if np.any(block.sigma)]


def refusals(sample: Sample, aid: Aid, reason: str, now: float) -> list[UpdateReport]:
    """Reports on a sample that is not used, without innovations (NaN): one for each part of it."""
    t = sample.t if math.isfinite(sample.t) else now
    return [
        UpdateReport(
            t, sample.sensor, part, np.full(m, np.nan), np.full((m, m), np.nan), math.nan, math.nan,
            0.0, Outcome.UNSOUND, reason,
        )
        for part, m in aid.parts
    ]  # fmt: skip


def report_on(
    sample: Sample, part: str, nu: Array, S: Array, nis: float, threshold: float, ruling: Ruling
) -> UpdateReport:
    """The report on one part of a sample."""
    return UpdateReport(
        sample.t, sample.sensor, part, nu, S, nis, threshold, ruling.weight, ruling.outcome, ruling.reason
    )


@dataclass(frozen=True)
class Watched:
    """A sensor of a local filter; detector and policy are made anew for each part of its looks."""

    aid: Aid
    detector: Callable[[], Detector] = lambda: ChiSquare(1e-3)
    policy: Callable[[], Policy] | None = None


class Change(Enum):
    """What a look changed in the isolation of its sensor; NONE is false."""

    NONE = ""
    ISOLATED = "isolated"
    READMITTED = "readmitted"

    def __bool__(self) -> bool:
        return self is not Change.NONE


class Watch:
    """What is known of one part of a sensor's looks: which axes are isolated, how long each has been bad or good.

    Of its policy ``noise`` is what learns R, before the detector judges, and ``policy`` the rest (`split`).

    A condemned look goes axis by axis (`Decision.axis_mask`). An axis that was condemned in ``isolate_after``
    consecutive looks is isolated; it is readmitted when it has been sound in ``readmit_after`` consecutive ones, or
    when all isolated axes would each be sound alone in `PATIENT` times as many: while a sensor is isolated nothing
    estimates its slow errors, its innovations are correlated, and a detector that gathers them might never let it go.
    It begins anew then.

    ``suspect`` says that some axis is isolated, ``out`` that every one is. ``suspicion`` is the statistic of the latest
    look over its threshold, infinite when there is none; ``judged`` the time of that look [s].
    """

    def __init__(
        self, detector: Detector, policy: Policy | None, size: int, isolate_after: int, readmit_after: int
    ) -> None:
        self.detector = detector
        self.noise, self.policy = split(policy)
        self._isolate_after, self._readmit_after = isolate_after, readmit_after
        self.isolated: Mask = np.full(size, False)
        self.suspect = self.out = False
        self.suspicion, self.judged = 0.0, -math.inf
        self._bad, self._good, self._alone = np.zeros(size), np.zeros(size), np.zeros(size)
        self._clean = True
        self._new_detector = deepcopy(detector)

    def judge(self, nu: Array, S: Array, t: float) -> tuple[Decision, Change]:
        """The detector's decision on one look, and what it changes; an axis isolated outweighs one readmitted."""
        decision = self.detector.step(nu, S, t)
        ratio = decision.statistic / decision.threshold
        self.suspicion, self.judged = max(ratio, 0.0) if ratio == ratio else math.inf, t
        if not decision.alarm and self._clean:
            return decision, Change.NONE
        sound, before = decision.axis_mask, self.isolated
        self._bad = np.where(sound, 0.0, self._bad + 1.0)
        self._good = np.where(sound, self._good + 1.0, 0.0)
        alone = nu * nu <= chi_square_threshold(ALONE_FALSE_ALARM, 1) * S.diagonal()
        self._alone = np.where(before & alone, self._alone + 1.0, 0.0)
        patient = self.suspect and bool((self._alone[before] >= PATIENT * self._readmit_after).all())
        kept = before & (self._good < self._readmit_after) & (not patient)
        self.isolated = kept | (~before & (self._bad >= self._isolate_after))
        if patient:
            self.detector, self._alone = deepcopy(self._new_detector), np.zeros(len(nu))
        self.suspect, self.out = bool(self.isolated.any()), bool(self.isolated.all())
        self._clean = not self.suspect and not self._bad.any()
        if (self.isolated & ~before).any():
            return decision, Change.ISOLATED
        return decision, Change.READMITTED if (before & ~self.isolated).any() else Change.NONE

    def convict(self) -> None:
        """Isolate every axis, whatever the detector found."""
        self.isolated, self._good = np.full(len(self.isolated), True), np.zeros(len(self.isolated))
        self.suspect = self.out = True
        self._clean = False


class LocalFilter:
    """One filter's aids and what becomes of their looks; the numbers are rows ``row`` of a `State`.

    ``closed`` filters put each correction into the nominal state at once. With a ``scaling`` they work by sigma points
    around the filter's own estimate. Parts without a `Watch` pass the ``gate``.
    """

    def __init__(
        self,
        imu: ImuModel,
        aids: Sequence[Aid],
        gate: ChiSquareGate,
        row: int = 0,
        closed: bool = True,
        scaling: Scaling | None = None,
    ) -> None:
        self.aids = {aid.sensor: aid for aid in aids}
        if len(self.aids) < len(aids):
            raise ValueError(f"a sensor is listed twice: {[aid.sensor for aid in aids]}")
        self.model = ErrorModel(imu, aid_blocks(aids))
        self.gate, self.row, self.closed, self.scaling = gate, row, closed, scaling
        self.watches: dict[tuple[str, str], Watch] = {}
        self.of_sensor: dict[str, list[Watch]] = {}
        self.noises: dict[str, SageHusa] = {}  # of parts without a watch, as the two below
        self.policies: dict[str, Policy] = {}
        self.fadings: Mapping[str, Fading] = {}
        self._starts = {aid.sensor: tuple(map(self.model.start, aid.states)) for aid in aids}

    def watch(self, watched: Watched, isolate_after: int, readmit_after: int) -> None:
        """Watch each part of a sensor's looks, from a clean record."""
        sensor, policy = watched.aid.sensor, watched.policy
        for part, size in watched.aid.parts:
            self.watches[sensor, part] = Watch(
                watched.detector(), policy() if policy else None, size, isolate_after, readmit_after
            )
        self.of_sensor[sensor] = [self.watches[sensor, part] for part, _ in watched.aid.parts]

    def weigh_by(self, policies: Mapping[str, Policy]) -> None:
        """Weigh looks that have no watch, by the names of their parts."""
        for part, policy in policies.items():
            noise, rest = split(policy)
            if noise is not None:
                self.noises[part] = noise
            if rest is not None:
                self.policies[part] = rest

    def _noise(self, sensor: str, part: str) -> SageHusa | None:
        """What learns the variances of one part of a sensor's looks."""
        watch = self.watches.get((sensor, part))
        return self.noises.get(part) if watch is None else watch.noise

    def learned_sigma(self, part: str, sigma: Array) -> Array:
        """The 1-sigma (m,) that a sensor tells of one part of its looks, as learned."""
        noise = self.noises.get(part)
        return sigma if noise is None or noise.ratio is None else sigma * np.sqrt(noise.ratio)

    def look(self, reference: Reference, state: State, aid: Aid, part: str, sample: Sample) -> Look | None:
        """One part of a sample with the filter's own errors of aids, its R as learned.

        It is a look at the nominal state, with sigma points at the filter's own estimate.
        """
        if self.scaling is None:
            return self.nominal_look(reference, state, aid, part, sample)
        state = state if self.closed else reference.own(state, self.row)
        look = self.nominal_look(reference, state, aid, part, sample)
        if look is None:
            return None
        starts = self._starts[aid.sensor]
        root = unscented.factor(state.P[self.row], CURVED)
        points = unscented.points(state.q_nb, state.v_n, state.lla, self._whole(state), root, self.scaling.spread)
        at_points, there = np.empty((len(points.x), len(look.nu))), state.copy()
        for k, (q_nb, v_n, lla, x) in enumerate(zip(*points, strict=True)):
            there.q_nb[:], there.v_n[:], there.lla[:] = q_nb, v_n, lla
            sensor_errors(there.errors, x, reference.driven)
            at_point = aid.look(part, sample, Seat(reference, there, x, starts))
            assert at_point is not None  # as whether there is a look depends on the sample alone
            at_points[k] = at_point.nu
        return look._replace(at_points=at_points)

    def nominal_look(self, reference: Reference, state: State, aid: Aid, part: str, sample: Sample) -> Look | None:
        """One part of a sample at the nominal state and the filter's own errors of aids, its R as learned."""
        look = aid.look(part, sample, Seat(reference, state, state.x[self.row], self._starts[aid.sensor]))
        noise = self._noise(aid.sensor, part)
        if look is None or noise is None:
            return look
        return look._replace(R=noise.learned(look.R), told=look.R)

    def _whole(self, state: State) -> Array:
        """All estimated values beyond the motion (n,) of a closed filter, those of the inertial sensors too."""
        x: Array = state.x[self.row].copy()
        x[: len(state.imu)] = state.imu
        return x

    def innovate(self, state: State, look: Look) -> tuple[Array, Array, float]:
        """(nu, S, nis) of a look at the filter's own estimate."""
        if look.at_points is not None:
            nu, S, _, nis = self._innovate_points(state.P[self.row], look.at_points, look.H, look.R)
            return nu, S, nis
        return _innovate(state.P[self.row], state.x[self.row], len(state.imu), look.H, look.R, look.nu)

    def absorb(
        self,
        reference: Reference,
        state: State,
        nu: Array,
        H: Array,
        R: Array,
        threshold: float,
        at_points: Array | None = None,
    ) -> tuple[Array, float]:
        """Correct if nis is at most ``threshold``; (S, nis). ``nu`` is at the filter's own estimate."""
        s = state
        if self.scaling is not None:
            assert at_points is not None
            return self._absorb_points(reference, s, at_points, H, R, threshold)
        return absorb(
            s.q_nb, s.v_n, s.lla, s.imu, s.x[self.row], s.P[self.row], s.errors, reference.driven,
            nu, H, R, threshold, self.closed,
        )  # fmt: skip

    def _innovate_points(self, P: Array, at_points: Array, H: Array, R: Array) -> tuple[Array, Array, Array, float]:
        """`unscented.innovate`: minus ``at_points`` is prediction - measurement, so that zero is measured."""
        assert self.scaling is not None
        root, z, work = unscented.factor(P, CURVED), np.zeros(len(R)), unscented.scratch(len(P), len(R))
        spread, excess = self.scaling.spread, self.scaling.excess
        nu, S, W, nis = unscented.innovate(P, -at_points, z, R, root, H, work, spread, excess)
        return nu.copy(), S.copy(), W, nis

    def _absorb_points(
        self, reference: Reference, state: State, at_points: Array, H: Array, R: Array, threshold: float
    ) -> tuple[Array, float]:
        """`absorb` by sigma points."""
        s, P = state, state.P[self.row]
        _, S, W, nis = self._innovate_points(P, at_points, H, R)
        if nis <= threshold:
            error = unscented.correct(P, W, unscented.scratch(len(P)))
            if not self.closed:
                remove_open(s.x[self.row], error)
                return S, nis
            x, common = self._whole(s), len(s.imu)
            unscented.remove(s.q_nb, s.v_n, s.lla, x, error)
            s.imu[MOTION:], s.x[self.row, common:] = x[MOTION:common], x[common:]
            sensor_errors(s.errors, s.imu, reference.driven)
        return S, nis

    def fuse(
        self, reference: Reference, state: State, sample: Sample, part: str, look: Look,
        withheld: Ruling | None = None,
    ) -> UpdateReport:  # fmt: skip
        """Gate, policy and correction of a closed filter; without correction where ``withheld`` says why."""
        withheld = withheld or look.withheld
        threshold = self.gate.threshold(len(look.nu))
        nu, H, R, at_points = look.nu, look.H, look.R, look.at_points
        simple = part not in self.policies and part not in self.fadings and part not in self.noises
        limit = threshold if simple and not withheld else -math.inf
        S, nis = self.absorb(reference, state, nu, H, R, limit, at_points)
        ruling = withheld or (FUSED if nis <= threshold else OUTSIDE)
        if not simple and ruling is FUSED:
            ruling = self.weigh(reference, state, sample, part, look, S)
        return report_on(sample, part, nu, S, nis, threshold, ruling)

    def weigh(self, reference: Reference, state: State, sample: Sample, part: str, look: Look, S: Array) -> Ruling:
        """Correct a closed filter with a look that passed its gate, as fading and policy say: see `take`."""
        fading = self.fadings.get(part)
        factor = fading.factor(look.nu, S) if fading is not None else 1.0
        if factor > 1.0:
            state.P[self.row] *= factor
            again = self.look(reference, state, self.aids[sample.sensor], part, sample)
            assert again is not None
            look = again
            S, _ = self.absorb(reference, state, look.nu, look.H, look.R, -math.inf, look.at_points)
        every = np.full(len(look.nu), True)
        noise, policy = self._noise(sample.sensor, part), self.policies.get(part)
        return self.take(reference, state, look, look.nu, S, every, noise, policy, sample.t)

    def take(
        self,
        reference: Reference,
        state: State,
        look: Look,
        nu: Array,
        S: Array,
        used: Mask,
        noise: SageHusa | None,
        policy: Policy | None,
        t: float,
    ) -> Ruling:
        """Correct with the ``used`` axes as far as the policy lets them; what was used teaches ``noise``.

        The weight is the mean factor on the information.
        """
        if policy is None and noise is None and used.all():
            self.absorb(reference, state, nu, look.H, look.R, math.inf, look.at_points)
            return FUSED
        R = np.where(used, look.R, np.inf)
        if policy is not None and used.any():
            R[used] = policy.adapt(nu[used], S[np.ix_(used, used)], look.R[used], t)
            used = np.isfinite(R)
            if not used.any():
                return LEFT_OUT
        if noise is not None:
            noise.learn(nu, S - np.diag(look.R), R)
        if used.any():
            at_points = None if look.at_points is None else look.at_points[:, used]
            self.absorb(reference, state, nu[used], look.H[used], R[used], math.inf, at_points)
        told = look.R if look.told is None else look.told
        weight = float(np.mean(told / R))
        return Ruling(Outcome.FUSED if weight >= 1.0 else Outcome.WEAKENED, weight=weight)


@njit
def _innovate(P: Array, x: Array, common: int, H: Array, R: Array, nu: Array) -> tuple[Array, Array, float]:
    """(innovation, S, nis) at nominal state plus ``x[:common]``, from the innovation ``nu`` (m,) at the nominal one."""
    own = nu.copy()
    for k in range(len(nu)):
        for j in range(common):
            own[k] -= H[k, j] * x[j]
    S, _, _, nis = innovate(P, H, R, own)
    return own, S, nis
