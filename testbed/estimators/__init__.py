"""From scenario sections to estimators: what each filter is told of the sensors it is given.

A filter knows the datasheets, never the errors that were drawn from them. Terms that it has no state for
(g-sensitivity, temperature, misalignment, mostly scale factors too) widen the bias that it does estimate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from nav.ahrs import Ahrs, AhrsConfig
from nav.alignment import InitialState
from nav.detection import (
    ChiSquare,
    Detector,
    Eraim,
    Glr,
    Mean,
    Never,
    Reset,
    Sprt,
    WindowMean,
    eq20,
    exponential,
    plain,
)
from nav.earth import STANDARD_GRAVITY, radii, wrap_longitude
from nav.error_model import ImuModel
from nav.federated import Config, Federated, Local
from nav.horizon import FusionHorizon
from nav.ins import AIDS as INS_AIDS
from nav.ins import Ins, InsConfig
from nav.local_filter import Aid, BodyVelocityAid, Course, Policy, PositionFixAid, StarAid, Watched
from nav.motion import LowDynamics
from nav.rotation import quat_from_rotvec, quat_multiply, quat_rotate
from nav.samples import Array, Estimate, ImuSamples, Sample, UpdateReport
from nav.unscented import Scaling
from nav.voting import Voter
from nav.weighting import Fading, MahalanobisInflation, SageHusa
from testbed.motion.table import TruthBlock
from testbed.scenario import CourseConfig, DetectorConfig, EstimatorConfig, ImuStates, PolicyConfig, Scenario
from testbed.sensors import SensorConfig, geomagnetic_field_n
from testbed.sensors.airspeed import REFERENCE_EAS, AirspeedConfig
from testbed.sensors.barometer import BarometerConfig
from testbed.sensors.body_velocity import BodyVelocityConfig
from testbed.sensors.gnss import GnssConfig
from testbed.sensors.imu import ImuConfig, ImuErrors
from testbed.sensors.magnetometer import MagnetometerConfig
from testbed.sensors.noise import stream
from testbed.sensors.position_fix import PositionFixConfig
from testbed.sensors.star_tracker import StarTrackerConfig

WARM_UP_K = 10.0  # how far the unit may be from the temperature it was calibrated at
TURN_RATE = 0.06  # of a usual turn of this aircraft [rad/s]
LOAD_CHANGE = 0.1  # and the change of its load factor
MANOEUVRE_S = 120.0  # between changes of these
METRES_PER_PASCAL = 1 / 12.0  # of pressure altitude near the ground
FIELD_SIZE = 5e-5  # of the geomagnetic field at middle latitudes [T]
FIELD_ERROR = 1.4e-7  # of the model of it [T]: `geomagnetic_field_n`
PAYLOAD_CURRENT = 2.0  # the current that wiring carries in flight [A]
SOFT_IRON_SHARE = 0.5  # of soft iron's field in each of: body axes, n axes, neither
GUST_TIME_S = 12.0  # 300 m, the length of gusts at the height of 300 m (MIL-F-8785C), at 25 m/s
SHORT_GUSTS = 0.15  # of the gusts, what is faster than that
WIND_WALK = 0.015  # change of the mean wind [m/s/sqrt(s)]: 1 m/s in 75 min
SIDESLIP = 0.15  # of a coordinated flight in calm air [m/s]
VOTED_OUT, DISAGREE = "voted out", "the units left disagree"
SNAPSHOT_FALSE_ALARM, GATHERED_FALSE_ALARM = 1e-3, 1e-6  # per look, of detectors of one look and of many
LEVELLING_FORCE = 0.3  # what light turbulence leaves of a second's mean horizontal specific force [m/s^2]
IRON_TURN_S = 15.0  # how long iron pulls the heading the same way, turning at TURN_RATE: so much more than noise
GNSS_LOOKS = ("gnss_position", "gnss_velocity", "gnss_course")
NEVER_LEVEL = LowDynamics(roll_rate_limit=-1.0)
LEVEL_BANK = math.radians(5.0)  # commanded; a straight in light turbulence takes 2.5 (99 % of the time)


class Tracked(NamedTuple):
    """What an estimator integrated, its reports on redundant units and on samples, and its estimates."""

    increments: ImuSamples
    votes: list[UpdateReport]
    reports: list[UpdateReport]
    estimates: list[Estimate]


@dataclass
class FlightControl:
    """Tells an AHRS when its autopilot commands level flight: no turn, no climb, no change of speed.

    An autopilot knows its own commands, so they are no truth. `LEVEL_BANK` is what keeping a straight course in gusts
    takes.
    """

    ahrs: Ahrs
    _held: Array = field(default_factory=lambda: np.full(2, np.nan))  # last commanded altitude [m] and airspeed [m/s]

    def tell(self, truth: TruthBlock) -> None:
        """Pass on what is in effect over the intervals that end at these rows."""
        bank, held = truth.commands[:, 0], truth.commands[:, 1:]
        before = np.vstack([self._held, held[:-1]])
        moved = (held != before) & ~np.isnan(before)
        self._held = held[-1].copy()
        self.ahrs.flight_control(truth.t, (np.abs(bank) <= LEVEL_BANK) & ~moved.any(axis=1))


@dataclass(frozen=True, slots=True)
class Running:
    """An estimator behind its fusion horizon: the IMUs it integrates, the sensors whose samples it is handed.

    ``imus`` has how each IMU is mounted, C_sb (3, 3), by name; of several the ``voter`` makes one. The estimate is of
    the point where the first sits. ``flight_control`` is for one that listens to the autopilot.
    """

    horizon: FusionHorizon
    imus: Mapping[str, Array]
    sensors: tuple[str, ...]
    handover: Handover | None = None
    voter: Voter | None = None
    flight_control: FlightControl | None = None

    def begin(self, truth: TruthBlock) -> None:
        """Hand over the first row of ``truth`` where that is how it starts."""
        if self.handover is not None:
            self.handover.take_over(truth)

    def track(
        self, truth: TruthBlock, imu: Mapping[str, ImuSamples], samples: Mapping[str, Sequence[Sample]],
        times: Sequence[float],
    ) -> Tracked:  # fmt: skip
        """Give it what the sensors delivered over the rows of ``truth``, of which it gets the commands alone.

        ``times`` [s] are those at which estimates are wanted.
        """
        if self.flight_control is not None:
            self.flight_control.tell(truth)
        increments, votes = self.increments(imu)
        handed = [sample for aid in self.sensors for sample in samples[aid]]
        reports, estimates = self.horizon.track(increments, handed, times)
        return Tracked(increments, votes, reports, estimates)

    @property
    def imu(self) -> str:
        """The first IMU."""
        return next(iter(self.imus))

    def increments(self, imu: Mapping[str, ImuSamples]) -> tuple[ImuSamples, list[UpdateReport]]:
        """What to integrate, in body axes, from the increments of each IMU; and on each unit of several what was voted.

        A report's nis is the unit's parity statistic; its weight is 0 while the unit is voted out.
        """
        turned = [
            replace(imu[name], dtheta=_turned_back(C_sb, imu[name].dtheta), dv=_turned_back(C_sb, imu[name].dv))
            for name, C_sb in self.imus.items()
        ]
        if self.voter is None:
            return turned[0], []
        used, ballots = self.voter.vote(turned)
        none = np.empty(0)
        return used, [
            UpdateReport(
                ballot.t, name, "imu_parity", none, none.reshape(0, 0), float(statistic), ballot.threshold,
                0.0 if failed else 1.0, VOTED_OUT if failed else DISAGREE if ballot.ambiguous else "",
            )
            for ballot in ballots
            for name, statistic, failed in zip(self.imus, ballot.statistic, ballot.failed, strict=True)
        ]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Handover:
    """A start by somebody else's navigation: truth where the IMU sits, plus errors.

    ``arm_b`` (3,) [m] points from the centre of gravity to the IMU; ``sigma`` (9,) is of attitude [rad], velocity [m/s]
    and position [m], NED; the errors are drawn from ``random``.
    """

    estimator: Ins | Federated
    arm_b: Array
    sigma: Array
    random: np.random.Generator

    def take_over(self, truth: TruthBlock) -> None:
        """Start the estimator at the first row of ``truth``."""
        phi, v_error, p_error = (self.sigma * self.random.standard_normal(len(self.sigma))).reshape(3, 3)
        true_q = truth.q_nb[0]
        v_n = truth.v_n[0] + quat_rotate(true_q, np.cross(truth.omega_b[0], self.arm_b)) + v_error
        north, east, down = quat_rotate(true_q, self.arm_b) + p_error
        lat, lon, h = float(truth.lat[0]), float(truth.lon[0]), float(truth.h[0])
        R_M, R_N = radii(lat)
        # C_nb_hat = (I - [phi x]) C_nb
        q_nb = quat_multiply(quat_from_rotvec(-phi), true_q)
        initial = InitialState(
            float(truth.t[0]), lat + north / (R_M + h), wrap_longitude(lon + east / ((R_N + h) * math.cos(lat))),
            h - down, v_n, q_nb, np.diag(self.sigma**2),
        )  # fmt: skip
        self.estimator.start(initial)


def _imus(config: EstimatorConfig, scenario: Scenario) -> tuple[dict[str, Array], Voter | None]:
    """How the IMUs are mounted, and who votes where there are several."""
    sections = {name: scenario.sensors[name] for name in (config.imu, *config.spare_imus)}
    errors = {name: section.errors() for name, section in sections.items() if isinstance(section, ImuConfig)}
    mountings = {name: e.C_sb for name, e in errors.items()}
    if not config.spare_imus:
        return mountings, None
    e = errors[config.imu]
    turn = math.hypot(e.gyro_misalignment, e.gyro_nonorthogonality, e.gyro_scale)
    level = math.hypot(e.accel_misalignment, e.accel_nonorthogonality, e.accel_scale)
    return mountings, Voter(imu_model(e), turn, level)


def _handover(config: EstimatorConfig, estimator: Ins | Federated, imu: ImuErrors, seed: int) -> Handover | None:
    given = config.handover
    if given is None:
        return None
    level, heading = math.radians(given.level_deg), math.radians(given.heading_deg)
    sigma = np.array([level, level, heading, *[given.velocity_mps] * 3, *[given.position_m] * 3])
    return Handover(estimator, imu.lever_arm_b, sigma, stream(seed, config.name, "handover"))


def _turned_back(C_sb: Array, x_s: Array) -> Array:
    """C_sb' x of each row; written out, since the sums of a matrix product depend on the number of rows."""
    with np.errstate(all="ignore"):  # a broken unit may say anything
        x_b: Array = x_s[:, 0:1] * C_sb[0] + x_s[:, 1:2] * C_sb[1] + x_s[:, 2:3] * C_sb[2]
    return x_b


def build(scenario: Scenario, seed: int) -> dict[str, Running]:
    """The scenario's estimators by name, not yet aligned; ``seed`` is that of the run."""
    kinds = {"ins": _ins, "federated": _federated, "ahrs": _ahrs}
    return {config.name: kinds[config.kind](config, scenario, seed) for config in scenario.estimator}


def imu_model(errors: ImuErrors, turn_rate: float = TURN_RATE, states: ImuStates = "biases") -> ImuModel:
    """The datasheet as the filter's error model; ``turn_rate`` [rad/s] is the usual one.

    Misalignment and g-sensitivity make a bias that changes with every manoeuvre: a random walk. Of the gyros it is as
    large as a turn makes it; of the accelerometers as a change of load does, `LOAD_CHANGE`. In turns slower than
    `TURN_RATE` the load changes by less, with the square of their rate: n^2 = 1 + (v turn_rate / g)^2.

    With ``states`` "biases" scale factors do so too, and in-run instability (Gauss-Markov, sigma and tau) becomes a
    random walk of the same driving noise, q = sigma sqrt(2 / tau), beside the rate random walk: over minutes the two
    cannot be told apart. With "full" both are states of their own (Cui et al. 2022, Eq 36).
    """
    full = states == "full"
    beside = replace(errors, gyro_in_run=0.0, accel_in_run=0.0, gyro_scale=0.0, accel_scale=0.0) if full else errors
    level = math.hypot(beside.accel_misalignment, beside.accel_nonorthogonality, beside.accel_scale)
    turn = math.hypot(beside.gyro_misalignment, beside.gyro_nonorthogonality, beside.gyro_scale)
    pull = beside.gyro_g_sensitivity * STANDARD_GRAVITY
    changes = math.sqrt(1 / MANOEUVRE_S)
    load_change = LOAD_CHANGE * min(1.0, turn_rate / TURN_RATE) ** 2
    return ImuModel(
        gyro_noise=beside.gyro_noise,
        accel_noise=beside.accel_noise,
        gyro_bias_sigma=math.hypot(
            beside.gyro_turn_on, beside.gyro_in_run, beside.gyro_temperature * WARM_UP_K, pull, turn * turn_rate
        ),
        accel_bias_sigma=math.hypot(
            beside.accel_turn_on, beside.accel_in_run, beside.accel_temperature * WARM_UP_K, level * STANDARD_GRAVITY
        ),
        gyro_bias_walk=math.hypot(
            beside.gyro_random_walk,
            _drive(beside.gyro_in_run, beside.gyro_in_run_tau),
            turn * turn_rate * changes,
            pull * load_change * changes,
        ),
        accel_bias_walk=math.hypot(
            beside.accel_random_walk,
            _drive(beside.accel_in_run, beside.accel_in_run_tau),
            level * STANDARD_GRAVITY * load_change * changes,
        ),
        gyro_drift_sigma=errors.gyro_in_run if full else 0.0,
        accel_drift_sigma=errors.accel_in_run if full else 0.0,
        gyro_drift_correlation_s=errors.gyro_in_run_tau,
        accel_drift_correlation_s=errors.accel_in_run_tau,
        gyro_scale_sigma=errors.gyro_scale if full else 0.0,
        accel_scale_sigma=errors.accel_scale if full else 0.0,
    )


def _drive(sigma: float, tau: float) -> float:
    return sigma * math.sqrt(2 / tau)


def _ins(config: EstimatorConfig, scenario: Scenario, seed: int) -> Running:
    imu = scenario.sensors[config.imu]
    assert isinstance(imu, ImuConfig)  # the scenario was checked
    # One sensor of a kind: an aid, or the first in the file, whose samples then serve the alignment only.
    offered = {scenario.sensors[name].kind: name for name in config.aids if scenario.sensors[name].kind in INS_AIDS}
    aids = tuple(offered)
    for name, section in scenario.sensors.items():
        if section.kind in INS_AIDS:
            offered.setdefault(section.kind, name)
    kinds: Mapping[str, SensorConfig] = {kind: scenario.sensors[name] for kind, name in offered.items()}
    errors = imu.errors()
    told = _told(kinds, errors, config.gust_mps)
    if config.course is not None:
        # With the wind, course says what the constraint of no sideslip says: both would count it twice.
        slip = told.pop("sideslip_sigma", 0.0) if "airspeed" in aids else 0.0
        told |= {"course": _course(config.course, slip), "sideslip_sigma": None}
    others = {name: _other(name, scenario.sensors[name], config, errors) for name in config.aids}
    learning = config.sage_husa
    fading = config.fading
    ins = Ins(
        InsConfig(
            imu_model(errors, math.radians(config.turn_degps), config.states),
            aids,
            tuple(aid for aid in others.values() if aid is not None),
            mounting_sigma=errors.accel_misalignment,
            scaling=_scaling(config.engine),
            false_rejection=config.false_rejection,
            **told,  # type: ignore[arg-type]
        ),
        partial(geomagnetic_field_n, date=scenario.date),
        {part: SageHusa(learning.b) for part in GNSS_LOOKS} if learning else None,
        {part: Fading(fading.window, fading.alpha) for part in fading.looks} if fading else None,
    )
    used = dict.fromkeys((*offered.values(), *(name for name, aid in others.items() if aid is not None)))
    imus, voter = _imus(config, scenario)
    return Running(
        FusionHorizon(ins, _lag_s(scenario, used), coning=imu.rate_hz < scenario.truth.rate_hz),
        imus,
        tuple(used),
        _handover(config, ins, errors, seed),
        voter,
    )


def _scaling(engine: str) -> Scaling | None:
    """How far out the sigma points of an engine lie, None when it has none."""
    return Scaling() if engine == "unscented" else None


def _course(config: CourseConfig, slip: object) -> Course:
    """Course with the slip [m/s] that the constraint of no sideslip would be told, none on a road."""
    assert isinstance(slip, float)
    limit = math.inf if config.max_turn_rate_degps is None else math.radians(config.max_turn_rate_degps)
    return Course(limit, config.quiet_s, slip)


def _lag_s(scenario: Scenario, names: Iterable[str]) -> float:
    """The largest latency of the aids of these names [s]."""
    sections = [scenario.sensors[name] for name in names]
    return max((section.latency_s for section in sections if not isinstance(section, ImuConfig)), default=0.0)


def _other(name: str, section: SensorConfig, config: EstimatorConfig, imu: ImuErrors) -> Aid | None:
    """An aid of which a filter may have several, None for a sensor of any other kind.

    What they measure is of the centre of gravity.
    """
    arm_b: tuple[float, float, float] = tuple(0.0 - imu.lever_arm_b)
    match section:
        case BodyVelocityConfig():
            v = section.errors()
            return BodyVelocityAid(name, v.axes, v.noise, v.scale, v.correlated, v.tau, config.nonholonomic_mps, arm_b)
        case StarTrackerConfig():
            return StarAid(name, tuple(section.errors().noise_b))
        case PositionFixConfig():
            p = section.errors()
            return PositionFixAid(name, tuple(p.position_n), p.height, arm_b)
    return None


def _told(kinds: Mapping[str, SensorConfig], imu: ImuErrors, gust_mps: float) -> dict[str, object]:
    """The keys of `InsConfig` that one sensor of each kind decides on."""
    told: dict[str, object] = {}
    gnss = kinds.get("gnss")
    if isinstance(gnss, GnssConfig):
        e = gnss.errors()
        told |= {
            "gnss_arm_b": tuple(e.lever_arm_b - imu.lever_arm_b),
            "gnss_position_error_sigma": tuple(e.position_correlated_n),
            "gnss_position_error_correlation_s": e.position_tau,
            "gnss_velocity_error_sigma": tuple(e.velocity_correlated_n),
            "gnss_velocity_error_correlation_s": e.velocity_tau,
        }
    barometer = kinds.get("barometer")
    if isinstance(barometer, BarometerConfig):
        b = barometer.errors()
        told |= {
            "barometer_sigma": b.noise * METRES_PER_PASCAL,
            "barometer_bias_walk": _drive(b.drift, b.drift_tau) * METRES_PER_PASCAL,
        }
    magnetometer = kinds.get("magnetometer")
    if isinstance(magnetometer, MagnetometerConfig):
        m = magnetometer.errors()
        told |= {
            "magnetometer_sigma": m.noise,
            "magnetometer_error_sigma": SOFT_IRON_SHARE * m.soft_iron * FIELD_SIZE,
            "magnetometer_anomaly_sigma": SOFT_IRON_SHARE * m.soft_iron * FIELD_SIZE,
            "magnetometer_bias_sigma": math.hypot(m.hard_iron, m.current * PAYLOAD_CURRENT),
        }
    airspeed = kinds.get("airspeed")
    if isinstance(airspeed, AirspeedConfig):
        a = airspeed.errors()
        told |= {
            "airspeed_sigma": math.hypot(a.noise, SHORT_GUSTS * gust_mps),
            "airspeed_scale_sigma": math.hypot(a.scale, a.bias / REFERENCE_EAS),
            "gust_sigma": gust_mps,
            "gust_correlation_s": GUST_TIME_S,
            "wind_walk": WIND_WALK,
            "sideslip_sigma": math.hypot(SIDESLIP, SHORT_GUSTS * gust_mps),
        }
    return told


def _federated(config: EstimatorConfig, scenario: Scenario, seed: int) -> Running:
    """Local filters, each told of its own sensors as an INS would be."""
    imu = scenario.sensors[config.imu]
    assert isinstance(imu, ImuConfig)  # the scenario was checked
    errors = imu.errors()

    def aid(name: str) -> Aid:
        section = scenario.sensors[name]
        other = _other(name, section, config, errors)
        if other is not None:
            return other
        told = _told({section.kind: section}, errors, config.gust_mps)
        return InsConfig(imu_model(errors), (section.kind,), **told).aid_of(section.kind, name)  # type: ignore[arg-type]

    used = dict.fromkeys(name for local in config.locals for name in local.aids)
    # Without a receiver or magnetometer among the aids, the first in the file serves the alignment.
    for kind in ("gnss", "magnetometer"):
        if all(scenario.sensors[name].kind != kind for name in used):
            used |= dict.fromkeys([name for name, s in scenario.sensors.items() if s.kind == kind][:1])
    aids = {name: aid(name) for name in used}
    local_filters = tuple(
        Local(
            local.name,
            tuple(
                Watched(aids[name], partial(_detector, local.detector), _policy(local.policy)) for name in local.aids
            ),
            local.share,
            _scaling(local.engine),
        )
        for local in config.locals
    )
    federated = Federated(
        Config(
            imu_model(errors, math.radians(config.turn_degps), config.states),
            local_filters,
            structure=config.structure,
            sharing=config.sharing,
            combination=config.combination,
            retention=config.retention,
            weighting=config.weighting,
            literal=config.literal,
            fusion_period_s=config.fusion_period_s,
            isolate_after=config.isolate_after,
            readmit_after=config.readmit_after,
            recall_s=config.recall_s,
            cross_check=config.cross_check,
            mounting_sigma=errors.accel_misalignment,
            alignment_aids=tuple(aids.values()),
        ),
        partial(geomagnetic_field_n, date=scenario.date),
    )
    imus, voter = _imus(config, scenario)
    return Running(
        FusionHorizon(federated, _lag_s(scenario, used), coning=imu.rate_hz < scenario.truth.rate_hz),
        imus,
        tuple(used),
        _handover(config, federated, errors, seed),
        voter,
    )


def _detector(config: DetectorConfig) -> Detector:
    """A detector as the scenario says. Evidence over looks is correlated: its alarms must be rarer."""
    match config.kind:
        case "chi_square":
            return ChiSquare(config.false_alarm or SNAPSHOT_FALSE_ALARM)
        case "eraim":
            return Eraim(config.false_alarm or SNAPSHOT_FALSE_ALARM)
        case "sprt":
            return Sprt(config.false_alarm or GATHERED_FALSE_ALARM, _mean(config), Reset(config.reset))
        case "glr":
            return Glr(config.false_alarm or GATHERED_FALSE_ALARM, config.window_s)
        case "none":
            return Never()


def _mean(config: DetectorConfig) -> Mean:
    """What a sequential test remembers."""
    match config.mean:
        case "plain":
            return plain()
        case "window":
            return WindowMean(config.window_s)
        case "exponential":
            return exponential(config.forgetting)
        case "eq20":
            return eq20(config.forgetting)


def _policy(config: PolicyConfig | None) -> Callable[[], Policy] | None:
    """What makes the measurement policy of a sensor, as the scenario says."""
    if config is None:
        return None
    if config.kind == "sage_husa":
        return partial(SageHusa, config.b)
    return partial(
        MahalanobisInflation, config.false_alarm, config.reject_above or math.inf, config.solver == "reciprocal"
    )


def _ahrs(config: EstimatorConfig, scenario: Scenario, seed: int) -> Running:
    """Attitude alone. It is told its area of operation, and its heading where no magnetometer finds it."""
    imu = scenario.sensors[config.imu]
    assert isinstance(imu, ImuConfig)  # the scenario was checked
    errors, site = imu.errors(), scenario.site()
    aids = {scenario.sensors[name].kind: scenario.sensors[name] for name in config.aids}
    field_n = geomagnetic_field_n(site.lat, site.lon, site.h, scenario.date)
    told: dict[str, object] = {"force_sigma": LEVELLING_FORCE}
    level = config.level
    if level is not None:
        yaw_rate, roll_rate = math.radians(level.yaw_rate_degps), math.radians(level.roll_rate_degps)
        limits = LowDynamics(level.acceleration_mps2, yaw_rate, roll_rate, level.test)
        told |= {"motion": limits, "compensated_motion": limits}
        told |= {"force_sigma": level.force_sigma_mps2, "phi_limit": math.radians(level.limit_deg)}
        told |= {"gyro_bias_feedback": level.gyro_bias_feedback}
    if not config.levelling:
        told |= {"motion": NEVER_LEVEL, "compensated_motion": NEVER_LEVEL}
    if config.heading_deg is not None:
        told |= {"heading": math.radians(config.heading_deg)}
    magnetometer = aids.get("magnetometer")
    if isinstance(magnetometer, MagnetometerConfig):
        m = magnetometer.errors()
        iron = math.hypot(SOFT_IRON_SHARE * m.soft_iron * FIELD_SIZE, m.hard_iron, m.current * PAYLOAD_CURRENT)
        lasting = math.hypot(iron, FIELD_ERROR) * math.sqrt(2 * IRON_TURN_S * magnetometer.rate_hz)
        told |= {"magnetometer_sigma": math.hypot(m.noise, lasting) / math.hypot(field_n[0], field_n[1])}
    ahrs = Ahrs(
        AhrsConfig(
            imu_model(errors, math.radians(config.turn_degps)),
            site.lat,
            site.h,
            tuple(aids),
            airspeed_sigma=config.gust_mps,
            literal=config.literal,
            **told,  # type: ignore[arg-type]
        ),
        field_n,
    )
    imus, voter = _imus(config, scenario)
    return Running(
        FusionHorizon(ahrs, _lag_s(scenario, config.aids), coning=imu.rate_hz < scenario.truth.rate_hz),
        imus,
        config.aids,
        voter=voter,
        flight_control=FlightControl(ahrs) if config.autopilot else None,
    )
