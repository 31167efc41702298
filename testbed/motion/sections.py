"""The ``[truth]`` section of a scenario: where a motion starts, what makes it, the wind that it meets."""

from __future__ import annotations

import itertools
from typing import Annotated, Literal, Self, TypeAlias

from pydantic import Field, model_validator

from testbed.motion.segments import Body, GroundSpeed, Segment, Track, lay_track
from testbed.schema import Heading, Section

LATITUDE_LIMIT_DEG = 85.0  # north-east-down navigation loses its north near the poles

Latitude: TypeAlias = Annotated[float, Field(gt=-LATITUDE_LIMIT_DEG, lt=LATITUDE_LIMIT_DEG)]
Longitude: TypeAlias = Annotated[float, Field(ge=-180, le=180)]
Altitude: TypeAlias = Annotated[float, Field(ge=-500, le=10_000)]
WindSpeed: TypeAlias = Annotated[float, Field(ge=0, le=50)]
TickRate: TypeAlias = Annotated[float, Field(ge=50, le=1000)]


class Start(Section):
    """Where and how a flight starts: trimmed, straight and level."""

    lat_deg: Latitude
    lon_deg: Longitude
    alt_m: Altitude
    heading_deg: Heading
    airspeed_mps: float = Field(gt=0, le=100)


class Wind(Section):
    """Wind over ground: one vector, or a profile of rows [alt_m, from_deg, speed_mps]; and turbulence on top.

    The gusts follow the run's seed, or ``turbulence_seed`` where runs of different seeds shall meet the same ones.
    """

    from_deg: Heading = 0.0
    speed_mps: WindSpeed = 0.0
    turbulence: Literal["none", "light", "moderate", "severe"] = "none"
    turbulence_seed: int | None = Field(default=None, ge=0, lt=2**63)
    profile: tuple[tuple[Altitude, Heading, WindSpeed], ...] = ()

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
    aircraft: str = "loiter"
    rate_hz: TickRate = 200.0
    start: Start
    wind: Wind = Wind()


class KinematicStart(Section):
    """Where a kinematic body starts and how it lies; its motion comes on top of pitch and roll."""

    lat_deg: Latitude
    lon_deg: Longitude
    alt_m: Altitude
    heading_deg: Heading = 0.0
    pitch_deg: float = Field(default=0.0, ge=-90, le=90)
    roll_deg: float = Field(default=0.0, ge=-180, le=180)
    speed_mps: GroundSpeed = 0.0


class KinematicTruth(Section):
    """Motion from a formula: a body at rest on the turning Earth, or on segments one after the other.

    After the last segment it goes straight on at the speed reached.
    """

    source: Literal["kinematic"]
    motion: Literal["static", "segments"] = "static"
    rate_hz: TickRate = 200.0
    start: KinematicStart
    body: Body = Body()
    segments: tuple[Segment, ...] = ()

    def track(self) -> Track:
        """The track along the segments. Raises ValueError with the key of the first that can't be."""
        return lay_track(self.segments, self.start.speed_mps, self.start.alt_m, self.body.blend_s)
