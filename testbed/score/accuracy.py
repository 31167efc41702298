"""Errors of an estimator against truth: what every score and figure begins with."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from nav import earth
from nav.samples import Array, Status
from testbed.errors import UserError

if TYPE_CHECKING:
    import xarray

SETTLING_S = 60.0  # after alignment, before errors count: biases and heading settle
RECOVERY_WINDOW_S = 10.0
SAME_TIME_S = 1e-6
SINGULAR = 1e-12  # determinant of correlations
LARGEST = 1e100  # of a number that is scored: of larger ones no sum of squares is a number
AXES = ("north", "east", "down")


Mask: TypeAlias = npt.NDArray[np.bool_]
Window: TypeAlias = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of one estimator where truth has a row at the same time: estimate - truth, by the conventions of `nav`.

    ``t`` (N,) [s]; ``position`` (N, 3) NED [m]; ``velocity`` (N, 3) NED [m/s]; ``attitude`` (N, 3) phi in n [rad];
    ``angles`` (N, 3) differences of roll, pitch and heading [rad]; ``sigma_*`` (N, 3) what the estimator claimed;
    ``*_nees`` (N,) normalised squared error over 3, NaN where the covariance is unknown or not positive definite;
    ``aligned_s`` time of alignment, None when never; ``attitude_only`` whether position and velocity are NaN by design;
    ``nonfinite`` (N,) rows that should be numbers and are not; ``valid`` (N,) rows that count. A position or a velocity
    that is never told is NaN in all of them, and not judged. Of a recorded flight the reference stands for truth: where
    it is unknown an error is NaN, which is not judged, and its own covariance is part of ``*_nees``.
    """

    t: Array
    position: Array
    velocity: Array
    attitude: Array
    angles: Array
    sigma_position: Array
    sigma_velocity: Array
    sigma_attitude: Array
    position_nees: Array
    velocity_nees: Array
    attitude_nees: Array
    aligned_s: float | None
    attitude_only: bool
    nonfinite: Mask
    valid: Mask

    @property
    def horizontal(self) -> Array:
        """Length of the horizontal position error (N,) [m]."""
        return np.hypot(self.position[:, 0], self.position[:, 1])

    @property
    def over_3sigma(self) -> Array:
        """Horizontal position error over three times its claimed sqrt(P_N + P_E) (N,), NaN where none is claimed."""
        claimed = 3.0 * np.hypot(self.sigma_position[:, 0], self.sigma_position[:, 1])
        ratio: Array = np.divide(self.horizontal, claimed, out=np.full(len(claimed), np.nan), where=claimed > 0)
        return ratio

    @property
    def tilt(self) -> Array:
        """Angle between true and estimated vertical (N,) [rad]."""
        return np.hypot(self.attitude[:, 0], self.attitude[:, 1])


def worst_over_3sigma(e: Errors, mask: Mask, key: str) -> dict[str, float]:
    """The largest horizontal error over the claimed 3 sigma of these rows; nothing where none is claimed."""
    values = e.over_3sigma[mask]
    values = values[np.isfinite(values)]
    return {key: float(values.max())} if len(values) else {}


def column(dataset: xarray.DataTree, path: str) -> npt.NDArray[Any]:
    """The bare array of one variable, such as ``truth/v_n``. Raises UserError of a record that lacks it."""
    *groups, name = path.split("/")
    try:
        node = reduce(lambda above, group: above.children[group], groups, dataset)
        return np.asarray(node.variables[name].values)  # `dataset[path]` makes a whole Dataset of the node
    except KeyError:
        raise UserError(f"damaged record: {path} is missing") from None


def names(dataset: xarray.DataTree) -> list[str]:
    """The recorded estimators with estimates, in the order of the scenario: a run that was cut off may lack some."""
    if "estimators" not in dataset.children:
        return []
    found = [name for name, node in dataset["estimators"].children.items() if "time" in node.coords]
    order = list(json.loads(str(dataset.attrs.get("estimator_imus", "{}"))))  # a file has them as they came to speak
    return sorted(found, key=lambda name: order.index(name) if name in order else len(order))


def ended(dataset: xarray.DataTree) -> dict[str, str]:
    """The estimators that ended by errors of their own before the run did, and why."""
    return {str(name): str(why) for name, why in json.loads(str(dataset.attrs.get("ended", "{}"))).items()}


def aids(dataset: xarray.DataTree, estimator: str) -> list[str]:
    """The aids whose innovations one estimator reported."""
    children = dataset.children["estimators"].children[estimator].children
    return list(children["innovations"].children) if "innovations" in children else []


def alignment(dataset: xarray.DataTree, estimator: str) -> tuple[Array, float | None]:
    """Times (N,) [s] of the estimates of which the truth is known, and the first at which it was aligned, if any."""
    own = f"estimators/{estimator}"
    rows, _ = _common(column(dataset, f"{own}/time"), column(dataset, "truth/time"))
    t, status = column(dataset, f"{own}/time")[rows], column(dataset, f"{own}/status")[rows]
    aligned = (status & Status.ALIGNED) != 0
    return t, float(t[np.argmax(aligned)]) if aligned.any() else None


def errors(dataset: xarray.DataTree, estimator: str, settling_s: float = SETTLING_S) -> Errors:
    """Errors of one estimator of a recorded run."""
    own = f"estimators/{estimator}"
    rows, at = _common(column(dataset, f"{own}/time"), column(dataset, "truth/time"))

    def estimated(name: str) -> Array:
        return np.asarray(column(dataset, f"{own}/{name}")[rows], np.float64)

    def claimed(first: int) -> Array:
        """Covariances of three states, which are a ninth of what is recorded."""
        own_states = slice(first, first + 3)
        return np.asarray(column(dataset, f"{own}/covariance")[:, own_states, own_states][rows], np.float64)

    def true(name: str) -> Array:
        return np.asarray(column(dataset, f"truth/{name}")[at], np.float64)

    t, aligned_s = alignment(dataset, estimator)
    position = earth.position_difference_n(
        estimated("lat"), estimated("lon"), estimated("h"), true("lat"), true("lon"), true("h")
    )
    velocity = estimated("v_n") - true("v_n")
    # The estimate is of the IMU, truth of the centre of gravity and a receiver of its antenna. (The Earth's own rate
    # does 1e-4 m/s per metre.)
    arm_b = np.array(json.loads(dataset.attrs["estimated_point_b_m"])[estimator], float)
    arm_b -= json.loads(dataset.attrs.get("reference_point_b_m", "[0, 0, 0]"))
    if arm_b.any():
        lying = np.where(np.isfinite(true("q_nb")), true("q_nb"), estimated("q_nb"))  # as near as anybody knows
        position -= rotated(lying, np.broadcast_to(arm_b, position.shape))
        velocity -= rotated(lying, np.cross(true("omega_b"), arm_b))
    for off in (position, velocity):
        off[~(np.abs(off) < LARGEST)] = np.nan
    attitude = attitude_error(estimated("q_nb"), true("q_nb"))
    status = column(dataset, f"{own}/status")[rows]
    aligned = (status & Status.ALIGNED) != 0
    whole = aligned & ((status & Status.ATTITUDE_ONLY) == 0)
    attitude_only = bool(aligned.any() and not whole.any())
    finite = np.asarray(np.isfinite(estimated("q_nb")).all(axis=1))
    # An attitude may be known before a position is; what is left out throughout was never claimed.
    begun = np.logical_or.accumulate(whole)
    for said in (np.column_stack([estimated(name) for name in ("lat", "lon", "h")]), estimated("v_n")):
        if not np.isnan(said[aligned]).all():
            finite &= np.asarray((np.abs(said) < LARGEST).all(axis=1)) | ~begun  # false for NaN
    since = np.zeros(len(t), bool) if aligned_s is None else t >= aligned_s
    settled = since if aligned_s is None else t >= aligned_s + settling_s
    own_n = np.array(json.loads(dataset.attrs.get("reference_sigma_n", "[0, 0, 0, 0, 0, 0]"))) ** 2
    return Errors(
        t=t,
        position=position,
        velocity=velocity,
        attitude=attitude,
        angles=wrapped(euler(estimated("q_nb")) - euler(true("q_nb"))),
        sigma_position=estimated("sigma_position_n"),
        sigma_velocity=estimated("sigma_velocity_n"),
        sigma_attitude=estimated("sigma_attitude_n"),
        position_nees=nees(position, claimed(0) + np.diag(own_n[:3])),
        velocity_nees=nees(velocity, claimed(3) + np.diag(own_n[3:])),
        attitude_nees=nees(attitude, claimed(6)),
        aligned_s=aligned_s,
        attitude_only=attitude_only,
        nonfinite=since & ~finite,
        valid=settled & finite,
    )


def _common(t: Array, t_true: Array) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Indices into both of the times they share."""
    if not len(t) or not len(t_true):
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    at = np.clip(np.searchsorted(t_true, t - SAME_TIME_S), 0, len(t_true) - 1)
    rows = np.flatnonzero(np.abs(t_true[at] - t) <= SAME_TIME_S)
    return rows, at[rows]


def rotated(q: Array, v: Array) -> Array:
    """Vectors (N, 3) in the axes that quaternions (N, 4) take them to."""
    twice = 2 * np.cross(q[:, 1:], v)
    turned: Array = v + q[:, :1] * twice + np.cross(q[:, 1:], twice)
    return turned


def attitude_error(q: Array, q_true: Array) -> Array:
    """Phi (N, 3) [rad] in n with ``C_hat = exp(-[phi x]) C``, of quaternions (N, 4) that take b to n."""
    w, v = q[:, :1], q[:, 1:]
    w0, v0 = q_true[:, :1], q_true[:, 1:]
    scalar = w * w0 + np.sum(v * v0, axis=1, keepdims=True)
    vector = w0 * v - w * v0 - np.cross(v, v0)  # of q times the inverse of q_true
    vector = np.where(scalar < 0, -vector, vector)
    sine = np.linalg.norm(vector, axis=1, keepdims=True)
    angle = 2 * np.arctan2(sine, np.abs(scalar))
    phi: Array = -vector * np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 0)
    return phi


def euler(q: Array) -> Array:
    """Roll, pitch, heading (N, 3) [rad] of q_nb (N, 4)."""
    w, x, y, z = q.T
    roll = np.arctan2(2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - x * z), -1.0, 1.0))
    heading = np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
    return np.column_stack([roll, pitch, heading])


def wrapped(angle: Array) -> Array:
    """The same angles in [-pi, pi)."""
    same: Array = np.mod(angle + np.pi, 2 * np.pi) - np.pi
    return same


def nees(error: Array, covariance: Array) -> Array:
    """Normalised squared error e' P^-1 e / n (N,) of errors (N, n) of covariances (N, n, n).

    With the correlations C = L diag(d) L' and y = L^-1 of the errors over their sigmas it is the mean of y^2 / d: for
    all N at once, where a library would solve one after the other. NaN where the covariance is singular, or not
    positive definite: then some d is not positive.
    """
    n = error.shape[1]
    L: dict[tuple[int, int], Array] = {}
    y: list[Array] = []
    d: list[Array] = []
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        scaled, correlation = error / sigma, covariance / (sigma[:, :, None] * sigma[:, None, :])
        for i in range(n):
            y_i, d_i = scaled[:, i].copy(), correlation[:, i, i].copy()
            for j in range(i):
                L[i, j] = (correlation[:, i, j] - sum(L[i, k] * L[j, k] * d[k] for k in range(j))) / d[j]
                d_i -= L[i, j] ** 2 * d[j]
                y_i -= L[i, j] * y[j]
            y.append(y_i)
            d.append(d_i)
        result: Array = sum(y_i**2 / d_i for y_i, d_i in zip(y, d, strict=True)) / n
    result[~(np.isfinite(result) & (np.min(d, axis=0) > 0) & (np.prod(d, axis=0) > SINGULAR))] = np.nan
    return result


def inside(t: Array, windows: list[Window]) -> Mask:
    """Which times (N,) lie in one of the windows [start, end)."""
    result = np.zeros(len(t), bool)
    for start, end in windows:
        result |= (t >= start) & (t < end)
    return result
