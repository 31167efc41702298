"""Turns of a run as steps: one per sample of the first IMU, with what else has arrived since the step before."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from nav.samples import Array, Sample
from testbed.feeds.feed import Surfaces, Turn
from testbed.motion.table import TruthBlock

S = TypeVar("S", bound=Sample)
SAME_TIME_S = 1e-6


@dataclass(frozen=True, slots=True)
class Step:
    """One inertial sample at ``t`` [s]: mean rate [rad/s] and specific force [m/s^2], body, over ``dt`` [s].

    ``arrived`` are the newest samples of those sensors that had news since the step before; ``truth`` one row.
    """

    t: float
    dt: float
    gyro: Array
    accel: Array
    arrived: Mapping[str, Sample]
    truth: TruthBlock

    def first(self, kind: type[S]) -> S | None:
        """News of the first sensor of a kind, None when it has none."""
        return next((one for one in self.arrived.values() if isinstance(one, kind)), None)


def moved(roll: float, pitch: float, yaw: float, throttle: float) -> Surfaces | None:
    """Surfaces of commands that are positive to the right, up and right, from -1 to 1, and throttle from 0 to 1.

    What is beyond is the limit; None where one is no number.
    """
    commands = np.array([roll, -pitch, -yaw, throttle])
    if not np.isfinite(commands).all():
        return None
    return Surfaces(*np.clip(commands, [-1.0, -1.0, -1.0, 0.0], 1.0).tolist())


class Stepper:
    """Makes steps of turns; keeps samples that have not arrived yet."""

    def __init__(self) -> None:
        self._pending: list[tuple[float, int, Sample]] = []
        self._count = 0

    def steps(self, turn: Turn) -> Iterator[Step]:
        """The steps of one turn, none where it has no inertial samples."""
        for samples in turn.samples.values():
            for sample in samples:
                heapq.heappush(self._pending, (sample.t_arrival, self._count, sample))
                self._count += 1
        imu = next(iter(turn.imu.values()), None)
        if imu is None:
            return
        rows = np.searchsorted(turn.reference.t, imu.t - SAME_TIME_S).clip(0, len(turn.reference) - 1)
        for k, t in enumerate(imu.t.tolist()):
            dt, row = float(imu.dt[k]), int(rows[k])
            gyro, accel = imu.dtheta[k] / dt, imu.dv[k] / dt
            yield Step(t, dt, gyro, accel, self._until(t), turn.reference.rows(row, row + 1))

    def _until(self, t: float) -> dict[str, Sample]:
        arrived = {}
        while self._pending and self._pending[0][0] <= t + SAME_TIME_S:
            sample = heapq.heappop(self._pending)[2]
            arrived[sample.sensor] = sample
        return arrived
