"""Jiang et al. 2021: attitude of a low-grade inertial system without satellite navigation, on its U flight.

Each job senses the flights of `FLIGHTS` with one seed, in a `World` of its own, and runs every `Case` on the same
samples, begun at the truth with a tilt of given size to anywhere. Errors of roll and pitch count from `SETTLED_S` on.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from nav.ahrs import Ahrs
from nav.ahrs.filter import JUDGED
from nav.error_model import ImuModel
from nav.rotation import quat_from_rotvec, quat_multiply
from nav.samples import Array, ImuSamples, Sample
from testbed.estimators import ahrs, registry
from testbed.estimators.lane import Lane
from testbed.motion.sections import KinematicTruth
from testbed.motion.segments import Straight, Turn
from testbed.noise import stream
from testbed.papers import Job, Paper, levelling, scenario
from testbed.papers.draws import World, world
from testbed.papers.flights import Sensed
from testbed.papers.misprints import correction_eq10
from testbed.report.style import COLOURS, GUIDE, SHADE
from testbed.results import write_result
from testbed.scenario import Scenario
from testbed.score import accuracy
from testbed.score.claims import HARDLY_ANY, MEAN, NEARLY_ALL, SHARE, Claim, bootstrapped, quantile
from testbed.sensors.imu import ImuConfig

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SETTLED_S = 60.0  # as the digest of the paper's claims has it
RECOVERED_DEG = 0.5
FLIGHTS = ("jiang2021", "jiang2021_slow_turn")
TURN = 1  # the segment
DRIFT_DEG = 6.7  # of heading in 600 s, by the paper
GUST_MPS2, GUST_S = 0.15, 0.5  # as the scenario makes them
ACCELERATION, YAW, ROLL = range(3)  # what low dynamics are judged by
THRESHOLDS = (0.2, 0.5, 2.0)  # of them, the paper's [m/s^2, deg/s]
LASTING_S = 5  # an acceleration lasts that is found in so many seconds in a row
ENDS_OF_99 = 368  # draws that an interval of a 99 % quantile takes to have an upper end: 0.99^n < 0.025
DEGPH = math.radians(1 / 3600)
# P0, Q and R as they are printed, the Q of each second: (200 deg/h)^2, (40 deg/3600 s)^2 and (5 deg/3600 s)^2.
PRINTED_NOISE = ImuModel(
    gyro_noise=40 * DEGPH,
    accel_noise=0.0,
    gyro_bias_sigma=200 * DEGPH,
    accel_bias_sigma=0.0,
    gyro_bias_walk=5 * DEGPH,
)


class Case(NamedTuple):
    """One estimator of one scenario, its attitude at the start tilted."""

    flight: str
    estimator: str
    tilt_deg: float = 0.5

    def start(self, azimuth: float) -> Array:
        """The tilt as a rotation vector (3,) in n [rad]."""
        return math.radians(self.tilt_deg) * np.array([math.cos(azimuth), math.sin(azimuth), 0.0])


GYROS, PAPER_S, NORM, CALIBRATED, MODELLED, PRINTED, LITERAL = (
    Case("jiang2021", name) for name in ("gyros", "paper", "norm", "calibrated", "modelled", "printed", "literal")
)
TILTED_GYROS, TILTED_PAPER_S, TILTED, TILTED_MODELLED = (
    Case("jiang2021", name, 3.0) for name in ("gyros", "paper", "norm", "modelled")
)
SLOW_PAPER_S, SLOW, SLOW_COMPENSATED = (
    Case("jiang2021_slow_turn", name) for name in ("paper", "norm", "compensated")
)  # fmt: skip
CASES = (
    GYROS, PAPER_S, NORM, CALIBRATED, MODELLED, PRINTED, LITERAL, TILTED_GYROS, TILTED_PAPER_S, TILTED, TILTED_MODELLED,
    SLOW_PAPER_S, SLOW, SLOW_COMPENSATED,
)  # fmt: skip
UNTIL_TURN = (TILTED_GYROS, TILTED, TILTED_MODELLED)  # they go on as without the tilt


class Flown(NamedTuple):
    """One case once a second: ``t`` (N,), attitude (N, 4), ``error`` (N, 3) of roll, pitch, heading [deg], what low
    dynamics were ``judged`` by (N, 3) [m/s^2, deg/s], counters of mode and of corrections (N, 2); when it was levelled
    (M,), and from when to when it turned [s].
    """

    t: Array
    q_nb: Array
    error: Array
    judged: Array
    counters: Array
    levelled: Array
    turn: tuple[float, float]

    @property
    def largest(self) -> float:
        """Of roll and pitch error [deg]."""
        return largest(self.error[self.t >= SETTLED_S, :2])

    @property
    def rms(self) -> float:
        """Of roll or pitch error, whichever is larger [deg]."""
        return rms(self.error[self.t >= SETTLED_S, :2])

    def accepted(self, start: float, end: float) -> int:
        """Seconds in (start, end] whose specific force was taken for tilt."""
        return int(np.sum((self.levelled > start) & (self.levelled <= end)))

    @property
    def recovered_s(self) -> float:
        """From when on roll and pitch error stay below `RECOVERED_DEG` until the turn, infinite when they don't."""
        straight = self.t < self.turn[0]
        above = np.abs(self.error[straight, :2]).max(axis=1) >= RECOVERED_DEG
        if above[-1]:
            return math.inf
        return float(self.t[np.flatnonzero(above)[-1] + 1]) if above.any() else float(self.t[0])

    def noticed_s(self, test: int) -> float:
        """When ``test`` first notices the turn [s]: of acceleration, one that lasts; infinite when never."""
        above = (self.judged[:, test] > THRESHOLDS[test]) & (self.t > self.turn[0])
        if test == ACCELERATION:
            runs = np.convolve(above, np.ones(LASTING_S), "valid") == LASTING_S
            above = np.append(runs, np.zeros(LASTING_S - 1, bool))
        return float(self.t[np.argmax(above)]) if above.any() else math.inf

    def in_steady_turn(self, test: int) -> Array:
        """Seconds of the steady turn that ``test`` calls no low dynamics, and all of them (2,)."""
        steady = (self.t > self.turn[0] + ROLLED_S) & (self.t <= self.turn[1] - ROLLED_S)
        return np.array([np.sum(self.judged[steady, test] > THRESHOLDS[test]), np.sum(steady)], dtype=float)


ROLLED_S = 5.0  # to roll in, and a second that is judged whole
Run: TypeAlias = tuple[dict[Case, Flown], Array]  # all cases of a seed, and errors (N, 2) of `levelling.best`


def largest(error: Array) -> float:
    """Of errors (N, m)."""
    return float(np.abs(error).max())


def rms(error: Array) -> float:
    """Of errors (N, m), that of the axis with the largest."""
    return float(np.sqrt(np.mean(error**2, axis=0)).max())


def placed(flight: str, here: World) -> Scenario:
    """A scenario of `FLIGHTS`, begun where and with a first leg and a turn as `world` has drawn them."""
    motion = scenario(flight).truth
    assert isinstance(motion, KinematicTruth)
    straight, turn = motion.segments
    assert isinstance(straight, Straight)
    assert straight.duration_s is not None
    assert isinstance(turn, Turn)
    turned = turn.by_deg if flight == FLIGHTS[0] else turn.by_deg * here.stretch[1]
    duration_s = straight.duration_s * here.stretch[0]
    legs = f"truth.segments[0].duration_s={duration_s!r}", f"truth.segments[1].by_deg={turned!r}"
    return scenario(flight, [*here.start, *legs])


def estimators(chosen: Scenario, seed: int) -> dict[str, Lane]:
    """Those of a scenario, and two more: the paper's told the noise that it prints, and equation 10 as printed."""
    rig = chosen.rig(seed)
    lanes = registry.build(chosen.estimator, rig)
    for section in chosen.estimator:
        if not isinstance(section, ahrs.AhrsSection):
            continue
        told = ahrs.configuration(section, rig)
        if section.name == PAPER_S.estimator:
            lanes[PRINTED.estimator] = ahrs.lane(section, rig, replace(told, imu=PRINTED_NOISE))
        if section.name == NORM.estimator:
            lanes[LITERAL.estimator] = ahrs.lane(section, rig, replace(told, correction=correction_eq10))
    return lanes


def fly(seed: int) -> Run:
    """All cases with one seed, and the least error that there could be."""
    found = {}
    random = stream(seed, "papers", "jiang2021")
    azimuth = random.uniform(0.0, 2 * math.pi)
    for flight in FLIGHTS:
        chosen = placed(flight, world(seed, 2))
        sensed, increments = Sensed.of(chosen, seed), None
        for case in CASES:
            if case.flight == flight:
                lane = estimators(chosen, seed)[case.estimator]
                if increments is None:
                    increments = lane.increments(sensed.samples)[0]  # of the only IMU
                found[case] = _run(lane, sensed, increments, case.start(azimuth), case not in UNTIL_TURN)
        if flight == FLIGHTS[0]:
            best = _best(chosen, sensed, found[PAPER_S].turn, random)
    return found, best


def _best(chosen: Scenario, sensed: Sensed, turn: tuple[float, float], random: np.random.Generator) -> Array:
    """Errors (N, 2) [deg] of `levelling.best` on the flight."""
    imu = chosen.sensors["imu"]
    assert isinstance(imu, ImuConfig)
    e, rate = imu.errors(), round(chosen.truth.rate_hz)
    statistics = levelling.Statistics(
        e.gyro_turn_on, e.gyro_noise, e.gyro_misalignment, e.accel_turn_on, e.accel_noise, GUST_MPS2, GUST_S,
        math.radians(PAPER_S.tilt_deg),
    )  # fmt: skip
    middle = np.arange(rate // 2, len(sensed.truth) - 1, rate)
    end = np.arange(1.0, len(middle) + 1)
    straight = (end <= turn[0]) | (end - 1 >= turn[1])
    truth = sensed.truth
    return levelling.best(statistics, truth.q_nb[middle], truth.omega_b[middle, 2], straight, random)


def _run(running: Lane, sensed: Sensed, increments: ImuSamples, tilt_n: Array, whole: bool) -> Flown:
    estimator, truth = running.horizon.estimator, sensed.truth
    assert isinstance(estimator, Ahrs)
    estimator.start(float(truth.t[0]), quat_multiply(quat_from_rotvec(-tilt_n), truth.q_nb[0]))  # phi = tilt_n
    aids: list[Sample] = [sample for name in running.sensors for sample in sensed.samples[name]]
    turning = truth.t[truth.leg == TURN]
    t = np.arange(1.0, (truth.t[-1] if whole else turning[0]) + 0.5)
    reports, estimates = running.horizon.track(increments, aids, t.tolist())
    rows = np.searchsorted(truth.t, t - accuracy.SAME_TIME_S)
    q_nb, true = estimates.q_nb, truth.q_nb[rows]

    def told(*names: str) -> Array:
        return np.column_stack([estimates.extra[name][0][:, 0] for name in names])

    return Flown(
        t=t,
        q_nb=q_nb,
        error=np.degrees(accuracy.wrapped(accuracy.euler(q_nb) - accuracy.euler(true))),
        judged=told(*JUDGED) * [1.0, math.degrees(1.0), math.degrees(1.0)],
        counters=told("mode_counter", "correction_counter"),
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


MAX = "roll and pitch error, largest"
FILTERS: Mapping[Case, str] = {
    PAPER_S: "the paper's filter",
    PRINTED: "the same, P0 and Q as printed, per second",
    NORM: "acceleration by its size",
    CALIBRATED: "gyro biases fed back as well",
    MODELLED: "gusts, accelerometer biases, misalignment as states",
}


def conclude(runs: Sequence[Run]) -> list[Claim]:
    """Every claim beside the paper's."""
    flown, best = [run[0] for run in runs], [run[1] for run in runs]
    return [*_level_claims(flown), *_dynamics_claims(flown), *_tilt_claims(flown), *_room_claims(flown, best)]


def _of(flown: Sequence[dict[Case, Flown]], case: Case, what: Callable[[Flown], float]) -> list[float]:
    return [what(one[case]) for one in flown]


def _largest(one: Flown) -> float:
    return one.largest


def _level_claims(flown: Sequence[dict[Case, Flown]]) -> Iterator[Claim]:
    """Roll and pitch on the U flight by each filter, by gyros alone, by equation 10 as printed; and heading."""
    for case, label in FILTERS.items():
        yield Claim(f"{label}: {MAX}", "deg", "< 2", _of(flown, case, _largest), 2.0, statistic=NEARLY_ALL)
    yield Claim(
        f"plain inertial: {MAX}", "deg", "diverges", _of(flown, GYROS, _largest), 2.0, at_least=True,
        statistic=HARDLY_ANY,
    )  # fmt: skip
    off = _of(flown, PAPER_S, lambda one: abs(abs(float(one.error[-1, 2])) - DRIFT_DEG))
    yield Claim(f"heading error after 600 s, off the paper's {DRIFT_DEG}", "deg", "about 6.7", off, 0.5)
    yield Claim(
        f"equation 10 as printed: {MAX}", "deg", "< 2", _of(flown, LITERAL, _largest), 2.0, misprint=True,
        note="it corrects both axes by the error of the north axis, and so never levels the east axis",
    )  # fmt: skip
    for case, label in FILTERS.items():
        yield Claim(
            f"{label}: RMS of roll or pitch error", "deg", "", _of(flown, case, lambda one: one.rms), 0.4,
            statistic=quantile(0.99), note=f"the upper end wants {ENDS_OF_99} draws" if len(flown) < ENDS_OF_99 else "",
        )  # fmt: skip


def _dynamics_claims(flown: Sequence[dict[Case, Flown]]) -> Iterator[Claim]:
    """Which of the three tests notices the turn, and what is taken for level in it."""
    for test, name in ((YAW, "yaw rate"), (ACCELERATION, "acceleration")):
        lead = [one[PAPER_S].noticed_s(test) - one[PAPER_S].noticed_s(ROLL) for one in flown]
        quantity = f"the turn is noticed by roll rate before {name}, by"
        yield Claim(quantity, "s", "first", lead, 0.0, at_least=True, statistic=MEAN)
    yaw, roll = (np.array([one[PAPER_S].in_steady_turn(test) for one in flown]) for test in (YAW, ROLL))
    steady = "seconds of the steady turn in which {} rate is too large"
    yield Claim(steady.format("yaw"), "", "all", yaw, 0.99, at_least=True, statistic=SHARE)
    yield Claim(steady.format("roll"), "", "none", roll, 0.01, statistic=SHARE)
    in_turn = _of(flown, PAPER_S, lambda one: one.accepted(one.turn[0] + 1, one.turn[1]))
    yield Claim("seconds taken for level in the turn, after its first", "s", "0", in_turn, 0.0, statistic=NEARLY_ALL)
    corrections = [largest_correction(one[TILTED], one[TILTED_GYROS]) for one in flown]
    yield Claim(
        "largest correction per second and axis", "deg", "φ_limit", corrections, 0.2, statistic=NEARLY_ALL
    )  # fmt: skip


def _tilt_claims(flown: Sequence[dict[Case, Flown]]) -> Iterator[Claim]:
    """From three degrees of tilt, and in a slow turn: what the paper doesn't say."""
    for tilted, same in ((TILTED_PAPER_S, PAPER_S), (TILTED, NORM), (TILTED_MODELLED, MODELLED)):
        back = _of(flown, tilted, lambda one: one.recovered_s)
        quantity = f"{FILTERS[same]}, from 3 deg of tilt: below 0.5 deg until the turn, from"
        yield Claim(quantity, "s", "", back, SETTLED_S)
    quantity = f"{FILTERS[PAPER_S]}, from 3 deg of tilt: {MAX}"
    yield Claim(quantity, "deg", "", _of(flown, TILTED_PAPER_S, _largest), 2.0, statistic=NEARLY_ALL)
    early = _of(flown, TILTED_PAPER_S, lambda one: one.accepted(0.0, SETTLED_S))
    yield Claim(
        "the paper's filter, from 3 deg of tilt: seconds taken for level in the first 60 s", "s", "", early, 30.0,
        at_least=True, note="a tilt above 1.17 deg is an acceleration of 0.2 m/s² to its test, and locks it out",
    )  # fmt: skip
    for case, label, note in (
        (SLOW_PAPER_S, FILTERS[PAPER_S], "levelled to the turn in the end, and locked out when it is over"),
        (SLOW, FILTERS[NORM], "0.35 m/s² are taken for 2 deg of tilt, and none of the three tests sees them"),
        (SLOW_COMPENSATED, "less the turn of the air velocity", ""),
    ):
        slow = _of(flown, case, _largest)
        yield Claim(f"turn of 0.4 deg/s, {label}: {MAX}", "deg", "", slow, 2.0, statistic=NEARLY_ALL, note=note)


def _room_claims(flown: Sequence[dict[Case, Flown]], best: Sequence[Array]) -> Iterator[Claim]:
    """How much of the room between levelling by size and `levelling.best` the modelled filter takes."""
    late = [error[round(SETTLED_S) - 1 :] for error in best]
    for what, of_case, of_best in (
        (MAX, _largest, largest),
        ("RMS of roll or pitch error", lambda one: one.rms, rms),
    ):
        figures = np.column_stack(
            [_of(flown, NORM, of_case), _of(flown, MODELLED, of_case), [of_best(error) for error in late]]
        )
        quantity = f"{FILTERS[MODELLED]}: {what}, share of the room from {FILTERS[NORM]} to a filter told everything"
        yield Claim(quantity, "", "", figures, 0.5, at_least=True, statistic=bootstrapped("of medians", room))
        yield Claim(f"a filter told everything: {what}", "deg", "", figures[:, 2], 2.0, statistic=NEARLY_ALL)


def room(figures: Array) -> float:
    """(a - b) / (a - c) of the medians of figures (draws, 3)."""
    ours, modelled, told = np.median(figures, axis=0)
    return float((ours - modelled) / (ours - told))


# --- figures

TESTS = ((ROLL, "roll rate [deg/s]"), (YAW, "yaw rate [deg/s]"), (ACCELERATION, "acceleration [m/s²]"))
SHOWN = (
    (GYROS, "gyros alone", COLOURS[1]),
    (PAPER_S, "the paper's filter", COLOURS[0]),
    (MODELLED, "gusts and biases modelled", COLOURS[2]),
)


def draw(runs: Sequence[Run], out: Path) -> None:
    """What the paper's figures show, and what defeats its filter. First draw."""
    _draw_flight(runs[0][0], out / "jiang2021.png")
    _draw_limits(runs[0][0], out / "jiang2021_limits.png")


def _figure(height: float, rows: int) -> tuple[Figure, Sequence[Axes]]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, height), dpi=90, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, 1, sharex=True)
    for ax in panels:
        ax.grid(alpha=0.35, lw=0.6)
        ax.spines[["top", "right"]].set_visible(False)
        ax.set_xlim(0, 600)
    panels[-1].set_xlabel("time [s]")
    return figure, panels


def _bound(ax: Axes, value: float, text: str, both: bool = True) -> None:
    """A line at a bound of the paper's, with its name."""
    for y in (-value, value) if both else (value,):
        ax.axhline(y, color=GUIDE, lw=0.9, ls="--")
    ax.annotate(
        text,
        (596, value),
        xytext=(0, 2),
        textcoords="offset points",
        fontsize=8,
        color=GUIDE,
        ha="right",
        backgroundcolor="#ffffffb0",
    )


def _draw_flight(run: dict[Case, Flown], path: Path) -> None:
    """Errors, the three tests in the order in which they notice the turn, and the two counters."""
    figure, panels = _figure(11.5, 7)
    for axis, name in enumerate(("roll", "pitch", "heading")):
        ax = panels[axis]
        for shown, label, colour in SHOWN:
            ax.plot(run[shown].t, run[shown].error[:, axis], color=colour, lw=1.2, label=label)
        ax.set_ylabel(f"{name}\nerror [deg]")
        if name == "heading":
            end = math.copysign(DRIFT_DEG, run[PAPER_S].error[-1, 2])
            _bound(ax, end, "the paper's 6.7 deg after 600 s", both=False)
        else:
            _bound(ax, 2.0, "the paper's 2 deg")
            ax.set_ylim(-3.9, 3.9)
    one = run[PAPER_S]
    for ax, (test, name) in zip(panels[3:6], TESTS, strict=True):
        ax.plot(one.t, one.judged[:, test], color=COLOURS[0], lw=1.0)
        _bound(ax, THRESHOLDS[test], f"the paper's threshold, {THRESHOLDS[test]:g}", both=False)
        ax.set_ylim(0, None if test != ACCELERATION else 1.0)
        ax.set_ylabel("mean of 1 s\n" + name)
    for k, name in enumerate(("seconds of low dynamics", "corrections since they began")):
        panels[6].plot(one.t, one.counters[:, k], color=COLOURS[3 * k], lw=1.2, label=name)
    panels[6].set_ylabel("counters")
    panels[6].legend(loc="upper left", fontsize=8, frameon=False)
    for ax in panels:
        ax.axvspan(*one.turn, color=SHADE, lw=0, zorder=0)
    panels[0].text(sum(one.turn) / 2, 1.0, "turn", transform=panels[0].get_xaxis_transform(), ha="center", va="bottom")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=3, frameon=False)
    figure.supxlabel(
        "Not reproduced: the paper's flight, of which it prints neither data nor times; gusts are made up here.\n"
        "Tests and counters: the paper's filter; "
        "acceleration in the turn is cut, it is 2.6 m/s².",
        fontsize=8,
    )
    _save(figure, path)


def _draw_limits(run: dict[Case, Flown], path: Path) -> None:
    """The larger of roll and pitch error from a tilt of 3 deg, and in a turn that is hardly noticed."""
    figure, panels = _figure(5.2, 2)
    panels_of = (
        (
            (TILTED_PAPER_S, "the paper's filter"),
            (TILTED, "acceleration by its size"),
            (TILTED_MODELLED, "gusts and biases modelled"),
        ),
        (
            (SLOW_PAPER_S, "the paper's filter"),
            (SLOW, "acceleration by its size"),
            (SLOW_COMPENSATED, "less the turn of the air velocity"),
        ),
    )
    titles = "U flight, 3 deg of tilt", "Turn of 0.4 deg/s"
    for ax, cases, title in zip(panels, panels_of, titles, strict=True):
        for (case, label), colour in zip(cases, (COLOURS[0], COLOURS[1], COLOURS[2]), strict=True):
            ax.plot(run[case].t, np.abs(run[case].error[:, :2]).max(axis=1), color=colour, lw=1.2, label=label)
        turn = run[cases[0][0]].turn
        ax.axvspan(*turn, color=SHADE, lw=0, zorder=0)
        ax.text(turn[1] - 4, 0.98, "turn", transform=ax.get_xaxis_transform(), ha="right", va="top", fontsize=8)
        _bound(ax, 2.0, "the paper's 2 deg", both=False)
        ax.set_ylabel("roll or pitch\nerror [deg]")
        ax.set_ylim(bottom=0)
        ax.set_title(title, loc="left", fontsize=10)
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False, borderaxespad=0.2, fontsize=8)
    figure.supxlabel(
        "Nothing of this is in the paper: it gives no tilt at the start and no slow turn. Above, what recovers "
        "is flown to the turn only.",
        fontsize=8,
    )
    _save(figure, path)


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
