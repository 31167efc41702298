"""The initial state from sensors: at rest, in a turn, with and without magnetometer, and how sure it says it is."""

import math
from dataclasses import replace

import numpy as np
import pymap3d
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from worlds.ins import CONSUMER, DEG, FIELD_N, Flight, at_rest, barometer, error, feed, flight, gnss, imu, magnetometer
from worlds.motion import RATE_HZ

from nav.aids import GnssAid, MagnetometerAid
from nav.alignment import AidSigmas, Alignment
from nav.error_model import CROSS, ImuModel
from nav.horizon import FusionHorizon
from nav.ins import Ins, InsConfig
from nav.samples import FixType, GnssSample, ImuSamples, Status
from testbed.motion.table import increments

COMPASS, NOTHING = MagnetometerAid(), np.zeros((3, 3))
NAVIGATION = ImuModel(0.002 * DEG / 60, 1e-4, 0.003 * DEG / 3600, 3e-4)


def driven(duration_s):
    """From rest to 16 m/s in four seconds, over a hill, and U-turns of ten seconds."""
    t = np.arange(duration_s * RATE_HZ + 1) / RATE_HZ
    speed = 4.0 * np.minimum(t, 4.0)
    heading = -0.3 + np.cumsum(np.where((t > 24) & (t % 30 > 20), math.pi / 10, 0.0)) / RATE_HZ
    pitch = math.radians(10.0) * np.clip((t - 4.0) / 4.0, 0.0, 1.0) * np.clip((12.0 - t) / 4.0, 0.0, 1.0)
    level = np.cos(pitch)
    v_n = speed[:, None] * np.column_stack([level * np.cos(heading), level * np.sin(heading), -np.sin(pitch)])
    moved = np.concatenate([[np.zeros(3)], np.cumsum((v_n[1:] + v_n[:-1]) / (2 * RATE_HZ), axis=0)])
    lat, lon, h = pymap3d.ned2geodetic(*moved.T, 48 * DEG, 11 * DEG, 400.0, deg=False)
    q_nb = Rotation.from_euler("ZY", np.column_stack([heading, pitch])).as_quat(scalar_first=True)
    rows = t, lat, lon, h, v_n, q_nb
    return Flight(*rows, *increments(*rows))


def align(
    truth, model, rng, with_field=True, arm_b=(0.0, 0.0, 0.0), seconds=60.0, sigma_v=0.1,
    sigma_p=1.5, compass=COMPASS, triad=NOTHING, iron=NOTHING, **config
):  # fmt: skip
    """The first estimate after alignment, the Ins, and the true sensor biases then.

    Specific force is wrong by ``triad`` (3, 3) times itself, the magnetic field by ``iron`` (3, 3) times itself.
    """
    increments_, _, accel_bias = imu(truth, model, rng)
    increments_ = replace(increments_, dv=increments_.dv @ (np.eye(3) + triad).T)
    settings = InsConfig(model, (GnssAid(arm_b=arm_b), compass), **config)
    hard_iron = compass.bias_sigma * rng.normal(size=3)
    samples = gnss(truth, rng, 4.0, arm_b=arm_b, sigma_v=sigma_v, sigma_p=sigma_p)
    if with_field:
        fields = magnetometer(truth, rng, hard_iron)
        samples += [replace(one, field_b=one.field_b + iron @ (one.field_b - hard_iron)) for one in fields]
    ins = Ins(settings, (lambda *_: FIELD_N) if with_field else None)
    horizon = FusionHorizon(ins)
    for k in range(int(seconds / 0.25)):
        rows = slice(50 * k, 50 * k + 50)
        block = ImuSamples(increments_.t[rows], increments_.dt[rows], increments_.dtheta[rows], increments_.dv[rows])
        horizon.push(block, [s for s in samples if 0.25 * k - 1e-6 <= s.t < 0.25 * (k + 1) - 1e-6])
        estimate = horizon.estimate_at(float(block.t[-1]))
        if ins.aligned:
            return ins, estimate, accel_bias[rows.stop - 1]
        assert estimate.status & Status.ALIGNING
        assert np.isnan(estimate.lat)
        assert np.isnan(estimate.covariance).all()
        assert ins.problem
    return ins, None, None


def test_in_flight_with_magnetometer():
    truth = flight(30)
    ins, estimate, _ = align(truth, CONSUMER, np.random.default_rng(1), arm_b=(0.5, 0.0, -0.2))
    assert ins.problem == ""
    assert 2.0 <= estimate.t <= 2.6
    wrong, sigma = error(estimate, truth), np.sqrt(np.diag(estimate.covariance))
    assert (np.abs(wrong) < 3.5 * sigma).all()
    assert (sigma[6:8] < 0.8 * DEG).all()
    assert sigma[8] < 4 * DEG


@pytest.mark.slow
@pytest.mark.parametrize("arm_b", [(0.0, 0.0, 0.0), (0.5, 0.1, -0.3)])
def test_sigmas_are_honest_over_many_alignments(arm_b):
    """Two-sided 99 % bounds of the mean NEES, and the tilt must go with the accelerometer bias that caused it."""
    truth, runs = flight(30), 150
    nees, joint = np.zeros(3), 0.0
    for seed in range(runs):
        ins, estimate, accel_bias = align(truth, CONSUMER, np.random.default_rng(seed), arm_b=arm_b)
        wrong = error(estimate, truth)
        for i in range(3):
            block = slice(3 * i, 3 * i + 3)
            nees[i] += wrong[block] @ np.linalg.solve(estimate.covariance[block, block], wrong[block]) / runs
        state = ins._state
        where = np.r_[0:3, ins.model.slices["accel_bias"]]
        both = np.r_[wrong[6:9], estimate.accel_bias - accel_bias]
        joint += both @ np.linalg.solve(state.P[0][np.ix_(where, where)], both) / runs
    low, high = chi2.ppf([0.005, 0.995], 3 * runs) / runs
    print("position, velocity, attitude", nees, "bounds", low, high, "attitude with accelerometer bias", joint)
    assert ((low < nees) & (nees < high)).all()
    low, high = chi2.ppf([0.005, 0.995], 6 * runs) / runs
    assert low < joint < high


@pytest.mark.slow
def test_of_an_antenna_on_a_long_arm_the_place_goes_with_the_attitude():
    """A receiver of centimetres: two-sided 99 % bounds of the mean NEES of place, velocity and attitude together.

    Taken for independent of the heading, the place proved it, and the heading was several sigma off.
    """
    truth, runs, nees = flight(30), 150, 0.0
    for seed in range(runs):
        rng = np.random.default_rng(4000 + seed)
        _, estimate, _ = align(truth, CONSUMER, rng, arm_b=(1.5, 0.2, -0.3), sigma_p=0.01, sigma_v=0.03)
        wrong = error(estimate, truth)
        nees += wrong @ np.linalg.solve(estimate.covariance, wrong) / runs
    low, high = chi2.ppf([0.005, 0.995], 9 * runs) / runs
    print("nine components", nees, "bounds", low, high)
    assert low < nees < high


@pytest.mark.ci
def test_what_an_alignment_made_of_them_goes_with_triad_and_soft_iron():
    """Two-sided 99 % bounds of the NEES of the attitude, and of it together with the errors that caused it.

    Independent of them, a tilt levelled on a turned triad would soon tell that the triad is not turned.
    """
    model = replace(CONSUMER, accel_scale_sigma=2e-3, accel_misalignment=4e-3, accel_nonorthogonality=2e-3)
    compass = MagnetometerAid(soft_iron_sigma=0.02)
    truth, runs, found = flight(30), 120, np.zeros(2)
    for seed in range(runs):
        rng = np.random.default_rng(2000 + seed)
        m, lean = 4e-3 * rng.normal(size=3), 2e-3 * rng.normal(size=3)
        turn = -np.array([[0.0, -m[2], m[1]], [m[2], 0.0, -m[0]], [-m[1], m[0], 0.0]])
        leaning = np.array([[0.0, 0.0, 0.0], [lean[0], 0.0, 0.0], [lean[1], lean[2], 0.0]])
        scale, iron = 2e-3 * rng.normal(size=3), 0.02 * rng.normal(size=(3, 3))
        triad = turn + leaning + np.diag(scale)
        ins, estimate, accel_bias = align(truth, model, rng, compass=compass, triad=triad, iron=iron)
        slices = ins.model.slices
        causes = ("accel_bias", "accel_scale", "accel_cross", "magnetometer_soft_iron")
        where = np.r_[0:3, *(slices[name] for name in causes)]
        crossing = [triad[axis] for axis in CROSS]
        x = ins._state.x[0].copy()
        x[: len(ins._state.imu)] = ins._state.imu
        wrong = np.r_[error(estimate, truth)[6:9], x[where[3:]] - np.r_[accel_bias, scale, crossing, iron.ravel()]]
        for i, n in enumerate((3, len(where))):
            P = ins._state.P[0][np.ix_(where[:n], where[:n])]
            found[i] += wrong[:n] @ np.linalg.solve(P, wrong[:n]) / (n * runs)
    for nees, n in zip(found, (3, len(where)), strict=True):
        low, high = chi2.ppf([0.005, 0.995], n * runs) / (n * runs)
        print(nees, "bounds", low, high)
        assert low < nees < high


def test_course_in_flight_without_magnetometer():
    truth = flight(30)
    _, estimate, _ = align(truth, CONSUMER, np.random.default_rng(2), with_field=False)
    wrong, sigma = error(estimate, truth), np.sqrt(np.diag(estimate.covariance))
    assert 10 * DEG < sigma[8] < 40 * DEG
    assert abs(wrong[8]) < 2 * sigma[8]
    assert (np.abs(wrong[6:8]) < 3.5 * sigma[6:8]).all()


@pytest.mark.ci
@pytest.mark.parametrize("seed", range(8))
def test_a_vehicle_that_sets_off_is_not_aligned_by_a_course_that_may_be_anything(seed):
    """At 8 m/s wind may turn the heading by a radian, and what accelerates by 4 m/s^2 is tilted by 20 deg with it: one
    of these was 8 m off for a minute, one of another simulator 2 km. It waits until it is faster."""
    truth, rng = driven(90), np.random.default_rng(5000 + seed)
    model = replace(CONSUMER, gyro_bias_sigma=0.2 * DEG, accel_bias_sigma=0.16)
    increments_, *_ = imu(truth, CONSUMER, rng)
    increments_.dv[:] += 0.16 / RATE_HZ
    increments_.dtheta[:] += 0.2 * DEG / RATE_HZ
    settings = InsConfig(model, (GnssAid(),))
    times = [*range(1, 90)]
    _, found = FusionHorizon(Ins(settings, None)).track(
        increments_, gnss(truth, rng, 5.0, sigma_p=5.0, sigma_v=0.05), times
    )
    aligned = [one for one in found if not one.status & Status.ALIGNING]
    assert 3 <= aligned[0].t <= 5
    sigma = math.sqrt(aligned[0].covariance[8, 8])
    assert abs(error(aligned[0], truth)[8]) < 2 * sigma < 80 * DEG
    late = np.array([error(one, truth) for one in aligned if one.t > 30])
    assert np.hypot(*late[:, :2].T).max() < 3
    assert np.abs(late[:, 6:8]).max() < 0.5 * DEG
    assert np.abs(late[:, 8]).max() < 3 * DEG


def test_at_rest_with_magnetometer():
    truth = at_rest(10)
    _, estimate, _ = align(truth, CONSUMER, np.random.default_rng(3), sigma_v=0.03)
    wrong, sigma = error(estimate, truth), np.sqrt(np.diag(estimate.covariance))
    assert (np.abs(wrong) < 3.5 * sigma).all()
    assert sigma[6] < 0.3 * DEG


def test_at_rest_consumer_gyros_cannot_find_north():
    rng = np.random.default_rng(4)
    ins, estimate, _ = align(at_rest(10), CONSUMER, rng, with_field=False, seconds=10, sigma_v=0.03)
    assert estimate is None
    assert "gyrocompassing would leave" in ins.problem


def test_gyrocompassing_with_navigation_grade_gyros():
    truth = at_rest(10)
    _, estimate, _ = align(truth, NAVIGATION, np.random.default_rng(5), with_field=False, seconds=10, sigma_v=0.03)
    wrong, sigma = error(estimate, truth), np.sqrt(np.diag(estimate.covariance))
    assert sigma[8] < 10 * DEG
    assert abs(wrong[8]) < 3.5 * sigma[8]


def test_accelerometers_that_contradict_gnss_are_not_believed():
    truth = flight(30)
    broken = flight(30).dv * 1.3
    increments_ = ImuSamples(truth.t[1:], np.full(len(truth.t) - 1, 0.005), truth.dtheta[1:], broken[1:])
    ins = Ins(InsConfig(CONSUMER), lambda *_: FIELD_N)
    rng = np.random.default_rng(6)
    feed(FusionHorizon(ins), increments_, gnss(truth, rng, 4.0) + magnetometer(truth, rng))
    assert not ins.aligned
    assert "disagree" in ins.problem


def test_no_gnss_no_alignment():
    truth = flight(30)
    rng = np.random.default_rng(7)
    ins = Ins(InsConfig(CONSUMER), lambda *_: FIELD_N)
    increments_, *_ = imu(truth, CONSUMER, rng)
    estimates, reports = feed(FusionHorizon(ins), increments_, barometer(truth, rng) + magnetometer(truth, rng))
    assert reports == []
    assert ins.problem == "waiting for GNSS"
    assert all(math.isnan(e.h) for e in estimates)


@pytest.mark.parametrize("broken", [np.nan, np.inf, 1e4])
def test_a_broken_increment_starts_the_alignment_again(broken):
    imu = ImuModel(1e-4, 1e-3, 1e-4, 0.02)
    aids = AidSigmas(field=1e-7, field_bias=0.0, gnss_position=np.zeros(3), gnss_velocity=np.zeros(3), wind=5.0)
    alignment = Alignment(imu, aids, np.zeros(3), 2.0)
    field_n = np.array([2e-5, 0.0, 4e-5])
    initial = None
    for k in range(60):  # upright, facing north, at rest, 10 Hz; one increment is broken
        t = 0.1 * (k + 1)
        increments = ImuSamples(np.array([t]), np.array([0.1]), np.zeros((1, 3)), np.array([[0.0, 0.0, -0.981]]))
        if k == 12:
            increments.dv[0, 1] = broken
        alignment.propagate(increments)
        alignment.add_field(field_n)
        sigma = np.full(3, 0.1)
        fix = GnssSample(t, t, 0.8, 0.1, 100.0, np.zeros(3), sigma, sigma, FixType.FIX_3D, 10, 1.0, 1.0)
        initial = initial or alignment.add_gnss(fix, field_n)
    assert initial is not None
    assert initial.t > 1.3 + 2.0 - 1e-6
    np.testing.assert_allclose(initial.q_nb, [1, 0, 0, 0], atol=0.01)


def test_a_receiver_without_velocity_aligns_slower_and_claims_less():
    truth, rng = flight(40), np.random.default_rng(5)
    increments_, *_ = imu(truth, CONSUMER, rng)
    nothing = np.full(3, np.nan)
    samples = [replace(fix, v_n=nothing, sigma_velocity_n=nothing) for fix in gnss(truth, rng, 4.0)]
    samples += magnetometer(truth, rng)
    ins = Ins(InsConfig(CONSUMER, (GnssAid(), MagnetometerAid())), lambda *_: FIELD_N)
    estimates, _ = feed(FusionHorizon(ins), increments_, samples)
    first = next(e for e in estimates if math.isfinite(e.h))
    assert 10.0 < first.t < 20.0
    wrong, sigma = error(first, truth), np.sqrt(np.diag(first.covariance))
    assert (np.abs(wrong) < 3.5 * sigma).all()
    assert 0.5 < sigma[3] < 5.0
    assert np.linalg.norm(error(estimates[-1], truth)[:3]) < 5.0
    assert ins.problem == ""


@pytest.mark.parametrize("says", [0.02, 0.5, 0.95, 1.0, 3.0])
def test_a_receiver_that_claims_less_than_its_slow_errors_begins_with_a_covariance(says):
    """As receivers of today do: by what they say of position and velocity, over what slow errors are told to be."""
    truth, rng = flight(30), np.random.default_rng(3)
    increments_, _, _ = imu(truth, CONSUMER, rng)
    slow_p, slow_v = np.array([1.0, 1.0, 2.4]), np.full(3, 0.1)
    aid = GnssAid(position_error_sigma=tuple(slow_p), velocity_error_sigma=tuple(slow_v))
    ins = Ins(InsConfig(CONSUMER, (aid, COMPASS)), lambda *_: FIELD_N)
    horizon = FusionHorizon(ins)
    samples = [
        replace(one, sigma_position_n=says * slow_p, sigma_velocity_n=says * slow_v)
        for one in gnss(truth, rng, 4.0, sigma_v=0.02)
    ]
    samples += magnetometer(truth, rng, np.zeros(3))
    reports = []
    for k in range(60):
        rows = slice(50 * k, 50 * k + 50)
        block = ImuSamples(increments_.t[rows], increments_.dt[rows], increments_.dtheta[rows], increments_.dv[rows])
        reports += horizon.push(block, [s for s in samples if 0.25 * k - 1e-6 <= s.t < 0.25 * (k + 1) - 1e-6])
        if ins.aligned:
            P = ins._state.P[0]
            sigma = np.sqrt(np.diag(P))
            known = sigma > 0
            correlation = P[np.ix_(known, known)] / np.outer(sigma[known], sigma[known])
            assert np.linalg.eigvalsh(correlation)[0] > -1e-9
    assert len(reports) > 50
    assert np.isfinite([one.nis for one in reports]).all()
