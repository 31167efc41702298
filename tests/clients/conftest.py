"""A run as its own process, watched by ground stations that are processes too: all on loopback, all ended here."""

from __future__ import annotations

import contextlib
import socket
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from worlds.programs import ROOT, START_S, Program, free_port

CLIENTS = ROOT / ".venv-clients"


@pytest.fixture(scope="session")
def clients() -> Path:
    """Folder of the ground stations' programs."""
    if not (CLIENTS / ".ready").exists():
        pytest.skip(f"the ground stations are not installed: make {CLIENTS.name}/.ready, or make test-all")
    return CLIENTS / "bin"


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Program]]:
    """Start a program in an empty folder of its own, to be ended with the test."""
    started: list[Program] = []

    def program(*command: str | Path) -> Program:
        folder = tmp_path / str(len(started))
        folder.mkdir()
        started.append(Program(*command, cwd=folder))
        return started[-1]

    yield program
    for one in reversed(started):
        one.end()


@pytest.fixture
def fly(start: Callable[..., Program]) -> Callable[..., int]:
    """Start a run in real time that sends to the port returned; it has begun to."""

    def run(scenario: str, *arguments: str, realtime: float = 1.0) -> int:
        port = free_port()
        command = [sys.executable, "-m", "testbed", "run", scenario, "--realtime", str(realtime), "--no-report"]
        flight = start(*command, "--out", "run", "--mavlink", f"udpout:127.0.0.1:{port}", *arguments)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as early:
            early.bind(("127.0.0.1", port))
            early.settimeout(0.2)
            limit = time.monotonic() + START_S
            while time.monotonic() < limit:
                with contextlib.suppress(TimeoutError):
                    early.recv(65535)
                    return port
                flight.check()
        pytest.fail(f"the run says nothing within {START_S} s")

    return run
