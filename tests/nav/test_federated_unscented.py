"""Sigma points in the filters of a federation: the linear ones, a closed filter, and honest with headings far off."""

import dataclasses
import functools

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from worlds.federated import DETECTORS, differ, field, fly, horizontal, named, ramp, three, true_start, world
from worlds.ins import CONSUMER, DEG, DT, error, feed, flight, gnss, imu

from nav.aids import BarometerAid, GnssAid, MagnetometerAid
from nav.alignment import InitialState
from nav.detection import Never
from nav.federated import Federated
from nav.federation import Config, Local
from nav.horizon import FusionHorizon
from nav.ins import Ins, InsConfig
from nav.monitor import MonitoredAid
from nav.reference import turned
from nav.samples import ImuSamples
from nav.unscented import Scaling

EVERYTHING = (
    MonitoredAid(GnssAid(), Never),
    MonitoredAid(BarometerAid(), Never),
    MonitoredAid(MagnetometerAid(), Never),
)


def by_points(locals_):
    return tuple(dataclasses.replace(local, scaling=Scaling()) for local in locals_)


def begin(estimator, initial, increments, samples, seconds=1.0):
    estimator.start(initial)
    return feed(FusionHorizon(estimator), increments, samples, seconds)[0]


def cut(increments, end):
    rows = slice(0, round(end / DT))
    return ImuSamples(increments.t[rows], increments.dt[rows], increments.dtheta[rows], increments.dv[rows])


@pytest.mark.ci
@pytest.mark.parametrize("structure", ["no_reset", "full_reset"])
def test_small_errors_give_the_linear_federation(structure):
    """All filters by sigma points, or the first of them only, which then has linear ones beside it."""
    truth, increments, one, two, others = world()
    samples = one + two + others
    start = true_start(truth, (0.01 * DEG, 0.1, 1.0))
    few = cut(increments, 40)
    linear = begin(Federated(Config(CONSUMER, three(), structure=structure), field), start, few, samples)
    for locals_ in (by_points(three()), (*by_points(three()[:1]), *three()[1:])):
        estimates = begin(Federated(Config(CONSUMER, locals_, structure=structure), field), start, few, samples)
        for t in (5, 20, 39):
            shift, ratio = differ(estimates[t], linear[t], truth)
            assert 0 < shift < 0.05
            assert ratio < 5e-3


@pytest.mark.ci
@pytest.mark.parametrize("structure", ["no_reset", "partial"])
@pytest.mark.parametrize(("period_s", "most"), [(0.0, 1e-6), (1.0, 0.01), (5.0, 0.03)])
def test_one_filter_is_the_closed_ins_however_wrong_the_heading(structure, period_s, most):
    """From a heading 60 deg off the nominal state is tens of degrees from the filter's own, until they are fused."""
    truth, increments, one, _, _ = world()
    few = cut(increments, 25)
    sigma = np.array([0.2 * DEG, 0.2 * DEG, 60 * DEG, *[0.1] * 3, *[1.0] * 3])
    q_nb = Rotation.from_euler("z", 60, degrees=True) * Rotation.from_quat(truth.q_nb[0], scalar_first=True)
    start = dataclasses.replace(
        true_start(truth), q_nb=q_nb.as_quat(scalar_first=True), covariance=np.diag(sigma**2)
    )  # fmt: skip
    config = InsConfig(CONSUMER, (GnssAid(), BarometerAid(), MagnetometerAid()), scaling=Scaling(), false_rejection=0.0)
    closed = begin(Ins(config, field), start, few, one)
    only = Config(CONSUMER, (Local("only", EVERYTHING, scaling=Scaling()),), structure, fusion_period_s=period_s)
    estimates = begin(Federated(only, field), start, few, one)
    headings = [abs(error(closed[t], truth)[8]) / DEG for t in (0, 20)]
    assert headings[0] > 5 > 2 > headings[1]
    for t in (0, 1, 2, 5, 20):
        shift, ratio = differ(estimates[t], closed[t], truth)
        assert shift < most
        assert ratio < most


@functools.cache
def from_bad_headings(engine, structure, sigma_deg=60.0, seeds=8):
    """Heading errors (seeds, times) [deg] and mean NEES over nine states, of two receivers at 1 Hz in a manoeuvre."""
    truth, headings, nees = flight(30), [], []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        increments, *_ = imu(truth, CONSUMER, rng)
        fixes = [fix for fix in gnss(truth, rng) + named(gnss(truth, rng), "gnss2") if fix.t > 0]
        sigma = np.array([DEG, DEG, sigma_deg * DEG, *[0.1] * 3, *[1.0] * 3])
        wrong = sigma * rng.normal(size=9)
        q_nb = Rotation.from_rotvec(-wrong[:3]) * Rotation.from_quat(truth.q_nb[0], scalar_first=True)
        start = InitialState(
            0.0, truth.lat[0] + wrong[6] / 6.37e6, truth.lon[0] + wrong[7] / 4.26e6, truth.h[0] - wrong[8],
            truth.v_n[0] + wrong[3:6], q_nb.as_quat(scalar_first=True), np.diag(sigma**2),
        )  # fmt: skip
        locals_ = [Local(name, (MonitoredAid(GnssAid(name), Never),)) for name in ("gnss", "gnss2")]
        both = by_points(locals_) if engine == "unscented" else tuple(locals_)
        estimates = begin(Federated(Config(CONSUMER, both, structure), field), start, increments, fixes)
        errors = [(e, error(e, truth)) for e in (estimates[t] for t in (4, 9, 19, 28))]
        headings.append([wrong[8] / DEG for _, wrong in errors])
        nees.append([wrong @ np.linalg.solve(e.covariance, wrong) / 9 for e, wrong in errors])
    return np.array(headings), np.mean(nees, axis=0)


@pytest.mark.ci
@pytest.mark.parametrize("structure", ["no_reset", "full_reset", "partial"])
def test_headings_far_off_are_found_and_nothing_is_claimed_too_much(structure):
    """Start 60 deg wrong, 1 sigma, of which each filter is told 85: a linear federation is lost, and sure of itself."""
    headings, nees = from_bad_headings("unscented", structure)
    linear, overconfident = from_bad_headings("linear", "no_reset")
    rms, lost = (np.sqrt(np.mean(errors**2, axis=0)) for errors in (headings, linear))
    assert (rms[1:] < 0.5 * lost[1:]).all()
    assert rms[-1] < 4
    # Errors of 60 deg are not Gaussian however they are propagated, so the upper bounds are not those of chi-square: of
    # 8 flights with nine states, 99.9 % of consistent ones are between 0.54 and 1.64.
    assert (nees < [4, 2.5, 2, 2]).all()
    assert (nees > chi2.ppf(0.0005, 72) / 72).all()
    assert (overconfident > 5).all()


def test_a_covariance_turns_with_the_axes_of_its_own_estimate():
    """exp([phi x]) exp(-[x x]) = exp(-[(x + dx) x]): the slope of dx by differences, with scipy's exponential."""
    x, h = np.array([0.3, -0.5, 0.9]), 1e-6
    dx = np.empty((3, 3))
    for k in range(3):
        ends = []
        for step in (h, -h):
            phi = step * np.eye(3)[k]
            R = expm(_cross_matrix(phi)) @ expm(-_cross_matrix(x))
            ends.append(-Rotation.from_matrix(R).as_rotvec())
        dx[:, k] = (ends[0] - ends[1]) / (2 * h)
    root = np.random.default_rng(3).normal(size=(5, 5))
    P = root @ root.T
    J = -np.eye(5)  # of the other states, dx is minus the error
    J[:3, :3] = dx
    values = np.r_[x, 1.0, 2.0]
    np.testing.assert_allclose(turned(values, P, own=False), J @ P @ J.T, atol=1e-7)
    np.testing.assert_allclose(turned(values, turned(values, P, own=False), own=True), P, atol=1e-12)


def _cross_matrix(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


@pytest.mark.ci
@pytest.mark.parametrize(("structure", "recall_s"), [("no_reset", None), ("full_reset", None), ("no_reset", 10.0)])
def test_a_spoofed_receiver_is_isolated_and_readmitted(structure, recall_s):
    """As with linear filters: isolation starts the filters again, or takes one back, and readmission judges by all."""
    truth, increments, one, two, others = world(260)
    spoofed = ramp(one, 100, 160, 0.5, True)
    one_filter, two_filter, air = three(DETECTORS["glr"])
    config = Config(CONSUMER, (*by_points((one_filter, two_filter)), air), structure, recall_s=recall_s)
    federated, estimates, _ = fly(config, spoofed + two + others, cut(increments, 175))
    assert max(horizontal(estimates, truth, 50).values()) < (5.0 if recall_s else 2.0)
    assert {(e.local, e.sensor) for e in federated.events} == {("one", "gnss")}
    assert 100 < federated.events[0].t < 116
    assert 160 < federated.events[-1].t < 165
    assert federated.isolated() == []
    assert (np.abs(error(estimates[-1], truth)) < 4 * np.sqrt(np.diag(estimates[-1].covariance))).all()


@pytest.mark.ci
def test_blocks_of_any_size_give_the_same_bits():
    _, increments, one, two, others = world()
    few = cut(increments, 15)
    mixed = (*by_points(three()[:2]), three()[2])
    finals = [fly(Config(CONSUMER, mixed), one + two + others, few, seconds)[1][-1] for seconds in (0.055, 1.0, 3.0)]
    for other in finals[1:]:
        assert other.t == finals[0].t
        np.testing.assert_array_equal(other.q_nb, finals[0].q_nb)
        np.testing.assert_array_equal(other.covariance, finals[0].covariance)
