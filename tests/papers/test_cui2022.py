"""Cui et al. 2022: the scenario is the paper's, one flight meets its claims, claims can fail, and what it misprints."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import pytest
from scipy.stats import chi2, ncx2
from worlds.lanes import lanes

from nav.aids import GnssAid
from nav.aids.base import OperatingPoint
from nav.detection import Detector, Eraim, Glr
from nav.error_model import POS, VEL
from nav.federated import Federated
from nav.kalman import correct, innovate
from nav.local_filter import LocalFilter
from nav.samples import Array, FixType, GnssSample
from testbed import papers, run
from testbed.estimators.datasheet import imu_model
from testbed.feeds.simulated import motion
from testbed.papers.cui2022 import PAPER, claims, flight
from testbed.papers.cui2022.flight import GLR, TOLD, WITH_STAR, WITHOUT_STAR, Draw
from testbed.papers.flights import KnownFaults
from testbed.scenario import Scenario
from testbed.score import accuracy
from testbed.sensors.imu import ImuConfig


@pytest.fixture(scope="module")
def shipped() -> Scenario:
    return papers.scenario("cui2022")


@pytest.fixture(scope="module")
def draw() -> Draw:
    """What a job gives."""
    return flight.fly(3, True)


def test_the_motion_is_the_paper_s(shipped: Scenario) -> None:
    slow = papers.scenario("cui2022", ["truth.rate_hz=50", "sensors.imu.rate_hz=50"])
    block = motion(slow, 1).advance(1200 * 50 + 1)
    assert shipped.duration_s == block.t[-1]
    t, speed = block.t, np.linalg.norm(block.v_n, axis=1)
    assert speed[0] == pytest.approx(100)
    assert speed[t == 150.0][0] == pytest.approx(150, abs=0.1)
    assert speed[-1] == pytest.approx(200)
    assert np.rad2deg(np.arctan2(block.v_n[0, 1], block.v_n[0, 0])) == pytest.approx(30)
    assert np.abs(block.h - 1000).max() < 1e-6
    assert np.trapezoid(speed, t) == pytest.approx(225e3, rel=1e-3)


def test_the_faults_are_table_2(shipped: Scenario) -> None:
    """In metres from arcminutes, of 1852 m each, within what the ellipsoid makes of them."""
    by_name = {fault.name: fault for fault in shipped.fault}
    lat, lon, h = math.radians(34.0), math.radians(108.0), 1000.0
    arcmin = math.radians(1 / 60)
    _, east, _ = pymap3d.geodetic2ned(lat, lon + 0.3 * arcmin, h, lat, lon, h, deg=False)
    north, _, _ = pymap3d.geodetic2ned(lat + 1e-3 * arcmin, lon, h, lat, lon, h, deg=False)
    assert by_name["longitude"].size == pytest.approx(east, rel=5e-3)  # type: ignore[union-attr]
    assert by_name["latitude"].coefficient == pytest.approx(0.8 * north, rel=5e-3)  # type: ignore[union-attr]
    windows = {"longitude": (20, 50), "latitude": (100, 140), "east_velocity": (300, 330),
               "doppler_velocity": (500, 540), "height": (600, 650), "north_velocity": (1000, 1060)}  # fmt: skip
    assert {fault.name: fault.window for fault in shipped.fault} == windows


def test_a_body_that_never_turns_keeps_its_gyro_bias() -> None:
    """15 arcsec of misalignment count with the rate of turn; at the default they are 100 times the bias.

    So do they with the load of turns: of a body that does not turn, the accelerometer bias does not walk.
    """
    tilted = dict.fromkeys(("gyro_misalignment_mrad", "accel_misalignment_mrad"), 0.0727)
    errors = ImuConfig(grade="perfect", gyro_turn_on_degph=0.01, **tilted).errors()
    straight, turning = imu_model(errors, math.radians(0.006)), imu_model(errors)
    assert turning.accel_bias_walk == pytest.approx(7.27e-5 * 9.80665 * 0.1 / math.sqrt(120))
    assert straight.accel_bias_walk < 1e-4 * turning.accel_bias_walk
    assert straight.gyro_bias_sigma == pytest.approx(errors.gyro_turn_on, rel=0.02)
    assert turning.gyro_bias_sigma == pytest.approx(7.27e-5 * 0.06, rel=0.01)
    assert straight.accel_bias_sigma == turning.accel_bias_sigma


def test_turn_rate_and_recall_reach_the_filters(shipped: Scenario) -> None:
    config = lanes(shipped, 1)["with_star"].horizon.estimator.config  # type: ignore[union-attr]
    assert config.recall_s == 10.0
    assert math.degrees(config.imu.gyro_bias_sigma) * 3600 == pytest.approx(0.01, rel=0.02)


def test_the_states_are_those_of_eq_36() -> None:
    """24 common ones, none of which walks for want of another; 6 of a GPS with slow errors, 6 of the Doppler."""
    slow = ["correlated_m", "velocity_correlated_mps"]
    gps = [f"sensors.gps.{axis}_{what}=1" for axis in ("horizontal", "vertical") for what in slow]
    estimator = lanes(papers.scenario("cui2022", gps), 1)["with_star"].horizon.estimator
    assert isinstance(estimator, Federated)
    common = ["phi", "dv", "dp", "gyro_bias", "accel_bias", "gyro_drift", "gyro_scale", "accel_scale"]
    own = {
        "gps": ["gps_position_error", "gps_velocity_error"],
        "doppler": ["doppler_scale", "doppler_error"],
        "star": [],
    }
    for local, filter_ in zip(estimator.config.locals, estimator.locals, strict=True):
        model = filter_.model
        assert (model.mixing, model.size) == (24, 24 + 3 * len(own[local.name]))
        assert list(model.slices) == common + own[local.name]
    model, g0 = estimator.model, 9.80665
    per_hour = math.radians(1.0) / 3600
    for name, sigma in (
        ("gyro_bias", 0.01 * per_hour), ("gyro_drift", 0.005 * per_hour), ("gyro_scale", 2e-5), ("accel_scale", 2e-5),
        ("accel_bias", g0 * math.hypot(5e-5, 15 * math.radians(1 / 3600))),
    ):  # fmt: skip
        np.testing.assert_allclose(model.sigma[model.slices[name]], sigma, rtol=0.015)
    np.testing.assert_allclose(1 / model.decay_rate[model.slices["gyro_drift"]], 3600)
    # The walks left are those of misalignment: of the gyros at the Earth's rate, of the accelerometers next to none.
    gyro, accel = (model.density[model.slices[name]] for name in ("gyro_bias", "accel_bias"))
    np.testing.assert_allclose(gyro, 7.27e-5 * math.radians(0.006) / math.sqrt(120), rtol=1e-3)
    assert (accel * math.sqrt(1200) < 1e-4 * model.sigma[model.slices["accel_bias"]]).all()


def normalised(seeds: range, duration_s: int, *, faults: bool) -> Array:
    """Squared errors (seeds, 2) of position and velocity at the end over the claimed covariance, 3 degrees each.

    Of one filter with every sensor; with ``faults`` of the federation.
    """
    overrides = [f"duration_s={duration_s}"]
    if not faults:
        scenario = papers.scenario("cui2022")
        config = scenario.estimator[0]
        aids = [aid for local in config.locals for aid in local.aids]
        handover = "handover={level_deg=0.00278, heading_deg=0.0333, velocity_mps=0.01, position_m=5}"
        one = f'{{name="with_star", states="{config.states}", turn_degps={config.turn_degps}, aids={aids}, {handover}}}'
        overrides += ["fault=[]", f"estimator=[{one}]", "expect={}"]
    rows = []
    for seed in seeds:
        errors = accuracy.errors(run(papers.scenario("cui2022", overrides), seed=seed).dataset, "with_star")
        rows.append([3 * errors.position_nees[-1], 3 * errors.velocity_nees[-1]])
    return np.array(rows)


@pytest.mark.ci
def test_the_claimed_covariance_is_that_of_the_errors() -> None:
    """Once the speed has changed, which scale factors and the misalignment without a state feel."""
    for found in normalised(range(1, 9), 240, faults=False).T:
        low, high = chi2.ppf([0.0005, 0.9995], 3 * len(found))
        assert low < found.sum() < high


@pytest.mark.slow
def test_the_claimed_covariance_at_the_end_of_the_flight() -> None:
    """Two-sided 99 % of one filter; the federation without resets claims no less than its errors, faults or none."""
    alone = normalised(range(1, 21), 1200, faults=False)
    low, high = chi2.ppf([0.005, 0.995], 3 * len(alone))
    print(alone.mean(axis=0), low / len(alone), high / len(alone))
    assert ((low < alone.sum(axis=0)) & (alone.sum(axis=0) < high)).all()
    federated = normalised(range(1, 21), 1200, faults=True)
    print(federated.mean(axis=0))
    assert (federated.sum(axis=0) < high).all()


@pytest.mark.ci
def test_one_draw(draw: Draw) -> None:
    """With generous room: the claims themselves are judged over all of them."""
    for name in (WITH_STAR, WITHOUT_STAR, GLR):
        scores = {fault: score.detection for fault, score in draw.faulty[name].scores.items()}
        assert all(score is not None for score in scores.values())
        for fault in ("longitude", "height", "doppler_velocity"):
            assert (scores[fault].delay, scores[fault].coverage) == (0.0, 1.0)  # type: ignore[union-attr]
        assert scores["latitude"].delay <= 11  # type: ignore[union-attr]
        assert scores["north_velocity"].delay <= 6  # type: ignore[union-attr]
        assert draw.faulty[name].largest["position"].max() < 14
        assert draw.faulty[name].largest["velocity"].max() < 0.2
    assert draw.faulty[WITH_STAR].largest["attitude"].max() < 6
    assert draw.kept == pytest.approx(1.0)
    sound = draw.healthy[WITH_STAR]
    assert (sound.refused, sound.isolated, sound.measurements) == (0, 0, 4804)


@pytest.mark.ci
def test_claims_can_fail(draw: Draw) -> None:
    """Judged over a hundred times the same, so that every interval is as narrow as it can be."""

    def missed(one: Draw) -> set[str]:
        return {claim.quantity for claim in claims.claims([one] * 100) if claim.verdict == "missed"}

    every = [claim.quantity for claim in claims.claims([draw])]
    assert len(every) == len(set(every))
    before = missed(draw)
    assert not any(name.startswith("detection delay") for name in before)
    spoilt = copy.deepcopy(draw)
    star = spoilt.faulty[WITH_STAR]
    for fault, delay in (("longitude", 1.0), ("height", math.nan)):
        score = star.scores[fault]
        assert score.detection is not None
        star.scores[fault] = score._replace(detection=replace(score.detection, delay=delay))  # type: ignore[index]
    star.scores["latitude"] = star.scores["latitude"]._replace(isolated=False)  # type: ignore[index]
    star.largest["velocity"][2] = 0.6
    sound = spoilt.healthy[WITH_STAR]._replace(refused=4, isolated=3)
    spoilt = spoilt._replace(kept=0.5, healthy={WITH_STAR: sound})
    lost = missed(spoilt) - before
    for start in (
        "detection delay, longitude step", "detection delay, height step", "the right sensor isolated",
        "largest error after 60 s, velocity down, six faults", "sound axes",
        "flights within every figure of the paper", "largest error after 60 s, velocity, any axis, six faults",
        "measurements while a sensor was isolated", "measurements refused in 1200 s without fault",
        "measurements refused without fault, share",
    ):  # fmt: skip
        assert any(name.startswith(start) for name in lost), start
    assert not any(name.startswith("detection delay, Doppler") for name in lost)


@pytest.mark.ci
def test_the_optimal_filter_is_told_of_the_faults_alone(draw: Draw) -> None:
    """It loses what the axes at fault would have told, and no more."""
    nothing = np.zeros(3)
    told = KnownFaults(((1, 20.0, 50.0), (0, 100.0, 140.0)))
    used = [np.isfinite(told.adapt(nothing, np.eye(3), np.ones(3), t)).tolist() for t in (19.0, 20.0, 49.0, 50.0, 110)]
    assert used == [[True] * 3, [True, False, True], [True, False, True], [True] * 3, [False, True, True]]
    assert set(flight.known(papers.scenario("cui2022"))) == {"gnss_position", "gnss_velocity", "body_velocity"}
    best = draw.faulty[TOLD[WITH_STAR]]
    for what, most in (("position", 12.0), ("velocity", 0.2), ("attitude", 6.0)):
        assert best.largest[what].max() < most
    assert best.largest["attitude"] == pytest.approx(draw.healthy[WITH_STAR].largest["attitude"], rel=0.3)


@pytest.mark.ci
def test_draws_differ_in_place_and_course() -> None:
    starts = [flight.drawn(seed).truth.start for seed in (1, 2)]
    assert starts[0].lat_deg != starts[1].lat_deg
    assert starts[0].heading_deg != starts[1].heading_deg


@pytest.mark.ci
def test_the_figure_is_drawn(draw: Draw, tmp_path: Path) -> None:
    PAPER.draw([draw], tmp_path)
    picture = tmp_path / "cui2022.png"
    assert 20_000 < picture.stat().st_size < 150_000


def found(kind: Callable[[float], Detector], count: int) -> float:
    """Share of steps of one sigma on one of three axes, after 60 sound samples, that are found within 30."""
    random = np.random.default_rng(2022)
    seen = 0
    for _ in range(count):
        nu = random.standard_normal((90, 3))
        nu[60:, 1] += 1.0
        detector = kind(1e-5)
        seen += any([detector.step(v, np.eye(3), float(k)).alarm for k, v in enumerate(nu)][60:])
    return seen / count


def test_a_step_of_one_sigma_is_beyond_a_snapshot() -> None:
    """Non-central chi-square of one sigma: 1.1e-4 per measurement at 1e-5, 0.3 % of steps of 30; the GLR finds most."""
    each = float(ncx2.sf(25.902, 3, 1.0))
    assert 1 - (1 - each) ** 30 == pytest.approx(0.0034, abs=1e-4)
    assert found(Eraim, 300) <= 0.02
    assert found(Glr, 300) > 0.5


def test_the_drifts_show_when_noise_lets_them() -> None:
    """Why "no delay" can't be: what one measurement of 20 m and of 0.3 m/s shows of 1.48 tau^2 m and of 0.5 tau m/s."""

    def seen(sigmas: float) -> float:
        return float(ncx2.sf(25.902, 3, sigmas**2))

    assert [round(seen(1.4816 * tau**2 / 20), 2) for tau in (7, 8, 9, 10)] == [0.11, 0.44, 0.86, 0.99]
    assert [round(seen(0.5 * tau / 0.3), 2) for tau in (2, 3, 4, 5)] == [0.07, 0.54, 0.96, 1.0]


# --- what the paper misprints


def test_the_gain_of_eq_9_makes_the_variance_negative() -> None:
    """K = P- H' / R with P+ = (1 - K H) P-: holds with P+ in the place of P- only. P- = 4, R = 1, H = 1."""
    P, H, R = np.array([[4.0]]), np.array([[1.0]]), np.array([1.0])
    printed = P[0, 0] / R[0]
    assert (1 - printed) * P[0, 0] == -12.0
    _, S_inverse, HP, _ = innovate(P, H, R, np.array([1.0]))
    gain = correct(P, H, R, HP, S_inverse, np.array([1.0]))
    assert gain[0] == pytest.approx(0.8)
    assert P[0, 0] == pytest.approx(0.8)
    assert gain[0] == pytest.approx(P[0, 0] / R[0])  # with the variance after the update


def test_the_measurement_matrix_of_eq_35_would_see_the_misalignments() -> None:
    """Printed: ones in the first three columns, twice. There the attitude lies (Eq 12)."""
    scenario = papers.scenario("cui2022")
    estimator = lanes(scenario, 1)["with_star"].horizon.estimator
    reference = estimator._reference  # type: ignore[union-attr]
    state = reference.start(_level())
    local: LocalFilter = estimator.locals[0]  # type: ignore[union-attr]
    aid = local.aids["gps"]
    assert isinstance(aid, GnssAid)
    three = np.full(3, 1.0)
    fix = GnssSample(0.0, 0.0, 0.6, 1.9, 1000.0, np.zeros(3), three, three, FixType.FIX_3D, 9, 1.0, 1.0, "gps")
    here = OperatingPoint(reference, state, state.x[0], (-1, -1, -1), state.P[0])
    measured = [aid.measure(part, fix, here) for part, _ in aid.parts]
    H = np.vstack([one.H for one in measured if one is not None])
    printed = np.zeros_like(H)
    printed[[0, 3], 0] = printed[[1, 4], 1] = printed[[2, 5], 2] = 1.0
    assert np.linalg.matrix_rank(printed) == 3  # rows 4 to 6 say nothing new
    right = np.zeros_like(H)
    right[:3, POS : POS + 3] = right[3:, VEL : VEL + 3] = np.eye(3)
    np.testing.assert_allclose(H, right)
    assert not (H @ printed.T).any()


def _level() -> Any:
    from nav.alignment import InitialState

    q_nb = np.array([1.0, 0.0, 0.0, 0.0])
    return InitialState(0.0, 0.6, 1.9, 1000.0, np.array([100.0, 0.0, 0.0]), q_nb, np.eye(9))


def test_errors_count_when_those_of_a_run_do() -> None:
    assert accuracy.SETTLING_S == flight.AFTER_S
