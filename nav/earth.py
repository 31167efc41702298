"""The Earth: WGS84 ellipsoid, normal gravity, rotation, and the standard atmosphere.

Latitude and longitude are geodetic in radians, ``h`` is metres above the ellipsoid. Functions of scalars that return
a scalar or a tuple work element by element on arrays too. All can be called from a kernel.

Sources: WGS84 and normal gravity, NIMA TR8350.2 (3rd ed., 1997); mechanisation terms, Groves, Principles of GNSS,
Inertial, and Multisensor Integrated Navigation Systems, 2nd ed., chapters 2 and 5; atmosphere, U.S. Standard
Atmosphere 1976.
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np

from nav._jit import njit
from nav.rotation import Four, Three
from nav.samples import Array

# A scalar or an array of scalars: one formula serves both.
Scalar = TypeVar("Scalar", float, Array)

# WGS84 (TR8350.2 tables 3.1, 3.3, 3.4)
A = 6378137.0  # semi-major axis [m]
F = 1 / 298.257223563  # flattening
E2 = F * (2 - F)  # first eccentricity squared
B = A * (1 - F)  # semi-minor axis [m]
GM = 3.986004418e14  # gravitational constant times mass, atmosphere included [m^3/s^2]
OMEGA_IE = 7.292115e-5  # angular rate [rad/s]
GRAVITY_EQUATOR = 9.7803253359  # normal gravity on the ellipsoid at the equator [m/s^2]
GRAVITY_POLE = 9.8321849378  # and at the poles [m/s^2]
SOMIGLIANA_K = B * GRAVITY_POLE / (A * GRAVITY_EQUATOR) - 1
M = OMEGA_IE**2 * A**2 * B / GM  # centrifugal over gravitational acceleration at the equator

# U.S. Standard Atmosphere 1976, first two layers
SEA_LEVEL_PRESSURE = 101325.0  # [Pa]
SEA_LEVEL_TEMPERATURE = 288.15  # [K]
LAPSE_RATE = 0.0065  # [K/m of geopotential height]
TROPOPAUSE = 11000.0  # [m of geopotential height]
TROPOPAUSE_TEMPERATURE = SEA_LEVEL_TEMPERATURE - LAPSE_RATE * TROPOPAUSE
SEA_LEVEL_DENSITY = 1.225  # that defines equivalent airspeed [kg/m^3]
GAS_CONSTANT = 287.05287  # of dry air [J/(kg K)]
STANDARD_GRAVITY = 9.80665  # [m/s^2]
GEOPOTENTIAL_RADIUS = 6356766.0  # [m]
PRESSURE_EXPONENT = STANDARD_GRAVITY / (GAS_CONSTANT * LAPSE_RATE)
TROPOPAUSE_PRESSURE = SEA_LEVEL_PRESSURE * (TROPOPAUSE_TEMPERATURE / SEA_LEVEL_TEMPERATURE) ** PRESSURE_EXPONENT
STRATOSPHERE_SCALE = GAS_CONSTANT * TROPOPAUSE_TEMPERATURE / STANDARD_GRAVITY  # [m]
# What the functions of air take a height for that is beyond: below and above the standard atmosphere (ISO 2533).
ATMOSPHERE = (-5e3, 80e3)  # [m]


@njit
def radii(lat: Scalar) -> tuple[Scalar, Scalar]:
    """Radii of curvature (R_M, R_N) [m]: in the meridian and in the prime vertical (Groves 2.105, 2.106)."""
    return radii_of(np.sin(lat) ** 2)


@njit
def radii_of(sin2: Scalar) -> tuple[Scalar, Scalar]:
    """`radii` where the square of the latitude's sine is ``sin2``."""
    root2 = 1 - E2 * sin2
    R_N = A / np.sqrt(root2)
    return R_N * (1 - E2) / root2, R_N


@njit
def gravity(lat: Scalar, h: Scalar) -> Scalar:
    """Normal gravity [m/s^2], positive down along the ellipsoid's normal.

    Somigliana on the ellipsoid, then the second-order free-air series (TR8350.2 equations 4-1, 4-3). The horizontal
    component that appears above the ellipsoid (8e-9 h sin 2 lat [m/s^2]) is left out.
    """
    down: Scalar = gravity_of(np.sin(lat) ** 2, h)
    return down


@njit
def gravity_of(sin2: Scalar, h: Scalar) -> Scalar:
    """`gravity` where the square of the latitude's sine is ``sin2``."""
    on_ellipsoid = GRAVITY_EQUATOR * (1 + SOMIGLIANA_K * sin2) / np.sqrt(1 - E2 * sin2)
    ratio = h / A
    at_height: Scalar = on_ellipsoid * (1 - 2 * (1 + F + M - 2 * F * sin2) * ratio + 3 * ratio * ratio)
    return at_height


@njit
def earth_rate_n(lat: float) -> Array:
    """Angular rate (3,) of e relative to i in n [rad/s] (Groves 2.123)."""
    return np.array(earth_rate_components(lat))


@njit
def earth_rate_components(lat: float) -> Three:
    """`earth_rate_n` without an array, for long loops."""
    return OMEGA_IE * math.cos(lat), 0.0, -OMEGA_IE * math.sin(lat)


@njit
def transport_rate_n(lat: float, h: float, v_n: Array) -> Array:
    """Angular rate (3,) of n relative to e in n [rad/s] (Groves 5.44). Grows without bound towards the poles."""
    R_M, R_N = radii(lat)
    east_over_radius = v_n[1] / (R_N + h)
    return np.array([east_over_radius, -v_n[0] / (R_M + h), -east_over_radius * math.tan(lat)])


@njit
def wrap_longitude(lon: Scalar) -> Scalar:
    """The same longitude in (-pi, pi]; returned bit for bit when it is there already."""
    wrapped: Scalar = lon - 2 * math.pi * np.ceil((lon - math.pi) / (2 * math.pi))
    return wrapped


@njit
def ecef_from_geodetic(lat: float, lon: float, h: float) -> Array:
    """Position r_e (3,) [m] (Groves 2.112)."""
    return np.array(ecef_components(lat, lon, h))


@njit
def ecef_components(lat: float, lon: float, h: float) -> Three:
    """`ecef_from_geodetic` without an array, for long loops."""
    _, R_N = radii(lat)
    across = (R_N + h) * math.cos(lat)
    return across * math.cos(lon), across * math.sin(lon), ((1 - E2) * R_N + h) * math.sin(lat)


@njit
def geodetic_from_ecef(r_e: Array) -> tuple[float, float, float]:
    """(lat, lon, h) of a position (3,) [m], away from the centre of the Earth.

    Bowring's iteration on the reduced latitude (Survey Review 23, 1976): each round gains about five digits near the
    Earth, three are exact to rounding.
    """
    across = math.hypot(r_e[0], r_e[1])
    z = r_e[2]
    lat = math.atan2(z, (1 - F) ** 2 * across)
    for _ in range(3):
        reduced = math.atan2((1 - F) * math.sin(lat), math.cos(lat))
        lat = math.atan2(z + E2 / (1 - F) * A * math.sin(reduced) ** 3, across - E2 * A * math.cos(reduced) ** 3)
    sin_lat = math.sin(lat)
    h = across * math.cos(lat) + z * sin_lat - A * math.sqrt(1 - E2 * sin_lat * sin_lat)
    return lat, math.atan2(r_e[1], r_e[0]), h


@njit
def dcm_en(lat: float, lon: float) -> Array:
    """C_en (3, 3): components north-east-down to components ECEF (Groves 2.150)."""
    sin_lat, cos_lat = math.sin(lat), math.cos(lat)
    sin_lon, cos_lon = math.sin(lon), math.cos(lon)
    return np.array(
        [
            [-sin_lat * cos_lon, -sin_lon, -cos_lat * cos_lon],
            [-sin_lat * sin_lon, cos_lon, -cos_lat * sin_lon],
            [cos_lat, 0.0, -sin_lat],
        ]
    )


@njit
def quat_en(lat: float, lon: float) -> Array:
    """q_en (4,): the same rotation as `dcm_en`, continuous in longitude up to its sign."""
    return np.array(quat_en_components(lat, lon))


@njit
def quat_en_components(lat: float, lon: float) -> Four:
    """`quat_en` without an array, for long loops."""
    half_turn = -0.5 * (0.5 * math.pi + lat)
    sin_turn, cos_turn = math.sin(half_turn), math.cos(half_turn)
    sin_lon, cos_lon = math.sin(0.5 * lon), math.cos(0.5 * lon)
    return cos_lon * cos_turn, -sin_lon * sin_turn, cos_lon * sin_turn, sin_lon * cos_turn


@njit
def quat_ie(t: float) -> Array:
    """q_ie (4,), the turn of the Earth since i coincided with e: by OMEGA_IE ``t`` about the polar axis."""
    half = 0.5 * OMEGA_IE * t
    return np.array([math.cos(half), 0.0, 0.0, math.sin(half)])


@njit
def displacement_n(lat: float, lon: float, h: float, lat0: float, lon0: float, h0: float) -> Array:
    """Position minus reference position (3,) in metres north-east-down.

    Arc lengths with the radii half-way between the two, for points a few kilometres apart; safe across the date line.
    """
    return np.array(displacement_components(lat, lon, h, lat0, lon0, h0))


@njit
def displacement_components(lat: float, lon: float, h: float, lat0: float, lon0: float, h0: float) -> Three:
    """`displacement_n` without an array, for long loops."""
    mid_lat, mid_h = 0.5 * (lat + lat0), 0.5 * (h + h0)
    R_M, R_N = radii(mid_lat)
    east = (R_N + mid_h) * math.cos(mid_lat) * wrap_longitude(lon - lon0)
    return (R_M + mid_h) * (lat - lat0), east, h0 - h


@njit
def _displacements_n(lat: Array, lon: Array, h: Array, lat0: Array, lon0: Array, h0: Array) -> Array:
    difference = np.empty((len(lat), 3))
    for k in range(len(lat)):
        one = displacement_n(lat[k], lon[k], h[k], lat0[k], lon0[k], h0[k])
        difference[k, 0], difference[k, 1], difference[k, 2] = one[0], one[1], one[2]
    return difference


def position_difference_n(lat: Scalar, lon: Scalar, h: Scalar, lat0: Scalar, lon0: Scalar, h0: Scalar) -> Array:
    """`displacement_n` of one point, (3,), or of N at once, (N, 3), when any argument is an array."""
    points = np.broadcast_arrays(lat, lon, h, lat0, lon0, h0)
    difference = _displacements_n(*[np.array(column, dtype=float).ravel() for column in points])
    return difference.reshape(*points[0].shape, 3)


@njit
def _geopotential(h: Scalar) -> Scalar:
    """Geopotential height [m] of a height above sea level [m], held where air is: a filter may believe any."""
    held = np.minimum(np.maximum(h, ATMOSPHERE[0]), ATMOSPHERE[1])
    geopotential: Scalar = GEOPOTENTIAL_RADIUS * held / (GEOPOTENTIAL_RADIUS + held)
    return geopotential


@njit
def isa_temperature(h: Scalar) -> Scalar:
    """Standard air temperature [K] at a height above sea level [m], up to 20 km."""
    temperature: Scalar = SEA_LEVEL_TEMPERATURE - LAPSE_RATE * np.minimum(_geopotential(h), TROPOPAUSE)
    return temperature


@njit
def isa_pressure(h: Scalar) -> Scalar:
    """Standard static pressure [Pa] at a height above sea level [m], up to 20 km."""
    geopotential = _geopotential(h)
    below = (isa_temperature(h) / SEA_LEVEL_TEMPERATURE) ** PRESSURE_EXPONENT
    above = np.exp(-np.maximum(geopotential - TROPOPAUSE, 0.0) / STRATOSPHERE_SCALE)
    pressure: Scalar = SEA_LEVEL_PRESSURE * below * above
    return pressure


@njit
def isa_density(h: Scalar) -> Scalar:
    """Standard air density [kg/m^3] at a height above sea level [m], up to 20 km."""
    return isa_pressure(h) / (GAS_CONSTANT * isa_temperature(h))


@njit
def pressure_altitude(p: Scalar) -> Scalar:
    """Height above sea level [m] where the standard pressure is ``p`` [Pa]: the inverse of `isa_pressure`."""
    below = (
        SEA_LEVEL_TEMPERATURE
        / LAPSE_RATE
        * (1 - (np.maximum(p, TROPOPAUSE_PRESSURE) / SEA_LEVEL_PRESSURE) ** (1 / PRESSURE_EXPONENT))
    )
    geopotential = below - STRATOSPHERE_SCALE * np.log(np.minimum(p, TROPOPAUSE_PRESSURE) / TROPOPAUSE_PRESSURE)
    height: Scalar = GEOPOTENTIAL_RADIUS * geopotential / (GEOPOTENTIAL_RADIUS - geopotential)
    return height
