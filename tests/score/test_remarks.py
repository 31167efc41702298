"""What a run says at its end of estimators that are not to be trusted."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2
from worlds import synthetic_run
from worlds.synthetic_run import Errors, circle, scenario

from nav.samples import Outcome, Status
from testbed import Scenario, run
from testbed.record.recorder import Recorder
from testbed.score import accuracy, metrics
from testbed.score.remarks import remarks
from testbed.sensors.faults import FaultTruth


def flown(honest: float = 1.0, window: tuple[float, float] = (100.0, 120.0), sensor: str = "gnss") -> Any:
    """A made-up run of 200 s with one fault and two estimators: one claims what is so, the other a part of it."""
    recorder = Recorder(None, scenario(200.0), 1)
    recorder.faults([FaultTruth("jump", sensor, "x", "step", *window, 3.0, "m")])
    estimators = {"ins": Errors(aligned_after=0.0), "other": Errors(aligned_after=0.0, truth_over_claim=honest)}
    synthetic_run.record(recorder, circle(200.0), estimators)
    recorder.close()
    return recorder.dataset()


def doubts(run: Any, found: dict[str, float]) -> list[str]:
    """All remarks but the first: that the text of a made-up run is no scenario."""
    first, *others = remarks(run, found)
    assert first.startswith("flight.* and visibility are left out")
    return others


@pytest.mark.ci
def test_an_honest_estimator_is_not_doubted() -> None:
    run = flown()
    found = metrics.compute(run)
    assert 0.3 < found["ins.position_horizontal_over_3sigma_max"] < 1.0
    assert doubts(run, found) == []


def test_who_is_led_astray_is_named() -> None:
    run = flown()
    own = run["estimators/other"]
    own["lat"].values[(own["time"].values >= 100.0) & (own["time"].values < 130.0)] += 40.0 / 6.37e6
    found = metrics.compute(run)
    e = accuracy.errors(run, "other")
    rows = (e.t >= 100.0) & (e.t < 130.0)
    expected = float(np.max(e.horizontal[rows] / (3.0 * np.hypot(*e.sigma_position[rows, :2].T))))
    assert found["other.error_over_3sigma.jump"] == pytest.approx(expected)
    assert expected > 2.0
    assert found["ins.error_over_3sigma.jump"] < 1.0
    worst = int(np.flatnonzero(rows)[np.argmax(e.over_3sigma[rows])])
    assert doubts(run, found) == [
        f"other was led astray and doesn't know it: with jump its position was {e.horizontal[worst]:.3g} m wrong at "
        f"{e.t[worst]:.0f} s, where it claims {3 * np.hypot(*e.sigma_position[worst, :2]):.3g} m (3 σ)"
    ]


@pytest.mark.ci
def test_what_was_as_bad_before_a_fault_is_not_its_doing() -> None:
    run = flown(6.0)
    found = metrics.compute(run)
    assert found["other.error_over_3sigma.jump"] > 1.0
    before = accuracy.errors(run, "other")
    assert (
        np.nanmax(before.over_3sigma[before.valid & (before.t < 100.0)]) > 0.6 * found["other.error_over_3sigma.jump"]
    )
    assert doubts(run, found) == []


@pytest.mark.ci
def test_metrics_of_another_settling_time_are_no_error() -> None:
    run = flown(window=(10.0, 20.0))
    own = run["estimators/other"]
    own["lat"].values[own["time"].values < 59.0] += 40.0 / 6.37e6
    found = metrics.compute(run, settling_s=5.0)
    assert found["other.error_over_3sigma.jump"] > 1.0
    assert all("astray" not in told for told in doubts(run, found))


@pytest.mark.ci
@pytest.mark.parametrize(
    ("sensor", "window", "how"),
    [
        ("gnss", (10.0, 20.0), "not counted"),
        ("gnss", (10.0, 50.0), "not counted"),
        ("gnss", (10.0, 60.0), "counted in part"),
        ("gnss", (60.0, 70.0), ""),
        ("imu", (0.0, 1.0), "not counted"),
        ("rangefinder", (0.0, 1.0), ""),  # which nobody has
    ],
)
def test_what_faults_did_before_errors_count_is_told(sensor: str, window: tuple[float, float], how: str) -> None:
    """Of a step of 20 m in the first 20 s nothing was said, and all figures of errors were perfect."""
    run = flown(window=window, sensor=sensor)
    found = metrics.compute(run)
    assert ("ins.error_over_3sigma.jump" in found) is (sensor == "gnss" and how != "not counted")
    when = f"from {window[0]:g} to {window[1]:g} s"
    told = f"its errors with jump, {when}, are {how}: errors count from 60.0 s, 60 s after its alignment"
    assert doubts(run, found) == ([f"{name}: {told}" for name in ("ins", "other")] if how else [])


@pytest.mark.ci
def test_innovations_far_too_large_are_told_but_not_those_of_a_fault() -> None:
    run = flown()
    nis = run["estimators/ins/innovations/barometer"]["nis"].values
    t = run["estimators/ins/innovations/barometer"]["sample_time"].values
    nis[(t >= 100.0) & (t < 130.0)] *= 100.0
    assert doubts(run, metrics.compute(run)) == []
    nis *= 3.0
    (told,) = doubts(run, metrics.compute(run))
    settled = nis[(t >= 60.0) & ~((t >= 100.0) & (t < 130.0))]
    bound, most = chi2.ppf(0.999, len(settled)) / len(settled), chi2.ppf(0.999, 1)
    assert told == (
        f"ins is too sure of barometer: the mean NIS is {np.minimum(settled, most).mean():.3g} per degree of freedom, "
        f"none counted for more than {most:.3g}, where up to {bound:.3g} would fit; its noise is larger, or the "
        f"model worse, than the filter is told"
    )


@pytest.mark.ci
@pytest.mark.parametrize(("variance", "doubted"), [(1.0, False), (100.0, True)])
def test_a_sample_that_is_wildly_wrong_tells_nothing_of_the_filter(variance: float, doubted: bool) -> None:
    """One that the gate had refused made the mean 50 000, and the filter too sure; who is, by 10 sigma, is told."""
    run = flown()
    own = run["estimators/ins/innovations/barometer"]
    own["nis"].values[:] = np.random.default_rng(1).chisquare(1, len(own["nis"])) * variance
    own["nis"].values[-20] = 1e8
    own["outcome"].values[own["nis"].values > chi2.ppf(0.9999, 1)] = Outcome.OUTSIDE_GATE
    own["weight"].values[own["outcome"].values == Outcome.OUTSIDE_GATE] = 0.0
    found = metrics.compute(run)
    assert found["ins.nis_mean.barometer"] > 1e3
    assert bool(doubts(run, found)) is doubted


@pytest.mark.ci
def test_a_few_large_innovations_tell_nothing() -> None:
    """The mean of 4 samples is above 1.5 once in 6 times."""
    run = flown()
    nis = run["estimators/ins/innovations/barometer"]["nis"].values
    nis[:-4] = np.nan
    nis[-4:] = 2.0
    assert doubts(run, metrics.compute(run)) == []


def test_covariances_that_give_no_nees_are_told() -> None:
    """An indefinite one gave none without a word, or a negative one; one that ended was not missed."""
    run = flown()
    covariance = accuracy.column(run, "estimators/other/covariance")
    covariance[-100:, 0, 1] = covariance[-100:, 1, 0] = 2.0 * covariance[-100:, 0, 0]
    text = f"other claims a covariance of position that is not positive definite in 100 of {len(covariance)} estimates"
    assert doubts(run, metrics.compute(run)) == [f"{text}: no NEES there"]
    covariance[-50:] = np.nan
    assert doubts(run, metrics.compute(run))[1:] == [
        f"other claims no covariance of {what} in 50 of {len(covariance)} estimates: no NEES and no 3 σ there"
        for what in ("position", "velocity", "attitude")
    ]


def test_a_number_that_is_none_in_a_covariance_is_told() -> None:
    """The NEES of what it is in ended without a word."""
    run = flown()
    covariance = accuracy.column(run, "estimators/other/covariance")
    covariance[-50:, 3, 4] = np.nan
    (said,) = doubts(run, metrics.compute(run))
    assert said.startswith(f"other claims no covariance of velocity in 50 of {len(covariance)} estimates")


@pytest.mark.ci
@pytest.mark.parametrize(("variance", "told"), [(1.0, False), (np.nan, False), (0.0, True), (-1.0, True)])
def test_variances_that_there_cant_be_are_told(variance: float, told: bool) -> None:
    """Of those there is no NEES, nor what is judged against three sigma. NaN claims none."""
    run = flown()
    covariance = accuracy.column(run, "estimators/other/covariance")
    covariance[-100:, 0, 0] = covariance[-100:, 8, 8] = variance
    text = (
        f"other claims a variance of 0 or below in 100 of {len(covariance)} estimates (north position, down attitude): "
        "no NEES and no 3 σ there"
    )
    silent = [
        f"other claims no covariance of {what} in 100 of {len(covariance)} estimates: no NEES and no 3 σ there"
        for what in ("position", "attitude")
    ]
    assert doubts(run, metrics.compute(run)) == (silent if np.isnan(variance) else [text] * told)


def test_an_estimator_of_attitude_alone_claims_no_position() -> None:
    run = flown()
    accuracy.column(run, "estimators/other/covariance")[:, 0, 0] = 0.0
    accuracy.column(run, "estimators/other/status")[:] |= Status.ATTITUDE_ONLY
    assert doubts(run, metrics.compute(run)) == []


def test_estimates_that_are_no_numbers_are_told() -> None:
    run = flown()
    told = remarks(run, {"ins.nonfinite_samples": 12.0, "ins.aligned_s": 2.0})
    assert "ins: 12 estimates since its alignment are not finite, and not scored" in told


def test_a_sensor_that_never_says_anything_is_told() -> None:
    sensors = {"sensors.rangefinder": {"min_range_m": 0.5, "max_range_m": 20.0}}
    result = run(Scenario.load("u_turn", {"duration_s": 5, "expect": {}, "estimator": []} | sensors))
    assert "rangefinder: gave no sample in the whole run" in result.remarks
    assert not [one for one in result.remarks if one.startswith(("imu", "gnss"))]


def test_a_unit_that_is_not_recorded_has_given_samples() -> None:
    found = run(Scenario.load("static_bench", {"duration_s": 1, "expect": {}, "record.imu": False}))
    assert not [one for one in found.remarks if "gave no sample" in one]


@pytest.mark.ci
def test_who_refuses_most_in_a_run_too_short_to_be_scored_is_told() -> None:
    """Nothing else said so."""
    jump = {"sensor": "gnss", "channel": "north", "kind": "step", "size": 500.0, "window": [4, 20]}
    aided = {"duration_s": 20, "expect": {}, "fault": [jump]}
    told = run(Scenario.load("u_turn", aided)).remarks
    assert [one for one in told if one.startswith("ins refused") and "of gnss_position since its alignment" in one]
    assert not [one for one in run(Scenario.load("u_turn", aided | {"fault": []})).remarks if " refused " in one]


def test_an_aid_of_which_nothing_can_be_used_is_told() -> None:
    """As of one in a wrong unit: all its samples are out of range, and no innovation is formed."""
    wrong = {"sensor": "barometer", "channel": "pressure", "kind": "step", "size": 9e6, "window": [0, 90]}
    told = run(Scenario.load("u_turn", {"duration_s": 90, "expect": {}, "fault": [wrong]})).remarks
    (said,) = [one for one in told if " could use none of " in one]
    assert said.startswith("ins could use none of ")
    assert "samples of barometer since its alignment, such as: pressure 9.0" in said
    assert said.endswith("e+06 is out of range")
