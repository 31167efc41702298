"""What goes out when: a vehicle's messages at their rates, counted in simulated time."""

from __future__ import annotations

import contextlib
import datetime
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from nav.samples import Array, Estimate, ImuSamples, Sample, UpdateReport
from testbed.control import Request
from testbed.mavlink import messages
from testbed.mavlink.encode import Encoder, Fields, microseconds
from testbed.mavlink.link import connect_all
from testbed.mavlink.messages import Point, Snapshot
from testbed.truth import TruthBlock

PUBLISH_HZ = 25


@dataclass(frozen=True, slots=True)
class Stream:
    """A message, its mean rate [Hz], and the function that fills it."""

    message: str
    rate_hz: float
    fields: Callable[[Snapshot], Fields | None]


STREAMS = (
    Stream("HEARTBEAT", 1, messages.heartbeat),
    Stream("SYSTEM_TIME", 1, messages.system_time),
    Stream("SYS_STATUS", 1, messages.sys_status),
    Stream("EXTENDED_SYS_STATE", 1, messages.extended_sys_state),
    Stream("HOME_POSITION", 0.5, messages.home_position),
    Stream("ATTITUDE", 25, messages.attitude),
    Stream("ATTITUDE_QUATERNION", 10, messages.attitude_quaternion),
    Stream("GLOBAL_POSITION_INT", 10, messages.global_position_int),
    Stream("LOCAL_POSITION_NED", 10, messages.local_position_ned),
    Stream("VFR_HUD", 5, messages.vfr_hud),
    Stream("ODOMETRY", 5, messages.odometry),
    Stream("ALTITUDE", 2, messages.altitude),
    Stream("WIND_COV", 1, messages.wind_cov),
    Stream("ESTIMATOR_STATUS", 2, messages.estimator_status),
    Stream("EKF_STATUS_REPORT", 1, messages.ekf_status_report),
    Stream("GPS_RAW_INT", 5, messages.gps_raw_int),
    Stream("GNSS_INTEGRITY", 1, messages.gnss_integrity),
    Stream("HIGHRES_IMU", 10, messages.highres_imu),
    Stream("SCALED_PRESSURE", 1, messages.scaled_pressure),
    Stream("HIL_STATE_QUATERNION", 10, messages.hil_state_quaternion),
    Stream("SIMSTATE", 5, messages.simstate),
    Stream("SIM_STATE", 1, messages.sim_state),
    Stream("AHRS2", 5, messages.ahrs2),
    Stream("AHRS3", 5, messages.ahrs3),
    *(
        Stream("NAMED_VALUE_FLOAT", 1, partial(messages.error, name))
        for name in ("err_horiz", "err_down", "err_vel", "err_tilt", "err_head", "sig_horiz")
    ),
)

# The streams of each call over two seconds, after which the pattern repeats: the slowest is sent every two seconds.
_PATTERN = [
    [stream for stream in STREAMS if call * stream.rate_hz % PUBLISH_HZ < stream.rate_hz]
    for call in range(2 * PUBLISH_HZ)
]


class MavlinkPublisher:
    """The vehicle that a ground station sees: PX4 identity, fixed wing, in Hold, system 1 component 1.

    It is handed a row of a run every `period_s` of simulated time and sends what is due to every link. Its clock is
    the run's: with the same run, a telemetry log has the same bytes.
    """

    period_s = 1 / PUBLISH_HZ

    def __init__(self, urls: Sequence[str], date: datetime.date) -> None:
        """Open ``urls`` (see `testbed.mavlink.link`); the run starts at midnight UTC of ``date``.

        Raises UserError when an address is wrong or can't be had; then nothing stays open.
        """
        midnight = datetime.datetime.combine(date, datetime.time(), datetime.UTC)
        self._start_us = int(midnight.timestamp()) * 10**6
        self._sent_us = 0
        self._encoder = Encoder()
        self._calls = 0
        self._long_texts = 0
        self._home: Point | None = None
        self._imu_before: ImuSamples | None = None
        self._gyro: Array = np.full(3, math.nan)
        self._accel: Array = np.full(3, math.nan)
        self._ratios: dict[str, float] = {}
        self._links = connect_all(urls)

    def publish(
        self,
        truth: TruthBlock,
        estimate: Estimate,
        samples: Mapping[str, Sample],
        imu: ImuSamples | None,
        others: Sequence[tuple[str, Estimate]],
        reports: Sequence[UpdateReport] = (),
    ) -> None:
        """Send what is due at the time of ``truth`` (one row).

        ``samples`` is the newest of each sensor, ``imu`` increments around now (those up to now are used), ``others``
        the estimates shown beside this one, ``reports`` this estimator's updates since the last call.
        """
        with np.errstate(all="ignore"):  # an estimate may be anything; the encoder copes
            self._read_imu(imu, float(truth.t[0]))
            for report in reports:
                ratio = float(np.float64(report.nis) / report.threshold)
                self._ratios[report.aid] = math.sqrt(ratio) if ratio >= 0 else math.nan
            if self._home is None:
                self._home = messages.known_point(estimate)
            snapshot = Snapshot(
                truth,
                estimate,
                samples,
                self._gyro,
                self._accel,
                others,
                self._home,
                self._start_us,
                self._ratios,
            )
            frames = []
            for stream in _PATTERN[self._calls % len(_PATTERN)]:
                fields = stream.fields(snapshot)
                if fields is not None:
                    frames.append(self._encoder.frame(stream.message, fields))
        self._calls += 1
        self._send(snapshot.t, frames)

    def requests(self) -> Sequence[Request]:
        """What stations ask of the run: nothing yet."""
        return ()

    def event(self, t: float, severity: str, text: str) -> None:
        """Say ``text`` as STATUSTEXT; severity is info, warning or error."""
        chunks = messages.statustext(severity, text, self._long_texts)
        self._long_texts += len(chunks) > 1
        self._send(t, [self._encoder.frame("STATUSTEXT", chunk) for chunk in chunks])

    def close(self) -> None:
        """Close every link; harmless when done twice."""
        with contextlib.ExitStack() as stack:
            for link in self._links:
                stack.callback(link.close)

    def _send(self, t: float, frames: Sequence[bytes]) -> None:
        self._sent_us = max(self._sent_us, self._start_us + microseconds(t))  # events tell of times before the last row
        for link in self._links:
            link.send(self._sent_us, frames)

    def _read_imu(self, imu: ImuSamples | None, t: float) -> None:
        """Take the newest increment up to ``t``: with an IMU slower than the calls it may be in the block before."""
        for block in (imu, self._imu_before):
            newest = int(block.t.searchsorted(t + 1e-6)) - 1 if block is not None else -1
            if block is not None and newest >= 0:
                self._gyro = block.dtheta[newest] / block.dt[newest]
                self._accel = block.dv[newest] / block.dt[newest]
                break
        self._imu_before = imu
