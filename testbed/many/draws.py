"""Draws: sets of seeds that have none in common, so that a figure can be had on seeds that nobody looked at before."""

from __future__ import annotations

from testbed.errors import UserError

DRAW = 1_000_000  # seeds from the first of one draw to the first of the next, and the most runs in one
LARGEST_DRAW = 1_000_000_000


def require_draw(number: int, runs: int) -> None:
    """Raises UserError when there is no such draw, or it has not so many seeds."""
    if not 0 <= number <= LARGEST_DRAW:
        raise UserError(f"--draw {number}: give a number from 0 to {LARGEST_DRAW}")
    if runs > DRAW:
        raise UserError(f"--runs {runs}: a draw has {DRAW} seeds")
