"""What a run costs: over the simulator alone, at its start, in a campaign, and as it grows."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from statistics import median

from bench.measure import MAIN, TWO_ESTIMATORS, Effort, Row, alternate, cpu_seconds, ratios, wall_seconds
from bench.shares import shares

from testbed.exports import FORMATS, export
from testbed.loop import loop
from testbed.motion.model import Aircraft
from testbed.motion.sections import FlightTruth
from testbed.results import RECORD
from testbed.scenario import Scenario

CAMPAIGN_RUNS = 20


def whole_run(effort: Effort) -> Iterator[Row]:
    """Wall time to fly, sense, run two estimators and record, over JSBSim stepping the same aircraft as long.

    A run counts until its record is complete and read back (`run.wall_s`): what comes then, metrics, is no part of it.
    """
    scenario = main_scenario(effort, TWO_ESTIMATORS)
    with tempfile.TemporaryDirectory() as folder:
        whole, bare = alternate(
            lambda: loop.run(scenario, out=Path(folder)).metrics["run.wall_s"],
            lambda: wall_seconds(lambda: _step(scenario)),
            effort,
        )
    yield Row("whole run / bare JSBSim stepping, wall", ratios(whole, bare), at_most=2.0, detail=_over(whole, bare))


def cpu_two_estimators(effort: Effort) -> Iterator[Row]:
    """Processor time of a whole run with two estimators and record, over JSBSim stepping the same aircraft."""
    yield _cpu("two estimators and record / bare JSBSim, CPU", main_scenario(effort, TWO_ESTIMATORS), 2.2, effort)


def cpu_main_scenario(effort: Effort) -> Iterator[Row]:
    """The same of the main scenario with its three estimators."""
    yield _cpu("main scenario's three and record / bare, CPU", main_scenario(effort), 3.0, effort)


def _cpu(what: str, scenario: Scenario, at_most: float, effort: Effort) -> Row:
    """A run in seconds of all processes, metrics included, and which part of the product takes how much of them."""
    with tempfile.TemporaryDirectory() as folder:

        def fly() -> None:
            loop.run(scenario, out=Path(folder))

        whole, bare = alternate(lambda: cpu_seconds(fly), lambda: cpu_seconds(lambda: _step(scenario)), effort)
        spent = shares(fly)
    parts = ", ".join(f"{room} {100 * seconds / sum(spent.values()):.0f} %" for room, seconds in spent.items())
    return Row(what, ratios(whole, bare), at_most=at_most, detail=f"{_over(whole, bare)}: {parts}")


def telemetry(effort: Effort) -> Iterator[Row]:
    """Processor time that a telemetry log at 25 Hz adds to the main scenario, over JSBSim stepping alone."""
    from testbed.mavlink import MavlinkPublisher

    scenario = main_scenario(effort)
    with tempfile.TemporaryDirectory() as folder:

        def fly(*urls: str) -> float:
            def flown() -> None:
                links = [MavlinkPublisher(urls, scenario)] if urls else []
                loop.run(scenario, links=links, out=Path(folder))

            return cpu_seconds(flown)

        def added() -> float:
            without = fly()
            return fly(f"tlog:{folder}/run.tlog") - without

        more, bare = alternate(added, lambda: cpu_seconds(lambda: _step(scenario)), effort)
    yield Row("telemetry log adds / bare JSBSim, CPU", ratios(more, bare), at_most=0.6, detail=_over(more, bare))


def exports(effort: Effort) -> Iterator[Row]:
    """Processor time of turning the record of the main scenario into each format; mcap where its extra is installed."""
    with tempfile.TemporaryDirectory() as folder:
        loop.run(main_scenario(effort), out=Path(folder))
        for name, one in FORMATS.items():
            if one.extra and find_spec(one.extra) is None:
                continue
            target = Path(folder) / "out" / name
            seconds = [
                cpu_seconds(lambda form=name, to=target: export(Path(folder) / RECORD, form, to, force=True))
                for _ in range(min(2, effort.rounds))
            ]
            yield Row(f"export to {name}, CPU", tuple(seconds), "s")


def federation(effort: Effort) -> Iterator[Row]:
    """Processor time in a federation of three local filters over that in an INS with the same aids, in flight."""
    ins = 'estimator=[{name="ins", aids=["gnss", "barometer", "magnetometer", "airspeed"]}]'
    parts = ", ".join(
        f"{{name='{name}', aids=[{aids}]}}"
        for name, aids in (("gnss", "'gnss'"), ("air", "'airspeed', 'barometer'"), ("mag", "'magnetometer'"))
    )

    def spent(estimator: str) -> float:
        scenario = main_scenario(effort, estimator)
        return shares(lambda: loop.run(scenario))["estimators"]

    for structure in ("full_reset", "no_reset"):
        federated = f'estimator=[{{name="fused", kind="federated", structure="{structure}", locals=[{parts}]}}]'
        above, below = alternate(lambda one=federated: spent(one), lambda: spent(ins), effort)
        detail = f"{median(above):.2f} s over {median(below):.2f} s"
        yield Row(f"federation, {structure} / INS, CPU", ratios(above, below), at_most=4.0, detail=detail)


def main_scenario(effort: Effort, *overrides: str) -> Scenario:
    """The main scenario, all of it or its beginning."""
    full = Scenario.load(MAIN, [*overrides, "expect={}"])
    duration = effort.count(full.duration_s)
    return full.model_copy(update={"duration_s": float(duration)})


def _step(scenario: Scenario) -> None:
    """Step JSBSim's model of the scenario's aircraft as long as the scenario flies, nothing read."""
    truth = scenario.truth
    assert isinstance(truth, FlightTruth)
    aircraft = Aircraft(truth.aircraft, truth.rate_hz)
    aircraft.start(truth.start)
    aircraft.turbulence(truth.wind.turbulence, 1)
    run = aircraft.fdm.run
    for _ in range(round(scenario.duration_s * truth.rate_hz)):
        run()


def _over(whole: tuple[float, ...], bare: tuple[float, ...]) -> str:
    return f"{median(whole):.2f} s over {median(bare):.2f} s"


def campaign_efficiency(effort: Effort) -> Iterator[Row]:
    """Wall time of a campaign of the main scenario with two estimators, on one worker over twice that on two."""
    from testbed.many.campaign import campaign

    full = Scenario.load(MAIN).duration_s
    runs, duration = effort.count(CAMPAIGN_RUNS), effort.count(full)
    denied = [round(t * duration / full) for t in (600, 1200)]  # as in the scenario when it is flown in full
    overrides = [TWO_ESTIMATORS, "expect={}", f"duration_s={duration}", f"sensors.gnss.denied=[{denied}]"]
    seconds: dict[int, list[float]] = {2: [], 1: []}
    for _ in range(min(3, effort.rounds)):
        for workers, taken in seconds.items():
            with tempfile.TemporaryDirectory() as folder:
                began = time.perf_counter()
                campaign(MAIN, runs, overrides=overrides, out=Path(folder), workers=workers)
                taken.append(time.perf_counter() - began)
    detail = f"{runs} runs: {median(seconds[1]):.0f} s on one worker, {median(seconds[2]):.0f} s on two"
    halves = tuple(one / 2 for one in seconds[1])
    yield Row("campaign: parallel efficiency", ratios(halves, seconds[2]), "", at_least=0.85, detail=detail)


def start_up(effort: Effort) -> Iterator[Row]:
    """Cold compile of every kernel, and the time from process start to the first tick when they are compiled.

    Kernels can't be compiled in part: less than all of the work is to do without those of the estimators.
    """
    overrides = ["duration_s=20", "sensors.gnss.denied=[]"]
    if effort.share < 1:
        overrides += ["estimator=[]", "expect={}"]
    script = (
        "import time; from testbed import Scenario, run\n"
        "first = []\n"
        "def tick(p):\n"
        "    first or first.append(time.time())\n"
        f"run(Scenario.load('{MAIN}', {overrides!r}), progress=tick)\n"
        "print(first[0])\n"
    )
    with tempfile.TemporaryDirectory() as cache:
        cold, _ = _process(script, {"NUMBA_CACHE_DIR": cache})
        warm = [_process(script, {"NUMBA_CACHE_DIR": cache}) for _ in range(effort.rounds)]
    yield Row("cold JIT compile", tuple(cold - total for total, _ in warm), "s", at_most=15.0)
    yield Row("second start to first tick", tuple(first for _, first in warm), "s", at_most=3.0)


def _process(script: str, environment: dict[str, str]) -> tuple[float, float]:
    """Wall seconds of a fresh interpreter, in all and until the moment that it prints."""
    began = time.time()
    done = subprocess.run(
        [sys.executable, "-c", script], env=os.environ | environment, capture_output=True, text=True, check=True
    )
    return time.time() - began, float(done.stdout) - began


def growth(effort: Effort) -> Iterator[Row]:
    """What a run costs as it grows: processor time per simulated hour, wall time and memory."""
    many = ", ".join(f"{{name='ins{k}', aids=['gnss', 'barometer', 'magnetometer', 'airspeed']}}" for k in range(4))
    cases = (
        ("of 600 s", 600, []),
        ("of 1200 s", 1200, []),
        ("of 2400 s", 2400, []),
        ("of 600 s, IMU at 100 Hz", 600, ["sensors.imu.rate_hz=100"]),
        ("of 600 s, GNSS and barometer at 20 Hz", 600, ["sensors.gnss.rate_hz=20", "sensors.barometer.rate_hz=20"]),
        ("of 600 s, 1 estimator", 600, ["estimator=[{name='ins', aids=['gnss']}]"]),
        ("of 600 s, 4 estimators", 600, [f"estimator=[{many}]"]),
    )
    flights: list[tuple[str, int, list[str]]] = []
    for case, full, further in cases:
        duration = effort.count(full)
        denied = f"sensors.gnss.denied=[[{duration / 3:.0f}, {duration * 2 / 3:.0f}]]"
        flights.append((case, duration, [denied, "expect={}", f"duration_s={duration}", *further]))
    # Each by itself, or memory would be that of the flights before; of little work most would be the imports.
    for together in [flights] if effort.share < 1 else [[flight] for flight in flights]:
        figures = _grown([overrides for _, _, overrides in together])
        for (case, duration, _), (cpu, wall, memory) in zip(together, figures, strict=True):
            detail = f"{duration} s flown in {wall:.2f} s of wall time, at most {memory:.0f} MiB"
            yield Row(f"run {case}", (cpu * 3600 / duration,), "CPU s/h", detail=detail)


def _grown(flights: list[list[str]]) -> list[list[float]]:
    """Processor and wall seconds and largest memory [MiB] of flights one after the other in a fresh interpreter."""
    script = (
        "import os, re, tempfile, time; from pathlib import Path; from testbed import Scenario, run\n"
        f"run(Scenario.load('{MAIN}', ['duration_s=20', 'sensors.gnss.denied=[]', 'expect={{}}']))  # imports\n"
        f"for overrides in {flights!r}:\n"
        f"    scenario = Scenario.load('{MAIN}', overrides)\n"
        "    with tempfile.TemporaryDirectory() as folder:\n"
        "        began, before = time.perf_counter(), sum(os.times()[:4])\n"
        "        run(scenario, out=Path(folder))\n"
        "        wall, cpu = time.perf_counter() - began, sum(os.times()[:4]) - before\n"
        # not getrusage, whose maximum is that of the process which started this one, if that was larger
        "    memory = int(re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())[1]) / 1024\n"
        "    print(cpu, wall, memory)\n"
    )
    out = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    return [[float(word) for word in line.split()] for line in out.splitlines()]
