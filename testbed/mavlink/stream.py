"""What goes out when: a vehicle's messages and their rates, counted in simulated time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import all as mav  # type: ignore[import-untyped]

from testbed.mavlink import estimates, messages
from testbed.mavlink.encode import Fields, layout
from testbed.mavlink.snapshot import Rows, Snapshot

PUBLISH_HZ = 25
OTHERS_HZ = 5  # of the estimators beside the shown one

_RAW = mav.MAV_DATA_STREAM_RAW_SENSORS
_STATUS = mav.MAV_DATA_STREAM_EXTENDED_STATUS
_POSITION = mav.MAV_DATA_STREAM_POSITION
_ATTITUDE = mav.MAV_DATA_STREAM_EXTRA1
_HUD = mav.MAV_DATA_STREAM_EXTRA2
_REST = mav.MAV_DATA_STREAM_EXTRA3


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """A message, its mean rate [Hz], the function that fills it, and the group that it is in for ArduPilot's stations.

    Group 0 is in none. ``needs`` are the attributes of `Rows` without which there is nothing to say; the function is
    then one of rows. Without ``needs`` it is one of a `Snapshot`, and says itself when there is nothing.
    """

    message: str
    rate_hz: float
    fields: Callable[[Snapshot], Fields | None] | Callable[[Rows], Fields]
    group: int = 0
    needs: Sequence[str] | None = None

    def payloads(self, rows: Rows) -> Payloads:
        """What it says of those rows of which there is something to say."""
        own = layout(self.message)
        if self.needs is None:
            said = [self.fields(one) for one in rows.snapshots]  # type: ignore[arg-type]
            found = {k: own.payload(fields) for k, fields in enumerate(said) if fields is not None}
            sizes = np.array([len(one) for one in found.values()], int)
            return Payloads(np.array([*found], int), sizes, np.frombuffer(b"".join(found.values()), np.uint8))
        told = np.ones(len(rows), bool)
        for need in self.needs:
            told &= np.isfinite(getattr(rows, need)).all(axis=1)
        payloads = own.payloads(self.fields(rows), len(rows))[told]  # type: ignore[arg-type]
        return Payloads(np.flatnonzero(told), np.full(len(payloads), payloads.shape[1]), payloads.reshape(-1))

    def payload(self, snapshot: Snapshot) -> bytes | None:
        """What it says of one instant, None when there is nothing to say."""
        fields = self.fields(snapshot) if self.needs is None else self._of_one(snapshot.alone)  # type: ignore[arg-type]
        return None if fields is None else layout(self.message).payload(fields)

    def _of_one(self, row: Rows) -> Fields | None:
        """The fields of a single row as plain numbers, whose way into bytes is far shorter than that of columns."""
        known = (value for need in self.needs or () for value in getattr(row, need)[0].tolist())
        if not all(map(math.isfinite, known)):
            return None
        fields = self.fields(row)  # type: ignore[arg-type]
        assert fields is not None
        return {name: value[0].tolist() if isinstance(value, np.ndarray) else value for name, value in fields.items()}


@dataclass(frozen=True, slots=True)
class Payloads:
    """Fields of one message as bytes: ``rows`` (N,) that say something, their ``sizes`` (N,), all bytes in a row."""

    rows: NDArray[np.intp]
    sizes: NDArray[np.intp]
    data: NDArray[np.uint8]


STREAMS = (
    Stream("HEARTBEAT", 1, messages.heartbeat_of),
    Stream("SYSTEM_TIME", 1, messages.system_time, _REST),
    Stream("SYS_STATUS", 2, messages.sys_status, _STATUS),
    Stream("EXTENDED_SYS_STATE", 1, messages.extended_sys_state, _STATUS),
    Stream("MISSION_CURRENT", 1, messages.mission_current, _STATUS),
    Stream("HOME_POSITION", 0.5, messages.home_position),
    Stream("ATTITUDE", 25, estimates.attitude, _ATTITUDE, needs=("euler",)),
    Stream("ATTITUDE_QUATERNION", 10, estimates.attitude_quaternion, _ATTITUDE, needs=("euler",)),
    Stream("GLOBAL_POSITION_INT", 10, estimates.global_position_int, _POSITION, needs=("point", "local_n")),
    Stream("LOCAL_POSITION_NED", 10, estimates.local_position_ned, _POSITION, needs=("local_n",)),
    Stream("VFR_HUD", 5, estimates.vfr_hud, _HUD, needs=("point", "euler")),
    Stream("ODOMETRY", 5, estimates.odometry, _POSITION, needs=("local_n", "euler")),
    Stream("ALTITUDE", 2, estimates.altitude, _POSITION, needs=("local_n",)),
    Stream("WIND_COV", 1, estimates.wind_cov, _REST),
    Stream("ESTIMATOR_STATUS", 2, estimates.estimator_status, _REST),
    Stream("EKF_STATUS_REPORT", 1, estimates.ekf_status_report, _REST),
    Stream("GPS_RAW_INT", 5, messages.gps_raw_int, _STATUS),
    Stream("GNSS_INTEGRITY", 1, messages.gnss_integrity, _STATUS),
    Stream("HIGHRES_IMU", 10, messages.highres_imu, _RAW, needs=()),
    Stream("SCALED_PRESSURE", 1, messages.scaled_pressure, _RAW),
    Stream("HIL_STATE_QUATERNION", 10, estimates.hil_state_quaternion, _ATTITUDE, needs=("true_point",)),
    Stream("SIMSTATE", 5, estimates.simstate, _ATTITUDE, needs=("true_point",)),
    Stream("SIM_STATE", 1, estimates.sim_state, _ATTITUDE, needs=("true_point",)),
    Stream("AHRS2", OTHERS_HZ, estimates.ahrs2, _ATTITUDE, needs=("second",)),
    Stream("AHRS3", OTHERS_HZ, estimates.ahrs3, _ATTITUDE, needs=("third",)),
    *(
        Stream("NAMED_VALUE_FLOAT", 1, partial(estimates.error, f"{kind}_{error}"), _REST, needs)
        for error, needs in (
            *((motion, ("euler", "point")) for motion in ("horiz", "down", "vel")),
            *((attitude, ("euler",)) for attitude in ("tilt", "head")),
        )
        for kind in ("err", "sig")
    ),
)

_VEHICLE = (
    "HEARTBEAT",
    "SYS_STATUS",
    "HOME_POSITION",
    "ATTITUDE",
    "GLOBAL_POSITION_INT",
    "LOCAL_POSITION_NED",
    "VFR_HUD",
)
# What truth or another estimator says as a vehicle of its own, and what the first one says then.
VEHICLE_STREAMS = tuple(replace(one, rate_hz=min(one.rate_hz, 10)) for one in STREAMS if one.message in _VEHICLE)
BESIDE_VEHICLES = tuple(one for one in STREAMS if not one.message.startswith("AHRS"))


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Streams of one rate, each after its place among all."""

    streams: Sequence[tuple[int, Stream]]


class Schedule:
    """Which of some streams are due at each call."""

    def __init__(self, streams: Sequence[Stream]) -> None:
        self._streams = streams
        by_rate: dict[float, list[tuple[int, Stream]]] = {}
        for place, one in enumerate(streams):
            by_rate.setdefault(one.rate_hz, []).append((place, one))
        self._groups = {rate: Group(group) for rate, group in by_rate.items()}
        # The usual rates repeat after two seconds: the slowest message is sent every two seconds.
        self._pattern = [self._due(call, {}) for call in range(2 * PUBLISH_HZ)]

    def usual(self, calls: NDArray[np.int64]) -> list[tuple[NDArray[np.intp], Group]]:
        """Of calls (N,) those at which streams are due at their usual rates, for each rate."""
        return [(np.flatnonzero(calls * rate % PUBLISH_HZ < rate), group) for rate, group in self._groups.items()]

    def due(self, call: int, rates: Mapping[str, float]) -> Sequence[Stream]:
        """The streams due at a call, where ``rates`` [Hz] replace the usual ones by message."""
        return self._due(call, rates) if rates else self._pattern[call % len(self._pattern)]

    def _due(self, call: int, rates: Mapping[str, float]) -> list[Stream]:
        return [
            one for one in self._streams if call * (rate := rates.get(one.message, one.rate_hz)) % PUBLISH_HZ < rate
        ]
