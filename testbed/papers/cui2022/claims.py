"""What Cui et al. 2022 claim of detection, accuracy and false alarms, judged over all draws."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from nav.samples import Array
from testbed.papers import scenario
from testbed.papers.bounds import TOLD as TOLD_TEST
from testbed.papers.bounds import told_test
from testbed.papers.cui2022.flight import FALSE_ALARM, GLR, NAME, QUANTITIES, TOLD, WITH_STAR, WITHOUT_STAR, Draw, Flown
from testbed.score.claims import HARDLY_ANY, NEARLY_ALL, SHARE, Claim, Floor

AXES = {
    "position": ("north", "east", "down"),
    "velocity": ("north", "east", "down"),
    "attitude": ("roll", "pitch", "heading"),
}
UNITS = {"position": "m", "velocity": "m/s", "attitude": "arcsec"}
REQUIRED = {"position": 10.0, "velocity": 0.5, "attitude": 50.0}  # by the paper, of every axis
FIGURES = {"position": (10.0, 10.0, 10.0), "velocity": (0.5, 0.1, 0.2), "attitude": (50.0, 10.0, 5.0)}  # in its figures
NO_WORSE = 1.25  # than the optimal filter
SIX, NONE = "six faults", "no fault"
STEPS = {"longitude": "longitude step", "height": "height step", "doppler_velocity": "Doppler step"}
SLOW = {"latitude": "latitude drift", "north_velocity": "north velocity ramp"}
SMALL = "0.3 m/s east velocity step"
OPTIMAL = "one filter of all sensors that is told of the faults has"


def claims(results: Sequence[Draw]) -> list[Claim]:
    """The paper's, and what else is to be known."""
    return [
        *_detection(results),
        *_accuracy(results),
        *_false_alarms(results),
        *_small_step(results),
        *_beside_the_optimal(results),
    ]


def _of(results: Sequence[Draw], name: str) -> list[Flown]:
    return [result.faulty[name] for result in results]


def _delays(results: Sequence[Draw], name: str, fault: str) -> list[float]:
    scores = [flown.scores[fault].detection for flown in _of(results, name)]
    return [math.inf if score is None or math.isnan(score.delay) else score.delay for score in scores]


def told_delay(name: str) -> float:
    """Median delay [s] of the test that is told of a slow fault, or the small step: one sample of GPS a second."""
    fault = next(one for one in scenario(NAME).fault if one.name == name)
    gps = scenario(NAME).sensors["gps"]
    tau = np.arange(fault.window[1] - fault.window[0])
    added = {
        "latitude": getattr(fault, "coefficient", 0.0) * tau**2 / getattr(gps, "horizontal_white_m", 1.0),
        "north_velocity": getattr(fault, "slope", 0.0) * tau / getattr(gps, "horizontal_velocity_white_mps", 1.0),
        "east_velocity": np.full(
            len(tau), getattr(fault, "size", 0.0) / getattr(gps, "horizontal_velocity_white_mps", 1.0)
        ),
    }[name]
    return told_test(added, FALSE_ALARM)[0]


def _detection(results: Sequence[Draw]) -> Iterator[Claim]:
    paper = "no delay"
    for fault, what in STEPS.items():
        yield Claim(f"detection delay, {what}", "s", paper, _delays(results, WITH_STAR, fault), 0.0)
    for name, judge in ((WITH_STAR, "ERAIM"), (GLR, "GLR")):
        for fault, what in (*SLOW.items(), ("east_velocity", SMALL)):
            yield Claim(
                f"detection delay, {what}, {judge}", "s", paper, _delays(results, name, fault), 0.0,
                floor=Floor(told_delay(fault), TOLD_TEST, exact=True),
            )  # fmt: skip
    found = (*STEPS, *SLOW)
    right = [min(float(flown.scores[fault].isolated) for fault in found) for flown in _of(results, WITH_STAR)]
    yield Claim("the right sensor isolated, those five", "", "yes", right, 1.0, at_least=True, statistic=HARDLY_ANY)
    back = [_longest_lag(flown, found) for flown in _of(results, WITH_STAR)]
    yield Claim("in full use again after a fault's end", "s", "", back, 3.0, statistic=NEARLY_ALL)
    kept = [result.kept for result in results]
    yield Claim("sound axes of a partly failed GPS in use", "", "", kept, 0.99, at_least=True, statistic=HARDLY_ANY)


def _longest_lag(flown: Flown, found: Sequence[str]) -> float:
    lags = [score.end_lag for score in (flown.scores[fault].detection for fault in found) if score is not None]
    return max(math.inf if math.isnan(lag) else lag for lag in lags)


def _accuracy(results: Sequence[Draw]) -> Iterator[Claim]:
    """Largest error after a minute, of the median flight by axis; of nearly all flights on any axis."""
    for flights, when in ((_of(results, WITH_STAR), SIX), ([one.healthy[WITH_STAR] for one in results], NONE)):
        for what in QUANTITIES:
            largest = np.array([flown.largest[what] for flown in flights])
            for k, axis in enumerate(AXES[what]):
                label = axis if what == "attitude" else f"{what} {axis}"
                bound = FIGURES[what][k]
                quantity = f"largest error after 60 s, {label}, {when}"
                yield Claim(quantity, UNITS[what], f"{bound:g}", largest[:, k], bound)
            yield Claim(
                f"largest error after 60 s, {what}, any axis, {when}", UNITS[what], f"{REQUIRED[what]:g}",
                largest.max(axis=1), REQUIRED[what], statistic=NEARLY_ALL,
            )  # fmt: skip
        within = [all(np.all(flown.largest[what] < most) for what, most in FIGURES.items()) for flown in flights]
        what = f"flights within every figure of the paper by axis, share, {when}"
        yield Claim(what, "", "1 flight", np.array(within, float), 0.9, at_least=True, statistic=SHARE)
    heading, best = (_headings(results, name) for name in (WITHOUT_STAR, TOLD[WITHOUT_STAR]))
    quantity = "largest error after 60 s, heading, six faults, no star tracker"
    yield Claim(quantity, "arcsec", "50", heading, 50.0, floor=Floor(best, OPTIMAL))


def _headings(results: Sequence[Draw], name: str) -> Array:
    return np.array([flown.largest["attitude"][2] for flown in _of(results, name)])


def _false_alarms(results: Sequence[Draw]) -> Iterator[Claim]:
    sound = [result.healthy[WITH_STAR] for result in results]
    isolated = [float(one.isolated) for one in sound]
    yield Claim("measurements while a sensor was isolated in 1200 s without fault", "", "none", isolated, 0.0)
    refused = [float(one.refused) for one in sound]
    yield Claim("measurements refused in 1200 s without fault", "", "none", refused, 0.0)
    share = [(one.refused, one.measurements) for one in sound]
    yield Claim("measurements refused without fault, share", "", "1e-5", share, FALSE_ALARM, statistic=SHARE)


def _small_step(results: Sequence[Draw]) -> Iterator[Claim]:
    """Of one sigma: hardly ever in one sample, most times in thirty."""
    for name, judge in ((WITH_STAR, "ERAIM"), (GLR, "filters with GLR")):
        seen = [float(math.isfinite(delay)) for delay in _delays(results, name, "east_velocity")]
        what = f"{SMALL} found by {judge}, share of flights"
        yield Claim(what, "", "", seen, 0.5, at_least=True, statistic=SHARE)
    for name, label in (("GLR", "GLR on the innovations"), ("GLR per axis", "GLR on what the fused solution leaves")):
        seen = [float(math.isfinite(result.small_step[name])) for result in results]
        yield Claim(f"{SMALL} found by {label}, share of flights", "", "", seen, 0.5, at_least=True, statistic=SHARE)
        falsely = [float(result.false_alarms[name]) for result in results]
        yield Claim(f"alarms without a fault by {label}, share of flights", "", "", falsely, 0.05, statistic=SHARE)


def _beside_the_optimal(results: Sequence[Draw]) -> Iterator[Claim]:
    for name, best in TOLD.items():
        for what in QUANTITIES:
            largest, least = (
                np.array([flown.largest[what].max() for flown in _of(results, one)]) for one in (name, best)
            )
            label = "" if name == WITH_STAR else ", no star tracker"
            quantity = f"largest error after 60 s, {what}, any axis, six faults{label}, over that of the optimal filter"
            yield Claim(quantity, "", "", largest / least, NO_WORSE)
