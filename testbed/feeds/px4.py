"""PX4's ULog (.ulg), by pyulog.

Of several ways in which PX4 logs the same sensor that with the most samples of one instance is taken: integrated
increments (vehicle_imu), sensor_combined, or raw sensor_gyro and sensor_accel; likewise for GNSS, barometer and
airspeed. What is raw is neither calibrated nor turned into body axes: of inertial units it is taken where the others
are much slower, of magnetometers where there is nothing else. Instances are sensors of their own, such as ``imu2``. The
reference is what the EKF said of attitude and local position. Times are the autopilot's: of the samples themselves
where it logs them.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from nav.earth import isa_pressure, wrap_longitude
from nav.samples import Array, FixType, ImuSamples
from testbed.errors import UserError
from testbed.feeds.doubted import remark
from testbed.feeds.log import Log, Reference, Samples, beginning, require_imu
from testbed.feeds.reference import is_flown
from testbed.feeds.rest import refusal
from testbed.feeds.samples import Fixes, airspeeds, barometers, eas_of, magnetometers, spread
from testbed.feeds.stamps import integrated, ordered
from testbed.motion.logged import Stream

NEEDED = "vehicle_imu, sensor_combined, or sensor_gyro and sensor_accel"
GAUSS = 1e-4  # [T]
SPHERE_M = 6_371_000.0  # PX4's Earth
NEVER = 2**31 - 1  # a relative time of what is not there
# Counts that are alike: of them the first way is taken. A way that is calibrated and in body axes is used from a lower
# share of the most samples on, than one that is raw.
ALIKE, RAW_SHARE = 0.9, 0.1
USED_FROM = {"vehicle_magnetometer": 0.0, "sensor_combined": 0.0}
RECEIVERS = ("sensor_gps", "vehicle_gps_position")  # the topics of GNSS
HEIGHTS = ("altitude_ellipsoid_m", "altitude_msl_m", 1.0)  # of them above ellipsoid and sea, and the unit [m]
OLD_HEIGHTS = ("alt_ellipsoid", "alt", 1e-3)
OLDEST_MBAR = 2000.0  # pressures below it are in the millibars of early logs

Rows: TypeAlias = Mapping[str, Array]  # the fields of one instance of a topic
Topics: TypeAlias = Mapping[str, Mapping[int, Rows]]  # by name and number
Making: TypeAlias = Callable[[str, Rows, list[str]], Samples]


def read(path: Path, columns: Mapping[str, Stream]) -> Log:
    """Read a ULog. Raises UserError when it is damaged, or has no inertial data."""
    notes: list[str] = []
    logged = _topics(path, notes)
    found = {name: sum(len(rows["timestamp"]) for rows in own.values()) for name, own in logged.items()}
    topics = _one_height(logged)
    imus = _imus(topics, notes)
    require_imu(path, imus, found, NEEDED, notes)
    samples: dict[str, Samples] = {}
    for kind, sources in SOURCES.items():
        counts = [_most(topics, source[0], source[1]) for source in sources]
        chosen = sources[_chosen(counts, [USED_FROM.get(source[0], ALIKE) for source in sources])]
        for number, rows in topics.get(chosen[0], {}).items():
            if chosen[1] not in rows or (kind != "gnss" and len(rows["timestamp"]) < 2):
                continue
            name = kind if number == 0 else f"{kind}{number + 1}"
            if own := chosen[2](name, rows, notes):
                samples[name] = own
    solution = _solution(topics)
    if solution is not None and (refused := refusal(solution, imus, samples)):
        notes.append(refused)
        solution = None
    start = beginning(imus, samples, solution, notes)
    return Log(
        path, "PX4 ULog", imus, samples, solution, start, found, notes, date=_date(topics),
        remark=remark(solution, imus, samples), utc=_utc(topics),
    )  # fmt: skip


def _topics(path: Path, notes: list[str]) -> dict[str, dict[int, Rows]]:
    """All topics with their fields, and what is missing. Raises UserError where none can be read."""
    from pyulog import ULog

    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            log = ULog(str(path))
    except Exception as error:  # whatever a damaged file makes the reader raise
        raise UserError(f"{path}: can't be read as a ULog: {type(error).__name__} {error}") from None
    topics: dict[str, dict[int, Rows]] = {}
    for data in log.data_list:
        if len(data.data.get("timestamp", ())):
            topics.setdefault(data.name, {})[data.multi_id] = data.data
    if not topics:
        raise UserError(f"{path}: a ULog without a single message: it was cut off, or never written")
    if log.file_corruption:
        notes.append("parts of it can't be read, and are left out: it is damaged")
    if log.dropouts:
        lost = sum(one.duration for one in log.dropouts) / 1e3
        notes.append(f"its logger was too slow {len(log.dropouts)} times: all messages of {lost:.2f} s are missing")
    return topics


def _most(topics: Topics, name: str, key: str) -> int:
    """How many samples an instance of a topic has, the most, that has a field."""
    return max((len(rows["timestamp"]) for rows in topics.get(name, {}).values() if key in rows), default=0)


def _chosen(counts: Sequence[int], shares: Sequence[float]) -> int:
    """Of several ways by their counts: the first that has its share of the most, or that which has the most."""
    most = max(counts)
    enough = (k for k, (n, share) in enumerate(zip(counts, shares, strict=True)) if n > 1 and n >= share * most)
    return next(enough, counts.index(most))


def _seconds(rows: Rows, key: str = "") -> Array:
    """When samples were taken, where the log says it [s]."""
    if key:
        after = rows[key].astype(float)
        return np.asarray(np.where(after == NEVER, np.nan, (rows["timestamp"].astype(float) + after) / 1e6))
    own = rows.get("timestamp_sample", rows["timestamp"]).astype(float)
    return np.asarray(np.where(own > 0, own, rows["timestamp"].astype(float)) / 1e6)


def _vector(rows: Rows, *names: str) -> Array:
    return np.ascontiguousarray(np.column_stack([rows[name].astype(float) for name in names]))


def _array(rows: Rows, name: str) -> Array:
    return _vector(rows, *(f"{name}[{k}]" for k in range(3)))


def _imus(topics: Topics, notes: list[str]) -> dict[str, ImuSamples]:
    """The inertial units, by the way in which the most samples of them were logged."""
    corrected = (("vehicle_imu", "delta_angle[0]", _of_increments), ("sensor_combined", "gyro_rad[0]", _of_combined))
    counts = [_most(topics, name, key) for name, key, _ in corrected]
    raw = _most(topics, "sensor_gyro", "x")
    if raw and max(counts) < RAW_SHARE * raw:
        return _of_raw(topics, notes)
    return corrected[_chosen(counts, (ALIKE, 0.0))][2](topics, notes) if max(counts) else {}


def _of_increments(topics: Topics, notes: list[str]) -> dict[str, ImuSamples]:
    imus = {}
    for number, rows in topics["vehicle_imu"].items():
        name = _unit(number)
        t, kept = ordered(name, _seconds(rows), notes)
        rates = [_array(rows, what) * 1e6 / _lengths(rows, f"{what}_dt") for what in ("delta_angle", "delta_velocity")]
        imus[name] = integrated(t, rates[0][kept], rates[1][kept], "averaged")
    return imus


def _lengths(rows: Rows, key: str) -> Array:
    """Over how long increments were integrated (N, 1) [us]: of early logs both in one."""
    return np.asarray(np.maximum(rows[key if key in rows else "dt"].astype(float), 1.0))[:, None]


def _of_combined(topics: Topics, notes: list[str]) -> dict[str, ImuSamples]:
    rows = next(iter(topics["sensor_combined"].values()))
    t, kept = ordered("imu", _seconds(rows), notes)
    return {"imu": integrated(t, _array(rows, "gyro_rad")[kept], _array(rows, "accelerometer_m_s2")[kept], "averaged")}


def _of_raw(topics: Topics, notes: list[str]) -> dict[str, ImuSamples]:
    imus = {}
    for number, gyro in topics["sensor_gyro"].items():
        accel = topics.get("sensor_accel", {}).get(number)
        if accel is None:
            continue
        name = _unit(number)
        t, kept = ordered(name, _seconds(gyro), notes)
        t_accel, kept_accel = ordered(name, _seconds(accel), [])
        if len(t) > 1 and len(t_accel) > 1:
            force = _vector(accel, "x", "y", "z")[kept_accel]
            at = np.column_stack([np.interp(t, t_accel, column) for column in force.T])
            imus[name] = integrated(t, _vector(gyro, "x", "y", "z")[kept], at, "averaged")
    return imus


def _unit(number: int) -> str:
    return "imu" if number == 0 else f"imu{number + 1}"


def _fixes(name: str, rows: Rows, notes: list[str]) -> Samples:
    """A receiver's samples: when they were told of, as its time of validity is not known to the autopilot."""
    t, kept = ordered(name, rows["timestamp"].astype(float) / 1e6, notes)
    own = {key: values[kept].astype(float) for key, values in rows.items()}
    if "latitude_deg" in own:
        lat, lon = own["latitude_deg"], own["longitude_deg"]
    else:
        lat, lon = own["lat"] / 1e7, own["lon"] / 1e7
    fixes = Fixes(t, np.radians(lat), np.radians(lon), _heights(own)[0])
    fixes.v_n = np.column_stack([own[f"vel_{axis}_m_s"] for axis in "ned"])
    if "vel_ned_valid" in own:
        fixes.v_n[own["vel_ned_valid"] == 0] = np.nan
    fixes.fix = own["fix_type"]
    for key, there in (("satellites", "satellites_used"), ("hdop", "hdop"), ("vdop", "vdop")):
        if there in own:
            setattr(fixes, key, own[there])
    # of the whole horizontal error and of the whole velocity, in parts that are alike
    fixes.sigma_position_n = spread(own["eph"] / math.sqrt(2), own["epv"])
    each = own["s_variance_m_s"] / math.sqrt(3)
    fixes.sigma_velocity_n = spread(each, each)
    return fixes.samples(name, notes)


def _heights(rows: Rows) -> tuple[Array, Array]:
    """A receiver's heights above the ellipsoid and above the sea [m], the latter twice where it tells no others."""
    ellipsoid, sea, unit = OLD_HEIGHTS if "alt" in rows else HEIGHTS
    above_sea = unit * rows[sea].astype(float)
    return (unit * rows[ellipsoid].astype(float) if _has_ellipsoid(rows) else above_sea), above_sea


def _has_ellipsoid(rows: Rows) -> bool:
    """Whether a receiver's topic tells heights above the ellipsoid: where it does not, they are missing or zero."""
    return any(rows[keys[0]].any() for keys in (HEIGHTS, OLD_HEIGHTS) if keys[0] in rows)


def _one_height(topics: Topics) -> Topics:
    """The topics without a receiver's that tell heights above the sea alone, where the other tells those it needs.

    Else the fixes could be above the sea, and the EKF's heights brought to the ellipsoid.
    """
    better = {name for name in RECEIVERS if any(map(_has_ellipsoid, topics.get(name, {}).values()))}
    return {name: own for name, own in topics.items() if name not in RECEIVERS or name in (better or RECEIVERS)}


def _field(name: str, rows: Rows, notes: list[str]) -> Samples:
    t, kept = ordered(name, _seconds(rows), notes)
    own = _vector(rows, "x", "y", "z") if "x" in rows else _array(rows, "magnetometer_ga")
    return magnetometers(name, t, own[kept] * GAUSS, notes)


def _combined_field(name: str, rows: Rows, notes: list[str]) -> Samples:
    t, kept = _newly(rows, "magnetometer_timestamp_relative")
    return magnetometers(name, t, _array(rows, "magnetometer_ga")[kept] * GAUSS, notes)


def _combined_altitude(name: str, rows: Rows, notes: list[str]) -> Samples:
    t, kept = _newly(rows, "baro_timestamp_relative")
    return barometers(name, t, np.asarray(isa_pressure(rows["baro_alt_meter"][kept].astype(float))))


def _newly(rows: Rows, key: str) -> tuple[Array, Any]:
    """The rows of sensor_combined with something new of another sensor: what is old it repeats."""
    t = _seconds(rows, key)
    known = np.flatnonzero(np.isfinite(t))
    return _quietly(t, known[np.diff(t[known], prepend=-np.inf) > 1e-6])


def _quietly(t: Array, rows: Any) -> tuple[Array, Any]:
    """`ordered` without a word."""
    times, kept = ordered("", t[rows], [])
    return times, rows[kept]


def _pressure(key: str) -> Making:
    def make(name: str, rows: Rows, notes: list[str]) -> Samples:
        t, kept = ordered(name, _seconds(rows), notes)
        pressure = rows[key][kept].astype(float)
        return barometers(name, t, np.where(pressure < OLDEST_MBAR, 100.0 * pressure, pressure))

    return make


def _speed(name: str, rows: Rows, notes: list[str]) -> Samples:
    t, kept = ordered(name, _seconds(rows), notes)
    return airspeeds(name, t, rows["indicated_airspeed_m_s"][kept].astype(float))


def _tube(name: str, rows: Rows, notes: list[str]) -> Samples:
    t, kept = ordered(name, _seconds(rows), notes)
    return airspeeds(name, t, eas_of(rows["differential_pressure_filtered_pa"][kept].astype(float)))


# By kind: topic, a field that it must have, and what makes samples of it.
SOURCES: Mapping[str, tuple[tuple[str, str, Making], ...]] = {
    "gnss": tuple((name, "eph", _fixes) for name in RECEIVERS),
    "magnetometer": (
        ("vehicle_magnetometer", "magnetometer_ga[0]", _field),
        ("sensor_combined", "magnetometer_ga[0]", _combined_field),
        ("sensor_mag", "x", _field),
    ),
    "barometer": (
        ("vehicle_air_data", "baro_pressure_pa", _pressure("baro_pressure_pa")),
        ("sensor_baro", "pressure", _pressure("pressure")),
        ("sensor_combined", "baro_alt_meter", _combined_altitude),
    ),
    "airspeed": (
        ("airspeed", "indicated_airspeed_m_s", _speed),
        ("differential_pressure", "differential_pressure_filtered_pa", _tube),
    ),
}


def _first(topics: Topics, names: Iterable[str]) -> Rows | None:
    return next((next(iter(topics[name].values())) for name in names if name in topics), None)


def _solution(topics: Topics) -> Reference | None:
    """What the EKF said: attitude at its own times, velocity and position there from the local position."""
    attitude = _first(topics, ("vehicle_attitude",))
    if attitude is None or "q[0]" not in attitude:
        return None
    t, kept = _quietly(_seconds(attitude), np.arange(len(attitude["timestamp"])))
    q = _vector(attitude, *(f"q[{k}]" for k in range(4)))[kept]
    columns: dict[str, Array] = {"q_nb": q / np.linalg.norm(q, axis=1, keepdims=True)}
    local = _first(topics, ("vehicle_local_position",))
    if local is not None and "vx" in local and len(local["timestamp"]) > 1:
        at, rows = _quietly(_seconds(local), np.arange(len(local["timestamp"])))
        own = {key: values[rows].astype(float) for key, values in local.items()}

        def there(key: str, valid: str) -> Array:
            values = np.where(own[valid] > 0, own[key], np.nan) if valid in own else own[key]
            return np.asarray(np.interp(t, at, values, left=np.nan, right=np.nan))

        columns["v_n"] = np.column_stack(
            [there("vx", "v_xy_valid"), there("vy", "v_xy_valid"), there("vz", "v_z_valid")]
        )
        lat0, lon0 = (np.radians(there(key, "xy_global")) for key in ("ref_lat", "ref_lon"))
        h0 = there("ref_alt", "z_global")
        columns["lat"], columns["lon"] = placed(there("x", "xy_valid"), there("y", "xy_valid"), lat0, lon0)
        columns["h"] = h0 - there("z", "z_valid") + _geoid(topics)
        somewhere = is_flown(columns["lat"], columns["h"])
        columns |= {name: np.where(somewhere, columns[name], np.nan) for name in ("lat", "lon", "h")}
    return Reference("the autopilot's own solution (EKF)", t, columns)


def placed(north: Array, east: Array, lat0: Array, lon0: Array) -> tuple[Array, Array]:
    """Latitudes and longitudes (N,) [rad] of PX4's local positions [m], from the origins (N,) [rad] that go with them.

    PX4's projection is azimuthal equidistant, on a sphere of `SPHERE_M` and whatever the height: its metres are up to
    0.5 % off those over the ellipsoid. Snyder, "Map Projections: A Working Manual" (USGS 1395), Eq 20-14, 20-15, 25-15.
    """
    c = np.hypot(north, east) / SPHERE_M
    per_m = np.sinc(c / np.pi) / SPHERE_M  # sin c over the distance
    lat = np.arcsin(np.clip(np.cos(c) * np.sin(lat0) + per_m * north * np.cos(lat0), -1.0, 1.0))
    along = np.cos(lat0) * np.cos(c) - np.sin(lat0) * per_m * north
    return lat, wrap_longitude(lon0 + np.arctan2(per_m * east, along))


def _geoid(topics: Topics) -> float:
    """How far the receiver has the sea above the ellipsoid [m]: the EKF's heights are of the one, its of the other."""
    gps = _first(topics, RECEIVERS)
    if gps is None:
        return 0.0
    ellipsoid, sea = _heights(gps)
    known = (gps["fix_type"] >= FixType.FIX_3D) & (ellipsoid != 0)
    return float(np.median(ellipsoid[known] - sea[known])) if known.any() else 0.0


def _date(topics: Topics) -> dt.date | None:
    """The day of the flight, by the receiver."""
    gps = _first(topics, RECEIVERS)
    utc = 0 if gps is None or "time_utc_usec" not in gps else int(gps["time_utc_usec"].max())
    return dt.datetime.fromtimestamp(utc / 1e6, dt.UTC).date() if utc else None


def _utc(topics: Topics) -> float | None:
    """What the receiver says of the time at 0 of the autopilot's clock [s since 1970]."""
    gps = _first(topics, RECEIVERS)
    if gps is None or "time_utc_usec" not in gps:
        return None
    told, fixed = gps["time_utc_usec"] > 0, gps["fix_type"] >= FixType.FIX_3D
    told = told & fixed if (told & fixed).any() else told
    since = gps["time_utc_usec"][told] / 1e6 - _seconds(gps)[told]
    return float(np.median(since)) if len(since) else None
