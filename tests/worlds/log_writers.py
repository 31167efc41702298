"""A recorded run written as the logs of other systems, with their resolution: each only what the tests read."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

# --- ArduPilot DataFlash: name, format by the letters of its FMT message, labels
LETTERS = {one: one for one in "QBIHhf"} | {"L": "i", "e": "i", "c": "h", "C": "H", "N": "16s"}
SCALED = {"L": 1e7, "e": 100.0, "c": 100.0, "C": 100.0}
DATAFLASH = {
    "IMU": ("QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "GPS": ("QBBIHBcLLefff", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ"),
    "GPA": ("QBCCCf", "TimeUS,I,VDop,HAcc,VAcc,SAcc"),
    "MAG": ("QBfff", "TimeUS,I,MagX,MagY,MagZ"),
    "BARO": ("QBff", "TimeUS,I,Alt,Press"),
    "ARSP": ("QBf", "TimeUS,I,Airspeed"),
    "XKF1": ("QBffffff", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD"),
    "POS": ("QLLf", "TimeUS,Lat,Lng,Alt"),
    "ATT": ("Qfff", "TimeUS,Roll,Pitch,Yaw"),
    "PARM": ("QNf", "TimeUS,Name,Value"),
}


def us(t: Any) -> int:
    return round(float(t) * 1e6)


def rows(dataset: Any, group: str) -> Iterator[dict[str, Any]]:
    """The rows of one group of a record."""
    if group not in {node.path.strip("/") for node in dataset.subtree}:
        return
    own = dataset[group].to_dataset(inherit=False)
    names = [str(name) for name in own.variables if own[name].dims[:1] == ("time",)]
    columns = [own[name].values for name in names]
    for row in zip(*columns, strict=True):
        yield dict(zip(names, row, strict=True))


def dataflash_rows(dataset: Any) -> list[tuple[str, tuple[Any, ...]]]:
    """Messages in the order in which an autopilot would log them."""
    found: list[tuple[float, str, tuple[Any, ...]]] = []
    for r in rows(dataset, "sensors/imu"):
        found.append((r["time"], "IMU", (us(r["time"]), 0, *(r["dtheta"] / r["dt"]), *(r["dv"] / r["dt"]))))
    for r in rows(dataset, "sensors/gnss"):
        t, fix = r["t_arrival"], r["fix_type"] >= 3
        v = np.nan_to_num(r["v_n"])
        lat, lon, h = np.nan_to_num([math.degrees(r["lat"]), math.degrees(r["lon"]), r["h"]])
        speed, course = math.hypot(v[0], v[1]), math.degrees(math.atan2(v[1], v[0])) % 360
        status = 3 if fix else 1
        message = (us(t), 0, status, int(t * 1000), 2400, r["satellites"], r["hdop"], lat, lon, h, speed, course, v[2])
        found.append((t, "GPS", message))
        sp, sv = np.nan_to_num(r["sigma_position_n"]), np.nan_to_num(r["sigma_velocity_n"])
        whole = sp[0] * math.sqrt(2), sp[2], float(np.linalg.norm(sv))
        found.append((t, "GPA", (us(t), 0, r["vdop"], *whole)))
    for r in rows(dataset, "sensors/magnetometer"):
        found.append((r["t_arrival"], "MAG", (us(r["t_arrival"]), 0, *(r["field_b"] * 1e7))))
    for r in rows(dataset, "sensors/barometer"):
        found.append((r["t_arrival"], "BARO", (us(r["t_arrival"]), 0, 0.0, r["pressure"])))
    for r in rows(dataset, "sensors/airspeed"):
        found.append((r["t_arrival"], "ARSP", (us(r["t_arrival"]), 0, r["eas"])))
    for r in rows(dataset, "truth"):
        w, x, y, z = r["q_nb"]
        roll = math.atan2(2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
        pitch, yaw = math.asin(2 * (w * y - x * z)), math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
        angles = [math.degrees(a) for a in (roll, pitch, yaw)]
        found.append((r["time"], "XKF1", (us(r["time"]), 0, *angles, *r["v_n"])))
        place = math.degrees(r["lat"]), math.degrees(r["lon"]), r["h"]
        found.append((r["time"], "POS", (us(r["time"]), *place)))
    found.sort(key=lambda one: one[0])
    return [(name, values) for _, name, values in found]


def packed(letters: str, values: Sequence[Any]) -> bytes:
    given = [
        v if letter == "N" else float(v) if letter == "f" else round(float(v) * SCALED.get(letter, 1.0))
        for letter, v in zip(letters, values, strict=True)
    ]
    limited = [max(0, min(g, 65535)) if letter == "C" else g for letter, g in zip(letters, given, strict=True)]
    return struct.pack("<" + "".join(LETTERS[letter] for letter in letters), *limited)


def dataflash(messages: Sequence[tuple[str, Sequence[Any]]], path: Path) -> Path:
    """A binary DataFlash log."""
    numbers = {name: 130 + k for k, name in enumerate(DATAFLASH)}
    with path.open("wb") as file:
        for name, (letters, labels) in {"FMT": ("BBnNZ", "Type,Length,Name,Format,Columns"), **DATAFLASH}.items():
            size = 89 if name == "FMT" else 3 + struct.calcsize("<" + "".join(LETTERS[one] for one in letters))
            fields = (128 if name == "FMT" else numbers[name], size, name.encode(), letters.encode(), labels.encode())
            file.write(b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", *fields))
        for name, values in messages:
            file.write(b"\xa3\x95" + bytes([numbers[name]]) + packed(DATAFLASH[name][0], values))
    return path


def dataflash_text(messages: Sequence[tuple[str, Sequence[Any]]], path: Path) -> Path:
    """The same as text."""
    lines = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"]
    for k, (name, (letters, labels)) in enumerate(DATAFLASH.items()):
        lines.append(f"FMT, {130 + k}, 50, {name}, {letters}, {labels}")
    for name, values in messages:
        lines.append(", ".join([name, *(repr(float(v)) if isinstance(v, float) else str(v) for v in values)]))
    path.write_text("\n".join(lines) + "\n")
    return path


# --- PX4 ULog
ULOG = {
    "vehicle_imu": ("uint64_t timestamp;float[3] delta_angle;float[3] delta_velocity;uint32_t delta_angle_dt;"
                    "uint32_t delta_velocity_dt;", "<Q6fII"),
    "vehicle_gps_position": ("uint64_t timestamp;int32_t lat;int32_t lon;int32_t alt;int32_t alt_ellipsoid;"
                             "float s_variance_m_s;float eph;float epv;float hdop;float vdop;float vel_n_m_s;"
                             "float vel_e_m_s;float vel_d_m_s;uint8_t fix_type;uint8_t satellites_used;", "<Q4i8f2B"),
    "vehicle_magnetometer": ("uint64_t timestamp;float[3] magnetometer_ga;", "<Q3f"),
    "sensor_mag": ("uint64_t timestamp;float x;float y;float z;", "<Q3f"),
    "sensor_gyro": ("uint64_t timestamp;float x;float y;float z;", "<Q3f"),
    "sensor_accel": ("uint64_t timestamp;float x;float y;float z;", "<Q3f"),
    "vehicle_air_data": ("uint64_t timestamp;float baro_pressure_pa;", "<Qf"),
    "airspeed": ("uint64_t timestamp;float indicated_airspeed_m_s;", "<Qf"),
    "vehicle_attitude": ("uint64_t timestamp;float[4] q;", "<Q4f"),
    "vehicle_local_position": ("uint64_t timestamp;double ref_lat;double ref_lon;float ref_alt;float x;float y;float z;"
                               "float vx;float vy;float vz;", "<Q2d7f"),
}  # fmt: skip


def ulog_rows(dataset: Any) -> list[tuple[str, tuple[Any, ...]]]:
    """Messages in the order in which an autopilot would log them."""
    found: list[tuple[float, str, tuple[Any, ...]]] = []
    for r in rows(dataset, "sensors/imu"):
        found.append((r["time"], "vehicle_imu", (us(r["time"]), *r["dtheta"], *r["dv"], us(r["dt"]), us(r["dt"]))))
    for r in rows(dataset, "sensors/gnss"):
        lat, lon, h = np.nan_to_num([math.degrees(r["lat"]), math.degrees(r["lon"]), r["h"]])
        v, sp, sv = (np.nan_to_num(r[key]) for key in ("v_n", "sigma_position_n", "sigma_velocity_n"))
        place = round(lat * 1e7), round(lon * 1e7), round(h * 1e3), round(h * 1e3)
        how_good = float(np.linalg.norm(sv)), sp[0] * math.sqrt(2), sp[2], r["hdop"], r["vdop"]
        said = (us(r["t_arrival"]), *place, *how_good, *v, int(r["fix_type"]), int(r["satellites"]))
        found.append((r["t_arrival"], "vehicle_gps_position", said))
    for name, group, keys, factor in (
        ("vehicle_magnetometer", "magnetometer", "field_b", 1e4),
        ("vehicle_air_data", "barometer", "pressure", 1.0),
        ("airspeed", "airspeed", "eas", 1.0),
    ):
        for r in rows(dataset, f"sensors/{group}"):
            found.append((r["t_arrival"], name, (us(r["t_arrival"]), *(factor * np.atleast_1d(r[keys])))))
    first: Mapping[str, Any] | None = None
    for r in rows(dataset, "truth"):
        first = first or r
        found.append((r["time"], "vehicle_attitude", (us(r["time"]), *r["q_nb"])))
        north, east = _moved(first, r)
        place = math.degrees(first["lat"]), math.degrees(first["lon"]), first["h"], north, east, first["h"] - r["h"]
        found.append((r["time"], "vehicle_local_position", (us(r["time"]), *place, *r["v_n"])))
    found.sort(key=lambda one: one[0])
    return [(name, values) for _, name, values in found]


def _moved(first: Mapping[str, Any], r: Mapping[str, Any]) -> tuple[float, float]:
    """North and east as PX4 has them: distance and bearing of the great circle, on a sphere of 6371 km (haversines)."""
    lat0, lat, dlon = first["lat"], r["lat"], r["lon"] - first["lon"]
    half = math.sin((lat - lat0) / 2) ** 2 + math.cos(lat0) * math.cos(lat) * math.sin(dlon / 2) ** 2
    distance = 2 * 6_371_000.0 * math.asin(math.sqrt(half))
    away = math.cos(lat0) * math.sin(lat) - math.sin(lat0) * math.cos(lat) * math.cos(dlon)
    bearing = math.atan2(math.sin(dlon) * math.cos(lat), away)
    return distance * math.cos(bearing), distance * math.sin(bearing)


def ulog(messages: Sequence[tuple[str, Sequence[Any]]], path: Path) -> Path:
    """A ULog; messages of ``topic:1`` are of the second instance of the topic."""
    numbers = {name: k for k, name in enumerate(dict.fromkeys([*ULOG, *(name for name, _ in messages)]))}

    def message(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<H", len(body)) + kind + body

    with path.open("wb") as file:
        file.write(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0))
        file.write(message(b"B", bytes(40)))
        for name, (fields, _) in ULOG.items():
            file.write(message(b"F", f"{name}:{fields}".encode()))
        for name, number in numbers.items():
            topic, _, instance = name.partition(":")
            file.write(message(b"A", struct.pack("<BH", int(instance or 0), number) + topic.encode()))
        for name, values in messages:
            body = struct.pack(ULOG[name.partition(":")[0]][1], *values)
            file.write(message(b"D", struct.pack("<H", numbers[name]) + body))
    return path


# --- CSV
CSV = {
    "imu": {"time": "t", "gyro": ["gx", "gy", "gz"], "accel": ["ax", "ay", "az"]},
    "gnss": {
        "time": "t",
        "lat": {"column": "lat", "unit": "deg"},
        "lon": {"column": "lon", "unit": "deg"},
        "height": "h",
        "velocity": ["vn", "ve", "vd"],
        "sigma_position": ["spn", "spe", "spd"],
        "sigma_velocity": ["svn", "sve", "svd"],
        "satellites": "sats",
        "hdop": "hdop",
        "vdop": "vdop",
    },
    "magnetometer": {"time": "t", "field": {"column": ["mx", "my", "mz"], "unit": "uT"}},
    "barometer": {"time": "t", "pressure": {"column": "hpa", "unit": "hPa"}},
    "airspeed": {"time": "t", "airspeed": {"column": "kn", "unit": "kn"}},
}


def csv(dataset: Any, path: Path) -> Path:
    """One table of all sensors, blank where one says nothing; `CSV` are its columns."""
    import pandas

    lines: list[dict[str, float]] = []

    def put(t: float, names: Sequence[str], values: Any) -> None:
        lines.append({"t": t, **dict(zip(names, np.atleast_1d(values), strict=True))})

    for r in rows(dataset, "sensors/imu"):
        put(r["time"], ("gx", "gy", "gz", "ax", "ay", "az"), np.concatenate([r["dtheta"], r["dv"]]) / r["dt"])
    for r in rows(dataset, "sensors/gnss"):
        names = ("lat", "lon", "h", "vn", "ve", "vd", "spn", "spe", "spd", "svn", "sve", "svd", "sats", "hdop", "vdop")
        place = [math.degrees(r["lat"]), math.degrees(r["lon"]), r["h"]]
        rest = [r["satellites"], r["hdop"], r["vdop"]]
        put(
            r["t_arrival"], names, np.concatenate([place, r["v_n"], r["sigma_position_n"], r["sigma_velocity_n"], rest])
        )
    for r in rows(dataset, "sensors/magnetometer"):
        put(r["t_arrival"], ("mx", "my", "mz"), r["field_b"] * 1e6)
    for r in rows(dataset, "sensors/barometer"):
        put(r["t_arrival"], ("hpa",), r["pressure"] / 100)
    for r in rows(dataset, "sensors/airspeed"):
        put(r["t_arrival"], ("kn",), r["eas"] * 3600 / 1852)
    lines.sort(key=lambda line: line["t"])
    pandas.DataFrame(lines).to_csv(path, index=False)
    return path


def csv_columns() -> str:
    """[truth.columns] for `csv`."""

    def written(value: Any) -> str:
        if isinstance(value, dict):
            return "{ " + ", ".join(f"{key} = {written(one)}" for key, one in value.items()) + " }"
        return "[" + ", ".join(map(written, value)) + "]" if isinstance(value, list) else f'"{value}"'

    return "\n".join(f"columns.{name} = {written(columns)}" for name, columns in CSV.items())
