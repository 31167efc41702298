"""True increments of motion integrated apart: constant rate and specific force, free fall, a tumbling body."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from nav import earth
from testbed.motion.table import COLUMNS, TruthBlock, increments


def gravitation(r_i, t):
    """Newtonian attraction in inertial axes that agree with e at t = 0: gravity without the Earth's rotation."""
    turn = Rotation.from_rotvec([0, 0, earth.OMEGA_IE * t])
    r_e = turn.inv().apply(r_i)
    lat, lon, h = earth.geodetic_from_ecef(r_e)
    down = earth.dcm_en(lat, lon)[:, 2]
    return turn.apply(earth.gravity(lat, h) * down - earth.OMEGA_IE**2 * r_e * [1, 1, 0])


def inertial_motion(f_b, omega_b, rate_hz, duration_s, lat_deg=-40.0, lon_deg=179.9999):
    """Rows of a body that turns at ``omega_b`` and feels ``f_b``, both constant, integrated in inertial axes."""
    start = np.array([0.3, -0.2, 2.0])  # rotation vector of the attitude at the start
    r_e = earth.ecef_from_geodetic(math.radians(lat_deg), math.radians(lon_deg), 3000.0)
    earth_rate = np.array([0, 0, earth.OMEGA_IE])
    v_i = earth.dcm_en(math.radians(lat_deg), math.radians(lon_deg)) @ [30.0, 40.0, -5.0] + np.cross(earth_rate, r_e)

    def attitude(t):
        return Rotation.from_rotvec(start) * Rotation.from_rotvec(np.multiply.outer(t, omega_b))

    def derivative(t, y):
        return np.concatenate([y[3:], attitude(t).apply(f_b) + gravitation(y[:3], t)])

    t = np.arange(round(duration_s * rate_hz) + 1) / rate_hz
    path = solve_ivp(
        derivative, (0, t[-1]), np.concatenate([r_e, v_i]), "DOP853", t, rtol=1e-13, atol=1e-9, max_step=0.05
    )
    to_earth = Rotation.from_rotvec(np.multiply.outer(-t, earth_rate))
    r_e = to_earth.apply(path.y[:3].T)
    v_e = to_earth.apply(path.y[3:].T) - np.cross(earth_rate, r_e)
    lat, lon, h = np.array([earth.geodetic_from_ecef(r) for r in r_e]).T
    to_ned = Rotation.from_matrix(np.array([earth.dcm_en(a, b) for a, b in zip(lat, lon, strict=True)])).inv()
    return t, lat, lon, h, to_ned.apply(v_e), (to_ned * to_earth * attitude(t)).as_quat(scalar_first=True)


@pytest.mark.parametrize("rate_hz", [10, 50, 200])
def test_constant_rate_and_specific_force_come_back(rate_hz):
    f_b, omega_b = np.array([3.0, -2.0, -9.0]), np.array([2.0, -1.0, 1.5])
    dtheta, dv = increments(*inertial_motion(f_b, omega_b, rate_hz, 1.0))
    assert not dtheta[0].any()
    assert not dv[0].any()
    assert np.abs(dtheta[1:] * rate_hz - omega_b).max() < 1e-10
    assert np.abs(dv[1:] * rate_hz - f_b).max() < 2e-7


@pytest.mark.parametrize("omega_b", [[0.0, 0.0, 0.0], [3.0, 0.5, -1.0]])
def test_free_fall_reads_zero(omega_b):
    _, dv = increments(*inertial_motion(np.zeros(3), np.array(omega_b), 200, 1.0))
    assert np.abs(dv * 200).max() < 1e-7
    assert np.abs(dv.sum(axis=0)).max() < 1e-9


def test_a_body_that_does_not_turn_in_inertial_space_reads_no_rate():
    dtheta, _ = increments(*inertial_motion(np.array([1.0, 0.0, -9.8]), np.zeros(3), 200, 1.0))
    assert np.abs(dtheta * 200).max() < 1e-11


def test_blocks_join_when_each_begins_with_the_last_row_before_it():
    rows = inertial_motion(np.array([1.0, 2.0, -9.0]), np.array([0.5, -0.4, 0.3]), 50, 3.0)
    whole = increments(*rows)
    for first, last in [(0, 1), (1, 2), (2, 77), (77, 151)]:
        block = increments(*(x[max(first - 1, 0) : last] for x in rows))
        drop = 1 if first else 0
        for a, b in zip(block, whole, strict=True):
            assert np.array_equal(a[drop:], b[first:last])


def test_a_block_starts_empty_and_its_rows_are_views():
    block = TruthBlock.empty(100, 5)
    assert len(block) == 5
    for name, column in COLUMNS.items():
        assert getattr(block, name).shape == ((5,) if column.width == 1 else (5, column.width))
    part = block.rows(2, 4)
    assert (part.tick, len(part)) == (102, 2)
    part.h[0] = 7.0
    assert block.h[2] == 7.0
