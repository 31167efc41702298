"""A receiver whose positions move against its own velocities: what it has found, and what detectors are given of it."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.ins import CONSUMER

from nav.aids import GnssAid
from nav.aids.gnss import CONTRADICTION_S, Contradiction
from nav.detection import ChiSquareGate
from nav.local_filter import LocalFilter
from nav.samples import FixType, GnssSample

SIGMA = np.full(3, 0.5)


def fixes(t, down, climb):
    """At rest but for heights: moved ``down`` [m], with the velocity of a ``climb`` [m/s]."""
    return [
        GnssSample(
            one, one, 0.0, 0.0, 100.0 - off, np.array([0.0, 0.0, -climb]), SIGMA, SIGMA, FixType.FIX_3D, 10, 1.0, 1.5
        )
        for one, off in zip(t, down, strict=True)
    ]


def test_it_is_nothing_where_positions_follow_velocities_and_a_step_is_forgotten():
    t = np.arange(0.0, 20.0, 0.2)
    sound, stepped = Contradiction(7.0), Contradiction(7.0)
    assert all((sound.heard(one) < 1e-6).all() for one in fixes(t, -3.0 * t, 3.0))
    found = [stepped.heard(one)[2] for one in fixes(t, np.where(t < 10.0, 0.0, 4.0), 0.0)]
    k = int(np.flatnonzero(t >= 10.0)[0])
    assert found[k] == pytest.approx(16.0, rel=1e-3)
    assert found[k + 10] == pytest.approx(16.0 * np.exp(-2 * (t[k + 10] - t[k]) / CONTRADICTION_S), rel=1e-3)


def test_more_than_a_sound_receivers_explains_nothing_until_it_is_forgotten():
    t = np.arange(0.0, 24.0, 0.2)
    one, down = Contradiction(7.0), np.where(t < 10.0, 0.0, 10.0) + np.where(t < 22.0, 0.0, 3.0)
    found = np.array([one.heard(fix)[2] for fix in fixes(t, down, 0.0)])
    assert not found[t < 16.0].any()
    assert found[t >= 22.0][0] == pytest.approx(9.0, rel=0.1)


def test_it_needs_velocities_and_hears_a_sample_once():
    one = Contradiction(7.0)
    first, last = fixes([0.0, 0.2], [0.0, 6.0], 0.0)
    one.heard(first)
    assert one.heard(last)[2] == pytest.approx(36.0, rel=1e-3)
    assert one.heard(last)[2] == pytest.approx(36.0, rel=1e-3)
    one.heard(replace(last, t=0.4, v_n=np.full(3, np.nan)))
    assert not one.variance.any()


@pytest.mark.parametrize("told", [0.0, 7.0])
def test_only_positions_of_a_receiver_that_jumps_are_judged_wider(told):
    filter_ = LocalFilter(CONSUMER, [GnssAid(largest_jump=told)], ChiSquareGate(1e-3))
    S = np.eye(3)
    for sample in fixes([0.0, 0.2], [0.0, 3.0], 0.0):
        position, velocity = (filter_.as_judged(part, sample, S) for part in ("gnss_position", "gnss_velocity"))
    assert velocity is S
    assert position[2, 2] == pytest.approx(10.0 if told else 1.0, rel=1e-3)
