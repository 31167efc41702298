"""Whether a measurement may be believed: fault detectors, the chi-square gate of a filter, and GNSS after an outage.

Every detector has one method, ``step(nu, S, t) -> Decision``, for the innovation ``nu`` (m,), its covariance ``S``
(m, m) by the filter and the time ``t`` [s] of one sample. A sound innovation is zero-mean with covariance S. Residuals
are whitened, ``r = L^-1 nu`` with ``S = L L'``, so that a mean over samples stays one of unit normals when S changes.
A detector holds the state of one sensor: build one for each.

Which one: `ChiSquare` sees a fault in one sample or not at all; `Eraim` is the same test and keeps the sound axes
(`nav.detection.snapshot`); `Sprt` gathers evidence over samples, as Zhou et al. 2025 do (`nav.detection.sequential`,
with what it remembers in `nav.detection.means`); `Glr` finds slow faults sooner and knows best when they end
(`nav.detection.glr`). Both take innovations for white; `LongRunVariance` says how far that is true
(`nav.detection.colour`). `GnssMonitor` decides on the fixes of a receiver (`nav.detection.gnss`), `Refusals` when
anything has been refused for too long (`nav.detection.refusals`).

Sources: Zhou et al. 2025 (SINS/GNSS/odometer, completely reset SPRT; "Eq" in this package), Cui et al. 2022 (ERAIM),
Siegmund, Sequential Analysis (1985). Evidence is a logarithm of a likelihood ratio [nats].
"""

from nav.detection.base import Decision, Detector, Event, Mask, chi_square_threshold, whiten
from nav.detection.colour import LongRunVariance
from nav.detection.glr import Glr, glr_false_alarm, glr_threshold
from nav.detection.gnss import PROBATION_S, RECOVERY_S, GnssMonitor, Verdict
from nav.detection.means import Mean, RunningMean, WindowMean, exponential, plain
from nav.detection.refusals import Refusals
from nav.detection.sequential import Evidence, Quadratic, Recursive, Reset, SampleTest, Sprt
from nav.detection.snapshot import ChiSquare, ChiSquareGate, Eraim, Never, w_tests
from nav.detection.witness import SURE, WindMemory

__all__ = [
    "PROBATION_S",
    "RECOVERY_S",
    "SURE",
    "ChiSquare",
    "ChiSquareGate",
    "Decision",
    "Detector",
    "Eraim",
    "Event",
    "Evidence",
    "Glr",
    "GnssMonitor",
    "LongRunVariance",
    "Mask",
    "Mean",
    "Never",
    "Quadratic",
    "Recursive",
    "Refusals",
    "Reset",
    "RunningMean",
    "SampleTest",
    "Sprt",
    "Verdict",
    "WindMemory",
    "WindowMean",
    "chi_square_threshold",
    "exponential",
    "glr_false_alarm",
    "glr_threshold",
    "plain",
    "w_tests",
    "whiten",
]
