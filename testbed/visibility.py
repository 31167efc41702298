"""Which states of each INS can be seen, and when, along the way that a recorded run took.

The filters are built from the run's scenario as they were for it; truth gives the motion, the record what they could
look at. See `nav.observability.flown`, whose prior is the estimator's own 1-sigma once aligned.
"""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING

import numpy as np

from nav.alignment import InitialState
from nav.detection import ChiSquareGate
from nav.earth import isa_pressure
from nav.error_model import MOTION
from nav.ins import Ins
from nav.local_filter import (
    Aid,
    AirspeedAid,
    BarometerAid,
    BodyVelocityAid,
    GnssAid,
    LocalFilter,
    MagnetometerAid,
    PositionFixAid,
    StarAid,
)
from nav.observability import Visibility, flown
from nav.reference import Reference
from nav.samples import (
    AirspeedSample,
    Array,
    BarometerSample,
    BodyVelocitySample,
    FixType,
    GnssSample,
    MagnetometerSample,
    PositionSample,
    Sample,
    StarSample,
)
from testbed import estimators
from testbed import metrics as scores
from testbed.errors import UserError
from testbed.metrics import column
from testbed.scenario import Scenario

if TYPE_CHECKING:
    import xarray

SEGMENTS = 60  # of a run at most
SHORTEST_S = 5.0  # of a segment
LOOK_S = 5.0  # given to a derivative to show
KNOWN = 1e-9  # prior of a state that is told to have no error, of its unit


def of_run(dataset: xarray.DataTree) -> dict[str, Visibility]:
    """Visibility of each INS of the run that was ever aligned; none of a record whose scenario is no longer read."""
    try:
        overrides = json.loads(dataset.attrs.get("overrides", "[]"))
        scenario = Scenario.parse(str(dataset.attrs["scenario"]), overrides)
    except (KeyError, ValueError, UserError):
        return {}
    found = {}
    for name, running in estimators.build(scenario, scenario.seed).items():
        ins = running.horizon.estimator
        if isinstance(ins, Ins) and name in scores.names(dataset):
            receiver = next((one for one in running.sensors if scenario.sensors[one].kind == "gnss"), "")
            seen = _of_ins(dataset, name, ins, receiver)
            if seen is not None:
                found[name] = seen
    return found


def _of_ins(dataset: xarray.DataTree, name: str, ins: Ins, receiver: str) -> Visibility | None:
    e = scores.errors(dataset, name, 0.0)
    t = column(dataset, "truth/time")
    if e.aligned_s is None or t[-1] - e.aligned_s < 2 * SHORTEST_S:
        return None
    count = min(SEGMENTS, int((t[-1] - e.aligned_s) / SHORTEST_S))
    edges = np.linspace(e.aligned_s, t[-1], count + 1)
    middle = np.searchsorted(t, (edges[:-1] + edges[1:]) / 2)
    true = {key: column(dataset, f"truth/{key}")[middle] for key in ("q_nb", "v_n", "lat", "lon", "h", "airspeed")}
    interval = t[middle] - t[middle - 1]
    f_b, omega_b = (column(dataset, f"truth/{key}")[middle] / interval[:, None] for key in ("dv", "dtheta"))
    lla = np.column_stack([true["lat"], true["lon"], true["h"]])

    config = ins.config
    inner = LocalFilter(config.imu, config.used(), ChiSquareGate(0.0))
    reference = Reference([inner.model], [1.0], 1, ins.field_n)
    parts = [(aid, part, size) for aid in config.used() for part, size in aid.parts]
    H = np.zeros((count, sum(size for *_, size in parts), inner.model.size))
    variance = np.full(H.shape[1], np.nan)
    denied = scores.inside(t[middle], scores.outages(dataset))
    for k in range(count):
        lat, lon, h = lla[k].tolist()
        initial = InitialState(float(t[middle[k]]), lat, lon, h, true["v_n"][k], true["q_nb"][k], np.eye(MOTION))
        state = reference.start(initial)
        first = 0
        for aid, part, size in parts:
            rows = slice(first, first + size)
            first += size
            if isinstance(aid, GnssAid) and (denied[k] or _turns_too_fast(aid, part, omega_b[k])):
                continue
            sample = _sample(dataset, aid, initial, reference, float(true["airspeed"][k]), receiver)
            look = inner.look(reference, state, aid, part, sample)
            if look is not None and not look.withheld:
                H[k, rows], variance[rows] = look.H, look.R
    at = int(np.searchsorted(e.t, e.aligned_s))
    prior = inner.model.sigma.copy()
    prior[:MOTION] = np.concatenate([e.sigma_attitude[at], e.sigma_velocity[at], e.sigma_position[at]])
    noise = np.sqrt(np.where(np.isfinite(variance), variance, 1.0))
    return flown(
        inner.model, edges, true["q_nb"], true["v_n"], lla, f_b, omega_b, list(H), noise,
        np.maximum(prior, KNOWN), LOOK_S,
    )  # fmt: skip


def _turns_too_fast(aid: GnssAid, part: str, omega_b: Array) -> bool:
    return part == "gnss_course" and aid.course is not None and abs(float(omega_b[2])) > aid.course.max_turn_rate


def _sample(
    dataset: xarray.DataTree, aid: Aid, here: InitialState, reference: Reference, airspeed: float, receiver: str
) -> Sample:
    """What the aid's sensor would say here without error, with the accuracy that the ``receiver`` usually reports."""
    t = here.t
    match aid:
        case GnssAid():
            position, velocity = (
                np.nanmedian(column(dataset, f"sensors/{receiver}/sigma_{what}_n"), axis=0)
                for what in ("position", "velocity")
            )
            return GnssSample(
                t, t, here.lat, here.lon, here.h, here.v_n, position, velocity, FixType.FIX_3D, 12, 0.9, 1.4, aid.sensor
            )
        case BarometerAid():
            return BarometerSample(t, t, float(isa_pressure(here.h)), aid.sensor)
        case MagnetometerAid():
            place = np.array([here.lat, here.lon, here.h])
            return MagnetometerSample(t, t, reference.field_n(place), aid.sensor)
        case AirspeedAid():
            return AirspeedSample(t, t, airspeed, aid.sensor)
        case BodyVelocityAid():
            return BodyVelocitySample(t, t, np.zeros(3), aid.sensor)
        case StarAid():
            return StarSample(t, t, np.array([1.0, 0.0, 0.0, 0.0]), aid.sensor)
        case PositionFixAid():
            return PositionSample(t, t, here.lat, here.lon, here.h, aid.sensor)
    raise TypeError(f"no sample of {aid!r}")


def table(found: dict[str, Visibility]) -> list[list[str]]:
    """Rows for all: head, ranks, then each state: seen from when [s], or the share of it that is, 0 to 1."""
    rows = [["state", *found], ["rank", *(f"{seen.rank[-1]} of {len(seen.names)}" for seen in found.values())]]
    names = dict.fromkeys(name for seen in found.values() for name in seen.names)
    for name in names:
        row = [name]
        for seen in found.values():
            if name not in seen.names:
                row.append("")
                continue
            k = seen.names.index(name)
            since = float(seen.seen_from()[k])
            row.append(f"from {since:.0f} s" if math.isfinite(since) else f"never ({seen.share[-1, k]:.2f})")
        rows.append(row)
    return rows
