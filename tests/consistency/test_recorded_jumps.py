"""Recorded flights whose only receiver jumps and stays: how far filters go astray, and whether they know it.

``TESTBED_RECORDINGS=DIR pytest -m slow -s tests/consistency/test_recorded_jumps.py`` prints the table.
"""

from __future__ import annotations

import numpy as np
import pytest
from worlds import real_flights

from testbed import Scenario, error_series, run

ALOFT = {"thor": (170.0, 420.0), "swiss": (30.0, 60.0), "quad": (70.0, 560.0)}  # when a jump may begin [s of the run]
SIZES_M, LASTS_S = (30.0, 300.0), (20.0, 60.0)
FIRST_S, AFTER_S = 8.0, 28.0  # of a jump, when nobody believes it yet; and after its end


def scenario(name: str, start: float, size: float, lasts: float) -> Scenario:
    """A flight with an INS and a federation of three filters."""
    text = real_flights.FLIGHTS[name].partition('[[estimator]]\nname = "ahrs"')[0]
    air = ["barometer"] if name == "quad" else ["barometer", "airspeed"]
    text += '[[estimator]]\nname = "federated"\nkind = "federated"\n'
    for local, aids in (("gnss", ["gnss"]), ("air", air), ("magnetometer", ["magnetometer"])):
        text += f'[[estimator.locals]]\nname = "{local}"\naids = {aids}\n'
    text += '[[fault]]\nname = "jump"\nsensor = "gnss"\nchannel = "north"\nkind = "step"\n'
    text += f"window = [{start}, {start + lasts}]\nsize = {size}\n"
    return Scenario.parse(text, {"truth.reference": "gnss", "duration_s": min(start + lasts + AFTER_S, 690.0)})


@pytest.mark.slow
@pytest.mark.skipif(not real_flights.available(), reason="TESTBED_RECORDINGS names no folder of recordings")
@pytest.mark.parametrize("name", ALOFT)
def test_filters_that_give_in_to_a_jump_know_what_it_may_cost(name: str) -> None:
    rng = np.random.default_rng(56301)
    first: dict[str, list[float]] = {"ins": [], "federated": []}
    beyond: dict[str, list[float]] = {"ins": [], "federated": []}
    for start in rng.uniform(*ALOFT[name], 4).round(1):
        for size in SIZES_M:
            for lasts in LASTS_S:
                result = run(scenario(name, start, size, lasts))
                for estimator in first:
                    errors = error_series(result, estimator).loc[start + 1.0 :]
                    off = np.hypot(errors["north_m"], errors["east_m"])
                    claim = np.hypot(errors["sigma_north_m"], errors["sigma_east_m"])
                    first[estimator].append(float(off.loc[: start + FIRST_S].max()))
                    beyond[estimator].append(float((off > 3.0 * claim)[off.notna()].mean()))
    for estimator in first:
        print(f"{name}, {estimator}: in the first {FIRST_S:g} s {np.median(first[estimator]):.1f} m off (median), "
              f"{max(first[estimator]):.0f} m at most; beyond 3 claims {100 * np.mean(beyond[estimator]):.1f} % of the "
              f"time, {100 * max(beyond[estimator]):.0f} % at most")  # fmt: skip
        assert np.median(first[estimator]) < 20.0
        assert np.mean(beyond[estimator]) < 0.1
