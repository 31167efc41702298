"""Metrics against formulas and libraries that share nothing with them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import pytest
import synthetic_run
from scipy.spatial.transform import Rotation
from synthetic_run import Errors, circle, scenario

from nav.samples import FixType, GnssSample
from testbed import metrics
from testbed.errors import UserError
from testbed.record import Recorder

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


def test_heading_error_is_the_difference_of_headings_in_level_flight() -> None:
    heading = np.deg2rad(np.array([10.0, 179.0, -179.0, 90.0]))
    error = np.deg2rad(np.array([2.0, 3.0, -3.0, 0.0]))
    q, q_true = (Rotation.from_euler("z", h[:, None]).as_quat(scalar_first=True) for h in (heading + error, heading))
    np.testing.assert_allclose(metrics.attitude_error(q, -q_true)[:, 2], -error, atol=1e-12)


def test_attitude_error_has_the_sign_of_the_conventions() -> None:
    rng = np.random.default_rng(3)
    true = Rotation.random(50, rng=rng)
    phi = rng.normal(size=(50, 3)) * 1e-4
    C_hat = np.array([(np.eye(3) - np.cross(np.eye(3), p)) @ C for p, C in zip(phi, true.as_matrix(), strict=True)])
    estimated = Rotation.from_matrix(C_hat).as_quat(scalar_first=True)
    # the rows of np.cross(I, p) are e_i x p, so it is the matrix [p x]
    np.testing.assert_allclose(metrics.attitude_error(estimated, true.as_quat(scalar_first=True)), phi, atol=1e-7)


def test_nees_is_the_quadratic_form_and_nan_where_singular() -> None:
    rng = np.random.default_rng(4)
    A = rng.normal(size=(20, 3, 3))
    P = A @ A.transpose(0, 2, 1) * np.array([1e-8, 1.0, 1e8])[rng.integers(0, 3, 20), None, None]
    e = rng.normal(size=(20, 3))
    expected = [x @ np.linalg.inv(p) @ x / 3 for x, p in zip(e, P, strict=True)]
    np.testing.assert_allclose(metrics.nees(e, P), expected, rtol=1e-6)
    assert np.isnan(metrics.nees(e[:1], np.zeros((1, 3, 3)))).all()
    assert np.isnan(metrics.nees(e[:1], np.ones((1, 3, 3)))).all()
    assert np.isnan(metrics.nees(e[:1], np.full((1, 3, 3), np.nan))).all()


def test_consistent_errors_give_one_and_overconfident_ones_their_square() -> None:
    for factor in (1.0, 2.0):
        found = metrics.compute(synthetic_run.dataset(400.0, {"ins": Errors(truth_over_claim=factor)}, DENIED))
        for key in ("position", "velocity", "attitude"):
            assert found[f"ins.{key}_nees_mean"] == pytest.approx(factor**2, rel=0.1)
            assert found[f"ins.outage_{key}_nees_mean"] == pytest.approx(factor**2, rel=0.1)


def test_error_at_marks_of_the_outage(run: Any, computed: dict[str, float]) -> None:
    x = independent(run, "ins")
    for mark in (60, 120):
        row = np.flatnonzero(np.isclose(x["t"], 150 + mark))[0]
        assert computed[f"ins.outage_position_horizontal_at_{mark}s_m"] == pytest.approx(x["horizontal"][row], rel=2e-5)
    assert "ins.outage_position_horizontal_at_300s_m" not in computed


def test_nis_counts_what_was_fused_and_refusals_are_told(run: Any, computed: dict[str, float]) -> None:
    reports = run["estimators/ins/innovations/gnss_position"]
    after = reports["sample_time"].values >= 65
    fused = after & (reports["weight"].values > 0)
    assert computed["ins.nis_mean.gnss_position"] == pytest.approx(reports["nis"].values[fused].mean() / 3)
    assert computed["ins.nis_mean.barometer"] == pytest.approx(1.0, abs=0.15)
    refused = np.mean(reports["weight"].values[after] == 0)
    assert computed["ins.rejected_fraction.gnss_position"] == pytest.approx(refused)


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


def test_estimates_that_turn_nan_are_counted_not_averaged() -> None:
    found = metrics.compute(synthetic_run.dataset(100.0, {"ins": Errors(nan_from=90.0)}))
    assert found["ins.nonfinite_samples"] == 101
    assert np.isfinite(list(found.values())).all()


def recovering(path: Path, bad_until: float, relapse: float | None = None) -> dict[str, float]:
    """An estimator 20 m off until ``bad_until``, and again for a second from ``relapse``."""
    truth = circle(200.0)
    recorder = Recorder(None, scenario(200.0), 1)
    recorder.truth(truth)
    rng = np.random.default_rng(0)
    for k in range(0, len(truth), 20):
        t = truth.t[k]
        off = 90 <= t < bad_until or (relapse is not None and relapse <= t < relapse + 1)
        good = synthetic_run.estimate(truth, k, Errors(sigma_position=0.1), rng)
        recorder.estimate(
            "ins",
            type(good)(
                **{f: getattr(good, f) for f in good.__slots__} | {"h": good.h, "lat": good.lat + off * 20 / 6.36e6}
            ),
        )
        fix = FixType.NO_FIX if 80 <= t < 100 else FixType.FIX_3D
        nan = np.full(3, np.nan)
        recorder.samples("gnss", [GnssSample(t, t, np.nan, np.nan, np.nan, nan, nan, nan, fix, 0, 1.0, 1.0)])
    return metrics.compute(recorder.dataset())


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
