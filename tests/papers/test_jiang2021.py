"""The U flight of Jiang et al. 2021: what is measured, what is concluded, and that each claim can fail."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from testbed import papers
from testbed.papers import jiang2021, levelling
from testbed.papers.draws import world
from testbed.papers.jiang2021 import (
    ACCELERATION,
    CASES,
    FLIGHTS,
    GYROS,
    LITERAL,
    MODELLED,
    NORM,
    PAPER_S,
    ROLL,
    SLOW,
    SLOW_COMPENSATED,
    TILTED,
    TILTED_PAPER_S,
    YAW,
    Case,
    Flown,
    Run,
)
from testbed.score.claims import Verdict


@pytest.fixture(scope="module")
def run() -> Run:
    return jiang2021.fly(1)


@pytest.fixture(scope="module")
def flown(run: Run) -> dict[Case, Flown]:
    return run[0]


def made(error: np.ndarray, levelled: tuple[float, ...] = ()) -> Flown:
    """A run of these errors (N, 3) [deg], one a second, that turns from 100 s to 120 s."""
    t = np.arange(1.0, len(error) + 1.0)
    q_nb = Rotation.from_euler("xyz", error, degrees=True).as_quat(scalar_first=True)
    judged = np.zeros((len(t), 3))
    judged[102:120, ACCELERATION], judged[102:120, YAW], judged[101:103, ROLL] = 2.6, 3.0, 5.0
    judged[50:51, ACCELERATION] = judged[101:102, ACCELERATION] = 0.3  # gusts
    return Flown(t, q_nb, error, judged, np.zeros((len(t), 2)), np.array(levelled), (100.0, 120.0))


@pytest.mark.parametrize("flight", FLIGHTS)
def test_scenarios_say_what_they_show_and_promise(flight: str) -> None:
    loaded = papers.scenario(flight)
    assert loaded.text.startswith("# What this shows")
    assert loaded.expect
    assert {case.estimator for case in CASES if case.flight == flight} <= set(jiang2021.estimators(loaded, 1))


@pytest.mark.parametrize("flight", FLIGHTS)
def test_each_draw_has_a_world_of_its_own(flight: str) -> None:
    placed = jiang2021.placed(flight, world(3, 2))
    shipped = papers.scenario(flight)
    assert placed.site().lat != shipped.site().lat
    assert placed.duration_s == shipped.duration_s
    assert placed != shipped


def test_what_is_measured() -> None:
    error = np.zeros((200, 3))
    error[9, 0], error[69, 1], error[99, 0], error[199, 2] = 3.0, -0.7, 0.6, 5.0
    error[:5, 1] = 0.6
    one = made(error, (100.0, 100.5, 101.0, 120.0, 121.0))
    assert one.largest == 0.7
    assert one.rms == pytest.approx(0.7 / math.sqrt(141))
    assert one.accepted(100.0, 120.0) == 3


def test_recovered_is_to_stay_below() -> None:
    """Not first to cross: below at 6 s already, but above again at 10 s and at 70 s; the turn is not of it."""
    error = np.zeros((200, 3))
    error[:5, 1], error[9, 0], error[69, 1], error[110, 0] = 0.6, 3.0, -0.7, 2.0
    assert made(error).recovered_s == 71.0
    assert made(np.zeros((200, 3))).recovered_s == 1.0
    assert made(error + 1.0).recovered_s == math.inf


def test_a_turn_is_noticed_by_what_lasts() -> None:
    one = made(np.zeros((200, 3)))
    assert [one.noticed_s(test) for test in (ROLL, YAW, ACCELERATION)] == [102.0, 103.0, 102.0]
    assert one.in_steady_turn(YAW).tolist() == [10.0, 10.0]
    assert one.in_steady_turn(ROLL).tolist() == [0.0, 10.0]


def test_correction_is_what_levelling_alone_turned() -> None:
    error = np.zeros((5, 3))
    error[2:, 0], error[4:, 0] = 0.15, 0.05
    assert jiang2021.largest_correction(made(error), made(np.zeros((5, 3)))) == pytest.approx(0.15)


def test_room_is_a_share() -> None:
    assert jiang2021.room(np.tile([0.8, 0.6, 0.5], (5, 1))) == pytest.approx(2 / 3)


def statistics(**other: float) -> levelling.Statistics:
    told = {
        "gyro_bias": 1e-9, "gyro_noise": 1e-4, "misalignment": 1e-9, "accel_bias": 1e-9, "accel_noise": 1e-3,
        "gust": 0.15, "gust_correlation_s": 0.5, "tilt": 0.01,
    }  # fmt: skip
    return levelling.Statistics(**(told | other))


def test_gusts_and_their_means_against_van_loan() -> None:
    """Exact covariance of [gust, integral of gust] over a second by the matrix exponential."""
    s = statistics()
    A = np.array([[-1 / s.gust_correlation_s, 0.0], [1.0, 0.0]])
    noise = np.diag([2 * s.gust**2 / s.gust_correlation_s, 0.0])
    whole = expm(np.block([[-A, noise], [np.zeros((2, 2)), A.T]]))
    F, Q = levelling.gust_step(s)
    np.testing.assert_allclose(Q, whole[2:, 2:].T @ whole[:2, 2:], rtol=1e-9)
    np.testing.assert_allclose(F[:, 0], expm(A)[:, 0], rtol=1e-12)


@pytest.mark.ci
def test_the_best_error_is_what_the_steady_covariance_says() -> None:
    """White gusts, gyros of white noise alone: P = q/2 + sqrt(q^2/4 + q r) before, P r / (P + r) after an update."""
    s = statistics(gust_correlation_s=1e-3, gust=2.0)
    q, r = s.gyro_noise**2, (2 * s.gust**2 * 1e-3 + s.accel_noise**2) / 9.80665**2
    before = q / 2 + math.sqrt(q**2 / 4 + q * r)
    expected = math.degrees(math.sqrt(before * r / (before + r)))
    level, never = np.tile([1.0, 0, 0, 0], (3000, 1)), np.zeros(3000)
    errors = [levelling.best(s, level, never, never == 0, np.random.default_rng(k))[1000:] for k in range(6)]
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(expected, rel=0.15)


@pytest.mark.ci
def test_the_flight_turns_when_it_should(flown: dict[Case, Flown]) -> None:
    start, end = flown[PAPER_S].turn
    assert 160 <= start <= 240
    assert end - start == pytest.approx(63.0, abs=0.02)  # 60 s at 3 deg/s, and 3 s to roll in and out
    assert 0.8 * 400 < flown[SLOW].turn[1] - flown[SLOW].turn[0] < 1.2 * 403
    in_turn = (flown[PAPER_S].t > start + 1) & (flown[PAPER_S].t <= end)
    mode, corrections = flown[PAPER_S].counters[in_turn].T
    assert mode[0] > 20
    assert (mode == mode[0]).all()
    assert not corrections.any()
    first = np.abs(flown[TILTED].error[0, :2])
    assert np.hypot(*first) == pytest.approx(3.0, abs=0.3)


@pytest.mark.ci
def test_what_holds_in_any_draw(flown: dict[Case, Flown]) -> None:
    assert flown[PAPER_S].largest < 2
    assert flown[NORM].largest < 2
    assert flown[MODELLED].largest < 1
    assert flown[GYROS].largest > 2
    assert flown[LITERAL].largest > flown[NORM].largest
    assert flown[SLOW].largest > 2 > 1 > flown[SLOW_COMPENSATED].largest
    assert flown[TILTED_PAPER_S].accepted(0.0, 60.0) < 10 < flown[TILTED].accepted(0.0, 60.0)


@pytest.mark.ci
def test_claims_can_fail_and_figures_are_drawn(run: Run, tmp_path: Path) -> None:
    flown, best = run
    swapped = dict.fromkeys((PAPER_S, NORM, MODELLED), flown[GYROS]) | {GYROS: flown[MODELLED]}
    right = {claim.quantity: claim.verdict for claim in jiang2021.conclude([run] * 100)}
    wrong = {claim.quantity: claim.verdict for claim in jiang2021.conclude([(flown | swapped, best)] * 100)}
    assert sum(verdict is Verdict.MISSED for verdict in wrong.values()) >= 8
    for quantity in (f"the paper's filter: {jiang2021.MAX}", f"plain inertial: {jiang2021.MAX}"):
        assert (right[quantity], wrong[quantity]) == (Verdict.MET, Verdict.MISSED)
    jiang2021.draw([run], tmp_path)
    for name in jiang2021.PAPER.figures:
        assert (tmp_path / name).stat().st_size > 20_000


@pytest.mark.slow
def test_the_modelled_filter_takes_half_of_the_room() -> None:
    """Medians of the largest error and of the RMS, over draws that were not looked at."""
    runs = [jiang2021.fly(seed) for seed in range(7001, 7041)]
    claims = {claim.quantity: claim for claim in jiang2021.conclude(runs)}
    room = [claim.interval.value for quantity, claim in claims.items() if "share of the room" in quantity]
    assert len(room) == 2
    assert min(room) > 0.5
