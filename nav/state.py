"""What moves in a filter, and the kernels that move it: strapdown, covariance, and what a measurement corrects.

A kernel is handed the whole of a `State` as one array, and finds its parts in it (`parts`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from nav._jit import inlined, lean, njit
from nav.earth import gravity, radii, wrap_longitude
from nav.error_model import MOTION, PHI, POS, VEL, Indices, sensor_errors, take_errors, transition
from nav.kalman import predict, update_in
from nav.rotation import turn
from nav.samples import FORCE_LIMIT, RATE_LIMIT, Array
from nav.strapdown import step
from nav.unscented import predict as predict_points
from nav.unscented import remove

FIXED = 73  # numbers in a `State` of any size
SAME = 1e-9  # rates this close, relative, are those of one increment
BRIDGED_RATE, BRIDGED_FORCE = 0.5, 3.0  # by which those before a gap are off in the end [rad/s, m/s^2]
CHANGE_S = 0.2  # in which they are by half of that
ANYHOW = math.pi**2 / 3  # variance of an angle of which nothing is known [rad^2]
ACCELERATION_S = 0.2  # over which acceleration is averaged: about as long as receivers are late
SHAKEN_S = 1.0  # over which the noise of increments is averaged


class State:
    """Everything that moves: nominal motion and sensor errors, what the filters hold, and integrals still to be used.

    ``x[i, :common]`` is what filter i would add to the nominal state, the estimated error with its sign turned; behind
    that are the estimated errors of its own aids, whole values. All are views of one array, the ``whole``, so that a
    prediction can `take` it at once, and a kernel is handed one array for ten: each costs as much as a small product.
    """

    q_nb: Array
    v_n: Array
    lla: Array
    imu: Array  # (common,) estimated sensor errors, the motion's own entries zero
    x: Array  # (filters, n)
    P: Array  # (filters, n, n)
    errors: Array  # (4, 3) nominal sensor errors by kind
    sums: Array  # (3, 3, 3), see `error_model.transition`
    elapsed: Array  # (3,) seconds and samples since the last covariance step; seconds since a sound increment
    rates: Array  # (2, 3) angular rate and specific force of the last sound increment, as measured
    shaking: Array  # (3, 3) rate and force of the increment before; densities of their noise, and the last one's length
    acceleration: Array  # (2, 3) of the IMU over ground, NED, averaged over `ACCELERATION_S`, and once more [m/s^2]

    def __init__(self, common: int, filters: int, n: int, whole: Array | None = None) -> None:
        self.shape = common, filters, n
        self.whole = np.zeros(FIXED + common + filters * n * (n + 1)) if whole is None else whole
        (
            self.q_nb, self.v_n, self.lla, self.imu, self.x, self.P, self.errors, self.sums, self.elapsed, self.rates,
            self.shaking, self.acceleration,
        ) = parts(self.whole, common, filters, n)  # fmt: skip

    def take(self, other: State) -> None:
        """Become the same as ``other``, which has as many filters and states."""
        self.whole[:] = other.whole

    def accelerated(self, before: float) -> Array:
        """Acceleration (3,) over ground, NED [m/s^2], so many seconds ``before`` now.

        The averages are as old as what they are taken over, once and twice `ACCELERATION_S`: by the line through both.
        """
        once, twice = self.acceleration
        found: Array = once + (1.0 - before / ACCELERATION_S) * (once - twice)
        return found

    def copy(self) -> State:
        """The same in arrays of its own."""
        made = State(*self.shape)
        made.take(self)
        return made

    def __deepcopy__(self, memo: object) -> State:
        """A deep copy of views would be arrays each by itself."""
        return self.copy()


class Known(NamedTuple):
    """What each of N states says of the motion, of the inertial sensors and of its filters; and where its P begins."""

    q_nb: Array  # (N, 4)
    v_n: Array
    lla: Array
    imu: Array  # (N, common)
    x: Array  # (N, filters, n)
    first: int


def known(wholes: Array, common: int, filters: int, n: int) -> Known:
    """A copy of what is short of ``wholes`` (N, numbers), each the whole of a `State`; covariances are far larger."""
    x = FIXED + common
    P = x + filters * n
    short = wholes[:, :P].copy()
    return Known(
        short[:, :4], short[:, 4:7], short[:, 7:10], short[:, FIXED:x], short[:, x:].reshape(-1, filters, n), P
    )  # fmt: skip


@inlined
def parts(
    whole: Array, common: int, filters: int, n: int
) -> tuple[Array, Array, Array, Array, Array, Array, Array, Array, Array, Array, Array, Array]:
    """The parts of the ``whole`` of a `State` as views, in the order of the class; those of fixed size lie first."""
    x = FIXED + common
    P = x + filters * n
    return (
        whole[:4], whole[4:7], whole[7:10], whole[FIXED:x], whole[x:P].reshape(filters, n),
        whole[P:].reshape(filters, n, n), whole[10:22].reshape(4, 3), whole[22:49].reshape(3, 3, 3),
        whole[49:52], whole[52:58].reshape(2, 3), whole[58:67].reshape(3, 3),
        whole[67:FIXED].reshape(2, 3),
    )  # fmt: skip


@inlined
def draft(into: Array, whole: Array, common: int, filters: int, n: int) -> None:
    """Copy of a ``whole`` what an estimate is made of: all but the covariances of what is not common."""
    P = FIXED + common + filters * n
    for i in range(P):
        into[i] = whole[i]
    for f in range(filters):
        for i in range(common):
            row = P + (f * n + i) * n
            for j in range(row, row + common):
                into[j] = whole[j]
        for i in range(common, n):
            into[P + (f * n + i) * n + i] = whole[P + (f * n + i) * n + i]


@inlined
def working(room: Array, common: int, n: int) -> tuple[Array, Array, Array, Array]:
    """Where a covariance step works in: two matrices of `transition`, decay and half noise of each state."""
    matrix = MOTION * common
    return (
        room[:matrix].reshape(MOTION, common), room[matrix : 2 * matrix].reshape(MOTION, common),
        room[2 * matrix : 2 * matrix + n], room[2 * matrix + n :],
    )  # fmt: skip


@lean
def absorb(
    whole: Array, common: int, filters: int, n: int, row: int, driven: Indices, nu: Array, H: Array, R: Array,
    threshold: float, close: bool, S: Array, inverses: Array, work: Array,
) -> float:  # fmt: skip
    """One measurement into filter ``row`` of a `State` if its nis is at most ``threshold``; nis.

    With ``close`` what the filter would add to the nominal state is put there at once. See `kalman.update`; ``S``
    (m, m) and what it works in as of `kalman.scratch`.
    """
    q_nb, v_n, lla, imu, x, P, errors, _, _, _, _, _ = parts(whole, common, filters, n)
    nis = update_in(x[row], P[row], H, R, nu, threshold, S, inverses, work)
    if close and nis <= threshold:
        inject(q_nb, v_n, lla, imu, x[row])
        for i in range(common):
            x[row, i] = 0.0
        sensor_errors(errors, imu, driven)
    return nis


@lean
def inject(q_nb: Array, v_n: Array, lla: Array, imu: Array, correction: Array) -> None:
    """Add a correction (of the common states at least) to the nominal state, with the sign of `kalman.correct`."""
    # C_nb_hat = (I - [phi x]) C_nb, and the correction is minus phi's estimate
    turn(q_nb, -correction[PHI], -correction[PHI + 1], -correction[PHI + 2])
    for i in range(3):
        v_n[i] += correction[VEL + i]
    R_M, R_N = radii(lla[0])
    lla[1] = wrap_longitude(lla[1] + correction[POS + 1] / ((R_N + lla[2]) * math.cos(lla[0])))
    lla[0] += correction[POS] / (R_M + lla[2])
    lla[2] -= correction[POS + 2]
    for i in range(MOTION, len(imu)):
        imu[i] += correction[i]


@inlined
def _covariance_step(
    v_n: Array, lla: Array, imu: Array, x: Array, P: Array, errors: Array, sums: Array, elapsed: Array,
    shaking: Array, driven: Indices, decay_rate: Array, variance_rate: Array, in_motion: Array, Phi: Array, FT: Array,
    decay: Array, half_noise: Array, work: Array, first: int,
) -> None:  # fmt: skip
    """Take every filter's covariance and states over the time in ``elapsed``, and empty the integrals.

    For ``first`` see `kalman.predict`.
    """
    T = elapsed[0]
    transition(Phi, FT, driven, v_n, lla[0], lla[2], sums, T)
    common = len(imu)
    for f in range(len(x)):
        for i in range(x.shape[1]):
            half_noise[i] = 0.5 * T * variance_rate[f, i]
            decay[i] = math.exp(-T * decay_rate[f, i]) if decay_rate[f, i] > 0.0 else 1.0
        _add_motion(half_noise, in_motion[f], sums, shaking, lla, T)
        estimated = False
        for i in range(common):
            if x[f, i] != 0.0:
                estimated = True
        if estimated:
            for i in range(MOTION):
                work[i, 0] = 0.0
                for j in range(common):
                    work[i, 0] += Phi[i, j] * x[f, j]
            for i in range(MOTION):
                x[f, i] = work[i, 0]
        for i in range(MOTION, x.shape[1]):
            x[f, i] *= decay[i]
        if f == 0:
            for i in range(MOTION, common):
                imu[i] *= decay[i]
        predict(P[f], Phi, decay, half_noise, work, first)
    sensor_errors(errors, imu, driven)
    _empty(sums, elapsed)


@lean
def _add_motion(half_noise: Array, in_motion: Array, sums: Array, shaking: Array, lla: Array, T: float) -> None:
    """Add what motion and vibration over ``T`` seconds do to half of the noise of attitude and velocity.

    ``in_motion`` (4,) is `error_model.ImuModel.in_motion`: of the mean rate and of the mean force less gravity a share
    that is another one each second, so that its density is that share times one root of a second.
    """
    if in_motion[0] == 0.0 and in_motion[1] == 0.0 and in_motion[2] == 0.0:
        return
    turn2 = push2 = 0.0
    for i in range(3):
        turn, push = 0.0, gravity(lla[0], lla[2]) * T if i == 2 else 0.0
        for j in range(3):
            turn, push = turn + sums[1, i, j], push + sums[2, i, j]
        turn2, push2 = turn2 + turn * turn, push2 + push * push
    phi = in_motion[0] * turn2 / T + in_motion[2] * shaking[2, 0] * T
    dv = in_motion[1] * push2 / T + in_motion[2] * shaking[2, 1] * T
    for i in range(3):
        half_noise[PHI + i] += 0.5 * phi
        half_noise[VEL + i] += 0.5 * dv


@lean
def _shake(shaking: Array, rates: Array, dtheta: Array, dv: Array, T: float) -> None:
    """Learn from one sound increment how noisy increments are, ``rates`` being those of the one before.

    The second difference of three rates in a row has six times the variance of one, whatever a slow motion does. The
    density of the noise (mean of the axes) is that variance times the length of an increment, averaged over a second.
    Parts into which an increment was split have its rates, and count as one.
    """
    same = True
    for i in range(3):
        turn, push = dtheta[i] / T, dv[i] / T
        if abs(turn - rates[0, i]) > SAME * (1.0 + abs(turn)) or abs(push - rates[1, i]) > SAME * (1.0 + abs(push)):
            same = False
    if same:
        shaking[2, 2] += T
        return
    length = shaking[2, 2]
    for kind in range(2):
        spread = 0.0
        for i in range(3):
            now = dtheta[i] / T if kind == 0 else dv[i] / T
            second = now - 2.0 * rates[kind, i] + shaking[kind, i]
            spread += second * second
            shaking[kind, i] = rates[kind, i]
        if length > 0.0:
            shaking[2, kind] += min(1.0, length / SHAKEN_S) * (spread / 18.0 * length - shaking[2, kind])
    shaking[2, 2] = T


@lean
def _empty(sums: Array, elapsed: Array) -> None:
    """Begin the integrals anew."""
    for i in range(3):
        for j in range(3):
            for k in range(3):
                sums[i, j, k] = 0.0
    elapsed[0] = elapsed[1] = 0.0


@njit
def sigma_step(
    q_nb: Array, v_n: Array, lla: Array, imu: Array, x: Array, P: Array, errors: Array, sums: Array, elapsed: Array,
    shaking: Array, driven: Indices, decay_rate: Array, variance_rate: Array, in_motion: Array, Phi: Array, FT: Array,
    decay: Array, half_noise: Array, work: Array, spread: float, excess: float,
) -> Array:  # fmt: skip
    """`_covariance_step` of one closed filter by sigma points, whose mean error (n,) is taken out of the motion."""
    T = elapsed[0]
    transition(Phi, FT, driven, v_n, lla[0], lla[2], sums, T)
    push_n = np.empty(3)
    for i in range(3):
        push_n[i] = sums[2, i, 0] + sums[2, i, 1] + sums[2, i, 2]
    for i in range(len(x)):
        half_noise[i] = 0.5 * T * variance_rate[i]
        decay[i] = math.exp(-T * decay_rate[i]) if decay_rate[i] > 0.0 else 1.0
    _add_motion(half_noise, in_motion, sums, shaking, lla, T)
    for i in range(MOTION, len(x)):
        x[i] *= decay[i]
    for i in range(MOTION, len(imu)):
        imu[i] *= decay[i]
    error = predict_points(P, Phi, decay, half_noise, work, push_n, T, spread, excess)
    remove(q_nb, v_n, lla, imu, error[: len(imu)])
    sensor_errors(errors, imu, driven)
    _empty(sums, elapsed)
    return error


@lean
def propagate(
    whole: Array, common: int, filters: int, n: int, driven: Indices, decay_rate: Array, variance_rate: Array,
    in_motion: Array, room: Array, work: Array, period: int, dtheta: Array, dv: Array, dt: Array, row: int, stop: int,
    settle: bool, first: int,
) -> int:  # fmt: skip
    """Strapdown and covariances over the increments from ``row`` to before ``stop`` in place; the last of them that was
    not usable, -1 for none.

    A covariance step is taken every ``period`` samples and, to ``settle``, at the end. It stands at one place only,
    since it is long to compile. Of a `draft` it finds what there is, if ``first`` is ``common``; otherwise that is n.
    """
    q_nb, v_n, lla, imu, x, P, errors, sums, elapsed, rates, shaking, acceleration = parts(whole, common, filters, n)
    Phi, FT, decay, half_noise = working(room, common, n)
    bad = -1
    shaken = in_motion[0, 2] > 0.0
    angle, push, before, old = FT[0, :3], FT[1, :3], FT[2, :4], FT[3, :3]  # until a covariance step needs the room
    for k in range(row, stop + 1):
        T = dt[k] if k < stop else 0.0
        if T > 0.0:
            sound = True
            for i in range(3):
                if not (abs(dtheta[k, i]) <= RATE_LIMIT * T and abs(dv[k, i]) <= FORCE_LIMIT * T):
                    sound = False
            if sound:
                if shaken:
                    _shake(shaking, rates, dtheta[k], dv[k], T)
                for i in range(3):
                    rates[0, i], rates[1, i] = dtheta[k, i] / T, dv[k, i] / T
                elapsed[2] = 0.0
            else:
                bad = k
                if rates[1, 0] == 0.0 and rates[1, 1] == 0.0 and rates[1, 2] == 0.0:  # it has felt nothing yet
                    weigh(rates[1], q_nb, lla)
                turned = turn_unseen(elapsed[2] + T) - turn_unseen(elapsed[2])
                pushed = push_unseen(elapsed[2] + T) - push_unseen(elapsed[2])
                elapsed[2] += T
                for f in range(filters):
                    most = in_motion[f, 3] * ANYHOW
                    for i in range(3):
                        p = P[f, PHI + i, PHI + i]
                        P[f, PHI + i, PHI + i] = max(p, min(p + in_motion[f, 3] * turned, most))
                        P[f, VEL + i, VEL + i] += in_motion[f, 3] * pushed
            take_errors(angle, push, rates, T, errors, imu, driven)
            for i in range(4):
                before[i] = q_nb[i]
            for i in range(3):
                old[i] = v_n[i]
            step(q_nb, v_n, lla, angle, push, T)
            share = min(1.0, T / ACCELERATION_S)
            for i in range(3):
                acceleration[0, i] += share * ((v_n[i] - old[i]) / T - acceleration[0, i])
                acceleration[1, i] += share * (acceleration[0, i] - acceleration[1, i])
            integrate(sums, before, q_nb, angle, push, T)
            elapsed[0] += T
            elapsed[1] += 1.0
        if elapsed[1] >= period or (settle and k == stop and elapsed[0] > 0.0):
            _covariance_step(
                v_n, lla, imu, x, P, errors, sums, elapsed, shaking,
                driven, decay_rate, variance_rate, in_motion, Phi, FT, decay, half_noise, work, first,
            )  # fmt: skip
    return bad


@inlined
def push_unseen(gap: float) -> float:
    """Variance [m^2/s^2] of what a velocity is off by after so many seconds without increments.

    The force before the gap is held on, and off by a share T / (T + `CHANGE_S`) of `BRIDGED_FORCE` after T seconds: so
    it is with small aeroplanes, from 0.02 s to 2 s.
    """
    return (BRIDGED_FORCE * gap * gap / (gap + CHANGE_S)) ** 2


@inlined
def turn_unseen(gap: float) -> float:
    """The same of an angle [rad^2], by `BRIDGED_RATE`: on and on, as what has been measured of it since passes too.

    No angle is less well known than `ANYHOW`.
    """
    return (BRIDGED_RATE * gap * gap / (gap + CHANGE_S)) ** 2


@inlined
def weigh(force: Array, q_nb: Array, lla: Array) -> None:
    """Let a specific force (3,) [m/s^2] of body axes be that of a body which is not accelerated."""
    w, x, y, z = q_nb[0], q_nb[1], q_nb[2], q_nb[3]
    g = gravity(lla[0], lla[2])
    force[0], force[1] = -2 * (x * z - w * y) * g, -2 * (y * z + w * x) * g
    force[2] = -(1 - 2 * (x * x + y * y)) * g


@inlined
def integrate(sums: Array, before: Array, after: Array, angle: Array, push: Array, T: float) -> None:
    """Add one interval to the integrals of `error_model.transition`, with C_nb in its middle: of the mean quaternion.

    Written out in scalars: a matrix made for every increment would take as long as the strapdown.
    """
    w, x, y, z = before[0] + after[0], before[1] + after[1], before[2] + after[2], before[3] + after[3]
    s = 2.0 / (w * w + x * x + y * y + z * z)
    C_nb = (
        (1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)),
        (s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)),
        (s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)),
    )
    for i in range(3):
        for j in range(3):
            sums[0, i, j] += C_nb[i][j] * T
            sums[1, i, j] += C_nb[i][j] * angle[j]
            sums[2, i, j] += C_nb[i][j] * push[j]
