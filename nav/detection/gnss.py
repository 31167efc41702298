"""Whether a GNSS fix is to be believed: streaks of fixes that agree, outages, and filters that were too sure."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import NamedTuple

import numpy as np

from nav._jit import njit
from nav.detection.witness import SURE
from nav.earth import STANDARD_GRAVITY, displacement_n
from nav.samples import Array, GnssSample

# The mean of two velocities misses V w^2 dt^3 / 12 of a turn; this covers 0.5 rad/s at 30 m/s [m/s^3].
TURN_ERROR = 0.6
PROBATION_S, RECOVERY_S = 1.0, 4.0  # fixes that agree for so long may be used after an outage, overrule the filter
ASTRAY_S = 10.0  # as long as a slow vehicle needs to show it again
LED_ASTRAY_S = 15.0  # fixes that agree for so long overrule a filter whose velocity they contradict too
SLOW_ERROR = 0.1  # of a velocity, for as long as a streak lasts, at least [m/s]
JUMP_FLOOR = 0.5  # a smaller jump harms nobody: it also covers the swing of an antenna on its lever arm [m]


class Verdict(Enum):
    """What to do with a GNSS fix."""

    FUSE = auto()
    REJECT = auto()  # outside the gate
    PROBATION = auto()  # not to be used before it has been consistent for a while after an outage
    RECOVER = auto()  # outside the gate, but consistent for so long that the filter must be wrong


class Moved(NamedTuple):
    """By how much fixes have moved, along n (3,) [m], and the variance that it is known to (3,) [m^2]."""

    off: Array
    variance: Array


NOT_MOVED = Moved(np.zeros(3), np.zeros(3))


@dataclass
class GnssMonitor:
    """Decides on each GNSS fix so that a good receiver is never shut out for ever and a bad fix never pulls the filter.

    Successive fixes form a streak while each agrees with the one before and with the velocities in between, which
    needs no trust in the filter. A position that stands still, or goes elsewhere than its velocity, may do so from
    one fix to the next: with the first of the streak, or the last that was fused, it must agree as well. While the
    filter is being aided, a fix inside the gate is fused and one outside rejected, and only a streak that stays
    outside for ``patience_s`` is believed against the filter. A filter that an inertial unit has led astray has a wrong
    velocity too, and goes farther away by the second: there `LED_ASTRAY_S` do, which leave `nav.heading_recovery` the
    time to find another attitude, unless the wind is a witness for the filter (`nav.detection.witness`). After an
    outage of ``outage_s`` the filter's covariance is wide enough to swallow a bad first fix, so nothing is fused before
    a streak has lasted ``probation_s``; if it then lies outside the gate, the filter was too sure of itself, and after
    ``recovery_s`` the streak is believed. So it is without an outage where the wind is a witness that the filter was
    led astray, as when a spoofer lets go.
    """

    outage_s: float
    probation_s: float
    recovery_s: float
    patience_s: float
    consistency_gate: float  # chi-square limit for the jump between two fixes, three degrees of freedom
    last_fused: float = -math.inf
    contradicted: bool = False  # by the latest fixes, which agree with each other and lie outside the gate
    believed: Moved | None = None  # of the latest fix, if it was fused: by how much it had `moved`
    unexplained: bool = False  # the last recovery: nothing but the fixes speaks against the filter
    _streak_start: float = math.nan
    _interval: float = math.inf  # the shortest between two epochs, with a fix or without: what the receiver can do
    _heard: float = math.nan  # when the last of them was
    _was_aided: bool = False
    _previous: tuple[GnssSample, Array] | None = None
    _begun: GnssSample | None = None  # the first of the streak, or the last fused
    _moved: Array = field(default_factory=lambda: np.zeros(3))  # since then, by velocities [m]
    _jumped: Array | None = None  # by how much the latest one is off the one before (3,), if they don't agree [m]
    _jumps: Moved = NOT_MOVED  # the sum of these, none being used between
    _strayed: float = -math.inf  # when one last did not agree with its first, or two in a row jumped alike
    _turned: float = 0.0  # and what turns may add to that, over `TURN_ERROR`: the sum of dt^3 [s^3]

    def heard(self, t: float) -> None:
        """The receiver has reported at ``t`` [s], if only that it has no fix."""
        if t > self._heard:  # not the first
            self._interval = min(self._interval, t - self._heard)
        self._heard = t

    def judge(
        self, fix: GnssSample, v_n: Array, sigma_v: Array, inside_gate: bool, odds: float = 0.0, both: bool = False
    ) -> Verdict:
        """Verdict on a sound ``fix`` given its velocity [m/s], 1-sigma, and whether its position is inside the gate.

        ``odds`` are those for the fix against the filter by what else is known [nats]; ``both`` says that its velocity
        is outside its gate as well, and its position where the filter may have been `led` from.
        """
        self.heard(fix.t)
        if not self._continues(fix, v_n, sigma_v):
            before, self._jumped = self._jumped, self._off(fix, v_n)
            # One that stands still falls behind time and again. One that jumps, or jumps back, may be sound again.
            self._strayed = fix.t if before is not None and before @ self._jumped > 0 else -math.inf
            self._add(fix, self._jumped, sigma_v)
            self._begin(fix)
            self._was_aided = fix.t - self.last_fused <= self._longest_gap()
        else:
            self._jumped = None
            if self._strays(fix, sigma_v):
                if self.last_fused >= self._streak_start:
                    self._jumps = NOT_MOVED
                self._begin(fix)
                self._strayed = fix.t
        self._previous = (fix, v_n)
        lasted = fix.t - max(self._streak_start, self.last_fused)
        alone = self._was_aided and odds < SURE and not (both and odds > -SURE)
        wait = self.patience_s if alone else self._wait(odds)
        # a place that stands still is inside a gate that has grown wide, each time that the vehicle comes by
        comes_by = inside_gate and self.astray(fix.t) and fix.t - self.last_fused > self.outage_s
        if comes_by or (not self._was_aided and lasted < self.probation_s):
            verdict = Verdict.PROBATION
        elif inside_gate:
            verdict = Verdict.FUSE
        else:
            verdict = Verdict.RECOVER if lasted >= wait else Verdict.REJECT
        self.contradicted = verdict is Verdict.REJECT and lasted >= self.probation_s
        if verdict is Verdict.RECOVER:  # a jump is none of the filter's, though an outlier has come since
            self.unexplained = alone or (self.moved is not None and odds < SURE and not both)
        self.believed = self.moved if verdict is Verdict.FUSE else None
        if verdict in (Verdict.FUSE, Verdict.RECOVER):
            self.last_fused = fix.t
            self._was_aided = True
            self._count_from(fix)
        return verdict

    @property
    def since(self) -> float:
        """When the streak of the latest fix began [s]."""
        return self._streak_start

    @property
    def moved(self) -> Moved | None:
        """By how much its fixes have jumped, all together, if they have and none was used since."""
        off, variance = self._jumps
        known = self.last_fused < self._streak_start and off.any()
        return self._jumps if known and np.sum(off**2 / variance) > self.consistency_gate else None

    def sure(self, t: float, before: float) -> bool:
        """Whether a fix at ``t`` [s] inside the gate is to be fused whatever it is, if that at ``before`` was."""
        return self._was_aided and t - before <= self.outage_s

    def led(self, t: float, off: Array) -> bool:
        """Whether, at ``t`` [s], a filter may be ``off`` (2,) [m] over ground by what an inertial unit told it since a
        fix was fused last.
        """
        return math.hypot(*off) <= STANDARD_GRAVITY * (t - self.last_fused) ** 2

    def astray(self, t: float) -> bool:
        """Whether, of late, refused positions went elsewhere than the receiver's own velocities, at ``t`` [s]."""
        return t - self._strayed <= ASTRAY_S

    def _wait(self, odds: float) -> float:
        """For how long fixes that do not stand alone must agree to be believed against the filter [s]."""
        return self.recovery_s if not self._was_aided or odds >= SURE else min(LED_ASTRAY_S, self.patience_s)

    def _longest_gap(self) -> float:
        """Without fixes for longer is an outage, unless the receiver is as slow as that [s]."""
        return max(self.outage_s, 2 * self._interval) if math.isfinite(self._interval) else self.outage_s

    def _begin(self, fix: GnssSample) -> None:
        self._streak_start = fix.t
        self._count_from(fix)

    def _count_from(self, fix: GnssSample) -> None:
        self._begun, self._turned = fix, 0.0
        self._moved[:] = 0.0

    def _continues(self, fix: GnssSample, v_n: Array, sigma_v: Array) -> bool:
        """Whether ``fix`` is where the fix before it and the mean of both velocities say."""
        if self._previous is None:
            return False
        before, v0_n = self._previous
        dt = fix.t - before.t
        if dt > self._longest_gap():
            return False
        moved = 0.5 * dt * (v0_n + v_n)
        self._moved += moved
        self._turned += dt**3
        return jump(before, fix, moved, dt * sigma_v, dt**3) <= self.consistency_gate

    def _add(self, fix: GnssSample, off: Array, sigma_v: Array) -> None:
        """Add a jump to those before, if none of their fixes was used; one in a gap is none that anybody knows."""
        before = self._previous[0] if self._previous is not None else fix
        dt = fix.t - before.t
        if self._previous is None or dt > max(PROBATION_S, 2 * self._interval):
            self._jumps = NOT_MOVED
            return
        variance = fix.sigma_position_n**2 + before.sigma_position_n**2 + (dt * sigma_v) ** 2 + JUMP_FLOOR**2
        sum_ = NOT_MOVED if self.last_fused >= self._streak_start else self._jumps
        self._jumps = Moved(sum_.off + off, sum_.variance + variance)

    def _off(self, fix: GnssSample, v_n: Array) -> Array:
        """Where ``fix`` is, seen from where the one before it and the mean of both velocities say (3,) [m]."""
        if self._previous is None:
            return np.zeros(3)
        before, v0_n = self._previous
        way = displacement_n(fix.lat, fix.lon, fix.h, before.lat, before.lon, before.h)
        return np.array(way) - 0.5 * (fix.t - before.t) * (v0_n + v_n)

    def _strays(self, fix: GnssSample, sigma_v: Array) -> bool:
        """Whether the receiver's own velocities lead elsewhere from the first of the streak.

        Where it tells none they are the filter's, which may be wrong: the count begins anew.
        """
        if self._begun is None or self._previous is None:
            return False
        if not (math.isfinite(self._previous[0].v_n[0]) and math.isfinite(fix.v_n[0])):
            self._count_from(fix)
            return False
        drift = (fix.t - self._begun.t) * np.maximum(sigma_v, SLOW_ERROR)
        return jump(self._begun, fix, self._moved, drift, self._turned) > self.consistency_gate


def jump(before: GnssSample, fix: GnssSample, moved: Array, drift: Array, turned: float) -> float:
    """Squared distance, chi-square of three, of a fix from where it ``moved`` (3,) [m] by velocities since one before.

    ``drift`` (3,) [m] is 1-sigma of that, and ``turned`` [s^3] the sum of dt^3.
    """
    return _jump(
        fix.lat, fix.lon, fix.h, before.lat, before.lon, before.h, moved, drift, turned, fix.sigma_position_n,
        before.sigma_position_n,
    )  # fmt: skip


@njit
def _jump(
    lat: float, lon: float, h: float, lat0: float, lon0: float, h0: float, moved: Array, drift: Array, turned: float,
    sigma: Array, sigma_before: Array,
) -> float:  # fmt: skip
    """`jump`, in one kernel."""
    off, squared = displacement_n(lat, lon, h, lat0, lon0, h0), 0.0
    for k in range(3):
        variance = sigma[k] ** 2 + sigma_before[k] ** 2 + drift[k] ** 2 + JUMP_FLOOR**2 + (TURN_ERROR * turned) ** 2
        squared += (off[k] - moved[k]) ** 2 / variance
    return squared
