"""An attitude that is not the vehicle's is told by the gyros; against rotations of scipy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nav.samples import Array, ImuSamples
from testbed.feeds.log import Reference
from testbed.feeds.turning import turns_otherwise

T = np.arange(1, 6001) / 100
RATE_B = 0.2 * np.column_stack([np.sin(0.7 * T), 0.5 * np.cos(0.9 * T), 1.0 + np.sin(0.3 * T)])
BIAS = np.radians([0.5, -0.4, 0.5])  # of gyros that nobody calibrated


@pytest.fixture(scope="module")
def attitudes() -> Rotation:
    flown = [Rotation.from_euler("ZYX", [2.0, 0.1, -0.2])]
    for rate in RATE_B:
        flown.append(flown[-1] * Rotation.from_rotvec(rate / 100))
    return Rotation.concatenate(flown[1:])


def told(q_nb: Array, silent: slice = slice(0)) -> str:
    """What is said of a reference at 10 Hz with these quaternions (6000, 4), one that says nothing for a while."""
    rng = np.random.default_rng(5)
    q_nb = q_nb.copy()
    q_nb[silent] = np.nan
    increments = (RATE_B + BIAS + 0.02 * rng.normal(size=RATE_B.shape)) / 100
    unit = ImuSamples(T, np.full(len(T), 0.01), increments, np.zeros((len(T), 3)))
    return turns_otherwise(Reference("reference", T[9::10], {"q_nb": q_nb[9::10]}), {"imu": unit})


def test_an_attitude_that_turns_as_gyros_feel_is_not_doubted(attitudes: Rotation) -> None:
    q_nb = attitudes.as_quat(scalar_first=True)
    assert told(q_nb) == ""
    assert told(-q_nb, slice(1000, 4000)) == ""
    assert told((Rotation.from_euler("z", 1.0) * attitudes).as_quat(scalar_first=True)) == ""  # only a heading


@pytest.mark.parametrize("wrong", [
    lambda r: r.inv().as_quat(scalar_first=True),
    lambda r: r.as_quat(),
    lambda r: Rotation.from_euler("ZYX", r.as_euler("ZYX") * [-1, 1, 1]).as_quat(scalar_first=True),
    lambda r: Rotation.from_euler("ZYX", np.radians(r.as_euler("ZYX"))).as_quat(scalar_first=True),
], ids=["from n to b", "scalar last", "heading to the left", "degrees"])  # fmt: skip
def test_an_attitude_that_does_not_is_told(attitudes: Rotation, wrong: Callable[[Rotation], Array]) -> None:
    said = told(wrong(attitudes))
    assert said.startswith("reference turns otherwise than the gyros of imu feel, by ")


def test_nothing_is_told_by_a_rest_or_by_too_few_rows(attitudes: Rotation) -> None:
    wrong = attitudes.inv().as_quat(scalar_first=True)
    assert told(wrong, slice(500, 6000)) == ""
    still = ImuSamples(T, np.full(len(T), 0.01), np.tile(BIAS / 100, (len(T), 1)), np.zeros((len(T), 3)))
    at_rest = np.tile([1.0, 0.0, 0.0, 0.0], (600, 1))
    assert turns_otherwise(Reference("reference", T[9::10], {"q_nb": at_rest}), {"imu": still}) == ""
    assert turns_otherwise(Reference("reference", T, {"lat": T}), {"imu": still}) == ""
