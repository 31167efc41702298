"""What is drawn anew for a verdict: seeds of noise and start errors, and where and how a paper's motion goes.

No paper says at which latitude, on which heading and over exactly which legs its claims hold; so they are drawn.
"""

from __future__ import annotations

from typing import NamedTuple

from testbed.errors import UserError
from testbed.many.draws import DRAW, require_draw
from testbed.noise import stream

RUNS, QUICK = 100, 10
LATITUDE_DEG = (10.0, 60.0)  # of either hemisphere
STRETCH = (0.8, 1.2)  # of a leg


class Draws(NamedTuple):
    """``runs`` seeds that no other ``number`` has."""

    number: int
    runs: int = RUNS

    @property
    def seeds(self) -> range:
        """One for each run."""
        first = 1 + self.number * DRAW
        return range(first, first + self.runs)


def draws(number: int, runs: int | None, quick: bool) -> Draws:
    """What the command is asked for. Raises UserError when there are no such draws."""
    if quick and runs is not None:
        raise UserError("--quick and --runs: give one of them")
    chosen = QUICK if quick else RUNS if runs is None else runs
    require_draw(number, chosen)
    return Draws(number, chosen)


class World(NamedTuple):
    """Where a motion begins and how long its legs are, the factor of each."""

    lat_deg: float
    heading_deg: float
    stretch: tuple[float, ...]

    @property
    def start(self) -> tuple[str, str]:
        """What it changes of a scenario's start."""
        return f"truth.start.lat_deg={self.lat_deg!r}", f"truth.start.heading_deg={self.heading_deg!r}"


def world(seed: int, legs: int = 0) -> World:
    """The start of the run with this seed, and the lengths of so many ``legs``: each uniform in its range."""
    random = stream(seed, "papers", "world")
    lat_deg = random.uniform(*LATITUDE_DEG) * random.choice((-1.0, 1.0))
    heading_deg = random.uniform(0.0, 360.0)
    return World(float(lat_deg), float(heading_deg), tuple(random.uniform(*STRETCH, legs).tolist()))
