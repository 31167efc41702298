"""What an estimator of the user's gives, looked at before anybody reckons with it: it may be anything."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from numbers import Integral, Real
from typing import Any

import numpy as np

from nav.columns import VECTORS
from nav.samples import Array, Estimate, Outcome, Status, UpdateReport
from testbed import plugins
from testbed.errors import shown
from testbed.plugins import DIMENSIONS

FLOAT = np.dtype(float)
NUMBERS = ("t", "lat", "lon", "h")
ALL = sum(Status)
LIMITS = {"lat": math.pi / 2, "lon": 2 * math.pi}  # [rad]
LENGTH = 1e-3  # by which that of a quaternion may be off 1: angles are wrong by as much
SYMMETRY = 1e-3  # by which correlations across the diagonal may differ: rounding of single precision is far below
# What else the record has beside the further states of an estimate: columns and groups.
TAKEN = {*DIMENSIONS, *NUMBERS, *VECTORS, "status", "innovations",
         "sigma_position_n", "sigma_velocity_n", "sigma_attitude_n"}  # fmt: skip


class Unfit(Exception):
    """What the user's class gave can't be used. The text says what it gave, and what was wanted."""


class Given:
    """Looks at what one estimator gives; the length of what has a name must stay as it was at first.

    Numbers and arrays of another type than that of the record become of that type; arrays are copies, since a filter
    may go on in those that it gave. An estimate may be off its time by ``tick_s`` [s], as a clock that counts ticks is
    between them. Before the first increment nobody tells it the time: then it may be of the run's start, or as old as a
    sample that it was handed.
    """

    def __init__(self, tick_s: float) -> None:
        self._tick_s = tick_s
        self._reached = [0.0]  # times that it knows before the first increment
        self._innovations: dict[str, int] = {}  # by aid
        self._states: dict[str, int] = {}

    def handed(self, t: float) -> None:
        """Before the first increment a sample of ``t`` [s] is handed over."""
        if math.isfinite(t):
            self._reached = [min(t, *self._reached), max(t, *self._reached)]

    def estimate(self, given: Any, method: str, t: float) -> Estimate:
        """What a method gave as an estimate at ``t`` [s], NaN before the first increment. Raises Unfit."""
        if not isinstance(given, Estimate):
            raise Unfit(f"{method} gave {_described(given)}, not a nav.samples.Estimate")
        changes: dict[str, Any] = {}
        for name in NUMBERS:
            value = getattr(given, name)
            if not isinstance(value, float):
                changes[name] = _number(value, f"{method}: {name}")
        for name, shape in VECTORS.items():
            value = changes[name] = _array(getattr(given, name), f"{method}: {name}")
            if value.shape != shape:
                raise Unfit(f"{method}: {name} has shape {value.shape}, not {shape}")
        w, x, y, z = changes["q_nb"].tolist()
        square = w * w + x * x + y * y + z * z
        if abs(square - 1.0) > 2 * LENGTH:  # false for NaN
            raise Unfit(f"{method}: q_nb has length {math.sqrt(square):.4g}, not 1")
        if type(given.status) is not Status or not 0 <= given.status <= ALL:
            changes["status"] = _status(given.status, f"{method}: status")
        changes["extra"] = self._extra(given.extra, f"{method}: extra")
        fit = dataclasses.replace(given, **changes)
        if fit.status & Status.ALIGNED:
            self._require_time(fit.t, method, t)
        for name, limit in LIMITS.items():
            angle = getattr(fit, name)
            if limit < abs(angle) < math.inf:  # what is not finite is counted
                within = f"within {limit:.4g} either way"
                raise Unfit(f"{method}: {name} is {angle:.6g}: latitude and longitude are in radians, {within}")
        if not _is_symmetric(fit.covariance):
            raise Unfit(f"{method}: covariance is not symmetric: give 0.5 * (P + P.T)")
        return fit

    def _require_time(self, own: float, method: str, t: float) -> None:
        """Raises Unfit of an estimate of another time than ``t`` [s], NaN before the first increment."""
        begun, tick_s = not math.isnan(t), self._tick_s * (1 + LENGTH)
        known = [t] if begun else self._reached
        if own < min(known) - tick_s or own > max(known) + tick_s:  # false for NaN
            when = f"not of {t:.10g} s, the end of the last increment"
            early = "before the first increment: there its t is nan, 0, or that of a sample"
            raise Unfit(f"{method} is of {own:.10g} s, {when if begun else early}")

    def reports(self, given: Any, method: str, t: float) -> list[UpdateReport]:
        """What a method gave as a list of reports, of times until ``t`` [s]. Raises Unfit."""
        if isinstance(given, UpdateReport):
            return [self._report(given, f"{method}: a report's", t)]
        if not isinstance(given, Iterable) or isinstance(given, str):
            raise Unfit(f"{method} gave {_described(given)}, not a list of reports")
        reports = []
        for one in given:
            if not isinstance(one, UpdateReport):
                raise Unfit(f"{method} gave a list with {_described(one)} in it, not a nav.samples.UpdateReport")
            reports.append(self._report(one, f"{method}: a report's", t))
        return reports

    def _report(self, given: UpdateReport, of: str, until: float) -> UpdateReport:
        changes: dict[str, Any] = {}
        for name in ("t", "nis", "threshold", "weight"):
            value = getattr(given, name)
            unknown = value is None and name in ("nis", "threshold")
            changes[name] = math.nan if unknown else _number(value, f"{of} {name}")
            if name != "t" and changes[name] < 0:
                raise Unfit(f"{of} {name} is {changes[name]:.6g}, below 0")
        if not -math.inf < changes["t"] <= until + self._tick_s * (1 + LENGTH):
            raise Unfit(f"{of} t is {changes['t']:.10g} s, where the run is at {until:.10g} s: give that of the sample")
        for name in ("sensor", "reason"):
            if not _is_text(getattr(given, name)):
                raise Unfit(f"{of} {name} is {_described(getattr(given, name))}, not a text")
        _require_name(given.aid, f"{of} aid")
        if given.aid in DIMENSIONS:
            raise Unfit(f"{of} aid can't be called {given.aid}: the record has {given.aid} already")
        innovation = changes["innovation"] = _array(given.innovation, f"{of} innovation")
        if innovation.ndim != 1:
            raise Unfit(f"{of} innovation has shape {innovation.shape}, not (m,)")
        m = len(innovation)
        S = changes["S"] = _array(given.S, f"{of} S")
        if S.shape != (m, m):
            raise Unfit(f"{of} S has shape {S.shape}, not {(m, m)} as its innovation has {m}")
        if m:  # a sample that was refused before has none
            _require_length(self._innovations, given.aid, m, f"{of} innovation of {given.aid}")
        if m and math.isnan(changes["nis"]):
            changes["nis"] = _nis(innovation, S)
        try:
            changes["outcome"] = Outcome(given.outcome)
        except ValueError:
            raise Unfit(f"{of} outcome is {_described(given.outcome)}, not a nav.samples.Outcome") from None
        return dataclasses.replace(given, **changes)

    def _extra(self, given: Any, what: str) -> dict[str, tuple[Array, Array]]:
        if not isinstance(given, Mapping):
            raise Unfit(f"{what} is {_described(given)}, not further states by name")
        states = {}
        for name, pair in given.items():
            if name not in self._states:
                self._require_free(name, what)
            own = f"{what}: {name}"
            if not (isinstance(pair, tuple | list) or np.ndim(pair) > 1) or len(pair) != 2:
                raise Unfit(f"{own} is {_described(pair)}, not (value, sigma)")
            value, sigma = (_array(one, f"{own}, {part}") for one, part in zip(pair, ("value", "sigma"), strict=True))
            if value.ndim != 1 or not len(value):
                raise Unfit(f"{own}, value has shape {value.shape}, not (k,)")
            if sigma.shape != value.shape:
                raise Unfit(f"{own}, sigma has shape {sigma.shape}, and its value {value.shape}")
            _require_length(self._states, name, len(value), own)
            states[name] = value, sigma
        return states

    def _require_free(self, name: Any, what: str) -> None:
        """Raises Unfit when the record can't have a state of this name beside what it has."""
        _require_name(name, f"{what}: a name")
        taken = TAKEN.union(*map(_columns, self._states))
        both = sorted(_columns(name) & taken)
        if both:
            raise Unfit(f"{what}: {name} can't be a name: the record has {both[0]} already")


def _columns(name: str) -> set[str]:
    """What the record has of a further state: value, sigma, and the dimension of both."""
    return {name, f"sigma_{name}", f"{name}_component"}


def _number(value: Any, what: str) -> float:
    if isinstance(value, np.ndarray) and not value.ndim:
        value = value[()]
    if not isinstance(value, Real) or isinstance(value, bool):
        raise Unfit(f"{what} is {_described(value)}, not a number")
    return float(value)


def _nis(innovation: Array, S: Array) -> float:
    """The sum nu' S^-1 nu, NaN where ``S`` is not positive definite, or not known."""
    try:
        whitened = np.linalg.solve(np.linalg.cholesky(S), innovation)
    except np.linalg.LinAlgError:
        return math.nan
    return float(whitened @ whitened)


def _array(value: Any, what: str) -> Array:
    """An array of its own."""
    if type(value) is np.ndarray and value.dtype is FLOAT:
        return value.copy()
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        raise Unfit(f"{what} is {_described(value)}, not an array of numbers") from None
    if array.dtype.kind not in "fiu" and array.size:
        raise Unfit(f"{what} is {_described(value)}, not an array of real numbers")
    numbers: Array = array.astype(float)
    numbers[np.ma.getmaskarray(value)] = np.nan
    return numbers


def _is_symmetric(covariance: Array) -> bool:
    """Whether a covariance is the same across its diagonal; NaN is no difference."""
    sigma = np.sqrt(np.abs(np.diagonal(covariance)))
    with np.errstate(invalid="ignore", over="ignore"):
        return not (np.abs(covariance - covariance.T) > SYMMETRY * np.outer(sigma, sigma)).any()


def _status(value: Any, what: str) -> Status:
    if not isinstance(value, Integral) or not 0 <= int(value) <= ALL:
        raise Unfit(f"{what} is {_described(value)}, not a nav.samples.Status")
    return Status(int(value))


def _require_name(name: Any, what: str) -> None:
    """Raises Unfit when a group or a column of the record can't be called so."""
    if not plugins.can_be_name(name):
        raise Unfit(f"{what} is {_described(name)}, not a text that can be a name: no slash, no control character")


def _require_length(lengths: dict[str, int], name: str, length: int, what: str) -> None:
    if lengths.setdefault(name, length) != length:
        raise Unfit(f"{what} has {length} numbers, and had {lengths[name]} before")


def _is_text(value: Any) -> bool:
    """Whether it is one that can be written."""
    try:
        return isinstance(value, str) and value.encode() is not None
    except UnicodeEncodeError:
        return False


def _described(value: Any) -> str:
    """What something is, in a few words."""
    if value is None or isinstance(value, int | float | np.number):
        return str(value)
    if isinstance(value, str):
        return shown(value)
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype} of shape {value.shape}"
    name = type(value).__name__
    return f"{'an' if name[0] in 'aeiouAEIOU' else 'a'} {name}"
