"""What becomes of what an attitude filter is given: used, with a report, or refused."""

from __future__ import annotations

import math

import numpy as np

from nav.ahrs.config import KINDS, MAGNETIC_HEADING
from nav.ahrs.state import State
from nav.kalman import update
from nav.samples import Array, MagnetometerSample, Outcome, Sample, UpdateReport


def fuse(s: State, H: Array, R: Array, z: Array, t: float, sensor: str, aid: str) -> UpdateReport:
    """Update the error states with ``z`` (m,) = H x + noise, of variances R (m,)."""
    nu = z - H @ s.x
    S, nis = update(s.x, s.P, H, R, nu, math.inf)
    return UpdateReport(t, sensor, aid, nu, S, nis, math.inf, 1.0, Outcome.FUSED)


def refused(sample: Sample, reason: str) -> UpdateReport:
    """The report on a sample that is not used."""
    aid = MAGNETIC_HEADING if isinstance(sample, MagnetometerSample) else KINDS[type(sample)]
    return UpdateReport(
        sample.t, sample.sensor, aid, np.empty(0), np.empty((0, 0)), math.nan, math.nan, 0.0, Outcome.UNSOUND, reason
    )
