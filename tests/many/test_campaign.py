"""Campaigns: the same numbers however they are flown, nothing lost when something dies, honest statistics."""

from __future__ import annotations

import errno
import io
import json
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from distributed import LocalCluster
from rich.console import Console
from scipy.stats import binomtest, chi2, ttest_1samp
from typer.testing import CliRunner
from worlds import browser, synthetic_run

import testbed
from testbed import Scenario, plugins, run
from testbed.__main__ import app
from testbed.data import docs_dir
from testbed.errors import UserError
from testbed.feeds import simulated
from testbed.feeds.simulated import motion
from testbed.loop import loop
from testbed.many import campaign as campaigns
from testbed.many import folder, given, pool, shared_flight
from testbed.many.campaign import Combination, Failure, Outcome, Plan, Progress, campaign
from testbed.motion.kinematic import Kinematic
from testbed.motion.table import COLUMNS, Replay, TruthBlock, save_motion
from testbed.report import campaign as campaign_report
from testbed.report import campaign_figures, expected
from testbed.results import MANIFEST, REPORT
from testbed.scenario.schema import Bounds
from testbed.score import accuracy

AT_REST = """
title = "At rest, some of it without GNSS"
seed = 11
duration_s = 80

[truth]
source = "kinematic"
rate_hz = 50
start = { lat_deg = 47.0, lon_deg = 8.0, alt_m = 500 }

[sensors.imu]
grade = "mems-industrial"
rate_hz = 50
[sensors.gnss]
rate_hz = 5
denied = [[70, 75]]
[sensors.barometer]
rate_hz = 5
[sensors.magnetometer]
rate_hz = 5

[[estimator]]
name = "ins"
aids = ["gnss", "barometer", "magnetometer"]
"""


@pytest.fixture
def at_rest(tmp_path: Path) -> Path:
    path = tmp_path / "at_rest.toml"
    path.write_text(AT_REST)
    return path


def in_this_process(workers: int) -> LocalCluster:
    """A cluster whose workers are threads of this process, so that tests can reach into them."""
    return LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        processes=False,
        protocol="tcp",
        host="127.0.0.1",
        dashboard_address=None,
        scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
    )


@pytest.fixture(scope="module")
def threads() -> Iterator[str]:
    with in_this_process(1) as cluster:
        yield cluster.scheduler_address


def same(one: Outcome, other: Outcome) -> bool:
    """Whether two outcomes hold the same bits."""
    return (
        one.seed == other.seed
        and dict(one.metrics) == dict(other.metrics)
        and one.history.keys() == other.history.keys()
        and all(np.array_equal(one.history[k], other.history[k], equal_nan=True) for k in one.history)
    )


def flown_here(path: Path, seed: int, overrides: tuple[str, ...] = ()) -> Outcome:
    """What a campaign should have of one run, flown in this process by the plain loop, truth and all."""
    result = run(Scenario.load(path, overrides), seed=seed)
    metrics = {k: v for k, v in result.metrics.items() if not k.startswith("run.")}
    return Outcome(0, seed, metrics, campaigns.history_of(result.dataset))


class Counter:
    """Stands for the loop's run: counts the seeds flown, and fails for some of them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, failing: set[int] = frozenset()) -> None:  # type: ignore[assignment]
        self.seeds: list[int] = []
        self.failing = failing
        self._run = loop.run
        monkeypatch.setattr(loop, "run", self)

    def __call__(self, scenario: Scenario, *, seed: int, **options: Any) -> Any:
        self.seeds.append(seed)
        if seed in self.failing:
            raise ArithmeticError("the filter blew up")
        return self._run(scenario, seed=seed, **options)


# --- replay


def test_replay_gives_the_stored_rows(tmp_path: Path) -> None:
    start = SimpleNamespace(lat_deg=10.0, lon_deg=179.0, alt_m=5.0, heading_deg=1.0, pitch_deg=2.0, roll_deg=3.0)
    save_motion(Kinematic(start, 50.0), 1001, tmp_path / "truth")
    direct, replay = Kinematic(start, 50.0), Replay(tmp_path / "truth")
    assert replay.rate_hz == 50.0
    for ticks in (1, 7, 500, 493):
        one, other = direct.advance(ticks), replay.advance(ticks)
        assert one.tick == other.tick
        for name in COLUMNS:
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), strict=True)
    assert len(replay.advance(1)) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["truth"]


def test_replay_ends_where_the_motion_ended(tmp_path: Path) -> None:
    class Ends:
        rate_hz = 10.0

        def __init__(self) -> None:
            self.left = 30
            self.failure = "control lost"

        def advance(self, ticks: int) -> TruthBlock:
            n = min(ticks, self.left)
            self.left -= n
            return TruthBlock.empty(30 - self.left - n, n)

        def activity(self) -> str:
            return ""

    save_motion(Ends(), 100, tmp_path / "truth")
    replay = Replay(tmp_path / "truth")
    assert (len(replay.advance(30)), replay.failure) == (30, "")
    assert (len(replay.advance(70)), replay.failure) == (0, "control lost")


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="room can't be taken here")
def test_a_flight_that_there_is_no_room_for_is_a_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a full disk the process was killed, and left a folder."""

    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    scenario = Scenario.load("static_bench")
    with pytest.raises(UserError, match="truth: can't store the flight: No space left on device"):
        save_motion(motion(scenario, scenario.seed), 100, tmp_path / "truth")
    assert [*tmp_path.iterdir()] == []


@pytest.mark.ci
def test_replayed_flight_equals_the_flight(tmp_path: Path) -> None:
    overrides = ["duration_s=30", "truth.wind.turbulence=none"]
    scenario = Scenario.load("u_turn", overrides)
    save_motion(motion(scenario, scenario.seed), 30 * 200 + 1, tmp_path / "truth")
    direct = run(scenario, seed=5)
    replayed = run(scenario, seed=5, source=Replay(tmp_path / "truth"))
    for node in direct.dataset.subtree:
        for name, variable in node.variables.items():
            np.testing.assert_array_equal(variable.values, replayed.dataset[node.path][name].values)


@pytest.mark.parametrize(
    ("overrides", "shared"),
    [
        (["truth.wind.turbulence=none"], True),
        ([], False),
        (["truth.wind.turbulence_seed=3"], True),
        (["truth.wind.turbulence=none", "autopilot.feedback=ins"], False),
    ],
)
def test_truth_is_shared_when_the_seed_does_not_move_it(overrides: list[str], shared: bool) -> None:
    assert shared_flight.seed_leaves_motion(Scenario.load("u_turn", overrides)) is shared


def test_truth_is_not_shared_when_it_is_varied(at_rest: Path) -> None:
    here, there = (Scenario.load(at_rest, [f"truth.start.alt_m={alt}"]) for alt in (500, 600))
    assert shared_flight.same_motion(here, Scenario.load(at_rest, ["sensors.gnss.rate_hz=1"]))
    assert not shared_flight.same_motion(here, there)
    on_truth, on_estimate = (Scenario.load("u_turn", [f"autopilot.feedback={name}"]) for name in ("truth", "ins"))
    assert not shared_flight.same_motion(on_truth, on_estimate)


# --- the same numbers, however flown


@pytest.mark.ci
def test_two_workers_give_what_one_process_gives(at_rest: Path, tmp_path: Path) -> None:
    told: list[Progress] = []
    result = campaigns.fly(Plan(at_rest, 3, tmp_path / "out"), 2, told.append)
    assert not result.failures
    assert [outcome.seed for outcome in result.outcomes] == [11, 12, 13]
    assert (tmp_path / "out" / "truth" / "t.npy").exists()  # so this compares replay with direct, too
    for outcome in result.outcomes:
        assert same(outcome, flown_here(at_rest, outcome.seed))
    assert (told[0].done, told[-1].done, told[-1].total) == (0, 3, 3)
    assert not same(result.outcomes[0], result.outcomes[1])


def command(*arguments: str) -> tuple[int, str, str]:
    """Exit code, output and messages of the command line."""
    result = CliRunner().invoke(app, ["campaign", *arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stdout, result.stderr


@pytest.mark.ci
def test_varied_values_and_files(at_rest: Path, tmp_path: Path, threads: str) -> None:
    out = tmp_path / "out"
    vary = ("--vary", "sensors.gnss.rate_hz=1,5", "--vary", "sensors.gnss.denied=[[68, 72]],[]")
    code, text, progress = command(str(at_rest), "--runs", "1", *vary, "--scheduler", threads, "--out", str(out))
    assert code == 0
    assert "4/4" in progress
    assert "[[68, 72]]" in text
    assert "horizontal rms [m]" in text
    lines = (out / "campaign.csv").read_text().splitlines()
    assert len(lines) == 1 + 4
    assert lines[0].startswith("sensors.gnss.rate_hz,sensors.gnss.denied,seed,ins.")
    stored = json.loads((out / "campaign.json").read_text())
    assert stored["combinations"][1] == {"sensors.gnss.rate_hz": "1", "sensors.gnss.denied": "[]"}
    assert {row["combination"] for row in stored["spreads"]} == {0, 1, 2, 3}
    assert sorted(path.name for path in out.glob("*.png")) == [
        "distribution_sensors_gnss_denied.png",
        "distribution_sensors_gnss_rate_hz.png",
        "errors.png",
        "nees.png",
    ]
    reloaded = campaigns._load(out, 1, 11)
    assert reloaded is not None
    assert same(reloaded, flown_here(at_rest, 11, ("sensors.gnss.rate_hz=1", "sensors.gnss.denied=[]")))


# --- nothing is lost


@pytest.mark.ci
def test_interrupted_campaign_carries_on(
    at_rest: Path, tmp_path: Path, threads: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    flown = Counter(monkeypatch)

    def interrupt(now: Progress) -> None:
        if now.done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        campaigns.fly(Plan(at_rest, 4, out), threads, interrupt)
    assert not (out / "campaign.json").exists()
    kept = {int(path.stem.split("_s")[1]) for path in (out / "runs").glob("*.json")}
    assert 1 <= len(kept) <= 2
    damaged = out / "runs" / f"c000_s{min(kept):06d}.npz"
    damaged.write_bytes(damaged.read_bytes()[:100])
    time.sleep(1.0)  # until the worker is done with the run it was flying

    flown.seeds.clear()
    result = campaign(at_rest, 4, workers=threads, out=out)
    assert sorted(flown.seeds) == sorted({11, 12, 13, 14} - kept | {min(kept)})
    again = next(outcome for outcome in result.outcomes if outcome.seed == min(kept))
    assert same(again, flown_here(at_rest, again.seed))

    flown.seeds.clear()
    more = campaign(at_rest, 5, workers=threads, out=out)
    assert flown.seeds == [15]
    assert len(more.outcomes) == 5


@pytest.mark.ci
def test_failing_run_is_reported_and_stops_no_other(
    at_rest: Path, tmp_path: Path, threads: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    flown = Counter(monkeypatch, failing={12})
    code, _, messages = command(str(at_rest), "--runs", "3", "--scheduler", threads, "--out", str(out))
    assert code == 1
    assert "seed 12: ArithmeticError: the filter blew up" in messages
    stored = json.loads((out / "campaign.json").read_text())
    assert (stored["runs"], stored["draw"]) == (2, 0)
    assert [f["seed"] for f in stored["failures"]] == [12]
    assert "in __call__" in stored["failures"][0]["traceback"]

    flown.seeds.clear()
    flown.failing = set()
    result = campaign(at_rest, 3, workers=threads, out=out)
    assert flown.seeds == [12]
    assert not result.failures


@pytest.mark.ci
def test_a_draw_has_seeds_of_its_own(at_rest: Path, threads: str, tmp_path: Path) -> None:
    result = campaign(at_rest, 2, draw=3, workers=threads, out=tmp_path / "third")
    assert [o.seed for o in result.outcomes] == [3_000_011, 3_000_012]
    again = campaign(at_rest, 2, workers=threads, out=tmp_path / "third")
    assert [o.seed for o in again.outcomes] == [11, 12]
    for draw in (-1, 10**9 + 1):
        with pytest.raises(UserError, match=f"--draw {draw}: give a number from 0 to"):
            campaign(at_rest, 2, draw=draw, workers=threads, out=tmp_path / "none")


@pytest.mark.ci
def test_flight_out_of_control_is_a_failure(tmp_path: Path, threads: str, monkeypatch: pytest.MonkeyPatch) -> None:
    class Falls(Kinematic):
        def __init__(self) -> None:
            start = {
                "lat_deg": 10.0,
                "lon_deg": 9.0,
                "alt_m": 5.0,
                "heading_deg": 1.0,
                "pitch_deg": 2.0,
                "roll_deg": 3.0,
            }
            super().__init__(SimpleNamespace(**start), 200.0)
            self.failure = "control lost: bank -90 deg"

        def advance(self, ticks: int) -> TruthBlock:
            return super().advance(ticks if self._tick < 200 else 0)

    monkeypatch.setattr(simulated, "motion", lambda scenario, seed: Falls())
    result = campaign("u_turn", 2, workers=threads, out=tmp_path / "gusty")
    assert not result.outcomes
    assert [f.message for f in result.failures] == ["the flight ended early: control lost: bank -90 deg"] * 2
    with pytest.raises(UserError, match="control lost"):
        campaign("u_turn", 2, overrides=["truth.wind.turbulence=none"], workers=threads, out=tmp_path / "calm")
    assert not (tmp_path / "calm" / "truth").exists()


def dask(*arguments: str) -> subprocess.Popen[bytes]:
    """A scheduler or worker of its own, as a user would start it."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "dask", *arguments]
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


@pytest.mark.slow
def test_killed_worker_loses_nothing(at_rest: Path, tmp_path: Path) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    scheduler = dask("scheduler", "--host", address, "--no-dashboard")
    worker = ("worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(tmp_path))
    workers = [dask(*worker), dask(*worker)]
    overrides = ["duration_s=200"]
    told: list[Progress] = []

    def kill_half_way(now: Progress) -> None:
        told.append(now)
        if now.done >= 4 and workers[0].poll() is None:
            workers[0].send_signal(signal.SIGKILL)
            workers[0].wait()

    try:
        wait_for(address)
        plan = Plan(at_rest, 8, tmp_path / "out", overrides=overrides)
        result = campaigns.fly(plan, address, kill_half_way)
    finally:
        for process in (*workers, scheduler):
            process.terminate()
            process.wait()
    assert not result.failures
    assert workers[0].returncode == -signal.SIGKILL
    assert told[-1].done == 8
    assert [outcome.seed for outcome in result.outcomes] == list(range(11, 19))
    for outcome in result.outcomes:
        assert same(outcome, flown_here(at_rest, outcome.seed, tuple(overrides)))


def wait_for(address: str) -> None:
    """Until both workers are there, so that one of them can be killed at its work."""
    from distributed import Client

    deadline = time.monotonic() + 30.0
    while True:
        try:
            pool._require_scheduler(address)
            break
        except UserError:
            assert time.monotonic() < deadline
    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=30)


@pytest.mark.ci
def test_the_code_that_decides_numbers_is_all_of_it_but_presentation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(Path(testbed.__file__).parent, tmp_path / "testbed", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(testbed, "__file__", str(tmp_path / "testbed" / "__init__.py"))
    before = folder.code.__wrapped__()
    for path in (tmp_path / "testbed").rglob("*.py"):
        text = path.read_bytes()
        path.write_bytes(text + b"#")
        room = path.relative_to(tmp_path / "testbed").parts[0]
        assert (folder.code.__wrapped__() == before) == (room in ("report", "mavlink")), path
        path.write_bytes(text)
    assert folder.code.__wrapped__() == before


def test_a_million_runs_are_made_as_they_are_flown(
    at_rest: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    began = []

    def first(now: Progress) -> None:
        began.append(now)
        raise KeyboardInterrupt

    flown = Counter(monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        campaigns.fly(Plan(at_rest, 1_000_000_000, tmp_path / "out"), 1, first)
    assert began[0].total == 1_000_000_000
    assert flown.seeds == []


@pytest.mark.ci
def test_a_wrong_scheduler_is_told_before_anything_is_made(at_rest: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nothing answers there"):
        campaign(at_rest, 1_000_000_000, workers=f"tcp://127.0.0.1:{free_port()}", out=tmp_path / "out")


@pytest.mark.ci
def test_frame_and_dataset(at_rest: Path, tmp_path: Path, threads: str) -> None:
    vary = {"sensors.gnss.rate_hz": ["1", "5"]}
    result = campaign(at_rest, 2, vary=vary, workers=threads, overrides=["duration_s=76"], out=str(tmp_path / "out"))
    frame, dataset = result.frame(), result.dataset()
    assert repr(result) == f"<CampaignResult 4 runs, 0 failed, in {tmp_path / 'out'}>"
    assert list(frame["seed"]) == [11, 12, 11, 12]
    assert list(frame["sensors.gnss.rate_hz"]) == [1, 1, 5, 5]
    assert frame["ins.aligned_s"][3] == result.outcomes[3].metrics["ins.aligned_s"]
    assert dict(dataset.sizes) == {"run": 4, "time": 77}
    np.testing.assert_array_equal(dataset["ins.error"][2], result.outcomes[2].history["ins.error"])
    assert list(dataset["sensors.gnss.rate_hz"].values) == ["1", "1", "5", "5"]


@pytest.mark.ci
def test_values_may_be_given_as_they_are(at_rest: Path, tmp_path: Path, threads: str) -> None:
    """They were flown, and then ended in a traceback."""
    vary = {"sensors.gnss.denied": [[], [[70, 75]]], "sensors.gnss.rate_hz": [1, 5]}
    result = campaign(at_rest, 1, vary=vary, workers=threads, overrides={"duration_s": 76}, out=tmp_path / "out")
    assert not result.failures
    said = [("[]", "1"), ("[]", "5"), ("[[70, 75]]", "1"), ("[[70, 75]]", "5")]
    assert [tuple(one.values.values()) for one in result.combinations] == said
    assert [one.scenario.sensors["gnss"].rate_hz for one in result.combinations] == [1, 5, 1, 5]
    assert result.combinations[0].scenario.duration_s == 76


# --- what a user may get wrong


def test_what_is_no_scenario_or_no_number_of_workers_is_told(at_rest: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="give the file or the name of a scenario, not Scenario"):
        campaign(Scenario.load(at_rest), 1, out=tmp_path / "out")  # type: ignore[arg-type]
    with pytest.raises(UserError, match="workers 0: give at least 1"):
        campaign(at_rest, 1, workers=0, out=tmp_path / "out")
    with pytest.raises(UserError, match='workers: give a whole number, not "2"'):
        campaign(at_rest, 1, workers="2", out=tmp_path / "out")
    with pytest.raises(UserError, match=r"--vary truth\.rate_hz: give each value once"):
        campaign(at_rest, 1, vary={"truth.rate_hz": [50, 50.0]}, out=tmp_path / "out")
    run(Scenario.load(at_rest), out=tmp_path / "run")
    with pytest.raises(UserError, match="has the results of a run: choose another folder"):
        campaign(at_rest, 1, out=tmp_path / "run")


@pytest.mark.ci
def test_folder_of_another_campaign(at_rest: Path, tmp_path: Path, threads: str) -> None:
    out = tmp_path / "out"
    campaign(at_rest, 1, workers=threads, out=out)
    with pytest.raises(UserError, match="different overrides: choose another folder with --out"):
        campaign(at_rest, 1, overrides=["duration_s=79"], workers=threads, out=out)
    begun = (out / "setup.json").stat().st_mtime_ns
    at_rest.write_text(AT_REST + '[expect]\n"ins.position_horizontal_rms_m" = 100\n')
    again = campaign(at_rest, 1, workers=threads, out=out)
    assert [one.share.value for one in again.statistics.expected] == [1.0]
    assert (out / "setup.json").stat().st_mtime_ns == begun
    at_rest.write_text(AT_REST.replace("rate_hz = 5\n", "rate_hz = 2\n"))
    with pytest.raises(UserError, match="different scenario: choose"):
        campaign(at_rest, 1, workers=threads, out=out)
    (out / "setup.json").write_text("{")
    with pytest.raises(UserError, match=r"setup\.json: is damaged"):
        campaign(at_rest, 1, workers=threads, out=out)
    (out / "setup.json").unlink()
    with pytest.raises(UserError, match="has runs but no"):
        campaign(at_rest, 1, workers=threads, out=out)


OWN = """
from dataclasses import dataclass

from nav.samples import Estimate
from testbed.sensors.timing import AidingTiming, Schedule
from {helper} import OFFSET


@dataclass(frozen=True, slots=True)
class Sample:
    t: float
    t_arrival: float
    height: float
    sensor: str


class Height:
    class Section(AidingTiming):
        offset_m: float = 0.0

    def __init__(self, name, section, tick_rate_hz, seed):
        self.name, self.schedule, self.offset = name, Schedule.of(name, section, tick_rate_hz), section.offset_m

    def sense(self, truth):
        rows = self.schedule.rows(truth)
        return [Sample(truth.t[k], truth.t[k], truth.h[k] + self.offset + OFFSET, self.name) for k in rows]


class Mine:
    def __init__(self, rig):
        self.t = 0.0

    def propagate(self, imu):
        self.t = imu.t[-1]

    def update(self, sample):
        pass

    def estimate(self):
        return Estimate.of(self.t)
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[Path]:
    """A scenario with classes of the user's in a file that imports another, and that of a package, which can be."""
    monkeypatch.syspath_prepend(tmp_path)
    before = set(sys.modules)
    (tmp_path / "own_package").mkdir()
    (tmp_path / "own_package/__init__.py").touch()
    for name in ("own_helper.py", "own_package/helper.py"):
        (tmp_path / name).write_text("OFFSET = 1.0\n")
    (tmp_path / "classes.py").write_text(OWN.format(helper="own_helper"))
    (tmp_path / "own_package/classes.py").write_text(OWN.format(helper=".helper"))
    text = AT_REST.replace("duration_s = 80", "duration_s = 2").replace("denied = [[70, 75]]", "")
    mine = '[[estimator]]\nname = "mine"\nkind = "./classes.py:Mine"\nestimates = "attitude"\n'
    (tmp_path / "own.toml").write_text(f"{text}{mine}")
    yield tmp_path / "own.toml"
    for name in set(sys.modules) - before:
        if name.startswith(("own_", "classes_")):
            del sys.modules[name]


@pytest.mark.ci
@pytest.mark.parametrize("what", ["estimators", "sensors"])
def test_a_class_that_was_edited_is_another(own: Path, what: str) -> None:
    if what == "sensors":
        text = own.read_text().partition('[[estimator]]\nname = "mine"')[0]
        own.write_text(text + '[sensors.height]\nkind = "./classes.py:Height"\nrate_hz = 5\n')
    out = own.parent / "out"
    campaign(own, 1, workers=1, out=out)
    file = own.parent / "classes.py"
    file.write_text(file.read_text() + "\n\nMORE = 1\n")
    with pytest.raises(UserError, match=f"holds a campaign with different {what}: choose"):
        campaign(own, 1, workers=1, out=out)
    file.write_text(OWN.format(helper="own_helper"))
    campaign(own, 1, workers=1, out=out)


@pytest.mark.ci
@pytest.mark.parametrize(("kind", "edited"), [
    ("./classes.py:Mine", "own_helper.py"), ("own_package.classes:Mine", "own_package/helper.py"),
])  # fmt: skip
def test_what_a_class_imports_belongs_to_it(own: Path, threads: str, kind: str, edited: str) -> None:
    given = {"workers": threads, "overrides": [f"estimator[1].kind={kind!r}"], "out": own.parent / "out"}
    campaign(own, 1, **given)
    (own.parent / edited).write_text("OFFSET = 2.0\n")
    with pytest.raises(UserError, match=f"{edited}: has been edited since it was imported"):
        campaign(own, 1, **given)
    for name in [name for name in sys.modules if name.startswith(("own_", "classes_"))]:
        del sys.modules[name]  # as in a new process
    with pytest.raises(UserError, match="holds a campaign with different estimators"):
        campaign(own, 1, **given)


@pytest.mark.ci
def test_a_sensor_of_the_users_is_flown_by_workers(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    info = own.parent / "own_package-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own_package\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[navigation_testbed.sensors]\nown_height = own_package.classes:Height\n")
    plugins.installed.cache_clear()
    own.write_text(own.read_text() + "[sensors.height]\nkind = './classes.py:Height'\nrate_hz = 5\noffset_m = 2.0\n")
    kinds = ['"./classes.py:Height"', '"own_package.classes:Height"', '"own_height"']
    try:
        flown = campaign(own, 1, vary={"sensors.height.kind": kinds}, workers=2, out=own.parent / "out")
    finally:
        plugins.installed.cache_clear()
    assert not flown.failures
    assert [len(one.history["time"]) for one in flown.outcomes] == [3, 3, 3]


def test_a_run_after_an_edit_is_none_of_the_campaign(own: Path) -> None:
    scenario = Scenario.load(own)
    task = campaigns._Task(0, 1, scenario, None, folder.code(), folder.own([scenario]))
    (own.parent / "classes.py").write_text(OWN.format(helper="own_helper") + "#")
    flown = campaigns._fly(task, lambda share: None)
    assert isinstance(flown, Failure)
    assert "has been edited meanwhile" in flown.message


@pytest.mark.ci
def test_a_class_that_is_edited_before_it_flies_is_not_flown(
    own: Path, threads: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder is of the class as it was when it was made."""
    file = own.parent / "classes.py"
    monkeypatch.setattr(campaigns, "share_truth", lambda *_: file.write_text(file.read_text() + "#") and None)
    out, vary = own.parent / "out", {"estimator[1].kind": ["./classes.py:Mine", "own_package.classes:Mine"]}
    flown = campaign(own, 1, vary=vary, workers=threads, out=out)
    assert [one.combination for one in flown.outcomes] == [1]
    assert ["edited meanwhile" in one.message for one in flown.failures] == [True]


def test_folder_that_cannot_be(at_rest: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="can't write here"):
        campaign(at_rest, 1, out=tmp_path / "file" / "out")


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"vary": {"sensors.gnss.rate_hz": np.array(5.0)}}, '"5.0" is one value: give a list of values'),
        ({"vary": [1, 2]}, "vary: give lists of values by key, such as .*, not list"),
        ({"vary": {3: [1]}}, "vary: a key is a text, not 3"),
        ({"overrides": 3}, "overrides: give values by key, such as .*, not 3"),
        ({"overrides": "duration_s=3"}, "overrides: give values by key, such as .*, not .duration_s=3"),
        ({"overrides": [3]}, "overrides: give values by key, such as .*, not list"),
        ({"overrides": {3: 4}}, "overrides: a key is a text, not 3"),
        ({"runs": "2"}, 'runs: give a whole number, not "2"'),
        ({"runs": 2.0}, r"runs: give a whole number, not 2\.0"),
        ({"draw": None}, "draw: give a whole number, not NoneType"),
        ({"workers": 1.5}, r"workers: give a whole number, not 1\.5"),
        ({"out": 3}, "out: give a folder, not int"),
        ({"out": ""}, "out: give a folder, not ''"),
    ],
)
def test_what_is_of_no_such_type_is_told(at_rest: Path, tmp_path: Path, wrong: dict[str, Any], says: str) -> None:
    with pytest.raises(UserError, match=says):
        campaign(at_rest, **{"runs": 1, "out": tmp_path / "out", **wrong})
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ({"seed": ["1", "2"]}, "use --runs"),
        ({"sensors.gnss.rate_hz": ["1", "1"]}, "each value once"),
        ({"sensors.gnss.rate_hz": []}, "each value once"),
        ({"sensors.gnss.rate_hz": ["5", "7"]}, "does not divide"),
        ({"sensors.gnss.speed": ["5"]}, "unknown key"),
        ({"sensors.gnss.rate_hz": "1,5"}, '"1,5" is one value: give a list of values'),
        ({"sensors.gnss.rate_hz": 5}, '"5" is one value: give a list of values'),
        ({"sensors.gnss.rate_hz": [1, "1"]}, "each value once"),
        ({"sensors.gnss.rate_hz": [5, None]}, "and no NoneType"),
    ],
)
def test_wrong_varied_values(at_rest: Path, tmp_path: Path, vary: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        campaign(at_rest, 2, vary=vary, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("address", ["localhost", "nonsense://here:1", "tcp://127.0.0.1:port"])
def test_scheduler_address_that_is_none(at_rest: Path, tmp_path: Path, address: str) -> None:
    with pytest.raises(UserError, match="give an address like tcp://host:8786"):
        campaign(at_rest, 1, workers=address, out=tmp_path / "out")


@pytest.mark.ci
def test_scheduler_that_does_not_answer(at_rest: Path, tmp_path: Path) -> None:
    assert pool.CONNECT_S <= 3.0  # after which it is given up
    with pytest.raises(UserError, match="nothing answers there"):
        campaign(at_rest, 1, workers=f"tcp://127.0.0.1:{free_port()}", out=tmp_path / "out")


def test_scheduler_without_workers(at_rest: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "WORKER_WAIT_S", 0.5)
    with in_this_process(0) as cluster, pytest.raises(UserError, match="has no workers"):
        campaign(at_rest, 1, workers=cluster.scheduler_address, out=tmp_path / "out")


# --- statistics


def test_nees_bounds_are_those_of_the_tables() -> None:
    # Chi-square with 150 degrees of freedom: 117.985 and 185.800 at 2.5 and 97.5 % (NIST/SEMATECH e-Handbook, 1.3.6.7.4
    # gives 100: 74.222 and 129.561).
    np.testing.assert_allclose(campaign_figures.nees_bounds(50) * 150, [117.985, 185.800], atol=1e-3)
    # Three degrees of freedom for a single run: 0.216 and 9.348.
    np.testing.assert_allclose(campaign_figures.nees_bounds(1) * 3, [0.216, 9.348], atol=1e-3)


def made_up(combination: int, seed: int, rng: np.random.Generator, claim: float = 1.0) -> Outcome:
    """A run of a filter whose covariance is too small by the square of ``claim``."""
    error = rng.normal(size=(400, 3))
    history = {
        "time": np.arange(400.0),
        "outage": np.r_[np.zeros(100), np.ones(100), np.zeros(200)],
        "ins.error": np.hypot(error[:, 0], error[:, 1]),
        "ins.sigma": np.full(400, math.sqrt(2.0)),
        "ins.nees": np.where(np.arange(400) < 10, np.nan, (error**2).sum(axis=1) / 3 * claim**2),
    }
    metrics = {
        "ins.position_horizontal_max_m": 1.0 + seed,
        "ins.position_horizontal_rms_m": float(seed),
        "ins.false_alarms_per_h": float(seed % 2),
    }
    metrics |= {"ins.detection_delay_s.jump": 0.1 * seed, "ins.coverage.jump": 1 - 0.01 * seed}
    mean = {f"ins.outage_velocity_{axis}_mean_mps": 0.3 + 0.01 * seed for axis in ("north", "east", "down")}
    metrics |= mean | {"ins.heading_mean_deg": 1.0}
    metrics |= {"ins.outage_position_horizontal_at_600s_m": 60.0 + seed % 2 * 80.0, "ins.outage_bound_at_600s_m": 50.0}
    if seed != 4:
        metrics["ins.recovery_s"] = 10.0 - seed
    return Outcome(combination, seed, metrics, history)


def made_up_campaign(tmp_path: Path, values: list[str], runs: int = 30) -> campaigns.CampaignResult:
    estimator = SimpleNamespace(name="ins", attitude_only=False)
    expect = {
        "ins.position_horizontal_rms_m": Bounds(min=4.0, max=20.0),
        "ins.recovery_s": Bounds(max=100.0),
        "ins.nothing_of_the_kind": Bounds(min=1.0),
    }
    scenario: Any = SimpleNamespace(title="Made up", estimator=[estimator], fault=(), expect=expect)
    combinations = [Combination({"wind": value} if value else {}, scenario) for value in values]
    rng = np.random.default_rng(2)
    outcomes = [made_up(i, seed, rng, 1.0 + i) for i in range(len(values)) for seed in range(runs)]
    statistics = campaign_report.statistics(combinations, outcomes)
    return campaigns.CampaignResult(tmp_path, combinations, outcomes, [Failure(0, 99, "lost")], statistics)


def test_statistics(tmp_path: Path) -> None:
    statistics = made_up_campaign(tmp_path, ["0", "5"]).statistics
    first, second = statistics.consistency
    low, high = chi2.ppf([0.0005, 0.9995], 3 * 30 * 390) / (3 * 30 * 390)  # 30 runs of 390 independent errors
    assert low < first.nees < high
    assert first.inside == pytest.approx(0.95, abs=0.04)
    assert first.lower < 1.0 < first.upper
    assert 4 * low < second.nees < 4 * high
    assert second.inside == 0.0
    assert first.false_alarms_per_h == pytest.approx(0.5)
    rms = next(s for s in statistics.spreads if s.metric == "position_horizontal_rms_m")
    assert (rms.median, rms.worst, rms.worst_seed, rms.runs) == (14.5, 29.0, 29, 30)
    assert rms.median == made_up_campaign(tmp_path, [""]).frame()[f"ins.{rms.metric}"].median()
    assert rms.p95 == 28.0  # the 29th of 30
    recovery = next(s for s in statistics.spreads if s.metric == "recovery_s")
    assert (recovery.worst, recovery.worst_seed, recovery.runs) == (10.0, 0, 29)
    delay = next(s for s in statistics.spreads if s.metric == "detection_delay_s.jump")
    assert (delay.worst, delay.worst_seed) == (pytest.approx(2.9), 29)
    coverage = next(s for s in statistics.spreads if s.metric == "coverage.jump")  # little is bad
    assert (coverage.worst, coverage.worst_seed) == (pytest.approx(0.71), 29)
    assert coverage.p95 == pytest.approx(0.72)  # the second
    shown = "".join(str(cell) for cell in campaign_report.tables(made_up_campaign(tmp_path, ["0"]))[0].columns[1].cells)
    assert "jump: detected after \\[s]" in shown


def test_mean_errors_and_efficiency_have_intervals(tmp_path: Path) -> None:
    result = made_up_campaign(tmp_path, ["0"])
    mean, _, _ = result.statistics.means  # of axes of position and velocity, nothing else
    assert (mean.metric, mean.runs) == ("outage_velocity_north_mean_mps", 30)
    assert mean.mean == pytest.approx(0.445)
    interval = ttest_1samp(0.3 + 0.01 * np.arange(30), 0.0).confidence_interval(0.95)
    assert (mean.low, mean.high) == pytest.approx((interval.low, interval.high))
    (found,) = result.statistics.efficiencies
    assert (found.metric, found.bound) == ("outage_efficiency_at_600s", pytest.approx(50.0))
    rms = math.sqrt((60.0**2 + 140.0**2) / 2)
    assert (found.rms, found.efficiency) == (pytest.approx(rms), pytest.approx(rms / 50.0))
    interval = ttest_1samp(np.tile([1.2**2, 2.8**2], 15), 0.0).confidence_interval(0.95)
    assert (found.low, found.high) == pytest.approx((math.sqrt(interval.low), math.sqrt(interval.high)))
    (alone,) = made_up_campaign(tmp_path, ["0"], runs=1).statistics.efficiencies
    assert math.isnan(alone.low)
    assert alone.efficiency == pytest.approx(1.2)
    titles = [text.title for text in campaign_report.texts(result)]
    assert "Horizontal error in outages against the bound" in titles


def test_how_many_runs_keep_what_is_expected(tmp_path: Path) -> None:
    """Of 30 runs the error of run k is k, run 4 has no recovery."""
    result = made_up_campaign(tmp_path, ["0"])
    least, largest, recovery, nothing = result.statistics.expected
    clopper = binomtest(26, 30).proportion_ci(0.95)
    assert least.share == pytest.approx((26 / 30, clopper.low, clopper.high))
    assert (least.at_least, least.bound, least.most[0]) == (True, 4.0, 1.0)
    assert (largest.share[0], largest.median[0], largest.most[0]) == (21 / 30, 14.5, 28.0)
    assert math.isinf(largest.most[2])  # 95 % of all runs: thirty can't tell
    assert recovery.share[0] == 29 / 30
    assert nothing.share[0] == 0.0
    assert [one.missing for one in result.statistics.expected] == [0, 0, 1, 30]
    assert recovery.row[2].endswith(" %, missing in 1")
    assert largest.row[:2] == ("ins.position_horizontal_rms_m", "≤ 20")
    titles = [text.title for text in campaign_report.texts(result)]
    assert titles[-1] == "[expect] over the runs"
    campaign_report.save(result)
    kept = json.loads((tmp_path / campaign_report.SUMMARY).read_text())["expected"]
    assert kept[1]["most"][2] is None
    assert "[expect] over the runs" in (tmp_path / REPORT).read_text("utf-8")


def test_names_stay_legible_on_a_narrow_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wide = ("≤ 1.50e-05", "86.7 (69.3 to 96.2) %", "1.234e-05 (1.111e-05 to 1.999e-05)", "≤ 1.9e-05 (1.8e-05 to inf)")
    rows = [["metric", "wind", "bound", "kept by", "median", "95 % of runs"], ["ins.nothing_of_the_kind", "5", *wide]]
    monkeypatch.setattr(campaign_report, "texts", lambda result: [campaign_report.Text("[expect]", rows, 2)])
    console = Console(width=80, file=io.StringIO())
    (table,) = campaign_report.tables(made_up_campaign(tmp_path, ["0"]))
    console.print(table)
    lines = console.file.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    first = lines[next(k for k, line in enumerate(lines) if "───" in line) + 1]
    assert "ins.nothing_" in first
    for part in " ".join(wide).split():
        assert part in "\n".join(lines)


def test_the_manual_has_a_section_for_each_scenario(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(expected, "docs_dir", lambda: tmp_path)
    result = replace(made_up_campaign(tmp_path, ["0"]), failures=())
    for name, runs in (("u_turn", 30), ("jammer_zone", 31), ("u_turn", 32)):
        plan = Plan(name, runs, tmp_path, draw=7)
        expected.require_shipped(plan)
        path = expected.save(plan, result)
    page = path.read_text("utf-8")
    assert [line for line in page.splitlines() if line.startswith("## ")] == ["## jammer_zone", "## u_turn"]
    assert "`testbed campaign u_turn --runs 32 --draw 7 --save`" in page
    assert "--runs 30" not in page
    assert page.count("| ins.recovery_s | ≤ 100 |") == 2
    assert page.startswith(expected.HEAD)
    assert (docs_dir() / expected.PAGE).read_text("utf-8").startswith(expected.HEAD)
    with pytest.raises(UserError, match="1 runs failed"):
        expected.save(plan, made_up_campaign(tmp_path, ["0"]))


@pytest.mark.parametrize("plan", [
    Plan("mine.toml", 2, Path("x")), Plan("u_turn", 2, Path("x"), {"seed": ["1"]}),
    Plan("u_turn", 2, Path("x"), overrides=["duration_s=70"]),
])  # fmt: skip
def test_the_manual_is_of_shipped_scenarios(plan: Plan) -> None:
    with pytest.raises(UserError, match="shipped scenarios"):
        expected.require_shipped(plan)


@pytest.mark.ci
def test_a_worker_keeps_no_record_of_the_run_before(at_rest: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    left: list[weakref.ref[Any]] = []
    plain = campaigns.history_of

    def history(dataset: Any) -> Any:
        left.append(weakref.ref(dataset["truth/h"].values))
        return plain(dataset)

    monkeypatch.setattr(campaigns, "history_of", history)
    scenario = Scenario.load(at_rest, ["duration_s=5", "sensors.gnss.denied=[]"])
    for seed in (1, 2):
        task = campaigns._Task(0, seed, scenario, None, folder.code(), folder.own([scenario]))
        flown = campaigns._fly(task, lambda share: None)
        assert isinstance(flown, Outcome)
        assert sum(one() is not None for one in left) == 1  # the last


@pytest.mark.parametrize(
    "listed", [["'a'", '"a"'], ["1", "1.0"], ["1e0", "1"], ["[1, 2]", "[1,2]"], ["[1]", "[1.0]"], []]
)
def test_a_value_given_twice_is_refused_however_it_is_written(listed: list[str]) -> None:
    given.require_once("estimator[0].grade", ["true", "1", "'a'", "a.b", "[1]", "1" * 400])
    with pytest.raises(UserError, match="give each value once"):
        given.require_once("estimator[0].grade", listed)


@pytest.mark.parametrize("text", ["[]", '{"metrics": []}', '{"metrics": {"ins.aligned_s": "soon"}}', "{}", "1"])
def test_a_stored_run_of_another_shape_is_none(text: str, tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs/c000_s000001.json").write_text(text)
    np.savez(tmp_path / "runs/c000_s000001.npz", time=np.zeros(1))
    assert campaigns._load(tmp_path, 0, 1) is None


@pytest.mark.ci
def test_a_loop_that_never_closed_is_a_failure() -> None:
    """The flight on truth to its end was a success, of an estimator that never said anything."""
    scenario = Scenario.load("closed_loop_gnss_outage", ["duration_s=1", "sensors.gnss.denied=[]", "expect={}"])
    task = campaigns._Task(0, 1, scenario, None, folder.code(), folder.own([scenario]))
    flown = campaigns._fly(task, lambda share: None)
    assert isinstance(flown, Failure)
    assert "the autopilot flew on truth to the end" in flown.message


def test_few_runs_have_no_interval(tmp_path: Path) -> None:
    # P(all n on one side of the median) = 2^(1 - n), above 5 % up to five runs; 0.95^n above 2.5 % up to 71
    for runs, ends in ((5, (False, False)), (6, (True, False)), (80, (True, True))):
        spread = made_up_campaign(tmp_path, [""], runs).statistics.spreads[0]
        assert (math.isfinite(spread.median_high), math.isfinite(spread.p95_high)) == ends
    intervals = campaign_report.texts(made_up_campaign(tmp_path, [""], 6))[1]
    assert intervals.rows[1][2:] == ["0 – 5.00", "≥ 3.00"]


@pytest.mark.ci
def test_runs_too_short_to_be_scored_say_so(at_rest: Path, tmp_path: Path, threads: str) -> None:
    short = ["duration_s=20", "sensors.gnss.denied=[]"]
    errors, *_, consistency = campaign_report.texts(
        campaign(at_rest, 2, overrides=short, out=tmp_path / "out", workers=threads)
    )
    assert errors.title.endswith("none is scored, which begins 60 s after an alignment")
    _, nees, _, inside, *_ = consistency.rows[1]
    assert (nees, inside) == ("–", "–")


def test_history_is_the_error_once_a_second() -> None:
    dataset = synthetic_run.dataset(100.0, denied=((40.0, 50.0),))
    history = campaigns.history_of(dataset)
    np.testing.assert_allclose(history["time"], np.arange(101.0))
    np.testing.assert_array_equal(np.flatnonzero(history["outage"]), np.arange(40, 51))  # the fix comes at 50.1 s
    assert np.flatnonzero(np.isfinite(history["ins.error"]))[0] == 5
    assert np.flatnonzero(np.isfinite(history["ins.nees"]))[0] == 65
    errors = accuracy.errors(dataset, "ins")
    row = int(np.argmin(np.abs(errors.t - 77.0)))
    assert history["ins.error"][77] == pytest.approx(math.hypot(*errors.position[row, :2]))
    assert history["ins.sigma"][77] == pytest.approx(math.sqrt(2.0))


@pytest.mark.ci
@pytest.mark.parametrize("values", [[""], ["0", "5"], ["0", "1", "2", "3", "4", "5", "6"]])
def test_figures_are_drawn(tmp_path: Path, values: list[str]) -> None:
    result = made_up_campaign(tmp_path, values, runs=5)
    drawn = campaign_figures.figures(result)
    assert set(drawn) == {"errors", "nees", "distribution" if values == [""] else "distribution_wind"}
    for one in drawn.values():
        one.figure.canvas.draw()
    panels = drawn["nees"].figure.axes
    assert panels[0].get_ylabel() == "position NEES / dof"
    assert len(panels[0].get_lines()) == 1 + len(values)


@pytest.mark.ci
@pytest.mark.skipif(browser.program() is None, reason="there is no Chromium on this machine to open a page in")
def test_the_page_can_be_looked_around_in(tmp_path: Path) -> None:
    campaign_report.save(made_up_campaign(tmp_path, ["0", "5"], runs=5))
    with browser.opened() as tab:
        tab.size(1200, 4000)
        tab.open(tmp_path / REPORT, "document.documentElement.dataset.state == 'whole'")
        assert tab.run("page.panels.map((panel) => panel.spec.title.split(': ')[1])") == [
            "horizontal error",
            "position NEES / dof",
        ]
        assert tab.run("page.panels.every((panel) => panel.view)")
        tab.run("page.setCursor(150)")
        tab.until("page.panels[0].told.textContent.includes(' – ')")  # median and percentiles
        assert tab.run("page.panels[0].values().length") == 4  # two combinations, each with its claim
        tab.key("1")
        tab.until("page.panels[0].values().length == 2")
        assert tab.complaints == []


def test_nothing_flown_draws_nothing(tmp_path: Path) -> None:
    result = made_up_campaign(tmp_path, [""], runs=0)
    campaign_report.save(result)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["campaign.csv", "campaign.json", MANIFEST]
    assert json.loads((tmp_path / "campaign.json").read_text())["failures"][0]["message"] == "lost"


def test_outages_that_differ_between_runs_are_not_shaded(tmp_path: Path) -> None:
    result = made_up_campaign(tmp_path, [""], runs=2)
    assert campaign_figures.outages_of(result) == [(100.0, 200.0)]
    result.outcomes[1].history["outage"][150:] = 1.0
    assert campaign_figures.outages_of(result) == []


def test_run_that_ends_early_hides_no_other(tmp_path: Path) -> None:
    result = made_up_campaign(tmp_path, [""], runs=3)
    history = result.outcomes[0].history
    result.outcomes[0] = Outcome(0, 0, result.outcomes[0].metrics, {k: v[:150] for k, v in history.items()})  # type: ignore[index]
    mean, runs = campaign_figures.nees_mean(result.outcomes, "ins")
    assert (runs[149], runs[150], len(mean)) == (3, 2, 400)
    assert np.isfinite(mean[10:]).all()
    assert campaign_figures.outages_of(result) == [(100.0, 200.0)]
    drawn = campaign_figures.figures(result)["errors"].figure
    assert drawn.axes[0].get_lines()[0].get_xdata()[-1] == 399.0


@pytest.mark.ci
def test_a_recorded_flight_is_read_by_every_run(tmp_path: Path) -> None:
    vary = {"sensors.gnss.denied": ["[[10, 15]]", "[[12, 20]]"]}
    plan = Plan("recorded_flight", 1, tmp_path / "out", vary, ("duration_s=70", "expect={}"))
    result = campaigns.fly(plan, None, None)
    assert result.failures == []
    assert [len(outcome.metrics) > 40 for outcome in result.outcomes] == [True, True]
