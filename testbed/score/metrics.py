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
* ``north``, ``east``, ``down``, ``roll`` and ``pitch`` are single axes; ``std`` is about the mean error, ``max`` the
  largest size.
* NEES and NIS are per degree of freedom: 1 is perfectly consistent, above is overconfident. NIS is averaged over what
  the gate judged, whether it let it pass or not, and ``rejected_fraction`` is the share that it did not. What was
  withheld for another reason, such as probation after an outage, is in neither.
* Faults are scored one by one, under their names, for the estimators that take samples of the faulty sensor. A look is
  one sample of the sensor; it is an alarm when the estimator refused any part of it, be it one axis, probation apart.
  ``detection_delay_s``: from the beginning to the first alarm; ``missed``: 1 when there is none in the window;
  ``coverage``: share of the window's looks that are alarms; ``end_lag_s``: from the end until a whole sample is used
  again;
  ``isolation_correct``: 1 when no sensor without a fault of its own has as large a share of alarms in the window;
  ``error_over_3sigma``: largest horizontal error over three times its claimed sigma, from the beginning of the fault to
  `RECOVERY_WINDOW_S` after its end: above 1 the estimator was led astray and does not know it.
* ``false_alarms_per_look``: share of innovations that were refused though all was well, probation apart: once settled,
  while GNSS has a fix, and not from the beginning of a fault to `RECOVERY_WINDOW_S` after its alarm has ceased.
  ``false_alarms_per_h``: the same per hour of such time.
* ``flight.`` is how the aircraft flew, in truth, whatever it flew on: ``bank``; ``stall_margin`` and
  ``overspeed_margin``, equivalent airspeed above the stall at its bank and below the fastest that is flown;
  ``altitude_error`` from the altitude commanded; ``path_error``, across the circle of loiters that have a ``centre``,
  from `ON_CIRCLE_S` after it is first within `ON_CIRCLE_M` of it. Here ``recovery_`` stands before the first
  `RETURN_S` after an outage.
* A quantity that could not be formed (no outage, never aligned, never recovered) has no key. Nothing is ever NaN.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from nav import earth
from nav.samples import Array, Outcome, Status, has_fix
from testbed.errors import UserError
from testbed.motion import aircraft, legs
from testbed.motion.sections import FlightTruth
from testbed.record.reader import scenario_of
from testbed.results import write_result
from testbed.schema import LONGEST_RUN_S
from testbed.sensors.faults import FaultTruth
from testbed.sensors.timing import patience

if TYPE_CHECKING:
    import xarray

SETTLING_S = 60.0  # after alignment, before errors count: biases and heading settle
RECOVERY_WINDOW_S = 10.0
RECOVERED_M = 5.0  # horizontal error that counts as recovered
RECOVERED_HOLD_S = 30.0  # and for how long it has to stay there
OUTAGE_MARKS_S = (60, 120, 300, 600)
SAME_TIME_S = 1e-6
SUSTAINED_S = 2.0  # for how long an alarm has to go on to be a sustained one,
SUSTAINED_SHARE = 0.8  # and at how many of the looks
ON_CIRCLE_M = 5.0  # as near as guidance keeps to it in light turbulence
ON_CIRCLE_S = 20.0  # until a capture of the circle has died away
RETURN_S = 60.0  # after an outage, in which an aircraft that flew on its estimate flies back
AXES = ("north", "east", "down")

Mask: TypeAlias = npt.NDArray[np.bool_]
Window: TypeAlias = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of one estimator where truth has a row at the same time: estimate - truth, by the conventions of `nav`.

    ``t`` (N,) [s]; ``position`` (N, 3) NED [m]; ``velocity`` (N, 3) NED [m/s]; ``attitude`` (N, 3) phi in n [rad];
    ``angles`` (N, 3) differences of roll, pitch and heading [rad]; ``sigma_*`` (N, 3) what the estimator claimed;
    ``*_nees`` (N,) normalised squared error over 3, NaN where the covariance is singular; ``aligned_s`` time of
    alignment, None when never; ``attitude_only`` whether position and velocity are NaN by design; ``nonfinite`` (N,)
    rows that should be numbers and are not; ``valid`` (N,) rows that count.
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
    finite = np.isfinite(every).all(axis=1)
    claimed = np.isfinite(covariance[:, judged, judged]).all(axis=(1, 2))
    if claimed.any():  # one that never claims a covariance is judged by its errors alone
        finite &= claimed
    since = np.zeros(len(t), bool) if aligned_s is None else t >= aligned_s
    settled = since if aligned_s is None else t >= aligned_s + settling_s
    return Errors(
        t=t,
        position=position,
        velocity=velocity,
        attitude=attitude,
        angles=_wrapped(euler(estimated("q_nb")) - euler(true("q_nb"))),
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


def euler(q: Array) -> Array:
    """Roll, pitch, heading (N, 3) [rad] of q_nb (N, 4)."""
    w, x, y, z = q.T
    roll = np.arctan2(2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - x * z), -1.0, 1.0))
    heading = np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
    return np.column_stack([roll, pitch, heading])


def _wrapped(angle: Array) -> Array:
    """The same angles in [-pi, pi)."""
    wrapped: Array = np.mod(angle + np.pi, 2 * np.pi) - np.pi
    return wrapped


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

    A window starts with the first sample that has no fix, or when one is overdue, and ends when the first fix arrives;
    one that lasts to the end of the run ends at infinity. A receiver that has said nothing yet does not count. Empty
    without GNSS receivers.
    """
    changes: list[tuple[float, str, bool]] = []
    receivers = _receivers(dataset)
    for name in receivers:
        t = column(dataset, f"sensors/{name}/time")
        fix = np.asarray(has_fix(column(dataset, f"sensors/{name}/fix_type")))
        when = np.where(fix, column(dataset, f"sensors/{name}/t_arrival"), t)
        interval = float(np.median(np.diff(t))) if len(t) > 1 else LONGEST_RUN_S
        silent = np.flatnonzero(np.diff(t, append=column(dataset, "truth/time")[-1]) > patience(1 / interval))
        fix, when = np.insert(fix, silent + 1, False), np.insert(when, silent + 1, t[silent] + interval)
        first = np.flatnonzero(np.diff(fix, prepend=~fix[:1]))
        changes += [(float(when[k]), name, bool(fix[k])) for k in first]
    fixes: dict[str, bool] = {}
    windows: list[Window] = []
    start: float | None = None
    for t_change, name, fixed in sorted(changes):
        fixes[name] = fixed
        if start is None and not any(fixes.values()):
            start = t_change
        elif start is not None and fixed:
            windows.append((start, t_change))
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
    """All metrics of a recorded run; see the head of this module for what each counts.

    Raises UserError when no row of truth was recorded.
    """
    if "truth" not in dataset or not dataset["truth"].sizes["time"]:
        raise UserError(
            "the record holds no row of truth, so there is nothing to score: the run ended before its first"
        )
    result: dict[str, float] = {}
    windows = outages(dataset)
    for name in names(dataset):
        own = _estimator(dataset, name, windows, settling_s)
        result |= {f"{name}.{key}": float(value) for key, value in own.items()}
    return result | {f"flight.{key}": float(value) for key, value in _flight(dataset, windows).items()}


def unscored(dataset: xarray.DataTree, settling_s: float = SETTLING_S) -> list[str]:
    """What is missing among the metrics, and why: a sentence each."""
    told = left_out(dataset)
    for name in names(dataset):
        e = errors(dataset, name, settling_s)
        if e.aligned_s is None:
            told.append(f"{name}: its errors are not scored: it was never aligned (its status never said ALIGNED)")
        elif e.t[-1] < e.aligned_s + settling_s:
            told.append(
                f"{name}: its errors are not scored: they count from {settling_s:g} s after its alignment, "
                f"{e.aligned_s + settling_s:.1f} s, and the run ends at {e.t[-1]:.1f} s"
            )
    return told


def left_out(dataset: xarray.DataTree) -> list[str]:
    """What needs the scenario of a record, when that is no longer read: a sentence, or none."""
    try:
        scenario_of(dataset)
    except UserError as error:
        return [f"flight.* and visibility are left out: {error}"]
    return []


def _flight(dataset: xarray.DataTree, windows: list[Window]) -> dict[str, float]:
    """How the aircraft flew; nothing when none did, or of a record whose scenario is no longer read."""
    try:
        scenario = scenario_of(dataset)
    except UserError:  # `unscored` says so
        return {}
    if not isinstance(scenario.truth, FlightTruth):
        return {}
    t, bank = column(dataset, "truth/time"), np.abs(euler(column(dataset, "truth/q_nb"))[:, 0])
    eas = column(dataset, "truth/airspeed") * np.sqrt(column(dataset, "truth/density") / earth.SEA_LEVEL_DENSITY)
    limits = aircraft.load(scenario.truth.aircraft).airspeed
    stall = limits.stall_mps / np.sqrt(np.maximum(np.cos(bank), 0.01))
    climb_error = np.abs(column(dataset, "truth/h") - column(dataset, "truth/commands")[:, 1])
    path_error = _path_error(dataset, scenario.plan)
    denied = inside(t, windows)
    returning = inside(t, [(end, end + RETURN_S) for _, end in windows]) & ~denied
    result: dict[str, float] = {}
    for prefix, mask in (("", ~denied & ~returning), ("outage_", denied), ("recovery_", returning)):
        if not mask.any():
            continue
        result |= {
            f"{prefix}bank_max_deg": float(np.rad2deg(bank[mask].max())),
            f"{prefix}stall_margin_min_mps": float((eas - stall)[mask].min()),
            f"{prefix}overspeed_margin_min_mps": float((limits.max_mps - eas)[mask].min()),
            f"{prefix}altitude_error_max_m": float(climb_error[mask].max()),
        }
        on_path = path_error[mask & np.isfinite(path_error)]
        if len(on_path):
            result |= {f"{prefix}path_error_rms_m": _rms(on_path), f"{prefix}path_error_max_m": float(on_path.max())}
    return result


def _path_error(dataset: xarray.DataTree, plan: Sequence[legs.Leg]) -> Array:
    """Distance (N,) [m] from the circle that is being flown, NaN where there is none."""
    t, leg = column(dataset, "truth/time"), column(dataset, "truth/leg")
    result = np.full(len(leg), np.nan)
    for index, one in enumerate(plan):
        rows = np.flatnonzero(leg == index)
        if not isinstance(one, legs.Loiter) or one.centre is None or not len(rows):
            continue
        lat, lon, h = (column(dataset, f"truth/{name}")[rows] for name in ("lat", "lon", "h"))
        centre = np.deg2rad([one.centre.lat_deg, one.centre.lon_deg])
        away = earth.position_difference_n(lat, lon, h, np.full(len(rows), centre[0]), np.full(len(rows), centre[1]), h)
        error = np.abs(np.hypot(away[:, 0], away[:, 1]) - one.radius_m)
        near = np.flatnonzero(error <= ON_CIRCLE_M)
        if len(near):
            counted = t[rows] >= t[rows[near[0]]] + ON_CIRCLE_S
            result[rows[counted]] = error[counted]
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
    scores, spans = _detection(dataset, name, e)
    return result | scores | _false_alarms(dataset, name, e, [*windows, *spans])


def _statistics(e: Errors, mask: Mask, prefix: str) -> dict[str, float]:
    if not mask.any():
        return {}
    tilt, heading = np.rad2deg(e.tilt[mask]), np.rad2deg(e.attitude[mask, 2])
    result = {}
    if not e.attitude_only:
        horizontal, speed = e.horizontal[mask], np.linalg.norm(e.velocity[mask], axis=1)
        result = {
            "position_horizontal_rms_m": _rms(horizontal),
            "position_horizontal_max_m": float(horizontal.max()),
            "position_vertical_rms_m": _rms(e.position[mask, 2]),
            "velocity_rms_mps": _rms(speed),
            "velocity_max_mps": float(speed.max()),
        } | _over_3sigma(e, mask, "position_horizontal_over_3sigma_max")
    result |= {
        "roll_pitch_rms_deg": _rms(tilt),
        "roll_pitch_max_deg": float(tilt.max()),
    }
    axes = []
    if not e.attitude_only:
        axes += [(f"position_{axis}", e.position[mask, k], "m") for k, axis in enumerate(AXES)]
        axes += [(f"velocity_{axis}", e.velocity[mask, k], "mps") for k, axis in enumerate(AXES)]
    axes += [(axis, np.rad2deg(e.angles[mask, k]), "deg") for k, axis in enumerate(("roll", "pitch"))]
    for axis, values, unit in [*axes, ("heading", heading, "deg")]:
        result[f"{axis}_rms_{unit}"] = _rms(values)
        result[f"{axis}_max_{unit}"] = float(np.abs(values).max())
        result[f"{axis}_std_{unit}"] = float(values.std())
    for what, values in (("position", e.position_nees), ("velocity", e.velocity_nees), ("attitude", e.attitude_nees)):
        finite = values[mask & np.isfinite(values)]
        if len(finite):
            result[f"{what}_nees_mean"] = float(finite.mean())
    return {prefix + key: value for key, value in result.items()}


def _over_3sigma(e: Errors, mask: Mask, key: str) -> dict[str, float]:
    """The largest horizontal error over the claimed 3 sigma of these rows; nothing where none is claimed."""
    values = e.over_3sigma[mask]
    values = values[np.isfinite(values)]
    return {key: float(values.max())} if len(values) else {}


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
    instead, and there is no such time; one that leaves less time than that is not judged. Non-finite rows count as bad.
    """
    found, never = [], 0
    for k, (start, end) in enumerate(windows):
        until = windows[k + 1][0] if k + 1 < len(windows) else np.inf
        rows = np.flatnonzero((e.t >= end) & (e.t < until))
        t = e.t[rows]
        if e.aligned_s is None or start < e.aligned_s or not len(t) or t[-1] - end < RECOVERED_HOLD_S - SAME_TIME_S:
            continue
        good = e.horizontal[rows] < RECOVERED_M  # false for NaN
        # The first bad row at or after each row, and so how long it stays good from there.
        bad_at = np.where(good, np.inf, t)
        next_bad = np.minimum.accumulate(bad_at[::-1])[::-1]
        held = good & (np.minimum(next_bad, t[-1]) - t >= RECOVERED_HOLD_S - SAME_TIME_S)
        if held.any():
            found.append(float(t[np.argmax(held)] - end))
        else:
            never += 1
    if never:
        return {"unrecovered_outages": never}
    return {"recovery_s": max(found), "unrecovered_outages": 0} if found else {}


@dataclass(frozen=True, slots=True)
class _Reports:
    """What became of the samples of one aid, or of one sensor, each (N,).

    ``used``, in part at least; ``gated`` refused by the gate; ``alarm`` refused, in part at least, because the sample
    looked wrong; ``judged`` used or refused for its innovation.
    """

    t: Array
    sensor: npt.NDArray[np.str_]
    nis: Array
    used: Mask
    gated: Mask
    alarm: Mask
    judged: Mask


def refused(weight: Array, outcome: npt.NDArray[Any]) -> Mask:
    """Which samples (N,) were not used, or not with every axis."""
    return (weight <= 0) | np.isin(outcome, (Outcome.OUTSIDE_GATE, Outcome.ISOLATED))


def _reports(dataset: xarray.DataTree, estimator: str, aid: str) -> _Reports:
    own = f"estimators/{estimator}/innovations/{aid}"
    outcome, value = column(dataset, f"{own}/outcome"), column(dataset, f"{own}/nis")
    weight = column(dataset, f"{own}/weight")
    used = weight > 0
    alarm = refused(weight, outcome) & (outcome != Outcome.WITHHELD)
    return _Reports(
        t=column(dataset, f"{own}/sample_time"),
        sensor=column(dataset, f"{own}/sensor").astype(str),
        nis=value,
        used=used,
        gated=outcome == Outcome.OUTSIDE_GATE,
        alarm=alarm,
        judged=(used | alarm) & np.isfinite(value),  # an unsound sample has no innovation
    )


@dataclass(frozen=True, slots=True)
class Judged:
    """Samples that the gate judged: times (N,) [s], NIS (N,), whether it refused them (N,), components of each.

    ``components`` is 0 for the parity of redundant units, which has no innovation.
    """

    t: Array
    nis: Array
    gated: Mask
    components: int


def judged(dataset: xarray.DataTree, estimator: str, aid: str) -> Judged:
    """What the gate of one aid judged, whether it let it pass or not."""
    reports = _reports(dataset, estimator, aid)
    rows = (reports.used & ~reports.alarm | reports.gated) & np.isfinite(reports.nis)
    own = dataset[f"estimators/{estimator}/innovations/{aid}"]
    components = own["innovation"].shape[1] if "innovation" in own else 0
    return Judged(reports.t[rows], reports.nis[rows], reports.gated[rows], components)


def _innovations(dataset: xarray.DataTree, estimator: str, aid: str, start: float) -> dict[str, float]:
    looks = judged(dataset, estimator, aid)
    rows = looks.t >= start
    if not rows.any() or not looks.components:
        return {}
    return {
        f"nis_mean.{aid}": float(looks.nis[rows].mean() / looks.components),
        f"rejected_fraction.{aid}": float(np.mean(looks.gated[rows])),
    }


# --- detection of faults


@dataclass(frozen=True, slots=True)
class DetectionScore:
    """How one fault was detected; times in seconds, NaN where it was not.

    ``delay`` from its beginning to the first alarm; ``sustained_delay`` to the first alarm from which on, for
    `SUSTAINED_S` or to the end, `SUSTAINED_SHARE` of the looks are alarms; ``coverage`` share of the looks in the
    window that are alarms; ``end_lag`` from its end to the first look without alarm.
    """

    delay: float
    sustained_delay: float
    coverage: float
    end_lag: float

    @property
    def missed(self) -> bool:
        """Whether there was no alarm in the window."""
        return self.coverage == 0.0


def detection(t: Array, alarm: Mask, window: Window, until: float = np.inf) -> DetectionScore | None:
    """Score of alarms (N,) at looks (N,) [s], ascending, on a fault in ``window`` [start, end).

    ``until`` is when the next fault of the same sensor begins: an alarm from then on belongs to that. None when nobody
    looked during the fault.
    """
    start, end = window[0] - SAME_TIME_S, window[1] - SAME_TIME_S
    during = (t >= start) & (t < end)
    if not during.any():
        return None
    looked, alarmed = t[during], alarm[during]
    after = (t >= end) & (t < until) & ~alarm
    total = np.append(0, np.cumsum(alarmed))
    stop = np.searchsorted(looked, looked + SUSTAINED_S - SAME_TIME_S)
    here = np.arange(len(looked))
    sustained = alarmed & (total[stop] - total[here] >= SUSTAINED_SHARE * (stop - here))

    def first(when: Array, since: float) -> float:
        return max(float(when[0]) - since, 0.0) if len(when) else np.nan

    return DetectionScore(
        delay=first(looked[alarmed], window[0]),
        sustained_delay=first(looked[sustained], window[0]),
        coverage=float(alarmed.mean()),
        end_lag=first(t[after], window[1]),
    )


def faults(dataset: xarray.DataTree) -> list[FaultTruth]:
    """What was made to go wrong in a run."""
    if "faults" not in dataset.children:
        return []
    own = [column(dataset, f"faults/{'time' if f.name == 'start' else f.name}").tolist() for f in fields(FaultTruth)]
    return [FaultTruth(*row) for row in zip(*own, strict=True)]


def fault_window(fault: FaultTruth) -> Window:
    """From the beginning of a fault to `RECOVERY_WINDOW_S` after its end [s]."""
    return fault.start, fault.end + RECOVERY_WINDOW_S


def _by_sensor(dataset: xarray.DataTree, estimator: str) -> dict[str, tuple[Array, Mask, Mask]]:
    """Times of the samples of each sensor, whether any part of one raised an alarm, whether it was not used whole."""
    found = [_reports(dataset, estimator, aid) for aid in aids(dataset, estimator)]
    result = {}
    for sensor in dict.fromkeys(name for reports in found for name in np.unique(reports.sensor).tolist()):
        own = [(reports, reports.sensor == sensor) for reports in found]
        t, row = np.unique(np.concatenate([reports.t[mine] for reports, mine in own]), return_inverse=True)
        alarm, used = np.zeros(len(t), bool), np.zeros(len(t), bool)
        np.logical_or.at(alarm, row, np.concatenate([reports.alarm[mine] for reports, mine in own]))
        np.logical_or.at(used, row, np.concatenate([reports.used[mine] for reports, mine in own]))
        result[sensor] = (t, alarm, ~used | alarm)
    return result


def _detection(dataset: xarray.DataTree, estimator: str, e: Errors) -> tuple[dict[str, float], list[Window]]:
    """Scores of all faults, and the spans of time in which an alarm may be theirs."""
    every = faults(dataset)
    looks = _by_sensor(dataset, estimator) if every else {}
    result: dict[str, float] = {}
    spans: list[Window] = []
    for fault in every:
        window, score = (fault.start, fault.end), None
        # From when on an alarm is another fault's of the same sensor.
        until = min(
            (max(o.start, fault.end) for o in every if o.sensor == fault.sensor and o.end > fault.end), default=np.inf
        )
        if fault.sensor in looks:
            t, alarm, unused = looks[fault.sensor]
            # What was refused as faulty may be on probation before it is used again.
            score = detection(t, alarm | unused & (t >= fault.end - SAME_TIME_S), window, until)
        if score is None:
            spans.append(fault_window(fault))
            continue
        ceased = until if np.isnan(score.end_lag) else fault.end + score.end_lag
        spans.append((fault.start, ceased + RECOVERY_WINDOW_S))
        at_fault = {other.sensor for other in every if other.start < fault.end and other.end > fault.start}
        others = [detection(t, alarm, window) for name, (t, alarm, _) in looks.items() if name not in at_fault]
        most = max((other.coverage for other in others if other is not None), default=0.0)
        scored = {
            "detection_delay_s": score.delay,
            "end_lag_s": score.end_lag,
            "coverage": score.coverage,
            "missed": score.missed,
            "isolation_correct": score.coverage > most,
        }
        result |= {f"{key}.{fault.name}": value for key, value in scored.items() if np.isfinite(value)}
        if not e.attitude_only:
            result |= _over_3sigma(e, e.valid & inside(e.t, [fault_window(fault)]), f"error_over_3sigma.{fault.name}")
    return result, spans


def _false_alarms(dataset: xarray.DataTree, estimator: str, e: Errors, troubled: list[Window]) -> dict[str, float]:
    """Innovations refused though all was well, of those judged and per hour of healthy time with GNSS fix."""
    counted = e.t[e.valid & ~inside(e.t, troubled)]
    if not len(counted):
        return {}
    alarms = looks = 0
    for aid in aids(dataset, estimator):
        reports = _reports(dataset, estimator, aid)
        healthy = reports.judged & (reports.t >= counted[0]) & ~inside(reports.t, troubled)
        alarms += int(np.sum(healthy & reports.alarm))
        looks += int(healthy.sum())
    hours = len(counted) / (3600.0 * float(dataset.attrs["record_rate_hz"]))
    return {"false_alarms_per_h": alarms / hours} | ({"false_alarms_per_look": alarms / looks} if looks else {})


def save(metrics: Mapping[str, float], path: Path) -> None:
    """Write metrics as JSON. Raises UserError when the file can't be written."""
    text = json.dumps(dict(metrics), indent=1, sort_keys=True, allow_nan=False) + "\n"
    write_result(path, text.encode())
