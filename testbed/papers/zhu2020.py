"""Zhu et al. 2020: a federated filter whose local filters inflate R, on a river with wrong transponder fixes.

Each job senses one run with one seed and lets every estimator of its scenario work on the same samples. Errors are
estimate - truth once a second, position and velocity NED, attitude phi.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from nav.detection import chi_square_threshold
from nav.earth import position_difference_n
from nav.federated import Federated
from nav.fusion import weights_by_covariance
from nav.samples import Array
from nav.weighting import inflation
from testbed import sensors
from testbed.estimators import federated, registry
from testbed.estimators.lane import Lane
from testbed.feeds.known import handed_over
from testbed.feeds.simulated import motion
from testbed.papers import Job, Paper, scenario
from testbed.papers.claims import HARDLY_ANY, MEDIAN, NEARLY_ALL, Claim
from testbed.papers.misprints import inflation_by_newton, inflation_upside_down, weights_eq13
from testbed.report.style import COLOURS, SHADE
from testbed.results import write_result
from testbed.scenario import Scenario
from testbed.score.accuracy import attitude_error
from testbed.sensors.faults import Faults

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SLOW_LOG = ("sensors.dvl.rate_hz=0.0333333333333",)  # thinned to one value in 30 s
CLEAN = ("fault=[]", 'sensors.ast.distribution="gaussian"', "sensors.ast.horizontal_m=11.547")  # the same R
RUNS: Mapping[str, tuple[str, tuple[str, ...]]] = {  # scenario and overrides
    "outage": ("zhu2020_outage", ()),  # the longest job first
    "1 Hz": ("zhu2020", ()),
    "clean": ("zhu2020", CLEAN),
    "30 s": ("zhu2020", SLOW_LOG),
}
BLOCK_S = 10.0
OUTLIERS = 150.5 + 150.0 * np.arange(23)  # [s]
OUTAGE = (1500.0, 2500.0)
CONVERGED_S = 600.0  # the paper doesn't say when
COMMON = 15  # states that the local filters share
P_N, P_E, V_N, V_E, HEADING = 0, 1, 3, 4, 8  # columns of errors
HORIZONTAL = (P_N, P_E)
LIMIT = chi_square_threshold(0.01, 2)
CASES = 4000
WEIGHTS = (weights_by_covariance, weights_eq13)
NO_RESET, EQ13 = "frkf_no_reset", "eq13"


class Flown(NamedTuple):
    """One estimator: ``error`` (N, 9) at each second [m, m/s, rad]; ``step`` (M, 9), by how many sigma each wrong fix
    moved it; after each block of `BLOCK_S`, the weight (K,) of the second of two local filters by the traces of their
    covariances, and by equation 13.
    """

    error: Array
    step: Array
    by_trace: Array
    by_eq13: Array


def fly(run: str, seed: int) -> dict[str, Flown]:
    """Every estimator of one of `RUNS`, by name."""
    name, overrides = RUNS[run]
    return navigate(scenario(name, overrides), seed)


def estimators(chosen: Scenario, seed: int) -> dict[str, Lane]:
    """Those of a scenario, and where one does without resets, ``eq13``: scalar weights by equation 13 as printed."""
    rig = chosen.rig(seed)
    lanes = registry.build(chosen.estimator, rig)
    for section in chosen.estimator:
        if section.name == NO_RESET and isinstance(section, federated.FederatedSection):
            told = federated.configuration(section, rig)
            told = replace(told, sharing="none", combination="scalar", weigh=weights_eq13)
            lanes[EQ13] = federated.lane(section, rig, told)
    return lanes


def navigate(chosen: Scenario, seed: int) -> dict[str, Flown]:
    """Every one of `estimators`, by name, all of them started with the same errors."""
    rate = round(chosen.truth.rate_hz)
    source = motion(chosen, seed)
    sensed = {name: sensors.build(name, config, rate, seed, chosen.site()) for name, config in chosen.sensors.items()}
    faults = Faults(chosen.fault, chosen.sensors, seed)
    filters = estimators(chosen, seed)
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
                one.start(handed_over(one.handover, truth))
            handed = [sample for aid in one.sensors for sample in samples[aid]]
            increments, _ = one.increments(samples)
            _, found = one.horizon.track(increments, handed, truth.t[due].tolist())
            lat, lon, h = np.array([(e.lat, e.lon, e.h) for e in found]).T
            error = np.column_stack(
                [
                    position_difference_n(lat, lon, h, truth.lat[due], truth.lon[due], truth.h[due]),
                    np.array([e.v_n for e in found]) - truth.v_n[due],
                    attitude_error(np.array([e.q_nb for e in found]), truth.q_nb[due]),
                ]
            )
            sigma = np.sqrt([e.covariance.diagonal() for e in found])
            rows[name].append((error, sigma))
            estimator = one.horizon.estimator
            assert isinstance(estimator, Federated)
            if len(estimator.locals) == 2:
                P = np.stack([estimator.local(local.name)[1][:COMMON, :COMMON] for local in estimator.config.locals])
                weights[name].append(np.array([weigh(P, COMMON, np.ones(2)) for weigh in WEIGHTS]))
    second = np.flatnonzero(wanted % rate == 0)
    at = np.searchsorted(wanted, wrong)
    flown = {}
    for name, parts in rows.items():
        error, sigma = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        betas = np.array(weights[name]).reshape(-1, 2, 2)
        step = np.abs(error[at] - error[at - 1]) / sigma[at]
        flown[name] = Flown(error[second], step, betas[:, 0, 1], betas[:, 1, 1])
    return flown


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
        "near": 100 * near / CASES,
    }


def _std(flown: Flown, column: int) -> float:
    return float(flown.error[:, column].std())


def _largest(flown: Flown, columns: Sequence[int], start: float, end: float) -> float:
    """The largest error of any of these ``columns`` from ``start`` to ``end`` [s]."""
    return float(np.abs(flown.error[round(start) : round(end) + 1, columns]).max())


def _loss(robust: Flown, plain: Flown, columns: Sequence[int]) -> float:
    """By how many percent the RMS error over these ``columns`` is larger."""
    rms = [float(np.sqrt(np.mean(flown.error[:, columns] ** 2))) for flown in (robust, plain)]
    return 100 * (rms[0] / rms[1] - 1)


def conclude(results: Sequence[Any]) -> list[Claim]:
    """Every claim beside the paper's."""
    seeds = len(results) // len(RUNS)
    of = {run: results[k * seeds : (k + 1) * seeds] for k, run in enumerate(RUNS)}
    return [
        *_spread_claims("30 s", "log every 30 s", of["30 s"]),
        *_spread_claims("1 Hz", "log at 1 Hz", of["1 Hz"]),
        *_converged_claims(of["30 s"]),
        *_step_claims(of["1 Hz"]),
        *_outage_claims(of["outage"]),
        *_clean_claims(of["clean"]),
        *_solver_claims(results[len(RUNS) * seeds :]),
    ]


def _spread_claims(run: str, every: str, flown: Sequence[Mapping[str, Flown]]) -> Iterator[Claim]:
    """Standard deviations of the robust filter, beside the traditional one's and by themselves."""
    for what, column, paper, bound in (
        ("v_E", V_E, 0.0874 / 0.2154, 0.45),
        ("v_N", V_N, 0.1804 / 0.2948, 0.65),
        ("latitude", P_N, 7.191 / 19.30, 0.4),
        ("longitude", P_E, 6.330 / 19.84, 0.4),
    ):
        ratios = [_std(one["frkf"], column) / _std(one["tfkf"], column) for one in flown]
        name = f"{every}: std of {what}, robust over traditional"
        yield Claim(name, "", f"{paper:.2f}", ratios, bound)
    speed, paper_speed = (0.1, "0.087, 0.180") if run == "30 s" else (0.03, "—")
    for what, unit, columns, paper_std, bound in (
        ("v_E or v_N", "m/s", (V_E, V_N), paper_speed, speed),
        ("latitude or longitude", "m", (P_N, P_E), "7.2, 6.3" if run == "30 s" else "—", 6.0),
    ):
        largest = [max(_std(one["frkf"], column) for column in columns) for one in flown]
        name = f"{every}: std of {what}, worst seed"
        yield Claim(name, unit, paper_std, largest, bound, statistic=NEARLY_ALL)


def _converged_claims(flown: Sequence[Mapping[str, Flown]]) -> Iterator[Claim]:
    """Largest errors of the robust filter from `CONVERGED_S` on, the log every 30 s."""
    for what, unit, columns, limit in (
        ("pitch and roll", "deg", (6, 7), 0.01),
        ("heading", "deg", (HEADING,), 0.2),
        ("v_E", "m/s", (V_E,), 0.2),
        ("v_N", "m/s", (V_N,), 0.3),
        ("latitude", "m", (P_N,), 21.0),
        ("longitude", "m", (P_E,), 16.0),
    ):
        late = [_largest(one["frkf"], columns, CONVERGED_S, 3600) for one in flown]
        ours = [float(np.degrees(value)) for value in late] if unit == "deg" else late
        yield Claim(f"after convergence, largest error of {what}", unit, f"< {limit:g}", ours, limit)


def _step_claims(flown: Sequence[Mapping[str, Flown]]) -> Iterator[Claim]:
    """By how much a wrong fix moves either filter, the log at 1 Hz."""

    def steps(name: str) -> list[float]:
        return [float(one[name].step.max()) for one in flown]

    yield Claim(
        "largest step at a wrong fix, any state, worst seed", "sigma", "—", steps("frkf"), 1.0, statistic=NEARLY_ALL
    )
    yield Claim("the same, traditional", "sigma", "jumps", steps("tfkf"), 1.0, at_least=True, statistic=HARDLY_ANY)


def _outage_claims(flown: Sequence[Mapping[str, Flown]]) -> Iterator[Claim]:
    """1000 s without a fix: largest errors, and what the lost filter still counts for."""

    def lost(name: str, columns: Sequence[int], start: float = OUTAGE[0]) -> list[float]:
        return [_largest(one[name], columns, start, OUTAGE[1]) for one in flown]

    at_the_end = round(OUTAGE[1] / BLOCK_S) - 1
    by_trace, by_eq13 = (
        [float(one[NO_RESET].by_trace[at_the_end]) for one in flown],
        [float(one[NO_RESET].by_eq13[at_the_end]) for one in flown],
    )
    gap, share = "1000 s of outage, largest error", "weight of the transponder's filter at the end of it"
    for name, which, worst in (("frkf", "worst seed", True), (NO_RESET, "no reset", False)):
        for what, column, paper in (("latitude", P_N, 17.57), ("longitude", P_E, 18.68)):
            found = lost(name, (column,))
            quantity = f"{gap} of {what}, {which}"
            yield Claim(quantity, "m", f"{paper:.1f}", found, 20.0, statistic=NEARLY_ALL if worst else MEDIAN)
    yield Claim(f"{gap} of the log's filter alone", "m", "81.5", lost("rkf_dvl", HORIZONTAL), 81.53)
    yield Claim(
        "error of the transponder's filter alone at the end of it", "m", "225",
        lost("rkf_ast", HORIZONTAL, OUTAGE[1]), 100.0, at_least=True,
    )  # fmt: skip
    yield Claim(f"{share}, by the traces", "", "—", by_trace, 0.05)
    yield Claim(
        f"{share}, by equation 13", "", "→ 0", by_eq13, 0.15, at_least=True,
        note="it adds (rad/s)^-4 to m^-4: the gyro biases alone decide, and a lost position doesn't count",
    )  # fmt: skip
    yield Claim(
        f"{gap} with the weights of equation 13", "m", "18.7", lost(EQ13, HORIZONTAL), 20.0, at_least=True,
        note="a filter that is lost keeps such a weight",
    )  # fmt: skip


def _clean_claims(flown: Sequence[Mapping[str, Flown]]) -> Iterator[Claim]:
    """What inflation costs where nothing is wrong."""
    for what, columns in (("position", HORIZONTAL), ("velocity", (V_N, V_E))):
        loss = [_loss(one["frkf"], one["tfkf"], columns) for one in flown]
        yield Claim(f"sound Gaussian data: RMS of {what}, loss by inflation", "%", "—", loss, 2.0)


def _solver_claims(solved: Sequence[Mapping[str, float]]) -> Iterator[Claim]:
    """Equation 12: put right, on the reciprocal, and as printed."""

    def of(key: str) -> list[float]:
        return [one[key] for one in solved]

    yield Claim(f"iterations for lambda, most of {CASES}", "", "—", of("newton"), 17.0)
    yield Claim("the same on the reciprocal", "", "—", of("reciprocal"), 5.0)
    yield Claim("distance after inflation, off its limit by", "", "—", of("off"), 1e-5)
    yield Claim(
        "equation 12 as printed: outliers whose lambda it finds within 1 %", "%", "all", of("near"), 5.0,
        note="its fraction is upside down: steps too small for a gross error, too large for a slight one",
    )  # fmt: skip


# --- figure

ROWS = (
    (P_N, "latitude error [m]"),
    (P_E, "longitude error [m]"),
    (V_N, "v$_N$ error [m/s]"),
    (V_E, "v$_E$ error [m/s]"),
)
SHOWN = np.arange(0, 3601, 10)  # [s]
ALONE = (
    ("rkf_ast", "transponder alone", COLOURS[1]),
    ("rkf_dvl", "log alone", COLOURS[2]),
    ("frkf", "federated", COLOURS[0]),
    (NO_RESET, "federated, no reset", COLOURS[3]),
)


def draw(results: Sequence[Any], out: Path) -> None:
    """Errors of both filters with wrong fixes (log every 30 s), and what the outage does. First seed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    seeds = len(results) // len(RUNS)
    first = {run: results[k * seeds] for k, run in enumerate(RUNS)}
    figure = Figure(figsize=(11.0, 7.6), dpi=78, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(4, 2, height_ratios=(1, 1, 1, 1))
    _draw_river(panels[:, 0], first["30 s"])
    _draw_outage(panels[:3, 1], first["outage"])
    for ax in (*panels[:, 0], *panels[:3, 1]):
        ax.set_xlim(0, 3600)
        ax.set_xlabel("time [s]" if ax in (panels[3, 0], panels[2, 1]) else "")
    _draw_bars(panels[3, 1], first["outage"])
    for ax in panels.flat:
        ax.grid(alpha=0.35, lw=0.6)
        ax.spines[["top", "right"]].set_visible(False)
    image = io.BytesIO()
    figure.savefig(image, format="png")
    write_result(out / "zhu2020.png", image.getvalue())


def _draw_river(panels: Sequence[Axes], river: Mapping[str, Flown]) -> None:
    """Errors of both filters, and when the fixes are wrong."""
    for ax, (column, label) in zip(panels, ROWS, strict=True):
        for name, text, colour in (("tfkf", "traditional", COLOURS[1]), ("frkf", "robust", COLOURS[0])):
            ax.plot(SHOWN, river[name].error[SHOWN, column], color=colour, lw=0.9, label=text)
        top = ax.get_xaxis_transform()
        flags = np.full(len(OUTLIERS), 0.97)
        ax.plot(OUTLIERS, flags, "v", color="black", ms=3.5, transform=top, label="fix 500 m wrong")
        ax.set_ylabel(label)
        ax.set_ylim(*((-15, 60) if column in (P_N, P_E) else (-0.15, 0.2)))
    panels[0].set_title("Fixes 500 m wrong every 150 s, log every 30 s", fontsize=10)
    panels[0].legend(loc="upper right", bbox_to_anchor=(1, 0.97), ncols=3, fontsize=8, frameon=False)


def _draw_outage(panels: Sequence[Axes], outage: Mapping[str, Flown]) -> None:
    """Errors of each filter alone and of both, and what the lost one counts for."""
    for ax, (column, label) in zip(panels[:2], ROWS, strict=False):
        for name, text, colour in ALONE:
            ax.plot(SHOWN, outage[name].error[SHOWN, column], color=colour, lw=1.1, label=text)
        ax.set_ylabel(label)
        ax.set_ylim(-100, 60)
    panels[0].set_title("No fix from 1500 s to 2500 s", fontsize=10)
    panels[0].legend(loc="lower left", fontsize=7.5, frameon=False)
    weights, ax = outage[NO_RESET], panels[2]
    t = BLOCK_S * (1 + np.arange(len(weights.by_trace)))
    ax.plot(t, weights.by_trace, color=COLOURS[0], lw=1.3, label="by the traces of position and velocity")
    ax.plot(t, weights.by_eq13, color="black", lw=1.3, ls="--", label="by equation 13 as printed")
    ax.set_ylabel("weight of transponder")
    ax.set_ylim(0, 1)
    ax.legend(loc="upper left", fontsize=8, frameon=False)
    for ax in panels:
        ax.axvspan(*OUTAGE, color=SHADE, lw=0, zorder=0)


PAPER_TABLE_3 = {
    "rkf_ast": (25.13, 225.30),
    "rkf_dvl": (81.53, 62.27),
    "frkf": (17.57, 18.68),
}  # latitude, longitude [m]


def _draw_bars(ax: Axes, outage: Mapping[str, Flown]) -> None:
    """Largest errors of the outage, latitude and longitude, beside those of Table 3."""
    for k, (name, _, colour) in enumerate(ALONE):
        for i, column in enumerate((P_N, P_E)):
            x, value = k + 0.36 * i - 0.18, _largest(outage[name], (column,), *OUTAGE)
            ax.bar(x, value, 0.32, color=colour)
            ax.annotate("lat" if i == 0 else "lon", (x, 1.1), ha="center", fontsize=7, color="white")
            if name in PAPER_TABLE_3:
                ax.plot(
                    x, PAPER_TABLE_3[name][i], "D", color="black", ms=4, label="the paper's" if k + i == 0 else None
                )
    ax.set_yscale("log")
    ax.set_ylim(1, 1000)
    ax.set_xticks(range(len(ALONE)), [text for _, text, _ in ALONE], fontsize=8)
    ax.set_ylabel("largest error [m]")
    ax.legend(loc="upper right", fontsize=8, frameon=False)


PAPER = Paper(
    "Zhu et al. 2020: a robust federated filter under water",
    ("zhu2020.png",),
    lambda draws: [*(Job(fly, (run, seed)) for run in RUNS for seed in draws.seeds), Job(solve, (1,))],
    conclude,
    draw,
)
