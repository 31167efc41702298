"""Whose ways the vehicle takes on, so that ground stations know how to read it: PX4's, or ArduPilot Plane's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version

from pymavlink.dialects.v20 import all as mav  # type: ignore[import-untyped]

from testbed.errors import UserError
from testbed.mavlink.encode import Fields

_RELEASE = 255  # version type


@dataclass(frozen=True, slots=True)
class Identity:
    """What differs between autopilots.

    ``mode`` is the one mode there is, circling or following the plan on its own; ``byte_wise`` whether integer
    parameters travel as their bytes or as numbers; ``home_first`` whether a mission begins with home; ``version`` that
    of the autopilot whose protocol is spoken, as stations refuse older ones; ``facts`` parameters that they look for.
    """

    autopilot: int
    mode: int
    mode_name: str
    byte_wise: bool
    home_first: bool
    version: tuple[int, int, int]
    facts: Mapping[str, tuple[int, str]]


IDENTITIES = {
    "px4": Identity(
        autopilot=mav.MAV_AUTOPILOT_PX4,
        mode=4 << 16 | 3 << 24,  # main mode auto, sub mode loiter, as PX4 packs them
        mode_name="Hold",
        byte_wise=True,
        home_first=False,
        version=(1, 15, 0),
        facts={
            "MAV_SYS_ID": (1, "system of the vehicle"),
            "MAV_TYPE": (mav.MAV_TYPE_FIXED_WING, "fixed wing"),
            "SYS_AUTOSTART": (2100, "standard plane"),
            "SYS_FAILURE_EN": (1, "failures can be injected"),
        },
    ),
    "ardupilot": Identity(
        autopilot=mav.MAV_AUTOPILOT_ARDUPILOTMEGA,
        mode=12,
        mode_name="LOITER",
        byte_wise=False,
        home_first=True,
        version=(4, 5, 7),
        facts={"SYSID_THISMAV": (1, "system of the vehicle")},
    ),
}


def identity_of(name: str) -> Identity:
    """The identity of that name. Raises UserError when there is none."""
    if name not in IDENTITIES:
        raise UserError(f"--mavlink-identity {name}: not known: choose from {', '.join(IDENTITIES)}")
    return IDENTITIES[name]


def autopilot_version(identity: Identity, system: int) -> Fields:
    """AUTOPILOT_VERSION: what is spoken (that autopilot's version) and what this is (`middleware_sw_version`)."""
    encoding = mav.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
    if identity.byte_wise:
        encoding = mav.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    capabilities = (
        mav.MAV_PROTOCOL_CAPABILITY_MAVLINK2
        | mav.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
        | mav.MAV_PROTOCOL_CAPABILITY_MISSION_FLOAT
        | mav.MAV_PROTOCOL_CAPABILITY_MISSION_INT
        | mav.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        | encoding
    )
    own = [int(part) for part in version("navigation-testbed").split(".")[:3]]
    return {
        "capabilities": capabilities,
        "uid": system,
        "flight_sw_version": _packed(identity.version),
        "middleware_sw_version": _packed(own),
        "os_sw_version": 0,
        "board_version": 0,
        "vendor_id": 0,
        "product_id": 0,
        "flight_custom_version": b"testbed\0",
        "middleware_custom_version": bytes(8),
        "os_custom_version": bytes(8),
        "uid2": bytes([system, *bytes(17)]),
    }


def _packed(version: Sequence[int]) -> int:
    major, minor, patch = version
    return (major & 0xFF) << 24 | (minor & 0xFF) << 16 | (patch & 0xFF) << 8 | _RELEASE


def available_mode(identity: Identity) -> Fields:
    """AVAILABLE_MODES: the one that there is."""
    return {
        "number_modes": 1,
        "mode_index": 1,
        "standard_mode": mav.MAV_STANDARD_MODE_NON_STANDARD,
        "custom_mode": identity.mode,
        "properties": 0,
        "mode_name": identity.mode_name.encode(),
    }


def current_mode(identity: Identity) -> Fields:
    """CURRENT_MODE."""
    return {
        "standard_mode": mav.MAV_STANDARD_MODE_NON_STANDARD,
        "custom_mode": identity.mode,
        "intended_custom_mode": 0,
    }
