"""Strapdown navigation: inertial increments to attitude, velocity and position in north-east-down on WGS84.

`step` takes one interval in which body rate and specific force are constant in body axes; for such an interval its
attitude is exact and its velocity exact to second order in the slow rotation of n. Real motion is not constant over an
interval: `compensate` turns raw increments into those of the equivalent constant motion. The rotation of specific
force *within* the interval (the ``dtheta x dv / 2`` term and all its higher orders) belongs to `step`, which applies
it exactly, as the left Jacobian of ``dtheta``. It is therefore not part of `compensate`, and a compensated interval
can be split linearly in time.

Sources: Savage, Strapdown Inertial Navigation Integration Algorithm Design, J. Guidance 21 (1998), parts 1 and 2;
Groves, 2nd ed., chapter 5.
"""

from __future__ import annotations

import math

import numpy as np

from nav._jit import lean, njit
from nav.earth import E2, GRAVITY_EQUATOR, OMEGA_IE, SOMIGLIANA_K, A, F, M, wrap_longitude
from nav.rotation import rotation_coefficients
from nav.samples import Array, ImuSamples


@lean
def step(q_nb: Array, v_n: Array, lla: Array, dtheta: Array, dv: Array, dt: float) -> None:
    """Advance ``q_nb`` (4,), ``v_n`` (3,) [m/s] and ``lla`` [lat, lon, h] in place by one IMU interval.

    ``dtheta`` (3,) [rad] and ``dv`` (3,) [m/s] are free of bias and compensated; ``dt`` [s] is the interval's length.

    v+ = v + (I - [omega_in dt x]/2) C_nb J(dtheta) dv + (g - (2 omega_ie + omega_en) x v) dt
    q+ = exp(-omega_in dt/2) q exp(dtheta/2)

    with gravity and the Earth's and transport rates at the middle of the interval, and position by the trapezoid of
    velocity. Valid away from the poles.
    """
    w, x, y, z = q_nb[0], q_nb[1], q_nb[2], q_nb[3]
    ax, ay, az = dtheta[0], dtheta[1], dtheta[2]
    ux, uy, uz = dv[0], dv[1], dv[2]

    # dv in the body axes of the interval's start: u + b a x u + c a x (a x u)
    angle2 = ax * ax + ay * ay + az * az
    _, b, c = rotation_coefficients(angle2)
    px, py, pz = ay * uz - az * uy, az * ux - ax * uz, ax * uy - ay * ux
    ux += b * px + c * (ay * pz - az * py)
    uy += b * py + c * (az * px - ax * pz)
    uz += b * pz + c * (ax * py - ay * px)

    # ... and in the n axes of the start
    tx, ty, tz = 2 * (y * uz - z * uy), 2 * (z * ux - x * uz), 2 * (x * uy - y * ux)
    dv_north = ux + w * tx + y * tz - z * ty
    dv_east = uy + w * ty + z * tx - x * tz
    dv_down = uz + w * tz + x * ty - y * tx

    # Middle of the interval. The radius in its latitude needs no ellipsoid: half a step is a fraction of a metre.
    half = 0.5 * dt
    h = lla[2] - half * v_n[2]
    lat = lla[0] + half * v_n[0] / (A + h)
    sin_lat, cos_lat = math.sin(lat), math.cos(lat)
    sin2 = sin_lat * sin_lat
    root2 = 1 - E2 * sin2
    root = math.sqrt(root2)
    ratio = h / A
    g = GRAVITY_EQUATOR * (1 + SOMIGLIANA_K * sin2) / root
    g *= 1 - 2 * (1 + F + M - 2 * F * sin2) * ratio + 3 * ratio * ratio
    north_radius = A * (1 - E2) / (root2 * root) + h
    east_radius = A / root + h

    # Velocity: specific force seen half-way through the turn of n, Coriolis, gravity. Rates want the velocity in the
    # middle of the interval, which is half of what they help to find: from that of the start, two rounds do.
    earth_north, earth_down = OMEGA_IE * cos_lat * dt, -OMEGA_IE * sin_lat * dt
    per_north, per_east, tan_lat = dt / north_radius, dt / east_radius, sin_lat / cos_lat
    mid_north, mid_east, mid_down = v_n[0], v_n[1], v_n[2]
    nx, ny, nz = 0.0, 0.0, 0.0  # angles that n turns relative to i, in n
    for _ in range(2):
        nx = earth_north + mid_east * per_east
        ny = -mid_north * per_north
        nz = earth_down - mid_east * per_east * tan_lat
        cx, cz = nx + earth_north, nz + earth_down
        gain_north = dv_north - 0.5 * (ny * dv_down - nz * dv_east) - (ny * mid_down - cz * mid_east)
        gain_east = dv_east - 0.5 * (nz * dv_north - nx * dv_down) - (cz * mid_north - cx * mid_down)
        gain_down = dv_down - 0.5 * (nx * dv_east - ny * dv_north) - (cx * mid_east - ny * mid_north) + g * dt
        mid_north, mid_east, mid_down = v_n[0] + 0.5 * gain_north, v_n[1] + 0.5 * gain_east, v_n[2] + 0.5 * gain_down

    # Position by the trapezoid of velocity, which is what the middle stands for
    lla[0] += mid_north * per_north
    lla[1] = wrap_longitude(lla[1] + mid_east * per_east / cos_lat)
    lla[2] -= mid_down * dt
    v_n[0] += gain_north
    v_n[1] += gain_east
    v_n[2] += gain_down

    # Attitude: the body's turn on the right (any size), the turn of n on the left (micro-radians)
    quarter = 0.25 * angle2
    sinc, versine, _ = rotation_coefficients(quarter)
    ew, k = 1 - quarter * versine, 0.5 * sinc
    ex, ey, ez = k * ax, k * ay, k * az
    w, x, y, z = (
        w * ew - x * ex - y * ey - z * ez,
        w * ex + x * ew + y * ez - z * ey,
        w * ey - x * ez + y * ew + z * ex,
        w * ez + x * ey - y * ex + z * ew,
    )
    ew, ex, ey, ez = 1 - 0.125 * (nx * nx + ny * ny + nz * nz), -0.5 * nx, -0.5 * ny, -0.5 * nz
    w, x, y, z = (
        ew * w - ex * x - ey * y - ez * z,
        ew * x + ex * w + ey * z - ez * y,
        ew * y - ex * z + ey * w + ez * x,
        ew * z + ex * y - ey * x + ez * w,
    )
    scale = 1.5 - 0.5 * (w * w + x * x + y * y + z * z)  # one Newton step to unit norm: it left it by rounding only
    q_nb[0], q_nb[1], q_nb[2], q_nb[3] = scale * w, scale * x, scale * y, scale * z


@njit
def propagate(q_nb: Array, v_n: Array, lla: Array, dtheta: Array, dv: Array, dt: Array) -> None:
    """`step` in place over N intervals: ``dtheta`` (N, 3), ``dv`` (N, 3), ``dt`` (N,)."""
    for k in range(len(dt)):
        step(q_nb, v_n, lla, dtheta[k], dv[k], dt[k])


def compensate(imu: ImuSamples, previous: ImuSamples | None = None) -> ImuSamples:
    """Two-sample coning and sculling compensation of raw increments.

    dtheta' = dtheta + dtheta_prev x dtheta / 12
    dv'     = dv + (dtheta_prev x dv + dv_prev x dtheta) / 12

    for body rate and specific force that change linearly over two equal intervals. ``dtheta'`` is then the rotation
    vector of the interval, ``dv'`` the equivalent constant specific force times ``dt``, as `step` wants them.

    ``previous`` holds the raw samples before this block (its last one is used), so that blocks join without a seam;
    without it the first interval is left as it is. For raw increments of motion that is not constant over the
    interval; increments that are rotation vectors already would be compensated twice.
    """
    if len(imu) == 0:
        return imu
    before = (
        (np.zeros(3), np.zeros(3)) if previous is None or not len(previous) else (previous.dtheta[-1], previous.dv[-1])
    )
    increments = np.ascontiguousarray(imu.dtheta), np.ascontiguousarray(imu.dv)
    return ImuSamples(imu.t, imu.dt, *_compensated(*increments, *before))


@njit
def _compensated(dtheta: Array, dv: Array, dtheta_0: Array, dv_0: Array) -> tuple[Array, Array]:
    """`compensate` of increments (N, 3), the ones before them (3,)."""
    turned, gained = dtheta.copy(), dv.copy()
    for k in range(len(dtheta)):
        for j in range(3):
            one, two = (j + 1) % 3, (j + 2) % 3
            coning = dtheta_0[one] * dtheta[k, two] - dtheta_0[two] * dtheta[k, one]
            sculling = dtheta_0[one] * dv[k, two] - dtheta_0[two] * dv[k, one]
            sculling += dv_0[one] * dtheta[k, two] - dv_0[two] * dtheta[k, one]
            turned[k, j] += coning / 12
            gained[k, j] += sculling / 12
        dtheta_0, dv_0 = dtheta[k], dv[k]
    return turned, gained
