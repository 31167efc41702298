"""What becomes of looks: isolation and readmission, measurement policies, states of aids."""

import dataclasses
import math

import numpy as np
import pytest
from worlds.ins import CONSUMER, FIELD_N, barometer, error, feed, flight, gnss, imu

from nav.aids import AirspeedAid, BarometerAid, Course, GnssAid
from nav.aids.base import aid_blocks
from nav.alignment import InitialState
from nav.detection import ChiSquare, ChiSquareGate, Decision, Event, Glr
from nav.horizon import FusionHorizon
from nav.ins import Ins, InsConfig
from nav.local_filter import LocalFilter
from nav.monitor import Change, Monitor, Patience
from nav.samples import Outcome
from nav.unscented import Scaling
from nav.weighting import MahalanobisInflation, SageHusa


class Scripted:
    """A detector that says what it was told to: one mask per look, None for no alarm."""

    def __init__(self, masks):
        self.masks = iter(masks)

    def step(self, nu, S, t):
        mask = next(self.masks)
        sound = np.full(len(nu), True) if mask is None else np.array(mask)
        return Decision(mask is not None, 0.0, 1.0, sound, Event.NONE)


def changes(masks, isolate_after=3, readmit_after=4, isolate_s=0.0):
    watch = Monitor(Scripted(masks), None, 2, Patience(isolate_after, isolate_s, readmit_after))
    rows = []
    for k in range(len(masks)):
        _, change = watch.judge(np.zeros(2), np.eye(2), float(k))
        rows.append((change, tuple(watch.isolated), watch.suspect, watch.out))
    return rows


def test_isolation_needs_consecutive_alarms_on_an_axis():
    bad_first, bad_both = (False, True), (False, False)
    rows = changes([bad_first, bad_first, None, bad_first, bad_both, bad_both, bad_both])
    assert [change for change, *_ in rows] == [Change.NONE] * 5 + [Change.ISOLATED] * 2
    assert rows[5][1:] == ((True, False), True, False)
    assert rows[6][1:] == ((True, True), True, True)


def test_isolation_needs_alarms_that_last():
    bad = (False, True)
    rows = changes([bad] * 4 + [None] + [bad] * 6, isolate_after=2, isolate_s=4.0)
    assert [change for change, *_ in rows] == [Change.NONE] * 9 + [Change.ISOLATED, Change.NONE]  # 5 s to 9 s


def test_readmission_needs_consecutive_passes():
    bad = (False, True)
    rows = changes([bad] * 3 + [None] * 3 + [bad] + [None] * 4 + [bad] * 2)
    assert [change for change, *_ in rows][3:] == [Change.NONE] * 7 + [Change.READMITTED] + [Change.NONE] * 2
    assert not rows[-1][2]


def test_a_suspicion_fades_and_one_that_is_none_is_forgotten_at_once():
    class Suspects(Scripted):
        def step(self, nu, S, t):
            return super().step(nu, S, t)._replace(statistic=next(statistics))

    statistics = iter([0.8, 0.1, 0.5, math.nan, 0.2])
    watch = Monitor(Suspects([None] * 5), None, 2, Patience(3))
    found = []
    for t in (0.0, 2.0, 5.0, 6.0, 7.0):
        watch.judge(np.zeros(2), np.eye(2), t)
        found.append(watch.suspected)
    np.testing.assert_allclose(found, [0.8, 0.8 * math.exp(-0.4), 0.5, math.inf, 0.2])


def test_looks_that_are_sound_alone_for_long_overrule_the_detector():
    """Ten times four looks, of all isolated axes; then the detector begins anew."""
    watch = Monitor(Glr(1e-6), None, 2, Patience(3, readmit_after=4))
    nu = np.array([1.2, 1.2])  # a sound look, and a fault for one that gathers them
    rows = [watch.judge(nu, np.eye(2), 0.2 * k) for k in range(200)]
    changed = [(k, change) for k, (_, change) in enumerate(rows) if change]
    (isolated, first), (readmitted, second) = changed[:2]
    assert (first, second) == (Change.ISOLATED, Change.READMITTED)
    assert readmitted == isolated + 40
    assert not rows[readmitted + 1][0].alarm
    watch = Monitor(Glr(1e-6), None, 2, Patience(3, readmit_after=4))
    for k in range(200):
        watch.judge(np.array([1.2, 5.0]), np.eye(2), 0.2 * k)
    assert watch.suspect  # one of them is not sound


def test_an_isolation_from_outside_holds_until_samples_are_sound():
    watch = Monitor(ChiSquare(1e-3), None, 2, Patience(3, readmit_after=4))
    watch.isolate()
    assert watch.out
    assert watch.suspect
    found = [watch.judge(np.zeros(2), np.eye(2), float(k))[1] for k in range(4)]
    assert found == [Change.NONE] * 3 + [Change.READMITTED]


def test_a_change_that_is_none_is_false():
    assert Change.ISOLATED
    assert Change.READMITTED
    assert not Change.NONE


class Times:
    """A policy that multiplies the variances."""

    def __init__(self, *factors):
        self.factors = np.array(factors)
        self.seen = []

    def adapt(self, nu, S, R, t):
        self.seen.append((nu, S, R, t))
        return R * self.factors


def run(policies, scale=1.0, seconds=20, perfect=False):
    truth = flight(60)
    rng = np.random.default_rng(1)
    increments, *_ = imu(truth, CONSUMER, rng)
    fixes = [dataclasses.replace(f, sigma_position_n=scale * f.sigma_position_n) for f in gnss(truth, rng, 5.0)]
    if perfect:
        fixes += barometer(truth, rng, sigma=0.0)
    aids = (GnssAid(), BarometerAid(sigma=0.0, bias_sigma=1e-3)) if perfect else (GnssAid(),)
    ins = Ins(InsConfig(CONSUMER, aids, false_rejection=1e-12), lambda *_: FIELD_N, policies)
    covariance = np.diag(np.repeat([1e-3, 0.1, 1.0], 3) ** 2)
    ins.start(InitialState(0.0, truth.lat[0], truth.lon[0], truth.h[0], truth.v_n[0], truth.q_nb[0], covariance))
    estimates, reports = feed(FusionHorizon(ins), increments, [f for f in fixes if f.t < seconds])
    return estimates[seconds], reports


def test_a_policy_decides_on_the_variances():
    """Four times the variance is twice the reported sigma, to the last bit."""
    policy = Times(4.0, 4.0, 4.0)
    weighed, reports = run({"gnss_position": policy})
    expected, _ = run({}, scale=2.0)
    np.testing.assert_array_equal(weighed.q_nb, expected.q_nb)
    assert {r.weight for r in reports if r.aid == "gnss_position"} == {0.25}
    assert {r.weight for r in reports if r.aid == "gnss_velocity"} == {1.0}
    nu, S, R, t = policy.seen[-1]
    assert nu.shape == R.shape == (3,)
    assert S.shape == (3, 3)
    assert (np.diag(S) > R).all()
    assert t == pytest.approx(19.8)


def test_an_infinite_variance_leaves_the_axis_out():
    estimate, reports = run({"gnss_position": Times(1.0, math.inf, 1.0)})
    assert {round(r.weight, 9) for r in reports if r.aid == "gnss_position"} == {round(2 / 3, 9)}
    sigma = np.sqrt(np.diag(estimate.covariance))
    assert sigma[1] > 3 * sigma[0]
    nothing, reports = run({"gnss_position": Times(math.inf, math.inf, math.inf)})
    assert {(r.weight, r.outcome, r.reason) for r in reports if r.aid == "gnss_position"} == {
        (0.0, Outcome.WEAKENED, "left out by the measurement policy")
    }
    assert {r.weight for r in reports if r.aid == "gnss_velocity"} == {0.0}  # a position not used withholds it
    assert np.isfinite(error(nothing, flight(60))).all()


@pytest.mark.ci
@pytest.mark.parametrize("policy", [SageHusa(), MahalanobisInflation(), Times(4.0)])
def test_a_sensor_without_noise_keeps_its_weight(policy):
    """There is no variance to learn or to inflate: the same to the last bit as without a policy."""
    estimate, reports = run({"barometer": policy}, perfect=True)
    expected, _ = run({}, perfect=True)
    assert {r.weight for r in reports if r.aid == "barometer"} == {1.0}
    np.testing.assert_array_equal(estimate.covariance, expected.covariance)


def test_names_of_the_states():
    two = [GnssAid(position_error_sigma=(1.0, 1.0, 2.0)), GnssAid("gps2", velocity_error_sigma=(0.1, 0.1, 0.1))]
    assert [b.name for b in aid_blocks(two)] == ["gnss_position_error", "gps2_velocity_error"]
    air = [AirspeedAid(scale_sigma=0.02), AirspeedAid("pitot2", scale_sigma=0.03), BarometerAid("static")]
    assert [b.name for b in aid_blocks(air)] == ["wind", "airspeed_scale", "pitot2_scale", "static_bias"]


def test_a_sensor_can_be_given_to_a_filter_once():
    with pytest.raises(ValueError, match="listed twice"):
        LocalFilter(CONSUMER, [GnssAid(), GnssAid()], ChiSquareGate(1e-3))


def test_a_watch_passes_on_what_its_detector_says():
    watch = Monitor(ChiSquare(1e-3), None, 1, Patience(1, readmit_after=2))
    assert not watch.judge(np.array([3.0]), np.eye(1), 0.0)[0].alarm
    decision, change = watch.judge(np.array([3.4]), np.eye(1), 1.0)
    assert decision.alarm
    assert change is Change.ISOLATED


def test_innovations_at_all_points_at_once_are_those_one_by_one():
    """Position, velocity and course behind a lever arm, to the last bit."""
    truth = flight(30)
    rng = np.random.default_rng(5)
    increments, *_ = imu(truth, CONSUMER, rng)
    fixes = gnss(truth, rng, 5.0)
    covariance = np.diag(np.repeat([0.1, 0.5, 3.0], 3) ** 2)

    def flown(at_once):
        aid = GnssAid(arm_b=(0.5, -0.2, 0.1), position_error_sigma=(1.0, 1.0, 1.0), course=Course())
        ins = Ins(InsConfig(CONSUMER, (aid,), scaling=Scaling()), lambda *_: FIELD_N)
        if not at_once:
            ins._filter._at_points.clear()
        ins.start(InitialState(0.0, truth.lat[0], truth.lon[0], truth.h[0], truth.v_n[0], truth.q_nb[0], covariance))
        estimates, reports = feed(FusionHorizon(ins), increments, [f for f in fixes if f.t < 10])
        assert {r.aid for r in reports} == {"gnss_position", "gnss_velocity", "gnss_course"}
        return estimates[10]

    once, each = flown(True), flown(False)
    for one, other in ((once.v_n, each.v_n), (once.q_nb, each.q_nb), (once.covariance, each.covariance)):
        np.testing.assert_array_equal(one, other)
