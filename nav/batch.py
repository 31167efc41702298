"""Many steps of a filter in one kernel: increments, plain samples, and what it knows on the way.

A call of a kernel from Python costs as much as the update that it does, and what is done in Python about a sample costs
several times that. Most samples are plain: of a sensor that needs no more than its kernel (`nav.aids.base.PlainAid`),
sound, and inside their gate. `follow` takes them one after the other, just as they would be taken one by one, until one
is not what it seemed to be; that is left to the filter.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from copy import copy
from typing import NamedTuple, Protocol, cast

import numpy as np
import numpy.typing as npt

from nav._jit import lean, njit
from nav.aids import MagnetometerAid
from nav.aids.airspeed import AIRSPEED_LIMITS, Silence, is_slow, put_airspeed, put_sideslip, widened
from nav.aids.barometer import PRESSURE_LIMITS, put_barometer, thinness
from nav.aids.base import Kind, PlainAid, well_within
from nav.aids.gnss import is_whole, put_gnss_position, put_gnss_velocity, put_white
from nav.aids.magnetometer import FIELD_LIMITS, put_magnetometer
from nav.columns import Estimated, Estimates, FusedReports, Reported
from nav.detection.base import whiten_in
from nav.earth import pressure_altitude
from nav.error_model import Indices
from nav.increments import (
    ADVANCE,
    COINCIDENT,
    ESTIMATE,
    HORIZON,
    NUMBERS,
    TIME,
    WHAT,
    Increments,
    Steps,
    row_after,
    share,
    take_off,
)
from nav.kalman import innovate_in, scratch
from nav.local_filter import LocalFilter, from_nominal
from nav.monitor import shown_limits
from nav.plan import ANY, SPLIT, Plan, planned
from nav.realignment import Realignment, tilt_is_lost
from nav.reference import PREDICTED_PERIODS, Reference, is_near
from nav.samples import Array, GnssSample, Sample, Status, UpdateReport
from nav.state import State, absorb, draft, parts, propagate

LIMITS = 10  # where the limits of an aid's two parts are among its numbers
REPORT = 16  # step, part, nis, statistic, innovation (3,), S (9,)


class Done(NamedTuple):
    """How far `follow` came: steps, and parts of the next one that were used; of increments the first row that is left,
    and the time; when one was not usable for the last time; reports and estimates that were written.
    """

    steps: int
    parts: int
    row: int
    t: float
    last_bad: float
    reports: int
    estimates: int


class Taker(Protocol):
    """An estimator whose plain steps a `Batch` takes."""

    realignment: Realignment

    def trusted(self, sensor: str, t: float, before: float) -> bool:
        """Whether a sound fix at ``t``, if it is inside its gate, is simply used when the one of the time ``before``
        was.
        """
        ...

    @property
    def pauses_from(self) -> float:
        """The time [s] of samples from which on there is something to do after one and before the next step."""
        ...

    def took(self, sample: Sample) -> None:
        """A sample was used, at least the first part of it, or said that there is no fix.

        Of what is no fix it is told the last of many.
        """
        ...

    def finish(self, sample: Sample, first: int) -> list[UpdateReport]:
        """Use the parts from the ``first`` on of a sample whose others were used."""
        ...

    def status(self, t: float, last_bad: float) -> Status:
        """What it says of itself at ``t`` [s], an increment having been bad for the last time at ``last_bad``."""
        ...

    def told(self, wholes: Array, t: Array, status: Sequence[Status]) -> Estimates:
        """The estimates at ``t`` (N,) of settled states, each the whole of one of ``wholes``, which may be changed."""
        ...


class Batch:
    """Takes the plain steps of an estimator that has these ``filters``, `LocalFilter.row` by row.

    A filter that is not ``closed`` is corrected by itself; then nothing but its own states changes.
    """

    def __init__(self, filters: Sequence[LocalFilter], reference: Reference) -> None:
        self._filters, self._reference = filters, reference
        self._listening = [filter_ for filter_ in filters if filter_.silence is not None]
        self._aids: dict[str, tuple[int, PlainAid, LocalFilter]] = {}  # with their rows in the tables
        self._parts: list[tuple[str, str, int]] = []  # sensor, name and axes of each part of a sample
        first: list[int] = []  # of an aid's parts
        kinds: list[list[int]] = []
        told: list[list[float]] = []
        sensors = [sensor for filter_ in filters for sensor in filter_.aids]
        for filter_ in filters:
            for sensor, aid in filter_.aids.items():
                plain = aid.plain if isinstance(aid, PlainAid) and sensors.count(sensor) == 1 else None
                field = reference.has_field or not isinstance(aid, MagnetometerAid)
                if plain is not None and isinstance(aid, PlainAid) and field:
                    self._aids[sensor] = len(kinds), aid, filter_
                    first.append(len(self._parts))
                    self._parts += [(sensor, name, m) for name, m in aid.parts]
                    starts = filter_.starts[sensor]
                    kinds.append([plain[0], len(aid.parts), *starts, *[-1] * (5 - len(starts)), filter_.row])
                    told.append([*plain[1], *[0.0] * (LIMITS + 2 - len(plain[1]))])
        self._first = np.array(first, np.int64)
        self._kinds, self._models = np.array(kinds, np.int64).reshape(-1, 8), np.array(told).reshape(-1, LIMITS + 2)
        self._wholes = np.empty((0, 0))  # states on the way to estimates, many times as long as these: used again

    def take(
        self, taker: Taker, state: State, last_bad: float, last_fix: float, steps: Steps, ahead: Increments,
        reports: Reported, estimates: Estimated,
    ) -> tuple[int, float]:  # fmt: skip
        """Take the next of ``steps`` as far as they are plain; how many, and when an increment was not usable last.

        The last fix that was used was of the time ``last_fix``.
        """
        plan, silences = self._plan(taker, steps, last_fix)
        if not len(plan):
            return 0, last_bad
        imu, (common, filters, n) = ahead.imu, state.shape
        told = np.empty((2 * len(plan), REPORT))
        asked = np.count_nonzero(plan[:, WHAT] == ESTIMATE)
        if len(self._wholes) < asked:
            self._wholes = np.empty((asked, len(state.whole)))
        wholes, when = self._wholes[:asked], np.empty((asked, 2))
        done = Done(
            *follow(
                state.whole, common, filters, n, *self._reference.moving, imu.t, imu.dt, imu.dtheta, imu.dv, ahead.next,
                ahead.t, ahead.longest, last_bad, plan, self._kinds, self._models, self._reference.field,
                self._filters[0].closed, len(self._filters), taker.realignment.since, told, wholes, when,
            )
        )  # fmt: skip
        ahead.next, ahead.t = done.row, done.t
        if done.reports:
            reports.append(self._reports(plan, told[: done.reports]))
        listening = self._listening
        if silences and done.steps == len(plan):  # they have heard just these
            for filter_, silence in zip(listening, silences, strict=True):
                filter_.silence = silence
            listening = []
        status = self._tell(taker, steps, plan[: done.steps, WHAT], when.tolist(), listening)
        if status:
            drafted = len(status)
            estimates.append(taker.told(wholes[:drafted], when[:drafted, 0], status))
        if not done.parts:
            return done.steps, done.last_bad
        sample = steps.samples[steps.next + done.steps]
        assert sample is not None
        taker.took(sample)
        further = taker.finish(sample, done.parts)
        taker.realignment.hear(sample, further)
        reports += further
        for filter_ in self._listening:
            filter_.stand_in(sample)
        return done.steps + 1, done.last_bad

    @staticmethod
    def _tell(
        taker: Taker, steps: Steps, what: Array, when: Sequence[Sequence[float]], listening: Sequence[LocalFilter]
    ) -> list[Status]:
        """Tell of the samples of the next steps, of which ``what`` was done; the status at each estimate on the way.

        Of fixes and estimates in their order; of another sensor's samples the last, as one says what all do.
        """
        first, plan = steps.next, steps.plan
        stop = first + len(what)
        turns: list[int] = (np.flatnonzero(what == ESTIMATE) + first).tolist()
        for sensor in plan.of:
            own = plan.own(sensor, first, stop)
            if not len(own):
                continue
            if (what[own - first] >= 0).any():
                taker.realignment.took(sensor)
            sample = cast(Sample, steps.samples[own[-1]])
            if isinstance(sample, GnssSample):
                turns += own.tolist()
            else:
                taker.took(sample)
        status, then = [], iter(when)
        for k in sorted(turns):
            fix = steps.samples[k]
            if fix is None:
                status.append(taker.status(*next(then)))
            else:
                taker.took(fix)
        for filter_ in listening:  # of the others nothing was to stand in for it
            assert filter_.silence is not None
            own = plan.own(filter_.silence.sensor, first, stop)
            filter_.silence.hear(plan.rows[own[what[own - first] >= 0], TIME].tolist())
        return status

    def _reports(self, plan: Array, rows: Array) -> FusedReports:
        """The reports on what was just done, of which monitors are told, too."""
        step, part = rows[:, 0].astype(np.int64), rows[:, 1].astype(np.int64)
        what = plan[step, WHAT].astype(np.int64)
        t, nis, statistic = plan[step, TIME], rows[:, 2].copy(), rows[:, 3]
        kind, limit = self._first[what] + part, self._models[what, LIMITS + part]
        for number, (sensor, name, _) in enumerate(self._parts):
            monitor = self._aids[sensor][2].monitors.get((sensor, name))
            if monitor is not None:
                own = np.flatnonzero(kind == number)
                for judged in zip(statistic[own].tolist(), limit[own].tolist(), t[own].tolist(), strict=True):
                    monitor.passed(*judged)
        return FusedReports(
            self._parts, kind, t, rows[:, 4:7], rows[:, 7:], nis, shown_limits(limit, statistic, nis)
        )  # fmt: skip

    def _known(self) -> npt.NDArray[np.bool_]:
        """Which steps may be plain now, by `Plan.aid`; the tables get the limits of today."""
        known = np.zeros(len(self._kinds) + 2, bool)
        known[ANY] = True
        for sensor, (row, _, filter_) in self._aids.items():
            limits = filter_.limits(sensor)
            if limits is not None:
                self._models[row, LIMITS : LIMITS + len(limits)] = limits
                known[row] = True
        return known

    def _plan(self, taker: Taker, steps: Steps, last_fix: float) -> tuple[Array, list[Silence]]:
        """The next of the ``steps`` that look plain, as rows for `follow`; the silences once these have been heard.

        Whether samples are sound, `follow` finds out itself.
        """
        if steps.plan is None:
            steps.plan = planned(steps, {sensor: (row, aid) for sensor, (row, aid, _) in self._aids.items()})
        plan: Plan = steps.plan
        first, known = steps.next, self._known()[plan.aid[steps.next :]]
        stop = first + (len(known) if known.all() else int(known.argmin()))
        rows, pauses_from = plan.rows[first:stop], taker.pauses_from
        if pauses_from < math.inf:
            due = (rows[:, WHAT] >= 0) & (rows[:, TIME] >= pauses_from)
            stop = first + int(due.argmax()) + 1 if due.any() else stop
        for k, sensor in plan.fixes[bisect_left(plan.fixes, (first, "")) : bisect_left(plan.fixes, (stop, ""))]:
            t = float(plan.rows[k, TIME])
            if not taker.trusted(sensor, t, last_fix):
                stop = k
                break
            last_fix = t
        stop, silences = self._heard(steps, plan, stop)
        return plan.rows[first:stop], silences

    def _heard(self, steps: Steps, plan: Plan, stop: int) -> tuple[int, list[Silence]]:
        """Up to which of the next steps before ``stop`` no silence stands in, and the silences once these were heard.

        None are given where one does.
        """
        first, silences = steps.next, self._silences()
        if not silences or stop == first:
            return stop, silences
        until = plan.rows[first:stop, HORIZON].max()
        for silence in silences:
            times = plan.rows[plan.own(silence.sensor, first, stop), TIME].tolist()
            if not silence.hears(times, until):
                break
        else:
            return stop, silences
        silences = self._silences()
        for k, sample in enumerate(steps.samples[first:stop], first):
            if sample is not None and plan.rows[k, WHAT] >= 0:
                for silence in silences:
                    if silence.stand_in(sample) is not None:
                        return k, []  # one sample too many
        return stop, silences

    def _silences(self) -> list[Silence]:
        return [copy(filter_.silence) for filter_ in self._listening if filter_.silence is not None]


@njit
def follow(
    whole: Array, common: int, filters: int, n: int, driven: Indices, decay_rate: Array, variance_rate: Array,
    in_motion: Array, room: Array, work: Array, period: int,
    t: Array, dt: Array, dtheta: Array, dv: Array, row: int, now: float, longest: float, last_bad: float,
    steps: Array, kinds: Indices, told: Array, field: Array, closed: bool, own: int, since: float,
    reports: Array, estimates: Array, when: Array,
) -> tuple[int, int, int, float, float, int, int]:  # fmt: skip
    """Take ``steps`` (K, WIDTH) as far as they are plain: see `Done`. In place on all that is handed over.

    The state and how it moves as of `nav.state.propagate`, the increments of `nav.increments.Increments`; ``kinds`` (A,
    8) and ``told`` (A, 12) of the aids (`_measure`), the last place of the reference ``field`` (6,), whether the
    filters are ``closed``, how many of them are no shadows but the estimator's ``own``, and ``since`` when a missing
    increment may be why a tilt is lost. Into ``reports`` (_, `REPORT`), ``estimates`` (_, whole) and ``when`` (_, 2):
    of each of these its time and that of the last bad increment.
    """
    nu, H, R = np.empty(3), np.empty((3, n)), np.empty(3)
    S, S_one, (_, inverses, updating) = np.empty((3, 3)), np.empty((1, 1)), scratch(3, n)
    one_dt, one_angle, one_push = np.empty(1), np.empty((1, 3)), np.empty((1, 3))
    return _follow(
        whole, common, filters, n, driven, decay_rate, variance_rate, in_motion, room, work, period,
        t, dt, dtheta, dv, row, now, longest, last_bad, steps, kinds, told, field, closed, own, since, reports,
        estimates, when, nu, H, R, S, S_one, inverses, updating, one_dt, one_angle, one_push,
    )  # fmt: skip


@lean
def _follow(
    whole: Array, common: int, filters: int, n: int, driven: Indices, decay_rate: Array, variance_rate: Array,
    in_motion: Array, room: Array, work: Array, period: int,
    t: Array, dt: Array, dtheta: Array, dv: Array, row: int, now: float, longest: float, last_bad: float,
    steps: Array, kinds: Indices, told: Array, field: Array, closed: bool, own: int, since: float,
    reports: Array, estimates: Array, when: Array,
    nu_of: Array, H_of: Array, R_of: Array, S_three: Array, S_one: Array, inverses: Array, updating: Array,
    one_dt: Array, one_angle: Array, one_push: Array,
) -> tuple[int, int, int, float, float, int, int]:  # fmt: skip
    """`follow` with room for what it finds on the way."""
    q_nb, v_n, lla, _, x, P, errors, _, _, rates, _, _ = parts(whole, common, filters, n)
    written = drafted = 0
    for k in range(len(steps)):
        time, what = steps[k, TIME], int(steps[k, WHAT])
        if what >= 0 and not _is_sound(kinds[what, 0], steps[k, NUMBERS:]):
            return k, 0, row, now, last_bad, written, drafted
        stop, settle = row_after(t, steps[k, HORIZON], row), what >= 0
        reached = t[stop - 1] if stop > row else now
        split = (settle or what == SPLIT) and time > reached + COINCIDENT and stop < len(t)
        if stop > row or settle:
            bad = propagate(
                whole, common, filters, n, driven, decay_rate, variance_rate, in_motion, room, work, period,
                dtheta, dv, dt, row, stop, settle and not split, n,
            )  # fmt: skip
            if bad >= 0:
                last_bad = max(last_bad, t[bad])
            row, now = stop, reached
        if what == ADVANCE:
            continue
        if what == ESTIMATE:
            if now > time + COINCIDENT:
                return k, 0, row, now, last_bad, written, drafted
            stop = row if abs(time - now) <= COINCIDENT else row_after(t, time, row)
            further = 0.0 if abs(time - now) <= COINCIDENT else time - max(t[stop - 1], now)
            if further > longest + COINCIDENT:
                return k, 0, row, now, last_bad, written, drafted
            drawn, bad_then, then = estimates[drafted], last_bad, now if stop == row else t[stop - 1]
            draft(drawn, whole, common, filters, n)
            bad = propagate(
                drawn, common, filters, n, driven, decay_rate, variance_rate, in_motion, room, work,
                period * PREDICTED_PERIODS, dtheta, dv, dt, row, stop, further <= COINCIDENT, common,
            )  # fmt: skip
            if bad >= 0:
                bad_then = max(bad_then, t[bad])
            if further > COINCIDENT:
                share(one_dt, one_angle, one_push, dt, dtheta, dv, stop - 1, further / dt[stop - 1])
                bad = propagate(  # not with a literal, for which it would be compiled anew
                    drawn, common, filters, n, driven, decay_rate, variance_rate, in_motion, room, work,
                    period * PREDICTED_PERIODS, one_angle, one_push, one_dt, 0 * row, len(one_dt), further > COINCIDENT,
                    common,
                )  # fmt: skip
                then = time
                if bad >= 0:
                    bad_then = max(bad_then, time)
            when[drafted, 0], when[drafted, 1] = then, bad_then
            drafted += 1
            continue
        if split:
            share(one_dt, one_angle, one_push, dt, dtheta, dv, row, 1 - (t[row] - time) / dt[row])
            take_off(one_dt, one_angle, one_push, dt, dtheta, dv, row)
            bad = propagate(
                whole, common, filters, n, driven, decay_rate, variance_rate, in_motion, room, work, period, one_angle,
                one_push, one_dt, 0 * row, len(one_dt), settle, n,
            )  # fmt: skip
            if bad >= 0:
                last_bad = max(last_bad, time)
            now = time
        if what == SPLIT:
            continue
        if last_bad > since and tilt_is_lost(P, own):
            return k, 0, row, now, last_bad, written, drafted
        for part in range(kinds[what, 1]):
            f, limit = kinds[what, 7], told[what, LIMITS + part]
            plain, m = _measure(
                kinds[what], part, told[what], steps[k, NUMBERS:], q_nb, v_n, lla, x[f], rates, errors, driven, field,
                nu_of, H_of, R_of,
            )  # fmt: skip
            if not plain:
                return k, part, row, now, last_bad, written, drafted
            nu, H, R, S = nu_of[:m], H_of[:m], R_of[:m], S_three if m == 3 else S_one  # no plain part has two axes
            if not closed:
                from_nominal(nu, H, x[f], common)
                innovate_in(P[f], H, R, nu, S, updating[:m], inverses)
                statistic = whiten_in(inverses[:m], inverses[m:], nu, S)
                if not statistic <= limit:
                    return k, part, row, now, last_bad, written, drafted
            threshold = limit if closed else math.inf
            nis = absorb(
                whole, common, filters, n, f, driven, nu, H, R, threshold, closed, S, inverses, updating
            )  # fmt: skip
            if closed:
                statistic = nis
                if not nis <= limit:
                    return k, part, row, now, last_bad, written, drafted
            _report(reports[written], k, part, nu, S, nis, statistic)
            written += 1
    return len(steps), 0, row, now, last_bad, written, drafted


@njit
def _is_sound(kind: int, numbers: Array) -> bool:
    """Whether a sample of these numbers (12,) surely has no `nav.aids.problem`."""
    if kind == Kind.BAROMETER:
        return well_within(numbers[0], PRESSURE_LIMITS)
    if kind == Kind.MAGNETOMETER:
        length = math.sqrt(numbers[0] ** 2 + numbers[1] ** 2 + numbers[2] ** 2)
        return well_within(length, FIELD_LIMITS)
    if kind == Kind.AIRSPEED:
        return well_within(numbers[0], AIRSPEED_LIMITS)
    return is_whole(numbers)


@lean
def _report(report: Array, k: int, part: int, nu: Array, S: Array, nis: float, statistic: float) -> None:
    """Write down what became of a part."""
    m = len(nu)
    report[0], report[1], report[2], report[3] = k, part, nis, statistic
    for i in range(m):
        report[4 + i] = nu[i]
        for j in range(m):
            report[7 + m * i + j] = S[i, j]


@lean
def _measure(
    kind: Indices, part: int, told: Array, numbers: Array, q_nb: Array, v_n: Array, lla: Array, x: Array, rates: Array,
    errors: Array, driven: Indices, field: Array, nu: Array, H: Array, R: Array,
) -> tuple[bool, int]:  # fmt: skip
    """Whether one part of a sample is plain, and how many axes m it has; its innovation (m,), Jacobian (m, n) and
    variances (m,) into ``nu``, ``H`` and ``R``.

    ``kind`` (8,) has what it is, how many parts there are, where states begin (5,), and whose filter's it is; ``told``
    (12,) the numbers of the aid and the limits of its parts, ``numbers`` (12,) those of the sample.
    """
    m = 3 if kind[0] == Kind.GNSS or kind[0] == Kind.MAGNETOMETER else 1
    for i in range(m):
        for j in range(H.shape[1]):
            H[i, j] = 0.0
    if kind[0] == Kind.BAROMETER:
        put_barometer(nu, H, lla, x, kind[2], kind[3], pressure_altitude(numbers[0]))
        thin = thinness(numbers[0])
        R[0] = told[0] * (thin * thin)
        return True, m
    if kind[0] == Kind.MAGNETOMETER:
        put_magnetometer(nu, H, q_nb, x, kind[2], kind[4], kind[3], kind[5], field[3:], numbers[:3])
        for i in range(3):
            R[i] = told[i]
        return is_near(lla, field), m
    if kind[0] == Kind.AIRSPEED:
        plain = not is_slow(numbers[0], v_n, told[2])
        if part == 0:
            put_airspeed(nu, H, q_nb, v_n, lla, x, kind[2], kind[3], kind[4], numbers[0])
            R[0] = told[0] * widened(numbers[0])
            return plain, m
        put_sideslip(nu, H, q_nb, v_n, x, kind[2], kind[3])
        R[0] = told[1]
        return plain, m
    arm = told[6:9]
    if part == 0:
        put_gnss_position(nu, H, q_nb, lla, x, arm, kind[2], numbers[0], numbers[1], numbers[2])
        put_white(R, numbers[6:9], told[:3])
        return True, m
    swings = arm[0] != 0.0 or arm[1] != 0.0 or arm[2] != 0.0
    known = rates[0, 0] != 0.0 or rates[0, 1] != 0.0 or rates[0, 2] != 0.0
    put_gnss_velocity(nu, H, q_nb, v_n, lla, x, rates[0], errors, driven, arm, kind[3], numbers[3:6])
    put_white(R, numbers[9:12], told[3:6])
    return known or not swings, m
