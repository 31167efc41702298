"""What is asked of a run while it goes on: what it does, what is recorded of it, and that a rerun has the same bits."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from worlds.loop import same

from nav.samples import FixType
from testbed import Scenario, run
from testbed.errors import UserError
from testbed.loop.director import Director, Restarted, recorded
from testbed.loop.injection import KINDS, UNITS, injection
from testbed.loop.links import Stretch
from testbed.loop.requests import (
    Change,
    Clear,
    End,
    Faster,
    Inject,
    Pause,
    Refused,
    Request,
    Restart,
    Resume,
    Speed,
    Step,
    Toggle,
)
from testbed.loop.settings import settings
from testbed.record import reader as record

HEALTHY = ["sensors.gnss.denied=[]", "expect={}", "truth.wind.turbulence='none'"]
TWICE = [
    "sensors.second_gnss={kind='gnss', rate_hz=5}",
    "sensors.second_imu={kind='imu', grade='mems-industrial', rate_hz=200}",
]


def scenario(seconds: float, *more: str) -> Scenario:
    return Scenario.load("u_turn", [f"duration_s={seconds}", *HEALTHY, *more])


@cache
def healthy_run(seconds: float, *more: str) -> Any:
    """The record when nothing is asked."""
    return run(scenario(seconds, *more)).dataset


class Station:
    """A link that asks for what its script says, each as soon as it has been shown a row of that time or later."""

    asks = True
    others_every = 1

    def __init__(self, script: Sequence[tuple[float, Request]], period_s: float = 0.04) -> None:
        self.script = list(script)
        self.period_s = period_s
        self.t = -1.0
        self.rows: list[float] = []
        self.events: list[tuple[float, str, str]] = []
        self.told_settings: list[dict[str, float]] = []
        self.calls = 0

    def publish(self, rows: Stretch) -> None:
        self.rows += rows.truth["t"].tolist()
        self.t = self.rows[-1]

    def requests(self) -> Sequence[Request]:
        self.calls += 1
        due = [request for t, request in self.script if t <= self.t]
        self.script = self.script[len(due) :]
        return due

    def settings(self, values: Mapping[str, float]) -> None:
        self.told_settings.append(dict(values))

    def event(self, t: float, severity: str, text: str) -> None:
        self.events.append((t, severity, text))

    def close(self) -> None:
        pass

    def told(self) -> list[str]:
        return [text for _, _, text in self.events]


def at(t: float, asked: Sequence[Request]) -> list[tuple[float, Request]]:
    return [(t, request) for request in asked]


# --- what may be asked


@pytest.mark.ci
def test_every_failure_of_every_unit_begins_and_ends() -> None:
    """Each becomes one fault of each instance, and OK leaves the sensors as if nothing had been."""
    pair = scenario(12, *TWICE)
    healthy = healthy_run(12, *TWICE)
    names = {"gnss": ["gnss", "second_gnss"], "gyro": ["imu", "second_imu"], "accelerometer": ["imu", "second_imu"]}
    for kind in KINDS[:-1]:
        asked = [request for unit in UNITS for request in injection(pair, unit, kind)]
        ok = [request for unit in UNITS for request in injection(pair, unit, "ok")]
        data = run(pair, replay=[*((4.0, one) for one in asked), *((8.0, one) for one in ok)]).dataset
        faults = data["faults"]
        expected = [name for unit in UNITS for name in names.get(unit, [unit])]
        assert faults["sensor"].values.tolist() == expected
        assert set(faults["time"].values.tolist()) == {4.0}
        assert set(faults["end"].values.tolist()) == {8.0}
        for sensor in healthy["sensors"].children:
            ours, theirs = data[f"sensors/{sensor}"], healthy[f"sensors/{sensor}"]
            assert alike(ours, theirs, 0.0, 3.999), (kind, sensor)
            assert not alike(ours, theirs, 3.999, 7.999), (kind, sensor)
            assert alike(ours, theirs, 7.999, 12.1), (kind, sensor)


def alike(a: Any, b: Any, start: float, end: float) -> bool:
    """Whether two tables hold the same bits between two times."""

    def within(table: Any) -> list[np.ndarray]:
        t = table["time"].values
        return [column.values[(t >= start) & (t < end)] for column in table.variables.values() if "time" in column.dims]

    return all(np.array_equal(x, y, equal_nan=x.dtype.kind == "f") for x, y in zip(within(a), within(b), strict=True))


def during(kind: str, unit: str) -> tuple[Any, Any]:
    """What the unit delivers from 4 to 8 s when it fails so, and when it does not."""
    short = scenario(8)
    sensor = {"gyro": "imu", "accelerometer": "imu"}.get(unit, unit)
    window = dict(time=slice(3.999, None))
    failed = run(short, replay=at(4.0, injection(short, unit, kind))).dataset[f"sensors/{sensor}"].to_dataset()
    return failed.sel(window), healthy_run(8)[f"sensors/{sensor}"].to_dataset().sel(window)


@pytest.mark.ci
def test_failures_are_what_their_names_say() -> None:
    failed, healthy = during("off", "barometer")
    assert failed.sizes["time"] == 0
    assert healthy.sizes["time"] > 15
    failed, healthy = during("off", "gyro")
    assert np.isnan(failed["dtheta"]).all()
    np.testing.assert_array_equal(failed["dv"], healthy["dv"])
    failed, healthy = during("stuck", "gnss")
    assert (failed["lat"] == healthy["lat"][0]).all()
    assert (failed["v_n"] == healthy["v_n"][0]).all()
    failed, healthy = during("wrong", "airspeed")
    np.testing.assert_allclose(failed["eas"], 0.707 * healthy["eas"])
    failed, healthy = during("wrong", "gyro")
    np.testing.assert_allclose((failed["dtheta"] - healthy["dtheta"]) / 0.005, math.radians(1.0))
    failed, healthy = during("slow", "gnss")
    np.testing.assert_array_equal(failed["time"], healthy["time"][::5])
    failed, healthy = during("slow", "accelerometer")
    np.testing.assert_allclose(failed["dv"], np.repeat(healthy["dv"].values[::5], 5, axis=0)[: failed.sizes["time"]])
    np.testing.assert_array_equal(failed["dtheta"], healthy["dtheta"])
    failed, healthy = during("delayed", "magnetometer")  # at 10 Hz
    np.testing.assert_array_equal(failed["field_b"][5:], healthy["field_b"][:-5])
    failed, healthy = during("intermittent", "barometer")
    np.testing.assert_array_equal(failed["time"], [t for t in healthy["time"].values if 6 <= t < 8])
    failed, _ = during("garbage", "gnss")
    assert not (np.abs(failed["lat"]) < 2).all()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("rotor", "off"), "rotor can't be made to fail: choose from gnss, gyro"),
        (("gnss", "asleep"), "asleep is no way to fail: choose from off, stuck"),
        (("gnss", "off", 2), "there is no gnss 2: choose from 1 to 1, or 0 for all"),
        (("gnss", "off", -1), "there is no gnss -1"),
    ],
)
def test_what_can_not_fail(arguments: tuple[Any, ...], says: str) -> None:
    with pytest.raises(Refused, match=says):
        injection(scenario(5), *arguments)


def test_what_is_not_there_can_not_fail() -> None:
    with pytest.raises(Refused, match="there is no magnetometer"):
        injection(Scenario.parse(WITHOUT_MAGNETOMETER), "magnetometer", "off")


WITHOUT_MAGNETOMETER = """
title = "still"
duration_s = 3
[truth]
source = "kinematic"
start = { lat_deg = 47.0, lon_deg = 8.0, alt_m = 300 }
[sensors.imu]
[sensors.gnss]
[[estimator]]
name = "ins"
aids = ["gnss"]
"""


def test_settings_are_known_by_names_that_fit_the_wire_and_start_as_the_scenario_says() -> None:
    found = settings(scenario(5, *TWICE))
    assert all(len(name) <= 16 and name.isascii() for name in found)
    assert all(one.least <= one.value <= one.most and one.text for one in found.values())
    assert all(one.value == int(one.value) for one in found.values() if one.whole)
    assert (found["SIM_WIND_SPD"].value, found["SIM_WIND_DIR"].value) == (4.0, 300.0)
    assert found["EST1_FALSE_REJ"].value == 1e-3
    assert {"SIM_GPS2_ENABLE", "SIM_ACCEL2_FAIL"} <= found.keys()
    assert found["SIM_GYR_FAIL_MSK"].most == 3
    assert "SIM_WIND_SPD" not in settings(Scenario.parse(WITHOUT_MAGNETOMETER))
    profile = "truth.wind={profile=[[0, 300, 4], [500, 300, 6]]}"
    assert "SIM_WIND_SPD" not in settings(scenario(5, profile))


@pytest.mark.ci
def test_every_setting_does_something_and_what_it_says() -> None:
    """But the speed, which changes no bit: see below."""
    short = scenario(9, "sensors.second_imu={kind='imu', grade='mems-industrial', rate_hz=200}")
    healthy = run(short).dataset
    values = {"SIM_GPS1_ENABLE": 0.0, "SIM_WIND_SPD": 14.0, "SIM_WIND_DIR": 90.0, "EST1_FALSE_REJ": 0.3}
    values |= {"SIM_ARSPD_FAIL": 12.5, "SIM_GPS1_NOISE": 5.0, "SIM_GYR_FAIL_MSK": 2.0, "SIM_ACC_FAIL_MSK": 2.0}
    for name in settings(short).keys() - {"SIM_SPEEDUP"}:
        data = run(short, replay=[(4.0, Change(name, values.get(name, 1.0)))]).dataset
        assert not same(data, healthy), name
        assert f"{name} set to {values.get(name, 1.0):g}" in data["events"]["text"].values
        match name:
            case "SIM_GPS1_ENABLE":
                assert data["sensors/gnss/time"].values[-1] < 4.0
            case "SIM_GPS1_JAM":
                fix = data["sensors/gnss/fix_type"].sel(time=slice(3.999, None))
                assert (fix == FixType.NO_FIX).all()
            case "SIM_GPS1_NOISE":
                t = data["sensors/gnss/time"].values
                wave = np.where(t > 3.999, 5.0 * np.sin((t - 4.0) * 0.5), 0.0)  # sin(0.0005 ms)
                np.testing.assert_allclose(data["sensors/gnss/h"] - healthy["sensors/gnss/h"], wave, atol=1e-6)
            case "SIM_ARSPD_FAIL":
                assert (data["sensors/airspeed/eas"].sel(time=slice(3.999, None)) == 12.5).all()
            case "SIM_GYR_FAIL_MSK" | "SIM_ACC_FAIL_MSK":
                assert np.isfinite(data["sensors/imu/dtheta"]).all()
                lost = data["sensors/second_imu"]["dtheta" if "GYR" in name else "dv"].sel(time=slice(3.999, None))
                assert np.isnan(lost).all()
            case "SIM_WIND_SPD" | "SIM_WIND_DIR":
                speed, direction = (14.0, 300.0) if name == "SIM_WIND_SPD" else (4.0, 90.0)
                asked = -speed * np.array([math.cos(math.radians(direction)), math.sin(math.radians(direction))])
                before = -4.0 * np.array([math.cos(math.radians(300)), math.sin(math.radians(300))])
                wind = data["truth/wind_n"].values[-1, :2]
                share = 1 - math.exp(-5.0 / 5.0)
                np.testing.assert_allclose(wind, before + share * (asked - before), atol=0.15)


def test_a_setting_goes_back_and_leaves_failures_alone() -> None:
    short = scenario(12)
    off = [(4.0, Change("SIM_GPS1_ENABLE", 0.0)), (5.0, Change("SIM_GPS1_ENABLE", 0.0))]
    stuck = at(4.0, injection(short, "barometer", "stuck"))
    back = [(6.0, Change("SIM_GPS1_ENABLE", 1.0)), (8.0, Clear("gnss"))]
    data = run(short, replay=[*off[:1], *stuck, off[1], *back]).dataset
    assert data["faults/kind"].values.tolist() == ["dropout", "stuck"]
    assert data["faults/time"].values.tolist() == [4.0, 4.0]
    assert data["faults/end"].values.tolist() == [6.0, 12.0], "what went on lasted until the end of the run"
    assert data["requests/kind"].values.tolist() == ["change", "inject", "change", "change"], "nothing to clear"


@pytest.mark.ci
def test_a_silent_receiver_and_its_return_are_told_within_a_second() -> None:
    short = scenario(12)
    station = Station([*at(4.0, injection(short, "gnss", "off")), *at(8.0, injection(short, "gnss", "ok"))])
    run(short, links=[station], realtime=100.0)
    times = {text: t for t, _, text in station.events}
    began, ended = times["fault gnss_dropout begins: gnss dropout"], times["fault gnss_dropout ends: gnss dropout"]
    assert 4.0 <= began <= 4.1
    assert began < times["gnss silent"] <= began + 1.0
    assert ended < times["gnss heard again"] <= ended + 1.0
    assert sum("silent" in text for text in station.told()) == 1


def test_scheduled_faults_are_not_ended_by_ok() -> None:
    text = Scenario.load("u_turn").text + '\n[[fault]]\nsensor = "gnss"\nkind = "dropout"\nwindow = [3, 7]\n'
    both = Scenario.parse(text, ["duration_s=9", *HEALTHY])
    data = run(both, replay=at(5.0, injection(both, "gnss", "ok"))).dataset
    assert data["faults/end"].values.tolist() == [7.0]
    t = data["sensors/gnss/time"].values
    assert not ((t > 2.999) & (t < 6.999)).any()
    assert ((t > 6.999) & (t < 9)).sum() == 10


# --- the same bits again

SESSION: Sequence[tuple[float, Callable[[Scenario], Sequence[Request]]]] = (
    (3.01, lambda s: injection(s, "magnetometer", "stuck")),
    (3.37, lambda s: [Change("SIM_WIND_SPD", 9.0)]),
    (4.44, lambda s: injection(s, "barometer", "garbage")),
    (5.0, lambda s: injection(s, "gnss", "delayed")),
    (6.21, lambda s: injection(s, "gyro", "slow")),
    (6.5, lambda s: [Inject({"sensor": "airspeed", "channel": "speed", "kind": "noise", "factor": 5.0})]),
    (7.77, lambda s: [*injection(s, "gyro", "ok"), *injection(s, "barometer", "ok")]),
    (8.1, lambda s: [Change("EST1_FALSE_REJ", 0.2), Change("SIM_GPS1_NOISE", 3.0)]),
    (9.93, lambda s: [*injection(s, "gnss", "off"), *injection(s, "magnetometer", "ok")]),
    (11.11, lambda s: [Change("SIM_GPS1_JAM", 1.0), Change("SIM_GPS1_NOISE", 0.0)]),
    (13.6, lambda s: [*injection(s, "gnss", "ok"), Change("SIM_GPS1_JAM", 0.0)]),
    (17.0, lambda s: [End()]),
)


@pytest.mark.ci
@pytest.mark.parametrize(("period_s", "realtime"), [(0.04, 50.0), (0.135, 200.0), (0.3, None)])
def test_a_session_is_repeated_bit_for_bit(period_s: float, realtime: float | None, tmp_path: Path) -> None:
    turbulent = Scenario.load("u_turn", ["duration_s=26", "expect={}"])
    script = [(t, request) for t, ask in SESSION for request in ask(turbulent)]
    live = run(turbulent, seed=5, links=[Station(script, period_s)], realtime=realtime, out=tmp_path).dataset
    kept = record.load(tmp_path / "run.nc")
    assert same(live, kept)
    assert len(kept["requests/tick"]) > 15
    assert kept["truth/time"].values[-1] < 21, "it was ended"
    again = Scenario.parse(kept.attrs["scenario"], json.loads(kept.attrs["overrides"]))
    replay = recorded(kept, again)
    assert [round(t * 200) for t, _ in replay] == kept["requests/tick"].values.tolist()
    batch = run(again, seed=kept.attrs["seed"], replay=replay)
    assert same(batch.dataset, kept)
    watched = run(again, seed=5, replay=replay, links=[Station([], 0.11)], realtime=300.0)
    assert same(watched.dataset, kept)
    assert not same(run(again, seed=6, replay=replay).dataset, kept)


@pytest.mark.ci
@pytest.mark.parametrize("realtime", [None, 4.0])
def test_what_was_asked_is_in_the_file_at_once(realtime: float | None, tmp_path: Path) -> None:
    found: list[int] = []

    class Looking(Station):
        def requests(self) -> Sequence[Request]:
            if self.t > 9 and not found:
                found.append(len(record.load(tmp_path / "run.nc")["requests/time"]))
            return super().requests()

    run(scenario(12), links=[Looking([(3.0, Change("SIM_GPS1_JAM", 1.0))])], out=tmp_path, realtime=realtime)
    assert found == [1]


def requests_in(dataset: Any, rows: Sequence[Mapping[str, str]]) -> Any:
    """The dataset with other requests."""
    import xarray

    group = xarray.Dataset(
        {name: ("time", [row[name] for row in rows]) for name in ("kind", "content")},
        {"time": [float(k) for k in range(len(rows))]},
    )
    return xarray.DataTree.from_dict({"/": dataset.to_dataset(), "requests": group})


@pytest.mark.ci
@pytest.mark.parametrize(
    ("kind", "content", "says"),
    [
        ("inject", "{", "can't be read: inject"),
        ("inject", "{}", "can't be read: inject"),
        ("pause", "{}", "can't be read: pause"),
        ("change", '{"setting": "SIM_GPS1_JAM", "value": 7}', "SIM_GPS1_JAM 7: must be a whole number from 0 to 1"),
        ("change", '{"setting": "SIM_GPS1_JAM", "value": NaN}', "SIM_GPS1_JAM nan: must be"),
        ("change", '{"setting": "SIM_GPS1_JAM", "value": "x"}', "can't be read: change"),
        ("change", '{"setting": "WIND", "value": 7}', "there is no setting WIND: choose from SIM_GPS1_ENABLE"),
        ("inject", '{"fault": {"sensor": "lidar", "kind": "dropout"}}', "there is no sensor 'lidar'"),
        ("inject", '{"fault": {"sensor": "gnss", "kind": "dropped"}}', "no such fault: .*dropped"),
        ("inject", '{"fault": {"sensor": "gnss", "kind": "scale", "channel": "north", "factor": 2}}', "a multiple of"),
        ("inject", '{"fault": {"sensor": "gnss", "kind": "stuck", "channel": "gyro"}}', "gnss has no channel 'gyro'"),
        ("inject", '{"fault": 5}', "can't be read: inject"),
        ("inject", '{"fault": {"sensor": "gnss", "kind": "dropout", "name": "a b"}}', "no such fault: name"),
    ],
)
def test_a_record_whose_requests_make_no_sense(kind: str, content: str, says: str) -> None:
    short = scenario(1)
    with pytest.raises(UserError, match=says):
        recorded(requests_in(run(short).dataset, [{"kind": kind, "content": content}]), short)


def test_nonsense_from_a_link_is_refused_and_leaves_no_trace() -> None:
    short = scenario(6)
    nonsense: list[Request] = [
        Change("SIM_GPS1_JAM", 2.0),
        Change("SIM_WIND_SPD", math.nan),
        Change("NOTHING", 1.0),
        Inject({"sensor": "gnss", "kind": "stuck"}),
        Inject({"sensor": "gnss", "kind": "dropout", "name": "x" * 600}),
        Speed(0.0),
        Step(-1.0),
        Speed(math.nan),
        Step(math.inf),
    ]
    station = Station(at(2.0, nonsense))
    assert same(run(short, links=[station]).dataset, run(short).dataset)
    assert sum(text.startswith("refused: ") for text in station.told()) == len(nonsense)


# --- when it goes on


@pytest.mark.ci
def test_a_paused_run_stands_still_goes_on_by_steps_and_loses_no_bit() -> None:
    short = scenario(6)

    class Pausing(Station):
        """Pauses at 2 s, steps 0.5 s, goes on; notes where it stood at each of the calls in between."""

        def __init__(self) -> None:
            super().__init__([(2.0, Pause())])
            self.stood: list[float] = []
            self.when: list[float] = []

        def requests(self) -> Sequence[Request]:
            if not any("paused" in text for text in self.told()):
                return super().requests()
            self.stood.append(self.t)
            self.when.append(time.monotonic())
            return {10: [Step(0.5)], 40: [Toggle()]}.get(len(self.stood), [])

    station = Pausing()
    result = run(short, links=[station], realtime=10.0)
    assert same(result.dataset, healthy_run(6))
    first, stepped = station.stood[:10], station.stood[25:39]
    assert len(set(first)) == len(set(stepped)) == 1
    assert stepped[0] - first[0] == pytest.approx(0.5, abs=0.041), "of steps no more than a row is missed"
    paused = [t for t, _, text in station.events if text.startswith("paused at")]
    assert paused[1] - paused[0] == pytest.approx(0.5, abs=1e-9)
    assert station.when[-1] - station.when[40] > 0.3, "3.5 s at ten times the clock: the pause is not made good"


@pytest.mark.ci
def test_a_pause_ends_by_resume_and_by_end() -> None:
    short = scenario(6)
    for last, finished in ((Resume(), True), (End(), False)):

        class Pausing(Station):
            def __init__(self, last: Request) -> None:
                super().__init__([(2.0, Pause())])
                self.last = last

            def requests(self) -> Sequence[Request]:
                if self.calls and any("paused" in text for text in self.told()):
                    last, self.told_off = self.last, True
                    self.events.clear()
                    return [last]
                return super().requests()

        result = run(short, links=[Pausing(last)], realtime=50.0)
        assert (result.dataset["truth/time"].values[-1] > 5.99) == finished
        assert bool(result.remarks and result.remarks[0].startswith("ended on request")) != finished


@pytest.mark.ci
@pytest.mark.parametrize("asked", [Speed(4.0), Change("SIM_SPEEDUP", 4.0), Faster(0.004)])
def test_the_speed_changes_on_the_way_and_is_no_part_of_the_record(asked: Request) -> None:
    short = scenario(6)
    station = Station([(2.0, Speed(1000.0)), (3.0, asked)])
    result = run(short, links=[station], realtime=20.0)
    assert same(result.dataset, healthy_run(6))
    assert result.metrics["run.wall_s"] > 0.7, "3 s at four times the clock"
    assert "4 times the wall clock" in station.told()


def test_faster_is_meant_of_the_speed_in_force_and_ends_where_speeds_do() -> None:
    asked: list[Request] = [Faster(2.0), Change("SIM_SPEEDUP", 8.0), Faster(0.5), Faster(1e6), Faster(1e-9)]
    director = Director([lambda: asked and [asked.pop(0)]], (), 3.0, 200.0)
    desk = SimpleNamespace(values={})
    director.begin(desk, None, lambda *_: None, lambda *_: None, lambda _: None)  # type: ignore[arg-type]
    speeds = []
    for tick in range(5):
        director.ready(tick)
        assert director.pacer is not None
        speeds.append(director.pacer.factor)
    assert speeds == [6.0, 8.0, 4.0, 1000.0, 0.01]


@pytest.mark.ci
def test_a_run_as_fast_as_it_can_is_slowed_down_on_request() -> None:
    short = scenario(9)
    station = Station([(4.0, Speed(8.0))])
    assert same(run(short, links=[station]).dataset, run(short).dataset)
    rows = np.array(station.rows)
    assert len(rows) == 226


@pytest.mark.ci
def test_a_restart_begins_anew_in_the_same_folder(tmp_path: Path) -> None:
    short = scenario(7)
    station = Station([(2.0, Change("SIM_GPS1_JAM", 1.0)), (4.0, Restart())])
    result = run(short, links=[station], realtime=50.0, out=tmp_path)
    assert same(result.dataset, healthy_run(7))
    assert same(record.load(tmp_path / "run.nc"), result.dataset)
    turn = int(np.argmin(np.diff(station.rows)))
    assert 3.9 < station.rows[turn] < 4.3
    assert station.rows[turn + 1] == 0.0
    assert "begins anew" in station.told()


@pytest.mark.ci
def test_after_a_restart_the_clock_begins_anew_at_the_speed_of_before() -> None:
    asked: list[Request] = [Speed(500.0), Restart()]
    director = Director([lambda: [asked.pop(0)] if asked else []], (), 1000.0, 200.0)
    told: list[str] = []
    desk = SimpleNamespace(values={})
    director.begin(desk, None, lambda *_: None, lambda *event: told.append(event[-1]), lambda _: None)  # type: ignore[arg-type]
    assert director.ready(0)
    assert director.pacer is not None
    for k in range(3):
        director.pacer.wait(100.0 * k)
    with pytest.raises(Restarted):
        director.ready(40_000)
    for k in range(3):
        director.pacer.wait(100.0 * k)
    assert (director.pacer.factor, director.pacer.waits, director.pacer.missed) == (500.0, 2, 0)
    assert told == ["500 times the wall clock", "begins anew"]


@pytest.mark.ci
def test_what_is_asked_with_a_restart_is_asked_of_the_run_that_begins() -> None:
    short = scenario(6)
    asked: list[Request] = [Restart(), Change("SIM_GPS1_JAM", 1.0)]
    station = Station([(2.0, one) for one in asked])
    requests = run(short, links=[station], realtime=50.0).dataset["requests"]
    assert requests["kind"].values.tolist() == ["change"]
    assert requests["time"].values.tolist() == [0.0]


def test_a_motion_that_was_handed_over_is_not_begun_anew() -> None:
    from testbed.feeds.simulated import motion

    short = scenario(6)
    station = Station([(2.0, Restart()), (2.0, Change("SIM_WIND_SPD", 5.0))])
    result = run(short, links=[station], source=motion(short, 1))
    assert "refused: this motion can't be flown again" in station.told()
    assert len(result.dataset["truth/time"]) == 61


def test_an_end_before_the_first_row_leaves_one() -> None:
    result = run(scenario(6), links=[Station([(-1.0, End())])])
    assert result.dataset["truth/time"].values.tolist() == [0.0]
    assert result.remarks[0] == "ended on request at 0 s of 6 s"


@pytest.mark.ci
def test_links_are_told_the_settings_in_force() -> None:
    """Whoever changes them: at the start, after a change, and anew after a restart."""
    station = Station([(1.0, Change("SIM_WIND_SPD", 7.0)), (1.5, Speed(40.0)), (2.0, Restart())])
    run(scenario(3), links=[station], realtime=50.0)
    told = [(values["SIM_WIND_SPD"], values["SIM_SPEEDUP"]) for values in station.told_settings]
    usual = told[0][0]
    assert told == [(usual, 50.0), (7.0, 50.0), (7.0, 40.0), (usual, 40.0)]
