"""Where a recorded vehicle is at rest by its inertial units, and what their accelerometers say there of an attitude."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from nav.earth import STANDARD_GRAVITY
from nav.rotation import quat_conjugate, quat_rotate
from nav.samples import Array, GnssSample, ImuSamples
from testbed.feeds.log import Reference, Samples
from testbed.feeds.reference import ReferenceMotion

WINDOW_S = 1.0  # over which a vehicle is judged to be at rest
REST_RATE, REST_FORCE = 0.02, 0.3  # deviation from the mean within a window [rad/s, m/s^2]
REST_SPEED = 1.0  # of GNSS [m/s]
FORCE_SHARE = 0.2  # of gravity, by which a force at rest may be off: accelerometers that were never calibrated
LEAST_RESTS = 3  # windows, each with one at rest on either side
MOST_TILT_OFF = math.radians(10)  # as much as a sixth of gravity of biases makes


def is_still(imu: ImuSamples, edges: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Whether rates and forces are steady, in each window between ``edges`` (N + 1,) [s]."""
    rows = np.searchsorted(imu.t, edges)
    rates, forces = imu.dtheta / imu.dt[:, None], imu.dv / imu.dt[:, None]
    found = np.zeros(len(rows) - 1, bool)
    for k, (first, stop) in enumerate(itertools.pairwise(rows)):
        if stop - first > 1:
            steady = (rates[first:stop].std(axis=0) < REST_RATE) & (forces[first:stop].std(axis=0) < REST_FORCE)
            found[k] = steady.all()
    return found


def tilt_off(solution: Reference, imus: Mapping[str, ImuSamples], samples: Mapping[str, Samples]) -> float:
    """The angle [rad] from what is down for a solution to what is down for an accelerometer: median of the rests.

    Of several units that which agrees best; zero without attitude, or hardly a rest. A steady turn can't be told from a
    rest but by a receiver's speed: where there is one with fixes, a window without them is none.
    """
    if "q_nb" not in solution.columns:
        return 0.0
    found = [_tilt_off(solution, imu, samples) for imu in imus.values() if len(imu) > 1]
    return min((float(np.median(off)) for off in found if len(off) >= LEAST_RESTS), default=0.0)


def tilted(solution: Reference, imus: Mapping[str, ImuSamples], samples: Mapping[str, Samples]) -> str:
    """That a solution does not lie as its accelerometers feel, at rest; empty where it does."""
    off = tilt_off(solution, imus, samples)
    if off <= MOST_TILT_OFF:
        return ""
    return f"{solution.name} and what the accelerometers feel at rest are {math.degrees(off):.0f} deg apart (median)"


def refusal(solution: Reference, imus: Mapping[str, ImuSamples], samples: Mapping[str, Samples]) -> str:
    """Why nothing may be judged by a solution, a sentence; empty where it lies as its accelerometers feel, at rest."""
    off = tilted(solution, imus, samples)
    return f"{off}: nothing is judged by it" if off else ""


def _tilt_off(solution: Reference, imu: ImuSamples, samples: Mapping[str, Samples]) -> list[float]:
    """`tilt_off` of one unit, in each window at rest."""
    windows = np.unique(np.floor((imu.t - imu.t[0]) / WINDOW_S))  # there may be days between two
    edges = float(imu.t[0]) + WINDOW_S * np.unique(np.concatenate([windows, windows + 1]))
    resting = is_still(imu, edges) & ~_moves(samples, edges)
    resting[1:-1] &= resting[:-2] & resting[2:]
    resting[[0, -1]] = False
    q_nb = ReferenceMotion(solution, 1.0, 0).at(edges[:-1] + WINDOW_S / 2).q_nb
    rows = np.searchsorted(imu.t, edges)
    off = []
    for k in np.flatnonzero(resting & np.isfinite(q_nb).all(axis=1)):
        part = slice(int(rows[k]), int(rows[k + 1]))
        felt = -imu.dv[part].sum(axis=0) / imu.dt[part].sum()
        force = float(np.linalg.norm(felt))
        if abs(force / STANDARD_GRAVITY - 1) < FORCE_SHARE:
            down = quat_rotate(quat_conjugate(q_nb[k]), np.array([0.0, 0.0, 1.0]))
            off.append(math.acos(min(max(float(felt @ down) / force, -1.0), 1.0)))
    return off


def _moves(samples: Mapping[str, Samples], edges: Array) -> npt.NDArray[np.bool_]:
    """In each window, whether the first receiver that ever has a fix has none, or one of some speed or of none known.

    Where no receiver ever has a fix, nowhere.
    """
    for own in samples.values():
        fixes = [one for one in own if isinstance(one, GnssSample) and one.has_fix]
        if fixes:
            t = np.array([one.t for one in fixes])
            slow = np.array([math.hypot(*one.v_n[:2]) < REST_SPEED for one in fixes])
            return np.asarray((np.histogram(t[slow], edges)[0] == 0) | (np.histogram(t[~slow], edges)[0] > 0))
    return np.zeros(len(edges) - 1, bool)
