"""The reference of a recorded flight as a motion: rows at every tick, unknown where nobody knew."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from nav.earth import position_difference_n, radii, wrap_longitude
from nav.samples import Array, GnssSample, ImuSamples, usable
from testbed.feeds.log import Reference, Samples
from testbed.feeds.stamps import Rows
from testbed.motion.sections import ALTITUDES, LATITUDE_LIMIT_DEG
from testbed.motion.table import COLUMNS, TruthBlock

SAME_TIME_S = 1e-6
LONGEST_STEP_S = 1.5  # between rows that are joined: a receiver of 1 Hz may be late
OTHER_HEIGHT_M = 10.0  # as the sea is above the ellipsoid or below it, and no receiver all the time
DOUBTED_M, LATE_S = 10.0, 0.5  # of a solution from its receiver: more than both are off, and the receiver is late
STEPS = 3.0  # or so many of its own, where it is slower
FAR_M, FAR = 10.0, 10.0  # that a fix may be off by and count, or so many times the usual
BACK = 0.2  # of the way there, by which the way back may miss
SIDE_BY_SIDE = 2  # that may be far off together
KNOWN = {"leg": -1.0}  # columns of which something is known without a log that tells it; all others are NaN


class ReferenceMotion:
    """A motion source (`testbed.motion.table.MotionSource`) that gives ``rows`` rows of what is known of a flight.

    At the times of the reference its own rows; between two that are near each other, position on the cubic through both
    with their velocities, or the straight line where they have none, the attitude turned evenly and all else in
    proportion. NaN where there is nothing.
    """

    def __init__(self, reference: Reference, rate_hz: float, rows: int) -> None:
        self.rate_hz = rate_hz
        self.failure = ""
        self._reference, self._rows, self._tick = reference, rows, 0
        steps = np.diff(reference.t)
        usual = float(np.median(steps)) if len(steps) else 0.0
        self._longest = max(LONGEST_STEP_S, STEPS * usual)

    def advance(self, ticks: int) -> TruthBlock:
        """The next rows, fewer when the log ends."""
        n = max(min(ticks, self._rows - self._tick), 0)
        t = (self._tick + np.arange(n)) / self.rate_hz
        block = self.at(t, self._tick)
        self._tick += n
        return block

    def at(self, t: Array, tick: int = 0) -> TruthBlock:
        """What is known at the times ``t`` (N,) [s]."""
        block = TruthBlock.empty(tick, len(t))
        self._fill(block, t)
        return block

    def activity(self) -> str:
        """How far it has come."""
        return f"log {self._tick / self.rate_hz:.0f}/{(self._rows - 1) / self.rate_hz:.0f} s"

    def _fill(self, block: TruthBlock, t: Array) -> None:
        """Write the rows at ``t``."""
        block.t[:] = t
        for name in COLUMNS:
            if name != "t":
                getattr(block, name)[:] = KNOWN.get(name, np.nan)
        own = self._reference.t
        if not len(own) or not len(t):
            return
        after = np.clip(np.searchsorted(own, t - SAME_TIME_S), 0, len(own) - 1)
        at = np.abs(own[after] - t) <= SAME_TIME_S
        before = np.maximum(after - 1, 0)
        step = own[after] - own[before]
        between = ~at & (own[before] < t) & (t < own[after]) & (step <= self._longest)
        rows, i, j = np.flatnonzero(between), before[between], after[between]
        share = (t[between] - own[i]) / step[between]
        for name, values in self._reference.columns.items():
            if name in ("dtheta", "dv"):
                continue  # sums over the steps of the record, not of ticks
            column = getattr(block, name)
            column[at] = values[after[at]]
            column[rows] = values[i] if name == "leg" else _between(values[i], values[j], share)
        _turn(block, self._reference, rows, (i, j), share)
        _move(block, self._reference, rows, (i, j), share)


def _between(first: Array, second: Array, share: Array) -> Array:
    """The part ``share`` (N,) of the way from one (N, ...) to the other."""
    part = share.reshape(-1, *[1] * (first.ndim - 1))
    value: Array = first + part * (second - first)
    return value


def _turn(block: TruthBlock, reference: Reference, rows: Rows, ends: tuple[Rows, Rows], share: Array) -> None:
    """Attitude between two rows, the short way."""
    if "q_nb" not in reference.columns or not len(rows):
        return
    first, second = (reference.columns["q_nb"][end] for end in ends)
    near = np.where(np.sum(first * second, axis=1, keepdims=True) < 0, -second, second)
    q = _between(first, near, share)
    block.q_nb[rows] = q / np.linalg.norm(q, axis=1, keepdims=True)


def _move(block: TruthBlock, reference: Reference, rows: Rows, ends: tuple[Rows, Rows], share: Array) -> None:
    """Position between two rows: on Hermite's cubic where velocities are known."""
    if "lat" not in reference.columns or not len(rows):
        return
    (lat, lat_1), (lon, lon_1), (h, h_1) = (
        [reference.columns[name][end] for end in ends] for name in ("lat", "lon", "h")
    )
    way = position_difference_n(lat_1, lon_1, h_1, lat, lon, h)
    s = share[:, None]
    moved = s * way
    if "v_n" in reference.columns:
        v, v_1 = (reference.columns["v_n"][end] for end in ends)
        step = (reference.t[ends[1]] - reference.t[ends[0]])[:, None]
        cubic = (3 - 2 * s) * s * s * way + step * s * (1 - s) * ((1 - s) * v - s * v_1)
        moved = np.where(np.isfinite(cubic), cubic, moved)
    R_M, R_N = radii(lat)
    block.lat[rows] = lat + moved[:, 0] / (R_M + h)
    block.lon[rows] = wrap_longitude(lon + moved[:, 1] / ((R_N + h) * np.cos(lat)))
    block.h[rows] = h - moved[:, 2]


def is_flown(lat: npt.ArrayLike, h: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Whether an aircraft may be at latitudes [rad] and heights [m], of which there may be many."""
    north, high = np.asarray(lat, float), np.asarray(h, float)
    there: npt.NDArray[np.bool_] = np.abs(north) < math.radians(LATITUDE_LIMIT_DEG)
    there = there & (high >= ALTITUDES[0]) & (high <= ALTITUDES[1])
    return there


def doubt(solution: Reference | None, samples: Mapping[str, Samples]) -> str:
    """What there is to say of a solution that is not where the first receiver with a fix was, nothing otherwise."""
    for name, own in samples.items():
        fixes = [one for one in own if isinstance(one, GnssSample) and one.has_fix and is_flown(one.lat, one.h)]
        fixes = [one for one, wrong in zip(fixes, strays(fixes), strict=True) if not wrong]
        if fixes and solution is not None and "lat" in solution.columns:
            at = ReferenceMotion(solution, 1.0, 0).at(np.array([one.t for one in fixes]))
            there = np.array([(one.lat, one.lon, one.h) for one in fixes]).T
            off = np.hypot(*position_difference_n(at.lat, at.lon, at.h, *there)[:, :2].T)
            off = off[np.isfinite(off)]
            if apart := silence(solution, fixes[0].t, fixes[-1].t):
                return f'{apart} of {name}: truth.reference = "gnss" judges by the receiver'
            rms = float(np.sqrt(np.mean(off**2))) if len(off) else 0.0
            speeds = [speed for one in fixes if math.isfinite(speed := math.hypot(*one.v_n[:2]))]
            speed = float(np.median(speeds)) if speeds else 0.0
            if rms <= DOUBTED_M + LATE_S * speed:
                return ""
            return (
                f"{solution.name} is {rms:.3g} m (RMS) from {name}, {off.max():.3g} m at most:"
                ' truth.reference = "gnss" judges by the receiver'
            )
    return ""


def elsewhere_in_height(reference: Reference, samples: Mapping[str, Samples]) -> str:
    """That a reference is higher or lower than the first receiver all the time, nothing where it is not."""
    for name, own in samples.items():
        fixes = [one for one in own if isinstance(one, GnssSample) and one.has_fix and is_flown(one.lat, one.h)]
        if fixes and "h" in reference.columns and "lat" in reference.columns:
            h = ReferenceMotion(reference, 1.0, 0).at(np.array([one.t for one in fixes])).h
            above = h - np.array([one.h for one in fixes])
            above = above[np.isfinite(above)]
            off = float(np.median(above)) if len(above) else 0.0
            if abs(off) > OTHER_HEIGHT_M:
                where = "above" if off > 0 else "below"
                return f"{reference.name} is {abs(off):.3g} m {where} {name} (median)"
            return ""
    return ""


def silence(reference: Reference, first: float, last: float) -> str:
    """That a reference has rows, but none from ``first`` to ``last`` [s], which the caller says of what they are."""
    t = reference.t
    if not len(t) or (t[0] <= last and t[-1] >= first):
        return ""
    return f"{reference.name} is of {t[0]:.10g} to {t[-1]:.10g} s, outside of the {first:.10g} to {last:.10g} s"


def strays(fixes: Sequence[GnssSample]) -> npt.NDArray[np.bool_]:
    """Which fixes (N,) are far from the one before and from the one after, while those two agree.

    That is by how far each step is from what velocities say of it, or from nothing where there are none. Where they
    say it, two side by side are found too: without them a vehicle that hovers may have gone there and back.
    """
    found = np.zeros(len(fixes), bool)
    if len(fixes) < 3:
        return found
    t, lat, lon, h = np.array([(one.t, one.lat, one.lon, one.h) for one in fixes]).T
    v_n = np.array([one.v_n for one in fixes])

    def off(steps: int) -> tuple[Array, npt.NDArray[np.bool_]]:
        """How far each fix is from where the one so many before it, and both velocities, say [m]; if these are told."""
        said = 0.5 * (v_n[steps:] + v_n[:-steps]) * (t[steps:] - t[:-steps])[:, None]
        gone = position_difference_n(lat[steps:], lon[steps:], h[steps:], lat[:-steps], lon[:-steps], h[:-steps])
        gone -= np.where(np.isfinite(said), said, 0.0)
        return np.asarray(np.linalg.norm(gone, axis=1)), np.asarray(np.isfinite(said).all(axis=1))

    far, told = off(1)
    most = max(FAR_M, FAR * float(np.median(far)))
    for count in range(1, min(SIDE_BY_SIDE, len(fixes) - 2) + 1):
        least = np.minimum(far[:-count], far[count:])
        astray = (least > most) & (off(count + 1)[0] < BACK * least)
        if count > 1:
            astray &= told[:-count] & told[count:]
        for k in range(count):
            found[1 + k : 1 + k + len(astray)] |= astray
    return found


def of_receiver(samples: Sequence[GnssSample], name: str, point_b: Array) -> Reference:
    """A receiver's own fixes as the reference, as good as it says, of its antenna at ``point_b`` (3,); no `strays`."""
    fixes = [one for one in samples if one.has_fix]
    wrong = strays(fixes)
    fixes = [one for one, left_out in zip(fixes, wrong.tolist(), strict=True) if not left_out]
    but = f", but for {wrong.sum()} far from those before and after" if wrong.any() else ""

    def rows(key: str) -> Array:
        return np.array([getattr(one, key) for one in fixes], float)

    columns = {key: rows(key) for key in ("lat", "lon", "h")} | {"v_n": rows("v_n").reshape(-1, 3)}
    position, velocity = (usual_sigma(rows(f"sigma_{what}_n").reshape(-1, 3)) for what in ("position", "velocity"))
    told = f"{name} of the log, kept back where it is denied{but}"
    return Reference(told, rows("t"), columns, position, velocity, point_b)


def usual_sigma(told: Array) -> Array:
    """The median of what is known of each axis (3,), of (N, 3) that were told; 0 where nothing was."""
    return np.array([np.median(axis[np.isfinite(axis)]) if np.isfinite(axis).any() else 0.0 for axis in told.T])


def with_rates(reference: Reference, imu: ImuSamples, C_sb: Array) -> Reference:
    """The same with angular rates, body axes, where it has none of its own: levers swing by them.

    They are those of an IMU mounted by ``C_sb``; where its increments are none, of the next one that is.
    """
    sound = np.flatnonzero(usable(imu.dtheta, imu.dv, imu.dt))
    if "omega_b" in reference.columns or not len(reference.t) or not len(sound):
        return reference
    at = sound[np.clip(np.searchsorted(imu.t[sound], reference.t), 0, len(sound) - 1)]
    rates = imu.dtheta[at] / imu.dt[at, None] @ C_sb
    return replace(reference, columns={**reference.columns, "omega_b": rates})
