"""Cheng et al. 2020: the scenario, what a run of it is reduced to, and claims that can fail."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
from worlds.lanes import lanes

from nav.aids import Course, GnssAid
from nav.ins import Ins
from testbed import papers
from testbed.papers import cheng2020


def test_the_scenario_tells_the_filters_what_it_says() -> None:
    built = lanes(papers.scenario("cheng2020"), 0)
    filters = {name: one.horizon.estimator for name, one in built.items()}
    assert set(filters) == set(cheng2020.ALL)
    for name, ins in filters.items():
        assert isinstance(ins, Ins)
        assert ins.config.scaling is not None
        assert (course_of(ins) is None) == (name == "no_course")
        assert ins.model.size == 15
    improved = filters["improved"]
    assert isinstance(improved, Ins)
    course = course_of(improved)
    assert course is not None
    assert course.max_turn_rate == pytest.approx(cheng2020.KAPPA)
    assert course.slip == 0.0


def course_of(ins: Ins) -> Course | None:
    return next(aid.course for aid in ins.config.aids if isinstance(aid, GnssAid))


@pytest.fixture(scope="module")
def first_turn() -> dict[str, Any]:
    return cheng2020.road(cheng2020.SEEDS[1], 360, ("improved", "ungated"))


@pytest.mark.ci
def test_a_turn_disturbs_only_who_takes_course_for_heading_in_it(first_turn: dict[str, Any]) -> None:
    improved, ungated = first_turn["improved"], first_turn["ungated"]
    assert len(first_turn["turns"]) == 1
    assert improved["heading_turn"] < 0.3
    assert ungated["heading_turn"] > 1.5
    assert improved["heading_straight"] < 0.1
    assert improved["level_before"] < 0.3
    assert improved["course_amiss"] == 0
    assert ungated["course_amiss"] > 0
    assert 250 < improved["course_looks"] < 300 - 20  # of 300 s under way there are 20 s of rest, and a turn
    assert improved["least_R"] > 0.25


@pytest.mark.ci
def test_more_noise_is_found() -> None:
    assert cheng2020.noisier(2)["gnss_position"] < 0.25


def test_table_1() -> None:
    table = cheng2020.table_1()
    assert table["ranks"] == [7, 9, 10, 12]
    for column in ("velocity", "position", "both"):
        found = table[column]
        assert found["phi"] == pytest.approx([9.86, 9.86], abs=0.005)
        assert found["eps"] == pytest.approx([9.806, 9.806], abs=0.005)
        assert found["dv"] == pytest.approx([1, 1], abs=1e-6)
        assert found["dp"] == pytest.approx([] if column == "velocity" else [1, 1], abs=1e-6)
        assert found["eps_down"] == pytest.approx(5.06e-4, rel=1e-2)
        assert found["unseen"] < 1e-9
    # 1 / (R_N cos L R_M), where the paper has 3.14e-14; and sqrt(5) g w_ie, 1.79e-3
    assert table["radians"] == pytest.approx([1 / (6.388838e6 * 0.7071068 * 6.367382e6), 1.599e-3], rel=1e-3)


@pytest.mark.ci
def test_table_1_has_a_row_for_each_column(first_turn: dict[str, Any]) -> None:
    claims = [one for one in cheng2020.PAPER.conclude(results(first_turn)) if one.quantity.startswith("Table 1")]
    for column in ("velocity", "position", "velocity and position"):
        own = [one for one in claims if one.quantity.startswith(f"Table 1, {column}:")]
        assert {one.verdict for one in own} == {"met", "impossible"}
        assert all(
            "5.06e-4" in one.impossible or "velocity" in one.impossible for one in own if "eps_U" in one.quantity
        )
    (other,) = (one for one in claims if "3.14e-14" in one.paper)
    assert "3.5e-14" in other.impossible
    assert "1.6e-03" in other.impossible


def results(road: dict[str, Any]) -> list[Any]:
    """As the jobs give them, with one run in the place of all."""
    n = len(cheng2020.SEEDS)
    road = {"told": road["improved"]} | road | {"no_course": road["improved"]}
    off = {"gnss_position": 0.1, "gnss_velocity": 0.1}
    return [road] * (n + 1) + [off] * n + [(1.5, 1.2)] * n + [cheng2020.table_1()]


def verdicts(found: list[Any]) -> dict[str, str]:
    return {claim.quantity: claim.verdict for claim in cheng2020.PAPER.conclude(found)}


@pytest.mark.ci
def test_claims_can_fail(first_turn: dict[str, Any]) -> None:
    sound = verdicts(results(first_turn))
    bad: dict[str, Any] = copy.deepcopy(first_turn)
    bad["told"] = first_turn["improved"]
    bad["improved"] |= {
        "heading_straight": 0.2,
        "level_nearly_all": 0.05,
        "level_rms": 0.03,
        "position_rms": 0.9,
        "course_amiss": 1,
    }
    bad["improved"] |= {"heading_turn": 0.4, "velocity": 0.03, "least_R": -0.1}
    bad["ungated"] |= {"heading_turn": 1.0}
    failed = verdicts(results(bad))
    turned = {quantity for quantity in sound if sound[quantity] != "missed" and failed[quantity] == "missed"}
    assert len(turned) >= 11, turned
    assert sum("any seed" in quantity for quantity in turned) == 3, turned
    wrong = copy.deepcopy(results(first_turn))
    for column in ("velocity", "position", "both"):
        wrong[-1][column] |= {
            "phi": [9.88, 9.88],
            "unseen": 1e-3,
            "eps_down": 9e-9 if column == "position" else 5.66e-4,
        }
    failed = verdicts(wrong)
    assert len({quantity for quantity in failed if "Table 1" in quantity and failed[quantity] == "missed"}) == 10


@pytest.mark.slow
def test_every_claim_is_kept(tmp_path: Path) -> None:
    claims = papers.reproduce({"cheng2020": cheng2020.PAPER}, tmp_path)["cheng2020"]
    assert {claim.quantity for claim in claims if claim.verdict == "missed"} == set()
    assert (tmp_path / "cheng2020.png").stat().st_size > 10_000
