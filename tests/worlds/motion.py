"""Analytic motion: circling, weaving, climbing, in the radii of curvature of pymap3d."""

import math

import numpy as np
import pymap3d
import pymap3d.rcurve
from scipy.spatial.transform import Rotation

RATE_HZ = 200
DT = 1 / RATE_HZ
RADIUS = 6.37e6


def quaternions(roll, pitch, heading):
    return Rotation.from_euler("ZYX", np.column_stack([heading, pitch, roll])).as_quat(scalar_first=True)


def manoeuvres(duration_s, lat0_deg, lon0_deg):
    """Rows (t, lat, lon, h, v_n, q_nb) at 200 Hz: circling 400 m wide at about 25 m/s in a drift, a weave, climbs and

    descents, bank as in coordinated turns, and quick roll, pitch and yaw oscillations on top. Latitude, longitude and
    height are sums of sines; velocity is their derivative by hand, in the radii of curvature of pymap3d.
    """
    t = np.arange(int(duration_s * RATE_HZ) + 1) / RATE_HZ
    circle, weave, climb, bump = 0.0625, 2 * math.pi / 47, 2 * math.pi / 310, 2 * math.pi / 11
    north = 4 * t + 400 * np.sin(circle * t) + 20 * np.sin(weave * t)
    north_rate = 4 + 400 * circle * np.cos(circle * t) + 20 * weave * np.cos(weave * t)
    east = 3 * t - 400 * np.cos(circle * t) + 30 * np.cos(weave * t)
    east_rate = 3 + 400 * circle * np.sin(circle * t) - 30 * weave * np.sin(weave * t)
    north_accel = -400 * circle**2 * np.sin(circle * t) - 20 * weave**2 * np.sin(weave * t)
    east_accel = 400 * circle**2 * np.cos(circle * t) - 30 * weave**2 * np.cos(weave * t)
    h = 800 + 150 * np.sin(climb * t) + 3 * np.sin(bump * t)
    h_rate = 150 * climb * np.cos(climb * t) + 3 * bump * np.cos(bump * t)

    lat0 = math.radians(lat0_deg)
    lat = lat0 + north / RADIUS
    lon = math.radians(lon0_deg) + east / (RADIUS * math.cos(lat0))
    v_n = np.column_stack(
        [
            north_rate / RADIUS * (pymap3d.rcurve.meridian(np.degrees(lat)) + h),
            east_rate / (RADIUS * math.cos(lat0)) * np.cos(lat) * (pymap3d.rcurve.transverse(np.degrees(lat)) + h),
            -h_rate,
        ]
    )
    speed = np.hypot(north_rate, east_rate)
    turn_rate = (north_rate * east_accel - east_rate * north_accel) / speed**2
    roll = (
        np.arctan(speed * turn_rate / 9.8) + 0.15 * np.sin(2 * math.pi * 0.7 * t) + 0.01 * np.sin(2 * math.pi * 5 * t)
    )
    pitch = np.arctan(h_rate / speed) + 0.05 + 0.03 * np.sin(2 * math.pi * 0.9 * t)
    heading = np.arctan2(east_rate, north_rate) + 0.04 * np.sin(2 * math.pi * 0.5 * t)
    lon = np.angle(np.exp(1j * lon))
    return t, lat, lon, h, v_n, quaternions(roll, pitch, heading)
