"""The federated filter: against a centralised one, honest with itself, safe from a faulty sensor."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.stats import chi2
from worlds.covariances import lost_position, position_and_its_error, scaled_eigenvalues
from worlds.federated import DETECTORS, differ, field, fly, horizontal, ramp, three, true_start, world
from worlds.ins import CONSUMER, DEG, DT, airspeed, error, feed, gnss

from nav.aids import AirspeedAid, BarometerAid, GnssAid, MagnetometerAid
from nav.detection import Decision, Event
from nav.error_model import POS
from nav.federated import Federated
from nav.federation import Config, Local
from nav.fusion import blend, combine, reset, weights_by_covariance
from nav.horizon import FusionHorizon
from nav.ins import Ins, InsConfig
from nav.local_filter import LocalFilter
from nav.monitor import MonitoredAid
from nav.samples import NO_SENSOR, AirspeedSample, BarometerSample, FixType, ImuSamples, Outcome, Status
from nav.weighting import MahalanobisInflation, SageHusa, Weight

INFORMATION = Config(CONSUMER, (Local("only", ()),))
SCALAR = Config(CONSUMER, (Local("only", ()),), sharing="none", combination="scalar")
INTERSECTION = Config(CONSUMER, (Local("only", ()),), sharing="none", combination="covariance_intersection")


# --- the arithmetic, against oracles written here


def spread(rng, n):
    A = rng.normal(size=(n, n))
    return A @ A.T + 0.1 * np.eye(n)


def kalman(x, P, H, R, z):
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return x + K @ (z - H @ x), P - K @ H @ P


def test_full_reset_is_the_centralised_filter():
    """Position and velocity driven by noise, a fix of each by two filters: shares 0.3 and 0.7, reset at each step."""
    rng = np.random.default_rng(0)
    Phi, Q = np.array([[1.0, 0.2], [0.0, 1.0]]), np.diag([1e-3, 0.02])
    H = [np.array([[1.0, 0.0]]), np.array([[0.3, 1.0]])]
    R = [np.array([[4.0]]), np.array([[0.25]])]
    shares = np.array([0.3, 0.7])
    central = np.zeros(2), np.diag([100.0, 4.0])
    x, P = np.zeros((2, 2)), np.stack([central[1] / share for share in shares])
    for _ in range(200):
        z = [rng.normal(size=1) for _ in H]
        central = Phi @ central[0], Phi @ central[1] @ Phi.T + Q
        for i in range(2):
            central = kalman(*central, H[i], R[i], z[i])
            x[i], P[i] = Phi @ x[i], Phi @ P[i] @ Phi.T + Q / shares[i]
            x[i], P[i] = kalman(x[i], P[i], H[i], R[i], z[i])
        master = combine(x, P, 2, np.ones(2), INFORMATION.combination)
        for i in range(2):
            reset(x[i], P[i], master.x, master.P / shares[i])
        np.testing.assert_allclose(master.x, central[0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(master.P, central[1], rtol=1e-9)


def test_what_a_filter_knows_of_its_aid_survives_a_reset():
    """Four common states, an aid error in each of two filters, no process noise: still the centralised filter."""
    rng = np.random.default_rng(1)
    P0, x0 = spread(rng, 4), rng.normal(size=4)
    aid = [2.0, 0.5]  # variances
    central = np.r_[x0, 0.0, 0.0], np.zeros((6, 6))
    central[1][:4, :4], central[1][4, 4], central[1][5, 5] = P0, *aid
    x, P = np.zeros((2, 5)), np.zeros((2, 5, 5))
    for i in range(2):
        x[i, :4], P[i, :4, :4], P[i, 4, 4] = x0, 2 * P0, aid[i]
    for k in range(60):
        i = k % 2
        H_c, z, R = rng.normal(size=(2, 4)), rng.normal(size=2), np.diag([0.3, 0.1])
        local = np.c_[H_c, [1.0, 0.0]]
        whole = np.zeros((2, 6))
        whole[:, :4], whole[0, 4 + i] = H_c, 1.0
        central = kalman(*central, whole, R, z)
        x[i], P[i] = kalman(x[i], P[i], local, R, z)
        if k % 3 == 2:
            master = combine(x, P, 4, np.ones(2), INFORMATION.combination)
            for f in range(2):
                reset(x[f], P[f], master.x, 2 * master.P)
            np.testing.assert_allclose(master.x, central[0][:4], rtol=0, atol=1e-9)
            np.testing.assert_allclose(master.P, central[1][:4, :4], rtol=1e-9, atol=1e-12)
            # The common states that a filter holds are told with its share; given them, the aid's error is whole.
            for f in range(2):
                G = np.linalg.solve(P[f, :4, :4], P[f, :4, 4])
                mean, variance = x[f, 4], P[f, 4, 4] - G @ P[f, :4, :4] @ G + G @ master.P @ G
                assert mean == pytest.approx(central[0][4 + f], abs=1e-9)
                assert variance == pytest.approx(central[1][4 + f, 4 + f], rel=1e-9)


def toy_covariances(shared, steps=60):
    """(claimed, actual) covariance of two filters' fusion without resets: both are linear in the noise."""
    Phi, Q, R = np.array([[1.0, 1.0], [0.0, 1.0]]), np.diag([0.01, 0.02]), (4.0, 1.0)
    H, inflation = np.array([[1.0, 0.0]]), 2.0 if shared else 1.0
    P0 = np.diag([25.0, 1.0])
    P = np.stack([P0 * inflation] * 2)
    joint = np.kron(np.ones((2, 2)), P0)  # both filters begin with the same error
    for _ in range(steps):
        joint = np.kron(np.eye(2), Phi) @ joint @ np.kron(np.eye(2), Phi).T + np.kron(np.ones((2, 2)), Q)
        for i in range(2):
            P[i] = Phi @ P[i] @ Phi.T + Q * inflation
            K = P[i] @ H.T / (H @ P[i] @ H.T + R[i])
            P[i] = P[i] - K @ H @ P[i]
            L = np.eye(4)
            L[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] -= K @ H
            joint = L @ joint @ L.T
            joint[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += R[i] * K @ K.T
    claimed = combine(np.zeros((2, 2)), P, 2, np.ones(2), INFORMATION.combination).P
    gain = np.hstack([claimed @ np.linalg.inv(p) for p in P])
    return claimed, gain @ joint @ gain.T


def test_without_resets_the_noise_must_be_shared():
    """Exact covariance of the fused error against the claimed one: at least as large in every direction, or not."""
    claimed, actual = toy_covariances(shared=True)
    assert np.linalg.eigvalsh(claimed - actual).min() > 0
    assert np.trace(np.linalg.solve(claimed, actual)) / 2 > 0.7  # and not by much
    claimed, actual = toy_covariances(shared=False)
    assert np.trace(np.linalg.solve(claimed, actual)) / 2 > 1.15
    assert math.sqrt(actual[1, 1] / claimed[1, 1]) > 1.1


def test_marginalises_to_the_common_states():
    """The sub-block of P is taken and inverted; the sub-block of the inverse would take the aid's error for known."""
    rng = np.random.default_rng(3)
    P, x = np.stack([spread(rng, 6), spread(rng, 6)]), rng.normal(size=(2, 6))
    master = combine(x, P, 4, np.ones(2), INFORMATION.combination)
    inverses = [np.linalg.inv(p[:4, :4]) for p in P]
    P_g = np.linalg.inv(sum(inverses))
    np.testing.assert_allclose(master.P, P_g, rtol=1e-9)
    np.testing.assert_allclose(master.x, P_g @ sum(i @ v[:4] for i, v in zip(inverses, x, strict=True)), rtol=1e-9)
    wrong = np.linalg.inv(sum(np.linalg.inv(p)[:4, :4] for p in P))
    assert np.linalg.eigvalsh(P_g - wrong).min() > 0


def test_units_that_differ_by_twelve_orders_are_no_trouble():
    rng = np.random.default_rng(4)
    unit = np.diag(np.r_[np.full(3, 1e-3), np.full(3, 0.1), np.full(3, 1e3), np.full(3, 1e-7), np.full(3, 1e-2)])
    correlation = [np.eye(15) + 0.05 * spread(rng, 15) / 15 for _ in range(3)]
    P = np.stack([unit @ c @ unit for c in correlation])
    master = combine(np.zeros((3, 15)), P, 15, np.ones(3), INFORMATION.combination)
    units = np.outer(unit.diagonal(), unit.diagonal())
    expected = np.linalg.inv(sum(np.linalg.inv(c) for c in correlation))
    np.testing.assert_allclose(master.P / units, expected, rtol=1e-9, atol=1e-12)


def test_a_member_with_weight_zero_is_left_out():
    rng = np.random.default_rng(5)
    P, x = np.stack([spread(rng, 9), spread(rng, 9)]), rng.normal(size=(2, 9))
    for config in (INFORMATION, SCALAR, INTERSECTION):
        master = combine(x, P, 9, np.array([0.0, 1.0]), config.combination)
        np.testing.assert_allclose(master.x, x[1], rtol=1e-9)
        np.testing.assert_allclose(master.P, P[1], rtol=1e-9)


@pytest.mark.parametrize("config", [SCALAR, INTERSECTION])
@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_scalar_weights_and_intersection_hold_for_any_correlation(config, correlation):
    """Two errors of known covariance and cross-covariance: the claim is never below what the fused error has."""
    rng = np.random.default_rng(6)
    P = np.stack([spread(rng, 9), spread(rng, 9)])
    cross = correlation * np.linalg.cholesky(P[0]) @ np.linalg.cholesky(P[1]).T
    joint = np.block([[P[0], cross], [cross.T, P[1]]])
    claimed, weights = (lambda m: (m.P, m.weights))(combine(np.zeros((2, 9)), P, 9, np.ones(2), config.combination))
    assert weights.sum() == pytest.approx(1.0)
    if config is SCALAR:
        gain = np.hstack([w * np.eye(9) for w in weights])
    else:
        gain = np.hstack([w * claimed @ np.linalg.inv(p) for w, p in zip(weights, P, strict=True)])
    assert np.linalg.eigvalsh(claimed - gain @ joint @ gain.T).min() > -1e-9


def test_blend_goes_from_own_to_shared():
    rng = np.random.default_rng(7)
    (P, P_g), (x, x_g) = (spread(rng, 4), spread(rng, 4)), rng.normal(size=(2, 4))
    np.testing.assert_allclose(blend(x, P, x_g, P_g, 0.0)[1], P, rtol=1e-9)
    np.testing.assert_allclose(blend(x, P, x_g, P_g, 1.0)[0], x_g, rtol=1e-9)
    half = np.linalg.inv(0.5 * np.linalg.inv(P) + 0.5 * np.linalg.inv(P_g))
    np.testing.assert_allclose(blend(x, P, x_g, P_g, 0.5)[1], half, rtol=1e-9)


def test_a_reset_keeps_the_covariance_positive():
    """An aid known to half a millimetre given a position lost by kilometres; a sixth of these was indefinite."""
    for seed in range(40):
        P, _, _ = position_and_its_error(seed)
        root = np.array([[7.0], [3.0], [2000.0]]) * np.random.default_rng(seed).normal(size=(3, 3))
        P_g = (root @ root.T + np.diag([1e-2, 1e-2, 1.0])) / 0.02
        reset(np.zeros(6), P, np.zeros(3), P_g)
        assert scaled_eigenvalues(P)[0] > 0, seed
        np.testing.assert_allclose(P[:3, :3], P_g, rtol=1e-9)


def test_weights_see_a_lost_position():
    P = lost_position()
    assert weights_by_covariance(P, 15, np.ones(2))[1] < 0.02
    x = np.zeros((2, 15))
    x[1, POS] = 185.0
    assert combine(x, P, 15, np.ones(2), "scalar").x[POS] < 4.0
    half = combine(x, P, 15, np.ones(2), "scalar", lambda P, common, members: members / 2)  # weights of another rule
    assert half.x[POS] == 92.5


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"locals": ()}, "needs local filters"),
        ({"locals": (Local("a", ()), Local("a", ()))}, "a name of its own"),
        ({"locals": (Local("a", (), 0.5), Local("b", ()))}, "add up to 1"),
        ({"locals": (Local("a", (), 0.5), Local("b", (), 0.4))}, "add up to 1"),
        ({"retention": 1.5}, "fraction"),
        ({"recall_s": 20.0, "structure": "full_reset"}, "spreads"),
        ({"imu": dataclasses.replace(CONSUMER, gyro_bias_sigma=0.0)}, "sigma above zero"),
        ({"sharing": "none", "structure": "full_reset"}, "again and again"),
        ({"combination": "scalar"}, "sharing must be 'none'"),
    ],
)
def test_what_makes_no_sense_is_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(INFORMATION, **wrong)


# --- in flight


@pytest.mark.ci
def test_one_local_filter_is_the_ins():
    """Corrected every second instead of at once: only linearisation differs."""
    truth, increments, one, _, others = world()
    sensors = (MonitoredAid(GnssAid()), MonitoredAid(BarometerAid()), MonitoredAid(MagnetometerAid()))
    _, estimates, _ = fly(Config(CONSUMER, (Local("only", sensors),)), one + others, increments)
    config = InsConfig(CONSUMER, (GnssAid(), BarometerAid(), MagnetometerAid()))
    central, _ = feed(FusionHorizon(Ins(config, field)), increments, one + others)
    for t in (20, 60, 119):
        shift, ratio = differ(estimates[t], central[t], truth)
        assert shift < 0.05
        assert ratio < 5e-3


def test_full_reset_reproduces_one_filter_with_every_aid():
    """Shares, resets and marginalised aid errors lose nothing: a tenth of a sigma, a fiftieth of the sigmas."""
    truth, increments, one, two, others = world()
    samples = one + two + others
    everything = (Local("only", tuple(w for local in three() for w in local.sensors)),)
    _, central, _ = fly(Config(CONSUMER, everything), samples, increments)
    shares = tuple(dataclasses.replace(f, share=s) for f, s in zip(three(), (0.5, 0.3, 0.2), strict=True))
    for locals_ in (three(), shares):
        _, estimates, _ = fly(Config(CONSUMER, locals_, structure="full_reset"), samples, increments)
        for t in (20, 60, 119):
            shift, ratio = differ(estimates[t], central[t], truth)
            assert shift < 0.1
            assert ratio < 0.02


@pytest.mark.ci
@pytest.mark.parametrize(
    "options",
    [
        {"structure": "partial"},
        {"sharing": "by_covariance"},
        {"sharing": "by_covariance", "structure": "full_reset"},
        {"sharing": "none", "combination": "scalar"},
        {"sharing": "none", "combination": "covariance_intersection"},
        {"sharing": "none", "combination": "covariance_intersection", "structure": "full_reset"},
        {"fusion_period_s": 0.0, "structure": "full_reset"},
        {"fusion_period_s": 7.0},
    ],
)
def test_every_way_of_fusing_is_sound(options):
    truth, increments, one, two, others = world()
    federated, estimates, reports = fly(Config(CONSUMER, three(), **options), one + two + others, increments)
    wrong, sigma = error(estimates[-1], truth), np.sqrt(np.diag(estimates[-1].covariance))
    assert (np.abs(wrong) < 4 * sigma).all()
    assert np.hypot(*wrong[:2]) < 1.5
    assert sigma[6] < 0.15 * DEG
    assert federated.shares.sum() == pytest.approx(1.0)
    assert federated.events == []
    assert np.mean([r.weight for r in reports]) > 0.99
    assert estimates[-1].status == Status.ALIGNED | Status.GNSS_FUSED
    assert estimates[-1].extra["barometer_bias"][0][0] == pytest.approx(40.0, abs=2.0)


@pytest.mark.ci
def test_claims_without_resets():
    """Shared noise claims a little more than the centralised sigma; unshared noise claims less than can be."""
    _, increments, one, two, others = world()
    sigma = {}
    for name, options in (
        ("central", {"structure": "full_reset"}),
        ("shared", {}),
        ("unshared", {"sharing": "none"}),
    ):
        estimates = fly(Config(CONSUMER, three(), **options), one + two + others, increments)[1]
        sigma[name] = np.sqrt(np.diag(estimates[-1].covariance))
    assert (sigma["shared"] > 0.999 * sigma["central"]).all()
    assert (sigma["shared"] < 1.25 * sigma["central"]).all()
    assert (sigma["unshared"][3:8] < 0.95 * sigma["central"][3:8]).all()


@pytest.mark.slow
def test_nees_over_many_flights():
    """Mean of nine states' NEES over 40 flights, against the 99 % bound of a consistent filter.

    One-sided, since shares of the noise that are never taken back make claims too large.
    """
    runs, nees = 40, {"fixed": 0.0, "none": 0.0}
    for seed in range(runs):
        truth, increments, one, two, others = world.__wrapped__(60, 1000 + seed)
        for sharing in nees:
            _, estimates, _ = fly(Config(CONSUMER, three(), sharing=sharing), one + two + others, increments)
            wrong = error(estimates[-1], truth)
            nees[sharing] += wrong @ np.linalg.solve(estimates[-1].covariance, wrong) / runs
    bound = chi2.ppf(0.99, 9 * runs) / runs
    print("mean NEES", nees, "bound", bound)
    assert nees["fixed"] < bound < nees["none"]


@pytest.mark.ci
@pytest.mark.parametrize(
    ("kind", "structure", "with_velocity"),
    [
        ("chi_square", "no_reset", True),
        pytest.param("eraim", "partial", False, marks=pytest.mark.ci),
        pytest.param("sprt", "no_reset", False, marks=pytest.mark.ci),
        pytest.param("sprt", "full_reset", True, marks=pytest.mark.ci),
        pytest.param("glr", "no_reset", True, marks=pytest.mark.ci),
        pytest.param("glr", "full_reset", False, marks=pytest.mark.ci),
    ],
)
def test_a_spoofed_receiver_is_isolated_and_readmitted(kind, structure, with_velocity):
    """A ramp of 0.5 m/s from 100 to 220 s on the first of two receivers: 60 m, of which under 2 m reach the fusion."""
    truth, increments, one, two, others = world(260)
    spoofed = ramp(one, 100, 220, 0.5, with_velocity)
    federated, estimates, reports = fly(
        Config(CONSUMER, three(DETECTORS[kind]), structure=structure), spoofed + two + others, increments
    )
    errors = horizontal(estimates, truth, 50)
    assert max(errors.values()) < 2.0  # the requirement is 10 m
    assert {(e.local, e.sensor) for e in federated.events} == {("one", "gnss")}
    first, last = federated.events[0], federated.events[-1]
    assert 100 < first.t < 116
    assert any(first.isolated)
    assert 221 < last.t < 224
    assert federated.isolated() == []
    north = [r for r in reports if r.sensor == "gnss" and r.aid == "gnss_position" and 120 < r.t < 220]
    assert all(r.outcome is Outcome.ISOLATED and r.weight < 1 for r in north)
    assert all(r.weight == 1 for r in reports if r.sensor == "gnss" and r.t > 224 and not r.reason)
    assert np.mean([r.weight for r in reports if r.sensor == "gnss2"]) > 0.995
    wrong, sigma = error(estimates[-1], truth), np.sqrt(np.diag(estimates[-1].covariance))
    assert (np.abs(wrong) < 4 * sigma).all()


def accelerating(fixes, start, stop, acceleration):
    """Spoofed eastwards from the true position away, with the velocity that belongs to it."""
    spoofed = []
    for fix in fixes:
        if start <= fix.t < stop:
            tau = fix.t - start
            v_n = fix.v_n + np.array([0.0, acceleration * tau, 0.0])
            away = 0.5 * acceleration * tau**2 / (6.37e6 * math.cos(fix.lat))
            fix = dataclasses.replace(fix, lon=fix.lon + away, v_n=v_n)
        spoofed.append(fix)
    return spoofed


@pytest.mark.ci
def test_cross_check_finds_what_drags_its_own_filter_along():
    """60 m and 2.4 m/s in 50 s: the receiver's own filter believes it, but it contradicts the other one's."""
    truth, increments, one, two, others = world(200)
    spoofed = accelerating(one, 100, 150, 0.05)
    worst = {}
    for cross_check in (False, True):
        config = Config(CONSUMER, three(DETECTORS["glr"]), cross_check=cross_check)
        federated, estimates, _ = fly(config, spoofed + two + others, increments)
        worst[cross_check] = max(horizontal(estimates, truth, 50).values())
    assert worst[False] > 5.0
    assert worst[True] < 3.0
    assert {(e.local, e.sensor) for e in federated.events} == {("one", "gnss")}
    assert 100 < federated.events[0].t < 112
    assert federated.isolated() == []
    assert 150 < federated.events[-1].t < 155


@pytest.mark.ci
def test_cross_check_finds_nothing_in_healthy_flight():
    truth, increments, one, two, others = world(260)
    config = Config(CONSUMER, three(DETECTORS["glr"]), cross_check=True)
    federated, estimates, _ = fly(config, one + two + others, increments)
    assert federated.events == []
    assert max(horizontal(estimates, truth, 50).values()) < 2.0


@pytest.mark.parametrize("options", [{"structure": "partial"}, {"sharing": "none", "combination": "scalar"}])
def test_cross_check_needs_independent_filters(options):
    with pytest.raises(ValueError, match="independent"):
        Config(CONSUMER, three(), cross_check=True, **options)


@pytest.mark.ci
def test_the_single_filter_follows_the_spoofer():
    """The same ramp and sensors in one filter, whatever its gate."""
    truth, increments, one, _, others = world(260)
    spoofed = ramp(one, 100, 220, 0.5, True)
    for false_rejection in (1e-3, 1e-300):
        config = InsConfig(CONSUMER, (GnssAid(), BarometerAid(), MagnetometerAid()), false_rejection=false_rejection)
        estimates, _ = feed(FusionHorizon(Ins(config, field)), increments, spoofed + others)
        assert max(horizontal(estimates, truth, 50).values()) > 50


@pytest.mark.ci
def test_when_a_spoofer_lets_go_of_the_only_receiver_the_wind_speaks_for_it():
    """Off by 90 m and 3 m/s at the end: back within 10 s, never much farther off, and not sure of being elsewhere."""
    truth, increments, one, _, others = world(160)
    others = others + airspeed(truth, np.random.default_rng(3))
    spoofed = accelerating(one, 60, 120, 0.05)
    first, _, air = three()
    pitot = MonitoredAid(AirspeedAid(sideslip_sigma=None))
    config = Config(CONSUMER, (first, Local("air", (*air.sensors, pitot))), structure="full_reset")
    _, estimates, _ = fly(config, spoofed + others, increments, 0.2)
    off = horizontal(estimates, truth, 50)
    assert max(distance for t, distance in off.items() if t > 120) < off[119.8] + 10 * 3
    assert max(distance for t, distance in off.items() if t > 130) < 5.0
    claimed = {round(e.t, 3): math.sqrt(e.covariance[0, 0] + e.covariance[1, 1]) for e in estimates}
    assert all(claimed[t] > off[t] / 3 for t in off if t > 121.2)


@pytest.mark.ci
def test_a_spoofer_that_begins_gently():
    """Velocity grows by 0.05 m/s^2 up to 0.5 m/s, the position with it: alone with its IMU a filter does not notice."""
    truth, increments, one, two, others = world(260)
    gentle = []
    for fix in one:
        T = min(max(fix.t - 100, 0.0), 120.0)
        v, moved = min(0.05 * T, 0.5), 0.025 * min(T, 10.0) ** 2 + 0.5 * max(T - 10.0, 0.0)
        here = fix.t < 220
        gentle.append(
            dataclasses.replace(fix, lat=fix.lat + here * moved / 6.37e6, v_n=fix.v_n + here * np.array([v, 0.0, 0.0]))
        )
    worst = {}
    for structure, kind in (("full_reset", "glr"), ("full_reset", "sprt"), ("no_reset", "chi_square")):
        config = Config(CONSUMER, three(DETECTORS[kind]), structure=structure)
        federated, estimates, _ = fly(config, gentle + two + others, increments)
        worst[structure, kind] = max(horizontal(estimates, truth, 50).values())
        if structure == "full_reset":
            assert {e.local for e in federated.events} == {"one"}
    assert worst["full_reset", "glr"] < 2.0
    assert worst["full_reset", "sprt"] < 2.0
    assert worst["no_reset", "chi_square"] > 20.0


def test_nothing_of_the_spoofed_fixes_stays():
    """At the isolation the spoofed filter goes back to the others' solution, of which it gets next to no share."""
    _, increments, one, two, others = world(260)
    federated = Federated(Config(CONSUMER, three(DETECTORS["glr"])), field)
    horizon = FusionHorizon(federated)
    rows = slice(0, round(130 / DT))
    block = ImuSamples(increments.t[rows], increments.dt[rows], increments.dtheta[rows], increments.dv[rows])
    samples = [s for s in ramp(one, 100, 220, 0.5, True) + two + others if s.t <= 130]
    horizon.push(block, samples)
    assert federated.events
    apart = np.abs(federated.local("one")[0][POS : POS + 3] - federated.local("two")[0][POS : POS + 3])
    assert apart[0] < 3.0  # after 20 s, in which the spoofed receiver went 10 m
    sigma = [math.sqrt(federated.local(name)[1][POS, POS]) for name in ("one", "two")]
    assert apart[0] < 2 * sigma[0]
    assert sigma[0] > 3 * sigma[1]


class Suspects:
    """A detector that suspects every look alike: statistic over threshold is ``ratio``; it never alarms."""

    def __init__(self, ratio):
        self.ratio = ratio

    def step(self, nu, S, t):
        return Decision(False, 8.0 * self.ratio, 8.0, np.full(len(nu), True), Event.NONE)


def weights_of(reports, after):
    """{sensor: the weights of its looks after a time}."""
    found = {}
    for r in reports:
        if r.t > after and not r.reason:
            found.setdefault(r.sensor, set()).add(round(r.weight, 6))
    return found


@pytest.mark.ci
@pytest.mark.parametrize(
    ("ratios", "options", "expected"),
    [
        ((0.5, 0.0), {}, (0.5, 1.0)),  # B = 0.5 and 1, over the larger
        ((0.6, 0.2), {}, (0.5, 1.0)),
        ((0.5, 0.5), {}, (1.0, 1.0)),  # alike: nobody is weakened
        ((-3.0, 0.5), {}, (1.0, 0.5)),  # evidence below zero makes nobody sounder than sound
        ((0.5, 0.0), {"weighting": "none"}, (1.0, 1.0)),
        ((0.0, 0.0), {"normalise": lambda found, limits: 0.25 * limits}, (0.25, 0.25)),  # by a rule of one's own
    ],
)
def test_normalised_weights_of_two_receivers(ratios, options, expected):
    _, increments, one, two, others = world(50)
    pair = tuple(
        Local(name, (MonitoredAid(GnssAid(name), lambda ratio=ratio: Suspects(ratio)),))
        for name, ratio in zip(("gnss", "gnss2"), ratios, strict=True)
    )
    magnetic = tuple(s for s in others if s.sensor == "magnetometer")  # for the alignment
    config = Config(CONSUMER, pair, alignment_aids=(MagnetometerAid(),), **({"weighting": "normalised"} | options))
    _, _, reports = fly(config, one + two + list(magnetic), increments)
    assert weights_of(reports, 20.0) == {"gnss": {expected[0]}, "gnss2": {expected[1]}}


def test_a_weight_needs_somebody_to_compare_with_and_comes_after_the_own_policy():
    """A sensor left alone is not weakened short of its limit; a suspect part speaks for the whole of its filter."""
    _, increments, one, two, others = world(50)
    locals_ = (
        Local("one", (MonitoredAid(GnssAid(), lambda: Suspects(0.5), lambda: Weight(0.5)),)),
        Local(
            "two",
            (
                MonitoredAid(GnssAid("gnss2"), lambda: Suspects(0.0)),
                MonitoredAid(BarometerAid(), lambda: Suspects(0.3)),
            ),
        ),
    )
    two = [fix for fix in two if fix.t < 30]
    baro = [s for s in others if s.sensor == "barometer" and s.t < 30]
    magnetic = [s for s in others if s.sensor == "magnetometer"]
    config = Config(CONSUMER, locals_, weighting="normalised", alignment_aids=(MagnetometerAid(),))
    _, _, reports = fly(config, one + two + baro + magnetic, increments)
    together = [r for r in reports if 20 < r.t < 30]
    assert weights_of(together, 0) == {"gnss": {round(0.5 * 0.5 / 0.7, 6)}, "gnss2": {1.0}, "barometer": {1.0}}
    assert weights_of(reports, 33) == {"gnss": {0.5}}


@pytest.mark.ci
def test_a_velocity_fault_takes_the_position_of_its_receiver_along():
    """One look on every axis bad is the whole receiver bad."""
    truth, increments, one, two, others = world(120)
    bad = [dataclasses.replace(f, v_n=f.v_n + np.array([2.0, -2.0, 1.0])) if 60 <= f.t < 80 else f for f in one]
    federated, estimates, reports = fly(Config(CONSUMER, three()), bad + two + others, increments)
    assert max(horizontal(estimates, truth, 50).values()) < 2.0
    during = [r for r in reports if r.sensor == "gnss" and 61 < r.t < 80]
    assert len(during) > 180
    assert all((r.weight, r.outcome) == (0.0, Outcome.ISOLATED) for r in during)
    assert {e.part for e in federated.events} == {"gnss_velocity"}


def alone(recall_s):
    """One receiver, and aids that know no position across."""
    locals_ = (Local("one", (MonitoredAid(GnssAid(), DETECTORS["eraim"]),)), three()[2])
    return Config(CONSUMER, locals_, recall_s=recall_s)


@pytest.mark.ci
def test_a_filter_alone_in_knowing_the_position_recalls_it():
    """The others' solution has lost the position for long, what the filter itself knew before the fault has not."""
    truth, increments, one, _, others = world(180)
    bad = ramp(one, 100, 140, 10.0, False)
    _, estimates, _ = fly(alone(None), bad + others, increments)
    assert max(horizontal(estimates, truth, 90).values()) > 20
    federated, estimates, _ = fly(alone(10.0), bad + others, increments)
    assert max(horizontal(estimates, truth, 90).values()) < 4.0
    assert [bool(sum(e.isolated)) for e in federated.events] == [True, False]
    isolated, readmitted = federated.events
    assert 100 < isolated.t < 104
    assert 140 < readmitted.t < 143
    assert (np.abs(error(estimates[-1], truth)) < 4 * np.sqrt(np.diag(estimates[-1].covariance))).all()


@pytest.mark.ci
def test_a_recall_takes_back_all_that_was_told_since():
    """Whatever the fixes of the last seconds before the isolation said: a trace of a metre, or none."""
    truth, increments, one, _, others = world(120)
    bad = ramp(one, 100, 120, 10.0, False)
    # Others in the second before: believed, and not so far off that anything else changes.
    pulled = [dataclasses.replace(f, lat=f.lat - 1.0 / 6.37e6) if 99 <= f.t < 100 else f for f in bad]

    def apart(config, t):
        flights = [fly(config, fixes + others, increments) for fixes in (bad, pulled)]
        assert flights[0][0].events[0].t == flights[1][0].events[0].t < t
        one, two = (next(e for e in estimates if abs(e.t - t) < 1e-6) for _, estimates, _ in flights)
        return np.abs(error(one, truth)[:3] - error(two, truth)[:3]).max()

    assert apart(alone(5.0), 105.0) < 0.001
    # Taken as shadow at 99.8 s or later, it holds them.
    assert apart(alone(0.2), 105.0) > 0.03


def test_a_faulty_axis_leaves_the_others_in_use():
    truth, increments, one, two, others = world(120)
    bad = [dataclasses.replace(f, h=f.h + 640.0) if 60 <= f.t < 80 else f for f in one]
    federated, estimates, reports = fly(Config(CONSUMER, three(DETECTORS["eraim"])), bad + two + others, increments)
    during = [r for r in reports if r.aid == "gnss_position" and r.sensor == "gnss" and 60 <= r.t < 80]
    assert np.mean([r.weight for r in during]) == pytest.approx(2 / 3, abs=0.02)
    assert federated.events[0].isolated == (False, False, True)
    assert max(abs(error(e, truth)[2]) for e in estimates if e.t > 50) < 1.5


def test_what_is_fused_after_an_isolation_is_seen_from_the_new_start(monkeypatch):
    """The sound axes of the look that isolated one: the aid's own errors began anew, and so must its innovation."""
    _, increments, one, two, others = world(120)
    bad = [dataclasses.replace(f, h=f.h + 640.0) if 60 <= f.t < 62 else f for f in one]
    first, *rest = three(DETECTORS["eraim"])
    correlated = GnssAid(position_error_sigma=(1.0, 1.0, 1.0))
    locals_ = (Local("one", (dataclasses.replace(first.sensors[0], aid=correlated),)), *rest)
    now, off = [], []
    use, take = Federated._use_part, LocalFilter.take

    def noted(self, state, filter_, sample, part, look, withheld):
        now[:] = sample, part
        return use(self, state, filter_, sample, part, look, withheld)

    def checked(self, reference, state, look, nu, S, used, *more):
        sample, part = now
        fresh = self.measure(reference, state, self.aids[sample.sensor], part, sample)
        if not used.all():
            off.append(np.abs(self.innovate(state, fresh)[0] - nu)[used].max())
        return take(self, reference, state, look, nu, S, used, *more)

    monkeypatch.setattr(Federated, "_use_part", noted)
    monkeypatch.setattr(LocalFilter, "take", checked)
    fly(Config(CONSUMER, locals_), bad + two + others, increments)
    assert len(off) >= 10
    assert max(off) < 1e-9


def learner(made):
    """A policy that learns, and remembers itself in a list."""

    def make():
        made.append(SageHusa(0.98))
        return made[-1]

    return make


@pytest.mark.ci
def test_a_condemned_axis_does_not_weaken_the_sound_ones():
    """Two kilometres north, which the detector takes out: what inflates is not asked about them."""
    _, increments, one, two, others = world(120)
    bad = [dataclasses.replace(f, lat=f.lat + 2000 / 6.37e6) if 60 <= f.t < 80 else f for f in one]
    first, *rest = three(DETECTORS["eraim"])
    locals_ = (Local("one", (dataclasses.replace(first.sensors[0], policy=MahalanobisInflation),)), *rest)
    federated, _, reports = fly(Config(CONSUMER, locals_), bad + two + others, increments)
    during = [r for r in reports if r.aid == "gnss_position" and r.sensor == "gnss" and 60 <= r.t < 80]
    assert np.mean([r.weight for r in during]) == pytest.approx(2 / 3, abs=0.02)
    assert federated.events[0].isolated == (True, False, False)


@pytest.mark.ci
@pytest.mark.parametrize("detector", ["chi_square", "eraim", "glr"])
def test_a_detector_judges_by_the_noise_that_was_learned(detector):
    """A receiver twice as bad as it says, which would be isolated for that."""
    truth, increments, _, two, others = world(120)
    rng = np.random.default_rng(9)
    bad = [
        dataclasses.replace(f, sigma_position_n=np.full(3, 1.5), sigma_velocity_n=np.full(3, 0.1))
        for f in gnss(truth, rng, 5.0, sigma_p=3.0, sigma_v=0.2)
    ]
    made = []
    first, *rest = three(DETECTORS[detector])
    locals_ = (Local("one", (dataclasses.replace(first.sensors[0], policy=learner(made)),)), *rest)
    federated, _, reports = fly(Config(CONSUMER, locals_), bad + two + others, increments)
    assert not federated.events
    for policy in made:
        assert np.mean(policy.ratio) == pytest.approx(4, rel=0.25)
    refused = [bool(r.reason) for r in reports if r.sensor == "gnss" and r.t > 40]
    assert len(refused) > 700
    assert np.mean(refused) < 0.01


@pytest.mark.ci
def test_an_axis_left_out_teaches_nothing_and_the_others_go_on():
    _, increments, one, two, others = world(120)
    bad = [dataclasses.replace(f, h=f.h + 640.0) if f.t >= 60 else f for f in one]
    ratios = {}
    for name, fixes in (("sound", [f for f in one if f.t < 60]), ("bad", bad)):
        made = []
        first, *rest = three(DETECTORS["eraim"])
        locals_ = (Local("one", (dataclasses.replace(first.sensors[0], policy=learner(made)),)), *rest)
        fly(Config(CONSUMER, locals_), fixes + two + others, increments)
        ratios[name] = made[0].ratio
    assert ratios["bad"][2] == ratios["sound"][2] != 1.0
    assert (ratios["bad"][:2] != ratios["sound"][:2]).all()
    assert (np.abs(ratios["bad"][:2] - 1) < 0.5).all()


@pytest.mark.ci
def test_both_receivers_off_for_long_are_believed_in_the_end():
    """A lasting jump of both by 100 m, as after a filter too sure of itself: given in to after `patience_s`."""
    truth, increments, one, two, others = world(120)
    jumped = [dataclasses.replace(f, lat=f.lat + 100 / 6.37e6) if f.t >= 60 else f for f in one + two]
    _, estimates, reports = fly(Config(CONSUMER, three(), patience_s=20.0), jumped + others, increments)
    fused = [r.t for r in reports if r.aid == "gnss_position" and r.t >= 60 and r.weight == 1]
    assert 79.5 < fused[0] < 81
    assert len(fused) > 350
    errors = horizontal(estimates, truth)
    assert errors[79.0] < 8.0
    assert 95 < errors[119.0] < 105


def test_an_outage_of_both_receivers_and_their_return():
    truth, increments, one, two, others = world(120)
    seen = [f for f in one + two if not 40 <= f.t < 70]
    _, estimates, reports = fly(Config(CONSUMER, three()), seen + others, increments)
    status = {round(e.t): e.status for e in estimates}
    assert status[50] == Status.ALIGNED | Status.DEAD_RECKONING
    assert status[72] == Status.ALIGNED | Status.GNSS_FUSED
    assert max(e for t, e in horizontal(estimates, truth).items() if t > 75) < 1.5
    assert np.mean([r.weight for r in reports if 70 <= r.t < 75]) > 0.95
    at = estimates[68]
    assert (np.abs(error(at, truth)) < 4 * np.sqrt(np.diag(at.covariance))).all()


def test_blocks_of_any_size_give_the_same_bits():
    _, increments, one, two, others = world(120)
    few = ImuSamples(increments.t[:6000], increments.dt[:6000], increments.dtheta[:6000], increments.dv[:6000])
    samples = [s for s in one + two + others if s.t < 30]
    finals = [fly(Config(CONSUMER, three()), samples, few, seconds)[1][-1] for seconds in (0.05, 1.0, 3.0)]
    for other in finals[1:]:
        assert (other.lat, other.lon, other.h) == (finals[0].lat, finals[0].lon, finals[0].h)
        np.testing.assert_array_equal(other.covariance, finals[0].covariance)


def test_broken_samples_and_strangers():
    truth, _, one, _, _ = world(120)
    federated = Federated(Config(CONSUMER, three()), field)
    federated.start(true_start(truth))
    broken = dataclasses.replace(one[0], t=0.0, lat=math.nan)
    reports = federated.update(broken)
    assert [(r.aid, r.weight) for r in reports] == [("gnss_position", 0.0), ("gnss_velocity", 0.0)]
    assert federated.estimate().status & Status.BAD_SAMPLE
    stranger = dataclasses.replace(one[0], t=0.0, sensor="gnss9")
    assert not federated.accepts(stranger)
    assert federated.update(stranger) == federated.refuse(stranger, "late") == []
    assert federated.update(dataclasses.replace(one[0], t=0.0, fix_type=FixType.NO_FIX)) == []
    with pytest.raises(ValueError, match="the filter is at"):
        federated.update(BarometerSample(0.5, 0.5, 95_000.0))


def test_looking_at_an_estimate_changes_none():
    _, increments, one, two, others = world(120)
    federated, _, _ = fly(Config(CONSUMER, three()), [s for s in one + two + others if s.t < 119], increments)
    before = federated.local("one")
    few = ImuSamples(increments.t[:20], increments.dt[:20], increments.dtheta[:20], increments.dv[:20])
    first = federated.estimate()
    federated.predict(few)
    second = federated.estimate()
    assert first.lat == second.lat
    for a, b in zip(before, federated.local("one"), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_pitot_that_falls_silent_leaves_its_filter_the_constraint_of_no_sideslip():
    truth, increments, one, *_ = world()
    speeds = airspeed(truth, np.random.default_rng(3))
    locals_ = Local("one", (MonitoredAid(GnssAid()),)), Local("air", (MonitoredAid(AirspeedAid(sideslip_sigma=1.0)),))
    heard = [s for s in [*one, *speeds] if s.t < 30 and (s.t < 15 or not isinstance(s, AirspeedSample))]
    first = increments.t <= 30.0
    increments = ImuSamples(*(getattr(increments, name)[first] for name in ("t", "dt", "dtheta", "dv")))
    _, _, reports = fly(Config(CONSUMER, locals_), heard, increments)
    known = [r for r in reports if r.sensor == NO_SENSOR]
    assert known[0].t == pytest.approx(16.0)
    assert {(r.aid, r.outcome) for r in known} == {("sideslip", Outcome.FUSED)}


def test_two_filters_may_share_a_sensor_or_a_name_of_a_state():
    _, increments, one, two, others = world(120)
    locals_ = (
        Local("one", (MonitoredAid(GnssAid()), MonitoredAid(BarometerAid()))),
        Local("two", (MonitoredAid(GnssAid("gnss2")), MonitoredAid(BarometerAid()))),
    )
    few = ImuSamples(increments.t[:6000], increments.dt[:6000], increments.dtheta[:6000], increments.dv[:6000])
    _, estimates, reports = fly(Config(CONSUMER, locals_), [s for s in one + two + others if s.t < 30], few)
    assert set(estimates[-1].extra) == {"one_barometer_bias", "two_barometer_bias"}
    assert len([r for r in reports if r.aid == "barometer" and r.t == 20.0]) == 2
