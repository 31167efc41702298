"""Programs that tests start, talk to and end."""

from __future__ import annotations

import os
import queue
import re
import signal
import socket
import subprocess
import threading
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
START_S = 90.0  # compiling included


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


class Program:
    """A process whose output is read as it comes."""

    def __init__(self, *command: str | Path, cwd: Path) -> None:
        environment = {**os.environ, "HOME": str(cwd), "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
        self._process = subprocess.Popen(
            [str(part) for part in command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            cwd=cwd,
            env=environment,
            start_new_session=True,
        )
        self.output = ""
        self._chunks: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        while chunk := self._process.stdout.read1(65536):  # type: ignore[attr-defined]
            self._chunks.put(chunk)
        self._chunks.put(b"")

    def say(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n".encode())
        self._process.stdin.flush()

    def expect(self, pattern: str, within_s: float) -> re.Match[str]:
        """The pattern's first match in what has been said since the last match."""
        limit = time.monotonic() + within_s
        while True:
            if match := re.search(pattern, self.output):
                self.output = self.output[match.end() :]
                return match
            try:
                chunk = self._chunks.get(timeout=max(0.01, limit - time.monotonic()))
            except queue.Empty:
                pytest.fail(f"no {pattern!r} within {within_s} s; since then:\n{self.output[-4000:]}")
            assert chunk, f"ended without {pattern!r}:\n{self.output[-4000:]}"
            self.output += chunk.decode(errors="replace")

    def check(self) -> None:
        """Fail the test if it has ended."""
        if self._process.poll() is not None:
            self.wait(5)
            pytest.fail(f"ended:\n{self.output[-4000:]}")

    def wait(self, timeout_s: float) -> int:
        """Let it end by itself; its exit code."""
        self._process.wait(timeout_s)
        self._reader.join(5)
        while not self._chunks.empty():
            self.output += self._chunks.get().decode(errors="replace")
        return self._process.returncode

    def end(self) -> None:
        """End it, and what it has started."""
        for name in (signal.SIGINT, signal.SIGKILL):
            if self._process.poll() is None:
                os.killpg(self._process.pid, name)
                try:
                    self._process.wait(5)
                except subprocess.TimeoutExpired:
                    continue
        self._reader.join(5)
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
