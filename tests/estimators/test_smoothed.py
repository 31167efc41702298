"""An INS that looks back in a run: beside it in record and metrics, and no other number moves."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest

from nav.samples import Estimate
from testbed import Scenario, run
from testbed.errors import UserError
from testbed.estimators.lane import Lane
from testbed.record.reader import load
from testbed.results import RECORD
from testbed.score.accuracy import column

ONE = [
    "duration_s=150",
    "sensors.gnss.denied=[[80,130]]",
    'estimator=[{ name="ins", kind="ins", aids=["gnss","barometer","magnetometer","airspeed"], smooth=true }]',
    "expect={}",
]


@pytest.mark.ci
def test_it_is_recorded_and_scored_beside_the_filter() -> None:
    smoothed = run(Scenario.load("loiter_gnss_outage", ONE))
    own, back = (smoothed.metrics[f"{name}.outage_position_horizontal_rms_m"] for name in ("ins", "ins_smoothed"))
    assert back < own
    assert "ins_smoothed.outage_bound_at_60s_m" not in smoothed.metrics  # it knows the future
    t = column(smoothed.dataset, "estimators/ins_smoothed/time")
    np.testing.assert_allclose(np.diff(t), 0.1, atol=1e-6)
    assert t[-1] == column(smoothed.dataset, "truth/time")[-1]
    assert smoothed.dataset["estimators/ins_smoothed/magnetometer_soft_iron"].shape == (len(t), 9)


def test_a_run_that_is_killed_while_it_looks_back_has_a_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    smoothed, kept = Lane.smoothed, []

    def look_back(lane: Lane, times: Iterable[float]) -> Iterator[Estimate]:
        kept.append(load(tmp_path / RECORD)["truth/time"].values[-1])
        return smoothed(lane, times)

    monkeypatch.setattr(Lane, "smoothed", look_back)
    run(Scenario.parse(TURN), out=tmp_path)
    assert kept == [30.0]


TURN = """
title = "What a later turn tells of the heading at the beginning"
seed = 1
duration_s = 30
[truth]
source = "kinematic"
motion = "segments"
start = { lat_deg = 47.0, lon_deg = 8.0, alt_m = 800, speed_mps = 25 }
segments = [{ leg = "turn", by_deg = 180, rate_degps = 5 }]
body = { turns = "banked" }
[sensors.imu]
rate_hz = 50
jitter_s = 0.002
[sensors.gnss]
grade = "rtk"
rate_hz = 2
[[estimator]]
name = "ins"
aids = ["gnss"]
smooth = true
"""


def test_what_it_claims_is_possible_where_next_to_nothing_was_known() -> None:
    """Heading by 18 deg before, and centimetres after: variances were below zero, which the record has as sure."""
    back = run(Scenario.parse(TURN)).dataset["estimators/ins_smoothed"]
    covariance = back["covariance"].values
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    assert variances.min() > 0
    sigma = np.sqrt(variances)
    correlations = covariance / (sigma[:, :, None] * sigma[:, None, :])
    assert np.linalg.eigvalsh(correlations).min() > -1e-6  # it is recorded in single precision
    assert np.deg2rad(0.1) < back["sigma_attitude_n"].values[0, 2] < np.deg2rad(5)


def test_it_makes_no_difference_how_often_it_is_recorded() -> None:
    """With times of increments that lie between the rows."""
    often, seldom = (
        run(Scenario.parse(TURN, [f"record.rate_hz={rate_hz}"])).dataset["estimators/ins_smoothed"]
        for rate_hz in (10, 2)
    )
    rows = np.searchsorted(often["time"].values, seldom["time"].values - 1e-6)
    for name in ("lat", "h", "v_n", "q_nb", "covariance"):
        np.testing.assert_array_equal(often[name].values[rows], seldom[name].values)


def test_mistakes() -> None:
    aids = 'aids=["gnss"]'
    sigma_points = f'estimator=[{{ name="a", kind="ins", {aids}, smooth=true, engine="unscented" }}]'
    with pytest.raises(UserError, match=r"smooth: needs engine 'linear'"):
        Scenario.load("loiter_gnss_outage", [sigma_points, "expect={}"])
    taken = f'estimator=[{{ name="a_smoothed", {aids} }}, {{ name="a", {aids}, smooth=true }}]'
    with pytest.raises(UserError, match="'a_smoothed' is taken"):
        Scenario.load("loiter_gnss_outage", [taken, "expect={}"])


def test_up_to_the_end_it_is_no_worse_than_the_filter() -> None:
    """From the last fix that was used on, half a second before the end, it stood still: 30 m at 60 m/s."""
    scenario = Scenario.parse(
        """
title = "Straight on, by fixes that are late"
seed = 1
duration_s = 80
[truth]
source = "kinematic"
motion = "segments"
start = { lat_deg = 47.0, lon_deg = 8.0, alt_m = 800, speed_mps = 60 }
segments = [{ leg = "straight", duration_s = 80 }]
[sensors.imu]
[sensors.gnss]
grade = "rtk"
latency_s = 0.5
[sensors.magnetometer]
[[estimator]]
name = "ins"
kind = "ins"
aids = ["gnss", "magnetometer"]
smooth = true
"""
    )
    data, off = run(scenario).dataset, {}
    for name in ("ins", "ins_smoothed"):
        t, lat, lon = (column(data, f"estimators/{name}/{key}")[-10:] for key in ("time", "lat", "lon"))
        true = {key: np.interp(t, data["truth/time"], data[f"truth/{key}"]) for key in ("lat", "lon")}
        off[name] = 6.4e6 * np.hypot(lat - true["lat"], np.cos(lat) * (lon - true["lon"]))
    assert t[-1] == data["truth/time"][-1]
    assert off["ins_smoothed"].max() < 0.3
    assert off["ins_smoothed"][-1] == off["ins"][-1]  # when it has heard no more


def test_a_run_that_ends_as_it_aligns_has_nothing_to_look_back_on() -> None:
    """It ended in a traceback: no increment had been used yet."""
    overrides = [*ONE, "sensors.gnss.latency_s=0.3", "duration_s=2.3", "sensors.gnss.denied=[]"]
    assert run(Scenario.load("loiter_gnss_outage", overrides)).dataset is not None
