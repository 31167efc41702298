"""Running a sensor of the user's, and its aid: what they raise, or give that is no sample and no measurement, ends the
run with its name and why.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from numbers import Real
from typing import Any, cast

import numpy as np

import nav.aids
import nav.samples
from nav.aids.base import Measurement, OperatingPoint
from nav.error_model import Block
from nav.samples import Array
from testbed import plugins
from testbed.errors import UserError, shown
from testbed.interrupts import INTERRUPTS
from testbed.motion.table import COLUMNS, TruthBlock
from testbed.schema import Section
from testbed.sensors import registry
from testbed.sensors.timing import AidingTiming

# Of the arrays in samples of ours, those that have not three numbers.
OURS: Mapping[str, tuple[int, ...]] = {"q_ib": (4,), "wind_n": (2,), "flow_b": (2,), "rotation_b": (2,)}
TAKEN = ("time", "component")  # what the record has beside the fields of a sample: its times, and places in lists
AID = ("sensor", "parts", "states", "blocks", "measure")  # what an aid has (`nav.aids.base.Aid`)


def is_own(section: Section) -> bool:
    """Whether a section is of a sensor of the user's."""
    return getattr(section, "kind", None) not in registry.BUILT_IN


def made(name: str, section: Section, *given: Any) -> Any:
    """The user's sensor of a section, and what else its kind is given. Raises UserError where its class does."""
    try:
        return plugins.confined(registry.of(section).sensor, name, section, *given)
    except UserError:
        raise
    except INTERRUPTS:
        raise
    except BaseException as error:
        raise UserError(f"{_called(name, section)} can't be made: {plugins.raised(error)}") from error


def aid(maker: Callable[..., Any], name: str, section: Section, imu: Any) -> Any:
    """What a sensor of the user's says that it is to filters, None where nothing. Raises UserError where no aid.

    One of a class of the user's is guarded, also where that is made of one of `nav.aids`; one of these is what it is.
    """
    try:
        found = plugins.confined(maker, name, section, imu)
    except UserError:
        raise
    except INTERRUPTS:
        raise
    except BaseException as error:
        raise UserError(f"{_called(name, section)}: aid: {plugins.raised(error)}") from error
    if found is None:
        return None
    missing = [one for one in AID if not hasattr(found, one)]
    if missing:
        raise UserError(f"{_called(name, section)}: aid gave {_type(found)}, which lacks {', '.join(missing)}")
    if found.sensor != name:
        raise UserError(f"{_called(name, section)}: aid gave one of sensor {shown(found.sensor)}, not {shown(name)}")
    if _is_ours(type(found)):
        return found
    if any(map(_is_ours, type(found).__mro__)):
        _require_names(f"{_called(name, section)}: aid", found.parts)
        return _as_made(found, getattr(section, "kind", ""))
    return AidGuard(name, f"{_called(name, section)}: aid", found)


def is_own_aid(aid: Any) -> bool:
    """Whether an aid is of a class of the user's."""
    return not _is_ours(type(aid))


def _is_ours(kind: type) -> bool:
    """Whether a class is one of `nav.aids`, which filters know."""
    return kind.__module__.startswith(f"{nav.aids.__name__}.") and kind.__module__ != nav.aids.base.__name__


def _as_made(found: Any, of: str) -> Any:
    """A copy of an aid made of one of ours, guarded as `AidGuard` does, which filters still know by its class."""
    kind: Any = type(found)
    guarded = copy.copy(found)
    object.__setattr__(guarded, "__class__", _guarding(kind, of))  # it may be frozen
    return guarded


@cache
def _guarding(kind: Any, of: str) -> type:
    """The guarded class of a class made of one of ours, which the sensor's kind gives: one, as filters compare them.

    What takes the place of `measure` where it is ours is off: no kernel knows what the user's measures.
    """

    class Guarded(kind):  # type: ignore[misc]
        __slots__ = ()
        plain = None

        def blocks(self) -> list[Block]:
            return _blocks(f"sensor {self.sensor}: {of}: aid", super().blocks)

        def measure(self, part: str, sample: Any, at: OperatingPoint) -> Measurement | None:
            called = f"sensor {self.sensor}: {of}: aid"
            return _measured(called, dict(self.parts)[part], super().measure, part, sample, at)

        def at_points(self, *_: Any) -> None:  # one by one
            return None

    return Guarded


def _require_names(called: str, parts: Sequence[tuple[str, int]]) -> None:
    """Raise UserError where groups of the record can't be called as parts are."""
    names = [name for name, _ in parts]
    for name in names:
        if not plugins.can_be_name(name) or name in plugins.DIMENSIONS or names.count(name) > 1:
            told = "a name without a slash or control characters, no dimension of the record, another for each"
            raise UserError(f"{called}: parts has {shown(name)}: give {told}")


class AidGuard:
    """An aid of the user's. Of what `measure` gives only measurements come through (`nav.aids.base.Aid`).

    Raises UserError where it gives anything else, or raises.
    """

    def __init__(self, name: str, called: str, own: Any) -> None:
        self.sensor, self._called, self._aid = name, called, own
        try:
            self.parts: tuple[tuple[str, int], ...] = tuple((str(part), int(axes)) for part, axes in own.parts)
            self.states: tuple[str, ...] = tuple(map(str, own.states))
        except (TypeError, ValueError):
            given = f"parts = {shown(str(own.parts))} and states = {shown(str(own.states))}"
            raise UserError(f"{called}: {given}: give pairs of a name and its axes, and names") from None
        _require_names(called, self.parts)

    def blocks(self) -> list[Block]:
        """Its error states."""
        return _blocks(self._called, self._aid.blocks)

    def measure(self, part: str, sample: Any, at: OperatingPoint) -> Measurement | None:
        """One part of a sample."""
        return _measured(self._called, dict(self.parts)[part], self._aid.measure, part, sample, at)


def require_alike(aids: Iterable[Any]) -> None:
    """Raise UserError when parts of two aids of a filter have one name, as in the record, and not as many axes."""
    known: dict[str, int] = {}
    for aid in aids:
        for part, axes in aid.parts:
            if known.setdefault(part, axes) != axes:
                told = f"has {axes} axes, and that of another {known[part]}: give it a name of its own"
                raise UserError(f"sensor {aid.sensor}: aid: part {shown(part)} {told}")


def _blocks(called: str, ask: Callable[[], Any]) -> list[Block]:
    """The error states that an aid gives."""
    found = _asked(called, ask)
    if not (isinstance(found, list) and all(isinstance(one, Block) for one in found)):
        raise UserError(f"{called}: blocks gave {shown(str(found))}: give a list of nav.error_model.Block")
    return found


def _measured(
    called: str, axes: int, ask: Callable[..., Any], part: str, sample: Any, at: OperatingPoint
) -> Measurement | None:
    """What an aid makes of one part of a sample."""
    own = at._replace(state=at.state.copy(), x=at.x.copy(), P=at.P.copy())  # which it may write into
    given = _asked(called, ask, part, sample, own)
    if given is None:
        return None
    if wrong := _no_measurement(given, axes, len(at.x)):
        raise UserError(f"{called}: measure gave {wrong} of {shown(part)} at {sample.t:g} s")
    nu, H, R = (np.array(numbers, dtype=float) for numbers in (given.nu, given.H, given.R))
    return cast("Measurement", given._replace(nu=nu, H=H, R=R))


def _asked(called: str, ask: Callable[..., Any], *given: Any) -> Any:
    try:
        return plugins.confined(ask, *given)
    except UserError:
        raise
    except INTERRUPTS:
        raise
    except BaseException as error:
        raise UserError(f"{called}: {plugins.raised(error)}") from error


def _no_measurement(given: Any, axes: int, states: int) -> str:
    """What is wrong with a measurement by so many axes and states; empty when nothing is."""
    if not isinstance(given, Measurement):
        return f"{_type(given)} where a Measurement or None was expected"
    for what, value, shape in (("nu", given.nu, (axes,)), ("H", given.H, (axes, states)), ("R", given.R, (axes,))):
        try:
            numbers = _numbers(value)
        except (TypeError, ValueError):
            return f"{what} = {shown(value)}, which are no numbers,"
        if numbers.shape != shape:
            return f"{what} of shape {numbers.shape}, not {shape},"
        if not np.isfinite(numbers).all():
            return f"{what} = {numbers.tolist()}"
    return "" if (np.asarray(given.R) > 0).all() else f"variances R = {np.asarray(given.R).tolist()}, not above 0,"


class Guard:
    """A sensor of the user's, which is handed a copy of truth. Of what it gives only samples come through."""

    def __init__(self, name: str, section: Section, sensor: Any) -> None:
        self._name, self._called, self._sensor = name, _called(name, section), sensor
        self._period_s = 1 / cast("AidingTiming", section).rate_hz
        self._kind: type | None = None  # of all its samples
        self._shapes: dict[str, tuple[int, ...]] = {}  # of their numbers
        self._shared: dict[int, tuple[Any, Any]] = {}  # arrays that were in several samples, and with what

    def sense(self, truth: TruthBlock) -> list[Any]:
        """The samples inside a block. Raises UserError where there are none such, or it raises."""
        try:
            given, samples = plugins.confined(self._sensed, truth)
            wrong = next(filter(None, (self._wrong(sample, _ends(truth)) for sample in samples)), "")
        except UserError:
            raise
        except INTERRUPTS:
            raise
        except BaseException as error:
            raise UserError(f"{self._called}: {plugins.raised(error)}") from error
        if isinstance(given, Sequence):
            wrong = wrong or self._overwritten(samples)
        if wrong:
            raise UserError(f"{self._called}: sense gave {wrong}")
        return [_in_arrays(_owned(sample) if isinstance(given, Sequence) else sample) for sample in samples]

    def _sensed(self, truth: TruthBlock) -> tuple[Iterable[Any], list[Any]]:
        """What it gives, and what is in it."""
        given = self._sensor.sense(_copy(truth))
        if not isinstance(given, Iterable):
            raise UserError(f"{self._called}: sense gave {_type(given)}: give a list of samples, if an empty one")
        # One that is made at a time is copied at once: the next may be written into the same arrays.
        return given, [_timed(sample) if isinstance(given, Sequence) else _owned(_timed(sample)) for sample in given]

    def _overwritten(self, samples: Sequence[Any]) -> str:
        """That an array is in several samples, and has changed: they all have what was written last."""
        found = [{_place(value): (name, value) for name, value in _arrays(sample).items()} for sample in samples]
        times, shared = Counter(place for one in found for place in one), {}
        for place, (name, value) in [pair for one in found for pair in one.items()]:
            if times[place] > 1:
                shared[place] = before = self._shared.get(place, (value, value.copy()))
                if not np.array_equal(np.asarray(before[1], float), np.asarray(value, float), equal_nan=True):
                    return f"one array as {name} of several samples, and overwrote it: give each a copy"
        self._shared = shared
        return ""

    def _wrong(self, sample: Any, until: float) -> str:
        """What is wrong with a sample of a block that ends at ``until`` [s]; empty when nothing is."""
        if not dataclasses.is_dataclass(sample) or isinstance(sample, type):
            return f"{_type(sample)} where a sample was expected: a dataclass with t, t_arrival, numbers and sensor"
        missing = [one for one in ("t", "t_arrival", "sensor") if not hasattr(sample, one)]
        if missing:
            return f"{_type(sample)}, which lacks {', '.join(missing)}"
        return self._mistimed(sample, until) or self._unlike(sample)

    def _mistimed(self, sample: Any, until: float) -> str:
        """What is wrong with its times, or its name. Its stamp may be late, but not by more than a period."""
        t, arrival, name = sample.t, sample.t_arrival, sample.sensor
        for what, value in (("t", t), ("t_arrival", arrival)):
            if not (isinstance(value, Real) and math.isfinite(value)):
                return f"a sample whose {what} is {shown(value)}: it must be a time in seconds"
        if t < 0:
            return f"a sample of {t:g} s, before the run begins: leave it out"
        if arrival < t:
            return f"a sample that arrives at {arrival:g} s, before it is true at {t:g} s"
        if t > until + self._period_s:
            return f"a sample of {t:g} s inside a block of truth that ends at {until:g} s: give it with a later block"
        if name != self._name:
            return f"a sample of sensor {shown(name)}, not {shown(self._name)}: its name is handed to the class"
        return ""

    def _unlike(self, sample: Any) -> str:
        """What is wrong with its numbers, or tells it from the samples before it."""
        kind = type(sample)
        if self._kind is None:
            self._kind = kind
            if wrong := _unrecordable(kind):
                return wrong
        if kind is not self._kind:
            return f"{kind.__name__} after {self._kind.__name__}: all samples of a sensor are of one class"
        ours = kind.__module__ == nav.samples.__name__
        for name, of in ((field.name, field.type) for field in dataclasses.fields(sample) if field.name != "sensor"):
            value = getattr(sample, name)
            try:
                shape = _numbers(value).shape
            except OverflowError:
                return f"a sample whose {name} is an integer beyond 1.8e308: it must be a number or a list of them"
            except (TypeError, ValueError):
                shape = None
            if shape is None or value is None or 0 in shape:
                return f"a sample whose {name} is {shown(value)}: it must be a number or a list of them"
            wanted = OURS.get(name, (3,)) if of == "Array" else ()
            if ours and shape != wanted:
                return f"a {kind.__name__} whose {name} has shape {shape}, not {wanted}"
            if len(shape) > 1 or self._shapes.setdefault(name, shape) != shape:
                return f"a sample whose {name} has shape {shape}: it must be a number, or as many in every sample"
        return ""


def _numbers(value: Any) -> Array:
    """A number, or an array of them. Raises TypeError or ValueError: text is none, though NumPy would read "1.5"."""
    given = np.asarray(value)
    ones = given.flat if given.dtype.kind == "O" else ()
    if given.dtype.kind not in "fiubO" or any(isinstance(one, str | bytes) for one in ones):
        raise TypeError
    return given.astype(float)


def _ends(truth: TruthBlock) -> float:
    """The end of a block [s]; one without rows has none."""
    return float(truth.t[-1]) if len(truth) else math.inf


def _unrecordable(kind: Any) -> str:
    """What the record can't have of a class of samples, a name or a text of its metadata; empty without."""
    taken = {*TAKEN, *(f"{one.name}_component" for one in dataclasses.fields(kind))}
    for one in dataclasses.fields(kind):
        if one.name in taken:
            return f"a sample with a field {one.name}, which the record has already: give it another name"
        for key in ("unit", "meaning"):
            text = str(one.metadata.get(key, ""))
            if text != text.encode(errors="ignore").decode():
                return f"a sample whose {one.name} has the {key} {shown(text)}, which can't be written as UTF-8"
    return ""


def _place(value: Any) -> int:
    """Where the numbers of an array are kept, or which list they are in."""
    return int(value.__array_interface__["data"][0]) if isinstance(value, np.ndarray) else id(value)


def _arrays(sample: Any) -> dict[str, Any]:
    """The arrays and lists of a sample."""
    values = {field.name: getattr(sample, field.name) for field in dataclasses.fields(sample)}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray | list)}


def _owned(sample: Any) -> Any:
    """The same with arrays that nobody else writes into."""
    if not dataclasses.is_dataclass(sample) or isinstance(sample, type):
        return sample
    arrays = _arrays(sample)
    if not arrays:
        return sample
    own = copy.copy(sample)
    for name, value in arrays.items():
        object.__setattr__(own, name, value.copy())  # it may be frozen
    return own


def _in_arrays(sample: Any) -> Any:
    """The same with arrays for lists and tuples of numbers."""
    values = ((field.name, getattr(sample, field.name)) for field in dataclasses.fields(sample))
    lists = {name: np.array(value, dtype=float) for name, value in values if isinstance(value, list | tuple)}
    if not lists:
        return sample
    own = copy.copy(sample)
    for name, value in lists.items():
        object.__setattr__(own, name, value)  # it may be frozen
    return own


def _copy(truth: TruthBlock) -> TruthBlock:
    """The same rows, which nobody else sees."""
    return TruthBlock(truth.tick, **{name: getattr(truth, name).copy() for name in COLUMNS})


def _timed(sample: Any) -> Any:
    """The same, with numbers of Python as its times where they are arrays without dimensions, or in single precision.

    Beside a single number NumPy compares in single precision, in an array not.
    """
    if not dataclasses.is_dataclass(sample) or isinstance(sample, type):
        return sample
    times = {name: getattr(sample, name, None) for name in ("t", "t_arrival")}
    changes = {
        name: value.item()
        for name, value in times.items()
        if (isinstance(value, np.ndarray) and not value.ndim)
        or (isinstance(value, np.generic) and not isinstance(value, float))
    }
    return dataclasses.replace(sample, **changes) if changes else sample


def _called(name: str, section: Section) -> str:
    return f"sensor {name}: {getattr(section, 'kind', '')}"


def _type(value: object) -> str:
    return type(value).__name__
