"""The simulated feed: a motion, the sensors that report it, the faults that act on them."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

from nav.samples import ImuSamples, Sample
from testbed import sensors
from testbed.feeds.feed import Turn
from testbed.motion.ahead import Ahead
from testbed.motion.sections import FlightTruth, KinematicTruth
from testbed.motion.table import MotionSource, TruthBlock
from testbed.scenario import Scenario
from testbed.sensors.custom import Guard, is_own
from testbed.sensors.delivery import Delivery
from testbed.sensors.faults import Faults
from testbed.sensors.gnss import Gnss
from testbed.sensors.timing import AidingTiming


def motion(scenario: Scenario, seed: int) -> MotionSource:
    """The motion source that the scenario asks for, at its first tick."""
    if isinstance(scenario.truth, FlightTruth):
        from testbed.motion.flight import Flight

        return Flight(scenario.truth, scenario.plan, seed)
    from testbed.motion.kinematic import Kinematic

    truth = scenario.truth
    assert isinstance(truth, KinematicTruth)  # a log has a feed of its own
    return Kinematic(truth.start, truth.rate_hz, truth.track(), truth.body)


class Simulated:
    """A motion with the sensors of a scenario (`testbed.feeds.feed.Feed`); what it follows, if anything, is truth."""

    def __init__(self, scenario: Scenario, seed: int, source: MotionSource) -> None:
        self.source = source
        self.rate_hz = source.rate_hz
        self.motion_s = 0.0
        self.inertial: dict[str, sensors.Imu] = {}
        self.aiding: dict[str, sensors.AidingSensor] = {}
        self._own: dict[str, Guard] = {}  # of the user's
        self._deliveries: dict[str, Delivery] = {}
        for name, section in scenario.sensors.items():
            sensor = sensors.build(name, section, source.rate_hz, seed, scenario.site())
            if isinstance(sensor, sensors.Imu):
                self.inertial[name] = sensor
            else:
                self.aiding[name] = sensor
                assert isinstance(section, AidingTiming)
                self._deliveries[name] = Delivery(name, section, seed)
                if is_own(section):
                    self._own[name] = Guard(name, section, sensor)
        self.receptions = {name: one.reception for name, one in self.aiding.items() if isinstance(one, Gnss)}
        self.origin: dict[str, str] = {}
        self.faults = Faults(scenario.fault, scenario.sensors, seed)

    @property
    def failure(self) -> str:
        """Why the motion ended early, empty when it did not."""
        return self.source.failure

    def advance(self, ticks: int, wanted: Sequence[int]) -> Turn:
        """The next rows; nobody's estimate is needed for them."""
        before = time.perf_counter()
        block = self.source.advance(ticks)
        self.motion_s += time.perf_counter() - before
        return Turn(block, *self.sense(block))

    def sense(self, block: TruthBlock) -> tuple[dict[str, ImuSamples], dict[str, Sequence[Sample]]]:
        """What every sensor delivers over these rows: increments by IMU, samples by aiding sensor."""
        return (
            {name: self.faults.apply(name, sensor.sense(block)) for name, sensor in self.inertial.items()},
            {name: self.faults.apply(name, self._delivered(name, block)) for name in self.aiding},
        )

    def _delivered(self, name: str, block: TruthBlock) -> Sequence[Sample]:
        """What comes through of one aiding sensor."""
        sensor = self._own.get(name, self.aiding[name])
        return self._deliveries[name].of(sensor.sense(block))

    def activity(self) -> str:
        """What the motion is doing."""
        return self.source.activity()

    def take_events(self, until: float = math.inf) -> list[tuple[float, str, str]]:
        """None of its own."""
        return []

    def remark(self) -> str:
        """Nothing."""
        return ""

    def close(self) -> None:
        """End the process that flies ahead, if there is one."""
        if isinstance(self.source, Ahead):
            self.source.close()
