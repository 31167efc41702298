"""A record as a ULog of PX4: what its EKF2 takes for a replay, the truth beside it, and our estimates.

* Its clock begins `START_US` before the run, at which the file begins too: to PX4 a stamp of 0 means never.
* Inertial samples are ``sensor_combined`` (and ``vehicle_imu`` where there are several units); those of other sensors
  stand at the time when they arrived, and ``timestamp_sample`` is when they were true. ``ekf2_timestamps`` says with
  which inertial sample EKF2 saw each first, in 0.1 ms relative to it, rounded up, so that neither version comes early.
* The receiver's latency is told by ``EKF2_GPS_DELAY``, as EKF2 goes by the time at which a fix came. Without a fix the
  place is the last one and accuracies are NaN.
* Truth (of the centre of gravity) is ``vehicle_*_groundtruth``; estimates (of the IMU) are instances of
  ``estimator_*``, the first of them ``vehicle_*`` as well. Local positions are on PX4's own projection, from the first
  place that truth has. Heights above the sea's level are those above the ellipsoid.
* Innovations are prediction less measurement, as PX4 has them: the other way round than ours.

Sources: EKF2.cpp and ReplayEkf2.cpp of PX4-Autopilot 1.15 and 1.16; device numbers, SimulatorMavlink.hpp; sphere and
projection, geo.cpp there, which is Snyder, Map Projections (1987), Eq 5-3 and 25-2 to 25-4.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from nav.earth import SEA_LEVEL_DENSITY, isa_density, isa_temperature, pressure_altitude
from nav.samples import Array, Status
from testbed.exports.stream import START_US, Rows, Stamps, stamps
from testbed.exports.ulog import Topic, encode, rows
from testbed.exports.view import Columns, View, carried, fixed, only, placed, turned
from testbed.feeds.px4 import SPHERE_M
from testbed.motion.sections import FlightTruth
from testbed.motion.table import FLYING_MPS
from testbed.score.accuracy import euler
from testbed.score.detection import refused
from testbed.sensors.gnss import GnssConfig

if TYPE_CHECKING:
    import xarray

NEVER = 32767  # in ekf2_timestamps, of what is not new [0.1 ms]
STEP_US = 100  # of ekf2_timestamps
LATEST_STEPS = 32_000  # a sample is not told of after that
GAUSS, FREEZING = 1e-4, 273.15  # [T], [K]
IMU_ID, MAGNETOMETER_ID, BAROMETER_ID, NEXT_ID = 1310988, 197388, 6620172, 256  # PX4's simulated devices
ARMED, MISSION, FIXED_WING = 2, 3, 2
USABLE_EAS = 8.0  # from which speed on EKF2 is to take the airspeed [m/s]
SLOWEST_DELAY_MS = 200.0  # EKF2 keeps samples for so long by itself

# Topics of what became of an aid, which of its components, and whether it points up where PX4's points down.
AID_TOPICS = (
    ("estimator_aid_src_gnss_pos", "gnss_position", slice(0, 2), False),
    ("estimator_aid_src_gnss_hgt", "gnss_position", slice(2, 3), False),
    ("estimator_aid_src_gnss_vel", "gnss_velocity", slice(0, 3), False),
    ("estimator_aid_src_baro_hgt", "barometer", slice(0, 1), True),
    ("estimator_aid_src_mag", "magnetometer", slice(0, 3), False),
    ("estimator_aid_src_airspeed", "airspeed", slice(0, 1), False),
)


def content(tree: xarray.DataTree, version: str) -> bytes:
    """The ULog of a record for this version of PX4."""
    view = View(tree)
    topics = [
        *_inertial(view, version),
        *_fixes(view, version),
        *_aiding(view, version),
        *_vehicle(view, version),
        *_truth(view, version),
        *_estimates(view, version),
        *_innovations(view, version),
    ]
    texts = [(int(stamps(np.array([t]))[0]), severity, words) for t, severity, words in view.events]
    infos = {
        "sys_name": "navigation-testbed",
        "ver_sw_release_of_messages": f"PX4 {version}",
        "title": view.title,
        "estimators": ", ".join(view.estimators),
    }
    return encode(topics, version, START_US, parameters=_parameters(view), infos=infos, texts=texts)


def local(lat: Array, lon: Array, lat0: float, lon0: float) -> Array:
    """North and east (N, 2) [m] of a place [rad] on PX4's projection, azimuthal equidistant on a sphere."""
    c = np.arccos(
        np.clip(np.sin(lat0) * np.sin(lat) + np.cos(lat0) * np.cos(lat) * np.cos(lon - lon0), -1.0, 1.0)
    )  # Eq 5-3
    k = 1.0 / np.sinc(c / np.pi)  # Eq 25-2
    east = np.cos(lat) * np.sin(lon - lon0)  # Eq 25-3
    north = np.cos(lat0) * np.sin(lat) - np.sin(lat0) * np.cos(lat) * np.cos(lon - lon0)  # Eq 25-4
    place: Array = np.column_stack([north, east]) * (SPHERE_M * k)[:, None]
    return place


def _inertial(view: View, version: str) -> Iterator[Topic]:
    units = view.sensors["imu"]
    for k, own in enumerate(units.values()):
        dt, t = own["dt"], stamps(own["time"])
        dt_us = np.rint(dt * 1e6)
        if k == 0:
            values: dict[str, Any] = {"gyro_rad": own["dtheta"] / dt[:, None], "gyro_integral_dt": dt_us}
            values |= {"accelerometer_m_s2": own["dv"] / dt[:, None], "accelerometer_integral_dt": dt_us}
            yield Topic("sensor_combined", 0, rows("sensor_combined", version, t, **values))
            ids = {"accel_device_id": IMU_ID, "gyro_device_id": IMU_ID}
            yield Topic("sensor_selection", 0, rows("sensor_selection", version, t[:1], **ids))
            yield Topic("ekf2_timestamps", 0, _seen(view, version, t))
        if len(units) > 1:
            device = IMU_ID + k * NEXT_ID
            values = {"accel_device_id": device, "gyro_device_id": device, "timestamp_sample": t}
            values |= {"delta_angle": own["dtheta"], "delta_velocity": own["dv"]}
            values |= {"delta_angle_dt": dt_us, "delta_velocity_dt": dt_us}
            yield Topic("vehicle_imu", k, rows("vehicle_imu", version, t, **values))


def _seen(view: View, version: str, t: Stamps) -> Rows:
    """With which inertial sample EKF2 sees those of the other sensors first."""
    told: dict[str, Any] = {}
    for kind, fields in (
        ("airspeed", ("airspeed_timestamp_rel", "airspeed_validated_timestamp_rel")),
        ("barometer", ("vehicle_air_data_timestamp_rel",)),
        ("magnetometer", ("vehicle_magnetometer_timestamp_rel",)),
    ):
        relative = np.full(len(t), NEVER)
        if (own := view.first(kind)) is not None:
            came = stamps(own["t_arrival"])
            at = np.searchsorted(t, came)
            came, at = came[at < len(t)], at[at < len(t)]
            steps: Stamps = -((t[at] - came) // STEP_US)
            soon = np.asarray(steps >= -LATEST_STEPS)
            relative[at[soon]] = steps[soon]
        told |= dict.fromkeys(fields, relative)
    never = dict.fromkeys(("distance_sensor", "optical_flow", "visual_odometry"), NEVER)
    return rows("ekf2_timestamps", version, t, **told, **{f"{name}_timestamp_rel": n for name, n in never.items()})


def _fixes(view: View, version: str) -> Iterator[Topic]:
    for k, own in enumerate(view.sensors["gnss"].values()):
        fix, t, v = fixed(own), stamps(own["t_arrival"]), own["v_n"]
        lat, lon, h = (carried(own[name], fix) for name in ("lat", "lon", "h"))
        moving = np.asarray(np.isfinite(v).all(axis=1))
        v = np.where(moving[:, None], v, 0.0)
        sigma, sigma_v = own["sigma_position_n"], own["sigma_velocity_n"]
        relative = stamps(own["time"]) - t
        utc = view.midnight.timestamp() * 1e6 + np.rint(own["time"] * 1e6)
        values: dict[str, Any] = {"timestamp_sample": stamps(own["time"]), "device_id": k + 1}
        values |= {"latitude_deg": np.degrees(lat), "longitude_deg": np.degrees(lon)}
        values |= {"altitude_msl_m": h, "altitude_ellipsoid_m": h, "fix_type": own["fix_type"]}
        values |= {"eph": np.hypot(sigma[:, 0], sigma[:, 1]), "epv": sigma[:, 2]}
        values |= {"s_variance_m_s": np.linalg.norm(sigma_v, axis=1), "hdop": own["hdop"], "vdop": own["vdop"]}
        values |= {f"vel_{axis}_m_s": v[:, j] for j, axis in enumerate("ned")}
        values |= {"vel_m_s": np.hypot(v[:, 0], v[:, 1]), "cog_rad": np.arctan2(v[:, 1], v[:, 0])}
        values |= {"vel_ned_valid": moving, "satellites_used": np.maximum(own["satellites"], 0)}
        values |= {"timestamp_time_relative": relative, "time_utc_usec": utc}
        values |= dict.fromkeys(("heading", "heading_offset", "heading_accuracy"), np.nan)
        for name in ("sensor_gps", "vehicle_gps_position") if k == 0 else ("sensor_gps",):
            yield Topic(name, k, rows(name, version, t, **values))


def _aiding(view: View, version: str) -> Iterator[Topic]:
    for k, own in enumerate(view.sensors["barometer"].values()):
        t, h = stamps(own["t_arrival"]), pressure_altitude(own["pressure"])
        values: dict[str, Any] = {"timestamp_sample": stamps(own["time"]), "baro_device_id": BAROMETER_ID + k * NEXT_ID}
        values |= {"baro_alt_meter": h, "baro_pressure_pa": own["pressure"], "rho": isa_density(h)}
        values |= dict.fromkeys(("ambient_temperature", "baro_temp_celcius"), isa_temperature(h) - FREEZING)
        values |= {"eas2tas": np.sqrt(SEA_LEVEL_DENSITY / isa_density(h))}
        yield Topic("vehicle_air_data", k, rows("vehicle_air_data", version, t, **values))
    for k, own in enumerate(view.sensors["magnetometer"].values()):
        values = {"timestamp_sample": stamps(own["time"]), "device_id": MAGNETOMETER_ID + k * NEXT_ID}
        values |= {"magnetometer_ga": own["field_b"] / GAUSS}
        name = "vehicle_magnetometer"
        yield Topic(name, k, rows(name, version, stamps(own["t_arrival"]), **values))
    for k, own in enumerate(view.sensors["airspeed"].values()):
        t, tas = stamps(own["t_arrival"]), own["eas"] * _faster(view, own["time"])
        values = {"timestamp_sample": stamps(own["time"]), "indicated_airspeed_m_s": own["eas"]}
        values |= {"true_airspeed_m_s": tas, "air_temperature_celsius": np.nan, "confidence": 1.0}
        yield Topic("airspeed", k, rows("airspeed", version, t, **values))
        if k == 0:
            values = {f"{what}_airspeed_m_s": own["eas"] for what in ("indicated", "calibrated")}
            values |= dict.fromkeys(("calibrated_ground_minus_wind_m_s", "true_ground_minus_wind_m_s"), np.nan)
            values |= {"true_airspeed_m_s": tas, "airspeed_sensor_measurement_valid": True}
            values |= {"selected_airspeed_index": 1}
            yield Topic("airspeed_validated", 0, rows("airspeed_validated", version, t, **values))


def _faster(view: View, t: Array) -> Array:
    """True over equivalent airspeed (N,), by the standard atmosphere at the barometer's pressure; 1 without one."""
    own = view.first("barometer")
    if own is None:
        return np.ones(len(t))
    h = pressure_altitude(np.interp(t, own["time"], own["pressure"]))
    return np.asarray(np.sqrt(SEA_LEVEL_DENSITY / isa_density(h)))


def _vehicle(view: View, version: str) -> Iterator[Topic]:
    """Armed all the time, and landed while it is slow; once a second."""
    truth = view.truth
    seconds = np.unique(np.floor(truth["time"]))
    speed = np.fmax(np.linalg.norm(truth["v_n"], axis=1), truth["airspeed"])
    down = speed[np.searchsorted(truth["time"], seconds)] < FLYING_MPS
    t = stamps(seconds)
    values: dict[str, Any] = {"armed_time": START_US, "takeoff_time": START_US, "arming_state": ARMED}
    values |= {"nav_state": MISSION, "nav_state_user_intention": MISSION, "system_type": 1, "system_id": 1}
    values |= {"component_id": 1, "pre_flight_checks_pass": True, "power_input_valid": True}
    values |= {"vehicle_type": FIXED_WING if isinstance(view.scenario.truth, FlightTruth) else 0}
    yield Topic("vehicle_status", 0, rows("vehicle_status", version, t, **values))
    on_ground = dict.fromkeys(("ground_contact", "maybe_landed", "landed"), down)
    yield Topic("vehicle_land_detected", 0, rows("vehicle_land_detected", version, t, **on_ground))


def _truth(view: View, version: str) -> Iterator[Topic]:
    for what, values in _states(view, view.truth).items():
        name = f"vehicle_{what}_groundtruth"
        yield Topic(name, 0, rows(name, version, values.pop("t"), **values))


def _estimates(view: View, version: str) -> Iterator[Topic]:
    for k, own in enumerate(view.estimators.values()):
        for what, values in _states(view, own).items():
            t = values.pop("t")
            for name in (f"estimator_{what}", *([f"vehicle_{what}"] if k == 0 else [])):
                yield Topic(name, k, rows(name, version, t, **values))
        t = stamps(own["time"])
        values = {"timestamp_sample": t}
        for what in ("gyro", "accel"):
            known = np.isfinite(own[f"{what}_bias"]).all(axis=1)
            values |= {f"{what}_bias": own[f"{what}_bias"], f"{what}_bias_variance": own[f"sigma_{what}_bias"] ** 2}
            values |= {f"{what}_bias_valid": known, f"{what}_bias_stable": known, f"{what}_device_id": IMU_ID}
        yield Topic("estimator_sensor_bias", k, rows("estimator_sensor_bias", version, t, **values))
        if "wind" in own:
            values = {"timestamp_sample": t}
            for j, axis in enumerate(("north", "east")):
                values |= {f"windspeed_{axis}": own["wind"][:, j], f"variance_{axis}": own["sigma_wind"][:, j] ** 2}
            yield Topic("estimator_wind", k, rows("estimator_wind", version, t, **values))


def _states(view: View, own: Columns) -> dict[str, dict[str, Any]]:
    """What PX4 says of attitude, local and global position, each where it is known: a heading may be NaN."""
    upright = only(own, turned(own))
    t = stamps(upright["time"])
    said: dict[str, dict[str, Any]] = {"attitude": {"t": t, "timestamp_sample": t, "q": upright["q_nb"]}}
    own = only(own, placed(own))
    if not len(own["time"]):
        return said
    t, lat, lon, h, v = stamps(own["time"]), own["lat"], own["lon"], own["h"], own["v_n"]
    lat0, lon0, h0 = view.origin()
    place = local(lat, lon, lat0, lon0)
    blank = np.zeros((len(t), 3))
    sigma, sigma_v = own.get("sigma_position_n", blank), own.get("sigma_velocity_n", blank)
    alone = (own["status"] & Status.DEAD_RECKONING) != 0 if "status" in own else False
    accuracy = {"eph": np.hypot(sigma[:, 0], sigma[:, 1]), "epv": sigma[:, 2], "dead_reckoning": alone}
    valid: dict[str, Any] = dict.fromkeys(("xy_valid", "z_valid", "xy_global", "z_global"), True)
    moving = np.isfinite(v).all(axis=1)
    valid |= {"v_xy_valid": moving, "v_z_valid": moving, "heading_good_for_control": turned(own)}
    unlimited = ("vxy_max", "vz_max", "hagl_min", "hagl_max", "hagl_max_z", "hagl_max_xy")
    unknown = ("ax", "ay", "az", "unaided_heading", "dist_bottom", "dist_bottom_var")
    said["local_position"] = {
        "t": t, "timestamp_sample": t, **valid, **accuracy, **dict.fromkeys(unlimited, np.inf),
        "x": place[:, 0], "y": place[:, 1], "z": h0 - h, "vx": v[:, 0], "vy": v[:, 1], "vz": v[:, 2],
        "z_deriv": v[:, 2], "heading": euler(own["q_nb"])[:, 2],
        "evh": np.hypot(sigma_v[:, 0], sigma_v[:, 1]), "evv": sigma_v[:, 2],
        "ref_timestamp": START_US, "ref_lat": np.degrees(lat0), "ref_lon": np.degrees(lon0), "ref_alt": h0,
        **dict.fromkeys(unknown, np.nan),
    }  # fmt: skip
    said["global_position"] = {
        "t": t, "timestamp_sample": t, "lat": np.degrees(lat), "lon": np.degrees(lon), "alt": h, "alt_ellipsoid": h,
        "lat_lon_valid": True, "alt_valid": True, "terrain_alt": np.nan, **accuracy,
    }  # fmt: skip
    return said


def _innovations(view: View, version: str) -> Iterator[Topic]:
    for k, estimator in enumerate(view.estimators):
        for topic, aid, part, up in AID_TOPICS:
            own = view.reports(estimator, aid)
            if "innovation" not in own:
                continue
            order = np.argsort(own["sample_time"], kind="stable")  # several sensors of a kind come one after another
            own = {name: values[order] for name, values in own.items()}
            t = stamps(own["sample_time"])
            variance = np.diagonal(own["S"], axis1=1, axis2=2)[:, part]
            innovation = own["innovation"][:, part] * (1.0 if up else -1.0)
            out = refused(own["weight"], own["outcome"])
            values: dict[str, Any] = {"timestamp_sample": t, "estimator_instance": k, "innovation_rejected": out}
            values |= {"fused": ~out, "time_last_fuse": np.where(out, 0, t)}
            ratio = np.broadcast_to((own["nis"] / own["threshold"])[:, None], innovation.shape)
            values |= {"innovation": innovation, "innovation_variance": variance, "test_ratio": ratio}
            values |= {f"{name}_filtered": values[name] for name in ("innovation", "test_ratio")}
            values |= dict.fromkeys(("observation", "observation_variance"), np.full(innovation.shape, np.nan))
            flat = {name: v[:, 0] if np.shape(v)[1:] == (1,) else v for name, v in values.items()}
            yield Topic(topic, k, rows(topic, version, t, **flat))


def _parameters(view: View) -> dict[str, int | float]:
    """What EKF2 has to know of the sensors: one filter on sensor_combined, latencies, arms from the IMU."""
    sections, gnss = view.scenario.sensors, next(iter(view.sensors["gnss"]), "")
    imu = next(iter(view.arms.values()), np.zeros(3))
    delay_ms = 0.0
    if gnss:
        own = view.sensors["gnss"][gnss]
        delay_ms = float(np.median(own["t_arrival"] - own["time"])) * 1e3
    section = sections.get(gnss)
    antenna = section.lever_arm_m if isinstance(section, GnssConfig) else (0.0, 0.0, 0.0)
    parameters: dict[str, int | float] = {"SENS_IMU_MODE": 1, "EKF2_MULTI_IMU": 0, "EKF2_MULTI_MAG": 0}
    parameters |= {"EKF2_GPS_DELAY": delay_ms, "EKF2_DELAY_MAX": max(SLOWEST_DELAY_MS, delay_ms)}
    parameters |= {f"EKF2_{name}_DELAY": 0.0 for name in ("BARO", "MAG", "ASP")}
    for name, arm in (("IMU", imu), ("GPS", antenna)):
        parameters |= {f"EKF2_{name}_POS_{axis}": float(arm[k]) for k, axis in enumerate("XYZ")}
    parameters |= {"EKF2_ARSP_THR": USABLE_EAS if view.sensors["airspeed"] else 0.0}
    parameters |= {"EKF2_FUSE_BETA": int(isinstance(view.scenario.truth, FlightTruth))}
    return parameters
