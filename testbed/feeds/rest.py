"""Where a recorded vehicle is at rest by its inertial unit, and what its accelerometers say there of an attitude."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from nav.rotation import quat_conjugate, quat_rotate
from nav.samples import Array, GnssSample, ImuSamples
from testbed.feeds.log import Reference, Samples
from testbed.feeds.reference import ReferenceMotion

WINDOW_S = 1.0  # over which a vehicle is judged to be at rest
REST_RATE, REST_FORCE = 0.02, 0.3  # deviation from the mean within a window [rad/s, m/s^2]
REST_SPEED = 1.0  # of GNSS [m/s]
LEAST_RESTS, LOST = 3, math.radians(10)  # windows, and what a tenth of gravity of biases does not do


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


def believed(
    solution: Reference | None, imus: Mapping[str, ImuSamples], samples: Mapping[str, Samples], notes: list[str]
) -> Reference | None:
    """An autopilot's solution; None, and a note, where at rest it lies otherwise than its accelerometers feel."""
    if solution is None or "q_nb" not in solution.columns:
        return solution
    imu = next(iter(imus.values()))
    edges = np.arange(float(imu.t[0]), float(imu.t[-1]), WINDOW_S)
    if len(edges) < 2:
        return solution
    resting = is_still(imu, edges) & ~_moves(samples, edges)
    middles = edges[:-1] + WINDOW_S / 2
    q_nb = ReferenceMotion(solution, 1.0, 0).at(middles).q_nb
    rows = np.searchsorted(imu.t, edges)
    off = []
    for k in np.flatnonzero(resting & np.isfinite(q_nb).all(axis=1)):
        felt = -imu.dv[rows[k] : rows[k + 1]].sum(axis=0)
        down = quat_rotate(quat_conjugate(q_nb[k]), np.array([0.0, 0.0, 1.0]))
        off.append(math.acos(min(max(float(felt @ down) / float(np.linalg.norm(felt)), -1.0), 1.0)))
    if len(off) < LEAST_RESTS or np.median(off) <= LOST:
        return solution
    notes.append(
        f"{solution.name} is tilted by {math.degrees(float(np.median(off))):.0f} deg (median) from what the"
        " accelerometers feel at rest: nothing is judged by it"
    )
    return None


def _moves(samples: Mapping[str, Samples], edges: Array) -> npt.NDArray[np.bool_]:
    """Whether the first receiver with a fix says so, in each window, or nothing; without one, nobody does."""
    for own in samples.values():
        fixes = [one for one in own if isinstance(one, GnssSample) and one.has_fix]
        if fixes:
            slow = np.array([one.t for one in fixes if math.hypot(*one.v_n[:2]) < REST_SPEED])
            fast = np.array([one.t for one in fixes if not math.hypot(*one.v_n[:2]) < REST_SPEED])
            found = np.histogram(slow, edges)[0] == 0
            return np.asarray(found | (np.histogram(fast, edges)[0] > 0))
    return np.zeros(len(edges) - 1, bool)
