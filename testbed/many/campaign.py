"""Many seeds: one scenario flown many times, for every combination of varied values, on Dask.

Run k of a combination has the scenario's own seed + k, so `testbed run --seed` flies any one of them again, bit for
bit. Every run is a task by itself: its numbers can't depend on how many workers there are, or on which of them it ran.
Results come back to this process, which writes them into the campaign's folder as they finish; a campaign that was
interrupted carries on with the runs that are missing.
"""

# mypy: untyped-calls-exclude="distributed"

from __future__ import annotations

import asyncio
import functools
import hashlib
import io
import itertools
import json
import logging
import math
import shutil
import time
import traceback
import uuid
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import nav
import testbed
from nav.samples import Array
from testbed.data import data_dir, write_file
from testbed.errors import UserError
from testbed.motion import aircraft
from testbed.motion.sections import FlightTruth
from testbed.motion.table import MotionSource, Replay, save_motion
from testbed.scenario import Scenario
from testbed.score import metrics

if TYPE_CHECKING:
    import xarray
    from distributed import Client

    from testbed.report.campaign import Statistics

HISTORY_HZ = 1.0  # rate at which a run's errors are kept
CONNECT_S = 3.0  # how long a scheduler may take to answer
WORKER_WAIT_S = 10.0  # how long its first worker may take to appear
POLL_S = 2.0  # how often progress is told when no run finishes
SETUP = "setup.json"
# An interrupt from the terminal reaches the workers too, where it would end in a traceback: this process stops them.
IGNORE_INTERRUPT = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
PRESENTATION = ("report", "mavlink")  # rooms that change no number


@dataclass(frozen=True, slots=True)
class Combination:
    """One choice of the varied values, as given, and the scenario that it makes."""

    values: Mapping[str, str]
    scenario: Scenario

    def __str__(self) -> str:
        return ", ".join(f"{key}={value}" for key, value in self.values.items())


@dataclass(frozen=True, slots=True)
class Outcome:
    """What is kept of one run: its metrics, and its errors over time at `HISTORY_HZ`.

    ``history`` has ``time`` (N,) [s], ``outage`` (N,) 1 while some GNSS receiver has no fix, and for each estimator
    ``<name>.error`` horizontal position error [m], ``<name>.sigma`` its own 1-sigma sqrt(P_N + P_E) [m] and
    ``<name>.nees`` the position NEES per degree of freedom; each (N,), NaN while aligning. Of an estimator of attitude
    alone they are the error of roll and pitch [deg], its sigma [deg] and the attitude NEES.
    """

    combination: int
    seed: int
    metrics: Mapping[str, float]
    history: Mapping[str, Array]


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

    ``elapsed_s`` is wall time; ``activity`` says what is going on when it is not simply flying.
    """

    done: int
    failed: int
    total: int
    before: int
    elapsed_s: float
    activity: str

    @property
    def remaining_s(self) -> float:
        """Wall time still to go at the pace so far, NaN before the first run."""
        flown = self.done + self.failed - self.before
        return self.elapsed_s / flown * (self.total - self.done - self.failed) if flown else math.nan

    def __str__(self) -> str:
        parts = [f"{self.done}/{self.total}", f"{self.elapsed_s:.0f} s"]
        if math.isfinite(self.remaining_s):
            parts.append(f"about {self.remaining_s:.0f} s to go")
        if self.failed:
            parts.append(f"{self.failed} failed")
        return "  ".join(filter(None, [*parts, self.activity]))


@dataclass(frozen=True, slots=True)
class CampaignResult:
    """A finished campaign: folder, combinations, outcomes in order of combination and seed, failures, statistics."""

    path: Path
    combinations: Sequence[Combination]
    outcomes: Sequence[Outcome]
    failures: Sequence[Failure]
    statistics: Statistics


@dataclass(frozen=True, slots=True)
class _Task:
    """All that a worker needs to fly one run."""

    combination: int
    seed: int
    scenario: Scenario
    truth: Path | None  # the flight that all runs share; a worker that can't see it flies it again
    code: str


def campaign(
    scenario: str | Path,
    runs: int,
    *,
    vary: Mapping[str, Sequence[str]] | None = None,
    overrides: Sequence[str] = (),
    scheduler: str | None = None,
    out: Path,
    workers: int | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> CampaignResult:
    """Fly ``runs`` seeds of a scenario for every combination of the values in ``vary``, and say what they show.

    ``vary`` maps a key path to the values it takes, each as ``--set`` takes it; ``overrides`` apply to all runs.
    ``scheduler`` is the address of a Dask scheduler; without, a cluster of one process per core (or ``workers``) lives
    as long as the campaign. A script that calls this needs the guard ``if __name__ == "__main__":``, because those
    processes import it. In ``out`` there are, at the end, runs/, campaign.csv, campaign.json and figures; what is there
    already of the same campaign is not flown again.

    A run that fails is in ``failures`` and stops no other. Raises UserError when the scenario or a varied value is
    wrong, when ``out`` can't be written or holds another campaign, or when the scheduler can't be reached.
    """
    from dask.system import CPU_COUNT

    from testbed.report import campaign as campaign_report

    combinations = _combinations(scenario, vary or {}, overrides)
    if runs < 1:
        raise UserError(f"--runs {runs}: give at least 1")
    folder = out.absolute()
    _claim(folder, _setup([one.scenario for one in combinations], vary or {}, overrides))
    wanted = [(i, c.scenario.seed + k) for i, c in enumerate(combinations) for k in range(runs)]
    stored = {run: _load(folder, *run) for run in wanted}
    missing = [run for run, outcome in stored.items() if outcome is None]
    failures: list[Failure] = []
    if missing:
        truth = _share_truth(folder, combinations)
        code = _code()
        tasks = [_Task(i, seed, combinations[i].scenario, truth, code) for i, seed in missing]
        tell = _Teller(progress, len(wanted), len(wanted) - len(missing))
        with _connect(scheduler, min(workers or CPU_COUNT, len(tasks))) as client:
            for flown in _fly_all(client, tasks, tell):
                if isinstance(flown, Failure):
                    failures.append(flown)
                else:
                    _store(folder, flown)
                    stored[flown.combination, flown.seed] = flown
    outcomes = [outcome for outcome in stored.values() if outcome is not None]
    failures.sort(key=lambda f: (f.combination, f.seed))
    statistics = campaign_report.statistics(combinations, outcomes)
    result = CampaignResult(folder, combinations, outcomes, failures, statistics)
    campaign_report.save(result)
    return result


def _combinations(
    scenario: str | Path, vary: Mapping[str, Sequence[str]], overrides: Sequence[str]
) -> list[Combination]:
    """Every combination of varied values, each loaded and so checked. They differ in nothing else."""
    for key, listed in vary.items():
        if key == "seed":
            raise UserError("--vary seed: every combination is flown with many seeds already: use --runs")
        if not listed or len(set(listed)) < len(listed):
            raise UserError(f"--vary {key}: give each value once, such as {key}=0,5,10")
    made = []
    for values in itertools.product(*vary.values()):
        chosen = dict(zip(vary, values, strict=True))
        loaded = Scenario.load(scenario, [*overrides, *(f"{key}={value}" for key, value in chosen.items())])
        made.append(Combination(chosen, loaded))
    if not made[0].scenario.estimator:
        raise UserError(f"{scenario}: has no estimator, so a campaign would have nothing to compare: add [[estimator]]")
    return made


# --- the folder


def _setup(
    scenarios: Sequence[Scenario], vary: Mapping[str, Sequence[str]], overrides: Sequence[str]
) -> dict[str, Any]:
    """Everything that decides the numbers, apart from the seeds."""
    packages = ("numpy", "scipy", "numba", "jsbsim", "pygeomag")
    flown = {one.truth.aircraft for one in scenarios if isinstance(one.truth, FlightTruth)}
    return {
        "scenario text": scenarios[0].text,
        "overrides": list(overrides),
        "varied values": {key: list(values) for key, values in vary.items()},
        "code": _code(),
        "aircraft": [aircraft.digest(name) for name in sorted(flown)],
        "versions": {package: version(package) for package in packages},
    }


@functools.cache
def _code() -> str:
    """Digest of the code and the aircraft that decide the numbers of a run in this process."""
    digest = hashlib.sha256()
    package = Path(testbed.__file__).parent
    shown = {file for room in PRESENTATION for file in (package / room).rglob("*.py")}
    for folder, pattern in (
        (Path(nav.__file__).parent, "*.py"),
        (package, "*.py"),
        (data_dir("aircraft"), "*.xml"),
        (data_dir("aircraft"), "*.toml"),
    ):
        for file in sorted(set(folder.rglob(pattern)) - shown):
            digest.update(file.relative_to(folder).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def _claim(folder: Path, setup: Mapping[str, Any]) -> None:
    """Make the campaign's folder, or make sure that it holds this campaign and no other."""
    file = folder / SETUP
    advice = "choose another folder with --out, or delete this one"
    try:
        (folder / "runs").mkdir(parents=True, exist_ok=True)
        if file.exists():
            before = json.loads(file.read_bytes())
            differ = [key for key in setup if before.get(key) != setup[key]]
            if differ:
                raise UserError(f"{folder}: holds a campaign with different {', '.join(differ)}: {advice}")
        elif any((folder / "runs").iterdir()):
            raise UserError(f"{folder}: has runs but no {SETUP} to say of what: {advice}")
        else:
            write_file(file, json.dumps(setup, indent=1).encode())
    except OSError as error:
        raise UserError(f"{folder}: can't write here ({error.strerror}): choose another folder with --out") from None
    except (ValueError, AttributeError):
        raise UserError(f"{file}: is damaged: {advice}") from None


def _stem(folder: Path, combination: int, seed: int) -> Path:
    return folder / "runs" / f"c{combination:03d}_s{seed:06d}"


def _store(folder: Path, outcome: Outcome) -> None:
    """Write one outcome: metrics last, so that a run with metrics is a whole run."""
    stem = _stem(folder, outcome.combination, outcome.seed)
    record = {"combination": outcome.combination, "seed": outcome.seed, "metrics": outcome.metrics}
    arrays = io.BytesIO()
    np.savez_compressed(arrays, **outcome.history)  # type: ignore[arg-type]
    write_file(stem.with_suffix(".npz"), arrays.getvalue())
    write_file(stem.with_suffix(".json"), json.dumps(record, indent=1).encode())


def _load(folder: Path, combination: int, seed: int) -> Outcome | None:
    """A stored outcome; None when there is none, or none that can be read."""
    stem = _stem(folder, combination, seed)
    try:
        values = json.loads(stem.with_suffix(".json").read_bytes())["metrics"]
        with np.load(io.BytesIO(stem.with_suffix(".npz").read_bytes())) as file:
            history = {name: file[name] for name in file.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return Outcome(combination, seed, values, history)


# --- the shared flight


def _share_truth(folder: Path, combinations: Sequence[Combination]) -> Path | None:
    """Fly once the motion that all runs have in common, if they have, and give the folder where it lies."""
    from testbed.feeds.simulated import motion

    first = combinations[0].scenario
    if not all(_same_motion(first, c.scenario) for c in combinations) or not _seed_leaves_motion(first):
        return None
    truth = folder / "truth"
    if not truth.is_dir():
        source = motion(first, first.seed)
        save_motion(source, round(first.duration_s * source.rate_hz) + 1, truth)
        try:
            _require_control(source)
        except UserError:
            shutil.rmtree(truth)
            raise
    return truth


def _require_control(source: MotionSource) -> None:
    """A flight that got out of control says nothing about navigation: don't let its numbers in among the others."""
    if source.failure:
        raise UserError(f"the flight ended early: {source.failure}")


def _same_motion(one: Scenario, other: Scenario) -> bool:
    return _moving(one) == _moving(other)


def _moving(scenario: Scenario) -> tuple[object, ...]:
    """All that the motion depends on but the seed, and what is estimated when that is fed back."""
    return scenario.truth, scenario.plan, scenario.duration_s, scenario.autopilot


def _seed_leaves_motion(scenario: Scenario) -> bool:
    """Whether the motion is the same for every seed: nothing estimated is fed back, and no gust follows the seed."""
    if scenario.autopilot.feedback.estimators:
        return False
    if not isinstance(scenario.truth, FlightTruth):
        return True
    wind = scenario.truth.wind
    return wind.turbulence == "none" or wind.turbulence_seed is not None


# --- the workers


@contextmanager
def _connect(scheduler: str | None, workers: int) -> Iterator[Client]:
    """A client of the scheduler at an address, or of a cluster of our own on the loopback interface."""
    import dask
    from distributed import Client, LocalCluster

    # A scheduler that goes away is told of in a line; the client would add its traceback.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    if scheduler is not None:
        _require_scheduler(scheduler)
        with Client(scheduler, set_as_default=False) as client, client.as_current():
            try:
                client.wait_for_workers(1, timeout=WORKER_WAIT_S)
            except TimeoutError:
                raise UserError(
                    f"{scheduler}: the scheduler has no workers: start some with `dask worker {scheduler}`"
                ) from None
            yield client
        return
    # Dask starts workers with one BLAS thread each, which is what matrices of this size want. Its statistical profiler
    # would look at the Python stack a hundred times a second.
    with (
        dask.config.set({"distributed.worker.profile.enabled": False}),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},  # or it would take port 8787 all the same
            memory_limit=None,
            preload=[IGNORE_INTERRUPT],
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
        client.as_current(),
    ):
        yield client


def _require_scheduler(address: str) -> None:
    """Ask whoever answers at the address what it is: a client that can't connect leaves threads and noise behind."""
    from concurrent.futures import ThreadPoolExecutor

    from distributed.core import rpc
    from distributed.security import Security

    async def ask() -> Mapping[str, Any]:
        arguments = Security().get_connection_args("client")
        async with rpc(address, connection_args=arguments, timeout=CONNECT_S) as peer:
            return await asyncio.wait_for(peer.identity(), CONNECT_S)

    try:
        # In a thread of its own, since a notebook has an event loop running in this one.
        with ThreadPoolExecutor(1) as pool:
            identity = pool.submit(asyncio.run, ask()).result()
    except ValueError as error:
        raise UserError(f"--scheduler {address}: {error}: give an address like tcp://host:8786") from None
    except OSError:
        raise UserError(
            f"--scheduler {address}: nothing answers there: start one with `dask scheduler`, or leave the option out"
        ) from None
    except MemoryError:  # the first bytes of another protocol, read as the size of a message
        identity = {}
    if identity.get("type") != "Scheduler":
        raise UserError(f"--scheduler {address}: what answers there is no Dask scheduler")


def _fly_all(client: Client, tasks: Sequence[_Task], tell: _Teller) -> Iterator[Outcome | Failure]:
    """Outcomes and failures as they come. A task whose worker dies is given to another one."""
    from concurrent.futures import CancelledError

    from distributed import wait

    campaign_id = uuid.uuid4().hex  # an old scheduler may remember another campaign
    waiting = {
        client.submit(_fly, task, key=f"run-{campaign_id}-{task.combination}-{task.seed}", pure=False): task
        for task in tasks
    }
    tell.now("starting")
    try:
        while waiting:
            try:
                done = wait(list(waiting), timeout=POLL_S, return_when="FIRST_COMPLETED").done
            except TimeoutError:
                tell.now("" if client.scheduler_info()["workers"] else "waiting for a worker")
                continue
            for future in done:
                result = _result(future, waiting.pop(future))
                tell.finished(isinstance(result, Failure))
                yield result
    except CancelledError:
        raise UserError("the scheduler has gone: give the same command again to fly the runs that are left") from None


def _result(future: Any, task: _Task) -> Outcome | Failure:
    from concurrent.futures import CancelledError

    from distributed.scheduler import KilledWorker

    try:
        result: Outcome | Failure = future.result()
    except CancelledError:
        raise
    except KilledWorker as error:
        deaths = error.allowed_failures + 1
        message = f"its worker process died, {deaths} times over: out of memory, or a crash outside Python?"
        return Failure(task.combination, task.seed, message)
    except Exception as error:
        return Failure(task.combination, task.seed, f"{type(error).__name__}: {error}", traceback.format_exc())
    return result


def _fly(task: _Task) -> Outcome | Failure:
    """Fly one run. Called on a worker."""
    from testbed.feeds.simulated import motion
    from testbed.loop.loop import run

    try:
        if _code() != task.code:
            raise UserError(
                "this worker has other code than the campaign began with: has a file been edited meanwhile?"
            )
        shared = task.truth if task.truth is not None and task.truth.is_dir() else None
        source = Replay(shared) if shared else motion(task.scenario, task.seed)
        result = run(task.scenario, seed=task.seed, source=source)
        _require_control(source)
        # How long a run took says nothing about the filter and is never the same twice.
        kept = {key: value for key, value in result.metrics.items() if not key.startswith("run.")}
        finite = {key: value for key, value in kept.items() if math.isfinite(value)}
        return Outcome(task.combination, task.seed, finite, _history(result.dataset))
    except Exception as error:
        message = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
        return Failure(task.combination, task.seed, message, traceback.format_exc())


def _history(dataset: xarray.DataTree) -> dict[str, Array]:
    """The errors of a run over time, as `Outcome` keeps them."""
    t = metrics.column(dataset, "truth/time")
    kept = {"time": t, "outage": metrics.inside(t, metrics.outages(dataset)).astype(float)}
    for name in metrics.names(dataset):
        errors = metrics.errors(dataset, name)
        rows = np.searchsorted(t, errors.t - metrics.SAME_TIME_S)
        if errors.attitude_only:
            error, sigma, nees = np.rad2deg(errors.tilt), np.rad2deg(errors.sigma_attitude), errors.attitude_nees
        else:
            error, sigma, nees = errors.horizontal, errors.sigma_position, errors.position_nees
        for what, values in (
            ("error", error),
            ("sigma", np.hypot(sigma[:, 0], sigma[:, 1])),
            ("nees", np.where(errors.valid, nees, np.nan)),
        ):
            kept[f"{name}.{what}"] = np.full(len(t), np.nan)
            kept[f"{name}.{what}"][rows] = values
    every = max(1, round(float(dataset.attrs["record_rate_hz"]) / HISTORY_HZ))
    return {name: values[::every].copy() for name, values in kept.items()}


# --- telling


class _Teller:
    """Counts what has finished and passes it on."""

    def __init__(self, progress: Callable[[Progress], None] | None, total: int, done: int) -> None:
        self._progress = progress
        self._total, self._before, self._done, self._failed = total, done, done, 0
        self._started = time.monotonic()

    def finished(self, failed: bool) -> None:
        """One more run is through."""
        self._failed += failed
        self._done += not failed
        self.now("")

    def now(self, activity: str) -> None:
        """Tell how things stand."""
        if self._progress is not None:
            elapsed = time.monotonic() - self._started
            self._progress(Progress(self._done, self._failed, self._total, self._before, elapsed, activity))
