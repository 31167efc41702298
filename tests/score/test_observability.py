"""Which states can be seen, of runs whose answer is known, and how the report shows it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from nav.observability import Visibility
from nav.samples import Array
from testbed import Scenario, run
from testbed.papers import scenario
from testbed.report import page as report
from testbed.report import tables
from testbed.report.figures import observability as figures
from testbed.report.figures.imu import imu_error
from testbed.report.run import Run
from testbed.score import accuracy, metrics
from testbed.score import observability as visibility
from testbed.score.accuracy import column

STRAIGHT = [
    "duration_s=60",
    "truth.start.speed_mps=3",
    'truth.segments=[{ leg = "straight", duration_s = 1e4 }]',
]
HEALTHY = ["sensors.precise.denied=[]", "sensors.plain.denied=[]"]
KNOWN = "handover={level_deg=0.02,heading_deg=0.2,velocity_mps=0.1,position_m=10}"
GONE = "{{name='gone',sensor='{}',kind='dropout',window=[0,1e4]}}"


def selected(estimators: list[str], overrides: Sequence[str] = ()) -> Scenario:
    """The drive of Cheng et al. 2020 with these of its estimators."""
    whole = scenario("cheng2020", overrides)
    return whole.model_copy(update={"estimator": tuple(one for one in whole.estimator if one.name in estimators)})


def seen(run_of: Scenario) -> dict[str, Visibility]:
    """Visibility of a run, of each estimator."""
    return visibility.of_run(run(run_of).dataset)


def states(found: Visibility, *names: str) -> list[int]:
    """Where states are, by their full names."""
    return [found.names.index(name) for name in names]


def share(found: Visibility, *names: str) -> Array:
    """The share of states that is seen in the end."""
    last: Array = found.share[-1, states(found, *names)]
    return last


def overridden(estimator: str, faults: Sequence[str] = ()) -> list[str]:
    """Overrides for this estimator, no bounds, and no faults but these."""
    return [f"estimator=[{estimator}]", f"fault=[{','.join(faults)}]", "expect={}"]


@pytest.mark.ci
def test_course_shows_the_heading_of_a_straight_and_a_turn_the_accelerometers(tmp_path: Path) -> None:
    straight = run(selected(["improved", "no_course"], STRAIGHT)).dataset
    found = visibility.of_run(straight)
    assert list(found) == ["improved", "no_course"]
    heading = found["improved"].names.index("phi down")
    assert found["improved"].seen_from()[heading] < 10
    assert np.isinf(found["no_course"].seen_from()[heading])
    level = [found["improved"].names.index(f"accel_bias {axis}") for axis in "xy"]
    assert np.isinf(found["improved"].seen_from()[level]).all()

    page = report.write_report(straight, metrics.compute(straight), tmp_path).read_text(encoding="utf-8")
    assert "<tr><td>in steps of</td><td>5 s</td><td>5 s</td></tr>" in page
    assert "<tr><td>phi down</td><td>from 5 s</td><td>never (0.00)</td></tr>" in page
    assert (tmp_path / "visibility.png").stat().st_size > 5000

    turned = seen(selected(["improved"], ["duration_s=360"]))["improved"]
    assert (np.abs(turned.seen_from()[level] - 330) < 12).all()


RIVER = [*overridden('{name="ins",aids=["dvl","ast","barometer"],' + KNOWN + "}"), "duration_s=100"]


@pytest.mark.ci
@pytest.mark.parametrize(
    "silent",
    [
        "fault=[" + GONE.format("ast") + "]",
        "sensors.ast.denied=[[0,100]]",
        "sensors.ast.transponder={lat_deg=31.5,lon_deg=114.3,range_m=1000}",
    ],
)
def test_a_transponder_that_is_never_heard_shows_no_position(silent: str) -> None:
    heard, unheard = (seen(scenario("zhu2020", [*RIVER, *more]))["ins"] for more in ([], [silent]))
    place = states(heard, "dp north", "dp east")
    assert (heard.seen_from()[place] <= 15).all()
    assert np.isinf(unheard.seen_from()[place]).all()
    assert (unheard.share[-1, place] < 1e-6).all()
    assert (share(unheard, "dv north", "dv east", "dv down") > 0.9).all()  # by the log


@pytest.mark.ci
def test_a_star_tracker_shows_the_heading_at_once_and_only_while_it_is_believed() -> None:
    wrong = "{name='wrong',sensor='star_tracker',channel='down',kind='step',size=600,window=[30,50]}"
    whole = scenario("cui2022", ["duration_s=80", f"fault=[{wrong}]", "expect={}"])
    names = ["with_star", "without_star"]
    chosen = tuple(one for one in whole.estimator if one.name in names)
    found = seen(whole.model_copy(update={"estimator": chosen}))
    assert list(found) == names
    with_star = found["with_star"]
    heading, *level = states(with_star, "phi down", "phi north", "phi east")  # of a body that is level
    assert with_star.seen_from()[heading] == pytest.approx(5, abs=0.1)
    assert np.isinf(found["without_star"].seen_from()[heading])
    believed = (with_star.t[1:] <= 30) | (with_star.t[:-1] >= 60)
    isolated = (with_star.t[:-1] >= 30) & (with_star.t[1:] <= 50)
    assert (with_star.alone[believed, heading] > 0.99).all()
    assert (with_star.alone[isolated, heading] < 0.01).all()
    assert (with_star.alone[:, level] > 0.99).all()
    assert (with_star.share[:, heading] > 0.99).all()  # what was seen before counts


def test_a_look_that_was_not_used_shows_nothing() -> None:
    dataset = run(selected(["improved"], STRAIGHT)).dataset
    before = visibility.of_run(dataset)["improved"]
    place = states(before, "dp north", "dp east", "dp down")
    for part in accuracy.aids(dataset, "improved"):
        own = f"estimators/improved/innovations/{part}"
        column(dataset, f"{own}/weight")[column(dataset, f"{own}/sample_time") > 30] = 0.0
    after = visibility.of_run(dataset)["improved"]
    early = before.t[1:] <= 30
    np.testing.assert_array_equal(after.alone[early], before.alone[early])
    assert (before.alone[~early][:, place] > 0.1).all()
    assert not after.alone[~early].any()
    np.testing.assert_array_equal(after.share[~early], np.tile(after.share[early][-1], (np.sum(~early), 1)))


SECOND_LOG = 'sensors.second={kind="body_velocity",grade="dvl",rate_hz=1}'


@pytest.mark.ci
@pytest.mark.parametrize(
    "estimator",
    [
        'name="one",aids=["dvl","second","ast","barometer"]',
        'name="one",kind="federated",locals=[{name="a",aids=["dvl","ast","barometer"]},'
        '{name="b",aids=["second","barometer"]}]',
    ],
)
def test_sensors_with_the_same_looks_are_told_apart(estimator: str) -> None:
    both = [*RIVER[1:], SECOND_LOG, f"estimator=[{{{estimator},{KNOWN}}}]"]
    heard, lost = (
        seen(scenario("zhu2020", [*both, f"fault=[{fault}]"]))["one"] for fault in ("", GONE.format("second"))
    )
    alone = seen(scenario("zhu2020", RIVER))["ins"]
    scales = share(heard, "dvl_scale 1", "second_scale 1")
    assert scales[0] == pytest.approx(scales[1])  # nothing tells one from the other
    assert scales[0] > 0.9
    assert share(lost, "second_scale 1") == pytest.approx(0, abs=1e-9)
    common = [name for name in alone.names if name in lost.names]
    assert len(common) == len(alone.names)
    np.testing.assert_allclose(share(lost, *common), share(alone, *common), atol=0.02)


def test_one_filter_of_all_aids_stands_for_a_federation() -> None:
    locals_ = "[{name='a',aids=['dvl','barometer']},{name='b',aids=['ast','barometer']}]"
    both = [*RIVER[1:], f"estimator=[{{name='federated',kind='federated',locals={locals_},{KNOWN}}}]"]
    federated, ins = seen(scenario("zhu2020", both))["federated"], seen(scenario("zhu2020", RIVER))["ins"]
    assert sorted(federated.names) == sorted(ins.names)
    assert federated.rank[-1] == ins.rank[-1]
    np.testing.assert_allclose(share(federated, *ins.names), share(ins, *ins.names), atol=0.02)


def test_an_ahrs_never_sees_its_heading_without_a_magnetometer() -> None:
    estimators = (
        '{name="plain",kind="ahrs",aids=["airspeed"],heading_deg=30},{name="magnetic",kind="ahrs",aids=["airspeed","magnetometer"]},'
        '{name="gyros",kind="ahrs",aids=[],heading_deg=30,levelling=false},'
        '{name="any",kind="ahrs",aids=["airspeed","magnetometer"],profile="any_motion"}'
    )
    found = seen(Scenario.load("kinematic_u_flight", [*overridden(estimators), "duration_s=60"]))
    assert list(found) == ["plain", "magnetic", "gyros", "any"]
    assert found["any"].names[-4:] == [
        f"{of} {axis}" for of in ("velocity", "turning velocity") for axis in ("north", "east")
    ]
    for name in ("plain", "magnetic", "any"):
        assert found[name].names[:3] == ["phi north", "phi east", "phi down"]
        assert (found[name].seen_from()[:2] < 8).all()  # 2 s of alignment, and a segment
    assert np.isinf(found["plain"].seen_from()[2])
    assert found["plain"].share[-1, 2] < 1e-3
    assert np.isfinite(found["magnetic"].seen_from()[2])
    assert found["gyros"].rank[-1] == 0
    assert not found["gyros"].share.any()


def test_a_record_without_its_scenario_has_none() -> None:
    dataset = run(selected(["improved"], ["duration_s=5"])).dataset
    dataset.attrs["scenario"] = "title = 3"
    assert visibility.of_run(dataset) == {}
    assert tables.seen({}) == []


@pytest.mark.ci
def test_a_receiver_may_have_any_name() -> None:
    flown = run(Scenario.load("regression", ["duration_s=30", "fault=[]", *HEALTHY, "expect={}"])).dataset
    found = visibility.of_run(flown)
    assert list(found) == ["ins", "federated", "ahrs"]
    for name in ("ins", "federated"):
        assert np.isfinite(found[name].seen_from()[found[name].names.index("dv down")])


@pytest.mark.ci
def test_of_a_recorded_flight_it_is_by_what_its_imu_felt() -> None:
    """Nobody knows the force of a recorded flight: without any, neither tilt nor wind would ever be seen."""
    flown = run(Scenario.load("recorded_flight", {"expect": {}})).dataset
    assert not np.nan_to_num(flown["truth/dv"].values).any()
    found = visibility.of_run(flown)
    assert (share(found["ins"], "phi north", "phi east", "wind 1", "airspeed_scale") > 0.9).all()
    assert (share(found["ahrs"], "phi north", "phi east") > 0.9).all()
    unheard = run(Scenario.load("recorded_flight", {"expect": {}, "record.imu": False})).dataset
    assert visibility.of_run(unheard) == {}
    assert imu_error(Run(flown), "ins") is None


def test_increments_that_no_filter_takes_are_not_felt() -> None:
    broken = ["fault=[{sensor='imu', kind='garbage', channel='accel', window=[40, 42]}]", "expect={}"]
    flown = run(Scenario.load("recorded_flight", broken)).dataset
    found = visibility.of_run(flown)
    assert np.isfinite(found["ins"].seen_from()).any()
    assert (share(found["ins"], "phi north", "phi east") > 0.9).all()


def test_the_figure_is_pale_where_only_the_past_helps() -> None:
    dataset = run(Scenario.load("static_bench", ["duration_s=12", "expect={}"])).dataset
    drawn = Run(dataset)
    t = np.array([2.0, 7.0, 12.0])
    share, alone = np.array([[1.0, 0.0], [1.0, 0.5]]), np.array([[1.0, 0.0], [0.0, 0.5]])
    name = accuracy.names(dataset)[0]
    own = Visibility(["phi north", "wind 1"], t, np.array([1, 2]), share, share, alone)
    drawn.seen = {name: own}
    figure = figures.visibility(drawn)
    assert figure is not None
    (image,) = figure.axes[0].images
    cells = np.asarray(image.get_array())
    np.testing.assert_allclose(cells[..., :3], np.broadcast_to(to_rgb(drawn.colours[name]), (2, 2, 3)))
    np.testing.assert_allclose(cells[..., 3], [[1.0, figures.PALE], [0.0, 0.5]])
    assert image.get_extent()[:2] == [2.0, 12.0]
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == own.names
    drawn.seen = {}
    assert figures.visibility(drawn) is None
