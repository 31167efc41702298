"""What is in a log, measured: rates, gaps, phases of the flight, noise at rest, vibration, latencies, calibrations."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from nav.earth import SEA_LEVEL_DENSITY, gravity, isa_density, position_difference_n
from nav.samples import AirspeedSample, Array, GnssSample, ImuSamples, MagnetometerSample
from testbed.errors import UserError
from testbed.feeds.lateness import LEAST_FIXES, Late, fixes, late_by_imu, velocity_lag
from testbed.feeds.log import Log
from testbed.feeds.rest import REST_SPEED, WINDOW_S, is_still
from testbed.feeds.stamps import GAP_PERIODS, GAP_S
from testbed.sensors import SensorConfig

MOVING = ("moving", "flying")  # the phases in which it does
ABOUT_S = 20.0  # over which positions tell a speed
FLYING_SPEED, FLYING_HEIGHT = 6.0, 8.0  # of GNSS [m/s, m]
LEAST_REST_S = 20.0  # to say anything of noise
TOGETHER = 10  # steps
ROUNDING_S = 1e-9  # of times that are numbers
SLOWEST_IMU_S = 2.0  # between its samples: more is another unit of time
LEAST_LINE = 6.0  # times the median of the spectrum about it
ERRORS = 20  # of a magnetometer in a flight that are independent: each lasts
LEAST_SPREAD = 0.05  # of a field about its mean, over its median size, in the direction of the least
ACROSS = 0.1  # share of the flight across its main direction, to tell wind from scale
SCALES = 0.6, 1.6  # of an airspeed in the right unit
SCALE_SIGMA, WORST_CONDITION = 0.05, 1e6  # of an airspeed scale that is worth saying
LEAST_AIR = 10.0  # an airspeed says something of its scale from here on [m/s]


@dataclass(frozen=True, slots=True)
class Rate:
    """How a sensor reports: count, samples per second, deviation of their steps [s], gaps and the longest [s]."""

    count: int
    rate_hz: float
    jitter_s: float
    gaps: int
    longest_s: float


@dataclass(frozen=True, slots=True)
class Phase:
    """A stretch of the flight: ``rest``, ``moving``, ``flying`` or ``silent``, from the log's beginning [s].

    In the last the inertial unit is not heard, and no receiver says that it flies.
    """

    name: str
    start: float
    end: float


@dataclass(frozen=True, slots=True)
class Noise:
    """Of one inertial unit at rest for ``seconds``: gyros in rad/s, accelerometers in m/s^2, the worst axis.

    ``*_walk`` is the Allan deviation at one second, which is what white noise leaves there per root second, and
    ``*_floor`` its least, of averages over ``*_floor_s``; ``gyro_bias`` (3,) the mean; ``force_error`` the size of the
    mean specific force less gravity.
    """

    seconds: float
    gyro_walk: float
    gyro_floor: float
    gyro_floor_s: float
    accel_walk: float
    accel_floor: float
    accel_floor_s: float
    gyro_bias: Array
    force_error: float


@dataclass(frozen=True, slots=True)
class Vibration:
    """Of the specific force while it moves: rms above 5 Hz [m/s^2], and the lines (frequency [Hz], amplitude)."""

    rms: float
    lines: Sequence[tuple[float, float]]


class Sphere(NamedTuple):
    """The sphere that fits magnetic fields in body axes best [T]: their rms distance from it, and its radius.

    Its centre is ``off`` the origin, by hard iron, known to ``off_sigma``.
    """

    residual: float
    radius: float
    off: float
    off_sigma: float


@dataclass(frozen=True, slots=True)
class Survey:
    """All that was found; what could not be is None or missing."""

    log: Log
    rates: Mapping[str, Rate]
    phases: Sequence[Phase]
    noise: Mapping[str, Noise]
    vibration: Mapping[str, Vibration]
    latency: Mapping[str, Late]  # of velocities
    velocity_lag_s: Mapping[str, float]  # by which these are older than the positions beside them
    spheres: Mapping[str, Sphere]
    airspeed_scale: Mapping[str, float]  # true airspeed over what the sensor says


def survey(log: Log, sections: Mapping[str, SensorConfig] | None = None) -> Survey:
    """Measure what is in a log, with what the ``sections`` of a scenario tell of its sensors, where there is one.

    Sensors of which no sample can be used are left out, with a note.
    """
    streams: dict[str, Any] = {**log.imus, **log.samples}
    mute = [f"{name}: none of its samples can be used: it is left out" for name, own in streams.items() if not len(own)]
    imus = {name: imu for name, imu in log.imus.items() if len(imu)}
    samples = {name: own for name, own in log.samples.items() if len(own)}
    log = replace(log, imus=imus, samples=samples, notes=[*log.notes, *mute])
    found = phases(log)
    resting = max((p for p in found if p.name == "rest"), key=lambda p: p.end - p.start, default=None)
    moving = [p for p in found if p.name in MOVING]
    noise = {name: still for name, imu in log.imus.items() if (still := _noise(log, imu, resting)) is not None}
    vibration = {name: felt for name, imu in log.imus.items() if (felt := _vibration(log, imu, moving)) is not None}
    times = {name: imu.t for name, imu in log.imus.items()}
    times |= {name: np.array([one.t for one in own]) for name, own in log.samples.items()}
    late, behind, spheres, scales = {}, {}, {}, {}
    for name, own in log.samples.items():
        if isinstance(own[0], GnssSample):
            if (found_late := late_by_imu(log, name, _as_told(log, own), sections or {})) is not None:
                late[name] = found_late
            if (lag := velocity_lag(own)) is not None:
                behind[name] = lag
        elif isinstance(own[0], MagnetometerSample):
            field = np.array([one.field_b for one in own if isinstance(one, MagnetometerSample)])
            if (sphere := _sphere(field)) is not None:
                spheres[name] = sphere
        elif isinstance(own[0], AirspeedSample) and (scale := airspeed_scale(*in_the_air(log, own, found))):
            scales[name] = scale
    rates = {name: _rate(t) for name, t in times.items()}
    return Survey(log, rates, found, noise, vibration, late, behind, spheres, scales)


def _as_told(log: Log, own: Sequence[Any]) -> Sequence[Any]:
    """The samples of a sensor at the times when they were told."""
    return [replace(one, t=one.t_arrival) for one in own] if log.valid_times else own


def usual_step(t: Array) -> float:
    """The usual time from one of ascending times (N,) to the next, N > 1: the median of the mean of `TOGETHER` steps.

    One step alone says nothing of that where stamps are rounded, or come in pairs.
    """
    n = min(TOGETHER, len(t) - 1)
    return float(np.median(t[n:] - t[:-n])) / n


def _rate(t: Array) -> Rate:
    steps = np.diff(t)
    if not len(steps):
        return Rate(len(t), math.nan, math.nan, 0, 0.0)
    usual = usual_step(t)
    ordinary = steps[steps <= max(GAP_PERIODS * usual, GAP_S)]
    jitter = float(np.std(ordinary)) if len(ordinary) else math.nan
    jitter = 0.0 if jitter < ROUNDING_S else jitter
    return Rate(len(t), 1 / usual, jitter, len(steps) - len(ordinary), float(steps.max()))


def phases(log: Log) -> list[Phase]:
    """Rest by the inertial unit, flight by GNSS speed or height. Raises UserError where its times can't be seconds."""
    imu = log.imus[log.unit]
    if len(imu) > 1 and (step := usual_step(imu.t)) > SLOWEST_IMU_S:
        told = f"its IMU reports every {step:.3g} s, for {imu.t[-1] - imu.t[0]:.3g} s"
        raise UserError(f'{log.path}: {told}: give truth.columns.<sensor>.time a unit, such as "ms" or "us"')
    count = max(int((imu.t[-1] - log.t0) / WINDOW_S), 1)
    edges = log.t0 + WINDOW_S * np.arange(count + 1)
    rows = np.searchsorted(imu.t, edges)
    resting = is_still(imu, edges)
    names = []
    receiver = log.receiver
    t, v_n, place = fixes(log.samples[receiver]) if receiver else (np.empty(0), np.empty((0, 3)), np.empty((0, 3)))
    speed = np.hypot(v_n[:, 0], v_n[:, 1])
    speed = np.where(np.isfinite(speed), speed, _speed_by_places(t, place))
    for k in range(count):
        still = bool(resting[k])
        near = slice(*np.searchsorted(t, edges[k : k + 2]))
        slowest, fast = _speeds(speed, near)
        high = float(np.max(place[near, 2] - np.median(place[:5, 2]), initial=0.0)) if len(place) else 0.0
        if slowest > FLYING_SPEED or (high > FLYING_HEIGHT and not still):
            names.append("flying")
        elif rows[k + 1] == rows[k]:
            names.append("silent")
        else:
            names.append("rest" if still and fast < REST_SPEED else "moving")
    changes = [0, *[k for k in range(1, count) if names[k] != names[k - 1]], count]
    return [Phase(names[a], a * WINDOW_S, b * WINDOW_S) for a, b in itertools.pairwise(changes)]


def _speed_by_places(t: Array, place: Array) -> Array:
    """How fast a receiver without velocities went about each of its fixes (N,), over `ABOUT_S` [m/s]."""
    if len(t) < 2:
        return np.zeros(len(t))
    k = np.arange(len(t))
    first = np.minimum(np.searchsorted(t, t - ABOUT_S / 2), np.maximum(k - 1, 0))
    last = np.maximum(np.searchsorted(t, t + ABOUT_S / 2, side="right") - 1, np.minimum(k + 1, len(t) - 1))
    way = position_difference_n(*place[last].T, *place[first].T)
    speed: Array = np.hypot(way[:, 0], way[:, 1]) / np.maximum(t[last] - t[first], ROUNDING_S)
    return speed


def _speeds(speed: Array, near: slice) -> tuple[float, float]:
    """The least and the largest speed [m/s] in a window, of the fixes ``near``; without any, of those before and after.

    A vehicle that has lost its receiver may fly on as steadily as one that is at rest.
    """
    if near.stop > near.start:
        fast = float(np.nanmax(speed[near], initial=0.0))
        return fast, fast
    about = np.nan_to_num(speed[max(near.start - 1, 0) : near.start + 1])
    return float(np.min(about, initial=math.inf)) if len(about) else 0.0, float(np.max(about, initial=0.0))


def between(log: Log, imu: ImuSamples, phase: Phase) -> slice:
    """The rows of an inertial unit in a phase."""
    first, last = np.searchsorted(imu.t, [log.t0 + phase.start, log.t0 + phase.end])
    return slice(int(first), int(last))


def allan(rates: Array, dt: float) -> tuple[Array, Array]:
    """Averaging times (M,) [s] and the overlapping Allan deviation (M, k) of rates (N, k) every ``dt`` [s]."""
    angle = np.vstack([np.zeros((1, rates.shape[1])), np.cumsum(rates, axis=0)]) * dt
    most = max(len(rates) // 4, 1)
    counts = np.unique(np.geomspace(1, most, 40).astype(int))
    rows = []
    for m in counts:
        second = angle[2 * m :] - 2 * angle[m:-m] + angle[: -2 * m]
        rows.append(np.sqrt(np.mean(second**2, axis=0) / (2 * (m * dt) ** 2)))
    return counts * dt, np.array(rows)


def _noise(log: Log, imu: ImuSamples, resting: Phase | None) -> Noise | None:
    if resting is None or resting.end - resting.start < LEAST_REST_S:
        return None
    part = between(log, imu, resting)
    t = imu.t[part]
    if not len(t) or t[-1] - t[0] < LEAST_REST_S:  # another unit was heard then
        return None
    dt = usual_step(t)
    gyro, force = imu.dtheta[part] / imu.dt[part, None], imu.dv[part] / imu.dt[part, None]
    found: list[tuple[float, float, float]] = []
    for values in (gyro, force):
        tau, deviation = allan(values - values.mean(axis=0), dt)
        worst = deviation.max(axis=1)
        lowest = int(np.argmin(worst))
        found.append((float(np.interp(1.0, tau, worst)), float(worst[lowest]), float(tau[lowest])))
    receiver = log.receiver
    lat, h = (0.8, 0.0) if receiver is None else fixes(log.samples[receiver])[2][0, [0, 2]]
    off = float(np.linalg.norm(force.mean(axis=0)) - gravity(float(lat), float(h)))
    return Noise(resting.end - resting.start, *found[0], *found[1], gyro.mean(axis=0), off)


def _vibration(log: Log, imu: ImuSamples, moving: Sequence[Phase]) -> Vibration | None:
    longest = max(moving, key=lambda p: p.end - p.start, default=None)
    if longest is None or longest.end - longest.start < LEAST_REST_S:
        return None
    from scipy import signal  # takes long to load, and a run has no need of it; the same of the one below

    part = between(log, imu, longest)
    force = imu.dv[part] / imu.dt[part, None]
    force = force[np.isfinite(force).all(axis=1)]  # of increments that a table lacks nothing is known
    if len(force) < 2:
        return None
    rate_hz = 1 / usual_step(imu.t[part])
    frequency, density = signal.welch(force, rate_hz, nperseg=min(1024, len(force)), axis=0)
    total = density.sum(axis=1)
    fast = frequency >= 5.0
    if not fast.any():
        return None
    step = float(frequency[1])
    floor = signal.medfilt(total, min(len(total) - 1 + len(total) % 2, 41))
    peaks, _ = signal.find_peaks(np.where(fast & (total > LEAST_LINE * floor), total, 0.0))
    strongest = sorted(peaks, key=lambda k: -total[k])[:3]
    lines = [(float(frequency[k]), math.sqrt(2 * 1.5 * step * float(total[k]))) for k in strongest]
    return Vibration(math.sqrt(float(total[fast].sum()) * step), lines)


def _sphere(field: Array) -> Sphere | None:
    """The sphere that fits magnetic fields (N, 3) [T]; None where the vehicle did not turn enough to tell."""
    known = field[np.isfinite(field).all(axis=1)]
    if len(known) < LEAST_FIXES:
        return None
    scale = float(np.abs(known).max()) or 1.0
    x = known / scale
    A = np.column_stack([2 * x, np.ones(len(x))])
    solved, *_ = np.linalg.lstsq(A, np.sum(x * x, axis=1), rcond=None)
    radius = math.sqrt(max(float(solved[3] + solved[:3] @ solved[:3]), 0.0))
    apart = np.linalg.norm(x - solved[:3], axis=1) - radius
    spread = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)[-1] / math.sqrt(len(x))
    size = float(np.median(np.linalg.norm(x, axis=1)))  # not the radius: to noise alone a tiny sphere fits
    if spread <= LEAST_SPREAD * size:
        return None
    residual = float(np.sqrt(np.mean(apart**2)))
    # Of |x - c|^2 = r^2 an error of x makes 2 r times as much.
    doubt = 2 * radius * residual * math.sqrt(np.trace(np.linalg.inv(A.T @ A)[:3, :3]) * len(x) / ERRORS)
    off = float(np.linalg.norm(solved[:3]))
    return Sphere(scale * residual, scale * radius, scale * off, scale * doubt)


def in_the_air(log: Log, own: Sequence[Any], flight: Sequence[Phase]) -> tuple[Array, Array]:
    """GNSS velocities (N, 3) while it flies, and the true airspeeds (N,) that a sensor tells at these times."""
    receiver = log.receiver
    if receiver is None:
        return np.empty((0, 3)), np.empty(0)
    t, v_n, place = fixes(log.samples[receiver])
    told = np.interp(t, [one.t for one in own], [one.eas for one in own], left=np.nan, right=np.nan)
    told = told * np.sqrt(SEA_LEVEL_DENSITY / isa_density(place[:, 2]))
    flying = [(t >= log.t0 + one.start) & (t < log.t0 + one.end) for one in flight if one.name == "flying"]
    moves = np.hypot(v_n[:, 0], v_n[:, 1]) > REST_SPEED  # heights alone may drift, of one whose propeller turns
    flown = np.any(flying, axis=0) & moves & (told > 0) & np.isfinite(v_n).all(axis=1)
    return v_n[flown], told[flown]


def about(v_n: Array, air: Array) -> float:
    """Speed over ground of velocities (N, 3) over airspeed (N,), medians: what wind leaves of a scale; 1 of none."""
    return float(np.median(np.linalg.norm(v_n, axis=1)) / np.median(air)) if len(air) else 1.0


def airspeed_scale(v_n: Array, air: Array) -> float | None:
    """True airspeed over the sensor's, of the wind and scale that fit what was heard `in_the_air` best."""
    rough = about(v_n, air)
    usual = 1.0 if SCALES[0] <= rough <= SCALES[1] else rough  # beyond these it is another unit
    fast = usual * air > LEAST_AIR
    v, air = v_n[fast], usual * air[fast]
    if len(air) < LEAST_FIXES:
        return None
    courses = v[:, :2] / np.hypot(v[:, 0], v[:, 1])[:, None]
    if np.linalg.eigvalsh(courses.T @ courses / len(courses))[0] < ACROSS:
        return None  # there and back alone: the wind across can't be told from the scale

    def misfit(x: Array) -> Array:
        return np.asarray(np.sqrt((v[:, 0] - x[0]) ** 2 + (v[:, 1] - x[1]) ** 2 + v[:, 2] ** 2) - x[2] * air)

    from scipy.optimize import least_squares

    found = least_squares(misfit, [0.0, 0.0, 1.0], loss="soft_l1")
    jacobian = np.asarray(found.jac)
    information = jacobian.T @ jacobian
    variance = 2 * found.cost / len(air) * np.linalg.pinv(information)[2, 2]
    sure = found.success and variance < SCALE_SIGMA**2 and np.linalg.cond(information) < WORST_CONDITION
    return usual * float(found.x[2]) if sure else None
