"""Small logs with what recordings of others were found to have: a clock at a wrong pace, dead sensors, lines before."""

from __future__ import annotations

import datetime as dt
import math
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from worlds import log_writers
from worlds.log_writers import dataflash, dataflash_text, ulog, us

import testbed.__main__ as cli
from nav.rotation import euler_from_quat
from nav.samples import FixType, GnssSample, MagnetometerSample
from testbed import Scenario, run
from testbed.errors import UserError
from testbed.feeds import draft, formats
from testbed.feeds.beside import judged_by
from testbed.feeds.log import Log, Reference
from testbed.feeds.reference import doubt
from testbed.feeds.stamps import pace
from testbed.feeds.survey import survey
from testbed.motion.logged import LogTruth, Stream
from testbed.score.observability import of_run

SECONDS, IMU_HZ, GNSS_HZ = 60.0, 50, 5
SPEED, TURN = 12.0, 0.2  # of what flies in circles [m/s, rad/s]
SLOW = 24 / 26  # a board whose clock takes a quartz of 26 MHz for one of 24
FIRST_MS, WEEK = 100_000_000, 1820

Messages = list[tuple[str, tuple[Any, ...]]]


def circling(clock: float = 1.0, field: float = 300.0, silent: tuple[float, float] = (0.0, 0.0)) -> Messages:
    """A log of level circles, stamped by a clock of that pace; no IMU in ``silent``; the field in mG."""
    found: list[tuple[float, str, tuple[Any, ...]]] = []
    for k in range(1, int(SECONDS * IMU_HZ) + 1):
        t = k / IMU_HZ
        if not silent[0] < t < silent[1]:
            shaken = 0.5 * (-1) ** k  # or it would be taken for at rest
            found.append((t, "IMU", (us(clock * t), 0, 0.0, 0.0, TURN, shaken, SPEED * TURN, -9.81)))
    for k in range(1, int(SECONDS * GNSS_HZ) + 1):
        t = k / GNSS_HZ
        course = TURN * t
        north, east = SPEED / TURN * np.sin(course), SPEED / TURN * (1 - np.cos(course))
        place = 47 + np.degrees(north / 6.378e6), 8 + np.degrees(east / 6.378e6) / np.cos(np.radians(47)), 500.0
        told = us(clock * t), 0, 3, FIRST_MS + round(t * 1e3), WEEK, 10, 1.0
        found.append((t, "GPS", (*told, *place, SPEED, np.degrees(course) % 360, 0.0)))
        found.append((t, "MAG", (us(clock * t), 0, field * np.cos(course), -field * np.sin(course), field)))
    found.sort(key=lambda one: one[0])
    return [(name, values) for _, name, values in found]


def read(messages: Messages, folder: Path) -> Log:
    return formats.read(dataflash(messages, folder / "flight.bin"), {})


def test_a_clock_of_a_wrong_pace_is_mended_by_the_receivers_time(tmp_path: Path) -> None:
    right, slow = read(circling(), tmp_path), read(circling(SLOW), tmp_path)
    assert not any("clock" in note for note in right.notes)
    assert [note for note in slow.notes if "its clock runs 7.7% too slow" in note]
    for log in (right, slow):
        assert np.allclose(log.imus["imu"].t, np.arange(1, SECONDS * IMU_HZ + 1) / IMU_HZ, rtol=1e-4, atol=1e-4)
    for what in ("dtheta", "dv"):  # rates are rates, over the time that it truly was
        whole = [getattr(log.imus["imu"], what).sum(axis=0) for log in (right, slow)]
        assert np.allclose(*whole, rtol=1e-4, atol=0.01)  # the first increment's, which is shaken
    for name in ("gnss", "magnetometer"):
        pairs = zip(right.samples[name], slow.samples[name], strict=True)
        assert max(abs(a.t - b.t) + abs(a.t_arrival - b.t_arrival) for a, b in pairs) < 0.01
    assert abs(slow.t0 - right.t0) < 0.01


def test_a_reference_by_a_clock_of_a_wrong_pace_is_mended_with_it(tmp_path: Path) -> None:
    slow = read(circling(SLOW), tmp_path)
    rows = [f"{SLOW * t},47,8,{500 + t}" for t in np.arange(1, SECONDS)]
    (tmp_path / "ppk.csv").write_text("\n".join(["t,lat,lon,h", *rows]))
    place = {"lat": {"column": "lat", "unit": "deg"}, "lon": {"column": "lon", "unit": "deg"}, "height": "h"}
    stream = Stream.model_validate({"file": str(tmp_path / "ppk.csv"), "time": "t", **place})
    found = judged_by(slow, {"reference": stream}).solution
    assert found is not None
    assert np.allclose(found.t, found.columns["h"] - 500, atol=1e-4)


@pytest.mark.parametrize("drift", [1e-4, -3e-3])
def test_a_clock_that_drifts_as_clocks_do_is_left_alone(drift: float) -> None:
    told = np.arange(500) / 5
    assert pace((1 + drift) * told, told) == 1.0


def test_a_receiver_whose_time_says_nothing_of_a_clock_is_not_believed() -> None:
    t = np.arange(500) / 5
    assert pace(t, np.full(500, np.nan)) is None
    assert pace(t[:100], t[:100]) is None  # too short
    halting = t + np.floor(t / 20) * 20  # it jumps, as when it gets to know leap seconds or the week
    assert pace(t, halting) == 1.0


@pytest.mark.parametrize("fixed", [0.3, 0.0])
def test_what_a_receiver_says_of_the_time_counts_once_it_has_a_fix(fixed: float, tmp_path: Path) -> None:
    """Before, it may be of some other week; where it never has one, that is all that there is."""
    messages = circling()
    unfixed = {k for k, (name, _) in enumerate(messages) if name == "GPS" and k < (1 - fixed) * len(messages)}
    for k in unfixed:
        told, instance, _, ms, week, *rest = messages[k][1]
        messages[k] = ("GPS", (told, instance, 1, ms, week - 60, *rest))
    week = WEEK if fixed else WEEK - 60
    begins = dt.datetime(1980, 1, 6, tzinfo=dt.UTC) + dt.timedelta(weeks=week, milliseconds=FIRST_MS)
    ahead = 16  # of UTC, from July 2012 to June 2015 (IERS bulletin C 43) [s]
    assert read(messages, tmp_path).utc == pytest.approx(begins.timestamp() - ahead, abs=0.01)


def test_the_scenario_of_a_slow_clock_lasts_as_long_as_the_flight(tmp_path: Path) -> None:
    (tmp_path / "flight.toml").write_text(draft.scenario(survey(read(circling(SLOW), tmp_path)), tmp_path / "x", None))
    scenario = Scenario.load(tmp_path / "flight.toml")
    assert abs(scenario.duration_s - SECONDS) < 0.2


def test_a_magnetometer_without_a_field_is_left_out(tmp_path: Path) -> None:
    dead = read(circling(field=0.0), tmp_path)
    assert "magnetometer" not in dead.samples
    assert "magnetometer: it never has a field: left out" in dead.notes
    assert "magnetometer" not in draft.sections(survey(dead))
    messages = circling()
    first = next(k for k, (name, _) in enumerate(messages) if name == "MAG")
    messages[first] = ("MAG", (*messages[first][1][:2], 0.0, 0.0, 0.0))
    once = read(messages, tmp_path)
    assert len(once.samples["magnetometer"]) == SECONDS * GNSS_HZ - 1
    assert "magnetometer: 1 samples have no field at all: left out" in once.notes


@pytest.mark.parametrize("turns", [False, True])
def test_no_sphere_is_fitted_to_a_magnetometer_that_does_not_turn(turns: bool, tmp_path: Path) -> None:
    """To noise alone one of the noise's own size fits."""
    rng = np.random.default_rng(41)
    messages: Messages = []
    for name, values in circling():
        if name == "MAG":
            angle = values[0] / 1e6 if turns else 0.0
            field = 300.0 * np.array([np.cos(angle), np.sin(angle), np.sin(3 * angle)]) + rng.normal(0.0, 1.0, 3)
            values = (*values[:2], *field)
        messages.append((name, values))
    assert bool(survey(read(messages, tmp_path)).spheres) == turns


@pytest.mark.parametrize(
    "before", ["", "9\n\nArduCopter V3.1 (5c6503e2)\nFree RAM: 1044\nAPM 2\n", "ArduPlane V2.7\r\n"]
)
def test_text_after_lines_of_a_ground_station_is_known(before: str, tmp_path: Path) -> None:
    path = dataflash_text(circling(), tmp_path / "flight.log")
    path.write_bytes(before.encode() + path.read_bytes())
    log = formats.read(path, {})
    assert log.format == "ArduPilot DataFlash"
    assert len(log.imus["imu"]) == SECONDS * IMU_HZ
    assert log.samples.keys() == {"gnss", "magnetometer"}


def test_a_long_silence_is_a_phase_and_nothing_is_measured_of_it(tmp_path: Path) -> None:
    messages = [one for one in circling(silent=(3.0, 57.0)) if one[0] != "GPS"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = survey(read(messages, tmp_path))
    longest = max(found.phases, key=lambda phase: phase.end - phase.start)
    assert longest.name == "silent"
    assert longest.end - longest.start >= 53
    assert not found.vibration


@pytest.mark.ci
def test_of_a_log_that_does_not_say_where_it_was_a_place_is_assumed(tmp_path: Path) -> None:
    lost = [one for one in circling() if one[0] != "GPS"]
    text = draft.scenario(survey(read(lost, tmp_path)), tmp_path / "x", None)
    (line,) = [line for line in text.splitlines() if line.startswith("start = ")]
    assert "# assumed" in line
    (tmp_path / "flight.toml").write_text(text)
    result = run(Scenario.load(tmp_path / "flight.toml"))
    assert np.isfinite(result.dataset["estimators/ahrs"].to_dataset(inherit=False).q_nb.values[-1]).all()
    (tmp_path / "flight.toml").write_text(text.replace(line, ""))
    with pytest.raises(UserError, match="nowhere"):
        run(Scenario.load(tmp_path / "flight.toml"))


def with_solution(messages: Messages, off_deg: float = 0.0, garbage_until: float = 0.0) -> Messages:
    """The same with an autopilot that thinks it is ``off_deg`` south, and, up to a time, nowhere on Earth."""
    found: Messages = []
    for name, values in messages:
        found.append((name, values))
        if name == "GPS":
            t, place = values[0], (values[7] - off_deg, values[8], values[9])
            nowhere = t < us(garbage_until)
            found.append(("XKF1", (t, 0, 0.0, 0.0, 90.0, *([4e5] * 3 if nowhere else [0.0] * 3))))
            found.append(("POS", (t, *((-130.0, 8.0, 62815.0) if nowhere else place))))
    return found


def lying(
    thought: tuple[float, float] = (3.0, -2.0), ekf: tuple[float, ...] | None = None, trim: float = 0.0, g: float = 9.8
) -> Messages:
    """A vehicle at rest for 10 s, rolled by 3 and pitched by -2 deg; what flies it, and an EKF, think so."""
    roll, pitch = np.radians((3.0, -2.0))
    force = g * np.sin(pitch), -g * np.sin(roll) * np.cos(pitch), -g * np.cos(roll) * np.cos(pitch)
    found: Messages = [("PARM", (0, b"AHRS_TRIM_X", np.radians(trim))), ("PARM", (0, b"AHRS_TRIM_Y", 0.0))]
    for k in range(1, 501):
        found.append(("IMU", (us(k / 50), 0, 0.4, -0.3, 0.0, *force)))  # gyros of 30 deg/s too much
        if k % 5 == 0:
            found.append(("ATT", (us(k / 50), *thought, 90.0)))
            found += [("XKF1", (us(k / 50), 0, *ekf, 0.0, 0.0, 0.0))] if ekf is not None else []
    return found


def attitude(log: Log) -> Any:
    """The last of a log's solution, roll, pitch and heading [deg]."""
    assert log.solution is not None
    return np.degrees(euler_from_quat(log.solution.columns["q_nb"][-1]))


@pytest.mark.parametrize("trim", [0.0, 0.24])
def test_an_ekf_that_does_not_run_is_no_reference(trim: float, tmp_path: Path) -> None:
    """It is logged as zeros, less the trim; the attitude that was flown by is logged beside it."""
    log = read(lying((3.0 - trim, -2.0), (-trim, 0.0, 0.0), trim), tmp_path)
    assert log.solution is not None
    assert "(ATT)" in log.solution.name
    assert set(log.solution.columns) == {"q_nb"}
    np.testing.assert_allclose(attitude(log), [3.0, -2.0, 90.0], atol=1e-3)


def test_an_ekf_that_hardly_runs_is_not_either(tmp_path: Path) -> None:
    messages = lying(ekf=(3.0, -2.0, 90.0))
    found = [(name, (*v[:2], 0.0, 0.0, 0.0, *v[5:]) if name == "XKF1" and v[0] < us(6) else v) for name, v in messages]
    log = read(found, tmp_path)
    assert log.solution is not None
    assert "(ATT)" in log.solution.name


@pytest.mark.parametrize(("thought", "told"), [((8.0, -2.0), False), ((30.0, -2.0), True)])
def test_an_attitude_that_is_not_how_it_lies_is_no_reference(
    thought: tuple[float, float], told: bool, tmp_path: Path
) -> None:
    log = read(lying(thought), tmp_path)
    assert (log.solution is None) == told
    assert any("27 deg apart" in note for note in log.notes) == told


def test_where_an_ekf_is_refused_what_was_flown_by_is_looked_at(tmp_path: Path) -> None:
    log = read(lying(ekf=(30.0, -2.0, 90.0)), tmp_path)
    assert any("27 deg apart" in note for note in log.notes)
    np.testing.assert_allclose(attitude(log), [3.0, -2.0, 90.0], atol=1e-3)


@pytest.mark.parametrize("g", [0.0, 6.0, 14.0])
def test_no_rest_is_seen_where_gravity_is_not_felt(g: float, tmp_path: Path) -> None:
    """Accelerometers that are dead, or of a fall or a turn."""
    assert read(lying((30.0, -2.0), g=g), tmp_path).solution is not None


def test_one_unit_that_agrees_is_enough(tmp_path: Path) -> None:
    """The first has accelerometers that are stuck."""
    messages = [(name, (*v[:1], 1, *v[2:]) if name == "IMU" else v) for name, v in lying()]
    stuck = [("IMU", (v[0], 0, *v[2:5], 9.8, 0.0, 0.0)) for name, v in messages if name == "IMU"]
    log = read(sorted([*messages, *stuck], key=lambda one: one[1][0]), tmp_path)
    assert set(log.imus) == {"imu", "imu2"}
    assert log.solution is not None


def test_the_reference_is_the_inertial_units_attitude_whatever_the_trim(tmp_path: Path) -> None:
    """The vehicle's is logged: that of the unit, less the trim."""
    np.testing.assert_allclose(attitude(read(lying((1.0, -2.0), trim=2.0), tmp_path)), [3.0, -2.0, 90.0], atol=1e-3)


def test_a_place_that_is_given_is_kept(tmp_path: Path) -> None:
    log = read(lying(), tmp_path)
    given = {"source": "log", "file": "flight.bin", "reference": "none"}
    truth = LogTruth.model_validate({**given, "start": {"lat_deg": -33.0, "lon_deg": 151.0, "alt_m": 5.0}})
    (tmp_path / "flight.toml").write_text(draft.scenario(survey(log), tmp_path / "x", truth))
    kept = Scenario.load(tmp_path / "flight.toml").truth
    assert isinstance(kept, LogTruth)
    assert (kept.start, kept.reference) == (truth.start, "none")


def unfixed(messages: Messages, until: float) -> Messages:
    """The same with a receiver that has no fix up to a time."""
    return [
        (name, (*values[:2], 1, *values[3:]) if name == "GPS" and values[0] < us(until) else values)
        for name, values in messages
    ]


@pytest.mark.ci
@pytest.mark.parametrize("until", [10.0, 100.0])
@pytest.mark.parametrize("fields", [True, False])
def test_what_an_autopilot_thinks_before_a_fix_is_not_believed(until: float, fields: bool, tmp_path: Path) -> None:
    """Garbage for a position, and others that are on Earth, but nobody knew: a log with no fix is nowhere."""
    messages = [one for one in circling() if fields or one[0] != "MAG"]
    log = read(unfixed(with_solution(messages, garbage_until=5.0), until), tmp_path)
    assert log.solution is not None
    known = np.isfinite(log.solution.columns.get("lat", np.full(len(log.solution.t), np.nan)))
    assert np.array_equal(known, log.solution.t >= until)
    assert np.array_equal(np.isfinite(log.solution.columns["v_n"]).all(axis=1), known)
    text = draft.scenario(survey(log), tmp_path / "x", None)
    assert ("\nstart = " in text) == (until > SECONDS)
    assert ('kind = "ins"' in text) == (until < SECONDS)
    (tmp_path / "flight.toml").write_text(text)
    result = run(Scenario.load(tmp_path / "flight.toml"))
    assert np.isfinite(result.dataset["estimators/ahrs"].to_dataset(inherit=False).q_nb.values[-1]).all()


def test_the_command_says_what_to_give(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for until, told in ((0.0, False), (100.0, True)):
        read(unfixed(circling(), until), tmp_path)
        monkeypatch.setattr("sys.argv", ["testbed", "log", "--force", "--scenario", "x.toml", "flight.bin"])
        monkeypatch.chdir(tmp_path)
        with suppress(SystemExit):
            cli.main()
        assert ("where the flight was" in capsys.readouterr().out) == told


@pytest.mark.parametrize("receiver", [True, False])
def test_nothing_is_interpolated_from_nowhere(receiver: bool, tmp_path: Path) -> None:
    """Positions come once a second, attitudes five times."""
    told = [one for one in with_solution(circling(), garbage_until=9.9) if one[0] != "POS" or one[1][0] % 10**6 == 0]
    messages = unfixed(told, 10.0) if receiver else [one for one in told if one[0] != "GPS"]
    log = read(messages, tmp_path)
    assert log.solution is not None
    lat = np.degrees(log.solution.columns["lat"])
    assert np.array_equal(np.isfinite(lat), log.solution.t >= 10.0)
    assert np.nanmax(np.abs(lat - 47)) < 0.1


@pytest.mark.parametrize(("until", "taken"), [(100.0, "gnss2"), (0.95 * SECONDS, "gnss2"), (0.3 * SECONDS, "gnss")])
def test_a_draft_takes_the_receiver_that_has_fixes(until: float, taken: str, tmp_path: Path) -> None:
    second = [
        (name, (values[0], 1, *values[2:])) for name, values in circling() if name == "GPS"
    ]  # of the same kind, the second unit
    messages = sorted([*unfixed(circling(), until), *second], key=lambda one: one[1][0])
    text = draft.scenario(survey(read(messages, tmp_path)), tmp_path / "x", None)
    assert f'aids = ["{taken}"' in text


@pytest.mark.parametrize("heard", [1, 2])
def test_what_was_heard_once_is_no_aid(heard: int, tmp_path: Path) -> None:
    fields = [one for one in circling() if one[0] == "MAG"]
    log = read([one for one in circling() if one[0] != "MAG" or one in fields[:heard]], tmp_path)
    text = draft.scenario(survey(log), tmp_path / "x", None)
    assert "[sensors.magnetometer]" in text
    assert ('"magnetometer"]' in text) == (heard > 1)


def test_places_where_no_aircraft_is_are_not_believed_without_a_receiver_either(tmp_path: Path) -> None:
    log = read([one for one in with_solution(circling(), garbage_until=5.0) if one[0] != "GPS"], tmp_path)
    assert log.solution is not None
    known = np.isfinite(log.solution.columns["lat"])
    assert known.any()
    assert np.array_equal(known, log.solution.t >= 5.0)


@pytest.mark.ci
@pytest.mark.parametrize(("off_deg", "told"), [(0.0, False), (0.001, True)])
def test_a_solution_that_is_not_where_its_receiver_was_is_told(off_deg: float, told: bool, tmp_path: Path) -> None:
    log = read(with_solution(circling(), off_deg), tmp_path)  # 12 m/s, for which 16 m are allowed
    assert ("111 m (RMS) from gnss" in log.remark) == told
    text = draft.scenario(survey(log), tmp_path / "x", None)
    (tmp_path / "flight.toml").write_text(text)
    scenario = Scenario.load(tmp_path / "flight.toml", {"duration_s": 20.0})
    assert isinstance(scenario.truth, LogTruth)
    assert scenario.truth.reference == ("gnss" if told else "solution")  # of a draft: who is right
    by_solution = run(scenario.changed({"truth.reference": "solution"}))
    assert any("judges by the receiver" in one for one in by_solution.remarks) == told
    assert not any("judges by the receiver" in one for one in run(scenario).remarks)


def test_heights_from_before_an_autopilot_knew_its_origins_are_no_heights(tmp_path: Path) -> None:
    """A real one counted from where it was switched on for 16 s, 590 m below; exports took their origin from that."""
    early = [
        (name, (*v[:3], v[3] - 500.0) if name == "POS" and v[0] < us(5.0) else v)
        for name, v in with_solution(circling())
    ]
    found = read(early, tmp_path).solution
    assert found is not None
    before = found.t < 4.9
    assert np.isnan(found.columns["h"][before]).all()
    np.testing.assert_allclose(found.columns["h"][~before][2:], 500.0, atol=1e-3)
    # what a receiver says for a while later on is no other zero, nor are heights that are all below: told of otherwise
    for off_m, since, until in ((-500.0, 10.0, 15.0), (-500.0, 0.0, math.inf)):
        odd = [
            (name, (*v[:3], v[3] + off_m) if name == "POS" and us(since) <= v[0] < until * 1e6 else v)
            for name, v in with_solution(circling())
        ]
        solution = read(odd, tmp_path).solution
        assert solution is None or np.isfinite(solution.columns["h"][2:]).all()


@pytest.mark.parametrize(("below_m", "told"), [(0.0, False), (8.0, False), (20.0, True)])
def test_a_solution_that_is_below_its_receiver_is_told(below_m: float, told: bool, tmp_path: Path) -> None:
    messages = with_solution(circling())
    low = [(name, (*v[:3], v[3] - below_m) if name == "POS" else v) for name, v in messages]
    said = '(XKF1) is 20 m below gnss (median): truth.reference = "gnss" judges by the receiver'
    log = read(low, tmp_path)
    assert log.remark == (f"the autopilot's own solution {said}" if told else "")
    assert ('reference = "gnss"' in draft.scenario(survey(log), tmp_path / "x", None)) == told


@pytest.mark.parametrize("below_m", [0.0, 20.0])
def test_a_px4_solution_that_is_below_its_receiver_is_told(below_m: float, tmp_path: Path) -> None:
    messages: Messages = []
    for k in range(1, 101):
        t, place = us(k / 100), (470_000_000, 80_000_000, 500_000, 500_000)
        messages.append(("vehicle_imu", (t, 0.0, 0.0, 0.0, 0.0, 0.0, -0.098, 10_000, 10_000)))
        messages.append(("vehicle_attitude", (t, 1.0, 0.0, 0.0, 0.0)))
        messages.append(("vehicle_local_position", (t, 47.0, 8.0, 500.0 - below_m, *[0.0] * 6)))
        messages.append(("vehicle_gps_position", (t, *place, 0.3, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 3, 9)))
    assert ("20 m below gnss" in formats.read(ulog(messages, tmp_path / "flight.ulg"), {}).remark) == bool(below_m)


@pytest.mark.parametrize(("late_s", "told"), [(0.2, False), (1.0, True)])
def test_a_fast_aircraft_is_no_reason_to_doubt_its_solution(late_s: float, told: bool) -> None:
    """At 60 m/s a receiver that is told of late is 12 m behind an exact solution; a second late is another matter."""
    t = np.arange(0.0, 60.0, 0.1)
    north, zero = np.radians(47) + 60.0 * t / 6.37e6, np.zeros(len(t))
    v_n = np.tile([60.0, 0.0, 0.0], (len(t), 1))
    solution = Reference("its own solution", t, {"lat": north, "lon": zero, "h": zero + 500.0, "v_n": v_n})
    fixes = [
        GnssSample(
            t=one, t_arrival=one, lat=np.interp(one - late_s, t, north), lon=0.0, h=500.0, v_n=v_n[0],
            sigma_position_n=np.ones(3), sigma_velocity_n=np.ones(3), fix_type=FixType.FIX_3D, satellites=9, hdop=1.0,
            vdop=1.0, sensor="gnss",
        )
        for one in np.arange(2.0, 59.0, 0.2).tolist()
    ]  # fmt: skip
    assert bool(doubt(solution, {"gnss": fixes})) == told


@pytest.mark.ci
@pytest.mark.parametrize("later", [0.03, 0.31, 7.0])
def test_an_inertial_unit_may_begin_later_than_the_log(later: float, tmp_path: Path) -> None:
    """Every sensor is heard from the beginning on, and estimators know that no increments were."""
    text = draft.scenario(survey(read(circling(silent=(0.0, later)), tmp_path)), tmp_path / "x", None)
    (tmp_path / "flight.toml").write_text(text)
    result = run(Scenario.load(tmp_path / "flight.toml", {"duration_s": 20.0}))
    own = result.dataset["estimators/ins"].to_dataset(inherit=False)
    aligned = own.time.values[np.isfinite(own.q_nb.values).all(axis=1)]
    assert later < aligned[0] < later + 4.0


@pytest.mark.ci
@pytest.mark.parametrize("until", [0.0, 20.0, 35.0])
def test_what_can_be_seen_where_nobody_knows_the_motion(until: float, tmp_path: Path) -> None:
    """Of a log without attitude nothing is said; where the autopilot falls silent the last that it said is taken."""
    messages = circling()
    for k in range(1, int(until * GNSS_HZ)):
        t = k / GNSS_HZ
        course = np.degrees(TURN * t) % 360
        velocity = SPEED * np.cos(TURN * t), SPEED * np.sin(TURN * t), 0.0
        messages.append(("XKF1", (us(t), 0, 0.0, 0.0, course, *velocity)))
        messages.append(("POS", (us(t), 47.0, 8.0, 500.0)))
    (tmp_path / "flight.toml").write_text(draft.scenario(survey(read(messages, tmp_path)), tmp_path / "x", None))
    seen = of_run(run(Scenario.load(tmp_path / "flight.toml", {"duration_s": 45.0})).dataset)
    assert list(seen) == (["ins", "ahrs"] if until else [])
    for name, one in seen.items():
        assert np.isfinite(one.share).all()
        assert one.rank[-1] >= (6 if name == "ins" else 2)  # in a circle of which a compass is all that is told


def autopilot_of(raw_hz: float, corrected_hz: float) -> Messages:
    """PX4 with two magnetometers and gyros logged raw, a quarter turn about down off, and as it corrected them."""
    found: list[tuple[float, str, tuple[Any, ...]]] = []
    for k in range(1, int(20 * corrected_hz) + 1):
        t = k / corrected_hz
        step = round(1e6 / corrected_hz)
        turned, pushed = (0.1 / corrected_hz, 0.0, 0.0), (0.0, 0.0, -9.81 / corrected_hz)
        found.append((t, "vehicle_imu", (us(t), *turned, *pushed, step, step)))
        found.append((t, "vehicle_magnetometer", (us(t), 0.2, 0.0, 0.4)))
    for k in range(1, int(20 * raw_hz) + 1):
        t = k / raw_hz
        for unit in ("", ":1"):
            found.append((t, f"sensor_mag{unit}", (us(t), 0.0, 0.9, 0.4)))
            found.append((t, f"sensor_gyro{unit}", (us(t), 0.0, 0.1, 0.0)))
            found.append((t, f"sensor_accel{unit}", (us(t), 0.0, 0.0, -9.81)))
    found.sort(key=lambda one: one[0])
    return [(name, values) for _, name, values in found]


@pytest.mark.parametrize("raw_hz", [49.0, 400.0])
def test_what_the_autopilot_corrected_is_taken_before_what_is_raw(raw_hz: float, tmp_path: Path) -> None:
    """Though there are more samples of the raw ones, of both units together or of each."""
    log = formats.read(ulog(autopilot_of(raw_hz, 50.0), tmp_path / "flight.ulg"), {})
    assert list(log.imus) == ["imu"]
    assert list(log.samples) == ["magnetometer"]
    imu = log.imus["imu"]
    assert np.allclose(imu.dtheta / imu.dt[:, None], [0.1, 0.0, 0.0], atol=1e-4)
    for one in log.samples["magnetometer"]:
        assert isinstance(one, MagnetometerSample)
        assert np.allclose(one.field_b, [20e-6, 0.0, 40e-6])


def test_raw_units_are_taken_where_the_corrected_ones_are_slow(tmp_path: Path) -> None:
    log = formats.read(ulog(autopilot_of(200.0, 2.0), tmp_path / "flight.ulg"), {})
    assert list(log.imus) == ["imu", "imu2"]
    assert list(log.samples) == ["magnetometer"]
    raw = [one for one in autopilot_of(200.0, 2.0) if one[0] != "vehicle_magnetometer"]
    alone = formats.read(ulog(raw, tmp_path / "raw.ulg"), {})
    assert list(alone.samples) == ["magnetometer", "magnetometer2"]


def test_a_solution_in_metres_across_the_date_line_has_longitudes_as_they_are(tmp_path: Path) -> None:
    """Told from a point west of it: eastward, on to the other side."""
    told = autopilot_of(49.0, 50.0)
    for k in range(200):
        t = 0.1 * (k + 1)
        place, v = (-17.0, 179.9999, 100.0, 0.0, 20.0 * t, 0.0), (0.0, 20.0, 0.0)
        told.append(("vehicle_attitude", (us(t), 1.0, 0.0, 0.0, 0.0)))
        told.append(("vehicle_local_position", (us(t), *place, *v)))
    log = formats.read(ulog(told, tmp_path / "flight.ulg"), {})
    assert log.solution is not None
    east = np.degrees(log.solution.columns["lon"])
    assert -180.0 < east[-1] < -179.99
    np.testing.assert_allclose(np.mod(east, 360.0)[5:], 179.9999 + 20.0 * log.solution.t[5:] / 106447.0, atol=2e-5)


@pytest.mark.parametrize("lacking", ["HDop", "NSats", "Status", "VZ", "Spd"])
def test_a_receiver_whose_messages_lack_a_field_is_heard(
    lacking: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was left out; and without a velocity down its fixes, place and all, were refused by every filter."""
    letters, names = log_writers.DATAFLASH["GPS"]
    at = names.split(",").index(lacking)
    fewer = letters[:at] + letters[at + 1 :], ",".join(one for one in names.split(",") if one != lacking)
    monkeypatch.setitem(log_writers.DATAFLASH, "GPS", fewer)
    messages = [(name, values[:at] + values[at + 1 :] if name == "GPS" else values) for name, values in circling()]
    log = read(messages, tmp_path)
    fixes = [one for one in log.samples["gnss"] if isinstance(one, GnssSample)]
    assert len(fixes) == SECONDS * GNSS_HZ
    assert all(one.has_fix for one in fixes)
    assert all(np.isfinite(one.v_n).all() == (lacking not in ("VZ", "Spd")) for one in fixes)
    assert any(note.startswith("gnss: ") for note in log.notes)
