"""The ground and what is seen of it: against interpolation by scipy, geometry by pymap3d, differences."""

from __future__ import annotations

import math

import numpy as np
import pymap3d
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation
from worlds.ins import CONSUMER

from nav.aids.base import Measurement, OperatingPoint, aid_blocks
from nav.aids.terrain import OpticalFlowAid, RangefinderAid, optical_flow, range_to_ground
from nav.alignment import InitialState
from nav.earth import OMEGA_IE, radii, wrap_longitude
from nav.error_model import MOTION, PHI, POS, VEL, ErrorModel
from nav.reference import Reference
from nav.rotation import quat_from_rotvec, quat_multiply
from nav.samples import OpticalFlowSample, RangeSample
from nav.terrain import Terrain, ground, slant_range

LAT, LON = math.radians(36.5), math.radians(-84.2)
STEP = math.radians(3 / 3600)
ROWS, COLUMNS = np.mgrid[0:40, 0:50]
HILLS = Terrain(
    400 + 60 * np.sin(0.35 * ROWS) * np.cos(0.3 * COLUMNS) + 3.0 * COLUMNS, np.array([LAT, STEP, LON, STEP])
)
FLAT = Terrain.flat(120.0)
TERRAINS = pytest.mark.parametrize("terrain", [FLAT, HILLS], ids=["flat", "hills"])
TERRAIN, SCALE, ERROR, LOCAL = MOTION, MOTION + 1, MOTION + 2, MOTION + 4  # states beside the motion
N = MOTION + 5


def test_heights_are_those_between_the_points() -> None:
    rng = np.random.default_rng(1)
    lat, lon = LAT + STEP * rng.uniform(0, 39, 200), LON + STEP * rng.uniform(0, 49, 200)
    between = RegularGridInterpolator(
        (LAT + STEP * np.arange(40), LON + STEP * np.arange(50)), HILLS.heights, bounds_error=False, fill_value=None
    )
    found = np.array([ground(a, b, HILLS.heights, HILLS.grid) for a, b in zip(lat, lon, strict=True)])
    np.testing.assert_allclose(found[:, 0], between(np.column_stack([lat, lon])), rtol=1e-12)


def test_slopes_are_the_differences_of_heights() -> None:
    R_M, R_N = radii(LAT)
    a, b, d = LAT + 10.4 * STEP, LON + 20.7 * STEP, 1e-9
    height, north, east = ground(a, b, HILLS.heights, HILLS.grid)
    assert north == pytest.approx((ground(a + d, b, HILLS.heights, HILLS.grid)[0] - height) / (d * R_M), rel=1e-4)
    along = d * R_N * math.cos(a)
    assert east == pytest.approx((ground(a, b + d, HILLS.heights, HILLS.grid)[0] - height) / along, rel=1e-3)


def test_beyond_the_edge_it_is_as_at_the_edge() -> None:
    corner = ground(LAT - 1.0, LON + 1.0, HILLS.heights, HILLS.grid)
    assert corner == (HILLS.heights[0, -1], 0.0, 0.0)


@pytest.mark.parametrize("first", [179.98, -180.02, 180.0 - 49 * 3 / 3600])
def test_a_map_across_the_date_line_is_one_map(first: float) -> None:
    """The same hills elsewhere are the oracle; beyond an edge it is that edge, however longitude is counted."""
    west = math.radians(first)
    moved = Terrain(HILLS.heights, np.array([LAT, STEP, west, STEP]))
    rng = np.random.default_rng(4)
    for row, column in rng.uniform([0, -40], [39, 89], (200, 2)):
        expected = ground(LAT + STEP * row, LON + STEP * column, HILLS.heights, HILLS.grid)
        for lon in (west + STEP * column, float(wrap_longitude(west + STEP * column))):
            found = ground(LAT + STEP * row, lon, moved.heights, moved.grid)
            np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-9)


def test_a_map_of_the_whole_earth_has_its_own_longitudes() -> None:
    heights = np.tile(np.arange(361.0), (2, 1))
    for lon_deg in (-180.0, -179.5, -0.25, 0.0, 100.5, 179.75):
        at = ground(0.0, math.radians(lon_deg), heights, np.radians([-1.0, 2.0, -180.0, 1.0]))[0]
        assert at == pytest.approx(lon_deg + 180.0, abs=1e-9)


@TERRAINS
def test_a_line_of_sight_ends_on_the_ground(terrain: Terrain) -> None:
    """The point at that range, by pymap3d on the curved Earth, is on the ground but for the curvature."""
    lla = np.array([LAT + 20.3 * STEP, LON + 24.6 * STEP, 900.0])
    for azimuth, off_nadir in ((0.0, 0.0), (40.0, 20.0), (200.0, 45.0), (310.0, 60.0)):
        look = np.array(Rotation.from_euler("ZY", [azimuth, -off_nadir], degrees=True).apply([0, 0, 1.0]))
        length = slant_range(lla, look, 7.0, terrain.heights, terrain.grid)[0]
        lat, lon, h = pymap3d.ned2geodetic(*(length * look), lla[0], lla[1], lla[2], deg=False)
        assert h == pytest.approx(ground(lat, lon, terrain.heights, terrain.grid)[0] + 7.0, abs=0.25)


def test_who_looks_at_the_sky_sees_no_ground() -> None:
    lla = np.array([LAT, LON, 900.0])
    for look in ([0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.98, 0.0, 0.199]):
        assert math.isnan(slant_range(lla, np.array(look), 0.0, FLAT.heights, FLAT.grid)[0])
    below = np.array([LAT, LON, 100.0])
    assert math.isnan(slant_range(below, np.array([0.0, 0.0, 1.0]), 0.0, FLAT.heights, FLAT.grid)[0])


def state(seed: int) -> tuple[np.ndarray, ...]:
    """Attitude within 40 deg of level, velocity, place over the hills, estimated values."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform([-180, -25, -40], [180, 25, 40])
    q_nb = Rotation.from_euler("ZYX", angles, degrees=True).as_quat(scalar_first=True)
    lla = np.array([LAT + 20 * STEP, LON + 20 * STEP, rng.uniform(700, 1200)])
    x = np.zeros(N)
    x[MOTION:] = rng.normal(size=5) * [5.0, 0.02, 1e-4, 1e-4, 5.0]
    return q_nb, rng.normal(size=3) * 20, lla, x


def displaced(at: tuple[np.ndarray, ...], delta: np.ndarray) -> tuple[np.ndarray, ...]:
    q_nb, v_n, lla, x = at
    R_M, R_N = radii(lla[0])
    dp = delta[POS : POS + 3]
    off = np.array([dp[0] / (R_M + lla[2]), dp[1] / ((R_N + lla[2]) * math.cos(lla[0])), -dp[2]])
    values = x.copy()
    values[MOTION:] += delta[MOTION:]
    turned = quat_multiply(quat_from_rotvec(-delta[PHI : PHI + 3]), q_nb)
    return turned, v_n + delta[VEL : VEL + 3], lla + off, values


def ranged(at: tuple[np.ndarray, ...], terrain: Terrain) -> tuple[np.ndarray, np.ndarray]:
    return range_to_ground(at[0], at[2], at[3], TERRAIN, LOCAL, SCALE, 0.0, 500.0, terrain.heights, terrain.grid)


def flowing(at: tuple[np.ndarray, ...], terrain: Terrain) -> tuple[np.ndarray, np.ndarray]:
    rotation = np.array([0.02, -0.03])
    return optical_flow(
        *at, TERRAIN, LOCAL, SCALE, ERROR, 0.0, np.array([0.05, 0.01]), rotation, terrain.heights, terrain.grid
    )  # fmt: skip


@TERRAINS
@pytest.mark.parametrize("measurement", [ranged, flowing])
@pytest.mark.parametrize("seed", range(5))
def test_jacobians_are_differences(measurement, terrain: Terrain, seed: int) -> None:
    """But for 1e-5 m per metre, by which meridians converge between the aircraft and the ground that it sees."""
    at = state(seed)
    _, H = measurement(at, terrain)
    steps = [*[1e-5] * 3, *[1e-3] * 3, *[0.1] * 4, 1e-5, 1e-6, 1e-6, 0.1]
    for k, step in enumerate(steps):
        delta = np.zeros(N)
        delta[k] = step
        higher, lower = measurement(displaced(at, delta), terrain)[0], measurement(displaced(at, -delta), terrain)[0]
        np.testing.assert_allclose((lower - higher) / (2 * step), H[:, k], rtol=2e-3, atol=2e-5, err_msg=str(k))


def test_signs_of_flow() -> None:
    """MAVLink: forward motion is a positive flow about y, motion to the right a negative one about x."""
    nothing = np.zeros(2)
    lla, x = np.array([LAT, LON, 220.0]), np.zeros(N)
    level = np.array([1.0, 0.0, 0.0, 0.0])
    for v_n, expected in (([10.0, 0, 0], [0, 0.1]), ([0, 10.0, 0], [-0.1, 0])):
        nu, _ = optical_flow(
            level, np.array(v_n), lla, x, -1, -1, -1, -1, 0.0, nothing, nothing, FLAT.heights, FLAT.grid
        )  # fmt: skip
        np.testing.assert_allclose(-nu, np.array(expected) - [OMEGA_IE * math.cos(LAT), 0], atol=1e-12)


ARM, RATE_B = np.array([0.3, 1.2, -0.4]), np.array([0.05, -0.02, 0.1])
EYES = (RangefinderAid(arm_b=tuple(ARM), terrain=FLAT), OpticalFlowAid(arm_b=tuple(ARM), terrain=FLAT))
MODEL = ErrorModel(CONSUMER, aid_blocks(EYES))


def banked(error: np.ndarray) -> OperatingPoint:
    """A turn over flat ground as a filter has it, whose motion is off by an ``error`` (9,)."""
    reference = Reference([MODEL], [1.0], 10, lambda *_: np.zeros(3))
    level = Rotation.from_rotvec(-error[PHI : PHI + 3])
    attitude = level * Rotation.from_euler("ZYX", [0.6, 0.05, 0.4])
    place = pymap3d.ned2geodetic(*error[POS : POS + 3], LAT, LON, 320.0, deg=False)
    v_n = np.array([20.0, 9.0, -1.0]) + error[VEL : VEL + 3]
    state = reference.start(InitialState(0.0, *place, v_n, attitude.as_quat(scalar_first=True), np.eye(9)))
    state.rates[0] = RATE_B
    return OperatingPoint(reference, state, state.x[0], (), state.P[0])


@pytest.mark.parametrize("aid", EYES, ids=lambda aid: aid.sensor)
def test_a_sensor_beside_the_imu_sees_from_where_it_is(aid: RangefinderAid | OpticalFlowAid) -> None:
    """What it measures there is no news to a filter, and what its errors change is as differences say."""
    at = banked(np.zeros(9))
    C = Rotation.from_quat(at.state.q_nb, scalar_first=True)
    earth_b = C.inv().apply(OMEGA_IE * np.array([math.cos(LAT), 0.0, -math.sin(LAT)]))
    _, _, h = pymap3d.ned2geodetic(*C.apply(ARM), LAT, LON, 320.0, deg=False)
    distance = (h - 120.0) / C.as_matrix()[2, 2]
    v_b = C.inv().apply(at.state.v_n) + np.cross(RATE_B - earth_b, ARM)
    seen = np.array([-v_b[1], v_b[0]]) / distance + RATE_B[:2] - earth_b[:2]
    sample: RangeSample | OpticalFlowSample = RangeSample(0.0, 0.0, distance)
    if isinstance(aid, OpticalFlowAid):
        sample = OpticalFlowSample(0.0, 0.0, seen, RATE_B[:2], 1.0)

    def measured(error: np.ndarray) -> Measurement:
        here = banked(error)._replace(starts=tuple(map(MODEL.start, aid.states)))
        found = aid.measure(aid.parts[0][0], sample, here)
        assert found is not None
        return found

    nothing = measured(np.zeros(9))
    np.testing.assert_allclose(nothing.nu, 0.0, atol=1e-3 if isinstance(aid, RangefinderAid) else 1e-6)
    for k, step in enumerate([1e-5] * 3 + [1e-3] * 3 + [0.1] * 3):
        off = step * np.eye(9)[k]
        slope = (measured(-off).nu - measured(off).nu) / (2 * step)
        np.testing.assert_allclose(nothing.H[:, k], slope, rtol=2e-3, atol=2e-5, err_msg=str(k))
    gyro = MODEL.start("gyro_bias")
    swing = np.array([np.cross(-np.eye(3)[k], ARM) for k in range(3)]).T  # of a rate that is known less by its bias
    expected = {"range": np.zeros((1, 3)), "optical_flow": np.array([-swing[1], swing[0]]) / distance}[aid.parts[0][0]]
    np.testing.assert_allclose(nothing.H[:, gyro : gyro + 3], expected, atol=1e-9)
