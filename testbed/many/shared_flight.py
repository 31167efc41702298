"""A flight that all runs of a campaign have in common is flown once."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Sequence
from pathlib import Path

from testbed.errors import UserError
from testbed.motion.logged import LogTruth
from testbed.motion.sections import FlightTruth
from testbed.motion.table import save_motion
from testbed.scenario import Scenario


def share_truth(folder: Path, scenarios: Sequence[Scenario]) -> Path | None:
    """Fly once the motion that all runs have in common, if they have, and give the folder where it lies."""
    from testbed.feeds.simulated import motion

    first = scenarios[0]
    if isinstance(first.truth, LogTruth):
        return None  # it is read, not flown
    if not all(same_motion(first, scenario) for scenario in scenarios) or not seed_leaves_motion(first):
        return None
    truth = folder / "truth"
    if not truth.is_dir():
        source = motion(first, first.seed)
        save_motion(source, round(first.duration_s * source.rate_hz) + 1, truth)
        try:
            require_control(source.failure)
        except UserError:
            shutil.rmtree(truth)
            raise
    return truth


def log_digests(scenarios: Sequence[Scenario]) -> list[str]:
    """What tells the logs, tables of wind and maps of these scenarios, if any, from others."""
    files = {Path(file) for one in scenarios if isinstance(one.truth, LogTruth) for file in one.truth.files.values()}
    winds = [one.truth.wind.file for one in scenarios if isinstance(one.truth, FlightTruth)]
    grounds = [one.truth.terrain.file for one in scenarios]
    files |= {Path(file) for file in (*winds, *grounds) if file}
    return [hashlib.sha256(file.read_bytes()).hexdigest() for file in sorted(files) if file.is_file()]


def require_control(failure: str) -> None:
    """A flight that got out of control says nothing about navigation: don't let its numbers in among the others."""
    if failure:
        raise UserError(f"the flight ended early: {failure}")


def same_motion(one: Scenario, other: Scenario) -> bool:
    """Whether both move alike, as far as the seed leaves it."""
    return _moving(one) == _moving(other)


def _moving(scenario: Scenario) -> tuple[object, ...]:
    """All that the motion depends on but the seed, and what is estimated when that is fed back."""
    return scenario.truth, scenario.plan, scenario.duration_s, scenario.autopilot


def seed_leaves_motion(scenario: Scenario) -> bool:
    """Whether the motion is the same for every seed: nothing estimated is fed back, no gust or weather follows it."""
    if scenario.autopilot.feedback.estimators:
        return False
    if not isinstance(scenario.truth, FlightTruth):
        return True
    wind = scenario.truth.wind
    return not wind.drawn and (wind.turbulence == "none" or wind.turbulence_seed is not None)
