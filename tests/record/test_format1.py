"""Records of the first format, in which what became of a sample stood in words: its outcome is found at loading."""

from __future__ import annotations

import math
from pathlib import Path

import h5py
import numpy as np
import pytest
from worlds import synthetic_run
from worlds.synthetic_run import Errors, circle, scenario

from nav.samples import Outcome
from testbed.record import format1
from testbed.record.columns import FORMAT
from testbed.record.reader import load
from testbed.record.recorder import Recorder
from testbed.score import accuracy, metrics


@pytest.mark.parametrize(
    ("reason", "nis", "weight", "outcome"),
    [
        ("", 2.0, 1.0, Outcome.FUSED),
        ("", 2.0, 1.3, Outcome.FUSED),
        ("", 9.0, 0.4, Outcome.WEAKENED),
        ("left out by the measurement policy", 90.0, 0.0, Outcome.WEAKENED),
        ("outside the gate", 90.0, 0.0, Outcome.OUTSIDE_GATE),
        ("outside the gate", 90.0, 2 / 3, Outcome.OUTSIDE_GATE),
        ("outside the gate, but consistent for long: covariance reset", 90.0, 1.0, Outcome.FUSED),
        ("isolated", 90.0, 2 / 3, Outcome.ISOLATED),
        ("voted out", 90.0, 0.0, Outcome.ISOLATED),
        ("the units left disagree", 90.0, 1.0, Outcome.FUSED),
        ("on probation after an outage", 90.0, 0.0, Outcome.WITHHELD),
        ("position outside the gate", 2.0, 0.0, Outcome.WITHHELD),
        ("position isolated", 2.0, 0.0, Outcome.WITHHELD),
        ("position is not finite", math.nan, 0.0, Outcome.UNSOUND),
        ("how fast the sensor swings about the IMU isn't known before the", 2.0, 0.0, Outcome.WITHHELD),
        ("too slow for the pitot tube", 2.0, 0.0, Outcome.OUT_OF_RANGE),
        ("0.3 s too late", math.nan, 0.0, Outcome.UNSOUND),
    ],
)
def test_words_of_the_first_format(reason: str, nis: float, weight: float, outcome: Outcome) -> None:
    found = format1.outcomes(np.array([reason.encode()], "S64"), np.array([nis]), np.array([weight]))
    assert found.tolist() == [outcome]


def test_a_record_of_the_first_format_is_read_and_scored_as_before(tmp_path: Path) -> None:
    path = tmp_path / "run.nc"
    recorder = Recorder(path, scenario(100.0), 3)
    synthetic_run.record(recorder, circle(100.0), {"ins": Errors()}, ((30.0, 40.0),))
    recorder.close()
    now = load(path)
    with h5py.File(path, "r+") as file:
        assert file.attrs["format"] == FORMAT != format1.FORMAT
        file.attrs["format"] = format1.FORMAT
        reports = file["estimators/ins/innovations"]
        for own in reports.values():
            del own["outcome"]
    before = load(path)
    for aid in accuracy.aids(now, "ins"):
        own = f"estimators/ins/innovations/{aid}"
        assert {Outcome.FUSED, Outcome.OUTSIDE_GATE} >= set(now[f"{own}/outcome"].values.tolist())
        np.testing.assert_array_equal(before[f"{own}/outcome"], now[f"{own}/outcome"])
        assert before[f"{own}/outcome"].attrs == now[f"{own}/outcome"].attrs
    assert metrics.compute(before) == metrics.compute(now)
