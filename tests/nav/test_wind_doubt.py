"""A filter without fixes that is sure of a wind which has changed, and reports that say so."""

import dataclasses

import numpy as np
import pytest
from worlds.ins import CONSUMER, DEG, FIELD_N, error, flight

from nav.aids import AirspeedAid, BarometerAid, GnssAid, WindReportAid
from nav.alignment import InitialState
from nav.doubts import WindDoubt
from nav.earth import radii
from nav.error_model import POS, VEL
from nav.ins import Ins, InsConfig
from nav.samples import Outcome, WindSample

CHANGE = np.array([-8.0, 5.0])  # of the wind [m/s]
LASTING, SINCE = 600.0, 350.0  # without a fix, and since the wind changed [s]


def report(wind_n, t=LASTING, sigma=0.5):
    return WindSample(t, t, np.asarray(wind_n, float), 0.0, sigma)


def astray():
    """A filter at the first moment of a flight that took the wind of before for that of now since `SINCE` ago."""
    truth = flight(30)
    ins = Ins(InsConfig(CONSUMER, (GnssAid(), BarometerAid(), AirspeedAid(), WindReportAid())), lambda *_: FIELD_N)
    covariance = np.diag(np.repeat([0.1 * DEG, 0.3, 30.0], 3) ** 2)
    R_M, R_N = radii(truth.lat[0])
    north, east = -CHANGE * SINCE
    lat, lon = truth.lat[0] + north / R_M, truth.lon[0] + east / (R_N * np.cos(truth.lat[0]))
    v_n = truth.v_n[0] - np.append(CHANGE, 0.0)
    ins.start(InitialState(LASTING, lat, lon, truth.h[0], v_n, truth.q_nb[0], covariance))
    ins._monitor.last_fused = 0.0
    state, wind = ins._state, ins.model.slices["wind"]
    state.P[0][wind, wind] = 0.3**2 * np.eye(2)
    for axis in range(2):  # the velocity through the air is known better than that over ground
        state.P[0][VEL + axis, wind.start + axis] = state.P[0][wind.start + axis, VEL + axis] = 0.95 * 0.09
    return ins, truth


def off(ins, truth):
    """Horizontal errors of position and velocity (4,), and how many sigmas each is claimed to be."""
    estimate = dataclasses.replace(ins.estimate(), t=0.0)
    found = error(estimate, truth)[[0, 1, 3, 4]]
    return found, np.abs(found) / np.sqrt(estimate.covariance.diagonal()[[0, 1, 3, 4]])


def test_one_report_puts_the_motion_in_doubt_and_a_second_opens_the_wind_again():
    ins, truth = astray()
    before, sigmas = off(ins, truth)
    assert np.all(sigmas > 10)
    (first,) = ins.update(report(CHANGE))
    assert first.outcome is Outcome.OUTSIDE_GATE
    after, sigmas = off(ins, truth)
    np.testing.assert_array_equal(after, before)
    assert np.all(sigmas < 2.5)
    (second,) = ins.update(report(CHANGE + 0.4))
    assert second.outcome is Outcome.FUSED
    after, sigmas = off(ins, truth)
    assert np.all(np.abs(after[2:]) < 1.0)
    assert np.all(np.abs(after[:2]) < 0.2 * np.abs(before[:2]))
    assert np.all(sigmas < 2)
    np.testing.assert_allclose(ins._state.x[0, ins.model.slices["wind"]], CHANGE, atol=1.0)
    (third,) = ins.update(report(CHANGE))
    assert third.outcome is Outcome.FUSED


def test_reports_that_contradict_each_other_are_not_believed():
    ins, truth = astray()
    before, _ = off(ins, truth)
    for wind in ([20.0, 0.0], [0.0, -20.0], [-20.0, 20.0]):
        (told,) = ins.update(report(wind))
        assert told.outcome is Outcome.OUTSIDE_GATE
    np.testing.assert_array_equal(off(ins, truth)[0], before)


def test_a_filter_with_fixes_knows_the_wind_better_than_reports():
    ins, _ = astray()
    ins._monitor.last_fused = LASTING
    for _ in range(3):
        (told,) = ins.update(report(CHANGE))
        assert told.outcome is Outcome.OUTSIDE_GATE
    assert not ins._wind_doubt.off(LASTING).any()


def test_a_doubt_grows_with_time_and_ends_with_the_next_fix():
    doubt = WindDoubt(10.0)
    doubt.right(100.0)
    assert not doubt.refused(report([8.0, 0.0], 400.0), np.array([8.0, 0.0]), np.full(2, 0.25))
    at_once, later = doubt.off(400.0), doubt.off(700.0)
    assert at_once[VEL] == later[VEL] == -8.0
    assert at_once[POS] == pytest.approx(-8.0 * 300 / np.sqrt(3))
    assert later[POS] == pytest.approx(2 * at_once[POS])
    doubt.right(99.0)
    np.testing.assert_array_equal(doubt.off(700.0), later)
    doubt.right(701.0)
    assert not doubt.off(800.0).any()


def test_a_report_that_is_used_takes_the_doubt_away_however_old_its_wind_is():
    doubt = WindDoubt(10.0)
    doubt.right(100.0)
    doubt.refused(report([8.0, 0.0], 400.0), np.array([8.0, 0.0]), np.full(2, 0.25))
    doubt.right(50.0, told=True)
    assert not doubt.off(500.0).any()
    assert doubt.lasting(500.0) == 400.0
