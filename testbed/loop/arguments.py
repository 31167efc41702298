"""What `testbed.run` is given."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Integral
from pathlib import Path
from typing import Any, TypedDict

from testbed.errors import UserError
from testbed.estimators.section import EstimatorSection
from testbed.feeds.bridged import FarEnd
from testbed.loop.links import Progress, Publisher, shown_estimator
from testbed.loop.requests import Recorded, Request
from testbed.motion.table import MotionSource
from testbed.scenario import Scenario

LARGEST_SEED = 2**63 - 1


class Others(TypedDict, total=False):
    """Further arguments of `run`, of its `Setup`."""

    links: Sequence[Publisher]
    shown: str | None
    realtime: float | None
    controls: Sequence[Callable[[], Sequence[Request]]]
    replay: Sequence[tuple[float, Recorded]]
    source: MotionSource | None
    far_end: FarEnd | None


@dataclass(frozen=True, slots=True)
class Setup:
    """What a run is to do beside its scenario: the arguments of `run` of the same names."""

    seed: int
    out: Path | None = None
    progress: Callable[[Progress], None] | None = None
    links: Sequence[Publisher] = ()
    shown: str | None = None
    realtime: float | None = None
    controls: Sequence[Callable[[], Sequence[Request]]] = ()
    replay: Sequence[tuple[float, Recorded]] = ()
    source: MotionSource | None = None
    far_end: FarEnd | None = None

    def own(self, scenario: Scenario) -> tuple[EstimatorSection, ...]:
        """The estimators that do not run in the far end."""
        return tuple(
            one for one in scenario.estimator if self.far_end is None or one.name not in self.far_end.estimators
        )


def require_sound(scenario: Any, out: Any, progress: Any, others: Mapping[str, Any]) -> None:
    """Raise UserError where an argument of `run` is of no type that it could have, TypeError where it has none so."""
    for name in others.keys() - Others.__annotations__.keys():
        raise TypeError(f"run() got an unexpected keyword argument {name!r}")
    if not isinstance(scenario, Scenario):
        raise UserError(f"run: give a Scenario, such as Scenario.load({str(scenario)!r})")
    if not isinstance(out, str | Path | None) or out == "":
        raise UserError(f"run: out: give a folder, not {repr(out) if isinstance(out, str) else type(out).__name__}")
    if not all(callable(getattr(link, "publish", None)) for link in others.get("links", ())):
        raise UserError("run: links: give publishers, such as testbed.mavlink.MavlinkPublisher(addresses, scenario)")
    if progress is not None and not callable(progress):
        raise UserError(f"run: progress: give a function that is told how far it is, not {type(progress).__name__}")


def setup_of(
    scenario: Scenario,
    seed: int | None,
    out: str | Path | None,
    progress: Callable[[Progress], None] | None,
    others: Others,
) -> Setup:
    """The arguments of `run`, with what they leave to the scenario."""
    seed = scenario.seed if seed is None else seed
    if not (isinstance(seed, Integral) and not isinstance(seed, bool) and 0 <= seed <= LARGEST_SEED):
        raise UserError(f"seed {seed}: must be from 0 to {LARGEST_SEED}, a whole number")
    setup = Setup(seed, None if out is None else Path(out), progress, **others)
    if not setup.links and setup.shown is None:
        return setup
    return replace(setup, shown=shown_estimator(setup.own(scenario), setup.shown))
