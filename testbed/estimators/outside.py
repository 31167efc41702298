"""Estimators of autopilots, ``kind = "px4"`` and ``"ardupilot"``, which run there on the samples that the run sends."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import ClassVar, Literal, NoReturn

from pydantic import Field

from testbed.errors import UserError
from testbed.estimators.rig import Rig
from testbed.estimators.section import EstimatorSection, Mistake
from testbed.sensors import SensorConfig


class OutsideSection(EstimatorSection):
    """What the sections of both have in common; each has an ``address``, where it speaks to."""

    autopilot: ClassVar[str]
    option: ClassVar[str]  # with which it follows a run
    firsts: ClassVar[tuple[str, ...]]  # kinds of aiding sensors of which it is sent one unit's samples
    address: str

    def aiding(self, sensors: Mapping[str, SensorConfig]) -> tuple[str, ...]:
        """The names of the sensors whose samples it is sent: every receiver, and the first of some kinds."""
        kinds = {name: sensor.kind for name, sensor in sensors.items()}
        firsts = {next((name for name, own in kinds.items() if own == kind), "") for kind in self.firsts}
        return tuple(name for name, kind in kinds.items() if kind == "gnss" or name in firsts)

    def mistakes(self, sensors: Mapping[str, SensorConfig]) -> Iterator[Mistake]:
        """What is wrong with it among these sensors."""
        yield from super().mistakes(sensors)
        first = next((name for name, sensor in sensors.items() if sensor.kind == "imu"), self.imu)
        if self.imu != first:
            text = f"{self.autopilot} is sent the samples of the first IMU, {first!r}: name that one, or leave it out"
            yield ("imu",), text
        if self.spare_imus:
            yield ("spare_imus",), f"{self.autopilot} is sent the samples of one IMU: leave it out"


class Px4Section(OutsideSection):
    """Keys of PX4's own estimator."""

    autopilot, option, firsts = "PX4", "--px4", ("barometer", "magnetometer", "airspeed")
    kind: Literal["px4"] = "px4"
    address: str = Field(default="udpin:127.0.0.1:14540", description="where PX4's MAVLink comes to, udpin:HOST:PORT")


class ArduPilotSection(OutsideSection):
    """Keys of ArduPilot's own estimator. Receivers' samples are sent with ``--gps-input`` only."""

    autopilot, option, firsts = "ArduPilot", "--ardupilot", ("airspeed",)
    kind: Literal["ardupilot"] = "ardupilot"
    address: str = Field(
        default="udpin:127.0.0.1:14550", description="where ArduPilot's MAVLink comes to, udpin:HOST:PORT"
    )


def build(section: OutsideSection, rig: Rig) -> NoReturn:
    """Nothing of it is in this house. Raises UserError, which says where it is."""
    one = section.autopilot
    raise UserError(
        f"estimator {section.name}: is {one}'s own, which is there while {one} follows the run: add {section.option},"
        " or leave it out"
    )
