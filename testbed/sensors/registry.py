"""Which kinds of sensor there are: the section and the class of each, and of the user's the aid too.

A kind of the user's is a class, ``kind = "./sensors.py:Mine"``, ``"module:Mine"`` or an entry point of the group
``navigation_testbed.sensors``:

    class Mine:
        class Section(AidingTiming): ...    # its keys (`testbed.sensors.timing.AidingTiming`), pydantic
        def __init__(self, name, section, tick_rate_hz, seed): ...
        def sense(self, truth): ...         # the samples inside a block, `testbed.motion.table.TruthBlock`

        @staticmethod
        def aid(name, section, imu): ...    # what filters are told of it, an aid as in `nav.aids`; may be left out

A sample is a frozen dataclass with ``t``, ``t_arrival`` [s], its numbers, and ``sensor``, its name; the record takes
unit and meaning of a number from ``field(metadata={"unit": "m", "meaning": "..."})``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import create_model

from testbed import plugins
from testbed.errors import UserError, choice, shown
from testbed.schema import Section
from testbed.sensors.airspeed import Airspeed, AirspeedConfig
from testbed.sensors.barometer import Barometer, BarometerConfig
from testbed.sensors.body_velocity import BodyVelocity, BodyVelocityConfig
from testbed.sensors.gnss import Gnss, GnssConfig
from testbed.sensors.imu import Imu, ImuConfig
from testbed.sensors.magnetometer import Magnetometer, MagnetometerConfig
from testbed.sensors.optical_flow import OpticalFlow, OpticalFlowConfig
from testbed.sensors.position_fix import PositionFix, PositionFixConfig
from testbed.sensors.rangefinder import Rangefinder, RangefinderConfig
from testbed.sensors.star_tracker import StarTracker, StarTrackerConfig
from testbed.sensors.timing import AidingTiming
from testbed.sensors.wind_report import WindReport, WindReportConfig

GROUP = "navigation_testbed.sensors"


@dataclass(frozen=True, slots=True)
class Kind:
    """The keys of a ``[sensors.<name>]`` of this kind, the class, and of a class of the user's the maker of its aid."""

    section: type[Section]
    sensor: Callable[..., Any]
    aid: Callable[..., Any] | None = None


BUILT_IN: dict[str, Kind] = {
    "imu": Kind(ImuConfig, Imu),
    "gnss": Kind(GnssConfig, Gnss),
    "magnetometer": Kind(MagnetometerConfig, Magnetometer),
    "barometer": Kind(BarometerConfig, Barometer),
    "airspeed": Kind(AirspeedConfig, Airspeed),
    "body_velocity": Kind(BodyVelocityConfig, BodyVelocity),
    "star_tracker": Kind(StarTrackerConfig, StarTracker),
    "position_fix": Kind(PositionFixConfig, PositionFix),
    "rangefinder": Kind(RangefinderConfig, Rangefinder),
    "optical_flow": Kind(OpticalFlowConfig, OpticalFlow),
    "wind_report": Kind(WindReportConfig, WindReport),
}
_BY_SECTION: dict[type[Section], Kind] = {kind.section: kind for kind in BUILT_IN.values()}
_CUSTOM: dict[tuple[str, Any], Kind] = {}
_FOLDERS: dict[type[Section], Path] = {}  # from which the kind of a user's was seen


def find(kind: str, folder: Path) -> Kind:
    """The kind of this name; a path in it is seen from ``folder``. Raises UserError when there is none such."""
    if kind in BUILT_IN:
        return BUILT_IN[kind]
    offered = plugins.installed(GROUP)
    if ":" not in kind and kind not in offered:
        text = f"there is no sensor of kind {shown(kind)}: {choice(kind, [*BUILT_IN, *offered])}"
        raise UserError(f'{text}, or name a class of your own, such as "./sensors.py:Mine"')
    made = plugins.load(kind, folder, GROUP)
    if (kind, made) not in _CUSTOM:
        _CUSTOM[kind, made] = _custom(kind, made, folder.absolute())
    return _CUSTOM[kind, made]


class _Sent(Section):
    """What makes the section of a user's class fit to be sent: another process finds its class as this one did."""

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str, Path], Any]:
        section: Any = self
        return _blank, (section.kind, _FOLDERS[type(section)]), section.__getstate__()


def _blank(kind: str, folder: Path) -> Section:
    """A section of this kind that has no values yet."""
    section = find(kind, folder).section
    return section.__new__(section)


def _custom(kind: str, made: Any, folder: Path) -> Kind:
    section = getattr(made, "Section", None)
    if not (isinstance(section, type) and issubclass(section, AidingTiming)):
        raise UserError(f"kind {shown(kind)} lacks a Section, a class of testbed.sensors.timing.AidingTiming")
    if not callable(getattr(made, "sense", None)):
        raise UserError(f"kind {shown(kind)} lacks sense: see docs/extending.md")
    named = create_model(section.__name__, __base__=(_Sent, section), kind=(str, kind))
    _FOLDERS[named] = folder
    found = Kind(named, made, getattr(made, "aid", None))
    _BY_SECTION[named] = found
    return found


def of(section: Section) -> Kind:
    """The kind that a section is of."""
    return _BY_SECTION[type(section)]
