"""Cheng et al. 2020: heading on the road from GNSS course, with a turn rule and an adaptive unscented filter.

`scenarios/papers/cheng2020.toml` holds the assumptions. The paper runs it for 3 h, and so does one job; what is asked
of every seed is in the first 1000 s: two stops, two turns and the beginning of the straight after the third.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nav.earth import OMEGA_IE, gravity, radii
from nav.error_model import PAPERS, ErrorModel, ImuModel, Indices
from nav.observability import Segment, analyse, continuous, derivatives, in_units, stripped
from nav.rotation import quat_from_euler
from nav.samples import Array
from testbed.loop.loop import run
from testbed.papers import Job, Paper, scenario
from testbed.papers.claims import HARDLY_ANY, NEARLY_ALL, Claim
from testbed.papers.draws import Draws
from testbed.results import write_result
from testbed.scenario import Scenario
from testbed.score import accuracy

SHORT_S, LONG_S, STRAIGHT_S = 1000, 10_800, 300
SETTLED_S = 300.0  # from here on the paper's figures are to hold
DRIFT_DEG = 3.0  # of the scenario's turns
KAPPA = math.radians(2.0)
AFTER_TURN_S = 10
NOISIER_S, LEARNED_S = 400, 200  # when the receiver gets worse, and how many samples there are to find out
THREE_SIGMA = 0.9973  # of a normal error that lies within three sigma
NO_WORSE = 1.05  # than the filter that is told the variances, at most

_MORE_NOISE = ", ".join(
    f'{{ sensor = "gnss", channel = "{channel}", kind = "noise", factor = 2, window = [{NOISIER_S}, {LONG_S}] }}'
    for channel in ("north", "east", "down", "v_north", "v_east", "v_down")
)


def selected(estimators: Sequence[str], overrides: Sequence[str] = ()) -> Scenario:
    """The scenario with these of its estimators."""
    whole = scenario("cheng2020", overrides)
    return whole.model_copy(update={"estimator": tuple(one for one in whole.estimator if one.name in estimators)})


def road(seed: int, duration_s: int, estimators: Sequence[str], series: bool = False) -> dict[str, Any]:
    """One run: what each of the estimators made of it; with ``series`` what the figure shows as well. Angles in deg."""
    dataset = run(selected(estimators, [f"duration_s={duration_s}"]), seed=seed).dataset
    t = accuracy.column(dataset, "truth/time")
    rate = np.abs(accuracy.column(dataset, "truth/omega_b")[:, 2])
    speed = np.linalg.norm(accuracy.column(dataset, "truth/v_n"), axis=1)
    turning = rate > KAPPA
    near_turn = np.convolve(turning, np.ones(AFTER_TURN_S + 1))[: len(t)] > 0
    first_turn = t[np.argmax(turning)]
    result: dict[str, Any] = {}
    for name in estimators:
        e = accuracy.errors(dataset, name, 0.0)
        heading, level = np.degrees(e.attitude[:, 2]), np.degrees(e.attitude[:, :2])
        settled, turned = e.t > SETTLED_S, e.t > first_turn + AFTER_TURN_S
        own = f"estimators/{name}/innovations"
        learned = {
            aid: 1 / accuracy.column(dataset, f"{own}/{aid}/weight") for aid in accuracy.aids(dataset, name)
        }  # of R, to what was told
        result[name] = {
            "heading_straight": _largest(heading[settled & ~near_turn]),
            "heading_turn": _largest(heading[settled & near_turn]),
            "level_before": _largest(level[e.t < first_turn]),
            "level_rms": _rms(level[turned]),
            "level_nearly_all": float(np.quantile(np.abs(level[turned]), THREE_SIGMA)),
            "velocity": float(np.quantile(np.abs(e.velocity[settled, :2]), THREE_SIGMA)),
            "position_rms": _rms(e.position[settled, :2]),
            "position_largest": _largest(e.position[settled, :2]),
            "least_R": float(min(ratio.min() for ratio in learned.values())),
        }
        if "gnss_course" in learned:
            at = np.searchsorted(t, accuracy.column(dataset, f"{own}/gnss_course/sample_time") - accuracy.SAME_TIME_S)
            result[name] |= {"course_looks": len(at), "course_amiss": int(np.sum(turning[at] | (speed[at] < 1.0)))}
        if series:
            result[name] |= {"t": e.t.tolist(), "heading": heading.tolist(), "level": level.tolist()}
    result["turns"] = t[turning & ~np.roll(turning, 1)].tolist()
    return result


def noisier(seed: int) -> dict[str, float]:
    """By how much the learned variance is off, some samples after the receiver's became four times as large."""
    end = NOISIER_S + LEARNED_S
    dataset = run(selected(["improved"], [f"duration_s={end + 1}", f"fault=[{_MORE_NOISE}]"]), seed=seed).dataset
    off = {}
    for aid in ("gnss_position", "gnss_velocity"):
        own = f"estimators/improved/innovations/{aid}"
        last = np.searchsorted(accuracy.column(dataset, f"{own}/sample_time"), end)
        off[aid] = abs(1 / float(accuracy.column(dataset, f"{own}/weight")[last]) / 4 - 1)
    return off


def straight(seed: int) -> tuple[float, float]:
    """Heading error [deg] of a filter without course after a straight, and its own sigma relative to the initial."""
    overrides = [
        f"duration_s={STRAIGHT_S}",
        "truth.start.speed_mps=3",
        'truth.segments=[{ leg = "straight", duration_s = 1e4 }]',
    ]
    e = accuracy.errors(run(selected(["no_course"], overrides), seed=seed).dataset, "no_course", 0.0)
    sigma = e.sigma_attitude[:, 2]
    return math.degrees(e.attitude[-1, 2]), float(sigma[-1] / sigma[0])


def table_1() -> dict[str, Any]:
    """The singular values of Table 1 by column, and the ranks: of the paper's states, at rest at its start.

    Values are over that of the measured state, dV or dp itself and dV for the rest where both are measured. ``radians``
    are dV_E, over dL, and the smaller eps of a level gyro when the fix is in metres north but in radians east.
    """
    start = scenario("cheng2020").truth.start
    assert start is not None  # a log's may be
    lat = math.radians(start.lat_deg)
    model = ErrorModel(ImuModel(1e-4, 1e-3, 1e-4, 0.05))
    places = model.places(PAPERS["cheng2020"])
    at = {name: np.flatnonzero((places >= where.start) & (places < where.stop)) for name, where in model.slices.items()}
    dv, dp, phi, nabla, eps = (at[name] for name in ("dv", "dp", "phi", "accel_bias", "gyro_bias"))

    def segment(heading: float, rows: Indices) -> Segment:
        q_nb, f_b = quat_from_euler(0.0, 0.0, heading), np.array([0.0, 0.0, -gravity(lat, 0.0)])
        F = continuous(model, q_nb, np.zeros(3), np.array([lat, 0.0, 0.0]), f_b, np.zeros(3))
        return Segment(F[np.ix_(places, places)], np.eye(len(places))[rows], 60.0)

    both = np.concatenate([dv, dp])
    every = np.append(both, phi[2])
    matrices = {
        name: derivatives(segment(0.0, rows)) for name, rows in (("velocity", dv), ("position", dp), ("both", both))
    }
    found: dict[str, Any] = {}
    for column, Q in matrices.items():
        degree = analyse(Q, 1e-8).degree
        rest = degree / degree[dp[0] if column == "position" else dv[0]]
        found[column] = {
            "dv": rest[dv].tolist(),
            "dp": (degree[dp] / degree[dp[0]]).tolist() if column != "velocity" else [],
            "phi": rest[phi[:2]].tolist(),
            "eps": rest[eps[:2]].tolist(),
            "eps_down": float(rest[eps[2]]),
            "unseen": float(rest[[phi[2], *nabla]].max()),
        }
    R_M, R_N = radii(lat)
    radian = np.ones(len(places))  # of latitude and longitude [m]
    radian[dp] = R_M, R_N * math.cos(lat)
    mixed = in_units(segment(0.0, dp), radian, np.array([1.0, radian[dp[1]]]), 1.0)
    degree = analyse(derivatives(mixed), 1e-8).degree
    turned = stripped([segment(0.0, every), segment(math.pi / 2, every)])
    seen = [matrices["velocity"], matrices["both"], derivatives(segment(0.0, every)), turned]
    return found | {
        "radians": [float(degree[dv[1]] / degree[dp[0]]), float(degree[eps[:2]].min())],
        "ranks": [analyse(Q, 1e-8).rank for Q in seen],
        "g_earth_rate": float(gravity(lat, 0.0)) * OMEGA_IE * math.cos(lat),
    }


def _largest(values: Array) -> float:
    return float(np.abs(values).max())


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


ALL = ("improved", "ungated", "no_course", "told")


def _jobs(draws: Draws) -> list[Job]:
    seeds = draws.seeds
    return [
        Job(road, (seeds[-1] + 1, LONG_S, ("improved", "told"))),
        *(Job(road, (seed, SHORT_S, ALL, seed == seeds[0])) for seed in seeds),
        *(Job(noisier, (seed,)) for seed in seeds),
        *(Job(straight, (seed,)) for seed in seeds),
        Job(table_1, ()),
    ]


def _conclude(results: Sequence[Any]) -> list[Claim]:
    n = (len(results) - 2) // 3
    roads, noises, straights, table = results[: n + 1], results[n + 1 : -n - 1], results[-n - 1 : -1], results[-1]
    return [
        *_heading_claims(roads, straights),
        *_level_claims(roads),
        *_position_claims(roads),
        *_course_claims(roads),
        *_noise_claims(roads, noises),
        *_velocity_table_claims(table),
        *_position_table_claims(table),
        *_both_table_claims(table),
    ]


def _of(roads: Sequence[Any], name: str, key: str) -> list[float]:
    return [one[name][key] for one in roads if name in one]


def _any_seed(roads: Sequence[Any], what: tuple[str, str, str], key: str, wanted: float) -> Claim:
    """The worst seed; where the filter that need not learn is not within ``wanted`` either, next to that filter.

    ``what`` are the quantity, its unit, and the paper's figure.
    """
    quantity, unit, paper = what
    least = max(_of(roads, "told", key))
    bound, because = wanted, ""
    if least > wanted:
        bound, because = NO_WORSE * least, f"with the variances told instead of learned it is {least:.3g}"
    ours = _of(roads, "improved", key)
    return Claim(f"{quantity}, any seed below {wanted:g}", unit, paper, ours, bound, statistic=NEARLY_ALL, note=because)


def _heading_claims(roads: Sequence[Any], straights: Sequence[tuple[float, float]]) -> Iterator[Claim]:
    """With course and its turn rule, without the rule, and without course."""
    left, claimed = np.array(straights).T
    on_straights = "heading on straights from 300 s, largest"
    straight, turn = _of(roads, "improved", "heading_straight"), _of(roads, "improved", "heading_turn")
    yield Claim(on_straights, "deg", "0.1", straight, 0.1, statistic=NEARLY_ALL)
    yield _any_seed(roads, (on_straights, "deg", "0.1"), "heading_straight", 0.08)
    yield Claim("heading in turns and 10 s after, largest", "deg", "0.1", turn, 0.3, statistic=NEARLY_ALL)
    yield Claim(
        "the same without the turn rule", "deg", "large oscillation", _of(roads, "ungated", "heading_turn"),
        DRIFT_DEG / 2, at_least=True, statistic=HARDLY_ANY,
    )  # fmt: skip
    yield Claim(
        "heading after 300 s of straight, without course, RMS over the seeds", "deg", "constant offset",
        [_rms(left)], 1.0, at_least=True,
    )  # fmt: skip
    yield Claim(
        "its own 1 sigma then, of the initial one", "1", "offset whatever the initial error", claimed, 0.9,
        at_least=True, statistic=HARDLY_ANY,
        note="nothing there shows the heading (Table 1: phi_U 0): what was wrong stays, and drifts",
    )  # fmt: skip


def _level_claims(roads: Sequence[Any]) -> Iterator[Claim]:
    """Before the first turn, and after it."""
    before, rms, nearly_all = (_of(roads, "improved", key) for key in ("level_before", "level_rms", "level_nearly_all"))
    yield Claim(
        "level before the first turn, largest", "deg", "0.01", before, 0.3,
        note="at one heading a tilt can't be told from the accelerometer's bias (Table 1: nabla 0)",
    )  # fmt: skip
    yield Claim("level after the first turn, RMS", "deg", "0.01", rms, 0.02, statistic=NEARLY_ALL)
    most_of_the_time = "level after the first turn, 99.7 % of the time"
    yield Claim(most_of_the_time, "deg", "0.01", nearly_all, 0.02)
    yield _any_seed(roads, (most_of_the_time, "deg", "0.01"), "level_nearly_all", 0.02)


def _position_claims(roads: Sequence[Any]) -> Iterator[Claim]:
    """Velocity and position."""
    velocity, rms, largest = (_of(roads, "improved", key) for key in ("velocity", "position_rms", "position_largest"))
    yield Claim("velocity, each axis, 99.7 % of the time", "m/s", "0.02", velocity, 0.02, statistic=NEARLY_ALL)
    yield Claim("position, each axis, RMS", "m", "1", rms, 0.6)
    yield _any_seed(roads, ("position, each axis, RMS", "m", "1"), "position_rms", 0.6)
    yield Claim("position, each axis, largest", "m", "1", largest, 1.5)


def _course_claims(roads: Sequence[Any]) -> Iterator[Claim]:
    """Whether course is used when it should be, and only then."""
    amiss, samples = _of(roads, "improved", "course_amiss"), _of(roads, "improved", "course_looks")
    yield Claim("courses used in a turn or below 1 m/s", "", "0", amiss, 0, statistic=NEARLY_ALL)
    yield Claim("courses used on straights, of 3 h", "", "all", [max(samples)], 5000, at_least=True)


def _noise_claims(roads: Sequence[Any], noises: Sequence[Any]) -> Iterator[Claim]:
    """The variances that are learned."""
    yield Claim(
        "smallest learned variance, of the nominal", "1", "may be negative (Eq 29)",
        _of(roads, "improved", "least_R"), 0.25, at_least=True, statistic=HARDLY_ANY,
    )  # fmt: skip
    for what, aid in (("position", "gnss_position"), ("velocity", "gnss_velocity")):
        off = [one[aid] for one in noises]
        yield Claim(f"{what} variance x 4: learned within, after 200 samples", "1", "", off, 0.25)


def _off(*pairs: tuple[Sequence[float], float]) -> list[float]:
    """By how much [%] ours are off what is printed."""
    return [100 * abs(one / printed - 1) for ours, printed in pairs for one in ours]


def _velocity_table_claims(table: Any) -> Iterator[Claim]:
    """Table 1, the column of measured velocity."""
    velocity = table["velocity"]
    yield Claim(
        "Table 1, velocity: phi, eps, dV off the print by", "%", "9.86, 9.80, 1",
        _off((velocity["phi"], 9.86), (velocity["eps"], 9.80), (velocity["dv"], 1.0)), 0.1, statistic=NEARLY_ALL,
    )  # fmt: skip
    yield Claim("Table 1, velocity: phi_U, nabla", "", "0", [velocity["unseen"]], 1e-9)
    yield Claim(
        "Table 1, velocity: eps_U", "", "5.66e-4", [velocity["eps_down"]], 1.01 * table["g_earth_rate"],
        note="it is g w_ie cos 45 deg = 5.06e-4",
    )  # fmt: skip


def _position_table_claims(table: Any) -> Iterator[Claim]:
    """Table 1, the column of measured position."""
    position, in_radians = table["position"], table["radians"]
    yield Claim(
        "Table 1, position: dV_N, dL, dlambda, phi_E, eps_N off the print by", "%", "1, 1, 1, 9.86, 9.81",
        _off(
            (position["dv"][:1], 1.0), (position["dp"], 1.0), (position["phi"][1:], 9.86),
            (position["eps"][:1], 9.81),
        ), 0.1, statistic=NEARLY_ALL,
    )  # fmt: skip
    yield Claim(
        "Table 1, position: dV_E, phi_N, eps_E off 1, 9.86, 9.81 by", "%", "3.14e-14, 8.43e-11, 1.79e-3",
        _off((position["dv"][1:], 1.0), (position["phi"][:1], 9.86), (position["eps"][1:], 9.81)), 0.1,
        statistic=NEARLY_ALL,
        note="at rest one level axis shows as the other does; with the fix left in radians along one of them,"
        f" dV_E is {in_radians[0]:.1e} and one eps {in_radians[1]:.1e} (11 % less than printed, as eps_U)",
    )  # fmt: skip
    yield Claim("Table 1, position: phi_U, nabla", "", "0", [position["unseen"]], 1e-9)
    yield Claim(
        "Table 1, position: eps_U", "", "9.03e-9", [position["eps_down"]], 0.99 * table["g_earth_rate"],
        at_least=True, note="it is g w_ie cos 45 deg = 5.06e-4, one derivative later than by velocity",
    )  # fmt: skip


def _both_table_claims(table: Any) -> Iterator[Claim]:
    """Table 1, the column of both, and the ranks."""
    both = table["both"]
    yield Claim(
        "Table 1, velocity and position: phi, eps, dV, dL, dlambda off the print by", "%", "9.86, 9.80, 1, 1, 1",
        _off((both["phi"], 9.86), (both["eps"], 9.80), (both["dv"], 1.0), (both["dp"], 1.0)), 0.1, statistic=NEARLY_ALL,
    )  # fmt: skip
    yield Claim("Table 1, velocity and position: phi_U, nabla", "", "0", [both["unseen"]], 1e-9)
    yield Claim(
        "Table 1, velocity and position: eps_U", "", "5.66e-4", [both["eps_down"]], 1.01 * table["g_earth_rate"],
        note="as by velocity alone",
    )  # fmt: skip
    off = [abs(ours - printed) for ours, printed in zip(table["ranks"], (7, 9, 10, 12), strict=True)]
    yield Claim(
        "ranks with velocity, position, heading, a turn: off by", "", "7, 9, 10, 12", off, 0, statistic=NEARLY_ALL
    )


def _draw(results: Sequence[Any], out: Path) -> None:
    from matplotlib.figure import Figure

    drawn = next(one for one in results if isinstance(one, dict) and "t" in one.get("improved", {}))
    figure = Figure(figsize=(8, 7), layout="constrained")
    whole, near, level = figure.subplots(3, 1, sharex=True)
    colours = {"improved": "#0072B2", "ungated": "#D55E00", "no_course": "#009E73"}
    labels = {
        "improved": "course, turn rule, adaptive",
        "ungated": "the same without the turn rule",
        "no_course": "no course",
    }
    for name in ("ungated", "no_course", "improved"):
        for ax in (whole, near):
            ax.plot(drawn[name]["t"], drawn[name]["heading"], color=colours[name], label=labels[name], lw=1)
    level.plot(drawn["improved"]["t"], drawn["improved"]["level"], lw=1, label=["about north", "about east"])
    for ax, limit, title in (
        (whole, 3.2, "heading error [deg]"),
        (near, 0.3, "the same, enlarged [deg]"),
        (level, 0.12, "level error about north and east [deg]"),
    ):
        ax.set_ylim(-limit, limit)
        ax.set_title(title, loc="left", fontsize=10)
        ax.grid(alpha=0.3)
        for turn in drawn["turns"]:
            ax.axvspan(turn, turn + 4, color="#DDDDDD", zorder=0)
    for ax in (near, level):
        ax.axhline(0.1 if ax is near else 0.02, color="black", lw=0.8, ls=":")
        ax.axhline(-0.1 if ax is near else -0.02, color="black", lw=0.8, ls=":")
    whole.legend(fontsize=8, loc="lower left", ncols=3)
    level.legend(fontsize=8, ncols=2)
    level.set_xlabel("time [s]; turns shaded")
    level.set_xlim(0, SHORT_S)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=100)
    write_result(out / "cheng2020.png", picture.getvalue())


PAPER = Paper("Cheng et al. 2020: heading from GNSS course on the road", ("cheng2020.png",), _jobs, _conclude, _draw)
