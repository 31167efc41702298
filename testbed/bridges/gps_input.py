"""Our fixes for ArduPilot, over its MAVLink as GPS_INPUT: its JSON backend takes none.

ArduPilot uses them where GPS1_TYPE is 14 (GPS2_TYPE for a second receiver). Each epoch goes out at the step at which
it arrives, with the time at which it was true: denials, faults and latency are those of the scenario. Without a fix
there is only that there is none. Receivers are numbered as the scenario has them; ArduPilot takes `MOST_RECEIVERS`.
Heights are above the ellipsoid, in the place of those above the sea's level, as the positions that ArduPilot is told.

Sources: MAVLink common message GPS_INPUT; AP_GPS_MAV.cpp of ArduPilot 4.6. A component other than the autopilot's own
speaks, as that does not take what comes from itself for news.
"""

from __future__ import annotations

import datetime as dt
import math
import time
from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from nav.samples import GnssSample
from testbed.bridges.steps import Step
from testbed.errors import UserError
from testbed.mavlink.encode import Encoder, Fields, latitude_e7, longitude_e7, microseconds
from testbed.mavlink.link import Link, TelemetryLog, connect, log_path, resolve
from testbed.mavlink.receive import Reader
from testbed.sensors.gnss import GPS_EPOCH, LEAP_S, WEEK_S

DEFAULT = "udpin:127.0.0.1:14551"  # where sim_vehicle.py speaks to beside the ground station's 14550
SYSTEM, COMPONENT = 1, 220  # MAV_COMP_ID_GPS
MOST_RECEIVERS = 2
CONNECT_S = 120.0  # of wall time
READ = 65536
# What is passed over where it is unknown: GPS_INPUT_IGNORE_FLAGS.
IGNORED = {
    "alt": 1, "hdop": 2, "vdop": 4, "vn": 8, "ve": 8, "vd": 16,
    "speed_accuracy": 32, "horiz_accuracy": 64, "vert_accuracy": 128,
}  # fmt: skip


class GpsInput:
    """A link to ArduPilot's MAVLink (see `testbed.mavlink.link`); ``failure`` is why it is none, empty if it is.

    What is due before ArduPilot is there is lost.
    """

    def __init__(self, url: str, receivers: Sequence[str], date: dt.date, *, connect_s: float = CONNECT_S) -> None:
        """Open ``url``; the run starts at midnight UTC of the ``date``. A ``tcp`` one may begin to listen later.

        Raises UserError when the address is none, or can't be had.
        """
        self.failure = ""
        self._url, self._connect_s = url, connect_s
        self._numbers = {name: number for number, name in enumerate(receivers[:MOST_RECEIVERS])}
        self._start = dt.datetime.combine(date, dt.time(), dt.UTC)
        self._encoder = Encoder(SYSTEM, COMPONENT)
        self._link: Link | None = None
        if log_path(url) is not None:
            raise UserError(f"{url}: nobody reads a log while it is written: give an address, such as {DEFAULT}")
        if url.startswith("tcp:"):
            resolve(url, url.removeprefix("tcp:"))
            with suppress(UserError):  # nobody listens yet
                self._open()
        else:
            self._open()
        self._until: float | None = None  # of wall time

    def tell(self, step: Step) -> None:
        """Send the epochs that have arrived by a step."""
        epochs = [one for one in step.arrived.values() if isinstance(one, GnssSample) and one.sensor in self._numbers]
        if not epochs or not self._there():
            return
        assert self._link is not None
        frames = [self._encoder.frame("GPS_INPUT", self._fields(one)) for one in epochs]
        for station in self._link.stations:
            station.send(frames)

    def close(self) -> None:
        """Close the link."""
        if self._link is not None:
            self._link.close()

    def _open(self) -> None:
        link = connect(self._url)
        assert not isinstance(link, TelemetryLog)
        self._link = link

    def _there(self) -> bool:
        """Whether ArduPilot is; what it says is read away."""
        self._until = self._until or time.monotonic() + self._connect_s
        if self._link is None:
            with suppress(UserError):  # nobody listens yet
                self._open()
        if self._link is not None:
            for station, data in self._link.receive(READ):
                if any(Reader().read(data, station.datagrams)):
                    station.admit()
            if self._link.stations:
                self._until = time.monotonic() + self._connect_s
                return True
        if time.monotonic() > self._until:
            self.failure = f"{self._url}: no MAVLink of ArduPilot there for {self._connect_s:g} s, to take GPS_INPUT"
        return False

    def _fields(self, sample: GnssSample) -> Fields:
        """GPS_INPUT of one epoch."""
        start_us = round(self._start.timestamp()) * 10**6
        gps_ms = round(((self._start - GPS_EPOCH).total_seconds() + LEAP_S + sample.t) * 1e3)
        week, week_ms = divmod(gps_ms, 1000 * WEEK_S)
        position, velocity = sample.sigma_position_n, sample.sigma_velocity_n
        numbers = {
            "alt": sample.h,
            "hdop": sample.hdop,
            "vdop": sample.vdop,
            **dict(zip(("vn", "ve", "vd"), sample.v_n.tolist(), strict=True)),
            "speed_accuracy": float(np.linalg.norm(velocity)),
            "horiz_accuracy": math.hypot(position[0], position[1]),
            "vert_accuracy": float(position[2]),
        }
        known = {name: value for name, value in numbers.items() if sample.has_fix and math.isfinite(value)}
        return {
            "time_usec": start_us + microseconds(sample.t),
            "gps_id": self._numbers[sample.sensor],
            "ignore_flags": sum({flag for name, flag in IGNORED.items() if name not in known}),
            "time_week_ms": week_ms,
            "time_week": week,
            "fix_type": int(sample.fix_type),
            "lat": latitude_e7(sample.lat) if sample.has_fix else 0,
            "lon": longitude_e7(sample.lon) if sample.has_fix else 0,
            **{name: known.get(name, 0.0) for name in IGNORED},
            "satellites_visible": sample.satellites,
            "yaw": 0,  # not measured
        }
