"""Between a run and its ground stations: sends what is due, hears what is asked, hands over what concerns the run."""

from __future__ import annotations

import contextlib
import datetime
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np

from nav.samples import Array, Estimate, ImuSamples, Outcome, Sample, Status, UpdateReport
from testbed.loop.requests import Request
from testbed.loop.settings import settings
from testbed.mavlink import estimates, messages, mission
from testbed.mavlink.answers import Answers, Talk, Vehicle
from testbed.mavlink.encode import Fields, microseconds
from testbed.mavlink.history import History
from testbed.mavlink.identity import identity_of
from testbed.mavlink.link import Link, Station, TelemetryLog, connect_all
from testbed.mavlink.parameters import Parameters
from testbed.mavlink.signing import Signing
from testbed.mavlink.snapshot import Heard, Point, Snapshot, known_point
from testbed.mavlink.stream import BESIDE_VEHICLES, OTHERS_HZ, PUBLISH_HZ, STREAMS, VEHICLE_STREAMS, Schedule, Stream
from testbed.motion.table import TruthBlock
from testbed.scenario import Scenario
from testbed.sensors.imu import ImuConfig
from testbed.sensors.timing import patience

HEARD_A_TURN = 4096  # bytes that are taken from each link at a time; the rest waits, or is lost
HEARTBEAT_S = 0.95  # of wall time: stations hold the link for lost after 3.5 s
_TOO_SOON_S = 0.1  # after a heartbeat by the wall clock, for one by the run's
REFUSED = 10  # samples of a receiver in a row, before it is held for spoofed
MOST_VEHICLES = 254


class MavlinkPublisher:
    """The vehicle that ground stations see: fixed wing, system 1 component 1, on a mode of its own.

    It is handed a row of a run every `period_s` of simulated time and sends what is due to every station and log. A
    telemetry log holds what goes out by itself, at the usual rates: with the same run it has the same bytes, whatever
    stations ask. Answers, and heartbeats by the wall clock, go to stations only.
    """

    period_s = 1 / PUBLISH_HZ

    def __init__(
        self,
        urls: Sequence[str],
        scenario: Scenario,
        *,
        identity: str = "px4",
        readonly: bool = False,
        key: str | None = None,
        vehicles: bool = False,
    ) -> None:
        """Open ``urls`` (see `testbed.mavlink.link`); the run starts at midnight UTC of the scenario's date.

        ``identity`` is one of `testbed.mavlink.identity.IDENTITIES`. ``readonly`` denies what would change the run.
        With a ``key`` (see `testbed.mavlink.signing.key_bytes`) what is not signed with it is not heard, and what goes
        to stations is signed. ``vehicles`` shows truth, system 2, and the other estimators, from 3 on, as vehicles.
        Raises UserError when an address, the identity or the key is wrong or can't be had; then nothing stays open.
        """
        midnight = datetime.datetime.combine(scenario.date, datetime.time(), datetime.UTC)
        self._start_us = int(midnight.timestamp()) * 10**6
        self._sent_us = 0
        self._identity = identity_of(identity)
        self._signing = Signing(key) if key is not None else None
        self._parameters = Parameters(self._identity.facts, settings(scenario), self._identity.byte_wise)
        self._in_force: Mapping[str, float] = {}
        self._items = mission.items(scenario, self._identity.home_first)
        self._legs = len(self._items) - (self._identity.home_first and len(self._items) > 0)
        self._silent_s = {
            name: patience(config.rate_hz)
            for name, config in scenario.sensors.items()
            if not isinstance(config, ImuConfig)
        }
        self._streams = BESIDE_VEHICLES if vehicles else STREAMS
        self._schedule = Schedule(self._streams)
        self._history = History()
        self._long_texts = 0
        self._vehicles = vehicles
        self._beside: list[Answers] = []  # truth and the other estimators, when they are vehicles
        self._beside_schedule = Schedule(VEHICLE_STREAMS)
        self._heartbeat_at = -math.inf
        self._quiet: dict[str, float] = {}
        self._talks: WeakKeyDictionary[Station, Talk] = WeakKeyDictionary()
        self._readonly = readonly
        self._scenario = scenario
        self._begin()
        self._logs: list[TelemetryLog] = []
        self._links: list[Link] = []
        for link in connect_all(urls):
            if isinstance(link, TelemetryLog):
                self._logs.append(link)
            else:
                self._links.append(link)
        self.asks = bool(self._links)
        # Stations may ask for other rates at any time, and a log is at the usual ones.
        self.others_every = 1 if self._links or vehicles else PUBLISH_HZ // OTHERS_HZ

    def _begin(self) -> None:
        """Forget what was of a run, for another to begin."""
        self._t = -math.inf
        self._calls = 0
        self._leg = -1.0
        self._home: Point | None = None
        self._health: tuple[int, int] | None = None
        self._health_of: tuple[object, ...] = ()  # what it was worked out from
        self._heard: Heard | None = None
        self._imu: ImuSamples | None = None
        self._readings: list[_Readings] = []  # of the newest increments, and of those before
        self._gyro: Array = np.full(3, math.nan)
        self._accel: Array = np.full(3, math.nan)
        self._ratios: dict[str, float] = {}
        self._refused: dict[tuple[str, str], int] = {}  # samples in a row, by sensor and aid
        self._isolated: set[tuple[str, str]] = set()
        self._shut_out: tuple[frozenset[str], frozenset[str]] = (frozenset(), frozenset())  # sensors, of both
        self._told: frozenset[str] = frozenset()  # isolations
        vehicle = Vehicle(self._identity, self._parameters, self._items, self._streams)
        self._main = Answers(vehicle, self._scenario, self._readonly)
        for talk in self._talks.values():
            talk.lists.clear()

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
        the estimates shown beside this one, needed every `others_every` calls, ``reports`` this estimator's updates
        since the last call.
        """
        t = float(truth.t[0])
        if t < self._t:
            self._begin()
        self._t = t
        self._beats()
        with np.errstate(all="ignore"):  # an estimate may be anything; the encoder copes
            self._read_imu(imu, t)
            for report in reports:
                self._read_report(report)
            if reports:
                self._shut_out = (
                    frozenset(sensor for sensor, _ in self._isolated),
                    frozenset(sensor for (sensor, _), count in self._refused.items() if count >= REFUSED),
                )
            if self._heard is None or not self._heard.holds(samples, t):
                self._heard = Heard(samples, t, self._silent_s)
            if self._home is None:
                self._home = known_point(estimate)
            snapshot = Snapshot(
                truth,
                estimate,
                self._heard,
                self._gyro,
                self._accel,
                others,
                self._home,
                self._start_us,
                dict(self._ratios),
                self._identity,
                self._legs,
                *self._shut_out,
            )
            self._tell_isolations(t, snapshot.isolated)
            self._main.snapshot = snapshot
            said = [*self._reached(snapshot), *self._health_changed(snapshot)]
            self._send(t, said, self._main, self._schedule)
            if self._vehicles:
                self._send_beside(snapshot)
        self._calls += 1

    def requests(self) -> Sequence[Request]:
        """Answer what stations have asked since the last call, and give what concerns the run; never waits."""
        for link in self._links:
            for station, data in link.receive(HEARD_A_TURN):
                talk = self._talk(station)
                for message in talk.hear(station, data):
                    for vehicle in (self._main, *self._beside):
                        vehicle.answer(message, talk)
        due = time.monotonic() - self._heartbeat_at > HEARTBEAT_S
        heartbeats = [vehicle.heartbeat() for vehicle in (self._main, *self._beside)] if due else []
        if due:
            self._heartbeat_at = time.monotonic()
        for link in self._links:
            for station in link.stations:
                talk = self._talk(station)
                for vehicle in (self._main, *self._beside):
                    vehicle.go_on(talk)
                talk.flush(station, heartbeats)
        asked, self._main.asked = self._main.asked, []
        return asked

    def settings(self, values: Mapping[str, float]) -> None:
        """Keep the parameters in force, whoever has changed them, and tell every station of those that differ."""
        for name, value in values.items():
            self._parameters.put(name, value)
            fields = self._parameters.in_force(name)
            if fields and self._in_force and self._in_force.get(name) != value:
                for talk in self._talks.values():
                    talk.due.append(self._main.encoder.frame("PARAM_VALUE", fields))
        self._in_force = dict(values)

    def event(self, t: float, severity: str, text: str) -> None:
        """Say ``text`` as STATUSTEXT; severity is info, warning or error."""
        chunks = messages.statustext(severity, text, self._long_texts)
        self._long_texts += len(chunks) > 1
        self._send(t, [("STATUSTEXT", chunk) for chunk in chunks], self._main)

    def close(self) -> None:
        """Write the rest of the logs and close every link; harmless when done twice."""
        with contextlib.ExitStack() as stack:
            for close in [link.close for link in self._links] + [log.close for log in self._logs]:
                stack.callback(close)
            self._write()

    def _talk(self, station: Station) -> Talk:
        talk = self._talks.get(station)
        if talk is None:
            talk = self._talks[station] = Talk(self._signing)
        return talk

    def _send(
        self, t: float, said: Sequence[tuple[str, Fields]], vehicle: Answers, schedule: Schedule | None = None
    ) -> None:
        """Send what a vehicle has ``said``, and with a ``schedule`` what is due of its snapshot.

        Logs have the usual rates and numbers that are the run's alone, stations what they have asked for.
        """
        self._sent_us = max(self._sent_us, self._start_us + microseconds(t))  # events tell of times before the last row
        if self._logs:
            due = schedule.due(self._calls, {}) if schedule else ()
            if self._history.add(self._sent_us, vehicle.encoder.system, said, vehicle.snapshot, due):
                self._write()
        made: dict[Stream, bytes | None] = {}
        first = [vehicle.encoder.frame(message, fields) for message, fields in said if self._links]
        for link in self._links:
            for station in link.stations:
                talk = self._talk(station)
                rates = {**talk.rates[vehicle.encoder.system], **self._quiet}
                streams = schedule.due(self._calls, rates) if schedule else ()
                for stream in streams:
                    if stream not in made:
                        made[stream] = vehicle.frame(stream)
                talk.flush(station, [*first, *(one for stream in streams if (one := made[stream]) is not None)])

    def _write(self) -> None:
        """Hand the logs what was kept for them."""
        with np.errstate(all="ignore"):
            data = self._history.take()
        for log in self._logs if data else ():
            log.write(data)

    def _beats(self) -> None:
        """See to it that no heartbeat follows one by the wall clock at once."""
        self._quiet = {}
        if self._calls % PUBLISH_HZ == 0:
            now = time.monotonic()
            if now - self._heartbeat_at < _TOO_SOON_S:
                self._quiet = {"HEARTBEAT": 0.0}
            else:
                self._heartbeat_at = now

    def _send_beside(self, shown: Snapshot) -> None:
        """Truth and the other estimators as vehicles of their own, each with its home and without the plan."""
        estimates = [("truth", _as_estimate(shown.truth)), *shown.others][: MOST_VEHICLES - 1]
        if not self._beside:
            for system, (name, _) in enumerate(estimates, 2):
                facts = {name: (system, text) for name, (_, text) in list(self._identity.facts.items())[:1]}
                parameters = Parameters(facts, {}, self._identity.byte_wise)
                vehicle = Vehicle(self._identity, parameters, streams=VEHICLE_STREAMS, system=system)
                self._beside.append(Answers(vehicle, readonly=True))
                self.event(shown.t, "info", f"system {system} is {name}")
        for beside, (_, estimate) in zip(self._beside, estimates, strict=True):
            before = beside.snapshot
            home = before.home if before is not None and before.t <= shown.t else None
            beside.snapshot = replace(
                shown,
                estimate=estimate,
                gyro=shown.truth.omega_b[0] + estimate.gyro_bias,
                others=(),
                home=home or known_point(estimate),
                legs=0,
            )
            self._send(shown.t, [], beside, self._beside_schedule)

    def _tell_isolations(self, t: float, isolated: frozenset[str]) -> None:
        """Say which sensors the shown estimator has shut out since the last call, and which it has let in again."""
        before, self._told = self._told, isolated
        for sensor in sorted(isolated - before):
            self.event(t, "warning", f"{sensor} isolated")
        for sensor in sorted(before - isolated):
            self.event(t, "info", f"{sensor} no longer isolated")

    def _reached(self, snapshot: Snapshot) -> list[tuple[str, Fields]]:
        """MISSION_ITEM_REACHED when a leg has ended."""
        before, self._leg = self._leg, float(snapshot.truth.leg[0])
        if before == self._leg or not 0 <= before < self._legs:
            return []
        number = int(before) + self._identity.home_first
        return [("MISSION_ITEM_REACHED", {"seq": number})]

    def _health_changed(self, snapshot: Snapshot) -> list[tuple[str, Fields]]:
        """What tells health, at once when it changes; a heartbeat after it, which is when MAVSDK passes it on."""
        status, inertial = snapshot.estimate.status, messages.inertial(snapshot)
        depends = snapshot.heard, status, inertial, snapshot.isolated, snapshot.refused
        if depends == self._health_of:
            return []
        self._health_of = depends
        before, self._health = self._health, (messages.health(snapshot), estimates.ekf_flags(snapshot))
        if before in (None, self._health):
            return []
        self._heartbeat_at = -math.inf
        return [
            ("SYS_STATUS", messages.sys_status(snapshot)),
            ("EKF_STATUS_REPORT", estimates.ekf_status_report(snapshot)),
        ]

    def _read_report(self, report: UpdateReport) -> None:
        ratio = float(np.float64(report.nis) / report.threshold)
        self._ratios[report.aid] = math.sqrt(ratio) if ratio >= 0 else math.nan
        part = report.sensor, report.aid
        if report.outcome is Outcome.ISOLATED:
            self._isolated.add(part)
        else:
            self._isolated.discard(part)
        if report.outcome is Outcome.OUTSIDE_GATE:
            self._refused[part] = self._refused.get(part, 0) + 1
        elif report.weight > 0:
            self._refused.pop(part, None)

    def _read_imu(self, imu: ImuSamples | None, t: float) -> None:
        """Take the newest increment up to ``t``: with an IMU slower than the calls it may be in the block before."""
        if imu is not self._imu:
            self._readings = [_Readings(imu), *self._readings[:1]] if imu is not None else []
            self._imu = imu
        for block in self._readings:
            newest = int(block.t.searchsorted(t + 1e-6)) - 1
            if newest >= 0:
                self._gyro, self._accel = block.gyro[newest], block.accel[newest]
                break


class _Readings:
    """Angular rates [rad/s] and specific forces [m/s^2] (N, 3) of increments."""

    def __init__(self, imu: ImuSamples) -> None:
        self.t = imu.t
        self.gyro = imu.dtheta / imu.dt[:, None]
        self.accel = imu.dv / imu.dt[:, None]


def _as_estimate(truth: TruthBlock) -> Estimate:
    """Truth as an estimate without error."""
    none = np.zeros(3)
    return Estimate(
        t=float(truth.t[0]),
        lat=float(truth.lat[0]),
        lon=float(truth.lon[0]),
        h=float(truth.h[0]),
        v_n=truth.v_n[0],
        q_nb=truth.q_nb[0],
        gyro_bias=none,
        accel_bias=none,
        covariance=np.zeros((9, 9)),
        sigma_gyro_bias=none,
        sigma_accel_bias=none,
        status=Status.ALIGNED | Status.GNSS_FUSED,
    )
