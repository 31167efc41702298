"""Which feed a scenario asks for."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

from testbed.errors import UserError
from testbed.estimators.lane import Lane
from testbed.feeds.autopilot import Autopilot, Steered
from testbed.feeds.closed import Closed
from testbed.feeds.feed import Feed
from testbed.feeds.recorded import Recorded, located
from testbed.feeds.simulated import Simulated, motion
from testbed.motion.ahead import Ahead
from testbed.motion.logged import LogTruth
from testbed.motion.sections import FlightTruth
from testbed.motion.table import MotionSource
from testbed.scenario import Scenario

__all__ = ["located", "open_feed"]


def open_feed(
    scenario: Scenario, seed: int, lanes: Mapping[str, Lane], source: MotionSource | None, ahead: tuple[int, int] | None
) -> Feed:
    """The feed of one run. ``source`` replaces the motion; ``lanes`` are the estimators, of which some may be flown on.

    ``ahead`` (ticks of a chunk, ticks of the run) lets a motion that follows nothing fly in a process of its own.
    Raises UserError when the motion can't be started, or can't follow an estimate.
    """
    if isinstance(scenario.truth, LogTruth):
        return Recorded(scenario, seed)
    closed = bool(scenario.autopilot.feedback.estimators)  # on something else than truth
    by_itself = isinstance(scenario.truth, FlightTruth) and not closed and ahead is not None
    if source is None and by_itself and ahead is not None and Ahead.possible():
        source = Ahead(partial(motion, scenario, seed), scenario.truth.rate_hz, *ahead)
    elif source is None:
        source = motion(scenario, seed)
    simulated = Simulated(scenario, seed, source)
    if not closed:
        return simulated
    if not isinstance(source, Steered):
        raise UserError("autopilot.feedback: a motion flown before can't follow an estimate")
    return Closed(simulated, Autopilot(source, scenario, lanes, simulated.sense))
