"""An INS that looks back in a run: beside it in record and metrics, and no other number moves."""

from __future__ import annotations

import numpy as np
import pytest

from testbed import Scenario, run
from testbed.errors import UserError
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


def test_mistakes() -> None:
    aids = 'aids=["gnss"]'
    sigma_points = f'estimator=[{{ name="a", kind="ins", {aids}, smooth=true, engine="unscented" }}]'
    with pytest.raises(UserError, match=r"smooth: needs engine 'linear'"):
        Scenario.load("loiter_gnss_outage", [sigma_points, "expect={}"])
    taken = f'estimator=[{{ name="a_smoothed", {aids} }}, {{ name="a", {aids}, smooth=true }}]'
    with pytest.raises(UserError, match="'a_smoothed' is taken"):
        Scenario.load("loiter_gnss_outage", [taken, "expect={}"])
