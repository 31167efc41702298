"""Flights for the sake of the kernels that they compile: in a process of their own, while a run compiles others."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import warnings
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress

from testbed import interrupts

PR_SET_PDEATHSIG = 1  # prctl(2); only where there is fork, which is on Linux (`testbed.motion.ahead.Ahead.possible`)


class Rehearsal:
    """Flies ``flights`` one after the other in a process of its own; nobody hears what becomes of them.

    What it has compiled by then is on disk for whoever needs it next. `close` ends it, wherever it is. Where there can
    be no further process, nothing is flown.
    """

    def __init__(self, flights: Sequence[Callable[[], object]]) -> None:
        context = multiprocessing.get_context("fork")
        self._process = context.Process(target=_fly, args=(flights, os.getpid()), daemon=True)
        with warnings.catch_warnings(), suppress(OSError):
            warnings.simplefilter("ignore", DeprecationWarning)  # of forks beside threads: see `testbed.motion.ahead`
            self._process.start()

    def close(self) -> None:
        """End the process."""
        if self._process.pid is not None:
            self._process.kill()
            self._process.join()


def _fly(flights: Sequence[Callable[[], object]], parent: int) -> None:
    try:
        interrupts.left_to_others()
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # nobody needs it when who began it has been killed
        if os.getppid() != parent:
            return
        with open(os.devnull, "w", encoding="utf-8") as nobody, redirect_stdout(nobody), redirect_stderr(nobody):
            for stream in (1, 2):
                os.dup2(nobody.fileno(), stream)
            for flight in flights:
                with suppress(Exception):  # the run itself will say so
                    flight()
    finally:
        os._exit(0)  # without the parent's exit handlers, or its output buffers
