"""ArduPilot follows a run by its JSON backend: what it is told, that it changes nothing, how it ends."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worlds import autopilots
from worlds.loop import same

from testbed import RunResult, Scenario, run
from testbed.bridges.ardupilot import ArduPilot
from testbed.errors import UserError
from testbed.record.reader import load

# How ArduPilot reads a list: right after its key and colon.
READ = {key: re.compile(rb'"%s":\[(\S+?),\s*(\S+?),\s*(\S+?)\]' % key) for key in (b"gyro", b"accel_body", b"position")}


def scenario(duration_s: float) -> Scenario:
    return Scenario.load("kinematic_u_flight", {"duration_s": duration_s})


def told(duration_s: float, behaviour: str = "") -> tuple[RunResult, autopilots.ArduPilot, ArduPilot]:
    peer = autopilots.ArduPilot(behaviour)
    try:
        far_end = ArduPilot(peer.url)
        return run(scenario(duration_s), far_end=far_end), peer, far_end
    finally:
        peer.over.set()


@pytest.mark.ci
def test_a_run_that_ardupilot_follows_has_the_same_bits_and_is_told_as_it_is() -> None:
    alone = run(scenario(10.0))
    result, peer, far_end = told(10.0)
    assert result.failure == ""
    assert same(result.dataset, alone.dataset)
    imu, truth = alone.dataset["sensors/imu"], alone.dataset["truth"]
    assert far_end.answered == len(imu["time"])
    lines = peer.lines[-len(imu["time"]) + 1 :]
    assert all(line[:1] == b"\n" and line[-1:] == b"\n" for line in lines)
    for key, values in ((b"gyro", imu["dtheta"]), (b"accel_body", imu["dv"])):
        found = np.array([[float(x) for x in READ[key].search(line).groups()] for line in lines])  # type: ignore[union-attr]
        wanted = (values.values / imu["dt"].values[:, None])[-len(lines) :]
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9)
    last = peer.said[-1]
    if last["timestamp"] == pytest.approx(10.0):  # the last answer may not have been read
        lat, lon, h = (truth[key].values for key in ("lat", "lon", "h"))
        assert place(lat[0], lon[0], last["position"]) == pytest.approx((lat[-1], lon[-1]), rel=0, abs=5e-8)  # 0.3 m
        assert last["position"][2] == pytest.approx(h[0] - h[-1], abs=1e-6)
        np.testing.assert_allclose(last["velocity"], truth["v_n"].values[-1], atol=1e-6)
        attitude = Rotation.from_euler("ZYX", last["attitude"][::-1])
        same_as = Rotation.from_quat(truth["q_nb"].values[-1], scalar_first=True)
        assert (attitude * same_as.inv()).magnitude() < 1e-6
    assert last["airspeed"] == pytest.approx(50, abs=5)
    assert all(b'"no_time_sync":1' in line for line in lines)


def place(lat: float, lon: float, position: list[float]) -> tuple[float, float]:
    """Where ArduPilot takes a position from a place to be [rad], in steps of 1e-7 degrees, each 1.1 cm."""
    unit = np.radians(1e-7)
    north = position[0] / 0.011131884502145034
    east = position[1] / 0.011131884502145034 / np.cos(lat + north * unit / 2)
    return lat + north * unit, lon + east * unit


def test_airspeed_is_a_true_one_of_which_ardupilot_makes_an_equivalent_one() -> None:
    peer = autopilots.ArduPilot()
    changes = {"duration_s": 2, "truth.start.alt_m": 3000, "expect": {}}
    try:
        result = run(Scenario.load("kinematic_u_flight", changes), far_end=ArduPilot(peer.url))
    finally:
        peer.over.set()
    equivalent = result.dataset["sensors/airspeed/eas"].values
    told = {line["airspeed"] / 1.1609 for line in peer.said if "airspeed" in line}  # EAS2TAS there
    assert max(abs(one - equivalent).min() for one in told) < 0.02


@pytest.mark.parametrize("behaviour", ["double", "wrong", "wide"])
def test_what_udp_may_do_is_no_misbehaviour(behaviour: str) -> None:
    result, peer, far_end = told(1.0, behaviour)
    assert (result.failure, far_end.answered) == ("", 200)
    times = [line["timestamp"] for line in peer.said]
    assert times == sorted(set(times))


@pytest.mark.ci
@pytest.mark.parametrize(
    ("behaviour", "says"),
    [
        ("stall", r"ArduPilot has sent no frame for 3 s at \d\.\d+ s"),
        ("restart", r"ArduPilot has begun anew: frame 0 after frame \d+"),
    ],
)
def test_an_ardupilot_that_misbehaves_ends_the_run_and_leaves_the_record(
    behaviour: str, says: str, tmp_path: Path
) -> None:
    peer = autopilots.ArduPilot(behaviour, at=500)
    try:
        result = run(scenario(6.0), out=tmp_path, far_end=ArduPilot(peer.url, answer_s=3.0))
    finally:
        peer.over.set()
    assert re.search(says, result.failure)
    record = load(tmp_path / "run.nc")
    assert record.attrs["complete"] == 1
    assert 2.0 < record["truth/time"].values[-1] < 3.0


def test_one_that_repeats_a_frame_for_ever_ends_it() -> None:
    peer = autopilots.ArduPilot("repeat", at=100)
    try:
        result = run(scenario(6.0), far_end=ArduPilot(peer.url))
    finally:
        peer.over.set()
    assert result.failure.startswith(
        ("ArduPilot has sent 1000 packets, but no next frame", "ArduPilot has sent no frame")
    )


def test_nobody_calls() -> None:
    url = f"udpin:127.0.0.1:{autopilots.free_port(autopilots.socket.SOCK_DGRAM)}"
    with pytest.raises(UserError, match=r"no ArduPilot has called within 0\.1 s"):
        ArduPilot(url, connect_s=0.1)
    with pytest.raises(UserError, match="is no address: give it as udpin:HOST:PORT"):
        ArduPilot("tcpin:127.0.0.1:9002")
