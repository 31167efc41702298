"""What the benchmark is to show, judged: a consumer's IMU in 8 m/s of wind that walks by 0.02 m/s per root second."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from nav.samples import Array
from testbed.denied import flight
from testbed.denied.benchmark import Result
from testbed.denied.table import JUDGED_GRADE, Aids
from testbed.score.claims import EXACT, MEDIAN, NEARLY_ALL, RMS_OVER_BOUND, Claim

# By aids, and the time since GNSS was lost [s]: median and 95 % of the horizontal error [m] at most.
ERRORS = {
    ("flow", 120): (8.0, 20.0),
    ("flow", 600): (25.0, 60.0),
    ("terrain", 600): (40.0, 100.0),
    ("terrain", 1800): (40.0, 100.0),
    ("terrain", 3600): (40.0, 100.0),
}
SHARES = {("flow", 1800): 1.0}  # 95 % of the error over the distance flown since, at most [%]
RATIOS = {"air_data": 1.10}  # RMS over the bound, at every time
BEATEN = 0.05  # probability that any figure of a whole table is taken to be below the bound though none is


def claims(result: Result) -> dict[str, list[Claim]]:
    """Goals of which the table has rows, by estimator."""
    return {one.name: list(_claims(result, one.name)) for one in result.plan.contestants}


def _claims(result: Result, estimator: str) -> Iterator[Claim]:
    table = result.plan.table
    for case in table.judged(()):
        own = {mark for aids, mark in ERRORS if aids == case.aids.name and mark <= case.longest_s}
        flown = [one for one in result.outcomes if one.weather == case.weather.name] + list(result.further)
        for mark in sorted({*table.marks_s, *own}):
            lanes = [one.lane((case.aids.name, JUDGED_GRADE, estimator)) for one in flown if one.t[-1] >= mark]
            if lanes:
                then = flight.at(lanes, [mark])
                yield from _of_one(
                    case.aids, mark, *(column[:, 0, 0] for column in (then.horizontal, then.bound, then.distance))
                )
    beaten, judged = below_the_bound(result, estimator)
    if judged:
        quantity = f"figures of the whole table that are below the bound, of {judged}"
        yield Claim(quantity, "", "", [float(beaten)], 0.0, statistic=EXACT)


def _of_one(aids: Aids, after_s: int, error: Array, bound: Array, distance: Array) -> Iterator[Claim]:
    """Goals of one set of aids at one time, judged by errors, bounds and distances flown (draws,) [m]."""
    quantity = f"{aids.title}: horizontal error after {after_s} s"
    if (least := ERRORS.get((aids.name, after_s))) is not None:
        yield Claim(quantity, "m", "", error, least[0], statistic=MEDIAN)
        yield Claim(quantity, "m", "", error, least[1], statistic=NEARLY_ALL)
    if (percent := SHARES.get((aids.name, after_s))) is not None:
        yield Claim(f"{quantity}, of the way flown", "%", "", 100 * error / distance, percent, statistic=NEARLY_ALL)
    if (ratio := RATIOS.get(aids.name)) is not None:
        yield Claim(quantity, "", "", np.column_stack([error, bound]), ratio, statistic=RMS_OVER_BOUND)


def below_the_bound(result: Result, estimator: str) -> tuple[int, int]:
    """How many root mean squares of the table are below the bound more than draws alone explain, and of how many.

    Of n draws of an estimator that is as good as can be, the sum of squared errors over their bound falls below r n at
    most as often as chi-square with n degrees of freedom does, which is what errors along one axis give; the level
    is `BEATEN` for all figures together (Bonferroni).
    """
    from scipy.special import chdtr

    found: list[float] = []
    for weather in {one.weather: one for one in result.outcomes}.values():
        then = result.at(weather.weather)
        lanes = [k for k, lane in enumerate(weather.lanes) if lane[2] == estimator]
        error, bound = then.horizontal[:, lanes], then.bound[:, lanes]
        known = np.isfinite(error).all(axis=0) & np.isfinite(bound).all(axis=0)
        squares = np.sum((error[:, known] / bound[:, known]) ** 2, axis=0)
        found += chdtr(len(error), squares).tolist()
    return sum(p < BEATEN / len(found) for p in found), len(found)
