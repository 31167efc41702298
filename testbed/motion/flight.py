"""JSBSim flies a plan."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence

import numpy as np

from nav._jit import njit
from nav.earth import GAS_CONSTANT
from nav.rotation import quat_from_euler_components, quat_rotate_components
from nav.samples import Array
from nav.terrain import ground as height_of_ground
from testbed.motion import terrain
from testbed.motion.guidance import Guidance, beginning, climb_out
from testbed.motion.launch import Launcher
from testbed.motion.legs import Leg
from testbed.motion.model import FOOT, WIDTH, Aircraft
from testbed.motion.paths import Feedback
from testbed.motion.sections import FlightTruth
from testbed.motion.table import CLIMBING_OUT, ON_GROUND, OUTSIDE, TruthBlock, increments
from testbed.motion.weather import Weather

GUIDANCE_HZ = 10.0
SERVO_RATE = 10.0  # normalised travel per second at full rate
MAX_ROLL, MAX_PITCH = math.radians(80.0), math.radians(60.0)  # beyond these control is lost
HIT_M = 1.0  # over ground: an aircraft this low has hit it


class Flight:
    """A JSBSim aircraft on a plan: a `MotionSource`. It starts trimmed, straight and level in the wind at its altitude.

    Or at rest on its launcher: then it is launched, and climbs out on its heading before the plan begins.
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
        self._legs, self._ground, self._hit = list(plan), terrain.of(truth.terrain), HIT_M
        self._weather = Weather(truth.wind, truth.start, self._ground, seed, self._frame / truth.rate_hz)
        start, envelope = truth.start, self._aircraft.envelope
        self._launcher: Launcher | None = None
        self._summit = float(self._ground.heights.max())
        if start.on_ground:
            assert envelope.launch is not None  # the scenario was checked
            self._launcher = Launcher(envelope.launch, truth, self._frame)
            self._aircraft.stand(start, envelope.launch, self._weather.start(start.alt_m + envelope.launch.height_m))
            self._legs.insert(0, climb_out(start, envelope))
            # It rests on the ground, whose height its start tells to a metre.
            self._hit += start.alt_m - self._height_of_ground(math.radians(start.lat_deg), math.radians(start.lon_deg))
        else:
            self._aircraft.start(start, self._weather.start(start.alt_m))
        wind_seed = truth.wind.turbulence_seed
        self._aircraft.turbulence(truth.wind.turbulence, seed if wind_seed is None else wind_seed)
        self._row = self._aircraft.read()
        self._last = self._row  # the last row handed out, for its increments
        self._feedback: Feedback | None = None
        self._moved = False
        self._before = len(self._legs) - len(plan)  # legs before the plan's first
        self._speed = beginning(start, envelope).airspeed_mps
        self._guidance = self._guided(start.alt_m)
        self._commands = (0.0, start.alt_m, start.airspeed_mps, ON_GROUND if start.on_ground else 0.0)

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
            self._row = self._fly(steps, raw)
            commands.append((steps, self._commands))
            self._tick += steps
            rows += steps
        return self._table(first, rows, raw, commands)

    @property
    def on_ground(self) -> bool:
        """Whether it is still on its launcher."""
        return self._launcher is not None

    def feed_back(self, state: Feedback | None) -> None:
        """Close guidance and inner loops on ``state`` until the next call; None, as at first, closes them on truth."""
        self._feedback = state
        if self._launcher is None:
            self._aircraft.feed_back(state)

    def wait(self) -> None:
        """Let somebody else fly, who takes off from the ground when he likes: by the throttle of `move`."""
        if self._launcher is not None:
            self._launcher.wait()

    def move(self, aileron: float, elevator: float, rudder: float, throttle: float) -> None:
        """Let somebody else fly from now on: shares of the surfaces' travel (-1 to 1), and throttle (0 to 1).

        Signs are those of the recorded controls: aileron rolls right, elevator pitches down, rudder yaws left.
        """
        self._moved = True
        if self._launcher is not None:
            self._launcher.hear(throttle, self._tick - 1)
        else:
            self._commands = (*self._commands[:3], OUTSIDE)
        self._aircraft.move(aileron, elevator, rudder, throttle)

    def blow(self, from_deg: float, speed_mps: float) -> None:
        """Let the mean wind, where it is one, become this: `Weather.blow`."""
        self._weather.blow(from_deg, speed_mps)

    def give_up(self, why: str) -> None:
        """End the flight here, with ``why`` for a failure."""
        self.failure, self._ended = why, True

    def activity(self) -> str:
        """The leg being flown, or why the flight ended."""
        if self._launcher is not None and not self.failure:
            return self._launcher.activity(self._tick - 1)
        return self.failure or ("flown from outside" if self._moved else self._guidance.activity())

    def _fly(self, steps: int, raw: array[float]) -> list[float]:
        """Append ``steps`` rows, free or on the launcher; returns the last."""
        if self._launcher is None:
            return self._aircraft.run(steps, raw)
        rows = array("d")
        self._aircraft.run(steps, rows)
        self._launcher.push(rows, WIDTH, self._tick - 1 + steps, FOOT)
        raw.extend(rows)
        return rows[-WIDTH:].tolist()

    def _guided(self, alt: float) -> Guidance:
        """Guidance that begins here, at an altitude [m]."""
        period = self._frame / self.rate_hz
        return Guidance(self._legs, self._aircraft.envelope, self.true_feedback(), alt, self._speed, period)

    def _height_of_ground(self, lat: float, lon: float) -> float:
        """The map's [m]."""
        return height_of_ground(lat, lon, self._ground.heights, self._ground.grid)[0]

    def _guide(self) -> None:
        """One step of guidance, or the end of the flight."""
        true = self.true_feedback()
        high = true.h > self._hit + self._summit  # whatever is below
        self.failure = _loss_of_control(
            true, self._hit + (self._summit if high else self._height_of_ground(true.lat, true.lon))
        )
        if self.failure:
            self._ended = True
            return
        if self._launcher is not None:
            self._launch(self._launcher, true)
        if self._launcher is None and not self._moved:
            command = self._guidance.step(self._feedback or true)
            self._ended = self._guidance.done
            self._commands = (command.bank, command.altitude, command.airspeed, self._leg())
            self._aircraft.command(command.bank, command.altitude, command.climb, command.airspeed)
        if self._weather.changes:
            self._aircraft.wind(*self._weather.step(true.lat, true.lon, true.h))

    def _launch(self, launcher: Launcher, true: Feedback) -> None:
        """Full power when it is time, and at the end of the launcher let go."""
        done = self._tick - 1
        if not self._moved and launcher.full_power is not None and done >= launcher.full_power:
            self._aircraft.move(0.0, 0.0, 0.0, 1.0)
        if done < launcher.release:
            return
        self._launcher = None
        self._aircraft.let_go(true, not self._moved)
        self._aircraft.feed_back(self._feedback)
        self._guidance = self._guided(true.h)
        self._commands = (0.0, true.h, 0.0, OUTSIDE)

    def _leg(self) -> float:
        """The leg of the plan, from 0, or the way to it."""
        leg = self._guidance.leg - self._before
        return CLIMBING_OUT if leg < 0 else float(leg)

    def true_feedback(self) -> Feedback:
        """The true state at the newest row."""
        lat, lon, h, north, east, down, roll, pitch, heading, p, q, r, w_north, w_east, w_down = self._row[:15]
        north, east, down = FOOT * north, FOOT * east, FOOT * down
        airspeed = math.dist((north, east, down), (FOOT * w_north, FOOT * w_east, FOOT * w_down))
        return Feedback(lat, lon, FOOT * h, north, east, down, roll, pitch, heading, p, q, r, airspeed)

    def _table(
        self, first: int, rows: int, raw: array[float], commands: list[tuple[int, tuple[float, float, float, float]]]
    ) -> TruthBlock:
        """Rows as read from JSBSim, and the last row before them, to columns."""
        if rows == 0:
            return TruthBlock.empty(first, 0)
        table = np.concatenate((np.array(self._last), np.frombuffer(raw))).reshape(rows + 1, WIDTH)
        table *= self._aircraft.units
        self._last = raw[-WIDTH:].tolist()
        t = (first - 1 + np.arange(rows + 1)) / self.rate_hz
        columns, v_n, wind_n = table.T.copy(), table[:, 3:6].copy(), table[:, 12:15].copy()
        q_nb, air = _attitude_and_air(table[:, 6:9], v_n, wind_n)
        dtheta, dv = increments(t, columns[0], columns[1], columns[2], v_n, q_nb)
        if first == 0:
            dtheta[1], dv[1] = 0.0, 0.0  # no interval ends at the first row of a run
        load, now = self._aircraft.envelope.current, columns[:, 1:]
        idle = load.payload_a + 4 * load.servo_idle_a
        held = np.repeat(np.array([values for _, values in commands]), [steps for steps, _ in commands], axis=0)
        return TruthBlock(
            first,
            t=t[1:],
            lat=now[0],
            lon=now[1],
            h=now[2],
            v_n=v_n[1:],
            q_nb=q_nb[1:],
            omega_b=table[1:, 9:12].copy(),
            dtheta=dtheta[1:],
            dv=dv[1:],
            wind_n=wind_n[1:],
            airspeed=air[0, 1:],
            alpha=air[1, 1:],
            beta=air[2, 1:],
            pressure=now[15],
            temperature=now[16],
            density=now[15] / (GAS_CONSTANT * now[16]),
            engine_rpm=now[17],
            current=_current(columns[19:], self.rate_hz, idle, load.servo_running_a),
            fuel=now[18],
            controls=table[1:, 19:23].copy(),
            commands=held[:, :3].copy(),
            leg=held[:, 3].copy(),
        )


@njit
def _attitude_and_air(euler: Array, v_n: Array, wind_n: Array) -> tuple[Array, Array]:
    """Quaternions (N, 4), and (3, N) true airspeed [m/s], angles of attack and sideslip [rad]."""
    q_nb, air = np.empty((len(euler), 4)), np.empty((3, len(euler)))
    for k in range(len(euler)):
        q = quat_from_euler_components(euler[k, 0], euler[k, 1], euler[k, 2])
        for i in range(4):
            q_nb[k, i] = q[i]
        air_n = v_n[k, 0] - wind_n[k, 0], v_n[k, 1] - wind_n[k, 1], v_n[k, 2] - wind_n[k, 2]
        air_b = quat_rotate_components((q[0], -q[1], -q[2], -q[3]), air_n)
        speed = math.sqrt(air_b[0] * air_b[0] + air_b[1] * air_b[1] + air_b[2] * air_b[2])
        across = min(max(air_b[1] / speed, -1.0), 1.0) if speed > 0.0 else 0.0
        air[0, k], air[1, k], air[2, k] = speed, math.atan2(air_b[2], air_b[0]), math.asin(across)
    return q_nb, air


@njit
def _current(columns: Array, rate_hz: float, idle: float, running: float) -> Array:
    """Current (N,) [A] from ``columns`` (5, N + 1), of four actuators, more the faster they run, and motor."""
    current = np.full(columns.shape[1] - 1, idle)
    for k in range(len(current)):
        for servo in range(4):
            rate = abs(columns[servo, k + 1] - columns[servo, k]) * rate_hz / SERVO_RATE
            current[k] += running * (1.0 if rate > 1.0 else rate)
        current[k] += columns[4, k + 1]
    return current


def _loss_of_control(state: Feedback, lowest: float) -> str:
    """What went wrong, empty when nothing did; a height of ``lowest`` [m] is the ground."""
    if state.h > lowest and abs(state.roll) < MAX_ROLL and abs(state.pitch) < MAX_PITCH:  # false for NaN
        return ""
    if not all(map(math.isfinite, state)):
        return "control lost: the simulation diverged"
    if state.h <= lowest:
        return "the aircraft hit the ground"
    return f"control lost: bank {math.degrees(state.roll):.0f} deg, pitch {math.degrees(state.pitch):.0f} deg"
