"""``kind = "module:Class"``: anybody's estimator, run as ours are.

The class is the user's, found in a module, in a file beside the scenario, or by an entry point of the group
``navigation_testbed.estimators``:

    class Mine:
        def __init__(self, rig, **options): ...   # `testbed.estimators.rig.Rig`; the other keys of its [[estimator]]
        def propagate(self, imu): ...             # a block of increments, `nav.samples.ImuSamples`
        def update(self, sample): ...             # one aiding sample; None, or a list of `nav.samples.UpdateReport`
        def estimate(self): ...                   # `nav.samples.Estimate` at the end of the last increment

Samples come in the order of their times, each after the increments up to its own time; one of a kind that it does not
use it ignores. ``Options``, a pydantic model inside the class, checks its keys if it is there. Where it has them,
``predict(imu)``, ``accepts(sample)``, ``refuse(sample, reason)`` and ``listening`` of `nav.horizon.Estimator` are used;
else `Adapter` stands in for them.
"""

from __future__ import annotations

import dataclasses
import math
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, RootModel, ValidationError

from nav import strapdown
from nav.horizon import FusionHorizon
from nav.samples import Estimate, ImuSamples, Sample, UpdateReport
from testbed import plugins
from testbed.errors import UserError, choice, shown, unknown
from testbed.estimators.given import Given, Unfit
from testbed.estimators.lane import Lane, mountings
from testbed.estimators.rig import Rig
from testbed.estimators.section import EstimatorSection, Mistake
from testbed.interrupts import INTERRUPTS
from testbed.schema import keys_of
from testbed.sensors import SensorConfig

GROUP = "navigation_testbed.estimators"
METHODS = ("propagate", "update", "estimate")

T = TypeVar("T")


class CustomSection(EstimatorSection):
    """Keys of an estimator of the user's. Those that are not here are handed to its class."""

    model_config = ConfigDict(extra="allow")

    aids: tuple[str, ...] | None = Field(default=None, description="whose samples it is handed; none: of every sensor")
    estimates: Literal["motion", "attitude"] = Field(default="motion", description="attitude: no position, no velocity")

    @property
    def attitude_only(self) -> bool:
        """Whether it estimates no position and no velocity."""
        return self.estimates == "attitude"

    @property
    def options(self) -> dict[str, Any]:
        """The keys that are the class's own."""
        return dict(self.model_extra or {})

    def mistakes(self, sensors: Mapping[str, SensorConfig]) -> Iterator[Mistake]:
        """What is wrong with it among these sensors."""
        yield from super().mistakes(sensors)
        aiding = [name for name, sensor in sensors.items() if sensor.kind != "imu"]
        for index, aid in enumerate(self.aids or ()):
            if aid not in aiding:
                yield ("aids", index), unknown("sensor", aid, aiding)


def build(section: CustomSection, rig: Rig) -> Lane:
    """The user's estimator behind its fusion horizon.

    Raises UserError when its class can't be had, does not have the three methods, or refuses its options.
    """
    try:
        made = plugins.load(section.kind, rig.folder, GROUP)
    except UserError as error:
        raise UserError(f"estimator {section.name}: {error}") from None
    options = _options(section, made)
    try:
        inner = plugins.confined(made, dataclasses.replace(rig, sensors=dict(rig.sensors)), **options)
        missing = [name for name in METHODS if not callable(getattr(inner, name, None))]
    except UserError:
        raise
    except INTERRUPTS:
        raise
    except BaseException as error:
        raise UserError(f"estimator {section.name}: {section.kind} can't be made: {plugins.raised(error)}") from error
    if missing:
        raise UserError(f"estimator {section.name}: {section.kind} lacks {', '.join(missing)}: see docs/extending.md")
    used = section.aiding(rig.sensors)
    imus, voter = mountings(section, rig)
    coning = rig.imu(section.imu).rate_hz < rig.tick_rate_hz
    adapter = Adapter(inner, 1 / rig.tick_rate_hz)
    return Lane(FusionHorizon(adapter, rig.lag_s(used), coning=coning), imus, used, voter=voter)


# --- its keys


def options_of(kind: str, folder: Path) -> type[BaseModel] | None:
    """The model that checks the keys of a class; None where it has none, or can't be had, which `build` says."""
    try:
        return _model(plugins.load(kind, folder, GROUP))
    except UserError:
        return None


def _model(made: Any) -> type[BaseModel] | None:
    found = getattr(made, "Options", None)
    return found if isinstance(found, type) and issubclass(found, BaseModel) else None


def checked(options: type[BaseModel], given: Mapping[str, Any]) -> BaseModel:
    """The keys as the model of a class has them. Raises ValidationError, of a key that no field has too."""
    return plugins.confined(_strict(options).model_validate, given)


@cache
def _strict(model: type[BaseModel]) -> type[BaseModel]:
    """The same model, which refuses keys that it doesn't have, as sections do; one that says it takes any as it is."""
    if model.model_config.get("extra") in ("allow", "forbid") or issubclass(model, RootModel):
        return model
    return cast("type[BaseModel]", types.new_class(model.__name__, (model,), {"extra": "forbid"}))


def _options(section: CustomSection, made: Any) -> dict[str, Any]:
    """The class's own keys, checked by its ``Options`` if it has that."""
    options = _model(made)
    if options is None:
        return section.options
    try:
        found = checked(options, section.options)
    except ValidationError as error:  # of a record, whose class was another: where it is loaded all is said
        first = error.errors(include_url=False)[0]
        key = ".".join(map(str, first["loc"])) or "options"
        if first["type"] == "extra_forbidden":
            raise UserError(
                f"estimator {section.name}: {key}: unknown key: {choice(key, [*keys_of(options)])}"
            ) from None
        raise UserError(f"estimator {section.name}: {key}: {first['msg']}, not {shown(first['input'])}") from None
    return {name: getattr(found, name) for name in options.model_fields} | dict(found.model_extra or {})


# --- running it


class Adapter:
    """A class of three methods as an estimator of the house (`nav.horizon.Estimator`).

    What it raises, or gives that can't be used, is its end: ``failure`` says why, and from there on it has no estimate:
    ``ended`` [s] is the time of the first that it was asked for in vain, NaN until then. It is handed copies, so that
    it can't change what others see. A tick lasts ``tick_s`` [s].
    """

    def __init__(self, inner: Any, tick_s: float) -> None:
        self.inner = inner
        self.failure = ""
        self.ended = math.nan
        self._t = np.nan
        self._given = Given(tick_s)

    @property
    def listening(self) -> bool:
        """Whether a sample of some kind would still be used."""
        return self._asked(self._listening, False)

    def accepts(self, sample: Sample) -> bool:
        """Whether `update` would use the sample now."""
        return self._asked(self._accepts, False, sample)

    def propagate(self, imu: ImuSamples) -> Sequence[UpdateReport]:
        """Advance by a block of increments."""
        self._t = float(imu.t[-1])
        return self._asked(self._propagate, [], imu)

    def update(self, sample: Sample) -> list[UpdateReport]:
        """Use a sample that is valid at the estimator's own time."""
        if np.isnan(self._t):
            self._given.handed(sample.t)
        return self._asked(self._update, [], sample)

    def refuse(self, sample: Sample, reason: str) -> list[UpdateReport]:
        """The reports on a sample that came too late: none, unless it has something to say."""
        return self._asked(self._refuse, [], sample, reason)

    def estimate(self) -> Estimate:
        """The state at its own time."""
        return self._asked(self._estimate, None) or self._none(self._t)

    def predict(self, imu: ImuSamples) -> Estimate:
        """The state after further increments: its own prediction, or its estimate carried on by the increments."""
        return self._asked(self._predict, None, imu) or self._none(float(imu.t[-1]))

    def _none(self, t: float) -> Estimate:
        """In place of an estimate at ``t`` [s], of one that has ended."""
        self.ended = float(np.fmin(self.ended, t))
        return Estimate.of(t)

    def _asked(self, ask: Callable[..., T], otherwise: T, *arguments: Any) -> T:
        if self.failure:
            return otherwise
        try:
            return plugins.confined(ask, *arguments)
        except Unfit as error:
            self.failure = str(error)
        except INTERRUPTS:
            raise
        except BaseException as error:  # `sys.exit` in it, or a panic, is its own end, not the run's
            self.failure = plugins.raised(error)
        return otherwise

    # What is asked: only `_asked` calls these, for whatever is done with the user's object may raise.

    def _listening(self) -> bool:
        return bool(getattr(self.inner, "listening", True))

    def _accepts(self, sample: Sample) -> bool:
        accepts = getattr(self.inner, "accepts", None)
        return accepts is None or bool(accepts(_copied(sample)))

    def _propagate(self, imu: ImuSamples) -> list[UpdateReport]:
        given = self.inner.propagate(_copied(imu))
        return [] if given is None else self._given.reports(given, "propagate", self._t)

    def _update(self, sample: Sample) -> list[UpdateReport]:
        given = self.inner.update(_copied(sample))
        return [] if given is None else self._given.reports(given, "update", self._until(sample))

    def _refuse(self, sample: Sample, reason: str) -> list[UpdateReport]:
        refuse = getattr(self.inner, "refuse", None)
        given = None if refuse is None else refuse(_copied(sample), reason)
        return [] if given is None else self._given.reports(given, "refuse", self._until(sample))

    def _until(self, sample: Sample) -> float:
        """The newest time that it knows of [s]."""
        return float(np.fmax(self._t, sample.t_arrival))

    def _estimate(self) -> Estimate | None:
        return self._given.estimate(self.inner.estimate(), "estimate", self._t)

    def _predict(self, imu: ImuSamples) -> Estimate | None:
        predict = getattr(self.inner, "predict", None)
        if predict is not None:
            return self._given.estimate(predict(_copied(imu)), "predict", float(imu.t[-1]))
        return carried(self._given.estimate(self.inner.estimate(), "estimate", self._t), imu)


def carried(estimate: Estimate, imu: ImuSamples) -> Estimate:
    """An estimate carried on by increments, less the biases that it knows; what it does not know stays unknown."""
    ends = float(imu.t[-1])
    gyro, accel = (np.nan_to_num(bias) for bias in (estimate.gyro_bias, estimate.accel_bias))
    dt = imu.dt[:, None]
    dtheta, dv = imu.dtheta - gyro * dt, imu.dv - accel * dt
    lla, q_nb = np.array([estimate.lat, estimate.lon, estimate.h]), np.array(estimate.q_nb, dtype=float)
    v_n = np.array(estimate.v_n, dtype=float)
    moving = bool(np.isfinite(lla).all() and np.isfinite(v_n).all())
    if not moving:
        lla[:], v_n[:] = 0.0, 0.0
    strapdown.propagate(q_nb, v_n, lla, dtheta, dv, imu.dt)
    if not moving:
        return dataclasses.replace(estimate, t=ends, q_nb=q_nb)
    lat, lon, h = lla.tolist()
    return dataclasses.replace(estimate, t=ends, lat=lat, lon=lon, h=h, v_n=v_n, q_nb=q_nb)


def _copied(record: T) -> T:
    """The same record with arrays of its own."""
    changes = {}
    for name in (field.name for field in dataclasses.fields(record)):  # type: ignore[arg-type]
        value = getattr(record, name)
        if isinstance(value, np.ndarray):
            changes[name] = value.copy()
    return dataclasses.replace(record, **changes) if changes else record  # type: ignore[type-var]
