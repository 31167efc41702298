"""How well each estimator did: errors against truth, outage and recovery, consistency of claimed covariances.

Keys are ``<estimator>.<quantity>_<statistic>_<unit>``. What they count:

* Rows from `SETTLING_S` after the estimator first called itself aligned.
* Keys without prefix: while GNSS has a fix (or all the time, in a run without GNSS receiver), but not the first
  `RECOVERY_WINDOW_S` after an outage, which ``recovery_s`` judges by itself.
* Keys with ``outage_`` in front: while no receiver has a fix, up to the arrival of the next fix.
* An estimate is of the point where its IMU sits, and is compared with the true position and velocity of that point.
* Horizontal errors are the length of the 2-D error; ``roll_pitch`` is the angle between the true and the estimated
  vertical; ``heading`` is the rotation about the vertical; ``velocity`` is the length of the 3-D error.
* An estimator of attitude alone (`Status.ATTITUDE_ONLY`) is judged by its attitude alone.
* NEES and NIS are per degree of freedom: 1 is perfectly consistent, above is overconfident.
* A quantity that could not be formed (no outage, never aligned, never recovered) has no key. Nothing is ever NaN.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from nav import earth
from nav.samples import Array, FixType, Status
from testbed.data import write_file

if TYPE_CHECKING:
    import xarray

SETTLING_S = 60.0  # after alignment, before errors count: biases and heading settle
RECOVERY_WINDOW_S = 10.0
RECOVERED_M = 5.0  # horizontal error that counts as recovered
RECOVERED_HOLD_S = 30.0  # and for how long it has to stay there
OUTAGE_MARKS_S = (60, 120, 300, 600)
SAME_TIME_S = 1e-6

Mask: TypeAlias = npt.NDArray[np.bool_]
Window: TypeAlias = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of one estimator where truth has a row at the same time: estimate - truth, by the conventions of `nav`.

    ``t`` (N,) [s]; ``position`` (N, 3) NED [m]; ``velocity`` (N, 3) NED [m/s]; ``attitude`` (N, 3) phi in n [rad];
    ``sigma_*`` (N, 3) what the estimator claimed; ``*_nees`` (N,) normalised squared error over 3, NaN where the
    covariance is singular; ``aligned_s`` time of alignment, None when never; ``attitude_only`` whether position and
    velocity are NaN by design; ``nonfinite`` (N,) rows that should be numbers and are not; ``valid`` (N,) rows that
    count.
    """

    t: Array
    position: Array
    velocity: Array
    attitude: Array
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
    def tilt(self) -> Array:
        """Angle between true and estimated vertical (N,) [rad]."""
        return np.hypot(self.attitude[:, 0], self.attitude[:, 1])


def column(dataset: xarray.DataTree, path: str) -> npt.NDArray[Any]:
    """The bare array of one variable, such as ``truth/v_n``."""
    return np.asarray(cast("xarray.DataArray", dataset[path]).values)


def names(dataset: xarray.DataTree) -> list[str]:
    """The recorded estimators, in the order of the scenario."""
    return list(dataset["estimators"].children) if "estimators" in dataset.children else []


def aids(dataset: xarray.DataTree, estimator: str) -> list[str]:
    """The aids whose innovations one estimator reported."""
    children = dataset.children["estimators"].children[estimator].children
    return list(children["innovations"].children) if "innovations" in children else []


def errors(dataset: xarray.DataTree, estimator: str, settling_s: float = SETTLING_S) -> Errors:
    """Errors of one estimator of a recorded run."""
    own = f"estimators/{estimator}"
    rows, at = _common(column(dataset, f"{own}/time"), column(dataset, "truth/time"))

    def estimated(name: str) -> Array:
        return np.asarray(column(dataset, f"{own}/{name}")[rows], np.float64)

    def true(name: str) -> Array:
        return np.asarray(column(dataset, f"truth/{name}")[at], np.float64)

    t = estimated("time")
    position = earth.position_difference_n(
        estimated("lat"), estimated("lon"), estimated("h"), true("lat"), true("lon"), true("h")
    )
    velocity = estimated("v_n") - true("v_n")
    # Truth is of the centre of gravity, the estimate of the IMU. (The Earth's own rate does 1e-4 m/s per metre.)
    arm_b = np.array(json.loads(dataset.attrs["estimated_point_b_m"])[estimator])
    position -= _rotate(true("q_nb"), np.broadcast_to(arm_b, position.shape))
    velocity -= _rotate(true("q_nb"), np.cross(true("omega_b"), arm_b))
    attitude = attitude_error(estimated("q_nb"), true("q_nb"))
    covariance = estimated("covariance")
    status = column(dataset, f"{own}/status")[rows]
    aligned = (status & Status.ALIGNED) != 0
    attitude_only = bool(np.any(aligned & ((status & Status.ATTITUDE_ONLY) != 0)))
    aligned_s = float(t[np.argmax(aligned)]) if aligned.any() else None
    judged = slice(6 if attitude_only else 0, 9)
    every = np.column_stack([position, velocity, attitude])[:, judged]
    finite = np.isfinite(every).all(axis=1) & np.isfinite(covariance[:, judged, judged]).all(axis=(1, 2))
    since = np.zeros(len(t), bool) if aligned_s is None else t >= aligned_s
    settled = since if aligned_s is None else t >= aligned_s + settling_s
    return Errors(
        t=t,
        position=position,
        velocity=velocity,
        attitude=attitude,
        sigma_position=estimated("sigma_position_n"),
        sigma_velocity=estimated("sigma_velocity_n"),
        sigma_attitude=estimated("sigma_attitude_n"),
        position_nees=nees(position, covariance[:, 0:3, 0:3]),
        velocity_nees=nees(velocity, covariance[:, 3:6, 3:6]),
        attitude_nees=nees(attitude, covariance[:, 6:9, 6:9]),
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


def _rotate(q: Array, v: Array) -> Array:
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


def nees(error: Array, covariance: Array) -> Array:
    """Normalised squared error e' P^-1 e / n (N,) of errors (N, n) of covariances (N, n, n), NaN where singular."""
    n = error.shape[1]
    sigma = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = error / sigma
        correlation = covariance / (sigma[:, :, None] * sigma[:, None, :])
    result = np.full(len(error), np.nan)
    good = np.isfinite(scaled).all(axis=1) & np.isfinite(correlation).all(axis=(1, 2))
    good[good] = np.linalg.det(correlation[good]) > 1e-12
    solved = np.linalg.solve(correlation[good], scaled[good][:, :, None])[:, :, 0]
    result[good] = np.sum(scaled[good] * solved, axis=1) / n
    return result


def outages(dataset: xarray.DataTree) -> list[Window]:
    """Windows [start, end) in which no GNSS receiver has a fix [s].

    A window starts with the first sample that has no fix and ends when the first fix arrives; one that lasts to the
    end of the run ends at infinity. Empty without GNSS receivers.
    """
    changes: list[tuple[float, str, bool]] = []
    receivers = _receivers(dataset)
    for name in receivers:
        fix = column(dataset, f"sensors/{name}/fix_type") > FixType.NO_FIX
        first = np.flatnonzero(np.diff(fix, prepend=~fix[:1]))
        when = np.where(fix, column(dataset, f"sensors/{name}/t_arrival"), column(dataset, f"sensors/{name}/time"))
        changes += [(float(when[k]), name, bool(fix[k])) for k in first]
    has_fix = dict.fromkeys(receivers, True)
    windows: list[Window] = []
    start: float | None = None
    for t, name, fixed in sorted(changes):
        has_fix[name] = fixed
        if start is None and not any(has_fix.values()):
            start = t
        elif start is not None and fixed:
            windows.append((start, t))
            start = None
    return windows if start is None else [*windows, (start, np.inf)]


def _receivers(dataset: xarray.DataTree) -> list[str]:
    if "sensors" not in dataset.children:
        return []
    return [name for name, node in dataset["sensors"].children.items() if "fix_type" in node.data_vars]


def inside(t: Array, windows: list[Window]) -> Mask:
    """Which times (N,) lie in one of the windows [start, end)."""
    result = np.zeros(len(t), bool)
    for start, end in windows:
        result |= (t >= start) & (t < end)
    return result


def compute(dataset: xarray.DataTree, settling_s: float = SETTLING_S) -> dict[str, float]:
    """All metrics of a recorded run; see the head of this module for what each counts."""
    result: dict[str, float] = {}
    windows = outages(dataset)
    for name in names(dataset):
        own = _estimator(dataset, name, windows, settling_s)
        result |= {f"{name}.{key}": float(value) for key, value in own.items()}
    return result


def _estimator(dataset: xarray.DataTree, name: str, windows: list[Window], settling_s: float) -> dict[str, float]:
    e = errors(dataset, name, settling_s)
    result: dict[str, float] = {}
    if e.nonfinite.any():
        result["nonfinite_samples"] = int(e.nonfinite.sum())
    if e.aligned_s is None:
        return result
    result["aligned_s"] = e.aligned_s
    denied = inside(e.t, windows)
    recovering = inside(e.t, [(end, end + RECOVERY_WINDOW_S) for _, end in windows])
    result |= _statistics(e, e.valid & ~denied & ~recovering, "")
    result |= _statistics(e, e.valid & denied, "outage_")
    if not e.attitude_only:
        result |= _outage_marks(e, windows) | _recovery(e, windows)
    for aid in aids(dataset, name):
        result |= _innovations(dataset, name, aid, e.aligned_s + settling_s)
    return result


def _statistics(e: Errors, mask: Mask, prefix: str) -> dict[str, float]:
    if not mask.any():
        return {}
    tilt, heading = np.rad2deg(e.tilt[mask]), np.rad2deg(e.attitude[mask, 2])
    result = {}
    if not e.attitude_only:
        horizontal = e.horizontal[mask]
        result = {
            "position_horizontal_rms_m": _rms(horizontal),
            "position_horizontal_max_m": float(horizontal.max()),
            "position_vertical_rms_m": _rms(e.position[mask, 2]),
            "velocity_rms_mps": _rms(np.linalg.norm(e.velocity[mask], axis=1)),
        }
    result |= {
        "roll_pitch_rms_deg": _rms(tilt),
        "roll_pitch_max_deg": float(tilt.max()),
        "heading_rms_deg": _rms(heading),
        "heading_max_deg": float(np.abs(heading).max()),
    }
    for what, values in (("position", e.position_nees), ("velocity", e.velocity_nees), ("attitude", e.attitude_nees)):
        finite = values[mask & np.isfinite(values)]
        if len(finite):
            result[f"{what}_nees_mean"] = float(finite.mean())
    return {prefix + key: value for key, value in result.items()}


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _outage_marks(e: Errors, windows: list[Window]) -> dict[str, float]:
    """Horizontal error so many seconds into an outage, the worst of all outages that last so long."""
    result: dict[str, float] = {}
    for mark in OUTAGE_MARKS_S:
        found = []
        for start, end in windows:
            k = int(np.searchsorted(e.t, start + mark - SAME_TIME_S))
            if start + mark < end and k < len(e.t) and e.valid[k]:
                found.append(e.horizontal[k])
        if found:
            result[f"outage_position_horizontal_at_{mark}s_m"] = float(max(found))
    return result


def _recovery(e: Errors, windows: list[Window]) -> dict[str, float]:
    """Seconds from reacquisition until the horizontal error is below `RECOVERED_M` for `RECOVERED_HOLD_S`.

    The worst of all outages. Outages after which it never is, before the next one or the end of the run, are counted
    instead, and there is no such time. Non-finite rows count as bad.
    """
    found, never = [], 0
    for k, (start, end) in enumerate(windows):
        until = windows[k + 1][0] if k + 1 < len(windows) else np.inf
        rows = np.flatnonzero((e.t >= end) & (e.t < until))
        if e.aligned_s is None or start < e.aligned_s or not len(rows):
            continue
        t = e.t[rows]
        good = e.horizontal[rows] < RECOVERED_M  # false for NaN
        # The first bad row at or after each row, and so how long it stays good from there.
        bad_at = np.where(good, np.inf, t)
        next_bad = np.minimum.accumulate(bad_at[::-1])[::-1]
        held = good & ((next_bad - t >= RECOVERED_HOLD_S) | np.isinf(next_bad))
        if held.any():
            found.append(float(t[np.argmax(held)] - end))
        else:
            never += 1
    if never:
        return {"unrecovered_outages": never}
    return {"recovery_s": max(found), "unrecovered_outages": 0} if found else {}


def _innovations(dataset: xarray.DataTree, estimator: str, aid: str, start: float) -> dict[str, float]:
    own = f"estimators/{estimator}/innovations/{aid}"
    after = column(dataset, f"{own}/sample_time") >= start
    value, weight = column(dataset, f"{own}/nis"), column(dataset, f"{own}/weight")
    fused = after & (weight > 0) & np.isfinite(value)
    result = {}
    if fused.any():
        m = column(dataset, f"{own}/innovation").shape[1]
        result[f"nis_mean.{aid}"] = float(value[fused].mean() / m)
    if after.any():
        result[f"rejected_fraction.{aid}"] = float(np.mean(weight[after] <= 0))
    return result


def save(metrics: Mapping[str, float], path: Path) -> None:
    """Write metrics as JSON. Raises UserError when the file can't be written."""
    text = json.dumps(dict(metrics), indent=1, sort_keys=True, allow_nan=False) + "\n"
    write_file(path, text.encode())
