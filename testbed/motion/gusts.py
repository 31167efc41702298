"""How strong gusts are: MIL-F-8785C, 3.7.3.4 and 3.7.3.5, as JSBSim's turbulence follows it.

The specification goes by height over ground. JSBSim (1.3.3, FGWinds) takes the altitude, whatever the height of the
terrain that it is told; so altitudes are above the ellipsoid here, as they are flown.

MIL-F-8785C, *Flying Qualities of Piloted Airplanes*, 1980, figure 7 for the high-altitude table.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from nav.samples import Array
from testbed.motion.legs import Leg
from testbed.motion.sections import FlightTruth
from testbed.schema import Section

FOOT = 0.3048  # [m]
UNKNOWN_AIR = 1.0  # what is expected of air that nothing is said about [m/s]

# Wind at 20 ft for the low-altitude model [ft/s] (15, 30 and 45 knots, fig. 8) and the probability of exceedance curve
# of the high-altitude model (fig. 7: light 1e-2, moderate 1e-3, severe 1e-5; JSBSim counts them).
TURBULENCE = {"light": (25.3, 3), "moderate": (50.6, 4), "severe": (76.0, 6)}

# Figure 7: altitude [ft], and the gusts' rms [ft/s] on each of these curves.
HIGH = (500.0, 1750.0, 3750.0, 7500.0, 15_000.0, 25_000.0, 35_000.0)
EXCEEDANCE = {
    3: (6.6, 6.9, 7.4, 6.7, 4.6, 2.7, 0.4),
    4: (8.6, 9.6, 10.6, 10.1, 8.0, 6.6, 5.0),
    6: (15.6, 17.6, 23.0, 23.6, 22.1, 20.0, 16.0),
}


def gust_sigma(level: str, alt_m: float) -> float:
    """Rms of the horizontal gusts along one axis [m/s] at an altitude, by a word of `TURBULENCE`.

    Up to 1000 ft sigma_u = 0.1 W20 / (0.177 + 0.000823 h)^0.4, above 2000 ft figure 7, linear between the two.
    """
    at_20ft, curve = TURBULENCE[level]
    h = max(alt_m / FOOT, 10.0)
    low = 0.1 * at_20ft
    if h <= 1000.0:
        return low / math.pow(0.177 + 0.000823 * h, 0.4) * FOOT
    high = float(np.interp(h, HIGH, EXCEEDANCE[curve]))
    return (low + min((h - 1000.0) / 1000.0, 1.0) * (high - low)) * FOOT


def gust_statistics(level: str, alt_m: Array) -> tuple[Array, Array]:
    """Rms [m/s] and length [m] of JSBSim's gusts along, across and down (N, 3) at altitudes (N,).

    They are first-order Gauss-Markov processes of these lengths over the airspeed (MIL-STD-1797A as Yeager 1998 has it,
    equations 30 to 32): across and down half of Dryden's L_u and L_w, which up to 1000 ft are h / (0.177 + 0.000823
    h)^1.2 and h.
    """
    h = np.maximum(alt_m / FOOT, 10.0)
    high = 1000.0 + np.clip((h - 1000.0) / 1000.0, 0.0, 1.0) * 750.0
    along = np.where(h <= 1000.0, h / (0.177 + 0.000823 * h) ** 1.2, high) * FOOT
    down = np.where(h <= 1000.0, h, high) * FOOT
    sigma = np.array([gust_sigma(level, float(alt)) for alt in alt_m])
    vertical = np.where(h <= 1000.0, 0.1 * TURBULENCE[level][0] * FOOT, sigma)
    return np.column_stack([sigma, sigma, vertical]), np.column_stack([along, along / 2, down / 2])


def expected_gust(truth: Section, plan: Sequence[Leg]) -> float:
    """The strongest gusts that a plan meets, rms [m/s]; `UNKNOWN_AIR` where no turbulence is asked for."""
    if not isinstance(truth, FlightTruth) or truth.wind.turbulence == "none":
        return UNKNOWN_AIR
    return max(gust_sigma(truth.wind.turbulence, alt) for alt in _altitudes(truth, plan))


def _altitudes(truth: FlightTruth, plan: Sequence[Leg]) -> Iterator[float]:
    yield truth.start.alt_m
    for leg in plan:
        for key in ("to_m", "alt_m"):
            if (altitude := getattr(leg, key, None)) is not None:
                yield altitude
