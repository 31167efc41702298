"""``kind = "px4"``: PX4's own estimator, which runs in PX4 on the samples that the run sends it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Literal, NoReturn

from pydantic import Field

from testbed.errors import UserError
from testbed.estimators.rig import Rig
from testbed.estimators.section import EstimatorSection, Mistake
from testbed.sensors import SensorConfig

FIRST_ONLY = ("barometer", "magnetometer", "airspeed")  # of these PX4 is sent one unit's samples


class Px4Section(EstimatorSection):
    """Keys of PX4's own estimator."""

    kind: Literal["px4"] = "px4"
    address: str = Field(default="udpin:127.0.0.1:14540", description="where PX4's MAVLink comes to, udpin:HOST:PORT")

    def aiding(self, sensors: Mapping[str, SensorConfig]) -> tuple[str, ...]:
        """The names of the sensors whose samples PX4 is sent: every receiver, and the first of other kinds."""
        kinds = {name: sensor.kind for name, sensor in sensors.items()}
        firsts = {next((name for name, own in kinds.items() if own == kind), "") for kind in FIRST_ONLY}
        return tuple(name for name, kind in kinds.items() if kind == "gnss" or name in firsts)

    def mistakes(self, sensors: Mapping[str, SensorConfig]) -> Iterator[Mistake]:
        """What is wrong with it among these sensors."""
        yield from super().mistakes(sensors)
        first = next((name for name, sensor in sensors.items() if sensor.kind == "imu"), self.imu)
        if self.imu != first:
            yield ("imu",), f"PX4 is sent the samples of the first IMU, {first!r}: name that one, or leave it out"
        if self.spare_imus:
            yield ("spare_imus",), "PX4 is sent the samples of one IMU: leave it out"


def build(section: Px4Section, rig: Rig) -> NoReturn:
    """Nothing of it is in this house. Raises UserError, which says where it is."""
    raise UserError(
        f"estimator {section.name}: is PX4's own, which is there while PX4 follows the run: add --px4, or leave it out"
    )
