"""What a vehicle says of its own motion over MAVLink, put together as estimates at any time.

Attitude comes from ATTITUDE_QUATERNION or ODOMETRY, position from GLOBAL_POSITION_INT, velocity from
LOCAL_POSITION_NED (GLOBAL_POSITION_INT, to 1 cm/s, where that is not sent), variances from ODOMETRY; where that is
not sent those of the position from ESTIMATOR_STATUS. Each message counts at its own stamp, so that it does not matter
when and in which order messages arrive; between two of them, at most `LONGEST_GAP_S` apart, values are
interpolated. Where any of the three is missing, nothing is known. What is no number, no rotation or of another
component is passed over.

Sources: MAVLink common messages; PX4-Autopilot 1.16, src/modules/mavlink/streams: the covariance of ODOMETRY's
rotation is in body axes, that of its velocity in ``child_frame_id``.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from pymavlink.dialects.v20 import all as dialect  # type: ignore[import-untyped]

from nav.rotation import dcm_from_quat
from nav.samples import Array, Estimate
from testbed.mavlink.receive import Message, Reader

LONGEST_GAP_S = 0.5  # between two messages that are interpolated
LONGEST_HELD_S = 2.0  # that variances hold
ROTATION_TOLERANCE = 0.01  # of the norm of a quaternion
POSE_DIAGONAL, VELOCITY_DIAGONAL = (0, 6, 11, 15, 18, 20), (0, 6, 11)  # in the upper triangle of a 6 x 6 matrix


@dataclass(slots=True)
class _Series:
    """Rows of numbers by their stamps [us]; of one stamp the last counts."""

    rows: dict[int, Array] = field(default_factory=dict)
    _stamps: list[int] = field(default_factory=list)

    def settle(self, since: float) -> None:
        """Bring the stamps in order from one on, once all is there."""
        self._stamps = sorted(stamp for stamp in self.rows if stamp >= since)

    def between(self, stamp: float) -> Array | None:
        """Interpolated; None beyond the ends and in gaps."""
        k = bisect_left(self._stamps, stamp)
        if k < len(self._stamps) and self._stamps[k] == stamp:
            return self.rows[self._stamps[k]]
        if not 0 < k < len(self._stamps) or self._stamps[k] - self._stamps[k - 1] > LONGEST_GAP_S * 1e6:
            return None
        before, after = self._stamps[k - 1 : k + 1]
        share = (stamp - before) / (after - before)
        mixed: Array = (1 - share) * self.rows[before] + share * self.rows[after]
        return mixed

    def held(self, stamp: float) -> Array | None:
        """The last one before; None when that is long ago."""
        k = bisect_right(self._stamps, stamp) - 1
        if k < 0 or stamp - self._stamps[k] > LONGEST_HELD_S * 1e6:
            return None
        return self.rows[self._stamps[k]]


class VehicleState:
    """What one vehicle says of itself; ``armed`` is whether it is."""

    def __init__(self) -> None:
        self._attitude, self._odometry, self._position = _Series(), _Series(), _Series()
        self._coarse, self._fine, self._pose, self._accuracy = _Series(), _Series(), _Series(), _Series()
        self.armed = False
        self._take: Mapping[str, Callable[[Message], None]] = {
            "HEARTBEAT": self._take_heartbeat,
            "ATTITUDE_QUATERNION": self._take_attitude,
            "GLOBAL_POSITION_INT": self._take_position,
            "LOCAL_POSITION_NED": self._take_velocity,
            "ODOMETRY": self._take_odometry,
            "ESTIMATOR_STATUS": self._take_accuracy,
        }

    def hear(self, datagram: bytes, system: int) -> bool:
        """Take what the autopilot of a ``system`` says in it; whether it said anything."""
        own = [
            message
            for message in Reader().read(datagram, whole=True)
            if (message.system, message.component) == (system, dialect.MAV_COMP_ID_AUTOPILOT1)
        ]
        for message in own:
            take = self._take.get(message.name)
            if take is not None:
                take(message)
        return bool(own)

    @property
    def placed(self) -> bool:
        """Whether it has said an attitude and a position."""
        return bool(self._position.rows and (self._attitude.rows or self._odometry.rows))

    @property
    def moving(self) -> bool:
        """Whether it has said a velocity too, which ArduPilot does only once it knows where it is."""
        return self.placed and bool(self._fine.rows)

    def estimates(self, times: Sequence[float], boot: float) -> Iterator[Estimate]:
        """The estimates at ``times`` [s] of a clock that says ``boot`` when the vehicle's says zero."""
        attitude = self._attitude if self._attitude.rows else self._odometry
        velocity = self._fine if self._fine.rows else self._coarse
        for series in (attitude, velocity, self._position, self._pose, self._accuracy):
            series.settle(-1e6 * boot)  # before the run began, it stood still
        _shortest_way(attitude)
        for t in times:
            stamp = (t - boot) * 1e6
            q_nb, lla, v_n = attitude.between(stamp), self._position.between(stamp), velocity.between(stamp)
            if q_nb is None or lla is None or v_n is None:
                yield Estimate.of(t)
                continue
            q_nb = q_nb / np.linalg.norm(q_nb)
            yield Estimate.of(t, q_nb=q_nb, lla=lla, v_n=v_n, covariance=self._covariance(stamp))

    def _covariance(self, stamp: float) -> Array:
        """That of position, velocity and attitude error (9, 9), NaN as far as it is not told."""
        if (told := self._pose.held(stamp)) is not None:
            return told.reshape(9, 9)
        covariance = np.full((9, 9), np.nan)
        if (position := self._accuracy.held(stamp)) is not None:
            covariance[:3, :3] = np.diag(position)
        return covariance

    def _take_heartbeat(self, message: Message) -> None:
        self.armed = bool(message["base_mode"] & dialect.MAV_MODE_FLAG_SAFETY_ARMED)

    def _take_attitude(self, message: Message) -> None:
        q_nb = _rotation([message[key] for key in ("q1", "q2", "q3", "q4")])
        if q_nb is not None:
            self._attitude.rows[1000 * message["time_boot_ms"]] = q_nb

    def _take_position(self, message: Message) -> None:
        stamp = 1000 * message["time_boot_ms"]
        lat, lon = (math.radians(message[key] / 1e7) for key in ("lat", "lon"))
        self._position.rows[stamp] = np.array([lat, lon, message["alt"] / 1e3])
        self._coarse.rows[stamp] = np.array([message[key] / 100 for key in ("vx", "vy", "vz")])

    def _take_velocity(self, message: Message) -> None:
        v_n = np.array([message[key] for key in ("vx", "vy", "vz")])
        if np.isfinite(v_n).all():
            self._fine.rows[1000 * message["time_boot_ms"]] = v_n

    def _take_odometry(self, message: Message) -> None:
        q_nb = _rotation(message["q"])
        if q_nb is None or message["frame_id"] != dialect.MAV_FRAME_LOCAL_NED:
            return
        self._odometry.rows[message["time_usec"]] = q_nb
        pose = np.array(message["pose_covariance"])[list(POSE_DIAGONAL)]
        speed = np.array(message["velocity_covariance"])[list(VELOCITY_DIAGONAL)]
        variances = np.concatenate([pose, speed])
        if not (np.isfinite(variances) & (variances > 0)).all():
            return
        C_nb = dcm_from_quat(q_nb)
        C_nv = C_nb if message["child_frame_id"] == dialect.MAV_FRAME_BODY_FRD else np.eye(3)
        covariance = np.zeros((9, 9))
        covariance[:3, :3] = np.diag(pose[:3])
        covariance[3:6, 3:6] = C_nv @ np.diag(speed) @ C_nv.T
        covariance[6:, 6:] = C_nb @ np.diag(pose[3:]) @ C_nb.T
        self._pose.rows[message["time_usec"]] = covariance.ravel()

    def _take_accuracy(self, message: Message) -> None:
        level, down = message["pos_horiz_accuracy"], message["pos_vert_accuracy"]
        if math.isfinite(level) and math.isfinite(down) and level > 0 and down > 0:
            self._accuracy.rows[message["time_usec"]] = np.array([level**2 / 2, level**2 / 2, down**2])


def _rotation(numbers: Sequence[float]) -> Array | None:
    """A unit quaternion, None where it is none."""
    q_nb = np.array(numbers, dtype=float)
    norm = float(np.linalg.norm(q_nb))
    return q_nb / norm if abs(norm - 1) < ROTATION_TOLERANCE else None


def _shortest_way(attitude: _Series) -> None:
    """Give quaternions the signs with which neighbours can be interpolated."""
    for before, after in pairwise(sorted(attitude.rows)):
        if attitude.rows[before] @ attitude.rows[after] < 0:
            attitude.rows[after] = -attitude.rows[after]
