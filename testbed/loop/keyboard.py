"""Keys on the terminal that direct a run while it goes on."""

from __future__ import annotations

import os
import select
import termios
import tty
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from testbed.loop.requests import End, Faster, Request, Restart, Step, Toggle

HELP = "keys: space pauses and resumes, s steps 1 s, + and - change the speed, r restarts, q ends"
MEANT: Mapping[str, Request] = {
    " ": Toggle(),
    "s": Step(1.0),
    "+": Faster(2.0),
    "=": Faster(2.0),  # the same key without shift
    "-": Faster(0.5),
    "r": Restart(),
    "q": End(),
}


class Keyboard:
    """What the keys pressed on terminal ``fd`` ask for."""

    def __init__(self, fd: int) -> None:
        self._fd = fd

    def requests(self) -> Sequence[Request]:
        """What has been asked for since the last call; never waits."""
        asked: list[Request] = []
        while _in_front(self._fd) and select.select([self._fd], [], [], 0)[0]:
            try:
                keys = os.read(self._fd, 64)
            except OSError:  # the terminal has gone
                break
            if not keys:
                break
            if not keys.startswith(b"\x1b"):  # an arrow or the like, of several letters
                asked += [MEANT[key] for key in keys.decode("ascii", "ignore") if key in MEANT]
        return asked


@contextmanager
def keys(fd: int = 0) -> Iterator[Keyboard | None]:
    """The keyboard of terminal ``fd`` while the context lasts; None when it is no terminal, or another's.

    Keys then come one by one and unseen; however the context ends, the terminal is as it was.
    """
    if not (os.isatty(fd) and _in_front(fd)):
        yield None
        return
    before = termios.tcgetattr(fd)
    try:
        tty.setcbreak(fd, termios.TCSANOW)
        yield Keyboard(fd)
    finally:
        if _in_front(fd):
            termios.tcsetattr(fd, termios.TCSANOW, before)


def _in_front(fd: int) -> bool:
    """Whether this process may use the terminal: in the background it would be stopped for it."""
    try:
        return os.tcgetpgrp(fd) == os.getpgrp()
    except OSError:
        return False
