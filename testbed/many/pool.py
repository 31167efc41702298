"""Many tasks on many processors: in this process, on worker processes of our own, or on a Dask cluster.

Workers of our own are Dask workers that this module starts as programs, and not as copies of the calling one: a script
needs no ``if __name__ == "__main__":`` to use them, and an interrupt from the terminal doesn't reach them. Dask can't
end a task that has begun, but a process can be killed, so the end of the pool is theirs, whatever they are doing.
"""

# mypy: untyped-calls-exclude="distributed"

from __future__ import annotations

import asyncio
import itertools
import logging
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeAlias, TypeVar, cast

from testbed import interrupts, threads
from testbed.errors import UserError

if TYPE_CHECKING:
    from distributed import Client, Future, LocalCluster, Scheduler

CONNECT_S = 3.0  # how long a scheduler may take to answer
WORKER_WAIT_S = 10.0  # how long its first worker may take to appear
POLL_S = 0.5  # how often the workers are looked at when nothing comes from them
GONE = "the scheduler has gone: give the same command again for what is left"
PRELOAD = "testbed.many.worker"
PARENT = "TESTBED_POOL"  # the variable that tells a worker whose it is, by the number of the process
SHARE_S = 0.3  # how often a task tells how far it is
AHEAD = 2  # tasks given to a cluster for each of its threads, so that none waits for the next

A = TypeVar("A")
R = TypeVar("R")


# What is done for one task. It may tell, as often as it likes, the share of it that is done.
Work: TypeAlias = Callable[[A, Callable[[float], None]], R]


class Died(Exception):
    """The process that worked on a task has died."""


@dataclass(frozen=True, slots=True)
class Done(Generic[A, R]):
    """A task that is through: its result, or what it raised, with the traceback."""

    task: A
    result: R | None = None
    error: Exception | None = None
    trace: str = ""


@dataclass(frozen=True, slots=True)
class Standing(Generic[A]):
    """How things stand: the tasks given to workers, each with the share of it that is done, and how many take them."""

    running: Sequence[tuple[A, float]]
    workers: int


class Pool(Protocol):
    """Whoever works off tasks."""

    def work(
        self, do: Work[A, R], tasks: Iterable[A], tell: Callable[[Standing[A]], None] | None = None
    ) -> Iterator[Done[A, R]]:
        """Each task when it is through, in whatever order. A task is taken from ``tasks`` when it can be begun."""
        ...


@contextmanager
def opened(tasks: int, workers: int | str | None = None, apart: bool = False) -> Iterator[Pool]:
    """A pool for so many tasks: that many ``workers``, one a core without, or those of a scheduler by its address.

    With one worker tasks are done in this process, and so is a single one: only with ``workers`` of 1 where they are to
    be done ``apart``, as what may end a process. Raises UserError when there is no such scheduler, or no workers.
    """
    if isinstance(workers, str):
        _require_scheduler(workers)
        with _client(workers) as client:
            yield _Cluster(client, _hired(client, workers))
        return
    if workers is not None and workers < 1:
        raise UserError(f"workers {workers}: give at least 1, or none for one a core")
    count = min(workers or cores(), tasks)
    if count <= 1 and not (apart and workers != 1):
        yield _Here()
        return
    with (
        _scheduler() as cluster,
        _client(cluster) as client,
        _Crew(cluster, count) as crew,
    ):
        yield _Cluster(client, crew)


def cores() -> int:
    """The processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# --- in this process


class _Here:
    """One task after the other."""

    def work(
        self, do: Work[A, R], tasks: Iterable[A], tell: Callable[[Standing[A]], None] | None = None
    ) -> Iterator[Done[A, R]]:
        for task in tasks:

            def share(done: float, task: A = task) -> None:
                if tell is not None:
                    tell(Standing([(task, done)], 1))

            share(0.0)
            try:
                done = Done(task, do(task, share))
            except Exception as error:
                done = Done(task, error=error, trace=traceback.format_exc())
            yield done


# --- on Dask


class _Workers(Protocol):
    """Whoever a scheduler has."""

    def room(self) -> int:
        """How many tasks they can have at a time. Raises UserError when they can have none any more."""
        ...

    def ended(self, name: str) -> str:
        """How the process of a worker ended, to be put after that; empty when it is not known."""
        ...


@dataclass(slots=True)
class _Cluster:
    """Tasks are given to the scheduler as there is room for them, and what is heard of them comes through a queue."""

    client: Client
    workers: _Workers

    def work(
        self, do: Work[A, R], tasks: Iterable[A], tell: Callable[[Standing[A]], None] | None = None
    ) -> Iterator[Done[A, R]]:
        name = uuid.uuid4().hex  # an old scheduler may remember other tasks
        heard: queue.SimpleQueue[Future[Any] | tuple[float, tuple[int, float]]] = queue.SimpleQueue()
        self.client.subscribe_topic(name, heard.put)
        coming = enumerate(tasks)
        futures: dict[Future[Any], int] = {}
        running: dict[int, tuple[A, float]] = {}
        while True:
            room = self.workers.room()
            given = list(itertools.islice(coming, max(room - len(futures), 0)))
            for number, task in given:
                future = self.client.submit(_do, do, task, number, name, key=f"{name}-{number}", pure=False)
                futures[future], running[number] = number, (task, 0.0)
                future.add_done_callback(heard.put)
            if room and not futures:
                return
            if tell is not None:
                tell(Standing(list(running.values()), room))
            try:
                news = heard.get(timeout=POLL_S)
            except queue.Empty:
                continue
            if not isinstance(news, tuple):
                yield self._done(news, running.pop(futures.pop(news))[0])
            elif news[1][0] in running:
                number, share = news[1]
                running[number] = running[number][0], share

    def _done(self, future: Future[Any], task: A) -> Done[A, Any]:
        from concurrent.futures import CancelledError

        from distributed.scheduler import KilledWorker

        try:
            return Done(task, future.result())
        except CancelledError:
            raise UserError(GONE) from None
        except KilledWorker as error:
            how = self.workers.ended(str(error.last_worker.name))
            return Done(task, error=Died(f"its process ended{how}: out of memory, or a crash outside Python?"))
        except Exception as error:
            return Done(task, error=error, trace=traceback.format_exc())


def _do(do: Work[A, R], task: A, number: int, topic: str) -> R:
    """Do one task on a worker."""
    from distributed import get_worker

    worker, last = get_worker(), 0.0

    def tell(share: float) -> None:
        nonlocal last
        if time.monotonic() - last >= SHARE_S:
            last = time.monotonic()
            worker.log_event(topic, (number, share))

    return do(task, tell)


@contextmanager
def _client(of: str | LocalCluster) -> Iterator[Client]:
    from distributed import Client

    # A scheduler that goes away is told of in a line; the client would add its traceback, and whoever still had
    # something to say to a connection that is closed in the end.
    for name in ("distributed.client", "distributed.batched"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with Client(of, set_as_default=False) as client, client.as_current():
        yield client


# --- a cluster of somebody else's


@dataclass(frozen=True, slots=True)
class _Hired:
    """The workers of a scheduler that was there before."""

    client: Client

    def room(self) -> int:
        if self.client.status != "running":
            raise UserError(GONE)
        try:
            return AHEAD * int(sum(self.client.nthreads().values()))
        except OSError:
            raise UserError(GONE) from None

    def ended(self, name: str) -> str:
        return ", several times over"


def _hired(client: Client, scheduler: str) -> _Hired:
    try:
        client.wait_for_workers(1, timeout=WORKER_WAIT_S)
    except TimeoutError:
        raise UserError(
            f"{scheduler}: the scheduler has no workers: start some with `dask worker {scheduler}`"
        ) from None
    return _Hired(client)


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


# --- a cluster of our own


@contextmanager
def _scheduler() -> Iterator[LocalCluster]:
    """A scheduler on the loopback interface without workers."""
    import dask
    from distributed import LocalCluster

    with (
        # Workers that say nothing for minutes have been asleep with the computer: we see for ourselves if one has died.
        dask.config.set({"distributed.scheduler.worker-ttl": None}),
        LocalCluster(
            n_workers=0,
            processes=False,
            protocol="tcp",
            host="127.0.0.1",
            dashboard_address=None,
            # Without an address it would take port 8787 for its dashboard all the same.
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0", "allowed_failures": 0},
            silence_logs=logging.CRITICAL,
        ) as cluster,
    ):
        yield cluster


@dataclass(slots=True)
class _Crew:
    """Worker processes of one thread each, killed at the end; in the place of one that dies comes another."""

    cluster: LocalCluster
    count: int
    _processes: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)
    _began: set[str] = field(default_factory=set)  # of those processes, whom the scheduler has seen
    _names: Iterator[int] = field(default_factory=itertools.count)
    _ending: ExitStack = field(default_factory=ExitStack)
    _hiring: threading.Lock = field(default_factory=threading.Lock)
    _over: bool = False  # an interrupt that is not heard kills them from another thread: then nobody else comes
    _folder: Path = field(init=False)

    def __enter__(self) -> _Crew:
        with self._ending as ending:
            self._folder = Path(ending.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True)))
            ending.enter_context(interrupts.lastly(self._kill))
            ending.callback(self._kill)
            for _ in range(self.count):
                self._hire()
            self._ending = ending.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.close()

    def room(self) -> int:
        there = {str(worker.name) for worker in cast("Scheduler", self.cluster.scheduler).workers.values()}
        self._began |= there
        ended = [name for name, process in self._processes.items() if process.poll() is not None]
        for name in ended:
            if name not in self._began:
                raise UserError(f"a worker process ended before it had begun: {self._said(name)}")
        for _ in range(self.count - len(self._processes) + len(ended)):
            self._hire()
        return len(there)

    def ended(self, name: str) -> str:
        code = self._processes[name].wait()
        return f" by signal {-code}" if code < 0 else f" with exit code {code}"

    def _hire(self) -> None:
        name = f"testbed-{next(self._names)}"
        worker = ["distributed.cli.dask_worker", self.cluster.scheduler_address, "--name", name, "--nthreads", "1"]
        worker += ["--no-nanny", "--no-dashboard", "--memory-limit", "0", "--death-timeout", "10"]
        worker += ["--local-directory", str(self._folder), "--preload", PRELOAD]
        path = os.pathsep.join(folder or os.getcwd() for folder in sys.path)
        with (self._folder / f"{name}.err").open("wb") as said, self._hiring, interrupts.held():
            if self._over:
                return
            self._processes[name] = subprocess.Popen(
                [sys.executable, "-P", "-m", *worker],
                env=os.environ | _ENVIRONMENT | {"PYTHONPATH": path, PARENT: str(os.getpid())},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=said,
                start_new_session=True,
            )

    def _said(self, name: str) -> str:
        lines = (self._folder / f"{name}.err").read_text("utf-8", "replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing"

    def _kill(self) -> None:
        with self._hiring:
            self._over = True
            for process in self._processes.values():
                process.kill()
        for process in self._processes.values():
            process.wait()


# Dask's statistical profiler would look at the Python stack a hundred times a second, and it would log that its
# scheduler has gone.
_ENVIRONMENT = {
    **threads.ONE,
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "false",
    "DASK_LOGGING__DISTRIBUTED": "critical",
}
