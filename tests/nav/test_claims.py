"""Claims that follow innovations: where they go, how far, and which filters have them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from worlds.ins import CONSUMER, FIELD_N

from nav.aids import BarometerAid, GnssAid, MagnetometerAid
from nav.alignment import InitialState
from nav.claims import NARROWEST, OUTLYING, PAUSE_S, WIDEST, Claim, Following
from nav.detection import ChiSquareGate
from nav.ins import Ins, InsConfig
from nav.local_filter import LocalFilter
from nav.samples import BarometerSample, FixType, GnssSample, Outcome
from nav.weighting import SageHusa
from testbed.estimators.datasheet import aid_of
from testbed.scenario import Scenario

PERIOD_S = 0.2


def taught(sigma, following, samples=20_000, told=1.0, HPH=0.0):
    """The mean scale of the second half, of a claim of one axis whose noise has this ``sigma``."""
    claim, rng, scales = Claim(following), np.random.default_rng(2), []
    for k, nu in enumerate(rng.normal(0.0, sigma, samples)):
        claim.heard(nu**2 / (HPH + claim.scale * told), k * PERIOD_S)
        scales.append(claim.scale)
    return float(np.mean(scales[samples // 2 :]))


@pytest.mark.parametrize("sigma", [0.5, 1.0, 2.0])
def test_a_claim_finds_the_noise_that_there_is(sigma):
    assert taught(sigma, Following(30.0, 0.01, 100.0)) == pytest.approx(sigma**2, rel=0.1)


@pytest.mark.parametrize(("sigma", "scale"), [(0.1, NARROWEST), (5.0, 1.0)])
def test_it_stays_within_its_limits(sigma, scale):
    assert taught(sigma, Following(5.0)) == pytest.approx(scale, rel=0.15)


def test_one_outlier_teaches_little_and_a_sample_counts_once():
    claim = Claim(Following(30.0, 1.0, WIDEST))
    claim.heard(1.0, 0.0)
    claim.heard(1e6, 0.2)
    assert claim.scale == pytest.approx(math.exp(0.2 / 30.0 * (OUTLYING - 1.0)))
    before = claim.scale
    claim.heard(1e6, 0.2)
    claim.heard(math.nan, 0.4)
    assert claim.scale == before


def test_a_pause_teaches_as_a_second_does_and_a_long_one_takes_back_what_was_learned():
    short, long = Claim(Following(30.0)), Claim(Following(30.0))
    for claim, until in ((short, 1.0), (long, PAUSE_S)):
        claim.heard(0.0, 0.0)
        claim.heard(0.0, until)
    assert long.scale == short.scale == pytest.approx(math.exp(-1 / 30.0))
    for k in range(20):
        long.heard(0.0, PAUSE_S + k)
    t = 40.0 + PAUSE_S
    assert long.at(t) == 1.0 > long.scale  # for what is made of the first sample, too
    long.heard(1.0, t)
    assert long.scale == 1.0


def test_however_short_the_time_it_stays_within_its_limits():
    claim = Claim(Following(1e-4, 1.0, WIDEST))
    for t in range(3):
        claim.heard(1e6, float(t))
    assert claim.scale == WIDEST


FOLLOWED = (GnssAid(follow_s=5.0), BarometerAid(error_sigma=3.0, follow_s=30.0), MagnetometerAid(follow_s=60.0))


def test_only_closed_filters_that_are_told_so_have_claims():
    gate = ChiSquareGate(1e-3)
    closed = LocalFilter(CONSUMER, FOLLOWED, gate)
    assert {part for _, part in closed.claims} == {"gnss_position", "gnss_velocity", "barometer", "magnetometer"}
    assert all(closed.limits(aid.sensor) is None for aid in FOLLOWED)  # nothing that many steps may be taken of at once
    assert not LocalFilter(CONSUMER, FOLLOWED, gate, closed=False).claims
    assert not LocalFilter(CONSUMER, (GnssAid(), BarometerAid(error_sigma=3.0), MagnetometerAid()), gate).claims
    assert not BarometerAid(follow_s=30.0).following  # without a wake


def test_what_learns_R_replaces_a_claim():
    filter_ = LocalFilter(CONSUMER, FOLLOWED, ChiSquareGate(1e-3))
    filter_.weigh_by({"gnss_velocity": SageHusa()})
    assert ("gnss", "gnss_velocity") not in filter_.claims
    assert ("gnss", "gnss_position") in filter_.claims


def at_rest(aids):
    """An INS that knows that it is at rest."""
    ins = Ins(InsConfig(CONSUMER, aids), lambda *_: FIELD_N)
    covariance = np.diag([1e-6] * 3 + [1e-6] * 3 + [1e-4] * 3)
    ins.start(InitialState(0.0, 0.8, 0.1, 300.0, np.zeros(3), np.array([1.0, 0, 0, 0]), covariance))
    return ins


def held(ins, sample):
    """The reports on a sample at a time to which nothing has moved."""
    ins.t = sample.t
    return ins.update(sample)


def fix(t, off=0.0, v=0.0):
    """A fix ``off`` [m] below, with a velocity down."""
    sigma = np.full(3, 1.0)
    return GnssSample(
        t, t, 0.8, 0.1, 300.0 - off, np.array([0.0, 0.0, v]), sigma, 0.1 * sigma, FixType.FIX_3D, 10, 1.0, 1.5
    )


def test_positions_are_claimed_to_be_better_and_velocities_worse_even_by_those_refused():
    ins = at_rest((GnssAid(follow_s=5.0),))
    position, velocity = (ins._filter.claims["gnss", part] for part in ("gnss_position", "gnss_velocity"))
    reports = [held(ins, fix(PERIOD_S * k, v=1.0))[1] for k in range(1, 20)]
    assert reports[0].outcome is Outcome.OUTSIDE_GATE
    assert position.scale < 1.0 < velocity.scale
    first, last = (float(report.S[0, 0]) for report in (reports[0], reports[-1]))
    assert last > 2.0 * first
    assert velocity.scale <= WIDEST


def test_the_driving_noise_of_a_wake_follows():
    ins = at_rest((GnssAid(), BarometerAid(error_sigma=3.0, follow_s=2.0)))
    where = ins.model.slices["barometer_error"]
    told = ins._reference.moving[2][0, where].copy()
    for k in range(1, 100):
        held(ins, BarometerSample(PERIOD_S * k, PERIOD_S * k, 97_772.6))
    scale = ins._filter.claims["barometer", "barometer"].scale
    assert scale != 1.0
    np.testing.assert_allclose(ins._reference.moving[2][0, where], scale * told)


def test_what_a_wake_may_be_grows_with_what_drives_it():
    ins = at_rest((GnssAid(), BarometerAid(error_sigma=3.0, follow_s=2.0)))
    k = ins.model.start("barometer_error")
    claim = ins._filter.claims["barometer", "barometer"]
    for row in range(1, 100):
        held(ins, BarometerSample(PERIOD_S * row, PERIOD_S * row, 97_772.6))
    P, before, scale = ins._state.P[0], 1.0, claim.scale
    P[k], P[:, k] = 0.0, 0.0  # as small as it has become by now in flight
    P[k, k] = before
    report = held(ins, BarometerSample(PERIOD_S * 100, PERIOD_S * 100, 97_272.6))[0]
    assert report.outcome is Outcome.OUTSIDE_GATE  # so that nothing else moved it
    assert claim.scale > scale
    assert ins._state.P[0, k, k] / before == pytest.approx(claim.scale / scale)
    for row in range(101, 200):
        held(ins, BarometerSample(PERIOD_S * row, PERIOD_S * row, 97_772.6 - 500.0 * (row % 5 == 0)))
        assert ins._state.P[0, k, k] <= 9.0 * (1 + 1e-12)  # never to more than what is told


def test_a_filter_that_begins_anew_claims_what_is_told():
    """What it learned while it was lost is no error of its sensors."""
    ins = at_rest((GnssAid(follow_s=5.0),))
    velocity = ins._filter.claims["gnss", "gnss_velocity"]
    held(ins, fix(0.0))
    velocity.scale = WIDEST
    for k in range(1, 400):  # it takes half a minute until it gives in
        position, *_ = held(ins, fix(PERIOD_S * k, off=-1e3))
        if position.outcome is Outcome.FUSED:
            break
        assert velocity.scale == WIDEST
    assert position.outcome is Outcome.FUSED
    assert velocity.scale == 1.0


def test_a_gate_lets_a_receiver_contradict_itself_as_far_as_a_sound_one_does():
    for told, outcome in ((0.0, Outcome.OUTSIDE_GATE), (7.5, Outcome.FUSED)):
        ins = at_rest((GnssAid(largest_jump=told),))
        for k in range(1, 30):
            held(ins, fix(PERIOD_S * k))
        report = held(ins, fix(PERIOD_S * 30, off=6.0))[0]
        assert report.outcome is outcome
        assert report.nis > ins._gate.threshold(3)
        assert (report.nis <= report.threshold) == (outcome is Outcome.FUSED)
    assert held(ins, fix(PERIOD_S * 31, off=30.0))[0].outcome is Outcome.OUTSIDE_GATE


def test_grades_of_hobby_hardware_follow_and_others_do_not():
    for name, follows in (("hardware_loiter", True), ("loiter_gnss_outage", False)):
        scenario = Scenario.load(name)
        rig = scenario.rig(1)
        imu = rig.imu("imu").errors()
        kinds = {section.kind: sensor for sensor, section in rig.sensors.items()}
        made = {
            kind: aid_of(kinds[kind], rig, imu, rig.air(None, None)) for kind in ("gnss", "barometer", "magnetometer")
        }
        assert all(bool(aid.following) == follows for aid in made.values())
