"""Keys on a terminal: what they ask for, and a terminal that is as it was however the run ends."""

from __future__ import annotations

import os
import pty
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from testbed.loop import keyboard
from testbed.loop.keyboard import Keyboard, keys
from testbed.loop.requests import End, Faster, Restart, Step, Toggle
from testbed.record import reader as record

PATIENCE_S = 120.0  # with a machine that is busy with something else


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    """The two ends of a terminal: who types, and who reads."""
    ours, theirs = pty.openpty()
    yield ours, theirs
    os.close(ours)
    os.close(theirs)


def test_what_the_keys_mean(terminal: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = terminal
    monkeypatch.setattr(keyboard, "_in_front", lambda fd: True)
    with keys(theirs) as pressed:
        assert pressed is not None
        assert pressed.requests() == []
        os.write(ours, b" s+=-x\xffrq")
        expected = [Toggle(), Step(1.0), Faster(2.0), Faster(2.0), Faster(0.5), Restart(), End()]
        assert pressed.requests() == expected
        os.write(ours, b"\x1b[s")
        assert pressed.requests() == [], "an arrow is no key of ours"


def test_the_terminal_is_restored_whatever_happens(terminal: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    _, theirs = terminal
    monkeypatch.setattr(keyboard, "_in_front", lambda fd: True)
    before, heeded = termios.tcgetattr(theirs), signal.getsignal(signal.SIGTERM)

    def use_and(fail: type[BaseException]) -> None:
        with keys(theirs):
            assert termios.tcgetattr(theirs) != before
            raise fail

    for failure in (KeyboardInterrupt, ValueError):
        with pytest.raises(failure):
            use_and(failure)
        assert termios.tcgetattr(theirs) == before
        assert signal.getsignal(signal.SIGTERM) is heeded


def test_no_keys_without_a_terminal_of_ones_own(terminal: tuple[int, int], tmp_path: Path) -> None:
    _, theirs = terminal
    before = termios.tcgetattr(theirs)
    with keys(theirs) as pressed:  # not the one that this process was started from
        assert pressed is None
        assert termios.tcgetattr(theirs) == before
    with (tmp_path / "file").open("w") as file, keys(file.fileno()) as pressed:
        assert pressed is None
    assert list(Keyboard(theirs).requests()) == []


# Makes the terminal on its standard input its own, as a shell would have done, and runs the command line.
OWN = (
    "import fcntl, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0)\n"
    "from testbed.__main__ import main; sys.argv[0] = 'testbed'; main()"
)


class Typist:
    """A person at a terminal with a live run on it."""

    def __init__(self, terminal: tuple[int, int], folder: Path) -> None:
        self._ours, theirs = terminal
        command = [sys.executable, "-c", OWN, "run", "static_bench", "--realtime", "40", "--no-report"]
        environment = os.environ | {"PYTHONPATH": os.getcwd(), "TERM": "xterm", "COLUMNS": "200"}
        self.running = subprocess.Popen(
            command, cwd=folder, env=environment, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True
        )
        self.seen = ""

    def sees(self, text: str) -> bool:
        """Whether ``text`` appears within a while, after what was seen before."""
        until = time.monotonic() + PATIENCE_S
        while text not in self.seen and time.monotonic() < until:
            if select.select([self._ours], [], [], 0.1)[0]:
                self.seen += os.read(self._ours, 4096).decode(errors="replace")
        found = text in self.seen
        self.seen = self.seen.partition(text)[2]
        return found

    def ended(self) -> int:
        """The exit code, everything read, as a terminal does."""
        until = time.monotonic() + PATIENCE_S
        while self.running.poll() is None and time.monotonic() < until:
            if select.select([self._ours], [], [], 0.1)[0]:
                os.read(self._ours, 4096)
        return self.running.wait(1)

    def types(self, letters: str) -> None:
        os.write(self._ours, letters.encode())


@pytest.mark.ci
def test_a_live_run_is_directed_by_keys(terminal: tuple[int, int], tmp_path: Path) -> None:
    before = termios.tcgetattr(terminal[1])
    typist = Typist(terminal, tmp_path)
    assert typist.sees("keys: space pauses and resumes")
    assert typist.sees(" of 05:00  ")
    typist.types(" ")
    assert typist.sees("paused at")
    typist.types("s")
    assert typist.sees("paused at")
    typist.types("+")
    assert typist.sees("80 times the wall clock")
    typist.types(" ")
    typist.types("q")
    assert typist.sees("ended on request at")
    assert typist.sees("record: runs/static_bench/run.nc")
    assert typist.ended() == 0
    assert termios.tcgetattr(terminal[1]) == before
    dataset = record.load(tmp_path / "runs/static_bench/run.nc")
    assert dataset["requests/kind"].values.tolist() == ["end"]
    assert 1 < dataset["truth/time"].values[-1] < 250


@pytest.mark.ci
def test_a_terminated_run_leaves_the_terminal_and_the_record(terminal: tuple[int, int], tmp_path: Path) -> None:
    before = termios.tcgetattr(terminal[1])
    typist = Typist(terminal, tmp_path)
    assert typist.sees(" of 05:00  ")
    assert termios.tcgetattr(terminal[1]) != before
    typist.running.terminate()
    assert typist.ended() == 128 + signal.SIGTERM
    assert termios.tcgetattr(terminal[1]) == before
    assert record.load(tmp_path / "runs/static_bench/run.nc").attrs["complete"] == 1
