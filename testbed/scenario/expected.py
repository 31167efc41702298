"""What a scenario may expect: the names of metrics that a run of it can have."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from typing import TYPE_CHECKING

from nav.ahrs import LEVEL, MAGNETIC_HEADING
from nav.standing import ZERO_VELOCITY
from testbed import measures
from testbed.errors import unknown
from testbed.estimators.ahrs import AhrsSection
from testbed.estimators.federated import FederatedSection
from testbed.estimators.ins import InsSection
from testbed.estimators.section import EstimatorSection
from testbed.scenario.keypath import KeyPath
from testbed.sensors import SensorConfig, faults

if TYPE_CHECKING:
    from testbed.scenario.schema import Scenario

KEY = re.compile(r"(?P<whose>[A-Za-z_][A-Za-z0-9_]*)\.(?P<metric>[a-z0-9_]+(\.[A-Za-z0-9_]+)*)")
# What filters can make of the samples of a sensor, by its kind: the parts that the aids in `nav.aids` have.
AIDS: Mapping[str, tuple[str, ...]] = {
    "gnss": ("gnss_position", "gnss_velocity", "gnss_course"),
    "barometer": ("barometer",),
    "magnetometer": ("magnetometer",),
    "airspeed": ("airspeed", "sideslip"),
    "body_velocity": ("body_velocity", "nonholonomic"),
    "star_tracker": ("star_attitude",),
    "position_fix": ("position_fix",),
    "rangefinder": ("range", "terrain_fix"),
    "optical_flow": ("optical_flow",),
    "wind_report": ("wind_report",),
}


def mistakes(scenario: Scenario, estimators: Collection[str]) -> Iterator[tuple[KeyPath, str]]:
    """What is wrong with names in [expect]: no run of the scenario could have such a metric."""
    known = sorted({*estimators, "run", "flight"})
    for key in scenario.expect:
        path: KeyPath = ("expect", key)
        match = KEY.fullmatch(key)
        if not match:
            yield (
                path,
                'is no metric: write it quoted as "<estimator>.<quantity>_<statistic>_<unit>", such as'
                ' "ins.position_horizontal_rms_m" = 5.0',
            )
        elif match["whose"] not in known:
            yield path, unknown("estimator", match["whose"], known)
        elif measures.find(key) is None:
            yield path, unknown("metric", match["metric"], measures.names(match["whose"]))
        else:
            yield from ((path, text) for text in _of_what(scenario, match["whose"], match["metric"]))


def _of_what(scenario: Scenario, whose: str, metric: str) -> Iterator[str]:
    """What is wrong with the aid or the fault that a metric is of, if it is of one."""
    kind, dot, of = metric.partition(".")
    section = next((one for one in scenario.estimator if whose in one.recorded), None)
    if not dot or section is None:
        return
    if whose != section.name:
        yield f"{whose!r} looks back, and has nothing of aids or faults: expect it of {section.name!r}"
        return
    if kind in measures.OF_FAULTS:
        there: list[str] | None = _fault_names(scenario)
    else:
        there = aids(section, scenario.sensors)
    if there is not None and of not in there:
        yield unknown("fault" if kind in measures.OF_FAULTS else f"aid of {whose}", of, there)


def _fault_names(scenario: Scenario) -> list[str]:
    names: list[str] = []
    for fault in scenario.fault:
        names.append(faults.label(fault, names))
    return names


def aids(section: EstimatorSection, sensors: Mapping[str, SensorConfig]) -> list[str] | None:
    """The aids that an estimator can have innovations of; None where only its run can tell, as of own code."""
    if isinstance(section, AhrsSection):
        return [LEVEL, MAGNETIC_HEADING]
    if not isinstance(section, InsSection | FederatedSection):
        return None
    used = [sensors[name] for name in section.aiding(sensors) if name in sensors]
    if any(one.kind not in AIDS for one in used):
        return None
    course = isinstance(section, InsSection) and section.course is not None
    left_out = {"sideslip" if course else "gnss_course"}  # a course has the sideslip in it
    if section.nonholonomic_mps is None:
        left_out.add("nonholonomic")
    if any(getattr(one, "slips", False) for one in used):
        left_out.add("sideslip")
    found = [part for one in used for part in AIDS[one.kind] if part not in left_out]
    if isinstance(section, InsSection) and section.zero_velocity_mps is not None:
        found.append(ZERO_VELOCITY)
    return list(dict.fromkeys(found))
