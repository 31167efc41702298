"""Which part of the product the processor time of a call goes to."""

from __future__ import annotations

import os
import signal
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import testbed

EVERY_S = 0.001
ROOMS = ("motion", "sensors", "estimators", "record")
HOUSE = str(Path(testbed.__file__).parent)


def shares(work: Callable[[], object]) -> dict[str, float]:
    """Processor seconds of ``work`` in each of `ROOMS`, and in the "rest".

    The stack is looked at every millisecond: the outermost room on it pays. Processes that ``work`` starts are the
    motion's, which is flown ahead in one.
    """
    spent: Counter[str] = Counter()
    last = time.process_time()

    def look(_: int, frame: FrameType | None) -> None:
        nonlocal last
        now = time.process_time()  # a long call of a kernel is one look, and all of its time
        spent[_room(frame)] += now - last
        last = now

    children = sum(os.times()[2:4])
    before = signal.signal(signal.SIGPROF, look)
    signal.setitimer(signal.ITIMER_PROF, EVERY_S, EVERY_S)
    try:
        work()
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)
    spent["motion"] += sum(os.times()[2:4]) - children
    return {room: spent[room] for room in (*ROOMS, "rest")}


def _room(frame: FrameType | None) -> str:
    found = "rest"
    while frame is not None:
        path = frame.f_code.co_filename
        if path.startswith(HOUSE):
            room = path[len(HOUSE) + 1 :].partition(os.sep)[0]
            found = room if room in ROOMS else found
        frame = frame.f_back
    return found
