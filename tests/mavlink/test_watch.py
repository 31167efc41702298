"""What `testbed watch` shows is what was said on the link."""

from __future__ import annotations

import io
import math
import random
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pymap3d
import pytest
from pymavlink.dialects.v20 import all as mav
from rich.console import Console

import testbed.__main__ as cli
from testbed.errors import UserError
from testbed.mavlink.watch import LONGEST_TEXT, Picture, _messages, watch
from testbed.record import reader as record

SECONDS = 16
DENIED = (6, 12)
ALL = (
    mav.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mav.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mav.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | mav.MAV_SYS_STATUS_SENSOR_GPS
)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a short run that ended in its outage's aftermath, with its telemetry log."""
    folder = tmp_path_factory.mktemp("watched")
    denied = f"sensors.gnss.denied=[[{DENIED[0]}, {DENIED[1]}]]"
    arguments = ["run", "u_turn", "--set", f"duration_s={SECONDS}", "--set", denied, "--no-report"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["testbed", *arguments, "--out", str(folder), "--mavlink", f"{folder}/run.tlog"])
        with pytest.raises(SystemExit) as ended:
            cli.main()
    assert not ended.value.code
    return folder


def shown(source: str | Path, console: Console | None = None, speed: float = 10) -> str:
    console = console or Console(file=io.StringIO(), width=120)
    watch(str(source), console, speed)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


class Vehicle:
    """Messages as they come off the wire."""

    def __init__(self, system: int = 1, component: int = 1) -> None:
        self._mav = mav.MAVLink(None, system, component)

    def bytes(self, message: mav.MAVLink_message) -> bytes:
        packed: bytes = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        return packed

    def message(self, message: mav.MAVLink_message) -> mav.MAVLink_message:
        return mav.MAVLink(None).decode(bytearray(self.bytes(message)))


def heartbeat() -> mav.MAVLink_message:
    return mav.MAVLink_heartbeat_message(mav.MAV_TYPE_FIXED_WING, mav.MAV_AUTOPILOT_PX4, 149, 0x03040000, 4, 3)


def sys_status(health: int) -> mav.MAVLink_message:
    return mav.MAVLink_sys_status_message(ALL, ALL, health, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)


def gps(fix: int) -> mav.MAVLink_message:
    return mav.MAVLink_gps_raw_int_message(0, fix, 0, 0, 0, 0, 0, 0, 0, 0)


def log(*frames: bytes, every_s: float = 1.0) -> bytes:
    return b"".join(struct.pack(">Q", round(1e6 * (1e9 + i * every_s))) + frame for i, frame in enumerate(frames))


@pytest.mark.ci
def test_the_end_of_a_log_is_the_end_of_the_run(flown: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = shown(flown / "run.tlog")
    dataset = record.load(flown / "run.nc")
    truth, ins = dataset["truth"], dataset["estimators/ins"]
    # The errors go out once per second: the last at the last whole second or just before.
    told = float(re.findall(r"horizontal +([\d.]+) m", picture)[0])
    errors = []
    for t in (SECONDS - 1, SECONDS):
        i, j = (int(np.abs(rows["time"].values - t).argmin()) for rows in (truth, ins))
        at = [float(np.degrees(rows[name].values[k])) for rows, k in ((ins, j), (truth, i)) for name in ("lat", "lon")]
        north, east, _ = pymap3d.geodetic2ned(at[0], at[1], 0, at[2], at[3], 0)
        errors.append(math.hypot(north, east))
    assert any(told == pytest.approx(error, abs=0.02) for error in errors)
    lines = capsys.readouterr().out.splitlines()
    said = {line.partition("  ")[2].strip(): line for line in map(str.strip, lines)}
    assert float(said["gnss denied"].split()[0]) == pytest.approx(DENIED[0], abs=0.5)
    assert "gnss reacquired" in said
    assert re.search(r"GNSS +healthy", picture)
    assert "LOITER, armed" in picture
    assert "1/3 straight" in picture


def test_an_outage_shows_while_it_lasts(flown: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shown(flown / "run.tlog", speed=1)  # a line per second of the log
    lines = [
        line.split("  ", 1) for line in map(str.strip, capsys.readouterr().out.splitlines()) if "horizontal" in line
    ]
    denied = [float(time.split()[0]) for time, rest in lines if "GNSS denied" in rest]
    healthy = [float(time.split()[0]) for time, rest in lines if "all sensors healthy" in rest]
    assert len(denied) == pytest.approx(DENIED[1] - DENIED[0] + 2, abs=2)  # and the time to reacquire
    assert min(denied) >= DENIED[0]
    assert set(map(round, healthy)) >= {4, 5, SECONDS}
    assert any("dead reckoning" in rest for _, rest in lines)


def test_a_terminal_sees_it_at_its_pace(flown: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=100, height=40)
    now = [100.0]  # the clock, which only sleeping moves
    clock = SimpleNamespace(monotonic=lambda: now[0], sleep=lambda s: now.append(now.pop() + s))
    monkeypatch.setattr("testbed.mavlink.watch.time", clock)
    drawn = shown(flown / "run.tlog", console, speed=SECONDS)
    took = now[0] - 100.0
    assert took == pytest.approx(1.0, abs=0.1)
    assert 4 <= drawn.count("╭") <= 5 * took + 3  # at 5 Hz, and the first and the last
    assert "\x1b[33mdenied" in drawn


def test_link_is_lost_after_three_and_a_half_seconds() -> None:
    picture, vehicle = Picture(""), Vehicle()
    assert "no vehicle" in picture.line()
    picture.hear(vehicle.message(heartbeat()), 10.0)
    picture.clock = 13.4
    assert "lost" not in picture.line()
    picture.hear(vehicle.message(sys_status(ALL)), 13.5)  # is no heartbeat
    picture.clock = 13.6
    assert "link lost" in picture.line()
    picture.hear(vehicle.message(heartbeat()), 14.0)
    picture.clock = 14.0
    assert "lost" not in picture.line()


@pytest.mark.parametrize(
    ("health", "fix", "spoofing", "expected"),
    [
        (ALL, 3, mav.GPS_SPOOFING_STATE_NOT_SPOOFED, "all sensors healthy"),
        (ALL, 1, mav.GPS_SPOOFING_STATE_NOT_SPOOFED, "GNSS denied"),
        (ALL, 3, mav.GPS_SPOOFING_STATE_DETECTED, "GNSS spoofed"),
        (ALL & ~mav.MAV_SYS_STATUS_SENSOR_GPS, 0, mav.GPS_SPOOFING_STATE_NOT_SPOOFED, "GNSS failed"),
        (ALL & ~mav.MAV_SYS_STATUS_SENSOR_3D_GYRO, 3, mav.GPS_SPOOFING_STATE_NOT_SPOOFED, "gyro failed"),
        (ALL & ~mav.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE, 1, 0, "barometer failed, GNSS denied"),
    ],
)
def test_sensors(health: int, fix: int, spoofing: int, expected: str) -> None:
    picture, vehicle = Picture(""), Vehicle()
    for message in (
        heartbeat(),
        sys_status(health),
        gps(fix),
        mav.MAVLink_gnss_integrity_message(0, 0, 0, 1, spoofing, 0, 0, 0, 0, 0, 0, 0),
    ):
        picture.hear(vehicle.message(message), 0.0)
    assert picture.line().endswith(f"  {expected}")
    assert "magnetometer" not in picture.line()  # is not present


def test_another_run_begins_anew() -> None:
    picture, vehicle = Picture(""), Vehicle()

    def attitude(t: float) -> mav.MAVLink_message:
        return vehicle.message(mav.MAVLink_attitude_message(round(t * 1e3), 0, 0, 0, 0, 0, 0))

    for message in (heartbeat(), mav.MAVLink_named_value_float_message(0, b"err_horiz", 77.0)):
        picture.hear(vehicle.message(message), 0.0)
    picture.hear(attitude(100.0), 0.0)
    assert "77.0 m" in picture.line()
    picture.hear(attitude(0.1), 1.0)
    picture.hear(vehicle.message(heartbeat()), 1.0)
    assert "77.0 m" not in picture.line()


@pytest.mark.parametrize(
    ("autopilot", "seq", "expected"),
    [
        (mav.MAV_AUTOPILOT_PX4, 0, "leg 1/3  "),
        (mav.MAV_AUTOPILOT_PX4, 2, "leg 3/3  "),
        (mav.MAV_AUTOPILOT_ARDUPILOTMEGA, 2, "leg 2/3  "),  # 0 is home
    ],
)
def test_a_leg_is_the_item_that_is_flown_whatever_texts_say(autopilot: int, seq: int, expected: str) -> None:
    picture, vehicle = Picture(""), Vehicle()
    for message in (
        mav.MAVLink_heartbeat_message(mav.MAV_TYPE_FIXED_WING, autopilot, 149, 12, 4, 3),
        mav.MAVLink_statustext_message(6, f"leg {seq}/3 u_turn".encode()),
        mav.MAVLink_mission_current_message(seq, 3),
        sys_status(ALL),
    ):
        picture.hear(vehicle.message(message), 0.0)
    assert expected in picture.line()


def test_other_vehicles_and_stations_are_left_out() -> None:
    picture, vehicle, other = Picture(""), Vehicle(), Vehicle(system=2)
    station = mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
    picture.hear(Vehicle(255, 190).message(station), 0.0)
    picture.hear(vehicle.message(heartbeat()), 0.0)
    picture.hear(other.message(mav.MAVLink_statustext_message(4, b"not mine")), 0.0)
    picture.hear(vehicle.message(mav.MAVLink_statustext_message(4, b"mine")), 0.0)
    drawn = Console(file=io.StringIO(), width=100)
    drawn.print(picture.render())
    assert isinstance(drawn.file, io.StringIO)
    assert "mine" in drawn.file.getvalue()
    assert "not mine" not in drawn.file.getvalue()


def test_texts_are_put_together_and_disarmed() -> None:
    picture, vehicle = Picture(""), Vehicle()
    picture.hear(vehicle.message(heartbeat()), 0.0)
    chunks = [b"x" * 50, b"y" * 50, b""]
    said = [
        picture.hear(vehicle.message(mav.MAVLink_statustext_message(6, chunk, 9, i)), 0.0)
        for i, chunk in enumerate(chunks)
    ]
    assert said[:2] == [None, None]
    assert said[2] is not None
    assert said[2].strip() == "x" * 50 + "y" * 50
    hostile = picture.hear(vehicle.message(mav.MAVLink_statustext_message(3, b"\x1b[2J[bold]\xff\x07")), 0.0)
    assert hostile is not None
    assert hostile.isprintable()
    assert "[bold]" in hostile


def test_what_is_no_frame_is_passed_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    vehicle = Vehicle()
    texts = [vehicle.bytes(mav.MAVLink_statustext_message(6, text)) for text in (b"one", b"two", b"three")]
    broken = bytearray(texts[1])
    broken[12] ^= 1
    data = log(vehicle.bytes(heartbeat()), texts[0], bytes(broken), bytes(range(256)) * 3, texts[2])
    path = tmp_path / "damaged.tlog"
    path.write_bytes(data + b"\0" * 8 + texts[1][:-5])  # cut in its last frame
    shown(path)
    out = capsys.readouterr().out
    assert "one" in out
    assert "three" in out
    assert "two" not in out


@pytest.mark.parametrize(
    ("source", "hint"),
    [
        ("loiter", "udpin:host:port"),
        ("udpout:127.0.0.1:14550", "udpin:host:port"),
        ("udpin:127.0.0.1", "port number"),
        ("udpin:127.0.0.1:70000", "port number"),
        ("udpin:no host:1", "not known"),
        ("nowhere.tlog", "No such file"),
        ("tlog:.", "can't be read"),
    ],
)
def test_wrong_sources(source: str, hint: str) -> None:
    with pytest.raises(UserError, match=hint):
        shown(source)


def test_sources_that_can_not_be_had(tmp_path: Path) -> None:
    (tmp_path / "text.tlog").write_text("no log at all\n" * 50)
    by_chance = random.Random(1).randbytes(5000) + Vehicle().bytes(sys_status(ALL))
    (tmp_path / "random.tlog").write_bytes(by_chance)
    for name in ("text", "random"):
        with pytest.raises(UserError, match="no telemetry log: there is no heartbeat of a vehicle in it"):
            shown(tmp_path / f"{name}.tlog")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(UserError, match="choose another"):
            shown(f"udpin:127.0.0.1:{taken.getsockname()[1]}")
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        with pytest.raises(UserError, match="start the run first"):
            shown(f"tcp:127.0.0.1:{unused.getsockname()[1]}")


def test_a_connection_that_the_vehicle_closes_ends_it(capsys: pytest.CaptureFixture[str]) -> None:
    vehicle = Vehicle()
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            peer, _ = server.accept()
            with peer:
                for frame in (vehicle.bytes(heartbeat()), vehicle.bytes(mav.MAVLink_statustext_message(4, b"bye"))):
                    for piece in (frame[:7], frame[7:]):
                        peer.sendall(piece)
                        time.sleep(0.02)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        picture = shown(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        thread.join(5)
    assert "LOITER, armed" in picture
    assert "bye" in capsys.readouterr().out


def test_a_reset_connection_ends_it_too() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            peer, _ = server.accept()
            peer.sendall(Vehicle().bytes(heartbeat()))
            time.sleep(0.2)
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            peer.close()

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        assert "LOITER, armed" in shown(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        thread.join(5)


def test_a_frame_that_the_parser_fails_at_is_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    vehicle = Vehicle()
    frames = [vehicle.bytes(heartbeat()) for _ in range(3)]
    decode = mav.MAVLink.decode

    def fails(self: mav.MAVLink, data: bytearray) -> mav.MAVLink_message:
        if bytes(data) == frames[1]:
            raise TypeError("as at hostile bytes")
        return decode(self, data)

    monkeypatch.setattr(mav.MAVLink, "decode", fails)
    assert len(_messages(mav.MAVLink(None), b"".join(frames))) == 2


def test_texts_without_an_end_stay_short() -> None:
    picture, vehicle = Picture(""), Vehicle()
    for i in range(2000):
        said = picture.hear(vehicle.message(mav.MAVLink_statustext_message(6, b"x" * 50, 1 + i // 600, 1)), 0.0)
        assert said is None
    said = picture.hear(vehicle.message(mav.MAVLink_statustext_message(6, b"end", 1, 2)), 0.0)
    assert said is not None
    assert len(said) <= 10 + LONGEST_TEXT


@pytest.mark.ci
def test_live_until_interrupted() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    # Tests that run in the background of a shell inherit that interrupts are ignored.
    heed = partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    watcher = subprocess.Popen(
        [sys.executable, "-m", "testbed", "watch", f"udpin:127.0.0.1:{port}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=heed,
    )
    try:
        assert watcher.stdout is not None
        assert "no vehicle" in watcher.stdout.readline()
        vehicle = Vehicle()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
            for message in (heartbeat(), sys_status(ALL), mav.MAVLink_statustext_message(4, b"gnss denied")):
                link.sendto(vehicle.bytes(message), ("127.0.0.1", port))
        assert "gnss denied" in watcher.stdout.readline()
        assert "LOITER, armed" in watcher.stdout.readline()
        watcher.send_signal(signal.SIGINT)
        out, err = watcher.communicate(timeout=10)
    finally:
        watcher.kill()
        watcher.wait(10)
    assert watcher.returncode == 0
    assert err == ""
    assert "online" in out
