"""Whether a reference turns as gyros feel: it tells of an attitude in other axes or another order what rest may not."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from nav.rotation import quat_conjugate, quat_multiply, rotvec_from_quat
from nav.samples import ImuSamples
from testbed.feeds.log import Reference

STRETCH_S = 1.0  # over which turns are compared
LONGEST_S = 1.5  # of which there may be no row
LEAST_TURN, MOST_TURN = math.radians(3), math.radians(60)  # more is no sum of increments
LEAST_STRETCHES = 10
MOST_OFF = 0.5  # of the turns: gyros that nobody calibrated make 0.2


def turns_otherwise(reference: Reference, imus: Mapping[str, ImuSamples]) -> str:
    """That its attitude turns otherwise than the gyros of the first unit; empty where it does not, or nothing tells.

    Compared are log(q_k^-1 q_k+1), body axes, and the sum of the increments between, in stretches of `STRETCH_S`.
    """
    if "q_nb" not in reference.columns:
        return ""
    name, imu = next((name, imu) for name, imu in imus.items() if len(imu))
    t, q_nb = reference.t, reference.columns["q_nb"]
    known = np.isfinite(q_nb).all(axis=1) & (t >= imu.t[0]) & (t <= imu.t[-1])
    t, q_nb = t[known], q_nb[known]
    if len(t) < LEAST_STRETCHES:
        return ""
    rows = np.unique(np.searchsorted(t, np.arange(t[0], t[-1], STRETCH_S)))
    t, q_nb = t[rows], q_nb[rows]
    at = np.concatenate([imu.t[:1] - imu.dt[:1], imu.t])
    summed = np.concatenate([np.zeros((1, 3)), np.cumsum(np.nan_to_num(imu.dtheta), axis=0)])
    felt = np.diff(np.column_stack([np.interp(t, at, axis) for axis in summed.T]), axis=0)
    turned = np.array([rotvec_from_quat(quat_multiply(quat_conjugate(a), b)) for a, b in pairwise(q_nb)]).reshape(-1, 3)
    size = np.maximum(np.linalg.norm(felt, axis=1), np.linalg.norm(turned, axis=1))
    told = (np.diff(t) <= LONGEST_S) & (size >= LEAST_TURN) & (size <= MOST_TURN)
    if told.sum() < LEAST_STRETCHES:
        return ""
    off, turn = np.median(np.linalg.norm(felt - turned, axis=1)[told]), np.median(size[told])
    if off <= MOST_OFF * turn:
        return ""
    apart = f"{math.degrees(off):.3g} of {math.degrees(turn):.3g} deg in {STRETCH_S:g} s (medians)"
    return f"{reference.name} turns otherwise than the gyros of {name} feel, by {apart}"
