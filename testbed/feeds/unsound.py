"""Which sensors of a log can't be right: magnetometers by the World Magnetic Model, barometers by heights of GNSS."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from nav.earth import pressure_altitude
from nav.samples import Array, BarometerSample, MagnetometerSample
from testbed.feeds.axes import unlike
from testbed.feeds.lateness import fixes
from testbed.feeds.log import Log
from testbed.feeds.reference import is_flown
from testbed.feeds.survey import Phase, Survey, between
from testbed.sensors.magnetometer import WMM_YEARS, geomagnetic_field_n
from testbed.sensors.units import MICROTESLA

LEAST_REST_S = 3.0  # that says how a vehicle lies
LEAST_SAMPLES = 60  # in flight
# Recorded flights: sound magnetometers are off by 10 deg and a fifth of the field at most, and change by a twelfth in
# flight; bad ones are off by 24 deg or a third of it, and motors' currents add as much.
MOST_INCLINATION_OFF = math.radians(15)
MOST_SIZE_OFF = 0.25
FIELDS_UT = 15.0, 85.0  # that a magnetometer may say, a third beyond those of the Earth
MOST_HEIGHT_OFF_M = 1000.0  # of a pressure altitude: no weather makes so much


def unfit_as_aids(found: Survey) -> dict[str, str]:
    """What speaks against those sensors that are to be left out of the estimators' aids, a sentence each."""
    told = {**magnetometers(found), **barometers(found), **unlike(found.log)}
    return {name: said for name, said in told.items() if name in found.log.samples}


def magnetometers(found: Survey) -> dict[str, str]:
    """What speaks against those magnetometers of which something does, a sentence each."""
    told = {}
    for name, own in found.log.samples.items():
        fields = [one for one in own if isinstance(one, MagnetometerSample) and 0 < _size(one) < math.inf]
        if fields and (said := list(_against(found, fields))):
            why = ", ".join(said)
            told[name] = f"{name}: {why}: leave it out of the estimators' aids, or correct its calibration or axes"
    return told


def _size(sample: MagnetometerSample) -> float:
    return float(np.linalg.norm(sample.field_b))


def barometers(found: Survey) -> dict[str, str]:
    """The same of barometers."""
    t, place = _places(found.log)
    told = {}
    for name, own in found.log.samples.items():
        pressures = [one for one in own if isinstance(one, BarometerSample) and one.pressure > 0]
        if not pressures or not len(t):
            continue
        altitude = pressure_altitude(np.array([one.pressure for one in pressures]))
        above = np.interp(t, [one.t for one in pressures], altitude) - place[:, 2]
        if abs(off := float(np.median(above))) > MOST_HEIGHT_OFF_M:
            where = f"{abs(off):.0f} m {'above' if off > 0 else 'below'} {found.log.receiver}"
            what = f"its pressure altitude is {where} (median)"
            told[name] = f"{name}: {what}: leave it out of the estimators' aids, or correct its pressure"
    return told


def _places(log: Log) -> tuple[Array, Array]:
    """Times (N,) and places (N, 3) of the first receiver that has a fix."""
    if log.receiver is None:
        return np.empty(0), np.empty((0, 3))
    t, _, place = fixes(log.samples[log.receiver])
    there = is_flown(place[:, 0], place[:, 2])
    return t[there], place[there]


def _model(log: Log) -> Array | None:
    """The Earth's field (3,) [T], north-east-down, None where the log doesn't say when and where it was."""
    _, place = _places(log)
    if not len(place) or log.date is None or not WMM_YEARS[0] <= log.date.year < WMM_YEARS[1]:
        return None
    lat, lon, h = np.median(place, axis=0).tolist()
    return geomagnetic_field_n(lat, lon, h, log.date)


def _against(found: Survey, fields: list[MagnetometerSample]) -> Iterator[str]:
    """What speaks against one magnetometer."""
    t = np.array([one.t for one in fields]) - found.log.t0
    field_b = np.array([one.field_b for one in fields])
    size = np.linalg.norm(field_b, axis=1)

    def during(name: str) -> list[tuple[Phase, slice]]:
        own = [phase for phase in found.phases if phase.name == name]
        rows = [slice(*np.searchsorted(t, [phase.start, phase.end]).tolist()) for phase in own]
        return [(phase, part) for phase, part in zip(own, rows, strict=True) if part.stop > part.start]

    resting = [(phase, part) for phase, part in during("rest") if phase.end - phase.start >= LEAST_REST_S]
    if not resting:
        usual = float(np.median(size)) / MICROTESLA
        if not FIELDS_UT[0] <= usual <= FIELDS_UT[1]:
            yield f"its field is of {usual:.3g} µT mostly, where the Earth's is of 22 to 67 µT"
        return
    at_rest = float(np.median(np.concatenate([size[part] for _, part in resting])))
    if (model_n := _model(found.log)) is not None:
        inclined = [_inclination(found.log, phase, field_b[part].mean(axis=0)) for phase, part in resting]
        true = math.asin(float(model_n[2] / np.linalg.norm(model_n)))
        worst = max(inclined, key=lambda one: abs(one - true))
        if abs(worst - true) > MOST_INCLINATION_OFF:
            told, model = round(math.degrees(worst)), round(math.degrees(true))
            yield f"at rest its field is inclined by {told} deg, by the World Magnetic Model by {model} deg"
        strength = float(np.linalg.norm(model_n))
        if abs(at_rest / strength - 1) > MOST_SIZE_OFF:
            sizes = f"{at_rest / MICROTESLA:.1f} µT, by the World Magnetic Model of {strength / MICROTESLA:.1f} µT"
            yield f"at rest its field is of {sizes}"
    aloft = np.concatenate([np.empty(0), *(size[part] for _, part in during("flying"))])
    ratio = float(np.median(aloft)) / at_rest if len(aloft) >= LEAST_SAMPLES else 1.0
    if abs(ratio - 1) > MOST_SIZE_OFF:
        yield f"in flight its field is {ratio:.2f} times as large as at rest, as motors' currents make it"


def _inclination(log: Log, phase: Phase, field_b: Array) -> float:
    """How far a field (3,) points below the horizon [rad], as the accelerometers feel that in a rest."""
    imu = log.imus[log.unit]
    down = -np.nansum(imu.dv[between(log, imu, phase)], axis=0)
    across = float(np.linalg.norm(down) * np.linalg.norm(field_b))
    return math.asin(min(max(float(down @ field_b) / across, -1.0), 1.0)) if across else 0.0
