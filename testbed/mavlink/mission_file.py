"""The plan of a scenario as a file that ground stations read: QGroundControl's .plan, and plain text (QGC WPL 110).

Both hold what PX4 and ArduPlane understand alike: a take-off from the ground, waypoints where legs lead, circles that
last a time about their centre, changes of airspeed, and at the end a circle for good. Circuits and eights become
circles, turns are counted by their time. Heights are absolute, above the ellipsoid in the place of the sea's level, as
autopilots are told them here; airspeeds are equivalent ones, which autopilots fly by.

Sources: QGroundControl's Plan File Format (version 1 of the file, 2 of mission, fence and rally points);
https://mavlink.io/en/file_formats/; mavlink_mission.cpp of PX4-Autopilot 1.16 for the commands that it takes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import all as mav  # type: ignore[import-untyped]

from nav.earth import SEA_LEVEL_DENSITY, isa_density
from testbed.errors import UserError
from testbed.mavlink import mission
from testbed.motion.sections import FlightTruth
from testbed.scenario import Scenario

ABSOLUTE = 2  # QGroundControl's mode of altitudes above the sea's level
HOVER_MPS = 5.0  # of vehicles that can; the file must have it
DEGREES = 9  # digits after the point: a tenth of a millimetre


@dataclass(frozen=True, slots=True)
class Order:
    """One line: command, its first four parameters, place [deg, deg, m], or none."""

    command: int
    params: tuple[float, float, float, float]
    place: tuple[float, float, float] | None


def content(scenario: Scenario, form: str) -> bytes:
    """The file of a scenario in the ``form`` "plan" or "wpl". Raises UserError when there is nothing to fly."""
    if not isinstance(scenario.truth, FlightTruth) or not scenario.plan:
        raise UserError('there is no plan that an autopilot could fly: truth.source must be "flight"')
    home, *items = mission.items(scenario, home_first=True)
    orders = list(_orders(home, items))
    if (first := mission.take_off(scenario)) is not None:
        orders.insert(0, Order(first.command, first.params, _place(first)))
    return _plan(home, orders) if form == "plan" else _wpl(home, orders)


def _orders(home: mission.Item, items: Sequence[mission.Item]) -> Iterator[Order]:
    speed, radius, last = home.speed, 0.0, home
    for item in items:
        if item.speed != speed:
            speed = item.speed
            yield Order(mav.MAV_CMD_DO_CHANGE_SPEED, (0.0, _equivalent(speed, item.h), -1.0, 0.0), None)
        if item.command == mav.MAV_CMD_DO_CHANGE_SPEED:
            continue
        lasts, params = 0.0, (0.0, 0.0, 0.0, 0.0)
        if item.command in (mav.MAV_CMD_NAV_LOITER_TURNS, mav.MAV_CMD_NAV_LOITER_TIME):
            lasts, _, radius, _ = item.params
            if item.command == mav.MAV_CMD_NAV_LOITER_TURNS:
                lasts *= 2 * math.pi * abs(radius) / speed
            params = (round(lasts, 1), 0.0, radius, 0.0)
        yield Order(mav.MAV_CMD_NAV_LOITER_TIME if lasts else mav.MAV_CMD_NAV_WAYPOINT, params, _place(item))
        last = item
    yield Order(mav.MAV_CMD_NAV_LOITER_UNLIM, (0.0, 0.0, radius, 0.0), _place(last))


def _place(item: mission.Item) -> tuple[float, float, float]:
    lat, lon = round(math.degrees(item.lat), DEGREES), round(math.degrees(item.lon), DEGREES)
    return lat, lon, round(item.h, 3)


def _equivalent(speed: float, h: float) -> float:
    """Equivalent airspeed of a true one [m/s] at a height [m], to 1 cm/s."""
    return round(speed * math.sqrt(float(isa_density(h)) / SEA_LEVEL_DENSITY), 2)


def _plan(home: mission.Item, orders: Sequence[Order]) -> bytes:
    items: list[dict[str, Any]] = []
    for number, order in enumerate(orders, 1):
        one: dict[str, Any] = {"type": "SimpleItem", "command": order.command, "doJumpId": number, "autoContinue": True}
        one["frame"] = mav.MAV_FRAME_MISSION if order.place is None else mav.MAV_FRAME_GLOBAL
        one["params"] = [*order.params, *(order.place or (0, 0, 0))]
        if order.place is not None:
            one |= {"Altitude": order.place[2], "AltitudeMode": ABSOLUTE, "AMSLAltAboveTerrain": None}
        items.append(one)
    file = {
        "fileType": "Plan",
        "version": 1,
        "groundStation": "QGroundControl",
        "mission": {
            "version": 2,
            "firmwareType": mav.MAV_AUTOPILOT_PX4,
            "vehicleType": mav.MAV_TYPE_FIXED_WING,
            "cruiseSpeed": _equivalent(home.speed, home.h),
            "hoverSpeed": HOVER_MPS,
            "globalPlanAltitudeMode": ABSOLUTE,
            "plannedHomePosition": list(_place(home)),
            "items": items,
        },
        "geoFence": {"version": 2, "circles": [], "polygons": []},
        "rallyPoints": {"version": 2, "points": []},
    }
    return (json.dumps(file, indent=2) + "\n").encode()


def _wpl(home: mission.Item, orders: Sequence[Order]) -> bytes:
    first = Order(mav.MAV_CMD_NAV_WAYPOINT, (0.0, 0.0, 0.0, 0.0), _place(home))
    lines = ["QGC WPL 110"]
    for number, order in enumerate((first, *orders)):
        frame = mav.MAV_FRAME_MISSION if order.place is None else mav.MAV_FRAME_GLOBAL
        numbers = (*order.params, *(order.place or (0.0, 0.0, 0.0)))
        words = (number, int(number == 0), frame, order.command, *(f"{value:.9f}" for value in numbers), 1)
        lines.append("\t".join(map(str, words)))
    return ("\n".join(lines) + "\n").encode()
