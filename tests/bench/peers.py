"""The oracle hour: 100 Hz IMU with the errors of an industrial MEMS unit, 1 Hz GNSS position; ours beside peers."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from statistics import median
from typing import Any

import numpy as np
from bench.measure import Effort, Row, compare, need, ratios
from bench.unit import ACCEL_NOISE, ACCEL_WALK, DEG, GNSS_SIGMA, GYRO_NOISE, GYRO_WALK, START, unit

from nav import strapdown
from nav.aids import GnssAid
from nav.alignment import InitialState
from nav.earth import position_difference_n
from nav.horizon import FusionHorizon
from nav.ins import Ins, InsConfig
from nav.rotation import euler_from_quat, quat_from_euler
from nav.samples import Array, FixType, GnssSample, ImuSamples, Sample

RATE_HZ, HOUR_S = 100, 3600.0
GYRO_BIAS = np.array([60.0, -40.0, 50.0]) * DEG / 3600  # [rad/s]
ACCEL_BIAS = np.array([0.05, -0.04, 0.06])  # [m/s^2]
IMU_COLUMNS = ("gyro", "accel")  # as pyins names them


def strapdown_alone(effort: Effort) -> Iterator[Row]:
    """The strapdown kernel over pyins' batch integration, the same increments."""
    need("pyins")
    from pyins import strapdown as peer

    trajectory, imu, _ = _oracle_hour(effort)
    samples = _increments(imu)
    theirs_increments = peer.compute_increments_from_imu(imu, "increment")

    def ours() -> None:
        q, v, lla = _initial(trajectory)
        strapdown.propagate(q, v, lla, samples.dtheta, samples.dv, samples.dt)

    def theirs() -> None:
        peer.Integrator(trajectory.iloc[0]).integrate(theirs_increments)

    us, them = compare(ours, theirs, effort)
    speeds = f"{len(samples) / median(us) / 1e6:.1f} M steps/s against {len(samples) / median(them) / 1e6:.2f} M"
    yield Row("strapdown: pyins batch / ours", ratios(them, us), at_least=4.0, detail=speeds)


def ins_at_every_sample(effort: Effort) -> Iterator[Row]:
    """The 15-state INS with covariance at every IMU sample over smsfusion's aided INS, the same hour."""
    need("pyins", "smsfusion")
    from smsfusion import AidedINS

    trajectory, imu, fixes = _oracle_hour(effort)
    samples, aids = _increments(imu), _fixes(fixes)
    rate, force = samples.dtheta * RATE_HZ, samples.dv * RATE_HZ
    q, v, lla = _initial(trajectory)
    start = np.concatenate([np.zeros(3), v, q, np.zeros(6)])
    # smsfusion navigates on a flat Earth; it gets the fixes in metres about the start, for the same number of updates
    local = np.array([position_difference_n(s.lat, s.lon, s.h, *lla) for s in aids if isinstance(s, GnssSample)])
    variance = np.full(3, GNSS_SIGMA**2)

    def ours() -> None:
        FusionHorizon(_aligned(trajectory)).push(samples, aids)

    def theirs() -> None:
        accel = {"N": ACCEL_NOISE, "B": 0.05, "tau_cb": 1e4}
        gyro = {"N": GYRO_NOISE, "B": 3e-4, "tau_cb": 1e4}
        aided = AidedINS(RATE_HZ, start, np.eye(15) * 1e-2, accel, gyro, ignore_bias_acc=False, cold_start=False)
        for k in range(len(rate)):
            second, rest = divmod(k + 1, RATE_HZ)
            if rest == 0 and second <= len(local):
                aided.update(force[k], rate[k], pos=local[second - 1], pos_var=variance)
            else:
                aided.update(force[k], rate[k])

    us, them = compare(ours, theirs, Effort(effort.share, min(3, effort.rounds)))
    speeds = f"{len(rate) / median(us) / 1e3:.0f} k samples/s against {len(rate) / median(them) / 1e3:.1f} k"
    yield Row("15-state INS: smsfusion / ours", ratios(them, us), at_least=10.0, detail=speeds)


def accuracy(effort: Effort) -> Iterator[Row]:
    """Errors in the last half hour over those of pyins' feedback filter on the same increments and fixes.

    Both filters start at the truth, told the true error levels; the largest of six RMS ratios (N, E, D, roll, pitch,
    heading).
    """
    need("pyins")
    from pyins import filters, measurements, strapdown, transform
    from pyins.inertial_sensor import EstimationModel

    trajectory, imu, fixes = _oracle_hour(effort)
    half = trajectory.index >= trajectory.index[-1] / 2

    ins = FusionHorizon(_aligned(trajectory))
    times = [float(t) for t in trajectory.index[half]]
    _, estimates = ins.track(_increments(imu), _fixes(fixes), times)
    ours = trajectory[half].copy()
    columns = list(ours.columns)
    ours[:] = [
        [e.lat / DEG, e.lon / DEG, e.h, *e.v_n, *(euler_from_quat(e.q_nb) / DEG)] for e in estimates
    ]  # as pyins orders them

    theirs = filters.run_feedback_filter(
        trajectory.iloc[0], 1.0, 0.5, 2.0, 2.0,
        strapdown.compute_increments_from_imu(imu, "increment"),
        EstimationModel(bias_sd=60 * DEG / 3600, noise=GYRO_NOISE, bias_walk=GYRO_WALK),
        EstimationModel(bias_sd=0.06, noise=ACCEL_NOISE, bias_walk=ACCEL_WALK),
        [measurements.Position(fixes, GNSS_SIGMA)],
        time_step=1.0,  # the longest that pyins recommends; with its 0.1 s it takes minutes
    ).trajectory  # fmt: skip

    def rms(estimated: Any) -> Array:
        error = transform.compute_state_difference(estimated.loc[ours.index, columns], trajectory.loc[ours.index])
        found: Array = np.sqrt((error**2).mean())[["north", "east", "down", "roll", "pitch", "heading"]].to_numpy()
        return found

    us, them = rms(ours), rms(theirs)
    detail = f"{' '.join(f'{x:.3g}' for x in us)} against {' '.join(f'{x:.3g}' for x in them)} (m, deg)"
    yield Row("error on the oracle hour: ours / pyins", (float(max(us / them)),), at_most=1.05, detail=detail)


@cache
def _oracle_hour(effort: Effort) -> tuple[Any, Any, Any]:
    """Trajectory, increments with errors and GNSS fixes of the hour, from pyins' own simulator, as its frames."""
    from pyins import inertial_sensor, sim

    dt = 1 / RATE_HZ
    trajectory, imu = sim.generate_sine_velocity_motion(
        dt, effort.count(HOUR_S) + dt, list(START), [25.0, 15.0, 0.0], [8.0, 8.0, 0.5], 60, sensor_type="increment"
    )
    gyro = inertial_sensor.Parameters(bias=GYRO_BIAS, noise=GYRO_NOISE, bias_walk=GYRO_WALK, rng=1)
    accel = inertial_sensor.Parameters(bias=ACCEL_BIAS, noise=ACCEL_NOISE, bias_walk=ACCEL_WALK, rng=2)
    imu = inertial_sensor.apply_imu_parameters(imu, "increment", gyro, accel)
    legacy = np.random.RandomState(3)  # the kind that pyins takes
    fixes = sim.generate_position_measurements(trajectory.iloc[::RATE_HZ].iloc[1:], GNSS_SIGMA, legacy)
    return trajectory, imu, fixes


def _increments(imu: Any) -> ImuSamples:
    """The hour's increments as samples; the first row ends at time zero and is left out."""
    t = np.array(imu.index)[1:]
    columns = [np.array(imu[[f"{name}_{axis}" for axis in "xyz"]], order="C")[1:] for name in IMU_COLUMNS]
    return ImuSamples(t, np.full(len(t), 1 / RATE_HZ), columns[0], columns[1])


def _fixes(fixes: Any) -> list[Sample]:
    """The hour's fixes as samples: position only."""
    sigma, unknown = np.full(3, GNSS_SIGMA), np.full(3, np.nan)
    return [
        GnssSample(t, t, lat * DEG, lon * DEG, alt, unknown, sigma, unknown, FixType.FIX_3D, 12, hdop=1.0, vdop=1.0)
        for t, (lat, lon, alt) in zip(fixes.index, fixes[["lat", "lon", "alt"]].to_numpy(), strict=True)
    ]


def _initial(trajectory: Any) -> tuple[Array, Array, Array]:
    """Attitude, velocity and position at the start of the hour."""
    first = trajectory.iloc[0]
    return (
        quat_from_euler(first.roll * DEG, first.pitch * DEG, first.heading * DEG),
        np.array(first[["VN", "VE", "VD"]], dtype=float),  # a copy: what a frame gives can't be written to
        np.array([first.lat * DEG, first.lon * DEG, first.alt]),
    )


def _aligned(trajectory: Any) -> Ins:
    """A 15-state INS told the true error levels, at the start of the hour."""
    ins = Ins(InsConfig(unit(), (GnssAid(use_velocity=False),), covariance_period=1))
    q, v, lla = _initial(trajectory)
    covariance = np.diag(np.repeat([2 * DEG, 0.5, 1.0], 3) ** 2)
    ins.start(InitialState(0.0, lla[0], lla[1], lla[2], v, q, covariance))
    return ins
