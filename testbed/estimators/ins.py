"""``kind = "ins"``: one strapdown INS with an error-state filter of all its aids."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, Literal

from pydantic import Field

from nav.aids import Aid, AirspeedAid, Course, GnssAid, ZeroVelocityAid
from nav.horizon import FusionHorizon
from nav.ins import Ins, InsConfig
from nav.standing import ZERO_VELOCITY, Standing
from nav.unscented import Scaling
from nav.weighting import Fading, SageHusa
from testbed.estimators.datasheet import aid_of, imu_model
from testbed.estimators.lane import Lane, handover_errors, mountings
from testbed.estimators.rig import Rig
from testbed.estimators.section import (
    ONE_EACH,
    SEVERAL,
    Engine,
    EstimatorSection,
    Gust,
    Handover,
    Mistake,
    Slip,
    States,
    TurnRate,
    WindWalk,
    aid_mistakes,
    second_of_a_kind,
    slip_mistakes,
)
from testbed.schema import Section
from testbed.sensors import SensorConfig, custom, geomagnetic_field_n

STATE_ORDER = ("gnss", "barometer", "magnetometer", "airspeed")  # the order in the state, which decides on its rounding
GNSS_MEASUREMENTS = ("gnss_position", "gnss_velocity", "gnss_course")


class CourseSection(Section):
    """GNSS course as a measurement of heading: with the wind where airspeed aids, else taken for the heading."""

    max_turn_rate_degps: float | None = Field(default=None, gt=0, le=360, description="none: in turns as well")
    quiet_s: float = Field(default=2.0, ge=0, le=60, description="for how long it must not have turned faster")


class SageHusaSection(Section):
    """Measurement noise learned from the residuals (`nav.weighting.SageHusa`)."""

    b: float = Field(default=0.97, ge=0.5, lt=1, description="forgetting factor per measurement")


class FadingSection(Section):
    """Covariance made as large as the innovations say when they diverge (`nav.weighting.Fading`)."""

    window: int = Field(default=10, ge=1, le=1000, description="measurements that it averages over")
    alpha: float = Field(default=20.0, ge=1, le=100, description="times the expected innovation is divergence")
    looks: Annotated[tuple[Literal["gnss_position", "gnss_velocity", "gnss_course"], ...], Field(min_length=1)] = Field(
        default=(
            "gnss_position",
            "gnss_velocity",
            "gnss_course",
        ),
        description="innovations that are watched",
    )


class InsSection(EstimatorSection):
    """Keys of an INS (`nav.ins.InsConfig`)."""

    kind: Literal["ins"] = "ins"
    aids: tuple[str, ...] = Field(description="sensors whose samples it uses, by their names")
    states: States = "biases"
    turn_degps: TurnRate = None
    gust_mps: Gust = None
    wind_walk_mps_per_sqrt_s: WindWalk = None
    handover: Handover | None = Field(default=None, description="how well the start is known; none: it aligns")
    nonholonomic_mps: Slip | None = None
    zero_velocity_mps: float | None = Field(
        default=None,
        gt=0,
        le=1,
        description="how fast it moves when it stands, 1 sigma: used as a velocity of zero once a receiver has said so,"
        " and while the IMU feels nothing since; none: not used",
    )
    engine: Engine = "linear"
    course: CourseSection | None = Field(default=None, description="of its GNSS receiver; none: not used")
    sage_husa: SageHusaSection | None = Field(default=None, description="none: the receiver's sigmas are believed")
    fading: FadingSection | None = Field(
        default=None, description="covariance that follows diverging innovations; none: it does not"
    )
    smooth: bool = Field(
        default=False,
        description="look back in the end: `<name>_smoothed` is what it would say, knowing the whole run",
    )
    false_rejection: float = Field(default=1e-3, ge=0, lt=0.5, description="of sound samples by the gate; 0: no gate")

    def mistakes(self, sensors: Mapping[str, SensorConfig]) -> Iterator[Mistake]:
        """What is wrong with it among these sensors."""
        yield from super().mistakes(sensors)
        yield from aid_mistakes("ins", self.aids, sensors, ONE_EACH | SEVERAL, own=True)
        if self.smooth and self.engine != "linear":
            yield ("smooth",), f"needs engine 'linear', not {self.engine!r}: leave one of the two out"
        receivers = [aid for aid in self.aids if aid in sensors and sensors[aid].kind == "gnss"]
        for key in ("course", "sage_husa", "fading"):
            if getattr(self, key) is not None and not receivers:
                yield (key,), "needs a GNSS receiver among the aids: add one, or leave it out"
        if self.zero_velocity_mps is not None and not any(one.kind == "gnss" for one in sensors.values()):
            yield ("zero_velocity_mps",), "needs a GNSS receiver, which says that it stands: add one, or leave it out"
        if self.zero_velocity_mps is not None and ZERO_VELOCITY in sensors:
            yield ("zero_velocity_mps",), f"takes the name {ZERO_VELOCITY!r}: give the sensor of that name another"
        yield from slip_mistakes(self.nonholonomic_mps, self.aids, sensors)
        yield from second_of_a_kind("ins", self.aids, sensors)


def build(section: InsSection, rig: Rig) -> Lane:
    """The INS that a section asks for, not yet aligned."""
    sensors, errors = rig.sensors, rig.imu_errors(section.imu, *section.spare_imus)
    air = rig.air(section.gust_mps, section.wind_walk_mps_per_sqrt_s)

    def aid(name: str) -> Aid | None:
        return aid_of(name, rig, errors, air, section.nonholonomic_mps)

    # One sensor of a kind: an aid, or the first in the file, whose samples then serve the alignment only.
    offered = {sensors[name].kind: name for name in section.aids if sensors[name].kind in ONE_EACH}
    for name, sensor in sensors.items():
        if sensor.kind in ONE_EACH:
            offered.setdefault(sensor.kind, name)
    singles = [name for kind in STATE_ORDER for name in section.aids if sensors[name].kind == kind]
    several = [name for name in section.aids if sensors[name].kind not in ONE_EACH]
    aids = [made for made in map(aid, (*singles, *several)) if made is not None]
    custom.require_alike(aids)
    if section.course is not None:
        aids = _with_course(aids, section.course)
    used = tuple(dict.fromkeys((*offered.values(), *(made.sensor for made in aids))))
    standing = None
    if section.zero_velocity_mps is not None:
        aids.append(ZeroVelocityAid(ZERO_VELOCITY, section.zero_velocity_mps))
        standing = Standing((errors.gyro_noise, errors.accel_noise))
    idle = [made for name in offered.values() if name not in singles and (made := aid(name)) is not None]
    learning, fading = section.sage_husa, section.fading
    ins = Ins(
        InsConfig(
            imu_model(errors, rig.turn_rate(section.turn_degps), section.states, rig.usual),
            tuple(aids),
            tuple(idle),
            mounting_sigma=0.0 if section.states == "matrix" else errors.accel_misalignment,
            scaling=scaling(section.engine),
            smooth=section.smooth,
            false_rejection=section.false_rejection,
        ),
        partial(geomagnetic_field_n, date=rig.site.date),
        {part: SageHusa(learning.b) for part in GNSS_MEASUREMENTS} if learning else None,
        {part: Fading(fading.window, fading.alpha) for part in fading.looks} if fading else None,
    )
    imus, voter = mountings(section, rig)
    return Lane(
        FusionHorizon(ins, rig.lag_s(used), coning=rig.imu(section.imu).rate_hz < rig.tick_rate_hz),
        imus,
        used,
        handover_errors(section.handover, errors.lever_arm_b, rig.seed),
        voter,
        standing=standing,
        spacing_s=rig.spacing_s(used),
    )


def scaling(engine: Engine) -> Scaling | None:
    """How far out the sigma points of an engine lie, None when it has none."""
    return Scaling() if engine == "unscented" else None


def _with_course(aids: Sequence[Aid], section: CourseSection) -> list[Aid]:
    """The same aids with the course of their receiver, its slip [m/s] that of the constraint of no sideslip.

    With the wind, course says what that constraint says: both would count it twice. Without it there is no slip, as on
    a road.
    """
    limit = math.inf if section.max_turn_rate_degps is None else math.radians(section.max_turn_rate_degps)
    slip = next((aid.sideslip_sigma for aid in aids if isinstance(aid, AirspeedAid)), None) or 0.0
    course = Course(limit, section.quiet_s, slip)
    return [
        replace(aid, course=course) if isinstance(aid, GnssAid)
        else replace(aid, sideslip_sigma=None) if isinstance(aid, AirspeedAid)
        else aid
        for aid in aids
    ]  # fmt: skip
