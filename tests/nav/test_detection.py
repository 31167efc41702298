"""The detectors against least squares, exact distributions and brute force."""

import itertools

import numpy as np
import pytest
from scipy import stats
from worlds.innovations import alarm_share, positive, within_binomial

from nav.detection import (
    ChiSquare,
    Eraim,
    Event,
    Glr,
    Recursive,
    Reset,
    Sprt,
    WindowMean,
    chi_square_threshold,
    exponential,
    glr_false_alarm,
    glr_threshold,
    plain,
    w_tests,
    whiten,
)

MEANS = {"plain": plain, "exponential": lambda: exponential(0.9), "window": lambda: WindowMean(8.0)}

DETECTORS = {
    "chi-square": lambda: ChiSquare(1e-3),
    "eraim": lambda: Eraim(1e-3),
    "sprt": lambda: Sprt(1e-3, exponential(0.9), Reset.COMPLETE),
    "recursive": lambda: Sprt(1e-3, exponential(0.9), Reset.FAST, Recursive()),
    "glr": lambda: Glr(1e-3),
}


# --- one look ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("m", [1, 2, 3, 6])
def test_whitening(m):
    rng = np.random.default_rng(m)
    S, nu = positive(rng, m), rng.normal(size=m)
    r, gamma2 = whiten(nu, S)
    np.testing.assert_allclose(r[0], np.linalg.solve(np.linalg.cholesky(S), nu), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(r[1], nu / np.sqrt(np.diag(S)), rtol=1e-12)
    np.testing.assert_allclose(gamma2, nu @ np.linalg.solve(S, nu), rtol=1e-9)


@pytest.mark.parametrize(
    ("nu", "S"),
    [
        (np.zeros(2), np.array([[1.0, 2.0], [2.0, 1.0]])),
        (np.zeros(2), np.full((2, 2), np.nan)),
        (np.array([0.0, np.nan]), np.eye(2)),
        (np.array([np.inf, 0.0]), np.eye(2)),
        (np.array([1e200, 0.0]), np.eye(2)),
    ],
)
def test_what_cannot_be_judged_is_an_alarm_and_is_forgotten(nu, S):
    for build in DETECTORS.values():
        detector = build()
        detector.step(np.ones(2), np.eye(2), 0.0)
        bad = detector.step(nu, S, 1.0)
        assert bad.alarm
        assert bad.event is Event.ONSET
        assert not np.isfinite(bad.statistic)
        assert not bad.axis_mask.all()
        good = detector.step(np.ones(2), np.eye(2), 2.0)
        assert good.event is Event.END
        assert np.isfinite(good.statistic)
        assert good.axis_mask.all()


def test_quantiles():
    for m, p in itertools.product([1, 2, 3, 6, 9], [1e-1, 1e-3, 1e-5, 1e-9]):
        assert chi_square_threshold(p, m) == pytest.approx(stats.chi2.isf(p, m), rel=1e-9)
    limits = [chi_square_threshold(1e-5, m) for m in (1, 2, 3, 6)]
    np.testing.assert_allclose(limits, [19.51, 23.03, 25.90, 33.11], atol=0.006)
    # On one axis the w-test and the global test are the same.
    assert np.sqrt(limits[0]) == pytest.approx(stats.norm.isf(0.5e-5), rel=1e-9)
    for p in (0.0, 1.0, -0.1):
        with pytest.raises(ValueError, match="probability"):
            chi_square_threshold(p, 1)


@pytest.mark.parametrize("m", [1, 3, 6])
def test_chi_square_false_alarms(m):
    rng = np.random.default_rng(m)
    detector, looks, p = ChiSquare(0.01), 8000, 0.01
    alarms = 0
    for k in range(looks):
        if k % 100 == 0:
            S = positive(rng, m)
            L = np.linalg.cholesky(S)
        alarms += detector.step(L @ rng.normal(size=m), S, float(k)).alarm
    assert within_binomial(alarms, looks, p)


# --- ERAIM: least squares over the measurement and the prediction -----------------------------------------------------


def stacked_least_squares(H, R, P, nu):
    """(v' C^-1 v, |w| per measurement) of l = [z; x-], with x- = 0 and so z = nu, by the normal equations."""
    m, n = H.shape
    A = np.vstack([H, np.eye(n)])
    C = np.zeros((m + n, m + n))
    C[:m, :m], C[m:, m:] = R, P
    W = np.linalg.inv(C)
    l = np.concatenate([nu, np.zeros(n)])  # noqa: E741
    N = np.linalg.inv(A.T @ W @ A)
    v = A @ (N @ A.T @ W @ l) - l
    Qv = C - A @ N @ A.T
    w = (W @ v) / np.sqrt(np.diag(W @ Qv @ W))
    return v @ W @ v, np.abs(w[:m])


def test_eraim_is_stacked_least_squares():
    rng = np.random.default_rng(5)
    for m, n in [(1, 4), (3, 9), (6, 9)]:
        H, R, P = rng.normal(size=(m, n)), positive(rng, m), positive(rng, n)
        S = H @ P @ H.T + R
        nu = 4 * rng.normal(size=m)
        statistic, w = stacked_least_squares(H, R, P, nu)
        assert Eraim(1e-3).step(nu, S, 0.0).statistic == pytest.approx(statistic, rel=1e-8)
        np.testing.assert_allclose(w_tests(nu, S), w, rtol=1e-7)


def test_eraim_excludes_as_least_squares_without_the_row():
    rng = np.random.default_rng(11)
    excluded = set()
    for _ in range(60):
        m, n = 6, 8
        H, R, P = rng.normal(size=(m, n)), np.diag(rng.uniform(0.5, 2, m)), positive(rng, n)
        S = H @ P @ H.T + R
        nu = np.linalg.cholesky(S) @ rng.normal(size=m)
        nu[rng.choice(m, rng.integers(0, 4), replace=False)] += 30 * np.sqrt(np.diag(S).max())
        used = list(range(m))
        while used:
            statistic, w = stacked_least_squares(H[used], R[np.ix_(used, used)], P, nu[used])
            if statistic <= stats.chi2.isf(1e-3, len(used)):
                break
            used.pop(int(w.argmax()))
        decision = Eraim(1e-3).step(nu, S, 0.0)
        assert np.flatnonzero(decision.axis_mask).tolist() == used
        assert decision.alarm == (len(used) < m)
        excluded.add(m - len(used))
    assert {0, 1, 2, 3} <= excluded


def test_eraim_keeps_the_sound_axes_of_a_partly_failed_receiver():
    S = np.diag([400.0, 400.0, 400.0, 0.09, 0.09, 0.09]) + 0.02
    nu = np.array([5.0, 460.6, -8.0, 0.1, np.nan, 0.2])  # a longitude step of 0.3' and a velocity that is no number
    assert Eraim(1e-5).step(nu, S, 0.0).axis_mask.tolist() == [True, False, True, True, False, True]
    nu[4] = 0.0
    assert Eraim(1e-5).step(nu, S, 0.0).axis_mask.tolist() == [True, False, True, True, True, True]
    assert not ChiSquare(1e-5).step(nu, S, 0.0).axis_mask.any()


# --- evidence over looks ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mean", "weights"),
    [
        (plain, lambda k: np.ones(k)),
        (lambda: exponential(0.8), lambda k: 0.8 ** np.arange(k)[::-1]),
        (lambda: WindowMean(7.0), lambda k: (np.arange(k)[::-1] < 7).astype(float)),
    ],
)
def test_means(mean, weights):
    rng = np.random.default_rng(2)
    rows, running = rng.normal(size=(300, 2, 3)), mean()
    for k in range(1, 301):
        running.add(rows[k - 1], float(k))
        w = weights(k) / weights(k).sum()
        np.testing.assert_allclose(running.value, np.tensordot(w, rows[:k], 1), rtol=1e-9, atol=1e-12)
        assert running.variance == pytest.approx(w @ w)


def test_window_is_of_time():
    mean, value = WindowMean(10.0), np.ones((2, 1))
    for k in range(500):
        mean.add(value, 0.1 * k)
    assert mean.n in (100, 101)
    mean.add(value, 55.0)  # after a gap of 5 s
    assert mean.n == pytest.approx(51, abs=1)
    mean.add(value, 90.0)
    assert mean.n == 1


@pytest.mark.ci
@pytest.mark.parametrize("name", MEANS)
def test_quadratic_evidence_has_the_stated_rate(name):
    rng = np.random.default_rng(7)
    m, p, runs, looks = 2, 0.05, 2000, 15
    L = [np.linalg.cholesky(positive(rng, m)) for _ in range(looks)]
    S = [a @ a.T for a in L]
    alarms = 0
    for _ in range(runs):
        detector = Sprt(p, MEANS[name]())
        for k in range(looks):
            decision = detector.step(L[k] @ rng.normal(size=m), S[k], float(k))
        alarms += decision.alarm
    assert decision.threshold == pytest.approx(0.5 * stats.chi2.isf(p, m))
    assert within_binomial(alarms, runs, p)


def test_recursive_evidence_keeps_within_the_stated_rate():
    rng = np.random.default_rng(8)
    p, runs, looks = 0.02, 100, 200
    share = np.mean([alarm_share(Sprt(p, exponential(0.95), evidence=Recursive()), rng, 3, looks) for _ in range(runs)])
    assert share <= p
    ever = [alarm_share(Sprt(p, plain(), evidence=Recursive()), rng, 3, looks) > 0 for _ in range(runs)]
    assert np.mean(ever) <= p + 4 * np.sqrt(p / runs)  # Ville's inequality: at any look


# --- resets -----------------------------------------------------------------------------------------------------------


def after_a_fault(**options):
    """(decisions, detector) over 100 looks at 5 sigma and 60 at zero, at 5 Hz."""
    detector = Sprt(1e-3, exponential(0.95), **options)
    x = np.concatenate([np.full(100, 5.0), np.zeros(60)])
    return [detector.step(x[k : k + 1], np.eye(1), 0.2 * k) for k in range(len(x))], detector


def test_without_reset_the_alarm_outlives_the_fault():
    decisions, _ = after_a_fault()
    assert 30 < sum(d.alarm for d in decisions[100:]) < 60
    assert [d.event for d in decisions].count(Event.ONSET) == [d.event for d in decisions].count(Event.END) == 1


def test_complete_reset_starts_again_from_the_look():
    decisions, detector = after_a_fault(reset=Reset.COMPLETE)
    assert all(d.alarm for d in decisions[5:100])
    assert decisions[100].event is Event.END
    assert decisions[100].statistic == 0.0
    assert not any(d.alarm for d in decisions[100:])
    assert detector.mean.n == pytest.approx((1 - 0.95**60) / 0.05)


def test_fast_reset_lasts_with_recursive_evidence_only():
    decisions, _ = after_a_fault(reset=Reset.FAST)
    kept, _ = after_a_fault()
    assert decisions[101].statistic == kept[101].statistic
    recursive, _ = after_a_fault(reset=Reset.FAST, evidence=Recursive())
    assert not any(d.alarm for d in recursive[100:])
    assert min(d.statistic for d in recursive[100:]) < -20  # the next fault has to climb out of this first
    again, _ = after_a_fault(reset=Reset.COMPLETE, evidence=Recursive())
    assert min(d.statistic for d in again[100:]) == 0.0


# --- generalised likelihood ratio -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("m", "n"), [(1, 1), (1, 40), (3, 40), (6, 20)])
def test_glr_limit_has_the_stated_rate(m, n):
    p, runs = 4e-3, 20000
    rng = np.random.default_rng(m)
    sums = np.cumsum(rng.normal(size=(runs, n, m)), axis=1)
    largest = ((sums**2).sum(axis=2) / (2 * np.arange(1, n + 1))).max(axis=1)
    count = int((largest > glr_threshold(p, m, n)).sum())
    # the approximation itself is good to a tenth
    assert abs(count - runs * p) <= 0.1 * runs * p + 3 * np.sqrt(runs * p)


def test_glr_limits_are_in_order():
    for m in (1, 2, 3, 6):
        limits = [glr_threshold(2e-4, m, n) for n in range(1, 401)]
        assert limits[0] == pytest.approx(0.5 * stats.chi2.isf(2e-4, m))
        assert (np.diff(limits) > 0).all()
        assert glr_false_alarm(limits[-1], m, 400) == pytest.approx(2e-4)


def test_glr_statistic_is_the_largest_over_onsets():
    rng = np.random.default_rng(4)
    detector, x = Glr(1e-9, window_s=5.9), rng.normal(size=(200, 2))
    for k in range(200):
        decision = detector.step(x[k], np.eye(2), 0.2 * k)
        tail = x[max(0, k - 29) : k + 1][::-1]
        brute = max(0.5 * np.sum(tail[:j].sum(axis=0) ** 2) / j for j in range(1, len(tail) + 1))
        assert decision.statistic == pytest.approx(brute)


def test_glr_false_alarms_of_the_detector():
    rng = np.random.default_rng(12)
    p, runs, looks = 0.01, 1500, 30
    alarms = 0
    for _ in range(runs):
        detector, x = Glr(p), rng.normal(size=(looks, 2))
        for k in range(looks):
            decision = detector.step(x[k], np.eye(2), 0.2 * k)
        alarms += decision.statistic > decision.threshold
    assert abs(alarms - runs * p) <= 0.1 * runs * p + 4 * np.sqrt(runs * p)


def test_glr_follows_a_fault_and_sees_its_end():
    detector = Glr(1e-4)
    x = np.concatenate([np.zeros(50), np.linspace(0, 8, 200), np.zeros(50)])
    decisions = [detector.step(x[k : k + 1], np.eye(1), 0.2 * k) for k in range(300)]
    events = [(k, d.event) for k, d in enumerate(decisions) if d.event is not Event.NONE]
    assert [event for _, event in events] == [Event.ONSET, Event.END]
    assert events[0][0] < 120
    assert events[1][0] == 250  # at 7 sigma one sound look is 24 nats of evidence


# --- all detectors ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", DETECTORS)
def test_units_do_not_matter_even_if_they_change(name):
    rng = np.random.default_rng(6)
    one, other = DETECTORS[name](), DETECTORS[name]()
    S = positive(rng, 3)
    for k in range(150):
        nu = np.linalg.cholesky(S) @ rng.normal(size=3) + (np.array([0, 3.0, 0]) if 50 <= k < 100 else 0.0)
        scale = np.diag(rng.uniform(0.1, 10.0, 3))
        a, b = one.step(nu, S, 0.2 * k), other.step(scale @ nu, scale @ S @ scale, 0.2 * k)
        assert (a.alarm, a.event, a.threshold) == (b.alarm, b.event, b.threshold)
        assert a.statistic == pytest.approx(b.statistic, rel=1e-9, abs=1e-9)
        assert (a.axis_mask == b.axis_mask).all()


@pytest.mark.parametrize("name", ["eraim", "sprt", "recursive", "glr"])
def test_the_faulty_axes_are_named(name):
    rng = np.random.default_rng(13)
    S = np.array([[2.0, 0.3, 0.1], [0.3, 1.0, 0.2], [0.1, 0.2, 0.5]])
    L = np.linalg.cholesky(S)
    for faulty in ([0], [1], [0, 2]):
        detector, right = DETECTORS[name](), 0
        bias = np.zeros(3)
        bias[faulty] = 6.0 * np.sqrt(np.diag(S)[faulty])
        for k in range(100):
            decision = detector.step(L @ rng.normal(size=3) + (bias if k >= 50 else 0.0), S, 0.2 * k)
            right += k >= 60 and np.flatnonzero(~decision.axis_mask).tolist() == faulty
        assert right >= 36, (faulty, right)


def test_a_fault_that_no_axis_shows_takes_out_all():
    S, bias = np.eye(6), np.full(6, 0.45)
    for detector in (Sprt(1e-3, plain()), Glr(1e-4)):
        decisions = [detector.step(bias, S, 0.2 * k) for k in range(60)]
        first = next(d for d in decisions if d.alarm)
        assert not first.axis_mask.any()


@pytest.mark.parametrize("s", [0.0, 1.0, 1.5])
def test_forgetting_factor_is_checked(s):
    with pytest.raises(ValueError, match="forgetting"):
        exponential(s)
