"""The attitude filter: levelling period by period, heading from a magnetometer; see `nav.ahrs`."""

from __future__ import annotations

import math

import numpy as np

from nav import aids
from nav.ahrs.any_motion import AnyMotionLevelling
from nav.ahrs.config import KINDS, LEVEL, MAGNETIC_HEADING, AhrsConfig
from nav.ahrs.further import FurtherStates
from nav.ahrs.state import BIAS, PHI, STATES, UNKNOWN, State, covariance_step, fresh, propagate, transition
from nav.detection import Mask
from nav.earth import earth_rate_n, gravity
from nav.error_model import PAPERS, ErrorModel
from nav.kalman import update
from nav.motion import TrueAirspeed, acceleration_n
from nav.rotation import quat_from_euler, quat_from_rotvec, quat_multiply, quat_normalise, quat_rotate
from nav.samples import (
    AirspeedSample,
    Array,
    BarometerSample,
    Estimate,
    ImuSamples,
    MagnetometerSample,
    Outcome,
    Sample,
    Status,
    UpdateReport,
)

JUDGED = "judged_acceleration", "judged_yaw_rate", "judged_roll_rate"  # what the last period was judged by
BAD_SAMPLE_S = 1.0  # for how long a refused sample is told of (`Status.BAD_SAMPLE`)
TIME_TOLERANCE = 1e-4  # between a sample and the filter [s]
COINCIDENT = 1e-6  # two times this close are the same [s]
KNOWN = Status.ALIGNED | Status.DEAD_RECKONING | Status.ATTITUDE_ONLY
NO_ATTITUDE = np.full(4, np.nan)
NO_COVARIANCE = np.full((9, 9), np.nan)


class Ahrs:
    """Attitude filter behind the estimator protocol of `nav.horizon`; position and velocity are NaN throughout.

    ``field_n`` (3,) [T] is the reference magnetic field, NED; without it the magnetometer is not used. The filter
    levels itself from the first increments, or `start` sets it at a known attitude. An autopilot that knows better than
    the sensors that the body manoeuvres says so by `flight_control`.
    """

    def __init__(self, config: AhrsConfig, field_n: Array | None = None) -> None:
        self.config = config
        self._commanded = (np.empty(0), np.empty(0, bool))  # times, and whether level flight was commanded up to each
        self.t = math.nan
        self._state: State | None = None
        self._airspeed = TrueAirspeed(config.h, config.airspeed_smoothing_s)
        self._aids = tuple(kind for kind in config.aids if kind != "magnetometer" or field_n is not None)
        self._field_n = field_n
        self._g = float(gravity(config.lat, config.h))
        self._earth_n = earth_rate_n(config.lat)
        imu = config.imu
        model = ErrorModel(imu)
        self.further = FurtherStates(config)
        n = STATES + self.further.count
        self._stays = np.eye(n)
        self._variance_rate = np.zeros(n)
        self._variance_rate[:STATES] = model.density[model.places(PAPERS["jiang2021"])] ** 2
        self._sigma_accel_bias = np.full(3, imu.accel_bias_sigma)
        self._accel_bias = self.further.accel_bias
        biased = self._accel_bias.start == self._accel_bias.stop  # accelerometers, by what no state stands for
        self._floor = np.diag([(imu.accel_bias_sigma / self._g) ** 2 if biased else 0.0] * 2 + [0.0])
        self._H_level = np.zeros((2, n))
        self._H_level[0, PHI + 1], self._H_level[1, PHI] = self._g, -self._g
        H = np.zeros((1, n))
        if field_n is not None:
            H[0, PHI : PHI + 2] = field_n[:2] * field_n[2] / (field_n[0] ** 2 + field_n[1] ** 2)
        H[0, PHI + 2] = -1.0
        self.heading_measurement = H, np.array([config.magnetometer_sigma**2])  # H (1, n) and R (1,) of a heading
        told = config.any_motion
        self._any_motion = (
            None if told is None else AnyMotionLevelling(config, told, self.further, self._g, self._earth_n, H)
        )
        self._last_bad = -math.inf

    @property
    def aligned(self) -> bool:
        """Whether there is an attitude."""
        return self._state is not None and self._state.levelled

    @property
    def listening(self) -> bool:
        """Whether a sample of some kind would still be used."""
        return bool(self._aids)

    @property
    def problem(self) -> str:
        """What the levelling is waiting for, empty once there is an attitude."""
        return "" if self.aligned else "levelling: waiting for unaccelerated flight"

    def start(self, t: float, q_nb: Array) -> None:
        """Begin at a given attitude, known as well as the configuration's sigmas say, instead of levelling."""
        self._state = state = fresh(t + self.config.period_s, STATES + self.further.count)
        state.levelled = True
        state.q_nb = np.array(q_nb, dtype=float)
        state.P = self._initial_covariance()
        state.air_velocity_n = self._air_velocity_n(state, t)
        self.t = t

    def flight_control(self, t: Array, level: Mask) -> None:
        """What was commanded over the intervals that end at ``t`` (N,) [s], on from the last ones: level flight or not.

        Its word is taken for periods to come, which it must hence reach before the increments do; without it, or beyond
        its end, the sensors judge alone.
        """
        times, before = self._commanded
        since = 0.0 if math.isnan(self.t) else self.t - 2 * self.config.period_s
        kept = slice(int(np.searchsorted(times, since)), None)
        self._commanded = (np.concatenate([times[kept], t]), np.concatenate([before[kept], level]))

    def propagate(self, imu: ImuSamples) -> list[UpdateReport]:
        """Advance by a block of increments; a non-finite or impossible one is bridged with the last sound rates.

        The reports are those of the levellings on the way.
        """
        reports: list[UpdateReport] = []
        if len(imu) == 0:
            return reports
        if self._state is None:
            start = float(imu.t[0] - imu.dt[0])
            self._state = fresh(start + self.config.levelling_s, STATES + self.further.count)
            self._state.air_velocity_n = self._air_velocity_n(self._state, start)
        self._last_bad = max(self._last_bad, self._run(self._state, imu, reports))
        self.t = float(imu.t[-1])
        return reports

    def accepts(self, sample: Sample) -> bool:
        """Whether the sample's kind is an aid."""
        return KINDS.get(type(sample)) in self._aids

    def update(self, sample: Sample) -> list[UpdateReport]:
        """Use a sample valid at the filter's own time (ValueError otherwise: `nav.horizon.FusionHorizon` sees to that).

        A magnetometer's sample and one that is unsound leave a report; airspeed and pressure leave none.
        """
        if not self.accepts(sample):
            return []
        trouble = aids.problem(sample)
        if trouble:
            self._last_bad = max(self._last_bad, sample.t if math.isfinite(sample.t) else self.t)
            return [_refused(sample, trouble)]
        if not math.isnan(self.t) and abs(sample.t - self.t) > TIME_TOLERANCE:
            raise ValueError(f"sample at {sample.t} s, but the filter is at {self.t} s")
        match sample:
            case AirspeedSample():
                if sample.eas >= self.config.airspeed_min:
                    self._airspeed.add_eas(sample.t, sample.eas)
                else:
                    self._airspeed.lose()
            case BarometerSample():
                self._airspeed.add_pressure(sample.pressure)
            case MagnetometerSample():
                return self._update_magnetometer(sample)
        return []

    def refuse(self, sample: Sample, reason: str) -> list[UpdateReport]:
        """The report on a sample that is not used."""
        return [_refused(sample, reason)]

    def estimate(self) -> Estimate:
        """The state at the filter's own time."""
        return self._estimate(self._state.present() if self._state is not None else None, self.t, self._last_bad)

    def predict(self, imu: ImuSamples) -> Estimate:
        """The state after further increments, the filter itself staying where it is."""
        state = self._state.copy() if self._state is not None else None
        last_bad = self._last_bad
        if state is not None and len(imu):
            last_bad = max(last_bad, self._run(state, imu, []))
        return self._estimate(state, float(imu.t[-1]) if len(imu) else self.t, last_bad)

    def _run(self, s: State, imu: ImuSamples, reports: list[UpdateReport]) -> float:
        """Propagate a state; the time of the last increment that was not usable, -inf when all were.

        Periods end at times of their own, whatever the blocks.
        """
        last_bad = -math.inf
        start, n = 0, len(imu)
        while start < n:
            end = int(imu.t.searchsorted(s.period_end - COINCIDENT)) + 1
            rows = slice(start, min(end, n))
            bad = propagate(
                s.q_nb, s.gyro_bias, self._earth_n if s.levelled else np.zeros(3), s.rates, s.turned, s.angle, s.force,
                s.elapsed, s.sums, imu.dtheta[rows], imu.dv[rows], imu.dt[rows],
            )  # fmt: skip
            if bad >= 0:
                last_bad = float(imu.t[start + bad])
            start = rows.stop
            if end <= n:
                self._end_period(s, float(imu.t[end - 1]), reports)
        return last_bad

    def _end_period(self, s: State, t: float, reports: list[UpdateReport]) -> None:
        """Level by what the period has shown, and begin the next."""
        if s.levelled:
            self._settle(s)
            if self._any_motion is None:
                self._level(s, t, reports)
            else:
                self._level_in_motion(s, self._any_motion, t, reports)
        else:
            self._find_level(s, t)
        s.angle[:] = 0.0
        s.force[:] = 0.0
        s.sums[:] = 0.0
        s.elapsed[1:] = 0.0
        s.air_velocity_n = self._air_velocity_n(s, t)
        period = self.config.period_s if s.levelled else self.config.levelling_s
        while s.period_end <= t + COINCIDENT:
            s.period_end += period

    def _air_velocity_n(self, s: State, t: float) -> Array:
        speed = self._airspeed.at(t)
        return UNKNOWN if math.isnan(speed) else quat_rotate(s.q_nb, np.array([speed, 0.0, 0.0]))

    def _steady_force(self, s: State, t: float) -> tuple[Array, bool]:
        """Mean specific force over the period, less the acceleration that airspeed tells, and whether it told any."""
        T = float(s.elapsed[1])
        f_n = s.force / T
        acceleration = acceleration_n(s.air_velocity_n, self._air_velocity_n(s, t), T)
        if math.isnan(acceleration[0]):
            return f_n, False
        return f_n - acceleration, True

    def _find_level(self, s: State, t: float) -> None:
        """Roll and pitch from specific force; heading from the magnetic field or from outside.

        Equations 1 to 3 find it by the Earth's rate, which such gyros do not feel.
        """
        config = self.config
        f_0, compensated = self._steady_force(s, t)
        no_field = "magnetometer" in self._aids and not s.field_n.any()
        if self._any_motion is not None:
            rate = math.sqrt(s.angle @ s.angle) / float(s.elapsed[1])
            tilt_variance = self._any_motion.tilt_variance(f_0, rate, compensated)
        else:
            unaccelerated = abs(math.sqrt(f_0 @ f_0) - self._g) <= config.motion.acceleration_limit
            tilt_variance = config.tilt_sigma**2 if unaccelerated else math.nan
        if no_field or math.isnan(tilt_variance):
            s.q_nb = np.array([1.0, 0.0, 0.0, 0.0])
            s.field_n[:] = 0.0
            return
        roll, pitch = math.atan2(-f_0[1], -f_0[2]), math.atan2(f_0[0], math.hypot(f_0[1], f_0[2]))
        heading = config.heading
        if self._field_n is not None and "magnetometer" in self._aids:
            level = quat_rotate(quat_from_euler(roll, pitch, 0.0), s.field_n)
            heading = _azimuth(self._field_n) - _azimuth(level)
        s.levelled = True
        s.q_nb = quat_multiply(quat_from_euler(roll, pitch, heading), s.q_nb)
        s.P = self._initial_covariance()
        if self._any_motion is not None:
            s.P[PHI, PHI] = s.P[PHI + 1, PHI + 1] = tilt_variance
            s.P[PHI + 2, PHI + 2] += float(np.square(self.heading_measurement[0][0, :2]).sum()) * tilt_variance
            s.field_n[:] = 0.0
            s.in_motion.fields = 0
        s.turned[:] = 0.0
        s.elapsed[0] = 0.0

    def _initial_covariance(self) -> Array:
        config = self.config
        sigma = np.repeat([config.tilt_sigma, config.imu.gyro_bias_sigma], 3)
        sigma[PHI + 2] = config.heading_sigma
        return np.diag(np.concatenate([sigma, self.further.sigma]) ** 2)

    def _level(self, s: State, t: float, reports: list[UpdateReport]) -> None:
        """Take horizontal specific force for tilt if the motion allows (equation 7), then correct the attitude."""
        config = self.config
        f_n, compensated = self._steady_force(s, t)
        limits = config.compensated_motion if compensated else config.motion
        omega_b = s.angle / s.elapsed[1] - s.gyro_bias
        motion = limits.judge(f_n, omega_b, self._g, self._level_commanded(t - float(s.elapsed[1]), t))
        s.shown[:] = motion.acceleration, motion.yaw_rate, motion.roll_rate
        if not motion.low:
            s.correction_counter = 0
            return
        s.mode_counter += 1
        H, R = self.level_measurement(s.q_nb, omega_b, compensated)
        reports.append(_fuse(s, H, R, f_n[:2], t, "accelerometer", LEVEL))
        self._feed_back(s)

    def _level_in_motion(self, s: State, how: AnyMotionLevelling, t: float, reports: list[UpdateReport]) -> None:
        """Level by what a period of any motion shows, turn by the field's mean, and correct all that was found."""
        T = float(s.elapsed[1])
        if T == 0.0:
            return
        f_n, compensated = self._steady_force(s, t)
        omega_b = s.angle / T - s.gyro_bias
        how.watch(s, f_n, omega_b, T)
        acceleration = how.acceleration(s, compensated)
        s.shown[:] = acceleration, abs(float(omega_b[2])), abs(float(omega_b[0]))
        s.mode_counter += 1
        H, R = self.level_measurement(s.q_nb, omega_b, compensated, acceleration, T)
        reports.append(_fuse(s, H, R, how.unexplained(s, f_n[:2], T), t, "accelerometer", LEVEL))
        how.move(s, f_n[:2], T)
        if s.in_motion.fields and self._field_n is not None:
            field_n = s.field_n / s.in_motion.fields
            z = math.remainder(_azimuth(field_n) - _azimuth(self._field_n), 2 * math.pi)
            variance = float(self.heading_measurement[1][0]) / s.in_motion.fields
            reports.append(how.turn(s, z, variance, t, field_n, T))
            s.field_n[:] = 0.0
            s.in_motion.fields = 0
        how.rest(s, T)
        how.feed_back(s)
        s.correction_counter += 1

    def level_measurement(
        self, q_nb: Array, omega_b: Array, compensated: bool, acceleration: float = 0.0, T: float = 1.0
    ) -> tuple[Array, Array]:
        """H (2, n) and R (2,) of a levelling at the attitude ``q_nb`` and the rate ``omega_b``, with the acceleration
        taken off or without.

        In any motion also by the horizontal ``acceleration`` expected [m/s^2], rms of an axis, over ``T`` [s].
        """
        variance = self.config.force_sigma**2
        if compensated:
            variance += self.config.airspeed_sigma**2 * float(omega_b @ omega_b)
        H = self._H_level.copy()
        self.further.columns(H, q_nb)
        if self._any_motion is not None:
            return self._any_motion.level_measurement(H, omega_b, compensated, acceleration, T)
        return H, np.full(2, variance)

    def _level_commanded(self, start: float, end: float) -> bool:
        """Whether nothing but level flight was commanded from ``start`` to ``end`` [s], as far as is known."""
        times, level = self._commanded
        first, stop = np.searchsorted(times, (start + COINCIDENT, end + COINCIDENT))
        return bool(level[first:stop].all())

    def _feed_back(self, s: State) -> None:
        """Move estimated errors into attitude and gyro bias, in small steps (equations 10, 11)."""
        config = self.config
        if max(s.P[PHI, PHI], s.P[PHI + 1, PHI + 1]) >= config.correction_sigma**2:
            return
        phi = s.x[PHI : PHI + 3].copy()
        if "magnetometer" not in self._aids:
            phi[2] = 0.0  # nothing sees the heading: what the filter thinks of it, and of its gyro, is a guess
        step = config.correction(phi, config.phi_limit)
        s.q_nb = quat_normalise(quat_multiply(quat_from_rotvec(step), s.q_nb))  # C = (I + [phi x]) C_hat
        s.x[PHI : PHI + 3] -= step
        s.correction_counter += 1
        if config.gyro_bias_feedback:
            seen = slice(BIAS, STATES if "magnetometer" in self._aids else BIAS + 2)
            s.gyro_bias[: seen.stop - BIAS] -= s.x[seen]
            s.x[seen] = 0.0

    def _update_magnetometer(self, sample: MagnetometerSample) -> list[UpdateReport]:
        """Take the direction of the levelled field for heading; while levelling, collect it.

        Azimuth of C_nb_hat m_b less that of the reference m_n: -phi_D + m_D (m_N phi_N + m_E phi_E) / (m_N^2 + m_E^2).
        """
        s, m_n = self._state, self._field_n
        if s is None or m_n is None:
            return []
        levelled = quat_rotate(s.q_nb, sample.field_b)
        if not s.levelled or self._any_motion is not None:
            s.field_n += levelled
            s.in_motion.fields += 1
            s.in_motion.sensor = sample.sensor
            return []
        self._settle(s)
        z = math.remainder(_azimuth(levelled) - _azimuth(m_n), 2 * math.pi)
        return [_fuse(s, *self.heading_measurement, np.array([z]), sample.t, sample.sensor, MAGNETIC_HEADING)]

    def _settle(self, s: State) -> None:
        """Bring error states and covariance up to the time of the attitude."""
        if s.elapsed[0] > 0:
            T, period, _ = s.elapsed.tolist()
            whole, half_noise = self._stays.copy(), 0.5 * T * self._variance_rate
            whole[PHI : PHI + 3, :STATES] = transition(s.turned, self._earth_n, T)
            self.further.step(whole, half_noise, T)
            self.further.turn(whole, s.turned, float(s.angle[2]) / period)
            if self._any_motion is not None:
                half_noise[PHI : PHI + 3] += self._any_motion.half_noise(s)
            covariance_step(s, whole, half_noise)

    def _estimate(self, s: State | None, t: float, last_bad: float) -> Estimate:
        """The estimate at ``t`` from a state of its own.

        The attitude is what it is before the corrections still outstanding, so they are part of its error; so is the
        tilt of accelerometers that are biased, which no state stands for.
        """
        bad = t - last_bad <= BAD_SAMPLE_S
        if s is None or not s.levelled:
            return Estimate(
                t, math.nan, math.nan, math.nan, UNKNOWN, NO_ATTITUDE, UNKNOWN, UNKNOWN, NO_COVARIANCE, UNKNOWN,
                UNKNOWN, Status.ALIGNING | Status.BAD_SAMPLE if bad else Status.ALIGNING,
            )  # fmt: skip
        self._settle(s)
        phi = s.x[PHI : PHI + 3]
        covariance = NO_COVARIANCE.copy()
        covariance[6:, 6:] = s.P[PHI : PHI + 3, PHI : PHI + 3] + phi[:, None] * phi + self._floor
        zero, sigma = np.zeros(1), np.sqrt(s.P.diagonal())
        judged = zip(JUDGED, s.shown[:, None], strict=True)
        accel_bias, sigma_accel_bias = np.zeros(3), self._sigma_accel_bias
        if self._accel_bias.start < self._accel_bias.stop:
            accel_bias, sigma_accel_bias = -s.x[self._accel_bias], sigma[self._accel_bias]
        return Estimate(
            t=t,
            lat=math.nan,
            lon=math.nan,
            h=math.nan,
            v_n=UNKNOWN,
            q_nb=s.q_nb,
            gyro_bias=s.gyro_bias - s.x[BIAS:STATES],
            accel_bias=accel_bias,
            covariance=covariance,
            sigma_gyro_bias=sigma[BIAS:STATES],
            sigma_accel_bias=sigma_accel_bias,
            status=KNOWN | Status.BAD_SAMPLE if bad else KNOWN,
            extra={
                "mode_counter": (np.array([float(s.mode_counter)]), zero),
                "correction_counter": (np.array([float(s.correction_counter)]), zero),
                **{name: (value, zero) for name, value in judged},
            },
        )


def _fuse(s: State, H: Array, R: Array, z: Array, t: float, sensor: str, aid: str) -> UpdateReport:
    """Update the error states with ``z`` = H x + noise."""
    nu = z - H @ s.x
    S, nis = update(s.x, s.P, H, R, nu, math.inf)
    return UpdateReport(t, sensor, aid, nu, S, nis, math.inf, 1.0, Outcome.FUSED)


def _refused(sample: Sample, reason: str) -> UpdateReport:
    aid = MAGNETIC_HEADING if isinstance(sample, MagnetometerSample) else KINDS[type(sample)]
    return UpdateReport(
        sample.t, sample.sensor, aid, np.empty(0), np.empty((0, 0)), math.nan, math.nan, 0.0, Outcome.UNSOUND, reason
    )


def _azimuth(x_n: Array) -> float:
    return math.atan2(x_n[1], x_n[0])
