"""What is seen of the ground: its range along the body's down axis, and how its image moves.

Both are predicted from the height over the map, with the error of the map as states (`TERRAIN`, `LOCAL`) that they
share: a rangefinder finds it, and optical flow is a velocity then. Over relief a range tells of the position, too: its
Jacobian has the slope of the map where the line of sight ends (SITAN: Hostetler and Andreas, Nonlinear Kalman Filtering
Techniques for Terrain-Aided Navigation, IEEE Trans. Automatic Control 28 (3), 1983), taken over as far as the position
is uncertain (`REACH`), as theirs is of a plane fitted there: a slope at a point would make a filter sure of where the
map has its bends. Where that is farther than hills are wide, all places are tried instead (`Search`). A range that
repeats itself is not used (`STUCK`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from nav._jit import njit
from nav.aids.base import NO_RATES, Axes, Measurement, OperatingPoint, Ruling, range_problem
from nav.aids.gnss import gnss_position, gnss_velocity
from nav.aids.position_fix import position_fix
from nav.earth import earth_rate_n, radii
from nav.error_model import PHI, POS, VEL, Block, markov
from nav.point_mass import Fix, PointMass
from nav.rotation import cross, dcm_from_quat
from nav.samples import Array, OpticalFlowSample, Outcome, RangeSample, Sample
from nav.terrain import Terrain, slant_range, slope

TERRAIN = "terrain"  # the state: how much higher the ground is than on the map, everywhere [m]
LOCAL = "terrain_local"  # and here, first-order Markov along the way [m]
RANGE_LIMITS, RATE_LIMIT = (0.0, 20_000.0), 100.0  # what an instrument could possibly report [m], [rad/s]
LEAST_QUALITY = 0.01
TIME_TOLERANCE = 1e-6  # [s]
LOST_M, FOUND_M = 100.0, 50.0  # sigma of the position per axis from which on it is searched, and no more
WEIGH_S, FIX_S = 1.0, 5.0  # in a search, from one range that is used to the next, and from one attempt at a fix
GAP_S, GIVE_UP_S = 5.0, 240.0  # without a range, or without a fix, it begins again
# The same range to the last digit, so often in a row and faster than that, is no echo of relief: the sensor is stuck.
REPEATED, MOVING_MPS = 5, 5.0
STUCK = Ruling(Outcome.ISOLATED, "the same range again and again: the sensor is stuck")
REACH = 2.0  # sigma of the horizontal position, to either side, over which slopes are taken


class Search:
    """Where over the map a filter is that doesn't know: from its ranges, as fixes in place of these (`PointMass`).

    It belongs to one filter, from its beginning on.
    """

    def __init__(self, places: PointMass) -> None:
        self.places = places
        self.lost = self._begun = False
        self.fix: Fix | None = None
        self._t = self._tried = -math.inf
        self._v_n = np.zeros(3)
        self._range, self._repeated = math.nan, 0

    @property
    def stuck(self) -> bool:
        """Whether the latest range was the same as those before, too often for relief."""
        return self._repeated >= REPEATED

    def hear(self, sample: RangeSample, at: OperatingPoint, height_sigma: float) -> None:
        """Take in a sample, once. A filter is `lost` from then on or not; `fix` is of this sample, if there is one.

        ``height_sigma`` [m] is that of what makes heights wrong as a whole, beside the filter's own height.
        """
        t, state, places = sample.t, at.state, self.places
        if t == self._t:
            return
        self._t, self.fix = t, None
        moving = math.hypot(state.v_n[0], state.v_n[1]) > MOVING_MPS
        self._repeated = self._repeated + 1 if sample.range == self._range and moving else 1
        self._range = sample.range
        P, own = at.P[POS : POS + 2, POS : POS + 2], at.x[: POS + 3]
        sigma = math.sqrt(0.5 * P.trace())
        self.lost = sigma > (FOUND_M if self.lost else LOST_M)
        if not self.lost or self.stuck:
            self._begun = False
            return
        R_M, R_N = radii(state.lla[0])
        lat = state.lla[0] + own[POS] / R_M
        lon = state.lla[1] + own[POS + 1] / (R_N * math.cos(lat))
        v_n, h = state.v_n + own[VEL : VEL + 3], state.lla[2] - own[POS + 2]
        if not self._begun or t - places.t > GAP_S or t - places.t_begun > GIVE_UP_S:
            height_sigma = math.hypot(height_sigma, math.sqrt(at.P[POS + 2, POS + 2]))
            places.begin(t, np.array([lat, lon, h]), P, height_sigma)
            self._begun, self._tried, self._v_n = True, t, v_n
        elif t - places.t >= WEIGH_S - TIME_TOLERANCE:
            variance = at.P.diagonal()[VEL : VEL + 3]
            places.move(t, 0.5 * (v_n + self._v_n), np.sqrt([0.5 * (variance[0] + variance[1]), variance[2]]))
            self._v_n = v_n
            places.weigh(sample.range * dcm_from_quat(state.q_nb)[:, 2])
            if not places.fits:
                self._begun = False
            elif t - self._tried >= FIX_S:
                self._tried = t
                self.fix = places.fix(lat, lon, P)
                self._begun = self.fix is None


@dataclass(frozen=True)
class RangefinderAid:
    """Range to the ground along the body's down axis, with white noise and an unknown scale factor.

    With a ``search`` a filter that doesn't know where it is has fixes instead, one for many ranges, along the axes of
    their covariance.

    ``map_sigma`` [m] is how well the ``terrain`` is known as a whole, ``local_sigma`` from place to place, of errors
    that pass by in ``local_correlation_s``.
    """

    sensor: str = "rangefinder"
    sigma: float = 0.5  # [m]
    scale_sigma: float = 0.0  # [1]
    terrain: Terrain = field(default_factory=Terrain)
    map_sigma: float = 5.0
    local_sigma: float = 0.0
    local_correlation_s: float = 10.0
    search: Search | None = None
    arm_b: Axes = (0.0, 0.0, 0.0)  # IMU to sensor [m]; a search, which is after tens of metres, leaves it out

    @property
    def parts(self) -> tuple[tuple[str, int], ...]:
        """See `Aid`."""
        return (("range", 1),) if self.search is None else (("range", 1), ("terrain_fix", 2))

    @property
    def states(self) -> tuple[str, ...]:
        """See `Aid`."""
        return TERRAIN, LOCAL, f"{self.sensor}_scale"

    def blocks(self) -> list[Block]:
        """See `Aid`."""
        return [
            *ground_blocks(self.map_sigma, self.local_sigma, self.local_correlation_s),
            Block(self.states[2], 1, self.scale_sigma),
        ]

    @cached_property
    def _R(self) -> Array:
        return np.array([self.sigma**2])

    def measure(self, part: str, sample: Sample, at: OperatingPoint) -> Measurement | None:
        """See `Aid`."""
        assert isinstance(sample, RangeSample)
        if self.search is not None:
            raised = self.map_sigma if at.starts[0] < 0 else math.sqrt(at.P[at.starts[0], at.starts[0]])
            self.search.hear(sample, at, math.hypot(max(self.map_sigma, raised), self.scale_sigma * sample.range))
            if part == "terrain_fix":
                return None if self.search.fix is None else _fixed(self.search.fix, at)
            if self.search.lost and not self.search.stuck:
                return None
        terrain, (raised, local, scale) = self.terrain, at.starts
        lla, _, place, _ = there(at, self.arm_b)
        nu, H = range_to_ground(
            at.state.q_nb, lla, at.x, raised, local, scale, reach(at.P), sample.range, terrain.heights, terrain.grid
        )
        stuck = STUCK if self.search is not None and self.search.stuck else None
        return None if math.isnan(nu[0]) else Measurement(nu, H + H[:, POS : POS + 3] @ place, self._R, stuck)


@dataclass(frozen=True)
class OpticalFlowAid:
    """Rates of the line of sight about body x and y, less the rotation that the sensor's own gyro measures.

    ``sigma`` [rad/s] white at full quality, its variance goes with the inverse of the quality; the optics have a scale
    error, ``error_sigma`` [rad/s] is of a slow error (Markov), such as the bias of its gyro.
    """

    sensor: str = "optical_flow"
    sigma: float = 0.002
    scale_sigma: float = 0.0
    error_sigma: float = 0.0
    error_correlation_s: float = 300.0
    terrain: Terrain = field(default_factory=Terrain)
    map_sigma: float = 5.0
    local_sigma: float = 0.0
    local_correlation_s: float = 10.0
    arm_b: Axes = (0.0, 0.0, 0.0)  # IMU to sensor [m]

    parts = (("optical_flow", 2),)

    @property
    def states(self) -> tuple[str, ...]:
        """See `Aid`."""
        return TERRAIN, LOCAL, f"{self.sensor}_scale", f"{self.sensor}_error"

    def blocks(self) -> list[Block]:
        """See `Aid`."""
        *_, scale, error = self.states
        return [
            *ground_blocks(self.map_sigma, self.local_sigma, self.local_correlation_s),
            Block(scale, 1, self.scale_sigma),
            markov(error, 2, self.error_sigma, self.error_correlation_s),
        ]

    def measure(self, part: str, sample: Sample, at: OperatingPoint) -> Measurement | None:
        """See `Aid`."""
        assert isinstance(sample, OpticalFlowSample)
        terrain, (raised, local, scale, error) = self.terrain, at.starts
        lla, v_n, place, swing = there(at, self.arm_b)
        nu, H = optical_flow(
            at.state.q_nb, v_n, lla, at.x, raised, local, scale, error, reach(at.P), sample.flow_b,
            sample.rotation_b, terrain.heights, terrain.grid,
        )  # fmt: skip
        H += H[:, POS : POS + 3] @ place + H[:, VEL : VEL + 3] @ swing
        R = np.full(2, self.sigma**2 / max(sample.quality, LEAST_QUALITY))
        unknown = NO_RATES if any(self.arm_b) and not at.state.rates[0].any() else None
        return None if math.isnan(nu[0]) else Measurement(nu, H, R, unknown)


def there(at: OperatingPoint, arm_b: Axes) -> tuple[Array, Array, Array, Array]:
    """Where a sensor is that is ``arm_b`` [m] from the IMU, and how fast: lat, lon [rad], h [m] and v_n [m/s], (3,).

    And what all errors but the IMU's own of position and velocity change of both: Jacobians (3, n), to be led on by
    those of the measurement. See `nav.aids.gnss.gnss_position` and `gnss_velocity`.
    """
    state, arm, nothing = at.state, np.array(arm_b, dtype=float), np.zeros((3, len(at.x)))
    if not arm.any():
        return state.lla, state.v_n, nothing, nothing
    lat, lon, h = state.lla.tolist()
    R_M, R_N = radii(lat)
    before, place = gnss_position(state.q_nb, state.lla, at.x, arm, -1, lat, lon, h)
    north, east, down = (-before).tolist()
    before, swing = gnss_velocity(
        state.q_nb, state.v_n, state.lla, at.x, state.rates[0], state.errors, at.reference.driven, arm, -1, np.zeros(3)
    )
    place[:, POS : POS + 3] = swing[:, VEL : VEL + 3] = 0.0
    lla = np.array([lat + north / (R_M + h), lon + east / ((R_N + h) * math.cos(lat)), h - down])
    return lla, -before, place, swing


def _fixed(fix: Fix, at: OperatingPoint) -> Measurement:
    """A fix as a measurement, along the axes of its covariance."""
    nu, H = position_fix(at.state.q_nb, at.state.lla, at.x, np.zeros(3), fix.lat, fix.lon, math.nan)
    R, axes = np.linalg.eigh(fix.R)
    return Measurement(axes.T @ nu, axes.T @ H, R)


def reach(P: Array) -> float:
    """Over how many metres to either side a filter of covariance ``P`` (n, n) takes slopes."""
    return REACH * math.sqrt(0.5 * (P[POS, POS] + P[POS + 1, POS + 1]))


def ground_blocks(map_sigma: float, local_sigma: float, local_correlation_s: float) -> list[Block]:
    """The error of the map, which all who look at the ground share."""
    return [Block(TERRAIN, 1, map_sigma), markov(LOCAL, 1, local_sigma, local_correlation_s)]


def range_trouble(sample: RangeSample) -> str:
    """See `nav.aids.problem`."""
    return range_problem("range", sample.range, RANGE_LIMITS)


def flow_trouble(sample: OpticalFlowSample) -> str:
    """See `nav.aids.problem`."""
    largest = float(np.abs(np.concatenate([sample.flow_b, sample.rotation_b])).max())
    return range_problem("rate", largest, (0.0, RATE_LIMIT)) or range_problem("quality", sample.quality, (0.0, 1.0))


@njit
def _sight(
    q_nb: Array, lla: Array, x: Array, terrain: int, local: int, reach: float, heights: Array, grid: Array
) -> tuple[float, Array]:
    """Range r [m] along the body's down axis u to the ground, and dr / d error state (n,); NaN where there is none.

    p + r u is on the ground of slope g, so with D = u_D + g_N u_N + g_E u_E, phi turning u by u x phi,

        D dr = dh - r (e_D + g_N e_N + g_E e_E) . du - g . dp - d terrain
    """
    C_nb = dcm_from_quat(q_nb)
    u = np.array([C_nb[0, 2], C_nb[1, 2], C_nb[2, 2]])
    h = np.zeros(len(x))
    raised = x[terrain] if terrain >= 0 else 0.0
    if local >= 0:
        raised += x[local]
    length, lat, lon = slant_range(lla, u, raised, heights, grid)
    if math.isnan(length):
        return length, h
    slope_n, slope_e = slope(lat, lon, reach, heights, grid)
    normal = np.array([slope_n, slope_e, 1.0])
    closing = u[0] * normal[0] + u[1] * normal[1] + u[2]
    turned = cross(normal, u)  # normal . (u x phi) = (normal x u) . phi
    for i in range(3):
        h[PHI + i] = -length * turned[i] / closing
        h[POS + i] = -normal[i] / closing
    for state in (terrain, local):
        if state >= 0:
            h[state] = -1.0 / closing
    return length, h


@njit
def range_to_ground(
    q_nb: Array,
    lla: Array,
    x: Array,
    terrain: int,
    local: int,
    scale: int,
    reach: float,
    measured: float,
    heights: Array,
    grid: Array,
) -> tuple[Array, Array]:
    """Range [m]: (1 + scale) r along the body's down axis; see `_sight`."""
    length, h = _sight(q_nb, lla, x, terrain, local, reach, heights, grid)
    gain = 1.0 + x[scale] if scale >= 0 else 1.0
    H = np.empty((1, len(x)))
    for i in range(len(x)):
        H[0, i] = gain * h[i]
    if scale >= 0:
        H[0, scale] = length
    return np.array([measured - gain * length]), H


@njit
def optical_flow(
    q_nb: Array, v_n: Array, lla: Array, x: Array, terrain: int, local: int, scale: int, error: int,
    reach: float, flow_b: Array, rotation_b: Array, heights: Array, grid: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Flow less rotation about body x and y [rad/s]: (1 + scale)(w_ge + m) + scale w_rotation + error.

    Of a camera that looks down at the range r the scene turns by w + m, m = (-v_y, v_x) / r in body axes: a rotation
    about an axis is a positive flow about it (MAVLink, OPTICAL_FLOW_RAD). w is that relative to the ground; the gyro
    ``rotation_b`` (2,) feels the Earth turn as well, so w_ge = -C_nb' w_ie remains.
    """
    C_nb = dcm_from_quat(q_nb)
    length, h = _sight(q_nb, lla, x, terrain, local, reach, heights, grid)
    earth_n = earth_rate_n(lla[0])
    gain = 1.0 + x[scale] if scale >= 0 else 1.0
    nu, H = np.empty(2), np.zeros((2, len(x)))
    for row in range(2):
        sign, axis = (-1.0, 1) if row == 0 else (1.0, 0)
        along = np.array([C_nb[0, axis], C_nb[1, axis], C_nb[2, axis]])
        speed = sign * (along[0] * v_n[0] + along[1] * v_n[1] + along[2] * v_n[2])
        turned = cross(v_n, along)
        about = np.array([C_nb[0, row], C_nb[1, row], C_nb[2, row]])
        behind = -(about[0] * earth_n[0] + about[2] * earth_n[2])
        carried = cross(earth_n, about)
        moved = speed / length + behind
        nu[row] = flow_b[row] - rotation_b[row] - gain * moved
        for j in range(len(x)):
            H[row, j] = -gain * speed / (length * length) * h[j]
        for i in range(3):
            H[row, PHI + i] += gain * (sign * turned[i] / length - carried[i])
            H[row, VEL + i] += gain * sign * along[i] / length
        if scale >= 0:
            nu[row] -= x[scale] * rotation_b[row]
            H[row, scale] = moved + rotation_b[row]
        if error >= 0:
            nu[row] -= x[error + row]
            H[row, error + row] = 1.0
    return nu, H
