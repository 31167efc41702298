"""Sensors: truth in, samples with the errors of real hardware out. One file per sensor.

Each file declares its scenario section (datasheet units, with a grade that presets it), its errors in SI, and the
sensor. `timing` says when samples come, `noise` how random errors are drawn.
"""

from __future__ import annotations

from typing import TypeAlias

from testbed.schema import Section
from testbed.sensors.airspeed import Airspeed, AirspeedConfig
from testbed.sensors.barometer import Barometer, BarometerConfig
from testbed.sensors.body_velocity import BodyVelocity, BodyVelocityConfig
from testbed.sensors.gnss import Gnss, GnssConfig
from testbed.sensors.imu import Imu, ImuConfig
from testbed.sensors.magnetometer import Magnetometer, MagnetometerConfig, Site, geomagnetic_field_n
from testbed.sensors.position_fix import PositionFix, PositionFixConfig
from testbed.sensors.star_tracker import StarTracker, StarTrackerConfig

__all__ = [
    "CONFIGS",
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
)
AidingSensor: TypeAlias = Gnss | Magnetometer | Barometer | Airspeed | BodyVelocity | StarTracker | PositionFix
Sensor: TypeAlias = Imu | AidingSensor

# by kind
CONFIGS: dict[str, type[Section]] = {
    "imu": ImuConfig,
    "gnss": GnssConfig,
    "magnetometer": MagnetometerConfig,
    "barometer": BarometerConfig,
    "airspeed": AirspeedConfig,
    "body_velocity": BodyVelocityConfig,
    "star_tracker": StarTrackerConfig,
    "position_fix": PositionFixConfig,
}


def build(name: str, config: SensorConfig, tick_rate_hz: float, seed: int, site: Site) -> Sensor:
    """The sensor for one run. Raises UserError when its samples do not fall on ticks or no field model has the date."""
    match config:
        case ImuConfig():
            return Imu(name, config, tick_rate_hz, seed)
        case GnssConfig():
            return Gnss(name, config, tick_rate_hz, seed)
        case MagnetometerConfig():
            return Magnetometer(name, config, tick_rate_hz, seed, site)
        case BarometerConfig():
            return Barometer(name, config, tick_rate_hz, seed)
        case AirspeedConfig():
            return Airspeed(name, config, tick_rate_hz, seed)
        case BodyVelocityConfig():
            return BodyVelocity(name, config, tick_rate_hz, seed)
        case StarTrackerConfig():
            return StarTracker(name, config, tick_rate_hz, seed)
        case PositionFixConfig():
            return PositionFix(name, config, tick_rate_hz, seed)
