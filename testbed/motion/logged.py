"""``[truth] source = "log"``: a flight that was recorded, and how the columns of a table are to be read."""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Field, field_validator, model_validator

from testbed.motion.sections import Altitude, Latitude, Longitude, Terrain, TickRate
from testbed.schema import Section

COMPONENT = re.compile(r"(?P<minus>-?)(?P<axis>[xyz])")
AXES = "xyz"
INTEGRALS = {"gyro": ("rad", "deg"), "accel": ("m/s",)}  # the units of increments
# Of whose axes a left-handed set is a slip: of those of the Earth up is often the third, beside north and east.
OF_BODY = ("gyro", "accel", "field")
# What a column may be between or along, the usual one first.
FRAMES = {"attitude": ("frd-ned", "flu-enu"), "velocity": ("frd-ned", "ecef"), "position": ("frd-ned", "ecef")}
REVERSED = ("-x", "-y", "-z")

Component: TypeAlias = Annotated[str, Field(description="x, y or z: first, second or third column; - turns it round")]


class Place(Section):
    """Where a recorded flight begins, known within kilometres; its height tells nothing but the site's."""

    lat_deg: Latitude
    lon_deg: Longitude
    alt_m: Altitude


class Column(Section):
    """Where one quantity stands in a table. In the file a name, or a list of three names, may stand for all of it."""

    column: str | tuple[str, ...] = Field(
        description="its name, of a vector that of an array or those of three; `name:2` is one column of an array"
    )
    file: str | None = Field(
        default=None,
        description="the table that it is in, row by row beside the time, seen from this file; none: the sensor's",
    )
    unit: str | None = Field(default=None, description="what it is in; none: the SI unit")
    axes: tuple[Component, Component, Component] = Field(
        default=("x", "y", "z"),
        description="of a vector, which column is forward, right, down, or north, east, down; of angles, which is "
        "roll, pitch, heading",
    )
    frame: Literal["frd-ned", "flu-enu", "ecef"] = Field(
        default="frd-ned",
        description="of an attitude, from which body axes to which of the Earth it turns: forward, right, down to "
        "north, east, down, or, as ROS has it, forward, left, up to east, north, up; of a velocity `ecef` where it is "
        "along the Earth's own axes",
    )
    scale: float = Field(default=1.0, description="what it is multiplied by, before the unit")
    offset: float = Field(default=0.0, description="what is added then, in the unit")

    @field_validator("scale")
    @classmethod
    def _says_something(cls, scale: float) -> float:
        if scale == 0:
            raise ValueError("must not be 0, which makes all values alike")
        return scale

    @model_validator(mode="before")
    @classmethod
    def _name_alone(cls, value: Any) -> Any:
        return {"column": value} if isinstance(value, str | tuple | list) else value

    @field_validator("axes")
    @classmethod
    def _each_once(cls, axes: tuple[str, str, str]) -> tuple[str, str, str]:
        found = [COMPONENT.fullmatch(axis) for axis in axes]
        if not all(found) or {match["axis"] for match in found if match} != set(AXES):
            raise ValueError('must name each of x, y and z once, with - where it is turned round, such as "-y"')
        return axes

    @property
    def order(self) -> tuple[list[int], list[float]]:
        """Of each axis, the number of its column and its sign."""
        found = [COMPONENT.fullmatch(axis) for axis in self.axes]
        pairs = [(AXES.index(match["axis"]), -1.0 if match["minus"] else 1.0) for match in found if match]
        return [k for k, _ in pairs], [sign for _, sign in pairs]

    @property
    def is_left_handed(self) -> bool:
        """Whether the axes are the mirror image of three that a body has."""
        order, signs = self.order
        turns = order in ([0, 1, 2], [1, 2, 0], [2, 0, 1])
        return (signs.count(-1.0) % 2 == 0) != turns


class Stream(Section):
    """The columns of one sensor in a table, or of the ``reference``; which it needs depends on its kind.

    Sensors of other kinds than their names say it with ``kind``.
    """

    kind: str | None = Field(default=None, description="of the sensor; none: its name")
    file: str | None = Field(
        default=None, description="the table that its columns are in, seen from this file; none: that of `truth.file`"
    )
    time: Column = Field(description="time, at which a sample is valid, or was told of after the sensor's latency")
    form: Literal["averaged", "instantaneous", "increments"] = Field(
        default="averaged",
        description="what gyro and accel are: means since the row before, values at its time, or integrals since then",
    )
    gyro: Column | None = Field(default=None, description="angular rate, body axes, or its integral")
    accel: Column | None = Field(default=None, description="specific force, body axes, or its integral")
    lat: Column | None = Field(default=None, description="geodetic latitude")
    lon: Column | None = Field(default=None, description="longitude")
    height: Column | None = Field(default=None, description="above the ellipsoid; of a barometer its altitude")
    position: Column | None = Field(
        default=None, description="from the centre of the Earth (ECEF), in place of lat, lon and height"
    )
    velocity: Column | None = Field(default=None, description="over ground, north, east, down")
    sigma_position: Column | None = Field(default=None, description="1-sigma of position, north, east, down")
    sigma_velocity: Column | None = Field(default=None, description="1-sigma of velocity, north, east, down")
    fix: Column | None = Field(default=None, description="type of fix, 3 or more being one in three dimensions")
    satellites: Column | None = Field(default=None, description="number in use")
    hdop: Column | None = Field(default=None, description="horizontal dilution of precision")
    vdop: Column | None = Field(default=None, description="vertical dilution of precision")
    pressure: Column | None = Field(default=None, description="static; of an airspeed sensor dynamic")
    field: Column | None = Field(default=None, description="magnetic flux density, body axes")
    airspeed: Column | None = Field(default=None, description="equivalent (indicated)")
    attitude: Column | None = Field(default=None, description="roll, pitch, heading; or four of a quaternion, w first")

    @property
    def columns(self) -> dict[str, Column]:
        """Those that are given, by the quantity that they hold."""
        given = {name: getattr(self, name) for name in type(self).model_fields}
        return {name: column for name, column in given.items() if isinstance(column, Column)}

    @property
    def files(self) -> dict[str, str]:
        """The tables that it names, by the keys that do."""
        own = {f"{name}.file": column.file for name, column in self.columns.items()}
        return {key: file for key, file in {"file": self.file, **own}.items() if file is not None}

    @model_validator(mode="after")
    def _frames_are_of_few(self) -> Stream:
        for name, column in self.columns.items():
            if column.frame not in FRAMES.get(name, ("frd-ned",)):
                frames = ", ".join(f'"{frame}"' for frame in FRAMES.get(name, ()))
                others = f"must be one of {frames}" if frames else "is an attitude's or a velocity's: say it with axes"
                raise ValueError(f"{name}.frame: {others}")
        return self

    @model_validator(mode="after")
    def _form_is_of_increments(self) -> Stream:
        if self.form != "averaged" and self.gyro is None and self.accel is None:
            raise ValueError("form: is of gyro and accel, and there are none here: leave it out")
        return self

    @model_validator(mode="after")
    def _units_agree_with_form(self) -> Stream:
        for name, integrals in INTEGRALS.items():
            column = getattr(self, name)
            if column is None or column.unit is None or (column.unit in integrals) == (self.form == "increments"):
                continue
            if self.form == "increments":
                raise ValueError(f'{name}.unit: is "{column.unit}", and of increments one of {", ".join(integrals)}')
            raise ValueError(f'{name}.unit: is "{column.unit}", of an integral: form = "increments"?')
        return self

    @model_validator(mode="after")
    def _right_handed(self) -> Stream:
        for name in OF_BODY:
            column = getattr(self, name)
            # All three reversed are no axes but a sign: a rate the other way round, a load instead of its reaction.
            if column is None or not column.is_left_handed or column.axes == REVERSED:
                continue
            others = ", ".join(f'"{axis[1:] if axis.startswith("-") else "-" + axis}"' for axis in column.axes)
            offset = f", offset = {-column.offset:g}" if column.offset else ""
            said = f"say scale = {-column.scale:g}{offset} and axes = [{others}]"
            raise ValueError(
                f"{name}.axes: are left-handed: is a sign missing? Of values whose signs are all reversed {said}"
            )
        return self


class LogTruth(Section):
    """Motion that was recorded: its sensors' samples are the log's, and what is known of the motion is a reference."""

    source: Literal["log"]
    file: str = Field(
        description="the log, seen from this file: ArduPilot .bin or .log, PX4 .ulg, run.nc, or a table: "
        ".npz, .mat, .parquet, or text such as .csv"
    )
    aircraft: str | None = Field(
        default=None,
        min_length=1,
        description="an aircraft that flies as this one did, for what estimators expect; none: any body",
    )
    rate_hz: TickRate = 200.0
    start_s: float = Field(default=0.0, ge=0, description="seconds of the log that are left out before the run begins")
    reference: Literal["solution", "gnss", "none"] = Field(
        default="solution",
        description="what errors are formed against: the best solution that the log has (truth, the autopilot's own), "
        "or its GNSS where it has none; that GNSS, kept back where it is denied; or nothing",
    )
    start: Place | None = Field(default=None, description="where it begins; none: where the log's GNSS says")
    terrain: Terrain = Field(default=Terrain(), description="the ground, as filters are told of it")
    columns: dict[str, Stream] = Field(
        default_factory=dict,
        description="of a table: the columns of each sensor, by name, and of the `reference`; beside any other log a "
        "`reference` alone, with its own `file`, in place of the log's solution",
    )

    @property
    def files(self) -> dict[str, str]:
        """All that it is in, by the keys that name them."""
        own = {
            f"columns.{name}.{key}": file for name, stream in self.columns.items() for key, file in stream.files.items()
        }
        return {"file": self.file, **own}
