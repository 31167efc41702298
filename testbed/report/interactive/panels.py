"""Panels over time: errors and what is claimed of them, consistency, innovations, the flight, biases."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from nav.detection import chi_square_threshold
from nav.samples import Array
from testbed.report.figures.consistency import axes_of, refused_as
from testbed.report.figures.errors import SMOOTH_S, euler_deg, moving_rms
from testbed.report.figures.imu import AXES as BODY_AXES
from testbed.report.figures.imu import DEGPH, MG, imu_error
from testbed.report.interactive.arrays import Arrays
from testbed.report.run import Run
from testbed.report.style import NOT_USED
from testbed.score import accuracy
from testbed.score.bound import Bound

TRUTH = -1  # in place of a subject
DOTS = 1.5  # of an aid, for each bin of a line
NED = accuracy.AXES

Panel: TypeAlias = dict[str, Any]
Truths: TypeAlias = Sequence[tuple[str, Run]]


@dataclass(frozen=True, slots=True)
class Subject:
    """An estimator on a page: its place there, which line it has, what it is called, its run, and its name in that."""

    index: int
    line: int
    name: str
    run: Run
    estimator: str

    @property
    def errors(self) -> accuracy.Errors:
        """Its errors."""
        return self.run.errors[self.estimator]

    def column(self, name: str) -> Any:
        """One of its recorded columns."""
        return self.run.estimate(self.estimator, name)

    def has(self, name: str) -> bool:
        """Whether it has such a column."""
        return self.run.has(f"estimators/{self.estimator}/{name}")


def chapters(subjects: Sequence[Subject], truths: Truths, arrays: Arrays) -> list[dict[str, Any]]:
    """All panels, under their headings; what would be empty is left out."""
    positioned = [one for one in subjects if not one.errors.attitude_only]
    found: list[tuple[str, str, Iterator[Panel]]] = [
        (
            "Size of the errors",
            "Root mean square over the last 2 s, on a logarithmic axis. Dashed black, in runs with an outage: the"
            " bound, a root mean square over draws that no estimator of these sensors can be below; one run may be.",
            _sizes(subjects, positioned, arrays),
        ),
        (
            "Consistency",
            "Squared errors over claimed variances, mean of 2 s: 1 is right, above is overconfident. Green: where a"
            " consistent filter is for 95 % of the time.",
            _nees(subjects, positioned, arrays),
        ),
        ("Flight", "What was flown, and what was thought of it.", _flight(subjects, positioned, truths, arrays)),
        ("Errors and claims", "Line: error; band: ±3 σ as claimed.", _errors(subjects, positioned, arrays)),
        (
            "Innovations",
            "What each aid said that was not expected, over the σ that was expected of it. Dots: used; crosses: not"
            " used, in the colour of what became of it, at the edge if it lies beyond; dashed: the gate.",
            _innovations(subjects, arrays),
        ),
        (
            "Biases",
            "Line: estimate; band: ±3 σ as claimed; black: what the IMU measured less truth, mean of 60 s.",
            _biases(subjects, arrays),
        ),
    ]
    listed = [
        {"title": title, "note": note, "panels": [panel for panel in panels if panel["lines"] or panel.get("dots")]}
        for title, note, panels in found
    ]
    return [chapter for chapter in listed if chapter["panels"]]


def _panel(title: str, unit: str, lines: Sequence[dict[str, Any]], **more: Any) -> Panel:
    return {"title": title, "unit": unit, "lines": list(lines), **more}


def _sizes(subjects: Sequence[Subject], positioned: Sequence[Subject], arrays: Arrays) -> Iterator[Panel]:
    quantities: tuple[tuple[str, str, Sequence[Subject], Callable[[accuracy.Errors | Bound], Array]], ...] = (
        ("horizontal position error", "m", positioned, lambda e: e.horizontal),
        ("height error", "m", positioned, lambda e: np.abs(e.position[:, 2])),
        ("velocity error", "m/s", positioned, lambda e: np.asarray(np.linalg.norm(e.velocity, axis=1))),
        ("roll and pitch error", "deg", subjects, lambda e: np.rad2deg(e.tilt)),
        ("heading error", "deg", subjects, lambda e: np.rad2deg(np.abs(e.attitude[:, 2]))),
    )
    bounded: dict[int, tuple[Bound, list[str]]] = {}
    for one in subjects:
        if one.estimator in one.run.bounds:
            bound = one.run.bounds[one.estimator]
            bounded.setdefault(id(bound), (bound, []))[1].append(one.name)
    bounds = [(f"bound of {', '.join(names)}", bound) for bound, names in bounded.values()]
    for title, unit, shown, size in quantities:
        lines: list[dict[str, Any]] = []
        for one in shown:
            e = one.errors
            y = np.maximum(moving_rms(e.t, size(e), SMOOTH_S), 1e-6)
            lines.append({"of": one.index, "since": _since(e), **arrays.line(e.t, y)})
        if lines:
            lines += [
                {"of": TRUTH, "name": name, "dashed": True, **arrays.line(bound.t, size(bound))}
                for name, bound in bounds
            ]
            yield _panel(title, unit, lines, log=True)


def _since(e: accuracy.Errors) -> float:
    """From when on errors count: what is before is shown, but the axes are not made for it [s]."""
    rows = np.flatnonzero(e.valid)
    return float(e.t[rows[0]]) if len(rows) else float(e.aligned_s or 0.0)


def _nees(subjects: Sequence[Subject], positioned: Sequence[Subject], arrays: Arrays) -> Iterator[Panel]:
    bounds = [chi_square_threshold(1 - p, 3) / 3 for p in (0.025, 0.975)]
    for what, shown in (("position", positioned), ("velocity", positioned), ("attitude", subjects)):
        lines = []
        for one in shown:
            e = one.errors
            nees = np.where(e.valid, getattr(e, f"{what}_nees"), np.nan)
            if np.isfinite(nees).any():
                smooth = np.maximum(moving_rms(e.t, np.sqrt(nees), SMOOTH_S) ** 2, 1e-4)
                lines.append({"of": one.index, "since": _since(e), **arrays.line(e.t, smooth)})
        if lines:
            yield _panel(f"{what} NEES / 3", "", lines, log=True, bounds=bounds, level=1.0)


def _flight(
    subjects: Sequence[Subject], positioned: Sequence[Subject], truths: Truths, arrays: Arrays
) -> Iterator[Panel]:
    def true(values: Callable[[Run], Array]) -> list[dict[str, Any]]:
        found = [(name, run.t, values(run)) for name, run in truths]
        return [{"of": TRUTH, "name": name, **arrays.line(t, y)} for name, t, y in found if np.isfinite(y).any()]

    heights = [{"of": one.index, **arrays.line(one.column("time"), one.column("h"))} for one in positioned]
    yield _panel("height above ellipsoid", "m", [*true(lambda run: run.truth("h")), *heights], near=True)
    speeds = [
        {"of": one.index, **arrays.line(one.column("time"), np.linalg.norm(one.column("v_n")[:, :2], axis=1))}
        for one in positioned
    ]
    ground = true(lambda run: np.linalg.norm(run.truth("v_n")[:, :2], axis=1))
    yield _panel("speed over ground", "m/s", [*ground, *speeds], near=True)
    yield _panel("true airspeed", "m/s", true(lambda run: run.truth("airspeed")), near=True)
    angles = [(one.index, one.column("time"), euler_deg(one.column("q_nb"))) for one in subjects]
    for k, title in enumerate(("roll", "pitch", "heading")):
        of_truth = true(lambda run, k=k: euler_deg(run.truth("q_nb"))[:, k])  # type: ignore[misc]
        lines = [{"of": index, **arrays.line(t, euler[:, k])} for index, t, euler in angles]
        yield _panel(title, "deg", [*of_truth, *lines], **({"wraps": 360} if title == "heading" else {"near": True}))
    windy = [one for one in subjects if one.has("wind")]
    for k, title in enumerate(("wind from south", "wind from west") if windy else ()):
        of_truth = true(lambda run, k=k: run.truth("wind_n")[:, k])  # type: ignore[misc]
        lines = [_estimate(one, "wind", k, 1.0, arrays) for one in windy]
        yield _panel(title, "m/s", [*of_truth, *lines], near=True)


def _estimate(one: Subject, name: str, k: int, scale: float, arrays: Arrays) -> dict[str, Any]:
    """A further state of an estimator with what it claims of it."""
    t, values, sigma = (one.column(column) for column in ("time", name, f"sigma_{name}"))
    some = arrays.stride(len(t))
    where = {"t": arrays.add(t[some]), "y": arrays.add(scale * values[some, k])}
    return {"of": one.index, **where, "band": {"t": where["t"], "half": arrays.add(3 * scale * sigma[some, k])}}


def _errors(subjects: Sequence[Subject], positioned: Sequence[Subject], arrays: Arrays) -> Iterator[Panel]:
    groups = (
        ("position", "position error", "m", 1.0, positioned, NED),
        ("velocity", "velocity error", "m/s", 1.0, positioned, NED),
        ("attitude", "attitude error about", "deg", float(np.rad2deg(1.0)), subjects, NED),
    )
    for what, title, unit, scale, shown, axes in groups:
        for k, axis in enumerate(axes if shown else ()):
            lines = []
            for one in shown:
                e = one.errors
                some = arrays.stride(len(e.t))
                half = 3 * scale * getattr(e, f"sigma_{what}")[some, k]
                band = {"t": arrays.add(e.t[some]), "half": arrays.add(half), "about": 0}
                line = arrays.line(e.t, scale * getattr(e, what)[:, k])
                lines.append({"of": one.index, "since": _since(e), **line, "band": band})
            yield _panel(f"{title} {axis}", unit, lines, level=0.0)


# --- innovations


def _innovations(subjects: Sequence[Subject], arrays: Arrays) -> Iterator[Panel]:
    of_aids: dict[str, list[Subject]] = {}
    for one in subjects:
        for aid in accuracy.aids(one.run.dataset, one.estimator):
            if one.has(f"innovations/{aid}/innovation"):
                of_aids.setdefault(aid, []).append(one)
    for aid, shown in of_aids.items():
        found = [_innovations_of(one, aid, arrays) for one in shown]
        gates = [own["gate"] for own in found if own["gate"] is not None]
        limit = 1.6 * max(gates, default=6.0 / 1.6)
        unit = _unit(shown[0], aid)
        dots = [{key: value for key, value in own.items() if key != "gate"} for own in found]
        sensors = sorted({str(name) for one in shown for name in np.unique(one.column(f"innovations/{aid}/sensor"))})
        yield _panel(
            f"{aid} innovation / σ", unit, [], dots=dots, gate=max(gates, default=None), limit=limit, sensors=sensors
        )


def _unit(one: Subject, aid: str) -> str:
    """The unit of the innovations of an aid."""
    path = f"estimators/{one.estimator}/innovations/{aid}/innovation"
    return str(one.run.dataset[path].attrs.get("units", ""))


def _innovations_of(one: Subject, aid: str, arrays: Arrays) -> dict[str, Any]:
    """Those of one estimator: used ones by axis, and where and why others were not; the gate on one axis."""
    own = f"innovations/{aid}"
    t, z = one.column(f"{own}/sample_time"), one.column(f"{own}/innovation")
    became = refused_as(one.run, one.estimator, aid)
    gate = np.sqrt(one.column(f"{own}/threshold"))
    with np.errstate(invalid="ignore", divide="ignore"):
        normalised = z / np.sqrt(np.diagonal(one.column(f"{own}/S"), axis1=1, axis2=2))
    refused = np.isfinite(became)
    fused = np.flatnonzero(~refused)
    fused = fused[arrays.stride(len(fused), round(DOTS * arrays.bins))]
    axes = axes_of(one.run, f"estimators/{one.estimator}/{own}/innovation")
    return {
        "of": one.index,
        "axes": axes or [str(k + 1) for k in range(z.shape[1])] * (z.shape[1] > 1) or [""],
        "t": arrays.add(t[fused]),
        "y": [arrays.add(normalised[fused, k]) for k in range(z.shape[1])],
        "raw": [arrays.add(z[fused, k]) for k in range(z.shape[1])],
        "refused": float(np.mean(refused)) if len(refused) else 0.0,
        "not_used": _not_used(t, normalised, became, arrays),
        "gate": float(np.nanmax(gate)) if np.isfinite(gate).any() else None,
    }


def _not_used(t: Array, normalised: Array, became: Array, arrays: Arrays) -> list[dict[str, Any]]:
    """By what became of them: when, and the axis that is farthest off."""
    magnitude = np.where(np.isfinite(normalised), np.abs(normalised), -1.0)
    worst = normalised[np.arange(len(t)), np.argmax(magnitude, axis=1)] if len(t) else t
    found = []
    for k, outcome in enumerate(NOT_USED):
        rows = np.flatnonzero(became == outcome)
        if len(rows):
            rows = rows[arrays.stride(len(rows), 2 * arrays.bins)]
            found.append({"outcome": k, "t": arrays.add(t[rows]), "y": arrays.add(worst[rows])})
    return found


# --- biases


def _biases(subjects: Sequence[Subject], arrays: Arrays) -> Iterator[Panel]:
    units = {"gyro": ("gyro bias", DEGPH, "deg/h"), "accel": ("accelerometer bias", MG, "mg")}
    real: dict[str, dict[str, Array] | None] = {}
    for one in subjects:
        name = f"{one.name.removesuffix(one.estimator)}{one.run.imu_of(one.estimator)} - truth"
        if name not in real:
            real[name] = imu_error(one.run, one.estimator)
    for what, (title, scale, unit) in units.items():
        shown = [one for one in subjects if np.nanmax(one.column(f"sigma_{what}_bias"), initial=0.0) > 0]
        for k, axis in enumerate(BODY_AXES if shown else ()):
            known = [
                {"of": TRUTH, "name": name, **arrays.line(measured["t"], scale * measured[what][:, k])}
                for name, measured in real.items()
                if measured is not None
            ]
            estimates = [_estimate(one, f"{what}_bias", k, scale, arrays) for one in shown]
            yield _panel(f"{title} {axis}", unit, [*known, *estimates], near=True)
