"""The U flight of Jiang et al. 2021 for the attitude filter's tests: exact motion, sensors of 40 deg/h and 2 mg, gusts.

50 m/s level, straight for 200 s, half a turn at 3 deg/s, straight back; or one unnoticed slow turn instead. Gusts are
true accelerations of the body that no sensor but the accelerometer knows of.
"""

import dataclasses
import functools
import math

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from nav.ahrs import Ahrs, AhrsConfig
from nav.error_model import ImuModel
from nav.horizon import FusionHorizon
from nav.motion import LowDynamics
from nav.samples import AirspeedSample, ImuSamples
from testbed.motion.table import increments

DEG = math.pi / 180
DEGPH = DEG / 3600
MG = 9.80665e-3
RATE_HZ, DT = 200, 1 / 200
SPEED = 50.0
DURATION_S = 600.0
TURN = (200.0, 260.0)  # [s]
LAT, H = 34.0 * DEG, 500.0
GUST_S = 0.5
SEEDS = range(4)

PAPER = AhrsConfig(
    # per second of filter step, as the paper gives its Q
    imu=ImuModel(
        gyro_noise=40 * DEGPH,
        accel_noise=0.0,
        gyro_bias_sigma=200 * DEGPH,
        accel_bias_sigma=2 * MG,
        gyro_bias_walk=5 * DEGPH,
    ),
    lat=LAT,
    h=H,
    compensated_motion=LowDynamics(),
)
NOISELESS = ImuModel(gyro_noise=1e-7, accel_noise=0.0, gyro_bias_sigma=1e-6, accel_bias_sigma=0.0)


@dataclasses.dataclass(frozen=True)
class Truth:
    t: np.ndarray
    q_nb: np.ndarray
    dtheta: np.ndarray
    dv: np.ndarray


@functools.lru_cache(maxsize=8)
def level_flight(turn_degps=3.0, turn=TURN, duration_s=DURATION_S, speed=SPEED):
    """Level flight at constant speed with one turn, rolled into and out of in a few seconds, coordinated throughout."""
    t = np.arange(int(duration_s * RATE_HZ) + 1) / RATE_HZ
    edge = 1.0  # [s]
    shape = 0.5 * (np.tanh((t - turn[0]) / edge) - np.tanh((t - turn[1]) / edge))
    course_rate = turn_degps * DEG * shape
    course = 0.3 + np.concatenate([[0.0], np.cumsum(0.5 * (course_rate[1:] + course_rate[:-1])) * DT])
    v_n = np.column_stack([speed * np.cos(course), speed * np.sin(course), np.zeros_like(t)])
    R = 6.37e6
    travelled = np.vstack([np.zeros(3), np.cumsum(0.5 * (v_n[1:] + v_n[:-1]), axis=0) * DT])
    lat = LAT + travelled[:, 0] / R
    lon = 1.0 + travelled[:, 1] / (R * math.cos(LAT))
    roll = np.arctan(speed * course_rate / 9.8)
    q_nb = Rotation.from_euler("ZYX", np.column_stack([course, np.full_like(t, 0.03), roll])).as_quat(scalar_first=True)
    return Truth(t, q_nb, *increments(t, lat, lon, np.full_like(t, H), v_n, q_nb))


def imu(truth, seed, gyro_bias=40 * DEGPH, accel_bias=2 * MG, gust=0.15):
    """Increments with biases of either sign on the level axes, plus on the vertical gyro, white noise and gusts."""
    rng = np.random.default_rng(seed)
    n = len(truth.t) - 1
    sign = rng.choice([-1.0, 1.0], (2, 3))
    sign[0, 2] = 1.0
    decay = math.exp(-DT / GUST_S)
    gusts = lfilter([math.sqrt(1 - decay**2)], [1, -decay], rng.normal(size=(n, 3)), axis=0) * gust
    noisy = 1.0 if gust else 0.0
    gyro_noise, accel_noise = noisy * 0.3 * DEG / 60, noisy * 1e-3
    return ImuSamples(
        truth.t[1:],
        np.full(n, DT),
        truth.dtheta[1:] + sign[0] * gyro_bias * DT + gyro_noise * math.sqrt(DT) * rng.normal(size=(n, 3)),
        truth.dv[1:] + (sign[1] * accel_bias + gusts) * DT + accel_noise * math.sqrt(DT) * rng.normal(size=(n, 3)),
    )


def airspeed(duration_s=DURATION_S, rate_hz=5.0, speed=SPEED):
    from nav.earth import isa_density

    eas = speed * math.sqrt(isa_density(H) / 1.225)
    return [AirspeedSample(t, t, eas) for t in np.arange(0, duration_s, 1 / rate_hz).tolist()]


def tilted(q_nb, tilt_deg, heading_deg=0.0):
    """The attitude with a tilt error about north and east of ``tilt_deg`` each in size 1/sqrt(2)."""
    level = tilt_deg * DEG / math.sqrt(2)
    wrong = Rotation.from_rotvec([level, -level, heading_deg * DEG]) * Rotation.from_quat(q_nb, scalar_first=True)
    return wrong.as_quat(scalar_first=True)


def run(config, truth, increments_, samples=(), tilt_deg=0.5, every_s=1.0, ahrs=None, **kw):
    """Fly: errors [roll, pitch, heading] (N, 3) [deg] at ``t`` (N,), all estimates, all reports."""
    ahrs = ahrs or Ahrs(config, **kw)
    ahrs.start(0.0, tilted(truth.q_nb[0], tilt_deg))
    times = np.arange(every_s, truth.t[-1] + 1e-9, every_s).tolist()
    reports, estimates = FusionHorizon(ahrs).track(increments_, samples, times)
    rows = np.round(np.array(times) / DT).astype(int)
    return np.array(times), errors(np.array([e.q_nb for e in estimates]), truth.q_nb[rows]), estimates, reports


def errors(q_nb, q_true):
    ours = Rotation.from_quat(q_nb, scalar_first=True).as_euler("ZYX")
    theirs = Rotation.from_quat(q_true, scalar_first=True).as_euler("ZYX")
    return np.degrees((ours - theirs + math.pi) % (2 * math.pi) - math.pi)[:, ::-1]


def fly(config, tilt_deg=0.5, turn_degps=3.0, turn=TURN, samples=()):
    truth = level_flight(turn_degps, turn)
    return [run(config, truth, imu(truth, seed), samples, tilt_deg) for seed in SEEDS]


def level_figures(runs):
    """Largest level error after 60 s and RMS of the worse axis [deg], each the mean over the seeds."""
    late = [error[t > 60, :2] for t, error, _, _ in runs]
    return np.mean([np.abs(e).max() for e in late]), np.mean(
        [np.sqrt(np.mean(np.square(e), axis=0)).max() for e in late]
    )
