"""Filters broken on purpose: `testbed check` says so, by metrics that anybody sees.

Each break is made at run time, in this process, in what the filters are made of. The scenario is the shipped
`regression` with its golden metrics; that it passes unbroken is tested where all shipped scenarios are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numba
import pytest

from nav import aids, alignment, columns, earth, reference, state, strapdown
from nav.aids.base import Measurement
from nav.detection import Never
from nav.error_model import PHI, POS, VEL
from nav.horizon import FusionHorizon
from nav.local_filter import LocalFilter
from nav.samples import Sample
from testbed.estimators import federated
from testbed.estimators.rig import Rig
from testbed.many import check
from testbed.report import page as report

GOLDEN = Path(__file__).parents[1] / "golden"
MILLI = 1e-3

Break = Callable[[pytest.MonkeyPatch], None]


@pytest.fixture
def verdict(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], check.Outcome]:
    """Flies and judges the scenario in this process; figures, which take longer than the flight, are left out."""
    monkeypatch.setattr(report, "write_report", lambda *_: None)
    (task,) = check.tasks(["regression"], tmp_path, GOLDEN)
    return lambda: check.fly(task)


def one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every sample goes through Python, where it can be broken; `tests/nav/test_batch` holds batches to that."""
    for aid in (aids.AirspeedAid, aids.BarometerAid, aids.GnssAid, aids.MagnetometerAid):
        monkeypatch.setattr(aid, "plain", None)


def sign(aid: str, start: int) -> Break:
    """The sign of a block of three columns of one aid's Jacobian."""

    def apply(monkeypatch: pytest.MonkeyPatch) -> None:
        module = {"sideslip": aids.airspeed, "magnetometer": aids.magnetometer, "barometer": aids.barometer}.get(
            aid, aids.gnss
        )
        right = getattr(module, aid)

        def wrong(*arguments: Any) -> Any:
            nu, H = right(*arguments)
            H[:, start : start + 3] *= -1
            return nu, H

        one_by_one(monkeypatch)
        monkeypatch.setattr(module, aid, wrong)

    return apply


def noise(part: str, factor: float = 100.0) -> Break:
    """R of the looks whose names begin with ``part``."""

    def apply(monkeypatch: pytest.MonkeyPatch) -> None:
        right = LocalFilter.measure

        def wrong(self: LocalFilter, *arguments: Any) -> Measurement | None:
            measurement = right(self, *arguments)
            return (
                measurement
                if measurement is None or not arguments[3].startswith(part)
                else measurement._replace(R=factor * measurement.R)
            )

        one_by_one(monkeypatch)
        monkeypatch.setattr(LocalFilter, "measure", wrong)

    return apply


def no_detector(monkeypatch: pytest.MonkeyPatch) -> None:
    """Detectors that never alarm."""
    monkeypatch.setattr(federated, "_detector", lambda config: Never())


def samples_as_they_arrive(monkeypatch: pytest.MonkeyPatch) -> None:
    """Latency ignored: a sample taken for one of the time at which it arrives."""
    right = FusionHorizon.track

    def wrong(self: FusionHorizon, imu: Any, samples: list[Sample], times: Any) -> Any:
        return right(self, imu, [replace(sample, t=sample.t_arrival) for sample in columns.one_by_one(samples)], times)

    monkeypatch.setattr(FusionHorizon, "track", wrong)


def no_lag(monkeypatch: pytest.MonkeyPatch) -> None:
    """Latency ignored: no horizon, so that a filter is past a sample's time when it arrives."""
    monkeypatch.setattr(Rig, "lag_s", lambda *_: 0.0)


def gravity(monkeypatch: pytest.MonkeyPatch) -> None:
    """One mg too much, in the strapdown and in the alignment."""
    wrong = (1 + MILLI) * earth.GRAVITY_EQUATOR
    step = recompiled(strapdown, "step", GRAVITY_EQUATOR=wrong)
    monkeypatch.setattr(reference, "propagate", recompiled(state, "propagate", step=step))
    monkeypatch.setattr(alignment, "gravity", lambda lat, h: (1 + MILLI) * earth.gravity(lat, h))


def recompiled(module: ModuleType, kernel: str, **globals: Any) -> Any:
    """A kernel compiled anew with other globals, which the compiler takes for constants."""
    code = getattr(module, kernel).py_func.__code__
    return numba.njit(FunctionType(code, vars(module) | globals))


BREAKS = [
    pytest.param(sign("magnetometer", PHI), "ins.heading_rms_deg", id="sign-magnetometer"),
    pytest.param(noise("gnss"), "ins.nis_mean.gnss_position", marks=pytest.mark.ci, id="R-x-100-gnss"),
    pytest.param(no_detector, "federated.missed.ramp", marks=pytest.mark.ci, id="no-detector"),
    pytest.param(samples_as_they_arrive, "ins.position_horizontal_rms_m", marks=pytest.mark.ci, id="latency-ignored"),
    pytest.param(gravity, "federated.outage_position_horizontal_max_m", marks=pytest.mark.ci, id="gravity-1-mg"),
]
MORE = [
    pytest.param(sign("gnss_velocity", VEL), "ins.velocity_rms_mps", id="sign-gnss-velocity"),
    pytest.param(no_lag, "ins.position_horizontal_rms_m", id="no-lag"),
    pytest.param(sign("gnss_position", PHI), "federated.outage_position_north_rms_m", id="sign-lever-arm"),
    pytest.param(sign("gnss_position", POS), "ins.position_horizontal_rms_m", id="sign-gnss-position"),
    pytest.param(sign("barometer", POS), "ins.position_vertical_rms_m", id="sign-barometer"),
    pytest.param(sign("sideslip", PHI), "ins.outage_heading_std_deg", id="sign-sideslip-attitude"),
    pytest.param(sign("sideslip", VEL), "federated.outage_position_north_rms_m", id="sign-sideslip-velocity"),
    pytest.param(noise("barometer"), "ins.outage_position_vertical_rms_m", id="R-x-100-barometer"),
    pytest.param(noise("magnetometer"), "federated.heading_rms_deg", id="R-x-100-magnetometer"),
    *(
        pytest.param(noise(part), f"ins.nis_mean.{part}", id=f"R-x-100-{part}")
        for part in ("gnss_velocity", "airspeed", "sideslip")
    ),
    pytest.param(noise("", 0.01), "federated.velocity_nees_mean", id="R-over-100"),
]


def catches(outcome: check.Outcome, metric: str) -> None:
    worst = sorted((row for row in outcome.rows if not row.sound), key=lambda row: row.golden)
    print(f"{outcome}\n" + "\n".join(str(row) for row in worst[:12]))
    assert outcome.failed
    assert not outcome.failure, "it ended otherwise than by its metrics"
    assert metric in {row.metric for row in worst}


@pytest.mark.ci
@pytest.mark.parametrize(("apply", "metric"), BREAKS)
def test_broken_it_fails(
    verdict: Callable[[], check.Outcome], monkeypatch: pytest.MonkeyPatch, apply: Break, metric: str
) -> None:
    apply(monkeypatch)
    catches(verdict(), metric)


@pytest.mark.slow
@pytest.mark.parametrize(("apply", "metric"), MORE)
def test_broken_otherwise_it_fails(
    verdict: Callable[[], check.Outcome], monkeypatch: pytest.MonkeyPatch, apply: Break, metric: str
) -> None:
    apply(monkeypatch)
    catches(verdict(), metric)
