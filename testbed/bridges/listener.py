"""An ear for what an autopilot says of itself over MAVLink, beside the protocol by which it takes our sensors."""

from __future__ import annotations

import socket
import time

from testbed.bridges.address import address, bound
from testbed.mavlink.told import Told

DEFAULT = "udpin:127.0.0.1:14540"
MOST_DATAGRAMS = 10_000  # heard at once


class Listener:
    """Hears at a UDP address; ``told`` is what came of it. Raises UserError when the address is none, or is taken."""

    def __init__(self, url: str) -> None:
        self.told = Told()
        self._socket = bound(url, address(url, "udpin", DEFAULT), socket.SOCK_DGRAM)

    def listen(self, system: int, seconds: float = 0.0) -> None:
        """Take what is there of a ``system``, and what comes within ``seconds`` of wall time."""
        until = time.monotonic() + seconds
        for _ in range(MOST_DATAGRAMS):
            self._socket.settimeout(max(0.0, until - time.monotonic()))
            try:
                self.told.hear(self._socket.recv(65536), system)
            except OSError:  # there is no more
                return

    def close(self) -> None:
        """Close the port."""
        self._socket.close()
