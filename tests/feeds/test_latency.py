"""How late a receiver's velocities are by the inertial unit, of a flight that is known by formula."""

from __future__ import annotations

import numpy as np
import pytest

from nav.samples import GnssSample, ImuSamples
from testbed.feeds.lateness import latency
from testbed.feeds.samples import Fixes

RATE_HZ, LASTS = 100.0, 240.0


def swinging(late: float, noise: float = 0.05) -> tuple[ImuSamples, list[GnssSample]]:
    """A level vehicle that is pushed to and fro, by two swings, and a receiver of 5 Hz that is so late [s]."""
    turns, pushes = 2 * np.pi / np.array([2.9, 7.3]), np.array([3.0, 5.0])

    def velocity(t: np.ndarray) -> np.ndarray:
        return np.column_stack([np.cos(t[:, None] * turns) @ (-pushes / turns), 0 * t, 0 * t])

    edges = np.arange(round(LASTS * RATE_HZ) + 1) / RATE_HZ
    dv = np.diff(velocity(edges), axis=0) - [0.0, 0.0, 9.8 / RATE_HZ]
    imu = ImuSamples(edges[1:], np.diff(edges), np.zeros_like(dv), dv)
    at = np.arange(0.0, LASTS, 0.2)
    told = Fixes(at, np.full(len(at), 0.8), np.full(len(at), 0.1), np.full(len(at), 500.0))
    told.v_n = velocity(at - late) + noise * np.random.default_rng(1).standard_normal((len(at), 3))
    return imu, told.samples("gnss")  # type: ignore[return-value]


def test_velocities_that_are_unknown_hide_no_latency() -> None:
    """One of a thousand did, and the whole log was taken for a receiver without velocities."""
    imu, own = swinging(0.36)
    for k in (3, *range(200, 230), 700):
        own[k].v_n[:] = np.nan
    assert latency(imu, own) == pytest.approx(0.36, abs=0.011)
