"""What a run is made of, whoever makes it: the reference motion, and what every sensor delivered on the way."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import NamedTuple, Protocol

import numpy as np

from nav.columns import Estimates, Reports
from nav.samples import ImuSamples, Sample
from testbed.estimators.lane import Tracked
from testbed.motion.table import MotionSource, TruthBlock
from testbed.sensors.faults import Faults
from testbed.sensors.gnss import Reception


class Surfaces(NamedTuple):
    """What moves an aircraft: shares of travel (-1 to 1) with the signs of recorded controls, and throttle (0 to 1)."""

    aileron: float
    elevator: float
    rudder: float
    throttle: float


class Steered(NamedTuple):
    """What a far end commands from ``t`` [s] on, None as long as it leaves the plan to be flown."""

    t: float
    surfaces: Surfaces | None


class Turn(NamedTuple):
    """What came of some ticks: the reference, increments by IMU, and the samples by aiding sensor.

    ``tracked`` is what those estimators made of it that the motion itself follows; the others run in the loop.
    ``steered`` is what a far end commanded that is to fly, at each of its steps.
    """

    reference: TruthBlock
    imu: Mapping[str, ImuSamples]
    samples: Mapping[str, Sequence[Sample]]
    tracked: Mapping[str, Tracked] = {}
    steered: Sequence[Steered] = ()


class Feed(Protocol):
    """A source of turns. ``faults``, ``receptions`` (by receiver) and ``source`` are what requests act on
    (`testbed.loop.requests`).
    """

    rate_hz: float
    faults: Faults
    receptions: dict[str, Reception]
    source: MotionSource

    @property
    def origin(self) -> dict[str, str]:
        """What a record says, by attribute, of a reference that is no truth and of a far end."""
        ...

    @property
    def motion_s(self) -> float:
        """Wall time [s] that the motion took so far."""
        ...

    @property
    def failure(self) -> str:
        """Why the motion ended early, empty when it did not."""
        ...

    def advance(self, ticks: int, wanted: Sequence[int]) -> Turn:
        """The next ``ticks`` rows, fewer when the motion ends; estimates are needed of the rows ``wanted``."""
        ...

    def activity(self) -> str:
        """What is going on at the end of the newest turn."""
        ...

    def take_events(self, until: float = math.inf) -> list[tuple[float, str, str]]:
        """Remove and give its own events (time, severity, text) up to a time."""
        ...

    def remark(self) -> str:
        """What else the caller should know at the end, empty when nothing."""
        ...

    def close(self) -> None:
        """Let go of what it holds."""
        ...


def join(turns: Sequence[Turn]) -> Turn:
    """Consecutive turns as one."""
    if len(turns) == 1:
        return turns[0]
    columns = {
        field.name: np.concatenate([getattr(turn.reference, field.name) for turn in turns])
        for field in fields(TruthBlock)
        if field.name != "tick"
    }
    first = turns[0]
    return Turn(
        TruthBlock(first.reference.tick, **columns),
        {name: _join_imu([turn.imu[name] for turn in turns]) for name in first.imu},
        {name: [sample for turn in turns for sample in turn.samples[name]] for name in first.samples},
        {
            name: Tracked(
                _join_imu([turn.tracked[name].increments for turn in turns]),
                [report for turn in turns for report in turn.tracked[name].votes],
                Reports.joined(turn.tracked[name].reports for turn in turns),
                Estimates.of(turn.tracked[name].estimates for turn in turns),
            )
            for name in first.tracked
        },
        [one for turn in turns for one in turn.steered],
    )


def _join_imu(pieces: Sequence[ImuSamples]) -> ImuSamples:
    columns = ("t", "dt", "dtheta", "dv")
    return ImuSamples(*(np.concatenate([getattr(piece, name) for piece in pieces]) for name in columns))
