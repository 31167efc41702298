"""What PX4's messages hold, by version: what a ULog must say word for word to be replayed by PX4.

One line a message: types as `struct` letters, with the length of arrays before, and the names of fields of that type.
Fields stand in the order in which PX4 logs them: by the size of their type, largest first, else as they are defined.
Sources: PX4's message definitions as published for 1.15 (px4_msgs a1045ec, v1.15.4) and 1.16 (px4_msgs 392e831,
v1.16.2), https://github.com/PX4/px4_msgs; the order, Tools/msg/templates/uorb/msg.json.em of PX4-Autopilot.
"""

from __future__ import annotations

from collections.abc import Mapping

V1_16: Mapping[str, str] = {
    "sensor_combined": (
        "Q timestamp | 3f gyro_rad | I gyro_integral_dt | i accelerometer_timestamp_relative | 3f "
        "accelerometer_m_s2 | I accelerometer_integral_dt | B accelerometer_clipping gyro_clipping "
        "accel_calibration_count gyro_calibration_count"
    ),
    "vehicle_imu": (
        "Q timestamp timestamp_sample | I accel_device_id gyro_device_id | 3f delta_angle delta_velocity | I "
        "delta_angle_dt delta_velocity_dt | B delta_angle_clipping delta_velocity_clipping "
        "accel_calibration_count gyro_calibration_count"
    ),
    "vehicle_air_data": (
        "Q timestamp timestamp_sample | I baro_device_id | f baro_alt_meter baro_pressure_pa ambient_temperature "
        "rho | B temperature_source calibration_count"
    ),
    "vehicle_magnetometer": "Q timestamp timestamp_sample | I device_id | 3f magnetometer_ga | B calibration_count",
    "sensor_gps": (
        "Q timestamp timestamp_sample | d latitude_deg longitude_deg altitude_msl_m altitude_ellipsoid_m | Q "
        "time_utc_usec | I device_id | f s_variance_m_s c_variance_rad eph epv hdop vdop | i noise_per_ms "
        "jamming_indicator | f vel_m_s vel_n_m_s vel_e_m_s vel_d_m_s cog_rad | i timestamp_time_relative | f "
        "heading heading_offset heading_accuracy rtcm_injection_rate | H automatic_gain_control | B fix_type "
        "jamming_state spoofing_state | ? vel_ned_valid | B satellites_used selected_rtcm_instance | ? "
        "rtcm_crc_failed | B rtcm_msg_used"
    ),
    "airspeed": "Q timestamp timestamp_sample | f indicated_airspeed_m_s true_airspeed_m_s confidence",
    "airspeed_validated": (
        "Q timestamp | f indicated_airspeed_m_s calibrated_airspeed_m_s true_airspeed_m_s "
        "calibrated_ground_minus_wind_m_s true_ground_minus_wind_m_s airspeed_derivative_filtered "
        "throttle_filtered pitch_filtered | ? airspeed_sensor_measurement_valid | b selected_airspeed_index"
    ),
    "sensor_selection": "Q timestamp | I accel_device_id gyro_device_id",
    "vehicle_status": (
        "Q timestamp armed_time takeoff_time nav_state_timestamp | I valid_nav_states_mask "
        "can_set_nav_states_mask | H failure_detector_status | B arming_state latest_arming_reason "
        "latest_disarming_reason nav_state_user_intention nav_state executor_in_charge hil_state vehicle_type | ? "
        "failsafe failsafe_and_user_took_over | B failsafe_defer_state | ? gcs_connection_lost | B "
        "gcs_connection_lost_counter | ? high_latency_data_link_lost is_vtol is_vtol_tailsitter "
        "in_transition_mode in_transition_to_fw | B system_type system_id component_id | ? "
        "safety_button_available safety_off power_input_valid usb_connected open_drone_id_system_present "
        "open_drone_id_system_healthy parachute_system_present parachute_system_healthy "
        "rc_calibration_in_progress calibration_enabled pre_flight_checks_pass"
    ),
    "vehicle_land_detected": (
        "Q timestamp | ? freefall ground_contact maybe_landed landed in_ground_effect in_descend has_low_throttle "
        "vertical_movement horizontal_movement rotational_movement close_to_ground_or_skipped_check at_rest"
    ),
    "ekf2_timestamps": (
        "Q timestamp | h airspeed_timestamp_rel airspeed_validated_timestamp_rel distance_sensor_timestamp_rel "
        "optical_flow_timestamp_rel vehicle_air_data_timestamp_rel vehicle_magnetometer_timestamp_rel "
        "visual_odometry_timestamp_rel"
    ),
    "vehicle_attitude": "Q timestamp timestamp_sample | 4f q delta_q_reset | B quat_reset_counter",
    "vehicle_local_position": (
        "Q timestamp timestamp_sample ref_timestamp | d ref_lat ref_lon | f x y z | 2f delta_xy | f delta_z vx vy "
        "vz z_deriv | 2f delta_vxy | f delta_vz ax ay az heading heading_var unaided_heading delta_heading "
        "tilt_var ref_alt dist_bottom dist_bottom_var delta_dist_bottom eph epv evh evv vxy_max vz_max hagl_min "
        "hagl_max_z hagl_max_xy | ? xy_valid z_valid v_xy_valid v_z_valid | B xy_reset_counter z_reset_counter "
        "vxy_reset_counter vz_reset_counter heading_reset_counter | ? heading_good_for_control xy_global z_global "
        "dist_bottom_valid | B dist_bottom_reset_counter dist_bottom_sensor_bitfield | ? dead_reckoning"
    ),
    "vehicle_global_position": (
        "Q timestamp timestamp_sample | d lat lon | f alt alt_ellipsoid delta_alt delta_terrain eph epv "
        "terrain_alt | ? lat_lon_valid alt_valid | B lat_lon_reset_counter alt_reset_counter "
        "terrain_reset_counter | ? terrain_alt_valid dead_reckoning"
    ),
    "estimator_sensor_bias": (
        "Q timestamp timestamp_sample | I gyro_device_id | 3f gyro_bias | f gyro_bias_limit | 3f "
        "gyro_bias_variance | I accel_device_id | 3f accel_bias | f accel_bias_limit | 3f accel_bias_variance | I "
        "mag_device_id | 3f mag_bias | f mag_bias_limit | 3f mag_bias_variance | ? gyro_bias_valid "
        "gyro_bias_stable accel_bias_valid accel_bias_stable mag_bias_valid mag_bias_stable"
    ),
    "wind": (
        "Q timestamp timestamp_sample | f windspeed_north windspeed_east variance_north variance_east tas_innov "
        "tas_innov_var beta_innov beta_innov_var"
    ),
    "estimator_aid_source1d": (
        "Q timestamp timestamp_sample time_last_fuse | I device_id | f observation observation_variance "
        "innovation innovation_filtered innovation_variance test_ratio test_ratio_filtered | B estimator_instance "
        "| ? innovation_rejected fused"
    ),
    "estimator_aid_source2d": (
        "Q timestamp timestamp_sample time_last_fuse | 2d observation | I device_id | 2f observation_variance "
        "innovation innovation_filtered innovation_variance test_ratio test_ratio_filtered | B estimator_instance "
        "| ? innovation_rejected fused"
    ),
    "estimator_aid_source3d": (
        "Q timestamp timestamp_sample time_last_fuse | I device_id | 3f observation observation_variance "
        "innovation innovation_filtered innovation_variance test_ratio test_ratio_filtered | B estimator_instance "
        "| ? innovation_rejected fused"
    ),
}

V1_15: Mapping[str, str] = {
    **V1_16,
    "vehicle_imu": (
        "Q timestamp timestamp_sample | I accel_device_id gyro_device_id | 3f delta_angle delta_velocity | H "
        "delta_angle_dt delta_velocity_dt | B delta_angle_clipping delta_velocity_clipping "
        "accel_calibration_count gyro_calibration_count"
    ),
    "vehicle_air_data": (
        "Q timestamp timestamp_sample | I baro_device_id | f baro_alt_meter baro_temp_celcius baro_pressure_pa "
        "rho eas2tas | B calibration_count"
    ),
    "airspeed": (
        "Q timestamp timestamp_sample | f indicated_airspeed_m_s true_airspeed_m_s air_temperature_celsius confidence"
    ),
    "airspeed_validated": (
        "Q timestamp | f indicated_airspeed_m_s calibrated_airspeed_m_s true_airspeed_m_s "
        "calibrated_ground_minus_wind_m_s true_ground_minus_wind_m_s | ? airspeed_sensor_measurement_valid | b "
        "selected_airspeed_index"
    ),
    "vehicle_status": (
        "Q timestamp armed_time takeoff_time nav_state_timestamp | I valid_nav_states_mask "
        "can_set_nav_states_mask | H failure_detector_status | B arming_state latest_arming_reason "
        "latest_disarming_reason nav_state_user_intention nav_state executor_in_charge hil_state vehicle_type | ? "
        "failsafe failsafe_and_user_took_over | B failsafe_defer_state | ? gcs_connection_lost | B "
        "gcs_connection_lost_counter | ? high_latency_data_link_lost is_vtol is_vtol_tailsitter "
        "in_transition_mode in_transition_to_fw | B system_type system_id component_id | ? "
        "safety_button_available safety_off power_input_valid usb_connected open_drone_id_system_present "
        "open_drone_id_system_healthy parachute_system_present parachute_system_healthy avoidance_system_required "
        "avoidance_system_valid rc_calibration_in_progress calibration_enabled pre_flight_checks_pass"
    ),
    "ekf2_timestamps": (
        "Q timestamp | h airspeed_timestamp_rel distance_sensor_timestamp_rel optical_flow_timestamp_rel "
        "vehicle_air_data_timestamp_rel vehicle_magnetometer_timestamp_rel visual_odometry_timestamp_rel"
    ),
    "vehicle_local_position": (
        "Q timestamp timestamp_sample ref_timestamp | d ref_lat ref_lon | f x y z | 2f delta_xy | f delta_z vx vy "
        "vz z_deriv | 2f delta_vxy | f delta_vz ax ay az heading heading_var unaided_heading delta_heading "
        "tilt_var ref_alt dist_bottom eph epv evh evv vxy_max vz_max hagl_min hagl_max | ? xy_valid z_valid "
        "v_xy_valid v_z_valid | B xy_reset_counter z_reset_counter vxy_reset_counter vz_reset_counter "
        "heading_reset_counter | ? heading_good_for_control xy_global z_global dist_bottom_valid | B "
        "dist_bottom_sensor_bitfield | ? dead_reckoning"
    ),
    "vehicle_global_position": (
        "Q timestamp timestamp_sample | d lat lon | f alt alt_ellipsoid delta_alt eph epv terrain_alt | B "
        "lat_lon_reset_counter alt_reset_counter | ? terrain_alt_valid dead_reckoning"
    ),
    "estimator_aid_source1d": (
        "Q timestamp timestamp_sample time_last_fuse | I device_id | f observation observation_variance "
        "innovation innovation_variance test_ratio | B estimator_instance | ? innovation_rejected fused"
    ),
    "estimator_aid_source2d": (
        "Q timestamp timestamp_sample time_last_fuse | I device_id | 2f observation observation_variance "
        "innovation innovation_variance test_ratio | B estimator_instance | ? innovation_rejected fused"
    ),
    "estimator_aid_source3d": (
        "Q timestamp timestamp_sample time_last_fuse | I device_id | 3f observation observation_variance "
        "innovation innovation_variance test_ratio | B estimator_instance | ? innovation_rejected fused"
    ),
}

VERSIONS: Mapping[str, Mapping[str, str]] = {"1.16": V1_16, "1.15": V1_15}

# Topics that are named otherwise than their message.
MESSAGES = {
    "vehicle_gps_position": "sensor_gps",
    "vehicle_attitude_groundtruth": "vehicle_attitude",
    "vehicle_local_position_groundtruth": "vehicle_local_position",
    "vehicle_global_position_groundtruth": "vehicle_global_position",
    "estimator_attitude": "vehicle_attitude",
    "estimator_local_position": "vehicle_local_position",
    "estimator_global_position": "vehicle_global_position",
    "estimator_wind": "wind",
    "estimator_aid_src_gnss_pos": "estimator_aid_source2d",
    "estimator_aid_src_gnss_hgt": "estimator_aid_source1d",
    "estimator_aid_src_gnss_vel": "estimator_aid_source3d",
    "estimator_aid_src_baro_hgt": "estimator_aid_source1d",
    "estimator_aid_src_mag": "estimator_aid_source3d",
    "estimator_aid_src_airspeed": "estimator_aid_source1d",
}
