"""What may be asked of a run while it goes on: plain data, so that it can be recorded and replayed.

Whoever watches a run (`testbed.loop.links.Publisher`) hands its requests over when the loop looks, at the start of a
turn. Those that change what is computed take effect at that tick and are recorded with it; replayed at the same
ticks they give the same bits. The others only say when the loop goes on.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias, get_args

if TYPE_CHECKING:
    pass


class Refused(Exception):
    """What was asked for can't be done; says why."""


@dataclass(frozen=True, slots=True)
class Inject:
    """Begin a fault now, until it is cleared: a ``[[fault]]`` table without its window."""

    fault: Mapping[str, object]


@dataclass(frozen=True, slots=True)
class Clear:
    """End now what was injected into a sensor, or only into its ``channel``; scheduled faults go on.

    The channel of a fault counts as another's if it is one of those that the other stands for, such as gyro_x of gyro.
    """

    sensor: str
    channel: str = ""


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
class Toggle:
    """`Resume` if the run is paused, else `Pause`."""


@dataclass(frozen=True, slots=True)
class Step:
    """Go on for ``seconds`` of simulated time, then hold again."""

    seconds: float


@dataclass(frozen=True, slots=True)
class Speed:
    """Run at ``factor`` times the wall clock."""

    factor: float


@dataclass(frozen=True, slots=True)
class Faster:
    """Run ``times`` as fast as now, within what a speed may be."""

    times: float


@dataclass(frozen=True, slots=True)
class Restart:
    """Begin the run anew, at its first tick."""


Request: TypeAlias = Inject | Clear | Change | End | Pause | Resume | Toggle | Step | Speed | Faster | Restart
Recorded: TypeAlias = Inject | Clear | Change | End  # those that change what is computed
RECORDED: Mapping[str, type[Recorded]] = {one.__name__.lower(): one for one in get_args(Recorded)}


def written(request: Recorded) -> tuple[str, str]:
    """Kind and content of a request as they are recorded."""
    return type(request).__name__.lower(), json.dumps(dataclasses.asdict(request))
