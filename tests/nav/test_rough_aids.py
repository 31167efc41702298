"""Aids as hobby autopilots have them: late by an unknown time, bent by currents, blown upon, not calibrated."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
from worlds.ins import CONSUMER, FIELD_N, at_rest, error, feed, flight, gnss, imu, magnetometer

from nav.aids import AirspeedAid, GnssAid, MagnetometerAid
from nav.aids.airspeed import SLOW
from nav.aids.base import OperatingPoint
from nav.aids.gnss import WAKE_S, Wake
from nav.alignment import InitialState
from nav.detection import ChiSquareGate
from nav.earth import gravity
from nav.horizon import FusionHorizon
from nav.ins import Ins, InsConfig
from nav.local_filter import LocalFilter
from nav.reference import Reference
from nav.samples import AirspeedSample, FixType, GnssSample, ImuSamples, MagnetometerSample, Outcome

RECEIVER, STEP = GnssAid(latency_sigma=0.1), 0.2
SPEED, TURN = 20.0, 0.5  # of a level circle [m/s, rad/s]
LAT, H = math.radians(47.0), 300.0


def circling(aid, t=0.7, v_n=None):
    """A filter on the circle at ``t``, its IMU having felt the force of it; and what it measures there from."""
    ins = Ins(InsConfig(CONSUMER, (aid,)), lambda *_: FIELD_N)
    heading = TURN * t
    bank = math.atan(SPEED * TURN / gravity(LAT, H))
    attitude = Rotation.from_euler("ZYX", [heading, 0.0, bank])
    v_n = velocity(t) if v_n is None else v_n
    initial = InitialState(t, LAT, 0.1, H, v_n, attitude.as_quat(scalar_first=True), np.eye(9))
    reference = Reference([ins.model], [1.0], 10, lambda *_: FIELD_N)
    state = reference.start(initial)
    force_n = np.array([-SPEED * TURN * math.sin(heading), SPEED * TURN * math.cos(heading), -gravity(LAT, H)])
    state.rates[:] = attitude.inv().apply([[0.0, 0.0, TURN], force_n])
    state.acceleration[:] = force_n + np.array([0.0, 0.0, gravity(LAT, H)])
    starts = tuple(map(ins.model.start, aid.states))
    return OperatingPoint(reference, state, state.x[0], starts, state.P[0])


def velocity(t):
    return SPEED * np.array([math.cos(TURN * t), math.sin(TURN * t), 0.0])


def fix(v_n):
    sigma = np.full(3, 0.1)
    return GnssSample(0.7, 0.7, LAT, 0.1, H, v_n, 10 * sigma, sigma, FixType.FIX_3D, 10, 1.0, 1.0)


def test_an_uncertain_latency_counts_with_velocity_and_acceleration():
    """0.1 s at 20 m/s is 2 m along the track; at 10 m/s^2 across it 1 m/s: as noise, and as states at first."""
    aid, at = GnssAid(latency_sigma=0.1), circling(GnssAid(latency_sigma=0.1))
    along, across = velocity(0.7) / SPEED, np.array([-math.sin(0.35), math.cos(0.35), 0.0])
    late, lag = at.starts[2], at.starts[2] + 1
    position = aid.measure("gnss_position", fix(velocity(0.7)), at)
    np.testing.assert_allclose(position.R, 1.0 + (0.1 * SPEED * along) ** 2)
    np.testing.assert_allclose(position.H[:, [late, lag]], np.outer(-SPEED * along, [1, 0]))
    speed = aid.measure("gnss_velocity", fix(velocity(0.7)), at)
    np.testing.assert_allclose(speed.R, 0.01 + (0.1 * SPEED * TURN * across) ** 2, atol=1e-9)
    np.testing.assert_allclose(speed.H[:, [late, lag]], np.outer(-SPEED * TURN * across, [1, 1]), atol=1e-9)
    np.testing.assert_allclose(at.P[late : lag + 1, late : lag + 1], 0.01 * np.eye(2))


def test_a_wake_is_the_mean_of_the_last_half_second_and_what_goes_beyond_that_is_its_onset():
    manoeuvre = np.zeros((60, 3))
    manoeuvre[10:30] = [4.0, 1.0, 0.0]  # two pulls, of four seconds and of one sample
    manoeuvre[45] = 9.0
    kept = np.exp(-STEP / WAKE_S)
    mean = lfilter([1.0 - kept], [1.0, -kept], manoeuvre, axis=0)
    wake = Wake()
    for k, now in enumerate(manoeuvre):
        np.testing.assert_allclose(wake.heard(STEP * k, now), mean[k], atol=1e-12)
        np.testing.assert_allclose(wake.onset, np.maximum(now - mean[k], 0.0), atol=1e-12)


def test_a_wake_begins_with_what_it_hears_first_and_hears_each_sample_once():
    wake = Wake()
    np.testing.assert_array_equal(wake.heard(5.0, np.ones(3)), np.ones(3))
    np.testing.assert_array_equal(wake.heard(5.0, np.full(3, 7.0)), np.ones(3))
    np.testing.assert_array_equal(wake.heard(4.0, np.full(3, 7.0)), np.ones(3))  # taken back and flown again
    np.testing.assert_array_equal(wake.onset, np.zeros(3))


def test_velocities_are_taken_for_as_bad_and_judged_by_what_begins():
    """10 m/s^2 of a turn is 1 m/s of 0.1 s; half a second after it has ended 1/e of that variance is left."""
    filter_, at = LocalFilter(CONSUMER, [RECEIVER], ChiSquareGate(1e-3)), circling(RECEIVER)
    turning, straight = at.state.acceleration.copy(), np.zeros(3)

    def told(t, acceleration):
        at.state.acceleration[:] = acceleration
        sample = replace(fix(velocity(0.7)), t=t, t_arrival=t)
        R = filter_.measure(at.reference, at.state, RECEIVER, "gnss_velocity", sample).R
        return R - sample.sigma_velocity_n**2, filter_.as_judged("gnss_velocity", sample, np.eye(3)) - np.eye(3)

    pull, onset = told(0.7, turning)
    assert np.linalg.norm(np.sqrt(pull)) == pytest.approx(0.1 * SPEED * TURN)
    assert not onset.any()
    left, onset = told(0.7 + WAKE_S, straight)
    np.testing.assert_allclose(left, pull / np.e, atol=1e-12)
    assert not onset.any()
    nothing, _ = told(0.7 + 80 * WAKE_S, straight)
    np.testing.assert_allclose(nothing, 0.0, atol=1e-12)
    again, onset = told(0.7 + 81 * WAKE_S, turning)
    np.testing.assert_allclose(again + np.diag(onset), pull)
    np.testing.assert_allclose(again, (1 - 1 / np.e) * pull)


def test_a_receiver_whose_latency_is_known_leaves_no_wake():
    aid = GnssAid()
    filter_, at = LocalFilter(CONSUMER, [aid], ChiSquareGate(1e-3)), circling(aid)
    S = np.eye(3)
    found = filter_.measure(at.reference, at.state, aid, "gnss_velocity", fix(velocity(0.7)))
    np.testing.assert_array_equal(found.R, fix(velocity(0.7)).sigma_velocity_n ** 2)
    assert filter_.as_judged("gnss_velocity", fix(velocity(0.7)), S) is S


@pytest.mark.parametrize("lag", [0.1, -0.1, 0.2])
def test_a_velocity_older_than_its_position_is_held_against_its_own_time(lag):
    """What is left is of second order: half of a turn's v w^2 lag^2."""
    aid = GnssAid(velocity_lag=lag)
    measured = aid.measure("gnss_velocity", fix(velocity(0.7 - lag)), circling(aid))
    assert np.linalg.norm(measured.nu) < 0.5 * SPEED * TURN**2 * lag**2 * 1.05
    plain = GnssAid().measure("gnss_velocity", fix(velocity(0.7 - lag)), circling(GnssAid()))
    assert np.linalg.norm(plain.nu) == pytest.approx(SPEED * TURN * abs(lag), rel=0.01)


def test_a_field_of_the_wrong_length_is_doubted_by_as_much():
    aid = MagnetometerAid(sigma=1e-6, doubt=1.0)
    at = circling(aid)
    C_bn = Rotation.from_quat(at.state.q_nb, scalar_first=True).inv()
    sound = aid.measure("magnetometer", MagnetometerSample(0.7, 0.7, C_bn.apply(FIELD_N)), at)
    np.testing.assert_allclose(sound.R, 1e-12, rtol=1e-9)
    bent = aid.measure("magnetometer", MagnetometerSample(0.7, 0.7, 1.4 * C_bn.apply(FIELD_N)), at)
    np.testing.assert_allclose(bent.R, 1e-12 + (0.4 * np.linalg.norm(FIELD_N)) ** 2)


def test_a_pitot_that_is_blown_upon_at_rest_tells_nothing_of_the_wind():
    sample = AirspeedSample(0.7, 0.7, 14.0)
    at_rest = AirspeedAid().measure("airspeed", sample, circling(AirspeedAid(), v_n=np.array([0.3, 0.0, 0.0])))
    assert at_rest.withheld is not None
    assert at_rest.withheld.outcome is Outcome.OUT_OF_RANGE
    flown = AirspeedAid().measure("airspeed", sample, circling(AirspeedAid()))
    assert flown.withheld is None


def test_errors_of_pressure_count_for_more_when_it_is_slow():
    aid = AirspeedAid(minimum=5.0)
    fast, slow, none = (
        aid.measure("airspeed", AirspeedSample(0.7, 0.7, eas), circling(aid)) for eas in (SLOW, 6.0, 4.0)
    )
    assert fast.withheld is slow.withheld is None
    assert none.withheld.outcome is Outcome.OUT_OF_RANGE
    np.testing.assert_allclose(slow.R, fast.R * (SLOW / 6.0) ** 2)
    usual = AirspeedAid().measure("airspeed", AirspeedSample(0.7, 0.7, 6.0), circling(aid))
    assert usual.withheld.outcome is Outcome.OUT_OF_RANGE


def aligned(seconds, hard_iron, **aids):
    """An INS given a flight with a magnetometer that has this hard iron, until it is aligned."""
    truth, rng = flight(seconds), np.random.default_rng(3)
    increments, *_ = imu(truth, CONSUMER, rng)
    samples = gnss(truth, rng, 4.0) + magnetometer(truth, rng, hard_iron)
    ins = Ins(InsConfig(CONSUMER, (GnssAid(), MagnetometerAid(**aids))), lambda *_: FIELD_N)
    horizon = FusionHorizon(ins)
    for k in range(4 * seconds):
        rows = slice(50 * k, 50 * k + 50)
        block = ImuSamples(increments.t[rows], increments.dt[rows], increments.dtheta[rows], increments.dv[rows])
        horizon.push(block, [s for s in samples if 0.25 * k - 1e-6 <= s.t < 0.25 * (k + 1) - 1e-6])
        if ins.aligned:
            break
    estimate = ins.estimate()
    row = round(estimate.t * 200)
    off = (
        Rotation.from_quat(estimate.q_nb, scalar_first=True)
        * Rotation.from_quat(truth.q_nb[row], scalar_first=True).inv()
    )
    return ins, estimate, -off.as_rotvec()


LONGER, STEEPER = np.array([40e-6, -15e-6, 40e-6]), np.array([0.0, 0.0, -2 * FIELD_N[2]])


@pytest.mark.parametrize("hard_iron", [LONGER, STEEPER], ids=["longer", "as-long"])
def test_a_magnetometer_that_nobody_calibrated_tells_no_heading_but_is_learned(hard_iron: np.ndarray):
    """Hard iron as large as the field, which makes it longer, or turns it: the course begins, which knows no wind, and
    the samples then tell the bias.
    """
    _, estimate, phi = aligned(30, hard_iron)
    bias, sigma = estimate.extra["magnetometer_bias"]
    assert (np.abs(bias - hard_iron) < 4 * sigma).all()
    assert (np.abs(bias) > 5e-6).any()  # many times what it was told
    claimed = math.sqrt(estimate.covariance[8, 8])
    assert abs(phi[2]) < 3 * claimed
    assert claimed > math.radians(5)
    _, calibrated, _ = aligned(30, 1e-6 * np.ones(3))
    assert math.sqrt(calibrated.covariance[8, 8]) < math.radians(4)
    assert (calibrated.extra["magnetometer_bias"][1] < MagnetometerAid().bias_sigma).all()


@pytest.mark.parametrize("scale", [0.6, 1.0, 1.6])
def test_iron_that_makes_a_field_longer_or_shorter_tells_no_heading(scale: float):
    """The field that it was aligned by, heard again, tells nothing new: the heading stays as good as iron lets it."""
    truth, rng = at_rest(4), np.random.default_rng(46)
    along = truth.C_nb[0].T @ np.array([*FIELD_N[:2], 0.0])
    samples = gnss(truth, rng, 4.0) + magnetometer(truth, rng, (scale - 1) * along)
    ins = Ins(InsConfig(CONSUMER, (GnssAid(), MagnetometerAid(bias_sigma=10e-6))), lambda *_: FIELD_N)
    estimates, _ = feed(FusionHorizon(ins), imu(truth, CONSUMER, rng)[0], samples, 0.25)
    first = next(one for one in estimates if math.isfinite(one.lat))
    assert math.sqrt(first.covariance[8, 8]) > 0.9 * 10e-6 / math.hypot(*FIELD_N[:2])


def test_what_is_at_rest_begins_on_a_compass_whose_iron_is_nearly_as_large_as_the_field():
    """There is no course that could tell more; it claims hardly anything, and its heading is that of the field."""
    truth, rng = at_rest(4), np.random.default_rng(47)
    along = truth.C_nb[0].T @ np.array([*FIELD_N[:2], 0.0])
    samples = gnss(truth, rng, 4.0) + magnetometer(truth, rng, 0.9 * along)
    ins = Ins(InsConfig(CONSUMER, (GnssAid(), MagnetometerAid(bias_sigma=6e-6))), lambda *_: FIELD_N)
    estimates, _ = feed(FusionHorizon(ins), imu(truth, CONSUMER, rng)[0], samples, 0.25)
    first = next(one for one in estimates if math.isfinite(one.lat))
    assert math.sqrt(first.covariance[8, 8]) > math.radians(40)
    assert abs(error(first, truth)[8]) < math.radians(5)
