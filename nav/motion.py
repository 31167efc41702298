"""How the body moves, judged from the inertial sensors: low dynamics, turns, and the acceleration that airspeed tells.

In low dynamics the accelerometers feel gravity alone, and what they show horizontally is tilt (Jiang et al. 2021). In a
turn course and heading part (Cheng et al. 2020). Between the two lies flight in a steady wind with an airspeed sensor:
its acceleration is that of the velocity through the air, which turns with the body, and can be taken off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from nav._jit import inlined
from nav.earth import SEA_LEVEL_DENSITY, isa_density, pressure_altitude
from nav.samples import Array, ImuSamples

AIRSPEED_VALID_S = 2.0  # an airspeed is good for as long


@dataclass(frozen=True, slots=True)
class Motion:
    """What `LowDynamics` measured, ``acceleration`` [m/s^2], ``yaw_rate``, ``roll_rate`` [rad/s]; the tests failed."""

    acceleration: float
    yaw_rate: float
    roll_rate: float
    failed: tuple[str, ...]

    @property
    def low(self) -> bool:
        """Whether all tests passed."""
        return not self.failed


@dataclass(frozen=True, slots=True)
class LowDynamics:
    """Whether the body is hardly accelerated: three tests on means over a second, and what the autopilot commands.

    ``acceleration_limit`` [m/s^2] on what specific force shows beyond gravity, ``yaw_rate_limit`` and
    ``roll_rate_limit`` [rad/s] on the rates about body z and x. The ``norm`` test takes ``| |f| - g |``, which no
    attitude error can deceive, but which sees of a horizontal acceleration a only a^2 / 2g. The ``vector`` test takes
    ``|f_n - [0, 0, -g]|``, which sees all of it and its own tilt as well: tilted by more than asin(limit / g), 1.17 deg
    with the paper's limit, it never passes again, and a filter that waits for it never levels.

    Source: Jiang et al. 2021, section on the low-dynamics criterion; limits are the paper's.
    """

    acceleration_limit: float = 0.2
    yaw_rate_limit: float = math.radians(0.5)
    roll_rate_limit: float = math.radians(2.0)
    test: Literal["norm", "vector"] = "norm"

    def judge(self, f_n: Array, omega_b: Array, g: float, autopilot_level: bool = True) -> Motion:
        """Judge mean specific force ``f_n`` (3,) [m/s^2], known accelerations taken off, and angular rate ``omega_b``
        (3,) [rad/s]; ``g`` [m/s^2] is gravity. Values that are not finite fail.
        """
        shown = np.empty(3)
        passed = passes(f_n, omega_b, g, self.numbers, shown)
        tests = zip(("acceleration", "yaw rate", "roll rate", "autopilot"), (*passed, autopilot_level), strict=True)
        acceleration, yaw_rate, roll_rate = shown.tolist()
        return Motion(acceleration, yaw_rate, roll_rate, tuple(name for name, ok in tests if not ok))

    @property
    def numbers(self) -> Array:
        """The limits (3,), and whether acceleration is that of the vector: as `passes` is told them."""
        limits = self.acceleration_limit, self.yaw_rate_limit, self.roll_rate_limit
        return np.array([*limits, float(self.test == "vector")])


@inlined
def passes(f_n: Array, omega_b: Array, g: float, limits: Array, shown: Array) -> tuple[bool, bool, bool]:
    """The three tests of `LowDynamics.judge` with ``limits`` (4,); acceleration, yaw and roll rate into ``shown``."""
    north, east, down = f_n[0], f_n[1], f_n[2]
    if limits[3] == 0.0:
        shown[0] = abs(math.sqrt(north * north + east * east + down * down) - g)
    else:
        shown[0] = math.sqrt(north * north + east * east + (down + g) * (down + g))
    shown[1], shown[2] = abs(omega_b[2]), abs(omega_b[0])
    return shown[0] <= limits[0], shown[1] <= limits[1], shown[2] <= limits[2]


class TurnDetector:
    """Straight is when |omega_z| stayed below ``rate_limit`` [rad/s] during the whole last ``quiet_s`` [s].

    Source: Cheng et al. 2020, equation 24, kappa and T0. The paper gives no values: the limit must exceed gyro bias and
    noise.
    """

    def __init__(self, rate_limit: float = math.radians(2.0), quiet_s: float = 2.0) -> None:
        self.rate_limit = rate_limit
        self.quiet_s = quiet_s
        self._quiet_since = math.nan

    def push(self, imu: ImuSamples) -> None:
        """Add consecutive increments."""
        if len(imu) == 0:
            return
        if math.isnan(self._quiet_since):
            self._quiet_since = float(imu.t[0] - imu.dt[0])
        turning = ~(np.abs(imu.dtheta[:, 2]) < self.rate_limit * imu.dt)
        if turning.any():
            self._quiet_since = float(imu.t[np.flatnonzero(turning)[-1]])

    def straight(self, t: float) -> bool:
        """Whether the motion up to ``t`` [s], the end of the newest increment, was straight for long enough."""
        return t - self._quiet_since >= self.quiet_s


class TrueAirspeed:
    """True airspeed [m/s] from samples of equivalent airspeed, smoothed over gusts.

    A gust changes airspeed at once and the body's velocity hardly: what is shorter than ``smoothing_s`` [s] says
    nothing of acceleration. Density is that of the standard atmosphere at ``h`` [m], or, once there is a barometer, at
    the static pressure it shows. ``numbers`` (3,) are all that it knows, for kernels: true over equivalent airspeed,
    the smoothed equivalent airspeed [m/s], and its time [s].
    """

    def __init__(self, h: float, smoothing_s: float) -> None:
        self.smoothing_s = smoothing_s
        self.numbers = np.array([math.sqrt(SEA_LEVEL_DENSITY / isa_density(h)), math.nan, -math.inf])

    def add_eas(self, t: float, eas: float) -> None:
        """Add an equivalent airspeed [m/s] at ``t`` [s]."""
        add_eas(self.numbers, t, eas, self.smoothing_s)

    def add_pressure(self, pressure: float) -> None:
        """Add a static pressure [Pa]."""
        self.numbers[0] = true_over_equivalent(pressure)

    def lose(self) -> None:
        """Forget the speed: the sensor says nothing that can be used."""
        self.numbers[2] = -math.inf

    def at(self, t: float) -> float:
        """The speed at ``t`` [s], NaN when the newest sample is too old."""
        return true_airspeed(self.numbers, t)


def true_over_equivalent(pressure: float) -> float:
    """Ratio of the airspeeds where the static pressure is so much [Pa]."""
    return math.sqrt(SEA_LEVEL_DENSITY / isa_density(pressure_altitude(pressure)))


@inlined
def add_eas(numbers: Array, t: float, eas: float, smoothing_s: float) -> None:
    """`TrueAirspeed.add_eas`."""
    dt = t - numbers[2]
    numbers[1] = eas if dt > AIRSPEED_VALID_S else numbers[1] + (eas - numbers[1]) * -math.expm1(-dt / smoothing_s)
    numbers[2] = t


@inlined
def true_airspeed(numbers: Array, t: float) -> float:
    """`TrueAirspeed.at`."""
    speed: float = numbers[0] * numbers[1] if t - numbers[2] <= AIRSPEED_VALID_S else math.nan
    return speed


@inlined
def acceleration_n(air_velocity_before_n: Array, air_velocity_n: Array, T: float) -> Array:
    """Mean acceleration (3,) [m/s^2] over ``T`` [s] from the velocity through the air [m/s], which points forward.

    In a steady wind it is the body's acceleration: the mean of C_nb (omega x [V, 0, 0] + [dV/dt, 0, 0]), integrated
    without error. NaN where a velocity is unknown.
    """
    now, before = air_velocity_n, air_velocity_before_n
    return np.array([(now[0] - before[0]) / T, (now[1] - before[1]) / T, (now[2] - before[2]) / T])
