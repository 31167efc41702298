"""Every metric there is: its name, which way is better, and how much it may differ from a golden value.

Names are ``<estimator>.<quantity>_<statistic>_<unit>``, by `testbed.score.metrics`; ``flight.*`` are of the aircraft
and ``run.*`` of the machine.

Tolerances. A run gives the same bits again on the same machine. On another, the last bits of sines, of exponentials
and of matrix products differ. Measured by running all shipped scenarios with numpy, OpenBLAS, glibc and LLVM held to
the instructions of a processor of 2008: no metric differs by more than 1e-5 of its value, as every filter forgets
where it was. Where the autopilot flies on an estimate, differences grow: most metrics differ by less than 1 %, the
worst of an estimator by 2.7 %, the worst of the flight by 6 %. (In an hour over hills, each estimate of the slope an
estimate of the place, rounding alone decides: with five kinds of matrix product 48 to 60 m are the farthest off. Such a
scenario has ``golden = false``.) So the tolerance is 5 %, and 10 % of the flight's, while
filters that are wrong by a sign, by a latency or by a milli-g differ by more. Floors are for what is next to zero; of a
mean error, which is next to zero by right, the tolerance is a share of the RMS error beside it (a mean heading of
-0.015 deg differed by 8 % of itself, 1.4 % of its RMS, between two kinds of matrix product).
Metrics that count events, or say when one was, jump by whole events if one sample lies at the edge of a gate: a few
events, or samples of a sensor at 5 Hz, are no difference.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum
from itertools import product

SHARE, OF_THE_FLIGHT = 0.05, 0.1


class Aim(Enum):
    """Which way is better."""

    LESS = "less"
    MORE = "more"
    ONE = "nearer to one"
    ZERO = "nearer to zero"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class Measure:
    """Which way a metric is better, and its tolerance: a share of the golden value, and at least ``floor``.

    ``size`` is the metric of which it is a share, where that is another one of the same estimator.
    """

    aim: Aim = Aim.LESS
    floor: float = 0.0
    share: float = SHARE
    size: str = ""

    def verdict(self, golden: float, now: float, size: float | None = None) -> str:
        """same, better, worse, or changed where no way is better; ``size`` is the golden value of that metric."""
        if abs(now - golden) <= max(self.floor, self.share * abs(golden if size is None else size)):
            return "same"
        if self.aim is Aim.NONE:
            return "changed"
        return "better" if self._badness(now) < self._badness(golden) else "worse"

    def _badness(self, value: float) -> float:
        if self.aim is Aim.ONE:
            return abs(math.log(max(value, 1e-12)))
        if self.aim is Aim.ZERO:
            return abs(value)
        return -value if self.aim is Aim.MORE else value


def _statistics() -> dict[str, Measure]:
    """The metrics that there are with GNSS and, with ``outage_`` in front, without."""
    position, velocity, angle = (Measure(floor=floor) for floor in (1e-4, 1e-5, 1e-5))
    axes = ("north", "east", "down")
    of_axes = tuple(product(axes, ("rms", "max", "std")))
    found = {
        **dict.fromkeys([f"position_{axis}_{statistic}_m" for axis, statistic in of_axes], position),
        **dict.fromkeys([f"velocity_{axis}_{statistic}_mps" for axis, statistic in of_axes], velocity),
        **{f"position_{axis}_mean_m": _mean(position, f"position_{axis}_rms_m") for axis in axes},
        **{f"velocity_{axis}_mean_mps": _mean(velocity, f"velocity_{axis}_rms_mps") for axis in axes},
        **{f"{one}_mean_deg": _mean(angle, f"{one}_rms_deg") for one in ("roll", "pitch", "heading")},
        **dict.fromkeys([f"position_horizontal_{statistic}_m" for statistic in ("rms", "max")], position),
        "position_horizontal_over_3sigma_max": Measure(floor=1e-3),
        "position_vertical_rms_m": position,
        **dict.fromkeys([f"velocity_{statistic}_mps" for statistic in ("rms", "max")], velocity),
        **dict.fromkeys([f"roll_pitch_{statistic}_deg" for statistic in ("rms", "max")], angle),
        **dict.fromkeys(
            [f"{axis}_{one}_deg" for axis, one in product(("roll", "pitch", "heading"), ("rms", "max", "std"))], angle
        ),
        **dict.fromkeys(
            [f"{what}_nees_mean" for what in ("position", "velocity", "attitude")], Measure(Aim.ONE, floor=2e-3)
        ),
    }
    return found | {
        f"outage_{name}": replace(measure, size=measure.size and f"outage_{measure.size}")
        for name, measure in found.items()
    }


def _mean(measure: Measure, rms: str) -> Measure:
    """Of a mean error, beside the metric of its RMS."""
    return replace(measure, aim=Aim.ZERO, size=rms)


# Of an estimator, by the name without it,
MEASURES: dict[str, Measure] = _statistics() | {
    **{f"outage_position_horizontal_at_{mark}s_m": Measure(floor=1e-4) for mark in (60, 120, 300, 600)},
    **{f"outage_bound_at_{mark}s_m": Measure(Aim.NONE, floor=1e-4) for mark in (60, 120, 300, 600)},
    "aligned_s": Measure(floor=0.5),
    "recovery_s": Measure(floor=0.5),
    "unrecovered_outages": Measure(share=0.0),
    "nonfinite_samples": Measure(share=0.0),
    "false_alarms_per_h": Measure(floor=50.0, share=0.1),
    "false_alarms_per_look": Measure(floor=1e-3, share=0.1),
}
# and of those that have, after a dot, the name of an aid,
OF_AIDS = {
    "nis_mean": Measure(Aim.ONE, floor=2e-3),
    "rejected_fraction": Measure(Aim.NONE, floor=2e-3, share=0.1),
}
# or of a fault.
OF_FAULTS = {
    "detection_delay_s": Measure(floor=0.5),
    "end_lag_s": Measure(floor=0.5),
    "coverage": Measure(Aim.MORE, floor=0.01),
    "missed": Measure(share=0.0),
    "isolation_correct": Measure(Aim.MORE, share=0.0),
    "error_over_3sigma": Measure(floor=1e-3),
}
# ``flight.*``, of the aircraft,
OF_FLIGHT = {
    prefix + name: measure
    for prefix in ("", "outage_", "recovery_")
    for name, measure in {
        "bank_max_deg": Measure(Aim.NONE, share=OF_THE_FLIGHT),
        "stall_margin_min_mps": Measure(Aim.MORE, floor=0.05, share=OF_THE_FLIGHT),
        "overspeed_margin_min_mps": Measure(Aim.MORE, floor=0.05, share=OF_THE_FLIGHT),
        "altitude_error_max_m": Measure(floor=1e-2, share=OF_THE_FLIGHT),
        "path_error_rms_m": Measure(floor=1e-2, share=OF_THE_FLIGHT),
        "path_error_max_m": Measure(floor=1e-2, share=OF_THE_FLIGHT),
    }.items()
}
# and ``run.*``, of the machine: never the same twice.
OF_RUN = dict.fromkeys(("wall_s", "truth_s", "realtime_factor"), Measure(Aim.NONE))


def find(metric: str) -> Measure | None:
    """What is to be known of a metric; None when there is no such metric, whatever the estimator is called."""
    whose, _, name = metric.partition(".")
    if whose in ("flight", "run"):
        return (OF_FLIGHT if whose == "flight" else OF_RUN).get(name)
    kind, dot, _ = name.partition(".")
    return (OF_AIDS | OF_FAULTS).get(kind) if dot else MEASURES.get(name)


def names(whose: str) -> list[str]:
    """The names of the metrics of an estimator, of ``flight`` or of ``run``."""
    if whose in ("flight", "run"):
        return list(OF_FLIGHT if whose == "flight" else OF_RUN)
    return [*MEASURES, *(f"{kind}.<aid>" for kind in OF_AIDS), *(f"{kind}.<fault>" for kind in OF_FAULTS)]
