"""Initial attitude, velocity and position from the sensors alone, at rest or in flight, with honest sigmas.

Between two GNSS fixes the specific force, carried into the axes of one moment by the gyros, must equal the change of
GNSS velocity less gravity: one pair of vectors known in body and in n, whatever the aircraft does in between. A second
pair fixes the heading: the magnetic field; else, at rest, the Earth's rate if the gyros are good enough to sense it;
else, in motion, the course, which is the heading but for wind; else what many pairs of the first kind tell together
(`nav.velocity_matching`). Two pairs make an attitude (TRIAD: Black, AIAA J. 2 (1964)). The covariance follows by
differences, correlation with the sensors' biases included: a tilt that was levelled on a biased accelerometer is not
independent of that bias.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from nav._jit import njit
from nav.aids import Aid, AirspeedAid, GnssAid, MagnetometerAid
from nav.aids.gnss import WHITE_SHARE, has_velocity
from nav.aids.magnetometer import FIELD_SIZE
from nav.earth import displacement_n, earth_rate_n, gravity, radii, transport_rate_n, wrap_longitude
from nav.error_model import CROSS, MOTION, PHI, POS, VEL, ErrorModel, ImuModel
from nav.rotation import (
    cross,
    dcm_from_quat,
    quat_from_dcm,
    quat_from_rotvec,
    quat_multiply,
    quat_normalise,
    quat_rotate,
    skew,
)
from nav.samples import Array, GnssSample, ImuSamples, usable
from nav.triad import attitude_jacobian, triad
from nav.velocity_matching import Matched, VelocityMatching

REST_SPEED = 0.5  # slower than this is standing [m/s]
COURSE_SPEED = 8.0  # faster than this is flying, and the course tells the heading [m/s]
COURSE_SIGMA_LIMIT = math.radians(40.0)  # beyond which, by wind, it does not: filters are linear
HEADING_SIGMA_LIMIT = math.radians(10.0)  # no gyrocompassing with gyros that leave more than this
DIFFERENCE_S, USUAL_ACCELERATION = 1.0, 3.0  # of positions that tell a velocity; of small vehicles [s, m/s^2]
WITHOUT_VELOCITY_S = 10.0  # so long must it take then: as long as errors of such velocities are small beside gravity's
NOISE_SHARE = 0.2  # gyrocompassing lasts until noise adds less than this share of the limit
SWING_ROUNDS = 3  # of the correction of the antenna's swing: each leaves a few hundredths of the last
UNCALIBRATED = 2.5  # times what a magnetometer is told to be wrong by: a sound one is so once in twenty
# Hard iron over the level field, beyond which a magnetometer tells no heading to begin with: beside a course, or alone.
FIELD_HEADING_LIMIT, ALONE_LIMIT = 0.7, 1.0
_DV_B, _S_B, _DV_N, _S_N = range(4)  # of the vectors that TRIAD takes
_GNSS = ("gnss_position_error", "gnss_velocity_error", "gnss_latency")
_MAGNETOMETER = tuple(f"magnetometer_{error}" for error in ("bias", "anomaly", "error", "soft_iron"))
PULL = 3.0  # of a receiver that is led away steadily, where nothing else is asked for a heading [m/s^2]
FEW, CLEARLY = 5, 0.9  # pairs, and the share of pushes that is explained, where nothing else is asked for a heading
LONGEST_S = 6.0  # beyond which gyros drift too far within a pair of vectors for matching
NORTH = np.array([1.0, 0.0, 0.0])
ACCELERATION_ERROR = 0.1  # of such a pair: latency, scale and tilt of what manoeuvres [m/s^2]


@dataclass(frozen=True)
class InitialState:
    """Where an estimator begins: motion at ``t`` with the covariance (9, 9) of [phi, dv, dp].

    ``correlated`` gives, by block name, the covariance (9, k) of that motion error with the error of further blocks;
    ``widened`` the 1-sigma of blocks that turned out to be worse than the filter was told.
    """

    t: float
    lat: float
    lon: float
    h: float
    v_n: Array
    q_nb: Array
    covariance: Array
    correlated: Mapping[str, Array] = field(default_factory=dict)
    widened: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class AidSigmas:
    """What alignment is told of the aids [1-sigma]: field in T (noise, constant and slow errors, anomaly of the
    reference) and by soft iron [1], correlated GNSS errors in m, m/s NED and its latency in s; wind in m/s.
    """

    field: float
    field_bias: float
    gnss_position: Array
    gnss_velocity: Array
    wind: float
    field_anomaly: float = 0.0
    field_error: float = 0.0
    soft_iron: float = 0.0
    gnss_latency: float = 0.0


@dataclass(frozen=True)
class _Cause:
    """Errors (k,) of a block, of covariance ``known`` (k, k), that add ``gain`` (3, k) times them to a vector."""

    vector: int  # of the four that TRIAD takes
    block: str
    gain: Array
    known: Array


@dataclass(frozen=True)
class _Heading:
    """The second pair of vectors, with the white variance of the one in body axes, what else it is wrong by, and what
    else turns the heading.
    """

    s_b: Array
    s_n: Array
    variance_b: float
    causes: Sequence[_Cause] = ()
    heading_sigma: float = 0.0


class Alignment:
    """Collects sensors until it can tell where the body is and how it lies; `problem` says what is missing."""

    def __init__(self, imu: ImuModel, aids: AidSigmas, arm_b: Array, duration_s: float) -> None:
        self.imu, self.aids, self.arm_b, self.duration_s = imu, aids, arm_b, duration_s
        self._model = ErrorModel(imu)
        self.receiver = ""  # whose arm and slow errors it is told
        self.names: dict[str, str] = {}  # of the blocks in `InitialState.correlated`, where a filter has others
        self.problem = "waiting for GNSS"
        self._first: GnssSample | None = None
        self._places: list[GnssSample] = []  # of a receiver that tells no velocity, the last ones
        self._biases = (
            math.hypot(imu.gyro_bias_sigma, imu.gyro_drift_sigma),
            math.hypot(imu.accel_bias_sigma, imu.accel_drift_sigma),
        )
        self._matching = VelocityMatching(*self._biases)
        self._by_accelerations = self._compassing = False
        self.matched: Matched | None = None  # by accelerations, at the last fix
        self._restart(None)

    @classmethod
    def from_aids(cls, imu: ImuModel, aids: Iterable[Aid], duration_s: float) -> Alignment:
        """By the first receiver, magnetometer and wind of a filter's ``aids``, and what such are by default."""
        aids = list(aids)
        gnss = next((aid for aid in aids if isinstance(aid, GnssAid)), GnssAid())
        magnetometer = next((aid for aid in aids if isinstance(aid, MagnetometerAid)), MagnetometerAid())
        sigmas = AidSigmas(
            field=magnetometer.sigma,
            field_bias=magnetometer.bias_sigma,
            field_anomaly=magnetometer.anomaly_sigma,
            field_error=magnetometer.error_sigma,
            soft_iron=magnetometer.soft_iron_sigma,
            gnss_position=np.array(gnss.position_error_sigma),
            gnss_velocity=np.array(gnss.velocity_error_sigma),
            gnss_latency=gnss.latency_sigma,
            wind=next((aid.wind_sigma for aid in aids if isinstance(aid, AirspeedAid)), AirspeedAid().wind_sigma),
        )
        made = cls(imu, sigmas, gnss.arm, duration_s)
        made.receiver = gnss.sensor
        made.names = dict(zip(_GNSS, gnss.states, strict=False))
        made.names |= dict(zip(_MAGNETOMETER, magnetometer.states, strict=True))
        return made

    def by_accelerations(self) -> Alignment:
        """One for the same sensors that finds the heading by accelerations alone, soon, where they tell it clearly."""
        other = Alignment(self.imu, self.aids, self.arm_b, DIFFERENCE_S)
        other.names, other.receiver = self.names, self.receiver
        other._matching, other._by_accelerations = VelocityMatching(*self._biases, PULL, FEW, CLEARLY), True
        return other

    def _restart(self, fix: GnssSample | None) -> None:
        self._first = fix
        self._q_0b = np.array([1.0, 0.0, 0.0, 0.0])  # body axes now to those at the first fix
        self._angle_0, self._dv_0, self._field_0 = np.zeros(3), np.zeros(3), np.zeros(3)
        self._turned_0 = np.zeros((3, 3))
        self._fields = 0
        self._omega_first_b, self._omega_b = np.full(3, np.nan), np.zeros(3)

    def propagate(self, imu: ImuSamples) -> None:
        """Add a block of increments."""
        if self._first is None or not len(imu):
            return
        if not usable(imu.dtheta, imu.dv, imu.dt).all():
            self.problem = "an increment was not sound: collecting again"
            self._matching.forget()
            self._restart(None)
        else:
            _accumulate(self._q_0b, self._angle_0, self._dv_0, self._turned_0, imu.dtheta, imu.dv, imu.dt)
            self._omega_b = imu.dtheta[-1] / imu.dt[-1]
            if math.isnan(self._omega_first_b[0]):
                self._omega_first_b = imu.dtheta[0] / imu.dt[0]

    def add_field(self, field_b: Array) -> None:
        """Add a magnetic field [T], body axes, at the current time."""
        self._field_0 += quat_rotate(self._q_0b, field_b)
        self._fields += 1

    def add_gnss(self, fix: GnssSample, field_n: Array | None) -> InitialState | None:
        """Add a sound fix at the current time, ``field_n`` the reference field there [T]; the state once known."""
        told, duration_s = fix, self.duration_s
        if not has_velocity(told):
            differenced, duration_s = self._differenced(fix), max(duration_s, WITHOUT_VELOCITY_S)
            if differenced is None:
                self.problem = "no GNSS velocity: waiting for positions that tell it"
                return None
            fix = differenced
        first = self._first
        if first is None:
            self.problem = (
                "collecting" if duration_s == self.duration_s else "collecting, for long without GNSS velocity"
            )
            self._restart(fix)
            return None
        T = fix.t - first.t
        if duration_s - 1e-6 > T:
            return None
        C_b0 = np.ascontiguousarray(dcm_from_quat(self._q_0b).T)
        dv_b = C_b0 @ self._dv_0
        dv_n = self._specific_force_n(first, fix, T)
        swing_b = cross(self._omega_b, self.arm_b) - C_b0 @ cross(self._omega_first_b, self.arm_b)
        sigma_dv = math.sqrt(
            (self.imu.accel_bias_sigma**2 + self.imu.accel_drift_sigma**2) * T**2
            + float(np.max(first.sigma_velocity_n**2 + fix.sigma_velocity_n**2))
            + float(swing_b @ swing_b)
        )
        mismatch = abs(np.linalg.norm(dv_b) - np.linalg.norm(dv_n))
        if not mismatch <= 5 * sigma_dv:
            self.problem = f"accelerometers and GNSS velocity disagree by {mismatch / T:.3g} m/s^2"
            self._matching.forget()
            self._restart(fix)
            return None
        field_bias = self._field_bias(dv_n, field_n, sigma_dv / float(np.linalg.norm(dv_n)))
        heading = None if self._by_accelerations else self._heading(C_b0, first, fix, T, field_n, field_bias)
        if heading is None and not self._compassing:
            heading = self._matched(C_b0, swing_b, first, fix, T)
        if heading is None:
            if not self._compassing:
                self._restart(fix)
            return None
        # The antenna swings about the IMU: the velocity change of the IMU needs the attitude it serves to find.
        for _ in range(SWING_ROUNDS):
            C_nb = triad(dv_b, heading.s_b, dv_n, heading.s_n)
            dv_n = self._specific_force_n(first, fix, T) - C_nb @ swing_b
        self.problem = ""
        initial = self._state(fix, T, dv_b, dv_n, heading)
        if field_bias > self.aids.field_bias:
            initial = replace(initial, widened={"magnetometer_bias": field_bias})
        return initial

    def _differenced(self, fix: GnssSample) -> GnssSample | None:
        """The fix with the velocity that positions tell, None as long as none is `DIFFERENCE_S` older.

        It is the mean velocity since then: wrong by what both positions are, and by half of a usual acceleration.
        """
        self._places = [one for one in self._places if fix.t - one.t <= 2 * DIFFERENCE_S] + [fix]
        old = [one for one in self._places if fix.t - one.t >= DIFFERENCE_S - 1e-6]
        if not old:
            return None
        before = old[-1]
        dt = fix.t - before.t
        v_n = displacement_n(fix.lat, fix.lon, fix.h, before.lat, before.lon, before.h) / dt
        sigma = np.sqrt(
            (fix.sigma_position_n**2 + before.sigma_position_n**2) / dt**2 + (USUAL_ACCELERATION * dt / 2) ** 2
        )
        return replace(fix, v_n=v_n, sigma_velocity_n=sigma)

    def _specific_force_n(self, first: GnssSample, fix: GnssSample, T: float) -> Array:
        """Integral of specific force in n between the fixes: velocity change less gravity and Coriolis."""
        v_n = 0.5 * (first.v_n + fix.v_n)
        turn = 2 * earth_rate_n(fix.lat) + transport_rate_n(fix.lat, fix.h, v_n)
        change: Array = fix.v_n - first.v_n + T * cross(turn, v_n)
        change[2] -= gravity(fix.lat, 0.5 * (first.h + fix.h)) * T
        return change

    def _field_bias(self, dv_n: Array, field_n: Array | None, tilt: float) -> float:
        """The hard iron per axis [T] that must be reckoned with: as told, or more of a magnetometer not calibrated.

        Specific force, known to ``tilt`` [rad], tells whatever the heading what of a field is along it and what across.
        What both are off by is the least that the errors can be.
        """
        if self._fields == 0 or field_n is None or self.aids.field_bias == 0.0:
            return self.aids.field_bias
        off = _along_and_across(self._field_0 / self._fields, self._dv_0) - _along_and_across(field_n, dv_n)
        bent = self.aids.field_anomaly, self.aids.field_error, self.aids.soft_iron * FIELD_SIZE, tilt * FIELD_SIZE
        known = math.hypot(self.aids.field_bias, self.aids.field, *bent)
        found = math.hypot(*off.tolist())
        return found if found > UNCALIBRATED * known else self.aids.field_bias

    def _heading(
        self, C_b0: Array, first: GnssSample, fix: GnssSample, T: float, field_n: Array | None, field_bias: float
    ) -> _Heading | None:
        speed = math.hypot(fix.v_n[0], fix.v_n[1])
        told = field_bias == self.aids.field_bias
        on_course = speed >= COURSE_SPEED and self.aids.wind <= COURSE_SIGMA_LIMIT * speed
        level = 0.0 if field_n is None else math.hypot(field_n[0], field_n[1])
        most = level * (FIELD_HEADING_LIMIT if on_course else ALONE_LIMIT)
        if self._fields > 0 and field_n is not None and (told or field_bias <= most):
            field_b = C_b0 @ self._field_0 / self._fields
            return _Heading(
                field_b, field_n, self.aids.field**2 / self._fields, self._magnetometer(field_b, field_bias)
            )
        if on_course:
            course = np.array([fix.v_n[0], fix.v_n[1], 0.0])
            return _Heading(np.array([1.0, 0.0, 0.0]), course, 0.0, heading_sigma=self.aids.wind / speed)
        at_rest = max(speed, float(np.linalg.norm(first.v_n))) <= REST_SPEED
        earth_n = earth_rate_n(fix.lat)
        left = math.hypot(self.imu.gyro_bias_sigma, self.imu.gyro_drift_sigma) / abs(float(earth_n[0]))
        self._compassing = at_rest and left <= HEADING_SIGMA_LIMIT
        if self._compassing:
            return self._gyrocompass(C_b0, earth_n, T)
        lacking = "no magnetometer" if told else "the magnetometer is not calibrated"
        slow = (
            f"gyrocompassing would leave {math.degrees(min(left, math.pi)):.3g} deg"
            if at_rest
            else "it is too slow for the course"
        )
        self.problem = f"{lacking}, and {slow}: waiting for flight, or for accelerations that tell the heading"
        return None

    def _matched(self, C_b0: Array, swing_b: Array, first: GnssSample, fix: GnssSample, T: float) -> _Heading | None:
        """By what was felt between the fixes, and before; ``swing_b`` (3,) [m/s] is what the antenna swung faster."""
        sigma_v = math.sqrt(float(np.max(first.sigma_velocity_n**2 + fix.sigma_velocity_n**2)))
        sigma = math.hypot(sigma_v, ACCELERATION_ERROR * T) if T <= LONGEST_S else math.inf
        push_0 = self._dv_0 + C_b0.T @ swing_b
        self._matching.add(C_b0.T, push_0, self._turned_0, T, self._specific_force_n(first, fix, T), sigma)
        self.matched = self._matching.attitude()
        if self.matched is None and self._by_accelerations:  # by what has happened since something that did not fit
            self.matched = self._matching.attitude(FEW + 1)
        if self.matched is None:
            return None
        C_nb, covariance = self.matched
        return _Heading(C_nb[0].copy(), NORTH, 0.0, heading_sigma=math.sqrt(covariance[2, 2]))

    def go_on(self, fix: GnssSample) -> None:
        """From the fix that it was given last, though it has found a state."""
        self._restart(fix)

    @property
    def matching(self) -> bool:
        """Whether it has no other heading than what accelerations may tell, which takes longer."""
        return self._matching.under_way

    def _gyrocompass(self, C_b0: Array, earth_n: Array, T: float) -> _Heading | None:
        level_rate = abs(float(earth_n[0]))
        needed = (self.imu.gyro_noise / (NOISE_SHARE * HEADING_SIGMA_LIMIT * level_rate)) ** 2
        if needed > T:
            self.problem = f"gyrocompassing, {needed - T:.0f} s to go"
            return None
        return _Heading(
            C_b0 @ self._angle_0,
            earth_n * T,
            self.imu.gyro_noise**2 * T,
            [
                _Cause(_S_B, name, T * np.eye(3), sigma**2 * np.eye(3))
                for name, sigma in (("gyro_bias", self.imu.gyro_bias_sigma), ("gyro_drift", self.imu.gyro_drift_sigma))
            ],
        )

    def _magnetometer(self, field_b: Array, field_bias: float) -> list[_Cause]:
        """What a field (3,) [T] of body axes is wrong by beside noise, ``field_bias`` [T] being its hard iron."""
        bias, anomaly, error, soft_iron = _MAGNETOMETER
        one = np.eye(3)
        return [
            _Cause(_S_B, bias, one, field_bias**2 * one),
            _Cause(_S_N, anomaly, -one, self.aids.field_anomaly**2 * one),
            _Cause(_S_B, error, one, self.aids.field_error**2 * one),
            _Cause(_S_B, soft_iron, np.array(np.kron(one, field_b)), self.aids.soft_iron**2 * np.eye(9)),
        ]

    def _accelerometers(self, dv_b: Array, T: float) -> list[_Cause]:
        """What a change of velocity (3,) [m/s] of body axes, over ``T`` seconds, is wrong by beside noise."""
        crossing = np.zeros((3, len(CROSS)))
        for state, (axis, of) in enumerate(CROSS):
            crossing[axis, state] = dv_b[of]
        gains = {
            "accel_bias": T * np.eye(3),
            "accel_drift": T * np.eye(3),
            "accel_scale": np.diag(dv_b),
            "accel_cross": crossing,
        }
        slices, prior = self._model.slices, self._model.prior
        return [_Cause(_DV_B, n, gain, prior[slices[n], slices[n]]) for n, gain in gains.items() if n in slices]

    def _state(self, fix: GnssSample, T: float, dv_b: Array, dv_n: Array, heading: _Heading) -> InitialState:
        C_nb = triad(dv_b, heading.s_b, dv_n, heading.s_n)
        # As filters reckon with what is measured: hard iron that makes a field longer turns it by no less for them.
        expected_b = C_nb.T @ heading.s_n
        J = [attitude_jacobian(dv_b, expected_b, dv_n, heading.s_n, which) for which in range(4)]

        variance_v = np.diag(whole(fix.sigma_velocity_n, self.aids.gnss_velocity))
        up = dv_n / np.linalg.norm(dv_n)
        gyro_turn = (self.imu.gyro_bias_sigma * T) ** 2 + self.imu.gyro_noise**2 * T
        P = np.zeros((MOTION, MOTION))
        phi, vel, pos = slice(PHI, PHI + 3), slice(VEL, VEL + 3), slice(POS, POS + 3)
        P[phi, phi] = (
            self.imu.accel_noise**2 * T * J[_DV_B] @ J[_DV_B].T
            + J[_DV_N] @ (2 * variance_v) @ J[_DV_N].T
            + heading.variance_b * J[_S_B] @ J[_S_B].T
            + heading.heading_sigma**2 * np.outer(up, up)
            + gyro_turn * np.eye(3)
        )
        # Slow errors are in both fixes alike: a tilt goes with what is left of the last one.
        P[phi, vel] = J[_DV_N] @ (variance_v - np.diag(self.aids.gnss_velocity**2))
        P[vel, phi] = P[phi, vel].T
        P[vel, vel] = variance_v
        P[pos, pos] = np.diag(whole(fix.sigma_position_n, self.aids.gnss_position))

        # Every estimated error is zero, so its error is minus what it is: hence the signs.
        correlated = {name: np.zeros((MOTION, size)) for name, size in zip(_GNSS, (3, 3, 2), strict=True)}
        correlated["gnss_position_error"][pos] = -np.diag(self.aids.gnss_position**2)
        correlated["gnss_velocity_error"][vel] = -np.diag(self.aids.gnss_velocity**2)
        # A fix that is late by an uncertain time is that long ago, on the way that both its parts went since.
        correlated["gnss_latency"][pos, 0] = self.aids.gnss_latency**2 * fix.v_n
        P[pos, pos] += self.aids.gnss_latency**2 * np.outer(fix.v_n, fix.v_n)
        for cause in (*self._accelerometers(dv_b, T), *heading.causes):
            turning = J[cause.vector] @ cause.gain
            P[phi, phi] += turning @ cause.known @ turning.T
            correlated[cause.block] = np.zeros((MOTION, len(cause.known)))
            correlated[cause.block][phi] = -turning @ cause.known

        # What is known is the antenna: about it the IMU's place and velocity turn with the attitude.
        arm_n, swing_n = C_nb @ self.arm_b, C_nb @ cross(self._omega_b, self.arm_b)
        carried = np.eye(MOTION)
        carried[pos, phi], carried[vel, phi] = -skew(arm_n), -skew(swing_n)
        P = carried @ P @ carried.T
        correlated = {name: carried @ one for name, one in correlated.items()}

        q_nb = quat_from_dcm(C_nb)
        R_M, R_N = radii(fix.lat)
        return InitialState(
            t=fix.t,
            lat=fix.lat - arm_n[0] / (R_M + fix.h),
            lon=wrap_longitude(fix.lon - arm_n[1] / ((R_N + fix.h) * math.cos(fix.lat))),
            h=fix.h + arm_n[2],
            v_n=fix.v_n - swing_n,
            q_nb=q_nb,
            covariance=P,
            correlated=correlated,
        )


def whole(reported: Array, correlated: Array) -> Array:
    """Variances (3,) of what a receiver says to be as good as ``reported`` (3,), ``correlated`` (3,) being slow errors.

    A receiver may claim to be better than its slow errors are told to be. What begins at its fix has both them and its
    white noise (`nav.aids.gnss.white`): with less, and correlated with them, it would be no covariance.
    """
    return np.maximum(reported**2, correlated**2 + WHITE_SHARE * reported**2)


def _along_and_across(field: Array, force: Array) -> Array:
    """What of a ``field`` (3,) is along ``force`` (3,), and the size of the rest (2,)."""
    return np.array([field @ force, math.hypot(*cross(field, force).tolist())]) / math.hypot(*force.tolist())


@njit
def _accumulate(q_0b: Array, angle_0: Array, dv_0: Array, turned_0: Array, dtheta: Array, dv: Array, dt: Array) -> None:
    """Turn ``q_0b`` by increments (N, 3) and add them up in its axes, each taken half-way through its own turn; into
    ``turned_0`` (3, 3) the integral of C_0b.
    """
    for k in range(len(dtheta)):
        turn = quat_from_rotvec(dtheta[k])
        after = quat_normalise(quat_multiply(q_0b, turn))
        turn[0] += 1.0  # half of it, when normalised
        middle = quat_multiply(q_0b, quat_normalise(turn))
        angle, push = quat_rotate(middle, dtheta[k]), quat_rotate(middle, dv[k])
        C_0b = dcm_from_quat(middle)
        for i in range(3):
            angle_0[i] += angle[i]
            dv_0[i] += push[i]
            for j in range(3):
                turned_0[i, j] += C_0b[i, j] * dt[k]
        for i in range(4):
            q_0b[i] = after[i]
