"""Datasheets of inertial units: what each grade presets of the keys of `testbed.sensors.imu.ImuConfig`."""

from __future__ import annotations

from typing import Any

# How the unit is mounted and warms up is the aircraft's doing, the same for every real grade: a small engine behind
# soft rubber (assumed).
INSTALLATION = {"vibration_mg": 30.0, "vibration_degps": 0.2, "self_heating_k": 5.0}

# Sources. Where a datasheet is silent or gives worst-case limits, the figure is typical of the class: "assumed".
GRADES: dict[str, dict[str, Any]] = {
    "perfect": {},
    # Honeywell HG9900 brochure N61-1638: gyro bias 0.0035 deg/h, ARW 0.002 deg/sqrt(h), scale 5 ppm; accelerometer bias
    # 25 ug, scale 100 ppm. Turn-on 0.01 deg/h defines the class (Groves 2013, table 4.1). Rest assumed.
    "navigation": {
        **INSTALLATION,
        "gyro_turn_on_degph": 0.01,
        "gyro_instability_degph": 0.0035,
        "gyro_instability_tau_s": 500.0,
        "angle_random_walk_degprth": 0.002,
        "gyro_rate_random_walk_degphprth": 0.0005,
        "gyro_scale_ppm": 5.0,
        "gyro_scale_asymmetry_ppm": 1.0,
        "gyro_misalignment_mrad": 0.02,
        "gyro_nonorthogonality_mrad": 0.01,
        "gyro_temperature_degphpk": 0.0002,
        "gyro_range_degps": 400.0,
        "gyro_resolution_degps": 1e-6,
        "gyro_bandwidth_hz": 300.0,
        "accel_turn_on_mg": 0.025,
        "accel_instability_mg": 0.005,
        "accel_instability_tau_s": 500.0,
        "velocity_random_walk_mpsprth": 0.005,
        "accel_random_walk_mgprth": 0.0005,
        "accel_scale_ppm": 100.0,
        "accel_scale_asymmetry_ppm": 10.0,
        "accel_misalignment_mrad": 0.02,
        "accel_nonorthogonality_mrad": 0.01,
        "accel_temperature_mgpk": 0.0005,
        "accel_range_g": 30.0,
        "accel_resolution_mg": 0.0005,
        "accel_bandwidth_hz": 300.0,
    },
    # Sensonor STIM300 datasheet TS1524: gyro in-run 0.5 deg/h, ARW 0.15 deg/sqrt(h), scale 500 ppm, 5 deg/h rms over
    # static temperature, g-sensitivity 1 deg/h/g (compensated), 400 deg/s; 10 g accelerometer in-run 0.05 mg,
    # VRW 0.06 m/s/sqrt(h), scale 300 ppm, on/off 0.75 mg, misalignment 1 mrad, filter up to 262 Hz, 24 bit. Rest
    # assumed.
    "tactical": {
        **INSTALLATION,
        "gyro_turn_on_degph": 5.0,
        "gyro_instability_degph": 0.5,
        "gyro_instability_tau_s": 200.0,
        "angle_random_walk_degprth": 0.15,
        "gyro_rate_random_walk_degphprth": 0.1,
        "gyro_scale_ppm": 500.0,
        "gyro_scale_asymmetry_ppm": 50.0,
        "gyro_misalignment_mrad": 1.0,
        "gyro_nonorthogonality_mrad": 0.2,
        "gyro_g_sensitivity_degphpg": 1.0,
        "gyro_temperature_degphpk": 0.1,
        "gyro_range_degps": 400.0,
        "gyro_resolution_degps": 6.1e-5,
        "gyro_bandwidth_hz": 262.0,
        "accel_turn_on_mg": 0.75,
        "accel_instability_mg": 0.05,
        "accel_instability_tau_s": 200.0,
        "velocity_random_walk_mpsprth": 0.06,
        "accel_random_walk_mgprth": 0.005,
        "accel_scale_ppm": 300.0,
        "accel_scale_asymmetry_ppm": 30.0,
        "accel_misalignment_mrad": 1.0,
        "accel_nonorthogonality_mrad": 0.2,
        "accel_temperature_mgpk": 0.01,
        "accel_range_g": 10.0,
        "accel_resolution_mg": 0.0019,
        "accel_bandwidth_hz": 262.0,
    },
    # Analog Devices ADIS16495-1 datasheet Rev. C: gyro in-run 0.8 deg/h, ARW 0.09 deg/sqrt(h), +-125 deg/s;
    # accelerometer in-run 3.2 ug, +-8 g; axis to axis 0.05 deg, axis to package 0.25 deg maximum (taken as three
    # sigma). Rest assumed, the turn-on after the bias correction at start-up that the part offers.
    "mems-industrial": {
        **INSTALLATION,
        "gyro_turn_on_degph": 15.0,
        "gyro_instability_degph": 0.8,
        "gyro_instability_tau_s": 200.0,
        "angle_random_walk_degprth": 0.09,
        "gyro_rate_random_walk_degphprth": 0.3,
        "gyro_scale_ppm": 800.0,
        "gyro_scale_asymmetry_ppm": 80.0,
        "gyro_misalignment_mrad": 1.5,
        "gyro_nonorthogonality_mrad": 0.87,
        "gyro_g_sensitivity_degphpg": 5.0,
        "gyro_temperature_degphpk": 0.3,
        "gyro_range_degps": 125.0,
        "gyro_resolution_degps": 1e-5,
        "gyro_bandwidth_hz": 300.0,
        "accel_turn_on_mg": 1.0,
        "accel_instability_mg": 0.0032,
        "accel_instability_tau_s": 200.0,
        "velocity_random_walk_mpsprth": 0.01,
        "accel_random_walk_mgprth": 0.001,
        "accel_scale_ppm": 500.0,
        "accel_scale_asymmetry_ppm": 50.0,
        "accel_misalignment_mrad": 1.5,
        "accel_nonorthogonality_mrad": 0.87,
        "accel_temperature_mgpk": 0.01,
        "accel_range_g": 8.0,
        "accel_resolution_mg": 0.0005,
        "accel_bandwidth_hz": 300.0,
    },
    # Turn-on 40 deg/h and 2 mg: the unit of Jiang et al. 2021 (attitude of a loitering vehicle without GNSS), after
    # calibration. Its noise is not given; 0.3 deg/sqrt(h) and 100 ug/sqrt(Hz) lie between the TDK ICM-42688-P datasheet
    # DS-000347 (2.8 mdps/sqrt(Hz) = 0.17 deg/sqrt(h), 70 ug/sqrt(Hz)) and the Bosch BMI088 (0.84 deg/sqrt(h),
    # 175 ug/sqrt(Hz)). 16 bit on +-500 deg/s and +-12 g. Rest assumed, for a calibrated part.
    "mems-consumer": {
        **INSTALLATION,
        "gyro_turn_on_degph": 40.0,
        "gyro_instability_degph": 5.0,
        "gyro_instability_tau_s": 200.0,
        "angle_random_walk_degprth": 0.3,
        "gyro_rate_random_walk_degphprth": 2.0,
        "gyro_scale_ppm": 1000.0,
        "gyro_scale_asymmetry_ppm": 200.0,
        "gyro_misalignment_mrad": 2.0,
        "gyro_nonorthogonality_mrad": 1.0,
        "gyro_g_sensitivity_degphpg": 10.0,
        "gyro_temperature_degphpk": 1.0,
        "gyro_range_degps": 500.0,
        "gyro_resolution_degps": 500 / 2**15,
        "gyro_bandwidth_hz": 116.0,
        "accel_turn_on_mg": 2.0,
        "accel_instability_mg": 0.03,
        "accel_instability_tau_s": 200.0,
        "velocity_random_walk_mpsprth": 0.06,
        "accel_random_walk_mgprth": 0.02,
        "accel_scale_ppm": 1000.0,
        "accel_scale_asymmetry_ppm": 200.0,
        "accel_misalignment_mrad": 2.0,
        "accel_nonorthogonality_mrad": 1.0,
        "accel_temperature_mgpk": 0.02,
        "accel_range_g": 12.0,
        "accel_resolution_mg": 12_000 / 2**15,
        "accel_bandwidth_hz": 145.0,
    },
    # As flown in hobby autopilots: a part of the kind of the InvenSense MPU-6000 (PS-MPU-6000A Rev. 3.4: 0.005
    # deg/s/sqrt(Hz), 400 ug/sqrt(Hz), zero offset +-20 deg/s and +-50 to 80 mg, scale +-3 %, cross axis +-2 %, 0.1
    # deg/s/g), its gyros zeroed at power-up and otherwise not calibrated, on a vibrating airframe. Measured on recorded
    # flights of such: 430 to 4300 deg/h of gyro bias, scale and alignment of 1 % and 1 deg. At rest white noise is the
    # data sheet's (0.24 to 0.29 deg/sqrt(h), 0.11 m/s/sqrt(h)); in flight vibration makes ten times that of it, and
    # what an unfiltered sampling folds down has lines of 0.15 m/s^2 and up to 3 deg/s and leaves 0.2 to 0.4 m/s^2
    # per axis between 8 and 25 Hz, as 100 mg and the noise do here. Where they fly briskly, 1 % of the rate and of the
    # force less gravity goes wrong each second; what vibrates more than usual shows it in its increments. Steps between
    # stamps deviate by 0.7 to 1.9 ms. Rectification of the accelerometers: Analog Devices ADXL355 data sheet, 0.4 g at
    # 2.5 g rms; of the gyros, and losses: assumed.
    "mems-hobby": {
        **INSTALLATION,
        "output": "sampled",
        "jitter_s": 0.002,
        "dropout_percent": 0.5,
        "vibration_mg": 100.0,
        "vibration_degps": 2.0,
        "gyro_vibration_degprth": 1.98,
        "accel_vibration_mpsprth": 2.99,
        "gyro_rectification_degphpg2": 100.0,
        "accel_rectification_mgpg2": 64.0,
        "gyro_motion_percent": 1.0,
        "accel_motion_percent": 1.0,
        "vibration_percent": 50.0,
        "gyro_turn_on_degph": 2000.0,
        "gyro_instability_degph": 30.0,
        "gyro_instability_tau_s": 200.0,
        "angle_random_walk_degprth": 0.3,
        "gyro_rate_random_walk_degphprth": 20.0,
        "gyro_scale_ppm": 10_000.0,
        "gyro_scale_asymmetry_ppm": 1000.0,
        "gyro_misalignment_mrad": 17.0,
        "gyro_nonorthogonality_mrad": 5.0,
        "gyro_g_sensitivity_degphpg": 300.0,
        "gyro_temperature_degphpk": 20.0,
        "gyro_range_degps": 500.0,
        "gyro_resolution_degps": 500 / 2**15,
        "gyro_bandwidth_hz": 42.0,
        "accel_turn_on_mg": 50.0,
        "accel_instability_mg": 1.0,
        "accel_instability_tau_s": 200.0,
        "velocity_random_walk_mpsprth": 0.24,
        "accel_random_walk_mgprth": 5.0,
        "accel_scale_ppm": 10_000.0,
        "accel_scale_asymmetry_ppm": 1000.0,
        "accel_misalignment_mrad": 17.0,
        "accel_nonorthogonality_mrad": 5.0,
        "accel_temperature_mgpk": 0.5,
        "accel_range_g": 8.0,
        "accel_resolution_mg": 8000 / 2**15,
        "accel_bandwidth_hz": 44.0,
    },
}
