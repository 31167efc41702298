"""Steps as the rows of numbers that the kernel of the attitude filter takes (`nav.ahrs.steps`)."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from nav.ahrs import steps as kernels
from nav.aids.airspeed import AIRSPEED_LIMITS
from nav.aids.barometer import PRESSURE_LIMITS
from nav.aids.base import all_within
from nav.aids.magnetometer import FIELD_LIMITS
from nav.columns import column
from nav.earth import SEA_LEVEL_PRESSURE
from nav.increments import ADVANCE, ESTIMATE, HORIZON, NUMBERS, TIME, WHAT, Steps
from nav.motion import true_over_equivalent
from nav.samples import AirspeedSample, Array, BarometerSample, MagnetometerSample


def planned(steps: Steps, kind_of: Callable[[str], int], slowest: float) -> tuple[Array, npt.NDArray[np.bool_]]:
    """All ``steps`` as rows for `nav.ahrs.steps.follow`, and which of them look plain (N,).

    ``kind_of`` has the place of a magnetometer's reports among the kinds; no airspeed below the ``slowest`` is used.
    """
    t, horizon = np.array(steps.t), np.array(steps.horizon)
    rows = np.zeros((len(t), kernels.WIDTH))
    rows[:, TIME], rows[:, HORIZON], rows[:, WHAT] = t, horizon, np.where(np.isnan(t), ADVANCE, ESTIMATE)
    plain = np.ones(len(t), bool)
    for sensor, places, samples in sorted(steps.groups, key=lambda group: group[1][0]):
        where = np.asarray(places)
        match samples[0]:
            case MagnetometerSample():
                field_b = column(samples, "field_b")
                with np.errstate(over="ignore"):  # of what is no field
                    sound = all_within(np.sqrt(np.sum(field_b * field_b, axis=1)), FIELD_LIMITS)
                rows[where, WHAT], rows[where, NUMBERS + 3] = kernels.MAGNETIC, kind_of(sensor)
                rows[where, NUMBERS : NUMBERS + 3] = field_b
            case AirspeedSample():
                eas = column(samples, "eas")
                sound = all_within(eas, AIRSPEED_LIMITS)
                rows[where, WHAT] = kernels.AIRSPEED
                rows[where, NUMBERS] = np.where(eas >= slowest, eas, math.nan)
            case BarometerSample():
                pressure = column(samples, "pressure")
                sound = all_within(pressure, PRESSURE_LIMITS)
                rows[where, WHAT] = kernels.DENSITY
                known = np.where(sound, pressure, SEA_LEVEL_PRESSURE).tolist()
                rows[where, NUMBERS] = [true_over_equivalent(one) for one in known]
        plain[where] = (t[where] == horizon[where]) & sound  # not too late
    return rows, plain
