"""An estimator of attitude alone, from the scenario to every output: what it does not estimate appears nowhere."""

from __future__ import annotations

import collections
import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import all as mav
from rich.console import Console
from scipy.spatial.transform import Rotation
from worlds.lanes import lanes

from nav.ahrs import Ahrs, AhrsConfig, AnyMotion
from nav.motion import LowDynamics
from nav.samples import AirspeedSample, Outcome, UpdateReport
from testbed import RunResult, Scenario, run
from testbed.errors import UserError
from testbed.estimators.ahrs import AhrsSection
from testbed.exports import export
from testbed.many import campaign
from testbed.many.campaign import CampaignResult, Combination
from testbed.mavlink import MavlinkPublisher
from testbed.record import reader as record
from testbed.record.recorder import Recorder
from testbed.report import campaign as campaign_report
from testbed.report import campaign_figures, tables
from testbed.report import page as report
from testbed.report.figures import consistency, flight
from testbed.report.figures import errors as errors_figures
from testbed.report.run import Run
from testbed.score import accuracy, detection, metrics

INS = '{name="ins", aids=["gnss", "barometer", "magnetometer", "airspeed"]}'
AHRS = '{name="ahrs", kind="ahrs", aids=["airspeed", "magnetometer", "barometer"]}'
BLIND = '{name="blind", kind="ahrs", aids=[], heading_deg=90}'
GYROS = '{name="gyros", kind="ahrs", aids=[], heading_deg=90, levelling=false}'
OF_ATTITUDE = {
    f"{quantity}_{statistic}_deg"
    for quantity in ("roll", "pitch", "heading")
    for statistic in ("rms", "max", "mean", "std")
} | {"roll_pitch_rms_deg", "roll_pitch_max_deg", "attitude_nees_mean"}


def scenario(*chosen: str, overrides: tuple[str, ...] = ()) -> Scenario:
    return Scenario.load("u_turn", [f"estimator=[{', '.join(chosen)}]", "expect={}", *overrides])


def config(*chosen: str, overrides: tuple[str, ...] = ()) -> Any:
    """What the last of the estimators is told."""
    ahrs = list(lanes(scenario(*chosen, overrides=overrides), 0).values())[-1].horizon.estimator
    assert isinstance(ahrs, Ahrs)
    return ahrs.config


# --- the scenario


@pytest.mark.parametrize(
    ("estimator", "says"),
    [
        ('{name="a", kind="ahrs", aids=["airspeed"]}', "estimator[0].heading_deg: is missing: an AHRS without magnet"),
        ('{name="a", kind="ahrs", aids=["magnetometer"], heading_deg=3}', "heading_deg: the magnetometer among the"),
        (
            '{name="a", kind="ahrs", aids=["gnss"], heading_deg=3}',
            "'gnss' is of kind 'gnss', which does not aid 'ahrs'",
        ),
        ('{name="a", kind="ahrs", aids=[], heading_deg=400}', "heading_deg: must be less than or equal to 360"),
        ('{name="a", aids=["gnss"], heading_deg=3}', "heading_deg: is a key of kind 'ahrs', not of 'ins': leave it"),
        ('{name="a", aids=["gnss"], levelling=false}', "levelling: is a key of kind 'ahrs', not of 'ins'"),
        ('{name="a", aids=["gnss"], level={}}', "level: is a key of kind 'ahrs', not of 'ins'"),
        ('{name="a", kind="ahrs", aids=[], heading_deg=0, level={test="nrm"}}', 'level.test: can\'t be "nrm"'),
        ('{name="a", kind="ahrs", aids=[], heading_deg=3, literal=true}', "literal: unknown key"),
        (
            '{name="a", kind="ahrs", aids=[], heading_deg=3, profile="any_motion", level={}}',
            'level: says how profile "jiang2021" levels',
        ),
        ('{name="a", kind="ahrz", aids=[]}', 'kind: there is no kind "ahrz": did you mean ahrs'),
    ],
)
def test_wrong_scenarios_are_told(estimator: str, says: str) -> None:
    with pytest.raises(UserError) as caught:
        scenario(estimator)
    assert says in str(caught.value)


def test_it_is_told_the_datasheets() -> None:
    told = config(BLIND, overrides=("sensors.imu.grade=mems-consumer",))
    assert told.imu.gyro_noise == pytest.approx(math.radians(0.3) / 60)
    assert told.imu.gyro_bias_sigma >= math.radians(40) / 3600
    assert (told.lat, told.h, told.heading) == (math.radians(47.0), 300.0, math.pi / 2)
    assert told.aids == ()
    # hard iron of 0.5 uT in about 21 uT of horizontal field is 1.4 deg; 15 s of it at 10 Hz, as white noise: times 17
    assert 0.3 < config(AHRS).magnetometer_sigma < 0.6
    strong = config(AHRS, overrides=("sensors.magnetometer.hard_iron_ut=5.0",))
    assert strong.magnetometer_sigma > 8 * config(AHRS).magnetometer_sigma


def test_it_is_told_how_to_level() -> None:
    house, paper = config(BLIND), config(BLIND.replace("}", ", level={}}"))
    assert (house.force_sigma, paper.force_sigma) == (0.3, 0.1)
    assert house.motion == paper.motion == paper.compensated_motion != house.compensated_motion
    keys = (
        'acceleration_mps2=0.5, yaw_rate_degps=1, roll_rate_degps=3, test="vector", force_sigma_mps2=0.2, '
        "limit_deg=0.4, gyro_bias_feedback=true"
    )
    told = config(AHRS.replace("}", f", level={{{keys}}}}}"))
    assert told.motion == told.compensated_motion == LowDynamics(0.5, math.radians(1), math.radians(3), "vector")
    assert (told.force_sigma, told.phi_limit, told.gyro_bias_feedback) == (0.2, math.radians(0.4), True)


def test_the_description_of_how_it_levels_says_what_one_key_changes() -> None:
    """One key of `level` puts the paper's limits in place of all others, and only the defaults were said."""
    house, one = config(AHRS), config(AHRS.replace("}", ", level={limit_deg=0.2}}"))
    assert (one.compensated_motion, one.force_sigma) == (LowDynamics(), AhrsConfig.force_sigma)
    limits = house.compensated_motion
    told = AhrsSection.model_fields["level"].description
    assert told is not None
    for key, value in {
        "force_sigma_mps2": house.force_sigma,
        "acceleration_mps2": limits.acceleration_limit,
        "yaw_rate_degps": math.degrees(limits.yaw_rate_limit),
        "roll_rate_degps": math.degrees(limits.roll_rate_limit),
    }.items():
        assert f"{key} {value:g}" in told
    assert "a table of any one key sets all others" in told


def test_corrections_are_never_slower_than_the_drift() -> None:
    assert config(BLIND).phi_limit == math.radians(0.2)
    hobby = config(BLIND, overrides=("sensors.imu.grade=mems-hobby",))
    assert hobby.phi_limit > 3 * math.radians(1000 / 3600)  # what the grade says of turn-on, in a period of a second
    told = config(BLIND.replace("}", ", level={limit_deg=0.3}}"), overrides=("sensors.imu.grade=mems-hobby",))
    assert told.phi_limit == math.radians(0.3)


def test_it_is_told_to_level_in_any_motion() -> None:
    told, house = config(AHRS.replace("}", ', profile="any_motion"}')), config(AHRS)
    assert house.any_motion is None
    assert told.any_motion == AnyMotion()
    assert told.imu.gyro_bias_walk < house.imu.gyro_bias_walk  # turns widen the attitude's noise instead
    assert told.magnetometer_sigma == house.magnetometer_sigma


# --- a run


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunResult, dict[str, list[Any]], Path]:
    """A U-turn, with GNSS denied for some of it, as a station would see the AHRS: result, messages, folder."""
    folder = tmp_path_factory.mktemp("ahrs")
    flight = scenario(AHRS, INS, BLIND, GYROS, overrides=("duration_s=100", "sensors.gnss.denied=[[75, 88]]"))
    publisher = MavlinkPublisher([f"tlog:{folder / 'run.tlog'}"], flight)
    result = run(flight, out=folder, links=[publisher])
    reader = mavutil.mavlink_connection(str(folder / "run.tlog"), dialect="all")
    heard = collections.defaultdict(list)
    while message := reader.recv_msg():
        heard[message.get_type()].append(message)
    reader.close()
    return result, heard, folder


def test_metrics_are_of_attitude_alone(flown: Any) -> None:
    found = flown[0].metrics
    keys = {key.removeprefix("ahrs.") for key in found if key.startswith("ahrs.")}
    levelled = {"nis_mean.level", "rejected_fraction.level"}
    quiet = {"false_alarms_per_look", "false_alarms_per_h"}
    heading = {"nis_mean.magnetic_heading", "rejected_fraction.magnetic_heading"}
    assert keys == OF_ATTITUDE | {f"outage_{key}" for key in OF_ATTITUDE} | {"aligned_s"} | levelled | heading | quiet
    assert all(math.isfinite(value) for value in found.values())
    assert "ins.outage_position_horizontal_max_m" in found
    assert found["ahrs.roll_pitch_max_deg"] < 1.0
    assert found["ahrs.heading_max_deg"] < 5.0
    assert found["ahrs.outage_roll_pitch_max_deg"] < 1.0
    assert "gyros.nis_mean.level" not in found


def run_until(dataset: Any, end: float) -> Any:
    """The record without the truth after ``end``: rows without truth have no errors."""
    cut = dataset.copy()
    cut["truth"] = dataset["truth"].isel(time=dataset["truth"]["time"].values < end)
    return cut


def test_errors_are_those_of_the_attitude(flown: Any) -> None:
    """By rotations of scipy: the angle between the verticals, over the rows that count."""
    result = flown[0]
    own, truth = result.dataset["estimators/ahrs"], result.dataset["truth"]
    t = own["time"].values
    rows = (t >= result.metrics["ahrs.aligned_s"] + accuracy.SETTLING_S) & (t < 74.9)
    np.testing.assert_array_equal(t, truth["time"].values)
    verticals = [
        Rotation.from_quat(q[rows], scalar_first=True).inv().apply([0.0, 0.0, 1.0])
        for q in (own["q_nb"].values, truth["q_nb"].values)
    ]
    angle = np.degrees(np.arccos(np.clip(np.sum(verticals[0] * verticals[1], axis=1), -1, 1)))
    assert len(angle) > 100
    found = metrics.compute(run_until(result.dataset, 74.9))
    assert found["ahrs.roll_pitch_max_deg"] == pytest.approx(angle.max(), rel=1e-3)
    assert found["ahrs.roll_pitch_rms_deg"] == pytest.approx(np.sqrt(np.mean(angle**2)), rel=1e-3)


def test_a_lost_attitude_counts_as_not_finite(flown: Any) -> None:
    dataset = flown[0].dataset.copy(deep=True)
    dataset["estimators/ahrs"]["q_nb"].values[500:510] = np.nan
    assert metrics.compute(dataset)["ahrs.nonfinite_samples"] == 10


def test_levelling_is_recorded_as_what_it_is(flown: Any) -> None:
    dataset = flown[0].dataset
    for name, least in (("ahrs", 80), ("blind", 8)):  # without any aid as well
        level = dataset[f"estimators/{name}/innovations/level"]
        assert level["innovation"].attrs["units"] == "m/s^2"
        assert level["innovation"].dims == ("sample_time", "north_east")
        assert np.isinf(level["threshold"].values).all()
        assert (level["weight"].values == 1.0).all()
        t = level["sample_time"].values
        np.testing.assert_allclose(t, np.round(t), atol=1e-9)
        assert (np.diff(t) > 0).all()
        assert len(t) > least
    assert dataset["estimators/ahrs/innovations/magnetic_heading/innovation"].attrs["units"] == "rad"
    assert "innovations" not in dataset["estimators/gyros"].children
    for counter in ("mode_counter", "correction_counter"):
        assert dataset[f"estimators/ahrs/{counter}"].attrs["units"] == "1"
    assert dataset["estimators/gyros/mode_counter"].values[-1] == 0


def test_a_sample_that_is_refused_is_recorded(tmp_path: Path) -> None:
    flight = scenario(AHRS, overrides=("duration_s=1",))
    refused = Ahrs(config(AHRS)).refuse(AirspeedSample(0.5, 0.5, math.nan), "not finite")
    level = UpdateReport(1.0, "accelerometer", "level", np.zeros(2), np.eye(2), 0.0, math.inf, 1.0, Outcome.FUSED)
    recorder = Recorder(tmp_path / "run.nc", flight, 1)
    recorder.reports("ahrs", [*refused, level])
    recorder.close()
    own = record.load(tmp_path / "run.nc")["estimators/ahrs/innovations"]
    assert own["airspeed"]["reason"].values.tolist() == ["not finite"]
    assert own["airspeed"]["weight"].values.tolist() == [0.0]
    dataset = recorder.dataset()
    assert detection.innovation_scores(dataset, "ahrs", "airspeed", 0.0) == {}  # the gate has judged nothing


# --- what is shown


@pytest.mark.ci
def test_report_shows_attitude_where_there_is_no_position(flown: Any, tmp_path: Path) -> None:
    report.write_report(flown[0].dataset, flown[0].metrics, tmp_path)
    images = {path.stem for path in tmp_path.glob("*.png")}
    for name, aided in (("ahrs", True), ("blind", True), ("gyros", False)):
        own = {f"{name}_attitude_errors", f"{name}_biases"} | ({f"{name}_innovations"} if aided else set())
        assert {image for image in images if image.startswith(f"{name}_")} == own
    assert {"ins_position_errors", "ins_motion_errors", "attitude", "comparison", "nees"} <= images


def lines(axes: Any) -> set[str]:
    return {line.get_label() for line in axes.get_lines() if len(line.get_xdata())}  # not what only the legend has


def test_figures_compare_what_there_is(flown: Any) -> None:
    every = Run(flown[0].dataset)
    position, height, tilt, heading = errors_figures.comparison(every).axes
    assert lines(position) == lines(height) == {"ins", "bound"}
    assert lines(tilt) == lines(heading) == {"ahrs", "ins", "blind", "gyros", "bound"}
    assert "ahrs" not in lines(flight.ground_track(every).axes[0]) | lines(flight.flight(every).axes[0])
    alone = Run(flown[0].dataset)
    del alone.errors["ins"]
    assert len(errors_figures.comparison(alone).axes) == 2
    assert len(consistency.consistency(alone).axes) == 1
    assert len(errors_figures.motion_errors(alone, "ahrs").axes) == 3


def test_table_has_no_rows_that_nobody_can_fill(flown: Any) -> None:
    def printed(found: dict[str, float]) -> str:
        out = io.StringIO()
        Console(file=out, width=160).print(tables.summary(found))
        return out.getvalue()

    alone = {key: value for key, value in flown[0].metrics.items() if not key.startswith("ins.")}
    assert "position" in printed(flown[0].metrics)
    assert "position" not in printed(alone)
    assert "roll and pitch" in printed(alone)


def test_a_station_sees_the_attitude_and_no_position(flown: Any) -> None:
    result, heard, _ = flown
    own = result.dataset["estimators/ahrs"]
    rows = {round(t * 1e3): k for k, t in enumerate(own["time"].values)}
    compared = 0
    for message in heard["ATTITUDE"]:
        k = rows.get(message.time_boot_ms)
        if k is not None:
            angles = [message.yaw, message.pitch, message.roll]
            turned = (
                Rotation.from_euler("ZYX", angles) * Rotation.from_quat(own["q_nb"].values[k], scalar_first=True).inv()
            )
            assert turned.magnitude() < 1e-6
            compared += 1
    assert compared > 400
    assert len(heard["ATTITUDE_QUATERNION"]) > 900
    unknown = ("GLOBAL_POSITION_INT", "LOCAL_POSITION_NED", "HOME_POSITION", "ODOMETRY", "ALTITUDE", "VFR_HUD", "AHRS3")
    assert not [name for name in unknown if heard[name]]
    assert heard["AHRS2"], "the INS beside it has a position"
    assert {message.flags for message in heard["ESTIMATOR_STATUS"][10:]} == {mav.ESTIMATOR_ATTITUDE}
    assert all(math.isnan(message.pos_horiz_accuracy) for message in heard["ESTIMATOR_STATUS"])
    assert heard["HEARTBEAT"][-1].system_status == mav.MAV_STATE_ACTIVE
    named = collections.Counter(message.name for message in heard["NAMED_VALUE_FLOAT"])
    assert set(named) == {"err_tilt", "err_head", "sig_tilt", "sig_head"}
    assert all(abs(m.value) < 2.0 for m in heard["NAMED_VALUE_FLOAT"] if m.name == "err_tilt" and m.time_boot_ms > 6e4)


@pytest.mark.ci
def test_export(flown: Any, tmp_path: Path) -> None:
    folder = export(flown[2] / "run.nc", "csv", tmp_path / "csv")
    own = pandas.read_csv(folder / "estimators.ahrs.csv")
    assert own["lat [rad]"].isna().all()
    assert own["q_nb.w [1]"].notna().sum() > 900
    level = pandas.read_csv(folder / "estimators.ahrs.innovations.level.csv")
    assert level["innovation.north [m/s^2]"].notna().all()
    assert np.isinf(level["threshold [1]"]).all()
    assert export(flown[2] / "run.nc", "mat", tmp_path / "run.mat").stat().st_size > 100_000


@pytest.mark.ci
def test_a_campaign_counts_degrees(flown: Any, tmp_path: Path) -> None:
    result = flown[0]
    history = campaign.history_of(result.dataset)
    errors = accuracy.errors(result.dataset, "ahrs")
    np.testing.assert_allclose(np.nanmax(history["ahrs.error"][60:]), np.rad2deg(errors.tilt[600:].max()), rtol=0.2)
    assert np.nanmean(history["ahrs.nees"]) > 0.0
    own = Scenario.load("u_turn", [f"estimator=[{AHRS}, {INS}, {BLIND}, {GYROS}]", "expect={}"])
    combination = Combination({}, own)
    outcomes = [campaign.Outcome(0, seed, result.metrics, history) for seed in (1, 2)]
    statistics = campaign_report.statistics([combination], outcomes)
    gathered = CampaignResult(tmp_path, [combination], outcomes, [], statistics)
    made = campaign_figures.figures(gathered)
    assert [axes.get_ylabel() for axes in made["errors"].figure.axes[:2]] == [
        "roll, pitch error [deg]",
        "horizontal error [m]",
    ]
    assert [axes.get_ylabel() for axes in made["nees"].figure.axes[:2]] == [
        "attitude NEES / dof",
        "position NEES / dof",
    ]
    campaign_report.save(gathered)
    kept = json.loads((tmp_path / "campaign.json").read_text())
    of_ahrs = {spread["metric"] for spread in kept["spreads"] if spread["estimator"] == "ahrs"}
    assert "outage_roll_pitch_max_deg" in of_ahrs
    assert not [metric for metric in of_ahrs if "position" in metric]
