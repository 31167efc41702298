"""The attitude filter: levelling period by period, heading from a magnetometer; see `nav.ahrs`."""

from __future__ import annotations

import math

import numpy as np

from nav import aids
from nav.ahrs import steps as kernels
from nav.ahrs.any_motion import AnyMotionLevelling
from nav.ahrs.config import KINDS, LEVEL, MAGNETIC_HEADING, AhrsConfig, limited
from nav.ahrs.further import RIGHT, FurtherStates
from nav.ahrs.plan import planned
from nav.ahrs.reports import fuse, refused
from nav.ahrs.state import (
    BIAS,
    CORRECTIONS,
    FIXED,
    LEVELLINGS,
    MISSING,
    PERIOD_END,
    PHI,
    STATES,
    TURN_RATE,
    State,
    fresh,
    propagate,
)
from nav.columns import Estimated, Estimates, FusedReports, Reported
from nav.detection import Mask
from nav.earth import earth_rate_n, gravity
from nav.increments import COINCIDENT, ESTIMATE, WHAT, Increments, Steps
from nav.motion import TrueAirspeed
from nav.rotation import quat_from_euler, quat_multiply, quat_rotate
from nav.samples import (
    AirspeedSample,
    Array,
    BarometerSample,
    Estimate,
    ImuSamples,
    MagnetometerSample,
    Sample,
    Status,
    UpdateReport,
)

COUNTED = "mode_counter", "correction_counter"  # periods of low dynamics, and corrections
JUDGED = "judged_acceleration", "judged_yaw_rate", "judged_roll_rate"  # what the last period was judged by
BAD_SAMPLE_S = 1.0  # for how long a refused sample is told of (`Status.BAD_SAMPLE`)
AVERAGING = 0.02  # rate of a turn in which what iron does to the heading averages out [rad/s]
TIME_TOLERANCE = 1e-4  # between a sample and the filter [s]
KNOWN = Status.ALIGNED | Status.DEAD_RECKONING | Status.ATTITUDE_ONLY


class Ahrs:
    """Attitude filter behind the estimator protocol of `nav.horizon`; position and velocity are NaN throughout.

    ``field_n`` (3,) [T] is the reference magnetic field, NED; without it the magnetometer is not used. The filter
    levels itself from the first increments, or `start` sets it at a known attitude. An autopilot that knows better than
    the sensors that the body manoeuvres says so by `flight_control`.
    """

    def __init__(self, config: AhrsConfig, field_n: Array | None = None) -> None:
        self.config = config
        self._busy = np.empty(0)  # times up to which something else than level flight was commanded
        self.t = math.nan
        self._state: State | None = None
        self._airspeed = TrueAirspeed(config.h, config.airspeed_smoothing_s)
        self._aids = tuple(kind for kind in config.aids if kind != "magnetometer" or field_n is not None)
        self._field_n = field_n
        self._g = float(gravity(config.lat, config.h))
        self._earth_n = earth_rate_n(config.lat)
        imu = config.imu
        self.further = FurtherStates(config)
        self._n = STATES + self.further.count
        self._sees_heading = field_n is not None and "magnetometer" in config.aids
        self._model = kernels.model(config, self.further, self._g, field_n, self._sees_heading)
        self._sigma_accel_bias = np.full(3, imu.accel_bias_sigma)
        self._accel_bias = self.further.accel_bias
        biased = self._accel_bias.start == self._accel_bias.stop  # accelerometers, by what no state stands for
        rows = self._model.rows
        # the heading of a levelled field is off with the tilt that levels it
        off = np.vstack([np.eye(2), rows[kernels.HEADING_ROW, PHI : PHI + 2] * self._sees_heading])
        self._floor = (imu.accel_bias_sigma / self._g) ** 2 * off @ off.T if biased else np.zeros((3, 3))
        self._H_level = rows[kernels.LEVEL_ROW : kernels.LEVEL_ROW + 2]
        H = rows[kernels.HEADING_ROW, None]
        self.heading_measurement = H, np.array([config.magnetometer_sigma**2])  # H (1, n) and R (1,) of a heading
        told = config.any_motion
        self._any_motion = (
            None if told is None else AnyMotionLevelling(config, told, self.further, self._g, self._earth_n, H)
        )
        self._last_bad = -math.inf
        self._usual = (
            told is None and config.correction is limited
        )  # levels in low dynamics, and corrects by equation 10
        # sensor, name and axes of what a report is on; and of which kind those of each magnetometer are
        self._kinds = [("accelerometer", LEVEL, 2)]
        self._kind_of: dict[str, int] = {}
        self._report = np.empty((1, kernels.REPORT))

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
        if self.aligned:
            return ""
        return "levelling" if self._any_motion is not None else "levelling: waiting for unaccelerated flight"

    def start(self, t: float, q_nb: Array) -> None:
        """Begin at a given attitude, known as well as the configuration's sigmas say, instead of levelling."""
        self._state = state = fresh(t + self.config.period_s, self._n)
        state.levelled = True
        state.q_nb[:] = q_nb
        state.P[:] = self._initial_covariance()
        state.air_velocity_n[:] = kernels.air_velocity(state.q_nb, self._airspeed.numbers, t)
        self.t = t

    def flight_control(self, t: Array, level: Mask) -> None:
        """What was commanded over the intervals that end at ``t`` (N,) [s], on from the last ones: level flight or not.

        Its word is taken for periods to come, which it must hence reach before the increments do; without it, or beyond
        its end, the sensors judge alone.
        """
        since = 0.0 if math.isnan(self.t) else self.t - 2 * self.config.period_s
        self._busy = np.concatenate([self._busy[self._busy >= since], t[~np.asarray(level)]])

    def propagate(self, imu: ImuSamples) -> list[UpdateReport]:
        """Advance by a block of increments; a non-finite or impossible one is bridged with the last sound rates.

        The reports are those of the levellings on the way.
        """
        reports: list[UpdateReport] = []
        if len(imu) == 0:
            return reports
        if self._state is None:
            start = float(imu.t[0] - imu.dt[0])
            self._state = state = fresh(start + self.config.levelling_s, self._n)
            state.air_velocity_n[:] = kernels.air_velocity(state.q_nb, self._airspeed.numbers, start)
        self._last_bad = max(self._last_bad, self._run(self._state, imu, reports))
        self.t = float(imu.t[-1])
        return reports

    @property
    def in_steps(self) -> bool:
        """Whether it takes many steps at once: it has an attitude, and levels as usual."""
        return self.aligned and self._usual

    def take(self, steps: Steps, ahead: Increments, reports: Reported, estimates: Estimated) -> int:
        """Take the next of ``steps``, as far as they are plain: see `nav.horizon.TakesSteps`."""
        s, imu, plan = self._state, ahead.imu, self._plan(steps)
        if s is None or not s.levelled or not len(plan):
            return 0
        periods = self._periods(float(imu.t[-1]) + ahead.longest - ahead.t)  # what is predicted counts
        told = np.empty((len(plan) + periods, kernels.REPORT))
        asked = np.count_nonzero(plan[:, WHAT] == ESTIMATE)
        wholes, when = np.empty((asked, len(s.whole))), np.empty((asked, 2))
        taken, ahead.next, ahead.t, self._last_bad, written, drafted = kernels.follow(
            s.whole, s.n, *self._model, self._airspeed.numbers, self._busy, imu.t, imu.dt, imu.dtheta, imu.dv,
            ahead.next, ahead.t, ahead.longest, self._last_bad, plan, told, wholes, when,
        )  # fmt: skip
        self.t = ahead.t
        self._begin_anew_if_lost(s, ahead.t)
        if written:
            reports.append(self._reports(told[:written]))
        if drafted:
            estimates.append(self._described(wholes[:drafted], *when[:drafted].T.copy()))
        return taken

    def _plan(self, steps: Steps) -> Array:
        """The next of the ``steps`` that look plain, as rows for `nav.ahrs.steps.follow`."""
        if steps.plan is None:
            steps.plan = planned(steps, self._kind, self.config.airspeed_min)
        rows, plain = steps.plan
        left: Array = rows[steps.next :]
        others = ~plain[steps.next :]
        return left[: int(others.argmax())] if others.any() else left

    def _kind(self, sensor: str) -> int:
        """The place of a magnetometer's reports among the kinds."""
        if sensor not in self._kind_of:
            self._kind_of[sensor] = len(self._kinds)
            self._kinds.append((sensor, MAGNETIC_HEADING, 1))
        return self._kind_of[sensor]

    def _reports(self, rows: Array) -> FusedReports:
        """The reports that kernels wrote."""
        kind, t, nis = rows[:, 0].astype(np.int64), rows[:, 1], rows[:, 2]
        return FusedReports(self._kinds, kind, t, rows[:, 3:6], rows[:, 6:], nis, np.full(len(rows), math.inf))

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
            return [refused(sample, trouble)]
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
        return [refused(sample, reason)]

    def estimate(self) -> Estimate:
        """The state at the filter's own time."""
        return self._estimate(self._state, self.t, self._last_bad)

    def predict(self, imu: ImuSamples) -> Estimate:
        """The state after further increments, the filter itself staying where it is."""
        state = self._state.copy() if self._state is not None else None
        last_bad = self._last_bad
        if state is not None and len(imu):
            last_bad = max(last_bad, self._run(state, imu, [], ahead=True))
        return self._estimate(state, float(imu.t[-1]) if len(imu) else self.t, last_bad)

    def _run(self, s: State, imu: ImuSamples, reports: list[UpdateReport], ahead: bool = False) -> float:
        """Propagate a state; the time of the last increment that was not usable, -inf when all were.

        Periods end at times of their own, whatever the blocks. Of one that is ``ahead`` no level is begun anew.
        """
        last_bad = -math.inf
        start, n = 0, len(imu)
        while start < n:
            if s.levelled and self._usual:
                bad, taken = self._advance(s, imu, start, not ahead, reports)
                last_bad, start = max(last_bad, bad), start + taken
                if not ahead:
                    self._begin_anew_if_lost(s, float(imu.t[start - 1]))
                continue
            end = int(imu.t.searchsorted(s.counts[PERIOD_END] - COINCIDENT)) + 1
            rows = slice(start, min(end, n))
            bad = propagate(
                s.q_nb, s.gyro_bias, self._earth_n if s.levelled else np.zeros(3), s.rates, s.turned, s.angle, s.force,
                s.elapsed, s.sums, s.P, imu.dtheta[rows], imu.dv[rows], imu.dt[rows],
            )  # fmt: skip
            if bad >= 0:
                last_bad = float(imu.t[start + bad])
            start = rows.stop
            if end <= n:
                self._end_period(s, float(imu.t[end - 1]), reports)
        return last_bad

    def _begin_anew_if_lost(self, s: State, t: float) -> None:
        """Find the level anew where a filter that levels as usual is at the end of a period with its tilt lost."""
        if t >= s.counts[PERIOD_END] - COINCIDENT and kernels.lost(s.P):
            self._begin_levelling(s)
            self._begin_period(s, t)

    def _advance(
        self, s: State, imu: ImuSamples, start: int, stops: bool, reports: list[UpdateReport]
    ) -> tuple[float, int]:
        """`kernels.advance` by the increments from ``start`` on: when one was bad last, and how many were taken."""
        rows = np.empty((self._periods(float(imu.t[-1] - imu.t[start])), kernels.REPORT))
        bad, written, taken = kernels.advance(
            s.whole, s.n, *self._model, self._airspeed.numbers, self._busy, imu.t[start:], imu.dtheta[start:],
            imu.dv[start:], imu.dt[start:], -math.inf, stops, rows,
        )  # fmt: skip
        reports += self._reports(rows[:written])[:]
        return bad, taken

    def _periods(self, T: float) -> int:
        """How many may end within ``T`` [s], at most."""
        return 3 + int(T / self.config.period_s)

    def _end_period(self, s: State, t: float, reports: list[UpdateReport]) -> None:
        """Level by what the period has shown, and begin the next."""
        if s.levelled:
            self._settle(s)
            if self._any_motion is None:
                self._level(s, t, reports)
            elif not kernels.shows_nothing(s.elapsed):
                self._level_in_motion(s, self._any_motion, t, reports)
            elif self._any_motion.lost(s):
                self._begin_levelling(s)
            else:
                self._any_motion.bridge(s)
        elif s.elapsed[MISSING] > 0.0:
            self._begin_levelling(s)
        else:
            self._find_level(s, t)
        self._begin_period(s, t)

    def _begin_period(self, s: State, t: float) -> None:
        period = self.config.period_s if s.levelled else self.config.levelling_s
        kernels.begin_period(
            s.q_nb, s.air_velocity_n, s.counts, s.angle, s.force, s.elapsed, s.sums, self._airspeed.numbers, t, period
        )

    def _steady_force(self, s: State, t: float) -> tuple[Array, bool]:
        """Mean specific force over the period, less the acceleration that airspeed tells, and whether it told any."""
        air = self._airspeed.numbers
        return kernels.steady_force(s.q_nb, s.force, s.air_velocity_n, air, t, float(s.elapsed[1]))

    def _find_level(self, s: State, t: float) -> None:
        """Roll and pitch from specific force; heading from the magnetic field or from outside.

        Equations 1 to 3 find it by the Earth's rate, which such gyros do not feel.
        """
        config = self.config
        f_0, compensated = self._steady_force(s, t)
        no_field = "magnetometer" in self._aids and not s.field_n.any()
        if self._any_motion is not None:
            tilt_variance = self._any_motion.tilt_variance(f_0)
        else:
            unaccelerated = abs(math.sqrt(f_0 @ f_0) - self._g) <= config.motion.acceleration_limit
            tilt_variance = config.tilt_sigma**2 if unaccelerated else math.nan
        if no_field or math.isnan(tilt_variance):
            self._begin_levelling(s)
            return
        roll, pitch = math.atan2(-f_0[1], -f_0[2]), math.atan2(f_0[0], math.hypot(f_0[1], f_0[2]))
        heading = config.heading
        if self._field_n is not None and self._sees_heading:
            level = quat_rotate(quat_from_euler(roll, pitch, 0.0), s.field_n)
            heading = _azimuth(self._field_n) - _azimuth(level)
        s.levelled = True
        s.q_nb[:] = quat_multiply(quat_from_euler(roll, pitch, heading), s.q_nb)
        s.P[:], s.x[:] = self._initial_covariance(), 0.0
        if self._any_motion is not None:
            s.P[PHI, PHI] = s.P[PHI + 1, PHI + 1] = tilt_variance
            self._any_motion.begin(s, f_0, s.angle / float(s.elapsed[1]), compensated)
            s.P[PHI + 2, PHI + 2] += float(np.square(self.heading_measurement[0][0, :2]).sum() * s.P[PHI, PHI])
            s.field_n[:] = 0.0
            s.in_motion.fields = 0
        s.turned[:] = 0.0
        s.elapsed[0] = 0.0

    def _begin_levelling(self, s: State) -> None:
        """Let n be the body axes now, and collect anew."""
        s.levelled = False
        s.q_nb[:] = 1.0, 0.0, 0.0, 0.0
        s.field_n[:] = 0.0

    def _initial_covariance(self) -> Array:
        config = self.config
        sigma = np.repeat([config.tilt_sigma, config.imu.gyro_bias_sigma], 3)
        sigma[PHI + 2] = config.heading_sigma
        return np.diag(np.concatenate([sigma, self.further.sigma]) ** 2)

    def _level(self, s: State, t: float, reports: list[UpdateReport]) -> None:
        """Take horizontal specific force for tilt if the motion allows (equation 7), then correct the attitude."""
        commanded = not kernels.is_busy(self._busy, t - float(s.elapsed[1]), t)
        report = self._report[0]
        low = kernels.level(
            s.q_nb, s.gyro_bias, s.air_velocity_n, s.shown, s.counts, s.angle, s.force, s.elapsed, s.x, s.P,
            *self._model, self._airspeed.numbers, commanded, t, report,
        )  # fmt: skip
        if low:
            reports += self._reports(self._report.copy())[:]
            due, phi = kernels.outstanding(s.x, s.P, self._model.told, self._model.places)
            if due:
                step = self.config.correction(phi, self.config.phi_limit)
                kernels.correct(s.q_nb, s.gyro_bias, s.counts, s.x, step, self._model.places)

    def _level_in_motion(self, s: State, how: AnyMotionLevelling, t: float, reports: list[UpdateReport]) -> None:
        """Level by what a period of any motion shows, turn by the field's mean, and correct all that was found."""
        T = float(s.elapsed[1])
        if T == 0.0:
            return
        f_n, compensated = self._steady_force(s, t)
        omega_b = s.angle / T - s.gyro_bias
        how.watch_turn(s, f_n, omega_b, T)
        turn_rate = how.turn_rate(s, compensated)
        level_n = f_n[:2] - turn_rate * (RIGHT @ s.in_motion.turning_n)
        how.watch(s, level_n, T)
        acceleration = how.acceleration(s, compensated)
        s.shown[:] = acceleration, abs(float(omega_b[2])), abs(float(omega_b[0]))
        s.counts[LEVELLINGS] += 1
        H, R = self.level_measurement(s.q_nb, omega_b, compensated, acceleration, turn_rate, T)
        reports.append(fuse(s, H, R, how.unexplained(s, level_n, T), t, "accelerometer", LEVEL))
        how.move(s, level_n, turn_rate, T)
        if s.in_motion.fields and self._field_n is not None:
            field_n = s.field_n / s.in_motion.fields
            z = math.remainder(_azimuth(field_n) - _azimuth(self._field_n), 2 * math.pi)
            variance = float(self.heading_measurement[1][0]) / s.in_motion.fields
            reports.append(how.turn(s, z, variance, t, field_n, T))
            s.field_n[:] = 0.0
            s.in_motion.fields = 0
        how.rest(s, T)
        how.feed_back(s)
        s.counts[CORRECTIONS] += 1

    def level_measurement(
        self,
        q_nb: Array,
        omega_b: Array,
        compensated: bool,
        acceleration: float = 0.0,
        turn_rate: float = 0.0,
        T: float = 1.0,
    ) -> tuple[Array, Array]:
        """H (2, n) and R (2,) of a levelling at the attitude ``q_nb`` and the rate ``omega_b``, with the acceleration
        taken off or without.

        In any motion also by the horizontal ``acceleration`` expected [m/s^2], rms of an axis, and by the rate of a
        turn about the vertical [rad/s], over ``T`` [s].
        """
        H, R = kernels.level_measurement(q_nb, omega_b, compensated, *self._model)
        if self._any_motion is not None:
            return self._any_motion.level_measurement(H, omega_b, compensated, acceleration, turn_rate, T)
        return H, R

    def _update_magnetometer(self, sample: MagnetometerSample) -> list[UpdateReport]:
        """Take the direction of the levelled field for heading; while levelling, collect it."""
        s = self._state
        if s is None:
            return []
        if s.levelled and self._any_motion is None:
            kind = self._kind(sample.sensor)
            kernels.turn(s.whole, s.n, *self._model, sample.field_b, self._report[0], kind, sample.t)
            return self._reports(self._report.copy())[:]
        s.field_n += quat_rotate(s.q_nb, sample.field_b)
        s.in_motion.fields += 1
        s.in_motion.sensor = sample.sensor
        return []

    def _settle(self, s: State) -> None:
        """Bring error states and covariance up to the time of the attitude."""
        turning = self._any_motion.half_noise(s) if self._any_motion is not None else 0.0
        kernels.settle(s.x, s.P, s.turned, s.angle, s.elapsed, *self._model, turning)

    def _estimate(self, s: State | None, t: float, last_bad: float) -> Estimate:
        """The estimate at ``t`` from a state, which stays as it is."""
        if s is None or not s.levelled:
            status = Status.ALIGNING | Status.BAD_SAMPLE if t - last_bad <= BAD_SAMPLE_S else Status.ALIGNING
            return Estimate.of(t, status=status)
        settled = s.copy()
        self._settle(settled)
        return self._described(settled.whole[None], np.array([t]), np.array([last_bad]))[0]

    def _described(self, wholes: Array, t: Array, last_bad: Array) -> Estimates:
        """The estimates at ``t`` (N,) of settled states, each the whole of one of ``wholes``.

        The attitude is what it is before the corrections still outstanding, so they are part of its error; so is the
        tilt of accelerometers that are biased, and the pull of iron on a course that stays, which no state stands for.
        """
        N, n, zero = len(t), self._n, np.zeros((len(t), 1))
        q_nb, gyro_bias, shown, counts = wholes[:, :4], wholes[:, 4:7], wholes[:, 13:16], wholes[:, 16:19]
        x, P = wholes[:, FIXED : FIXED + n], wholes[:, FIXED + n :].reshape(N, n, n)
        phi = x[:, PHI : PHI + 3]
        covariance = np.full((N, 9, 9), np.nan)
        covariance[:, 6:, 6:] = P[:, PHI : PHI + 3, PHI : PHI + 3] + phi[:, :, None] * phi[:, None] + self._floor
        turned = np.square(wholes[:, 40:46][:, TURN_RATE] / AVERAGING)
        covariance[:, 8, 8] = np.maximum(covariance[:, 8, 8], self.config.iron_sigma**2 * np.exp(-turned))
        sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
        accel_bias, sigma_accel_bias = np.zeros((N, 3)), np.tile(self._sigma_accel_bias, (N, 1))
        if self._accel_bias.start < self._accel_bias.stop:
            accel_bias, sigma_accel_bias = -x[:, self._accel_bias], sigma[:, self._accel_bias]
        unknown, nowhere, bad = np.full((N, 3), np.nan), np.full(N, np.nan), t - last_bad <= BAD_SAMPLE_S
        values = counts[:, LEVELLINGS, None], counts[:, CORRECTIONS, None], *np.split(shown, 3, axis=1)
        return Estimates(
            t, nowhere, nowhere, nowhere, unknown, q_nb.copy(), gyro_bias - x[:, BIAS:STATES], accel_bias, covariance,
            sigma[:, BIAS:STATES], sigma_accel_bias, np.where(bad, KNOWN | Status.BAD_SAMPLE, KNOWN),
            {name: (value.copy(), zero) for name, value in zip((*COUNTED, *JUDGED), values, strict=True)},
        )  # fmt: skip


def _azimuth(x_n: Array) -> float:
    return math.atan2(x_n[1], x_n[0])
