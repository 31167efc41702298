"""Zhu et al. 2020: a federated filter whose local filters inflate R, on a river with wrong transponder fixes.

Each job senses one run with one seed and lets every estimator of its scenario work on the same samples. Errors are
estimate - truth once a second, position and velocity NED, attitude phi.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from nav.detection import chi_square_threshold
from nav.earth import displacements_n
from nav.federated import Federated, weights_by_covariance, weights_eq13
from nav.samples import Array
from nav.weighting import ITERATIONS, inflation
from testbed import estimators, loop, sensors
from testbed.data import write_file
from testbed.metrics import attitude_error
from testbed.papers import Claim, Job, Paper, scenario
from testbed.scenario import Scenario
from testbed.sensors.faults import Faults

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SEEDS = range(1, 11)
SLOW_LOG = ("sensors.dvl.rate_hz=0.0333333333333",)  # thinned to one value in 30 s
CLEAN = ("fault=[]", 'sensors.ast.distribution="gaussian"', "sensors.ast.horizontal_m=11.547")  # the same R
RUNS: Mapping[str, tuple[str, tuple[str, ...]]] = {  # scenario and overrides
    "1 Hz": ("zhu2020", ()),
    "30 s": ("zhu2020", SLOW_LOG),
    "clean": ("zhu2020", CLEAN),
    "outage": ("zhu2020_outage", ()),
}
BLOCK_S = 10.0
OUTLIERS = 150.5 + 150.0 * np.arange(23)  # [s]
OUTAGE = (1500.0, 2500.0)
CONVERGED_S = 600.0  # the paper doesn't say when
COMMON = 15  # states that the local filters share
P_N, P_E, V_N, V_E, HEADING = 0, 1, 3, 4, 8  # columns of errors
LIMIT = chi_square_threshold(0.01, 2)
CASES = 4000


class Flown(NamedTuple):
    """One estimator: ``error`` and ``sigma`` (N, 9) at each second [m, m/s, rad]; ``step`` (M, 9), by how many sigma a
    wrong fix moved the estimate; by block of `BLOCK_S`, the weights (K, 2) of two local filters by the traces of their
    covariances, and as equation 13 has them.
    """

    error: Array
    sigma: Array
    step: Array
    by_trace: Array
    by_eq13: Array


def fly(run: str, seed: int) -> dict[str, Flown]:
    """Every estimator of one of `RUNS`, by name."""
    name, overrides = RUNS[run]
    return _fly(scenario(name, overrides), seed)


def _fly(chosen: Scenario, seed: int) -> dict[str, Flown]:
    rate = round(chosen.truth.rate_hz)
    source = loop.motion(chosen, seed)
    sensed = {
        name: sensors.build(name, config, rate, seed, chosen.site()) for name, config in chosen.sensors.items()
    }
    faults = Faults(chosen.fault, chosen.sensors, seed)
    filters = estimators.build(chosen, seed)
    ticks = round(chosen.duration_s) * rate + 1
    wrong = [round(t * rate) for t in OUTLIERS if t < chosen.duration_s]
    wanted = np.array(sorted({*range(0, ticks, rate), *wrong, *(tick - 1 for tick in wrong)}))
    rows: dict[str, list[tuple[Array, ...]]] = {name: [] for name in filters}
    weights: dict[str, list[Array]] = {name: [] for name in filters}
    for first in range(0, ticks, round(BLOCK_S * rate)):
        truth = source.advance(min(round(BLOCK_S * rate), ticks - first))
        samples: dict[str, Any] = {name: faults.apply(name, one.sense(truth)) for name, one in sensed.items()}
        due = wanted[(wanted >= first) & (wanted < first + len(truth))] - first
        for name, one in filters.items():
            if first == 0 and one.handover is not None:
                one.handover.take_over(truth)
            handed = [sample for aid in one.sensors for sample in samples[aid]]
            _, found = one.horizon.track(one.in_body_axes(samples[one.imu]), handed, truth.t[due].tolist())
            position = [np.array([getattr(e, key) for e in found]) for key in ("lat", "lon", "h")]
            error = np.column_stack(
                [
                    displacements_n(*position, truth.lat[due], truth.lon[due], truth.h[due]),
                    np.array([e.v_n for e in found]) - truth.v_n[due],
                    attitude_error(np.array([e.q_nb for e in found]), truth.q_nb[due]),
                ]
            )
            sigma = np.sqrt([e.covariance.diagonal() for e in found])
            rows[name].append((error, sigma))
            federated = one.horizon.estimator
            assert isinstance(federated, Federated)
            if len(federated.locals) == 2:
                P = np.stack([federated.local(local.name)[1][:COMMON, :COMMON] for local in federated.config.locals])
                weights[name].append(np.array([weigh(P, COMMON, np.ones(2)) for weigh in _WEIGHTS]))
    second = np.flatnonzero(wanted % rate == 0)
    at = np.searchsorted(wanted, wrong)
    flown = {}
    for name, parts in rows.items():
        error, sigma = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        betas = np.array(weights[name]).reshape(-1, 2, 2)
        step = np.abs(error[at] - error[at - 1]) / sigma[at]
        flown[name] = Flown(error[second], sigma[second], step, betas[:, 0], betas[:, 1])
    return flown


_WEIGHTS = (weights_by_covariance, weights_eq13)


def solve(seed: int) -> dict[str, float]:
    """The three forms of the solver on `CASES` random outliers of two axes with H P H' and R of like size."""
    random = np.random.default_rng(seed)
    iterations: dict[str, list[int]] = {"newton": [], "reciprocal": [], "printed": []}
    off, near = 0.0, 0
    while len(iterations["newton"]) < CASES:
        R, half = random.uniform(0.1, 10, 2), random.normal(size=(2, 2))
        HPH, nu = half @ half.T, random.normal(size=2) * 10 ** random.uniform(0, 2)
        if not LIMIT < nu @ np.linalg.solve(HPH + np.diag(R), nu) < 2000 * LIMIT:
            continue
        newton, n = inflation(nu, HPH, R, LIMIT, False, False)
        root, m = inflation(nu, HPH, R, LIMIT, True, False)
        printed, k = inflation(nu, HPH, R, LIMIT, True, True)
        for name, count in (("newton", n), ("reciprocal", m), ("printed", k)):
            iterations[name].append(count)
        for lam in (newton, root):
            off = max(off, abs(float(nu @ np.linalg.solve(HPH + lam * np.diag(R), nu)) / LIMIT - 1))
        near += abs(printed / root - 1) < 0.01
    return {
        "newton": max(iterations["newton"]),
        "reciprocal": max(iterations["reciprocal"]),
        "off": off,
        "near": 100 * near / CASES,
        "unfinished": 100 * float(np.mean(np.array(iterations["printed"]) == ITERATIONS)),
    }


if __name__ == "__main__":
    import sys
    import time

    for run in sys.argv[1].split(","):
        for seed in map(int, sys.argv[2].split(",")):
            start = time.process_time()
            d = fly(run, seed)
            print(run, seed, f"{time.process_time() - start:.1f} s")
            for name, f in d.items():
                e = f.error
                std = e.std(axis=0)[[P_N, P_E, V_N, V_E]]
                rms = np.sqrt(np.mean(e**2, axis=0))[[P_N, P_E, V_N, V_E]]
                late = np.abs(e[600:]).max(axis=0)
                o = e[1500:2501]
                print(f"  {name:10s} std {np.round(std, 4)} rms {np.round(rms, 4)} heading max {np.degrees(late[8]):.3f} level {np.degrees(late[6:8].max()):.4f} pos {late[:2].max():.1f} v {late[3:5].max():.3f} outage {np.abs(o[:, :2]).max(axis=0).round(1)} end {o[-1, :2].round(1)} sig {f.sigma[2500][:2].round(1)} step {f.step[:,[0,1,3,4]].max():.2f} {f.step.max():.2f}")
