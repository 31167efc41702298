"""A star tracker: attitude against the stars."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nav._jit import njit
from nav.aids.base import Axes, Measurement, OperatingPoint, range_problem
from nav.earth import quat_en, quat_ie, radii
from nav.error_model import PHI, POS, Block
from nav.rotation import dcm_from_quat, quat_conjugate, quat_multiply, rotvec_from_quat
from nav.samples import Array, Sample, StarSample

NORM_LIMITS = (0.999, 1.001)  # of a sound attitude quaternion


@dataclass(frozen=True)
class StarAid:
    """Attitude against the stars; ``sigma`` about each body axis [rad]."""

    sensor: str = "star_tracker"
    sigma: Axes = (2.4e-5, 2.4e-5, 7.3e-5)

    parts = (("star_attitude", 3),)
    states = ()

    def blocks(self) -> list[Block]:
        """See `Aid`."""
        return []

    @cached_property
    def _R(self) -> Array:
        return np.array(self.sigma) ** 2

    def measure(self, part: str, sample: Sample, at: OperatingPoint) -> Measurement | None:
        """See `Aid`."""
        assert isinstance(sample, StarSample)
        nu, H = star_attitude(at.state.q_nb, at.state.lla, at.x, sample.t, sample.q_ib)
        return Measurement(nu, H, self._R)


def problem(sample: StarSample) -> str:
    """See `nav.aids.problem`."""
    return range_problem("norm of the quaternion", math.hypot(*sample.q_ib.tolist()), NORM_LIMITS)


@njit
def star_attitude(q_nb: Array, lla: Array, x: Array, t: float, q_ib: Array) -> tuple[Array, Array]:
    """Rotation (3,) [rad], body axes, from the estimated to the measured attitude in i, which was e at t = 0.

    nu = log(C_ib_hat' C_ib) = C_nb' (phi - dtheta) with C_ib_hat = C_ie(t) C_en_hat C_nb_hat, where the position error
    turns n by dtheta = (dE / (R_N + h), -dN / (R_M + h), -dE tan(lat) / (R_N + h)). Cui et al. 2022,
    equations 17-33 (their C_dP, here for metres north-east-down and our phi).
    """
    predicted = quat_multiply(quat_ie(t), quat_multiply(quat_en(lla[0], lla[1]), q_nb))
    nu = rotvec_from_quat(quat_multiply(quat_conjugate(predicted), q_ib))
    C_nb = dcm_from_quat(q_nb)
    R_M, R_N = radii(lla[0])
    north, east = 1 / (R_M + lla[2]), 1 / (R_N + lla[2])
    H = np.zeros((3, len(x)))
    for i in range(3):
        for j in range(3):
            H[i, PHI + j] = -C_nb[j, i]
        H[i, POS] = -C_nb[1, i] * north
        H[i, POS + 1] = (C_nb[0, i] - C_nb[2, i] * math.tan(lla[0])) * east
    return nu, H
