"""What can be wrong between keys of a scenario that are each right."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from nav.terrain import Terrain
from nav.terrain import ground as height_of_ground
from testbed.errors import UserError, unknown
from testbed.estimators.ahrs import AhrsSection
from testbed.estimators.outside import OutsideSection
from testbed.estimators.section import EstimatorSection
from testbed.motion import aircraft, guidance, terrain
from testbed.motion.logged import LogTruth
from testbed.motion.sections import FlightTruth, KinematicTruth
from testbed.motion.weather import strongest
from testbed.scenario import expected, keypath
from testbed.scenario.keypath import KeyPath
from testbed.schema import IDENTIFIER, LONGEST_RUN_S
from testbed.sensors import SensorConfig, faults
from testbed.sensors.timing import TICK_TOLERANCE

if TYPE_CHECKING:
    from testbed.scenario.schema import Scenario

LONGEST_NAME = 32  # as the record keeps them
ON_THE_GROUND_M = 1.0  # as near as the height of a start must be told
RESERVED = frozenset({"run", "flight", "truth"})  # `run.wall_s` and the like would become ambiguous


def found(scenario: Scenario) -> Iterator[tuple[KeyPath, str]]:
    """What is wrong between keys that are each right."""
    tick_hz = scenario.truth.rate_hz
    yield from _divides(("record", "rate_hz"), scenario.record.rate_hz, tick_hz)
    for name, config in scenario.sensors.items():
        yield from _sensor_mistakes(("sensors", name), config, scenario.duration_s)
        if not isinstance(scenario.truth, LogTruth):  # whose sensors have times of their own
            yield from _tick_mistakes(("sensors", name), config, tick_hz)
    try:
        terrain.thinned(terrain.of(scenario.truth.terrain), scenario.truth.terrain.map_every)
    except UserError as error:
        yield ("truth", "terrain", "file"), str(error)
    yield from _plan_mistakes(scenario)
    yield from _fault_mistakes(scenario)
    taken: set[str] = set()
    for index, estimator in enumerate(scenario.estimator):
        yield from _estimator_mistakes(("estimator", index), estimator, scenario.sensors, taken)
        if not isinstance(scenario.truth, LogTruth):  # whose units are brought to common times
            yield from _stamp_mistakes(("estimator", index, "spare_imus"), estimator, scenario.sensors)
        taken |= set(estimator.recorded)
    yield from _address_mistakes(scenario)
    yield from _autopilot_mistakes(scenario)
    yield from expected.mistakes(scenario, taken)


def _plan_mistakes(scenario: Scenario) -> Iterator[tuple[KeyPath, str]]:
    if not isinstance(scenario.truth, FlightTruth):
        if scenario.plan:
            yield ("plan",), f"a body of source {scenario.truth.source!r} flies no plan: leave it out"
        if isinstance(scenario.truth, KinematicTruth):
            yield from _track_mistakes(scenario.truth)
        elif scenario.truth.aircraft is not None:
            yield from _aircraft_mistakes(scenario.truth.aircraft)
        return
    if not scenario.plan:
        yield ("plan",), "a flight needs a plan: add at least one [[plan]] leg"
        return
    named, wind = scenario.truth.aircraft, scenario.truth.wind
    if complaints := list(_aircraft_mistakes(named)):
        yield from complaints
        return
    envelope = aircraft.load(named)
    if wind.front is not None and wind.front.time_s - wind.front.width_s / 2 >= scenario.duration_s:
        after = f"it comes after the end of the run: duration_s is {scenario.duration_s:g}"
        yield ("truth", "wind", "front", "time_s"), after
    try:
        foreseen = strongest(wind)
    except UserError as error:
        yield ("truth", "wind", "file"), str(error)
        return
    try:
        relief = terrain.of(scenario.truth.terrain)
    except UserError:  # told already
        return
    start = scenario.truth.start
    yield from _launch_mistakes(scenario.truth, envelope, relief)
    yield from _ground_mistakes(scenario.truth, relief)
    begun = guidance.beginning(start, envelope)
    # Nothing is flown below the lowest of a relief; whether a leg meets what is higher the flight shows.
    ground = start.alt_m if start.on_ground else float(relief.heights.min())
    for key, what in guidance.plan_mistakes(scenario.plan, begun, envelope, foreseen, ground):
        yield keypath.read(key), what


def _launch_mistakes(truth: FlightTruth, envelope: aircraft.Envelope, relief: Terrain) -> Iterator[tuple[KeyPath, str]]:
    """What of a start on the ground can't be."""
    start = truth.start
    if not start.on_ground:
        return
    if envelope.launch is None:
        lacking = f"the aircraft {truth.aircraft!r} has no [launch] in its envelope.toml"
        yield ("truth", "start", "on_ground"), f"{lacking}: add it, or begin in the air"
    lat, lon = math.radians(start.lat_deg), math.radians(start.lon_deg)
    ground = height_of_ground(lat, lon, relief.heights, relief.grid)[0]
    if not abs(start.alt_m - ground) <= ON_THE_GROUND_M:
        whose = "truth.terrain.file" if truth.terrain.file else "truth.terrain.height_m"
        yield (
            ("truth", "start", "alt_m"),
            f"a start on the ground is where the ground is, {ground:.1f} m by {whose}, not at {start.alt_m:g}:"
            " change the one or the other",
        )


def _ground_mistakes(truth: FlightTruth, relief: Terrain) -> Iterator[tuple[KeyPath, str]]:
    """What of a start in the air can't be where the ground has relief."""
    start = truth.start
    if start.on_ground or relief.heights.size == 1:
        return
    lat, lon = math.radians(start.lat_deg), math.radians(start.lon_deg)
    if not terrain.covers(relief, lat, lon):
        yield (
            ("truth", "terrain", "file"),
            f"has no heights where the flight begins: it covers {terrain.extent(relief)}",
        )
        return
    ground = height_of_ground(lat, lon, relief.heights, relief.grid)[0]
    if start.alt_m <= ground:
        yield ("truth", "start", "alt_m"), f"is below the ground, which is at {ground:.0f} m there: start above it"


def _aircraft_mistakes(named: str) -> Iterator[tuple[KeyPath, str]]:
    if aircraft.find(named) is None:
        missing = unknown("aircraft", named, list(aircraft.shipped()))
        yield ("truth", "aircraft"), f"{missing}, or give the path of its folder, as seen from the scenario file"
        return
    try:
        aircraft.load(named)
    except UserError as error:
        yield ("truth", "aircraft"), "; ".join(error.args)


def _track_mistakes(truth: KinematicTruth) -> Iterator[tuple[KeyPath, str]]:
    if truth.motion == "static":
        if truth.segments:
            yield ("truth", "segments"), 'a static body follows none: set truth.motion = "segments", or leave them out'
        if truth.start.speed_mps > 0:
            yield ("truth", "start", "speed_mps"), 'a static body has none: set truth.motion = "segments"'
    elif not truth.segments:
        yield ("truth", "segments"), "is missing: add at least one [[truth.segments]] table"
    else:
        try:
            truth.track()
        except ValueError as error:
            key, _, what = str(error).partition(": ")
            yield keypath.read(key), what


def _sensor_mistakes(path: KeyPath, config: SensorConfig, duration_s: float) -> Iterator[tuple[KeyPath, str]]:
    name = str(path[-1])
    if not IDENTIFIER.fullmatch(name):
        yield path, "a sensor's name is made of letters, digits and _, and does not begin with a digit"
    elif len(name) > LONGEST_NAME:
        yield path, f"a sensor's name has at most {LONGEST_NAME} letters"
    for start, end in getattr(config, "denied", ()):
        if start >= duration_s:
            window = f"window [{start:g}, {end:g}]"
            yield (*path, "denied"), f"{window} starts after the end of the run: duration_s is {duration_s:g}"


def _tick_mistakes(path: KeyPath, config: SensorConfig, tick_hz: float) -> Iterator[tuple[KeyPath, str]]:
    yield from _divides((*path, "rate_hz"), config.rate_hz, tick_hz)
    offset_s = getattr(config, "offset_s", 0.0)
    if not _whole(offset_s * tick_hz):
        nearest = round(offset_s * tick_hz) / tick_hz
        yield (*path, "offset_s"), f"is not a multiple of the tick {1 / tick_hz:g} s: the nearest is {nearest:g}"


def _fault_mistakes(scenario: Scenario) -> Iterator[tuple[KeyPath, str]]:
    taken: list[str] = []
    for index, fault in enumerate(scenario.fault):
        path: KeyPath = ("fault", index)
        name = faults.label(fault, taken)
        if not IDENTIFIER.fullmatch(name):
            yield (*path, "name"), "is made of letters, digits and _, and does not begin with a digit"
        elif name in taken:
            yield (*path, "name"), f"{name!r} is taken by a fault above: give each its own name"
        taken.append(name)
        start, end = fault.window
        if start >= scenario.duration_s:
            after = f"starts after the end of the run: duration_s is {scenario.duration_s:g}"
            yield (*path, "window"), f"[{start:g}, {end:g}] {after}"
        sensor = scenario.sensors.get(fault.sensor)
        if sensor is None:
            yield (*path, "sensor"), unknown("sensor", fault.sensor, list(scenario.sensors))
            continue
        channels = list(faults.CHANNELS.get(sensor.kind, {}))
        channel = getattr(fault, "channel", None)
        if channel is not None and channel not in channels:
            yield (*path, "channel"), unknown(f"channel of {fault.sensor}", channel, channels)
        for key, complaint in faults.mistakes(fault, sensor):
            yield (*path, key), complaint


def _estimator_mistakes(
    path: KeyPath, section: EstimatorSection, sensors: Mapping[str, SensorConfig], taken: set[str]
) -> Iterator[tuple[KeyPath, str]]:
    if not IDENTIFIER.fullmatch(section.name):
        yield (*path, "name"), "is made of letters, digits and _, and does not begin with a digit"
    elif same := [name for name in section.recorded if name in taken]:
        yield (*path, "name"), f"{same[0]!r} is taken by an estimator above: give each its own name"
    elif section.name in RESERVED:
        yield (*path, "name"), f"{section.name!r} is reserved: choose another name"
    for where, text in section.mistakes(sensors):
        yield (*path, *where), text


def _stamp_mistakes(
    path: KeyPath, section: EstimatorSection, sensors: Mapping[str, SensorConfig]
) -> Iterator[tuple[KeyPath, str]]:
    if not section.spare_imus:
        return
    for name in (section.imu, *section.spare_imus):
        if getattr(sensors.get(name), "jitter_s", 0.0):
            yield path, f"sensors.{name}.jitter_s: units that are voted on must be stamped together: set it to 0"


def _address_mistakes(scenario: Scenario) -> Iterator[tuple[KeyPath, str]]:
    """Two estimators that would be heard at one address."""
    heard: dict[str, str] = {}
    for index, one in enumerate(scenario.estimator):
        if isinstance(one, OutsideSection):
            if one.address in heard:
                yield ("estimator", index, "address"), f"{heard[one.address]!r} is heard there: give it another"
            heard.setdefault(one.address, one.name)


def _autopilot_mistakes(scenario: Scenario) -> Iterator[tuple[KeyPath, str]]:
    path: KeyPath = ("autopilot", "feedback")
    feedback = scenario.autopilot.feedback
    flown = isinstance(scenario.truth, FlightTruth)
    for index, config in enumerate(scenario.estimator):
        if isinstance(config, AhrsSection) and config.autopilot and not flown:
            yield (
                ("estimator", index, "autopilot"),
                f"a body of source {scenario.truth.source!r} has none: leave it out",
            )
    if not feedback.estimators:
        return
    if not flown:
        text = f"a body of source {scenario.truth.source!r} has no autopilot that could follow: leave it out"
        yield path, text
        return
    known = {config.name: config for config in scenario.estimator}
    groups = [((*path, key), getattr(feedback, key)) for key in ("attitude", "position")]
    if feedback.attitude == feedback.position:
        groups = [(path, feedback.attitude)]
    for where, name in groups:
        if name != "truth" and name not in known:
            yield where, unknown("estimator", name, [*known, "truth"])
        elif isinstance(other := known.get(name), OutsideSection):
            whose = f"{name!r} is {other.autopilot}'s own, heard too late to fly on here"
            yield where, f"{whose}: let {other.autopilot} fly by {other.option} --pilot"
    kinds = {section.kind for section in scenario.sensors.values()}
    if feedback.position not in known:
        return
    where = groups[-1][0]
    if "airspeed" not in kinds:
        yield where, "flying on an estimate takes an airspeed sensor: add [sensors.airspeed]"
    if known[feedback.position].attitude_only and "barometer" not in kinds:
        text = f"{feedback.position!r} estimates attitude alone, and height must come from a barometer"
        yield where, f"{text}: add [sensors.barometer], or take the position of another estimator"


def _divides(path: KeyPath, rate_hz: float, tick_hz: float) -> Iterator[tuple[KeyPath, str]]:
    if rate_hz > tick_hz:
        yield path, f"{rate_hz:g} Hz is faster than the tick rate of {tick_hz:g} Hz (truth.rate_hz)"
    elif rate_hz * LONGEST_RUN_S < 1:
        yield path, f"{rate_hz:g} Hz is less than once in the longest run"
    elif not _whole(tick_hz / rate_hz):
        ticks = int(tick_hz / rate_hz)
        slower, faster = tick_hz / (ticks + 1), tick_hz / ticks
        nearest = f"{slower:.10g} or {faster:.10g}"
        yield path, f"{rate_hz:g} Hz does not divide the tick rate of {tick_hz:g} Hz (truth.rate_hz): try {nearest}"


def _whole(value: float) -> bool:
    return abs(value - round(value)) <= TICK_TOLERANCE * max(1.0, value)
