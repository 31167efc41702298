"""PX4's own estimate is recorded and scored beside ours, whatever the ways in which it arrives."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import autopilots
from worlds.loop import same

from testbed import RunResult, Scenario, run
from testbed.bridges.px4 import Px4
from testbed.errors import UserError
from testbed.score import metrics

DURATION_S = 12.0


def scenario(*, px4: bool = True) -> Scenario:
    ours = [{"name": "ins", "aids": ["gnss", "barometer", "magnetometer", "airspeed"]}]
    theirs = [{"name": "theirs", "kind": "px4"}] if px4 else []
    changes = {"duration_s": DURATION_S, "sensors.gnss.denied": [], "estimator": ours + theirs, "expect": {}}
    return Scenario.load("kinematic_u_flight", changes)


def heard(odd: bool) -> RunResult:
    voice = autopilots.Voice(odd)
    peer = autopilots.Px4(voice=voice)
    return run(scenario(), far_end=Px4(peer.url, estimators={"theirs": voice.url}))


@pytest.fixture(scope="module")
def sound() -> RunResult:
    return heard(odd=False)


def errors_of(result: RunResult) -> tuple[np.ndarray, np.ndarray]:
    """Errors north and east [m] of those rows that have an estimate, and the rows."""
    own, truth = result.dataset["estimators/theirs"], result.dataset["truth"]
    np.testing.assert_array_equal(own["time"], truth["time"])
    lat, lon = own["lat"].values - truth["lat"].values, own["lon"].values - truth["lon"].values
    north, east = lat * 6.36e6, lon * 6.38e6 * np.cos(truth["lat"].values)
    rows = np.flatnonzero(np.isfinite(north))
    return np.column_stack([north, east])[rows], rows


@pytest.mark.ci
def test_it_is_scored_as_one_more_estimator(sound: RunResult) -> None:
    assert sound.failure == ""
    found, rows = errors_of(sound)
    assert len(rows) >= len(sound.dataset["truth/time"]) - 2  # it has said nothing before the first and after the last
    np.testing.assert_allclose(found, [[autopilots.Voice.NORTH_M, 0.0]] * len(found), atol=0.1)
    own, truth = sound.dataset["estimators/theirs"], sound.dataset["truth"]
    np.testing.assert_allclose(own["v_n"].values[rows], truth["v_n"].values[rows], atol=0.02)
    alignment = np.abs((own["q_nb"].values * truth["q_nb"].values).sum(axis=1))[rows]
    assert (alignment > 1 - 1e-6).all()
    scores = metrics.compute(sound.dataset, settling_s=2.0)
    assert scores["theirs.position_nees_mean"] == pytest.approx(0.75, abs=0.05)  # (3 / 2)^2 / 3
    assert scores["theirs.position_north_mean_m"] == pytest.approx(autopilots.Voice.NORTH_M, abs=0.1)


@pytest.mark.ci
def test_ours_have_the_same_bits_beside_it(sound: RunResult) -> None:
    alone = run(scenario(px4=False))
    for group in ("truth", "sensors", "estimators/ins"):
        assert same(sound.dataset[group], alone.dataset[group])


@pytest.mark.ci
def test_late_lacking_and_senseless_messages_do_no_harm() -> None:
    result = heard(odd=True)
    found, rows = errors_of(result)
    np.testing.assert_allclose(found, [[autopilots.Voice.NORTH_M, 0.0]] * len(found), atol=0.1)
    t = result.dataset["truth/time"].values
    without = np.setdiff1d(t, t[rows])
    assert ((without < 0.1) | (without > DURATION_S - 0.2) | ((without > 3.9) & (without < 6.1))).all()
    assert len(without) > 15


@pytest.mark.ci
def test_it_is_armed_once_it_has_said_where_it_is() -> None:
    voice = autopilots.Voice(placed_s=4.0)
    peer = autopilots.Px4(voice=voice)
    far_end = Px4(peer.url, estimators={"theirs": voice.url})
    result = run(scenario(), far_end=far_end)
    assert result.failure == ""
    assert voice.armed is not None
    assert 4.0e6 <= voice.armed < 5.5e6
    assert far_end.armed


@pytest.mark.ci
def test_one_that_has_terminated_its_flight_is_told_of() -> None:
    voice = autopilots.Voice()
    peer = autopilots.Px4("stall", at=1000, voice=voice)
    try:
        result = run(scenario(), far_end=Px4(peer.url, estimators={"theirs": voice.url}, answer_s=3.0))
    finally:
        peer.over.set()
    assert result.failure.endswith("for 3 s: has it terminated its flight?")


def test_one_that_flies_is_armed_by_whom_it_likes() -> None:
    voice = autopilots.Voice()
    peer = autopilots.Px4(voice=voice)
    far_end = Px4(peer.url, estimators={"theirs": voice.url}, flies=True)
    flown = {"duration_s": 2.0, "sensors.gnss.denied": [], "expect": {}}
    run(
        Scenario.load("loiter_gnss_outage", flown | {"estimator": [{"name": "theirs", "kind": "px4"}]}), far_end=far_end
    )
    assert voice.armed is None
    assert not far_end.armed


def test_without_px4_it_is_said_where_it_is() -> None:
    with pytest.raises(UserError, match="theirs: is PX4's own, which is there while PX4 follows the run: add --px4"):
        run(scenario())


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"imu": "second"}, "PX4 is sent the samples of the first IMU, 'imu'"),
        ({"spare_imus": ["second"]}, "PX4 is sent the samples of one IMU"),
    ],
)
def test_what_can_not_be_is_said(changes: dict[str, object], says: str) -> None:
    with pytest.raises(UserError, match=says):
        Scenario.load(
            "kinematic_u_flight",
            {"sensors.second": {"kind": "imu"}, "estimator": [{"name": "p", "kind": "px4", **changes}], "expect": {}},
        )


def test_an_address_that_is_none_is_told() -> None:
    with pytest.raises(UserError, match="is no address: give it as udpin:HOST:PORT"):
        Px4("tcpin:127.0.0.1:0", estimators={"p": "tcpin:127.0.0.1:14540"}, connect_s=0.1)


def test_nothing_here_flies_on_it() -> None:
    with pytest.raises(UserError, match="'p' is PX4's own, heard too late to fly on here"):
        Scenario.load(
            "loiter_gnss_outage", {"estimator": [{"name": "p", "kind": "px4"}], "autopilot.feedback": "p", "expect": {}}
        )
