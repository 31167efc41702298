"""Whose ways the vehicle takes on, so that ground stations know how to read it: PX4's, or ArduPilot Plane's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pymavlink.dialects.v20 import all as mav  # type: ignore[import-untyped]

from testbed.errors import UserError


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
