"""The estimators of a scenario, built but not run."""

from testbed import Scenario
from testbed.estimators import registry
from testbed.estimators.lane import Lane


def lanes(scenario: Scenario, seed: int = 0) -> dict[str, Lane]:
    return registry.build(scenario.estimator, scenario.rig(seed))
