"""A published filter as an estimator: Laidig and Seel's VQF (package ``vqf``, Information Fusion 91 (2023))."""

import numpy as np
from vqf import VQF

from nav.rotation import quat_multiply
from nav.samples import Estimate, MagnetometerSample

ENU_TO_NED = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])  # the same turn in both directions


class Published:
    """Kind ``./published.py:Published`` with the key ``estimates = "attitude"``. VQF's world is east-north-up."""

    def __init__(self, rig, imu="imu"):
        self.filter = VQF(1.0 / rig.sensors[imu].rate_hz)
        self.t, self.seen = np.nan, False

    def propagate(self, imu):
        for dt, dtheta, dv in zip(imu.dt, imu.dtheta, imu.dv, strict=True):
            self.filter.updateGyr(np.ascontiguousarray(dtheta / dt))
            self.filter.updateAcc(np.ascontiguousarray(dv / dt))
        self.t = imu.t[-1]

    def update(self, sample):
        if isinstance(sample, MagnetometerSample):
            self.filter.updateMag(np.ascontiguousarray(sample.field_b))
            self.seen = True

    def estimate(self):
        if not self.seen:
            return Estimate.of(self.t)
        return Estimate.of(self.t, q_nb=quat_multiply(ENU_TO_NED, self.filter.getQuat9D()))
