"""What may be asked of a run while it goes on: plain data, so that it can be recorded and replayed.

Whoever watches a run (`testbed.loop.Publisher`) hands its requests over when the loop looks, at the start of a turn.
Those that change what is computed take effect at that tick and are recorded with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias


@dataclass(frozen=True, slots=True)
class Inject:
    """Begin a fault now, until it is cleared: a ``[[fault]]`` table without its window."""

    fault: Mapping[str, object]


@dataclass(frozen=True, slots=True)
class Clear:
    """End now what was injected into a sensor; scheduled faults go on."""

    sensor: str


@dataclass(frozen=True, slots=True)
class Change:
    """Give a setting another value."""

    setting: str
    value: float


@dataclass(frozen=True, slots=True)
class End:
    """End the run here; what was recorded is concluded as usual."""


@dataclass(frozen=True, slots=True)
class Pause:
    """Hold simulated time until `Resume` or `Step`."""


@dataclass(frozen=True, slots=True)
class Resume:
    """Go on after `Pause`."""


@dataclass(frozen=True, slots=True)
class Step:
    """Go on for ``seconds`` of simulated time, then hold again."""

    seconds: float


@dataclass(frozen=True, slots=True)
class Speed:
    """Run at ``factor`` times the wall clock."""

    factor: float


@dataclass(frozen=True, slots=True)
class Restart:
    """Begin the run anew, at its first tick."""


Request: TypeAlias = Inject | Clear | Change | End | Pause | Resume | Step | Speed | Restart
