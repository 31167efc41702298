"""What a second process does of the compilation, and what it may not do."""

import multiprocessing
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from testbed import Scenario, run
from testbed.estimators import registry
from testbed.loop.arguments import Setup
from testbed.loop.loop import _leaves_to_compile
from testbed.loop.rehearsal import Rehearsal

SCENARIO = """
title = "At rest"
duration_s = 70
seed = 4
[truth]
source = "kinematic"
rate_hz = 200
[truth.start]
lat_deg = 34.0
lon_deg = 108.0
alt_m = 500
heading_deg = 30
[sensors.imu]
[sensors.gnss]
[sensors.magnetometer]
[[estimator]]
name = "ins"
kind = "ins"
aids = ["gnss", "magnetometer"]
[[estimator]]
name = "ahrs"
kind = "ahrs"
aids = ["magnetometer"]
"""
REHEARSED = """
from nav import earth
from testbed.loop.rehearsal import Rehearsal
rehearsal = Rehearsal([lambda: earth.radii(0.5)])
rehearsal._process.join()
earth.radii(0.5)
print(sum(earth.radii.stats.cache_hits.values()), sum(earth.radii.stats.cache_misses.values()))
"""


def flown(**settings):
    result = run(Scenario.parse(SCENARIO), **settings)
    return {name: value for name, value in result.metrics.items() if not name.startswith("run.")}


@pytest.mark.ci
def test_what_it_has_compiled_is_there_for_the_run(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    run = subprocess.run([sys.executable, "-c", REHEARSED], env=environment, capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["1", "0"]
    assert run.stderr == ""


@pytest.mark.ci
@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one core")
@pytest.mark.parametrize("settings", [{}, {"realtime": 200.0}])
def test_a_run_is_the_same_with_it_and_leaves_no_process(settings, monkeypatch):
    alone = flown()
    begun, begin = [], Rehearsal.__init__

    def counted(rehearsal, flights):
        begun.append(len(flights))
        begin(rehearsal, flights)

    monkeypatch.setattr(Rehearsal, "__init__", counted)
    monkeypatch.setattr(registry, "is_kept", lambda sections: False)
    assert flown(**settings) == alone
    assert begun == [3]
    assert not multiprocessing.active_children()


def test_what_fails_or_prints_in_it_is_not_heard_and_what_comes_after_is_flown(tmp_path, capfd):
    def fails():
        print("rehearsed")
        raise ValueError("rehearsed")

    rehearsal = Rehearsal([fails, (tmp_path / "flown").touch, lambda: time.sleep(60)])
    ends = time.monotonic() + 20
    while not (tmp_path / "flown").exists() and time.monotonic() < ends:
        time.sleep(0.01)
    rehearsal.close()
    assert (tmp_path / "flown").exists()
    assert not multiprocessing.active_children()
    assert capfd.readouterr() == ("", "")


@pytest.mark.ci
def test_it_ends_with_who_began_it():
    script = (
        "import os, signal, time\nfrom testbed.loop.rehearsal import Rehearsal\n"
        "rehearsal = Rehearsal([lambda: time.sleep(60)])\ntime.sleep(1)\n"
        "print(rehearsal._process.pid, flush=True)\nos.kill(os.getpid(), signal.SIGKILL)"
    )
    killed = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    ends = time.monotonic() + 20
    while Path("/proc", killed.stdout.strip()).exists() and time.monotonic() < ends:
        time.sleep(0.05)
    assert killed.stdout
    assert not Path("/proc", killed.stdout.strip()).exists()


@pytest.mark.ci
def test_a_signal_to_it_ends_it_alone():
    """Who heeds interrupts is told of them by a pipe, which a process that was forked has too."""
    script = (
        "import os, signal, time\nfrom testbed import interrupts\nfrom testbed.loop.rehearsal import Rehearsal\n"
        "with interrupts.heeded():\n"
        "    rehearsal = Rehearsal([lambda: time.sleep(60)])\n    time.sleep(1)\n"
        "    os.kill(rehearsal._process.pid, signal.SIGTERM)\n    rehearsal._process.join()\n"
        "    time.sleep(interrupts.GRACE_S + 0.5)\n    print('went on')"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout, run.stderr) == (0, "went on\n", "")


def test_where_there_can_be_no_process_nothing_is_flown(tmp_path, monkeypatch):
    def fails(process):
        raise BlockingIOError

    monkeypatch.setattr(multiprocessing.get_context("fork").Process, "start", fails)
    rehearsal = Rehearsal([(tmp_path / "flown").touch])
    rehearsal.close()
    assert rehearsal._process.pid is None
    assert not (tmp_path / "flown").exists()


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one core")
def test_neither_somebody_elses_code_is_rehearsed_nor_what_a_filter_steers_nor_a_log(monkeypatch):
    monkeypatch.setattr(registry, "is_kept", lambda sections: False)
    scenario = Scenario.parse(SCENARIO)
    mine = {"mine": SimpleNamespace(kind="./mine.py:Mine")}
    others = scenario.model_copy(update={"sensors": scenario.sensors | mine})
    assert _leaves_to_compile(scenario, Setup(1))
    assert not _leaves_to_compile(others, Setup(1))
    assert not _leaves_to_compile(Scenario.load("closed_loop_spoofed"), Setup(1))
    assert not _leaves_to_compile(Scenario.load("recorded_flight"), Setup(1))


def test_an_estimator_of_somebody_elses_is_not_rehearsed():
    """It may write files or open ports."""
    kinds = {kind: registry.find(kind).kernel is not None for kind in (*registry.BUILT_IN, "./mine.py:Mine")}
    assert [kind for kind, rehearsed in kinds.items() if rehearsed] == ["ins", "federated", "ahrs"]
