"""Inertial measurement unit: true increments in, increments of a real unit out.

Chain, tick by tick: lever arm -> engine vibration -> bandwidth -> mounting, misalignment, scale factor and its
asymmetry, g-sensitivity -> summed over the output interval, or sampled at its end -> biases and noise -> range ->
resolution -> stamps and losses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import Field, model_validator
from scipy.linalg import expm

from nav.rotation import dcm_from_quat, quat_from_euler
from nav.samples import Array, ImuSamples
from testbed.motion.table import TruthBlock
from testbed.noise import Process, stream
from testbed.schema import Section
from testbed.sensors.delivery import InertialDelivery, latest
from testbed.sensors.grades import with_grade
from testbed.sensors.imu_grades import GRADES
from testbed.sensors.increments import accumulate, degrade
from testbed.sensors.timing import ticks_per_sample
from testbed.sensors.units import (
    DEG,
    DEG_PER_H,
    DEG_PER_H_PER_ROOT_H,
    DEG_PER_ROOT_H,
    MG,
    MG_PER_ROOT_H,
    MPS_PER_ROOT_H,
    MRAD,
    PERCENT,
    PPM,
    G,
    LeverArm,
)

Angle: TypeAlias = Annotated[float, Field(ge=-360, le=360)]

# A Gauss-Markov process of standard deviation sigma and correlation time tau has the Allan deviation
# sigma sqrt(2 tau/T (1 - tau/(2 T) (3 - 4 exp(-T/tau) + exp(-2 T/tau)))) (IEEE Std 952, annex C), flat around its
# maximum of 0.6174 sigma at T = 1.89 tau. A datasheet's in-run instability is the height of that flat region.
ALLAN_PEAK = 0.6174
VIBRATION_RPM = 6000.0  # the engine speed at which the vibration keys hold; imbalance forces grow with its square
SECOND_HARMONIC = 0.5  # amplitude of the tone at two per rev over that at one per rev


@dataclass(frozen=True, slots=True)
class ImuErrors:
    """The unit's datasheet in SI: what an estimator may be told. All sizes are 1 sigma per axis.

    Random walks: ``gyro_noise`` [rad/sqrt(s)], ``accel_noise`` [m/s/sqrt(s)]; ``*_vibration`` what an engine adds to
    them. Biases: ``*_turn_on`` constant of a run, ``*_in_run`` Gauss-Markov with correlation time ``*_in_run_tau`` [s],
    ``*_random_walk`` per sqrt(s), all
    in rad/s and m/s^2. ``*_scale`` and ``*_scale_asymmetry`` [1], ``*_misalignment`` and ``*_nonorthogonality`` [rad],
    ``gyro_g_sensitivity`` [rad/s per m/s^2], ``*_temperature`` per kelvin. ``*_motion`` and ``vibration_share`` are
    what filters are told of noise that follows motion (`nav.error_model.ImuModel`). ``lever_arm_b`` (3,) [m] from the
    centre of gravity, ``C_sb`` (3, 3) from body axes to the axes of the unit.
    """

    gyro_noise: float
    gyro_vibration: float
    gyro_turn_on: float
    gyro_in_run: float
    gyro_in_run_tau: float
    gyro_random_walk: float
    gyro_scale: float
    gyro_scale_asymmetry: float
    gyro_misalignment: float
    gyro_nonorthogonality: float
    gyro_g_sensitivity: float
    gyro_temperature: float
    accel_noise: float
    accel_vibration: float
    accel_turn_on: float
    accel_in_run: float
    accel_in_run_tau: float
    accel_random_walk: float
    accel_scale: float
    accel_scale_asymmetry: float
    accel_misalignment: float
    accel_nonorthogonality: float
    accel_temperature: float
    gyro_motion: float
    accel_motion: float
    vibration_share: float
    lever_arm_b: Array
    C_sb: Array


class ImuConfig(Section):
    """Keys of an inertial unit. ``grade`` sets all the others; each may be given to override the datasheet.

    Errors are 1 sigma per axis. Units end the names: degph deg/h, degprth deg/sqrt(h), degphprth deg/h/sqrt(h),
    mpsprth m/s/sqrt(h), mgprth mg/sqrt(h), degphpk deg/h/K, degphpg deg/h/g,
    degphpg2 deg/h/g^2, mgpg2 mg/g^2.
    """

    kind: Literal["imu"] = Field(default="imu", description="what the sensor is; the table's name where it is left out")
    grade: Literal["perfect", "navigation", "tactical", "mems-industrial", "mems-consumer", "mems-hobby"] = Field(
        default="mems-consumer", description="datasheet that presets every error below"
    )
    rate_hz: float = Field(200.0, ge=5, le=10_000, description="increments per second; divides the tick rate")
    turn_on: Literal["drawn", "exact"] = Field(
        "drawn", description="drawn from their sigma, or exactly as large as it, with only the signs drawn"
    )

    output: Literal["integrated", "sampled"] = Field(
        "integrated", description="sums over the interval, or its last value, in which faster vibration folds down"
    )
    jitter_s: float = Field(
        0.0, ge=0, le=1, description="how late increments are stamped: half-normal, by less than a period"
    )
    dropout_percent: float = Field(
        0.0, ge=0, le=50, description="of the increments that are lost: the last rates are read again for them"
    )

    gyro_turn_on_degph: float = Field(0.0, ge=0, le=1e5, description="constant bias of a run")
    gyro_instability_degph: float = Field(
        0.0, ge=0, le=1e4, description="in-run bias instability: the floor of the Allan deviation"
    )
    gyro_instability_tau_s: float = Field(200.0, gt=0, le=1e6, description="correlation time of the in-run bias")
    angle_random_walk_degprth: float = Field(0.0, ge=0, le=1e3, description="white noise of the rate")
    gyro_rate_random_walk_degphprth: float = Field(0.0, ge=0, le=1e4, description="random walk of the bias")
    gyro_scale_ppm: float = Field(0.0, ge=0, le=1e5, description="scale factor error")
    gyro_scale_asymmetry_ppm: float = Field(
        0.0, ge=0, le=1e5, description="difference of the scale factor between positive and negative rates"
    )
    gyro_misalignment_mrad: float = Field(
        0.0, ge=0, le=100, description="of the triad as a whole to the axes of the unit"
    )
    gyro_nonorthogonality_mrad: float = Field(0.0, ge=0, le=100, description="of the axes to each other")
    gyro_g_sensitivity_degphpg: float = Field(0.0, ge=0, le=1e4, description="bias per specific force")
    gyro_temperature_degphpk: float = Field(0.0, ge=0, le=1e3, description="bias per kelvin of warming up")
    gyro_range_degps: float | None = Field(None, gt=0, le=1e5, description="largest rate; none: no limit")
    gyro_resolution_degps: float = Field(0.0, ge=0, le=100, description="least step of the output; 0: none")
    gyro_bandwidth_hz: float | None = Field(None, gt=0, le=1e5, description="of the low-pass filter; none: no filter")

    accel_turn_on_mg: float = Field(0.0, ge=0, le=1e3, description="constant bias of a run")
    accel_instability_mg: float = Field(
        0.0, ge=0, le=1e3, description="in-run bias instability: the floor of the Allan deviation"
    )
    accel_instability_tau_s: float = Field(200.0, gt=0, le=1e6, description="correlation time of the in-run bias")
    velocity_random_walk_mpsprth: float = Field(0.0, ge=0, le=1e3, description="white noise of the specific force")
    accel_random_walk_mgprth: float = Field(0.0, ge=0, le=1e3, description="random walk of the bias")
    accel_scale_ppm: float = Field(0.0, ge=0, le=1e5, description="scale factor error")
    accel_scale_asymmetry_ppm: float = Field(
        0.0, ge=0, le=1e5, description="difference of the scale factor between positive and negative forces"
    )
    accel_misalignment_mrad: float = Field(
        0.0, ge=0, le=100, description="of the triad as a whole to the axes of the unit"
    )
    accel_nonorthogonality_mrad: float = Field(0.0, ge=0, le=100, description="of the axes to each other")
    accel_temperature_mgpk: float = Field(0.0, ge=0, le=100, description="bias per kelvin of warming up")
    accel_range_g: float | None = Field(None, gt=0, le=1e4, description="largest specific force; none: no limit")
    accel_resolution_mg: float = Field(0.0, ge=0, le=1e3, description="least step of the output; 0: none")
    accel_bandwidth_hz: float | None = Field(None, gt=0, le=1e5, description="of the low-pass filter; none: no filter")

    vibration_mg: float = Field(
        0.0, ge=0, le=1e5, description="engine vibration of the specific force: amplitude at one per rev and 6000 rpm"
    )
    vibration_degps: float = Field(
        0.0, ge=0, le=1e4, description="engine vibration of the rate: amplitude at one per rev and 6000 rpm"
    )
    gyro_vibration_degprth: float = Field(
        0.0, ge=0, le=1e3, description="white noise of the rate that the engine adds, at 6000 rpm; told to filters"
    )
    accel_vibration_mpsprth: float = Field(
        0.0, ge=0, le=1e3, description="the same of the specific force; both grow with the square of the engine speed"
    )
    gyro_rectification_degphpg2: float = Field(
        0.0, ge=0, le=1e6, description="bias that vibration makes, per mean square of its specific force"
    )
    accel_rectification_mgpg2: float = Field(0.0, ge=0, le=1e6, description="the same of the specific force")
    gyro_motion_percent: float = Field(
        0.0, ge=0, le=100, description="told to filters: of the rate, what goes wrong in each second of a manoeuvre"
    )
    accel_motion_percent: float = Field(
        0.0, ge=0, le=100, description="told to filters: the same of the specific force less gravity"
    )
    vibration_percent: float = Field(
        0.0, ge=0, le=1000, description="told to filters: of the noise that the increments show, what they expect"
    )
    self_heating_k: float = Field(0.0, ge=0, le=100, description="how much the unit warms up after power-on")
    self_heating_tau_s: float = Field(300.0, gt=0, le=1e5, description="time constant of warming up")

    lever_arm_m: LeverArm = Field(
        (0.0, 0.0, 0.0), description="from the centre of gravity to the unit, forward, right, down"
    )
    mounting_deg: tuple[Angle, Angle, Angle] = Field(
        (0.0, 0.0, 0.0), description="roll, pitch and heading of the unit in the aircraft"
    )

    @model_validator(mode="before")
    @classmethod
    def _on_top_of_grade(cls, data: Any) -> Any:
        return with_grade(data, GRADES, "mems-consumer")

    @property
    def longest_s(self) -> float:
        """The longest time between two increments [s]."""
        return 1 / self.rate_hz + latest(self.jitter_s, 1 / self.rate_hz)

    def errors(self) -> ImuErrors:
        """The same in SI."""
        roll, pitch, heading = (float(a) * DEG for a in self.mounting_deg)
        return ImuErrors(
            gyro_noise=self.angle_random_walk_degprth * DEG_PER_ROOT_H,
            gyro_vibration=self.gyro_vibration_degprth * DEG_PER_ROOT_H,
            gyro_turn_on=self.gyro_turn_on_degph * DEG_PER_H,
            gyro_in_run=self.gyro_instability_degph * DEG_PER_H / ALLAN_PEAK,
            gyro_in_run_tau=self.gyro_instability_tau_s,
            gyro_random_walk=self.gyro_rate_random_walk_degphprth * DEG_PER_H_PER_ROOT_H,
            gyro_scale=self.gyro_scale_ppm * PPM,
            gyro_scale_asymmetry=self.gyro_scale_asymmetry_ppm * PPM,
            gyro_misalignment=self.gyro_misalignment_mrad * MRAD,
            gyro_nonorthogonality=self.gyro_nonorthogonality_mrad * MRAD,
            gyro_g_sensitivity=self.gyro_g_sensitivity_degphpg * DEG_PER_H / G,
            gyro_temperature=self.gyro_temperature_degphpk * DEG_PER_H,
            accel_noise=self.velocity_random_walk_mpsprth * MPS_PER_ROOT_H,
            accel_vibration=self.accel_vibration_mpsprth * MPS_PER_ROOT_H,
            accel_turn_on=self.accel_turn_on_mg * MG,
            accel_in_run=self.accel_instability_mg * MG / ALLAN_PEAK,
            accel_in_run_tau=self.accel_instability_tau_s,
            accel_random_walk=self.accel_random_walk_mgprth * MG_PER_ROOT_H,
            accel_scale=self.accel_scale_ppm * PPM,
            accel_scale_asymmetry=self.accel_scale_asymmetry_ppm * PPM,
            accel_misalignment=self.accel_misalignment_mrad * MRAD,
            accel_nonorthogonality=self.accel_nonorthogonality_mrad * MRAD,
            accel_temperature=self.accel_temperature_mgpk * MG,
            gyro_motion=self.gyro_motion_percent * PERCENT,
            accel_motion=self.accel_motion_percent * PERCENT,
            vibration_share=self.vibration_percent * PERCENT,
            lever_arm_b=np.array(self.lever_arm_m, dtype=float),
            C_sb=dcm_from_quat(quat_from_euler(roll, pitch, heading)).T.copy(),
        )


class Imu:
    """One unit on one run: its turn-on errors are drawn here, its in-run errors as it senses.

    ``sense`` is called with consecutive truth blocks of any length. Raises UserError when the rate does not divide the
    tick rate.
    """

    def __init__(self, name: str, config: ImuConfig, tick_rate_hz: float, seed: int) -> None:
        self.name = name
        self.rate_hz = config.rate_hz
        self.errors = config.errors()
        self._every = ticks_per_sample(name, config.rate_hz, tick_rate_hz)
        self._dt = self._every / tick_rate_hz
        self._tick_s = 1 / tick_rate_hz
        self._delivery = InertialDelivery(name, config.dropout_percent, config.jitter_s, self._dt, seed)
        self._draw_constants(config, seed)
        self._start_processes(seed)
        self._self_heating = (config.self_heating_k, config.self_heating_tau_s)
        self._temperature_at_start = math.nan
        bandwidths = (config.gyro_bandwidth_hz, config.accel_bandwidth_hz)
        self._filter = np.stack([_low_pass(bandwidth, self._tick_s) for bandwidth in bandwidths])
        self._bandwidth = np.array([bandwidth or np.inf for bandwidth in bandwidths])
        self._sampled = config.output == "sampled"
        self._limit = np.repeat([(config.gyro_range_degps or np.inf) * DEG, (config.accel_range_g or np.inf) * G], 3)
        self._resolution = np.repeat([config.gyro_resolution_degps * DEG, config.accel_resolution_mg * MG], 3)
        # Carried from tick to tick: filter states, sum of the running interval, last rate and engine phase.
        self._filter_state = np.zeros((6, 2))
        self._sum = np.zeros(6)
        self._last = np.zeros(4)
        self._bias = np.zeros(6)

    def _draw_constants(self, config: ImuConfig, seed: int) -> None:
        def draw(process: str, n: int) -> Array:
            return stream(seed, self.name, process).standard_normal(n)

        e = self.errors
        turn_on = draw("turn-on", 6)
        if config.turn_on == "exact":
            turn_on = np.sign(turn_on)
        self._turn_on = turn_on * np.repeat([e.gyro_turn_on, e.accel_turn_on], 3)
        self._temperature_slope = draw("temperature", 6) * np.repeat([e.gyro_temperature, e.accel_temperature], 3)
        # One scale is more by half of the difference, the other less.
        half = 0.5 * np.repeat([e.gyro_scale_asymmetry, e.accel_scale_asymmetry], 3)
        self._asymmetry = draw("scale asymmetry", 6) * half
        scale = draw("scale", 6) * np.repeat([e.gyro_scale, e.accel_scale], 3)
        misalignment = draw("misalignment", 6) * np.repeat([e.gyro_misalignment, e.accel_misalignment], 3)
        skewness = draw("non-orthogonality", 6) * np.repeat([e.gyro_nonorthogonality, e.accel_nonorthogonality], 3)
        self._sensitivity = np.stack(
            [
                (np.eye(3) + _axis_errors(scale[i : i + 3], misalignment[i : i + 3], skewness[i : i + 3])) @ e.C_sb
                for i in (0, 3)
            ]
        )
        self._g_sensitivity = draw("g-sensitivity", 9).reshape(3, 3) * e.gyro_g_sensitivity @ e.C_sb
        amplitude = np.repeat([config.vibration_degps * DEG, config.vibration_mg * MG], 3) / VIBRATION_RPM**2
        phase = stream(seed, self.name, "vibration").uniform(0, 2 * math.pi, (2, 6))
        harmonics = amplitude * np.array([[1.0], [SECOND_HARMONIC]])
        self._vibration = np.stack([harmonics * np.cos(phase), harmonics * np.sin(phase)], axis=-1)
        square = (
            0.5 * np.sum(harmonics[:, 3:] ** 2, axis=0) / G**2
        )  # of each axis, per fourth power of the engine speed
        per_square = np.repeat(
            [config.gyro_rectification_degphpg2 * DEG_PER_H, config.accel_rectification_mgpg2 * MG], 3
        )
        self._rectified = draw("rectification", 6) * per_square * np.concatenate([np.repeat(square.sum(), 3), square])

    def _start_processes(self, seed: int) -> None:
        def per_axis(gyro: float, accel: float) -> Array:
            return np.repeat([gyro, accel], 3)

        e, dt = self.errors, self._dt
        self._white = Process.white(
            stream(seed, self.name, "white"), per_axis(e.gyro_noise, e.accel_noise) / math.sqrt(dt)
        )
        shaken = per_axis(e.gyro_vibration, e.accel_vibration) / math.sqrt(dt)
        self._shaken = Process.white(stream(seed, self.name, "vibration noise"), shaken) if shaken.any() else None
        self._in_run = Process.gauss_markov(
            stream(seed, self.name, "in-run"),
            per_axis(e.gyro_in_run, e.accel_in_run),
            per_axis(e.gyro_in_run_tau, e.accel_in_run_tau),
            dt,
        )
        self._walk = Process.random_walk(
            stream(seed, self.name, "random walk"), per_axis(e.gyro_random_walk, e.accel_random_walk), dt
        )

    @property
    def bias(self) -> tuple[Array, Array]:
        """(gyro (3,) [rad/s], accel (3,) [m/s^2]): additive bias of the newest sample, all terms but white noise."""
        return self._bias[:3].copy(), self._bias[3:].copy()

    def sense(self, truth: TruthBlock) -> ImuSamples:
        """The increments whose intervals end inside this block, in the axes of the unit."""
        if math.isnan(self._temperature_at_start) and len(truth):
            self._temperature_at_start = float(truth.temperature[0])
        first = max(truth.tick, 1)  # row 0 of a run carries no increments
        start = -first % self._every + first - truth.tick
        t = truth.t[start :: self._every].copy()
        n = len(t)
        exact = np.empty((n, 6))
        accumulate(
            truth.tick,
            self._every,
            self._tick_s,
            truth.dtheta,
            truth.dv,
            truth.omega_b,
            truth.engine_rpm,
            self.errors.lever_arm_b,
            self._vibration,
            self._rectified,
            self._filter,
            self._bandwidth,
            self._sampled,
            self._sensitivity,
            self._g_sensitivity,
            self._asymmetry,
            self._filter_state,
            self._sum,
            self._last,
            exact,
        )
        bias = self._in_run.take(n)
        bias += self._walk.take(n)
        white = self._white.take(n)
        if self._shaken is not None:
            white += self._shaken.take(n) * (truth.engine_rpm[start :: self._every, None] / VIBRATION_RPM) ** 2
        warmer = truth.temperature[start :: self._every] - self._temperature_at_start
        dtheta, dv = np.empty((n, 3)), np.empty((n, 3))
        degrade(
            self._dt,
            t,
            exact,
            self._turn_on,
            bias,
            self._temperature_slope,
            warmer,
            *self._self_heating,
            white,
            self._limit,
            self._resolution,
            dtheta,
            dv,
        )
        if n:
            self._bias = bias[-1]
        measured = ImuSamples(t, np.full(n, self._dt), dtheta, dv)
        return self._delivery.of(measured, float(truth.t[-1])) if len(truth) else measured


def _axis_errors(scale: Array, misalignment: Array, skewness: Array) -> Array:
    """Scale on the diagonal, a small rotation of the triad, and y and z axes that lean towards the earlier ones."""
    mx, my, mz = misalignment
    errors: Array = np.diag(scale) + np.array([[0.0, mz, -my], [-mz, 0.0, mx], [my, -mx, 0.0]])
    errors[1, 0] += skewness[0]
    errors[2, 0] += skewness[1]
    errors[2, 1] += skewness[2]
    return errors


def _low_pass(bandwidth_hz: float | None, dt: float) -> Array:
    """Second-order Butterworth low-pass over one tick: (3, 3) map of [state (2), input] to [new state, average output].

    Exact for an input that is constant over the tick; unit gain at rest, -3 dB at the bandwidth. The third row gives
    the output averaged over the tick, which is what an integrating sensor sees.
    """
    if bandwidth_hz is None:
        return np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    w = 2 * math.pi * bandwidth_hz
    # states: output y, its derivative over w, the input, and the integral of y
    A = np.zeros((4, 4))
    A[0, 1] = w
    A[1] = [-w, -math.sqrt(2) * w, w, 0.0]
    A[3, 0] = 1.0
    step = expm(A * dt)
    over_tick: Array = np.array([step[0, :3], step[1, :3], step[3, :3] / dt])
    return over_tick
