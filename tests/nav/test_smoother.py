"""Looking back: as least squares have it, honest, and better than the filter where that had no fix."""

import itertools

import numpy as np
import pytest
from scipy.stats import chi2
from worlds.ins import CONSUMER, FIELD_N, airspeed, barometer, error, flight, gnss, imu, magnetometer
from worlds.motion import DT

from nav.aids import AirspeedAid, BarometerAid, GnssAid, MagnetometerAid
from nav.error_model import CROSS, MOTION, ErrorModel, ImuModel, sensor_errors
from nav.horizon import FusionHorizon
from nav.ins import Ins, InsConfig
from nav.samples import ImuSamples
from nav.smoother import LEAST, Smoothed, Smoother, _spread
from nav.state import State
from nav.unscented import Scaling

DENIED = (50.0, 90.0)
DURATION = 120
AIDS = (GnssAid(), BarometerAid(bias_walk=0.0), MagnetometerAid(), AirspeedAid(sideslip_sigma=None, wind_walk=0.0))


def level_increments(t, rows=20):
    times = t + np.arange(1, rows + 1) * 0.05
    turn, push = np.tile([0.01, 0.0, 0.003], (rows, 1)), np.tile([0.1, 0.0, -9.8], (rows, 1))
    return ImuSamples(times, np.full(rows, 0.05), turn * 0.05, push * 0.05)


def test_it_is_the_least_squares_solution():
    """Four stretches of a second of a turning flight, two vague measurements after each, against all at once."""
    model = ErrorModel(ImuModel(1e-3, 1e-2, 1e-3, 0.05, 1e-4, 1e-3))
    n, rng = model.size, np.random.default_rng(5)
    smoother, state = Smoother(model), State(n, 1, n)
    state.q_nb[0], state.v_n[:], state.lla[:] = 1.0, (20.0, 3.0, 0.0), (0.6, 1.0, 300.0)
    prior = np.diag(np.repeat([1e-3, 0.1, 1.0, 1e-3, 1e-2], 3) ** 2)
    Q = np.diag(rng.uniform(0.2, 1.0, n) * np.diag(prior) * 0.1)
    state.P[0] = prior
    smoother.pause(0.0, state)
    # information and its sum over all errors there ever were, stretch by stretch
    A, b = np.zeros((5 * n, 5 * n)), np.zeros(5 * n)
    A[:n, :n] = np.linalg.inv(prior)
    moved = np.zeros(n)  # what the corrections so far have become: the nominal states are of a filter without any
    for k in range(1, 5):
        probe = Smoother(model)
        probe.pause(0.0, state)
        probe.carry(state, level_increments(k - 1.0))
        probe.pause(1.0, state)
        T = probe._nodes[0].M.T.copy()
        smoother.carry(state, level_increments(k - 1.0))
        state.P[0] = T @ state.P[0] @ T.T + Q
        moved = T @ moved
        G = np.hstack([-T, np.eye(n)])
        both = slice((k - 1) * n, (k + 1) * n)
        A[both, both] += G.T @ np.linalg.inv(Q) @ G
        H, R = rng.normal(size=(2, n)) / np.sqrt(np.diag(prior)), np.array([0.5, 0.8])
        z = rng.normal(size=2)
        own = slice(k * n, (k + 1) * n)
        A[own, own] += H.T @ np.diag(1 / R) @ H
        b[own] += H.T @ (z / R)
        P, nu = state.P[0].copy(), z - H @ moved
        S = H @ P @ H.T + np.diag(R)
        K = P @ H.T @ np.linalg.inv(S)
        moved = moved + K @ nu
        state.P[0] = P - K @ H @ P
        smoother.updated(P, H, nu, S)
        state.imu[MOTION:] = moved[MOTION:]
        smoother.pause(float(k), state)
    state.imu[:] = 0.0
    whole, at_once = np.linalg.inv(A), np.linalg.solve(A, b)
    nodes = smoother._look_back()
    assert len(nodes) == 5
    for k, node in enumerate(nodes):
        own = slice(k * n, (k + 1) * n)
        np.testing.assert_allclose(
            node.state.P[0], whole[own, own], rtol=1e-6, atol=1e-9 * np.abs(whole[own, own]).max()
        )
        np.testing.assert_allclose(node.state.imu[MOTION:], at_once[own][MOTION:], rtol=1e-5, atol=1e-9)


def as_told(truth, k, model):
    """A state of a ``model`` that is the truth of row ``k``."""
    state = State(model.mixing, 1, model.size)
    state.q_nb[:], state.v_n[:] = truth.q_nb[k], truth.v_n[k]
    state.lla[:] = truth.lat[k], truth.lon[k], truth.h[k]
    return state


def test_what_axes_feel_of_each_other_is_taken_off_between_nodes():
    """Known to the filter, it changes neither where a second of increments leads nor what errors become in it."""
    truth, rows = flight(DURATION), slice(5001, 5091)
    model = ErrorModel(ImuModel(1e-3, 1e-2, 1e-3, 0.05, 1e-4, 1e-3, gyro_misalignment=0.017, accel_misalignment=0.017))
    felt = np.random.default_rng(2).normal(0.0, 0.017, (2, 6))
    turn, push = np.eye(3), np.eye(3)
    for axes, of_gyros, of_accels in zip(CROSS, *felt, strict=True):
        turn[axes], push[axes] = of_gyros, of_accels
    clean = ImuSamples(truth.t[rows], np.full(90, DT), truth.dtheta[rows], truth.dv[rows])
    crossed = ImuSamples(clean.t, clean.dt, clean.dtheta @ turn.T, clean.dv @ push.T)
    exact, known = as_told(truth, 5000, model), as_told(truth, 5000, model)
    known.imu[model.slices["gyro_cross"]], known.imu[model.slices["accel_cross"]] = felt
    sensor_errors(known.errors, known.imu, model.driven)
    maps = []
    for state, measured in ((exact, clean), (known, crossed)):
        smoother = Smoother(model)
        smoother.pause(truth.t[5000], state)
        smoother.carry(state, measured)
        maps.append(smoother._nodes[0].M[:, :MOTION])
        _, last = smoother._carried(Smoothed(truth.t[5000], state), float(clean.t[-1]), measured)
        np.testing.assert_allclose(last.v_n, truth.v_n[5090], atol=0.02)  # to the second order in 17 mrad
    np.testing.assert_allclose(maps[1], maps[0], rtol=2e-3, atol=0.01)


def test_a_sound_covariance_is_as_it_comes_and_one_that_is_none_is_kept_positive():
    P = np.array([[100.0, 0.0], [0.0, 4.0]])
    exact = np.diag([1 / (100 + 1e-6), 1 / (4 + 1.0)])  # of later measurements of 1 mm and 1 m
    np.testing.assert_array_equal(_spread(P, exact), P - P @ exact @ P)
    spread = _spread(P, exact * [[1.0001, 1.0], [1.0, 1.0]])
    np.testing.assert_allclose(spread, np.diag([LEAST * 100, 0.8]), rtol=1e-6)
    assert not _spread(np.zeros((2, 2)), exact).any()


def flown(seed, smooth=True):
    truth, rng = flight(DURATION), np.random.default_rng(seed)
    increments, *_ = imu(truth, CONSUMER, rng)
    samples = [s for s in gnss(truth, rng, 5.0) if not DENIED[0] <= s.t < DENIED[1]]
    samples += magnetometer(truth, rng, MagnetometerAid().bias_sigma * rng.normal(size=3))
    samples += barometer(truth, rng, 100 * rng.normal()) + airspeed(truth, rng)
    ins = Ins(InsConfig(CONSUMER, AIDS, false_rejection=1e-6, smooth=smooth), lambda *_: FIELD_N)
    horizon = FusionHorizon(ins)
    times = [float(t) for t in range(1, DURATION + 1)]
    _, estimates = horizon.track(increments, samples, times)
    return truth, estimates, ins, times


def squares(estimates, truth):
    """(N, 3) NEES of position, velocity and attitude over three, and (N,) horizontal errors."""
    found, horizontal = [], []
    for estimate in estimates:
        wrong = error(estimate, truth)
        blocks = [slice(3 * i, 3 * i + 3) for i in range(3)]
        found.append([wrong[b] @ np.linalg.solve(estimate.covariance[b, b], wrong[b]) / 3 for b in blocks])
        horizontal.append(np.hypot(*wrong[:2]))
    return np.array(found), np.array(horizontal)


@pytest.mark.ci
def test_it_knows_more_than_the_filter_in_an_outage_and_never_less():
    truth, estimates, ins, times = flown(3)
    smoothed = list(ins.smoothed(times))
    assert [one.t for one in smoothed] == times[-len(smoothed) :]
    start = len(times) - len(smoothed)
    sigma = [np.sqrt(np.trace(one.covariance[:2, :2])) for one in smoothed]
    before = [np.sqrt(np.trace(one.covariance[:2, :2])) for one in estimates[start:]]
    assert (np.array(sigma) <= np.array(before) * 1.05).all()
    late = [k for k, one in enumerate(smoothed) if 80 <= one.t < 90]
    assert np.mean(np.array(before)[late] / np.array(sigma)[late]) > 2.0
    _, own = squares([estimates[start + k] for k in late], truth)
    _, back = squares([smoothed[k] for k in late], truth)
    assert np.sqrt(np.mean(back**2)) < np.sqrt(np.mean(own**2))
    # between nodes the strapdown carries it: no step is larger than the noise of a second
    fine = list(ins.smoothed([70.0 + 0.1 * k for k in range(60)]))
    step = np.diff([one.v_n for one in fine], axis=0)
    assert np.abs(np.diff(step, axis=0)).max() < 0.1


def test_to_keep_what_it_takes_changes_no_estimate():
    """And without it there is nothing to look back on."""
    short = [flown_shortly(smooth) for smooth in (True, False)]
    np.testing.assert_array_equal(short[0][0].covariance, short[1][0].covariance)
    with pytest.raises(ValueError, match="smooth"):
        next(short[1][1].smoothed([5.0]))
    with pytest.raises(ValueError, match="sigma points"):
        InsConfig(CONSUMER, smooth=True, scaling=Scaling())


def flown_shortly(smooth):
    truth, rng = flight(DURATION), np.random.default_rng(1)
    increments, *_ = imu(truth, CONSUMER, rng)
    ins = Ins(InsConfig(CONSUMER, AIDS[:1], smooth=smooth), lambda *_: FIELD_N)
    first = ImuSamples(*(getattr(increments, name)[:2000] for name in ("t", "dt", "dtheta", "dv")))
    samples = [s for s in gnss(truth, rng, 5.0) + magnetometer(truth, rng) if s.t < 9.9]
    _, (estimate,) = FusionHorizon(ins).track(first, samples, [9.9])
    return estimate, ins


@pytest.mark.slow
def test_its_covariance_is_that_of_its_errors():
    """NEES over 30 draws at times before, in and after the outage."""
    runs = []
    for seed in range(30):
        truth, _, ins, _ = flown(seed)
        found, _ = squares(ins.smoothed([40.0, 60.5, 75.0, 85.3, 100.0]), truth)
        runs.append(found)
    low, high = chi2.ppf([0.0005, 0.9995], 90) / 90
    means = np.mean(runs, axis=0)
    print(means)
    assert ((low < means) & (means < high)).all()


def test_no_bit_depends_on_how_increments_come_in_blocks():
    model = ErrorModel(ImuModel(1e-3, 1e-2, 1e-3, 0.05, 1e-4, 1e-3, gyro_drift_sigma=1e-4, accel_drift_sigma=1e-3))
    n, rng = model.size, np.random.default_rng(6)
    H, nu, S = rng.normal(size=(2, n)), np.array([0.1, -0.2]), np.diag([3.0, 4.0])
    found = []
    for edges in ([0, 80], [0, 7, 25, 26, 80], [0, 50, 80]):
        state = State(n, 1, n)
        state.q_nb[0], state.v_n[:], state.lla[:], state.P[0] = 1.0, (20.0, 3.0, 0.0), (0.6, 1.0, 300.0), np.eye(n)
        state.imu[MOTION:] = 1e-4
        smoother = Smoother(model)
        smoother.pause(0.0, state)
        imu = level_increments(0.0, 80)
        for first, stop in itertools.pairwise(edges):
            smoother.carry(state, ImuSamples(*(column[first:stop] for column in (imu.t, imu.dt, imu.dtheta, imu.dv))))
        smoother.updated(state.P[0], H, nu, S)
        found.append(smoother._nodes[0])
    for other in found[1:]:
        assert (other.M == found[0].M).all()
        assert (other.N == found[0].N).all()
