"""Inertial navigation closed by one error-state Kalman filter.

The strapdown runs at the rate of the IMU; the covariance every `InsConfig.covariance_period` samples, with the
transition of the whole period; estimated errors are put into the state at once, so the error state itself is always
zero. Between calls nothing depends on how the increments were cut into blocks: what has not yet been put into the
covariance is kept as integrals until the period is full or a measurement comes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nav import aiding
from nav._jit import inlined, njit
from nav.alignment import FORCE_LIMIT, RATE_LIMIT, AidSigmas, Alignment, InitialState
from nav.detection import ChiSquareGate, GnssMonitor, Verdict
from nav.earth import pressure_altitude, radii, wrap_longitude
from nav.error_model import (
    MOTION,
    PHI,
    POS,
    VEL,
    Block,
    ErrorModel,
    ImuModel,
    Indices,
    markov,
    sensor_errors,
    transition,
)
from nav.kalman import correct, innovate, predict
from nav.rotation import quat_conjugate, quat_from_rotvec, quat_multiply, quat_normalise
from nav.samples import (
    AirspeedSample,
    Array,
    BarometerSample,
    BodyVelocitySample,
    Estimate,
    FixType,
    GnssSample,
    ImuSamples,
    MagnetometerSample,
    PositionSample,
    Sample,
    StarSample,
    Status,
    UpdateReport,
)
from nav.strapdown import step

AIDS = ("gnss", "barometer", "magnetometer", "airspeed")
RECENT_S = 2.0  # a position this fresh counts as aided
FUSED, UNAIDED = Status.ALIGNED | Status.GNSS_FUSED, Status.ALIGNED | Status.DEAD_RECKONING
BAD_SAMPLE_S = 1.0  # for how long a refused sample is told of (`Status.BAD_SAMPLE`)
TIME_TOLERANCE = 1e-4  # between a sample and the filter [s]
WHITE_SHARE = 0.1  # of a receiver's reported variance, the least that is taken as white noise
FIELD_PATCH_RAD, FIELD_PATCH_M = 1e-4, 500.0  # the reference field is looked up again beyond this

PREDICTED_PERIODS = 5  # covariance periods in one step of a prediction, which is short and not built upon

# Order of the covariance in an estimate; and the blocks that have a place of their own there
ESTIMATE_ORDER = np.r_[POS : POS + 3, VEL : VEL + 3, PHI : PHI + 3]
REPORTED = ("phi", "dv", "dp", "gyro_bias", "accel_bias")

KINDS = {
    GnssSample: "gnss",
    BarometerSample: "barometer",
    MagnetometerSample: "magnetometer",
    AirspeedSample: "airspeed",
    BodyVelocitySample: "body_velocity",
    StarSample: "star_tracker",
    PositionSample: "position_fix",
}

FieldModel = Callable[[float, float, float], Array]


@dataclass(frozen=True)
class InsConfig:
    """What the filter is told: SI, radians, body axes from the IMU. A block whose sigma is zero is left out.

    ``aids`` names the kinds of sample that are fused (`AIDS`); samples of other kinds serve the alignment only.
    """

    imu: ImuModel
    aids: tuple[str, ...] = AIDS
    mounting_sigma: float = 0.0  # between the axes of the IMU, whose attitude is found, and of the body, reported [rad]
    covariance_period: int = 10  # IMU samples per covariance step; 50 ms and less lose nothing on an aircraft

    # GNSS: the receiver's own sigmas, of which a part may be a slowly varying error (first-order Markov, NED)
    gnss_arm_b: tuple[float, float, float] = (0.0, 0.0, 0.0)  # IMU to antenna [m]
    gnss_use_velocity: bool = True
    gnss_position_error_sigma: tuple[float, float, float] = (0.0, 0.0, 0.0)  # [m]
    gnss_position_error_correlation_s: float = 100.0
    gnss_velocity_error_sigma: tuple[float, float, float] = (0.0, 0.0, 0.0)  # [m/s]
    gnss_velocity_error_correlation_s: float = 20.0

    # Barometer, as pressure altitude
    barometer_sigma: float = 0.5  # [m]
    barometer_bias_sigma: float = 300.0  # weather and geoid, before the first GNSS height tells [m]
    barometer_bias_walk: float = 0.03  # [m/sqrt(s)]

    # Magnetometer, three axes
    magnetometer_sigma: float = 0.5e-6  # [T]
    magnetometer_bias_sigma: float = 1.0e-6  # hard iron left after calibration [T]
    magnetometer_anomaly_sigma: float = 0.0  # of the reference field, constant in n [T]
    magnetometer_error_sigma: float = 0.0  # what changes with attitude, soft iron, as a Markov process [T]
    magnetometer_error_correlation_s: float = 30.0

    # Airspeed along body x, and the constraint of no sideslip (None leaves it out)
    airspeed_sigma: float = 0.5  # [m/s]
    airspeed_scale_sigma: float = 0.0  # [1]
    airspeed_min: float = 10.0  # equivalent; below it neither airspeed nor sideslip is used [m/s]
    sideslip_sigma: float | None = 1.0  # [m/s]
    wind_sigma: float = 8.0  # per horizontal axis, before anything is known [m/s]
    wind_walk: float = 0.03  # [m/s/sqrt(s)]
    gust_sigma: float = 0.0  # turbulence as a Markov part of the wind [m/s]
    gust_correlation_s: float = 5.0

    # Belief
    false_rejection: float = 1e-3  # probability that the gate turns a sound measurement away
    outage_s: float = 10.0  # this long without a fused position is an outage
    probation_s: float = 1.0  # fixes must agree with each other for this long after it
    recovery_s: float = 4.0  # after an outage, fixes that agree for this long overrule the filter
    patience_s: float = 30.0  # and this long when they left the gate without an outage

    alignment_s: float = 2.0  # shortest time over which the initial attitude is found

    def __post_init__(self) -> None:
        unknown = set(self.aids) - set(AIDS)
        if unknown:
            raise ValueError(f"unknown aids {sorted(unknown)}, choose from {list(AIDS)}")
        if self.covariance_period < 1:
            raise ValueError("covariance_period is a number of samples, at least 1")

    def aid_blocks(self) -> list[Block]:
        """The error states of the aids in use."""
        blocks = []
        if "gnss" in self.aids:
            for of in ("position", "velocity"):
                sigma = getattr(self, f"gnss_{of}_error_sigma")
                blocks.append(markov(f"gnss_{of}_error", 3, sigma, getattr(self, f"gnss_{of}_error_correlation_s")))
        if "barometer" in self.aids:
            blocks.append(Block("barometer_bias", 1, self.barometer_bias_sigma, self.barometer_bias_walk))
        if "magnetometer" in self.aids:
            error, correlation_s = self.magnetometer_error_sigma, self.magnetometer_error_correlation_s
            blocks += [
                Block("magnetometer_bias", 3, self.magnetometer_bias_sigma),
                Block("magnetometer_anomaly", 3, self.magnetometer_anomaly_sigma),
                markov("magnetometer_error", 3, error, correlation_s),
            ]
        if "airspeed" in self.aids:
            blocks += [
                Block("wind", 2, self.wind_sigma, self.wind_walk),
                markov("gust", 2, self.gust_sigma, self.gust_correlation_s),
                Block("airspeed_scale", 1, self.airspeed_scale_sigma),
            ]
        return [block for block in blocks if np.any(block.sigma)]


@dataclass
class _State:
    """Everything that moves: nominal motion, estimated further states, covariance, and integrals still to be used."""

    q_nb: Array
    v_n: Array
    lla: Array
    x: Array  # (n,) estimated values, the motion's own entries zero
    P: Array  # (n, n)
    errors: Array  # (4, 3) estimated sensor errors by kind
    sums: Array  # (3, 3, 3), see `error_model.transition`
    elapsed: Array  # (2,) seconds and samples since the last covariance step
    rates: Array  # (2, 3) angular rate and specific force of the last sound increment, as measured

    def copy(self) -> _State:
        return _State(
            self.q_nb.copy(),
            self.v_n.copy(),
            self.lla.copy(),
            self.x.copy(),
            self.P.copy(),
            self.errors.copy(),
            self.sums.copy(),
            self.elapsed.copy(),
            self.rates.copy(),
        )


@dataclass(frozen=True)
class _Constants:
    """What the kernels need of the error model, and their scratch."""

    driven: Indices
    decay_rate: Array
    variance_rate: Array
    Phi: Array
    FT: Array
    decay: Array
    half_noise: Array
    work: Array


class Ins:
    """Strapdown closed by one local filter; see the estimator protocol in `nav.horizon`.

    ``field_n`` gives the reference magnetic field (3,) [T], NED, at (lat, lon, h); without it the magnetometer is not
    used. The filter aligns itself from the samples it is given; `start` sets it at a known state instead.
    """

    def __init__(self, config: InsConfig, field_n: FieldModel | None = None) -> None:
        self.config = config
        self.model = ErrorModel(config.imu, config.aid_blocks())
        self.t = math.nan
        self._field_model = field_n
        self._field_at = (math.nan, math.nan, math.nan)
        self._field_value = np.zeros(3)
        self._arm_b = np.array(config.gnss_arm_b, dtype=float)
        self._gate = ChiSquareGate(config.false_rejection)
        self._monitor = GnssMonitor(
            config.outage_s, config.probation_s, config.recovery_s, config.patience_s, self._gate.threshold(3)
        )
        self._last_bad = -math.inf  # time of the last sample refused as unsound
        self._state: _State | None = None
        self._alignment = Alignment(
            config.imu,
            AidSigmas(
                field=config.magnetometer_sigma,
                field_bias=config.magnetometer_bias_sigma,
                gnss_position=np.array(config.gnss_position_error_sigma),
                gnss_velocity=np.array(config.gnss_velocity_error_sigma),
                wind=config.wind_sigma,
            ),
            self._arm_b,
            config.alignment_s,
        )
        model, n = self.model, self.model.size
        self._constants = _Constants(
            driven=model.driven,
            decay_rate=model.decay_rate,
            variance_rate=model.density**2,
            Phi=np.zeros((MOTION, model.mixing)),
            FT=np.zeros((MOTION, model.mixing)),
            decay=np.ones(n),
            half_noise=np.zeros(n),
            work=np.zeros((MOTION, n)),
        )
        self._gnss_position_R = np.array(config.gnss_position_error_sigma) ** 2
        self._gnss_velocity_R = np.array(config.gnss_velocity_error_sigma) ** 2
        self._barometer_R = np.array([config.barometer_sigma**2])
        self._magnetometer_R = np.full(3, config.magnetometer_sigma**2)
        self._airspeed_R = np.array([config.airspeed_sigma**2])
        self._sideslip_R = np.array([(config.sideslip_sigma or 0.0) ** 2])
        self._extra = [(name, where) for name, where in model.slices.items() if name not in REPORTED]
        start = model.start
        self._gnss_position_error = start("gnss_position_error")
        self._gnss_velocity_error = start("gnss_velocity_error")
        self._barometer_bias = start("barometer_bias")
        self._magnetometer_bias, self._magnetometer_error = start("magnetometer_bias"), start("magnetometer_error")
        self._magnetometer_anomaly = start("magnetometer_anomaly")
        self._wind, self._gust, self._airspeed_scale = start("wind"), start("gust"), start("airspeed_scale")

    @property
    def aligned(self) -> bool:
        """Whether there is an attitude, a velocity and a position."""
        return self._state is not None

    @property
    def listening(self) -> bool:
        """Whether a sample of some kind would still be used."""
        return self._state is None or bool(self.config.aids)

    @property
    def problem(self) -> str:
        """What the alignment is waiting for or why it refuses, empty once aligned."""
        return "" if self.aligned else self._alignment.problem

    def start(self, initial: InitialState) -> None:
        """Begin at a given state instead of aligning."""
        n = self.model.size
        P = np.diag(self.model.sigma**2)
        P[:MOTION, :MOTION] = initial.covariance
        for name, covariance in initial.correlated.items():
            if name in self.model.slices:
                block = self.model.slices[name]
                P[:MOTION, block] = covariance
                P[block, :MOTION] = covariance.T
        self._state = _State(
            q_nb=np.array(initial.q_nb, dtype=float),
            v_n=np.array(initial.v_n, dtype=float),
            lla=np.array([initial.lat, initial.lon, initial.h]),
            x=np.zeros(n),
            P=P,
            errors=np.zeros((4, 3)),
            sums=np.zeros((3, 3, 3)),
            elapsed=np.zeros(2),
            rates=np.zeros((2, 3)),
        )
        self.t = initial.t
        self._monitor.last_fused = initial.t

    def propagate(self, imu: ImuSamples) -> None:
        """Advance by a block of increments; a non-finite or impossible one is bridged with the last sound rates."""
        if len(imu) == 0:
            return
        if self._state is None:
            self._alignment.propagate(imu)
        else:
            self._last_bad = max(self._last_bad, self._run(self._state, imu, self.config.covariance_period))
        self.t = float(imu.t[-1])

    def accepts(self, sample: Sample) -> bool:
        """Whether the sample's kind is an aid, or it can still serve the alignment."""
        if self._state is None:
            return isinstance(sample, (GnssSample, MagnetometerSample))
        return KINDS[type(sample)] in self.config.aids

    def update(self, sample: Sample) -> list[UpdateReport]:
        """Use a sample valid at the filter's own time (ValueError otherwise: `nav.horizon.FusionHorizon` sees to that).

        One report per aid; an unsound sample is refused and reported; none for a GNSS sample without fix, for a kind
        that is not among the aids, and during alignment.
        """
        if isinstance(sample, GnssSample) and sample.fix_type is not FixType.FIX_3D:
            return []
        trouble = aiding.problem(sample)
        if trouble:
            self._last_bad = max(self._last_bad, sample.t if math.isfinite(sample.t) else self.t)
            return self.refuse(sample, trouble)
        if not math.isnan(self.t) and abs(sample.t - self.t) > TIME_TOLERANCE:
            raise ValueError(f"sample at {sample.t} s, but the filter is at {self.t} s")
        state = self._state
        if state is None:
            self._align(sample)
            return []
        if KINDS[type(sample)] not in self.config.aids:
            return []
        self._settle(state)
        match sample:
            case GnssSample():
                return self._update_gnss(state, sample)
            case BarometerSample():
                altitude = pressure_altitude(sample.pressure)
                nu, H = aiding.barometer(state.lla, state.x, self._barometer_bias, altitude)
                return [self._fuse(state, sample, "barometer", nu, H, self._barometer_R)]
            case MagnetometerSample():
                return self._update_magnetometer(state, sample)
            case AirspeedSample():
                return self._update_airspeed(state, sample)
            case BodyVelocitySample() | StarSample() | PositionSample():  # never among the aids
                return []

    def refuse(self, sample: Sample, reason: str) -> list[UpdateReport]:
        """Reports on a sample that is not used, without innovations (NaN): one for each aid it would have served."""
        t = sample.t if math.isfinite(sample.t) else self.t
        return [
            UpdateReport(
                t, sample.sensor, aid, np.full(m, np.nan), np.full((m, m), np.nan), math.nan, math.nan, 0.0, reason
            )
            for aid, m in self._serves(sample)
        ]

    def _serves(self, sample: Sample) -> list[tuple[str, int]]:
        """The aids that a sample of this kind serves, and the size of their innovations."""
        match sample:
            case GnssSample():
                return [("gnss_position", 3)] + [("gnss_velocity", 3)] * self.config.gnss_use_velocity
            case BarometerSample():
                return [("barometer", 1)]
            case MagnetometerSample():
                return [("magnetometer", 3)]
            case AirspeedSample():
                return [("airspeed", 1)] + [("sideslip", 1)] * (self.config.sideslip_sigma is not None)
            case BodyVelocitySample() | StarSample() | PositionSample():
                return []

    def estimate(self) -> Estimate:
        """The state at the filter's own time."""
        return self._estimate(self._state.copy() if self._state is not None else None, self.t, self._last_bad)

    def predict(self, imu: ImuSamples) -> Estimate:
        """The state after further increments, the filter itself staying where it is."""
        state = self._state.copy() if self._state is not None else None
        last_bad = self._last_bad
        if state is not None and len(imu):
            period = self.config.covariance_period * PREDICTED_PERIODS
            last_bad = max(last_bad, self._run(state, imu, period))
        return self._estimate(state, float(imu.t[-1]) if len(imu) else self.t, last_bad)

    def _run(self, state: _State, imu: ImuSamples, period: int) -> float:
        """Propagate a state; the time of the last increment that was not usable, -inf when all were."""
        s, c = state, self._constants
        bad = _propagate(
            s.q_nb, s.v_n, s.lla, s.x, s.P, s.errors, s.sums, s.elapsed, s.rates,
            c.driven, c.decay_rate, c.variance_rate, c.Phi, c.FT, c.decay, c.half_noise, c.work,
            period, imu.dtheta, imu.dv, imu.dt,
        )  # fmt: skip
        return float(imu.t[bad]) if bad >= 0 else -math.inf

    def _settle(self, state: _State) -> None:
        """Bring the covariance up to the time of the motion."""
        s, c = state, self._constants
        if s.elapsed[0] > 0:
            _covariance_step(
                s.v_n, s.lla, s.x, s.P, s.errors, s.sums, s.elapsed,
                c.driven, c.decay_rate, c.variance_rate, c.Phi, c.FT, c.decay, c.half_noise, c.work,
            )  # fmt: skip

    def _align(self, sample: Sample) -> None:
        if isinstance(sample, MagnetometerSample):
            self._alignment.add_field(sample.field_b)
        elif isinstance(sample, GnssSample):
            field_n = self._field_n(np.array([sample.lat, sample.lon, sample.h])) if self._field_model else None
            initial = self._alignment.add_gnss(sample, field_n)
            if initial is not None:
                self.start(initial)

    def _update_gnss(self, state: _State, sample: GnssSample) -> list[UpdateReport]:
        nu, H = self._gnss_position(state, sample)
        R = _white(sample.sigma_position_n, self._gnss_position_R)
        S, _, _, nis = innovate(state.P, H, R, nu)
        with_velocity = aiding.has_velocity(sample)
        v_n, sigma_v = (
            (sample.v_n, sample.sigma_velocity_n)
            if with_velocity
            else (state.v_n.copy(), np.sqrt(np.diag(state.P)[VEL : VEL + 3]))
        )
        threshold = self._gate.threshold(3)
        verdict = self._monitor.judge(sample, v_n, sigma_v, nis <= threshold)
        use_velocity = with_velocity and self.config.gnss_use_velocity
        if verdict is Verdict.RECOVER:
            self._give_up_position(state, sample, nu, S, use_velocity)
        weight = 1.0 if verdict in (Verdict.FUSE, Verdict.RECOVER) else 0.0
        if weight:
            S, nis = self._absorb(state, nu, H, R, math.inf)
        reports = [UpdateReport(sample.t, sample.sensor, "gnss_position", nu, S, nis, threshold, weight, verdict.value)]
        if use_velocity:
            nu, H = self._gnss_velocity(state, sample)
            R = _white(sample.sigma_velocity_n, self._gnss_velocity_R)
            withheld = "" if weight else f"position {verdict.value}"
            reports.append(self._fuse(state, sample, "gnss_velocity", nu, H, R, withheld))
        return reports

    def _gnss_position(self, state: _State, sample: GnssSample) -> tuple[Array, Array]:
        return aiding.gnss_position(
            state.q_nb, state.lla, state.x, self._arm_b, self._gnss_position_error, sample.lat, sample.lon, sample.h
        )

    def _gnss_velocity(self, state: _State, sample: GnssSample) -> tuple[Array, Array]:
        return aiding.gnss_velocity(
            state.q_nb, state.v_n, state.lla, state.x, state.rates[0], state.errors, self.model.driven,
            self._arm_b, self._gnss_velocity_error, sample.v_n,
        )  # fmt: skip

    def _give_up_position(self, state: _State, sample: GnssSample, nu: Array, S: Array, use_velocity: bool) -> None:
        """Make the covariance as wide as the innovation says; the rest of the state keeps what it knows.

        When velocity is off as well, it goes too, and with it the wind that was estimated from it.
        """
        if use_velocity:
            nu_v, H = self._gnss_velocity(state, sample)
            R = _white(sample.sigma_velocity_n, self._gnss_velocity_R)
            S_v, _, _, nis = innovate(state.P, H, R, nu_v)
            if not nis <= self._gate.threshold(3):
                _forget(state.P, VEL, nu_v**2 + np.diag(S_v))
                if self._wind >= 0:
                    _forget(state.P, self._wind, np.full(2, self.config.wind_sigma**2))
        _forget(state.P, POS, nu**2 + np.diag(S))

    def _update_magnetometer(self, state: _State, sample: MagnetometerSample) -> list[UpdateReport]:
        if self._field_model is None:
            return []
        nu, H = aiding.magnetometer(
            state.q_nb, state.x, self._magnetometer_bias, self._magnetometer_error, self._magnetometer_anomaly,
            self._field_n(state.lla), sample.field_b,
        )  # fmt: skip
        return [self._fuse(state, sample, "magnetometer", nu, H, self._magnetometer_R)]

    def _update_airspeed(self, state: _State, sample: AirspeedSample) -> list[UpdateReport]:
        slow = "" if sample.eas >= self.config.airspeed_min else "too slow for the pitot tube"
        nu, H = aiding.airspeed(
            state.q_nb, state.v_n, state.lla, state.x, self._wind, self._gust, self._airspeed_scale, sample.eas
        )
        reports = [self._fuse(state, sample, "airspeed", nu, H, self._airspeed_R, slow)]
        if self.config.sideslip_sigma is not None:
            nu, H = aiding.sideslip(state.q_nb, state.v_n, state.x, self._wind, self._gust)
            reports.append(self._fuse(state, sample, "sideslip", nu, H, self._sideslip_R, slow))
        return reports

    def _fuse(
        self, state: _State, sample: Sample, aid: str, nu: Array, H: Array, R: Array, withheld: str = ""
    ) -> UpdateReport:
        """Gate and correct; ``withheld`` says why the measurement must not be used whatever the gate says."""
        threshold = self._gate.threshold(len(nu))
        S, nis = self._absorb(state, nu, H, R, -math.inf if withheld else threshold)
        reason = withheld or ("" if nis <= threshold else "outside the gate")
        return UpdateReport(sample.t, sample.sensor, aid, nu, S, nis, threshold, 0.0 if reason else 1.0, reason)

    def _absorb(self, state: _State, nu: Array, H: Array, R: Array, threshold: float) -> tuple[Array, float]:
        """Correct the state if nis is at most ``threshold``; (S, nis)."""
        return _update(
            state.q_nb, state.v_n, state.lla, state.x, state.P, state.errors, self.model.driven, nu, H, R, threshold
        )

    def _field_n(self, lla: Array) -> Array:
        """The reference field, looked up again only after the place has changed."""
        assert self._field_model is not None
        (lat, lon, h), (lat0, lon0, h0) = lla.tolist(), self._field_at
        if not (
            abs(lat - lat0) < FIELD_PATCH_RAD and abs(lon - lon0) < FIELD_PATCH_RAD and abs(h - h0) < FIELD_PATCH_M
        ):
            self._field_at = (lat, lon, h)
            self._field_value = np.array(self._field_model(lat, lon, h), dtype=float)
        return self._field_value

    def _estimate(self, state: _State | None, t: float, last_bad: float) -> Estimate:
        """The estimate at ``t`` from a ``state`` of its own."""
        aided = "gnss" in self.config.aids and t - self._monitor.last_fused <= RECENT_S
        status = Status.ALIGNING if state is None else FUSED if aided else UNAIDED
        if t - last_bad <= BAD_SAMPLE_S:
            status |= Status.BAD_SAMPLE
        if state is None:
            nothing = np.full(3, np.nan)
            return Estimate(
                t, math.nan, math.nan, math.nan, nothing, np.full(4, np.nan), nothing, nothing, np.full((9, 9), np.nan),
                nothing, nothing, status,
            )  # fmt: skip
        self._settle(state)
        covariance, sigma = _spread(state.P, self.config.mounting_sigma**2)
        gyro_bias, sigma_gyro = self._with_drift(state, sigma, "gyro")
        accel_bias, sigma_accel = self._with_drift(state, sigma, "accel")
        lat, lon, h = state.lla.tolist()
        return Estimate(
            t=t,
            lat=lat,
            lon=lon,
            h=h,
            v_n=state.v_n,
            q_nb=state.q_nb,
            gyro_bias=gyro_bias,
            accel_bias=accel_bias,
            covariance=covariance,
            sigma_gyro_bias=sigma_gyro,
            sigma_accel_bias=sigma_accel,
            status=status,
            extra={name: (state.x[where], sigma[where]) for name, where in self._extra},
        )

    def _with_drift(self, state: _State, sigma: Array, sensor: str) -> tuple[Array, Array]:
        """Bias of one kind of inertial sensor, its in-run part included, and the 1-sigma."""
        bias = self.model.slices[f"{sensor}_bias"]
        drift = self.model.slices.get(f"{sensor}_drift")
        if drift is None:
            return state.x[bias], sigma[bias]
        variance = sigma[bias] ** 2 + sigma[drift] ** 2 + 2 * state.P[bias, drift].diagonal()
        return state.x[bias] + state.x[drift], np.sqrt(variance)


def _white(sigma: Array, correlated_variance: Array) -> Array:
    """The white part of a receiver's reported variance, when the correlated part is a state of the filter."""
    reported = sigma * sigma
    return np.maximum(reported - correlated_variance, WHITE_SHARE * reported)


def _forget(P: Array, start: int, variance: Array) -> None:
    """Give a block of states new variances, independent of all others."""
    block = slice(start, start + len(variance))
    P[block, :] = 0.0
    P[:, block] = 0.0
    P[block, block] = np.diag(variance)


@njit
def _spread(P: Array, mounting_variance: float) -> tuple[Array, Array]:
    """Covariance (9, 9) in the order of an estimate, with the mounting's share, and 1-sigma (n,) of every state."""
    covariance, sigma = np.empty((MOTION, MOTION)), np.empty(len(P))
    for i in range(MOTION):
        for j in range(MOTION):
            covariance[i, j] = P[ESTIMATE_ORDER[i], ESTIMATE_ORDER[j]]
        if ESTIMATE_ORDER[i] < PHI + 3:
            covariance[i, i] += mounting_variance
    for i in range(len(P)):
        sigma[i] = math.sqrt(P[i, i])
    return covariance, sigma


@njit
def _update(
    q_nb: Array, v_n: Array, lla: Array, x: Array, P: Array, errors: Array, driven: Indices,
    nu: Array, H: Array, R: Array, threshold: float,
) -> tuple[Array, float]:  # fmt: skip
    """One measurement into the state if its nis is at most ``threshold``; (S, nis), see `kalman.innovate`."""
    S, S_inverse, HP, nis = innovate(P, H, R, nu)
    if nis <= threshold:
        _inject(q_nb, v_n, lla, x, correct(P, H, R, HP, S_inverse, nu))
        sensor_errors(errors, x, driven)
    return S, nis


@inlined
def _inject(q_nb: Array, v_n: Array, lla: Array, x: Array, correction: Array) -> None:
    """Add a correction (n,) to the state: what the error state has found out, with the sign of `kalman.correct`."""
    # C_nb_hat = (I - [phi x]) C_nb, and the correction is minus phi's estimate
    turn = quat_conjugate(quat_from_rotvec(correction[PHI : PHI + 3]))
    turned = quat_normalise(quat_multiply(turn, q_nb))
    for i in range(4):
        q_nb[i] = turned[i]
    for i in range(3):
        v_n[i] += correction[VEL + i]
    R_M, R_N = radii(lla[0])
    lla[1] = wrap_longitude(lla[1] + correction[POS + 1] / ((R_N + lla[2]) * math.cos(lla[0])))
    lla[0] += correction[POS] / (R_M + lla[2])
    lla[2] -= correction[POS + 2]
    for i in range(MOTION, len(x)):
        x[i] += correction[i]


@njit
def _covariance_step(
    v_n: Array, lla: Array, x: Array, P: Array, errors: Array, sums: Array, elapsed: Array,
    driven: Indices, decay_rate: Array, variance_rate: Array, Phi: Array, FT: Array, decay: Array, half_noise: Array,
    work: Array,
) -> None:  # fmt: skip
    """Take covariance and Markov states over the time in ``elapsed``, and empty the integrals."""
    T = elapsed[0]
    transition(Phi, FT, driven, v_n, lla[0], lla[2], sums, T)
    for i in range(len(x)):
        half_noise[i] = 0.5 * T * variance_rate[i]
        if decay_rate[i] > 0.0:
            decay[i] = math.exp(-T * decay_rate[i])
            x[i] *= decay[i]
    predict(P, Phi, decay, half_noise, work)
    sensor_errors(errors, x, driven)
    sums[:] = 0.0
    elapsed[:] = 0.0


@njit
def _propagate(
    q_nb: Array, v_n: Array, lla: Array, x: Array, P: Array, errors: Array, sums: Array, elapsed: Array, rates: Array,
    driven: Indices, decay_rate: Array, variance_rate: Array, Phi: Array, FT: Array, decay: Array, half_noise: Array,
    work: Array, period: int, dtheta: Array, dv: Array, dt: Array,
) -> int:  # fmt: skip
    """Strapdown and covariance over N increments in place; the last of them that was not usable, -1 for none."""
    bad = -1
    angle, push, before = np.empty(3), np.empty(3), np.empty(4)
    for k in range(len(dt)):
        T = dt[k]
        if not T > 0.0:
            continue
        sound = True
        for i in range(3):
            if not (abs(dtheta[k, i]) <= RATE_LIMIT * T and abs(dv[k, i]) <= FORCE_LIMIT * T):
                sound = False
        if sound:
            for i in range(3):
                rates[0, i], rates[1, i] = dtheta[k, i] / T, dv[k, i] / T
        else:
            bad = k
        for i in range(3):
            angle[i] = (rates[0, i] - errors[0, i]) * T / (1.0 + errors[2, i])
            push[i] = (rates[1, i] - errors[1, i]) * T / (1.0 + errors[3, i])
        for i in range(4):
            before[i] = q_nb[i]
        step(q_nb, v_n, lla, angle, push, T)
        _integrate(sums, before, q_nb, angle, push, T)
        elapsed[0] += T
        elapsed[1] += 1.0
        if elapsed[1] >= period:
            _covariance_step(
                v_n, lla, x, P, errors, sums, elapsed,
                driven, decay_rate, variance_rate, Phi, FT, decay, half_noise, work,
            )  # fmt: skip
    return bad


@inlined
def _integrate(sums: Array, before: Array, after: Array, angle: Array, push: Array, T: float) -> None:
    """Add one interval to the integrals of `error_model.transition`, with C_nb in its middle: of the mean quaternion.

    Written out in scalars: a matrix made for every increment would take as long as the strapdown.
    """
    w, x, y, z = before[0] + after[0], before[1] + after[1], before[2] + after[2], before[3] + after[3]
    s = 2.0 / (w * w + x * x + y * y + z * z)
    C_nb = (
        (1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)),
        (s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)),
        (s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)),
    )
    for i in range(3):
        for j in range(3):
            sums[0, i, j] += C_nb[i][j] * T
            sums[1, i, j] += C_nb[i][j] * angle[j]
            sums[2, i, j] += C_nb[i][j] * push[j]
