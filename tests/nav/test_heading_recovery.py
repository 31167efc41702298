"""A filter that begins with a wrong attitude, and is sure of it: found soon, and only where it is wrong."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worlds.federated import field, named, three, true_start
from worlds.ins import CONSUMER, barometer, error, feed, flight, gnss, imu, magnetometer

from nav.aids import BarometerAid, GnssAid, MagnetometerAid
from nav.federated import Federated
from nav.federation import Config
from nav.heading_recovery import BELIEVED_S, HeadingRecovery
from nav.horizon import FusionHorizon
from nav.ins import Ins, InsConfig
from nav.samples import Outcome

SMALL = dataclasses.replace(CONSUMER, gyro_motion=0.01, accel_motion=0.01)
AIDS = (GnssAid(), BarometerAid(), MagnetometerAid())
SECONDS = 60


def a_filter(kind):
    if kind == "federated":
        return Federated(Config(SMALL, three()), field)
    aids = AIDS if kind == "ins" else AIDS[:2]
    return Ins(InsConfig(SMALL, aids, smooth=kind == "smoother"), field)


def begun(truth, turn_deg, about=(0.0, 0.0, 1.0)):
    """The state at the beginning, turned about an axis of n, claimed to be right to a tenth of a degree."""
    turned = Rotation.from_rotvec(np.radians(turn_deg) * np.array(about)) * Rotation.from_matrix(truth.C_nb[0])
    return dataclasses.replace(true_start(truth), q_nb=turned.as_quat(scalar_first=True))


def flown(estimator, turn_deg, seed=0, seconds=1.0, change=lambda fix: fix, about=(0.0, 0.0, 1.0)):
    """The truth, the estimates of a minute, and when the estimator was started again."""
    truth, rng = flight(SECONDS), np.random.default_rng(seed)
    increments, *_ = imu(truth, CONSUMER, rng)
    fixes = [change(fix) for fix in gnss(truth, rng, 5.0)] + named(gnss(truth, rng, 5.0), "gnss2")
    samples = fixes + barometer(truth, rng) + magnetometer(truth, rng)
    start, again = estimator.start, []
    start(begun(truth, turn_deg, about))
    estimator.start = lambda initial: (again.append(initial.t), start(initial))
    return truth, feed(FusionHorizon(estimator), increments, samples, seconds)[0], again


@pytest.mark.ci
@pytest.mark.parametrize("kind", ["ins", "federated", "smoother"])
@pytest.mark.parametrize("turn_deg", [-60.0, 50.0, 90.0, 180.0])
def test_a_wrong_heading_is_found_soon(kind, turn_deg):
    """It circles; it would be hundreds of metres off for minutes, claiming a third of it.

    One that is off by less bent its biases until fixes were fused again, and was not found before 27 s, or never.
    """
    truth, estimates, again = flown(a_filter(kind), turn_deg)
    assert len(again) == 1
    assert again[0] < 15.0
    for estimate in estimates:
        off, sigma = error(estimate, truth), np.sqrt(np.diag(estimate.covariance))
        if estimate.t > again[0] + 0.1:
            assert np.hypot(*off[:2]) < 8.0, estimate.t
            assert (np.abs(off) < 5 * sigma).all(), estimate.t


def test_a_wrong_tilt_too():
    truth, estimates, again = flown(a_filter("ins"), 40.0, about=(1.0, 0.0, 0.0))
    assert len(again) <= 1
    assert np.hypot(*error(estimates[-1], truth)[:2]) < 4.0


@pytest.mark.ci
@pytest.mark.parametrize("kind", ["ins", "federated"])
def test_a_right_one_is_let_alone(kind):
    for seed in range(3):
        assert not flown(a_filter(kind), 0.0, seed)[2]


def pulled(fix, speed, acceleration=0.0):
    """A fix whose receiver is led to the east from 20 s on."""
    t = fix.t - 20
    east = speed * t + 0.5 * acceleration * t**2
    v_n = fix.v_n + np.array([0.0, speed + acceleration * t, 0.0])
    return dataclasses.replace(fix, lon=fix.lon + east / (6.38e6 * math.cos(fix.lat)), v_n=v_n)


@pytest.mark.ci
@pytest.mark.parametrize(
    "false",
    [
        lambda fix: dataclasses.replace(fix, lat=fix.lat + 1e-4),  # 640 m away
        lambda fix: pulled(fix, 6.0),
        lambda fix: pulled(fix, 0.0, 0.5),
        lambda fix: pulled(fix, 0.0, 1.0),
        lambda fix: pulled(fix, 0.0, 2.0),
        lambda fix: pulled(fix, 0.0, 4.0),
        lambda fix: dataclasses.replace(pulled(fix, 0.0, 3.0), sigma_velocity_n=np.full(3, 0.3)),
        lambda fix: dataclasses.replace(pulled(fix, 0.0, 6.0), sigma_velocity_n=np.full(3, 0.3)),
        lambda fix: dataclasses.replace(fix, v_n=fix.v_n + 8 * np.sin(np.arange(3) + 1.7 * fix.t)),
        lambda fix: dataclasses.replace(fix, v_n=fix.v_n * [1.0, -1.0, 1.0]),
        lambda fix: dataclasses.replace(fix, v_n=fix.v_n * [-1.0, -1.0, 1.0]),
    ],
)
@pytest.mark.parametrize("kind", ["ins", "federated"])
def test_a_receiver_led_astray_tells_no_other_attitude(kind, false):
    """A steady pull is a tilt, and velocities alone are no reason where positions are fused: both were believed."""
    change = lambda fix: false(fix) if fix.t > 20 else fix  # noqa: E731
    again = flown(a_filter(kind), 0.0, change=change)[2]
    assert not [t for t in again if t < 20 + InsConfig(SMALL).patience_s]


@pytest.mark.ci
def test_a_receiver_that_is_elsewhere_is_not_believed():
    """A wrong attitude led the filter away by hundreds of metres, not by twenty kilometres, until patience ends."""
    change = lambda fix: dataclasses.replace(fix, lat=fix.lat + 3e-3)  # noqa: E731
    again = flown(a_filter("ins"), 120.0, change=change)[2]
    assert min(again) >= InsConfig(SMALL).patience_s


@pytest.mark.ci
@pytest.mark.parametrize("kind", ["ins", "federated", "smoother"])
def test_however_it_is_cut_the_same_bits(kind):
    """Where no compass begins the doubt, too: fixes whose position was used and whose velocity was not."""
    whole, parts = (flown(a_filter(kind), 120.0, seconds=seconds)[1] for seconds in (10.0, 0.5))
    by_time = {round(one.t, 3): one for one in parts}
    for one in whole:
        other = by_time[round(one.t, 3)]
        assert np.array_equal(one.covariance, other.covariance)
        assert (one.lat, one.lon, one.h) == (other.lat, other.lon, other.h)


@pytest.mark.ci
@pytest.mark.parametrize("lost", [3, 7, 11])
def test_what_is_refused_now_and_then_is_no_doubt(lost, monkeypatch):
    """Each so many fixes one jumps, and is refused: nobody looks for an attitude once it has flown for a while."""
    looked = []

    def judge(self, state, filters, sample, last_fused):
        if sample.t > BELIEVED_S + 1.0:
            looked.append(self.under_way)

    monkeypatch.setattr(HeadingRecovery, "judge", judge)

    def jump(fix):
        return dataclasses.replace(fix, lat=fix.lat + 1e-5) if round(5 * fix.t) % lost == 0 else fix

    flown(a_filter("ins"), 0.0, change=jump)
    assert looked
    assert not any(looked)


def test_that_it_began_anew_is_told():
    told = []
    estimator = a_filter("ins")
    update = estimator.update
    estimator.update = lambda sample: told.extend(reports := update(sample)) or reports
    again = flown(estimator, 120.0)[2]
    said = [one for one in told if one.reason.startswith("the attitude was wrong: begun anew")]
    assert {one.t for one in said} == set(again)
    assert {one.outcome for one in said} == {Outcome.WITHHELD}


@pytest.mark.parametrize("kind", ["ins", "federated"])
def test_it_is_doubted_no_longer_where_nobody_is_heard_any_more(kind):
    """Every step was taken by itself until the next fix, which may be far."""
    estimator = a_filter(kind)
    truth, rng = flight(SECONDS), np.random.default_rng(0)
    increments, *_ = imu(truth, CONSUMER, rng)
    estimator.start(begun(truth, 0.0))
    fixes = [fix for fix in gnss(truth, rng, 5.0) if fix.t < 5.0]
    feed(FusionHorizon(estimator), increments, fixes, 1.0)
    assert not estimator.realignment.under_way
