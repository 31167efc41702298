"""A feed that is flown from outside: a far end hears each inertial sample, and what it commands moves the surfaces.

A run that begins in the air flies the plan until the far end takes over, which is an event. Then neither plan nor
inner loops have a say. What it answers to a sample moves the aircraft from that sample's time on. A run that begins on
the ground stays there until the far end has taken over and its throttle is up.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from testbed.feeds.bridged import FarEnd, told_of
from testbed.feeds.feed import Steered, Turn, join
from testbed.feeds.simulated import Simulated
from testbed.motion.table import MotionSource, TruthBlock

TAKES_OVER = "{} flies from here on"
NEVER_FLOWN = "the plan was flown to the end: {} never took over"
NEVER_LAUNCHED = "the aircraft was on the ground to the end: {} was never armed with its throttle up"


def is_step(turn: Turn) -> bool:
    """Whether a sample of the first IMU came of it; the loop may ask for less than the ticks from one to the next."""
    return len(next(iter(turn.imu.values()), ())) > 0


@runtime_checkable
class Movable(MotionSource, Protocol):
    """A motion whose surfaces can be moved: `testbed.motion.flight.Flight`."""

    @property
    def on_ground(self) -> bool:
        """Whether it has not been launched yet."""
        ...

    def wait(self) -> None:
        """Take off when who moves it wants to, and not before."""
        ...

    def move(self, aileron: float, elevator: float, rudder: float, throttle: float) -> None:
        """Let these fly from now on."""
        ...

    def give_up(self, why: str) -> None:
        """End the motion here; ``why`` becomes its failure."""
        ...


class Piloted:
    """A simulated feed that a far end flies (`testbed.feeds.feed.Feed`), one inertial sample after the other."""

    def __init__(self, simulated: Simulated, source: Movable, far_end: FarEnd, imu_hz: float) -> None:
        self.rate_hz, self.source = simulated.rate_hz, simulated.source
        self.faults, self.receptions = simulated.faults, simulated.receptions
        self.motion_s = 0.0
        self._simulated, self._movable, self._far_end = simulated, source, far_end
        self._every = max(1, round(self.rate_hz / imu_hz))  # ticks from sample to sample
        self._tick = 0
        self._events: list[tuple[float, str, str]] = []
        self._taken_over = False
        source.wait()

    @property
    def origin(self) -> dict[str, str]:
        """Who flies."""
        return self._simulated.origin | {"far_end": told_of(self._far_end)}

    @property
    def failure(self) -> str:
        """Why the motion ended early, empty when it did not."""
        return self._simulated.failure

    def advance(self, ticks: int, wanted: Sequence[int]) -> Turn:
        """The next rows, fewer when the motion or the far end ends; nobody's estimate is needed for them."""
        turns: list[Turn] = []
        done = 0
        while done < ticks:
            before = time.perf_counter()
            block = self._movable.advance(min(ticks - done, 1 + -self._tick % self._every))
            self.motion_s += time.perf_counter() - before
            if not len(block):
                break
            turn = Turn(block, *self._simulated.sense(block))
            done += len(block)
            self._tick += len(block)
            self._far_end.follow(turn)
            turns.append(turn._replace(steered=self._obey(turn)))
        return join(turns) if turns else Turn(TruthBlock.empty(self._tick, 0), {}, {})

    def _obey(self, turn: Turn) -> Sequence[Steered]:
        """Let it move the surfaces; what it commands, where the turn was a step to it."""
        t, surfaces = float(turn.reference.t[-1]), self._far_end.surfaces
        if self._far_end.failure:
            self._movable.give_up(self._far_end.failure)
            return ()
        if surfaces is not None:
            self._movable.move(*surfaces)
            if not self._taken_over:
                self._events.append((t, "info", TAKES_OVER.format(self._far_end.name)))
            self._taken_over = True
        return (Steered(t, surfaces),) if is_step(turn) else ()

    def activity(self) -> str:
        """What the motion is doing."""
        return self._simulated.activity()

    def take_events(self, until: float = math.inf) -> list[tuple[float, str, str]]:
        """Remove and give its events up to a time."""
        taken = [event for event in self._events if event[0] <= until]
        self._events = self._events[len(taken) :]
        return taken

    def remark(self) -> str:
        """That nobody took over, or took off, if so."""
        if self._movable.on_ground:
            return NEVER_LAUNCHED.format(self._far_end.name)
        return "" if self._taken_over else NEVER_FLOWN.format(self._far_end.name)

    def close(self) -> None:
        """Let go of what the motion holds."""
        self._simulated.close()
