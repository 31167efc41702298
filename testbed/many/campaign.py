"""Many seeds: one scenario flown many times, for every combination of varied values, on many processors.

Run k of a combination has the scenario's own seed + k, so `testbed run --seed` flies any one of them again, bit for
bit; another draw begins `draws.DRAW` seeds further on for each. Every run is a task by itself: its numbers can't depend
on how many workers there are, or on which of them it ran.

Results come back to this process, which writes them into the campaign's folder as they finish; a campaign that was
interrupted carries on with the runs that are missing.
"""

from __future__ import annotations

import gc
import io
import itertools
import json
import math
import re
import time
import tomllib
import traceback
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from nav.samples import Array
from testbed.data import write_file
from testbed.errors import UserError
from testbed.feeds.closed import CLOSED, NEVER, NEVER_CLOSED
from testbed.many import given, pool, progress, seeds
from testbed.many.draws import DRAW, require_draw
from testbed.many.folder import claim, code, own, require_code, require_own_code, versions
from testbed.many.history import history_of
from testbed.many.shared_flight import log_digests, require_control, share_truth
from testbed.motion import aircraft
from testbed.motion.logged import LogTruth
from testbed.motion.sections import FlightTruth
from testbed.motion.table import Replay
from testbed.results import REPORT, require_own
from testbed.scenario import Scenario
from testbed.score.remarks import LOST

if TYPE_CHECKING:
    import pandas
    import xarray

    from testbed.report.campaign import Statistics

NO_NUMBERS = "gave estimates that are no numbers"

_Own: TypeAlias = Mapping[str, Mapping[str, str]]  # the user's classes in all combinations, as `own` tells them


@dataclass(frozen=True, slots=True)
class Combination:
    """One choice of the varied values, as given, and the scenario that it makes."""

    values: Mapping[str, str]
    scenario: Scenario

    def __str__(self) -> str:
        return ", ".join(f"{key}={value}" for key, value in self.values.items())


@dataclass(frozen=True, slots=True)
class Outcome:
    """What is kept of one run: its metrics, and its errors over time at `testbed.many.history.HISTORY_HZ`.

    ``history`` has ``time`` (N,) [s], ``outage`` (N,) 1 while some GNSS receiver has no fix, and for each estimator
    ``<name>.error`` horizontal position error [m], ``<name>.sigma`` its own 1-sigma sqrt(P_N + P_E) [m] and
    ``<name>.nees`` the position NEES per degree of freedom; each (N,), NaN while aligning. Of an estimator of attitude
    alone they are the error of roll and pitch [deg], its sigma [deg] and the attitude NEES. ``ended`` are
    the estimators that ended by errors of their own, and why.
    """

    combination: int
    seed: int
    metrics: Mapping[str, float]
    history: Mapping[str, Array]
    ended: Mapping[str, str] = field(default_factory=dict)

    @property
    def spoilt(self) -> dict[str, tuple[str, str]]:
        """Estimators of which other metrics say too little: what each did, and why."""
        lost = [name.removesuffix(LOST) for name, count in self.metrics.items() if name.endswith(LOST) and count]
        return dict.fromkeys(lost, (NO_NUMBERS, "")) | {name: ("has ended", why) for name, why in self.ended.items()}


@dataclass(frozen=True, slots=True)
class Failure:
    """A run that ended with an error: its combination, seed, the message and the traceback, if there was one."""

    combination: int
    seed: int
    message: str
    traceback: str = ""


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a campaign stands: runs finished and failed, of how many, how many of them were there before it began.

    ``flying`` is the sum of the shares that are done of the runs on their way; ``elapsed_s`` is wall time; ``activity``
    says what is going on when it is not simply flying.
    """

    done: int
    failed: int
    total: int
    before: int
    flying: float
    elapsed_s: float
    activity: str

    @property
    def fraction(self) -> float:
        """The share of the campaign that is done."""
        return (self.done + self.failed + self.flying) / self.total

    def __str__(self) -> str:
        parts = [f"{self.done}/{self.total} runs", f"{self.failed} failed" if self.failed else "", self.activity]
        return "  ".join(filter(None, parts))


@dataclass(frozen=True, slots=True)
class CampaignResult:
    """A finished campaign: folder, combinations, outcomes in order of combination and seed, failures, statistics."""

    path: Path
    combinations: Sequence[Combination]
    outcomes: Sequence[Outcome]
    failures: Sequence[Failure]
    statistics: Statistics
    draw: int = 0
    remarks: Sequence[str] = ()  # what its reader should know first

    def __repr__(self) -> str:
        """In a line, as the last of a notebook's cell is shown."""
        return f"<CampaignResult {len(self.outcomes)} runs, {len(self.failures)} failed, in {self.path}>"

    def frame(self) -> pandas.DataFrame:
        """One row for each run: the varied values, the seed and all metrics, NaN where a run has none of that name."""
        import pandas

        return pandas.DataFrame(
            [
                {key: _plain(value) for key, value in self.combinations[o.combination].values.items()}
                | {"seed": o.seed}
                | dict(sorted(o.metrics.items()))
                for o in self.outcomes
            ]
        )

    def spoilt(self) -> list[str]:
        """Which estimators ended by errors of their own or gave no numbers, in how many runs, why: a sentence each."""
        seeds: dict[tuple[int, str, str, str], list[int]] = {}
        for one in self.outcomes:
            for name, (what, why) in one.spoilt.items():
                seeds.setdefault((one.combination, name, what, why), []).append(one.seed)
        told = []
        for (combination, name, what, why), runs in seeds.items():
            which = f"seed {runs[0]}" if len(runs) == 1 else f"{len(runs)} runs, the first of seed {runs[0]}"
            told.append(f"{self.combinations[combination]} {name} {what} in {which}{f': {why}' if why else ''}".strip())
        return told

    def dataset(self) -> xarray.Dataset:
        """What `Outcome` keeps over time, of all runs: dimensions run and time, NaN after the end of a shorter run.

        Coordinates of a run are its seed and, under their keys, the varied values as given.
        """
        import xarray

        longest = max((o.history["time"] for o in self.outcomes), key=len, default=np.zeros(0))
        names = [name for name in dict.fromkeys(name for o in self.outcomes for name in o.history) if name != "time"]

        def stacked(name: str) -> Array:
            rows = np.full((len(self.outcomes), len(longest)), np.nan)
            for row, outcome in zip(rows, self.outcomes, strict=True):
                own = outcome.history.get(name, ())
                row[: len(own)] = own
            return rows

        coordinates: dict[str, Any] = {"time": longest, "seed": ("run", [o.seed for o in self.outcomes])}
        for key in self.combinations[0].values:
            coordinates[key] = ("run", [self.combinations[o.combination].values[key] for o in self.outcomes])
        return xarray.Dataset({name: (("run", "time"), stacked(name)) for name in names}, coordinates)


def _plain(text: str) -> Any:
    """A varied value as a number, a text or a truth value; a list or a table stays as it was given."""
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
    return text if isinstance(value, (list, dict)) else value


@dataclass(frozen=True, slots=True)
class Plan:
    """What a campaign is to fly: ``runs`` seeds for every combination of the values in ``vary``, into folder ``out``.

    ``vary`` maps a key path to the values it takes, each as ``--set`` takes it; ``overrides`` apply to all runs. Each
    ``draw`` has seeds of its own, so that a figure can be had on seeds that nobody looked at before.
    """

    scenario: str | Path
    runs: int
    out: Path
    vary: Mapping[str, Sequence[str]] = field(default_factory=dict)
    overrides: Sequence[str] = ()
    draw: int = 0

    def seeds(self, scenario: Scenario) -> range:
        """The seeds of a scenario's runs: one where all runs would be the same."""
        first = scenario.seed + self.draw * DRAW
        return range(first, first + (self.runs if seeds.matter(scenario) else 1))


@dataclass(frozen=True, slots=True)
class _Task:
    """All that a worker needs to fly one run."""

    combination: int
    seed: int
    scenario: Scenario
    truth: Path | None  # the flight that all runs share; a worker that can't see it flies it again
    code: str
    own: _Own


def campaign(
    scenario: str | Path,
    runs: int,
    *,
    vary: Mapping[str, Sequence[Any]] | None = None,
    overrides: Sequence[str] | Mapping[str, Any] = (),
    draw: int = 0,
    workers: int | str | None = None,
    out: str | Path | None = None,
) -> CampaignResult:
    """Fly ``runs`` seeds of a scenario for every combination of the values in ``vary``, and say what they show.

    ``vary`` maps a key path to the values it takes, each as it is or as the text that ``--set`` takes;
    ``overrides``, as `Scenario.load` takes them, apply to all runs. Each ``draw`` has other seeds. ``workers`` is
    the number of processes, one for each core without, or the address of a Dask scheduler. In ``out``,
    `usual_folder` without, there are at the end runs/, campaign.csv, campaign.json and figures; what is there
    already of the same campaign is not flown again. How far it is is told on stderr. Of a recorded flight in which
    nothing follows the seed each combination is flown once, and ``remarks`` say so.

    A run that fails is in ``failures`` and stops no other. Raises UserError when anything given is wrong, when ``out``
    can't be written or holds another campaign, or when the scheduler can't be reached.
    """
    given.require_path("campaign: scenario", scenario, "the file or the name of a scenario")
    given.require_path("campaign: out", Path() if out is None else out, "a folder")
    runs, draw = given.whole("campaign: runs", runs), given.whole("campaign: draw", draw)
    workers = given.crew("campaign: workers", workers)
    varied, overrides = given.varied(vary), given.overrides(overrides)
    folder = usual_folder(scenario, draw) if out is None else Path(out)
    from rich.console import Console

    with progress.shown(Console(stderr=True), str(scenario)) as tell:
        plan = Plan(scenario, runs, folder, varied, overrides, draw)
        return fly(plan, workers, lambda now: tell(now.fraction, str(now)), progress.say)


def usual_folder(scenario: str | Path, draw: int) -> Path:
    """Where a campaign goes unless told otherwise: ``runs/<scenario>_campaign``, with the draw behind it if not 0."""
    return Path("runs", f"{Path(scenario).stem}_campaign{f'_draw{draw}' if draw else ''}")


def fly(
    plan: Plan, workers: int | str | None = None, tell: Callable[[Progress], None] | None = None,
    say: Callable[[str], None] = lambda remark: None,
) -> CampaignResult:  # fmt: skip
    """The same, for whoever shows by itself how far it is, and what there is to say before it begins."""
    from testbed.report import campaign as campaign_report
    from testbed.report import campaign_figures

    combinations = _combinations(plan)
    if plan.runs < 1:
        raise UserError(f"--runs {plan.runs}: give at least 1")
    require_draw(plan.draw, plan.runs if plan.draw else 0)
    remarks = seeds.remarks([one.scenario for one in combinations], plan.runs, plan.draw)
    total = sum(len(plan.seeds(one.scenario)) for one in combinations)
    folder = plan.out.absolute()
    figures = campaign_figures.files(combinations[0].values)
    require_own(folder, [campaign_report.TABLE, campaign_report.SUMMARY, REPORT, *figures])
    mine = own([one.scenario for one in combinations])
    claim(folder, "runs", "campaign", _setup([one.scenario for one in combinations], plan, mine))
    stored = _load_all(folder, combinations, plan)
    failures: list[Failure] = []
    for remark in remarks:
        say(remark)
    if len(stored) < total:
        teller = _Teller(tell, total, len(stored))
        apart = any(one.scenario.has_own_code for one in combinations)
        with pool.opened(total - len(stored), workers, apart) as crew:
            truth = share_truth(folder, [c.scenario for c in combinations])
            tasks = _tasks(plan, combinations, truth, mine, set(stored))
            for done in crew.work(_fly, tasks, teller.standing):
                flown = _flown(done)
                if isinstance(flown, Failure):
                    failures.append(flown)
                else:
                    _store(folder, flown)
                    stored[flown.combination, flown.seed] = flown
                teller.finished(flown)
    outcomes = [stored[run] for run in sorted(stored)]
    failures.sort(key=lambda f: (f.combination, f.seed))
    statistics = campaign_report.statistics(combinations, outcomes, failures)
    result = CampaignResult(folder, combinations, outcomes, failures, statistics, plan.draw, remarks)
    campaign_report.save(result)
    return result


def _combinations(plan: Plan) -> list[Combination]:
    """Every combination of varied values, each loaded and so checked. They differ in nothing else."""
    for key, listed in plan.vary.items():
        if key == "seed":
            raise UserError("--vary seed: every combination is flown with many seeds already: use --runs")
        if key.partition(".")[0] == "record":
            raise UserError(
                f"--vary {key}: runs whose records have other rows are not put beside each other: use --set"
            )
        given.require_once(key, listed)
    made = []
    for values in itertools.product(*plan.vary.values()):
        chosen = dict(zip(plan.vary, values, strict=True))
        loaded = Scenario.load(plan.scenario, [*plan.overrides, *(f"{key}={value}" for key, value in chosen.items())])
        made.append(Combination(chosen, loaded))
    names = [[one.name for one in combination.scenario.estimator] for combination in made]
    for combination, own_names in zip(made, names, strict=True):
        if own_names != names[0]:
            raise UserError(
                f"--vary {combination}: has estimators {own_names}, the first combination {names[0]}: they are compared"
                " by their names, which must be the same, and in the same order"
            )
    if not made[0].scenario.estimator:
        raise UserError(
            f"{plan.scenario}: has no estimator, so a campaign would have nothing to compare: add [[estimator]]"
        )
    return made


def _tasks(
    plan: Plan, combinations: Sequence[Combination], truth: Path | None, mine: _Own, stored: Set[tuple[int, int]]
) -> Iterator[_Task]:
    """The runs that are not there yet. There may be millions: they are made as they are flown."""
    now = code()
    for i, combination in enumerate(combinations):
        for seed in plan.seeds(combination.scenario):
            if (i, seed) not in stored:
                yield _Task(i, seed, combination.scenario, truth, now, mine)


# --- the folder


def _setup(scenarios: Sequence[Scenario], plan: Plan, mine: _Own) -> dict[str, Any]:
    """Everything that decides the numbers, apart from the seeds."""
    flown = {one.truth.aircraft for one in scenarios if isinstance(one.truth, FlightTruth)}
    return {
        "scenario": _deciding(scenarios[0].text),
        "overrides": list(plan.overrides),
        "varied values": {key: list(values) for key, values in plan.vary.items()},
        "code": code(),
        **mine,
        "aircraft": [aircraft.digest(name) for name in sorted(flown)],
        "logs": log_digests(scenarios),
        "versions": versions(),
    }


def _deciding(text: str) -> dict[str, Any]:
    """A scenario's text as data, without what it expects: that changes no number, and is set by what was flown."""
    told = tomllib.loads(text)
    told.pop("expect", None)
    plain: dict[str, Any] = json.loads(json.dumps(told, default=str))
    return plain


def _stem(folder: Path, combination: int, seed: int) -> Path:
    return folder / "runs" / f"c{combination:03d}_s{seed:06d}"


def _store(folder: Path, outcome: Outcome) -> None:
    """Write one outcome: metrics last, so that a run with metrics is a whole run."""
    stem = _stem(folder, outcome.combination, outcome.seed)
    record = {"combination": outcome.combination, "seed": outcome.seed, "metrics": outcome.metrics}
    record |= {"ended": outcome.ended} if outcome.ended else {}
    arrays = io.BytesIO()
    np.savez_compressed(arrays, **outcome.history)  # type: ignore[arg-type]
    write_file(stem.with_suffix(".npz"), arrays.getvalue())
    write_file(stem.with_suffix(".json"), json.dumps(record, indent=1).encode())


def _load_all(folder: Path, combinations: Sequence[Combination], plan: Plan) -> dict[tuple[int, int], Outcome]:
    """The outcomes that are there, of those that are wanted, by combination and seed."""
    found = {}
    for path in (folder / "runs").glob("*.json"):
        named = re.fullmatch(r"c(\d+)_s(\d+)", path.stem)
        if named is None:
            continue
        combination, seed = int(named[1]), int(named[2])
        if combination < len(combinations) and seed in plan.seeds(combinations[combination].scenario):
            outcome = _load(folder, combination, seed)
            if outcome is not None:
                found[combination, seed] = outcome
    return found


def _load(folder: Path, combination: int, seed: int) -> Outcome | None:
    """A stored outcome; None when there is none, or none that can be read."""
    stem = _stem(folder, combination, seed)
    try:
        record = json.loads(stem.with_suffix(".json").read_bytes())
        values = {str(name): float(value) for name, value in record["metrics"].items()}
        ended = {str(name): str(why) for name, why in record.get("ended", {}).items()}
        with np.load(io.BytesIO(stem.with_suffix(".npz").read_bytes())) as file:
            history = {"time": file["time"]} | {name: file[name] for name in file.files}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, EOFError, zlib.error, zipfile.BadZipFile):
        return None
    return Outcome(combination, seed, values, history, ended)


# --- the workers


def _flown(done: pool.Done[_Task, Outcome | Failure]) -> Outcome | Failure:
    """What became of a run, also when its worker could not say so itself."""
    if done.result is not None:
        return done.result
    said = str(done.error) if isinstance(done.error, pool.Died) else f"{type(done.error).__name__}: {done.error}"
    return Failure(done.task.combination, done.task.seed, said, done.trace)


def _fly(task: _Task, tell: Callable[[float], None]) -> Outcome | Failure:
    """Fly one run. Called on a worker."""
    from testbed.feeds.simulated import motion
    from testbed.loop.loop import run

    # The tree of a record refers to itself: Python would leave those of hundreds of runs, of up to 100 MB each.
    gc.collect()
    try:
        require_code(task.code)
        require_own_code(task.own, task.scenario)
        shared = task.truth if task.truth is not None and task.truth.is_dir() else None
        recorded = isinstance(task.scenario.truth, LogTruth)  # is read by the run itself
        source = Replay(shared) if shared else None if recorded else motion(task.scenario, task.seed)
        result = run(task.scenario, seed=task.seed, source=source, progress=lambda now: tell(now.t / now.duration))
        ended = [f"{name} has ended: {why}" for name, why in result.ended.items()]
        require_control("; ".join([result.failure, *ended]) if result.failure else "")
        if result.dataset.attrs.get(CLOSED) == NEVER:
            raise UserError(NEVER_CLOSED)
        # How long a run took says nothing about the filter and is never the same twice.
        kept = {key: value for key, value in result.metrics.items() if not key.startswith("run.")}
        finite = {key: value for key, value in kept.items() if math.isfinite(value)}
        return Outcome(task.combination, task.seed, finite, history_of(result.dataset), result.ended)
    except Exception as error:
        message = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
        return Failure(task.combination, task.seed, message, traceback.format_exc())


# --- telling


class _Teller:
    """Counts what has finished and passes it on, with how far the others are."""

    def __init__(self, tell: Callable[[Progress], None] | None, total: int, done: int) -> None:
        self._tell = tell
        self._total, self._before, self._done, self._failed = total, done, done, 0
        self._flying, self._begun, self._activity = 0.0, False, ""
        self._started = time.monotonic()

    def finished(self, flown: Outcome | Failure) -> None:
        """One more run is through."""
        failed = isinstance(flown, Failure)
        self._failed += failed
        self._done += not failed
        self._flying = max(self._flying - 1.0, 0.0)
        self._now()

    def standing(self, now: pool.Standing[_Task]) -> None:
        """Workers have told how far they are."""
        self._begun |= now.workers > 0
        self._flying = sum(share for _, share in now.running)
        self._activity = "" if now.workers else "waiting for a worker" if self._begun else "starting"
        self._now()

    def _now(self) -> None:
        if self._tell is not None:
            elapsed = time.monotonic() - self._started
            counts = self._done, self._failed, self._total, self._before
            self._tell(Progress(*counts, self._flying, elapsed, self._activity))
