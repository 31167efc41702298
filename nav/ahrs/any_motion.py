"""Levelling whatever the body does: what it gains in velocity averages out, tilt does not.

`nav.motion.LowDynamics` waits for a second without acceleration, which a hand, a rotor or a manoeuvring wing may not
grant for minutes. Here every period counts. Its horizontal specific force, integrated along the gyros' attitude, is the
change of velocity and what tilt makes of gravity,

    integral of f = v(t + T) - v(t) + g [phi_E, -phi_N] T

where what airspeed tells of v is taken off first (`nav.motion.acceleration_n`). The rest of v is a Gauss-Markov process
of correlation time tau, driven by accelerations of the spectral density S, so that with r = exp(-T / tau)

    v(t + T) - r v(t) = noise of variance S tau (1 - r^2) / 2

An estimate of v, driven by f, is an error state: delta v' = g [phi_E, -phi_N]. S follows the variance of the smoothed
specific force in the last seconds, about its mean, so that a tilt does not make itself believed an acceleration.

In a lasting turn that is not enough: its acceleration has one size and turns with the body, as what biased gyros make
of the horizon does. Where airspeed does not tell it, it is that of a velocity c which turns with the body, of unknown
size,

    c' = psi' (down x c) - c / tau_c + noise,    acceleration psi' (down x c)

with psi' the mean rate about the vertical of the last seconds, as far as it is a turn and no swing. What is wrong in an
estimate of c are error states too: a turn that is begun with a horizon well known tells c, and c then levels in the
turn.

The magnetic field turns the heading alone; it is used while its size and dip are those of the last minutes. At rest the
gyros show their biases. All that is found is corrected at once.

The idea that accelerations average out along an attitude by gyros is that of Laidig and Seel 2023, VQF: highly accurate
IMU orientation estimation with bias estimation and magnetic disturbance rejection; here as error states.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from nav.ahrs.config import MAGNETIC_HEADING, AhrsConfig, AnyMotion
from nav.ahrs.further import RIGHT, FurtherStates
from nav.ahrs.state import BIAS, PHI, STATES, State
from nav.kalman import update
from nav.realignment import LOST_TILT
from nav.rotation import dcm_from_quat, quat_from_rotvec, quat_multiply, quat_normalise
from nav.samples import Array, Outcome, UpdateReport

REST_GATE = 16.3  # chi-square of three, 99.9 %
MOST_TILT = math.radians(60)  # claimed of a first levelling
STEEPEST = 0.05  # a field with less of it level points nowhere
FORCE = 0.5, 2.0  # in g: a body that feels less or more than this is not levelled at first


class AnyMotionLevelling:
    """The steps at the end of a period, on a state whose error states are all zero between them.

    ``g`` [m/s^2] is gravity, ``earth_n`` (3,) [rad/s] the Earth's rate; ``H_heading`` (1, n) sees the heading.
    """

    def __init__(
        self, config: AhrsConfig, told: AnyMotion, further: FurtherStates, g: float, earth_n: Array, H_heading: Array
    ) -> None:
        self.config, self.told = config, told
        self._further, self._velocity = further, further.velocity
        self._g, self._earth_n = g, earth_n
        self._H_heading = H_heading
        # Density over variance: twice that of white noise, smoothed.
        self._lasting_s = 4 * told.acceleration_smoothing_s

    def tilt_variance(self, f_n: Array) -> float:
        """Of a first levelling by a mean specific force (3,), beside a turn's; NaN when it shows none."""
        force = math.sqrt(f_n @ f_n) / self._g
        if not FORCE[0] <= force <= FORCE[1]:
            return math.nan
        return min(math.hypot(self.config.tilt_sigma, force - 1), MOST_TILT) ** 2

    def begin(self, s: State, f_0: Array, omega_b: Array, compensated: bool) -> None:
        """Begin with an attitude that a mean specific force (3,) [m/s^2] has levelled at a mean rate (3,) [rad/s].

        Its covariance is that without a turn. What a turn accelerates was taken for tilt: phi_N = -(psi' / g) c_N, and
        phi_E the same of c_E; how much of the rate is a turn's and no swing's, so short a time does not tell.
        """
        m, level, own, speed = s.in_motion, slice(PHI, PHI + 2), self._further.turning, self.told.turning_speed
        m.turn_rate = m.steady_rate = float(dcm_from_quat(s.q_nb)[2] @ omega_b)
        m.swing, m.swing_square = 0.0, max(0.0, float(omega_b @ omega_b) - m.steady_rate**2)
        m.excess = float(f_0 @ f_0) - self._g**2
        m.turning_n[:] = 0.0
        tilt = max(-MOST_TILT, min(self.turn_rate(s, compensated) * speed / self._g, MOST_TILT))
        if not compensated:
            s.P[level, level] += min(abs(m.turn_rate) * speed / self._g, MOST_TILT) ** 2 * np.eye(2)
        s.P[level, own] = s.P[own, level] = -tilt * speed * np.eye(2)

    def lost(self, s: State) -> bool:
        """Whether the tilt is, so that it must be found anew."""
        return bool(max(s.P[PHI, PHI], s.P[PHI + 1, PHI + 1]) > LOST_TILT**2)

    def half_noise(self, s: State) -> float:
        """Half of the variance that the turns of a period bring to each axis of the attitude."""
        share = max(self.told.gyro_share, self.config.imu.gyro_motion)
        return 0.5 * share**2 * float(s.sums[1].sum())

    def level_measurement(
        self, H: Array, omega_b: Array, compensated: bool, acceleration: float, turn_rate: float, T: float
    ) -> tuple[Array, Array]:
        """``H`` (2, n) with the velocities' columns and R (2,) of the mean horizontal specific force over ``T`` [s].

        ``acceleration`` [m/s^2] is what is expected of it, and ``turn_rate`` [rad/s] as the methods of that name say.
        """
        told, tau = self.told, self.told.velocity_correlation_s
        kept = math.exp(-T / tau)
        density = told.least_acceleration_density + self._lasting_s * acceleration**2
        variance = 0.5 * density * tau * (1 - kept**2) + self.config.imu.accel_noise**2 * T
        if compensated:
            variance += self.config.airspeed_sigma**2 * float(omega_b @ omega_b) * told.airspeed_error_s * T
        H[:, self._velocity] += np.eye(2) * ((1 - kept) / T)
        H[:, self._further.turning] = -turn_rate * RIGHT
        return H, np.full(2, variance / T**2)

    def watch_turn(self, s: State, f_n: Array, omega_b: Array, T: float) -> None:
        """Follow the rate ``omega_b`` (3,) [rad/s], and the size of the specific force ``f_n`` (3,) [m/s^2]."""
        m, memory = s.in_motion, -math.expm1(-T / self.told.turn_memory_s)
        rate = float(dcm_from_quat(s.q_nb)[2] @ omega_b)
        m.turn_rate += memory * (rate - m.turn_rate)
        m.swing = rate - m.turn_rate
        m.steady_rate -= math.expm1(-T / self.told.turn_smoothing_s) * (rate - m.steady_rate)
        m.swing_square += memory * (max(0.0, float(omega_b @ omega_b) - m.steady_rate**2) - m.swing_square)
        m.excess += memory * (float(f_n @ f_n) - self._g**2 - m.excess)

    def turn_share(self, s: State, compensated: bool) -> float:
        """How far the body turns, and does not swing as a hand does, from 0 to 1; 0 where airspeed tells of it.

        By the share of the square of its mean rate about the vertical in the mean square of its rate about any axis.
        """
        m, (none, full) = s.in_motion, self.told.turn_shares
        square = m.steady_rate**2
        if compensated or not square > 0.0:
            return 0.0
        return max(0.0, min((square / (square + m.swing_square) - none) / (full - none), 1.0))

    def turn_rate(self, s: State, compensated: bool) -> float:
        """At which a velocity turns with the body [rad/s], as far as what it accelerates shows."""
        rate = s.in_motion.turn_rate * self.turn_share(s, compensated)
        usual = (self.told.turning_speed * rate) ** 2
        return rate * math.sqrt(self._shows(s) / usual) if usual > self._shows(s) else rate

    def _shows(self, s: State) -> float:
        """Square of the horizontal acceleration that the size of the specific force leaves room for [m^2/s^4].

        Whatever the attitude |f|^2 = g^2 + a^2, of which a bias b of the accelerometers may hide 2 g b.
        """
        return max(0.0, s.in_motion.excess) + 2 * self._g * self.config.imu.accel_bias_sigma

    def watch(self, s: State, f_n: Array, T: float) -> None:
        """Follow the horizontal specific force ``f_n`` (2,) [m/s^2], less what a turn explains."""
        m, told = s.in_motion, self.told
        smoothing, memory = (
            -math.expm1(-T / time) for time in (told.acceleration_smoothing_s, told.acceleration_memory_s)
        )
        m.force_n += smoothing * (f_n - m.force_n)
        m.mean_force_n += memory * (m.force_n - m.mean_force_n)
        beside = m.force_n - m.mean_force_n
        m.force_variance += memory * (0.5 * float(beside @ beside) - m.force_variance)

    def acceleration(self, s: State, compensated: bool) -> float:
        """What to expect of horizontal acceleration, rms of an axis [m/s^2]: what varies, and unless airspeed tells it
        what a turn makes where its rate is not the mean one, as at its beginning.

        At the speed v such a difference w accelerates by a = v w, for as long as the mean is taken over (tau): a
        density of 2 a^2 tau, believed in as the turn is. It is no more than shows in the size of the specific force,
        whatever the attitude: |f|^2 = g^2 + a^2, of which a bias b of the accelerometers may hide 2 g b.
        """
        m = s.in_motion
        speed_square = max(self.told.turning_speed**2, float(m.turning_n @ m.turning_n))
        square = min(speed_square * m.swing**2, self._shows(s))
        hidden = 2 * square * self.told.turn_memory_s * self.turn_share(s, compensated) ** 2
        return math.sqrt(m.force_variance + hidden / self._lasting_s)

    def unexplained(self, s: State, f_n: Array, T: float) -> Array:
        """What of the mean horizontal specific force (2,) the decay of the velocity does not explain."""
        left: Array = f_n + s.in_motion.velocity_n * (-math.expm1(-T / self.told.velocity_correlation_s) / T)
        return left

    def move(self, s: State, f_n: Array, turn_rate: float, T: float) -> None:
        """Take velocities and their error states over a period with the mean horizontal specific force (2,)."""
        m, own = s.in_motion, self._further.turning
        m.velocity_n += f_n * T
        turn = _turn((m.turn_rate + m.swing) * T)
        m.turning_n = turn @ m.turning_n * math.exp(-T / self.told.turning_speed_s)
        gain = np.zeros_like(s.P)
        self._further.drive(gain, turn_rate)
        whole = np.eye(len(s.x)) + T * gain
        whole[own, own] = turn
        s.x[:] = whole @ s.x
        s.P[:] = whole @ s.P @ whole.T

    def bridge(self, s: State) -> None:
        """Turn the velocity that turns with the body over a period that is missing, as its attitude was."""
        turned = float(dcm_from_quat(s.q_nb)[2] @ (s.angle - s.gyro_bias * float(s.elapsed[1])))
        s.in_motion.turning_n = _turn(turned) @ s.in_motion.turning_n
        _turn_blocks(s, turned, self._further.turning)

    def _undisturbed(self, s: State, seen: Array, T: float) -> bool:
        """Whether a field (2,), level and down, is the usual one, which follows it slowly then; or has come to be."""
        m, told = s.in_motion, self.told
        if not seen[0] > STEEPEST * math.hypot(*seen):
            return False
        if math.isnan(m.field[0]):
            m.field = seen
        m.field_s = min(m.field_s + T, told.field_memory_s)
        share = T / m.field_s
        if self._alike(seen, m.field):
            m.other_s = 0.0
            m.field = m.field + share * (seen - m.field)
            return True
        if m.other_s > 0 and self._alike(seen, m.other):
            m.other = m.other + share * (seen - m.other)
        else:
            m.other, m.other_s = seen, 0.0
        m.other_s += T
        if m.other_s >= told.field_patience_s:
            m.field, m.other_s = m.other, 0.0
        return False

    def _alike(self, seen: Array, usual: Array) -> bool:
        """Whether two fields are of the same size and dip."""
        (size, dip), (usual_size, usual_dip) = ((math.hypot(*one), math.atan2(one[1], one[0])) for one in (seen, usual))
        told = self.told
        return (
            abs(size - usual_size) <= told.field_tolerance * usual_size and abs(dip - usual_dip) <= told.dip_tolerance
        )

    def turn(self, s: State, z: float, variance: float, t: float, field_n: Array, T: float) -> UpdateReport:
        """Take the heading ``z`` [rad] of a mean field (3,) for what it is, unless the field is disturbed.

        A disturbance shows by two of its three components, level along the field and down; the third, which turns the
        heading, is taken for as large as either (half of the sum of their squares), and as noise that lasts (twice its
        time over the period) adds to the ``variance`` of the mean. The heading
        moves heading and the gyros' bias about the vertical, no other state; the covariance is that of the gain that is
        used (Joseph's form).
        """
        seen = np.array([math.hypot(field_n[0], field_n[1]), field_n[2]])
        undisturbed = self._undisturbed(s, seen, T)
        H, R = self._H_heading, variance
        if undisturbed:
            beside = (seen - s.in_motion.field) / seen[0]
            R += float(beside @ beside) * self.told.disturbance_s / T
        PH = s.P @ H[0]
        S = float(H[0] @ PH) + R
        nu = z - float(H[0] @ s.x)
        report = UpdateReport(
            t, s.in_motion.sensor, MAGNETIC_HEADING, np.array([nu]), np.array([[S]]), nu * nu / S, math.inf, 1.0,
            Outcome.FUSED,
        )  # fmt: skip
        if not undisturbed:
            return replace(report, weight=0.0, outcome=Outcome.OUTSIDE_GATE, reason="the field is disturbed")
        gain = np.zeros(len(s.x))
        gain[PHI + 2] = PH[PHI + 2] / S
        down_b = dcm_from_quat(s.q_nb)[2]
        gain[BIAS:STATES] = down_b * float(down_b @ PH[BIAS:STATES]) / S
        s.x += gain * nu
        rest = np.eye(len(s.x)) - gain[:, None] * H
        s.P[:] = rest @ s.P @ rest.T + R * gain[:, None] * gain
        return report

    def rest(self, s: State, T: float) -> None:
        """Take the mean rate for bias when the body has been at rest for some periods.

        Rest is that neither rate nor specific force varies by more than noise, and that no rate is seen but what the
        biases may be.
        """
        told, imu = self.told, self.config.imu
        rate, force, increments = s.angle / T, s.sums[0] / T, float(s.elapsed[2])
        spread = s.sums[1:3] / T - np.square([rate, force])
        limits = [
            one**2 + 6 * noise**2 * increments / T
            for one, noise in ((told.rest_rate, imu.gyro_noise), (told.rest_force, imu.accel_noise))
        ]
        H = np.zeros((3, len(s.x)))
        H[:, BIAS:STATES] = -np.eye(3)
        R = np.full(3, told.rest_sigma**2 / T)
        nu = rate - s.gyro_bias - dcm_from_quat(s.q_nb).T @ self._earth_n
        S = s.P[BIAS:STATES, BIAS:STATES] + np.diag(R)
        quiet = bool((spread.sum(axis=1) <= limits).all()) and float(nu @ np.linalg.solve(S, nu)) <= REST_GATE
        s.in_motion.quiet = s.in_motion.quiet + 1 if quiet else 0
        if s.in_motion.quiet >= told.rest_periods:
            update(s.x, s.P, H, R, nu - H @ s.x, math.inf)

    def feed_back(self, s: State) -> None:
        """Take what was found out of attitude, gyros and velocities; what is known along n turns with the heading."""
        m, turned = s.in_motion, float(s.x[PHI + 2])
        s.q_nb[:] = quat_normalise(quat_multiply(quat_from_rotvec(s.x[PHI : PHI + 3]), s.q_nb))
        s.gyro_bias -= s.x[BIAS:STATES]
        m.velocity_n -= s.x[self._velocity]
        m.turning_n -= s.x[self._further.turning]
        s.x[:STATES] = 0.0
        s.x[self._velocity] = s.x[self._further.turning] = 0.0
        turn = _turn(turned)
        m.velocity_n, m.turning_n = turn @ m.velocity_n, turn @ m.turning_n
        m.force_n, m.mean_force_n = turn @ m.force_n, turn @ m.mean_force_n
        _turn_blocks(s, turned, slice(PHI, PHI + 2), self._velocity, self._further.turning)


def _turn(angle: float) -> Array:
    """What turns a horizontal vector by an angle [rad] to the right, (2, 2)."""
    return math.cos(angle) * np.eye(2) + math.sin(angle) * RIGHT


def _turn_blocks(s: State, angle: float, *blocks: slice) -> None:
    """Turn errors of horizontal vectors by an angle [rad] to the right."""
    whole = np.eye(len(s.x))
    for block in blocks:
        whole[block, block] = _turn(angle)
    s.x[:] = whole @ s.x
    s.P[:] = whole @ s.P @ whole.T
