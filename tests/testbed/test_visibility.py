"""Which states can be seen, of runs whose answer is known, and the table in the report."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from testbed import Scenario, metrics, run, visibility
from testbed.papers import cheng2020
from testbed.report import write_report

STRAIGHT = [
    "duration_s=60",
    "truth.start.speed_mps=3",
    'truth.segments=[{ leg = "straight", duration_s = 1e4 }]',
]


HEALTHY = ["sensors.precise.denied=[]", "sensors.plain.denied=[]"]


def test_course_shows_the_heading_of_a_straight_and_a_turn_the_accelerometers(tmp_path: Path) -> None:
    straight = run(cheng2020.selected(["improved", "no_course"], STRAIGHT)).dataset
    found = visibility.of_run(straight)
    assert list(found) == ["improved", "no_course"]
    heading = found["improved"].names.index("phi down")
    assert found["improved"].seen_from()[heading] < 10
    assert np.isinf(found["no_course"].seen_from()[heading])
    level = [found["improved"].names.index(f"accel_bias {axis}") for axis in "xy"]
    assert np.isinf(found["improved"].seen_from()[level]).all()

    rows = visibility.table(found)
    page = write_report(straight, metrics.compute(straight), tmp_path, rows).read_text(encoding="utf-8")
    assert "<tr><td>phi down</td><td>from 5 s</td><td>never (0.00)</td></tr>" in page

    turned = visibility.of_run(run(cheng2020.selected(["improved"], ["duration_s=360"])).dataset)["improved"]
    assert (np.abs(turned.seen_from()[level] - 330) < 12).all()


def test_a_record_without_its_scenario_has_none() -> None:
    dataset = run(cheng2020.selected(["improved"], ["duration_s=5"])).dataset
    dataset.attrs["scenario"] = "title = 3"
    assert visibility.of_run(dataset) == {}
    assert visibility.table({}) == [["state"], ["rank"]]


def test_a_receiver_may_have_any_name() -> None:
    flown = run(Scenario.load("regression", ["duration_s=30", "fault=[]", *HEALTHY, "expect={}"])).dataset
    found = visibility.of_run(flown)
    assert list(found) == ["ins"]
    assert np.isfinite(found["ins"].seen_from()[found["ins"].names.index("dv down")])
