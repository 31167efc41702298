"""Course over ground as a look at the heading, learned noise, fading, and sigma points, each inside a whole INS."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worlds.ins import CONSUMER, DEG, DT, FIELD_N, airspeed, error, feed, flight, gnss, imu

from nav.aids import AirspeedAid, Course, GnssAid
from nav.alignment import InitialState
from nav.detection import ChiSquareGate
from nav.horizon import FusionHorizon
from nav.ins import Ins, InsConfig
from nav.local_filter import LocalFilter
from nav.reference import Reference
from nav.samples import FixType, GnssSample, ImuSamples
from nav.unscented import Scaling
from nav.weighting import Fading, SageHusa, residual

ROAD = InsConfig(CONSUMER, (GnssAid(course=Course(2 * DEG, 2.0)),), alignment_s=1.0)


def drive(ins, speed, turn_degps, seconds):
    """Steady motion on a flat road at the equator, heading and course 0 at first; one report list per second."""
    ins.start(InitialState(0.0, 0.0, 0.0, 0.0, np.array([speed, 0, 0]), np.array([1.0, 0, 0, 0]),
                           np.diag([1e-4, 1e-4, 0.1, 0.01, 0.01, 0.01, 1.0, 1.0, 1.0])))  # fmt: skip
    found = []
    for k in range(seconds):
        t = k + DT * np.arange(1, round(1 / DT) + 1)
        rate = math.radians(turn_degps[k])
        n = len(t)
        push = np.tile([0.0, 0.0, -9.78 * DT], (n, 1))
        ins.propagate(ImuSamples(t, np.full(n, DT), np.tile([0.0, 0.0, rate * DT], (n, 1)), push))
        v_n = np.array([speed * math.cos(0.1), speed * math.sin(0.1), 0.0])
        sample = GnssSample(k + 1.0, k + 1.0, 0.0, 0.0, 0.0, v_n, np.full(3, 1e3), np.array([0.3, 0.4, 9.0]),
                            FixType.FIX_3D, 12, 0.8, 1.2)  # fmt: skip
        found.append({report.aid: report for report in ins.update(sample)})
    return found


def test_course_is_used_on_straights_only_and_not_near_rest():
    quick = [0.0] * 4 + [5.0] + [0.0] * 4
    used = ["gnss_course" in one for one in drive(Ins(ROAD), 5.0, quick, 9)]
    assert used == [False, True, True, True, False, False, True, True, True]
    assert not any("gnss_course" in one for one in drive(Ins(ROAD), 0.9, [0.0] * 4, 4))
    always = dataclasses.replace(ROAD, aids=(GnssAid(course=Course()),))
    assert all("gnss_course" in one for one in drive(Ins(always), 1.1, quick, 9))
    without = dataclasses.replace(ROAD, aids=(GnssAid(),))
    assert not any("gnss_course" in one for one in drive(Ins(without), 5.0, quick, 9))


def test_course_is_worth_the_velocity_over_the_speed():
    """R = (mean of 0.3^2 and 0.4^2, and slip^2) / 25, and course 0.1 rad off pulls the heading there."""
    ins = Ins(dataclasses.replace(ROAD, aids=(GnssAid(course=Course(slip=0.2)),)))
    first = drive(ins, 5.0, [0.0], 1)[0]["gnss_course"]
    assert first.innovation[0] == pytest.approx(0.1, abs=0.01)
    assert first.S[0, 0] - 0.1 == pytest.approx((0.125 + 0.04) / 25, rel=0.03)
    heading = Rotation.from_quat(ins.estimate().q_nb, scalar_first=True).as_euler("ZYX")[0]
    assert heading == pytest.approx(0.1, abs=0.01)


def test_course_in_wind_is_heading_and_drift():
    """25 m/s north over ground, wind 5 m/s to the east: a nose at atan2(-5, 25) explains it, north does not."""
    aids = [AirspeedAid(), GnssAid(course=Course())]
    inner = LocalFilter(CONSUMER, aids, ChiSquareGate(1e-3))
    reference = Reference([inner.model], [1.0], 10, None)
    fix = GnssSample(0.0, 0.0, 0.0, 0.0, 0.0, np.array([25.0, 0, 0]), np.ones(3), np.full(3, 0.05),
                     FixType.FIX_3D, 12, 0.8, 1.2)  # fmt: skip
    for heading, nu in ((math.atan2(-5, 25), 0.0), (0.0, math.atan2(-5, 25))):
        q = Rotation.from_euler("z", heading).as_quat(scalar_first=True)
        state = reference.start(InitialState(0.0, 0.0, 0.0, 0.0, np.array([25.0, 0, 0]), q, np.eye(9)))
        wind = inner.model.start("wind")
        state.x[0, wind : wind + 2] = 0.0, 5.0
        look = inner.measure(reference, state, aids[1], "gnss_course", fix)
        assert look.nu[0] == pytest.approx(nu, abs=1e-9)
        assert np.abs(look.H[0, wind : wind + 2]).max() > 0.03
    assert "wind" not in GnssAid().states


def test_residual_is_what_an_update_leaves():
    rng = np.random.default_rng(2)
    H, root = rng.normal(size=(3, 7)), rng.normal(size=(7, 7))
    P, R, nu = root @ root.T, np.array([0.5, np.inf, 2.0]), rng.normal(size=3)
    left, after = residual(nu, H @ P @ H.T, R)
    kept = [0, 2]
    H_kept = H[kept]
    K = P @ H_kept.T @ np.linalg.inv(H_kept @ P @ H_kept.T + np.diag(R[kept]))
    np.testing.assert_allclose(left[kept], nu[kept] - H_kept @ K @ nu[kept])
    np.testing.assert_allclose(after[np.ix_(kept, kept)], H_kept @ (P - K @ H_kept @ P) @ H_kept.T, atol=1e-12)
    assert np.isnan(left[1])


@pytest.mark.ci
@pytest.mark.parametrize("scaling", [None, Scaling()])
def test_noise_is_learned_inside_the_filter(scaling):
    """A receiver that says 1 m and 0.1 m/s and is twice as bad."""
    truth = flight(120)
    rng = np.random.default_rng(4)
    increments, *_ = imu(truth, CONSUMER, rng)
    fixes = noisy(truth, rng, 2)
    policies = {part: SageHusa(0.99) for part in ("gnss_position", "gnss_velocity")}
    ins = Ins(InsConfig(CONSUMER, (GnssAid(),), false_rejection=0.0, scaling=scaling), lambda *_: FIELD_N, policies)
    ins.start(_start(truth, 1 * DEG))
    _, reports = feed(FusionHorizon(ins), increments, fixes)
    for part, policy in policies.items():
        assert np.mean(policy.ratio) == pytest.approx(4, rel=0.25), part
        last = [report for report in reports if report.aid == part][-1]
        assert last.weight == pytest.approx(0.25, rel=0.25)


def noisy(truth, rng, times, rate_hz=5.0):
    """A receiver that says 1.5 m and 0.1 m/s and is `times` as bad."""
    return [
        dataclasses.replace(fix, sigma_position_n=np.full(3, 1.5), sigma_velocity_n=np.full(3, 0.1))
        for fix in gnss(truth, rng, rate_hz, sigma_p=1.5 * times, sigma_v=0.1 * times)
    ]


def learning(times, outage=(0.0, 0.0)):
    """What is learned behind the usual gate, and the reports on a flight of 600 looks."""
    truth = flight(120)
    rng = np.random.default_rng(4)
    increments, *_ = imu(truth, CONSUMER, rng)
    fixes = [fix for fix in noisy(truth, rng, times) if not outage[0] <= fix.t < outage[1]]
    policies = {part: SageHusa(0.99) for part in ("gnss_position", "gnss_velocity")}
    ins = Ins(InsConfig(CONSUMER, (GnssAid(),)), lambda *_: FIELD_N, policies)
    ins.start(_start(truth, 1 * DEG))
    return policies, feed(FusionHorizon(ins), increments, fixes)[1]


@pytest.mark.ci
@pytest.mark.parametrize("times", [1, 2, 4])
def test_the_gate_judges_by_what_was_learned(times):
    """Otherwise it turns sound looks of a noisier receiver away, and what passes never teaches how noisy it is."""
    policies, reports = learning(times)
    for part, policy in policies.items():
        assert np.mean(policy.ratio) == pytest.approx(times**2, rel=0.25), part
        refused = [bool(report.reason) for report in reports if report.aid == part and report.t > 30]
        assert len(refused) > 400
        assert np.mean(refused) < 0.01  # the gate's rate is 0.001


def test_fixes_of_a_receiver_found_noisier_agree_after_an_outage():
    """They agree with each other by the learned sigma: by that told, no streak of them would last a second."""
    _, reports = learning(4, outage=(60.0, 80.0))
    after = [report for report in reports if report.aid == "gnss_position" and report.t > 82]
    assert np.mean([report.weight > 0 for report in after]) > 0.95


def _start(truth, heading_sigma, heading_error=0.0):
    q = Rotation.from_euler("z", heading_error) * Rotation.from_quat(truth.q_nb[0], scalar_first=True)
    sigma = np.array([0.2 * DEG, 0.2 * DEG, heading_sigma, *[0.1] * 3, *[1.0] * 3])
    return InitialState(0.0, truth.lat[0], truth.lon[0], truth.h[0], truth.v_n[0],
                        q.as_quat(scalar_first=True), np.diag(sigma**2))  # fmt: skip


def _fly(truth, increments, samples, seconds=1.0, heading_sigma=1 * DEG, heading_error=0.0, **keys):
    ins = Ins(InsConfig(CONSUMER, (GnssAid(), AirspeedAid()), **keys))
    ins.start(_start(truth, heading_sigma, heading_error))
    estimates, _ = feed(FusionHorizon(ins), increments, samples, seconds)
    return estimates


def test_sigma_points_are_the_linear_filter_for_small_errors():
    truth = flight(60)
    rng = np.random.default_rng(5)
    increments, *_ = imu(truth, CONSUMER, rng)
    samples = gnss(truth, rng, 5.0)
    linear, points = (_fly(truth, increments, samples, scaling=scaling)[-1] for scaling in (None, Scaling()))
    sigma = np.sqrt(np.diag(linear.covariance))
    assert (np.abs(error(linear, truth) - error(points, truth)) < 0.1 * sigma).all()
    np.testing.assert_allclose(np.sqrt(np.diag(points.covariance)), sigma, rtol=0.02)
    np.testing.assert_allclose(points.gyro_bias, linear.gyro_bias, atol=0.1 * linear.sigma_gyro_bias.max())


def test_sigma_points_do_not_depend_on_the_blocks():
    truth = flight(12)
    rng = np.random.default_rng(6)
    increments, *_ = imu(truth, CONSUMER, rng)
    samples = gnss(truth, rng, 5.0) + airspeed(truth, rng)
    whole, pieces = (_fly(truth, increments, samples, s, scaling=Scaling())[-1] for s in (4.0, 33 * DT))
    assert pieces.t == whole.t
    np.testing.assert_array_equal(pieces.q_nb, whole.q_nb)
    np.testing.assert_array_equal(pieces.covariance, whole.covariance)


@pytest.mark.ci
def test_sigma_points_find_a_heading_that_is_far_off():
    """A start 150 deg wrong and told so: after six seconds the linear filter is still lost, and sure of it."""
    truth = flight(60)
    left = {}
    for name, scaling in (("linear", None), ("points", Scaling())):
        found = []
        for seed in (1, 3, 4):
            rng = np.random.default_rng(seed)
            whole, *_ = imu(truth, CONSUMER, rng)
            rows = slice(0, round(6 / DT))
            increments = ImuSamples(whole.t[rows], whole.dt[rows], whole.dtheta[rows], whole.dv[rows])
            estimates = _fly(
                truth, increments, gnss(truth, rng, 5.0), heading_sigma=100 * DEG, heading_error=150 * DEG,
                scaling=scaling, false_rejection=0.0,
            )  # fmt: skip
            found.append(abs(error(estimates[-1], truth)[8]) / DEG)
        left[name] = np.median(found)
    assert left["points"] < 5
    assert left["linear"] > 10


def test_fading_raises_P_after_the_gate():
    """Velocity off by 5 sigma for a while: with fading the filter believes it sooner, and says that it knows less."""
    truth = flight(60)
    rng = np.random.default_rng(8)
    increments, *_ = imu(truth, CONSUMER, rng)
    fixes = gnss(truth, rng, 5.0)
    fixes = [dataclasses.replace(fix, v_n=fix.v_n + np.array([0.8, 0, 0]) * (fix.t > 40)) for fix in fixes]
    sigma = {}
    for name, fadings in (("plain", None), ("fading", {"gnss_velocity": Fading(10, 3.0)})):
        ins = Ins(InsConfig(CONSUMER, (GnssAid(),), false_rejection=0.0), fadings=fadings)
        ins.start(_start(truth, 1 * DEG))
        estimates, _ = feed(FusionHorizon(ins), increments, fixes)
        sigma[name] = np.sqrt(estimates[40].covariance[3, 3]), error(estimates[40], truth)[3]
    assert sigma["fading"][0] > 1.5 * sigma["plain"][0]
    assert sigma["fading"][1] > 2 * sigma["plain"][1]
