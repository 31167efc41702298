"""The linear model of a simulated run along its true trajectory, with the statistics that its errors were drawn from.

Written for `testbed.score.bound` alone, and without the filters' models (`nav.error_model`, `nav.aids`) on purpose: a
mistake in those would not show beside itself. Errors have the signs of `nav`; they are of motion (attitude phi,
velocity, position), of sensors, and of the air. What is drawn for a run is a state with the spread it was drawn with,
or white noise. What is left out, for it changes nothing or because it has no statistics, is taken as known, which makes
the bound lower and never wrong: vibration, resolution, range, asymmetry, self-heating, faults; the stray field of
motors; a receiver's latency and its jumps; what the air about it does to a static port; in the air, updrafts and a mean
wind that changes by a front, with place, or with height.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from nav.earth import SEA_LEVEL_DENSITY
from nav.samples import Array, has_fix
from testbed.motion.gusts import gust_statistics
from testbed.motion.sections import FlightTruth, Wind
from testbed.score.accuracy import SAME_TIME_S, column
from testbed.score.bound_way import Way
from testbed.sensors import SensorConfig
from testbed.sensors.airspeed import AirspeedConfig
from testbed.sensors.barometer import BarometerConfig
from testbed.sensors.body_velocity import BodyVelocityConfig
from testbed.sensors.gnss import GnssConfig
from testbed.sensors.imu import ImuErrors
from testbed.sensors.magnetometer import FieldMap, MagnetometerConfig
from testbed.sensors.position_fix import PositionFixConfig
from testbed.sensors.star_tracker import StarTrackerConfig
from testbed.sensors.units import PERCENT
from testbed.sensors.wind_report import WindReportConfig

if TYPE_CHECKING:
    import datetime

    import xarray

EARTH_RATE = 7.292115e-5  # [rad/s]
MEAN_RADIUS = 6.371e6  # [m]: for what is a thousand times smaller than the rest
GRAVITY = 9.81  # [m/s^2]
SCALE_HEIGHT = 1.04e4  # of the air's density near the ground [m]

MOTION = 9
PHI, VEL, POS = slice(0, 3), slice(3, 6), slice(6, 9)
UNKNOWN_WIND = 20.0  # mean wind per axis, before anything is known of it [m/s]
SLOWEST = 5.0  # along the tube, below which a pitot tube tells nothing [m/s]
FIELD_EVERY = 50  # steps between which the Earth's magnetic field is taken as changing evenly
EXACT_SLIP = 0.1  # of its own sigma: how exactly the slip is known to be what it is
Measured: TypeAlias = Callable[[slice, int], tuple[Array, Array]]  # H (K, m, n) and 1-sigma (K, m) of one sample each
Gusts: TypeAlias = tuple[slice, Array]  # their states, and their axes (K, 3, 3)


@dataclass(frozen=True, slots=True)
class Block:
    """Error states: their covariance (n, n) at the start and how they go on.

    ``sigma`` (n,) or (K, n) and ``correlation_s``, a number or (K, n), are of a first-order Gauss-Markov process.
    Without them they are a random walk of ``density`` per root second, or constants where that is zero.
    """

    prior: Array
    sigma: Array | None = None
    correlation_s: Array | float = math.inf
    density: float = 0.0

    @property
    def empty(self) -> bool:
        """Whether all of it is known to be zero."""
        return not self.prior.any() and not self.density

    def step(self, T: Array, part: slice) -> tuple[Array, Array]:
        """Decay and variance, each (K, n) or like it, over steps of ``T`` (K,) [s]."""
        if self.sigma is None:
            return np.ones((len(T), 1)), self.density**2 * T[:, None]
        tau = self.correlation_s[part] if isinstance(self.correlation_s, np.ndarray) else self.correlation_s
        sigma = self.sigma if self.sigma.ndim == 1 else self.sigma[part]
        decay = np.exp(-T[:, None] / tau)
        return decay, 2 * sigma**2 * np.tanh(T[:, None] / tau)  # half before, half after: sigma^2 stays


def constant(sigma: Array | Sequence[float]) -> Block:
    """Constants, drawn once with standard deviations ``sigma`` (n,)."""
    return Block(np.diag(np.square(sigma)))


def gauss_markov(sigma: Array | Sequence[float], correlation_s: Array | float) -> Block:
    """Stationary first-order Gauss-Markov processes; ``sigma`` (n,), or (K, n) and so its correlation time."""
    sigma = np.asarray(sigma, float)
    return Block(np.diag(np.square(np.atleast_2d(sigma)[0])), sigma, correlation_s)


@dataclass
class Model:
    """The states of a run, how they grow over each step of its `Way`, and what each step's measurements tell of them.

    Blocks and measurements are added one by one; `transition` and `measured` then serve any part of the steps.
    ``noise`` is the density of white noise on the motion (9,).
    """

    way: Way
    size: int = MOTION
    noise: Array = field(default_factory=lambda: np.zeros(MOTION))
    blocks: list[tuple[slice, Block]] = field(default_factory=list)
    drives: list[tuple[slice, slice, Array]] = field(default_factory=list)  # rows, columns, F T (K, 3, n)
    measurements: list[tuple[Array, Measured]] = field(default_factory=list)  # samples per step (K,), and rows
    air: tuple[slice, slice | None, Gusts | None] | None = None  # mean wind, what wanders about it, gusts
    ground: slice | None = None  # its height over the map

    def add(self, block: Block) -> slice:
        """Lay a block out behind the others."""
        where = slice(self.size, self.size + len(block.prior))
        self.blocks.append((where, block))
        self.size = where.stop
        return where

    def observe(self, times: Array, rows: Measured) -> None:
        """Measurements by samples at ``times`` [s], ``rows`` being those of each."""
        edges = np.concatenate([[self.way.t[0] - self.way.T[0]], self.way.t]) + SAME_TIME_S
        self.measurements.append((np.histogram(times, edges)[0].astype(float), rows))

    @property
    def prior(self) -> Array:
        """Covariance (n, n) at the start, the motion's part left zero."""
        P = np.zeros((self.size, self.size))
        for where, block in self.blocks:
            P[where, where] = block.prior
        return P

    def transition(self, part: slice) -> tuple[Array, Array, Array]:
        """(Phi (K, 9, c), decay (K, n), variance (K, n)) of the steps in ``part``.

        The motion at the end of a step is Phi times the first c states at its beginning (no other drives it), any other
        state its own times its decay; each gains its variance, white noise of the step. Phi = I + F T + (F T)^2 / 2,
        with F of the whole step.
        """
        T = self.way.T[part]
        FT = np.zeros((len(T), MOTION, max((where.stop for _, where, _ in self.drives), default=MOTION)))
        _motion(FT, self.way, part)
        for onto, where, turned in self.drives:
            FT[:, onto, where] += turned[part]
        Phi = FT + 0.5 * FT[:, :, :MOTION] @ FT
        Phi[:, range(MOTION), range(MOTION)] += 1.0
        decay, variance = np.ones((len(T), self.size)), np.zeros((len(T), self.size))
        variance[:, :MOTION] = self.noise**2 * T[:, None]
        for where, block in self.blocks:
            decay[:, where], variance[:, where] = block.step(T, part)
        return Phi, decay, variance

    def measured(self, part: slice) -> Array:
        """H (K, m, n) over the 1-sigma of what each row measures, of all samples of a step together."""
        found = [np.zeros((len(self.way.t[part]), 0, self.size))]
        for count, rows in self.measurements:
            if count[part].any():
                H, sigma = rows(part, self.size)
                found.append(H * (np.sqrt(count[part])[:, None] / sigma)[:, :, None])
        return np.concatenate(found, axis=1)


def _motion(FT: Array, way: Way, part: slice) -> None:
    """F T of the motion among itself, into ``FT`` (K, 9, n): Titterton and Weston, 2nd ed., 12.3, with phi = -psi."""
    T, v, lat = way.T[part], way.v_n[part], way.lla[part, 0]
    zero, over_R = np.zeros_like(T), T / MEAN_RADIUS
    earth = EARTH_RATE * np.column_stack([np.cos(lat), zero, -np.sin(lat)]) * T[:, None]
    carried = np.column_stack([v[:, 1], -v[:, 0], -v[:, 1] * np.tan(lat)]) * over_R[:, None]
    FT[:, PHI, PHI] = -skew(earth + carried)
    FT[:, 0, 4], FT[:, 1, 3], FT[:, 2, 4] = over_R, -over_R, -np.tan(lat) * over_R
    FT[:, VEL, PHI] = skew(way.force_n[part])
    FT[:, VEL, VEL] = -skew(2 * earth + carried)
    FT[:, 5, 8] = 2 * GRAVITY / MEAN_RADIUS * T
    FT[:, POS, VEL] = np.eye(3) * T[:, None, None]


def skew(v: Array) -> Array:
    """[v x] (..., 3, 3) of vectors (..., 3)."""
    x, y, z = np.moveaxis(v, -1, 0)
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)


# --- sensors, as they are drawn (`testbed.sensors`)


def add_imu(model: Model, e: ImuErrors) -> None:
    """Gyros and accelerometers: biases, their drift and walk, scale and alignment, temperature, pull, white noise."""
    way = model.way
    warming = way.temperature[:, None, None]
    for what, onto, sign, products in (
        ("gyro", PHI, 1.0, way.turned_rate),
        ("accel", VEL, -1.0, way.turned_force),
    ):

        def of(name: str, what: str = what) -> float:
            return float(getattr(e, f"{what}_{name}"))

        scaled = products.reshape(len(way), 3, 9)
        for block, turned in (
            (Block(np.eye(3) * of("turn_on") ** 2, density=of("random_walk")), way.turned),
            (gauss_markov([of("in_run")] * 3, of("in_run_tau")), way.turned),
            (constant([of("temperature")] * 3), way.turned * warming),
            (Block(_matrix_prior(of("scale"), of("misalignment"), of("nonorthogonality"))), scaled),
        ):
            if not block.empty:
                model.drives.append((onto, model.add(block), sign * turned))
        model.noise[onto] = of("noise")
    if e.gyro_g_sensitivity:
        pulled = way.turned_force.reshape(len(way), 3, 9)
        model.drives.append((PHI, model.add(constant([e.gyro_g_sensitivity] * 9)), pulled))


def _matrix_prior(scale: float, misalignment: float, skewness: float) -> Array:
    """Covariance (9, 9) of a triad's error matrix, row by row: scale, a small rotation, y and z that lean."""
    from_draws = np.zeros((9, 9))  # columns: scale x y z, rotation x y z, skewness yx zx zy
    from_draws[[0, 4, 8], [0, 1, 2]] = scale
    for (row, column_), axis, sign in (
        ((0, 1), 2, 1), ((0, 2), 1, -1), ((1, 0), 2, -1), ((1, 2), 0, 1), ((2, 0), 1, 1), ((2, 1), 0, -1),
    ):  # fmt: skip
        from_draws[3 * row + column_, 3 + axis] = sign * misalignment
    from_draws[[3, 6, 7], [6, 7, 8]] = skewness
    prior: Array = from_draws @ from_draws.T
    return prior


def add_sensor(model: Model, dataset: xarray.DataTree, name: str, config: SensorConfig, date: datetime.date) -> bool:
    """The samples of one aiding sensor and its errors; whether it is of a kind that is known here."""
    recorded = "sensors" in dataset and name in dataset["sensors"]
    times = np.asarray(column(dataset, f"sensors/{name}/time"), float) if recorded else np.zeros(0)
    way = model.way
    match config:
        case GnssConfig():
            fixed = has_fix(column(dataset, f"sensors/{name}/fix_type")) if recorded else np.zeros(0, bool)
            _add_gnss(model, times[fixed], config)
        case BarometerConfig():
            _add_barometer(model, times, config)
        case MagnetometerConfig():
            _add_magnetometer(model, times, config, date)
        case AirspeedConfig():
            _add_airspeed(model, times, config)
        case BodyVelocityConfig():
            v = config.errors()
            C_bn = way.C_nb.transpose(0, 2, 1)[:, list(v.axes)]
            scale = model.add(constant([v.scale] * len(v.axes)))
            slow = model.add(gauss_markov([v.correlated] * len(v.axes), v.tau))

            def velocity(H: Array, part: slice) -> float:
                C, v_n = C_bn[part], way.v_n[part]
                H[:, :, VEL], H[:, :, PHI] = C, -C @ skew(v_n)
                H[:, :, scale] = np.eye(len(v.axes)) * (C @ v_n[:, :, None])
                H[:, :, slow] = np.eye(len(v.axes))
                return v.noise

            model.observe(times, rows(len(v.axes), 1e-4, velocity))
        case StarTrackerConfig():
            across = config.errors().noise_b

            def attitude(H: Array, part: slice) -> Array:
                # As against the stars, n itself is turned by an error of the position that it stands at.
                C_bn, tangent = way.C_nb[part].transpose(0, 2, 1), np.tan(way.lla[part, 0])[:, None]
                H[:, :, PHI] = -C_bn
                H[:, :, POS.start] = -C_bn[:, :, 1] / MEAN_RADIUS
                H[:, :, POS.start + 1] = (C_bn[:, :, 0] - tangent * C_bn[:, :, 2]) / MEAN_RADIUS
                return across

            model.observe(times, rows(3, 1e-6, attitude))
        case PositionFixConfig():
            p = config.errors()
            axes = 3 if p.height else 2

            def position(H: Array, part: slice) -> Array:
                H[:, range(axes), range(POS.start, POS.start + axes)] = 1.0
                return p.position_n[:axes]

            model.observe(times, rows(axes, 1e-3, position))
        case WindReportConfig():
            ages = np.asarray(column(dataset, f"sensors/{name}/age"), float) if recorded else np.zeros(0)
            _add_wind_report(model, times - ages, config)
        case _:
            return False
    return True


def rows(m: int, least: float, fill: Callable[[Array, slice], Array | float]) -> Measured:
    """Measurements of ``m`` components: ``fill`` writes their H (K, m, n) and gives their 1-sigma, at the ``least``."""

    def measured(part: slice, size: int) -> tuple[Array, Array]:
        H = np.zeros((part.stop - part.start, m, size))
        return H, np.broadcast_to(np.maximum(fill(H, part), least), H.shape[:2])

    return measured


def _add_gnss(model: Model, times: Array, config: GnssConfig) -> None:
    way, e = model.way, config.errors()
    slow_position = model.add(gauss_markov(e.position_correlated_n, e.position_tau))
    slow_velocity = model.add(gauss_markov(e.velocity_correlated_n, e.velocity_tau))
    arm_b = np.asarray(e.lever_arm_b, float)
    arm_n = way.C_nb @ arm_b
    swing_n = np.einsum("kij,kj->ki", way.C_nb, np.cross(way.omega_b, arm_b))

    def fix(H: Array, part: slice) -> Array:
        H[:, :3, POS] = H[:, 3:, VEL] = np.eye(3)
        H[:, :3, PHI], H[:, 3:, PHI] = skew(arm_n[part]), skew(swing_n[part])
        H[:, :3, slow_position] = H[:, 3:, slow_velocity] = np.eye(3)
        return np.concatenate([e.position_white_n, e.velocity_white_n])

    model.observe(times, rows(6, 1e-4, fix))


def _add_barometer(model: Model, times: Array, config: BarometerConfig) -> None:
    b = config.errors()
    parts = [model.add(constant([b.bias])), model.add(gauss_markov([b.drift], b.drift_tau))]
    if b.unsteady:
        parts.append(model.add(gauss_markov([b.unsteady], b.unsteady_tau)))
    weight = model.way.density * GRAVITY  # of pressure per metre down

    def pressure(H: Array, part: slice) -> float:
        H[:, 0, POS.start + 2] = weight[part]
        for error in parts:
            H[:, :, error] = 1.0
        return b.noise

    model.observe(times, rows(1, 0.01, pressure))


def _add_magnetometer(model: Model, times: Array, config: MagnetometerConfig, date: datetime.date) -> None:
    way, e = model.way, config.errors()
    hard, soft = model.add(constant([e.hard_iron] * 3)), model.add(constant([e.soft_iron] * 9))
    wiring = model.add(constant([e.current] * 3))
    world = FieldMap(date)
    looked_up = np.unique(np.append(np.arange(0, len(way), FIELD_EVERY), len(way) - 1))
    known = np.array([world.field_n(*place) for place in way.lla[looked_up].tolist()])
    field_n = np.column_stack([np.interp(np.arange(len(way)), looked_up, axis) for axis in known.T])
    C_bn = way.C_nb.transpose(0, 2, 1)
    field_b = np.einsum("kij,kj->ki", C_bn, field_n)

    def seen(H: Array, part: slice) -> float:
        H[:, :, PHI] = -C_bn[part] @ skew(field_n[part])
        H[:, :, hard] = np.eye(3)
        H[:, :, soft] = np.kron(np.eye(3), np.ones((1, 3))) * np.tile(field_b[part], 3)[:, None, :]
        H[:, :, wiring] = np.eye(3) * way.current[part, None, None]
        return e.noise

    model.observe(times, rows(3, 1e-10, seen))


# --- the air


def _add_airspeed(model: Model, times: Array, config: AirspeedConfig) -> None:
    """Speed along the tube, and that the aircraft slips as it does: sideways it is a coordinated flight's."""
    way = model.way
    bias, scale = model.add(constant([config.bias_pa])), model.add(constant([config.scale_percent * PERCENT]))
    wake = model.add(gauss_markov([config.errors().unsteady], config.unsteady_time_s)) if config.unsteady_pa else None
    air_n = way.v_n - way.wind_n
    ahead_n, side_n = way.C_nb[:, :, 0], way.C_nb[:, :, 1]
    along = np.maximum(np.einsum("ki,ki->k", ahead_n, air_n), SLOWEST)
    thinness = np.sqrt(way.density / SEA_LEVEL_DENSITY)
    eas = thinness * along
    per_pascal = 1 / (SEA_LEVEL_DENSITY * eas)

    def speed(H: Array, part: slice) -> Array:
        _through_air(H[:, 0], model, thinness[part, None] * ahead_n[part], air_n[part], part)
        H[:, 0, POS.start + 2] = 0.5 * eas[part] / SCALE_HEIGHT
        H[:, 0, bias] = per_pascal[part, None]
        if wake is not None:
            H[:, 0, wake] = 1.0
        H[:, 0, scale] = 0.5 * eas[part, None]
        noise: Array = config.noise_pa * per_pascal[part, None]
        return noise

    flown = way.airspeed > SLOWEST
    model.observe(times[np.interp(times, way.t, flown) > 0], rows(1, 1e-3, speed))
    sigma, correlation_s = slip_statistics(way)
    slipping = model.add(gauss_markov([sigma], correlation_s))

    def slip(H: Array, part: slice) -> float:
        _through_air(H[:, 0], model, side_n[part], air_n[part], part)
        H[:, 0, slipping] = -1.0
        return EXACT_SLIP * sigma

    model.observe(way.t[flown], rows(1, 1e-3, slip))


def _add_wind_report(model: Model, times: Array, config: WindReportConfig) -> None:
    """The mean wind at the ``times`` it was measured, known then: nobody knows it sooner, or without the gusts."""
    e = config.errors()
    local = model.add(gauss_markov([e.local] * 2, e.tau))
    if model.air is None:
        return
    mean, back, _ = model.air

    def wind(H: Array, part: slice) -> float:
        H[:, :, mean] = H[:, :, local] = np.eye(2)
        if back is not None:
            H[:, :, back] = np.eye(2)
        return e.noise

    model.observe(times, rows(2, 1e-3, wind))


def slip_statistics(way: Way) -> tuple[float, float]:
    """Standard deviation [m/s] and correlation time [s] of the air that comes from the side, about its mean."""
    slip = way.slip - way.slip.mean()
    sigma = float(slip.std())
    if not sigma > 0:
        return 0.0, way.row_s
    alike = float(np.mean(slip[1:] * slip[:-1])) / sigma**2
    return sigma, -way.row_s / math.log(min(max(alike, 0.01), 0.999))


def _through_air(H: Array, model: Model, axis_n: Array, air_n: Array, part: slice) -> None:
    """Velocity through the air along an axis (K, 3) of the body, of which ``air_n`` (K, 3) is the whole, into a row."""
    H[:, VEL], H[:, PHI] = axis_n, np.cross(air_n, axis_n)
    if model.air is None:
        return
    mean, back, gusts = model.air
    H[:, mean] = -axis_n[:, :2]
    if back is not None:
        H[:, back] = -axis_n[:, :2]
    if gusts is not None:
        H[:, gusts[0]] = -np.einsum("ki,kij->kj", axis_n, gusts[1][part])


def add_air(model: Model, truth: FlightTruth) -> None:
    """The mean wind, what wanders about it, and Dryden's gusts along their own axes as JSBSim turns them."""
    way, wind = model.way, truth.wind
    mean = model.add(Block(np.eye(2) * UNKNOWN_WIND**2, density=wind.walk_mps_per_sqrt_s))
    back = None
    if wind.gauss_markov is not None and wind.gauss_markov.sigma_mps > 0:
        back = model.add(gauss_markov([wind.gauss_markov.sigma_mps] * 2, wind.gauss_markov.correlation_s))
    gusts = None
    if wind.turbulence != "none":
        sigma, length = gust_statistics(wind.turbulence, way.lla[:, 2])
        speed = np.maximum(way.airspeed, SLOWEST)[:, None]
        gusts = model.add(gauss_markov(sigma, length / speed)), _gust_axes(wind, way)
    model.air = mean, back, gusts


def _gust_axes(wind: Wind, way: Way) -> Array:
    """Axes (K, 3, 3) of gusts along the wind, across it and down, as columns in n.

    JSBSim turns them the other way round about the vertical than the wind blows (FGWinds::Turbulence): of a wind
    towards the east of north, gusts along it blow towards the west of north.
    """
    north, east = way.mean_wind_n[:, 0], way.mean_wind_n[:, 1]
    still = wind.one and not wind.drawn and wind.speed_mps == 0.0
    psi = np.zeros(len(way)) if still else np.arctan2(east, north)
    axes = np.zeros((len(way), 3, 3))
    axes[:, 0, 0] = axes[:, 1, 1] = np.cos(psi)
    axes[:, 0, 1], axes[:, 1, 0] = np.sin(psi), -np.sin(psi)
    axes[:, 2, 2] = 1.0
    return axes
