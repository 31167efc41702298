"""Times as logs have them: jittered, repeated, out of order, wrapped, with gaps. What is done about each is told.

A counter that wraps goes on; a time that comes twice, is no number, or is far off those before and after is left out;
out of order is put in order. Where time goes back for good, or on by more than any gap, the clock was set or the
vehicle started again: the longer part is kept.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view

from nav.samples import Array, ImuSamples

Rows: TypeAlias = npt.NDArray[np.intp]
Mask: TypeAlias = npt.NDArray[np.bool_]

# After which counters begin anew [s]: 32 bits of microseconds, of milliseconds; 16 of milliseconds; a GPS week; a day.
WRAPS = (2**32 * 1e-6, 2**32 * 1e-3, 2**16 * 1e-3, 604_800.0, 86_400.0)
WRAP_SHARE = 0.02  # of it, that may be lost where it begins anew
STRAY, STRAY_SHARE = 8, 0.01  # rows by which times may be out of order, or that may be far off; of all rows
LONGEST_GAP_S = 3600.0  # beyond which a gap that is longer than all else is none: the clock was set
MUCH = 0.01  # of a stream's rows: who runs the log is told when more are left out
EDGE_S = 1e-6  # times closer than this are one
GAP_PERIODS, GAP_S = 5.0, 0.1  # beyond which rates are not held on
PIECE = 1.5  # usual increments: the longest that there may be
ABOUT, SLOWER = 51, 1.2  # rows about one that tell what is usual there, where that is so much longer than elsewhere
BESIDE = 5  # rows before one and after it that tell what it felt
# A clock that is off by more than any quartz is by temperature runs by a wrong frequency. By how much must be alike in
# half of what is seen, over as long as jitter of 0.1 s is small beside it.
CLOCK_OFF, CLOCK_ALIKE, CLOCK_S = 0.005, 0.2, 30.0


class Loss(str):
    """A note of rows that are left out: more than `MUCH` of a ``stream``."""

    stream: str


class Course(NamedTuple):
    """How a clock went: the ``part`` that is kept, from 0 on, of the ``parts`` between which it was set back.

    It began ``anew`` so often after so long [s].
    """

    part: int = 0
    parts: int = 1
    anew: Mapping[float, int] = {}


def left_out(stream: str, text: str, lost: int, rows: int) -> str:
    """A note of ``lost`` of a stream's ``rows`` that are left out."""
    note = f"{stream}: {text}"
    if lost <= MUCH * rows:
        return note
    loss = Loss(note)
    loss.stream = stream
    return loss


def ordered(
    name: str, stamps: npt.ArrayLike, notes: list[str], heard: tuple[float, float] | None = None
) -> tuple[Array, Rows]:
    """Ascending times [s] of the stamps (N,) of a stream, and the rows that they belong to; what was odd to ``notes``.

    ``notes`` gets a sentence for each kind of thing, beginning with the stream's ``name``. No silence in the time for
    which another stream was ``heard`` [s], on the same clock, is too long.
    """
    return in_parts(name, stamps, notes, heard, Course())[:2]


def in_parts(
    name: str, stamps: npt.ArrayLike, notes: list[str], heard: tuple[float, float] | None, leader: Course
) -> tuple[Array, Rows, Course]:
    """The same, and how the clock went: of as many parts as the ``leader`` has, that is kept which it keeps."""
    t = np.array(stamps, float)
    rows: Rows = np.arange(len(t))

    def keep(kept: Mask, why: str) -> None:
        nonlocal t, rows
        lost = int(np.sum(~kept))
        if lost:
            notes.append(left_out(name, f"{lost} {why}", lost, len(kept)))
            t, rows = t[kept], rows[kept]

    keep(np.isfinite(t), "times are no numbers, and left out")
    if len(t) > 1 and np.median(np.diff(t)) < 0:  # as tables are that begin with the newest row
        notes.append(f"{name}: its times go back from row to row, and are taken from the last row on")
        t, rows = t[::-1], rows[::-1]
    keep(~_astray(t), "times are far off those before and after, and left out")
    t, anew = _unwrapped(name, t, notes)
    edges = _parts(t)
    part, parts = _kept(edges, leader), len(edges) - 1
    kept = slice(edges[part], edges[part + 1])
    if left := len(t) - (kept.stop - kept.start):
        which = f"part {part + 1}, that of the IMU," if parts == leader.parts else "the longest part"
        told = f"time goes back {parts - 1} times: {which} is kept, {left} rows are left out"
        notes.append(left_out(name, told, left, len(t)))
    t, rows = t[kept], rows[kept]
    order = np.argsort(t, kind="stable")
    moved = int(np.sum(np.diff(t) < 0))
    if moved:
        notes.append(f"{name}: {moved} times are out of order, and put in order")
    t, rows = t[order], rows[order]
    keep(np.diff(t, prepend=-np.inf) > 0, "times come again, and are left out")
    set_on = f"times are {LONGEST_GAP_S:g} s and more from all others, a clock that was set: left out"
    keep(_of_one_clock(t, heard), set_on)
    _note_gaps(name, t, notes)
    return t, rows, Course(part, parts, anew)


def _usual(t: Array) -> float:
    """The usual step of times in the order of their rows [s]."""
    steps = np.diff(t)
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0


def _late(usual: float) -> float:
    """By how much a time may be out of order, where steps are usually so long [s]."""
    return max(STRAY * usual, GAP_S)


def _astray(t: Array) -> Mask:
    """Which of times (N,) in the order of their rows are far off, where those about them go on.

    Of the pieces between jumps the chain in which time goes on is kept that has the most rows, where the clock going
    back for good costs as many as may be far off, and a counter that begins anew none: the longest path by pieces.
    """
    usual = _usual(t)
    late, few = _late(usual), max(STRAY, int(STRAY_SHARE * len(t)))
    steps = np.diff(t)
    if not (steps < -late).any():
        return np.zeros(len(t), bool)
    edges = np.array([0, *(np.flatnonzero((steps < -late) | (steps > _gap(usual))) + 1).tolist(), len(t)])
    first, last, count = t[edges[:-1]].tolist(), t[edges[1:] - 1].tolist(), np.diff(edges).tolist()
    most, before = list(count), [-1] * len(count)  # rows of the best chain up to each piece, and the piece before it
    ends: list[float] = []  # ascending, of the pieces up to which no chain that ends as early has as many rows
    best: list[int] = []
    for k, begin in enumerate(first):
        ways = [(0, -1)] if edges[k] <= few else []
        if found := bisect.bisect_right(ends, begin + late):
            ways.append((most[best[found - 1]], best[found - 1]))
        for j in range(max(k - STRAY, 0), k):
            if last[j] - late > begin:
                anew = _begins_anew(t, int(edges[k]), last[j], usual, few)
                ways.append((most[j] - (0 if anew else few + 1), j))
        rows, before[k] = max(ways)
        most[k] += rows
        place = bisect.bisect_right(ends, last[k])
        if not place or most[best[place - 1]] < most[k]:
            beaten = place
            while beaten < len(best) and most[best[beaten]] <= most[k]:
                beaten += 1
            ends[place:beaten], best[place:beaten] = [last[k]], [k]
    off: Mask = np.ones(len(t), bool)
    k = max((k for k in range(len(most)) if len(t) - edges[k + 1] <= few), key=most.__getitem__)
    while k >= 0:
        off[edges[k] : edges[k + 1]] = False
        k = before[k]
    return off


def _wrap(before: float, after: float, usual: float) -> float:
    """After how long [s] the counter began anew that stands just below that first and just above zero then, or 0.

    Or that comes back by so long from anywhere: times may have been moved, as to begin at zero.
    """
    for wrap in WRAPS:
        near = max(WRAP_SHARE * wrap, _gap(usual))
        begins_anew = wrap - near < before <= wrap + EDGE_S and 0 <= after < near
        if begins_anew or abs(before - after - wrap) < WRAP_SHARE * wrap:
            return wrap
    return 0.0


def _begins_anew(t: Array, row: int, before: float, usual: float, few: int) -> bool:
    """Whether times (N,) from a ``row`` on are those of a counter that began anew after ``before``.

    Those of a ``few`` rows on are not back there, nor have most of a few rows before been where it goes on. If no more
    than these are left they go on at once.
    """
    after = float(t[row])
    wrap = _wrap(before, after, usual)
    rows = 1 + min(few, int(wrap / 2 / max(usual, EDGE_S)))
    soon, past = t[row : row + rows], t[max(row - rows, 0) : row]
    back = ((soon >= before) & (soon < before + wrap / 2)).any()
    there = 2 * np.sum((past > after - wrap / 2) & (past <= after)) >= len(past)
    late = len(t) - row <= few and after + wrap - before > _gap(usual)
    return wrap > 0 and not (back or there or late)


def _unwrapped(name: str, t: Array, notes: list[str]) -> tuple[Array, dict[float, int]]:
    """The same with counters that began anew going on, and how often after how long they did.

    One that comes back to where it was did not begin anew.
    """
    usual, whole = _usual(t), np.zeros(len(t))
    edges = [*(np.flatnonzero(np.diff(t) < -_late(usual)) + 1).tolist(), len(t)]
    count: dict[float, int] = {}
    for first, stop in itertools.pairwise(edges):
        before = float(t[first - 1])
        wrap = _wrap(before, float(t[first]), usual)
        comes_back = (np.diff(t[first:stop]) > wrap / 2) & (t[first + 1 : stop] >= before)
        if wrap and not comes_back.any():
            whole[first:] += wrap
            count[wrap] = count.get(wrap, 0) + 1
    for wrap, times in count.items():
        notes.append(f"{name}: the clock began anew after {wrap:g} s, {times} times, and goes on")
    return (t + whole if count else t), count


def _parts(t: Array) -> list[int]:
    """The first row of each stretch in which time does not go back for good, by more than `STRAY` rows' worth.

    And the number of all rows.
    """
    if len(t) <= STRAY:
        return [0, len(t)]
    newest = np.maximum.accumulate(t)
    behind = t < np.concatenate([np.full(STRAY, -np.inf), newest[:-STRAY]])
    behind &= t < newest - GAP_S  # not a burst that came late
    begins = np.flatnonzero(behind & (np.diff(t, prepend=t[0]) < 0))
    return [0, *begins[~_are_shuffled(t, begins, newest[begins])].tolist(), len(t)]


def _kept(edges: list[int], leader: Course) -> int:
    """Which of the parts between ``edges`` is kept: the leader's, where there are as many, else the longest."""
    if len(edges) - 1 == leader.parts:
        return leader.part
    return max(range(len(edges) - 1), key=lambda k: edges[k + 1] - edges[k])


def _are_shuffled(t: Array, rows: Rows, newest: Array) -> Mask:
    """Whether what is about ``rows`` (M,) behind the ``newest`` times (M,) before them is in disorder, and newer after.

    Of a clock that was set back there are twice as many rows in the time that it goes through again.
    """
    near = 2 * STRAY
    about = sliding_window_view(np.pad(t, near, constant_values=np.nan), 2 * near + 1)[rows]
    again = np.count_nonzero((about >= t[rows, None]) & (about <= newest[:, None]), axis=1)
    goes_on = (about[:, near:] >= newest[:, None]).any(axis=1)
    shuffled: Mask = goes_on & (again <= 1.5 * (newest - t[rows]) / _usual(t) + 2)
    return shuffled


def _of_one_clock(t: Array, heard: tuple[float, float] | None) -> Mask:
    """Which of ascending times (N,) are left where gaps are none: longer than `LONGEST_GAP_S` and than all else.

    Where both what is before one and what is after it is of a time for which another stream was ``heard``, it is one.
    """
    first, stop = 0, len(t)
    while stop - first > 1:
        steps = np.diff(t[first:stop])
        worst = int(np.argmax(steps))
        if steps[worst] <= max(LONGEST_GAP_S, float(t[stop - 1] - t[first]) / 2):
            break
        cut = first + worst + 1
        if heard and heard[0] - LONGEST_GAP_S <= t[cut - 1] and t[cut] <= heard[1] + LONGEST_GAP_S:
            break
        first, stop = (first, cut) if cut - first > stop - cut else (cut, stop)
    kept: Mask = np.zeros(len(t), bool)
    kept[first:stop] = True
    return kept


def pace(t: Array, told: Array) -> float | None:
    """How fast the clock of ascending times (N,) [s] runs by a better one, ``told`` (N,), NaN where it is silent.

    Seconds of the first for each of the second; 1 where they agree to `CLOCK_OFF`, None where nothing can be said.
    """
    known = np.isfinite(told)
    t, told = t[known], told[known]
    half = len(t) // 2
    since = told[half:] - told[: len(told) - half]
    long: Mask = since >= CLOCK_S
    if half < STRAY or 2 * long.sum() < len(since):
        return None
    ratios = (t[half:] - t[: len(t) - half])[long] / since[long]
    lower, middle, upper = np.percentile(ratios, [25, 50, 75])
    off = abs(middle - 1)
    return float(middle) if off > CLOCK_OFF and upper - lower < CLOCK_ALIKE * off else 1.0


def _note_gaps(name: str, t: Array, notes: list[str]) -> None:
    steps = np.diff(t)
    if not len(steps):
        return
    gaps = np.flatnonzero(steps > _gap(float(np.median(steps))))
    if len(gaps):
        worst = gaps[np.argmax(steps[gaps])]
        after = t[worst] - t[0]
        said = f"{len(gaps)} gaps, the longest" if len(gaps) > 1 else "a gap"
        notes.append(f"{name}: {said} of {steps[worst]:.3g} s, {after:.1f} s after its beginning")


def _gap(usual: float) -> float:
    """What is a gap, where steps are usually so long [s]."""
    return max(GAP_PERIODS * usual, GAP_S)


def integrated(t: Array, gyro: Array, accel: Array, form: str) -> ImuSamples:
    """Increments from rates (N, 3) [rad/s] and specific forces [m/s^2] at ascending times (N,).

    ``form``: means over the step before (``averaged``), values at the time (``instantaneous``: the trapezoid), or
    ``increments`` themselves, in rad and m/s. The step before the first is taken to be the usual one.
    """
    usual = float(np.median(np.diff(t))) if len(t) > 1 else 1.0
    dt = np.diff(t, prepend=t[:1] - usual)
    if form == "increments":
        return ImuSamples(t, dt, gyro, accel)
    if form == "instantaneous":
        gyro, accel = (np.vstack([x[:1], 0.5 * (x[1:] + x[:-1])]) if len(x) else x for x in (gyro, accel))
    return ImuSamples(t, dt, gyro * dt[:, None], accel * dt[:, None])


def spaced(name: str, stamps: Array, notes: list[str]) -> Array:
    """The stamps (N,) of increments with those that are shared put apart, where the time up to the next has room.

    A row of increments is what was integrated since the row before: where two differ in nothing but their clock's
    resolution, or one has the stamp of the row before, both happened. Without room the row was only told again.
    """
    begins = np.flatnonzero(np.diff(stamps, prepend=np.nan) != 0)
    counts = np.diff(begins, append=len(stamps))
    steps = np.diff(stamps[begins], append=np.nan)
    each = steps / counts
    if not (each > 0).any():
        return stamps
    usual = float(np.median(each[each > 0]))
    roomy = (counts > 1) & (steps >= (counts - 0.5) * usual)
    if not roomy.any():
        return stamps
    notes.append(f"{name}: {np.sum(counts[roomy] - 1)} rows share the time of the one before, and are put after it")
    number = np.arange(len(stamps)) - np.repeat(begins, counts)
    return np.asarray(stamps + number * np.repeat(np.where(roomy, np.minimum(each, usual), 0.0), counts))


def with_holes(name: str, imu: ImuSamples, notes: list[str]) -> ImuSamples:
    """Increments as a table has them, with others where rows are missing: of a step they are its last part alone.

    A step is too long if no others, before it or after it, are as much shorter: times of rows may come early or late;
    nor is one that is as long as most of those about it, of a unit that was slower for a while; nor, where most of them
    do so, one that felt as much as those beside it would have in all its time (`_felt_s`). Up to `GAP_PERIODS` rows are
    as those about them, as no filter aligns on what has holes all the time; more are NaN.
    """
    unknown = int(np.sum(~np.isfinite(np.hstack([imu.dtheta, imu.dv])).all(axis=1)))
    if unknown:
        notes.append(left_out(name, f"increments of {unknown} rows are no numbers, and unknown", unknown, len(imu)))
    if len(imu) < 2:
        return imu
    period = np.full(len(imu), _period(imu.dt))
    if not (imu.dt[1:] > PIECE * period[1:]).any():
        return imu
    from scipy.ndimage import median_filter  # takes long to load, and most have no need of it

    about = median_filter(imu.dt, ABOUT, mode="nearest")
    period = np.where(about > SLOWER * period, about, period)
    rows = 1 + np.flatnonzero(imu.dt[1:] > PIECE * period[1:])
    even = imu.t - np.cumsum(period)
    near = np.arange(STRAY + 1)[:, None]
    later, earlier = even[np.minimum(rows + near, len(imu) - 1)], even[np.maximum(rows - 1 - near, 0)]
    missing = later.min(axis=0, initial=np.inf) - earlier.max(axis=0, initial=-np.inf)
    lacks = missing > period[rows] / 2
    if lacks.any():
        more = _felt_s(imu, imu.dt <= PIECE * period, rows) - (imu.dt[rows] - missing / 2)
        if np.nanmedian(np.append(more[lacks], -np.inf)) > 0:  # it is a unit whose steps differ
            lacks &= ~(more > 0)
    rows, missing = rows[lacks], missing[lacks]
    if not len(rows):
        return imu
    long = missing > GAP_PERIODS * period[rows]
    lost = f"rows are missing in {len(rows)} places, {missing.sum():.3g} s in all: increments are unknown where they "
    lost += f"are more than {GAP_PERIODS:g}, {long.sum()} times, and as those about them elsewhere"
    notes.append(left_out(name, lost, round(float(np.sum(missing / period[rows]))), len(imu)))
    dt = imu.dt.copy()
    dt[rows] -= missing
    rates = [imu.dtheta / dt[:, None], imu.dv / dt[:, None]]
    between = [np.where(long, np.nan, missing / 2)[:, None] * (rate[rows - 1] + rate[rows]) for rate in rates]
    return ImuSamples(
        np.insert(imu.t, rows, imu.t[rows] - dt[rows]), np.insert(dt, rows, missing),
        np.insert(imu.dtheta, rows, between[0], axis=0), np.insert(imu.dv, rows, between[1], axis=0),
    )  # fmt: skip


def _felt_s(imu: ImuSamples, ordinary: Mask, rows: Rows) -> Array:
    """How long (M,) [s] it takes to feel the velocity that ``rows`` (M,) felt, by the `ordinary` ones beside each."""
    known = ordinary & np.isfinite(imu.dv).all(axis=1)
    felt = np.where(known[:, None], np.column_stack([imu.dt, imu.dv]), 0.0)
    sums = np.vstack([np.zeros(4), np.cumsum(felt, axis=0)])
    beside = sums[np.minimum(rows + BESIDE + 1, len(imu))] - sums[np.maximum(rows - BESIDE, 0)]
    dt, dv = beside[:, 0], beside[:, 1:]
    with np.errstate(divide="ignore", invalid="ignore"):  # in free fall nothing tells
        return np.asarray(dt * np.sum(imu.dv[rows] * dv, axis=1) / np.sum(dv * dv, axis=1))


def _period(dt: Array) -> float:
    """Of rows of which some may be missing, or that come in bursts, how long one is [s]."""
    usual = float(np.median(dt))
    ordinary, all_but_gaps = dt[dt <= PIECE * usual], dt[dt <= _gap(usual)]
    return float(np.mean(ordinary if 2 * ordinary.sum() > all_but_gaps.sum() else all_but_gaps))


def begun(imu: ImuSamples, t: float) -> ImuSamples:
    """The same from ``t`` [s] on: before its first increment nothing is known: NaN in steps of the usual length.

    Of a first over a gap in which ``t`` is, the part since then is left.
    """
    if not len(imu):
        return imu
    first, usual = float(imu.t[0] - imu.dt[0]), float(np.median(imu.dt))
    if first < t - EDGE_S and imu.dt[0] > _gap(usual):
        part = np.ones(len(imu))
        part[0] = (imu.t[0] - t) / imu.dt[0]
        return ImuSamples(imu.t, imu.dt * part, imu.dtheta * part[:, None], imu.dv * part[:, None])
    if first - t < EDGE_S:
        return imu
    count = math.ceil((first - t) / usual)
    dt = np.full(count, (first - t) / count)
    unknown = np.full((count, 3), np.nan)
    return ImuSamples(
        np.concatenate([t + np.cumsum(dt), imu.t]), np.concatenate([dt, imu.dt]),
        np.vstack([unknown, imu.dtheta]), np.vstack([unknown, imu.dv]),
    )  # fmt: skip


def bridged(imu: ImuSamples) -> ImuSamples:
    """The same without steps longer than `PIECE` times the usual one.

    What is longer comes in equal pieces, all at its rates; over a gap nothing is known, and increments are NaN up to
    the usual step before its end. The first is as long as any, so that no wait for the next comes as a surprise.
    """
    if len(imu) < 2:
        return imu
    usual = float(np.median(imu.dt))
    most = PIECE * usual
    gap: Mask = np.asarray(imu.dt > _gap(usual))
    if float(imu.dt.max()) <= float(imu.dt[0]) and not gap[0]:
        return imu
    pieces = np.where(imu.dt > most, np.ceil(imu.dt / most), 1.0).astype(int)
    row = np.repeat(np.arange(len(imu)), pieces)
    number = np.arange(len(row)) - np.repeat(np.cumsum(pieces) - pieces, pieces) + 1
    dt = (imu.dt / pieces)[row]
    t = np.where(number == pieces[row], imu.t[row], imu.t[row] - imu.dt[row] + number * dt)
    rates = np.hstack([imu.dtheta, imu.dv]) / imu.dt[:, None]
    rates = rates[row]
    rates[gap[row] & (number < pieces[row])] = np.nan
    dt[0] = max(float(dt.max()), dt[0])
    whole = rates * dt[:, None]
    one: Mask = np.repeat(pieces == 1, pieces)
    one[0] = False
    whole[one] = np.hstack([imu.dtheta, imu.dv])[row[one]]  # as they are, to the last bit
    return ImuSamples(t, dt, np.ascontiguousarray(whole[:, :3]), np.ascontiguousarray(whole[:, 3:]))


def at_times(imu: ImuSamples, other: ImuSamples) -> ImuSamples:
    """Increments of one unit over the intervals of another: what was integrated by their ends, in proportion."""
    rows = np.hstack([imu.dtheta, imu.dv])
    known: Mask = np.asarray(np.isfinite(rows).all(axis=1))
    whole = np.vstack([np.zeros(6), np.cumsum(np.where(known[:, None], rows, 0.0), axis=0)])
    own = np.concatenate([imu.t[:1] - imu.dt[:1], imu.t])
    ends = np.concatenate([other.t[:1] - other.dt[:1], other.t])
    parts = np.diff(np.column_stack([np.interp(ends, own, column) for column in whole.T]), axis=0)
    after = np.clip(np.searchsorted(imu.t, other.t), 0, len(imu) - 1)
    outside: Mask = (other.t > imu.t[-1]) | (other.t - other.dt < imu.t[0] - imu.dt[0])
    parts[outside | ~known[after]] = np.nan
    return ImuSamples(other.t, other.dt, np.ascontiguousarray(parts[:, :3]), np.ascontiguousarray(parts[:, 3:]))


def joined(t: Array, other: Array, most: float) -> tuple[Rows, Rows]:
    """Rows of two ascending series of times that belong together: for each of ``t`` the nearest within ``most`` [s]."""
    if not len(other):
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    right = np.clip(np.searchsorted(other, t), 0, len(other) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(np.abs(other[left] - t) <= np.abs(other[right] - t), left, right)
    rows = np.flatnonzero(np.abs(other[nearest] - t) <= most)
    return rows, nearest[rows]
