"""What receivers and the wind say against a federation whose filters refuse every fix."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from nav.aids import GnssAid
from nav.aids.gnss import has_velocity
from nav.detection import PROBATION_S, RECOVERY_S, SURE, GnssMonitor, Verdict
from nav.error_model import MOTION, POS, VEL
from nav.local_filter import LocalFilter
from nav.samples import Array, GnssSample, Outcome, Sample, UpdateReport
from nav.state import State

REFUSAL_GAP_S = 10.0  # without a refused position for longer, the refusals begin anew
REFUSED = (Outcome.OUTSIDE_GATE, Outcome.ISOLATED)


class Doubts:
    """How long every position was refused, one `GnssMonitor` for each receiver, and the wind that is remembered.

    The filters give in when every position was refused for ``patience_s``, or when the wind that the first filter with
    airspeed remembers speaks for the fixes.

    ``off`` (9,) is by how much the latest fixes, which agree with each other, contradict the estimate; zeros where none
    do. Receivers without velocity say nothing.
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
        self.off = np.zeros(MOTION)
        self._patience_s = patience_s
        self._refused_since = self._last_refused = -math.inf  # positions, without one fused in between

    def fused(self) -> None:
        """A position was fused, or the filters gave in."""
        self._last_refused = -math.inf

    def overruled(self, state: State, sample: Sample, nu: Array, report: UpdateReport) -> bool:
        """Whether to believe a fix against the filters, given its innovation ``nu`` (3,) and what became of it."""
        lasting = report.weight == 0 and self._refused(sample.t)
        return self._witnessed(state, sample, nu, report.outcome) or lasting

    def _refused(self, t: float) -> bool:
        """Whether every position was refused for so long that the filters must be wrong, this one at ``t`` [s] too."""
        if t - self._last_refused > REFUSAL_GAP_S:
            self._refused_since = t
        self._last_refused = t
        return t - self._refused_since >= self._patience_s

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
        self.off[:] = 0.0
        if monitor.contradicted:
            self.off[POS : POS + 3], self.off[VEL : VEL + 3] = nu, sample.v_n - state.v_n
        return verdict is Verdict.RECOVER and odds >= SURE
