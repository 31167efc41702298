"""A motion flown in a process of its own: as nothing feeds back to it, flying and navigating can share two cores."""

from __future__ import annotations

import mmap
import multiprocessing
import os
import pickle
import threading
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection

import numpy as np

from testbed import interrupts
from testbed.motion.table import COLUMNS, MotionSource, TruthBlock

SLOTS = 3  # blocks flown ahead, so that neither side waits for the other
ROW = sum(column.width for column in COLUMNS.values())  # numbers


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
        self._shared = _Shared(chunk)
        context = multiprocessing.get_context("fork")
        self._blocks, theirs = context.Pipe()
        flight = (make, self._shared, ticks, theirs, self._blocks)
        self._process = context.Process(target=_fly, args=flight, daemon=True)
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
        except (EOFError, ConnectionResetError):
            raise RuntimeError("the process that flies has died") from None
        if isinstance(received, Exception):
            raise received
        number, tick, rows, self._activity, self.failure = received
        self._block = self._shared.take(number, tick, rows)
        with suppress(OSError):  # it has sent its last
            self._blocks.send_bytes(b"taken")
        self._used = 0
        self._ended = rows == 0


class _Shared:
    """Memory for `SLOTS` blocks of up to ``chunk`` rows, which a process shares with those that it forks."""

    def __init__(self, chunk: int) -> None:
        self.chunk = chunk
        self._slots = np.frombuffer(mmap.mmap(-1, SLOTS * chunk * ROW * 8)).reshape(SLOTS, chunk * ROW)

    def put(self, number: int, block: TruthBlock) -> None:
        """Write the block of this number, column after column."""
        columns = [getattr(block, name).reshape(-1) for name in COLUMNS]
        np.concatenate(columns, out=self._slots[number % SLOTS, : ROW * len(block)])

    def take(self, number: int, tick: int, rows: int) -> TruthBlock:
        """The block of this number, whose first row is ``tick``, as a copy."""
        flat, columns, at = self._slots[number % SLOTS, : ROW * rows].copy(), {}, 0
        for name, column in COLUMNS.items():
            values = flat[at : at + rows * column.width]
            columns[name] = values if column.width == 1 else values.reshape(rows, column.width)
            at += len(values)
        return TruthBlock(tick, **columns)


def _fly(
    make: Callable[[], MotionSource], shared: _Shared, ticks: int, blocks: Connection, other_end: Connection
) -> None:
    """`_share` in a thread, which has a heap of its own.

    Strewn over what was free in that of the process that forked, JSBSim's model takes a tenth longer for each step.
    """
    try:
        interrupts.left_to_others()
        other_end.close()
        thread = threading.Thread(target=_share, args=(make, shared, ticks, blocks), daemon=True)
        thread.start()
        thread.join()
    finally:
        os._exit(0)  # without the parent's exit handlers, or its output buffers


def _sendable(error: Exception) -> Exception:
    """The same with where it was raised; what only this process can make, as JSBSim's own, as text."""
    note = traceback.format_exc()
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        error = RuntimeError(f"{type(error).__name__}: {error}")
    error.add_note(note)
    return error


def _share(make: Callable[[], MotionSource], shared: _Shared, ticks: int, blocks: Connection) -> None:
    """Share blocks and send (number, tick, rows, activity, failure) of each, until one is empty or nobody listens.

    Or an exception in place of that. The last blocks but `SLOTS` have been taken when the next is written.
    """
    try:
        source, rows, number = make(), 1, 0
        while rows:
            block = source.advance(min(shared.chunk, ticks))
            rows = len(block)
            ticks -= rows
            if number >= SLOTS:
                blocks.recv_bytes()
            shared.put(number, block)
            blocks.send((number, block.tick, rows, source.activity(), source.failure))
            number += 1
    except (BrokenPipeError, ConnectionResetError, EOFError):
        pass
    except Exception as error:
        blocks.send(_sendable(error))
    finally:
        os._exit(0)  # while the thread is there: what JSBSim does as one ends is no part of the flight
