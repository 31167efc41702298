"""ArduPilot's own estimate is recorded and scored beside ours."""

from __future__ import annotations

import math

import numpy as np
import pytest
from worlds import autopilots
from worlds.loop import same

from testbed import RunResult, Scenario, run
from testbed.bridges.ardupilot import ArduPilot
from testbed.errors import UserError
from testbed.score import accuracy, bound, metrics

DURATION_S, PLACED_S = 12.0, 3.0
DENIED_S = [8.0, 10.0]


def scenario(*, theirs: bool = True) -> Scenario:
    ours = [{"name": "ins", "aids": ["gnss", "barometer", "magnetometer", "airspeed"]}]
    other = [{"name": "theirs", "kind": "ardupilot"}] if theirs else []
    changes = {"duration_s": DURATION_S, "sensors.gnss.denied": [DENIED_S], "estimator": ours + other, "expect": {}}
    return Scenario.load("kinematic_u_flight", changes)


@pytest.fixture(scope="module")
def alone() -> RunResult:
    return run(scenario(theirs=False))


@pytest.fixture(scope="module")
def heard(alone: RunResult) -> tuple[RunResult, autopilots.Answering]:
    first, t = alone.dataset["sensors/imu/time"].values[0], alone.dataset["truth/time"].values
    home = [float(np.interp(first, t, alone.dataset[f"truth/{name}"].values)) for name in ("lat", "lon", "h")]
    voice = autopilots.Answering(*home, PLACED_S)
    peer = autopilots.ArduPilot(voice=voice)
    far_end = ArduPilot(peer.url, estimators={"theirs": voice.url})
    try:
        return run(scenario(), far_end=far_end), voice
    finally:
        peer.over.set()
        peer.join()
        far_end.close()
        voice.close()


@pytest.mark.ci
def test_it_is_asked_heard_and_scored_at_its_own_stamps(heard: tuple[RunResult, autopilots.Answering]) -> None:
    result, voice = heard
    assert result.failure == ""
    assert voice.asked == dict.fromkeys((30 + 1, 33, 32), 50_000.0)  # 20 Hz: attitude, global and local position
    errors = accuracy.errors(result.dataset, "theirs")
    known = np.isfinite(errors.position[:, 0])
    assert known[(errors.t > PLACED_S + 0.1) & (errors.t < DURATION_S - 0.1)].all()
    assert not known[errors.t < PLACED_S - 0.1].any()
    np.testing.assert_allclose(
        errors.position[known, :2], [[autopilots.Answering.NORTH_M, 0.0]] * known.sum(), atol=0.1
    )
    np.testing.assert_allclose(errors.velocity[known], 0.0, atol=0.02)
    np.testing.assert_allclose(errors.attitude[known], 0.0, atol=math.radians(0.05))
    assert "theirs.position_nees_mean" not in result.metrics  # it says nothing of how sure it is
    assert "theirs" not in bound.of_run(result.dataset)  # it has sensors of its own


@pytest.mark.ci
def test_one_that_does_not_fly_is_armed_once_it_knows_where_it_is(
    heard: tuple[RunResult, autopilots.Answering],
) -> None:
    _, voice = heard
    assert voice.armed is not None
    assert PLACED_S <= voice.armed < PLACED_S + 2.5


@pytest.mark.ci
def test_ours_have_the_same_bits_beside_it(heard: tuple[RunResult, autopilots.Answering], alone: RunResult) -> None:
    for group in ("truth", "sensors", "estimators/ins"):
        assert same(heard[0].dataset[group], alone.dataset[group])


@pytest.mark.ci
def test_whom_nothing_is_denied_has_no_outage(heard: tuple[RunResult, autopilots.Answering]) -> None:
    found = metrics.compute(heard[0].dataset, settling_s=1.0)
    assert found["ins.outage_position_horizontal_max_m"] > 0.0
    assert found["theirs.position_horizontal_rms_m"] >= 0.0
    assert not [name for name in found if name.startswith("theirs.outage") or name.startswith("theirs.recovery")]


@pytest.mark.ci
def test_one_that_flies_is_armed_by_whom_it_likes() -> None:
    voice = autopilots.Answering(0.5, 1.5, 100.0)
    peer = autopilots.ArduPilot(voice=voice)
    far_end = ArduPilot(peer.url, estimators={"theirs": voice.url}, flies=True)
    theirs = [{"name": "theirs", "kind": "ardupilot"}]
    flown = {"duration_s": 5.0, "sensors.gnss.denied": [], "expect": {}, "estimator": theirs}
    try:
        run(Scenario.load("loiter_gnss_outage", flown), far_end=far_end)
    finally:
        peer.over.set()
        peer.join()
        far_end.close()
        voice.close()
    assert voice.asked
    assert voice.armed is None


def test_an_address_that_is_taken_leaves_nothing_open() -> None:
    voice = autopilots.Answering(0.5, 1.5, 100.0)
    with pytest.raises(UserError, match="in use"):
        ArduPilot("udpin:127.0.0.1:0", estimators={"one": voice.url, "two": voice.url}, connect_s=0.1)
    voice.close()


def test_two_at_one_address_are_told_of() -> None:
    twice = [{"name": name, "kind": "ardupilot"} for name in ("a", "b")]
    with pytest.raises(UserError, match=r"estimator\[1\].address: 'a' is heard there: give it another"):
        Scenario.load("kinematic_u_flight", {"estimator": twice, "expect": {}})


def test_without_ardupilot_it_is_said_where_it_is() -> None:
    with pytest.raises(UserError, match=r"theirs: is ArduPilot's own, which is there while .* add --ardupilot"):
        run(scenario())


def test_nothing_here_flies_on_it() -> None:
    with pytest.raises(UserError, match=r"'a' is ArduPilot's own, .* let ArduPilot fly by --ardupilot --pilot"):
        Scenario.load(
            "loiter_gnss_outage",
            {"estimator": [{"name": "a", "kind": "ardupilot"}], "autopilot.feedback": "a", "expect": {}},
        )
