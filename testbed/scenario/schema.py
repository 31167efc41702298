"""The scenario file: what to fly, sense, estimate and expect. Whatever can be found wrong with it is found here.

A scenario is one TOML file. Sensors, plan legs and estimators declare their own keys beside their code
(`testbed.sensors`, `testbed.motion.legs`, `testbed.estimators`); the sections that belong to nobody else are here.
`Scenario.load` reports every mistake of a file at once, each with its line and key path.
"""

from __future__ import annotations

import datetime as dt
import difflib
import json
import math
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Self, TypeAlias

from pydantic import (
    AfterValidator,
    Field,
    PlainValidator,
    PrivateAttr,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError, to_json

from testbed import plugins
from testbed.data import data_dir
from testbed.errors import UserError, shown
from testbed.estimators import custom, registry
from testbed.estimators.rig import Air, Rig
from testbed.estimators.section import DEFAULT_ESTIMATOR, EstimatorSection
from testbed.motion import aircraft, legs, terrain
from testbed.motion.gusts import expected_gust
from testbed.motion.logged import LogTruth
from testbed.motion.sections import FlightTruth, KinematicTruth
from testbed.motion.weather import expected_walk
from testbed.scenario import keypath, messages, mistakes
from testbed.schema import LONGEST_RUN_S, Section
from testbed.sensors import SensorConfig, Site, faults
from testbed.sensors import registry as sensor_registry
from testbed.sensors.magnetometer import covered

LARGEST_FILE = 1_000_000  # bytes; a scenario has a few thousand

Date: TypeAlias = Annotated[dt.date, AfterValidator(covered)]


def _sensor(table: object, info: ValidationInfo) -> Section:
    """One ``[sensors.<name>]`` table, by the kind that it says or that its name says."""
    if not isinstance(table, dict):
        raise PydanticCustomError("dict_type", "Input should be a table")
    folder: Path = (info.context or {}).get("folder", Path())
    try:
        section = sensor_registry.find(_text(table.get("kind")), folder).section
    except UserError as error:
        raise PydanticCustomError("sensor_kind", "{text}", {"text": str(error)}) from None
    if table["kind"] in sensor_registry.BUILT_IN:
        return section.model_validate(table, strict=True)
    # The user's fields may be lists as well as tuples: what is read as JSON becomes either.
    return section.model_validate_json(to_json(table), strict=True)


def _estimator(table: object, info: ValidationInfo) -> EstimatorSection:
    """One ``[[estimator]]`` table, by its kind, with the keys of a class of the user's if that is asked for."""
    if not isinstance(table, dict):
        raise PydanticCustomError("dict_type", "Input should be a table")
    kind = table.get("kind", DEFAULT_ESTIMATOR)
    try:
        section = registry.find(_text(kind)).section
    except UserError as error:
        raise PydanticCustomError("estimator_kind", "{text}", {"text": str(error)}) from None
    found = section.model_validate({**table, "kind": kind}, strict=True)
    if isinstance(found, custom.CustomSection) and (folder := (info.context or {}).get("options")) is not None:
        try:
            plugins.load(found.kind, folder, custom.GROUP)
            options = custom.options_of(found.kind, folder)
            if options is not None:
                custom.checked(options, found.options)
        except ValidationError:
            raise
        except UserError as error:
            raise PydanticCustomError("estimator_kind", "{text}", {"text": str(error)}) from None
        except Exception as error:  # a validator of the user's
            raise PydanticCustomError("estimator_kind", "{text}", {"text": plugins.raised(error)}) from None
    return found


def _text(kind: object) -> str:
    if isinstance(kind, str):
        return kind
    raise UserError(f'must be text in quotes, such as "text", not {shown(kind)}')


class FeedbackConfig(Section):
    """Whose attitude and whose position: an estimator's name, or ``truth``. In the file one name may stand for both."""

    attitude: str = Field(default="truth", description="whose attitude: an estimator's name, or `truth`")
    position: str = Field(default="truth", description="whose position: an estimator's name, or `truth`")

    @model_validator(mode="before")
    @classmethod
    def _one_for_both(cls, value: Any) -> Any:
        if not isinstance(value, str | dict):
            raise ValueError(
                'must be an estimator\'s name, or a table of attitude and position; "truth" is one as well'
            )
        return {"attitude": value, "position": value} if isinstance(value, str) else value

    @property
    def estimators(self) -> tuple[str, ...]:
        """The estimators that are flown on, each once."""
        return tuple(dict.fromkeys(name for name in (self.attitude, self.position) if name != "truth"))


class AutopilotConfig(Section):
    """What the autopilot flies on: ``testbed.feeds.autopilot`` says what comes from where."""

    feedback: FeedbackConfig = Field(
        default=FeedbackConfig(),
        description="whose attitude and position is flown on: an estimator's name, `truth`, or a table of both",
    )


class RecordConfig(Section):
    """What goes into the run file: rate of truth and estimates, and whether every IMU sample is kept."""

    rate_hz: float = Field(
        default=10.0, gt=0, description="rows of truth and estimates per second; divides the tick rate"
    )
    imu: bool = Field(default=True, description="whether every IMU sample is kept")


class Bounds(Section):
    """What a metric may be, both ends included. In the file a plain number is a maximum."""

    min: float | None = Field(default=None, description="least value that is allowed")
    max: float | None = Field(default=None, description="largest value that is allowed")

    @model_validator(mode="before")
    @classmethod
    def _maximum(cls, value: Any) -> Any:
        if not isinstance(value, dict):
            return {"max": value}
        if value.keys() - {"min", "max"}:
            raise ValueError("takes a maximum, or min and max; a metric's name is quoted, as it has dots in it")
        return value

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.min is None and self.max is None:
            raise ValueError("give a maximum, or a table with min, max or both")
        if self.min is not None and self.max is not None and self.min > self.max:
            raise ValueError(f"min {self.min:g} is above max {self.max:g}")
        return self

    def hold(self, value: float) -> bool:
        """Whether ``value`` lies inside; NaN never does."""
        return (self.min is None or value >= self.min) and (self.max is None or value <= self.max) and value == value

    def __str__(self) -> str:
        if self.min is None:
            return f"≤ {self.max:g}"
        return f"≥ {self.min:g}" if self.max is None else f"{self.min:g} … {self.max:g}"


class Scenario(Section):
    """One run, described. Made by `Scenario.load`; a changed one comes from loading with overrides."""

    title: str = Field(min_length=1, description="what reports and figures are headed with")
    seed: int = Field(
        default=0, ge=0, lt=2**63, description="of all random numbers: same scenario, same seed, same bits"
    )
    duration_s: float = Field(gt=0, le=LONGEST_RUN_S, description="length of the run in simulated time")
    date: Date = Field(default=dt.date(2026, 1, 1), description="for the World Magnetic Model: of 2010 to 2029")
    truth: FlightTruth | KinematicTruth | LogTruth = Field(discriminator="source", description="the motion")
    plan: tuple[legs.Leg, ...] = Field(default=(), description="legs that a flight consists of, in order")
    sensors: dict[str, Annotated[SensorConfig, PlainValidator(_sensor)]] = Field(
        default_factory=dict, description="sensors by their names; a name is the kind unless `kind` says otherwise"
    )
    fault: tuple[faults.Fault, ...] = Field(default=(), description="what goes wrong with sensors, and when")
    estimator: tuple[Annotated[EstimatorSection, PlainValidator(_estimator)], ...] = Field(
        default=(), description="any number of estimators, side by side on the same samples"
    )
    autopilot: AutopilotConfig = Field(default=AutopilotConfig(), description="what the aircraft flies on")
    record: RecordConfig = Field(default=RecordConfig(), description="what is kept of the run")
    expect: dict[str, Bounds] = Field(
        default_factory=dict,
        description="bounds on metrics by their names, for `testbed check`; a plain number is a maximum",
    )
    golden: bool = Field(
        default=True, description="compare metrics with golden ones in `testbed check`; not where rounding decides them"
    )

    _text: str = PrivateAttr("")
    _path: Path | None = PrivateAttr(None)
    _overrides: tuple[str, ...] = PrivateAttr(())

    @property
    def text(self) -> str:
        """The file's text as written, before overrides."""
        return self._text

    @property
    def path(self) -> Path | None:
        """The file it came from, None when it did not come from one."""
        return self._path

    @property
    def overrides(self) -> tuple[str, ...]:
        """The ``key=value`` overrides applied to the text, in order: text and overrides make the scenario again."""
        return self._overrides

    @classmethod
    def load(cls, path_or_name: str | Path, overrides: Sequence[str] | Mapping[str, Any] = ()) -> Scenario:
        """Read a scenario file, or a shipped scenario by name, and check all of it.

        ``overrides`` are values by key, such as ``{"duration_s": 60, "sensors.gnss.denied": [[10, 20]]}``, or
        ``key=value`` strings as `testbed.scenario.keypath.assign` takes them. Raises UserError with every mistake
        found: file, line, key path and what to do.
        """
        if not isinstance(path_or_name, str | Path):
            raise UserError(f"Scenario.load: {shown(str(path_or_name))} is neither a file nor a shipped name")
        path = _find(path_or_name)
        return cls._parsed(_read(path), _texts(overrides, "load"), path, {"options": path.parent})

    @classmethod
    def parse(cls, text: str, overrides: Sequence[str] | Mapping[str, Any] = (), path: Path | None = None) -> Scenario:
        """The scenario that ``text`` describes; ``path`` is where it came from; all else as in `load`.

        The keys of an estimator of the user's are left to its class, which may be another one by now.
        """
        if not isinstance(text, str):
            raise UserError(f"Scenario.parse: {shown(str(text))} is no text: Scenario.load reads a file")
        return cls._parsed(text, _texts(overrides, "parse"), path, {})

    @classmethod
    def _parsed(cls, text: str, overrides: Sequence[str], path: Path | None, context: Mapping[str, Path]) -> Scenario:
        place = str(path) if path else "scenario"
        data = _toml(text, place)
        if not data:
            raise UserError(f"{place}: is empty: begin with a copy of {data_dir('scenarios') / 'u_turn.toml'}")
        set_paths = {keypath.assign(data, override): override for override in overrides}
        truth, sensors = data.get("truth"), data.get("sensors")
        if isinstance(truth, dict):
            _see_files(truth, path)
        for name, table in sensors.items() if isinstance(sensors, dict) else ():
            if isinstance(table, dict):
                table.setdefault("kind", name)
        try:
            folder = path.parent if path else Path()
            scenario = cls.model_validate(_frozen(data), strict=True, context={"folder": folder, **context})
        except ValidationError as error:
            written = messages.Written(data, text, place, set_paths, folder)
            raise UserError(*messages.report(error, cls, written)) from None
        except RecursionError:
            raise UserError(f"{place}: tables or lists are nested too deeply") from None
        scenario._text, scenario._path, scenario._overrides = text, path, tuple(overrides)
        return scenario

    @classmethod
    def of_record(cls, said: Mapping[Any, Any]) -> Scenario:
        """The scenario of a record, by the record's attributes; what is the user's is looked for where it was.

        Where that is older records don't say in full: it is seen from the working folder.

        Raises KeyError or ValueError where the attributes are no record's, UserError as `load` does.
        """
        path = str(said.get("scenario_path", ""))
        overrides = json.loads(said.get("overrides", "[]"))
        return cls.parse(str(said["scenario"]), overrides, Path(path).absolute() if path else None)

    def changed(self, values: Mapping[str, Any]) -> Scenario:
        """The same with further values by key, which belong to it from then on. Raises UserError as `load` does."""
        more = [keypath.override(key, value) for key, value in values.items()]
        return self.parse(self.text, [*self.overrides, *more], self.path)

    @property
    def leg_names(self) -> tuple[str, ...]:
        """What the motion is made of, in order: the names of a flight's legs, or of a body's segments."""
        match self.truth:
            case FlightTruth():
                return tuple(leg.leg for leg in self.plan)
            case KinematicTruth():
                return tuple(segment.leg for segment in self.truth.segments)
        return ()

    @property
    def _own_kinds(self) -> tuple[list[str], list[str]]:
        estimators = [one.kind for one in self.estimator if isinstance(one, custom.CustomSection)]
        return estimators, [one.kind for one in self.sensors.values() if one.kind not in sensor_registry.BUILT_IN]

    @property
    def has_own_code(self) -> bool:
        """Whether there is any class of the user's in it, which may end the process."""
        return any(self._own_kinds)

    def own(self) -> dict[str, dict[str, str]]:
        """Digests of the code of the user's classes, by kind. Raises UserError where one can't be had as it is now."""
        folder = self._path.parent if self._path else Path()
        estimators, sensors = self._own_kinds
        return {
            "estimators": {kind: plugins.digest(kind, folder, custom.GROUP) for kind in estimators},
            "sensors": {kind: plugins.digest(kind, folder, sensor_registry.GROUP) for kind in sensors},
        }

    def site(self) -> Site:
        """Where and when the run starts. Raises UserError of a log that nobody has looked up yet."""
        start = self.truth.start
        if start is None:
            raise UserError("truth.start: is found in the log when it is run; to know it before, give it")
        ground = self.truth.terrain
        finer = terrain.of(ground)
        map_, between = terrain.thinned(finer, ground.map_every)
        return Site(
            self.date, math.radians(start.lat_deg), math.radians(start.lon_deg), start.alt_m,
            map_, ground.map_sigma_m, math.hypot(ground.map_error_m, between), ground.map_correlation_m,
            finer, ground.map_error_m,
        )  # fmt: skip

    def rig(self, seed: int) -> Rig:
        """What builders of estimators may know of a run with this seed."""
        folder = self._path.parent if self._path else Path()
        usual = aircraft.UNKNOWN_BODY
        if isinstance(self.truth, FlightTruth | LogTruth) and self.truth.aircraft is not None:
            usual = aircraft.load(self.truth.aircraft).usual
        air = Air(expected_gust(self.truth, self.plan), expected_walk(self.truth))
        return Rig(self.sensors, self.site(), self.truth.rate_hz, seed, folder, usual, air)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        found = [
            InitErrorDetails(type=PydanticCustomError("scenario", "{text}", {"text": text}), loc=path, input=None)
            for path, text in mistakes.found(self)
        ]
        if found:
            raise ValidationError.from_exception_data("Scenario", found)
        return self


def shipped() -> dict[str, Path]:
    """The shipped scenarios by name."""
    return {path.stem: path for path in sorted(data_dir("scenarios").glob("*.toml"))}


# --- reading


def _texts(overrides: Any, method: str) -> list[str]:
    """Overrides of a method as ``key=value`` strings. Raises UserError when they are none."""
    if isinstance(overrides, Mapping):
        return [keypath.override(str(key), value) for key, value in overrides.items()]
    single = isinstance(overrides, str) or not isinstance(overrides, Iterable)
    texts: list[str] = [overrides] if single else [*overrides]
    if not all(isinstance(one, str) for one in texts):
        wanted = 'give values by key, such as {"duration_s": 60}, or a list such as ["duration_s=60"]'
        raise UserError(f"Scenario.{method}: overrides: {wanted}, not {shown(str(texts))}")
    return texts


def _find(path_or_name: str | Path) -> Path:
    """The file meant by a path or by the name of a shipped scenario."""
    named = str(path_or_name)
    known = shipped()
    if named in known:
        return known[named]
    path = Path(path_or_name)
    try:
        if path.is_dir():
            raise UserError(f"{path}: is a folder: give a scenario file in it")
        if path.exists():
            return path
    except OSError as error:  # a name that no file can have
        raise UserError(f"{named}: {error.strerror}") from None
    if path.suffix or path.parent != Path():
        raise UserError(f"{path}: no such file")
    similar = difflib.get_close_matches(named, known, n=3)
    hint = f"did you mean {' or '.join(similar)}?" if similar else f"shipped are {', '.join(known)}"
    raise UserError(f"{named}: no such file and no shipped scenario of that name: {hint}")


def _read(path: Path) -> str:
    try:
        with path.open("rb") as file:
            raw = file.read(LARGEST_FILE + 1)
    except OSError as error:
        raise UserError(f"{path}: can't be read: {error.strerror}") from None
    if len(raw) > LARGEST_FILE:
        raise UserError(f"{path}: is larger than {LARGEST_FILE // 1000} kB: is this a scenario file?")
    try:
        return raw.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        line = raw[: error.start].count(b"\n") + 1
        raise UserError(f"{path}:{line}: is not UTF-8 text: save the file as UTF-8") from None


def _toml(text: str, place: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        what, _, position = str(error).rpartition(" (at ")
        line = re.match(r"line (\d+)", position)
        at = line.group(1) if line else str(text.count("\n") + 1)
        raise UserError(f"{place}:{at}: is not valid TOML: {what}") from None
    except RecursionError:
        raise UserError(f"{place}: tables or lists are nested too deeply") from None
    except ValueError as error:  # an integer of thousands of digits
        raise UserError(f"{place}: is not valid TOML: {error}") from None


def _see_files(truth: dict[str, Any], path: Path | None) -> None:
    """Put what ``[truth]`` names as seen from the scenario file in place of what is written there."""
    folder = path.parent if path else Path()
    if isinstance(named := truth.get("aircraft"), str) and named:
        truth["aircraft"] = _aircraft(named, path)
    streams = _tables(truth.get("columns"))
    columns = [one for stream in streams for one in _tables(stream)]
    log = truth if truth.get("source") == "log" else None
    for table in (log, *streams, *columns, truth.get("wind"), truth.get("terrain")):
        if isinstance(table, dict) and isinstance(file := table.get("file"), str) and file != terrain.JACKSBORO:
            table["file"] = str(folder / file)


def _tables(of: Any) -> list[dict[str, Any]]:
    """The tables in a table, whatever else it has."""
    return [one for one in of.values() if isinstance(one, dict)] if isinstance(of, dict) else []


def _aircraft(named: str, path: Path | None) -> str:
    """A shipped aircraft's name as it is; the path of another's folder, as seen from the scenario file, in full."""
    found = None if named in aircraft.shipped() else aircraft.find(named, path.parent if path else None)
    return named if found is None else str(found)


def _frozen(value: Any) -> Any:
    """The same with tuples for lists: sections are immutable, and strict validation does not convert."""
    if isinstance(value, dict):
        return {key: _frozen(item) for key, item in value.items()}
    return tuple(map(_frozen, value)) if isinstance(value, list) else value
