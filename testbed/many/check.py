"""Regression: scenarios flown side by side, their metrics held against `[expect]` and against golden ones.

Golden metrics are what came out when somebody last looked: one JSON file for each scenario, one metric a line. They
say nothing of right or wrong; `[expect]` does. What is compared, and how closely, is in `testbed.measures`.

Scenarios are flown by worker processes. One that dies takes the scenario that it flew with it and no other.
"""

# mypy: untyped-calls-exclude="junitparser"

from __future__ import annotations

import itertools
import json
import math
import re
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from testbed import measures
from testbed.data import data_dir, write_file
from testbed.errors import UserError
from testbed.feeds.closed import CLOSED, NEVER, NEVER_CLOSED
from testbed.loop import loop
from testbed.many import given, pool, progress
from testbed.report import page as report
from testbed.results import RECORD, require_own, start_anew
from testbed.scenario import Bounds, Scenario
from testbed.score.accuracy import column
from testbed.score.remarks import LOST

if TYPE_CHECKING:
    from junitparser import Error, Failure
    from junitparser.xunit2 import TestCase
    from rich.table import Table

    from testbed.many.progress import Tell

OUT = Path("runs/check")
GOLDEN = Path("tests/golden")  # of a checkout; they are not shipped
_ANEW = "delete it, and make it again with `testbed check --update`"
DIGITS = 4  # of a golden metric; tolerances are a hundred times that
QUIET = ("kept", "same")  # the verdicts that nobody has to read
SOUND = (*QUIET, "better", "updated")  # and all that are no failure


@dataclass(frozen=True, slots=True)
class Row:
    """One metric beside what it should be, and the verdict: what follows from [expect], or from a golden value.

    The former is kept or exceeded; the latter same, better, worse, or changed where no way is better, new when there is
    no golden value, updated when the golden value has been written anew. Both are missing when the run has none.
    """

    metric: str
    should: str
    now: float | None
    verdict: str
    golden: bool

    @property
    def sound(self) -> bool:
        """Whether it is no failure."""
        return self.verdict in SOUND

    def __str__(self) -> str:
        now = "none" if self.now is None else f"{self.now:.4g}"
        return f"{self.metric} is {now}, not {self.should}: {self.verdict}"


@dataclass(frozen=True, slots=True)
class Task:
    """A scenario to fly, where its record goes, and what to hold it against; ``golden`` is None when there is none."""

    name: str
    scenario: Scenario
    folder: Path
    golden: Mapping[str, float] | None


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a scenario; wall time [s].

    ``failure`` says why there is nothing, no whole flight or an estimator less to judge. Record and report of one that
    failed are ``kept`` in the folder of its task, if they can be.
    """

    task: Task
    rows: Sequence[Row] = ()
    metrics: Mapping[str, float] = field(default_factory=dict)
    failure: str = ""
    wall_s: float = 0.0
    kept: bool = False

    @property
    def name(self) -> str:
        """The scenario's."""
        return self.task.name

    @property
    def failed(self) -> bool:
        """Whether anything is wrong."""
        return bool(self.failure) or not all(row.sound for row in self.rows)

    def __str__(self) -> str:
        parts = [self.failure.splitlines()[0]] if self.failure else []
        for golden, what in ((False, "of [expect]"), (True, "of golden metrics")):
            verdicts = [row.verdict for row in self.rows if row.golden == golden]
            counts = [f"{verdicts.count(verdict)} {verdict}" for verdict in dict.fromkeys(sorted(verdicts))]
            parts += [f"{what} {', '.join(counts)}"] if counts else []
        if not self.failure and not any(row.golden for row in self.rows):
            parts.append("no golden metrics to compare with")
        verdict = "FAILED" if self.failed else "passed"
        kept = f"; kept in {self.task.folder}" if self.kept else ""
        return f"{self.name}: {verdict} in {self.wall_s:.0f} s: {'; '.join(parts)}{kept}"


@dataclass(frozen=True, slots=True)
class Checked:
    """What `check` found out, scenario by scenario. As text, every verdict and whatever is not as it should be."""

    outcomes: Sequence[Outcome]

    @property
    def passed(self) -> bool:
        """Whether nothing is wrong."""
        return not any(outcome.failed for outcome in self.outcomes)

    def __str__(self) -> str:
        lines = [[str(one), *(f"  {row}" for row in one.rows if not row.sound)] for one in self.outcomes]
        return "\n".join(itertools.chain(*lines))


def check(
    *scenarios: str | Path, golden: str | Path | None = None, workers: int | None = None, out: str | Path = OUT
) -> Checked:
    """Fly scenarios, files or shipped ones by name, and hold their metrics against [expect] and against golden ones.

    ``golden`` is the folder of golden metrics, none without; ``workers`` is the number of processes, one for each core
    without. One scenario is flown in this one, unless it has classes of the user's and ``workers`` is not 1. Of a
    scenario that fails there are record and report in a folder of its name in ``out``. In a test:
    ``result = testbed.check("mine.toml")``, ``assert result.passed, result``. Raises UserError when a scenario or a
    golden file is wrong, or there is nothing to check.
    """
    from rich.console import Console

    for one in scenarios:
        given.require_path("check: scenarios", one, "the file or the name of each")
    for what, folder in (("golden", golden), ("out", out)):
        if folder is not None or what == "out":
            given.require_path(f"check: {what}", folder, "a folder")
    todo = tasks([str(one) for one in scenarios], Path(out), None if golden is None else Path(golden))
    count = None if workers is None else given.whole("check: workers", workers)
    with progress.shown(Console(stderr=True), "check") as tell:
        return Checked(fly_all(todo, tell, count))


def shipped() -> list[str]:
    """The names of the shipped scenarios. Those of the papers are judged over many seeds, by `testbed papers`."""
    return sorted(path.stem for path in data_dir("scenarios").glob("*.toml"))


def tasks(names: Sequence[str], out: Path, golden: Path | None, update: bool = False) -> list[Task]:
    """What to fly for these scenarios, into folders of ``out``, with golden metrics of the folder ``golden``.

    To ``update`` golden metrics is to fly without. Raises UserError when a scenario or a golden file is wrong, when
    there are two of one name, or nothing to check.
    """
    if not names:
        raise UserError("check: there is nothing to check: name a scenario")
    if golden is not None and not update and not golden.is_dir():
        raise UserError(f"--golden {golden}: no such folder: make it with --update")
    made: dict[str, Task] = {}
    for one in names:
        scenario, name = Scenario.load(one), Path(one).stem
        if name in made:
            raise UserError(f"{one}: there is another scenario of that name among these: check one at a time")
        known = read_golden(golden / f"{name}.json") if golden is not None and scenario.golden else None
        if not scenario.expect and known is None and not update:
            raise UserError(
                f"{one}: has no [expect] and no golden metrics (or golden = false): there is nothing to check: add some"
            )
        made[name] = Task(name, scenario, out / name, None if update else known)
    return list(made.values())


def read_golden(path: Path) -> dict[str, float] | None:
    """The golden metrics of a file; None when there is no such file. Raises UserError when it can't be read."""
    try:
        found = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: {error}: {_ANEW}") from None
    if not isinstance(found, dict) or not all(
        type(value) in (int, float) and math.isfinite(value) for value in found.values()
    ):
        raise UserError(f"{path}: is no table of metrics: {_ANEW}")
    return found


def update(outcomes: Sequence[Outcome], folder: Path) -> list[Outcome]:
    """Bring the golden metrics in ``folder`` up to date with these runs; those that failed leave theirs as they are.

    A value that is the same within its tolerance stays: the difference between two versions of a file is what somebody
    should look at, and small steps in one direction add up until they are seen.
    """
    make_folder(folder)
    return [
        _update(outcome, folder / f"{outcome.name}.json")
        if outcome.task.scenario.golden and not outcome.failed
        else outcome
        for outcome in outcomes
    ]


def _update(outcome: Outcome, path: Path) -> Outcome:
    golden = read_golden(path) or {}
    rows = [
        row if row.verdict == "same" else replace(row, verdict="updated")
        for row in against_golden(golden, outcome.metrics)
    ]
    changed = {row.metric: row.now for row in rows if row.verdict == "updated"}
    merged = {key: value for key, value in golden.items() if key not in changed}
    merged |= {key: _rounded(now) for key, now in changed.items() if now is not None}
    if changed:
        write_file(path, (json.dumps(merged, indent=1, sort_keys=True, allow_nan=False) + "\n").encode())
    return replace(outcome, rows=[*outcome.rows, *rows])


def _rounded(value: float) -> float:
    return value if value == round(value) else float(f"{value:.{DIGITS}g}")


NONE = Bounds(max=0.0)


def judge(expect: Mapping[str, Bounds], metrics: Mapping[str, float]) -> list[Row]:
    """Each expected metric beside its bounds; one that is missing, but for a count of none, is no better."""
    rows = []
    for key, bounds in expect.items():
        now = metrics.get(key, 0.0 if key.endswith(LOST) else None)
        verdict = "missing" if now is None else "kept" if bounds.hold(now) else "exceeded"
        rows.append(Row(key, str(bounds), now, verdict, False))
    return rows


def against_golden(golden: Mapping[str, float], metrics: Mapping[str, float]) -> list[Row]:
    """Each metric beside its golden value, those of the machine left out."""
    rows = []
    for key in sorted(golden.keys() | metrics.keys()):
        if key.startswith("run."):
            continue
        before, now = golden.get(key), metrics.get(key)
        if before is None:
            rows.append(Row(key, "none", now, "new", True))
        else:
            measure = measures.find(key) or measures.Measure(measures.Aim.NONE)
            size = golden.get(f"{key.partition('.')[0]}.{measure.size}")
            verdict = "missing" if now is None else measure.verdict(before, now, size)
            rows.append(Row(key, f"{before:.4g}", now, verdict, True))
    return rows


def fly(task: Task, tell: Callable[[float], None] = lambda share: None) -> Outcome:
    """Fly one scenario and judge it. The record stays when it failed, with a report; otherwise nothing does.

    ``tell`` hears the share of the run that is done.
    """
    started = time.perf_counter()
    try:
        result = loop.run(task.scenario, out=task.folder, progress=lambda now: tell(now.t / now.duration))
        wrong = [NEVER_CLOSED] if result.dataset.attrs.get(CLOSED) == NEVER else []
        if result.failure:
            t = column(result.dataset, "truth/time")[-1]
            wrong = [f"the flight ended after {t:.0f} s: {result.failure}"]
        ended = [f"{name} has ended: {why}" for name, why in result.ended.items()]
        failure = "\n".join([*wrong, *ended])
        # estimates that are no numbers are in no other metric: there must be none, unless it is said
        lost = {key for key in result.metrics if key.endswith(LOST)} - set(task.golden or ())
        lost -= {name + LOST for name in result.ended}  # which have failed already
        rows = judge(dict.fromkeys(sorted(lost), NONE) | task.scenario.expect, result.metrics)
        if task.golden is not None:
            rows += against_golden(task.golden, result.metrics)
        outcome = Outcome(task, rows, result.metrics, failure, time.perf_counter() - started)
    except Exception as error:
        wall_s = time.perf_counter() - started
        return Outcome(task, failure=_described(error), wall_s=wall_s, kept=task.folder.exists())
    if not outcome.failed:
        clear(task.folder)
        return outcome
    try:
        report.write_report(result.dataset, result.metrics, task.folder)
    except Exception as error:
        outcome = replace(outcome, failure="\n".join(filter(None, (failure, f"no report: {_described(error)}"))))
    return replace(outcome, kept=True)


def _described(error: Exception) -> str:
    """What an error says; where it comes from too, unless it is a user's mistake."""
    if isinstance(error, UserError):
        return str(error)
    return f"{type(error).__name__}: {error}\n{traceback.format_exc()}"


def clear(folder: Path) -> None:
    """Remove what a run left in its folder, and the folder when nothing else is in it."""
    with suppress(OSError, UserError):
        start_anew(folder)
        folder.rmdir()


# --- all of them


def fly_all(todo: Sequence[Task], tell: Tell | None = None, workers: int | None = None) -> list[Outcome]:
    """Fly all tasks, as many at a time as there are cores, or ``workers``; their outcomes in the order of these.

    They are flown in a folder beside theirs that goes at the end, whatever ends it: only what failed comes to its own.
    """
    parent = todo[0].folder.parent
    make_folder(parent)
    # The longest first, so that no core has much to do when the others have finished.
    longest = sorted(todo, key=lambda task: -task.scenario.duration_s * (1 + len(task.scenario.estimator)))
    total_s = sum(task.scenario.duration_s for task in todo)
    done: dict[str, Outcome] = {}

    def say(now: pool.Standing[Task]) -> None:
        if tell is not None:
            flown_s = sum(one.task.scenario.duration_s for one in done.values())
            flown_s += sum(share * task.scenario.duration_s for task, share in now.running)
            names = ", ".join(task.name for task, _ in now.running)
            tell(flown_s / total_s, f"{len(done)} of {len(todo)} scenarios  {names}")

    with (
        tempfile.TemporaryDirectory(prefix=".flying_", dir=parent, ignore_cleanup_errors=True) as flying,
        pool.opened(len(todo), workers, apart=any(task.scenario.has_own_code for task in todo)) as crew,
    ):
        own = {task.name: task.folder for task in todo}
        for flown in crew.work(fly, (replace(task, folder=Path(flying, task.name)) for task in longest), say):
            outcome = flown.result or Outcome(flown.task, failure=str(flown.error))
            task = replace(flown.task, folder=own[flown.task.name])
            clear(task.folder)
            if outcome.failed:
                outcome = _keep(outcome, flown.task.folder, task.folder)
            done[task.name] = replace(outcome, task=task)
    return [done[task.name] for task in todo]


def _keep(outcome: Outcome, flown: Path, folder: Path) -> Outcome:
    """Bring what is in the folder where it was flown into its own, unless files of somebody else are in the way."""
    outcome = replace(outcome, kept=False)
    if not (flown / RECORD).exists():  # its process has died before there was one
        return outcome
    found = list(flown.iterdir())
    try:
        require_own(folder, [path.name for path in found])
        make_folder(folder)
    except UserError as error:
        return replace(outcome, failure="\n".join(filter(None, (outcome.failure, f"not kept: {error}"))))
    for path in found:
        path.replace(folder / path.name)
    return replace(outcome, kept=True)


def make_folder(folder: Path) -> None:
    """Make a folder for results or golden metrics. Raises UserError when it can't be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:  # ValueError: a name that can be none
        raise UserError(f"{folder}: can't be made: {getattr(error, 'strerror', None) or error}") from None


# --- telling


def table(outcomes: Iterable[Outcome], verbose: bool = False) -> Table | None:
    """The metrics that are worth reading, all of them if ``verbose``; None when there is none."""
    from rich.table import Table

    rows = Table("scenario", "metric", "should be", "is", "change", "verdict")
    rows.columns[1].no_wrap = True
    for name, row in ((outcome.name, row) for outcome in outcomes for row in outcome.rows):
        if not verbose and row.verdict in QUIET:
            continue
        verdict = row.verdict if row.verdict in QUIET else f"[{'green' if row.sound else 'bold red'}]{row.verdict}[/]"
        now = "missing" if row.now is None else f"{row.now:.4g}"
        rows.add_row(name, row.metric, row.should, now, _change(row), verdict)
    return rows if rows.row_count else None


def _change(row: Row) -> str:
    """By how much it is off its golden value."""
    golden = float(row.should) if row.golden and row.should != "none" else 0.0
    return "" if row.now is None or not golden else f"{100 * (row.now / golden - 1):+.1f} %"


_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def is_junit(content: bytes) -> bool:
    """Whether a file is a report of `junit`, or empty."""
    return not content or b"<testsuites" in content[:200]


def junit(outcomes: Sequence[Outcome]) -> bytes:
    """All outcomes as JUnit XML: a suite for each scenario; a case for the flight, [expect], and each estimator."""
    from junitparser import Error
    from junitparser.xunit2 import JUnitXml, TestSuite

    report = JUnitXml("testbed check")
    for outcome in outcomes:
        suite = TestSuite(outcome.name)
        flight = _case(outcome.name, "flight", outcome.wall_s)
        if outcome.failure:
            flight.result = [_complaint(Error, outcome.failure.splitlines()[0], outcome.failure)]
        suite.add_testcase(flight)
        for group, found in itertools.groupby(outcome.rows, _group):
            suite.add_testcase(_judged(outcome.name, group, list(found)))
        report.add_testsuite(suite)
    report.update_statistics()
    text: bytes = report.tostring()
    return text


def _judged(name: str, group: str, rows: Sequence[Row]) -> TestCase:
    from junitparser import Failure

    case = _case(name, group, 0.0)
    bad = [str(row) for row in rows if not row.sound]
    if bad:
        case.result = [_complaint(Failure, f"{len(bad)} of {len(rows)} metrics", "\n".join(bad))]
    return case


def _case(suite: str, name: str, wall_s: float) -> TestCase:
    from junitparser.xunit2 import TestCase

    return TestCase(name, suite, round(wall_s, 3))


def _group(row: Row) -> str:
    return f"golden {row.metric.partition('.')[0]}" if row.golden else "expect"


def _complaint(kind: type[Error | Failure], message: str, text: str) -> Error | Failure:
    """An error or a failure; characters that XML can't have become question marks."""
    complaint = kind(_NOT_XML.sub("?", message), kind.__name__.lower())
    complaint.text = _NOT_XML.sub("?", text)
    return complaint
