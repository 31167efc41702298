"""What is said against filters that are too sure: by receivers and the wind, and by reports of another wind."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from nav.aids import GnssAid
from nav.aids.base import OUTSIDE, Ruling
from nav.aids.gnss import has_velocity
from nav.detection import PROBATION_S, RECOVERY_S, SURE, GnssMonitor, Refusals, Verdict, whiten
from nav.error_model import MOTION, POS, VEL
from nav.local_filter import LocalFilter
from nav.samples import Array, GnssSample, Outcome, Sample, UpdateReport, WindSample
from nav.state import State

RULINGS = {
    Verdict.FUSE: Ruling(Outcome.FUSED, weight=1.0),
    Verdict.REJECT: OUTSIDE,
    Verdict.PROBATION: Ruling(Outcome.WITHHELD, "on probation after an outage"),
    Verdict.RECOVER: Ruling(Outcome.FUSED, "outside the gate, but consistent for long: covariance reset", weight=1.0),
}
REFUSED = (Outcome.OUTSIDE_GATE, Outcome.ISOLATED)


class Doubts:
    """How long every position was refused, one `GnssMonitor` for each receiver, and the wind that is remembered.

    The filters give in when every position was refused for ``patience_s``, or when the wind that the first filter with
    airspeed remembers speaks for the fixes. ``fixes`` is what those with velocities say against the filters.
    """

    def __init__(self, filters: Sequence[LocalFilter], patience_s: float, limit: float) -> None:
        self._receivers = {
            aid.sensor: GnssMonitor(math.inf, PROBATION_S, RECOVERY_S, patience_s, limit)
            for filter_ in filters
            for aid in filter_.aids.values()
            if isinstance(aid, GnssAid)
        }
        self._with_air = next((filter_ for filter_ in filters if filter_.wind_memory() is not None), filters[0])
        self._winds = self._with_air.wind_memory()
        self._refusals = Refusals(patience_s)  # of positions
        self.fixes = FixDoubt()
        self._witness = False  # of the latest fix

    def begin(self, t: float) -> None:
        """The filters begin at ``t`` [s]."""
        self.fixes.begin(t, *self._receivers.values())

    def fused(self) -> None:
        """A position was fused."""
        self._refusals.taken()

    def gave_in(self, off: Array, variance: Array, alone: bool) -> None:
        """The filters gave in to fixes; see `FixDoubt.gave_in`."""
        self.fixes.gave_in(self._refusals.since, off, variance, alone and not self._witness)
        self._refusals.taken()

    def trusted(self, sensor: str, t: float, before: float) -> bool:
        """Whether a fix at ``t``, if it is not refused, is simply used when that of the time ``before`` was."""
        sure = self._receivers[sensor].sure(t, before)
        return sure and not (self._winds is not None and self._winds.due(t))

    def used(self, fix: GnssSample) -> None:
        """A `trusted` fix with velocity was used."""
        self._refusals.taken()
        self._receivers[fix.sensor].judge(fix, fix.v_n, fix.sigma_velocity_n, inside_gate=True)
        for other in self._receivers.values():
            other.last_fused = fix.t

    def overruled(self, state: State, sample: Sample, nu: Array, report: UpdateReport) -> bool:
        """Whether to believe a fix against the filters, given its innovation ``nu`` (3,) and what became of it."""
        lasting = report.weight == 0 and self._refusals.too_long(sample.t) and not self.astray(sample)
        self._witness = self._witnessed(state, sample, nu, report.outcome)
        return self._witness or lasting

    def astray(self, sample: Sample) -> bool:
        """Whether a sample is of a receiver whose refused positions contradict its own velocities."""
        receiver = self._receivers.get(sample.sensor)
        return receiver is not None and receiver.astray(sample.t)

    def _witnessed(self, state: State, sample: Sample, nu: Array, outcome: Outcome) -> bool:
        """Whether the wind speaks for a fix that was refused, and that those before it agree with."""
        if not (isinstance(sample, GnssSample) and has_velocity(sample)):
            return False
        monitor, refused = self._receivers[sample.sensor], outcome in REFUSED
        odds = self._with_air.odds(self._winds, state, sample.v_n, sample.t) if refused else 0.0
        verdict = monitor.judge(sample, sample.v_n, sample.sigma_velocity_n, not refused, odds)
        if verdict is Verdict.FUSE:
            self._with_air.remember_wind(self._winds, state, sample.t)
            for other in self._receivers.values():
                other.last_fused = sample.t
        self.fixes.heard(nu, sample.v_n - state.v_n, monitor)
        return verdict is Verdict.RECOVER and odds >= SURE


class FixDoubt:
    """What fixes say against a filter: those that it refuses, and where it was before it gave in to others.

    A receiver that jumps and stays, its velocities as sound as before, was wrong before or is wrong now, and nothing on
    board says which. Errors of receivers last for any time, long or short: let one in 1/T of them last longer than T.
    Then, after T at the first place and s at the second, this one is wrong with the probability

        p = (1/s) / (1/s + 1/T) = T / (T + s).
    """

    def __init__(self) -> None:
        self._refused = np.zeros(MOTION)  # by how much fixes that agree with each other contradict the estimate
        self._off, self._variance = np.zeros(3), np.zeros(3)  # of this place from the first
        self._since, self._lasted = math.nan, 0.0

    def begin(self, t: float, *receivers: GnssMonitor) -> None:
        """A filter begins at ``t`` [s], where one of the ``receivers`` may have jumped to.

        What was doubted before still is, when it begins anew: it is the same receivers that tell it where.
        """
        self._refused[:] = 0.0
        if not math.isfinite(self._since):
            self._since = t
        moved = [receiver for receiver in receivers if receiver.moved is not None]
        if moved and (jump := moved[0].moved) is not None:
            self.gave_in(moved[0].since, *jump, alone=True)

    def heard(self, position: Array, velocity: Array, receiver: GnssMonitor) -> None:
        """The latest fix of a receiver, which has judged it, is off the filter by so much (3,) [m, m/s]."""
        if self.pending and receiver.believed is not None:  # the filter's own position became less sure than that
            self.gave_in(receiver.since, *receiver.believed, alone=True)
        self._refused[:] = 0.0
        if receiver.contradicted:
            self._refused[POS : POS + 3], self._refused[VEL : VEL + 3] = position, velocity

    @property
    def pending(self) -> bool:
        """Whether fixes are refused that agree with each other."""
        return bool(self._refused.any())

    def gave_in(self, t: float, off: Array, variance: Array, alone: bool) -> None:
        """Fixes are believed that lay ``off`` (3,) [m], known to a ``variance`` (3,) [m^2], and from ``t`` [s] on.

        They did ``alone``, or the filter's velocity or the wind said so as well, which adds no doubt. Those that have
        come back to the first place leave none. One much smaller than those before leaves the time that they have had.
        """
        self._refused[:] = 0.0
        back = np.sum((self._off + off) ** 2) < 0.25 * np.sum(self._off**2)
        if not (alone or back) or not t > self._since:  # it knows of these
            return
        self._off += off
        self._variance += variance
        if not self._lasted or np.sum(off**2) > 0.25 * np.sum(self._off**2):
            self._since, self._lasted = t, t - self._since

    def off(self, t: Array) -> Array:
        """By how much the motion is off or right (N, 9), see `nav.reference.spread`, at the times ``t`` (N,) [s].

        That is by fixes that are refused now, or by the place before, if that is farther.
        """
        off = np.empty((len(t), MOTION))
        off[:] = self._refused
        if self._lasted > 0.0:
            wrong = self._lasted / (self._lasted + t - self._since)
            way = np.sqrt(np.maximum(self._off**2 - self._variance, 0.0)) * np.sign(self._off)
            before = np.sqrt(2.0 * wrong)[:, None] * way
            farther = np.sum(before**2, axis=1) > np.sum(self._refused[POS : POS + 3] ** 2)
            off[farther] = 0.0
            off[farther, POS : POS + 3] = before[farther]
        return off


class WindDoubt:
    """Reports of a wind that a filter without fixes refuses, since it is sure of another: a front may have passed.

    One report may be wrong itself. Until there is another, the motion is in doubt (`off`): with the wind the velocity
    is wrong by as much, and so is the position, by that times the time since the wind changed, which may have been at
    any time since it was last known to be right. Two in a row that agree with each other, by chi-square of two up to
    ``limit``, are believed.
    """

    def __init__(self, limit: float) -> None:
        self._limit = limit
        self._right = -math.inf  # when the wind was last known to be what the filter takes it for
        self._refused: tuple[WindSample, Array, Array] | None = None  # the latest, its variance (2,), its innovation

    def right(self, t: float, told: bool = False) -> None:
        """The wind of ``t`` [s] is known, by a fix or, ``told``, by a report: one refused before is forgotten."""
        if told or t > self._right:
            self._right, self._refused = max(self._right, t), None

    @property
    def pending(self) -> bool:
        """Whether a report was refused of late."""
        return self._refused is not None

    def lasting(self, t: float) -> float:
        """For how long [s] the wind may have been another."""
        return max(t - self._right, 0.0) if math.isfinite(self._right) else 0.0

    def refused(self, sample: WindSample, nu: Array, R: Array) -> bool:
        """Whether a refused report is to be believed, of innovation ``nu`` and variances ``R``, each (2,)."""
        before, self._refused = self._refused, (sample, R, nu)
        if before is None:
            return False
        off = sample.wind_n - before[0].wind_n
        return bool(whiten(off, np.diag(R + before[1]))[1] <= self._limit)

    def off(self, t: float) -> Array:
        """By how much the motion (9,) is off at ``t`` [s] if the latest report is right, zeros where nothing says so.

        The position by the root of its second moment over all times when the wind may have changed.
        """
        off = np.zeros(MOTION)
        if self._refused is not None:
            change = -self._refused[2]
            off[VEL : VEL + 2], off[POS : POS + 2] = change, change * self.lasting(t) / math.sqrt(3.0)
        return off
