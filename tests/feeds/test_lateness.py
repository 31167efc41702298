"""A receiver whose velocities are older than its positions: measured, drafted, and judged by where it was."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pymap3d
import pytest

from nav.samples import FixType, GnssSample, ImuSamples
from testbed import Scenario, run
from testbed.feeds import draft, formats
from testbed.feeds.lateness import velocity_lag
from testbed.feeds.log import Log
from testbed.feeds.survey import Survey, survey
from testbed.motion.logged import LogTruth

LASTS, SPEED, SWING = 180.0, 12.0, 0.6
STANDS = 15.0


def drive(t):
    """Level velocity (N, 2) and position (N, 2), course and its rate (N,) of a car that turns to either side."""
    fine = np.arange(0.0, LASTS + 1, 0.001)
    go = np.clip((fine - STANDS) / 5, 0, 1)
    course = SWING * np.sin(0.5 * fine) * go
    v = (go * SPEED)[:, None] * np.column_stack([np.cos(course), np.sin(course)])
    p = np.vstack([np.zeros((1, 2)), np.cumsum(0.5e-3 * (v[1:] + v[:-1]), axis=0)])
    rate, push = np.gradient(course, 0.001), np.gradient(go * SPEED, 0.001)

    def at(column):
        return np.interp(np.maximum(t, 0.0), fine, column)

    v_n, p_n = (np.column_stack([at(one[:, 0]), at(one[:, 1])]) for one in (v, p))
    return v_n, p_n, at(rate), at(push), at(go * SPEED)


def fixes(lag, late=0.0, period=0.2, noise=0.02):
    """What a receiver says at times (N,): places, velocities ``lag`` older, all told ``late``."""
    rng = np.random.default_rng(4)
    t = np.arange(1.0, LASTS - 1, period)
    place, v_n = drive(t - late)[1], drive(t - late - lag)[0]
    lat, lon, h = pymap3d.enu2geodetic(place[:, 1], place[:, 0], 0 * t, 48.0, 11.0, 500.0)
    down = np.zeros((len(t), 1))
    return t, lat, lon, h, np.hstack([v_n, down]) + rng.normal(0.0, noise, (len(t), 3))


def samples(lag, **how):
    t, lat, lon, h, v_n = fixes(lag, **how)
    sigma = np.ones(3)
    return [
        GnssSample(
            t[k], t[k], np.radians(lat[k]), np.radians(lon[k]), h[k], v_n[k], sigma, sigma, FixType.FIX_3D, 9, 1, 1
        )
        for k in range(len(t))
    ]


@pytest.mark.parametrize("period", [0.1, 0.2, 1.0])
@pytest.mark.parametrize("lag", [-0.1, 0.05, 0.3])
def test_how_much_older_velocities_are_than_positions(lag, period):
    assert velocity_lag(samples(lag, period=period)) == pytest.approx(lag, abs=0.012)


def test_none_is_found_where_there_is_none_or_nothing_shows_it():
    assert velocity_lag(samples(0.0)) is None
    assert velocity_lag(samples(0.2)[:50]) is None
    assert velocity_lag([replace(one, v_n=np.full(3, np.nan)) for one in samples(0.2)]) is None
    still = [replace(one, v_n=np.zeros(3)) for one in samples(0.2)]
    assert velocity_lag(still) is None
    noisy = [replace(one, lat=one.lat + (-1) ** k * 5e-7) for k, one in enumerate(samples(0.02))]
    assert velocity_lag(noisy) is None


def test_a_gap_and_the_date_line_make_none():
    own = samples(0.2)
    holed = [one for one in own if not 40 < one.t < 60]
    assert velocity_lag(holed) == pytest.approx(0.2, abs=0.012)
    there = [replace(one, lon=(one.lon - own[300].lon) % (2 * np.pi) - np.pi) for one in own]
    assert velocity_lag(there) == pytest.approx(0.2, abs=0.012)


def table(folder, lag, late, sigma=0.01):
    """The scenario of a table with the car's IMU and such a receiver, that claims ``sigma`` [m]."""
    rng = np.random.default_rng(5)
    t = np.arange(0.01, LASTS, 0.01)
    _, _, rate, push, speed = drive(t - 0.005)
    zero = np.zeros(len(t))
    gyro = np.column_stack([zero, zero, rate]) + rng.normal(0.0, 2e-3, (len(t), 3))
    accel = np.column_stack([push, speed * rate, zero - 9.8088]) + rng.normal(0.0, 0.03, (len(t), 3))
    at, lat, lon, h, v_n = fixes(lag, late)
    claims = np.full((len(at), 3), sigma)
    said = {"lat": lat, "lon": lon, "h": h, "v": v_n, "sp": claims, "sv": claims + 0.05}
    np.savez(folder / "car.npz", t=t, gyro=gyro, accel=accel, at=at, **said)
    (folder / "car.toml").write_text(
        'title = "car"\nduration_s = 170\n[truth]\nsource = "log"\nfile = "car.npz"\n'
        '[truth.columns.imu]\ntime = "t"\ngyro = "gyro"\naccel = "accel"\n[truth.columns.gnss]\ntime = "at"\n'
        'lat = { column = "lat", unit = "deg" }\nlon = { column = "lon", unit = "deg" }\nheight = "h"\n'
        'velocity = "v"\nsigma_position = "sp"\nsigma_velocity = "sv"\n'
        '[sensors.imu]\ngrade = "mems-hobby"\n[sensors.gnss]\n'
        '[[estimator]]\nname = "ins"\nkind = "ins"\naids = ["gnss"]\n'
    )
    return Scenario.load(folder / "car.toml")


def drafted(folder, **how):
    truth = table(folder, **how).truth
    assert isinstance(truth, LogTruth)
    (folder / "draft.toml").write_text(draft.scenario(survey(formats.open_log(truth)), folder / "draft.toml", truth))
    return Scenario.load(folder / "draft.toml")


@pytest.mark.ci
def test_a_draft_says_both_and_is_judged_by_where_the_receiver_was(tmp_path):
    scenario = drafted(tmp_path, lag=0.2, late=0.1)
    receiver = scenario.sensors["gnss"]
    assert receiver.grade == "rtk"  # by what it claims
    assert receiver.latency_s == pytest.approx(0.1, abs=0.021)
    assert receiver.velocity_lag_s == pytest.approx(0.2, abs=0.021)
    flown = run(scenario)
    assert "its velocities 0.20 s more" in flown.dataset.attrs["reference"]
    # Was 2.2 m: the reference was where the receiver had been 0.2 s before.
    assert flown.metrics["ins.position_horizontal_rms_m"] < 0.3
    assert flown.metrics["ins.velocity_rms_mps"] < 0.3


def test_velocities_of_the_reference_are_as_old_as_is_told(tmp_path):
    scenario = table(tmp_path, lag=0.2, late=0.0).changed(
        {"sensors.gnss.grade": "rtk", "sensors.gnss.latency_s": 0.0, "sensors.gnss.velocity_lag_s": 0.2}
    )
    metrics = run(scenario).metrics
    assert metrics["ins.position_horizontal_rms_m"] < 0.05
    assert metrics["ins.velocity_rms_mps"] < 0.2  # was 1 m/s


@pytest.mark.parametrize(("sigma", "grade"), [(0.02, "rtk"), (0.5, "u-blox-m8")])
def test_the_grade_of_a_receiver_is_by_what_it_claims(sigma, grade, tmp_path):
    assert drafted(tmp_path, lag=0.0, late=0.1, sigma=sigma).sensors["gnss"].grade == grade


def test_a_claim_that_is_missing_hides_no_others():
    """One of a thousand made the median of them no number, and an RTK receiver a u-blox M8."""
    imu = ImuSamples(np.array([0.1, 0.2]), np.full(2, 0.1), np.zeros((2, 3)), np.full((2, 3), -0.5))
    own = [replace(one, sigma_position_n=np.full(3, 0.02)) for one in samples(0.0)]
    own[2] = replace(own[2], sigma_position_n=np.full(3, np.nan))
    log = Log(Path("a.npz"), "table", {"imu": imu}, {"gnss": own}, None, 0.0, {})
    found = Survey(log, {}, [], {}, {}, {}, {}, {}, {})
    assert draft.sections(found)["gnss"]["grade"] == "rtk"


@pytest.mark.ci
@pytest.mark.parametrize("late", [1.0, 2.4])
def test_a_receiver_of_another_clock_is_found_and_told(late, tmp_path):
    """Nothing was found, and nothing said but that noise is larger than is told."""
    flown = run(table(tmp_path, lag=0.0, late=late).changed({"sensors.gnss.grade": "rtk"}))
    (found,) = re.findall(r"gnss is ([\d.]+) ± 0.01 s late by the IMU, and told to be 0.1:", " ".join(flown.remarks))
    assert float(found) == pytest.approx(late, abs=0.03)
    scenario = drafted(tmp_path, lag=0.0, late=late)
    assert scenario.sensors["gnss"].latency_s == pytest.approx(late, abs=0.03)
    assert run(scenario).metrics["ins.position_horizontal_rms_m"] < 0.5
