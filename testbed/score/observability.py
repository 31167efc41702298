"""Which states of each estimator can be seen, and when, along the way that a recorded run took.

The filters are built from the run's scenario as they were for it. Truth gives the motion; the record says which
measurements each of them used (`UpdateReport`): what was not used, in an outage, out of a transponder's range, or as
its sensor was faulty or isolated, shows nothing here either. See `nav.observability.visibility`, whose prior is the
estimator's own 1-sigma once aligned. Nobody knows what samples a sensor of the user's would give here: what those show
of the states is left out.

A federated filter is judged as one filter with the common states and the aids of all its locals: by what can be seen
at all. What one local filter sees of its own is less.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from nav.ahrs import LEVEL, MAGNETIC_HEADING, STATES, Ahrs, transition
from nav.aids import (
    Aid,
    AirspeedAid,
    BarometerAid,
    BodyVelocityAid,
    GnssAid,
    MagnetometerAid,
    OpticalFlowAid,
    PositionFixAid,
    RangefinderAid,
    StarAid,
    WindReportAid,
    ZeroVelocityAid,
)
from nav.alignment import InitialState
from nav.detection import ChiSquareGate
from nav.earth import earth_rate_n, isa_pressure
from nav.error_model import MOTION
from nav.federated import Federated
from nav.ins import Ins
from nav.local_filter import LocalFilter
from nav.observability import Visibility, flown, visibility
from nav.reference import Reference
from nav.rotation import dcm_from_quat
from nav.samples import (
    AirspeedSample,
    Array,
    BarometerSample,
    BodyVelocitySample,
    FixType,
    GnssSample,
    MagnetometerSample,
    OpticalFlowSample,
    PositionSample,
    RangeSample,
    Sample,
    StarSample,
    Status,
    WindSample,
    usable,
)
from testbed.errors import UserError
from testbed.estimators import registry
from testbed.estimators.lane import Lane
from testbed.estimators.outside import OutsideSection
from testbed.record.reader import scenario_of
from testbed.score import accuracy, detection
from testbed.score.accuracy import column
from testbed.sensors.custom import is_own_aid

if TYPE_CHECKING:
    import xarray

SEGMENTS = 60  # of a run at most
SHORTEST_S = 5.0  # of a segment
TIME_S = 5.0  # given to a derivative to show
KNOWN = 1e-9  # sigma of what is told to have no error, of its unit


class _Way(NamedTuple):
    """N segments with edges ``t`` (N + 1,), truth at their middles, and the 1-sigma of the motion at the start (9,)."""

    t: Array
    middle: Array  # (N,) [s]
    q_nb: Array
    v_n: Array
    lla: Array
    airspeed: Array
    f_b: Array
    omega_b: Array
    sigma: Array


def of_run(dataset: xarray.DataTree) -> dict[str, Visibility]:
    """Visibility of each estimator that was ever aligned; none of a record whose scenario is no longer read."""
    try:
        scenario = scenario_of(dataset)
    except UserError:  # `metrics.unscored` says so
        return {}
    found = {}
    own = [one for one in scenario.estimator if one.kind in registry.BUILT_IN and not isinstance(one, OutsideSection)]
    for name, running in registry.build(own, scenario.rig(scenario.seed)).items():
        way = _way(dataset, name, running) if name in accuracy.names(dataset) else None
        if way is None:
            continue
        match running.horizon.estimator:
            case Ahrs() as ahrs:
                found[name] = _of_ahrs(dataset, name, way, ahrs)
            case Ins() as ins:
                found[name] = _of_filter(dataset, name, way, ins, {aid.sensor: aid for aid in ins.config.aids})
            case Federated() as federated:
                own_aids = {one.aid.sensor: one.aid for local in federated.config.locals for one in local.sensors}
                found[name] = _of_filter(dataset, name, way, federated, own_aids)
    return found


def _way(dataset: xarray.DataTree, name: str, running: Lane) -> _Way | None:
    """The way from where the estimator was aligned, None when it never was, or only at the end.

    Where nobody knows the motion it is that of the next time at which somebody does, or the last; None where
    nobody ever does. A recorded flight has no truth of what is felt: it is what the estimator's IMU felt, None where
    the record lacks that too; and its air moves with the ground.
    """
    own, t = f"estimators/{name}", column(dataset, "truth/time")
    aligned = np.flatnonzero(column(dataset, f"{own}/status") & Status.ALIGNED)
    start = float(column(dataset, f"{own}/time")[aligned[0]]) if len(aligned) else np.inf
    if t[-1] - start < 2 * SHORTEST_S:
        return None
    edges = np.linspace(start, t[-1], min(SEGMENTS, int((t[-1] - start) / SHORTEST_S)) + 1)
    motion = {key: column(dataset, f"truth/{key}") for key in ("lat", "lon", "h", "q_nb", "v_n")}
    known = np.flatnonzero(np.isfinite(np.column_stack([*motion.values()])).all(axis=1) & (t > t[0]))
    if not len(known):
        return None
    after = np.clip(np.searchsorted(t[known], (edges[:-1] + edges[1:]) / 2), 0, len(known) - 1)
    row = known[after]
    lla = np.column_stack([motion[key][row] for key in ("lat", "lon", "h")])
    q_nb, v_n = motion["q_nb"][row], motion["v_n"][row]
    dv, dtheta = (column(dataset, f"truth/{key}")[row] for key in ("dv", "dtheta"))
    airspeed = column(dataset, "truth/airspeed")[row]
    airspeed = np.where(np.isfinite(airspeed), airspeed, np.linalg.norm(v_n, axis=1))
    if not np.nan_to_num(dv).any():  # unknown, in older records 0
        unit, C_sb = next(iter(running.imus.items()))
        felt = _felt(dataset, unit, t[row - 1], t[row])
        if felt is None:
            return None
        dtheta, dv = (increments @ C_sb for increments in felt)
    interval = (t[row] - t[row - 1])[:, None]
    sigma = np.concatenate(
        [column(dataset, f"{own}/sigma_{what}_n")[aligned[0]] for what in ("attitude", "velocity", "position")]
    )
    return _Way(edges, t[row], q_nb, v_n, lla, airspeed, dv / interval, dtheta / interval, sigma)


def _felt(dataset: xarray.DataTree, unit: str, begins: Array, ends: Array) -> tuple[Array, Array] | None:
    """The increments (N, 3) [rad], [m/s] that an IMU has recorded between times, None where it has not."""
    if f"/sensors/{unit}" not in dataset.groups:
        return None
    t = column(dataset, f"sensors/{unit}/time")
    first, stop = (np.searchsorted(t, edges + KNOWN, side="right") for edges in (begins, ends))

    dt, dtheta, dv = (column(dataset, f"sensors/{unit}/{name}") for name in ("dt", "dtheta", "dv"))
    sound = usable(dtheta, dv, dt)[:, None]  # no filter takes the others

    def between(increments: Array) -> Array:
        total = np.vstack([np.zeros(3), np.cumsum(np.where(sound, increments, 0.0), axis=0)])
        return np.asarray(total[stop] - total[first])

    return between(dtheta), between(dv)


def _used(dataset: xarray.DataTree, name: str, edges: Array, part: tuple[str, int], sensor: str = "") -> Array:
    """The largest weight (N, m) of each axis of a measurement in each segment, 0 without; of one ``sensor`` of several.

    Where a measurement was used in part, the record says how many axes were left out but not which: they are taken for
    those that were the furthest from what was expected.
    """
    aid, m = part
    best = np.zeros((len(edges) - 1, m))
    if aid not in accuracy.aids(dataset, name):
        return best
    own = f"estimators/{name}/innovations/{aid}"
    total = column(dataset, f"{own}/weight")
    mine = total > 0
    if sensor:
        mine &= column(dataset, f"{own}/sensor").astype(str) == sensor
    total = total[mine]
    weight = np.repeat(total[:, None], m, axis=1)
    cut = detection.refused(total, column(dataset, f"{own}/outcome")[mine])
    if cut.any():
        nu, S = (column(dataset, f"{own}/{what}")[mine][cut] for what in ("innovation", "S"))
        order = np.argsort(np.argsort(-np.abs(nu) / np.sqrt(np.diagonal(S, axis1=1, axis2=2)), axis=1), axis=1)
        weight[cut] = np.where(order < np.round(m * (1 - total[cut]))[:, None], 0.0, 1.0)
    segment = np.searchsorted(edges, column(dataset, f"{own}/sample_time")[mine]) - 1
    np.maximum.at(best, np.clip(segment, 0, len(best) - 1), weight)
    return best


def _of_ahrs(dataset: xarray.DataTree, name: str, way: _Way, ahrs: Ahrs) -> Visibility:
    level, heading = (_used(dataset, name, way.t, part) for part in ((LEVEL, 2), (MAGNETIC_HEADING, 1)))
    compensated = "airspeed" in ahrs.config.aids
    further, n = ahrs.further, STATES + ahrs.further.count
    F, measurements = np.tile(np.diag(np.concatenate([np.zeros(STATES), -further.decay_rate])), (len(level), 1, 1)), []
    own = f"estimators/{name}"
    judged = column(dataset, f"{own}/judged_acceleration").ravel()
    known = np.isfinite(judged)
    seen = np.interp(way.middle, column(dataset, f"{own}/time")[known], judged[known])
    for k, q_nb in enumerate(way.q_nb):
        earth_n = earth_rate_n(float(way.lla[k, 0]))
        C_nb = dcm_from_quat(q_nb)
        F[k, :3, :STATES] = transition(C_nb, earth_n, 1.0) - np.eye(3, STATES)
        further.turn(F[k], C_nb, way.omega_b[k, 2])
        turn_rate = 0.0 if compensated else float(C_nb[2] @ way.omega_b[k])
        further.drive(F[k], turn_rate)
        levelling = *ahrs.level_measurement(q_nb, way.omega_b[k], compensated, float(seen[k]), turn_rate), level[k]
        measurements.append(_stacked([levelling, (*ahrs.heading_measurement, heading[k])], n))
    names = [f"phi {axis}" for axis in ("north", "east", "down")] + [f"gyro_bias {axis}" for axis in "xyz"]
    names += further.names
    prior = np.concatenate([way.sigma[:3], np.full(3, ahrs.config.imu.gyro_bias_sigma), further.sigma])
    return visibility(names, way.t, F, measurements, np.maximum(prior, KNOWN), TIME_S)


def _of_filter(
    dataset: xarray.DataTree, name: str, way: _Way, estimator: Ins | Federated, aids: Mapping[str, Aid]
) -> Visibility:
    """Of one filter with these aids, by the names of their sensors."""
    inner = LocalFilter(estimator.config.imu, list(aids.values()), ChiSquareGate(0.0))
    reference = Reference([inner.model], [1.0], 1, estimator.field_n)
    parts = [
        (sensor, aid, part[0], _used(dataset, name, way.t, part, sensor))
        for sensor, aid in aids.items()
        if not is_own_aid(aid)
        for part in aid.parts
    ]
    accuracy: dict[str, tuple[Array, Array] | None] = {
        sensor: _accuracy(dataset, sensor) for sensor, aid, _, used in parts if isinstance(aid, GnssAid) and used.any()
    }
    # A record cut short may have reports on samples that it lacks: then nobody knows how accurate they were.
    parts = [part for part in parts if accuracy.get(part[0], ()) is not None]
    all_used = []
    for k in range(len(way.middle)):
        lat, lon, h = way.lla[k].tolist()
        initial = InitialState(float(way.middle[k]), lat, lon, h, way.v_n[k], way.q_nb[k], np.eye(MOTION))
        state = reference.start(initial)
        state.rates[0] = way.omega_b[k]
        found = []
        for sensor, aid, part, used in parts:
            if used[k].any():
                sample = _sample(aid, initial, reference, float(way.airspeed[k]), accuracy.get(sensor))
                measurement = inner.measure(reference, state, aid, part, sample)
                if measurement is not None:  # there is no course at rest
                    found.append((measurement.H, measurement.R, used[k]))
        all_used.append(_stacked(found, inner.model.size))
    prior = np.concatenate([way.sigma, inner.model.sigma[MOTION:]])
    motion = way.t, way.q_nb, way.v_n, way.lla, way.f_b, way.omega_b
    return flown(inner.model, *motion, all_used, np.maximum(prior, KNOWN), TIME_S)


def _accuracy(dataset: xarray.DataTree, receiver: str) -> tuple[Array, Array] | None:
    """Which 1-sigma of position and of velocity (3,) it usually reports; None when no sample of it was recorded."""
    if "sensors" not in dataset or receiver not in dataset["sensors"]:
        return None
    position, velocity = (column(dataset, f"sensors/{receiver}/sigma_{what}_n") for what in ("position", "velocity"))
    if not np.isfinite(position).all(axis=1).any():
        return None
    return np.nanmedian(position, axis=0), np.nanmedian(velocity, axis=0)


def _stacked(parts: Sequence[tuple[Array, Array, Array]], n: int) -> tuple[Array, Array]:
    """H (m, n) and 1-sigma of the noise (m,) of those axes of several measurements (H, R, weight) that were used."""
    H = np.vstack([np.zeros((0, n)), *(H for H, _, _ in parts)])
    R, weight = (np.concatenate([[], *values]) for values in ([R for _, R, _ in parts], [w for *_, w in parts]))
    used = weight > 0
    return H[used], np.sqrt(np.maximum(R[used], KNOWN**2) / weight[used])


def _sample(
    aid: Aid, here: InitialState, reference: Reference, airspeed: float, accuracy: tuple[Array, Array] | None
) -> Sample:
    """What the aid's sensor would say here without error; a receiver, with its usual ``accuracy``."""
    t = here.t
    match aid:
        case GnssAid():
            assert accuracy is not None
            return GnssSample(
                t, t, here.lat, here.lon, here.h, here.v_n, *accuracy, FixType.FIX_3D, 12, 0.9, 1.4, aid.sensor
            )
        case BarometerAid():
            return BarometerSample(t, t, float(isa_pressure(here.h)), aid.sensor)
        case MagnetometerAid():
            place = np.array([here.lat, here.lon, here.h])
            return MagnetometerSample(t, t, reference.field_n(place), aid.sensor)
        case AirspeedAid():
            return AirspeedSample(t, t, airspeed, aid.sensor)
        case BodyVelocityAid() | ZeroVelocityAid():
            return BodyVelocitySample(t, t, np.zeros(3), aid.sensor)
        case StarAid():
            return StarSample(t, t, np.array([1.0, 0.0, 0.0, 0.0]), aid.sensor)
        case RangefinderAid():
            return RangeSample(t, t, 1.0, aid.sensor)
        case OpticalFlowAid():
            return OpticalFlowSample(t, t, np.zeros(2), np.zeros(2), 1.0, aid.sensor)
        case PositionFixAid():
            return PositionSample(t, t, here.lat, here.lon, here.h, aid.sensor)
        case WindReportAid():
            return WindSample(t, t, np.zeros(2), 0.0, aid.error_sigma, aid.sensor)
    raise TypeError(f"no sample of {aid!r}")
