"""A whole hour of one INS alone: what a replay costs when nobody flies, records or looks at it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from statistics import median

from bench.measure import MAIN, Effort, Row, cpu_seconds

from nav.ins import Ins
from testbed.estimators import registry
from testbed.estimators.lane import Lane
from testbed.feeds.build import open_feed
from testbed.feeds.known import commanded
from testbed.scenario import Scenario

HOUR_S, TURN_S, COVARIANCE_HZ = 3600, 5, 100
INS = 'estimator=[{name="ins", gust_mps=1.0, aids=["gnss", "barometer", "magnetometer", "airspeed"]}]'
OVERRIDES = [INS, "expect={}", "sensors.gnss.denied=[]", "plan[4].duration_s=4000"]


def ins_hour(effort: Effort) -> Iterator[Row]:
    """The main scenario's INS through an hour of samples, IMU at 200 Hz and covariance at 100 Hz."""
    scenario = Scenario.load(MAIN, OVERRIDES)
    duration, ticks = effort.count(HOUR_S), round(TURN_S * scenario.truth.rate_hz)
    feed = open_feed(scenario, scenario.seed, {}, None, None)
    turns = [feed.advance(ticks, ()) for _ in range(duration // TURN_S)]
    feed.close()
    samples = sum(len(own) for turn in turns for own in turn.samples.values())

    def replay() -> None:
        lane = _lane(scenario)
        for turn in turns:
            lane.track(commanded(turn.reference), turn.imu, turn.samples, ())

    replay()
    seconds = tuple(cpu_seconds(replay) * HOUR_S / duration for _ in range(effort.rounds))
    detail = f"{samples} samples, {median(seconds) * duration / HOUR_S / samples * 1e6:.0f} us each with its increments"
    yield Row("INS through an hour at 200 Hz, CPU", seconds, "s", at_most=1.2, detail=detail)


def _lane(scenario: Scenario) -> Lane:
    """The scenario's INS, its covariance at `COVARIANCE_HZ`."""
    (lane,) = registry.build(scenario.estimator, scenario.rig(scenario.seed)).values()
    ins = lane.horizon.estimator
    assert isinstance(ins, Ins)
    period = round(scenario.truth.rate_hz / COVARIANCE_HZ)
    lane.horizon.estimator = Ins(replace(ins.config, covariance_period=period), ins.field_n)
    return lane
