"""What is recorded: name, unit, meaning, dimensions and element type of every column, in one table each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from nav.samples import FixType, Outcome, Status
from testbed.motion.table import COLUMNS

FORMAT = "navigation-testbed run 2"

# What the components of a vector mean: the labels of its dimension.
AXES: dict[str, tuple[str, ...]] = {
    "ned": ("north", "east", "down"),
    "body": ("forward", "right", "down"),
    "north_east": ("north", "east"),
    "cross": ("xy", "xz", "yx", "yz", "zx", "zy"),
    "fix_part": ("position", "velocity"),
    "body_xy": ("x", "y"),
    "quaternion": ("w", "x", "y", "z"),
    "inertial_quaternion": ("w", "x", "y", "z"),
    "surface": ("aileron", "elevator", "rudder", "throttle"),
    "command": ("bank", "altitude", "airspeed"),
    "error": tuple(
        f"{what}_{axis}" for what in ("position", "velocity", "attitude") for axis in ("north", "east", "down")
    ),
}
AXES["element"] = tuple(row + column for row in "xyz" for column in "xyz")
AXES["error_column"] = AXES["error"]
_FRAME = {
    "ned": "n: local north-east-down",
    "north_east": "n: local north-east-down",
    "body_xy": "b: body forward-right-down",
    "body": "b: forward-right-down",
    "quaternion": "from b (forward-right-down) to n (north-east-down)",
    "inertial_quaternion": "from b (forward-right-down) to i (ECEF at time 0)",
    "error": "n: local north-east-down",
}


@dataclass(frozen=True, slots=True)
class Variable:
    """Unit, meaning, dimensions after time, element type and further attributes of one recorded column."""

    unit: str
    meaning: str
    dims: tuple[str, ...] = ()
    dtype: str = "<f8"
    attributes: Mapping[str, str] = field(default_factory=dict)

    @property
    def frame(self) -> str:
        """Frame of the components, empty for scalars."""
        return next((_FRAME[d] for d in self.dims if d in _FRAME), "")

    @property
    def labels(self) -> dict[str, str]:
        """The attributes that it has in the file, empty ones left out."""
        pairs = {"units": self.unit, "long_name": self.meaning, "frame": self.frame, **self.attributes}
        return {key: value for key, value in pairs.items() if value}


def _truth_dims(name: str, width: int) -> tuple[str, ...]:
    if width == 1:
        return ()
    if name.startswith("q_"):
        return ("quaternion",)
    if name.endswith("_n"):
        return ("ned",)
    return {"controls": ("surface",), "commands": ("command",)}.get(name, ("body",))


TRUTH = {name: Variable(c.unit, c.meaning, _truth_dims(name, c.width)) for name, c in COLUMNS.items() if name != "t"}
for _name, _what in (("dtheta", "omega_b"), ("dv", "specific force at the centre of gravity, body axes")):
    TRUTH[_name] = replace(TRUTH[_name], meaning=f"sum over the ticks since the last row of the increments of {_what}")

IMU = {
    "dt": Variable("s", "length of the interval that ends at time"),
    "dtheta": Variable("rad", "measured integral of angular rate of b relative to i", ("body",)),
    "dv": Variable("m/s", "measured integral of specific force", ("body",)),
}

SAMPLE = {
    "t_arrival": Variable("s", "when the sample could first be used"),
    "lat": Variable("rad", "measured geodetic latitude, WGS84; GNSS: of the antenna"),
    "lon": Variable("rad", "measured longitude, WGS84; GNSS: of the antenna"),
    "h": Variable("m", "measured height above the ellipsoid; GNSS: of the antenna"),
    "v_n": Variable("m/s", "velocity of the antenna over ground", ("ned",)),
    "sigma_position_n": Variable("m", "reported 1-sigma of position", ("ned",)),
    "sigma_velocity_n": Variable("m/s", "reported 1-sigma of velocity", ("ned",)),
    "fix_type": Variable(
        "1",
        "GNSS fix type, -1 where nothing was written",
        dtype="<i4",
        attributes={
            "flag_values": " ".join(str(int(f)) for f in FixType),
            "flag_meanings": " ".join(f.name.lower() for f in FixType),
        },
    ),
    "satellites": Variable("1", "satellites used, -1 where nothing was written, or a log does not say", dtype="<i4"),
    "hdop": Variable("1", "horizontal dilution of precision"),
    "vdop": Variable("1", "vertical dilution of precision"),
    "pressure": Variable("Pa", "measured static pressure"),
    "field_b": Variable("T", "measured magnetic flux density", ("body",)),
    "eas": Variable("m/s", "measured equivalent airspeed along body x"),
    "v_b": Variable("m/s", "measured velocity over ground, NaN on axes that are not measured", ("body",)),
    "range": Variable("m", "measured range to the ground along body z"),
    "flow_b": Variable("rad/s", "rates of the line of sight about body x and y", ("body_xy",)),
    "rotation_b": Variable("rad/s", "rotation of the body about x and y by the sensor's own gyro", ("body_xy",)),
    "quality": Variable("1", "quality of the match of the images, 0 to 1"),
    "wind_n": Variable("m/s", "reported velocity of the air over ground, a mean", ("north_east",)),
    "age": Variable("s", "how long before its time of validity that was"),
    "sigma": Variable("m/s", "reported 1-sigma per axis"),
    "q_ib": Variable("1", "measured attitude quaternion, scalar first", ("inertial_quaternion",)),
}

ESTIMATE = {
    "lat": Variable("rad", "estimated geodetic latitude, WGS84"),
    "lon": Variable("rad", "estimated longitude, WGS84"),
    "h": Variable("m", "estimated height above the ellipsoid"),
    "v_n": Variable("m/s", "estimated velocity over ground", ("ned",)),
    "q_nb": Variable("1", "estimated attitude quaternion, scalar first", ("quaternion",)),
    "gyro_bias": Variable("rad/s", "estimated gyro bias", ("body",)),
    "accel_bias": Variable("m/s^2", "estimated accelerometer bias", ("body",)),
    "sigma_position_n": Variable("m", "1-sigma of position error", ("ned",)),
    "sigma_velocity_n": Variable("m/s", "1-sigma of velocity error", ("ned",)),
    "sigma_attitude_n": Variable("rad", "1-sigma of attitude error phi", ("ned",)),
    "sigma_gyro_bias": Variable("rad/s", "1-sigma of gyro bias", ("body",)),
    "sigma_accel_bias": Variable("m/s^2", "1-sigma of accelerometer bias", ("body",)),
    "covariance": Variable(
        "products of m, m/s, rad",
        "covariance of position, velocity and attitude error",
        ("error", "error_column"),
        "<f4",  # a dozen standard deviations would do; half the size of everything else an estimator says
    ),
    "status": Variable(
        "1",
        "what the estimator says of itself, -1 where nothing was written",
        dtype="<i4",
        attributes={
            "flag_masks": " ".join(str(int(f)) for f in Status),
            "flag_meanings": " ".join((f.name or "").lower() for f in Status),
        },
    ),
}

# The further states that estimators may carry, by name.
EXTRA = {
    "gyro_drift": Variable("rad/s", "estimated correlated part of the gyro bias", ("body",)),
    "accel_drift": Variable("m/s^2", "estimated correlated part of the accelerometer bias", ("body",)),
    "gyro_scale": Variable("1", "estimated gyro scale factor error", ("body",)),
    "accel_scale": Variable("1", "estimated accelerometer scale factor error", ("body",)),
    "gyro_cross": Variable("1", "estimated share that a gyro feels of the rates about other axes", ("cross",)),
    "accel_cross": Variable("1", "estimated share that an accelerometer feels of other axes", ("cross",)),
    "gnss_position_error": Variable("m", "estimated correlated error of GNSS position", ("ned",)),
    "gnss_velocity_error": Variable("m/s", "estimated correlated error of GNSS velocity", ("ned",)),
    "gnss_latency": Variable(
        "s", "estimated latency of GNSS position, and further lag of its velocity, beyond what is told", ("fix_part",)
    ),
    "barometer_bias": Variable("m", "estimated bias of pressure altitude"),
    "barometer_error": Variable("m", "estimated correlated error of pressure altitude"),
    "magnetometer_bias": Variable("T", "estimated magnetometer bias", ("body",)),
    "magnetometer_anomaly": Variable("T", "estimated error of the reference field, constant over ground", ("ned",)),
    "magnetometer_soft_iron": Variable("1", "estimated soft iron matrix less the unit matrix", ("element",)),
    "magnetometer_error": Variable("T", "estimated correlated error of the magnetometer", ("body",)),
    "wind": Variable("m/s", "estimated velocity of the air over ground, without gusts", ("north_east",)),
    "gust": Variable("m/s", "estimated gust beside the steady wind", ("north_east",)),
    "airspeed_scale": Variable("1", "estimated scale factor error of the airspeed sensor"),
    "body_velocity_scale": Variable("1", "estimated scale factor error of the body velocity sensor", ("body_axis",)),
    "body_velocity_error": Variable("m/s", "estimated correlated error of body velocity", ("body_axis",)),
    "terrain": Variable("m", "estimated height of the ground over the map"),
    "terrain_local": Variable("m", "estimated height of the ground over the map here, beside that"),
    "rangefinder_scale": Variable("1", "estimated scale factor error of the rangefinder"),
    "optical_flow_scale": Variable("1", "estimated scale factor error of the optics"),
    "optical_flow_error": Variable("rad/s", "estimated slow error of optical flow", ("body_xy",)),
    "wind_report_error": Variable("m/s", "estimated slow error of the wind report", ("north_east",)),
    "mode_counter": Variable("1", "periods of low dynamics"),
    "correction_counter": Variable("1", "corrections of the attitude since the last period that was none"),
    "judged_acceleration": Variable("m/s^2", "acceleration by which low dynamics were judged"),
    "judged_yaw_rate": Variable("rad/s", "rate about body z by which low dynamics were judged"),
    "judged_roll_rate": Variable("rad/s", "rate about body x by which low dynamics were judged"),
}


def extra_state(name: str, width: int) -> Variable:
    """What a further state of as many numbers is; receivers have names of their own, a local filter's may be in front.

    One of an estimator of the user's may have a known name, and another number of numbers: then it is not known.
    """
    for known, variable in EXTRA.items():
        if name == known or name.endswith(("_" + known, known.removeprefix("gnss"))):
            if width != (len(AXES.get(variable.dims[0], range(width))) if variable.dims else 1):
                break
            return variable
    return Variable("unknown", "further state", (f"{name}_component",))


# Unit of the innovation of each aid, and its components.
INNOVATIONS: dict[str, tuple[str, tuple[str, ...]]] = {
    "gnss_position": ("m", ("ned",)),
    "gnss_velocity": ("m/s", ("ned",)),
    "magnetometer": ("T", ("body",)),
    "barometer": ("m", ("component",)),
    "airspeed": ("m/s", ("component",)),
    "sideslip": ("m/s", ("component",)),
    "body_velocity": ("m/s", ("component",)),
    "nonholonomic": ("m/s", ("component",)),
    "zero_velocity": ("m/s", ("ned",)),
    "star_attitude": ("rad", ("body",)),
    "position_fix": ("m", ("component",)),
    "range": ("m", ("component",)),
    "terrain_fix": ("m", ("component",)),
    "optical_flow": ("rad/s", ("body_xy",)),
    "wind_report": ("m/s", ("north_east",)),
    "gnss_course": ("rad", ("component",)),
    "level": ("m/s^2", ("north_east",)),
    "magnetic_heading": ("rad", ("component",)),
}
REPORT = {
    "sensor": Variable("", "whose sample it was", dtype="S32"),
    "nis": Variable("1", "normalised innovation squared"),
    "threshold": Variable("1", "gate for nis"),
    "weight": Variable("1", "factor on the information of the sample: 1 taken as it is, 0 rejected"),
    "outcome": Variable(
        "1",
        "what became of the sample, -1 where nothing was written",
        dtype="i1",
        attributes={
            "flag_values": " ".join(str(int(f)) for f in Outcome),
            "flag_meanings": " ".join(f.name.lower() for f in Outcome),
        },
    ),
    "reason": Variable("", "why it was refused or weakened, for people; empty when simply fused", dtype="S64"),
}

FAULT = {
    "end": Variable("s", "when the fault ends"),
    "name": Variable("", "name of the fault", dtype="S64"),
    "sensor": Variable("", "sensor that it acts on", dtype="S64"),
    "channel": Variable("", "quantity that it acts on, empty for all", dtype="S16"),
    "kind": Variable("", "how it acts", dtype="S16"),
    "size": Variable("in unit", "its principal number as in the scenario, NaN when it has none"),
    "unit": Variable("", "unit of size", dtype="S16"),
}

STEERED = {
    "surfaces": Variable(
        "1",
        "what a far end commands from now on: shares of travel with the signs of controls, throttle 0 to 1",
        ("surface",),
    ),
    "flies": Variable(
        "1",
        "whether that moves the aircraft: 0 as long as the plan is flown, -1 where nothing was written",
        dtype="i1",
    ),
}

REQUEST = {
    "tick": Variable("1", "number of the first row that it had to do with", dtype="<i8"),
    "kind": Variable("", "what was asked", dtype="S8"),
    "content": Variable("", "the same in full, JSON", dtype="S512"),
}

EVENT = {
    "severity": Variable("", "info, warning or error", dtype="S8"),
    "text": Variable("", "what happened", dtype="S320"),
}
