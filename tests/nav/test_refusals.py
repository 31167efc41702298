"""What is refused for long: its bias is opened again, while GNSS says that it is not the filter that is wrong."""

import dataclasses

import numpy as np
import pytest
from worlds.ins import CONSUMER, DT, FIELD_N, barometer, feed, flight, gnss, imu, magnetometer

from nav.aids import BarometerAid, GnssAid, MagnetometerAid
from nav.detection import Refusals
from nav.earth import isa_pressure, pressure_altitude
from nav.horizon import FusionHorizon
from nav.ins import REOPENED, Ins, InsConfig

MOVED_S, MOVED = 30.0, 15.0  # when the barometer's height moves, and by how much [s, m]
AIDS = (GnssAid(), BarometerAid(bias_sigma=10.0), MagnetometerAid())


def moved(sample):
    if sample.t < MOVED_S:
        return sample
    return dataclasses.replace(sample, pressure=isa_pressure(pressure_altitude(sample.pressure) + MOVED))


def flown(denied_s=np.inf):
    """Reports on the barometer, and estimates every second, of a flight in which its height moves."""
    truth, rng = flight(100), np.random.default_rng(91301)
    increments, *_ = imu(truth, CONSUMER, rng)
    samples = [one for one in gnss(truth, rng, 5.0) if one.t < denied_s] + magnetometer(truth, rng)
    samples += [moved(one) for one in barometer(truth, rng, 5.0)]
    estimates, reports = feed(FusionHorizon(Ins(InsConfig(CONSUMER, AIDS), lambda *_: FIELD_N)), increments, samples)
    return truth, estimates, [one for one in reports if one.aid == "barometer"]


@pytest.mark.ci
def test_a_barometer_that_moved_is_used_again_when_patience_ends():
    truth, estimates, reports = flown()
    refused = [one.t for one in reports if not one.weight and one.t > MOVED_S - 0.5]
    opened = [one.t for one in reports if one.reason == REOPENED]
    assert opened == pytest.approx([MOVED_S + 30.0], abs=0.2)
    assert max(refused) < opened[0]
    bias, sigma = estimates[-1].extra["barometer_bias"]
    assert abs(bias - 5.0 - MOVED) < 4 * sigma
    for estimate in estimates[5:]:
        off = estimate.h - truth.h[round(estimate.t / DT)]
        assert abs(off) < 4.5 * np.sqrt(estimate.covariance[2, 2])


@pytest.mark.ci
def test_without_gnss_it_may_be_the_filter_that_is_wrong():
    _, _, reports = flown(denied_s=MOVED_S + 1)
    assert not any(one.reason == REOPENED for one in reports)


def test_patience_begins_anew_with_a_taken_one_and_after_silence():
    refusals = Refusals(30.0)
    assert [t for t in range(0, 40, 5) if refusals.too_long(t)] == [30, 35]
    refusals.taken()
    assert [t for t in range(40, 80, 5) if refusals.too_long(t)] == [70, 75]
    assert [t for t in range(90, 130, 5) if refusals.too_long(t)] == [120, 125]
