"""What the filters are told: the datasheet of the sensors that they are given, and of no other."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worlds.lanes import lanes

from nav.aids import AirspeedAid, GnssAid, MagnetometerAid
from nav.detection import Eraim, Glr, Mean, Reset, Sprt, WindowMean, exponential, plain
from nav.earth import position_difference_n
from nav.error_model import CROSS
from nav.federated import Federated
from nav.ins import Ins
from nav.unscented import Scaling
from nav.weighting import MahalanobisInflation, SageHusa
from testbed import Scenario, papers, run
from testbed.errors import UserError
from testbed.feeds.simulated import motion
from testbed.motion.kinematic import Kinematic
from testbed.motion.sections import KinematicStart
from testbed.score import accuracy
from testbed.sensors import build as build_sensor
from testbed.sensors.imu import ImuConfig, _axis_errors

TWO_RECEIVERS = [
    "duration_s=20",
    "sensors.gnss.grade=rtk",
    'sensors.gnss2={kind="gnss", lever_arm_m=[20.0, 0.0, 0.0], denied=[[8, 15]]}',
    'estimator=[{name="ins", aids=["gnss2", "barometer", "magnetometer", "airspeed"]}]',
    "expect={}",
]


def told(scenario: Scenario, name: str = "ins") -> Ins:
    inner = lanes(scenario, 0)[name].horizon.estimator
    assert isinstance(inner, Ins)
    return inner


def test_datasheet_units() -> None:
    model = told(Scenario.load("loiter_gnss_outage")).config.imu
    hour = 3600.0
    assert model.gyro_noise == pytest.approx(math.radians(0.3) / math.sqrt(hour))
    assert model.accel_noise == pytest.approx(0.06 / math.sqrt(hour))
    assert model.gyro_bias_sigma >= math.radians(40) / hour
    assert model.accel_bias_sigma >= 2e-3 * 9.80665


def test_drift_and_scale_factors_are_states_when_asked_for() -> None:
    """Then no walk and no sigma of a bias stands in for them; misalignment has no state either way."""
    scenario = Scenario.load("loiter_gnss_outage")
    imu = scenario.sensors["imu"]
    assert isinstance(imu, ImuConfig)
    e, biases = imu.errors(), told(scenario).config.imu
    full = told(Scenario.load("loiter_gnss_outage", ['estimator.ins.states="full"'])).config.imu
    assert (biases.gyro_drift_sigma, biases.accel_drift_sigma) == (0.0, 0.0)
    assert (biases.gyro_scale_sigma, biases.accel_scale_sigma) == (0.0, 0.0)
    assert (full.gyro_drift_sigma, full.accel_drift_sigma) == (e.gyro_in_run, e.accel_in_run)
    assert (full.gyro_drift_correlation_s, full.accel_drift_correlation_s) == (e.gyro_in_run_tau, e.accel_in_run_tau)
    assert (full.gyro_scale_sigma, full.accel_scale_sigma) == (e.gyro_scale, e.accel_scale)
    rate, load, changes = 0.06, 0.1 * 9.80665, 1 / math.sqrt(120)
    gyro, accel = rate * e.gyro_scale, load * e.accel_scale
    drift = e.gyro_in_run * math.sqrt(2 / e.gyro_in_run_tau), e.accel_in_run * math.sqrt(2 / e.accel_in_run_tau)
    for before, after, parts in (
        (biases.gyro_bias_walk, full.gyro_bias_walk, (gyro * changes, drift[0])),
        (biases.accel_bias_walk, full.accel_bias_walk, (accel * changes, drift[1])),
        (biases.gyro_bias_sigma, full.gyro_bias_sigma, (gyro, e.gyro_in_run)),
        (biases.accel_bias_sigma, full.accel_bias_sigma, (10 * accel, e.accel_in_run)),
    ):
        assert before == pytest.approx(math.hypot(after, *parts))
        assert after > 0


def test_misalignment_is_a_state_when_asked_for() -> None:
    """Their prior is that of the draws of which a unit is made; no walk of a bias stands in for them."""
    scenario = Scenario.load("loiter_gnss_outage", ['estimator.ins.states="matrix"'])
    imu = scenario.sensors["imu"]
    assert isinstance(imu, ImuConfig)
    e, found = imu.errors(), told(scenario)
    full = told(Scenario.load("loiter_gnss_outage", ['estimator.ins.states="full"'])).config.imu
    for sensor in ("gyro", "accel"):
        turned, leaning = (getattr(e, f"{sensor}_{what}") for what in ("misalignment", "nonorthogonality"))
        draws = np.diag([turned] * 3 + [leaning] * 3)  # each alone, by one sigma
        units = np.array([_axis_errors(np.zeros(3), draw[:3], draw[3:]) for draw in draws])
        felt = np.array([units[:, axis, of] for axis, of in CROSS])
        own = found.model.slices[f"{sensor}_cross"]
        np.testing.assert_allclose(found.model.prior[own, own], felt @ felt.T, atol=1e-12)
    assert full.gyro_misalignment == full.accel_nonorthogonality == 0.0
    assert found.config.imu.gyro_bias_walk < full.gyro_bias_walk
    stood_in = math.hypot(e.accel_misalignment, e.accel_nonorthogonality) * 9.80665
    assert math.hypot(found.config.imu.accel_bias_sigma, stood_in) == pytest.approx(full.accel_bias_sigma)
    assert found.config.mounting_sigma == 0.0
    assert {"gyro_cross", "accel_cross"} <= found.model.slices.keys()


@pytest.mark.ci
@pytest.mark.parametrize("engine", ["linear", pytest.param("unscented", marks=pytest.mark.slow)])
def test_scale_factors_are_found_in_flight(engine: str) -> None:
    """Against what the unit makes of true increments, without its biases and noise."""
    estimator = (
        f"{{name='ins', states='full', aids=['gnss', 'stars'], engine='{engine}',"
        " handover={level_deg=0.1, heading_deg=0.1, velocity_mps=0.1, position_m=1}}"
    )
    scale = {"gyro_scale_ppm": 2000.0, "accel_scale_ppm": 2000.0}
    overrides = [
        *(f"sensors.imu.{key}={ppm}" for key, ppm in scale.items()),
        "sensors.imu.grade='perfect'",
        "sensors.imu.gyro_turn_on_degph=1",
        "sensors.imu.accel_turn_on_mg=0.1",
        "sensors.imu.angle_random_walk_degprth=0.01",
        "sensors.imu.velocity_random_walk_mpsprth=0.01",
        "sensors.stars={kind='star_tracker'}",
        "sensors.gnss={grade='rtk', rate_hz=1}",
        "duration_s=240",
        f"estimator=[{estimator}]",
        "expect={}",
    ]
    scenario = Scenario.load("kinematic_u_flight", overrides)
    done = run(scenario, seed=4)
    truth = motion(scenario, 4).advance(240 * 200 + 1)
    units = (ImuConfig(grade="perfect", **scale), ImuConfig(grade="perfect"))
    sensed = [build_sensor("imu", unit, 200.0, 4, scenario.site()).sense(truth) for unit in units]
    own, true = (np.hstack([unit.dtheta, unit.dv]).sum(axis=0) for unit in sensed)
    for name, axis, column in (("gyro_scale", 2, 2), ("accel_scale", 2, 5)):
        expected = own[column] / true[column] - 1
        found = done.dataset[f"estimators/ins/{name}"].values[-1, axis]
        sigma = done.dataset[f"estimators/ins/sigma_{name}"].values[-1, axis]
        print(name, expected, found, sigma)
        assert sigma < 0.25 * 2e-3
        assert abs(found - expected) < 4 * sigma
        assert abs(expected) > 4 * sigma


def test_a_receiver_that_is_no_aid_is_not_fused() -> None:
    scenario = Scenario.load("u_turn", TWO_RECEIVERS)
    assert lanes(scenario, 0)["ins"].sensors[0] == "gnss2"
    assert "gnss" not in lanes(scenario, 0)["ins"].sensors
    fused = run(scenario).dataset["estimators/ins/innovations/gnss_position"]["sample_time"].values
    assert not ((fused > 8.05) & (fused < 14.95)).any()
    assert (fused < 8).any()


def test_alignment_knows_the_lever_arm_of_a_receiver_that_is_no_aid() -> None:
    still = ["duration_s=30", "sensors.gnss.grade=rtk", "sensors.gnss.lever_arm_m=[20.0, 0.0, 0.0]", "expect={}"]
    scenario = Scenario.load("static_bench", [*still, 'estimator=[{name="alone", aids=[]}]'])
    assert told(scenario, "alone").config.aids == ()
    dataset = run(scenario).dataset
    estimate, truth = dataset["estimators/alone"], dataset["truth"]
    lat, lon, h = (estimate[name].values for name in ("lat", "lon", "h"))
    first = int(np.argmax(np.isfinite(lat)))
    place = [float(truth[name].values[0]) for name in ("lat", "lon", "h")]
    error = position_difference_n(float(lat[first]), float(lon[first]), float(h[first]), *place)
    assert np.linalg.norm(error) < 2.0  # 20 m of arm, turned by a heading that is known to a degree or two


RIVER = [
    "duration_s=200",
    "truth.segments=[{leg='weave', swing_deg=120, period_s=200, swings=2, to_mps=6}]",
    "sensors.ast={kind='position_fix', grade='perfect', horizontal_m=0.1, vertical_m=0.1}",
    "fault=[]",
    "expect={}",
]


@pytest.mark.ci
def test_fixes_and_body_velocities_are_of_the_centre_of_gravity_wherever_the_imu_sits() -> None:
    """With the IMU 10 m ahead and 3 m above, of a ship that turns, rolls and pitches, all is as without."""

    def rms(arm: str) -> Any:
        dataset = run(papers.scenario("zhu2020", [*RIVER, f"sensors.imu.lever_arm_m={arm}"])).dataset
        found = [accuracy.errors(dataset, name, 60.0) for name in ("frkf", "tfkf")]
        nis = accuracy.column(dataset, "estimators/frkf/innovations/body_velocity/nis")
        values = [np.sqrt(np.mean(values**2, axis=0)) for e in found for values in (e.position, e.velocity, e.attitude)]
        return np.concatenate([*values, [np.median(nis)]])

    at_the_centre, ahead = rms("[0.0, 0.0, 0.0]"), rms("[10.0, 2.0, -3.0]")
    least = [*[0.02] * 3, *[0.001] * 3, *[1e-4] * 3]
    assert (ahead < 1.1 * at_the_centre + [*least, *least, 0.0]).all(), ahead / at_the_centre


@pytest.mark.parametrize(("arm", "first"), [("[10.0, 0.0, 0.0]", 0.0), ("[0.0, 0.0, 0.0]", 1.0)])
def test_velocity_at_the_end_of_an_arm_waits_for_the_rates(arm: str, first: float) -> None:
    estimator = "{name='ins', aids=['gnss'], handover={level_deg=0.1, heading_deg=1, velocity_mps=0.1, position_m=1}}"
    receiver = f"{{kind='gnss', grade='rtk', rate_hz=1, latency_s=0, lever_arm_m={arm}}}"
    more = [*RIVER, "duration_s=5", f"sensors.gnss={receiver}", f"estimator=[{estimator}]"]
    own = "estimators/ins/innovations/gnss_velocity"
    dataset = run(papers.scenario("zhu2020", more)).dataset
    assert accuracy.column(dataset, f"{own}/sample_time")[0] == 0.0
    assert accuracy.column(dataset, f"{own}/weight").tolist() == [first, 1.0, 1.0, 1.0, 1.0, 1.0]


THREE_IMUS = [
    "duration_s=90",
    "sensors.spare={kind='imu', grade='mems-consumer'}",
    "sensors.third={kind='imu', grade='mems-consumer'}",
    "expect={}",
]


def failing(estimator: str) -> Scenario:
    fault = "{sensor='imu', channel='gyro_z', kind='step', window=[60, 80], size=3}"
    return Scenario.load("u_turn", [*THREE_IMUS, f"fault=[{fault}]", f"estimator=[{estimator}]"])


@pytest.mark.ci
def test_a_failed_unit_of_three_is_voted_out_and_comes_back() -> None:
    aids = "aids=['gnss', 'magnetometer']"
    both = f"{{name='voted', spare_imus=['spare', 'third'], {aids}}}, {{name='alone', {aids}}}"
    dataset = run(failing(both)).dataset
    parity = dataset["estimators/voted/innovations/imu_parity"]
    t, weight, sensor = (parity[name].values for name in ("sample_time", "weight", "sensor"))
    out = np.unique(sensor[weight == 0.0])
    assert out.tolist() == ["imu"]
    times = t[(sensor == "imu") & (weight == 0.0)]
    assert times[0] < 60.5
    assert 80.0 < times[-1] < 90.0
    error = {name: np.abs(heading_error_deg(dataset, name, 61.0)).max() for name in ("voted", "alone")}
    assert error["voted"] < 3.0
    assert error["alone"] > 20.0
    assert any("imu_parity refused" in text for text in dataset["events/text"].values.astype(str))


def test_of_units_that_differ_a_filter_is_told_the_worst() -> None:
    """It was told the errors of the first, and averaged both: 30 times what it claimed."""
    grades = ["sensors.imu.grade='navigation'", "sensors.spare={kind='imu', grade='mems-consumer'}"]
    rig = Scenario.load("u_turn", [*grades, "estimator=[{name='ins', aids=['gnss']}]"]).rig(1)
    best, worst, told = rig.imu("imu").errors(), rig.imu("spare").errors(), rig.imu_errors("imu", "spare")
    assert (told.gyro_noise, told.accel_turn_on) == (worst.gyro_noise, worst.accel_turn_on)
    assert told.gyro_in_run_tau == best.gyro_in_run_tau
    voted = "{name='ins', spare_imus=['spare'], aids=['gnss', 'magnetometer']}"
    found = run(Scenario.load("u_turn", [*grades, f"estimator=[{voted}]", "duration_s=90", "fault=[]", "expect={}"]))
    assert found.metrics["ins.attitude_nees_mean"] < 3


def heading_error_deg(dataset: Any, name: str, since: float) -> Any:
    """Difference of headings from a time on, by scipy."""
    late = dataset["truth/time"].values > since
    q_hat, q = (dataset[path].values[late] for path in (f"estimators/{name}/q_nb", "truth/q_nb"))
    turned = Rotation.from_quat(q, scalar_first=True) * Rotation.from_quat(q_hat, scalar_first=True).inv()
    return np.rad2deg(turned.as_rotvec()[:, 2])


def test_units_that_cannot_be_voted_on_are_refused() -> None:
    for spare, complaint in (
        ("gyro", "there is no IMU"),
        ("imu", "'imu' is used already: name another IMU"),
        ("slow", "has 100 Hz, not the 200 Hz of 'imu': units that are voted on must report together"),
    ):
        with pytest.raises(UserError, match=complaint):
            Scenario.load(
                "u_turn",
                [
                    "sensors.slow={kind='imu', rate_hz=100}",
                    f"estimator=[{{name='ins', aids=['gnss'], spare_imus=['{spare}']}}]",
                    "expect={}",
                ],
            )


@pytest.mark.ci
def test_a_start_is_handed_over_with_its_errors() -> None:
    handover = "handover={level_deg=0.5, heading_deg=2, velocity_mps=0.3, position_m=8}"
    drawn = []
    for seed in range(40):
        scenario = Scenario.load(
            "u_turn", ["duration_s=0.1", f"estimator=[{{name='ins', aids=[], {handover}}}]", "expect={}"]
        )
        dataset = run(scenario, seed=seed, source=still()).dataset
        e = accuracy.errors(dataset, "ins")
        assert e.aligned_s == 0.0
        drawn.append(np.concatenate([e.attitude[0], e.velocity[0], e.position[0]]))
    sigma = np.array([*np.deg2rad([0.5, 0.5, 2.0]), *[0.3] * 3, *[8.0] * 3])
    scaled = np.array(drawn) / sigma
    # 40 draws: the sample variance of each is chi-square of 40 degrees of freedom over 40.
    assert np.all(np.abs(scaled.mean(axis=0)) < 4 / np.sqrt(40))
    assert np.all((scaled.var(axis=0) > 0.4) & (scaled.var(axis=0) < 2.0))


@pytest.mark.ci
def test_all_estimators_of_a_run_start_with_the_same_errors() -> None:
    keys = "aids=[], handover={level_deg=0.5, heading_deg=2, velocity_mps=0.3, position_m=8}"
    scenario = Scenario.load(
        "u_turn", ["duration_s=0.1", f"estimator=[{{name='ins', {keys}}}, {{name='rival', {keys}}}]", "expect={}"]
    )
    dataset = run(scenario, source=still()).dataset
    ins, rival = (accuracy.errors(dataset, name) for name in ("ins", "rival"))
    for one, other in ((ins.attitude, rival.attitude), (ins.velocity, rival.velocity), (ins.position, rival.position)):
        np.testing.assert_array_equal(one, other)


def still() -> Kinematic:
    return Kinematic(KinematicStart(lat_deg=34.0, lon_deg=108.0, alt_m=300.0, heading_deg=40.0), 200.0)


@pytest.mark.ci
def test_body_velocity_stars_and_position_fixes_aid() -> None:
    sensors = [
        "sensors.imu.grade='navigation'",
        "sensors.doppler={kind='body_velocity', grade='doppler'}",
        "sensors.stars={kind='star_tracker'}",
        "sensors.terrain={kind='position_fix', grade='terrain'}",
    ]
    handover = "handover={level_deg=0.5, heading_deg=2, velocity_mps=0.3, position_m=30}"
    aids = ["doppler", "stars", "terrain"]
    local = ", ".join(f"{{name='{aid}', aids=['{aid}']}}" for aid in aids)
    scenario = Scenario.load(
        "kinematic_u_flight",
        [
            *sensors,
            "truth.segments=[{leg='straight', duration_s=200}]",
            f"estimator=[{{name='ins', aids={aids}, {handover}}},"
            f" {{name='fed', kind='federated', locals=[{local}], {handover}}}]",
            "expect={}",
        ],
    )
    found = run(scenario).metrics
    for name in ("ins", "fed"):
        assert found[f"{name}.position_horizontal_rms_m"] < 15.0
        assert found[f"{name}.velocity_rms_mps"] < 0.3
        assert found[f"{name}.heading_rms_deg"] < 0.02
        for aid in ("body_velocity", "star_attitude", "position_fix"):
            assert 0.5 < found[f"{name}.nis_mean.{aid}"] < 1.5


FEDERATED = [
    "sensors.gnss.grade=rtk",
    'sensors.gnss2={kind="gnss", lever_arm_m=[2.0, 0.0, 0.0], denied=[[40, 50]]}',
    'estimator=[{name="fed", kind="federated", structure="full_reset", locals=['
    '{name="one", aids=["gnss"], share=0.5, detector={kind="glr", window_s=20.0}},'
    '{name="two", aids=["gnss2"], share=0.3},'
    '{name="air", aids=["airspeed", "barometer", "magnetometer"], share=0.2, detector={kind="eraim"}}]}]',
    "expect={}",
]


def test_a_federation_is_told_of_each_sensor() -> None:
    running = lanes(Scenario.load("u_turn", FEDERATED), 0)["fed"]
    federated = running.horizon.estimator
    assert isinstance(federated, Federated)
    assert running.sensors == ("gnss", "gnss2", "airspeed", "barometer", "magnetometer")
    assert federated.config.structure == "full_reset"
    assert federated.shares.tolist() == [0.5, 0.3, 0.2]
    one, two, air = federated.config.locals
    first, second = one.sensors[0].aid, two.sensors[0].aid
    assert isinstance(first, GnssAid)
    assert isinstance(second, GnssAid)
    assert second.arm_b[0] - first.arm_b[0] == pytest.approx(2.0, abs=0.5)
    assert first.position_error_sigma < second.position_error_sigma  # RTK and the usual kind
    assert isinstance(air.sensors[0].aid, AirspeedAid)
    detector = one.sensors[0].detector()
    assert isinstance(detector, Glr)
    assert detector.window_s == 20.0
    assert isinstance(air.sensors[0].detector(), Eraim)
    assert air.sensors[0].detector() is not air.sensors[0].detector()


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ('mean="plain"', plain()),
        ('mean="window", window_s=7.0', WindowMean(7.0)),
        ('mean="exponential", forgetting=0.8', exponential(0.8)),
        ('mean="exponential", forgetting=0.8, reset="fast"', exponential(0.8)),
        ('reset="none"', exponential(0.95)),
    ],
)
def test_every_sequential_test_can_be_asked_for(keys: str, expected: Mean) -> None:
    """It remembers as the mean that is built by hand."""
    override = f"estimator[0].locals[0].detector={{kind='sprt', {keys}}}"
    running = lanes(Scenario.load("u_turn", [*FEDERATED, override]), 0)["fed"]
    federated = running.horizon.estimator
    assert isinstance(federated, Federated)
    detector = federated.config.locals[0].sensors[0].detector()
    assert isinstance(detector, Sprt)
    assert detector.reset is Reset({"fast": "fast", "none": "none"}.get(keys.split('reset="')[-1][:-1], "complete"))
    rng = np.random.default_rng(0)
    for k in range(100):
        nu = rng.normal(size=3)
        detector.mean.add(np.stack([nu, nu]), 0.2 * k)
        expected.add(np.stack([nu, nu]), 0.2 * k)
    np.testing.assert_array_equal(detector.mean.value, expected.value)
    assert detector.mean.variance == expected.variance


def test_a_local_filter_has_its_own_engine_and_policy() -> None:
    keys = [
        "estimator[0].locals[0].engine='unscented'",
        "estimator[0].locals[0].policy={kind='sage_husa', b=0.9}",
        "estimator[0].locals[1].policy={kind='inflate', reject_above=50.0}",
    ]
    federated = lanes(Scenario.load("u_turn", [*FEDERATED, *keys]), 0)["fed"].horizon.estimator
    assert isinstance(federated, Federated)
    one, two, air = federated.config.locals
    assert [local.scaling for local in (one, two, air)] == [Scaling(), None, None]
    assert one.sensors[0].policy is not None
    assert two.sensors[0].policy is not None
    assert one.sensors[0].policy() == SageHusa(0.9)
    assert two.sensors[0].policy() == MahalanobisInflation(0.01, 50.0)
    assert [monitor.noise is not None for monitor in federated.locals[0].monitors.values()] == [True, True]
    assert air.sensors[0].policy is None


def test_a_federation_without_receivers_aligns_with_the_first() -> None:
    blind = ['estimator=[{name="fed", kind="federated", locals=[{name="air", aids=["barometer"]}]}]', "expect={}"]
    running = lanes(Scenario.load("u_turn", blind), 0)["fed"]
    assert running.sensors == ("barometer", "gnss", "magnetometer")


@pytest.mark.ci
def test_a_federation_in_a_run() -> None:
    result = run(Scenario.load("u_turn", [*FEDERATED, "duration_s=110"]))
    metrics = result.metrics
    assert metrics["fed.position_horizontal_rms_m"] < 0.5  # RTK goes first
    assert metrics["fed.heading_rms_deg"] < 1.0
    assert metrics["fed.velocity_nees_mean"] < 3.0  # 4.28 would be the 99.5 % of one draw of three components
    innovations = result.dataset["estimators/fed/innovations"]
    assert set(innovations.children) == {
        "gnss_position", "gnss_velocity", "airspeed", "sideslip", "barometer", "magnetometer",
    }  # fmt: skip
    assert "wind" in result.dataset["estimators/fed"]


def test_what_a_barometer_is_told_is_right_high_up() -> None:
    """Its noise is one of pressure: of a pascal high up there are three times as many metres."""
    metrics = run(Scenario.load("kinematic_u_flight", ["truth.start.alt_m=9000", "expect={}"])).metrics
    assert 0.7 < metrics["ins.nis_mean.barometer"] < 1.4
    assert metrics["ins.rejected_fraction.barometer"] < 0.01


def test_a_compass_is_told_what_the_throttle_changes_of_a_motors_field() -> None:
    for aircraft, change_a in (("flying_wing", 3.1), ("loiter", 0.0)):
        told = [
            f"truth.aircraft={aircraft}",
            "truth.start.airspeed_mps=20",
            "expect={}",
            "sensors.magnetometer.current_ut_per_a=0.2",
        ]
        ins = lanes(Scenario.load("u_turn", told), 0)["ins"].horizon.estimator
        assert isinstance(ins, Ins)
        (compass,) = [one for one in ins.config.aids if isinstance(one, MagnetometerAid)]
        assert compass.error_sigma == pytest.approx(0.2e-6 * change_a)
