"""From datasheets to what filters are told: the noise and the error states of the IMU and of each aid.

A filter knows the datasheets, never the errors that were drawn from them. Terms that it has no state for
(g-sensitivity, temperature, misalignment, mostly scale factors too) widen the bias that it does estimate.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from nav.aids import (
    Aid,
    AirspeedAid,
    BarometerAid,
    BodyVelocityAid,
    GnssAid,
    MagnetometerAid,
    OpticalFlowAid,
    PositionFixAid,
    RangefinderAid,
    StarAid,
    WindReportAid,
)
from nav.aids.magnetometer import FIELD_SIZE
from nav.aids.terrain import Search
from nav.earth import STANDARD_GRAVITY
from nav.error_model import ImuModel
from nav.point_mass import PointMass
from nav.samples import Array
from testbed.estimators.rig import Air, Rig
from testbed.estimators.section import ImuStates
from testbed.motion.aircraft import UNKNOWN_BODY, Usual
from testbed.sensors import Site, custom, registry
from testbed.sensors.airspeed import REFERENCE_EAS, AirspeedConfig
from testbed.sensors.barometer import BarometerConfig
from testbed.sensors.body_velocity import BodyVelocityConfig
from testbed.sensors.gnss import GnssConfig
from testbed.sensors.imu import ImuErrors
from testbed.sensors.magnetometer import MagnetometerConfig
from testbed.sensors.optical_flow import OpticalFlowConfig
from testbed.sensors.position_fix import PositionFixConfig
from testbed.sensors.rangefinder import RangefinderConfig
from testbed.sensors.star_tracker import StarTrackerConfig
from testbed.sensors.units import ARCSEC, DEG_PER_H, DEG_PER_ROOT_H, MG, MICROTESLA, MPS_PER_ROOT_H
from testbed.sensors.wind_report import WindReportConfig

WARM_UP_K = 10.0  # how far the unit may be from the temperature it was calibrated at
MANOEUVRE_S = 120.0  # between changes of turn and load
METRES_PER_PASCAL = 1 / 12.0  # of pressure altitude near the ground
SOFT_IRON_SHARE = 0.5  # of soft iron's field that is constant in n axes, where it is not a state
SOFT_IRON_LASTS_S = 60.0  # for which what it does otherwise lasts, as long as a turn
# Where a datasheet has no noise, as of grade "perfect", a filter is told of about that of the best real parts. Told of
# none it would be sure of itself within a second, and refuse what integration and rounding leave.
BEST_IMU = ImuModel(0.001 * DEG_PER_ROOT_H, 0.003 * MPS_PER_ROOT_H, 0.003 * DEG_PER_H, 0.01 * MG)
BEST_PRESSURE, BEST_FIELD, BEST_STARS = 0.1, 0.01 * MICROTESLA, 1 * ARCSEC  # [m], [T], [rad]
BEST_SPEED, BEST_PLACE, BEST_FLOW = 0.005, 0.01, 1e-4  # [m/s], [m], [rad/s]
GUST_LENGTH = 300.0  # of gusts at the height of 300 m (MIL-F-8785C) [m]
SHORT_GUSTS = 0.15  # of the gusts, what is faster than that
CRUISE_THROTTLE = 0.5  # of full throttle
SIDESLIP = 0.5  # of a coordinated flight: what is left of a gust, for a third of a second, and a mean in turns [m/s]


def imu_model(
    errors: ImuErrors, turn_rate: float | None = None, states: ImuStates = "biases", usual: Usual = UNKNOWN_BODY
) -> ImuModel:
    """The datasheet as the filter's error model; ``turn_rate`` [rad/s] counts in place of the ``usual`` one.

    Misalignment and g-sensitivity make a bias that changes with every manoeuvre: a random walk. Of the gyros it is as
    large as a turn makes it; of the accelerometers as the usual change of load does. In turns slower than
    the usual one the load changes by less, with the square of their rate: n^2 = 1 + (v turn_rate / g)^2.

    With ``states`` "biases" scale factors do so too, and in-run instability (Gauss-Markov, sigma and tau) becomes a
    random walk of the same driving noise, q = sigma sqrt(2 / tau), beside the rate random walk: over minutes the two
    cannot be told apart. With "full" both are states of their own (Cui et al. 2022, Eq 36), and with "matrix"
    misalignment, a small turn of the triad, and axes y and z that lean, too: biases no longer walk for them.
    """
    full, matrix = states != "biases", states == "matrix"
    beside = replace(errors, gyro_in_run=0.0, accel_in_run=0.0, gyro_scale=0.0, accel_scale=0.0) if full else errors
    if matrix:
        beside = replace(
            beside, gyro_misalignment=0.0, gyro_nonorthogonality=0.0, accel_misalignment=0.0, accel_nonorthogonality=0.0
        )
    level = math.hypot(beside.accel_misalignment, beside.accel_nonorthogonality, beside.accel_scale)
    turn = math.hypot(beside.gyro_misalignment, beside.gyro_nonorthogonality, beside.gyro_scale)
    pull = beside.gyro_g_sensitivity * STANDARD_GRAVITY
    changes = math.sqrt(1 / MANOEUVRE_S)
    turn_rate = usual.turn_rate_radps if turn_rate is None else turn_rate
    load_change = usual.load_change_g * min(1.0, turn_rate / usual.turn_rate_radps) ** 2
    model = ImuModel(
        gyro_noise=math.hypot(beside.gyro_noise, beside.gyro_vibration),
        accel_noise=math.hypot(beside.accel_noise, beside.accel_vibration),
        gyro_bias_sigma=math.hypot(
            beside.gyro_turn_on, beside.gyro_in_run, beside.gyro_temperature * WARM_UP_K, pull, turn * turn_rate
        ),
        accel_bias_sigma=math.hypot(
            beside.accel_turn_on, beside.accel_in_run, beside.accel_temperature * WARM_UP_K, level * STANDARD_GRAVITY
        ),
        gyro_bias_walk=math.hypot(
            beside.gyro_random_walk,
            _drive(beside.gyro_in_run, beside.gyro_in_run_tau),
            turn * turn_rate * changes,
            pull * load_change * changes,
        ),
        accel_bias_walk=math.hypot(
            beside.accel_random_walk,
            _drive(beside.accel_in_run, beside.accel_in_run_tau),
            level * STANDARD_GRAVITY * load_change * changes,
        ),
        gyro_drift_sigma=errors.gyro_in_run if full else 0.0,
        accel_drift_sigma=errors.accel_in_run if full else 0.0,
        gyro_drift_correlation_s=errors.gyro_in_run_tau,
        accel_drift_correlation_s=errors.accel_in_run_tau,
        gyro_scale_sigma=errors.gyro_scale if full else 0.0,
        accel_scale_sigma=errors.accel_scale if full else 0.0,
        gyro_misalignment=errors.gyro_misalignment if matrix else 0.0,
        accel_misalignment=errors.accel_misalignment if matrix else 0.0,
        gyro_nonorthogonality=errors.gyro_nonorthogonality if matrix else 0.0,
        accel_nonorthogonality=errors.accel_nonorthogonality if matrix else 0.0,
        gyro_motion=errors.gyro_motion,
        accel_motion=errors.accel_motion,
        vibration=errors.vibration_share,
    )
    return replace(
        model,
        gyro_noise=model.gyro_noise or BEST_IMU.gyro_noise,
        accel_noise=model.accel_noise or BEST_IMU.accel_noise,
        gyro_bias_sigma=model.gyro_bias_sigma or BEST_IMU.gyro_bias_sigma,
        accel_bias_sigma=model.accel_bias_sigma or BEST_IMU.accel_bias_sigma,
    )


def _drive(sigma: float, tau: float) -> float:
    return sigma * math.sqrt(2 / tau)


def _of_each(sigma: Array, best: float) -> tuple[float, float, float]:
    """The noise of each axis; ``best`` where there is none."""
    x, y, z = np.where(sigma > 0, sigma, best).tolist()
    return x, y, z


def aid_of(name: str, rig: Rig, imu: ImuErrors, air: Air, slip_mps: float | None = None) -> Aid | None:
    """A sensor of the ``rig`` as a filter is told of it, None for one that aids none.

    ``slip_mps`` is of wheels, None without that constraint. Body velocity, position fixes and what is seen of the
    ground are of the centre of gravity.
    """
    section, usual = rig.sensors[name], rig.usual
    from_imu: tuple[float, float, float] = tuple(0.0 - imu.lever_arm_b)
    match section:
        case RangefinderConfig() | OpticalFlowConfig():
            return _eye(name, section, rig.site, usual, from_imu)
        case GnssConfig():
            e = section.errors()
            return GnssAid(
                name,
                arm_b=tuple(e.lever_arm_b - imu.lever_arm_b),
                position_error_sigma=tuple(e.position_correlated_n),
                position_error_correlation_s=e.position_tau,
                velocity_error_sigma=tuple(e.velocity_correlated_n),
                velocity_error_correlation_s=e.velocity_tau,
                latency_sigma=e.latency_sigma,
                velocity_lag=e.velocity_lag,
                largest_jump=e.largest_jump,
                follow_s=section.follow_s,
            )
        case BarometerConfig():
            return _barometer(name, section)
        case MagnetometerConfig():
            return _compass(name, section, usual)
        case AirspeedConfig():
            a = section.errors()
            gust = max(air.gust, section.gust_mps)
            slower = REFERENCE_EAS / usual.airspeed_mps  # of constant errors of pressure, at the airspeed that is usual
            return AirspeedAid(
                name,
                sigma=math.hypot(slower * a.noise, a.unsteady, SHORT_GUSTS * gust) or BEST_SPEED,
                scale_sigma=math.hypot(a.scale, slower * a.bias / usual.airspeed_mps),
                minimum=section.slowest_mps,
                sideslip_sigma=None if section.slips else math.hypot(SIDESLIP, SHORT_GUSTS * gust),
                wind_walk=max(air.wind_walk, section.wind_walk_mps_per_sqrt_s),
                gust_sigma=gust,
                gust_correlation_s=section.gust_time_s or GUST_LENGTH / usual.airspeed_mps,
            )
        case BodyVelocityConfig():
            v = section.errors()
            noise = v.noise or BEST_SPEED
            return BodyVelocityAid(name, v.axes, noise, v.scale, v.correlated, v.tau, slip_mps, from_imu)
        case StarTrackerConfig():
            return StarAid(name, _of_each(section.errors().noise_b, BEST_STARS))
        case PositionFixConfig():
            p = section.errors()
            return PositionFixAid(name, _of_each(p.position_n, BEST_PLACE), p.height, from_imu)
        case WindReportConfig():
            w = section.errors()
            length = GUST_LENGTH / usual.airspeed_mps
            left = air.gust * math.sqrt(2 * length / max(section.mean_s, 2 * length))
            return WindReportAid(name, w.local, w.tau, left, air.wind_walk)
    maker = registry.of(section).aid  # of a sensor of the user's
    return None if maker is None else custom.aid(maker, name, section, imu)


def _barometer(name: str, section: BarometerConfig) -> Aid:
    """A barometer; one in a wake is of an installation whose white noise no data sheet knows."""
    b = section.errors()
    return BarometerAid(
        name,
        sigma=b.noise * METRES_PER_PASCAL or BEST_PRESSURE,
        bias_walk=_drive(b.drift, b.drift_tau) * METRES_PER_PASCAL,
        error_sigma=b.unsteady * METRES_PER_PASCAL,
        error_correlation_s=b.unsteady_tau,
        scatters=b.unsteady > 0,
        follow_s=section.follow_s,
    )


def _compass(name: str, section: MagnetometerConfig, usual: Usual) -> Aid:
    """A magnetometer, with soft iron as states, or, of one that is doubted, as an anomaly.

    What the throttle changes of the field by the motor's current is neither: an error that comes and goes.
    """
    m = section.errors()
    bias = math.hypot(m.hard_iron, math.hypot(m.current * usual.current_a, m.throttle * CRUISE_THROTTLE))
    motor = m.current * usual.current_change_a
    noise = m.noise or BEST_FIELD
    if not m.doubt:
        return MagnetometerAid(name, sigma=noise, bias_sigma=bias, soft_iron_sigma=m.soft_iron, error_sigma=motor)
    iron = m.soft_iron * FIELD_SIZE
    return MagnetometerAid(
        name, sigma=noise, bias_sigma=bias, anomaly_sigma=SOFT_IRON_SHARE * iron, error_sigma=math.hypot(iron, motor),
        error_correlation_s=SOFT_IRON_LASTS_S, doubt=m.doubt, follow_s=section.follow_s,
    )  # fmt: skip


def _eye(
    name: str, section: RangefinderConfig | OpticalFlowConfig, site: Site, usual: Usual,
    arm_b: tuple[float, float, float],
) -> Aid:  # fmt: skip
    """A sensor that looks at the ground, with the map, whose errors pass by as fast as the aircraft usually flies."""
    map_ = site.terrain, site.terrain_sigma, site.local_sigma, site.local_length / usual.airspeed_mps
    if isinstance(section, RangefinderConfig):
        r = section.errors()
        noise = r.noise or BEST_PLACE
        places = PointMass(site.terrain, noise, *map_[2:])
        search = Search(places) if site.terrain.heights.size > 1 else None
        return RangefinderAid(name, noise, r.scale, *map_, search, arm_b)
    f = section.errors()
    return OpticalFlowAid(name, f.noise or BEST_FLOW, f.scale, f.bias, f.tau, *map_, arm_b)
