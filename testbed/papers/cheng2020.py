"""Cheng et al. 2020: heading on the road from GNSS course, with a turn rule and an adaptive unscented filter.

``scenarios/papers/cheng2020.toml`` holds the assumptions. The paper runs it for 3 h; what is judged here is the first
1000 s of it: two stops, two turns and the beginning of the straight after the third, over drawn places, courses and
lengths of the straights. ``told`` is the same filter with the true variances, which no filter that must learn them can
better.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nav.earth import OMEGA_IE, gravity, radii
from nav.error_model import PAPERS, ErrorModel, ImuModel, Indices
from nav.observability import Segment, analyse, continuous, derivatives, in_units, stripped
from nav.rotation import quat_from_euler
from nav.samples import Array
from testbed.papers import Job, Paper, flights, scenario
from testbed.papers.draws import world
from testbed.papers.flights import Flight, Sensed, Track
from testbed.report.style import COLOURS
from testbed.results import write_result
from testbed.scenario import Scenario
from testbed.score import accuracy
from testbed.score.claims import EXACT, NEARLY_ALL, RATIO_OF_RMS, RMS, Claim, Floor

DURATION_S, STRAIGHT_S, FIRST_TURN_S = 1000, 300, 450
STRAIGHTS = {2: 112.5, 6: 131.5, 8: 139.0}  # segments [s]
SETTLED_S = 300.0  # from here on the paper's figures are to hold
DRIFT_DEG = 3.0  # of the scenario's turns
KAPPA = math.radians(2.0)
AFTER_TURN_S = 10
NOISIER_S, LEARNED_S = 350, 200  # when the receiver gets worse, and how many samples there are to find out
WRONG = math.sqrt(10.0)  # what a sigma is told too small or too large by, where the noise is not known
IMPROVED, UNGATED, NO_COURSE, TOLD = "improved", "ungated", "no_course", "told"
CHANNELS = ("north", "east", "down", "v_north", "v_east", "v_down")
NOISIER = ", ".join(
    f'{{ sensor = "gnss", channel = "{channel}", kind = "noise", factor = 2, window = [{NOISIER_S}, {DURATION_S}] }}'
    for channel in CHANNELS
)


class Drive(NamedTuple):
    """One filter on one drive from `SETTLED_S` on, angles in deg: largest heading error on straights, and in turns and
    10 s after them; largest level error before the first turn, and from 10 s after it; largest velocity error [m/s] and
    position error [m] of an axis; RMS of position, and of heading; courses that were used in a turn or below 1 m/s.
    """

    straight: float
    turn: float
    level_before: float
    level: float
    velocity: float
    position: float
    position_rms: float
    heading_rms: float
    amiss: int


class Draw(NamedTuple):
    """One draw: drives by filter; by how much the variances are off that were learned after they became four times as
    large; RMS of position and heading (2, 2) of the filter that learns and of the one that doesn't, by how the noise is
    wrong; heading error [deg] after a straight without course, and its 1 sigma there over the initial; the figure's
    series by filter.
    """

    drives: Mapping[str, Drive]
    learned: Mapping[str, float]
    wrong: Mapping[str, Array]
    drift: tuple[float, float]
    series: Mapping[str, Any]


def drive(seed: int, series: bool = False) -> Draw:
    """Every filter on one draw."""
    here = world(seed, len(STRAIGHTS))
    legs = [
        f"truth.segments[{k}].duration_s={s * f!r}" for (k, s), f in zip(STRAIGHTS.items(), here.stretch, strict=True)
    ]
    keys = (*here.start, *legs, f"duration_s={DURATION_S}")
    chosen = scenario("cheng2020", keys)
    sensed = Sensed.of(chosen, seed)
    moving = Moving.of(sensed)
    before, after, learned = np.arange(0.0, NOISIER_S), np.arange(NOISIER_S, DURATION_S + 0.5), NOISIER_S + LEARNED_S
    noisier, _ = sensed.with_faults(scenario("cheng2020", (*keys, f"fault=[{NOISIER}]")), seed)
    tracks, worse = {}, []
    for name in (IMPROVED, TOLD):
        flight = Flight(flights.lanes(chosen, seed)[name], sensed)
        flight.on(before)
        other = flight.fork(noisier)
        flight.on(after)
        other.on(after[after <= learned])
        tracks[name] = flight.track()
        worse.append(other.track())
    others = {UNGATED: FIRST_TURN_S} | ({NO_COURSE: DURATION_S} if series else {})
    tracks |= {name: _track(chosen, seed, name, sensed, duration) for name, duration in others.items()}
    wrong = {"10 times too small": _misstated(sensed, 1 / WRONG), "10 times too large": _misstated(sensed, WRONG)}
    pairs = {how: [_track(chosen, seed, name, one, learned) for name in (IMPROVED, TOLD)]
             for how, one in wrong.items()} | {"too small by 4 from 350 s on": worse}  # fmt: skip
    return Draw(
        {name: moving.judged(track) for name, track in tracks.items()},
        {aid: abs(1 / float(worse[0].looks(aid).weight[-1]) / 4 - 1) for aid in ("gnss_position", "gnss_velocity")},
        {how: np.array([_rms_of(track) for track in pair]).T for how, pair in pairs.items()},
        _straight(seed, here.start),
        _series(tracks, moving) if series else {},
    )


def _track(chosen: Scenario, seed: int, name: str, sensed: Sensed, duration: int) -> Track:
    t = np.arange(0.0, duration + 0.5)
    return flights.track(flights.lanes(chosen, seed)[name], sensed, t)


def _misstated(sensed: Sensed, factor: float) -> Sensed:
    """The same with a receiver that says another accuracy than it has."""
    fixes = [
        replace(fix, sigma_position_n=factor * fix.sigma_position_n, sigma_velocity_n=factor * fix.sigma_velocity_n)
        for fix in sensed.samples["gnss"]
    ]
    return Sensed(sensed.truth, {**sensed.samples, "gnss": fixes})


def _rms_of(track: Track) -> tuple[float, float]:
    late = track.t > SETTLED_S
    return _rms(track.position[late, :2]), math.degrees(_rms(track.attitude[late, 2]))


def _straight(seed: int, start: Sequence[str]) -> tuple[float, float]:
    keys = (
        *start, f"duration_s={STRAIGHT_S}", "truth.start.speed_mps=3",
        'truth.segments=[{ leg = "straight", duration_s = 1e4 }]',
    )  # fmt: skip
    chosen = scenario("cheng2020", keys)
    track = _track(chosen, seed, NO_COURSE, Sensed.of(chosen, seed), STRAIGHT_S)
    return math.degrees(track.attitude[-1, 2]), float(track.sigma[-1, 8] / track.sigma[0, 8])


def _series(tracks: Mapping[str, Track], moving: Moving) -> dict[str, Any]:
    shown: dict[str, Any] = {
        name: {"t": one.t, "heading": np.degrees(one.attitude[:, 2]), "level": np.degrees(one.attitude[:, :2])}
        for name, one in tracks.items()
    }
    return shown | {"turns": moving.turns}


class Moving(NamedTuple):
    """A drive once a second: whether it turned in that second, and speed [m/s], each (N,)."""

    turning: accuracy.Mask
    speed: Array

    @classmethod
    def of(cls, sensed: Sensed) -> Moving:
        """From truth."""
        rate = round(1 / (sensed.truth.t[1] - sensed.truth.t[0]))
        rows = slice(None, None, rate)
        return cls(
            np.abs(sensed.truth.omega_b[rows, 2]) > KAPPA, np.linalg.norm(sensed.truth.v_n[rows], axis=1)
        )  # fmt: skip

    @property
    def turns(self) -> list[float]:
        """When each turn begins [s]."""
        return np.flatnonzero(self.turning & ~np.roll(self.turning, 1)).astype(float).tolist()

    def judged(self, track: Track) -> Drive:
        """What is judged of a filter."""
        n = len(track.t)
        near = np.convolve(self.turning, np.ones(AFTER_TURN_S + 1))[:n] > 0
        first = self.turns[0]
        settled, turned = track.t > SETTLED_S, track.t > first + AFTER_TURN_S
        heading, level = np.degrees(track.attitude[:, 2]), np.degrees(track.attitude[:, :2])
        at = track.looks("gnss_course").t.astype(int)
        return Drive(
            straight=_largest(heading[settled & ~near]),
            turn=_largest(heading[settled & near]),
            level_before=_largest(level[track.t < first]),
            level=_largest(level[turned]),
            velocity=_largest(track.velocity[settled, :2]),
            position=_largest(track.position[settled, :2]),
            position_rms=_rms(track.position[settled, :2]),
            heading_rms=_rms(heading[settled]),
            amiss=int(np.sum(self.turning[at] | (self.speed[at] < 1.0))),
        )


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
    return float(np.abs(values).max()) if values.size else 0.0


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


# --- what comes out


def claims(results: Sequence[Any]) -> list[Claim]:
    """From all draws, and Table 1."""
    *draws, table = results
    return [
        *_accuracy(draws),
        *_heading(draws),
        *_velocity_table(table),
        *_position_table(table),
        *_both_table(table),
        *_own(draws),
    ]


def _of(draws: Sequence[Draw], name: str, key: str) -> list[float]:
    return [float(getattr(one.drives[name], key)) for one in draws]


def _accuracy(draws: Sequence[Draw]) -> Iterator[Claim]:
    """The paper says "within"; the largest error is what is asked, of the median drive."""
    why = "the same filter, told the true noise, has"
    for what, unit, key, bound in (
        ("heading on straights", "deg", "straight", 0.1), ("heading in turns and 10 s after", "deg", "turn", 0.1),
        ("level, after the first turn", "deg", "level", 0.01),
        ("level, before the first turn", "deg", "level_before", 0.01),
        ("velocity, each axis", "m/s", "velocity", 0.02), ("position, each axis", "m", "position", 1.0),
    ):  # fmt: skip
        floor = Floor(_of(draws, TOLD, key), why)
        yield Claim(f"{what}, largest", unit, f"{bound:g}", _of(draws, IMPROVED, key), bound, floor=floor)
    what, nearly = "heading on straights, largest, nearly all drives", _of(draws, IMPROVED, "straight")
    yield Claim(
        what, "deg", "0.1", nearly, 0.1, statistic=NEARLY_ALL, floor=Floor(_of(draws, TOLD, "straight"), why)
    )  # fmt: skip


def _heading(draws: Sequence[Draw]) -> Iterator[Claim]:
    """Without the turn rule, and without course."""
    ungated = _of(draws, UNGATED, "turn")
    what = "heading in the first turn and 10 s after without the turn rule, largest"
    yield Claim(what, "deg", "large oscillation", ungated, DRIFT_DEG / 2, at_least=True)
    left, claimed = np.array([one.drift for one in draws]).T
    what = "heading after 300 s of straight, without course"
    yield Claim(what, "deg", "constant offset", left, 1.0, at_least=True, statistic=RMS)
    yield Claim(
        "its own 1 sigma then, of the initial one", "", "offset whatever the initial error", claimed, 0.5,
        note="nothing there shows the heading (Table 1: phi_U 0): what was wrong stays, and drifts",
    )  # fmt: skip
    amiss = _of(draws, IMPROVED, "amiss")
    yield Claim("courses used in a turn or below 1 m/s", "", "0", amiss, 0.0, statistic=NEARLY_ALL)


def _own(draws: Sequence[Draw]) -> Iterator[Claim]:
    """What learning the noise costs where it is known, and brings where it isn't."""
    yield Claim("position, each axis, RMS", "m", "", _of(draws, IMPROVED, "position_rms"), 0.6)
    for what, key in (("position", "position_rms"), ("heading", "heading_rms")):
        pair = np.column_stack([_of(draws, name, key) for name in (IMPROVED, TOLD)])
        quantity = f"R as it is: RMS of {what}, learned over told"
        yield Claim(quantity, "", "", pair, 1.05, statistic=RATIO_OF_RMS)
    for how in draws[0].wrong:
        for k, what in enumerate(("position", "heading")):
            pair = np.array([one.wrong[how][k] for one in draws])
            quantity = f"R told {how}: RMS of {what}, learned over told"
            yield Claim(quantity, "", "", pair, 1.0, statistic=RATIO_OF_RMS)
    for what, aid in (("position", "gnss_position"), ("velocity", "gnss_velocity")):
        off = [one.learned[aid] for one in draws]
        yield Claim(f"{what} variance x 4: learned within, after 200 samples", "", "", off, 0.25)


def _off(*pairs: tuple[Sequence[float], float]) -> list[float]:
    """By how much [%] ours are off what is printed, the most."""
    return [max(100 * abs(one / printed - 1) for ours, printed in pairs for one in ours)]


def _velocity_table(table: Any) -> Iterator[Claim]:
    """Table 1, the column of measured velocity."""
    velocity = table["velocity"]
    yield Claim(
        "Table 1, velocity: phi, eps, dV off the print by", "%", "9.86, 9.80, 1",
        _off((velocity["phi"], 9.86), (velocity["eps"], 9.80), (velocity["dv"], 1.0)), 0.1, statistic=EXACT,
    )  # fmt: skip
    yield Claim("Table 1, velocity: phi_U, nabla", "", "0", [velocity["unseen"]], 1e-9, statistic=EXACT)
    yield _eps_u("velocity", velocity["eps_down"], 5.66e-4, table["g_earth_rate"])


def _eps_u(column: str, ours: float, printed: float, value: float) -> Claim:
    """The gyro about the vertical shows by g w_ie cos 45 deg, whatever else is right."""
    floor = Floor(_off(([value], printed)), f"g w_ie cos 45 deg is {value:.3g}, off by", exact=True)
    quantity = f"Table 1, {column}: eps_U off the print by"
    return Claim(quantity, "%", f"{printed:.3g}", _off(([ours], printed)), 0.1, statistic=EXACT, floor=floor)


def _position_table(table: Any) -> Iterator[Claim]:
    """Table 1, the column of measured position."""
    position, in_radians = table["position"], table["radians"]
    yield Claim(
        "Table 1, position: dV_N, dL, dlambda, phi_E, eps_N off the print by", "%", "1, 1, 1, 9.86, 9.81",
        _off(
            (position["dv"][:1], 1.0), (position["dp"], 1.0), (position["phi"][1:], 9.86),
            (position["eps"][:1], 9.81),
        ), 0.1, statistic=EXACT,
    )  # fmt: skip
    yield Claim(
        "Table 1, position in metres: dV_E, phi_N, eps_E off 1, 9.86, 9.81 by", "%", "",
        _off((position["dv"][1:], 1.0), (position["phi"][:1], 9.86), (position["eps"][1:], 9.81)), 0.1,
        statistic=EXACT, note="at rest one level axis shows as the other does",
    )  # fmt: skip
    yield Claim(
        "Table 1, position with the fix left in radians along one axis: dV_E, eps_E off the print by", "%",
        "3.14e-14, 1.79e-3", _off(([in_radians[0]], 3.14e-14), ([in_radians[1]], 1.79e-3)), 0.1, statistic=EXACT,
        misprint=True, note="of the printed size, and 11 % off as eps_U is",
    )  # fmt: skip
    yield Claim("Table 1, position: phi_U, nabla", "", "0", [position["unseen"]], 1e-9, statistic=EXACT)
    yield _eps_u("position", position["eps_down"], 9.03e-9, table["g_earth_rate"])


def _both_table(table: Any) -> Iterator[Claim]:
    """Table 1, the column of both, and the ranks."""
    both = table["both"]
    yield Claim(
        "Table 1, velocity and position: phi, eps, dV, dL, dlambda off the print by", "%", "9.86, 9.80, 1, 1, 1",
        _off((both["phi"], 9.86), (both["eps"], 9.80), (both["dv"], 1.0), (both["dp"], 1.0)), 0.1, statistic=EXACT,
    )  # fmt: skip
    yield Claim("Table 1, velocity and position: phi_U, nabla", "", "0", [both["unseen"]], 1e-9, statistic=EXACT)
    yield _eps_u("velocity and position", both["eps_down"], 5.66e-4, table["g_earth_rate"])
    off = max(abs(ours - printed) for ours, printed in zip(table["ranks"], (7, 9, 10, 12), strict=True))
    quantity = "ranks with velocity, position, heading, a turn: off by"
    yield Claim(quantity, "", "7, 9, 10, 12", [float(off)], 0.0, statistic=EXACT)


def _draw(results: Sequence[Any], out: Path) -> None:
    """The first draw: heading and level errors, the paper's bounds dotted, turns shaded."""
    from matplotlib.figure import Figure

    drawn = results[0].series
    figure = Figure(figsize=(8, 7), layout="constrained")
    whole, near, level = figure.subplots(3, 1, sharex=True)
    colours = {IMPROVED: COLOURS[0], UNGATED: COLOURS[1], NO_COURSE: COLOURS[2]}
    labels = {
        IMPROVED: "course, turn rule, adaptive",
        UNGATED: "the same without the turn rule",
        NO_COURSE: "no course",
    }
    for name in (UNGATED, NO_COURSE, IMPROVED):
        for ax in (whole, near):
            ax.plot(drawn[name]["t"], drawn[name]["heading"], color=colours[name], label=labels[name], lw=1)
    level.plot(drawn[IMPROVED]["t"], drawn[IMPROVED]["level"], lw=1, label=["about north", "about east"])
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
        ax.axhline(0.1 if ax is near else 0.01, color="black", lw=0.8, ls=":")
        ax.axhline(-0.1 if ax is near else -0.01, color="black", lw=0.8, ls=":")
    whole.legend(fontsize=8, loc="lower left", ncols=3)
    level.legend(fontsize=8, ncols=2)
    level.set_xlabel("time [s]; turns shaded")
    level.set_xlim(0, DURATION_S)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=100)
    write_result(out / "cheng2020.png", picture.getvalue())


PAPER = Paper(
    "Cheng et al. 2020: heading from GNSS course on the road",
    ("cheng2020.png",),
    lambda draws: [*(Job(drive, (seed, seed == draws.seeds[0])) for seed in draws.seeds), Job(table_1, ())],
    claims,
    _draw,
)
