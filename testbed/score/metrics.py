"""How well each estimator did: errors against truth, outage and recovery, consistency of claimed covariances.

Keys are ``<estimator>.<quantity>_<statistic>_<unit>``. What they count:

* Rows from `SETTLING_S` after the estimator first called itself aligned.
* Keys without prefix: while GNSS has a fix (or all the time, in a run without GNSS receiver), but not the first
  `RECOVERY_WINDOW_S` after an outage, which ``recovery_s`` judges by itself.
* Keys with ``outage_`` in front: while no receiver has a fix, up to the arrival of the next fix. An autopilot with a
  receiver of its own (``--ardupilot`` without ``--gps-input``) has no outage.
* An estimate is of the point where its IMU sits, and is compared with the true position and velocity of that point.
* Horizontal errors are the length of the 2-D error; ``roll_pitch`` is the angle between the true and the estimated
  vertical; ``heading`` is the rotation about the vertical; ``velocity`` is the length of the 3-D error.
* An estimator of attitude alone (`Status.ATTITUDE_ONLY`) is judged by its attitude alone.
* ``north``, ``east``, ``down``, ``roll`` and ``pitch`` are single axes; ``mean`` has its sign, ``std`` is about it,
  ``max`` the largest size.
* ``outage_bound`` is what no estimator of the same sensors can be better than, on average over draws: the least root
  mean square of the horizontal error at that time, `testbed.score.bound`. Of simulated runs only.
* NEES and NIS are per degree of freedom: 1 is perfectly consistent, above is overconfident. NIS is averaged over what
  the gate judged, whether it let it pass or not, and ``rejected_fraction`` is the share that it did not. What was
  withheld for another reason, such as probation after an outage, is in neither.
* Faults are scored one by one, under their names, for the estimators that take samples of the faulty sensor. A look is
  one sample of the sensor; it is an alarm when the estimator refused any part of it, be it one axis, probation apart.
  ``detection_delay_s``: from the beginning to the first alarm; ``missed``: 1 when there is none in the window;
  ``coverage``: share of the window's looks that are alarms; ``end_lag_s``: from the end until a whole sample is used
  again;
  ``isolation_correct``: 1 when four of five looks over 2 s, or from one on to the end of the window, are alarms, and no
  sensor without a fault of its own has as large a share of alarms in the window;
  ``error_over_3sigma``: largest horizontal error over three times its claimed sigma, from the beginning of the fault to
  `RECOVERY_WINDOW_S` after its end: above 1 the estimator was led astray and does not know it.
* ``false_alarms_per_look``: share of innovations that were refused though all was well, probation apart: once settled,
  while GNSS has a fix, and not from the beginning of a fault to `RECOVERY_WINDOW_S` after its alarm has ceased.
  ``false_alarms_per_h``: the same per hour of such time.
* ``flight.`` is how the aircraft flew, in truth, whatever it flew on, and not before its launch: ``bank``;
  ``stall_margin`` and ``overspeed_margin``, equivalent airspeed above the stall at its bank and below the fastest that
  is flown; ``altitude_error`` from the altitude commanded; ``path_error``, across the circle of loiters that have a
  ``centre``, from `ON_CIRCLE_S` after it is first within `ON_CIRCLE_M` of it. Here ``recovery_`` stands before the
  first `RETURN_S` after an outage.
* A recorded flight is judged against its reference: the log's solution, or its GNSS, that kept back in a denial too.
  What the reference doesn't know is not judged; its own covariance is added to the claimed one for NEES.
* A quantity that could not be formed (no outage, never aligned, never recovered) has no key. Nothing is ever NaN.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nav import earth
from nav.samples import Array, has_fix
from testbed.errors import UserError
from testbed.estimators.outside import OutsideSection
from testbed.feeds.bridged import THEIRS
from testbed.motion import aircraft, legs
from testbed.motion.sections import FlightTruth
from testbed.motion.table import ON_GROUND
from testbed.record.reader import scenario_of
from testbed.results import write_result
from testbed.schema import LONGEST_RUN_S
from testbed.score import bound
from testbed.score.accuracy import (
    AXES,
    RECOVERY_WINDOW_S,
    SAME_TIME_S,
    SETTLING_S,
    Errors,
    Mask,
    Window,
    aids,
    alignment,
    column,
    errors,
    euler,
    inside,
    names,
    worst_over_3sigma,
)
from testbed.score.detection import false_alarms, fault_scores, innovation_scores
from testbed.sensors.timing import patience

if TYPE_CHECKING:
    import xarray

RECOVERED_M = 5.0  # horizontal error that counts as recovered
RECOVERED_HOLD_S = 30.0  # and for how long it has to stay there
OUTAGE_MARKS_S = (60, 120, 300, 600)
ON_CIRCLE_M = 5.0  # as near as guidance keeps to it in light turbulence
ON_CIRCLE_S = 20.0  # until a capture of the circle has died away
RETURN_S = 60.0  # after an outage, in which an aircraft that flew on its estimate flies back


def outages(dataset: xarray.DataTree) -> list[Window]:
    """Windows [start, end) in which no GNSS receiver has a fix [s].

    A window starts with the first sample that has no fix, or when one is overdue, and ends when the first fix arrives;
    one that lasts to the end of the run ends at infinity. A receiver that has said nothing yet does not count. Empty
    without GNSS receivers.
    """
    changes: list[tuple[float, str, bool]] = []
    for name in receivers(dataset):
        t, arrival = (column(dataset, f"sensors/{name}/{key}") for key in ("time", "t_arrival"))
        fix = np.asarray(has_fix(column(dataset, f"sensors/{name}/fix_type")))
        when = np.where(fix, arrival, t)
        interval = float(np.median(np.diff(t))) if len(t) > 1 else LONGEST_RUN_S
        heard = column(dataset, "truth/time")[-1] - (arrival[-1:] - t[-1:])  # what came later is not recorded
        silent = np.flatnonzero(np.diff(t, append=heard) > patience(1 / interval))
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


def receivers(dataset: xarray.DataTree) -> list[str]:
    """The GNSS receivers of a record."""
    if "sensors" not in dataset.children:
        return []
    return [name for name, node in dataset["sensors"].children.items() if "fix_type" in node.data_vars]


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
    bounds = bound.of_run(dataset, until=max(end for _, end in windows)) if windows else {}
    undenied = _undenied(dataset)
    for name in names(dataset):
        own = _estimator(dataset, name, [] if name in undenied else windows, settling_s)
        if name in bounds and "aligned_s" in own:
            own |= bound.marks(bounds[name], windows, OUTAGE_MARKS_S)
        result |= {f"{name}.{key}": float(value) for key, value in own.items()}
    return result | {f"flight.{key}": float(value) for key, value in _flight(dataset, windows).items()}


def _undenied(dataset: xarray.DataTree) -> set[str]:
    """The estimators of a far end that has a receiver of its own: what the run denies, it does not deny them."""
    far_end = json.loads(dataset.attrs.get("far_end") or "{}")
    if far_end.get("sensors", {}).get("gnss") != THEIRS:
        return set()
    try:
        return {one.name for one in scenario_of(dataset).estimator if isinstance(one, OutsideSection)}
    except UserError:  # `unscored` says so
        return set()


def unscored(dataset: xarray.DataTree, settling_s: float = SETTLING_S) -> list[str]:
    """What is missing among the metrics, and why: a sentence each."""
    told = left_out(dataset)
    for name in names(dataset):
        t, aligned_s = alignment(dataset, name)
        if aligned_s is None:
            told.append(f"{name}: its errors are not scored: it was never aligned (its status never said ALIGNED)")
        elif t[-1] < aligned_s + settling_s:
            told.append(
                f"{name}: its errors are not scored: they count from {settling_s:g} s after its alignment, "
                f"{aligned_s + settling_s:.1f} s, and the run ends at {t[-1]:.1f} s"
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
    flown = column(dataset, "truth/leg") != ON_GROUND
    denied, returning, healthy = denied & flown, returning & flown, ~denied & ~returning & flown
    result: dict[str, float] = {}
    for prefix, mask in (("", healthy), ("outage_", denied), ("recovery_", returning)):
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
        result |= innovation_scores(dataset, name, aid, e.aligned_s + settling_s)
    scores, spans = fault_scores(dataset, name, e)
    return result | scores | false_alarms(dataset, name, e, [*windows, *spans])


def _statistics(e: Errors, mask: Mask, prefix: str) -> dict[str, float]:
    result: dict[str, float] = {}
    axes: list[tuple[str, Array, str]] = []
    positioned, moving, turned = (mask & np.isfinite(x).all(axis=1) for x in (e.position, e.velocity, e.attitude))
    if not e.attitude_only and positioned.any():
        horizontal = e.horizontal[positioned]
        result |= {
            "position_horizontal_rms_m": _rms(horizontal),
            "position_horizontal_max_m": float(horizontal.max()),
            "position_vertical_rms_m": _rms(e.position[positioned, 2]),
        } | worst_over_3sigma(e, positioned, "position_horizontal_over_3sigma_max")
        axes += [(f"position_{axis}", e.position[positioned, k], "m") for k, axis in enumerate(AXES)]
    if not e.attitude_only and moving.any():
        speed = np.linalg.norm(e.velocity[moving], axis=1)
        result |= {"velocity_rms_mps": _rms(speed), "velocity_max_mps": float(speed.max())}
        axes += [(f"velocity_{axis}", e.velocity[moving, k], "mps") for k, axis in enumerate(AXES)]
    if turned.any():
        tilt = np.rad2deg(e.tilt[turned])
        result |= {"roll_pitch_rms_deg": _rms(tilt), "roll_pitch_max_deg": float(tilt.max())}
        axes += [(axis, np.rad2deg(e.angles[turned, k]), "deg") for k, axis in enumerate(("roll", "pitch"))]
        axes += [("heading", np.rad2deg(e.attitude[turned, 2]), "deg")]
    for axis, values, unit in axes:
        result[f"{axis}_rms_{unit}"] = _rms(values)
        result[f"{axis}_max_{unit}"] = float(np.abs(values).max())
        result[f"{axis}_mean_{unit}"] = float(values.mean())
        result[f"{axis}_std_{unit}"] = float(values.std())
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
            if start + mark < end and k < len(e.t) and e.valid[k] and np.isfinite(e.horizontal[k]):
                found.append(e.horizontal[k])
        if found:
            result[f"outage_position_horizontal_at_{mark}s_m"] = float(max(found))
    return result


def _recovery(e: Errors, windows: list[Window]) -> dict[str, float]:
    """Seconds from reacquisition until the horizontal error is below `RECOVERED_M` for `RECOVERED_HOLD_S`.

    The worst of all outages. Outages after which it never is, before the next one or the end of the run, are counted
    instead, and there is no such time; one that leaves less time than that is not judged. Non-finite rows count as bad,
    but for those that nobody knows the truth of.
    """
    found, never = [], 0
    for k, (start, end) in enumerate(windows):
        until = windows[k + 1][0] if k + 1 < len(windows) else np.inf
        rows = np.flatnonzero((e.t >= end) & (e.t < until) & (np.isfinite(e.horizontal) | e.nonfinite))
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


def save(metrics: Mapping[str, float], path: Path) -> None:
    """Write metrics as JSON. Raises UserError when the file can't be written."""
    text = json.dumps(dict(metrics), indent=1, sort_keys=True, allow_nan=False) + "\n"
    write_result(path, text.encode())
