"""What the attitude filter is told."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from nav._jit import inlined
from nav.error_model import ImuModel
from nav.motion import LowDynamics
from nav.samples import AirspeedSample, Array, BarometerSample, MagnetometerSample

KINDS: dict[type, str] = {AirspeedSample: "airspeed", BarometerSample: "barometer", MagnetometerSample: "magnetometer"}
# What an update is called, by the accelerometers and by the magnetometer: an angle, not a field.
LEVEL, MAGNETIC_HEADING = "level", "magnetic_heading"
DEG = math.pi / 180
Correction: TypeAlias = Callable[[Array, float], Array]  # as `limited`


@inlined
def limited(phi: Array, limit: float) -> Array:
    """What of an attitude error ``phi`` (3,) is corrected at once: each axis by its own error, at most ``limit`` [rad].

    Equation 10 (which prints the north axis' error for both level axes).
    """
    return np.array([min(max(phi[0], -limit), limit), min(max(phi[1], -limit), limit), min(max(phi[2], -limit), limit)])


@dataclass(frozen=True)
class AnyMotion:
    """How to level whatever the body does (`nav.ahrs.any_motion`); SI, radians. Fit for a hand, a rotor and a wing.

    Chosen on six trials of BROAD and two recorded flights, where half and twice each value makes little difference.
    """

    velocity_correlation_s: float = 4.0  # how long a velocity lasts that nothing on board tells
    acceleration_smoothing_s: float = 0.5  # quicker accelerations average out by themselves
    acceleration_memory_s: float = 4.0  # time over which accelerations are measured
    least_acceleration_density: float = 1e-3  # of horizontal accelerations, where none are seen [(m/s^2)^2 s]
    airspeed_error_s: float = 1.0  # how long ``airspeed_sigma`` has one sign
    # Of the rate of turn that is an error, by misalignment and scale, over a second; more where a part is told so.
    gyro_share: float = 3e-3
    turning_speed: float = 20.0  # rms axis of the velocity that turns with the body, where airspeed does not tell [m/s]
    turning_speed_s: float = 300.0  # how long it lasts
    turn_memory_s: float = 12.0  # time over which its rate is taken
    turn_smoothing_s: float = 4.0  # of the rate that tells a turn from a swing
    # Of the square of that rate in that of all rates: up to the first it is a swing, from the second on a turn.
    turn_shares: tuple[float, float] = (0.1, 0.3)

    field_tolerance: float = 0.1  # of the size of the magnetic field: further off it tells no heading
    dip_tolerance: float = 6 * DEG
    disturbance_s: float = 10.0  # how long what disturbs the field lasts
    field_memory_s: float = 20.0  # time over which size and dip are learned
    field_patience_s: float = 20.0  # time after which another field that stays is taken for the right one

    rest_rate: float = 0.5 * DEG  # by how much rates vary over a period at rest, beside the gyros' noise [rad/s]
    rest_force: float = 0.1  # the same of specific force [m/s^2]
    rest_periods: int = 8  # that have to be quiet in a row
    rest_sigma: float = 0.03 * DEG  # of a second's mean rate, taken for bias [rad/s]


@dataclass(frozen=True)
class AhrsConfig:
    """What the filter is told: SI, radians. ``lat`` and ``h`` are of the area of operation, good to 100 km and 1 km.

    Without magnetometer ``heading`` is where the body's nose points when the first increment begins: nothing on board
    tells it (a gyro of 40 deg/h does not feel the Earth's 15).
    """

    imu: ImuModel
    lat: float
    h: float = 0.0
    aids: tuple[str, ...] = ()  # of airspeed, barometer, magnetometer
    period_s: float = 1.0
    tilt_sigma: float = 5 * DEG  # after levelling
    heading: float = 0.0
    heading_sigma: float = 15 * DEG
    levelling_s: float = 2.0  # time over which the first roll and pitch are found

    force_sigma: float = 0.1  # of the mean horizontal specific force over a period, as a sign of tilt [m/s^2]
    motion: LowDynamics = field(default_factory=LowDynamics)  # when level, by specific force as it is
    # and by specific force less the acceleration that airspeed tells: then turns need not be shut out
    compensated_motion: LowDynamics = field(default_factory=lambda: LowDynamics(1.0, 10 * DEG, 10 * DEG))
    phi_limit: float = 0.2 * DEG  # largest correction of each level axis per period
    correction_sigma: float = 1 * DEG  # the attitude is corrected when both level axes are known this well
    gyro_bias_feedback: bool = False  # estimated biases are taken off the gyros
    # Further error states, none where zero (`nav.ahrs.further.FurtherStates`).
    gyro_misalignment_sigma: float = 0.0  # share of the yaw rate that each gyro feels beside its own
    accel_bias_sigma: float = 0.0  # of the accelerometers' constant biases [m/s^2]
    gust_sigma: float = 0.0  # of horizontal accelerations in straight flight, each axis [m/s^2]
    gust_correlation_s: float = 0.5

    airspeed_sigma: float = 1.0  # what gusts, sideslip and angle of attack make of it in a turn [m/s]
    airspeed_smoothing_s: float = 5.0
    airspeed_min: float = 10.0  # equivalent; below it the tube tells nothing [m/s]
    # Of the heading from one sample, as if errors were white [rad]: hard and soft iron of 2 deg that last for 15 s,
    # seen at 10 Hz, are worth 2 deg sqrt(2 * 15 * 10). Told less, the filter turns them into tilt.
    magnetometer_sigma: float = 30 * DEG
    iron_sigma: float = 0.0  # what iron makes of the heading while the body flies straight on [rad]

    any_motion: AnyMotion | None = None  # levels by this instead of in low dynamics, and takes all corrections at once

    correction: Correction = limited  # what of the estimated attitude error is taken out at the end of a period

    def in_any_motion(self, told: AnyMotion | None = None) -> AhrsConfig:
        """The same that levels whatever the body does (`nav.ahrs.any_motion`): the one configuration for all bodies."""
        return replace(self, period_s=0.2, tilt_sigma=3 * DEG, any_motion=told or AnyMotion())

    def __post_init__(self) -> None:
        unknown = set(self.aids) - set(KINDS.values())
        if unknown:
            raise ValueError(f"unknown aids {sorted(unknown)}, choose from {sorted(KINDS.values())}")
