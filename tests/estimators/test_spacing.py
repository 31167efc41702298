"""Samples whose errors are alike are handed over only so often."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from nav.samples import BarometerSample, ImuSamples, Sample
from testbed.estimators.lane import Commanded, Lane


class Listener:
    """In the place of the horizon: keeps what it is handed."""

    def __init__(self) -> None:
        self.heard: list[Sample] = []

    def track(self, imu: ImuSamples, samples: Sequence[Sample], times: Sequence[float]) -> tuple[list[Any], list[Any]]:
        self.heard += samples
        return [], []


def test_of_a_fast_sensor_no_more_is_handed_over_than_the_estimator_shall_take() -> None:
    """A jittered 50 Hz with 0.1 s between two that are taken is one in five, whatever the blocks; others are whole."""
    random = np.random.default_rng(1)
    t = np.arange(500) / 50 + 0.002 * random.uniform(-1, 1, 500)
    none = np.empty(0)
    silent = Commanded(none, none, none, none)
    increments = ImuSamples(none, none, np.empty((0, 3)), np.empty((0, 3)))
    listener = Listener()
    lane = Lane(listener, {"imu": np.eye(3)}, ("fast", "other"), spacing_s={"fast": 0.1})  # type: ignore[arg-type]
    for own in np.array_split(t, 37):
        samples = {name: [BarometerSample(one, one, 9e4, name) for one in own.tolist()] for name in ("fast", "other")}
        lane.track(silent, {"imu": increments}, samples, ())
    fast = np.diff([one.t for one in listener.heard if one.sensor == "fast"])
    assert fast.min() > 0.094
    assert fast.max() < 0.106
    assert sum(one.sensor == "other" for one in listener.heard) == 500
