"""ArduPilot's JSON physics backend: we are the physics. ArduPilot listens to the motion of the run.

ArduPilot sends a packet of servo outputs per frame over UDP and waits for one line of JSON; a line goes out for each
sample of the first IMU, when the packet of the next frame has come, and until then the run waits. What is ours in it:
``imu`` (gyro and accel_body, with all errors of the scenario), and ``airspeed`` where there is a sensor. ``position``
(from the first place, see `_metres`), ``velocity`` and ``attitude`` are truth: of these ArduPilot makes GNSS,
magnetometer and barometer of its own; our fixes can go to its MAVLink beside (`testbed.bridges.gps_input`).
``no_time_sync`` keeps it from waiting for the wall clock. What the servos say moves nothing here, unless ArduPilot is
to fly: then from its first throttle above `STARTED_US` on channels 1 to 4 are aileron, elevator, throttle and rudder, a
packet old when they move.

Its estimators of ``estimators``, names and addresses, are heard there (`testbed.mavlink.vehicle`), once they are asked
to speak. ArduPilot's clock is that of the lines: the sum of the differences of their stamps. One that is not armed
takes itself for landed, and has no position without fixes: so one that does not fly is armed there, by force, once it
has said where it is.

A packet that comes again, as ArduPilot's do after a second without an answer, is answered again by the same line;
earlier frames and what is no such packet are passed over. A first frame after others, none within ``answer_s``, or
more than `MOST_PACKETS` without the next frame ends it, and the run, with the reason.

Source: SIM_JSON.cpp and .h, SIM_Aircraft.cpp of ArduPilot 4.6, and libraries/SITL/examples/JSON/readme.md there: magic
18458 with 16 channels or 29569 with 32, rate, count, microseconds of each, little-endian; no space may stand before a
list. Airspeed is a true one, of which sitl_airspeed.cpp makes an equivalent one; places come of metres as in
Location.cpp.
"""

from __future__ import annotations

import json
import math
import socket
import struct
import time
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from nav.columns import Estimates
from nav.earth import SEA_LEVEL_DENSITY, isa_density
from nav.rotation import euler_from_quat
from nav.samples import AirspeedSample
from testbed.bridges.address import address, bound
from testbed.bridges.gps_input import GpsInput
from testbed.bridges.listener import Listener, listeners
from testbed.bridges.steps import Step, Stepper, moved
from testbed.errors import UserError
from testbed.feeds.bridged import OURS, THEIRS
from testbed.feeds.feed import Surfaces, Turn

DEFAULT = "udpin:127.0.0.1:9002"
CONNECT_S, ANSWER_S = 120.0, 10.0  # of wall time
SYSTEM = 1  # that ArduPilot is, where its MAV_SYSID is not changed
ASK_S = 1.0  # of the run, between two times that it is asked to speak
LAST_S = 0.2  # of wall time, that its last words may take
MOST_PACKETS = 1000  # heard within one step
_HEAD = struct.Struct("<HHI")  # magic, frame rate, frame count
CHANNELS = {18458: 16, 29569: 32}  # by magic
DIGITS = 9
RADIUS_M = 6_378_100.0  # of ArduPilot's Earth, a sphere
MIDDLE_US, TRAVEL_US, STARTED_US = 1500, 500, 1050  # of a channel


class ArduPilot:
    """One ArduPilot that follows a run (`testbed.feeds.bridged.FarEnd`); ``answered`` counts steps."""

    name = "ArduPilot"

    def __init__(
        self,
        url: str = DEFAULT,
        *,
        flies: bool = False,
        fixes: GpsInput | None = None,
        estimators: Mapping[str, str] | None = None,
        connect_s: float = CONNECT_S,
        answer_s: float = ANSWER_S,
    ) -> None:
        """Wait for ArduPilot's first packet; ``fixes`` are sent there, and closed at the end.

        Raises UserError when the address is none, is taken, or nobody comes.
        """
        self.failure, self.answered = "", 0
        self.flies, self._fixes = flies, fixes
        self.sensors: Mapping[str, str] = {
            "imu": OURS,
            "airspeed": OURS,
            "gnss": OURS if fixes is not None else THEIRS,
            "magnetometer": THEIRS,
            "barometer": THEIRS,
        }
        self.surfaces: Surfaces | None = None
        self._ears: dict[str, Listener] = {}
        self.estimators: Collection[str] = tuple(estimators or ())
        self._ask_due = -math.inf
        self._started = False
        self._answer_s = answer_s
        self._stepper = Stepper()
        self._line = b""  # the last answer
        self._frame: int | None = None  # that was answered last
        self._peer: tuple[str, int] | None = None
        self._servos: tuple[int, ...] = (MIDDLE_US, MIDDLE_US, 0, MIDDLE_US)
        self._home: tuple[float, float, float] | None = None
        self._airspeed: float | None = None
        self._socket = bound(url, address(url, "udpin", DEFAULT), socket.SOCK_DGRAM)
        try:
            self._ears = listeners(estimators or {})
            self._next = self._heard(time.monotonic() + connect_s)
            if self._next is None:
                raise UserError(f"{url}: no ArduPilot has called within {connect_s:g} s: start it with --model JSON")
        except BaseException:  # an interrupt too
            self.close()
            raise

    def follow(self, turn: Turn) -> None:
        """Answer the frames that the steps of a turn belong to."""
        for step in self._stepper.steps(turn):
            if not self.failure:
                self._answer(step)
        t = float(turn.reference.t[-1])
        asks = t >= self._ask_due
        for one in self._ears.values():
            one.listen(SYSTEM)
            if asks and not one.state.moving:
                one.ask(SYSTEM)
            elif asks and not (one.state.armed or self.flies):
                one.arm_ardupilot(SYSTEM)
        self._ask_due = t + ASK_S if asks else self._ask_due

    def estimates(self, times: Sequence[float]) -> Mapping[str, Estimates]:
        """What ArduPilot said over the whole run of its own motion."""
        for one in self._ears.values():
            one.listen(SYSTEM, LAST_S)
        return {name: Estimates.of(one.state.estimates(times, 0.0)) for name, one in self._ears.items()}

    def close(self) -> None:
        """Close the port, the link for fixes, and where its estimators are heard."""
        self._socket.close()
        for one in self._ears.values():
            one.close()
        if self._fixes is not None:
            self._fixes.close()

    def _answer(self, step: Step) -> None:
        frame, self._next = self._next, None
        if frame is None:
            frame = self._heard(time.monotonic() + self._answer_s)
        if frame is None:
            self.failure = self.failure or f"ArduPilot has sent no frame for {self._answer_s:g} s at {step.t:.3f} s"
            return
        self._take(self._servos)
        if self._fixes is not None:
            self._fixes.tell(step)
            self.failure = self.failure or self._fixes.failure
        self._frame, self._line = frame, self.line(step)
        self._reply()
        self.answered += 1

    def _take(self, servos: tuple[int, ...]) -> None:
        """The first four channels [us], once the throttle is up."""
        roll, pitch, throttle, yaw = servos
        self._started |= throttle > STARTED_US
        if self.flies and self._started:
            right, up, yawed = ((value - MIDDLE_US) / TRAVEL_US for value in (roll, pitch, yaw))
            self.surfaces = moved(right, up, yawed, (throttle - MIDDLE_US + TRAVEL_US) / (2 * TRAVEL_US))

    def _reply(self) -> None:
        if self._peer is not None:
            try:
                self._socket.sendto(self._line, self._peer)
            except OSError as error:
                self.failure = f"the answer to ArduPilot can't be sent: {error.strerror}"

    def _heard(self, until: float) -> int | None:
        """The count of the next frame, None when none comes."""
        for _ in range(MOST_PACKETS):
            left = until - time.monotonic()
            if left <= 0:
                return None
            self._socket.settimeout(left)
            try:
                data, peer = self._socket.recvfrom(2048)
            except TimeoutError:
                return None
            except OSError:  # the peer's port was closed when an answer came; it may open again
                continue
            frame = _frame_of(data)
            if frame is None or (self._peer is not None and peer != self._peer):
                continue
            self._peer = peer
            if self._frame is None or frame > self._frame:
                self._servos = struct.unpack_from("<4H", data, _HEAD.size)
                return frame
            if frame == self._frame:
                self._reply()
            elif frame == 0:
                self.failure = f"ArduPilot has begun anew: frame 0 after frame {self._frame}"
                return None
        self.failure = f"ArduPilot has sent {MOST_PACKETS} packets, but no next frame"
        return None

    def line(self, step: Step) -> bytes:
        """What ArduPilot is told of a step."""
        row = step.truth
        place = float(row.lat[0]), float(row.lon[0]), float(row.h[0])
        self._home = self._home or place
        if (speed := step.first(AirspeedSample)) is not None:
            self._airspeed = speed.eas * math.sqrt(SEA_LEVEL_DENSITY / float(isa_density(place[2])))
        said = {
            "timestamp": round(step.t, DIGITS),
            "imu": {"gyro": _list(step.gyro), "accel_body": _list(step.accel)},
            "position": _list(_metres(*place, *self._home)),
            "attitude": _list(np.array(euler_from_quat(row.q_nb[0]))),
            "velocity": _list(row.v_n[0]),
            "no_time_sync": 1,  # else ArduPilot holds itself to the wall clock; a number, it reads no words
        }
        if self._airspeed is not None:
            said["airspeed"] = round(self._airspeed, DIGITS)
        return b"\n" + json.dumps(said, separators=(",", ":")).encode() + b"\n"


def _metres(lat: float, lon: float, h: float, lat0: float, lon0: float, h0: float) -> np.ndarray:
    """North, east, down [m] of a place from another, with which ArduPilot's arithmetic leads there again.

    Its Earth is a sphere: true metres would be 0.1 to 0.6 % short of where its GNSS, its mission and our fixes are.
    """
    east = (lon - lon0 + math.pi) % (2 * math.pi) - math.pi
    return np.array([RADIUS_M * (lat - lat0), RADIUS_M * math.cos(0.5 * (lat + lat0)) * east, h0 - h])


def _list(values: np.ndarray) -> list[float]:
    return [round(float(value), DIGITS) for value in values]


def _frame_of(data: bytes) -> int | None:
    """The frame's count in a packet of servo outputs, None when it is none."""
    if len(data) < _HEAD.size:
        return None
    magic, _, count = _HEAD.unpack_from(data)
    if magic not in CHANNELS or len(data) != _HEAD.size + 2 * CHANNELS[magic]:
        return None
    return int(count)
