import os
import socket
import time

import pytest

from testbed.errors import UserError, printable
from testbed.mavlink.link import connect, connect_all

FRAME = b"\xfd" + bytes(range(60))
BUDGET = 8192


def send(link, frames):
    """To all who are there, as the publisher does it."""
    link.receive(BUDGET)
    for station in list(link.stations):
        station.send(frames)


def free_port(kind=socket.SOCK_STREAM):
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def read(connection, size):
    connection.settimeout(5.0)
    data = b""
    while len(data) < size:
        more = connection.recv(size - len(data))
        assert more, "closed early"
        data += more
    return data


@pytest.mark.parametrize(
    ("url", "complaint"),
    [
        ("127.0.0.1:14550", "not a MAVLink address"),
        ("serial:/dev/no-such-device", "the device can't be opened"),
        ("serial:/dev/null", "is no serial port"),
        ("serial:/dev/ttyUSB0:12345", "no baud rate"),
        ("serial:/dev/ttyUSB0:0", "no baud rate"),
        ("serial:/dev/ttyUSB0:fast", "the device can't be opened"),
        ("serial:", "the device can't be opened"),
        ("udpin:127.0.0.1", "no port number"),
        ("udpin:192.0.2.1:14550", "can't listen there"),
        ("", "not a MAVLink address"),
        ("udpout:127.0.0.1", "no port number"),
        ("udpout:127.0.0.1:", "no port number"),
        ("udpout:127.0.0.1:0", "no port number"),
        ("tcp:127.0.0.1:65536", "no port number"),
        ("tcpin:127.0.0.1:mavlink", "no port number"),
        ("udpout:no-such-host.invalid:14550", "no-such-host.invalid"),
        (f"udpout:{'x' * 70}:14550", "is not known"),
        ("udpout:a\0b:14550", "is not known"),
        ("udpout:255.255.255.255:14550", "can't send there"),
        ("tcpin:192.0.2.1:14550", "can't listen there"),
        ("tlog:/proc/no/run.tlog", "choose another path"),
        ("tlog:", "choose another path"),
        ("\0.tlog", "choose another path"),
    ],
)
def test_bad_address_is_named(url, complaint):
    with pytest.raises(UserError) as caught:
        connect(url)
    assert complaint in str(caught.value)
    assert str(caught.value).startswith(f"{printable(url)}:")


def test_log_cannot_replace_a_folder(tmp_path):
    with pytest.raises(UserError, match="Is a directory"):
        connect(f"tlog:{tmp_path}")


def test_nobody_listens():
    with pytest.raises(UserError, match="start the ground station first"):
        connect(f"tcp:127.0.0.1:{free_port()}")


def test_port_in_use():
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(UserError, match="choose another"):
        connect(f"tcpin:127.0.0.1:{taken.getsockname()[1]}")


def test_all_or_none(tmp_path):
    port = free_port()
    with pytest.raises(UserError, match="not a MAVLink address"):
        connect_all([f"tlog:{tmp_path / 'run.tlog'}", f"tcpin::{port}", "nonsense"])
    assert not (tmp_path / "run.tlog").exists()
    connect(f"tcpin::{port}").close()  # the port is free again


def test_same_address_twice():
    with pytest.raises(UserError, match="twice"):
        connect_all(["udpout::14550", "udpout::14550"])


def test_order_of_links_is_kept(tmp_path):
    links = connect_all([str(tmp_path / "a.tlog"), "udpout::14550"])
    assert [type(link).__name__ for link in links] == ["TelemetryLog", "UdpOut"]
    for link in links:
        link.close()
        link.close()


def test_log_in_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(UserError, match=r"there is no folder .*/rums: make it, or choose another path"):
        connect(f"tlog:{tmp_path / 'rums' / 'run.tlog'}")
    assert not list(tmp_path.iterdir())


def test_log_has_what_is_written(tmp_path):
    path = tmp_path / "run.tlog"
    log = connect(f"tlog:{path}")
    log.write(FRAME)
    log.write(b"two")
    log.close()
    assert path.read_bytes() == FRAME + b"two"


def test_no_log_goes_over_a_file_that_is_none(tmp_path):
    """Such as the scenario that is flown; one of an earlier run is written anew."""
    mine = tmp_path / "mine.toml"
    mine.write_text("title = 'mine'")
    with pytest.raises(UserError, match=r"mine\.toml is there already, and is no telemetry log: give the log another"):
        connect(f"tlog:{mine}")
    assert mine.read_text() == "title = 'mine'"
    for head in (bytes(8) + b"\xfd", b""):
        mine.write_bytes(head)
        connect(f"tlog:{mine}").close()


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_full_disk_is_an_error_with_a_name():
    log = connect("tlog:/dev/full")
    with pytest.raises(UserError, match="/dev/full: the log can't be written any further"):
        log.write(FRAME * 10_000)  # more than is buffered
    log.close()
    log = connect("tlog:/dev/full")
    log.write(FRAME)
    with pytest.raises(UserError, match="/dev/full: the end of the log can't be written"):
        log.close()


def test_datagrams_carry_one_frame_each_and_go_on_after_the_peer_was_away():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", 0))
        station.settimeout(5.0)
        port = station.getsockname()[1]
        link = connect(f"udpout::{port}")
        send(link, [FRAME, b"two"])
        assert station.recv(2048) == FRAME
        assert station.recv(2048) == b"two"
    for _ in range(100):
        send(link, [FRAME])  # refused by now
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", port))
        station.settimeout(5.0)
        send(link, [FRAME, FRAME])
        assert station.recv(2048) == FRAME
    link.close()


def test_datagrams_to_a_peer_that_never_reads_cost_no_time():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", 0))
        link = connect(f"udpout::{station.getsockname()[1]}")
        assert not link._socket.getblocking()  # so that no send can wait
        for _ in range(20_000):
            send(link, [FRAME])
        link.close()


def test_client_sends_and_falls_silent_when_the_station_leaves():
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = connect(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        station, _ = server.accept()
        with station:
            station.sendall(b"hello")  # what a station says is taken and dropped
            send(link, [FRAME, b"two"])
            assert read(station, len(FRAME) + 3) == FRAME + b"two"
    for _ in range(10):
        send(link, [FRAME])
    link.close()


def test_end_of_the_stream_arrives_though_the_station_talks():
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = connect(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        station, _ = server.accept()
        with station:
            send(link, [FRAME])
            station.sendall(b"heartbeat" * 100)
            time.sleep(0.05)
            link.close()
            assert read(station, len(FRAME)) == FRAME
            assert station.recv(1) == b""


def test_server_lets_stations_come_and_go():
    port = free_port()
    link = connect(f"tcpin:127.0.0.1:{port}")
    send(link, [FRAME])  # nobody yet
    with socket.create_connection(("127.0.0.1", port)) as first:
        send(link, [b"one"])
        assert read(first, 3) == b"one"
        with socket.create_connection(("127.0.0.1", port)) as second:
            send(link, [b"two"])
            assert read(first, 3) == b"two"
            assert read(second, 3) == b"two"
        for _ in range(10):
            send(link, [b"x"])
        assert read(first, 10) == b"x" * 10
    send(link, [FRAME])
    link.close()
    link.close()


def test_slow_station_costs_no_time_and_gets_whole_batches_only():
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = connect(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        station, _ = server.accept()
        with station:
            batch = b"".join(bytes([k]) * 1000 for k in range(1, 101))
            assert not link.stations[0]._socket.getblocking()  # so that no send can wait
            for _ in range(500):  # 50 MB, far beyond what the system holds
                send(link, [batch])
            received = bytearray()
            station.settimeout(0.2)
            for _ in range(1000):
                try:
                    received += station.recv(1 << 20)
                except TimeoutError:
                    break
                send(link, [])  # nothing new: what was cut goes out
            assert len(received) < 50e6
            assert len(received) % len(batch) == 0
            assert bytes(received) == batch * (len(received) // len(batch))
        link.close()
