"""Every paper judged again on a draw that nobody has looked at: that of the day."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from testbed import papers
from testbed.papers.draws import Draws

# Rows that hold with room on any draw; with ten draws the interval of a median is that of the second to the ninth.
ROWS = {
    "cheng2020": ("heading on straights, largest", "heading in turns and 10 s after, largest",
                  "ranks with velocity, position, heading, a turn: off by"),
    "cui2022": ("detection delay, longitude step", "largest error after 60 s, velocity north, six faults",
                "largest error after 60 s, pitch, no fault"),
    "jiang2021": ("plain inertial: roll and pitch error, largest", "heading error after 600 s, off the paper's 6.7",
                  "seconds taken for level in the turn, after its first"),
    "zhou2025": ("hard fault at 5 Hz, complete reset: delay", "hard fault at 5 Hz, complete reset: end lag",
                 "north RMSE over the traditional, ramp as printed, SPRT"),
    "zhu2020": ("no feedback, the whole run: std of latitude, robust over traditional",
                "no feedback: largest step at a wrong fix, any state, robust",
                "no feedback: largest step at a wrong fix, any state, traditional"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", papers.IDS)
def test_cheap_rows_hold_on_the_draw_of_the_day(name: str, tmp_path: Path) -> None:
    draws = Draws(int(datetime.now(UTC).strftime("%Y%m%d")) + 1, 10)
    print(f"testbed papers {name} --quick --draw {draws.number}")
    claims = papers.reproduce(papers.find([name]), draws, tmp_path)[name]
    found = {claim.quantity: claim for claim in claims if claim.quantity in ROWS[name]}
    assert len(found) == len(ROWS[name]) == 3
    assert {what: str(claim.interval) for what, claim in found.items() if claim.verdict == "missed"} == {}
