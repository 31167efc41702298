"""One draw of the river: every filter with wrong fixes and a log every 30 s, and through an outage with a log at 1 Hz.

Errors are estimate - truth, position and velocity NED, attitude phi, every ten seconds, when a fix is due, and at wrong
fixes. The motion is too slow for an IMU of 200 Hz to tell more than one of 50 Hz, which is what is flown here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from nav.detection import chi_square_threshold
from nav.federated import Federated
from nav.fusion import Weigh, weights_by_covariance
from nav.samples import Array
from nav.weighting import inflation
from testbed.estimators import federated
from testbed.estimators.lane import Lane
from testbed.motion.sections import KinematicTruth
from testbed.motion.segments import Weave
from testbed.papers import flights, scenario
from testbed.papers.draws import world
from testbed.papers.flights import Sensed
from testbed.papers.misprints import (
    inflation_by_newton,
    inflation_upside_down,
    weights_eq13,
    weights_eq13_in_degrees,
)
from testbed.scenario import Scenario

RATE_HZ = 50
SLOW_LOG = "sensors.dvl.rate_hz=0.0333333333333"  # thinned to one value in 30 s
CLEAN = ("fault=[]", 'sensors.ast.distribution="gaussian"', "sensors.ast.horizontal_m=11.547")  # the same R
OUTLIERS = 150.5 + 150.0 * np.arange(23)  # [s]
OUTAGE = (1500.0, 2500.0)
EVERY_S = 10.0
COMMON = 15  # states that the local filters share
LIMIT = chi_square_threshold(0.01, 2)
CASES = 4000
FRKF, TFKF = "frkf", "tfkf"  # with feedback; without, as section 3.2 has it:
FRKF_ALONE, TFKF_ALONE = "frkf_no_reset", "tfkf_no_reset"
DVL, AST = "rkf_dvl", "rkf_ast"
EQ13, EQ13_DEGREES, SHARED, SHARED_ALONE = "eq13", "eq13_degrees", "shared", "shared_no_reset"
WEIGHTS: Mapping[str, Weigh] = {
    "traces": weights_by_covariance, EQ13: weights_eq13, EQ13_DEGREES: weights_eq13_in_degrees,
}  # fmt: skip


class Flown(NamedTuple):
    """One estimator: times (N,) [s], ``error`` (N, 9) [m, m/s, rad]; ``step`` (M, 9), by how many sigma each wrong fix
    moved it.
    """

    t: Array
    error: Array
    step: Array


class Draw(NamedTuple):
    """One draw: each filter by name on the ``river``, in the ``outage``, and on the river without any fault; the weight
    of the transponder's filter at the end of the outage by each of `WEIGHTS`.
    """

    river: Mapping[str, Flown]
    outage: Mapping[str, Flown]
    clean: Mapping[str, Flown]
    weight: Mapping[str, float]


def placed(name: str, seed: int, *overrides: str) -> Scenario:
    """A scenario of the paper, begun where and weaving as `world` has drawn it."""
    here = world(seed, 1)
    motion = scenario(name).truth
    assert isinstance(motion, KinematicTruth)
    (weave,) = motion.segments
    assert isinstance(weave, Weave)
    period = f"truth.segments[0].period_s={weave.period_s * here.stretch[0]!r}"
    rates = f"truth.rate_hz={RATE_HZ}", f"sensors.imu.rate_hz={RATE_HZ}"
    return scenario(name, (*here.start, period, *rates, *overrides))


def fly(seed: int) -> Draw:
    """Every filter on one draw."""
    chosen = placed("zhu2020", seed, SLOW_LOG)
    river = navigate(chosen, seed, flights.lanes(chosen, seed), chosen.duration_s)
    chosen = placed("zhu2020_outage", seed)
    lanes = flights.lanes(chosen, seed) | others(chosen, seed)
    outage = navigate(chosen, seed, lanes, OUTAGE[1])
    sound = placed("zhu2020", seed, SLOW_LOG, *CLEAN)
    both = {name: lane for name, lane in flights.lanes(sound, seed).items() if name in (FRKF, TFKF)}
    clean = navigate(sound, seed, both, sound.duration_s)
    return Draw(river, outage, clean, weights(lanes[FRKF_ALONE]))


def others(chosen: Scenario, seed: int) -> dict[str, Lane]:
    """What no scenario says: scalar weights by equation 13, as printed and in its units; shares by covariance."""
    rig, found = chosen.rig(seed), {}
    sections = {one.name: one for one in chosen.estimator if isinstance(one, federated.FederatedSection)}
    alone = federated.configuration(sections[FRKF_ALONE], rig)
    scalar = replace(alone, sharing="none", combination="scalar")
    for name, told in (
        (EQ13, replace(scalar, weigh=weights_eq13)),
        (EQ13_DEGREES, replace(scalar, weigh=weights_eq13_in_degrees)),
        (SHARED_ALONE, replace(alone, sharing="by_covariance")),
    ):
        found[name] = federated.lane(sections[FRKF_ALONE], rig, told)
    shared = replace(federated.configuration(sections[FRKF], rig), sharing="by_covariance")
    found[SHARED] = federated.lane(sections[FRKF], rig, shared)
    return found


def navigate(chosen: Scenario, seed: int, lanes: Mapping[str, Lane], end_s: float) -> dict[str, Flown]:
    """Each estimator up to ``end_s``, all of them on the same samples and from the same start."""
    sensed, _ = Sensed.of(chosen, seed).with_faults(chosen, seed)
    outliers = OUTLIERS[end_s > OUTLIERS] if chosen.fault else np.empty(0)
    regular = np.arange(EVERY_S, end_s + 0.5, EVERY_S)
    t = np.unique(np.concatenate([regular, outliers, outliers - 1 / RATE_HZ]))
    often, at = np.searchsorted(t, regular), np.searchsorted(t, outliers)
    found = {}
    for name, lane in lanes.items():
        track = flights.track(lane, sensed, t)
        error = track.every
        step = np.abs(error[at] - error[at - 1]) / track.sigma[at]
        found[name] = Flown(regular, error[often], step)
    return found


def weights(lane: Lane) -> dict[str, float]:
    """What the second of two local filters counts for, by each of `WEIGHTS`."""
    estimator = lane.horizon.estimator
    assert isinstance(estimator, Federated)
    P = np.stack([estimator.local(local.name)[1][:COMMON, :COMMON] for local in estimator.config.locals])
    return {name: float(weigh(P, COMMON, np.ones(2))[1]) for name, weigh in WEIGHTS.items()}


def solve(seed: int) -> dict[str, float]:
    """The three forms of the solver on `CASES` random outliers of two axes with H P H' and R of like size."""
    random = np.random.default_rng(seed)
    iterations: dict[str, list[int]] = {"newton": [], "reciprocal": []}
    off, near = 0.0, 0
    while len(iterations["newton"]) < CASES:
        R, half = random.uniform(0.1, 10, 2), random.normal(size=(2, 2))
        HPH, nu = half @ half.T, random.normal(size=2) * 10 ** random.uniform(0, 2)
        if not LIMIT < nu @ np.linalg.solve(HPH + np.diag(R), nu) < 2000 * LIMIT:
            continue
        newton, n = inflation_by_newton(nu, HPH, R, LIMIT)
        root, m = inflation(nu, HPH, R, LIMIT)
        printed, _ = inflation_upside_down(nu, HPH, R, LIMIT)
        iterations["newton"].append(n)
        iterations["reciprocal"].append(m)
        for lam in (newton, root):
            off = max(off, abs(float(nu @ np.linalg.solve(HPH + lam * np.diag(R), nu)) / LIMIT - 1))
        near += abs(printed / root - 1) < 0.01
    return {
        "newton": max(iterations["newton"]),
        "reciprocal": max(iterations["reciprocal"]),
        "off": off,
        "near": near,
    }
