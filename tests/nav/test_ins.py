"""The inertial navigation as a whole: no noise no error, belief and disbelief, outages, broken samples."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.stats import norm
from worlds.ins import (
    CONSUMER,
    DEG,
    DT,
    FIELD_N,
    NOISELESS,
    WIND_N,
    airspeed,
    at_rest,
    barometer,
    error,
    feed,
    flight,
    gnss,
    imu,
    magnetometer,
)

from nav.aids import AirspeedAid, BarometerAid, GnssAid, MagnetometerAid
from nav.alignment import InitialState
from nav.detection import SURE, GnssMonitor, Verdict, WindMemory
from nav.error_model import CROSS
from nav.horizon import FusionHorizon
from nav.ins import Ins, InsConfig
from nav.samples import NO_SENSOR, AirspeedSample, BarometerSample, FixType, GnssSample, ImuSamples, Outcome, Status

ARM = (0.5, 0.1, -0.3)
RECEIVER, PRESSURE, COMPASS = GnssAid(arm_b=ARM), BarometerAid(), MagnetometerAid()
CONFIG = InsConfig(CONSUMER, (RECEIVER, PRESSURE, COMPASS, AirspeedAid(sideslip_sigma=None)))


def field(*_):
    return FIELD_N


def exact(truth):
    return ImuSamples(truth.t[1:], np.full(len(truth.t) - 1, DT), truth.dtheta[1:], truth.dv[1:])


def true_start(truth, sigma=(0.1 * DEG, 0.1, 1.0)):
    covariance = np.diag(np.repeat(sigma, 3) ** 2)
    return InitialState(0.0, truth.lat[0], truth.lon[0], truth.h[0], truth.v_n[0], truth.q_nb[0], covariance)


def everything(truth, rng, **of_gnss):
    increments, *_ = imu(truth, CONSUMER, rng)
    samples = gnss(truth, rng, 5.0, arm_b=ARM, **of_gnss)
    return increments, samples, barometer(truth, rng, 40.0) + magnetometer(truth, rng) + airspeed(truth, rng)


@pytest.mark.ci
def test_no_noise_no_error():
    """Every aid exact, at 10 Hz: what is left is rounding, linearisation and the covariance period."""
    truth = flight(60)
    rng = np.random.default_rng(0)
    samples = (
        gnss(truth, rng, 5.0, 0.0, 0.0, arm_b=ARM, offset_s=0.2)
        + barometer(truth, rng, 40.0, 0.0)
        + magnetometer(truth, rng, np.array([1e-6, -5e-7, 2e-7]), 0.0)
        + airspeed(truth, rng, 0.0)
    )
    ins = Ins(dataclasses.replace(CONFIG, imu=NOISELESS), field)
    ins.start(true_start(truth))
    estimates, reports = feed(FusionHorizon(ins), exact(truth), samples)
    assert all(r.weight == 1 for r in reports)
    wrong = error(estimates[-1], truth)
    assert np.abs(wrong[:3]).max() < 5e-3
    assert np.abs(wrong[3:6]).max() < 2e-3
    assert np.abs(wrong[6:]).max() < 1e-4
    extra = estimates[-1].extra
    np.testing.assert_allclose(extra["barometer_bias"][0], 40.0, atol=0.05)
    np.testing.assert_allclose(extra["wind"][0], WIND_N[:2], atol=0.02)
    np.testing.assert_allclose(extra["magnetometer_bias"][0], [1e-6, -5e-7, 2e-7], atol=2e-8)
    assert set(extra) == {"barometer_bias", "wind", "magnetometer_bias"}


@pytest.mark.ci
def test_dead_reckoning_without_aids():
    truth = flight(120)
    rng = np.random.default_rng(1)
    increments, fixes, others = everything(truth, rng)
    ins = Ins(dataclasses.replace(CONFIG, aids=(), alignment_aids=CONFIG.aids), field)
    estimates, reports = feed(FusionHorizon(ins), increments, fixes + others)
    assert reports == []
    assert estimates[-1].status == Status.ALIGNED | Status.DEAD_RECKONING
    assert estimates[-1].extra == {}
    wrong, sigma = error(estimates[-1], truth), np.sqrt(np.diag(estimates[-1].covariance))
    assert 20 < sigma[0] < 1000
    assert np.hypot(*wrong[:2]) > 5
    assert (np.abs(wrong) < 4 * sigma).all()


def test_all_aids_converge():
    truth = flight(120)
    rng = np.random.default_rng(2)
    increments, fixes, others = everything(truth, rng)
    estimates, reports = feed(FusionHorizon(Ins(CONFIG, field)), increments, fixes + others)
    assert estimates[-1].status == Status.ALIGNED | Status.GNSS_FUSED
    wrong, sigma = error(estimates[-1], truth), np.sqrt(np.diag(estimates[-1].covariance))
    assert (np.abs(wrong) < 4 * sigma).all()
    assert sigma[6] < 0.15 * DEG
    assert sigma[8] < 0.7 * DEG
    for aid in ("gnss_position", "gnss_velocity", "barometer", "magnetometer", "airspeed"):
        chosen = [r for r in reports if r.aid == aid]
        mean = np.mean([r.nis / len(r.innovation) for r in chosen])
        assert 0.85 < mean < 1.15, aid
        assert np.mean([r.weight for r in chosen]) > 0.99


@pytest.mark.ci
@pytest.mark.parametrize("period", [4, 10])
def test_covariance_period_loses_nothing(period):
    truth = flight(60)
    rng = np.random.default_rng(3)
    increments, fixes, others = everything(truth, rng)
    finals = []
    for samples in (1, period):
        ins = Ins(dataclasses.replace(CONFIG, covariance_period=samples), field)
        finals.append(feed(FusionHorizon(ins), increments, fixes + others)[0][-1])
    sigma = np.sqrt(np.diag(finals[0].covariance))
    np.testing.assert_allclose(np.sqrt(np.diag(finals[1].covariance)), sigma, rtol=2e-3)
    difference = error(finals[0], truth) - error(finals[1], truth)
    assert (np.abs(difference) < 0.02 * sigma).all()


def moved(fix, north_m, east_m=0.0):
    east = east_m / (6.37e6 * math.cos(fix.lat))
    return dataclasses.replace(fix, lat=fix.lat + north_m / 6.37e6, lon=fix.lon + east)


def aided(samples, seconds, config=CONFIG, seed=4, duration=120):
    truth = flight(duration)
    increments, fixes, others = everything(truth, np.random.default_rng(seed))
    estimates, reports = feed(FusionHorizon(Ins(config, field)), increments, samples(fixes) + others, seconds)
    errors = {round(e.t, 3): np.hypot(*error(e, truth)[:2]) for e in estimates if e.status & Status.ALIGNED}
    return errors, [r for r in reports if r.aid == "gnss_position"], estimates


@pytest.mark.ci
@pytest.mark.parametrize("length_s", [0.1, 3.0])
def test_a_glitch_of_a_hundred_metres_is_rejected(length_s):
    def glitch(fixes):
        return [moved(f, 100.0) if 60 <= f.t < 60 + length_s else f for f in fixes]

    errors, reports, _ = aided(glitch, 0.2)
    assert all((r.weight == 0) == (60 <= r.t < 60 + length_s) for r in reports if 50 < r.t < 100)
    assert max(e for t, e in errors.items() if t > 50) < 3.0


def outage(fixes, start, stop):
    return [
        f if not start <= f.t < stop else dataclasses.replace(f, lat=math.nan, fix_type=FixType.NO_FIX) for f in fixes
    ]


def test_outage_and_reacquisition():
    errors, reports, estimates = aided(lambda fixes: outage(fixes, 40, 90), 0.2)
    status = {round(e.t, 3): e.status for e in estimates}
    assert status[41.0] & Status.GNSS_FUSED
    assert status[43.0] & Status.DEAD_RECKONING
    assert status[92.0] & Status.GNSS_FUSED
    assert [r.outcome for r in reports if 90 <= r.t < 90.9] == [Outcome.WITHHELD] * 5
    assert max(e for t, e in errors.items() if t > 100) < 3.0
    assert not any(40 <= r.t < 90 for r in reports)


@pytest.mark.ci
def test_a_bad_first_fix_after_an_outage_is_not_swallowed():
    def samples(fixes):
        return [moved(f, 60.0) if 90 <= f.t < 90.6 else f for f in outage(fixes, 40, 90)]

    errors, reports, _ = aided(samples, 0.2)
    assert all(r.weight == 0 for r in reports if 90 <= r.t < 90.6)
    assert all(r.weight == 1 for r in reports if 92 <= r.t < 100)
    assert errors[91.0] < errors[90.0] + 3
    assert max(e for t, e in errors.items() if t > 100) < 3.0


@pytest.mark.ci
def test_a_filter_too_sure_of_itself_gives_in_to_consistent_gnss():
    """The filter believes in gyros and accelerometers a thousand times better than they are, and drifts off."""
    vain = dataclasses.replace(
        CONFIG,
        aids=(RECEIVER,),
        alignment_aids=(MagnetometerAid(bias_sigma=1e-8, sigma=1e-7),),
        imu=dataclasses.replace(
            CONSUMER, accel_bias_sigma=1e-4, gyro_bias_sigma=1e-6, accel_noise=1e-5, gyro_noise=1e-6,
            accel_bias_walk=0.0, gyro_bias_walk=0.0,
        ),
    )  # fmt: skip

    truth = flight(120)
    increments, fixes, _ = everything(truth, np.random.default_rng(5))
    ins = Ins(vain, field)
    ins.start(true_start(truth, sigma=(1e-4, 0.01, 0.5)))
    estimates, reports = feed(FusionHorizon(ins), increments, outage(fixes, 0.5, 90), 0.2)
    errors = {round(e.t, 3): np.hypot(*error(e, truth)[:2]) for e in estimates}
    position = [r for r in reports if r.aid == "gnss_position" and r.t >= 90]
    assert errors[90.0] > 30
    assert position[0].outcome is Outcome.WITHHELD
    assert any("covariance reset" in r.reason for r in position)
    assert all(r.weight == 0 for r in position if r.t < 93.9)
    assert max(e for t, e in errors.items() if 97 < t < 100) < 5.0


@pytest.mark.ci
def test_a_lasting_jump_is_believed_only_after_patience():
    def jumped(fixes):
        return [moved(f, 100.0) if f.t >= 60 else f for f in fixes]

    config = dataclasses.replace(CONFIG, patience_s=20.0)
    _, reports, _ = aided(jumped, 0.2, config)
    fused = [r.t for r in reports if r.t >= 60 and r.weight == 1]
    assert 79.5 < fused[0] < 81
    assert len(fused) > 150


def dragged(fixes, start, stop, acceleration):
    """Eastwards from the true position away, with the velocity that belongs to it."""

    def one(fix):
        tau = fix.t - start
        if not 0 <= tau < stop - start:
            return fix
        v_n = fix.v_n + np.array([0.0, acceleration * tau, 0.0])
        return moved(dataclasses.replace(fix, v_n=v_n), 0.0, 0.5 * acceleration * tau**2)

    return [one(fix) for fix in fixes]


@pytest.mark.ci
def test_when_a_spoofer_lets_go_the_wind_speaks_for_the_genuine_fixes():
    """Off by 90 m and 3 m/s at the end: believed after `recovery_s`, claimed as far off as it is before that."""
    truth = flight(160)
    increments, fixes, others = everything(truth, np.random.default_rng(5))
    estimates, _ = feed(FusionHorizon(Ins(CONFIG, field)), increments, dragged(fixes, 60, 120, 0.05) + others, 0.2)
    estimates = [e for e in estimates if e.t > 50]
    off = {round(e.t, 3): np.hypot(*error(e, truth)[:2]) for e in estimates}
    claimed = {round(e.t, 3): math.sqrt(e.covariance[0, 0] + e.covariance[1, 1]) for e in estimates}
    assert 80 < off[119.8] < 95
    assert max(distance for t, distance in off.items() if t > 120) < off[119.8] + 4.4 * 3
    assert max(distance for t, distance in off.items() if t > 124.6) < 5.0
    assert all(claimed[t] > off[t] / 3 for t in off if 121.2 < t < 124)


@pytest.mark.ci
@pytest.mark.parametrize("velocity", [0.0, 6.0])
def test_a_receiver_that_jumps_away_for_a_while_is_not_followed(velocity):
    """Twenty seconds 60 m off, with its own velocity or another: it says nothing that the wind would bear out."""

    def away(fix):
        if not 100 <= fix.t < 120:
            return fix
        v_n = fix.v_n + np.array([0.0, velocity, 0.0])
        return moved(dataclasses.replace(fix, v_n=v_n), 60.0, velocity * (fix.t - 100))

    truth = flight(160)
    increments, fixes, others = everything(truth, np.random.default_rng(6))
    ins = Ins(CONFIG, field)
    estimates, reports = feed(FusionHorizon(ins), increments, [away(fix) for fix in fixes] + others, 0.2)
    assert all(r.weight == 0 for r in reports if r.aid == "gnss_position" and 100 <= r.t < 120)
    assert max(np.hypot(*error(e, truth)[:2]) for e in estimates if e.t > 60) < 5.0


def shaken(aids, seconds, airspeeds_until=math.inf):
    """Truth, estimates and reports of a flight whose accelerometers are off by 6 m/s^2 from 60 to 62 s."""
    config = dataclasses.replace(CONFIG, aids=tuple(aid for aid in CONFIG.aids if aid.sensor in ("gnss", *aids)))
    truth = flight(160)
    increments, fixes, others = everything(truth, np.random.default_rng(16))
    off = (increments.t > 60) & (increments.t <= 62)
    increments.dv[off] += increments.dt[off, None] * np.array([6.0, 0.0, 0.0])
    others = [one for one in others if not isinstance(one, AirspeedSample) or one.t < airspeeds_until]
    return truth, *feed(FusionHorizon(Ins(config, field)), increments, fixes + others, seconds)


@pytest.mark.ci
@pytest.mark.parametrize(
    ("aids", "airspeeds_until"),
    [((), math.inf), (("barometer", "magnetometer"), math.inf), (("airspeed",), math.inf), (("airspeed",), 59.0)],
)
def test_after_a_shock_to_the_accelerometers_the_fixes_are_believed(aids, airspeeds_until):
    """The filter goes astray by metres a second, and the fixes that it refuses are right.

    The wind keeps still while airspeeds are refused, or there are none, and so is no witness for the filter.
    """
    truth, estimates, reports = shaken(aids, 0.2, airspeeds_until)
    fused = [r.t for r in reports if r.aid == "gnss_position" and r.t > 60 and r.weight == 1]
    assert 10 < np.diff(fused).max() < 15.5
    assert max(np.hypot(*error(e, truth)[:2]) for e in estimates if e.t > 120) < 5.0


@pytest.mark.ci
def test_after_a_shock_the_same_bits_however_it_is_cut():
    """An airspeed is used one by one, or as a step among many: the wind is a witness, or not, all the same."""
    whole, parts = (shaken(("airspeed",), seconds)[1] for seconds in (10.0, 0.5))
    by_time = {round(one.t, 3): one for one in parts}
    for one in whole:
        other = by_time[round(one.t, 3)]
        assert np.array_equal(one.covariance, other.covariance)
        assert (one.lat, one.lon, one.h) == (other.lat, other.lon, other.h)


@pytest.mark.parametrize(("off", "odds", "waits"), [(2e-4, 0.0, 15.0), (2e-4, -9.0, 30.0), (3e-3, 0.0, 30.0)])
def test_fixes_that_contradict_position_and_velocity_are_believed_sooner(off, odds, waits):
    """1.3 km away, but not where the wind speaks for the filter, nor 19 km away, where nothing felt could lead."""
    monitor = GnssMonitor(outage_s=10.0, probation_s=1.0, recovery_s=4.0, patience_s=30.0, consistency_gate=16.3)
    sigma = np.full(3, 1.0)
    for k in range(1, 400):
        fix = GnssSample(k / 5, k / 5, 0.8, 0.1, 100.0, np.zeros(3), sigma, sigma, FixType.FIX_3D, 10, 1.0, 1.0)
        inside = k <= 50  # up to 10 s
        both = not inside and monitor.led(fix.t, np.array([off * 6.37e6, 0.0]))
        if monitor.judge(fix, np.zeros(3), 0.1 * sigma, inside, odds, both) is Verdict.RECOVER:
            break
    assert fix.t == pytest.approx(10 + waits)


@pytest.mark.ci
def test_correlated_gnss_errors_do_not_make_it_sure_of_itself():
    """White 0.9 m and a Markov error of 1.2 m reported as 1.5 m: without the states it would claim half a metre."""
    truth = flight(120)
    rng = np.random.default_rng(8)
    increments, fixes, others = everything(truth, rng, sigma_p=0.9)
    wander, wandering = 1.2 * rng.normal(size=3), []
    for fix in fixes:
        off = wander / [6.37e6, 6.37e6 * math.cos(fix.lat), -1]
        wandering.append(
            dataclasses.replace(
                fix, lat=fix.lat + off[0], lon=fix.lon + off[1], h=fix.h + off[2], sigma_position_n=np.full(3, 1.5)
            )
        )
        fade = math.exp(-0.2 / 100)
        wander = fade * wander + 1.2 * math.sqrt(1 - fade**2) * rng.normal(size=3)
    told = dataclasses.replace(
        CONFIG, aids=(GnssAid(arm_b=ARM, position_error_sigma=(1.2, 1.2, 1.2)), *CONFIG.aids[1:])
    )
    estimates, reports = feed(FusionHorizon(Ins(told, field)), increments, wandering + others)
    plain, _ = feed(FusionHorizon(Ins(CONFIG, field)), increments, wandering + others)
    sigma = [math.sqrt(e[-1].covariance[0, 0]) for e in (estimates, plain)]
    assert 0.7 < sigma[0] < 1.3
    assert sigma[1] < 0.4
    assert (np.abs(error(estimates[-1], truth)[:3]) < 3.5 * np.sqrt(np.diag(estimates[-1].covariance))[:3]).all()
    nis = [r.nis / 3 for r in reports if r.aid == "gnss_position"]
    assert 0.85 < np.mean(nis) < 1.15
    value, deviation = estimates[-1].extra["gnss_position_error"]
    assert (np.abs(value - wander) < 4 * deviation).all()


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_what_axes_feel_of_each_other_is_taken_off_the_increments(sensor):
    """Dead reckoning through manoeuvres, each axis of one triad feeling 2 to 7 mrad of the others."""
    truth, share = flight(30), 1e-3 * np.array([2.0, -3.0, 4.0, -5.0, 6.0, -7.0])
    matrix = np.eye(3)
    for (axis, of), value in zip(CROSS, share, strict=True):
        matrix[axis, of] = value
    increments = exact(truth)
    field_ = {"gyro": "dtheta", "accel": "dv"}[sensor]
    increments = dataclasses.replace(increments, **{field_: getattr(increments, field_) @ matrix.T})
    off = []
    for known in (0.0, 1.0):
        told = dataclasses.replace(NOISELESS, **{f"{sensor}_misalignment": 5e-3})
        ins = Ins(InsConfig(told, (PRESSURE,)), field)
        ins.start(true_start(truth))
        ins._state.imu[ins.model.slices[f"{sensor}_cross"]] = known * share
        ins.propagate(increments)
        off.append(np.linalg.norm(error(ins.estimate(), truth)[3:6]))
    assert off[0] > 0.5
    assert off[1] < 0.02 * off[0]


def test_broken_samples_are_reported_and_not_fused():
    truth = flight(30)
    increments, fixes, others = everything(truth, np.random.default_rng(6))
    ins = Ins(CONFIG, field)
    horizon = FusionHorizon(ins)
    feed(horizon, increments, fixes + others)
    before = ins.estimate()
    t = ins.t
    broken = [
        dataclasses.replace(fixes[-1], t=t, lat=math.nan),
        dataclasses.replace(fixes[-1], t=t, v_n=np.array([math.nan, 0.0, 0.0])),
        dataclasses.replace(fixes[-1], t=t, sigma_position_n=np.zeros(3)),
        BarometerSample(t, t, math.nan),
        BarometerSample(t, t, -5.0),
        AirspeedSample(t, t, math.inf),
    ]
    sizes = {"gnss_position": 3, "gnss_velocity": 3, "barometer": 1, "airspeed": 1}
    for sample in broken:
        reports = ins.update(sample)
        assert [r.aid for r in reports] == [aid for aid in sizes if aid.startswith(sample.sensor)]
        for report in reports:
            assert report.weight == 0
            assert report.outcome is Outcome.UNSOUND
            assert report.reason
            assert report.S.shape == (sizes[report.aid], sizes[report.aid])
            assert report.innovation.shape == (sizes[report.aid],)
            assert np.isnan(report.innovation).all()
    after = ins.estimate()
    assert after.status & Status.BAD_SAMPLE
    assert ins.estimate().status == after.status  # looking at an estimate changes none
    np.testing.assert_array_equal(after.covariance, before.covariance)
    assert after.lat == before.lat


@pytest.mark.ci
def test_broken_increments_are_bridged():
    truth = flight(60)
    increments, fixes, others = everything(truth, np.random.default_rng(7))
    increments.dtheta[4000:4004] = math.nan
    increments.dv[6000] = 1e6
    estimates, _ = feed(FusionHorizon(Ins(CONFIG, field)), increments, fixes + others)
    flagged = [e.t for e in estimates if e.status & Status.BAD_SAMPLE]
    assert flagged == pytest.approx([21.0, 31.0])
    assert np.hypot(*error(estimates[-1], truth)[:2]) < 3


def test_slow_air_is_not_fused():
    ins = Ins(dataclasses.replace(CONFIG, aids=(*CONFIG.aids[:3], AirspeedAid(sideslip_sigma=1.0))), field)
    ins.start(true_start(flight(30)))
    reports = ins.update(AirspeedSample(0.0, 0.0, 2.0))
    assert [(r.aid, r.weight, r.outcome) for r in reports] == [
        ("airspeed", 0.0, Outcome.OUT_OF_RANGE),
        ("sideslip", 0.0, Outcome.OUT_OF_RANGE),
    ]
    assert [r.weight for r in ins.update(AirspeedSample(0.0, 0.0, 25.0))] == [1.0, 1.0]


def test_sideslip_observes_the_wind_across():
    truth = flight(30)
    sigma = []
    for sideslip in (None, 1.0):
        ins = Ins(dataclasses.replace(CONFIG, aids=(*CONFIG.aids[:3], AirspeedAid(sideslip_sigma=sideslip))), field)
        ins.start(true_start(truth))
        for _ in range(20):
            ins.update(AirspeedSample(0.0, 0.0, float(np.linalg.norm(truth.v_n[0]))))
        across = truth.C_nb[0][:2, 1]
        where = ins.model.slices["wind"]
        sigma.append(math.sqrt(across @ ins._state.P[0][where, where] @ across))
    assert sigma[0] > 4
    assert sigma[1] < 1


def silent_pitot(truth, until, slip):
    """Reports of a flight whose pitot tube, 10 Hz, says nothing any more from ``until`` [s] on; 1-sigma of the wind."""
    aids = RECEIVER, PRESSURE, AirspeedAid(sideslip_sigma=slip, wind_walk=0.1)
    rng = np.random.default_rng(5)
    increments, fixes, others = everything(truth, rng)
    samples = [s for s in others if not isinstance(s, AirspeedSample) or s.t < until]
    ins = Ins(InsConfig(CONSUMER, aids), field)
    ins.start(true_start(truth))
    _, reports = feed(FusionHorizon(ins), increments, [f for f in fixes if f.t < until] + samples)
    where = ins.model.slices["wind"]
    return reports, np.sqrt(ins._state.P[0].diagonal()[where])


@pytest.mark.ci
def test_a_pitot_that_falls_silent_leaves_the_constraint_of_no_sideslip():
    """As often as it was heard, from a second later on, against the filter's own velocity through the air."""
    truth = flight(60)
    reports, sigma = silent_pitot(truth, 20.0, 1.0)
    heard = [r for r in reports if r.aid == "sideslip" and r.sensor == "airspeed"]
    known = [r for r in reports if r.aid == "sideslip" and r.sensor == NO_SENSOR]
    assert max(r.t for r in reports if r.aid == "airspeed") == max(r.t for r in heard) < 20.0
    assert known[0].t == pytest.approx(21.0)
    assert np.diff([r.t for r in known]) == pytest.approx(0.1)
    assert known[-1].t == pytest.approx(60.0, abs=0.2)
    assert np.mean([r.weight for r in known]) > 0.99
    assert np.mean([r.nis for r in known]) < 2.0
    _, without = silent_pitot(truth, 20.0, None)
    assert np.all(sigma < 0.7 * without)


def test_who_stands_still_knows_nothing_of_the_air_from_the_side():
    truth = at_rest(5)
    ins = Ins(InsConfig(CONSUMER, (PRESSURE, AirspeedAid(wind_sigma=40.0))), field)
    ins.start(true_start(truth))
    increments = exact(truth)
    winds = [AirspeedSample(t, t, 20.0) for t in (0.2, 0.4)]
    _, reports = feed(FusionHorizon(ins), increments, winds + barometer(truth, np.random.default_rng(1)))
    known = [r for r in reports if r.sensor == NO_SENSOR]
    assert known[0].t > 1.4
    assert {(r.aid, r.outcome) for r in known} == {("sideslip", Outcome.OUT_OF_RANGE)}


def test_a_sample_at_another_time_is_a_mistake_of_the_caller():
    ins = Ins(CONFIG, field)
    ins.start(true_start(flight(30)))
    with pytest.raises(ValueError, match="the filter is at"):
        ins.update(BarometerSample(0.02, 0.02, 95_000.0))


def test_one_receiver_and_each_sensor_once():
    with pytest.raises(ValueError, match="several make a federation"):
        InsConfig(CONSUMER, (GnssAid("one"), GnssAid("two")))
    with pytest.raises(ValueError, match="listed twice"):
        Ins(InsConfig(CONSUMER, (BarometerAid(), BarometerAid())))


def test_aids_go_by_the_names_of_their_sensors():
    ins = Ins(
        InsConfig(CONSUMER, (GnssAid("front", position_error_sigma=(1.0, 1.0, 1.0)), BarometerAid("static"))), field
    )
    ins.start(true_start(flight(30)))
    assert {"front_position_error", "static_bias"} <= set(ins.model.slices)
    assert [r.aid for r in ins.update(BarometerSample(0.0, 0.0, 95_000.0, "static"))] == ["barometer"]
    assert not ins.accepts(BarometerSample(0.0, 0.0, 95_000.0, "other"))


@pytest.mark.ci
def test_the_reference_field_is_looked_up_rarely():
    calls = []

    def counted(*place):
        calls.append(place)
        return FIELD_N

    truth = flight(60)
    increments, fixes, others = everything(truth, np.random.default_rng(9))
    feed(FusionHorizon(Ins(CONFIG, counted)), increments, fixes + others)
    assert 1 <= len(calls) < 10


def test_a_receiver_slower_than_an_outage_is_fused():
    monitor = GnssMonitor(outage_s=10.0, probation_s=1.0, recovery_s=4.0, patience_s=30.0, consistency_gate=16.3)
    monitor.last_fused = 0.0
    verdicts = []
    sigma = np.full(3, 1.0)
    for k in range(1, 8):
        t = 20.0 * k
        fix = GnssSample(t, t, 0.8, 0.1, 100.0, np.zeros(3), sigma, sigma, FixType.FIX_3D, 10, 1.0, 1.0)
        verdicts.append(monitor.judge(fix, np.zeros(3), 0.1 * sigma, inside_gate=True))
    assert verdicts[1:] == [Verdict.FUSE] * 6


def test_an_outage_right_after_the_first_fix_is_one():
    """The receiver goes on reporting that it has no fix, so nobody takes it for a slow one."""
    monitor = GnssMonitor(outage_s=10.0, probation_s=1.0, recovery_s=4.0, patience_s=30.0, consistency_gate=16.3)
    monitor.last_fused = 0.0
    sigma = np.full(3, 1.0)

    def judged(t):
        fix = GnssSample(t, t, 0.8, 0.1, 100.0, np.zeros(3), sigma, sigma, FixType.FIX_3D, 10, 1.0, 1.0)
        return monitor.judge(fix, np.zeros(3), 0.1 * sigma, inside_gate=True)

    assert judged(0.2) is Verdict.FUSE
    for k in range(2, 200):
        monitor.heard(0.2 * k)
    assert judged(40.0) is Verdict.PROBATION


@pytest.mark.parametrize(("odds", "after"), [(5.0, 4.0), (0.0, 30.0), (-5.0, 30.0)])
def test_fixes_that_contradict_the_filter_are_believed_sooner_where_something_speaks_for_them(odds, after):
    monitor = GnssMonitor(outage_s=10.0, probation_s=1.0, recovery_s=4.0, patience_s=30.0, consistency_gate=16.3)
    monitor.last_fused = 0.0
    sigma = np.full(3, 1.0)
    believed, contradicted = None, []
    for k in range(1, 200):
        t = 0.2 * k
        fix = GnssSample(t, t, 0.8, 0.1, 100.0, np.zeros(3), sigma, sigma, FixType.FIX_3D, 10, 1.0, 1.0)
        if monitor.judge(fix, np.zeros(3), 0.1 * sigma, False, odds) is Verdict.RECOVER:
            believed = t
            break
        contradicted.append(monitor.contradicted)
    assert believed == pytest.approx(after + 0.2, abs=0.21)
    assert not any(contradicted[:4])
    assert all(contradicted[6:])


@pytest.mark.parametrize(("speed", "rate_hz"), [(25.0, 5.0), (25.0, 1.0), (3.0, 5.0), (1.0, 10.0)])
def test_a_position_that_stands_still_while_its_velocity_does_not_is_never_believed(speed, rate_hz):
    monitor = GnssMonitor(outage_s=10.0, probation_s=1.0, recovery_s=4.0, patience_s=30.0, consistency_gate=16.3)
    monitor.last_fused = 0.0
    sigma, v_n = np.full(3, 1.5), np.array([speed, 0.0, 0.0])
    for k in range(1, int(200 * rate_hz)):
        t = k / rate_hz
        fix = GnssSample(t, t, 0.8, 0.1, 100.0, v_n, sigma, 0.05 * sigma, FixType.FIX_3D, 10, 1.0, 1.0)
        assert monitor.judge(fix, v_n, 0.05 * sigma, False) in (Verdict.REJECT, Verdict.PROBATION)
        assert monitor.astray(t) or t < 20.0
    assert not monitor.astray(t + 11.0)


def test_a_position_that_was_dragged_away_is_sound_as_soon_as_it_is_let_go():
    """Ever faster, so that each fix is off the one before up to the last: a federation readmitted it 10 s late."""
    monitor = GnssMonitor(outage_s=10.0, probation_s=1.0, recovery_s=4.0, patience_s=30.0, consistency_gate=16.3)
    monitor.last_fused = 0.0
    sigma, v_n = np.full(3, 1.5), np.array([25.0, 0.0, 0.0])
    for k in range(1, 60):
        dragged = 1.5 * max(k - 10.0, 0.0) ** 2 if k < 50 else 0.0
        lat = 0.8 + (25.0 * k + dragged) / 6.37e6
        fix = GnssSample(k, k, lat, 0.1, 100.0, v_n, sigma, 0.05 * sigma, FixType.FIX_3D, 10, 1.0, 1.0)
        monitor.judge(fix, v_n, 0.05 * sigma, dragged == 0.0)
        assert monitor.astray(k) == (30 < k < 50) or k <= 30


def test_who_comes_by_a_position_that_stands_still_does_not_use_it():
    monitor = GnssMonitor(outage_s=10.0, probation_s=1.0, recovery_s=4.0, patience_s=30.0, consistency_gate=16.3)
    monitor.last_fused = 0.0
    sigma = np.full(3, 1.5)
    for k in range(1, 400):
        t = 0.2 * k
        v_n = 25.0 * np.array([np.cos(0.1 * t), np.sin(0.1 * t), 0.0])
        fix = GnssSample(t, t, 0.8, 0.1, 100.0, v_n, sigma, 0.05 * sigma, FixType.FIX_3D, 10, 1.0, 1.0)
        inside = 60.0 < t < 63.0
        assert monitor.judge(fix, v_n, 0.05 * sigma, inside) is not Verdict.FUSE


@pytest.mark.parametrize("every", [2, 5])
def test_a_receiver_that_tells_its_velocity_now_and_then_is_believed_against_the_filter(every):
    """As NMEA's do, in rows of their own; what the filter says of the velocity in between may be wrong."""
    monitor = GnssMonitor(outage_s=10.0, probation_s=1.0, recovery_s=4.0, patience_s=30.0, consistency_gate=16.3)
    monitor.last_fused = 0.0
    sigma, v_n = np.full(3, 1.5), np.array([25.0, 0.0, 0.0])
    for k in range(1, 300):
        t = 0.2 * k
        own = v_n if k % every == 0 else np.full(3, np.nan)
        used = v_n if k % every == 0 else v_n + np.array([2.0, 0.0, 0.0])
        lat = 0.8 + 25.0 * t / 6.37e6
        fix = GnssSample(t, t, lat, 0.1, 100.0, own, sigma, 0.05 * sigma, FixType.FIX_3D, 10, 1.0, 1.0)
        if monitor.judge(fix, used, 0.1 * sigma, False) is Verdict.RECOVER:
            break
    assert t == pytest.approx(30.2, abs=0.5)


@pytest.mark.parametrize("rate_hz", [1.0, 5.0])
def test_a_receiver_that_circles_late_and_noisily_is_believed_against_the_filter(rate_hz):
    """Velocities are older than positions by 0.15 s, positions drift by metres: no more than real receivers do."""
    random = np.random.default_rng(5)
    monitor = GnssMonitor(outage_s=10.0, probation_s=1.0, recovery_s=4.0, patience_s=30.0, consistency_gate=16.3)
    monitor.last_fused = 0.0
    sigma = np.full(3, 1.5)
    for k in range(1, 200):
        t = k / rate_hz
        angle, late = 0.3 * t, 0.3 * (t - 0.15)
        p_n = 80.0 * np.array([np.cos(angle), np.sin(angle), 0.0]) + random.normal(0, 0.5, 3) + 2 * np.sin(t / 20)
        v_n = 24.0 * np.array([-np.sin(late), np.cos(late), 0.0]) + random.normal(0, 0.1, 3)
        lat, lon = 0.8 + p_n[0] / 6.37e6, 0.1 + p_n[1] / (6.39e6 * np.cos(0.8))
        fix = GnssSample(t, t, lat, lon, 100.0 - p_n[2], v_n, sigma, 0.1 * sigma, FixType.FIX_3D, 10, 1.0, 1.0)
        if monitor.judge(fix, v_n, 0.1 * sigma, False) is Verdict.RECOVER:
            break
    assert t == pytest.approx(31.0, abs=1.01)


def test_the_wind_speaks_for_who_brings_it_back_to_what_it_was():
    """Against the ratio of two normal densities; nothing is said where velocities agree, or nothing is remembered."""
    memory = WindMemory(walk=0.02, gust=0.8)
    before, air, change = np.array([2.0, 5.0]), np.array([4.0, 9.0]), np.array([-2.2, -3.5])
    assert memory.odds(300.0, air, change) == 0.0
    memory.remember(100.0, before, np.array([0.09, 0.16]))
    memory.remember(105.0, air, np.zeros(2))  # too soon to be remembered
    sigma = np.sqrt(np.array([0.09, 0.16]) + 0.8**2 + 0.02**2 * 200)
    expected = norm.logpdf(air + change, before, sigma).sum() - norm.logpdf(air, before, sigma).sum()
    assert memory.odds(300.0, air, change) == pytest.approx(expected)
    assert expected > SURE
    assert memory.odds(300.0, air + change, -change) == pytest.approx(-expected)
    assert memory.odds(300.0, air, np.zeros(2)) == 0.0
    memory.remember(801.0, air, np.zeros(2))
    assert memory.odds(801.0, air, change) < 0.0  # the first is forgotten
