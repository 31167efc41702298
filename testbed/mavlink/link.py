"""Where frames go and requests come from. A link never waits for its peer: what can't be sent at once is lost.

Addresses are pymavlink's:

``udpout:host:port``
    Sends to a ground station that listens there, or will.
``udpin:host:port``
    Listens; ground stations speak first, several at once.
``tcp:host:port``
    Connects, as a client, to a ground station that listens there already.
``tcpin:host:port``
    Listens, as a server; ground stations may come and go.
``serial:device``, ``serial:device:baud``
    A serial port, as of a telemetry radio; 57600 baud unless it is said.
``tlog:path``, or a path that ends in ``.tlog``
    Writes the log that ground stations replay: big-endian microseconds before each frame.

An empty host is this machine, for listening too. Host names are looked up once, IPv4 only.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from testbed.errors import UserError

STAMP_BYTES, FRAMES = 8, (b"\xfd", b"\xfe")  # of a telemetry log: the time, and how the frame after it begins

CONNECT_TIMEOUT_S = 5.0
MOST_STATIONS = 16  # on one port; more are not let in
FORGET_S = 30.0  # a station on udpin that is silent for longer has gone: they all send heartbeats
BAUD = 57600
_READ = 4096
_FORMS = (
    "udpout:host:port, udpin:host:port, tcp:host:port, tcpin:host:port, serial:device[:baud], tlog:path"
    " or a path ending in .tlog"
)


class Station(ABC):
    """One other end of a link, as long as it is there."""

    datagrams = False  # whether what it says comes in datagrams, each with whole frames

    @abstractmethod
    def send(self, frames: Sequence[bytes]) -> None:
        """Hand over frames; what can't be taken at once is lost."""

    def admit(self) -> bool:
        """It has spoken MAVLink: whether it belongs to its link's `Link.stations` from now on."""
        return True


class Link(Protocol):
    """One way out, and in."""

    @property
    def stations(self) -> Sequence[Station]:
        """Who is there."""
        ...

    def receive(self, budget: int) -> list[tuple[Station, bytes]]:
        """Let stations in, and give what they have said since, at most about ``budget`` bytes; the rest next time."""
        ...

    def close(self) -> None:
        """Let go of the socket or file; harmless when done twice."""
        ...


def log_path(url: str) -> Path | None:
    """The file that ``url`` names; None when it names no telemetry log."""
    return Path(url.removeprefix("tlog:")) if url.startswith("tlog:") or url.endswith(".tlog") else None


def connect(url: str) -> Link | TelemetryLog:
    """Open the link that ``url`` names.

    Raises UserError, naming the address and what to do, when it is malformed, its host unknown, its port taken, nobody
    listens, or the file can't be written.
    """
    path = log_path(url)
    if path is not None:
        return TelemetryLog(url, path)
    kind, _, where = url.partition(":")
    if kind == "serial":
        return Serial(url, where)
    if kind not in _KINDS:
        raise UserError(f"{url}: not a MAVLink address; use {_FORMS}")
    return _KINDS[kind](url, resolve(url, where))


def connect_all(urls: Sequence[str]) -> list[Link | TelemetryLog]:
    """Open every link, or none. Files come last, so that a wrong address leaves no empty log behind."""
    if len(set(urls)) < len(urls):
        raise UserError(f"{', '.join(urls)}: the same MAVLink address is given twice; give it once")
    with contextlib.ExitStack() as opened:
        links = {}
        for url in sorted(urls, key=lambda url: log_path(url) is not None):
            links[url] = connect(url)
            opened.callback(links[url].close)
        opened.pop_all()
    return [links[url] for url in urls]


def resolve(url: str, where: str, forms: str = _FORMS) -> tuple[str, int]:
    """Address of ``host:port`` at the end of ``url``; UserError, naming the right ``forms``, when there is none."""
    host, colon, port = where.rpartition(":")
    if not colon or not port.isdecimal() or not 0 < int(port) < 2**16:
        raise UserError(f"{url}: no port number between 1 and 65535 at its end; use {forms}")
    try:
        found = socket.getaddrinfo(host or "127.0.0.1", int(port), socket.AF_INET, socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        raise UserError(f"{url}: host {host!r} is not known; check the name or give its IPv4 address") from None
    address: tuple[str, int] = found[0][4][:2]  # type: ignore[assignment]
    return address


def _require_log(url: str, path: Path) -> None:
    """Raise UserError when there is a file that is no telemetry log of earlier: it is somebody else's."""
    if not path.is_file():
        return
    try:
        with path.open("rb") as file:
            head = file.read(STAMP_BYTES + 1)
    except OSError:
        return  # to be told when it is opened
    if head and head[STAMP_BYTES:] not in FRAMES:  # one that was cut off before its first frame too
        raise UserError(f"{url}: {path.name} is there already, and is no telemetry log: give the log another name")


class TelemetryLog:
    """A telemetry log (.tlog) as ground stations, mavlogdump and MAVExplorer read it."""

    def __init__(self, url: str, path: Path) -> None:
        self._url = url
        _require_log(url, path)
        try:
            self._file = path.open("wb")
        except FileNotFoundError:
            raise UserError(f"{url}: there is no folder {path.parent}: make it, or choose another path") from None
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UserError(f"{url}: the log can't be written there ({reason}); choose another path") from None

    def write(self, data: bytes) -> None:
        """Append stamps and frames. Raises UserError when the disk takes no more."""
        try:
            self._file.write(data)
        except OSError as error:
            raise UserError(f"{self._url}: the log can't be written any further ({error.strerror})") from None

    def close(self) -> None:
        """Write what is buffered and close the file."""
        try:
            self._file.close()
        except OSError as error:
            raise UserError(f"{self._url}: the end of the log can't be written ({error.strerror})") from None


class _Udp(Station):
    """One address that datagrams of one frame each go to, whether or not anybody is there."""

    datagrams = True

    def __init__(self, send: Callable[[bytes], int], admit: Callable[[_Udp], bool] = lambda station: True) -> None:
        self._send = send
        self._admit = admit
        self.heard = time.monotonic()

    def send(self, frames: Sequence[bytes]) -> None:
        for frame in frames:
            # Refused, unreachable, buffer full: the peer's loss, and it may come back.
            with contextlib.suppress(OSError):
                self._send(frame)

    def admit(self) -> bool:
        return self._admit(self)


class UdpOut:
    """One station, at an address that is known."""

    def __init__(self, url: str, address: tuple[str, int]) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.connect(address)
        except OSError as error:
            self._socket.close()
            raise UserError(f"{url}: can't send there ({error.strerror}); check the address") from None
        self.stations = [_Udp(self._socket.send)]

    def receive(self, budget: int) -> list[tuple[Station, bytes]]:
        """What the station at the address says; others are not heard."""
        said: list[tuple[Station, bytes]] = []
        while budget > 0:
            try:
                data = self._socket.recv(_READ)
            except BlockingIOError:
                break
            except OSError:  # nobody was there for what was sent before
                budget -= _READ // 16
                continue
            budget -= max(len(data), 64)
            said.append((self.stations[0], data))
        return said

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class UdpIn:
    """A port that ground stations speak to first. Silent ones are forgotten, and cost nothing from then on."""

    def __init__(self, url: str, address: tuple[str, int]) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind(address)
        except OSError as error:
            self._socket.close()
            raise UserError(in_use(url, error)) from None
        self._by_address: dict[tuple[str, int], _Udp] = {}

    @property
    def stations(self) -> Sequence[Station]:
        """Those that have spoken MAVLink within the last half minute."""
        return list(self._by_address.values())

    def receive(self, budget: int) -> list[tuple[Station, bytes]]:
        """What was said, by stations or by strangers that may become one."""
        now = time.monotonic()
        said: list[tuple[Station, bytes]] = []
        while budget > 0:
            try:
                data, address = self._socket.recvfrom(_READ)
            except BlockingIOError:
                break
            except OSError:
                budget -= _READ // 16
                continue
            budget -= max(len(data), 64)
            station = self._by_address.get(address)
            if station is None:
                station = self._stranger(address)
            station.heard = now
            said.append((station, data))
        gone = [address for address, station in self._by_address.items() if now - station.heard > FORGET_S]
        for address in gone:
            del self._by_address[address]
        return said

    def _stranger(self, address: tuple[str, int]) -> _Udp:
        def admit(station: _Udp) -> bool:
            if len(self._by_address) < MOST_STATIONS:
                self._by_address.setdefault(address, station)
            return address in self._by_address

        return _Udp(lambda frame: self._socket.sendto(frame, address), admit)

    def close(self) -> None:
        """Close the port."""
        self._socket.close()


class _Stream(Station):
    """The other end of a connection whose bytes come in order, never waited for; ``write`` and ``read`` raise OSError.

    A frame cut by a full buffer goes on first, or the peer would lose its place; what was due meanwhile is lost.
    """

    def __init__(self, write: Callable[[bytes], int], read: Callable[[int], bytes]) -> None:
        self._write = write
        self._read = read
        self._rest = b""
        self.gone = False

    def send(self, frames: Sequence[bytes]) -> None:
        if self.gone:
            return
        try:
            if self._rest:
                self._rest = self._rest[self._write(self._rest) :]
            data = b"".join(frames)
            if data and not self._rest:
                self._rest = data[self._write(data) :]
        except BlockingIOError:
            pass
        except OSError:
            self.gone = True

    def receive(self, budget: int) -> bytes:
        """What it has said; notices when it has gone."""
        said = b""
        try:
            while not self.gone and len(said) < budget:
                more = self._read(min(_READ, budget - len(said)))
                self.gone = not more
                said += more
        except BlockingIOError:
            pass
        except OSError:
            self.gone = True
        return said


class _Peer(_Stream):
    """The other end of a TCP connection."""

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        with contextlib.suppress(OSError):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        super().__init__(connection.send, connection.recv)
        self._socket = connection

    def close(self) -> None:
        self.receive(1 << 20)  # unread input would make the system throw away what is still under way
        self._socket.close()


class TcpClient:
    """A connection to a ground station that listens. When the station closes it, the link falls silent."""

    def __init__(self, url: str, address: tuple[str, int]) -> None:
        try:
            connection = socket.create_connection(address, timeout=CONNECT_TIMEOUT_S)
        except OSError as error:
            raise UserError(
                f"{url}: nobody answers there ({error}); start the ground station first, or let it connect: tcpin:"
            ) from None
        self.stations = [_Peer(connection)]

    def receive(self, budget: int) -> list[tuple[Station, bytes]]:
        """What the station has said."""
        said = [(peer, peer.receive(budget)) for peer in self.stations]
        if any(peer.gone for peer in self.stations):
            self.close()
        return [(peer, data) for peer, data in said if data]

    def close(self) -> None:
        """Close the connection."""
        while self.stations:
            self.stations.pop().close()


class TcpServer:
    """A port at which ground stations may connect, at any time."""

    def __init__(self, url: str, address: tuple[str, int]) -> None:
        try:
            self._listener = socket.create_server(address)
        except OSError as error:
            raise UserError(in_use(url, error)) from None
        self._listener.setblocking(False)
        self.stations: list[_Peer] = []

    def receive(self, budget: int) -> list[tuple[Station, bytes]]:
        """Let waiting stations in; what they all have said, shared fairly."""
        with contextlib.suppress(OSError):
            while len(self.stations) < MOST_STATIONS:
                self.stations.append(_Peer(self._listener.accept()[0]))
        share = budget // max(1, len(self.stations))
        said = [(peer, peer.receive(share)) for peer in self.stations]
        for peer in [peer for peer in self.stations if peer.gone]:
            peer.close()
            self.stations.remove(peer)
        return [(peer, data) for peer, data in said if data]

    def close(self) -> None:
        """Close the port and every connection."""
        self._listener.close()
        while self.stations:
            self.stations.pop().close()


class Serial:
    """A serial port. When the device goes away, the link falls silent."""

    def __init__(self, url: str, where: str) -> None:
        device, _, rate = where.rpartition(":")
        if not rate.isdecimal():  # names of devices may have colons, too
            device, rate = where, str(BAUD)
        try:
            import termios
            import tty
        except ImportError:
            raise UserError(f"{url}: serial ports are for POSIX systems; use udpout: or tcp: here") from None
        speed = getattr(termios, f"B{rate}", None)
        if not speed:  # 0 would hang up
            raise UserError(
                f"{url}: {rate!r} is no baud rate of this system; use serial:device:57600 or another usual one"
            )
        try:
            self._file = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UserError(f"{url}: the device can't be opened ({reason}); check its name and your rights") from None
        try:
            tty.setraw(self._file, termios.TCSANOW)
            settings = termios.tcgetattr(self._file)
            settings[2] |= termios.CLOCAL | termios.CREAD
            settings[4] = settings[5] = speed
            termios.tcsetattr(self._file, termios.TCSANOW, settings)
        except termios.error:
            os.close(self._file)
            raise UserError(f"{url}: is no serial port; check the device's name") from None
        self.stations = [_Stream(self._write, self._read)]

    def _write(self, data: bytes) -> int:
        return os.write(self._file, data)

    def _read(self, size: int) -> bytes:
        data = os.read(self._file, size)
        if not data:  # nothing there, as a terminal says it
            raise BlockingIOError
        return data

    def receive(self, budget: int) -> list[tuple[Station, bytes]]:
        """What was said."""
        said = [(station, station.receive(budget)) for station in self.stations]
        if any(station.gone for station in self.stations):
            self.close()
        return [(station, data) for station, data in said if data]

    def close(self) -> None:
        """Close the device."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1
        self.stations.clear()


def in_use(url: str, error: OSError) -> str:
    """What is said when nobody can listen at ``url``."""
    return f"{url}: can't listen there ({error.strerror}); end what uses the port or choose another"


_KINDS: dict[str, Callable[[str, tuple[str, int]], Link]] = {
    "udpout": UdpOut,
    "udpin": UdpIn,
    "tcp": TcpClient,
    "tcpin": TcpServer,
}
