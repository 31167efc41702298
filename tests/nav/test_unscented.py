"""Sigma points against the linear filter, dense numpy, and strapdowns of every point; and from a bad alignment."""

import functools

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from worlds.ins import flight

from nav import error_model, kalman, strapdown, unscented
from nav.earth import position_difference_n
from nav.error_model import ErrorModel, ImuModel, sensor_errors
from nav.rotation import dcm_from_quat, quat_from_euler, quat_from_rotvec, quat_multiply
from nav.unscented import Scaling

DT = 0.005
DEG = np.pi / 180
ONE = Scaling()
IMU = ImuModel(0.3 * DEG / 60, 0.1 / 60, 40 * DEG / 3600, 0.02, 1e-6, 2e-5)


def positive(rng, n, scale=1.0):
    root = rng.normal(size=(n, n))
    return (root @ root.T + 0.1 * np.eye(n)) * np.outer(scale, scale) if np.ndim(scale) else root @ root.T


def estimate(n):
    return quat_from_euler(0.3, -0.2, 2.0), np.array([20.0, -10.0, 2.0]), np.array([0.8, 0.2, 900.0]), np.zeros(n)


def errors_of(points):
    """(2n + 1, n) the errors, estimate minus truth, that the points stand for: the oracle of `points`."""
    q, v, lla, x = points
    turned = Rotation.from_quat(q[:1], scalar_first=True) * Rotation.from_quat(q, scalar_first=True).inv()
    e = x[0] - x
    e[:, 0:3] = -turned.as_rotvec()
    e[:, 3:6] = v[0] - v
    e[:, 6:9] = position_difference_n(*lla[0], *lla.T)
    return e


def test_factor():
    rng = np.random.default_rng(0)
    scale = 10.0 ** rng.uniform(-6, 3, 15)
    P = positive(rng, 15, scale)
    np.testing.assert_allclose(unscented.factor(P, 15), np.linalg.cholesky(P).T, rtol=1e-9, atol=1e-20)
    np.testing.assert_allclose(unscented.factor(P, 3), np.linalg.cholesky(P).T[:3], rtol=1e-9, atol=1e-20)
    # as good as singular, with unknown states of zero variance
    low = rng.normal(size=(15, 4)) * scale[:, None]
    P = low @ low.T
    P[3] = P[:, 3] = 0.0
    root = unscented.factor(P, 15)
    assert np.isfinite(root).all()
    np.testing.assert_allclose((root.T @ root - P) / np.outer(scale, scale), 0.0, atol=1e-6)


@pytest.mark.ci
def test_points_are_the_columns_of_the_factor():
    n = 17
    rng = np.random.default_rng(1)
    scale = np.array([0.1] * 3 + [1.0] * 3 + [30.0] * 3 + [1e-3] * 8)
    root = unscented.factor(positive(rng, n, scale), n)
    found = errors_of(unscented.points(*estimate(n), root, ONE.spread))
    expected = ONE.spread * np.vstack([np.zeros(n), root, -root])
    # positions in metres by radii that change over the distance
    np.testing.assert_allclose(found / scale, expected / scale, atol=2e-3)
    np.testing.assert_allclose(np.delete(found, slice(6, 9), 1), np.delete(expected, slice(6, 9), 1), atol=1e-12)


@pytest.mark.ci
@pytest.mark.parametrize("alpha", [0.1, 0.5, 1.0])
@pytest.mark.parametrize(("m", "k"), [(1, 15), (3, 15), (6, 15), (6, 3), (9, 3), (20, 3)])
def test_linear_measurement_is_the_kalman_filter(m, k, alpha):
    rng = np.random.default_rng(m)
    n = 15
    scaling = Scaling(alpha=alpha)
    P = positive(rng, n)
    H, R, z = rng.normal(size=(m, n)), rng.uniform(0.1, 1, m), rng.normal(size=m)
    root = unscented.factor(P, k)
    Z = -ONE.spread * alpha * np.vstack([np.zeros(n), root, -root]) @ H.T  # truth = estimate - error
    nu, S, W, nis = unscented.innovate(P, Z, z, R, root, H, unscented.scratch(n, m, k), scaling.spread, scaling.excess)
    S_linear, S_inverse, HP, nis_linear = kalman.innovate(P, H, R, z)
    np.testing.assert_allclose(nu, z, atol=1e-10)
    np.testing.assert_allclose(S, S_linear, rtol=1e-10)
    np.testing.assert_allclose(nis, nis_linear, rtol=1e-9)
    P_linear = P.copy()
    correction = kalman.correct(P_linear, H, R, HP, S_inverse, z)
    found = unscented.correct(P, W, unscented.scratch(n))
    np.testing.assert_allclose(found, -correction, atol=1e-10)
    # the attitude's covariance is turned into the corrected axes: undo that with scipy's left Jacobian
    G = np.eye(n)
    G[:3, :3] = left_jacobian(found[:3])
    np.testing.assert_allclose(P, G @ P_linear @ G.T, atol=1e-10)
    assert (P == P.T).all()


@pytest.mark.ci
def test_a_dead_state_changes_nothing():
    """15 states and six rows have loops of their own size: with a sixteenth, always zero, it is the other ones."""
    rng = np.random.default_rng(11)
    scale = np.array([0.3] * 3 + [1.0] * 3 + [10.0] * 3 + [1e-3] * 3 + [0.05] * 3)
    P = positive(rng, 15, scale) / 15
    Phi = np.eye(9, 15) + 0.1 * rng.normal(size=(9, 15)) * np.outer(scale[:9], 1 / scale)
    Z, z, R, H = rng.normal(size=(7, 6)), rng.normal(size=6), rng.uniform(0.1, 1, 6), rng.normal(size=(6, 15)) / scale
    decay, half, push_n = rng.uniform(0.9, 1.0, 15), (1e-3 * scale) ** 2, np.array([1.0, 2.0, -9.0])

    def period(dead):
        n, work = 15 + dead, unscented.scratch(15 + dead)
        P_here, H_here = np.zeros((n, n)), np.zeros((6, n))
        P_here[:15, :15], H_here[:, :15] = P, H
        given = np.pad(decay, (0, dead), constant_values=1.0), np.pad(half, (0, dead))
        mean = unscented.predict(P_here, Phi, *given, work, push_n, 0.7, ONE.spread, ONE.excess)[:15].copy()
        predicted, root = P_here.copy(), unscented.factor(P_here, 3)
        nu, S, W, nis = unscented.innovate(P_here, Z, z, R, root, H_here, work, ONE.spread, ONE.excess)
        found = unscented.correct(P_here, W, work)
        return mean, predicted[:15, :15], nu, S, W[:, :15], nis, found[:15], P_here[:15, :15]

    for own, other in zip(period(0), period(1), strict=True):
        np.testing.assert_allclose(own, other, rtol=1e-12, atol=1e-14)


def test_time_update_is_its_formula():
    """T (P - L_1 L_1') T' and the columns as `carry` takes them, by dense matrices: large angles, decaying states."""
    rng, scaling, T = np.random.default_rng(12), Scaling(alpha=0.6), 0.8
    n, s = 19, scaling.spread
    scale = np.array([0.6] * 3 + [1.0] * 3 + [10.0] * 3 + [1e-3] * 3 + [0.05] * 3 + [2.0] * 4)
    P = positive(rng, n, scale) / n
    Phi = np.eye(9, 15) + 0.1 * rng.normal(size=(9, 15)) * np.outer(scale[:9], 1 / scale[:15])
    decay, half, push_n = rng.uniform(0.5, 1.0, n), (0.1 * scale) ** 2, np.array([1.0, 2.0, -9.0])
    whole = np.diag(decay)
    whole[:9] = 0.0
    whole[:9, :15] = Phi
    start = P + np.diag(half)
    root = np.linalg.cholesky(start)[:, :3]

    def carried(e):
        return np.concatenate([unscented.carry(e, Phi, push_n, T), decay[9:] * e[9:]])

    ends = [(carried(s * e), carried(-s * e)) for e in root.T]
    shift = sum(ahead + behind for ahead, behind in ends) / 2 / s**2
    expected = whole @ (start - root @ root.T) @ whole.T + np.diag(half) + scaling.excess * np.outer(shift, shift)
    for ahead, behind in ends:
        odd, even = (ahead - behind) / 2 / s, (ahead + behind) / 2 / s
        expected += np.outer(odd, odd) + np.outer(even, even)
    mean = unscented.predict(P, Phi, decay, half, unscented.scratch(n), push_n, T, s, scaling.excess)
    sigma = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(mean / sigma, shift / sigma, atol=1e-12)
    np.testing.assert_allclose(P / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=1e-11)
    assert np.abs(shift / sigma).max() > 0.01
    assert (P == P.T).all()


def test_too_little_room_is_refused():
    P, H, R = np.eye(15), np.ones((7, 15)), np.ones(7)
    given = P, np.zeros((7, 7)), R, R, unscented.factor(P, 3), H
    with pytest.raises(ValueError, match="make it by `scratch`"):
        unscented.innovate(*given, unscented.scratch(15), 1.0, 1.0)
    with pytest.raises(ValueError, match="make it by `scratch`"):
        unscented.correct(P, np.ones((6, 16)), np.empty((10, 16)))


def test_scaling_with_negative_weights_is_refused():
    assert Scaling(alpha=0.5).excess == 1.75
    with pytest.raises(ValueError, match="weights would be negative"):
        _ = Scaling(alpha=2.0).excess


def left_jacobian(phi):
    """The mean of exp(s [phi x]) over s from 0 to 1: the integral in the corner of an exponential."""
    block = np.zeros((6, 6))
    block[:3, :3] = np.cross(np.eye(3), phi)
    block[:3, 3:] = np.eye(3)
    return expm(block)[:3, 3:]


def test_curved_measurement_is_the_weighted_sum():
    """The weights of Julier and Uhlmann, summed as printed, for a three-axis field that turns with the attitude."""
    n, scaling = 15, Scaling(alpha=0.6)
    rng = np.random.default_rng(4)
    scale = np.array([0.5] * 3 + [1.0] * 3 + [10.0] * 3 + [1e-3] * 3 + [0.05] * 3)
    P = positive(rng, n, scale) / 5
    q, v, lla, x = estimate(n)
    field = np.array([0.5, -0.1, 0.8])

    def h(points):
        C_nb = np.array([dcm_from_quat(q) for q in points.q_nb])
        return np.einsum("kji,j->ki", C_nb, field) + points.x[:, 9:12]

    z, R = np.array([0.3, 0.4, 0.5]), np.array([0.01, 0.02, 0.03])
    root = unscented.factor(P, n)
    Z = h(unscented.points(q, v, lla, x, root, scaling.spread))
    work = unscented.scratch(n, 3, n)
    nu, S, W, _ = unscented.innovate(P, Z, z, R, root, np.zeros((3, n)), work, scaling.spread, scaling.excess)
    HP = np.linalg.cholesky(S) @ W[:, :n]

    c = scaling.spread**2
    W = np.full(2 * n + 1, 0.5 / c)
    W[0] = 1 - n / c
    mean = W @ Z
    Wc = W.copy()
    Wc[0] += 1 - scaling.alpha**2 + scaling.beta
    Pzz = np.einsum("k,ki,kj->ij", Wc, Z - mean, Z - mean)
    Pez = np.einsum("k,ki,kj->ij", Wc, scaling.spread * np.vstack([np.zeros(n), root, -root]), Z - mean)
    np.testing.assert_allclose(nu, z - mean, atol=1e-12)
    np.testing.assert_allclose(S, Pzz + np.diag(R), atol=1e-12)
    np.testing.assert_allclose(-HP.T, Pez, atol=1e-12)
    A = -np.linalg.solve(root.T, HP.T).T
    bend = S - np.diag(R) - A @ A.T
    assert np.linalg.eigvalsh(bend).min() > -1e-15

    K = Pez @ np.linalg.inv(S)
    G = np.eye(n)
    G[:3, :3] = left_jacobian((K @ nu)[:3])
    expected = G @ (P - K @ S @ K.T) @ G.T
    H = np.zeros((3, n))
    H[:, 9:12] = np.eye(3)
    P_seven = P.copy()
    seven = unscented.update(*estimate(n), P_seven, z, h, R, H, scaling)
    nu_again, S_again, _ = unscented.update(q, v, lla, x, P, z, h, R, scaling=scaling)
    np.testing.assert_allclose(seven[0], nu, atol=1e-10)  # the same from 7 points
    np.testing.assert_allclose(seven[1], S, atol=1e-10)
    np.testing.assert_allclose(P_seven / np.outer(scale, scale), P / np.outer(scale, scale), atol=1e-9)
    np.testing.assert_array_equal(nu, nu_again)
    np.testing.assert_array_equal(S, S_again)
    np.testing.assert_allclose(P / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-8)
    # the correction has been made: the estimate has moved by the mean error
    start = estimate(n)
    moved = errors_of(
        unscented.Points(*(np.stack([new, old]) for new, old in zip((q, v, lla, x), start, strict=True)))
    )[1]
    np.testing.assert_allclose(np.delete(moved, [6, 7, 8]), -np.delete(K @ nu, [6, 7, 8]), atol=1e-9)


@pytest.mark.ci
def test_update_refuses_beyond_the_threshold():
    q, v, lla, x = estimate(15)
    P = np.eye(15)
    before = P.copy()
    _, _, nis = unscented.update(q, v, lla, x, P, np.array([99.0]), lambda p: p.v_n[:, :1], np.ones(1), threshold=9.0)
    assert nis > 9
    np.testing.assert_array_equal(P, before)
    assert v[0] == 20.0


def transition(model, state, sums, T):
    Phi = np.zeros((9, model.mixing))
    error_model.transition(Phi, np.zeros_like(Phi), model.driven, state[1], state[2][0], state[2][2], sums, T)
    return Phi


def advance(state, errors, dtheta, dv):
    """Strapdown of measured increments in place, less the ``errors`` (4, 3); the integrals over the way."""
    q, v, lla = state
    sums = np.zeros((3, 3, 3))
    for k in range(len(dtheta)):
        angle = (dtheta[k] - errors[0] * DT) / (1 + errors[2])
        push = (dv[k] - errors[1] * DT) / (1 + errors[3])
        before = dcm_from_quat(q)
        strapdown.step(q, v, lla, angle, push, DT)
        middle = 0.5 * (before + dcm_from_quat(q))
        sums += np.stack([middle * DT, middle * angle, middle * push])
    return sums


def test_small_errors_take_the_linear_step():
    model = ErrorModel(IMU, [error_model.markov("gust", 2, 1.5, 3.0)])
    n = model.size
    rng = np.random.default_rng(5)
    scale = np.array([1e-7] * 3 + [1e-3] * 3 + [1.0] * 3 + [1e-7] * 3 + [1e-4] * 3 + [1.0] * 2)
    state = estimate(n)[:3]
    sums = np.stack([dcm_from_quat(state[0])] * 3) * np.array([1.0, 0.1, 9.8])[:, None, None]
    Phi = transition(model, state, sums, 1.0)
    decay, half = np.exp(-model.decay_rate), 0.5 * (1e-2 * scale) ** 2
    P = positive(rng, n, scale)
    P_linear = P.copy()
    kalman.predict(P_linear, Phi, decay, half, np.empty((9, n)), n)
    mean = unscented.predict(
        P, Phi, decay, half, unscented.scratch(n), sums[2].sum(axis=1), 1.0, ONE.spread, ONE.excess
    )
    sigma = np.sqrt(np.diag(P_linear))
    np.testing.assert_allclose((P - P_linear) / np.outer(sigma, sigma), 0.0, atol=1e-10)
    np.testing.assert_allclose(mean / sigma, 0.0, atol=1e-5)
    assert (P == P.T).all()


@pytest.mark.parametrize("level", [5 * DEG, 20 * DEG])
def test_time_update_is_a_strapdown_of_every_point(level):
    """All 31 points through the non-linear strapdown for a second of turning flight, summed with the printed weights.

    What `predict` says beyond the linear step must be what they say beyond it, to two per cent.
    """
    model = ErrorModel(ImuModel(0.0, 0.0, 1e-3, 0.05))
    n = model.size
    truth = flight(60.0)
    rows = slice(8001, 8201)
    dtheta, dv = truth.dtheta[rows], truth.dv[rows]
    rng = np.random.default_rng(6)
    scale = np.array([level] * 3 + [0.5] * 3 + [5.0] * 3 + [1e-3] * 3 + [0.05] * 3)
    correlation = positive(rng, n) + 10 * np.eye(n)
    deviation = np.sqrt(np.diag(correlation))
    P = correlation / np.outer(deviation, deviation) * np.outer(scale, scale)
    state = truth.q_nb[8000].copy(), truth.v_n[8000].copy(), np.array([truth.lat[8000], truth.lon[8000], truth.h[8000]])
    scaling = Scaling(alpha=1.0)
    points = unscented.points(*state, np.zeros(n), unscented.factor(P, n), scaling.spread)
    ends, errors = [], np.zeros((4, 3))
    for k in range(2 * n + 1):
        sensor_errors(errors, points.x[k], model.driven)
        point = points.q_nb[k].copy(), points.v_n[k].copy(), points.lla[k].copy()
        sums = advance(point, errors, dtheta, dv)
        ends.append((*point, points.x[k]))
        if k == 0:
            Phi = transition(model, point, sums, 1.0)
            push_n = sums[2].sum(axis=1)
    e = errors_of(unscented.Points(*(np.array(part) for part in zip(*ends, strict=True))))
    c = scaling.spread**2
    W = np.full(2 * n + 1, 0.5 / c)
    W[0] = 1 - n / c
    mean = W @ e
    Wc = W.copy()
    Wc[0] += 1 - scaling.alpha**2 + scaling.beta
    expected = np.einsum("k,ki,kj->ij", Wc, e - mean, e - mean)

    linear = P.copy()
    none, still = np.zeros(n), np.ones(n)
    kalman.predict(linear, Phi, still, none, np.empty((9, n)), n)
    shift = unscented.predict(P, Phi, still, none, unscented.scratch(n), push_n, 1.0, scaling.spread, scaling.excess)
    sigma = np.sqrt(np.diag(expected))
    beyond = np.abs((expected - linear) / np.outer(sigma, sigma)).max()
    missed = np.abs((P - expected) / np.outer(sigma, sigma)).max()
    assert beyond > 0.05
    assert missed < 0.02 * beyond
    assert np.abs(mean / sigma).max() > 0.1
    assert np.abs((mean - shift) / sigma).max() < 0.005 * np.abs(mean / sigma).max()


class Filter:
    """The same filter with either engine: strapdown, a covariance step each second, GNSS position and velocity."""

    def __init__(self, engine, state, sigma):
        self.engine, self.model = engine, ErrorModel(IMU)
        self.state, self.x, self.P = state, np.zeros(self.model.size), np.diag(sigma**2)

    def second(self, dtheta, dv, z_place, z_velocity, R):
        model, n = self.model, self.model.size
        errors = np.zeros((4, 3))
        sensor_errors(errors, self.x, model.driven)
        sums = advance(self.state, errors, dtheta, dv)
        T = len(dtheta) * DT
        Phi = transition(model, self.state, sums, T)
        step = (self.P, Phi, np.exp(-T * model.decay_rate), 0.5 * T * model.density**2, unscented.scratch(n))
        if self.engine == "linear":
            kalman.predict(*step, n)
        else:
            shift = unscented.predict(*step, sums[2].sum(axis=1), T, ONE.spread, ONE.excess)
            unscented.remove(*self.state, self.x, shift)
        place = self.state[2].copy()
        z = np.concatenate([position_difference_n(*z_place, *place), z_velocity])
        H = np.zeros((6, n))
        H[:3, 6:9] = H[3:, 3:6] = np.eye(3)
        if self.engine == "linear":
            nu = z - np.concatenate([np.zeros(3), self.state[1]])
            _, S_inverse, HP, _ = kalman.innovate(self.P, H, R, nu)
            unscented.remove(*self.state, self.x, -kalman.correct(self.P, H, R, HP, S_inverse, nu))
        else:
            unscented.update(
                *self.state, self.x, self.P, z,
                lambda p: np.hstack([position_difference_n(*p.lla.T, *place), p.v_n]), R, H,
            )  # fmt: skip


@functools.cache
def from_bad_alignment(engine, level_deg, heading_deg, seconds, seed):
    """Attitude errors (seconds, 3) and their normalised squares (seconds,), from a wrong alignment."""
    truth = flight(100.0)
    rng = np.random.default_rng(seed)
    sigma = np.array([level_deg * DEG] * 2 + [heading_deg * DEG] + [0.3] * 3 + [3.0] * 3 + [2e-4] * 3 + [0.02] * 3)
    wrong = sigma * rng.normal(size=15)
    first = 2000
    q = quat_multiply(quat_from_rotvec(-wrong[:3]), truth.q_nb[first])
    lla = np.array([truth.lat[first], truth.lon[first], truth.h[first]])
    state = q, truth.v_n[first] + wrong[3:6], lla + wrong[6:9] * np.array([1.57e-7, 2.3e-7, -1.0])
    filter_ = Filter(engine, state, sigma)
    R = np.array([1.0] * 3 + [0.1] * 3) ** 2
    phi, nees = [], []
    for k in range(seconds):
        a = first + 200 * k
        rows, b = slice(a + 1, a + 201), a + 200
        gyro = truth.dtheta[rows] - wrong[9:12] * DT + IMU.gyro_noise * np.sqrt(DT) * rng.normal(size=(200, 3))
        accel = truth.dv[rows] - wrong[12:15] * DT + IMU.accel_noise * np.sqrt(DT) * rng.normal(size=(200, 3))
        noise = np.sqrt(R) * rng.normal(size=6)
        place = np.array([truth.lat[b], truth.lon[b], truth.h[b]]) + noise[:3] * np.array([1.57e-7, 2.3e-7, -1.0])
        filter_.second(gyro, accel, place, truth.v_n[b] + noise[3:], R)
        turned = (
            Rotation.from_quat(filter_.state[0], scalar_first=True)
            * Rotation.from_quat(truth.q_nb[b], scalar_first=True).inv()
        )
        e = -turned.as_rotvec()
        phi.append(e)
        nees.append(e @ np.linalg.solve(filter_.P[:3, :3], e))
    return np.array(phi), np.array(nees), np.linalg.eigvalsh(filter_.P).min()


def test_small_misalignment_is_the_linear_filter():
    linear, sigma_points = (from_bad_alignment(engine, 0.005, 0.02, 20, 0)[0] for engine in ("linear", "sigma"))
    np.testing.assert_allclose(sigma_points, linear, atol=5e-6)


@pytest.mark.ci
def test_converges_from_a_bad_alignment():
    """8 deg of level and 60 deg of heading error (1 sigma), GNSS each second in flight: twelve runs with either engine.

    After 20 s the linear filter is wrong by tens of degrees and sure of itself; the sigma points find the heading.
    """
    results = {}
    for engine in ("linear", "sigma"):
        runs = [from_bad_alignment(engine, 8.0, 60.0, 21, seed) for seed in range(12)]
        heading = np.sqrt(np.mean([phi[-1, 2] ** 2 for phi, _, _ in runs])) / DEG
        level = np.sqrt(np.mean([phi[-1, :2] ** 2 for phi, _, _ in runs])) / DEG
        results[engine] = heading, level, np.median([nees[-1] for _, nees, _ in runs])
        assert all(smallest > 0 for _, _, smallest in runs)
    assert results["sigma"][0] < 0.3 * results["linear"][0]
    assert results["sigma"][1] < 0.5 * results["linear"][1]
    assert results["sigma"][1] < 1.0
    assert results["sigma"][2] < chi2.ppf(0.99, 3) < results["linear"][2]


def hostile(updates):
    """Large misalignments, measurements a million times sharper than the prior, states from 1e-6 to 1e3."""
    rng = np.random.default_rng(7)
    n = 15
    scale = np.array([1.0] * 3 + [10.0] * 3 + [1e3] * 3 + [1e-6] * 3 + [1e-4] * 3)
    P = positive(rng, n, scale) / n
    Phi = np.eye(9, n) + 1e-3 * rng.normal(size=(9, n)) * np.outer(scale[:9], 1 / scale)
    half, decay, work = (1e-7 * scale) ** 2, np.ones(n), unscented.scratch(n)
    R = np.full(3, 1e-6)
    slopes = rng.normal(size=(100, 3, n)) / scale
    numbers = rng.normal(size=(100, 7, 3))
    pushes = 50 * rng.normal(size=(100, 3))
    for k in range(updates):
        i = k % 100
        mean = unscented.predict(P, Phi, decay, half, work, pushes[i], 1.0, ONE.spread, ONE.excess)
        root = unscented.factor(P, 3)
        Z = numbers[i] if i % 10 == 0 else numbers[i] * 1e-6
        _, _, W, nis = unscented.innovate(P, Z, numbers[i, 0], R, root, slopes[i], work, ONE.spread, ONE.excess)
        found = unscented.correct(P, W, work)
        if i == 0:
            assert np.isfinite(nis)
            assert np.isfinite(mean).all()
            assert np.isfinite(found).all()
            P += np.outer(scale, scale) * np.diag(rng.uniform(0, 1e-2, n))
    assert (P == P.T).all()
    sigma = np.sqrt(np.diag(P))
    assert np.linalg.eigvalsh(P / np.outer(sigma, sigma)).min() > 0


def test_positive_after_hostile_updates():
    hostile(3000)


@pytest.mark.slow
def test_positive_after_a_hundred_thousand_hostile_updates():
    hostile(100_000)
