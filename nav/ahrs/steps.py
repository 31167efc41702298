"""The attitude filter's kernels: what it does at a time, and many steps of it at once.

What they are told beside the whole of a `nav.ahrs.state.State` and the number of its error states n is in the three
arrays of a `Model`: ``told`` are numbers by their names here, ``rows`` (6, n) have one of each error state, ``places``
are indices. ``air`` (3,) are the numbers of `nav.motion.TrueAirspeed`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from nav._jit import inlined, njit
from nav.ahrs.config import AhrsConfig, limited
from nav.ahrs.further import FurtherStates, columns, misaligned
from nav.ahrs.state import (
    BIAS,
    CORRECTIONS,
    LEVELLINGS,
    MISSING,
    PERIOD_END,
    PHI,
    STATES,
    TURN_RATE,
    parts,
    propagate,
    transition,
)
from nav.earth import earth_rate_n
from nav.error_model import PAPERS, ErrorModel, Indices
from nav.increments import (
    ADVANCE,
    COINCIDENT,
    ESTIMATE,
    HORIZON,
    NUMBERS,
    TIME,
    WHAT,
    row_after,
    share,
    take_off,
)
from nav.kalman import take_rest, update
from nav.motion import acceleration_n, add_eas, passes, true_airspeed
from nav.rotation import dot, quat_from_rotvec, quat_multiply, quat_normalise, quat_rotate
from nav.samples import Array
from nav.state import ANYHOW

# ``told``: the Earth's rate (3,), and what begins where
G, PERIOD, FORCE_VARIANCE, AIRSPEED_VARIANCE, WELL_KNOWN, PHI_LIMIT, AZIMUTH, HEADING_VARIANCE, SMOOTHING = range(3, 12)
AS_IT_IS, COMPENSATED = 12, 16  # limits of low dynamics (4,) each
# ``rows``: variance that comes in per second, or over a step that forgets all; decay; Jacobians
VARIANCE_RATE, DECAY_RATE, VARIANCE, HEADING_ROW, LEVEL_ROW = range(5)
# ``places``: where further states begin, -1 without; biases that are fed back; whether the heading is seen
MISALIGNMENT, ACCEL_BIAS, GUST, FED_BACK, SEES_HEADING = range(5)

AIRSPEED, DENSITY, MAGNETIC = 0, 1, 2  # what a step is that has a sample
WIDTH = NUMBERS + 4
TURN_MEMORY_S = 30.0  # over which the rate of a turn is taken, so that what a nose does in gusts is none
AS_GOOD_AS = 0.95  # of the variance of an angle of which nothing is known
REPORT = 15  # kind, t, nis, innovation (3,), S (9,)


class Model(NamedTuple):
    """The three arrays of numbers that kernels are told."""

    told: Array
    rows: Array
    places: Indices


def model(config: AhrsConfig, further: FurtherStates, g: float, field_n: Array | None, heading: bool) -> Model:
    """All that a ``config`` says to a filter with these ``further`` states; ``g`` [m/s^2] is gravity.

    ``field_n`` (3,) is the reference field, whose ``heading`` is used or not.
    """
    n = STATES + further.count
    rows = np.zeros((6, n))
    errors = ErrorModel(config.imu)
    rows[VARIANCE_RATE, :STATES] = errors.density[errors.places(PAPERS["jiang2021"])] ** 2
    rows[DECAY_RATE, STATES:], rows[VARIANCE, STATES:] = further.decay_rate, further.sigma**2
    if field_n is not None:
        rows[HEADING_ROW, PHI : PHI + 2] = field_n[:2] * field_n[2] / (field_n[0] ** 2 + field_n[1] ** 2)
    rows[HEADING_ROW, PHI + 2] = -1.0
    rows[LEVEL_ROW, PHI + 1], rows[LEVEL_ROW + 1, PHI] = g, -g
    told = [
        *earth_rate_n(config.lat), g, config.period_s, config.force_sigma**2, config.airspeed_sigma**2,
        config.correction_sigma**2, config.phi_limit, 0.0 if field_n is None else math.atan2(field_n[1], field_n[0]),
        config.magnetometer_sigma**2, config.airspeed_smoothing_s, *config.motion.numbers,
        *config.compensated_motion.numbers,
    ]  # fmt: skip
    fed_back = (3 if heading else 2) if config.gyro_bias_feedback else 0
    return Model(np.array(told), rows, np.array([*further.places, fed_back, heading], np.int64))


@njit
def settle(
    x: Array, P: Array, turned: Array, angle: Array, elapsed: Array, told: Array, rows: Array, places: Indices,
    turning: float,
) -> None:  # fmt: skip
    """Bring error states ``x`` (n,) and covariance ``P`` (n, n) up to the time of the attitude.

    ``turning`` is half of a variance that comes in beside, to each axis of the attitude. Half of all comes in before
    the transition, and half after.
    """
    n, T = len(x), elapsed[0]
    if not T > 0.0:
        return
    Phi, decay, half_noise, moved = np.zeros((3, n)), np.empty(n), np.empty(n), np.zeros((3, n))
    first = transition(turned, told[:3], T)
    for i in range(n):
        kept = math.exp(-T * rows[DECAY_RATE, i])
        decay[i] = kept
        half_noise[i] = 0.5 * T * rows[VARIANCE_RATE, i] + rows[VARIANCE, i] * (1 - kept * kept) / (1 + kept * kept)
        if i < STATES:
            for j in range(3):
                Phi[j, i] = first[j, i]
    misaligned(Phi, turned, angle[2] / elapsed[1], places[MISALIGNMENT])
    turn = (turned[2, 0] * angle[0] + turned[2, 1] * angle[1] + turned[2, 2] * angle[2]) / (elapsed[1] * T)
    elapsed[TURN_RATE] -= math.expm1(-T / TURN_MEMORY_S) * (turn - elapsed[TURN_RATE])
    for i in range(3):
        half_noise[PHI + i] += turning
    for i in range(3):
        for k in range(n):
            moved[i, 0] += Phi[i, k] * x[k]
    for i in range(n):
        x[i] = moved[i, 0] if i < 3 else decay[i] * x[i]
        P[i, i] += half_noise[i]
    for i in range(3):
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += Phi[i, k] * P[k, j]
            moved[i, j] = total
    for i in range(3):
        for j in range(i, 3):
            total = 0.0
            for k in range(n):
                total += moved[i, k] * Phi[j, k]
            P[i, j] = P[j, i] = total
        for j in range(3, n):
            P[i, j] = moved[i, j] * decay[j]
    take_rest(P, decay, 3, n)
    for i in range(n):
        P[i, i] += half_noise[i]
    for i in range(3):
        for j in range(3):
            turned[i, j] = 0.0
    elapsed[0] = 0.0


@inlined
def steady_force(
    q_nb: Array, force: Array, air_velocity_n: Array, air: Array, t: float, T: float
) -> tuple[Array, bool]:
    """Mean specific force (3,) over the period of ``T`` [s] that ends at ``t`` [s], less the acceleration that airspeed
    tells, and whether it told any; NaN where no time has passed.
    """
    f_n, told = np.empty(3), False
    if T > 0.0:
        acceleration = acceleration_n(air_velocity_n, air_velocity(q_nb, air, t), T)
        told = not math.isnan(acceleration[0])
        for i in range(3):
            f_n[i] = force[i] / T - acceleration[i] if told else force[i] / T
    else:
        f_n[0] = f_n[1] = f_n[2] = math.nan
    return f_n, told


@inlined
def air_velocity(q_nb: Array, air: Array, t: float) -> Array:
    """Velocity through the air (3,) at ``t`` [s], which points forward, NaN when unknown."""
    return quat_rotate(q_nb, np.array([true_airspeed(air, t), 0.0, 0.0]))


@inlined
def level_measurement(
    q_nb: Array, omega_b: Array, compensated: bool, told: Array, rows: Array, places: Indices
) -> tuple[Array, Array]:
    """H (2, n) and R (2,) of a levelling at the attitude ``q_nb`` and the rate ``omega_b``, with the acceleration
    taken off or without.
    """
    variance = told[FORCE_VARIANCE]
    if compensated:
        variance += told[AIRSPEED_VARIANCE] * dot(omega_b, omega_b)
    H = np.zeros((2, rows.shape[1]))
    for i in range(2):
        for j in range(PHI, PHI + 2):
            H[i, j] = rows[LEVEL_ROW + i, j]
    columns(H, q_nb, places[ACCEL_BIAS], places[GUST])
    return H, np.array([variance, variance])


@inlined
def level(
    q_nb: Array, gyro_bias: Array, air_velocity_n: Array, shown: Array, counts: Array, angle: Array, force: Array,
    elapsed: Array, x: Array, P: Array, told: Array, rows: Array, places: Indices, air: Array, commanded: bool,
    t: float, report: Array,
) -> bool:  # fmt: skip
    """Take the mean horizontal specific force of the period that ends at ``t`` [s] for tilt (equation 7).

    Whether the motion allowed it, level flight being ``commanded`` or not; if so the ``report`` (15,) is filled.
    """
    T = elapsed[1]
    f_n, compensated = steady_force(q_nb, force, air_velocity_n, air, t, T)
    omega_b = np.empty(3)
    for i in range(3):
        omega_b[i] = angle[i] / T - gyro_bias[i] if T > 0.0 else math.nan
    first = COMPENSATED if compensated else AS_IT_IS
    calm, straight, still = passes(f_n, omega_b, told[G], told[first : first + 4], shown)
    low = calm and straight and still and commanded
    if low:
        counts[LEVELLINGS] += 1.0
        H, R = level_measurement(q_nb, omega_b, compensated, told, rows, places)
        _fuse(x, P, H, R, f_n, report, t)
        report[0] = 0.0
    else:
        counts[CORRECTIONS] = 0.0
    return low


@njit
def _fuse(x: Array, P: Array, H: Array, R: Array, z: Array, report: Array, t: float) -> None:
    """Update the error states with the first m of ``z`` = H x + noise, ``H`` (m, n); no kind is put into ``report``."""
    m, n = H.shape
    nu = np.empty(m)
    for i in range(m):
        nu[i] = z[i]
        for j in range(n):
            nu[i] -= H[i, j] * x[j]
    S, nis = update(x, P, H, R, nu, math.inf)
    report[1], report[2] = t, nis
    for i in range(m):
        report[3 + i] = nu[i]
        for j in range(m):
            report[6 + m * i + j] = S[i, j]


@njit
def turn(
    whole: Array, n: int, told: Array, rows: Array, places: Indices, field_b: Array, report: Array, kind: int, t: float
) -> None:
    """Take the direction of the levelled field ``field_b`` (3,) for heading, and write a ``report`` of this ``kind``.

    Azimuth of C_nb_hat m_b less that of the reference m_n: -phi_D + m_D (m_N phi_N + m_E phi_E) / (m_N^2 + m_E^2).
    """
    q_nb, _, _, _, _, _, _, turned, angle, _, elapsed, _, x, P = parts(whole, n)
    settle(x, P, turned, angle, elapsed, told, rows, places, 0.0)
    field_n = quat_rotate(q_nb, field_b)
    z = math.atan2(field_n[1], field_n[0]) - told[AZIMUTH]
    if abs(z) > math.pi:
        z -= math.copysign(2 * math.pi, z)
    H, R = rows[HEADING_ROW : HEADING_ROW + 1], told[HEADING_VARIANCE : HEADING_VARIANCE + 1]
    _fuse(x, P, H, R, np.array([z]), report, t)
    report[0] = kind


@inlined
def outstanding(x: Array, P: Array, told: Array, places: Indices) -> tuple[bool, Array]:
    """Whether the attitude is to be corrected, and its error (3,); without a field that of the heading is zero.

    Nothing sees it then: what the filter thinks of it, and of its gyro, is a guess.
    """
    heading = x[PHI + 2] if places[SEES_HEADING] else 0.0
    return max(P[PHI, PHI], P[PHI + 1, PHI + 1]) < told[WELL_KNOWN], np.array([x[PHI], x[PHI + 1], heading])


@inlined
def correct(q_nb: Array, gyro_bias: Array, counts: Array, x: Array, step: Array, places: Indices) -> None:
    """Move a ``step`` (3,) of estimated errors into the attitude, and those of the gyros (equations 10, 11)."""
    turned = quat_normalise(quat_multiply(quat_from_rotvec(step), q_nb))  # C = (I + [phi x]) C_hat
    for i in range(4):
        q_nb[i] = turned[i]
    for i in range(3):
        x[PHI + i] -= step[i]
    counts[CORRECTIONS] += 1.0
    for i in range(places[FED_BACK]):
        gyro_bias[i] -= x[BIAS + i]
        x[BIAS + i] = 0.0


@inlined
def begin_period(
    q_nb: Array, air_velocity_n: Array, counts: Array, angle: Array, force: Array, elapsed: Array, sums: Array,
    air: Array, t: float, period: float,
) -> None:  # fmt: skip
    """Sum up anew from ``t`` [s] on; what ends then ends a whole number of periods later."""
    velocity = air_velocity(q_nb, air, t)
    for i in range(3):
        angle[i] = force[i] = 0.0
        air_velocity_n[i] = velocity[i]
        for j in range(3):
            sums[i, j] = 0.0
    elapsed[1] = elapsed[2] = elapsed[MISSING] = 0.0
    while counts[PERIOD_END] <= t + COINCIDENT:
        counts[PERIOD_END] += period


@inlined
def is_busy(busy: Array, start: float, end: float) -> bool:
    """Whether one of the times ``busy`` (M,), up to which no level flight was commanded, is from ``start`` to ``end``
    [s].
    """
    found = False
    for k in range(len(busy)):
        if start + COINCIDENT <= busy[k] < end + COINCIDENT:
            found = True
    return found


@njit
def advance(
    whole: Array, n: int, told: Array, rows: Array, places: Indices, air: Array, busy: Array,
    t: Array, dtheta: Array, dv: Array, dt: Array, last_bad: float, stops: bool, reports: Array,
) -> tuple[float, int, int]:  # fmt: skip
    """Take N increments, with the levellings on the way; when one was not usable last, how many ``reports`` (_, 15)
    were written, and how many increments were taken.

    The autopilot commanded something else than level flight up to the times ``busy`` (M,). From one most of which is
    missing nothing is taken for a level; where the tilt is `lost` at its end, no more increments are if it ``stops``.
    """
    (
        q_nb, gyro_bias, air_velocity_n, _, shown, counts, rates, turned, angle, force, elapsed, sums, x, P,
    ) = parts(whole, n)  # fmt: skip
    row = written = 0
    while row < len(t):
        stop = row
        while stop < len(t) and t[stop] < counts[PERIOD_END] - COINCIDENT:
            stop += 1
        ends = stop < len(t)
        if ends:
            stop += 1
        bad = propagate(
            q_nb, gyro_bias, told[:3], rates, turned, angle, force, elapsed, sums, P, dtheta[row:stop], dv[row:stop],
            dt[row:stop],
        )  # fmt: skip
        if bad >= 0:
            last_bad = max(last_bad, t[row + bad])
        row = stop
        if ends and stops and lost(P):
            return last_bad, written, row
        if ends:
            now = t[row - 1]
            settle(x, P, turned, angle, elapsed, told, rows, places, 0.0)
        if ends and not shows_nothing(elapsed):
            commanded = not is_busy(busy, now - elapsed[1], now)
            low = level(
                q_nb, gyro_bias, air_velocity_n, shown, counts, angle, force, elapsed, x, P, told, rows, places, air,
                commanded, now, reports[written],
            )  # fmt: skip
            if low:
                written += 1
                known, phi = outstanding(x, P, told, places)
                if known:
                    correct(q_nb, gyro_bias, counts, x, limited(phi, told[PHI_LIMIT]), places)
        if ends:
            begin_period(q_nb, air_velocity_n, counts, angle, force, elapsed, sums, air, now, told[PERIOD])
    return last_bad, written, row


@njit
def shows_nothing(elapsed: Array) -> bool:
    """Whether most of a period's increments are missing."""
    return bool(elapsed[MISSING] > 0.5 * elapsed[1])


@njit
def lost(P: Array) -> bool:
    """Whether as good as nothing is known of roll or pitch: increments were missing for long."""
    return bool(max(P[PHI, PHI], P[PHI + 1, PHI + 1]) > AS_GOOD_AS * ANYHOW)


@njit
def follow(
    whole: Array, n: int, told: Array, rows: Array, places: Indices, air: Array, busy: Array,
    t: Array, dt: Array, dtheta: Array, dv: Array, row: int, now: float, longest: float, last_bad: float,
    steps: Array, reports: Array, estimates: Array, when: Array,
) -> tuple[int, int, float, float, int, int]:  # fmt: skip
    """Take ``steps`` (K, WIDTH) of a levelled filter, in place on all that is handed over, as far as they are plain.

    The increments as of `nav.increments.Increments`, from ``row`` on. Into ``reports`` (_, `REPORT`), which have room
    for those of what is predicted as well, ``estimates`` (_, whole) and ``when`` (_, 2), of each of these its time and
    that of the last bad increment. Returned are steps, the first row that is left, the time reached, that of the last
    bad increment, reports and estimates. Where the tilt is `lost` no further step is taken.
    """
    one_t, one_dt, one_angle, one_push = np.empty(1), np.empty(1), np.empty((1, 3)), np.empty((1, 3))
    _, _, _, _, _, counts, _, _, _, _, _, _, _, P = parts(whole, n)
    written = drafted = some = 0
    then = now
    for k in range(len(steps)):
        time, what = steps[k, TIME], int(steps[k, WHAT])
        if what >= 0 and now > time + COINCIDENT:  # too late
            return k, row, now, last_bad, written, drafted
        stop = row_after(t, steps[k, HORIZON], row)
        if stop > row:
            last_bad, some, came = advance(  # not with literals, for each of which it would be compiled anew
                whole, n, told, rows, places, air, busy, t[row:stop], dtheta[row:stop], dv[row:stop],
                dt[row:stop], last_bad, stop > row, reports[written:],
            )  # fmt: skip
            row, now, written = row + came, t[row + came - 1], written + some
            if lost(P) and now >= counts[PERIOD_END] - COINCIDENT:
                return k, row, now, last_bad, written, drafted
        if what == ADVANCE:
            continue
        state, partly, part, of_row, bad = whole, False, 0.0, row, last_bad
        if what == ESTIMATE:
            if now > time + COINCIDENT:
                return k, row, now, last_bad, written, drafted
            stop = row if abs(time - now) <= COINCIDENT else row_after(t, time, row)
            further = 0.0 if abs(time - now) <= COINCIDENT else time - max(t[stop - 1], now)
            if further > longest + COINCIDENT:
                return k, row, now, last_bad, written, drafted
            state, of_row, then = estimates[drafted], stop - 1, now if stop == row else t[stop - 1]
            for i in range(len(whole)):
                state[i] = whole[i]
            bad, some, came = advance(
                state, n, told, rows, places, air, busy, t[row:stop], dtheta[row:stop], dv[row:stop], dt[row:stop],
                last_bad, stop < row, reports[written:],
            )  # fmt: skip
            if further > COINCIDENT:
                partly, part, then = True, further / dt[of_row], time
        elif time > now + COINCIDENT and row < len(t):
            partly, part = True, 1 - (t[row] - time) / dt[row]
        if partly:
            share(one_dt, one_angle, one_push, dt, dtheta, dv, of_row, part)
            one_t[0] = time
            bad, some, came = advance(
                state, n, told, rows, places, air, busy, one_t, one_angle, one_push, one_dt, bad, what != ESTIMATE,
                reports[written:],
            )  # fmt: skip
        if what == ESTIMATE:
            _, _, _, _, _, _, _, turned, angle, _, elapsed, _, x, own = parts(state, n)
            settle(x, own, turned, angle, elapsed, told, rows, places, 0.0)
            when[drafted, 0], when[drafted, 1] = then, bad
            drafted += 1
            continue
        if partly:
            take_off(one_dt, one_angle, one_push, dt, dtheta, dv, row)
            now, last_bad, written = time, bad, written + some
            if lost(P) and now >= counts[PERIOD_END] - COINCIDENT:
                return k, row, now, last_bad, written, drafted
        numbers = steps[k, NUMBERS:]
        if what == MAGNETIC:
            turn(whole, n, told, rows, places, numbers[:3], reports[written], int(numbers[3]), time)
            written += 1
        elif what == DENSITY:
            air[0] = numbers[0]
        elif math.isnan(numbers[0]):
            air[2] = -math.inf
        else:
            add_eas(air, time, numbers[0], told[SMOOTHING])
    return len(steps), row, now, last_bad, written, drafted
