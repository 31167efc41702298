"""What goes out when: a vehicle's messages and their rates, counted in simulated time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from pymavlink.dialects.v20 import all as mav  # type: ignore[import-untyped]

from testbed.mavlink import estimates, messages
from testbed.mavlink.encode import Fields
from testbed.mavlink.snapshot import Snapshot

PUBLISH_HZ = 25
OTHERS_HZ = 5  # of the estimators beside the shown one

_RAW = mav.MAV_DATA_STREAM_RAW_SENSORS
_STATUS = mav.MAV_DATA_STREAM_EXTENDED_STATUS
_POSITION = mav.MAV_DATA_STREAM_POSITION
_ATTITUDE = mav.MAV_DATA_STREAM_EXTRA1
_HUD = mav.MAV_DATA_STREAM_EXTRA2
_REST = mav.MAV_DATA_STREAM_EXTRA3


@dataclass(frozen=True, slots=True)
class Stream:
    """A message, its mean rate [Hz], the function that fills it, and the group that it is in for ArduPilot's stations.

    Group 0 is in none.
    """

    message: str
    rate_hz: float
    fields: Callable[[Snapshot], Fields | None]
    group: int = 0


STREAMS = (
    Stream("HEARTBEAT", 1, messages.heartbeat_of),
    Stream("SYSTEM_TIME", 1, messages.system_time, _REST),
    Stream("SYS_STATUS", 2, messages.sys_status, _STATUS),
    Stream("EXTENDED_SYS_STATE", 1, messages.extended_sys_state, _STATUS),
    Stream("MISSION_CURRENT", 1, messages.mission_current, _STATUS),
    Stream("HOME_POSITION", 0.5, messages.home_position),
    Stream("ATTITUDE", 25, estimates.attitude, _ATTITUDE),
    Stream("ATTITUDE_QUATERNION", 10, estimates.attitude_quaternion, _ATTITUDE),
    Stream("GLOBAL_POSITION_INT", 10, estimates.global_position_int, _POSITION),
    Stream("LOCAL_POSITION_NED", 10, estimates.local_position_ned, _POSITION),
    Stream("VFR_HUD", 5, estimates.vfr_hud, _HUD),
    Stream("ODOMETRY", 5, estimates.odometry, _POSITION),
    Stream("ALTITUDE", 2, estimates.altitude, _POSITION),
    Stream("WIND_COV", 1, estimates.wind_cov, _REST),
    Stream("ESTIMATOR_STATUS", 2, estimates.estimator_status, _REST),
    Stream("EKF_STATUS_REPORT", 1, estimates.ekf_status_report, _REST),
    Stream("GPS_RAW_INT", 5, messages.gps_raw_int, _STATUS),
    Stream("GNSS_INTEGRITY", 1, messages.gnss_integrity, _STATUS),
    Stream("HIGHRES_IMU", 10, messages.highres_imu, _RAW),
    Stream("SCALED_PRESSURE", 1, messages.scaled_pressure, _RAW),
    Stream("HIL_STATE_QUATERNION", 10, estimates.hil_state_quaternion, _ATTITUDE),
    Stream("SIMSTATE", 5, estimates.simstate, _ATTITUDE),
    Stream("SIM_STATE", 1, estimates.sim_state, _ATTITUDE),
    Stream("AHRS2", OTHERS_HZ, estimates.ahrs2, _ATTITUDE),
    Stream("AHRS3", OTHERS_HZ, estimates.ahrs3, _ATTITUDE),
    *(
        Stream("NAMED_VALUE_FLOAT", 1, partial(estimates.error, name), _REST)
        for name in (f"{kind}_{error}" for error in ("horiz", "down", "vel", "tilt", "head") for kind in ("err", "sig"))
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
VEHICLE_STREAMS = tuple(
    Stream(one.message, min(one.rate_hz, 10), one.fields, one.group) for one in STREAMS if one.message in _VEHICLE
)
BESIDE_VEHICLES = tuple(one for one in STREAMS if not one.message.startswith("AHRS"))


class Schedule:
    """Which of some streams are due at each call."""

    def __init__(self, streams: Sequence[Stream]) -> None:
        self._streams = streams
        # The usual rates repeat after two seconds: the slowest message is sent every two seconds.
        self._pattern = [self._due(call, {}) for call in range(2 * PUBLISH_HZ)]

    def due(self, call: int, rates: Mapping[str, float]) -> Sequence[Stream]:
        """The streams due at a call, where ``rates`` [Hz] replace the usual ones by message."""
        return self._due(call, rates) if rates else self._pattern[call % len(self._pattern)]

    def _due(self, call: int, rates: Mapping[str, float]) -> list[Stream]:
        return [
            one for one in self._streams if call * (rate := rates.get(one.message, one.rate_hz)) % PUBLISH_HZ < rate
        ]
