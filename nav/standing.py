"""Whether a vehicle stands, judged by what its inertial sensors feel: a velocity of zero that takes no sensor.

At rest all that they feel is steady. That alone is no proof, as it is so in smooth flight, too: a receiver must have
said that the vehicle stands, and since then nothing may have been felt that could have set it in motion (zero velocity
update, ZUPT: Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd ed., 15.3).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from nav.aids.gnss import has_velocity
from nav.increments import COINCIDENT, joined
from nav.samples import Array, BodyVelocitySample, GnssSample, ImuSamples, Sample

ZERO_VELOCITY = "zero_velocity"  # in place of a sensor
WINDOW_S = 1.0  # over which it is judged, and as often a velocity is told
LEAST_ROWS, LEAST_SHARE = 5, 0.9  # of increments in a window, and of its time that they must cover
# The rms of what changes within a window, all axes together. Of eight recorded aircraft six stood with engines off, at
# 0.0004 to 0.012 rad/s and 0.013 to 0.12 m/s^2 when quietest; in the air none was below 0.026 rad/s or 0.12 m/s^2.
QUIET = np.array([0.015, 0.15])  # [rad/s], [m/s^2]
STEADY = np.array([0.01, 0.1])  # by which the mean of a window may differ from those before it
REMEMBERED_S = 30.0  # over which these are averaged, as biases drift
NOISES = 3.0  # by this many sigmas of white noise more, of what is told of it
AT_REST, MOVING = 0.5, 4.0  # a receiver's speed [m/s], and times its sigma beyond that
RECENT_S = 2.0  # for how long a fix speaks
STOPPED_S = 4.0  # after a motion until one does: what gains 0.125 m/s a second is no longer at rest by then


class Standing:
    """Tells of a velocity of zero while a vehicle stands.

    ``noise`` (2,) is the white noise of gyros [rad/sqrt(s)] and accelerometers [m/s/sqrt(s)]. Windows begin with the
    first increment, so that it makes no difference how the increments are cut into blocks.
    """

    def __init__(self, noise: tuple[float, float]) -> None:
        self._noise = np.array(noise)
        self._rows: ImuSamples | None = None  # of the window that is not complete yet
        self._end = math.nan  # of that [s]
        self._fixes: list[GnssSample] = []  # that no window has heard of
        self._usual: Array | None = None  # (2, 3) what is felt at rest, None while it is not known to stand
        self._stood_at = -math.inf  # when a receiver said so last
        self._moved_at = -math.inf  # when motion was felt last

    def heard(self, imu: ImuSamples, samples: Sequence[Sample]) -> list[BodyVelocitySample]:
        """A velocity of zero at the end of each window that ends in these increments, if the vehicle stands then.

        The ``samples`` have arrived with them.
        """
        self._fixes += [one for one in samples if isinstance(one, GnssSample) and one.has_fix and has_velocity(one)]
        if not len(imu):
            return []
        if self._rows is None:
            self._end = float(imu.t[0] - imu.dt[0]) + WINDOW_S
        rows, told, first = imu if self._rows is None else joined(self._rows, imu), [], 0
        while self._end <= float(rows.t[-1]) + COINCIDENT:
            stop = int(np.searchsorted(rows.t, self._end + COINCIDENT, side="right"))
            window = ImuSamples(*(column[first:stop] for column in (rows.t, rows.dt, rows.dtheta, rows.dv)))
            if self._stands(window):
                t = float(window.t[-1])
                told.append(BodyVelocitySample(t, t, np.zeros(3), ZERO_VELOCITY))
            first, self._end = stop, self._end + WINDOW_S
        self._rows = ImuSamples(*(column[first:] for column in (rows.t, rows.dt, rows.dtheta, rows.dv)))
        return told

    def _stands(self, window: ImuSamples) -> bool:
        self._listen()
        covered = float(window.dt.sum())
        if len(window) < LEAST_ROWS or covered < LEAST_SHARE * WINDOW_S:
            return self._moves()
        felt = np.stack([window.dtheta, window.dv])  # (2, N, 3)
        mean = felt.sum(axis=1) / covered
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):  # what is not usable is not quiet
            off = felt / window.dt[:, None] - mean[:, None]
            changes = np.sqrt(np.mean(np.sum(off**2, axis=2), axis=1))
        white = math.sqrt(3) * self._noise
        quiet = np.all(changes <= np.hypot(QUIET, NOISES * white * math.sqrt(len(window) / covered)))
        if not quiet:
            return self._moves()
        if self._usual is None and self._end - self._stood_at <= RECENT_S:
            self._usual = mean
        if self._usual is None:
            return False
        off = np.linalg.norm(mean - self._usual, axis=1)
        if not np.all(off <= np.hypot(STEADY, NOISES * white / math.sqrt(covered))):
            return self._moves()
        self._usual = self._usual + (mean - self._usual) * WINDOW_S / REMEMBERED_S
        return True

    def _moves(self) -> bool:
        """It moves, or nothing is known: what receivers said before counts no more."""
        self._usual, self._stood_at, self._moved_at = None, -math.inf, self._end
        return False

    def _listen(self) -> None:
        """To the fixes that have arrived by the end of the window."""
        arrived = [fix for fix in self._fixes if fix.t_arrival <= self._end + COINCIDENT]
        self._fixes = [fix for fix in self._fixes if fix.t_arrival > self._end + COINCIDENT]
        for fix in arrived:
            speed = float(np.linalg.norm(fix.v_n))
            if speed <= AT_REST and fix.t >= self._moved_at + STOPPED_S:
                self._stood_at = max(self._stood_at, fix.t)
            elif speed > AT_REST + MOVING * float(np.linalg.norm(np.nan_to_num(fix.sigma_velocity_n))):
                self._stood_at, self._usual = -math.inf, None
