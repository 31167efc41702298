"""Every block of the error model against differences of the non-linear strapdown, and its noise against fine steps."""

import dataclasses

import numpy as np
import pytest

from nav import error_model
from nav.earth import position_difference_n, radii
from nav.error_model import CROSS, MOTION, PHI, POS, VEL, Block, Drive, ErrorModel, ImuModel, markov
from nav.kalman import predict
from nav.rotation import dcm_from_quat, quat_from_euler, quat_from_rotvec, quat_multiply, rotvec_from_quat
from nav.strapdown import step

FULL = ImuModel(1e-4, 1e-3, 1e-4, 0.05, 1e-6, 1e-5, 1e-5, 1e-3, 300.0, 300.0, 1e-3, 1e-3)
DT = 0.005
STEP = {"phi": 1e-4, "dv": 1.0, "dp": 1000.0, "gyro_bias": 1e-3, "accel_bias": 0.1, "gyro_drift": 1e-3,
        "accel_drift": 0.1, "gyro_scale": 1e-2, "accel_scale": 1e-2}  # fmt: skip
NO_CROSS = np.zeros((2, 3, 3))
# What the differences cannot resolve, in rows phi, dv, dp and columns phi, dv, dp and later
FLOOR = np.array([[1e-9, 1e-14, 1e-16], [1e-7, 1e-12, 1e-14], [1e-9, 1e-11, 1e-12]])


def nominal(lat_deg):
    q = quat_from_euler(0.4, -0.1, 2.1)
    return q, np.array([22.0, -17.0, 3.0]), np.array([np.radians(lat_deg), 0.2, 900.0])


def propagate(state, errors, samples, sums=None, cross=NO_CROSS):
    """Strapdown through `samples` with `errors` (4, 3) and what axes feel of each other, `cross`, taken out.

    Optionally `sums`, the integrals that `transition` needs.
    """
    q, v, lla = (part.copy() for part in state)
    for k in range(samples):
        s = k * DT
        omega = np.array([0.3 + 0.2 * np.sin(3 * s), 0.2 * np.cos(2 * s), -0.4])
        force = np.array([1.0 + np.sin(2 * s), -0.5, -9.9 + s])
        angle = (omega - errors[0]) * DT / (1 + errors[2])
        push = (force - errors[1]) * DT / (1 + errors[3])
        angle, push = angle - cross[0] @ angle, push - cross[1] @ push
        before = dcm_from_quat(q)
        step(q, v, lla, angle, push, DT)
        if sums is not None:
            middle = 0.5 * (before + dcm_from_quat(q))
            sums += np.stack([middle * DT, middle * angle, middle * push])
    return q, v, lla


def displaced(state, delta):
    """A state whose motion is wrong by `delta` (9,) of phi, dv, dp."""
    q, v, lla = state
    R_M, R_N = radii(lla[0])
    dp = delta[POS : POS + 3]
    off = np.array([dp[0] / (R_M + lla[2]), dp[1] / ((R_N + lla[2]) * np.cos(lla[0])), -dp[2]])
    return quat_multiply(quat_from_rotvec(-delta[PHI : PHI + 3]), q), v + delta[VEL : VEL + 3], lla + off


def motion_error(state, true):
    phi = -rotvec_from_quat(quat_multiply(state[0], true[0] * [1, -1, -1, -1]))
    return np.concatenate([phi, state[1] - true[1], position_difference_n(*state[2], *true[2])])


@pytest.mark.parametrize("lat_deg", [48.0, -33.0, 5.0, 80.0])
def test_transition_is_the_derivative_of_the_strapdown(lat_deg):
    model = ErrorModel(FULL)
    samples, state = 10, nominal(lat_deg)
    sums = np.zeros((3, 3, 3))
    end = propagate(state, np.zeros((4, 3)), samples, sums)
    Phi, FT = np.zeros((MOTION, model.mixing)), np.zeros((MOTION, model.mixing))
    middle = propagate(state, np.zeros((4, 3)), samples // 2)
    error_model.transition(Phi, FT, model.driven, middle[1], middle[2][0], middle[2][2], sums, samples * DT)

    expected = np.zeros_like(Phi)
    for block in model.blocks:
        for axis in range(3):
            column = model.start(block.name) + axis
            results = []
            for sign in (1, -1):
                delta, errors = np.zeros(MOTION), np.zeros((4, 3))
                if block.drive is Drive.NONE:
                    delta[column] = sign * STEP[block.name]
                else:
                    errors[block.drive, axis] = sign * STEP[block.name]
                results.append(motion_error(propagate(displaced(state, delta), errors, samples), end))
            expected[:, column] = (results[0] - results[1]) / (2 * STEP[block.name])

    grown, reference = Phi.copy(), expected.copy()
    for i in range(MOTION):
        grown[i, i] -= 1
        reference[i, i] -= 1
    # Each element against the largest of its row in its block, so that the small physics counts too. Left out: what
    # is of third order in the step (accelerometer to attitude, gyro to position), and gravity's change with latitude.
    for row in range(MOTION):
        for block in model.blocks:
            where = model.slices[block.name]
            a, b = grown[row, where], reference[row, where]
            if row < VEL and block.drive in (Drive.ACCEL, Drive.ACCEL_SCALE):
                continue
            if row >= POS and block.drive in (Drive.GYRO, Drive.GYRO_SCALE):
                continue
            second_order = row >= POS or (row >= VEL and block.drive in (Drive.GYRO, Drive.GYRO_SCALE))
            share = 0.03 if second_order else 0.01
            tolerance = share * np.abs(b).max() + FLOOR[row // 3, min(2, where.start // 3)]
            if row == VEL + 2 and block.name == "dp":
                tolerance += samples * DT * 9.8 * 0.0053 / 6.37e6
            np.testing.assert_allclose(a, b, atol=tolerance, rtol=0, err_msg=f"row {row}, {block.name}")


def test_what_axes_feel_of_each_other_drives_the_motion_as_differences_say():
    model = ErrorModel(dataclasses.replace(FULL, gyro_misalignment=1e-3, accel_misalignment=2e-3))
    samples, state, sums, step_ = 10, nominal(48.0), np.zeros((3, 3, 3)), 1e-2
    end = propagate(state, np.zeros((4, 3)), samples, sums)
    Phi, FT = np.zeros((MOTION, model.mixing)), np.zeros((MOTION, model.mixing))
    error_model.transition(Phi, FT, model.driven, end[1], end[2][0], end[2][2], sums, samples * DT)
    for name, sensor, rows in (("gyro_cross", 0, slice(PHI, PHI + 3)), ("accel_cross", 1, slice(VEL, VEL + 3))):
        for c, place in enumerate(CROSS):
            results = []
            for sign in (1, -1):
                cross = np.zeros((2, 3, 3))
                cross[sensor][place] = sign * step_
                results.append(motion_error(propagate(state, np.zeros((4, 3)), samples, cross=cross), end))
            expected = (results[0] - results[1])[rows] / (2 * step_)
            found = Phi[rows, model.start(name) + c]
            np.testing.assert_allclose(found, expected, atol=0.03 * np.abs(expected).max(), err_msg=f"{name} {place}")


def test_markov_variance_is_stationary_and_its_estimate_decays():
    model = ErrorModel(FULL, [markov("gust", 2, (1.5, 0.5), 3.0)])
    decay = np.exp(-0.05 * model.decay_rate)
    P, Phi, work = np.diag(model.sigma**2), np.eye(MOTION, model.mixing), np.zeros((MOTION, model.size))
    for _ in range(2000):
        predict(P, Phi, decay, 0.5 * 0.05 * model.density**2, work, model.size)
    for name in ("gust", "gyro_drift", "accel_drift"):
        where = model.slices[name]
        np.testing.assert_allclose(np.diag(P)[where], model.sigma[where] ** 2, rtol=2e-4)
    walk = model.slices["gyro_bias"]
    np.testing.assert_allclose(np.diag(P)[walk], model.sigma[walk] ** 2 + 100 * FULL.gyro_bias_walk**2, rtol=1e-9)


def test_noise_of_long_steps_is_that_of_short_ones():
    """The trapezoid over 50 ms against 0.5 ms steps, after two seconds from a perfect start."""

    def covariance(T):
        model = ErrorModel(FULL)
        C = dcm_from_quat(nominal(48.0)[0])
        sums = np.stack([C * T, C * 0.1 * T, C * np.array([0.5, -0.3, -9.8]) * T])
        Phi, FT = np.zeros((MOTION, model.mixing)), np.zeros((MOTION, model.mixing))
        error_model.transition(Phi, FT, model.driven, np.array([20.0, 5.0, 0.0]), 0.8, 500.0, sums, T)
        P = np.zeros((model.size, model.size))
        for _ in range(round(2 / T)):
            predict(
                P,
                Phi,
                np.exp(-T * model.decay_rate),
                0.5 * T * model.density**2,
                np.zeros((MOTION, model.size)),
                model.size,
            )
        return P

    coarse, fine = covariance(0.05), covariance(0.0005)
    scale = np.sqrt(np.outer(np.diag(fine), np.diag(fine)) + 1e-300)
    assert np.abs((coarse - fine) / scale).max() < 2e-3


def test_layout():
    imu = ImuModel(1e-4, 1e-3, 1e-4, 0.05)
    model = ErrorModel(imu, [Block("wind", 2, 8.0, 0.1), Block("barometer_bias", 1, 300.0)])
    assert (model.size, model.mixing) == (18, 15)
    assert model.slices["wind"] == slice(15, 17)
    assert (model.start("barometer_bias"), model.start("gust")) == (17, -1)
    with pytest.raises(ValueError, match="two blocks named wind"):
        ErrorModel(model.imu, [Block("wind", 2, 8.0), Block("wind", 2, 8.0)])
    with pytest.raises(ValueError, match="cannot drive"):
        ErrorModel(model.imu, [Block("wind", 3, 8.0, drive=Drive.GYRO)])
