"""Faults against their formulas on a still truth, and what must not change: other sensors, other times, the blocks."""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Callable
from dataclasses import fields
from typing import Any, get_args

import numpy as np
import pymap3d
import pytest
from pydantic import TypeAdapter
from scipy.spatial.transform import Rotation
from worlds.sections import SECTIONS
from worlds.sensor_truth import RATE_HZ, cut, lively, still

from nav.earth import isa_pressure
from nav.samples import FixType, ImuSamples
from nav.terrain import Terrain
from testbed import sensors
from testbed.sensors import faults
from testbed.sensors.faults import CHANNELS, Faults
from testbed.sensors.faults.kinds import OnChannel

DURATION_S = 30.0
SITE = sensors.Site(dt.date(2026, 6, 1), 0.0, 0.0, 0.0, Terrain.flat(500.0))  # in sight from 800 m
KINDS = tuple(SECTIONS)
FAULT: TypeAdapter[Any] = TypeAdapter(faults.Fault)
G_TO_SI = 9.80665


def fault(**keys: Any) -> Any:
    return FAULT.validate_python({"window": (10.0, 20.0), **keys}, strict=True)


def section(kind: str, **keys: Any) -> Any:
    return SECTIONS[kind].model_validate({"kind": kind, **keys}, strict=True)


def sensed(
    config: Any, *injected: Any, moving: bool = False, cuts: list[int] | None = None, seed: int = 5
) -> tuple[Any, Any]:
    """What the sensor called "it" delivers when healthy, and with faults, over `DURATION_S`."""
    truth = (lively if moving else still)(round(DURATION_S * RATE_HZ) + 1)
    healthy = sensors.build("it", config, RATE_HZ, seed, SITE).sense(truth)
    sensor = sensors.build("it", config, RATE_HZ, seed, SITE)
    at_work = Faults(injected, {"it": config}, seed)
    parts = [at_work.apply("it", sensor.sense(block)) for block in cut(truth, cuts or [])]
    if isinstance(healthy, ImuSamples):
        joined = [np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(ImuSamples)]
        return healthy, ImuSamples(*joined)
    return healthy, [sample for part in parts for sample in part]


def column(samples: Any, read: Callable[[Any], float]) -> tuple[np.ndarray, np.ndarray]:
    return np.array([s.t for s in samples]), np.array([read(s) for s in samples])


def north_east_down(samples: Any, origin: Any) -> np.ndarray:
    """By pymap3d, metres from the healthy samples."""
    return np.array(
        [
            pymap3d.geodetic2ned(s.lat, s.lon, s.h, o.lat, o.lon, o.h, deg=False)
            for s, o in zip(samples, origin, strict=True)
        ]
    )


def alike(a: Any, b: Any) -> bool:
    """The same bits."""
    if isinstance(a, ImuSamples):
        return all(np.array_equal(getattr(a, f.name), getattr(b, f.name), equal_nan=True) for f in fields(ImuSamples))
    return len(a) == len(b) and all(
        np.array_equal(getattr(x, f.name), getattr(y, f.name), equal_nan=f.name != "sensor")
        for x, y in zip(a, b, strict=True)
        for f in fields(x)
    )


ADDED: dict[str, tuple[dict[str, Any], Callable[[float], float]]] = {
    "step": ({"size": 40.0}, lambda tau: 40.0),
    "ramp": ({"slope": -0.5}, lambda tau: -0.5 * tau),
    "quadratic": ({"coefficient": 0.3}, lambda tau: 0.3 * tau * tau),
    "exponential": ({"size": 20.0, "time_constant_s": 4.0}, lambda tau: 20.0 * (1 - math.exp(-tau / 4.0))),
    "sine": ({"size": 8.0, "period_s": 5.0}, lambda tau: 8.0 * math.sin(2 * math.pi * tau / 5.0)),
    "spikes": ({"size": 500.0, "period_s": 3.0}, lambda tau: 500.0 if abs(tau % 3.0) < 1e-9 else 0.0),
}


@pytest.mark.parametrize("kind", ADDED)
def test_what_is_added_follows_its_formula_and_goes_when_the_window_ends(kind: str) -> None:
    keys, formula = ADDED[kind]
    config = section("airspeed", grade="perfect", rate_hz=10.0)
    _, found = sensed(config, fault(sensor="it", channel="speed", kind=kind, **keys))
    t, eas = column(found, lambda s: s.eas)
    expected = [formula(round(when - 10.0, 9)) if 10.0 <= when < 20.0 else 0.0 for when in np.round(t, 9)]
    np.testing.assert_allclose(eas, expected, atol=1e-9)
    assert np.count_nonzero(expected) >= 3


def test_spikes_hit_the_first_sample_after_each_period() -> None:
    config = section("airspeed", grade="perfect", rate_hz=1.0)
    spikes = fault(sensor="it", channel="speed", kind="spikes", size=5.0, period_s=2.5, window=(10.5, 29.0))
    t, eas = column(sensed(config, spikes)[1], lambda s: s.eas)
    np.testing.assert_array_equal(t[eas > 0], [11, 13, 16, 18, 21, 23, 26, 28])


@pytest.mark.parametrize(
    ("channel", "bearing", "expected"),
    [
        ("north", None, [200.0, 0, 0]),
        ("east", None, [0, 200.0, 0]),
        ("down", None, [0, 0, 200.0]),
        ("position", 30.0, [200 * math.cos(math.pi / 6), 100.0, 0]),
    ],
)
def test_gnss_position_is_moved_in_metres(channel: str, bearing: float | None, expected: list[float]) -> None:
    step = fault(sensor="it", channel=channel, kind="step", size=200.0, bearing_deg=bearing)
    healthy, found = sensed(section("gnss"), step, moving=True)
    moved = north_east_down(found, healthy)
    inside = np.array([10 <= s.t < 20 for s in found])
    np.testing.assert_allclose(moved[inside], np.tile(expected, (inside.sum(), 1)), atol=0.01)
    assert not moved[~inside].any()
    assert all(np.array_equal(a.v_n, b.v_n) for a, b in zip(healthy, found, strict=True))


def test_drag_off_moves_position_and_velocity_consistently_from_the_true_position() -> None:
    spoof = fault(sensor="it", kind="drag_off", bearing_deg=120.0, velocity_mps=0.5, acceleration_mps2=0.2)
    healthy, found = sensed(section("gnss", rate_hz=10.0), spoof, moving=True)
    moved = north_east_down(found, healthy)
    faster = np.array([b.v_n - a.v_n for a, b in zip(healthy, found, strict=True)])
    inside = np.array([10 <= s.t < 20 for s in found])
    np.testing.assert_allclose(moved[inside][0], 0.0, atol=1e-6)
    np.testing.assert_allclose(
        np.diff(moved[inside], axis=0) / 0.1, (faster[inside][1:] + faster[inside][:-1]) / 2, atol=2e-3
    )
    tau = 9.9
    away = 0.5 * tau + 0.1 * tau**2
    np.testing.assert_allclose(moved[inside][-1][:2], away * np.array([-0.5, math.sqrt(3) / 2]), atol=1e-3)
    assert not moved[~inside].any()
    assert not faster[~inside].any()


def test_barometer_in_pascals_and_in_metres() -> None:
    config = section("barometer", grade="perfect")
    _, found = sensed(config, fault(sensor="it", channel="pressure", kind="step", size=1.5, unit="hPa"))
    t, p = column(found, lambda s: s.pressure)
    np.testing.assert_allclose(p[(t >= 10) & (t < 20)], 101_325 + 150, rtol=1e-12)
    _, found = sensed(config, fault(sensor="it", channel="height", kind="step", size=100.0))
    t, p = column(found, lambda s: s.pressure)
    np.testing.assert_allclose(p[(t >= 10) & (t < 20)], isa_pressure(100.0), rtol=1e-9)


@pytest.mark.parametrize(
    ("channel", "unit", "field", "axis", "si"),
    [
        ("gyro_y", None, "dtheta", 1, math.radians(1)),
        ("gyro_x", "deg/h", "dtheta", 0, math.radians(1) / 3600),
        ("accel_z", None, "dv", 2, 1.0),
        ("accel_x", "mg", "dv", 0, 1e-3 * G_TO_SI),
    ],
)
def test_imu_faults_are_rates_on_increments(channel: str, unit: str | None, field: str, axis: int, si: float) -> None:
    step = fault(sensor="it", channel=channel, kind="step", size=3.0, unit=unit)
    healthy, found = sensed(section("imu", rate_hz=100.0), step, moving=True, cuts=[700, 2301, 2302, 5000])
    difference = getattr(found, field) - getattr(healthy, field)
    inside = (found.t > 10 - 1e-6) & (found.t < 20 - 1e-6)
    np.testing.assert_allclose(difference[inside, axis], 3.0 * si * 0.01, rtol=1e-6)
    assert not difference[~inside].any()
    assert not np.delete(difference, axis, axis=1).any()
    assert np.array_equal(found.dt, healthy.dt)


def test_magnetometer_in_microtesla() -> None:
    healthy, found = sensed(
        section("magnetometer"), fault(sensor="it", channel="z", kind="step", size=7.0), moving=True
    )
    difference = np.array([b.field_b - a.field_b for a, b in zip(healthy, found, strict=True) if 10 <= a.t < 20])
    np.testing.assert_allclose(difference, np.tile([0, 0, 7e-6], (len(difference), 1)), atol=1e-15)


def test_body_velocity_by_axis() -> None:
    step = fault(sensor="it", channel="right", kind="step", size=0.3)
    healthy, found = sensed(section("body_velocity", rate_hz=10.0), step, moving=True)
    difference = np.array([b.v_b - a.v_b for a, b in zip(healthy, found, strict=True) if 10 <= a.t < 20])
    np.testing.assert_allclose(difference, np.tile([0, 0.3, 0], (len(difference), 1)), atol=1e-12)


def test_star_tracker_is_turned_about_a_body_axis() -> None:
    config = section("star_tracker", rate_hz=10.0)
    healthy, found = sensed(config, fault(sensor="it", channel="down", kind="ramp", slope=100.0), moving=True)
    for a, b in zip(healthy, found, strict=True):
        before, after = (Rotation.from_quat(s.q_ib, scalar_first=True) for s in (a, b))
        expected = [0, 0, 100 * (a.t - 10) if 10 <= a.t < 20 - 1e-6 else 0]
        np.testing.assert_allclose((before.inv() * after).as_rotvec(degrees=True) * 3600, expected, atol=1e-6)


def test_position_fix_without_height() -> None:
    step = fault(sensor="it", channel="east", kind="step", size=500.0)
    healthy, found = sensed(section("position_fix", rate_hz=1.0), step, moving=True)
    for a, b in zip(healthy, found, strict=True):
        _, east, _ = pymap3d.geodetic2ned(b.lat, b.lon, 0.0, a.lat, a.lon, 0.0, deg=False)
        assert east == pytest.approx(500.0 if 10 <= a.t < 20 else 0.0, abs=0.05)
        assert math.isnan(b.h)


def test_stuck_holds_the_last_value_before_the_window_or_the_one_given() -> None:
    for rate_hz, start in ((10.0, 10.0), (0.5, 11.0)):  # the slow one is silent for longer than a block
        config = section("airspeed", rate_hz=rate_hz)
        stuck = fault(sensor="it", channel="speed", kind="stuck", window=(start, 20.0))
        for cuts in ([], [1700, 1999], [2100]):
            healthy, found = sensed(config, stuck, moving=True, cuts=cuts)
            last = [s.eas for s in healthy if s.t < start - 1e-6][-1]
            inside = [s.eas for s in found if start <= s.t < 20.0 - 1e-6]
            assert inside
            assert set(inside) == {last}
    blocked = fault(sensor="it", channel="speed", kind="stuck", value=4.5)
    assert {s.eas for s in sensed(config, blocked)[1] if 10 <= s.t < 20} == {4.5}
    healthy, found = sensed(section("gnss"), fault(sensor="it", channel="position", kind="stuck"), moving=True)
    last = next(s for s in reversed(healthy) if s.t < 10 - 1e-6)
    inside = [s for s in zip(healthy, found, strict=True) if 10 <= s[0].t < 20]
    assert all((b.lat, b.lon, b.h) == (last.lat, last.lon, a.h) for a, b in inside)


def test_delay_gives_the_value_of_then() -> None:
    config = section("airspeed", rate_hz=10.0)
    for cuts in ([], [30, 1650, 1999], [3999]):
        healthy, found = sensed(
            config, fault(sensor="it", channel="speed", kind="delay", delay_s=2.0), moving=True, cuts=cuts
        )
        before = {round(s.t, 6): s.eas for s in healthy}
        for s in found:
            assert s.eas == before[round(s.t - 2.0 if 10 <= round(s.t, 6) < 20 else s.t, 6)]


def test_dropout_loses_samples_and_makes_increments_nan() -> None:
    healthy, found = sensed(section("gnss"), fault(sensor="it", kind="dropout"), moving=True)
    assert alike(found, [s for s in healthy if not 10 <= round(s.t, 6) < 20])
    healthy, found = sensed(section("imu"), fault(sensor="it", kind="dropout"), moving=True)
    lost = np.isnan(found.dtheta).all(axis=1) & np.isnan(found.dv).all(axis=1)
    np.testing.assert_array_equal(lost, (healthy.t > 10 - 1e-6) & (healthy.t < 20 - 1e-6))
    np.testing.assert_array_equal(found.dtheta[~lost], healthy.dtheta[~lost])


def test_noise_makes_the_stated_sigma_so_many_times_as_large() -> None:
    config = section("airspeed", rate_hz=200.0)
    noisy = fault(sensor="it", channel="speed", kind="noise", factor=2.0)
    truth_still, found = sensed(config, noisy, moving=True)
    extra = np.array([b.eas - a.eas for a, b in zip(truth_still, found, strict=True) if 10 <= a.t < 20])
    sigma = config.errors().noise
    assert math.hypot(extra.std(), sigma) == pytest.approx(2 * sigma, rel=0.05)  # 2000 samples: 1.6 % one sigma
    assert abs(extra.mean()) < 4 * 2 * sigma / math.sqrt(len(extra))


def test_scale_multiplies() -> None:
    healthy, found = sensed(
        section("airspeed"), fault(sensor="it", channel="speed", kind="scale", factor=0.8), moving=True
    )
    for a, b in zip(healthy, found, strict=True):
        assert b.eas == (0.8 * a.eas if 10 <= round(a.t, 6) < 20 else a.eas)


def test_garbage_is_nonsense_of_several_sorts() -> None:
    _, found = sensed(
        section("airspeed", rate_hz=50.0), fault(sensor="it", channel="speed", kind="garbage"), moving=True
    )
    inside = np.array([s.eas for s in found if 10 <= s.t < 20])
    assert np.isnan(inside).any()
    assert np.isposinf(inside).any()
    assert np.isneginf(inside).any()
    assert (np.abs(inside[np.isfinite(inside)]) >= 1e9).all()


def test_sigma_is_what_the_sensor_states() -> None:
    gnss = section("gnss", horizontal_white_m=3.0, horizontal_correlated_m=4.0)
    healthy, found = sensed(gnss, fault(sensor="it", channel="north", kind="step", size=5.0, unit="sigma"))
    moved = north_east_down(found, healthy)[[10 <= s.t < 20 for s in found]]
    np.testing.assert_allclose(moved[:, 0], 5 * healthy[0].sigma_position_n[0], rtol=1e-4)
    assert healthy[0].sigma_position_n[0] == pytest.approx(5.0)


def test_faults_overlap_and_act_in_order() -> None:
    config = section("airspeed", grade="perfect", rate_hz=10.0)
    step = fault(sensor="it", channel="speed", kind="step", size=10.0, window=(5.0, 25.0))
    scale = fault(sensor="it", channel="speed", kind="scale", factor=3.0, window=(10.0, 15.0))
    ramp = fault(sensor="it", channel="speed", kind="ramp", slope=1.0, window=(12.0, 20.0))
    t, eas = column(sensed(config, step, scale, ramp)[1], lambda s: s.eas)
    expected = np.where((t > 4.99) & (t < 24.99), 10.0, 0.0)
    expected[(t > 9.99) & (t < 14.99)] *= 3
    late = (t > 11.99) & (t < 19.99)
    expected[late] += t[late] - 12.0
    np.testing.assert_allclose(eas, expected, atol=1e-9)


EVERY = [
    {"kind": "step", "size": 1.0},
    {"kind": "noise", "factor": 3.0},
    {"kind": "spikes", "size": 4.0, "period_s": 1.3},
    {"kind": "stuck"},
    {"kind": "delay", "delay_s": 1.7},
    {"kind": "garbage"},
]


@pytest.mark.ci
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("cuts", [[1, 2, 3, 1999, 2000, 2001, 3999], list(range(7, 6000, 57))])
def test_the_blocks_do_not_matter_and_outside_the_window_nothing_changes(kind: str, cuts: list[int]) -> None:
    config = section(kind, **({"rate_hz": 1.0} if kind == "wind_report" else {}))  # as it is, one in ten minutes
    channels = list(CHANNELS[kind])
    injected = [
        fault(
            sensor="it",
            channel=channel,
            window=(9.0 + k, 19.0 + k / 3),
            **keys,
            **({"bearing_deg": 77.0} if CHANNELS[kind][channel].needs_bearing else {}),
        )
        for k, (channel, keys) in enumerate(zip(channels * 6, EVERY, strict=False))
    ]
    healthy, whole = sensed(config, *injected, moving=True)
    assert alike(whole, sensed(config, *injected, moving=True, cuts=cuts)[1])
    assert not alike(whole, healthy)
    if kind == "imu":
        outside = (healthy.t < 9 - 1e-6) | (healthy.t > 24)
        assert np.array_equal(healthy.dtheta[outside], whole.dtheta[outside])
    else:
        outside = [k for k, s in enumerate(healthy) if s.t < 9 - 1e-6 or s.t > 24]
        assert alike([healthy[k] for k in outside], [whole[k] for k in outside])


def test_a_fault_has_numbers_of_its_own() -> None:
    config = section("airspeed", rate_hz=10.0)
    noise = fault(sensor="it", channel="speed", kind="noise", factor=3.0)
    idle = fault(sensor="it", channel="speed", kind="step", size=0.0, window=(1.0, 2.0))
    first = sensed(config, noise, moving=True)[1]
    assert alike(first, sensed(config, noise, idle, moving=True)[1])
    assert not alike(first, sensed(config, idle, noise, moving=True)[1])
    assert not alike(first, sensed(config, noise, moving=True, seed=6)[1])


def test_a_receiver_without_fix_has_nothing_to_falsify() -> None:
    config = section("gnss", denied=((12.0, 15.0),))
    stuck = fault(sensor="it", channel="position", kind="stuck", window=(13.0, 20.0))
    _, found = sensed(config, stuck, fault(sensor="it", channel="north", kind="step", size=9.0), moving=True)
    silent = [s for s in found if s.fix_type is FixType.NO_FIX]
    assert silent
    assert all(math.isnan(s.lat) for s in silent)
    assert all(math.isfinite(s.lat) for s in found if s.fix_type is not FixType.NO_FIX)


@pytest.mark.ci
def test_absurd_sizes_after_garbage_raise_nothing() -> None:
    for kind in KINDS:
        for channel, row in CHANNELS[kind].items():
            bearing = {"bearing_deg": 10.0} if row.needs_bearing else {}
            garbage = fault(sensor="it", channel=channel, kind="garbage")
            huge = [fault(sensor="it", channel=channel, kind="step", size=size, **bearing) for size in (1e9, -1e9)]
            sound, found = sensed(section(kind), garbage, *huge, moving=True)
            assert len(found) == len(sound) > 0


def test_one_may_be_added_while_the_run_goes_on() -> None:
    config = section("airspeed", grade="perfect", rate_hz=10.0)
    at_work = Faults([], {"it": config}, 1)
    sensor = sensors.build("it", config, RATE_HZ, 1, SITE)
    first, second = cut(still(3001), [2000])
    at_work.apply("it", sensor.sense(first))
    at_work.add(fault(sensor="it", channel="speed", kind="step", size=2.0))
    assert {s.eas for s in at_work.apply("it", sensor.sense(second))} == {2.0}
    assert [one.name for one in at_work.truth] == ["it_speed_step"]


def test_truth_says_what_was_done() -> None:
    config = section("gnss")
    injected = [
        fault(sensor="it", channel="north", kind="ramp", slope=0.5),
        fault(sensor="it", channel="north", kind="ramp", slope=2.0, unit="sigma"),
        fault(name="spoof", sensor="it", kind="drag_off", bearing_deg=0.0, velocity_mps=1.0),
        fault(name="slowly", sensor="it", kind="drag_off", bearing_deg=0.0, acceleration_mps2=0.05),
        fault(sensor="it", kind="dropout"),
    ]
    truth = Faults(injected, {"it": config}, 1).truth
    assert [one.name for one in truth] == ["it_north_ramp", "it_north_ramp_2", "spoof", "slowly", "it_dropout"]
    assert [(one.size, one.unit) for one in truth[:3]] == [(0.5, "m/s"), (2.0, "sigma/s"), (1.0, "m/s")]
    assert [str(one) for one in truth[1:]] == [
        "it north ramp 2 sigma/s",
        "it drag_off 1 m/s",
        "it drag_off 0.05 m/s^2",
        "it dropout",
    ]
    assert math.isnan(truth[4].size)


def test_slow_delivers_one_of_so_many_and_an_imu_repeats_itself() -> None:
    healthy, ours = sensed(section("barometer", rate_hz=10), fault(sensor="it", kind="slow", factor=4))
    t = np.array([s.t for s in healthy])
    inside = (t > 10 - 1e-6) & (t < 20 - 1e-6)
    kept = [*t[~inside & (t < 15)], *t[inside][::4], *t[~inside & (t > 15)]]
    assert [s.t for s in ours] == kept
    config = section("imu", grade="mems-industrial", rate_hz=100)
    healthy, ours = sensed(config, fault(sensor="it", channel="gyro", kind="slow", factor=3), moving=True, cuts=[1234])
    inside = (healthy.t > 10 - 1e-6) & (healthy.t < 20 - 1e-6)
    held = np.repeat(healthy.dtheta[inside][::3], 3, axis=0)[: inside.sum()]
    np.testing.assert_allclose(ours.dtheta[inside], held, rtol=1e-12)
    np.testing.assert_array_equal(ours.dtheta[~inside], healthy.dtheta[~inside])
    np.testing.assert_array_equal(ours.dv, healthy.dv)


def test_intermittent_comes_and_goes() -> None:
    for share, lost in ((0.5, lambda p: p < 1.5), (0.25, lambda p: p < 0.75)):
        keys = {"kind": "intermittent", "period_s": 3.0, "share": share}
        healthy, ours = sensed(section("airspeed", rate_hz=5), fault(sensor="it", **keys), cuts=[2500])
        t = np.array([s.t for s in healthy])
        gone = np.array([9.999 < x < 19.999 and lost((x - 10 + 1e-6) % 3.0) for x in t])
        assert [s.t for s in ours] == t[~gone].tolist()
        assert gone.sum() > 10
    keys = {"kind": "intermittent", "period_s": 4.0}
    healthy, ours = sensed(section("imu", rate_hz=100), fault(sensor="it", channel="accel", **keys))
    gone = np.array([9.999 < x < 19.999 and (x - 10 + 1e-6) % 4.0 < 2.0 for x in healthy.t])
    np.testing.assert_array_equal(np.isnan(ours.dv).all(axis=1), gone)
    assert np.isfinite(ours.dtheta).all()


def test_it_is_known_which_kinds_draw() -> None:
    """Of a recorded flight nothing else does, so that runs of it are all the same."""
    more = {"noise": {"factor": 3.0}, "scale": {"factor": 2.0}, "delay": {"delay_s": 1.0}, "slow": {"factor": 2},
            "intermittent": {"period_s": 2.0}, "stuck": {}, "garbage": {}, "dropout": {},
            "drag_off": {"bearing_deg": 0.0, "velocity_mps": 1.0}}  # fmt: skip
    given = {kind: keys for kind, (keys, _) in ADDED.items()} | more
    config = section("gnss")
    samples = sensors.build("it", config, RATE_HZ, 5, SITE).sense(lively(round(DURATION_S * RATE_HZ) + 1))
    for kind in get_args(faults.FaultConfig):
        name = get_args(kind.model_fields["kind"].annotation)[0]
        channel = {"channel": "down"} if issubclass(kind, OnChannel) else {}
        at_work = fault(sensor="it", kind=name, **given[name], **channel)
        one, other = (Faults([at_work], {"it": config}, seed).apply("it", samples) for seed in (5, 6))
        assert alike(one, other) is (not issubclass(kind, faults.DRAWN)), name


@pytest.mark.parametrize(("kind", "channel", "unit"), [("imu", "gyro", "deg/s"), ("magnetometer", "field", "uT")])
def test_a_size_is_added_to_every_axis_of_what_stands_for_several(kind: str, channel: str, unit: str) -> None:
    step = fault(sensor="it", channel=channel, kind="step", size=3.0, unit=unit)
    healthy, ours = sensed(section(kind, rate_hz=100), step, moving=True)
    if kind == "imu":
        added, t = (ours.dtheta - healthy.dtheta) * 100 / math.radians(1), healthy.t
    else:
        added = np.array([b.field_b - a.field_b for a, b in zip(healthy, ours, strict=True)]) / 1e-6
        t = np.array([s.t for s in healthy])
    inside = (t > 10 - 1e-6) & (t < 20 - 1e-6)
    np.testing.assert_allclose(added, np.where(inside, 3.0, 0.0)[:, None] * np.ones(3), atol=1e-9)


def test_a_fault_may_begin_and_end_while_the_run_goes_on_wherever_it_is_cut() -> None:
    """Added and ended between blocks, it acts as one that was known beforehand; stuck, from its first sample on."""
    config = section("gnss", rate_hz=10)
    truth = still(4001)
    window = {"window": (8.0, 12.0)}
    known = Faults(
        [fault(sensor="it", channel="north", kind="sine", size=4.0, period_s=3.0, **window)], {"it": config}, 5
    )
    live = Faults([], {"it": config}, 5)
    one, other = (sensors.build("it", config, RATE_HZ, 5, SITE) for _ in range(2))
    expected = known.apply("it", one.sense(truth))
    found: list[Any] = []
    index = -1
    for block in cut(truth, [700, round(8 * RATE_HZ), 1777, round(12 * RATE_HZ), 3000]):
        if block.t[0] == 8.0:
            keys = {"window": (8.0, 1e5)}
            index = live.add(fault(sensor="it", channel="north", kind="sine", size=4.0, period_s=3.0, **keys))
        if block.t[0] == 12.0:
            ended = live.end(index, 12.0)
            assert (ended.start, ended.end) == (8.0, 12.0)
        found += live.apply("it", other.sense(block))
    assert alike(found, expected)
    assert live.truth == known.truth
