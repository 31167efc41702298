"""The attitude filter that levels in any motion, on a body in a hand: exact motion, by scipy's rotations."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worlds.ahrs import airspeed, errors, imu, level_flight
from worlds.ahrs import run as fly

from nav.ahrs import Ahrs, AhrsConfig
from nav.earth import earth_rate_n, gravity
from nav.error_model import ImuModel
from nav.horizon import FusionHorizon
from nav.samples import AirspeedSample, ImuSamples, MagnetometerSample, Outcome, Status

DEG = math.pi / 180
LAT, DT = 0.9, 0.01
G = float(gravity(LAT, 0.0))
FIELD_N = np.array([19e-6, 1e-6, 45e-6])
PART = ImuModel(gyro_noise=0.02 * DEG, accel_noise=3e-3, gyro_bias_sigma=0.5 * DEG, accel_bias_sigma=0.0)
CONFIG = AhrsConfig(PART, LAT, aids=("magnetometer",), magnetometer_sigma=2 * DEG * math.sqrt(2 * 10 / (4 * DT)))
TOLD = CONFIG.in_any_motion()
BLIND = replace(TOLD, aids=())


@dataclass(frozen=True)
class Motion:
    """Attitudes at the edges of the increments, and these."""

    attitude: Rotation
    imu: ImuSamples

    @property
    def q_nb(self):
        return self.attitude.as_quat(scalar_first=True)


def made(t, attitude, acceleration_n, bias=(0.0, 0.0, 0.0)):
    """Increments of a body with these attitudes at ``t`` (N + 1,) and mean accelerations (N, 3) between, NED."""
    turns = (attitude[:-1].inv() * attitude[1:]).as_rotvec()
    half_way = attitude[:-1] * Rotation.from_rotvec(turns / 2)
    dt = np.diff(t)
    earth = half_way.inv().apply(earth_rate_n(LAT)) * dt[:, None]
    force = half_way.inv().apply(acceleration_n - [0.0, 0.0, G])
    return Motion(attitude, ImuSamples(t[1:], dt, turns + earth + np.array(bias) * dt[:, None], force * dt[:, None]))


def in_hand(seconds, rest_s=0.0, size_m=0.1, bias=(0.0, 0.0, 0.0)):
    """Swung by tens of degrees and by a decimetre about once a second, after ``rest_s`` of rest."""
    t = np.arange(round(seconds / DT) + 1) * DT
    moving = np.clip((t - rest_s) / 2, 0, 1)[:, None]
    angles = 40 * DEG * np.sin(t[:, None] * [1.9, 2.3, 1.1] + [0.3, 1.0, 2.0]) * moving
    attitude = Rotation.from_euler("ZYX", angles + np.array([0.7, 0.1, -0.2]))
    place = size_m * np.sin(t[:, None] * [5.1, 6.3, 7.2] + [0.2, 1.4, 2.5]) * moving
    velocity = np.gradient(place, DT, axis=0)
    return made(t, attitude, np.diff(velocity, axis=0) / DT, bias)


def fields(motion, field_n=lambda t: FIELD_N):
    t = motion.imu.t[::4]
    seen = motion.attitude[1::4].inv().apply([field_n(now) for now in t.tolist()])
    return [MagnetometerSample(now, now, b) for now, b in zip(t.tolist(), seen, strict=True)]


def track(motion, told=TOLD, samples=(), every=100):
    """Times, phi (N, 3) [rad], covariances (N, 3, 3) of attitude, estimates and reports."""
    rows = np.arange(round(3 / DT), len(motion.imu.t), every)
    times = motion.imu.t[rows]
    reports, found = FusionHorizon(Ahrs(told, FIELD_N)).track(motion.imu, samples, times.tolist())
    turned = Rotation.from_quat([one.q_nb for one in found], scalar_first=True) * motion.attitude[rows + 1].inv()
    return times, -turned.as_rotvec(), np.array([one.covariance[6:, 6:] for one in found]), found, reports


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.fixture(scope="module")
def swung():
    return in_hand(60.0)


def test_levels_a_body_that_never_is_at_rest(swung):
    """Accelerations of 4 m/s^2 average out: the first levelling is degrees off, what stays is less than one."""
    t, phi, covariance, _, reports = track(swung, samples=fields(swung))
    assert np.abs(phi[0, :2]).max() > 1 * DEG
    assert np.abs(phi[t > 30]).max() < 1.2 * DEG
    assert np.abs(phi[t > 30, :2]).max() < 0.6 * DEG
    assert np.all(np.abs(phi) < 4 * np.sqrt(covariance.diagonal(axis1=1, axis2=2)))
    assert {report.aid for report in reports} == {"level", "magnetic_heading"}


def test_a_heading_is_followed_and_does_not_tilt(swung):
    """A field turned by 30 deg, of the same size and dip, turns the estimate: no gate tells it. The horizon stays, but
    for what the gyros' bias about the vertical, believed to have changed, makes of it as the body turns over."""
    turned = Rotation.from_rotvec([0, 0, 30 * DEG]).apply(FIELD_N)
    _, right, *_ = track(swung, samples=fields(swung))
    _, wrong, *_ = track(swung, samples=fields(swung, lambda t: FIELD_N if t < 20 else turned))
    assert abs(wrong[-1, 2]) > 10 * DEG
    tilt = np.hypot(*right.T[:2]), np.hypot(*wrong.T[:2])
    assert np.abs(tilt[0] - tilt[1]).max() < 1.2 * DEG


def test_a_disturbed_field_is_left_out_and_in_time_believed():
    motion = in_hand(70.0)
    other = Rotation.from_rotvec([0, 0, 20 * DEG]).apply(FIELD_N) * 1.3
    t, phi, _, _, reports = track(motion, samples=fields(motion, lambda t: FIELD_N if t < 20 else other))
    outcomes = {report.t: report.outcome for report in reports if report.aid == "magnetic_heading"}
    refused = [now for now, outcome in outcomes.items() if outcome == Outcome.OUTSIDE_GATE]
    assert min(now for now in refused if now > 4) == pytest.approx(20.2, abs=0.3)
    assert 39 < max(refused) < 41  # `AnyMotion.field_patience_s`
    assert np.abs(phi[(t > 15) & (t < 38), 2]).max() < 2 * DEG
    assert abs(phi[-1, 2]) > 3 * DEG


def test_no_field_is_no_heading():
    motion = in_hand(10.0)
    _, phi, _, found, reports = track(
        motion, samples=fields(motion, lambda t: FIELD_N if t < 5 else np.array([0.0, 0.0, 45e-6]))
    )
    assert np.isfinite(phi).all()
    assert np.isfinite(found[-1].covariance[6:, 6:]).all()
    assert [r.outcome for r in reports if r.aid == "magnetic_heading"][-1] == Outcome.OUTSIDE_GATE


def test_rest_shows_the_biases_of_all_gyros():
    bias = np.array([0.6, -0.4, 0.5]) * DEG
    _, _, _, found, _ = track(in_hand(12.0, rest_s=1e3, bias=bias), BLIND)
    np.testing.assert_allclose(found[-1].gyro_bias, bias, atol=0.02 * DEG)
    assert np.all(found[-1].sigma_gyro_bias < 0.05 * DEG)


def test_motion_shows_the_biases_too():
    bias = np.array([0.6, -0.4, 0.5]) * DEG
    motion = in_hand(60.0, bias=bias)
    t, phi, _, found, _ = track(motion, samples=fields(motion))
    np.testing.assert_allclose(found[-1].gyro_bias, bias, atol=0.25 * DEG)
    assert np.abs(phi[t > 30, :2]).max() < 1 * DEG


def test_a_steady_turn_is_no_rest():
    """Of 2 deg/s in calm air, where nothing varies: with a part whose biases are a twentieth of that."""
    part = replace(PART, gyro_bias_sigma=0.1 * DEG)
    t = np.arange(3001) * DT
    turning = made(t, Rotation.from_rotvec(np.outer(t, [0, 0, 2 * DEG])), np.zeros((3000, 3)))
    _, phi, _, found, _ = track(turning, replace(BLIND, imu=part))
    assert abs(found[-1].gyro_bias[2]) < 0.02 * DEG
    assert abs(phi[-1, 2] - phi[0, 2]) < 1 * DEG


def test_first_levelling_in_motion_claims_what_it_errs():
    """In a turn that nobody tells it of, specific force shows no tilt at all."""
    truth = level_flight(6.0, (-10.0, 100.0), duration_s=10.0, speed=15.0)
    filter_ = Ahrs(BLIND)
    increments = imu(truth, 1)
    _, (first,) = FusionHorizon(filter_).track(increments, (), [2.05])
    error = errors(first.q_nb[None], truth.q_nb[[410]])[0]
    claimed = np.degrees(np.sqrt(first.covariance[6:8, 6:8].diagonal()))
    assert abs(error[0]) > 5
    assert abs(error[0]) < 2.5 * claimed.max()


@pytest.mark.ci
def test_turned_on_the_spot_it_is_levelled():
    """100 deg/s in a hand is no turn at speed, the specific force is no larger than gravity: what gyros lose on the
    way, 3 deg in 100 s, is found by it."""
    t = np.arange(12001) * DT
    motion = made(t, Rotation.from_rotvec(np.outer(t, [0.0, 0.0, 100 * DEG])), np.zeros((12000, 3)))
    motion.imu.dtheta[:] += 0.3 * DEG * math.sqrt(DT) * np.random.default_rng(1).normal(size=(12000, 3))
    _, phi, covariance, *_ = track(motion, BLIND)
    assert rms(phi[:, :2]) < 0.3 * DEG
    assert np.all(np.abs(phi[:, :2]) < 4 * np.sqrt(covariance.diagonal(axis1=1, axis2=2)[:, :2]))


def test_a_turn_at_speed_does_not_lean_it():
    """12 deg/s at 15 m/s, leaning by 18 deg as specific force does: half a minute of it is not taken for level."""
    rate, speed, t = 12 * DEG, 15.0, np.arange(4001) * DT
    heading = rate * np.maximum(t - 10.0, 0.0)
    lean = np.where(t > 10.0, math.atan(rate * speed / G), 0.0)
    velocity = speed * np.column_stack([np.cos(heading), np.sin(heading), 0.0 * t])
    attitude = Rotation.from_euler("ZYX", np.column_stack([heading, 0.0 * t, lean]))
    motion = made(t, attitude, np.diff(velocity, axis=0) / DT)
    _, phi, covariance, *_ = track(motion, BLIND)
    assert np.abs(phi[:, :2]).max() < 3 * DEG
    assert np.all(np.abs(phi[:, :2]) < 4 * np.sqrt(covariance.diagonal(axis1=1, axis2=2)[:, :2]))


@pytest.mark.ci
def test_airspeed_levels_in_a_turn():
    """100 s of turns at 3 deg/s and 50 m/s: 15 deg of bank, of which airspeed leaves less than one."""
    truth = level_flight(3.0, (50.0, 550.0))
    told = replace(BLIND, aids=("airspeed",))
    _, error, _, _ = fly(told, truth, imu(truth, 1), airspeed(), tilt_deg=3.0)
    assert np.abs(error[100:, :2]).max() < 1.0


@pytest.mark.parametrize("size", [1, 7, 64])
def test_blocks_make_no_difference(swung, size):
    whole, parts = Ahrs(BLIND), Ahrs(BLIND)
    rows = slice(0, 1500)
    given = [getattr(swung.imu, key)[rows] for key in ("t", "dt", "dtheta", "dv")]
    whole.propagate(ImuSamples(*given))
    for start in range(0, 1500, size):
        parts.propagate(ImuSamples(*(one[start : start + size] for one in given)))
    np.testing.assert_array_equal(parts.estimate().q_nb, whole.estimate().q_nb)
    np.testing.assert_array_equal(parts.estimate().covariance, whole.estimate().covariance)


def test_prediction_is_the_future_and_changes_nothing(swung):
    cut = [ImuSamples(*(getattr(swung.imu, key)[rows] for key in ("t", "dt", "dtheta", "dv"))) for rows in (
        slice(0, 800), slice(800, 1200))]  # fmt: skip
    filter_ = Ahrs(BLIND)
    filter_.propagate(cut[0])
    before, ahead = filter_.estimate(), filter_.predict(cut[1])
    np.testing.assert_array_equal(filter_.estimate().q_nb, before.q_nb)
    filter_.propagate(cut[1])
    np.testing.assert_array_equal(filter_.estimate().q_nb, ahead.q_nb)
    np.testing.assert_array_equal(filter_.estimate().covariance, ahead.covariance)


@pytest.mark.ci
def test_it_errs_as_it_claims_where_velocities_are_as_it_thinks():
    """Velocities that are Gauss-Markov, noise of the data sheet: NEES of tilt per degree of freedom, eight draws."""
    found = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        t = np.arange(6001) * DT
        velocity = np.zeros((6001, 3))
        for k in range(6000):
            velocity[k + 1] = velocity[k] * math.exp(-DT / 4) + 0.5 * math.sqrt(2 * DT / 4) * rng.normal(size=3)
        attitude = Rotation.from_euler("ZYX", 0.5 * np.sin(t[:, None] * [0.3, 0.5, 0.4] + rng.uniform(0, 6, 3)))
        motion = made(t, attitude, np.diff(velocity, axis=0) / DT, 0.3 * DEG * rng.normal(size=3))
        motion.imu.dtheta[:] += PART.gyro_noise * math.sqrt(DT) * rng.normal(size=(6000, 3))
        at, phi, covariance, *_ = track(motion, BLIND)
        phi, covariance = phi[at > 20, :2], covariance[at > 20, :2, :2]
        found.append(np.einsum("ni,nij,nj->n", phi, np.linalg.inv(covariance), phi).mean() / 2)
    print(np.round(found, 2))
    assert 0.3 < np.mean(found) < 1.5


@pytest.mark.ci
def test_a_part_whose_gyros_are_off_in_motion_is_taken_for_what_it_is():
    """Scale and alignment of 2 %, each unit its own, told or not: NEES of tilt per degree of freedom, and the error."""
    found = {0.0: [], 0.02: []}
    for seed in range(8):
        motion = in_hand(60.0)
        motion.imu.dtheta[:] += 0.02 * motion.imu.dtheta @ np.random.default_rng(seed).normal(size=(3, 3))
        for told, rows in found.items():
            at, phi, covariance, *_ = track(motion, replace(BLIND, imu=replace(PART, gyro_motion=told)))
            phi, covariance = phi[at > 20, :2], covariance[at > 20, :2, :2]
            rows.append((np.einsum("ni,nij,nj->n", phi, np.linalg.inv(covariance), phi).mean() / 2, rms(phi)))
    untold, told = (np.mean(rows, axis=0) for rows in found.values())
    print(untold, told)
    assert told[0] < 1.5 < 0.5 * untold[0]
    assert told[1] < untold[1]


@pytest.mark.parametrize("gap_s", [0.4, 3.0, 40.0])
def test_after_a_gap_it_is_right_in_five_seconds(gap_s):
    """A short gap widens what is claimed; in a long one the tilt is lost, and found anew by what is felt after it."""
    motion = in_hand(30 + gap_s + 20)
    lost = (motion.imu.t > 30) & (motion.imu.t <= 30 + gap_s)
    for values in (motion.imu.dtheta, motion.imu.dv):
        values[lost] = math.nan
    samples = [one for one in fields(motion) if not 30 < one.t <= 30 + gap_s]
    told = []
    for cut in (1, 100):
        horizon, found = FusionHorizon(Ahrs(TOLD, FIELD_N)), []
        for k in range(0, len(motion.imu.t), 100 * cut):  # and the same bits, however it is cut
            rows = slice(k, min(k + 100 * cut, len(motion.imu.t)))
            part = ImuSamples(
                *(values[rows] for values in (motion.imu.t, motion.imu.dt, motion.imu.dtheta, motion.imu.dv))
            )
            arrived = [one for one in samples if part.t[0] - 1e-6 < one.t <= part.t[-1] + 1e-6]
            wanted = [t for t in part.t[99::100].tolist()]
            found += list(horizon.track(part, arrived, wanted)[1])
        told.append(found)
    for one, other in zip(*told, strict=True):
        assert np.array_equal(one.q_nb, other.q_nb, equal_nan=True)
        assert np.array_equal(one.covariance, other.covariance, equal_nan=True)
    known = [one for one in told[0] if one.t > 30 + gap_s + 5]
    assert len(known) > 5
    for one in known:
        k = round(one.t / DT)
        off = (Rotation.from_quat(one.q_nb, scalar_first=True) * motion.attitude[k].inv()).as_rotvec()
        assert np.hypot(*off[:2]) < 5 * DEG
        assert np.abs(off[2]) < 20 * DEG
    aligning = [one.t for one in told[0] if Status.ALIGNING in one.status and one.t > 5]
    assert bool(aligning) == (gap_s > 1.0)


def circling(straight_s, seconds, bias=(0.0, 0.0, 0.0), speed=25.0, radius=400.0):
    """A wing that banks into a circle [m/s, m] within three seconds, and stays in it."""
    t = np.arange(round((straight_s + seconds) / DT) + 1) * DT
    rate = speed / radius * np.clip((t - straight_s + 3.0) / 3.0, 0.0, 1.0)
    heading = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * DT)]) + 0.5
    bank = np.arctan(speed * rate / G)
    attitude = Rotation.from_euler("ZYX", np.column_stack([heading, np.full(len(t), 0.05), bank]))
    velocity = speed * np.column_stack([np.cos(heading), np.sin(heading), np.zeros(len(t))])
    return made(t, attitude, np.diff(velocity, axis=0) / DT, bias)


FINE = replace(
    BLIND, imu=ImuModel(gyro_noise=5e-3 * DEG, accel_noise=2e-3, gyro_bias_sigma=40 / 3600 * DEG, accel_bias_sigma=0.0)
)


@pytest.mark.ci
@pytest.mark.parametrize(("straight_s", "worst_deg"), [(60.0, 1.0), (0.0, 2.5)])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_circle_that_never_ends_does_not_tilt_the_horizon(straight_s, worst_deg, sign):
    """Nothing tells the speed of a wing without a pitot tube: what its circle accelerates is taken for no tilt, and not
    for biases of the gyros; begun in the circle, the first levelling is off by the whole bank, and is found so."""
    motion = circling(straight_s, 400.0, bias=np.array([40, -30, 35]) * sign / 3600 * DEG)
    t, phi, covariance, found, _ = track(motion, FINE)
    late = t > straight_s + 60
    assert np.abs(phi[late, :2]).max() < worst_deg * DEG
    assert np.all(np.abs(phi[late]) < 3.5 * np.sqrt(covariance.diagonal(axis1=1, axis2=2)[late]))
    assert np.abs(found[-1].gyro_bias).max() < 120 / 3600 * DEG


def test_airspeed_tells_the_circle_better():
    """What turns with the body is left to airspeed where there is one."""
    motion = circling(60.0, 200.0)
    told = replace(FINE, aids=("airspeed",), airspeed_sigma=0.3)
    samples = [AirspeedSample(now, now, 25.0) for now in motion.imu.t[::20].tolist()]
    t, phi, _, _, _ = track(motion, told, samples)
    assert np.abs(phi[t > 30, :2]).max() < 0.4 * DEG


@pytest.mark.ci
@pytest.mark.parametrize("compass", [True, False])
@pytest.mark.parametrize("speed", [20.0, 40.0])
def test_a_heading_that_is_corrected_turns_what_is_known_along_it(speed, compass):
    """Begun at 45 deg of bank the field is levelled askew, and the heading found by and by: the velocity that turns
    with the body pointed elsewhere then, 2 deg of tilt with a compass at 20 m/s, and at 40 m/s 4."""
    motion = circling(0.0, 240.0, speed=speed, radius=speed**2 / G)
    told = replace(TOLD if compass else BLIND, imu=replace(FINE.imu, gyro_bias_sigma=0.2 * DEG, accel_bias_sigma=0.05))
    t, phi, covariance, *_ = track(motion, told, fields(motion) if compass else ())
    late, claimed = t > 30, covariance.diagonal(axis1=1, axis2=2)[:, :2]
    assert rms(phi[late, :2]) < 1.0 * DEG
    assert np.mean(phi[late, :2] ** 2 / claimed[late]) < 1.5


def test_over_a_gap_in_a_circle_its_velocity_turns_on():
    """As the attitude does; left as it was it is 23 deg astray after a second, and tilts the horizon by as much as it
    says of the circle."""
    motion = circling(0.0, 140.0, speed=20.0, radius=50.0)
    gap = (motion.imu.t > 100.0) & (motion.imu.t < 101.0)
    motion.imu.dtheta[gap] = motion.imu.dv[gap] = np.nan
    t, phi, *_ = track(motion, FINE)
    assert np.abs(phi[(t > 101.5) & (t < 121), :2]).max() < 4 * DEG
