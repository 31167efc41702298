"""Finding the attitude again that a filter has begun with wrongly, or lost, while it is sure of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy

import numpy as np

from nav.alignment import Alignment, InitialState
from nav.detection import Refusals, chi_square_threshold
from nav.earth import displacement_n
from nav.error_model import PHI, POS
from nav.rotation import quat_conjugate, quat_from_dcm, quat_multiply, rotvec_from_quat
from nav.samples import GnssSample, ImuSamples, Outcome, Sample, UpdateReport
from nav.state import State
from nav.velocity_matching import Matched

DOUBT_S = 1.0  # what is refused for so long may be right
BELIEVED_S = 10.0  # after so long without a refusal, and since it began, the filter is believed
FALSE_ALARM = 1e-4  # probability that two attitudes as good as they claim contradict each other
REFUSED = (Outcome.OUTSIDE_GATE, Outcome.ISOLATED)
LIMIT = chi_square_threshold(FALSE_ALARM, 3)
LEAST = 1e-6  # of a filter's own [rad]
ELSEWHERE = 5.0  # sigmas
GRAVITY = 9.8  # [m/s^2]
TURN, PLACE = slice(PHI, PHI + 3), range(POS, POS + 2)


class HeadingRecovery:
    """Finds the attitude by the accelerations that change a receiver's velocity, while a filter refuses samples.

    Where a heading is off by a radian, what is felt along one axis is taken for another: velocity and tilt go wrong,
    fixes and fields leave their gates, and what corrections remain go along wrong axes. `nav.velocity_matching` asks
    nothing of the filter. A receiver that is pulled away steadily would tell of a tilt that is not there: so a pull is
    estimated beside (`nav.alignment.PULL`). One that is farther away than a wrong attitude could have led in the time
    is not believed, nor, but for what follows, is any while positions are fused: then no attitude has led the filter
    away, and what is refused is wrong. It is the receiver that the ``alignment`` was made for.

    A filter that has just begun is doubted too, though it fuses everything: what it began on was one reading of a
    compass, or a course, which bends biases and iron to itself until nothing contradicts it clearly any more.
    """

    def __init__(self, alignment: Alignment) -> None:
        self._beginning = alignment.by_accelerations()
        self.begin(math.inf)

    def begin(self, t: float) -> None:
        """The filter begins at ``t`` [s], inf before it does: nothing was refused so far."""
        self._refusals: dict[str, Refusals] = {}
        self._begun_at = self._doubted_at = self._refused_at = t
        self._alignment = deepcopy(self._beginning) if math.isfinite(t) else None

    @property
    def under_way(self) -> bool:
        """Whether it is to have increments."""
        return self._alignment is not None

    def propagate(self, imu: ImuSamples) -> None:
        """Add a block of increments."""
        if len(imu):
            self._forget(float(imu.t[-1]))
        if self._alignment is not None:
            self._alignment.propagate(imu)

    def took(self, sensor: str) -> None:
        """A sample of a sensor was used, whole."""
        if sensor in self._refusals:
            self._refusals[sensor].taken()

    def hear(self, sample: Sample, reports: Sequence[UpdateReport]) -> None:
        """What became of a sample."""
        self._forget(sample.t)
        if any(report.outcome in REFUSED for report in reports):
            if self._refusals.setdefault(sample.sensor, Refusals(DOUBT_S)).too_long(sample.t):
                self._refused_at = sample.t
                if self._alignment is None:
                    self._doubted_at, self._alignment = sample.t, deepcopy(self._beginning)
        elif reports:
            self.took(sample.sensor)

    def _forget(self, t: float) -> None:
        """Look for no attitude any more where nothing was refused for long, whenever that is noticed."""
        if t - self._refused_at > BELIEVED_S:
            self._alignment = None

    def follow(self, sample: Sample) -> None:
        """A sound sample whose position, if it has one, was used: by it nothing begins anew."""
        if isinstance(sample, GnssSample) and self._alignment is not None and self._found(self._alignment, sample):
            self._alignment.go_on(sample)

    def judge(self, state: State, filters: int, sample: Sample, last_fused: float) -> InitialState | None:
        """Where to begin anew, given a sound sample, which was heard of; None where nothing contradicts the attitude.

        The ``state``, of so many filters, is settled at the sample's time; a position was ``last_fused`` then [s].
        """
        if self._alignment is None or not isinstance(sample, GnssSample):
            return None
        found = self._found(self._alignment, sample)
        if found is None:
            return None
        initial, matched = found
        doubted = sample.t - last_fused > DOUBT_S or sample.t - self._begun_at <= BELIEVED_S
        if doubted and _contradicts(matched, state, filters) and self._could_be(sample, state, filters):
            return initial
        self._alignment.go_on(sample)
        return None

    @staticmethod
    def _found(alignment: Alignment, fix: GnssSample) -> tuple[InitialState, Matched] | None:
        """What an alignment has found by a fix, if it is one of its receiver."""
        initial = alignment.add_gnss(fix, None) if fix.sensor == alignment.receiver else None
        return None if initial is None or alignment.matched is None else (initial, alignment.matched)

    def _could_be(self, fix: GnssSample, state: State, filters: int) -> bool:
        """Whether the filter may have gone from a fix, over ground, by taking what it felt for the opposite."""
        north, east, _ = displacement_n(fix.lat, fix.lon, fix.h, *state.lla.tolist())
        doubted = fix.t - self._doubted_at + DOUBT_S
        known = state.P[:filters, PLACE, PLACE].min(axis=0) + fix.sigma_position_n[:2] ** 2
        return math.hypot(north, east) <= GRAVITY * doubted**2 + ELSEWHERE * math.sqrt(known.sum())


def _contradicts(found: Matched, state: State, filters: int) -> bool:
    """Whether an attitude is where that of the filters together can't be."""
    turn = rotvec_from_quat(quat_multiply(quat_from_dcm(found.C_nb), quat_conjugate(state.q_nb)))
    each = state.P[:filters, TURN, TURN] + LEAST**2 * np.eye(3)
    known = np.linalg.inv(np.linalg.inv(each).sum(axis=0))
    return bool(turn @ np.linalg.solve(known + found.covariance, turn) > LIMIT)
