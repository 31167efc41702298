"""Attitude and heading without position: gyros, levelled by the accelerometers while nothing else accelerates them.

Six error states, attitude error phi and gyro bias error, both estimate - truth in the conventions of `nav`:

    phi' = -[w_ie x] phi + C_nb b_g,    b_g a random walk

Once per ``period_s`` the mean specific force in computed n axes is examined. Without acceleration its horizontal part
is tilt, f_N = g phi_E, f_E = -g phi_N, and `nav.motion.LowDynamics` says whether there is none. With an airspeed sensor
the acceleration in a steady wind is known (`nav.motion.acceleration_n`) and is taken off first, so that slow turns do
no harm and a loiter can be levelled in too. The correction reaches the attitude in steps of at most ``phi_limit`` per
period, so that an autopilot on it feels no jump; the filter keeps in mind what is still outstanding. Heading is the
gyro's alone, unless there is a magnetometer.

Source: Jiang et al. 2021, attitude of a low-grade inertial system without satellite navigation, equations 5 to 11,
turned from north-up-east to north-east-down.
"""

from nav.ahrs.config import LEVEL, MAGNETIC_HEADING, AhrsConfig, AnyMotion, Correction, limited
from nav.ahrs.filter import Ahrs
from nav.ahrs.state import BIAS, PHI, STATES, transition

__all__ = [
    "BIAS",
    "LEVEL",
    "MAGNETIC_HEADING",
    "PHI",
    "STATES",
    "Ahrs",
    "AhrsConfig",
    "AnyMotion",
    "Correction",
    "limited",
    "transition",
]
