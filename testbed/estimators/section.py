"""The keys that ``[[estimator]]`` tables of several kinds have, and what can be wrong with those."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from testbed.errors import unknown
from testbed.schema import Section
from testbed.sensors import SensorConfig, registry

Mistake: TypeAlias = tuple[tuple[str | int, ...], str]  # where in the table, and what is wrong

DEFAULT_ESTIMATOR = "ins"  # the kind of one that does not say it
# Of these kinds an estimator may have several sensors; of any other kind it takes one.
SEVERAL = frozenset({"body_velocity", "star_tracker", "position_fix", "rangefinder", "optical_flow", "wind_report"})
ONE_EACH = frozenset({"gnss", "barometer", "magnetometer", "airspeed"})

Engine: TypeAlias = Annotated[Literal["linear", "unscented"], Field(description="derivatives or sigma points")]
ImuStates: TypeAlias = Literal["biases", "full", "matrix"]
States: TypeAlias = Annotated[
    ImuStates,
    Field(
        description="full: in-run instability and scale factors of the IMU too, as states; matrix: and what its axes"
        " feel of each other, misaligned and not square"
    ),
]
TurnRate: TypeAlias = Annotated[
    float | None,
    Field(ge=0, le=360, description="usual rate of turn: how far scale errors count; none: the aircraft's usual one"),
]
Gust: TypeAlias = Annotated[
    float | None,
    Field(
        ge=0,
        le=20,
        description="turbulence that the filter expects, 1 sigma; none: what MIL-F-8785C gives for the scenario's"
        " turbulence at the plan's altitudes, 1 m/s where none is asked for",
    ),
]
WindWalk: TypeAlias = Annotated[
    float | None,
    Field(
        ge=0,
        le=1,
        description="random walk of the mean wind that the filter expects; none: that of the scenario's wind,"
        " 0.015 m/s/√s where that says nothing",
    ),
]
Slip: TypeAlias = Annotated[
    float, Field(gt=0, le=10, description="slip of wheels where body velocity aids; none: no constraint")
]


class Handover(Section):
    """The state that somebody else's navigation hands over at the start, instead of alignment: its errors, 1 sigma."""

    level_deg: float = Field(gt=0, le=20, description="error of roll and pitch each")
    heading_deg: float = Field(gt=0, le=90, description="error of the heading")
    velocity_mps: float = Field(gt=0, le=100, description="error of velocity per axis")
    position_m: float = Field(gt=0, le=1e4, description="error of position per axis")


class EstimatorSection(Section):
    """The keys of every ``[[estimator]]``: its name, and the IMU that it integrates."""

    name: str = Field(description="what the record, metrics and figures call it")
    kind: str = Field(description="which estimator")
    imu: str = Field(default="imu", description="the unit that it integrates, by its name")
    spare_imus: Annotated[tuple[str, ...], Field(max_length=3)] = Field(
        default=(), description="further units of the same rate, voted on together with the first"
    )

    @property
    def attitude_only(self) -> bool:
        """Whether it estimates no position and no velocity."""
        return False

    @property
    def recorded(self) -> tuple[str, ...]:
        """What records and metrics call its estimates: by its name, and those of one that looks back in the end."""
        return (self.name, f"{self.name}_smoothed") if getattr(self, "smooth", False) else (self.name,)

    def aiding(self, sensors: Mapping[str, SensorConfig]) -> tuple[str, ...]:
        """The names of those sensors whose samples it is handed once aligned."""
        aids: tuple[str, ...] | None = getattr(self, "aids", None)
        return tuple(name for name, one in sensors.items() if one.kind != "imu") if aids is None else aids

    def mistakes(self, sensors: Mapping[str, SensorConfig]) -> Iterator[Mistake]:
        """What is wrong with it among these sensors."""
        imus = [name for name, sensor in sensors.items() if sensor.kind == "imu"]
        if self.imu not in imus:
            yield ("imu",), unknown("IMU", self.imu, imus)
        for index, spare in enumerate(self.spare_imus):
            if spare not in imus:
                yield ("spare_imus", index), unknown("IMU", spare, imus)
            elif spare == self.imu or spare in self.spare_imus[:index]:
                yield ("spare_imus", index), f"{spare!r} is used already: name another IMU"
            elif self.imu in imus and sensors[spare].rate_hz != sensors[self.imu].rate_hz:
                rates = f"{sensors[spare].rate_hz:g} Hz, not the {sensors[self.imu].rate_hz:g} Hz of {self.imu!r}"
                yield ("spare_imus", index), f"has {rates}: units that are voted on must report together"


def aid_mistakes(
    kind: str, aids: Sequence[str], sensors: Mapping[str, SensorConfig], usable: frozenset[str], *, own: bool
) -> Iterator[Mistake]:
    """What is wrong with a list of aids, of sensors of ``usable`` kinds, or ``own``: of the user's that have an aid."""
    names = [n for n, one in sensors.items() if one.kind in usable or (own and registry.of(one).aid is not None)]
    for index, aid in enumerate(aids):
        if aid in sensors and aid not in names:
            yield ("aids", index), f"{aid!r} is of kind {sensors[aid].kind!r}, which does not aid {kind!r}"
        elif aid not in sensors:
            yield ("aids", index), unknown("sensor", aid, names)
        elif aid in aids[:index]:
            yield ("aids", index), f"{aid!r} is listed twice"
        elif sensors[aid].kind == "wind_report" and not any(
            sensors[other].kind == "airspeed" for other in aids if other in sensors
        ):
            text = "tells of a wind that nothing here meets: add an airspeed sensor to these aids, or leave it out"
            yield ("aids", index), f"{aid!r} {text}"


def slip_mistakes(
    slip_mps: float | None, aids: Sequence[str], sensors: Mapping[str, SensorConfig]
) -> Iterator[Mistake]:
    """A constraint of wheels that no aid meets."""
    if slip_mps is not None and not any(sensors[aid].kind == "body_velocity" for aid in aids if aid in sensors):
        yield ("nonholonomic_mps",), "is used with a body velocity: add such an aid, or leave it out"


def second_of_a_kind(kind: str, aids: Sequence[str], sensors: Mapping[str, SensorConfig]) -> Iterator[Mistake]:
    """Aids that are one too many of their kind."""
    kinds = {name: sensor.kind for name, sensor in sensors.items()}
    for index, aid in enumerate(aids):
        if aid in aids[:index] or kinds.get(aid) not in ONE_EACH:
            continue
        if kinds[aid] in [kinds.get(before) for before in aids[:index]]:
            yield ("aids", index), f"{aid!r} is a second {kinds[aid]!r}: {kind!r} takes one of each kind"
