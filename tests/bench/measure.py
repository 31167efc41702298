"""What a figure is, how it is judged, and how time is taken."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from importlib.util import find_spec
from statistics import median

MAIN = "loiter_gnss_outage"
TWO_ESTIMATORS = (
    "estimator=[{name='ins', aids=['gnss', 'barometer', 'magnetometer', 'airspeed']}, {name='dead_reckoning', aids=[]}]"
)


class Verdict(Enum):
    """What the rounds say of a bound."""

    KEPT = "kept"
    MISSED = "missed"
    OPEN = "open"  # some rounds keep it, some miss it
    NONE = ""  # there is no bound


@dataclass(frozen=True, slots=True)
class Row:
    """One figure, a value from each round, with the bound it must keep; without one it is only shown."""

    what: str
    rounds: tuple[float, ...]
    unit: str = "x"
    at_most: float | None = None
    at_least: float | None = None
    detail: str = ""

    @property
    def value(self) -> float:
        """The median of the rounds."""
        return median(self.rounds)

    @property
    def bound(self) -> str:
        """The bound in words, empty without one."""
        if self.at_most is not None:
            return f"at most {self.at_most:g}"
        return "" if self.at_least is None else f"at least {self.at_least:g}"

    @property
    def verdict(self) -> Verdict:
        """Kept or missed when every round says so."""
        if not self.bound:
            return Verdict.NONE
        kept = {self._keeps(value) for value in self.rounds}
        return Verdict.OPEN if len(kept) == 2 else Verdict.KEPT if True in kept else Verdict.MISSED

    def _keeps(self, value: float) -> bool:
        if self.at_most is not None:
            return value <= self.at_most
        return self.at_least is not None and value >= self.at_least


@dataclass(frozen=True, slots=True)
class Effort:
    """How much work a measurement may be: the part of its full length, and how often it is repeated."""

    share: float
    rounds: int

    def count(self, full: float) -> int:
        """That share of a full number of things or seconds, at least one."""
        return max(1, round(self.share * full))


FULL = Effort(1.0, 5)
QUICK = Effort(0.1, 1)  # no longer than a tenth, and once after the warm-up


class Missing(Exception):
    """Raised where a peer isn't installed."""


def need(*peers: str) -> None:
    """Raise Missing unless all these packages can be imported."""
    if missing := [name for name in peers if find_spec(name) is None]:
        raise Missing(f"{', '.join(missing)} not installed; `make bench` installs the peers")


def wall_seconds(work: Callable[[], object]) -> float:
    """Wall time of one call."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def cpu_seconds(work: Callable[[], object]) -> float:
    """Processor time of one call in all processes: this one, and those that it started and saw end."""
    before = _spent()
    work()
    return _spent() - before


def _spent() -> float:
    """Unlike `os.times` in microseconds, not in hundredths of a second."""
    return sum(
        used.ru_utime + used.ru_stime
        for used in (resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN))
    )


def alternate(
    first: Callable[[], float], second: Callable[[], float], effort: Effort
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Seconds of each side in every round, the two taken in turn after one warm-up."""
    first()
    second()
    pairs = [(first(), second()) for _ in range(effort.rounds)]
    return tuple(a for a, _ in pairs), tuple(b for _, b in pairs)


def compare(
    first: Callable[[], object], second: Callable[[], object], effort: Effort
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Processor seconds of two pieces of work, as `alternate` gives them: what else a machine does counts less."""
    return alternate(lambda: cpu_seconds(first), lambda: cpu_seconds(second), effort)


def ratios(above: Sequence[float], below: Sequence[float]) -> tuple[float, ...]:
    """Round by round: what disturbs a machine for some seconds disturbs both sides of a round."""
    return tuple(a / b for a, b in zip(above, below, strict=True))
