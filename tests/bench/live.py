"""A run held to the wall clock while stations listen."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from bench.measure import MAIN, TWO_ESTIMATORS, Effort, Row

from testbed.loop import links, loop
from testbed.scenario import Scenario

LIVE_S = 25


def live(effort: Effort) -> Iterator[Row]:
    """A run held to the wall clock with four stations listening: deadlines, jitter, and what streaming costs."""
    from testbed.mavlink import MavlinkPublisher

    station = (
        "import select, socket, sys\n"
        "udp = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]\n"
        "tcp = socket.create_server(('127.0.0.1', 0))\n"
        "for one in udp: one.bind(('127.0.0.1', 0))\n"
        "print(*(one.getsockname()[1] for one in (*udp, tcp)), flush=True)\n"
        "ears = [*udp, tcp.accept()[0], socket.create_connection(('127.0.0.1', int(sys.stdin.readline())))]\n"
        "while all(one.recv(65536) for one in select.select(ears, [], [])[0]): pass\n"
    )
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    length = effort.count(LIVE_S)
    scenario = Scenario.load(MAIN, [f"duration_s={length}", "sensors.gnss.denied=[]", "expect={}", TWO_ESTIMATORS])
    command = [sys.executable, "-c", station]
    with (
        tempfile.TemporaryDirectory() as folder,
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as listening,
    ):
        assert listening.stdin is not None
        assert listening.stdout is not None
        ours = [int(word) for word in listening.stdout.readline().split()]
        urls = [f"udpout:127.0.0.1:{ours[0]}", f"udpout:127.0.0.1:{ours[1]}", f"tcp:127.0.0.1:{ours[2]}"]
        publisher = MavlinkPublisher([*urls, f"tcpin:127.0.0.1:{port}"], scenario)
        listening.stdin.write(f"{port}\n")
        listening.stdin.flush()
        timed = _Timed(publisher)
        found = loop.run(scenario, links=[timed], realtime=1.0, out=Path(folder)).metrics
    share = 100 * timed.seconds / length
    detail = f"{length} s at 200 Hz, four streams, {os.getloadavg()[0]:.1f} processes running on {os.cpu_count()} cores"
    yield Row("live: missed deadlines", (found["run.missed_percent"],), "%", at_most=0.1, detail=detail)
    yield Row("live: jitter, 99 % within", (1e3 * found["run.jitter_p99_s"],), "ms", at_most=5.0)
    yield Row("live: streaming", (share,), "% of a core", at_most=5.0)


class _Timed:
    """A publisher, and the processor time that it takes."""

    def __init__(self, publisher: links.Publisher) -> None:
        self.period_s, self.others_every, self.asks = publisher.period_s, publisher.others_every, publisher.asks
        self.seconds = 0.0
        self.publish = self._timed(publisher.publish)
        self.requests = self._timed(publisher.requests)
        self.event = self._timed(publisher.event)
        self.settings = publisher.settings
        self.close = publisher.close

    def _timed(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any) -> Any:
            began = time.thread_time()
            result = call(*arguments)
            self.seconds += time.thread_time() - began
            return result

        return timed
