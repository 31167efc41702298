"""From what was measured in a log to a scenario that runs it: a grade for each sensor, and what differs from it."""

from __future__ import annotations

import datetime as dt
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nav.rotation import euler_from_quat
from nav.samples import AirspeedSample, BarometerSample, GnssSample, MagnetometerSample
from testbed.errors import UserError
from testbed.feeds.log import TABLE, Log
from testbed.feeds.recorded import first_place, rate, references
from testbed.feeds.reference import doubt, elsewhere_in_height, silence
from testbed.feeds.scatter import otherwise
from testbed.feeds.survey import Noise, Sphere, Survey
from testbed.feeds.unsound import unfit_as_aids
from testbed.motion.logged import LogTruth
from testbed.motion.terrain import JACKSBORO
from testbed.sensors import SensorConfig
from testbed.sensors.airspeed import GRADES as AIRSPEEDS
from testbed.sensors.gnss import GRADES as RECEIVERS
from testbed.sensors.imu_grades import GRADES as IMUS
from testbed.sensors.magnetometer import GRADES as MAGNETOMETERS
from testbed.sensors.magnetometer import WMM_YEARS
from testbed.sensors.units import DEG_PER_H, DEG_PER_ROOT_H, MG, MICROTESLA, MPS_PER_ROOT_H

WORST = "mems-hobby"
NOISE_MARGIN, BIAS_SIGMAS = 2.0, 3.0  # a part is of a grade with so much of its noise, and biases within so many sigmas
DIGITS = 3
MOST_RTK_CLAIM = 0.05  # level [m]
UNSURE = {"latency_sigma_s": RECEIVERS["u-blox-m8"]["latency_sigma_s"]}
USUAL_AIDS = {
    "ins": ("gnss", "barometer", "airspeed", "magnetometer"),
    "ahrs": ("magnetometer", "barometer", "airspeed"),
}
ROWS_HZ, RECORD_HZ = 100.0, 10.0
SHORTEST_S = 0.1  # of a run; one that begins after the log's end is refused when it is run
# A place for a log that has none, so that its scenario runs: an AHRS needs gravity and declination.
ASSUMED = {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 400.0}


def sections(found: Survey) -> dict[str, dict[str, Any]]:
    """The keys of each sensor: kind, grade, rate, and what was measured to be otherwise.

    Beside an inertial unit of the worst grade the other sensors are taken to be installed no better.
    """
    log = found.log
    made: dict[str, dict[str, Any]] = {
        name: {"kind": "imu", **imu_keys(found.noise.get(name)), "rate_hz": rate(log, name)} for name in log.imus
    }
    hobby = any(keys["grade"] == WORST for keys in made.values())
    grade, receiver = ("hobby", "u-blox-m8") if hobby else ("mems", "standalone")
    for name, own in log.samples.items():
        keys: dict[str, Any] = {"rate_hz": rate(log, name)}
        match own[0]:
            case GnssSample():
                keys = {"kind": "gnss", **_receiver_keys(own, receiver), **keys}
                if name in found.latency and not log.valid_times:
                    keys |= _lateness(found.latency[name].s, found.velocity_lag_s.get(name, 0.0))
                elif log.format == TABLE and not log.valid_times:
                    keys |= {"latency_s": 0.0, **UNSURE}  # mostly times of fixes, in a table that tools have written
            case MagnetometerSample():
                keys = {"kind": "magnetometer", "grade": grade, **keys}
                iron = _iron(found.spheres.get(name)) / MICROTESLA
                if iron > MAGNETOMETERS[grade]["hard_iron_ut"]:
                    keys["hard_iron_ut"] = _rounded(iron)
            case BarometerSample():
                keys = {"kind": "barometer", "grade": grade, **keys}
            case AirspeedSample():
                keys = {"kind": "airspeed", "grade": grade, **keys}
                off = 200 * abs(found.airspeed_scale.get(name, 1.0) - 1)  # of pressure: twice that of speed
                if off > AIRSPEEDS[grade]["scale_percent"]:
                    keys["scale_percent"] = min(_rounded(off), 50.0)
            case _:
                continue
        made[name] = keys
    return made


def _receiver_keys(own: Sequence[Any], grade: str) -> dict[str, Any]:
    """The grade of a receiver, and how well its latency is known: `rtk` of one that claims what only that can have."""
    claims = np.array([np.max(one.sigma_position_n[:2]) for one in own if one.has_fix])
    claims = claims[np.isfinite(claims)]
    if not len(claims) or not np.median(claims) <= MOST_RTK_CLAIM:
        return {"grade": grade, **otherwise(own, RECEIVERS[grade])}
    return {"grade": "rtk", **otherwise(own, RECEIVERS["rtk"]), **UNSURE}


def _lateness(latency: float, lag: float) -> dict[str, float]:
    """Of a receiver whose velocities are told of so late, and that are so much older than its positions [s]."""
    lag = round(min(lag, latency), 2)  # no position is told of before it is there
    return {"latency_s": round(latency - lag, 2)} | ({"velocity_lag_s": lag} if lag else {})


def _iron(sphere: Sphere | None) -> float:
    """What a magnetometer's field is off by per axis [T], by the sphere that fits it; 0 where none is known."""
    if sphere is None:
        return 0.0
    sure = sphere.off > BIAS_SIGMAS * sphere.off_sigma
    return max(sphere.residual, sphere.off / math.sqrt(3) if sure else 0.0)


def imu_keys(noise: Noise | None) -> dict[str, Any]:
    """The best grade that covers what an inertial unit shows at rest; of one that no grade covers, the worst with that.

    Without a rest nothing is known, and the worst grade is the safest.
    """
    grades = [name for name in IMUS if name != "perfect"]
    if noise is None:
        return {"grade": WORST}
    shown = {
        "angle_random_walk_degprth": noise.gyro_walk / DEG_PER_ROOT_H,
        "velocity_random_walk_mpsprth": noise.accel_walk / MPS_PER_ROOT_H,
        "gyro_turn_on_degph": float(abs(noise.gyro_bias).max()) / DEG_PER_H,
        "accel_turn_on_mg": abs(noise.force_error) / MG,
    }
    for name in grades:
        told = IMUS[name]
        if all(value <= _margin(key) * told[key] for key, value in shown.items()):
            return {"grade": name}
    told = IMUS[WORST]
    beside = {
        "angle_random_walk_degprth": "gyro_vibration_degprth",
        "velocity_random_walk_mpsprth": "accel_vibration_mpsprth",
    }
    covered = {key: math.hypot(told[key], told[beside[key]] if key in beside else 0.0) for key in shown}
    return {"grade": WORST} | {key: _rounded(value) for key, value in shown.items() if value > covered[key]}


def _margin(key: str) -> float:
    return BIAS_SIGMAS if key.endswith(("turn_on_degph", "turn_on_mg")) else NOISE_MARGIN


def scenario(
    found: Survey,
    out: Path,
    truth: LogTruth | None,
    date: dt.date | None = None,
    told: Mapping[str, SensorConfig] | None = None,
) -> str:
    """The text of a scenario file at ``out``; of a table, ``truth`` has its columns.

    What ``truth`` says, and a ``date`` that is given, are kept before what the log says; so is where its sensors are
    ``told`` to be, and how mounted, which no log can tell.
    """
    log = found.log
    end = min(float(own.t[-1]) for own in log.imus.values()) - log.t0
    lasts = max(end - (0.0 if truth is None else truth.start_s), SHORTEST_S)
    date = log.date if date is None else date
    own = sections(found)
    unsound = unfit_as_aids(found)
    aids = [name for name in own if len(log.samples.get(name, ())) > 1 and name not in unsound]
    first = {str(own[name]["kind"]): name for name in reversed(aids)}  # one of each kind
    if log.receiver is not None:
        first["gnss"] = log.receiver  # the first with a fix
    lines = [
        f"title = {json.dumps(log.path.name)}",
        f"duration_s = {math.floor(10 * lasts) / 10:.1f}",
    ]
    if date is not None and WMM_YEARS[0] <= date.year < WMM_YEARS[1]:
        lines.append(f"date = {date.isoformat()}")
    else:
        lines.append("# date = 2024-06-01  # the log doesn't say: give it, for the magnetic field")
    place = _seen_from(out, log.path)
    kept = {} if truth is None else _kept(truth, out)
    lines += ["", "[truth]", 'source = "log"', f"file = {json.dumps(place)}"]
    lines += [f"{key} = {_inline(value)}" for key, value in ({"rate_hz": ROWS_HZ} | kept).items()]
    if truth is not None and "reference" in truth.model_fields_set:
        lines.append(f"reference = {_inline(truth.reference)}")
    elif _is_elsewhere(log, named=truth is not None and bool(references(truth))):
        lines.append('reference = "gnss"  # its own solution is elsewhere')
    if truth is not None and truth.start is not None:
        lines.append(f"start = {_inline(truth.start.model_dump())}")
    elif not is_placed(log):
        lines.append(f"start = {_inline(ASSUMED)}  # assumed: the log doesn't say where: give it")
    if truth is not None and truth.columns:
        lines += [f"columns.{name} = {_inline(stream)}" for name, stream in _columns(truth, out).items()]
    for name, keys in own.items():
        keys |= _installed(told[name]) if told and name in told else {}
        why = [f"# Among no estimator's aids: {unsound[name]}"] if name in unsound else []
        lines += ["", f"[sensors.{name}]", *why, *(f"{key} = {_inline(value)}" for key, value in keys.items())]
    for kind in USUAL_AIDS:
        if kind != "ins" or log.receiver is not None:
            used = [first[one] for one in USUAL_AIDS[kind] if one in first]
            lines += ["", "[[estimator]]", f'name = "{kind}"', f'kind = "{kind}"', f'imu = "{log.unit}"']
            lines.append(f"aids = {_inline(used)}")
            lines += ['profile = "any_motion"'] if kind == "ahrs" else []  # nobody knows what vehicle it was
            if kind == "ahrs" and "magnetometer" not in first:
                lines.append(_heading(log))
    lines += ["", "[record]", f"rate_hz = {RECORD_HZ:g}", ""]
    return "\n".join(lines)


def _installed(section: SensorConfig) -> dict[str, Any]:
    """Where a sensor is, and how it is mounted, as far as that is said."""
    return {
        key: list(getattr(section, key))
        for key in ("lever_arm_m", "mounting_deg")
        if key in section.model_fields_set and any(getattr(section, key))
    }


def _is_elsewhere(log: Log, named: bool) -> bool:
    """Whether a log's solution can't judge it; one that the user ``named`` judges unless it is of another time."""
    if log.solution is None:
        return False
    imu = next(iter(log.imus.values()))
    if named and not silence(log.solution, float(imu.t[0]), float(imu.t[-1])):
        return False
    return bool(doubt(log.solution, log.samples) or elsewhere_in_height(log.solution, log.samples))


def is_placed(log: Log) -> bool:
    """Whether a log says where it was."""
    try:
        first_place(log, 0.0)
    except UserError:
        return False
    return True


def _heading(log: Log) -> str:
    """The line that says where a vehicle without magnetometer points at the start: as its autopilot thought."""
    q_nb = log.solution.columns.get("q_nb", np.empty((0, 4))) if log.solution is not None else np.empty((0, 4))
    known = np.flatnonzero(np.isfinite(q_nb).all(axis=1))
    if not len(known):
        return "heading_deg = 0  # at the start: nothing in the log tells it: give it"
    heading = math.degrees(euler_from_quat(q_nb[known[0]])[2])
    return f"heading_deg = {round(heading)}  # at the start, as its autopilot thought: no magnetometer tells it"


def _kept(truth: LogTruth, out: Path) -> dict[str, Any]:
    """What the scenario of a table said of its flight, files as seen from ``out``."""
    said = truth.model_dump(exclude_unset=True, include={"aircraft", "rate_hz", "start_s", "terrain"})
    ground = said.get("terrain", {})
    if ground.get("file") not in (None, JACKSBORO):
        ground["file"] = _seen_from(out, ground["file"])
    return {key: value for key, value in said.items() if value is not None}


def _columns(truth: LogTruth, out: Path) -> Mapping[str, Any]:
    """What the scenario said of a table's columns, without what it left out, files as seen from ``out``."""
    said = {name: stream.model_dump(exclude_unset=True) for name, stream in truth.columns.items()}
    for stream in said.values():
        for table in (stream, *(one for one in stream.values() if isinstance(one, dict))):
            if table.get("file") is not None:
                table["file"] = _seen_from(out, table["file"])
    return said


def _seen_from(out: Path, file: str | Path) -> str:
    return os.path.relpath(Path(file).resolve(), out.resolve().parent)


def _inline(value: Any) -> str:
    """A value as TOML has it on one line."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_inline(one)}" for key, one in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_inline, value)) + "]"
    return json.dumps(value)


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")
