"""What a builder of estimators may know of a run: datasheets, the site, the rates. Never what is true."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from testbed.motion.aircraft import UNKNOWN_BODY, Usual
from testbed.motion.gusts import UNKNOWN_AIR
from testbed.motion.weather import UNKNOWN_WALK
from testbed.sensors import SensorConfig, Site
from testbed.sensors.imu import ImuConfig, ImuErrors


@dataclass(frozen=True, slots=True)
class Air:
    """What is expected of the air: gusts, rms per axis [m/s], and the random walk of the mean wind [m/s/sqrt(s)]."""

    gust: float = UNKNOWN_AIR
    wind_walk: float = UNKNOWN_WALK


@dataclass(frozen=True, slots=True)
class Rig:
    """The sensors of a run by name, each a section of the scenario whose ``errors()`` is its datasheet in SI units.

    ``site`` is the area of operation and the date, known within kilometres; ``tick_rate_hz`` the rate of the motion;
    ``seed`` that of the run, for what an estimator draws itself. Files that a scenario names lie in ``folder``.
    ``usual`` is how the aircraft, or a body of which nothing is known, usually flies; ``expected_air`` the
    gusts that its plan meets and how the scenario's wind wanders.
    """

    sensors: Mapping[str, SensorConfig]
    site: Site
    tick_rate_hz: float
    seed: int
    folder: Path = field(default_factory=Path)
    usual: Usual = UNKNOWN_BODY
    expected_air: Air = Air()

    def imu(self, name: str) -> ImuConfig:
        """The section of an IMU. Raises ValueError when ``name`` is no IMU."""
        section = self.sensors[name]
        if not isinstance(section, ImuConfig):
            raise ValueError(f"{name!r} is a sensor of kind {section.kind!r}, not an IMU")
        return section

    def imu_errors(self, main: str, *spare: str) -> ImuErrors:
        """What is told of the average of several units: the largest of each error, all else as of the ``main`` one."""
        errors = [self.imu(name).errors() for name in (main, *spare)]
        sizes = [one.name for one in fields(ImuErrors) if one.type == "float" and not one.name.endswith("_tau")]
        return replace(errors[0], **{name: max(getattr(one, name) for one in errors) for name in sizes})

    def turn_rate(self, told_degps: float | None) -> float:
        """The rate of turn [rad/s] that an estimator is told, or else the usual one."""
        return self.usual.turn_rate_radps if told_degps is None else math.radians(told_degps)

    def air(self, gust_mps: float | None, wind_walk: float | None = None) -> Air:
        """The gusts [m/s] and walk of the wind [m/s/sqrt(s)] that an estimator is told of, else the scenario's."""
        expected = self.expected_air
        return Air(
            expected.gust if gust_mps is None else gust_mps, expected.wind_walk if wind_walk is None else wind_walk
        )

    def spacing_s(self, names: Iterable[str]) -> dict[str, float]:
        """How far apart [s] the samples of these sensors must be that a filter takes, where that is limited."""
        sections = {name: self.sensors[name] for name in names}
        return {
            name: 1 / section.fused_hz
            for name, section in sections.items()
            if not isinstance(section, ImuConfig) and section.fused_hz is not None
        }

    def lag_s(self, names: Iterable[str]) -> float:
        """The largest age [s] at which samples of the aids of these names arrive."""
        sections = [self.sensors[name] for name in names]
        return max((section.age_s for section in sections if not isinstance(section, ImuConfig)), default=0.0)
