"""Aids: what each one measures, as innovation and Jacobian at the nominal state, and which samples are not fit to use.

Every function returns ``nu`` (m,) = measurement - prediction and ``H`` (m, n) = d prediction / d error state, error
being estimate - truth; ``x`` (n,) holds the estimated values of the states beyond the motion (`nav.error_model`), and
an argument named after a block is the index where it begins, -1 when the model has none. Lever arms point from the
inertial sensor to the aid's, in body axes [m].
"""

from __future__ import annotations

import math

import numpy as np

from nav._jit import njit
from nav.earth import (
    SEA_LEVEL_DENSITY,
    displacement_n,
    earth_rate_n,
    isa_density,
    quat_en,
    quat_ie,
    radii,
    wrap_longitude,
)
from nav.error_model import PHI, POS, VEL, Drive, Indices
from nav.rotation import cross, dcm_from_quat, quat_conjugate, quat_multiply, quat_rotate, rotvec_from_quat
from nav.samples import (
    AirspeedSample,
    Array,
    BarometerSample,
    BodyVelocitySample,
    GnssSample,
    MagnetometerSample,
    PositionSample,
    Sample,
    StarSample,
)

# What an instrument could possibly report; beyond it the sample is broken.
HEIGHT_LIMITS = (-1000.0, 50_000.0)  # [m]
SPEED_LIMIT = 600.0  # over ground [m/s]
PRESSURE_LIMITS = (1_000.0, 120_000.0)  # [Pa]
FIELD_LIMITS = (5e-6, 200e-6)  # magnitude; the Earth's is 22 to 67 uT [T]
AIRSPEED_LIMITS = (-10.0, 300.0)  # [m/s]
NORM_LIMITS = (0.999, 1.001)  # of an attitude quaternion

SIDEWAYS = np.array([1, 2])  # the body axes along which a wheeled vehicle does not move


def problem(sample: Sample) -> str:
    """Why ``sample`` must not be fused, empty when it is sound. A GNSS sample may lack velocity (NaN) altogether."""
    if not math.isfinite(sample.t):
        return "time is not finite"
    match sample:
        case GnssSample():
            return _gnss_problem(sample)
        case BarometerSample():
            return _range_problem("pressure", sample.pressure, PRESSURE_LIMITS)
        case MagnetometerSample():
            return _range_problem("field", math.hypot(*sample.field_b), FIELD_LIMITS)
        case AirspeedSample():
            return _range_problem("airspeed", sample.eas, AIRSPEED_LIMITS)
        case BodyVelocitySample():
            return _body_velocity_problem(sample.v_b)
        case StarSample():
            return _range_problem("norm of the quaternion", math.hypot(*sample.q_ib.tolist()), NORM_LIMITS)
        case PositionSample():
            return _position_problem(sample.lat, sample.lon, 0.0 if math.isnan(sample.h) else sample.h)


def _range_problem(what: str, value: float, limits: tuple[float, float]) -> str:
    if not math.isfinite(value):
        return f"{what} is not finite"
    return "" if limits[0] <= value <= limits[1] else f"{what} {value:.6g} is out of range"


def _position_problem(lat: float, lon: float, h: float) -> str:
    if not (math.isfinite(lat) and math.isfinite(lon) and math.isfinite(h)):
        return "position is not finite"
    if abs(lat) > math.pi / 2 or abs(lon) > 2 * math.pi:
        return "position is out of range"
    return "" if HEIGHT_LIMITS[0] <= h <= HEIGHT_LIMITS[1] else f"height {h:.6g} is out of range"


def _body_velocity_problem(v_b: Array) -> str:
    """Axes that are not measured are NaN; which they may be, only the filter knows (`measures`)."""
    measured = [v for v in v_b.tolist() if not math.isnan(v)]
    if not measured:
        return "velocity is not finite"
    return _range_problem("speed", math.hypot(*measured), (0.0, SPEED_LIMIT))


def measures(sample: BodyVelocitySample, axes: Indices) -> bool:
    """Whether a sound sample has a number on each of the body ``axes``."""
    return all(math.isfinite(v) for v in sample.v_b[axes].tolist())


def _gnss_problem(sample: GnssSample) -> str:
    if trouble := _position_problem(sample.lat, sample.lon, sample.h):
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
    return all(0.0 < s < math.inf for s in sigma.tolist())


def has_velocity(sample: GnssSample) -> bool:
    """Whether a sound GNSS sample carries velocity."""
    return math.isfinite(sample.v_n[0])


@njit
def gnss_position(
    q_nb: Array, lla: Array, x: Array, arm_b: Array, gnss_position_error: int, lat: float, lon: float, h: float
) -> tuple[Array, Array]:
    """Antenna position [m], NED: p + C_nb arm_b + correlated receiver error."""
    arm_n = quat_rotate(q_nb, arm_b)
    nu = displacement_n(lat, lon, h, lla[0], lla[1], lla[2])
    H = np.zeros((3, len(x)))
    _put_skew(H, arm_n)
    for i in range(3):
        H[i, POS + i] = 1.0
        nu[i] -= arm_n[i]
        if gnss_position_error >= 0:
            H[i, gnss_position_error + i] = 1.0
            nu[i] -= x[gnss_position_error + i]
    return nu, H


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
    C_nb = dcm_from_quat(q_nb)
    gain, omega_b = np.empty(3), np.empty(3)
    for i in range(3):
        gain[i] = 1 / (1 + errors[Drive.GYRO_SCALE, i])
        omega_b[i] = (omega_measured_b[i] - errors[Drive.GYRO, i]) * gain[i]
    arm_n = quat_rotate(q_nb, arm_b)
    swing_n = quat_rotate(q_nb, cross(omega_b, arm_b))
    earth_n = earth_rate_n(lla[0])
    carried_n = cross(earth_n, arm_n)
    nu = np.empty(3)
    H = np.zeros((3, len(x)))
    _put_skew(H, swing_n)
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
                    from_gyro = (C_nb[i, one] * arm_b[two] - C_nb[i, two] * arm_b[one]) * gain[j]
                    H[i, start + j] = from_gyro if kind == Drive.GYRO else from_gyro * omega_b[j]
    return nu, H


@njit
def barometer(lla: Array, x: Array, barometer_bias: int, pressure_altitude: float) -> tuple[Array, Array]:
    """Pressure altitude [m]: h + bias."""
    nu = np.array([pressure_altitude - lla[2] - x[barometer_bias]])
    H = np.zeros((1, len(x)))
    H[0, POS + 2] = -1.0
    H[0, barometer_bias] = 1.0
    return nu, H


@njit
def magnetometer(
    q_nb: Array, x: Array, bias: int, error: int, anomaly: int, field_n: Array, field_b: Array
) -> tuple[Array, Array]:
    """Magnetic field [T] in body axes: C_nb' (field_n + anomaly) + bias + error, ``field_n`` the reference field there.

    ``bias`` and ``error`` are fixed to the body, ``anomaly`` to n; each is where its states begin, -1 for none.
    """
    C_nb = dcm_from_quat(q_nb)
    H = np.zeros((3, len(x)))
    nu = np.zeros(3)
    m0, m1, m2 = field_n[0], field_n[1], field_n[2]
    if anomaly >= 0:
        m0, m1, m2 = m0 + x[anomaly], m1 + x[anomaly + 1], m2 + x[anomaly + 2]
    for i in range(3):
        c0, c1, c2 = C_nb[0, i], C_nb[1, i], C_nb[2, i]
        nu[i] = field_b[i] - (c0 * m0 + c1 * m1 + c2 * m2)
        # -C_nb' [field x]
        H[i, PHI] = c2 * m1 - c1 * m2
        H[i, PHI + 1] = c0 * m2 - c2 * m0
        H[i, PHI + 2] = c1 * m0 - c0 * m1
        if anomaly >= 0:
            H[i, anomaly], H[i, anomaly + 1], H[i, anomaly + 2] = c0, c1, c2
        for start in (bias, error):
            if start >= 0:
                H[i, start + i] = 1.0
                nu[i] -= x[start + i]
    return nu, H


@njit
def airspeed(
    q_nb: Array, v_n: Array, lla: Array, x: Array, wind: int, gust: int, airspeed_scale: int, eas: float
) -> tuple[Array, Array]:
    """Equivalent airspeed along body x [m/s]: (1 + scale) sqrt(rho / rho0) e_x . C_nb' (v - wind - gust).

    The density rho is the standard atmosphere's at the estimated height.
    """
    C_nb = dcm_from_quat(q_nb)
    scale = x[airspeed_scale] if airspeed_scale >= 0 else 0.0
    root = (1 + scale) * math.sqrt(isa_density(lla[2]) / SEA_LEVEL_DENSITY)
    nu, H = _air_velocity(C_nb[:, 0], v_n, x, wind, gust)
    predicted = -root * nu[0]
    for i in range(len(x)):
        H[0, i] *= root
    nu[0] = eas - predicted
    half_lapse = 0.25 * math.log(isa_density(lla[2] + 1.0) / isa_density(lla[2] - 1.0))  # of density, per metre up
    H[0, POS + 2] = -predicted * half_lapse
    if airspeed_scale >= 0:
        H[0, airspeed_scale] = predicted / (1 + scale)
    return nu, H


@njit
def sideslip(q_nb: Array, v_n: Array, x: Array, wind: int, gust: int) -> tuple[Array, Array]:
    """The constraint that no air comes from the side: 0 = e_y . C_nb' (v - wind - gust) [m/s]."""
    return _air_velocity(dcm_from_quat(q_nb)[:, 1], v_n, x, wind, gust)


@njit
def _air_velocity(axis_n: Array, v_n: Array, x: Array, wind: int, gust: int) -> tuple[Array, Array]:
    """Zero minus the velocity through the air along a body axis ``axis_n`` (3,), and the Jacobian of that velocity."""
    air_n, along_n = np.empty(3), np.empty(3)
    H = np.zeros((1, len(x)))
    for i in range(3):
        air_n[i], along_n[i] = v_n[i], axis_n[i]
    for start in (wind, gust):
        if start >= 0:
            for i in range(2):
                air_n[i] -= x[start + i]
                H[0, start + i] = -along_n[i]
    turned = cross(air_n, along_n)
    nu = np.zeros(1)
    for i in range(3):
        H[0, PHI + i], H[0, VEL + i] = turned[i], along_n[i]
        nu[0] -= along_n[i] * air_n[i]
    return nu, H


@njit
def body_velocity(
    q_nb: Array,
    v_n: Array,
    lla: Array,
    x: Array,
    omega_measured_b: Array,
    errors: Array,
    driven: Indices,
    arm_b: Array,
    axes: Indices,
    scale: int,
    error: int,
    v_b: Array,
) -> tuple[Array, Array]:
    """Velocity over ground along the m body ``axes`` [m/s], one row for each: (1 + scale) e . C_nb' v_s + error.

    v_s = v + C_nb (omega_ib x arm) - omega_ie x (C_nb arm) is the sensor's, see `gnss_velocity`. ``v_b`` (3,) is what
    was measured. The blocks ``scale`` and ``error`` have a state for each row, in the same order. By an odometer,
    axes = [0]: forward speed. Cui et al. 2022, equations 50-52, with the difference taken in body axes.
    """
    C_nb = dcm_from_quat(q_nb)
    nu = np.empty(len(axes))
    H = np.zeros((len(axes), len(x)))
    point_n, swing = v_n, H  # velocity of the sensor, and its Jacobian where it isn't that of the IMU's
    swings = arm_b[0] != 0.0 or arm_b[1] != 0.0 or arm_b[2] != 0.0
    if swings:
        behind, swing = gnss_velocity(q_nb, v_n, lla, x, omega_measured_b, errors, driven, arm_b, -1, np.zeros(3))
        point_n = -behind
        for i in range(3):
            swing[i, VEL + i] = 0.0
    for row in range(len(axes)):
        axis = axes[row]
        along_n = np.array([C_nb[0, axis], C_nb[1, axis], C_nb[2, axis]])
        speed = along_n[0] * point_n[0] + along_n[1] * point_n[1] + along_n[2] * point_n[2]
        gain = 1 + x[scale + row] if scale >= 0 else 1.0
        turned = cross(point_n, along_n)
        nu[row] = v_b[axis] - gain * speed
        for i in range(3):
            H[row, PHI + i], H[row, VEL + i] = gain * turned[i], gain * along_n[i]
        if swings:
            for i in range(3):
                for j in range(len(x)):
                    H[row, j] += gain * along_n[i] * swing[i, j]
        if scale >= 0:
            H[row, scale + row] = speed
        if error >= 0:
            H[row, error + row] = 1.0
            nu[row] -= x[error + row]
    return nu, H


def nonholonomic(
    q_nb: Array, v_n: Array, lla: Array, x: Array, omega_measured_b: Array, errors: Array, driven: Indices, arm_b: Array
) -> tuple[Array, Array]:
    """The constraint of wheels, neither sideways nor off the ground: 0 = (e_y, e_z) . C_nb' v_s [m/s].

    It acts where the sensor of the wheels does, v_s as of `body_velocity`.
    """
    return body_velocity(
        q_nb, v_n, lla, x, omega_measured_b, errors, driven, arm_b, SIDEWAYS, -1, -1, np.zeros(3)
    )  # fmt: skip


@njit
def star_attitude(q_nb: Array, lla: Array, x: Array, t: float, q_ib: Array) -> tuple[Array, Array]:
    """Rotation (3,) [rad], body axes, from the estimated to the measured attitude in i, which was e at t = 0.

    nu = log(C_ib_hat' C_ib) = C_nb' (phi - dtheta) with C_ib_hat = C_ie(t) C_en_hat C_nb_hat, where the position error
    turns n by dtheta = (dE / (R_N + h), -dN / (R_M + h), -dE tan(lat) / (R_N + h)). Cui et al. 2022,
    equations 17-33 (their C_dP, here for metres north-east-down and our phi).
    """
    predicted = quat_multiply(quat_ie(t), quat_multiply(quat_en(lla[0], lla[1]), q_nb))
    nu = rotvec_from_quat(quat_multiply(quat_conjugate(predicted), q_ib))
    C_nb = dcm_from_quat(q_nb)
    R_M, R_N = radii(lla[0])
    north, east = 1 / (R_M + lla[2]), 1 / (R_N + lla[2])
    H = np.zeros((3, len(x)))
    for i in range(3):
        for j in range(3):
            H[i, PHI + j] = -C_nb[j, i]
        H[i, POS] = -C_nb[1, i] * north
        H[i, POS + 1] = (C_nb[0, i] - C_nb[2, i] * math.tan(lla[0])) * east
    return nu, H


@njit
def position_fix(
    q_nb: Array, lla: Array, x: Array, arm_b: Array, lat: float, lon: float, h: float
) -> tuple[Array, Array]:
    """The sensor's position [m], north, east and, unless ``h`` is NaN, down: p + C_nb arm_b."""
    rows = 2 if math.isnan(h) else 3
    nu, H = gnss_position(q_nb, lla, x, arm_b, -1, lat, lon, lla[2] if rows == 2 else h)
    return nu[:rows], H[:rows]


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
        ground2, air2 = v_n[0] * v_n[0] + v_n[1] * v_n[1], air_n * air_n + air_e * air_e
        predicted += math.atan2(v_n[1], v_n[0]) - math.atan2(air_e, air_n)
        H[0, VEL], H[0, VEL + 1] = air_e / air2 - v_n[1] / ground2, v_n[0] / ground2 - air_n / air2
        for start in (wind, gust):
            if start >= 0:
                H[0, start], H[0, start + 1] = -air_e / air2, air_n / air2
    return np.array([wrap_longitude(math.atan2(antenna_v_n[1], antenna_v_n[0]) - predicted)]), H


@njit
def _put_skew(H: Array, v: Array) -> None:
    """Write [v x] into the columns of the attitude."""
    for j in range(3):
        one, two = (j + 1) % 3, (j + 2) % 3
        H[one, PHI + two], H[two, PHI + one] = -v[j], v[j]
