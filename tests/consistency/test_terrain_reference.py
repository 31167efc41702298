"""Ranges to the ground over relief: the position that they give is as good as its covariance says.

A body whose velocity error is Markov circles over the highest of the hills with the aid alone; all errors are drawn as
the filter is told.
"""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nav.aids.base import OperatingPoint
from nav.aids.terrain import RangefinderAid
from nav.earth import radii
from nav.error_model import MOTION, POS, VEL
from nav.kalman import update
from nav.samples import Outcome, RangeSample
from nav.terrain import Terrain, ground
from testbed import Scenario, run
from testbed.motion.sections import Terrain as Section
from testbed.motion.terrain import of, thinned, uneven
from testbed.score.accuracy import column, errors

LAT, LON, H_M = math.radians(36.58), math.radians(-84.34), 1100.0
RADIUS_M, SPEED, DT, SECONDS = 1500.0, 25.0, 1.0, 900
SIGMA_V, TAU_V, SIGMA_R = 0.5, 300.0, 0.5
TERRAIN, LOCAL = MOTION, MOTION + 1
HILLS = of(Section(file="jacksboro"))
PER_NORTH = 1 / (radii(LAT)[0] + H_M)
PER_EAST = 1 / ((radii(LAT)[1] + H_M) * math.cos(LAT))


def circle(
    seed: int, true: Terrain, known: Terrain, sigma: float, length: float, raised: float = 5.0
) -> tuple[np.ndarray, np.ndarray]:
    """Horizontal errors (n, 2) [m] and NEES (n,) of them."""
    rng = np.random.default_rng(seed)
    aid = RangefinderAid("r", SIGMA_R, 0.0, known, raised, sigma, length / SPEED)
    state = SimpleNamespace(q_nb=np.array([1.0, 0.0, 0.0, 0.0]), lla=np.zeros(3), v_n=np.zeros(3))
    P = np.zeros((MOTION + 2, MOTION + 2))
    P[[POS, POS + 1], [POS, POS + 1]], P[[VEL, VEL + 1], [VEL, VEL + 1]] = 25.0, SIGMA_V**2
    P[TERRAIN, TERRAIN], P[LOCAL, LOCAL] = raised**2, sigma**2
    x, offset, velocity = np.zeros(len(P)), 5 * rng.standard_normal(2), SIGMA_V * rng.standard_normal(2)
    higher, phase = raised * rng.standard_normal(), rng.uniform(0, 2 * math.pi)
    back, back_local = math.exp(-DT / TAU_V), math.exp(-DT * SPEED / length)
    Phi = np.eye(len(P))
    Phi[[POS, POS + 1], [VEL, VEL + 1]], Phi[[VEL, VEL + 1], [VEL, VEL + 1]], Phi[LOCAL, LOCAL] = DT, back, back_local
    Q = np.zeros_like(P)
    Q[[VEL, VEL + 1], [VEL, VEL + 1]] = SIGMA_V**2 * (1 - back**2)
    Q[LOCAL, LOCAL] = sigma**2 * (1 - back_local**2)
    off_by, nees = [], []
    for k in range(round(SECONDS / DT)):
        offset = offset + velocity * DT
        velocity = back * velocity + SIGMA_V * math.sqrt(1 - back**2) * rng.standard_normal(2)
        P, x = Phi @ P @ Phi.T + Q, Phi @ x  # x is what is estimated of the errors, taken off where it is used
        angle = phase + SPEED * DT * k / RADIUS_M
        place = RADIUS_M * np.array([math.cos(angle), math.sin(angle)])
        here = ground(LAT + place[0] * PER_NORTH, LON + place[1] * PER_EAST, true.heights, true.grid)[0]
        measured = H_M - here - higher + SIGMA_R * rng.standard_normal()
        believed = place + offset + x[POS : POS + 2]
        state.lla[:] = LAT + believed[0] * PER_NORTH, LON + believed[1] * PER_EAST, H_M
        at: Any = OperatingPoint(None, state, x, (TERRAIN, LOCAL, -1), P)  # type: ignore[arg-type]
        found = aid.measure("range", RangeSample(0.0, 0.0, measured, "r"), at)
        assert found is not None
        update(x, P, found.H, found.R, found.nu, 10.8)
        off_by.append(offset + x[POS : POS + 2])
        nees.append(off_by[-1] @ np.linalg.solve(P[POS : POS + 2, POS : POS + 2], off_by[-1]))
    return np.array(off_by), np.array(nees)


def circles(runs: int, sigma: float, length: float = 200.0, every: int = 1) -> tuple[float, float, float]:
    """Median and 95 % of the error [m], mean NEES per degree of freedom, after the first minute."""
    known, between = thinned(HILLS, every)
    apart, nees = [], []
    for seed in range(runs):
        true = uneven(HILLS, sigma, length, np.random.default_rng(seed))
        off, normalised = circle(seed, true, known, math.hypot(sigma, between), length)
        apart.append(np.hypot(*off[60:].T))
        nees.append(normalised[60:])
    return float(np.median(apart)), float(np.percentile(apart, 95)), float(np.mean(nees)) / 2


@pytest.mark.ci
def test_a_map_with_errors_is_not_believed_more_than_it_deserves() -> None:
    median, worst, nees = circles(4, 4.0)
    assert median < 20
    assert worst < 50
    assert nees < 2.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sigma", "length", "every", "limit"),
    [(0.0, 200.0, 1, 2.0), (1.0, 200.0, 1, 8.0), (4.0, 200.0, 1, 20.0), (4.0, 1000.0, 1, 20.0), (2.0, 200.0, 3, 50.0)],
)
def test_what_errors_of_the_map_do(sigma: float, length: float, every: int, limit: float) -> None:
    """Errors of a metre or of four, alike over 200 m or a kilometre, and a map of 9 arc-seconds.

    What is between the points of a coarse one is larger on steep ground, so its NEES is above one.
    """
    median, worst, nees = circles(20, sigma, length, every)
    print(f"{sigma:g} m over {length:g} m, every {every}: median {median:.1f} m, 95 % {worst:.1f} m, NEES {nees:.2f}")
    assert median < limit
    assert 0.3 < nees < (1.2 if every == 1 else 2.0)


@pytest.mark.ci
@pytest.mark.parametrize("fault", ['kind="step", size=60', 'kind="stuck"'])
def test_a_broken_rangefinder_leads_nobody_astray(fault: str) -> None:
    """The shape of the ground tells the place in spite of a step; what is stuck is coasted through, as wide as claimed.

    Before, both went kilometres off within ten minutes and claimed tens of metres.
    """
    changes = [
        "duration_s=1100",
        "expect={}",
        'estimator=[{name="ins", aids=["gnss", "barometer", "magnetometer", "airspeed", "rangefinder"]}]',
        f'fault=[{{sensor="rangefinder", channel="range", window=[500, 1100], {fault}}}]',
    ]
    dataset = run(Scenario.load("denied_terrain", changes), seed=11).dataset
    e, since = errors(dataset, "ins"), 540
    outcome = column(dataset, "estimators/ins/innovations/range/outcome")
    late = column(dataset, "estimators/ins/innovations/range/sample_time") > since
    assert (outcome[late] == Outcome.ISOLATED).mean() == (1.0 if "stuck" in fault else 0.0)
    since = e.t > since
    off, claimed = np.hypot(*e.position[since, :2].T), np.hypot(*e.sigma_position[since, :2].T)
    print(f"median {np.median(off):.0f} m, over the claimed {np.median(off / claimed):.1f}")
    assert np.median(off / claimed) < 3
    assert "stuck" in fault or np.median(off) < 60
    assert off.max() < 800


@pytest.mark.ci
def test_ranges_refused_beside_fixes_put_nothing_in_doubt() -> None:
    """A sensor that was off before the outage is given the ten seconds after it, too."""
    changes = [
        "duration_s=350",
        "expect={}",
        "sensors.gnss.denied=[[300, 350]]",
        'estimator=[{name="ins", aids=["gnss", "barometer", "magnetometer", "airspeed", "rangefinder"]}]',
        'fault=[{sensor="rangefinder", channel="range", window=[200, 350], kind="step", size=60}]',
    ]
    e = errors(run(Scenario.load("denied_terrain", changes), seed=11).dataset, "ins")
    claimed = np.hypot(*e.sigma_position[:, :2].T)
    assert claimed[(e.t > 300) & (e.t < 309)].max() < 10
    assert claimed[(e.t > 313) & (e.t < 320)].max() > 100


@pytest.mark.slow
def test_the_shipped_flight_knows_how_good_it_is() -> None:
    """Four seeds, ten minutes without GNSS each, over the same hills lap by lap."""
    changes = [
        "duration_s=900",
        "expect={}",
        'estimator=[{name="ins", aids=["gnss", "barometer", "magnetometer", \
"airspeed", "rangefinder"]}]',
    ]
    metrics = [run(Scenario.load("denied_terrain", changes), seed=seed).metrics for seed in range(4)]
    nees = np.mean([one["ins.outage_position_nees_mean"] for one in metrics])
    print(f"NEES per degree of freedom {nees:.2f}")
    assert 0.3 < nees < 2.5
    assert max(one["ins.outage_position_horizontal_max_m"] for one in metrics) < 150
