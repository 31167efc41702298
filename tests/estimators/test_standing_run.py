"""Without GNSS an INS that is told when it stands stays where it is, and flies as the others do."""

from __future__ import annotations

import numpy as np
import pytest

from testbed import RunResult, Scenario, run

HOBBY = 'sensors.imu={grade="mems-hobby", rate_hz=200}'
STANDING = "estimator.ins.zero_velocity_mps=0.05"


def flown(scenario: str, *overrides: str) -> RunResult:
    """A run of a scenario that ships."""
    return run(Scenario.load(f"scenarios/{scenario}.toml", ["expect={}", *overrides]))


@pytest.mark.ci
@pytest.mark.parametrize("imu", [(), (HOBBY,)], ids=["industrial", "hobby"])
def test_standing_without_gnss_it_stays_where_it_is(imu: tuple[str, ...]) -> None:
    denied = "duration_s=200", "sensors.gnss.denied=[[40, 200]]", *imu
    metrics = flown("static_bench", *denied, STANDING).metrics
    without = flown("static_bench", *denied).metrics["ins.outage_velocity_rms_mps"]
    assert metrics["ins.outage_velocity_rms_mps"] < min(0.05, without / 4)
    assert metrics["ins.outage_position_horizontal_max_m"] < 8  # what it was off by when GNSS went
    for what in ("position", "velocity", "attitude"):
        assert metrics[f"ins.outage_{what}_nees_mean"] < 3
    assert metrics["ins.rejected_fraction.zero_velocity"] == 0


def test_nothing_is_told_after_the_launch() -> None:
    """GNSS is gone ten seconds before it, and never says that it moves."""
    results = flown("take_off", "duration_s=60", "sensors.gnss.denied=[[20, 60]]", STANDING)
    told = results.dataset["estimators/ins/innovations/zero_velocity"]
    assert told.sample_time[-1] <= 30
    np.testing.assert_allclose(np.diff(told.sample_time), 1.0)
    assert np.all(told.weight == 1)
