"""Cui et al. 2022: fault-tolerant federated filter of SINS, GPS, Doppler radar and star tracker.

Straight flight of 1200 s with the six faults of table 2, and without any. Flights carry the federation with and without
star tracker, judged by ERAIM, and one with it that is judged by the GLR. How near one can come is measured as well:
with a single Kalman filter of all sensors and the same states, which is told of the faults.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.stats import poisson

from nav.detection import Detector, Eraim, Glr, chi_square_threshold
from nav.earth import position_difference_n
from nav.horizon import FusionHorizon
from nav.ins import Ins
from nav.samples import Array, Estimate, Outcome
from testbed import sensors
from testbed.estimators import registry
from testbed.estimators.federated import FederatedSection
from testbed.estimators.ins import InsSection
from testbed.feeds.known import handed_over
from testbed.feeds.simulated import motion
from testbed.loop.loop import run
from testbed.motion.table import TruthBlock
from testbed.papers import Job, Paper, scenario
from testbed.papers.claims import HARDLY_ANY, NEARLY_ALL, Claim
from testbed.papers.draws import Draws
from testbed.report.style import AXIS_COLOURS, COLOURS, FAULT
from testbed.results import write_result
from testbed.score import accuracy, detection
from testbed.score.accuracy import column

if TYPE_CHECKING:
    import xarray

NAME = "cui2022"
FEW = 2  # every second flight carries more than one estimator
HEALTHY = ("fault=[]",)
CARRIED = {(): ("with_star", "without_star", "glr"), HEALTHY: ("with_star", "glr")}  # by overrides
FALSE_ALARM = 1e-5  # per measurement: table 1
AFTER_S = 60.0
REPLAYS = 1000
SMALL_STEP = (300.0, 330.0)  # that of GPS velocity: 0.3 m/s, one sigma
COLOURS_KEPT = 48  # of the figure: dots of many shades make it four times as large
ARCSEC_PER_RAD = 180 * 3600 / np.pi
AXES = {
    "position": ("north", "east", "down"),
    "velocity": ("north", "east", "down"),
    "attitude": ("roll", "pitch", "heading"),
}
UNITS = {"position": "m", "velocity": "m/s", "attitude": "arcsec"}
BOUNDS = {"position": (10.0, 6.0), "velocity": (0.5, 0.1), "attitude": (50.0, 5.0)}  # the paper's, and better ones
FIGURES = {"position": (10.0, 10.0, 10.0), "velocity": (0.5, 0.1, 0.2), "attitude": (50.0, 10.0, 5.0)}  # in its figures
NO_WORSE = 1.25  # than the optimal filter
PARTS = {"gnss_position": "GPS position", "gnss_velocity": "GPS velocity", "body_velocity": "Doppler",
         "star_attitude": "star"}  # fmt: skip

Result: TypeAlias = dict[str, Any]
CHANNELS = {"north": ("gnss_position", 0), "east": ("gnss_position", 1), "down": ("gnss_position", 2),
            "v_north": ("gnss_velocity", 0), "v_east": ("gnss_velocity", 1),
            "forward": ("body_velocity", 0)}  # fmt: skip


def fly(seed: int, overrides: tuple[str, ...], names: tuple[str, ...], series: bool) -> Result:
    """One run: by estimator the largest errors and its scores; with ``series`` what the figure shows as well."""
    chosen = scenario(NAME, overrides)
    flown = tuple(one for one in chosen.estimator if one.name in names)
    done = run(chosen.model_copy(update={"estimator": flown}), seed=seed)
    tree = done.dataset
    faulty = bool(detection.faults(tree))
    replayed = _replayed(tree, Glr(FALSE_ALARM))
    result: Result = {"faulty": faulty, "glr_on_residuals": _scored(*replayed[:2], SMALL_STEP)}
    for name in accuracy.names(tree):
        t, errors = _errors(tree, name)
        result[name] = {
            "largest": _largest(t, errors),
            "heading_at_end": abs(float(errors["attitude"][-1, 2])),
            "scores": {
                key.split(".", 1)[1]: value for key, value in done.metrics.items() if key.startswith(f"{name}.")
            },
            "refused": _refused(tree, name),
        }
        if series:
            result[name] |= {"t": t, "errors": errors}
    if faulty:
        result["kept"] = _kept(tree)
    if series:
        result["faults"] = [(f.sensor, f.start, f.end) for f in detection.faults(tree)]
        result["measurements"] = {part: _measurements(tree, "with_star", part)[:2] for part in PARTS}
        result["glr_statistic"] = replayed[0], *replayed[2:]
    return result


@dataclass(frozen=True)
class KnownFaults:
    """A measurement policy that leaves out what it was told is wrong: (axis, from, to) of one kind of measurement."""

    wrong: tuple[tuple[int, float, float], ...]

    def adapt(self, nu: Array, S: Array, R: Array, t: float) -> Array:
        """See `nav.weighting.Policy`."""
        out = [axis for axis, start, end in self.wrong if start <= t + accuracy.SAME_TIME_S < end]
        told = R.copy()
        told[out] = np.inf
        return told


def floor(seed: int) -> dict[str, dict[str, list[float]]]:
    """Largest errors of the optimal filter that is told of the faults, and of it where there are none.

    One Kalman filter with every sensor and no gate, of the states, noise and initial errors of ``with_star``. What is
    wrong it never uses, so the flight may be one without faults.
    """
    chosen = scenario(NAME, HEALTHY)
    federated = next(one for one in chosen.estimator if one.name == "with_star")
    assert isinstance(federated, FederatedSection)
    same = ("name", "imu", "states", "turn_degps", "gust_mps", "handover", "nonholonomic_mps")
    aids = tuple(aid for local in federated.locals for aid in local.aids)
    alone = InsSection(aids=aids, false_rejection=0.0, **{key: getattr(federated, key) for key in same})
    chosen = chosen.model_copy(update={"estimator": (alone,)})
    truth = motion(chosen, seed).advance(round(chosen.duration_s * chosen.truth.rate_hz) + 1)
    sensed: dict[str, Any] = {
        name: sensors.build(name, config, chosen.truth.rate_hz, seed, chosen.site()).sense(truth)
        for name, config in chosen.sensors.items()
    }
    wrong: dict[str, list[tuple[int, float, float]]] = {}
    for fault in scenario(NAME).fault:
        part, axis = CHANNELS[fault.channel]  # type: ignore[union-attr, index]
        wrong.setdefault(part, []).append((axis, *fault.window))
    told = {part: KnownFaults(tuple(windows)) for part, windows in wrong.items()}
    t = np.arange(0.0, chosen.duration_s + 0.5)
    largest = {}
    for when, policies in (("six faults", told), ("no fault", None)):
        built = registry.build(chosen.estimator, chosen.rig(seed))["with_star"]
        assert isinstance(built.horizon.estimator, Ins)
        assert built.handover is not None
        ins = Ins(built.horizon.estimator.config, policies=policies)
        ins.start(handed_over(built.handover, truth))
        handed = [sample for aid in built.sensors for sample in sensed[aid]]
        _, estimates = FusionHorizon(ins).track(built.increments(sensed)[0], handed, t.tolist())
        largest[when] = _largest(t, _differences(estimates, truth, np.searchsorted(truth.t, t - accuracy.SAME_TIME_S)))
    return largest


def _largest(t: Array, errors: dict[str, Array]) -> dict[str, list[float]]:
    """The largest error of each axis after a minute."""
    return {what: np.abs(e[t >= AFTER_S]).max(axis=0).tolist() for what, e in errors.items()}


def _differences(estimates: Sequence[Estimate], truth: TruthBlock, rows: npt.NDArray[np.intp]) -> dict[str, Array]:
    """The same as `_errors` from estimates (N,), ``rows`` (N,) of truth being at their times."""
    lat, lon, h = np.array([(e.lat, e.lon, e.h) for e in estimates]).T
    q_nb, true = np.array([e.q_nb for e in estimates]), truth.q_nb[rows]
    attitude = accuracy.euler(q_nb) - accuracy.euler(true)
    attitude[:, 2] = accuracy.attitude_error(q_nb, true)[:, 2]
    return {
        "position": position_difference_n(lat, lon, h, truth.lat[rows], truth.lon[rows], truth.h[rows]),
        "velocity": np.array([e.v_n for e in estimates]) - truth.v_n[rows],
        "attitude": attitude * ARCSEC_PER_RAD,
    }


def _errors(tree: xarray.DataTree, name: str) -> tuple[Array, dict[str, Array]]:
    """Times (N,) and errors (N, 3) of position [m], velocity [m/s], roll, pitch and heading [arcsec]."""
    e = accuracy.errors(tree, name)
    attitude = np.column_stack([e.angles[:, :2], e.attitude[:, 2]]) * ARCSEC_PER_RAD
    return e.t, {"position": e.position, "velocity": e.velocity, "attitude": attitude}


def _measurements(tree: xarray.DataTree, name: str, part: str) -> tuple[Array, Array, Array, Array]:
    """Of the measurements of one part the times, the chi-square statistics, the weights and the outcomes, each (N,)."""
    own = f"estimators/{name}/innovations/{part}"
    t, nis, weight, outcome = (column(tree, f"{own}/{key}") for key in ("sample_time", "nis", "weight", "outcome"))
    return t, nis, weight, outcome


def _refused(tree: xarray.DataTree, name: str) -> tuple[int, int, int]:
    """How many measurements of a run had an axis refused, how many an axis isolated, and how many there were."""
    measurements = [_measurements(tree, name, part)[2:] for part in accuracy.aids(tree, name)]
    refused = sum(int(np.sum(weight < 1)) for weight, _ in measurements)
    isolated = sum(int(np.sum(outcome == Outcome.ISOLATED)) for _, outcome in measurements)
    return refused, isolated, sum(len(w) for w, _ in measurements)


def _kept(tree: xarray.DataTree) -> float:
    """Share of the two sound axes of GPS position that were used while the third was refused."""
    t, _, weight, _ = _measurements(tree, "with_star", "gnss_position")
    windows = [(f.start, f.end) for f in detection.faults(tree) if f.channel in ("east", "north", "down")]
    return float(np.mean(weight[accuracy.inside(t, windows) & (weight < 1)])) * 3 / 2


def _replayed(tree: xarray.DataTree, detector: Detector) -> tuple[Array, accuracy.Mask, Array, Array]:
    """Times, alarms, statistics and thresholds, each (N,), of a detector on the residuals of GPS velocity.

    They are those that the filters with ERAIM met around the small step, which ERAIM let through.
    """
    own = "estimators/with_star/innovations/gnss_velocity"
    t, nu, S = (column(tree, f"{own}/{key}") for key in ("sample_time", "innovation", "S"))
    rows = np.flatnonzero((t >= 200) & (t < 400))
    decisions = [detector.step(nu[k], S[k], float(t[k])) for k in rows]
    return (
        t[rows], np.array([d.alarm for d in decisions]),
        np.array([d.statistic for d in decisions]), np.array([d.threshold for d in decisions]),
    )  # fmt: skip


def _scored(t: Array, alarm: accuracy.Mask, window: accuracy.Window) -> tuple[float, float]:
    """Delay [s], NaN without an alarm in the window, and coverage."""
    score = detection.detection(t, alarm, window)
    assert score is not None
    return score.delay, score.coverage


def replay(kind: Callable[[float], Detector], count: int) -> list[float]:
    """Delays of a detector on white residuals of three axes, 60 sound samples and 30 with one sigma more on one."""
    random = np.random.default_rng(2022)
    t, window = np.arange(90.0), (60.0, 90.0)
    delays = []
    for _ in range(count):
        nu = random.standard_normal((len(t), 3))
        nu[60:, 1] += 1.0
        detector = kind(FALSE_ALARM)
        alarm = np.array([detector.step(v, np.eye(3), when).alarm for v, when in zip(nu, t, strict=True)])
        delays.append(_scored(t, alarm, window)[0])
    return delays


def jobs(draws: Draws) -> list[Job]:
    """Two replays on white residuals, what no filter could better, then runs with and without faults."""
    replays = [Job(replay, (kind, REPLAYS)) for kind in (Eraim, Glr)]
    floors = [Job(floor, (seed,)) for seed in draws.seeds]
    flights = [
        Job(fly, (seed, overrides, carried if k % FEW == 0 else ("with_star",), overrides == () and k == 0))
        for overrides, carried in CARRIED.items()
        for k, seed in enumerate(draws.seeds)
    ]
    return [*replays, *floors, *flights]


def conclude(results: Sequence[Any]) -> list[Claim]:
    """What the paper claims of detection, accuracy and false alarms."""
    snapshot, gathered, *flown = results
    floors, runs = [r for r in flown if "faulty" not in r], [r for r in flown if "faulty" in r]
    faulty, healthy = [r for r in runs if r["faulty"]], [r for r in runs if not r["faulty"]]
    starless = [r for r in faulty if "without_star" in r]
    return [
        *_detection_claims(faulty),
        *_small_step_claims(snapshot, gathered, faulty),
        *_accuracy_claims("with_star", faulty, "six faults", floors),
        *_accuracy_claims("with_star", healthy, "no fault", floors),
        *_accuracy_claims("without_star", starless, "six faults, no star tracker"),
        Claim("heading error at 1200 s, six faults, no star tracker", "arcsec", "50",
              [r["without_star"]["heading_at_end"] for r in starless], 50.0),
        *_false_alarm_claims(healthy),
    ]  # fmt: skip


def _scores(runs: Sequence[Result], name: str, key: str) -> list[float]:
    """One score of every run, NaN where there is none."""
    return [r[name]["scores"].get(key, float("nan")) for r in runs]


def _detection_claims(faulty: Sequence[Result]) -> list[Claim]:
    instant = [
        Claim(f"detection delay, {what}", "s", "no delay", _scores(faulty, "with_star", f"detection_delay_s.{fault}"),
              0.0, statistic=NEARLY_ALL)
        for fault, what in (("longitude", "longitude step"), ("height", "height step"),
                            ("doppler_velocity", "Doppler step"))
    ]  # fmt: skip
    latitude, ramp = (
        _scores(faulty, "with_star", f"detection_delay_s.{fault}") for fault in ("latitude", "north_velocity")
    )
    slow = "the drift is below 3 sigma of GPS for 6 s: one measurement in nine shows it after 7 s, and 86 % after 9 s"
    steep = "it passes 5 sigma after 3 s: 54 % of measurements show it then, and 96 % after 4 s"
    drifts = [
        Claim("detection delay, latitude drift", "s", "no delay", latitude, 10.0, statistic=NEARLY_ALL, note=slow),
        Claim("detection delay, north velocity ramp, median", "s", "no delay", ramp, 4.0, note=steep),
        Claim("detection delay, north velocity ramp, any flight", "s", "no delay", ramp, 5.0, statistic=NEARLY_ALL,
              note=steep),
    ]  # fmt: skip
    found = [fault for fault in ("longitude", "latitude", "doppler_velocity", "height", "north_velocity")]
    isolated = [min(r["with_star"]["scores"][f"isolation_correct.{fault}"] for fault in found) for r in faulty]
    back = [max(r["with_star"]["scores"][f"end_lag_s.{fault}"] for fault in found) for r in faulty]
    return [
        *instant,
        *drifts,
        Claim("the right sensor isolated, those five", "", "yes", isolated, 1.0, at_least=True, statistic=HARDLY_ANY),
        Claim("in full use again after a fault's end", "s", "not said", back, 3.0, statistic=NEARLY_ALL),
        Claim("sound axes of a partly failed GPS in use", "", "not said", [r["kept"] for r in faulty], 0.99,
              at_least=True, statistic=HARDLY_ANY),
    ]  # fmt: skip


def _small_step_claims(snapshot: Sequence[float], gathered: Sequence[float], faulty: Sequence[Result]) -> list[Claim]:
    what = "0.3 m/s east velocity step found"
    because = "a measurement of one sigma passes the limit of 1e-5 once in 9000: 0.3 % of the 30 s steps are ever seen"
    evidence = "its 30 samples hold 15 nats of evidence at most, less what the filter learns of the step, against 15.9"
    delays = [d for d in gathered if np.isfinite(d)]
    in_flight = [1.0 - r["glr"]["scores"]["missed.east_velocity"] for r in faulty if "glr" in r]
    on_residuals = [float(np.isfinite(r["glr_on_residuals"][0])) for r in faulty]
    covered = np.array(_scores(faulty, "with_star", "coverage.east_velocity"))
    seen = float(np.mean(np.where(np.isnan(covered), np.nan, covered > 0)))
    return [
        Claim(f"{what} by ERAIM, share of flights", "", "no delay", [seen], 0.0, note=because),
        Claim(f"{what} by ERAIM, share of {len(snapshot)} replays", "", "no delay", [_share(snapshot)], 0.02,
              note=because),
        Claim(f"{what} by GLR, share of {len(gathered)} replays", "", "–", [_share(gathered)], 0.5, at_least=True),
        Claim(f"{what} by GLR, delay where it is, replays", "s", "–", delays, 30.0),
        Claim(f"{what} by GLR on ERAIM's residuals, share of flights", "", "–", [float(np.mean(on_residuals))], 0.1,
              at_least=True, note=evidence),
        Claim(f"{what} by filters with GLR, share of flights", "", "–", [float(np.mean(in_flight))], 0.1,
              at_least=True, note=evidence),
    ]  # fmt: skip


def _share(delays: Sequence[float]) -> float:
    return float(np.mean(np.isfinite(delays)))


def _accuracy_claims(
    name: str, runs: Sequence[Result], when: str, floors: Sequence[dict[str, dict[str, list[float]]]] = ()
) -> list[Claim]:
    """Largest error after a minute by axis, of the median flight; with ``floors``, those of the optimal filter, it
    must keep the better bounds, and the worst flight too or be next to the optimal filter's.
    """
    claims = []
    for what, (bound, better) in BOUNDS.items():
        largest = np.array([r[name]["largest"][what] for r in runs])
        for k, axis in enumerate(AXES[what]):
            label = f"largest error after 60 s, {axis} {what if what != 'attitude' else ''}".strip()
            blind = axis == "heading" and not floors
            because = (
                "the 120 arcsec at the start show in GPS only when the speed changes: 0.3 m/s of noise over the "
                "100 m/s gained" if blind else ""
            )  # fmt: skip
            claims.append(
                Claim(f"{label}, {when}", UNITS[what], f"{bound:g}", largest[:, k].tolist(),
                      120.0 if blind else better if floors else bound, note=because)
            )  # fmt: skip
        if floors:
            of_all, least = largest.max(axis=1), np.array([one[when][what] for one in floors]).max(axis=1)
            label = f"largest error after 60 s, {what}, any axis"
            claims.append(_any_flight_claim(label, what, when, of_all, least))
            ratio = (of_all / least).tolist()
            claims.append(Claim(f"{label}, {when}, over that of the optimal filter", "", "–", ratio, NO_WORSE))
    if floors:
        within = [all(np.all(np.less(r[name]["largest"][what], most)) for what, most in FIGURES.items()) for r in runs]
        what = f"share of flights within every figure of the paper by axis, {when}"
        claims.append(Claim(what, "", "1 flight", [float(np.mean(within))], 0.9, at_least=True))
    return claims


def _any_flight_claim(label: str, what: str, when: str, ours: Array, least: Array) -> Claim:
    """The worst flight against the better bound; where the optimal filter breaks it too, next to its worst flight."""
    paper, bound = BOUNDS[what]
    because, kept = "", bound
    if np.max(least) > bound:
        kept = NO_WORSE * float(np.max(least))
        optimal = "the optimal filter, told of the faults," if when == "six faults" else "the optimal filter"
        because = (
            f"{optimal} has up to {np.max(least):.2g}, more than {bound:g} in {np.sum(least > bound)} of {len(least)}"
        )
    return Claim(f"{label}, any flight, {when}", UNITS[what], f"{paper:g}", ours.tolist(), kept, statistic=NEARLY_ALL,
                 note=because)  # fmt: skip


def _false_alarm_claims(healthy: Sequence[Result]) -> list[Claim]:
    refused, isolated, measurements = np.array([r["with_star"]["refused"] for r in healthy]).T
    expected = FALSE_ALARM * measurements.sum()
    by_glr = np.array([r["glr"]["refused"] for r in healthy if "glr" in r])
    return [
        Claim("measurements while a sensor was isolated in 1200 s without fault", "", "none", isolated.tolist(), 0.0,
              statistic=NEARLY_ALL),
        Claim("measurements refused in 1200 s without fault", "", "none", refused.tolist(), 0.0),
        Claim(f"measurements refused in {len(healthy)} flights without fault", "", "none", [float(refused.sum())],
              float(poisson.ppf(0.95, expected)),
              note=f"table 1 allows 1e-5 of the {measurements.sum()} measurements: {expected:.2f} are expected"),
        Claim(f"flights of {len(by_glr)} in which GLR refused a measurement without fault", "", "–",
              [float(np.sum(by_glr[:, 0] > 0))], float(poisson.ppf(0.95, FALSE_ALARM * by_glr[:, 2].sum()))),
    ]  # fmt: skip


def draw(results: Sequence[Any], out: Path) -> None:
    """The first faulty flight: errors on the left, what each detector saw on the right, the faults shaded."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    first = next(r for r in results if isinstance(r, dict) and "measurements" in r)
    figure = Figure(figsize=(10.5, 7.4), dpi=90, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(4, 2, sharex=True)
    rows = [
        ("with_star", "position"),
        ("with_star", "velocity"),
        ("with_star", "attitude"),
        ("without_star", "attitude"),
    ]
    for ax, (name, what) in zip(axes[:, 0], rows, strict=True):
        t, error = first[name]["t"], first[name]["errors"][what]
        for k, axis in enumerate(AXES[what]):
            ax.plot(t, error[:, k], color=AXIS_COLOURS[k], lw=0.9, label=axis)
        most = 1.15 * np.abs(error[t >= AFTER_S]).max()
        ax.set(ylim=(-most, most), ylabel=f"{what} error [{UNITS[what]}]")
        for _, start, end in first["faults"]:
            ax.axvspan(start, end, color=FAULT, lw=0)
        ax.set_title("without star tracker" if name == "without_star" else "", fontsize=9, loc="left", pad=3)
        ax.legend(loc="upper right", ncols=3, fontsize=8, frameon=False, borderaxespad=0.1)
    sensor = {
        "gnss_position": "gps",
        "gnss_velocity": "gps",
        "body_velocity": "doppler",
        "star_attitude": "star_tracker",
    }
    for ax, (part, label) in zip(axes[:, 1], PARTS.items(), strict=True):
        t, nis = first["measurements"][part]
        ax.semilogy(t, np.maximum(nis, 0.01), ".", ms=1.8, color=COLOURS[0], label="ERAIM")
        ax.axhline(chi_square_threshold(FALSE_ALARM, 3), color=COLOURS[1], lw=1)
        if part == "gnss_velocity":
            t, statistic, threshold = first["glr_statistic"]
            ax.semilogy(t, np.maximum(statistic, 0.01), color=COLOURS[2], lw=1, label="GLR around the small step")
            ax.semilogy(t, threshold, color=COLOURS[2], lw=1, ls="--")
            ax.legend(loc="upper left", ncols=2, fontsize=8, frameon=False, borderaxespad=0.1, markerscale=3)
        for name, start, end in first["faults"]:
            if name == sensor[part]:
                ax.axvspan(start, end, color=FAULT, lw=0)
        ax.set(ylabel=f"{label}: statistic", ylim=(0.05, 3e4))
    for ax in axes.flat:
        ax.grid(alpha=0.35, lw=0.6)
        ax.spines[["top", "right"]].set_visible(False)
        ax.set_xlim(0, 1200)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    axes[0, 0].set_title("federated filter, faults shaded", fontsize=9, loc="left", pad=3)
    axes[0, 1].set_title("detection statistic and limit, faults of the sensor shaded", fontsize=9, loc="left", pad=3)
    drawn, content = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn)
    Image.open(drawn).convert("RGB").quantize(COLOURS_KEPT).save(content, "png")
    write_result(out / f"{NAME}.png", content.getvalue())


PAPER = Paper(
    "Cui et al. 2022: fault-tolerant federated SINS, GPS, Doppler and star tracker",
    ("cui2022.png",),
    jobs,
    conclude,
    draw,
)
