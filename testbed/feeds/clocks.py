"""One clock for the streams of a table: they keep the same part of it, and count alike how often it began anew."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from nav.samples import Array
from testbed.feeds.stamps import Course, Mask, Rows, in_parts, left_out

TOLD_S = 10.0  # by which a stream may be heard before another, and after it


class Leader(NamedTuple):
    """The stream that the others go by: its ``times`` (N,) [s] at ``rows`` (N,) of its ``column``, and their course."""

    name: str
    column: Any
    times: Array
    rows: Rows
    course: Course


class Clocks:
    """The clock of streams, the first of which, an inertial unit, leads.

    ``heard`` is when such a one was heard [s]: no silence of another in that time is too long.
    """

    def __init__(self, heard: tuple[float, float] | None = None) -> None:
        self.heard = heard
        self._leader: Leader | None = None

    def ordered(self, name: str, column: Any, rows: Rows, stamps: Array, notes: list[str]) -> tuple[Array, Rows]:
        """As `testbed.feeds.stamps.ordered` of the stamps (N,) [s], which are at ``rows`` (N,) of a ``column``.

        Streams of one column agree by its rows. Of others that which is not known is told.
        """
        leader = self._leader
        if leader is None:
            t, kept, course = in_parts(name, stamps, notes, self.heard, Course())
            if len(t):
                self._leader = Leader(name, column, t, rows[kept], course)
            return t, kept
        if column == leader.column:
            inside = np.flatnonzero(_of_its_part(name, rows, leader, notes))
            t, kept, course = in_parts(name, stamps[inside], notes, self.heard, Course())
            kept = inside[kept]
            return t + _turns_by_rows(t, rows[kept], course, leader), kept
        t, kept, course = in_parts(name, stamps, notes, self.heard, leader.course)
        if leader.course.parts > 1 and course.parts != leader.course.parts:
            told = f"its time goes back {course.parts - 1} times, that of {leader.name} {leader.course.parts - 1} times"
            unknown = f"{told}: what is kept may be of another flight: leave all but one out of the file"
            notes.append(left_out(name, unknown, len(t), len(t)))
        return t + _turns_by_time(name, t, course, leader, notes), kept


def _of_its_part(name: str, rows: Rows, leader: Leader, notes: list[str]) -> Any:
    """Which ``rows`` (N,) are among those of the part that the leader keeps."""
    inside = np.ones(len(rows), bool)
    if leader.course.parts > 1:
        inside = (rows >= leader.rows.min()) & (rows <= leader.rows.max())
        if lost := int(np.sum(~inside)):
            told = f"{lost} rows are not of the part that is kept of {leader.name}: left out"
            notes.append(left_out(name, told, lost, len(rows)))
    return inside


def _turns_by_rows(t: Array, rows: Rows, course: Course, leader: Leader) -> float:
    """What is to be added [s] to times (N,) at ``rows`` for whole turns of a counter that the leader's rows have."""
    total = 0.0
    order = np.argsort(leader.rows)
    for wrap in {**leader.course.anew, **course.anew} if len(t) else ():
        apart = np.interp(rows, leader.rows[order], leader.times[order]) - t - total
        total += wrap * round(float(np.median(apart)) / wrap)
    return total


def _turns_by_time(name: str, t: Array, course: Course, leader: Leader, notes: list[str]) -> float:
    """The same of times of another column: so many turns as let it be heard while the leader is; told if others may."""
    total = 0.0
    for wrap in {**leader.course.anew, **course.anew} if len(t) else ():
        own, count = course.anew.get(wrap, 0), leader.course.anew.get(wrap, 0)
        if not own and t[-1] - t[0] > wrap:  # it is no such counter
            continue
        turns = np.arange(-own, count + 1)
        begins, ends = t[0] + total + turns * wrap, t[-1] + total + turns * wrap
        outside = np.maximum(leader.times[0] - begins, 0) + np.maximum(ends - leader.times[-1], 0)
        if outside.min() > max((t[-1] - t[0]) / 2, TOLD_S):  # of another clock, or another time
            continue
        near: Mask = outside <= outside.min() + TOLD_S
        earlier: Mask = (turns < 0) & (begins > leader.times[0])  # none need be: an offset may have been given for that
        likely = turns[near & ~earlier].tolist() or turns[near].tolist()
        taken = min(likely, key=abs)
        if len(likely) > 1:
            others = " or ".join(f"{(k - taken) * wrap:g}" for k in likely if k != taken)
            told = f"its clock begins anew after {wrap:g} s, how often before it was heard is not known"
            notes.append(
                left_out(name, f"{told}: if it is early or late its time needs an offset of {others} s", len(t), len(t))
            )
        elif taken:
            first = name if taken > 0 else leader.name
            notes.append(f"{name}: the clock began anew after {wrap:g} s, {abs(taken)} times before {first} was heard")
        total += taken * wrap
    return total
