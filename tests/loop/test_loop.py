"""The loop: the same bits however it is watched or paced, events, and a record that survives a crash."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from worlds.loop import Watcher, same
from worlds.recordings import log_of

from nav.columns import FusedReports
from nav.samples import FixType, GnssSample, Sample
from testbed import RunResult, Scenario, results, run, sensors
from testbed.errors import UserError
from testbed.feeds.simulated import motion
from testbed.loop import loop
from testbed.loop.links import Stretch
from testbed.loop.pacer import Pacer
from testbed.motion import flight
from testbed.motion.table import MotionSource, TruthBlock
from testbed.record import reader as record
from testbed.scenario import shipped

SHORT = ["duration_s=40", "sensors.gnss.denied=[[20, 26]]"]


def test_live_and_batch_give_the_same_bits() -> None:
    scenario = Scenario.load("u_turn", SHORT)
    batch = run(scenario, seed=3)
    watcher = Watcher()
    live = run(scenario, seed=3, links=[watcher], realtime=1000.0)
    assert same(batch.dataset, live.dataset)
    assert watcher.closed
    np.testing.assert_allclose(watcher.rows, np.arange(1001) * 0.04, atol=1e-9)
    assert not same(batch.dataset, run(scenario, seed=4).dataset)


@pytest.mark.ci
def test_a_known_mounting_is_undone_and_truth_is_taken_at_the_imu() -> None:
    quiet = ["sensors.imu.grade=perfect", "sensors.gnss.grade=rtk", "estimator[0].aids=['gnss']", "duration_s=100"]
    mounted = ["sensors.imu.mounting_deg=[20,-40,135]", "sensors.imu.lever_arm_m=[2,-1,0.5]"]
    found = run(Scenario.load("u_turn", [*quiet, *mounted])).metrics
    assert found["ins.position_horizontal_max_m"] < 0.05
    assert found["ins.velocity_rms_mps"] < 0.002
    assert found["ins.roll_pitch_max_deg"] < 0.001
    assert found["ins.heading_max_deg"] < 0.01


LATE = Scenario.load("u_turn", [*SHORT, "sensors.gnss.latency_s=0.13"])


@pytest.fixture(scope="module")
def in_one_chunk() -> RunResult:
    return run(LATE)


@pytest.mark.ci
@pytest.mark.parametrize("batch_s", [0.065, 0.25, 7.0])
def test_result_does_not_depend_on_the_chunk(
    in_one_chunk: RunResult, monkeypatch: pytest.MonkeyPatch, batch_s: float
) -> None:
    monkeypatch.setattr(loop, "BATCH_S", batch_s)
    assert same(in_one_chunk.dataset, run(LATE).dataset)


@pytest.mark.parametrize(("quick", "turns"), [(0.0, [5.0, 20.0, 40.0]), (math.inf, [5.0, 10.0, 15.0, 20.0])])
def test_turns_are_long_only_when_they_pass_quickly(
    monkeypatch: pytest.MonkeyPatch, quick: float, turns: list[float]
) -> None:
    """What is not quick loses little of its record when it is ended."""
    monkeypatch.setattr(loop, "QUICK", quick)
    told: list[float] = []
    run(Scenario.load("u_turn", ["duration_s=45"]), progress=lambda now: told.append(now.t))
    assert told[: len(turns)] == pytest.approx(turns, abs=0.01)


def test_events_tell_of_denial_reacquisition_and_legs() -> None:
    watcher = Watcher()
    run(Scenario.load("u_turn", SHORT), links=[watcher])
    texts = [text for _, _, text in watcher.events]
    assert any("aligned" in text for text in texts)
    denied = next(t for t, _, text in watcher.events if text == "gnss denied")
    back = next(t for t, _, text in watcher.events if text == "gnss reacquired")
    assert denied == pytest.approx(20.0, abs=0.41)
    assert back >= 26.0
    assert any(text.startswith("leg 1/") for text in texts)


def test_crash_leaves_a_readable_record(tmp_path: Path) -> None:
    scenario = Scenario.load("u_turn", SHORT)

    class Failing:
        """A motion that breaks after 25 s."""

        def __init__(self, inner: MotionSource) -> None:
            self.inner = inner
            self.rate_hz = inner.rate_hz
            self.failure = ""
            self.ticks = 0

        def advance(self, ticks: int) -> TruthBlock:
            self.ticks += ticks
            if self.ticks > 25 * self.rate_hz:
                raise RuntimeError("the simulator broke")
            return self.inner.advance(ticks)

        def activity(self) -> str:
            return ""

    with pytest.raises(RuntimeError, match="simulator broke"):
        run(scenario, out=tmp_path, source=Failing(motion(scenario, scenario.seed)))
    dataset = record.load(tmp_path / "run.nc")
    t = dataset["estimators/ins"]["time"].values
    assert t[0] == 0.0
    assert 24.0 <= t[-1] <= 25.0
    assert np.isfinite(dataset["estimators/ins"]["lat"].values[-1])


def test_lost_control_is_an_event_and_ends_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flight, "MAX_ROLL", math.radians(20.0))  # which the U-turn exceeds
    watcher = Watcher()
    result = run(Scenario.load("u_turn", ["duration_s=60", "plan[0].length_m=500"]), links=[watcher])
    end = result.dataset["truth"]["time"].values[-1]
    assert 10.0 < end < 59.0
    assert result.failure.startswith("control lost: bank")
    assert watcher.events[-1] == (pytest.approx(end, abs=0.1), "error", result.failure)


def test_legs_that_the_wind_kept_from_being_flown_are_named() -> None:
    """Against 30 m/s the first leg never ends."""
    to = "to={lat_deg=47.1, lon_deg=8.0}"
    plan = f"plan=[{{leg='straight', {to}}}, {{leg='climb', to_m=350}}, {{leg='u_turn', radius_m=2000}}]"
    wind = "truth.wind={from_deg=0, speed_mps=30}"
    watcher = Watcher()
    result = run(Scenario.load("u_turn", [plan, wind, "truth.start.heading_deg=0", "duration_s=20"]), links=[watcher])
    said = "legs 2/3 climb, 3/3 u turn were never flown: the run ended in leg 1 straight"
    assert said in result.remarks
    assert watcher.events[-1] == (pytest.approx(20.0, abs=0.1), "warning", said)


@pytest.mark.parametrize(
    ("denied", "severity", "more"),
    [([[2.0, 4.0]], "info", ""), ([[2.0, 4.0], [150.0, 160.0]], "warning", ", before gnss denied from 150 s")],
)
def test_a_plan_that_ends_before_the_run_is_an_event(denied: list[list[float]], severity: str, more: str) -> None:
    short = ["plan=[{leg='straight', length_m=200}]", f"sensors.gnss.denied={denied}"]
    result = run(Scenario.load("u_turn", short))
    end = result.dataset["truth"]["time"].values[-1]
    assert end < 20.0
    said = f"plan flown: the run ends at {end:.0f} s of 200 s{more}"
    assert (result.failure, result.remarks[0]) == ("", said)  # after it, that so short a run is not scored
    assert result.dataset["events"]["text"].values[-1] == said
    assert result.dataset["events"]["severity"].values[-1] == severity


@pytest.mark.ci
def test_links_show_the_estimator_that_was_asked_for() -> None:
    class Naming(Watcher):
        def publish(self, rows: Stretch) -> None:
            super().publish(rows)
            pieces = [piece[:] if isinstance(piece, FusedReports) else [piece] for _, piece in rows.reports]
            aids = {report.aid for piece in pieces for report in piece}
            self.shown = "wind" in rows.estimates.extra, [one.name for one in rows.others], aids

    estimators = ", ".join(
        f"{{name='{n}', aids={a}}}" for n, a in (("a", ["gnss"]), ("b", ["gnss", "airspeed"]), ("c", []))
    )
    scenario = Scenario.load("u_turn", ["duration_s=8", f"estimator=[{estimators}]", "expect={}"])
    for shown, expected in ((None, (False, ["b", "c"])), ("b", (True, ["a", "c"]))):
        watcher = Naming()
        run(scenario, links=[watcher], shown=shown)
        assert watcher.shown[:2] == expected
        assert ("airspeed" in watcher.shown[2]) <= (shown == "b")


@pytest.mark.parametrize(
    ("options", "overrides", "says"),
    [
        ({"seed": -1}, [], "seed -1: must be from 0 to 9223372036854775807"),
        ({"seed": True}, [], "seed True: must be from 0 to 9223372036854775807"),
        ({"seed": 2**63}, [], "seed 9223372036854775808: must be from 0"),
        ({"seed": 1.5}, [], r"seed 1\.5: must be .*, a whole number"),
        ({"shown": "inz"}, [], "--estimator inz: the scenario has no such estimator: choose from ins"),
        ({}, ["estimator=[]", "expect={}"], r"no \[\[estimator\]\], so a link has nothing to show"),
        ({"out": Path("/proc/testbed")}, [], "can't be written"),
    ],
)
def test_a_refused_run_closes_its_links(options: dict[str, Any], overrides: list[str], says: str) -> None:
    watcher = Watcher()
    with pytest.raises(UserError, match=says):
        run(Scenario.load("u_turn", overrides), links=[watcher], **options)
    assert watcher.closed


def test_the_largest_seed_flies() -> None:
    flown = run(Scenario.load("u_turn", ["duration_s=1"]), seed=2**63 - 1)
    assert flown.dataset.attrs["seed"] == 2**63 - 1
    assert repr(flown).startswith("<RunResult 'A U-turn with all sensors healthy', ")
    assert len(repr(flown).splitlines()) == 1


def test_what_an_earlier_run_left_goes_when_the_next_one_starts(tmp_path: Path) -> None:
    scenario = Scenario.load("u_turn", ["duration_s=3"])
    stale = [tmp_path / name for name in ("metrics.json", "report.html", "nees.png", "old_biases.png")]
    mine = [tmp_path / name for name in ("run.tlog", "photo.png", "notes.html")]

    class Broken:
        """A motion that fails at its first or at its second call."""

        rate_hz, failure = 200.0, ""

        def __init__(self, rows: int) -> None:
            self.inner, self.left = motion(scenario, 1), rows

        def advance(self, ticks: int) -> TruthBlock:
            if not self.left:
                raise UserError("no trim")
            self.left -= 1
            return self.inner.advance(200)

        def activity(self) -> str:
            return ""

    for path in stale + mine:
        path.write_text("")
    results.enter(tmp_path, [path.name for path in stale])
    for calls, left in ((0, True), (1, False)):
        with pytest.raises(UserError, match="no trim"):
            run(scenario, out=tmp_path, source=Broken(calls))
        assert {path.exists() for path in stale} == {left}
        assert all(path.exists() for path in mine)


def test_metrics_and_record_are_written(tmp_path: Path) -> None:
    result = run(Scenario.load("u_turn", SHORT), out=tmp_path)
    assert (tmp_path / "metrics.json").exists()
    assert same(result.dataset, record.load(tmp_path / "run.nc"))
    assert result.metrics["run.realtime_factor"] > 0
    assert result.metrics["ins.aligned_s"] < 5


@pytest.mark.ci
@pytest.mark.parametrize("every", [1, 5])
def test_estimators_beside_the_shown_one_are_handed_over_as_often_as_they_are_looked_at(every: int) -> None:
    class Sparse(Watcher):
        others_every = every

        def row(self, rows: Stretch, row: int) -> None:
            if len(self.rows) % every == 0:
                others = [(one.name, one.estimates.t[one.at[row]]) for one in rows.others]
                assert others == [("b", rows.estimates.t[row])]
            else:
                assert [one.at[row] for one in rows.others] == [-1]
            super().row(rows, row)

    estimators = "estimator=[{name='a', aids=['gnss']}, {name='b', aids=[]}]"
    watcher = Sparse()
    scenario = Scenario.load("u_turn", ["duration_s=3", estimators, "expect={}", "record.rate_hz=4"])
    assert run(scenario, links=[watcher]).dataset.identical(run(scenario).dataset)
    assert len(watcher.rows) == 76


def test_gnss_denied_sample_says_so() -> None:
    seen: list[GnssSample] = []

    class Keeping(Watcher):
        def publish(self, rows: Stretch) -> None:
            super().publish(rows)
            seen.extend(sample for _, sample in rows.samples if isinstance(sample, GnssSample))

    watcher = Keeping()
    run(Scenario.load("u_turn", SHORT), links=[watcher])
    inside = [s for s in seen if 20.5 < s.t < 25.5]
    assert inside
    assert all(s.fix_type == FixType.NO_FIX for s in inside)
    assert all(np.isnan(s.lat) for s in inside)


@pytest.mark.ci
def test_faults_and_only_their_sensor() -> None:
    """A step of one receiver is told, recorded, detected by the gate, and isolated; then all is as before."""
    step = """
[[fault]]
sensor = "gnss"
channel = "north"
kind = "step"
window = [70, 80]
size = 20
unit = "sigma"
[[fault]]
sensor = "barometer"
channel = "pressure"
kind = "garbage"
window = [75, 77]
[[fault]]
sensor = "imu"
kind = "dropout"
window = [90, 90.05]
"""
    text, options = shipped()["u_turn"].read_text(), ["duration_s=100", "sensors.gnss.denied=[]"]
    healthy = run(Scenario.parse(text, options))
    watcher = Watcher()
    result = run(Scenario.parse(text + step, options), links=[watcher])
    data = result.dataset
    for sensor in ("magnetometer", "airspeed"):
        assert data[f"sensors/{sensor}"].identical(healthy.dataset[f"sensors/{sensor}"])
    moved = (data["sensors/gnss/lat"].values != healthy.dataset["sensors/gnss/lat"].values).nonzero()[0]
    t = data["sensors/gnss/time"].values
    np.testing.assert_array_equal(moved, np.flatnonzero((t > 70 - 1e-6) & (t < 80 - 1e-6)))
    assert data["faults/name"].values.tolist() == ["gnss_north_step", "barometer_pressure_garbage", "imu_dropout"]
    assert data["faults/time"].values.tolist() == [70.0, 75.0, 90.0]
    assert (70.0, "info", "fault gnss_north_step begins: gnss north step 20 sigma") in watcher.events
    assert (80.0, "info", "fault gnss_north_step ends: gnss north step 20 sigma") in watcher.events
    found = result.metrics
    assert found["ins.detection_delay_s.gnss_north_step"] == 0.0
    assert found["ins.coverage.gnss_north_step"] == 1.0
    assert found["ins.isolation_correct.gnss_north_step"] == 1.0
    assert found["ins.end_lag_s.gnss_north_step"] <= 1.5
    assert found["ins.coverage.barometer_pressure_garbage"] == 1.0
    assert found["ins.end_lag_s.barometer_pressure_garbage"] == 0.0
    assert found["ins.position_horizontal_max_m"] < 10.0
    assert not [key for key in healthy.metrics if "detection" in key or "missed" in key]


@pytest.mark.ci
def test_a_faulty_run_does_not_depend_on_the_chunk(monkeypatch: pytest.MonkeyPatch) -> None:
    text = shipped()["u_turn"].read_text() + "".join(
        f'[[fault]]\nsensor = "{sensor}"\nkind = "{kind}"\nwindow = [20, 30]\n{rest}\n'
        for sensor, kind, rest in (
            ("gnss", "drag_off", "bearing_deg = 40\nacceleration_mps2 = 0.3"),
            ("airspeed", "stuck", 'channel = "speed"'),
            ("barometer", "delay", 'channel = "height"\ndelay_s = 3'),
            ("imu", "noise", 'channel = "gyro_x"\nfactor = 4'),
            ("imu", "spikes", 'channel = "accel_z"\nsize = 20\nperiod_s = 0.33'),
        )
    )
    scenario = Scenario.parse(text, ["duration_s=40"])
    reference = run(scenario)
    monkeypatch.setattr(loop, "BATCH_S", 0.365)
    assert same(reference.dataset, run(scenario).dataset)


@pytest.mark.ci
@pytest.mark.parametrize(
    ("broken", "refused"),
    [
        ("sensors.barometer.bias_pa=100000", "barometer"),
        ("sensors.magnetometer.hard_iron_ut=500", "magnetometer"),
        ("sensors.gnss.horizontal_white_m=10000", "gnss_position"),
    ],
)
def test_nonsense_is_refused_and_the_run_goes_on(broken: str, refused: str) -> None:
    result = run(Scenario.load("u_turn", ["duration_s=75", "sensors.gnss.denied=[]", broken]))
    assert result.dataset["truth"]["time"].values[-1] == pytest.approx(75.0)
    assert all(np.isfinite(value) for value in result.metrics.values())
    innovations = result.dataset.get(f"estimators/ins/innovations/{refused}")
    assert innovations is None or (innovations["weight"].values == 0).any()


@pytest.mark.ci
def test_an_unsound_sample_of_every_sensor_is_reported_and_not_fused(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = Scenario.load("u_turn", ["duration_s=75", "sensors.gnss.denied=[]"])
    original = sensors.build

    def build(name: str, *rest: Any) -> Any:
        sensor = original(name, *rest)
        if name == "imu":
            return sensor
        sense, fields = sensor.sense, {"gnss": "lat", "barometer": "pressure", "airspeed": "eas"}

        def broken(truth: TruthBlock) -> list[Sample]:
            value = np.full(3, np.nan) if name == "magnetometer" else float("nan")
            change = {fields.get(name, "field_b"): value}
            return [replace(s, **change) if 65.0 <= s.t < 65.3 else s for s in sense(truth)]

        sensor.sense = broken
        return sensor

    monkeypatch.setattr(sensors, "build", build)
    watcher = Watcher()
    result = run(scenario, links=[watcher])
    texts = [text for t, _, text in watcher.events if 65.0 <= t < 66.0]
    for aid in ("gnss_position", "barometer", "magnetometer", "airspeed"):
        assert any(f"ins: {aid.removesuffix('_position')} refused" in text for text in texts), (aid, texts)
        innovations = result.dataset[f"estimators/ins/innovations/{aid}"]
        t, weight = innovations["sample_time"].values, innovations["weight"].values
        inside = (t >= 65.0) & (t < 65.3)
        assert inside.any()
        assert (weight[inside] == 0).all()
    assert all(np.isfinite(value) for value in result.metrics.values())


@pytest.mark.ci
@pytest.mark.parametrize("imu_hz", [25, 40])
def test_slow_imu_gives_the_same_bits_live_and_batch(imu_hz: int) -> None:
    scenario = Scenario.load("u_turn", ["duration_s=20", "sensors.gnss.denied=[]", f"sensors.imu.rate_hz={imu_hz}"])
    batch = run(scenario)
    assert same(batch.dataset, run(scenario, links=[Watcher()], realtime=1000.0).dataset)


@pytest.mark.ci
@pytest.mark.parametrize("duration_s", [2.0, 2.01, 2.03])
def test_no_deadline_comes_at_once_after_another(duration_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The last, of the one row that is left over, was missed in every run."""
    deadlines = []
    monkeypatch.setattr(Pacer, "wait", lambda self, t, meanwhile=None: deadlines.append(t))
    run(Scenario.load("static_bench", {"duration_s": duration_s}), links=[Watcher()], realtime=1000.0)
    assert deadlines[-1] == pytest.approx(duration_s)
    assert np.diff(deadlines).min() >= 0.5 * Watcher.period_s


@pytest.mark.ci
def test_late_stamps_and_losses_give_the_same_bits_live_batch_and_as_a_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rough = {
        "imu": {"rate_hz": 50, "jitter_s": 0.008, "dropout_percent": 3.0},
        "gnss": {"denied": [[12, 15]], "jitter_s": 0.02, "dropout_percent": 5.0},
        **{key: {"jitter_s": 0.01, "dropout_percent": 5.0} for key in ("barometer", "magnetometer", "airspeed")},
    }
    changes = {f"sensors.{name}.{key}": value for name, keys in rough.items() for key, value in keys.items()}
    scenario = Scenario.load("u_turn", {"duration_s": 20, **changes})
    batch = run(scenario, out=tmp_path)
    assert same(batch.dataset, run(scenario, links=[Watcher()], realtime=1000.0).dataset)
    monkeypatch.setattr(loop, "BATCH_S", 0.065)
    assert same(batch.dataset, run(scenario).dataset)
    path = tmp_path / "again.toml"
    path.write_text(log_of(scenario.text, tmp_path / "run.nc", 'aircraft = "loiter"'), "utf-8")
    again = run(Scenario.load(path, {"duration_s": 20, **changes}))
    # the log ends with the last stamp, a moment before the run did
    for node in again.dataset["estimators"].subtree:
        for name, variable in node.variables.items():
            first = batch.dataset[node.path][name].values
            assert len(variable) >= len(first) - 2
            np.testing.assert_array_equal(variable.values, first[: len(variable)], err_msg=f"{node.path}/{name}")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"out": 3}, "run: out: give a folder, not int"),
        ({"out": ""}, "run: out: give a folder, not ''"),
        ({"out": "a\0b"}, "can't be written: "),
        ({"realtime": "1"}, "the speed must be above 0"),
        ({"links": ["udpout:127.0.0.1:14550"]}, "run: links: give publishers"),
        ({"progress": 3}, "run: progress: give a function"),
    ],
)
def test_what_a_caller_gets_wrong_is_told(options: dict[str, Any], says: str) -> None:
    with pytest.raises(UserError, match=says):
        run(Scenario.load("static_bench"), **options)
    with pytest.raises(UserError, match=r"run: give a Scenario, such as Scenario\.load\('u_turn'\)"):
        run("u_turn", **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("overrides", [3, [("duration_s", 100)], [3]])
def test_overrides_that_are_none_are_told(overrides: Any) -> None:
    with pytest.raises(UserError, match=r"Scenario\.load: overrides: give values by key"):
        Scenario.load("u_turn", overrides)
    with pytest.raises(UserError, match=r"Scenario\.parse: overrides: give values by key"):
        Scenario.parse(Scenario.load("u_turn").text, overrides)


def test_a_text_takes_values_by_key_as_a_file_does() -> None:
    assert Scenario.parse(Scenario.load("u_turn").text, {"duration_s": 3}).duration_s == 3


def test_overrides_may_be_made_as_they_are_read() -> None:
    assert Scenario.load("u_turn", (one for one in ["duration_s=3"])).overrides == ("duration_s=3",)  # type: ignore[arg-type]
