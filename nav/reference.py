"""The strapdown that filters correct, and the covariances that ride on it.

`Reference` integrates the increments of one IMU and takes any number of filters' covariances along with the same
transition, formed once for all of them. The motion and the errors of the IMU are the *common* states, the first
``common`` of every filter; behind them each filter has states of its own, the errors of its aids.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from nav._jit import njit
from nav.alignment import Alignment, InitialState
from nav.columns import Estimates
from nav.error_model import MOTION, PHI, POS, VEL, ErrorModel, Indices, sensor_errors
from nav.rotation import (
    dcm_from_quat,
    left_jacobian_solve,
    quat_conjugate,
    quat_from_rotvec,
    quat_multiply,
    rotvec_from_quat,
)
from nav.samples import Array, Estimate, GnssSample, ImuSamples, MagnetometerSample, Sample, Status
from nav.state import State, inject, propagate, sigma_step, working
from nav.unscented import Scaling, carry, scratch

FIELD_PATCH_RAD, FIELD_PATCH_M = 1e-4, 500.0  # the reference field is looked up again beyond this
RECENT_S = 2.0  # a position this fresh counts as aided
FUSED, UNAIDED = Status.ALIGNED | Status.GNSS_FUSED, Status.ALIGNED | Status.DEAD_RECKONING
BAD_SAMPLE_S = 1.0  # for how long a refused sample is told of (`Status.BAD_SAMPLE`)
TIME_TOLERANCE = 1e-4  # between a sample and the filter [s]
NEVER = 1 << 62
NO_INCREMENTS, NO_TIMES = np.empty((0, 3)), np.empty(0)
PREDICTED_PERIODS = 5  # covariance periods in one step of a prediction, which is short and not built upon

# Order of the covariance in an estimate; and the blocks that have a place of their own there
ESTIMATE_ORDER = np.r_[POS : POS + 3, VEL : VEL + 3, PHI : PHI + 3]
REPORTED = ("phi", "dv", "dp", "gyro_bias", "accel_bias")

FieldModel = Callable[[float, float, float], Array]


class Reference:
    """One strapdown and the growth of the covariances of the filters of ``models``.

    Filter i is told ``1 / shares[i]`` times the noise and the initial covariance of the common states, so that a fusion
    of all may add up their information as if they were independent (Cui et al. 2022, Eq 7). Filters with fewer states
    than the largest have dead ones behind. ``field_n`` gives the reference magnetic field (3,) [T], NED, at (lat, lon,
    h). A covariance step takes ``period`` samples, by sigma points with a ``scaling`` (of one closed filter only), or
    for those of several open filters that have one in ``scalings``.

    What an open filter of the second kind would add to the nominal attitude may be of any size: x = -phi with
    ``C_own = exp(-[x x]) C_nb``, and it is never added to or subtracted from but as a rotation. Its P is that of the
    error of its own estimate, in axes that go with it (`own`, `turned`).
    """

    def __init__(
        self,
        models: Sequence[ErrorModel],
        shares: Sequence[float] | Array,
        period: int,
        field_n: FieldModel | None,
        scaling: Scaling | None = None,
        scalings: Sequence[Scaling | None] = (),
    ) -> None:
        self.models, self.period, self.scaling = models, period, scaling
        self.scalings = {row: given for row, given in enumerate(scalings) if given is not None}
        self._pauses = scaling is not None or bool(self.scalings)
        self.common = models[0].mixing
        self.driven = models[0].driven
        self.size = max(model.size for model in models)
        self.has_field = field_n is not None
        self._field_model = field_n
        self.field = np.full(6, math.nan)  # where the field was looked up, and what it was
        filters, n = len(models), self.size
        self._decay_rate, self._noise = np.zeros((filters, n)), np.zeros((filters, n))
        for i, model in enumerate(models):
            self._decay_rate[i, : model.size] = model.decay_rate
            self._noise[i, : model.size] = model.density**2
        self._variance_rate = self._noise.copy()
        self._in_motion = np.zeros((filters, 4))
        self._room, self._work = np.zeros(2 * MOTION * self.common + 2 * n), scratch(n)
        self._scratch = (*working(self._room, self.common, n), self._work)
        self.share_noise(shares)
        # The longest kernel is loaded here, or compiled, and not when samples wait for it.
        self._propagate(State(self.common, filters, n), NEVER, NO_INCREMENTS, NO_INCREMENTS, NO_TIMES)

    def share_noise(self, shares: Sequence[float] | Array) -> None:
        """New shares of the noise of the common states."""
        each = np.array(shares)[:, None]
        self._variance_rate[:, : self.common] = self._noise[:, : self.common] / each
        self._in_motion[:] = np.array([model.imu.in_motion for model in self.models]) / each

    def scale_noise(self, row: int, where: slice, scale: float) -> None:
        """From now on, ``scale`` times the told driving noise of some of a filter's own states (not common ones)."""
        self._variance_rate[row, where] = scale * self._noise[row, where]

    @property
    def moving(self) -> tuple[Indices, Array, Array, Array, Array, Array, int]:
        """What `nav.state.propagate` is told beside a state, up to the period."""
        return (
            self.driven, self._decay_rate, self._variance_rate, self._in_motion, self._room, self._work, self.period
        )  # fmt: skip

    def start(self, initial: InitialState, names: Sequence[Mapping[str, str]] | None = None) -> State:
        """A given state with its covariance, not yet shared; ``names[i]`` renames correlated blocks for filter i."""
        filters, n = len(self.models), self.size
        P = np.zeros((filters, n, n))
        for i, model in enumerate(self.models):
            P[i, : model.size, : model.size] = model.prior
            P[i, :MOTION, :MOTION] = initial.covariance
            for given, sigma in initial.widened.items():
                name = names[i].get(given, given) if names else given
                if name in model.slices:
                    own = np.arange(model.size)[model.slices[name]]
                    P[i, own, own] = sigma**2
            for given, covariance in initial.correlated.items():
                name = names[i].get(given, given) if names else given
                if name in model.slices:
                    block = model.slices[name]
                    P[i, :MOTION, block] = covariance
                    P[i, block, :MOTION] = covariance.T
        state = State(self.common, filters, n)
        state.q_nb[:], state.v_n[:] = initial.q_nb, initial.v_n
        state.lla[:] = initial.lat, initial.lon, initial.h
        state.P[:] = P
        return state

    def run(self, state: State, imu: ImuSamples, periods: int = 1, *, settle: bool = False) -> float:
        """Propagate by a block of increments, a covariance step every ``periods`` of the usual ones; `settle` after it.

        The time of the last increment that was not usable, -inf when all were: it is bridged with the last sound rates.
        """
        s = state
        period, first, last_bad = self.period * periods, 0, -math.inf
        while first < len(imu):
            # the kernel takes linear steps only: sigma points stop it before one is due
            stop = first + max(1, period - int(s.elapsed[1])) if self._pauses else len(imu)
            part = slice(first, stop)
            every = NEVER if self._pauses else period
            at_once = settle and not self._pauses
            bad = self._propagate(s, every, imu.dtheta[part], imu.dv[part], imu.dt[part], settle=at_once)
            if bad >= 0:
                last_bad = float(imu.t[first + bad])
            if self._pauses and s.elapsed[1] >= period:
                self.settle(s)
            first = stop
        if settle:
            self.settle(s)
        return last_bad

    def settle(self, state: State) -> None:
        """Bring the covariances up to the time of the motion."""
        s = state
        if s.elapsed[0] > 0 and self.scaling is not None:
            sigma_step(
                s.q_nb, s.v_n, s.lla, s.imu, s.x[0], s.P[0], s.errors, s.sums, s.elapsed, s.shaking,
                self.driven, self._decay_rate[0], self._variance_rate[0], self._in_motion[0],
                *self._scratch, self.scaling.spread, self.scaling.excess,
            )  # fmt: skip
        elif s.elapsed[0] > 0:
            before = s.copy() if self.scalings else None
            self._propagate(s, NEVER, NO_INCREMENTS, NO_INCREMENTS, NO_TIMES, settle=True)
            if before is not None:
                Phi = self._scratch[0].copy()
                for row, scaling in self.scalings.items():
                    self._sigma_step(s, before, Phi, row, scaling)

    def _sigma_step(self, s: State, before: State, Phi: Array, row: int, scaling: Scaling) -> None:
        """Take an open filter over an interval by sigma points around its own estimate.

        ``s`` is at the end of it in all but this filter, ``before`` has the filter at the beginning and the integrals;
        ``Phi`` is the nominal transition.
        """
        x, T = before.x[row], float(before.elapsed[0])
        x[:MOTION] = -carry(-x, Phi, before.sums[2].sum(axis=1), T)
        q_nb, v_n, lla, imu = s.q_nb.copy(), s.v_n.copy(), s.lla.copy(), np.zeros(self.common)
        inject(q_nb, v_n, lla, imu, x[: self.common])
        error = sigma_step(
            q_nb, v_n, lla, imu, x, before.P[row], np.empty((4, 3)), dcm_from_quat(_turn(x)) @ before.sums,
            np.array([T, 0.0]), before.shaking, self.driven, self._decay_rate[row], self._variance_rate[row],
            self._in_motion[row], *self._scratch,
            scaling.spread, scaling.excess,
        )  # fmt: skip
        remove_open(x, error)
        s.x[row], s.P[row] = x, before.P[row]

    def _propagate(self, s: State, period: int, dtheta: Array, dv: Array, dt: Array, *, settle: bool = False) -> int:
        """See the kernel."""
        return propagate(
            s.whole, *s.shape, self.driven, self._decay_rate, self._variance_rate, self._in_motion, self._room,
            self._work,
            period, dtheta, dv, dt, 0, len(dt), settle, self.size,
        )  # fmt: skip

    def correct(self, state: State, correction: Array) -> None:
        """Put a correction (common,) of the common states into the nominal ones and take it from every filter's."""
        s = state
        inject(s.q_nb, s.v_n, s.lla, s.imu, correction)
        sensor_errors(s.errors, s.imu, self.driven)
        left = {row: quat_multiply(_turn(s.x[row]), quat_conjugate(_turn(correction))) for row in self.scalings}
        s.x[:, : self.common] -= correction
        for row, turn in left.items():
            s.x[row, PHI : PHI + 3] = -rotvec_from_quat(turn)

    def own(self, state: State, row: int) -> State:
        """A copy whose nominal state is what an open filter estimates itself."""
        own = state.copy()
        inject(own.q_nb, own.v_n, own.lla, own.imu, own.x[row, : self.common])
        own.x[row, : self.common] = 0.0
        sensor_errors(own.errors, own.imu, self.driven)
        return own

    def field_n(self, lla: Array) -> Array:
        """The reference field, looked up again only after the place has changed."""
        assert self._field_model is not None
        if not is_near(lla, self.field):
            lat, lon, h = lla.tolist()
            self.field = np.array([lat, lon, h, *self._field_model(lat, lon, h)])
        return self.field[3:]


@njit
def is_near(lla: Array, field: Array) -> bool:
    """Whether the reference ``field`` (6,), latitude, longitude, height and what it is there, is that of a place."""
    near: bool = (
        abs(lla[0] - field[0]) < FIELD_PATCH_RAD
        and abs(lla[1] - field[1]) < FIELD_PATCH_RAD
        and abs(lla[2] - field[2]) < FIELD_PATCH_M
    )
    return near


def _turn(x: Array) -> Array:
    """What ``x`` (of the common states at least) adds to the nominal attitude, as a quaternion: exp(-[x x])."""
    return quat_conjugate(quat_from_rotvec(x[PHI : PHI + 3]))


def remove_open(x: Array, error: Array) -> None:
    """Take an ``error`` (n,), of an open filter's own estimate, out of what it would add to the nominal state."""
    phi = rotvec_from_quat(quat_multiply(quat_from_rotvec(error[PHI : PHI + 3]), _turn(x)))
    x -= error
    x[PHI : PHI + 3] = -phi


def turned(x: Array, P: Array, *, own: bool) -> Array:
    """``P`` (n, n) of the error of x (n,) made that of the error of the estimate at x, in its ``own`` axes, or back.

    ``exp(-[(x + dx) x]) = exp([phi x]) exp(-[x x])`` for ``dx = -J_l^-1(-x) phi``, so only the attitude's part turns.
    """
    J = np.eye(len(P))
    J[:3, :3] = np.array([left_jacobian_solve(-x[PHI : PHI + 3], axis) for axis in np.eye(3)]).T
    if own:
        J[:3, :3] = np.linalg.inv(J[:3, :3])
    P = J @ P @ J.T
    return 0.5 * (P + P.T)


def nothing_known(t: float, status: Status) -> Estimate:
    """The estimate before there is a state: every number is NaN."""
    nothing = np.full(3, np.nan)
    return Estimate(
        t, math.nan, math.nan, math.nan, nothing, np.full(4, np.nan), nothing, nothing, np.full((9, 9), np.nan),
        nothing, nothing, status,
    )  # fmt: skip


def described(
    t: Array, status: Sequence[int], motion: tuple[Array, Array, Array], x: Array, P: tuple[Array, int],
    model: ErrorModel, covariance: Array, sigma: Array, extra: dict[str, tuple[Array, Array]],
) -> Estimates:  # fmt: skip
    """The estimates of N nominal states with estimated sensor errors ``x`` (N, n) and covariances ``P``.

    These are laid out as ``model``. ``motion`` is q_nb, v_n and (lat, lon, h); ``covariance`` and ``sigma`` are those
    that `spread` finds in the rows ``P[0]``, from the place ``P[1]`` on. Each estimate has a row of each.
    """
    gyro_bias, sigma_gyro = _with_drift(x, P, model, sigma, "gyro")
    accel_bias, sigma_accel = _with_drift(x, P, model, sigma, "accel")
    q_nb, v_n, (lat, lon, h) = motion[0], motion[1], motion[2].T
    return Estimates(
        t, lat, lon, h, v_n, q_nb, gyro_bias, accel_bias, covariance, sigma_gyro, sigma_accel,
        np.array(status, np.int64), extra,
    )  # fmt: skip


def align(alignment: Alignment, reference: Reference, sample: Sample) -> InitialState | None:
    """Give a sound sample to the alignment; the initial state once it is known."""
    if isinstance(sample, MagnetometerSample):
        alignment.add_field(sample.field_b)
    elif isinstance(sample, GnssSample):
        place = np.array([sample.lat, sample.lon, sample.h])
        return alignment.add_gnss(sample, reference.field_n(place) if reference.has_field else None)
    return None


def forget(P: Array, start: int, variance: Array) -> None:
    """Give a block of states new variances, independent of all others."""
    block = slice(start, start + len(variance))
    P[block, :] = 0.0
    P[:, block] = 0.0
    P[block, block] = np.diag(variance)


def _with_drift(
    x: Array, P: tuple[Array, int], model: ErrorModel, sigma: Array, sensor: str
) -> tuple[Array, Array]:  # fmt: skip
    """Biases (N, 3) of one kind of inertial sensor, its in-run part included, and the 1-sigma."""
    bias = model.slices[f"{sensor}_bias"]
    drift = model.slices.get(f"{sensor}_drift")
    if drift is None:
        return x[:, bias], sigma[:, bias]
    rows, first = P
    step = x.shape[1] + 1
    start = first + bias.start * x.shape[1] + drift.start  # of their covariances, on a diagonal of P
    variance = sigma[:, bias] ** 2 + sigma[:, drift] ** 2 + 2 * rows[:, start : start + 3 * step : step]
    return x[:, bias] + x[:, drift], np.sqrt(variance)


@njit
def spread(rows: Array, first: int, n: int, mounting_variance: float, off: Array) -> tuple[Array, Array]:
    """Covariances (N, 9, 9) in the order of an estimate, with the mounting's share, and 1-sigma (N, n) of every state.

    A covariance (n, n) begins in each of ``rows`` at the place ``first``. The motion is off by ``off`` (N, 9) or right,
    nobody knows which: half of its square comes on top, which is the second moment about the estimate where both are as
    likely.
    """
    covariance, sigma = np.empty((len(rows), MOTION, MOTION)), np.empty((len(rows), n))
    for k in range(len(rows)):
        for i in range(MOTION):
            a = ESTIMATE_ORDER[i]
            for j in range(MOTION):
                b = ESTIMATE_ORDER[j]
                covariance[k, i, j] = rows[k, first + a * n + b] + 0.5 * (off[k, a] * off[k, b])
            if a < PHI + 3:
                covariance[k, i, i] += mounting_variance
        for i in range(n):
            sigma[k, i] = math.sqrt(rows[k, first + i * (n + 1)])
    return covariance, sigma
