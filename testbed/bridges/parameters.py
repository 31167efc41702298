"""Parameters with which PX4 or ArduPlane fly the aircraft of a scenario, each with what it is for.

Names and units: parameter definitions of PX4-Autopilot 1.16 (performance_model_params, control_allocator, pwm_out_sim,
navigator, commander, ekf2) and of ArduPilot 4.6 (ArduPlane/Parameters.cpp, APM_Control, SRV_Channel, AP_GPS_Params,
AP_Airspeed_Params, AP_TECS), whose earlier names are told beside. Airspeeds of both are equivalent (calibrated) ones.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from nav.earth import SEA_LEVEL_DENSITY, isa_density
from testbed.errors import UserError
from testbed.motion import aircraft
from testbed.motion.guidance import beginning
from testbed.motion.legs import TURN_BANK, FigureEight, Loiter, Racetrack
from testbed.motion.paths import turn_radius
from testbed.motion.sections import FlightTruth
from testbed.scenario import Scenario
from testbed.sensors.airspeed import AirspeedConfig
from testbed.sensors.gnss import GnssConfig
from testbed.sensors.imu import ImuConfig

REAL32, INT32 = 9, 6  # MAV_PARAM_TYPE
AXES = "XYZ"
# Of ArduPlane's controllers of rate and angle, about those of its own model of a small aeroplane: with its defaults the
# loiter aircraft swings by 30 m about its height in circles, and its throttle from end to end; with these by 9 m.
GAINS = {
    "roll": {"RLL_RATE_P": 0.3, "RLL_RATE_I": 0.25, "RLL_RATE_D": 0.017, "RLL_RATE_FF": 0.24, "RLL2SRV_TCONST": 0.3},
    "pitch": {
        "PTCH_RATE_P": 0.15,
        "PTCH_RATE_I": 0.11,
        "PTCH_RATE_D": 0.007,
        "PTCH_RATE_FF": 0.6,
        "PTCH2SRV_TCONST": 0.3,
    },
}
AT_ONCE = "the launcher waits for the throttle, which must not wait for the launch"


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter; that a value is whole says its type too."""

    name: str
    value: float
    meaning: str


@dataclass(frozen=True, slots=True)
class Facts:
    """What parameters are made of: airspeeds are equivalent ones [m/s], ``radius`` [m] that of the last circle, or of
    a turn where the plan has none.

    ``latency_s`` and ``antenna`` [m] are the first receiver's; ``imu`` [m] is where the first IMU is.
    """

    title: str
    stall: float
    slowest: float
    cruise: float
    fastest: float
    climb: float
    least_sink: float
    most_sink: float
    bank_deg: float
    radius: float
    right: bool
    receivers: int
    latency_s: float
    antenna: tuple[float, float, float]
    imu: tuple[float, float, float]
    airspeed: bool
    on_ground: bool


def content(scenario: Scenario, autopilot: str) -> bytes:
    """The file for "px4" or "ardupilot". Raises UserError where the scenario has no aircraft to be flown."""
    facts = _facts(scenario)
    return _px4(facts) if autopilot == "px4" else _ardupilot(facts)


def _facts(scenario: Scenario) -> Facts:
    truth = scenario.truth
    if not isinstance(truth, FlightTruth):
        raise UserError('there is no aircraft that an autopilot could fly: truth.source must be "flight"')
    envelope, start = aircraft.load(truth.aircraft), truth.start
    begun = beginning(start, envelope)
    speed, h = begun.airspeed_mps, begun.alt_m
    sections = scenario.sensors.values()
    receivers = [one for one in sections if isinstance(one, GnssConfig)]
    imus = [one for one in sections if isinstance(one, ImuConfig)]
    circles = [leg for leg in scenario.plan if isinstance(leg, Loiter | Racetrack | FigureEight)]
    slowest = envelope.airspeed.margin * envelope.airspeed.stall_mps
    return Facts(
        title=" ".join(f"{scenario.title}: {envelope.title}".split()),
        stall=envelope.airspeed.stall_mps,
        slowest=slowest,
        cruise=min(
            max(speed * math.sqrt(float(isa_density(h)) / SEA_LEVEL_DENSITY), slowest), envelope.airspeed.max_mps
        ),
        fastest=envelope.airspeed.max_mps,
        climb=envelope.climb_limit(speed, h),
        least_sink=envelope.descent_limit(speed, h),
        most_sink=envelope.descent.max_mps,
        bank_deg=envelope.bank.max_deg,
        radius=circles[-1].radius_m if circles else turn_radius(speed, TURN_BANK),
        right=not circles or circles[-1].direction == "right",
        receivers=len(receivers),
        latency_s=receivers[0].latency_s if receivers else 0.0,
        antenna=receivers[0].lever_arm_m if receivers else (0.0, 0.0, 0.0),
        imu=imus[0].lever_arm_m if imus else (0.0, 0.0, 0.0),
        airspeed=any(isinstance(one, AirspeedConfig) for one in sections),
        on_ground=start.on_ground,
    )


def _within(value: float, least: float, most: float) -> float:
    """A value to two digits, within what a parameter may be."""
    return round(min(max(value, least), most), 2)


def _px4(facts: Facts) -> bytes:
    """QGroundControl's .params: vehicle, component, name, value and type, separated by tabs."""
    lines = [
        f"# Parameters for PX4 1.16 to fly {facts.title}",
        "# QGroundControl: Vehicle Setup, Parameters, Tools, Load from file. Then boot PX4 anew.",
        "#",
        "# Vehicle-Id Component-Id Name Value Type",
    ]
    for one in _of_px4(facts):
        kind = INT32 if isinstance(one.value, int) else REAL32
        lines += [f"# {one.meaning}", f"1\t1\t{one.name}\t{one.value}\t{kind}"]
    return ("\n".join(lines) + "\n").encode()


def _of_px4(facts: Facts) -> Iterator[Parameter]:
    yield Parameter("CA_AIRFRAME", 1, "the mixer of a fixed wing")
    yield Parameter("CA_ROTOR_COUNT", 1, "one engine")
    yield Parameter("CA_SV_CS_COUNT", 3, "control surfaces")
    surfaces = (("R", 15, "a single aileron channel"), ("P", 3, "elevator"), ("Y", 4, "rudder"))
    for number, (axis, kind, what) in enumerate(surfaces):
        yield Parameter(f"CA_SV_CS{number}_TYPE", kind, f"surface {number + 1}: {what}")
        yield Parameter(f"CA_SV_CS{number}_TRQ_{axis}", 1.0, f"all of its travel: {what}")
    outputs = ((201, "aileron"), (202, "elevator"), (101, "throttle"), (203, "rudder"))
    for number, (function, what) in enumerate(outputs, 1):
        yield Parameter(
            f"PWM_MAIN_FUNC{number}", function, f"output {number}: {what} (HIL_ACT_FUNC{number} on a board)"
        )
    yield Parameter("FW_AIRSPD_STALL", _within(facts.stall, 0.5, 100), "stall [m/s]")
    yield Parameter("FW_AIRSPD_MIN", _within(facts.slowest, 0.5, 100), "slowest, with the margin to the stall [m/s]")
    yield Parameter("FW_AIRSPD_TRIM", _within(facts.cruise, 0.5, 100), "the airspeed at which the plan begins [m/s]")
    yield Parameter("FW_AIRSPD_MAX", _within(facts.fastest, 0.5, 100), "fastest [m/s]")
    yield Parameter("FW_T_CLMB_MAX", _within(facts.climb, 1, 15), "steepest climb at that airspeed [m/s]")
    yield Parameter("FW_T_SINK_MIN", _within(facts.least_sink, 1, 5), "sink at idle at that airspeed [m/s]")
    yield Parameter("FW_T_SINK_MAX", _within(facts.most_sink, 1, 15), "steepest descent [m/s]")
    yield Parameter("FW_R_LIM", _within(facts.bank_deg, 35, 65), "steepest bank [deg]")
    yield Parameter("FW_THR_MAX", 1.0, "what that climb takes; airframes of PX4's own have less")
    yield Parameter("FW_THR_MIN", 0.0, "what that sink takes")
    yield Parameter("NAV_LOITER_RAD", _within(facts.radius, 25, 1000), "radius of the last circle [m]")
    if facts.receivers:
        yield Parameter("EKF2_GPS_DELAY", _within(1e3 * facts.latency_s, 0, 300), "how late fixes come [ms]")
    for what, place, sensor in (("GPS", facts.antenna, "antenna"), ("IMU", facts.imu, "first IMU")):
        for axis, arm in zip(AXES, place, strict=True):
            yield Parameter(f"EKF2_{what}_POS_{axis}", round(float(arm), 3), f"place of the {sensor} [m]")
    yield Parameter("MIS_TKO_LAND_REQ", 0, "a mission needs neither take-off nor landing")
    if facts.on_ground:
        yield Parameter("FW_LAUN_DETCN_ON", 0, AT_ONCE)
    for name in ("COM_POS_LOW_EPH", "COM_POS_FS_EPH"):
        yield Parameter(
            name, -1.0, "the plan is flown on without GNSS, however doubtful the position, not home, nor down"
        )
    yield Parameter("COM_RC_IN_MODE", 4, "there are no sticks")
    yield Parameter("NAV_DLL_ACT", 0, "a ground station may go away")
    yield Parameter("CBRK_SUPPLY_CHK", 894281, "there is no power supply to be checked before arming")


def _ardupilot(facts: Facts) -> bytes:
    """ArduPilot's .parm: name and value, separated by a comma."""
    lines = [
        f"# Parameters for ArduPlane 4.6 to fly {facts.title}",
        "# sim_vehicle.py --add-param-file=FILE, or MAVProxy: param load FILE. Then boot ArduPilot anew.",
    ]
    for one in _of_ardupilot(facts):
        lines += [f"# {one.meaning}", f"{one.name},{one.value}"]
    return ("\n".join(lines) + "\n").encode()


def _of_ardupilot(facts: Facts) -> Iterator[Parameter]:
    outputs = ((4, "aileron", 1500), (19, "elevator", 1500), (70, "throttle", 1000), (21, "rudder", 1500))
    for number, (function, what, trim) in enumerate(outputs, 1):
        yield Parameter(f"SERVO{number}_FUNCTION", function, f"output {number}: {what}")
        for end, value in (("MIN", 1000), ("TRIM", trim), ("MAX", 2000)):
            yield Parameter(f"SERVO{number}_{end}", value, f"{what} [us]")
    yield Parameter(
        "AIRSPEED_MIN",
        math.ceil(facts.slowest),
        "slowest, with the margin to the stall [m/s]; before 4.5: ARSPD_FBW_MIN, the same",
    )
    yield Parameter(
        "AIRSPEED_CRUISE",
        round(facts.cruise, 2),
        f"the airspeed at which the plan begins [m/s]; before 4.5: TRIM_ARSPD_CM,{round(100 * facts.cruise)}",
    )
    yield Parameter("AIRSPEED_MAX", math.floor(facts.fastest), "fastest [m/s]; before 4.5: ARSPD_FBW_MAX, the same")
    yield Parameter("TECS_CLMB_MAX", _within(facts.climb, 0.1, 20), "steepest climb at that airspeed [m/s]")
    yield Parameter("TECS_SINK_MIN", _within(facts.least_sink, 0.1, 10), "sink at idle at that airspeed [m/s]")
    yield Parameter("TECS_SINK_MAX", _within(facts.most_sink, 0.1, 20), "steepest descent [m/s]")
    yield Parameter(
        "ROLL_LIMIT_DEG",
        facts.bank_deg,
        f"steepest bank [deg]; before 4.5: LIM_ROLL_CD,{round(100 * facts.bank_deg)}",
    )
    for axis, gains in GAINS.items():
        for name, gain in gains.items():
            yield Parameter(name, gain, f"gain of {axis}, tried with the loiter aircraft")
    way = 1 if facts.right else -1
    yield Parameter("WP_LOITER_RAD", way * round(facts.radius), "radius of the last circle, left below 0 [m]")
    yield Parameter("ARSPD_TYPE", 100 if facts.airspeed else 0, "the airspeed sensor that it is told of, or none")
    yield Parameter("ARSPD_USE", int(facts.airspeed), "whether it flies by that")
    if facts.airspeed:
        yield Parameter("ARSPD_SKIP_CAL", 1, "it boots in the wind, or in flight: there is no zero to be found")
    for number in range(1, min(facts.receivers, 2) + 1):
        old = "GPS_TYPE" if number == 1 else "GPS_TYPE2"
        yield Parameter(f"GPS{number}_TYPE", 14, f"our fixes, as GPS_INPUT (--gps-input); before 4.6: {old}, the same")
    if facts.receivers:
        delay = round(min(max(1e3 * facts.latency_s, 1), 250))
        yield Parameter("GPS1_DELAY_MS", delay, f"how late fixes come [ms]; before 4.6: GPS_DELAY_MS,{delay}")
        for axis, arm in zip(AXES, facts.antenna, strict=True):
            where = round(float(arm), 3)
            yield Parameter(f"GPS1_POS_{axis}", where, f"place of the antenna [m]; before 4.6: GPS_POS1_{axis},{where}")
    if facts.on_ground:
        for name in ("TKOFF_THR_MINACC", "TKOFF_THR_MINSPD"):
            yield Parameter(name, 0, AT_ONCE)
    for axis, arm in zip(AXES, facts.imu, strict=True):
        yield Parameter(f"INS_POS1_{axis}", round(float(arm), 3), "place of the first IMU [m]")
