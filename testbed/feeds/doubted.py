"""What whoever is judged by an autopilot's solution, or by a reference, should know: where sensors say otherwise."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from nav._jit import njit
from nav.rotation import quat_rotate_components
from nav.samples import Array, GnssSample, ImuSamples
from testbed.feeds.lateness import fixes
from testbed.feeds.log import TABLE, Log, Reference, Samples
from testbed.feeds.mistaken import gone_otherwise
from testbed.feeds.reference import LONGEST_STEP_S, ReferenceMotion, doubt, elsewhere_in_height, silence
from testbed.feeds.rest import tilted
from testbed.feeds.turning import turns_otherwise
from testbed.sensors import SensorConfig
from testbed.sensors.imu import ImuConfig

STRETCH_S, STEP_S = 20.0, 1.0  # over which changes of velocity are compared, and of which length they are
KNOWN_SHARE = 0.95  # of a stretch, in which increments and attitude are known
LEAST_CHANGE = 1.0  # horizontal, rms [m/s]
LEAST_LIKENESS = 0.8  # of both, once one of them is turned: correlation
MOST_TURNED = math.radians(30)  # sound solutions seem to be up to 25 deg off: receivers are late, and slow


def remark(solution: Reference | None, imus: Mapping[str, ImuSamples], samples: Mapping[str, Samples]) -> str:
    """What there is to say, nothing where receiver and accelerometers agree with a solution."""
    if solution is None:
        return ""
    elsewhere = doubt(solution, samples)
    if not elsewhere and (off := elsewhere_in_height(solution, samples)):
        elsewhere = f'{off}: truth.reference = "gnss" judges by the receiver'
    return "; ".join(one for one in (elsewhere, turned(solution, imus, samples)) if one)


def contradicted(
    reference: Reference | None, imus: Mapping[str, ImuSamples], samples: Mapping[str, Samples]
) -> str:  # fmt: skip
    """What speaks against the reference of a table.

    It is judged by all the same, unlike an autopilot's own: the user named it, and it may be the truth, and what is
    said of the axes of the inertial unit or of the receiver's clock wrong.
    """
    if reference is None:
        return ""
    said = [doubt(reference, samples)]
    if said[0]:
        said.append("are columns, units and times of both as truth.columns says?")
    if apart := elsewhere_in_height(reference, samples):
        said.append(f"{apart}: is one of heights above the sea?")
    name, main = next((name, imu) for name, imu in imus.items() if len(imu))
    if not said[0] and (apart := silence(reference, float(main.t[0]), float(main.t[-1]))):
        said.append(f"{apart} of {name}")
    if lies := tilted(reference, imus, samples):
        said.append(f"{lies}: unit, order or frame of its attitude, or axes of accel, are not as truth.columns says")
    elif turns := turns_otherwise(reference, imus):
        said.append(f"{turns}: unit, order or frame of its attitude, or axes of gyro, are not as truth.columns says")
    own = reference.columns
    if {"lat", "lon", "h", "v_n"} <= own.keys():
        place = np.column_stack([own[axis] for axis in ("lat", "lon", "h")])
        ways = gone_otherwise(reference.t, own["v_n"], place)
        said += [f"{reference.name}: {way}: are units, columns and axes right?" for way in ways]
    return "; ".join(one for one in said if one)


def mounted(log: Log, sections: Mapping[str, SensorConfig]) -> Log:
    """A log in body axes, of units that ``sections`` say are mounted otherwise, with what speaks against it then."""
    imus = dict(log.imus)
    for name, imu in log.imus.items():
        section = sections.get(name)
        if isinstance(section, ImuConfig) and any(section.mounting_deg):
            C_sb = section.errors().C_sb
            imus[name] = replace(imu, dtheta=imu.dtheta @ C_sb, dv=imu.dv @ C_sb)
    if all(imus[name] is imu for name, imu in log.imus.items()):
        return log
    against = contradicted if log.format == TABLE else remark
    return replace(log, imus=imus, remark=against(log.solution, imus, log.samples))


def turned(solution: Reference, imus: Mapping[str, ImuSamples], samples: Mapping[str, Samples]) -> str:
    """That a solution's heading is off for a while; empty where it is not, or nothing tells.

    How velocity changes in the horizontal a receiver tells, and so do accelerometers, turned by the solution's
    attitude: the angle between both is the heading's error, wherever the vehicle points and the wind blows from.
    """
    if "q_nb" not in solution.columns:
        return ""
    imu = next(imu for imu in imus.values() if len(imu))
    for name, own in samples.items():
        if any(isinstance(one, GnssSample) and one.has_fix for one in own):
            t, v_n, _ = fixes(own)
            off = max(_turns(solution, imu, t, v_n[:, :2]), key=abs, default=0.0)
            if abs(off) <= MOST_TURNED:
                return ""
            how = f"by how {name} and the accelerometers tell the same turns"
            degrees = math.degrees(abs(off))
            return f"the heading of {solution.name} is {degrees:.0f} deg off at times, {how}: judge no attitude by it"
    return ""


def _turns(solution: Reference, imu: ImuSamples, t: Array, v: Array) -> Iterator[float]:
    """The heading's error [rad] in each stretch that tells, of horizontal velocities ``v`` (N, 2) at ``t`` (N,)."""
    attitude = Reference(solution.name, solution.t, {"q_nb": solution.columns["q_nb"]})
    sums = _gained(ReferenceMotion(attitude, 1.0, 0).at(imu.t).q_nb, imu.dv, imu.dt)
    at = np.concatenate([imu.t[:1] - imu.dt[:1], imu.t])
    for start in t[0] + STRETCH_S * np.unique(np.floor((t - t[0]) / STRETCH_S)):  # there may be days between two
        times = np.arange(start, start + STRETCH_S + STEP_S / 2, STEP_S)
        heard = t[(t >= times[0] - LONGEST_STEP_S) & (t <= times[-1] + LONGEST_STEP_S)]
        north, east, known = (np.interp(times, at, column) for column in sums.T)
        if known[-1] - known[0] < KNOWN_SHARE * STRETCH_S or np.diff(heard).max(initial=0.0) > LONGEST_STEP_S:
            continue
        felt = np.diff(north + 1j * east)
        told = np.diff(np.interp(times, t, v[:, 0]) + 1j * np.interp(times, t, v[:, 1]))
        both = complex(np.vdot(felt, told))
        sizes = float(np.linalg.norm(felt)), float(np.linalg.norm(told))
        if sizes[1] >= LEAST_CHANGE * math.sqrt(len(told)) and abs(both) >= LEAST_LIKENESS * sizes[0] * sizes[1]:
            yield math.atan2(both.imag, both.real)


@njit
def _gained(q_nb: Array, dv: Array, dt: Array) -> Array:
    """Velocity gained north and east [m/s], and over which time it is known [s], up to each increment (N + 1, 3)."""
    total = np.zeros((len(dv) + 1, 3))
    for k in range(len(dv)):
        north, east, _ = quat_rotate_components(q_nb[k], dv[k])
        known = math.isfinite(north + east)
        total[k + 1, 0] = total[k, 0] + (north if known else 0.0)
        total[k + 1, 1] = total[k, 1] + (east if known else 0.0)
        total[k + 1, 2] = total[k, 2] + (dt[k] if known else 0.0)
    return total
