"""The closed loop: guidance and inner loops fly on an estimate and on sensors, truth is only recorded.

What comes from where (`testbed.scenario.FeedbackConfig`), every `FRAME_HZ`, at the newest tick t:

* Attitude group. Roll, pitch and heading are the estimator's at t, predicted with the newest increments. Body rates
  are the mean of the increments since the last frame, in body axes, less the gyro bias where one is estimated.
* Position group of an estimator that has one. Place, height, velocity and climb are the estimator's at t, moved from
  its IMU to the centre of gravity. True airspeed is V = EAS sqrt(rho0 / rho), EAS the newest sample that has arrived,
  rho the standard atmosphere's at the static pressure that has. While the estimator refuses the sensor
  (`TRUSTED_AFTER` looks in a row), or it is silent or stuck (2 s without another value), V = |v_n - wind|, the
  estimator's wind; where it has none, V is the speed commanded, so that the throttle stays as it was trimmed.
* Position group of an estimator of attitude alone: dead reckoning by air data, no wind being known,

      V_h^2 = V^2 - w^2,   v_N = V_h cos(heading),   v_E = V_h sin(heading),
      lat' = v_N / (R_M + h),   lon' = v_E / ((R_N + h) cos lat).

  Height h and climb w come from vertical acceleration, corrected by pressure altitude z as the altimeter was set:

      h' = w + 2 zeta omega (z - h),   w' = a + omega^2 (z - h),   a = -(C_nb f_b)_D - g.

  A constant error of acceleration da makes the climb wrong by 2 zeta da / omega: 0.1 m/s for 3 mg.

A run begins in the air, so somebody else has taken off, or it takes off on truth, as its launcher is no matter of
navigation: the loops are closed on truth until the aircraft is launched and the estimators are aligned.
Then the loop closes, which is an event, and stays closed. Dead reckoning takes over place, height and climb, and sets
its altimeter. Nothing is fed back that had not arrived. Numbers that can't be flown on (NaN, or beyond all bounds)
never reach the aircraft: for `HOLD_S` it flies on the last good ones, then the run ends with the reason.

Frames. A sample held for T is T / 2 old on average, and a rate averaged over T is T / 2 older. Fed with truth that
late, the inner loops oscillate from a further delay of 0.15 s on at 25 m/s and 0.07 s at 34 m/s, near the fastest that
is flown (`tests/feeds/test_autopilot.py`). 50 Hz takes a fifth of what there is then and cannot be told from 200 Hz;
25 Hz would take nearly half. Guidance keeps its own 10 Hz. Frames are counted in ticks from the start of the run, so
the result depends on nothing else.
"""

from __future__ import annotations

import math
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from nav import aids
from nav.columns import Reports
from nav.earth import gravity, pressure_altitude, radii, wrap_longitude
from nav.motion import TrueAirspeed
from nav.rotation import cross, euler_from_quat, quat_rotate
from nav.samples import (
    FORCE_LIMIT,
    RATE_LIMIT,
    AirspeedSample,
    Array,
    BarometerSample,
    Estimate,
    ImuSamples,
    Outcome,
    Sample,
    Status,
    UpdateReport,
)
from testbed.estimators.lane import Lane
from testbed.feeds.feed import Turn, join
from testbed.feeds.known import commanded, handed_over
from testbed.motion.paths import Feedback
from testbed.motion.table import MotionSource, TruthBlock
from testbed.scenario import Scenario
from testbed.sensors.imu import ImuConfig

FRAME_HZ = 50.0
HOLD_S = 1.0  # for how long the last good state is flown on
AIRSPEED_SMOOTHING_S = 0.2  # the loops have a lag of their own
LEAST_EAS = 10.0  # below it the tube tells nothing: nothing of this size flies so slowly [m/s]
TRUSTED_AFTER = 3  # looks in a row for which an estimator refuses a sensor, or takes it, before the autopilot does
CLIMB_BANDWIDTH, CLIMB_DAMPING = 0.5, 0.7  # omega [rad/s] and zeta of height and climb
PRESSURE_VALID_S = 2.0  # a pressure is good for as long
LONGEST_LOOK_S = 1.0  # what a pressure counts for at most, however long ago the one before was
AIRSPEED_SOURCES = {
    "sensor": ("info", "from its sensor again"),
    "estimate": ("warning", "from ground velocity less wind: the sensor is silent, stuck or refused"),
    "command": ("warning", "unknown: it is taken to be the one commanded"),
}
MOST_HEIGHT, MOST_SPEED = 1e5, 1e3  # that can be flown on [m, m/s]
MOST_OF_QUATERNION = 1.1  # of a component
PLACE, VELOCITY = ("lat", "lon", "h"), ("v_north", "v_east", "v_down")  # of `Feedback`

UNKNOWN = np.full(3, np.nan)

Sense = Callable[[TruthBlock], tuple[dict[str, ImuSamples], dict[str, Sequence[Sample]]]]


@runtime_checkable
class Steered(MotionSource, Protocol):
    """A motion that follows what is fed back: `testbed.motion.flight.Flight`."""

    def feed_back(self, state: Feedback | None) -> None:
        """Close guidance and inner loops on ``state`` until the next call; None is truth."""
        ...

    @property
    def on_ground(self) -> bool:
        """Whether it has not been launched yet."""
        ...

    def true_feedback(self) -> Feedback:
        """What would be fed back if everything were known."""
        ...

    def give_up(self, why: str) -> None:
        """End the motion here; ``why`` becomes its failure."""
        ...


class Autopilot:
    """Flies a motion on estimates, frame by frame. ``events`` are (time, severity, text), for the loop to take.

    ``sense`` makes what all sensors deliver over some rows; ``filters`` are the scenario's estimators, of which those
    flown on are run here.
    """

    def __init__(self, source: Steered, scenario: Scenario, filters: Mapping[str, Lane], sense: Sense) -> None:
        feedback = scenario.autopilot.feedback
        self.events: deque[tuple[float, str, str]] = deque()
        self.closed = False
        self.motion_s = 0.0  # wall time that the motion took
        self._source, self._sense = source, sense
        self._filters = {name: filters[name] for name in feedback.estimators}
        self._attitude, self._position = feedback.attitude, feedback.position
        self._frame = max(1, round(source.rate_hz / FRAME_HZ))
        self._tick = 0
        self._turned, self._pushed, self._span = np.zeros(3), np.zeros(3), 0.0  # increments since the last frame
        self._rates = np.zeros(3)
        self._good: tuple[float, Feedback] | None = None  # the last one, and when
        self._arm_b = np.zeros(3)
        self._air: AirData | None = None
        self._reckoning: DeadReckoning | None = None
        self._reckons = False
        self._airspeed_from = "sensor"
        # Whose attitude and increments are used here, even where the aircraft flies on true ones.
        self._leader = feedback.estimators[0]
        if self._position != "truth":
            config = next(one for one in scenario.estimator if one.name == self._position)
            imu, used = scenario.sensors[config.imu], self._filters[self._position].sensors
            assert isinstance(imu, ImuConfig)  # the scenario was checked
            self._arm_b = imu.errors().lever_arm_b
            airspeed, barometer = (_first(kind, used, scenario) for kind in ("airspeed", "barometer"))
            self._air = AirData(airspeed, barometer, scenario.site().h)
            self._reckons = config.attitude_only

    def advance(self, ticks: int, wanted: Sequence[int]) -> Turn:
        """The next ``ticks`` rows, fewer when the motion ends; estimates are kept of the rows ``wanted``, ascending."""
        turns: list[Turn] = []
        done = 0
        while done < ticks:
            before = time.perf_counter()
            block = self._source.advance(min(ticks - done, self._frame - self._tick % self._frame))
            self.motion_s += time.perf_counter() - before
            if not len(block):
                break
            first, last = bisect_left(wanted, done), bisect_left(wanted, done + len(block))
            here = [float(block.t[k - done]) for k in wanted[first:last]]
            turns.append(self._turn(block, here))
            done += len(block)
        return join(turns) if turns else Turn(TruthBlock.empty(self._tick, 0), {}, {}, {})

    def take_events(self, until: float = math.inf) -> list[tuple[float, str, str]]:
        """Remove and give the events up to a time."""
        taken = []
        while self.events and self.events[0][0] <= until:
            taken.append(self.events.popleft())
        return taken

    def _turn(self, block: TruthBlock, wanted: list[float]) -> Turn:
        """Sense and estimate over the rows of one frame, or of a part of it; at its end, feed back."""
        if block.tick == 0:
            for one in self._filters.values():
                if one.handover is not None:
                    one.start(handed_over(one.handover, block))
        self._tick = block.tick + len(block)
        t = float(block.t[-1])
        ends = self._tick % self._frame == 0
        times = [*wanted, t] if ends and t not in wanted else wanted
        imu, samples = self._sense(block)
        tracked = {name: one.track(commanded(block), imu, samples, times) for name, one in self._filters.items()}
        self._integrate(tracked[self._leader].increments)
        if self._air is not None:
            self._air.take(samples, tracked[self._position].reports)
        if ends:
            self._feed_back(t, block, {name: _sound(one.estimates[-1]) for name, one in tracked.items()})
        if len(times) > len(wanted):
            tracked = {name: one._replace(estimates=one.estimates[: len(wanted)]) for name, one in tracked.items()}
        return Turn(block, imu, samples, tracked)

    def _integrate(self, imu: ImuSamples) -> None:
        """Add what is possible of the increments; rates are unknown when nothing is."""
        for T, dtheta, dv in zip(imu.dt.tolist(), imu.dtheta, imu.dv, strict=True):  # as sums depend on their order
            if np.abs(dtheta).max() <= RATE_LIMIT * T and np.abs(dv).max() <= FORCE_LIMIT * T:  # false for NaN
                self._turned += dtheta
                self._pushed += dv
                self._span += T
            else:
                self._rates = UNKNOWN

    def _feed_back(self, t: float, block: TruthBlock, estimates: Mapping[str, Estimate]) -> None:
        """Close the loops on what is known at ``t``, once there is something to be known."""
        if self._air is not None:
            self._air.advance(t)
        if not self.closed and not self._source.on_ground and self._ready(t, estimates):
            self.closed = True
            self.events.append((t, "info", f"the autopilot flies on {self._names()} from here on"))
            if self._reckons and self._air is not None:
                self._reckoning = DeadReckoning(self._source.true_feedback(), self._air.altitude)
        if self.closed:
            state = self._state(t, float(block.commands[-1, 2]), estimates)
            if all(map(math.isfinite, state)):
                self._good = (t, state)
            if self._good is not None and t - self._good[0] <= HOLD_S:
                self._source.feed_back(self._good[1])
            else:
                self._source.give_up(f"the autopilot lost its estimate: {self._missing(state, estimates)}")
        self._turned[:], self._pushed[:], self._span = 0.0, 0.0, 0.0

    def _names(self) -> str:
        if self._attitude == self._position:
            return self._attitude
        return f"attitude of {self._attitude} and position of {self._position}"

    def _missing(self, state: Feedback, estimates: Mapping[str, Estimate]) -> str:
        """Which numbers of whom can't be flown on, less those that only could not be worked out for want of others."""
        known: set[str] = set()
        if self._reckoning is not None and not math.isfinite(state.heading):
            known = {*PLACE, *VELOCITY}
        elif self._reckoning is None and self._air is not None:
            estimate = estimates[self._position]
            told = dict(zip((*PLACE, *VELOCITY), (estimate.lat, estimate.lon, estimate.h, *estimate.v_n), strict=True))
            known = {name for name, value in told.items() if math.isfinite(value)}
        bad = [name for name, value in state._asdict().items() if not math.isfinite(value)]
        return f"{self._names()} gives no {', '.join([name for name in bad if name not in known] or bad)}"

    def _ready(self, t: float, estimates: Mapping[str, Estimate]) -> bool:
        aligned = all(Status.ALIGNED in estimate.status for estimate in estimates.values())
        air = self._air if self._reckons else None
        return aligned and (air is None or (t - air.altitude_t <= PRESSURE_VALID_S and math.isfinite(air.airspeed(t))))

    def _state(self, t: float, commanded_airspeed: float, estimates: Mapping[str, Estimate]) -> Feedback:
        """What is known at ``t``; NaN is what is not."""
        state = self._source.true_feedback()
        attitude = estimates[self._leader]
        roll, pitch, heading = euler_from_quat(attitude.q_nb).tolist()
        if not math.isfinite(roll):
            pitch = math.nan  # its sine was brought within bounds
        f_b = np.zeros(3)
        if self._span > 0.0:  # an IMU slower than the frames has nothing new in some
            self._rates, f_b = self._turned / self._span - attitude.gyro_bias, self._pushed / self._span
        p, q, r = self._rates.tolist()
        if self._attitude != "truth":
            state = state._replace(roll=roll, pitch=pitch, heading=heading, p=p, q=q, r=r)
        if self._air is None:
            return state
        if self._reckoning is None:
            estimate = estimates[self._position]
            airspeed = self._airspeed(t, _speed_through_air(estimate), commanded_airspeed)
            lat, lon, h, v_n = _at_centre(estimate, attitude.q_nb, self._rates, self._arm_b)
        else:
            airspeed = self._airspeed(t, math.nan, commanded_airspeed)
            rising = -float(quat_rotate(attitude.q_nb, f_b)[2]) if self._span > 0.0 else math.nan
            lat, lon, h, v_n = self._reckoning.advance(t, airspeed, heading, rising, self._air)
        north, east, down = v_n
        return state._replace(lat=lat, lon=lon, h=h, v_north=north, v_east=east, v_down=down, airspeed=airspeed)

    def _airspeed(self, t: float, estimated: float, commanded: float) -> float:
        """True airspeed [m/s] from the sensor, else as estimated, else the one that was asked for."""
        assert self._air is not None
        measured = self._air.airspeed(t)
        source = "sensor" if math.isfinite(measured) else "estimate" if math.isfinite(estimated) else "command"
        if source != self._airspeed_from:
            self._airspeed_from = source
            severity, what = AIRSPEED_SOURCES[source]
            self.events.append((t, severity, f"autopilot: airspeed {what}"))
        return {"sensor": measured, "estimate": estimated, "command": commanded}[source]


class AirData:
    """What air data has arrived: true airspeed, and pressure altitude.

    ``airspeed_sensor`` is trusted as long as the estimator flown on, if it uses it, does not refuse it.
    """

    def __init__(self, airspeed_sensor: str, barometer: str, h: float) -> None:
        self.altitude = math.nan  # pressure altitude [m] of the newest sample, which was true at
        self.altitude_t = -math.inf
        self._airspeed_sensor = airspeed_sensor
        self._coming: list[Sample] = []  # not arrived yet
        self._reports: list[UpdateReport] = []  # not looked at
        self._sensors = (airspeed_sensor, barometer)
        self._true = TrueAirspeed(h, AIRSPEED_SMOOTHING_S)
        self._eas = math.nan
        self._looks = 0  # in a row that the estimator saw otherwise than the autopilot does
        self.trusted = True

    def take(self, samples: Mapping[str, Sequence[Sample]], reports: Reports) -> None:
        """Add what the sensors deliver, some of it later, and what the estimator says of it."""
        for name in self._sensors:
            self._coming.extend(samples.get(name, ()))
        self._reports += reports.of(self._airspeed_sensor, "airspeed")

    def advance(self, t: float) -> None:
        """Use what has arrived by ``t`` [s]."""
        for report in self._reports:
            self._judge(report.outcome in (Outcome.FUSED, Outcome.WEAKENED) and report.weight > 0.0)
        self._reports.clear()
        arrived = [sample for sample in self._coming if sample.t_arrival <= t]
        self._coming = [sample for sample in self._coming if sample.t_arrival > t]
        for sample in arrived:
            if aids.problem(sample):
                continue
            if isinstance(sample, BarometerSample):
                self.altitude, self.altitude_t = float(pressure_altitude(sample.pressure)), sample.t
                self._true.add_pressure(sample.pressure)
            elif isinstance(sample, AirspeedSample) and sample.eas >= LEAST_EAS and self.trusted:
                if sample.eas != self._eas:  # one that does not even rustle is stuck
                    self._true.add_eas(sample.t, sample.eas)
                self._eas = sample.eas

    def airspeed(self, t: float) -> float:
        """True airspeed [m/s], NaN when the sensor is silent or not to be trusted."""
        return self._true.at(t) if self.trusted else math.nan

    def _judge(self, sound: bool) -> None:
        self._looks = 0 if sound == self.trusted else self._looks + 1
        if self._looks >= TRUSTED_AFTER:
            self.trusted, self._looks = sound, 0


class DeadReckoning:
    """Place, height and climb from heading and air data; the equations are at the head of this module."""

    def __init__(self, start: Feedback, altimeter: float) -> None:
        """Take over from whoever has flown so far; the ``altimeter`` [m] is set to the height."""
        self._lat, self._lon, self._h, self._climb = start.lat, start.lon, start.h, -start.v_down
        self._setting = start.h - altimeter
        self._t = self._seen = math.nan  # now, and when the newest pressure was true
        self._a = 0.0  # upwards [m/s^2], as it was last

    def advance(
        self, t: float, airspeed: float, heading: float, rising: float, air: AirData
    ) -> tuple[float, float, float, tuple[float, float, float]]:
        """Go on to ``t``: latitude, longitude [rad], height [m], velocity NED [m/s]. Height is NaN without pressure.

        ``airspeed`` [m/s] is true, ``rising`` specific force upwards [m/s^2], NaN when there is no new one: then it is
        as it was, as with an IMU slower than the frames. Without a heading it stays where it is, and knows nothing.
        """
        if not math.isfinite(heading):
            return math.nan, math.nan, math.nan, (math.nan, math.nan, math.nan)
        T = 0.0 if math.isnan(self._t) else t - self._t
        self._t = t
        if math.isfinite(rising):
            self._a = rising - gravity(self._lat, self._h)
        self._h += (self._climb + 0.5 * self._a * T) * T
        self._climb += self._a * T
        if air.altitude_t != self._seen:
            dt = 0.0 if math.isnan(self._seen) else min(air.altitude_t - self._seen, LONGEST_LOOK_S)
            age = t - air.altitude_t
            error = air.altitude + self._setting - (self._h - self._climb * age)
            self._h += 2 * CLIMB_DAMPING * CLIMB_BANDWIDTH * dt * error
            self._climb += CLIMB_BANDWIDTH**2 * dt * error
            self._seen = air.altitude_t
        level = math.sqrt(max(airspeed**2 - self._climb**2, 0.0))
        north, east = level * math.cos(heading), level * math.sin(heading)
        R_M, R_N = radii(self._lat)
        lat = self._lat + north * T / (R_M + self._h)
        self._lon = wrap_longitude(self._lon + east * T / ((R_N + self._h) * math.cos(self._lat)))
        self._lat = lat
        h = self._h if t - air.altitude_t <= PRESSURE_VALID_S else math.nan
        return self._lat, self._lon, h, (north, east, -self._climb)


def _first(kind: str, used: Sequence[str], scenario: Scenario) -> str:
    """The first sensor of a kind that the estimator uses, else the first in the file, else none."""
    return next((name for name in (*used, *scenario.sensors) if scenario.sensors[name].kind == kind), "")


def _speed_through_air(estimate: Estimate) -> float:
    """|v_n - wind| [m/s], NaN when no wind is estimated, or one that is none."""
    wind = next(
        (value for name, (value, _) in estimate.extra.items() if name == "wind" or name.endswith("_wind")), None
    )
    if wind is None or len(wind) < 2:  # an estimator of the user's may call another thing so
        return math.nan
    if max(abs(wind[0]), abs(wind[1])) > MOST_SPEED:
        return math.nan
    north, east, down = estimate.v_n.tolist()
    return math.sqrt((north - float(wind[0])) ** 2 + (east - float(wind[1])) ** 2 + down**2)


def _sound(estimate: Estimate) -> Estimate:
    """The same, with NaN for numbers too large to be flown on, so that nothing has to reckon with them.

    A gyro bias that is not estimated is 0: there is none to take off.
    """
    unknown = np.isnan(estimate.gyro_bias)
    e = replace(estimate, gyro_bias=np.where(unknown, 0.0, estimate.gyro_bias)) if unknown.any() else estimate
    lost = abs(e.lat) > math.pi / 2 or abs(e.lon) > 2 * math.pi or abs(e.h) > MOST_HEIGHT
    limits = {"v_n": MOST_SPEED, "q_nb": MOST_OF_QUATERNION, "gyro_bias": RATE_LIMIT}
    large = {name: np.abs(getattr(e, name)) > most for name, most in limits.items()}
    changes: dict[str, Any] = dict.fromkeys(("lat", "lon", "h"), math.nan) if lost else {}
    changes |= {name: np.where(bad, math.nan, getattr(e, name)) for name, bad in large.items() if bad.any()}
    return replace(e, **changes) if changes else e


def _at_centre(
    estimate: Estimate, q_nb: Array, omega_b: Array, arm_b: Array
) -> tuple[float, float, float, tuple[float, float, float]]:
    """Place and velocity NED of the centre of gravity, from which ``arm_b`` [m] points to what is estimated."""
    if not math.isfinite(estimate.lat):
        return math.nan, math.nan, math.nan, (math.nan, math.nan, math.nan)
    north, east, down = quat_rotate(q_nb, arm_b).tolist()
    R_M, R_N = radii(estimate.lat)
    v_n = estimate.v_n - quat_rotate(q_nb, cross(omega_b, arm_b))
    return (
        estimate.lat - north / (R_M + estimate.h),
        estimate.lon - east / ((R_N + estimate.h) * math.cos(estimate.lat)),
        estimate.h + down,
        (float(v_n[0]), float(v_n[1]), float(v_n[2])),
    )
