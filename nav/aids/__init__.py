"""Aids: what each sensor tells a filter, one file for each kind.

A file has the kernels (innovation and Jacobian of a measurement), which samples are not fit to use (``problem``), and
the aid itself with its error states: see `nav.aids.base.Aid`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from nav.aids import (
    airspeed,
    barometer,
    body_velocity,
    gnss,
    magnetometer,
    position_fix,
    star_tracker,
    terrain,
    wind_report,
)
from nav.aids.airspeed import AirspeedAid
from nav.aids.barometer import BarometerAid
from nav.aids.base import Aid
from nav.aids.body_velocity import BodyVelocityAid
from nav.aids.gnss import Course, GnssAid
from nav.aids.magnetometer import MagnetometerAid
from nav.aids.position_fix import PositionFixAid
from nav.aids.star_tracker import StarAid
from nav.aids.terrain import OpticalFlowAid, RangefinderAid
from nav.aids.wind_report import WindReportAid
from nav.aids.zero_velocity import ZeroVelocityAid
from nav.samples import (
    AirspeedSample,
    BarometerSample,
    BodyVelocitySample,
    GnssSample,
    MagnetometerSample,
    OpticalFlowSample,
    PositionSample,
    RangeSample,
    Sample,
    StarSample,
    WindSample,
)

__all__ = [
    "Aid",
    "AirspeedAid",
    "BarometerAid",
    "BodyVelocityAid",
    "Course",
    "GnssAid",
    "MagnetometerAid",
    "OpticalFlowAid",
    "PositionFixAid",
    "RangefinderAid",
    "StarAid",
    "WindReportAid",
    "ZeroVelocityAid",
    "problem",
]

PROBLEMS: Mapping[type[Sample], Callable[[Any], str]] = {
    AirspeedSample: airspeed.problem,
    BarometerSample: barometer.problem,
    BodyVelocitySample: body_velocity.problem,
    GnssSample: gnss.problem,
    MagnetometerSample: magnetometer.problem,
    OpticalFlowSample: terrain.flow_trouble,
    PositionSample: position_fix.problem,
    RangeSample: terrain.range_trouble,
    StarSample: star_tracker.problem,
    WindSample: wind_report.problem,
}


def problem(sample: Sample) -> str:
    """Why ``sample`` must not be fused, empty when it is sound."""
    if not math.isfinite(sample.t):
        return "time is not finite"
    check = PROBLEMS.get(type(sample))
    return check(sample) if check is not None else ""
