"""Reports by rows: the same as one after the other."""

import math

import numpy as np
import pytest

from nav.columns import FusedReports
from nav.samples import Outcome, UpdateReport
from testbed.loop.events import REFUSALS
from testbed.mavlink.verdicts import Verdicts

KINDS = [
    ("gnss", "gnss_position", 3),
    ("gnss", "gnss_velocity", 3),
    ("second", "gnss_position", 3),
    ("baro", "baro", 1),
]
OUTCOMES = Outcome.OUTSIDE_GATE, Outcome.ISOLATED, Outcome.FUSED, Outcome.OUT_OF_RANGE


def pieces(seed, rows):
    """Stretches of fused reports and single ones of all outcomes, each with the row by which it is there."""
    rng = np.random.default_rng(seed)
    found = []
    at = 0
    while at < rows - 1:
        count = int(rng.integers(1, 30))
        due = np.sort(np.minimum(at + rng.integers(0, 20, count), rows - 1))
        at = int(due[-1])
        if rng.random() < 0.3:
            kind = rng.integers(0, len(KINDS), count)
            nis = rng.normal(2.0, 3.0, count)  # some below zero
            found.append(
                (
                    due,
                    FusedReports(KINDS, kind, due * 0.04, np.zeros((count, 3)), np.zeros((count, 9)), nis, nis * 0 + 9),
                )
            )
        else:
            outcome = OUTCOMES[rng.choice(4, p=[0.6, 0.2, 0.1, 0.1])]
            sensor, aid, _ = KINDS[rng.integers(len(KINDS))]
            weight = float(outcome is Outcome.FUSED)
            for row in due:
                nis = float(rng.normal(20, 9))
                report = UpdateReport(row * 0.04, sensor, aid, np.zeros(1), np.eye(1), nis, 9.0, weight, outcome)
                found.append((np.array([row]), report))
    return found


def one_after_the_other(found, rows):
    """What each row has: ratios by aid, and who is isolated and refused."""
    ratios, refused, isolated, told = {}, {}, set(), []
    singles = [
        (int(row), report)
        for due, piece in found
        for row, report in zip(due, piece[:] if isinstance(piece, FusedReports) else [piece], strict=True)
    ]
    for row in range(rows):
        for _, report in (one for one in singles if one[0] == row):
            part = report.sensor, report.aid
            ratios[report.aid] = math.sqrt(report.nis / report.threshold) if report.nis >= 0 else math.nan
            if report.outcome is Outcome.ISOLATED:
                isolated.add(part)
            else:
                isolated.discard(part)
            wrong = report.outcome is Outcome.OUT_OF_RANGE and report.nis > report.threshold
            if report.outcome is Outcome.OUTSIDE_GATE or wrong:
                refused[part] = refused.get(part, 0) + 1
            elif report.weight > 0:
                refused[part] = 0
        long = {sensor for (sensor, _), count in refused.items() if count >= REFUSALS}
        told.append((dict(ratios), {sensor for sensor, _ in isolated}, long))
    return told


@pytest.mark.ci
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("chunk", [1, 7, 600])
def test_rows_have_what_reports_one_after_the_other_come_to(seed, chunk):
    rows = 600
    found = pieces(seed, rows)
    expected = one_after_the_other(found, rows)
    assert any(long for _, _, long in expected)
    assert any(isolated for _, isolated, _ in expected)
    verdicts = Verdicts()
    for first in range(0, rows, chunk):
        last = min(first + chunk, rows)
        own = []
        for due, piece in found:
            inside = np.flatnonzero((due >= first) & (due < last))
            if len(inside):
                part = piece.part(inside[0], inside[-1] + 1) if isinstance(piece, FusedReports) else piece
                own.append((due[inside] - first, part))
        ratios, shut_out = verdicts.read(own, last - first)
        assert len(shut_out) == last - first
        for row in range(first, last):
            newest = {}
            for aid, (at, values) in ratios.items():
                known = [value for k, value in zip(at, values, strict=True) if k <= row - first]
                if known:
                    newest[aid] = known[-1]
            numbers, isolated, long = expected[row]
            assert newest == pytest.approx(numbers, nan_ok=True)
            assert (shut_out[row - first].isolated, shut_out[row - first].refused) == (isolated, long)
