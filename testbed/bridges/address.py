"""Where a far end is waited for."""

from __future__ import annotations

import socket

from testbed.errors import UserError
from testbed.mavlink.link import in_use


def address(url: str, kind: str, default: str) -> tuple[str, int]:
    """Host and port of ``kind:HOST:PORT``. Raises UserError, with the ``default`` as an example, when it is none."""
    said, _, where = url.partition(":")
    host, _, port = where.rpartition(":")
    if said != kind or not port.isdecimal() or not 0 <= int(port) < 2**16:
        raise UserError(f"{url}: is no address: give it as {kind}:HOST:PORT, such as {default}")
    try:
        found = socket.gethostbyname(host or "127.0.0.1")
    except OSError as error:
        raise UserError(f"{url}: the host is unknown ({error.strerror or error}): give its number") from None
    return found, int(port)


def bound(url: str, where: tuple[str, int], kind: socket.SocketKind) -> socket.socket:
    """A socket that is bound there. Raises UserError when it can't be."""
    made = socket.socket(socket.AF_INET, kind)
    try:
        if kind == socket.SOCK_STREAM:
            made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind(where)
    except OSError as error:
        made.close()
        raise UserError(in_use(url, error)) from None
    return made
