"""PX4 follows a run in lockstep: what it is sent, that it changes nothing, and how it ends when PX4 misbehaves."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from worlds import autopilots
from worlds.loop import same

from testbed import RunResult, Scenario, run
from testbed.bridges.px4 import Px4
from testbed.errors import UserError
from testbed.record.reader import load

DURATION_S = 12.0


def scenario(duration_s: float = DURATION_S) -> Scenario:
    return Scenario.load(
        "kinematic_u_flight",
        {
            "duration_s": duration_s,
            "sensors.gnss.latency_s": 0.12,
            "sensors.gnss.denied": [[5, 7]] if duration_s > 7 else [],
            "sensors.second": {"kind": "gnss", "rate_hz": 1},
        },
    )


@pytest.fixture(scope="module")
def alone() -> RunResult:
    return run(scenario())


@pytest.fixture(scope="module")
def followed() -> tuple[RunResult, autopilots.Px4, Px4]:
    peer = autopilots.Px4()
    far_end = Px4(peer.url)
    return run(scenario(), far_end=far_end), peer, far_end


Followed = tuple[RunResult, autopilots.Px4, Px4]


@pytest.mark.ci
def test_a_run_that_px4_follows_has_the_same_bits(alone: RunResult, followed: Followed) -> None:
    result, _, far_end = followed
    assert result.failure == ""
    assert same(result.dataset, alone.dataset)
    assert far_end.answered == len(alone.dataset["sensors/imu/time"])
    assert not far_end.armed


@pytest.mark.ci
def test_px4_is_sent_the_samples_of_the_run(alone: RunResult, followed: Followed) -> None:
    _, peer, _ = followed
    imu = alone.dataset["sensors/imu"]
    n = len(imu["time"])
    told = peer.of("HIL_SENSOR")[-n:]
    stamps = np.array([m.time_usec for m in peer.of("HIL_SENSOR")])
    assert (np.diff(stamps) == 5000).all()  # without a jump between booting and the run
    rate, force = (imu[key].values / imu["dt"].values[:, None] for key in ("dtheta", "dv"))
    np.testing.assert_array_equal([(m.xgyro, m.ygyro, m.zgyro) for m in told], rate.astype(np.float32))
    np.testing.assert_array_equal([(m.xacc, m.yacc, m.zacc) for m in told], force.astype(np.float32))
    assert all(m.fields_updated & 0x3F == 0x3F for m in told)
    start = told[0].time_usec - 5000
    for bits, sensor, values in (
        (0x1C0, "magnetometer", lambda m: (m.xmag * 1e-4, m.ymag * 1e-4, m.zmag * 1e-4)),
        (0x1A00, "barometer", lambda m: m.abs_pressure * 100),
        (0x400, "airspeed", lambda m: np.sqrt(2 * 100 * m.diff_pressure / 1.225)),
    ):
        own = alone.dataset[f"sensors/{sensor}"]
        news = [m for m in told if m.fields_updated & bits]
        assert all(m.fields_updated & bits == bits for m in news)
        came = own["t_arrival"].values > 0.0051  # what was there before the first step comes with it
        assert len(news) == came.sum() + 1
        key = {"magnetometer": "field_b", "barometer": "pressure", "airspeed": "eas"}[sensor]
        np.testing.assert_allclose([values(m) for m in news[1:]], own[key].values[came], rtol=1e-5)
        at = np.array([m.time_usec - start for m in news[1:]]) / 1e6
        assert ((at >= own["t_arrival"].values[came] - 1e-6) & (at < own["t_arrival"].values[came] + 0.0051)).all()


@pytest.mark.ci
def test_receivers_say_what_they_said_in_the_run(alone: RunResult, followed: Followed) -> None:
    _, peer, _ = followed
    own = alone.dataset["sensors/gnss"]
    n = int((own["t_arrival"].values < DURATION_S).sum())
    fixes = np.array([m for m in peer.of("HIL_GPS") if m.id == 0][-n:])
    fix = own["fix_type"].values[:n] >= 3
    assert 0 < fix.sum() < n
    assert [m.fix_type >= 3 for m in fixes] == list(fix)
    for field, values in (
        ("lat", np.degrees(own["lat"].values) * 1e7),
        ("alt", own["h"].values * 1e3),
        ("vn", own["v_n"].values[:, 0] * 100),
        ("epv", own["sigma_position_n"].values[:, 2] * 100),
    ):
        np.testing.assert_allclose([getattr(m, field) for m in fixes[fix]], values[:n][fix], rtol=0, atol=0.51)
    first_without = int(np.flatnonzero(~fix)[0])
    assert {m.eph for m in fixes[~fix]} == {65535}
    assert fixes[first_without].lat == fixes[first_without - 1].lat
    assert {m.id for m in peer.of("HIL_GPS")} == {0, 4}  # their places among the aiding sensors
    truth = peer.of("HIL_STATE_QUATERNION")
    assert len(truth) >= DURATION_S * 50 - 2
    np.testing.assert_allclose(truth[-1].attitude_quaternion, alone.dataset["truth/q_nb"].values[-1], atol=2e-3)


@pytest.mark.ci
@pytest.mark.parametrize(
    ("behaviour", "says"),
    [
        ("stall", r"PX4 has not answered the step of \d\.\d+ s for 3 s"),
        ("close", "PX4 has closed the connection|connection to PX4 broke"),
        ("late", r"PX4 has not answered the step of \d\.\d+ s for 3 s"),
        ("ahead", r"for 0\.005 s later: its clock is not ours"),
        ("talk", r"PX4 said \d+ bytes at \d\.\d+ s, but not the controls of that step"),
    ],
)
def test_a_px4_that_misbehaves_ends_the_run_and_leaves_the_record(behaviour: str, says: str, tmp_path: Path) -> None:
    peer = autopilots.Px4(behaviour, at=500)
    try:
        patience = {"answer_s": 3.0} if behaviour in ("stall", "late") else {}
        result = run(scenario(6.0), out=tmp_path, far_end=Px4(peer.url, **patience))
    finally:
        peer.over.set()
    assert re.search(says, result.failure)
    record = load(tmp_path / "run.nc")
    assert record.attrs["complete"] == 1
    assert 2.0 < record["truth/time"].values[-1] < 3.0  # within a tenth of a second of the 500th step
    assert result.failure in list(record["events/text"].values)


@pytest.mark.parametrize("behaviour", ["double", "halves"])
def test_what_tcp_may_do_is_no_misbehaviour(behaviour: str) -> None:
    peer = autopilots.Px4(behaviour)
    far_end = Px4(peer.url)
    result = run(scenario(1.0), far_end=far_end)
    assert (result.failure, far_end.answered) == ("", 200)


def test_a_px4_that_never_boots_is_told_of() -> None:
    peer = autopilots.Px4(boot=10**9)
    result = run(scenario(1.0), far_end=Px4(peer.url, boot_s=0.2))
    assert result.failure == "PX4 has connected, but answered no HIL_SENSOR for 0.2 s"


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("udpin:127.0.0.1:4560", "is no address: give it as tcpin:HOST:PORT, such as tcpin:127.0.0.1:4560"),
        ("tcpin:127.0.0.1", "is no address"),
        ("tcpin:127.0.0.1:99999", "is no address"),
        ("tcpin:256.1.1.1:4560", "the host is unknown"),
        ("tcpin:192.0.2.1:4560", "can't listen there"),
    ],
)
def test_addresses_that_are_none_are_told(url: str, says: str) -> None:
    with pytest.raises(UserError, match=says):
        Px4(url)


def test_nobody_connects() -> None:
    url = f"tcpin:127.0.0.1:{autopilots.free_port(autopilots.socket.SOCK_STREAM)}"
    with pytest.raises(UserError, match=r"no PX4 has connected within 0\.1 s"):
        Px4(url, connect_s=0.1)


def test_the_same_answers_give_the_same_bytes() -> None:
    def sent() -> tuple[bytes, Any]:
        peer = autopilots.Px4(boot=1)
        run(scenario(1.0), far_end=Px4(peer.url))
        peer.join()
        return peer.raw, peer.of("HIL_SENSOR")

    (first, one), (second, other) = sent(), sent()
    assert len(one) >= 200
    if len(one) == len(other):  # booting took as long
        assert first == second
    assert [m.get_payload()[8:] for m in one[-200:]] == [m.get_payload()[8:] for m in other[-200:]]
