"""From true increments to those of a unit, tick by tick and sample by sample: the kernels of `testbed.sensors.imu`."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from nav._jit import njit
from nav.samples import Array

Triple: TypeAlias = tuple[float, float, float]


@njit
def _cross(a: Triple, b: Triple) -> Triple:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit
def _lever_arm(phi: Triple, rate0: Triple, rate1: Triple, r: Triple) -> Triple:
    """Velocity increment [m/s] of a point at ``r`` [m] relative to the body's origin, over one tick.

    The point moves at u = omega x r. Its inertial velocity change, taken into rotating body axes as that of the origin
    is (by the inverse of the left Jacobian J of phi = dtheta), is
    J^-1 (exp(phi) u1 - u0) = (u1 - u0) + phi x (u0 + u1)/2 + c phi x (phi x (u1 - u0)),
    c = (1 - |phi|/2 cot(|phi|/2)) / |phi|^2 = 1/12 + |phi|^2/720 + ...

    This is alpha x r and omega x (omega x r) in increments, exactly.
    """
    mean = _cross((0.5 * (rate0[0] + rate1[0]), 0.5 * (rate0[1] + rate1[1]), 0.5 * (rate0[2] + rate1[2])), r)
    change = _cross((rate1[0] - rate0[0], rate1[1] - rate0[1], rate1[2] - rate0[2]), r)
    square = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    c = 1.0 / 12.0 + square / 720.0 + square * square / 30240.0
    turned = _cross(phi, mean)
    twice = _cross(phi, _cross(phi, change))
    return (
        change[0] + turned[0] + c * twice[0],
        change[1] + turned[1] + c * twice[1],
        change[2] + turned[2] + c * twice[2],
    )


@njit
def accumulate(
    tick: int,
    every: int,
    tick_s: float,
    dtheta: Array,
    dv: Array,
    omega_b: Array,
    engine_rpm: Array,
    lever: Array,
    vibration: Array,
    rectified: Array,
    low_pass: Array,
    bandwidth: Array,
    sampled: bool,
    sensitivity: Array,
    g_sensitivity: Array,
    asymmetry: Array,
    state: Array,
    total: Array,
    last: Array,
    out: Array,
) -> None:
    """Deterministic part of the chain: sensed increments of each output interval into ``out`` (n, 6).

    They are sums, or, ``sampled``, the filters' output at the end of the interval held over all of it: then vibration
    has the phase of that moment, and folds. Of vibration both are given what filters of this ``bandwidth`` (2,) [Hz]
    leave of its size: it may be faster than ticks, whose mean is another.
    ``rectified`` (6,) is the bias that vibration makes, per fourth power of the engine speed.
    ``state`` (6, 2) of the filters, ``total`` (6,) of the running interval and ``last`` (4,), rate and engine phase at
    the last tick, are carried from call to call.
    """
    has_lever = lever[0] != 0.0 or lever[1] != 0.0 or lever[2] != 0.0
    has_vibration = False
    for i in range(6):
        if vibration[0, i, 0] != 0.0 or vibration[0, i, 1] != 0.0:
            has_vibration = True
    x = np.empty(6)
    y = np.empty(6)
    tone = np.zeros(6)
    drift = np.zeros(6)
    j = 0
    for k in range(dtheta.shape[0]):
        if tick + k == 0:
            last[0], last[1], last[2] = omega_b[0, 0], omega_b[0, 1], omega_b[0, 2]
            continue
        for i in range(3):
            x[i] = dtheta[k, i]
            x[3 + i] = dv[k, i]
        if has_lever:
            rate = (omega_b[k, 0], omega_b[k, 1], omega_b[k, 2])
            moved = _lever_arm((x[0], x[1], x[2]), (last[0], last[1], last[2]), rate, (lever[0], lever[1], lever[2]))
            for i in range(3):
                x[3 + i] += moved[i]
                last[i] = omega_b[k, i]
        if has_vibration and engine_rpm[k] > 0.0:
            # integral of a cos(phase + offset) over the tick, for one and two per rev
            turn = 2.0 * math.pi * engine_rpm[k] / 60.0 * tick_s
            middle = last[3] + 0.5 * turn
            size = engine_rpm[k] * engine_rpm[k] * tick_s
            c1, s1 = math.cos(middle), math.sin(middle)
            half = math.sin(0.5 * turn)
            one = size * half / (0.5 * turn)
            two = size * (2.0 * half * math.cos(0.5 * turn)) / turn
            c2, s2 = c1 * c1 - s1 * s1, 2.0 * c1 * s1
            if not sampled:
                for i in range(6):
                    share = (engine_rpm[k] / 60.0 / bandwidth[i // 3]) ** 2
                    tone[i] = one / math.sqrt(1.0 + share**2) * (vibration[0, i, 0] * c1 - vibration[0, i, 1] * s1)
                    share *= 4.0
                    tone[i] += two / math.sqrt(1.0 + share**2) * (vibration[1, i, 0] * c2 - vibration[1, i, 1] * s2)
            last[3] = (last[3] + turn) % (2.0 * math.pi)
            for i in range(6):
                drift[i] = rectified[i] * engine_rpm[k] ** 4 * tick_s
        else:
            tone[:] = drift[:] = 0.0
        for i in range(6):
            m = low_pass[i // 3]
            if tick + k == 1:
                state[i, 0] = x[i]
            y[i] = m[2, 0] * state[i, 0] + m[2, 1] * state[i, 1] + m[2, 2] * x[i]
            a = m[0, 0] * state[i, 0] + m[0, 1] * state[i, 1] + m[0, 2] * x[i]
            state[i, 1] = m[1, 0] * state[i, 0] + m[1, 1] * state[i, 1] + m[1, 2] * x[i]
            state[i, 0] = a
            if not sampled:
                y[i] += tone[i]
        due = (tick + k) % every == 0
        if sampled:
            if not due:
                continue
            if has_vibration:
                _tones(engine_rpm[k], last[3], vibration, bandwidth, tone)
            for i in range(6):
                filtered = state[i, 0] if math.isfinite(bandwidth[i // 3]) else x[i]
                y[i] = every * (filtered + tone[i] * tick_s)
        for i in range(3):
            w = sensitivity[0, i, 0] * y[0] + sensitivity[0, i, 1] * y[1] + sensitivity[0, i, 2] * y[2]
            f = sensitivity[1, i, 0] * y[3] + sensitivity[1, i, 1] * y[4] + sensitivity[1, i, 2] * y[5]
            g = g_sensitivity[i, 0] * y[3] + g_sensitivity[i, 1] * y[4] + g_sensitivity[i, 2] * y[5]
            total[i] += w + asymmetry[i] * abs(w) + g
            total[3 + i] += f + asymmetry[3 + i] * abs(f)
        if due:
            for i in range(6):
                out[j, i] = total[i] + (every * drift[i] if drift[i] != 0.0 else 0.0)
                total[i] = 0.0
            j += 1


@njit
def _tones(rpm: float, phase: float, vibration: Array, bandwidth: Array, out: Array) -> None:
    """Vibration at one and two per rev behind a second-order Butterworth filter, at this moment [rad/s, m/s^2]."""
    for i in range(6):
        out[i] = 0.0
        for harmonic in range(2):
            angle = (harmonic + 1) * phase
            share = (harmonic + 1) * rpm / 60.0 / bandwidth[i // 3]
            gain = rpm * rpm / math.sqrt(1.0 + share**4)
            real, imaginary = vibration[harmonic, i, 0], vibration[harmonic, i, 1]
            out[i] += gain * (real * math.cos(angle) - imaginary * math.sin(angle))


@njit
def degrade(
    dt: float,
    t: Array,
    exact: Array,
    turn_on: Array,
    bias: Array,
    slope: Array,
    warmer: Array,
    self_heating: float,
    self_heating_tau: float,
    white: Array,
    limit: Array,
    resolution: Array,
    dtheta: Array,
    dv: Array,
) -> None:
    """Biases and white noise [rad/s, m/s^2] onto the increments ``exact`` (n, 6), then range and resolution.

    ``bias`` comes in as the in-run part (n, 6) and leaves as the whole. Since power-on the air has become ``warmer``
    (n,) [K], and the unit heats itself up. Results go to ``dtheta`` and ``dv`` (n, 3).
    """
    for k in range(exact.shape[0]):
        warming = warmer[k] - self_heating * math.expm1(-t[k] / self_heating_tau)
        for i in range(6):
            bias[k, i] += turn_on[i] + slope[i] * warming
            value = exact[k, i] + (bias[k, i] + white[k, i]) * dt
            value = min(limit[i] * dt, max(-limit[i] * dt, value))
            step = resolution[i] * dt
            if step > 0.0:
                value = step * np.rint(value / step)
            if i < 3:
                dtheta[k, i] = value
            else:
                dv[k, i - 3] = value
