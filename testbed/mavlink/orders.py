"""What is asked of an autopilot over MAVLink: what to say, to be armed, a line for its shell where it has one.

Sources: MAVLink common messages SERIAL_CONTROL, COMMAND_LONG; PX4-Autopilot 1.16, src/modules/mavlink/
mavlink_receiver.cpp; ArduPilot 4.6, libraries/GCS_MAVLink/GCS_Common.cpp.
"""

from __future__ import annotations

from collections.abc import Iterator

from pymavlink.dialects.v20 import all as dialect  # type: ignore[import-untyped]

from testbed.mavlink.encode import Encoder

LONGEST = 70  # bytes
ASKED, ASKED_HZ = ("ATTITUDE_QUATERNION", "GLOBAL_POSITION_INT", "LOCAL_POSITION_NED"), 20
FORCE = 2989.0  # with which ArduPilot takes a command to arm as one that is meant


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


def asked(encoder: Encoder, system: int) -> Iterator[bytes]:
    """The frames that ask the autopilot of a ``system`` to say where it is, `ASKED_HZ` times a second."""
    for name in ASKED:
        message = getattr(dialect, f"MAVLINK_MSG_ID_{name}")
        yield _command(encoder, system, dialect.MAV_CMD_SET_MESSAGE_INTERVAL, message, 1e6 / ASKED_HZ)


def armed(encoder: Encoder, system: int) -> bytes:
    """The frame that has an ArduPilot of a ``system`` armed, whatever its checks say."""
    return _command(encoder, system, dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1.0, FORCE)


def _command(encoder: Encoder, system: int, command: int, *values: float) -> bytes:
    told = {f"param{k + 1}": values[k] if k < len(values) else 0.0 for k in range(7)}
    whom = {"target_system": system, "target_component": dialect.MAV_COMP_ID_AUTOPILOT1}
    return encoder.frame("COMMAND_LONG", {**whom, "command": command, "confirmation": 0, **told})
