"""Records of the first format, which told what became of a sample in words only (`nav.samples.Outcome` came after it).

The only place that reads those words: an outcome is found for each report when such a record is loaded, and nothing
else need know which format it was. The words below are those of the programs that wrote the format; they never change.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nav.samples import Array, Outcome

FORMAT = "navigation-testbed run 1"
CHANGED = "bits differ where no gust_mps was given: its default was 1.0 then (--set estimator.NAME.gust_mps=1.0)"

WORDS = {
    b"outside the gate": Outcome.OUTSIDE_GATE,
    b"isolated": Outcome.ISOLATED,
    b"voted out": Outcome.ISOLATED,
    b"on probation after an outage": Outcome.WITHHELD,
    b"too slow for the pitot tube": Outcome.OUT_OF_RANGE,
    b"left out by the measurement policy": Outcome.WEAKENED,
}
WITHHELD_FOR = (b"position ", b"how fast the sensor swings")  # how reasons began of samples that were sound themselves


def outcomes(reason: npt.NDArray[np.bytes_], nis: Array, weight: Array) -> npt.NDArray[np.int8]:
    """Outcomes (N,) of reports with these words (N,), statistics and weights."""
    found: npt.NDArray[np.int8] = np.where(weight >= 1.0, Outcome.FUSED, Outcome.WEAKENED).astype(np.int8)
    for words in np.unique(reason).tolist():
        mine = reason == words
        if words in WORDS:
            found[mine] = WORDS[words]
        elif words.startswith(WITHHELD_FOR):
            found[mine & (weight <= 0)] = Outcome.WITHHELD
        else:
            found[mine & (weight <= 0)] = Outcome.UNSOUND
    found[(weight <= 0) & np.isnan(nis) & (found == Outcome.WITHHELD)] = Outcome.UNSOUND
    return found
