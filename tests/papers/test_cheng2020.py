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
    assert set(filters) == {"improved", "ungated", "no_course", "told"}
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
def drawn() -> cheng2020.Draw:
    """What a job gives."""
    return cheng2020.drive(2, True)


@pytest.fixture(scope="module")
def table() -> dict[str, Any]:
    return cheng2020.table_1()


@pytest.mark.ci
def test_a_turn_disturbs_only_who_takes_course_for_heading_in_it(drawn: cheng2020.Draw) -> None:
    improved, ungated = drawn.drives["improved"], drawn.drives["ungated"]
    assert len(drawn.series["turns"]) >= 2
    assert improved.turn < 0.3
    assert ungated.turn > 2 * improved.turn
    assert improved.straight < 0.15
    assert improved.amiss == 0
    assert drawn.drives["told"].position_rms == pytest.approx(improved.position_rms, rel=0.5)


@pytest.mark.ci
def test_table_1_has_a_row_for_each_column(drawn: cheng2020.Draw, table: dict[str, Any]) -> None:
    rows = [one for one in cheng2020.claims([drawn, table]) if one.quantity.startswith("Table 1")]
    for column in ("velocity", "position", "velocity and position"):
        own = [one for one in rows if one.quantity.startswith(f"Table 1, {column}:")]
        assert {one.verdict for one in own} == {"met", "impossible"}
        assert all("0.000506" in one.why for one in own if "eps_U" in one.quantity)
    (other,) = (one for one in rows if one.misprint)
    assert other.verdict == "misprint"
    assert other.interval.value == pytest.approx(10.7, abs=0.5)


def verdicts(drawn: cheng2020.Draw, table: dict[str, Any]) -> dict[str, str]:
    """Judged over a hundred times the same, so that every interval is as narrow as it can be."""
    return {claim.quantity: claim.verdict for claim in cheng2020.claims([*[drawn] * 100, table])}


@pytest.mark.ci
def test_claims_can_fail(drawn: cheng2020.Draw, table: dict[str, Any]) -> None:
    sound = verdicts(drawn, table)
    worse = drawn.drives["improved"]._replace(
        straight=0.2, turn=0.4, level=0.5, velocity=0.3, position=9.0, position_rms=9.0, heading_rms=1.0, amiss=1
    )
    still = drawn.drives["ungated"]._replace(turn=0.1)
    learned = dict.fromkeys(drawn.learned, 0.5)
    bad = drawn._replace(drives=drawn.drives | {"improved": worse, "ungated": still}, learned=learned, drift=(0.1, 1.2))
    failed = verdicts(bad, table)
    turned = {quantity for quantity in sound if failed[quantity] == "missed" != sound[quantity]}
    assert {quantity.partition(",")[0] for quantity in turned} >= {
        "heading on straights", "position", "courses used in a turn or below 1 m/s",
        "heading after 300 s of straight",
        "R as it is: RMS of position", "R as it is: RMS of heading", "position variance x 4: learned within",
    }  # fmt: skip
    wrong = copy.deepcopy(table)
    for column in ("velocity", "position", "both"):
        wrong[column] |= {"phi": [9.88, 9.88], "unseen": 1e-3}
    failed = verdicts(drawn, wrong)
    assert sum(failed[quantity] == "missed" != sound[quantity] for quantity in failed) == 7


@pytest.mark.ci
def test_the_figure_is_drawn(drawn: cheng2020.Draw, tmp_path: Path) -> None:
    cheng2020.PAPER.draw([drawn], tmp_path)
    assert (tmp_path / "cheng2020.png").stat().st_size > 10_000
