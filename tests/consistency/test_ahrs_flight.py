"""Attitude without GNSS on the flown aircraft, over seeds."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

from testbed import Scenario, error_series, run

SEEDS = range(1, 7)
FLIGHTS = ("loiter_ahrs_denied", "loiter_ahrs_continuous")


def fly(flight: str, seed: int) -> dict[str, float]:
    return run(Scenario.load(flight, ["record.imu=false", "expect={}"]), seed=seed).metrics


@pytest.mark.slow
@pytest.mark.parametrize("flight", FLIGHTS)
def test_half_an_hour_without_gnss(flight: str) -> None:
    """The compensated AHRS holds with every seed what gyros alone lose with most: 5 deg."""
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        found = list(pool.map(fly, [flight] * len(SEEDS), SEEDS))
    largest, rms, gyros = (
        np.array([one[key] for one in found])
        for key in ("ahrs.roll_pitch_max_deg", "ahrs.roll_pitch_rms_deg", "gyros.roll_pitch_max_deg")
    )
    print(f"{flight}: largest {np.round(largest, 2)}, RMS {np.round(rms, 2)}, gyros alone {np.round(gyros, 1)} deg")
    assert largest.max() < 1.5
    assert rms.max() < 0.5
    assert np.median(gyros) > 5.0


CIRCLE = 'plan=[{leg="loiter", radius_m=400.0, duration_s=2000.0}]'


def level(flight: str, overrides: list[str], seed: int) -> tuple[float, float]:
    """RMS of tilt [deg] after a minute, and its mean square over what is claimed, without any aid in any motion."""
    blind = 'estimator=[{name="ahrs", kind="ahrs", aids=[], heading_deg=30.0, profile="any_motion"}]'
    scenario = Scenario.load(flight, [blind, "duration_s=900.0", "record.imu=false", "expect={}", *overrides])
    errors = error_series(run(scenario, seed=seed), "ahrs").loc[60:]
    axes = ("phi_north_deg", "phi_east_deg")
    tilt, claimed = (errors[[f"{of}{axis}" for axis in axes]].to_numpy() for of in ("", "sigma_"))
    return float(np.sqrt(np.square(tilt).sum(axis=1).mean())), float(np.square(tilt / claimed).mean())


@pytest.mark.slow
@pytest.mark.parametrize("grade", ["mems-consumer", "mems-industrial"])
@pytest.mark.parametrize(
    ("flight", "plan"),
    [("loiter_gnss_outage", []), ("loiter_ahrs_continuous", []), ("loiter_ahrs_continuous", [CIRCLE])],
)
def test_a_circle_without_a_pitot_tube_is_no_tilt(flight: str, plan: list[str], grade: str) -> None:
    """What a lasting turn accelerates was taken for tilt and for biases: 1.3 to 3.8 deg, 4 to 9 times the claim."""
    seeds = range(986001, 986011)
    flown = [flight] * len(seeds), [[*plan, f"sensors.imu.grade={grade}"]] * len(seeds)
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        found = np.array(list(pool.map(level, *flown, seeds)))
    tilt, nees = np.median(found, axis=0)
    print(f"{flight}, {grade}: {tilt:.2f} deg, NEES {nees:.2f}", np.round(found, 2).tolist())
    assert tilt < 1.5
    assert 0.2 < nees < 3.0


def heading(grade: str, seed: int) -> list[float]:
    """Mean square of the heading over what is claimed of it, of both profiles, a quarter of an hour straight on."""
    plan = [{"leg": "straight", "length_m": 60000}]
    flown = {"expect": {}, "duration_s": 900, "plan": plan, "sensors.gnss.denied": [], "sensors.imu.grade": grade}
    by = [
        {"name": "jiang2021", "kind": "ahrs", "aids": ["airspeed", "barometer", "magnetometer"]},
        {"name": "any_motion", "kind": "ahrs", "profile": "any_motion", "aids": ["magnetometer"]},
    ]
    result = run(Scenario.load("loiter_gnss_outage", flown | {"estimator": by}), seed=seed)
    series = [error_series(result, name).loc[60:] for name in ("jiang2021", "any_motion")]
    return [float(np.square(one["phi_down_deg"] / one["sigma_phi_down_deg"]).mean()) for one in series]


@pytest.mark.slow
@pytest.mark.parametrize("grade", ["mems-consumer", "mems-industrial", "mems-hobby"])
def test_a_heading_straight_on_is_claimed_no_better_than_iron_leaves_it(grade: str) -> None:
    """Iron pulls it one way then: it was claimed by 2.0 to 6.7 times (medians of the square) too well."""
    seeds = range(993201, 993211)
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        found = np.array(list(pool.map(heading, [grade] * len(seeds), seeds)))
    print(f"{grade}: NEES of the heading", np.round(np.median(found, axis=0), 2), np.round(found, 2).tolist())
    assert (np.median(found, axis=0) < 2.0).all()
