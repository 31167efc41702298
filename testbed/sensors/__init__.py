"""Sensors: truth in, samples with the errors of real hardware out. One file per sensor.

Each file declares its scenario section (datasheet units, with a grade that presets it), its errors in SI, and the
sensor. `timing` says when samples come, `noise` how random errors are drawn.
"""

from __future__ import annotations

from typing import TypeAlias

from testbed.sensors import custom, registry
from testbed.sensors.airspeed import Airspeed, AirspeedConfig
from testbed.sensors.barometer import Barometer, BarometerConfig
from testbed.sensors.body_velocity import BodyVelocity, BodyVelocityConfig
from testbed.sensors.gnss import Gnss, GnssConfig
from testbed.sensors.imu import Imu, ImuConfig
from testbed.sensors.magnetometer import Magnetometer, MagnetometerConfig, geomagnetic_field_n
from testbed.sensors.optical_flow import OpticalFlow, OpticalFlowConfig
from testbed.sensors.position_fix import PositionFix, PositionFixConfig
from testbed.sensors.rangefinder import Rangefinder, RangefinderConfig
from testbed.sensors.site import Site
from testbed.sensors.star_tracker import StarTracker, StarTrackerConfig
from testbed.sensors.wind_report import WindReport, WindReportConfig

__all__ = [
    "AidingSensor",
    "Imu",
    "Sensor",
    "SensorConfig",
    "Site",
    "build",
    "geomagnetic_field_n",
]

SensorConfig: TypeAlias = (
    ImuConfig
    | GnssConfig
    | MagnetometerConfig
    | BarometerConfig
    | AirspeedConfig
    | BodyVelocityConfig
    | StarTrackerConfig
    | PositionFixConfig
    | RangefinderConfig
    | OpticalFlowConfig
    | WindReportConfig
)
AidingSensor: TypeAlias = (
    Gnss
    | Magnetometer
    | Barometer
    | Airspeed
    | BodyVelocity
    | StarTracker
    | PositionFix
    | Rangefinder
    | OpticalFlow
    | WindReport
)
Sensor: TypeAlias = Imu | AidingSensor


def build(name: str, config: SensorConfig, tick_rate_hz: float, seed: int, site: Site) -> Sensor:
    """The sensor for one run. Raises UserError when its samples do not fall on ticks or no field model has the date."""
    local = isinstance(config, MagnetometerConfig | RangefinderConfig | OpticalFlowConfig)
    given = (tick_rate_hz, seed, *([site] if local else []))
    own = custom.is_own(config)
    sensor: Sensor = custom.made(name, config, *given) if own else registry.of(config).sensor(name, config, *given)
    return sensor
