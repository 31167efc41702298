"""What a survey makes of logs whose sensors say more than the flight."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nav.samples import AirspeedSample, ImuSamples
from testbed.feeds import draft
from testbed.feeds.log import Log
from testbed.feeds.samples import Fixes
from testbed.feeds.survey import survey

STANDS, LASTS, SPEED, RADIUS = 300.0, 500.0, 15.0, 120.0
WIND_N = np.array([3.0, -2.0])


def flown(shakes: bool, drifts: bool) -> Log:
    """A vehicle that stands while 11.5 m/s blow into its tube, then circles in a wind; its scale is one.

    Its engine may ``shake`` it from the beginning on, and the heights of its receiver ``drift``.
    """
    rng = np.random.default_rng(3)
    t = np.arange(1, round(100 * LASTS) + 1) / 100
    aloft = t > STANDS
    force = np.where(aloft[:, None], [0.0, SPEED**2 / RADIUS, -9.8], [0.0, 0.0, -9.8])
    force += (shakes | aloft)[:, None] * rng.normal(0.0, 1.0, (len(t), 3))
    rate = np.where(aloft[:, None], [0.0, 0.0, SPEED / RADIUS], 0.0)
    imu = ImuSamples(t, np.full(len(t), 0.01), 0.01 * rate, 0.01 * force)
    at = np.arange(0.2, LASTS - 0.2, 0.2)
    course = SPEED * (at - STANDS) / RADIUS
    through_air = SPEED * np.column_stack([np.cos(course), np.sin(course)])
    level = np.where(at[:, None] > STANDS, through_air + WIND_N, 0.0) + rng.normal(0.0, 0.05, (len(at), 2))
    height = np.where(at > STANDS, 50.0, 12.0 * np.sin(at / 40) if drifts else 0.0)
    told = Fixes(at, np.full(len(at), 0.8), np.full(len(at), 0.1), height)
    told.v_n = np.column_stack([level, 0 * at])
    speeds = np.where(at > STANDS, SPEED, 11.5) + rng.normal(0.0, 0.3, len(at))
    air = [AirspeedSample(now, now, eas, "airspeed") for now, eas in zip(at.tolist(), speeds.tolist(), strict=True)]
    samples = {"gnss": told.samples("gnss"), "airspeed": air}
    return Log(Path("a.npz"), "table", {"imu": imu}, samples, None, 0.0, {})


@pytest.mark.parametrize(("shakes", "drifts"), [(False, False), (True, True)])
def test_a_pitot_that_is_blown_on_the_ground_says_nothing_of_its_scale(shakes: bool, drifts: bool) -> None:
    """It was fitted as if it flew, and made 0.8 of one, or in a run that never flew 0.04."""
    assert survey(flown(shakes, drifts)).airspeed_scale["airspeed"] == pytest.approx(1.0, abs=0.01)


@pytest.mark.ci
@pytest.mark.parametrize("samples", [0, None], ids=["mute", "dead"])
def test_a_log_is_surveyed_by_a_unit_that_feels_something(samples: int | None, tmp_path: Path) -> None:
    """By the first, of which no sample was of use, there was a traceback, and by one of zeros all went by these."""
    log = flown(shakes=False, drifts=False)
    imu = log.imus["imu"]
    first = ImuSamples(*(own[:samples] for own in (imu.t, imu.dt, 0 * imu.dtheta, 0 * imu.dv)))
    alone, found = survey(log), survey(replace(log, imus={"first": first, "imu": imu}))
    assert found.phases == alone.phases
    assert str(found.noise["imu"]) == str(alone.noise["imu"])
    text = draft.scenario(found, tmp_path / "draft.toml", None)
    assert text.count('imu = "imu"') == 2
    assert ("[sensors.first]" in text) == bool(len(first))
    assert any("none of its samples can be used" in note for note in found.log.notes) == (not len(first))
