"""A GNSS receiver: position, velocity and course over ground."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from nav._jit import lean, njit
from nav.aids.base import (
    HEIGHT_LIMITS,
    NO_RATES,
    SPEED_LIMIT,
    Axes,
    Kind,
    Measurement,
    OperatingPoint,
    position_problem,
    put_skew,
    well_within,
)
from nav.claims import WIDEST, Following
from nav.columns import column
from nav.earth import displacement_components, displacement_n, earth_rate_components, wrap_longitude
from nav.error_model import PHI, POS, VEL, Block, Drive, Indices, markov, sensor_errors
from nav.rotation import cross_components, dcm_components, dcm_from_quat, quat_rotate_components
from nav.samples import Array, GnssSample, Sample

if TYPE_CHECKING:
    from nav.state import State
    from nav.unscented import Points

WHITE_SHARE = 0.1  # of a receiver's reported variance, the least that is taken as white noise
NUMBERS = "lat", "lon", "h", "v_n", "sigma_position_n", "sigma_velocity_n"  # of a fix
AT_REST = 1e-12  # square of a speed below which there is no direction [m^2/s^2]
CONTRADICTION_S, REMEMBERED_S = 2.0, 6.0  # over which positions are held against velocities, faults remembered
WAKE_S = 0.5  # in which what manoeuvres do to velocities comes, and goes, but for 1/e


@dataclass(frozen=True)
class Course:
    """Course over ground as a measurement of heading (Cheng et al. 2020, Eq 22-24): see `gnss_course`.

    It is worth the receiver's velocity and the ``slip`` of the body, over the speed; nothing below ``minimum`` speed.
    Where it turned faster than ``max_turn_rate`` within the last ``quiet_s`` there is none (`nav.motion`).
    """

    max_turn_rate: float = math.inf  # [rad/s]
    quiet_s: float = 0.0
    slip: float = 0.0  # sideways through the air, 1 sigma [m/s]
    minimum: float = 1.0  # [m/s]


@dataclass(frozen=True)
class GnssAid:
    """A receiver by its own sigmas, of which a part may be a slowly varying error (first-order Markov, NED).

    A velocity older by ``velocity_lag`` than the position of the same sample, as of receivers that smooth it, is held
    against the velocity at that time, v(t - L) = v(t) - L a(t - L / 2), which is right to second order. That the
    acceleration which leads there is itself wrong by tilt and by the accelerometers' biases is left out: 0.03 m/s for a
    degree and 0.2 s. It goes by averages (`nav.state.State.accelerated`): the noise of one increment would seem to tell
    a latency, and makes it smaller than it is, as any noise of what is regressed upon does. Where it is known to
    ``latency_sigma`` only when a sample was valid, two states say by how much earlier the position was, and by how
    much more the velocity lags. The receiver's own filters make both change with each manoeuvre by as much: velocity
    times that is noise of the position beside its sigma, and acceleration times that of the velocity, where it outlasts
    the manoeuvre (`Wake`). Positions of a sound receiver that jump against its velocities by no more than
    ``largest_jump`` are no fault: see `Contradiction`. All this is what manoeuvres may do: with ``follow_s`` positions
    are claimed to be better as long as they are, and velocities to be worse (`nav.claims`).
    """

    sensor: str = "gnss"
    arm_b: Axes = (0.0, 0.0, 0.0)  # IMU to antenna [m]
    use_velocity: bool = True
    position_error_sigma: Axes = (0.0, 0.0, 0.0)  # [m]
    position_error_correlation_s: float = 100.0
    velocity_error_sigma: Axes = (0.0, 0.0, 0.0)  # [m/s]
    velocity_error_correlation_s: float = 20.0
    course: Course | None = None
    latency_sigma: float = 0.0  # how well it is known when a sample was valid [s]
    velocity_lag: float = 0.0  # by which its velocity is older than its position [s]
    largest_jump: float = 0.0  # [m]
    follow_s: float = 0.0  # over which what is claimed follows innovations, 0: it does not [s]

    @property
    def following(self) -> dict[str, Following]:
        """See `nav.claims.FollowingAid`."""
        if not self.follow_s:
            return {}
        velocity = Following(self.follow_s, 1.0, WIDEST)
        return {"gnss_position": Following(self.follow_s), "gnss_velocity": velocity}

    @property
    def parts(self) -> tuple[tuple[str, int], ...]:
        """See `Aid`."""
        velocity = (("gnss_velocity", 3),) if self.use_velocity else ()
        return (("gnss_position", 3), *velocity, *((("gnss_course", 1),) if self.course else ()))

    @property
    def states(self) -> tuple[str, ...]:
        """See `Aid`."""
        own = tuple(f"{self.sensor}_{name}" for name in ("position_error", "velocity_error", "latency"))
        return (*own, "wind", "gust") if self.course else own

    def blocks(self) -> list[Block]:
        """See `Aid`."""
        position, velocity, latency = self.states[:3]
        return [
            markov(position, 3, self.position_error_sigma, self.position_error_correlation_s),
            markov(velocity, 3, self.velocity_error_sigma, self.velocity_error_correlation_s),
            Block(latency, 2, self.latency_sigma),
        ]

    @cached_property
    def arm(self) -> Array:
        """IMU to antenna (3,) [m]."""
        return np.array(self.arm_b, dtype=float)

    @cached_property
    def _correlated(self) -> tuple[Array, Array]:
        return np.array(self.position_error_sigma) ** 2, np.array(self.velocity_error_sigma) ** 2

    @property
    def plain(self) -> tuple[Kind, tuple[float, ...]] | None:
        """See `PlainAid`: the variances of its slow errors, of position and velocity, and the arm."""
        if self.course is not None or self.latency_sigma or self.velocity_lag:
            return None
        return Kind.GNSS, (*self._correlated[0], *self._correlated[1], *self.arm)

    def numbers(self, samples: Sequence[GnssSample]) -> Array:
        """See `PlainAid`."""
        return np.column_stack([column(samples, name) for name in NUMBERS])

    def measure(self, part: str, sample: Sample, at: OperatingPoint) -> Measurement | None:
        """See `Aid`."""
        assert isinstance(sample, GnssSample)
        state, latency = at.state, at.starts[2]
        if part == "gnss_position":
            nu, H = gnss_position(state.q_nb, state.lla, at.x, self.arm, at.starts[0], sample.lat, sample.lon, sample.h)
            R = white(sample.sigma_position_n, self._correlated[0])
            if latency >= 0:
                older = float(at.x[latency])
                nu += older * state.v_n
                H[:, VEL : VEL + 3] -= older * np.eye(3)
                H[:, latency] = -state.v_n
                R = R + (self.latency_sigma * state.v_n) ** 2
            return Measurement(nu, H, R)
        if not has_velocity(sample):
            return None
        if part == "gnss_course":
            return self._course(sample, at)
        nu, H = gnss_velocity(
            state.q_nb, state.v_n, state.lla, at.x, state.rates[0], state.errors, at.reference.driven,
            self.arm, at.starts[1], sample.v_n,
        )  # fmt: skip
        unknown = NO_RATES if any(self.arm_b) and not state.rates[0].any() else None
        R = white(sample.sigma_velocity_n, self._correlated[1])
        if latency >= 0 or self.velocity_lag:
            lag = self.velocity_lag
            if latency >= 0:
                lag += float(at.x[latency] + at.x[latency + 1])
                H[:, latency] = H[:, latency + 1] = -state.accelerated(lag)
                R = R + (self.latency_sigma * state.acceleration[0]) ** 2
            nu += lag * state.accelerated(lag / 2)
        return Measurement(nu, H, R, unknown)

    def manoeuvre(self, state: State) -> Array:
        """The variance (3,) [m^2/s^2] that accelerating now adds to a velocity that is late by an uncertain time."""
        acceleration: Array = state.acceleration[0]
        return (self.latency_sigma * acceleration) ** 2

    def at_points(self, part: str, sample: Sample, at: OperatingPoint, points: Points) -> Array | None:
        """See `AidAtPoints`."""
        assert isinstance(sample, GnssSample)
        q_nb, v_n, lla, x = points
        if at.starts[2] >= 0 or self.velocity_lag:
            return None
        if part == "gnss_position":
            return _positions(q_nb, lla, x, self.arm, at.starts[0], sample.lat, sample.lon, sample.h)
        if part == "gnss_course":
            return _courses(q_nb, v_n, x, at.starts[3], at.starts[4], sample.v_n)
        return _velocities(
            q_nb, v_n, lla, x, at.state.rates[0], at.reference.driven, self.arm, at.starts[1], sample.v_n
        )  # fmt: skip

    def _course(self, sample: GnssSample, at: OperatingPoint) -> Measurement | None:
        assert self.course is not None
        speed2 = float(sample.v_n[0] ** 2 + sample.v_n[1] ** 2)
        if not speed2 > self.course.minimum**2:
            return None
        nu, H = gnss_course(at.state.q_nb, at.state.v_n, at.x, at.starts[3], at.starts[4], sample.v_n)
        sigma2 = float(sample.sigma_velocity_n[:2] @ sample.sigma_velocity_n[:2]) / 2
        return Measurement(nu, H, np.array([(sigma2 + self.course.slip**2) / speed2]))


@njit
def white(sigma: Array, correlated_variance: Array) -> Array:
    """The white part of a receiver's reported variance, when the correlated part is a state of the filter."""
    R = np.empty(len(sigma))
    put_white(R, sigma, correlated_variance)
    return R


@lean
def put_white(R: Array, sigma: Array, correlated_variance: Array) -> None:
    """`white` into ``R`` (3,)."""
    for i in range(len(sigma)):
        reported = sigma[i] * sigma[i]
        R[i] = max(reported - correlated_variance[i], WHITE_SHARE * reported)


@dataclass
class Wake:
    """What a manoeuvre does to a receiver's velocities, and leaves in them: the error of a pull-up outlasts it.

    w_k = e w_(k-1) + (1 - e) m_k per axis, e = exp(-dt / `WAKE_S`), where m_k is `GnssAid.manoeuvre`. A manoeuvre that
    is more than that by its `onset` max(0, m_k - w_k) may do that too, at once.
    """

    variance: Array = field(default_factory=lambda: np.zeros(3))  # w [m^2/s^2]
    onset: Array = field(default_factory=lambda: np.zeros(3))  # [m^2/s^2]
    _heard: float = -math.inf  # [s]

    def heard(self, t: float, manoeuvre: Array) -> Array:
        """The variance (3,) [m^2/s^2] at ``t`` [s]; at a time that it was told of before it is what it was."""
        if t > self._heard:
            kept = math.exp((self._heard - t) / WAKE_S)
            self.variance = kept * self.variance + (1.0 - kept) * manoeuvre
            self.onset = np.maximum(0.0, manoeuvre - self.variance)
            self._heard = t
        return self.variance


@dataclass
class Contradiction:
    """How far a receiver's positions moved against its own velocities of late, whatever a filter thinks of either.

    c_k = exp(-dt / T) c_(k-1) + p_k - p_(k-1) - dt (v_k + v_(k-1)) / 2 [m], NED, dt = t_k - t_(k-1), T
    `CONTRADICTION_S`. In pull-ups, and when the satellites used change, a sound receiver contradicts itself by metres;
    a fault that moves positions and velocities together, or slowly, does not. More than the ``largest`` [m] is no sound
    receiver's, and explains nothing until it is forgotten.
    """

    largest: float
    variance: Array = field(default_factory=lambda: np.zeros(3))  # c^2, as far as a sound receiver's [m^2]
    _moved: Array = field(default_factory=lambda: np.zeros(3))
    _last: GnssSample | None = None
    _faulty: float = -math.inf  # when it was last more than a sound receiver's [s]

    def heard(self, sample: GnssSample) -> Array:
        """The variance (3,) [m^2] with one more sample; one that it was told of before changes nothing."""
        last = self._last
        if last is not None and sample.t <= last.t:
            return self.variance
        self._last = sample
        if last is None or sample.t - last.t > CONTRADICTION_S or not (has_velocity(sample) and has_velocity(last)):
            self._moved = np.zeros(3)
        else:
            dt = sample.t - last.t
            moved = displacement_n(sample.lat, sample.lon, sample.h, last.lat, last.lon, last.h)
            self._moved = math.exp(-dt / CONTRADICTION_S) * self._moved + moved - 0.5 * dt * (sample.v_n + last.v_n)
        if np.abs(self._moved).max() > self.largest:
            self._faulty = sample.t
        self.variance = self._moved**2 if sample.t - self._faulty > REMEMBERED_S else np.zeros(3)
        return self.variance


def problem(sample: GnssSample) -> str:
    """See `nav.aids.problem`; velocity may be missing (NaN) altogether."""
    if trouble := position_problem(sample.lat, sample.lon, sample.h):
        return trouble
    if not _positive(sample.sigma_position_n):
        return "reported accuracy of position is not a positive number"
    speed = math.hypot(*sample.v_n.tolist())
    if math.isnan(speed):
        return "" if np.isnan(sample.v_n).all() else "velocity is not finite"
    if speed > SPEED_LIMIT:
        return f"speed {speed:.6g} is out of range"
    return "" if _positive(sample.sigma_velocity_n) else "reported accuracy of velocity is not a positive number"


def _positive(sigma: Array) -> bool:
    x: float
    x, y, z = sigma.tolist()
    return 0.0 < x < math.inf and 0.0 < y < math.inf and 0.0 < z < math.inf


@njit
def is_whole(numbers: Array) -> bool:
    """Whether a fix of these numbers (12,), those of `GnssAid.numbers`, surely has no `problem`, and has velocity."""
    for k in range(6, 12):
        if not 0.0 < numbers[k] < math.inf:
            return False
    speed = math.sqrt(numbers[3] ** 2 + numbers[4] ** 2 + numbers[5] ** 2)
    placed = abs(numbers[0]) < 0.5 * math.pi and abs(numbers[1]) < 2 * math.pi
    return placed and well_within(numbers[2], HEIGHT_LIMITS) and well_within(speed, (-SPEED_LIMIT, SPEED_LIMIT))


def has_velocity(sample: GnssSample) -> bool:
    """Whether a sound GNSS sample carries velocity."""
    return math.isfinite(sample.v_n[0])


@njit
def gnss_position(
    q_nb: Array, lla: Array, x: Array, arm_b: Array, gnss_position_error: int, lat: float, lon: float, h: float
) -> tuple[Array, Array]:
    """Antenna position [m], NED: p + C_nb arm_b + correlated receiver error."""
    nu, H = np.empty(3), np.zeros((3, len(x)))
    put_gnss_position(nu, H, q_nb, lla, x, arm_b, gnss_position_error, lat, lon, h)
    return nu, H


@lean
def put_gnss_position(
    nu: Array, H: Array, q_nb: Array, lla: Array, x: Array, arm_b: Array, gnss_position_error: int, lat: float,
    lon: float, h: float,
) -> None:  # fmt: skip
    """`gnss_position` into ``nu`` (3,) and zeros ``H`` (3, n)."""
    arm_n = quat_rotate_components(q_nb, arm_b)
    away_n = displacement_components(lat, lon, h, lla[0], lla[1], lla[2])
    put_skew(H, arm_n)
    for i in range(3):
        H[i, POS + i] = 1.0
        nu[i] = away_n[i] - arm_n[i]
        if gnss_position_error >= 0:
            H[i, gnss_position_error + i] = 1.0
            nu[i] -= x[gnss_position_error + i]


@njit
def gnss_velocity(
    q_nb: Array,
    v_n: Array,
    lla: Array,
    x: Array,
    omega_measured_b: Array,
    errors: Array,
    driven: Indices,
    arm_b: Array,
    gnss_velocity_error: int,
    antenna_v_n: Array,
) -> tuple[Array, Array]:
    """Antenna velocity over ground [m/s], NED: v + C_nb (omega_ib x arm) - omega_ie x (C_nb arm) + correlated error.

    omega_ib is the measured angular rate less the estimated sensor ``errors`` (4, 3), rows as `Drive`; ``driven`` tells
    which states those are (`ErrorModel.driven`).
    """
    nu, H = np.empty(3), np.zeros((3, len(x)))
    put_gnss_velocity(
        nu, H, q_nb, v_n, lla, x, omega_measured_b, errors, driven, arm_b, gnss_velocity_error, antenna_v_n
    )
    return nu, H


@lean
def put_gnss_velocity(
    nu: Array, H: Array, q_nb: Array, v_n: Array, lla: Array, x: Array, omega_measured_b: Array, errors: Array,
    driven: Indices, arm_b: Array, gnss_velocity_error: int, antenna_v_n: Array,
) -> None:  # fmt: skip
    """`gnss_velocity` into ``nu`` (3,) and zeros ``H`` (3, n)."""
    C_nb = dcm_components(q_nb)
    scale, bias = errors[Drive.GYRO_SCALE], errors[Drive.GYRO]
    gain = 1 / (1 + scale[0]), 1 / (1 + scale[1]), 1 / (1 + scale[2])
    omega_b = (
        (omega_measured_b[0] - bias[0]) * gain[0],
        (omega_measured_b[1] - bias[1]) * gain[1],
        (omega_measured_b[2] - bias[2]) * gain[2],
    )
    arm_n = quat_rotate_components(q_nb, arm_b)
    swing_n = quat_rotate_components(q_nb, cross_components(omega_b, arm_b))
    earth_n = earth_rate_components(lla[0])
    carried_n = cross_components(earth_n, arm_n)
    put_skew(H, swing_n)
    along = earth_n[0] * arm_n[0] + earth_n[1] * arm_n[1] + earth_n[2] * arm_n[2]
    for i in range(3):
        nu[i] = antenna_v_n[i] - v_n[i] - swing_n[i] + carried_n[i]
        for j in range(3):
            H[i, PHI + j] -= arm_n[i] * earth_n[j]  # [earth x] [arm x] = arm earth' - (earth . arm) I
        H[i, PHI + i] += along
        H[i, VEL + i] = 1.0
        if gnss_velocity_error >= 0:
            H[i, gnss_velocity_error + i] = 1.0
            nu[i] -= x[gnss_velocity_error + i]
    for block in range(len(driven)):
        kind, start = driven[block, 0], driven[block, 1]
        if kind == Drive.GYRO or kind == Drive.GYRO_SCALE:
            for i in range(3):
                for j in range(3):
                    # C_nb [arm x]: a gyro bias estimated too high leaves too little rate
                    one, two = (j + 1) % 3, (j + 2) % 3
                    from_gyro = (C_nb[i][one] * arm_b[two] - C_nb[i][two] * arm_b[one]) * gain[j]
                    H[i, start + j] = from_gyro if kind == Drive.GYRO else from_gyro * omega_b[j]


@njit
def gnss_course(q_nb: Array, v_n: Array, x: Array, wind: int, gust: int, antenna_v_n: Array) -> tuple[Array, Array]:
    """Course over ground, clockwise from north [rad]: heading + drift, nu in (-pi, pi].

    The measured course is atan2(vE, vN) of the receiver's velocity. Drift is the angle from the velocity through the
    air, v - wind - gust, to v, both horizontal: of an aircraft that does not slip. Without wind states it is zero and
    course is taken for heading, as on a road (Cheng et al. 2020, equation 22; their z = heading - course is -nu).

    Sign: phi down turns the estimate anticlockwise, so H[PHI + 2] is -1, and the rest of phi counts with the tangent
    of pitch. Course is worth sigma_v / speed and nothing near rest: gate the speed.
    """
    C_nb = dcm_from_quat(q_nb)
    fwd_n, fwd_e, fwd_d = C_nb[0, 0], C_nb[1, 0], C_nb[2, 0]
    level = fwd_n * fwd_n + fwd_e * fwd_e
    H = np.zeros((1, len(x)))
    H[0, PHI], H[0, PHI + 1], H[0, PHI + 2] = fwd_n * fwd_d / level, fwd_e * fwd_d / level, -1.0
    predicted = math.atan2(fwd_e, fwd_n)
    if wind >= 0 or gust >= 0:
        air_n, air_e = v_n[0], v_n[1]
        for start in (wind, gust):
            if start >= 0:
                air_n, air_e = air_n - x[start], air_e - x[start + 1]
        ground2, air2 = max(v_n[0] * v_n[0] + v_n[1] * v_n[1], AT_REST), max(air_n * air_n + air_e * air_e, AT_REST)
        predicted += math.atan2(v_n[1], v_n[0]) - math.atan2(air_e, air_n)
        H[0, VEL], H[0, VEL + 1] = air_e / air2 - v_n[1] / ground2, v_n[0] / ground2 - air_n / air2
        for start in (wind, gust):
            if start >= 0:
                H[0, start], H[0, start + 1] = -air_e / air2, air_n / air2
    return np.array([wrap_longitude(math.atan2(antenna_v_n[1], antenna_v_n[0]) - predicted)]), H


@njit
def _positions(
    q_nb: Array, lla: Array, x: Array, arm_b: Array, gnss_position_error: int, lat: float, lon: float, h: float
) -> Array:
    """Innovations (N, 3) of `gnss_position` at N points."""
    nu = np.empty((len(x), 3))
    for k in range(len(x)):
        nu[k] = gnss_position(q_nb[k], lla[k], x[k], arm_b, gnss_position_error, lat, lon, h)[0]
    return nu


@njit
def _velocities(
    q_nb: Array, v_n: Array, lla: Array, x: Array, omega_measured_b: Array, driven: Indices, arm_b: Array,
    gnss_velocity_error: int, antenna_v_n: Array,
) -> Array:  # fmt: skip
    """Innovations (N, 3) of `gnss_velocity` at N points."""
    nu, errors = np.empty((len(x), 3)), np.empty((4, 3))
    for k in range(len(x)):
        sensor_errors(errors, x[k], driven)
        nu[k] = gnss_velocity(
            q_nb[k], v_n[k], lla[k], x[k], omega_measured_b, errors, driven, arm_b, gnss_velocity_error, antenna_v_n
        )[0]
    return nu


@njit
def _courses(q_nb: Array, v_n: Array, x: Array, wind: int, gust: int, antenna_v_n: Array) -> Array:
    """Innovations (N, 1) of `gnss_course` at N points."""
    nu = np.empty((len(x), 1))
    for k in range(len(x)):
        nu[k] = gnss_course(q_nb[k], v_n[k], x[k], wind, gust, antenna_v_n)[0]
    return nu
