"""The pool: tasks as there is room for them, results as they come, and an end that nothing outlives."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from testbed.many import pool

Tell = Callable[[float], None]


def square(task: int, tell: Tell) -> tuple[int, int]:
    tell(0.5)
    if task == 3:
        raise ValueError("three")
    if task == 4:
        os.kill(os.getpid(), signal.SIGKILL)
    return task * task, os.getpid()


@pytest.mark.ci
def test_results_errors_and_deaths() -> None:
    given: list[int] = []
    got: list[int] = []

    def coming() -> Iterator[int]:
        for task in range(12):
            given.append(task)
            assert len(given) - len(got) <= 2, "more than there is room for"
            yield task

    results, pids = {}, set()
    with pool.opened(12, 2) as crew:
        for done in crew.work(square, coming()):
            got.append(done.task)
            results[done.task] = done.result[0] if done.result is not None else done.error
            pids |= {done.result[1]} if done.result is not None else set()
    assert sorted(got) == list(range(12))
    assert {k: v for k, v in results.items() if k not in (3, 4)} == {k: k * k for k in range(12) if k not in (3, 4)}
    assert str(results[3]) == "three"
    assert str(results[4]).startswith("its process ended by signal 9: ")
    assert os.getpid() not in pids
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_workers_that_slept_are_not_given_up() -> None:
    """A computer may sleep for hours, or its user stop the program; Dask would give up workers after five minutes."""
    with pool._scheduler() as cluster:
        assert cluster.scheduler.worker_ttl is None


def test_one_worker_is_this_process() -> None:
    told: list[float] = []
    with pool.opened(9, 1) as crew:
        done = list(crew.work(square, [2, 3, 5], lambda now: told.append(now.running[0][1])))
    assert [one.result for one in done] == [(4, os.getpid()), None, (25, os.getpid())]
    assert "ValueError: three" in done[1].trace
    assert told == [0.0, 0.5] * 3


SCRIPT = """
import os, signal, sys, time
from testbed.many import pool

def work(task, tell):
    tell(0.5)
    open(f"{os.getpid()}.pid", "w").close()
    time.sleep(600)

with pool.opened(2, 2) as crew:
    for done in crew.work(work, range(2), lambda now: None):
        pass
"""


def gone(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


@pytest.mark.ci
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_workers_end_with_who_started_them(tmp_path: Path, number: int) -> None:
    """From a script without a main guard; even when it has no time to end them."""
    (tmp_path / "script.py").write_text(SCRIPT)
    path = os.pathsep.join(filter(None, sys.path))
    with subprocess.Popen(
        [sys.executable, "script.py"], cwd=tmp_path, env=os.environ | {"PYTHONPATH": path},
        stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as running:  # fmt: skip
        while len(pids := [int(path.stem) for path in tmp_path.glob("*.pid")]) < 2:
            assert running.poll() is None, running.stderr.read() if running.stderr else ""
            time.sleep(0.05)
        running.send_signal(number)
        running.communicate()
    deadline = time.monotonic() + 60.0
    while not all(gone(pid) for pid in pids):
        assert time.monotonic() < deadline, "a worker is still there"
        time.sleep(0.1)


@pytest.mark.ci
def test_a_worker_that_cannot_begin_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "PRELOAD", "no_such_module")
    with pool.opened(2, 2) as crew, pytest.raises(pool.UserError, match=r"ended before it had begun: .*no_such_module"):
        list(crew.work(square, [1, 2]))


@pytest.mark.ci
def test_who_is_killed_from_beside_hires_nobody() -> None:
    """An interrupt that the main thread doesn't hear kills its workers while it looks after them."""
    with pool._scheduler() as cluster, pool._Crew(cluster, 1) as crew:
        while not crew.room():
            time.sleep(0.05)
        crew._kill()
        crew.room()
        assert all(process.poll() is not None for process in crew._processes.values())


@pytest.mark.ci
def test_a_worker_that_begins_after_its_pool_has_ended_ends_too() -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    script = "import testbed.many.worker, time; time.sleep(600)"
    path = os.pathsep.join(filter(None, sys.path))
    environment = os.environ | {"PYTHONPATH": path, pool.PARENT: str(ended.pid)}
    assert subprocess.run([sys.executable, "-c", script], env=environment, timeout=60, check=False).returncode == 1
