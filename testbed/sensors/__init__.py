"""Sensors: truth in, samples with the errors of real hardware out. One file per sensor.

Each file declares its scenario section (datasheet units, with a grade that presets it), its errors in SI, its recorded
columns with their units, and the sensor. `timing` says when samples come, `noise` how random errors are drawn.
"""

from __future__ import annotations

from typing import TypeAlias

from testbed.schema import Section
from testbed.sensors import airspeed, barometer, gnss, imu, magnetometer
from testbed.sensors.airspeed import Airspeed, AirspeedConfig
from testbed.sensors.barometer import Barometer, BarometerConfig
from testbed.sensors.gnss import Gnss, GnssConfig
from testbed.sensors.imu import Imu, ImuConfig
from testbed.sensors.magnetometer import Magnetometer, MagnetometerConfig, Site, geomagnetic_field_n
from testbed.sensors.timing import Schedule, ticks_per_sample
from testbed.truth import Column

__all__ = [
    "COLUMNS",
    "CONFIGS",
    "AidingSensor",
    "Imu",
    "Sensor",
    "SensorConfig",
    "Site",
    "build",
    "check_timing",
    "geomagnetic_field_n",
]

SensorConfig: TypeAlias = ImuConfig | GnssConfig | MagnetometerConfig | BarometerConfig | AirspeedConfig
AidingSensor: TypeAlias = Gnss | Magnetometer | Barometer | Airspeed
Sensor: TypeAlias = Imu | AidingSensor

# by kind
CONFIGS: dict[str, type[Section]] = {
    "imu": ImuConfig,
    "gnss": GnssConfig,
    "magnetometer": MagnetometerConfig,
    "barometer": BarometerConfig,
    "airspeed": AirspeedConfig,
}
COLUMNS: dict[str, dict[str, Column]] = {
    "imu": imu.COLUMNS,
    "gnss": gnss.COLUMNS,
    "magnetometer": magnetometer.COLUMNS,
    "barometer": barometer.COLUMNS,
    "airspeed": airspeed.COLUMNS,
}


def check_timing(name: str, config: SensorConfig, tick_rate_hz: float) -> None:
    """Raises UserError when the sensor's samples would not fall on ticks."""
    if isinstance(config, ImuConfig):
        ticks_per_sample(name, config.rate_hz, tick_rate_hz)
    else:
        Schedule.of(name, config, tick_rate_hz)


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
