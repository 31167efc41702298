"""The detectors of low dynamics and of turns, and acceleration from airspeed."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worlds.ahrs import DEG, DT, SPEED, TURN, imu, level_flight

from nav.motion import LowDynamics, TrueAirspeed, TurnDetector, acceleration_n
from nav.samples import ImuSamples

G = 9.8
STILL = np.zeros(3)
NORM, VECTOR = LowDynamics(), LowDynamics(test="vector")


def means(truth, increments, second):
    """Specific force in true n axes and angular rate, means over one second."""
    rows = slice(round(second / DT), round((second + 1) / DT))
    C_nb = Rotation.from_quat(truth.q_nb[1:][rows], scalar_first=True)
    return C_nb.apply(increments.dv[rows]).mean(axis=0) / DT, increments.dtheta[rows].mean(axis=0) / DT


def test_each_test_fails_alone_and_says_so():
    level = np.array([0.0, 0.0, -G])
    assert NORM.judge(level, STILL, G).low
    assert NORM.judge(level * 1.025, STILL, G).failed == ("acceleration",)
    assert NORM.judge(level * 0.975, STILL, G).failed == ("acceleration",)
    assert NORM.judge(level, np.array([0.0, 0.0, -0.6 * DEG]), G).failed == ("yaw rate",)
    assert NORM.judge(level, np.array([0.0, 0.0, 0.4 * DEG]), G).low
    assert NORM.judge(level, np.array([-2.1 * DEG, 0.0, 0.0]), G).failed == ("roll rate",)
    assert NORM.judge(level, np.array([1.9 * DEG, 0.0, 0.0]), G).low
    assert NORM.judge(level, np.array([0.0, 5 * DEG, 0.0]), G).low
    assert NORM.judge(level, STILL, G, autopilot_level=False).failed == ("autopilot",)
    assert NORM.judge(np.full(3, np.nan), np.full(3, np.nan), G).failed == ("acceleration", "yaw rate", "roll rate")


def test_the_norm_sees_the_square_of_a_horizontal_acceleration_and_the_vector_all_of_it():
    a = SPEED * 0.4 * DEG
    f_n = np.array([0.0, a, -G])
    assert NORM.judge(f_n, STILL, G).acceleration == pytest.approx(a**2 / (2 * G), rel=0.01)
    assert NORM.judge(f_n, STILL, G).low
    assert VECTOR.judge(f_n, STILL, G).acceleration == pytest.approx(a)
    assert not VECTOR.judge(f_n, STILL, G).low


@pytest.mark.parametrize(("tilt_deg", "passes"), [(1.1, True), (1.25, False), (30.0, False)])
def test_the_vector_test_takes_its_own_tilt_for_acceleration(tilt_deg, passes):
    f_n = Rotation.from_rotvec([0.0, tilt_deg * DEG, 0.0]).apply([0.0, 0.0, -G])
    assert VECTOR.judge(f_n, STILL, G).low is passes
    assert NORM.judge(f_n, STILL, G).low


@pytest.mark.ci
def test_rolling_in_is_seen_first_and_the_yaw_rate_holds_through_the_turn():
    truth = level_flight()
    increments = imu(truth, 0, gust=0.0)
    judged = {second: NORM.judge(*means(truth, increments, second), G).failed for second in np.arange(1900, 3000) / 10}
    first = {name: min(s for s, failed in judged.items() if name in failed) for name in ("roll rate", "yaw rate")}
    assert first["roll rate"] < first["yaw rate"] - 0.2
    assert first["yaw rate"] < TURN[0]
    assert all("yaw rate" in judged[second] for second in range(int(TURN[0]), int(TURN[1])))
    assert all("roll rate" not in judged[second] for second in range(int(TURN[0]) + 5, int(TURN[1]) - 5))
    assert not any(failed for second, failed in judged.items() if abs(second - 230) > 35)


def test_acceleration_of_the_air_velocity_is_what_the_body_feels():
    T, n = 1.0, 20_000
    dt = T / n
    omega_b = np.array([0.1, -0.2, 0.3])
    middle = (np.arange(n) + 0.5) * dt
    speed, speed_rate = 25 + 2 * middle, 2.0
    C_nb = Rotation.from_rotvec(middle[:, None] * omega_b)
    along = np.array([1.0, 0.0, 0.0])
    felt = C_nb.apply(np.cross(omega_b, speed[:, None] * along) + speed_rate * along).mean(axis=0)
    end = Rotation.from_rotvec(T * omega_b).apply(27 * along)
    np.testing.assert_allclose(acceleration_n(25 * along, end, T), felt, atol=1e-6)
    assert np.isnan(acceleration_n(np.full(3, np.nan), end, T)).all()


def test_true_airspeed_by_height_and_by_pressure():
    # U.S. Standard Atmosphere 1976, table I, geometric 5000 m: 54048 Pa, 0.73643 kg/m^3
    expected = 30 * math.sqrt(1.225 / 0.73643)
    by_height, by_pressure = TrueAirspeed(5000.0, 5.0), TrueAirspeed(0.0, 5.0)
    for airspeed in (by_height, by_pressure):
        airspeed.add_eas(1.0, 30.0)
    assert by_height.at(1.0) == pytest.approx(expected, rel=1e-4)
    assert by_pressure.at(1.0) == pytest.approx(30.0, rel=1e-4)
    by_pressure.add_pressure(54048.0)
    assert by_pressure.at(1.0) == pytest.approx(expected, rel=1e-4)


def test_airspeed_is_smoothed_and_grows_old():
    airspeed = TrueAirspeed(0.0, smoothing_s=5.0)
    assert math.isnan(airspeed.at(0.0))
    airspeed.add_eas(0.0, 20.0)
    for k in range(1, 26):
        airspeed.add_eas(0.2 * k, 30.0)
    assert airspeed.at(5.0) == pytest.approx(30 - 10 * math.exp(-1), rel=1e-4)
    assert airspeed.at(6.9) == airspeed.at(5.0)
    assert math.isnan(airspeed.at(7.1))
    airspeed.add_eas(8.0, 22.0)
    assert airspeed.at(8.0) == pytest.approx(22.0, rel=1e-4)
    airspeed.lose()
    assert math.isnan(airspeed.at(8.0))


def rates(degps):
    n = len(degps)
    dtheta = np.zeros((n, 3))
    dtheta[:, 2] = np.asarray(degps) * DEG * 0.01
    return ImuSamples(np.arange(1, n + 1) * 0.01, np.full(n, 0.01), dtheta, np.zeros((n, 3)))


def cut(samples, start, stop):
    return ImuSamples(samples.t[start:stop], samples.dt[start:stop], samples.dtheta[start:stop], samples.dv[start:stop])


@pytest.mark.parametrize("size", [1, 7, 50])
def test_a_turn_is_over_when_it_has_been_quiet_for_long_enough(size):
    """Quiet, half a degree per second; 3 s of turn from 3 s on; quiet again, just below the limit."""
    samples = rates([0.5] * 300 + [-30.0] * 300 + [1.9] * 400)
    detector = TurnDetector()
    assert not detector.straight(0.0)
    for start in range(0, len(samples), size):
        block = cut(samples, start, start + size)
        detector.push(block)
        t = float(block.t[-1])
        assert detector.straight(t + 1e-9) is ((t + 1e-9 >= 2.0 and t < 3.005) or t > 7.995)


def test_a_rate_that_is_not_finite_is_no_straight():
    samples = rates([0.0] * 300 + [np.nan] + [0.0] * 99)
    detector = TurnDetector()
    detector.push(samples)
    assert not detector.straight(4.0)
