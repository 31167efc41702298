"""Aligning anew, when an attitude's error is not small any more: increments were missing for long, or it was wrong."""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from copy import deepcopy
from dataclasses import replace
from typing import Protocol

import numpy as np

from nav._jit import njit
from nav.aids.gnss import has_velocity
from nav.alignment import USUAL_ACCELERATION, Alignment, InitialState, whole
from nav.earth import SEA_LEVEL_DENSITY, displacement_n, isa_density
from nav.error_model import PHI, POS, VEL
from nav.heading_recovery import HeadingRecovery
from nav.reference import Reference, align
from nav.rotation import dcm_from_quat, skew
from nav.samples import (
    AirspeedSample,
    Array,
    FixType,
    GnssSample,
    ImuSamples,
    MagnetometerSample,
    Outcome,
    Sample,
    UpdateReport,
)
from nav.smoother import Smoother
from nav.state import State

LOST_TILT = 0.5  # roll or pitch, 1 sigma [rad]
GRAVITY = 9.8  # [m/s^2]
DV, DP = range(VEL, VEL + 3), range(POS, POS + 3)
TURNED, MOVED = slice(PHI, PHI + 3), slice(VEL, VEL + 3)
WAIT_S = 5.0  # the longest that samples are withheld for an alignment,
LONG_S = 30.0  # the same of one that has no compass, and that one goes on though the tilt seems to be known again
ELSEWHERE = 5.0  # sigmas
CRAWLING = np.array([1.0, 0.0, 0.0])  # neither at rest, where gyros may tell the heading, nor on a course [m/s]
WIND, SLIP = 8.0, 3.0  # where no filter has one, and across the nose [m/s]
SWING = 1.0  # of an antenna about the IMU, in a body whose turns nobody knows [rad/s]


class Startable(Protocol):
    """An estimator that can begin anew."""

    def start(self, initial: InitialState) -> None:
        """Begin at a given state."""
        ...

    def refuse(self, sample: Sample, reason: str, outcome: Outcome) -> list[UpdateReport]:
        """Reports on a sample that is not used."""
        ...


class Realignment:
    """Watches how well an estimator knows its attitude, and aligns it anew when that was lost by missing increments.

    A correction of an attitude that is off by half a radian goes along wrong axes, and the covariance shrinks as if it
    did not. So the fixes of one receiver, and samples of the ``sensors``, go to an alignment, which is as ``alignment``
    at its beginning and knows nothing of before. All are withheld from the filters, whose velocity and position are
    those of the receiver meanwhile. Where none is heard, gravity and a magnetic field tell the attitude `WAIT_S` after
    the last missing increment, as well as a body that is not thought to be accelerated can be levelled (`level`). Where
    nothing comes to an end in that time, or in `LONG_S` without a compass, they are used as well as may be. The
    same where it contradicts the position that was known.

    Without missing increments it may be another than the estimator is sure of, which refuses samples then: see
    `nav.heading_recovery`.
    """

    def __init__(
        self, alignment: Alignment, sensors: Container[str], reference: Reference, smoother: Smoother | None = None
    ) -> None:
        self._beginning, self._sensors, self._reference = deepcopy(alignment), sensors, reference
        self._heading = HeadingRecovery(alignment)
        self._smoother = smoother  # to which what was before tells nothing of what is put in its place
        self.begin(math.inf)

    def begin(self, t: float) -> None:
        """The estimator starts at ``t`` [s]: what was missing before is of no account."""
        self.since = t
        self._alignment: Alignment | None = None
        self._by_gravity: Alignment | None = None
        self._eas = 0.0
        self._fix_at = -math.inf  # when one was heard last
        self._heading.begin(t)
        self._receiver = ""
        self._lost_at = self._moved_at = self._widened = math.nan

    @property
    def under_way(self) -> bool:
        """Whether there is an alignment to be fed."""
        return self._alignment is not None or self._heading.under_way

    def propagate(self, imu: ImuSamples) -> None:
        """Add a block of increments."""
        for alignment in (self._alignment, self._by_gravity):
            if alignment is not None:
                alignment.propagate(imu)
        self._heading.propagate(imu)

    def took(self, sensor: str) -> None:
        """A sample of a sensor was used, whole."""
        self._heading.took(sensor)

    def hear(self, sample: Sample, reports: Sequence[UpdateReport]) -> None:
        """What became of a sample whose position, if it has one, was used."""
        self._heading.hear(sample, reports)
        self._heading.follow(sample)

    def judge(
        self, estimator: Startable, state: State, filters: int, sample: Sample, reports: list[UpdateReport],
        last_fused: float,
    ) -> None:  # fmt: skip
        """What became of a sample; where the attitude is another the estimator is started, and the reports say so.

        The ``state``, of so many filters, is settled at its time; a position was ``last_fused`` then [s].
        """
        self._heading.hear(sample, reports)
        initial = self._heading.judge(state, filters, sample, last_fused)
        if initial is not None:
            estimator.start(initial)
            reports[:] = estimator.refuse(
                sample, "the attitude was wrong: begun anew by accelerations", Outcome.WITHHELD
            )

    def keeps(
        self, estimator: Startable, state: State, filters: int, sample: Sample, last_bad: float, sound: bool = True
    ) -> list[UpdateReport] | None:
        """The reports on a sample that is kept from an estimator, None where it is not; it may be started by it.

        The ``state``, of so many filters, is settled at the sample's time; an increment was missing for the last time
        at ``last_bad`` [s]. A sample that is not ``sound`` is no part of an alignment.
        """
        lost = last_bad > self.since and tilt_is_lost(state.P, filters)
        if self._alignment is None:
            if not lost:
                return None
            self._alignment = deepcopy(self._beginning)
            self._lost_at = self._moved_at = self._widened = sample.t
        waited = sample.t - max(self._lost_at, last_bad)
        if sound and isinstance(sample, AirspeedSample):
            self._eas = sample.eas
        is_part = sound and self._is_part(sample)
        if is_part:
            initial = align(self._alignment, self._reference, sample)
            if initial is not None and _is_elsewhere(initial, initial.covariance[DP, DP], state, filters):
                self.begin(sample.t)
                return None
            if initial is not None:
                estimator.start(initial)
                return []
            if isinstance(sample, GnssSample):
                self._fix_at = sample.t
            if isinstance(sample, MagnetometerSample) and waited > 0 and self._level(state, filters, sample):
                return []
        patience = LONG_S if self._alignment.matching else WAIT_S
        if self._by_gravity is not None and sample.t - self._fix_at > WAIT_S:
            patience = max(patience, 2 * WAIT_S)  # which takes as long, and begins with a field
        if waited <= patience:
            self._widen(state.P, filters, sample.t)
            if is_part and isinstance(sample, GnssSample):
                self._follow(state, filters, sample)
            return estimator.refuse(sample, "the attitude is lost: aligning anew", Outcome.WITHHELD)
        if waited > LONG_S and not lost:  # it has come back without
            self.begin(sample.t)
        return None

    def _level(self, state: State, filters: int, sample: MagnetometerSample) -> bool:
        """Find the attitude by gravity and the field, where no fix was heard of late; whether it was: see `level`.

        All else the filters keep, such as the iron that they know beside the magnetometer.
        """
        if self._by_gravity is None:
            self._by_gravity = deepcopy(self._beginning)
            self._by_gravity.duration_s = WAIT_S
        found = level(self._by_gravity, self._reference, self._without_iron(state, sample), state.lla)
        if found is None or sample.t - self._fix_at <= WAIT_S:
            return False
        state.q_nb[:] = found.q_nb
        state.x[:, TURNED] = 0.0
        state.P[:, TURNED, :] = 0.0
        state.P[:, :, TURNED] = 0.0
        state.P[:, TURNED, TURNED] = filters * found.covariance[TURNED, TURNED]
        if self._eas > 0.0:
            self._fly_on(state, filters, found.covariance[TURNED, TURNED])
        if self._smoother is not None:
            self._smoother.begin(sample.t, state)
        self.begin(sample.t)
        return True

    def _fly_on(self, state: State, filters: int, variance: Array) -> None:
        """Take the velocity that was heard through the air, along the nose, in place of one that gravity may have had.

        It is off as the nose is, of the ``variance`` (3, 3), and by wind and slip.
        """
        wind, off = np.zeros(3), np.zeros((3, 3))
        own = [model.slices.get("wind") for model in self._reference.models]
        row = next((k for k, where in enumerate(own) if where is not None), None)
        if row is None:
            off = WIND**2 * np.eye(3)
        else:
            wind[:2] = state.x[row, own[row]]
            off[:2, :2] = state.P[row, own[row], own[row]] / filters
        speed = self._eas * math.sqrt(SEA_LEVEL_DENSITY / isa_density(float(state.lla[2])))
        air = speed * dcm_from_quat(state.q_nb)[:, 0]
        state.v_n[:] = wind + air
        state.x[:, MOVED] = 0.0
        state.P[:, MOVED, :] = 0.0
        state.P[:, :, MOVED] = 0.0
        swung = skew(air) @ variance
        state.P[:, MOVED, TURNED] = filters * swung
        state.P[:, TURNED, MOVED] = filters * swung.T
        state.P[:, MOVED, MOVED] = filters * (swung @ skew(air).T + off + SLIP**2 * np.eye(3))
        if row is not None:
            state.P[row, MOVED, own[row]] = filters * off[:, :2]
            state.P[row, own[row], MOVED] = filters * off[:2]

    def _without_iron(self, state: State, sample: MagnetometerSample) -> MagnetometerSample:
        """The sample without the hard iron that a filter has found, if one looks for it."""
        for x, model in zip(state.x, self._reference.models, strict=False):
            if (iron := model.slices.get(f"{sample.sensor}_bias")) is not None:
                return replace(sample, field_b=sample.field_b - x[iron])
        return sample

    def _is_part(self, sample: Sample) -> bool:
        """Whether the alignment is to have it: of receivers it is the first that is heard."""
        if isinstance(sample, GnssSample):
            self._receiver = self._receiver or sample.sensor
            return sample.sensor == self._receiver
        return sample.sensor in self._sensors

    def _follow(self, state: State, filters: int, fix: GnssSample) -> None:
        """Take velocity and position of a receiver, if they are known and not elsewhere; of the attitude they tell
        nothing that a linear correction could use.
        """
        aids, arm = self._beginning.aids, math.hypot(*self._beginning.arm_b)
        variance_p = whole(fix.sigma_position_n, aids.gnss_position) + arm**2 + (aids.gnss_latency * fix.v_n) ** 2
        variance_v = whole(fix.sigma_velocity_n, aids.gnss_velocity) + (SWING * arm) ** 2
        if not fix.has_fix or not has_velocity(fix) or _is_elsewhere(fix, variance_p, state, filters):
            return
        moved = [*DV, *DP]
        state.lla[:], state.v_n[:] = (fix.lat, fix.lon, fix.h), fix.v_n
        state.x[:, moved] = 0.0
        state.P[:, moved, :] = 0.0
        state.P[:, :, moved] = 0.0
        state.P[:, DV, DV], state.P[:, DP, DP] = filters * variance_v, filters * variance_p
        self._moved_at = self._widened = fix.t
        if self._smoother is not None:
            self._smoother.begin(fix.t, state)

    def _widen(self, P: Array, filters: int, t: float) -> None:
        """Let velocity and position be off as if gravity pulled anywhere, of which linear errors know nothing."""
        before, now = self._widened - self._moved_at, t - self._moved_at
        self._widened = t
        P[:, DV, DV] += filters * GRAVITY**2 * (now**2 - before**2)
        P[:, DP, DP] += filters * (0.5 * GRAVITY) ** 2 * (now**4 - before**4)


def level(alignment: Alignment, reference: Reference, sample: MagnetometerSample, lla: Array) -> InitialState | None:
    """Give a field to an alignment that is to take the body at ``lla`` for one that is not accelerated; the attitude
    once known.

    That is as if a receiver had told of one velocity at both ends of the alignment's time, and were wrong by what a
    steady acceleration of `USUAL_ACCELERATION` does in it.
    """
    wrong = np.full(3, USUAL_ACCELERATION * alignment.duration_s / math.sqrt(2))
    t, (lat, lon, h) = sample.t, lla.tolist()
    fix = GnssSample(t, t, lat, lon, h, CRAWLING, wrong, wrong, FixType.FIX_3D, 0, math.nan, math.nan)
    align(alignment, reference, sample)
    return align(alignment, reference, fix)


def _is_elsewhere(place: InitialState | GnssSample, variance: Array, state: State, filters: int) -> bool:
    """Whether a place, known with a ``variance`` (3,) [m^2], is elsewhere over ground than filters thought, who claim
    much already.
    """
    north, east, _ = displacement_n(place.lat, place.lon, place.h, *state.lla.tolist())
    both = state.P[:filters, DP, DP].max(axis=0) + variance
    return bool(north**2 + east**2 > ELSEWHERE**2 * both[:2].sum())


@njit
def tilt_is_lost(P: Array, filters: int) -> bool:
    """Whether roll or pitch is less well known than `LOST_TILT` by the first ``filters`` of P (_, n, n) together."""
    for axis in range(PHI, PHI + 2):
        information = 0.0  # in that which would do
        for f in range(filters):
            information += LOST_TILT**2 / max(P[f, axis, axis], 1e-12)
        if information < 1.0:
            return True
    return False
