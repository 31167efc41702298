"""What each message on the vehicle and its sensors says: one function per message, from a snapshot to its fields;
of those that go out often from `Rows`, to columns of them.

A function returns None when what its message is about is not known; a single unknown number is NaN, and the encoder
turns it into the field's own "unknown". Heights are above the WGS84 ellipsoid, also where MAVLink says mean sea level:
the testbed has no geoid.
Source of the fields' meaning and units: https://mavlink.io/en/messages/all.html
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from pymavlink.dialects.v20 import all as mav  # type: ignore[import-untyped]

from nav.earth import SEA_LEVEL_DENSITY
from nav.samples import (
    AirspeedSample,
    BarometerSample,
    GnssSample,
    MagnetometerSample,
    Sample,
)
from testbed.mavlink.encode import Fields, centidegrees, latitude_e7, longitude_e7, microseconds
from testbed.mavlink.identity import Identity
from testbed.mavlink.snapshot import Rows, Snapshot, floats, root
from testbed.motion.table import CLIMBING_OUT

# The vehicle


def heartbeat_of(s: Snapshot) -> Fields:
    """HEARTBEAT of a snapshot."""
    return heartbeat(s, s.identity)


def heartbeat(s: Snapshot | None, identity: Identity) -> Fields:
    """Fixed wing, on its own; armed when flying; calibrating until the estimator is aligned, and before the run."""
    mode = mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mav.MAV_MODE_FLAG_AUTO_ENABLED | mav.MAV_MODE_FLAG_STABILIZE_ENABLED
    flying = s is not None and s.flying
    if s is None or not s.aligned:
        state = mav.MAV_STATE_CALIBRATING
    else:
        state = mav.MAV_STATE_ACTIVE if flying else mav.MAV_STATE_STANDBY
    return {
        "type": mav.MAV_TYPE_FIXED_WING,
        "autopilot": identity.autopilot,
        "base_mode": mode | (mav.MAV_MODE_FLAG_SAFETY_ARMED if flying else 0),
        "custom_mode": identity.mode,
        "system_status": state,
        "mavlink_version": 3,
    }


def system_time(s: Snapshot) -> Fields:
    """Simulated date and time of day, and time since boot."""
    return {"time_unix_usec": s.start_us + s.usec, "time_boot_ms": s.boot_ms}


_INERTIAL: int = mav.MAV_SYS_STATUS_SENSOR_3D_GYRO | mav.MAV_SYS_STATUS_SENSOR_3D_ACCEL
_ALIGNED: int = mav.MAV_SYS_STATUS_AHRS | mav.MAV_SYS_STATUS_PREARM_CHECK
_ALWAYS: int = mav.MAV_SYS_STATUS_GEOFENCE  # without it MAVProxy reports a breach
_AIDS: Mapping[type[Sample], int] = {
    MagnetometerSample: mav.MAV_SYS_STATUS_SENSOR_3D_MAG,
    BarometerSample: mav.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE,
    AirspeedSample: mav.MAV_SYS_STATUS_SENSOR_DIFFERENTIAL_PRESSURE,
    GnssSample: mav.MAV_SYS_STATUS_SENSOR_GPS,
}


def health(s: Snapshot) -> int:
    """Which sensors work, in the bits of SYS_STATUS.

    Failed are those that are silent, or that the estimator does not believe, and a receiver without a fix.
    """
    bits = _ALWAYS
    if s.inertial:
        bits |= _INERTIAL
    if s.aligned:
        bits |= _ALIGNED
    if s.works(MagnetometerSample):
        bits |= _AIDS[MagnetometerSample]
    if s.works(BarometerSample) and math.isfinite(s.pressure):
        bits |= _AIDS[BarometerSample]
    if s.works(AirspeedSample) and math.isfinite(s.eas):
        bits |= _AIDS[AirspeedSample]
    if s.works(GnssSample) and s.gnss_fix is not None:
        bits |= _AIDS[GnssSample]
    return bits


def sys_status(s: Snapshot) -> Fields:
    """Which sensors there are and which of them work."""
    present = _ALWAYS | _INERTIAL | _ALIGNED
    for kind, bit in _AIDS.items():
        present |= bit if s.knows(kind) else 0
    return {
        "onboard_control_sensors_present": present,
        "onboard_control_sensors_enabled": present,
        "onboard_control_sensors_health": health(s),
        "load": 0,
        "voltage_battery": 2**16 - 1,  # not sent, nor the two below
        "current_battery": -1,
        "battery_remaining": -1,
        "drop_rate_comm": 0,
        "errors_comm": 0,
        "errors_count1": 0,
        "errors_count2": 0,
        "errors_count3": 0,
        "errors_count4": 0,
        "onboard_control_sensors_present_extended": 0,
        "onboard_control_sensors_enabled_extended": 0,
        "onboard_control_sensors_health_extended": 0,
    }


def extended_sys_state(s: Snapshot) -> Fields:
    """On the ground or in the air."""
    landed = {
        None: mav.MAV_LANDED_STATE_UNDEFINED,
        False: mav.MAV_LANDED_STATE_ON_GROUND,
        True: mav.MAV_LANDED_STATE_IN_AIR,
    }
    return {"vtol_state": mav.MAV_VTOL_STATE_UNDEFINED, "landed_state": landed[s.flying]}


def current_item(s: Snapshot) -> int:
    """The mission item being flown: that of the leg; the first before it, the last one when the plan is flown."""
    first = int(s.identity.home_first)
    if s.leg <= CLIMBING_OUT:
        return first
    return first + (int(s.leg) if 0 <= s.leg < s.legs else max(0, s.legs - 1))


def mission_current(s: Snapshot) -> Fields:
    """The leg being flown, as an item of the mission."""
    if not s.legs:
        state = mav.MISSION_STATE_NO_MISSION
    elif s.leg <= CLIMBING_OUT:
        state = mav.MISSION_STATE_NOT_STARTED
    else:
        state = mav.MISSION_STATE_ACTIVE if s.leg >= 0 else mav.MISSION_STATE_COMPLETE
    return {
        "seq": current_item(s) if s.legs else 0,
        "total": s.legs,
        "mission_state": state,
        "mission_mode": 0,  # unknown: there is but one mode
        "mission_id": 0,
        "fence_id": 0,
        "rally_points_id": 0,
    }


def home_position(s: Snapshot) -> Fields | None:
    """Where the estimator first knew its position."""
    if s.home is None:
        return None
    lat, lon, h = s.home
    return {
        "latitude": latitude_e7(lat),
        "longitude": longitude_e7(lon),
        "altitude": h * 1e3,
        "x": 0,
        "y": 0,
        "z": 0,
        "q": [1.0, 0.0, 0.0, 0.0],
        "approach_x": 0,
        "approach_y": 0,
        "approach_z": 0,
        "time_usec": s.usec,
    }


# Receiver and sensors


def gps_raw_int(s: Snapshot) -> Fields | None:
    """What the receiver says: no fix and nothing known when it is denied."""
    if not s.knows(GnssSample):
        return None
    fix = s.gnss_fix
    if fix is None:
        sample = s.newest(GnssSample)
        return {
            "time_usec": microseconds(sample.t) if sample else s.usec,
            "fix_type": mav.GPS_FIX_TYPE_NO_FIX,
            **dict.fromkeys(("lat", "lon", "alt", "eph", "epv", "vel", "cog", "alt_ellipsoid"), math.nan),
            "satellites_visible": _satellites(sample) if sample else math.nan,
            **dict.fromkeys(("h_acc", "v_acc", "vel_acc"), math.nan),
            "hdg_acc": 0,
            "yaw": 0,
        }
    north, east, _ = floats(fix.v_n)
    variance = fix.sigma_position_n * fix.sigma_position_n
    return {
        "time_usec": microseconds(fix.t),
        "fix_type": fix.fix_type,
        "lat": latitude_e7(fix.lat),
        "lon": longitude_e7(fix.lon),
        "alt": fix.h * 1e3,
        "eph": fix.hdop * 100,
        "epv": fix.vdop * 100,
        "vel": math.hypot(north, east) * 100,
        "cog": centidegrees(math.atan2(east, north)),
        "satellites_visible": _satellites(fix),
        "alt_ellipsoid": fix.h * 1e3,
        "h_acc": root(variance[:2]) * 1e3,
        "v_acc": root(variance[2:]) * 1e3,
        "vel_acc": root(fix.sigma_velocity_n * fix.sigma_velocity_n) * 1e3,
        "hdg_acc": 0,
        "yaw": 0,  # not measured
    }


def _satellites(sample: GnssSample) -> float:
    """How many, NaN where a log does not say."""
    return sample.satellites if sample.satellites >= 0 else math.nan


def gnss_integrity(s: Snapshot) -> Fields | None:
    """Jamming is reported while there is no fix, as nothing but interference takes it away in this testbed.

    Spoofing is reported while the estimator does not believe a receiver that has one.
    """
    if not s.knows(GnssSample):
        return None
    spoofing = mav.GPS_SPOOFING_STATE_UNKNOWN
    if s.gnss_fix:
        spoofing = mav.GPS_SPOOFING_STATE_DETECTED if s.doubted else mav.GPS_SPOOFING_STATE_NOT_SPOOFED
    return {
        "id": 0,
        "system_errors": 0,
        "authentication_state": mav.GPS_AUTHENTICATION_STATE_UNKNOWN,
        "jamming_state": mav.GPS_JAMMING_STATE_NOT_JAMMED if s.gnss_fix else mav.GPS_JAMMING_STATE_DETECTED,
        "spoofing_state": spoofing,
        "raim_state": mav.GPS_RAIM_STATE_UNKNOWN,
        "raim_hfom": 2**16 - 1,
        "raim_vfom": 2**16 - 1,
        "corrections_quality": 255,
        "system_status_summary": 255,
        "gnss_signal_quality": 255,
        "post_processing_quality": 255,
    }


_READINGS = (
    *("xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro", "xmag", "ymag", "zmag"),
    *("abs_pressure", "diff_pressure", "pressure_alt", "temperature"),
)


def highres_imu(r: Rows) -> Fields:
    """Inertial, magnetic and pressure readings; the bits say which of them there are."""
    columns = (
        *r.accel.T,
        *r.gyro.T,
        *(r.field_b * 1e4).T,
        r.pressure / 100,
        0.5 * SEA_LEVEL_DENSITY * r.eas * r.eas / 100,
        r.pressure_altitude,
        np.full(len(r), math.nan),
    )
    updated = sum((column == column).astype(float) * 2**bit for bit, column in enumerate(columns))
    return {"time_usec": r.usec, **dict(zip(_READINGS, columns, strict=True)), "fields_updated": updated, "id": 0}


def scaled_pressure(s: Snapshot) -> Fields | None:
    """Static and differential pressure."""
    if s.pressure != s.pressure:
        return None
    return {
        "time_boot_ms": s.boot_ms,
        "press_abs": s.pressure / 100,
        "press_diff": 0.5 * SEA_LEVEL_DENSITY * s.eas * s.eas / 100,
        "temperature": 0,
        "temperature_press_diff": 0,
    }


# Events

_SEVERITY = {"info": mav.MAV_SEVERITY_INFO, "warning": mav.MAV_SEVERITY_WARNING, "error": mav.MAV_SEVERITY_ERROR}
_CHUNK = 50  # bytes of text in one STATUSTEXT
_MAX_CHUNKS = 255


def statustext(severity: str, text: str, number: int) -> list[Fields]:
    """STATUSTEXT fields of one event, in chunks when it is longer than 50 bytes.

    ``number`` tells the chunks of one long text from another's; a text of one chunk has none. The last chunk of several
    must hold a zero byte, so a text that ends at the edge of a chunk is followed by an empty one.
    """
    encoded = text.replace("\0", " ").encode(errors="replace")[: _CHUNK * _MAX_CHUNKS]
    end = len(encoded) + 1 if len(encoded) > _CHUNK else _CHUNK
    chunked = len(encoded) > _CHUNK
    return [
        {
            "severity": _SEVERITY[severity],
            "text": encoded[start : start + _CHUNK],
            "id": 1 + number % (2**16 - 1) if chunked else 0,
            "chunk_seq": start // _CHUNK,
        }
        for start in range(0, end, _CHUNK)
    ]
