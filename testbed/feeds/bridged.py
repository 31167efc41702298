"""A feed with somebody listening: each turn goes to a far end, such as an autopilot, before it goes on as it is."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Protocol

from nav.columns import Estimates
from testbed.feeds.feed import Feed, Surfaces, Turn

OURS, THEIRS = "ours", "theirs"  # whose samples of a kind of sensor a far end has


class FarEnd(Protocol):
    """A program outside that is told what the sensors say, step by step, and answers each step.

    ``name`` is what it is called. ``failure`` is why it no longer answers, empty as long as it does. ``flies`` says
    whether it is to move the aircraft; then ``surfaces`` are what it commands, None as long as it does not.
    ``estimators`` are the names of those of the scenario that run in it. ``sensors`` says of each kind whether it is
    told ours, where the scenario has one, or makes its own.
    """

    name: str
    failure: str
    flies: bool
    surfaces: Surfaces | None
    estimators: Collection[str]
    sensors: Mapping[str, str]

    def follow(self, turn: Turn) -> None:
        """Tell it of a turn, and hear its answers; waits for them. Sets ``failure`` in place of raising anything."""
        ...

    def estimates(self, times: Sequence[float]) -> Mapping[str, Estimates]:
        """What its estimators, by name, said over the whole run, at ``times`` [s]."""
        ...

    def close(self) -> None:
        """Let go of the connection."""
        ...


def told_of(far_end: FarEnd) -> str:
    """What a record says of a far end: an object of JSON, with the names of `FarEnd`'s own fields."""
    one = far_end
    return json.dumps({"name": one.name, "flies": one.flies, "failure": one.failure, "sensors": dict(one.sensors)})


class Bridged:
    """A feed that a far end follows (`testbed.feeds.feed.Feed`); it ends when that no longer answers."""

    def __init__(self, feed: Feed, far_end: FarEnd) -> None:
        self.rate_hz, self.source = feed.rate_hz, feed.source
        self.faults, self.receptions = feed.faults, feed.receptions
        self._feed, self._far_end = feed, far_end
        self._last: Turn | None = None

    @property
    def origin(self) -> dict[str, str]:
        """That of the feed, and who follows it."""
        return self._feed.origin | {"far_end": told_of(self._far_end)}

    @property
    def motion_s(self) -> float:
        """Wall time that the motion took so far."""
        return self._feed.motion_s

    @property
    def failure(self) -> str:
        """Why the motion ended early, or the far end; empty when neither did."""
        return self._feed.failure or self._far_end.failure

    def advance(self, ticks: int, wanted: Sequence[int]) -> Turn:
        """The next rows, once the far end has followed them; none after it has failed."""
        if self._last is not None and self._far_end.failure:
            return Turn(self._last.reference.rows(0, 0), {}, {})
        self._last = turn = self._feed.advance(ticks, wanted)
        if len(turn.reference):
            self._far_end.follow(turn)
        return turn

    def activity(self) -> str:
        """What the motion is doing."""
        return self._feed.activity()

    def take_events(self, until: float = math.inf) -> list[tuple[float, str, str]]:
        """Those of the feed."""
        return self._feed.take_events(until)

    def remark(self) -> str:
        """That of the feed."""
        return self._feed.remark()

    def close(self) -> None:
        """Let go of what the feed holds; whoever made the far end closes it."""
        self._feed.close()
