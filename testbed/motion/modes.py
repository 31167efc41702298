"""What the bare airframe does by itself: its trims over airspeed, and its natural modes at them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nav.earth import STANDARD_GRAVITY
from testbed.motion.model import POUND, Aircraft
from testbed.motion.sections import Start


class Mode(NamedTuple):
    """One natural mode of the bare airframe: eigenvalue [1/s], and what can be seen of it.

    ``period`` [s] is infinite for a mode that does not oscillate; ``time_constant`` [s] is 1/|real part|.
    """

    name: str
    eigenvalue: complex
    damping: float
    period: float
    time_constant: float


class Trim(NamedTuple):
    """Straight and level, steady: true airspeed [m/s], angles [rad], travel and throttle as shares, thrust [N]."""

    airspeed: float
    alpha: float
    elevator: float
    throttle: float
    rpm: float
    thrust: float


def trim_and_modes(name: str, airspeed: float, alt_m: float) -> tuple[Trim, list[Mode]]:
    """The trim of an aircraft at a true airspeed [m/s] and an altitude [m], and its modes there: `modes`."""
    aircraft = Aircraft(name, 200.0)
    aircraft.start(Start(lat_deg=0, lon_deg=0, alt_m=alt_m, heading_deg=0, airspeed_mps=airspeed))
    fdm = aircraft.fdm
    trim = Trim(
        airspeed,
        fdm["aero/alpha-rad"],
        fdm["fcs/elevator-pos-rad"] / aircraft.travel["elevator"],
        fdm["fcs/throttle-pos-norm"],
        fdm["propulsion/engine/engine-rpm"],
        fdm["propulsion/engine/thrust-lbs"] * POUND * STANDARD_GRAVITY,
    )
    longitudinal, lateral = (np.linalg.eigvals(block) for block in aircraft.linearise())
    phugoid, _, short, _ = sorted(longitudinal, key=lambda s: (abs(s), s.imag))
    spiral, *dutch, roll = sorted(lateral, key=lambda s: (abs(s.real) if s.imag == 0 else 1.0, s.imag))
    named = {
        "short period": short,
        "phugoid": phugoid,
        "Dutch roll": dutch[-1],
        "roll": roll,
        "spiral": spiral,
    }
    return trim, [_mode(name, complex(s)) for name, s in named.items()]


def modes(airspeed: float, alt_m: float = 800.0, name: str = "loiter") -> list[Mode]:
    """Short period, phugoid, Dutch roll, roll and spiral at a trimmed true airspeed [m/s], loops off, controls fixed.

    From central differences of JSBSim's own accelerations. The airframe is frozen at each perturbed state until the
    engine has found its speed there, so thrust is what a fixed throttle gives.
    """
    return trim_and_modes(name, airspeed, alt_m)[1]


def modes_table(airspeeds: Sequence[float] = (20.0, 25.0, 30.0, 35.0), alt_m: float = 800.0) -> str:
    """The modes at several trimmed airspeeds, as a Markdown table."""
    lines = [
        "| airspeed m/s | mode | eigenvalue 1/s | damping | period s | time constant s |",
        "|---|---|---|---|---|---|",
    ]
    for airspeed in airspeeds:
        for mode in modes(airspeed, alt_m):
            s, period = mode.eigenvalue, f"{mode.period:.2f}" if math.isfinite(mode.period) else "–"
            value = f"{s.real:.3f} ± {abs(s.imag):.3f}i" if s.imag else f"{s.real:.4f}"
            lines.append(
                f"| {airspeed:g} | {mode.name} | {value} | {mode.damping:.2f} | {period} | {mode.time_constant:.2f} |"
            )
    return "\n".join(lines)


def _mode(name: str, s: complex) -> Mode:
    period = 2 * math.pi / abs(s.imag) if s.imag else math.inf
    return Mode(name, s, -s.real / abs(s), period, 1.0 / abs(s.real))
