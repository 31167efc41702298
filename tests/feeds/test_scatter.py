"""How much of a receiver's error is another one at each fix, and that filters are told so."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pymap3d
import pytest

from nav.samples import Array, FixType, GnssSample
from testbed import Scenario, run
from testbed.feeds import draft, formats
from testbed.feeds.scatter import otherwise, scatter
from testbed.feeds.survey import survey
from testbed.motion.logged import LogTruth
from testbed.sensors.gnss import GRADES, GnssConfig

WHITE = np.array([0.8, 0.8, 1.5])


def circling(
    rate_hz: float, claims: float | Array, white: Array = WHITE, lasting: float = 0.0, velocities: bool = True
) -> list[GnssSample]:
    """Laps of 150 m at 15 m/s, by pymap3d; ``lasting`` [m] is a Markov error of 100 s."""
    random = np.random.default_rng(4)
    t = np.arange(0, 300, 1 / rate_hz)
    angle = 15.0 / 150.0 * t
    walk, kept = np.zeros(3), math.exp(-1 / (100 * rate_hz))
    fixes = []
    for now, turned in zip(t.tolist(), angle.tolist(), strict=True):
        walk = kept * walk + math.sqrt(1 - kept**2) * lasting * random.normal(size=3)
        off = white * random.normal(size=3) + walk
        north, east = 150 * math.sin(turned) + off[0], 150 * (1 - math.cos(turned)) + off[1]
        place = pymap3d.ned2geodetic(north, east, off[2], 47.0, 179.9999, 300.0)
        v_n = 15.0 * np.array([math.cos(turned), math.sin(turned), 0.0]) + 0.05 * random.normal(size=3)
        v_n = v_n if velocities else np.full(3, math.nan)
        lat, lon = np.deg2rad(place[:2]).tolist()
        sigma = claims * np.ones(3)
        fixes.append(GnssSample(now, now, lat, lon, place[2], v_n, sigma, np.full(3, 0.1), FixType.FIX_3D, 9, 1, 1))
    return fixes


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize("rate_hz", [1.0, 5.0])
def test_white_noise_is_found_beside_motion_and_what_lasts(rate_hz: float, velocities: bool) -> None:
    found = scatter(circling(rate_hz, 2.0, lasting=2.0, velocities=velocities))
    assert found is not None
    np.testing.assert_allclose(found, WHITE, rtol=0.25)


def test_fixes_that_are_told_again_are_no_scatter() -> None:
    once = circling(5.0, 2.0, white=0.1 * WHITE, lasting=2.0)
    again = [replace(one, t=one.t + late, t_arrival=one.t + late) for one in once for late in (0.0, 0.1)]
    assert otherwise(again, GRADES["u-blox-m8"]) == {}
    np.testing.assert_allclose(scatter(again), scatter(once))  # type: ignore[arg-type]


def test_of_few_fixes_nothing_is_known() -> None:
    assert scatter(circling(1.0, 1.0)[:30]) is None
    assert scatter([]) is None
    assert otherwise([], GRADES["standalone"]) == {}


def test_a_claim_that_is_all_scatter_leaves_nothing_that_lasts() -> None:
    told = GRADES["standalone"]
    keys = otherwise(circling(1.0, WHITE), told)
    assert keys.keys() == {"horizontal_correlated_m", "vertical_correlated_m"}
    assert max(keys.values()) < 0.8
    assert otherwise(circling(1.0, 2.5, white=0.3 * WHITE, lasting=2.0), told) == {}


def test_without_claims_the_noise_is_told() -> None:
    keys = otherwise(circling(1.0, math.nan), GRADES["standalone"])
    assert keys == {
        "horizontal_white_m": pytest.approx(0.8, rel=0.25), "vertical_white_m": pytest.approx(1.5, rel=0.25),
    }  # fmt: skip
    assert otherwise(circling(1.0, math.nan, white=0.2 * WHITE), GRADES["standalone"]) == {}


@pytest.mark.ci
@pytest.mark.parametrize("grade", ["standalone", "sbas", "rtk", "u-blox-m8"])
def test_the_receivers_of_the_simulator_are_as_they_are_told(grade: str) -> None:
    e = GnssConfig(grade=grade).errors()  # type: ignore[arg-type]
    claims = np.hypot(e.position_white_n, e.position_correlated_n)
    fixes = circling(5.0, claims, white=e.position_white_n, lasting=float(e.position_correlated_n[0]))
    assert otherwise(fixes, GRADES[grade]) == {}


COLUMNS = """
[truth.columns.imu]
time = "0"
form = "increments"
gyro = ["1", "2", "3"]
accel = ["4", "5", "6"]
[truth.columns.gnss]
file = "gnss.txt"
time = "0"
lat = { column = "1", unit = "deg" }
lon = { column = "2", unit = "deg" }
height = "3"
sigma_position = ["4", "5", "6"]
"""


@pytest.mark.ci
def test_increments_and_white_fixes_without_velocities_are_flown_as_the_draft_says(tmp_path: Path) -> None:
    """As KF-GINS has them: a filter that was told that most of a claim lasts was 234 m off, refusing 80 % of them."""
    flown = run(Scenario.load("u_turn", {"estimator": [], "fault": [], "expect": {}, "sensors.gnss.latency_s": 0.0}))
    truth, imu = flown.dataset["truth"], flown.dataset["sensors/imu"]
    rows = np.column_stack([imu["time"].values, imu["dtheta"].values, imu["dv"].values])
    np.savetxt(tmp_path / "imu.txt", rows, fmt="%.12g")
    every, random = slice(10, None, 10), np.random.default_rng(5)
    places = np.column_stack([truth[name].values[every] for name in ("lat", "lon", "h")])
    off = random.normal(size=places.shape) * [1.0, 1.0, 1.5]
    lat, lon, h = pymap3d.ned2geodetic(*off.T, *np.rad2deg(places[:, :2]).T, places[:, 2])
    sigma = np.tile([1.0, 1.0, 1.5], (len(off), 1))
    np.savetxt(tmp_path / "gnss.txt", np.column_stack([truth["time"].values[every], lat, lon, h, sigma]), fmt="%.12g")
    (tmp_path / "table.toml").write_text(
        f'title = "a"\nduration_s = 190\n[truth]\nsource = "log"\nfile = "imu.txt"\n{COLUMNS}'
    )
    told = Scenario.load(tmp_path / "table.toml").truth
    assert isinstance(told, LogTruth)
    out = tmp_path / "drawn.toml"
    out.write_text(draft.scenario(survey(formats.open_log(told)), out, told))
    drawn = Scenario.load(out)
    found = run(drawn)
    assert not [one for one in found.remarks if "scatter" in one or "too sure" in one]
    assert found.metrics["ins.position_horizontal_rms_m"] < 2.5  # of fixes that are 1.4 m off
    unlike = run(Scenario.load(out, {"sensors.gnss.horizontal_correlated_m": 1.0}))
    assert any("say horizontal_correlated_m = 0" in one for one in unlike.remarks)
