"""Metrics against formulas and libraries that share nothing with them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pymap3d
import pytest
import xarray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from worlds import synthetic_run
from worlds.synthetic_run import Errors, circle, scenario

from nav.columns import Estimates
from nav.samples import NO_SENSOR, FixType, GnssSample, Outcome, Status
from testbed import Scenario
from testbed import run as fly
from testbed.errors import UserError
from testbed.record.recorder import Recorder
from testbed.score import accuracy, detection, metrics, observability
from testbed.score.series import error_series
from testbed.sensors.faults import FaultTruth

DENIED = ((150.0, 290.0),)


@pytest.fixture(scope="module")
def run() -> Any:
    return synthetic_run.dataset(400.0, {"ins": Errors(drift_mps=0.5), "late": Errors(aligned_after=100.0)}, DENIED)


@pytest.fixture(scope="module")
def computed(run: Any) -> dict[str, float]:
    return metrics.compute(run)


def independent(run: Any, name: str) -> dict[str, np.ndarray]:
    """Errors by pymap3d and scipy, row by row of the record."""
    truth, own = run["truth"], run[f"estimators/{name}"]
    e, n, u = pymap3d.geodetic2enu(
        own["lat"].values, own["lon"].values, own["h"].values, truth["lat"].values, truth["lon"].values,
        truth["h"].values, deg=False,
    )  # fmt: skip
    good = np.isfinite(own["lat"].values)
    turn = np.full((len(good), 3), np.nan)
    estimated = Rotation.from_quat(own["q_nb"].values[good], scalar_first=True)
    true = Rotation.from_quat(truth["q_nb"].values[good], scalar_first=True)
    turn[good] = (estimated * true.inv()).as_rotvec(degrees=True)
    return {
        "t": own["time"].values,
        "horizontal": np.hypot(e, n),
        "position": np.column_stack([n, e, -u]),
        "velocity": own["v_n"].values - truth["v_n"].values,
        "turn_deg": turn,
    }


def test_errors_agree_with_independent_libraries(run: Any, computed: dict[str, float]) -> None:
    x = independent(run, "ins")
    t = x["t"]
    # Aligned at 5 s and 60 s to settle; the first fix after the outage arrives at 290.1 s, recovery takes 10 s more.
    for prefix, rows in (("", (t >= 65) & (t < 150) | (t >= 300.1)), ("outage_", (t >= 150) & (t < 290.1))):
        expected = {
            "position_horizontal_rms_m": np.sqrt(np.mean(x["horizontal"][rows] ** 2)),
            "position_horizontal_max_m": x["horizontal"][rows].max(),
            "position_vertical_rms_m": np.sqrt(np.mean(x["position"][rows, 2] ** 2)),
            "velocity_rms_mps": np.sqrt(np.mean(np.sum(x["velocity"][rows] ** 2, axis=1))),
            "roll_pitch_rms_deg": np.sqrt(np.mean(np.sum(x["turn_deg"][rows, :2] ** 2, axis=1))),
            "roll_pitch_max_deg": np.sqrt(np.sum(x["turn_deg"][rows, :2] ** 2, axis=1)).max(),
            "heading_rms_deg": np.sqrt(np.mean(x["turn_deg"][rows, 2] ** 2)),
            "heading_max_deg": np.abs(x["turn_deg"][rows, 2]).max(),
        }
        for key, value in expected.items():
            assert computed[f"ins.{prefix}{key}"] == pytest.approx(value, rel=2e-5), key


def test_error_series_agree_with_independent_libraries(run: Any) -> None:
    x, table = independent(run, "late"), error_series(SimpleNamespace(dataset=run), "late")
    assert table.index.name == "t_s"
    assert np.array_equal(table.index, x["t"])
    before, after = table.loc[:99], table.loc[101:]
    assert before.isna().all(axis=None)
    assert after.notna().all(axis=None)
    rows = x["t"] >= 101
    own = run["estimators/late"]
    for columns, expected, atol in (
        (["north_m", "east_m", "down_m"], x["position"], 1e-3),
        (["v_north_mps", "v_east_mps", "v_down_mps"], x["velocity"], 1e-6),
        (["phi_north_deg", "phi_east_deg", "phi_down_deg"], -x["turn_deg"], 1e-5),
        (["sigma_north_m", "sigma_east_m", "sigma_down_m"], own["sigma_position_n"].values, 0),
        (["sigma_v_north_mps", "sigma_v_east_mps", "sigma_v_down_mps"], own["sigma_velocity_n"].values, 0),
        ([f"sigma_phi_{axis}_deg" for axis in accuracy.AXES], np.rad2deg(own["sigma_attitude_n"].values), 1e-6),
        (["roll_deg", "pitch_deg", "heading_deg"], euler_difference_deg(run, "late"), 1e-6),
    ):
        np.testing.assert_allclose(after[columns], expected[rows], rtol=1e-6, atol=atol)


def euler_difference_deg(run: Any, name: str) -> np.ndarray:
    """Roll, pitch, heading of the estimate less those of truth, by scipy; NaN before there is an estimate."""
    q, q_true = run[f"estimators/{name}/q_nb"].values, run["truth/q_nb"].values
    good = np.isfinite(q[:, 0])
    angles, true = (Rotation.from_quat(x[good], scalar_first=True).as_euler("ZYX", degrees=True) for x in (q, q_true))
    found = np.full((len(q), 3), np.nan)
    found[good] = ((angles - true + 180) % 360 - 180)[:, ::-1]
    return found


def test_error_series_of_an_estimator_that_is_not_there(run: Any) -> None:
    with pytest.raises(UserError, match=r"no estimator mine: choose from ins, late"):
        error_series(run, "mine")


@pytest.mark.parametrize("given", ["run.nc", None])
def test_error_series_of_no_run(given: Any) -> None:
    with pytest.raises(UserError, match=r"is no run: give what `testbed\.run` gave back"):
        error_series(given, "ins")


def test_estimators_that_are_not_scored_are_told_and_why() -> None:
    run = synthetic_run.dataset(
        100.0, {"ins": Errors(), "late": Errors(aligned_after=70.0), "other": Errors(aligned_after=np.inf)}
    )
    _, late, other = metrics.unscored(run)  # the first: that the text of a made-up run is no scenario
    assert late.startswith("late: its errors are not scored: they count from 60 s after its alignment, 130.")
    assert late.endswith("and the run ends at 100.0 s")
    assert other == "other: its errors are not scored: it was never aligned (its status never said ALIGNED)"


def test_heading_error_is_the_difference_of_headings_in_level_flight() -> None:
    heading = np.deg2rad(np.array([10.0, 179.0, -179.0, 90.0]))
    error = np.deg2rad(np.array([2.0, 3.0, -3.0, 0.0]))
    q, q_true = (Rotation.from_euler("z", h[:, None]).as_quat(scalar_first=True) for h in (heading + error, heading))
    np.testing.assert_allclose(accuracy.attitude_error(q, -q_true)[:, 2], -error, atol=1e-12)


def test_attitude_error_has_the_sign_of_the_conventions() -> None:
    rng = np.random.default_rng(3)
    true = Rotation.random(50, rng=rng)
    phi = rng.normal(size=(50, 3)) * 1e-4
    C_hat = np.array([(np.eye(3) - np.cross(np.eye(3), p)) @ C for p, C in zip(phi, true.as_matrix(), strict=True)])
    estimated = Rotation.from_matrix(C_hat).as_quat(scalar_first=True)
    # the rows of np.cross(I, p) are e_i x p, so it is the matrix [p x]
    np.testing.assert_allclose(accuracy.attitude_error(estimated, true.as_quat(scalar_first=True)), phi, atol=1e-7)


def test_nees_is_the_quadratic_form_and_nan_where_singular() -> None:
    rng = np.random.default_rng(4)
    A = rng.normal(size=(20, 3, 3))
    P = A @ A.transpose(0, 2, 1) * np.array([1e-8, 1.0, 1e8])[rng.integers(0, 3, 20), None, None]
    e = rng.normal(size=(20, 3))
    expected = [x @ np.linalg.inv(p) @ x / 3 for x, p in zip(e, P, strict=True)]
    np.testing.assert_allclose(accuracy.nees(e, P), expected, rtol=1e-6)
    assert np.isnan(accuracy.nees(e[:1], np.zeros((1, 3, 3)))).all()
    assert np.isnan(accuracy.nees(e[:1], np.ones((1, 3, 3)))).all()
    assert np.isnan(accuracy.nees(e[:1], np.full((1, 3, 3), np.nan))).all()
    indefinite = np.array([[1.0, 2.0, 2.0], [2.0, 1.0, 4.5], [2.0, 4.5, 1.0]])  # of two negative pivots
    assert np.linalg.det(indefinite) > 0
    assert np.isnan(accuracy.nees(e[:1], indefinite[None])).all()


@pytest.mark.ci
def test_consistent_errors_give_one_and_overconfident_ones_their_square() -> None:
    for factor in (1.0, 2.0):
        found = metrics.compute(synthetic_run.dataset(400.0, {"ins": Errors(truth_over_claim=factor)}, DENIED))
        for prefix, rows in (("", 1850), ("outage_", 1401)):  # each with errors of its own
            low, high = factor**2 * chi2.ppf([0.0005, 0.9995], 3 * rows) / (3 * rows)
            for key in ("position", "velocity", "attitude"):
                assert low < found[f"ins.{prefix}{key}_nees_mean"] < high


def test_error_at_marks_of_the_outage(run: Any, computed: dict[str, float]) -> None:
    x = independent(run, "ins")
    for mark in (60, 120):
        row = np.flatnonzero(np.isclose(x["t"], 150 + mark))[0]
        assert computed[f"ins.outage_position_horizontal_at_{mark}s_m"] == pytest.approx(x["horizontal"][row], rel=2e-5)
    assert "ins.outage_position_horizontal_at_300s_m" not in computed


def relabel(run: Any, aid: str, t: float, weight: float, outcome: Outcome, nis: float | None = None) -> None:
    """Make one report of a made-up run say something else."""
    reports = run[f"estimators/ins/innovations/{aid}"]
    k = int(np.flatnonzero(np.isclose(reports["sample_time"].values, t))[0])
    reports["weight"].values[k] = weight
    reports["outcome"].values[k] = outcome
    if nis is not None:
        reports["nis"].values[k] = nis


def take_all(run: Any, *aids: str) -> None:
    """No refusals but those that a test makes."""
    for aid in aids:
        reports = run[f"estimators/ins/innovations/{aid}"]
        reports["weight"].values[:] = 1.0
        reports["outcome"].values[:] = Outcome.FUSED


def test_nis_is_of_all_that_the_gate_judged(run: Any, computed: dict[str, float]) -> None:
    reports = run["estimators/ins/innovations/gnss_position"]
    after = reports["sample_time"].values >= 65
    assert computed["ins.nis_mean.gnss_position"] == pytest.approx(reports["nis"].values[after].mean() / 3)
    assert computed["ins.nis_mean.barometer"] == pytest.approx(1.0, abs=0.15)
    refused = np.mean(reports["weight"].values[after] == 0)
    assert computed["ins.rejected_fraction.gnss_position"] == pytest.approx(refused)


def test_what_was_withheld_is_not_the_gate_s() -> None:
    run = synthetic_run.dataset(100.0, estimators={"ins": Errors(aligned_after=0.0)})
    for aid in ("gnss_position", "gnss_velocity"):
        run[f"estimators/ins/innovations/{aid}"]["nis"].values[:] = 2.0
        take_all(run, aid)
    relabel(run, "gnss_position", 70.0, 0.0, Outcome.OUTSIDE_GATE, 50.0)
    relabel(run, "gnss_velocity", 70.0, 0.0, Outcome.WITHHELD, 700.0)
    for t in (72.0, 72.2, 72.4):
        relabel(run, "gnss_position", t, 0.0, Outcome.WITHHELD, 700.0)
        relabel(run, "gnss_velocity", t, 0.0, Outcome.WITHHELD, 700.0)
    relabel(run, "gnss_position", 80.0, 0.0, Outcome.UNSOUND, float("nan"))
    looks = 201 - 3 - 1  # from 60 s to 100 s at 5 Hz, less probation and the unsound one
    found = metrics.compute(run)
    assert found["ins.rejected_fraction.gnss_position"] == pytest.approx(1 / looks)
    assert found["ins.nis_mean.gnss_position"] == pytest.approx((2 * (looks - 1) + 50) / looks / 3)
    assert found["ins.rejected_fraction.gnss_velocity"] == 0.0
    assert found["ins.nis_mean.gnss_velocity"] == pytest.approx(2 / 3)
    barometer = run["estimators/ins/innovations/barometer"]
    by_chance = int(np.sum((barometer["weight"].values <= 0) & (barometer["sample_time"].values >= 60)))
    assert found["ins.false_alarms_per_h"] == pytest.approx((1 + by_chance) / (401 / 36000))
    assert found["ins.false_alarms_per_look"] == pytest.approx((1 + by_chance) / (looks + 201 - 4 + 201))


def test_axes_agree_with_independent_libraries(run: Any, computed: dict[str, float]) -> None:
    x = independent(run, "ins")
    t = x["t"]
    rows = (t >= 65) & (t < 150) | (t >= 300.1)
    own, truth = run["estimators/ins"]["q_nb"].values[rows], run["truth"]["q_nb"].values[rows]
    angles = [Rotation.from_quat(q, scalar_first=True).as_euler("ZYX", degrees=True) for q in (own, truth)]
    tilt = (angles[0] - angles[1])[:, 1:]
    axes = {f"position_{a}": (x["position"][rows, k], "m") for k, a in enumerate(("north", "east", "down"))}
    axes |= {f"velocity_{a}": (x["velocity"][rows, k], "mps") for k, a in enumerate(("north", "east", "down"))}
    axes |= {"pitch": (tilt[:, 0], "deg"), "roll": (tilt[:, 1], "deg"), "heading": (x["turn_deg"][rows, 2], "deg")}
    for axis, (error, unit) in axes.items():
        assert computed[f"ins.{axis}_rms_{unit}"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-4), axis
        assert computed[f"ins.{axis}_max_{unit}"] == pytest.approx(np.abs(error).max(), rel=1e-4), axis
        assert computed[f"ins.{axis}_std_{unit}"] == pytest.approx(np.std(error), rel=1e-4), axis
        assert f"ins.outage_{axis}_std_{unit}" in computed


# --- detection of faults


T = np.arange(0.0, 100.0, 0.2)


def alarms(*spans: tuple[float, float]) -> Any:
    return np.logical_or.reduce([(a - 1e-9 <= T) & (b - 1e-9 > T) for a, b in spans])


@pytest.mark.parametrize(
    ("spans", "delay", "sustained", "coverage", "end_lag"),
    [
        ([(40.0, 60.0)], 0.0, 0.0, 1.0, 0.0),
        ([(41.2, 67.6)], 1.2, 1.2, 0.94, 7.6),  # the paper's fading test on a step
        ([(10.0, 12.0), (43.0, 43.2), (50.0, 60.4)], 3.0, 10.0, 0.51, 0.4),
        ([(41.0, 41.2), (58.0, 58.2)], 1.0, np.nan, 0.02, 0.0),
        ([(59.0, 60.0)], 19.0, 19.0, 0.05, 0.0),
        ([(10.0, 40.0)], np.nan, np.nan, 0.0, 0.0),
        ([(60.0, 63.0)], np.nan, np.nan, 0.0, 3.0),
        ([(45.0, 101.0)], 5.0, 5.0, 0.75, np.nan),
    ],
)
def test_detection_scores(
    spans: list[tuple[float, float]], delay: float, sustained: float, coverage: float, end_lag: float
) -> None:
    score = detection.detection(T, alarms(*spans), (40.0, 60.0))
    assert score is not None
    found = [score.delay, score.sustained_delay, score.coverage, score.end_lag]
    np.testing.assert_allclose(found, [delay, sustained, coverage, end_lag], atol=1e-9)
    assert score.missed == np.isnan(delay)


def test_an_alarm_that_lasts_into_the_next_fault_has_not_ended() -> None:
    both = alarms((40.0, 80.0))
    score = detection.detection(T, both, (40.0, 60.0), until=70.0)
    assert score is not None
    assert np.isnan(score.end_lag)
    assert detection.detection(T, both, (200.0, 210.0)) is None


def faulty(*injected: tuple[Any, ...], chunk: int = 200) -> Any:
    """A made-up run of 200 s with faults (name, sensor, start, end) on record."""
    recorder = Recorder(None, scenario(200.0), 1)
    recorder.faults([FaultTruth(name, sensor, "x", "step", a, b, 3.0, "m") for name, sensor, a, b in injected])
    synthetic_run.record(recorder, circle(200.0), {"ins": Errors(aligned_after=0.0)}, chunk=chunk)
    run = recorder.dataset()
    take_all(run, "gnss_position", "gnss_velocity", "barometer")
    return run


def refuse(run: Any, aid: str, start: float, end: float, outcome: Outcome = Outcome.OUTSIDE_GATE) -> None:
    t = run[f"estimators/ins/innovations/{aid}"]["sample_time"].values
    for when in t[(t > start - 1e-6) & (t < end - 1e-6)]:
        relabel(run, aid, when, 0.0, outcome)


def test_faults_are_scored_by_name() -> None:
    run = faulty(("jump", "gnss", 100.0, 120.0), ("rise", "barometer", 110.0, 130.0), ("quiet", "airspeed", 5.0, 9.0))
    assert next((f.name, f.start, f.end) for f in detection.faults(run)) == ("jump", 100.0, 120.0)
    refuse(run, "gnss_velocity", 102.0, 120.0)  # one aid of the sensor is enough
    for aid in ("gnss_position", "gnss_velocity"):
        refuse(run, aid, 120.0, 121.0, Outcome.WITHHELD)  # and it is not used yet
    refuse(run, "barometer", 80.0, 80.2)  # by chance
    refuse(run, "barometer", 132.0, 133.0)  # after the fault that it missed
    found = metrics.compute(run)
    assert found["ins.detection_delay_s.jump"] == pytest.approx(2.0)
    assert found["ins.coverage.jump"] == pytest.approx(0.9)
    assert found["ins.end_lag_s.jump"] == pytest.approx(1.0)
    assert found["ins.missed.jump"] == 0
    assert found["ins.isolation_correct.jump"] == 1
    assert "ins.detection_delay_s.rise" not in found
    assert found["ins.missed.rise"] == 1
    assert found["ins.isolation_correct.rise"] == 0
    assert not [key for key in found if key.endswith("quiet")]  # nobody looks at the airspeed
    healthy_s = (100.0 - 60.0) + (200.1 - 140.0)  # neither from 100 s to 131 s nor from 110 s to 140 s
    assert found["ins.false_alarms_per_h"] == pytest.approx(3600 / healthy_s, rel=1e-3)
    assert found["ins.false_alarms_per_look"] == pytest.approx(1 / (3 * 5 * healthy_s), rel=5e-3)


def test_one_axis_refused_is_an_alarm() -> None:
    """The other axes of the sample were used."""
    run = faulty(("jump", "gnss", 100.0, 120.0))
    t = run["estimators/ins/innovations/gnss_position"]["sample_time"].values
    for when in t[(t > 103.0 - 1e-6) & (t < 122.0 - 1e-6)]:
        relabel(run, "gnss_position", when, 2 / 3, Outcome.OUTSIDE_GATE if when < 104 else Outcome.ISOLATED)
    found = metrics.compute(run)
    assert found["ins.detection_delay_s.jump"] == pytest.approx(3.0)
    assert found["ins.coverage.jump"] == pytest.approx(0.85)
    assert found["ins.end_lag_s.jump"] == pytest.approx(2.0)
    assert found["ins.isolation_correct.jump"] == 1
    assert found["ins.false_alarms_per_look"] == 0.0
    relabel(run, "gnss_position", 150.0, 2 / 3, Outcome.OUTSIDE_GATE)
    assert metrics.compute(run)["ins.false_alarms_per_look"] > 0.0


@pytest.mark.ci
def test_faults_that_overlap_end_when_they_end() -> None:
    run = faulty(("long", "gnss", 100.0, 130.0), ("short", "gnss", 105.0, 110.0), ("next", "gnss", 140.0, 150.0))
    refuse(run, "gnss_position", 100.0, 133.0)
    refuse(run, "gnss_velocity", 100.0, 133.0, Outcome.WITHHELD)
    found = metrics.compute(run)
    assert found["ins.end_lag_s.long"] == pytest.approx(3.0)
    assert "ins.end_lag_s.short" not in found  # nobody can tell
    assert found["ins.missed.next"] == 1
    healthy_s = (100.0 - 60.0) + (200.1 - 160.0)
    assert found["ins.false_alarms_per_look"] == 0.0
    relabel(run, "barometer", 190.0, 0.0, Outcome.OUTSIDE_GATE)
    relabel(run, "barometer", 158.0, 0.0, Outcome.OUTSIDE_GATE)
    assert metrics.compute(run)["ins.false_alarms_per_h"] == pytest.approx(3600 / healthy_s, rel=1e-3)


def test_axes_left_out_of_a_sample_that_is_used_are_an_alarm() -> None:
    run = faulty(("slow", "gnss", 100.0, 120.0))
    for t in np.arange(104.0, 121.9, 0.2):  # one axis of three
        relabel(run, "gnss_position", t, 2 / 3, Outcome.ISOLATED, 300.0)
    relabel(run, "gnss_position", 150.0, 2 / 3, Outcome.OUTSIDE_GATE, 40.0)
    relabel(run, "gnss_position", 160.0, 1.0, Outcome.FUSED)
    relabel(run, "gnss_position", 170.0, 0.5, Outcome.WEAKENED)  # a policy's weight
    found = metrics.compute(run)
    assert found["ins.detection_delay_s.slow"] == pytest.approx(4.0)
    assert found["ins.coverage.slow"] == pytest.approx(0.8)
    assert found["ins.end_lag_s.slow"] == pytest.approx(2.0)
    assert found["ins.isolation_correct.slow"] == 1
    healthy_s = (100.0 - 60.0) + (200.1 - 132.0)
    assert found["ins.false_alarms_per_h"] == pytest.approx(3600 / healthy_s, rel=1e-3)
    assert found["ins.nis_mean.gnss_position"] < 1.5  # what was isolated is in no mean


@pytest.mark.ci
def test_the_wrong_sensor_is_no_isolation() -> None:
    run = faulty(("jump", "gnss", 100.0, 120.0))
    refuse(run, "gnss_position", 110.0, 120.0)
    assert metrics.compute(run)["ins.isolation_correct.jump"] == 1
    refuse(run, "barometer", 108.0, 120.0)
    assert metrics.compute(run)["ins.isolation_correct.jump"] == 0


def test_single_refusals_are_no_isolation() -> None:
    """Those of an estimator that was led away, and refuses a sample now and then."""
    run = faulty(("jump", "gnss", 100.0, 120.0))
    for start in (104.0, 110.0, 116.0):
        refuse(run, "gnss_position", start, start + 1.0)
    found = metrics.compute(run)
    assert found["ins.coverage.jump"] == pytest.approx(0.15)
    assert found["ins.isolation_correct.jump"] == 0
    refuse(run, "gnss_position", 111.0, 112.0)
    assert metrics.compute(run)["ins.isolation_correct.jump"] == 1


@pytest.mark.ci
def test_what_is_known_without_a_sample_is_no_wrong_sensor() -> None:
    run = faulty(("jump", "gnss", 100.0, 120.0))
    refuse(run, "gnss_position", 110.0, 120.0)
    refuse(run, "barometer", 108.0, 120.0)
    sensor = run["estimators/ins/innovations/barometer/sensor"]
    sensor[:] = np.where(sensor.values == "barometer", NO_SENSOR, sensor.values)
    assert metrics.compute(run)["ins.isolation_correct.jump"] == 1


@pytest.mark.ci
def test_false_alarms_are_rejections_while_there_is_a_fix() -> None:
    dataset = synthetic_run.dataset(200.0, denied=((100.0, 150.0),))
    take_all(dataset, "barometer", "gnss_position", "gnss_velocity")
    barometer = dataset["estimators/ins/innovations/barometer"]
    for t in (30.0, 80.0, 90.2, 120.0, 190.0):  # aligned at 5 s, and settled a minute later; 120 s is in the outage
        barometer["weight"][round(t * 5)] = 0.0
    # From 65 s to 100 s, and from the arrival of the first fix at 150.1 s to the end.
    assert metrics.compute(dataset)["ins.false_alarms_per_h"] == pytest.approx(3 / (84.9 / 3600), rel=0.005)


def test_nothing_counts_before_alignment_and_settling(computed: dict[str, float]) -> None:
    assert computed["ins.aligned_s"] == 5.0
    assert computed["late.aligned_s"] == 100.0
    assert "late.outage_position_horizontal_at_60s_m" in computed
    assert "late.nonfinite_samples" not in computed
    late = metrics.compute(synthetic_run.dataset(100.0, {"ins": Errors(aligned_after=60.0)}))
    assert "ins.position_horizontal_rms_m" not in late
    assert metrics.compute(synthetic_run.dataset(10.0, {"ins": Errors(aligned_after=60.0)})) == {}


def test_settling_time_can_be_chosen() -> None:
    run = synthetic_run.dataset(30.0)
    assert "ins.position_horizontal_rms_m" in metrics.compute(run, settling_s=1.0)


def test_an_attitude_before_a_position_does_not_make_it_one_of_attitude_only() -> None:
    """One row of attitude alone took position and velocity out of all scores."""
    run = synthetic_run.dataset(100.0)
    own = run["estimators/ins"]
    first = (own["time"].values >= 5.0) & (own["time"].values < 8.0)
    own["status"].values[first] |= Status.ATTITUDE_ONLY
    for name in ("lat", "lon", "h", "v_n"):
        own[name].values[first] = np.nan
    found = metrics.compute(run)
    assert found["ins.aligned_s"] == 5.0
    assert found["ins.position_horizontal_rms_m"] == pytest.approx(2**0.5, rel=0.2)
    assert "ins.nonfinite_samples" not in found
    last = own["time"].values >= 95.0  # a position that is lost again is missing
    own["status"].values[last] |= Status.ATTITUDE_ONLY
    own["lat"].values[last] = np.nan
    assert metrics.compute(run)["ins.nonfinite_samples"] == last.sum()


@pytest.mark.ci
@pytest.mark.parametrize(("name", "wrong"), [("v_n", np.inf), ("lat", np.nan), ("h", 1e300)])
def test_what_never_was_a_number_is_not_taken_for_what_is_never_told(name: str, wrong: float) -> None:
    run = synthetic_run.dataset(100.0)
    own = run["estimators/ins"]
    own[name].values.reshape(len(own["time"]), -1)[:, 0] = wrong
    aligned = own["time"].values >= 5.0
    assert metrics.compute(run)["ins.nonfinite_samples"] == aligned.sum()
    for part in ("lat", "lon", "h") if name != "v_n" else ("v_n",):
        own[part].values[:] = np.nan
    assert "ins.nonfinite_samples" not in metrics.compute(run)


@pytest.mark.ci
def test_errors_are_judged_without_a_covariance() -> None:
    """A covariance that ends took the errors with it, and the estimates were called not finite."""
    run = synthetic_run.dataset(130.0)
    whole = metrics.compute(run)
    own = run["estimators/ins"]
    late = own["time"].values >= 80.0
    for name in ("covariance", "sigma_position_n", "sigma_velocity_n", "sigma_attitude_n"):
        own[name].values[late] = np.nan
    found = metrics.compute(run)
    assert "ins.nonfinite_samples" not in found
    assert found["ins.position_horizontal_rms_m"] == whole["ins.position_horizontal_rms_m"]
    assert found["ins.position_nees_mean"] != whole["ins.position_nees_mean"]


def test_what_is_left_out_throughout_is_not_missing() -> None:
    run = synthetic_run.dataset(100.0)
    whole = metrics.compute(run)
    run["estimators/ins/v_n"].values[:] = np.nan
    found = metrics.compute(run)
    gone = {key for key in whole if ".velocity" in key and "bound" not in key}
    assert found == {key: value for key, value in whole.items() if key not in gone}
    assert len(gone) > 10


def test_estimates_that_turn_nan_are_counted_not_averaged() -> None:
    found = metrics.compute(synthetic_run.dataset(100.0, {"ins": Errors(nan_from=90.0)}))
    assert found["ins.nonfinite_samples"] == 101
    assert np.isfinite(list(found.values())).all()


def test_estimates_too_large_to_be_squared_are_counted_not_averaged() -> None:
    """A filter that diverges for minutes comes to 1e200: metrics ended in an overflow."""
    run = synthetic_run.dataset(100.0)
    run["estimators/ins/v_n"].values[-101:] = 1e200
    found = metrics.compute(run)
    assert found["ins.nonfinite_samples"] == 101
    assert np.isfinite(list(found.values())).all()


def recovering(path: Path, bad_until: float, relapse: float | None = None) -> dict[str, float]:
    """An estimator 20 m off until ``bad_until``, and again for a second from ``relapse``."""
    truth = circle(200.0)
    recorder = Recorder(None, scenario(200.0), 1)
    recorder.truth(truth)
    for k, good in synthetic_run.estimates(truth, Errors(sigma_position=0.1), np.random.default_rng(0)).items():
        t = truth.t[k]
        off = 90 <= t < bad_until or (relapse is not None and relapse <= t < relapse + 1)
        recorder.estimates("ins", Estimates.of([replace(good, lat=good.lat + off * 20 / 6.36e6)]))
        fix = FixType.NO_FIX if 80 <= t < 100 else FixType.FIX_3D
        nan = np.full(3, np.nan)
        recorder.samples("gnss", [GnssSample(t, t, np.nan, np.nan, np.nan, nan, nan, nan, fix, 0, 1.0, 1.0)])
    return metrics.compute(recorder.dataset())


@pytest.mark.ci
@pytest.mark.parametrize(
    ("bad_until", "relapse", "expected"),
    [(95.0, None, 0.0), (107.0, None, 7.0), (107.0, 120.0, 21.0), (107.0, 170.0, 7.0)],
)
def test_recovery_is_when_it_stays_good(
    tmp_path: Path, bad_until: float, relapse: float | None, expected: float
) -> None:
    found = recovering(tmp_path, bad_until, relapse)
    assert found["ins.recovery_s"] == pytest.approx(expected, abs=0.11)
    assert found["ins.unrecovered_outages"] == 0


def test_no_recovery_is_no_time(tmp_path: Path) -> None:
    found = recovering(tmp_path, 300.0)
    assert "ins.recovery_s" not in found
    assert found["ins.unrecovered_outages"] == 1


@pytest.mark.ci
def test_a_hold_that_the_end_of_the_run_cuts_off_is_no_recovery(tmp_path: Path) -> None:
    found = recovering(tmp_path, 172.0)  # of 200 s
    assert "ins.recovery_s" not in found
    assert found["ins.unrecovered_outages"] == 1
    assert recovering(tmp_path, 169.0)["ins.recovery_s"] == pytest.approx(69.0, abs=0.11)


@pytest.mark.ci
def test_an_outage_at_the_end_is_not_judged() -> None:
    found = metrics.compute(synthetic_run.dataset(200.0, {"ins": Errors(aligned_after=0.0)}, ((150.0, 180.0),)))
    assert "ins.outage_position_horizontal_rms_m" in found
    assert not [key for key in found if "recover" in key]


def receivers(reports: dict[str, Any], end: float = 60.0, late: float = 0.2) -> list[tuple[float, float]]:
    """Outages of receivers that report twice a second, by the times at which they do and whether there is a fix."""
    recorder = Recorder(None, scenario(), 1)
    recorder.truth(circle(end))
    nan = np.full(3, np.nan)
    for name, says in reports.items():
        for t in np.arange(0.0, end + 0.1, 0.5):
            if says(t) is not None:
                fix = FixType.FIX_3D if says(t) else FixType.NO_FIX
                sample = GnssSample(t, t + late, nan[0], nan[0], nan[0], nan, nan, nan, fix, 0, 1.0, 1.0, name)
                recorder.samples(name, [sample])
    return metrics.outages(recorder.dataset())


def test_a_receiver_that_has_said_nothing_has_no_fix() -> None:
    found = receivers({"left": lambda t: t >= 20.0, "right": lambda t: True if t >= 30.0 else None})
    assert found == [(0.0, 20.2)]
    found = receivers({"left": lambda t: t >= 40.0, "right": lambda t: True if t >= 30.0 else None})
    assert found == [(0.0, 30.2)]


def test_a_receiver_that_falls_silent_has_no_fix() -> None:
    assert receivers({"left": lambda t: None if 20.0 <= t < 30.0 else True}) == [(20.0, 30.2)]
    assert receivers({"left": lambda t: None if t >= 50.0 else True}) == [(50.0, np.inf)]
    assert receivers({"left": lambda t: True}) == []
    late = 1.2  # what comes after the end isn't recorded
    assert receivers({"left": lambda t: True if t + late <= 60.0 else None}, late=late) == []
    assert receivers({"left": lambda t: True if t <= 57.0 else None}, late=late) == [(57.5, np.inf)]


@pytest.mark.ci
def test_no_outage_no_outage_keys() -> None:
    for gnss in (True, False):
        found = metrics.compute(synthetic_run.dataset(100.0, gnss=gnss))
        assert "ins.position_horizontal_rms_m" in found
        assert not [key for key in found if "outage" in key or "recover" in key]


def test_outages_need_every_receiver_to_be_without_fix() -> None:
    recorder = Recorder(None, scenario(), 1)
    recorder.truth(circle(60.0))
    nan = np.full(3, np.nan)
    for name, (start, end) in {"left": (10.0, 30.0), "right": (20.0, 70.0)}.items():
        for t in np.arange(0.0, 60.0, 0.5):
            fix = FixType.NO_FIX if start <= t < end else FixType.FIX_3D
            recorder.samples(
                name, [GnssSample(t, t + 0.2, nan[0], nan[0], nan[0], nan, nan, nan, fix, 0, 1.0, 1.0, name)]
            )
    assert metrics.outages(recorder.dataset()) == [(20.0, 30.2)]


def test_across_the_date_line_nothing_jumps() -> None:
    found = metrics.compute(synthetic_run.dataset(100.0, lon_deg=179.9999, lat_deg=-40.0))
    assert found["ins.position_horizontal_max_m"] < 10


def test_metrics_are_saved_as_strict_json(tmp_path: Path, computed: dict[str, float]) -> None:
    metrics.save(computed, tmp_path / "metrics.json")
    assert json.loads((tmp_path / "metrics.json").read_text()) == computed
    with pytest.raises(UserError, match="can't be written"):
        metrics.save(computed, tmp_path / "absent" / "metrics.json")


def test_every_metric_is_a_finite_number(computed: dict[str, float]) -> None:
    assert np.isfinite(list(computed.values())).all()
    assert all(type(value) is float for value in computed.values())


@pytest.fixture(scope="module")
def flown() -> Any:
    return fly(Scenario.load("u_turn", ["duration_s=75"])).dataset


def test_a_scenario_that_is_no_longer_read_is_told_by_what_it_costs(flown: Any) -> None:
    old = flown.copy()
    old.attrs = old.attrs | {"scenario": "[unheard_of]\nx = 1\n", "versions": '{"navigation-testbed": "0.0.9"}'}
    assert not [key for key in metrics.compute(old) if key.startswith("flight.")]
    assert observability.of_run(old) == {}
    told = [text for text in metrics.unscored(old) if "left out" in text]
    assert len(told) == 1
    assert told[0].startswith("flight.* and visibility are left out: a record of format 'navigation-testbed run")
    assert "written by navigation-testbed 0.0.9, whose scenario is no longer read: " in told[0]
    assert not [text for text in metrics.unscored(flown) if "left out" in text]


def shortened(run: Any, t: float, without: str) -> xarray.DataTree:
    """A record as somebody who was killed leaves it: rows up to ``t``, none at all of some groups."""
    groups = {"/": xarray.Dataset(attrs=run.attrs | {"complete": 0})}
    for node in run.subtree:
        own = node.to_dataset(inherit=False)
        time = "sample_time" if "sample_time" in own.dims else "time"
        if time in own.dims:
            rows = 0 if node.path.startswith(without) else int(np.sum(own[time].values <= t))
            groups[node.path] = own.isel({time: slice(rows)})
    return xarray.DataTree.from_dict(groups)


@pytest.mark.ci
@pytest.mark.parametrize("t", [0.0, 0.1, 1.0, 3.0, 70.0])
@pytest.mark.parametrize("without", ["/nothing", "/sensors", "/sensors/gnss", "/estimators", "/estimators/ins/inn"])
def test_a_record_cut_anywhere_is_scored(flown: Any, t: float, without: str) -> None:
    cut = shortened(flown, t, without)
    found = metrics.compute(cut)
    assert np.isfinite(list(found.values())).all()
    assert all(key in metrics.compute(flown) for key in found)  # a part of a run has no figure that the whole has not
    assert all(metrics.unscored(cut))
    observability.of_run(cut)


def test_a_record_without_a_row_is_told(flown: Any) -> None:
    with pytest.raises(UserError, match="no row of truth, so there is nothing to score"):
        metrics.compute(shortened(flown, -1.0, "/nothing"))
