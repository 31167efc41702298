"""Between a run and its ground stations: sends what is due, hears what is asked, hands over what concerns the run."""

from __future__ import annotations

import contextlib
import datetime
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from nav.columns import Estimates
from nav.samples import Array, Sample, Status
from testbed.feeds.log import SAMPLES
from testbed.loop.links import Stretch
from testbed.loop.requests import Request
from testbed.loop.settings import settings
from testbed.mavlink import estimates, messages, mission
from testbed.mavlink.answers import Answers, Talk, Vehicle
from testbed.mavlink.encode import Fields, microseconds
from testbed.mavlink.hearing import Hearing, Inertial
from testbed.mavlink.history import History, Said, Speech
from testbed.mavlink.identity import identity_of
from testbed.mavlink.link import Link, Station, TelemetryLog, connect_all
from testbed.mavlink.parameters import Parameters
from testbed.mavlink.signing import Signing
from testbed.mavlink.snapshot import Moments, known_points
from testbed.mavlink.stream import BESIDE_VEHICLES, OTHERS_HZ, PUBLISH_HZ, STREAMS, VEHICLE_STREAMS, Schedule, Stream
from testbed.mavlink.verdicts import NOBODY, ShutOut, Verdicts
from testbed.scenario import Scenario
from testbed.sensors.imu import ImuConfig
from testbed.sensors.timing import patience

HEARD_A_TURN = 4096  # bytes that are taken from each link at a time; the rest waits, or is lost
HEARTBEAT_S = 0.95  # of wall time: stations hold the link for lost after 3.5 s
_TOO_SOON_S = 0.1  # after a heartbeat by the wall clock, for one by the run's
MOST_VEHICLES = 254


@dataclass(frozen=True, slots=True)
class _Spoken:
    """What a vehicle says in a stretch, and how it is put."""

    answers: Answers
    schedule: Schedule
    moments: Moments
    said: Said


class MavlinkPublisher:
    """The vehicle that ground stations see: fixed wing, system 1 component 1, on a mode of its own.

    It is handed rows of a run that are `period_s` apart and sends what is due to every station and log. A
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
        self._first = _first_of(scenario)
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
        self._homes: dict[int, Array] = {}  # by system
        self._health: tuple[int, int] | None = None
        self._health_of: dict[str, int] = {}  # what it was worked out from
        self._heard: Mapping[str, Sample] = {}
        self._inertial = Inertial()
        self._verdicts = Verdicts()
        self._shut_out: ShutOut = NOBODY
        vehicle = Vehicle(self._identity, self._parameters, self._items, self._streams)
        self._main = Answers(vehicle, self._scenario, self._readonly)
        for talk in self._talks.values():
            talk.lists.clear()

    def publish(self, rows: Stretch) -> None:
        """Send what is due in these rows. Estimates beside the shown ones are needed every `others_every` rows."""
        if rows.truth["t"][0] < self._t:
            self._begin()
        self._t = float(rows.truth["t"][-1])
        with np.errstate(all="ignore"):  # an estimate may be anything; the encoder copes
            moments = self._moments(rows)
            told = [*self._isolations(moments), *self._reached(moments), *self._health_changed(moments)]
            said = sorted(told, key=lambda one: one[0])
            self._shut_out = moments.shut_out[-1]
            vehicles = [_Spoken(self._main, self._schedule, moments, said)]
            if self._vehicles:
                vehicles += self._beside_of(moments, rows)
            self._send(vehicles)
        self._calls += len(rows)

    def _moments(self, rows: Stretch) -> Moments:
        """The rows as the shown vehicle has them."""
        t = rows.truth["t"]
        hearing = Hearing(self._heard, rows.samples, t, self._silent_s, self._first)
        self._heard = hearing.last()
        ratios, shut_out = self._verdicts.read(rows.reports, len(rows))
        return Moments(
            rows.ticks,
            rows.truth,
            rows.estimates,
            rows.others,
            *self._inertial.read(rows.imu, t),
            hearing,
            self._home(1, rows.estimates),
            ratios,
            shut_out,
            self._legs,
            self._identity,
            self._start_us,
        )

    def _home(self, system: int, estimates: Estimates) -> Array:
        """Where a vehicle first knew its position (N, 3), NaN before."""
        homes = np.full((len(estimates), 3), math.nan)
        points = known_points(estimates)
        first = 0 if system in self._homes else next(iter(np.flatnonzero(np.isfinite(points[:, 0])).tolist()), None)
        if first is not None:
            homes[first:] = self._homes.setdefault(system, points[first])
        return homes

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
        said = [(0, "STATUSTEXT", fields) for fields in self._text(severity, text)]
        if self._logs and self._history.add(self._stamps([t]), [Speech(self._main.encoder.system, said)]):
            self._write()
        frames = [self._main.encoder.frame(message, fields) for _, message, fields in said if self._links]
        for link in self._links:
            for station in link.stations:
                self._talk(station).flush(station, frames)

    def _text(self, severity: str, text: str) -> list[Fields]:
        chunks = messages.statustext(severity, text, self._long_texts)
        self._long_texts += len(chunks) > 1
        return chunks

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

    def _send(self, vehicles: Sequence[_Spoken]) -> None:
        """Send what vehicles have said in a stretch, and what is due.

        Logs have the usual rates and numbers that are the run's alone, stations what they have asked for.
        """
        count = len(vehicles[0].moments)
        stamps = self._stamps(vehicles[0].moments.truth["t"].tolist())
        if self._logs:
            calls = self._calls + np.arange(count)
            speeches = [
                Speech(one.answers.encoder.system, one.said, one.moments, one.schedule.usual(calls)) for one in vehicles
            ]
            if self._history.add(stamps, speeches):
                self._write()
        for row in range(count if self._links else 0):
            self._beats(self._calls + row)
            for one in vehicles:
                self._send_row(row, one)
        for one in vehicles:
            one.answers.snapshot = one.moments.snapshot(count - 1)

    def _send_row(self, row: int, one: _Spoken) -> None:
        """Send stations what a vehicle says in one row."""
        answers = one.answers
        answers.snapshot = one.moments.snapshot(row)
        made: dict[Stream, bytes | None] = {}
        first = [answers.encoder.frame(message, fields) for at, message, fields in one.said if at == row]
        for link in self._links:
            for station in link.stations:
                talk = self._talk(station)
                rates = {**talk.rates[answers.encoder.system], **self._quiet}
                streams = one.schedule.due(self._calls + row, rates)
                for stream in streams:
                    if stream not in made:
                        made[stream] = answers.frame(stream)
                talk.flush(station, [*first, *(found for stream in streams if (found := made[stream]) is not None)])

    def _stamps(self, times: Sequence[float]) -> list[int]:
        """Microseconds since 1970 for a log, that never go back: events tell of times before the last row."""
        stamps = []
        for t in times:
            self._sent_us = max(self._sent_us, self._start_us + microseconds(t))
            stamps.append(self._sent_us)
        return stamps

    def _write(self) -> None:
        """Hand the logs what was kept for them."""
        with np.errstate(all="ignore"):
            data = self._history.take()
        for log in self._logs if data else ():
            log.write(data)

    def _beats(self, call: int) -> None:
        """See to it that no heartbeat follows one by the wall clock at once."""
        self._quiet = {}
        if call % PUBLISH_HZ == 0:
            now = time.monotonic()
            if now - self._heartbeat_at < _TOO_SOON_S:
                self._quiet = {"HEARTBEAT": 0.0}
            else:
                self._heartbeat_at = now

    def _beside_of(self, moments: Moments, rows: Stretch) -> list[_Spoken]:
        """Truth and the other estimators as vehicles of their own, each with its home and without the plan."""
        own = [("truth", _as_estimates(rows.truth))]
        own += [(one.name, one.estimates[one.at.tolist()]) for one in rows.others]
        own = own[: MOST_VEHICLES - 1]
        if not self._beside:
            for system, (name, _) in enumerate(own, 2):
                facts = {name: (system, text) for name, (_, text) in list(self._identity.facts.items())[:1]}
                parameters = Parameters(facts, {}, self._identity.byte_wise)
                vehicle = Vehicle(self._identity, parameters, streams=VEHICLE_STREAMS, system=system)
                self._beside.append(Answers(vehicle, readonly=True))
                self.event(float(rows.truth["t"][0]), "info", f"system {system} is {name}")
        spoken = []
        for answers, (_, estimates_) in zip(self._beside, own, strict=True):
            gyro = rows.truth["omega_b"] + estimates_.gyro_bias
            home = self._home(answers.encoder.system, estimates_)
            there = replace(moments, estimates=estimates_, others=(), gyro=gyro, home=home, legs=0)
            spoken.append(_Spoken(answers, self._beside_schedule, there, ()))
        return spoken

    def _isolations(self, moments: Moments) -> Iterator[tuple[int, str, Fields]]:
        """STATUSTEXT of which sensors the shown estimator has shut out, and which it has let in again."""
        before = self._shut_out
        for row, now in enumerate(moments.shut_out):
            if now is not before:
                for sensor in sorted(now.isolated - before.isolated):
                    yield from ((row, "STATUSTEXT", one) for one in self._text("warning", f"{sensor} isolated"))
                for sensor in sorted(before.isolated - now.isolated):
                    yield from ((row, "STATUSTEXT", one) for one in self._text("info", f"{sensor} no longer isolated"))
            before = now

    def _reached(self, moments: Moments) -> Iterator[tuple[int, str, Fields]]:
        """MISSION_ITEM_REACHED where a leg has ended."""
        legs = moments.truth["leg"]
        before = np.concatenate(([self._leg], legs[:-1]))
        self._leg = float(legs[-1])
        for row in np.flatnonzero((before != legs) & (before >= 0) & (before < self._legs)).tolist():
            yield row, "MISSION_ITEM_REACHED", {"seq": int(before[row]) + self._identity.home_first}

    def _health_changed(self, moments: Moments) -> Iterator[tuple[int, str, Fields]]:
        """What tells health, at once when it changes; a heartbeat after it, which is when MAVSDK passes it on."""
        for row in self._health_rows(moments):
            snapshot = moments.snapshot(row)
            before, self._health = self._health, (messages.health(snapshot), estimates.ekf_flags(snapshot))
            if before not in (None, self._health):
                self._heartbeat_at = -math.inf
                yield row, "SYS_STATUS", messages.sys_status(snapshot)
                yield row, "EKF_STATUS_REPORT", estimates.ekf_status_report(snapshot)

    def _health_rows(self, moments: Moments) -> list[int]:
        """The rows at which something has changed that health is worked out from."""
        columns: dict[str, npt.NDArray[np.int64]] = {
            **{f"sensor {name}": codes for name, codes in moments.hearing.codes().items()},
            "status": moments.estimates.status,
            "inertial": np.asarray(np.isfinite(np.hstack([moments.gyro, moments.accel])).all(axis=1), np.int64),
        }
        before = [self._shut_out, *moments.shut_out]
        changed = np.array([now is not last for now, last in zip(moments.shut_out, before, strict=False)])
        changed[0] |= self._health is None
        for name, column in columns.items():
            changed |= column != [self._health_of.get(name, 0), *column[:-1]]
            self._health_of[name] = int(column[-1])
        return [int(row) for row in np.flatnonzero(changed)]


def _first_of(scenario: Scenario) -> dict[type[Sample], str]:
    """The first sensor of each kind in the order of the scenario; of what own sensors measure none is known yet."""
    found: dict[type[Sample], str] = {}
    for name, config in scenario.sensors.items():
        if config.kind in SAMPLES:
            found.setdefault(SAMPLES[config.kind], name)
    return found


def _as_estimates(truth: Mapping[str, Array]) -> Estimates:
    """Truth as estimates without error."""
    count = len(truth["t"])
    none = np.zeros((count, 3))
    return Estimates(
        t=truth["t"],
        lat=truth["lat"],
        lon=truth["lon"],
        h=truth["h"],
        v_n=truth["v_n"],
        q_nb=truth["q_nb"],
        gyro_bias=none,
        accel_bias=none,
        covariance=np.zeros((count, 9, 9)),
        sigma_gyro_bias=none,
        sigma_accel_bias=none,
        status=np.full(count, int(Status.ALIGNED | Status.GNSS_FUSED)),
    )
