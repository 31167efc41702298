"""Running a sensor of the user's: what it raises, or gives that is no sample, ends the run with its name and why."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from numbers import Real
from typing import Any

import numpy as np

import nav.samples
from testbed import plugins
from testbed.errors import UserError, shown
from testbed.motion.table import COLUMNS, TruthBlock
from testbed.schema import Section
from testbed.sensors import registry

AID = ("sensor", "parts", "states", "blocks", "measure")  # what an aid has (`nav.aids.base.Aid`)


def is_own(section: Section) -> bool:
    """Whether a section is of a sensor of the user's."""
    return getattr(section, "kind", None) not in registry.BUILT_IN


def made(name: str, section: Section, *given: Any) -> Any:
    """The user's sensor of a section, and what else its kind is given. Raises UserError where its class does."""
    try:
        return registry.of(section).sensor(name, section, *given)
    except UserError:
        raise
    except (Exception, SystemExit) as error:
        raise UserError(f"{_called(name, section)} can't be made: {plugins.raised(error)}") from error


def aid(maker: Callable[..., Any], name: str, section: Section, imu: Any) -> Any:
    """What a sensor of the user's says that it is to filters, None where nothing. Raises UserError where no aid."""
    try:
        found = maker(name, section, imu)
    except UserError:
        raise
    except (Exception, SystemExit) as error:
        raise UserError(f"{_called(name, section)}: aid: {plugins.raised(error)}") from error
    if found is None:
        return None
    missing = [one for one in AID if not hasattr(found, one)]
    if missing:
        raise UserError(f"{_called(name, section)}: aid gave {_type(found)}, which lacks {', '.join(missing)}")
    if found.sensor != name:
        raise UserError(f"{_called(name, section)}: aid gave one of sensor {shown(found.sensor)}, not {shown(name)}")
    return found


class Guard:
    """A sensor of the user's, which is handed a copy of truth. Of what it gives only samples come through."""

    def __init__(self, name: str, section: Section, sensor: Any) -> None:
        self._name, self._called, self._sensor = name, _called(name, section), sensor
        self._kind: type | None = None  # of all its samples
        self._shapes: dict[str, tuple[int, ...]] = {}  # of their numbers

    def sense(self, truth: TruthBlock) -> list[Any]:
        """The samples inside a block. Raises UserError where there are none such, or it raises."""
        try:
            given = self._sensor.sense(_copy(truth))
            if not isinstance(given, Iterable):
                raise UserError(f"{self._called}: sense gave {_type(given)}: give a list of samples, if an empty one")
            samples = [_timed(sample) for sample in given]
        except UserError:
            raise
        except (Exception, SystemExit) as error:
            raise UserError(f"{self._called}: {plugins.raised(error)}") from error
        for sample in samples:
            wrong = self._wrong(sample)
            if wrong:
                raise UserError(f"{self._called}: sense gave {wrong}")
        return samples

    def _wrong(self, sample: Any) -> str:
        """What is wrong with a sample; empty when nothing is."""
        if not dataclasses.is_dataclass(sample) or isinstance(sample, type):
            return f"{_type(sample)} where a sample was expected: a dataclass with t, t_arrival, numbers and sensor"
        missing = [one for one in ("t", "t_arrival", "sensor") if not hasattr(sample, one)]
        if missing:
            return f"{_type(sample)}, which lacks {', '.join(missing)}"
        return self._mistimed(sample) or self._unlike(sample)

    def _mistimed(self, sample: Any) -> str:
        """What is wrong with its times, or its name."""
        t, arrival, name = sample.t, sample.t_arrival, sample.sensor
        for what, value in (("t", t), ("t_arrival", arrival)):
            if not (isinstance(value, Real) and math.isfinite(value)):
                return f"a sample whose {what} is {shown(value)}: it must be a time in seconds"
        if arrival < t:
            return f"a sample that arrives at {arrival:g} s, before it is true at {t:g} s"
        if name != self._name:
            return f"a sample of sensor {shown(name)}, not {shown(self._name)}: its name is handed to the class"
        return ""

    def _unlike(self, sample: Any) -> str:
        """What is wrong with its numbers, or tells it from the samples before it."""
        kind = type(sample)
        self._kind = self._kind or kind
        if kind is not self._kind:
            return f"{kind.__name__} after {self._kind.__name__}: all samples of a sensor are of one class"
        if kind.__module__ == nav.samples.__name__:
            return ""
        for name in (field.name for field in dataclasses.fields(sample) if field.name != "sensor"):
            value = getattr(sample, name)
            try:
                shape = np.asarray(value, dtype=float).shape
            except (TypeError, ValueError):
                return f"a sample whose {name} is {shown(value)}: it must be a number or a list of them"
            if len(shape) > 1 or self._shapes.setdefault(name, shape) != shape:
                return f"a sample whose {name} has shape {shape}: it must be a number, or as many in every sample"
        return ""


def _copy(truth: TruthBlock) -> TruthBlock:
    """The same rows, which nobody else sees."""
    return TruthBlock(truth.tick, **{name: getattr(truth, name).copy() for name in COLUMNS})


def _timed(sample: Any) -> Any:
    """The same, with numbers as its times where they are arrays without dimensions."""
    times = {name: getattr(sample, name, None) for name in ("t", "t_arrival")}
    changes = {name: value[()] for name, value in times.items() if isinstance(value, np.ndarray) and not value.ndim}
    return dataclasses.replace(sample, **changes) if changes else sample


def _called(name: str, section: Section) -> str:
    return f"sensor {name}: {getattr(section, 'kind', '')}"


def _type(value: object) -> str:
    return type(value).__name__
