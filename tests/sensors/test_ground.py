"""Rangefinder and optical flow: without errors what geometry says, with errors their statistics."""

from __future__ import annotations

import datetime

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worlds.sensor_truth import RATE_HZ, lively

from nav.terrain import Terrain
from testbed.motion.table import TruthBlock
from testbed.sensors.optical_flow import OpticalFlow, OpticalFlowConfig
from testbed.sensors.rangefinder import Rangefinder, RangefinderConfig
from testbed.sensors.site import Site

DATE = datetime.date(2026, 6, 1)
LEVEL = Site(DATE, 0.6, 1.9, 800.0, Terrain.flat(500.0))
TRUTH = lively(2000)
BODY = Rotation.from_quat(TRUTH.q_nb, scalar_first=True)
RANGE = (TRUTH.h - 500.0) / BODY.as_matrix()[:, 2, 2]
EARTH_N = 7.292115e-5 * np.column_stack([np.cos(TRUTH.lat), np.zeros(len(TRUTH)), -np.sin(TRUTH.lat)])


def level_flight(ticks: int, speed: float = 25.0) -> TruthBlock:
    block = TruthBlock.empty(0, ticks)
    block.t[:] = np.arange(ticks) / RATE_HZ
    block.lat[:], block.lon[:], block.h[:] = 0.6, 1.9, 780.0
    block.q_nb[:, 0] = 1.0
    block.v_n[:, 0] = speed
    return block


def test_a_perfect_range_is_the_height_over_the_cosine_of_the_tilt() -> None:
    samples = Rangefinder("r", RangefinderConfig(grade="perfect"), RATE_HZ, 1, LEVEL).sense(TRUTH)
    assert len(samples) == 100
    np.testing.assert_allclose([one.range for one in samples], RANGE[::20], rtol=1e-12)


def test_limits_of_range() -> None:
    config = RangefinderConfig(grade="perfect", min_range_m=301.0, max_range_m=305.0)
    samples = Rangefinder("r", config, RATE_HZ, 1, LEVEL).sense(TRUTH)
    inside = (RANGE[::20] >= 301.0) & (RANGE[::20] <= 305.0)
    assert 0 < inside.sum() < 100
    np.testing.assert_allclose([one.t for one in samples], TRUTH.t[::20][inside])


def test_the_ground_is_as_far_from_the_map_as_is_told() -> None:
    site = Site(DATE, 0.6, 1.9, 800.0, Terrain.flat(500.0), 4.0)
    found = [
        280.0 - Rangefinder("r", RangefinderConfig(grade="perfect"), RATE_HZ, k, site).sense(level_flight(1))[0].range
        for k in range(400)
    ]
    assert np.std(found) == pytest.approx(4.0, rel=0.12)
    assert np.mean(found) == pytest.approx(0.0, abs=0.7)
    seen = OpticalFlow("f", OpticalFlowConfig(grade="perfect"), RATE_HZ, 3, site).sense(level_flight(20))[-1:]
    config = OpticalFlowConfig(grade="perfect", rate_hz=200.0)
    seen = OpticalFlow("f", config, RATE_HZ, 3, site).sense(level_flight(1))
    assert seen[0].flow_b[1] == pytest.approx(25.0 / (280.0 - found[3]), rel=1e-3)  # the same ground for both


def test_perfect_flow_is_the_motion_of_a_point_of_the_ground() -> None:
    """By differences: where the point that was in the middle of the picture is a moment later, seen from the body."""
    config = OpticalFlowConfig(grade="perfect", rate_hz=RATE_HZ)
    samples = OpticalFlow("f", config, RATE_HZ, 1, LEVEL).sense(TRUTH)
    moment = 1e-4
    for k in range(100, 2000, 300):
        turned = BODY[k] * Rotation.from_rotvec((TRUTH.omega_b[k] - BODY[k].apply(EARTH_N[k], inverse=True)) * moment)
        point_n = BODY[k].apply([0, 0, RANGE[k]])
        x, y, z = turned.apply(point_n - TRUTH.v_n[k] * moment, inverse=True)
        np.testing.assert_allclose(samples[k].flow_b, [y / z / moment, -x / z / moment], atol=2e-5)
        np.testing.assert_allclose(samples[k].rotation_b, TRUTH.omega_b[k, :2], atol=1e-12)


def test_flow_is_the_mean_since_the_sample_before_and_of_its_middle() -> None:
    every = OpticalFlow("f", OpticalFlowConfig(grade="perfect", rate_hz=RATE_HZ), RATE_HZ, 1, LEVEL).sense(TRUTH)
    means = OpticalFlow("f", OpticalFlowConfig(grade="perfect", rate_hz=10), RATE_HZ, 1, LEVEL).sense(TRUTH)
    assert len(means) == 99  # the first has nothing before it
    expected = [np.mean([one.flow_b for one in every[k + 1 : k + 21]], axis=0) for k in range(0, 1980, 20)]
    np.testing.assert_allclose([one.flow_b for one in means], expected, rtol=1e-9)
    assert means[0].t == pytest.approx(np.mean([one.t for one in every[1:21]]))
    assert means[0].t_arrival == pytest.approx(0.1)
    assert means[0].t_arrival - means[0].t <= OpticalFlowConfig(rate_hz=10).age_s


def test_noise_grows_as_quality_falls_and_ends_in_silence() -> None:
    config = OpticalFlowConfig(grade="perfect", rate_hz=50, noise_radps=0.01, max_range_m=400.0, max_rate_radps=1.0)
    samples = OpticalFlow("f", config, RATE_HZ, 1, LEVEL).sense(level_flight(40_000))
    rate = 25.0 / 280.0
    quality = (1 - (280.0 / 400.0) ** 2) * (1 - rate**2)
    assert samples[0].quality == pytest.approx(quality, rel=1e-3)
    found = np.array([one.flow_b for one in samples])
    np.testing.assert_allclose(found.std(axis=0), 0.01 / np.sqrt(quality), rtol=0.03)
    assert found[:, 1].mean() == pytest.approx(rate, abs=5e-4)
    for changed in ({"max_range_m": 290.0}, {"max_rate_radps": 0.09}):
        too_far = OpticalFlow("f", config.model_copy(update=changed), RATE_HZ, 1, LEVEL)
        assert too_far.sense(level_flight(200)) == []


def test_outliers_come_as_often_as_they_say() -> None:
    config = OpticalFlowConfig(grade="perfect", rate_hz=50, outlier_percent=5.0)
    found = np.array([one.flow_b for one in OpticalFlow("f", config, RATE_HZ, 1, LEVEL).sense(level_flight(40_000))])
    off = np.abs(found - np.median(found, axis=0)).max(axis=1) > 1e-9
    assert off.mean() == pytest.approx(0.05, abs=0.01)
    assert found[off].std(axis=0) == pytest.approx([0.1, 0.1], rel=0.1)
