"""A JSBSim aircraft: its trim, its controls, what is read of it. The only file that imports jsbsim; feet end here."""

from __future__ import annotations

import functools
import itertools
import math
import struct
import subprocess
import sys
from array import array
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from xml.etree import ElementTree

import jsbsim
import numpy as np

from nav.rotation import quat_from_euler, quat_rotate
from nav.samples import Array
from testbed.data import data_dir
from testbed.errors import UserError
from testbed.motion import aircraft as aircraft_files
from testbed.motion.aircraft import Launch
from testbed.motion.gusts import TURBULENCE
from testbed.motion.paths import Feedback
from testbed.motion.sections import Start

FOOT = 0.3048  # [m]
POUND = 0.45359237  # [kg]
PSF = 47.88025898  # one pound-force per square foot [Pa]
RANKINE = 5 / 9  # [K]

# One for all threads and for good: JSBSim lets go of a thread's logger as the thread ends, without Python's lock, which
# is the end of the process when nobody else holds it.
LOGGER = jsbsim.DefaultLogger(jsbsim.LogLevel.ERROR)
SETTLING_S = 90.0  # of straight and level flight before the run starts

# JSBSim's numbers for: second order Adams-Bashforth rates, Adams-Bashforth 3 position, and Buss's augmented second
# order attitude, which is exact for a constant rate and needs no normalisation.
INTEGRATORS = {"rate/rotational": 3, "rate/translational": 3, "position/rotational": 7, "position/translational": 4}

SURFACES = ("aileron", "elevator", "rudder")  # ap/travel/<surface>-rad says how far each goes [rad]

MOTOR_CURRENT = "propulsion/engine/current-amperes"

# What is read on every tick: property and its unit in SI.
STATE: Mapping[str, float] = {
    "position/lat-geod-rad": 1.0,
    "position/long-gc-rad": 1.0,
    "position/geod-alt-ft": FOOT,
    "velocities/v-north-fps": FOOT,
    "velocities/v-east-fps": FOOT,
    "velocities/v-down-fps": FOOT,
    "attitude/phi-rad": 1.0,
    "attitude/theta-rad": 1.0,
    "attitude/psi-rad": 1.0,
    "velocities/pi-rad_sec": 1.0,
    "velocities/qi-rad_sec": 1.0,
    "velocities/ri-rad_sec": 1.0,
    "atmosphere/total-wind-north-fps": FOOT,
    "atmosphere/total-wind-east-fps": FOOT,
    "atmosphere/total-wind-down-fps": FOOT,
    "atmosphere/P-psf": PSF,
    "atmosphere/T-R": RANKINE,
    "propulsion/engine/engine-rpm": 1.0,
    "propulsion/total-fuel-lbs": POUND,
    **{f"fcs/{surface}-pos-rad": 1.0 for surface in SURFACES},  # over the aircraft's travel in `Aircraft.units`
    "fcs/throttle-pos-norm": 1.0,
    MOTOR_CURRENT: 1.0,
}
WIDTH = len(STATE)
# What is linearised: initial condition and rate of change, in JSBSim's units.
LINEAR_STATE: Mapping[str, str] = {
    "u-fps": "accelerations/udot-ft_sec2",
    "v-fps": "accelerations/vdot-ft_sec2",
    "w-fps": "accelerations/wdot-ft_sec2",
    "p-rad_sec": "accelerations/pdot-rad_sec2",
    "q-rad_sec": "accelerations/qdot-rad_sec2",
    "r-rad_sec": "accelerations/rdot-rad_sec2",
    "phi-rad": "velocities/phidot-rad_sec",
    "theta-rad": "velocities/thetadot-rad_sec",
}
VALUE = jsbsim.FGPropertyNode.get_double_value
ENGINE_SETTLING_S = 3.0
IDLING_S = 5.0  # before a run that starts on the ground
TRIMMED_THROTTLE = 0.5  # to which the loops add
HELD_MPS = 0.5  # airspeed and climb of straight and level flight are found to this, or it is none


PROBE = """
import sys, jsbsim
jsbsim.set_logger(jsbsim.DefaultLogger(jsbsim.LogLevel.ERROR))
fdm = jsbsim.FGFDMExec(sys.argv[1])
fdm.set_debug_level(0)
fdm.set_aircraft_path(sys.argv[2])
fdm.set_engine_path("engine")
fdm.set_systems_path("systems")
try:
    sys.exit(not fdm.load_model(sys.argv[3]))
except jsbsim.BaseError as error:
    sys.exit(str(error))
"""
SAID = 40  # last words of JSBSim that are passed on


class Aircraft:
    """A JSBSim model with its property nodes held; SI at every method.

    ``name`` is a shipped aircraft's, or the path of a folder. Raises UserError when it can't be loaded.
    """

    def __init__(self, name: str, rate_hz: float) -> None:
        jsbsim.set_logger(LOGGER)  # per thread; no banner
        self.name, self.envelope = name, aircraft_files.load(name)
        self._folder = aircraft_files.folder(name)
        self.fdm = jsbsim.FGFDMExec(str(data_dir("aircraft")))
        self.fdm.set_debug_level(0)
        self.fdm.set_aircraft_path(str(self._folder.parent))
        self.fdm.set_engine_path("engine")  # the shipped ones, after those in the aircraft's own folder
        self.fdm.set_systems_path("systems")
        self.fdm.set_dt(1.0 / rate_hz)  # before loading: filters take their coefficients from it
        self._load()
        self.fdm.disable_output()
        for integrator, number in INTEGRATORS.items():
            self.fdm[f"simulation/integrator/{integrator}"] = number
        self.rate_hz = rate_hz
        if self.fdm.get_property_manager().get_node(MOTOR_CURRENT) is None:
            self.fdm[MOTOR_CURRENT] = 0.0  # an engine that burns fuel has none
        self._nodes = [self._node(name) for name in STATE]
        tanks = (f"propulsion/tank[{number}]/contents-lbs" for number in itertools.count())
        self._tanks = list(itertools.takewhile(self.fdm.get_property_manager().get_node, tanks))
        self._command = [
            self._node(f"ap/{name}").set_double_value
            for name in ("bank-cmd-rad", "altitude-cmd-m", "climb-cmd-mps", "airspeed-cmd-mps")
        ]
        self.travel = {surface: self._node(f"ap/travel/{surface}-rad").get_double_value() for surface in SURFACES}
        travels = {f"fcs/{surface}-pos-rad": 1 / travel for surface, travel in self.travel.items()}
        self.units = np.array(list({**STATE, **travels}.values()))  # of a row, in SI and shares of travel

    def _load(self) -> None:
        """Let JSBSim read the model; one that is not shipped first in another process, as some mistakes abort it."""
        shipped = data_dir("aircraft")
        if self._folder.parent != shipped:
            _require_silent(self._model)
            _probe(shipped, self._folder)
        if not self.fdm.load_model(self._folder.name):
            raise UserError(f"{self._model}: JSBSim can't read it")

    @property
    def _model(self) -> Path:
        return self._folder / f"{self._folder.name}.xml"

    def _node(self, name: str) -> jsbsim.FGPropertyNode:
        node = self.fdm.get_property_manager().get_node(name)
        if node is None:
            raise UserError(f'{self._model}: has no property {name}: does it lack <system file="autopilot"/>?')
        return node

    @contextmanager
    def _flying(self) -> Iterator[None]:
        """What JSBSim finds wrong with a model no sooner than as it flies is the user's to mend."""
        try:
            yield
        except jsbsim.BaseError as error:
            raise self._not_flown(error) from None

    def _not_flown(self, error: jsbsim.BaseError) -> UserError:
        return UserError(f"{self._model}: JSBSim can't fly it: {' '.join(str(error).split())}")

    def _require_state(self) -> None:
        if not all(map(math.isfinite, self.read())):
            wrong = "does it lack lift, or are wing area, mass or inertia zero or below?"
            raise UserError(f"{self._model}: can't be flown: its state is not finite at the start: {wrong}")

    def _require_level(self, start: Start) -> None:
        fdm = self.fdm
        airspeed, climb = FOOT * fdm["velocities/vt-fps"], -FOOT * fdm["velocities/v-down-fps"]
        off = max(abs(airspeed - start.airspeed_mps), abs(climb))
        if not math.isfinite(off):
            return self._require_state()
        if off > HELD_MPS:
            asked = f"{start.airspeed_mps:g} m/s true airspeed at {start.alt_m:g} m"
            came = f"it flies {airspeed:.1f} m/s and climbs {climb:.1f} m/s at {fdm['fcs/throttle-pos-norm']:.0%}"
            wrong = "lacks it thrust, fuel or lift, is it too heavy, or does envelope.toml promise too much?"
            raise UserError(f"{self._model}: can't hold {asked}: {came} throttle: {wrong}")

    def read(self) -> list[float]:
        """One row of `STATE`, in JSBSim's units."""
        return list(map(VALUE, self._nodes))

    def run(self, steps: int, rows: array[float]) -> list[float]:
        """Fly ``steps`` ticks, appending a row of `STATE` for each; returns the last."""
        run, nodes = self.fdm.run, self._nodes
        flown: list[float] = []
        read = flown.extend  # no list for each row, and packed all at once: every step of Python counts here
        try:
            for _ in range(steps):
                run()
                read(map(VALUE, nodes))
        except jsbsim.BaseError as error:
            raise self._not_flown(error) from None
        rows.frombytes(struct.pack(f"{len(flown)}d", *flown))
        return flown[-WIDTH:]

    def command(self, bank: float, altitude: float, climb: float, airspeed: float) -> None:
        """Set what the inner loops follow."""
        set_bank, set_altitude, set_climb, set_airspeed = self._command
        set_bank(bank)
        set_altitude(altitude)
        set_climb(climb)
        set_airspeed(airspeed)

    def feed_back(self, state: Feedback | None) -> None:
        """Switch what the inner loops read: ``state``, or JSBSim's own states."""
        self.fdm["ap/feedback"] = 0.0 if state is None else 1.0
        if state is None:
            return
        for name, value in {
            "roll-rad": state.roll,
            "pitch-rad": state.pitch,
            "p-rad_sec": state.p,
            "q-rad_sec": state.q,
            "r-rad_sec": state.r,
            "altitude-m": state.h,
            "climb-mps": -state.v_down,
            "airspeed-mps": state.airspeed,
        }.items():
            self.fdm[f"feedback/{name}"] = value

    def move(self, aileron: float, elevator: float, rudder: float, throttle: float) -> None:
        """Leave the inner loops out, and the actuators to these shares of their travel."""
        self.fdm["ap/engaged"], self.fdm["ap/hold"] = 0.0, -1.0
        for name, value in zip((*SURFACES, "throttle"), (aileron, elevator, rudder, throttle), strict=True):
            self.fdm[f"fcs/{name}-cmd-norm"] = value

    def wind(self, north: float, east: float, down: float) -> None:
        """Set the wind beside the gusts, the velocity of the air [m/s]."""
        self.fdm["atmosphere/wind-north-fps"] = north / FOOT
        self.fdm["atmosphere/wind-east-fps"] = east / FOOT
        self.fdm["atmosphere/wind-down-fps"] = down / FOOT

    def turbulence(self, level: str, seed: int) -> None:
        """Dryden turbulence of MIL-F-8785C, its random numbers a child of ``seed``."""
        if level == "none":
            return
        child = np.random.SeedSequence([seed, *b"turbulence"])
        self.fdm["simulation/randomseed"] = int(child.generate_state(1)[0] >> 1)  # JSBSim's is a signed 32 bit number
        at_20ft, severity = TURBULENCE[level]
        self.fdm["atmosphere/turb-type"] = 3
        self.fdm["atmosphere/turbulence/milspec/windspeed_at_20ft_AGL-fps"] = at_20ft
        self.fdm["atmosphere/turbulence/milspec/severity"] = severity

    def start(self, start: Start, wind: tuple[float, float] = (0.0, 0.0)) -> None:
        """Put the aircraft in trim at its start, in a wind north, east [m/s].

        Trim is found by flying: straight and level on the inner loops until everything is steady, engine speed and
        integrators too, which a static trim leaves out. Then attitude, airspeed and angle of attack found are put at
        the start position and heading. Raises UserError of an aircraft that can't be flown, or not at this airspeed and
        height.
        """
        with self._flying():
            self._start(start, wind)
        self._require_state()

    def _start(self, start: Start, wind: tuple[float, float]) -> None:
        fdm = self.fdm
        fuel = {name: fdm[name] for name in self._tanks}
        # JSBSim's engine start finds no steady state at high advance ratios, so the engine is started slowly.
        slow = _v_n(1.15 * self.envelope.min_airspeed(start.alt_m), start.heading_deg)
        place = start.lat_deg, start.lon_deg, start.alt_m
        self._place(place, (0.0, 0.0, math.radians(start.heading_deg)), slow, (0.0, 0.0))
        fdm["propulsion/set-running"] = -1
        fdm["fcs/throttle-cmd-norm"] = TRIMMED_THROTTLE
        fdm["ap/engaged"], fdm["ap/hold"] = 1.0, 0.0
        self.command(0.0, start.alt_m, 0.0, start.airspeed_mps)
        for _ in range(round(SETTLING_S * self.rate_hz)):
            fdm.run()
        self._require_level(start)
        euler = (fdm["attitude/phi-rad"], fdm["attitude/theta-rad"], math.radians(start.heading_deg))
        air_b = np.array([fdm[f"velocities/{axis}-aero-fps"] for axis in "uvw"]) * FOOT
        air_n = quat_rotate(quat_from_euler(*euler), air_b)
        for name, contents in fuel.items():
            fdm[name] = contents
        self._place(place, euler, (air_n[0] + wind[0], air_n[1] + wind[1], air_n[2]), wind)

    def stand(self, start: Start, launch: Launch, wind: tuple[float, float]) -> None:
        """Hold the aircraft still on its launcher, engine at idle, in a wind north, east [m/s].

        The inner loops wait, and believe in the launch speed, so that they begin with it when it is let go. Raises
        UserError of an aircraft that can't be flown.
        """
        with self._flying():
            self._stand(start, launch, wind)
        self._require_state()

    def _stand(self, start: Start, launch: Launch, wind: tuple[float, float]) -> None:
        fdm, place = self.fdm, (start.lat_deg, start.lon_deg, start.alt_m + launch.height_m)
        euler = (0.0, math.radians(launch.pitch_deg), math.radians(start.heading_deg))
        fdm["forces/hold-down"] = 1.0
        self._place(place, euler, (0.0, 0.0, 0.0), wind)
        fuel = {name: fdm[name] for name in self._tanks}
        fdm["propulsion/set-running"] = -1
        self.move(0.0, 0.0, 0.0, 0.0)
        self.command(0.0, place[2], 0.0, launch.speed_mps)
        at = math.radians(start.lat_deg), math.radians(start.lon_deg), place[2]
        self.feed_back(Feedback(*at, 0.0, 0.0, 0.0, *euler, 0.0, 0.0, 0.0, launch.speed_mps))
        for _ in range(round(IDLING_S * self.rate_hz)):
            fdm.run()
        for name, contents in fuel.items():
            fdm[name] = contents
        self._place(place, euler, (0.0, 0.0, 0.0), wind)

    def let_go(self, state: Feedback, engage: bool) -> None:
        """Let the aircraft fly from a state on, with the inner loops engaged or not."""
        fdm = self.fdm
        fdm["forces/hold-down"] = 0.0
        place = math.degrees(state.lat), math.degrees(state.lon), state.h
        wind = FOOT * fdm["atmosphere/wind-north-fps"], FOOT * fdm["atmosphere/wind-east-fps"]
        self._place(place, (state.roll, state.pitch, state.heading), (state.v_north, state.v_east, state.v_down), wind)
        if engage:
            fdm["fcs/throttle-cmd-norm"] = TRIMMED_THROTTLE
            fdm["ap/engaged"], fdm["ap/hold"] = 1.0, 0.0

    def linearise(self) -> tuple[Array, Array]:
        """State matrices of the bare airframe about the present trim in still air, SI, body axes.

        Longitudinal over (u, w, q, pitch) and lateral over (v, p, r, roll); the weak coupling between them by engine
        torque is left out.
        """
        fdm = self.fdm
        for surface, travel in self.travel.items():
            fdm[f"fcs/{surface}-cmd-norm"] = fdm[f"fcs/{surface}-pos-rad"] / travel
        fdm["fcs/throttle-cmd-norm"] = fdm["fcs/throttle-pos-norm"]
        fdm["ap/engaged"], fdm["ap/hold"] = 0.0, -1.0
        for integrator in INTEGRATORS:
            fdm[f"simulation/integrator/{integrator}"] = 0
        trim = np.array([fdm[f"ic/{name}"] for name in LINEAR_STATE])
        steps = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.02, 0.02, 0.02])
        columns = []
        for step in np.diag(steps):
            ahead, behind = self._rates(trim + step), self._rates(trim - step)
            columns.append((ahead - behind) / (2 * step.max()))
        matrix = np.array(columns).T
        longitudinal, lateral = [0, 2, 4, 7], [1, 3, 5, 6]
        scale = np.array([FOOT, FOOT, FOOT, 1.0, 1.0, 1.0, 1.0, 1.0])
        matrix *= scale[:, None] / scale
        return matrix[np.ix_(longitudinal, longitudinal)], matrix[np.ix_(lateral, lateral)]

    def _rates(self, state: Array) -> Array:
        """Rates of change of `LINEAR_STATE` at ``state``, in JSBSim's units, with the engine at its steady speed."""
        for name, value in zip(LINEAR_STATE, state, strict=True):
            self.fdm[f"ic/{name}"] = value
        self.fdm.run_ic()
        for _ in range(round(ENGINE_SETTLING_S * self.rate_hz)):
            self.fdm.run()
        return np.array([self.fdm[name] for name in LINEAR_STATE.values()])

    def _place(
        self,
        place: tuple[float, float, float],
        euler: tuple[float, float, float],
        v_n: tuple[float, float, float],
        wind: tuple[float, float],
    ) -> None:
        """Initialise JSBSim's state at latitude, longitude [deg] and height; controls, filters and engine stay."""
        fdm, h = self.fdm, place[2] / FOOT
        fdm["ic/lat-geod-deg"], fdm["ic/long-gc-deg"] = place[:2]
        fdm["ic/h-sl-ft"] = h  # along the radius; the normal differs by millimetres
        fdm["ic/h-sl-ft"] += h - fdm["ic/geod-alt-ft"]
        fdm["ic/phi-rad"], fdm["ic/theta-rad"], fdm["ic/psi-true-rad"] = euler
        for axis, component in zip(("vn", "ve", "vd"), v_n, strict=True):
            fdm[f"ic/{axis}-fps"] = component / FOOT
        # JSBSim's initial condition takes the direction that the wind blows to.
        fdm["ic/vw-mag-fps"] = math.hypot(*wind) / FOOT
        fdm["ic/vw-dir-deg"] = math.degrees(math.atan2(wind[1], wind[0]))
        fdm.run_ic()


def _require_silent(model: Path) -> None:
    """Raise UserError of a model by which JSBSim would open files or ports, which it does as soon as it reads it."""
    try:
        found = {part.tag.rpartition("}")[2] for part in ElementTree.parse(model).getroot()}
    except (OSError, ValueError, ElementTree.ParseError):
        return  # what is wrong with it JSBSim says
    if talking := sorted(found & {"output", "input"}):
        told = f"has <{'> and <'.join(talking)}>, by which JSBSim writes over files or opens ports: take that out"
        raise UserError(f"{model}: {told}: the testbed records by itself")


@functools.cache
def _probe(shipped: Path, folder: Path) -> None:
    """Raise UserError, with what JSBSim says, where it can't load the model in a folder."""
    words = [sys.executable, "-c", PROBE, str(shipped), str(folder.parent), folder.name]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        said = " ".join((done.stdout.split() or done.stderr.split())[-SAID:]) or "it says nothing"
        raise UserError(f"{folder / folder.name}.xml: JSBSim can't read it: {said}")


def _v_n(speed: float, heading_deg: float) -> tuple[float, float, float]:
    heading = math.radians(heading_deg)
    return speed * math.cos(heading), speed * math.sin(heading), 0.0
