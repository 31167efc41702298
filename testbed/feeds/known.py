"""What estimators are told of the motion: a state handed over at the start, and what the autopilot commands.

Nothing else of the truth leaves the feed for them.
"""

from __future__ import annotations

import math

import numpy as np

from nav.alignment import InitialState
from nav.earth import radii, wrap_longitude
from nav.rotation import quat_from_rotvec, quat_multiply, quat_rotate
from testbed.estimators.lane import Commanded, HandoverErrors
from testbed.motion.table import TruthBlock


def handed_over(errors: HandoverErrors, truth: TruthBlock) -> InitialState:
    """A start by somebody else's navigation: the first row of ``truth`` where the IMU sits, plus errors drawn here."""
    phi, v_error, p_error = (errors.sigma * errors.random.standard_normal(len(errors.sigma))).reshape(3, 3)
    true_q = truth.q_nb[0]
    v_n = truth.v_n[0] + quat_rotate(true_q, np.cross(truth.omega_b[0], errors.arm_b)) + v_error
    north, east, down = quat_rotate(true_q, errors.arm_b) + p_error
    lat, lon, h = float(truth.lat[0]), float(truth.lon[0]), float(truth.h[0])
    R_M, R_N = radii(lat)
    # C_nb_hat = (I - [phi x]) C_nb
    q_nb = quat_multiply(quat_from_rotvec(-phi), true_q)
    return InitialState(
        float(truth.t[0]), lat + north / (R_M + h), wrap_longitude(lon + east / ((R_N + h) * math.cos(lat))),
        h - down, v_n, q_nb, np.diag(errors.sigma**2),
    )  # fmt: skip


def commanded(truth: TruthBlock) -> Commanded:
    """What the autopilot commands over the rows of a block: it knows its own commands, so they are no truth."""
    return Commanded(truth.t, truth.commands[:, 0], truth.commands[:, 1], truth.commands[:, 2])
