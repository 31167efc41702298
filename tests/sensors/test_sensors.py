"""What holds for every sensor: registry, grades, streams, independence of blocks."""

import datetime
from dataclasses import fields

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from pydantic import ValidationError
from worlds.sections import SECTIONS
from worlds.sensor_truth import RATE_HZ, cut, lively

from nav.samples import (
    AirspeedSample,
    BarometerSample,
    BodyVelocitySample,
    GnssSample,
    ImuSamples,
    MagnetometerSample,
    OpticalFlowSample,
    PositionSample,
    RangeSample,
    StarSample,
    WindSample,
)
from testbed import sensors
from testbed.errors import UserError
from testbed.record import columns as record
from testbed.sensors import (
    airspeed,
    barometer,
    body_velocity,
    gnss,
    imu,
    magnetometer,
    optical_flow,
    position_fix,
    rangefinder,
    star_tracker,
    wind_report,
)

SITE = sensors.Site(datetime.date(2026, 6, 1), 0.6, 1.9, 800.0)
MODULES = {
    "imu": imu,
    "gnss": gnss,
    "magnetometer": magnetometer,
    "barometer": barometer,
    "airspeed": airspeed,
    "body_velocity": body_velocity,
    "star_tracker": star_tracker,
    "position_fix": position_fix,
    "rangefinder": rangefinder,
    "optical_flow": optical_flow,
    "wind_report": wind_report,
}
SAMPLES = {
    "imu": ImuSamples,
    "gnss": GnssSample,
    "magnetometer": MagnetometerSample,
    "barometer": BarometerSample,
    "airspeed": AirspeedSample,
    "body_velocity": BodyVelocitySample,
    "star_tracker": StarSample,
    "position_fix": PositionSample,
    "rangefinder": RangeSample,
    "optical_flow": OpticalFlowSample,
    "wind_report": WindSample,
}
# On its way north the body passes a small jammer 44 m from its start.
JAMMER = {"lat_deg": np.degrees(0.6) + 4e-4, "lon_deg": np.degrees(1.9), "radius_m": 20.0}
BEACON = {"lat_deg": np.degrees(0.6) + 4e-4, "lon_deg": np.degrees(1.9), "alt_m": 800.0, "range_m": 30.0}
INTERRUPTED = {"denied": ((0.7, 0.9),), "dropout_percent": 20.0}
EVERYTHING = {
    "imu": {"rate_hz": 100.0, "lever_arm_m": (0.3, -0.1, 0.2), "mounting_deg": (1.0, 2.0, 90.0)},
    "gnss": {
        "rate_hz": 8.0,
        "offset_s": 0.05,
        "lever_arm_m": (0.5, 0.1, -0.3),
        "denied": ((0.7, 0.9),),
        "reacquire_s": 0.3,
        "jammers": (JAMMER,),
    },
    "magnetometer": {"rate_hz": 25.0},
    "barometer": {"rate_hz": 20.0, "offset_s": 0.015},
    "airspeed": {"rate_hz": 10.0},
    "body_velocity": {"rate_hz": 50.0, "offset_s": 0.01, **INTERRUPTED},
    "star_tracker": {"rate_hz": 20.0, "boresight": "right", **INTERRUPTED},
    "position_fix": {"rate_hz": 25.0, "transponder": BEACON, **INTERRUPTED},
    "rangefinder": {"rate_hz": 25.0, "max_range_m": 1000.0, **INTERRUPTED},
    "optical_flow": {"rate_hz": 20.0, "offset_s": 0.02, "max_range_m": 2000.0, "outlier_percent": 20.0, **INTERRUPTED},
    "wind_report": {"rate_hz": 20.0, "mean_s": 0.4, "delay_s": 0.2, **INTERRUPTED},
}
TRUTH = lively(400)


def outputs(name, kind, config, blocks, seed=1):
    """Everything that a sensor delivers over the blocks, as one table of numbers."""
    sensor = sensors.build(name, config, RATE_HZ, seed, SITE)
    sensed = [sensor.sense(block) for block in blocks]
    if kind == "imu":
        return np.concatenate([np.column_stack([s.t, s.dt, s.dtheta, s.dv]) for s in sensed])
    return np.array(
        [
            np.concatenate([np.atleast_1d(getattr(s, f.name)) for f in fields(s) if f.name != "sensor"])
            for part in sensed
            for s in part
        ]
    )


@pytest.mark.parametrize("kind", SECTIONS)
def test_every_field_of_a_sample_is_recorded(kind):
    recorded = record.IMU if kind == "imu" else record.SAMPLE
    assert {f.name for f in fields(SAMPLES[kind])} - {"t", "sensor"} <= recorded.keys()


@pytest.mark.parametrize("kind", SECTIONS)
def test_configuration_defaults_to_its_kind_and_builds(kind):
    config = SECTIONS[kind]()
    assert config.kind == kind
    sensor = sensors.build("x", config, RATE_HZ, 1, SITE)
    assert sensor.name == "x"
    assert sensor.rate_hz == config.rate_hz
    assert sensor.sense(TRUTH) is not None


GRADES = [(kind, grade) for kind, module in MODULES.items() for grade in module.GRADES]


@pytest.mark.parametrize(("kind", "grade"), GRADES)
def test_grade_sets_its_keys_and_what_is_written_wins(kind, grade):
    config = SECTIONS[kind]
    preset = MODULES[kind].GRADES[grade]
    for key, value in preset.items():
        assert getattr(config(grade=grade), key) == value
    if preset:
        key, other = next((k, v) for k, v in preset.items() if isinstance(v, float))
        overridden = config(grade=grade, **{key: other / 2})
        assert getattr(overridden, key) == other / 2
        assert overridden.model_dump(exclude={key}) == config(grade=grade).model_dump(exclude={key})


@pytest.mark.parametrize("kind", SECTIONS)
def test_section_takes_toml_lists_and_refuses_strings_for_numbers(kind):
    config = SECTIONS[kind]
    config.model_validate_json('{"rate_hz": 5}', strict=True)
    if kind in ("imu", "gnss"):
        config.model_validate_json('{"lever_arm_m": [1, 0, 0.5]}', strict=True)
    if kind == "gnss":
        text = '{"denied": [[1, 2]], "jammers": [{"lat_deg": 1, "lon_deg": 2, "radius_m": 3}]}'
        config.model_validate_json(text, strict=True)
    if kind == "body_velocity":
        config.model_validate_json('{"axes": ["forward", "right"], "denied": [[1, 2]]}', strict=True)
    if kind == "position_fix":
        text = '{"transponder": {"lat_deg": 1, "lon_deg": 2, "range_m": 3}}'
        config.model_validate_json(text, strict=True)
    for text in (
        '{"rate_hz": "5"}',
        '{"grade": "best"}',
        '{"grade": 7}',
        '{"unknown": 1}',
        '{"rate_hz": 0}',
        "[]",
        "3",
    ):
        with pytest.raises(ValidationError):
            config.model_validate_json(text, strict=True)


@pytest.mark.parametrize(("kind", "key", "value"), [
    ("imu", "gyro_turn_on_degph", -1.0),
    ("imu", "gyro_turn_on_degph", float("nan")),
    ("imu", "accel_scale_ppm", 2e5),
    ("imu", "lever_arm_m", (500.0, 0.0, 0.0)),
    ("imu", "lever_arm_m", (1.0, 2.0)),
    ("imu", "gyro_range_degps", 0.0),
    ("imu", "mounting_deg", (0.0, 0.0, 1000.0)),
    ("gnss", "hdop", 0.0),
    ("gnss", "satellites", 2),
    ("gnss", "latency_s", -0.1),
    ("gnss", "latency_s", 100.0),
    ("gnss", "correlation_time_s", 0.0),
    ("gnss", "jammers", ({"lat_deg": 91.0, "lon_deg": 0.0, "radius_m": 10.0},)),
    ("gnss", "jammers", ({"lat_deg": 1.0, "lon_deg": 0.0, "radius_m": 0.0},)),
    ("gnss", "jammers", ({"lat_deg": 1.0, "lon_deg": 0.0},)),
    ("magnetometer", "noise_ut", -0.1),
    ("magnetometer", "soft_iron_percent", 90.0),
    ("barometer", "drift_time_s", 0.0),
    ("airspeed", "scale_percent", 80.0),
    ("airspeed", "offset_s", -1.0),
    ("body_velocity", "axes", ()),
    ("body_velocity", "axes", ("forward", "forward")),
    ("body_velocity", "axes", ("up",)),
    ("body_velocity", "dropout_percent", 100.0),
    ("body_velocity", "correlation_time_s", 0.0),
    ("body_velocity", "denied", ((5.0, 3.0),)),
    ("star_tracker", "boresight", "z"),
    ("star_tracker", "across_arcsec", -1.0),
    ("position_fix", "distribution", "cauchy"),
    ("position_fix", "transponder", {"lat_deg": 1.0, "lon_deg": 2.0}),
    ("position_fix", "transponder", {"lat_deg": 1.0, "lon_deg": 2.0, "range_m": 0.0}),
])  # fmt: skip
def test_out_of_range_is_refused(kind, key, value):
    with pytest.raises(ValidationError) as raised:
        SECTIONS[kind](**{key: value})
    assert raised.value.errors()[0]["loc"][0] == key


@pytest.mark.parametrize("kind", SECTIONS)
def test_a_rate_that_does_not_divide_the_tick_is_refused(kind):
    with pytest.raises(UserError, match=r"sensors\.x\.rate_hz"):
        sensors.build("x", SECTIONS[kind](rate_hz=30.0), RATE_HZ, 1, SITE)


@pytest.mark.ci
@pytest.mark.parametrize("kind", SECTIONS)
@settings(max_examples=40, deadline=None)
@given(cuts=st.lists(st.integers(0, 400), max_size=8))
def test_result_does_not_depend_on_blocks(kind, cuts):
    config = SECTIONS[kind](**EVERYTHING[kind])
    whole = outputs(kind, kind, config, [TRUTH])
    assert len(whole) > 3
    np.testing.assert_array_equal(outputs(kind, kind, config, cut(TRUTH, cuts)), whole)


@pytest.mark.parametrize("kind", SECTIONS)
def test_result_does_not_depend_on_blocks_tick_by_tick(kind):
    config = SECTIONS[kind](**EVERYTHING[kind])
    whole = outputs(kind, kind, config, [TRUTH])
    np.testing.assert_array_equal(outputs(kind, kind, config, cut(TRUTH, list(range(1, 400)))), whole)


def test_adding_a_sensor_changes_no_other():
    """Run alone and run in the company of others, also of its own kind: the same bits."""
    alone = {k: outputs(k, k, SECTIONS[k](**EVERYTHING[k]), [TRUTH]) for k in SECTIONS}
    company = {}
    for kind in [*reversed(SECTIONS), *SECTIONS]:
        company[f"{kind}_2"] = sensors.build(f"{kind}_2", SECTIONS[kind](), RATE_HZ, 1, SITE)
        company[kind] = sensors.build(kind, SECTIONS[kind](**EVERYTHING[kind]), RATE_HZ, 1, SITE)
    for sensor in company.values():
        sensor.sense(TRUTH.rows(0, 100))
    for kind in SECTIONS:
        together = outputs(kind, kind, SECTIONS[kind](**EVERYTHING[kind]), [TRUTH])
        np.testing.assert_array_equal(together, alone[kind])


@pytest.mark.parametrize("kind", SECTIONS)
def test_name_and_seed_make_the_noise(kind):
    config = SECTIONS[kind](**EVERYTHING[kind])
    reference = outputs("a", kind, config, [TRUTH])
    np.testing.assert_array_equal(outputs("a", kind, config, [TRUTH]), reference)
    assert not np.array_equal(outputs("b", kind, config, [TRUTH]), reference, equal_nan=True)
    assert not np.array_equal(outputs("a", kind, config, [TRUTH], seed=2), reference, equal_nan=True)


def error_keys(kind, grade):
    """Keys of a grade whose zero switches one random error off."""
    preset = MODULES[kind].GRADES[grade]
    words = (
        "tau",
        "time",
        "range",
        "resolution",
        "bandwidth",
        "self_heating",
        "latency",
        "dop",
        "satellites",
        "reacquire",
        "rate_hz",
        "mean_s",
        "delay",
        "jitter",
        "dropout",
        "rectification",  # of the vibration: nothing by itself
    )
    numbers = {key: value for key, value in preset.items() if isinstance(value, (int, float))}
    return [key for key, value in numbers.items() if not any(w in key for w in words) and value != 0]


@pytest.mark.parametrize("kind", SECTIONS)
def test_switching_one_error_off_removes_that_error_and_no_other(kind):
    """The errors are additive to first order: the parts, each alone, sum to the whole."""
    module, config = MODULES[kind], SECTIONS[kind]
    grade = list(module.GRADES)[-1]
    plain = {"grade": "perfect", "rate_hz": 10.0}
    keys = error_keys(kind, grade)
    assert len(keys) >= 2
    preset = {key: module.GRADES[grade][key] for key in keys}
    perfect = outputs(kind, kind, config(**plain), [TRUTH])
    parts = sum(outputs(kind, kind, config(**plain, **{key: preset[key]}), [TRUTH]) - perfect for key in keys)
    whole = outputs(kind, kind, config(**plain, **preset), [TRUTH]) - perfect
    scale = np.abs(whole).max(axis=0)
    numeric = [c for c in range(whole.shape[1]) if scale[c] > 0]
    if kind == "gnss":  # reported accuracies add in squares, satellites are counted
        numeric = [c for c in numeric if c < 8]
    assert numeric
    # products of two errors: scale times noise and the like
    np.testing.assert_allclose(parts[:, numeric], whole[:, numeric], atol=0.02 * scale[numeric].max(), rtol=0.02)
