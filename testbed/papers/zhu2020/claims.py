"""What Zhu et al. 2020 claim of the river and of the outage, beside what comes out here."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from testbed.papers.zhu2020.flight import (
    AST,
    CASES,
    DVL,
    EQ13,
    EQ13_DEGREES,
    FRKF,
    FRKF_ALONE,
    OUTAGE,
    SHARED,
    SHARED_ALONE,
    TFKF,
    TFKF_ALONE,
    Draw,
    Flown,
)
from testbed.score.claims import EXACT, HARDLY_ANY, MEDIAN, NEARLY_ALL, SHARE, Claim

P_N, P_E, V_N, V_E, ROLL, PITCH, HEADING = 0, 1, 3, 4, 6, 7, 8  # columns of errors
HORIZONTAL = (P_N, P_E)
CONVERGED_S = 600.0  # the paper doesn't say when
# Of each: column, standard deviation of the traditional filter and of the robust one, Table 3.
SPREAD: Mapping[str, tuple[int, float, float]] = {
    "v_E": (V_E, 0.2154, 0.0874),
    "v_N": (V_N, 0.2948, 0.1804),
    "latitude": (P_N, 19.30, 7.191),
    "longitude": (P_E, 19.84, 6.330),
}
# Largest errors after convergence, section 4.2.
CONVERGED: Mapping[str, tuple[str, tuple[int, ...], float]] = {
    "pitch and roll": ("deg", (ROLL, PITCH), 0.01),
    "heading": ("deg", (HEADING,), 0.2),
    "v_E": ("m/s", (V_E,), 0.2),
    "v_N": ("m/s", (V_N,), 0.3),
    "latitude": ("m", (P_N,), 21.0),
    "longitude": ("m", (P_E,), 16.0),
}
LOST: Mapping[str, tuple[int, float]] = {"latitude": (P_N, 17.57), "longitude": (P_E, 18.68)}  # section 4.3


def conclude(results: Sequence[Any]) -> list[Claim]:
    """Every claim beside the paper's; the last result is that of `flight.solve`."""
    *draws, solved = results
    return [
        *_spread_claims(draws),
        *_converged_claims(draws),
        *_step_claims(draws),
        *_outage_claims(draws),
        *_weight_claims(draws),
        *_clean_claims(draws),
        *_solver_claims(solved),
    ]


def std(flown: Flown, column: int, start: float = 0.0, end: float = np.inf) -> float:
    """Standard deviation of an error from ``start`` to ``end`` [s]."""
    return float(flown.error[(flown.t >= start) & (flown.t <= end), column].std())


def largest(flown: Flown, columns: Sequence[int], start: float, end: float = np.inf) -> float:
    """The largest error of any of these ``columns`` from ``start`` to ``end`` [s]."""
    return float(np.abs(flown.error[(flown.t >= start) & (flown.t <= end)][:, list(columns)]).max())


def ratios(draws: Sequence[Draw], pair: tuple[str, str], column: int, start: float, end: float) -> list[float]:
    """Of standard deviations, the robust filter's over the traditional one's."""
    both = [(one.river[pair[0]], one.river[pair[1]]) for one in draws]
    return [std(robust, column, start, end) / std(plain, column, start, end) for robust, plain in both]


def _spread_claims(draws: Sequence[Draw]) -> Iterator[Claim]:
    """Standard deviations of the robust filter over the traditional one's, and by themselves."""
    alone, reset = (FRKF_ALONE, TFKF_ALONE), (FRKF, TFKF)
    for mode, pair, claimed in (("no feedback", alone, True), ("with feedback", reset, False)):
        for span, start, end in (
            ("the whole run", 0.0, np.inf),
            ("its first 600 s", 0.0, CONVERGED_S),
            ("without its first 600 s", CONVERGED_S, np.inf),
        ):
            for what, (column, plain, robust) in SPREAD.items():
                ours, paper = ratios(draws, pair, column, start, end), robust / plain
                printed = f"{paper:.2f}" if claimed and start == 0 and end == np.inf else ""
                yield Claim(f"{mode}, {span}: std of {what}, robust over traditional", "", printed, ours, paper)
    for what, (column, _, robust) in SPREAD.items():
        ours = [std(one.river[FRKF_ALONE], column) for one in draws]
        unit = "m/s" if what.startswith("v") else "m"
        yield Claim(
            f"no feedback: std of {what}, robust", unit, f"{robust:.3g}", ours, robust, statistic=NEARLY_ALL
        )  # fmt: skip


def _converged_claims(draws: Sequence[Draw]) -> Iterator[Claim]:
    """Largest errors of the robust filter from `CONVERGED_S` on."""
    for mode, name, claimed in (("no feedback", FRKF_ALONE, True), ("with feedback", FRKF, False)):
        for what, (unit, columns, limit) in CONVERGED.items():
            factor = float(np.degrees(1.0)) if unit == "deg" else 1.0
            ours = [factor * largest(one.river[name], columns, CONVERGED_S) for one in draws]
            quantity = f"{mode}, after convergence: largest error of {what}"
            printed, statistic = (f"< {limit:g}", NEARLY_ALL) if claimed else ("", MEDIAN)
            yield Claim(quantity, unit, printed, ours, limit, statistic=statistic)


def _step_claims(draws: Sequence[Draw]) -> Iterator[Claim]:
    """By how much a wrong fix moves either filter."""

    def steps(name: str) -> list[float]:
        return [float(one.river[name].step.max()) for one in draws]

    step = "no feedback: largest step at a wrong fix, any state"
    yield Claim(f"{step}, robust", "sigma", "smooth", steps(FRKF_ALONE), 1.0, statistic=NEARLY_ALL)
    yield Claim(f"{step}, traditional", "sigma", "jumps", steps(TFKF_ALONE), 1.0, at_least=True, statistic=HARDLY_ANY)


def _lost(draws: Sequence[Draw], name: str, columns: Sequence[int], start: float = OUTAGE[0]) -> list[float]:
    return [largest(one.outage[name], columns, start, OUTAGE[1]) for one in draws]


def _outage_claims(draws: Sequence[Draw]) -> Iterator[Claim]:
    """1000 s without a fix, the log at 1 Hz: largest errors."""
    gap = "1000 s of outage"
    for what, (column, paper) in LOST.items():
        ours = _lost(draws, FRKF_ALONE, (column,))
        name = f"{gap}, no feedback: largest error of {what}"
        yield Claim(name, "m", f"{paper:.1f}", ours, paper, statistic=NEARLY_ALL)
        yield Claim(f"{name}, draws within the paper's", "", "its one", np.array(ours) <= paper, 0.5, True, SHARE)
    for name, label in (
        (FRKF, "with feedback"),
        (SHARED, "with feedback, shares by covariance"),
        (SHARED_ALONE, "no feedback, shares by covariance"),
    ):
        for what, (column, paper) in LOST.items():
            quantity = f"{gap}, {label}: largest error of {what}"
            yield Claim(quantity, "m", "", _lost(draws, name, (column,)), paper)
    alone = _lost(draws, DVL, HORIZONTAL)
    yield Claim(f"{gap}: largest error of the log's filter alone", "m", "81.5", alone, 81.53)
    alone = _lost(draws, AST, HORIZONTAL, OUTAGE[1])
    quantity = "error of the transponder's filter alone at the end of it"
    yield Claim(quantity, "m", "225", alone, 100.0, at_least=True)


def _weight_claims(draws: Sequence[Draw]) -> Iterator[Claim]:
    """What the lost filter still counts for, and what comes of it by equation 13, as printed and in its units."""

    def weight(name: str) -> list[float]:
        return [one.weight[name] for one in draws]

    share = "weight of the transponder's filter at the end of the outage"
    yield Claim(f"{share}, by the traces", "", "", weight("traces"), 0.05)
    for name, units, misprint, note in (
        (EQ13, "in SI", True, "the gyro biases alone decide, and a lost position doesn't count"),
        (EQ13_DEGREES, "in deg, deg/h and µg", False, ""),
    ):
        quantity = f"{share}, by equation 13 {units}"
        yield Claim(quantity, "", "→ 0", weight(name), 0.15, misprint=misprint, note=note)
        for what, (column, paper) in LOST.items():
            quantity = f"outage by equation 13 {units}: largest error of {what}"
            ours = _lost(draws, name, (column,))
            yield Claim(quantity, "m", f"{paper:.1f}", ours, paper, misprint=misprint)


def _clean_claims(draws: Sequence[Draw]) -> Iterator[Claim]:
    """What inflation costs where nothing is wrong."""

    def rms(flown: Flown, columns: tuple[int, ...]) -> float:
        return float(np.sqrt(np.mean(flown.error[:, columns] ** 2)))

    for what, columns in (("position", HORIZONTAL), ("velocity", (V_N, V_E))):
        loss = [100 * (rms(one.clean[FRKF], columns) / rms(one.clean[TFKF], columns) - 1) for one in draws]
        quantity = f"sound Gaussian data: RMS of {what}, loss by inflation"
        yield Claim(quantity, "%", "", loss, 2.0)


def _solver_claims(solved: Mapping[str, float]) -> Iterator[Claim]:
    """Equation 12: put right, on the reciprocal, and as printed."""
    for quantity, key, bound in (
        (f"iterations for lambda, most of {CASES}", "newton", 17.0),
        ("the same on the reciprocal", "reciprocal", 5.0),
        ("distance after inflation, off its limit by", "off", 1e-5),
    ):
        yield Claim(quantity, "", "", [solved[key]], bound, statistic=EXACT)
    yield Claim(
        "equation 12 as printed: outliers whose lambda it finds within 1 %", "", "all", [[solved["near"], CASES]], 0.99,
        at_least=True, statistic=SHARE, misprint=True,
        note="its fraction is upside down: steps too small for a gross error, too large for a slight one",
    )  # fmt: skip
