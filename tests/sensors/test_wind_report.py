"""Wind by radio: what is averaged, how old it is, how wrong, and what filters make of it."""

from __future__ import annotations

import numpy as np
import pytest

from nav import aids
from nav.aids import WindReportAid
from nav.aids.wind_report import wind_report
from nav.samples import Outcome, WindSample
from testbed import Scenario, run
from testbed.errors import UserError
from testbed.motion.table import TruthBlock
from testbed.record.columns import EXTRA
from testbed.score.accuracy import column
from testbed.sensors.wind_report import WindReport, WindReportConfig

RATE_HZ = 10.0
SCENARIO = """
title = "Wind by radio"
seed = 5
duration_s = 60
[truth]
source = "flight"
start = { lat_deg = 34.0, lon_deg = 108.0, alt_m = 500, heading_deg = 30, airspeed_mps = 25 }
wind = { from_deg = 250, speed_mps = 8 }
[[plan]]
leg = "straight"
length_m = 9000
[sensors.imu]
[sensors.gnss]
[sensors.barometer]
[sensors.magnetometer]
[sensors.airspeed]
[sensors.radio]
kind = "wind_report"
noise_mps = 0.1
local_mps = 0.1
rate_hz = 0.1
delay_s = 5
[[estimator]]
name = "ins"
aids = ["gnss", "barometer", "magnetometer", "airspeed", "radio"]
[[estimator]]
name = "fed"
kind = "federated"
[[estimator.locals]]
name = "gnss"
aids = ["gnss"]
[[estimator.locals]]
name = "air"
aids = ["barometer", "magnetometer", "airspeed", "radio"]
"""


def walking(seconds: float, walk: float = 0.0, seed: int = 0) -> TruthBlock:
    """Truth whose wind walks about (6, -2) m/s."""
    block = TruthBlock.empty(0, round(seconds * RATE_HZ))
    block.t[:] = np.arange(len(block)) / RATE_HZ
    steps = np.random.default_rng(seed).standard_normal((len(block), 2)) * walk / np.sqrt(RATE_HZ)
    block.wind_n[:, :2] = np.array([6.0, -2.0]) + np.cumsum(steps, axis=0)
    return block


def reports(truth: TruthBlock, seed: int = 1, **keys: float) -> list[WindSample]:
    return WindReport("r", WindReportConfig(grade="perfect", **keys), RATE_HZ, seed).sense(truth)


def test_a_report_is_the_mean_of_the_wind_as_long_ago_as_it_says() -> None:
    truth = walking(1000, 0.1)
    found = reports(truth, rate_hz=0.01, mean_s=100.0, delay_s=200.0, latency_s=0.5)
    assert [one.t for one in found] == pytest.approx(np.arange(0.0, 1000.0, 100.0))
    assert found[5].t_arrival == pytest.approx(500.5)
    assert found[5].age == pytest.approx(250.0)
    seconds = truth.wind_n[:: round(RATE_HZ), :2]
    np.testing.assert_allclose(found[5].wind_n, seconds[200:301].mean(axis=0), rtol=1e-12)
    assert found[0].age == 0.0  # nothing is older than the run
    np.testing.assert_allclose(found[0].wind_n, seconds[0])


@pytest.mark.ci
def test_errors_are_as_large_and_as_slow_as_is_told() -> None:
    truth = walking(400_000 / RATE_HZ)
    white = np.array([one.wind_n for one in reports(truth, rate_hz=1.0, noise_mps=0.7)]) - [6.0, -2.0]
    assert white.std(axis=0) == pytest.approx([0.7, 0.7], rel=0.03)
    slow = np.array([one.wind_n for one in reports(truth, rate_hz=1.0, local_mps=1.5, local_time_s=50.0)])
    assert slow.std(axis=0) == pytest.approx([1.5, 1.5], rel=0.15)
    assert np.corrcoef(slow[50:, 0], slow[:-50, 0])[0, 1] == pytest.approx(np.exp(-1), abs=0.1)
    assert reports(walking(1), noise_mps=0.7)[0].sigma == 0.7


def test_what_the_filter_is_told_is_how_far_the_wind_has_walked_since() -> None:
    """Over many winds, the report less the wind of its time has the variance R of the aid."""
    off, R = [], None
    for k in range(400):
        truth = walking(300, 0.05, k)
        last = reports(truth, k, rate_hz=0.01, delay_s=200.0, noise_mps=0.3)[2]
        off.append(last.wind_n - truth.wind_n[2000, :2])
        R = last.sigma**2 + 0.05**2 * last.age
    assert np.var(off) == pytest.approx(R, rel=0.12)
    assert pytest.approx(0.59) == R


def test_innovation_and_jacobian() -> None:
    x = np.array([0.0, 5.0, -1.0, 0.2, 0.1])
    nu, H = wind_report(x, 1, 3, np.array([6.0, -2.0]))
    np.testing.assert_allclose(nu, [0.8, -1.1])
    for k, step in enumerate(np.eye(5)):
        np.testing.assert_allclose(nu - wind_report(x + step, 1, 3, np.array([6.0, -2.0]))[0], H[:, k])


@pytest.mark.parametrize(
    ("wind", "age", "sigma"), [(np.nan, 1.0, 1.0), (400.0, 1.0, 1.0), (1.0, -1.0, 1.0), (1, 1, -1)]
)
def test_unsound_reports_are_refused(wind: float, age: float, sigma: float) -> None:
    assert aids.problem(WindSample(0.0, 0.0, np.array([wind, 0.0]), age, sigma))
    assert not aids.problem(WindSample(0.0, 0.0, np.array([1.0, 0.0]), 1.0, 1.0))


def test_it_needs_a_wind_to_tell_of() -> None:
    with pytest.raises(UserError, match=r"'radio' tells of a wind that nothing here meets"):
        Scenario.parse(SCENARIO.replace('"airspeed", "radio"', '"radio"'))
    assert WindReportAid("r").blocks()[0].name == "r_error"


@pytest.mark.ci
def test_ins_and_a_local_filter_learn_the_wind_from_it() -> None:
    """Flying straight, airspeed tells one component; the error of the other falls to that of the report."""
    tree = run(Scenario.parse(SCENARIO)).dataset
    for name, state in (("ins", "wind"), ("fed", "wind")):
        told = column(tree, f"estimators/{name}/innovations/wind_report/outcome")
        assert (told == Outcome.FUSED).sum() == 5  # all but the one during alignment
        error = column(tree, f"estimators/{name}/{state}")[-1] - column(tree, "truth/wind_n")[-1][:2]
        assert np.hypot(*error) < 0.5
    assert "wind_report_error" in EXTRA
    assert "radio_error" in tree["estimators/ins"]
