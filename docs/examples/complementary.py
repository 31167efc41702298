"""A complementary filter of attitude: gyros for the short term, gravity and the magnetic field for the long."""

import numpy as np
from scipy.spatial.transform import Rotation

from nav.samples import Estimate, MagnetometerSample

DOWN = np.array([0.0, 0.0, 1.0])


class Complementary:
    """Kind ``./complementary.py:Complementary`` with the keys ``estimates = "attitude"`` and ``time_constant_s``."""

    def __init__(self, rig, time_constant_s=10.0):
        self.gain = 1.0 / time_constant_s
        self.t, self.C_nb, self.dv = np.nan, None, np.zeros(3)

    def propagate(self, imu):
        for self.t, dt, dtheta, self.dv in zip(imu.t, imu.dt, imu.dtheta, imu.dv, strict=True):
            if self.C_nb is not None:
                self.C_nb = self.C_nb * Rotation.from_rotvec(dtheta)
                up = self.C_nb.apply(self.dv)  # velocity increments point up when nothing accelerates
                self.turn(np.cross(up, -DOWN) / np.linalg.norm(up), dt)

    def update(self, sample):
        if isinstance(sample, MagnetometerSample) and self.dv.any():
            if self.C_nb is None:
                down, east = -self.dv, np.cross(-self.dv, sample.field_b)
                axes = np.array([np.cross(east, down), east, down])
                self.C_nb = Rotation.from_matrix(axes / np.linalg.norm(axes, axis=1, keepdims=True))
            north, east, _ = self.C_nb.apply(sample.field_b)
            self.turn(-np.arctan2(east, north) * DOWN, 0.1)

    def turn(self, angle, dt):
        """Turn the attitude by a share of an error, so that it dies out within the time constant."""
        self.C_nb = Rotation.from_rotvec(self.gain * dt * angle) * self.C_nb

    def estimate(self):
        known = {} if self.C_nb is None else {"q_nb": np.roll(self.C_nb.as_quat(), 1)}
        return Estimate.of(self.t, **known)
