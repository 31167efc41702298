"""The Earth model against pymap3d, against the closed form of the normal potential, and against printed tables."""

import math

import numpy as np
import pyins.earth
import pymap3d
import pymap3d.rcurve
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nav import earth

latitudes = st.floats(-math.pi / 2, math.pi / 2)
longitudes = st.floats(-math.pi, math.pi, exclude_min=True)
heights = st.floats(-500, 30e3)


def normal_potential(x, z):
    """Potential of normal gravity at distance x from the axis and z from the equator, in long double.

    Heiskanen and Moritz, Physical Geodesy, equation 2-62: exact, in ellipsoidal coordinates.
    """
    a, b = np.longdouble(earth.A), np.longdouble(earth.A) * (1 - 1 / np.longdouble("298.257223563"))
    gm, omega = np.longdouble("3986004.418e8"), np.longdouble("7.292115e-5")
    E2 = a * a - b * b
    E = np.sqrt(E2)
    s = x * x + z * z - E2
    u = np.sqrt((s + np.sqrt(s * s + 4 * E2 * z * z)) / 2)
    sin2 = (z / u) ** 2
    cos2 = x * x / (u * u + E2)

    def q(w):
        return ((1 + 3 * (w / E) ** 2) * np.arctan(E / w) - 3 * w / E) / 2

    return (
        gm / E * np.arctan(E / u)
        + omega**2 * a * a / 2 * q(u) / q(b) * (sin2 - np.longdouble(1) / 3)
        + omega**2 / 2 * (u * u + E2) * cos2
    )


@pytest.mark.parametrize("lat_deg", [-84, -45, -10, 0, 30, 60, 84, 90])
@pytest.mark.parametrize("h", [0.0, 1000.0, 10e3])
def test_gravity_is_the_gradient_of_the_normal_potential(lat_deg, h):
    lat = np.longdouble(lat_deg) * np.longdouble(math.pi) / 180
    position = earth.ecef_from_geodetic(float(lat), 0.0, h)
    x, z = np.longdouble(position[0]), np.longdouble(position[2])
    up_x, up_z = np.cos(lat), np.sin(lat)
    step = np.longdouble(10)
    difference = normal_potential(x + step * up_x, z + step * up_z) - normal_potential(x - step * up_x, z - step * up_z)
    # On the ellipsoid Somigliana is exact to the printed digits; above, the series leaves out f^2 and h^3.
    assert earth.gravity(float(lat), h) == pytest.approx(float(-difference / (2 * step)), abs=2e-9 + 1.2e-10 * h)


@given(st.floats(-90, 90), st.floats(-100, 1000))
def test_gravity_is_that_of_an_independent_library(lat_deg, h):
    """pyins has the free-air term to first order; what is left out is 3 g (h / a)^2 and 2 g h / a times f + m."""
    left_out = 30 * (h / earth.A) ** 2 + 20 * abs(h) / earth.A * 0.007
    assert earth.gravity(math.radians(lat_deg), h) == pytest.approx(
        float(pyins.earth.gravity(lat_deg, h)), abs=1e-9 + left_out
    )


def test_gravity_table_values():
    assert earth.gravity(0.0, 0.0) == pytest.approx(9.7803253359, abs=1e-13)
    assert earth.gravity(math.pi / 2, 0.0) == pytest.approx(9.8321849378, abs=1e-13)
    assert pytest.approx(0.00193185265241, abs=1e-11) == earth.SOMIGLIANA_K  # TR8350.2 table 3.4
    assert pytest.approx(0.00344978650684, abs=1e-14) == earth.M
    assert pytest.approx(6.69437999014e-3, abs=1e-14) == earth.E2
    assert pytest.approx(6356752.3142, abs=1e-4) == earth.B


@settings(deadline=None)
@given(st.floats(-89.9, 89.9))
def test_radii_of_curvature(lat_deg):
    R_M, R_N = earth.radii(math.radians(lat_deg))
    assert pytest.approx(pymap3d.rcurve.meridian(lat_deg), rel=1e-12) == R_M
    assert pytest.approx(pymap3d.rcurve.transverse(lat_deg), rel=1e-12) == R_N


@settings(deadline=None)
@given(latitudes, longitudes, heights)
@example(math.pi / 2, 0.0, 0.0)
@example(-math.pi / 2, 0.0, 100.0)
@example(0.0, math.pi, 0.0)
def test_ecef(lat, lon, h):
    r_e = earth.ecef_from_geodetic(lat, lon, h)
    assert r_e == pytest.approx(pymap3d.geodetic2ecef(lat, lon, h, deg=False), abs=5e-9)
    lat_back, lon_back, h_back = earth.geodetic_from_ecef(r_e)
    assert lat_back == pytest.approx(lat, abs=2e-15)
    assert h_back == pytest.approx(h, abs=5e-9)
    across = (earth.A + h) * math.cos(lat)
    assert abs(math.sin(lon_back - lon)) * across < 5e-9


@settings(deadline=None)
@given(st.floats(-89, 89), st.floats(-180, 180))
def test_north_east_down_axes(lat_deg, lon_deg):
    C_en = earth.dcm_en(math.radians(lat_deg), math.radians(lon_deg))
    for axis, direction in enumerate(np.eye(3)):
        # pymap3d: where does a point lie that is 1 Mm away along one axis of n, seen from the origin of n?
        there = np.array(pymap3d.ned2ecef(*(1e6 * direction), lat_deg, lon_deg, 0.0))
        here = np.array(pymap3d.geodetic2ecef(lat_deg, lon_deg, 0.0))
        assert np.abs(C_en[:, axis] - (there - here) / 1e6).max() < 1e-14
    q_en = earth.quat_en(math.radians(lat_deg), math.radians(lon_deg))
    assert np.abs(Rotation.from_quat(q_en, scalar_first=True).as_matrix() - C_en).max() < 1e-15


@settings(deadline=None)
@given(st.floats(-85, 85), longitudes, st.floats(-200, 8000), st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1))
@example(60.0, math.pi, 100.0, 0.0, 1.0, 0.0)
def test_position_difference(lat_deg, lon, h, north, east, down):
    """A point up to 1 km away in each direction: the chord of pymap3d against our arcs."""
    offset = 1000 * np.array([north, east, down])
    lat_there, lon_there, h_there = pymap3d.ned2geodetic(*offset, math.radians(lat_deg), lon, h, deg=False)
    difference = earth.position_difference_n(lat_there, lon_there, h_there, math.radians(lat_deg), lon, h)
    # Curvature: 1 km of level chord drops 8 cm; the meridians close in by 1 km tan(85 deg) / 6400 km = 2e-3.
    assert np.abs(difference - offset).max() < 2.5
    halfway = earth.position_difference_n(
        lat_there, lon_there, h_there, (lat_there + math.radians(lat_deg)) / 2, lon, h
    )
    assert abs(halfway[0] - difference[0] / 2) < 1e-3


def test_position_difference_is_exact_for_short_arcs_and_takes_arrays():
    lat, h = math.radians(84.0), 1000.0
    lon = math.pi - 1e-6
    metres = [3.0, -2.0, 1.5]
    lat_there, lon_there, h_there = pymap3d.ned2geodetic(*metres, lat, lon, h, deg=False)
    assert earth.position_difference_n(lat_there, lon_there, h_there, lat, lon, h) == pytest.approx(metres, abs=2e-5)
    many = earth.position_difference_n(np.full(4, lat_there), np.full(4, lon_there), np.full(4, h_there), lat, lon, h)
    assert many == pytest.approx(np.tile(metres, (4, 1)), abs=2e-5)
    across = earth.position_difference_n(lat, -math.pi + 1e-8, h, lat, math.pi - 1e-8, h)
    assert across[1] == pytest.approx(2e-8 * 6.4e6 * math.cos(lat), rel=1e-2)


@settings(deadline=None)
@given(st.floats(-50, 50))
@example(math.pi)
@example(-math.pi)
def test_wrap_longitude(lon):
    wrapped = earth.wrap_longitude(lon)
    assert -math.pi < wrapped <= math.pi
    assert math.sin(wrapped - lon) == pytest.approx(0, abs=1e-13)
    assert math.cos(wrapped - lon) > 0
    assert earth.wrap_longitude(wrapped) == wrapped
    assert earth.wrap_longitude(np.array([lon]))[0] == wrapped


@pytest.mark.parametrize("lat_deg", [-60.0, 0.0, 45.0, 84.0])
def test_rates_turn_the_axes(lat_deg):
    """Central difference of C_en along the motion: its angular rate is the transport rate; Earth's axis is z of e."""
    lat, lon, h = math.radians(lat_deg), 0.4, 1000.0
    assert earth.dcm_en(lat, lon) @ earth.earth_rate_n(lat) == pytest.approx([0, 0, earth.OMEGA_IE], abs=1e-19)
    v_n = np.array([20.0, 15.0, -2.0])
    dt = 10.0
    ahead = pymap3d.ecef2geodetic(
        *(earth.ecef_from_geodetic(lat, lon, h) + dt * earth.dcm_en(lat, lon) @ v_n), deg=False
    )
    behind = pymap3d.ecef2geodetic(
        *(earth.ecef_from_geodetic(lat, lon, h) - dt * earth.dcm_en(lat, lon) @ v_n), deg=False
    )
    turn = earth.dcm_en(lat, lon).T @ (earth.dcm_en(*ahead[:2]) - earth.dcm_en(*behind[:2])) / (2 * dt)
    rate = [turn[2, 1], turn[0, 2], turn[1, 0]]
    assert rate == pytest.approx(earth.transport_rate_n(lat, h, v_n), abs=1e-11)


# U.S. Standard Atmosphere 1976, table I, by geometric height: pressure [Pa], temperature [K], density [kg/m^3]
@pytest.mark.parametrize(
    ("h", "pressure", "temperature", "density"),
    [
        (0.0, 101325, 288.150, 1.2250),
        (1000.0, 89876, 281.651, 1.1117),
        (5000.0, 54048, 255.676, 0.73643),
        (10000.0, 26500, 223.252, 0.41351),
        (15000.0, 12112, 216.650, 0.19476),
        (20000.0, 5529.3, 216.650, 0.088910),
    ],
)
def test_standard_atmosphere(h, pressure, temperature, density):
    assert earth.isa_pressure(h) == pytest.approx(pressure, rel=3e-5)
    assert earth.isa_temperature(h) == pytest.approx(temperature, abs=2e-3)
    assert earth.isa_density(h) == pytest.approx(density, rel=5e-5)
    assert earth.pressure_altitude(earth.isa_pressure(h)) == pytest.approx(h, abs=1e-6)


@pytest.mark.parametrize("h", [-2e7, -7e6, -1e4, 1e5, 2e7])
def test_a_height_that_no_air_is_at_is_taken_for_the_nearest_that_has_some(h):
    edge = max(min(h, 80e3), -5e3)
    for air in (earth.isa_pressure, earth.isa_temperature, earth.isa_density):
        assert air(h) == air(edge) > 0.0
