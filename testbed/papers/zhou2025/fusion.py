"""The federation of Zhou et al. 2025 on the circuit of ``scenarios/papers/zhou2025.toml``, with its faults and without.

Each draw has its own latitude, heading and length of the legs, and all filters have the same samples. A fault across
the track does more than one along it, where the odometer holds the filter; over all headings north and east are alike.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from nav.samples import Array
from testbed.estimators import federated, registry
from testbed.estimators.federated import FederatedSection
from testbed.estimators.lane import Lane
from testbed.papers import flights, scenario
from testbed.papers.draws import world
from testbed.papers.flights import Flight, KnownFaults, Sensed, Track
from testbed.papers.misprints import weights_by_sum
from testbed.papers.zhou2025.replays import RAMP, STEP, clairvoyant
from testbed.scenario import Scenario
from testbed.score import detection
from testbed.score.claims import MEAN, RATIO_OF_RMS, RMS, SHARE, Claim, Floor
from testbed.sensors.faults import FaultTruth

SIDE_M = 230.0
RECORD_HZ = 2.0
IN_FLIGHT = 1e-6  # false alarms of a sample, as the scenario has it
FKF, IMPROVED, GLR = "fkf", "improved", "glr"  # of the scenario
ALONE, LITERAL, TOLD = "isolation alone", "weights as printed", "told of the faults"
CROSS = "cross-check of position and velocity between filters without reset"
LABELS = {FKF: "traditional", IMPROVED: "SPRT", GLR: "likelihood ratio"}
PRINTED, STEEP, HEALTHY = "ramp as printed", "ramp of 0.1 sigma/s", "healthy"
CASES: Mapping[str, Sequence[str]] = {PRINTED: (), STEEP: ("fault[2].slope=0.1", "fault[3].slope=0.1")}
FLOWN: Mapping[str, Sequence[str]] = {
    PRINTED: (FKF, IMPROVED, GLR, ALONE, TOLD),
    STEEP: (FKF, IMPROVED, GLR, ALONE, CROSS, TOLD),
    HEALTHY: (FKF, IMPROVED, GLR, LITERAL),
}
WRONG = {"gnss_position": KnownFaults([(axis, *window) for axis in (0, 1) for window in (STEP, RAMP)])}


class Flown(NamedTuple):
    """One filter on one flight: RMSE north and east (2,) [m]; mean of the horizontal 1-sigma that it claims [m]; delay
    [s], infinite when never found, and coverage of the step and the ramp on GNSS; samples of GNSS refused without a
    fault, and how many there were; with ``series`` the errors (N, 2) north and east [m].
    """

    rmse: Array
    sigma: float
    delay: tuple[float, float]
    coverage: tuple[float, float]
    refused: tuple[int, int]
    error: Array


def fly(seed: int, series: bool = False) -> dict[str, dict[str, Flown]]:
    """Every filter of every case on one draw, by case and name."""
    drawn = world(seed, 1)
    keys = (*drawn.start, f"truth.segments[2].length_m={SIDE_M * drawn.stretch[0]!r}")
    chosen = scenario("zhou2025", keys)
    healthy = Sensed.of(chosen, seed)
    t = np.arange(0, chosen.duration_s + 0.5 / RECORD_HZ, 1 / RECORD_HZ)
    found: dict[str, dict[str, Flown]] = {case: {} for case in FLOWN}
    faulty = {case: healthy.with_faults(scenario("zhou2025", (*keys, *CASES[case])), seed) for case in CASES}
    for name in FLOWN[HEALTHY]:
        found[HEALTHY][name] = _flown(flights.track(built(chosen, seed, name), healthy, t), [], series)
    for name in FLOWN[STEEP]:  # all of them; both cases are alike until their ramps begin
        flight = Flight(built(chosen, seed, name), faulty[STEEP][0])
        flight.on(t[t < RAMP[0]])
        for case in (case for case in CASES if name in FLOWN[case]):
            sensed, faults = faulty[case]
            fork = flight.fork(sensed)
            fork.on(t[t >= RAMP[0]])
            found[case][name] = _flown(fork.track(), faults, series)
    return found


def built(chosen: Scenario, seed: int, name: str) -> Lane:
    """The estimator of this name, of the scenario or made of one of them."""
    base = name if name in LABELS else FKF if name == TOLD else IMPROVED
    section = next(one for one in chosen.estimator if one.name == base)
    assert isinstance(section, FederatedSection)
    rig = chosen.rig(seed)
    if name == TOLD:
        return flights.told(chosen, seed, section, WRONG)
    if name == LITERAL:
        return federated.lane(section, rig, replace(federated.configuration(section, rig), normalise=weights_by_sum))
    if name == ALONE:
        section = section.model_copy(update={"weighting": "none"})
    elif name == CROSS:
        section = section.model_copy(update={"structure": "no_reset", "cross_check": True})
    return registry.build((section,), rig)[base]


def _flown(track: Track, faults: Sequence[FaultTruth], series: bool) -> Flown:
    looks = track.by_sensor
    scores = {
        fault.name: score.detection for fault, score in zip(faults, detection.score_faults(faults, looks), strict=True)
    }
    step, ramp = scores.get("hard_north"), scores.get("soft_north")
    gnss = looks["gnss"]
    error = track.position[:, :2]
    return Flown(
        rmse=np.sqrt(np.mean(error**2, axis=0)),
        sigma=float(np.mean(track.sigma[:, :2])),
        delay=(_delay(step), _delay(ramp)),
        coverage=(_coverage(step), _coverage(ramp)),
        refused=(int(gnss.alarm.sum()), len(gnss.t)),
        error=error if series else np.empty((0, 2)),
    )


def _delay(score: detection.DetectionScore | None) -> float:
    return math.inf if score is None or math.isnan(score.delay) else score.delay


def _coverage(score: detection.DetectionScore | None) -> float:
    return 0.0 if score is None else score.coverage


class Found:
    """The results, by case and filter."""

    def __init__(self, results: Sequence[Mapping[str, Mapping[str, Flown]]]) -> None:
        self._results = results

    def of(self, case: str, name: str) -> list[Flown]:
        """One filter in every draw."""
        return [result[case][name] for result in self._results]

    def rmse(self, case: str, name: str) -> Array:
        """RMSE (draws, 2) north and east [m]."""
        return np.array([one.rmse for one in self.of(case, name)])

    def pair(self, case: str, name: str, other: str, axis: int) -> Array:
        """RMSE (draws, 2) along one axis of a filter and of another [m]."""
        return np.column_stack([self.rmse(case, one)[:, axis] for one in (name, other)])


def claims(results: Sequence[Mapping[str, Mapping[str, Flown]]]) -> list[Claim]:
    """Table 3, what the weights add to isolation, what they cost, and the detectors in the flown filter."""
    found = Found(results)
    return [*_table_3(found), *_detectors(found), *_misprints(found), *_own(found)]


def _table_3(found: Found) -> Iterator[Claim]:
    for axis, (side, rmse, ratio) in enumerate((("north", 1.0976, 0.553), ("east", 2.2547, 0.644))):
        yield Claim(
            f"{side} RMSE, {PRINTED}, {LABELS[IMPROVED]}", "m", f"{rmse:.3g}", found.rmse(PRINTED, IMPROVED)[:, axis],
            rmse, statistic=RMS,
        )  # fmt: skip
        for case, name in itertools.product((PRINTED, STEEP), (IMPROVED, GLR)):
            yield Claim(
                f"{side} RMSE over the traditional, {case}, {LABELS[name]}", "", f"{ratio:.3g}",
                found.pair(case, name, FKF, axis), ratio, statistic=RATIO_OF_RMS,
            )  # fmt: skip


def _detectors(found: Found) -> Iterator[Claim]:
    """In the flown filter the detector has a sample a second, two axes, and a false alarm in 1e6 samples."""
    improved = found.of(PRINTED, IMPROVED)
    yield Claim("in flight, hard fault: delay", "s", "1.2", [one.delay[0] for one in improved], 1.2)
    covered = [one.coverage[0] for one in improved]
    yield Claim("in flight, hard fault: coverage", "", "0.94", covered, 0.94, at_least=True, statistic=MEAN)
    for case, slope in ((PRINTED, 0.02), (STEEP, 0.1)):
        delay, coverage = clairvoyant(1, slope, 2, IN_FLIGHT)
        why = "the test that is told when and how the fault grows, and of every error but the receiver's, has"
        for name in (IMPROVED, GLR) if case == STEEP else (IMPROVED,):
            flown, what = found.of(case, name), f"in flight, {case}, {LABELS[name]}"
            yield Claim(
                f"{what}: delay", "s", "1.5", [one.delay[1] for one in flown], 1.5, floor=Floor(delay, why, exact=True)
            )  # fmt: skip
            yield Claim(
                f"{what}: coverage", "", "0.96", [one.coverage[1] for one in flown], 0.96, at_least=True,
                statistic=MEAN, floor=Floor(coverage, why, exact=True),
            )  # fmt: skip


def _misprints(found: Found) -> Iterator[Claim]:
    """Weights that add up to one leave each of two sound sensors a half, which doubles its variance."""
    sigma = [one.sigma / two.sigma for one, two in zip(found.of(HEALTHY, LITERAL), found.of(HEALTHY, FKF), strict=True)]
    yield Claim(f"claimed 1-sigma over the traditional, {HEALTHY}, {LITERAL}", "", "", sigma, 1.02, misprint=True)
    for axis, side in enumerate(("north", "east")):
        yield Claim(
            f"{side} RMSE over the traditional, {HEALTHY}, {LITERAL}", "", "", found.pair(HEALTHY, LITERAL, FKF, axis),
            1.02, statistic=RATIO_OF_RMS, misprint=True,
        )  # fmt: skip


def _own(found: Found) -> Iterator[Claim]:
    """What the weights add to leaving out what is condemned, what they cost, and how near that is to the best."""
    for axis, side in enumerate(("north", "east")):
        for case, name, other, bound in (
            (PRINTED, ALONE, FKF, 0.65), (PRINTED, IMPROVED, ALONE, 1.0), (STEEP, IMPROVED, ALONE, 1.0),
            (HEALTHY, IMPROVED, FKF, 1.02), (HEALTHY, GLR, FKF, 1.02),
            (PRINTED, IMPROVED, TOLD, 1.5), (PRINTED, GLR, TOLD, 1.2),
            (STEEP, IMPROVED, TOLD, 1.5), (STEEP, GLR, TOLD, 1.5), (STEEP, CROSS, IMPROVED, 1.0),
        ):  # fmt: skip
            what = f"{side} RMSE over that of {LABELS.get(other, other)}, {case}, {LABELS.get(name, name)}"
            yield Claim(what, "", "", found.pair(case, name, other, axis), bound, statistic=RATIO_OF_RMS)
    covered = [one.coverage[1] for one in found.of(STEEP, CROSS)]
    most = float(np.mean([one.coverage[1] for one in found.of(STEEP, IMPROVED)]))
    what = f"in flight, {STEEP}, {CROSS}: coverage, at least that of {LABELS[IMPROVED]}"
    yield Claim(what, "", "", covered, most, at_least=True, statistic=MEAN)
    for name in (IMPROVED, GLR):
        refused = [one.refused for one in found.of(HEALTHY, name)]
        what = f"in flight without a fault: samples of GNSS refused, {LABELS[name]}"
        yield Claim(what, "", "", refused, IN_FLIGHT, statistic=SHARE)
