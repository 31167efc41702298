"""What of a log can't be in the units and axes that it is taken for, by what its sensors say of each other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from nav.earth import displacement_n, pressure_altitude
from nav.samples import AirspeedSample, Array, BarometerSample, GnssSample, ImuSamples
from testbed.feeds.axes import unlike
from testbed.feeds.lateness import LEAST_FIXES, fixes
from testbed.feeds.log import Log, feels_gravity, usual_force
from testbed.feeds.survey import SCALES, Phase, about, airspeed_scale, between, in_the_air, phases
from testbed.feeds.units import LENGTH, SPEED, mixed_up

STRETCH_S = 5.0  # over which a way, and a turn, are added up: fixes may be told to a metre only
LEAST_STRETCHES, LEAST_CLIMBS = 10, 6
LEAST_WAY, LEAST_CLIMB = 15.0, 5.0  # in a stretch [m]
LEAST_TURN = math.radians(360)  # of the course
# What 56 logs have, of which one receiver was jammed and two IMUs were not right: positions are 1 to 4 % of their way
# off what velocities say (0.29 and 0.54 of bad ones), heights 6 to 31 % (0.44 and 0.65); km/h make 72 %, exchanged axes
# more, and a sign 200 %. Gyros feel 1.1 to 5 times what the course turns, 0.2 to 1.4 rad/s; deg/s for rad/s are 57
# times as much.
MOST_OFF, MOST_HEIGHT_OFF = 0.5, 1.0
LEAST_FELT, FASTEST_TURN = 0.1, 4.0  # of the course; all the time that it flies [rad/s]
MOST_STEP, STEP_SHARE = math.radians(5), 0.95  # from one sample to the next; no more in this share of them
FASTEST = 100.0  # of one step [rad/s]
HEIGHTS = 0.6, 1.6  # of a receiver over those of a barometer, by how far both go up and down
LEAST_SPAN, MOST_OF_IT = 20.0, (0.05, 0.95)  # that both go up and down by [m], and of which share of the heights
SAME_SHAPE = 0.9  # of these: correlation
TINY = 1e-9  # [m]
ON_ITS_BACK = math.radians(120)  # what stands on its tail is none


def mistaken(log: Log) -> list[str]:
    """What contradicts what, a sentence each, sensor by sensor; nothing where all may be as it is taken for."""
    told: list[str] = []
    flight = phases(log) if any(len(imu) > 1 for imu in log.imus.values()) else []
    for name, own in log.samples.items():
        if own and isinstance(own[0], AirspeedSample):
            told += [f"{name}: {what}" for what in _airspeed(log, own, flight)]
        elif any(isinstance(one, GnssSample) and one.has_fix for one in own):
            told += [f"{name}: {what}: are units, columns and axes right?" for what in gone_otherwise(*fixes(own))]
            told += [f"{name}: {what}" for what in _heights(log, own)]
        elif any(isinstance(one, GnssSample) for one in own):
            told.append(f"{name}: it never has a fix")
    for name, imu in log.imus.items():
        if len(imu) > 1:
            told += [f"{name}: {what}" for what in _inertial(log, imu, flight)]
    return [*told, *unlike(log).values()]


def _airspeed(log: Log, own: Sequence[Any], flight: Sequence[Phase]) -> Iterator[str]:
    """Where GNSS velocities, with the wind that fits best, say that an airspeed is in another unit."""
    heard = in_the_air(log, own, flight)
    if SCALES[0] <= about(*heard) <= SCALES[1]:
        return
    scale = airspeed_scale(*heard)
    if scale and not SCALES[0] <= scale <= SCALES[1]:
        pair = mixed_up(scale, SPEED)
        as_made = f", as {pair} is" if pair else ""
        yield f"by {log.receiver} true airspeed is {scale:.3g} times what it says{as_made}: is its unit right?"


def _heights(log: Log, own: Sequence[Any]) -> Iterator[str]:
    """Where a receiver's heights go as those of a barometer do, but by another measure."""
    t, _, place = fixes(own)
    for name, beside in log.samples.items():
        pressures = [one for one in beside if isinstance(one, BarometerSample) and one.pressure > 0]
        if not pressures:
            continue
        altitude = pressure_altitude(np.array([one.pressure for one in pressures]))
        both = np.column_stack([place[:, 2], np.interp(t, [one.t for one in pressures], altitude, np.nan, np.nan)])
        both = both[np.isfinite(both).all(axis=1)]
        if len(both) < LEAST_FIXES:
            continue
        low, high = np.quantile(both, MOST_OF_IT, axis=0)
        least, ratio = min(high - low), float(np.divide(*np.maximum(high - low, TINY)))
        if least < LEAST_SPAN or HEIGHTS[0] <= ratio <= HEIGHTS[1]:
            continue
        if np.corrcoef(np.clip(both, low, high).T)[0, 1] >= SAME_SHAPE:
            pair = mixed_up(1 / ratio, LENGTH)
            as_made = f", as {pair} do" if pair else ""
            far = f"{ratio:.3g} times as far up and down as those of {name}"
            yield f"its heights go {far}{as_made}: are the units of both right?"


def gone_otherwise(t: Array, v_n: Array, place: Array) -> Iterator[str]:
    """Where positions (N, 3), latitude, longitude [rad] and height, go otherwise than velocities (N, 3) say."""
    usable = np.isfinite(v_n).all(axis=1) & np.isfinite(place).all(axis=1)
    t, v_n, place = t[usable], v_n[usable], place[usable]
    ways = list(_stretches(t, v_n, place))
    if not ways:
        return
    said, gone = (np.array(one) for one in zip(*ways, strict=True))
    level = "go", [0, 1], LEAST_WAY, LEAST_STRETCHES, MOST_OFF
    upright = "climb", [2], LEAST_CLIMB, LEAST_CLIMBS, MOST_HEIGHT_OFF
    for what, axes, least, enough, most in (level, upright):
        far = np.maximum(*(np.linalg.norm(one[:, axes], axis=1) for one in (said, gone))) >= least
        if far.sum() < enough:
            continue
        off = np.linalg.norm((said - gone)[far][:, axes], axis=1)
        way = np.linalg.norm(gone[far][:, axes], axis=1)
        told = np.linalg.norm(said[far][:, axes], axis=1)
        if np.median(off) > most * np.median(np.maximum(way, told)):
            figures = f"{np.median(way):.3g} m in {STRETCH_S:g} s where these say {np.median(told):.3g} m"
            yield f"its positions {what} otherwise than its velocities say ({figures}, {np.median(off):.3g} m apart)"


def _stretches(t: Array, v_n: Array, place: Array) -> Iterator[tuple[Array, Array]]:
    """What velocities add up to (3,) and how far positions move (3,) [m] in each stretch without a gap."""
    first = 0
    for k in range(1, len(t)):
        if t[k] - t[k - 1] > 0.5 * STRETCH_S:
            first = k
        elif t[k] - t[first] >= STRETCH_S:
            rows = slice(first, k + 1)
            said = np.atleast_1d(np.trapezoid(v_n[rows], t[rows], axis=0))
            yield said, displacement_n(*place[k].tolist(), *place[first].tolist())
            first = k


def _inertial(log: Log, imu: ImuSamples, flight: Sequence[Phase]) -> Iterator[str]:
    """Where gravity, or the turns of a receiver's course, are not what it feels."""
    usual = usual_force(imu)
    if math.isfinite(usual) and not feels_gravity(imu):
        yield f"it feels {usual:.3g} m/s² mostly, where gravity is 9.8: is the unit of its accelerometers right?"
    elif _lies_on_its_back(log, imu, flight):
        yield "at rest it lies on its back: are its axes forward, right and down?"
    turned = np.linalg.norm(np.nan_to_num(imu.dtheta), axis=1)
    often = float(np.quantile(turned, STEP_SHARE))
    if often > MOST_STEP:
        how = f"it turns by {math.degrees(often):.0f} deg from one sample to the next ({1 - STEP_SHARE:.0%} turn more)"
        yield f"{how}: told so seldom, rates lead no attitude on for long: log it faster, if you can"
    if log.receiver is None:
        return
    t, v_n, _ = fixes(log.samples[log.receiver])
    known = np.isfinite(v_n).all(axis=1)
    t, v_n = t[known], v_n[known]
    at = np.concatenate([imu.t[:1] - imu.dt[:1], imu.t])
    turned = np.minimum(turned, FASTEST * imu.dt)  # a row that is wrong is no wrong unit
    felt = np.concatenate([[0.0], np.cumsum(turned)])
    fast = np.hypot(v_n[:, 0], v_n[:, 1]) > LEAST_WAY / STRETCH_S
    step = np.diff(t)
    both = fast[1:] & fast[:-1] & (step < 0.5 * STRETCH_S) & (t[:-1] > at[0]) & (t[1:] < at[-1])
    seconds = float(step[both].sum())
    if seconds < LEAST_STRETCHES * STRETCH_S:
        return
    heading = np.exp(1j * np.arctan2(v_n[:, 1], v_n[:, 0]))
    course = float(np.abs(np.angle(heading[1:] / heading[:-1]))[both].sum())
    own = float(np.diff(np.interp(t, at, felt))[both].sum())
    rates = f"{math.degrees(own / seconds):.3g} deg/s on the way"
    if own > FASTEST_TURN * seconds:
        yield f"its gyros feel {rates}: is their unit right?"
    elif course > LEAST_TURN and own < LEAST_FELT * course:
        turns = f"{math.degrees(course / seconds):.3g} deg/s"
        yield f"its gyros feel {rates}, where the course of {log.receiver} turns by {turns}: is their unit right?"


def _lies_on_its_back(log: Log, imu: ImuSamples, flight: Sequence[Phase]) -> bool:
    """Whether gravity pulls it upwards for most of its rest."""
    rests = [between(log, imu, one) for one in flight if one.name == "rest"]
    forces = [np.nansum(imu.dv[rows], axis=0) for rows in rests]
    total = np.sum(forces, axis=0) if forces else np.zeros(3)
    return bool(-total[2] < math.cos(ON_ITS_BACK) * np.linalg.norm(total))
