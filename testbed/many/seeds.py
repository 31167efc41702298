"""Whether runs differ by their seeds: those of a recorded flight seldom do, and the same run twice tells no more."""

from __future__ import annotations

from collections.abc import Sequence

from testbed.estimators.custom import CustomSection
from testbed.estimators.section import EstimatorSection
from testbed.motion.logged import LogTruth
from testbed.scenario import Scenario
from testbed.sensors.faults import DRAWN


def matter(scenario: Scenario) -> bool:
    """Whether anything in a run may follow its seed: a log's samples do not, whatever its sensors' sections say."""
    if not isinstance(scenario.truth, LogTruth):
        return True
    return any(isinstance(one, DRAWN) for one in scenario.fault) or any(map(_draws, scenario.estimator))


def _draws(section: EstimatorSection) -> bool:
    """Whether an estimator may draw: the errors of a start that is handed over, or what one of the user's likes."""
    return isinstance(section, CustomSection) or getattr(section, "handover", None) is not None


def remarks(scenarios: Sequence[Scenario], runs: int, draw: int) -> list[str]:
    """What to say where of some of ``scenarios`` less is flown than was asked for: ``runs`` of each, of a ``draw``."""
    alike = sum(not matter(one) for one in scenarios)
    if not alike or (runs == 1 and draw == 0):
        return []
    where = f" in {alike} of {len(scenarios)} combinations of values" if alike < len(scenarios) else ""
    each = " of each value" if alike > 1 else ""
    same = f"all runs and draws would be the same, one{each} is flown"
    return [f"nothing in a recorded flight follows the seed{where}: {same}"]
