"""One interrupt ends a command: SIGINT, which is what Ctrl-C sends, and SIGTERM alike.

It is raised once, in the main thread. Python hears of a signal between two of its own instructions, and what is raised
in a callback is lost: whoever has not ended `GRACE_S` later is ended as it is, from a thread beside it.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from testbed.errors import printable

GRACE_S = 2.0  # to close files and to end other processes
SIGNALS = (signal.SIGINT, signal.SIGTERM)
AGAIN_S = 0.01
# What kernels call as they return, where most signals are heard, and what their compiler calls: what is raised there
# becomes a SystemError of theirs, or is lost.
CALLED_BACK = {"_numba_unpickle", "_raw_object_cache_notify", "_raw_object_cache_getbuffer"}
_SHOW_CURSOR = "\x1b[?25h"  # which a progress bar hides

_left: list[Callable[[], str]] = []  # what the contexts that are open leave behind, the innermost last
_last: list[Callable[[], object]] = []  # what is to be done though no context is left in order
_announced = False
_held = False
_program = False  # whether this process is a command's, and not another's that runs one
_waiting: list[int] = []  # signals that came in the meantime


class Interrupted(BaseException):
    """Raised by a signal; ``exit_code`` is 128 and its number, as shells have it.

    No KeyboardInterrupt: libraries have ideas of their own of what that means.
    """

    def __init__(self, number: int = signal.SIGINT) -> None:
        super().__init__(number)
        self.exit_code = 128 + number


INTERRUPTS = (Interrupted, KeyboardInterrupt)  # which are nobody's own to take


def end_at_once() -> None:
    """From now on each of `SIGNALS` ends this process there and then, with a line: before anything is begun.

    Who is forked off, as by a pool of the user's own, inherits neither that nor what comes later.
    """
    global _program
    _program = True
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_as_ever)
    for one in SIGNALS:
        if signal.getsignal(one) is not signal.SIG_IGN:
            signal.signal(one, _end)


def _end(number: int, frame: object) -> None:
    _tell()
    os._exit(128 + number)


def wait_for_nobody(code: object) -> None:
    """Once the main thread has ended, end this process with ``code`` and a line where Python waits for other threads.

    Those that the user began in an estimator or a sensor, such as a reader of a port, may know of no end.
    """
    if not _program:
        return
    number = code if isinstance(code, int) else int(code is not None)
    threading.Thread(target=_end_alone, args=(number,), daemon=True, name="end").start()


def _end_alone(code: int) -> None:
    time.sleep(GRACE_S)
    going_on = [one.name for one in threading.enumerate() if not (one.daemon or one is threading.main_thread())]
    if not going_on:
        return
    with suppress(Exception):  # nobody may listen any more
        sys.stdout.flush()
        told = f"ended, though threads still ran: {', '.join(going_on)}: end them, or make them daemon threads"
        print(f"testbed: {printable(told)}", file=sys.stderr, flush=True)
    os._exit(code)


def _as_ever() -> None:
    """In a process that was forked: a signal ends it, without a word."""
    signal.set_wakeup_fd(-1)
    for one in SIGNALS:
        signal.signal(one, signal.SIG_DFL)


def left_to_others() -> None:
    """In a process that was forked: SIGINT is for who began it, SIGTERM ends this one alone, and nobody else hears."""
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


@contextmanager
def heeded() -> Iterator[None]:
    """While the context lasts, the first of `SIGNALS` raises `Interrupted`, and the watch over the end begins.

    What this process was started to ignore, as in the background of a shell, it goes on ignoring.
    """
    mine = [one for one in SIGNALS if signal.getsignal(one) is not signal.SIG_IGN]
    heard, tell = os.pipe()
    os.set_blocking(tell, False)
    interrupted = 0  # the signal

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal interrupted
        if _in_callback(frame):
            threading.Timer(AGAIN_S, os.kill, (os.getpid(), number)).start()
            return
        interrupted = number
        for one in mine:
            signal.signal(one, signal.SIG_IGN)
        if _held:
            _waiting.append(number)
            return
        raise Interrupted(number)

    before = {one: signal.getsignal(one) for one in mine}
    awakened, unraisable = signal.set_wakeup_fd(tell, warn_on_full_buffer=False), sys.unraisablehook
    sys.unraisablehook = lambda what: None if isinstance(what.exc_value, Interrupted) else unraisable(what)
    threading.Thread(target=_watch, args=(heard,), daemon=True, name="interrupts").start()
    try:
        with leaving():
            for one in mine:
                signal.signal(one, interrupt)
            yield
    except SystemExit as end:
        if interrupted:  # nothing is left to be closed, and to take everything down in order can take seconds
            code = end.code if isinstance(end.code, int) else 0
            if not _announced:  # what was raised was lost, and the command went on to its end
                _tell()
                code = code or 128 + interrupted
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
        raise
    finally:
        if not interrupted:  # otherwise the watch goes on until the process has ended
            for one, handler in before.items():
                signal.signal(one, handler)
            signal.set_wakeup_fd(awakened)
            sys.unraisablehook = unraisable
            os.close(tell)


def _in_callback(frame: FrameType | None) -> bool:
    """Whether what goes on there was called by compiled code."""
    while frame is not None:
        if frame.f_code.co_name in CALLED_BACK:
            return True
        frame = frame.f_back
    return False


@contextmanager
def held() -> Iterator[None]:
    """A signal in this context is raised at its end: to start a process, and to note that it was, is one thing.

    At the end of the outermost such context; an error there ends the command by itself.
    """
    global _held
    outer, _held = _held, True
    try:
        yield
    except BaseException:
        _waiting.clear()
        raise
    finally:
        _held = outer
    if _waiting and not outer:
        raise Interrupted(_waiting.pop())


@contextmanager
def leaving(what: Callable[[], str] = str) -> Iterator[None]:
    """An interrupt in this context ends the command with its exit code and one line: ``what`` it leaves behind."""
    _left.append(what)
    try:
        yield
    except INTERRUPTS as interrupt:
        _tell()
        raise SystemExit(interrupt.exit_code if isinstance(interrupt, Interrupted) else 130) from None
    finally:
        _left.remove(what)


@contextmanager
def lastly(do: Callable[[], object]) -> Iterator[None]:
    """While the context lasts, ``do`` is called, in a thread, before the process is ended as it is."""
    _last.append(do)
    try:
        yield
    finally:
        _last.remove(do)


def taken() -> None:
    """An interrupt is how a command ends that goes on until then: it is in order, and needs no line."""
    global _announced
    _announced = True


def _tell() -> None:
    global _announced
    _announced = True
    what = _left[-1]() if _left else ""
    print(f"testbed: interrupted{': ' if what else ''}{printable(what)}", file=sys.stderr, flush=True)


def _watch(heard: int) -> None:
    """Wait for a signal, or the end of the pipe that it would be heard on; then for the process to end."""
    number = os.read(heard, 1)
    if not number:
        os.close(heard)
        return
    select.select([], [], [], GRACE_S)
    for do in _last:
        with suppress(Exception):
            do()
    if sys.stderr.isatty():
        print(end=_SHOW_CURSOR, file=sys.stderr)
    if not _announced:
        with suppress(Exception):
            _tell()
    os._exit(128 + number[0])
