"""A made-up run with known errors, recorded through the recorder like a real one."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nav.columns import Estimates
from nav.samples import (
    AirspeedSample,
    BarometerSample,
    Estimate,
    FixType,
    GnssSample,
    ImuSamples,
    MagnetometerSample,
    Outcome,
    Status,
    UpdateReport,
)
from testbed.motion.table import TruthBlock
from testbed.record.recorder import Recorder

TICK_HZ = 200
ROW = 20  # ticks from estimate to estimate


def scenario(duration_s: float = 60.0, rate_hz: float = 10.0, imu: bool = True) -> Any:
    return SimpleNamespace(
        title="A made-up circle",
        text='title = "A made-up circle"  # ±3 σ\n',
        path="circle.toml",
        overrides=("seed=3",),
        duration_s=duration_s,
        truth=SimpleNamespace(rate_hz=float(TICK_HZ)),
        sensors={"imu": SimpleNamespace(lever_arm_m=(0.0, 0.0, 0.0))},
        estimator=[
            SimpleNamespace(name=name, imu="imu", recorded=(name,))
            for name in ("ins", "dead_reckoning", "late", "other")
        ],
        record=SimpleNamespace(rate_hz=rate_hz, imu=imu),
    )


def circle(duration_s: float, lat_deg: float = 34.0, lon_deg: float = 108.0) -> TruthBlock:
    """25 m/s on a 400 m circle, banked, slowly climbing and descending."""
    n = round(duration_s * TICK_HZ) + 1
    block = TruthBlock.empty(0, n)
    t = np.arange(n) / TICK_HZ
    speed, radius = 25.0, 400.0
    heading = speed / radius * t
    lat = np.deg2rad(lat_deg)
    lon = np.deg2rad(lon_deg) + radius * (1 - np.cos(heading)) / (6.38e6 * np.cos(lat))
    block.t[:] = t
    block.lat[:] = lat + radius * np.sin(heading) / 6.36e6
    block.lon[:] = np.mod(lon + np.pi, 2 * np.pi) - np.pi
    block.h[:] = 1000 + 50 * np.sin(t / 60)
    block.v_n[:] = np.column_stack([speed * np.cos(heading), speed * np.sin(heading), -50 / 60 * np.cos(t / 60)])
    euler = np.column_stack([heading, np.full(n, 0.03), np.full(n, 0.16)])
    block.q_nb[:] = Rotation.from_euler("ZYX", euler).as_quat(scalar_first=True)
    block.wind_n[:] = [4.0, -2.0, 0.0]
    block.airspeed[:] = 25 + np.sin(t / 7)
    rng = np.random.default_rng(1)
    block.dtheta[1:] = rng.normal(size=(n - 1, 3)) * 1e-3
    block.dv[1:] = rng.normal(size=(n - 1, 3)) * 1e-2
    block.leg[:] = np.floor(t / 30)
    return block


@dataclass
class Errors:
    """How wrong one estimator is: 1-sigma claimed, factor of the true error on it, and drift while GNSS is denied."""

    sigma_position: float = 1.0
    sigma_velocity: float = 0.1
    sigma_attitude: float = np.deg2rad(0.3)
    truth_over_claim: float = 1.0
    drift_mps: float = 0.2
    aligned_after: float = 5.0
    nan_from: float = np.inf
    denied: tuple[tuple[float, float], ...] = field(default_factory=tuple)


def estimates(truth: TruthBlock, errors: Errors, rng: np.random.Generator) -> dict[int, Estimate]:
    """What one estimator says, by the tick at which it says it."""
    ticks = np.arange(0, len(truth), ROW)
    knows = (truth.t[ticks] >= errors.aligned_after) & (truth.t[ticks] < errors.nan_from)
    noise = np.zeros((len(ticks), 11))
    noise[knows] = rng.normal(size=(knows.sum(), 11))
    sigma = np.repeat([[errors.sigma_position, errors.sigma_velocity, errors.sigma_attitude]], 3, axis=1)
    sigma = np.repeat(sigma, len(ticks), axis=0)
    outage = np.zeros(len(ticks))
    for start, end in errors.denied:
        inside = (start <= truth.t[ticks]) & (truth.t[ticks] < end)
        outage[inside] = truth.t[ticks][inside] - start
    sigma[:, :2] += (errors.drift_mps * outage)[:, None]
    error = noise[:, :9] * sigma * errors.truth_over_claim
    lat = truth.lat[ticks] + error[:, 0] / 6.36e6
    lon = truth.lon[ticks] + error[:, 1] / (6.385e6 * np.cos(lat))
    lon = np.mod(lon + np.pi, 2 * np.pi) - np.pi
    true_attitude = Rotation.from_quat(truth.q_nb[ticks], scalar_first=True)
    q_nb = (Rotation.from_rotvec(-error[:, 6:]) * true_attitude).as_quat(scalar_first=True)
    bias, nan = np.array([1e-4, -2e-4, 5e-5]), np.full(3, np.nan)
    told = {}
    for row, k in enumerate(ticks.tolist()):
        t = float(truth.t[k])
        if not knows[row]:
            status = Status.ALIGNING if t < errors.aligned_after else Status.ALIGNED
            unknown = np.full(4, np.nan), nan, nan, np.full((9, 9), np.nan), nan, nan
            told[k] = Estimate(t, np.nan, np.nan, np.nan, nan, *unknown, status)
            continue
        fading = np.exp(-t / 100)
        told[k] = Estimate(
            t=t,
            lat=float(lat[row]),
            lon=float(lon[row]),
            h=float(truth.h[k] - error[row, 2]),
            v_n=truth.v_n[k] + error[row, 3:6],
            q_nb=q_nb[row],
            gyro_bias=bias * (1 - fading),
            accel_bias=100 * bias * (1 - fading),
            covariance=np.diag(sigma[row] ** 2),
            sigma_gyro_bias=np.full(3, 1e-5 + 2e-4 * fading),
            sigma_accel_bias=np.full(3, 1e-3 + 2e-2 * fading),
            status=Status.ALIGNED | (Status.DEAD_RECKONING if outage[row] else Status.GNSS_FUSED),
            extra={
                "wind": (truth.wind_n[k, :2] + noise[row, 9:] * 0.3, np.full(2, 0.3)),
                "barometer_bias": (np.array([3.0]), np.array([1.0])),
            },
        )
    return told


def record(
    recorder: Recorder,
    truth: TruthBlock,
    estimators: dict[str, Errors],
    denied: tuple[tuple[float, float], ...] = (),
    chunk: int = TICK_HZ,
    seed: int = 0,
    gnss: bool = True,
) -> None:
    """Feed a whole run in chunks of ticks; the same rows whatever the chunk."""
    aid_noise = np.random.default_rng([seed, 99])
    told = {}
    for k, (name, errors) in enumerate(estimators.items()):
        errors.denied = denied
        told[name] = estimates(truth, errors, np.random.default_rng([seed, k]))
    for start in range(0, len(truth), chunk):
        block = truth.rows(start, min(start + chunk, len(truth)))
        recorder.truth(block)
        recorder.imu("imu", ImuSamples(block.t, np.full(len(block), 1 / TICK_HZ), block.dtheta, block.dv))
        for k in range(-(-start // ROW) * ROW, start + len(block), ROW):
            t = float(truth.t[k])
            if k % (2 * ROW) == 0:
                out = any(a <= t < b for a, b in denied)
                nan = np.full(3, np.nan)
                one = np.ones(3)
                if gnss:
                    recorder.samples(
                        "gnss",
                        [
                            GnssSample(t, t + 0.1, np.nan, np.nan, np.nan, nan, nan, nan, FixType.NO_FIX, 0, 99.0, 99.0)
                            if out
                            else GnssSample(
                                t,
                                t + 0.1,
                                truth.lat[k],
                                truth.lon[k],
                                truth.h[k],
                                truth.v_n[k],
                                one,
                                0.1 * one,
                                FixType.FIX_3D,
                                11,
                                0.9,
                                1.4,
                            )
                        ],
                    )
                recorder.samples("barometer", [BarometerSample(t, t, 9e4)])
                recorder.samples("magnetometer", [MagnetometerSample(t, t, np.array([2e-5, 1e-6, 4e-5]))])
                recorder.samples("airspeed", [AirspeedSample(t, t, 24.0)])
                for name in estimators:
                    reports = []
                    if gnss and not out:
                        reports = [_report(t, "gnss", aid, 3, aid_noise) for aid in ("gnss_position", "gnss_velocity")]
                    recorder.reports(name, [*reports, _report(t, "barometer", "barometer", 1, aid_noise)])
            for name in estimators:
                recorder.estimates(name, Estimates.of([told[name][k]]))
        if start == 0:
            recorder.event(0.0, "info", "leg 1/2 «circle»")
    for a, b in denied:
        recorder.event(a, "warning", "gnss denied")
        recorder.event(b, "info", "gnss reacquired")


def _report(t: float, sensor: str, aid: str, m: int, rng: np.random.Generator) -> UpdateReport:
    sigma = np.arange(1.0, m + 1)
    unit = rng.normal(size=m)
    z, S, nis = unit * sigma, np.diag(sigma**2), float(unit @ unit)
    threshold = {1: 10.8, 3: 16.3}[m]
    refused = nis > threshold
    return UpdateReport(
        t,
        sensor,
        aid,
        z,
        S,
        nis,
        threshold,
        *((0.0, Outcome.OUTSIDE_GATE, "outside the gate") if refused else (1.0, Outcome.FUSED)),
    )


def dataset(
    duration_s: float = 60.0,
    estimators: dict[str, Errors] | None = None,
    denied: tuple[tuple[float, float], ...] = (),
    path: Path | None = None,
    **options: Any,
) -> Any:
    recorder = Recorder(path, scenario(duration_s), 3)
    where = {k: options.pop(k) for k in ("lat_deg", "lon_deg") if k in options}
    record(
        recorder,
        circle(duration_s, **where),
        {"ins": Errors()} if estimators is None else estimators,
        denied,
        **options,
    )
    recorder.close()
    return recorder.dataset()
