"""A line for the shell of a vehicle that has one, over MAVLink, as PX4 does.

Source: MAVLink common message SERIAL_CONTROL; PX4-Autopilot 1.16, src/modules/mavlink/mavlink_receiver.cpp.
"""

from __future__ import annotations

from pymavlink.dialects.v20 import all as dialect  # type: ignore[import-untyped]

from testbed.mavlink.encode import Encoder

LONGEST = 70  # bytes


def typed(encoder: Encoder, system: int, line: str) -> bytes:
    """The frame that types a ``line``, of less than `LONGEST` characters, for the autopilot of a ``system``."""
    data = f"{line}\n".encode("ascii")
    return encoder.frame(
        "SERIAL_CONTROL",
        {
            "device": dialect.SERIAL_CONTROL_DEV_SHELL,
            "flags": dialect.SERIAL_CONTROL_FLAG_RESPOND,  # without it the shell is closed before it has begun
            "timeout": 0,
            "baudrate": 0,
            "count": len(data),
            "data": data.ljust(LONGEST, b"\0"),
            "target_system": system,
            "target_component": dialect.MAV_COMP_ID_AUTOPILOT1,
        },
    )
