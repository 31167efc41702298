"""One interrupt ends every command: soon, with one line, and nothing outlives it."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import pytest
from worlds.programs import free_port

from testbed import Scenario, interrupts, run
from testbed.commands.run import _has_rows, _nothing
from testbed.results import MANIFEST, METRICS, RECORD, stamp, start_anew, withdraw, write_result

COMMANDS = {
    "run": (["run", "static_bench", "--set", "duration_s=36000"], r"nothing was recorded|the record so far is .*"),
    "campaign": (["campaign", "static_bench", "--runs", "1000000"], r"what is finished is in .*; the same .*"),
    "check": (["check", "one.toml", "two.toml"], "nothing was concluded"),
    "papers": (["papers"], "nothing was written"),
    "watch": (["watch", "udpin:127.0.0.1:{port}"], ""),
}


def caught(pid: int, number: int) -> bool:
    """Whether a process has a handler for a signal: before it has, not even Python hears of it."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return bool(int(next(line for line in lines if line.startswith("SigCgt")).split()[1], 16) >> (number - 1) & 1)


def group(mark: str) -> list[str]:
    """The processes that a command has started, and itself, wherever they have gone: they inherit its environment."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            zombie = process.joinpath("stat").read_text().rpartition(")")[2].split()[0] == "Z"
            if not zombie and mark.encode() in process.joinpath("environ").read_bytes():
                found.append(process.joinpath("cmdline").read_text().replace("\0", " "))
        except OSError:
            continue
    return found


@pytest.mark.ci
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize(
    "after_s", [0.0, pytest.param(2.0, marks=pytest.mark.slow), pytest.param(8.0, marks=pytest.mark.slow)]
)
def test_an_interrupt_ends_a_command(tmp_path: Path, name: str, number: int, after_s: float) -> None:
    arguments, left = COMMANDS[name]
    arguments = [one.format(port=free_port()) for one in arguments]  # which others may take soon
    bench = Path(__file__).parents[1] / "scenarios" / "static_bench.toml"
    for scenario in ("one", "two"):
        (tmp_path / f"{scenario}.toml").write_text(bench.read_text().replace("duration_s = 300", "duration_s = 36000"))
    mark = f"TESTBED_TEST={tmp_path}"
    path = os.pathsep.join(filter(None, sys.path))
    with subprocess.Popen(
        [sys.executable, "-m", "testbed", *arguments], cwd=tmp_path,
        env=os.environ | dict([mark.split("=")]) | {"PYTHONPATH": path},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, process_group=0,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as running:  # fmt: skip
        while not caught(running.pid, signal.SIGTERM):
            time.sleep(0.001)
        time.sleep(after_s)
        os.killpg(running.pid, number) if number == signal.SIGINT else running.send_signal(number)
        _, said = running.communicate()
    assert "Traceback" not in said
    if name != "watch" or said:  # which shows what it has seen, once it is there
        assert running.returncode == 128 + number, said
        assert re.fullmatch(f"testbed: interrupted(: ({left}))?", said.splitlines()[-1]), said
    deadline = time.monotonic() + 5.0
    while outlived := group(mark):
        assert time.monotonic() < deadline, outlived
        time.sleep(0.05)
    if name in ("check", "papers"):
        assert sorted(one.name for one in tmp_path.iterdir()) == ["one.toml", "two.toml"]


def test_one_interrupt_is_raised_once_at_the_end_of_what_holds_it() -> None:
    """Whatever comes while it is held, or while files are closed, is the same wish."""
    script = """
import os, signal
from testbed import interrupts
with interrupts.heeded():
    try:
        with interrupts.held():
            with interrupts.held():
                os.kill(os.getpid(), signal.SIGINT)
                os.kill(os.getpid(), signal.SIGTERM)
            print("held", flush=True)
        print("not reached")
    finally:
        os.kill(os.getpid(), signal.SIGINT)
        with interrupts.held():
            pass
        print("closed", flush=True)
"""
    ended = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    assert ended.stdout.split() == ["held", "closed"]
    assert (ended.returncode, ended.stderr) == (130, "testbed: interrupted\n")


@pytest.mark.parametrize("of", ["serialize._numba_unpickle", "ExecutionEngine._raw_object_cache_notify"])
def test_an_interrupt_that_is_heard_in_a_kernel_is_raised_when_it_has_returned(of: str) -> None:
    """A kernel that boxes what it returns calls Python, and so does its compiler: raised there it was a traceback."""
    script = (
        f"""
import os, signal, time
from llvmlite.binding.executionengine import ExecutionEngine
from numba.core import serialize
from testbed import interrupts

called = {of}.__code__.co_name
"""
        + """
def hear():
    os.kill(os.getpid(), signal.SIGTERM)
    for _ in range(1000):
        pass

def wait():
    hear()
    print("returned", flush=True)

wait.__code__ = wait.__code__.replace(co_name=called)
with interrupts.heeded():
    wait()
    time.sleep(10)
"""
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=60)
    assert ended.stdout.split() == ["returned"]
    assert (ended.returncode, ended.stderr) == (143, "testbed: interrupted\n")


def test_a_record_without_rows_is_none_to_be_shown(tmp_path: Path) -> None:
    """An interrupt while kernels compile leaves one: to name it sent people to a command that refuses it."""
    assert not _has_rows(tmp_path / "run.nc")
    with h5py.File(tmp_path / "run.nc", "w") as file:
        file.create_group("estimators/ins")
    assert not _has_rows(tmp_path / "run.nc")
    run(Scenario.load("u_turn", {"duration_s": 2, "expect": {}}), out=tmp_path / "flown")
    assert _has_rows(tmp_path / "flown/run.nc")
    (tmp_path / "damaged.nc").write_bytes((tmp_path / "flown/run.nc").read_bytes()[:1000])
    assert _has_rows(tmp_path / "damaged.nc")  # nobody knows, so that it must not be removed


SWALLOWED = """
import os, signal, sys
from testbed import interrupts
with interrupts.heeded():
    try:
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(100):
            pass
    except BaseException:
        pass
    sys.exit(0)
"""


def test_one_that_somebody_swallowed_is_told_at_the_end() -> None:
    ended = subprocess.run(
        [sys.executable, "-c", SWALLOWED], capture_output=True, text=True, check=False,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # that in the background of a shell is ignored
    )  # fmt: skip
    assert (ended.returncode, ended.stderr) == (130, "testbed: interrupted\n")


def test_what_is_left_behind_is_told_on_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(interrupts, "_announced", False)
    with pytest.raises(SystemExit), interrupts.leaving(lambda: "the record is two\nlines"):
        raise interrupts.Interrupted
    assert capsys.readouterr().err == "testbed: interrupted: the record is two\\nlines\n"


def test_a_record_without_a_row_is_withdrawn(tmp_path: Path) -> None:
    write_result(tmp_path / RECORD, b"")
    write_result(tmp_path / METRICS, b"{}")
    withdraw(tmp_path / RECORD)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([METRICS, MANIFEST])
    withdraw(tmp_path / METRICS)
    assert not [*tmp_path.iterdir()]


def test_a_record_that_was_to_come_is_no_longer_listed(tmp_path: Path) -> None:
    """Interrupted in its first turn a run left a manifest of a record that was not there."""
    record = tmp_path / RECORD
    start_anew(tmp_path, [RECORD])
    assert _nothing(record, None) == "nothing was recorded"
    assert not [*tmp_path.iterdir()]
    write_result(record, b"of an earlier run")
    assert _nothing(record, stamp(record)) == "nothing was recorded"
    assert sorted(path.name for path in tmp_path.iterdir()) == [RECORD, MANIFEST]


GOING_ON = """
import threading, time
from concurrent.futures import ThreadPoolExecutor
from nav.samples import Estimate


class Mine:
    def __init__(self, rig):
        self.t = 0.0
        threading.Thread(target=time.sleep, args=(1000.0,), name="reader", daemon={daemon}).start()

    def propagate(self, imu):
        self.t = float(imu.t[-1])

    def update(self, sample): ...

    def estimate(self):
        return Estimate.of(self.t)


class Lacking:
    __init__ = Mine.__init__


class Pooled(Mine):
    def __init__(self, rig):
        self.t = 0.0
        ThreadPoolExecutor(1, thread_name_prefix="reader").submit(time.sleep, 1000.0)
"""


def flown(folder: Path, name: str) -> subprocess.CompletedProcess[str]:
    """How a run on the bench has ended, with a class of mine.py in a folder as its estimator."""
    bench = (Path(__file__).parents[1] / "scenarios/static_bench.toml").read_text().partition("[[estimator]]")[0]
    (folder / "mine.toml").write_text(f'{bench}\n[[estimator]]\nname = "mine"\nkind = "./mine.py:{name}"\n')
    return subprocess.run(
        [sys.executable, "-m", "testbed", "run", "mine.toml", "--no-report", "--set", "duration_s=1"],
        cwd=folder, env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True, text=True, check=False, timeout=100,
    )  # fmt: skip


@pytest.mark.ci
@pytest.mark.parametrize(
    ("name", "daemon", "code"), [("Mine", False, 0), ("Mine", True, 0), ("Lacking", False, 2), ("Pooled", False, 0)]
)
def test_a_thread_of_the_users_does_not_outlive_its_command(tmp_path: Path, name: str, daemon: bool, code: int) -> None:
    """All was printed, and then the command hung."""
    (tmp_path / "mine.py").write_text(GOING_ON.format(daemon=daemon))
    ended = flown(tmp_path, name)
    assert ended.returncode == code, ended.stderr
    assert code or ended.stdout.splitlines()[-1].startswith("record: ")
    told = "testbed: ended, though threads still ran: reader"
    assert ended.stderr.splitlines()[-1].startswith(told) == (not daemon)


CLOSING = """
import sys
from nav.samples import Estimate


class Mine:
    def __init__(self, rig):
        self.t = 0.0

    def propagate(self, imu):
        self.t = float(imu.t[-1])
        print("mine")
        sys.stdout.close()
        sys.stderr.close()

    def update(self, sample): ...

    def estimate(self):
        return Estimate.of(self.t)
"""


@pytest.mark.ci
def test_who_closes_the_output_takes_it_from_nobody(tmp_path: Path) -> None:
    """All was flown, and then there was a traceback in place of tables and report, or no metrics."""
    (tmp_path / "mine.py").write_text(CLOSING)
    ended = flown(tmp_path, "Mine")
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.splitlines()[0] == "mine"
    assert ended.stdout.splitlines()[-1].startswith("record: ")
    assert "testbed: mine: its errors are not scored" in ended.stderr
    assert (tmp_path / "runs/mine" / METRICS).exists()


FORKED = """
import os, signal
from testbed import interrupts

interrupts.end_at_once()
with interrupts.heeded():
    if not (child := os.fork()):
        os._exit(sum(signal.getsignal(one) is not signal.SIG_DFL for one in interrupts.SIGNALS))
    print(os.waitpid(child, 0)[1])
"""


def test_who_is_forked_off_is_ended_by_signals_as_ever() -> None:
    """A `multiprocessing.Pool` of the user's own ended in our traceback, or, were they ignored, not at all."""
    done = subprocess.run([sys.executable, "-c", FORKED], capture_output=True, text=True, check=True)
    assert done.stdout == "0\n"
