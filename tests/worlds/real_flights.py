"""Scenarios of three recorded flights, that are not part of the project; `folder` is where they lie, if they do.

The variable ``TESTBED_RECORDINGS`` names the folder. Which columns are what is said by the recordings' own README.
"""

from __future__ import annotations

import os
from pathlib import Path

FOLDER = os.environ.get("TESTBED_RECORDINGS", "")

IMU = '[truth.columns.imu]\ntime = "imu_t"\ngyro = "gyro"\naccel = "accel"\n'
GNSS = """
[truth.columns.gnss]
time = "gnss_t"
lat = "gnss_lat"
lon = "gnss_lon"
height = "gnss_h"
velocity = "gnss_vel"
"""
GRADES = {"gnss": "u-blox-m8", "barometer": "hobby", "airspeed": "hobby", "magnetometer": "hobby"}


def flown_with(*aids: str) -> str:
    """Sensors, each told to be a hobby autopilot's, and an INS and an AHRS with them."""
    sensors = "".join(f'[sensors.{name}]\ngrade = "{GRADES[name]}"\n' for name in aids)
    return f"""
[sensors.imu]
grade = "mems-hobby"
{sensors}[[estimator]]
name = "ins"
kind = "ins"
aids = {list(aids)}
[[estimator]]
name = "ahrs"
kind = "ahrs"
aids = {list(aids[1:])}
"""


AEROPLANE = flown_with("gnss", "barometer", "airspeed", "magnetometer")
THOR = f"""
title = "Ultra Stick, 696 s at 50 Hz"
duration_s = 600
date = 2012-06-01
[truth]
source = "log"
file = "{FOLDER}/fw_thor75.npz"
rate_hz = 100
start_s = 60
{IMU}{GNSS}
satellites = "gnss_nsat"
[truth.columns.barometer]
time = "air_t"
pressure = "p_static"
[truth.columns.airspeed]
time = "air_t"
airspeed = "ias"
[truth.columns.magnetometer]
time = "mag_t"
field = {{ column = "mag_raw", unit = "G", axes = ["x", "-y", "-z"] }}
[truth.columns.reference]
time = "ref_t"
lat = "ref_lat"
lon = "ref_lon"
height = "ref_h"
velocity = "ref_vel"
attitude = "ref_q"
{AEROPLANE}"""
SWISS = f"""
title = "Fixed wing, 150 s at 145 Hz"
duration_s = 149
date = 2014-06-01
[truth]
source = "log"
file = "{FOLDER}/fw_px4_swisslog.npz"
{IMU}{GNSS}
[truth.columns.barometer]
time = "air_t"
height = "baro_h"
[truth.columns.airspeed]
time = "air_t"
airspeed = "ias"
[truth.columns.magnetometer]
time = "mag_t"
field = {{ column = "mag", unit = "mG" }}
[truth.columns.reference]
time = "refpos_t"
lat = "refpos_lat"
lon = "refpos_lon"
height = "refpos_h"
velocity = "refpos_vel"
attitude = "ref_q"
{AEROPLANE}"""
QUAD = f"""
title = "Quadcopter, 702 s at 45 Hz"
duration_s = 690
date = 2014-06-01
[truth]
source = "log"
file = "{FOLDER}/mr_quad123.npz"
rate_hz = 100
{IMU}{GNSS}
[truth.columns.barometer]
time = "air_t"
height = "baro_h_rel"
[truth.columns.magnetometer]
time = "mag_t"
field = {{ column = "mag", unit = "mG" }}
[truth.columns.reference]
time = "ref_t"
attitude = "ref_q"
{flown_with("gnss", "barometer", "magnetometer")}"""
FLIGHTS = {"thor": THOR, "swiss": SWISS, "quad": QUAD}


def available() -> bool:
    """Whether the recordings are there."""
    return bool(FOLDER) and Path(FOLDER).is_dir()
