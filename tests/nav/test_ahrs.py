"""The attitude filter: its linear model, exactness, the U flight of Jiang et al. 2021, and thirty minutes in JSBSim."""

import dataclasses
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worlds.ahrs import (
    DEG,
    DEGPH,
    DT,
    LAT,
    NOISELESS,
    PAPER,
    SEEDS,
    TURN,
    airspeed,
    errors,
    fly,
    imu,
    level_figures,
    level_flight,
    run,
    tilted,
)
from worlds.sections import SECTIONS

from nav.ahrs import BIAS, PHI, STATES, Ahrs, AhrsConfig, transition
from nav.ahrs.state import propagate
from nav.earth import OMEGA_IE
from nav.error_model import ImuModel
from nav.horizon import FusionHorizon
from nav.motion import LowDynamics
from nav.samples import AirspeedSample, BarometerSample, ImuSamples, MagnetometerSample, Status

FIELD_N = np.array([28e-6, -4e-6, 40e-6])
NEVER = LowDynamics(yaw_rate_limit=-1.0)
INERTIAL = replace(PAPER, motion=NEVER, compensated_motion=NEVER)
COMPENSATED = replace(PAPER, aids=("airspeed",))
SLOW_TURN = (100.0, 500.0)
WHAT_IS_JUDGED = ("acceleration", "yaw_rate", "roll_rate")


def rms(values):
    return np.sqrt(np.mean(np.square(values), axis=0))


def cut(samples, rows):
    return ImuSamples(samples.t[rows], samples.dt[rows], samples.dtheta[rows], samples.dv[rows])


def wild(seconds, seed=0):
    """Increments of a body that swings about all axes by degrees per sample second, any force."""
    rng = np.random.default_rng(seed)
    n = round(seconds / DT)
    t = DT * np.arange(1, n + 1)
    phase = rng.uniform(0, 6, 3)
    rate = 0.8 * np.sin(t[:, None] * [1.0, 1.7, 0.6] + phase)
    return ImuSamples(t, np.full(n, DT), rate * DT, rng.normal(size=(n, 3)) * DT + [0.0, 0.0, -9.8 * DT])


def attitude(increments, q_nb, bias=(0.0, 0.0, 0.0), config=INERTIAL):
    """The attitude after the increments, gyro bias ``bias`` taken off."""
    filter_ = Ahrs(config)
    filter_.start(0.0, q_nb)
    filter_._state.gyro_bias[:] = bias
    filter_.propagate(increments)
    return filter_.estimate().q_nb


def phi(q_nb_hat, q_nb):
    """C_nb_hat = (I - [phi x]) C_nb."""
    difference = Rotation.from_quat(q_nb_hat, scalar_first=True) * Rotation.from_quat(q_nb, scalar_first=True).inv()
    return -difference.as_rotvec()


# --- the linear model


def test_transition_against_finite_differences():
    increments, q_nb, h = wild(8.0), tilted([1.0, 0, 0, 0], 20.0, 70.0), 1e-5
    expected = np.zeros((3, STATES))
    for axis in range(3):
        for sign in (1.0, -1.0):
            turn = np.eye(3)[axis] * -sign * h
            moved = (Rotation.from_rotvec(turn) * Rotation.from_quat(q_nb, scalar_first=True)).as_quat(
                scalar_first=True
            )
            expected[:, PHI + axis] += sign * phi(attitude(increments, moved), attitude(increments, q_nb)) / (2 * h)
            biased = attitude(increments, q_nb, bias=np.eye(3)[axis] * sign * h)
            expected[:, BIAS + axis] += sign * phi(biased, attitude(increments, q_nb)) / (2 * h)
    turned, elapsed, forget = np.zeros((3, 3)), np.zeros(4), np.zeros(3)
    earth_n = np.array([math.cos(LAT), 0.0, -math.sin(LAT)]) * OMEGA_IE
    propagate(
        q_nb.copy(), np.zeros(3), earth_n, np.zeros((2, 3)), turned, forget, forget, elapsed,
        np.zeros((3, 3)), np.zeros((6, 6)), increments.dtheta, increments.dv, increments.dt,
    )  # fmt: skip
    np.testing.assert_allclose(elapsed, [8.0, 8.0, 1600, 0.0])
    Phi = transition(turned, earth_n, 8.0)
    np.testing.assert_allclose(Phi[:, BIAS:], expected[:, BIAS:], atol=3e-3)
    np.testing.assert_allclose(Phi[:, :BIAS], expected[:, :BIAS], atol=1e-6)
    assert np.abs(expected[:, BIAS:]).max() > 4


def level_innovation(q_nb):
    """What a second of rest shows a filter with the attitude ``q_nb`` of a level body."""
    filter_ = Ahrs(PAPER)
    filter_.start(0.0, q_nb)
    return filter_.propagate(at_rest(1.0))[0].innovation


def at_rest(seconds, q_nb=(1.0, 0.0, 0.0, 0.0)):
    """Increments of a body that lies still on the turning Earth."""
    n = round(seconds / DT)
    to_body = Rotation.from_quat(q_nb, scalar_first=True).inv()
    earth_n = np.array([math.cos(LAT), 0.0, -math.sin(LAT)]) * OMEGA_IE
    dtheta, dv = to_body.apply(earth_n) * DT, to_body.apply([0.0, 0.0, -Ahrs(PAPER)._g]) * DT
    return ImuSamples(DT * np.arange(1, n + 1), np.full(n, DT), np.tile(dtheta, (n, 1)), np.tile(dv, (n, 1)))


def small(axis, h):
    """The attitude of a level body with the error phi = ``h`` on one axis."""
    return Rotation.from_rotvec(-h * np.eye(3)[axis]).as_quat(scalar_first=True)


def test_level_jacobian_against_finite_differences():
    h = 1e-4
    H = np.column_stack([(level_innovation(small(i, h)) - level_innovation(small(i, -h))) / (2 * h) for i in range(3)])
    np.testing.assert_allclose(Ahrs(PAPER)._H_level[:, :3], H, atol=2e-3)
    assert abs(H[0, 1] - 9.79) < 0.01


def test_heading_jacobian_against_finite_differences():
    """S - R = sum (H_i sigma_i)^2 while the covariance is diagonal: each sigma in turn shows one H_i."""
    h, found = 1e-4, np.zeros(3)
    config = replace(PAPER, aids=("magnetometer",), magnetometer_sigma=0.01)
    for axis in range(3):
        z = []
        for sign in (1, -1):
            filter_ = Ahrs(config, FIELD_N)
            filter_.start(0.0, small(axis, sign * h))
            z.append(filter_.update(MagnetometerSample(0.0, 0.0, FIELD_N))[0].innovation[0])
        found[axis] = (z[0] - z[1]) / (2 * h)
        narrow = Ahrs(config, FIELD_N)
        narrow.start(0.0, np.array([1.0, 0, 0, 0]))
        narrow._state.P[:] = 0.0
        narrow._state.P[axis, axis] = 1.0
        S = narrow.update(MagnetometerSample(0.0, 0.0, FIELD_N))[0].S
        assert S[0, 0] - 0.01**2 == pytest.approx(found[axis] ** 2, rel=1e-5)
    assert found[2] == pytest.approx(-1, rel=1e-6)


def test_the_claim_of_a_heading_has_what_iron_does_straight_on_and_what_biases_do_to_the_level():
    """Azimuths of a field levelled wrongly by scipy; a turn of 3 deg/s for two minutes shows iron from all sides."""
    config = replace(PAPER, aids=("magnetometer",), heading_sigma=1e-3, iron_sigma=0.02)
    claims = []
    for bias, degps in ((0.0, 0.0), (0.2, 0.0), (0.0, 3.0)):
        filter_ = Ahrs(replace(config, imu=ImuModel(1e-9, 0.0, 0.0, bias)), FIELD_N)
        filter_.start(0.0, np.array([1.0, 0, 0, 0]))
        still = at_rest(120.0)
        still.dtheta[:, 2] += np.radians(degps) * still.dt
        filter_.propagate(still)
        claims.append(filter_.estimate().covariance[6:, 6:])
    assert claims[0][2, 2] == pytest.approx(0.02**2, rel=1e-3)
    assert claims[2][2, 2] < 0.2 * 0.02**2
    tilt = 1e-4
    turned = [Rotation.from_rotvec(-tilt * axis).apply(FIELD_N) for axis in np.eye(3)[:2]]
    off = np.array([math.atan2(one[1], one[0]) - math.atan2(FIELD_N[1], FIELD_N[0]) for one in turned]) / tilt
    lean = (0.2 / 9.79) ** 2 * np.vstack([np.eye(2), off]) @ np.vstack([np.eye(2), off]).T
    found = claims[1] - claims[0]
    np.testing.assert_allclose(found[:2, :2], lean[:2, :2], rtol=2e-3, atol=1e-9)
    np.testing.assert_allclose(found[2, :2], lean[2, :2], rtol=2e-3)


def test_covariance_without_levelling_against_the_formula():
    """sigma^2 + sigma_b^2 T^2 + gyro noise^2 T + walk^2 T^3 / 3, and the tilt of a biased accelerometer on top."""
    T, model = 100.0, ImuModel(1e-4, 0.0, 5e-5, 0.01, gyro_bias_walk=1e-5)
    filter_ = Ahrs(replace(INERTIAL, imu=model, tilt_sigma=1e-3, heading_sigma=2e-3))
    filter_.start(0.0, np.array([1.0, 0, 0, 0]))
    filter_.propagate(at_rest(T))
    estimate = filter_.estimate()
    grown = 5e-5**2 * T**2 + 1e-4**2 * T + 1e-5**2 * T**3 / 3
    floor = (0.01 / 9.8) ** 2
    expected = [1e-3**2 + grown + floor, 1e-3**2 + grown + floor, 2e-3**2 + grown]
    np.testing.assert_allclose(np.diag(estimate.covariance)[6:], expected, rtol=2e-3)
    np.testing.assert_allclose(estimate.sigma_gyro_bias, math.sqrt(5e-5**2 + 1e-5**2 * T), rtol=1e-6)


def test_what_is_still_to_be_corrected_is_part_of_the_claimed_error():
    filter_ = Ahrs(PAPER)
    filter_.start(0.0, small(0, 3 * DEG))
    filter_.propagate(at_rest(6.0))
    estimate = filter_.estimate()
    error = phi(estimate.q_nb, [1.0, 0, 0, 0])[0]
    assert error > 1 * DEG
    assert error < np.sqrt(estimate.covariance[6, 6]) < 1.5 * error


def test_nothing_is_corrected_before_the_tilt_is_known_well_enough():
    for sigma, corrections in ((1e-4, 0), (1 * DEG, 10)):
        filter_ = Ahrs(replace(PAPER, correction_sigma=sigma))
        filter_.start(0.0, small(0, 3 * DEG))
        filter_.propagate(at_rest(10.0))
        extra = filter_.estimate().extra
        assert extra["mode_counter"][0][0] == 10
        assert extra["correction_counter"][0][0] == corrections


def test_rates_are_judged_without_the_bias_that_is_known():
    increments = at_rest(5.0)
    increments.dtheta[:, 2] += 1 * DEG * DT
    for known, low in ((0.0, 0), (1 * DEG, 5)):
        filter_ = Ahrs(PAPER)
        filter_.start(0.0, np.array([1.0, 0, 0, 0]))
        filter_._state.gyro_bias[2] = known
        filter_.propagate(increments)
        assert filter_.estimate().extra["mode_counter"][0][0] == low


# --- exactness


def test_no_noise_no_error():
    """A body that turns on the spot: it has no velocity, so the model lacks nothing."""
    truth = level_flight(speed=0.0)
    config = replace(PAPER, imu=NOISELESS, motion=LowDynamics(yaw_rate_limit=1.0))
    _, error, estimates, reports = run(config, truth, imu(truth, 0, 0.0, 0.0, gust=0.0), tilt_deg=0.0)
    assert np.abs(error).max() < 1e-5
    assert len(reports) == 600
    np.testing.assert_allclose(estimates[-1].gyro_bias, 0.0, atol=1e-9)


def test_the_turn_of_an_exactly_known_air_velocity_costs_only_what_the_rotating_earth_adds():
    """Coriolis, 2 w_ie V sin(lat), is 0.004 m/s^2 at 50 m/s: the filter has no velocity to know it by."""
    truth = level_flight()
    config = replace(COMPENSATED, compensated_motion=LowDynamics(1.0, 1.0, 1.0))
    _, error, _, reports = run(config, truth, imu(truth, 0, 0.0, 0.0, gust=0.0), airspeed(), tilt_deg=0.0)
    in_turn = [report for report in reports if TURN[0] + 2 < report.t < TURN[1] - 2]
    assert len(in_turn) > 50
    # told that airspeed in a turn is worth 1 m/s times the rate
    added = in_turn[-1].S[0, 0] - reports[-1].S[0, 0]
    assert added == pytest.approx((3 * DEG) ** 2, rel=0.2)
    assert np.abs(error[:, :2]).max() < 0.12


@pytest.mark.parametrize("size", [1, 37, 5000])
def test_blocks_make_no_difference(size):
    truth = level_flight()
    increments = cut(imu(truth, 3), slice(0, 5000))
    config = replace(COMPENSATED, aids=("airspeed", "magnetometer"), gyro_bias_feedback=True)
    samples = [
        *airspeed(25.0, rate_hz=3.0),
        *(MagnetometerSample(t, t, FIELD_N) for t in np.arange(0.0, 25.0, 0.37).tolist()),
    ]

    def estimates(size):
        horizon = FusionHorizon(Ahrs(config, FIELD_N))
        found = []
        for start in range(0, 5000, size):
            block = cut(increments, slice(start, start + size))
            due = [s for s in samples if start * DT - 1e-9 <= s.t < block.t[-1] - 1e-9]
            times = [t for t in (9.5, 17.305, 24.995) if start * DT < t <= block.t[-1] + 1e-9]
            found += horizon.track(block, due, times)[1]
        return found

    for ours, whole in zip(estimates(size), estimates(2500), strict=True):
        np.testing.assert_array_equal(ours.q_nb, whole.q_nb)
        np.testing.assert_array_equal(ours.covariance, whole.covariance)
        np.testing.assert_array_equal(ours.gyro_bias, whole.gyro_bias)


@pytest.mark.parametrize("gap_s", [0.1, 0.5, 3.0])
def test_what_happens_in_a_gap_is_claimed_however_increments_are_cut(gap_s):
    """A body that swings by 0.8 rad/s: 3 s unseen turn it by up to a radian; afterwards the claim lasts."""
    increments, first = wild(20), round(5 / DT)
    lost = slice(first, first + round(gap_s / DT))
    gone = ImuSamples(increments.t, increments.dt, increments.dtheta.copy(), increments.dv)
    gone.dtheta[lost] = math.nan
    whole, parts, true = Ahrs(INERTIAL), Ahrs(INERTIAL), Ahrs(INERTIAL)
    for filter_ in (whole, parts, true):
        filter_.start(0.0, [1.0, 0.0, 0.0, 0.0])
    whole.propagate(gone)
    for start in range(0, len(gone), 77):
        parts.propagate(cut(gone, slice(start, start + 77)))
    true.propagate(increments)
    estimate, before = whole.estimate(), true.estimate()
    np.testing.assert_array_equal(estimate.q_nb, parts.estimate().q_nb)
    np.testing.assert_array_equal(estimate.covariance, parts.estimate().covariance)
    off = phi(estimate.q_nb, before.q_nb)
    widened = estimate.covariance.diagonal()[6:9] - before.covariance.diagonal()[6:9]
    assert (np.abs(off) < 4 * np.sqrt(widened)).all()
    np.testing.assert_allclose(np.sqrt(widened.sum() / 3), 0.5 * gap_s**2 / (gap_s + 0.2), rtol=0.02)


@pytest.mark.ci
@pytest.mark.parametrize("size", [77, 5000])
@pytest.mark.parametrize(("begins", "ends"), [(8.0, 18.0), (8.02, 11.98), (8.5, 12.3), (8.05, 12.02)])
def test_after_a_long_gap_the_level_is_found_anew(begins, ends, size):
    """Held on were the rates of a moment; corrected by no more than equation 10 allows, a tilt of 80 deg stayed."""
    increments = imu(level_flight(), 1)
    first, stop = round(begins / DT), round(ends / DT)
    increments.dtheta[first - 1] = np.array([0.3, -0.2, 0.1]) * increments.dt[first - 1]
    increments.dtheta[first:stop] = increments.dv[first:stop] = math.nan
    filter_, found = Ahrs(PAPER), []
    for start in range(0, len(increments), size):
        filter_.propagate(cut(increments, slice(start, start + size)))
        found.append(filter_.estimate())
    if size < 5000:
        assert any(np.isnan(one.q_nb).all() for one in found)
        assert not any(np.isnan(one.q_nb).any() for one in found if one.t > 23)
    tilt = Rotation.from_quat(found[-1].q_nb, scalar_first=True).apply([0, 0, 1])[2]
    assert math.degrees(math.acos(tilt)) < 2.0
    assert found[-1].t > 23


def test_prediction_is_the_future_and_changes_nothing():
    increments = imu(level_flight(), 1)
    filter_ = Ahrs(PAPER)
    filter_.propagate(cut(increments, slice(0, 3000)))
    before = filter_.estimate()
    predicted = filter_.predict(cut(increments, slice(3000, 3777)))
    np.testing.assert_array_equal(filter_.estimate().covariance, before.covariance)
    np.testing.assert_array_equal(filter_.estimate().q_nb, before.q_nb)
    filter_.propagate(cut(increments, slice(3000, 3777)))
    after = filter_.estimate()
    assert predicted.t == after.t
    np.testing.assert_array_equal(predicted.q_nb, after.q_nb)
    np.testing.assert_array_equal(predicted.covariance, after.covariance)


# --- the U flight: 50 m/s, half a turn at 3 deg/s, 40 deg/h, 2 mg, gusts of 0.15 m/s^2


def accepted(report_lists, start, stop):
    return [sum(r.aid == "level" and start < r.t <= stop for r in reports) for reports in report_lists]


@pytest.fixture(scope="module")
def u_flights():
    return fly(PAPER)


def test_u_flight_level(u_flights):
    largest, typical = level_figures(u_flights)
    inertial, _ = level_figures(fly(INERTIAL))
    print(f"level: max {largest:.2f}, rms {typical:.2f} deg; gyros alone max {inertial:.2f} deg")
    assert largest < 1.0
    assert typical < 0.4
    assert inertial > 2.0


def test_u_flight_heading_drifts_by_the_bias_of_the_gyro(u_flights):
    final = [error[-1, 2] for _, error, _, _ in u_flights]
    print("heading after 600 s:", np.round(final, 2))
    assert 6.0 < np.mean(final) < 7.0


def test_u_flight_takes_nothing_for_tilt_in_the_turn(u_flights):
    reports = [reports for *_, reports in u_flights]
    assert accepted(reports, TURN[0] + 1, TURN[1]) == [0] * len(SEEDS)
    assert min(accepted(reports, 0, 190)) > 150
    assert min(accepted(reports, 270, 600)) > 280


@pytest.mark.ci
def test_recovery_from_three_degrees():
    # wholly about one axis is the slowest case: the correction is limited axis by axis
    truth = level_flight()
    for seed in SEEDS:
        increments, runs = imu(truth, seed), []
        for tilt_deg in (3.0, 0.0):
            filter_ = Ahrs(PAPER)
            tilt = Rotation.from_euler("x", tilt_deg, degrees=True)
            filter_.start(0.0, (tilt * Rotation.from_quat(truth.q_nb[0], scalar_first=True)).as_quat(scalar_first=True))
            times = np.arange(1.0, 190.0)
            _, estimates = FusionHorizon(filter_).track(increments, (), times.tolist())
            rows = np.round(times / DT).astype(int)
            runs.append(errors(np.array([e.q_nb for e in estimates]), truth.q_nb[rows])[:, :2])
        largest = np.abs(runs[0]).max(axis=1)
        assert largest[0] > 2.0
        recovered = times[np.argmax(largest < 0.5)]
        print(f"seed {seed}: below 0.5 deg after {recovered:.0f} s")
        assert recovered < 60
        assert np.abs(runs[0] - runs[1])[times >= 60].max() < 0.05
    largest, typical = level_figures(fly(PAPER, tilt_deg=3.0))
    assert largest < 1.0
    assert typical < 0.4


def test_corrections_are_limited():
    truth = level_flight()
    increments = imu(truth, 0)
    attitudes = []
    for config in (PAPER, INERTIAL):
        *_, estimates, _ = run(config, truth, increments, tilt_deg=3.0)
        attitudes.append(Rotation.from_quat([e.q_nb for e in estimates], scalar_first=True))
    correction = attitudes[0] * attitudes[1].inv()
    steps = (correction[1:] * correction[:-1].inv()).as_rotvec() / DEG
    assert np.abs(steps[:, :2]).max() == pytest.approx(0.2, rel=2e-3)
    # heading is left to its gyro; what shows of it is earth rate in a frame that is tilted
    assert np.abs(steps[:, 2]).max() < 0.01


def test_the_vector_test_locks_itself_out():
    """Documented, not cured: a tilt above 1.17 deg is an acceleration to it, so it never levels."""
    runs = fly(replace(PAPER, motion=LowDynamics(test="vector")), tilt_deg=3.0)
    largest, _ = level_figures(runs)
    few = accepted([reports for *_, reports in runs], 0, 200)
    print(f"vector test from 3 deg: max {largest:.2f} deg, accepted of the first 200 s {few}")
    assert largest > 2.0
    assert np.mean(few) < 30


@pytest.mark.ci
def test_an_unnoticed_slow_turn():
    plain, _ = level_figures(fly(PAPER, turn_degps=0.4, turn=SLOW_TURN))
    runs = fly(COMPENSATED, turn_degps=0.4, turn=SLOW_TURN, samples=airspeed())
    compensated, _ = level_figures(runs)
    print(f"0.4 deg/s: max {plain:.2f} deg as it is, {compensated:.2f} deg less the acceleration of the air velocity")
    assert plain > 2.0
    assert compensated < 1.0
    assert min(accepted([reports for *_, reports in runs], *SLOW_TURN)) > 300


def test_counters():
    times, _, estimates, reports = run(PAPER, level_flight(), imu(level_flight(), 0))
    low = {round(r.t) for r in reports}
    corrected = held = 0
    for t, estimate in zip(np.round(times).astype(int), estimates, strict=True):
        mode, corrections = (int(estimate.extra[f"{name}_counter"][0][0]) for name in ("mode", "correction"))
        assert mode == held + (t in low)  # outside low dynamics it is held, and the other one cleared
        assert corrections <= mode if t in low else corrections == 0
        corrected, held = max(corrected, corrections), mode
    assert corrected > 50
    assert held == len(reports)


def test_what_low_dynamics_were_judged_by_is_told():
    """In a turn at 3 deg/s the yaw rate, as it is entered the roll rate, and of the acceleration its size beyond g."""
    times, _, estimates, _ = run(PAPER, level_flight(), imu(level_flight(), 0))
    judged = {name: np.array([e.extra[f"judged_{name}"][0][0] for e in estimates]) for name in WHAT_IS_JUDGED}
    assert np.median(judged["yaw_rate"][(times > 210) & (times < 250)]) / DEG == pytest.approx(3, abs=0.3)
    assert judged["roll_rate"][(times > 196) & (times < 204)].max() / DEG > 2
    straight = times < 190
    assert judged["yaw_rate"][straight].max() / DEG < 0.5
    assert judged["acceleration"][straight].mean() == pytest.approx(0.09, abs=0.03)


def test_the_autopilot_has_a_say():
    truth = level_flight()
    filter_ = Ahrs(PAPER)
    filter_.start(0.0, truth.q_nb[0])
    ends = (1 + np.arange(6000)) / 200.0
    turning = (ends > 5.0) & (ends < 15.0)
    filter_.flight_control(ends, ~turning)  # and nothing about what comes after 30 s
    levelled = {round(report.t) for report in filter_.propagate(cut(imu(truth, 0), slice(0, 8000)))}
    alone = Ahrs(PAPER)
    alone.start(0.0, truth.q_nb[0])
    unadvised = {round(report.t) for report in alone.propagate(cut(imu(truth, 0), slice(0, 8000)))}
    assert levelled == unadvised - {*range(6, 16)}  # periods that end at these times touch the turn
    assert len(unadvised) - len(levelled) > 7


@pytest.mark.ci
def test_the_autopilots_word_counts_whatever_the_blocks():
    truth = level_flight()
    ends = (1 + np.arange(6000)) / 200.0
    level = np.sin(ends) < 0.9
    whole, pieces = Ahrs(PAPER), Ahrs(PAPER)
    for filter_ in (whole, pieces):
        filter_.start(0.0, truth.q_nb[0])
    whole.flight_control(ends, level)
    expected = [report.t for report in whole.propagate(cut(imu(truth, 0), slice(0, 6000)))]
    found = []
    for start in range(0, 6000, 70):
        rows = slice(start, min(start + 70, 6000))
        pieces.flight_control(ends[rows], level[rows])
        found += [report.t for report in pieces.propagate(cut(imu(truth, 0), rows))]
    assert found == expected
    assert 10 < len(found) < 25


def test_bias_feedback_finds_level_biases_and_leaves_the_vertical_gyro_alone():
    truth, bias = level_flight(), 300 * DEGPH
    increments = imu(truth, 0, gyro_bias=bias)
    slow = replace(PAPER.imu, gyro_noise=0.3 * DEG / 60, gyro_bias_sigma=bias, gyro_bias_walk=0.1 * DEGPH)
    filter_ = Ahrs(replace(PAPER, imu=slow, gyro_bias_feedback=True, force_sigma=0.3))
    filter_.start(0.0, truth.q_nb[0])
    filter_.propagate(cut(increments, slice(0, 195 * 200)))
    applied = filter_._state.gyro_bias
    np.testing.assert_allclose(np.abs(applied[:2]), bias, atol=0.15 * bias)
    assert applied[2] == 0.0
    np.testing.assert_allclose(filter_.estimate().gyro_bias[:2], applied[:2], atol=0.05 * bias)
    plain = Ahrs(replace(PAPER, imu=slow, force_sigma=0.3))
    plain.start(0.0, truth.q_nb[0])
    plain.propagate(cut(increments, slice(0, 195 * 200)))
    np.testing.assert_allclose(plain.estimate().gyro_bias[:2], applied[:2], atol=0.2 * bias)
    # a bias that is taken off no longer tilts: in the turn there is nothing but the gyros
    level = []
    for feedback in (True, False):
        config = replace(PAPER, imu=slow, gyro_bias_feedback=feedback, force_sigma=0.3)
        t, error, _, _ = run(config, truth, increments)
        level.append(np.abs(error[(t > 200) & (t < 262), :2]).max())
    assert level[0] < 0.5 * level[1]


# --- starting, aids, broken samples


@pytest.mark.parametrize(("roll", "pitch", "heading"), [(3.0, -4.0, 200.0), (-40.0, 25.0, -10.0), (179.0, 0.0, 90.0)])
def test_levelling_at_rest(roll, pitch, heading):
    q_nb = Rotation.from_euler("ZYX", [heading, pitch, roll], degrees=True).as_quat(scalar_first=True)
    filter_ = Ahrs(replace(PAPER, heading=heading * DEG))
    increments = at_rest(2.0, q_nb)
    filter_.propagate(cut(increments, slice(0, 399)))
    assert filter_.estimate().status == Status.ALIGNING
    assert filter_.problem
    assert np.isnan(filter_.estimate().q_nb).all()
    filter_.propagate(cut(increments, slice(399, 400)))
    estimate = filter_.estimate()
    assert not filter_.problem
    assert np.abs(phi(estimate.q_nb, q_nb)).max() < 2e-4
    assert estimate.status == Status.ALIGNED | Status.DEAD_RECKONING | Status.ATTITUDE_ONLY
    assert all(math.isnan(x) for x in (estimate.lat, estimate.lon, estimate.h, *estimate.v_n))
    assert np.isnan(estimate.covariance[:6]).all()
    np.testing.assert_allclose(np.sqrt(np.diag(estimate.covariance)[6:]) / DEG, [5, 5, 15], rtol=1e-2)


def test_levelling_waits_while_the_body_accelerates():
    increments = at_rest(6.0)
    increments.dv[:800, 0] += 3.0 * DT
    filter_ = Ahrs(PAPER)
    filter_.propagate(cut(increments, slice(0, 1000)))
    assert not filter_.aligned
    filter_.propagate(cut(increments, slice(1000, 1200)))
    assert np.abs(errors(filter_.estimate().q_nb[None], np.array([[1.0, 0, 0, 0]]))).max() < 0.01


def test_levelling_in_a_steady_turn_with_airspeed():
    truth = level_flight(3.0, (-1000.0, 1000.0))
    _, estimates = FusionHorizon(Ahrs(replace(COMPENSATED, heading=0.3))).track(
        imu(truth, 0, 0.0, 0.0, gust=0.0), airspeed(6.0), [5.0]
    )
    assert np.abs(errors(estimates[0].q_nb[None], truth.q_nb[[1000]])[0, :2]).max() < 0.2


def magnetometer(truth, rate_hz=5.0):
    for k in range(0, len(truth.t), round(200 / rate_hz)):
        field_b = Rotation.from_quat(truth.q_nb[k], scalar_first=True).inv().apply(FIELD_N)
        yield MagnetometerSample(float(truth.t[k]), float(truth.t[k]), field_b)


def test_magnetometer_finds_and_holds_the_heading():
    truth = level_flight()
    horizon = FusionHorizon(Ahrs(replace(PAPER, aids=("magnetometer",)), FIELD_N))
    times = np.arange(5.0, 600.0, 1.0)
    reports, estimates = horizon.track(imu(truth, 1), list(magnetometer(truth)), times.tolist())
    error = errors(np.array([e.q_nb for e in estimates]), truth.q_nb[np.round(times / DT).astype(int)])
    assert np.abs(error[0]).max() < 3.0
    assert np.abs(error[times > 60, 2]).max() < 2.5
    assert np.abs(error[(times > 60) & (times < 195), :2]).max() < 1.0
    assert {r.aid for r in reports} == {"level", "magnetic_heading"}


def test_slow_or_silent_airspeed_is_no_airspeed():
    truth = level_flight(0.4, SLOW_TURN)
    fallen = [dataclasses.replace(s, eas=3.0) for s in airspeed()[601:]]
    for samples, at_once in ((airspeed(120.0), False), (airspeed(120.0) + fallen, True)):
        *_, reports = run(COMPENSATED, truth, imu(truth, 0, gust=0.0), samples)
        with_airspeed, without = (
            np.hypot(*np.mean([r.innovation for r in reports if start < r.t <= start + 3], axis=0))
            for start in (116.0, 122.0)
        )
        assert with_airspeed < 0.1
        assert bool(np.hypot(*next(r.innovation for r in reports if r.t > 120.5)) > 0.2) is at_once
        assert without > 0.2


def test_broken_samples_are_refused_and_told_of():
    filter_ = Ahrs(replace(PAPER, aids=("airspeed", "barometer")))
    increments = at_rest(10.0)
    increments.dtheta[1000] = np.nan
    increments.dv[1001:1041, 2] = 1e9
    filter_.propagate(cut(increments, slice(0, 1100)))
    assert Status.BAD_SAMPLE in filter_.estimate().status
    assert np.abs(phi(filter_.estimate().q_nb, [1.0, 0, 0, 0])).max() < 1e-3
    levelled = filter_.propagate(cut(increments, slice(1100, 2000)))
    assert Status.BAD_SAMPLE not in filter_.estimate().status
    reports = filter_.update(AirspeedSample(10.0, 10.0, math.nan))
    assert [r.aid for r in levelled] == ["level"] * 5
    assert [(r.aid, r.weight) for r in reports] == [("airspeed", 0.0)]
    assert "finite" in reports[0].reason
    assert Status.BAD_SAMPLE in filter_.estimate().status
    # U.S. Standard Atmosphere 1976: 54048 Pa is 5000 m, and 0.73643 kg/m^3
    assert filter_.update(AirspeedSample(10.0, 10.0, 20.0)) == []
    assert filter_.update(BarometerSample(10.0, 10.0, 54048.0)) == []
    assert filter_._airspeed.at(10.0) == pytest.approx(20 * math.sqrt(1.225 / 0.73643), rel=1e-4)
    with pytest.raises(ValueError, match="filter is at 10"):
        filter_.update(AirspeedSample(9.0, 9.0, 20.0))


def test_only_aids_are_heard():
    filter_ = Ahrs(PAPER)
    sample = AirspeedSample(0.0, 0.0, 20.0)
    assert not filter_.listening
    assert not filter_.accepts(sample)
    assert filter_.update(sample) == []
    without_field = Ahrs(replace(PAPER, aids=("magnetometer",)))
    assert not without_field.listening
    with pytest.raises(ValueError, match="gnss"):
        replace(PAPER, aids=("gnss",))


# --- the loiter aircraft


START = {"lat_deg": 34.0, "lon_deg": 108.0, "alt_m": 300.0, "heading_deg": 30.0, "airspeed_mps": 25.0}
LEGS_AND_LOITERS = [
    {"leg": "straight", "length_m": 3000},
    {"leg": "loiter", "radius_m": 400, "duration_s": 600},
    {"leg": "straight", "length_m": 5000},
    {"leg": "loiter", "radius_m": 200, "duration_s": 300, "direction": "left"},
    {"leg": "straight", "length_m": 5000},
    {"leg": "loiter", "radius_m": 400, "duration_s": 2000},
]
NOTHING_BUT_LOITER = [{"leg": "straight", "length_m": 500}, {"leg": "loiter", "radius_m": 400, "duration_s": 2000}]


SENSORS = {"imu": {"grade": "mems-consumer"}, "airspeed": {"rate_hz": 5.0}, "barometer": {"rate_hz": 5.0}}


@pytest.mark.slow
@pytest.mark.parametrize("plan", [LEGS_AND_LOITERS, NOTHING_BUT_LOITER], ids=["legs and loiters", "loiter"])
def test_half_an_hour_without_gnss(plan):
    from pydantic import TypeAdapter

    from testbed import sensors
    from testbed.estimators.datasheet import imu_model
    from testbed.motion.flight import Flight
    from testbed.motion.legs import Leg
    from testbed.motion.sections import FlightTruth

    seconds = 1800.0
    wind = {"from_deg": 250.0, "speed_mps": 5.0, "turbulence": "light"}
    config = FlightTruth(source="flight", rate_hz=200.0, start=START, wind=wind)
    truth = Flight(config, TypeAdapter(list[Leg]).validate_python(plan), 1).advance(round(seconds * 200) + 1)
    times = np.arange(60.0, seconds, 0.5)
    for seed in (1, 2, 3):
        sense = {}
        for kind, keys in SENSORS.items():
            section = SECTIONS[kind].model_validate(keys, strict=True)
            sense[kind] = section, sensors.build(kind, section, 200.0, seed, None).sense(truth)
        model = imu_model(sense["imu"][0].errors())
        told = AhrsConfig(model, LAT, 300.0, ("airspeed", "barometer"), heading=30 * DEG, force_sigma=0.3)
        _, estimates = FusionHorizon(Ahrs(told)).track(
            sense["imu"][1], [*sense["airspeed"][1], *sense["barometer"][1]], times.tolist()
        )
        error = errors(np.array([e.q_nb for e in estimates]), truth.q_nb[np.round(times * 200).astype(int)])[:, :2]
        sigma = np.sqrt([np.diag(e.covariance)[6:8].mean() for e in estimates]) / DEG
        print(f"roll, pitch: max {np.abs(error).max(axis=0)}, rms {rms(error)}, claimed {sigma.mean():.2f} deg")
        assert np.abs(error).max() < 1.5
        assert rms(error).max() < 0.5
        assert 0.4 < rms(error).mean() / sigma.mean() < 2.0
