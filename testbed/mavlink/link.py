"""Where frames go: UDP, TCP, a telemetry log. A link never waits for its peer: what can't be sent at once is lost.

Addresses are pymavlink's:

``udpout:host:port``
    Sends to a ground station that listens there, or will.
``tcp:host:port``
    Connects, as a client, to a ground station that listens there already.
``tcpin:host:port``
    Listens, as a server; ground stations may come and go.
``tlog:path``, or a path that ends in ``.tlog``
    Writes the log that ground stations replay: big-endian microseconds before each frame.

An empty host is this machine. Host names are looked up once, IPv4 only.
"""

from __future__ import annotations

import contextlib
import socket
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from testbed.errors import UserError

CONNECT_TIMEOUT_S = 5.0
_STAMP = struct.Struct(">Q")
_FORMS = "udpout:host:port, tcp:host:port, tcpin:host:port, tlog:path or a path ending in .tlog"


class Link(Protocol):
    """One way out."""

    def send(self, time_us: int, frames: Sequence[bytes]) -> None:
        """Hand over frames made at ``time_us`` (microseconds since 1970)."""
        ...

    def close(self) -> None:
        """Let go of the socket or file; harmless when done twice."""
        ...


def log_path(url: str) -> Path | None:
    """The file that ``url`` names; None when it names no telemetry log."""
    return Path(url.removeprefix("tlog:")) if url.startswith("tlog:") or url.endswith(".tlog") else None


def connect(url: str) -> Link:
    """Open the link that ``url`` names.

    Raises UserError, naming the address and what to do, when it is malformed, its host unknown, its port taken, nobody
    listens, or the file can't be written.
    """
    path = log_path(url)
    if path is not None:
        return TelemetryLog(url, path)
    kind, _, where = url.partition(":")
    if kind not in ("udpout", "tcp", "tcpin"):
        raise UserError(f"{url}: not a MAVLink address; use {_FORMS}")
    address = _resolve(url, where)
    if kind == "udpout":
        return UdpOut(url, address)
    return TcpClient(url, address) if kind == "tcp" else TcpServer(url, address)


def connect_all(urls: Sequence[str]) -> list[Link]:
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


def _resolve(url: str, where: str) -> tuple[str, int]:
    host, colon, port = where.rpartition(":")
    if not colon or not port.isdecimal() or not 0 < int(port) < 2**16:
        raise UserError(f"{url}: no port number between 1 and 65535 at its end; use {_FORMS}")
    try:
        found = socket.getaddrinfo(host or "127.0.0.1", int(port), socket.AF_INET, socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        raise UserError(f"{url}: host {host!r} is not known; check the name or give its IPv4 address") from None
    address: tuple[str, int] = found[0][4][:2]  # type: ignore[assignment]
    return address


class TelemetryLog:
    """A telemetry log (.tlog) as ground stations, mavlogdump and MAVExplorer read it. Folders are made as needed."""

    def __init__(self, url: str, path: Path) -> None:
        self._url = url
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("wb")
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UserError(f"{url}: the log can't be written there ({reason}); choose another path") from None

    def send(self, time_us: int, frames: Sequence[bytes]) -> None:
        """Append the frames. Raises UserError when the disk takes no more."""
        stamp = _STAMP.pack(max(0, min(2**64 - 1, time_us)))
        try:
            self._file.write(b"".join([stamp + frame for frame in frames]))
        except OSError as error:
            raise UserError(f"{self._url}: the log can't be written any further ({error.strerror})") from None

    def close(self) -> None:
        """Write what is buffered and close the file."""
        try:
            self._file.close()
        except OSError as error:
            raise UserError(f"{self._url}: the end of the log can't be written ({error.strerror})") from None


class UdpOut:
    """Datagrams of one frame each to one address, whether or not anybody is there."""

    def __init__(self, url: str, address: tuple[str, int]) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.connect(address)
        except OSError as error:
            self._socket.close()
            raise UserError(f"{url}: can't send there ({error.strerror}); check the address") from None

    def send(self, time_us: int, frames: Sequence[bytes]) -> None:
        """Send what the network takes."""
        for frame in frames:
            # Refused, unreachable, buffer full: the peer's loss, and it may come back.
            with contextlib.suppress(OSError):
                self._socket.send(frame)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class _Peer:
    """The other end of a TCP connection, never waited for."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._rest = b""  # of a frame cut by a full buffer: it goes first, or the peer would lose its place

    def send(self, data: bytes) -> bool:
        """Send ``data``, or drop it when the peer has not yet taken the data before; False when the peer is gone."""
        data = self._rest or data
        try:
            self._discard_input()
            self._rest = data[self._socket.send(data) :]
        except BlockingIOError:
            pass
        except OSError:
            return False
        return True

    def _discard_input(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                if not self._socket.recv(4096):
                    raise ConnectionResetError("closed by the peer")

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._discard_input()  # unread input would make the system throw away what is still under way
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
        self._peer: _Peer | None = _Peer(connection)

    def send(self, time_us: int, frames: Sequence[bytes]) -> None:
        """Send what the station takes."""
        if self._peer is not None and not self._peer.send(b"".join(frames)):
            self.close()

    def close(self) -> None:
        """Close the connection."""
        if self._peer is not None:
            self._peer.close()
            self._peer = None


class TcpServer:
    """A port at which any number of ground stations may connect, at any time."""

    def __init__(self, url: str, address: tuple[str, int]) -> None:
        try:
            self._listener = socket.create_server(address)
        except OSError as error:
            raise UserError(
                f"{url}: can't listen there ({error.strerror}); end what uses the port or choose another"
            ) from None
        self._listener.setblocking(False)
        self._peers: list[_Peer] = []

    def send(self, time_us: int, frames: Sequence[bytes]) -> None:
        """Let waiting stations in, then send each what it takes."""
        with contextlib.suppress(OSError):
            while True:
                self._peers.append(_Peer(self._listener.accept()[0]))
        data = b"".join(frames)
        for peer in list(self._peers):
            if not peer.send(data):
                peer.close()
                self._peers.remove(peer)

    def close(self) -> None:
        """Close the port and every connection."""
        self._listener.close()
        while self._peers:
            self._peers.pop().close()
