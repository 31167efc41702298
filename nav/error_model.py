"""The error state: which blocks it has, where they lie, and how they grow between measurements.

Error = estimate - truth (see `nav`). The first three blocks are the motion,

    phi  attitude error in n [rad], C_nb_hat = (I - [phi x]) C_nb
    dv   velocity error, NED [m/s]
    dp   position error, NED [m]

then come the blocks of inertial sensor errors, which drive the motion, then the errors of the aids, which do not.
Every block after the motion is a random walk or a first-order Markov process:

    e(t)' = -e / correlation_s + density * white noise

The motion obeys (f and omega of the sensors, b their errors, nominal C = C_nb):

    phi'  = -[w_in x] phi + (dw_in/dv) dv + (dw_in/dp) dp + C b_g
    dv'   = [f_n x] phi + ([v x] dw_en/dv - [(2 w_ie + w_en) x]) dv + ([v x] d(2 w_ie + w_en)/dp + dg/dp) dp - C b_a
    dp'   = dv + (dp'/dp) dp

where dp'/dp is the convergence of meridians and the curvature, and dg/dp the gravity gradient 2 g / R. Latitude
derivatives of the radii and of gravity are left out: they are a thousand times smaller than what is kept.

A paper whose filter has fewer states, or has them in another order, is a list of axes of blocks (`PAPERS`): where they
lie, `ErrorModel.places`, picks its rows and columns out of any matrix of the model, and its F by
F[np.ix_(places, places)] (`nav.observability.continuous`). What is left out is taken for known without error: height
and vertical velocity by the 13 states on the road and on the river; by the 6 of attitude alone the velocity, which is
zero, so that w_in = w_ie.

Source: Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd ed., section 14.2.4,
with position in metres; Titterton and Weston, 2nd ed., chapter 12. Verified in the tests by finite differences.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from nav._jit import inlined, lean
from nav.earth import OMEGA_IE, gravity_of, radii_of
from nav.samples import Array

Indices: TypeAlias = npt.NDArray[np.int64]

# Where the blocks of motion begin, and how many states they have together.
PHI, VEL, POS, MOTION = 0, 3, 6, 9


StateList: TypeAlias = Mapping[str, Sequence[int]]  # axes of blocks, in their order
_LEVEL, _ALL = (0, 1), (0, 1, 2)
_INS: StateList = {"phi": _ALL, "dv": _ALL, "dp": _ALL, "gyro_bias": _ALL, "accel_bias": _ALL}

# The states of the papers' filters, in the papers' order of blocks; axes NED where theirs are ENU or NUE. `_INS`, 15,
# is that of the main job too.
PAPERS: Mapping[str, StateList] = {
    # Equation 12.
    "cui2022_a": _INS,
    # Equation 36, 24: bias and Markov drift of the gyros, bias of the accelerometers, scale factors. The errors of a
    # receiver (Markov, 6) and of a Doppler radar (Markov and scale, 6) come after, under the names of these sensors:
    # `nav.local_filter.GnssAid` and `BodyVelocityAid`.
    "cui2022_b": dict.fromkeys(
        ("dp", "dv", "phi", "gyro_bias", "gyro_drift", "accel_bias", "gyro_scale", "accel_scale"), _ALL
    ),
    # "15-dimensional", no more is said.
    "zhou2025": _INS,
    # Equation 2, 13.
    "cheng2020": {"dv": _LEVEL, "dp": _LEVEL, "phi": _ALL, "accel_bias": _ALL, "gyro_bias": _ALL},
    # Equation 1, 13: height is the pressure gauge's.
    "zhu2020": {"dp": _LEVEL, "dv": _LEVEL, "phi": _ALL, "gyro_bias": _ALL, "accel_bias": _ALL},
    # Equation 5, 6: at rest relative to the Earth, as far as such gyros feel. Flown by `nav.ahrs`.
    "jiang2021": {"phi": _ALL, "gyro_bias": _ALL},
}


class Drive(IntEnum):
    """How a block enters the motion: added to a rate or force, scaling it, or crossing over from other axes (`CROSS`);
    NONE for the errors of aids.
    """

    NONE = -1
    GYRO = 0
    ACCEL = 1
    GYRO_SCALE = 2
    ACCEL_SCALE = 3
    GYRO_CROSS = 4
    ACCEL_CROSS = 5


# What the axis of the first index feels of the second, in the order of the states of a cross block.
CROSS = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
_OPPOSED = tuple((i, CROSS.index((of, axis))) for i, (axis, of) in enumerate(CROSS) if axis < of)


@dataclass(frozen=True, slots=True)
class Block:
    """One named group of error states.

    ``sigma`` is the 1-sigma at the start, one number or one per state; ``density`` the root spectral density of the
    driving noise [unit/sqrt(s)]; ``correlation_s`` the time constant, infinite for a random walk; ``covariance`` what
    two of the states, (i, j, covariance), have in common at the start.
    """

    name: str
    size: int
    sigma: float | tuple[float, ...]
    density: float | tuple[float, ...] = 0.0
    correlation_s: float = math.inf
    drive: Drive = Drive.NONE
    covariance: tuple[tuple[int, int, float], ...] = ()


def cross(name: str, misalignment: float, nonorthogonality: float, drive: Drive) -> Block:
    """What the axes of a triad feel of each other (`CROSS`), from 1-sigma [rad] of its turn and of its leaning axes.

    A small turn m of the triad is -[m x]: what one axis feels of another, that one feels of it with the opposite sign.
    Axes y and z lean, each by itself, towards those before them. Were the six taken for independent, a turn, which
    nothing in flight shows, would begin with half of its variance.
    """
    sigma = tuple(math.hypot(misalignment, nonorthogonality if of < axis else 0.0) for axis, of in CROSS)
    opposed = tuple((i, j, -(misalignment**2)) for i, j in _OPPOSED)
    return Block(name, len(CROSS), sigma, drive=drive, covariance=opposed)


def markov(
    name: str, size: int, sigma: float | tuple[float, ...], correlation_s: float, drive: Drive = Drive.NONE
) -> Block:
    """A stationary first-order Markov block: its variance stays sigma^2, density = sigma sqrt(2 / correlation_s)."""
    scale = math.sqrt(2 / correlation_s)
    density = scale * sigma if isinstance(sigma, float) else tuple(scale * s for s in sigma)
    return Block(name, size, sigma, density, correlation_s, drive)


@dataclass(frozen=True, slots=True)
class ImuModel:
    """What the filter is told of the inertial sensors, each axis alike.

    A bias is a turn-on value that walks, plus, when its sigma is not zero, an in-run part that is first-order Markov.
    Scale factor errors are states when their sigma is not zero, and so is what an axis feels of the others when a triad
    is told to be turned or not square (`cross`).

    Errors that come with motion and have no state are white noise beside that of rest: ``gyro_motion`` and
    ``accel_motion`` are the shares of the rate, and of the specific force less gravity, that go wrong over each
    second, as scale and alignment of small units do while a manoeuvre lasts; ``vibration`` the share of the noise that
    the increments themselves show (`nav.state.propagate`).
    """

    gyro_noise: float  # angle random walk [rad/sqrt(s)]
    accel_noise: float  # velocity random walk [m/s/sqrt(s)]
    gyro_bias_sigma: float  # turn-on bias [rad/s]
    accel_bias_sigma: float  # [m/s^2]
    gyro_bias_walk: float = 0.0  # rate random walk [rad/s/sqrt(s)]
    accel_bias_walk: float = 0.0  # [m/s^2/sqrt(s)]
    gyro_drift_sigma: float = 0.0  # in-run bias [rad/s]
    accel_drift_sigma: float = 0.0  # [m/s^2]
    gyro_drift_correlation_s: float = 300.0
    accel_drift_correlation_s: float = 300.0
    gyro_scale_sigma: float = 0.0  # scale factor error [1]
    accel_scale_sigma: float = 0.0
    gyro_misalignment: float = 0.0  # small turn of the triad, about each axis [rad]
    accel_misalignment: float = 0.0
    gyro_nonorthogonality: float = 0.0  # by which y and z lean towards the axes before them [rad]
    accel_nonorthogonality: float = 0.0
    gyro_motion: float = 0.0  # [1]
    accel_motion: float = 0.0  # [1]
    vibration: float = 0.0  # [1]

    @property
    def in_motion(self) -> Array:
        """Squares (4,) of the shares by which noise follows motion and vibration; last a 1, for the whole of a motion
        that nobody sees where increments are missing. Filters that share one have each of them over its share.
        """
        return np.array([self.gyro_motion, self.accel_motion, self.vibration, 1.0]) ** 2

    def blocks(self) -> list[Block]:
        """The motion (its noise is the sensors' white noise) and the sensor errors that drive it."""
        blocks = [
            Block("phi", 3, 0.0, self.gyro_noise),
            Block("dv", 3, 0.0, self.accel_noise),
            Block("dp", 3, 0.0),
            Block("gyro_bias", 3, self.gyro_bias_sigma, self.gyro_bias_walk, drive=Drive.GYRO),
            Block("accel_bias", 3, self.accel_bias_sigma, self.accel_bias_walk, drive=Drive.ACCEL),
        ]
        if self.gyro_drift_sigma > 0:
            blocks.append(markov("gyro_drift", 3, self.gyro_drift_sigma, self.gyro_drift_correlation_s, Drive.GYRO))
        if self.accel_drift_sigma > 0:
            blocks.append(markov("accel_drift", 3, self.accel_drift_sigma, self.accel_drift_correlation_s, Drive.ACCEL))
        if self.gyro_scale_sigma > 0:
            blocks.append(Block("gyro_scale", 3, self.gyro_scale_sigma, drive=Drive.GYRO_SCALE))
        if self.accel_scale_sigma > 0:
            blocks.append(Block("accel_scale", 3, self.accel_scale_sigma, drive=Drive.ACCEL_SCALE))
        if self.gyro_misalignment > 0 or self.gyro_nonorthogonality > 0:
            blocks.append(cross("gyro_cross", self.gyro_misalignment, self.gyro_nonorthogonality, Drive.GYRO_CROSS))
        if self.accel_misalignment > 0 or self.accel_nonorthogonality > 0:
            blocks.append(cross("accel_cross", self.accel_misalignment, self.accel_nonorthogonality, Drive.ACCEL_CROSS))
        return blocks


class ErrorModel:
    """The layout of the error state and the constants of its growth, from the sensors' model and the aids' blocks.

    ``size`` states, the first ``mixing`` of which take part in the motion; ``slices[name]`` is where a block lies and
    ``start(name)`` where it begins, -1 when there is none. ``sigma``, ``density``, ``decay_rate`` (size,) hold each
    state's initial 1-sigma, noise density and 1/correlation_s; ``prior`` (size, size) the covariance at the start;
    ``driven`` (blocks, 2) the kind and the start of each block that drives the motion.
    """

    def __init__(self, imu: ImuModel, aid_blocks: Iterable[Block] = ()) -> None:
        self.imu = imu
        self.blocks = [*imu.blocks(), *aid_blocks]
        if any(block.drive is not Drive.NONE for block in self.blocks[len(imu.blocks()) :]):
            raise ValueError("the error of an aid cannot drive the motion")
        self.slices: dict[str, slice] = {}
        end = 0
        for block in self.blocks:
            if block.name in self.slices:
                raise ValueError(f"two blocks named {block.name}")
            self.slices[block.name] = slice(end, end + block.size)
            end += block.size
        self.size = end
        self.sigma, self.density, self.decay_rate = np.zeros(end), np.zeros(end), np.zeros(end)
        driven = []
        for block in self.blocks:
            where = self.slices[block.name]
            self.sigma[where] = block.sigma
            self.density[where] = block.density
            self.decay_rate[where] = 1 / block.correlation_s
            if block.drive is not Drive.NONE:
                driven.append((int(block.drive), where.start))
        self.prior = np.diag(self.sigma**2)
        for block in self.blocks:
            for i, j, covariance in block.covariance:
                row, column = self.slices[block.name].start + i, self.slices[block.name].start + j
                self.prior[row, column] = self.prior[column, row] = covariance
        self.driven = np.array(driven, dtype=np.int64)
        self.mixing = self.slices[imu.blocks()[-1].name].stop

    def start(self, name: str) -> int:
        """Index of the first state of block ``name``, -1 when the model has no such block."""
        return self.slices[name].start if name in self.slices else -1

    def places(self, states: StateList) -> Indices:
        """Indices (m,) of the listed axes, block by block as they are listed."""
        missing = [name for name in states if name not in self.slices]
        if missing:
            raise ValueError(f"there is no block {missing[0]} among {', '.join(self.slices)}")
        return np.array([self.slices[name].start + axis for name, axes in states.items() for axis in axes])


@lean
def sensor_errors(errors: Array, x: Array, driven: Indices) -> None:
    """Sum the estimated inertial errors by kind: ``errors`` (4, 3), rows as `Drive`; ``x`` (size,) estimated values.

    What crosses over from other axes is no error of one axis: `take_errors` takes it off too.
    """
    for kind in range(len(errors)):
        for axis in range(3):
            errors[kind, axis] = 0.0
    for block in range(len(driven)):
        kind, start = driven[block, 0], driven[block, 1]
        if kind < len(errors):
            for axis in range(3):
                errors[kind, axis] += x[start + axis]


@inlined
def take_errors(
    angle: Array, push: Array, rates: Array, T: float, errors: Array, imu: Array, driven: Indices
) -> None:  # fmt: skip
    """Fill ``angle`` and ``push`` (3,) with an increment less the sensor errors that are estimated.

    ``rates`` (2, 3) are angular rate and specific force as measured over its ``T`` seconds, ``errors`` those of
    `sensor_errors`, ``imu`` the estimated values.
    """
    for i in range(3):
        angle[i] = (rates[0, i] - errors[0, i]) * T / (1.0 + errors[2, i])
        push[i] = (rates[1, i] - errors[1, i]) * T / (1.0 + errors[3, i])
    _uncross(angle, push, imu, driven)


@inlined
def _uncross(angle: Array, push: Array, imu: Array, driven: Indices) -> None:
    """Take off increments, in place, what crosses over from other axes by the estimates ``imu``, to first order."""
    for block in range(len(driven)):
        kind, start = driven[block, 0], driven[block, 1]
        if kind == Drive.GYRO_CROSS or kind == Drive.ACCEL_CROSS:
            of = angle if kind == Drive.GYRO_CROSS else push
            x, y, z = of[0], of[1], of[2]
            of[0] -= imu[start] * y + imu[start + 1] * z
            of[1] -= imu[start + 2] * x + imu[start + 3] * z
            of[2] -= imu[start + 4] * x + imu[start + 5] * y


@inlined
def transition(Phi: Array, FT: Array, driven: Indices, v_n: Array, lat: float, h: float, sums: Array, T: float) -> None:
    """Fill ``Phi`` (9, mixing), the rows of the motion in the transition over the ``T`` seconds just passed.

    ``sums`` (3, 3, 3) holds, over those T seconds, the integrals of C_nb, of C_nb diag(omega_b) and of C_nb diag(f_b);
    ``v_n``, ``lat``, ``h`` are where the interval ends; ``FT`` (9, mixing) is scratch. Phi = I + F T + (F T)^2 / 2 with
    F averaged over the interval. The remaining rows of the whole transition are diagonal and not formed here.
    """
    mixing = Phi.shape[1]
    for i in range(MOTION):  # a loop compiles in a tenth of the time of an assignment to all
        for j in range(mixing):
            FT[i, j] = 0.0
    sin_lat, cos_lat = math.sin(lat), math.cos(lat)
    tan_lat = sin_lat / cos_lat
    sin2 = sin_lat * sin_lat
    R_M, R_N = radii_of(sin2)
    rm, rn = 1 / (R_M + h), 1 / (R_N + h)
    vn, ve, vd = v_n[0] * T, v_n[1] * T, v_n[2] * T  # every term below is already times T
    ie_n, ie_d = OMEGA_IE * cos_lat * T, -OMEGA_IE * sin_lat * T
    en_n, en_e, en_d = ve * rn, -vn * rm, -ve * tan_lat * rn
    # d(w_en)/d(lat) has a down part only; per metre north, and per metre down (that is -d/dh)
    en_d_north = -ve * rn / (cos_lat * cos_lat) * rm
    ie_n_north, ie_d_north = ie_d * rm, -ie_n * rm
    en_n_down, en_e_down, en_d_down = en_n * rn, en_e * rm, en_d * rn

    # phi
    _skew(FT, PHI, PHI, -(ie_n + en_n), -en_e, -(ie_d + en_d))
    FT[PHI, VEL + 1] = rn * T
    FT[PHI + 1, VEL] = -rm * T
    FT[PHI + 2, VEL + 1] = -tan_lat * rn * T
    FT[PHI, POS] = ie_n_north
    FT[PHI + 2, POS] = ie_d_north + en_d_north
    FT[PHI, POS + 2] = en_n_down
    FT[PHI + 1, POS + 2] = en_e_down
    FT[PHI + 2, POS + 2] = en_d_down

    # dv
    _skew(
        FT,
        VEL,
        PHI,
        sums[2, 0, 0] + sums[2, 0, 1] + sums[2, 0, 2],
        sums[2, 1, 0] + sums[2, 1, 1] + sums[2, 1, 2],
        sums[2, 2, 0] + sums[2, 2, 1] + sums[2, 2, 2],
    )
    _skew(FT, VEL, VEL, -(2 * ie_n + en_n), -en_e, -(2 * ie_d + en_d))
    # [v x] times the columns of dw_en/dv: north velocity turns n about east, east velocity about north and down
    FT[VEL, VEL] += vd * rm
    FT[VEL + 2, VEL] -= vn * rm
    FT[VEL, VEL + 1] -= ve * tan_lat * rn
    FT[VEL + 1, VEL + 1] += vd * rn + vn * tan_lat * rn
    FT[VEL + 2, VEL + 1] -= ve * rn
    # [v x] times d(2 w_ie + w_en)/dp; v here is not times T
    turn_n, turn_d = 2 * ie_n_north, 2 * ie_d_north + en_d_north
    FT[VEL, POS] = v_n[1] * turn_d
    FT[VEL + 1, POS] = v_n[2] * turn_n - v_n[0] * turn_d
    FT[VEL + 2, POS] = -v_n[1] * turn_n
    FT[VEL, POS + 2] = v_n[1] * en_d_down - v_n[2] * en_e_down
    FT[VEL + 1, POS + 2] = v_n[2] * en_n_down - v_n[0] * en_d_down
    FT[VEL + 2, POS + 2] = v_n[0] * en_e_down - v_n[1] * en_n_down
    FT[VEL + 2, POS + 2] += 2 * gravity_of(sin2, h) / (math.sqrt(R_M * R_N) + h) * T

    # dp
    FT[POS, VEL] = FT[POS + 1, VEL + 1] = FT[POS + 2, VEL + 2] = T
    FT[POS, POS] = -vd * rm
    FT[POS, POS + 2] = vn * rm
    FT[POS + 1, POS] = ve * tan_lat * rm
    FT[POS + 1, POS + 1] = -vd * rn - vn * tan_lat * rn
    FT[POS + 1, POS + 2] = ve * rn

    for block in range(len(driven)):
        kind, start = driven[block, 0], driven[block, 1]
        if kind == Drive.GYRO_CROSS or kind == Drive.ACCEL_CROSS:
            _cross(FT, start, kind == Drive.GYRO_CROSS, sums, T)
        else:
            row, sign = (PHI, 1.0) if kind == Drive.GYRO or kind == Drive.GYRO_SCALE else (VEL, -1.0)
            term = max(0, kind - 1)  # plain biases share the integral of C_nb
            for i in range(3):
                for j in range(3):
                    FT[row + i, start + j] = sign * sums[term, i, j]

    for i in range(MOTION):
        for j in range(mixing):
            Phi[i, j] = FT[i, j]
        Phi[i, i] += 1.0
        for k in range(MOTION):
            half = 0.5 * FT[i, k]
            if half != 0.0:
                for j in range(mixing):
                    Phi[i, j] += half * FT[k, j]


@inlined
def _cross(FT: Array, start: int, gyro: bool, sums: Array, T: float) -> None:
    """Fill the columns of a cross block (`CROSS`): the mean axis of the one, times what the other felt over ``T``."""
    row, term, sign = (PHI, 1, 1.0) if gyro else (VEL, 2, -1.0)
    for c in range(6):
        one = c // 2
        other = (c % 2) if (c % 2) < one else (c % 2) + 1
        felt = 0.0
        for k in range(3):
            felt += sums[0, k, other] * sums[term, k, other]
        for i in range(3):
            FT[row + i, start + c] = sign * sums[0, i, one] * felt / (T * T)


@inlined
def _skew(matrix: Array, row: int, column: int, x: float, y: float, z: float) -> None:
    """Write [(x, y, z) x] into ``matrix`` with its corner at (row, column)."""
    matrix[row, column + 1], matrix[row, column + 2] = -z, y
    matrix[row + 1, column], matrix[row + 1, column + 2] = z, -x
    matrix[row + 2, column], matrix[row + 2, column + 1] = -y, x
