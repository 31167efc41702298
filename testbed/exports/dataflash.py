"""A record as a DataFlash log of ArduPilot, for its log viewers: units and scales are in it.

Its clock begins `stream.START_US` before the run. Samples stand where they arrived, truth is SIM (of the centre of
gravity; without an attitude its angles are 0 and its quaternion is NaN), estimators are the cores of XKF1 (of the IMU),
the first of them ATT and POS too. Messages that ArduPilot's Replay needs are not in it. Heights above the sea's level
are those above the ellipsoid.

Sources: LogStructure.h of AP_Logger, AP_GPS, AP_InertialSensor, AP_Compass, AP_AHRS and AP_NavEKF3 of ArduPilot 4.6.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from nav.earth import SEA_LEVEL_DENSITY, isa_temperature, position_difference_n, pressure_altitude
from nav.samples import Array
from testbed.exports.stream import Bytes, Rows, Stamps, in_order, stamps
from testbed.exports.view import Columns, View, carried, fixed
from testbed.score.accuracy import euler
from testbed.sensors.gnss import GPS_EPOCH, LEAP_S, WEEK_S

if TYPE_CHECKING:
    import xarray

HEAD = b"\xa3\x95"
FIRST_NUMBER = 128  # of messages; FMT has it
TEXT_BYTES = 64  # of the letter Z
GAUSS, FREEZING = 1e-4, 273.15  # [T], [K]
NONE, FIX_3D = 1, 3  # fixes, as ArduPilot counts them

# Letters of a format: how the number is stored, and by what it is multiplied first.
LETTERS: Mapping[str, tuple[str, float]] = {
    "Q": ("<u8", 1), "d": ("<f8", 1), "f": ("<f4", 1), "B": ("u1", 1), "b": ("i1", 1), "H": ("<u2", 1), "I": ("<u4", 1),
    "c": ("<i2", 100), "C": ("<u2", 100), "e": ("<i4", 100), "L": ("<i4", 1e7), "h": ("<i2", 1),
    "n": ("S4", 1), "N": ("S16", 1), "Z": (f"S{TEXT_BYTES}", 1),
}  # fmt: skip


class Message(NamedTuple):
    """Letters and labels of a message, units and multipliers of its fields."""

    letters: str
    labels: str
    units: str
    factors: str


MESSAGES: Mapping[str, Message] = {
    "FMT": Message("BBnNZ", "Type,Length,Name,Format,Columns", "-b---", "-----"),
    "UNIT": Message("QbZ", "TimeUS,Id,Label", "s--", "F--"),
    "MULT": Message("Qbd", "TimeUS,Id,Mult", "s--", "F--"),
    "FMTU": Message("QBNN", "TimeUS,FmtType,UnitIds,MultIds", "s---", "F---"),
    "MSG": Message("QZ", "TimeUS,Message", "s-", "F-"),
    "IMU": Message(
        "QBffffffIIfBBHH",
        "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz",
        "s#EEEooo--O--zz",
        "F-000000-----00",
    ),
    "GPS": Message(
        "QBBIHBcLLeffffB",
        "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U",
        "s#-s-S-DUmnhnh-",
        "F--C-0BGGB000--",
    ),
    "GPA": Message("QBCCCCfBIH", "TimeUS,I,VDop,HAcc,VAcc,SAcc,YAcc,VV,SMS,Delta", "s#mmmnd-ss", "F-BBBB0-CC"),
    "BARO": Message(
        "QBfffcfIffBf",
        "TimeUS,I,Alt,AltAMSL,Press,Temp,CRt,SMS,Offset,GndTemp,H,CPress",
        "s#mmPOnsmO-P",
        "F-000B0C?0-0",
    ),
    "MAG": Message(
        "QBhhhhhhhhhBI",
        "TimeUS,I,MagX,MagY,MagZ,OfsX,OfsY,OfsZ,MOX,MOY,MOZ,Health,S",
        "s#GGGGGGGGG-s",
        "F-CCCCCCCCC-F",
    ),
    "ARSP": Message(
        "QBffcffBBffB",
        "TimeUS,I,Airspeed,DiffPress,Temp,RawPress,Offset,U,H,Hp,TR,Pri",
        "s#nPOPP-----",
        "F-00B00-----",
    ),
    "ATT": Message("QffffffB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,AEKF", "sddddhh-", "F000000-"),
    "ORGN": Message("QBLLe", "TimeUS,Type,Lat,Lng,Alt", "s#DUm", "F-GGB"),
    "POS": Message("QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt", "sDUmmm", "FGG000"),
    "XKF1": Message(
        "QBccCfffffffccce",
        "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD,GX,GY,GZ,OH",
        "s#ddhnnnnmmmkkkm",
        "F-BBB0000000BBBB",
    ),
    "SIM": Message(
        "QccCfLLffff", "TimeUS,Roll,Pitch,Yaw,Alt,Lat,Lng,Q1,Q2,Q3,Q4", "sddhmDU----", "FBBB0GG----"
    ),
}  # fmt: skip
NUMBERS = {name: FIRST_NUMBER + k for k, name in enumerate(MESSAGES)}

UNITS = {
    "-": "", "s": "s", "#": "instance", "d": "deg", "D": "deglatitude", "U": "deglongitude", "h": "degheading",
    "k": "deg/s", "E": "rad/s", "m": "m", "n": "m/s", "o": "m/s/s", "G": "Gauss", "P": "Pa", "O": "degC",
    "S": "satellites", "b": "B", "z": "Hz",
}  # fmt: skip
FACTORS = {"-": 0.0, "?": 1.0, "0": 1.0, "B": 1e-2, "C": 1e-3, "F": 1e-6, "G": 1e-7}


def content(tree: xarray.DataTree) -> bytes:
    """The log of a record."""
    view = View(tree)
    told = [("navigation-testbed: " + view.title, 0.0), *((text, t) for t, _, text in view.events)]
    pieces = [(piece, t) for text, t in told for piece in _pieces(text)]
    words = _rows("MSG", stamps(np.array([t for _, t in pieces])), Message=np.array([piece for piece, _ in pieces]))
    parts = [("MSG", words), *_sensors(view), *_solutions(view)]
    return _head() + in_order([(own["TimeUS"], _framed(name, own)) for name, own in parts])


def _pieces(text: str) -> list[bytes]:
    """A text in as many pieces as messages have room for, none of which ends within a character."""
    found, rest = [], text.encode()
    while len(rest) > TEXT_BYTES:
        end = next(k for k in range(TEXT_BYTES, 0, -1) if rest[k] & 0xC0 != 0x80)  # no byte that goes on with another
        found.append(rest[:end])
        rest = rest[end:]
    return [*found, rest]


@cache
def _row(name: str) -> np.dtype[Any]:
    message = MESSAGES[name]
    labels = message.labels.split(",")
    return np.dtype([(label, LETTERS[letter][0]) for label, letter in zip(labels, message.letters, strict=True)])


def _rows(name: str, t: Stamps, **values: Any) -> Rows:
    """Rows of a message: ``values`` in the units that readers give back, 0 where nothing is said, at most the largest.

    Raises KeyError of a field that it doesn't have.
    """
    made = np.zeros(len(t), _row(name))
    factors = dict(zip(made.dtype.names or (), (LETTERS[one][1] for one in MESSAGES[name].letters), strict=True))
    for field, value in {"TimeUS": t, **values}.items():
        kind = made.dtype[field]
        if kind.kind in "iu":
            limit = np.iinfo(kind)
            whole = np.rint(np.nan_to_num(np.asarray(value) * factors[field]))
            made[field] = np.clip(whole, limit.min, limit.max).astype(kind)
        else:
            with np.errstate(over="ignore"):  # of what a broken sensor says: no smaller number has room for it
                made[field] = value
    return made


def _framed(name: str, own: Rows) -> Bytes:
    """Each row as a message (N, size)."""
    size = own.dtype.itemsize
    framed = np.empty((len(own), size + 3), np.uint8)
    framed[:, :3] = np.frombuffer(HEAD + bytes([NUMBERS[name]]), np.uint8)
    framed[:, 3:] = np.ascontiguousarray(own).view(np.uint8).reshape(len(own), size)
    return framed


def _head() -> bytes:
    """What the messages are, and the units of their fields."""
    lines = []
    for name, message in MESSAGES.items():
        own = name.encode(), message.letters.encode(), message.labels.encode()
        lines.append(("FMT", struct.pack("<BB4s16s64s", NUMBERS[name], _row(name).itemsize + 3, *own)))
    lines += [("UNIT", struct.pack("<Qb64s", 0, ord(key), label.encode())) for key, label in UNITS.items()]
    lines += [("MULT", struct.pack("<Qbd", 0, ord(key), factor)) for key, factor in FACTORS.items()]
    for name, message in MESSAGES.items():
        scales = message.units.encode(), message.factors.encode()
        lines.append(("FMTU", struct.pack("<QB16s16s", 0, NUMBERS[name], *scales)))
    return b"".join(HEAD + bytes([NUMBERS[name]]) + body for name, body in lines)


def _xyz(name: str, values: Array) -> dict[str, Array]:
    return {f"{name}{axis}": values[:, k] for k, axis in enumerate("XYZ")}


def _sensors(view: View) -> Iterator[tuple[str, Rows]]:
    for k, own in enumerate(view.sensors["imu"].values()):
        dt_s = own["dt"][:, None]
        values: dict[str, Any] = {"I": k, **_xyz("Gyr", own["dtheta"] / dt_s), **_xyz("Acc", own["dv"] / dt_s)}
        rate = np.rint(1 / np.median(own["dt"]))
        yield "IMU", _rows("IMU", stamps(own["time"]), **values, GH=1, AH=1, GHz=rate, AHz=rate)
    for k, own in enumerate(view.sensors["gnss"].values()):
        yield from _fixes(view, k, own)
    for k, own in enumerate(view.sensors["barometer"].values()):
        h, p = pressure_altitude(own["pressure"]), own["pressure"]
        values = {"I": k, "Alt": h - h[0], "AltAMSL": h, "Press": p, "CPress": p, "H": 1, "Offset": 0}
        values |= {"Temp": isa_temperature(h) - FREEZING, "SMS": stamps(own["time"]) // 1000}
        yield "BARO", _rows("BARO", stamps(own["t_arrival"]), **values)
    for k, own in enumerate(view.sensors["magnetometer"].values()):
        values = {"I": k, "Health": 1, "S": stamps(own["time"]), **_xyz("Mag", own["field_b"] / GAUSS * 1e3)}
        yield "MAG", _rows("MAG", stamps(own["t_arrival"]), **values)
    for k, own in enumerate(view.sensors["airspeed"].values()):
        pressure = 0.5 * SEA_LEVEL_DENSITY * own["eas"] ** 2
        values = {"I": k, "Airspeed": own["eas"], "DiffPress": pressure, "RawPress": pressure, "U": 1, "H": 1}
        yield "ARSP", _rows("ARSP", stamps(own["t_arrival"]), **values)


def _fixes(view: View, k: int, own: Columns) -> Iterator[tuple[str, Rows]]:
    fix, t, v = fixed(own), stamps(own["t_arrival"]), np.nan_to_num(own["v_n"])
    lat, lon, h = (carried(own[name], fix) for name in ("lat", "lon", "h"))
    seconds = (view.midnight - GPS_EPOCH).total_seconds() + LEAP_S + own["time"]
    values: dict[str, Any] = {"I": k, "Status": np.where(fix, FIX_3D, NONE), "GWk": seconds // WEEK_S, "U": int(k == 0)}
    values |= {"GMS": seconds % WEEK_S * 1e3, "NSats": own["satellites"], "HDop": own["hdop"]}
    values |= {"Lat": np.degrees(lat), "Lng": np.degrees(lon), "Alt": h, "Spd": np.hypot(v[:, 0], v[:, 1])}
    values |= {"GCrs": np.degrees(np.arctan2(v[:, 1], v[:, 0])) % 360, "VZ": v[:, 2]}
    yield "GPS", _rows("GPS", t, **values)
    sigma, sigma_v = own["sigma_position_n"], own["sigma_velocity_n"]
    values = {"I": k, "VDop": own["vdop"], "HAcc": np.hypot(sigma[:, 0], sigma[:, 1]), "VAcc": sigma[:, 2]}
    values |= {"SAcc": np.linalg.norm(sigma_v, axis=1), "YAcc": np.nan, "VV": fix, "SMS": stamps(own["time"]) // 1000}
    yield "GPA", _rows("GPA", t, **values, Delta=np.diff(t, prepend=t[:1]) // 1000)


def _solutions(view: View) -> Iterator[tuple[str, Rows]]:
    origin = view.origin()
    place = {"Lat": np.degrees(origin[0]), "Lng": np.degrees(origin[1]), "Alt": origin[2]}
    yield "ORGN", _rows("ORGN", stamps(np.zeros(1)), **place)
    truth, t = view.truth, stamps(view.truth["time"])
    values: dict[str, Any] = {**_angles(truth), **_place(truth)}
    values |= {f"Q{k + 1}": truth["q_nb"][:, k] for k in range(4)}
    yield "SIM", _rows("SIM", t, **values)[np.isfinite(truth["lat"])]
    for k, own in enumerate(view.estimators.values()):
        t, moved = stamps(own["time"]), _moved(own, *origin)
        values = {"C": k, **_angles(own), "OH": origin[2]}
        values |= {f"V{axis}": own["v_n"][:, j] for j, axis in enumerate("NED")}
        values |= {f"P{axis}": moved[:, j] for j, axis in enumerate("NED")}
        values |= _xyz("G", np.degrees(own["gyro_bias"]))
        yield "XKF1", _rows("XKF1", t, **values, dPD=own["v_n"][:, 2])
        if k == 0:
            unknown = dict.fromkeys(("DesRoll", "DesPitch", "DesYaw"), np.nan)
            yield "ATT", _rows("ATT", t, **_angles(own), **unknown, AEKF=3)
            known = np.isfinite(own["lat"])
            above = {"RelHomeAlt": own["h"] - origin[2], "RelOriginAlt": own["h"] - origin[2]}
            yield "POS", _rows("POS", t, **_place(own), **above)[known]


def _moved(own: Columns, lat: float, lon: float, h: float) -> Array:
    return position_difference_n(own["lat"], own["lon"], own["h"], np.array(lat), np.array(lon), np.array(h))


def _angles(own: Columns) -> dict[str, Array]:
    angles = np.degrees(euler(own["q_nb"]))
    return {"Roll": angles[:, 0], "Pitch": angles[:, 1], "Yaw": angles[:, 2] % 360}


def _place(own: Columns) -> dict[str, Array]:
    return {"Lat": np.degrees(own["lat"]), "Lng": np.degrees(own["lon"]), "Alt": own["h"]}
