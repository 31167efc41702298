"""Whether legs were flown as they were meant: a run may well end in the middle of one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from nav import earth
from testbed.errors import UserError
from testbed.motion.guidance import ACCELERATION
from testbed.motion.legs import (
    TURN_BANK,
    Airspeed,
    Climb,
    Descend,
    FigureEight,
    Leg,
    Loiter,
    Racetrack,
    Straight,
    STurns,
    Turn,
    UTurn,
    Waypoint,
)
from testbed.motion.paths import turn_radius
from testbed.motion.sections import FlightTruth
from testbed.record.reader import scenario_of
from testbed.score.accuracy import column

if TYPE_CHECKING:
    import xarray

LATE = 1.25  # times what a leg takes in still air, and more where ordinary wind asks for it
ORDINARY = 0.5  # wind over airspeed that a plan must reckon with
SETTLED_S = 15.0  # and so long on top, for getting onto its path
TURNED_S, FARTHER_M = 60.0, 50.0  # after which a leg to a place should come nearer to it, not farther


def not_as_planned(dataset: xarray.DataTree) -> list[str]:
    """A sentence on the first leg that the wind turned round, and one on the leg in which a run ended, if need be."""
    try:
        scenario = scenario_of(dataset)
    except UserError:  # `metrics.unscored` says so
        return []
    t = column(dataset, "truth/time")
    if not isinstance(scenario.truth, FlightTruth) or not len(t):
        return []
    said = [f"leg {k}/{len(scenario.plan)} {leg.leg.replace('_', ' ')}" for k, leg in enumerate(scenario.plan, 1)]
    number = int(column(dataset, "truth/leg")[-1])
    cut = len(t) > 1 and t[-1] + 2 * (t[-1] - t[-2]) > scenario.duration_s
    found = _turned_round(dataset, scenario.plan, said)
    if cut and 0 <= number < len(scenario.plan):  # of an early end something else is told
        found += _unfinished(dataset, number, scenario.plan[number], said[number])
    return found


def _turned_round(dataset: xarray.DataTree, plan: Sequence[Leg], said: Sequence[str]) -> list[str]:
    """Of the first leg along the course of the moment in which wind drove the aircraft backwards: it leads back."""
    legs, q_nb, v_n = (column(dataset, f"truth/{name}") for name in ("leg", "q_nb", "v_n"))
    for number in np.unique(legs[(legs >= 0) & (legs < len(plan))]).astype(int):
        row, leg = int(np.argmax(legs == number)), plan[number]
        w, x, y, z = q_nb[row]
        ahead = v_n[row, 0] * (1 - 2 * (y * y + z * z)) + v_n[row, 1] * 2 * (x * y + w * z)
        if isinstance(leg, Straight | Climb | Descend | Airspeed) and _place(leg) is None and ahead < 0:
            wind = float(np.linalg.norm(column(dataset, "truth/wind_n")[row, :2]))
            fast = float(column(dataset, "truth/commands")[row, 2])
            return [
                f"{said[number]} went the other way: it keeps the course over ground, which is backwards where the wind"
                f" ({wind:.3g} m/s) is faster than the aircraft ({fast:.3g} m/s)"
            ]
    return []


def _unfinished(dataset: xarray.DataTree, number: int, leg: Leg, named: str) -> list[str]:
    """A sentence when a run ended in a leg that should have been over by then, or led away from its place; or none.

    Over: after `LATE` times what its path takes at its airspeed in still air, and `SETTLED_S`; against an ordinary wind
    after what it takes there. Away: `FARTHER_M` and more, when `TURNED_S` have passed.
    """
    t, rows = column(dataset, "truth/time"), np.flatnonzero(column(dataset, "truth/leg") == number)
    took, airspeed = t[-1] - t[rows[0]], float(column(dataset, "truth/commands")[rows, 2].min())
    said = f"{named} was begun and not flown to its end"
    first, last = (_away(leg, dataset, row) for row in (rows[0], -1))
    if took > TURNED_S and last > first + FARTHER_M:
        return [f"{said}: it was {first / 1000:.3g} km away at first, and {last / 1000:.3g} km after {took:.0f} s"]
    due = _seconds(leg, dataset, rows[0], airspeed)
    share = float(np.linalg.norm(column(dataset, "truth/wind_n")[rows[0], :2])) / airspeed
    late = max(LATE, 1.05 / (1.0 - share)) if share <= ORDINARY else LATE
    if took > late * due + SETTLED_S:
        return [f"{said}: after {took:.0f} s, where still air would ask for {due:.0f} s"]
    return []


def _place(leg: Leg) -> Waypoint | None:
    """What a leg leads to, or circles about."""
    return getattr(leg, "to", None) or getattr(leg, "centre", None)


def _away(leg: Leg, dataset: xarray.DataTree, row: int) -> float:
    """From the place that a leg leads to, or the circle about it [m]; 0 for a leg without one."""
    place = _place(leg)
    if place is None:
        return 0.0
    lat, lon, h = (float(column(dataset, f"truth/{name}")[row]) for name in ("lat", "lon", "h"))
    north, east, _ = earth.displacement_n(math.radians(place.lat_deg), math.radians(place.lon_deg), h, lat, lon, h)
    return abs(math.hypot(north, east) - getattr(leg, "radius_m", 0.0))


def _seconds(leg: Leg, dataset: xarray.DataTree, first: int, airspeed: float) -> float:
    """What a leg that begins at row ``first`` takes in still air, at most [s]; infinite when a duration ends it."""
    if getattr(leg, "duration_s", None) is not None:
        return math.inf
    match leg:
        case Climb() | Descend():
            return abs(leg.to_m - float(column(dataset, "truth/h")[first])) / leg.rate_mps
        case Airspeed():
            return abs(leg.to_mps - float(column(dataset, "truth/commands")[first, 2])) / ACCELERATION
        case Turn():
            angle = 2 * math.pi if leg.by_deg is None else math.radians(abs(leg.by_deg))
            return angle * turn_radius(airspeed, TURN_BANK) / airspeed
    wind = float(np.linalg.norm(column(dataset, "truth/wind_n")[first, :2]))
    return (_away(leg, dataset, first) + _path(leg, turn_radius(airspeed + wind, TURN_BANK))) / airspeed


def _path(leg: Leg, usual_radius: float) -> float:
    """Length of the path of a leg that counts lengths, turns or laps [m], from where it is reached."""
    match leg:
        case Straight():
            return leg.length_m or 0.0
        case Loiter(turns=float(turns)):
            return 2 * math.pi * leg.radius_m * turns
        case Racetrack(laps=float(laps)):
            return 2 * (leg.length_m + math.pi * leg.radius_m) * laps
        case FigureEight(turns=float(turns)):
            return 4 * math.pi * leg.radius_m * turns
        case STurns():
            return 2 * math.radians(leg.swing_deg) * leg.radius_m * leg.turns
        case UTurn():
            return math.pi * (leg.radius_m or usual_radius)
    return math.inf
