"""One flight of the benchmark: motions, sensed and estimated in every case of a weather, and what is kept of it."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from nav.columns import Estimates
from nav.earth import position_difference_n
from nav.samples import Array
from testbed import sensors
from testbed.data import write_file
from testbed.denied.table import EVERY_S, Case
from testbed.estimators import registry
from testbed.estimators.lane import Lane
from testbed.feeds.known import commanded
from testbed.feeds.simulated import motion
from testbed.many.shared_flight import require_control
from testbed.motion.table import TruthBlock
from testbed.record.recorder import Recorder
from testbed.scenario import Scenario
from testbed.score import accuracy, bound
from testbed.sensors.faults import Faults

if TYPE_CHECKING:
    import xarray

PART_S = 10  # of the motion, in memory at a time
FLOWN = 0.8  # of the work, beside that for the bound


@dataclass(frozen=True, slots=True)
class Outcome:
    """What is kept of one flight at K times: errors are estimate - truth, NaN where an estimator had none to offer.

    ``t`` (K,) [s] since GNSS was lost. Of each of N ``lanes``, by names of aids, grade and estimator: ``error``
    (N, K, 2) north and east [m]; ``covariance`` (N, K, 3) claimed of them, north, both, east [m^2]; ``bound`` (N, K),
    the least RMS of the horizontal error [m], NaN where there is none; ``distance`` (N, K) flown over ground since GNSS
    was lost [m]; all NaN after a lane's own end, where others were flown longer. ``ended`` says by lane,
    ``aids/grade/estimator``, why an estimator ended by an error of its own.
    """

    weather: str
    seed: int
    t: Array
    lanes: tuple[tuple[str, str, str], ...]
    error: Array
    covariance: Array
    bound: Array
    distance: Array
    ended: Mapping[str, str]

    def lane(self, lane: tuple[str, str, str]) -> Outcome:
        """The same of one lane. Raises ValueError where there is none."""
        k = self.lanes.index(lane)
        one = {name: getattr(self, name)[k : k + 1] for name in ("error", "covariance", "bound", "distance")}
        return replace(self, lanes=(lane,), **one)

    @property
    def horizontal(self) -> Array:
        """Length of the horizontal error (N, K) [m]; of one that had no estimate it is infinite."""
        length = np.hypot(self.error[..., 0], self.error[..., 1])
        return np.where(np.isnan(length), np.inf, length)

    @property
    def normalised(self) -> Array:
        """Squared horizontal error by the claimed covariance (N, K); NaN where that is none."""
        (north, east), (a, b, c) = np.moveaxis(self.error, -1, 0), np.moveaxis(self.covariance, -1, 0)
        determinant = a * c - b * b
        with np.errstate(divide="ignore", invalid="ignore"):
            squared: Array = (c * north**2 - 2 * b * north * east + a * east**2) / determinant
        return np.where((determinant > 0) & (a > 0), squared, np.nan)


class At(NamedTuple):
    """N lanes of several flights at times that are asked for, each (draws, N, times), as `Outcome` has them."""

    horizontal: Array
    normalised: Array
    bound: Array
    distance: Array


def at(outcomes: Sequence[Outcome], marks_s: Sequence[int]) -> At:
    """The same lanes of all ``outcomes``, so long after GNSS was lost [s]."""
    found = []
    for one in outcomes:
        rows = np.searchsorted(one.t, np.array(marks_s) - accuracy.SAME_TIME_S)
        found.append((one.horizontal[:, rows], one.normalised[:, rows], one.bound[:, rows], one.distance[:, rows]))
    return At(*(np.array(column) for column in zip(*found, strict=True)))


@dataclass(slots=True)
class _Flying:
    """A case on its way: its estimators and what they said, and what went wrong with its sensors."""

    case: Case
    scenario: Scenario
    lanes: Mapping[str, Lane]
    faults: Faults
    estimates: dict[str, list[Estimates]] = field(default_factory=dict)


class _Bench:
    """Sensors of all cases. One that is the same in several, by its name, keys and ground, is sensed once."""

    def __init__(self, seed: int, rate_hz: float) -> None:
        self.seed, self.rate_hz = seed, rate_hz
        self._made: dict[str, sensors.AidingSensor | sensors.Imu] = {}
        self._sensed: dict[str, Any] = {}

    def sense(self, block: TruthBlock) -> None:
        """What every sensor delivers over the next rows."""
        self._sensed = {key: sensor.sense(block) for key, sensor in self._made.items()}

    def add(self, scenario: Scenario) -> None:
        """The sensors of one more case."""
        for name, section in scenario.sensors.items():
            key = self._key(scenario, name)
            if key not in self._made:
                self._made[key] = sensors.build(name, section, self.rate_hz, self.seed, scenario.site())

    def of(self, scenario: Scenario, name: str) -> Any:
        """What one sensor of a case delivered over the newest rows."""
        return self._sensed[self._key(scenario, name)]

    @staticmethod
    def _key(scenario: Scenario, name: str) -> str:
        return f"{name} {scenario.sensors[name]!r} {scenario.truth.terrain!r}"


def fly(cases: Sequence[Case], seed: int, tell: Callable[[float], None] = lambda share: None) -> Outcome:
    """Fly the ``cases``, which share their weather, once a route with this seed; ``tell`` hears the share that is done.

    Raises UserError when a flight gets out of control, or an estimator can't be had.
    """
    parts: list[Outcome] = []
    done = 0
    for motion_ in dict.fromkeys((case.aids.route, case.longest_s) for case in cases):
        own = [case for case in cases if (case.aids.route, case.longest_s) == motion_]
        before, share = done / len(cases), len(own) / len(cases)
        parts.append(_route(own, seed, lambda one, before=before, share=share: tell(before + share * one)))  # type: ignore[misc]
        done += len(own)

    t = max((part.t for part in parts), key=len)

    def whole(name: str) -> Array:
        return np.concatenate([_until(getattr(part, name), len(t)) for part in parts])

    lanes = tuple(lane for part in parts for lane in part.lanes)
    ended = {lane: why for part in parts for lane, why in part.ended.items()}
    columns = {name: whole(name) for name in ("error", "covariance", "bound", "distance")}
    return Outcome(parts[0].weather, seed, t, lanes, **columns, ended=ended)


def _until(rows: Array, count: int) -> Array:
    """Rows (N, K, ...) as ``count`` of them: NaN after the last."""
    whole: Array = np.full((len(rows), count, *rows.shape[2:]), np.nan)
    whole[:, : rows.shape[1]] = rows
    return whole


def _route(cases: Sequence[Case], seed: int, tell: Callable[[float], None]) -> Outcome:
    """The same of one route."""
    source = motion(cases[0].scenario, seed)
    flying = [_begin(case, seed) for case in cases]
    bench = _Bench(seed, source.rate_hz)
    records: dict[str, Recorder] = {}  # truth and samples, for the bound: those of a set of aids are of every grade's
    for one in flying:
        bench.add(one.scenario)
        records.setdefault(one.case.aids.name, Recorder(None, one.scenario, seed))
    end = round(flying[0].scenario.duration_s * source.rate_hz) + 1
    wanted = [cases[0].lost_s + t for t in range(0, cases[0].longest_s + 1, EVERY_S)]
    kept: list[Array] = []  # time, latitude, longitude and height
    tick, part = 0, round(PART_S * source.rate_hz)
    while tick < end:
        block = source.advance(min(part, end - tick))
        if not len(block):
            break
        bench.sense(block)
        rows = np.searchsorted(block.t, [t - accuracy.SAME_TIME_S for t in _within(wanted, block)])
        kept.append(np.column_stack([block.t[rows], block.lat[rows], block.lon[rows], block.h[rows]]))
        recorded: set[str] = set()
        for one in flying:
            into = None if one.case.aids.name in recorded else records[one.case.aids.name]
            recorded.add(one.case.aids.name)
            _part(one, block, bench, block.t[rows].tolist(), into)
        tick += len(block)
        tell(FLOWN * tick / end)
    require_control(source.failure)
    return _outcome(flying, records, np.concatenate(kept), seed, tell)


def _begin(case: Case, seed: int) -> _Flying:
    scenario = case.scenario
    lanes = registry.build(scenario.estimator, scenario.rig(seed))
    return _Flying(case, scenario, lanes, Faults(scenario.fault, scenario.sensors, seed), {name: [] for name in lanes})


def _within(times: Sequence[float], block: TruthBlock) -> list[float]:
    first, last = block.t[0] - accuracy.SAME_TIME_S, block.t[-1] + accuracy.SAME_TIME_S
    return [t for t in times if first <= t <= last]


def _part(one: _Flying, block: TruthBlock, bench: _Bench, times: Sequence[float], record: Recorder | None) -> None:
    """Some rows of the motion in one case; what the ``record`` wants of them is the same in others."""
    found = {name: one.faults.apply(name, bench.of(one.scenario, name)) for name in one.scenario.sensors}
    imu = {name: found.pop(name) for name, section in one.scenario.sensors.items() if section.kind == "imu"}
    if record is not None:
        for name, samples in found.items():
            record.samples(name, samples)
        record.truth(block)
    for name, lane in one.lanes.items():
        one.estimates[name].append(lane.track(commanded(block), imu, found, times).estimates)


def _outcome(
    flying: Sequence[_Flying], records: Mapping[str, Recorder], kept: Array, seed: int,
    tell: Callable[[float], None],
) -> Outcome:  # fmt: skip
    t = kept[:, 0]
    trees = {name: record.dataset() for name, record in records.items()}
    names, errors, covariances, bounds = [], [], [], []
    for k, one in enumerate(flying):
        least: dict[str, bound.Bound | None] = {}
        for section in one.scenario.estimator:
            aids = " ".join(section.aiding(one.scenario.sensors))
            if aids not in least:
                least[aids] = bound.of_estimator(trees[one.case.aids.name], one.scenario, section)
            found = least[aids]
            names.append((one.case.aids.name, one.case.grade.name, section.name))
            bounds.append(np.full(len(t), np.nan) if found is None else np.interp(t, found.t, found.horizontal))
            error, covariance = _errors(Estimates.of(one.estimates[section.name]), kept)
            errors.append(error)
            covariances.append(covariance)
        tell(FLOWN + (1 - FLOWN) * (k + 1) / len(flying))
    ended = {
        "/".join((one.case.aids.name, one.case.grade.name, name)): lane.failure
        for one in flying for name, lane in one.lanes.items() if lane.failure
    }  # fmt: skip
    distance = np.tile(_flown(next(iter(trees.values())), t), (len(names), 1))
    return Outcome(
        flying[0].case.weather.name, seed, t - t[0], tuple(names), np.array(errors), np.array(covariances),
        np.array(bounds), distance, ended,
    )  # fmt: skip


def _errors(estimates: Estimates, kept: Array) -> tuple[Array, Array]:
    """Horizontal errors (K, 2) [m] and their claimed covariance (K, 3) [m^2]; the IMU sits at the centre of gravity."""
    P = estimates.covariance
    error = position_difference_n(estimates.lat, estimates.lon, estimates.h, *kept.T[1:])
    return error[:, :2], np.column_stack([P[:, 0, 0], P[:, 0, 1], P[:, 1, 1]])


def _flown(tree: xarray.DataTree, t: Array) -> Array:
    """Distance over ground (K,) [m] since GNSS was lost."""
    at, v_n = accuracy.column(tree, "truth/time"), accuracy.column(tree, "truth/v_n")
    way = np.append(0.0, np.cumsum(np.diff(at) * np.hypot(v_n[1:, 0], v_n[1:, 1])))
    flown: Array = np.interp(t, at, way) - np.interp(t[0], at, way)
    return flown


# --- on disk


def store(outcome: Outcome, path: Path) -> None:
    """Write an outcome, whole or not at all."""
    content = io.BytesIO()
    np.savez_compressed(
        content, t=outcome.t, distance=outcome.distance, lanes=np.array(outcome.lanes), error=outcome.error,
        covariance=outcome.covariance, bound=outcome.bound,
        told=np.array(json.dumps({"weather": outcome.weather, "seed": outcome.seed, "ended": dict(outcome.ended)})),
    )  # fmt: skip
    write_file(path, content.getvalue())


def stored(path: Path) -> Outcome | None:
    """A stored outcome; None when there is none, or none that can be read."""
    try:
        with np.load(io.BytesIO(path.read_bytes())) as file:
            arrays: dict[str, Any] = {name: file[name] for name in file.files}
        told = json.loads(str(arrays.pop("told")))
        lanes = tuple((str(aids), str(grade), str(name)) for aids, grade, name in arrays.pop("lanes"))
        return Outcome(**told, lanes=lanes, **arrays)
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None
