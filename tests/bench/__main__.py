"""Speed, each figure as a ratio measured in one run: machines differ and are noisy, ratios much less so.

Peers come with the bench extra (`make bench` installs it): pyins (PyPI python-ins), smsfusion and vqf. Alternating
rounds, the median of each side.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from nav import strapdown, unscented
from nav._jit import njit
from nav.ahrs import Ahrs, AhrsConfig
from nav.alignment import InitialState
from nav.earth import A as EARTH_RADIUS
from nav.earth import gravity, position_difference_n
from nav.error_model import POS, VEL, ErrorModel, ImuModel, Indices, transition
from nav.federated import Config, Federated, Local
from nav.horizon import FusionHorizon
from nav.ins import Ins, InsConfig
from nav.local_filter import GnssAid, Watched
from nav.reference import integrate
from nav.rotation import euler_from_quat, quat_from_euler
from nav.samples import Array, FixType, GnssSample, ImuSamples, Sample
from testbed.loop import loop
from testbed.scenario import Scenario

MAIN = "loiter_gnss_outage"
ROUNDS = 5
CAMPAIGN_RUNS = 40
LIVE_S = 25
DEG = np.pi / 180
HAS_PEERS = all(find_spec(name) is not None for name in ("pyins", "smsfusion", "vqf"))

# The oracle hour: 100 Hz IMU, 1 Hz GNSS position, errors of an industrial MEMS unit.
RATE_HZ, HOUR_S = 100, 3600.0
START = (50.0, 30.0, 500.0)  # lat, lon [deg], h [m]
GYRO_NOISE, ACCEL_NOISE = 0.3 * DEG / 60, 0.05 / 60  # [rad/sqrt(s)], [m/s/sqrt(s)]
GYRO_BIAS = np.array([60.0, -40.0, 50.0]) * DEG / 3600  # [rad/s]
ACCEL_BIAS = np.array([0.05, -0.04, 0.06])  # [m/s^2]
GYRO_WALK, ACCEL_WALK = 1e-6, 1e-5  # [rad/s/sqrt(s)], [m/s^2/sqrt(s)]
GNSS_SIGMA = 1.0  # [m]
REST_S, REST_HZ = 600.0, 200  # of the comparisons without a peer
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
TWO_ESTIMATORS = (
    "estimator=[{name='ins', aids=['gnss', 'barometer', 'magnetometer', 'airspeed']}, {name='dead_reckoning', aids=[]}]"
)
IMU_COLUMNS = ("gyro", "accel")  # as pyins names them


@dataclass(frozen=True, slots=True)
class Row:
    """One figure with the bound it must keep: at most or at least ``bound``; no bound, only a figure."""

    what: str
    value: float
    unit: str = "x"
    at_most: float | None = None
    at_least: float | None = None
    detail: str = ""

    @property
    def kept(self) -> bool:
        """Whether the bound is kept."""
        if self.at_most is not None and not self.value <= self.at_most:
            return False
        return self.at_least is None or self.value >= self.at_least


def _seconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def _alternate(first: Callable[[], object], second: Callable[[], object], rounds: int = ROUNDS) -> tuple[float, float]:
    """Median seconds of each side, the two taken in turn after one warm-up."""
    first()
    second()
    pairs = [(_seconds(first), _seconds(second)) for _ in range(rounds)]
    return median(a for a, _ in pairs), median(b for _, b in pairs)


def whole_run() -> list[Row]:
    """Fly, sense, two estimators, record to disk; over JSBSim stepping the same aircraft as long, nothing read.

    A run counts until its record is complete and read back (`run.wall_s`): what comes then, metrics, is no part of it.
    """
    from testbed.motion.flight import Aircraft
    from testbed.motion.sections import FlightTruth

    scenario = Scenario.load(MAIN, [TWO_ESTIMATORS, "expect={}"])
    assert isinstance(scenario.truth, FlightTruth)
    truth = scenario.truth
    ticks = round(scenario.duration_s * truth.rate_hz)
    with tempfile.TemporaryDirectory() as folder:

        def fly() -> float:
            return loop.run(scenario, out=Path(folder)).metrics["run.wall_s"]

        def step() -> float:
            began = time.perf_counter()
            aircraft = Aircraft(truth.aircraft, truth.rate_hz)
            aircraft.start(truth.start, [(0.0, 0.0, 0.0)])
            aircraft.turbulence(truth.wind.turbulence, 1)
            run = aircraft.fdm.run
            for _ in range(ticks):
                run()
            return time.perf_counter() - began

        fly()  # compiles and imports
        pairs = [(fly(), step()) for _ in range(ROUNDS)]
    whole, bare = median(a for a, _ in pairs), median(b for _, b in pairs)
    detail = f"{whole:.2f} s over {bare:.2f} s ({bare / ticks * 1e6:.1f} us per step), {scenario.duration_s:g} s flown"
    return [Row("whole run / bare JSBSim stepping", whole / bare, at_most=2.0, detail=detail)]


def strapdown_alone() -> list[Row]:
    """The strapdown kernel over pyins' batch integration, the same increments."""
    if not HAS_PEERS:
        return []
    from pyins import strapdown as peer

    trajectory, imu, _ = _oracle_hour()
    samples = _increments(imu)
    theirs_increments = peer.compute_increments_from_imu(imu, "increment")

    def ours() -> None:
        q, v, lla = _initial(trajectory)
        strapdown.propagate(q, v, lla, samples.dtheta, samples.dv, samples.dt)

    def theirs() -> None:
        peer.Integrator(trajectory.iloc[0]).integrate(theirs_increments)

    us, them = _alternate(ours, theirs)
    speeds = f"{len(samples) / us / 1e6:.1f} M steps/s against {len(samples) / them / 1e6:.2f} M"
    return [Row("strapdown: pyins batch / ours", them / us, at_least=4.0, detail=speeds)]


def ins_at_every_sample() -> list[Row]:
    """The 15-state INS with covariance at every IMU sample over smsfusion's aided INS, the same hour."""
    if not HAS_PEERS:
        return []
    from smsfusion import AidedINS

    trajectory, imu, fixes = _oracle_hour()
    samples, aids = _increments(imu), _fixes(fixes)
    rate, force = samples.dtheta * RATE_HZ, samples.dv * RATE_HZ
    q, v, lla = _initial(trajectory)
    start = np.concatenate([np.zeros(3), v, q, np.zeros(6)])
    # smsfusion navigates on a flat Earth; it gets the fixes in metres about the start, for the same number of updates
    local = np.array([position_difference_n(s.lat, s.lon, s.h, *lla) for s in aids if isinstance(s, GnssSample)])
    variance = np.full(3, GNSS_SIGMA**2)

    def ours() -> None:
        FusionHorizon(_aligned(trajectory)).push(samples, aids)

    def theirs() -> None:
        accel = {"N": ACCEL_NOISE, "B": 0.05, "tau_cb": 1e4}
        gyro = {"N": GYRO_NOISE, "B": 3e-4, "tau_cb": 1e4}
        aided = AidedINS(RATE_HZ, start, np.eye(15) * 1e-2, accel, gyro, ignore_bias_acc=False, cold_start=False)
        for k in range(len(rate)):
            second, rest = divmod(k + 1, RATE_HZ)
            if rest == 0 and second <= len(local):
                aided.update(force[k], rate[k], pos=local[second - 1], pos_var=variance)
            else:
                aided.update(force[k], rate[k])

    us, them = _alternate(ours, theirs, 3)
    speeds = f"{len(rate) / us / 1e3:.0f} k samples/s against {len(rate) / them / 1e3:.1f} k"
    return [Row("15-state INS: smsfusion / ours", them / us, at_least=10.0, detail=speeds)]


def accuracy() -> list[Row]:
    """Errors in the last half hour over those of pyins' feedback filter on the same increments and fixes.

    Both filters start at the truth, told the true error levels; the largest of six RMS ratios (N, E, D, roll, pitch,
    heading).
    """
    if not HAS_PEERS:
        return []
    from pyins import filters, measurements, strapdown, transform
    from pyins.inertial_sensor import EstimationModel

    trajectory, imu, fixes = _oracle_hour()
    half = trajectory.index >= HOUR_S / 2

    ins = FusionHorizon(_aligned(trajectory))
    times = [float(t) for t in trajectory.index[half]]
    _, estimates = ins.track(_increments(imu), _fixes(fixes), times)
    ours = trajectory[half].copy()
    columns = list(ours.columns)
    ours[:] = [
        [e.lat / DEG, e.lon / DEG, e.h, *e.v_n, *(euler_from_quat(e.q_nb) / DEG)] for e in estimates
    ]  # as pyins orders them

    theirs = filters.run_feedback_filter(
        trajectory.iloc[0], 1.0, 0.5, 2.0, 2.0,
        strapdown.compute_increments_from_imu(imu, "increment"),
        EstimationModel(bias_sd=60 * DEG / 3600, noise=GYRO_NOISE, bias_walk=GYRO_WALK),
        EstimationModel(bias_sd=0.06, noise=ACCEL_NOISE, bias_walk=ACCEL_WALK),
        [measurements.Position(fixes, GNSS_SIGMA)],
        time_step=1.0,  # the longest that pyins recommends; with its 0.1 s it takes minutes
    ).trajectory  # fmt: skip

    def rms(estimated: Any) -> Array:
        error = transform.compute_state_difference(estimated.loc[ours.index, columns], trajectory.loc[ours.index])
        found: Array = np.sqrt((error**2).mean())[["north", "east", "down", "roll", "pitch", "heading"]].to_numpy()
        return found

    us, them = rms(ours), rms(theirs)
    detail = f"{' '.join(f'{x:.3g}' for x in us)} against {' '.join(f'{x:.3g}' for x in them)} (m, deg)"
    return [Row("error on the oracle hour: ours / pyins", float(max(us / them)), at_most=1.05, detail=detail)]


def campaign_efficiency() -> list[Row]:
    """Wall time of a campaign of the main scenario with two estimators, on one worker over twice that on two."""
    from testbed.many.campaign import campaign

    seconds = {}
    for workers in (2, 1):
        with tempfile.TemporaryDirectory() as folder:
            began = time.perf_counter()
            overrides = [TWO_ESTIMATORS, "expect={}"]
            campaign(MAIN, CAMPAIGN_RUNS, overrides=overrides, out=Path(folder), workers=workers)
            seconds[workers] = time.perf_counter() - began
    detail = f"{CAMPAIGN_RUNS} runs: {seconds[1]:.0f} s on one worker, {seconds[2]:.0f} s on two"
    return [Row("campaign: parallel efficiency", seconds[1] / (2 * seconds[2]), "", at_least=0.85, detail=detail)]


def ahrs_batch() -> list[Row]:
    """The attitude filter through increments in one block, levelling once a second; the fastest of the rounds."""
    samples = _rest()

    def ours() -> None:
        ahrs = Ahrs(AhrsConfig(_unit(), START[0] * DEG))
        ahrs.start(0.0, LEVEL)
        ahrs.propagate(samples)

    ours()
    rate = len(samples) / min(_seconds(ours) for _ in range(ROUNDS)) / 1e6
    rows = [Row("AHRS in a batch", rate, "M updates/s", at_least=1.5)]
    if not HAS_PEERS:
        return rows
    from vqf import VQF

    rates, forces = samples.dtheta / samples.dt[:, None], samples.dv / samples.dt[:, None]

    def theirs() -> None:
        VQF(float(samples.dt[0])).updateBatch(rates, forces)

    us, them = _alternate(ours, theirs)
    speeds = f"{len(samples) / us / 1e6:.1f} M updates/s against {len(samples) / them / 1e6:.1f} M"
    return [*rows, Row("AHRS: vqf / ours", them / us, at_least=1.0, detail=speeds)]


def federated() -> list[Row]:
    """Three local filters of 15 states, each with a receiver, over one INS of 15 states with one."""
    samples, names = _rest(), ("gnss", "second", "third")
    initial = InitialState(0.0, *_site(), np.zeros(3), LEVEL, np.diag(np.repeat([2 * DEG, 0.5, 1.0], 3) ** 2))
    receivers = [_still_fixes(name) for name in names]
    every = [fix for second in zip(*receivers, strict=True) for fix in second]

    def one() -> None:
        ins = Ins(InsConfig(_unit(), aids=("gnss",)))
        ins.start(initial)
        FusionHorizon(ins).push(samples, receivers[0])

    def three() -> None:
        filters = tuple(Local(name, (Watched(GnssAid(name)),)) for name in names)
        fused = Federated(Config(_unit(), filters))
        fused.start(initial)
        FusionHorizon(fused).push(samples, every)

    us, them = _alternate(three, one)
    detail = f"{us / REST_S * 1e6:.0f} us over {them / REST_S * 1e6:.0f} us per second of flight, fixes at 1 Hz"
    return [Row("federated, three local filters / one INS", us / them, at_most=4.0, detail=detail)]


def unscented_period() -> list[Row]:
    """Periods of 15 states by sigma points, each with six rows of GNSS, over the strapdown of the same time.

    The integrals over the way that the transition is made of, of a linear filter too, are on neither side. What they
    would add to the filter's at 10 Hz is a row without a bound.
    """
    samples, model, scaling = _rest(), ErrorModel(_unit()), unscented.Scaling()
    P = np.diag(np.repeat([0.1, 0.5, 3.0, 2e-4, 0.02], 3) ** 2)
    H = np.zeros((6, len(P)))
    H[:3, POS : POS + 3] = H[3:, VEL : VEL + 3] = np.eye(3)
    force = np.eye(3) * np.array([1.0, 0.1, -9.8])[:, None, None]  # C_nb, and it times rates and specific forces
    work, R = unscented.scratch(len(P)), np.array([1.0] * 3 + [0.01] * 3)

    def linear() -> None:
        strapdown.propagate(LEVEL.copy(), np.zeros(3), np.array(_site()), samples.dtheta, samples.dv, samples.dt)

    rows = []
    for rate in (1, 10):
        count, T = int(REST_S * rate), 1 / rate

        def ours(count: int = count, T: float = T) -> None:
            _unscented_periods(
                count, T, P, work, LEVEL.copy(), np.zeros(3), np.array(_site()), model.driven, force * T, H, R,
                scaling.spread, scaling.excess,
            )  # fmt: skip

        us, them = _alternate(ours, linear)
        period, steps = us / count * 1e6, REST_HZ // rate
        detail = f"{period:.2f} us per period over {them / count * 1e6:.2f} us for {steps} steps"
        rows.append(Row(f"UKF at {rate} Hz / strapdown beside it", us / them, at_most=1.0, detail=detail))
    sums = np.zeros((3, 3, 3))
    integrals, them = _alternate(lambda: _integrals(sums, LEVEL, samples.dtheta, samples.dv, samples.dt), linear)
    return [*rows, Row("the same and the integrals for its transition", (us + integrals) / them)]


@njit
def _integrals(sums: Array, q_nb: Array, dtheta: Array, dv: Array, dt: Array) -> None:
    """The integrals of `error_model.transition` over N intervals."""
    for k in range(len(dt)):
        integrate(sums, q_nb, q_nb, dtheta[k], dv[k], dt[k])


@njit
def _unscented_periods(
    count: int, T: float, P0: Array, work: Array, q_nb: Array, v_n: Array, lla: Array, driven: Indices, sums: Array,
    H: Array, R: Array, spread: float, excess: float,
) -> None:  # fmt: skip
    """``count`` periods of ``T`` seconds, each from the same covariance."""
    n = len(P0)
    P = P0.copy()
    Phi, FT, x = np.zeros((9, n)), np.zeros((9, n)), np.zeros(n)
    decay, half, push = np.ones(n), np.full(n, 1e-12), sums[2].sum(axis=1)
    Z, z = np.zeros((7, len(R))), np.zeros(len(R))
    root, points = np.empty((3, n)), np.empty((7, unscented.FURTHER + n))
    covariance, start = P.ravel(), P0.ravel()
    for _ in range(count):
        for i in range(len(start)):
            covariance[i] = start[i]
        transition(Phi, FT, driven, v_n, lla[0], lla[2], sums, T)
        unscented.remove(q_nb, v_n, lla, x, unscented.predict(P, Phi, decay, half, work, push, T, spread, excess))
        unscented.factor_into(root, P)
        unscented.points_into(points, q_nb, v_n, lla, x, root, spread)
        for k in range(7):
            for i in range(3):
                Z[k, 3 + i] = points[k, 4 + i] - v_n[i]
            Z[k, 0] = (points[k, 7] - lla[0]) * EARTH_RADIUS
            Z[k, 1] = (points[k, 8] - lla[1]) * EARTH_RADIUS
            Z[k, 2] = lla[2] - points[k, 9]
        _, _, W, _ = unscented.innovate(P, Z, z, R, root, H, work, spread, excess)
        unscented.remove(q_nb, v_n, lla, x, unscented.correct(P, W, work))


def live() -> list[Row]:
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
    scenario = Scenario.load(MAIN, [f"duration_s={LIVE_S}", "sensors.gnss.denied=[]", "expect={}", TWO_ESTIMATORS])
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
    share = 100 * timed.seconds / LIVE_S
    detail = f"{LIVE_S} s at 200 Hz, four streams, {os.getloadavg()[0]:.1f} processes running on {os.cpu_count()} cores"
    return [
        Row("live: missed deadlines", found["run.missed_percent"], "%", at_most=0.1, detail=detail),
        Row("live: jitter, 99 % within", 1e3 * found["run.jitter_p99_s"], "ms", at_most=5.0),
        Row("live: streaming", share, "% of a core", at_most=5.0),
    ]


class _Timed:
    """A publisher, and the processor time that it takes."""

    def __init__(self, publisher: loop.Publisher) -> None:
        self.period_s, self.asks = publisher.period_s, publisher.asks
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


def start_up() -> list[Row]:
    """Cold compile of every kernel, and the time from process start to the first tick when they are compiled."""
    script = (
        "import time; from testbed import Scenario, run\n"
        "first = []\n"
        "def tick(p):\n"
        "    first or first.append(time.time())\n"
        f"run(Scenario.load('{MAIN}', ['duration_s=20', 'sensors.gnss.denied=[]']), progress=tick)\n"
        "print(first[0])\n"
    )
    with tempfile.TemporaryDirectory() as cache:
        cold, _ = _process(script, {"NUMBA_CACHE_DIR": cache})
        warm = [_process(script, {"NUMBA_CACHE_DIR": cache}) for _ in range(3)]
    return [
        Row("cold JIT compile", cold - median(total for total, _ in warm), "s", at_most=15.0),
        Row("second start to first tick", median(first for _, first in warm), "s", at_most=3.0),
    ]


def _process(script: str, environment: dict[str, str]) -> tuple[float, float]:
    """Wall seconds of a fresh interpreter, in all and until the moment that it prints."""
    began = time.time()
    done = subprocess.run(
        [sys.executable, "-c", script], env=os.environ | environment, capture_output=True, text=True, check=True
    )
    return time.time() - began, float(done.stdout) - began


def growth() -> list[tuple[str, float, float, float]]:
    """What a run costs as it grows: (case, wall seconds, seconds per simulated hour, peak memory MiB)."""
    of_any_length = ["sensors.gnss.denied=[[200, 400]]", "expect={}"]
    base = [*of_any_length, "duration_s=600"]
    many = ", ".join(f"{{name='ins{k}', aids=['gnss', 'barometer', 'magnetometer', 'airspeed']}}" for k in range(4))
    cases = {
        "600 s": (base, 600),
        "1200 s": ([*of_any_length, "duration_s=1200"], 1200),
        "2400 s": ([*of_any_length, "duration_s=2400"], 2400),
        "600 s, IMU at 100 Hz": ([*base, "sensors.imu.rate_hz=100"], 600),
        "600 s, GNSS and barometer at 20 Hz": ([*base, "sensors.gnss.rate_hz=20", "sensors.barometer.rate_hz=20"], 600),
        "600 s, 1 estimator": ([*base, "estimator=[{name='ins', aids=['gnss']}]"], 600),
        "600 s, 4 estimators": ([*base, f"estimator=[{many}]"], 600),
    }
    rows = []
    for case, (overrides, duration) in cases.items():
        script = (
            "import re, tempfile, time; from pathlib import Path; from testbed import Scenario, run\n"
            f"run(Scenario.load('{MAIN}', ['duration_s=20', 'sensors.gnss.denied=[]', 'expect={{}}']))  # imports\n"
            f"scenario = Scenario.load('{MAIN}', {overrides!r})\n"
            "with tempfile.TemporaryDirectory() as folder:\n"
            "    began = time.perf_counter(); run(scenario, out=Path(folder)); wall = time.perf_counter() - began\n"
            # not getrusage, whose maximum is that of the process which started this one, if that was larger
            "print(wall, int(re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())[1]) / 1024)\n"
        )
        out = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
        wall, memory = map(float, out.split())
        rows.append((case, wall, wall * 3600 / duration, memory))
    return rows


@cache
def _rest() -> ImuSamples:
    """Noisy increments of a body that lies still."""
    rng, n = np.random.default_rng(1), round(REST_S * REST_HZ)
    dtheta = GYRO_NOISE / np.sqrt(REST_HZ) * rng.normal(size=(n, 3))
    dv = ACCEL_NOISE / np.sqrt(REST_HZ) * rng.normal(size=(n, 3))
    dv[:, 2] -= gravity(_site()[0], START[2]) / REST_HZ
    return ImuSamples(np.arange(1, n + 1) / REST_HZ, np.full(n, 1 / REST_HZ), dtheta, dv)


def _still_fixes(sensor: str) -> list[Sample]:
    """A fix of the body that lies still in every second but the last."""
    rng, (lat, lon, h) = np.random.default_rng(2), _site()
    sigma_p, sigma_v = np.full(3, GNSS_SIGMA), np.full(3, 0.1)
    return [
        GnssSample(t, t, lat, lon, h, 0.1 * rng.normal(size=3), sigma_p, sigma_v, FixType.FIX_3D, 12, hdop=1.0,
                   vdop=1.0, sensor=sensor)
        for t in np.arange(1.0, REST_S).tolist()
    ]  # fmt: skip


def _site() -> tuple[float, float, float]:
    return START[0] * DEG, START[1] * DEG, START[2]


def _unit() -> ImuModel:
    """The filters' model of that IMU."""
    return ImuModel(GYRO_NOISE, ACCEL_NOISE, 60 * DEG / 3600, 0.06, GYRO_WALK, ACCEL_WALK)


@cache
def _oracle_hour() -> tuple[Any, Any, Any]:
    """Trajectory, increments with errors and GNSS fixes of the hour, from pyins' own simulator, as its frames."""
    from pyins import inertial_sensor, sim

    dt = 1 / RATE_HZ
    trajectory, imu = sim.generate_sine_velocity_motion(
        dt, HOUR_S + dt, list(START), [25.0, 15.0, 0.0], [8.0, 8.0, 0.5], 60, sensor_type="increment"
    )
    gyro = inertial_sensor.Parameters(bias=GYRO_BIAS, noise=GYRO_NOISE, bias_walk=GYRO_WALK, rng=1)
    accel = inertial_sensor.Parameters(bias=ACCEL_BIAS, noise=ACCEL_NOISE, bias_walk=ACCEL_WALK, rng=2)
    imu = inertial_sensor.apply_imu_parameters(imu, "increment", gyro, accel)
    legacy = np.random.RandomState(3)  # the kind that pyins takes
    fixes = sim.generate_position_measurements(trajectory.iloc[::RATE_HZ].iloc[1:], GNSS_SIGMA, legacy)
    return trajectory, imu, fixes


def _increments(imu: Any) -> ImuSamples:
    """The hour's increments as samples; the first row ends at time zero and is left out."""
    t = np.array(imu.index)[1:]
    columns = [np.array(imu[[f"{name}_{axis}" for axis in "xyz"]], order="C")[1:] for name in IMU_COLUMNS]
    return ImuSamples(t, np.full(len(t), 1 / RATE_HZ), columns[0], columns[1])


def _fixes(fixes: Any) -> list[Sample]:
    """The hour's fixes as samples: position only."""
    sigma, unknown = np.full(3, GNSS_SIGMA), np.full(3, np.nan)
    return [
        GnssSample(t, t, lat * DEG, lon * DEG, alt, unknown, sigma, unknown, FixType.FIX_3D, 12, hdop=1.0, vdop=1.0)
        for t, (lat, lon, alt) in zip(fixes.index, fixes[["lat", "lon", "alt"]].to_numpy(), strict=True)
    ]


def _initial(trajectory: Any) -> tuple[Array, Array, Array]:
    """Attitude, velocity and position at the start of the hour."""
    first = trajectory.iloc[0]
    return (
        quat_from_euler(first.roll * DEG, first.pitch * DEG, first.heading * DEG),
        np.array(first[["VN", "VE", "VD"]], dtype=float),  # a copy: what a frame gives can't be written to
        np.array([first.lat * DEG, first.lon * DEG, first.alt]),
    )


def _aligned(trajectory: Any) -> Ins:
    """A 15-state INS told the true error levels, at the start of the hour."""
    ins = Ins(InsConfig(_unit(), aids=("gnss",), covariance_period=1, gnss_use_velocity=False))
    q, v, lla = _initial(trajectory)
    covariance = np.diag(np.repeat([2 * DEG, 0.5, 1.0], 3) ** 2)
    ins.start(InitialState(0.0, lla[0], lla[1], lla[2], v, q, covariance))
    return ins


def main() -> list[str]:
    """Measure and print everything; returns the names of the figures that missed their bound."""
    console = Console()
    rows: list[Row] = []
    for measure in (
        whole_run, strapdown_alone, ins_at_every_sample, accuracy, ahrs_batch, federated, unscented_period, live,
        start_up, campaign_efficiency,
    ):  # fmt: skip
        with console.status((measure.__doc__ or "").partition("\n")[0]):
            rows += measure()
    table = Table("figure", "value", "bound", "", "detail", title="Speed")
    for row in rows:
        bound = f"<= {row.at_most:g}" if row.at_most is not None else f">= {row.at_least:g}"
        verdict = "[green]kept[/]" if row.kept else "[red]MISSED[/]"
        table.add_row(row.what, f"{row.value:.2f} {row.unit}", bound, verdict, row.detail)
    console.print(table)
    costs = Table("run", "wall s", "s per simulated hour", "peak MiB", title="How the cost of a run grows")
    with console.status("runs of growing size"):
        for case, wall, hourly, memory in growth():
            costs.add_row(case, f"{wall:.2f}", f"{hourly:.2f}", f"{memory:.0f}")
    console.print(costs)
    if not HAS_PEERS:
        console.print("The peers are not installed: `make bench` installs them and compares.")
    return [row.what for row in rows if not row.kept]


if __name__ == "__main__":
    missed = main()
    if missed:
        sys.exit(f"bench: bound missed by {', '.join(missed)}")
