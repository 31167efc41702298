"""The plan as a mission that ground stations can show: one item for each leg, where still air would take the aircraft.

An item is where its leg leads: the end of a straight line or a turn, the centre of circles. Legs that only change
altitude or airspeed are such commands. In wind the aircraft goes elsewhere; the plan's own places stay.
Source of the items' parameters: https://mavlink.io/en/messages/common.html#mav_commands
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pymavlink.dialects.v20 import all as mav  # type: ignore[import-untyped]

from nav.earth import dcm_en, ecef_from_geodetic, geodetic_from_ecef
from nav.samples import Array
from testbed.mavlink.encode import latitude_e7, longitude_e7
from testbed.motion import aircraft, guidance, legs, paths
from testbed.motion.kinematic import Kinematic
from testbed.motion.logged import LogTruth
from testbed.motion.sections import FlightTruth, KinematicTruth
from testbed.scenario import Scenario

_MOST_SEGMENTS = 1000  # of one leg; where a longer one ends makes no difference on a map


@dataclass(frozen=True, slots=True)
class Item:
    """One mission item: command, its first four parameters, place [rad, m above the ellipsoid].

    ``speed`` is the true airspeed [m/s] on the way there, NaN where there is none to fly at.
    """

    command: int
    params: tuple[float, float, float, float]
    lat: float
    lon: float
    h: float
    speed: float = math.nan


def items(scenario: Scenario, home_first: bool) -> list[Item]:
    """The plan's legs in order; with ``home_first`` after the start, as ArduPilot has it."""
    truth = scenario.truth
    if isinstance(truth, LogTruth):
        return []  # what it was to fly, nobody knows
    start = truth.start
    home = Item(
        mav.MAV_CMD_NAV_WAYPOINT,
        (0.0, 0.0, 0.0, 0.0),
        math.radians(start.lat_deg),
        math.radians(start.lon_deg),
        float(start.alt_m),
        _begun(truth)[0].speed if isinstance(truth, FlightTruth) else math.nan,
    )
    legs = _flown(scenario.plan, truth) if isinstance(truth, FlightTruth) else _driven(truth, scenario.duration_s)
    return [home, *legs] if home_first and legs else legs


def take_off(scenario: Scenario) -> Item | None:
    """From the ground to where the plan begins; None where it begins in the air."""
    return _begun(scenario.truth)[1] if isinstance(scenario.truth, FlightTruth) else None


def fields(mission: Sequence[Item], number: int, current: int, home_h: float) -> dict[str, float]:
    """MISSION_ITEM_INT of an item, without its target. Heights are relative to ``home_h``."""
    item = mission[number]
    first, second, third, fourth = item.params
    return {
        "seq": number,
        "frame": mav.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
        "command": item.command,
        "current": int(number == current),
        "autocontinue": 1,
        "param1": first,
        "param2": second,
        "param3": third,
        "param4": fourth,
        "x": latitude_e7(item.lat),
        "y": longitude_e7(item.lon),
        "z": item.h - home_h,
        "mission_type": mav.MAV_MISSION_TYPE_MISSION,
    }


def with_floats(values: Mapping[str, float]) -> dict[str, float]:
    """MISSION_ITEM of the same: the old form, degrees in float32."""
    place = {"x": values["x"] / 1e7, "y": values["y"] / 1e7}
    return {**values, **place, "frame": mav.MAV_FRAME_GLOBAL_RELATIVE_ALT}


@dataclass(slots=True)
class _Here:
    """Where the walk along the plan has come to [rad, m, m/s true airspeed]."""

    lat: float
    lon: float
    h: float
    course: float
    speed: float


def _flown(plan: Sequence[legs.Leg], truth: FlightTruth) -> list[Item]:
    here, _ = _begun(truth)
    return [_leg(leg, here) for leg in plan]


def _begun(truth: FlightTruth) -> tuple[_Here, Item | None]:
    """Where the plan begins, and the take-off that leads there, if there is one."""
    start, envelope = truth.start, aircraft.load(truth.aircraft)
    here = _Here(
        math.radians(start.lat_deg),
        math.radians(start.lon_deg),
        start.alt_m,
        math.radians(start.heading_deg),
        guidance.beginning(start, envelope).airspeed_mps,
    )
    if envelope.launch is None or not start.on_ground:
        return here, None
    led = _leg(guidance.climb_out(start, envelope), here)
    return here, replace(led, command=mav.MAV_CMD_NAV_TAKEOFF, params=(envelope.launch.pitch_deg, 0.0, 0.0, 0.0))


def _leg(leg: legs.Leg, here: _Here) -> Item:
    """The item of a leg that begins ``here``; moves on to where it ends."""
    place = getattr(leg, "to", None) or getattr(leg, "centre", None)
    lat0, lon0 = (math.radians(place.lat_deg), math.radians(place.lon_deg)) if place else (here.lat, here.lon)
    north, east, here.course = _seen(here, lat0, lon0)
    to_h = getattr(leg, "to_m", None) or getattr(leg, "alt_m", None) or here.h
    to_speed = getattr(leg, "to_mps", None) or getattr(leg, "airspeed_mps", None) or here.speed
    length = math.inf
    if isinstance(leg, legs.Climb | legs.Descend):
        length = abs(to_h - here.h) / leg.rate_mps * here.speed
    elif isinstance(leg, legs.Airspeed):
        length = abs(to_speed - here.speed) / guidance.ACCELERATION * 0.5 * (to_speed + here.speed)
    elif duration := getattr(leg, "duration_s", None):
        length = duration * to_speed
    motion = paths.Motion(
        north, east, here.speed * math.cos(here.course), here.speed * math.sin(here.course), here.course, here.speed
    )
    centre: tuple[float, float] | None = None
    for count, segment in enumerate(leg.segments(motion, here.course)):
        if isinstance(segment, paths.Arc) and centre is None:
            centre = segment.north, segment.east
        north, east, here.course, length = _along(segment, north, east, here.course, to_speed, length)
        if length <= 0.0 or count >= _MOST_SEGMENTS:
            break
    here.lat, here.lon, here.course = _back(north, east, here.course, (lat0, lon0, to_h))
    here.h, here.speed = to_h, to_speed
    item = _item(leg, here)
    if centre is not None and item.command in (mav.MAV_CMD_NAV_LOITER_TURNS, mav.MAV_CMD_NAV_LOITER_TIME):
        lat, lon, _ = _back(*centre, here.course, (lat0, lon0, to_h))
        item = replace(item, lat=lat, lon=lon)
    return item


def _seen(here: _Here, lat0: float, lon0: float) -> tuple[float, float, float]:
    """Where it is in the plane that touches the Earth at a place [rad]: north, east [m], and course [rad] there."""
    C_ne = dcm_en(lat0, lon0).T
    away = ecef_from_geodetic(here.lat, here.lon, here.h) - ecef_from_geodetic(lat0, lon0, here.h)
    north, east, _ = (C_ne @ away).tolist()
    return north, east, _turned(here.course, C_ne @ dcm_en(here.lat, here.lon))


def _back(north: float, east: float, course: float, origin: tuple[float, float, float]) -> tuple[float, float, float]:
    """Latitude, longitude and course [rad] of what is there in the plane that touches the Earth at the ``origin``."""
    C_en = dcm_en(*origin[:2])
    lat, lon, _ = geodetic_from_ecef(ecef_from_geodetic(*origin) + C_en @ np.array([north, east, 0.0]))
    return lat, lon, _turned(course, dcm_en(lat, lon).T @ C_en)


def _turned(course: float, C: Array) -> float:
    """A course in the axes that ``C`` (3, 3) takes north, east, down to: meridians are not parallel."""
    north, east, _ = (C @ np.array([math.cos(course), math.sin(course), 0.0])).tolist()
    return math.atan2(east, north)


def _along(
    segment: paths.Segment, north: float, east: float, course: float, speed: float, length: float
) -> tuple[float, float, float, float]:
    """Where a segment ends, or ``length`` [m] runs out: north, east, course, and what is left of the length."""
    if isinstance(segment, paths.Line):
        course = segment.course
        gone = min(segment.length, length)
        gone = gone if math.isfinite(gone) else 0.0
        return north + gone * math.cos(course), east + gone * math.sin(course), course, length - gone
    if isinstance(segment, paths.HeadingTurn):
        radius, turn = paths.turn_radius(speed, legs.TURN_BANK), segment.remaining
        side = math.copysign(1.0, turn)
        middle = north - side * radius * math.sin(course), east + side * radius * math.cos(course)
        sweep = abs(turn)
    else:
        assert isinstance(segment, paths.Arc)
        radius, side, middle = segment.radius, float(segment.side), (segment.north, segment.east)
        sweep = segment.sweep
        off_north, off_east = north - middle[0], east - middle[1]
        if math.hypot(off_north, off_east) > 1.0:  # onto the circle by the straight way
            course = math.atan2(off_east, off_north) + side * 0.5 * math.pi
    sweep = min(sweep, length / radius)
    sweep = sweep if math.isfinite(sweep) else 0.0
    course += side * sweep
    end = middle[0] + side * radius * math.sin(course), middle[1] - side * radius * math.cos(course)
    return *end, paths.wrap(course), length - sweep * radius


def _item(leg: legs.Leg, end: _Here) -> Item:
    """The item of a leg that ends there."""
    place = end.lat, end.lon, end.h, end.speed
    match leg:
        case legs.Climb() | legs.Descend():
            way = 1.0 if isinstance(leg, legs.Climb) else 2.0
            return Item(mav.MAV_CMD_NAV_CONTINUE_AND_CHANGE_ALT, (way, 0.0, 0.0, 0.0), *place)
        case legs.Airspeed():
            return Item(mav.MAV_CMD_DO_CHANGE_SPEED, (0.0, leg.to_mps, -1.0, 0.0), 0.0, 0.0, end.h, end.speed)
        case legs.Loiter() | legs.Racetrack() | legs.FigureEight():
            radius = leg.radius_m if leg.direction == "right" else -leg.radius_m
            rounds = leg.laps if isinstance(leg, legs.Racetrack) else leg.turns
            if rounds is not None:
                return Item(mav.MAV_CMD_NAV_LOITER_TURNS, (rounds, 0.0, radius, 0.0), *place)
            assert leg.duration_s is not None
            return Item(mav.MAV_CMD_NAV_LOITER_TIME, (leg.duration_s, 0.0, radius, 0.0), *place)
    return Item(mav.MAV_CMD_NAV_WAYPOINT, (0.0, 0.0, 0.0, math.degrees(end.course) % 360), *place)


def _driven(truth: KinematicTruth, duration_s: float) -> list[Item]:
    """Where the segments of a kinematic motion end, each for the last time; waypoints all of them."""
    if not truth.segments:
        return []
    rows = Kinematic(truth.start, 1.0, truth.track(), truth.body).advance(math.ceil(duration_s) + 1)
    ends: list[Item] = []
    at = 0
    for index in range(len(truth.segments)):
        passed = np.flatnonzero(rows.leg == index)
        at = int(passed[-1]) if len(passed) else at  # a repeat has no rows of its own, what is not reached has none yet
        ends.append(
            Item(
                mav.MAV_CMD_NAV_WAYPOINT,
                (0.0, 0.0, 0.0, math.nan),
                float(rows.lat[at]),
                float(rows.lon[at]),
                float(rows.h[at]),
            )
        )
    return ends
