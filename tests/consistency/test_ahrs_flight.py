"""Attitude without GNSS on the flown aircraft, over seeds."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

from testbed import Scenario, run

SEEDS = range(1, 7)
FLIGHTS = ("loiter_ahrs_denied", "loiter_ahrs_continuous")


def fly(flight: str, seed: int) -> dict[str, float]:
    return run(Scenario.load(flight, ["record.imu=false", "expect={}"]), seed=seed).metrics


@pytest.mark.slow
@pytest.mark.parametrize("flight", FLIGHTS)
def test_half_an_hour_without_gnss(flight: str) -> None:
    """The compensated AHRS holds with every seed what gyros alone lose with most: 5 deg."""
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        found = list(pool.map(fly, [flight] * len(SEEDS), SEEDS))
    largest, rms, gyros = (
        np.array([one[key] for one in found])
        for key in ("ahrs.roll_pitch_max_deg", "ahrs.roll_pitch_rms_deg", "gyros.roll_pitch_max_deg")
    )
    print(f"{flight}: largest {np.round(largest, 2)}, RMS {np.round(rms, 2)}, gyros alone {np.round(gyros, 1)} deg")
    assert largest.max() < 1.5
    assert rms.max() < 0.5
    assert np.median(gyros) > 5.0
