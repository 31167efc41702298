"""The ``[truth]`` section of a scenario: where a motion starts, what makes it, the wind that it meets."""

from __future__ import annotations

import itertools
from typing import Annotated, Literal, Self, TypeAlias

from pydantic import Field, model_validator

from testbed.motion.segments import Body, GroundSpeed, Segment, Track, lay_track
from testbed.schema import Heading, Section

LATITUDE_LIMIT_DEG = 85.0  # north-east-down navigation loses its north near the poles

Latitude: TypeAlias = Annotated[
    float, Field(gt=-LATITUDE_LIMIT_DEG, lt=LATITUDE_LIMIT_DEG, description="geodetic latitude, WGS84")
]
Longitude: TypeAlias = Annotated[float, Field(ge=-180, le=180, description="longitude, east positive")]
Altitude: TypeAlias = Annotated[float, Field(ge=-500, le=10_000, description="height above the WGS84 ellipsoid")]
WindSpeed: TypeAlias = Annotated[float, Field(ge=0, le=50)]
TickRate: TypeAlias = Annotated[
    float, Field(ge=50, le=1000, description="ticks of the simulation; every other rate divides it")
]


class Start(Section):
    """Where and how a flight starts: trimmed, straight and level."""

    lat_deg: Latitude
    lon_deg: Longitude
    alt_m: Altitude
    heading_deg: Heading = Field(description="true heading of the nose")
    airspeed_mps: float = Field(gt=0, le=100, description="true airspeed, at which it is trimmed")


class Wind(Section):
    """Wind over ground: one vector, or a profile of rows [alt_m, from_deg, speed_mps]; and turbulence on top.

    The gusts follow the run's seed, or ``turbulence_seed`` where runs of different seeds shall meet the same ones.
    """

    from_deg: Heading = Field(default=0.0, description="true direction that the wind comes from")
    speed_mps: WindSpeed = Field(default=0.0, description="of the steady wind over ground")
    turbulence: Literal["none", "light", "moderate", "severe"] = Field(
        default="none", description="Dryden gusts by MIL-F-8785C, as JSBSim makes them"
    )
    turbulence_seed: int | None = Field(default=None, ge=0, lt=2**63, description="of the gusts; none: the run's seed")
    profile: tuple[tuple[Altitude, Heading, WindSpeed], ...] = Field(
        default=(), description="rows of `[alt_m, from_deg, speed_mps]`, climbing, in place of one wind"
    )

    @model_validator(mode="after")
    def _one_wind(self) -> Self:
        if self.profile and self.model_fields_set & {"from_deg", "speed_mps"}:
            raise ValueError("a profile replaces from_deg and speed_mps: give one or the other")
        heights = [row[0] for row in self.profile]
        if any(upper <= lower for lower, upper in itertools.pairwise(heights)):
            raise ValueError("the rows of profile must climb: sort them by alt_m, each altitude once")
        return self


class FlightTruth(Section):
    """Motion from JSBSim: an aircraft flies the scenario's plan."""

    source: Literal["flight"]
    aircraft: str = Field(
        default="loiter", description="a shipped aircraft by name, or the path of a folder, seen from this file"
    )
    rate_hz: TickRate = 200.0
    start: Start = Field(description="where the flight begins, trimmed, straight and level")
    wind: Wind = Field(default=Wind(), description="wind and turbulence; none: calm air")


class KinematicStart(Section):
    """Where a kinematic body starts and how it lies; its motion comes on top of pitch and roll."""

    lat_deg: Latitude
    lon_deg: Longitude
    alt_m: Altitude
    heading_deg: Heading = Field(default=0.0, description="true heading of the nose")
    pitch_deg: float = Field(default=0.0, ge=-90, le=90, description="nose up positive")
    roll_deg: float = Field(default=0.0, ge=-180, le=180, description="right side down positive")
    speed_mps: GroundSpeed = Field(default=0.0, description="speed over ground along the heading")


class KinematicTruth(Section):
    """Motion from a formula: a body at rest on the turning Earth, or on segments one after the other.

    After the last segment it goes straight on at the speed reached.
    """

    source: Literal["kinematic"]
    motion: Literal["static", "segments"] = Field(
        default="static", description="at rest on the turning Earth, or along the segments"
    )
    rate_hz: TickRate = 200.0
    start: KinematicStart = Field(description="where the body starts and how it lies")
    body: Body = Field(default=Body(), description="how it turns and sways")
    segments: tuple[Segment, ...] = Field(default=(), description="what it does, one after the other; then straight on")

    def track(self) -> Track:
        """The track along the segments. Raises ValueError with the key of the first that can't be."""
        return lay_track(self.segments, self.start.speed_mps, self.start.alt_m, self.body.blend_s)
