"""Rotations against scipy's Rotation, and their inverses against themselves."""

import math

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.integrate import quad_vec
from scipy.spatial.transform import Rotation

from nav import rotation

components = st.floats(-1, 1, allow_subnormal=False)
vectors = st.builds(lambda x, y, z: np.array([x, y, z]), components, components, components)
magnitudes = st.one_of(st.floats(1e-12, 1e-6), st.floats(1e-6, 0.3), st.floats(0.3, 3.1))
angles = st.floats(-math.pi, math.pi)


@st.composite
def rotvecs(draw):
    v = draw(vectors)
    assume(np.linalg.norm(v) > 1e-3)
    return draw(magnitudes) * v / np.linalg.norm(v)


def scipy_from(q):
    return Rotation.from_quat(q, scalar_first=True)


def same_rotation(p, q):
    return min(np.abs(p - q).max(), np.abs(p + q).max())


@settings(deadline=None)
@given(rotvecs())
@example(np.zeros(3))
def test_exponential_and_its_inverse(phi):
    q = rotation.quat_from_rotvec(phi)
    oracle = Rotation.from_rotvec(phi)
    assert same_rotation(q, oracle.as_quat(scalar_first=True)) < 1e-15
    assert np.abs(rotation.dcm_from_quat(q) - oracle.as_matrix()).max() < 2e-15
    assert rotation.rotvec_from_quat(q) == pytest.approx(phi, rel=1e-13, abs=1e-15)
    assert rotation.rotvec_from_quat(-q) == pytest.approx(phi, rel=1e-13, abs=1e-15)


@settings(deadline=None)
@given(rotvecs(), rotvecs(), vectors)
def test_product_inverse_and_rotated_vector(phi, psi, v):
    p, q = rotation.quat_from_rotvec(phi), rotation.quat_from_rotvec(psi)
    product = rotation.quat_multiply(p, q)
    assert same_rotation(product, (scipy_from(p) * scipy_from(q)).as_quat(scalar_first=True)) < 1e-15
    assert np.abs(rotation.quat_rotate(p, v) - scipy_from(p).apply(v)).max() < 2e-15
    assert np.abs(rotation.quat_rotate(rotation.quat_conjugate(p), rotation.quat_rotate(p, v)) - v).max() < 2e-15
    assert np.abs(rotation.quat_normalise(3.0 * q) - q).max() < 1e-15
    rotation.turn(q, *phi)
    assert same_rotation(q, product) < 1e-15


@settings(deadline=None)
@given(rotvecs())
@example(np.array([math.pi, 0.0, 0.0]))
@example(np.array([0.0, math.pi, 0.0]))
@example(np.array([0.0, 0.0, math.pi]))
@example(np.array([0.0, 2.2, 2.2]))
def test_quaternion_of_a_matrix(phi):
    q = rotation.quat_from_rotvec(phi)
    back = rotation.quat_from_dcm(Rotation.from_rotvec(phi).as_matrix())
    assert same_rotation(back, q) < 2e-15
    assert back[0] >= 0


@settings(deadline=None)
@given(angles, st.floats(-1.57, 1.57), angles)
def test_euler_angles(roll, pitch, heading):
    q = rotation.quat_from_euler(roll, pitch, heading)
    oracle = Rotation.from_euler("ZYX", [heading, pitch, roll])
    assert same_rotation(q, oracle.as_quat(scalar_first=True)) < 1e-15
    back = rotation.euler_from_quat(q)
    # asin loses half the digits towards +-90 deg, and with it the split between roll and heading
    assert np.abs(Rotation.from_euler("ZYX", back[::-1]).as_matrix() - oracle.as_matrix()).max() < 1e-7
    if abs(pitch) < 1.5:
        wrapped = (back - [roll, pitch, heading] + math.pi) % (2 * math.pi) - math.pi
        assert np.abs(wrapped).max() < 1e-13


def test_straight_up_keeps_the_attitude():
    q = rotation.quat_from_euler(0.3, math.pi / 2, 1.1)
    back = rotation.euler_from_quat(q)
    assert back[1] == pytest.approx(math.pi / 2, abs=1e-7)
    assert np.isfinite(back).all()


@pytest.mark.parametrize("part", [slice(None), 0, 2])
def test_an_unknown_attitude_has_no_euler_angles(part):
    q = np.full(4, 0.5)
    q[part] = math.nan
    assert np.isnan(rotation.euler_from_quat(q)).all()


@settings(deadline=None)
@given(vectors, vectors)
def test_cross_and_skew(u, v):
    assert np.array_equal(rotation.cross(u, v), np.cross(u, v))
    assert np.abs(rotation.skew(u) @ v - np.cross(u, v)).max() < 1e-15


@settings(deadline=None, max_examples=50)
@given(rotvecs(), vectors)
@example(np.zeros(3), np.array([1.0, 2.0, 3.0]))
@example(np.array([0.0, 5.9, 0.0]), np.array([1.0, 2.0, 3.0]))
def test_left_jacobian_by_quadrature(phi, v):
    mean, _ = quad_vec(lambda s: Rotation.from_rotvec(s * phi).apply(v), 0, 1, epsabs=1e-14)
    assert np.abs(rotation.left_jacobian_solve(phi, mean) - v).max() < 1e-13


@pytest.mark.parametrize("x", [0.0, 1e-9, 1e-3, 0.1, 0.19999, 0.20001, 1.0, 3.0, 6.0])
def test_coefficients_on_both_sides_of_the_switch(x):
    exact = np.longdouble(x)
    a, b, c = rotation.rotation_coefficients(x * x)
    if x < 1e-2:  # leading terms, where even long double cancels
        expected = 1 - x**2 / 6 + x**4 / 120, 1 / 2 - x**2 / 24 + x**4 / 720, 1 / 6 - x**2 / 120 + x**4 / 5040
    else:
        expected = np.sin(exact) / exact, (1 - np.cos(exact)) / exact**2, (exact - np.sin(exact)) / exact**3
    # x - sin x loses two digits just above the switch; c is only ever used times x^2
    tolerance = 5e-16 if x < 0.2 else 2e-14
    assert np.abs(np.array([a, b, c]) - np.array(expected, float)).max() < tolerance
