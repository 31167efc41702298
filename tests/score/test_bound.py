"""The bound: right where a Kalman filter's covariance is known, on Jacobians of its own, and never beaten."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
import xarray
from scipy.spatial.transform import Rotation

from nav.earth import SEA_LEVEL_DENSITY, gravity, radii
from nav.samples import Array
from testbed import Scenario, run
from testbed.loop.loop import RunResult
from testbed.many.campaign import Combination, Outcome
from testbed.motion.gusts import gust_statistics
from testbed.motion.sections import FlightTruth
from testbed.report.campaign import statistics
from testbed.score import bound, bound_way, metrics
from testbed.score import bound_model as model
from testbed.sensors.airspeed import AirspeedConfig
from testbed.sensors.barometer import BarometerConfig
from testbed.sensors.body_velocity import BodyVelocityConfig
from testbed.sensors.gnss import GnssConfig
from testbed.sensors.imu import ImuConfig
from testbed.sensors.magnetometer import FieldMap, MagnetometerConfig
from testbed.sensors.star_tracker import StarTrackerConfig

DATE = datetime.date(2026, 6, 1)
ROW_HZ, SECONDS = 50, 3
EARTH = 7.292115e-5


# --- the recursion


def random_steps(rng: np.random.Generator, count: int) -> list[tuple[Array, Array, Array, Array]]:
    """Nine states that mix, three that decay, and five measurements, two of which are missing now and then."""
    found = []
    for _ in range(count):
        Phi = np.eye(9, 12) + 0.1 * rng.normal(size=(9, 12))
        decay = np.concatenate([np.ones(9), rng.uniform(0.8, 1.0, 3)])
        H = rng.normal(size=(5, 12))
        H[rng.integers(0, 5, 2)] = 0.0
        found.append((Phi, decay, rng.uniform(0.01, 0.1, 12), H))
    return found


def test_it_is_the_covariance_of_a_kalman_filter_and_the_inverse_of_tichavskys_information() -> None:
    steps, P = random_steps(np.random.default_rng(4), 30), np.diag(np.linspace(1.0, 4.0, 12))
    got, J = P.copy(), np.linalg.inv(P)
    for Phi, decay, variance, H in steps:
        told = bound.variances(got, *(one[None] for one in (Phi, decay, variance, H)))
        F = np.diag(decay)
        F[:9] = Phi
        Q = 0.5 * (F @ np.diag(variance) @ F.T + np.diag(variance))  # half of the noise before, half after
        P = F @ P @ F.T + Q
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.eye(len(H)))
        P = P - K @ H @ P
        D11, D12, D22 = F.T @ np.linalg.inv(Q) @ F, -F.T @ np.linalg.inv(Q), np.linalg.inv(Q) + H.T @ H
        J = D22 - D12.T @ np.linalg.inv(J + D11) @ D12
        np.testing.assert_allclose(got, P, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(got, np.linalg.inv(J), rtol=1e-6, atol=1e-8)
        np.testing.assert_array_equal(told[0], np.diagonal(got)[:9])


def test_it_stays_a_covariance_for_hours_with_a_mode_that_grows() -> None:
    rng = np.random.default_rng(6)
    axes = np.linalg.qr(rng.normal(size=(9, 9)))[0]
    Phi = np.hstack([axes @ np.diag(np.linspace(1.0, 1.01, 9)) @ axes.T, np.zeros((9, 3))])
    step = Phi, np.ones(12), np.full(12, 1e-6), rng.normal(size=(5, 12))
    P = np.eye(12)
    bound.variances(P, *(np.repeat(one[None], 10_000, 0) for one in step))
    np.testing.assert_array_equal(P, P.T)
    assert np.linalg.eigvalsh(P)[0] > 0


@pytest.mark.parametrize("step_s", [0.1, 0.5, 5.0])
def test_an_error_of_first_order_keeps_its_spread_and_its_correlation(step_s: float) -> None:
    """Measured once, exactly, it is back at sigma^2 (1 - exp(-2 t / tau)) after t, whatever the steps are."""
    T, sigma, tau = np.full(round(50 / step_s), step_s), np.linspace(0.5, 4.0, 8), 10.0
    decay, variance = model.gauss_markov(sigma, tau).step(T, slice(0, len(T)))
    for start, end in ((1.0, 1.0), (0.0, 1 - np.exp(-2 * 50 / tau))):
        P = start * np.diag(sigma**2)
        bound.variances(P, np.zeros((len(T), 0, 8)), decay.repeat(8, 1), variance, np.zeros((len(T), 1, 8)))
        np.testing.assert_allclose(np.diagonal(P), end * sigma**2, rtol=1e-9)


# --- the model, by finite differences of motion and measurements


def f_b(t: float) -> Array:
    return np.array([0.4 * np.sin(t), 0.5 * np.cos(0.7 * t), -9.9 - 0.6 * np.sin(1.3 * t)])


def omega_b(t: float) -> Array:
    return np.array([0.15 * np.cos(t), 0.05 * np.sin(0.5 * t), 0.2])


Pose = tuple[Array, Array, Array]  # C_nb, v_n, (lat, lon, h)
START: Pose = (
    Rotation.from_euler("ZYX", [0.7, 0.05, 0.2]).as_matrix(),
    np.array([18.0, 15.0, -1.0]),
    np.array([0.6, 1.9, 280.0]),
)


def moved(pose: Pose, gyro: Callable[[float], Array], accel: Callable[[float], Array], dt: float) -> list[Pose]:
    """Poses at the rows of the run: the equations of motion on the turning ellipsoid, by the rule of the midpoint."""
    C, v, lla = pose
    rows = [pose]
    for k in range(ROW_HZ * SECONDS):
        t = (k + 0.5) * dt

        def rates(C: Array, v: Array, lla: Array) -> tuple[Array, Array, Array]:
            lat, _, h = lla
            R_M, R_N = radii(lat)
            place = np.array([v[0] / (R_M + h), v[1] / ((R_N + h) * np.cos(lat)), -v[2]])
            w_ie = EARTH * np.array([np.cos(lat), 0.0, -np.sin(lat)])
            w_en = np.array([v[1] / (R_N + h), -v[0] / (R_M + h), -v[1] * np.tan(lat) / (R_N + h)])
            force = C @ accel(t)  # noqa: B023
            return w_ie + w_en, force + np.array([0.0, 0.0, gravity(lat, h)]) - np.cross(2 * w_ie + w_en, v), place

        w_in, v_dot, place = rates(C, v, lla)
        half = Rotation.from_rotvec(gyro(t) * dt / 2).as_matrix()
        middle = Rotation.from_rotvec(-w_in * dt / 2).as_matrix() @ C @ half
        w_in, v_dot, place = rates(middle, v + v_dot * dt / 2, lla + place * dt / 2)
        C = Rotation.from_rotvec(-w_in * dt).as_matrix() @ C @ Rotation.from_rotvec(gyro(t) * dt).as_matrix()
        v, lla = v + v_dot * dt, lla + place * dt
        rows.append((C, v, lla))
    return rows


def difference(one: Pose, other: Pose) -> Array:
    """Phi, velocity and position (9,) of one less another."""
    C, v, lla = one
    C0, v0, lla0 = other
    R_M, R_N = radii(lla0[0])
    place = (lla - lla0) * [R_M + lla0[2], (R_N + lla0[2]) * np.cos(lla0[0]), -1.0]
    return np.concatenate([-Rotation.from_matrix(C @ C0.T).as_rotvec(), v - v0, place])


@pytest.fixture(scope="module")
def flown() -> tuple[list[Pose], xarray.DataTree]:
    """A turning flight by its equations, as a record."""
    poses = moved(START, omega_b, f_b, 1 / ROW_HZ)
    t = np.arange(len(poses)) / ROW_HZ
    C, v, lla = (np.array(part) for part in zip(*poses, strict=True))
    truth = {
        "q_nb": Rotation.from_matrix(C).as_quat(scalar_first=True), "v_n": v, "lat": lla[:, 0], "lon": lla[:, 1],
        "h": lla[:, 2], "omega_b": np.array([omega_b(x) for x in t]),
        "dtheta": np.array([omega_b(x - 0.5 / ROW_HZ) for x in t]) / ROW_HZ,
        "dv": np.array([f_b(x - 0.5 / ROW_HZ) for x in t]) / ROW_HZ,
        "wind_n": np.tile([3.0, -2.0, 0.5], (len(t), 1)), "airspeed": np.full(len(t), 25.0),
        "beta": 0.01 * np.sin(5 * t), "density": np.full(len(t), 1.19), "current": 2 + np.sin(t),
        "temperature": 288 - t,
    }  # fmt: skip
    columns = {name: (("time", *[f"{name}_axis"] * (x.ndim - 1)), x) for name, x in truth.items()}
    sensors = {"time": ("time", t[1:]), "fix_type": ("time", np.full(len(t) - 1, 3))}
    record = {"/truth": xarray.Dataset(columns, {"time": t})}
    return poses, xarray.DataTree.from_dict(record | {f"/sensors/{n}": xarray.Dataset(sensors) for n in ("one",)})


def whole(made: model.Model) -> Array:
    """Transition (9, n) of the motion over all steps."""
    F = np.eye(made.size)
    for Phi, decay, _ in zip(*made.transition(slice(0, len(made.way))), strict=True):
        step = np.diag(decay)
        step[:9] = Phi
        F = step @ F
    return F[:9]


def test_the_motion_is_that_of_its_equations(flown: tuple[list[Pose], xarray.DataTree]) -> None:
    """Phi of every state of motion and IMU beside finite differences over three seconds of turning flight."""
    poses, record = flown
    errors = ImuConfig(gyro_instability_degph=0, accel_instability_mg=0).errors()
    made = model.Model(bound_way.way(record, np.eye(3), 0.1))
    model.add_imu(made, errors)
    # biases, temperature and matrix of each, then the pull on the gyros
    assert made.size == 9 + 2 * (3 + 3 + 9) + 9
    F = whole(made)

    def late(pose: Pose, gyro: Callable[[float], Array] = omega_b, accel: Callable[[float], Array] = f_b) -> Array:
        return difference(moved(pose, gyro, accel, 1 / ROW_HZ)[-1], poses[-1])

    C, v, lla = START
    for k, size in ((0, 1e-4), (2, 1e-4), (3, 0.1), (4, 0.1), (8, 10.0)):
        change = np.zeros(9)
        change[k] = size
        place = np.array([0.0, 0.0, -change[8]])
        found = late((Rotation.from_rotvec(-change[:3]).as_matrix() @ C, v + change[3:6], lla + place)) / size
        np.testing.assert_allclose(F[:, k], found, rtol=3e-3, atol=3e-3 * np.abs(found).max() * 0.05, err_msg=str(k))
    rate, force = omega_b, f_b
    for k, size, gyro, accel in (
        (9, 1e-5, lambda t: rate(t) - [1e-5, 0, 0], force),
        (12, 1e-6, lambda t: rate(t) - np.array([t, 0, 0]) * -1e-6, force),
        (17, 1e-4, lambda t: rate(t) - [1e-4 * rate(t)[2], 0, 0], force),
        (24, 1e-3, rate, lambda t: force(t) - [1e-3, 0, 0]),
        (38, 1e-4, rate, lambda t: force(t) - [0, 0, 1e-4 * force(t)[2]]),
        (41, 1e-6, lambda t: rate(t) - [1e-6 * force(t)[2], 0, 0], force),
    ):
        found = late(START, gyro, accel) / size
        np.testing.assert_allclose(F[:, k], found, rtol=1e-2, atol=4e-3 * np.abs(found).max(), err_msg=str(k))


def test_measurements_are_those_of_the_sensors(flown: tuple[list[Pose], xarray.DataTree]) -> None:
    """Each row beside the difference that an error of the motion makes to what the sensor says."""
    poses, record = flown
    way = bound_way.way(record, np.eye(3), SECONDS)
    C, v, lla = poses[-1]
    arm, wind, rate = np.array([0.5, -0.3, 0.2]), np.array([3.0, -2.0, 0.5]), omega_b(SECONDS)
    field = FieldMap(DATE)
    thin = np.sqrt(1.19 / SEA_LEVEL_DENSITY)

    def fix(C: Array, v: Array, p: Array) -> Array:
        return np.concatenate([p + C @ arm, v + C @ np.cross(rate, arm)])

    def speed(C: Array, v: Array, p: Array) -> Array:
        return np.array([thin * (1 + 0.5 * p[2] / model.SCALE_HEIGHT) * C[:, 0] @ (v - wind)])

    for config, sigma, measured in (
        (GnssConfig(lever_arm_m=tuple(arm)), [0.4, 0.4, 0.8, 0.05, 0.05, 0.08], fix),
        (BarometerConfig(), [1.2], lambda C, v, p: np.array([1.19 * 9.81 * p[2]])),
        (MagnetometerConfig(), [0.19e-6] * 3, lambda C, v, p: C.T @ field.field_n(*lla.tolist())),
        (AirspeedConfig(), [2.0 / (SEA_LEVEL_DENSITY * speed(C, v, np.zeros(3))[0])], speed),
        (BodyVelocityConfig(noise_mps=0.1), [0.1] * 3, lambda C, v, p: C.T @ v),
    ):
        made = model.Model(way)
        assert model.add_sensor(made, record, "one", config, DATE)
        H = made.measured(slice(0, 1))[0, : len(sigma), :9] * np.array(sigma)[:, None] / np.sqrt(ROW_HZ * SECONDS)
        for k in range(9):
            change = np.zeros(9)
            change[k] = 1e-4
            turned = Rotation.from_rotvec(-change[:3]).as_matrix() @ C
            found = (measured(turned, v + change[3:6], change[6:]) - measured(C, v, np.zeros(3))) / 1e-4
            np.testing.assert_allclose(H[:, k], found, rtol=1e-3, atol=1e-3 * np.abs(H).max(), err_msg=str((config, k)))


def test_a_star_tracker_sees_how_the_place_turns_the_horizon(flown: tuple[list[Pose], xarray.DataTree]) -> None:
    """Attitude against the Earth's own axes, which is against the stars, beside errors of the motion."""
    poses, record = flown
    config = StarTrackerConfig()
    made = model.Model(bound_way.way(record, np.eye(3), SECONDS))
    assert model.add_sensor(made, record, "one", config, DATE)
    C, _, (lat, lon, h) = poses[-1]
    sigma = config.errors().noise_b
    H = made.measured(slice(0, 1))[0, :, :9] * sigma[:, None] / np.sqrt(ROW_HZ * SECONDS)
    R_M, R_N = radii(lat)

    def from_earth(error: Array) -> Rotation:
        north, east = lat + error[6] / (R_M + h), lon + error[7] / ((R_N + h) * np.cos(lat))
        horizon = Rotation.from_euler("ZY", [east, -north - np.pi / 2])
        return horizon * Rotation.from_rotvec(-error[:3]) * Rotation.from_matrix(C)

    for k, size in [(k, 1e-4) for k in range(3)] + [(6, 1e3), (7, 1e3), (8, 1e3)]:
        found = (from_earth(np.zeros(9)).inv() * from_earth(size * np.eye(9)[k])).as_rotvec() / size
        np.testing.assert_allclose(H[:, k], found, atol=0.005 * max(np.abs(found).max(), 1e-9), err_msg=str(k))


def test_who_knows_that_there_is_no_wind_knows_that_nothing_slips(flown: tuple[list[Pose], xarray.DataTree]) -> None:
    _, record = flown
    made = model.Model(bound_way.way(record, np.eye(3), SECONDS))
    assert model.add_sensor(made, record, "one", AirspeedConfig(), DATE)
    across = made.measured(slice(0, 1))[0, 1, 3:6]
    np.testing.assert_allclose(across / np.linalg.norm(across), made.way.C_nb[0][:, 1], atol=1e-12)


def test_gusts_along_their_axes_and_the_mean_wind_carry_the_air(flown: tuple[list[Pose], xarray.DataTree]) -> None:
    _, record = flown
    made = model.Model(bound_way.way(record, np.eye(3), SECONDS))
    truth = FlightTruth.model_validate(
        {"source": "flight", "start": {"lat_deg": 34, "lon_deg": 108, "alt_m": 280, "heading_deg": 0,
         "airspeed_mps": 25}, "wind": {"speed_mps": 5, "turbulence": "light", "walk_mps_per_sqrt_s": 0.02,
         "gauss_markov": {"sigma_mps": 1, "correlation_s": 300}}}, strict=False,
    )  # fmt: skip
    model.add_air(made, truth)
    assert model.add_sensor(made, record, "one", AirspeedConfig(), DATE)
    H = made.measured(slice(0, 1))[0]
    C = made.way.C_nb[0]
    for row, axis in ((0, C[:, 0]), (1, C[:, 1])):
        ground = H[row, 3:6]
        np.testing.assert_allclose(ground / np.linalg.norm(ground), axis, atol=1e-12)
        np.testing.assert_allclose(H[row, 9:13], -np.tile(ground[:2], 2))
        assert np.linalg.norm(H[row, 13:16]) == pytest.approx(np.linalg.norm(ground))
    _, decay, variance = made.transition(slice(0, 1))
    sigma, length = gust_statistics("light", np.array([280.0]))
    np.testing.assert_allclose(decay[0, 13:16], np.exp(-SECONDS * 25 / length[0]), rtol=1e-2)
    np.testing.assert_allclose(variance[0, 9:11], 0.02**2 * SECONDS)
    assert sigma[0, 0] == pytest.approx(0.79, abs=0.01)
    assert length[0, 0] == pytest.approx(2 * length[0, 1])


# --- of a run

SHORT = ["duration_s=110", "sensors.gnss.denied=[[40,110]]", "expect={}"]


@pytest.fixture(scope="module")
def short() -> RunResult:
    return run(Scenario.load("loiter_gnss_outage", SHORT))


@pytest.mark.ci
def test_a_simulated_outage_has_a_bound_for_each_estimator_of_position(short: RunResult) -> None:
    found = bound.of_run(short.dataset)
    assert list(found) == ["ins", "federated"]  # not of attitude alone
    assert found["ins"] is found["federated"]  # of the same sensors
    at_60 = found["ins"].horizontal_at(100.0)
    assert short.metrics["ins.outage_bound_at_60s_m"] == pytest.approx(at_60, rel=1e-3)
    assert 3.0 < at_60 < 15.0
    grows = np.diff(found["ins"].horizontal[found["ins"].t > 45.0])
    assert (grows > -1e-3).all()


@pytest.mark.ci
def test_finer_steps_and_fewer_sensors(short: RunResult) -> None:
    usual = bound.of_run(short.dataset)["ins"].horizontal_at(100.0)
    assert bound.of_run(short.dataset, 0.1)["ins"].horizontal_at(100.0) == pytest.approx(usual, rel=1e-3)
    blind = short.dataset.copy()
    text = str(blind.attrs["scenario"])
    blind.attrs["scenario"] = text.replace('["gnss", "barometer", "magnetometer", "airspeed"]', '["gnss", "barometer"]')
    assert bound.of_run(blind)["ins"].horizontal_at(100.0) > 1.5 * usual


@pytest.mark.ci
def test_what_comes_later_changes_nothing(short: RunResult) -> None:
    whole, part = bound.of_run(short.dataset)["ins"], bound.of_run(short.dataset, until=100.0)["ins"]
    assert 100.0 <= part.t[-1] < 100.0 + 2 * bound.STEP_S
    for name in ("t", "position", "velocity", "attitude"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[: len(part.t)])


@pytest.mark.ci
def test_what_was_not_simulated_or_not_denied_has_none(short: RunResult) -> None:
    assert bound.of_run(xarray.DataTree.from_dict({"/": xarray.Dataset()})) == {}
    recorded = short.dataset.copy()
    text = str(recorded.attrs["scenario"])
    voted = text.replace('name = "ins"', 'name = "ins"\nspare_imus = ["spare"]')
    recorded.attrs["scenario"] = voted.replace("[sensors.gnss]", "[sensors.spare]\nkind = 'imu'\n[sensors.gnss]")
    assert "ins" not in bound.of_run(recorded)
    assert not [key for key in metrics.compute(recorded) if key.startswith("ins.outage_bound")]


def test_the_slip_is_taken_as_it_was() -> None:
    rng, x = np.random.default_rng(1), np.zeros(200_000)
    for k in range(1, len(x)):
        x[k] = 0.7 * x[k - 1] + rng.normal()
    sigma, tau = model.slip_statistics(SimpleNamespace(slip=0.1 * x - 0.3, row_s=0.1))  # type: ignore[arg-type]
    assert sigma == pytest.approx(0.1 / np.sqrt(1 - 0.49), rel=0.02)
    assert tau == pytest.approx(-0.1 / np.log(0.7), rel=0.05)


DRAWS = 16


@pytest.mark.slow
def test_no_estimator_is_better_over_draws() -> None:
    """Root mean square over draws, with its interval, of every estimator 60 and 120 s into an outage."""
    scenario = Scenario.load("loiter_gnss_outage", ["duration_s=300", "sensors.gnss.denied=[[170,300]]", "expect={}"])
    outcomes = [Outcome(0, 900 + k, run(scenario, seed=900 + k).metrics, {}) for k in range(DRAWS)]
    times = {"time": np.zeros(1), "outage": np.zeros(1)} | {
        f"{e.name}.{what}": np.zeros(1) for e in scenario.estimator for what in ("error", "sigma", "nees")
    }
    outcomes = [Outcome(o.combination, o.seed, o.metrics, times) for o in outcomes]
    found = statistics([Combination({}, scenario)], outcomes).efficiencies
    assert len(found) == 4  # ins and federated, at 60 and 120 s
    for one in found:
        assert one.runs == DRAWS
        assert one.high > 1.0, one
