"""Jiang et al. 2021: attitude of a low-grade inertial system without satellite navigation, on its U flight.

Each job senses the flights of `FLIGHTS` with one seed and runs every `Case` on the same samples, begun at the truth
with a given tilt. Errors of roll and pitch count from `SETTLED_S` on.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from nav.ahrs import Ahrs
from nav.rotation import quat_from_rotvec, quat_multiply
from nav.samples import Array, Sample
from testbed import sensors
from testbed.estimators import ahrs, registry
from testbed.estimators.lane import Lane
from testbed.feeds.simulated import motion
from testbed.motion.table import TruthBlock
from testbed.papers import Job, Paper, scenario
from testbed.papers.claims import HARDLY_ANY, NEARLY_ALL, Claim
from testbed.papers.misprints import correction_eq10
from testbed.results import write_result
from testbed.scenario import Scenario
from testbed.score import accuracy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SETTLED_S = 60.0  # as the digest of the paper's claims has it
RECOVERED_DEG = 0.5
NORTH = np.array([1.0, 0.0, 0.0])
FLIGHTS = ("jiang2021", "jiang2021_slow_turn")
TURN = 1  # the segment


class Case(NamedTuple):
    """One estimator of one scenario, its attitude at the start tilted about north."""

    flight: str
    estimator: str
    tilt_deg: float = 0.5


GYROS, AHRS, CALIBRATED, VECTOR, LITERAL = (
    Case("jiang2021", name) for name in ("gyros", "ahrs", "calibrated", "vector", "literal")
)
TILTED_GYROS, TILTED, TILTED_VECTOR = (Case("jiang2021", name, 3.0) for name in ("gyros", "ahrs", "vector"))
SLOW, SLOW_COMPENSATED = (Case("jiang2021_slow_turn", name) for name in ("ahrs", "compensated"))
CASES = (GYROS, AHRS, CALIBRATED, VECTOR, LITERAL, TILTED_GYROS, TILTED, TILTED_VECTOR, SLOW, SLOW_COMPENSATED)


class Flown(NamedTuple):
    """One case once a second: ``t`` (N,), attitude (N, 4), ``error`` (N, 3) of roll, pitch, heading [deg], mode counter
    (N,); when it was levelled (M,), and from when to when it turned [s].
    """

    t: Array
    q_nb: Array
    error: Array
    mode: Array
    levelled: Array
    turn: tuple[float, float]

    @property
    def largest(self) -> float:
        """Of roll and pitch error [deg]."""
        return float(np.abs(self.error[self.t >= SETTLED_S, :2]).max())

    @property
    def rms(self) -> float:
        """Of roll or pitch error, whichever is larger [deg]."""
        return float(np.sqrt(np.mean(self.error[self.t >= SETTLED_S, :2] ** 2, axis=0)).max())

    def accepted(self, start: float, end: float) -> int:
        """Seconds in (start, end] whose specific force was taken for tilt."""
        return int(np.sum((self.levelled > start) & (self.levelled <= end)))

    @property
    def recovered_s(self) -> float:
        """When roll and pitch error first were below `RECOVERED_DEG`, infinite when never."""
        below = np.abs(self.error[:, :2]).max(axis=1) < RECOVERED_DEG
        return float(self.t[np.argmax(below)]) if below.any() else math.inf


def estimators(chosen: Scenario, seed: int) -> dict[str, Lane]:
    """Those of a scenario, and of each AHRS called ``ahrs`` one that is ``literal``: equation 10 as it is printed."""
    rig = chosen.rig(seed)
    lanes = registry.build(chosen.estimator, rig)
    for section in chosen.estimator:
        if section.name == AHRS.estimator and isinstance(section, ahrs.AhrsSection):
            told = replace(ahrs.configuration(section, rig), correction=correction_eq10)
            lanes[LITERAL.estimator] = ahrs.lane(section, rig, told)
    return lanes


def fly(seed: int) -> dict[Case, Flown]:
    """All cases with one seed."""
    found = {}
    for flight in FLIGHTS:
        chosen = scenario(flight)
        truth = motion(chosen, seed).advance(round(chosen.duration_s * chosen.truth.rate_hz) + 1)
        sensed: dict[str, Any] = {
            name: sensors.build(name, config, chosen.truth.rate_hz, seed, chosen.site()).sense(truth)
            for name, config in chosen.sensors.items()
        }
        for case in CASES:
            if case.flight == flight:
                found[case] = _run(case, estimators(chosen, seed)[case.estimator], truth, sensed)
    return found


def _run(case: Case, running: Lane, truth: TruthBlock, sensed: dict[str, Any]) -> Flown:
    estimator = running.horizon.estimator
    assert isinstance(estimator, Ahrs)
    tilt = -math.radians(case.tilt_deg) * NORTH  # C_nb_hat = (I - [phi x]) C_nb
    estimator.start(float(truth.t[0]), quat_multiply(quat_from_rotvec(tilt), truth.q_nb[0]))
    aids: list[Sample] = [sample for name in running.sensors for sample in sensed[name]]
    t = np.arange(1.0, truth.t[-1] + 0.5)
    increments, _ = running.increments(sensed)
    reports, estimates = running.horizon.track(increments, aids, t.tolist())
    rows = np.searchsorted(truth.t, t - accuracy.SAME_TIME_S)
    q_nb, true = np.array([estimate.q_nb for estimate in estimates]), truth.q_nb[rows]
    angles = np.degrees(accuracy.euler(q_nb) - accuracy.euler(true))
    turning = truth.t[truth.leg == TURN]
    return Flown(
        t=t,
        q_nb=q_nb,
        error=np.mod(angles + 180.0, 360.0) - 180.0,
        mode=np.array([estimate.extra["mode_counter"][0][0] for estimate in estimates]),
        levelled=np.array([report.t for report in reports if report.aid == "level"]),
        turn=(float(turning[0]), float(turning[-1])),
    )


def largest_correction(levelled: Flown, gyros: Flown) -> float:
    """The most by which one second's levelling turned the attitude about a level axis [deg], gyros being equal.

    To a thousandth: the Earth turns under the two, which are tilted differently, by 0.2 mdeg.
    """
    correction = accuracy.attitude_error(levelled.q_nb, gyros.q_nb)
    turned = [quat_from_rotvec(-phi) for phi in correction]
    steps = accuracy.attitude_error(np.array(turned[1:]), np.array(turned[:-1]))
    return round(float(np.degrees(np.abs(steps[:, :2]).max())), 3)


def conclude(runs: Sequence[dict[Case, Flown]]) -> list[Claim]:
    """Every claim beside the paper's."""

    def largest(case: Case) -> list[float]:
        return [run[case].largest for run in runs]

    def rms(case: Case) -> list[float]:
        return [run[case].rms for run in runs]

    headings = [abs(float(run[AHRS].error[-1, 2])) for run in runs]
    in_turn = [run[AHRS].accepted(run[AHRS].turn[0] + 1, run[AHRS].turn[1]) for run in runs]
    corrections = [largest_correction(run[TILTED], run[TILTED_GYROS]) for run in runs]
    recoveries = [run[TILTED].recovered_s for run in runs]
    early = [run[TILTED_VECTOR].accepted(0.0, SETTLED_S) for run in runs]
    max_error, most = "roll and pitch error, largest", "worst seed"
    return [
        Claim(max_error, "deg", "< 2", largest(AHRS), 1.0),
        Claim(f"{max_error}, {most}", "deg", "< 2", largest(AHRS), 2.0, statistic=NEARLY_ALL),
        Claim(f"roll or pitch error, RMS, {most}", "deg", "—", rms(AHRS), 0.4, statistic=NEARLY_ALL),
        Claim(
            f"with gyro biases fed back: {max_error}, {most}", "deg", "< 2", largest(CALIBRATED), 1.0,
            statistic=NEARLY_ALL,
        ),
        Claim(f"with gyro biases fed back: RMS, {most}", "deg", "—", rms(CALIBRATED), 0.4, statistic=NEARLY_ALL),
        Claim(f"plain inertial: {max_error}", "deg", "diverges", largest(GYROS), 2.0, at_least=True,
              statistic=HARDLY_ANY),
        Claim("heading error after 600 s", "deg", "6.7", headings, 6.0, at_least=True),
        Claim("heading error after 600 s", "deg", "6.7", headings, 7.0),
        Claim("seconds taken for level in the turn, after its first", "s", "0", in_turn, 0.0, statistic=NEARLY_ALL),
        Claim("largest correction per second and axis", "deg", "φ_limit", corrections, 0.2, statistic=NEARLY_ALL),
        Claim("from 3 deg of tilt to below 0.5 deg", "s", "—", recoveries, 60.0, statistic=NEARLY_ALL),
        Claim(f"from 3 deg of tilt: {max_error}", "deg", "< 2", largest(TILTED), 1.0),
        Claim(f"nav-frame test: {max_error}", "deg", "< 2", largest(VECTOR), 1.0),
        Claim(
            f"nav-frame test from 3 deg of tilt: {max_error}", "deg", "< 2", largest(TILTED_VECTOR), 2.0, at_least=True,
            note="to this test a tilt above 1.17 deg is itself an acceleration of 0.2 m/s²: it waits until the "
            "drift of the gyros happens to undo the tilt",
        ),
        Claim("the same: seconds taken for level in the first 60 s", "s", "—", early, 0.0),
        Claim(
            f"turn of 0.4 deg/s: {max_error}", "deg", "< 2", largest(SLOW), 2.0, at_least=True, statistic=HARDLY_ANY,
            note="the turn's 0.35 m/s² is taken for 2 deg of tilt, and none of the three tests sees it",
        ),
        Claim(
            f"the same less the turn of the air velocity: {max_error}, {most}", "deg", "—", largest(SLOW_COMPENSATED),
            1.0, statistic=NEARLY_ALL,
        ),
        Claim(
            f"equation 10 as printed: {max_error}", "deg", "< 2", largest(LITERAL), 2.0, at_least=True,
            statistic=HARDLY_ANY,
            note="it corrects both axes by the error of the north axis, and so never levels the east axis",
        ),
    ]  # fmt: skip


def draw(runs: Sequence[dict[Case, Flown]], out: Path) -> None:
    """Errors of gyros and filter on the U flight with the mode counter; and what defeats the filter. First seed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from testbed.report.style import COLOURS, SHADE

    run = runs[0]
    figure = Figure(figsize=(9.0, 7.2), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(4, 1, sharex=True, height_ratios=(1, 1, 1, 0.7))
    styles = (
        (GYROS, "gyros alone", COLOURS[1]),
        (AHRS, "levelled, the paper's filter", COLOURS[0]),
        (CALIBRATED, "gyro biases fed back as well", COLOURS[2]),
    )
    for axis, (ax, name) in enumerate(zip(panels, ("roll", "pitch", "heading"), strict=False)):
        for case, label, colour in styles:
            ax.plot(run[case].t, run[case].error[:, axis], color=colour, lw=1.3, label=label)
        ax.set_ylabel(f"{name} error [deg]")
        if name != "heading":
            for bound in (-2, 2):
                ax.axhline(bound, color="black", lw=0.8, ls="--")
    panels[0].annotate("the paper's 2 deg", (4, 2), xytext=(0, -11), textcoords="offset points", fontsize=8)
    panels[3].plot(run[AHRS].t, run[AHRS].mode, color=COLOURS[0], lw=1.3)
    panels[3].set_ylabel("mode counter [s]")
    panels[3].set_xlabel("time [s]")
    for ax in panels:
        ax.axvspan(*run[AHRS].turn, color=SHADE, lw=0, zorder=0)
    middle = sum(run[AHRS].turn) / 2
    panels[3].text(middle, 0.5, "turn", transform=panels[3].get_xaxis_transform(), ha="center")
    _finish(panels)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=3, frameon=False)
    _save(figure, out / "jiang2021.png")

    figure = Figure(figsize=(9.0, 4.6), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, 1, sharex=True)
    pairs = (
        (TILTED_VECTOR, "nav-frame test, from 3 deg of tilt"), (TILTED, "norm test"),
        (SLOW, "turn of 0.4 deg/s"), (SLOW_COMPENSATED, "less the turn of the air velocity"),
    )  # fmt: skip
    for k, (case, label) in enumerate(pairs):
        level = np.abs(run[case].error[:, :2]).max(axis=1)
        panels[k // 2].plot(run[case].t, level, color=COLOURS[1 - k % 2], lw=1.3, label=label)
        panels[k // 2].axvspan(*run[case].turn, color=SHADE, lw=0, zorder=0)
    for ax in panels:
        ax.set_ylabel("roll or pitch error [deg]")
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False, borderaxespad=0.2)
    panels[-1].set_xlabel("time [s]")
    _finish(panels)
    _save(figure, out / "jiang2021_limits.png")


def _finish(panels: Sequence[Axes]) -> None:
    for ax in panels:
        ax.grid(alpha=0.35, lw=0.6)
        ax.spines[["top", "right"]].set_visible(False)
        ax.set_xlim(0, 600)


def _save(figure: Figure, path: Path) -> None:
    image = io.BytesIO()
    figure.savefig(image, format="png")
    write_result(path, image.getvalue())


PAPER = Paper(
    "Jiang et al. 2021: attitude without satellite navigation",
    ("jiang2021.png", "jiang2021_limits.png"),
    lambda draws: [Job(fly, (seed,)) for seed in draws.seeds],
    conclude,
    draw,
)
