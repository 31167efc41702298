"""Fixes that jump and stay: what is claimed of a filter that gave in to them, since they may be the wrong ones."""

from dataclasses import replace

import numpy as np
import pymap3d
import pytest
from worlds.ins import CONSUMER, FIELD_N, barometer, feed, flight, gnss, imu, magnetometer

from nav.aids import BarometerAid, GnssAid, MagnetometerAid
from nav.detection import GnssMonitor
from nav.doubts import FixDoubt
from nav.earth import displacement_n
from nav.error_model import POS
from nav.federated import Federated
from nav.federation import Config, Local
from nav.horizon import FusionHorizon
from nav.ins import Ins, InsConfig
from nav.monitor import MonitoredAid
from nav.samples import ImuSamples

AIDS = (GnssAid(), BarometerAid(), MagnetometerAid())
POOR = replace(CONSUMER, gyro_noise=100 * CONSUMER.gyro_noise, accel_noise=100 * CONSUMER.accel_noise)
JUMPED_S, NORTH = 40.0, 300.0  # when positions jump, and by how much [s, m]


def jumped(fix, back_s):
    if not JUMPED_S <= fix.t < back_s:
        return fix
    lat, lon, h = pymap3d.ned2geodetic(NORTH, 0.0, 0.0, fix.lat, fix.lon, fix.h, deg=False)
    return replace(fix, lat=lat, lon=lon, h=h)


def estimator(kind, model=CONSUMER):
    if kind == "ins":
        return Ins(InsConfig(model, AIDS), lambda *_: FIELD_N)
    parts = {"gnss": AIDS[:2], "field": AIDS[2:]}
    locals_ = tuple(Local(name, tuple(MonitoredAid(aid) for aid in aids)) for name, aids in parts.items())
    return Federated(Config(model, locals_), lambda *_: FIELD_N)


def flown(kind, back_s, outlier_s=np.inf):
    """Errors to the north and their claims [m] at each second [s]."""
    truth, rng = flight(120.0), np.random.default_rng(56101)
    increments, *_ = imu(truth, CONSUMER, rng)
    fixes = [jumped(one, back_s) for one in gnss(truth, rng, 5.0)]
    fixes = [replace(one, h=one.h + 60.0) if outlier_s <= one.t < outlier_s + 0.3 else one for one in fixes]
    samples = fixes + magnetometer(truth, rng) + barometer(truth, rng, 5.0)
    estimates, _ = feed(FusionHorizon(estimator(kind)), increments, samples)
    return against(truth, estimates)


def against(truth, estimates):
    """Times [s], errors to the north and their claims [m]."""
    t = np.array([one.t for one in estimates])
    k = np.searchsorted(truth.t, t - 1e-9)
    errors = [
        displacement_n(one.lat, one.lon, one.h, truth.lat[row], truth.lon[row], truth.h[row])[0]
        for one, row in zip(estimates, k, strict=True)
    ]
    return t, np.array(errors), np.array([np.sqrt(one.covariance[0, 0]) for one in estimates])


@pytest.mark.ci
@pytest.mark.parametrize("kind", ["ins", "federated"])
def test_hundreds_of_metres_are_not_claimed_as_one(kind):
    t, error, claim = flown(kind, np.inf)
    led = (t > JUMPED_S + 2.0) & (np.abs(error) > 100.0)
    assert led.sum() > 40
    assert (np.abs(error[led]) < 3.0 * claim[led]).all()
    assert (claim[t < JUMPED_S - 1.0][10:] < 5.0).all()


@pytest.mark.ci
@pytest.mark.parametrize("kind", ["ins", "federated"])
def test_an_outlier_after_it_takes_nothing_of_the_doubt(kind):
    """It begins a streak that would be one after an outage; and adds nothing: the jump is as large as it was."""
    t, error, claim = flown(kind, np.inf, outlier_s=52.0)
    led = (t > JUMPED_S + 2.0) & (np.abs(error) > 100.0)
    assert led.sum() > 40
    assert (np.abs(error[led]) < 3.0 * claim[led]).all()
    assert (claim[led] < 1.1 * NORTH).all()


@pytest.mark.ci
@pytest.mark.parametrize("kind", ["ins", "federated"])
def test_a_short_jump_that_nobody_gave_in_to_leaves_none(kind):
    t, error, claim = flown(kind, JUMPED_S + 5.0)
    _, _, undisturbed = flown(kind, 0.0)
    assert np.abs(error[t > 5.0]).max() < 5.0
    assert claim[-1] == pytest.approx(undisturbed[-1], rel=0.05)


@pytest.mark.ci
@pytest.mark.parametrize("kind", ["ins", "federated"])
def test_one_that_came_back_leaves_no_doubt(kind):
    t, error, claim = flown(kind, 85.0)
    assert np.abs(error[(t > 75.0) & (t < 84.0)]).min() > 250.0  # it had given in
    assert np.abs(error[-1]) < 3.0
    assert claim[-1] < 5.0


@pytest.mark.ci
def test_how_likely_the_place_before_is_right():
    """Errors that begin at any time, of which 1/T last longer than T [s], drawn; seen: 40 s, a jump, 25 s."""
    lasted, stayed, width, rng = 40.0, 25.0, 4.0, np.random.default_rng(56102)
    begun = rng.uniform(-4000.0, lasted + width, 8_000_000)
    ended = begun + 1.0 / rng.uniform(size=begun.size)
    before = ((begun < 0.0) & (np.abs(ended - lasted) < width / 2)).sum()
    after = ((np.abs(begun - lasted) < width / 2) & (ended > lasted + stayed)).sum()
    doubt = FixDoubt()
    doubt.begin(0.0)
    doubt.gave_in(lasted, np.array([10.0, 0.0, 0.0]), np.zeros(3), alone=True)
    wrong = 0.5 * doubt.off(np.array([lasted + stayed]))[0, POS] ** 2 / 100.0
    assert wrong == pytest.approx(after / (after + before), abs=0.03)


def test_what_is_claimed_falls_with_time_and_lasts_until_the_receiver_comes_back():
    doubt, t = FixDoubt(), np.array([100.0, 130.0, 400.0])
    doubt.begin(0.0)
    assert not doubt.off(t).any()
    doubt.gave_in(100.0, np.array([3.0, -40.0, 0.0]), np.array([25.0, 0.0, 0.0]), alone=True)
    off = doubt.off(t)
    assert not off[:, POS].any()  # within what is known
    assert off[:, POS + 1] == pytest.approx(-40.0 * np.sqrt(2.0 * 100.0 / t))
    receiver = GnssMonitor(10.0, 1.0, 4.0, 30.0, 16.0, contradicted=True)
    doubt.heard(np.array([0.0, 0.0, 90.0]), np.zeros(3), receiver)
    assert doubt.off(t)[:, POS + 2] == pytest.approx(np.full(3, 90.0))  # the larger counts
    doubt.heard(np.zeros(3), np.zeros(3), replace(receiver, contradicted=False))
    before = doubt.off(t)
    doubt.gave_in(200.0, np.array([0.0, 500.0, 0.0]), np.zeros(3), alone=False)
    doubt.begin(210.0)
    assert np.array_equal(doubt.off(t), before)  # the receiver is where it was
    doubt.gave_in(220.0, np.array([0.0, 1.0, 0.0]), np.zeros(3), alone=True)
    assert doubt.off(t)[1] == pytest.approx(before[1], abs=2.0)  # nor has it had less time for that
    doubt.gave_in(300.0, np.array([-3.0, 39.0, 0.0]), np.ones(3), alone=False)
    assert not doubt.off(t + 300.0).any()  # it has come back


def poor_flight(last_s, back_s):
    """Increments and samples of a flight with a poor IMU whose positions jump."""
    truth, rng = flight(120.0), np.random.default_rng(56103)
    increments, *_ = imu(truth, POOR, rng)
    samples = [jumped(one, back_s) for one in gnss(truth, rng, 5.0)] + magnetometer(truth, rng)
    samples += barometer(truth, rng, 5.0)
    rows = increments.t <= last_s
    kept = ImuSamples(*(getattr(increments, name)[rows] for name in ("t", "dt", "dtheta", "dv")))
    return truth, kept, [one for one in samples if one.t_arrival <= last_s]


@pytest.mark.ci
def test_a_lone_receiver_that_jumps_takes_nothing_of_the_position_with_it():
    """Others know no position: starting again from them was 70 m off in ten seconds, in recorded flights kilometres."""
    truth, increments, samples = poor_flight(120.0, 85.0)
    estimates, _ = feed(FusionHorizon(estimator("federated", POOR)), increments, samples)
    t, north, _ = against(truth, estimates)
    assert np.abs(north[(t > 5.0) & (t < JUMPED_S + 10.0)]).max() < 30.0
    assert np.abs(north[t > 5.0]).max() < 1.2 * NORTH
    assert np.abs(north[-1]) < 5.0


@pytest.mark.ci
def test_a_filter_that_is_lost_knows_it_when_the_federation_gives_in():
    """It is elsewhere than the others: what they are off the fixes is not what it is."""
    _, increments, samples = poor_flight(80.0, np.inf)
    federated = estimator("federated", POOR)
    horizon, place = FusionHorizon(federated), slice(POS, POS + 3)
    early = increments.t <= JUMPED_S - 1.0
    parts = [ImuSamples(*(getattr(increments, k)[r] for k in ("t", "dt", "dtheta", "dv"))) for r in (early, ~early)]
    feed(horizon, parts[0], [one for one in samples if one.t_arrival <= JUMPED_S - 1.0])
    federated._state.x[1, POS] += 2e4
    federated._state.P[1, place, place] += 3e4**2 * np.eye(3)
    feed(horizon, parts[1], [one for one in samples if one.t_arrival > JUMPED_S - 1.0])
    (x, _), (away, P) = federated.local("gnss"), federated.local("field")
    assert np.linalg.norm(away[place] - x[place]) > 1e4
    assert (np.abs(away[place] - x[place]) < 3.0 * np.sqrt(np.diag(P)[place])).all()
