"""The ``[truth]`` section of a scenario: where a motion starts, what makes it, the wind that it meets."""

from __future__ import annotations

import itertools
import math
from typing import Annotated, Literal, Self, TypeAlias

from pydantic import Field, model_validator

from testbed.motion.segments import Body, GroundSpeed, Segment, Track, lay_track
from testbed.schema import LONGEST_RUN_S, Heading, Section

LATITUDE_LIMIT_DEG = 85.0  # north-east-down navigation loses its north near the poles
ALTITUDES = -500.0, 10_000.0  # [m]

Latitude: TypeAlias = Annotated[
    float, Field(gt=-LATITUDE_LIMIT_DEG, lt=LATITUDE_LIMIT_DEG, description="geodetic latitude, WGS84")
]
Longitude: TypeAlias = Annotated[float, Field(ge=-180, le=180, description="longitude, east positive")]
Altitude: TypeAlias = Annotated[
    float, Field(ge=ALTITUDES[0], le=ALTITUDES[1], description="height above the WGS84 ellipsoid")
]
WindSpeed: TypeAlias = Annotated[float, Field(ge=0, le=50)]
Shear: TypeAlias = Annotated[float, Field(ge=-5, le=5)]
TickRate: TypeAlias = Annotated[
    float, Field(ge=50, le=1000, description="ticks of the simulation; every other rate divides it")
]


class Start(Section):
    """Where and how a flight starts: trimmed, straight and level; or at rest, from where it takes off."""

    lat_deg: Latitude
    lon_deg: Longitude
    alt_m: Altitude
    heading_deg: Heading = Field(description="true heading of the nose")
    airspeed_mps: float = Field(
        default=0.0,
        ge=0,
        le=100,
        description="true airspeed, at which it is trimmed; of no start on the ground",
    )
    on_ground: bool = Field(
        default=False,
        description="whether it begins at rest on its launcher; `alt_m` is then the height of the ground there",
    )
    rest_s: float = Field(
        default=30.0, ge=3, le=LONGEST_RUN_S, description="how long it rests there before it is launched by itself"
    )

    @model_validator(mode="after")
    def _moving_or_not(self) -> Self:
        if self.on_ground and self.airspeed_mps > 0:
            raise ValueError("on_ground is a start at rest: leave airspeed_mps out")
        if not self.on_ground and self.airspeed_mps == 0:
            raise ValueError("airspeed_mps is missing or 0: give the speed to begin with, or set on_ground = true")
        if not self.on_ground and "rest_s" in self.model_fields_set:
            raise ValueError("rest_s is of a start at rest: set on_ground = true, or leave it out")
        return self


class GaussMarkov(Section):
    """A part of the mean wind that wanders and comes back, north and east alike (Ornstein and Uhlenbeck's process)."""

    sigma_mps: float = Field(ge=0, le=20, description="standard deviation per axis, from the start of the run")
    correlation_s: float = Field(gt=0, le=1e6, description="time in which it forgets itself but for 1/e")


class Front(Section):
    """Another wind that comes to stay. The change is 3 s^2 - 2 s^3 of the share s of the width that has passed."""

    time_s: float = Field(ge=0, le=LONGEST_RUN_S, description="when half of the change has come")
    width_s: float = Field(gt=0, le=LONGEST_RUN_S, description="from the first of the change to the last")
    from_deg: Heading = Field(description="true direction that the new wind comes from")
    speed_mps: WindSpeed = Field(description="of the new wind")


class BoundaryLayer(Section):
    """Wind that grows with the logarithm of the height over ground: ln(h / roughness) / ln(reference / roughness)."""

    roughness_m: float = Field(
        gt=0, le=5, description="of the ground: water 0.0002, grass 0.03, crops 0.1 to 0.25, a forest 1"
    )
    reference_m: float = Field(default=10.0, gt=0, le=500, description="height over ground that `speed_mps` is of")
    top_m: float = Field(default=300.0, gt=0, le=3000, description="height over ground from which on it is the same")

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if not self.roughness_m < self.reference_m <= self.top_m:
            raise ValueError("roughness_m must be below reference_m, and that not above top_m")
        return self

    def factor(self, h: float) -> float:
        """The wind at a height ``h`` over ground [m] over that at the reference."""
        height = min(max(h, self.roughness_m), self.top_m)
        return math.log(height / self.roughness_m) / math.log(self.reference_m / self.roughness_m)


class Updrafts(Section):
    """Thermals with sink between them (`testbed.motion.updrafts`), placed by the run's seed."""

    w_star_mps: float = Field(ge=0, le=10, description="convective velocity scale: 1 in winter, 2.7 in a desert's July")
    depth_m: float = Field(ge=100, le=6000, description="of the mixing layer over ground, to whose top they rise")


class Wind(Section):
    """Wind over ground: one vector, a profile of rows [alt_m, from_deg, speed_mps], or a file; what changes it; gusts.

    Boundary layer and updrafts lie on the ground of ``terrain``; profile, file and gusts go by altitude.
    The gusts follow the run's seed, or ``turbulence_seed`` where runs of different seeds shall meet the same ones.
    """

    from_deg: Heading = Field(default=0.0, description="true direction that the wind comes from")
    speed_mps: WindSpeed = Field(default=0.0, description="of the mean wind over ground")
    turbulence: Literal["none", "light", "moderate", "severe"] = Field(
        default="none",
        description="Dryden gusts by MIL-F-8785C, as JSBSim makes them: by altitude, whatever the ground",
    )
    turbulence_seed: int | None = Field(default=None, ge=0, lt=2**63, description="of the gusts; none: the run's seed")
    profile: tuple[tuple[Altitude, Heading, WindSpeed], ...] = Field(
        default=(), description="rows of `[alt_m, from_deg, speed_mps]`, climbing, in place of one wind"
    )
    file: str | None = Field(
        default=None,
        description="a CSV file, seen from this file, in place of one wind: columns `alt_m`, `from_deg`, `speed_mps`,"
        " and `time_s` where it changes",
    )
    walk_mps_per_sqrt_s: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="random walk of the mean wind, north and east alike; PX4 assumes 0.05;"
        " a 0 that is written down tells filters that it keeps still",
    )
    gauss_markov: GaussMarkov | None = Field(default=None, description="mean wind that wanders and comes back")
    front: Front | None = Field(default=None, description="another wind that comes to stay")
    gradient_mps_per_km: tuple[tuple[Shear, Shear], tuple[Shear, Shear]] = Field(
        default=((0.0, 0.0), (0.0, 0.0)),
        description="change of the wind over ground from the start: of its north component per km north and east,"
        " then of its east one",
    )
    boundary_layer: BoundaryLayer | None = Field(default=None, description="wind that grows with height over ground")
    updrafts: Updrafts | None = Field(default=None, description="thermals, and sink between them")

    @model_validator(mode="after")
    def _one_wind(self) -> Self:
        if "profile" in self.model_fields_set and not self.profile:
            raise ValueError("profile has no rows: give one, or leave it out")
        one = [key for key in ("from_deg", "speed_mps", "front", "boundary_layer") if key in self.model_fields_set]
        given = [key for key in ("profile", "file") if getattr(self, key)]
        if len(given) == 2:
            raise ValueError("a file replaces a profile: give one or the other")
        if given and one:
            keys = " and ".join(one)
            raise ValueError(f"a {given[0]} replaces {keys}: give one or the other")
        heights = [row[0] for row in self.profile]
        if any(upper <= lower for lower, upper in itertools.pairwise(heights)):
            raise ValueError("the rows of profile must climb: sort them by alt_m, each altitude once")
        return self

    @property
    def one(self) -> bool:
        """Whether there is one mean wind over all altitudes and times, but for what wanders about it."""
        return not (self.profile or self.file or self.front or self.boundary_layer)

    @property
    def drawn(self) -> bool:
        """Whether any of it but the gusts follows the run's seed."""
        wanders = self.gauss_markov is not None and self.gauss_markov.sigma_mps > 0
        return self.walk_mps_per_sqrt_s > 0 or wanders or self.updrafts is not None


class Terrain(Section):
    """The ground below, level or with relief. Filters have a map of it, from which the ground of a run differs.

    By one height everywhere (``map_sigma_m``), by heights that change from place to place (``map_error_m``), and by
    what lies between the points of a coarser map (``map_every``).
    """

    height_m: float = Field(default=0.0, ge=-500, le=9000, description="of the map above the WGS84 ellipsoid")
    map_sigma_m: float = Field(
        default=5.0, ge=0, le=1000, description="1 sigma of how far the ground is from the map; filters are told it"
    )
    file: str | None = Field(
        default=None,
        description="heights in place of one, seen from this file: an SRTM tile (`.hgt`), or `.npz` with `lat_deg`,"
        " `lon_deg` and `height_m`; or `jacksboro`, 36.45 to 36.73 north, 84.41 to 84.08 west, which comes along",
    )
    map_error_m: float = Field(
        default=0.0, ge=0, le=1000, description="1 sigma of errors of the map that change over ground; filters know it"
    )
    map_correlation_m: float = Field(default=200.0, gt=0, le=1e5, description="over what distance these fall to 1/e")
    map_every: int = Field(
        default=1, ge=1, le=100, description="filters' maps have each of so many rows and columns of the file only"
    )

    @model_validator(mode="after")
    def _one_ground(self) -> Self:
        if self.file and "height_m" in self.model_fields_set:
            raise ValueError("a file replaces height_m: give one or the other")
        if not self.file and (self.map_error_m or self.map_every > 1):
            raise ValueError("map_error_m and map_every are of a map with relief: give a file, or leave them out")
        return self


class FlightTruth(Section):
    """Motion from JSBSim: an aircraft flies the scenario's plan."""

    source: Literal["flight"]
    aircraft: str = Field(
        default="loiter",
        min_length=1,
        description="a shipped aircraft by name, or the path of a folder, seen from this file",
    )
    rate_hz: TickRate = 200.0
    start: Start = Field(description="where the flight begins")
    wind: Wind = Field(default=Wind(), description="wind and turbulence; none: calm air")
    terrain: Terrain = Field(default=Terrain(), description="the ground that sensors see, and on which a flight ends")


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
    terrain: Terrain = Field(default=Terrain(), description="the ground that sensors see")

    def track(self) -> Track:
        """The track along the segments. Raises ValueError with the key of the first that can't be."""
        return lay_track(self.segments, self.start.speed_mps, self.start.alt_m, self.body.blend_s)
