"""An ear for what an autopilot says of itself over MAVLink, beside the protocol by which it takes our sensors."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Mapping

from testbed.bridges.address import address, bound
from testbed.mavlink.encode import Encoder
from testbed.mavlink.orders import armed, asked, typed
from testbed.mavlink.vehicle import VehicleState

DEFAULT = "udpin:127.0.0.1:14540"
MOST_DATAGRAMS = 10_000  # heard at once
STATION = 255  # system of those who command
ARM = "commander arm -f"


class Listener:
    """Hears at a UDP address; ``told`` is what came of it. Raises UserError when the address is none, or is taken."""

    def __init__(self, url: str) -> None:
        self.state = VehicleState()
        self._encoder = Encoder(system=STATION)
        self._speaker: tuple[str, int] | None = None
        self._socket = bound(url, address(url, "udpin", DEFAULT), socket.SOCK_DGRAM)

    def listen(self, system: int, seconds: float = 0.0) -> None:
        """Take what is there of a ``system``, and what comes within ``seconds`` of wall time."""
        until = time.monotonic() + seconds
        for _ in range(MOST_DATAGRAMS):
            self._socket.settimeout(max(0.0, until - time.monotonic()))
            try:
                datagram, speaker = self._socket.recvfrom(65536)
            except OSError:  # there is no more
                return
            if self.state.hear(datagram, system):
                self._speaker = speaker

    def arm_px4(self, system: int) -> None:
        """Have a PX4 that has spoken armed, whatever its checks say.

        Its shell does that; a command over MAVLink is checked even where it says that it is by force.
        """
        self._say(typed(self._encoder, system, ARM))

    def arm_ardupilot(self, system: int) -> None:
        """Have an ArduPilot that has spoken armed, whatever its checks say."""
        self._say(armed(self._encoder, system))

    def ask(self, system: int) -> None:
        """Have an ArduPilot that has spoken say where it is, which it does when it is asked."""
        for frame in asked(self._encoder, system):
            self._say(frame)

    def _say(self, frame: bytes) -> None:
        if self._speaker is not None:
            with contextlib.suppress(OSError):  # it is said again until it was heard
                self._socket.sendto(frame, self._speaker)

    def close(self) -> None:
        """Close the port."""
        self._socket.close()


def listeners(addresses: Mapping[str, str]) -> dict[str, Listener]:
    """One for each of the ``addresses`` by name, or none at all. Raises UserError as one does."""
    with contextlib.ExitStack() as opened:
        found = {name: opened.enter_context(contextlib.closing(Listener(url))) for name, url in addresses.items()}
        opened.pop_all()
    return found
