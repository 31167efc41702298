"""Which feed a scenario asks for."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

from testbed.errors import UserError
from testbed.estimators.lane import Lane
from testbed.feeds.autopilot import Autopilot, Steered
from testbed.feeds.bridged import Bridged, FarEnd
from testbed.feeds.closed import Closed
from testbed.feeds.feed import Feed
from testbed.feeds.piloted import Movable, Piloted
from testbed.feeds.recorded import Recorded, located
from testbed.feeds.simulated import Simulated, motion
from testbed.motion.ahead import Ahead
from testbed.motion.logged import LogTruth
from testbed.motion.sections import FlightTruth
from testbed.motion.table import MotionSource
from testbed.scenario import Scenario
from testbed.sensors.imu import ImuConfig

__all__ = ["located", "open_feed"]


def open_feed(
    scenario: Scenario,
    seed: int,
    lanes: Mapping[str, Lane],
    source: MotionSource | None,
    ahead: tuple[int, int] | None,
    far_end: FarEnd | None = None,
) -> Feed:
    """The feed of one run. ``source`` replaces the motion; ``lanes`` are the estimators, of which some may be flown on.

    ``ahead`` (ticks of a chunk, ticks of the run) lets a motion that follows nothing fly in a process of its own. A
    ``far_end`` follows the feed, or flies it. Raises UserError when the motion can't be started, can't follow an
    estimate, or can't be flown from outside.
    """
    if far_end is None:
        return _own(scenario, seed, lanes, source, ahead)
    if not far_end.flies:
        return Bridged(_own(scenario, seed, lanes, source, ahead), far_end)
    feed = _own(scenario, seed, lanes, source, None)
    if not isinstance(feed, Simulated) or not isinstance(feed.source, Movable):
        raise UserError(
            '--pilot: flies what JSBSim flies on a plan: truth.source must be "flight", without autopilot.feedback'
        )
    imu = next(section for section in scenario.sensors.values() if isinstance(section, ImuConfig))
    return Piloted(feed, feed.source, far_end, imu.rate_hz)


def _own(
    scenario: Scenario, seed: int, lanes: Mapping[str, Lane], source: MotionSource | None, ahead: tuple[int, int] | None
) -> Feed:
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
