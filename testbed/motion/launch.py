"""From rest into the air: an aircraft is held still on its launcher, engine at idle, and let go.

`SPIN_UP_S` after its engine was asked for full power the launcher pushes it straight along its nose, with constant
acceleration, from rest to the launch speed, and leaves it there. Until then neither air nor propeller nor gravity moves
it: the launcher bears them all. So there are no wheels, and no ground that it could roll on.

Everything is counted in ticks, so the result does not depend on how a flight is advanced.
"""

from __future__ import annotations

import math
from array import array

from nav.earth import radii
from testbed.motion.aircraft import Launch
from testbed.motion.sections import FlightTruth

SPIN_UP_S = 2.0  # from full power, or from the throttle of somebody else that is up, to the push
THROTTLE_UP = 0.5  # of somebody else who flies: that asks for the launch


class Launcher:
    """When it pushes and lets go, and where the aircraft is meanwhile.

    ``full_power`` is the tick at which the engine is asked for it, None as long as nobody has; ``release`` the tick at
    which the aircraft is free, one of those ``frame`` ticks apart at which guidance is asked.
    """

    def __init__(self, launch: Launch, truth: FlightTruth, frame: int) -> None:
        self.full_power: int | None = round((truth.start.rest_s - SPIN_UP_S) * truth.rate_hz)
        self.speed = launch.speed_mps
        self._rate, self._frame = truth.rate_hz, frame
        self._pushed = max(1, math.ceil(2 * launch.length_m / launch.speed_mps * truth.rate_hz))  # ticks
        pitch, heading = math.radians(launch.pitch_deg), math.radians(truth.start.heading_deg)
        self._nose = math.cos(pitch) * math.cos(heading), math.cos(pitch) * math.sin(heading), -math.sin(pitch)

    @property
    def release(self) -> float:
        """The tick at which the aircraft is free; infinite as long as nobody has asked for power."""
        if self.full_power is None:
            return math.inf
        earliest = self.full_power + round(SPIN_UP_S * self._rate) + self._pushed
        return self._frame * math.ceil(earliest / self._frame)

    def wait(self) -> None:
        """Launch when somebody else's throttle is up, not before."""
        self.full_power = None

    def hear(self, throttle: float, tick: int) -> None:
        """The throttle of somebody else, from 0 to 1, at a tick."""
        if self.full_power is None and throttle > THROTTLE_UP:
            self.full_power = tick

    def push(self, rows: array[float], width: int, tick: int, unit: float) -> None:
        """Move ``rows``, which end at ``tick`` and are those of an aircraft at rest, along the launcher.

        A row has ``width`` numbers, first latitude, longitude [rad], height and velocity, NED, in ``unit`` [m].
        """
        first = self.release - self._pushed
        for back in range(len(rows) // width):
            ticks = tick - back - first
            if ticks <= 0:
                return
            speed = self.speed * ticks / self._pushed
            way = 0.5 * speed * ticks / self._rate
            at = len(rows) - (back + 1) * width
            lat, h = rows[at], unit * rows[at + 2]
            R_M, R_N = radii(lat)
            north, east, down = self._nose
            rows[at] += way * north / (R_M + h)
            rows[at + 1] += way * east / ((R_N + h) * math.cos(lat))
            rows[at + 2] -= way * down / unit
            for axis, share in enumerate(self._nose):
                rows[at + 3 + axis] = speed * share / unit

    def activity(self, tick: int) -> str:
        """What is going on at a tick."""
        if self.full_power is None:
            return "at rest, until somebody flies"
        return f"at rest, launched in {max(self.release - tick, 0.0) / self._rate:.0f} s"
