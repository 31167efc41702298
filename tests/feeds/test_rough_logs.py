"""What real logs are like: a flight with bad times, gaps and things missing runs to its end and says what was odd."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import testbed.__main__ as cli
from nav.samples import Array, GnssSample, ImuSamples
from testbed import Scenario, run
from testbed.data import data_dir
from testbed.errors import UserError
from testbed.feeds import draft, formats
from testbed.feeds.log import Log
from testbed.feeds.survey import survey
from testbed.loop.loop import RunResult
from testbed.motion.logged import LogTruth
from testbed.score import accuracy, metrics

BIN = data_dir("scenarios") / "recorded_flight.bin"
SECONDS = 70.0
SCENARIO = """
title = "rough"
duration_s = 69
date = 2026-06-01
[truth]
source = "log"
file = "rough.npz"
rate_hz = 100
reference = "gnss"
[truth.columns]
imu = { time = { column = "imu_t", unit = "us" }, gyro = "gyro", accel = "accel" }
gnss = { time = "gnss_t", lat = "lat", lon = "lon", height = "h", GNSS }
barometer = { time = "baro_t", pressure = "p" }
magnetometer = { time = "mag_t", field = "m" }
[sensors.imu]
[sensors.gnss]
latency_s = 0.1
[sensors.barometer]
[sensors.magnetometer]
[[estimator]]
name = "ins"
kind = "ins"
aids = ["gnss", "barometer", "magnetometer"]
"""


@pytest.fixture(scope="module")
def log() -> Log:
    return formats.read(BIN, {})


def arrays(log: Log) -> dict[str, Any]:
    """The first `SECONDS` of the shipped log as a table."""
    imu = log.imus["imu"]
    kept = imu.t <= SECONDS
    made: dict[str, Any] = {"imu_t": np.round(imu.t[kept] * 1e6), "gyro": (imu.dtheta / imu.dt[:, None])[kept]}
    made["accel"] = (imu.dv / imu.dt[:, None])[kept]
    fixes = [one for one in log.samples["gnss"] if isinstance(one, GnssSample) and one.t <= SECONDS]
    made |= {key: np.array([getattr(one, key) for one in fixes]) for key in ("lat", "lon", "h")}
    made |= {"gnss_t": np.array([one.t for one in fixes]), "v": np.array([one.v_n for one in fixes])}
    made |= {"sp": np.array([one.sigma_position_n for one in fixes])}
    made |= {"sv": np.array([one.sigma_velocity_n for one in fixes])}
    for name, time, field, key in (("barometer", "baro_t", "pressure", "p"), ("magnetometer", "mag_t", "field_b", "m")):
        own = [one for one in log.samples[name] if one.t <= SECONDS]
        made |= {time: np.array([one.t for one in own]), key: np.array([getattr(one, field) for one in own])}
    return made


def fly(table: Mapping[str, Any], folder: Path, gnss: str, changes: Mapping[str, Any] | None = None) -> RunResult:
    np.savez(folder / "rough.npz", **table)
    (folder / "rough.toml").write_text(SCENARIO.replace("GNSS", gnss))
    return run(Scenario.load(folder / "rough.toml", changes or {}))


ALL = 'velocity = "v", sigma_position = "sp", sigma_velocity = "sv"'


def told(result: RunResult) -> str:
    return "\n".join(result.dataset["events"].dataset["text"].values.tolist())


def scored(result: RunResult) -> dict[str, float]:
    return metrics.compute(result.dataset, settling_s=10.0)


def jittered(table: dict[str, Any], rng: np.random.Generator) -> None:
    table["imu_t"] = table["imu_t"] + np.round(rng.uniform(-3000, 3000, len(table["imu_t"])))
    table["gnss_t"] = table["gnss_t"] + rng.uniform(0, 0.01, len(table["gnss_t"]))


def repeated(table: dict[str, Any], rng: np.random.Generator) -> None:
    for k in rng.integers(10, len(table["imu_t"]), size=50):
        table["imu_t"][k] = table["imu_t"][k - 1]


def disordered(table: dict[str, Any], rng: np.random.Generator) -> None:
    for k in rng.integers(10, len(table["imu_t"]), size=50):
        table["imu_t"][[k - 1, k]] = table["imu_t"][[k, k - 1]]
        for name in ("gyro", "accel"):
            table[name][[k - 1, k]] = table[name][[k, k - 1]]


def wrapped(table: dict[str, Any], rng: np.random.Generator) -> None:
    table["imu_t"] = (table["imu_t"] + 2**32 - 30e6) % 2**32
    for name in ("gnss_t", "baro_t", "mag_t"):
        table[name] = table[name] + 2**32 * 1e-6 - 30


@pytest.mark.ci
@pytest.mark.parametrize(
    ("mangle", "note"),
    [(jittered, ""), (repeated, "come again"), (disordered, "out of order"), (wrapped, "began anew")],
)
def test_bad_times_cost_little_and_are_told(log: Log, tmp_path: Path, mangle: Any, note: str) -> None:
    table = arrays(log)
    mangle(table, np.random.default_rng(1))
    result = fly(table, tmp_path, ALL)
    scores = scored(result)
    assert scores["ins.position_horizontal_rms_m"] < 2.5
    assert scores["ins.velocity_rms_mps"] < 0.35
    assert note in told(result)


def test_who_runs_a_log_is_told_when_much_of_it_is_left_out(log: Log, tmp_path: Path) -> None:
    """Of what is used; a few rows are an event alone."""
    short = {"duration_s": 5, "truth.reference": "solution"}
    table = arrays(log)
    table["imu_t"][[500, 1500]] = 0.0
    few = fly(table, tmp_path, ALL, short)
    assert "imu: 2 times are far off" in told(few)
    assert not any("left out" in remark for remark in few.remarks)
    table["imu_t"] = np.where(table["imu_t"] > 60e6, table["imu_t"] - 60e6, table["imu_t"])
    table["baro_t"][::10] = np.nan
    many = fly(table, tmp_path, ALL, short)
    said = [remark for remark in many.remarks if "left out" in remark]
    assert len(said) == 1
    assert "imu: time goes back 1 times" in said[0]
    assert "barometer: 71 times are no numbers" in said[0]


@pytest.mark.ci
@pytest.mark.parametrize("gap_s", [0.3, 3.0])
def test_a_gap_of_the_imu_is_told_and_flown_over(log: Log, tmp_path: Path, gap_s: float) -> None:
    table = arrays(log)
    lost = (table["imu_t"] > 30e6) & (table["imu_t"] < (30 + gap_s) * 1e6)
    for name in ("imu_t", "gyro", "accel"):
        table[name] = table[name][~lost]
    result = fly(table, tmp_path, ALL)
    assert "imu: a gap of" in told(result)
    assert result.dataset["truth"].sizes["time"] == 691  # to the end
    assert scored(result)["ins.aligned_s"] < 5
    dtheta, dt = (result.dataset[f"sensors/imu/{name}"].values for name in ("dtheta", "dt"))
    assert dt[np.isnan(dtheta).any(axis=1)].sum() == pytest.approx(gap_s, abs=0.05)


@pytest.mark.ci
def test_without_accuracies_the_grade_is_declared(log: Log, tmp_path: Path) -> None:
    result = fly(arrays(log), tmp_path, 'velocity = "v"')
    sigma = result.dataset["sensors/gnss/sigma_position_n"].values
    assert np.allclose(sigma, np.hypot([0.4, 0.4, 0.8], [1.0, 1.0, 2.0]))
    assert scored(result)["ins.position_horizontal_rms_m"] < 2.5


@pytest.mark.ci
def test_without_velocity_it_aligns_later_by_positions(log: Log, tmp_path: Path) -> None:
    result = fly(arrays(log), tmp_path, 'sigma_position = "sp"')
    assert 10 <= scored(result)["ins.aligned_s"] <= 20
    e = accuracy.errors(result.dataset, "ins", settling_s=30.0)
    assert np.sqrt(np.mean(e.horizontal[e.valid] ** 2)) < 3.0


def test_an_unknown_reference_is_not_judged(log: Log, tmp_path: Path) -> None:
    result = fly(arrays(log), tmp_path, ALL, {"truth.reference": "none"})
    scores = scored(result)
    assert "ins.position_horizontal_rms_m" not in scores
    assert "ins.nonfinite_samples" not in scores
    assert scores["ins.nis_mean.gnss_position"] < 3
    assert result.remarks[0] == "errors are against none: nothing is judged"


def test_gnss_that_is_taken_away_is_what_it_is_judged_by(log: Log, tmp_path: Path) -> None:
    result = fly(arrays(log), tmp_path, ALL, {"sensors.gnss.denied": [[40, 60]]})
    assert 0.1 < scored(result)["ins.outage_position_horizontal_rms_m"] < 50
    assert "kept back where it is denied" in result.dataset.attrs["reference"]
    place = result.dataset["sensors/gnss/lat"].values
    assert np.isnan(place).sum() >= 95
    assert np.isfinite(result.dataset["truth/lat"].values).mean() > 0.95


WRONG = {"sensors.gnss.latency_s": 0.25}


@pytest.mark.ci
def test_gnss_told_a_wrong_latency_is_the_reference_of_when_it_was_felt(log: Log, tmp_path: Path) -> None:
    """The log's receiver is 0.1 s late. One that finds that is not judged by what it was told, if that is uncertain."""
    uncertain = fly(arrays(log), tmp_path, ALL, WRONG | {"sensors.gnss.latency_sigma_s": 0.1})
    found = re.search(r", (0\.\d+) ± [\d.]+ s late by the IMU", uncertain.dataset.attrs["reference"])
    assert found is not None
    assert float(found[1]) == pytest.approx(0.1, abs=0.02)
    sure = fly(arrays(log), tmp_path, ALL, WRONG)
    assert "late by" not in sure.dataset.attrs["reference"]
    # what the one has at some time the other has where the receiver is told to have been then
    apart = 0.25 - float(found[1])
    t, lat, earlier = (
        result.dataset[f"truth/{name}"].values for result, name in ((sure, "time"), (sure, "lat"), (uncertain, "lat"))
    )
    then = np.interp(t + apart, t, earlier)
    flown = np.isfinite(lat) & np.isfinite(then) & (t < t[-1] - 1)
    np.testing.assert_allclose(then[flown], lat[flown], rtol=0, atol=1e-7)


@pytest.mark.ci
def test_a_start_later_in_the_log(log: Log, tmp_path: Path) -> None:
    result = fly(arrays(log), tmp_path, ALL, {"truth.start_s": 20, "duration_s": 40})
    t, first = (result.dataset[f"sensors/imu/{name}"].values for name in ("time", "dtheta"))
    assert 0 < t[0] <= 0.02 + 1e-9
    imu = log.imus["imu"]
    assert np.allclose(first[0], imu.dtheta[np.searchsorted(imu.t, 20.0 + t[0] - 1e-6)])
    with pytest.raises(UserError, match=r"start_s: .*is over by then: it lasts 70\.0 s"):
        fly(arrays(log), tmp_path, ALL, {"truth.start_s": 2000})


# --- what is in a log


def test_a_survey_finds_latency_noise_and_phases(tmp_path: Path) -> None:
    changes = {"duration_s": 150, "sensors.imu.grade": "mems-consumer", "sensors.imu.turn_on": "exact"}
    result = run(Scenario.load("static_bench", {**changes, "record.imu": True}), out=tmp_path)
    still = survey(formats.read(tmp_path / "run.nc", {}))
    assert [phase.name for phase in still.phases] == ["rest"]
    noise = still.noise["imu"]
    assert np.rad2deg(noise.gyro_walk) * 60 == pytest.approx(0.3, rel=0.3)
    assert np.rad2deg(np.abs(noise.gyro_bias)).max() * 3600 == pytest.approx(40, rel=0.6)
    assert draft.imu_keys(noise)["grade"] == "mems-consumer"
    assert result.path is not None


@pytest.mark.parametrize("stamps", [0.0, -0.1])
def test_a_draft_says_how_late_a_receiver_is_and_that_it_is_not(stamps: float, log: Log, tmp_path: Path) -> None:
    """The log's is told of 0.1 s late; where stamps are of when fixes were valid, nothing is taken off."""
    table = arrays(log)
    table["gnss_t"] = table["gnss_t"] + stamps
    np.savez(tmp_path / "rough.npz", **table)
    (tmp_path / "rough.toml").write_text(SCENARIO.replace("GNSS", ALL))
    truth = Scenario.load(tmp_path / "rough.toml").truth
    assert isinstance(truth, LogTruth)
    (tmp_path / "draft.toml").write_text(draft.scenario(survey(formats.open_log(truth)), tmp_path / "x", truth))
    drafted = Scenario.load(tmp_path / "draft.toml").sensors["gnss"]
    assert drafted.latency_s == pytest.approx(0.1 + stamps, abs=0.021)  # type: ignore[attr-defined]
    assert "latency_s" in drafted.model_fields_set


def test_log_shows_a_table_and_writes_a_scenario_that_runs(
    log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)

    def command(*arguments: str) -> str:
        monkeypatch.setattr("sys.argv", ["testbed", *arguments])
        with suppress(SystemExit):
            cli.main()
        out, err = capsys.readouterr()
        return out + err

    np.savez(tmp_path / "rough.npz", **arrays(log))
    (tmp_path / "rough.toml").write_text(SCENARIO.replace("GNSS", ALL))
    assert "imu_t" in command("log", "rough.npz")
    assert "begin with a scenario" in command("log", "rough.npz", "--scenario", "new.toml")
    shown = command("log", "rough.toml", "--scenario", "new.toml")
    assert "magnetometer" in shown
    assert "is there already" in command("log", "rough.toml", "--scenario", "new.toml")
    scenario = Scenario.load("new.toml", {"duration_s": 15})
    assert run(scenario).metrics["ins.aligned_s"] < 5
    assert [getattr(one, "profile", "") for one in scenario.estimator] == ["", "any_motion"]
    assert "without a log" in command("log", str(data_dir("scenarios") / "u_turn.toml"))
    assert "No such file" in command("log", "nowhere.bin")


@pytest.mark.parametrize("stamps", ["exact", "milliseconds", "pairs"])
def test_the_rate_is_that_of_samples_however_they_are_stamped(stamps: str) -> None:
    """400 a second, rounded down to whole milliseconds, or two by two; a line of 80 Hz stays where it is."""
    rng, exact = np.random.default_rng(3), np.arange(1, 24001) / 400
    t = {"exact": exact, "milliseconds": np.floor(1e3 * exact) / 1e3, "pairs": np.floor(200 * exact) / 200}[stamps]
    t = t + (1e-4 * (np.arange(24000) % 2) if stamps == "pairs" else 0.0)
    dt = np.diff(t, prepend=t[0] - 0.0025)
    force = rng.normal(0.0, 0.05, (24000, 3)) - [0.0, 0.0, 9.8]
    force[12000:, 2] += 3 * np.sin(2 * np.pi * 80 * exact[12000:])
    rate = rng.normal(0.0, 1e-3, (24000, 3)) + np.where(exact > 30, 0.3 * np.sin(exact), 0.0)[:, None]
    imu = ImuSamples(t, dt, dt[:, None] * rate, dt[:, None] * force)
    found = survey(Log(Path("a.npz"), "table", {"imu": imu}, {}, None, float(t[0]), {}))
    assert found.rates["imu"].rate_hz == pytest.approx(400, rel=1e-3)
    assert found.noise["imu"].gyro_walk == pytest.approx(1e-3 / math.sqrt(400), rel=0.2)
    (frequency, _), *_ = found.vibration["imu"].lines
    assert frequency == pytest.approx(80.0, abs=0.5)


@pytest.mark.parametrize("per_second", [1e3, 1e6, 1e9])
def test_times_in_another_unit_are_told(per_second: float) -> None:
    t = np.arange(4000.0) / 100 * per_second
    imu = ImuSamples(t, np.full(4000, per_second / 100), np.zeros((4000, 3)), np.zeros((4000, 3)))
    with pytest.raises(UserError, match=r'^a.npz: its IMU reports every 1.*e?.* s, for .* s: give .* such as "ms"'):
        survey(Log(Path("a.npz"), "table", {"imu": imu}, {}, None, 0.0, {}))


@pytest.mark.parametrize("heard", [0, 1, 2])
def test_a_unit_that_was_hardly_heard_at_rest_has_no_noise(heard: int) -> None:
    def still(t: Array) -> ImuSamples:
        turning = np.where(t > 30, 0.3 * np.sin(t), 0.0)[:, None]
        return ImuSamples(t, np.full(len(t), 0.01), 0.01 * turning * np.ones(3), np.tile([0, 0, -0.098], (len(t), 1)))

    late = still(np.concatenate([10 + 0.01 * np.arange(heard), np.arange(40, 60, 0.01)]))
    both = {"imu": still(np.arange(0.01, 60, 0.01)), "imu2": late}
    found = survey(Log(Path("a.npz"), "table", both, {}, None, 0.0, {}))
    assert list(found.noise) == ["imu"]
