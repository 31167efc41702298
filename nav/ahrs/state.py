"""What moves in the attitude filter, by increments and by time: attitude, error states, what a period has summed up."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from nav._jit import inlined, njit
from nav.rotation import rotation_coefficients
from nav.samples import FORCE_LIMIT, RATE_LIMIT, Array
from nav.state import ANYHOW, turn_unseen

PHI, BIAS, STATES = 0, 3, 6  # where the error states begin, and how many there are before those of `nav.ahrs.further`
UNKNOWN = np.full(3, np.nan)
FIXED = 55  # numbers in a `State` of any size
PERIOD_END, LEVELLINGS, CORRECTIONS = 0, 1, 2  # what is where in `State.counts`
TURN_RATE, MISSING = 4, 5  # and in `State.elapsed`


@dataclasses.dataclass
class InMotion:
    """What `nav.ahrs.any_motion` keeps in mind: velocity, accelerations, the magnetic field, rest."""

    velocity_n: Array = dataclasses.field(
        default_factory=lambda: np.zeros(2)
    )  # north and east, beside what airspeed tells
    turning_n: Array = dataclasses.field(default_factory=lambda: np.zeros(2))  # the velocity that turns with the body
    force_n: Array = dataclasses.field(
        default_factory=lambda: np.zeros(2)
    )  # horizontal specific force, smoothed [m/s^2]
    mean_force_n: Array = dataclasses.field(default_factory=lambda: np.zeros(2))  # its mean of the last seconds
    force_variance: float = 0.0  # about that mean, of one axis
    turn_rate: float = 0.0  # about the vertical, mean of the last seconds [rad/s]
    swing: float = 0.0  # rate about the vertical, less that mean [rad/s]
    steady_rate: float = 0.0  # about the vertical, smoothed [rad/s]
    swing_square: float = 0.0  # of the rate about any axis, less that of the smoothed one, mean of the last seconds
    excess: float = 0.0  # of the square of the specific force over that of gravity, mean of the last seconds [m^2/s^4]
    fields: int = 0  # samples in `State.field_n` since the period began
    sensor: str = ""  # whose they are
    field: Array = dataclasses.field(
        default_factory=lambda: UNKNOWN[:2]
    )  # level and downward part of the undisturbed field [T]
    field_s: float = 0.0  # for how long it has been learned
    other: Array = dataclasses.field(default_factory=lambda: UNKNOWN[:2])  # the same of a field that may replace it
    other_s: float = 0.0  # for how long that has been seen
    quiet: int = 0  # periods in a row

    def copy(self) -> InMotion:
        """The same in arrays of its own."""
        arrays: dict[str, Any] = {
            name: value.copy() for name, value in vars(self).items() if isinstance(value, np.ndarray)
        }
        return dataclasses.replace(self, **arrays)


class State:
    """Everything that moves. While levelling, n stands for the body axes at the first increment.

    The arrays are views of one, the ``whole``, which a kernel is handed, and finds them in (`parts`).
    """

    q_nb: Array
    gyro_bias: Array  # (3,) taken off the gyros
    air_velocity_n: Array  # (3,) at the start of the period, NaN when unknown
    field_n: Array  # (3,) sum of magnetic fields while levelling
    shown: Array  # (3,) acceleration, yaw rate and roll rate that the last period was judged by, as `nav.motion.Motion`
    counts: Array  # (3,) end of the period [s], periods of low dynamics, corrections since the last that was none
    rates: Array  # (2, 3) angular rate and specific force of the last sound increment, as measured
    turned: Array  # (3, 3) integral of C_nb since the last covariance step
    angle: Array  # (3,) integral of angular rate over the period, body axes
    force: Array  # (3,) integral of specific force over the period, n
    elapsed: Array  # (6,) seconds since the last covariance step, since the start of the period; increments since then;
    # seconds since a sound increment; `TURN_RATE`, about the vertical, mean of the last half-minute [rad/s]; and
    # seconds of the period that are `MISSING`
    sums: Array  # (3, 3) integrals over the period of specific force and of the squares of rate and of it, body axes
    x: Array  # (n,) estimated errors still in the attitude and the gyros, and `nav.ahrs.further.FurtherStates`
    P: Array  # (n, n)

    def __init__(self, n: int, whole: Array, levelled: bool, in_motion: InMotion) -> None:
        self.n, self.whole, self.levelled, self.in_motion = n, whole, levelled, in_motion
        (
            self.q_nb, self.gyro_bias, self.air_velocity_n, self.field_n, self.shown, self.counts, self.rates,
            self.turned, self.angle, self.force, self.elapsed, self.sums, self.x, self.P,
        ) = parts(whole, n)  # fmt: skip

    def copy(self) -> State:
        """The same in arrays of its own."""
        return State(self.n, self.whole.copy(), self.levelled, self.in_motion.copy())


def fresh(period_end: float, n: int) -> State:
    """Nothing is known but when the levelling ends; ``n`` error states."""
    state = State(n, np.zeros(FIXED + n * (n + 1)), False, InMotion())
    state.q_nb[0] = 1.0
    state.air_velocity_n[:] = state.shown[:] = UNKNOWN
    state.counts[PERIOD_END] = period_end
    return state


@njit
def parts(
    whole: Array, n: int
) -> tuple[
    Array, Array, Array, Array, Array, Array, Array, Array, Array, Array, Array, Array, Array, Array
]:  # fmt: skip
    """The parts of the ``whole`` of a `State` as views, in the order of the class."""
    x = FIXED + n
    return (
        whole[:4], whole[4:7], whole[7:10], whole[10:13], whole[13:16], whole[16:19], whole[19:25].reshape(2, 3),
        whole[25:34].reshape(3, 3), whole[34:37], whole[37:40], whole[40:46], whole[46:FIXED].reshape(3, 3),
        whole[FIXED:x], whole[x:].reshape(n, n),
    )  # fmt: skip


@inlined
def transition(turned: Array, earth_n: Array, T: float) -> Array:
    """Rows of phi (3, 6) in the transition over ``T`` [s]: [I - [w_ie x] T, integral of C_nb] (equations 5, 6, 8)."""
    north, east, down = earth_n[0] * T, earth_n[1] * T, earth_n[2] * T
    rows = np.zeros((3, STATES))
    rows[0, 0] = rows[1, 1] = rows[2, 2] = 1.0
    rows[0, 1], rows[0, 2], rows[1, 2] = down, -east, north
    rows[1, 0], rows[2, 0], rows[2, 1] = -down, east, -north
    for i in range(3):
        for j in range(3):
            rows[i, BIAS + j] = turned[i, j]
    return rows


@njit
def propagate(
    q_nb: Array, gyro_bias: Array, earth_n: Array, rates: Array, turned: Array, angle: Array, force: Array,
    elapsed: Array, sums: Array, P: Array, dtheta: Array, dv: Array, dt: Array,
) -> int:  # fmt: skip
    """Attitude and the integrals over N increments in place; the last of them that was not usable, -1 for none.

    These are bridged with the last sound rates; unseen, the body may have turned (`nav.state.turn_unseen`).
    q+ = exp(-w_ie dt / 2) q exp(dtheta / 2), and C_nb dv by the attitude half-way through the turn.
    """
    bad = -1
    w, x, y, z = q_nb[0], q_nb[1], q_nb[2], q_nb[3]
    b0, b1, b2 = gyro_bias[0], gyro_bias[1], gyro_bias[2]
    e0, e1, e2 = -0.5 * earth_n[0], -0.5 * earth_n[1], -0.5 * earth_n[2]
    for k in range(len(dt)):
        T = dt[k]
        if not T > 0.0:
            continue
        p0, p1, p2 = dtheta[k, 0], dtheta[k, 1], dtheta[k, 2]
        u0, u1, u2 = dv[k, 0], dv[k, 1], dv[k, 2]
        most, strongest = RATE_LIMIT * T, FORCE_LIMIT * T
        if (
            abs(p0) <= most and abs(p1) <= most and abs(p2) <= most
            and abs(u0) <= strongest and abs(u1) <= strongest and abs(u2) <= strongest
        ):  # fmt: skip
            rates[0, 0], rates[0, 1], rates[0, 2] = p0 / T, p1 / T, p2 / T
            rates[1, 0], rates[1, 1], rates[1, 2] = u0 / T, u1 / T, u2 / T
            elapsed[3] = 0.0
        else:
            bad = k
            grown = turn_unseen(elapsed[3] + T) - turn_unseen(elapsed[3])
            elapsed[3] += T
            elapsed[MISSING] += T
            for i in range(3):
                P[PHI + i, PHI + i] = max(P[PHI + i, PHI + i], min(P[PHI + i, PHI + i] + grown, ANYHOW))
            p0, p1, p2 = rates[0, 0] * T, rates[0, 1] * T, rates[0, 2] * T
            u0, u1, u2 = rates[1, 0] * T, rates[1, 1] * T, rates[1, 2] * T
        angle[0] += p0
        angle[1] += p1
        angle[2] += p2
        sums[0, 0] += u0
        sums[0, 1] += u1
        sums[0, 2] += u2
        per_s = 1.0 / T
        sums[1, 0] += p0 * p0 * per_s
        sums[1, 1] += p1 * p1 * per_s
        sums[1, 2] += p2 * p2 * per_s
        sums[2, 0] += u0 * u0 * per_s
        sums[2, 1] += u1 * u1 * per_s
        sums[2, 2] += u2 * u2 * per_s
        p0, p1, p2 = p0 - b0 * T, p1 - b1 * T, p2 - b2 * T

        # half the turn, twice
        sinc, versine, _ = rotation_coefficients(0.0625 * (p0 * p0 + p1 * p1 + p2 * p2))
        dw, k4 = 1 - 0.0625 * (p0 * p0 + p1 * p1 + p2 * p2) * versine, 0.25 * sinc
        dx, dy, dz = k4 * p0, k4 * p1, k4 * p2
        w, x, y, z = (
            w * dw - x * dx - y * dy - z * dz,
            w * dx + x * dw + y * dz - z * dy,
            w * dy - x * dz + y * dw + z * dx,
            w * dz + x * dy - y * dx + z * dw,
        )
        c00, c01, c02 = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
        c10, c11, c12 = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
        c20, c21, c22 = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        w, x, y, z = (
            w * dw - x * dx - y * dy - z * dz,
            w * dx + x * dw + y * dz - z * dy,
            w * dy - x * dz + y * dw + z * dx,
            w * dz + x * dy - y * dx + z * dw,
        )
        dx, dy, dz = e0 * T, e1 * T, e2 * T
        w, x, y, z = (
            w - dx * x - dy * y - dz * z,
            x + dx * w + dy * z - dz * y,
            y - dx * z + dy * w + dz * x,
            z + dx * y - dy * x + dz * w,
        )
        scale = 1.5 - 0.5 * (w * w + x * x + y * y + z * z)  # one Newton step to unit norm: it left it by rounding only
        w, x, y, z = scale * w, scale * x, scale * y, scale * z

        turned[0, 0] += c00 * T
        turned[0, 1] += c01 * T
        turned[0, 2] += c02 * T
        turned[1, 0] += c10 * T
        turned[1, 1] += c11 * T
        turned[1, 2] += c12 * T
        turned[2, 0] += c20 * T
        turned[2, 1] += c21 * T
        turned[2, 2] += c22 * T
        force[0] += c00 * u0 + c01 * u1 + c02 * u2
        force[1] += c10 * u0 + c11 * u1 + c12 * u2
        force[2] += c20 * u0 + c21 * u1 + c22 * u2
        elapsed[0] += T
        elapsed[1] += T
        elapsed[2] += 1.0
    q_nb[0], q_nb[1], q_nb[2], q_nb[3] = w, x, y, z
    return bad
