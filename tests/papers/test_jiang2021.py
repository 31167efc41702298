"""The U flight of Jiang et al. 2021: what is measured, what is concluded, and that each claim can fail."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from testbed import papers
from testbed.papers import jiang2021
from testbed.papers.jiang2021 import AHRS, CALIBRATED, CASES, FLIGHTS, GYROS, SLOW, TILTED, TILTED_GYROS, Case, Flown


@pytest.fixture(scope="module")
def flown() -> dict[Case, Flown]:
    return jiang2021.fly(1)


def made(error: np.ndarray, levelled: tuple[float, ...] = ()) -> Flown:
    """A run of these errors (N, 3) [deg], one a second."""
    t = np.arange(1.0, len(error) + 1.0)
    q_nb = Rotation.from_euler("xyz", error, degrees=True).as_quat(scalar_first=True)
    return Flown(t, q_nb, error, np.zeros(len(t)), np.array(levelled), (100.0, 120.0))


@pytest.mark.parametrize("flight", FLIGHTS)
def test_scenarios_say_what_they_show_and_promise(flight: str) -> None:
    loaded = papers.scenario(flight)
    assert loaded.text.startswith("# What this shows")
    assert loaded.expect
    assert {case.estimator for case in CASES if case.flight == flight} <= set(jiang2021.estimators(loaded, 1))


def test_what_is_measured() -> None:
    error = np.zeros((200, 3))
    error[9, 0], error[69, 1], error[99, 0], error[199, 2] = 3.0, -0.7, 0.6, 5.0
    error[:5, 1] = 0.6
    one = made(error, (100.0, 100.5, 101.0, 120.0, 121.0))
    assert one.largest == 0.7
    assert one.rms == pytest.approx(0.7 / math.sqrt(141))
    assert one.recovered_s == 6.0
    assert made(error + 1.0).recovered_s == math.inf
    assert one.accepted(100.0, 120.0) == 3


def test_correction_is_what_levelling_alone_turned() -> None:
    error = np.zeros((5, 3))
    error[2:, 0], error[4:, 0] = 0.15, 0.05
    assert jiang2021.largest_correction(made(error), made(np.zeros((5, 3)))) == pytest.approx(0.15)


@pytest.mark.ci
def test_the_flight_turns_when_it_should(flown: dict[Case, Flown]) -> None:
    start, end = flown[AHRS].turn
    assert start == pytest.approx(200.0, abs=0.01)
    assert end == pytest.approx(263.0, abs=0.01)  # 60 s at 3 deg/s, and 3 s to roll in and out
    assert flown[SLOW].turn[1] - flown[SLOW].turn[0] == pytest.approx(403.0, abs=0.02)
    assert not flown[AHRS].mode[(flown[AHRS].t > start + 1) & (flown[AHRS].t <= end)].any()
    assert flown[AHRS].mode.max() > 20
    first = np.abs(flown[TILTED].error[0, :2])
    assert np.hypot(*first) == pytest.approx(3.0, abs=0.3)


@pytest.mark.ci
def test_one_seed_keeps_every_claim_and_draws(flown: dict[Case, Flown], tmp_path: Path) -> None:
    claims = jiang2021.conclude([flown])
    assert {claim.quantity: claim.verdict for claim in claims if claim.verdict == "missed"} == {}
    assert sum(claim.verdict == "impossible" for claim in claims) == 3
    jiang2021.draw([flown], tmp_path)
    for name in ("jiang2021", "jiang2021_limits"):
        assert (tmp_path / f"{name}.png").stat().st_size > 20_000


@pytest.mark.ci
def test_claims_can_fail(flown: dict[Case, Flown]) -> None:
    def missed(**swapped: Case) -> int:
        names = {"ahrs": AHRS, "gyros": GYROS, "calibrated": CALIBRATED, "tilted": TILTED, "slow": SLOW}
        results = flown | {names[name]: flown[other] for name, other in swapped.items()}
        return sum(claim.verdict == "missed" for claim in jiang2021.conclude([results]))

    assert missed(ahrs=GYROS) >= 2
    assert missed(calibrated=GYROS) == 2
    assert missed(gyros=AHRS) == 1
    assert missed(tilted=TILTED_GYROS) >= 2
    assert missed(slow=AHRS) == 1


@pytest.mark.slow
def test_every_claim_over_all_seeds(tmp_path: Path) -> None:
    claims = papers.reproduce(papers.find(["jiang2021"]), tmp_path)["jiang2021"]
    assert {claim.quantity: claim.value for claim in claims if claim.verdict == "missed"} == {}
    assert all(len(claim.ours) == 20 for claim in claims)
