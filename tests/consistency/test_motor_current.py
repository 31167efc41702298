"""The wing's motor beside its compass: the throttle changes the field, and claims of heading know it."""

from __future__ import annotations

import numpy as np
import pytest

from testbed import Scenario, error_series, run

pytestmark = pytest.mark.slow


def test_a_heading_beside_a_motor_is_claimed_as_it_errs() -> None:
    """Told a constant stray field only, the filter fitted soft iron to it, and was five times its claim off."""
    flown = ["truth.aircraft=flying_wing", "truth.start.airspeed_mps=18", "expect={}"]
    scenario, squares = Scenario.load("u_turn", flown), []
    for seed in range(970001, 970009):
        errors = error_series(run(scenario, seed=seed), "ins").loc[60:]
        squares.append(float(np.mean(np.square(errors["phi_down_deg"] / errors["sigma_phi_down_deg"]))))
    print("heading, mean square over claim:", np.round(squares, 2))
    assert 0.2 < np.median(squares) < 2.5
