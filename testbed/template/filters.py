"""An estimator of your own: strapdown navigation, pulled towards GNSS and the magnetometer by fixed gains.

Frames and signs are those of `nav` (see ``nav/__init__.py``). Change what you like: `first.toml` flies it beside ours.
"""

import math

import numpy as np

from nav import strapdown
from nav.rotation import dcm_from_quat, quat_from_euler, quat_from_rotvec, quat_multiply
from nav.samples import Array, Estimate, FixType, GnssSample, ImuSamples, MagnetometerSample, Sample
from testbed.estimators.rig import Rig
from testbed.sensors.magnetometer import geomagnetic_field_n

POSITION_GAIN = 0.1  # share of a difference that one fix takes away
VELOCITY_GAIN = 0.06
TILT_GAIN = 0.003  # [1/s] how much tilt explains a difference in velocity
SIGMAS = [1.5, 1.5, 1.5, 0.1, 0.1, 0.1, 0.006, 0.006, 0.03]  # claimed: position [m], velocity [m/s], attitude [rad]


class Mine:
    """An observer: it takes increments, looks at samples, and answers with an estimate."""

    def __init__(self, rig: Rig, heading_gain: float = 0.02) -> None:
        """Begin without a state; ``heading_gain`` is a key of its ``[[estimator]]``."""
        site = rig.site
        self.heading_gain = heading_gain
        self.north = _azimuth(geomagnetic_field_n(site.lat, site.lon, site.h, site.date))  # of the field
        self.t = 0.0
        self.f_b = np.zeros(3)  # specific force now
        self.field_b: Array | None = None
        self.begun = False  # from then on there are:
        self.q_nb, self.v_n, self.lla = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.zeros(3)

    def propagate(self, imu: ImuSamples) -> None:
        """Advance by a block of increments."""
        self.t, self.f_b = float(imu.t[-1]), imu.dv[-1] / imu.dt[-1]
        if self.begun:
            increments = (np.array(block) for block in (imu.dtheta, imu.dv, imu.dt))
            strapdown.propagate(self.q_nb, self.v_n, self.lla, *increments)

    def update(self, sample: Sample) -> None:
        """Use a sample that is valid now. What it has no use for, it leaves alone."""
        match sample:
            case MagnetometerSample():
                self.field_b = sample.field_b
                if self.begun:
                    error = self.north - _azimuth(dcm_from_quat(self.q_nb) @ sample.field_b)
                    self._turn(np.array([0.0, 0.0, self.heading_gain * math.remainder(error, math.tau)]))
            case GnssSample(fix_type=FixType.FIX_3D):
                if self.begun:
                    self._correct(sample)
                else:
                    self._begin(sample)

    def estimate(self) -> Estimate:
        """What it knows now; all NaN, and not aligned, before it has begun."""
        if not self.begun:
            return Estimate.of(self.t)
        return Estimate.of(
            self.t, q_nb=self.q_nb.copy(), v_n=self.v_n.copy(), lla=self.lla.copy(), covariance=np.diag(SIGMAS) ** 2
        )

    def _begin(self, fix: GnssSample) -> None:
        """Level by the specific force, heading by the magnetometer, the rest by a fix."""
        if self.field_b is None:
            return
        x, y, z = self.f_b
        roll, pitch = math.atan2(-y, -z), math.atan2(x, math.hypot(y, z))
        level_b = dcm_from_quat(quat_from_euler(roll, pitch, 0.0)) @ self.field_b
        self.q_nb = quat_from_euler(roll, pitch, self.north - _azimuth(level_b))
        self.v_n[:], self.lla[:] = fix.v_n, (fix.lat, fix.lon, fix.h)
        self.begun = True

    def _correct(self, fix: GnssSample) -> None:
        """Towards a fix; a tilt turns the specific force, so an error in velocity tells of it."""
        error = self.v_n - fix.v_n
        f_n = dcm_from_quat(self.q_nb) @ self.f_b
        self.lla += POSITION_GAIN * (np.array([fix.lat, fix.lon, fix.h]) - self.lla)
        self.v_n -= VELOCITY_GAIN * error
        self._turn(TILT_GAIN * np.cross(error, f_n) / (f_n @ f_n))

    def _turn(self, phi: Array) -> None:
        """Turn the attitude by a small angle about the axes of n."""
        self.q_nb = quat_multiply(quat_from_rotvec(phi), self.q_nb)


def _azimuth(v_n: Array) -> float:
    return math.atan2(v_n[1], v_n[0])
