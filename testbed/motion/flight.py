"""JSBSim flies a plan. The only file that imports jsbsim; feet end here."""

from __future__ import annotations

import functools
import itertools
import math
import subprocess
import sys
from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path

import jsbsim
import numpy as np

from nav._jit import njit
from nav.earth import GAS_CONSTANT
from nav.rotation import quat_conjugate, quat_from_euler, quat_rotate
from nav.samples import Array
from testbed.data import data_dir
from testbed.errors import UserError
from testbed.motion import aircraft as aircraft_files
from testbed.motion.guidance import Guidance
from testbed.motion.gusts import TURBULENCE
from testbed.motion.legs import Leg
from testbed.motion.paths import Feedback
from testbed.motion.sections import FlightTruth, Start
from testbed.motion.table import TruthBlock, increments
from testbed.motion.weather import Weather

FOOT = 0.3048  # [m]
POUND = 0.45359237  # [kg]
PSF = 47.88025898  # one pound-force per square foot [Pa]
RANKINE = 5 / 9  # [K]

GUIDANCE_HZ = 10.0
# One for all threads and for good: JSBSim lets go of a thread's logger as the thread ends, without Python's lock, which
# is the end of the process when nobody else holds it.
LOGGER = jsbsim.DefaultLogger(jsbsim.LogLevel.ERROR)
SETTLING_S = 90.0  # of straight and level flight before the run starts

# JSBSim's numbers for: second order Adams-Bashforth rates, Adams-Bashforth 3 position, and Buss's augmented second
# order attitude, which is exact for a constant rate and needs no normalisation.
INTEGRATORS = {"rate/rotational": 3, "rate/translational": 3, "position/rotational": 7, "position/translational": 4}

SERVO_RATE = 10.0  # normalised travel per second at full rate
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
ENGINE_SETTLING_S = 3.0

MAX_ROLL, MAX_PITCH = math.radians(80.0), math.radians(60.0)  # beyond these control is lost
WIDTH = len(STATE)

PROBE = """
import sys, jsbsim
jsbsim.set_logger(jsbsim.DefaultLogger(jsbsim.LogLevel.ERROR))
fdm = jsbsim.FGFDMExec(sys.argv[1])
fdm.set_debug_level(0)
fdm.set_aircraft_path(sys.argv[2])
fdm.set_engine_path("engine")
fdm.set_systems_path("systems")
sys.exit(not fdm.load_model(sys.argv[3]))
"""
SAID = 40  # last words of JSBSim that are passed on


class Flight:
    """A JSBSim aircraft on a plan: a `MotionSource`. It starts trimmed, straight and level in the wind at its altitude.

    ``failure`` is empty unless the flight ended because control was lost; then it says how. A row's commands and leg
    are those in effect over the interval that ends at the row. Same arguments, same bits, however it is advanced.
    """

    def __init__(self, truth: FlightTruth, plan: Sequence[Leg], seed: int) -> None:
        self.rate_hz = truth.rate_hz
        self.failure = ""
        self._tick = 0
        self._ended = False
        self._frame = max(1, round(truth.rate_hz / GUIDANCE_HZ))
        self._aircraft = Aircraft(truth.aircraft, truth.rate_hz)
        self._weather = Weather(truth.wind, truth.start, seed, self._frame / truth.rate_hz)
        self._aircraft.start(truth.start, self._weather.start())
        wind_seed = truth.wind.turbulence_seed
        self._aircraft.turbulence(truth.wind.turbulence, seed if wind_seed is None else wind_seed)
        self._row = self._aircraft.read()
        self._last = self._row  # the last row handed out, for its increments
        self._feedback: Feedback | None = None
        self._moved = False
        alt, speed = truth.start.alt_m, truth.start.airspeed_mps
        envelope, period = self._aircraft.envelope, self._frame / truth.rate_hz
        self._guidance = Guidance(plan, envelope, self.true_feedback(), alt, speed, period)
        self._commands = (0.0, alt, speed, 0.0)  # bank, altitude, airspeed, leg

    def advance(self, ticks: int) -> TruthBlock:
        """The next ``ticks`` rows; fewer when the plan ends or control is lost, none after that."""
        first = self._tick
        raw = array("d")
        commands: list[tuple[int, tuple[float, float, float, float]]] = []
        rows = 0
        if self._tick == 0 and ticks > 0 and not self._ended:
            raw.fromlist(self._row)
            commands.append((1, self._commands))
            rows = self._tick = 1
        while rows < ticks and not self._ended:
            done = self._tick - 1  # ticks flown
            if done % self._frame == 0:
                self._guide()
                if self._ended:
                    break
            steps = min(ticks - rows, self._frame - done % self._frame)
            self._row = self._aircraft.run(steps, raw)
            commands.append((steps, self._commands))
            self._tick += steps
            rows += steps
        return self._table(first, rows, raw, commands)

    def feed_back(self, state: Feedback | None) -> None:
        """Close guidance and inner loops on ``state`` until the next call; None, as at first, closes them on truth."""
        self._feedback = state
        self._aircraft.feed_back(state)

    def move(self, aileron: float, elevator: float, rudder: float, throttle: float) -> None:
        """Let somebody else fly from now on: shares of the surfaces' travel (-1 to 1), and throttle (0 to 1).

        Signs are those of the recorded controls: aileron rolls right, elevator pitches down, rudder yaws left.
        """
        self._moved = True
        self._aircraft.move(aileron, elevator, rudder, throttle)

    def blow(self, from_deg: float, speed_mps: float) -> None:
        """Let the mean wind, where it is one, become this: `Weather.blow`."""
        self._weather.blow(from_deg, speed_mps)

    def give_up(self, why: str) -> None:
        """End the flight here, with ``why`` for a failure."""
        self.failure, self._ended = why, True

    def activity(self) -> str:
        """The leg being flown, or why the flight ended."""
        return self.failure or ("flown from outside" if self._moved else self._guidance.activity())

    def _guide(self) -> None:
        """One step of guidance, or the end of the flight."""
        true = self.true_feedback()
        self.failure = _loss_of_control(true)
        if self.failure:
            self._ended = True
            return
        if not self._moved:
            command = self._guidance.step(self._feedback or true)
            self._ended = self._guidance.done
            self._commands = (command.bank, command.altitude, command.airspeed, float(self._guidance.leg))
            self._aircraft.command(command.bank, command.altitude, command.climb, command.airspeed)
        if self._weather.changes:
            self._aircraft.wind(*self._weather.step(true.lat, true.lon, true.h))

    def true_feedback(self) -> Feedback:
        """The true state at the newest row."""
        lat, lon, h, *v, roll, pitch, heading, p, q, r, w_north, w_east, w_down = self._row[:15]
        north, east, down = (FOOT * component for component in v)
        airspeed = math.dist((north, east, down), (FOOT * w_north, FOOT * w_east, FOOT * w_down))
        return Feedback(lat, lon, FOOT * h, north, east, down, roll, pitch, heading, p, q, r, airspeed)

    def _table(
        self, first: int, rows: int, raw: array[float], commands: list[tuple[int, tuple[float, float, float, float]]]
    ) -> TruthBlock:
        """Rows as read from JSBSim, and the last row before them, to columns."""
        block = TruthBlock.empty(first, rows)
        if rows == 0:
            return block
        table = np.concatenate((np.array(self._last), np.frombuffer(raw))).reshape(rows + 1, WIDTH)
        table *= self._aircraft.units
        self._last = raw[-WIDTH:].tolist()
        t = (first - 1 + np.arange(rows + 1)) / self.rate_hz
        v_n, wind_n, controls = table[:, 3:6], table[:, 12:15], table[:, 19:23]
        q_nb, air = _attitude_and_air(table[:, 6:9], v_n, wind_n)
        dtheta, dv = increments(t, table[:, 0].copy(), table[:, 1].copy(), table[:, 2].copy(), v_n.copy(), q_nb)
        if first == 0:
            dtheta[1], dv[1] = 0.0, 0.0  # no interval ends at the first row of a run
        servos = np.minimum(np.abs(np.diff(controls, axis=0)) * self.rate_hz / SERVO_RATE, 1.0)
        block.t[:] = t[1:]
        block.lat[:], block.lon[:], block.h[:] = table[1:, 0], table[1:, 1], table[1:, 2]
        block.v_n[:], block.q_nb[:], block.omega_b[:] = v_n[1:], q_nb[1:], table[1:, 9:12]
        block.dtheta[:], block.dv[:] = dtheta[1:], dv[1:]
        block.wind_n[:] = wind_n[1:]
        block.airspeed[:], block.alpha[:], block.beta[:] = air[1:].T
        block.pressure[:], block.temperature[:] = table[1:, 15], table[1:, 16]
        block.density[:] = block.pressure / (GAS_CONSTANT * block.temperature)
        block.engine_rpm[:], block.fuel[:] = table[1:, 17], table[1:, 18]
        block.controls[:] = controls[1:]
        load = self._aircraft.envelope.current
        block.current[:] = load.payload_a + 4 * load.servo_idle_a
        for servo in range(4):
            block.current[:] += load.servo_running_a * servos[:, servo]
        block.current[:] += table[1:, 23]
        repeats = [steps for steps, _ in commands]
        held = np.repeat(np.array([values for _, values in commands]), repeats, axis=0)
        block.commands[:], block.leg[:] = held[:, :3], held[:, 3]
        return block


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
        self._read = [self._node(name).get_double_value for name in STATE]
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

    def read(self) -> list[float]:
        """One row of `STATE`, in JSBSim's units."""
        return [get() for get in self._read]

    def run(self, steps: int, rows: array[float]) -> list[float]:
        """Fly ``steps`` ticks, appending a row of `STATE` for each; returns the last."""
        run, read, append = self.fdm.run, self._read, rows.fromlist
        row: list[float] = []
        for _ in range(steps):
            run()
            row = [get() for get in read]
            append(row)
        return row

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
        the start position and heading.
        """
        fdm = self.fdm
        fuel = {name: fdm[name] for name in self._tanks}
        # JSBSim's engine start finds no steady state at high advance ratios, so the engine is started slowly.
        slow = _v_n(1.15 * self.envelope.min_airspeed(start.alt_m), start.heading_deg)
        self._place(start, (0.0, 0.0, math.radians(start.heading_deg)), slow, (0.0, 0.0))
        fdm["propulsion/set-running"] = -1
        fdm["fcs/throttle-cmd-norm"] = 0.5
        fdm["ap/engaged"], fdm["ap/hold"] = 1.0, 0.0
        self.command(0.0, start.alt_m, 0.0, start.airspeed_mps)
        for _ in range(round(SETTLING_S * self.rate_hz)):
            fdm.run()
        euler = (fdm["attitude/phi-rad"], fdm["attitude/theta-rad"], math.radians(start.heading_deg))
        air_b = np.array([fdm[f"velocities/{axis}-aero-fps"] for axis in "uvw"]) * FOOT
        air_n = quat_rotate(quat_from_euler(*euler), air_b)
        for name, contents in fuel.items():
            fdm[name] = contents
        self._place(start, euler, (air_n[0] + wind[0], air_n[1] + wind[1], air_n[2]), wind)

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
        start: Start,
        euler: tuple[float, float, float],
        v_n: tuple[float, float, float],
        wind: tuple[float, float],
    ) -> None:
        """Initialise JSBSim's state at the start; controls, filters and engine stay as they are."""
        fdm = self.fdm
        fdm["ic/lat-geod-deg"], fdm["ic/long-gc-deg"] = start.lat_deg, start.lon_deg
        fdm["ic/h-sl-ft"] = start.alt_m / FOOT  # along the radius; the normal differs by millimetres
        fdm["ic/h-sl-ft"] += start.alt_m / FOOT - fdm["ic/geod-alt-ft"]
        fdm["ic/phi-rad"], fdm["ic/theta-rad"], fdm["ic/psi-true-rad"] = euler
        for axis, component in zip(("vn", "ve", "vd"), v_n, strict=True):
            fdm[f"ic/{axis}-fps"] = component / FOOT
        # JSBSim's initial condition takes the direction that the wind blows to.
        fdm["ic/vw-mag-fps"] = math.hypot(*wind) / FOOT
        fdm["ic/vw-dir-deg"] = math.degrees(math.atan2(wind[1], wind[0]))
        fdm.run_ic()


@njit
def _attitude_and_air(euler: Array, v_n: Array, wind_n: Array) -> tuple[Array, Array]:
    """Quaternions (N, 4), and (N, 3) true airspeed [m/s], angles of attack and sideslip [rad]."""
    q_nb, air = np.empty((len(euler), 4)), np.empty((len(euler), 3))
    air_n = np.empty(3)
    for k in range(len(euler)):
        q = quat_from_euler(euler[k, 0], euler[k, 1], euler[k, 2])
        for i in range(4):
            q_nb[k, i] = q[i]
        for i in range(3):
            air_n[i] = v_n[k, i] - wind_n[k, i]
        air_b = quat_rotate(quat_conjugate(q), air_n)
        speed = math.sqrt(air_b[0] * air_b[0] + air_b[1] * air_b[1] + air_b[2] * air_b[2])
        air[k, 0], air[k, 1], air[k, 2] = speed, math.atan2(air_b[2], air_b[0]), math.asin(air_b[1] / speed)
    return q_nb, air


@functools.cache
def _probe(shipped: Path, folder: Path) -> None:
    """Raise UserError, with what JSBSim says, where it can't load the model in a folder."""
    words = [sys.executable, "-c", PROBE, str(shipped), str(folder.parent), folder.name]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        said = " ".join((done.stdout + done.stderr).split()[-SAID:]) or "it says nothing"
        raise UserError(f"{folder / folder.name}.xml: JSBSim can't read it: {said}")


def _v_n(speed: float, heading_deg: float) -> tuple[float, float, float]:
    heading = math.radians(heading_deg)
    return speed * math.cos(heading), speed * math.sin(heading), 0.0


def _loss_of_control(state: Feedback) -> str:
    """What went wrong, empty when nothing did."""
    if state.h > 1.0 and abs(state.roll) < MAX_ROLL and abs(state.pitch) < MAX_PITCH:  # false for NaN
        return ""
    if not all(map(math.isfinite, state)):
        return "control lost: the simulation diverged"
    if state.h <= 1.0:
        return "the aircraft hit the ground"
    return f"control lost: bank {math.degrees(state.roll):.0f} deg, pitch {math.degrees(state.pitch):.0f} deg"
