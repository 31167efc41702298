"""PX4's lockstep: we are the simulator. PX4 listens to the sensors of the run, and its clock is ours.

PX4 connects over TCP. For each sample of the first IMU it is sent HIL_SENSOR, before that HIL_GPS when a receiver has
news, and at `TRUTH_HZ` HIL_STATE_QUATERNION; it answers HIL_SENSOR with HIL_ACTUATOR_CONTROLS of the same
``time_usec``, and until it has, the run waits. It does so once it has booted: until then it is sent the first sample
again and again, in real time, and the run waits at its beginning. So stamps are those of the run and what booting
took; what else is sent depends on the run alone. What PX4 answers moves nothing here, unless it is to fly: then from
when it is armed its outputs 1 to 4 are aileron, elevator, throttle and rudder, positive to the right, up, on, right.

Its estimators of ``estimators``, names and addresses, are heard there (`testbed.mavlink.vehicle`). PX4's clock is that
of the stamps it is sent, from the first of them on. PX4 takes itself for landed until it is armed, and its estimator
then uses neither airspeed nor sideslip: so one that does not fly is armed there, by force, once it has said where it
is. Armed before, it would terminate its flight, and a PX4 that has done so has no outputs to answer with.

* Samples are those of the scenario with all their errors; of several units of a kind, the first, but all receivers.
* Answers to earlier steps are passed over; a later one, none within ``answer_s``, more than `MOST_BYTES` without the
  right one, or a closed connection ends it, and the run, with the reason.
* Receivers have the numbers of their place among the aiding sensors; PX4 counts them as they first speak.
* PX4 itself takes GNSS velocity for good to 0.25 m/s; heights above the sea's level are those above the ellipsoid.

Sources: SimulatorMavlink.cpp and .hpp of PX4-Autopilot 1.16; https://docs.px4.io/main/en/simulation/#lockstep-simulation;
MAVLink common messages HIL_SENSOR, HIL_GPS, HIL_STATE_QUATERNION, HIL_ACTUATOR_CONTROLS.
"""

from __future__ import annotations

import contextlib
import math
import socket
import time
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from nav.columns import Estimates
from nav.earth import SEA_LEVEL_DENSITY, isa_temperature, pressure_altitude
from nav.samples import AirspeedSample, BarometerSample, GnssSample, MagnetometerSample
from testbed.bridges.address import address, bound
from testbed.bridges.listener import listeners
from testbed.bridges.steps import Step, Stepper, moved
from testbed.errors import UserError
from testbed.feeds.bridged import OURS
from testbed.feeds.feed import Surfaces, Turn
from testbed.mavlink.encode import Encoder, centidegrees, latitude_e7, longitude_e7, microseconds
from testbed.mavlink.receive import Message, Reader

DEFAULT = "tcpin:127.0.0.1:4560"
TRUTH_HZ = 50.0
BOOT_HZ = 10.0  # of sensors other than the IMU, until PX4 answers
CONNECT_S, BOOT_S, ANSWER_S = 120.0, 120.0, 10.0  # of wall time
ARM_S = 1.0  # of the run, between two commands to arm
LAST_S = 0.2  # of wall time, that its last words may take
MOST_BYTES = 100_000  # said within one step, of which an answer has some hundred
READ = 65536
ACCEL, GYRO, MAGNETOMETER, BAROMETER, DYNAMIC = 0x7, 0x38, 0x1C0, 0x1A00, 0x400  # fields_updated, each a whole group
GAUSS, HECTOPASCAL, FREEZING = 1e-4, 100.0, 273.15
UNKNOWN_ACCURACY = 65535
ARMED = 128  # in the mode of an answer


class Px4:
    """One PX4 that follows a run (`testbed.feeds.bridged.FarEnd`). ``answered`` counts steps, ``armed`` says whether
    it ever was.
    """

    name = "PX4"
    sensors: Mapping[str, str] = dict.fromkeys(("imu", "gnss", "magnetometer", "barometer", "airspeed"), OURS)

    def __init__(
        self,
        url: str = DEFAULT,
        *,
        flies: bool = False,
        estimators: Mapping[str, str] | None = None,
        connect_s: float = CONNECT_S,
        boot_s: float = BOOT_S,
        answer_s: float = ANSWER_S,
    ) -> None:
        """Wait for PX4 to connect. Raises UserError when the address is none, is taken, or nobody comes."""
        self.failure, self.answered, self.armed = "", 0, False
        self.flies = flies
        self.surfaces: Surfaces | None = None
        self.estimators: Collection[str] = tuple(estimators or ())
        self._boot_s, self._answer_s = boot_s, answer_s
        self._stepper, self._encoder, self._reader = Stepper(), Encoder(), Reader()
        self._heard: deque[Message] = deque()
        self._offset_us: int | None = None  # from the run's clock to the stamps
        self._first_us = 0  # the first stamp
        self._system = 0  # of PX4, as it answers
        self._fix: dict[str, GnssSample] = {}  # the last of each receiver
        self._order: list[str] = []  # of the aiding sensors, as the scenario has them
        self._truth_due = self._arm_due = -math.inf
        self._said = 0  # bytes, by PX4
        with (
            bound(url, address(url, "tcpin", DEFAULT), socket.SOCK_STREAM) as listener,
            contextlib.ExitStack() as broken,
        ):
            self._ears = listeners(estimators or {})
            for one in self._ears.values():
                broken.callback(one.close)
            listener.listen(1)
            listener.settimeout(connect_s)
            try:
                self._socket, _ = listener.accept()
            except TimeoutError:
                raise UserError(f"{url}: no PX4 has connected within {connect_s:g} s: start one, try again") from None
            broken.pop_all()
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def follow(self, turn: Turn) -> None:
        """Send the steps of a turn, and wait for the answer to each."""
        self._order = list(turn.samples)
        for step in self._stepper.steps(turn):
            if not self.failure and self._offset_us is None:
                self._boot(step)
            if not self.failure and self._offset_us is not None:
                stamp = self._offset_us + microseconds(step.t)
                if self._send(self._frames(step, stamp)):
                    self._await(stamp, step.t)
        for one in self._ears.values():
            one.listen(self._system)
            if one.state.placed and not (self.armed or self.flies) and turn.reference.t[-1] >= self._arm_due:
                self._arm_due = float(turn.reference.t[-1]) + ARM_S
                one.arm_px4(self._system)

    def estimates(self, times: Sequence[float]) -> Mapping[str, Estimates]:
        """What PX4 said over the whole run of its own motion."""
        boot = (self._first_us - (self._offset_us or 0)) / 1e6
        for one in self._ears.values():
            one.listen(self._system, LAST_S)
        return {name: Estimates.of(one.state.estimates(times, boot)) for name, one in self._ears.items()}

    def close(self) -> None:
        """Close the connections."""
        self._socket.close()
        for one in self._ears.values():
            one.close()

    def _boot(self, step: Step) -> None:
        """Send the first step in real time, at `BOOT_HZ` with the other sensors, until there is an answer to any."""
        interval_us = max(1, microseconds(step.dt))
        stamp, until = interval_us, time.monotonic() + self._boot_s
        self._first_us = stamp
        quiet, seldom = replace(step, arrived={}), max(1, round(1 / (BOOT_HZ * step.dt)))
        while self._send(self._frames(quiet if stamp // interval_us % seldom else step, stamp)):
            next_at = time.monotonic() + step.dt
            if (answer := self._controls(next_at)) is not None:
                self._system = answer.system
                self._offset_us = stamp + interval_us - microseconds(step.t)
                return
            if self.failure:
                return
            if time.monotonic() > until:
                self.failure = f"PX4 has connected, but answered no HIL_SENSOR for {self._boot_s:g} s"
                return
            stamp += interval_us

    def _await(self, stamp: int, t: float) -> None:
        """Wait for the controls of the step sent last."""
        until = time.monotonic() + self._answer_s
        heard_before = self._said
        while (controls := self._controls(until)) is not None:
            if controls["time_usec"] == stamp:
                self.answered += 1
                self.armed |= bool(controls["mode"] & ARMED)
                if self.flies and controls["mode"] & ARMED:
                    self._take(controls["controls"], t)
                return
            if controls["time_usec"] > stamp:
                self.failure = (
                    f"PX4 answered at {t:.3f} s for {(controls['time_usec'] - stamp) / 1e6:.3f} s later: its clock is"
                    " not ours; does it run in lockstep?"
                )
                return
            if self._said - heard_before > MOST_BYTES:
                break
        if not self.failure:
            much = self._said - heard_before
            self.failure = (
                f"PX4 said {much} bytes at {t:.3f} s, but not the controls of that step"
                if much > MOST_BYTES
                else f"PX4 has not answered the step of {t:.3f} s for {self._answer_s:g} s"
                + (": has it terminated its flight?" if self.armed else "")
            )

    def _take(self, controls: Sequence[float], t: float) -> None:
        """Outputs, as they are from -1 to 1, and the throttle from 0."""
        roll, pitch, throttle, yaw = controls[:4]
        self.surfaces = moved(roll, pitch, yaw, throttle)
        if self.surfaces is None:
            self.failure = f"PX4 commanded at {t:.3f} s what is no number"

    def _controls(self, until: float) -> Message | None:
        """The next HIL_ACTUATOR_CONTROLS, None when there is none by ``until`` or too much else is said."""
        said_before = self._said
        while True:
            while self._heard:
                message = self._heard.popleft()
                if message.name == "HIL_ACTUATOR_CONTROLS":
                    return message
            left = until - time.monotonic()
            if left <= 0 or self._said - said_before > MOST_BYTES:
                return None
            self._socket.settimeout(left)
            try:
                data = self._socket.recv(READ)
            except TimeoutError:
                return None
            except OSError as error:
                self.failure = f"the connection to PX4 broke: {error.strerror}"
                return None
            if not data:
                self.failure = "PX4 has closed the connection"
                return None
            self._said += len(data)
            self._heard.extend(self._reader.read(data))

    def _send(self, frames: list[bytes]) -> bool:
        """Whether it could be sent."""
        self._socket.settimeout(self._answer_s)
        try:
            self._socket.sendall(b"".join(frames))
        except TimeoutError:
            self.failure = f"PX4 has not read what it was sent for {self._answer_s:g} s"
        except OSError as error:
            self.failure = f"the connection to PX4 broke: {error.strerror}"
        return not self.failure

    def _frames(self, step: Step, stamp: int) -> list[bytes]:
        """What PX4 is told of a step; HIL_SENSOR last, as it sets PX4's clock."""
        frames = []
        receivers = [one for one in step.arrived.values() if isinstance(one, GnssSample)]
        for sample in receivers:
            self._fix.setdefault(sample.sensor, sample)
            if sample.has_fix:
                self._fix[sample.sensor] = sample
            frames.append(self._gps(sample, stamp))
        if stamp >= self._truth_due and np.isfinite(step.truth.lat[0]):
            self._truth_due = stamp + 1e6 / TRUTH_HZ - 1
            frames.append(self._state(step, stamp))
        return [*frames, self._sensor(step, stamp)]

    def _sensor(self, step: Step, stamp: int) -> bytes:
        fields: dict[str, float] = {"time_usec": stamp, "id": 0}
        fields |= zip(("xgyro", "ygyro", "zgyro"), step.gyro.tolist(), strict=True)
        fields |= zip(("xacc", "yacc", "zacc"), step.accel.tolist(), strict=True)
        fields |= dict.fromkeys(("xmag", "ymag", "zmag", "abs_pressure", "diff_pressure", "pressure_alt"), 0.0)
        updated, fields["temperature"] = ACCEL | GYRO, 0.0
        if (field := step.first(MagnetometerSample)) is not None:
            updated |= MAGNETOMETER
            fields |= zip(("xmag", "ymag", "zmag"), (field.field_b / GAUSS).tolist(), strict=True)
        if (air := step.first(BarometerSample)) is not None:
            updated |= BAROMETER
            h = float(pressure_altitude(air.pressure))
            fields |= {"abs_pressure": air.pressure / HECTOPASCAL, "pressure_alt": h}
            fields["temperature"] = float(isa_temperature(h)) - FREEZING
        if (speed := step.first(AirspeedSample)) is not None:
            updated |= DYNAMIC
            fields["diff_pressure"] = 0.5 * SEA_LEVEL_DENSITY * speed.eas * abs(speed.eas) / HECTOPASCAL
        return self._encoder.frame("HIL_SENSOR", {**fields, "fields_updated": updated})

    def _gps(self, sample: GnssSample, stamp: int) -> bytes:
        """A receiver's news; without a fix the place is the last one."""
        at = self._fix[sample.sensor]
        v = np.nan_to_num(sample.v_n)
        known = sample.has_fix
        sigma = sample.sigma_position_n
        fields = {
            "time_usec": stamp,
            "fix_type": int(sample.fix_type),
            "lat": latitude_e7(at.lat),
            "lon": longitude_e7(at.lon),
            "alt": at.h * 1e3,
            "eph": 100 * math.hypot(sigma[0], sigma[1]) if known else UNKNOWN_ACCURACY,
            "epv": 100 * sigma[2] if known else UNKNOWN_ACCURACY,
            "vel": 100 * math.hypot(v[0], v[1]),
            **dict(zip(("vn", "ve", "vd"), (100 * v).tolist(), strict=True)),
            "cog": centidegrees(math.atan2(v[1], v[0])),
            "satellites_visible": sample.satellites,
            "id": self._order.index(sample.sensor),
            "yaw": 0,
        }
        return self._encoder.frame("HIL_GPS", fields)

    def _state(self, step: Step, stamp: int) -> bytes:
        """Truth, which PX4 logs beside its estimate."""
        row = step.truth
        air = 100 * float(row.airspeed[0])
        rates = zip(("rollspeed", "pitchspeed", "yawspeed"), row.omega_b[0].tolist(), strict=True)
        velocity = zip(("vx", "vy", "vz"), (100 * row.v_n[0]).tolist(), strict=True)
        force = zip(("xacc", "yacc", "zacc"), (1e3 * step.accel / 9.80665).tolist(), strict=True)
        fields = {
            "time_usec": stamp,
            "attitude_quaternion": row.q_nb[0].tolist(),
            **dict(rates),
            "lat": latitude_e7(float(row.lat[0])),
            "lon": longitude_e7(float(row.lon[0])),
            "alt": float(row.h[0]) * 1e3,
            **dict(velocity),
            "ind_airspeed": air * math.sqrt(max(float(row.density[0]), 0.0) / SEA_LEVEL_DENSITY),
            "true_airspeed": air,
            **dict(force),
        }
        return self._encoder.frame("HIL_STATE_QUATERNION", fields)
