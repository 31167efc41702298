"""What the aids share: what an aid is, what it makes of a sample, and what becomes of that.

A kernel of an aid returns ``nu`` (m,) = measurement - prediction and ``H`` (m, n) = d prediction / d error state, error
being estimate - truth; ``x`` (n,) holds the estimated values of the states beyond the motion (`nav.error_model`), and
an argument named after a block is the index where it begins, -1 when the model has none. Lever arms point from the
inertial sensor to the aid's, in body axes [m].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np
import numpy.typing as npt

from nav._jit import njit
from nav.error_model import PHI, Block
from nav.rotation import Three
from nav.samples import Array, Outcome, Sample, UpdateReport

if TYPE_CHECKING:
    from nav.reference import Reference
    from nav.state import State
    from nav.unscented import Points

# What an instrument could possibly report; beyond it the sample is broken.
HEIGHT_LIMITS = (-1000.0, 50_000.0)  # [m]
SPEED_LIMIT = 600.0  # over ground [m/s]

Axes: TypeAlias = tuple[float, float, float]


class Ruling(NamedTuple):
    """What becomes of one part of a sample: the last three fields of its `UpdateReport`."""

    outcome: Outcome
    reason: str = ""
    weight: float = 0.0


class Measurement(NamedTuple):
    """One part of a sample at an operating point: innovation (m,), Jacobian (m, n), variances (m,).

    ``withheld`` says why it must not be used, None when it may. ``at_points`` (7, m) are the innovations at the sigma
    points of an unscented filter; ``reported`` (m,) the variances as the sensor reports them, where R is what they were
    learned to be.
    """

    nu: Array
    H: Array
    R: Array
    withheld: Ruling | None = None
    at_points: Array | None = None
    reported: Array | None = None


class OperatingPoint(NamedTuple):
    """What a measurement is predicted from: the nominal state, a filter's own states ``x`` (n,), and its ``P`` (n, n).

    ``starts`` are the indices where the aid's own blocks begin in ``x`` (`Aid.states`), -1 for one that is left out.
    """

    reference: Reference
    state: State
    x: Array
    starts: tuple[int, ...]
    P: Array


class Aid(Protocol):
    """One sensor as a filter models it: what its samples measure, how well, and with which error states."""

    @property
    def sensor(self) -> str:
        """The sensor's name."""
        ...

    @property
    def parts(self) -> tuple[tuple[str, int], ...]:
        """The measurements that a sample gives, in their order, and the number of axes of each."""
        ...

    @property
    def states(self) -> tuple[str, ...]:
        """The names of the blocks of states whose places `measure` needs (`OperatingPoint.starts`)."""
        ...

    def blocks(self) -> list[Block]:
        """The error states; one whose sigma is zero is left out."""
        ...

    def measure(self, part: str, sample: Sample, at: OperatingPoint) -> Measurement | None:
        """One part of a sound sample, None when it has no such part."""
        ...


@runtime_checkable
class AidAtPoints(Protocol):
    """An aid that finds the innovations at all sigma points at once: one after the other takes ten times as long."""

    def at_points(self, part: str, sample: Sample, at: OperatingPoint, points: Points) -> Array | None:
        """The innovations (N, m) of one part of a sound sample; None where they are to be had one by one only."""
        ...


class Kind(IntEnum):
    """The aids that `nav.batch` knows."""

    BAROMETER = 0
    MAGNETOMETER = 1
    AIRSPEED = 2
    GNSS = 3


@runtime_checkable
class PlainAid(Protocol):
    """An aid whose sound samples need no more than its kernels, so that many can be taken at once (`nav.batch`)."""

    @property
    def parts(self) -> tuple[tuple[str, int], ...]:
        """See `Aid`."""
        ...

    @property
    def plain(self) -> tuple[Kind, Sequence[float]] | None:
        """What it is, and up to twelve numbers of its own; None where it needs more than that."""
        ...

    def numbers(self, samples: Any) -> Array:
        """Up to twelve numbers of each of N samples, sound or not (N, _)."""
        ...


FUSED = Ruling(Outcome.FUSED, weight=1.0)
OUTSIDE = Ruling(Outcome.OUTSIDE_GATE, "outside the gate")
NO_RATES = Ruling(Outcome.WITHHELD, "how fast the sensor swings about the IMU isn't known before the first increment")


def without_position(position: Ruling) -> Ruling:
    """What becomes of the velocity of a fix whose position was not used."""
    return Ruling(Outcome.WITHHELD, f"position {position.reason}")


def aid_blocks(aids: Sequence[Aid]) -> list[Block]:
    """The error states of several aids, each name once, none of sigma zero."""
    blocks = {block.name: block for aid in aids for block in aid.blocks()}
    return [block for block in blocks.values() if np.any(block.sigma)]


def refusals(
    sample: Sample, aid: Aid, reason: str, now: float, outcome: Outcome = Outcome.UNSOUND
) -> list[UpdateReport]:
    """Reports on a sample that is not used, without innovations (NaN): one for each part of it."""
    t = sample.t if math.isfinite(sample.t) else now
    return [
        UpdateReport(
            t, sample.sensor, part, np.full(m, np.nan), np.full((m, m), np.nan), math.nan, math.nan,
            0.0, outcome, reason,
        )
        for part, m in aid.parts
    ]  # fmt: skip


def report_on(
    sample: Sample, part: str, nu: Array, S: Array, nis: float, threshold: float, ruling: Ruling
) -> UpdateReport:
    """The report on one part of a sample."""
    return UpdateReport(
        sample.t, sample.sensor, part, nu, S, nis, threshold, ruling.weight, ruling.outcome, ruling.reason
    )


def range_problem(what: str, value: float, limits: tuple[float, float]) -> str:
    """Why a value can't be, empty when it can."""
    if not math.isfinite(value):
        return f"{what} is not finite"
    return "" if limits[0] <= value <= limits[1] else f"{what} {value:.6g} is out of range"


@njit
def well_within(value: float, limits: tuple[float, float]) -> bool:
    """Whether `range_problem` surely has nothing against a value: one at the edge could be rounded over it."""
    edge = 1e-9 * (limits[1] - limits[0])
    return limits[0] + edge < value < limits[1] - edge


def all_within(values: Array, limits: tuple[float, float]) -> npt.NDArray[np.bool_]:
    """`well_within` of each of N values."""
    edge = 1e-9 * (limits[1] - limits[0])
    found: npt.NDArray[np.bool_] = (limits[0] + edge < values) & (values < limits[1] - edge)
    return found


def position_problem(lat: float, lon: float, h: float) -> str:
    """Why a position can't be, empty when it can."""
    if not (math.isfinite(lat) and math.isfinite(lon) and math.isfinite(h)):
        return "position is not finite"
    if abs(lat) > math.pi / 2 or abs(lon) > 2 * math.pi:
        return "position is out of range"
    return "" if HEIGHT_LIMITS[0] <= h <= HEIGHT_LIMITS[1] else f"height {h:.6g} is out of range"


@njit
def put_skew(H: Array, v: Array | Three) -> None:
    """Write [v x] into the columns of the attitude."""
    for j in range(3):
        one, two = (j + 1) % 3, (j + 2) % 3
        H[one, PHI + two], H[two, PHI + one] = -v[j], v[j]
