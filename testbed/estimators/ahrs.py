"""``kind = "ahrs"``: attitude alone, levelled by specific force while the motion allows it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from pydantic import Field

from nav.ahrs import Ahrs, AhrsConfig
from nav.aids.magnetometer import FIELD_SIZE
from nav.earth import STANDARD_GRAVITY
from nav.horizon import FusionHorizon
from nav.motion import LowDynamics
from nav.samples import Array
from testbed.estimators.datasheet import CRUISE_THROTTLE, SOFT_IRON_SHARE, imu_model
from testbed.estimators.lane import Commanded, Lane, mountings
from testbed.estimators.rig import Rig
from testbed.estimators.section import (
    EstimatorSection,
    Gust,
    Mistake,
    TurnRate,
    aid_mistakes,
    second_of_a_kind,
)
from testbed.motion.aircraft import UNKNOWN_BODY
from testbed.schema import Heading, Section
from testbed.sensors import SensorConfig, geomagnetic_field_n
from testbed.sensors.magnetometer import MagnetometerConfig

USABLE_AIDS = frozenset({"barometer", "magnetometer", "airspeed"})
FIELD_ERROR = 1.4e-7  # of the model of it [T]: `geomagnetic_field_n`
LEVELLING_FORCE = 0.3  # what light turbulence leaves of a second's mean horizontal specific force [m/s^2]
IRON_TURN_S = 15.0  # how long iron pulls the heading the same way, turning at 0.06 rad/s: so much more than noise
BIASES_FOLLOWED = 3.0  # of the gyros, 1 sigma: the drift that corrections are never slower than
NEVER_LEVEL = LowDynamics(roll_rate_limit=-1.0)
LEVEL_BANK = math.radians(5.0)  # commanded; a straight in light turbulence takes 2.5 (99 % of the time)


class LevelSection(Section):
    """When an AHRS takes specific force for tilt, and how far it follows; with airspeed as without.

    Defaults are those of Jiang et al. 2021 (`nav.motion.LowDynamics`, `nav.ahrs.AhrsConfig`).
    """

    acceleration_mps2: float = Field(default=0.2, gt=0, le=10, description="largest acceleration at which it levels")
    yaw_rate_degps: float = Field(
        default=0.5, gt=0, le=100, description="largest rate about the body's down axis at which it levels"
    )
    roll_rate_degps: float = Field(
        default=2.0, gt=0, le=100, description="largest rate about the body's forward axis at which it levels"
    )
    test: Literal["norm", "vector"] = Field(
        default="norm",
        description="acceleration by the size of specific force less gravity, or by its vector less gravity",
    )
    force_sigma_mps2: float = Field(default=0.1, gt=0, le=10, description="of a second's mean, as a sign of tilt")
    limit_deg: float = Field(default=0.2, gt=0, le=20, description="largest correction per second and axis")
    gyro_bias_feedback: bool = Field(default=False, description="biases of the level gyros are taken off as well")
    gyro_misalignment_mrad: float = Field(
        default=0.0,
        ge=0,
        le=100,
        description="of axes that it estimates, in place of a bias that walks with every turn; 0: it does not",
    )
    accel_bias_mg: float = Field(
        default=0.0, ge=0, le=100, description="of constant accelerometer biases that it estimates; 0: it does not"
    )
    gust_mps2: float = Field(
        default=0.0,
        ge=0,
        le=10,
        description="of horizontal accelerations by gusts, each axis, that it models beside the white rest; 0: none",
    )
    gust_correlation_s: float = Field(default=0.5, ge=0.01, le=100, description="how long one of them lasts")


class AhrsSection(EstimatorSection):
    """Keys of an AHRS (`nav.ahrs.AhrsConfig`)."""

    kind: Literal["ahrs"] = "ahrs"
    aids: tuple[str, ...] = Field(description="sensors whose samples it uses, by their names")
    turn_degps: TurnRate = None
    gust_mps: Gust = None
    heading_deg: Heading | None = Field(default=None, description="at the start, of one without magnetometer")
    profile: Literal["jiang2021", "any_motion"] = Field(
        default="jiang2021",
        description="jiang2021: levels in low dynamics only; any_motion: always, on any vehicle; it also gates the"
        " magnetic field and finds gyro biases at rest",
    )
    levelling: bool = Field(default=True, description="false: once it has begun, it goes by its gyros alone")
    level: LevelSection | None = Field(
        default=None,
        description="how it levels; none: as light turbulence wants: force_sigma_mps2 0.3, limit_deg what the gyros"
        " drift where that is more, and with airspeed acceleration_mps2 1, yaw_rate_degps 10 and roll_rate_degps 10;"
        " a table of any one key sets all others to their own defaults instead",
    )
    autopilot: bool = Field(default=False, description="true: it levels only while level flight is commanded")

    @property
    def attitude_only(self) -> bool:
        """Whether it estimates no position and no velocity."""
        return True

    def mistakes(self, sensors: Mapping[str, SensorConfig]) -> Iterator[Mistake]:
        """What is wrong with it among these sensors."""
        blind = "magnetometer" not in [sensors[aid].kind for aid in self.aids if aid in sensors]
        if blind and self.heading_deg is None:
            yield ("heading_deg",), "is missing: an AHRS without magnetometer is told where it points at the start"
        elif not blind and self.heading_deg is not None:
            yield ("heading_deg",), "the magnetometer among the aids finds the heading: leave one of the two out"
        if self.profile == "any_motion":
            for key in ("level", "autopilot", "levelling"):
                if key in self.model_fields_set:
                    yield (key,), 'says how profile "jiang2021" levels: leave it out, or the profile "any_motion"'
        yield from super().mistakes(sensors)
        yield from aid_mistakes("ahrs", self.aids, sensors, USABLE_AIDS, own=False)
        yield from second_of_a_kind("ahrs", self.aids, sensors)


@dataclass
class FlightControl:
    """Tells an AHRS when its autopilot commands level flight: no turn, no climb, no change of speed.

    `LEVEL_BANK` is what keeping a straight course in gusts
    takes.
    """

    ahrs: Ahrs
    _held: Array = field(default_factory=lambda: np.full(2, np.nan))  # last commanded altitude [m] and airspeed [m/s]

    def tell(self, commanded: Commanded) -> None:
        """Pass on what is in effect."""
        held = np.column_stack([commanded.altitude, commanded.airspeed])
        before = np.vstack([self._held, held[:-1]])
        moved = (held != before) & ~np.isnan(before)
        self._held = held[-1].copy()
        self.ahrs.flight_control(commanded.t, (np.abs(commanded.bank) <= LEVEL_BANK) & ~moved.any(axis=1))


def build(section: AhrsSection, rig: Rig) -> Lane:
    """Attitude alone."""
    return lane(section, rig, configuration(section, rig))


def configuration(section: AhrsSection, rig: Rig) -> AhrsConfig:
    """What the filter is told: its area of operation too, and its heading where no magnetometer finds it."""
    errors, site = rig.imu_errors(section.imu, *section.spare_imus), rig.site
    aids = {rig.sensors[name].kind: rig.sensors[name] for name in section.aids}
    config = AhrsConfig(
        imu_model(errors, rig.turn_rate(section.turn_degps), usual=rig.usual),
        site.lat,
        site.h,
        tuple(aids),
        airspeed_sigma=rig.air(section.gust_mps).gust,
        force_sigma=LEVELLING_FORCE,
    )
    level = section.level
    if section.profile == "any_motion" or (level is not None and level.gyro_misalignment_mrad > 0):
        aligned = replace(errors, gyro_misalignment=0.0, gyro_nonorthogonality=0.0, gyro_scale=0.0)
        config = replace(config, imu=imu_model(aligned, usual=rig.usual))
    if level is not None:
        yaw_rate, roll_rate = math.radians(level.yaw_rate_degps), math.radians(level.roll_rate_degps)
        limits = LowDynamics(level.acceleration_mps2, yaw_rate, roll_rate, level.test)
        config = replace(
            config,
            motion=limits,
            compensated_motion=limits,
            force_sigma=level.force_sigma_mps2,
            phi_limit=math.radians(level.limit_deg),
            gyro_bias_feedback=level.gyro_bias_feedback,
            gyro_misalignment_sigma=level.gyro_misalignment_mrad * 1e-3,
            accel_bias_sigma=level.accel_bias_mg * 1e-3 * STANDARD_GRAVITY,
            gust_sigma=level.gust_mps2,
            gust_correlation_s=level.gust_correlation_s,
        )
    drift = BIASES_FOLLOWED * config.imu.gyro_bias_sigma * config.period_s
    if level is None:  # a limit below what the gyros drift in a period never brings the horizon back
        config = replace(config, phi_limit=max(config.phi_limit, drift))
    if section.profile == "any_motion":
        config = config.in_any_motion()
    if not section.levelling:
        config = replace(config, motion=NEVER_LEVEL, compensated_motion=NEVER_LEVEL)
    if section.heading_deg is not None:
        config = replace(config, heading=math.radians(section.heading_deg))
    magnetometer = aids.get("magnetometer")
    if isinstance(magnetometer, MagnetometerConfig):
        m = magnetometer.errors()
        stray = math.hypot(m.current * rig.usual.current_a, m.throttle * CRUISE_THROTTLE)
        iron = math.hypot(SOFT_IRON_SHARE * m.soft_iron * FIELD_SIZE, m.hard_iron, stray)
        turn_s = IRON_TURN_S * (UNKNOWN_BODY.turn_rate_radps / rig.usual.turn_rate_radps)
        lasting = math.hypot(iron, FIELD_ERROR) * math.sqrt(2 * turn_s * magnetometer.rate_hz)
        field_n = _field_n(rig)
        level_field = math.hypot(field_n[0], field_n[1])
        config = replace(
            config,
            magnetometer_sigma=math.hypot(m.noise, lasting) / level_field,
            iron_sigma=math.hypot(iron, FIELD_ERROR) / level_field,
        )
    return config


def lane(section: AhrsSection, rig: Rig, config: AhrsConfig) -> Lane:
    """The estimator of a ``section`` that is told ``config``."""
    ahrs = Ahrs(config, _field_n(rig))
    imus, voter = mountings(section, rig)
    return Lane(
        FusionHorizon(ahrs, rig.lag_s(section.aids), coning=rig.imu(section.imu).rate_hz < rig.tick_rate_hz),
        imus,
        section.aids,
        voter=voter,
        commanded=FlightControl(ahrs).tell if section.autopilot else None,
    )


def _field_n(rig: Rig) -> Array:
    """The reference magnetic field of the area of operation, NED [T]."""
    return geomagnetic_field_n(rig.site.lat, rig.site.lon, rig.site.h, rig.site.date)
