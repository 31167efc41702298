"""The filters' kernels, on increments of a body that lies still."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from statistics import median

import numpy as np
from bench.measure import Effort, Row, compare, cpu_seconds, need, ratios
from bench.unit import ACCEL_NOISE, DEG, GNSS_SIGMA, GYRO_NOISE, START, site, unit

from nav import strapdown, unscented
from nav._jit import lean, njit
from nav.ahrs import Ahrs, AhrsConfig
from nav.aids import GnssAid
from nav.alignment import InitialState
from nav.earth import A as EARTH_RADIUS
from nav.earth import gravity
from nav.error_model import POS, VEL, ErrorModel, Indices, transition
from nav.federated import Federated
from nav.federation import Config, Local
from nav.horizon import FusionHorizon
from nav.ins import Ins, InsConfig
from nav.monitor import MonitoredAid
from nav.samples import Array, FixType, GnssSample, ImuSamples, Sample
from nav.state import integrate

REST_S, REST_HZ = 600, 200
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def ahrs_batch(effort: Effort) -> Iterator[Row]:
    """The attitude filter through increments in one block, levelling once a second; in comparison with vqf."""
    samples = _rest(effort)

    def ours() -> None:
        ahrs = Ahrs(AhrsConfig(unit(), START[0] * DEG))
        ahrs.start(0.0, LEVEL)
        ahrs.propagate(samples)

    ours()
    rates = tuple(len(samples) / cpu_seconds(ours) / 1e6 for _ in range(effort.rounds))
    yield Row("AHRS in a batch", rates, "M updates/s", at_least=1.5)
    need("vqf")
    from vqf import VQF

    turns, forces = samples.dtheta / samples.dt[:, None], samples.dv / samples.dt[:, None]

    def theirs() -> None:
        VQF(float(samples.dt[0])).updateBatch(turns, forces)

    us, them = compare(ours, theirs, effort)
    speeds = f"{len(samples) / median(us) / 1e6:.1f} M updates/s against {len(samples) / median(them) / 1e6:.1f} M"
    yield Row("AHRS: vqf / ours", ratios(them, us), at_least=1.0, detail=speeds)


def federated(effort: Effort) -> Iterator[Row]:
    """Three local filters of 15 states, each with a receiver, over one INS of 15 states with one."""
    samples, names = _rest(effort), ("gnss", "second", "third")
    initial = InitialState(0.0, *site(), np.zeros(3), LEVEL, np.diag(np.repeat([2 * DEG, 0.5, 1.0], 3) ** 2))
    receivers = [_still_fixes(name, samples.t[-1]) for name in names]
    every = [fix for second in zip(*receivers, strict=True) for fix in second]

    def one() -> None:
        ins = Ins(InsConfig(unit(), (GnssAid(),)))
        ins.start(initial)
        FusionHorizon(ins).push(samples, receivers[0])

    def three() -> None:
        filters = tuple(Local(name, (MonitoredAid(GnssAid(name)),)) for name in names)
        fused = Federated(Config(unit(), filters))
        fused.start(initial)
        FusionHorizon(fused).push(samples, every)

    us, them = compare(three, one, effort)
    per_second = [f"{median(side) / samples.t[-1] * 1e6:.0f} us" for side in (us, them)]
    detail = f"{' over '.join(per_second)} per second of flight, fixes at 1 Hz"
    yield Row("federated, three local filters / one INS", ratios(us, them), at_most=4.0, detail=detail)


def unscented_period(effort: Effort) -> Iterator[Row]:
    """Periods of 15 states by sigma points, each with six rows of GNSS, over the strapdown of the same time.

    The integrals over the way that the transition is made of, of a linear filter too, are on neither side. What they
    would add to the filter's at 10 Hz is a row without a bound.
    """
    samples, model, scaling = _rest(effort), ErrorModel(unit()), unscented.Scaling()
    P = np.diag(np.repeat([0.1, 0.5, 3.0, 2e-4, 0.02], 3) ** 2)
    H = np.zeros((6, len(P)))
    H[:3, POS : POS + 3] = H[3:, VEL : VEL + 3] = np.eye(3)
    force = np.eye(3) * np.array([1.0, 0.1, -9.8])[:, None, None]  # C_nb, and it times rates and specific forces
    R = np.array([1.0] * 3 + [0.01] * 3)
    room = _room(len(P), len(R))

    def linear() -> None:
        strapdown.propagate(LEVEL.copy(), np.zeros(3), np.array(site()), samples.dtheta, samples.dv, samples.dt)

    for rate in (1, 10):
        count, T = effort.count(REST_S) * rate, 1 / rate

        def ours(count: int = count, T: float = T) -> None:
            _unscented_periods(
                count, T, P, LEVEL.copy(), np.zeros(3), np.array(site()), model.driven, force * T,
                force[2].sum(axis=1) * T, H, R, scaling.spread, scaling.excess, *room,
            )  # fmt: skip

        us, them = compare(ours, linear, effort)
        period, steps = median(us) / count * 1e6, REST_HZ // rate
        detail = f"{period:.2f} us per period over {median(them) / count * 1e6:.2f} us for {steps} steps"
        yield Row(f"UKF at {rate} Hz / strapdown beside it", ratios(us, them), at_most=1.0, detail=detail)
    alone, sums = median(ratios(us, them)), np.zeros((3, 3, 3))
    us, them = compare(lambda: _integrals(sums, LEVEL, samples.dtheta, samples.dv, samples.dt), linear, effort)
    whole = tuple(alone + share for share in ratios(us, them))
    yield Row("the same and the integrals for its transition", whole)


@njit
def _integrals(sums: Array, q_nb: Array, dtheta: Array, dv: Array, dt: Array) -> None:
    """The integrals of `error_model.transition` over N intervals."""
    for k in range(len(dt)):
        integrate(sums, q_nb, q_nb, dtheta[k], dv[k], dt[k])


def _room(n: int, m: int) -> tuple[Array, ...]:
    """What `_unscented_periods` works in: from P to the points of a measurement of ``m`` rows."""
    return (
        np.empty((n, n)), np.zeros((9, n)), np.zeros((9, n)), np.zeros(n), np.ones(n), np.full(n, 1e-12),
        np.zeros((7, m)), np.zeros(m), np.empty((3, n)), np.empty((7, unscented.FURTHER + n)), unscented.scratch(n),
    )  # fmt: skip


@lean
def _unscented_periods(
    count: int, T: float, P0: Array, q_nb: Array, v_n: Array, lla: Array, driven: Indices, sums: Array, push: Array,
    H: Array, R: Array, spread: float, excess: float,
    P: Array, Phi: Array, FT: Array, x: Array, decay: Array, half: Array, Z: Array, z: Array, root: Array,
    points: Array, work: Array,
) -> None:  # fmt: skip
    """``count`` periods of ``T`` seconds, each from the same covariance ``P0``."""
    n = len(P0)
    for _ in range(count):
        for i in range(n):
            for j in range(n):
                P[i, j] = P0[i, j]
        transition(Phi, FT, driven, v_n, lla[0], lla[2], sums, T)
        unscented.remove(q_nb, v_n, lla, x, unscented.predict(P, Phi, decay, half, work, push, T, spread, excess))
        unscented.factor_into(root, P)
        unscented.points_into(points, q_nb, v_n, lla, x, root, spread)
        for k in range(7):
            for i in range(3):
                Z[k, 3 + i] = points[k, 4 + i] - v_n[i]
            Z[k, 0] = (points[k, 7] - lla[0]) * EARTH_RADIUS
            Z[k, 1] = (points[k, 8] - lla[1]) * EARTH_RADIUS
            Z[k, 2] = lla[2] - points[k, 9]
        _, _, W, _ = unscented.innovate(P, Z, z, R, root, H, work, spread, excess)
        unscented.remove(q_nb, v_n, lla, x, unscented.correct(P, W, work))


@cache
def _rest(effort: Effort) -> ImuSamples:
    """Noisy increments of a body that lies still."""
    rng, n = np.random.default_rng(1), effort.count(REST_S) * REST_HZ
    dtheta = GYRO_NOISE / np.sqrt(REST_HZ) * rng.normal(size=(n, 3))
    dv = ACCEL_NOISE / np.sqrt(REST_HZ) * rng.normal(size=(n, 3))
    dv[:, 2] -= gravity(site()[0], START[2]) / REST_HZ
    return ImuSamples(np.arange(1, n + 1) / REST_HZ, np.full(n, 1 / REST_HZ), dtheta, dv)


def _still_fixes(sensor: str, end: float) -> list[Sample]:
    """A fix of the body that lies still in every second but the last."""
    rng, (lat, lon, h) = np.random.default_rng(2), site()
    sigma_p, sigma_v = np.full(3, GNSS_SIGMA), np.full(3, 0.1)
    return [
        GnssSample(t, t, lat, lon, h, 0.1 * rng.normal(size=3), sigma_p, sigma_v, FixType.FIX_3D, 12, hdop=1.0,
                   vdop=1.0, sensor=sensor)
        for t in np.arange(1.0, end).tolist()
    ]  # fmt: skip
