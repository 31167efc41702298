"""A motion flown in a process of its own: as nothing feeds back to it, flying and navigating can share two cores."""

from __future__ import annotations

import multiprocessing
import os
import signal
import traceback
import warnings
from collections.abc import Callable
from multiprocessing.connection import Connection

from testbed.motion.table import MotionSource, TruthBlock

PIPE_BYTES = (
    1 << 20
)  # the most that Linux gives anybody: three blocks of 1000 rows, so that neither side waits for the other


class Ahead:
    """The motion source that ``make`` gives, flown some blocks of ``chunk`` rows ahead of who asks for them.

    The rows are those of the source, bit for bit, and so are its errors. `close` ends the process early.
    """

    def __init__(self, make: Callable[[], MotionSource], rate_hz: float, chunk: int, ticks: int) -> None:
        self.rate_hz = rate_hz
        self.failure = ""
        self._activity = ""
        self._block = TruthBlock.empty(0, 0)
        self._used = 0
        self._ended = False
        import fcntl  # of Linux, as is the rest

        context = multiprocessing.get_context("fork")
        self._blocks, theirs = context.Pipe(duplex=False)
        fcntl.fcntl(theirs.fileno(), fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        self._process = context.Process(target=_fly, args=(make, chunk, ticks, theirs, self._blocks), daemon=True)
        with warnings.catch_warnings():
            # Python warns of forks beside other threads, whose locks the child might wait for: this one takes none.
            warnings.simplefilter("ignore", DeprecationWarning)
            self._process.start()
        theirs.close()

    @staticmethod
    def possible() -> bool:
        """Whether there is a second core, and this process may have children."""
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1  # elsewhere forks are not safe
        return cores > 1 and not multiprocessing.current_process().daemon

    def advance(self, ticks: int) -> TruthBlock:
        """The next rows of one block, at most ``ticks``; none when the motion has ended."""
        if self._used == len(self._block) and not self._ended:
            self._receive()
        start, self._used = self._used, min(self._used + ticks, len(self._block))
        return self._block.rows(start, self._used)

    def activity(self) -> str:
        """What is going on at the end of the newest block."""
        return self._activity

    def close(self) -> None:
        """End the process, whether it has flown everything or not."""
        self._blocks.close()
        self._process.kill()
        self._process.join()

    def _receive(self) -> None:
        try:
            received = self._blocks.recv()
        except EOFError:
            raise RuntimeError("the process that flies has died") from None
        if isinstance(received, Exception):
            raise received
        self._block, self._activity, self.failure = received
        self._used = 0
        self._ended = len(self._block) == 0


def _fly(make: Callable[[], MotionSource], chunk: int, ticks: int, blocks: Connection, other_end: Connection) -> None:
    """Send (block, activity, failure) until an empty block has been sent, or an exception, or nobody listens."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # who asked for the motion decides what an interrupt means
    other_end.close()
    try:
        source, rows = make(), 1
        while rows:
            block = source.advance(min(chunk, ticks))
            rows = len(block)
            ticks -= rows
            blocks.send((block, source.activity(), source.failure))
    except BrokenPipeError:
        pass
    except Exception as error:
        error.add_note(traceback.format_exc())
        blocks.send(error)
    finally:
        os._exit(0)  # without the parent's exit handlers, or its output buffers
