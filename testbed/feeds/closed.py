"""The closed feed: the motion follows an estimate by the autopilot. The one visible edge from estimators to motion."""

from __future__ import annotations

import math
from collections.abc import Sequence

from testbed.feeds.autopilot import Autopilot
from testbed.feeds.feed import Turn
from testbed.feeds.simulated import Simulated

CLOSED, NEVER = "loop_closed", "never"  # an attribute of records, and what it is at the end of such
NEVER_CLOSED = "the autopilot flew on truth to the end: what it was to fly on was never ready"


class Closed:
    """A simulated feed that is flown frame by frame (`testbed.feeds.feed.Feed`)."""

    def __init__(self, simulated: Simulated, autopilot: Autopilot) -> None:
        self.rate_hz, self.source = simulated.rate_hz, simulated.source
        self.faults, self.receptions = simulated.faults, simulated.receptions
        self._autopilot, self._simulated = autopilot, simulated

    @property
    def motion_s(self) -> float:
        """Wall time that the motion took so far."""
        return self._autopilot.motion_s

    @property
    def failure(self) -> str:
        """Why the motion ended early, empty when it did not."""
        return self._simulated.failure

    def advance(self, ticks: int, wanted: Sequence[int]) -> Turn:
        """The next rows, with what the estimators made of them that are flown on."""
        return self._autopilot.advance(ticks, wanted)

    def activity(self) -> str:
        """What the motion is doing."""
        return self._simulated.activity()

    def take_events(self, until: float = math.inf) -> list[tuple[float, str, str]]:
        """Remove and give the autopilot's events up to a time."""
        return self._autopilot.take_events(until)

    @property
    def origin(self) -> dict[str, str]:
        """What the record says of where the motion came from, and whether the loop was ever closed."""
        return self._simulated.origin | {CLOSED: "yes" if self._autopilot.closed else NEVER}

    def remark(self) -> str:
        """That the loop was never closed, if it was not."""
        return "" if self._autopilot.closed else NEVER_CLOSED

    def close(self) -> None:
        """Let go of what the motion holds."""
        self._simulated.close()
