"""Process noise that follows motion and vibration, against sums by hand and against the noise that was put in."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nav.alignment import InitialState
from nav.earth import gravity
from nav.error_model import MOTION, PHI, VEL, ErrorModel, ImuModel
from nav.reference import Reference
from nav.samples import ImuSamples
from nav.unscented import Scaling

LAT, HZ = math.radians(47.0), 100.0
QUIET = ImuModel(gyro_noise=0.0, accel_noise=0.0, gyro_bias_sigma=0.0, accel_bias_sigma=0.0)
SMALL = 1e-6  # of what comes in, by the Earth's rate


def variances(model, rate_b, force_b, seconds, scaling=None, period=10):
    """Of attitude and of velocity (3,) after ``seconds`` at constant rate and force, from a state without error."""
    reference = Reference([ErrorModel(model)], [1.0], period, None, scaling)
    start = InitialState(0.0, LAT, 0.1, 300.0, np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros((MOTION, MOTION)))
    state = reference.start(start)
    n = round(seconds * HZ)
    dt = np.full(n, 1 / HZ)
    imu = ImuSamples(np.cumsum(dt), dt, np.outer(dt, rate_b), np.outer(dt, force_b))
    reference.run(state, imu, settle=True)
    P = state.P[0].diagonal()
    return P[PHI : PHI + 3], P[VEL : VEL + 3], state.shaking[2, :2]


@pytest.mark.parametrize("scaling", [None, Scaling()], ids=["linear", "points"])
def test_each_second_of_a_manoeuvre_adds_the_share_that_goes_wrong(scaling):
    """Rate w for T s: the attitude's variance is (share w)^2 T; force a beyond gravity: (share a)^2 T of velocity."""
    g = gravity(LAT, 300.0)
    model = replace(QUIET, gyro_motion=0.01)
    phi, _, _ = variances(model, [0.0, 0.0, 0.5], [0.0, 0.0, -g], 4.0, scaling)
    np.testing.assert_allclose(phi, (0.01 * 0.5) ** 2 * 4.0, rtol=1e-3)
    model = replace(QUIET, accel_motion=0.02)
    _, dv, _ = variances(model, [0.0, 0.0, 0.0], [3.0, 0.0, -g], 4.0, scaling)
    np.testing.assert_allclose(dv, (0.02 * 3.0) ** 2 * 4.0, rtol=1e-3)


def test_rest_adds_nothing_but_the_earths_rate():
    model = replace(QUIET, gyro_motion=0.01, accel_motion=0.01, vibration=1.0)
    phi, dv, shaking = variances(model, [0.0, 0.0, 0.0], [0.0, 0.0, -gravity(LAT, 300.0)], 10.0)
    assert phi.max() < SMALL**2 * 10
    assert dv.max() < (0.01 * 0.01) ** 2
    assert not shaking.any()


def test_a_filter_of_half_the_noise_is_told_of_twice_as_much():
    models = [ErrorModel(replace(QUIET, gyro_motion=0.01))] * 2
    reference = Reference(models, [1.0, 0.5], 10, None)
    state = reference.start(
        InitialState(0.0, LAT, 0.1, 300.0, np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros((MOTION, MOTION)))
    )
    dt = np.full(100, 0.01)
    reference.run(state, ImuSamples(np.cumsum(dt), dt, np.outer(dt, [0.2, 0, 0]), np.outer(dt, [0, 0, -9.8])))
    reference.settle(state)
    np.testing.assert_allclose(state.P[1, :3, :3], 2 * state.P[0, :3, :3])


def shaken(noise, split, seed=1, swing=0.0):
    """What is learned of increments of 100 Hz with white rates and forces, each cut in two at ``split`` of it."""
    reference = Reference([ErrorModel(replace(QUIET, vibration=1.0))], [1.0], 10, None)
    state = reference.start(
        InitialState(0.0, LAT, 0.1, 300.0, np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros((MOTION, MOTION)))
    )
    n = 2000
    t = np.arange(1, n + 1) / HZ
    random = np.random.default_rng(seed)
    rates = noise[0] * random.standard_normal((n, 3)) + swing * np.sin(2 * np.pi * 0.5 * t)[:, None]
    forces = noise[1] * random.standard_normal((n, 3)) - np.array([0, 0, 9.8])
    learned = []
    for k in range(n):
        for part in (split, 1 - split):
            if part:
                dt = np.array([part / HZ])
                reference.run(state, ImuSamples(t[k : k + 1], dt, rates[k : k + 1] * dt, forces[k : k + 1] * dt))
        learned.append(state.shaking[2, :2].copy())
    return np.mean(learned[500:], axis=0), state


@pytest.mark.parametrize("split", [0.0, 0.3])
def test_vibration_is_learned_from_second_differences_however_increments_are_cut(split):
    """White rates of sigma s over increments of T have the density s^2 T, which must be found within 5 %."""
    density, state = shaken((0.05, 2.0), split)
    np.testing.assert_allclose(density, np.array([0.05, 2.0]) ** 2 / HZ, rtol=0.05)
    expected = density[0] * 20.0  # all of it from the first second on
    assert 0.8 * expected < state.P[0, 0, 0] < 1.2 * expected or state.elapsed[0] > 0


def test_slow_motion_is_no_vibration():
    density, _ = shaken((0.0, 0.0), 0.0, swing=1.0)
    assert density[0] < (1e-3) ** 2 / HZ


@pytest.mark.parametrize("shares", [{}, {"gyro_motion": 0.01}])
@pytest.mark.parametrize("gap_s", [0.01, 0.1, 2.0])
def test_a_gap_widens_what_is_claimed_by_what_may_happen_unseen(shares, gap_s):
    """The rate before it is off by 0.5 T / (T + 0.2 s) rad/s after T seconds, the force by six times as much; whatever
    the grade of the sensors is.
    """
    model = replace(QUIET, **shares)
    reference = Reference([ErrorModel(model)], [1.0], 10, None)
    start = InitialState(0.0, LAT, 0.1, 300.0, np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros((MOTION, MOTION)))
    state = reference.start(start)
    dt = np.full(200, 0.01)
    force = np.outer(dt, [0.0, 0.0, -gravity(LAT, 300.0)])
    whole = ImuSamples(np.cumsum(dt), dt, 0 * force, force)
    reference.run(state, whole, settle=True)
    before = np.sqrt(state.P[0].diagonal())
    missing = round(gap_s * 100)
    lost = np.full((missing, 3), np.nan)
    for first, stop in ((0, missing // 3), (missing // 3, missing)):  # however they are cut
        rows = slice(first, stop)
        part = ImuSamples(2 + np.cumsum(dt)[rows], dt[rows], lost[rows], lost[rows])
        reference.run(state, part, settle=stop == missing)
    sigma = np.sqrt(state.P[0].diagonal())
    assert before[VEL : VEL + 3].max() < 1e-3
    turned = 0.5 * gap_s**2 / (gap_s + 0.2)
    np.testing.assert_allclose(sigma[PHI : PHI + 3], np.hypot(before[PHI : PHI + 3], turned), rtol=0.01)
    assert (sigma[VEL : VEL + 3] > 6 * turned * 0.99).all()
    if gap_s > 1:  # what comes of the velocity, were it off by parts that know nothing of each other
        at = np.linspace(0, gap_s, 10_000)
        grown = np.gradient((3 * at**2 / (at + 0.2)) ** 2, at)
        assert (sigma[6:9] > 0.95 * math.sqrt(np.trapezoid((gap_s - at) ** 2 * grown, at))).all()
    after = state.P[0].copy()
    reference.run(state, ImuSamples(5 + np.cumsum(dt), dt, 0 * force, force), settle=True)
    one = slice(0, 1)
    reference.run(state, ImuSamples(np.array([7.01]), dt[one], lost[one], lost[one]), settle=True)
    assert state.P[0, PHI, PHI] - after[PHI, PHI] < 1e-6 + (0.5 * 0.01**2 / 0.21) ** 2  # the next gap is one by itself


@pytest.mark.parametrize("gap_s", [0.1, 1.0])
def test_before_anything_was_felt_a_body_is_not_accelerated(gap_s):
    """Lost from the start on: held by gravity, however it lies, and not in free fall."""
    reference = Reference([ErrorModel(QUIET)], [1.0], 10, None)
    q_nb = Rotation.from_euler("ZYX", [1.0, 0.3, -0.5]).as_quat(scalar_first=True)
    state = reference.start(InitialState(0.0, LAT, 0.1, 300.0, np.zeros(3), q_nb, np.zeros((MOTION, MOTION))))
    dt = np.full(round(gap_s * 100), 0.01)
    lost = np.full((len(dt), 3), np.nan)
    reference.run(state, ImuSamples(np.cumsum(dt), dt, lost, lost), settle=True)
    assert np.abs(state.v_n).max() < 1e-3
    assert np.abs(state.v_n).max() < np.sqrt(state.P[0].diagonal()[VEL : VEL + 3]).min()


def test_an_angle_is_no_more_than_unknown():
    reference = Reference([ErrorModel(QUIET)], [1.0], 10, None)
    start = InitialState(0.0, LAT, 0.1, 300.0, np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros((MOTION, MOTION)))
    state = reference.start(start)
    lost = np.full((6000, 3), np.nan)
    dt = np.full(6000, 0.01)
    reference.run(state, ImuSamples(np.cumsum(dt), dt, lost, lost), settle=True)
    np.testing.assert_allclose(np.sqrt(state.P[0].diagonal()[PHI : PHI + 3]), math.pi / math.sqrt(3), rtol=0.01)
