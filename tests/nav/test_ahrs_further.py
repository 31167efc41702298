"""Error states of the attitude filter beyond the six: their model, and what they are worth on the U flight."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
from worlds.ahrs import DEG, DEGPH, DT, GUST_S, MG, PAPER, TURN, fly, imu, level_figures, level_flight, tilted

from nav.ahrs import STATES, Ahrs
from nav.ahrs.further import FurtherStates
from nav.earth import OMEGA_IE
from nav.error_model import ImuModel
from nav.horizon import FusionHorizon
from nav.motion import LowDynamics
from nav.samples import ImuSamples

NEVER = LowDynamics(yaw_rate_limit=-1.0)
MODELLED = replace(
    PAPER,
    imu=ImuModel(0.3 * DEG / 60, 1e-3, 40 * DEGPH, 2 * MG),
    force_sigma=0.02,
    gyro_bias_feedback=True,
    accel_bias_sigma=2 * MG,
    gust_sigma=0.15,
    gust_correlation_s=GUST_S,
)
MISALIGNED = replace(MODELLED, gyro_misalignment_sigma=2e-3)


def test_none_is_there_unless_asked_for():
    none = FurtherStates(PAPER)
    assert (none.count, none.names) == (0, [])
    assert Ahrs(PAPER).level_measurement(np.array([1.0, 0, 0, 0]), np.zeros(3), False)[0].shape == (2, STATES)
    every = FurtherStates(MISALIGNED)
    assert every.count == len(every.names) == 8
    assert (every.misalignment, every.accel_bias, every.gust) == (slice(6, 9), slice(9, 12), slice(12, 14))
    assert FurtherStates(replace(MISALIGNED, accel_bias_sigma=0.0)).gust == slice(9, 11)


@pytest.mark.ci
def test_gusts_are_as_likely_as_the_means_of_markov_noise():
    """Variance of the means of a second exact; their long-term power, what a mean over many seconds has, exact too."""
    rng = np.random.default_rng(1)
    decay = math.exp(-DT / GUST_S)
    made = lfilter([math.sqrt(1 - decay**2)], [1, -decay], 0.15 * rng.normal(size=(2000, 200 * 200)), axis=1)
    seconds = made[:, 4000:].reshape(2000, -1, 200).mean(axis=2)
    gusts = FurtherStates(replace(MODELLED, accel_bias_sigma=0.0))
    assert gusts.sigma == pytest.approx([seconds.std()] * 2, rel=0.01)
    r = math.exp(-gusts.decay_rate[0])
    long_term = gusts.sigma[0] ** 2 * (1 + r) / (1 - r)
    assert long_term == pytest.approx(seconds.shape[1] * seconds.mean(axis=1).var(), rel=0.1)
    assert np.mean(seconds[:, 1:] * seconds[:, :-1]) == pytest.approx(r * gusts.sigma[0] ** 2, rel=0.25)


@pytest.mark.parametrize("T", [0.3, 1.0, 70.0])
def test_gusts_stay_as_strong_as_they_are_while_nobody_looks(T):
    filter_ = Ahrs(replace(MISALIGNED, motion=NEVER))
    truth = level_flight()
    filter_.start(0.0, truth.q_nb[0])
    increments = imu(truth, 0)
    rows = slice(0, round(T / DT))
    filter_.propagate(ImuSamples(increments.t[rows], increments.dt[rows], increments.dtheta[rows], increments.dv[rows]))
    state = filter_._state.copy()
    filter_._settle(state)
    np.testing.assert_allclose(np.sqrt(np.diag(state.P))[STATES:], filter_.further.sigma, rtol=1e-9)


def test_a_step_against_dense_matrices():
    """P <- T (P + Q/2) T' + Q/2, x <- T x, with T of the turn, of the misaligned gyros and of gusts that fade."""
    filter_, rng = Ahrs(MISALIGNED), np.random.default_rng(1)
    filter_.start(0.0, np.array([1.0, 0, 0, 0]))
    state, n = filter_._state, STATES + 8
    root = rng.normal(size=(n, n))
    turned, x, P, T = rng.normal(size=(3, 3)), rng.normal(size=n), root @ root.T, 0.7
    state.turned[:], state.x[:], state.P[:], state.elapsed[:], state.angle[2] = (
        turned,
        x,
        P,
        (T, 0.9, 180, 0.0, 0.0, 0.0),
        0.3,
    )
    earth_n = np.array([math.cos(PAPER.lat), 0.0, -math.sin(PAPER.lat)]) * OMEGA_IE
    whole, Q = np.eye(n), np.zeros(n)
    whole[:3, :3] += np.cross(np.eye(3), earth_n).T * T
    whole[:3, 3:6] = turned
    whole[:3, 6:9] = turned * 0.3 / 0.9
    whole[12:, 12:] *= (kept := math.exp(-T * filter_.further.decay_rate[-1]))
    model = MODELLED.imu
    Q[:3], Q[3:6] = model.gyro_noise**2 * T, model.gyro_bias_walk**2 * T
    Q[12:] = 2 * filter_.further.sigma[-1] ** 2 * (1 - kept**2) / (1 + kept**2)
    filter_._settle(state)
    np.testing.assert_allclose(state.x, whole @ x, rtol=1e-12)
    np.testing.assert_allclose(state.P, whole @ (P + np.diag(Q) / 2) @ whole.T + np.diag(Q) / 2, rtol=1e-12, atol=1e-13)
    np.testing.assert_array_equal(state.P, state.P.T)
    assert not state.turned.any()
    assert state.elapsed[0] == 0


def test_force_columns_against_finite_differences():
    """The mean force that a biased accelerometer and a gust show, at any attitude; the estimate of both is zero."""
    q_nb = tilted([1.0, 0, 0, 0], 4.0, 70.0)
    to_n = Rotation.from_quat(q_nb, scalar_first=True)
    H = Ahrs(MODELLED).level_measurement(q_nb, np.zeros(3), False)[0][:, STATES:]
    for axis in range(3):
        np.testing.assert_allclose(H[:, axis], to_n.apply(np.eye(3)[axis])[:2] * -1.0, atol=1e-12)
    np.testing.assert_array_equal(H[:, 3:], -np.eye(2))


def test_a_turn_of_misaligned_gyros_against_finite_differences():
    truth, h = level_flight(), 1e-4
    increments = imu(truth, 0, 0.0, 0.0, gust=0.0)
    rows = slice(0, round(215.0 / DT))
    found = []
    for axis in range(3):
        ends = []
        for sign in (0.0, 1.0):
            dtheta = increments.dtheta[rows].copy()
            dtheta[:, axis] += sign * h * dtheta[:, 2]
            filter_ = Ahrs(replace(MISALIGNED, motion=NEVER))
            filter_.start(0.0, truth.q_nb[0])
            filter_.propagate(ImuSamples(increments.t[rows], increments.dt[rows], dtheta, increments.dv[rows]))
            ends.append(Rotation.from_quat(filter_.estimate().q_nb, scalar_first=True))
        found.append(-(ends[1] * ends[0].inv()).as_rotvec() / -h)  # error of the gyro: estimate - truth = -h
    state = Ahrs(replace(MISALIGNED, motion=NEVER))
    columns = []
    for axis in range(3):
        state.start(0.0, truth.q_nb[0])
        state._state.x[STATES + axis] = 1.0
        state.propagate(
            ImuSamples(increments.t[rows], increments.dt[rows], increments.dtheta[rows], increments.dv[rows])
        )
        settled = state._state.copy()
        state._settle(settled)
        columns.append(settled.x[:3])
    np.testing.assert_allclose(columns, found, atol=0.02)
    assert np.abs(found).max() > 0.5


@pytest.mark.ci
def test_what_they_are_worth_on_the_u_flight():
    """Half of the way from the paper's six states to a linear filter that is told the statistics, 0.43 and 0.15 deg."""
    six, typical_of_six = level_figures(fly(PAPER))
    largest, typical = level_figures(fly(MODELLED))
    print(f"six states: max {six:.2f}, rms {typical_of_six:.2f}; modelled: max {largest:.2f}, rms {typical:.2f} deg")
    assert largest < (six + 0.43) / 2
    assert typical < (typical_of_six + 0.15) / 2


@pytest.mark.ci
def test_they_find_the_biases_once_the_body_has_turned():
    """In a turn accelerometer biases go round with the body and tilt does not; before it only their sum shows."""
    truth = level_flight()
    before, after, claimed = [], [], []
    for seed in range(6):
        filter_ = Ahrs(MODELLED)
        filter_.start(0.0, truth.q_nb[0])
        increments = imu(truth, seed)
        _, (early, late) = FusionHorizon(filter_).track(increments, (), [TURN[0], 600.0])
        sign = np.random.default_rng(seed).choice([-1.0, 1.0], (2, 3))[1]
        before.append(early.accel_bias[:2] - 2 * MG * sign[:2])
        after.append(late.accel_bias[:2] - 2 * MG * sign[:2])
        claimed.append(late.sigma_accel_bias[:2])
        assert np.all(early.sigma_accel_bias[:2] > 0.8 * 2 * MG)
    assert np.mean(np.square(after)) < 0.6 * np.mean(np.square(before))
    assert 0.4 < np.mean(np.square(np.array(after) / claimed)) < 2.5
