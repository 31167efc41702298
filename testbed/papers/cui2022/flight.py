"""One draw of the flight of Cui et al. 2022: with the six faults of table 2, and without any.

It carries the federation with and without star tracker, judged by ERAIM, and one with it that is judged by the GLR. How
near one can come is measured as well: with a single Kalman filter of all sensors and the same states, which is told of
the faults. Latitude, heading, and for how long it flies straight and accelerates are drawn; a fault is as many metres
everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from nav.detection import Glr
from nav.samples import Array
from testbed.estimators.federated import FederatedSection
from testbed.papers import flights, scenario
from testbed.papers.draws import world
from testbed.papers.flights import KnownFaults, Looks, Sensed, Track
from testbed.scenario import Scenario
from testbed.score import accuracy, detection
from testbed.score.detection import FaultScore
from testbed.sensors.faults import FaultTruth

NAME = "cui2022"
FALSE_ALARM = 1e-5  # per measurement: table 1
AFTER_S = 60.0
LEG_S = 100.0  # the first two
ARCSEC_PER_RAD = 180 * 3600 / np.pi
WITH_STAR, WITHOUT_STAR, GLR = "with_star", "without_star", "glr"
TOLD = {name: f"{name}, told of the faults" for name in (WITH_STAR, WITHOUT_STAR)}
QUANTITIES = ("position", "velocity", "attitude")
PARTS = ("gnss_position", "gnss_velocity", "body_velocity", "star_attitude")
CHANNELS = {"north": ("gnss_position", 0), "east": ("gnss_position", 1), "down": ("gnss_position", 2),
            "v_north": ("gnss_velocity", 0), "v_east": ("gnss_velocity", 1),
            "forward": ("body_velocity", 0)}  # fmt: skip


class Flown(NamedTuple):
    """One filter on one flight: the largest error of each axis after a minute by quantity [m, m/s, arcsec]; by fault
    how it was detected; measurements with an axis refused, with an axis isolated, and all.
    """

    largest: Mapping[str, Array]
    scores: Mapping[str, FaultScore]
    refused: int
    isolated: int
    measurements: int


class Draw(NamedTuple):
    """One draw: ``faulty`` and ``healthy`` by filter; share of the two sound axes of GPS position that were used while
    the third was refused; by what it was looked for, whether and when [s] the small step was found in residuals, and
    whether the same finds one in residuals without a fault; what the figure shows, or nothing.
    """

    faulty: Mapping[str, Flown]
    healthy: Mapping[str, Flown]
    kept: float
    small_step: Mapping[str, float]
    false_alarms: Mapping[str, bool]
    series: Mapping[str, Any]


def fly(seed: int, series: bool = False) -> Draw:
    """Every filter on one draw."""
    chosen = drawn(seed)
    healthy = Sensed.of(chosen, seed)
    faulty, faults = healthy.with_faults(chosen, seed)
    t = np.arange(0.0, chosen.duration_s + 0.5)
    tracks = {name: flights.track(lane, faulty, t) for name, lane in flights.lanes(chosen, seed).items()}
    for name, other in TOLD.items():
        section = next(one for one in chosen.estimator if one.name == name)
        assert isinstance(section, FederatedSection)
        tracks[other] = flights.track(flights.told(chosen, seed, section, known(chosen)), faulty, t)
    sound = flights.track(flights.lanes(chosen, seed)[WITH_STAR], healthy, t)
    step = next(fault for fault in faults if fault.name == "east_velocity")
    looked = residuals(tracks[WITH_STAR], faulty), residuals(sound, healthy)
    return Draw(
        {name: flown(track, faults) for name, track in tracks.items()},
        {WITH_STAR: flown(sound, [])},
        _kept(tracks[WITH_STAR], faults),
        {name: _first_alarm(*made, (step.start, step.end)) for name, made in looked[0].items()},
        {name: bool(watched(*made)[0].any()) for name, made in looked[1].items()},
        _series(tracks, faults, looked[0]["GLR"]) if series else {},
    )


def drawn(seed: int) -> Scenario:
    """The scenario of one draw."""
    here = world(seed, 2)
    legs = [f"truth.segments[{k}].duration_s={LEG_S * factor!r}" for k, factor in enumerate(here.stretch)]
    return scenario(NAME, (*here.start, *legs))


def known(chosen: Scenario) -> dict[str, KnownFaults]:
    """What is wrong with the samples of a scenario, by aid."""
    wrong: dict[str, list[tuple[int, float, float]]] = {}
    for fault in chosen.fault:
        part, axis = CHANNELS[fault.channel]  # type: ignore[union-attr, index]
        wrong.setdefault(part, []).append((axis, *fault.window))
    return {part: KnownFaults(windows) for part, windows in wrong.items()}


def flown(track: Track, faults: Sequence[FaultTruth]) -> Flown:
    """What is judged of a flight."""
    found = detection.score_faults(faults, track.by_sensor)
    looks = [track.looks(part) for part in PARTS]
    return Flown(
        {what: np.abs(e[track.t >= AFTER_S]).max(axis=0) for what, e in errors(track).items()},
        {fault.name: score for fault, score in zip(faults, found, strict=True)},
        sum(int(np.sum(one.weight < 1)) for one in looks),
        sum(int(np.sum(one.isolated)) for one in looks),
        sum(len(one.t) for one in looks),
    )


def errors(track: Track) -> dict[str, Array]:
    """Errors (N, 3) of position [m], velocity [m/s], roll, pitch and heading [arcsec]."""
    attitude = np.column_stack([track.angles[:, :2], track.attitude[:, 2]]) * ARCSEC_PER_RAD
    return {"position": track.position, "velocity": track.velocity, "attitude": attitude}


def _kept(track: Track, faults: Sequence[FaultTruth]) -> float:
    looks = track.looks("gnss_position")
    windows = [(f.start, f.end) for f in faults if f.channel in ("east", "north", "down")]
    return float(np.mean(looks.weight[accuracy.inside(looks.t, windows) & (looks.weight < 1)])) * 3 / 2


# --- the small step, looked for in residuals


def residuals(track: Track, sensed: Sensed) -> dict[str, tuple[Array, Array, Array]]:
    """Residuals of GPS velocity as (times (N,), residuals (N, m), covariances (N, m, m)), around the small step.

    ``GLR`` has the innovations of the GPS filter, ``GLR per axis`` what is left of the velocity east after the fused
    solution, whose covariance is R - P since the solution knows the sample.
    """
    own = [report for report in track.reports if report.aid == "gnss_velocity" and 200 <= report.t < 400]
    t = np.array([report.t for report in own])
    rows = np.searchsorted(track.t, t - accuracy.SAME_TIME_S)
    fixes = {fix.t: fix for fix in sensed.samples["gps"]}
    at = np.searchsorted(sensed.truth.t, t - accuracy.SAME_TIME_S)
    left = np.array([fixes[when].v_n[1] for when in t]) - (sensed.truth.v_n[at, 1] + track.velocity[rows, 1])
    R = np.array([fixes[when].sigma_velocity_n[1] ** 2 for when in t])
    S = np.maximum(R - track.sigma[rows, 4] ** 2, 0.5 * R)
    return {
        "GLR": (t, np.array([report.innovation for report in own]), np.array([report.S for report in own])),
        "GLR per axis": (t, left[:, None], S[:, None, None]),
    }


def watched(t: Array, nu: Array, S: Array) -> tuple[accuracy.Mask, Array, Array]:
    """(alarms, statistics, thresholds), each (N,), of the GLR on residuals."""
    detector = Glr(FALSE_ALARM)
    decisions = [detector.step(one, cov, when) for one, cov, when in zip(nu, S, t.tolist(), strict=True)]
    return (
        np.array([d.alarm for d in decisions]),
        np.array([d.statistic for d in decisions]),
        np.array([d.threshold for d in decisions]),
    )


def _first_alarm(t: Array, nu: Array, S: Array, window: accuracy.Window) -> float:
    score = detection.detection(t, watched(t, nu, S)[0], window)
    assert score is not None
    return math.inf if math.isnan(score.delay) else score.delay


def _series(
    tracks: Mapping[str, Track], faults: Sequence[FaultTruth], looked: tuple[Array, Array, Array]
) -> dict[str, Any]:  # fmt: skip
    looks: dict[str, Looks] = {part: tracks[WITH_STAR].looks(part) for part in PARTS}
    return {
        "t": tracks[WITH_STAR].t,
        "errors": {name: errors(tracks[name]) for name in (WITH_STAR, WITHOUT_STAR)},
        "faults": [(fault.sensor, fault.start, fault.end) for fault in faults],
        "measurements": {part: (one.t, one.nis) for part, one in looks.items()},
        "glr": (looked[0], *watched(*looked)[1:]),
    }
