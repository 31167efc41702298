"""Flying the table: which flights there are, working them off in parallel, carrying on where it stopped.

Draw k of a ``number`` has the seed ``number * DRAW + k`` in every weather, so that weathers share gusts and noise. Of
what goals are set for there are further draws. The folder keeps each flight as it is finished; more draws in the same
folder fly those that are missing.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from testbed import plugins
from testbed.data import write_file
from testbed.denied import flight
from testbed.denied.flight import Outcome
from testbed.denied.table import Case, Contestant, Table, Weather
from testbed.errors import UserError, shown
from testbed.estimators import registry
from testbed.estimators.custom import GROUP
from testbed.many import pool
from testbed.many.draws import DRAW, require_draw
from testbed.many.folder import claim, code, require_code, versions
from testbed.many.shared_flight import log_digests
from testbed.motion import aircraft
from testbed.motion.sections import FlightTruth

if TYPE_CHECKING:
    from testbed.many.progress import Tell

RECORDED_DRAW = 791001  # of the table in the documentation, and what is drawn when nobody says
OURS = "ins"
FLIGHTS, SCENARIOS = "flights", "scenarios"  # folders


@dataclass(frozen=True, slots=True)
class Plan:
    """What is to be flown into ``out``: a table, for these estimators, so many ``draws`` of a ``number``."""

    table: Table
    contestants: tuple[Contestant, ...]
    out: Path
    number: int = RECORDED_DRAW
    draws: int = 0

    @property
    def seeds(self) -> range:
        """One for each draw of the whole table."""
        first = 1 + self.number * DRAW
        return range(first, first + (self.draws or self.table.draws))

    @property
    def further(self) -> range:
        """One for each further draw of what goals are set for."""
        judged = self.table.judged(self.contestants)
        count = len(self.seeds) * (self.table.judged_draws - 1) if judged else 0
        return range(self.seeds.stop, self.seeds.stop + count)

    def cases(self) -> Iterator[Case]:
        """All of them."""
        for weather in self.table.weathers:
            yield from self.table.cases(weather, self.contestants)


class Failure(NamedTuple):
    """A flight that ended with an error."""

    weather: str
    seed: int
    message: str


@dataclass(frozen=True, slots=True)
class Result:
    """A finished benchmark: what was planned, its flights in order of weather and seed, and those that failed.

    ``outcomes`` are of the whole table, ``further`` of what goals are set for alone.
    """

    plan: Plan
    outcomes: Sequence[Outcome]
    failures: Sequence[Failure]
    further: Sequence[Outcome] = ()

    def at(self, weather: str) -> flight.At:
        """What the flights of a weather came to, at the times of the table."""
        return flight.at([one for one in self.outcomes if one.weather == weather], self.plan.table.marks_s)


class _Task(NamedTuple):
    """All that a worker needs to fly one flight."""

    weather: Weather
    seed: int
    cases: tuple[Case, ...]
    path: Path
    code: str


def contestants(kinds: Sequence[str], table: Table, folder: Path) -> tuple[Contestant, ...]:
    """The estimators of these kinds, `OURS` without any; a path is relative to ``folder``. Each is built once.

    Raises UserError when one can't be had, or two have one name.
    """
    found: list[Contestant] = []
    for given in kinds or [OURS]:
        if given in registry.BUILT_IN and given != OURS:
            raise UserError(
                f"--estimator {given}: needs keys of its own: give {OURS}, or a class of yours, such as"
                " ./filters.py:Mine or mypackage.filters:Mine"
            )
        try:
            registry.find(given)
        except UserError as error:
            raise UserError(f"--estimator {shown(given)}: {error}") from None
        where, _, name = given.rpartition(":")
        path = (folder / where).resolve()
        if where.endswith(".py") and not path.is_file():
            raise UserError(f"--estimator {given}: there is no file {path}")
        kind = f"{path}:{name}" if where.endswith(".py") else given
        if name in (one.name for one in found):
            raise UserError(f"--estimator {given}: there is another {name}: estimators need different names")
        found.append(Contestant(name, kind))
    every = tuple(found)
    for case in Plan(table, every, Path()).cases():
        if (case.weather, case.grade) == (table.weathers[0], table.grades[0]):
            registry.build(case.scenario.estimator, case.scenario.rig(0))
    return every


def fly(plan: Plan, workers: int | None = None, tell: Tell | None = None) -> Result:
    """Fly what is not there yet, on every core unless ``workers`` are given.

    A flight that fails stops no other. Raises UserError when the folder can't be written or holds another benchmark.
    """
    require_draw(plan.number, plan.further.stop - plan.seeds.start)
    claim(plan.out, FLIGHTS, "benchmark", _setup(plan))
    _write_scenarios(plan)
    every = list(_tasks(plan))
    found = {one.path: outcome for one in every if (outcome := flight.stored(one.path)) is not None}
    failures: list[Failure] = []
    tasks = [one for one in every if one.path not in found]
    total, before = len(every), len(found)

    def say(now: pool.Standing[_Task]) -> None:
        if tell is not None:
            done = len(found) + len(failures)
            flying = sum(share for _, share in now.running) if done < total else 0.0
            text = f"{done} of {total} flights" + (f", {before} of them before" if before else "")
            tell((done + flying) / total, text if now.workers else f"{text}  starting")

    if tasks:
        apart = any(one.kind != OURS for one in plan.contestants)
        with pool.opened(len(tasks), workers, apart) as crew:
            for one in crew.work(_fly, tasks, say):
                if one.result is None:
                    failures.append(Failure(one.task.weather.name, one.task.seed, _said(one.error)))
                else:
                    flight.store(one.result, one.task.path)
                    found[one.task.path] = one.result
    ordered = [path for w in plan.table.weathers for seed in plan.seeds if (path := _path(plan.out, w, seed)) in found]
    if not ordered:
        raise UserError(f"no flight came to its end: {failures[0].message}")
    further = [path for seed in plan.further if (path := _judged_path(plan.out, seed)) in found]
    return Result(plan, [found[path] for path in ordered], sorted(failures), [found[path] for path in further])


def _said(error: Exception | None) -> str:
    return str(error) if isinstance(error, UserError | pool.Died) else f"{type(error).__name__}: {error}"


def _tasks(plan: Plan) -> Iterator[_Task]:
    """All flights, a draw after the other: what is interrupted has as many of every weather."""
    cases = {weather.name: tuple(plan.table.cases(weather, plan.contestants)) for weather in plan.table.weathers}
    for seed in plan.seeds:
        for weather in plan.table.weathers:
            yield _Task(weather, seed, cases[weather.name], _path(plan.out, weather, seed), code())
    judged = plan.table.judged(plan.contestants)
    for seed in plan.further:
        yield _Task(judged[0].weather, seed, judged, _judged_path(plan.out, seed), code())


def _fly(task: _Task, tell: Any) -> Outcome:
    """Called on a worker."""
    require_code(task.code)
    return flight.fly(task.cases, task.seed, tell)


def ended(result: Result) -> dict[tuple[str, str], int]:
    """Estimators that ended by errors of their own, ``aids/grade/estimator``, and why: in how many flights."""
    return dict(Counter(pair for one in (*result.outcomes, *result.further) for pair in one.ended.items()))


# --- the folder


def _path(folder: Path, weather: Weather, seed: int) -> Path:
    return folder / FLIGHTS / f"{weather.name}_s{seed}.npz"


def _judged_path(folder: Path, seed: int) -> Path:
    return folder / FLIGHTS / f"judged_s{seed}.npz"


def _setup(plan: Plan) -> dict[str, Any]:
    """Everything that decides the numbers, apart from the seeds."""
    bare = [case for weather in plan.table.weathers for case in plan.table.cases(weather, ())]
    loaded = [case.scenario for case in bare]
    flown = {one.truth.aircraft for one in loaded if isinstance(one.truth, FlightTruth)}
    return {
        "scenarios": hashlib.sha256("\0".join(case.text for case in bare).encode()).hexdigest(),
        "estimators": {one.name: _digest(one) for one in plan.contestants},
        "code": code(),
        "aircraft": [aircraft.digest(name) for name in sorted(flown)],
        "maps": log_digests(loaded),
        "versions": versions(),
    }


def _digest(contestant: Contestant) -> str:
    """What tells a user's class from what it was before."""
    return "" if contestant.kind == OURS else plugins.digest(contestant.kind, Path(), GROUP)


def _write_scenarios(plan: Plan) -> None:
    """Each case as a file: `testbed run` flies it with any of the seeds. One that is flown longer has a second."""
    folder = plan.out / SCENARIOS
    folder.mkdir(exist_ok=True)
    for case in plan.cases():
        write_file(folder / f"{case.weather.name}_{case.aids.name}_{case.grade.name}.toml", case.text.encode())
    for case in plan.table.judged(plan.contestants):
        if case.aids.name in plan.table.judged_longest_s:
            name = f"{case.weather.name}_{case.aids.name}_{case.grade.name}_{case.longest_s}s.toml"
            write_file(folder / name, case.text.encode())
