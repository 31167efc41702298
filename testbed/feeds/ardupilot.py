"""ArduPilot's DataFlash log, binary (.bin) or text (.log), by pymavlink's reader.

What is taken: IMU (or GYR and ACC where that is missing), GPS with GPA, MAG as corrected on board, BARO, ARSP; each of
several as a sensor of its own, such as ``imu2``. The reference is what the first core of the EKF said, with POS. Times
are the autopilot's, at which it logged. Heights are above the sea's level as the receiver has it.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import gc
import io
import math
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from nav.samples import Array, FixType, GnssSample, ImuSamples
from testbed.errors import UserError
from testbed.feeds.doubted import remark
from testbed.feeds.log import Log, Reference, Samples, at_pace, beginning, require_imu
from testbed.feeds.reference import is_flown
from testbed.feeds.rest import refusal
from testbed.feeds.samples import Fixes, airspeeds, barometers, magnetometers, quaternions, spread
from testbed.feeds.stamps import Course, in_parts, integrated, joined, left_out, ordered, pace
from testbed.motion.logged import Stream
from testbed.sensors.gnss import GPS_EPOCH, LEAPS, WEEK_S

NEEDED = "IMU with GyrX to AccZ, or GYR and ACC: log them with LOG_BITMASK (IMU) or INS_RAW_LOG_OPT"
MILLIGAUSS = 1e-7  # that MAG is in [T]
BINARY = b"\xa3\x95"  # how every message begins; text may begin with lines of the ground station
ACCURACY_WITHIN_S = 0.3  # GPA comes right after the GPS that it belongs to

# The messages by what they become, old names for the second and third unit among them.
KINDS: Mapping[str, tuple[str, ...]] = {
    "imu": ("IMU", "IMU2", "IMU3"),
    "gyr": ("GYR", "GYR1", "GYR2", "GYR3"),
    "acc": ("ACC", "ACC1", "ACC2", "ACC3"),
    "gnss": ("GPS", "GPS2"),
    "accuracy": ("GPA", "GPA2"),
    "magnetometer": ("MAG", "MAG2", "MAG3"),
    "barometer": ("BARO", "BAR2", "BAR3"),
    "airspeed": ("ARSP", "ASP2"),
}
SOLUTIONS = ("XKF1", "NKF1", "EKF1", "ATT")  # the last is what it flew by, whoever found it
PLACES = ("POS", "AHR2")
TRIMS = ("AHRS_TRIM_X", "AHRS_TRIM_Y")  # roll and pitch of the inertial unit in the vehicle [rad]
RESOLUTION_DEG = 0.02  # of logged angles, and of what is added to them
LAST_PAGE = 528  # of a log that is written by pages, which may be empty [bytes]
LEAST_RUNNING = 0.5  # of the log
OTHER_ZERO = 100.0  # of heights that are so far from a receiver's [m]
PLACE = "place in the file"  # as a field of each message

Rows: TypeAlias = dict[str, Array]  # the fields of one kind of message of one unit


def read(path: Path, columns: Mapping[str, Stream]) -> Log:
    """Read a DataFlash log. Raises UserError when it is damaged, or has no inertial data."""
    notes: list[str] = []
    messages = _messages(path, notes)
    found = {name: len(rows) for name, rows in messages.items()}
    messages = _of_one_boot(messages, notes)
    units = _units(messages)
    imus: dict[str, ImuSamples] = {}
    for name, rows in units.get("imu", {}).items():
        t, kept = _times(name, rows, notes)
        imus[name] = integrated(t, _vector(rows, "Gyr", kept), _vector(rows, "Acc", kept), "averaged")
    if not imus:
        imus = _raw_units(units, notes)
    require_imu(path, imus, found, NEEDED, notes)
    samples = _aiding(units, notes)
    solution = None
    for solution in _solutions(messages, _heard_fixes(samples)):
        if not (refused := refusal(solution, imus, samples)):
            break
        notes.append(refused)
        solution = None
    log = Log(
        path, "ArduPilot DataFlash", imus, samples, solution, beginning(imus, samples, solution, notes), found, notes,
        date=_date(units), remark=remark(solution, imus, samples),
    )  # fmt: skip
    runs = _pace(units)
    return replace(at_pace(log, runs), utc=_utc(units, runs))


def _messages(path: Path, notes: list[str]) -> dict[str, list[dict[str, Any]]]:
    """All messages by their names, and what of the file is none. Raises UserError when there are no messages."""
    with path.open("rb") as file:
        text = file.read(2) != BINARY
    with warnings.catch_warnings(), _silence():
        warnings.simplefilter("ignore", ResourceWarning)  # of a file that the reader gives up on
        found, size, problem = _parsed(path, text)
        if problem:
            gc.collect()
    if not found:
        cut = "it was cut off, or never written"
        raise UserError(f"{path}: a DataFlash log without a single message: {problem or cut}")
    if not text and (lost := path.stat().st_size - size) > LAST_PAGE:
        notes.append(f"{lost} of its {size + lost} bytes can't be read, and are left out: it is damaged")
    return found


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Keep what the reader has to say of bad bytes, some of it past Python, from the user, whom we tell ourselves."""
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere, contextlib.redirect_stderr(io.StringIO()):
            os.dup2(nowhere.fileno(), 2)
            with contextlib.redirect_stdout(io.StringIO()):
                yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _parsed(path: Path, text: bool) -> tuple[dict[str, list[dict[str, Any]]], int, str]:
    """The messages up to where the file is damaged beyond reading, the bytes that they are, of a binary one, and how it
    is damaged, empty when it is not.
    """
    from pymavlink import DFReader  # type: ignore[import-untyped]

    found: dict[str, list[dict[str, Any]]] = {}
    size = count = 0
    wanted = {name for names in KINDS.values() for name in names} | {*SOLUTIONS, *PLACES, "PARM"}
    try:
        reader = (DFReader.DFReader_text if text else DFReader.DFReader_binary)(str(path))
        with contextlib.closing(reader.filehandle), contextlib.closing(reader.data_map):
            while (message := reader.recv_msg()) is not None:
                name = message.get_type()
                size += getattr(message.fmt, "len", 0)
                fields = _fields(message) if name in wanted else {}
                count += 1
                found.setdefault(name, []).append(fields and {**fields, PLACE: count})
    except Exception as error:  # whatever a damaged file makes the reader raise
        return found, size, f"{type(error).__name__} {error}"
    return found, size, ""


def _fields(message: Any) -> dict[str, Any]:
    """The fields of a message by name, empty where one of them can't be read."""
    try:
        return {key: getattr(message, key) for key in message.get_fieldnames()}
    except (AttributeError, TypeError, ValueError, UnicodeDecodeError):
        return {}


def _of_one_boot(messages: dict[str, list[dict[str, Any]]], notes: list[str]) -> dict[str, list[dict[str, Any]]]:
    """The messages of the boot of which the inertial unit was heard for longest, of a file that has several.

    Parameters of all are kept: they are told before the unit is heard.
    """
    named = (messages.get(name, []) for kind in ("imu", "gyr") for name in KINDS[kind])
    own = next((found for one in named if (found := [fields for fields in one if fields])), [])
    rows = _rows([one for one in own if one.get("I") == own[0].get("I")])
    _, kept, course = in_parts("imu", _stamps(rows), [], None, Course())
    if course.parts == 1:
        return messages
    first, last = rows[PLACE][kept].min(), rows[PLACE][kept].max()
    boot = {
        name: [one for one in every if name == "PARM" or not one or first <= one[PLACE] <= last]
        for name, every in messages.items()
    }
    told = f"time goes back {course.parts - 1} times: of all sensors that is kept which is of its longest part"
    lost = len(rows[PLACE]) - len(kept)
    notes.append(left_out("imu", f"{told}, {lost} rows of its own are left out", lost, len(rows[PLACE])))
    return boot


def _units(messages: Mapping[str, list[dict[str, Any]]]) -> dict[str, dict[str, Rows]]:
    """The fields of the messages that are sensors', by kind and name of the unit."""
    units: dict[str, dict[str, Rows]] = {}
    for kind, names in KINDS.items():
        for k, name in enumerate(names):
            own = [one for one in messages.get(name, []) if one]
            numbers = {one.get("I") for one in own}
            for number in sorted(numbers, key=lambda n: -1 if n is None else n):
                of_unit = [one for one in own if one.get("I") == number]
                if number is not None and len(of_unit) == 1 < len(own):
                    continue  # what damaged bytes look like
                count = (k if number is None else int(number)) + 1
                if kind in ("gyr", "acc") and number is None:
                    count = max(k, 1)
                named = "imu" if kind in ("gyr", "acc") else "gnss" if kind == "accuracy" else kind
                unit = named if count == 1 else f"{named}{count}"
                units.setdefault(kind, {}).setdefault(unit, _rows(of_unit))
    return units


def _rows(messages: list[dict[str, Any]]) -> Rows:
    """Fields of numbers as arrays; a field that one message lacks, or that is text, is left out."""
    rows = {}
    for key in messages[0] if messages else ():
        values = [one.get(key) for one in messages]
        if all(isinstance(value, int | float) for value in values):
            rows[key] = np.array(values, float)
    return rows


def _stamps(rows: Rows) -> Array:
    """When messages were logged [s]; old GPS messages have the week's time first, and the autopilot's as T."""
    for key, factor in (("SampleUS", 1e6), ("TimeUS", 1e6), ("T", 1e3), ("TimeMS", 1e3)):
        if key in rows and (key != "T" or "Week" in rows):
            return rows[key] / factor
    return np.full(len(next(iter(rows.values()), ())), np.nan)


def _times(name: str, rows: Rows, notes: list[str]) -> tuple[Array, Any]:
    return ordered(name, _stamps(rows), notes)


def _vector(rows: Rows, of: str, kept: Any) -> Array:
    """Three fields as vectors; NaN where a log has none of them."""
    missing = np.full(len(next(iter(rows.values()))), np.nan)
    return np.ascontiguousarray(np.column_stack([rows.get(f"{of}{axis}", missing)[kept] for axis in "XYZ"]))


def _raw_units(units: Mapping[str, Mapping[str, Rows]], notes: list[str]) -> dict[str, ImuSamples]:
    """Units that are logged raw: accelerometers at the times of the gyros."""
    imus = {}
    for name, gyr in units.get("gyr", {}).items():
        acc = units.get("acc", {}).get(name)
        if acc is None:
            continue
        t, kept = _times(name, gyr, notes)
        t_acc, kept_acc = _times(name, acc, notes)
        if len(t) > 1 and len(t_acc) > 1:
            force = _vector(acc, "Acc", kept_acc)
            at = np.column_stack([np.interp(t, t_acc, column) for column in force.T])
            imus[name] = integrated(t, _vector(gyr, "Gyr", kept), at, "averaged")
    return imus


def _aiding(units: Mapping[str, Mapping[str, Rows]], notes: list[str]) -> dict[str, Samples]:
    """The samples of all other sensors."""
    samples: dict[str, Samples] = {}
    for name, rows in units.get("gnss", {}).items():
        samples[name] = _fixes(name, rows, units.get("accuracy", {}).get(name), notes)
    for name, rows in units.get("magnetometer", {}).items():
        t, kept = _times(name, rows, notes)
        samples[name] = magnetometers(name, t, _vector(rows, "Mag", kept) * MILLIGAUSS, notes)
    for kind, key, made in (("barometer", "Press", barometers), ("airspeed", "Airspeed", airspeeds)):
        for name, rows in units.get(kind, {}).items():
            if key in rows:
                t, kept = _times(name, rows, notes)
                samples[name] = made(name, t, rows[key][kept])
    return {name: own for name, own in samples.items() if own}


def _fixes(name: str, rows: Rows, accuracy: Rows | None, notes: list[str]) -> Samples:
    if not {"Lat", "Lng", "Alt"} <= rows.keys():
        return []
    if lacking := [key for key in ("Status", "NSats", "HDop", "Spd", "GCrs") if key not in rows]:
        notes.append(f"{name}: its messages have no {', '.join(lacking)}: taken for unknown")
    t, kept = _times(name, rows, notes)
    own = {key: values[kept] for key, values in rows.items()}
    fixes = Fixes(t, np.radians(own["Lat"]), np.radians(own["Lng"]), own["Alt"])
    unknown = np.full(len(t), np.nan)
    speed, course, down = (own.get(key, unknown) for key in ("Spd", "GCrs", "VZ"))
    fixes.v_n = np.column_stack([speed * np.cos(np.radians(course)), speed * np.sin(np.radians(course)), down])
    fixes.fix = own.get("Status", np.where((own["Lat"] == 0) & (own["Lng"] == 0), FixType.NO_FIX, fixes.fix))
    fixes.satellites, fixes.hdop = own.get("NSats", fixes.satellites), own.get("HDop", fixes.hdop)
    if accuracy is not None and {"HAcc", "VAcc", "SAcc", "VDop"} <= accuracy.keys():
        t_acc, kept_acc = _times(f"{name} accuracy", accuracy, [])
        at, of = joined(t, t_acc, ACCURACY_WITHIN_S)
        told = {key: accuracy[key][kept_acc][of] for key in ("HAcc", "VAcc", "SAcc", "VDop")}
        fixes.vdop[at] = told["VDop"]
        # of the whole horizontal error and of the whole velocity, in parts that are alike
        fixes.sigma_position_n[at] = spread(told["HAcc"] / math.sqrt(2), told["VAcc"])
        fixes.sigma_velocity_n[at] = spread(told["SAcc"] / math.sqrt(3), told["SAcc"] / math.sqrt(3))
    return fixes.samples(name, notes)


def _heard_fixes(samples: Mapping[str, Samples]) -> tuple[Array, Array] | None:
    """Times [s] and heights [m] of the fixes of all receivers, in order; None where it has no receiver."""
    told = [one for own in samples.values() for one in own if isinstance(one, GnssSample)]
    fixes = np.array(sorted((one.t, one.h) for one in told if one.has_fix)).reshape(-1, 2)
    return (fixes[:, 0], fixes[:, 1]) if told else None


def _solutions(messages: Mapping[str, list[dict[str, Any]]], fixes: tuple[Array, Array] | None) -> Iterator[Reference]:
    """What the autopilot itself thought, the best first: attitude and velocity of an EKF's first core, and position.

    Position and velocity from the first of ``fixes`` on: until it has heard of a receiver, what it logs of them means
    nothing. Where it has none, it may have been told where it is.
    Logged angles are the vehicle's: those of the inertial unit less its trim (`TRIMS`). Where an EKF does not run, the
    unit's are zero; one that runs for less than `LEAST_RUNNING` of the log comes last.
    """
    trims = _trims(messages.get("PARM", []))
    since = -math.inf if fixes is None else min(fixes[0], default=math.inf)
    late = []
    for source in SOLUTIONS:
        own = [one for one in messages.get(source, []) if one]
        rows = _rows([one for one in own if one.get("C", 0) == 0] or own)
        if not {"Roll", "Pitch", "Yaw"} <= rows.keys():
            continue
        t, kept = _times(source, rows, [])
        angles = np.array([rows[key][kept] for key in ("Roll", "Pitch", "Yaw")]) + trims[:, None]
        columns = {"q_nb": quaternions(*np.radians(angles))}
        running = np.ones(len(t), bool)
        if {"VN", "VE", "VD"} <= rows.keys():
            running = np.asarray((np.abs(angles) > RESOLUTION_DEG).any(axis=0))
            velocity = np.column_stack([rows[key][kept] for key in ("VN", "VE", "VD")])
            columns["q_nb"] = np.where(running[:, None], columns["q_nb"], np.nan)
            columns["v_n"] = np.where((running & (t >= since))[:, None], velocity, np.nan)
        found = Reference(
            f"the autopilot's own solution ({source})", t, {**columns, **_places(messages, t, since, fixes)}
        )
        if running.any() and running.mean() >= LEAST_RUNNING:
            yield found
        elif running.any():
            late.append(found)
    yield from late


def _places(
    messages: Mapping[str, list[dict[str, Any]]], t: Array, since: float, fixes: tuple[Array, Array] | None
) -> dict[str, Array]:
    """The positions that it had at the times ``t`` [s], by the first kind of message that has any from ``since`` on."""
    for name in PLACES:
        place = _rows([one for one in messages.get(name, []) if one])
        if not {"Lat", "Lng", "Alt"} <= place.keys():
            continue
        at, kept = _times(name, place, [])
        lat, lon, h = np.radians(place["Lat"][kept]), np.radians(place["Lng"][kept]), place["Alt"][kept]
        known = ((lat != 0) | (lon != 0)) & (at >= since) & is_flown(lat, h)
        known &= at >= _of_one_zero_from(at[known], h[known], fixes)
        if known.sum() > 1:
            columns = zip(("lat", "lon", "h"), (lat[known], np.unwrap(lon[known]), h[known]), strict=True)
            found = {key: np.interp(t, at[known], column, left=np.nan, right=np.nan) for key, column in columns}
            return {**found, "lon": np.mod(found["lon"] + math.pi, 2 * math.pi) - math.pi}
    return {}


def _of_one_zero_from(at: Array, h: Array, fixes: tuple[Array, Array] | None) -> float:
    """The time [s] from which on heights (N,) [m] at the times ``at`` count from where a receiver's do.

    Before an autopilot has found the height of its origin, they count from where it was switched on. Where most of them
    never come near a receiver's, there is no such time: -inf.
    """
    if fixes is None or not len(fixes[0]) or not len(h):
        return -math.inf
    same = np.abs(h - np.interp(at, *fixes)) <= OTHER_ZERO
    return float(at[same.argmax()]) if same.mean() >= 0.5 else -math.inf


def _trims(parameters: Sequence[Mapping[str, Any]]) -> Array:
    """By how much the unit is rolled, pitched and turned in its vehicle (3,) [deg]: as it was at first."""
    found = np.zeros(3)
    for one in reversed(parameters):
        value = one.get("Value")
        if one.get("Name") in TRIMS and isinstance(value, float) and abs(value) < math.pi:
            found[TRIMS.index(one["Name"])] = math.degrees(value)
    return found


def _date(units: Mapping[str, Mapping[str, Rows]]) -> dt.date | None:
    """The day of the flight, by the receiver."""
    for rows in units.get("gnss", {}).values():
        told = _satellite_time(rows)
        told = told[np.isfinite(told)]
        if len(told):
            return (GPS_EPOCH + dt.timedelta(seconds=float(told[-1]))).date()
    return None


def _utc(units: Mapping[str, Mapping[str, Rows]], pace: float) -> float | None:
    """What the first receiver that tells says of the time at 0 of the autopilot's clock [s since 1970]."""
    for rows in units.get("gnss", {}).values():
        t, kept = _times("", rows, [])
        since = _satellite_time(rows)[kept] - t / pace
        fixed = rows["Status"][kept] >= FixType.FIX_3D if "Status" in rows else np.ones(len(t), bool)
        since = since[np.isfinite(since) & (fixed | ~fixed.any())]
        if len(since):
            zero = GPS_EPOCH.timestamp() + float(np.median(since))
            return zero - next((ahead for begins, ahead in LEAPS if zero >= begins), 0)
    return None


def _satellite_time(rows: Rows) -> Array:
    """When fixes were valid by the receiver itself [s since 1980], NaN where it does not say it."""
    for week, ms in (("GWk", "GMS"), ("Week", "TimeMS")):
        if week in rows and ms in rows:
            return np.where(rows[week] > 0, rows[week] * WEEK_S + rows[ms] / 1e3, np.nan)
    return np.full(len(next(iter(rows.values()), ())), np.nan)


def _pace(units: Mapping[str, Mapping[str, Rows]]) -> float:
    """How fast the autopilot's clock runs, by the first receiver that tells."""
    for rows in units.get("gnss", {}).values():
        t, kept = _times("", rows, [])
        fixed = rows["Status"][kept] >= FixType.FIX_3D if "Status" in rows else np.ones(len(t), bool)
        if (found := pace(t[fixed], _satellite_time(rows)[kept][fixed])) is not None:
            return found
    return 1.0
