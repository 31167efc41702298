"""The scenario file: what to fly, sense, estimate and expect. Whatever can be found wrong with it is found here.

A scenario is one TOML file. Sensors and plan legs declare their own keys beside their code (`testbed.sensors`,
`testbed.motion.legs`); the sections that belong to nobody else are here. `Scenario.load` reports every mistake of a
file at once, each with its line and key path.
"""

from __future__ import annotations

import datetime as dt
import difflib
import json
import math
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeAlias, get_args

from pydantic import Field, PlainValidator, PrivateAttr, ValidationError, model_validator
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

from testbed import measures
from testbed.data import data_dir
from testbed.errors import UserError
from testbed.motion import aircraft, guidance, legs
from testbed.motion.sections import FlightTruth, KinematicTruth
from testbed.scenario import keypath
from testbed.scenario.keypath import KeyPath
from testbed.schema import Heading, Section
from testbed.sensors import CONFIGS, SensorConfig, Site, faults
from testbed.sensors.magnetometer import WMM_YEARS
from testbed.sensors.timing import TICK_TOLERANCE

LONGEST_RUN_S = 48 * 3600.0  # longer than any aircraft of this class flies; a slip of the keyboard beyond that
LARGEST_FILE = 1_000_000  # bytes; a scenario has a few thousand
LONGEST_NAME = 32  # as the record keeps them
ERRORS_SHOWN = 20
CHOICES_SHOWN = 16
MISSING = "is missing: add it"

Date: TypeAlias = Annotated[dt.date, Field(ge=dt.date(WMM_YEARS[0], 1, 1), lt=dt.date(WMM_YEARS[1], 1, 1))]

# What each kind of estimator can be aided by.
SEVERAL = frozenset({"body_velocity", "star_tracker", "position_fix"})  # and by several sensors of a kind
AIDS: Mapping[str, frozenset[str]] = {
    "ins": frozenset({"gnss", "barometer", "magnetometer", "airspeed"}) | SEVERAL,
    "federated": frozenset({"gnss", "barometer", "magnetometer", "airspeed"}) | SEVERAL,
    "ahrs": frozenset({"barometer", "magnetometer", "airspeed"}),
}
# The keys that only these kinds of estimator have.
OWN_KEYS: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(
        (
            "locals", "structure", "sharing", "combination", "retention", "weighting", "fusion_period_s",
            "isolate_after", "readmit_after", "recall_s", "cross_check",
        ),
        ("federated",),
    ),
    **dict.fromkeys(("heading_deg", "levelling", "level", "autopilot"), ("ahrs",)),
    **dict.fromkeys(("handover", "nonholonomic_mps", "states"), ("ins", "federated")),
    **dict.fromkeys(("engine", "course", "sage_husa", "fading", "false_rejection"), ("ins",)),
    "literal": ("federated", "ahrs"),
}  # fmt: skip

_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_EXPECT_KEY = re.compile(r"(?P<whose>[A-Za-z_][A-Za-z0-9_]*)\.(?P<metric>[a-z0-9_]+(\.[A-Za-z0-9_]+)*)")
_TAG_KEYS = ("leg", "source", "kind")  # whose values tell sections of a union apart
_RESERVED = frozenset({"run", "flight", "truth"})  # `run.wall_s` and the like would become ambiguous


def _sensor(table: object) -> Section:
    """One ``[sensors.<name>]`` table, by the kind that it says or that its name says."""
    if not isinstance(table, dict):
        raise PydanticCustomError("dict_type", "Input should be a table")
    kind = table.get("kind")
    if not isinstance(kind, str) or kind not in CONFIGS:
        raise PydanticCustomError("sensor_kind", "unknown sensor kind")
    return CONFIGS[kind].model_validate(table, strict=True)


class DetectorConfig(Section):
    """What judges the samples of a local filter; ``false_alarm`` is the probability per look (`nav.detection`)."""

    kind: Literal["chi_square", "eraim", "sprt", "glr", "none"] = Field(
        default="chi_square", description="how the samples are judged"
    )
    false_alarm: float | None = Field(
        default=None,
        gt=0,
        lt=0.5,
        description="probability per sample without a fault; none: 1e-3 of one look, 1e-6 of gathered evidence",
    )
    mean: Literal["plain", "window", "exponential", "eq20"] = Field(
        default="exponential", description="sprt: of what it has gathered; eq20 as Zhou et al. 2025 print it"
    )
    forgetting: float = Field(
        default=0.95, gt=0, lt=1, description="sprt, mean exponential or eq20: what a look leaves of the weight before"
    )
    reset: Literal["none", "fast", "complete"] = Field(default="complete", description="sprt: when a fault seems over")
    window_s: float = Field(
        default=40.0,
        gt=0,
        le=600,
        description="glr: how long ago the fault may have begun; sprt, mean window: its span",
    )

    @model_validator(mode="after")
    def _own_keys(self) -> Self:
        for key, kinds, means in (
            ("mean", ("sprt",), ()),
            ("forgetting", ("sprt",), ("exponential", "eq20")),
            ("reset", ("sprt",), ()),
            ("window_s", ("glr", "sprt"), ("window",)),
        ):
            if key in self.model_fields_set and self.kind not in kinds:
                named = " or ".join(map(repr, kinds))
                raise ValueError(f"{key} is a key of kind {named}, not of {self.kind!r}: leave it out")
            if key in self.model_fields_set and self.kind == "sprt" and means and self.mean not in means:
                named = " or ".join(map(repr, means))
                raise ValueError(f"{key} is a key of mean {named}, not of {self.mean!r}: leave it out")
        if self.kind == "none" and self.false_alarm is not None:
            raise ValueError("false_alarm is no key of kind 'none', which condemns nothing: leave it out")
        return self


class PolicyConfig(Section):
    """What the variances of a sample are taken for (`nav.weighting`).

    ``inflate`` makes the R of a suspect sample that the detector has let pass so large that its distance is at the
    limit (`MahalanobisInflation`); ``sage_husa`` learns R from the residuals, and the detector judges by that.
    """

    kind: Literal["inflate", "sage_husa"] = Field(description="weaken what is suspect, or learn the noise")
    false_alarm: float = Field(default=0.01, gt=0, lt=0.5, description="inflate: of the limit, probability per look")
    reject_above: float | None = Field(
        default=None, gt=0, description="inflate: squared distance to leave out; none: never"
    )
    solver: Literal["reciprocal", "newton"] = Field(
        default="reciprocal", description="inflate: Newton's method on the distance's reciprocal, or on itself"
    )
    b: float = Field(default=0.97, ge=0.5, lt=1, description="sage_husa: forgetting factor per look")

    @model_validator(mode="after")
    def _own_keys(self) -> Self:
        for key in self.model_fields_set - {"kind"}:
            kind = "sage_husa" if key == "b" else "inflate"
            if kind != self.kind:
                raise ValueError(f"{key} is a key of kind {kind!r}, not of {self.kind!r}: leave it out")
        return self


class LocalConfig(Section):
    """One local filter of a federated estimator."""

    name: str = Field(description="what reports and metrics call it")
    aids: Annotated[tuple[str, ...], Field(min_length=1)] = Field(
        description="sensors whose samples it uses, by their names"
    )
    share: float | None = Field(default=None, gt=0, le=1, description="of the information; all alike without")
    engine: Literal["linear", "unscented"] = Field(default="linear", description="derivatives or sigma points")
    detector: DetectorConfig = Field(default=DetectorConfig(), description="what judges the samples")
    policy: PolicyConfig | None = Field(default=None, description="what it does to R; none: R is as told")


class HandoverConfig(Section):
    """The state that somebody else's navigation hands over at the start, instead of alignment: its errors, 1 sigma."""

    level_deg: float = Field(gt=0, le=20, description="error of roll and pitch each")
    heading_deg: float = Field(gt=0, le=90, description="error of the heading")
    velocity_mps: float = Field(gt=0, le=100, description="error of velocity per axis")
    position_m: float = Field(gt=0, le=1e4, description="error of position per axis")


class LevelConfig(Section):
    """When an AHRS takes specific force for tilt, and how far it follows; with airspeed as without.

    Defaults are those of Jiang et al. 2021 (`nav.motion.LowDynamics`, `nav.ahrs.AhrsConfig`).
    """

    acceleration_mps2: float = Field(default=0.2, gt=0, le=10, description="largest acceleration at which it levels")
    yaw_rate_degps: float = Field(
        default=0.5, gt=0, le=100, description="largest rate about the body's down axis at which it levels"
    )
    roll_rate_degps: float = Field(
        default=2.0, gt=0, le=100, description="largest rate about the body's forward axis at which it levels"
    )
    test: Literal["norm", "vector"] = Field(
        default="norm",
        description="acceleration by the size of specific force less gravity, or by its vector less gravity",
    )
    force_sigma_mps2: float = Field(default=0.1, gt=0, le=10, description="of a second's mean, as a sign of tilt")
    limit_deg: float = Field(default=0.2, gt=0, le=20, description="largest correction per second and axis")
    gyro_bias_feedback: bool = Field(default=False, description="biases of the level gyros are taken off as well")


class CourseConfig(Section):
    """GNSS course as a look at the heading: with the wind where airspeed aids, taken for heading where it does not."""

    max_turn_rate_degps: float | None = Field(default=None, gt=0, le=360, description="none: in turns as well")
    quiet_s: float = Field(default=2.0, ge=0, le=60, description="for how long it must not have turned faster")


class SageHusaConfig(Section):
    """Measurement noise learned from the residuals (`nav.weighting.SageHusa`)."""

    b: float = Field(default=0.97, ge=0.5, lt=1, description="forgetting factor per look")


class FadingConfig(Section):
    """Covariance made as large as the innovations say when they diverge (`nav.weighting.Fading`)."""

    window: int = Field(default=10, ge=1, le=1000, description="looks")
    alpha: float = Field(default=20.0, ge=1, le=100, description="times the expected innovation is divergence")
    looks: Annotated[tuple[Literal["gnss_position", "gnss_velocity", "gnss_course"], ...], Field(min_length=1)] = Field(
        default=(
            "gnss_position",
            "gnss_velocity",
            "gnss_course",
        ),
        description="innovations that are watched",
    )


ImuStates: TypeAlias = Literal["biases", "full"]


class EstimatorConfig(Section):
    """One ``[[estimator]]``: which IMU it integrates and which sensors aid it.

    A federated one lists its aids by local filter instead (`nav.federated.Config` explains its keys).
    """

    name: str = Field(description="what the record, metrics and figures call it")
    kind: Literal["ins", "federated", "ahrs"] = Field(default="ins", description="which estimator")
    imu: str = Field(default="imu", description="the unit that it integrates, by its name")
    spare_imus: Annotated[tuple[str, ...], Field(max_length=3)] = Field(
        default=(), description="further units of the same rate, voted on together with the first"
    )
    aids: tuple[str, ...] = Field(description="sensors whose samples it uses, by their names")
    states: ImuStates = Field(default="biases", description="full: in-run instability and scale factors of the IMU too")
    turn_degps: float = Field(
        default=math.degrees(0.06), ge=0, le=360, description="usual rate of turn: how far scale errors count"
    )
    gust_mps: float = Field(default=1.0, ge=0, le=20, description="turbulence that the filter expects, 1 sigma")
    handover: HandoverConfig | None = Field(default=None, description="how well the start is known; none: it aligns")
    nonholonomic_mps: float | None = Field(
        default=None, gt=0, le=10, description="slip of wheels where body velocity aids; none: no constraint"
    )
    engine: Literal["linear", "unscented"] = Field(default="linear", description="derivatives or sigma points")
    course: CourseConfig | None = Field(default=None, description="of its GNSS receiver; none: not used")
    sage_husa: SageHusaConfig | None = Field(default=None, description="none: the receiver's sigmas are believed")
    fading: FadingConfig | None = Field(
        default=None, description="covariance that follows diverging innovations; none: it does not"
    )
    false_rejection: float = Field(default=1e-3, ge=0, lt=0.5, description="of sound samples by the gate; 0: no gate")
    heading_deg: Heading | None = Field(default=None, description="of an AHRS without magnetometer at the start")
    levelling: bool = Field(default=True, description="false: once it has begun, an AHRS goes by its gyros alone")
    level: LevelConfig | None = Field(default=None, description="how an AHRS levels; none: as light turbulence wants")
    autopilot: bool = Field(default=False, description="true: an AHRS levels only while level flight is commanded")
    locals: tuple[LocalConfig, ...] = Field(default=(), description="local filters of a federated one")
    structure: Literal["no_reset", "full_reset", "partial"] = Field(
        default="no_reset", description="what the fusion gives back to the local filters"
    )
    sharing: Literal["fixed", "by_covariance", "none"] = Field(
        default="fixed", description="how the common information is divided among the local filters"
    )
    combination: Literal["information", "scalar", "covariance_intersection"] = Field(
        default="information", description="how the local estimates are fused"
    )
    retention: float = Field(default=0.5, ge=0, le=1, description="of a partial reset: 0 is none, 1 a full one")
    weighting: Literal["none", "normalised"] = Field(
        default="none", description="normalised: a sample counts for less the nearer its detector is to an alarm"
    )
    fusion_period_s: float = Field(
        default=1.0, ge=0, le=60, description="from one fusion to the next; 0: at every sample"
    )
    isolate_after: int = Field(default=3, ge=1, description="consecutive condemned samples")
    readmit_after: int = Field(default=10, ge=1, description="consecutive sound samples")
    recall_s: float | None = Field(
        default=None, ge=1, le=600, description="isolated, a filter goes back by this; none: to the others' solution"
    )
    cross_check: bool = Field(default=False, description="of the local filters with each other; needs no_reset")
    literal: bool = Field(
        default=False,
        description="as printed: Jiang et al. 2021, equation 10; Zhu et al. 2020, equation 13; Zhou et al. 2025,"
        " equations 22-25",
    )

    @model_validator(mode="before")
    @classmethod
    def _aids_by_local(cls, value: Any) -> Any:
        if isinstance(value, dict) and value.get("kind") == "federated" and "aids" not in value:
            return value | {"aids": ()}
        return value

    @property
    def attitude_only(self) -> bool:
        """Whether it estimates no position and no velocity."""
        return self.kind == "ahrs"


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
    date: Date = Field(default=dt.date(2026, 1, 1), description="for the geomagnetic field")
    truth: FlightTruth | KinematicTruth = Field(discriminator="source", description="the motion")
    plan: tuple[legs.Leg, ...] = Field(default=(), description="legs that a flight consists of, in order")
    sensors: dict[str, Annotated[SensorConfig, PlainValidator(_sensor)]] = Field(
        default_factory=dict, description="sensors by their names; a name is the kind unless `kind` says otherwise"
    )
    fault: tuple[faults.Fault, ...] = Field(default=(), description="what goes wrong with sensors, and when")
    estimator: tuple[EstimatorConfig, ...] = Field(
        default=(), description="any number of estimators, side by side on the same samples"
    )
    autopilot: AutopilotConfig = Field(default=AutopilotConfig(), description="what the aircraft flies on")
    record: RecordConfig = Field(default=RecordConfig(), description="what is kept of the run")
    expect: dict[str, Bounds] = Field(
        default_factory=dict,
        description="bounds on metrics by their names, for `testbed check`; a plain number is a maximum",
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
        path = _find(path_or_name)
        if isinstance(overrides, Mapping):
            overrides = [keypath.override(key, value) for key, value in overrides.items()]
        return cls.parse(_read(path), overrides, path)

    @classmethod
    def parse(cls, text: str, overrides: Sequence[str] = (), path: Path | None = None) -> Scenario:
        """The scenario that ``text`` describes; ``path`` is where it came from. Raises UserError as `load` does."""
        place = str(path) if path else "scenario"
        data = _toml(text, place)
        if not data:
            raise UserError(f"{place}: is empty: begin with a copy of {data_dir('scenarios') / 'u_turn.toml'}")
        set_paths = {keypath.assign(data, override): override for override in overrides}
        truth, sensors = data.get("truth"), data.get("sensors")
        if isinstance(truth, dict) and isinstance(named := truth.get("aircraft"), str):
            truth["aircraft"] = _aircraft(named, path)
        for name, table in sensors.items() if isinstance(sensors, dict) else ():
            if isinstance(table, dict):
                table.setdefault("kind", name)
        try:
            scenario = cls.model_validate(_frozen(data), strict=True)
        except ValidationError as error:
            raise UserError(_report(error, data, text, place, set_paths)) from None
        except RecursionError:
            raise UserError(f"{place}: tables or lists are nested too deeply") from None
        scenario._text, scenario._path, scenario._overrides = text, path, tuple(overrides)
        return scenario

    def site(self) -> Site:
        """Where and when the run starts."""
        start = self.truth.start
        return Site(self.date, math.radians(start.lat_deg), math.radians(start.lon_deg), start.alt_m)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        found = [
            InitErrorDetails(type=PydanticCustomError("scenario", "{text}", {"text": text}), loc=path, input=None)
            for path, text in _inconsistencies(self)
        ]
        if found:
            raise ValidationError.from_exception_data("Scenario", found)
        return self


def shipped() -> dict[str, Path]:
    """The shipped scenarios by name."""
    return {path.stem: path for path in sorted(data_dir("scenarios").glob("*.toml"))}


# --- reading


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
    near = difflib.get_close_matches(named, known, n=3)
    hint = f"did you mean {' or '.join(near)}?" if near else f"shipped are {', '.join(known)}"
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


def _aircraft(named: str, path: Path | None) -> str:
    """A shipped aircraft's name as it is; the path of another's folder, as seen from the scenario file, in full."""
    found = None if named in aircraft.shipped() else aircraft.find(named, path.parent if path else None)
    return named if found is None else str(found)


def _frozen(value: Any) -> Any:
    """The same with tuples for lists: sections are immutable, and strict validation does not convert."""
    if isinstance(value, dict):
        return {key: _frozen(item) for key, item in value.items()}
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


# --- what one key can't know


def _inconsistencies(scenario: Scenario) -> Iterator[tuple[KeyPath, str]]:
    """What is wrong between keys that are each right."""
    tick_hz = scenario.truth.rate_hz
    yield from _divides(("record", "rate_hz"), scenario.record.rate_hz, tick_hz)
    for name, config in scenario.sensors.items():
        yield from _sensor_faults(("sensors", name), config, tick_hz, scenario.duration_s)
    yield from _plan_faults(scenario)
    yield from _fault_mistakes(scenario)
    taken: set[str] = set()
    for index, estimator in enumerate(scenario.estimator):
        yield from _estimator_faults(("estimator", index), estimator, scenario.sensors, taken)
        taken.add(estimator.name)
    yield from _autopilot_faults(scenario)
    for key in scenario.expect:
        yield from _expect_faults(key, taken)


def _plan_faults(scenario: Scenario) -> Iterator[tuple[KeyPath, str]]:
    if not isinstance(scenario.truth, FlightTruth):
        if scenario.plan:
            yield ("plan",), f"a body of source {scenario.truth.source!r} flies no plan: leave it out"
        yield from _track_faults(scenario.truth)
        return
    if not scenario.plan:
        yield ("plan",), "a flight needs a plan: add at least one [[plan]] leg"
        return
    named, wind = scenario.truth.aircraft, scenario.truth.wind
    if aircraft.find(named) is None:
        missing = _unknown("aircraft", named, list(aircraft.shipped()))
        yield ("truth", "aircraft"), f"{missing}, or give the path of its folder, as seen from the scenario file"
        return
    try:
        envelope = aircraft.load(named)
    except UserError as error:
        yield ("truth", "aircraft"), str(error)
        return
    strongest = max(wind.speed_mps, *(row[2] for row in wind.profile), 0)
    for key, what in guidance.plan_mistakes(scenario.plan, scenario.truth.start, envelope, strongest):
        yield keypath.read(key), what


def _track_faults(truth: KinematicTruth) -> Iterator[tuple[KeyPath, str]]:
    if truth.motion == "static":
        if truth.segments:
            yield ("truth", "segments"), 'a static body follows none: set truth.motion = "segments", or leave them out'
        if truth.start.speed_mps > 0:
            yield ("truth", "start", "speed_mps"), 'a static body has none: set truth.motion = "segments"'
    elif not truth.segments:
        yield ("truth", "segments"), "is missing: add at least one [[truth.segments]] table"
    else:
        try:
            truth.track()
        except ValueError as error:
            key, _, what = str(error).partition(": ")
            yield keypath.read(key), what


def _sensor_faults(
    path: KeyPath, config: SensorConfig, tick_hz: float, duration_s: float
) -> Iterator[tuple[KeyPath, str]]:
    name = str(path[-1])
    if not _IDENTIFIER.fullmatch(name):
        yield path, "a sensor's name is made of letters, digits and _, and does not begin with a digit"
    elif len(name) > LONGEST_NAME:
        yield path, f"a sensor's name has at most {LONGEST_NAME} letters"
    yield from _divides((*path, "rate_hz"), config.rate_hz, tick_hz)
    offset_s = getattr(config, "offset_s", 0.0)
    if not _whole(offset_s * tick_hz):
        nearest = round(offset_s * tick_hz) / tick_hz
        yield (*path, "offset_s"), f"is not a multiple of the tick {1 / tick_hz:g} s: the nearest is {nearest:g}"
    for start, end in getattr(config, "denied", ()):
        if start >= duration_s:
            shown = f"window [{start:g}, {end:g}]"
            yield (*path, "denied"), f"{shown} starts after the end of the run: duration_s is {duration_s:g}"


def _fault_mistakes(scenario: Scenario) -> Iterator[tuple[KeyPath, str]]:
    taken: list[str] = []
    for index, fault in enumerate(scenario.fault):
        path: KeyPath = ("fault", index)
        name = faults.label(fault, taken)
        if not _IDENTIFIER.fullmatch(name):
            yield (*path, "name"), "is made of letters, digits and _, and does not begin with a digit"
        elif name in taken:
            yield (*path, "name"), f"{name!r} is taken by a fault above: give each its own name"
        taken.append(name)
        start, end = fault.window
        if start >= scenario.duration_s:
            after = f"starts after the end of the run: duration_s is {scenario.duration_s:g}"
            yield (*path, "window"), f"[{start:g}, {end:g}] {after}"
        sensor = scenario.sensors.get(fault.sensor)
        if sensor is None:
            yield (*path, "sensor"), _unknown("sensor", fault.sensor, list(scenario.sensors))
            continue
        channels = list(faults.CHANNELS.get(sensor.kind, {}))
        channel = getattr(fault, "channel", None)
        if channel is not None and channel not in channels:
            yield (*path, "channel"), _unknown(f"channel of {fault.sensor}", channel, channels)
        for key, complaint in faults.mistakes(fault, sensor):
            yield (*path, key), complaint


def _estimator_faults(
    path: KeyPath, config: EstimatorConfig, sensors: Mapping[str, SensorConfig], taken: set[str]
) -> Iterator[tuple[KeyPath, str]]:
    if not _IDENTIFIER.fullmatch(config.name):
        yield (*path, "name"), "is made of letters, digits and _, and does not begin with a digit"
    elif config.name in taken:
        yield (*path, "name"), f"{config.name!r} is taken by an estimator above: give each its own name"
    elif config.name in _RESERVED:
        yield (*path, "name"), f"{config.name!r} is reserved: choose another name"
    kinds = {name: sensor.kind for name, sensor in sensors.items()}
    if config.kind == "ahrs":
        blind = "magnetometer" not in [kinds.get(aid) for aid in config.aids]
        if blind and config.heading_deg is None:
            yield (
                (*path, "heading_deg"),
                "is missing: an AHRS without magnetometer is told where it points at the start",
            )
        elif not blind and config.heading_deg is not None:
            yield (*path, "heading_deg"), "the magnetometer among the aids finds the heading: leave one of the two out"
    for key, owners in OWN_KEYS.items():
        if key in config.model_fields_set and config.kind not in owners:
            named = " or ".join(map(repr, owners))
            todo = "give it to its locals" if (config.kind, key) == ("federated", "engine") else "leave it out"
            yield (*path, key), f"is a key of kind {named}, not of {config.kind!r}: {todo}"
    imus = [name for name, kind in kinds.items() if kind == "imu"]
    if config.imu not in imus:
        yield (*path, "imu"), _unknown("IMU", config.imu, imus)
    for index, spare in enumerate(config.spare_imus):
        if spare not in imus:
            yield (*path, "spare_imus", index), _unknown("IMU", spare, imus)
        elif spare == config.imu or spare in config.spare_imus[:index]:
            yield (*path, "spare_imus", index), f"{spare!r} is used already: name another IMU"
        elif config.imu in imus and sensors[spare].rate_hz != sensors[config.imu].rate_hz:
            rates = f"{sensors[spare].rate_hz:g} Hz, not the {sensors[config.imu].rate_hz:g} Hz of {config.imu!r}"
            yield (*path, "spare_imus", index), f"has {rates}: units that are voted on must report together"
    usable = [name for name, kind in kinds.items() if kind in AIDS[config.kind]]
    if config.kind == "federated":
        yield from _federated_faults(path, config, kinds, usable)
        return
    yield from _aid_faults(path, config.kind, config.aids, kinds, usable)
    for key in ("course", "sage_husa", "fading"):
        if getattr(config, key) is not None and "gnss" not in [kinds.get(aid) for aid in config.aids]:
            yield (*path, key), "needs a GNSS receiver among the aids: add one, or leave it out"
    for index, aid in enumerate(config.aids):
        if aid in config.aids[:index] or aid not in usable:
            continue
        if kinds[aid] not in SEVERAL and kinds[aid] in [kinds.get(before) for before in config.aids[:index]]:
            yield (*path, "aids", index), f"{aid!r} is a second {kinds[aid]!r}: {config.kind!r} takes one of each kind"


def _aid_faults(
    path: KeyPath, kind: str, aids: Sequence[str], kinds: Mapping[str, str], usable: Sequence[str]
) -> Iterator[tuple[KeyPath, str]]:
    for index, aid in enumerate(aids):
        if aid in kinds and aid not in usable:
            yield (*path, "aids", index), f"{aid!r} is of kind {kinds[aid]!r}, which does not aid {kind!r}"
        elif aid not in kinds:
            yield (*path, "aids", index), _unknown("sensor", aid, usable)
        elif aid in aids[:index]:
            yield (*path, "aids", index), f"{aid!r} is listed twice"


def _federated_faults(
    path: KeyPath, config: EstimatorConfig, kinds: Mapping[str, str], usable: Sequence[str]
) -> Iterator[tuple[KeyPath, str]]:
    if "aids" in config.model_fields_set and config.aids:
        yield (*path, "aids"), "a federated estimator lists its aids by local filter: move them into its locals"
    if not config.locals:
        yield (*path, "locals"), 'is missing: add local filters, such as [{ name = "gnss", aids = ["gnss"] }]'
    names = [local.name for local in config.locals]
    for index, local in enumerate(config.locals):
        where = (*path, "locals", index)
        if not _IDENTIFIER.fullmatch(local.name):
            yield (*where, "name"), "is made of letters, digits and _, and does not begin with a digit"
        elif local.name in names[:index]:
            yield (*where, "name"), f"{local.name!r} is taken by a local filter above: give each its own name"
        yield from _aid_faults(where, config.kind, local.aids, kinds, usable)
    shares = [local.share for local in config.locals if local.share is not None]
    if shares and (len(shares) < len(names) or abs(sum(shares) - 1) > 1e-6):
        yield (*path, "locals"), f"the shares of all local filters must add up to 1, not {sum(shares):g}: or give none"
    if config.recall_s is not None and config.structure != "no_reset":
        yield (*path, "recall_s"), f"structure {config.structure!r} spreads what it would take back: leave one out"
    if config.combination == "information" and config.sharing == "none" and config.structure != "no_reset":
        yield (
            (*path, "sharing"),
            f"structure {config.structure!r} would count the same information again and again: share it",
        )
    if config.cross_check and (config.structure != "no_reset" or config.combination != "information"):
        text = 'compares independent filters: it needs structure = "no_reset" and combination = "information"'
        yield (*path, "cross_check"), text
    if config.combination != "information" and config.sharing != "none":
        yield (*path, "sharing"), f'combination {config.combination!r} needs no shares: set sharing = "none"'


def _autopilot_faults(scenario: Scenario) -> Iterator[tuple[KeyPath, str]]:
    path: KeyPath = ("autopilot", "feedback")
    feedback = scenario.autopilot.feedback
    flown = isinstance(scenario.truth, FlightTruth)
    for index, config in enumerate(scenario.estimator):
        if config.autopilot and not flown:
            yield (
                ("estimator", index, "autopilot"),
                f"a body of source {scenario.truth.source!r} has none: leave it out",
            )
    if not feedback.estimators:
        return
    if not flown:
        text = f"a body of source {scenario.truth.source!r} has no autopilot that could follow: leave it out"
        yield path, text
        return
    known = {config.name: config for config in scenario.estimator}
    groups = [((*path, key), getattr(feedback, key)) for key in ("attitude", "position")]
    if feedback.attitude == feedback.position:
        groups = [(path, feedback.attitude)]
    for where, name in groups:
        if name != "truth" and name not in known:
            yield where, _unknown("estimator", name, [*known, "truth"])
    kinds = {section.kind for section in scenario.sensors.values()}
    if feedback.position not in known:
        return
    where = groups[-1][0]
    if "airspeed" not in kinds:
        yield where, "flying on an estimate takes an airspeed sensor: add [sensors.airspeed]"
    if known[feedback.position].attitude_only and "barometer" not in kinds:
        text = f"{feedback.position!r} estimates attitude alone, and height must come from a barometer"
        yield where, f"{text}: add [sensors.barometer], or take the position of another estimator"


def _expect_faults(key: str, estimators: set[str]) -> Iterator[tuple[KeyPath, str]]:
    """What is wrong with the name of an expected metric: no run of the scenario could have it."""
    path: KeyPath = ("expect", key)
    match = _EXPECT_KEY.fullmatch(key)
    if not match:
        yield (
            path,
            'is no metric: write it quoted as "<estimator>.<quantity>_<statistic>_<unit>", such as'
            ' "ins.position_horizontal_rms_m" = 5.0',
        )
        return
    whose, metric = match["whose"], match["metric"]
    if whose not in estimators | {"run", "flight"}:
        yield path, _unknown("estimator", whose, sorted(estimators | {"run", "flight"}))
    elif measures.find(key) is None:
        yield path, _unknown("metric", metric, measures.names(whose))


def _divides(path: KeyPath, rate_hz: float, tick_hz: float) -> Iterator[tuple[KeyPath, str]]:
    if rate_hz > tick_hz:
        yield path, f"{rate_hz:g} Hz is faster than the tick rate of {tick_hz:g} Hz (truth.rate_hz)"
    elif rate_hz * LONGEST_RUN_S < 1:
        yield path, f"{rate_hz:g} Hz is less than once in the longest run"
    elif not _whole(tick_hz / rate_hz):
        ticks = int(tick_hz / rate_hz)
        slower, faster = tick_hz / (ticks + 1), tick_hz / ticks
        near = f"{slower:.10g} or {faster:.10g}"
        yield path, f"{rate_hz:g} Hz does not divide the tick rate of {tick_hz:g} Hz (truth.rate_hz): try {near}"


def _whole(value: float) -> bool:
    return abs(value - round(value)) <= TICK_TOLERANCE * max(1.0, value)


def _unknown(what: str, given: str, known: Sequence[str]) -> str:
    return f"there is no {what} {_shown(given)}: {_choice(given, known)}"


# --- saying what is wrong


def _report(
    error: ValidationError, data: dict[str, Any], text: str, place: str, set_paths: Mapping[KeyPath, str]
) -> str:
    """Every error on a line of its own: file, line, key path, what is wrong and what to do."""
    said: dict[KeyPath, list[str]] = {}
    misspelt: set[KeyPath] = set()
    for details in error.errors(include_url=False):
        path, models = _locate(details, data)
        said.setdefault(path, []).append(_say(details, path, models))
        if details["type"] == "extra_forbidden":
            misspelt.update((*path[:-1], key) for key in _near(str(path[-1]), _keys(models)))
    lines = keypath.line_numbers(text)
    messages = []
    for path, texts in said.items():
        if path in misspelt and texts == [MISSING]:
            continue  # it is there under the name that is complained about already
        above = [path[:length] for length in range(len(path), -1, -1)]
        below = [p for p in set_paths if path and p[: len(path)] == path]
        override = next((set_paths[p] for p in above + below if p in set_paths), None)
        line = next((lines[p] for p in above if p in lines), None)
        at = f" (--set {_short(override)})" if override else f":{line}" if line else ""
        key = f" {keypath.written(path)}:" if path else ""
        messages.append((line or 0, f"{place}{at}:{key} {', or '.join(dict.fromkeys(texts))}"))
    messages.sort(key=lambda message: message[0])
    shown = [message for _, message in messages[:ERRORS_SHOWN]]
    if len(messages) > ERRORS_SHOWN:
        shown.append(f"{place}: and {len(messages) - ERRORS_SHOWN} more")
    return "\n".join(shown)


def _locate(details: ErrorDetails, data: dict[str, Any]) -> tuple[KeyPath, list[type[Section]]]:
    """The key path of an error, and the sections whose keys may stand beside it.

    Pydantic's location also names the branch that it took in a union, which is no part of the file's path.
    """
    loc = details["loc"]
    if "discriminator" in details.get("ctx", {}):
        loc = (*loc, details["ctx"]["discriminator"].strip("'"))
    here: Any = data
    path: KeyPath = ()
    models: list[type[Section]] = [Scenario]
    for step in loc[:-1]:
        if isinstance(here, dict) and len(models) > 1 and step in (here.get(key) for key in _TAG_KEYS):
            models = [m for m in models if any(step in _tags(m, key) for key in _TAG_KEYS)]
        elif _holds(here, step):
            here = here[step]
            path = (*path, step)
            if len(path) == 2 and path[0] == "sensors":
                models = [CONFIGS[here["kind"]]]
            elif isinstance(step, str):
                fields = [m.model_fields[step].annotation for m in models if step in m.model_fields]
                models = [model for annotation in fields for model in _sections(annotation)]
    if loc and (_holds(here, loc[-1]) or details["type"] in ("missing", "union_tag_not_found", "scenario")):
        path = (*path, loc[-1])
    if details["type"] == "sensor_kind" and details["input"]["kind"] != path[-1]:
        path = (*path, "kind")
    return path, models


def _holds(here: Any, step: str | int) -> bool:
    return step in here if isinstance(here, dict) else isinstance(here, list) and isinstance(step, int)


def _sections(annotation: Any) -> list[type[Section]]:
    """The sections inside a type annotation."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return [annotation]
    return [section for argument in get_args(annotation) for section in _sections(argument)]


def _tags(model: type[Section], key: str) -> tuple[Any, ...]:
    return get_args(model.model_fields[key].annotation) if key in model.model_fields else ()


def _say(details: ErrorDetails, path: KeyPath, models: Sequence[type[Section]]) -> str:
    """What is wrong and what to do, in the words of this house."""
    kind, given, context = details["type"], details["input"], details.get("ctx", {})
    match kind:
        case "extra_forbidden":
            return f"unknown key: {_choice(str(path[-1]), _keys(models))}"
        case "missing":
            return "is missing: this item needs one more value" if isinstance(path[-1], int) else MISSING
        case "sensor_kind":
            return _unknown("sensor of kind", str(given.get("kind")), list(CONFIGS))
        case "union_tag_not_found":
            known = [tag for model in models for tag in _tags(model, str(path[-1]))]
            return f"is missing: add it, one of {', '.join(known)}"
        case "union_tag_invalid":
            return _unknown(str(path[-1]), str(context["tag"]), re.findall(r"'([^']*)'", context["expected_tags"]))
        case "literal_error":
            known = re.findall(r"'([^']*)'", context["expected"])
            return f"can't be {_shown(given)}: {_choice(str(given), known)}"
        case "value_error":
            return str(context["error"])
        case "scenario":
            return str(context["text"])
        case "model_type" | "dict_type" | "model_attributes_type":
            return f"must be a table, not {_shown(given)}"
        case "date_type" | "date_parsing" | "date_from_datetime_parsing" | "date_from_datetime_inexact":
            return f"must be a date such as 2026-06-01, not {_shown(given)}"
        case "list_type" | "tuple_type":
            return f"must be a list, not {_shown(given)}"
        case "finite_number":
            return f"must be a finite number, not {_shown(given)}"
        case "too_long":
            return f"has {context['actual_length']} items, but at most {context['max_length']} are allowed"
        case "float_type":
            return f"must be a number, not {_shown(given)}"
        case "int_type" | "int_from_float":
            return f"must be a whole number, not {_shown(given)}"
        case "string_type":
            return f'must be text in quotes, such as "text", not {_shown(given)}'
        case "bool_type":
            return f"must be true or false, not {_shown(given)}"
    return f"{details['msg'].replace('Input should be', 'must be')}, not {_shown(given)}"


def _choice(given: str, known: Sequence[str]) -> str:
    if not known:
        return "there is none to choose from"
    near = _near(given, known)
    listed = (
        known if len(known) <= CHOICES_SHOWN else difflib.get_close_matches(given, known, n=CHOICES_SHOWN, cutoff=0)
    )
    more = ", …" if len(known) > CHOICES_SHOWN else ""
    return (f"did you mean {near[0]}? Choose from " if near else "choose from ") + ", ".join(listed) + more


def _near(given: str, known: Sequence[str]) -> list[str]:
    return difflib.get_close_matches(given, known, n=1)


def _keys(models: Sequence[type[Section]]) -> list[str]:
    return list(dict.fromkeys(key for model in models for key in model.model_fields))


def _shown(value: object) -> str:
    return _short(repr(value) if isinstance(value, float) else json.dumps(value, default=str, ensure_ascii=False))


def _short(text: str) -> str:
    return keypath.printable(text if len(text) <= 60 else text[:57] + "...")
