"""The inertial unit, one error at a time against what it should do."""

import numpy as np
import pytest
from scipy import signal, stats
from scipy.spatial.transform import Rotation
from worlds.sensor_truth import RATE_HZ, lively, still

from testbed.errors import UserError
from testbed.motion.table import TruthBlock
from testbed.sensors.imu import GRADES, Imu, ImuConfig

G = 9.80665
DEG = np.pi / 180


def perfect(**keys):
    return ImuConfig(grade="perfect", **keys)


def sense(config, truth, rate_hz=RATE_HZ, seed=1):
    return Imu("imu", config, rate_hz, seed).sense(truth)


def constant(n, rate_hz, omega=(0.0, 0.0, 0.0), force=(0.0, 0.0, 0.0)):
    truth = still(n, rate_hz)
    truth.omega_b[:] = omega
    truth.dtheta[1:] = np.array(omega) / rate_hz
    truth.dv[1:] = np.array(force) / rate_hz
    return truth


def test_perfect_unit_is_truth_bit_for_bit():
    truth = lively(1000)
    imu = sense(perfect(), truth)
    np.testing.assert_array_equal(imu.t, truth.t[1:])
    np.testing.assert_array_equal(imu.dtheta, truth.dtheta[1:])
    np.testing.assert_array_equal(imu.dv, truth.dv[1:])
    np.testing.assert_array_equal(imu.dt, np.full(999, 1 / RATE_HZ))


@pytest.mark.parametrize("every", [2, 4, 10])
def test_slower_unit_sums_increments(every):
    truth = lively(1001)
    imu = sense(perfect(rate_hz=RATE_HZ / every), truth)
    np.testing.assert_array_equal(imu.t, truth.t[every::every])
    np.testing.assert_allclose(imu.dtheta, truth.dtheta[1:].reshape(-1, every, 3).sum(axis=1), rtol=1e-14)
    np.testing.assert_allclose(imu.dv, truth.dv[1:].reshape(-1, every, 3).sum(axis=1), rtol=1e-14)
    np.testing.assert_array_equal(imu.dt, np.full(len(imu), every / RATE_HZ))


@pytest.mark.parametrize("rate_hz", [150.0, 60.1, 400.0])
def test_rate_must_divide_the_tick(rate_hz):
    with pytest.raises(UserError, match=r"sensors\.imu\.rate_hz.*does not divide"):
        Imu("imu", perfect(rate_hz=rate_hz), RATE_HZ, 1)


def rotating(n, rate_hz):
    """Attitude, rate and increments of a body that tumbles about a centre of gravity at rest in inertial space."""
    t = np.arange(n) / rate_hz

    def attitude(t):
        return Rotation.from_euler("zyx", np.stack([2 * np.sin(t), 0.6 * np.cos(1.3 * t), t**2 / 4], axis=-1))

    eps = 1e-6
    omega = (attitude(t - eps).inv() * attitude(t + eps)).as_rotvec() / (2 * eps)
    q = attitude(t)
    dtheta = np.zeros((n, 3))
    dtheta[1:] = (q[:-1].inv() * q[1:]).as_rotvec()
    return q, omega, dtheta


def test_lever_arm_on_a_tumbling_body():
    n, rate_hz, arm = 400, 50.0, np.array([0.4, -0.2, 0.3])
    q, omega, dtheta = rotating(n, rate_hz)
    truth = still(n, rate_hz)
    truth.omega_b[:], truth.dtheta[:] = omega, dtheta
    imu = sense(perfect(lever_arm_m=tuple(arm), rate_hz=rate_hz), truth, rate_hz)
    # Independently: inertial velocity of the point, its change seen from the body at the start of each interval, as the
    # integral of a specific force that is constant in rotating axes: change = (integral of exp(s phi) ds) dv.
    velocity_i = q.apply(np.cross(omega, arm))
    nodes, weights = np.polynomial.legendre.leggauss(12)
    for k in range(1, n):
        turning = sum(
            w / 2 * Rotation.from_rotvec((1 + x) / 2 * dtheta[k]).as_matrix()
            for x, w in zip(nodes, weights, strict=True)
        )
        expected = np.linalg.solve(turning, q[k - 1].inv().apply(velocity_i[k] - velocity_i[k - 1]))
        np.testing.assert_allclose(imu.dv[k - 1], expected, atol=1e-9)
    np.testing.assert_array_equal(imu.dtheta, dtheta[1:])


def test_lever_arm_in_a_steady_spin_is_centripetal():
    spin, r = 3.0, 0.5
    truth = constant(50, RATE_HZ, omega=(0, 0, spin))
    imu = sense(perfect(lever_arm_m=(r, 0, 0)), truth)
    np.testing.assert_allclose(imu.dv * RATE_HZ, np.tile([-(spin**2) * r, 0, 0], (49, 1)), rtol=1e-12, atol=1e-15)


def test_mounting_turns_both_triads():
    truth = lively(200)
    roll, pitch, heading = 20.0, -30.0, 130.0
    imu = sense(perfect(mounting_deg=(roll, pitch, heading)), truth)
    from_unit_to_body = Rotation.from_euler("ZYX", [heading, pitch, roll], degrees=True)
    np.testing.assert_allclose(imu.dtheta, from_unit_to_body.inv().apply(truth.dtheta[1:]), atol=1e-16)
    np.testing.assert_allclose(imu.dv, from_unit_to_body.inv().apply(truth.dv[1:]), atol=1e-15)
    C_sb = perfect(mounting_deg=(roll, pitch, heading)).errors().C_sb
    np.testing.assert_allclose(C_sb, from_unit_to_body.inv().as_matrix(), atol=1e-15)


def test_saturation():
    truth = constant(10, RATE_HZ, omega=(5.0, -5.0, 0.1), force=(-200.0, 1.0, 200.0))
    imu = sense(perfect(gyro_range_degps=125.0, accel_range_g=8.0), truth)
    np.testing.assert_allclose(imu.dtheta * RATE_HZ, np.tile([125 * DEG, -125 * DEG, 0.1], (9, 1)), rtol=1e-12)
    np.testing.assert_allclose(imu.dv * RATE_HZ, np.tile([-8 * G, 1.0, 8 * G], (9, 1)), rtol=1e-12)


def test_resolution():
    truth = lively(2000)
    imu = sense(perfect(gyro_resolution_degps=0.5, accel_resolution_mg=20.0), truth)
    for value, exact, step in [
        (imu.dtheta, truth.dtheta[1:], 0.5 * DEG / RATE_HZ),
        (imu.dv, truth.dv[1:], 0.02 * G / RATE_HZ),
    ]:
        counts = value / step
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
        assert np.abs(value - exact).max() <= step / 2 * (1 + 1e-9)
        assert len(np.unique(np.rint(counts))) > 10


@pytest.mark.parametrize("frequency_hz", [2.0, 20.0, 60.0])
def test_bandwidth_is_a_second_order_butterworth(frequency_hz):
    rate_hz, bandwidth_hz, n = 1000.0, 20.0, 4000
    truth = still(n, rate_hz)
    phase = 2 * np.pi * frequency_hz * truth.t
    # exact increments of a sine on the gyro's x and the accelerometer's z
    increments = np.diff(-np.cos(phase), prepend=-1.0) / (2 * np.pi * frequency_hz)
    truth.dtheta[:, 0] = increments
    truth.dv[:, 2] = increments
    imu = sense(
        perfect(rate_hz=rate_hz, gyro_bandwidth_hz=bandwidth_hz, accel_bandwidth_hz=bandwidth_hz), truth, rate_hz
    )
    b, a = signal.butter(2, 2 * np.pi * bandwidth_hz, analog=True)
    _, (response,) = signal.freqs(b, a, [2 * np.pi * frequency_hz])
    settled = slice(1000, None)
    middle = imu.t[settled] - 0.5 / rate_hz
    basis = np.exp(2j * np.pi * frequency_hz * middle)
    for out, into in [
        (imu.dtheta[settled, 0], truth.dtheta[1:, 0][settled]),
        (imu.dv[settled, 2], truth.dv[1:, 2][settled]),
    ]:
        measured = (out * basis.conj()).mean() / (into * basis.conj()).mean()
        # what a piecewise constant input adds is second order in frequency over tick rate
        assert abs(measured - response) < 0.02 * abs(response)


def test_bandwidth_keeps_the_total():
    truth = constant(2000, RATE_HZ, omega=(0.5, 0, 0))
    truth.dtheta[1:1000] = 0.0
    imu = sense(perfect(gyro_bandwidth_hz=30.0), truth)
    lag = (truth.dtheta.sum(axis=0) - imu.dtheta.sum(axis=0))[0] / 0.5
    assert lag == pytest.approx(np.sqrt(2) / (2 * np.pi * 30.0), rel=1e-6)  # group delay of the filter at rest


@pytest.mark.parametrize("harmonic", [1, 2])
def test_vibration_has_tones_at_multiples_of_the_engine_speed(harmonic):
    rate_hz, rpm = 2000.0, 3000.0
    truth = still(8001, rate_hz)
    truth.engine_rpm[:] = rpm
    imu = sense(perfect(rate_hz=rate_hz, vibration_mg=100.0, vibration_degps=2.0), truth, rate_hz)
    tone = np.exp(-2j * np.pi * harmonic * rpm / 60 * imu.t)
    expected = (rpm / 6000) ** 2 * (1.0 if harmonic == 1 else 0.5) * np.sinc(harmonic * rpm / 60 / rate_hz)
    for increments, size in [(imu.dtheta, 2 * DEG), (imu.dv, 0.1 * G)]:
        amplitude = 2 * np.abs((increments * rate_hz * tone[:, None]).mean(axis=0))
        np.testing.assert_allclose(amplitude, expected * size, rtol=1e-6)
        rms = (increments * rate_hz).std(axis=0)
        assert np.all(rms < size * (rpm / 6000) ** 2)


def test_engine_off_no_vibration():
    imu = sense(perfect(vibration_mg=100.0, vibration_degps=2.0), still(100))
    assert not imu.dv.any()
    assert not imu.dtheta.any()


def test_temperature_slope_follows_the_air_and_self_heating():
    truth = still(2001, 10.0)
    truth.temperature[:] = 300.0 - 0.02 * truth.t
    config = perfect(
        rate_hz=10.0,
        gyro_temperature_degphpk=60.0,
        accel_temperature_mgpk=1.0,
        self_heating_k=8.0,
        self_heating_tau_s=50.0,
    )
    imu = sense(config, truth, 10.0)
    warming = -0.02 * imu.t + 8.0 * (1 - np.exp(-imu.t / 50.0))
    rate, force = imu.dtheta * 10.0, imu.dv * 10.0
    np.testing.assert_allclose(rate, np.outer(warming, rate[-1] / warming[-1]), atol=1e-15)
    np.testing.assert_allclose(force, np.outer(warming, force[-1] / warming[-1]), atol=1e-13)


def test_scale_factor_asymmetry():
    up = sense(perfect(gyro_scale_asymmetry_ppm=1e4), constant(3, RATE_HZ, omega=(1.0, 1.0, 1.0)))
    down = sense(perfect(gyro_scale_asymmetry_ppm=1e4), constant(3, RATE_HZ, omega=(-1.0, -1.0, -1.0)))
    excess = up.dtheta[0] * RATE_HZ - 1
    assert np.all(np.abs(excess) > 1e-5)
    np.testing.assert_allclose(down.dtheta[0] * RATE_HZ + 1, excess, rtol=1e-9)


def test_the_scales_of_both_directions_differ_by_the_asymmetry():
    """IEEE Std 528: the difference of the scale factors, of either sign, as a fraction; 1 sigma over 1200 axes."""
    differences = []
    for seed in range(200):
        up, down = (
            sense(
                perfect(gyro_scale_asymmetry_ppm=1e4, accel_scale_asymmetry_ppm=1e4),
                constant(3, RATE_HZ, omega=(sign,) * 3, force=(sign,) * 3),
                seed=seed,
            )
            for sign in (1.0, -1.0)
        )
        differences += [(up.dtheta[0] + down.dtheta[0]) * RATE_HZ, (up.dv[0] + down.dv[0]) * RATE_HZ]
    assert np.std(differences) == pytest.approx(1e-2, rel=0.08)


def test_g_sensitivity_is_linear_in_specific_force():
    config = perfect(gyro_g_sensitivity_degphpg=100.0)
    one = sense(config, constant(2, RATE_HZ, force=(0, 0, -G))).dtheta
    two = sense(config, constant(2, RATE_HZ, force=(0, 0, -2 * G))).dtheta
    assert np.all(one != 0)
    np.testing.assert_allclose(two, 2 * one, rtol=1e-12)


def test_bias_is_what_was_added_but_white_noise():
    truth = still(400)
    config = ImuConfig(
        grade="mems-consumer", angle_random_walk_degprth=0, velocity_random_walk_mpsprth=0, gyro_resolution_degps=0,
        accel_resolution_mg=0,
    )  # fmt: skip
    imu = Imu("imu", config, RATE_HZ, 3)
    samples = imu.sense(truth)
    gyro, accel = imu.bias
    np.testing.assert_allclose(samples.dtheta[-1] * RATE_HZ, gyro, rtol=1e-12)
    np.testing.assert_allclose(samples.dv[-1] * RATE_HZ, accel, rtol=1e-12)


# --- a thousand runs

RUNS = 1000


def over_runs(config, truth):
    """(gyro, accel) averages over the first interval of a thousand runs, each (RUNS, 3)."""
    samples = [sense(config, truth, seed=s) for s in range(RUNS)]
    return np.array([s.dtheta[0] for s in samples]) * RATE_HZ, np.array([s.dv[0] for s in samples]) * RATE_HZ


def assert_spread(values, sigma):
    """Standard deviation within 5 % (1000 x 3 or more values know it to 1.3 %), zero mean, normal."""
    values = np.asarray(values).ravel()
    assert values.std() == pytest.approx(sigma, rel=0.05)
    assert abs(values.mean()) < 3.5 * sigma / np.sqrt(len(values))
    assert stats.kstest(values / sigma, "norm").pvalue > 1e-3
    # no leak from run to run: the last runs are as bad as the first
    early, late = values[: len(values) // 4], values[-len(values) // 4 :]
    assert early.std() == pytest.approx(late.std(), rel=0.15)


@pytest.mark.ci
@pytest.mark.parametrize(
    "grade",
    [
        "mems-consumer",
        *(pytest.param(g, marks=pytest.mark.slow) for g in GRADES if g not in ("perfect", "mems-consumer")),
    ],
)
def test_thousand_runs_spread_turn_on_biases_as_the_grade_says(grade):
    preset = GRADES[grade]
    config = perfect(gyro_turn_on_degph=preset["gyro_turn_on_degph"], accel_turn_on_mg=preset["accel_turn_on_mg"])
    gyro, accel = over_runs(config, still(2))
    assert_spread(gyro, preset["gyro_turn_on_degph"] * DEG / 3600)
    assert_spread(accel, preset["accel_turn_on_mg"] * 1e-3 * G)


def test_exact_turn_on_biases_differ_in_sign_alone():
    config = perfect(turn_on="exact", gyro_turn_on_degph=40.0, accel_turn_on_mg=2.0)
    seeds = [sense(config, still(2), seed=seed) for seed in range(20)]
    for values, size in (([s.dtheta[0] for s in seeds], 40 * DEG / 3600), ([s.dv[0] for s in seeds], 2e-3 * G)):
        biases = np.array(values) * RATE_HZ
        np.testing.assert_allclose(np.abs(biases), size, rtol=1e-9)
        assert (np.ptp(np.sign(biases), axis=0) == 2).all()


@pytest.mark.slow
def test_thousand_runs_spread_scale_factors():
    truth = constant(2, RATE_HZ, omega=(1.0, 1.0, 1.0), force=(10.0, 10.0, 10.0))
    gyro, accel = over_runs(perfect(gyro_scale_ppm=500.0, accel_scale_ppm=300.0), truth)
    assert_spread(gyro - 1.0, 500e-6)
    assert_spread(accel / 10.0 - 1.0, 300e-6)


@pytest.mark.slow
def test_thousand_runs_spread_misalignment():
    truth = constant(2, RATE_HZ, omega=(1.0, 0.0, 0.0), force=(0.0, 0.0, 10.0))
    gyro, accel = over_runs(perfect(gyro_misalignment_mrad=2.0, accel_misalignment_mrad=1.0), truth)
    assert_spread(gyro[:, 1:], 2e-3)
    assert_spread(accel[:, :2] / 10.0, 1e-3)
    np.testing.assert_allclose(gyro[:, 0], 1.0, rtol=1e-14)


@pytest.mark.slow
def test_thousand_runs_spread_nonorthogonality():
    truth = constant(2, RATE_HZ, omega=(1.0, 0.0, 0.0), force=(10.0, 0.0, 0.0))
    gyro, accel = over_runs(perfect(gyro_nonorthogonality_mrad=2.0, accel_nonorthogonality_mrad=1.0), truth)
    assert_spread(gyro[:, 1:], 2e-3)
    assert_spread(accel[:, 1:] / 10.0, 1e-3)


@pytest.mark.slow
def test_thousand_runs_spread_g_sensitivity_and_in_run_bias():
    gyro, _ = over_runs(perfect(gyro_g_sensitivity_degphpg=10.0), constant(2, RATE_HZ, force=(0, 0, -G)))
    assert_spread(gyro, 10 * DEG / 3600)
    gyro, accel = over_runs(perfect(gyro_instability_degph=5.0, accel_instability_mg=0.03), still(2))
    assert_spread(gyro, 5 * DEG / 3600 / 0.6174)
    assert_spread(accel, 0.03e-3 * G / 0.6174)


def test_runs_leave_configuration_and_grades_alone():
    config = ImuConfig(grade="mems-consumer")
    before, grades = config.model_dump(), repr(GRADES)
    first = sense(config, lively(300), seed=0)
    for seed in range(1, 30):
        sense(config, lively(50), seed=seed)
    again = sense(config, lively(300), seed=0)
    np.testing.assert_array_equal(again.dtheta, first.dtheta)
    np.testing.assert_array_equal(again.dv, first.dv)
    assert config.model_dump() == before
    assert repr(GRADES) == grades


def test_empty_block_gives_no_samples():
    imu = Imu("imu", ImuConfig(), RATE_HZ, 1)
    assert len(imu.sense(TruthBlock.empty(0, 0))) == 0
    assert len(imu.sense(lively(1))) == 0  # row 0 of a run carries no increments
