"""A made-up flight for the MAVLink side: rows, estimates and samples, and what pymavlink reads of them."""

import math
import sys

import numpy as np
import pymap3d
from pymavlink.dialects.v20 import all as mav
from scipy.spatial.transform import Rotation

from nav.samples import (
    AirspeedSample,
    BarometerSample,
    Estimate,
    FixType,
    GnssSample,
    ImuSamples,
    MagnetometerSample,
    Status,
)
from testbed import Scenario
from testbed.motion.table import TruthBlock
from worlds.loop import one_row

SCENARIO = Scenario.load("u_turn", ["date=2026-06-01"])
MIDNIGHT_US = 1_780_272_000_000_000  # 2026-06-01T00:00Z
LAT, LON, H = math.radians(-33.9), math.radians(179.999), 800.0
G = 9.80665


def attitude(t):
    """Rotation body to NED: yaws through north, rolls, pitches."""
    return Rotation.from_euler("ZYX", [300 + 20 * t, 10 * math.sin(t), 30 * math.sin(0.5 * t)], degrees=True)


def quaternion(rotation):
    x, y, z, w = rotation.as_quat()
    return np.array([w, x, y, z])


def position(t):
    """Eastwards across the date line, climbing; by an independent library."""
    lat, lon, h = pymap3d.ned2geodetic(3 * t, 30 * t, -2 * t, math.degrees(LAT), math.degrees(LON), H)
    return math.radians(lat), math.radians(lon), h


def velocity(t):
    return np.array([3.0, 30.0, -2.0])


def estimate(t, status=Status.ALIGNED | Status.GNSS_FUSED, *, offset_h=0.0, covariance=None):
    known = Status.ALIGNED in status
    lat, lon, h = position(t) if known else (math.nan,) * 3
    nan3 = np.full(3, math.nan)
    return Estimate(
        t=t,
        lat=lat,
        lon=lon,
        h=h + offset_h,
        v_n=velocity(t) if known else nan3,
        q_nb=quaternion(attitude(t)) if known else np.full(4, math.nan),
        gyro_bias=np.array([0.01, 0.02, 0.03]) if known else nan3,
        accel_bias=np.zeros(3) if known else nan3,
        covariance=np.diag([9.0, 16, 4, 1, 1, 1, 1e-4, 1e-4, 1e-3]) if covariance is None else covariance,
        sigma_gyro_bias=np.full(3, 1e-3),
        sigma_accel_bias=np.full(3, 1e-2),
        status=status,
        extra={"wind": (np.array([4.0, -3.0]), np.array([0.3, 0.4]))} if known else {},
    )


def truth_row(t):
    row = TruthBlock.empty(round(t * 200), 1)
    row.t[0] = t
    row.lat[0], row.lon[0], row.h[0] = position(t)
    row.v_n[0] = velocity(t)
    row.q_nb[0] = quaternion(attitude(t))
    row.omega_b[0] = [0.1, 0.2, 0.3]
    row.dv[0] = np.array([1.0, 2.0, -50 * G]) / 200  # far over what the message holds: saturates
    row.airspeed[0] = 27.0
    row.density[0] = 1.225 / 4
    row.controls[0, 3] = 0.6
    return row


def samples_at(t, *, fix=True):
    nan3 = np.full(3, math.nan)
    lat, lon, h = position(t) if fix else (math.nan,) * 3
    gnss = GnssSample(
        t=t,
        t_arrival=t,
        lat=lat,
        lon=lon,
        h=h,
        v_n=np.array([-3.0, -4.0, 1.0]) if fix else nan3,
        sigma_position_n=np.array([3.0, 4.0, 6.0]) if fix else nan3,
        sigma_velocity_n=np.array([0.1, 0.2, 0.2]) if fix else nan3,
        fix_type=FixType.FIX_3D if fix else FixType.NO_FIX,
        satellites=14 if fix else 0,
        hdop=0.8 if fix else math.nan,
        vdop=1.25 if fix else math.nan,
    )
    others = [
        BarometerSample(t, t, 90000.0),
        MagnetometerSample(t, t, np.array([2e-5, 1e-5, -5e-5])),
        AirspeedSample(t, t, 20.0),
    ]
    return {sample.sensor: sample for sample in [gnss, *others]}


def increments(t):
    """A second of increments at 200 Hz around ``t``; the one that ends at ``t`` has its own numbers."""
    times = t + np.arange(-100, 100) / 200
    dtheta = np.full((200, 3), 99.0)
    dv = np.full((200, 3), 99.0)
    dtheta[100], dv[100] = np.array([0.11, 0.22, 0.33]) / 200, np.array([0.5, -0.5, -9.8]) / 200
    return ImuSamples(times, np.full(200, 1 / 200), dtheta, dv)


def publish(publisher, calls, **changes):
    for k in calls:
        publisher.requests()
        publisher.publish(row_at(k, **changes))


def row_at(k, **changes):
    """A row of the flight at 25 Hz; ``changes`` replace what it holds by functions of time."""
    t = k * 0.04
    arguments = {"truth": truth_row, "estimate": estimate, "samples": samples_at, "imu": increments} | changes
    return one_row(**{name: made(t) for name, made in arguments.items()})


def read_log(path):
    """(time_us, message) of a telemetry log, by pymavlink's decoder."""
    parser = mav.MAVLink(None)
    data = path.read_bytes()
    out = []
    at = 0
    while at < len(data):
        size = data[at + 9] + 12
        message = parser.decode(bytearray(data[at + 8 : at + 8 + size]))
        out.append((int.from_bytes(data[at : at + 8], "big"), message))
        at += 8 + size
    return out


class Calls:
    """Counts calls of Python functions in a ``with`` block: what work costs on any machine, however busy."""

    def __init__(self):
        self.count = 0

    def _seen(self, frame, event, argument):
        self.count += event == "call"

    def __enter__(self):
        sys.setprofile(self._seen)
        return self

    def __exit__(self, *_):
        sys.setprofile(None)
