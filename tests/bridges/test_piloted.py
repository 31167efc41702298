"""The far end flies: a minimal autopilot on either protocol takes over and flies circles, and our estimators watch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from worlds import autopilots
from worlds.loop import same

from testbed import RunResult, Scenario, run
from testbed.bridges.ardupilot import ArduPilot
from testbed.bridges.px4 import Px4
from testbed.errors import UserError
from testbed.feeds.played import played

TAKEN_OVER_S = 3.0
RATE_HZ = 100.0


def scenario(duration_s: float) -> Scenario:
    changes = {"duration_s": duration_s, "truth.rate_hz": RATE_HZ, "sensors.imu.rate_hz": RATE_HZ}
    one = {"name": "ins", "aids": ["gnss", "barometer", "magnetometer", "airspeed"]}
    return Scenario.load("loiter_gnss_outage", {**changes, "sensors.gnss.denied": [], "estimator": [one], "expect": {}})


def flown(protocol: str, duration_s: float, out: Path | None = None) -> RunResult:
    at = round(TAKEN_OVER_S * RATE_HZ)
    peer = (autopilots.Px4 if protocol == "px4" else autopilots.ArduPilot)(at=at, pilot=autopilots.Circle())
    try:
        far_end = (Px4 if protocol == "px4" else ArduPilot)(peer.url, flies=True)
        return run(scenario(duration_s), far_end=far_end, out=out)
    finally:
        peer.over.set()


def circles(result: RunResult) -> tuple[float, float, float]:
    """How often it went round, and by how much height and airspeed differ from those at the start, settled."""
    truth = result.dataset["truth"]
    course = np.unwrap(np.arctan2(truth["v_n"].values[:, 1], truth["v_n"].values[:, 0]))
    settled = truth["time"].values > 15.0
    height = np.abs(truth["h"].values - truth["h"].values[0])[settled].max(initial=0.0)
    speed = np.abs(truth["airspeed"].values - truth["airspeed"].values[0])[settled].max(initial=0.0)
    return float(course[-1] - course[0]) / (2 * np.pi), float(height), float(speed)


@pytest.mark.ci
@pytest.mark.parametrize("protocol", ["px4", pytest.param("ardupilot", marks=pytest.mark.slow)])
def test_a_minimal_autopilot_flies_circles(protocol: str) -> None:
    result = flown(protocol, 25.0)
    assert result.failure == ""
    turns, height, speed = circles(result)
    assert turns == pytest.approx(0.6, abs=0.3)  # a bank of 25 deg at 25 m/s is 0.18 rad/s
    assert height < 20
    assert speed < 4
    events = list(result.dataset["events/text"].values)
    assert any(text.endswith("flies from here on") for text in events)
    assert not any("never flown" in remark for remark in result.remarks)  # which legs those are, nobody here knows


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["px4", "ardupilot"])
def test_it_does_so_for_ten_minutes(protocol: str) -> None:
    result = flown(protocol, 600.0)
    assert result.failure == ""
    turns, height, speed = circles(result)
    assert turns > 12
    assert height < 20
    assert speed < 4
    assert result.metrics["ins.position_horizontal_rms_m"] < 5  # our estimators watch


def test_the_same_commands_give_the_same_bits() -> None:
    first, second = (flown("px4", 4.0).dataset for _ in range(2))
    assert same(first, second)


def test_until_it_takes_over_the_plan_is_flown() -> None:
    peer = autopilots.Px4()
    result = run(scenario(4.0), far_end=Px4(peer.url, flies=True))
    assert "the plan was flown to the end: PX4 never took over" in result.remarks
    assert same(result.dataset["truth"], run(scenario(4.0)).dataset["truth"])


def from_rest(duration_s: float) -> Scenario:
    changes = {"duration_s": duration_s, "truth.rate_hz": RATE_HZ, "sensors.imu.rate_hz": RATE_HZ, "expect": {}}
    return Scenario.load("take_off", {**changes, "truth.start.rest_s": 3})


@pytest.mark.ci
@pytest.mark.parametrize("protocol", ["px4", pytest.param("ardupilot", marks=pytest.mark.slow)])
def test_it_takes_off_once_it_is_armed(protocol: str) -> None:
    armed_s = 4.0  # later than it would have been launched by itself
    at = round(armed_s * RATE_HZ)
    peer = (autopilots.Px4 if protocol == "px4" else autopilots.ArduPilot)(at=at, pilot=autopilots.TakeOff())
    try:
        far_end = (Px4 if protocol == "px4" else ArduPilot)(peer.url, flies=True)
        result = run(from_rest(20.0), far_end=far_end)
    finally:
        peer.over.set()
    assert result.failure == ""
    truth, events = result.dataset["truth"], list(result.dataset["events/text"].values)
    t, moving = truth["time"].values, np.linalg.norm(truth["v_n"].values, axis=1) > 1e-6
    assert armed_s + 1.5 < t[moving][0] < armed_s + 3.0
    assert events.index("launch") > next(k for k, text in enumerate(events) if text.endswith("flies from here on"))
    assert truth["h"].values[-1] > 310
    assert result.metrics["flight.stall_margin_min_mps"] > 0
    assert same(run(from_rest(20.0), far_end=played(result.dataset)).dataset, result.dataset)


def test_until_it_is_armed_it_stays_on_the_ground() -> None:
    peer = autopilots.Px4()
    result = run(from_rest(6.0), far_end=Px4(peer.url, flies=True))
    assert "the aircraft was on the ground to the end: PX4 was never armed with its throttle up" in result.remarks
    assert np.abs(result.dataset["truth/v_n"].values).max() < 1e-9
    assert not any(key.startswith("flight.") for key in result.metrics)
    assert any("never flown: the run ended before the first" in remark for remark in result.remarks)


def test_what_does_not_fly_a_plan_can_not_be_flown() -> None:
    peer = autopilots.Px4()
    kinematic = Scenario.load("kinematic_u_flight", {"duration_s": 1})
    with pytest.raises(UserError, match=r"--pilot: flies what JSBSim flies on a plan"):
        run(kinematic, far_end=Px4(peer.url, flies=True))
